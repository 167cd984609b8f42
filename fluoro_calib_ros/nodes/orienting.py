"""The orientation of the rig in the calibration node: captured on request, kept, saved and
published.
"""

import threading
from pathlib import Path

from fluoro_calib_msgs.msg import RigOrientation
from fluoro_calib_msgs.srv import Orient
from rclpy.clock import Clock, ClockType
from rclpy.task import Future

from ..calibration.rig_orientation import orientation_of_capture
from ..errors import DataError
from ..files.rig_orientation import load_orientation, orientation_path, save_orientation
from ..jobs.result_folder import belongs_to
from .qos import LATCHED
from .spatial import message_from_orientation
from .support import check_timeout


class _Capture:
    """A capture of the phantom in the rig frame: pairs of frames until there are enough."""

    def __init__(self, names, count):
        self.frames = {name: [] for name in names}
        self._count = count
        self.done = Future()

    def take(self, pair):
        """Take a pair of frames."""
        for name, frame in pair.items():
            self.frames[name].append(frame)
        if len(self.frames[frame.fluoroscope]) == self._count and not self.done.done():
            self.done.set_result(True)


class Orienting:
    """The service orient of a node, and the orientation that is published on rig_orientation.

    names of the fluoroscopes; phantom; rig_frame: name of the frame of a capture; timeout: longest
    wait of one [s]; directory(): where orientations are saved; calibrations(): those that hold now
    {fluoroscope: calibration}.
    """

    def __init__(self, node, names, phantom, rig_frame, timeout, directory, calibrations, group):
        self._node = node
        self._names = names
        self._phantom = phantom
        self._rig_frame = rig_frame
        self._timeout = timeout
        self._directory = directory
        self._calibrations = calibrations
        self._capture = None
        self._present = None
        self._output = node.create_publisher(RigOrientation, 'rig_orientation', LATCHED)
        node.create_service(Orient, 'orient', self._on_orient, callback_group=group)

    def take(self, pair):
        """Give a pair of frames of the phantom to the capture that waits for it, if one does."""
        if self._capture is not None:
            self._capture.take(pair)
            if self._capture.done.done():
                self._capture = None

    @property
    def present(self):
        """The RigOrientation in use, or None."""
        return self._present

    def publish(self, orientation):
        """Take an orientation over and publish it; None: there is no new one."""
        if orientation is not None:
            self._present = orientation
            self._output.publish(message_from_orientation(orientation))

    def clear(self):
        """Forget the present orientation: it does not belong to the calibrations any more."""
        self._present = None

    def save(self, directory):
        """Save the present orientation, if there is one. Raises DataError."""
        if self._present is not None:
            save_orientation(directory, self._present)

    def read(self, directory, calibrations):
        """RigOrientation in a directory that belongs to calibrations, or None. Raises DataError."""
        path = Path(orientation_path(directory))
        if not path.exists():
            return None
        orientation = load_orientation(path)
        if belongs_to(orientation, calibrations):
            return orientation
        self._node.get_logger().warning(
            f'{path}: the orientation of the rig belongs to other calibrations, it is not used'
        )
        return None

    async def _on_orient(self, request, response):
        """Answer with the orientation of a rig in which the phantom stands."""
        try:
            orientation = await self._captured(request)
            save_orientation(self._directory(), orientation)
        except (DataError, ValueError, OSError) as error:
            response.message = f'the orientation of the rig stays as it is: {error}'
            self._node.get_logger().error(response.message)
            return response
        self.publish(orientation)
        response.success = True
        response.orientation_id = orientation.orientation_id
        response.message = (
            f'{", ".join(orientation.fluoroscopes)} oriented in frame {orientation.frame_id} from '
            f'{orientation.exposures} captures of the phantom, sources within '
            f'{orientation.sd_mm.max():.2f} mm (standard deviation)'
        )
        self._node.get_logger().info(response.message)
        return response

    async def _captured(self, request):
        """RigOrientation from the next frames of all fluoroscopes. Raises DataError and
        ValueError.
        """
        timeout = request.timeout_sec or self._timeout
        count = request.frames or 1
        calibrations = self._calibrations()
        check_timeout(timeout)
        missing = [name for name in self._names if name not in calibrations]
        if missing:
            raise DataError(f'there is no calibration of fluoroscope {missing[0]} yet')
        if self._capture is not None:
            raise DataError('another capture is waiting for its frames')
        waiting = self._capture = _Capture(self._names, count)
        timer = self._node.create_timer(
            timeout,
            lambda: waiting.done.done() or waiting.done.set_result(False),
            clock=Clock(clock_type=ClockType.STEADY_TIME),
        )
        came = await waiting.done
        self._node.destroy_timer(timer)
        if not came:
            self._capture = None
            raise DataError(
                f'{len(waiting.frames[self._names[0]])} of {count} frames of all fluoroscopes '
                f'({", ".join(self._names)}) came within {timeout:g} s'
            )
        calibrations = dict(calibrations)
        orientation = await self._beside(
            lambda: orientation_of_capture(
                waiting.frames, self._phantom, calibrations, self._rig_frame
            )
        )
        if not belongs_to(orientation, self._calibrations()):
            raise DataError('the calibrations have changed meanwhile, capture the phantom again')
        return orientation

    def _beside(self, function):
        """Future of the result of a function that is called in a thread of its own."""
        done = Future()

        def work():
            try:
                done.set_result(function())
            except Exception as error:
                done.set_exception(error)
            if self._node.executor is not None:
                self._node.executor.wake()  # to look at what has been awaited

        threading.Thread(target=work, daemon=True).start()
        return done
