# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Threads and processes that extract the images of an extraction node."""

from __future__ import annotations

import threading
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from sensor_msgs.msg import CompressedImage, Image

from ..jobs.live_extraction import MakeFollower, Observations, follower_process
from ..processes import WorkerProcess
from .image_stream import ImageStream
from .runtime.diagnostics import Refused
from .runtime.exposure_queue import ExposureQueue

PATIENCE_S = 5.0  # with the other view of an exposure, unless the next one comes before


@dataclass(frozen=True)
class Task:
    """An image that waits.

    Its number, message, when it has arrived [ns, system clock], and the angle of the C-arm [rad].
    """

    number: int
    message: Image | CompressedImage
    received_ns: int
    angle: float | None = None


class ExtractionWorkers:
    """A process for each follower, and the thread that gives it images.

    Parameters
    ----------
    streams : mapping of str to ImageStream
    queue_size : int
        Images of a fluoroscope that may wait.
    wanted : callable
        Called with a fluoroscope; returns whether its overlay is wanted.
    finish : callable
        Called with stream, task, image and what was found in it, in the threads.
    """

    def __init__(
        self,
        streams: Mapping[str, ImageStream],
        queue_size: int,
        wanted: Callable[[str], bool],
        finish: Callable[[ImageStream, Task, np.ndarray, Observations], None],
    ) -> None:
        self._streams = streams
        self._wanted = wanted
        self._finish = finish
        self._queue: ExposureQueue[Task] = ExposureQueue(streams, queue_size)
        self._threads: list[threading.Thread] = []
        self._processes: list[WorkerProcess] = []

    def start(self, followers: Sequence[MakeFollower]) -> None:
        """Start the processes, and the threads."""
        for make in followers:
            process = follower_process(make)
            process.start()
            thread = threading.Thread(
                target=self._serve, args=(make.names, process), name=make.names[0], daemon=True
            )
            thread.start()
            self._processes.append(process)
            self._threads.append(thread)

    def put(self, name: str, task: Task) -> None:
        """Let an image wait; the oldest exposure is shed where too many do."""
        for loser in self._queue.put(name, task.number, task):
            self._streams[loser].shed += 1

    def waiting(self, name: str) -> int:
        """Return how many images of a fluoroscope wait."""
        return self._queue.waiting(name)

    def close(self) -> None:
        """End threads and processes; what is waiting is lost."""
        self._queue.close()
        for process in self._processes:
            process.close()
        for thread in self._threads:
            thread.join()

    def _serve(self, names: Collection[str], process: WorkerProcess) -> None:
        """Extract the images of some fluoroscopes, exposure by exposure."""
        while (exposure := self._queue.get(names, PATIENCE_S)) is not None:
            number, tasks = exposure
            try:
                self._extract(number, tasks, process)
            except Exception as error:  # this exposure is lost, the next ones are not
                if self._queue.closed:
                    return  # the process has been ended
                for name in tasks:
                    stream = self._streams[name]
                    stream.refusals.fail(stream.topic, error)

    def _extract(self, number: int, tasks: Mapping[str, Task], process: WorkerProcess) -> None:
        """Extract the images of an exposure in a process."""
        images = {}
        for name, task in tasks.items():
            try:
                images[name] = self._streams[name].decoded(task.message)
            except Refused as error:
                self._streams[name].refusals.refuse(error)
        if not images:
            return
        wanted = [name for name in images if self._wanted(name)]
        angles = {name: tasks[name].angle for name in images}
        for name, found in process(images, number, wanted, angles).items():
            self._finish(self._streams[name], tasks[name], images[name], found)
