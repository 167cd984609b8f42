# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Rigid bodies of markers: their shapes, and where they say that markers are."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..bodies.body import Body
from ..bodies.motion import POSE
from ..bodies.rigid import by_pose
from ..bodies.shapes import learned_shape
from ..bodies.tracking import BodyTracker
from ..photogrammetry.rig_orientation import RigOrientation
from ..reconstruction.reconstruct import IntersectedViews
from .marker_rays import PairExposure

RIGID_MM = 0.1  # what a marker may move in its body, a standard deviation
RIGID_SIGMAS = 5.0
MIN_MEMBERS = 3  # of a body that give its pose
LEARNED = 40  # exposures from which the shape of a body is learned
FRAME_NS = 10_000_000  # time of an exposure for the filter, which adapts to any


@dataclass(frozen=True)
class BodyMarkers:
    """Places (n, 3) of markers by their bodies [mm], NaN for unknown; covariances (n, 3, 3)."""

    xyz_mm: NDArray[np.float64]
    covariance: NDArray[np.float64]

    @property
    def known(self) -> NDArray[np.bool_]:
        """Whether (n,) a body says where a marker is."""
        return np.asarray(np.isfinite(self.xyz_mm).all(axis=1))


class MarkerBodies:
    """All rigid bodies of markers.

    orientation: of the two fluoroscopes. target_id: (n,) of all markers, ascending. bodies: shapes
    that are not given are learned; bodies of too few markers are ignored.
    """

    def __init__(
        self, orientation: RigOrientation, target_id: np.ndarray, bodies: Sequence[Body]
    ) -> None:
        self._count = len(target_id)
        self._bodies = []
        for body in bodies:
            there = np.isin(body.target_id, target_id)
            if np.count_nonzero(there) >= MIN_MEMBERS:
                self._bodies.append(body.rows(there))
        self._rows = [np.searchsorted(target_id, body.target_id) for body in self._bodies]
        self._seen: list[list[tuple[np.ndarray, np.ndarray]]] = [[] for _ in self._bodies]
        self._learned = [
            np.where(body.known, LEARNED, 0) for body in self._bodies
        ]  # exposures, by marker
        self._tracker: BodyTracker | None = None
        if self._bodies:
            self._tracker = BodyTracker(orientation, [_placed(body) for body in self._bodies])
        self.present = self._nowhere()

    def _nowhere(self) -> BodyMarkers:
        return BodyMarkers(np.full((self._count, 3), np.nan), np.full((self._count, 3, 3), np.nan))

    def lost(self) -> tuple[Body, ...]:
        """Bodies whose pose is not known."""
        if self._tracker is None:
            return ()
        alive = self._tracker.filter.alive.tolist()
        return tuple(body for body, is_alive in zip(self._bodies, alive) if not is_alive)

    def predicted(self, frame: int) -> BodyMarkers:
        """Where markers are expected in the next exposure."""
        if self._tracker is None:
            return self.present
        expected = self._tracker.predict(frame * FRAME_NS)
        rotation = np.where(expected.known[:, None, None], expected.rotation, np.nan)
        # A marker may move in its body.
        out = self._placed(rotation, expected.centre_mm, expected.covariance)
        return replace(out, covariance=out.covariance + RIGID_MM**2 * np.eye(3))

    def update(self, exposure: PairExposure, frame: int) -> None:
        """Set where markers are at present, by the rays of those without a doubt."""
        if self._tracker is None:
            return
        usable = self._usable(exposure)
        views = exposure.intersected.views
        views = replace(views, uv=np.where(usable[..., None], views.uv, np.nan))
        found = self._tracker.add(
            IntersectedViews(views, exposure.intersected.points), frame, frame * FRAME_NS
        )
        if found is not None:
            covariance = found.covariance[:, POSE, POSE]
            self.present = self._placed(found.rotation, found.centre_mm, covariance)

    def _usable(self, exposure: PairExposure) -> np.ndarray:
        """Image points (2, n) whose ids are believed."""
        assert self._tracker is not None
        seen = np.isfinite(exposure.corrected).all(axis=2)
        out = seen & ~exposure.doubtful & (exposure.agree | (seen.sum(axis=0) < 2))
        for body, rows, alive in zip(self._bodies, self._rows, self._tracker.filter.alive):
            agree = exposure.agree[rows] & body.known
            if (
                not alive
                and np.count_nonzero(exposure.sure[rows] & body.known) < MIN_MEMBERS
                and np.count_nonzero(agree) > MIN_MEMBERS
            ):
                # Doubtful ids that fit the shape of the body support each other.
                out[:, rows] = agree
            out[:, rows] &= body.known
        return out

    def _placed(
        self, rotation: np.ndarray, centre: np.ndarray, covariance: np.ndarray
    ) -> BodyMarkers:
        """Places of markers at poses of the bodies."""
        assert self._tracker is not None
        out = self._nowhere()
        for number, (body, rows) in enumerate(zip(self._bodies, self._rows)):
            if not np.isfinite(rotation[number]).all():
                continue
            count = len(rows)
            arm = self._tracker.solver.xyz[number, :count] @ rotation[number].T
            d = by_pose(arm)
            out.xyz_mm[rows] = np.where(body.known[:, None], arm + centre[number], np.nan)
            out.covariance[rows] = d @ covariance[number] @ np.swapaxes(d, 1, 2)
        return out

    def learn(self, exposure: PairExposure, sure: np.ndarray) -> None:
        """Improve the shapes by an exposure, of which sure (n,) markers are trusted."""
        if self._tracker is None:
            return
        away = np.linalg.norm(exposure.xyz_mm - self.present.xyz_mm, axis=1)
        use = sure & ~(away >= RIGID_SIGMAS * RIGID_MM)
        changed = False
        for number, rows in enumerate(self._rows):
            known = self._bodies[number].known
            fresh = use[rows] & (self._learned[number] < LEARNED)
            if np.count_nonzero(use[rows]) < MIN_MEMBERS or not fresh.any():
                continue
            self._learned[number] += fresh
            xyz = np.where(use[rows][:, None], exposure.xyz_mm[rows], np.nan)
            covariance = exposure.intersected.points.covariance_noise[rows]
            self._seen[number].append((xyz, covariance))
            count = len(self._seen[number])
            # Twice as many exposures make a difference, and so does a marker that is new.
            if count & (count - 1) == 0 or count == LEARNED or (fresh & ~known).any():
                self._bodies[number] = learned_shape(
                    self._bodies[number],
                    np.stack([places for places, _ in self._seen[number]]),
                    np.stack([of_places for _, of_places in self._seen[number]]),
                )
                changed = True
        if changed:
            self._tracker.reshape([_placed(body) for body in self._bodies])


def _placed(body: Body) -> Body:
    """Return a body with the uncertainty of its rigidity, and somewhere what is not known."""
    known = body.known
    middle = body.centre if known.any() else np.zeros(3)
    return replace(
        body,
        xyz_mm=np.where(known[:, None], body.xyz_mm, middle),
        sd_mm=np.where(known & np.isfinite(body.sd_mm), np.hypot(body.sd_mm, RIGID_MM), RIGID_MM),
    )
