# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Rigid clusters of markers: their shapes, and the places that they say."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..bodies.rigid import fitted_pose
from ..checks.cluster_watch import Cluster
from .marker_ids import ClusterShape

RIGID_MM = 0.1  # what a marker may move in its cluster, a standard deviation
RIGID_SIGMAS = 5.0
MIN_MEMBERS = 3  # of a cluster that give its pose
LEARNED = 40  # exposures whose mean is the shape of a cluster


class RigidBody:
    """A rigid cluster: its shape, and its pose in an exposure."""

    def __init__(self, rows: np.ndarray) -> None:
        self.rows = rows
        self.shape = np.full((len(rows), 3), np.nan)
        self.count = np.zeros(len(rows), dtype=int)

    def expected(self, xyz: np.ndarray, trusted: np.ndarray, least: int) -> np.ndarray | None:
        """Places (k, 3) of all members by those that are trusted (k,), None for too few."""
        use = trusted & np.isfinite(self.shape).all(axis=1)
        while np.count_nonzero(use) >= least:
            rotation, shift = fitted_pose(self.shape[use], xyz[use])
            found = self.shape @ rotation.T + shift
            error = np.where(use, np.linalg.norm(found - xyz, axis=1), 0.0)
            worst = int(np.argmax(error))
            if error[worst] < RIGID_SIGMAS * RIGID_MM:
                return found
            if np.count_nonzero(use) == least:
                return None
            use[worst] = False
        return None

    def learn(self, xyz: np.ndarray, trusted: np.ndarray) -> None:
        """Improve the shape by an exposure."""
        known = self.count > 0
        if not known.any():
            if np.count_nonzero(trusted) >= MIN_MEMBERS:
                self.shape[trusted] = xyz[trusted]
                self.count[trusted] = 1
            return
        use = trusted & known
        if np.count_nonzero(use) < MIN_MEMBERS:
            return
        rotation, shift = fitted_pose(xyz[use], self.shape[use])
        local = xyz @ rotation.T + shift
        near = np.linalg.norm(local - self.shape, axis=1) < RIGID_SIGMAS * RIGID_MM
        for row in np.flatnonzero(trusted & (near | ~known) & (self.count < LEARNED)):
            before = self.shape[row] if self.count[row] else 0.0
            self.count[row] += 1
            self.shape[row] = before + (local[row] - before) / self.count[row]


class MarkerBodies:
    """All rigid clusters of markers.

    Parameters
    ----------
    target_id : (n,) ndarray
        Of all markers, ascending.
    clusters : sequence of Cluster
        Their shapes are learned; those of too few markers are ignored.
    shapes : sequence of ClusterShape
        Clusters whose shapes are known.
    """

    def __init__(
        self, target_id: np.ndarray, clusters: Sequence[Cluster], shapes: Sequence[ClusterShape]
    ) -> None:
        self._bodies = [
            RigidBody(np.searchsorted(target_id, known))
            for known in (np.intersect1d(c.target_id, target_id) for c in clusters)
            if len(known) >= MIN_MEMBERS
        ]
        for shape in shapes:
            known = np.isin(shape.target_id, target_id)
            body = RigidBody(np.searchsorted(target_id, shape.target_id[known]))
            body.shape[:] = shape.xyz_mm[known]
            body.count[:] = LEARNED
            self._bodies.append(body)

    def expected(self, xyz_mm: np.ndarray, sure: np.ndarray, agree: np.ndarray) -> np.ndarray:
        """Places (n, 3) of markers by their clusters [mm], NaN where there is none.

        xyz_mm (n, 3) are intersections, of which sure (n,) have ids without a doubt, and agree
        (n,) are of rays that meet.
        """
        out = np.full_like(xyz_mm, np.nan)
        for body in self._bodies:
            xyz = xyz_mm[body.rows]
            found = body.expected(xyz, sure[body.rows], MIN_MEMBERS)
            if found is None:
                # Doubtful ids that fit the shape of the cluster support each other.
                found = body.expected(xyz, agree[body.rows], MIN_MEMBERS + 1)
            if found is not None:
                out[body.rows] = found
        return out

    def learn(self, xyz_mm: np.ndarray, sure: np.ndarray) -> None:
        """Improve the shapes by intersections (n, 3) [mm], of which sure (n,) are trusted."""
        for body in self._bodies:
            body.learn(xyz_mm[body.rows], sure[body.rows])
