# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Read bags: a single .mcap file, or a rosbag2 folder."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from ...errors import DataError, ErrorsAt
from ...exposures.angles import AngleOptions, JointAngles
from ...exposures.frame import Frame, Frames, validate_frame, without_strays
from ...exposures.stamps import ExposureNumbers, nanoseconds_from_stamp
from ...limits import MAX_OBSERVATIONS
from ..access import PathLike, check_safe_name
from .mcap_file import (
    BagMessage,
    ChannelInfo,
    channels_of_bag,
    channels_of_file,
    is_foreign,
    merged_by_time,
    messages_of_bag,
    messages_of_file,
    start_of_file,
    storage_files,
)
from .metadata import (
    RETRACTION,
    TARGET_OBSERVATIONS,
    Definition,
    fields_of,
    fluoroscope_of_topic,
    frame_from_message,
    from_cdr,
    header_stamp_ns,
    type_hash,
    typestore,
)


class TopicInfo(NamedTuple):
    """A topic of a bag: type, number of messages, and offered QoS profiles [{policy: value}]."""

    type: str
    count: int  # type: ignore[assignment]  # a tuple has a method count
    offered_qos: list[dict[str, Any]]


@dataclass(frozen=True)
class BagContents:
    """Frames of a bag in the order of time, and their topics, by fluoroscope.

    notes are sentences about excluded image points and renumbered frames.
    """

    frames: dict[str, list[Frame]]
    topics: dict[str, str]
    notes: tuple[str, ...] = ()


def read_frames(source: PathLike, validate: bool = True) -> BagContents:
    """Read all frames of a bag, from every topic of type TargetObservations.

    The fluoroscope is the last but one part of the topic's name. If the frame numbers of a stream
    restart, a multiple of a power of ten is added to the following numbers to make them unique.
    Without validate only the lengths of the arrays of a frame are checked.

    Raises DataError that names bag, topic and message: for a source that is not a bag, a damaged
    or truncated one, one without observations, a different definition of the message, and an
    invalid or repeated frame.
    """
    fluoroscopes = _observation_topics(source)
    _check_definitions(source, fluoroscopes)
    frames: dict[str, list[Frame]] = {name: [] for name in sorted(fluoroscopes.values())}
    notes: list[str] = []
    first_message: dict[tuple[str, int, int], int] = {}  # where a frame first occurred
    restarts = dict.fromkeys(frames, 0)
    segments: dict[str, list[int]] = {name: [] for name in frames}
    for message in iterate_messages(source, fluoroscopes):
        name = fluoroscopes[message.topic]
        number = len(frames[name]) + 1
        where = f'{source}, topic {message.topic}, message {number}'
        with ErrorsAt(where):
            if len(message.data) > MAX_OBSERVATIONS:
                raise DataError(
                    f'the message has {len(message.data)} bytes; the limit is {MAX_OBSERVATIONS}'
                )
            frame = frame_from_message(from_cdr(message.data, TARGET_OBSERVATIONS), name)
            if validate:
                frame, stray = without_strays(frame)
                notes += [f'not used: {stray}'] if stray else []
                validate_frame(frame)
        if frames[name] and _is_restart(frames[name][-1], frame):
            restarts[name] += 1
        segments[name].append(restarts[name])
        key = (name, restarts[name], frame.number)
        if validate and key in first_message:
            raise DataError(
                f'{where}: frame {frame.number} is already given in message {first_message[key]}'
            )
        first_message[key] = number
        frames[name].append(frame)
    if validate and any(restarts.values()):
        frames, step = _renumbered(frames, segments)
        counts = ', '.join(f'{name} {count}' for name, count in restarts.items() if count)
        notes.append(
            f'{source}: the frame numbers restart ({counts} times), {step} is added to those '
            'after each restart'
        )
    frames, count = _without_retracted(source, frames)
    if count:
        notes.append(f'not used: {count} image points whose ids were retracted')
    topics = {name: topic for topic, name in fluoroscopes.items() if frames[name]}
    if not topics:
        raise DataError(f'{source}: the bag has no message on {" or ".join(fluoroscopes)}')
    return BagContents(
        {name: view_frames for name, view_frames in frames.items() if view_frames},
        dict(sorted(topics.items())),
        tuple(notes),
    )


def _without_retracted(source: PathLike, frames: Frames) -> tuple[dict[str, list[Frame]], int]:
    """Exclude image points whose ids were retracted later; return the frames and their number.

    The number is that of the excluded points. Raises DataError.
    """
    topics = {
        topic: fluoroscope_of_topic(topic)
        for topic, info in topics_of(source).items()
        if info.type == RETRACTION
    }
    retracted: dict[tuple[str, int], set[int]] = {}
    for message in iterate_messages(source, topics) if topics else ():
        with ErrorsAt(f'{source}, topic {message.topic}'):
            retraction = from_cdr(message.data, RETRACTION)
        stamp_ns = nanoseconds_from_stamp(retraction.header.stamp)
        retracted_ids = retracted.setdefault((topics[message.topic], stamp_ns), set())
        retracted_ids.update(retraction.target_id.tolist())
    count = 0
    remaining: dict[str, list[Frame]] = {}
    for name, view_frames in frames.items():
        remaining[name] = []
        for frame in view_frames:
            retracted_ids = retracted.get((name, frame.stamp_ns), set())
            kept = ~np.isin(frame.target_id, list(retracted_ids))
            count += int(np.count_nonzero(~kept))
            remaining[name].append(frame if kept.all() else frame.rows(kept))
    return remaining, count


def _is_restart(last: Frame, frame: Frame) -> bool:
    """Return whether the frame numbers of a stream restart while time increases."""
    return frame.number < last.number and frame.stamp_ns > last.stamp_ns


def _renumbered(
    frames: Frames, segments: Mapping[str, Sequence[int]]
) -> tuple[dict[str, list[Frame]], int]:
    """Make frame numbers of different segments of a stream unique; return frames and step."""
    largest = max(frame.number for view_frames in frames.values() for frame in view_frames)
    step = 10 ** len(str(largest))
    renumbered = {
        name: [
            replace(frame, number=frame.number + step * segment)
            for frame, segment in zip(view_frames, segments[name], strict=True)
        ]
        for name, view_frames in frames.items()
    }
    return renumbered, step


def iterate_messages(
    source: PathLike, topics: Iterable[str] | None = None
) -> Iterator[BagMessage]:
    """Yield the messages of a bag in the order of log time, with only a few chunks in memory.

    topics: names of the topics to read, by default all. Raises DataError, also during iteration,
    for a damaged or truncated bag.
    """
    wanted = None if topics is None else set(topics)
    if is_foreign(source):
        yield from messages_of_bag(source, wanted)
        return
    paths = storage_files(source)
    starts_ns = [start_of_file(path) for path in paths]
    yield from merged_by_time(starts_ns, lambda n: messages_of_file(paths[n], wanted))


def topics_of(source: PathLike) -> dict[str, TopicInfo]:
    """Return the topics of a bag, sorted by name. Raises DataError."""
    topics: dict[str, TopicInfo] = {}
    for path, channels in _channels(source):
        for info in channels:
            topic = info.channel.topic
            name = info.msg_type
            previous = topics.get(topic, TopicInfo(name, 0, []))
            if previous.type != name:
                raise DataError(
                    f'{path}: topic {topic} is of type {previous.type} and of type {name}'
                )
            profiles = previous.offered_qos or info.offered_qos
            topics[topic] = TopicInfo(name, previous.count + info.count, profiles)
    return dict(sorted(topics.items()))


def _channels(source: PathLike) -> Iterator[tuple[PathLike, list[ChannelInfo]]]:
    """Yield each file of a bag and its channels. Raises DataError."""
    if is_foreign(source):
        yield source, channels_of_bag(source)
        return
    for path in storage_files(source):
        yield path, channels_of_file(path)


def _observation_topics(source: PathLike) -> dict[str, str]:
    """Return the fluoroscopes of a bag by topic. Raises DataError."""
    fluoroscopes: dict[str, str] = {}
    for topic, info in topics_of(source).items():
        if info.type != TARGET_OBSERVATIONS:
            continue
        with ErrorsAt(source):
            name = fluoroscope_of_topic(topic)
        check_safe_name(name, f'{source}, topic {topic}')
        for other_topic, fluoroscope in fluoroscopes.items():
            if fluoroscope == name:
                raise DataError(
                    f'{source}: the topics {other_topic} and {topic} are both of fluoroscope '
                    f'{name}'
                )
        fluoroscopes[topic] = name
    if not fluoroscopes:
        raise DataError(f'{source}: the bag has no topic of type {TARGET_OBSERVATIONS}')
    return fluoroscopes


def _check_definitions(source: PathLike, topics: Collection[str]) -> None:
    """Raise DataError unless a bag and this program define TargetObservations equally."""
    for path, channels in _channels(source):
        for info in channels:
            if info.channel.topic not in topics:
                continue
            encoding = info.channel.message_encoding
            with ErrorsAt(f'{path}, topic {info.channel.topic}'):
                if encoding != 'cdr':
                    raise DataError(
                        f'the messages are encoded as {encoding!r}, only cdr is supported'
                    )
                if not _is_same_definition(info.definition):
                    raise DataError(
                        f'the bag defines {TARGET_OBSERVATIONS} differently from this program'
                    )


def _is_same_definition(recorded: Definition) -> bool:
    """Return whether a definition in a bag has the same fields as the one of this program.

    Without a text the recorded hash decides; without either the definition is accepted.
    """
    if not recorded.text.strip():
        return recorded.type_hash in ('', type_hash(TARGET_OBSERVATIONS))
    definitions = typestore().fielddefs
    recorded_fields = fields_of(TARGET_OBSERVATIONS, recorded.text, recorded.encoding)
    return all(
        name in definitions and definitions[name][1] == fields
        for name, fields in recorded_fields.items()
    )


# Images of a bag: sensor_msgs/Image and CompressedImage, without ROS.

IMAGE = 'sensor_msgs/msg/Image'
COMPRESSED_IMAGE = 'sensor_msgs/msg/CompressedImage'


# Images that this package publishes of those of a fluoroscope.
OWN_IMAGES = ('coverage', 'image_corrected', 'image_overlay', 'radiograph')


class BagImage(NamedTuple):
    """An image (h, w) of a bag, its exposure, its place in words, and its stamp [ns].

    If the image cannot be read, image is the DataError with the cause; the stamp is None if it
    cannot be read either.
    """

    exposure: int
    place: str
    image: np.ndarray | DataError
    stamp_ns: int | None


def image_topics(source: PathLike) -> dict[str, str]:
    """Return the topics with images of a camera by fluoroscope, the last but one part of the name.

    The suffix /compressed of image_transport is ignored. If a fluoroscope has both, the
    uncompressed images are used; of several topics it is image_raw. Raises DataError if several
    remain.
    """
    topics: dict[str, dict[str, str]] = {}  # by fluoroscope and name without suffix
    infos = topics_of(source)
    for kind in (COMPRESSED_IMAGE, IMAGE):
        for topic, info in infos.items():
            base = topic.removesuffix('/compressed')
            parts = [part for part in base.split('/') if part]
            is_own = len(parts) > 1 and parts[-1] in OWN_IMAGES
            if info.type == kind and info.count and not is_own:
                name = parts[0] if len(parts) == 1 else fluoroscope_of_topic(base)
                topics.setdefault(name, {})[base] = topic
    return {name: _camera_topic(source, name, bases) for name, bases in sorted(topics.items())}


def _camera_topic(source: PathLike, name: str, topics: Mapping[str, str]) -> str:
    """Return the topic of a camera among the image topics of a fluoroscope. Raises DataError."""
    raw = [topic for base, topic in topics.items() if base.endswith('/image_raw')]
    candidates = raw or list(topics.values())
    if len(candidates) > 1:
        raise DataError(
            f'{source}: images of fluoroscope {name} are on the topics '
            f'{", ".join(sorted(candidates))}; record the one with its radiographs alone, or name '
            f'it {name}/image_raw'
        )
    return candidates[0]


def images_of(source: PathLike, fluoroscope: str, numbers: ExposureNumbers) -> Iterator[BagImage]:
    """Yield the images of a fluoroscope. Raises DataError for a damaged bag.

    The images of all fluoroscopes get numbers in the order of time, as live, so that a lost image
    does not shift exposures.
    """
    topics = {topic: name for name, topic in image_topics(source).items()}
    kinds = topics_of(source)
    count = 0
    for message in iterate_messages(source, topics):
        name = topics[message.topic]
        stamp_ns = header_stamp_ns(message.data)
        number = numbers.number(name, message.log_time_ns if stamp_ns is None else stamp_ns)
        if name == fluoroscope:
            count += 1
            where = f'{source}, topic {message.topic}, message {count}'
            image = _decoded(message.data, kinds[message.topic].type)
            image = image.at(where) if isinstance(image, DataError) else image
            yield BagImage(number, where, image, stamp_ns)


def _decoded(data: bytes, kind: str) -> np.ndarray | DataError:
    """Return the image of a message, or the error with which it cannot be read."""
    from ...images.codec import decode, raw_image  # loads OpenCV, which a player does not need

    try:
        content = from_cdr(data, kind)
        return decode(content.data) if kind == COMPRESSED_IMAGE else raw_image(content)
    except DataError as error:
        return error


# Angles of C-arms in a bag, from the states of their joints.

JOINT_STATE = 'sensor_msgs/msg/JointState'


def joint_topics(source: PathLike) -> list[str]:
    """Return the topics of a bag with joint states. Raises DataError."""
    return [
        name for name, info in topics_of(source).items() if info.type == JOINT_STATE and info.count
    ]


def with_angles(
    source: PathLike, frames: Frames, options: AngleOptions
) -> tuple[dict[str, list[Frame]], tuple[str, ...]]:
    """Return frames of a bag with the same angles as the nodes assign, and notes about them.

    options name the joint of the C-arm, which may be in any topic of joint states. Raises
    DataError for a bag without this joint, with its states on several topics or damaged states,
    and for a joint of another fluoroscope.
    """
    angles = angles_in(source, frames, options)
    if not angles.joints:
        return {name: list(view_frames) for name, view_frames in frames.items()}, ()
    updated = {
        name: [replace(frame, angle=angles.at(name, frame.stamp_ns)) for frame in view_frames]
        for name, view_frames in frames.items()
    }
    return updated, tuple(_notes(source, updated, angles))


def angles_in(source: PathLike, fluoroscopes: Iterable[str], options: AngleOptions) -> JointAngles:
    """Return the joint angles of fluoroscopes from all joint states of a bag.

    Raises DataError as `with_angles` does.
    """
    try:
        angles = options.tracks(fluoroscopes, capacity=None)
    except ValueError as error:
        raise DataError(f'{source}: {error}') from None
    try:
        if angles.joints:
            _read_states(source, angles)
    except DataError as error:
        hint = "; the joint is from rig.toml, --angle-joint '' disables it"
        raise DataError(f'{error}{hint if options.of_rig else ""}') from None
    return angles


def _read_states(source: PathLike, angles: JointAngles) -> None:
    """Add all joint states in a bag to their tracks. Raises DataError."""
    topics = joint_topics(source)
    joints = set(angles.joints.values())
    if not topics:
        raise DataError(
            f'{source}: the bag has no joint states ({JOINT_STATE}), so the angle of joint '
            f'{", ".join(sorted(joints))} is unknown'
        )
    topics_by_joint: dict[str, set[str]] = {}  # topics by joint
    for message in iterate_messages(source, topics):
        with ErrorsAt(f'{source}, topic {message.topic}'):
            state = from_cdr(message.data, JOINT_STATE)
        for joint in state.name:
            topics_by_joint.setdefault(joint, set()).add(message.topic)
        angles.add(nanoseconds_from_stamp(state.header.stamp), state.name, state.position)
    for joint in sorted(joints):
        if joint not in topics_by_joint:
            raise DataError(
                f'{source}: the bag has no joint {joint!r}, only '
                f'{", ".join(sorted(topics_by_joint))}'
            )
        if len(topics_by_joint[joint]) > 1:
            raise DataError(
                f'{source}: joint {joint!r} is on the topics '
                f'{", ".join(sorted(topics_by_joint[joint]))}; its angle must come from one of '
                'them'
            )


def _notes(source: PathLike, frames: Frames, angles: JointAngles) -> Iterable[str]:
    """Yield a sentence for each fluoroscope that has frames with an unknown angle."""
    for name, view_frames in frames.items():
        without_angle = [frame for frame in view_frames if frame.angle is None]
        if name in angles.joints and without_angle:
            yield (
                f'{source}: {len(without_angle)} of {len(view_frames)} frames of fluoroscope '
                f'{name} have no angle, the first is frame {without_angle[0].number} '
                f'({angles.doubt(name, without_angle[0].stamp_ns)})'
            )
