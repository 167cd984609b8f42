# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Single image points that cannot be used: off the image, or of a target that is unknown.

A few of them are excluded and reported. Many are a fault of the whole input, such as a wrong image
size or another phantom, and are left to `validate_frame`, which refuses the frame. Many targets at
the same image point are a fill value of some program for targets that are not seen, such as
(0, 0), and always excluded.
"""

from __future__ import annotations

from collections.abc import Container, Mapping, Sequence
from dataclasses import replace

import numpy as np

from ..findings import Finding, Kind, Place, Severity, first_few
from .collector import MIN_COMMON_TARGETS, StillOptions
from .frame import Frame, points_on_image
from .phantom import Phantom

MIN_TOGETHER = 4  # targets at the same image point that are fill values
MIN_SHARE_TOGETHER = 0.02  # the same, of the targets of the frame; the larger of both holds
MAX_SHARE = 0.05  # of the image points of a frame that are excluded; one always is


def few(count: int, of: int) -> bool:
    """Return whether so many image points of a frame or file can be excluded."""
    return 0 < count <= max(1, MAX_SHARE * of) and count < of


def without_strays(frame: Frame, phantom: Phantom | None = None) -> tuple[Frame, Finding | None]:
    """Return the frame without its few stray points, and a finding about them, None without any.

    phantom: its targets are known, by default all. A frame with many of them, or whose arrays do
    not belong together, is returned as it is.
    """
    ids = np.asarray(frame.target_id)
    uv = np.asarray(frame.uv)
    if uv.shape != (len(ids), 2) or (frame.sigma is not None and len(frame.sigma) != len(ids)):
        return frame, None
    finite = np.isfinite(uv).all(axis=1)
    together = finite & _together(uv)
    off = finite & ~together & ~points_on_image(uv, frame.image_size)
    unknown = np.zeros(len(ids), dtype=bool) if phantom is None else phantom.index(ids) < 0
    single = (off | unknown) & ~together
    if not few(int(single.sum()), int(np.sum(~together))):
        single = np.zeros(len(ids), dtype=bool)
    stray = single | together
    if not stray.any() or stray.all():
        return frame, None
    kept = ~stray
    cleaned = replace(
        frame,
        target_id=ids[kept],
        uv=uv[kept],
        sigma=None if frame.sigma is None else np.asarray(frame.sigma)[kept],
    )
    causes = [
        f'target {first_few(ids[chosen])} {cause}'
        for chosen, cause in (
            (off & single, 'off the image'),
            (unknown & single & ~off, 'not on the phantom'),
            (
                together,
                'at the image point of others, a fill value for targets that are not seen',
            ),
        )
        if chosen.any()
    ]
    count = int(stray.sum())
    return cleaned, Finding(
        Kind.STRAY_POINTS,
        f'{count} image point{"s" * (count > 1)}, {" and ".join(causes)}',
        replace(frame.place, target_id=tuple(ids[stray].tolist())),
        severity=Severity.NOTE,
        numbers={
            'off_image': int(np.sum(off & single)),
            'not_on_phantom': int(np.sum(unknown & single & ~off)),
            'fill_values': int(together.sum()),
        },
    )


def frames_without_strays(
    frames: Mapping[str, Sequence[Frame]], phantom: Phantom
) -> tuple[dict[str, list[Frame]], list[Finding]]:
    """Return the frames by fluoroscope without their few stray points, and findings on these."""
    findings = []
    out: dict[str, list[Frame]] = {}
    for name, exposures in frames.items():
        cleaned = [without_strays(frame, phantom) for frame in exposures]
        out[name] = [frame for frame, _ in cleaned]
        findings += [found for _, found in cleaned if found is not None]
    return out, findings


def _together(uv: np.ndarray) -> np.ndarray:
    """Which (n,) of image points (n, 2) are at the place of so many others that none is there."""
    if len(uv) < MIN_TOGETHER:
        return np.zeros(len(uv), dtype=bool)
    _, place, count = np.unique(uv, axis=0, return_inverse=True, return_counts=True)
    return count[place.reshape(-1)] >= max(MIN_TOGETHER, MIN_SHARE_TOGETHER * len(uv))


# Exposures of a phantom that stands still, which count as one.
#
# The frames of a film of a standing phantom differ by a part of their noise only: their errors of
# extraction, which depend on what is round a bead, are the same. Taken as so many exposures they
# would be believed more than they know, and take their time. Their mean is one exposure.

STILL_PX = StillOptions().still_px  # median displacement of the targets
SHARE = 0.5  # of the targets of a frame that another one of the same pose has
SAME_ANGLE_RAD = 1e-3  # of the C-arm

Frames = Mapping[str, Sequence[Frame]]


def without_repeats(
    frames: Frames, known: Container[str] = ()
) -> tuple[dict[str, list[Frame]], list[Finding]]:
    """Return the frames with those of one pose joined, and a finding for each fluoroscope.

    Fluoroscopes of one rig see the same phantom: exposures are of one pose where they are so in
    the images of all fluoroscopes that have both. known: fluoroscopes of which a repeated pose is
    no repeated exposure, as their orientation is given.
    """
    images = {
        name: {frame.number: frame for frame in of_one}
        for name, of_one in frames.items()
        if name not in known
    }
    groups = _groups(images)
    repeated = {later for group in groups for later in group[1:]}
    out = {}
    findings = []
    for name, of_one in frames.items():
        if name not in images:
            out[name] = list(of_one)
            continue
        joined = []
        for group in groups:
            own = [images[name][number] for number in group if number in images[name]]
            if own:
                joined.append(_joined(own, group[0]))
        out[name] = joined
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
    return out, findings


def _groups(images: Mapping[str, Mapping[int, Frame]]) -> list[list[int]]:
    """Numbers of the exposures of each pose, in order."""
    numbers = sorted({number for of_one in images.values() for number in of_one})
    tables = [_Table(list(of_one.values())) for of_one in images.values()]
    groups: list[list[int]] = []
    for number in numbers:
        first = np.array([group[0] for group in groups], dtype=np.int64)
        same = np.zeros(len(first), dtype=bool)
        other = np.zeros(len(first), dtype=bool)
        for table in tables:
            is_same, is_other = table.compare(number, first)
            same |= is_same
            other |= is_other
        there = np.flatnonzero(same & ~other)
        if len(there):
            groups[there[0]].append(number)
        else:
            groups.append([number])
    return groups


class _Table:
    """Image points of the frames of a fluoroscope by frame and target, NaN where not seen."""

    def __init__(self, frames: Sequence[Frame]) -> None:
        ids = np.unique(np.concatenate([frame.target_id for frame in frames]))
        self._row = {frame.number: row for row, frame in enumerate(frames)}
        self._uv = np.full((len(frames), len(ids), 2), np.nan)
        self._angle = np.array([np.nan if f.angle is None else f.angle for f in frames])
        for own, frame in zip(self._uv, frames):
            own[np.searchsorted(ids, frame.target_id)] = frame.uv

    def compare(self, number: int, others: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return whether exposures (k,) have the pose of one, and whether they have another."""
        same = np.zeros(len(others), dtype=bool)
        has = np.array([other in self._row for other in others.tolist()], dtype=bool)
        if number not in self._row or not has.any():
            return same, same.copy()
        row = self._row[number]
        rows = np.array([self._row[other] for other in others[has].tolist()])
        distance = np.linalg.norm(self._uv[rows] - self._uv[row], axis=2)
        common = np.isfinite(distance)
        seen = np.isfinite(self._uv[..., 0]).sum(axis=1)
        enough = SHARE * np.minimum(seen[rows], seen[row])
        comparable = common.sum(axis=1) >= np.maximum(MIN_COMMON_TARGETS, enough)
        still = np.zeros(len(rows), dtype=bool)
        for place in np.flatnonzero(comparable):
            still[place] = np.median(distance[place][common[place]]) <= STILL_PX
        turned = np.abs(self._angle[rows] - self._angle[row]) > SAME_ANGLE_RAD
        same[has] = still & ~turned
        return same, has & ~same


def _joined(frames: Sequence[Frame], number: int) -> Frame:
    """Frame of a number with the medians of the image points of frames, of two their mean."""
    first = frames[0]
    if len(frames) == 1:
        return first if first.number == number else replace(first, number=number)
    ids = np.unique(np.concatenate([frame.target_id for frame in frames]))
    values = np.full((len(frames), len(ids), 3), np.nan)
    for own, frame in zip(values, frames):
        at = np.searchsorted(ids, frame.target_id)
        own[at, :2] = frame.uv
        if frame.sigma is not None:
            own[at, 2] = frame.sigma
    sigma = None
    if all(frame.sigma is not None for frame in frames):
        sigma = np.nanmedian(values[..., 2], axis=0)
    uv = np.nanmedian(values[..., :2], axis=0)
    return replace(first, number=number, target_id=ids, uv=uv, sigma=sigma)
