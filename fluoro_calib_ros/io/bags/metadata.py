# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Message definitions without ROS, and metadata of a bag in the layout of rosbag2."""

from __future__ import annotations

import dataclasses
import struct
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cache
from importlib.resources import files
from typing import Any

import numpy as np
import yaml
from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from ...correction.calibration_record import FIELDS, VERSION
from ...errors import DataError, ErrorsAt
from ...exposures.frame import Frame, stack_image_points
from ...exposures.stamps import NS_PER_S, nanoseconds_from_stamp
from ..documents import parse_yaml

PACKAGE = 'fluoro_calib_msgs'
TARGET_OBSERVATIONS = f'{PACKAGE}/msg/TargetObservations'
FLUOROSCOPE_CALIBRATION = f'{PACKAGE}/msg/FluoroscopeCalibration'
# Fields appended to a message by each change of its definition: earlier messages have none or only
# the first of them. Series did not exist before bags did.
ADDED = {
    FLUOROSCOPE_CALIBRATION: tuple(
        tuple(field.name for field in FIELDS if field.since == version)
        for version in range(3, VERSION + 1)
    )
}
SEPARATOR = '=' * 80  # separates the definitions in a schema


@dataclasses.dataclass(frozen=True)
class Definition:
    """Definition of a message type in a bag: text, encoding and hash; '' if unknown."""

    text: str
    encoding: str = 'ros2msg'
    type_hash: str = ''


def known_definition(msg_type: str) -> Definition:
    """Return the definition of a type in the typestore. Raises DataError for an unknown type."""
    return Definition(full_text(msg_type), 'ros2msg', type_hash(msg_type))


@cache
def typestore(changes: int | None = None) -> Typestore:
    """Return the rosbags typestore of Jazzy with the messages of fluoro_calib_msgs.

    changes: types in ADDED are those after the first `changes` changes; by default the present.
    """
    store = get_typestore(Stores.ROS2_JAZZY)
    for name, text in _package_texts().items():
        if changes is not None and changes < len(ADDED.get(name, ())):
            text = earlier_text(name, changes)
        store.register(get_types_from_msg(text, name))
    return store


def message_class(msg_type: str) -> type[Any]:
    """Return the dataclass of a message type such as 'std_msgs/msg/Header'.

    Raises DataError for an unknown type.
    """
    types = typestore().types
    if msg_type not in types:
        raise DataError(f'the message type {msg_type!r} is not known')
    return types[msg_type]


@cache
def type_hash(msg_type: str) -> str:
    """Return the hash ``RIHS01_...`` of a message type (REP-2016)."""
    message_class(msg_type)
    return typestore().hash_rihs01(msg_type)


@cache
def full_text(msg_type: str) -> str:
    """Return the definition of a message type in the form of a bag schema.

    The definitions of all types it depends on follow, each after a line of 80 '=' and a line 'MSG:
    package/Type', in the order of rosbag2.
    """
    message_class(msg_type)
    return with_dependencies(msg_type, _own_definition, set())


def to_cdr(message: Any, msg_type: str) -> bytes:
    """Serialise a message dataclass to CDR. Raises DataError for an invalid value of a field."""
    message_class(msg_type)
    try:
        return bytes(typestore().serialize_cdr(message, msg_type, little_endian=True))
    except Exception as error:  # generated code raises almost anything for a wrong value
        raise DataError(f'this is not a message of type {msg_type} ({error})') from None


def from_cdr(data: bytes, msg_type: str) -> Any:
    """Deserialise CDR to a message dataclass. Raises DataError for invalid bytes.

    Fields that an earlier definition of the message lacks are empty.

    Fast DDS reserves four bytes for the alignment of each empty sequence of float64, such as a
    missing sigma, and leaves them at the end. rosbags rejects such messages.
    """
    kind = message_class(msg_type)
    try:
        return _read_cdr(typestore(), data, msg_type)
    except DataError as error:
        last_error = error
    for changes in reversed(range(len(ADDED.get(msg_type, ())))):
        try:
            earlier_message = _read_cdr(typestore(changes), data, msg_type)
        except DataError as error:
            last_error = error
            continue
        added = {name: np.zeros(0) for name in _added(msg_type, changes)}
        field_names = [f.name for f in dataclasses.fields(earlier_message) if f.init]
        return kind(**{name: getattr(earlier_message, name) for name in field_names}, **added)
    raise last_error


def present_cdr(data: bytes, msg_type: str) -> bytes:
    """Convert a message of any definition to CDR of the current definition.

    Raises DataError for invalid bytes.
    """
    return to_cdr(from_cdr(data, msg_type), msg_type)


def earlier_text(msg_type: str, changes: int = 0) -> str:
    """Return the definition of a type after the first `changes` changes that added fields."""
    lines = _package_texts()[msg_type].splitlines(keepends=True)
    added = _added(msg_type, changes)
    return ''.join(line for line in lines if (line.split() + ['', ''])[1] not in added)


def _added(msg_type: str, changes: int) -> list[str]:
    """Return the fields of a type that were added after the first `changes` changes."""
    return [name for names in ADDED[msg_type][changes:] for name in names]


def _read_cdr(store: Typestore, data: bytes, msg_type: str) -> Any:
    """Deserialise CDR with a typestore. Raises DataError for invalid bytes."""
    try:
        return store.deserialize_cdr(data, msg_type)
    except Exception as error:  # generated code raises almost anything for damaged bytes
        # Ignore the bytes of up to ten empty sequences, see from_cdr; no message has more
        for empty in range(1, 11):
            with suppress(Exception):
                message = store.deserialize_cdr(data[: -4 * empty], msg_type)
                arrays = [v for v in vars(message).values() if isinstance(v, np.ndarray)]
                if empty <= sum(v.dtype == np.float64 and not len(v) for v in arrays):
                    return message
        raise DataError(f'the content is not a {msg_type} ({error})') from None


def fields_of(msg_type: str, text: str, encoding: str) -> dict[str, Any]:
    """Return the fields of a message type and its dependencies, by type.

    text is the definition in the schema of a bag, encoding 'ros2msg' or 'ros2idl'. Raises
    DataError for a definition that cannot be read.
    """
    try:
        if encoding == 'ros2msg':
            parsed = get_types_from_msg(text, msg_type)
        elif encoding == 'ros2idl':
            parsed = get_types_from_idl(text)
        else:
            raise DataError(
                f'the definition of {msg_type} has the encoding {encoding!r}, ros2msg is expected'
            )
    except DataError:
        raise
    except Exception as error:  # the parser raises almost anything for a damaged text
        raise DataError(
            f'the definition of {msg_type} cannot be read ({type(error).__name__})'
        ) from None
    return {name: fields for name, (_, fields) in parsed.items()}


def _package_texts() -> dict[str, str]:
    """Return the definitions of fluoro_calib_msgs by message type."""
    folder = files(__package__) / 'msg'
    return {
        f'{PACKAGE}/msg/{file.name[:-4]}': file.read_text(encoding='utf-8')
        for file in sorted(folder.iterdir(), key=lambda f: f.name)
        if file.name.endswith('.msg')
    }


def _own_definition(msg_type: str) -> tuple[str, Iterable[Any]]:
    store = typestore()
    text = _package_texts().get(msg_type) or store.gendefhash(msg_type, {}, ros_version=2)[0]
    return text, store.fielddefs[msg_type][1]


Definitions = Callable[[str], tuple[str, Iterable[Any]]]  # text and fields of a type


def with_dependencies(name: str, definitions: Definitions, seen: set[str]) -> str:
    """Return the definition of a type and its dependencies that are not in seen."""
    text, fields = definitions(name)
    for nested in sorted(_nested_types(fields)):
        if nested not in seen:
            seen.add(nested)
            heading = f'\n{SEPARATOR}\nMSG: {nested.replace("/msg/", "/")}\n'
            text += heading + with_dependencies(nested, definitions, seen)
    return text


def _nested_types(fields: Iterable[Any]) -> set[str]:
    """Return the names of the message types of fields, including those of array elements."""
    names = set()
    for _, description in fields:
        while isinstance(description[1][0], tuple):  # an array or a sequence
            description = description[1][0]
        if isinstance(description[1], str):
            names.add(description[1])
    return names


# Conversion between frames and TargetObservations messages, dataclasses of the rosbags typestore.

TOPIC_NAME = 'target_observations'
RETRACTION = f'{PACKAGE}/msg/Retraction'


def frame_from_message(message: Any, fluoroscope: str) -> Frame:
    """Return the Frame of a TargetObservations message.

    Raises DataError for arrays of different lengths; nothing else is validated.
    """
    with ErrorsAt(f'frame {message.frame_number}'):
        target_id, uv, sigma = stack_image_points(
            message.target_id, message.u, message.v, message.sigma
        )
    return Frame(
        fluoroscope=fluoroscope,
        number=int(message.frame_number),
        target_id=target_id,
        uv=uv,
        image_size=(int(message.image_width), int(message.image_height)),
        sigma=sigma,
        stamp_ns=nanoseconds_from_stamp(message.header.stamp),
        frame_id=message.header.frame_id,
    )


def header_stamp_ns(data: bytes) -> int | None:
    """Return the stamp [ns] of a message that begins with a header, None if it is too short."""
    if len(data) < 12:
        return None
    sec, nanosec = struct.unpack_from('<iI' if data[1] == 1 else '>iI', data, 4)
    return int(sec * NS_PER_S + nanosec)


def message_from_frame(frame: Frame) -> Any:
    """Return the TargetObservations message of a Frame."""
    uv = np.asarray(frame.uv, dtype=np.float64).reshape(-1, 2)
    stamp = message_class('builtin_interfaces/msg/Time')(*divmod(int(frame.stamp_ns), 10**9))
    sigma: Any = [] if frame.sigma is None else frame.sigma
    return message_class(TARGET_OBSERVATIONS)(
        header=message_class('std_msgs/msg/Header')(stamp, frame.frame_id),
        frame_number=int(frame.number),
        image_width=int(frame.image_size[0]),
        image_height=int(frame.image_size[1]),
        target_id=np.asarray(frame.target_id).astype(np.uint32),
        u=np.ascontiguousarray(uv[:, 0]),
        v=np.ascontiguousarray(uv[:, 1]),
        sigma=np.asarray(sigma, dtype=np.float64),
    )


def observations_topic(fluoroscope: str) -> str:
    """Return the absolute topic of the observations of a fluoroscope."""
    return f'/{fluoroscope}/{TOPIC_NAME}'


def fluoroscope_of_topic(topic: str) -> str:
    """Return the fluoroscope of a topic, the last but one part of its name.

    Raises DataError for a name of a single part.
    """
    parts = [part for part in topic.split('/') if part]
    if len(parts) < 2:
        raise DataError(
            f'topic {topic} does not name the fluoroscope, <fluoroscope>/{TOPIC_NAME} is expected'
        )
    return parts[-2]


# QoS profiles in bags: YAML in the metadata of a channel and in metadata.yaml.

_INFINITE = {'sec': 9223372036, 'nsec': 854775807}  # RMW_DURATION_INFINITE
# Bags older than Jazzy contain numbers instead of policy names (rmw/types.h).
_POLICY_NAMES = {
    'history': ('system_default', 'keep_last', 'keep_all', 'unknown'),
    'reliability': ('system_default', 'reliable', 'best_effort', 'unknown', 'best_available'),
    'durability': ('system_default', 'transient_local', 'volatile', 'unknown', 'best_available'),
    'liveliness': (
        'system_default',
        'automatic',
        'manual_by_node',
        'manual_by_topic',
        'unknown',
        'best_available',
    ),
}


def profile(durability: str = 'volatile', depth: int = 10) -> dict[str, Any]:
    """Return a reliable QoS profile {policy: value} in the form of rosbag2.

    Keep last, without deadline and lifespan.
    """
    return {
        'history': 'keep_last',
        'depth': depth,
        'reliability': 'reliable',
        'durability': durability,
        'deadline': dict(_INFINITE),
        'lifespan': dict(_INFINITE),
        'liveliness': 'automatic',
        'liveliness_lease_duration': dict(_INFINITE),
        'avoid_ros_namespace_conventions': False,
    }


PROFILES = {'observations': profile(), 'latched': profile(durability='transient_local', depth=1)}


def to_yaml(value: Any) -> str:
    """Return a value as YAML like rosbag2: block style, keys in order, no final newline."""
    return yaml.dump(
        value, Dumper=_Dumper, sort_keys=False, default_flow_style=False, width=10**6
    ).rstrip('\n')


def parse_profiles(value: Any) -> list[dict[str, Any]]:
    """Return QoS profiles from the YAML text, or the list, in a bag; policies by name.

    A text that cannot be parsed gives []: a bag can be read without profiles.
    """
    try:
        items = parse_yaml(value, 'QoS profiles') if isinstance(value, str) else value
    except DataError:
        return []
    if not isinstance(items, list):
        return []
    profiles = [dict(item) for item in items if isinstance(item, dict)]
    for item in profiles:
        for policy, names in _POLICY_NAMES.items():
            number = item.get(policy)
            if isinstance(number, int):
                item[policy] = names[number] if 0 <= number < len(names) else 'unknown'
    return profiles


class _Dumper(yaml.SafeDumper):
    """Writes block style like yaml-cpp."""

    def increase_indent(self, flow: bool = False, indentless: bool = False) -> None:
        return super().increase_indent(flow, False)

    def ignore_aliases(self, data: Any) -> bool:
        return True


_Dumper.add_representer(
    type(None), lambda dumper, _: dumper.represent_scalar('tag:yaml.org,2002:null', '~')
)


NO_MESSAGE_NS = 2**63 - 1  # starting time of a bag without messages [ns]


@dataclass
class FileSpan:
    """Number of messages in a file, or in the whole bag, and the time they span [ns]."""

    path: str = ''
    count: int = 0
    start_ns: int = NO_MESSAGE_NS
    end_ns: int = -1

    def add(self, time_ns: int) -> None:
        """Count a message."""
        self.count += 1
        self.start_ns = min(self.start_ns, time_ns)
        self.end_ns = max(self.end_ns, time_ns)

    @property
    def starting_time(self) -> dict[str, int]:
        """Time of the first message."""
        return {'nanoseconds_since_epoch': self.start_ns}

    @property
    def duration(self) -> dict[str, int]:
        """Time from the first message to the last."""
        return {'nanoseconds': max(self.end_ns - self.start_ns, 0)}


@dataclass
class BagTopic:
    """A topic that is written to a bag."""

    name: str
    msg_type: str
    qos: list[dict[str, Any]]  #: offered QoS profiles
    definition: Definition
    count: int = 0  #: number of messages
    #: channel id in the file that is being written
    channel: int = field(default=0, compare=False)


def bag_metadata(
    topics: Iterable[BagTopic], files: Sequence[FileSpan], total: FileSpan
) -> dict[str, Any]:
    """Return the content of rosbag2_bagfile_information; the order of the keys matters."""
    return {
        'version': 9,  # version of rosbag2 in Jazzy
        'storage_identifier': 'mcap',
        'duration': total.duration,
        'starting_time': total.starting_time,
        'message_count': total.count,
        'topics_with_message_count': [
            {
                'topic_metadata': {
                    'name': topic.name,
                    'type': topic.msg_type,
                    'serialization_format': 'cdr',
                    'offered_qos_profiles': topic.qos,
                    'type_description_hash': topic.definition.type_hash,
                },
                'message_count': topic.count,
            }
            for topic in topics
        ],
        'compression_format': '',
        'compression_mode': '',  # applies to whole files; chunks are compressed separately
        'relative_file_paths': [file.path for file in files],
        'files': [
            {
                'path': file.path,
                'starting_time': file.starting_time,
                'duration': file.duration,
                'message_count': file.count,
            }
            for file in files
        ],
        'custom_data': None,
        'ros_distro': 'jazzy',
    }
