# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The metadata of a bag as rosbag2 writes it, version 9 (rosbag2_storage/yaml.hpp)."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

import yaml

from ...errors import DataError
from ..documents import parse_yaml
from .definitions import Definition

# QoS profiles as bags contain them: YAML in a channel's metadata and in metadata.yaml.

_INFINITE = {'sec': 9223372036, 'nsec': 854775807}  # RMW_DURATION_INFINITE
# Bags from before Jazzy number the policies (rmw/types.h).
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


def profile(
    reliability: str = 'reliable', durability: str = 'volatile', depth: int = 10
) -> dict[str, Any]:
    """Return a QoS profile {policy: value} as rosbag2 writes it.

    Keep last, without deadline and lifespan.
    """
    return {
        'history': 'keep_last',
        'depth': depth,
        'reliability': reliability,
        'durability': durability,
        'deadline': dict(_INFINITE),
        'lifespan': dict(_INFINITE),
        'liveliness': 'automatic',
        'liveliness_lease_duration': dict(_INFINITE),
        'avoid_ros_namespace_conventions': False,
    }


PROFILES = {'observations': profile(), 'latched': profile(durability='transient_local', depth=1)}


def to_yaml(value: Any) -> str:
    """Return a value as YAML as rosbag2 does: block style, keys in order, no final newline."""
    return yaml.dump(
        value, Dumper=_Dumper, sort_keys=False, default_flow_style=False, width=10**6
    ).rstrip('\n')


def parse_profiles(value: Any) -> list[dict[str, Any]]:
    """Return QoS profiles from the YAML text, or the list, in a bag; policies by name.

    A text that cannot be parsed gives no profiles: a bag can be read without them.
    """
    try:
        items = parse_yaml(value, 'QoS profiles') if isinstance(value, str) else value
    except DataError:
        return []
    if not isinstance(items, list):
        return []
    return [_with_policy_names(item) for item in items if isinstance(item, dict)]


def _with_policy_names(item: dict[str, Any]) -> dict[str, Any]:
    item = dict(item)
    for policy, names in _POLICY_NAMES.items():
        number = item.get(policy)
        if isinstance(number, int):
            item[policy] = names[number] if 0 <= number < len(names) else 'unknown'
    return item


class _Dumper(yaml.SafeDumper):
    """Block style as yaml-cpp writes it."""

    def increase_indent(self, flow: bool = False, indentless: bool = False) -> None:
        return super().increase_indent(flow, False)

    def ignore_aliases(self, data: Any) -> bool:
        return True


_Dumper.add_representer(
    type(None), lambda dumper, _: dumper.represent_scalar('tag:yaml.org,2002:null', '~')
)


VERSION = 9
NO_MESSAGE_NS = 2**63 - 1  # starting time of a bag without messages [ns]


@dataclass
class FileSpan:
    """Number of the messages in a file, or in the whole bag, and the time they span [ns]."""

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
    #: its channel in the file that is being written
    channel: int = field(default=0, compare=False)


def bag_metadata(
    topics: Iterable[BagTopic], files: Sequence[FileSpan], total: FileSpan
) -> dict[str, Any]:
    """Return the content of rosbag2_bagfile_information; the order of the keys counts."""
    return {
        'version': VERSION,
        'storage_identifier': 'mcap',
        'duration': total.duration,
        'starting_time': total.starting_time,
        'message_count': total.count,
        'topics_with_message_count': [_topic_metadata(topic) for topic in topics],
        'compression_format': '',
        'compression_mode': '',  # of whole files; the chunks have their own
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


def _topic_metadata(topic: BagTopic) -> dict[str, Any]:
    return {
        'topic_metadata': {
            'name': topic.name,
            'type': topic.msg_type,
            'serialization_format': 'cdr',
            'offered_qos_profiles': topic.qos,
            'type_description_hash': topic.definition.type_hash,
        },
        'message_count': topic.count,
    }
