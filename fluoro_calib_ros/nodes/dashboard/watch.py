# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The program fluoro-calib watch: a dashboard that listens to nodes and calls their services."""

from __future__ import annotations

import argparse
import math
import sys
import threading
import time
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from fluoro_calib_msgs.msg import CalibrationStatus
from fluoro_calib_msgs.srv import Capture, Orient, Reset
from rclpy.clock import Clock, ClockType
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from rclpy.task import Future

from ..runtime.main import spin
from .actions import NO_ANSWER, Actions
from .state import (
    ACCEPT,
    CALIBRATE,
    CALIBRATE_FAST,
    CANCEL,
    CAPTURE,
    HEAL,
    LEVELS,
    ORIENT,
    RESET,
    ROLL_BACK,
    Diagnosis,
    FluoroscopeState,
    NodeState,
    RateMeter,
    SessionState,
    worst_verdict,
)

NODES = (
    'calibration_node',
    'extraction_node',
    'correction_node',
    'reconstruction_node',
    'image_node',
)
SILENT_S = 5.0  # a node reports once a second
ANSWER_S = 10.0  # capture and orient wait for 5 s unless the parameter capture_timeout says more
STATES = {
    CalibrationStatus.COLLECTING: 'collecting',
    CalibrationStatus.CALIBRATING: 'calibrating',
    CalibrationStatus.CALIBRATED: 'calibrated',
}


class SessionClient(Node):
    """Listens to the nodes of a namespace; implements the Session of the view.

    Callbacks run in the executor's thread, state() and request() in that of the view; a lock
    protects the shared data.
    """

    def __init__(self, namespace: str | None = None, context: Context | None = None) -> None:
        super().__init__('watch', namespace=namespace, context=context)
        self._lock = threading.RLock()
        self._fluoroscopes: dict[str, FluoroscopeState] = {}
        self._followed: set[str] = set()
        # state and when it was heard, by node, then by function
        self._functions: dict[str, dict[str, tuple[NodeState, float]]] = {}
        self._meters: dict[tuple[str, str], RateMeter] = {}
        self._lines: deque[str] = deque(maxlen=50)
        self._session = SessionState(self.get_namespace())
        self._points_at: tuple[float, float] | None = None  # reconstructed exposures, last change
        self.create_subscription(DiagnosticArray, '/diagnostics', self._on_diagnostics, 50)
        requests = {
            CAPTURE: (Capture, Capture.Request()),
            ORIENT: (Orient, Orient.Request(frames=10)),
            **dict.fromkeys((RESET, ACCEPT, ROLL_BACK), (Reset, Reset.Request())),
        }
        self._callers = {
            name: (self.create_client(kind, name), request)
            for name, (kind, request) in requests.items()
        }
        self._actions = Actions(self, self.log, self._set)
        self._asked: dict[Future, tuple[str, float]] = {}  # request, time it was made
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self.create_timer(1.0, self._check_answers, clock=steady)

    # -- the view's thread

    def state(self) -> SessionState:
        """Return the current state."""
        with self._lock:
            level, drift = self._drift_now()
            verdict, findings = worst_verdict(self._fluoroscopes.values())
            return replace(
                self._session,
                verdict=verdict,
                findings=findings,
                drift_level=level,
                drift=drift,
                fluoroscopes=tuple(v for _, v in sorted(self._fluoroscopes.items())),
                nodes=tuple(self._node_states()),
                log=tuple(self._lines),
            )

    def _drift_now(self) -> tuple[str, str]:
        """Return level and text of the drift; if the stream has ended, the drift is unknown."""
        level = self._session.drift_level
        drift = self._session.drift
        idle_s = 0.0 if self._points_at is None else time.monotonic() - self._points_at[1]
        if not drift or idle_s <= SILENT_S:
            return level, drift
        return '', f'not watched: no exposure for {idle_s:.0f} s (before: {drift})'

    def request(self, action: str) -> None:
        """Start one of REQUESTS; the answer is added to the log."""
        with self._lock:
            if action in (CALIBRATE, CALIBRATE_FAST, HEAL):
                self._actions.request(action)
            elif action == CANCEL:
                self._actions.cancel()
            else:
                self._call(action)

    def _call(self, action: str) -> None:
        client, request = self._callers[action]
        if not client.service_is_ready():
            self.log(f'{action}: no calibration node answers in {self.get_namespace()}')
            return
        self.log(f'{action.replace("_", " ")} ...')
        future = client.call_async(request)
        self._asked[future] = action, time.monotonic()
        future.add_done_callback(partial(self._on_answer, action))

    # -- the executor's thread

    def _check_answers(self) -> None:
        """Report unanswered requests: answers get lost when a node ends or has just started."""
        earliest = time.monotonic() - ANSWER_S
        with self._lock:
            for future, (action, requested_at) in list(self._asked.items()):
                if requested_at < earliest:
                    del self._asked[future]
                    self.log(f'{action.replace("_", " ")}: {NO_ANSWER}')
            self._actions.check(earliest)

    def _on_answer(self, action: str, future: Future) -> None:
        with self._lock:
            self._asked.pop(future, None)
        answer = future.result()
        suffix = '' if answer.success else ' failed'
        if answer.success and action in (ACCEPT, ROLL_BACK):
            self._set(diagnosis=Diagnosis())
        self.log(f'{action.replace("_", " ")}{suffix}: {answer.message}')

    def _on_status(self, message: CalibrationStatus) -> None:
        rmse = (message.rmse_u, message.rmse_v)
        with self._lock:
            self._update(
                message.fluoroscope,
                state=STATES.get(message.state, ''),
                frames=message.frames_received,
                exposures=message.exposures,
                coverage=message.coverage,
                rejected=message.frames_rejected,
                iteration=message.iteration,
                rmse_px=rmse if message.iteration else (float('nan'),) * 2,
                calibration_id=message.calibration_id,
                age_s=message.calibration_age,
            )

    def _on_diagnostics(self, array: DiagnosticArray) -> None:
        now = time.monotonic()
        stamp_s = array.header.stamp.sec + 1e-9 * array.header.stamp.nanosec
        prefix = self.get_namespace().rstrip('/') + '/'
        with self._lock:
            for status in array.status:
                node, _, function = status.name.removeprefix(prefix).partition(': ')
                if not status.name.startswith(prefix) or node not in NODES:
                    continue
                level = LEVELS[min(int.from_bytes(status.level, 'little'), 2)]
                functions = self._functions.setdefault(node, {})
                functions[function] = NodeState(function, level, status.message), now
                values = {value.key: value.value for value in status.values}
                if function == 'drift':
                    self._set(drift_level=level, drift=status.message)
                self._read(node, function, values, stamp_s)

    def _read(self, node: str, function: str, values: dict[str, str], stamp_s: float) -> None:
        """Copy the values of a diagnostic status into the session state."""
        received = values.get('frames received')
        corrected = values.get('frames corrected')
        if node == 'calibration_node' and received is not None:  # the status of a fluoroscope
            self._follow(function)
            self._set(results=values.get('calibration directory', ''))
            self._update(
                function,
                frames_hz=self._rate(node, function, received, stamp_s),
                next_pose=values.get('next pose', ''),
                ready=values.get('ready') == 'True',
                verdict=values.get('verdict', ''),
                findings=tuple(values.get('findings of the verdict', '').splitlines()),
            )
        elif node == 'correction_node' and corrected is not None:
            self._update(
                function,
                corrected_hz=self._rate(node, function, corrected, stamp_s),
                latency_p50_ms=_number(values.get('latency p50 [ms]')),
                latency_p99_ms=_number(values.get('latency p99 [ms]')),
            )
        elif function == 'reconstruction':
            count = values.get('exposures reconstructed')
            exposures = _number(count)
            if math.isfinite(exposures) and (self._points_at or (None,))[0] != exposures:
                self._points_at = exposures, time.monotonic()
            self._set(
                points_hz=self._rate(node, function, count, stamp_s),
                points_latency_ms=(
                    _number(values.get('latency p50 [ms]')),
                    _number(values.get('latency p99 [ms]')),
                ),
                orientation=values.get('source of the orientation', ''),
                orientation_id=values.get('orientation', ''),
            )

    def _follow(self, name: str) -> None:
        """Subscribe to the status of a fluoroscope, once."""
        if name not in self._followed:
            self._followed.add(name)
            self.create_subscription(
                CalibrationStatus, f'{name}/calibration_status', self._on_status, 10
            )

    def _rate(self, node: str, function: str, count: str | None, stamp_s: float) -> float:
        meter = self._meters.setdefault((node, function), RateMeter())
        if math.isfinite(_number(count)):
            meter.add(stamp_s, _number(count))
        return meter.hz

    def _update(self, name: str, **changes: Any) -> None:
        state = self._fluoroscopes.get(name, FluoroscopeState(name))
        self._fluoroscopes[name] = replace(state, **changes)

    def _set(self, **changes: Any) -> None:
        with self._lock:
            self._session = replace(self._session, **changes)

    def log(self, text: str) -> None:
        """Add a line to the log of the session."""
        with self._lock:
            self._lines.append(f'{time.strftime("%H:%M:%S")}  {text}')

    def _node_states(self) -> Iterator[NodeState]:
        """Yield the worst level of every node, with its message."""
        now = time.monotonic()
        for node, functions in sorted(self._functions.items()):
            silent_s = now - max(heard_at for _, heard_at in functions.values())
            if silent_s > SILENT_S:
                yield NodeState(node, 'silent', f'no message for {silent_s:.0f} s')
                continue
            current = [state for state, at in functions.values() if now - at <= SILENT_S]
            worst = max(current, key=lambda f: LEVELS.index(f.level))
            several = len(current) > 1 and worst.level != 'ok'
            message = f'{worst.name}: {worst.message}' if several else worst.message
            yield NodeState(node, worst.level, message)


def _number(text: str | None) -> float:
    with suppress(TypeError, ValueError):
        return float(text)  # type: ignore[arg-type]
    return float('nan')


@contextmanager
def session_client(arguments: list[str]) -> Iterator[SessionClient]:
    """Run a SessionClient in a thread. arguments: ROS arguments, such as a namespace."""
    rclpy.init(args=arguments, signal_handler_options=SignalHandlerOptions.NO)
    client = SessionClient()
    executor = SingleThreadedExecutor()
    executor.add_node(client)
    ended = threading.Event()
    thread = threading.Thread(target=spin, args=(executor, ended, client.log), daemon=True)
    thread.start()
    try:
        yield client
    finally:
        ended.set()
        executor.create_task(lambda: None)  # makes spin_once return
        thread.join(2.0)
        executor.shutdown()
        client.destroy_node()
        rclpy.try_shutdown()


def main(args: Sequence[str] | None = None) -> None:
    """Show the session in the terminal or a browser until the user quits; --once prints it."""
    parser = argparse.ArgumentParser('fluoro-calib watch')
    parser.add_argument('--once', action='store_true')
    parser.add_argument('--web', action='store_true')
    parser.add_argument('--host', default='127.0.0.1')
    parser.add_argument('--port', type=int, default=8080)
    parser.add_argument('--mas', type=float, default=0.0)
    parser.add_argument('--dicom', type=Path)
    options, ros_arguments = parser.parse_known_args(args)
    is_terminal = sys.stdin.isatty() and sys.stdout.isatty()
    if not options.once and not options.web and not is_terminal:
        sys.exit('fluoro-calib watch: this is not a terminal; use --once to print the state')
    with session_client(ros_arguments) as client:
        if options.once:
            _print(client)
        elif options.web:
            from .scene import Scene
            from .web import WebOptions, serve

            scene = Scene(client.get_namespace())
            web_options = WebOptions(
                options.host, options.port, mas=options.mas, dicom=options.dicom
            )
            serve(client, scene, web_options)
        else:
            from .terminal import Dashboard

            Dashboard(client).run()


def _print(client: SessionClient) -> None:
    """Print the state once, after waiting for the first reports."""
    from rich.console import Console

    from .terminal import session_text

    time.sleep(SILENT_S)
    state = client.state()
    Console().print(session_text(state))
    if not state.nodes:
        sys.exit(
            f'fluoro-calib watch: no node has reported in the namespace {state.namespace} within '
            f'{SILENT_S:g} s'
        )
