# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Recover recorded bags that are truncated anywhere or have a flipped bit."""

from __future__ import annotations

import random
import time
from collections import Counter
from pathlib import Path

from mcap.reader import make_reader

from fluoro_calib_ros.errors import DataError
from fluoro_calib_ros.io.bags.metadata import (
    TARGET_OBSERVATIONS,
    known_definition,
    message_from_frame,
    profile,
    to_cdr,
)
from fluoro_calib_ros.io.bags.reader import iterate_messages
from fluoro_calib_ros.io.bags.recording import Recording, RecordingOptions, TopicToRecord
from fluoro_calib_ros.io.bags.salvage import recover_bag
from fluoro_calib_ros.simulation.rig import StreamStart, simulate_tracking, virtual_rig

from ..timing import section

Message = tuple[str, int, bytes]
Chunk = tuple[int, int, list[Message]]  # first byte, end (exclusive), messages


def run(folder: Path, count: int, seed: int) -> str:
    """Damage a recorded bag 2 x `count` times each way; return the section of the report."""
    bag = recorded(folder / 'bag')
    content = bag.read_bytes()
    chunks = chunks_of(bag)
    rng = random.Random(seed)
    rows = []
    for name in ('cut off', 'one bit flipped'):
        found: Counter[str] = Counter()
        for number in range(2 * count):
            damaged = bytearray(content)
            place = rng.randrange(len(content))
            if name == 'cut off':
                del damaged[place:]
                intact = [m for _, end, inside in chunks if end <= place for m in inside]
            else:
                damaged[place] ^= 1 << rng.randrange(8)
                intact = [m for a, end, inside in chunks if not a <= place < end for m in inside]
            path = folder / 'damaged.mcap'
            path.write_bytes(damaged)
            found += judged(path, folder / f'{name[:3]}_{number}', Counter(intact), chunks)
        rows.append([name, *(str(found[key]) for key in KEYS)])
    return section(
        'Damaged bags',
        f'A recording of {len(chunks)} chunks with {sum(len(c[2]) for c in chunks)} messages. '
        'Whole: all messages of undamaged chunks were recovered. False: messages were recovered '
        'that had not been recorded. Silent: messages were lost and nothing was said.',
        ('damage', *KEYS),
        rows,
    )


KEYS = ('bags', 'whole', 'nothing to recover', 'incomplete', 'false', 'silent')


def judged(path: Path, out: Path, intact: Counter[Message], chunks: list[Chunk]) -> Counter[str]:
    """Recover a damaged bag, and return the outcome by KEYS."""
    everything = Counter(m for *_, inside in chunks for m in inside)
    found: Counter[str] = Counter(bags=1)
    try:
        recovery = recover_bag(path, out)
    except DataError:
        return found + Counter({'incomplete' if intact else 'nothing to recover': 1})
    held = Counter((m.topic, m.log_time_ns, m.data) for m in iterate_messages(out))
    found['whole'] += held >= intact
    found['incomplete'] += not held >= intact
    found['false'] += not held <= everything
    found['silent'] += held != everything and not recovery.damages
    return found


def recorded(path: Path) -> Path:
    """Record moving markers; return the file of the bag."""
    recording = Recording(path, RecordingOptions(flush_period=0.05))
    recording.start()
    frames = simulate_tracking(virtual_rig(1), 4.0, 120.0, 1, 0.25, StreamStart(10**18)).frames
    for name in frames:
        topic = f'/{name}/target_observations'
        definition = known_definition(TARGET_OBSERVATIONS)
        recording.add_topic(TopicToRecord(topic, TARGET_OBSERVATIONS, [profile()], definition))
    for pair in zip(*frames.values()):
        for number, frame in enumerate(pair):
            data = to_cdr(message_from_frame(frame), TARGET_OBSERVATIONS)
            time_ns = frame.stamp_ns + number  # unique time of each message
            recording.put(f'/{frame.fluoroscope}/target_observations', data, time_ns, time_ns)
        time.sleep(0.004)  # gives many flushes and thus many chunks
    recording.stop()
    return next(path.glob('*.mcap'))


def chunks_of(path: Path) -> list[Chunk]:
    """Return the chunks of a file with their messages, using its index."""
    with open(path, 'rb') as file:
        reader = make_reader(file)
        messages = [(c.topic, m.log_time, m.data) for _, c, m in reader.iter_messages()]
        summary = reader.get_summary()
    assert summary is not None
    return [
        (
            chunk.chunk_start_offset,
            chunk.chunk_start_offset + chunk.chunk_length,
            [m for m in messages if chunk.message_start_time <= m[1] <= chunk.message_end_time],
        )
        for chunk in summary.chunk_indexes
    ]
