"""Node that removes the distortion from every observation of the fluoroscopes, live."""

import time
from collections import Counter

import numpy as np
from fluoro_calib_msgs.msg import CorrectedObservations, TargetObservations
from sensor_msgs.msg import CameraInfo

from . import support
from .calibrations import Calibrations
from .checks import KINDS, FrameChecks, Refused
from .conversion import camera_info, fill_corrected
from .qos import LATCHED, OBSERVATIONS, overridable
from .streams import StreamReader


class _Stream:
    """What the node holds of one fluoroscope."""

    def __init__(self, name):
        self.checks, self.out = FrameChecks(name), CorrectedObservations()
        self.received = self.corrected = self.waiting = self.invalid_points = 0
        self.refused = Counter()   # by kind
        self.last_fault = ''
        self.latencies = support.Latencies()   # from the arrival of a frame to its publication
        self.stamp = None


class CorrectionNode(support.ManagedNode):
    """Publishes corrected observations; nothing before there is a calibration."""

    def __init__(self):
        super().__init__('correction_node')
        self._streams = {name: _Stream(name) for name in support.fluoroscopes_of(self)}
        self._sentences = support.Sentences(self.get_logger())
        self._corrected, self._info = {}, {}
        self._calibrations = self._reader = self._diagnostics = self._timer = None

    # -- lifecycle

    def open(self):
        """Make outputs, and take calibrations."""
        for name in self._streams:
            self._corrected[name] = self.create_lifecycle_publisher(
                CorrectedObservations, f'{name}/corrected_observations', OBSERVATIONS,
                qos_overriding_options=overridable())
            self._info[name] = self.create_publisher(CameraInfo, f'{name}/camera_info', LATCHED)
        self._calibrations = Calibrations(self, self._streams, self._prepared, self._on_taken, self._on_refused)
        self._diagnostics = support.Diagnostics(self)
        self._timer = self.create_timer(1.0, self._on_timer)

    def begin(self):
        """Take observations."""
        self._reader = StreamReader(self, self._on_undecodable, self.fail)
        for name in self._streams:
            self._reader.subscribe(TargetObservations, f'{name}/target_observations',
                                   lambda message, info, name=name: self._on_frame(name, message, info),
                                   OBSERVATIONS)
        self._reader.start()

    def end(self):
        """Take no more observations."""
        if self._reader is not None:
            self._reader.stop()
            self._reader = None

    def close(self):
        """Take the outputs back, and forget the calibrations."""
        if self._timer is not None:
            self._calibrations.close()
            self.destroy_timer(self._timer)
            self._diagnostics.close()
        for publisher in (*self._corrected.values(), *self._info.values()):
            self.destroy_publisher(publisher)
        self._timer, self._calibrations, self._corrected, self._info = None, None, {}, {}
        self._streams = {name: _Stream(name) for name in self._streams}

    # -- calibrations

    @staticmethod
    def _prepared(calibration):
        calibration.prepare()
        return calibration

    def _on_refused(self, name, error):
        self._streams[name].last_fault = str(error)

    def _on_taken(self, name, calibration):
        self._publish_info(name)
        grid = calibration.grid
        self.get_logger().info(f'fluoroscope {name}: corrected with calibration {calibration.calibration_id} now '
                               f'(grid of {grid.cell_px:g} px cells, within {grid.error_px:.4f} px of the model)')

    def _publish_info(self, name):
        calibration = self._calibrations.of(name)
        if calibration is not None:
            stamp = self._streams[name].stamp or self.get_clock().now().to_msg()
            self._info[name].publish(camera_info(calibration, stamp))

    # -- observations

    def _on_undecodable(self, topic):
        name = topic.split('/')[-2]
        self._streams[name].received += 1
        self._refuse(self._streams[name], Refused('undecodable', f'fluoroscope {name}: a message on {topic} cannot be '
                                                  'decoded'))

    def _refuse(self, stream, error):
        stream.refused[error.kind] += 1
        stream.last_fault = str(error)
        self._sentences.warn(f'frame refused: {error}')

    def _on_frame(self, name, message, info):
        """Correct a frame and publish it."""
        stream = self._streams[name]
        stream.received += 1
        stream.stamp = message.header.stamp
        calibration = self._calibrations.of(name)
        if calibration is None:
            stream.waiting += 1
            return
        try:
            u, v, sigma = stream.checks.arrays_of(message, calibration)
        except Refused as error:
            self._refuse(stream, error)
            return
        out = stream.out   # publishing copies it
        invalid = fill_corrected(out, message, calibration.calibration_id, calibration.correct_arrays(u, v, sigma))
        self._corrected[name].publish(out)
        stream.corrected += 1
        stream.latencies.add(time.time_ns() - info['received_timestamp'])
        if invalid or not out.status:
            self._remark(name, stream, out)

    def _remark(self, name, stream, out):
        """Say what was wrong with single points of a frame that has been published."""
        where = f'fluoroscope {name}, frame {out.frame_number}'
        if not out.status:
            stream.last_fault = f'{where}: the frame is empty, it has no targets'
        else:
            invalid = np.flatnonzero(np.asarray(out.status) == out.INVALID)
            stream.invalid_points += len(invalid)
            stream.last_fault = (f'{where}: target {out.target_id[int(invalid[0])]} is not a point of the image, '
                                 'it is published as INVALID')
        self._sentences.warn(stream.last_fault)

    # -- diagnostics

    def _on_timer(self):
        parts, deaf = [], support.deafness(self._reader, self._sentences)
        for name, stream in self._streams.items():
            self._publish_info(name)
            calibration = self._calibrations.of(name)
            values = {'frames received': stream.received, 'frames corrected': stream.corrected,
                      'frames without calibration': stream.waiting, 'frames refused': stream.refused.total(),
                      **{f'refused: {kind}': stream.refused[kind] for kind in KINDS},
                      'invalid points': stream.invalid_points, 'last fault': stream.last_fault,
                      'readers': self._corrected[name].get_subscription_count(),
                      'calibration': calibration.calibration_id if calibration else '',
                      'grid error [px]': f'{calibration.grid.error_px:.4f}' if calibration else '',
                      **stream.latencies.values()}
            parts.append((name, *self._verdict(name, stream, deaf.get(f'{name}/target_observations')), values))
        self._diagnostics.publish(parts)

    def _verdict(self, name, stream, deaf):
        """Level and message of the diagnostics of a fluoroscope."""
        if deaf:
            return support.WARN, deaf
        if self._calibrations.of(name) is None:
            return support.WARN, f'no calibration yet: {stream.waiting} frames were not corrected'
        if self._reader is None:
            return support.WARN, 'the node is not active'
        if self.count_publishers(f'{name}/target_observations') == 0:
            return support.WARN, 'nobody publishes target observations'
        if stream.refused:
            return support.WARN, f'{stream.refused.total()} frames refused: {stream.last_fault}'
        return support.OK, 'correcting'


def main(args=None):
    """Entry point."""
    support.run(CorrectionNode, args)


if __name__ == '__main__':
    main()
