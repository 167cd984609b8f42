"""Writing a bag as rosbag2 (Jazzy) does: a folder NAME with NAME_0.mcap and metadata.yaml.

The layout follows rosbag2's sources (sequential_writer.cpp, mcap_storage.cpp, yaml.hpp of the
branch jazzy).
"""

import os
import re
import secrets
import shutil
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field

import numpy as np
from mcap.writer import CompressionType, Writer

from ..errors import DataError
from ..files.access import cause_of
from ..files.atomic import sync_folder, write_text
from .definitions import TARGET_OBSERVATIONS, full_text, message_class, to_cdr, type_hash
from .qos import PROFILES, to_yaml

LIBRARY = 'fluoro_calib_ros'
NEVER = 2**63 - 1  # starting time of a bag without messages
CHUNK_SIZE = 768 * 1024  # of rosbag2
_TOPIC = re.compile(r'(/[A-Za-z_][A-Za-z0-9_]*)+')


@dataclass
class _Span:
    """Number of messages and the time they span [ns]."""

    path: str = ''
    count: int = 0
    start: int = NEVER
    end: int = -1

    def add(self, time):
        self.count, self.start, self.end = (
            self.count + 1,
            min(self.start, time),
            max(self.end, time),
        )

    def times(self):
        return {
            'starting_time': {'nanoseconds_since_epoch': self.start},
            'duration': {'nanoseconds': max(self.end - self.start, 0)},
        }


@dataclass
class _Topic:
    """A topic of a bag: its type, its quality of service and the number of its messages."""

    name: str
    msg_type: str
    qos: list
    count: int = 0
    channel: int = field(default=0, compare=False)  # in the present file

    def metadata(self):
        return {
            'topic_metadata': {
                'name': self.name,
                'type': self.msg_type,
                'serialization_format': 'cdr',
                'offered_qos_profiles': self.qos,
                'type_description_hash': type_hash(self.msg_type),
            },
            'message_count': self.count,
        }


class BagWriter:
    """A new bag, as a context manager; the same messages give the same bytes.

    path: the bag's folder. It is written under another name and gets its own when the block has
    ended well; an exception leaves nothing behind, and what was there before as it was. overwrite:
    replace a bag of that name. live, for recording: written in place, and what came before an
    exception is kept. split_bytes: size of a file [bytes] at which the next one is begun, 0:
    never. Raises DataError where a folder or file of that name is there, where it cannot be
    written, and for topics, types and messages that cannot be.
    """

    def __init__(self, path, overwrite=False, live=False, split_bytes=0):
        self.path = os.path.abspath(path)
        self.name = os.path.basename(self.path)
        self._overwrite = overwrite
        self._live = live
        self._split_bytes = split_bytes
        self._folder = self.path
        if not live:
            hidden = f'.{self.name}.{secrets.token_hex(8)}.tmp'
            self._folder = os.path.join(os.path.dirname(self.path), hidden)
        self._topics = {}
        self._files = []
        self._total = _Span()
        self._file = self._mcap = None
        self._schemas = {}

    def __enter__(self):
        check_replaceable(self.path, self._overwrite)
        try:
            with _writing(self.path):
                if self._live and os.path.isdir(self.path):
                    shutil.rmtree(self.path)
                os.makedirs(self._folder)
                self._open_file()
        except BaseException:
            self._give_up()
            raise
        return self

    def __exit__(self, kind, error, trace):
        if kind is not None and not self._live:
            self._give_up()
            return
        try:
            with _writing(self.path):
                self._close_file()
                write_text(os.path.join(self._folder, 'metadata.yaml'), self._metadata_yaml())
                if not self._live:
                    _put_in_place(self._folder, self.path, self._overwrite)
        except BaseException:
            self._give_up()
            raise

    def write(
        self, topic, msg_type, message, log_time_ns, publish_time_ns=None, qos='observations'
    ):
        """Write a message, a dataclass of the typestore or CDR bytes.

        log_time_ns: when it was received, publish_time_ns: when it was sent (None: the same). qos:
        a name in PROFILES or a list of profiles, of the first message of a topic. Raises
        DataError.
        """
        data = (
            bytes(message)
            if isinstance(message, (bytes, bytearray, memoryview))
            else to_cdr(message, msg_type)
        )
        time = int(log_time_ns)
        sent = time if publish_time_ns is None else int(publish_time_ns)
        if not (0 <= time < NEVER and 0 <= sent < NEVER):
            raise DataError(
                f'{self.path}, topic {topic}: the time {min(time, sent)} ns cannot stand in a bag'
            )
        with _writing(self.path):
            entry = self._topics.get(topic) or self.add_topic(topic, msg_type, qos)
            if entry.msg_type != msg_type:
                raise DataError(
                    f'{self.path}, topic {topic}: a message of type {msg_type} does not belong to '
                    f'this topic of type {entry.msg_type}'
                )
            if (
                self._split_bytes
                and self._files[-1].count
                and self._file.tell() >= self._split_bytes
            ):
                self._close_file()
                self._open_file()
            self._mcap.add_message(entry.channel, time, data, sent)
        entry.count += 1
        self._files[-1].add(time)
        self._total.add(time)

    def write_frame(self, frame, topic=None, namespace='', log_time_ns=None):
        """Write a Frame as TargetObservations to topic, None:
        <namespace>/<fluoroscope>/target_observations.

        log_time_ns None: the stamp of the frame. Raises DataError.
        """
        topic = topic or observations_topic(frame.fluoroscope, namespace)
        time = frame.stamp_ns if log_time_ns is None else log_time_ns
        self.write(topic, TARGET_OBSERVATIONS, message_from_frame(frame), time)

    def add_topic(self, topic, msg_type, qos='observations'):
        """Make a topic known that may stay without messages. Raises DataError for a name or type
        that cannot be.
        """
        if not _TOPIC.fullmatch(topic):
            raise DataError(f'{self.path}: {topic!r} cannot be the name of a ROS topic')
        message_class(msg_type)
        profiles = [PROFILES[qos]] if isinstance(qos, str) else list(qos)
        self._topics[topic] = _Topic(topic, msg_type, profiles)
        self._register(self._topics[topic])
        return self._topics[topic]

    def flush(self):
        """Hand all messages so far to the system: a recording that is killed keeps them."""
        with _writing(self.path):
            self._mcap.flush()

    def _open_file(self):
        name = f'{self.name}_{len(self._files)}.mcap'
        self._files.append(_Span(name))
        self._file = open(os.path.join(self._folder, name), 'xb')
        chunk_size = min(CHUNK_SIZE, self._split_bytes or CHUNK_SIZE)  # a file grows by chunks
        self._mcap = Writer(
            self._file,
            chunk_size=chunk_size,
            compression=CompressionType.ZSTD,
            enable_crcs=True,
            enable_data_crcs=True,
        )
        self._mcap.start(profile='ros2', library=LIBRARY)
        self._write_metadata([])  # rosbag2 does so too: a killed recording tells what it is
        self._schemas = {}
        for topic in self._topics.values():
            self._register(topic)

    def _register(self, topic):
        """Schema and channel of a topic in the present file."""
        if topic.msg_type not in self._schemas:
            self._schemas[topic.msg_type] = self._mcap.register_schema(
                topic.msg_type, 'ros2msg', full_text(topic.msg_type).encode()
            )
        topic.channel = self._mcap.register_channel(
            topic.name,
            'cdr',
            self._schemas[topic.msg_type],
            {
                'offered_qos_profiles': to_yaml(topic.qos),
                'topic_type_hash': type_hash(topic.msg_type),
            },
        )

    def _close_file(self):
        self._mcap.flush()  # the last chunk comes before the metadata
        self._write_metadata(self._topics.values())
        self._mcap.finish()
        self._file.flush()
        os.fsync(self._file.fileno())
        self._file.close()

    def _write_metadata(self, topics):
        self._mcap.add_metadata(
            'rosbag2', {'serialized_metadata': to_yaml(self._metadata(topics))}
        )

    def _metadata(self, topics):
        return {
            'version': 9,
            'storage_identifier': 'mcap',
            'duration': self._total.times()['duration'],
            'starting_time': self._total.times()['starting_time'],
            'message_count': self._total.count,
            'topics_with_message_count': [t.metadata() for t in topics],
            'compression_format': '',
            'compression_mode': '',  # of whole files; the chunks have their own
            'relative_file_paths': [file.path for file in self._files],
            'files': [
                {'path': file.path, **file.times(), 'message_count': file.count}
                for file in self._files
            ],
            'custom_data': None,
            'ros_distro': 'jazzy',
        }

    def _metadata_yaml(self):
        return (
            to_yaml({'rosbag2_bagfile_information': self._metadata(self._topics.values())}) + '\n'
        )

    def _give_up(self):
        with suppress(OSError, AttributeError):
            self._file.close()
        if not self._live:
            shutil.rmtree(self._folder, ignore_errors=True)


def observations_topic(fluoroscope, namespace=''):
    """Absolute topic of the observations of a fluoroscope, in a namespace such as '/rig'."""
    return '/' + '/'.join(
        [*namespace.strip('/').split('/'), fluoroscope, 'target_observations']
    ).lstrip('/')


def message_from_frame(frame):
    """TargetObservations of a Frame, as a dataclass of the typestore."""
    uv = np.asarray(frame.uv, dtype=np.float64).reshape(-1, 2)
    stamp = message_class('builtin_interfaces/msg/Time')(*divmod(int(frame.stamp_ns), 10**9))
    sigma = [] if frame.sigma is None else frame.sigma
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


def check_replaceable(path, overwrite):
    """Check that a new bag may get the name path: nothing is there, or with overwrite a bag.
    Raises DataError.
    """
    if not os.path.lexists(path):
        return
    if not overwrite:
        raise DataError(f'{path}: this is there already, and is not overwritten')
    if not os.path.isdir(path) or os.path.islink(path):
        raise DataError(f'{path}: this is no bag folder, it is not overwritten')
    strange = [
        name
        for name in sorted(os.listdir(path))
        if name != 'metadata.yaml' and not name.endswith('.mcap')
    ]
    if strange:
        raise DataError(
            f'{path}: the folder holds {strange[0]}, which does not belong to a bag; '
            f'it is not overwritten'
        )


def _put_in_place(folder, path, overwrite):
    """Give a folder its final name; with overwrite a bag of that name goes away, but not before."""
    sync_folder(folder)
    old = f'{folder}.old'
    replaced = overwrite and os.path.isdir(path)
    if replaced:
        os.rename(path, old)
    try:
        os.rename(folder, path)
    except OSError:
        if replaced:
            os.rename(old, path)
        raise
    sync_folder(os.path.dirname(path))
    if replaced:
        shutil.rmtree(old, ignore_errors=True)


@contextmanager
def _writing(path):
    """Turns what the system says against writing into DataError."""
    try:
        yield
    except OSError as error:
        raise DataError(f'{path}: the bag cannot be written ({cause_of(error)})') from None
