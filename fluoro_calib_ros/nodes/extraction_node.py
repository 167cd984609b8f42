# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Node that finds the beads of the phantom, or markers, in the images of the fluoroscopes, live.

One thread receives the images and numbers them; each fluoroscope has a thread and a process of its
own that extracts. Where images come faster than they are extracted, whole exposures are shed.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from fluoro_calib_msgs.msg import TargetObservations
from rclpy.publisher import Publisher
from sensor_msgs.msg import CompressedImage, Image

from ..drift.clusters import Cluster, parse_clusters
from ..errors import DataError
from ..exposures.angles import AngleOptions
from ..exposures.frame import Frame
from ..exposures.numbering import ExposureNumbers
from ..exposures.pairing import PairingOptions
from ..files.rig_orientation import load_orientation, orientation_path
from ..jobs.live_extraction import (
    LiveObservations,
    MakeExtractor,
    PhantomSettings,
    extraction_process,
)
from ..jobs.live_markers import MarkerSettings, PairSettings, pair_process
from ..jobs.reconstruction import check_orientation
from ..jobs.service_process import ServiceProcess
from ..jobs.sources import read_calibrations, read_source, read_survey
from ..options import option
from ..radiographs.markers import FirstMarkers, MarkerOptions
from .angle_input import AngleInput
from .image_node import INPUTS
from .messages.fields import NS_PER_S
from .messages.image import (
    IMAGE_REFUSALS,
    ImageConverter,
    message_from_image,
    use_single_thread,
)
from .messages.target_observations import message_from_frame
from .runtime.diagnostics import OK, WARN, LatencyWindow, Status
from .runtime.errors import StartError
from .runtime.exposure_queue import ExposureQueue
from .runtime.lifecycle import StreamNode
from .runtime.logging import RateLimitedLogger
from .runtime.main import run
from .runtime.parameters import (
    READ_LIMITS,
    ManagedParameters,
    ParameterGroup,
    declare_read_limits,
    expand_path,
)
from .runtime.qos import images_qos, observations_qos
from .runtime.refusals import RefusalLog, Refused
from .runtime.stall import StallDetector
from .runtime.stream_reader import FaultHandlers

OVERLAY = 'image_overlay'
MODES = ('phantom', 'markers')
PATIENCE_S = 5.0  # with the other view of an exposure, unless the next one comes before
LARGEST_PX = 2**14  # of an image, for points whose image is not known yet


@dataclass(frozen=True)
class ExtractionParameters(ManagedParameters):
    """Parameters of the extraction node."""

    mode: str = option('phantom', 'what is looked for in the images', choices=MODES)
    phantom: str = option(
        '',
        'file phantom.csv with the surveyed coordinates of the beads, and with a column diameter '
        'where their sizes differ',
        unit='mm',
    )
    markers: str = option(
        '',
        'for the mode markers: file with the ids of the markers and where they are in the first '
        'image, as for fluoro-calib extract --markers; until an image shows them there, the node '
        'waits',
    )
    calibration_directory: str = option(
        '',
        'for the mode markers: folder with the calibrations and the orientation of both '
        'fluoroscopes, whose views then decide together on ids that may have been exchanged; '
        'empty: each view by itself',
    )
    clusters: tuple[str, ...] = option(
        ('',),
        "for the mode markers and two views: rigid clusters, each a text such as 'tibia: 1001 "
        "1002 1003 1004'",
    )
    principal_distance: float = option(
        0.0,
        'principal distance, to some 10 %; 0: four times the width of the image, to 25 %',
        minimum=0.0,
        maximum=1e7,
        unit='px',
    )
    inputs: str = option(
        'both', 'topics to subscribe to; of a camera that offers both, choose one', choices=INPUTS
    )
    queue_size: int = option(
        32,
        'images of a fluoroscope that may wait; of more, the oldest exposure is shed; 1 for the '
        'least delay',
        minimum=1,
        maximum=10000,
    )

    def __post_init__(self) -> None:
        try:
            self.rigid_clusters()
        except ValueError as error:
            raise ValueError(f'clusters: {error}') from None

    def rigid_clusters(self) -> tuple[Cluster, ...]:
        """Return the clusters. Raises ValueError for a text that declares none."""
        return parse_clusters([text for text in self.clusters if text])


_NODE = ParameterGroup(ExtractionParameters)
_PAIRING = ParameterGroup(PairingOptions, {'tolerance_s': 'pair_tolerance'})
_FOLLOWING = ParameterGroup(
    MarkerOptions,
    {name: name for name in ('gate', 'shutter', 'lost_after', 'search_every')},
)
_ANGLES = ParameterGroup(AngleOptions)
PARAMETERS = (_NODE, _PAIRING, _FOLLOWING, _ANGLES, READ_LIMITS)


@dataclass(frozen=True)
class _Task:
    """An image that waits.

    Its number, message, when it has arrived [ns, system clock], and the angle of the C-arm [rad].
    """

    number: int
    message: Image | CompressedImage
    received_ns: int
    angle: float | None = None


class _ImageStream:
    """State of one fluoroscope."""

    def __init__(self, name: str, logger: RateLimitedLogger) -> None:
        self.name = name
        self.received = 0
        self.extracted = 0
        self.followed = 0
        self.without = 0  # images without observations
        self.shed = 0
        self.last: LiveObservations | None = None
        self.first: tuple[tuple[int, int], str] | None = None  # image size and frame id
        self.converter = ImageConverter(name)
        self.refusals = RefusalLog('image', logger)
        self.stall = StallDetector()
        self.latencies = LatencyWindow()
        self.seconds = 0.0  # that images took
        # Of the last diagnostics: time, images that were processed, images that were shed.
        self._before = (time.monotonic(), 0, 0)
        self.rate_hz = 0.0
        self.shed_now = 0

    def measure(self) -> None:
        """Determine the rate, and what was shed, since the last call."""
        now = time.monotonic()
        then, processed, shed = self._before
        count = self.extracted + self.without
        self.rate_hz = (count - processed) / max(now - then, 1e-3)
        self.shed_now = self.shed - shed
        self._before = (now, count, self.shed)

    def decoded(self, message: Image | CompressedImage) -> np.ndarray:
        """Return the image (h, w) of a message. Raises Refused where the stream has changed."""
        frame_id = message.header.frame_id
        if self.first is not None and frame_id != self.first[1]:
            raise self.converter.refusal(
                'frame id',
                message,
                f'the frame id is {frame_id!r}, but that of the first image is {self.first[1]!r}',
            )
        image, _ = self.converter.decoded(message)
        size = (image.shape[1], image.shape[0])
        if self.first is None:
            self.first = size, frame_id
        elif size != self.first[0]:
            expected = self.first[0]
            raise self.converter.refusal(
                'image size',
                message,
                f'the image is {size[0]} x {size[1]} px, but the first one is '
                f'{expected[0]} x {expected[1]} px',
            )
        return image


class ExtractionNode(StreamNode):
    """Publishes the targets that it finds in images."""

    def __init__(self) -> None:
        super().__init__('extraction_node')
        declare_read_limits(self)
        self._settings = _NODE.declare(self)
        self._tolerance_ns = _PAIRING.declare(self).tolerance_ns
        self.autostart = self._settings.autostart
        self.names = self._settings.fluoroscopes
        self._inputs = INPUTS[self._settings.inputs]
        self._make: Mapping[str, MakeExtractor] = {}
        self._pair: PairSettings | None = None
        angles = _ANGLES.declare(self)
        AngleInput(angles, self.names, self.limited_logger)  # refuses a joint of no fluoroscope
        self._prepare(_FOLLOWING.declare(self))
        # Only predictions by calibrations need the angles; beads are found without.
        self._angle_options = AngleOptions() if self._pair is None else angles
        self._threads: list[threading.Thread] = []
        self._processes: list[ServiceProcess] = []
        self._queue: ExposureQueue[_Task] = ExposureQueue(self.names, self._settings.queue_size)
        use_single_thread()
        self.reset()

    def _prepare(self, following: MarkerOptions) -> None:
        """Read what the extractors are made of. Raises StartError."""
        mode = self._settings.mode
        path = self._settings.phantom if mode == 'phantom' else self._settings.markers
        if not path:
            example = 'phantom.csv' if mode == 'phantom' else 'with the markers'
            raise StartError(f'parameter {mode} is not set: it names the file {example}')
        try:
            if mode == 'phantom':
                self._make = self._bead_extractors(expand_path(path))
                return
            first = self._first_markers(expand_path(path))
            if self._settings.calibration_directory:
                self._pair = self._pair_settings(first, following)
            else:
                self._make = {name: MarkerSettings(of, following) for name, of in first.items()}
        except DataError as error:
            raise StartError(str(error)) from None

    def _bead_extractors(self, path: Path) -> Mapping[str, MakeExtractor]:
        """Return what makes the extractor of each fluoroscope. Raises DataError."""
        survey = read_survey(path)
        for note in survey.notes:
            self.get_logger().warning(note)
        make = PhantomSettings(survey.phantom, self._settings.principal_distance or None)
        return dict.fromkeys(self.names, make)

    def _first_markers(self, path: Path) -> dict[str, FirstMarkers]:
        """Return ids and first places of the markers of each fluoroscope. Raises DataError."""
        size = (LARGEST_PX, LARGEST_PX)
        recording = read_source(path, image_size=size, fluoroscopes=self.names)
        out = {}
        for name, frames in recording.frames.items():
            first = min(frames, key=lambda frame: frame.number)
            out[name] = FirstMarkers(first.target_id, first.uv)
        return out

    def _pair_settings(
        self, first: Mapping[str, FirstMarkers], following: MarkerOptions
    ) -> PairSettings:
        """Read what two views need to be followed together. Raises DataError."""
        folder = expand_path(self._settings.calibration_directory)
        if len(self.names) != 2:
            raise DataError(
                f'calibration_directory: two fluoroscopes are followed together, not '
                f'{len(self.names)} ({", ".join(self.names)})'
            )
        settings = PairSettings(
            first,
            read_calibrations(folder, self.names),
            load_orientation(orientation_path(folder)).subset(self.names),
            self._settings.rigid_clusters(),
            following,
        )
        check_orientation(settings.orientation, settings.calibrations)
        settings()  # refuses what does not belong together before the node starts
        return settings

    # -- lifecycle

    def reset(self) -> None:
        """Start counting from zero."""
        self.streams = {name: _ImageStream(name, self.limited_logger) for name in self.names}
        self._numbers = ExposureNumbers(self.names, self._tolerance_ns)
        self._angles = AngleInput(self._angle_options, self.names, self.limited_logger)

    def create_outputs(self) -> None:
        """Make the outputs."""
        self._observations: dict[str, Publisher] = {}
        self._overlays: dict[str, Publisher] = {}
        for name in self.names:
            self._observations[name] = self.create_output(
                TargetObservations, f'{name}/target_observations', observations_qos()
            )
            self._overlays[name] = self.create_output(Image, f'{name}/{OVERLAY}', images_qos())

    def create_readers(self) -> None:
        """Receive the images of all fluoroscopes in one thread, and number them."""
        faults = FaultHandlers(
            self._on_undecodable,
            lambda topic, error: self._stream_of(topic).refusals.fail(topic, error),
            self.fail,
        )
        reader = self.create_reader(self._angles.guarded(faults))
        self._angles.subscribe(reader)
        for name in self.names:
            for kind, topic in self._inputs:
                reader.subscribe(
                    kind, f'{name}/{topic}', partial(self._on_image, name), images_qos()
                )

    def activate(self) -> None:
        """Start the processes that extract, then the stream reader."""
        size = self._settings.queue_size
        # One view of a pair waits for the other until the next exposure comes.
        self._queue = ExposureQueue(self.names, size if self._pair is None else max(size, 2))
        if self._pair is not None:
            self._start_worker(self._serve_pair, 'pair', pair_process(self._pair))
        else:
            for name in self.names:
                serve = partial(self._serve, name)
                self._start_worker(serve, name, extraction_process(self._make[name]))
        super().activate()

    def _start_worker(
        self,
        serve: Callable[[ExposureQueue[_Task], ServiceProcess], None],
        name: str,
        process: ServiceProcess,
    ) -> None:
        """Start a process and the thread that gives it images."""
        process.start()
        thread = threading.Thread(
            target=serve, args=(self._queue, process), name=name, daemon=True
        )
        thread.start()
        self._processes.append(process)
        self._threads.append(thread)

    def deactivate(self) -> None:
        """Stop receiving and extracting; what is waiting is lost."""
        super().deactivate()
        self._queue.close()
        for process in self._processes:
            process.close()
        for thread in self._threads:
            thread.join()
        self._processes = []
        self._threads = []

    # -- the thread of the stream reader

    def _stream_of(self, topic: str) -> _ImageStream:
        return self.streams[topic.partition('/')[0]]

    def _on_undecodable(self, topic: str) -> None:
        stream = self._stream_of(topic)
        stream.received += 1
        stream.refusals.refuse_undecodable(topic)

    def _on_image(
        self, name: str, message: Image | CompressedImage, info: Mapping[str, int]
    ) -> None:
        """Number an image and let it wait for the thread of its fluoroscope."""
        self.streams[name].received += 1
        stamp = message.header.stamp
        stamp_ns = NS_PER_S * stamp.sec + stamp.nanosec
        number = self._numbers.number(name, stamp_ns)
        angle = self._angles.of_frame(name, stamp_ns, needed=self._needs_angle(name))
        task = _Task(number, message, info['received_timestamp'], angle)
        for loser in self._queue.put(name, number, task):
            self.streams[loser].shed += 1

    def _needs_angle(self, name: str) -> bool:
        """Return whether predictions in the images of a fluoroscope depend on its angle."""
        return self._pair is not None and self._pair.calibrations[name].angle_field is not None

    # -- the threads that extract

    def _serve(self, name: str, queue: ExposureQueue[_Task], process: ServiceProcess) -> None:
        """Extract the images of a fluoroscope until the queue is closed."""
        stream = self.streams[name]
        while (task := queue.get(name)) is not None:
            try:
                image = stream.decoded(task.message)
                found = process(image, task.number, self._is_overlay_wanted(name))
                self._finish(stream, task, image, found)
            except Refused as error:
                stream.refusals.refuse(error)
            except Exception as error:  # this image is lost, the next ones are not
                if queue.closed:
                    return  # the process has been ended
                stream.refusals.fail(f'{name}/{self._inputs[0][1]}', error)

    def _serve_pair(self, queue: ExposureQueue[_Task], process: ServiceProcess) -> None:
        """Extract the images of both fluoroscopes, exposure by exposure."""
        while (exposure := queue.get_exposure(PATIENCE_S)) is not None:
            number, tasks = exposure
            try:
                images = {}
                for name, task in tasks.items():
                    try:
                        images[name] = self.streams[name].decoded(task.message)
                    except Refused as error:
                        self.streams[name].refusals.refuse(error)
                if not images:
                    continue
                wanted = [name for name in images if self._is_overlay_wanted(name)]
                angles = {name: tasks[name].angle for name in images}
                for name, found in process(images, number, wanted, angles).items():
                    self._finish(self.streams[name], tasks[name], images[name], found)
            except Exception as error:  # this exposure is lost, the next ones are not
                if queue.closed:
                    return  # the process has been ended
                for name in tasks:
                    self.streams[name].refusals.fail(f'{name}/{self._inputs[0][1]}', error)

    def _is_overlay_wanted(self, name: str) -> bool:
        return bool(self._overlays[name].get_subscription_count())

    def _finish(
        self, stream: _ImageStream, task: _Task, image: np.ndarray, found: LiveObservations
    ) -> None:
        """Publish what was found in an image, and count it."""
        message = task.message
        if not found.reason:
            self._publish(stream, task, found, (image.shape[1], image.shape[0]))
        else:
            stream.without += 1
            stream.refusals.note(
                str(stream.converter.refusal('', message, f'no observations: {found.reason}'))
            )
        if found.note:
            stream.refusals.note(str(stream.converter.refusal('', message, found.note)))
        stream.last = found
        stream.seconds += found.seconds
        if found.picture is not None:
            self._overlays[stream.name].publish(
                message_from_image(message.header, np.ascontiguousarray(found.picture))
            )

    def _publish(
        self,
        stream: _ImageStream,
        task: _Task,
        found: LiveObservations,
        image_size: tuple[int, int],
    ) -> None:
        header = task.message.header
        frame = Frame(
            stream.name,
            task.number,
            found.target_id,
            found.uv,
            image_size,
            found.sigma,
            NS_PER_S * header.stamp.sec + header.stamp.nanosec,
            header.frame_id,
        )
        self._observations[stream.name].publish(message_from_frame(frame))
        stream.extracted += 1
        stream.followed += found.followed
        stream.latencies.add(time.time_ns() - task.received_ns)

    # -- diagnostics

    def diagnose(self) -> list[Status]:
        """Return the status of every fluoroscope."""
        incompatible = self.incompatible_publishers()
        statuses = []
        for name, stream in self.streams.items():
            stream.measure()
            statuses.append(
                Status(name, *self._verdict(stream, incompatible), self._values(stream))
            )
        return statuses

    def _values(self, stream: _ImageStream) -> dict[str, object]:
        last = stream.last or LiveObservations()
        processed = stream.extracted + stream.without
        return {
            'images received': stream.received,
            'images extracted': stream.extracted,
            'images followed': stream.followed,
            'images without observations': stream.without,
            'images waiting': self._queue.waiting(stream.name),
            'images shed': stream.shed,
            **stream.refusals.values(IMAGE_REFUSALS),
            'last fault': stream.refusals.last_fault,
            'targets': len(last.target_id),
            'targets expected': last.expected,
            'found [%]': f'{100 * last.found:.1f}',
            'explained [%]': f'{100 * last.explained:.1f}',
            'overlapped': int(last.overlapped.sum()),
            'doubtful': last.doubtful,
            'refusal of the last image': last.reason,
            'rate [Hz]': f'{stream.rate_hz:.1f}',
            'time of an image [ms]': f'{1e3 * stream.seconds / max(processed, 1):.0f}',
            **self._angles.values(stream.name),
            **stream.latencies.values(),
        }

    def _verdict(self, stream: _ImageStream, incompatible: Mapping[str, str]) -> tuple[bytes, str]:
        """Return level and message of the diagnostics of a fluoroscope."""
        failure = stream.refusals.failure_status()
        if failure:
            return failure
        topics = [f'{stream.name}/{topic}' for _, topic in self._inputs]
        for topic in topics:
            if topic in incompatible:
                return WARN, incompatible[topic]
        if not self.readers:
            return WARN, 'the node is not active'
        if not any(map(self.has_publisher, topics)):
            return WARN, 'no publisher of images'
        stalled = stream.stall.message(stream.received)
        if stalled:
            return WARN, stalled
        if stream.shed_now:
            return WARN, f'images come faster than they are extracted: {stream.shed} were shed'
        if stream.last is not None and stream.last.reason:
            return WARN, f'no observations in the last image: {stream.last.reason}'
        unknown = self._angles.status(stream.name, incompatible)
        if unknown:
            level, reason = unknown
            return level, f'{reason}; markers are predicted by the mean correction over all angles'
        return stream.refusals.refusal_status() or (OK, 'extracting')


def main(args: Sequence[str] | None = None) -> None:
    """Run the node."""
    run(ExtractionNode, args)


if __name__ == '__main__':
    main()
