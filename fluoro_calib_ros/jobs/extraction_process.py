# Copyright 2026 fluoro_calib_ros maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""A live extractor in a process of its own."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from contextlib import suppress
from multiprocessing.connection import Connection
from multiprocessing.context import SpawnProcess

import cv2
import numpy as np
from threadpoolctl import threadpool_limits

from .live_extraction import LiveObservations, MakeExtractor
from .parent_watch import end_with_parent

NICE = 5  # lower priority than the live nodes, higher than a calibration

END_S = 1.0  # in which a process that has closed its connection ends


class ExtractionProcess:
    """Extracts the images of one fluoroscope in another process.

    One thread calls extract(), any may call close(). After a failure the next call starts a new
    process, which begins from nothing.

    Parameters
    ----------
    make : callable
        Makes the extractor in the process; it has to be picklable.
    """

    def __init__(self, make: MakeExtractor) -> None:
        self._make = make
        self._lock = threading.Lock()
        self._closed = False
        self._process: SpawnProcess | None = None
        self._connection: Connection | None = None

    def start(self) -> None:
        """Start the process, so that it is ready for the first image."""
        with self._lock:
            if self._process is not None or self._closed:
                return
            context = multiprocessing.get_context('spawn')  # a fork would copy locks of threads
            self._connection, other = context.Pipe()
            self._process = context.Process(
                target=_work, daemon=True, args=(other, self._make, os.getpid())
            )
            # The process inherits the mask: an interrupt from the keyboard only reaches the
            # caller, which terminates the process.
            masked = signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])
            self._process.start()
            signal.pthread_sigmask(signal.SIG_SETMASK, masked)
            other.close()

    def extract(self, image: np.ndarray, number: int, overlay: bool = False) -> LiveObservations:
        """Return what is found in the image (h, w) of an exposure.

        Raises RuntimeError where the extractor or its process fails.
        """
        self.start()
        connection = self._connection
        if connection is None:
            raise RuntimeError('the extraction was ended')
        try:
            connection.send((image, number, overlay))
            answer = connection.recv()
        except (EOFError, OSError):
            status = self._end(END_S)
            raise RuntimeError(f'the extraction process ended with status {status}') from None
        if isinstance(answer, BaseException):
            raise RuntimeError(f'the extraction failed: {answer!r}') from answer
        return answer

    def close(self) -> None:
        """End the process, also while it extracts; extract() then raises RuntimeError."""
        self._closed = True
        self._end(0)

    def _end(self, patience_s: float) -> int | None:
        """End the process, by force where it does not end itself; returns its exit status."""
        with self._lock:
            process = self._process
            self._process = None
            self._connection = None
        if process is None:
            return None
        process.join(patience_s)
        process.terminate()
        process.join()
        return process.exitcode


def _work(connection: Connection, make: MakeExtractor, parent: int) -> None:
    """Answer images until the caller has closed the connection or has died."""
    os.nice(NICE)
    cv2.setNumThreads(1)
    threading.Thread(target=end_with_parent, args=(parent,), daemon=True).start()
    with suppress(EOFError, OSError), threadpool_limits(1):
        extractor = make()
        while True:
            image, number, overlay = connection.recv()
            try:
                connection.send(extractor.extract(image, number, overlay))
            except Exception as error:  # a bug: this image is lost, the next one is not
                connection.send(RuntimeError(repr(error)))
