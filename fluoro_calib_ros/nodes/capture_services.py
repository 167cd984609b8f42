# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Services of a calibration node for its exposures: capture, reset, and orient the rig."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from fluoro_calib_msgs.srv import Capture, Orient, Reset
from rclpy.parameter import Parameter

from ..errors import DataError
from ..exposures.frame import Frame
from ..findings import sentences
from ..io.calibration import save_orientation
from ..jobs.orientation import OrientationOutcome, orient
from ..jobs.result_folder import belongs_to
from .calibration_output import CalibrationOutput
from .calibration_settings import CalibrationFiles, RigSetup
from .exposure_input import ExposureInput, captured_frames
from .runtime.lifecycle import StreamNode
from .runtime.services import (
    Requests,
    ServiceEntry,
    Worker,
    check_timeout,
    in_thread,
    telling_service,
    within,
)


@dataclass(frozen=True)
class NodeParts:
    """Parts of a calibration node that its services use."""

    node: StreamNode
    rig: RigSetup
    exposures: ExposureInput
    output: CalibrationOutput
    files: CalibrationFiles
    requests: Requests


class RigServices(Worker):
    """Services of a calibration node, listed in `services`."""

    services: tuple[ServiceEntry, ...]

    def __init__(self, parts: NodeParts) -> None:
        super().__init__(parts.node)
        self._node, self._rig, self._exposures = parts.node, parts.rig, parts.exposures
        self._output, self._files, self._requests = parts.output, parts.files, parts.requests
        self._logger = parts.node.get_logger()


class CollectServices(RigServices):
    """The services capture, reset and collect_anew."""

    def __init__(self, parts: NodeParts) -> None:
        super().__init__(parts)
        self.services = (
            ServiceEntry('capture', Capture, self._on_capture),
            telling_service('reset', Reset, 'not reset', self._reset, self._logger),
            telling_service('collect_anew', Reset, 'not reset', self._anew, self._logger),
        )

    async def _on_capture(
        self, request: Capture.Request, response: Capture.Response
    ) -> Capture.Response:
        timeout = request.timeout_sec or self._rig.settings().node.capture_timeout
        try:
            self._check(timeout)
        except ValueError as error:  # including DataError
            response.message = str(error)
            return response
        wait = self._exposures.next_pairs(collected=True)
        with self._requests.one():
            await within(self._node, timeout, wait.done, lambda: self._exposures.give_up(wait))
        names = self._rig.names
        response.success = bool(wait.pairs)
        response.exposures = wait.exposures
        if wait.pairs:
            response.message = (
                f'{captured_frames(wait, names)} captured, {response.exposures} exposures now'
            )
        else:
            response.exposures = self._exposures.collected(names[0]).status.exposures
            streams = self._exposures.streams.values()
            received = ', '.join(f'{stream.name} {stream.received}' for stream in streams)
            response.message = self._exposures.capture_refusal or (
                f'no frame of all fluoroscopes ({", ".join(names)}) came within {timeout:g} s; '
                f'frames received: {received}'
            )
        return response

    def _check(self, timeout_s: float) -> None:
        """Raise ValueError (including DataError) if nothing can be captured."""
        self._rig.required_phantom()
        check_timeout(timeout_s)
        self._node.check_active()
        waiting = self._requests.waiting
        if waiting >= self._rig.settings().limits.max_waiting:
            raise DataError(
                f'{waiting} requests wait for their answers, as many as max_waiting allows'
            )

    def _reset(self, _: Reset.Request) -> str:
        count = self._exposures.reset()
        self._output.refused.clear()
        return f'{count} exposures discarded, the calibration stays in use'

    def _anew(self, request: Reset.Request) -> str:
        self._node.set_parameters([Parameter('collect', value='still')])
        return (
            f'{self._reset(request)}; new exposures are collected whenever the phantom stands '
            'still in a new pose'
        )


class OrientationService(RigServices):
    """The service orient, which orients the rig from the next frames of the phantom."""

    def __init__(self, parts: NodeParts) -> None:
        super().__init__(parts)
        self._is_capturing = False
        self.services = (ServiceEntry('orient', Orient, self._on_orient),)

    async def _on_orient(
        self, request: Orient.Request, response: Orient.Response
    ) -> Orient.Response:
        """Orient the rig, save the orientation and publish it."""
        try:
            with self._requests.one():
                outcome = await self._orient(request)
            orientation = outcome.orientation
            save_orientation(self._rig.directory, orientation)
        except (DataError, ValueError, OSError) as error:
            response.message = f'the orientation of the rig is unchanged: {error}'
            self._logger.error(response.message)
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
            self._logger.warning(response.message)
        else:
            self._logger.info(response.message)
        return response

    async def _orient(self, request: Orient.Request) -> OrientationOutcome:
        """Capture frames and orient the rig. Raises DataError and ValueError."""
        names = self._rig.names
        phantom = self._rig.required_phantom()
        settings = self._rig.settings().node
        timeout = request.timeout_sec or settings.capture_timeout
        check_timeout(timeout)
        most = self._rig.settings().limits.max_exposures
        if request.frames > most:
            raise DataError(f'frames must be at most {most} (max_exposures), not {request.frames}')
        self._node.check_active()
        self._output.all_calibrations()
        frames = await self._captured(names, request.frames or 1, timeout)
        calibrations = self._output.calibrations
        present_orientation = self._output.orientation
        future, _ = in_thread(
            self._node,
            lambda: orient(
                frames, phantom, calibrations, settings.rig_frame, present=present_orientation
            ),
        )
        outcome = await future
        if not belongs_to(outcome.orientation, self._output.calibrations):
            raise DataError('the calibrations have changed meanwhile, capture the phantom again')
        return outcome

    async def _captured(
        self, names: Sequence[str], count: int, timeout_s: float
    ) -> dict[str, list[Frame]]:
        """Return the next frames of all fluoroscopes. Raises DataError if time runs out."""
        if self._is_capturing:
            raise DataError('another capture is waiting for its frames')
        self._is_capturing = True
        wait = self._exposures.next_pairs(count)
        try:
            await within(self._node, timeout_s, wait.done, lambda: self._exposures.give_up(wait))
        finally:
            self._is_capturing = False
        if len(wait.pairs) == count:
            return {name: [pair[name] for pair in wait.pairs] for name in names}
        raise DataError(
            f'{len(wait.pairs)} of {count} frames of all fluoroscopes ({", ".join(names)}) came '
            f'within {timeout_s:g} s'
        )
