# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Bags of other storages, read by the library rosbags: sqlite3, and compressed ones.

A bag is compressed by rosbag2 file by file (`file`) or message by message (`message`).
"""

from __future__ import annotations

import os
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from pathlib import Path

import yaml
from mcap.records import Channel, Schema
from rosbags.rosbag2 import Reader

from ..errors import DataError
from ..files.access import check_regular_file, read_text
from ..files.yaml_text import parse_yaml
from .mcap_file import BagMessage, ChannelInfo
from .qos import to_yaml
from .storage import PathLike

MAX_CAUSE = 200  # characters
SQLITE = b'SQLite format 3\0'


def is_foreign(source: PathLike) -> bool:
    """Return whether a bag is not stored in plain .mcap files."""
    if os.path.isdir(source):
        path = os.path.join(source, 'metadata.yaml')
        if not os.path.isfile(path):
            return False
        try:
            information = parse_yaml(read_text(path))['rosbag2_bagfile_information']
            mode = str(information.get('compression_mode') or 'none').lower()
            return str(information['storage_identifier']) == 'sqlite3' or mode != 'none'
        except (DataError, yaml.YAMLError, KeyError, TypeError, AttributeError):
            return False  # the reader of MCAP bags says what is wrong
    if not os.path.isfile(source):
        return False
    try:
        with open(source, 'rb') as file:
            return file.read(len(SQLITE)) == SQLITE
    except OSError:
        return False


def channels_of_bag(source: PathLike) -> list[ChannelInfo]:
    """Return all channels of a bag. Raises DataError for one that cannot be read."""
    out = []
    with _opened(source) as bag:
        for number, connection in enumerate(bag.connections, 1):
            text = connection.msgdef.data
            if not all(isinstance(v, str) for v in (connection.topic, connection.msgtype, text)):
                raise DataError(f'{source}: the bag is damaged, the name of a topic is no text')
            metadata = {'topic_type_hash': connection.digest or ''}
            profiles = getattr(connection.ext, 'offered_qos_profiles', '')
            metadata['offered_qos_profiles'] = (
                profiles if isinstance(profiles, str) else to_yaml(_plain(profiles))
            )
            encoding = getattr(connection.ext, 'serialization_format', 'cdr')
            channel = Channel(number, connection.topic, encoding, metadata, number)
            schema = Schema(number, text.encode(), 'ros2msg', connection.msgtype)
            out.append(ChannelInfo(channel, schema, connection.msgcount))
    return out


def messages_of_bag(source: PathLike, topics: Collection[str] | None) -> Iterator[BagMessage]:
    """Yield the messages of a bag in the order of log time. Raises DataError."""
    with _opened(source) as bag:
        wanted = [c for c in bag.connections if topics is None or c.topic in topics]
        if wanted:
            for connection, time_ns, data in bag.messages(wanted):
                yield BagMessage(connection.topic, connection.msgtype, time_ns, bytes(data))


def _plain(profiles: object) -> list[object]:
    """Return QoS profiles, of which rosbags makes objects, as YAML contains them; or none."""
    if isinstance(profiles, list) and all(isinstance(item, dict) for item in profiles):
        return profiles
    return []


@contextmanager
def _opened(source: PathLike) -> Iterator[Reader]:
    """Open a bag; every error of the library becomes a DataError."""
    check_regular_file(source)
    for name in os.listdir(source) if os.path.isdir(source) else ():
        check_regular_file(os.path.join(source, name))
    try:
        with Reader(Path(source)) as bag:
            yield bag
    except DataError:
        raise
    except Exception as error:  # a damaged bag makes the library raise almost anything
        cause = ' '.join(str(error).split())[:MAX_CAUSE] or type(error).__name__
        raise DataError(f'{source}: the bag cannot be read ({cause})') from None
