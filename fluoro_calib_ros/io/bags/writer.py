# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Write a bag in the layout of rosbag2 (Jazzy): a folder NAME, NAME_0.mcap and metadata.yaml.

The layout follows rosbag2's sources (sequential_writer.cpp, mcap_storage.cpp, yaml.hpp of the
branch jazzy).
"""

from __future__ import annotations

import os
import re
import secrets
import shutil
from collections.abc import Iterable
from contextlib import suppress
from typing import Any, BinaryIO

from mcap.writer import CompressionType, Writer

from ...errors import DataError
from ...exposures.frame import Frames
from ..access import PathLike, hidden_path, os_errors, sync_folder, write_text
from ..folder import PREVIOUS, put_in_place
from .metadata import (
    NO_MESSAGE_NS,
    PROFILES,
    TARGET_OBSERVATIONS,
    BagTopic,
    Definition,
    FileSpan,
    bag_metadata,
    known_definition,
    message_from_frame,
    observations_topic,
    to_cdr,
    to_yaml,
)

LIBRARY = 'fluoro_calib_ros'
NOT_WRITTEN = 'the bag cannot be written'
CHUNK_SIZE = 768 * 1024  # chunk size of rosbag2 [bytes]
_TOPIC_NAME = re.compile(r'(/[A-Za-z_][A-Za-z0-9_]*)+')

Qos = str | list[dict[str, Any]]  # key of PROFILES, or QoS profiles


class BagWriter:
    """A new bag, as a context manager; the same messages give the same bytes.

    The bag is written under a temporary name and renamed when the block ends without an error.
    After an exception nothing is left behind, and a bag that was to be replaced is unchanged.

    Parameters
    ----------
    path : path-like
        Folder of the bag.
    overwrite : bool
        Whether to replace an existing bag, which is kept as NAME.previous.
    live : bool
        For recording: the bag is written under its final name, and messages written before an
        exception are kept.

    Raises
    ------
    DataError
        If a folder or file must not be replaced, if the bag cannot be written, and for an invalid
        topic, type or message.
    """

    def __init__(self, path: PathLike, overwrite: bool = False, live: bool = False) -> None:
        self.path = os.path.abspath(path)
        self.name = os.path.basename(self.path)
        self._overwrite = overwrite
        self._live = live
        hidden = hidden_path(self.path, secrets.token_hex(8), 'tmp')
        self._folder = self.path if live else hidden
        self._topics: dict[str, BagTopic] = {}
        self._files: list[FileSpan] = []
        self._total = FileSpan()
        self._schemas: dict[str, int] = {}  # schema id by message type, in the file being written
        self._file: BinaryIO
        self._mcap: Writer

    def __enter__(self) -> BagWriter:
        check_replaceable(self.path, self._overwrite)
        if self._overwrite:
            check_replaceable(self.path + PREVIOUS, overwrite=True)
        try:
            with os_errors(self.path, NOT_WRITTEN):
                os.makedirs(self._folder)
                self._open_file()
        except BaseException:
            self._abandon()
            raise
        return self

    def __exit__(self, kind: object, error: object, traceback: object) -> None:
        if kind is not None and not self._live:
            self._abandon()
            return
        try:
            with os_errors(self.path, NOT_WRITTEN):
                self._close_file()
                document = bag_metadata(self._topics.values(), self._files, self._total)
                text = to_yaml({'rosbag2_bagfile_information': document}) + '\n'
                write_text(os.path.join(self._folder, 'metadata.yaml'), text)
                if self._overwrite:
                    sync_folder(self._folder)
                    put_in_place(self._folder, self.path)
                elif not self._live:
                    sync_folder(self._folder)
                    os.rename(self._folder, self.path)
                    sync_folder(os.path.dirname(self.path))
        except BaseException:
            self._abandon()
            raise

    def write(
        self,
        topic: str,
        msg_type: str,
        message: Any,
        log_time_ns: int,
        publish_time_ns: int | None = None,
        qos: Qos = 'observations',
    ) -> None:
        """Write a message.

        Parameters
        ----------
        topic : str
        msg_type : str
        message : object
            A dataclass of the typestore, or CDR as bytes.
        log_time_ns : int
            Time of reception [ns].
        publish_time_ns : int, optional
            Time of publication [ns]; by default log_time_ns.
        qos : str or list of dict
            A key of PROFILES or QoS profiles; only used with the first message of a topic.

        Raises
        ------
        DataError
        """
        is_cdr = isinstance(message, (bytes, bytearray, memoryview))
        data = bytes(message) if is_cdr else to_cdr(message, msg_type)
        received_ns = int(log_time_ns)
        sent_ns = received_ns if publish_time_ns is None else int(publish_time_ns)
        for time_ns in (received_ns, sent_ns):
            if not 0 <= time_ns < NO_MESSAGE_NS:
                raise DataError(
                    f'{self.path}, topic {topic}: {time_ns} ns is not a time that a bag can hold'
                )
        with os_errors(self.path, NOT_WRITTEN):
            entry = self._topics.get(topic) or self.add_topic(topic, msg_type, qos)
            if entry.msg_type != msg_type:
                raise DataError(
                    f'{self.path}, topic {topic}: a message of type {msg_type} does not belong to '
                    f'this topic of type {entry.msg_type}'
                )
            self._mcap.add_message(entry.channel, received_ns, data, sent_ns)
        entry.count += 1
        self._files[-1].add(received_ns)
        self._total.add(received_ns)

    def add_topic(
        self,
        topic: str,
        msg_type: str,
        qos: Qos = 'observations',
        definition: Definition | None = None,
    ) -> BagTopic:
        """Add a topic, which may remain without messages.

        Without a definition the type must be known to this program. Raises DataError for an
        invalid name and an unknown type.
        """
        check_topic_name(topic, self.path)
        definition = definition or known_definition(msg_type)
        profiles = [PROFILES[qos]] if isinstance(qos, str) else list(qos)
        self._topics[topic] = BagTopic(topic, msg_type, profiles, definition)
        self._register(self._topics[topic])
        return self._topics[topic]

    def flush(self, to_disk: bool = False) -> None:
        """Close the open chunk, so that its messages survive the end of the process.

        to_disk: also survive a power failure.
        """
        with os_errors(self.path, NOT_WRITTEN):
            self._mcap.flush()
            self._file.flush()
            if to_disk:
                os.fsync(self._file.fileno())

    @property
    def file_bytes(self) -> int:
        """Size of the file that is being written, without the open chunk [bytes]."""
        return self._file.tell()

    @property
    def file_count(self) -> int:
        """Number of files so far."""
        return len(self._files)

    def split(self) -> None:
        """Close the file and begin the next one."""
        with os_errors(self.path, NOT_WRITTEN):
            self._close_file()
            self._open_file()

    def _open_file(self) -> None:
        name = f'{self.name}_{len(self._files)}.mcap'
        self._files.append(FileSpan(name))
        self._file = open(os.path.join(self._folder, name), 'xb')  # noqa: SIM115
        self._mcap = Writer(
            self._file,
            chunk_size=CHUNK_SIZE,
            compression=CompressionType.ZSTD,
            enable_crcs=True,
            enable_data_crcs=True,
        )
        self._mcap.start(profile='ros2', library=LIBRARY)
        self._write_metadata([])  # like rosbag2: even a recording that was killed has metadata
        self._schemas = {}
        for topic in self._topics.values():
            self._register(topic)

    def _register(self, topic: BagTopic) -> None:
        """Write schema and channel of a topic to the file."""
        if topic.msg_type not in self._schemas:
            self._schemas[topic.msg_type] = self._mcap.register_schema(
                topic.msg_type, topic.definition.encoding, topic.definition.text.encode()
            )
        topic.channel = self._mcap.register_channel(
            topic.name,
            'cdr',
            self._schemas[topic.msg_type],
            {
                'offered_qos_profiles': to_yaml(topic.qos),
                'topic_type_hash': topic.definition.type_hash,
            },
        )

    def _close_file(self) -> None:
        self._mcap.flush()  # the last chunk precedes the metadata
        self._write_metadata(self._topics.values())
        self._mcap.finish()
        self._file.flush()
        os.fsync(self._file.fileno())
        self._file.close()

    def _write_metadata(self, topics: Iterable[BagTopic]) -> None:
        document = bag_metadata(topics, self._files, self._total)
        self._mcap.add_metadata('rosbag2', {'serialized_metadata': to_yaml(document)})

    def _abandon(self) -> None:
        """Close the file; delete the folder unless the bag is a recording."""
        with suppress(OSError, AttributeError):
            self._file.close()
        if not self._live:
            shutil.rmtree(self._folder, ignore_errors=True)


def write_bag(path: PathLike, frames: Frames) -> None:
    """Write frames as a bag folder, ordered by stamp. Raises DataError."""
    recorded = [frame for view_frames in frames.values() for frame in view_frames]
    with BagWriter(path, overwrite=True) as bag:
        for frame in sorted(recorded, key=lambda f: f.stamp_ns):
            topic = observations_topic(frame.fluoroscope)
            bag.write(topic, TARGET_OBSERVATIONS, message_from_frame(frame), frame.stamp_ns)


def check_topic_name(topic: str, path: str) -> None:
    """Raise DataError unless a topic of a bag has a name of ROS."""
    if not _TOPIC_NAME.fullmatch(topic):
        raise DataError(f'{path}: {topic!r} cannot be the name of a ROS topic')


def check_replaceable(path: str, overwrite: bool) -> None:
    """Raise DataError unless a new bag may be written to this path.

    The path must not exist; with overwrite it may be a folder that contains nothing but a bag.
    """
    if not os.path.lexists(path):
        return
    if not overwrite:
        raise DataError(f'{path}: this already exists, and is not overwritten')
    if not os.path.isdir(path) or os.path.islink(path):
        raise DataError(f'{path}: this is not a bag folder, it is not overwritten')
    for name in sorted(os.listdir(path)):
        if name != 'metadata.yaml' and not name.endswith('.mcap'):
            raise DataError(
                f'{path}: the folder holds {name}, which does not belong to a bag; '
                f'it is not overwritten'
            )
