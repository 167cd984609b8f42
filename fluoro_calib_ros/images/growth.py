# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Grow a pose from a few beads to all beads of an image, and evaluate its evidence."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.special import rel_entr

from .pose_search import LocalPose
from .view import TAIL, Lens, View, fit_view

START_BEADS = 14  # beads within the initial radius
GROWTH = 1.25  # factor on the radius in each step
MIN_SHARE = 0.5  # least share of expected beads; a pose with less is discarded
DEGREE = 5
LAST_DEGREE = 6
LAST_STEPS = 4
LAST_TOLERANCE_PX = 2.5
CELLS = 5  # regions along each side of the image
MIN_CELL = 5  # least number of predicted beads in a region that is evaluated
AMBIGUOUS_PX = 1.5  # least difference of a detection's distances from the two nearest predictions
# Least evidence of a pose for each radius while it grows: chance finds so many beads in one of ten
# places.
GROWN_EVIDENCE = float(np.log(10))
SURVEY_SIGMAS = 3.0  # largest displacement of a bead from its coordinates [standard deviations]
# Least lead in log-likelihood of a pose, or of the id of a bead, over any other: one in ten
# thousand may be mistaken.
LIKELIER = float(np.log(1e4))
SUPPORT = 12  # neighbours in space, of which MIN_SHARE must be found as well
# Correlation length of the residuals of a view, as a share of half the image: a polynomial of
# degree 6 has five extrema across it.
LENGTH = 0.5


@dataclass(frozen=True)
class Seen:
    """Detections in an image."""

    uv: NDArray[np.float64]  #: (n, 2), beads [px]
    tree: cKDTree  #: of uv
    field: NDArray[np.bool_]  #: (h, w), the field of view
    radius_px: float  #: radius of a bead: two beads closer than this may be detected as one
    #: largest distance from a prediction at which a bead is matched while the pose grows
    tolerance_px: float
    #: (n,), response to each bead, which increases with its size
    strength: NDArray[np.float64] | None = None

    @classmethod
    def of(
        cls,
        uv: NDArray[np.float64],
        field: np.ndarray,
        radius_px: float,
        strength: NDArray[np.float64] | None = None,
    ) -> Seen:
        """Return the detections, with a tolerance derived from the distances between beads."""
        tree = cKDTree(uv)
        distance = tree.query(uv, k=[min(4, len(uv))])[0][:, 0]
        tolerance = float(np.clip(0.2 * np.median(distance), 2.5, 6))
        return cls(
            uv, tree, field=field, radius_px=radius_px, tolerance_px=tolerance, strength=strength
        )

    def in_field(self, uv: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Return (n,) whether pixels (n, 2) lie in the field, False for NaN."""
        height, width = self.field.shape
        places = np.rint(np.where(np.isfinite(uv), uv, -1)).astype(int)
        inside = np.asarray(((places >= 0) & (places < (width, height))).all(axis=1))
        inside[inside] = self.field[places[inside, 1], places[inside, 0]]
        return inside


@dataclass(frozen=True)
class Coordinates:
    """Coordinates of the beads of a phantom."""

    xyz: NDArray[np.float64]  #: (n, 3) [mm]
    sd_mm: NDArray[np.float64]  #: (n,), their standard deviations

    def sd_px(self, view: View) -> NDArray[np.float64]:
        """Return standard deviations (n,) of predicted pixels by errors of the coordinates."""
        return np.asarray(view.principal_distance_px * self.sd_mm / np.abs(view.depth(self.xyz)))

    def reach_px(self, view: View, tolerance_px: float) -> NDArray[np.float64]:
        """Return distances (n,) from predictions that a tolerance and these errors allow."""
        return np.hypot(tolerance_px, SURVEY_SIGMAS * self.sd_px(view))


def spacing_of(xyz: NDArray[np.float64]) -> float:
    """Return the median distance of beads (n, 3) from the nearest one."""
    return float(np.median(cKDTree(xyz).query(xyz, k=[2])[0]))


def largest_sd(spacing_mm: float) -> float:
    """Return the standard deviation of coordinates that distinguishes neighbouring beads [mm].

    Two neighbours, displaced from each other by as much as is accepted, are half a spacing off.
    """
    return float(spacing_mm / (2 * np.sqrt(2) * SURVEY_SIGMAS))


@dataclass(frozen=True)
class Match:
    """A pose with its matched beads and the evidence for it."""

    view: View
    #: (n,), matched rows of the phantom and of the image
    bead: NDArray[np.int64]
    detection: NDArray[np.int64]
    #: (m, 2), predicted pixels of all beads of the phantom, with interpolated residuals
    predicted: NDArray[np.float64]
    found: float  #: share of the beads predicted in the field that are found
    apart: float  #: the same share of those predicted apart from each other
    #: share of the detections within the outline of the predicted beads that are predicted
    explained: float
    scale_px: float  #: robust standard deviation of the residuals
    expected: int  #: number of beads predicted in the field
    #: number of predicted beads that are not found, and of detections among them that are not
    #: predicted
    against: int
    #: logarithm of the likelihood of the beads that are found, over that for detections anywhere
    evidence: float

    @property
    def score(self) -> float:
        """Number of matched beads minus that of predicted beads that are not found."""
        return len(self.bead) - self.expected * (1 - self.found)


def start_view(pose: LocalPose, lens: Lens, xyz: NDArray[np.float64]) -> View:
    """Return the perspective view of a scaled-orthographic pose around a bead."""
    c = lens.principal_distance_px
    ray = np.append((pose.uv - lens.centre) / c, 1.0)
    rotation = _turn_to(ray) @ pose.rotation
    # The scale applies perpendicular to the ray, at the length of the ray.
    sensor = ray * (c / pose.scale)
    return View(
        lens,
        rotation,
        position=xyz[pose.bead] - rotation.T @ sensor,
        principal_distance_px=c,
        coefficients=lens.expected(DEGREE),
        degree=DEGREE,
    )


def _turn_to(ray: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the smallest rotation (3, 3) that takes the z axis to a direction (3,)."""
    z = ray / np.linalg.norm(ray)
    axis = np.array([-z[1], z[0], 0.0])
    k = np.array([[0, 0, axis[1]], [0, 0, -axis[0]], [-axis[1], axis[0], 0]])
    return np.eye(3) + k + k @ k / (1 + z[2])


def grow(view: View, start: int, phantom: Coordinates, seen: Seen) -> Match | None:
    """Grow a view from one bead over the phantom; return None if it does not fit.

    The radius around the bead grows in space, not in the image: beads behind it are predicted
    last, when the pose is known better. Beads found near their predictions are matched. start is
    the row of the bead.
    """
    xyz = phantom.xyz
    distance = np.linalg.norm(xyz - xyz[start], axis=1)
    radius = float(np.partition(distance, min(START_BEADS, len(xyz) - 1))[:START_BEADS].max())
    farthest = float(distance.max())
    while True:
        for _ in range(2):
            row = np.flatnonzero(distance <= radius)
            predicted = view.project(xyz[row])
            inside = seen.in_field(predicted)
            row = row[inside]
            if len(row) < 4:
                return None
            reach = phantom.reach_px(view, seen.tolerance_px)[row]
            bead, detection = pairs(predicted[inside], seen, reach)
            if len(bead) < max(4, MIN_SHARE * len(row)):
                return None
            by_chance = _by_chance(reach, *_outlined(seen.uv, predicted[inside], seen.field.shape))
            found = np.isin(np.arange(len(row)), bead)
            if _evidence(found, by_chance) < GROWN_EVIDENCE:
                return None
            view, _ = fit_view(view, xyz[row[bead]], seen.uv[detection], 1, 0.3)
        if radius >= farthest:
            break
        radius *= GROWTH
    return settle(view, phantom, seen)


def settle(view: View, phantom: Coordinates, seen: Seen) -> Match | None:
    """Match all beads with a view that is nearly right, and refine it."""
    xyz = phantom.xyz
    view = view.with_degree(max(view.degree, LAST_DEGREE))
    tolerance = seen.tolerance_px
    scale = 0.0
    bead = detection = np.zeros(0, dtype=int)
    residual = np.zeros_like(xyz[:, :2])
    for step in range(LAST_STEPS):
        before = bead, detection
        predicted = view.project(xyz) + residual
        row = np.flatnonzero(seen.in_field(predicted))
        if len(row) < 4:
            return None
        reach = phantom.reach_px(view, tolerance)[row]
        bead, detection = pairs(predicted[row], seen, reach)
        if len(bead) < 4:
            return None
        bead = row[bead]
        if len(bead) < MIN_SHARE * len(row) and step:
            return None
        # If the matches do not change, take the remaining steps at once.
        is_last = all(map(np.array_equal, before, (bead, detection)))
        steps = 2 * (LAST_STEPS - step) if is_last else 2
        view, scale = fit_view(view, xyz[bead], seen.uv[detection], steps)
        residual = nearby_residuals(view, xyz, bead, seen.uv[detection]).value
        if is_last:
            break
        tolerance = max(0.6 * tolerance, min(LAST_TOLERANCE_PX, seen.tolerance_px))
    predicted = view.project(xyz) + residual
    return _judged(view, phantom, seen, predicted, scale)


def pairs(
    predicted: NDArray[np.float64], seen: Seen, reach: NDArray[np.float64]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the rows of predictions (n, 2) and detections that are nearest to each other.

    reach: (n,) largest distances [px].
    """
    distance, detection = seen.tree.query(predicted, distance_upper_bound=float(reach.max()))
    row = np.flatnonzero(distance < reach)
    order = row[np.argsort(distance[row], kind='stable')]
    _, first = np.unique(detection[order], return_index=True)
    matched = np.sort(order[first])
    return matched, detection[matched]


def nearby_residuals(
    view: View, xyz: NDArray[np.float64], bead: NDArray[np.int64], uv: NDArray[np.float64]
) -> Interpolation:
    """Interpolate the residuals of all beads of a view from their matched neighbours in the image.

    xyz (n, 3) are all beads, bead (m,) the matched rows with pixels uv (m, 2).
    """
    place = view.project(xyz)
    return interpolated(place, bead, uv - place[bead], LENGTH * view.lens.half_px)


def _judged(
    view: View, phantom: Coordinates, seen: Seen, predicted: NDArray[np.float64], scale: float
) -> Match | None:
    """Return the match of settled predictions (n, 2), without regions that have diverged."""
    row = np.flatnonzero(seen.in_field(predicted))
    if len(row) < 4:
        return None
    reach = phantom.reach_px(view, min(LAST_TOLERANCE_PX, seen.tolerance_px))[row]
    bead, detection = pairs(predicted[row], seen, reach)
    is_found = np.zeros(len(row), dtype=bool)
    is_found[bead] = True
    # Two beads that overlap are detected as one, somewhere between them.
    detection_distance, _ = seen.tree.query(
        predicted[row], distance_upper_bound=1.2 * seen.radius_px
    )
    spacing = cKDTree(predicted[row]).query(predicted[row], k=[2])[0][:, 0]
    is_found |= np.isfinite(detection_distance) & (spacing < 2 * seen.radius_px)
    tree = cKDTree(predicted[row])
    prediction_distance, nearest = tree.query(seen.uv)
    within, area = _outlined(seen.uv, predicted[row], seen.field.shape)
    near = np.maximum(reach, 1.2 * seen.radius_px)[nearest]
    is_explained = (prediction_distance < near)[within]
    by_chance = _by_chance(reach, within, area)
    found_apart = is_found[spacing >= 2 * seen.radius_px]
    good = _good_cells(predicted[row], is_found, seen.field.shape)
    # A detection between two predictions may belong to either.
    distance, _ = tree.query(seen.uv[detection], k=2)
    is_unique = distance[:, 1] > distance[:, 0] + AMBIGUOUS_PX
    is_unique &= is_likelier(distance.T, phantom.sd_px(view)[row][bead])
    matched = np.zeros(len(row), dtype=bool)
    matched[bead[is_unique]] = True
    good &= supported(phantom.xyz[row], matched)
    accepted = good[bead] & is_unique
    return Match(
        view,
        row[bead[accepted]],
        detection=detection[accepted],
        predicted=predicted,
        found=float(np.mean(is_found)),
        apart=float(found_apart.sum() / max(len(found_apart), 1)),
        explained=float(is_explained.sum() / max(within.sum(), 1)),
        scale_px=scale,
        expected=len(row),
        against=int(np.sum(~is_found) + np.sum(~is_explained)),
        evidence=_evidence(found_apart, by_chance),
    )


def is_likelier(
    distance: Sequence[NDArray[np.float64]], sd_px: NDArray[np.float64]
) -> NDArray[np.bool_]:
    """Return (n,) whether pixels are much likelier at their predictions than at the next ones.

    distance: (2, n) from both predictions; sd_px: (n,), standard deviations of the predictions.
    """
    first, second = distance
    return np.asarray(second**2 - first**2 > 2 * LIKELIER * sd_px**2)


def _by_chance(reach: NDArray[np.float64], within: NDArray[np.bool_], area: int) -> float:
    """Return the probability that a detection is within reach of a place.

    within: which detections are within some area [px^2]; they are assumed to be anywhere in it.
    """
    return -float(np.expm1(-np.pi * np.mean(reach**2) * within.sum() / max(area, 1)))


def _evidence(is_found: NDArray[np.bool_], by_chance: float) -> float:
    """Return the log-likelihood ratio of predictions (n,) that are found, or are by chance.

    by_chance: probability that something is detected next to any place.
    """
    share = float(np.mean(is_found)) if len(is_found) else 0.0
    if share <= by_chance:
        return 0.0
    gain = rel_entr([share, 1 - share], [by_chance, 1 - by_chance])
    return len(is_found) * float(np.sum(gain))


def _outlined(
    uv: NDArray[np.float64], predicted: NDArray[np.float64], shape: tuple[int, ...]
) -> tuple[NDArray[np.bool_], int]:
    """Return which pixels (n, 2) are within the outline of predictions (m, 2), and its area.

    shape: that of the image. Labels, cables and screws beside the phantom are no evidence against
    a pose.
    """
    outline = cv2.convexHull(np.rint(predicted).astype(np.int32))
    inside = cv2.fillConvexPoly(np.zeros(shape, dtype=np.uint8), outline, 1)
    column, row = np.rint(uv).astype(int).T
    return inside[row, column].astype(bool), int(np.count_nonzero(inside))


def supported(xyz: NDArray[np.float64], good: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return (n,) whether most neighbours in space of beads (n, 3) are good (n,).

    If a face is seen from its edge, a prediction that is off by one bead still finds a detection
    now and then.
    """
    count = min(SUPPORT + 1, len(xyz))
    _, near = cKDTree(xyz).query(xyz, k=count)
    near = near.reshape(len(xyz), -1)
    is_other = near != np.arange(len(xyz))[:, None]
    share = np.sum(good[near] & is_other, axis=1) / np.maximum(is_other.sum(axis=1), 1)
    return np.asarray(share >= MIN_SHARE)


def _good_cells(
    uv: NDArray[np.float64], detected: NDArray[np.bool_], shape: tuple[int, ...]
) -> NDArray[np.bool_]:
    """Return (n,) whether most predicted beads (n, 2) of the same region are found."""
    height, width = shape
    cell = (np.clip(uv / (width, height), 0, 0.999) * CELLS).astype(int)
    number = cell[:, 0] * CELLS + cell[:, 1]
    total = np.bincount(number, minlength=CELLS * CELLS)
    hits = np.bincount(number, weights=detected, minlength=CELLS * CELLS)
    bad_cell = (total >= MIN_CELL) & (hits < 0.6 * total)
    return ~bad_cell[number]


# Interpolation of the residuals of matched beads over an image.
#
# Simple kriging with the nearest neighbours and Matern's covariance of order 3/2 (Stein,
# "Interpolation of Spatial Data", 1999): the residual distortion after the polynomial of a view is
# smooth, and errors of centres and survey add noise. The share of the noise, and the size of both,
# are estimated from how well matched beads predict each other.

NEIGHBOURS = 8  # number of neighbours; they screen a bead from those farther away
NOISE_SHARES = (0.001, 0.01, 0.1, 1.0)  # variance of the noise over that of the smooth part
SAMPLE = 100  # beads from which the share is estimated
ROUNDS = 2  # iterations of the weights: the first also spoils those of an outlier's neighbours
FAR = 1e9  # place of beads without a pixel, far from all others [px]


@dataclass(frozen=True)
class Interpolation:
    """Residuals of all beads, interpolated from matched neighbours in the image."""

    value: NDArray[np.float64]  #: (n, 2) [px]
    sd_px: NDArray[np.float64]  #: (n,), standard deviation of an observed coordinate from it


def interpolated(
    place: NDArray[np.float64],
    bead: NDArray[np.int64],
    residual: NDArray[np.float64],
    length_px: float,
) -> Interpolation:
    """Interpolate residuals (m, 2) of the matched rows bead (m,) of pixels place (n, 2).

    A bead does not contribute to its own value, and an outlier has less weight for others.
    length_px: distance at which the covariance of the smooth part has fallen to a half.
    """
    kriging = _Kriging.of(np.where(np.isfinite(place), place, FAR) / length_px, bead)
    matched = kriging.chosen(bead)
    sample = np.arange(0, len(bead), max(1, len(bead) // SAMPLE))
    share = _noise_share(matched.chosen(sample), residual, sample)
    noise = np.full(len(bead), share)
    for _ in range(ROUNDS):
        value, variance = matched.at(residual, noise)
        squared = np.sum((residual - value) ** 2, axis=1) / variance
        noise = share * (1 + squared / (TAIL**2 * _scale(squared)))
    value, variance = kriging.at(residual, noise)
    squared = np.sum((residual - value[bead]) ** 2, axis=1) / variance[bead]
    return Interpolation(value, np.sqrt(_scale(squared) * variance))


def _noise_share(
    kriging: _Kriging, residual: NDArray[np.float64], sample: NDArray[np.int64]
) -> float:
    """Return the share of the noise with which a sample of matched beads is predicted best."""

    def lack(share: float) -> float:
        value, _ = kriging.at(residual, np.full(len(residual), share))
        return float(np.median(np.sum((residual[sample] - value) ** 2, axis=1)))

    return min(NOISE_SHARES, key=lack)


def _scale(squared: NDArray[np.float64]) -> float:
    """Return the variance factor of squared lengths (m,) of residuals, normal in u and v."""
    return max(float(np.median(squared)) / (2 * np.log(2)), np.finfo(float).tiny)


@dataclass(frozen=True)
class _Kriging:
    """Kriging system of places with their nearest matched neighbours."""

    near: NDArray[np.int64]  #: (n, k), rows of the neighbours among the matched beads
    covariance: NDArray[np.float64]  #: (n, k, k), covariance of the smooth part between neighbours
    known: NDArray[np.float64]  #: (n, k), covariance of a place with its neighbours, 0 for its own

    @classmethod
    def of(cls, place: NDArray[np.float64], bead: NDArray[np.int64]) -> _Kriging:
        """Return the system of places (n, 2) in units of the length of the covariance."""
        count = min(NEIGHBOURS + 1, len(bead))
        _, near = cKDTree(place[bead]).query(place, k=list(range(1, count + 1)))
        is_other = bead[near] != np.arange(len(place))[:, None]
        neighbour = place[bead[near]]
        known = _matern(neighbour - place[:, None]) * is_other
        covariance = _matern(neighbour[:, :, None] - neighbour[:, None])
        # A bead's own residual is uncorrelated with all others, so that it gets no weight.
        covariance *= is_other[:, :, None] & is_other[:, None] | np.eye(count, dtype=bool)
        return cls(near, covariance, known)

    def chosen(self, rows: NDArray[np.int64]) -> _Kriging:
        """Return the kriging system restricted to some places."""
        return _Kriging(self.near[rows], self.covariance[rows], self.known[rows])

    def at(
        self, residual: NDArray[np.float64], noise: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return values (n, 2), and their variances (n,) in units of that of the smooth part.

        noise: (m,) variances of the residuals (m, 2). Variances include an observation's noise.
        """
        covariance = self.covariance.copy()
        diagonal = np.arange(covariance.shape[1])
        covariance[:, diagonal, diagonal] += noise[self.near]
        weight = np.linalg.solve(covariance, self.known[..., None])[..., 0]
        value = np.einsum('kn,knc->kc', weight, residual[self.near])
        return value, 1 + noise.min() - np.sum(weight * self.known, axis=1)


def _matern(shift: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return Matern's covariance of order 3/2 at shifts (..., 2) in units of its length."""
    x, y = shift[..., 0], shift[..., 1]
    distance = np.sqrt(3 * (x * x + y * y))
    return np.asarray((1 + distance) * np.exp(-distance))
