# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Streams of images: their diagnostics, the queue of exposures, and the extracting workers."""

from __future__ import annotations

import threading
import time
from collections import OrderedDict, deque
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from typing import Generic, TypeVar

import numpy as np
from sensor_msgs.msg import CompressedImage, Image
from std_msgs.msg import Header

from ..exposures.frame import image_size_error
from ..jobs.followers import FollowerSettings, Observations, follower_process
from ..processes import LentArrays, WorkerProcess
from .angle_input import AngleInput
from .messages.image import IMAGE_REFUSALS, ImageConverter
from .runtime import conditions
from .runtime.conditions import StreamState, healthy, warns
from .runtime.diagnostics import Health, Refused
from .runtime.lifecycle import Stream
from .runtime.streams import REMEMBERED


@dataclass
class ImageStream(Stream):
    """Stream of images from which targets are extracted."""

    topic: str = ''  #: one of the topics of the images, for messages
    extracted: int = 0  #: number of images with observations
    followed: int = 0  #: number of those among them that were followed from the previous image
    without: int = 0  #: number of images without observations
    shed: int = 0  #: number of images that were shed unprocessed
    headers: OrderedDict[int, Header] = field(default_factory=OrderedDict)  #: last, by number
    retracted: int = 0  #: number of published ids that were retracted
    last: Observations | None = None  #: observations in the last image
    seconds: float = 0.0  #: total processing time of the images
    #: rate, and number of images shed, between the last two calls of measure()
    rate_hz: float = 0.0
    shed_now: int = 0

    def __post_init__(self) -> None:
        self.converter = ImageConverter(self.name)
        self._first: tuple[tuple[int, int], str] | None = None  # image size and frame id
        # At the last measurement: time, number of processed images, number of shed images.
        self._before = (time.monotonic(), 0, 0)

    def measure(self) -> None:
        """Update the rate and the number of shed images since the last call."""
        now = time.monotonic()
        then, processed, shed = self._before
        count = self.extracted + self.without
        self.rate_hz = (count - processed) / max(now - then, 1e-3)
        self.shed_now = self.shed - shed
        self._before = (now, count, self.shed)

    def decoded(self, message: Image | CompressedImage) -> np.ndarray:
        """Return the image (h, w) of a message. Raises Refused if frame id or size has changed."""
        frame_id = message.header.frame_id
        if self._first is not None and frame_id != self._first[1]:
            raise self.converter.refusal(
                'frame id',
                message,
                f'the frame id is {frame_id!r}, but that of the first image is {self._first[1]!r}',
            )
        image, _ = self.converter.decoded(message)
        size = (image.shape[1], image.shape[0])
        if self._first is None:
            self._first = size, frame_id
        elif error := image_size_error(size, self._first[0], 'the first one is'):
            raise self.converter.refusal('image size', message, error)
        return image

    def count(self, message: Image | CompressedImage, observations: Observations) -> None:
        """Count a processed image, and log what is wrong with it."""
        if not observations.reason:
            self.extracted += 1
            self.followed += observations.followed
        else:
            self.without += 1
            self._note(message, f'no observations: {observations.reason}')
        if observations.note:
            self._note(message, observations.note)
        self.last = observations
        self.seconds += observations.seconds

    def _note(self, message: Image | CompressedImage, text: str) -> None:
        self.refusals.note(str(self.converter.refusal('', message, text)))

    def values(self, waiting: int) -> dict[str, object]:
        """Return the values for the diagnostics; waiting: number of waiting images."""
        last = self.last or Observations()
        processed = self.extracted + self.without
        return {
            'images received': self.received,
            'images extracted': self.extracted,
            'images followed': self.followed,
            'images without observations': self.without,
            'images waiting': waiting,
            'images shed': self.shed,
            **self.refusals.values(IMAGE_REFUSALS),
            'last fault': self.refusals.last_fault,
            'targets': len(last.target_id),
            'targets expected': last.expected,
            'found [%]': f'{100 * last.found:.1f}',
            'explained [%]': f'{100 * last.explained:.1f}',
            'overlapped': int(last.overlapped.sum()),
            'doubtful': last.doubtful,
            'ids retracted': self.retracted,
            'refusal of the last image': last.reason,
            'rate [Hz]': f'{self.rate_hz:.1f}',
            'time of an image [ms]': f'{1e3 * self.seconds / max(processed, 1):.0f}',
        }


@dataclass(frozen=True)
class ImageState(StreamState):
    """State from which the health of an image stream is diagnosed."""

    stream: ImageStream
    angles: AngleInput


def unknown_angle(state: ImageState) -> Health | None:
    """Warn if the angle of the C-arm is needed but unknown."""
    health = state.angles.health(state.stream.name, state.node.incompatible)
    return health and health.with_consequence(
        'markers are predicted by the mean correction over all angles'
    )


CONDITIONS = (
    conditions.lost_messages,
    conditions.incompatible_publisher,
    conditions.inactive_node,
    conditions.no_publisher,
    conditions.stalled_stream,
    conditions.overrun_input,
    warns(
        lambda state: (
            state.stream.shed_now
            and f'images come faster than they are extracted: {state.stream.shed} were shed'
        )
    ),
    warns(
        lambda state: (
            state.stream.last
            and state.stream.last.reason
            and f'no observations in the last image: {state.stream.last.reason}'
        )
    ),
    unknown_angle,
    conditions.refused_messages,
    healthy('extracting'),
)


T = TypeVar('T')

LATE = 3  # maximum delay of a view behind the others, in exposures


class ExposureQueue(Generic[T]):
    """Items of each fluoroscope that wait for its thread, at most `size` of them.

    If more would wait, the oldest exposure that no thread has begun is shed for all fluoroscopes:
    a reconstruction cannot use views of different exposures.
    """

    def __init__(self, fluoroscopes: Iterable[str], size: int) -> None:
        self._size = size
        self._waiting: dict[str, OrderedDict[int, T]] = {n: OrderedDict() for n in fluoroscopes}
        self._begun: deque[int] = deque(maxlen=REMEMBERED)
        self._shed: deque[int] = deque(maxlen=REMEMBERED)
        # Last exposure that get() returned for several fluoroscopes together, by fluoroscope.
        self._given: dict[str, int] = {}
        self._changed = threading.Condition()
        self._closed = False

    def put(self, fluoroscope: str, number: int, item: T) -> list[str]:
        """Add an item; return the fluoroscopes that have lost one."""
        with self._changed:
            waiting = self._waiting[fluoroscope]
            if number in self._shed or number <= self._given.get(fluoroscope, -1):
                return [fluoroscope]
            lost = [fluoroscope] if number in waiting else []  # the number is reused
            waiting[number] = item
            if len(waiting) > self._size:
                lost += self._shed_one(waiting)
            self._changed.notify_all()
            return lost

    def get(
        self, fluoroscopes: Collection[str], patience_s: float = 0.0
    ) -> tuple[int, dict[str, T]] | None:
        """Wait for the lowest waiting exposure and return its number and items; None once closed.

        Waits for items of the other fluoroscopes while they may still come, at most patience_s.
        """
        views = {name: self._waiting[name] for name in fluoroscopes}
        with self._changed:
            self._changed.wait_for(lambda: self._closed or any(views.values()))
            self._changed.wait_for(lambda: self._closed or _is_complete(views), patience_s)
            if self._closed:
                return None
            number = _lowest(views)
            self._begun.append(number)
            if len(views) > 1:
                self._given.update(dict.fromkeys(views, number))
            return number, {n: items.pop(number) for n, items in views.items() if number in items}

    @property
    def closed(self) -> bool:
        """Whether the queue is closed."""
        return self._closed

    def waiting(self, fluoroscope: str) -> int:
        """Return the number of waiting items of a fluoroscope."""
        return len(self._waiting[fluoroscope])

    def close(self) -> None:
        """End all waits; waiting items are lost."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()

    def _shed_one(self, full: OrderedDict[int, T]) -> list[str]:
        """Remove an exposure; return the fluoroscopes that have lost an item."""
        fresh = [number for number in full if number not in self._begun]
        if not fresh:
            full.popitem(last=False)
            return [name for name, items in self._waiting.items() if items is full]
        self._shed.append(fresh[0])
        lost = [name for name, items in self._waiting.items() if fresh[0] in items]
        for name in lost:
            del self._waiting[name][fresh[0]]
        return lost


def _lowest(views: Mapping[str, Mapping[int, object]]) -> int:
    """Return the lowest waiting exposure number."""
    return min(number for items in views.values() for number in items)


def _is_complete(views: Mapping[str, Mapping[int, object]]) -> bool:
    """Return whether the lowest waiting exposure has all items that can be expected."""
    number = _lowest(views)
    # A fluoroscope with a later exposure has lost this one. Do not wait for a fluoroscope that is
    # several exposures late.
    overdue = any(number in items and len(items) > LATE for items in views.values())
    return overdue or all(number in items or items for items in views.values())


PATIENCE_S = 5.0  # longest wait for the other views of an exposure, unless LATE exposures arrive


@dataclass(frozen=True)
class Task:
    """Image that waits for extraction.

    Its number, message, time of arrival [ns, system clock], and angle of the C-arm [rad].
    """

    number: int
    message: Image | CompressedImage
    received_ns: int
    angle: float | None = None


class ExtractionWorkers:
    """One process per follower, and the threads that pass images to the processes.

    queue_size: maximum number of waiting images of a fluoroscope. wanted: called with a
    fluoroscope; returns whether its overlay is wanted. finish: called in the threads with stream,
    task, image and the observations found in it.
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

    def start(self, followers: Sequence[FollowerSettings]) -> None:
        """Start the processes and threads."""
        for follower in followers:
            process = follower_process(follower)
            process.start()
            thread = threading.Thread(
                target=self._serve,
                args=(follower.names, process),
                name=follower.names[0],
                daemon=True,
            )
            thread.start()
            self._processes.append(process)
            self._threads.append(thread)

    def put(self, name: str, task: Task) -> None:
        """Queue an image; if too many wait, the oldest exposure is shed."""
        for fluoroscope in self._queue.put(name, task.number, task):
            self._streams[fluoroscope].shed += 1

    def waiting(self, name: str) -> int:
        """Return the number of waiting images of a fluoroscope."""
        return self._queue.waiting(name)

    def close(self) -> None:
        """End threads and processes; waiting images are lost."""
        self._queue.close()
        for process in self._processes:
            process.close()
        for thread in self._threads:
            thread.join()

    def _serve(self, names: Collection[str], process: WorkerProcess) -> None:
        """Extract the images of the given fluoroscopes, exposure by exposure."""
        with closing(LentArrays()) as lent:
            while (exposure := self._queue.get(names, PATIENCE_S)) is not None:
                number, tasks = exposure
                try:
                    self._extract(number, tasks, process, lent)
                except Exception as error:  # this exposure is lost, the next ones are not
                    if self._queue.closed:
                        return  # the process has been ended
                    for name in tasks:
                        stream = self._streams[name]
                        stream.refusals.fail(stream.topic, error)

    def _extract(
        self, number: int, tasks: Mapping[str, Task], process: WorkerProcess, lent: LentArrays
    ) -> None:
        """Extract the images of an exposure in the process."""
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
        arguments = {name: lent.lend(name, image) for name, image in images.items()}
        for name, observations in process(arguments, number, wanted, angles).items():
            self._finish(self._streams[name], tasks[name], images[name], observations)
