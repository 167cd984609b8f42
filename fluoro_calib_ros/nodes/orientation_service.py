# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The orientation of the rig in the calibration node: captured, saved, loaded and published."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from fluoro_calib_msgs.msg import RigOrientation
from fluoro_calib_msgs.srv import Orient
from rclpy.callback_groups import CallbackGroup
from rclpy.clock import Clock, ClockType
from rclpy.task import Future

from ..calibration.result import FluoroscopeCalibration
from ..errors import DataError
from ..exposures.frame import Frame
from ..exposures.phantom import Phantom
from ..files.rig_orientation import load_orientation, orientation_path, save_orientation
from ..jobs.orientation import OrientationOutcome, orient
from ..jobs.result_folder import belongs_to
from ..photogrammetry import rig_orientation
from .messages.rig_orientation import message_from_orientation
from .runtime.lifecycle import StreamNode
from .runtime.parameters import check_timeout
from .runtime.qos import latched_qos, services_qos


@dataclass(frozen=True)
class CaptureSettings:
    """What a capture needs besides its frames.

    Attributes
    ----------
    names : sequence of str
        Fluoroscopes of the rig.
    phantom : Phantom or None
        Without one nothing can be captured.
    rig_frame : str
        Name of the rig frame.
    timeout_s : float
        Longest wait where a request leaves it open.
    directory : Path
        Where orientations are saved.
    """

    names: Sequence[str]
    phantom: Phantom | None
    rig_frame: str
    timeout_s: float
    directory: Path


class _Capture:
    """Collects frames of the phantom in the rig frame until there are enough, or too late."""

    def __init__(self, names: Sequence[str], count: int) -> None:
        self.frames: dict[str, list[Frame]] = {name: [] for name in names}
        self.done = Future()  # of whether there are enough
        self._count = count
        self._lock = threading.Lock()

    def add(self, pair: Mapping[str, Frame]) -> bool:
        """Add a frame of every fluoroscope; returns whether there are enough."""
        for name, frame in pair.items():
            self.frames[name].append(frame)
        if len(self.frames[frame.fluoroscope]) == self._count:
            self.finish(True)
        return self.done.done()

    def finish(self, is_complete: bool) -> None:
        """End the capture, unless it has ended: frames and timeout come from two threads."""
        with self._lock:
            if not self.done.done():
                self.done.set_result(is_complete)


class OrientationService:
    """The service orient of a node, and the orientation published on rig_orientation.

    Parameters
    ----------
    node : StreamNode
    settings : callable
        Returns the present CaptureSettings.
    calibrations : callable
        Returns the present calibrations by fluoroscope.
    request : callable
        Returns a context manager that is entered while a request is being answered.
    group : CallbackGroup
        Callback group of the service.
    """

    def __init__(
        self,
        node: StreamNode,
        settings: Callable[[], CaptureSettings],
        calibrations: Callable[[], Mapping[str, FluoroscopeCalibration]],
        request: Callable[[], AbstractContextManager[None]],
        group: CallbackGroup,
    ) -> None:
        self._node = node
        self._present_settings = settings
        self._calibrations = calibrations
        self._request = request
        self._capture: _Capture | None = None
        self._present: rig_orientation.RigOrientation | None = None
        self._output = node.create_publisher(RigOrientation, 'rig_orientation', latched_qos())
        self._service = node.create_service(
            Orient, 'orient', self._on_orient, qos_profile=services_qos(), callback_group=group
        )

    @property
    def present(self) -> rig_orientation.RigOrientation | None:
        """The orientation in use."""
        return self._present

    def close(self) -> None:
        """Destroy service and publisher."""
        self._node.destroy_service(self._service)
        self._node.destroy_publisher(self._output)

    def add(self, pair: Mapping[str, Frame]) -> None:
        """Give frames of the phantom to the capture that waits for them, if any.

        Called in the thread of the streams.
        """
        capture = self._capture
        if capture is not None and capture.add(pair):
            self._capture = None
            self._wake()

    def publish(self, orientation: rig_orientation.RigOrientation | None) -> None:
        """Use an orientation and publish it; None: there is no new one."""
        if orientation is not None:
            self._present = orientation
            self._output.publish(message_from_orientation(orientation))

    def clear(self) -> None:
        """Forget the orientation in use: it no longer belongs to the calibrations."""
        self._present = None

    def load(
        self, directory: Path, calibrations: Mapping[str, FluoroscopeCalibration]
    ) -> rig_orientation.RigOrientation | None:
        """Return the orientation in a folder if it belongs to the calibrations.

        Raises DataError for a damaged file.
        """
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

    async def _on_orient(
        self, request: Orient.Request, response: Orient.Response
    ) -> Orient.Response:
        """Orient the rig from the next frames of the phantom."""
        settings = self._present_settings()
        try:
            with self._request():
                outcome = await self._orient(request, settings)
            orientation = outcome.orientation
            save_orientation(settings.directory, orientation)
        except (DataError, ValueError, OSError) as error:
            response.message = f'the orientation of the rig is unchanged: {error}'
            self._node.get_logger().error(response.message)
            return response
        self.publish(orientation)
        response.success = True
        response.orientation_id = orientation.orientation_id
        response.message = (
            f'{", ".join(orientation.fluoroscopes)} oriented in frame {orientation.frame_id} from '
            f'{orientation.exposures} captures of the phantom, standard deviation of the sources '
            f'{orientation.sd_mm.max():.2f} mm or less'
        )
        response.message = '; '.join([response.message, *outcome.notes])
        if outcome.notes:
            self._node.get_logger().warning(response.message)
        else:
            self._node.get_logger().info(response.message)
        return response

    async def _orient(
        self, request: Orient.Request, settings: CaptureSettings
    ) -> OrientationOutcome:
        """Capture frames and orient the rig. Raises DataError and ValueError."""
        names = settings.names
        phantom = settings.phantom
        if phantom is None:
            raise DataError(
                'parameter phantom is not set: the node only serves saved calibrations'
            )
        timeout = request.timeout_sec or settings.timeout_s
        check_timeout(timeout)
        if not self._node.readers:
            raise DataError('the node is not active, so no frames come in')
        missing = [name for name in names if name not in self._calibrations()]
        if missing:
            raise DataError(f'fluoroscope {missing[0]} is not calibrated yet')
        frames = await self._captured(names, request.frames or 1, timeout)
        calibrations = dict(self._calibrations())
        outcome = await self._in_thread(
            lambda: orient(
                frames, phantom, calibrations, settings.rig_frame, present=self._present
            )
        )
        if not belongs_to(outcome.orientation, self._calibrations()):
            raise DataError('the calibrations have changed meanwhile, capture the phantom again')
        return outcome

    async def _captured(
        self, names: Sequence[str], count: int, timeout: float
    ) -> dict[str, list[Frame]]:
        """Return the next frames of all fluoroscopes. Raises DataError when the time is up."""
        if self._capture is not None:
            raise DataError('another capture is waiting for its frames')
        capture = self._capture = _Capture(names, count)
        timer = self._node.create_timer(
            timeout,
            lambda: capture.finish(False),
            clock=Clock(clock_type=ClockType.STEADY_TIME),
        )
        is_complete = await capture.done
        self._node.destroy_timer(timer)
        if not is_complete:
            self._capture = None
            raise DataError(
                f'{len(capture.frames[names[0]])} of {count} frames of all fluoroscopes '
                f'({", ".join(names)}) came within {timeout:g} s'
            )
        return capture.frames

    def _in_thread(self, function: Callable[[], Any]) -> Future:
        """Return the Future of the result of a function that runs in a thread of its own."""
        done = Future()

        def work() -> None:
            try:
                done.set_result(function())
            except Exception as error:
                done.set_exception(error)
            self._wake()

        threading.Thread(target=work, daemon=True).start()
        return done

    def _wake(self) -> None:
        """Make the executor continue what awaits a result."""
        if self._node.executor is not None:
            self._node.executor.wake()
