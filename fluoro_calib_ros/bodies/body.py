# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Rigid bodies with markers, and their poses over a trial with the covariances of all errors."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from enum import IntEnum
from functools import cached_property
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from ..brief import brief_repr
from ..errors import DataError
from ..exposures.phantom import first_repeated
from ..photogrammetry.rotations import cross_matrix
from ..photogrammetry.unknowns import POSE_SIZE
from ..rows import chosen_rows

AXIS_MM = 20.0  # length of a drawn axis, about the size of a cluster of markers in a bone


@dataclass(frozen=True)
class Body:
    """Rigid body with the coordinates of its markers.

    Raises DataError for arrays of different lengths, repeated markers and non-finite values.

    Attributes
    ----------
    name : str
    target_id : (m,) ndarray
        Marker ids, ascending.
    xyz_mm : (m, 3) ndarray
        Coordinates in the frame of the body; NaN for a marker whose place is to be estimated.
    sd_mm : (m,) ndarray
        Standard deviation of the coordinates of each marker; infinite if unknown.
    frame_covariance : (6, 6) ndarray
        Covariance of the frame itself relative to the markers: shift [mm] and rotation [rad] about
        their centre, along the axes of the body. 0 if sd_mm includes it.
    covariance_mm2 : (3 m, 3 m) ndarray
        Covariance of the coordinates relative to each other; by default independent, from sd_mm.
    """

    __repr__ = brief_repr

    name: str
    target_id: NDArray[np.int64]
    xyz_mm: NDArray[np.float64]
    sd_mm: NDArray[np.float64]
    frame_covariance: NDArray[np.float64] = field(
        default_factory=lambda: np.zeros((POSE_SIZE, POSE_SIZE))
    )
    covariance_mm2: NDArray[np.float64] | None = None

    def __post_init__(self) -> None:
        target_id = np.array(self.target_id, dtype=np.int64).reshape(-1)
        xyz = np.array(self.xyz_mm, dtype=float).reshape(-1, 3)
        sd = np.array(self.sd_mm, dtype=float).reshape(-1)
        if not self.name:
            raise DataError('a body has no name')
        if not len(target_id) == len(xyz) == len(sd):
            raise DataError(
                f'body {self.name}: {len(target_id)} markers, {len(xyz)} positions and {len(sd)} '
                'standard deviations'
            )
        if not len(target_id):
            raise DataError(f'body {self.name}: it has no markers')
        repeated = first_repeated(target_id)
        if repeated is not None:
            raise DataError(f'body {self.name}: marker {target_id[repeated[0]]} is given twice')
        order = np.argsort(target_id)
        target_id = target_id[order]
        known = np.isfinite(xyz).all(axis=1)[order]
        is_invalid = (known & ~(sd[order] >= 0)) | np.isinf(xyz[order]).any(axis=1)
        if is_invalid.any():
            raise DataError(
                f'body {self.name}: the coordinates or the standard deviation of marker '
                f'{target_id[is_invalid][0]} are not finite, or negative'
            )
        if self.covariance_mm2 is not None:
            rows = (3 * order[:, None] + np.arange(3)).ravel()
            object.__setattr__(self, 'covariance_mm2', self.covariance_mm2[np.ix_(rows, rows)])
        for name, array in (
            ('target_id', target_id),
            ('xyz_mm', xyz[order]),
            ('sd_mm', sd[order]),
        ):
            array.setflags(write=False)
            object.__setattr__(self, name, array)

    @property
    def known(self) -> NDArray[np.bool_]:
        """Whether the place of each marker (m,) is known."""
        return np.asarray(np.isfinite(self.xyz_mm).all(axis=1))

    def rows(self, chosen: NDArray[np.bool_]) -> Body:
        """Return the body with a subset of its markers, chosen (m,)."""
        covariance = self.covariance_mm2
        if covariance is not None:
            covariance = covariance[np.ix_(np.repeat(chosen, 3), np.repeat(chosen, 3))]
        return replace(
            self,
            target_id=self.target_id[chosen],
            xyz_mm=self.xyz_mm[chosen],
            sd_mm=self.sd_mm[chosen],
            covariance_mm2=covariance,
        )

    @cached_property
    def centre(self) -> NDArray[np.float64]:
        """Mean (3,) of the known markers [mm]."""
        return self.xyz_mm[self.known].mean(axis=0)


def check_bodies(bodies: Sequence[Body]) -> None:
    """Raise DataError without bodies, for two of the same name, and for a shared marker."""
    if not bodies:
        raise DataError('there are no bodies')
    owners: dict[int, str] = {}
    names: set[str] = set()
    for body in bodies:
        if body.name in names:
            raise DataError(f'two bodies are called {body.name}')
        names.add(body.name)
        for marker in body.target_id.tolist():
            if marker in owners:
                raise DataError(
                    f'marker {marker} is one of {owners[marker]} and of {body.name}; '
                    'a marker belongs to one body'
                )
            owners[marker] = body.name


def declared_bodies(texts: Iterable[str]) -> tuple[Body, ...]:
    """Return bodies of unknown shapes from texts such as 'tibia: 1001 1002 1003'.

    Raises DataError for a text of another form, for fewer than two markers, and like check_bodies.
    """
    bodies = tuple(_declared_body(text) for text in texts)
    if bodies:
        check_bodies(bodies)
    return bodies


def _declared_body(text: str) -> Body:
    name, colon, ids = text.partition(':')
    try:
        target_id = [int(i) for i in ids.replace(',', ' ').split()]
    except ValueError:
        target_id = []
    if not colon or not name.strip() or not target_id:
        raise DataError(f"{text!r} does not declare a body, as 'tibia: 1001 1002 1003' does")
    if len(target_id) < 2:
        raise DataError(f'body {name.strip()}: needs two markers or more, not {target_id}')
    count = len(target_id)
    unknown = np.full((count, 3), np.nan)
    return Body(name.strip(), np.array(target_id), unknown, np.full(count, np.inf))


def padded(arrays: Sequence[np.ndarray], fill: float | bool) -> np.ndarray:
    """Stack arrays (m, ...) of bodies with different numbers of markers, filled up at the end."""
    out = np.full((len(arrays), max(map(len, arrays)), *arrays[0].shape[1:]), fill)
    for row, array in zip(out, arrays):
        row[: len(array)] = array
    return out


def solvable_bodies(bodies: Sequence[Body]) -> tuple[Body, ...]:
    """Return bodies without the markers whose places are unknown.

    Raises DataError for a body with fewer than three known markers, and for a marker without a
    standard deviation.
    """
    out = []
    for body in bodies:
        known = body.known
        if np.count_nonzero(known) < 3:
            raise DataError(
                f'body {body.name}: the coordinates of only {np.count_nonzero(known)} of its '
                f'{len(body.target_id)} markers are known, a pose needs three'
            )
        no_sd = body.target_id[known & ~np.isfinite(body.sd_mm)]
        if len(no_sd):
            raise DataError(
                f'body {body.name}: marker {no_sd[0]} has no standard deviation: give it, or '
                'estimate it from a recording'
            )
        out.append(body.rows(known))
    return tuple(out)


class PoseStatus(IntEnum):
    """Origin of a pose; the values are those of the messages."""

    OK = 0
    WEAK = 1  # too few markers or views for the full pose; the missing part is predicted
    FILLED = 2  # no marker of the body was seen; predicted or interpolated
    FAILED = 3  # unknown
    AMBIGUOUS = 4  # markers nearly in a plane or on a line also fit in a second pose


STATUS_NAMES = tuple(status.name for status in PoseStatus)


@dataclass(frozen=True)
class BodyPoses:
    """Poses of one body, from body to rig frame: P = R x + t.

    Errors are (dt, w) about the axes of the rig frame: t + dt [mm] and exp([w]x) R [rad].

    Attributes
    ----------
    body : str
    number, stamp_ns : (T,) ndarray
        Number and stamp of each exposure.
    rotation : (T, 3, 3) ndarray
        NaN where there is no pose.
    position_mm : (T, 3) ndarray
        Position of the origin of the body.
    covariance_noise : (T, 6, 6) ndarray
        Covariance of the random errors, which are independent between exposures.
    covariance_fixed : (T, 6, 6) ndarray
        Covariance of constant errors of this body: of its shape, and of the image corrections.
    rig_root : (T, 6, k) ndarray
        Derivatives with respect to k independent unknowns of unit variance of the orientation of
        the rig, which are common to the poses of all bodies and exposures.
    markers : (T,) ndarray
        Number of markers used.
    status : (T,) ndarray
        PoseStatus as uint8.
    """

    __repr__ = brief_repr

    body: str
    number: NDArray[np.int64]
    stamp_ns: NDArray[np.int64]
    rotation: NDArray[np.float64]
    position_mm: NDArray[np.float64]
    covariance_noise: NDArray[np.float64]
    covariance_fixed: NDArray[np.float64]
    rig_root: NDArray[np.float64]
    markers: NDArray[np.int64]
    status: NDArray[np.uint8]

    @property
    def known(self) -> NDArray[np.bool_]:
        """Whether there is a pose in each exposure (T,)."""
        return np.asarray(np.isfinite(self.rotation[:, 0, 0]))

    def rows(self, chosen: NDArray[np.bool_]) -> BodyPoses:
        """Return the poses of a subset of the exposures, chosen (T,)."""
        return chosen_rows(self, chosen)

    @property
    def covariance(self) -> NDArray[np.float64]:
        """Covariances (T, 6, 6) from all errors [mm, rad]."""
        covariance_rig = self.rig_root @ np.swapaxes(self.rig_root, 1, 2)
        return self.covariance_noise + self.covariance_fixed + covariance_rig

    @property
    def sd(self) -> NDArray[np.float64]:
        """Standard deviations (T, 6) from all errors [mm, rad]."""
        return np.sqrt(np.diagonal(self.covariance, axis1=1, axis2=2))


# Rigid motions of points.


def fitted_pose(
    source: NDArray[np.float64],
    target: NDArray[np.float64],
    weight: NDArray[np.float64] | None = None,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return rotations (..., 3, 3) and shifts (..., 3) that move points (..., k, 3) to target.

    Least-squares fit; weight (..., k): of the points, by default equal. Kabsch, "A solution for
    the best rotation to relate two sets of vectors", Acta Cryst. A32, 1976.
    """
    weight = np.ones(source.shape[:-1]) if weight is None else weight
    share = (weight / weight.sum(axis=-1, keepdims=True))[..., None]
    a = np.sum(share * source, axis=-2, keepdims=True)
    b = np.sum(share * target, axis=-2, keepdims=True)
    u, _, vt = np.linalg.svd(np.swapaxes(source - a, -1, -2) @ (share * (target - b)))
    right_vectors = np.swapaxes(vt, -1, -2).copy()
    right_vectors[..., 2] *= np.sign(np.linalg.det(u @ vt))[..., None]
    rotation = right_vectors @ np.swapaxes(u, -1, -2)
    return rotation, (b - a @ np.swapaxes(rotation, -1, -2))[..., 0, :]


def robust_pose(
    source: NDArray[np.float64], target: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the rotation (3, 3) and shift (3,) that move most of k >= 3 points (k, 3) to target.

    Among the motions of three points, the one with the smallest median distance selects all points
    within three of these medians for the final fit. Rousseeuw, "Least median of squares
    regression", J. Am. Stat. Assoc. 79, 1984.
    """
    count = len(source)
    triples = np.array(list(combinations(range(count), 3)))
    triples = triples[np.linspace(0, len(triples) - 1, 84).astype(int)]  # all of nine points
    rotation, shift = fitted_pose(source[triples], target[triples])
    distance = np.linalg.norm(
        source @ np.swapaxes(rotation, 1, 2) + shift[:, None] - target, axis=2
    )
    middle = max(count // 2, 2)
    median = np.partition(distance, middle, axis=1)[:, middle]
    best = int(np.argmin(median))
    is_near = distance[best] <= 3 * median[best]
    return fitted_pose(source[is_near], target[is_near])


def by_pose(arm: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return derivatives (..., 3, 6) of places by position and rotation; arm (..., 3): R x."""
    out = np.zeros((*arm.shape, 6))
    out[..., :3] = np.eye(3)
    out[..., 3:] = -cross_matrix(arm)
    return out
