# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Services of a calibration node: capture and reset exposures, orient the rig, self-calibrate."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

from fluoro_calib_msgs.action import SelfCalibrate
from fluoro_calib_msgs.srv import Calibrate, Capture, Orient, Reset
from rclpy.action import ActionServer, CancelResponse, GoalResponse
from rclpy.callback_groups import CallbackGroup
from rclpy.parameter import Parameter
from rclpy.task import Future

from ..checks.check import Validation
from ..errors import DataError
from ..estimation.options import CalibrationRequest
from ..estimation.rounds import Round
from ..exposures.frame import Frame
from ..findings import Severity, sentences
from ..io.calibration import save_orientation
from ..jobs.calibration import CalibrationOutcome, Rig, run_in_worker_process
from ..jobs.orientation import OrientationOutcome, orient
from ..jobs.result_folder import belongs_to, check_result_folder
from .calibration_output import CalibrationOutput
from .calibration_settings import CalibrationFiles, RigSetup
from .exposure_input import ExposureInput
from .messages.self_calibration import (
    Request,
    Result,
    fill_feedback,
    fill_result,
    fill_verdict,
    options_of_request,
)
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


class Cancelled(Exception):
    """The running job has to stop."""


class SelfCalibration:
    """Runs one self-calibration at a time, in a process of its own."""

    def __init__(
        self,
        node: StreamNode,
        rig: RigSetup,
        exposures: ExposureInput,
        output: CalibrationOutput,
        files: CalibrationFiles,
        requests: Requests,
    ) -> None:
        self.running: tuple[str, ...] = ()  #: fluoroscopes of the running job
        self.last_round: dict[str, Round] = {}  #: of the running or last job, by fluoroscope
        self._node = node
        self._rig = rig
        self._exposures = exposures
        self._output = output
        self._files = files
        self._requests = requests
        self._logger = node.get_logger()
        self._stopping = threading.Event()
        self._thread: threading.Thread | None = None  # waits for the process of the job
        self.services = (ServiceEntry('calibrate', Calibrate, self._on_calibrate),)

    def create_action(self, group: CallbackGroup) -> ActionServer:
        """Return the action server."""
        return ActionServer(
            self._node,
            SelfCalibrate,
            'self_calibrate',
            self._on_action,
            goal_callback=lambda _: GoalResponse.ACCEPT,
            cancel_callback=lambda _: CancelResponse.ACCEPT,
            callback_group=group,
        )

    def stop(self) -> None:
        """Cancel the running job, and those that are still to come."""
        self._stopping.set()

    def end(self) -> None:
        """Cancel the running job, and wait for its end."""
        self.stop()
        if self._thread is not None:
            self._thread.join()

    async def _on_calibrate(
        self, request: Calibrate.Request, response: Calibrate.Response
    ) -> Calibrate.Response:
        with self._requests.one():
            await self._answer(request, response, lambda *_: None, lambda: False)
        return response

    async def _on_action(self, goal: Any) -> SelfCalibrate.Result:
        result = SelfCalibrate.Result()
        feedback = SelfCalibrate.Feedback()

        def progress(label: str, last: Round) -> None:
            fill_feedback(feedback, label, last)
            goal.publish_feedback(feedback)

        with self._requests.one():
            cancelled = await self._answer(
                goal.request, result, progress, lambda: goal.is_cancel_requested
            )
        if result.success:
            goal.succeed()
        elif cancelled:
            goal.canceled()
        else:
            goal.abort()
        return result

    async def _answer(
        self,
        request: Request,
        result: Result,
        progress: Callable[[str, Round], None],
        is_cancel_requested: Callable[[], bool],
    ) -> bool:
        """Run a calibration and fill in the result; returns whether it was cancelled.

        Without success nothing is changed.
        """
        if self._thread is not None:
            result.message = 'refused: a self-calibration is already running'
            self._logger.warning(result.message)
            return False
        try:
            outcome = await self._start(request, progress, is_cancel_requested)
            self._use(outcome, result)
        except Cancelled:
            result.message = 'cancelled, nothing was changed'
            self._logger.info(result.message)
            return True
        except (DataError, ValueError, OSError) as error:
            result.message = str(error)
            self._logger.error(result.message)
            self._output.refused.update(dict.fromkeys(self.running, result.message))
        except Exception as error:  # a bug must reach the caller, and must not end the node
            result.message = f'the self-calibration failed unexpectedly: {error}'
            self._logger.error(result.message)
        finally:
            self.running = ()
            self._thread = None
        return False

    def _start(
        self,
        request: Request,
        progress: Callable[[str, Round], None],
        is_cancel_requested: Callable[[], bool],
    ) -> Future:
        """Start a calibration in a worker process; returns the Future of its CalibrationOutcome.

        Raises DataError and ValueError, also where the outcome could not be saved.
        """
        check_result_folder(self._rig.directory)
        job, rig = self._job_of(request)

        def on_round(label: str, last: Round) -> None:
            self.last_round.update(dict.fromkeys(label.split('+'), last))
            progress(label, last)

        def raise_if_cancelled() -> None:
            if is_cancel_requested() or self._stopping.is_set():
                raise Cancelled

        def run() -> CalibrationOutcome:
            return run_in_worker_process(
                job,
                validate=request.validate,
                rig=rig,
                progress=on_round,
                raise_if_cancelled=raise_if_cancelled,
            )

        self.running = tuple(job.frames)
        done, self._thread = in_thread(self._node, run)
        return done

    def _job_of(self, request: Request) -> tuple[CalibrationRequest, Rig]:
        """Return the job of a request, and the fluoroscopes that it leaves as they are.

        Raises DataError and ValueError.
        """
        settings = self._rig.settings()
        frames = self._exposures.frames(request.fluoroscopes)
        joint = settings.node.joint and len(frames) > 1
        job = CalibrationRequest(
            frames,
            self._rig.required_phantom(),
            options_of_request(request, settings.calibration, joint),
            joint=joint,
            principal_distance=request.principal_distance or None,
            names=self._rig.target_names,
        )
        others = {n: c for n, c in self._output.calibrations.items() if n not in frames}
        all_frames = self._exposures.frames()
        rig = Rig(self._rig.names, {name: all_frames[name] for name in others}, others)
        return job, rig

    def _use(self, outcome: CalibrationOutcome, result: Result) -> None:
        """Save and publish the outcome of a job, and fill in the result. Raises DataError."""
        calibrations = {
            name: replace(calibration, seconds=outcome.result.seconds)
            for name, calibration in outcome.result.calibrations.items()
        }
        orientation, fault = self._files.save_outcome(outcome)
        if orientation is None:
            self._output.orientation = None
        self._output.publish(calibrations, orientation)
        fill_result(result, outcome.result, calibrations)
        self._output.save_fault = fault
        if fault:
            result.message = f'{result.message}; {fault}'
            self._logger.error(fault)
        for found in outcome.result.findings:
            begin = 'not used: ' if found.severity is Severity.NOTE else ''
            self._logger.warning(f'{begin}{found}')
        self._logger.info(result.message)
        if outcome.validation is not None:
            fill_verdict(result, outcome.validation)
            self._log_verdict(outcome.validation)

    def _log_verdict(self, validation: Validation) -> None:
        self._logger.info(f'verdict: {validation.verdict} ({validation.seconds:.1f} s)')
        for found in validation.findings:
            self._logger.warning(found.sentence)
