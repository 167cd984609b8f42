# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What is in a bag, and what is wrong with it; damaged bags, too."""

from __future__ import annotations

import struct
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from ..errors import DataError
from .definitions import PACKAGE, TARGET_OBSERVATIONS, typestore
from .frames import fluoroscope_of_topic
from .recovery import Salvage
from .salvage import Damage
from .storage import PathLike

JUMP_NS = 1_000_000  # a time that much before the last one runs backwards
STREAM_NS = 100_000_000  # messages of a stream follow each other in less than that
GAP = 10  # times the usual interval of a stream is a gap
_NUMBERED = (TARGET_OBSERVATIONS, f'{PACKAGE}/msg/CorrectedObservations')


@dataclass
class TopicReport:
    """What a topic holds.

    Attributes
    ----------
    type : str
    log_ns, stamp_ns : list of int
        Times at which the messages were received, and those of their headers, if any [ns].
    numbers : list of int
        Frame numbers, of observations only.
    undecodable : int
        Messages whose header cannot be read.
    """

    type: str
    log_ns: list[int] = field(default_factory=list)
    stamp_ns: list[int] = field(default_factory=list)
    numbers: list[int] = field(default_factory=list)
    undecodable: int = 0

    @property
    def duration_s(self) -> float:
        """Time from the first message to the last."""
        return (max(self.log_ns) - min(self.log_ns)) * 1e-9 if self.log_ns else 0.0

    @property
    def interval_ns(self) -> float:
        """Usual time between two messages, by their stamps if they have some; NaN for one."""
        times = self.stamp_ns if len(self.stamp_ns) > 1 else self.log_ns
        return float(np.median(np.diff(times))) if len(times) > 1 else float('nan')

    @property
    def longest_gap_s(self) -> float:
        """Longest time between two messages, by stamps or when they were received."""
        steps = [np.diff(t).max() for t in (self.stamp_ns, self.log_ns) if len(t) > 1]
        return float(max(steps, default=0)) * 1e-9

    @property
    def has_gap(self) -> bool:
        """Whether a stream was interrupted; only messages with a header are a stream."""
        usual = self.interval_ns
        return (
            len(self.stamp_ns) > 1
            and 0 < usual < STREAM_NS
            and self.longest_gap_s * 1e9 > max(GAP * usual, STREAM_NS)
        )

    @property
    def backward_jumps(self) -> int:
        """Number of times that a clock ran backwards."""
        return sum(
            int((np.diff(times) < -JUMP_NS).sum()) for times in (self.log_ns, self.stamp_ns)
        )

    @property
    def restarts(self) -> int:
        """Number of times that the frame numbers began again."""
        return int((np.diff(self.numbers) < 0).sum())

    @property
    def repeated_frames(self) -> int:
        """Number of frames with the number of the one before."""
        return int((np.diff(self.numbers) == 0).sum())

    @property
    def missing_frames(self) -> int:
        """Number of frame numbers that were passed over."""
        steps = np.diff(self.numbers)
        return int((steps[steps > 1] - 1).sum())


@dataclass(frozen=True)
class BagReport:
    """What a bag holds, and its damages.

    Attributes
    ----------
    files : list of str
    topics : dict of str to TopicReport
    without_partner : dict of str to int
        Frames of every fluoroscope whose number another one does not have.
    damages : tuple of Damage
    lost : dict of str to int
        Number of messages that are known to be lost, by topic.
    """

    files: list[str]
    topics: dict[str, TopicReport]
    without_partner: dict[str, int]
    damages: tuple[Damage, ...]
    lost: dict[str, int]

    @property
    def faults(self) -> list[str]:
        """What is wrong, in sentences."""
        found = [f'{d.path}: {d.cause}' for d in self.damages]
        found += [f'{topic}: {count} messages are lost' for topic, count in self.lost.items()]
        for topic, report in self.topics.items():
            found += [f'{topic}: {text}' for text in _faults(report)]
        found += [
            f'fluoroscope {name}: {count} {"frame" if count == 1 else "frames"} without partner'
            for name, count in self.without_partner.items()
            if count
        ]
        return found


def inspect_bag(source: PathLike) -> BagReport:
    """Read a bag, also a damaged one, and report on it.

    Raises DataError for a source that is not a bag.
    """
    salvage = Salvage(source)
    topics: dict[str, TopicReport] = {}
    for file, message in salvage.messages():
        report = topics.get(message.topic)
        if report is None:
            report = topics[message.topic] = TopicReport(file.topics[message.topic].msg_type)
        report.log_ns.append(message.log_time_ns)
        _read_header(report, message.data)
    if not topics and salvage.damages:
        raise DataError(f'{source}: nothing can be read ({salvage.damages[0].cause})')
    counts = {topic: len(report.log_ns) for topic, report in topics.items()}
    lost = {t: n - counts.get(t, 0) for t, n in salvage.expected.items()}
    return BagReport(
        [file.path for file in salvage.files],
        dict(sorted(topics.items())),
        _without_partner(topics),
        salvage.damages,
        {topic: count for topic, count in lost.items() if count > 0},
    )


def _read_header(report: TopicReport, data: bytes) -> None:
    """Read stamp and frame number of a message that has them."""
    fields = typestore().fielddefs.get(report.type)
    if fields is None or not fields[1] or 'std_msgs/msg/Header' not in str(fields[1][0]):
        return
    order = '<' if data[1:2] == b'\x01' else '>'
    try:
        sec, nanosec, length = struct.unpack_from(f'{order}iII', data, 4)
        report.stamp_ns.append(sec * 10**9 + nanosec)
        if report.type in _NUMBERED:
            behind = 12 + length
            (number,) = struct.unpack_from(f'{order}I', data, 4 + behind + -behind % 4)
            report.numbers.append(number)
    except struct.error:
        report.undecodable += 1


def _without_partner(topics: Mapping[str, TopicReport]) -> dict[str, int]:
    """Return the number of frames without partner by fluoroscope, of two or more."""
    numbers: dict[str, Counter[int]] = {}
    for topic, report in topics.items():
        if report.type == TARGET_OBSERVATIONS and topic.count('/') > 1:
            numbers[fluoroscope_of_topic(topic)] = Counter(report.numbers)
    if len(numbers) < 2:
        return {}
    common = Counter(next(iter(numbers.values())))
    for each in numbers.values():
        common &= each
    return {name: (each - common).total() for name, each in sorted(numbers.items())}


def _faults(report: TopicReport) -> list[str]:
    found = []
    if report.has_gap:
        found.append(
            f'a gap of {report.longest_gap_s:.3f} s, the usual interval is '
            f'{report.interval_ns * 1e-6:.1f} ms'
        )
    if report.backward_jumps:
        found.append(f'the clock runs backwards {_times(report.backward_jumps)}')
    if report.missing_frames:
        noun = 'frame is' if report.missing_frames == 1 else 'frames are'
        found.append(f'{report.missing_frames} {noun} missing in the frame numbers')
    if report.repeated_frames:
        found.append(f'{report.repeated_frames} frame numbers are repeated')
    if report.restarts:
        found.append(f'the frame numbers begin again {_times(report.restarts)}')
    if report.undecodable:
        found.append(f'{report.undecodable} messages are too short for their type')
    return found


def _times(count: int) -> str:
    return 'once' if count == 1 else f'{count} times'
