# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Nodes whose work is done by a thread, and which end with it."""

from __future__ import annotations

import threading
import traceback

import rclpy

from ...errors import DataError
from .diagnostics import Trace
from .parameters import ParameterNode


class WorkerNode(ParameterNode):
    """Node that ends after work(), which a thread does after start()."""

    def __init__(self, name: str) -> None:
        super().__init__(name)
        self.stopping = threading.Event()  #: set if the node has to end
        self._worker = threading.Thread(target=self._run, daemon=True)

    def work(self) -> None:
        """Do the work until it is finished or `stopping` is set. Raises DataError."""

    def start(self) -> None:
        """Start the thread."""
        self._worker.start()

    def stop(self) -> None:
        """End the work before the node is destroyed."""
        self.stopping.set()
        self._worker.join(2.0)

    def _run(self) -> None:
        try:
            self.work()
        except Exception as error:
            if rclpy.ok() and not self.stopping.is_set():  # else ended between two messages
                is_fault = isinstance(error, DataError)
                self.fail(str(error) if is_fault else Trace(traceback.format_exc()))
        finally:
            rclpy.try_shutdown()
