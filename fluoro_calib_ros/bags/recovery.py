# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Recover a bag: all intact messages of a damaged or cut-off one, written as a valid bag."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass

import yaml

from ..errors import DataError
from ..files.access import read_text
from ..files.yaml_text import parse_yaml
from .definitions import Definition
from .qos import parse_profiles, profile
from .salvage import Damage, FileSalvage, SalvagedMessage, SalvagedTopic
from .storage import PathLike, candidate_files
from .writer import BagWriter


@dataclass(frozen=True)
class Recovery:
    """What was recovered from a bag.

    Attributes
    ----------
    counts : mapping of str to int
        Number of recovered messages by topic.
    expected : mapping of str to int
        Number of messages that the bag had, as far as it says so, by topic.
    damages : sequence of Damage
    skipped : mapping of str to str
        Why topics were left out.
    """

    counts: dict[str, int]
    expected: dict[str, int]
    damages: tuple[Damage, ...]
    skipped: dict[str, str]

    @property
    def lost(self) -> dict[str, int]:
        """Number of messages that are known to be lost, by topic."""
        lost = {t: n - self.counts.get(t, 0) for t, n in self.expected.items()}
        return {topic: count for topic, count in lost.items() if count > 0}


class Salvage:
    """The intact messages of a bag, file by file; topics and damages as far as it was read."""

    def __init__(self, source: PathLike) -> None:
        self.files = [FileSalvage(path) for path in candidate_files(source)]
        self._metadata = _expected_of_metadata(source)

    def messages(self) -> Iterator[tuple[FileSalvage, SalvagedMessage]]:
        """Yield file and message in the order in which they were written. Raises DataError."""
        for file in self.files:
            for message in file.messages():
                yield file, message

    @property
    def damages(self) -> tuple[Damage, ...]:
        """All damages that were found."""
        return tuple(damage for file in self.files for damage in file.damages)

    @property
    def expected(self) -> dict[str, int]:
        """Number of messages that the bag had, as far as it says so, by topic."""
        total: Counter[str] = Counter()
        for file in self.files:
            total += file.expected
        return {**total, **self._metadata}


def recover_bag(source: PathLike, out: PathLike) -> Recovery:
    """Write the intact messages of a bag to a new one.

    Parameters
    ----------
    source : path-like
        An .mcap file or a bag folder.
    out : path-like
        Folder of the new bag, which must not exist.

    Returns
    -------
    Recovery

    Raises
    ------
    DataError
        For a source without any intact message, and where the bag cannot be written.
    """
    salvage = Salvage(source)
    if os.path.realpath(out).startswith(os.path.join(os.path.realpath(source), '')):
        raise DataError(f'{out}: the output lies in the input {source}, choose another output')
    counts: Counter[str] = Counter()
    skipped: dict[str, str] = {}
    with BagWriter(out) as bag:
        for file, message in salvage.messages():
            topic = file.topics[message.topic]
            if message.topic not in counts and message.topic not in skipped:
                reason = _added(bag, topic)
                if reason:
                    skipped[message.topic] = reason
            if message.topic in skipped:
                continue
            bag.write(
                message.topic,
                topic.msg_type,
                message.data,
                message.log_time_ns,
                message.publish_time_ns,
            )
            counts[message.topic] += 1
        if not counts:
            causes = sorted({damage.cause for damage in salvage.damages} | {*skipped.values()})
            raise DataError(
                f'{source}: nothing can be recovered ({"; ".join(causes) or "no messages"})'
            )
    return Recovery(dict(sorted(counts.items())), salvage.expected, salvage.damages, skipped)


def _added(bag: BagWriter, topic: SalvagedTopic) -> str:
    """Add a topic to a bag; returns why that is not possible, or ''."""
    if topic.encoding != 'cdr':
        return f'the messages are encoded as {topic.encoding!r}'
    definition = Definition(topic.text, topic.schema_encoding, topic.type_hash)
    try:
        bag.add_topic(
            topic.name, topic.msg_type, parse_profiles(topic.qos) or [profile()], definition
        )
    except DataError as error:
        return str(error)
    return ''


def _expected_of_metadata(source: PathLike) -> dict[str, int]:
    """Return the numbers of messages by topic in metadata.yaml, if there is one."""
    path = os.path.join(source, 'metadata.yaml')
    if not os.path.isdir(source) or not os.path.exists(path):
        return {}
    try:
        information = parse_yaml(read_text(path))['rosbag2_bagfile_information']
        return {
            str(entry['topic_metadata']['name']): int(entry['message_count'])
            for entry in information['topics_with_message_count']
        }
    except (DataError, yaml.YAMLError, KeyError, TypeError, ValueError):
        return {}
