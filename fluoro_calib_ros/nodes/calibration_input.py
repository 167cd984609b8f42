# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Calibrations received by a node, prepared in a thread in parallel to the stream."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable
from typing import Any

from fluoro_calib_msgs.msg import FluoroscopeCalibration
from rclpy.node import Node

from ..correction import fluoroscope_calibration as calibration_result
from ..errors import DataError
from ..limits import read_limits
from .messages.fluoroscope_calibration import (
    calibration_from_message,
    decode_fluoroscope_calibration,
    message_from_calibration,
)
from .runtime.diagnostics import one_line
from .runtime.streams import DECODING_ERRORS
from .runtime.topics import latched_qos, publisher_conflict

# Number of release() calls after which an undisputed calibration is used although a second node is
# seen, which may have died.
HOLD_TICKS = 3
# Locked while a calibration is prepared: one at a time, also of inputs closed meanwhile.
_PREPARING = threading.Lock()


class CalibrationInput:
    """Subscribes to the calibrations of fluoroscopes and prepares them for use.

    The current calibration stays in use until the next one is prepared, so each frame sees exactly
    one of them. If several calibrations arrive during a preparation, only the newest is prepared
    next. Calibrations of several fluoroscopes that arrive together come into use together, because
    views with calibrations of different rigs give no points. While two calibration nodes serve the
    same fluoroscope, their calibrations are held back until release() finds only one node.

    Parameters
    ----------
    node : Node
    names : iterable of str
        Fluoroscopes.
    prepare : callable
        Called with a calibration in the thread; its result is what current() returns from then on.
        It must not need the node, which may be destroyed meanwhile.
    on_ready : callable
        Called in the thread with name and prepared calibration, once it is in use.
    on_refused : callable
        Called with name and reason if a calibration is refused.
    """

    def __init__(
        self,
        node: Node,
        names: Iterable[str],
        prepare: Callable[[calibration_result.FluoroscopeCalibration], Any],
        on_ready: Callable[[str, Any], None],
        on_refused: Callable[[str, str], None],
    ) -> None:
        self._node = node
        self._prepare = prepare
        self._on_ready = on_ready
        self._on_refused = on_refused
        names = tuple(names)
        self._current: dict[str, Any] = dict.fromkeys(names)
        self._next: dict[str, FluoroscopeCalibration] = {}
        self._ready: dict[str, Any] = {}  # prepared, but waiting for others
        self._thread: threading.Thread | None = None  # that prepares them, one after the other
        self._held: dict[str, dict[str, FluoroscopeCalibration]] = {name: {} for name in names}
        self._patience = dict.fromkeys(names, 0)
        # Protects _next, _ready, _thread, _closed and the use of the node.
        self._lock = threading.Lock()
        self._closed = False
        self._subscriptions = [
            node.create_subscription(
                FluoroscopeCalibration,
                f'{name}/calibration',
                lambda data, name=name: self._on_data(name, data),
                latched_qos(),
                raw=True,
            )
            for name in names
        ]

    def current(self, name: str) -> Any:
        """Return the prepared calibration of a fluoroscope, or None before the first one."""
        return self._current[name]

    def close(self) -> None:
        """Unsubscribe, and discard a calibration still in preparation, which may take long."""
        for subscription in self._subscriptions:
            self._node.destroy_subscription(subscription)
        self._subscriptions = []
        with self._lock:
            self._closed = True
            self._next.clear()
            self._ready.clear()

    def begin_with(
        self, name: str, calibration: calibration_result.FluoroscopeCalibration
    ) -> None:
        """Use a calibration loaded from a file until another one arrives."""
        self._start(name, message_from_calibration(calibration))

    def conflict(self, name: str) -> str:
        """Return a message if several calibration nodes serve a fluoroscope, else ''."""
        return publisher_conflict(self._node, f'{name}/calibration_status')

    def release(self) -> None:
        """Use the newest held-back calibration of each fluoroscope that has one calibration node.

        To be called once a second. If a fluoroscope has no calibration yet and only one is held
        back, it is used after HOLD_TICKS calls even while a second node is seen, which may have
        died.
        """
        for name, held in self._held.items():
            if not held:
                continue
            self._patience[name] -= 1
            has_one_node = not self.conflict(name)
            undisputed = self._current[name] is None and len(held) == 1
            if has_one_node or (undisputed and self._patience[name] <= 0):
                self._start(name, list(held.values())[-1])
                held.clear()

    def _on_data(self, name: str, data: bytes) -> None:
        """Decode a message, unless it is too large."""
        max_bytes = read_limits().max_calibration_bytes
        if len(data) > max_bytes:
            self._refuse(
                name,
                f'the message has {len(data) / 1e6:.0f} MB, calibrations of more than '
                f'{max_bytes / 1e6:.0f} MB are not read',
            )
            return
        try:
            message = decode_fluoroscope_calibration(data)
        except DECODING_ERRORS:
            self._refuse(name, f'the message on topic {name}/calibration cannot be decoded')
            return
        self._on_calibration(name, message)

    def _refuse(self, name: str, reason: str) -> None:
        self._node.get_logger().error(
            f'calibration refused, the current one stays in use: {reason}'
        )
        self._on_refused(name, reason)

    def _on_calibration(self, name: str, message: FluoroscopeCalibration) -> None:
        if self.conflict(name):
            self._held[name].pop(message.calibration_id, None)
            self._held[name][message.calibration_id] = message
            self._patience[name] = HOLD_TICKS
            return
        self._held[name].clear()
        self._start(name, message)

    def _start(self, name: str, message: FluoroscopeCalibration) -> None:
        """Prepare a calibration in a thread."""
        with self._lock:
            self._next[name] = message
            if self._thread is None or not self._thread.is_alive():
                self._thread = threading.Thread(target=self._work, daemon=True)
                self._thread.start()

    def _work(self) -> None:
        while True:
            with _PREPARING:
                with self._lock:
                    if not self._next:
                        self._thread = None
                        return
                    name = next(iter(self._next))
                    message = self._next.pop(name)
                self._use(name, message)

    def _use(self, name: str, message: FluoroscopeCalibration) -> None:
        """Prepare a calibration, and use it together with those that arrived with it."""
        prepared = self._prepared(name, message)
        with self._lock:
            if self._closed:
                return
            if prepared is not None:
                self._ready[name] = prepared
            # Wait for fluoroscopes with nothing prepared, but not for a newer calibration of the
            # others: there may be no end of them.
            if self._next.keys() <= self._ready.keys():
                ready, self._ready = self._ready, {}
                self._current = {**self._current, **ready}
                for ready_name in ready:
                    self._on_ready(ready_name, ready[ready_name])

    def _prepared(self, name: str, message: FluoroscopeCalibration) -> Any:
        """Return the prepared calibration, or None if it is refused."""
        try:
            calibration = calibration_from_message(message)
            if calibration.fluoroscope != name:
                raise DataError(
                    f'the calibration on topic {name}/calibration is of fluoroscope '
                    f'{calibration.fluoroscope}'
                )
            self._node.get_logger().info(
                f'fluoroscope {name}: calibration {calibration.calibration_id} is being prepared'
            )
            return self._prepare(calibration)
        except Exception as error:  # a message may contain anything, and the stream must go on
            with self._lock:
                if not self._closed:
                    self._refuse(name, one_line(error))
            return None
