# Copyright 2026 fluoro_calib_ros maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""Scatter of the relative orientations of exposures about that of the rig.

The pairs of exposures of a rigid rig have one relative orientation. A pair whose frames are not of
one exposure, or between whose frames the phantom moved, has another one, and is left out.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..photogrammetry.collinearity import project
from ..photogrammetry.network import Network
from ..photogrammetry.relative_orientation import discrepancies, mean_pose
from ..photogrammetry.relative_pose import RelativeConstraint, RelativePose
from ..photogrammetry.unknowns import Parameters

# A pair of exposures is left out of the mean where its deviation is so many times its standard
# deviation, and so many times the median of all pairs; at most this share of them is.
MAX_PAIR_SD = 4.0
MAX_LEFT_OUT = 1 / 3
MIN_PAIRS_ROBUST = 4
ROBUST_STEPS = 5


@dataclass(frozen=True)
class PairScatter:
    """How the relative orientations of k pairs of exposures scatter about the one of the rig.

    Attributes
    ----------
    fluoroscopes : (str, str)
    exposures : (k,) ndarray of int
    off_px : (k,) ndarray
        RMS displacement of a coordinate of the image points of the second fluoroscope [px].
    off_sd : (k,) ndarray
        Deviation over its standard deviation.
    used : (k,) ndarray of bool
        Whether the pair has part in the mean.
    growth : float
        Factor, at least 1, by which the used pairs scatter more than their standard deviations.
    turn : (k, 3, 3) ndarray
        Rotations from the sensor of the first fluoroscope to that of the second.
    shift_mm : (k, 3) ndarray
        Of the second source in the sensor frame of the first.
    """

    fluoroscopes: tuple[str, str]
    exposures: np.ndarray
    off_px: np.ndarray
    off_sd: np.ndarray
    used: np.ndarray
    growth: float
    turn: np.ndarray
    shift_mm: np.ndarray


def agreeing(
    parameters: Parameters, constraint: RelativeConstraint, weights: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return which (k,) pairs agree, and the deviations (k,) of all from their mean over its sd.

    weights (k, 6, 6) are those of the pairs. Where more than a few contradict the others, none is
    left out: there is no majority to rely on.
    """
    pairs = constraint.pairs
    every = np.ones(len(pairs), dtype=bool)
    robust = len(pairs) >= MIN_PAIRS_ROBUST
    pose = mean_pose(parameters, pairs, None if robust else weights)
    used = every
    for _ in range(ROBUST_STEPS if robust else 0):
        deviation = _deviations(parameters, constraint, pose, weights)
        limit = MAX_PAIR_SD * max(1.0, float(np.median(deviation)))
        before, used = used, deviation <= limit
        if np.sum(~used) > MAX_LEFT_OUT * len(pairs):
            used = every
        pose = mean_pose(parameters, pairs[used], weights[used])
        if np.array_equal(before, used):
            break
    return used, _deviations(parameters, constraint, pose, weights)


def _deviations(
    parameters: Parameters,
    constraint: RelativeConstraint,
    pose: RelativePose,
    weights: np.ndarray,
) -> np.ndarray:
    """Deviations (k,) of pairs from a relative orientation over their standard deviations."""
    off = discrepancies(constraint, pose, parameters)
    return np.sqrt(np.einsum('ki,kij,kj->k', off, weights, off) / 6)


def displacements(
    network: Network, parameters: Parameters, pairs: np.ndarray, pose: RelativePose
) -> np.ndarray:
    """RMS (k,) [px] of a coordinate by which image points of pairs (k, 2) of exposures are off.

    They are displaced by the relative orientation of the pair against that of the rig.
    """
    out = np.zeros(len(pairs))
    for k, (a, b) in enumerate(pairs):
        points = parameters.points_mm[network.point[network.exposure == b]]
        interior = parameters.interior[network.fluoroscope[b]]
        rotation = pose.rotation @ parameters.rotation[a]
        source = parameters.position_mm[a] + parameters.rotation[a].T @ pose.translation_mm
        shown = [
            project(
                np.broadcast_to(r, (len(points), 3, 3)),
                np.broadcast_to(t, points.shape),
                points,
                interior,
            )
            for r, t in (
                (rotation, source),
                (parameters.rotation[b], parameters.position_mm[b]),
            )
        ]
        out[k] = np.sqrt(np.mean((shown[0] - shown[1]) ** 2))
    return np.where(np.isnan(out), np.inf, out)  # NaN: points behind the source
