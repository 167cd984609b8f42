"""Node that collects exposures of the phantom and self-calibrates the fluoroscopes on request."""

import threading
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from fluoro_calib_msgs.action import SelfCalibrate
from fluoro_calib_msgs.msg import CalibrationStatus, FluoroscopeCalibration, TargetObservations
from fluoro_calib_msgs.srv import Calibrate, Capture, LoadCalibration, Reset, SaveCalibration
from rclpy.action import ActionServer, CancelResponse, GoalResponse
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup, ReentrantCallbackGroup
from rclpy.node import Node

from ..bags.reader import frame_from_message
from ..calibration.collector import ExposureCollector, FramePairer, StillOptions
from ..calibration.job import calibrate
from ..calibration.network import MIN_TARGETS_OF_EXPOSURE
from ..calibration.self_calibration import Options
from ..files.calibration import load_calibrations, save_calibration
from ..files.phantom import read_phantom
from ..photogrammetry.observations import DataError, check_frame
from . import support
from .conversion import message_from_calibration
from .qos import LATCHED, OBSERVATIONS, overridable
from .support import StartError, declare

COLLECT = ('still', 'request')


class Cancelled(Exception):
    """The running job is to stop."""


class CalibrationNode(Node):
    """Collects exposures of any number of fluoroscopes; one self-calibration at a time runs beside them."""

    def __init__(self):
        super().__init__('calibration_node')
        self._read_parameters()
        self._sentences = support.Sentences(self.get_logger())
        self._lock = threading.Lock()   # collector, pairer and counters
        self._captured = threading.Condition(self._lock)
        self._capture_wanted = 0
        self._new_collection()
        self._image_size, self._not_phantom = {}, set()
        self._received = dict.fromkeys(self._names, 0)
        self._rejected = dict.fromkeys(self._names, 0)
        self._last_fault = dict.fromkeys(self._names, '')
        self._job_lock = threading.Lock()   # held by the running job
        self._stopping = threading.Event()
        self._rounds, self._calibrations, self._made_at = {}, {}, {}
        self._busy = ()
        self._make_interfaces()
        self._load_at_start()

    def _read_parameters(self):
        self._names = list(declare(self, 'fluoroscopes', ['a', 'b'], 'names of the fluoroscopes'))
        if not self._names or len(set(self._names)) != len(self._names):
            raise StartError(f'parameter fluoroscopes: {self._names} is not a list of different names')
        phantom = declare(self, 'phantom', '', 'file phantom.csv with the surveyed coordinates of the beads [mm]')
        if not phantom:
            raise StartError('parameter phantom is not set: it names the file phantom.csv')
        try:
            self._phantom = read_phantom(Path(phantom).expanduser())
        except DataError as error:
            raise StartError(str(error)) from None
        self._directory = declare(self, 'calibration_directory', '~/.ros/fluoro_calib',
                                  'folder where calibrations are saved, and from which they are read at the start')
        self._directory = Path(self._directory).expanduser()
        self._collect = declare(self, 'collect', 'still', 'how exposures are collected: still (by itself, when '
                                'the phantom stands still in a new pose) or request (by the service capture)')
        if self._collect not in COLLECT:
            raise StartError(f'parameter collect is {" or ".join(COLLECT)}, not {self._collect!r}')
        self._still = StillOptions(
            declare(self, 'still_time', 0.1, 'time for which the phantom has to stand still [s]', 0.0, 60.0),
            declare(self, 'still_px', 1.0, 'displacement of the targets that counts as still [px]', 0.0, 100.0),
            declare(self, 'new_px', 10.0, 'displacement of the targets that makes a new pose [px]', 0.0, 1000.0))
        self._pairing = (declare(self, 'pair_by', 'frame_number', 'how frames are paired: frame_number or stamp'),
                         round(1e9 * declare(self, 'pair_tolerance', 0.002,
                                             'largest difference of the stamps of a pair [s]', 0.0, 1.0)))
        self._defaults = {
            'model': declare(self, 'model', 'local_linear', 'correction model: local_linear, knn or none'),
            'interior': declare(self, 'interior', 'estimated', 'interior orientation: estimated or fixed'),
            'loss': declare(self, 'loss', 'student_t', 'noise model: student_t, huber or gaussian'),
            'max_iterations': declare(self, 'max_iterations', 60, 'most rounds of a self-calibration', 1, 1000)}
        self._joint = declare(self, 'joint', False, 'adjust all fluoroscopes together')
        self._capture_timeout = declare(self, 'capture_timeout', 5.0, 'longest wait of a capture [s]', 0.1, 600.0)
        try:
            Options(**self._defaults)
            FramePairer(self._names, *self._pairing)
        except ValueError as error:
            raise StartError(f'parameter {error}') from None

    def _make_interfaces(self):
        streams, timers = MutuallyExclusiveCallbackGroup(), MutuallyExclusiveCallbackGroup()
        # Services that wait (calibrate, capture) must not keep others from being answered.
        services = ReentrantCallbackGroup()
        self._calibration_outputs, self._status = {}, {}
        for name in self._names:
            self._calibration_outputs[name] = self.create_publisher(FluoroscopeCalibration, f'{name}/calibration', LATCHED)
            self._status[name] = self.create_publisher(CalibrationStatus, f'{name}/calibration_status', 10)
            self.create_subscription(TargetObservations, f'{name}/target_observations',
                                     lambda message, name=name: self._on_frame(name, message), OBSERVATIONS,
                                     callback_group=streams, qos_overriding_options=overridable())
        for kind, name, callback in ((Calibrate, 'calibrate', self._on_calibrate),
                                     (Capture, 'capture', self._on_capture), (Reset, 'reset', self._on_reset),
                                     (SaveCalibration, 'save_calibration', self._on_save),
                                     (LoadCalibration, 'load_calibration', self._on_load)):
            self.create_service(kind, name, callback, callback_group=services)
        self._action = ActionServer(self, SelfCalibrate, 'self_calibrate', self._on_action,
                                    goal_callback=lambda _: GoalResponse.ACCEPT,
                                    cancel_callback=lambda _: CancelResponse.ACCEPT, callback_group=services)
        self._diagnostics = support.Diagnostics(self)
        self.create_timer(1.0, self._on_timer, callback_group=timers)

    def _new_collection(self):
        self._pairer = FramePairer(self._names, *self._pairing)
        self._collector = ExposureCollector(self._names, self._still)

    # -- observations

    def _on_frame(self, name, message):
        """Check a frame, pair it, and collect the pair where it is wanted."""
        try:
            with self._lock:
                self._received[name] += 1
            frame = self._checked(name, message)
        except DataError as error:
            with self._lock:
                self._rejected[name] += 1
                self._last_fault[name] = str(error)
            self._sentences.warn(f'frame refused: {error}')
            return
        if frame is None:
            return
        with self._lock:
            pair = self._pairer.add(frame)
            if pair is not None:
                self._collect_pair(pair)

    def _checked(self, name, message):
        """Frame of a message, None for one that does not show the phantom. Raises DataError for a wrong one."""
        frame = frame_from_message(message, name, f'fluoroscope {name}')
        if len(frame.target_id) and (self._phantom.index(frame.target_id) < 0).all():
            if name not in self._not_phantom:
                self._not_phantom.add(name)
                self.get_logger().info(f'fluoroscope {name}: frames without any target of the phantom, such as '
                                       f'frame {frame.number}, are passed over')
            return None
        frame = frame.sorted()
        check_frame(frame, self._phantom, self._image_size.get(name))
        if len(frame.target_id) < MIN_TARGETS_OF_EXPOSURE:
            raise DataError(f'fluoroscope {name}, frame {frame.number}: {len(frame.target_id)} targets are too few, '
                            f'{MIN_TARGETS_OF_EXPOSURE} are needed')
        self._image_size.setdefault(name, frame.image_size)
        return frame

    def _collect_pair(self, pair):
        """Collect a pair; the lock is held."""
        if self._capture_wanted:
            refused = self._collector.take(pair)
            if not refused:
                self._capture_wanted -= 1
                self._captured.notify_all()
        elif self._collect == 'still':
            refused = self._collector.offer(pair)
        else:
            return
        if not refused:
            counts = ', '.join(f'{n}: {len(pair[n].target_id)} targets, {100 * c.fraction:.0f} % of the image covered'
                               for n, c in self._collector.coverage.items())
            self.get_logger().info(f'exposure {len(self._collector.exposures)} collected ({counts})')

    # -- services

    def _on_capture(self, request, response):
        timeout = request.timeout_sec or self._capture_timeout
        with self._lock:
            before = len(self._collector.exposures)
            self._capture_wanted += 1
            done = self._captured.wait_for(
                lambda: len(self._collector.exposures) > before or self._stopping.is_set(), timeout)
            response.exposures = len(self._collector.exposures)
            response.success = done and response.exposures > before
            if response.success:
                number = self._collector.exposures[-1][self._names[0]].number
                response.message = f'frame {number} captured, {response.exposures} exposures now'
            else:
                self._capture_wanted -= 1
                response.message = (f'no frame of all fluoroscopes ({", ".join(self._names)}) came within '
                                    f'{timeout:g} s; frames received: {self._received}')
        return response

    def _on_reset(self, _, response):
        with self._lock:
            count = len(self._collector.exposures)
            self._new_collection()
            self._image_size.clear()
        response.success, response.message = True, f'{count} exposures forgotten, the calibration stays'
        return response

    def _on_save(self, request, response):
        directory = Path(request.directory).expanduser() if request.directory else self._directory
        try:
            if not self._calibrations:
                raise DataError('there is no calibration to save')
            for calibration in self._calibrations.values():
                save_calibration(directory, calibration)
        except (DataError, OSError) as error:
            response.message = f'not saved: {error}'
            self.get_logger().error(response.message)
            return response
        response.success = True
        response.message = f'{", ".join(self._calibrations)} saved to {directory}'
        return response

    def _on_load(self, request, response):
        directory = Path(request.directory).expanduser() if request.directory else self._directory
        try:
            found = self._read_calibrations(directory)
            if not found:
                raise DataError(f'{directory}: there is no calibration of {", ".join(self._names)}')
        except (DataError, OSError) as error:
            response.message = f'not loaded, the running calibration stays: {error}'
            self.get_logger().error(response.message)
            return response
        self._publish(found)
        response.success, response.message = True, f'{", ".join(found)} loaded from {directory}'
        return response

    def _read_calibrations(self, directory):
        return {n: c for n, c in load_calibrations(directory).items() if n in self._names}

    def _load_at_start(self):
        if not self._directory.is_dir():
            return
        try:
            found = self._read_calibrations(self._directory)
        except (DataError, OSError) as error:
            self._last_fault[self._names[0]] = str(error)
            self.get_logger().error(f'no calibration loaded: {error}')
            return
        if found:
            self._publish(found)
            self.get_logger().info(f'calibration of {", ".join(found)} loaded from {self._directory}')

    # -- self-calibration

    def _on_calibrate(self, request, response):
        self._run_job(request, response, lambda *_: None, lambda: False)
        return response

    def _on_action(self, goal):
        result, feedback = SelfCalibrate.Result(), SelfCalibrate.Feedback()

        def progress(label, this):
            feedback.fluoroscope, feedback.iteration = label, this.iteration
            feedback.cost_adjustment, feedback.cost_regression = this.F, this.G
            feedback.k = max(this.k.values())
            feedback.rmse_u, feedback.rmse_v = (float(x) for x in np.sqrt(
                np.mean([np.square(r) for r in this.rmse.values()], axis=0)))
            goal.publish_feedback(feedback)

        cancelled = self._run_job(goal.request, result, progress, lambda: goal.is_cancel_requested)
        if result.success:
            goal.succeed()
        elif cancelled:
            goal.canceled()
        else:
            goal.abort()
        return result

    def _run_job(self, request, result, progress, cancel_requested):
        """Run a job in a thread of its own and fill in result; returns whether it was cancelled."""
        if not self._job_lock.acquire(blocking=False):
            result.message = 'refused: a self-calibration is running already'
            self.get_logger().warning(result.message)
            return False
        cancelled = threading.Event()
        outcome = {}

        def check():
            if cancel_requested() or self._stopping.is_set():
                cancelled.set()
                raise Cancelled

        # The thread keeps the work out of the executor; this callback only waits for it.
        worker = threading.Thread(target=self._work, args=(request, result, progress, check, outcome), daemon=True)
        try:
            worker.start()
            worker.join()
        finally:
            self._busy = ()
            self._job_lock.release()
        if cancelled.is_set():
            result.message = 'cancelled, nothing was changed'
        elif 'fault' in outcome:
            result.message = outcome['fault']
        (self.get_logger().info if result.success else self.get_logger().error)(result.message)
        return cancelled.is_set()

    def _work(self, request, result, progress, check, outcome):
        """The job itself: calibrate, save, publish. Whatever goes wrong, nothing has been changed."""
        def on_round(label, this):
            for name in label.split('+'):
                self._rounds[name] = this
            progress(label, this)

        try:
            with self._lock:
                frames = self._collector.frames(list(request.fluoroscopes))
            self._busy = tuple(frames)
            job = calibrate(frames, self._phantom, self._options_of(request), self._joint and len(frames) > 1,
                            request.principal_distance or None, on_round, check)
            check()
            calibrations = {n: replace(c, seconds=job.seconds) for n, c in job.calibrations.items()}
            for calibration in calibrations.values():
                save_calibration(self._directory, calibration)
            self._publish(calibrations)
            _fill_result(result, job, calibrations)
            for sentence in job.left_out:
                self.get_logger().warning(f'not used: {sentence}')
        except Cancelled:
            pass
        except (DataError, ValueError, OSError) as error:
            outcome['fault'] = str(error)
        except Exception as error:   # a fault of ours must reach the caller, and must not end the node
            self.get_logger().error(f'self-calibration failed: {error!r}')
            outcome['fault'] = f'the self-calibration failed unexpectedly: {error!r}'

    def _options_of(self, request):
        """Options of a request, with the node's parameters where it leaves them open. Raises ValueError."""
        if request.principal_distance < 0 or not np.isfinite(request.principal_distance):
            raise ValueError(f'principal_distance is a length in pixels, not {request.principal_distance}')
        return Options(**{name: getattr(request, name) or default for name, default in self._defaults.items()})

    def _publish(self, calibrations):
        """Take calibrations over and publish them."""
        for name, calibration in calibrations.items():
            self._calibrations[name], self._made_at[name] = calibration, time.monotonic()
            self._calibration_outputs[name].publish(message_from_calibration(calibration))

    # -- status

    def _on_timer(self):
        with self._lock:
            parts = [self._report(name) for name in self._names]
        self._diagnostics.publish(parts)

    def _report(self, name):
        """Publish the status of a fluoroscope; returns its diagnostics."""
        message, calibration = CalibrationStatus(fluoroscope=name), self._calibrations.get(name)
        message.header.stamp = self.get_clock().now().to_msg()
        message.header.frame_id = f'{name}_optical'
        message.state = (CalibrationStatus.CALIBRATING if name in self._busy else
                         CalibrationStatus.CALIBRATED if calibration else CalibrationStatus.COLLECTING)
        message.frames_received, message.frames_rejected = self._received[name], self._rejected[name]
        message.frames_unpaired = self._pairer.unpaired[name]
        message.exposures = len(self._collector.exposures)
        message.observations = sum(len(pair[name].target_id) for pair in self._collector.exposures)
        if name in self._collector.coverage:
            message.coverage = self._collector.coverage[name].fraction
        if name in self._rounds:
            last = self._rounds[name]
            message.iteration, message.k = last.iteration, last.k[name]
            message.cost_adjustment, message.cost_regression = last.F, last.G
            message.rmse_u, message.rmse_v = (float(x) for x in last.rmse[name])
        message.calibration_age = time.monotonic() - self._made_at[name] if calibration else float('nan')
        message.calibration_id = calibration.calibration_id if calibration else ''
        self._status[name].publish(message)
        return (name, *self._verdict(name, message), {
            'exposures': message.exposures, 'coverage': f'{message.coverage:.2f}',
            'frames received': message.frames_received, 'frames rejected': message.frames_rejected,
            'frames unpaired': message.frames_unpaired, 'last fault': self._last_fault[name],
            'calibration': message.calibration_id})

    def _verdict(self, name, status):
        """Level and message of the diagnostics of a fluoroscope."""
        if self.count_publishers(f'{name}/target_observations') == 0 and status.frames_received == 0:
            return support.WARN, 'nobody publishes target observations'
        if status.frames_unpaired:
            return support.WARN, f'{status.frames_unpaired} frames without partner of the other fluoroscopes'
        if status.frames_rejected:
            return support.WARN, f'{status.frames_rejected} frames refused: {self._last_fault[name]}'
        if name in self._busy:
            return support.OK, f'self-calibration running, round {status.iteration}'
        return support.OK, 'calibrated' if name in self._calibrations else 'collecting exposures'

    def stop(self):
        """End what callbacks are waiting for: the node is to go."""
        self._stopping.set()
        with self._captured:
            self._captured.notify_all()

    def destroy_node(self):
        """Take the action server down with the node."""
        self._action.destroy()
        super().destroy_node()


def _fill_result(result, job, calibrations):
    """Fill in a Calibrate response or SelfCalibrate result."""
    result.success, result.seconds = True, job.seconds
    for name, calibration in calibrations.items():
        sd = np.sqrt(np.diagonal(calibration.interior_covariance))
        result.fluoroscope = [*result.fluoroscope, name]
        result.calibration_id = [*result.calibration_id, calibration.calibration_id]
        result.model_kind = [*result.model_kind, calibration.model.kind]
        result.converged = [*result.converged, calibration.converged]
        for field, value in (('k', calibration.model.k), ('iterations', calibration.iterations),
                             ('observations', calibration.observations), ('inliers', calibration.inliers),
                             ('xp', calibration.interior[0]), ('yp', calibration.interior[1]),
                             ('c', calibration.interior[2]), ('sd_xp', sd[0]), ('sd_yp', sd[1]), ('sd_c', sd[2]),
                             ('rmse_before_u', calibration.rmse_before[0]),
                             ('rmse_before_v', calibration.rmse_before[1]),
                             ('rmse_after_u', calibration.rmse_after[0]),
                             ('rmse_after_v', calibration.rmse_after[1])):
            getattr(result, field).append(value if isinstance(value, int) else float(value))
    unsettled = '' if job.converged else ' (stopped at the largest number of rounds, not converged)'
    result.message = f'{", ".join(calibrations)} calibrated in {job.seconds:.1f} s{unsettled}'


def main(args=None):
    """Entry point."""
    support.run(CalibrationNode, lambda: support.ThreadedExecutor(num_threads=8), args)


if __name__ == '__main__':
    main()
