# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Match beads of an image with a phantom, without prior knowledge or from a nearby pose.

A pose is only accepted by evidence: most of the beads that it predicts are found, most of the
detections are predicted, and no other pose fits nearly as well, such as that of the phantom
turned by one of its symmetries.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from ..errors import DataError
from ..findings import Kind
from .growth import (
    LAST_TOLERANCE_PX,
    LIKELIER,
    SURVEY_SIGMAS,
    Coordinates,
    Match,
    Seen,
    grow,
    largest_sd,
    settle,
    spacing_of,
    start_view,
)
from .lattice import CENTRAL, STEPS, FlatGrid, GridPose, grid_poses
from .pose_search import (
    MERGED,
    MIN_EXPLAINED,
    MIN_FOUND,
    Triples,
    enough_seeds,
    local_poses,
    nearby_map,
    triples_of,
)
from .symmetries import Symmetry, symmetries_of
from .view import Lens, fit_view

MIN_BEADS = 10
# Shares found and explained from which a pose is accepted. If many beads overlap, fewer are
# found, but nothing else is detected: the second pair counts beads that are predicted apart from
# each other.
EVIDENT = ((MIN_FOUND, MIN_EXPLAINED), (0.6, 0.85))
# Shares found and explained from which the search ends.
SURE = ((0.85, MIN_EXPLAINED), (0.75, 0.95))
# Least evidence of a pose: a million poses are tried, and one image in a million may show another
# pose by chance.
MIN_EVIDENCE = float(2 * np.log(1e6))
NEIGHBOURS = (8, 6)  # of a bead in phantom and image, which form triples with it
# Levels of the search: range of beads tried, and limits of the scale relative to that from the
# extent of the detections. The first level finds most poses, the second those that see all faces
# of a phantom from the edge. The others find a phantom among other objects, and a small part of a
# phantom. Beads are tried until a right pose would have been found (pose_search.py).
LEVELS = (
    ((0, 8), (0.85, 1.4)),
    ((8, 80), (0.85, 1.4)),
    ((0, 24), (0.0, 0.85)),
    ((0, 6), (1.4, 3.0)),
)
FITTED = 12  # number of ways to fit a grid to detections; a hexagonal grid has so many symmetries
APART = 0.6  # share of the beads, those farthest from their neighbours, that are tried next
AGREED = 3  # matches of the same pose after which the search ends if the pose is evident
MIN_SIZES = 0.1  # relative difference of diameters from which sizes distinguish beads
SIZE_TAIL = 3.0  # residual from which a response is an outlier [standard deviations]
SIZE_NEIGHBOURS = 12  # neighbours from which the usual response is estimated
# Length of the mean direction to the neighbours of a bead from which it is at the border: on a
# straight border it is 2 / pi, and less than 0.2 two rows further inside.
AT_BORDER = 0.4
# Least and largest slope of log response over log radius r, and number of slopes that are tried. A
# disc has r^2 exp(-r^2 / 2 s^2) at a scale s, where r < 1.2 s; a small sphere has its thickness as
# an additional factor.
SIZE_SLOPES = (0.5, 3.0, 11)
CLOSER = 2.0  # ratio of the residuals of two poses that decides between them
SCALE_BY_SIZE = (0.55, 1.6)  # ratio of a bead's image to its diameter, with the blur


@dataclass(frozen=True)
class PhantomModel(Coordinates):
    """Beads of a phantom, prepared for matching."""

    diameter_mm: NDArray[np.float64] | None  #: (n,)
    grid: FlatGrid | None  #: for a flat grid
    #: any of several poses that fit equally well is accepted: a regular grid looks alike in all
    regular: bool = False

    @classmethod
    def of(
        cls,
        xyz: NDArray[np.float64],
        diameter_mm: NDArray[np.float64] | None = None,
        regular: bool = False,
        sd_mm: NDArray[np.float64] | None = None,
    ) -> PhantomModel:
        """Return the model of beads (n, 3) [mm] with diameters (n,) [mm], if known.

        sd_mm: (n,), standard deviations of the coordinates, 0 if not given. They are limited: no
        pose with larger residuals is accepted, because it does not distinguish neighbours. Raises
        DataError if a regular phantom is not a flat grid.
        """
        grid = FlatGrid.of(xyz)
        if regular and grid is None:
            raise DataError('the phantom is not a flat grid with rows and columns')
        given_mm = np.zeros(len(xyz)) if sd_mm is None else sd_mm
        sd_mm = np.minimum(given_mm, largest_sd(spacing_of(xyz)))
        return cls(xyz, sd_mm, diameter_mm, grid=grid, regular=regular)

    @property
    def sizes_differ(self) -> bool:
        """Whether the sizes of the beads distinguish them."""
        diameter = self.diameter_mm
        return diameter is not None and np.ptp(diameter) >= MIN_SIZES * diameter.min()

    @cached_property
    def spacing_mm(self) -> float:
        """Median distance of a bead from the nearest one."""
        return spacing_of(self.xyz)

    @cached_property
    def symmetries(self) -> tuple[Symmetry, ...]:
        """Motions that move many beads close to others, computed on first use."""
        return symmetries_of(self, self.triples)

    @cached_property
    def triples(self) -> Triples:
        """Triples of beads, computed on first use."""
        return triples_of(self.xyz, NEIGHBOURS[0])


def match(seen: Seen, model: PhantomModel, lens: Lens) -> Match:
    """Match detections of an image with a phantom.

    Raises DataError, with the reason, if no pose is certain.
    """
    if len(seen.uv) < MIN_BEADS:
        raise DataError(
            f'only {len(seen.uv)} beads are found in the image, at least {MIN_BEADS} are needed',
            kind=Kind.FEW_BEADS,
            numbers={'beads': len(seen.uv)},
        )
    best = _grid_match(model.grid, seen, model, lens) if model.grid is not None else None
    if best is not None:
        _check_evidence(best)
        return best
    agreed = 0
    for candidate in _candidates(seen, model, lens):
        candidate = _improved(candidate, seen, model)
        if len(candidate.bead) < MIN_BEADS:
            continue
        agreed += best is not None and _same(candidate, best)
        if best is None or candidate.score > best.score:
            agreed = agreed if best is not None and _same(candidate, best) else 1
            best = candidate
            if is_evident(best) and not is_sure(best):
                best, _ = _climbed(best, seen, model)
        if is_sure(best) or (agreed >= AGREED and is_evident(best)):
            break
    if best is None:
        raise DataError('no pose of the phantom fits the beads in the image', kind=Kind.NO_POSE)
    _check_evidence(best)
    best = unambiguous(best, seen, model)
    _check_evidence(best)
    _check_residuals(best, model)
    return best


def _grid_match(grid: FlatGrid, seen: Seen, model: PhantomModel, lens: Lens) -> Match | None:
    """Return the match of a flat grid, None if its beads cannot be numbered.

    Raises DataError if the grid fits elsewhere as well, unless any place is accepted.
    """
    best: tuple[GridPose, Match] | None = None
    fitted: list[Match] = []
    for number, pose in enumerate(grid_poses(grid, model, seen, lens)):
        # A right pose is among the first; others that fit as well may come later.
        if (len(fitted) if best else number) >= FITTED:
            break
        if best and model.regular:
            break
        if best and not _could_be(pose.against - best[0].against, pose.numbered, best[0].against):
            break
        match = pose.fit()
        if match is None:
            continue
        fitted.append(match)
        if is_evident(match) and (not best or match.scale_px * CLOSER < best[1].scale_px):
            best = pose, match
    if best is None:
        return None
    limit = CLOSER * best[1].scale_px
    rivals = [rival for rival in fitted if rival is not best[1] and rival.scale_px < limit]
    if not rivals:
        return best[1]
    by_size = _best_by_size([best[1], *rivals], seen, model)
    if by_size is None:
        raise _ambiguous(best[1], rivals[0])
    return by_size


def _could_be(more: float, beads: int, against: float) -> bool:
    """Return whether a pose is too likely for the best pose to be certain.

    The probability of a contradiction, that a bead is missing or that something else is detected,
    is estimated from the best pose, with one more than it shows.

    Parameters
    ----------
    more : float
        Number of contradictions to the pose beyond those to the best pose.
    beads : int
        Number of beads found with the best pose.
    against : float
        Number of contradictions to the best pose.
    """
    log_odds = np.log(max(beads / (against + 1), 1.0))
    return bool(more * log_odds < LIKELIER)


def _ambiguous(best: Match, other: Match) -> DataError:
    return DataError(
        'the pose is ambiguous: the phantom fits nearly as well in another one '
        f'({len(other.bead)} beads instead of {len(best.bead)}); mark it by beads '
        'that break its symmetry',
        kind=Kind.POSE_AMBIGUOUS,
        numbers={'beads': len(best.bead), 'beads_of_other': len(other.bead)},
    )


def is_sure(best: Match) -> bool:
    """Return whether no better match needs to be searched for."""
    return best.evidence >= MIN_EVIDENCE and _is_supported(best, SURE)


def _improved(one: Match, seen: Seen, model: PhantomModel) -> Match:
    """Refine a nearly evident match by further steps as long as they find more beads.

    If faces are seen from the edge, a pose extends to the far side of the phantom only gradually.
    """
    while not is_sure(one) and one.found >= EVIDENT[1][0] and one.explained >= MIN_EXPLAINED:
        refined = settle(one.view, model, seen)
        if refined is None or refined.score <= one.score:
            break
        one = refined
    return one


def is_evident(best: Match) -> bool:
    """Return whether enough predicted beads are found, and enough detections are predicted."""
    return best.evidence >= MIN_EVIDENCE and _is_supported(best, EVIDENT)


def _is_supported(best: Match, shares: Sequence[tuple[float, float]]) -> bool:
    """Return whether a match has the shares found and explained of one of two pairs."""
    pairs = zip((best.found, best.apart), shares)
    return any(own >= found and best.explained >= explained for own, (found, explained) in pairs)


def _check_evidence(best: Match) -> None:
    """Raise DataError if too few predicted beads are found or too few detections are predicted."""
    if is_evident(best) and len(best.bead) >= MIN_BEADS:
        return
    cause = f'explains only {best.explained:.0%} of the beads in its outline'
    if _is_supported(best, EVIDENT) and len(best.bead) >= MIN_BEADS:
        cause = 'may fit by chance'
    elif best.explained >= MIN_EXPLAINED or len(best.bead) < MIN_BEADS:
        cause = (
            f'predicts {best.expected} beads in the image, of which only {best.found:.0%} are '
            'found'
        )
    raise DataError(
        f'the best pose of the phantom {cause}',
        kind=Kind.POSE_UNSURE,
        numbers={
            'expected': best.expected,
            'found': best.found,
            'explained': best.explained,
            'evidence': best.evidence,
        },
    )


def _check_residuals(best: Match, model: PhantomModel) -> None:
    """Raise DataError if the residuals of a pose do not distinguish neighbouring beads."""
    depth_mm = float(np.median(best.view.depth(model.xyz[best.bead])))
    residual_mm = best.scale_px * depth_mm / best.view.principal_distance_px
    if residual_mm > largest_sd(model.spacing_mm):
        raise DataError(
            f'the best pose of the phantom leaves residuals of {residual_mm:.2f} mm, too large to '
            f'distinguish beads {model.spacing_mm:.1f} mm apart',
            kind=Kind.POSE_UNSURE,
            numbers={'residual_mm': residual_mm, 'spacing_mm': model.spacing_mm},
        )


def unambiguous(best: Match, seen: Seen, model: PhantomModel, turn_rad: float = np.pi) -> Match:
    """Return the best of a match and its transforms by the symmetries of the phantom.

    Symmetries that turn it by more than turn_rad are ignored. Raises DataError if another match
    fits nearly as well, unless the phantom is regular.
    """
    if model.regular:
        return best
    climbed, rivals = _climbed(best, seen, model, turn_rad)
    equal = [
        rival
        for rival in rivals
        if _could_be(climbed.score - rival.score, len(climbed.bead), climbed.against)
        and not _same(rival, climbed)
    ]
    closest = min([climbed, *equal], key=lambda candidate: candidate.scale_px)
    if all(
        candidate is closest or candidate.scale_px > CLOSER * closest.scale_px
        for candidate in [climbed, *equal]
    ):
        return closest
    by_size = _best_by_size([climbed, *equal], seen, model)
    if by_size is None:
        raise _ambiguous(climbed, equal[0])
    return by_size


def _best_by_size(matches: list[Match], seen: Seen, model: PhantomModel) -> Match | None:
    """Return the match in which responses agree best with bead sizes; None if none stands out.

    Matches are compared by the likelihood of the responses to the beads that all of them contain.
    """
    diameter = model.diameter_mm
    if seen.strength is None or diameter is None or not model.sizes_differ:
        return None
    common = set.intersection(*(set(candidate.detection.tolist()) for candidate in matches))
    if len(common) < MIN_BEADS:
        return None
    rows = [np.flatnonzero(np.isin(candidate.detection, list(common))) for candidate in matches]
    likelihoods = [
        _likelihood_of_sizes(
            np.log(
                diameter[candidate.bead] / np.abs(candidate.view.depth(model.xyz[candidate.bead]))
            )[row],
            np.log(np.maximum(seen.strength[candidate.detection], 1e-3))[row],
            seen.uv[candidate.detection][row],
        )
        for candidate, row in zip(matches, rows)
    ]
    order = np.argsort(likelihoods)
    if likelihoods[order[-1]] - likelihoods[order[-2]] < LIKELIER:
        return None
    return matches[order[-1]]


def _likelihood_of_sizes(
    size: NDArray[np.float64], response: NDArray[np.float64], uv: NDArray[np.float64]
) -> float:
    """Return the log-likelihood of log responses (n,) to shadows of log sizes (n,) at uv (n, 2).

    A response is linear in the size, with the likeliest slope, and changes slowly across the
    image, as it does with perspective. Responses of beads that overlap or lie before an edge are
    outliers, with any residual up to the largest. The probability of an outlier is that among the
    beads around, one of which stands for the whole image.
    """
    near = _neighbours(uv)
    size = size - np.median(size[near], axis=1)  # without the perspective
    level = response - np.linspace(*SIZE_SLOPES)[:, None] * size  # (slopes, n)
    local_level = np.median(level[:, near], axis=2)
    scatter = 1.4826 * np.median(np.abs(level[:, near] - local_level[:, :, None]), axis=2)
    scatter = np.maximum(np.maximum(scatter, np.median(scatter, axis=1)[:, None]), 1e-6)
    residual = np.abs(level - local_level) / scatter
    outlier = residual > SIZE_TAIL
    usual = (np.count_nonzero(outlier, axis=1) + 1) / (len(uv) + 1)
    share = (np.sum(outlier[:, near[:, 1:]], axis=2) + usual[:, None]) / near.shape[1]
    normal = np.exp(-0.5 * residual**2) / np.sqrt(2 * np.pi)
    uniform = 0.5 / np.maximum(residual.max(axis=1), SIZE_TAIL)[:, None]
    density = ((1 - share) * normal + share * uniform) / scatter
    return float(np.sum(np.log(density), axis=1).max())


def _neighbours(uv: NDArray[np.float64]) -> NDArray[np.int64]:
    """Return rows (n, k) of each bead (n, 2) and the nearest ones in a similar place.

    At the border of the phantom, as at that of a sheet, responses differ from those inside.
    """
    count = min(SIZE_NEIGHBOURS + 1, len(uv))
    _, near = cKDTree(uv).query(uv, k=count)
    offset = uv[near[:, 1:]] - uv[:, None]
    direction = offset / np.maximum(np.linalg.norm(offset, axis=2, keepdims=True), 1e-9)
    at_border = np.linalg.norm(direction.mean(axis=1), axis=1) > AT_BORDER
    for similar in (at_border, ~at_border):
        rows = np.flatnonzero(similar)
        if len(rows) >= count:
            near[rows] = rows[cKDTree(uv[rows]).query(uv[rows], k=count)[1]]
    return near


def _climbed(
    best: Match, seen: Seen, model: PhantomModel, turn_rad: float = np.pi
) -> tuple[Match, list[Match]]:
    """Return the best match that symmetries of the phantom lead to, and its alternatives.

    On a nearly regular phantom the search finds poses that are several pattern steps off.
    """
    symmetries = [symmetry for symmetry in model.symmetries if symmetry.turn_rad <= turn_rad]
    while True:
        rivals = list(_alternatives(best, seen, model, symmetries))
        better = max(rivals, key=lambda rival: rival.score, default=best)
        if better.score <= best.score:
            return best, rivals
        best = better


def _alternatives(
    best: Match, seen: Seen, model: PhantomModel, symmetries: Sequence[Symmetry]
) -> Iterator[Match]:
    """Yield the matches of the phantom moved by its symmetries, if they fit at all."""
    for symmetry in symmetries:
        moved_bead = symmetry.row[best.bead]
        known = moved_bead >= 0
        # Beads that are moved to where the phantom has none contradict the other pose. It may
        # explain what contradicts this one.
        more = np.count_nonzero(~known) - best.against
        is_likely = _could_be(more, len(best.bead), best.against)
        if np.count_nonzero(known) < MIN_BEADS or not is_likely:
            continue
        view, scale = fit_view(
            symmetry.turned(best.view),
            model.xyz[moved_bead[known]],
            seen.uv[best.detection[known]],
            STEPS,
            0.3,
        )
        # The final matching uses the same tolerance.
        reach_px = float(np.median(model.reach_px(view, LAST_TOLERANCE_PX)))
        rival = settle(view, model, seen) if scale <= reach_px else None
        if rival is not None:
            yield rival


def _same(one: Match, other: Match) -> bool:
    """Return whether most beads of the image are matched with the same beads of the phantom."""
    a = dict(zip(one.detection.tolist(), one.bead.tolist()))
    b = dict(zip(other.detection.tolist(), other.bead.tolist()))
    shared = sum(a.get(detection) == bead for detection, bead in b.items())
    return shared > 0.5 * min(len(a), len(b))


def _candidates(seen: Seen, model: PhantomModel, lens: Lens) -> Iterator[Match]:
    """Yield matches of poses, likeliest first."""
    beads = beads_map(seen, model, _scale_by_extent(seen, model))
    order = seeds_of(seen)
    max_seeds = len(order)
    for (first, last), limits in LEVELS:
        scales = _scales(seen, model, limits)
        if first == CENTRAL:
            radius_mm = seen.radius_px / _scale_by_extent(seen, model)
            max_seeds = enough_seeds(model.xyz, len(seen.uv), radius_mm, NEIGHBOURS)
        for seed in order[first : min(last, max_seeds)]:
            for pose in local_poses(
                seed, seen.uv, NEIGHBOURS[1], model.triples, beads, scales=scales
            ):
                view = start_view(pose, lens, model.xyz)
                candidate = grow(view, pose.bead, model, seen)
                if candidate is not None:
                    yield candidate


def beads_map(seen: Seen, model: PhantomModel, scale: float) -> NDArray[np.uint8]:
    """Return a map (h, w): 1 near a detection, 2 outside the field, else 0; scale in px/mm."""
    displaced_px = SURVEY_SIGMAS * scale * float(np.median(model.sd_mm))
    height, width = seen.field.shape
    beads = nearby_map(seen.uv, (width, height), float(np.hypot(seen.tolerance_px, displaced_px)))
    beads[~seen.field] = 2
    return beads


def seeds_of(seen: Seen) -> NDArray[np.int64]:
    """Return rows of beads to start from: first some in the middle, then isolated ones, at random.

    Distortion is least in the middle. If faces are seen from the edge, neighbours in the image are
    beads of several faces, but less so for isolated beads.
    """
    n = len(seen.uv)
    rng = np.random.default_rng(0)
    centre = np.median(seen.uv, axis=0)
    distance = np.linalg.norm(seen.uv - centre, axis=1)
    middle = np.argsort(distance, kind='stable')[: max(60, n // 2)]
    first = np.concatenate([middle[:1], rng.permutation(middle[1:])])[:CENTRAL]
    spacing = seen.tree.query(seen.uv, k=[min(4, n)])[0][:, 0]
    order = np.argsort(-spacing, kind='stable')
    isolated = rng.permutation(order[: int(np.ceil(APART * n))])
    crowded = order[int(np.ceil(APART * n)) :]
    later = np.concatenate([isolated, crowded])
    return np.concatenate([first, later[~np.isin(later, first)]])


def _scales(seen: Seen, model: PhantomModel, limits: tuple[float, float]) -> tuple[float, float]:
    """Return least and largest scale [px/mm]; limits: factors on the scale by extent."""
    low, high = (_scale_by_extent(seen, model) * factor for factor in limits)
    low = max(low, MERGED * seen.radius_px / model.spacing_mm)
    if model.diameter_mm is None:
        return low, high
    by_size = 2 * seen.radius_px / float(np.median(model.diameter_mm))
    return max(low, by_size * SCALE_BY_SIZE[0]), min(high, by_size * SCALE_BY_SIZE[1])


def _scale_by_extent(seen: Seen, model: PhantomModel) -> float:
    """Return the scale [px/mm] at which the phantom is as large as the detections."""
    spread = np.sqrt(np.mean(np.sum((seen.uv - np.median(seen.uv, axis=0)) ** 2, axis=1)))
    extent = np.sqrt(np.mean(np.sum((model.xyz - model.xyz.mean(axis=0)) ** 2, axis=1)))
    return float(spread / (np.sqrt(2 / 3) * extent))
