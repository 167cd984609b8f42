# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Epipolar check of two image points, and causes of recordings whose rays do not meet.

The epipolar check tests whether two image points belong to one point in space: x_b^T E x_a = 0
with E = [s]x Q, Q = R_b R_a^T and s = R_b (T_a - T_b) [mm], where the image points are directions
x in the sensor frames (Hartley and Zisserman, "Multiple View Geometry", 2nd ed., 2004, 9.6). The
residual is the signed first-order geometric (Sampson) distance (11.4.3 there); its standard
deviation follows by propagation of covariance.

If the rays of a recording do not meet, most points are rejected, and the cause is found by trial.
A share of false matches is acceptable. If most rays miss each other, the frames, ids, fluoroscopes
or coordinates are confused, or the orientation does not hold, and rays that meet do so by chance.
If they miss each other by a little, the same trials may find the cause.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..correction.fluoroscope_calibration import uncorrected
from ..errors import DataError
from ..exposures.frame import Frame
from ..findings import Finding, Kind
from ..photogrammetry.noise import MAX_WIDENING
from ..photogrammetry.rig_orientation import ORIENTATION_SIZE, RigOrientation
from ..photogrammetry.rotations import cross_matrix
from .intersection import (
    FAILED,
    OK,
    OUTSIDE,
    REJECTED,
    SINGLE_VIEW,
    STATUS_NAMES,
)
from .reconstruct import ReconstructedFrame, RigRecording

MIN_BASE = 1e-6  # minimum distance of the sources over their distance from the origin of the rig


@dataclass(frozen=True)
class EpipolarResiduals:
    """Distances of n pairs of image points from their epipolar constraint.

    NaN where an image point or its sigma is NaN.
    """

    residual: NDArray[np.float64]  #: (n,) signed [px]
    #: (n,) standard deviation of the residual due to the image points alone (sigma) [px]
    sd: NDArray[np.float64]
    sd_total: NDArray[np.float64]  #: (n,) the same including the orientation of the rig [px]
    #: (n, 2) unit normals of the epipolar lines in both images, in the direction in which the
    #: residual increases
    normal_a: NDArray[np.float64]
    normal_b: NDArray[np.float64]
    #: (n,) change of the residual when an image point is shifted by one pixel along that normal;
    #: factor_a^2 + factor_b^2 = 1
    factor_a: NDArray[np.float64]
    factor_b: NDArray[np.float64]


class EpipolarGeometry:
    """Epipolar geometry of two fluoroscopes of a rig, built once for all frames.

    a, b: names of the fluoroscopes. Raises DataError for an unknown fluoroscope, and for two
    sources at the same place.
    """

    def __init__(self, orientation: RigOrientation, a: str, b: str) -> None:
        rows = [orientation.index(a), orientation.index(b)]
        r_a, r_b = orientation.rotation[rows]
        position_a, position_b = orientation.position_mm[rows]
        size = np.max(np.linalg.norm(orientation.position_mm[rows], axis=1))
        if np.linalg.norm(position_a - position_b) <= MIN_BASE * size:
            raise DataError(
                f'fluoroscopes {a} and {b} have coincident sources, so they have no epipolar '
                'geometry'
            )
        self.fluoroscopes = (a, b)
        self._interior = orientation.interior[rows]
        relative_rotation = r_b @ r_a.T
        shift = r_b @ (position_a - position_b)
        self.essential = cross_matrix(shift) @ relative_rotation  #: (3, 3), the matrix E [mm]
        columns = orientation.covariance_rows(rows)
        covariance = orientation.covariance[np.ix_(columns, columns)]
        derivative = _essential_jacobian(relative_rotation, shift, r_b, self._interior[:, 2])
        self._derivative = derivative
        self._covariance = derivative @ covariance @ derivative.T

    def residuals(
        self, uv_a: ArrayLike, uv_b: ArrayLike, sigma_a: ArrayLike, sigma_b: ArrayLike
    ) -> EpipolarResiduals:
        """Return the residuals of corrected image points uv_a and uv_b (n, 2) [px].

        sigma_a and sigma_b (n,), or a number for all: standard deviations of their coordinates
        [px].
        """
        x_a, x_b = self._directions(uv_a, uv_b)
        slope_a, slope_b = self._slopes(x_a, x_b)
        square_a = np.sum(slope_a * slope_a, axis=1)
        square_b = np.sum(slope_b * slope_b, axis=1)
        norm2 = square_a + square_b
        norm = np.sqrt(norm2)
        length_a = np.sqrt(square_a)
        length_b = np.sqrt(square_b)
        by_image = square_a * np.square(sigma_a) + square_b * np.square(sigma_b)
        terms = _terms(x_a, x_b)
        by_rig = np.sum((terms @ self._covariance) * terms, axis=1)
        return EpipolarResiduals(
            residual=np.sum(x_b * (x_a @ self.essential.T), axis=1) / norm,
            sd=np.sqrt(by_image / norm2),
            sd_total=np.sqrt((by_image + by_rig) / norm2),
            normal_a=slope_a / length_a[:, None],
            normal_b=slope_b / length_b[:, None],
            factor_a=length_a / norm,
            factor_b=length_b / norm,
        )

    def misses(self, uv_a: ArrayLike, uv_b: ArrayLike) -> NDArray[np.float64]:
        """Return the residuals (n,) of `residuals` [px] alone."""
        x_a, x_b = self._directions(uv_a, uv_b)
        slope_a, slope_b = self._slopes(x_a, x_b)
        norm2 = np.sum(slope_a * slope_a, axis=1) + np.sum(slope_b * slope_b, axis=1)
        return np.asarray(np.sum(x_b * (x_a @ self.essential.T), axis=1) / np.sqrt(norm2))

    def by_essential(self, uv_a: ArrayLike, uv_b: ArrayLike) -> NDArray[np.float64]:
        """Return derivatives (n, 9) of the residuals by the elements of E, by rows."""
        x_a, x_b = self._directions(uv_a, uv_b)
        slope_a, slope_b = self._slopes(x_a, x_b)
        norm = np.sqrt(np.sum(slope_a * slope_a + slope_b * slope_b, axis=1))
        return np.asarray(_terms(x_a, x_b) / norm[:, None])

    def by_orientation(self, uv_a: ArrayLike, uv_b: ArrayLike) -> NDArray[np.float64]:
        """Return derivatives (n, 18) of the residuals by T, w, xp, yp, c of a and of b."""
        return np.asarray(self.by_essential(uv_a, uv_b) @ self._derivative)

    def _directions(
        self, uv_a: ArrayLike, uv_b: ArrayLike
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return directions (n, 3) of image points (n, 2) in a and in b."""
        return _directions(uv_a, self._interior[0]), _directions(uv_b, self._interior[1])

    def _slopes(
        self, x_a: NDArray[np.float64], x_b: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return slopes (n, 2) in a and in b of the constraint at directions (n, 3)."""
        c_a, c_b = self._interior[:, 2]
        return (x_b @ self.essential)[:, :2] / c_a, (x_a @ self.essential.T)[:, :2] / c_b


def _terms(x_a: NDArray[np.float64], x_b: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the terms (n, 9) of the constraint, which is linear in E: products of coordinates."""
    return (x_b[:, :, None] * x_a[:, None, :]).reshape(-1, 9)


def _directions(uv: ArrayLike, interior: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return directions (n, 3) in the sensor frame, z = 1, of image points (n, 2) [px]."""
    uv = np.asarray(uv, dtype=float).reshape(-1, 2)
    out = np.ones((len(uv), 3))
    out[:, :2] = (uv - interior[:2]) / interior[2]
    return out


def _essential_jacobian(
    relative_rotation: NDArray[np.float64],
    shift: NDArray[np.float64],
    r_b: NDArray[np.float64],
    c: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Return derivatives (9, 18) of the elements of E, by rows, by T, w, xp, yp, c of a and b.

    The derivatives by the interior orientation are those of E acting on the present directions. A
    changed interior orientation maps a direction x to M x, to first order with M = 1 - (dc, 0,
    dxp; 0, dc, dyp; 0, 0, 0)/c.
    """
    cross = cross_matrix(shift)
    units = cross_matrix(np.eye(3))
    essential = cross @ relative_rotation
    # Derivative by T_a; the derivative by T_b is its negative.
    by_position = np.stack([cross_matrix(column) @ relative_rotation for column in r_b.T])
    by_rotation_a = -essential @ units
    by_rotation_b = cross_matrix(units @ shift) @ relative_rotation
    by_rotation_b = by_rotation_b + cross @ units @ relative_rotation
    m = np.zeros((3, 3, 3))  # dM/d(xp, yp, c) times -c
    m[0, 0, 2] = 1
    m[1, 1, 2] = 1
    m[2, 0, 0] = 1
    m[2, 1, 1] = 1
    by_interior_a = -essential @ m / c[0]
    by_interior_b = -m.transpose(0, 2, 1) @ essential / c[1]
    rows = [by_position, by_rotation_a, by_interior_a, -by_position, by_rotation_b, by_interior_b]
    return np.concatenate(rows).reshape(2 * ORIENTATION_SIZE, 9).T


MIN_POINTS = 20  # minimum number of points in two views for judging a recording
MAX_REJECTED = 0.5  # maximum share of rejected points in two views
CORRECTED = Finding(Kind.CORRECTED_ALREADY, 'the image points are already corrected')
MAX_TRIED = 10  # maximum number of exposures to try
UNKNOWN = Finding(
    Kind.RAYS_DO_NOT_MEET,
    'the frames, target ids or image coordinates do not belong together, the fluoroscopes are '
    'interchanged, or one was moved since its orientation was determined',
)
UNMATCHED = Finding(
    Kind.NO_COMMON_TARGETS,
    'no target is seen by two fluoroscopes in one exposure',
    advice='the target ids of the fluoroscopes, or the numbers of their frames, do not belong '
    'together',
)
# Maximum ratios of a trial to the recording, for the share of rejected points and the median miss,
# to accept the cause of the trial.
BETTER = 0.3
CLOSER = 0.6


Trial = tuple[Finding, RigRecording]
Counts = tuple[int, int, int]  # see `counts_of`


def recent_misses(counts: Sequence[Counts], timing: Finding | None = None) -> Finding | None:
    """Return what is wrong if the points of recent exposures are implausible, or None.

    counts: `counts_of` the points of each. timing: fault of their timing, which is the cause if
    there is one.
    """
    rejected, total, single = (sum(column) for column in zip(*counts or [(0, 0, 0)]))
    if not total and single >= MIN_POINTS:
        return UNMATCHED
    if total < MIN_POINTS or rejected <= MAX_REJECTED * total:
        return None
    return missing_rays(rejected / total, timing or UNKNOWN)


def missing_rays(share: float, reason: Finding) -> Finding:
    """Return the finding that a share of the rays miss each other, with the cause."""
    cause = f'{100 * share:.0f} % of the rays miss each other: {reason.cause}'
    return replace(reason, cause=cause, numbers={**reason.numbers, 'share': share})


def share_rejected(reconstructed: Sequence[ReconstructedFrame]) -> tuple[float, int]:
    """Return the share of rejected points, and the number of points in two views."""
    status = np.concatenate([frame.points.status for frame in reconstructed] or [np.empty(0, int)])
    rejected, total, _ = counts_of(status)
    return rejected / max(total, 1), total


def counts_of(status: NDArray[np.integer]) -> Counts:
    """Return the numbers of rejected points, of points in two views, and in a single one."""
    counts = np.bincount(status, minlength=len(STATUS_NAMES))
    rejected = int(counts[REJECTED] + counts[FAILED])
    return rejected, rejected + int(counts[OK] + counts[OUTSIDE]), int(counts[SINGLE_VIEW])


def why_rays_miss(
    recording: RigRecording,
    reconstruction: Sequence[ReconstructedFrame],
    widening: float,
    timing: Finding | None = None,
) -> Finding | None:
    """Return why a reconstruction is implausible, or None if nothing is wrong with it.

    widening: factor by which the rays miss each other by more than expected. If they miss by a
    little, a reason is returned only if a trial identifies it. timing: fault of the timing, which
    is the reason if there is one.
    """
    if timing is not None:
        share, total = share_rejected(reconstruction)
        most_miss = total >= MIN_POINTS and share > MAX_REJECTED
        return missing_rays(share, timing) if most_miss else None
    finding = mismatch(recording, reconstruction)
    if finding is None and widening >= MAX_WIDENING:
        finding = cause_of_misses(recording, reconstruction)
    return finding


def mismatch(
    recording: RigRecording, reconstruction: Sequence[ReconstructedFrame]
) -> Finding | None:
    """Return why most rays miss each other, or None if most meet."""
    share, total = share_rejected(reconstruction)
    seen = sum(len(frame.target_id) for frame in reconstruction)
    if not total and seen >= MIN_POINTS:
        return UNMATCHED
    if total < MIN_POINTS or share <= MAX_REJECTED:
        return None
    for cause, trial in _trials(recording.numbered(), _largest(reconstruction)):
        rejected, count = share_rejected(trial.reconstruct())
        if count >= MIN_POINTS and rejected < BETTER * share:
            return missing_rays(share, cause)
    return missing_rays(share, UNKNOWN)


def cause_of_misses(
    recording: RigRecording, reconstruction: Sequence[ReconstructedFrame]
) -> Finding | None:
    """Return why rays miss each other by more than expected, or None if no trial identifies it.

    The trials are those of `mismatch`, and image points that are already corrected.
    """
    recording = recording.numbered()
    numbers = _largest(reconstruction)
    limit = CLOSER * _miss([frame for frame in reconstruction if frame.number in numbers])
    as_corrected = replace(
        recording,
        frames=recording.selected(numbers),
        calibrations=uncorrected(recording.calibrations),
    )
    trials = [(CORRECTED, as_corrected), *_trials(recording, numbers)]
    misses = [_miss(trial.reconstruct()) for _, trial in trials]
    best = int(np.argmin(misses))
    if not misses[best] < limit:
        return None
    found, _ = trials[best]
    text = f'the rays miss each other by more than their standard deviations allow: {found.cause}'
    return replace(found, cause=text)


def _largest(reconstructed: Sequence[ReconstructedFrame]) -> set[int]:
    """Return the numbers of the frames with the most targets, for trials of causes."""
    largest = sorted(reconstructed, key=lambda frame: -len(frame.target_id))[:MAX_TRIED]
    return {frame.number for frame in largest}


def _miss(reconstructed: Sequence[ReconstructedFrame]) -> float:
    """Return the median miss of the rays over its standard deviation; infinite for few rays."""
    points = [frame.points for frame in reconstructed]
    size = np.concatenate([p.standardised[p.status != SINGLE_VIEW] for p in points] or [[]])
    if len(size) < MIN_POINTS:
        return np.inf
    return float(np.median(np.where(np.isfinite(size), size, np.inf)))


def _trials(recording: RigRecording, numbers: set[int]) -> list[Trial]:
    """Return findings on possible confusions, each with the recording put right.

    numbers: numbers of the frames to try.
    """
    names = recording.fluoroscopes
    selected = recording.selected(numbers)
    out: list[tuple[Finding, dict[str, list[Frame]]]] = []
    for one, other in pairwise(names):
        if _size(selected[one]) == _size(selected[other]):
            exchanged = {
                **selected,
                one: [replace(frame, fluoroscope=one) for frame in selected[other]],
                other: [replace(frame, fluoroscope=other) for frame in selected[one]],
            }
            cause = f'fluoroscopes {one} and {other} are interchanged'
            out.append((Finding(Kind.FLUOROSCOPES_INTERCHANGED, cause), exchanged))
    for name in names[1:]:
        for step, direction in ((1, 'small'), (-1, 'large')):
            numbered = [replace(f, number=f.number + step) for f in recording.frames[name]]
            numbered = [f for f in numbered if f.number in numbers]
            labelled = [replace(f, target_id=f.target_id + step) for f in selected[name]]
            for kind, label, corrected in (
                (Kind.FRAMES_SHIFTED, 'frame numbers', numbered),
                (Kind.IDS_SHIFTED, 'target ids', labelled),
            ):
                cause = f'the {label} of fluoroscope {name} are too {direction} by 1'
                out.append(
                    (Finding(kind, cause, numbers={'shift': -step}), {**selected, name: corrected})
                )
    out += _other_axes(selected)
    return [(cause, recording.with_frames(frames)) for cause, frames in out]


def _other_axes(
    frames: Mapping[str, list[Frame]],
) -> list[tuple[Finding, dict[str, list[Frame]]]]:
    """Return trials of other directions of u and v, in all fluoroscopes or in one."""
    out = []
    for kind, cause, change in (
        (Kind.IMAGE_TRANSPOSED, 'u and v are interchanged', _transposed),
        (Kind.IMAGE_MIRRORED, 'v runs upwards', _upside_down),
    ):
        all_changed = {name: [change(f) for f in exposures] for name, exposures in frames.items()}
        out.append((Finding(kind, cause), all_changed))
        out += [
            (Finding(kind, f'{cause} in fluoroscope {name}'), {**frames, name: changed})
            for name, changed in all_changed.items()
        ]
    return out


def _size(frames: Sequence[Frame]) -> tuple[int, int] | None:
    return frames[0].image_size if frames else None


def _transposed(frame: Frame) -> Frame:
    return replace(frame, uv=frame.uv[:, ::-1].copy())


def _upside_down(frame: Frame) -> Frame:
    height = frame.image_size[1]
    return replace(frame, uv=np.column_stack([frame.uv[:, 0], height - 1 - frame.uv[:, 1]]))
