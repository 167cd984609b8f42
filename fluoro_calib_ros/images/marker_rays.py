# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Rays of markers in several views, and the rigid bodies that they belong to."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray

from ..bodies.body import Body, by_pose
from ..bodies.motion import POSE
from ..bodies.shapes import learned_shape
from ..bodies.tracking import BodyTracker
from ..correction.fluoroscope_calibration import Calibrations
from ..photogrammetry.collinearity import project
from ..photogrammetry.rig_orientation import RigOrientation
from ..reconstruction.intersection import (
    IntersectedPoints,
    Intersector,
    largest_lack_of_fit,
)
from ..reconstruction.reconstruct import IntersectedViews, MatchedViews
from .corrector import observed_pixels
from .markers import MarkerFrame

AGREE = 4.0  # largest standardised deviation of rays, or members of a body, that belong together
SYSTEMATIC_PX = 0.1  # standard deviation of a corrected image point in addition to its own


@dataclass(frozen=True)
class MarkerExposure:
    """Markers of one exposure, in arrays over F views and n ids."""

    observed: NDArray[np.float64]  #: (F, n, 2) [px], NaN if a view does not see a marker
    doubtful: NDArray[np.bool_]  #: (F, n), True if the id may be wrong in the view
    intersected: IntersectedViews  #: corrected image points and the places of the markers
    #: (F, n), standardised lack of fit of the rays that are intersected, NaN without a ray; for
    #: two rays their epipolar distance; for a dropped false ray that of all rays of the marker
    standardised: NDArray[np.float64]

    @property
    def corrected(self) -> NDArray[np.float64]:
        """Corrected image points (F, n, 2) [px]."""
        return self.intersected.views.uv

    @property
    def sigma(self) -> NDArray[np.float64]:
        """Standard deviations (F, n) of the corrected image points [px]."""
        return self.intersected.views.sigma

    @property
    def xyz_mm(self) -> NDArray[np.float64]:
        """Places (n, 3) [mm]."""
        return self.intersected.points.xyz_mm

    @property
    def agree(self) -> NDArray[np.bool_]:
        """Whether a ray (F, n) meets others of its marker."""
        return (self.standardised < AGREE) & np.isfinite(self.xyz_mm).all(axis=1)

    @property
    def sure(self) -> NDArray[np.bool_]:
        """Whether (n,) rays of a marker meet, from at least two views that do not doubt its id."""
        return np.asarray((self.agree & ~self.doubtful).sum(axis=0) >= 2)


@dataclass(frozen=True)
class MarkerPlaces:
    """Places (n, 3) of markers [mm], NaN for unknown places; covariances (n, 3, 3)."""

    xyz_mm: NDArray[np.float64]
    covariance: NDArray[np.float64]

    @classmethod
    def nowhere(cls, count: int) -> MarkerPlaces:
        """Return unknown places."""
        return cls(np.full((count, 3), np.nan), np.full((count, 3, 3), np.nan))

    @property
    def known(self) -> NDArray[np.bool_]:
        """Whether (n,) the place of a marker is known."""
        return np.asarray(np.isfinite(self.xyz_mm).all(axis=1))

    def filled(self, others: MarkerPlaces) -> MarkerPlaces:
        """Return these places, with unknown places filled from others."""
        known = self.known
        if known.all() or not others.known.any():
            return self
        return MarkerPlaces(
            np.where(known[:, None], self.xyz_mm, others.xyz_mm),
            np.where(known[:, None, None], self.covariance, others.covariance),
        )

    def moved_on(self, before: MarkerPlaces, share: float) -> MarkerPlaces:
        """Extrapolate the places of markers that moved from other places to these.

        share: time of the extrapolation, as a share of the time between the two.
        """
        displacement = share * (self.xyz_mm - before.xyz_mm)
        covariance = (1 + share) ** 2 * self.covariance + share**2 * before.covariance
        # The uncertainty of the extrapolation is as large as the motion itself, along any axis.
        motion_covariance = (
            np.sum(displacement * displacement, axis=1)[:, None, None] / 3 * np.eye(3)
        )
        return MarkerPlaces(self.xyz_mm + displacement, covariance + motion_covariance)


@dataclass(frozen=True)
class CalibratedRig:
    """Orientation and calibrations of fluoroscopes, and the angles of their C-arms [rad]."""

    orientation: RigOrientation
    calibrations: Calibrations
    angles: Mapping[str, float | None]

    def project(self, view: int, xyz_mm: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return observed pixels (k, 2) of points (k, 3) in the rig frame [mm].

        view is the row of the fluoroscope in the orientation. NaN stays NaN, and points that are
        not before the source are NaN.
        """
        rig = self.orientation
        name = rig.fluoroscopes[view]
        ideal = project(rig.rotation[view], rig.position_mm[view], xyz_mm, rig.interior[view])
        angle = self.angles.get(name)
        return observed_pixels(self.calibrations[name], ideal.T.copy(), angle).T

    def spread(
        self, view: int, xyz_mm: NDArray[np.float64], covariance: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return standard deviations (k,) of a coordinate in a view [px] for points (k, 3).

        covariance: (k, 3, 3) of the points [mm^2].
        """
        rig = self.orientation
        axes = rig.rotation[view]
        sensor = (xyz_mm - rig.position_mm[view]) @ axes.T
        depth = sensor[:, 2, None, None]
        slope = rig.interior[view, 2] / depth * (axes[:2] - sensor[:, :2, None] / depth * axes[2])
        variance = np.trace(slope @ covariance @ np.swapaxes(slope, 1, 2), axis1=1, axis2=2)
        return np.asarray(np.sqrt(variance / 2))


class MarkerRays:
    """Rays of markers in calibrated views.

    target_id: (n,) ids of all markers, ascending.
    """

    def __init__(self, rig: CalibratedRig, target_id: NDArray[np.int64]) -> None:
        self._calibrations = rig.calibrations
        self._names = rig.orientation.fluoroscopes
        self._target_id = target_id
        self._fit = RayFit(rig.orientation)

    def intersect(
        self, views: Mapping[str, MarkerFrame], angles: Mapping[str, float | None]
    ) -> MarkerExposure:
        """Correct and intersect the markers of an exposure at C-arm angles [rad]."""
        shape = (len(self._names), len(self._target_id))
        observed = np.full((*shape, 2), np.nan)
        corrected = np.full((*shape, 2), np.nan)
        sigma, correction_sd = np.full((2, *shape), np.nan)
        doubtful = np.zeros(shape, dtype=bool)
        for view, name in enumerate(self._names):
            markers = views[name]
            rows = np.searchsorted(self._target_id, markers.target_id)
            observed[view, rows] = markers.uv
            u, v, total, sd, _ = self._calibrations[name].correct_arrays(
                markers.uv[:, 0].copy(), markers.uv[:, 1].copy(), markers.sigma, angles.get(name)
            )
            corrected[view, rows] = np.stack([u, v], axis=1)
            sigma[view, rows] = np.hypot(total, SYSTEMATIC_PX)
            correction_sd[view, rows] = np.hypot(sd, SYSTEMATIC_PX)
            doubtful[view, rows] = markers.doubtful
        points, standardised = self._fit.intersect(corrected, sigma)
        outside = np.zeros(sigma.shape, dtype=bool)
        matched = MatchedViews(self._target_id, corrected, sigma, correction_sd, outside)
        return MarkerExposure(observed, doubtful, IntersectedViews(matched, points), standardised)

    def exchanged(
        self, exposure: MarkerExposure, view: int, rows: Sequence[int]
    ) -> NDArray[np.float64]:
        """Return the standardised lack of fit (2,) of two markers of a view after an exchange."""
        pair = list(rows)
        uv = exposure.corrected[:, pair].copy()
        sigma = exposure.sigma[:, pair].copy()
        uv[view] = uv[view, ::-1]
        sigma[view] = sigma[view, ::-1]
        _, standardised = self._fit.intersect(uv, sigma)
        return standardised[view]

    def by_others(
        self, exposure: MarkerExposure, view: int, wanted: NDArray[np.bool_]
    ) -> MarkerPlaces:
        """Return the places of markers on which at least two other views agree.

        wanted: (n,) True for these markers.
        """
        out = MarkerPlaces.nowhere(len(self._target_id))
        seen = np.asarray(np.isfinite(exposure.corrected).all(axis=2))
        seen[view] = False
        rows = np.flatnonzero(wanted & (seen.sum(axis=0) >= 2))
        if not len(rows):
            return out
        uv = exposure.corrected[:, rows]  # a copy
        uv[view] = np.nan
        points, standardised = self._fit.intersect(uv, exposure.sigma[:, rows])
        agree = np.isfinite(points.xyz_mm).all(axis=1)
        agree &= np.nanmax(standardised, axis=0, initial=0.0) < AGREE
        out.xyz_mm[rows[agree]] = points.xyz_mm[agree]
        out.covariance[rows[agree]] = points.covariance[agree]
        return out


class RayFit:
    """Intersects rays, and determines which of them belong together.

    Of three rays or more, a false ray is dropped if the others agree without it.
    """

    def __init__(self, orientation: RigOrientation) -> None:
        self.orientation = orientation
        self._all = Intersector(orientation, None)
        self._without_false = Intersector(orientation, AGREE)
        limits = largest_lack_of_fit(AGREE, len(orientation.fluoroscopes))
        # By the number of rays: AGREE corresponds to the same probability for any number of them.
        self._scale = limits[2] / limits

    def intersect(
        self, uv: np.ndarray, sigma: NDArray[np.float64]
    ) -> tuple[IntersectedPoints, NDArray[np.float64]]:
        """Intersect image points uv (F, n, 2) with standard deviations sigma (F, n) [px].

        Also return the standardised lack of fit (F, n), see MarkerExposure.
        """
        points = self._all.intersect(uv, sigma)
        seen = np.isfinite(uv).all(axis=2)
        standardised = np.where(seen, points.standardised * self._scale[points.rays], np.nan)
        misses = ~(points.standardised * self._scale[points.rays] < AGREE)
        rows = np.flatnonzero((points.rays > 2) & misses)
        if not len(rows):
            return points, standardised
        reduced = self._without_false.intersect(uv[:, rows], sigma[:, rows])
        has_dropped = reduced.dropped_view >= 0
        reduced_rows = rows[has_dropped]
        remaining = np.arange(len(uv))[:, None] != reduced.dropped_view[has_dropped]
        misfit = (reduced.standardised * self._scale[reduced.rays])[has_dropped]
        standardised[:, reduced_rows] = np.where(
            remaining & seen[:, reduced_rows], misfit, standardised[:, reduced_rows]
        )
        values = {}
        for field in fields(IntersectedPoints):
            values[field.name] = getattr(points, field.name).copy()
            values[field.name][reduced_rows] = getattr(reduced, field.name)[has_dropped]
        return IntersectedPoints(**values), standardised


RIGID_MM = 0.1  # standard deviation of the motion of a marker in its body
MIN_MEMBERS = 3  # members of a body that determine its pose
# Share of the markers of a body that must be seen again. With fewer, the body has moved elsewhere,
# and the measured shadows may be anything.
MIN_SEEN = 0.5
LEARNED = 40  # exposures from which the shape of a body is learned
FRAME_NS = 10_000_000  # nominal time of an exposure for the filter, which adapts to any


class MarkerBodies:
    """All rigid bodies of markers.

    orientation: of the fluoroscopes. target_id: (n,) ids of all markers, ascending. bodies:
    unknown shapes are learned; bodies with too few markers are ignored.
    """

    def __init__(
        self, orientation: RigOrientation, target_id: NDArray[np.int64], bodies: Sequence[Body]
    ) -> None:
        self._count = len(target_id)
        self._bodies = []
        for body in bodies:
            is_tracked = np.isin(body.target_id, target_id)
            if np.count_nonzero(is_tracked) >= MIN_MEMBERS:
                self._bodies.append(body.rows(is_tracked))
        self._rows = [np.searchsorted(target_id, body.target_id) for body in self._bodies]
        # For all markers of bodies: the body, and the row in the body.
        self._member = (
            np.repeat(np.arange(len(self._rows)), [len(rows) for rows in self._rows]),
            np.array([k for rows in self._rows for k in range(len(rows))], dtype=int),
        )
        self._seen: list[list[tuple[NDArray[np.float64], NDArray[np.float64]]]] = [
            [] for _ in self._bodies
        ]
        self._learned = [
            np.where(body.known, LEARNED, 0) for body in self._bodies
        ]  # number of exposures, by marker
        self._tracker: BodyTracker | None = None
        if self._bodies:
            self._tracker = BodyTracker(orientation, [_placed(body) for body in self._bodies])
        self.present = MarkerPlaces.nowhere(self._count)

    def lost(self) -> tuple[Body, ...]:
        """Return bodies with unknown pose."""
        if self._tracker is None:
            return ()
        alive = self._tracker.filter.alive.tolist()
        return tuple(body for body, is_alive in zip(self._bodies, alive) if not is_alive)

    def unplaced(self) -> NDArray[np.bool_]:
        """Return (n,) whether markers have a known place in a body with unknown pose."""
        out = np.zeros(self._count, dtype=bool)
        for body, rows in zip(self._bodies, self._rows):
            out[rows] = body.known
        return np.asarray(out & ~self.present.known)

    def among(self, supported: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Return (n,) whether markers are of bodies with enough supported markers for a pose."""
        out = np.zeros(self._count, dtype=bool)
        for rows in self._rows:
            out[rows] = np.count_nonzero(supported[rows]) >= MIN_MEMBERS
        return out

    def miss(
        self, measured: NDArray[np.bool_], before: NDArray[np.bool_]
    ) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """Mark bodies as lost if they are not at their expected places.

        measured, before (F, n): markers that are measured now, and in the last images of the same
        views. Return the markers (n,) of lost bodies, and those (F, n) of bodies that are not at
        their expected places in a view.
        """
        out = np.zeros(self._count, dtype=bool)
        by_view = np.zeros(measured.shape, dtype=bool)
        if self._tracker is None:
            return out, by_view
        lost = np.zeros(len(self._rows), dtype=bool)
        for number, rows in enumerate(self._rows):
            expected = before[:, rows].sum(axis=1)
            seen = (measured & before)[:, rows].sum(axis=1)
            lost[number] = _is_elsewhere(seen.sum(), expected.sum())
            out[rows] = lost[number]
            by_view[:, rows] = _is_elsewhere(seen, expected)[:, None]
        self._tracker.lose(lost)
        return out, by_view

    def predicted(self, frame: int) -> MarkerPlaces:
        """Return the expected places of markers in the next exposure."""
        if self._tracker is None:
            return self.present
        expected = self._tracker.predict(frame * FRAME_NS)
        rotation = np.where(expected.known[:, None, None], expected.rotation, np.nan)
        # A marker may move in its body.
        out = self._placed(rotation, expected.centre_mm, expected.covariance)
        return replace(out, covariance=out.covariance + RIGID_MM**2 * np.eye(3))

    def update(self, exposure: MarkerExposure, frame: int) -> None:
        """Update the current places of markers from the rays of markers without a doubt."""
        if self._tracker is None:
            return
        usable = self._usable(exposure)
        views = exposure.intersected.views
        views = replace(views, uv=np.where(usable[..., None], views.uv, np.nan))
        tracked = self._tracker.add(
            IntersectedViews(views, exposure.intersected.points), frame, frame * FRAME_NS
        )
        if tracked is not None:
            covariance = tracked.covariance[:, POSE, POSE]
            self.present = self._placed(tracked.rotation, tracked.centre_mm, covariance)

    def _usable(self, exposure: MarkerExposure) -> NDArray[np.bool_]:
        """Return the image points (F, n) whose ids are trusted."""
        assert self._tracker is not None
        seen = np.isfinite(exposure.corrected).all(axis=2)
        out = seen & ~exposure.doubtful & (exposure.agree | (seen.sum(axis=0) < 2))
        for body, rows, alive in zip(self._bodies, self._rows, self._tracker.filter.alive):
            agree = exposure.agree[:, rows] & body.known
            if (
                not alive
                and np.count_nonzero(exposure.sure[rows] & body.known) < MIN_MEMBERS
                and np.count_nonzero(agree.any(axis=0)) > MIN_MEMBERS
            ):
                # Doubtful ids that fit the shape of the body support each other.
                out[:, rows] = agree
            out[:, rows] &= body.known
        return out

    def _placed(
        self,
        rotation: NDArray[np.float64],
        centre: NDArray[np.float64],
        covariance: NDArray[np.float64],
    ) -> MarkerPlaces:
        """Return the places of markers at poses of the bodies."""
        assert self._tracker is not None
        out = MarkerPlaces.nowhere(self._count)
        arm = self._tracker.solver.xyz @ np.swapaxes(rotation, 1, 2)
        xyz = (arm + centre[:, None])[self._member]
        known = np.concatenate([body.known for body in self._bodies]) & np.isfinite(xyz[:, 0])
        rows = np.concatenate(self._rows)[known]
        d = by_pose(arm)
        out.xyz_mm[rows] = xyz[known]
        spread = d @ covariance[:, None] @ np.swapaxes(d, 2, 3)
        out.covariance[rows] = spread[self._member][known]
        return out

    def learn(self, exposure: MarkerExposure, sure: NDArray[np.bool_]) -> None:
        """Improve the shapes with an exposure, of which sure (n,) markers are trusted."""
        if self._tracker is None:
            return
        displacement = np.linalg.norm(exposure.xyz_mm - self.present.xyz_mm, axis=1)
        trusted = sure & ~(displacement >= AGREE * RIGID_MM)
        changed = False
        for number, rows in enumerate(self._rows):
            known = self._bodies[number].known
            is_new = trusted[rows] & (self._learned[number] < LEARNED)
            if np.count_nonzero(trusted[rows]) < MIN_MEMBERS or not is_new.any():
                continue
            self._learned[number] += is_new
            xyz = np.where(trusted[rows][:, None], exposure.xyz_mm[rows], np.nan)
            covariance = exposure.intersected.points.covariance_noise[rows]
            self._seen[number].append((xyz, covariance))
            count = len(self._seen[number])
            # Relearn after twice as many exposures, and for each new marker.
            if count & (count - 1) == 0 or count == LEARNED or (is_new & ~known).any():
                self._bodies[number] = learned_shape(
                    self._bodies[number],
                    np.stack([places for places, _ in self._seen[number]]),
                    np.stack([covariances for _, covariances in self._seen[number]]),
                )
                changed = True
        if changed:
            self._tracker.reshape([_placed(body) for body in self._bodies])


def _is_elsewhere(seen: NDArray[np.int64], expected: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Return whether so few markers of bodies are seen that these have moved elsewhere."""
    return np.asarray((expected >= MIN_MEMBERS) & (seen < MIN_SEEN * expected))


def _placed(body: Body) -> Body:
    """Return a body with the uncertainty of its rigidity, and some place for unknown markers."""
    known = body.known
    middle = body.centre if known.any() else np.zeros(3)
    return replace(
        body,
        xyz_mm=np.where(known[:, None], body.xyz_mm, middle),
        sd_mm=np.where(known & np.isfinite(body.sd_mm), np.hypot(body.sd_mm, RIGID_MM), RIGID_MM),
    )
