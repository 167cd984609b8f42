"""Node that removes the distortion from every observation of the fluoroscopes, live."""

import numpy as np
from builtin_interfaces.msg import Time
from fluoro_calib_msgs.msg import CorrectedObservations, TargetObservations
from sensor_msgs.msg import CameraInfo

from ..distortion.grid import INVALID
from . import support
from .checks import KINDS, FrameChecks, Refused
from .conversion import camera_info
from .correcting import CorrectingNode, Stream
from .qos import LATCHED, OBSERVATIONS
from .wire import corrected_bytes, observations_of


class _Stream(Stream):
    """What the node holds of one fluoroscope."""

    def __init__(self, name):
        super().__init__()
        self.checks = FrameChecks(name)
        self.invalid_points = 0
        self.stamp = None  # seconds and nanoseconds of the newest frame


class CorrectionNode(CorrectingNode):
    """Publishes corrected observations; nothing before there is a calibration."""

    item = 'frame'
    subject = 'target observations'
    topics = ('target_observations',)
    kinds = KINDS
    new_stream = _Stream

    def __init__(self):
        super().__init__('correction_node')

    def make(self):
        """Make outputs, and take calibrations."""
        self._corrected = {}
        self._info = {}
        for name in self.names:
            self._corrected[name] = self.publisher(
                CorrectedObservations, f'{name}/corrected_observations', OBSERVATIONS
            )
            self._info[name] = info = self.create_publisher(
                CameraInfo, f'{name}/camera_info', LATCHED
            )
            self.kept(info, self.destroy_publisher, info)
        self.take_calibrations()

    def listen(self):
        """Take observations, all in one thread."""
        reader = self.reader(self.undecodable)
        for name in self.names:
            reader.subscribe(
                TargetObservations,
                f'{name}/target_observations',
                lambda frame, info, name=name: self._on_frame(name, frame, info),
                OBSERVATIONS,
                observations_of,
            )

    # -- calibrations

    @staticmethod
    def prepared(calibration):
        """The calibration with its grid."""
        calibration.prepare()
        return calibration

    def taken(self, name, calibration):
        """Tell that a calibration is in use."""
        self._publish_info(name)
        grid = calibration.grid
        self.get_logger().info(
            f'fluoroscope {name}: corrected with calibration {calibration.calibration_id} now '
            f'(grid of {grid.cell_px:g} px cells, within {grid.error_px:.4f} px of the model)'
        )

    def _publish_info(self, name):
        calibration = self.calibrations.of(name)
        if calibration is not None:
            stamp = self.streams[name].stamp
            self._info[name].publish(
                camera_info(
                    calibration,
                    self.get_clock().now().to_msg()
                    if stamp is None
                    else Time(sec=stamp[0], nanosec=stamp[1]),
                )
            )

    # -- observations

    def _on_frame(self, name, frame, info):
        """Correct a frame, Observations, and publish it."""
        stream = self.streams[name]
        stream.received += 1
        stream.stamp = frame.sec, frame.nanosec
        calibration = self.calibrations.of(name)
        if calibration is None:
            stream.waiting += 1
            return
        try:
            arrays = stream.checks.arrays_of(frame, calibration)
        except Refused as error:
            self.refuse(stream, error)
            return
        corrected = calibration.correct_arrays(*arrays)
        self._corrected[name].publish(
            corrected_bytes(frame, calibration.calibration_id, corrected)
        )
        stream.published(info)
        status = corrected[-1]
        if not len(status) or status.max() == INVALID:
            self._remark(name, stream, frame, status)

    def _remark(self, name, stream, frame, status):
        """Say what was wrong with single points of a frame that has been published."""
        where = f'fluoroscope {name}, frame {frame.frame_number}'
        if not len(status):
            stream.last_fault = f'{where}: the frame is empty, it has no targets'
        else:
            invalid = np.flatnonzero(status == INVALID)
            stream.invalid_points += len(invalid)
            number = np.frombuffer(frame.target_id, np.uint32)[invalid[0]]
            stream.last_fault = (
                f'{where}: target {number} is not a point of the image, it is published as INVALID'
            )
        self.sentences.warn(stream.last_fault)

    # -- diagnostics

    def report(self):
        """Diagnostics of every fluoroscope; with them the camera infos are repeated."""
        for name in self.names:
            self._publish_info(name)
        return super().report()

    def more(self, name, stream, calibration):
        """Further values of the diagnostics."""
        return {
            'invalid points': stream.invalid_points,
            'readers': self._corrected[name].get_subscription_count(),
            'calibration': calibration.calibration_id if calibration else '',
            'grid error [px]': f'{calibration.grid.error_px:.4f}' if calibration else '',
        }


def main(args=None):
    """Entry point."""
    support.run(CorrectionNode, args)


if __name__ == '__main__':
    main()
