"""Calibrations that arrive at a node, each prepared in a thread in parallel to the stream."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable
from typing import Any

from fluoro_calib_msgs.msg import FluoroscopeCalibration
from rclpy.node import Node

from ..calibration import result as calibration_result
from ..errors import DataError
from .messages.fluoroscope_calibration import calibration_from_message
from .runtime.errors import one_line
from .runtime.qos import latched_qos


class CalibrationInput:
    """Subscribes to the calibrations of fluoroscopes and prepares them for use.

    The calibration in use stays until the next one is prepared: a frame sees one or the other. Of
    calibrations that come while one is being prepared, the newest one is next.

    Parameters
    ----------
    node : Node
    names : iterable of str
        Fluoroscopes.
    prepare : callable
        Called with a calibration in the thread; returns what current() returns from then on.
    on_ready : callable
        Called with name and prepared calibration in the thread, once it is in use.
    on_refused : callable
        Called with name and reason where a calibration is refused.
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
        self._threads: dict[str, threading.Thread] = {}
        self._lock = threading.Lock()  # of _next and _threads
        self._subscriptions = [
            node.create_subscription(
                FluoroscopeCalibration,
                f'{name}/calibration',
                lambda message, name=name: self._on_calibration(name, message),
                latched_qos(),
            )
            for name in names
        ]

    def current(self, name: str) -> Any:
        """Return the prepared calibration of a fluoroscope, None before the first one."""
        return self._current[name]

    def close(self) -> None:
        """Unsubscribe, and wait for the calibrations in preparation: they need the node."""
        for subscription in self._subscriptions:
            self._node.destroy_subscription(subscription)
        self._subscriptions = []
        with self._lock:
            self._next.clear()
            running = list(self._threads.values())
        for thread in running:
            thread.join()

    def _on_calibration(self, name: str, message: FluoroscopeCalibration) -> None:
        with self._lock:
            self._next[name] = message
            thread = self._threads.get(name)
            # One thread for each fluoroscope, however many calibrations come.
            if thread is None or not thread.is_alive():
                self._threads[name] = threading.Thread(
                    target=self._work, args=(name,), daemon=True
                )
                self._threads[name].start()

    def _work(self, name: str) -> None:
        while True:
            with self._lock:
                message = self._next.pop(name, None)
                if message is None:
                    self._threads.pop(name, None)
                    return
            self._use(name, message)

    def _use(self, name: str, message: FluoroscopeCalibration) -> None:
        try:
            calibration = calibration_from_message(message)
            if calibration.fluoroscope != name:
                raise DataError(
                    f'the calibration on topic {name}/calibration is of fluoroscope '
                    f'{calibration.fluoroscope}'
                )
            prepared = self._prepare(calibration)
        except Exception as error:  # a message may hold anything, and the stream has to go on
            reason = one_line(error)
            self._node.get_logger().error(
                f'calibration refused, the current one stays in use: {reason}'
            )
            self._on_refused(name, reason)
            return
        self._current[name] = prepared
        self._on_ready(name, prepared)
