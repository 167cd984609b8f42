"""Node that removes the distortion from every observation of the fluoroscopes, live."""

import threading
import time
from collections import deque

import numpy as np
from fluoro_calib_msgs.msg import CorrectedObservations, FluoroscopeCalibration
from rclpy.node import Node
from sensor_msgs.msg import CameraInfo

from ..bags.reader import frame_from_message
from ..photogrammetry.observations import DataError
from . import support
from .conversion import calibration_from_message, camera_info, corrected_message
from .qos import LATCHED, OBSERVATIONS, overridable
from .support import StartError, declare


class _Stream:
    """What the node holds of one fluoroscope."""

    def __init__(self):
        self.newest = 0   # number of the last calibration that arrived
        self.preparing = None   # thread that prepares it
        self.calibration = None   # replaced as a whole: a frame sees one or the other, never half of each
        self.received = self.corrected = self.waiting = self.refused = self.invalid_points = 0
        self.last_fault = ''
        self.deaf = ''   # what keeps a publisher from being heard
        self.latencies = deque(maxlen=2000)   # seconds from the arrival of a frame to its publication
        self.stamp = None


class CorrectionNode(Node):
    """Publishes corrected observations; nothing before there is a calibration."""

    def __init__(self):
        super().__init__('correction_node')
        names = list(declare(self, 'fluoroscopes', ['a', 'b'], 'names of the fluoroscopes'))
        if not names or len(set(names)) != len(names):
            raise StartError(f'parameter fluoroscopes: {names} is not a list of different names')
        self._streams = {name: _Stream() for name in names}
        self._sentences = support.Sentences(self.get_logger())
        self._corrected, self._info = {}, {}
        for name in names:
            self._corrected[name] = self.create_publisher(
                CorrectedObservations, f'{name}/corrected_observations', OBSERVATIONS,
                qos_overriding_options=overridable())
            self._info[name] = self.create_publisher(CameraInfo, f'{name}/camera_info', LATCHED)
            self.create_subscription(FluoroscopeCalibration, f'{name}/calibration',
                                     lambda message, name=name: self._on_calibration(name, message), LATCHED)
            support.subscribe_observations(self, name, self._on_frame, self._on_deaf)
        self._diagnostics = support.Diagnostics(self)
        self.create_timer(1.0, self._on_timer)

    def _on_deaf(self, name, fault):
        """Say that nothing can come from a publisher."""
        self._streams[name].deaf = fault
        self._sentences.warn(fault)

    def _on_calibration(self, name, message):
        """Prepare a calibration beside the stream, and take it over when it is ready."""
        self._streams[name].newest += 1
        stream = self._streams[name]
        stream.preparing = threading.Thread(target=self._prepare, args=(name, message, stream.newest), daemon=True)
        stream.preparing.start()

    def _prepare(self, name, message, number):
        try:
            calibration = calibration_from_message(message)
            if calibration.fluoroscope != name:
                raise DataError(f'the calibration on topic {name}/calibration is of fluoroscope '
                                f'{calibration.fluoroscope}')
            calibration.prepare()
        except (DataError, ValueError) as error:
            self._streams[name].last_fault = str(error)
            self.get_logger().error(f'calibration refused, the running one stays: {error}')
            return
        stream = self._streams[name]
        if number < stream.newest:
            return   # a newer one has come meanwhile
        stream.calibration = calibration
        self._publish_info(name)
        self.get_logger().info(f'fluoroscope {name}: corrected with calibration {calibration.calibration_id} now')

    def _publish_info(self, name):
        stream = self._streams[name]
        if stream.calibration is not None:
            stamp = stream.stamp or self.get_clock().now().to_msg()
            self._info[name].publish(camera_info(stream.calibration, stamp))

    def _on_frame(self, name, message):
        """Correct a frame and publish it."""
        arrived = time.perf_counter()
        stream = self._streams[name]
        stream.received += 1
        stream.stamp = message.header.stamp
        calibration = stream.calibration
        if calibration is None:
            stream.waiting += 1
            return
        try:
            frame = frame_from_message(message, name, f'fluoroscope {name}')
            _check(frame, calibration)
            corrected = calibration.correct(frame.uv, frame.sigma)
        except DataError as error:
            stream.refused += 1
            stream.last_fault = str(error)
            self._sentences.warn(f'frame refused: {error}')
            return
        self._corrected[name].publish(corrected_message(message, calibration.calibration_id, corrected))
        stream.corrected += 1
        stream.latencies.append(time.perf_counter() - arrived)
        self._remark(stream, frame, corrected)

    def _remark(self, stream, frame, corrected):
        """Say what was wrong with single points of a frame that has been published."""
        where = f'fluoroscope {frame.fluoroscope}, frame {frame.number}'
        if len(frame.target_id) == 0:
            stream.last_fault = f'{where}: the frame is empty, it has no targets'
            self._sentences.warn(stream.last_fault)
        invalid = np.flatnonzero(np.isnan(corrected.sigma))
        if len(invalid):
            stream.invalid_points += len(invalid)
            stream.last_fault = (f'{where}: target {frame.target_id[invalid[0]]} is not a point of the image, '
                                 'it is published as INVALID')
            self._sentences.warn(stream.last_fault)

    def _on_timer(self):
        parts = []
        for name, stream in self._streams.items():
            self._publish_info(name)
            values = {'frames received': stream.received, 'frames corrected': stream.corrected,
                      'frames without calibration': stream.waiting, 'frames refused': stream.refused,
                      'invalid points': stream.invalid_points, 'last fault': stream.last_fault,
                      'calibration': stream.calibration.calibration_id if stream.calibration else ''}
            if stream.latencies:
                p50, p99 = np.percentile(list(stream.latencies), [50, 99]) * 1e3
                values |= {'latency p50 [ms]': f'{p50:.3f}', 'latency p99 [ms]': f'{p99:.3f}'}
            parts.append((name, *self._verdict(name, stream), values))
        self._diagnostics.publish(parts)

    def _verdict(self, name, stream):
        """Level and message of the diagnostics of a fluoroscope."""
        if stream.deaf:
            return support.WARN, stream.deaf
        if stream.calibration is None:
            return support.WARN, f'no calibration yet: {stream.waiting} frames were not corrected'
        if self.count_publishers(f'{name}/target_observations') == 0:
            return support.WARN, 'nobody publishes target observations'
        if stream.refused:
            return support.WARN, f'{stream.refused} frames refused: {stream.last_fault}'
        return support.OK, 'correcting'

    def stop(self):
        """Wait for what is being prepared: it needs the node."""
        for stream in self._streams.values():
            if stream.preparing is not None:
                stream.preparing.join()


def _check(frame, calibration):
    """Raise DataError for a frame that cannot be corrected as a whole."""
    where = f'fluoroscope {frame.fluoroscope}, frame {frame.number}'
    if frame.image_size != calibration.image_size:
        raise DataError(f'{where}: the image is {frame.image_size[0]} x {frame.image_size[1]} px, but the '
                        f'calibration is for {calibration.image_size[0]} x {calibration.image_size[1]} px')
    values, counts = np.unique(frame.target_id, return_counts=True)
    if len(values) < len(frame.target_id):
        raise DataError(f'{where}: target {values[counts > 1][0]} is there {counts.max()} times')
    if frame.sigma is not None:
        wrong = ~(np.isfinite(frame.sigma) & (frame.sigma > 0))
        if wrong.any():
            raise DataError(f'{where}: sigma of target {frame.target_id[wrong][0]} is not a positive number')


def main(args=None):
    """Entry point."""
    support.run(CorrectionNode, args)


if __name__ == '__main__':
    main()
