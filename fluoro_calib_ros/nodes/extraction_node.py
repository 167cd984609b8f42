# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Node that finds the beads of the phantom, or markers, in the images of the fluoroscopes, live.

One thread receives the images and numbers them. Each fluoroscope has its own thread and process
for extraction. If images arrive faster than they can be extracted, whole exposures are shed.
"""

from __future__ import annotations

from array import array
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from fluoro_calib_msgs.msg import Retraction, TargetObservations
from sensor_msgs.msg import CompressedImage, Image

from ..bodies.body import Body, declared_bodies
from ..correction.fluoroscope_calibration import ids_of
from ..errors import DataError, ErrorsAt
from ..exposures.angles import AngleOptions
from ..exposures.frame import Frame
from ..exposures.pairing import PairingOptions
from ..exposures.stamps import ExposureNumbers, nanoseconds_from_stamp
from ..images.markers import FirstMarkers, MarkerOptions
from ..images.overlay import small_jpeg
from ..io.bodies import read_bodies
from ..io.calibration import load_orientation, orientation_path
from ..jobs.extraction import RADIOGRAPH_PX
from ..jobs.followers import (
    REVISED,
    FollowerSettings,
    MarkerSettings,
    Observations,
    PhantomSettings,
)
from ..jobs.sources import read_calibrations, read_source, read_survey
from ..limits import MAX_IMAGE_SIDE
from ..options import option
from .angle_input import AngleInput
from .image_node import INPUTS
from .image_stream import (
    CONDITIONS,
    LATE,
    ExtractionWorkers,
    ImageState,
    ImageStream,
    Task,
)
from .messages.image import message_from_image, use_single_thread
from .messages.observations import message_from_frame, uint32_field
from .runtime.conditions import health_of, state_of
from .runtime.diagnostics import Logger, RefusalLog, StartError, Status
from .runtime.lifecycle import StreamNode, stream_faults
from .runtime.main import run
from .runtime.parameters import (
    ManagedParameters,
    expand_path,
    group,
    parameters_of_managed,
)
from .runtime.streams import remember
from .runtime.topics import images_qos, observations_qos

MODES = ('phantom', 'markers')


@dataclass(frozen=True)
class ExtractionParameters(ManagedParameters):
    """Parameters of the extraction node."""

    mode: str = option('phantom', 'what is extracted from the images', choices=MODES)
    phantom: str = option(
        '',
        'file phantom.csv with the surveyed coordinates of the beads, with a column diameter '
        'where their sizes differ, and a column part if each image shows one of several parts',
        unit='mm',
    )
    markers: str = option(
        '',
        'for the mode markers: file with the ids and image points of the markers in the first '
        'image, as for fluoro-calib extract --markers; until an image shows them there, the node '
        'waits',
    )
    calibration_directory: str = option(
        '',
        'for the mode markers: folder with the calibrations and the orientation of all '
        'fluoroscopes, whose views then decide together on ids that may have been exchanged; '
        'empty: each view separately',
    )
    clusters: tuple[str, ...] = option(
        ('',),
        'for the mode markers and two views or more: rigid clusters, each a text such as '
        "'tibia: 1001 1002 1003 1004'",
    )
    bodies: str = option(
        '',
        'for the mode markers and two views or more: bodies.csv with rigid bodies and the '
        'coordinates of their markers, instead of clusters; without the file markers, the shapes '
        'give the ids',
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
        'images of a fluoroscope that may wait; beyond that, the oldest exposure is shed; 1: '
        'least delay',
        minimum=1,
        maximum=10000,
    )

    def __post_init__(self) -> None:
        if self.bodies and self.rigid_bodies():
            raise ValueError('bodies: the file names the markers of each body, as clusters do')

    def rigid_bodies(self) -> tuple[Body, ...]:
        """Return the declared bodies. Raises DataError for a text that declares none."""
        with ErrorsAt('clusters'):
            return declared_bodies(filter(None, self.clusters))


@dataclass(frozen=True)
class ExtractionSettings:
    """Parameter values by group."""

    node: ExtractionParameters = group(ExtractionParameters)
    pairing: PairingOptions = group(PairingOptions, {'tolerance_s': 'pair_tolerance'})
    following: MarkerOptions = group(
        MarkerOptions, ('gate', 'shutter', 'lost_after', 'search_every')
    )
    angles: AngleOptions = group(AngleOptions)


PARAMETERS = parameters_of_managed(ExtractionSettings)


def read_followers(settings: ExtractionSettings, logger: Logger) -> Sequence[FollowerSettings]:
    """Return the settings of the followers: one per view, or one for all. Raises StartError."""
    mode = settings.node.mode
    path = settings.node.phantom if mode == 'phantom' else settings.node.markers
    by_shape = mode == 'markers' and settings.node.bodies and settings.node.calibration_directory
    if not path and not by_shape:
        example = 'phantom.csv' if mode == 'phantom' else 'with the markers'
        raise StartError(f'parameter {mode} is not set: it names the file {example}')
    try:
        if mode == 'phantom':
            survey = read_survey(expand_path(path))
            for note in survey.notes:
                logger.warning(note)
            distance = settings.node.principal_distance or None
            return [
                PhantomSettings(n, survey.phantom, distance) for n in settings.node.fluoroscopes
            ]
        first = _first_markers(expand_path(path), settings.node.fluoroscopes) if path else {}
        if settings.node.calibration_directory:
            return [_joined(settings, first)]
        return [
            MarkerSettings({name: markers}, settings.following) for name, markers in first.items()
        ]
    except DataError as error:
        raise StartError(str(error)) from None


def _first_markers(path: Path, names: Sequence[str]) -> dict[str, FirstMarkers]:
    """Return ids and initial positions of the markers of each fluoroscope. Raises DataError."""
    size = (MAX_IMAGE_SIDE, MAX_IMAGE_SIDE)  # the image size is not known yet
    recording = read_source(path, image_size=size, fluoroscopes=names)
    out = {}
    for name, frames in recording.frames.items():
        first_frame = min(frames, key=lambda frame: frame.number)
        out[name] = FirstMarkers(first_frame.target_id, first_frame.uv)
    return out


def _joined(settings: ExtractionSettings, first: Mapping[str, FirstMarkers]) -> MarkerSettings:
    """Read what is needed to follow the views jointly. Raises DataError."""
    names = settings.node.fluoroscopes
    folder = expand_path(settings.node.calibration_directory)
    if len(names) < 2:
        raise DataError(
            f'calibration_directory: two fluoroscopes or more are followed together, not '
            f'{len(names)} ({", ".join(names)})'
        )
    calibrations = read_calibrations(folder, names)
    orientation = load_orientation(orientation_path(folder)).subset(names)
    bodies = settings.node.rigid_bodies()
    if settings.node.bodies:
        bodies = read_bodies(expand_path(settings.node.bodies))
    joined = MarkerSettings(first, settings.following, calibrations, orientation, bodies=bodies)
    orientation.check_calibrations(ids_of(calibrations))
    joined()  # refuses inconsistent settings before the node starts
    return joined


class ExtractionNode(StreamNode):
    """Publishes the targets found in images."""

    subject = 'images'

    def __init__(self) -> None:
        super().__init__('extraction_node', ExtractionSettings)
        settings = self.settings
        self._inputs = INPUTS[settings.node.inputs]
        self.topics = tuple(topic for _, topic in self._inputs)
        AngleInput(settings.angles, self.names, self.limited_logger)  # refuses unknown joints
        self._followers = read_followers(settings, self.get_logger())
        # Used to predict marker positions when views are followed jointly; only these need angles.
        self._calibrations = {
            name: calibration
            for follower in self._followers
            if isinstance(follower, MarkerSettings)
            for name, calibration in follower.calibrations.items()
        }
        self._angle_options = settings.angles if self._calibrations else AngleOptions()
        use_single_thread()
        self.reset()

    def reset(self) -> None:
        """Reset all counters."""
        self.streams = {
            name: ImageStream(
                name,
                RefusalLog('image', self.limited_logger),
                topic=f'{name}/{self.topics[0]}',
            )
            for name in self.names
        }
        self._numbers = ExposureNumbers(self.names, self.settings.pairing.tolerance_ns)
        self._angles = AngleInput(self._angle_options, self.names, self.limited_logger)
        self._workers = self._make_workers()

    def _make_workers(self) -> ExtractionWorkers:
        size = self.settings.node.queue_size
        # Leave room for images that wait for the other views.
        size = max(size, LATE + 1) if self._calibrations else size
        return ExtractionWorkers(
            self.streams,
            size,
            wanted=lambda name: bool(self._overlays[name].get_subscription_count()),
            finish=self._finish,
        )

    # -- lifecycle

    def create_outputs(self) -> None:
        """Create the outputs."""
        outputs = self.create_outputs_of
        self._observations = outputs(TargetObservations, 'target_observations', observations_qos)
        self._overlays = outputs(Image, 'image_overlay', images_qos)
        self._retractions = outputs(Retraction, 'retractions', observations_qos)
        self._radiographs = outputs(CompressedImage, 'radiograph', observations_qos)

    def create_readers(self) -> None:
        """Receive the images of all fluoroscopes in one thread, and number them."""
        reader = self._angles.create_reader(self, stream_faults(self.streams, self.fail))
        for name in self.names:
            for kind, topic in self._inputs:
                reader.subscribe(
                    kind, f'{name}/{topic}', partial(self._on_image, name), images_qos()
                )

    def activate(self) -> None:
        """Start the extracting processes, then the stream reader."""
        self._workers = self._make_workers()
        self._workers.start(self._followers)
        super().activate()

    def deactivate(self) -> None:
        """Stop receiving and extracting; waiting images are lost."""
        super().deactivate()
        self._workers.close()

    # -- the thread of the stream reader

    def _on_image(
        self, name: str, message: Image | CompressedImage, info: Mapping[str, int]
    ) -> None:
        """Number an image and queue it for the thread of its fluoroscope."""
        self.streams[name].received += 1
        stamp_ns = nanoseconds_from_stamp(message.header.stamp)
        number = self._numbers.number(name, stamp_ns)
        calibration = self._calibrations.get(name)
        needed = calibration is not None and calibration.angle_field is not None  # to predict
        angle = self._angles.of_frame(name, stamp_ns, needed)
        self._workers.put(name, Task(number, message, info['received_timestamp'], angle))

    # -- the threads that extract

    def _finish(
        self, stream: ImageStream, task: Task, image: np.ndarray, observed: Observations
    ) -> None:
        """Publish the targets found in an image, and count it."""
        header = task.message.header
        if not observed.reason:
            radiographs = self._radiographs[stream.name]
            if self.settings.node.mode == 'phantom' and radiographs.get_subscription_count():
                jpeg = array('B', small_jpeg(image, RADIOGRAPH_PX))
                radiographs.publish(CompressedImage(header=header, format='jpeg', data=jpeg))
            frame = Frame(
                stream.name,
                task.number,
                observed.target_id,
                observed.uv,
                (image.shape[1], image.shape[0]),
                sigma=observed.sigma,
                stamp_ns=nanoseconds_from_stamp(header.stamp),
                frame_id=header.frame_id,
            )
            self._observations[stream.name].publish(message_from_frame(frame))
            stream.add_latency(task.received_ns)
        self._retract(stream, task, observed)
        stream.count(task.message, observed)
        if observed.picture is not None:
            self._overlays[stream.name].publish(
                message_from_image(header, np.ascontiguousarray(observed.picture))
            )

    def _retract(self, stream: ImageStream, task: Task, observed: Observations) -> None:
        """Publish which ids of earlier images are retracted."""
        headers = stream.headers
        remember(headers, task.number, task.message.header, REVISED)
        for retraction in observed.retracted:
            if retraction.frame not in headers:
                continue
            message = Retraction(header=headers[retraction.frame], frame_number=retraction.frame)
            message.target_id = uint32_field(retraction.target_id)
            self._retractions[stream.name].publish(message)
            stream.retracted += len(retraction.target_id)

    # -- diagnostics

    def diagnose(self) -> list[Status]:
        """Return the status of every fluoroscope."""
        return [self._diagnose(stream) for stream in self.streams.values()]

    def _diagnose(self, stream: ImageStream) -> Status:
        name = stream.name
        stream.measure()
        state = state_of(ImageState, self, stream, angles=self._angles)
        values = {
            **stream.values(self._workers.waiting(name)),
            'lost at the input': stream.overrun,
            'readers': self._observations[name].get_subscription_count(),
            'readers of retractions': self._retractions[name].get_subscription_count(),
            **self._angles.values(name),
            **stream.latencies.values(),
        }
        return Status(name, *health_of(state, CONDITIONS), values)


main = partial(run, ExtractionNode)

if __name__ == '__main__':
    main()
