# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Read every kind of bag that this package writes with three other readers, and compare results.

python tools/bag_readers/read_bags.py [FOLDER ...]

The readers: mcap (Python), rosbags, and @mcap/core with @foxglove/rosmsg2-serialization (npm,
installed next to this file by `make bag-readers`). All must find the same topic, times and bytes
of each message, and the two that decode must find the same values. Without folders, bags are made:
by simulate, by a recording in parts with images and latched messages, and by recovering a
truncated bag.
"""

from __future__ import annotations

import dataclasses
import hashlib
import struct
import subprocess
import sys
import tempfile
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
from mcap.reader import make_reader
from rosbags.highlevel import AnyReader

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE.parents[1]))

from fluoro_calib_ros.io.bags.metadata import (  # noqa: E402
    TARGET_OBSERVATIONS,
    known_definition,
    message_from_frame,
    profile,
    to_cdr,
    typestore,
)
from fluoro_calib_ros.io.bags.reader import read_frames  # noqa: E402
from fluoro_calib_ros.io.bags.recording import Recording, RecordingOptions, TopicToRecord  # noqa: E402
from fluoro_calib_ros.io.bags.salvage import recover_bag  # noqa: E402
from fluoro_calib_ros.jobs.simulation import SimulationOptions, simulate  # noqa: E402

IMAGE = 'sensor_msgs/msg/Image'
STRING = 'std_msgs/msg/String'


def made_bags(folder: Path) -> list[Path]:
    """Write bags of all kinds; return their folders."""
    simulate(folder / 'rig', SimulationOptions(1, 5, 0, 1.0))
    tracking = folder / 'rig' / 'tracking'
    recorded = folder / 'recorded'
    record(recorded, tracking)
    parts = sorted(recorded.glob('*.mcap'))
    if len(parts) < 2:
        raise SystemExit('the recording has one file only')
    cut = folder / 'cut.mcap'
    content = parts[0].read_bytes()
    cut.write_bytes(content[: 2 * len(content) // 3])
    recover_bag(parts[0], folder / 'recovered')
    recover_bag(cut, folder / 'recovered_cut')
    return [
        folder / 'rig' / 'calibration',
        tracking,
        recorded,
        folder / 'recovered',
        folder / 'recovered_cut',
    ]


def record(path: Path, tracking: Path) -> None:
    """Record frames, images and a latched message in files of 1 MB each."""
    types = typestore().types
    recording = Recording(path, RecordingOptions(split_size=1.0, flush_period=0.05))
    recording.start()
    for name, kind, latched in (
        ('/note', STRING, 1),
        ('/a/target_observations', TARGET_OBSERVATIONS, 0),
        ('/a/image_raw', IMAGE, 0),
    ):
        durability = 'transient_local' if latched else 'volatile'
        qos = [profile(durability=durability)]
        recording.add_topic(TopicToRecord(name, kind, qos, known_definition(kind), latched))
    note = to_cdr(types[STRING](data='tube b was warm: 40 °C'), STRING)
    recording.put('/note', note, 1, 1)
    rng = np.random.default_rng(1)
    header, time = types['std_msgs/msg/Header'], types['builtin_interfaces/msg/Time']
    for frame in read_frames(tracking).frames['a']:
        data = to_cdr(message_from_frame(frame), TARGET_OBSERVATIONS)
        recording.put('/a/target_observations', data, frame.stamp_ns, frame.stamp_ns - 7)
        if frame.number % 10 == 0:
            stamp = time(sec=frame.stamp_ns // 10**9, nanosec=frame.stamp_ns % 10**9)
            pixels = rng.integers(0, 256, 512 * 512, np.uint8)
            image = types[IMAGE](
                header(stamp=stamp, frame_id='a_optical'), 512, 512, 'mono8', 0, 512, pixels
            )
            recording.put('/a/image_raw', to_cdr(image, IMAGE), frame.stamp_ns, frame.stamp_ns)
    recording.stop()
    if recording.fault or recording.dropped:
        raise SystemExit(recording.fault or 'messages were dropped')


Message = tuple[str, int, int, str]  # topic, times of reception and publication [ns], digest


def by_mcap(bag: Path) -> Counter[Message]:
    """Read the messages of a bag with the Python package mcap."""
    found: Counter[Message] = Counter()
    for path in sorted(bag.glob('*.mcap')):
        with open(path, 'rb') as file:
            for _, channel, message in make_reader(file, validate_crcs=True).iter_messages():
                digest = hashlib.sha256(message.data).hexdigest()
                found[channel.topic, message.log_time, message.publish_time, digest] += 1
    return found


def by_rosbags(bag: Path) -> tuple[Counter[tuple[str, int, str]], Counter[tuple[str, int, str]]]:
    """Read a bag with rosbags; return digests of the bytes and of the values."""
    raw: Counter[tuple[str, int, str]] = Counter()
    values: Counter[tuple[str, int, str]] = Counter()
    with AnyReader([bag]) as reader:  # uses the message definitions stored in the bag
        for connection, time_ns, data in reader.messages():
            raw[connection.topic, time_ns, hashlib.sha256(data).hexdigest()] += 1
            message = reader.deserialize(data, connection.msgtype)
            hashed = hashlib.sha256()
            add_values(hashed, message)
            values[connection.topic, time_ns, hashed.hexdigest()] += 1
    return raw, values


def add_values(hashed: Any, value: Any) -> None:
    """Add all values of a message to a hash as read_bag.mjs does."""
    if dataclasses.is_dataclass(value):
        for field in dataclasses.fields(value):
            if not field.name.startswith('__'):
                add_values(hashed, getattr(value, field.name))
    elif isinstance(value, (np.ndarray, list, tuple)):
        hashed.update(f'[{len(value)}]'.encode())
        for item in value.tolist() if isinstance(value, np.ndarray) else value:
            add_values(hashed, item)
    elif isinstance(value, float):
        hashed.update(f'{struct.pack(">d", value).hex()};'.encode())
    elif isinstance(value, str):
        hashed.update(f'{value.encode().hex()};'.encode())
    else:
        hashed.update(f'{int(value)};'.encode())


def by_foxglove(bag: Path) -> tuple[Counter[Message], Counter[tuple[str, int, str]]]:
    """Read a bag with the npm packages; return digests of the bytes and of the values."""
    raw: Counter[Message] = Counter()
    values: Counter[tuple[str, int, str]] = Counter()
    done = subprocess.run(
        ['node', HERE / 'read_bag.mjs', *sorted(bag.glob('*.mcap'))],
        cwd=HERE,
        stdout=subprocess.PIPE,
        text=True,
        check=True,
    )
    for line in done.stdout.splitlines():
        topic, log_time, publish_time, of_bytes, of_values = line.split()
        raw[topic, int(log_time), int(publish_time), of_bytes] += 1
        values[topic, int(log_time), of_values] += 1
    return raw, values


def compare(bag: Path) -> int:
    """Compare the results of the readers for a bag; return the number of messages."""
    one = by_mcap(bag)
    raw, values = by_rosbags(bag)
    other, other_values = by_foxglove(bag)
    without_publication: Counter[tuple[str, int, str]] = Counter()
    for (topic, log_time, _, digest), count in one.items():
        without_publication[topic, log_time, digest] += count
    for name, equal in (
        ('bytes by mcap and @mcap/core', one == other),
        ('bytes by mcap and rosbags', without_publication == raw),
        ('values by rosbags and @foxglove/rosmsg2-serialization', values == other_values),
    ):
        if not equal:
            raise SystemExit(f'{bag}: different {name}')
    return one.total()


def main() -> None:
    """Compare the bags given on the command line, or newly created ones."""
    with tempfile.TemporaryDirectory() as folder:
        bags = [Path(word).resolve() for word in sys.argv[1:]] or made_bags(Path(folder))
        for bag in bags:
            print(f'{bag.name}: {compare(bag)} messages, equal for all readers', flush=True)


if __name__ == '__main__':
    main()
