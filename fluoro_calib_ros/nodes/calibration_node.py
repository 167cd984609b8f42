"""Node that collects exposures of the phantom and self-calibrates the fluoroscopes on request.

One thread runs all callbacks. Those that take long (calibrate, capture) are coroutines that await
what they wait for, and the calibration itself is a process of its own. rclpy's
MultiThreadedExecutor would be the other way, but it hands a callback out again until it has
started, which on a busy machine costs so much that frames are lost.
"""

import threading
import time
from collections import deque
from dataclasses import replace

import numpy as np
from fluoro_calib_msgs.action import SelfCalibrate
from fluoro_calib_msgs.msg import CalibrationStatus, FluoroscopeCalibration
from fluoro_calib_msgs.srv import Calibrate, Capture, LoadCalibration, Reset, SaveCalibration
from rclpy.action import ActionServer, CancelResponse, GoalResponse
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.task import Future

from ..bags.reader import frame_from_message
from ..calibration.initial_network import MIN_TARGETS_OF_EXPOSURE
from ..calibration.options import MODELS, CalibrationOptions
from ..calibration.request import CalibrationRequest
from ..errors import DataError
from ..exposures.collector import ExposureCollector, StillOptions
from ..exposures.frame import validate_frame
from ..exposures.pairing import FramePairer
from ..files.calibration import SUFFIX, load_calibrations, save_calibration
from ..files.phantom import read_phantom
from ..jobs.calibration import Rig
from ..jobs.result_folder import save_outcome
from ..jobs.worker_process import run_in_worker_process
from . import support
from .conversion import message_from_calibration
from .orienting import Orienting
from .qos import LATCHED
from .support import StartError, declare

COLLECT = ('still', 'request')


class Cancelled(Exception):
    """The running job is to stop."""


class CalibrationNode(Node):
    """Collects exposures of any number of fluoroscopes; one self-calibration at a time runs beside
    them.
    """

    def __init__(self):
        super().__init__('calibration_node')
        self._read_parameters()
        self._sentences = support.Sentences(self.get_logger())
        self._captures = deque()  # a Future for every capture that waits for its pair
        self._not_captured = ''  # why the last pair was none
        self._new_collection()
        self._image_size = {}
        self._not_phantom = set()
        self._received = dict.fromkeys(self._names, 0)
        self._rejected = dict.fromkeys(self._names, 0)
        self._last_fault = dict.fromkeys(self._names, '')
        self._deaf = dict.fromkeys(self._names, '')  # what keeps a publisher from being heard
        self._load_fault = ''
        self._stopping = threading.Event()
        self._rounds = {}
        self._calibrations = {}
        self._made_at = {}
        # fluoroscopes of the running job, and the thread that waits for it
        self._busy = ()
        self._job = None
        self._make_interfaces()
        self._load_at_start()

    def _read_parameters(self):
        self._names = support.fluoroscopes_of(self)
        phantom = declare(
            self, 'phantom', '', 'file phantom.csv with the surveyed coordinates of the beads [mm]'
        )
        if not phantom:
            raise StartError('parameter phantom is not set: it names the file phantom.csv')
        try:
            self._phantom = read_phantom(support.path_of(phantom))
        except DataError as error:
            raise StartError(str(error)) from None
        self._directory = support.path_of(
            declare(
                self,
                'calibration_directory',
                '~/.ros/fluoro_calib',
                'folder where calibrations are saved, and from which they are read at the start',
            )
        )
        self._collect = declare(
            self,
            'collect',
            'still',
            'how exposures are collected: still (by itself, when '
            'the phantom stands still in a new pose) or request (by the service capture)',
        )
        if self._collect not in COLLECT:
            raise StartError(f'parameter collect is {" or ".join(COLLECT)}, not {self._collect!r}')
        self._still = StillOptions(
            declare(
                self,
                'still_time',
                0.1,
                'time for which the phantom has to stand still [s]',
                0.0,
                60.0,
            ),
            declare(
                self,
                'still_px',
                1.0,
                'displacement of the targets that counts as still [px]',
                0.0,
                100.0,
            ),
            declare(
                self,
                'new_px',
                10.0,
                'displacement of the targets that makes a new pose [px]',
                0.0,
                1000.0,
            ),
        )
        self._pairing = (
            declare(
                self, 'pair_by', 'frame_number', 'how frames are paired: frame_number or stamp'
            ),
            round(
                1e9
                * declare(
                    self,
                    'pair_tolerance',
                    0.002,
                    'largest difference of the stamps of a pair [s]',
                    0.0,
                    1.0,
                )
            ),
        )
        self._defaults = {
            'model': declare(self, 'model', 'auto', f'correction model: {", ".join(MODELS)}'),
            'interior': declare(
                self, 'interior', 'estimated', 'interior orientation: estimated or fixed'
            ),
            'loss': declare(
                self, 'loss', 'student_t', 'noise model: student_t, huber or gaussian'
            ),
            'max_iterations': declare(
                self, 'max_iterations', 60, 'most rounds of a self-calibration', 1, 1000
            ),
        }
        self._joint = declare(self, 'joint', False, 'adjust all fluoroscopes together')
        self._fixed = {
            'relative_orientation': declare(
                self,
                'relative_orientation',
                'none',
                'between fluoroscopes adjusted together: none, soft or hard',
            ),
            'datum': declare(self, 'datum', 'survey', 'survey (weighted) or inner (free network)'),
        }
        self._rig_frame = declare(
            self,
            'rig_frame',
            'rig',
            'name of the rig frame, that of the phantom where orient captures it',
        )
        self._capture_timeout = declare(
            self, 'capture_timeout', 5.0, 'longest wait of a capture [s]', 0.1, 600.0
        )
        try:
            CalibrationOptions(**self._defaults, **self._fixed)
            FramePairer(self._names, *self._pairing)
        except ValueError as error:
            raise StartError(f'parameter {error}') from None

    def _make_interfaces(self):
        services = (
            ReentrantCallbackGroup()
        )  # those that await must not keep others from being answered
        self._calibration_outputs = {}
        self._status = {}
        for name in self._names:
            self._calibration_outputs[name] = self.create_publisher(
                FluoroscopeCalibration, f'{name}/calibration', LATCHED
            )
            self._status[name] = self.create_publisher(
                CalibrationStatus, f'{name}/calibration_status', 10
            )
            support.subscribe_observations(self, name, self._on_frame, self._on_deaf)
        self._orienting = Orienting(
            self,
            self._names,
            self._phantom,
            self._rig_frame,
            self._capture_timeout,
            lambda: self._directory,
            lambda: self._calibrations,
            services,
        )
        for kind, name, callback in (
            (Calibrate, 'calibrate', self._on_calibrate),
            (Capture, 'capture', self._on_capture),
            (Reset, 'reset', self._on_reset),
            (Reset, 'collect_anew', self._on_collect_anew),
            (SaveCalibration, 'save_calibration', self._on_save),
            (LoadCalibration, 'load_calibration', self._on_load),
        ):
            self.create_service(kind, name, callback, callback_group=services)
        self._action = ActionServer(
            self,
            SelfCalibrate,
            'self_calibrate',
            self._on_action,
            goal_callback=lambda _: GoalResponse.ACCEPT,
            cancel_callback=lambda _: CancelResponse.ACCEPT,
            callback_group=services,
        )
        self._diagnostics = support.Diagnostics(self)
        self.create_timer(1.0, self._on_timer)

    def _new_collection(self):
        self._pairer = FramePairer(self._names, *self._pairing)
        self._collector = ExposureCollector(self._names, self._still)

    # -- observations

    def _on_deaf(self, name, fault):
        """Say that nothing can come from a publisher."""
        self._deaf[name] = fault
        self._sentences.warn(fault)

    def _on_frame(self, name, message):
        """Check a frame, pair it, and collect the pair where it is wanted."""
        self._received[name] += 1
        try:
            frame = self._checked(name, message)
        except DataError as error:
            self._rejected[name] += 1
            self._last_fault[name] = str(error)
            self._sentences.warn(f'frame refused: {error}')
            return
        pair = None if frame is None else self._pairer.add(frame)
        if pair is not None:
            self._collect_pair(pair)

    def _checked(self, name, message):
        """Frame of a message, None for one that does not show the phantom. Raises DataError for a
        wrong one.
        """
        frame = frame_from_message(message, name, f'fluoroscope {name}')
        if len(frame.target_id) and (self._phantom.index(frame.target_id) < 0).all():
            if name not in self._not_phantom:
                self._not_phantom.add(name)
                self.get_logger().info(
                    f'fluoroscope {name}: frames without any target of the phantom, such as '
                    f'frame {frame.number}, are passed over'
                )
            return None
        frame = frame.sorted()
        validate_frame(frame, self._phantom, self._image_size.get(name))
        if len(frame.target_id) < MIN_TARGETS_OF_EXPOSURE:
            raise DataError(
                f'fluoroscope {name}, frame {frame.number}: {len(frame.target_id)} targets are too few, '
                f'{MIN_TARGETS_OF_EXPOSURE} are needed'
            )
        self._image_size.setdefault(name, frame.image_size)
        return frame

    def _collect_pair(self, pair):
        """Collect a pair, for the capture that has waited longest or because the phantom stands
        still.
        """
        self._orienting.take(pair)
        if self._captures:
            refused = self._not_captured = self._collector.take(pair)
            if not refused:
                self._captures.popleft().set_result(pair)
        elif self._collect == 'still':
            refused = self._collector.offer(pair)
        else:
            return
        if not refused:
            counts = ', '.join(
                f'{n}: {len(pair[n].target_id)} targets, {100 * c.fraction:.0f} % of the image covered'
                for n, c in self._collector.coverage.items()
            )
            self.get_logger().info(
                f'exposure {len(self._collector.exposures)} collected ({counts})'
            )

    # -- services

    async def _on_capture(self, request, response):
        timeout = request.timeout_sec or self._capture_timeout
        captured = Future()
        try:
            support.check_timeout(timeout)
        except ValueError as error:
            response.message = str(error)
            return response
        self._not_captured = ''
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
            response.message = self._not_captured or (
                f'no frame of all fluoroscopes ({", ".join(self._names)}) came within {timeout:g} s; '
                f'frames received: {", ".join(f"{n} {count}" for n, count in self._received.items())}'
            )
        return response

    def _on_reset(self, _, response):
        count = len(self._collector.exposures)
        self._new_collection()
        self._image_size.clear()
        response.success = True
        response.message = f'{count} exposures forgotten, the calibration stays'
        return response

    def _on_collect_anew(self, request, response):
        self._collect = 'still'
        self._on_reset(request, response)
        response.message += (
            '; exposures are collected anew, whenever the phantom stands still in a new pose'
        )
        self.get_logger().info(response.message)
        return response

    def _on_save(self, request, response):
        try:
            directory = (
                support.path_of(request.directory) if request.directory else self._directory
            )
            if not self._calibrations:
                raise DataError('there is no calibration to save')
            for calibration in self._calibrations.values():
                save_calibration(directory, calibration)
            self._orienting.save(directory)
        except (DataError, OSError) as error:
            response.message = f'not saved: {error}'
            self.get_logger().error(response.message)
            return response
        response.success = True
        response.message = f'{", ".join(self._calibrations)} saved to {directory}'
        return response

    def _on_load(self, request, response):
        try:
            directory = (
                support.path_of(request.directory) if request.directory else self._directory
            )
            found = self._read_calibrations(directory)
            if not found:
                raise DataError(
                    f'{directory}: there is no calibration of {", ".join(self._names)}'
                )
            orientation = self._orienting.read(directory, found)
        except (DataError, OSError) as error:
            response.message = f'not loaded, the running calibration stays: {error}'
            self.get_logger().error(response.message)
            return response
        self._publish(found, orientation)
        response.success = True
        response.message = f'{", ".join(found)} loaded from {directory}'
        return response

    def _read_calibrations(self, directory):
        return {n: c for n, c in load_calibrations(directory).items() if n in self._names}

    def _load_at_start(self):
        if not any(self._directory.glob('*' + SUFFIX)):
            return
        try:
            found = self._read_calibrations(self._directory)
            orientation = self._orienting.read(self._directory, found)
        except (DataError, OSError) as error:
            self._load_fault = str(error)
            self.get_logger().error(f'no calibration loaded: {error}')
            return
        if found:
            self._publish(found, orientation)
            self.get_logger().info(
                f'calibration of {", ".join(found)} loaded from {self._directory}'
            )

    # -- self-calibration

    async def _on_calibrate(self, request, response):
        await self._run_job(request, response, lambda *_: None, lambda: False)
        return response

    async def _on_action(self, goal):
        result = SelfCalibrate.Result()
        feedback = SelfCalibrate.Feedback()

        def progress(label, this):
            feedback.fluoroscope = label
            feedback.iteration = this.iteration
            feedback.cost_adjustment = this.F
            feedback.cost_regression = this.G
            feedback.k = max(this.k.values())
            feedback.rmse_u, feedback.rmse_v = (
                float(x)
                for x in np.sqrt(np.mean([np.square(r) for r in this.rmse.values()], axis=0))
            )
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

    async def _run_job(self, request, result, progress, cancel_requested):
        """Run a job and fill in result; returns whether it was cancelled. Without success nothing
        is changed.
        """
        if self._job is not None:
            result.message = 'refused: a self-calibration is running already'
            self.get_logger().warning(result.message)
            return False
        try:
            outcome = await self._start_job(request, progress, cancel_requested)
            calibrations = {
                name: replace(calibration, seconds=outcome.result.seconds)
                for name, calibration in outcome.result.calibrations.items()
            }
            orientation = save_outcome(self._directory, outcome, self._orienting.present)
            if outcome.orientation is None:
                self.get_logger().warning(
                    f'no new orientation of the rig: {outcome.orientation_note}'
                )
            if orientation is None:
                self._orienting.clear()
            self._publish(calibrations, orientation)
            _fill_result(result, outcome.result, calibrations)
            for sentence in outcome.result.left_out:
                self.get_logger().warning(f'not used: {sentence}')
            self.get_logger().info(result.message)
            self._report_verdict(result, outcome.validation)
        except Cancelled:
            result.message = 'cancelled, nothing was changed'
            self.get_logger().info(result.message)
            return True
        except (DataError, ValueError, OSError) as error:
            result.message = str(error)
            self.get_logger().error(result.message)
        except (
            Exception
        ) as error:  # a fault of ours must reach the caller, and must not end the node
            result.message = f'the self-calibration failed unexpectedly: {error}'
            self.get_logger().error(result.message)
        finally:
            self._busy = ()
            self._job = None
        return False

    def _start_job(self, request, progress, cancel_requested):
        """Start a calibration in a worker process; returns the Future of its CalibrationOutcome.

        Raises DataError and ValueError.
        """
        frames = self._collector.frames(list(request.fluoroscopes))
        joint = self._joint and len(frames) > 1
        job = CalibrationRequest(
            frames,
            self._phantom,
            self._options_of(request, joint),
            joint,
            request.principal_distance or None,
        )
        others = {n: c for n, c in self._calibrations.items() if n not in frames}
        all_frames = self._collector.frames()
        rig = Rig(self._names, {name: all_frames[name] for name in others}, others)
        done = Future()

        def on_round(label, this):
            for name in label.split('+'):
                self._rounds[name] = this
            progress(label, this)

        def raise_if_cancelled():
            if cancel_requested() or self._stopping.is_set():
                raise Cancelled

        def wait():
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
                self.executor.wake()  # to look at what has been awaited

        self._busy = tuple(frames)
        self._job = threading.Thread(target=wait, daemon=True)
        self._job.start()
        return done

    def _options_of(self, request, joint):
        """CalibrationOptions of a request, with the node's parameters where it leaves them open. Raises
        ValueError.
        """
        if request.principal_distance < 0 or not np.isfinite(request.principal_distance):
            raise ValueError(
                f'principal_distance is a length in pixels, not {request.principal_distance}'
            )
        fixed = dict(self._fixed)
        if not joint:
            del fixed['relative_orientation']
        return CalibrationOptions(
            **{
                name: getattr(request, name) or default for name, default in self._defaults.items()
            },
            **fixed,
        )

    def _report_verdict(self, result, validation):
        """Fill in and log the verdict on a calibration, where one was asked for."""
        if validation is not None:
            result.verdict = validation.verdict
            result.findings = list(validation.findings)
            result.message += f'; verdict: {validation.verdict}'
            self.get_logger().info(f'verdict: {validation.verdict} ({validation.seconds:.1f} s)')
            for sentence in validation.findings:
                self.get_logger().warning(sentence)

    def _publish(self, calibrations, orientation=None):
        """Take calibrations and, where there is one, the orientation that belongs to them over,
        and publish them.
        """
        # First, so that it is there when the first points come that are corrected with the new
        # calibrations.
        self._orienting.publish(orientation)
        for name, calibration in calibrations.items():
            self._calibrations[name] = calibration
            self._made_at[name] = time.monotonic()
            self._load_fault = ''
            self._calibration_outputs[name].publish(message_from_calibration(calibration))

    # -- status

    def _on_timer(self):
        self._diagnostics.publish([self._report(name) for name in self._names])

    def _report(self, name):
        """Publish the status of a fluoroscope; returns its diagnostics."""
        message = CalibrationStatus(fluoroscope=name)
        calibration = self._calibrations.get(name)
        message.header.stamp = self.get_clock().now().to_msg()
        message.header.frame_id = f'{name}_optical'
        message.state = (
            CalibrationStatus.CALIBRATING
            if name in self._busy
            else CalibrationStatus.CALIBRATED
            if calibration
            else CalibrationStatus.COLLECTING
        )
        message.frames_received = self._received[name]
        message.frames_rejected = self._rejected[name]
        message.frames_unpaired = self._pairer.unpaired[name]
        message.exposures = len(self._collector.exposures)
        message.observations = sum(len(pair[name].target_id) for pair in self._collector.exposures)
        if name in self._collector.coverage:
            message.coverage = self._collector.coverage[name].fraction
        if name in self._rounds:
            last = self._rounds[name]
            message.iteration = last.iteration
            message.k = last.k[name]
            message.cost_adjustment = last.F
            message.cost_regression = last.G
            message.rmse_u, message.rmse_v = (float(x) for x in last.rmse[name])
        message.calibration_age = (
            time.monotonic() - self._made_at[name] if calibration else float('nan')
        )
        message.calibration_id = calibration.calibration_id if calibration else ''
        self._status[name].publish(message)
        return (
            name,
            *self._verdict(name, message),
            {
                'exposures': message.exposures,
                'coverage': f'{message.coverage:.2f}',
                'frames received': message.frames_received,
                'frames rejected': message.frames_rejected,
                'frames unpaired': message.frames_unpaired,
                'last fault': self._last_fault[name],
                'calibration': message.calibration_id,
            },
        )

    def _verdict(self, name, status):
        """Level and message of the diagnostics of a fluoroscope."""
        if self._deaf[name]:
            return support.WARN, self._deaf[name]
        if self._load_fault:
            return support.ERROR, f'no calibration loaded: {self._load_fault}'
        if (
            self.count_publishers(f'{name}/target_observations') == 0
            and status.frames_received == 0
        ):
            return support.WARN, 'nobody publishes target observations'
        if status.frames_unpaired:
            return (
                support.WARN,
                f'{status.frames_unpaired} frames without partner of the other fluoroscopes',
            )
        if status.frames_rejected:
            return (
                support.WARN,
                f'{status.frames_rejected} frames refused: {self._last_fault[name]}',
            )
        if name in self._busy:
            return support.OK, f'self-calibration running, round {status.iteration}'
        return support.OK, 'calibrated' if name in self._calibrations else 'collecting exposures'

    def stop(self):
        """End the running job: the node is to go."""
        self._stopping.set()
        if self._job is not None:
            self._job.join()

    def destroy_node(self):
        """Take the action server down with the node."""
        self._action.destroy()
        super().destroy_node()


def _fill_result(result, job, calibrations):
    """Fill in a Calibrate response or SelfCalibrate result."""
    result.success = True
    result.seconds = job.seconds
    for name, calibration in calibrations.items():
        sd = np.sqrt(np.diagonal(calibration.interior_covariance))
        result.fluoroscope = [*result.fluoroscope, name]
        result.calibration_id = [*result.calibration_id, calibration.calibration_id]
        result.model_kind = [*result.model_kind, calibration.model.kind]
        result.converged = [*result.converged, calibration.converged]
        for field, value in (
            ('k', calibration.model.k),
            ('iterations', calibration.iterations),
            ('observations', calibration.observations),
            ('inliers', calibration.inliers),
            ('xp', calibration.interior[0]),
            ('yp', calibration.interior[1]),
            ('c', calibration.interior[2]),
            ('sd_xp', sd[0]),
            ('sd_yp', sd[1]),
            ('sd_c', sd[2]),
            ('rmse_before_u', calibration.rmse_before[0]),
            ('rmse_before_v', calibration.rmse_before[1]),
            ('rmse_after_u', calibration.rmse_after[0]),
            ('rmse_after_v', calibration.rmse_after[1]),
        ):
            getattr(result, field).append(value if isinstance(value, int) else float(value))
    unsettled = (
        '' if job.converged else ' (stopped at the largest number of rounds, not converged)'
    )
    result.message = f'{", ".join(calibrations)} calibrated in {job.seconds:.1f} s{unsettled}'


def main(args=None):
    """Entry point."""
    support.run(CalibrationNode, args)


if __name__ == '__main__':
    main()
