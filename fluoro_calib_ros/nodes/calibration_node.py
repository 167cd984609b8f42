"""Node that collects exposures of the phantom and self-calibrates the fluoroscopes on request.

One thread runs all callbacks. Those that take long (calibrate, capture) are coroutines that await
what they need, and the calibration itself is a process of its own. rclpy's MultiThreadedExecutor
is no alternative: it schedules a callback again and again until it has started, which on a busy
machine costs so much time that frames are lost.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from fluoro_calib_msgs.action import SelfCalibrate
from fluoro_calib_msgs.msg import CalibrationStatus, FluoroscopeCalibration, TargetObservations
from fluoro_calib_msgs.srv import Calibrate, Capture, LoadCalibration, Reset, SaveCalibration
from rclpy.action import ActionServer, CancelResponse, GoalResponse
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.clock import Clock, ClockType
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy, qos_policy_name_from_kind
from rclpy.subscription import Subscription
from rclpy.task import Future

from ..calibration import result as calibration_result
from ..calibration.initial_network import MIN_TARGETS_OF_EXPOSURE
from ..calibration.options import CalibrationOptions
from ..calibration.request import CalibrationRequest
from ..calibration.rounds import Round
from ..errors import DataError
from ..exposures.collector import ExposureCollector, StillOptions
from ..exposures.frame import Frame, validate_frame
from ..exposures.names import Names
from ..exposures.pairing import CompletePairer, PairingOptions
from ..exposures.phantom import Phantom
from ..files.calibration import SUFFIX, load_calibrations
from ..files.calibration_request import PHANTOM as PHANTOM_FILE
from ..files.phantom import read_phantom
from ..jobs.calibration import CalibrationOutcome, Rig
from ..jobs.result_folder import (
    check_result_folder,
    kept_orientation,
    save_calibrations,
    save_outcome,
)
from ..jobs.sources import read_survey
from ..jobs.worker_process import run_in_worker_process
from ..options import option
from ..photogrammetry.rig_orientation import RigOrientation
from ..validation.check import Validation
from .messages.calibration_status import FluoroscopeProgress, message_from_progress
from .messages.fluoroscope_calibration import message_from_calibration
from .messages.self_calibration import (
    Request,
    Result,
    fill_feedback,
    fill_result,
    fill_verdict,
    options_of_request,
)
from .messages.target_observations import frame_from_message
from .orientation_service import CaptureSettings, OrientationService
from .runtime.diagnostics import ERROR, OK, WARN, DiagnosticsPublisher, Status
from .runtime.discovery import best_effort_message, needs_best_effort, publisher_conflict
from .runtime.errors import StartError
from .runtime.logging import RateLimitedLogger
from .runtime.main import run
from .runtime.parameters import (
    ParameterGroup,
    RigParameters,
    check_timeout,
    default_calibration_directory,
    expand_path,
)
from .runtime.qos import (
    incompatible_qos_message,
    latched_qos,
    observations_qos,
    qos_overrides,
)
from .runtime.refusals import RefusalLog

COLLECT_MODES = ('still', 'request')


@dataclass(frozen=True)
class CalibrationParameters(RigParameters):
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


_NODE = ParameterGroup(CalibrationParameters)
_STILL = ParameterGroup(
    StillOptions, {'still_time_s': 'still_time', 'still_px': 'still_px', 'new_px': 'new_px'}
)
_PAIRING = ParameterGroup(PairingOptions, {'pair_by': 'pair_by', 'tolerance_s': 'pair_tolerance'})
_CALIBRATION = ParameterGroup(
    CalibrationOptions,
    {
        name: name
        for name in (
            'model',
            'interior',
            'loss',
            'max_iterations',
            'relative_orientation',
            'datum',
        )
    },
)
PARAMETERS = (_NODE, _STILL, _PAIRING, _CALIBRATION)


class Cancelled(Exception):
    """The running job has to stop."""


class _Fluoroscope:
    """What the node knows of one fluoroscope."""

    def __init__(self, name: str, logger: RateLimitedLogger) -> None:
        self.name = name
        self.received = 0
        self.refusals = RefusalLog('frame', logger)
        self.incompatible = ''  # message about a publisher whose frames are not received
        self.image_size: tuple[int, int] | None = None
        self.is_other_object_logged = False
        self.last_round: Round | None = None
        self.calibration: calibration_result.FluoroscopeCalibration | None = None
        self.calibrated_at = float('nan')
        self.refused_calibration = ''  # why the last calibration was refused

    def use(self, calibration: calibration_result.FluoroscopeCalibration) -> None:
        """Use a calibration from now on."""
        self.refused_calibration = ''
        self.calibration = calibration
        self.calibrated_at = time.monotonic()


class CalibrationNode(Node):
    """Collects exposures of the fluoroscopes, and runs one self-calibration at a time."""

    def __init__(self) -> None:
        super().__init__('calibration_node')
        self._settings = _NODE.declare(self)
        self._still = _STILL.declare(self)
        self._pairing = _PAIRING.declare(self)
        self._options = _CALIBRATION.declare(self)
        self._read_files()
        self._names = self._settings.fluoroscopes
        self._collect = self._settings.collect
        self._limited_logger = RateLimitedLogger(self.get_logger())
        self._fluoroscopes = {
            name: _Fluoroscope(name, self._limited_logger) for name in self._names
        }
        self._captures: deque[Future] = deque()  # one for every capture that waits for its pair
        self._capture_refusal = ''  # why the last pair was not captured
        self._start_collection()
        self._load_fault = ''
        self._save_fault = ''
        self._stopping = threading.Event()
        self._running: tuple[str, ...] = ()  # fluoroscopes of the running job
        self._job: threading.Thread | None = None  # waits for the worker process
        self._create_interfaces()
        self._load_at_start()

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

    def _create_interfaces(self) -> None:
        # Services that await must not keep others from being answered.
        services = ReentrantCallbackGroup()
        self._calibration_outputs = {}
        self._inputs: dict[str, Subscription] = {}
        self._status_outputs = {}
        for name in self._names:
            # The status first: by its publishers, receivers of calibrations recognise that two
            # nodes serve the same fluoroscope.
            self._status_outputs[name] = self.create_publisher(
                CalibrationStatus, f'{name}/calibration_status', 10
            )
            self._calibration_outputs[name] = self.create_publisher(
                FluoroscopeCalibration, f'{name}/calibration', latched_qos()
            )
            self._subscribe(self._fluoroscopes[name])
        self._orientation = OrientationService(
            self,
            CaptureSettings(
                self._names,
                self._phantom,
                self._settings.rig_frame,
                self._settings.capture_timeout,
                self._directory,
            ),
            self._calibrations,
            services,
        )
        for kind, service, callback in (
            (Calibrate, 'calibrate', self._on_calibrate),
            (Capture, 'capture', self._on_capture),
            (Reset, 'reset', self._on_reset),
            (Reset, 'collect_anew', self._on_collect_anew),
            (SaveCalibration, 'save_calibration', self._on_save),
            (LoadCalibration, 'load_calibration', self._on_load),
        ):
            self.create_service(kind, service, callback, callback_group=services)
        self._action = ActionServer(
            self,
            SelfCalibrate,
            'self_calibrate',
            self._on_action,
            goal_callback=lambda _: GoalResponse.ACCEPT,
            cancel_callback=lambda _: CancelResponse.ACCEPT,
            callback_group=services,
        )
        self._diagnostics = DiagnosticsPublisher(self)
        self.create_timer(1.0, self._on_timer)

    def _subscribe(self, fluoroscope: _Fluoroscope, qos: QoSProfile | None = None) -> None:
        """Subscribe to the observations of a fluoroscope; by default reliable."""
        topic = f'{fluoroscope.name}/target_observations'

        def on_message(message: TargetObservations) -> None:
            try:
                self._on_frame(fluoroscope, message)
            except Exception as error:  # a message may hold anything and must not end the node
                fluoroscope.refusals.fail(topic, error)

        def on_incompatible(event: Any) -> None:
            policy = qos_policy_name_from_kind(event.last_policy_kind)
            fluoroscope.incompatible = incompatible_qos_message(topic, policy)
            self._limited_logger.warning(fluoroscope.incompatible)

        self._inputs[fluoroscope.name] = self.create_subscription(
            TargetObservations,
            topic,
            on_message,
            qos or observations_qos(),
            event_callbacks=SubscriptionEventCallbacks(incompatible_qos=on_incompatible),
            qos_overriding_options=None if qos else qos_overrides(),
        )

    def _accept_best_effort(self, fluoroscope: _Fluoroscope) -> None:
        """Subscribe best effort where all publishers offer no more."""
        old = self._inputs[fluoroscope.name]
        if not needs_best_effort(self, old):
            return
        qos = observations_qos()
        qos.reliability = ReliabilityPolicy.BEST_EFFORT
        self.destroy_subscription(old)
        self._subscribe(fluoroscope, qos)
        fluoroscope.incompatible = ''
        self.get_logger().warning(best_effort_message(f'{fluoroscope.name}/target_observations'))

    def _start_collection(self) -> None:
        self._pairer = CompletePairer(self._names, self._pairing)
        self._collector = ExposureCollector(self._names, self._still)

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

    # -- observations

    def _on_frame(self, fluoroscope: _Fluoroscope, message: TargetObservations) -> None:
        """Validate a frame, pair it, and collect the pair where it is wanted."""
        fluoroscope.received += 1
        if self._phantom is None:
            return
        try:
            frame = self._validated(fluoroscope, message)
        except DataError as error:
            fluoroscope.refusals.refuse(error)
            return
        if frame is not None:
            for pair in self._pairer.add(frame):
                self._collect_pair(pair)

    def _validated(self, fluoroscope: _Fluoroscope, message: TargetObservations) -> Frame | None:
        """Return the frame of a message, None where it does not show the phantom.

        Raises DataError for an invalid frame.
        """
        name = fluoroscope.name
        assert self._phantom is not None
        frame = frame_from_message(message, name)
        if len(frame.target_id) and (self._phantom.index(frame.target_id) < 0).all():
            if not fluoroscope.is_other_object_logged:
                fluoroscope.is_other_object_logged = True
                self.get_logger().info(
                    f'fluoroscope {name}: frames without any target of the phantom, such as '
                    f'frame {frame.number}, are ignored'
                )
            return None
        frame = frame.sorted()
        validate_frame(frame, self._phantom, fluoroscope.image_size)
        if len(frame.target_id) < MIN_TARGETS_OF_EXPOSURE:
            raise DataError(
                f'fluoroscope {name}, frame {frame.number}: {len(frame.target_id)} targets are '
                f'too few, {MIN_TARGETS_OF_EXPOSURE} are needed'
            )
        if fluoroscope.image_size is None:
            fluoroscope.image_size = frame.image_size
        return frame

    def _collect_pair(self, pair: Mapping[str, Frame]) -> None:
        """Collect a pair for the oldest capture, or because the phantom stands still."""
        self._orientation.add(pair)
        if self._captures:
            refusal = self._capture_refusal = self._collector.add(pair)
            if not refusal:
                self._captures.popleft().set_result(pair)
        elif self._collect == 'still':
            before = len(self._collector.exposures)
            refusal = self._collector.offer(pair)
            if len(self._collector.exposures) < before:
                self.get_logger().info(
                    f'exposure {before} discarded: it is the first frame of a stream in which the '
                    'phantom moves'
                )
        else:
            return
        if not refusal:
            counts = ', '.join(
                f'{name}: {len(pair[name].target_id)} targets, '
                f'{100 * coverage.fraction:.0f} % of the image covered'
                for name, coverage in self._collector.coverage.items()
            )
            self.get_logger().info(
                f'exposure {len(self._collector.exposures)} collected ({counts})'
            )

    # -- services

    async def _on_capture(
        self, request: Capture.Request, response: Capture.Response
    ) -> Capture.Response:
        timeout = request.timeout_sec or self._settings.capture_timeout
        try:
            self._required_phantom()
            check_timeout(timeout)
        except ValueError as error:  # DataError among them
            response.message = str(error)
            return response
        captured = Future()
        self._capture_refusal = ''
        self._captures.append(captured)
        timer = self.create_timer(
            timeout,
            lambda: captured.done() or captured.set_result(None),
            clock=Clock(clock_type=ClockType.STEADY_TIME),
        )
        pair = await captured
        self.destroy_timer(timer)
        response.exposures = len(self._collector.exposures)
        response.success = pair is not None
        if pair is not None:
            number = pair[self._names[0]].number
            response.message = f'frame {number} captured, {response.exposures} exposures now'
        else:
            self._captures.remove(captured)
            received = ', '.join(f'{f.name} {f.received}' for f in self._fluoroscopes.values())
            response.message = self._capture_refusal or (
                f'no frame of all fluoroscopes ({", ".join(self._names)}) came within '
                f'{timeout:g} s; frames received: {received}'
            )
        return response

    def _on_reset(self, _: Reset.Request, response: Reset.Response) -> Reset.Response:
        count = len(self._collector.exposures)
        self._start_collection()
        for fluoroscope in self._fluoroscopes.values():
            fluoroscope.image_size = None
            fluoroscope.refused_calibration = ''
        response.success = True
        response.message = f'{count} exposures discarded, the calibration stays in use'
        return response

    def _on_collect_anew(self, request: Reset.Request, response: Reset.Response) -> Reset.Response:
        self._collect = 'still'
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
        return expand_path(request.directory) if request.directory else self._directory

    def _load(
        self, directory: Path
    ) -> tuple[dict[str, calibration_result.FluoroscopeCalibration], RigOrientation | None]:
        """Return the calibrations of the node's fluoroscopes in a folder, and their orientation.

        Raises DataError and OSError.
        """
        loaded = {n: c for n, c in load_calibrations(directory).items() if n in self._names}
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
        await self._run_job(request, response, lambda *_: None, lambda: False)
        return response

    async def _on_action(self, goal: Any) -> SelfCalibrate.Result:
        result = SelfCalibrate.Result()
        feedback = SelfCalibrate.Feedback()

        def progress(label: str, last: Round) -> None:
            fill_feedback(feedback, label, last)
            goal.publish_feedback(feedback)

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
            if self.executor is not None:
                self.executor.wake()  # to continue what awaits the result

        self._running = tuple(job.frames)
        self._job = threading.Thread(target=wait, daemon=True)
        self._job.start()
        return done

    def _job_of(self, request: Request) -> tuple[CalibrationRequest, Rig]:
        """Return the job of a request, and the fluoroscopes that it leaves as they are.

        Raises DataError and ValueError.
        """
        frames = self._collector.frames(list(request.fluoroscopes))
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
        all_frames = self._collector.frames()
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

    def _on_timer(self) -> None:
        """Publish the status and the diagnostics of every fluoroscope."""
        statuses = []
        stamp = self.get_clock().now().to_msg()
        for fluoroscope in self._fluoroscopes.values():
            self._accept_best_effort(fluoroscope)
            progress = self._progress_of(fluoroscope)
            self._status_outputs[fluoroscope.name].publish(message_from_progress(progress, stamp))
            statuses.append(self._diagnose(fluoroscope, progress))
        self._diagnostics.publish(statuses)

    def _progress_of(self, fluoroscope: _Fluoroscope) -> FluoroscopeProgress:
        name = fluoroscope.name
        exposures = self._collector.exposures
        coverage = self._collector.coverage.get(name)
        return FluoroscopeProgress(
            fluoroscope=name,
            frames_received=fluoroscope.received,
            frames_rejected=fluoroscope.refusals.total + fluoroscope.refusals.failures,
            frames_unpaired=self._pairer.unpaired[name],
            exposures=len(exposures),
            observations=sum(len(pair[name].target_id) for pair in exposures),
            coverage=coverage.fraction if coverage else 0.0,
            is_calibrating=name in self._running,
            last_round=fluoroscope.last_round,
            calibration=fluoroscope.calibration,
            calibration_age_s=time.monotonic() - fluoroscope.calibrated_at,
        )

    def _diagnose(self, fluoroscope: _Fluoroscope, progress: FluoroscopeProgress) -> Status:
        """Return the diagnostics of a fluoroscope."""
        return Status(
            fluoroscope.name,
            *self._verdict(fluoroscope, progress),
            {
                'exposures': progress.exposures,
                'coverage': f'{progress.coverage:.2f}',
                'frames received': progress.frames_received,
                'frames rejected': progress.frames_rejected,
                'frames unpaired': progress.frames_unpaired,
                'last fault': fluoroscope.refusals.last_fault,
                'calibration': progress.calibration_id,
            },
        )

    def _verdict(
        self, fluoroscope: _Fluoroscope, progress: FluoroscopeProgress
    ) -> tuple[bytes, str]:
        """Return level and message of the diagnostics of a fluoroscope."""
        failure = fluoroscope.refusals.failure_status()
        if failure:
            return failure
        if fluoroscope.incompatible:
            return WARN, fluoroscope.incompatible
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
        topic = self.resolve_topic_name(f'{fluoroscope.name}/target_observations')
        if not fluoroscope.received and not self.count_publishers(topic):
            return WARN, 'no publisher of target observations'
        if progress.frames_unpaired:
            return (
                WARN,
                f'{progress.frames_unpaired} frames without partner of the other fluoroscopes',
            )
        refusals = fluoroscope.refusals.refusal_status()
        if refusals:
            return refusals
        if progress.is_calibrating:
            last = progress.last_round
            return OK, f'self-calibration running, round {last.iteration if last else 0}'
        return OK, 'collecting exposures' if progress.calibration is None else 'calibrated'

    def stop(self) -> None:
        """End the running job before the node is destroyed."""
        self._stopping.set()
        if self._job is not None:
            self._job.join()

    def destroy_node(self) -> None:
        """Destroy the action server with the node."""
        self._action.destroy()
        super().destroy_node()


def main(args: Sequence[str] | None = None) -> None:
    """Run the node."""
    run(CalibrationNode, args)


if __name__ == '__main__':
    main()
