# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0
"""Refinements of a collocation, proposed where a solution shows that its terms do not suffice.

A refinement of the terms proposes a `Change` of functions, prior and terms of exposures for some
fluoroscopes; the network is then adjusted again. `collocation` defines their order.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from ..correction.terms import CUBIC, QUINTIC
from ..photogrammetry.adjustment import Adjustment
from .estimator import GaugeKind, coefficients_of
from .exposure_terms import (
    TERMS,
    ExposureTerms,
    can_be_fitted,
    exposure_functions,
    variation,
)
from .fluoroscope_terms import FluoroscopeTerms
from .lack_of_fit import LARGEST_SD, FittedPoints, areas_of_rejected
from .priors import Prior, SeriesEquations, prior_precision, with_shown_places
from .ripples import Ripples, shown_ripples

START_MODES = 16  # initial number of half waves along the image
MIN_MODES = 10  # least number of half waves
# Half waves that resolve the bumps of a place with larger signal variance. A search from rejected
# image points that agree starts with as many, because more places may follow.
LOCAL_MODES = 24
# Highest band of a smooth field, where a few other bands follow ripples.
GAP_FROM = 12
MAX_MODES = 30  # limits the time, which grows with the sixth power
# Prior variance times information of a sine below which the image points say nothing about it.
NEGLIGIBLE = 0.2
# A smaller number of modes must be below this part of the present one: nearly half the functions.
FEWER_MODES = 0.75
MODE_CHANGES = 3  # most changes, so that numbers do not alternate for ever
# The same statistic as `exposure_terms.VARYING`, for terms beyond cubic ones: their estimates then
# contain more change than noise. Independent residuals have at most 1.
MORE_THAN_NOISE = 2.0
MAX_VARYING_EXPOSURES = 60  # exposures of a fluoroscope with terms of their own; limits the time


@dataclass(frozen=True)
class Solution:
    """A solution of the adjustment, with updated priors."""

    parts: Sequence[FluoroscopeTerms]
    adjustment: Adjustment
    equations: Sequence[SeriesEquations]  #: by fluoroscope, linearised at the solution
    is_steady: bool  #: whether the update changed no prior visibly


@dataclass(frozen=True)
class Change:
    """Terms of a fluoroscope with which to adjust the network again; None: the present ones."""

    modes: int  #: number of modes up to which it gets all sines
    prior: Prior | None = None
    own: ExposureTerms | None = None  #: terms of exposures, if its distortion varies
    coefficients: NDArray[np.float64] | None = None  #: (p,) of the series


Changes = Mapping[int, Change]  # by number of the fluoroscope


class Refinement(Protocol):
    """A refinement of the terms."""

    def propose(self, solution: Solution) -> Changes:
        """Return the changes that a solution requires."""


class NumberOfSines:
    """Choose as many sines as the image points determine with the present priors.

    changes: how often the number has changed before.
    """

    def __init__(self, changes: int = 0) -> None:
        self._changes = changes
        self._varying = False

    def propose(self, solution: Solution) -> Changes:
        """See `Refinement`."""
        varying = any(part.own is not None for part in solution.parts)
        if varying and not self._varying:  # a variation may have been mistaken for a short signal
            self._changes = 0
        self._varying = varying
        wanted = {
            part.number: Change(self._wanted(part, equations.information))
            for part, equations in zip(solution.parts, solution.equations)
        }
        is_same = all(
            part.functions.complete == wanted[part.number].modes for part in solution.parts
        )
        if is_same or self._changes >= MODE_CHANGES:
            return {}
        self._changes += 1
        return wanted

    def _wanted(self, part: FluoroscopeTerms, information: NDArray[np.float64]) -> int:
        """Return the number of modes with which image points can determine the signal.

        information: (2m, 2m) of its coefficients without prior.
        """
        functions = part.functions
        if not functions.modes:
            return 0
        level = float(np.mean(np.diagonal(information)[functions.trend : len(functions)]))
        numbers = np.arange(MIN_MODES, MAX_MODES + 1)
        variance = part.prior.signal.density(numbers * functions.frequency_of_mode)
        sufficient = numbers[variance * level < NEGLIGIBLE]
        number = int(sufficient[0]) if len(sufficient) else MAX_MODES
        if part.prior.local is not None:
            number = max(number, LOCAL_MODES)
        current = functions.complete
        is_close = FEWER_MODES * current <= number <= current
        return current if is_close and self._changes else number


class Once:
    """A change that is searched for once, at steady priors."""

    def __init__(self, search: Callable[[Solution], Changes]) -> None:
        self._search = search
        self._is_done = False

    def propose(self, solution: Solution) -> Changes:
        """See `Refinement`."""
        if self._is_done or not solution.is_steady:
            return {}
        self._is_done = True
        return self._search(solution)


def ripples(solution: Solution) -> Changes:
    """Search for ripples in few bands of frequencies.

    They are shown by the residuals, or by what the sines of these bands have already followed
    together with all other sines that are as short.
    """
    out = {}
    for part, coefficients in zip(solution.parts, coefficients_of(solution.adjustment)):
        signal = part.prior.signal
        modes = part.functions.complete
        points = part.inliers(solution.adjustment)
        shown = _shown_ripples(part, points, points.residuals, modes)
        if shown is None and modes > GAP_FROM:
            shown = _followed_ripples(part, points, coefficients)
            signal = signal.without_short_field(max(part.image_size))
            modes = GAP_FROM
        if shown is not None:
            prior = replace(part.prior, signal=replace(signal, ripples=shown))
            out[part.number] = Change(modes, prior)
    return out


def _followed_ripples(
    part: FluoroscopeTerms, points: FittedPoints, coefficients: NDArray[np.float64]
) -> Ripples | None:
    """Return ripples that the sines beyond those of a smooth field have followed, or None."""
    functions = part.functions
    is_short = np.concatenate([np.zeros(functions.trend), functions.band > GAP_FROM])
    short_coefficients = coefficients[part.of_series].reshape(2, -1) * is_short
    values = points.residuals + functions(points.uv) @ short_coefficients.T
    shown = _shown_ripples(part, points, values, GAP_FROM)
    return None if shown is None else shown.alone()


def _shown_ripples(
    part: FluoroscopeTerms, points: FittedPoints, values: NDArray[np.float64], complete: int
) -> Ripples | None:
    """Return ripples that values (n, 2) [px] at image points show beyond the complete bands."""
    return shown_ripples(
        part.image_size, points.uv, values, exposure=points.exposure, complete=complete
    )


def exposure_terms(solution: Solution) -> Changes:
    """Return terms of exposures where residuals show that the exposures differ."""
    out = {}
    for part in solution.parts:
        modes = min(part.functions.complete, START_MODES)
        out[part.number] = Change(modes)
        if not 1 < len(np.unique(part.exposure)) <= MAX_VARYING_EXPOSURES:
            continue
        points = part.inliers(solution.adjustment)
        geometry = part.image_size, part.interior
        functions = exposure_functions(points.uv, *geometry)
        cubic = variation(points.residuals, points.exposure, functions)
        if not cubic.is_varying:
            continue
        functions = exposure_functions(points.uv, *geometry, degree=QUINTIC)
        higher = variation(points.residuals, points.exposure, functions, TERMS)
        degree = QUINTIC if higher.chi2_per_dof > MORE_THAN_NOISE else CUBIC
        is_flat = part.gauge_kind is GaugeKind.TREND  # and shows no change of the interior
        functions = exposure_functions(
            part.uv,
            *geometry,
            with_interior=can_be_fitted(part.angles) and not is_flat,
            kind=GaugeKind.TREND if is_flat else GaugeKind.FULL,
            degree=degree,
        )
        own = ExposureTerms(functions, part.exposure, cubic.size_px, degree)
        out[part.number] = Change(modes, own=own)
    return out if any(change.own is not None for change in out.values()) else {}


class AgreeingOutliers:
    """Search for rejected image points that agree, and so are not false matches.

    Weights that were found while the model had only long waves reject the image points of a dent;
    at that solution they have no weight, however many they are. The search is made at every
    solution with steady priors, because there may be too few before. Image points that were
    restored once and rejected again are not tried again.
    """

    def __init__(self) -> None:
        self._tried: dict[int, NDArray[np.int64]] = {}

    def propose(self, solution: Solution) -> Changes:
        """See `Refinement`."""
        out: dict[int, Change] = {}
        if not solution.is_steady:
            return out
        adjustment = solution.adjustment
        for part, current in zip(solution.parts, coefficients_of(adjustment)):
            tried = self._tried.get(part.number, np.zeros(0, dtype=int))
            rows = _agreeing(part, adjustment, tried)
            if not len(rows):
                continue
            self._tried[part.number] = np.union1d(tried, rows)
            used = adjustment.inliers[part.rows]
            used[rows] = True
            modes = max(LOCAL_MODES, part.functions.complete)
            prior, coefficients = _followed(
                part,
                modes,
                adjustment.residuals[part.rows] + part.correction(current),
                used=used,
                scale=adjustment.noise.scale,
            )
            out[part.number] = Change(modes, prior, coefficients=coefficients)
        return out


def _agreeing(
    part: FluoroscopeTerms, adjustment: Adjustment, tried: NDArray[np.int64]
) -> NDArray[np.int64]:
    """Return the rows, among those of a fluoroscope, of rejected image points that agree.

    tried (k,): rows that are no evidence, because they were restored before.
    """
    residuals = adjustment.residuals[part.rows]
    inliers = adjustment.inliers[part.rows]
    noise = adjustment.noise.scale * part.sigma
    is_small = np.sum(residuals**2, axis=1) < (LARGEST_SD * noise) ** 2
    rejected = np.setdiff1d(np.flatnonzero(~inliers & is_small), tried)
    points = FittedPoints(part.uv[rejected], residuals[rejected], part.exposure[rejected])
    areas = areas_of_rejected(points, part.point[rejected], part.uv[inliers], part.image_size)
    agreeing = [area.rows for area in areas if area.size_px > area.limit_px]
    return rejected[np.unique(np.concatenate(agreeing))] if agreeing else rejected[:0]


def _followed(
    part: FluoroscopeTerms,
    modes: int,
    values: NDArray[np.float64],
    used: NDArray[np.bool_],
    scale: float,
) -> tuple[Prior, NDArray[np.float64]]:
    """Return prior and coefficients that follow values (n, 2) [px] of the used points (n,).

    The robust adjustment continues from there: at a solution that rejects image points they have
    no weight, however many they are. A dent is a place with a larger variance of the signal.
    Orientations are assumed to be known, which is accurate enough for initial values. scale: scale
    of the noise.
    """
    functions = part.functions_with(modes, part.prior)
    at_points = functions(part.uv)
    gauge = part.gauge_of(at_points)
    weighted = part.weighted(at_points, scale) * used[:, None]
    observed = part.weighted(values, scale) * used[:, None]
    prior = with_shown_places(functions, weighted[used], observed[used], part.prior)
    information = block_diag(*[weighted.T @ weighted] * 2)
    right = (weighted.T @ observed).T.ravel()
    precision = information + gauge + prior_precision(functions, prior)
    return prior, np.linalg.solve(precision, right)


def places(solution: Solution) -> Changes:
    """Search for places where the signal has a larger variance."""
    out = {}
    noise = solution.adjustment.noise
    for part, coefficients in zip(solution.parts, coefficients_of(solution.adjustment)):
        fine = replace(part.functions, modes=max(LOCAL_MODES, part.functions.modes))
        inliers = solution.adjustment.inliers[part.rows]
        weight = noise.weight(solution.adjustment.q[part.rows][inliers])
        root = (np.sqrt(weight) / (noise.scale * part.sigma[inliers]))[:, None]
        residuals = solution.adjustment.residuals[part.rows][inliers]
        observed = residuals + part.correction(coefficients)[inliers]
        values = fine(part.uv[inliers])
        prior = with_shown_places(fine, values * root, observed * root, part.prior)
        if prior.local is not None:
            out[part.number] = Change(fine.complete, prior)
    return out
