# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0
"""Refinements of a collocation: what a solution shows that its terms do not have yet.

A refinement of one prior proposes another prior for the same functions. A refinement of the terms
proposes a `Change` of functions, priors and terms of exposures, with which the network is adjusted
again. None: nothing is proposed. `collocation` has their order.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from ..photogrammetry.adjustment import Adjustment
from .estimator import coefficients_of
from .exposure_terms import ExposureTerms, can_be_fitted, exposure_functions, variation
from .fluoroscope_terms import FluoroscopeTerms, SeriesEquations
from .lack_of_fit import LARGEST_SD, FittedPoints, areas_of_rejected
from .priors import Prior, most_likely_prior, prior_precision, with_more_places, with_shown_places
from .ripples import Ripples, shown_ripples

START_MODES = 16  # half waves along the image, until the signal is known
MIN_MODES = 10  # least number
# That tell the bumps of a place where the signal varies more. Rejected image points that agree
# start with them, too: more may follow.
LOCAL_MODES = 24
# Bands up to which a smooth field has its sines where others of few bands follow ripples.
GAP_FROM = 12
MAX_PLACE_SEARCHES = 4  # for more such places, beside those that there are
MAX_MODES = 30  # the time grows with the sixth power
# Prior variance times information of a sine below which the image points say nothing about it.
NEGLIGIBLE = 0.2
# Part of the present modes below which fewer are worth a change: nearly half of the functions.
FEWER_MODES = 0.75
MODE_CHANGES = 3  # at most: numbers must not alternate for ever
# Mean change of the logarithms of the variances of the signal that changes no correction visibly.
SETTLED_PRIOR = 0.3
MAX_VARYING_EXPOSURES = 60  # of a fluoroscope that can have terms of their own, to limit the time


@dataclass(frozen=True)
class Solution:
    """A solution of the adjustment, with the priors renewed."""

    parts: Sequence[FluoroscopeTerms]
    adjustment: Adjustment
    equations: Sequence[SeriesEquations]  #: by fluoroscope, linearised at the solution
    is_steady: bool  #: whether the renewal changed no prior visibly

    @property
    def coefficients(self) -> tuple[NDArray[np.float64], ...]:
        """Coefficients by fluoroscope."""
        return coefficients_of(self.adjustment)

    @property
    def modes(self) -> list[int]:
        """Modes up to which each fluoroscope has all sines."""
        return [part.functions.complete for part in self.parts]


@dataclass(frozen=True)
class Change:
    """Terms with which the network is to be adjusted again."""

    modes: Sequence[int]  #: modes up to which each fluoroscope gets all sines
    #: by number of the fluoroscope, where it changes
    priors: Mapping[int, Prior] = field(default_factory=dict)
    #: of fluoroscopes whose distortion varies
    exposure_terms: Mapping[int, ExposureTerms] = field(default_factory=dict)
    #: (p,) of the series with which to continue, where they are not those of the solution
    coefficients: Mapping[int, NDArray[np.float64]] = field(default_factory=dict)


class Refinement(Protocol):
    """A refinement of the terms."""

    def propose(self, solution: Solution) -> Change | None:
        """Return the change that a solution shows to be due, or None."""


class MorePlaces:
    """More places where the signal varies more, beside those that there are."""

    def __init__(self, searches: int = MAX_PLACE_SEARCHES) -> None:
        self._left = searches

    def propose(
        self, part: FluoroscopeTerms, equations: SeriesEquations, renewed: Prior
    ) -> Prior | None:
        """Return a prior in place of the renewed one, or None; part: with the last prior."""
        if not self._left or renewed.local is None:
            return None
        self._left -= 1
        return with_more_places(
            part.functions, equations.information, equations.right, part.gauge, prior=renewed
        )


class NumberOfSines:
    """As many sines as the image points can tell with the present priors.

    changes: how often the number has changed before.
    """

    def __init__(self, changes: int = 0) -> None:
        self._changes = changes
        self._varying = False

    def propose(self, solution: Solution) -> Change | None:
        """See `Refinement`."""
        varying = any(part.own is not None for part in solution.parts)
        if varying and not self._varying:  # what varied may have passed for a short signal
            self._changes = 0
        self._varying = varying
        modes = [
            self._wanted(part, equations.information)
            for part, equations in zip(solution.parts, solution.equations)
        ]
        if modes == solution.modes or self._changes >= MODE_CHANGES:
            return None
        self._changes += 1
        return Change(modes)

    def _wanted(self, part: FluoroscopeTerms, information: NDArray[np.float64]) -> int:
        """Number of modes with which image points can tell the signal.

        information (2m, 2m) of its coefficients without prior.
        """
        functions = part.functions
        if not functions.modes:
            return 0
        level = float(np.mean(np.diagonal(information)[functions.trend : len(functions)]))
        numbers = np.arange(MIN_MODES, MAX_MODES + 1)
        variance = part.prior.signal.density(numbers * functions.frequency_of_mode)
        enough = numbers[variance * level < NEGLIGIBLE]
        wanted = int(enough[0]) if len(enough) else MAX_MODES
        if part.prior.local is not None:
            wanted = max(wanted, LOCAL_MODES)
        present = functions.complete
        kept = FEWER_MODES * present <= wanted <= present
        return present if kept and self._changes else wanted


class Once:
    """A change that is looked for once, at steady priors."""

    def __init__(self, search: Callable[[Solution], Change | None]) -> None:
        self._search = search
        self._is_done = False

    def propose(self, solution: Solution) -> Change | None:
        """See `Refinement`."""
        if self._is_done or not solution.is_steady:
            return None
        self._is_done = True
        return self._search(solution)


def ripples(solution: Solution) -> Change | None:
    """Ripples in few bands of frequencies.

    Residuals show them, or what the sines of these bands have already followed, with all others
    that are as short.
    """
    modes = solution.modes
    priors = {}
    for part, coefficients in zip(solution.parts, solution.coefficients):
        f = part.number
        signal = part.prior.signal
        points = part.inliers(solution.adjustment)
        found = _shown_ripples(part, points, points.residuals, modes[f])
        if found is None and modes[f] > GAP_FROM:
            found = _followed_ripples(part, points, coefficients)
            if found is not None:
                signal = signal.without_short_field(max(part.image_size))
                modes[f] = GAP_FROM
        if found is not None:
            signal = replace(signal, ripples=found)
            priors[f] = replace(part.prior, signal=signal)
    return Change(modes, priors) if priors else None


def _followed_ripples(
    part: FluoroscopeTerms, points: FittedPoints, coefficients: NDArray[np.float64]
) -> Ripples | None:
    """Ripples that the sines beyond those of a smooth field have followed, or None."""
    functions = part.functions
    short = np.concatenate([np.zeros(functions.trend), functions.band > GAP_FROM])
    own = coefficients[part.of_series].reshape(2, -1) * short
    followed = points.residuals + functions(points.uv) @ own.T
    found = _shown_ripples(part, points, followed, GAP_FROM)
    return None if found is None else found.alone()


def _shown_ripples(
    part: FluoroscopeTerms, points: FittedPoints, values: NDArray[np.float64], complete: int
) -> Ripples | None:
    """Ripples that values (n, 2) [px] at image points show beyond the complete bands."""
    return shown_ripples(
        part.image_size, points.uv, values, exposure=points.exposure, complete=complete
    )


def exposure_terms(solution: Solution) -> Change | None:
    """Terms of the exposures where residuals show that these differ."""
    found = {}
    for part in solution.parts:
        functions = exposure_functions(part.uv, part.image_size, part.interior)
        core = solution.adjustment.inliers[part.rows]
        shown = variation(
            solution.adjustment.residuals[part.rows][core], part.exposure[core], functions[core]
        )
        few = len(np.unique(part.exposure)) <= MAX_VARYING_EXPOSURES
        if not shown.is_varying or not few:
            continue
        if can_be_fitted(part.angles):
            functions = exposure_functions(
                part.uv, part.image_size, part.interior, with_interior=True
            )
        found[part.number] = ExposureTerms(functions, part.exposure, shown.size_px)
    if not found:
        return None
    return Change([min(number, START_MODES) for number in solution.modes], exposure_terms=found)


class AgreeingOutliers:
    """Rejected image points that agree: they are not false matches.

    Weights that were found while only long waves were in the model reject the image points of a
    dent, and at that solution they have no weight, however many they are. They are looked for at
    every solution with steady priors: before, they may be too few. Those that have been taken back
    once, and were rejected again, are not tried again.
    """

    def __init__(self) -> None:
        self._tried: dict[int, set[int]] = {}

    def propose(self, solution: Solution) -> Change | None:
        """See `Refinement`."""
        if not solution.is_steady:
            return None
        modes = solution.modes
        priors = {}
        coefficients = {}
        adjustment = solution.adjustment
        for part, present in zip(solution.parts, solution.coefficients):
            f = part.number
            rows = _agreeing(part, adjustment)
            tried = self._tried.setdefault(f, set())
            if tried.issuperset(rows.tolist()):
                continue
            tried.update(rows.tolist())
            modes[f] = max(LOCAL_MODES, modes[f])
            used = adjustment.inliers[part.rows]
            used[rows] = True
            priors[f], coefficients[f] = _followed(
                part,
                modes[f],
                adjustment.residuals[part.rows] + part.correction(present),
                used=used,
                scale=adjustment.noise.scale,
            )
        return Change(modes, priors, coefficients=coefficients) if priors else None


def _agreeing(part: FluoroscopeTerms, adjustment: Adjustment) -> NDArray[np.int64]:
    """Rows, of those of a fluoroscope, of rejected image points that agree."""
    residuals = adjustment.residuals[part.rows]
    inliers = adjustment.inliers[part.rows]
    noise = adjustment.noise.scale * part.sigma
    small = np.sum(residuals**2, axis=1) < (LARGEST_SD * noise) ** 2
    rejected = np.flatnonzero(~inliers & small)
    points = FittedPoints(part.uv[rejected], residuals[rejected], part.exposure[rejected])
    areas = areas_of_rejected(points, part.point[rejected], part.uv[inliers], part.image_size)
    found = [area.rows for area in areas if area.size_px > area.limit_px]
    return rejected[np.unique(np.concatenate(found))] if found else rejected[:0]


def _followed(
    part: FluoroscopeTerms,
    modes: int,
    values: NDArray[np.float64],
    used: NDArray[np.bool_],
    scale: float,
) -> tuple[Prior, NDArray[np.float64]]:
    """Prior and coefficients that follow the values (n, 2) [px] of the points used (n,).

    The robust adjustment goes on from there: at a solution that rejects image points they have no
    weight, however many they are. A dent is a place where the signal varies more; where none is
    shown, the signal is given a short field. Orientations are taken to be known, which is near
    enough to start with. scale: of the noise.
    """
    functions = part.functions_with(modes, part.prior)
    at_points = functions(part.uv)
    gauge = part.gauge_of(at_points)
    weighted = part.weighted(at_points, scale) * used[:, None]
    observed = part.weighted(values, scale) * used[:, None]
    prior = with_shown_places(functions, weighted[used], observed[used], part.prior)
    information = block_diag(*[weighted.T @ weighted] * 2)
    right = (weighted.T @ observed).T.ravel()
    if prior.local is None:
        signal = part.prior.signal.with_short_field(max(part.image_size))
        prior = replace(part.prior, signal=signal)
        prior = most_likely_prior(functions, information, right, gauge, prior=prior)
    precision = information + gauge + prior_precision(functions, prior)
    return prior, np.linalg.solve(precision, right)


def places(solution: Solution) -> Change | None:
    """Places where the signal varies more."""
    modes = solution.modes
    priors = {}
    noise = solution.adjustment.noise
    for part, coefficients in zip(solution.parts, solution.coefficients):
        f = part.number
        fine = replace(part.functions, modes=max(LOCAL_MODES, part.functions.modes))
        used = solution.adjustment.inliers[part.rows]
        weight = noise.weight(solution.adjustment.q[part.rows][used])
        root = (np.sqrt(weight) / (noise.scale * part.sigma[used]))[:, None]
        residuals = solution.adjustment.residuals[part.rows][used]
        observed = residuals + part.correction(coefficients)[used]
        values = fine(part.uv[used])
        found = with_shown_places(fine, values * root, observed * root, part.prior)
        if found.local is not None:
            priors[f] = found
            modes[f] = fine.complete
    return Change(modes, priors) if priors else None
