# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Collect exposures from streams of frames: pair them, wait until the phantom stands still.

Exposures of a phantom that stands still count as one (`without_repeats`). Frames of a film of a
standing phantom differ only by part of their noise: extraction errors caused by the surroundings
of a bead are the same in all of them. Taken as separate exposures they would get too much weight,
and cost computing time. Therefore they are replaced by their median, one exposure.
"""

from __future__ import annotations

from collections import OrderedDict, deque
from collections.abc import Callable, Container, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import binary_dilation

from ..errors import DataError
from ..findings import Finding, Kind, Place, Severity
from ..options import option
from .frame import Frame, Frames, cells_of
from .pairing import (
    CompletePairer,
    PairingOptions,
    RecordedPairing,
    never_alone,
    recorded_exposures,
)

MIN_COMMON_TARGETS = 8  # two frames with fewer common targets cannot be compared
MAX_RECENT = 1000  # maximum number of remembered pairs
MAX_RECENT_RADIOGRAPHS = 32  # maximum per fluoroscope, while their frames are pending
MAX_GAP = 10  # longest gap in a stream, as a multiple of the still time

COLLECT_MODES = ('auto', 'all', 'still')  # modes for recordings
NO_STAMP = 'frames without a stamp do not show for how long the phantom stands still'

Pair = Mapping[str, Frame]


def displacement(one: Frame, other: Frame) -> float:
    """Return the median displacement [px] of the targets that two frames have in common.

    It is infinite for fewer than MIN_COMMON_TARGETS common targets.
    """
    _, in_one, in_other = np.intersect1d(
        one.target_id, other.target_id, assume_unique=True, return_indices=True
    )
    if len(in_one) < MIN_COMMON_TARGETS:
        return np.inf
    return float(np.median(np.linalg.norm(one.uv[in_one] - other.uv[in_other], axis=1)))


@dataclass(frozen=True)
class StillOptions:
    """Criteria for a phantom that stands still in a new pose.

    Frames further apart than still_time_s are single shots, each of which counts; except after a
    gap in a stream of up to ten times still_time_s.
    """

    still_time_s: float = option(
        0.1,
        'time for which the phantom has to stand still; frames have to cover half of it',
        minimum=0.0,
        maximum=60.0,
        unit='s',
    )
    still_px: float = option(
        1.0,
        'median displacement of the targets that counts as still',
        minimum=0.0,
        maximum=100.0,
        unit='px',
    )
    new_px: float = option(
        10.0,
        'median displacement of the targets from every collected exposure that makes a new pose',
        minimum=0.0,
        maximum=1000.0,
        unit='px',
    )


def displacement_of_pair(one: Pair, other: Pair) -> float:
    """Return the largest displacement [px] of a fluoroscope between two exposures.

    It is infinite for exposures of different fluoroscopes.
    """
    if one.keys() != other.keys():
        return np.inf
    return max(displacement(frame, other[name]) for name, frame in one.items())


def stamp_of(pair: Pair) -> int:
    """Return the stamp [ns] of an exposure, that of its first fluoroscope."""
    return next(iter(pair.values())).stamp_ns


class ExposureCollector:
    """Exposures collected from paired frames, and from frames that need no partner.

    exposures: the collected ones; coverage: covered part of the image by fluoroscope, which grows
    with them.
    """

    def __init__(self, fluoroscopes: Iterable[str], still: StillOptions | None = None) -> None:
        self.fluoroscopes = tuple(fluoroscopes)
        self.still = still or StillOptions()
        self.exposures: list[Pair] = []
        self.coverage: dict[str, Coverage] = {}
        self._numbers: set[tuple[str, int]] = set()  # fluoroscopes and frame numbers of exposures
        self._streams: dict[tuple[str, ...], _PoseStream] = {}  # by the fluoroscopes of exposures

    def offer(self, pair: Pair) -> str:
        """Collect a pair if the phantom stands still in a new pose.

        Returns '' if the pair was collected, otherwise the reason. The first frame of a stream is
        collected like a single shot, and discarded if the next ones show that the phantom moves.
        Pairs without a stamp are not collected.
        """
        if not stamp_of(pair):
            return NO_STAMP
        stream = self._streams.setdefault(tuple(pair), _PoseStream())
        moved = stream.moved_single(pair, self.still)
        if moved is not None:
            self._discard(moved)
        refusal, is_single = stream.refusal(pair, self.still)
        if refusal:
            return refusal
        for exposure in self.exposures:
            if displacement_of_pair(pair, exposure) < self.still.new_px:
                return 'this pose of the phantom is already collected'
        refusal = self.add(pair)
        stream.single = pair if not refusal and is_single else None
        return refusal

    def _discard(self, pair: Pair) -> None:
        """Remove an exposure."""
        kept = [exposure for exposure in self.exposures if exposure is not pair]
        self.exposures, self.coverage, self._numbers = [], {}, set()
        for exposure in kept:
            self.add(exposure)

    def add(self, pair: Pair) -> str:
        """Collect a pair unconditionally, unless one of its frame numbers is already collected.

        Returns '' if the pair was collected, otherwise the reason.
        """
        numbers = {(name, frame.number) for name, frame in pair.items()}
        if not numbers.isdisjoint(self._numbers):
            return f'frame {min(number for _, number in numbers)} is collected already'
        self.exposures.append(pair)
        self._numbers |= numbers
        for name, frame in pair.items():
            self.coverage.setdefault(name, Coverage(frame.image_size)).add(frame.uv)
        return ''

    def frames(self, fluoroscopes: Iterable[str] | None = None) -> dict[str, list[Frame]]:
        """Return the collected frames by fluoroscope.

        fluoroscopes: names of those to return, by default all. Raises DataError for an unknown
        name.
        """
        wanted = tuple(fluoroscopes or ())
        for name in wanted:
            if name not in self.fluoroscopes:
                raise DataError(
                    f'fluoroscope {name} is unknown, expected one of '
                    f'{", ".join(self.fluoroscopes)}'
                )
        return {
            name: [pair[name] for pair in self.exposures if name in pair]
            for name in self.fluoroscopes
            if not wanted or name in wanted
        }


class _PoseStream:
    """Recent exposures of the same fluoroscopes."""

    def __init__(self) -> None:
        self._recent: deque[Pair] = deque(maxlen=MAX_RECENT)
        self._is_streaming = False
        self.single: Pair | None = None  # collected as a single shot, but may begin a stream

    def moved_single(self, pair: Pair, still: StillOptions) -> Pair | None:
        """Return the single shot if the next pair shows that the phantom moved, else None."""
        single = self.single
        if single is None:
            return None
        if not 0 <= stamp_of(pair) - stamp_of(single) <= still.still_time_s * 1e9:
            self.single = None
        elif displacement_of_pair(pair, single) > still.still_px:
            self.single = None
            return single
        return None

    def refusal(self, pair: Pair, still: StillOptions) -> tuple[str, bool]:
        """Add a pair; return '' if the phantom stands still, otherwise the reason.

        The second value tells whether the pair is a single shot.
        """
        still_ns = still.still_time_s * 1e9
        stamp_ns = stamp_of(pair)
        window = [p for p in self._recent if 0 <= stamp_ns - stamp_of(p) <= still_ns]
        max_displacement = max((displacement_of_pair(pair, p) for p in window), default=0.0)
        span = max((stamp_ns - stamp_of(p) for p in window), default=0)
        self._update_streaming(stamp_ns, bool(window), still_ns)
        self._recent.append(pair)
        if max_displacement > still.still_px:
            return 'the phantom moves', False
        if self._is_streaming and span < still_ns / 2:
            return 'too few frames to decide whether the phantom stands still', False
        return '', not window

    def _update_streaming(self, now: int, follows: bool, still_ns: float) -> None:
        """Update whether frames arrive as a stream.

        A stream begins with the first frame that follows another one in time, and ends with a long
        gap.
        """
        previous_ns = stamp_of(self._recent[-1]) if self._recent else None
        if follows:
            self._is_streaming = True
        elif previous_ns is None or not 0 <= now - previous_ns <= MAX_GAP * still_ns:
            self._is_streaming = False


class RadiographCollector:
    """Small radiographs of the collected exposures, for their report.

    They arrive as separate messages, before or after the frames with the same stamps.
    """

    def __init__(self, names: Iterable[str]) -> None:
        self._recent: dict[str, OrderedDict[int, bytes]] = {n: OrderedDict() for n in names}
        self._wanted: dict[str, dict[int, bytes]] = {name: {} for name in self._recent}

    def add(self, name: str, stamp_ns: int, jpeg: bytes) -> None:
        """Store a radiograph: for its collected frame, or among the last ones."""
        if stamp_ns in self._wanted[name]:
            self._wanted[name][stamp_ns] = jpeg
        else:
            recent = self._recent[name]
            recent[stamp_ns] = jpeg
            if len(recent) > MAX_RECENT_RADIOGRAPHS:
                recent.popitem(last=False)

    def want(self, exposures: Iterable[Pair]) -> None:
        """Keep the radiographs of the frames of all collected exposures when they arrive."""
        pairs = tuple(exposures)
        for name, recent in self._recent.items():
            previous = self._wanted[name]
            stamps = [pair[name].stamp_ns for pair in pairs if name in pair]
            self._wanted[name] = {t: previous.get(t) or recent.pop(t, b'') for t in stamps}

    def of(self, frames: Frames) -> dict[str, dict[int, bytes]]:
        """Return the available radiographs of frames, by fluoroscope and exposure."""
        return {
            name: {
                frame.number: jpeg
                for frame in view_frames
                if (jpeg := self._wanted[name].get(frame.stamp_ns))
            }
            for name, view_frames in frames.items()
        }


def collect_recorded(
    frames: Frames,
    mode: str = 'auto',
    pair_by: str = 'frame_number',
    tolerance_s: float = PairingOptions.tolerance_s,
    alone: Callable[[Frame], bool] = never_alone,
) -> tuple[dict[str, list[Frame]], dict[str, int]]:
    """Collect the exposures of a recording in the same way as the calibration node.

    Parameters
    ----------
    frames : mapping of str to sequence of Frame
        All frames by fluoroscope.
    mode : {'auto', 'all', 'still'}
        'all' collects every pair, 'still' those in which the phantom stands still in a new pose;
        'auto' is 'still' for a stream and 'all' for single shots.
    pair_by : {'frame_number', 'stamp'}
    tolerance_s : float
        Largest difference between the stamps of an exposure [s].
    alone : callable
        Whether a frame needs no partner.

    Returns
    -------
    frames : dict of str to list of Frame
        Collected frames by fluoroscope.
    unpaired : dict of str to int
        Number of frames without a partner, by fluoroscope.

    Raises
    ------
    DataError
        For the mode 'still', if no frame has a stamp.
    """
    recorded = [frame for view_frames in frames.values() for frame in view_frames]
    if mode == 'still' and recorded and not any(frame.stamp_ns for frame in recorded):
        raise DataError(f'{NO_STAMP}: collect all')
    still_options = StillOptions()
    pairer = CompletePairer(frames, RecordedPairing(pair_by, tolerance_s).unlimited(), alone=alone)
    collector = ExposureCollector(frames, still_options)
    if mode == 'auto':
        mode = 'still' if any(_is_stream(f, still_options) for f in frames.values()) else 'all'
    collect = collector.offer if mode == 'still' else collector.add
    for pair in recorded_exposures(pairer, frames.values()):
        collect(pair)
    return collector.frames(), dict(pairer.unpaired)


def _is_stream(frames: Sequence[Frame], still: StillOptions) -> bool:
    """Return whether successive frames are within the still time."""
    if len(frames) < 2:
        return False
    gaps = np.diff(sorted(f.stamp_ns for f in frames))
    return bool(0 < np.median(gaps) <= still.still_time_s * 1e9)


MIN_EXPOSURES = 3  # for a calibration, or for a meaningful scatter
RECOMMENDED_EXPOSURES = 15  # docs/usage.md; accuracy by number: docs/how_good/accuracy.md
RECOMMENDED_COVERAGE = 0.9  # share of the field of view
MAX_AREAS = 2  # maximum number of areas named at once


@dataclass(frozen=True)
class Readiness:
    """Whether a calibration is worthwhile, and what is still missing."""

    ready: bool  #: whether the number of exposures and the coverage suffice
    advice: str  #: advice on the next pose, or that it is time to calibrate
    areas: tuple[int, ...] = ()  #: areas to show next, indices of AREAS


def readiness(exposures: int, coverage: Coverage | None) -> Readiness:
    """Return what is missing for a calibration of one fluoroscope.

    exposures: number of collected ones; coverage: None before the first one.
    """
    if coverage is None or not exposures:
        return Readiness(False, 'show the phantom and keep it still')
    areas = coverage.missing_areas[:MAX_AREAS]
    covered = coverage.fraction_of_field >= RECOMMENDED_COVERAGE
    if exposures >= RECOMMENDED_EXPOSURES and covered:
        corners = '; if the field of view is not round, also show beads in the corners'
        return Readiness(True, f'ready to calibrate{corners if coverage.is_round else ""}')
    remaining = RECOMMENDED_EXPOSURES - exposures
    count = f'{remaining} more, ' if remaining > 0 else ''
    if not areas:
        return Readiness(False, f'{count}with the phantom turned and tilted')
    areas_text = ' and '.join(AREAS[area] for area in areas)
    return Readiness(False, f'{count}with beads {areas_text} of the image', areas)


# Coverage of the image by the collected image points.

# Cells across the image: at 1024 px a cell is 32 px, about the spacing of the points of 15
# exposures.
CELLS = 32
# Areas of the image, in rows of three from the top left.
AREAS = (
    'in the upper left corner',
    'at the upper edge',
    'in the upper right corner',
    'at the left edge',
    'in the centre',
    'at the right edge',
    'in the lower left corner',
    'at the lower edge',
    'in the lower right corner',
)
# Covered fraction of the inscribed ellipse above which empty corners are attributed to a round
# field of view. It affects only the advice, which mentions it.
ROUND_FROM = 0.6
SUFFICIENT_OF_AREA = 0.85  # an area with a larger covered fraction is not named as missing


class Coverage:
    """Fraction of the image that is close to an image point.

    A point covers its cell in a grid of 32 x 32 and the eight cells around it.
    """

    def __init__(self, image_size: tuple[int, int]) -> None:
        self._size = np.asarray(image_size, dtype=float)
        self._occupied = np.zeros((CELLS, CELLS), dtype=bool)

    def add(self, uv: ArrayLike) -> None:
        """Add image points (n, 2) [px]."""
        column, row = cells_of(uv, self._size, CELLS).T
        self._occupied[row, column] = True

    @property
    def covered(self) -> NDArray[np.bool_]:
        """Whether cells (rows, columns) are covered."""
        return binary_dilation(self._occupied, np.ones((3, 3), dtype=bool))

    @property
    def fraction(self) -> float:
        """Covered fraction of the image, 0 to 1."""
        return float(np.mean(self.covered))

    @property
    def is_round(self) -> bool:
        """Whether the points may fill a round field of view, as of image intensifiers.

        This is assumed if most of the inscribed ellipse is covered, and no point lies outside.
        """
        in_ellipse = _ellipse()
        fraction = float(np.mean(self.covered[in_ellipse]))
        return fraction >= ROUND_FROM and not self._occupied[~in_ellipse].any()

    @property
    def fraction_of_field(self) -> float:
        """Covered fraction of the field of view, 0 to 1."""
        return float(np.mean(self.covered[self._field()]))

    def _field(self) -> NDArray[np.bool_]:
        """Return whether cells (rows, columns) belong to the field of view."""
        return _ellipse() if self.is_round else np.ones((CELLS, CELLS), dtype=bool)

    @property
    def missing_areas(self) -> tuple[int, ...]:
        """Areas that are not sufficiently covered, indices of AREAS, the emptiest first."""
        field = self._field()
        fractions = (_sums_of_areas(self.covered & field) / _sums_of_areas(field)).ravel()
        order = np.argsort(fractions, kind='stable')
        return tuple(int(i) for i in order if fractions[i] < SUFFICIENT_OF_AREA)


def coverage_of(uv: ArrayLike, image_size: tuple[int, int]) -> Coverage:
    """Return the coverage of an image by image points (n, 2) [px]."""
    coverage = Coverage(image_size)
    coverage.add(uv)
    return coverage


def _sums_of_areas(cells: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Return the number of True cells (rows, columns) in each of the 3 x 3 areas."""
    thirds = np.linspace(0, CELLS, 4).astype(int)[:-1]
    return np.add.reduceat(np.add.reduceat(cells.astype(float), thirds, 0), thirds, 1)


def _ellipse() -> NDArray[np.bool_]:
    """Return whether cells (rows, columns) touch the inscribed ellipse of the image."""
    nearest = np.abs(np.arange(CELLS) + 0.5 - CELLS / 2) - 0.5  # nearest edge to the centre
    return np.hypot(nearest[:, None], nearest[None]) <= CELLS / 2


STILL_PX = StillOptions().still_px  # maximum median displacement of targets in the same pose [px]
SHARE = 0.5  # minimum share of the targets of a frame that another one of the same pose has
SAME_ANGLE_RAD = 1e-3  # maximum difference of the angle of the C-arm in the same pose [rad]


def without_repeats(
    frames: Frames, known: Container[str] = ()
) -> tuple[dict[str, list[Frame]], list[Finding]]:
    """Join the frames of the same pose; return the frames, and a finding for each fluoroscope.

    Fluoroscopes of one rig see the same phantom: exposures have the same pose if they have it in
    the images of all fluoroscopes that have both. known: fluoroscopes with a given orientation,
    for which a repeated pose is not a repeated exposure.
    """
    images = {
        name: {frame.number: frame for frame in view_frames}
        for name, view_frames in frames.items()
        if name not in known
    }
    groups = _groups(images)
    repeated = {number for group in groups for number in group[1:]}
    unrepeated = {}
    findings = []
    for name, view_frames in frames.items():
        if name not in images:
            unrepeated[name] = list(view_frames)
            continue
        joined_frames = []
        for group in groups:
            group_frames = [images[name][number] for number in group if number in images[name]]
            if group_frames:
                joined_frames.append(_joined(group_frames, group[0]))
        unrepeated[name] = joined_frames
        numbers = tuple(sorted(int(number) for number in images[name] if number in repeated))
        if numbers:
            findings.append(
                Finding(
                    Kind.REPEATED_POSE,
                    f'{len(numbers)} exposures show the phantom in the pose of an earlier one, '
                    'and count as one exposure with it',
                    Place((name,), numbers, name=f'fluoroscope {name}'),
                    severity=Severity.NOTE,
                    numbers={'exposures': len(numbers)},
                )
            )
    return unrepeated, findings


def _groups(images: Mapping[str, Mapping[int, Frame]]) -> list[list[int]]:
    """Return the numbers of the exposures of each pose, in order."""
    numbers = sorted({number for view_frames in images.values() for number in view_frames})
    tables = [_Table(list(view_frames.values())) for view_frames in images.values() if view_frames]
    groups: list[list[int]] = []
    for number in numbers:
        first_numbers = np.array([group[0] for group in groups], dtype=np.int64)
        any_same = np.zeros(len(first_numbers), dtype=bool)
        any_other = np.zeros(len(first_numbers), dtype=bool)
        for table in tables:
            is_same, is_other = table.compare(number, first_numbers)
            any_same |= is_same
            any_other |= is_other
        matches = np.flatnonzero(any_same & ~any_other)
        if len(matches):
            groups[matches[0]].append(number)
        else:
            groups.append([number])
    return groups


class _Table:
    """Image points of the frames of a fluoroscope by frame and target, NaN where not seen."""

    def __init__(self, frames: Sequence[Frame]) -> None:
        self.ids = np.unique(np.concatenate([frame.target_id for frame in frames]))
        self._row = {frame.number: row for row, frame in enumerate(frames)}
        values = np.full((len(frames), len(self.ids), 3), np.nan)
        self.uv, self.sigma = values[..., :2], values[..., 2]
        self._angle = np.array([np.nan if f.angle is None else f.angle for f in frames])
        for row, frame in zip(values, frames):
            columns = np.searchsorted(self.ids, frame.target_id)
            row[columns, :2] = frame.uv
            row[columns, 2] = np.nan if frame.sigma is None else frame.sigma
        self._seen = np.isfinite(self.uv[..., 0]).astype(float)
        self._count = self._seen.sum(axis=1)

    def compare(
        self, number: int, others: NDArray[np.int64]
    ) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """Return whether exposures (k,) have the pose of `number`, and whether another one."""
        is_same = np.zeros(len(others), dtype=bool)
        is_present = np.array([other in self._row for other in others.tolist()], dtype=bool)
        if number not in self._row or not is_present.any():
            return is_same, is_same.copy()
        row = self._row[number]
        rows = np.array([self._row[other] for other in others[is_present].tolist()])
        common = self._seen[rows] @ self._seen[row]
        min_common = SHARE * np.minimum(self._count[rows], self._count[row])
        comparable = np.flatnonzero(common >= np.maximum(MIN_COMMON_TARGETS, min_common))
        distance = np.linalg.norm(self.uv[rows[comparable]] - self.uv[row], axis=2)
        # A median is small only if half of the distances are; few need it.
        near = 2 * np.count_nonzero(distance <= STILL_PX, axis=1) >= common[comparable]
        is_still = np.zeros(len(rows), dtype=bool)
        for index, targets in zip(comparable[near], distance[near]):
            is_still[index] = np.nanmedian(targets) <= STILL_PX
        is_rotated = np.abs(self._angle[rows] - self._angle[row]) > SAME_ANGLE_RAD
        is_same[is_present] = is_still & ~is_rotated
        return is_same, is_present & ~is_same


def _joined(frames: Sequence[Frame], number: int) -> Frame:
    """Return a frame with the median image points of frames, which is the mean for two."""
    first_frame = frames[0]
    if len(frames) == 1:
        return first_frame if first_frame.number == number else replace(first_frame, number=number)
    table = _Table(frames)
    sigma = None
    if all(frame.sigma is not None for frame in frames):
        sigma = np.nanmedian(table.sigma, axis=0)
    uv = np.nanmedian(table.uv, axis=0)
    return replace(first_frame, number=number, target_id=table.ids, uv=uv, sigma=sigma)
