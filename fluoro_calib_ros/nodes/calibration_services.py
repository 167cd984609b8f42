# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Services of a calibration node: capture and reset exposures, orient the rig."""

from __future__ import annotations

import threading
from collections.abc import Mapping, Sequence

from fluoro_calib_msgs.srv import Capture, Orient, Reset
from rclpy.parameter import Parameter
from rclpy.task import Future

from ..errors import DataError
from ..exposures.frame import Frame
from ..findings import sentences
from ..io.calibration import save_orientation
from ..jobs.orientation import OrientationOutcome, orient
from ..jobs.result_folder import belongs_to
from .calibration_output import CalibrationOutput
from .calibration_settings import RigSetup
from .exposure_input import ExposureInput
from .runtime.lifecycle import Requests, ServiceEntry, StreamNode, in_thread, wake, within
from .runtime.parameters import check_timeout


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
    """The service orient, which orients the rig from the next frames of the phantom."""

    def __init__(
        self, node: StreamNode, rig: RigSetup, output: CalibrationOutput, requests: Requests
    ) -> None:
        self._node = node
        self._rig = rig
        self._output = output
        self._requests = requests
        self._capture: _Capture | None = None
        self.services = (ServiceEntry('orient', Orient, self._on_orient),)

    def add(self, pair: Mapping[str, Frame]) -> None:
        """Give frames of the phantom to the capture that waits for them, if any.

        Called in the thread of the streams.
        """
        capture = self._capture
        if capture is not None and capture.add(pair):
            self._capture = None
            wake(self._node)

    async def _on_orient(
        self, request: Orient.Request, response: Orient.Response
    ) -> Orient.Response:
        """Orient the rig, save the orientation and publish it."""
        logger = self._node.get_logger()
        try:
            with self._requests.one():
                outcome = await self._orient(request)
            orientation = outcome.orientation
            save_orientation(self._rig.directory, orientation)
        except (DataError, ValueError, OSError) as error:
            response.message = f'the orientation of the rig is unchanged: {error}'
            logger.error(response.message)
            return response
        self._output.publish_orientation(orientation)
        response.success = True
        response.orientation_id = orientation.orientation_id
        response.message = (
            f'{", ".join(orientation.fluoroscopes)} oriented in frame {orientation.frame_id} from '
            f'{orientation.exposures} captures of the phantom, standard deviation of the sources '
            f'{orientation.sd_mm.max():.2f} mm or less'
        )
        response.message = '; '.join([response.message, *sentences(outcome.findings)])
        if outcome.findings:
            logger.warning(response.message)
        else:
            logger.info(response.message)
        return response

    async def _orient(self, request: Orient.Request) -> OrientationOutcome:
        """Capture frames and orient the rig. Raises DataError and ValueError."""
        names = self._rig.names
        phantom = self._rig.required_phantom()
        settings = self._rig.settings().node
        timeout = request.timeout_sec or settings.capture_timeout
        check_timeout(timeout)
        if not self._node.readers:
            raise DataError(NOT_ACTIVE)
        missing = [name for name in names if name not in self._output.calibrations]
        if missing:
            raise DataError(f'fluoroscope {missing[0]} is not calibrated yet')
        frames = await self._captured(names, request.frames or 1, timeout)
        calibrations = self._output.calibrations
        present = self._output.orientation
        oriented, _ = in_thread(
            self._node,
            lambda: orient(frames, phantom, calibrations, settings.rig_frame, present=present),
        )
        outcome = await oriented
        if not belongs_to(outcome.orientation, self._output.calibrations):
            raise DataError('the calibrations have changed meanwhile, capture the phantom again')
        return outcome

    async def _captured(
        self, names: Sequence[str], count: int, timeout_s: float
    ) -> dict[str, list[Frame]]:
        """Return the next frames of all fluoroscopes. Raises DataError when the time is up."""
        if self._capture is not None:
            raise DataError('another capture is waiting for its frames')
        capture = self._capture = _Capture(names, count)
        if await within(self._node, timeout_s, capture.done, lambda: capture.finish(False)):
            return capture.frames
        self._capture = None
        raise DataError(
            f'{len(capture.frames[names[0]])} of {count} frames of all fluoroscopes '
            f'({", ".join(names)}) came within {timeout_s:g} s'
        )


NOT_ACTIVE = 'the node is not active, so no frames come in'


class CollectServices:
    """The services capture, reset and collect_anew."""

    def __init__(
        self,
        node: StreamNode,
        rig: RigSetup,
        exposures: ExposureInput,
        output: CalibrationOutput,
        requests: Requests,
    ) -> None:
        self._node = node
        self._rig = rig
        self._exposures = exposures
        self._output = output
        self._requests = requests
        self.services = (
            ServiceEntry('capture', Capture, self._on_capture),
            ServiceEntry('reset', Reset, self._on_reset),
            ServiceEntry('collect_anew', Reset, self._on_collect_anew),
        )

    async def _on_capture(
        self, request: Capture.Request, response: Capture.Response
    ) -> Capture.Response:
        timeout = request.timeout_sec or self._rig.settings().node.capture_timeout
        try:
            self._check(timeout)
        except ValueError as error:  # DataError among them
            response.message = str(error)
            return response
        captured = self._exposures.capture()
        with self._requests.one():
            found = await within(
                self._node, timeout, captured, lambda: self._exposures.give_up(captured)
            )
        response.success = found is not None
        if found is not None:
            number, response.exposures = found
            response.message = f'frame {number} captured, {response.exposures} exposures now'
        else:
            names = self._rig.names
            streams = self._exposures.streams.values()
            received = ', '.join(f'{stream.name} {stream.received}' for stream in streams)
            response.exposures = self._exposures.collected(names[0]).exposures
            response.message = self._exposures.capture_refusal or (
                f'no frame of all fluoroscopes ({", ".join(names)}) came within {timeout:g} s; '
                f'frames received: {received}'
            )
        return response

    def _check(self, timeout_s: float) -> None:
        """Raise ValueError, DataError among them, where nothing can be captured."""
        self._rig.required_phantom()
        check_timeout(timeout_s)
        if not self._node.readers:
            raise DataError(NOT_ACTIVE)
        waiting = self._requests.waiting
        if waiting >= self._rig.settings().limits.max_waiting:
            raise DataError(
                f'{waiting} requests wait for their answers, as many as max_waiting allows'
            )

    def _on_reset(self, _: Reset.Request, response: Reset.Response) -> Reset.Response:
        count = self._exposures.reset()
        self._output.refused.clear()
        response.success = True
        response.message = f'{count} exposures discarded, the calibration stays in use'
        return response

    def _on_collect_anew(self, request: Reset.Request, response: Reset.Response) -> Reset.Response:
        self._node.set_parameters([Parameter('collect', value='still')])
        self._on_reset(request, response)
        response.message += (
            '; new exposures are collected whenever the phantom stands still in a new pose'
        )
        self._node.get_logger().info(response.message)
        return response
