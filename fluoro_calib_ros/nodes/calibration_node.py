# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Node that collects exposures of the phantom and self-calibrates the fluoroscopes on request.

A thread of its own receives the frames. Another one runs all other callbacks: those that take long
(calibrate, capture) are coroutines that await what they need, and the calibration itself is a
process of its own. rclpy's MultiThreadedExecutor is no alternative: it schedules a callback again
and again until it has started, which on a busy machine costs so much time that frames are lost.
"""

from __future__ import annotations

import itertools
import os
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from fluoro_calib_msgs.action import SelfCalibrate
from fluoro_calib_msgs.msg import CalibrationStatus, FluoroscopeCalibration, TargetObservations
from fluoro_calib_msgs.srv import Calibrate, Capture, LoadCalibration, Reset, SaveCalibration
from rclpy.action import ActionServer, CancelResponse, GoalResponse
from rclpy.callback_groups import CallbackGroup, ReentrantCallbackGroup
from rclpy.clock import Clock, ClockType
from rclpy.lifecycle import TransitionCallbackReturn
from rclpy.lifecycle.node import LifecycleState
from rclpy.parameter import Parameter
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile
from rclpy.task import Future
from sensor_msgs.msg import Image

from ..calibration import result as calibration_result
from ..calibration.options import CalibrationOptions
from ..calibration.request import CalibrationRequest
from ..calibration.rounds import Round
from ..errors import DataError, printable
from ..exposures.angles import AngleOptions
from ..exposures.collector import StillOptions
from ..exposures.frame import Frame
from ..exposures.names import Names
from ..exposures.pairing import PairingOptions
from ..exposures.phantom import Phantom
from ..files.calibration import SUFFIX, load_calibrations
from ..files.calibration_request import PHANTOM as PHANTOM_FILE
from ..files.phantom import read_phantom
from ..files.result_check import disagreements
from ..images.coverage_picture import coverage_picture
from ..jobs.calibration import CalibrationOutcome, Rig
from ..jobs.result_folder import (
    check_result_folder,
    kept_orientation,
    save_calibrations,
    save_outcome,
)
from ..jobs.sources import read_survey
from ..jobs.worker_process import run_in_worker_process
from ..limits import CollectLimits
from ..options import option
from ..photogrammetry.rig_orientation import RigOrientation
from ..validation.check import Validation
from .angle_input import AngleInput
from .exposure_input import Collected, CollectOptions, ExposureInput
from .messages.calibration_status import FluoroscopeProgress, message_from_progress
from .messages.fields import NS_PER_S
from .messages.fluoroscope_calibration import message_from_calibration
from .messages.image import colour_message
from .messages.self_calibration import (
    Request,
    Result,
    fill_feedback,
    fill_result,
    fill_verdict,
    options_of_request,
)
from .messages.target_observations import ObservedFrame, decode_target_observations
from .orientation_service import CaptureSettings, OrientationService
from .runtime.diagnostics import ERROR, OK, WARN, Status
from .runtime.discovery import publisher_conflict
from .runtime.errors import StartError
from .runtime.lifecycle import StreamNode
from .runtime.main import run
from .runtime.parameters import (
    READ_LIMITS,
    ManagedParameters,
    ParameterGroup,
    check_timeout,
    declare_read_limits,
    default_calibration_directory,
    expand_path,
)
from .runtime.qos import latched_qos, observations_qos, services_qos
from .runtime.stream_reader import FaultHandlers

COLLECT_MODES = ('still', 'request')
OBSERVATIONS = 'target_observations'
NOT_ACTIVE = 'the node is not active, so no frames come in'


@dataclass(frozen=True)
class CalibrationParameters(ManagedParameters):
    """Parameters of the calibration node."""

    phantom: str = option(
        '',
        'file phantom.csv with the surveyed coordinates of the beads; without it the node only '
        'serves saved calibrations',
        unit='mm',
    )
    calibration_directory: str = option(
        '',
        'folder in which calibrations are saved, and from which they are loaded at the start; '
        'empty: fluoro_calib/<namespace> in $ROS_HOME or ~/.ros',
    )
    any_directory: bool = option(
        False,
        'whether save_calibration and load_calibration may name folders that are not below '
        'calibration_directory',
    )
    collect: str = option(
        'still',
        'when an exposure is collected: whenever the phantom stands still in a new pose, '
        'or on request by the service capture',
        choices=COLLECT_MODES,
    )
    joint: bool = option(False, 'whether all fluoroscopes are adjusted together')
    rig_frame: str = option(
        'rig', 'name of the rig frame, which is that of the phantom captured by orient'
    )
    capture_timeout: float = option(
        5.0,
        'longest wait of capture and orient where the request leaves it open',
        minimum=0.1,
        maximum=600.0,
        unit='s',
    )


_OF_REQUESTS = ('model', 'interior', 'loss', 'max_iterations', 'relative_orientation', 'datum')
_NODE = ParameterGroup(
    CalibrationParameters, settable=('collect', 'joint', 'rig_frame', 'capture_timeout')
)
_STILL = ParameterGroup(
    StillOptions,
    {'still_time_s': 'still_time', 'still_px': 'still_px', 'new_px': 'new_px'},
    settable=('still_time', 'still_px', 'new_px'),
)
_PAIRING = ParameterGroup(
    PairingOptions,
    {'pair_by': 'pair_by', 'tolerance_s': 'pair_tolerance'},
    settable=('pair_tolerance',),
)
_CALIBRATION = ParameterGroup(
    CalibrationOptions, {name: name for name in _OF_REQUESTS}, settable=_OF_REQUESTS
)
_ANGLES = ParameterGroup(AngleOptions)
_LIMITS = ParameterGroup(CollectLimits)
PARAMETERS = (_NODE, _STILL, _PAIRING, _CALIBRATION, _ANGLES, _LIMITS, READ_LIMITS)


class Cancelled(Exception):
    """The running job has to stop."""


class _Fluoroscope:
    """What the node knows of the calibration of one fluoroscope."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.last_round: Round | None = None
        self.calibration: calibration_result.FluoroscopeCalibration | None = None
        self.calibrated_at = float('nan')
        self.refused_calibration = ''  # why the last calibration was refused

    def use(self, calibration: calibration_result.FluoroscopeCalibration) -> None:
        """Use a calibration from now on."""
        self.refused_calibration = ''
        self.calibration = calibration
        self.calibrated_at = time.monotonic()


class CalibrationNode(StreamNode):
    """Collects exposures of the fluoroscopes, and runs one self-calibration at a time."""

    def __init__(self) -> None:
        super().__init__('calibration_node')
        declare_read_limits(self)
        self._settings = _NODE.declare(self)
        self._still = _STILL.declare(self)
        self._pairing = _PAIRING.declare(self)
        self._options = _CALIBRATION.declare(self)
        self._angle_options = _ANGLES.declare(self)
        self._limits = _LIMITS.declare(self)
        self.autostart = self._settings.autostart
        self._names = self._settings.fluoroscopes
        self._read_files()
        self._stopping = threading.Event()
        self._running: tuple[str, ...] = ()  # fluoroscopes of the running job
        self._job: threading.Thread | None = None  # waits for the worker process
        self._requests = 0  # that have not been answered yet
        self.reset()
        _NODE.follow(self, self._use_settings)
        _STILL.follow(self, self._use_still)
        _PAIRING.follow(self, self._use_pairing)
        _CALIBRATION.follow(self, self._use_calibration_options)

    def reset(self) -> None:
        """Forget calibrations and exposures, and start counting from zero."""
        self._fluoroscopes = {name: _Fluoroscope(name) for name in self._names}
        self._load_fault = ''
        self._save_fault = ''
        self._angles = AngleInput(self._angle_options, self._names, self.limited_logger)
        self._exposures = ExposureInput(
            self._names,
            self._phantom,
            self._collect_options(),
            self._on_pair,
            self._wake,
            self.get_logger(),
        )

    # -- parameters

    def _collect_options(self) -> CollectOptions:
        return CollectOptions(
            self._settings.collect, self._still, self._pairing, self._limits.max_exposures
        )

    def _capture_settings(self) -> CaptureSettings:
        return CaptureSettings(
            self._names,
            self._phantom,
            self._settings.rig_frame,
            self._settings.capture_timeout,
            self._directory,
        )

    def _use_settings(self, settings: CalibrationParameters) -> None:
        self._settings = settings
        self._exposures.use(self._collect_options())

    def _use_still(self, still: StillOptions) -> None:
        self._still = still
        self._exposures.use(self._collect_options())

    def _use_pairing(self, pairing: PairingOptions) -> None:
        self._pairing = pairing
        self._exposures.use(self._collect_options())

    def _use_calibration_options(self, options: CalibrationOptions) -> None:
        self._options = options

    def _read_files(self) -> None:
        """Read the phantom, if one is named. Raises StartError."""
        directory = self._settings.calibration_directory
        self._phantom: Phantom | None = None
        self._target_names = Names()
        try:
            self._directory = (
                expand_path(directory)
                if directory
                else default_calibration_directory(self.get_namespace())
            )
            if self._settings.phantom:
                self._read_phantom(expand_path(self._settings.phantom))
        except DataError as error:
            raise StartError(str(error)) from None
        if self._phantom is None and not any(self._directory.glob('*' + SUFFIX)):
            raise StartError(
                'parameter phantom is not set: it names the file phantom.csv, without which the '
                f'node only serves saved calibrations, and there are none in {self._directory}'
            )

    def _read_phantom(self, path: Path) -> None:
        """Read the phantom. Raises DataError."""
        survey = read_survey(path)
        for note in survey.notes:
            self.get_logger().warning(note)
        self._phantom = survey.phantom
        self._target_names = survey.names

    # -- lifecycle

    def create_outputs(self) -> None:
        """Make topics, services and action, and publish the saved calibrations."""
        self._stopping.clear()
        # The status first: by its publishers, receivers of calibrations recognise that two nodes
        # serve the same fluoroscope.
        self._status_outputs = self._create_publishers(CalibrationStatus, 'calibration_status', 10)
        self._calibration_outputs = self._create_publishers(
            FluoroscopeCalibration, 'calibration', latched_qos()
        )
        self._coverage_outputs = self._create_publishers(Image, 'coverage', latched_qos())
        # Services that await must not keep others from being answered.
        services = ReentrantCallbackGroup()
        self._orientation = OrientationService(
            self, self._capture_settings, self._calibrations, self._request, services
        )
        self.own(self._orientation, self._orientation.close)
        self._create_services(services)
        self._load_at_start()

    def _create_publishers(
        self, kind: type, topic: str, qos: QoSProfile | int
    ) -> dict[str, Publisher]:
        """Return publishers, also of the inactive node, by fluoroscope."""
        publishers = {n: self.create_publisher(kind, f'{n}/{topic}', qos) for n in self._names}
        for publisher in publishers.values():
            self.own(publisher, self.destroy_publisher, publisher)
        return publishers

    def _create_services(self, group: CallbackGroup) -> None:
        for kind, name, callback in (
            (Calibrate, 'calibrate', self._on_calibrate),
            (Capture, 'capture', self._on_capture),
            (Reset, 'reset', self._on_reset),
            (Reset, 'collect_anew', self._on_collect_anew),
            (SaveCalibration, 'save_calibration', self._on_save),
            (LoadCalibration, 'load_calibration', self._on_load),
        ):
            service = self.create_service(
                kind, name, callback, qos_profile=services_qos(), callback_group=group
            )
            self.own(service, self.destroy_service, service)
        action = ActionServer(
            self,
            SelfCalibrate,
            'self_calibrate',
            self._on_action,
            goal_callback=lambda _: GoalResponse.ACCEPT,
            cancel_callback=lambda _: CancelResponse.ACCEPT,
            callback_group=group,
        )
        self.own(action, action.destroy)

    def create_readers(self) -> None:
        """Receive the observations of all fluoroscopes in one thread."""
        faults = FaultHandlers(
            self._on_undecodable,
            self._on_lost_frame,
            self.fail,
            self._on_too_large,
        )
        reader = self.create_reader(self._angles.guarded(faults))
        self._angles.subscribe(reader)
        for name in self._names:
            reader.subscribe(
                TargetObservations,
                f'{name}/{OBSERVATIONS}',
                partial(self._on_frame, name),
                observations_qos(),
                decode_target_observations,
                self._limits.max_bytes,
            )

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Take everything down, but not while a request is being answered."""
        if self._requests:
            self.get_logger().error(
                'cleanup refused: a request is being answered; cancel it or wait for its end'
            )
            return TransitionCallbackReturn.FAILURE
        return super().on_cleanup(state)

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """End a running job; what answers it goes with the process."""
        if not self._requests:
            return super().on_shutdown(state)
        self._stopping.set()
        self.deactivate()
        return TransitionCallbackReturn.SUCCESS

    def stop(self) -> None:
        """End the running job before the node is destroyed."""
        self._stopping.set()
        if self._job is not None:
            self._job.join()
        super().stop()

    @contextmanager
    def _request(self) -> Iterator[None]:
        """Count a request that awaits something."""
        self._requests += 1
        try:
            yield
        finally:
            self._requests -= 1

    def _wake(self) -> None:
        """Make the executor continue what awaits a result of another thread."""
        if self.executor is not None:
            self.executor.wake()

    def _required_phantom(self) -> Phantom:
        """Return the phantom. Raises DataError where the node has none."""
        if self._phantom is None:
            raise DataError(
                'parameter phantom is not set: the node only serves saved calibrations'
            )
        return self._phantom

    def _calibrations(self) -> dict[str, calibration_result.FluoroscopeCalibration]:
        """Return the present calibrations by fluoroscope."""
        return {
            fluoroscope.name: fluoroscope.calibration
            for fluoroscope in self._fluoroscopes.values()
            if fluoroscope.calibration is not None
        }

    # -- observations, in the thread of the streams

    def _on_frame(self, name: str, frame: ObservedFrame, _: Mapping[str, int]) -> None:
        stamp_ns = NS_PER_S * frame.sec + frame.nanosec
        needed = bool(self._angle_options.angle_joint)
        self._exposures.add(
            name, frame, lambda: self._angles.of_frame(name, stamp_ns, needed=needed)
        )

    def _on_pair(self, pair: Mapping[str, Frame]) -> None:
        self._orientation.add(pair)

    def _on_undecodable(self, topic: str) -> None:
        self._exposures.refuse_undecodable(topic)

    def _on_too_large(self, topic: str, size: int) -> None:
        self._exposures.refuse_too_large(topic, size)

    def _on_lost_frame(self, topic: str, error: Exception) -> None:
        self._exposures.streams[topic.partition('/')[0]].refusals.fail(topic, error)

    # -- services

    async def _on_capture(
        self, request: Capture.Request, response: Capture.Response
    ) -> Capture.Response:
        timeout = request.timeout_sec or self._settings.capture_timeout
        try:
            self._required_phantom()
            check_timeout(timeout)
            if not self.readers:
                raise DataError(NOT_ACTIVE)
            if self._requests >= self._limits.max_waiting:
                raise DataError(
                    f'{self._requests} requests wait for their answers, as many as max_waiting '
                    'allows'
                )
        except ValueError as error:  # DataError among them
            response.message = str(error)
            return response
        with self._request():
            captured = await self._captured(timeout)
        response.success = captured is not None
        if captured is not None:
            number, response.exposures = captured
            response.message = f'frame {number} captured, {response.exposures} exposures now'
        else:
            response.exposures = self._exposures.collected(self._names[0]).exposures
            streams = self._exposures.streams.values()
            received = ', '.join(f'{stream.name} {stream.received}' for stream in streams)
            response.message = self._exposures.capture_refusal or (
                f'no frame of all fluoroscopes ({", ".join(self._names)}) came within '
                f'{timeout:g} s; frames received: {received}'
            )
        return response

    async def _captured(self, timeout_s: float) -> tuple[int, int] | None:
        """Return frame number and exposures of the next pair, None where none came in time."""
        captured = self._exposures.capture()
        timer = self.create_timer(
            timeout_s,
            lambda: self._exposures.give_up(captured),
            clock=Clock(clock_type=ClockType.STEADY_TIME),
        )
        found = await captured
        self.destroy_timer(timer)
        return found

    def _on_reset(self, _: Reset.Request, response: Reset.Response) -> Reset.Response:
        count = self._exposures.reset()
        for fluoroscope in self._fluoroscopes.values():
            fluoroscope.refused_calibration = ''
        response.success = True
        response.message = f'{count} exposures discarded, the calibration stays in use'
        return response

    def _on_collect_anew(self, request: Reset.Request, response: Reset.Response) -> Reset.Response:
        self.set_parameters([Parameter('collect', value='still')])
        self._on_reset(request, response)
        response.message += (
            '; new exposures are collected whenever the phantom stands still in a new pose'
        )
        self.get_logger().info(response.message)
        return response

    def _on_save(
        self, request: SaveCalibration.Request, response: SaveCalibration.Response
    ) -> SaveCalibration.Response:
        calibrations = self._calibrations()
        try:
            directory = self._directory_of(request)
            if not calibrations:
                raise DataError('there is no calibration to save')
            self._check_folders(directory)
            save_calibrations(directory, calibrations, self._orientation.present)
        except (DataError, OSError) as error:
            response.message = f'not saved: {error}'
            self.get_logger().error(response.message)
            return response
        if directory == self._directory:
            self._save_fault = ''
        response.success = True
        response.message = f'{", ".join(calibrations)} saved to {directory}'
        return response

    def _on_load(
        self, request: LoadCalibration.Request, response: LoadCalibration.Response
    ) -> LoadCalibration.Response:
        try:
            directory = self._directory_of(request)
            loaded, orientation = self._load(directory)
            if not loaded:
                raise DataError(
                    f'{directory}: there is no calibration of {", ".join(self._names)}'
                )
        except (DataError, OSError) as error:
            response.message = f'not loaded, the calibration in use stays: {error}'
            self.get_logger().error(response.message)
            return response
        self._publish(loaded, orientation)
        response.success = True
        response.message = f'{", ".join(loaded)} loaded from {directory}'
        return response

    def _directory_of(self, request: SaveCalibration.Request | LoadCalibration.Request) -> Path:
        """Return the folder of a request. Raises DataError."""
        if not request.directory:
            return self._directory
        directory = self._directory / expand_path(request.directory)
        base = self._directory.resolve()
        if not self._settings.any_directory and not directory.resolve().is_relative_to(base):
            raise DataError(
                f'{directory}: this folder is not below the calibration_directory {base}; the '
                'parameter any_directory allows it'
            )
        return directory

    def _check_folders(self, directory: Path) -> None:
        """Raise DataError where peers have made as many folders as they may."""
        limit = self._limits.max_folders
        base = self._directory.resolve()
        target = directory.resolve()
        if target.exists() or not target.is_relative_to(base):
            return
        new = sum(not path.exists() for path in (target, *target.parents))
        # The first one is the base itself.
        present = sum(1 for _ in itertools.islice(os.walk(base), limit + 2)) - 1
        if max(present, 0) + new > limit:
            raise DataError(
                f'{directory}: {self._directory} has as many folders as max_folders allows'
            )

    def _load(
        self, directory: Path
    ) -> tuple[dict[str, calibration_result.FluoroscopeCalibration], RigOrientation | None]:
        """Return the calibrations of the node's fluoroscopes in a folder, and their orientation.

        Raises DataError and OSError.
        """
        loaded = {n: c for n, c in load_calibrations(directory).items() if n in self._names}
        for sentence in disagreements(directory, loaded):
            self.get_logger().warning(printable(sentence))
        return loaded, self._orientation.load(directory, loaded) if loaded else None

    def _check_phantom_of_directory(self) -> None:
        """Raise DataError where the saved calibrations were made with another phantom."""
        path = self._directory / PHANTOM_FILE
        if self._phantom is None or not path.exists():
            return
        if not self._phantom.equals(read_phantom(path)):
            raise DataError(
                f'{self._directory}: its calibrations were made with another phantom than '
                f'{self._settings.phantom}; use another calibration_directory, or load them by '
                'the service load_calibration'
            )

    def _load_at_start(self) -> None:
        if not any(self._directory.glob('*' + SUFFIX)):
            return
        try:
            loaded, orientation = self._load(self._directory)
            self._check_phantom_of_directory()
        except (DataError, OSError) as error:
            self._load_fault = str(error)
            self.get_logger().error(f'no calibration loaded: {error}')
            return
        if loaded:
            self._publish(loaded, orientation)
            self.get_logger().info(
                f'calibration of {", ".join(loaded)} loaded from {self._directory}'
            )

    # -- self-calibration

    async def _on_calibrate(
        self, request: Calibrate.Request, response: Calibrate.Response
    ) -> Calibrate.Response:
        with self._request():
            await self._run_job(request, response, lambda *_: None, lambda: False)
        return response

    async def _on_action(self, goal: Any) -> SelfCalibrate.Result:
        result = SelfCalibrate.Result()
        feedback = SelfCalibrate.Feedback()

        def progress(label: str, last: Round) -> None:
            fill_feedback(feedback, label, last)
            goal.publish_feedback(feedback)

        with self._request():
            cancelled = await self._run_job(
                goal.request, result, progress, lambda: goal.is_cancel_requested
            )
        if result.success:
            goal.succeed()
        elif cancelled:
            goal.canceled()
        else:
            goal.abort()
        return result

    async def _run_job(
        self,
        request: Request,
        result: Result,
        progress: Callable[[str, Round], None],
        is_cancel_requested: Callable[[], bool],
    ) -> bool:
        """Run a calibration and fill in the result; returns whether it was cancelled.

        Without success nothing is changed.
        """
        if self._job is not None:
            result.message = 'refused: a self-calibration is already running'
            self.get_logger().warning(result.message)
            return False
        try:
            outcome = await self._start_job(request, progress, is_cancel_requested)
            self._use_outcome(outcome, result)
        except Cancelled:
            result.message = 'cancelled, nothing was changed'
            self.get_logger().info(result.message)
            return True
        except (DataError, ValueError, OSError) as error:
            result.message = str(error)
            self.get_logger().error(result.message)
            for name in self._running:
                self._fluoroscopes[name].refused_calibration = result.message
        except Exception as error:  # a bug must reach the caller, and must not end the node
            result.message = f'the self-calibration failed unexpectedly: {error}'
            self.get_logger().error(result.message)
        finally:
            self._running = ()
            self._job = None
        return False

    def _use_outcome(self, outcome: CalibrationOutcome, result: Result) -> None:
        """Save and publish the outcome of a job, and fill in the result. Raises DataError."""
        calibrations = {
            name: replace(calibration, seconds=outcome.result.seconds)
            for name, calibration in outcome.result.calibrations.items()
        }
        orientation, fault = self._save_outcome(outcome)
        if outcome.orientation is None:
            self.get_logger().warning(f'no new orientation of the rig: {outcome.orientation_note}')
        elif outcome.rig_note:
            self.get_logger().warning(outcome.rig_note)
        if orientation is None:
            self._orientation.clear()
        self._publish(calibrations, orientation)
        fill_result(result, outcome.result, calibrations)
        self._save_fault = fault
        if fault:
            result.message = f'{result.message}; {fault}'
            self.get_logger().error(fault)
        for sentence in outcome.result.left_out:
            self.get_logger().warning(f'not used: {sentence}')
        self.get_logger().info(result.message)
        if outcome.validation is not None:
            fill_verdict(result, outcome.validation)
            self._log_verdict(outcome.validation)

    def _save_outcome(self, outcome: CalibrationOutcome) -> tuple[RigOrientation | None, str]:
        """Save the outcome of a job; returns the orientation to use, and why it is not saved.

        What a calibration has cost is not lost where its folder cannot be written any more: the
        outcome is used and published all the same.
        """
        present = self._orientation.present
        try:
            return save_outcome(self._directory, outcome, present), ''
        except DataError as error:
            orientation = kept_orientation(present, outcome.orientation, outcome.calibrations)
            return orientation, (
                f'the calibration is in use but not saved: {error}; save it by the service '
                'save_calibration'
            )

    def _start_job(
        self,
        request: Request,
        progress: Callable[[str, Round], None],
        is_cancel_requested: Callable[[], bool],
    ) -> Future:
        """Start a calibration in a worker process; returns the Future of its CalibrationOutcome.

        Raises DataError and ValueError, also where the outcome could not be saved.
        """
        check_result_folder(self._directory)
        job, rig = self._job_of(request)
        done = Future()

        def on_round(label: str, last: Round) -> None:
            for name in label.split('+'):
                self._fluoroscopes[name].last_round = last
            progress(label, last)

        def raise_if_cancelled() -> None:
            if is_cancel_requested() or self._stopping.is_set():
                raise Cancelled

        def wait() -> None:
            try:
                done.set_result(
                    run_in_worker_process(
                        job,
                        validate=request.validate,
                        rig=rig,
                        progress=on_round,
                        raise_if_cancelled=raise_if_cancelled,
                    )
                )
            except Exception as error:
                done.set_exception(error)
            self._wake()

        self._running = tuple(job.frames)
        self._job = threading.Thread(target=wait, daemon=True)
        self._job.start()
        return done

    def _job_of(self, request: Request) -> tuple[CalibrationRequest, Rig]:
        """Return the job of a request, and the fluoroscopes that it leaves as they are.

        Raises DataError and ValueError.
        """
        frames = self._exposures.frames(request.fluoroscopes)
        joint = self._settings.joint and len(frames) > 1
        job = CalibrationRequest(
            frames,
            self._required_phantom(),
            options_of_request(request, self._options, joint),
            joint,
            request.principal_distance or None,
            self._target_names,
        )
        others = {n: c for n, c in self._calibrations().items() if n not in frames}
        all_frames = self._exposures.frames()
        rig = Rig(self._names, {name: all_frames[name] for name in others}, others)
        return job, rig

    def _log_verdict(self, validation: Validation) -> None:
        self.get_logger().info(f'verdict: {validation.verdict} ({validation.seconds:.1f} s)')
        for sentence in validation.findings:
            self.get_logger().warning(sentence)

    def _publish(
        self,
        calibrations: Mapping[str, calibration_result.FluoroscopeCalibration],
        orientation: RigOrientation | None,
    ) -> None:
        """Use and publish calibrations, and the orientation that belongs to them, if any."""
        # The orientation first, so that it is there when the first points come that are corrected
        # with the new calibrations.
        self._orientation.publish(orientation)
        for name, calibration in calibrations.items():
            self._fluoroscopes[name].use(calibration)
            self._load_fault = ''
            self._calibration_outputs[name].publish(message_from_calibration(calibration))

    # -- status

    def diagnose(self) -> list[Status]:
        """Return the status of every fluoroscope, and publish it."""
        stamp = self.get_clock().now().to_msg()
        incompatible = self.incompatible_publishers()
        statuses = []
        for fluoroscope in self._fluoroscopes.values():
            collected = self._exposures.collected(fluoroscope.name)
            progress = self._progress_of(fluoroscope, collected)
            self._status_outputs[fluoroscope.name].publish(message_from_progress(progress, stamp))
            self._publish_coverage(progress, collected)
            fault = incompatible.get(f'{fluoroscope.name}/{OBSERVATIONS}', '')
            unknown = self._angles.status(fluoroscope.name, incompatible)
            status = self._diagnose(fluoroscope, progress, collected, fault)
            if unknown and status.level == OK:
                status = replace(status, level=unknown[0], message=unknown[1])
            statuses.append(status)
        return statuses

    def _publish_coverage(self, progress: FluoroscopeProgress, collected: Collected) -> None:
        """Publish a picture of what is covered, while somebody looks at it."""
        name = progress.fluoroscope
        output = self._coverage_outputs[name]
        if collected.covered is None or not output.get_subscription_count():
            return
        lines = (
            f'{name}: {progress.exposures} exposures, {100 * progress.coverage:.0f} % covered',
            collected.readiness.advice,
        )
        size = collected.image_size or (1, 1)
        picture = coverage_picture(collected.covered, size, lines)
        stamp = self.get_clock().now().to_msg()
        output.publish(colour_message(picture, stamp, f'{name}_optical'))

    def _progress_of(self, fluoroscope: _Fluoroscope, collected: Collected) -> FluoroscopeProgress:
        name = fluoroscope.name
        return FluoroscopeProgress(
            fluoroscope=name,
            frames_received=collected.received,
            frames_rejected=collected.rejected,
            frames_unpaired=collected.unpaired,
            exposures=collected.exposures,
            observations=collected.observations,
            coverage=collected.coverage,
            is_calibrating=name in self._running,
            last_round=fluoroscope.last_round,
            calibration=fluoroscope.calibration,
            calibration_age_s=time.monotonic() - fluoroscope.calibrated_at,
        )

    def _diagnose(
        self,
        fluoroscope: _Fluoroscope,
        progress: FluoroscopeProgress,
        collected: Collected,
        incompatible: str,
    ) -> Status:
        """Return the diagnostics of a fluoroscope.

        incompatible: message about a publisher whose frames are not received, or ''.
        """
        return Status(
            fluoroscope.name,
            *self._verdict(fluoroscope, progress, incompatible),
            {
                'exposures': progress.exposures,
                'coverage': f'{progress.coverage:.2f}',
                'ready': collected.readiness.ready,
                'next pose': collected.readiness.advice,
                'frames received': progress.frames_received,
                'frames rejected': progress.frames_rejected,
                'frames unpaired': progress.frames_unpaired,
                'last fault': self._exposures.streams[fluoroscope.name].refusals.last_fault,
                'calibration': progress.calibration_id,
                **self._angles.values(fluoroscope.name),
            },
        )

    def _verdict(
        self, fluoroscope: _Fluoroscope, progress: FluoroscopeProgress, incompatible: str
    ) -> tuple[bytes, str]:
        """Return level and message of the diagnostics of a fluoroscope."""
        stream = self._exposures.streams[fluoroscope.name]
        failure = stream.refusals.failure_status()
        if failure:
            return failure
        if incompatible:
            return WARN, incompatible
        conflict = publisher_conflict(self, f'{fluoroscope.name}/calibration_status')
        if conflict:
            return ERROR, conflict
        if self._load_fault:
            return ERROR, f'no calibration loaded: {self._load_fault}'
        if self._save_fault:
            return ERROR, self._save_fault
        if fluoroscope.refused_calibration:
            in_use = progress.calibration_id or 'no calibration'
            return (
                ERROR,
                f'the last calibration was refused: {fluoroscope.refused_calibration}; '
                f'{in_use} is in use',
            )
        if not self.readers:
            return WARN, 'the node is not active'
        if not stream.received and not self.has_publisher(f'{fluoroscope.name}/{OBSERVATIONS}'):
            return WARN, 'no publisher of target observations'
        if progress.frames_unpaired:
            return (
                WARN,
                f'{progress.frames_unpaired} frames without partner of the other fluoroscopes',
            )
        refusals = stream.refusals.refusal_status()
        if refusals:
            return refusals
        disagreement = self._exposures.disagreement()
        if disagreement:
            return WARN, disagreement
        if progress.is_calibrating:
            last = progress.last_round
            return OK, f'self-calibration running, round {last.iteration if last else 0}'
        return OK, 'collecting exposures' if progress.calibration is None else 'calibrated'


def main(args: Sequence[str] | None = None) -> None:
    """Run the node."""
    run(CalibrationNode, args)


if __name__ == '__main__':
    main()
