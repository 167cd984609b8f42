# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Job of a calibration node: self-calibrate the fluoroscopes."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Coroutine
from dataclasses import replace
from functools import partial
from typing import Any

from fluoro_calib_msgs.action import SelfCalibrate
from fluoro_calib_msgs.srv import Calibrate
from rclpy.action import ActionServer, CancelResponse, GoalResponse
from rclpy.callback_groups import CallbackGroup
from rclpy.task import Future

from ..errors import DataError
from ..estimation.options import CalibrationRequest
from ..estimation.rounds import Round
from ..findings import Severity
from ..io.calibration import Verdict
from ..io.folder import check_output_folder
from ..jobs.calibration import CalibrationOutcome, Rig, run_in_worker_process
from ..jobs.result_folder import RESULT_FOLDER
from ..processes import in_worker_process
from .capture_services import NodeParts, RigServices
from .messages.self_calibration import (
    Request,
    Result,
    feedback_of_round,
    fill_result,
    fill_verdict,
    options_of_request,
)
from .runtime.services import Cancelled, ServiceEntry


class Job(RigServices, ABC):
    """Runs one job of an action at a time, in a separate process."""

    kind: Any  #: type of the action
    action: str  #: name of the action
    title: str  #: kind of job, for messages

    def __init__(self, parts: NodeParts) -> None:
        super().__init__(parts)
        self._is_running = False

    def create_action(self, group: CallbackGroup) -> ActionServer:
        """Return the action server."""
        return ActionServer(
            self._node,
            self.kind,
            self.action,
            self._on_action,
            goal_callback=lambda _: GoalResponse.ACCEPT,
            cancel_callback=self._on_cancel,
            callback_group=group,
        )

    @abstractmethod
    async def _work(self, goal: Any, result: Any) -> None:
        """Run the job of a goal and fill in the result. Raises DataError and Cancelled."""

    def _on_cancel(self, _: Any) -> CancelResponse:
        return CancelResponse.ACCEPT

    async def _on_action(self, goal: Any) -> Any:
        result = self.kind.Result()
        if await self._answer(result, self._work(goal, result)):
            goal.succeed()
        elif goal.is_cancel_requested:
            goal.canceled()
        else:  # also if the node ends
            goal.abort()
        return result

    async def _answer(self, result: Any, work: Coroutine[Any, Any, None]) -> bool:
        """Await the work and return whether it succeeded; if not, state the reason in the result.

        Without success nothing is changed.
        """
        if self._is_running:
            work.close()
            result.message = f'refused: a {self.title} is already running'
            self._logger.warning(result.message)
            return False
        self._is_running = True
        try:
            with self._requests.one():
                await work
        except Cancelled:
            result.message = 'cancelled, nothing was changed'
            self._logger.info(result.message)
        except (DataError, ValueError, OSError) as error:
            result.message = str(error)
            self._logger.error(result.message)
        except Exception as error:  # a bug must reach the caller, and must not end the node
            result.message = f'the {self.title} failed unexpectedly: {error}'
            self._logger.error(result.message)
        else:
            return True
        finally:
            self._is_running = False
            self._thread = None
        return False


class SelfCalibration(Job):
    """The action self_calibrate, and the service calibrate."""

    kind = SelfCalibrate
    action = 'self_calibrate'
    title = 'self-calibration'

    def __init__(self, parts: NodeParts) -> None:
        super().__init__(parts)
        self.running: tuple[str, ...] = ()  #: fluoroscopes of the running job
        self.last_round: dict[str, Round] = {}  #: of the running or last job, by fluoroscope
        self.services = (ServiceEntry('calibrate', Calibrate, self._on_calibrate),)

    async def _on_calibrate(
        self, request: Calibrate.Request, response: Calibrate.Response
    ) -> Calibrate.Response:
        work = self._calibrate(request, response, lambda _: None, lambda: False)
        await self._answer(response, work)
        return response

    async def _work(self, goal: Any, result: Any) -> None:
        await self._calibrate(
            goal.request, result, goal.publish_feedback, lambda: goal.is_cancel_requested
        )

    async def _calibrate(
        self,
        request: Request,
        result: Result,
        publish: Callable[[SelfCalibrate.Feedback], None],
        is_cancel_requested: Callable[[], bool],
    ) -> None:
        try:
            outcome = await self._start_job(request, publish, is_cancel_requested)
            self._use(outcome, result)
            if request.validate and not self._output.save_fault:
                await self._write_report()
        except Cancelled:
            raise
        except Exception as error:  # also if the process was killed
            self._output.refused.update(dict.fromkeys(self.running, str(error)))
            raise
        finally:
            self.running = ()

    def _start_job(
        self,
        request: Request,
        publish: Callable[[SelfCalibrate.Feedback], None],
        is_cancel_requested: Callable[[], bool],
    ) -> Future:
        """Start a calibration in a worker process; return the Future of its CalibrationOutcome.

        Raises DataError and ValueError, also if the outcome could not be saved.
        """
        job, rig = self._job_of(request)
        self.running = tuple(job.frames)
        check_output_folder(self._rig.directory, RESULT_FOLDER)

        def on_round(label: str, last: Round) -> None:
            self.last_round.update(dict.fromkeys(label.split('+'), last))
            publish(feedback_of_round(label, last))

        work = partial(
            run_in_worker_process,
            job,
            validate=request.validate,
            rig=rig,
            progress=on_round,
            report_step=lambda stage, step, steps: publish(
                SelfCalibrate.Feedback(stage=stage, step=step, steps=steps)
            ),
        )
        return self._start(work, is_cancel_requested)

    async def _write_report(self) -> None:
        """Write the report of the saved calibration; a failure is only logged."""
        write = 'jobs.report:write_report'  # imports matplotlib
        work = partial(in_worker_process, write, self._rig.directory)
        try:
            self._logger.info(f'report: {await self._start(work)}')
        except Cancelled:
            self._logger.info('the node ends: no report of the calibration is written')
        except (DataError, ValueError, OSError, RuntimeError) as error:
            self._logger.warning(f'no report of the calibration: {error}')

    def _job_of(self, request: Request) -> tuple[CalibrationRequest, Rig]:
        """Return the job of a request, and the rig of the fluoroscopes that it leaves unchanged.

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
        unchanged = {n: c for n, c in self._output.calibrations.items() if n not in frames}
        all_frames = self._exposures.frames()
        rig = Rig(self._rig.names, {name: all_frames[name] for name in unchanged}, unchanged)
        return job, rig

    def _use(self, outcome: CalibrationOutcome, result: Result) -> None:
        """Save and publish the outcome of a job, and fill in the result. Raises DataError."""
        calibrations = {
            name: replace(calibration, seconds=outcome.result.seconds)
            for name, calibration in outcome.result.calibrations.items()
        }
        radiographs = self._exposures.radiographs(outcome.request.frames)
        orientation, fault = self._files.save_outcome(outcome, radiographs)
        if orientation is None:
            self._output.orientation = None
        validation = outcome.validation
        verdict = None
        if validation is not None:
            found = tuple(finding.sentence for finding in validation.findings)
            verdict = Verdict(validation.verdict, found, validation.calibration_id)
        self._output.publish(calibrations, orientation, verdict)
        fill_result(result, outcome.result, calibrations)
        self._output.save_fault = fault
        if fault:
            result.message = f'{result.message}; {fault}'
            self._logger.error(fault)
        for finding in outcome.result.findings:
            prefix = 'not used: ' if finding.severity is Severity.NOTE else ''
            self._logger.warning(f'{prefix}{finding}')
        self._logger.info(result.message)
        if validation is not None:
            fill_verdict(result, validation)
            self._logger.info(f'verdict: {validation.verdict} ({validation.seconds:.1f} s)')
            for finding in validation.findings:
                self._logger.warning(finding.sentence)
