# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The self-calibration of a calibration node: a service and an action, and the job behind them."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import replace
from typing import Any

from fluoro_calib_msgs.action import SelfCalibrate
from fluoro_calib_msgs.srv import Calibrate
from rclpy.action import ActionServer, CancelResponse, GoalResponse
from rclpy.callback_groups import CallbackGroup
from rclpy.task import Future

from ..checks.check import Validation
from ..errors import DataError
from ..estimation.options import CalibrationRequest
from ..estimation.rounds import Round
from ..findings import Severity
from ..jobs.calibration import CalibrationOutcome, Rig, run_in_worker_process
from ..jobs.result_folder import check_result_folder
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
from .runtime.lifecycle import Requests, ServiceEntry, StreamNode, in_thread


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
