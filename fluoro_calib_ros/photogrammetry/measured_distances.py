# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Scale of a free network from measured distances between its object points.

The distances are weighted observations that follow the adjustment of the images: with the
coordinates x of the free network, their covariance C and the unknown scale 1 + s about the centre,

    d - l = l s + A e + noise,    e with covariance C, noise with the variances of the distances,

where l are the distances in the network and A their derivatives. This is sequential least squares
(Foerstner and Wrobel, "Photogrammetric Computer Vision", Springer 2016, 4.2.7) and gives what the
distances in the adjustment would give. C keeps the inner constraints, and so do the coordinates:
position and attitude stay those of the datum, only the scale becomes that of the distances.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

CHECKED = 1e-9  # least redundancy of a distance, above rounding

# Blocks (k, 3, 3) of object points p (k,) with object points q (k,).
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
    #: factor on the network, and its standard deviation
    scale: float
    scale_sd: float
    #: (k,) measured distances less those that the images and the other distances give; 0 where
    #: nothing checks a distance
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
        In the datum of inner constraints [mm^2].
    between : callable
        Their covariances with each other.
    distances : Distances
    centre_mm : (3,) ndarray
        Centre of the datum, which the scale leaves in place.

    Returns
    -------
    Scaled
    """
    first, second = distances.pairs.T
    offset = xyz_mm[second] - xyz_mm[first]
    length = np.linalg.norm(offset, axis=1)
    direction = offset / length[:, None]
    # C A^T: of every object point with every distance.
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
    left = difference - change * length
    gain = mixed @ inverse
    moved = mixed @ (inverse @ left)
    arm = xyz_mm - centre_mm
    along = arm - gain @ length
    pull = inverse @ left
    # Of the pulls; zero for what no other distance checks.
    variance_of_pull = np.diagonal(inverse - variance * np.outer(weight, weight))
    is_checked = variance_of_pull > CHECKED * np.diagonal(inverse)
    variance_of_pull = np.where(is_checked, variance_of_pull, np.inf)
    return Scaled(
        xyz_mm + change * arm + moved,
        covariance
        - np.einsum('nak,nbk->nab', gain, mixed)
        + variance * along[:, :, None] * along[:, None, :],
        1 + change,
        float(np.sqrt(variance)),
        error_mm=pull / variance_of_pull,
        normalised=pull / np.sqrt(variance_of_pull),
        chi2=float(left @ pull),
        freedom=k - 1,
    )
