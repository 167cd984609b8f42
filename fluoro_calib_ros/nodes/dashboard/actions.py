# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Long-running requests of a dashboard: the calibration node's actions self_calibrate and heal."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

from action_msgs.msg import GoalStatus
from fluoro_calib_msgs.action import Heal, SelfCalibrate
from rclpy.action import ActionClient
from rclpy.node import Node
from rclpy.task import Future

from ..messages.self_calibration import feedback_text, healing_text
from .state import CALIBRATE, CALIBRATE_FAST, HEAL, Diagnosis

NO_ANSWER = (
    'no answer yet; it may be lost: check the state of the rig before you repeat the request'
)


class _Kind(NamedTuple):
    """An action and its texts in the dashboard."""

    name: str  #: name of the request
    client: ActionClient
    job: str  #: text for the running job
    feedback: Callable[[Any], str]


class Actions:
    """Starts the actions, one at a time, and reports their progress and result.

    say appends a line to the log; set_ changes fields of the session state. Both are called in the
    executor's thread as well as in that of the view, which calls request() and cancel().
    """

    def __init__(self, node: Node, say: Callable[[str], None], set_: Callable[..., None]) -> None:
        self._say = say
        self._set = set_
        self._lock = threading.RLock()
        self._goal: Any = None
        self._job = ''
        self._to_cancel = False  # as soon as the goal is accepted
        self._running: _Kind | None = None
        self._sent_at = 0.0
        client = ActionClient(node, SelfCalibrate, 'self_calibrate')
        calibrate = _Kind(CALIBRATE, client, 'calibrating', feedback_text)
        heal = _Kind(HEAL, ActionClient(node, Heal, 'heal'), 'healing', healing_text)
        goal = SelfCalibrate.Goal
        # Kind, goal and text of each request.
        self._requests: dict[str, tuple[_Kind, Any, str]] = {
            CALIBRATE: (calibrate, goal(validate=True), 'calibrate, with verdict ...'),
            CALIBRATE_FAST: (calibrate, goal(validate=False), 'calibrate, without verdict ...'),
            HEAL: (heal, Heal.Goal(), 'heal, from the markers that are seen now ...'),
        }
        self._namespace = node.get_namespace()

    def request(self, action: str) -> None:
        """Start one of CALIBRATE, CALIBRATE_FAST and HEAL."""
        self._start(*self._requests[action])

    def cancel(self) -> None:
        """Cancel the running action, if it was started here."""
        with self._lock:
            if not self._job:
                self._say('cancel: nothing runs that was started here')
                return
            self._to_cancel = self._goal is None
            if self._goal is not None:
                self._goal.cancel_goal_async()
        self._say('cancel ...')

    def _start(self, kind: _Kind, goal: Any, text: str) -> None:
        with self._lock:
            if not kind.client.server_is_ready():
                self._say(f'{kind.name}: no calibration node answers in {self._namespace}')
                return
            if self._job:
                self._say(f'{kind.name}: {self._job} already')
                return
            self._job = kind.job
            self._to_cancel = False
            self._running = kind
            self._sent_at = time.monotonic()
        self._set(job=kind.job)
        self._say(text)
        sent = kind.client.send_goal_async(
            goal, feedback_callback=lambda m: self._set(job=kind.feedback(m.feedback))
        )
        sent.add_done_callback(partial(self._on_goal, kind))

    # -- the executor's thread

    def check(self, before: float) -> None:
        """Give up if the server is gone, or if a goal sent before that time was not accepted."""
        with self._lock:
            kind = self._running
            if kind is None or not self._job:
                return
            if self._goal is None and self._sent_at < before:
                self._end(f'{kind.name}: {NO_ANSWER}')
            elif self._goal is not None and not kind.client.server_is_ready():
                self._end(f'{kind.name} failed: the calibration node has ended')

    def _end(self, text: str, **changes: Any) -> None:
        with self._lock:
            self._goal = None
            self._job = ''
        self._set(job='', **changes)
        self._say(text)

    def _on_goal(self, kind: _Kind, future: Future) -> None:
        handle = future.result()
        if not handle.accepted:
            self._end(f'{kind.name}: refused, the calibration node is busy')
            return
        with self._lock:
            self._goal = handle
            self._job = kind.job  # also if check() gave it up before
            if self._to_cancel:
                handle.cancel_goal_async()
        handle.get_result_async().add_done_callback(partial(self._on_result, kind))

    def _on_result(self, kind: _Kind, future: Future) -> None:
        answer = future.result()
        result = answer.result
        changes = {}
        succeeded = answer.status == GoalStatus.STATUS_SUCCEEDED
        if succeeded and kind.name == HEAL:
            findings = (*result.findings, *result.checks)
            changes['diagnosis'] = Diagnosis(result.verdict, findings, result.orientation_id)
        self._end(f'{kind.name}{"" if succeeded else " failed"}: {result.message}', **changes)
