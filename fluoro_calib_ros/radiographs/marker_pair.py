# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Follow markers in two views together: each view checks and predicts the other.

The image points of both views are corrected and intersected (`reconstruction`). Two rays that do
not meet, and a marker that is not where its rigid cluster says, reveal a wrong id. A marker that
one view does not see is predicted from its cluster, whose pose is fitted to the others.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import linear_sum_assignment

from ..calibration.result import FluoroscopeCalibration
from ..drift.clusters import Cluster
from ..errors import DataError
from ..photogrammetry.rig_orientation import RigOrientation
from ..reconstruction.intersection import Intersector
from .marker_geometry import fitted_pose, project_observed
from .marker_ids import ClusterShape
from .markers import FirstMarkers, MarkerFrame, MarkerOptions, MarkerTracker

AGREE = 4.0  # standardised epipolar distance up to which two rays belong together
DISAGREE = 6.0  # from which they do not
SYSTEMATIC_PX = 0.1  # of a corrected image point, beyond its standard deviation
RIGID_MM = 0.1  # what a marker may move in its cluster, a standard deviation
RIGID_SIGMAS = 5.0
MIN_MEMBERS = 3  # of a cluster that give its pose
LEARNED = 40  # exposures whose mean is the shape of a cluster
DECIDED = 3  # exposures that agree before an id is confirmed
DECIDED_ALONE = 8  # by epipolar distances alone
WRONG = 3  # exposures that disagree before an id is wrong
NEAR_PX = 1.0  # from where its cluster says, that a marker is; or so many
NEAR_SIGMAS = 3.5
FAR = 1.5  # times that, from which it is something else
PREDICTED_SD_PX = 1.0
FORGET_VELOCITY = 0.5
MAX_AGE = 8  # exposures after the last place in space, for which it predicts
MIN_MOVES = 2  # between exposures, that give a velocity
MAX_COST = 50.0


@dataclass(frozen=True)
class Decision:
    """What the other view, or its cluster, says of a doubtful id.

    Attributes
    ----------
    kind : {'confirmed', 'exchanged', 'dropped'}
    fluoroscope : str
    frame, since : int
        The image of the decision, and the first one that it holds for.
    target_id : tuple of int
        One id, or the two that were exchanged.
    """

    kind: str
    fluoroscope: str
    frame: int
    since: int
    target_id: tuple[int, ...]


@dataclass(frozen=True)
class PairFrame:
    """Markers of one exposure of two fluoroscopes.

    Attributes
    ----------
    views : mapping of str to MarkerFrame
        By fluoroscope.
    decisions : tuple of Decision
        They hold for the images since the doubt began; the views of this exposure obey them.
    """

    views: Mapping[str, MarkerFrame]
    decisions: tuple[Decision, ...] = ()


@dataclass
class _Exposure:
    """Markers of one exposure in all views, by row of all ids.

    Attributes
    ----------
    observed, corrected : (2, n, 2) ndarray
        [px], NaN where a view does not see a marker.
    sigma : (2, n) ndarray
        Of the corrected image points.
    doubtful : (2, n) ndarray of bool
    xyz_mm : (n, 3) ndarray
    standardised : (n,) ndarray
        Epipolar distance.
    """

    observed: np.ndarray
    corrected: np.ndarray
    sigma: np.ndarray
    doubtful: np.ndarray
    xyz_mm: np.ndarray
    standardised: np.ndarray


class _Body:
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


class MarkerPair:
    """Follows markers through the images of two calibrated fluoroscopes.

    Parameters
    ----------
    calibrations : mapping of str to FluoroscopeCalibration
    orientation : RigOrientation
        That they belong to.
    options : MarkerOptions, optional
    first : mapping of str to FirstMarkers
        Ids and places in the first images, of two fluoroscopes.
    clusters : sequence of Cluster
        Markers that are rigid together. Their shapes are learned from the images.
    shapes : sequence of ClusterShape
        Clusters whose shapes are known.

    Raises
    ------
    DataError
        For other than two fluoroscopes, and for those without calibration.
    """

    def __init__(
        self,
        calibrations: Mapping[str, FluoroscopeCalibration],
        orientation: RigOrientation,
        options: MarkerOptions | None = None,
        *,
        first: Mapping[str, FirstMarkers],
        clusters: Sequence[Cluster] = (),
        shapes: Sequence[ClusterShape] = (),
    ) -> None:
        names = [name for name in orientation.fluoroscopes if name in first]
        if len(names) != 2 or len(first) != 2:
            raise DataError(
                f'markers of {", ".join(first) or "no fluoroscope"} were given, but two '
                f'fluoroscopes of {", ".join(orientation.fluoroscopes)} are followed together'
            )
        self.names = tuple(names)
        self.calibrations = {name: calibrations[name] for name in names}
        self.trackers = {name: MarkerTracker(options, first=first[name]) for name in names}
        self.target_id = np.unique(np.concatenate([first[name].target_id for name in names]))
        self._intersector = Intersector(orientation.subset(names), None)
        self._bodies = [
            _Body(np.searchsorted(self.target_id, known))
            for known in (np.intersect1d(c.target_id, self.target_id) for c in clusters)
            if len(known) >= MIN_MEMBERS
        ]
        for shape in shapes:
            known = np.isin(shape.target_id, self.target_id)
            body = _Body(np.searchsorted(self.target_id, shape.target_id[known]))
            body.shape[:] = shape.xyz_mm[known]
            body.count[:] = LEARNED
            self._bodies.append(body)
        n = len(self.target_id)
        self._xyz = np.full((n, 3), np.nan)
        self._velocity = np.zeros((n, 3))
        self._moves = np.zeros(n, dtype=int)
        self._age = np.zeros(n, dtype=int)
        self._frame = 0
        # Of the C-arms [rad], in the last exposure and in the one before.
        self._angles: Mapping[str, float | None] = {}
        self._angles_before: Mapping[str, float | None] = {}
        self._evidence: dict[tuple[int, int, int], float] = defaultdict(float)
        self._kept: dict[tuple[int, int, int], int] = {}
        self._agreed = np.zeros((2, n), dtype=int)
        self._right = np.zeros((2, n), dtype=int)
        self._seen_right = np.zeros((2, n), dtype=int)
        self._wrong = np.zeros((2, n), dtype=int)

    def update(
        self,
        images: Mapping[str, np.ndarray | None],
        frame: int,
        angles: Mapping[str, float | None] | None = None,
    ) -> PairFrame:
        """Measure the markers of the next images.

        Parameters
        ----------
        images : mapping of str to ndarray or None
            By fluoroscope; one may be missing, after the first exposure.
        frame : int
            Number of the exposure, above that of the one before.
        angles : mapping of str to float or None, optional
            Of the C-arms [rad], by fluoroscope, for corrections that change with them; None where
            they are unknown.

        Returns
        -------
        PairFrame

        Raises
        ------
        DataError
            As MarkerTracker.update, and for an image of another size than the calibration's.
        """
        for name in self.names:
            image = images.get(name)
            expected = self.calibrations[name].image_size
            if self._frame == 0 and image is not None and image.shape[::-1] != tuple(expected):
                width, height = image.shape[::-1]
                raise DataError(
                    f'fluoroscope {name}: the image is {width} x {height} px, but the '
                    f'calibration is for {expected[0]} x {expected[1]} px'
                )
        self._angles_before, self._angles = self._angles, dict(angles or {})
        if self._frame:
            self._suggest(frame - self._frame)
        views = {
            name: tracker.update(images.get(name), frame)
            for name, tracker in self.trackers.items()
        }
        exposure = self._exposure(views)
        expected_mm, sure = self._expected(exposure)
        decisions = self._decide(exposure, expected_mm, frame)
        self._remember(exposure, expected_mm, sure, decisions, frame)
        revised = {}
        for name, tracker in self.trackers.items():
            found = _revised(views[name], name, decisions, frame)
            doubtful = np.array(
                [tracker.doubted_since(int(i)) is not None for i in found.target_id], dtype=bool
            )
            revised[name] = replace(found, doubtful=doubtful)
        return PairFrame(revised, decisions)

    def _suggest(self, frames: int) -> None:
        """Offer each view predictions of the markers that it is not sure of."""
        now = self._xyz + frames * self._velocity
        good = np.isfinite(now).all(axis=1) & (self._moves >= MIN_MOVES) & (self._age <= MAX_AGE)
        for view, tracker in enumerate(self.trackers.values()):
            rows = np.searchsorted(self.target_id, tracker.unsure())
            rows = rows[good[rows]]
            if not len(rows):
                continue
            uv = self._project(view, now[rows], self._angles)
            before = self._project(view, self._xyz[rows], self._angles_before)
            velocity = (uv - before) / frames
            sd = PREDICTED_SD_PX * (frames + self._age[rows])
            tracker.suggest(self.target_id[rows], uv, velocity, sd)

    def _project(
        self, view: int, xyz: np.ndarray, angles: Mapping[str, float | None]
    ) -> np.ndarray:
        """Observed pixels (k, 2) of points (k, 3) in the rig frame [mm] at angles [rad]."""
        name = self.names[view]
        return project_observed(
            self._intersector.orientation, view, self.calibrations[name], xyz, angles.get(name)
        )

    def _exposure(self, views: Mapping[str, MarkerFrame]) -> _Exposure:
        """Correct and intersect the markers of an exposure."""
        n = len(self.target_id)
        observed = np.full((2, n, 2), np.nan)
        corrected = np.full((2, n, 2), np.nan)
        sigma = np.full((2, n), np.nan)
        doubtful = np.zeros((2, n), dtype=bool)
        for view, name in enumerate(self.names):
            found = views[name]
            rows = np.searchsorted(self.target_id, found.target_id)
            observed[view, rows] = found.uv
            u, v, total, _, _ = self.calibrations[name].correct_arrays(
                found.uv[:, 0].copy(), found.uv[:, 1].copy(), found.sigma, self._angles.get(name)
            )
            corrected[view, rows] = np.stack([u, v], axis=1)
            sigma[view, rows] = np.hypot(total, SYSTEMATIC_PX)
            doubtful[view, rows] = found.doubtful
        points = self._intersector.intersect(corrected, sigma)
        return _Exposure(observed, corrected, sigma, doubtful, points.xyz_mm, points.standardised)

    def _expected(self, exposure: _Exposure) -> tuple[np.ndarray, np.ndarray]:
        """Places (n, 3) by the clusters, NaN where there is none; trusted intersections (n,)."""
        agree = (exposure.standardised < AGREE) & np.isfinite(exposure.xyz_mm).all(axis=1)
        sure = agree & ~exposure.doubtful.any(axis=0)
        out = np.full_like(exposure.xyz_mm, np.nan)
        for body in self._bodies:
            xyz = exposure.xyz_mm[body.rows]
            found = body.expected(xyz, sure[body.rows], MIN_MEMBERS)
            if found is None:
                # Doubtful ids that fit the shape of the cluster support each other.
                found = body.expected(xyz, agree[body.rows], MIN_MEMBERS + 1)
            if found is not None:
                out[body.rows] = found
        return out, sure

    def _decide(
        self, exposure: _Exposure, expected_mm: np.ndarray, frame: int
    ) -> tuple[Decision, ...]:
        """Confirm, exchange or drop ids."""
        out: list[Decision] = []
        for view in range(2):
            known = np.isfinite(expected_mm).all(axis=1)
            place = np.full((len(known), 2), np.nan)
            if known.any():
                place[known] = self._project(view, expected_mm[known], self._angles)
            out += self._by_cluster(view, exposure, place, frame)
        out += self._by_rays(exposure, np.isfinite(expected_mm).all(axis=1), frame)
        return tuple(out)

    def _by_cluster(
        self, view: int, exposure: _Exposure, place: np.ndarray, frame: int
    ) -> list[Decision]:
        """Decide on ids of a view by the places (n, 2) that clusters say, NaN for unknown."""
        name = self.names[view]
        tracker = self.trackers[name]
        seen = exposure.observed[view]
        away = np.linalg.norm(seen - place, axis=1)
        near = np.maximum(NEAR_PX, NEAR_SIGMAS * exposure.sigma[view])
        right = away < near
        wrong = away > FAR * near
        self._seen_right[view, right] = frame
        self._wrong[view] = np.where(wrong, self._wrong[view] + 1, 0)
        for row in np.flatnonzero(wrong & ~exposure.doubtful[view]):
            tracker.doubt(int(self.target_id[row]), frame)
        out = []
        # Markers beside each other exchange places only if both are nearer to the other's.
        suspects = np.flatnonzero(
            np.isfinite(away) & (exposure.doubtful[view] | (self._wrong[view] > 0))
        )
        exchanged: set[int] = set()
        for one, two in self._crossed(seen, place, near, suspects):
            ids = (int(self.target_id[one]), int(self.target_id[two]))
            since = min(
                tracker.doubted_since(ids[0]) or frame, tracker.doubted_since(ids[1]) or frame
            )
            # They were not exchanged while one of them was where its cluster says.
            since = max(since, int(self._seen_right[view, [one, two]].max()) + 1)
            tracker.exchange(*ids)
            out.append(Decision('exchanged', name, frame, since, ids))
            exchanged |= {one, two}
            self._wrong[view, [one, two]] = 0
            self._agreed[view, [one, two]] = 0
        for row in suspects.tolist():
            number = int(self.target_id[row])
            began = tracker.doubted_since(number)
            beside = np.linalg.norm(place - seen[row], axis=1)
            beside[row] = np.inf
            # Another one that could be here as well leaves the doubt.
            alone = np.nanmin(beside, initial=np.inf) > FAR * near[row]
            if row in exchanged:
                continue
            self._agree(view, row, bool(right[row] and alone), frame)
            if began is not None and self._agreed[view, row] >= DECIDED:
                tracker.confirm(number)
                out.append(
                    Decision('confirmed', name, frame, int(self._right[view, row]), (number,))
                )
                self._agreed[view, row] = 0
            elif self._wrong[view, row] >= WRONG:
                tracker.forget(number)
                out.append(Decision('dropped', name, frame, began or frame - WRONG + 1, (number,)))
                self._wrong[view, row] = 0
        return out

    def _agree(self, view: int, row: int, agrees: bool, frame: int) -> None:
        """Count the exposures that agree with a doubtful id, one after the other."""
        if not agrees:
            self._agreed[view, row] = 0
            return
        if self._agreed[view, row] == 0:
            self._right[view, row] = frame
        self._agreed[view, row] += 1

    def _crossed(
        self, seen: np.ndarray, place: np.ndarray, near: np.ndarray, suspects: np.ndarray
    ) -> list[tuple[int, int]]:
        """Pairs of suspects that are where clusters say that the other is."""
        if len(suspects) < 2:
            return []
        distance = np.linalg.norm(seen[suspects][:, None] - place[suspects][None], axis=2)
        own = np.diagonal(distance)
        cost = np.minimum(distance, MAX_COST)
        _, column = linear_sum_assignment(cost)
        out = []
        for one, two in enumerate(column.tolist()):
            if one < two and column[two] == one:
                limit = float(near[suspects[[one, two]]].min())
                both = max(distance[one, two], distance[two, one])
                if both < limit and min(own[one], own[two]) > FAR * limit:
                    out.append((int(suspects[one]), int(suspects[two])))
        return out

    def _by_rays(self, exposure: _Exposure, known: np.ndarray, frame: int) -> list[Decision]:
        """Decide on ids without a cluster by the epipolar distances of both ways round.

        known (n,) are those that clusters decide on.
        """
        out: list[Decision] = []
        both = np.isfinite(exposure.standardised) & ~known
        for view, name in enumerate(self.names):
            tracker = self.trackers[name]
            for row in np.flatnonzero(both & exposure.doubtful[view]).tolist():
                number = int(self.target_id[row])
                since = tracker.doubted_since(number)
                if since is None:
                    continue
                others = [
                    int(np.searchsorted(self.target_id, other))
                    for other in tracker.partners(number)
                ]
                others = [other for other in others if other != row and both[other]]
                for other in others:
                    if other > row:
                        out += self._both_ways(view, exposure, (int(row), other), frame)
                if not others and not tracker.partners(number) - {number}:
                    agrees = exposure.standardised[row] < AGREE
                    self._agree(view, row, bool(agrees), frame)
                    if self._agreed[view, row] >= DECIDED_ALONE:
                        tracker.confirm(number)
                        begin = int(self._right[view, row])
                        out.append(Decision('confirmed', name, frame, begin, (number,)))
                        self._agreed[view, row] = 0
            for row in np.flatnonzero(both):
                bad = exposure.standardised[row] > DISAGREE
                self._wrong[view, row] = self._wrong[view, row] + 1 if bad else 0
                if bad:
                    tracker.doubt(int(self.target_id[row]), frame)
        return out

    def _both_ways(
        self, view: int, exposure: _Exposure, rows: tuple[int, int], frame: int
    ) -> list[Decision]:
        """Weigh the epipolar distances of two markers of a view against those exchanged."""
        name = self.names[view]
        tracker = self.trackers[name]
        pair = list(rows)
        uv = exposure.corrected[:, pair].copy()
        sigma = exposure.sigma[:, pair].copy()
        uv[view] = uv[view, ::-1]
        sigma[view] = sigma[view, ::-1]
        other = self._intersector.intersect(uv, sigma).standardised
        keep = np.minimum(exposure.standardised[pair] ** 2, MAX_COST).sum()
        change = np.minimum(np.nan_to_num(other, nan=np.inf) ** 2, MAX_COST).sum()
        key = (view, *rows)
        if change < keep or key not in self._evidence:
            self._kept[key] = frame
        self._evidence[key] += float(change - keep)
        ids = (int(self.target_id[rows[0]]), int(self.target_id[rows[1]]))
        since = min(tracker.doubted_since(ids[0]) or frame, tracker.doubted_since(ids[1]) or frame)
        if abs(self._evidence[key]) < MAX_COST:
            return []
        exchanged = self._evidence.pop(key) < 0
        kept = self._kept.pop(key)
        out = []
        if exchanged:
            tracker.exchange(*ids)
            out.append(Decision('exchanged', name, frame, since, ids))
            kept = frame
        tracker.part(*ids)
        for number in ids:
            if tracker.doubted_since(number) is None:
                out.append(Decision('confirmed', name, frame, kept, (number,)))
        return out

    def _remember(
        self,
        exposure: _Exposure,
        expected_mm: np.ndarray,
        sure: np.ndarray,
        decisions: Sequence[Decision],
        frame: int,
    ) -> None:
        """Update places and velocities in space, and the shapes of the clusters."""
        touched = np.searchsorted(
            self.target_id, [i for decision in decisions for i in decision.target_id]
        ).astype(int)
        sure = sure.copy()
        sure[touched] = False
        for body in self._bodies:
            body.learn(exposure.xyz_mm[body.rows], sure[body.rows])
        now = np.where(np.isfinite(expected_mm), expected_mm, np.nan)
        now[sure] = exposure.xyz_mm[sure]
        frames = max(frame - self._frame, 1) if self._frame else 1
        velocity = (now - self._xyz) / frames
        fresh = np.isfinite(velocity).all(axis=1)
        share = np.where(self._moves > 0, FORGET_VELOCITY, 1.0)[:, None]
        self._velocity[fresh] += (share * (velocity - self._velocity))[fresh]
        self._moves[fresh] += 1
        # A marker without a place in this exposure moves on.
        unknown = ~np.isfinite(now).all(axis=1)
        self._age = np.where(unknown, self._age + frames, 0)
        now[unknown] = (self._xyz + frames * self._velocity)[unknown]
        self._xyz = now
        self._frame = frame


def _revised(
    found: MarkerFrame, name: str, decisions: Sequence[Decision], frame: int
) -> MarkerFrame:
    """Markers of an image after the decisions on its view."""
    for decision in decisions:
        if decision.fluoroscope == name and decision.since <= frame:
            found = revise(found, decision)
    return found


def revise(found: MarkerFrame, decision: Decision) -> MarkerFrame:
    """Return the markers of an image after a decision that holds for it."""
    ids = found.target_id.copy()
    doubtful = found.doubtful.copy()
    if decision.kind == 'exchanged':
        one, two = decision.target_id
        # The exposure in which they were exchanged is not known, so they stay doubtful.
        doubtful |= np.isin(found.target_id, decision.target_id)
        ids = np.where(
            found.target_id == one, two, np.where(found.target_id == two, one, found.target_id)
        )
        return replace(found, target_id=ids, doubtful=doubtful)
    row = found.target_id == decision.target_id[0]
    if decision.kind == 'confirmed':
        doubtful[row] = False
        return replace(found, doubtful=doubtful)
    keep = ~row
    missing = found.missing
    predicted = found.predicted
    lost = found.lost
    if row.any():
        missing = np.append(missing, decision.target_id[0])
        predicted = np.concatenate([predicted, found.uv[row]])
        lost = np.append(lost, True)
    return replace(
        found,
        target_id=ids[keep],
        uv=found.uv[keep],
        sigma=found.sigma[keep],
        overlapped=found.overlapped[keep],
        doubtful=doubtful[keep],
        missing=missing,
        predicted=predicted,
        lost=lost,
    )
