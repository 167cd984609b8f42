# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Survey of a phantom from its own exposures: a free network at a measured scale.

The scale of a free network is estimated from measured distances between its object points. The
distances are weighted observations that are added after the adjustment of the images. With the
coordinates x of the free network, their covariance C and the unknown scale 1 + s about the centre,

    d - l = l s + A e + noise,    e with covariance C, noise with the variances of the distances,

where l are the distances in the network and A their derivatives. This is sequential least squares
(Foerstner and Wrobel, "Photogrammetric Computer Vision", Springer 2016, 4.2.7), and gives the same
as distances in the adjustment would. C satisfies the inner constraints, and so do the coordinates:
position and attitude remain those of the datum, only the scale becomes that of the distances.

The self-calibration with inner constraints gives the shape of the phantom. Position and attitude
are those of the given coordinates. The scale is that of the measured distances, or else that of
the given coordinates.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..errors import DataError
from ..exposures.phantom import Phantom
from ..findings import Kind, Place
from ..photogrammetry.adjustment import Adjustment
from ..photogrammetry.network import Network
from ..photogrammetry.resection import ROUNDING
from ..rows import chosen_rows
from .result import CalibrationResult

# Returns blocks (k, 3, 3) of object points p (k,) with object points q (k,).
Between = Callable[[NDArray[np.int64], NDArray[np.int64]], NDArray[np.float64]]


@dataclass(frozen=True)
class Distances:
    """Measured distances between object points."""

    pairs: NDArray[np.int64]  #: (k, 2) rows of the object points
    #: (k,)
    length_mm: NDArray[np.float64]
    sd_mm: NDArray[np.float64]


@dataclass(frozen=True)
class Scaled:
    """Object points at the scale of measured distances."""

    xyz_mm: NDArray[np.float64]  #: (n, 3)
    covariance: NDArray[np.float64]  #: (n, 3, 3) [mm^2]
    #: scale factor of the network, and its standard deviation
    scale: float
    scale_sd: float
    #: (k,) measured distances less those from the images and the other distances; 0 if nothing
    #: checks a distance
    error_mm: NDArray[np.float64]
    #: (k,) the same over their standard deviations (Baarda's test)
    normalised: NDArray[np.float64]
    chi2: float  #: weighted square sum; expected: `freedom`
    freedom: int


def scaled_by_distances(
    xyz_mm: NDArray[np.float64],
    covariance: NDArray[np.float64],
    between: Between,
    distances: Distances,
    centre_mm: NDArray[np.float64],
) -> Scaled:
    """Return object points of a free network at the scale of one or more distances.

    Parameters
    ----------
    xyz_mm : (n, 3) ndarray
    covariance : (n, 3, 3) ndarray
        Covariances in the datum of inner constraints [mm^2].
    between : callable
        Returns covariances between object points.
    distances : Distances
    centre_mm : (3,) ndarray
        Centre of the datum, which the scale does not move.
    """
    first, second = distances.pairs.T
    offset = xyz_mm[second] - xyz_mm[first]
    length = np.linalg.norm(offset, axis=1)
    direction = offset / length[:, None]
    # C A^T: covariances of every object point with every distance.
    n, k = len(xyz_mm), len(length)
    rows = np.repeat(np.arange(n), k)
    ends = [between(rows, np.tile(end, n)).reshape(n, k, 3, 3) for end in (first, second)]
    mixed = np.einsum('nkab,kb->nak', ends[1] - ends[0], direction)
    predicted = np.einsum('ka,kaj->kj', direction, mixed[second] - mixed[first])
    total = predicted + np.diag(distances.sd_mm**2)
    inverse = np.linalg.inv(total)
    weight = inverse @ length
    variance = 1 / float(length @ weight)
    difference = distances.length_mm - length
    change = variance * float(weight @ difference)
    remainder = difference - change * length
    gain = mixed @ inverse
    shift = mixed @ (inverse @ remainder)
    arm = xyz_mm - centre_mm
    by_scale = arm - gain @ length
    pull = inverse @ remainder
    # Variances of the pulls; infinite for a distance that no other distance checks.
    variance_of_pull = np.diagonal(inverse - variance * np.outer(weight, weight))
    is_checked = variance_of_pull > ROUNDING * np.diagonal(inverse)
    variance_of_pull = np.where(is_checked, variance_of_pull, np.inf)
    return Scaled(
        xyz_mm + change * arm + shift,
        covariance
        - np.einsum('nak,nbk->nab', gain, mixed)
        + variance * by_scale[:, :, None] * by_scale[:, None, :],
        1 + change,
        float(np.sqrt(variance)),
        error_mm=pull / variance_of_pull,
        normalised=pull / np.sqrt(variance_of_pull),
        chi2=float(remainder @ pull),
        freedom=k - 1,
    )


@dataclass(frozen=True)
class MeasuredDistance:
    """Distance between the centres of two beads, measured with a caliper or similar.

    Attributes
    ----------
    first, second : int
        Target ids.
    length_mm, sd_mm : float
    """

    first: int
    second: int
    length_mm: float
    sd_mm: float

    def __post_init__(self) -> None:
        place = Place(target_id=(self.first, self.second), name=self.name)
        if self.first == self.second:
            raise DataError('both ends are the same bead', place=place)
        if not (0 < self.length_mm < np.inf and 0 < self.sd_mm < np.inf):
            raise DataError(
                'length and standard deviation must be finite and above 0', place=place
            )

    @property
    def name(self) -> str:
        """Name of the distance in a sentence."""
        return f'distance {self.first} to {self.second}'


@dataclass(frozen=True)
class SurveyedBeads:
    """Beads surveyed from the images of an adjustment."""

    target_id: NDArray[np.int64]  #: (n,)
    xyz_mm: NDArray[np.float64]  #: (n, 3)
    #: (n, 3, 3) [mm^2]; includes the uncertainty of the scale, which is common to all beads
    covariance: NDArray[np.float64]
    given_mm: NDArray[np.float64]  #: (n, 3) initial coordinates
    given_sd_mm: NDArray[np.float64]  #: (n,)
    rays: NDArray[np.int64]  #: (n,) number of inlier image points
    angle_rad: NDArray[np.float64]  #: (n,) largest angle between two of their rays
    #: scale factor of the given coordinates, and its standard deviation
    scale: float
    scale_sd: float
    distances: tuple[MeasuredDistance, ...] = ()
    scaled: Scaled | None = None  #: agreement of the distances; None without distances
    #: (3n, 3n) covariance of all beads in the free network, without scale [mm^2]; None if there
    #: are too many beads
    joint_covariance: NDArray[np.float64] | None = None

    @property
    def sd_mm(self) -> NDArray[np.float64]:
        """Standard deviations (n,) of a coordinate, the RMS of all three axes."""
        return np.sqrt(np.trace(self.covariance, axis1=1, axis2=2) / 3)

    def without(self, target_id: Iterable[int]) -> SurveyedBeads:
        """Return the beads except those with some target ids; the scale does not change."""
        is_kept = ~np.isin(self.target_id, list(target_id))
        joint = self.joint_covariance
        if joint is not None:
            rows = np.flatnonzero(np.repeat(is_kept, 3))
            joint = joint[np.ix_(rows, rows)]
        kept = chosen_rows(replace(self, joint_covariance=None), is_kept)
        return replace(kept, joint_covariance=joint)

    @property
    def off_mm(self) -> NDArray[np.float64]:
        """Distances (n,) from the given coordinates."""
        return np.linalg.norm(self.xyz_mm - self.given_mm, axis=1)


def surveyed_beads(
    result: CalibrationResult, initial: Phantom, distances: Sequence[MeasuredDistance] = ()
) -> SurveyedBeads:
    """Return the beads of a joint calibration with inner constraints, at a measured scale.

    Raises DataError for a distance with an end that is not among its targets.
    """
    (solved,) = result.solved.values()
    targets = result.targets
    row = initial.index(targets.target_id)
    given_mm = initial.xyz_mm[row]
    given_sd = initial.sd_mm[row]
    network = solved.measured.network
    in_datum = slice(None) if network.in_datum is None else network.in_datum
    centre = targets.xyz_mm[in_datum].mean(axis=0)
    if distances:
        scaled = scaled_by_distances(
            targets.xyz_mm,
            targets.covariance,
            solved.covariance_of_points(),
            _rows(distances, targets.target_id),
            centre,
        )
        xyz = scaled.xyz_mm
        covariance = scaled.covariance
        scale = scaled.scale
        scale_sd = scaled.scale_sd
    else:
        scaled = None
        xyz = targets.xyz_mm
        scale = 1.0
        scale_sd = _scale_sd(given_mm[in_datum], given_sd[in_datum])
        arm = xyz - centre
        covariance = targets.covariance + scale_sd**2 * arm[:, :, None] * arm[:, None, :]
    rays, angle = _rays(network, solved.adjustment)
    return SurveyedBeads(
        target_id=targets.target_id,
        xyz_mm=xyz,
        covariance=covariance,
        given_mm=given_mm,
        given_sd_mm=given_sd,
        rays=rays,
        angle_rad=angle,
        scale=scale,
        scale_sd=scale_sd,
        distances=tuple(distances),
        scaled=scaled,
        joint_covariance=targets.joint_covariance,
    )


def _rows(distances: Sequence[MeasuredDistance], target_id: NDArray[np.int64]) -> Distances:
    """Return the distances by rows of targets. Raises DataError for an end without a row."""
    for distance in distances:
        for end in (distance.first, distance.second):
            if end not in target_id:
                raise DataError(
                    f'bead {end} cannot be located from the images: it is not on the phantom, or '
                    'too few exposures show it',
                    kind=Kind.FEW_RAYS,
                    place=Place(target_id=(end,), name=distance.name),
                )
    pairs = np.array([(distance.first, distance.second) for distance in distances])
    return Distances(
        np.searchsorted(target_id, pairs),
        np.array([distance.length_mm for distance in distances], dtype=float),
        np.array([distance.sd_mm for distance in distances], dtype=float),
    )


def _scale_sd(given_mm: NDArray[np.float64], given_sd: NDArray[np.float64]) -> float:
    """Return the standard deviation of the scale of given coordinates with independent errors."""
    square = np.sum((given_mm - given_mm.mean(axis=0)) ** 2, axis=1)
    return float(np.sqrt(np.sum(given_sd**2 * square)) / np.sum(square))


def _rays(
    network: Network, adjustment: Adjustment
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return the number (n,) of inlier rays of each object point, and their largest angle (n,)."""
    parameters = adjustment.parameters
    rows = np.flatnonzero(adjustment.inliers)
    point = network.point[rows]
    ray = parameters.points_mm[point] - parameters.position_mm[network.exposure[rows]]
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    order = np.argsort(point, kind='stable')
    count = np.bincount(point, minlength=network.n_points)
    angle = np.zeros(network.n_points)
    for number, directions in enumerate(np.split(ray[order], np.cumsum(count)[:-1])):
        if len(directions) > 1:
            # Rays from opposite sides have the same line, and intersect as badly as parallel rays.
            angle[number] = np.arccos(np.clip(np.abs(directions @ directions.T).min(), 0, 1))
    return count, angle
