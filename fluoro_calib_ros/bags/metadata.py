# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The metadata of a bag as rosbag2 writes it, version 9 (rosbag2_storage/yaml.hpp)."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

from .definitions import Definition

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
    """A topic that is written to a bag.

    Attributes
    ----------
    name : str
    msg_type : str
    qos : list of dict
        Offered QoS profiles.
    definition : Definition
    count : int
        Number of messages.
    channel : int
        Its channel in the file that is being written.
    """

    name: str
    msg_type: str
    qos: list[dict[str, Any]]
    definition: Definition
    count: int = 0
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
