# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The model `parametric`: terms of the expert, selected stepwise without the expert.

Section 3 of Chow et al.: additional parameters are added one at a time. A parameter stays if it
reduces the RMSE of the residuals, is significant by Student's t-test, and reduces the remaining
trend of the residuals. Where the last two disagree, the expert decides; here a significant term
stays if either of the other two criteria holds.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.special import stdtrit

from ..correction.series import Functions, Series, sd_over_image
from ..correction.terms import HIGHEST, expert_terms
from ..photogrammetry.collinearity import AdditionalParameters
from ..photogrammetry.outliers import LOOSE, SIGNIFICANCE
from ..photogrammetry.precision import information_of_additional
from .estimator import (
    AdjustedTerms,
    AdjustmentProblem,
    GaugeKind,
    TermsOfFluoroscope,
    coefficients_of,
    estimated_terms,
    gauge_basis,
    prior_of_additional,
)

if TYPE_CHECKING:
    from ..photogrammetry.adjustment import Adjustment
    from ..photogrammetry.elimination import FactorizedNormalMatrix
    from ..photogrammetry.network import Network
    from ..photogrammetry.precision import Precision

# Uncertainty of which terms of a trend exist, and with which variance.
#
# The prior variances of the trend terms are those of the largest marginal likelihood (see
# `priors`), and the posterior treats them as known. A term that hardly exceeds its noise may then
# be omitted, or kept with too small a standard deviation: its mean squared error is up to three
# times its variance. Here each term is averaged over its prior. With equal odds, it does not exist
# (Mitchell and Beauchamp, "Bayesian variable selection in linear regression", JASA 83, 1988), or
# it has a variance with the uniform shrinkage prior (Daniels, "A prior for the variance in
# hierarchical models", Canadian Journal of Statistics 27, 1999).

NODES = 64  # nodes of a quadrature
FAR = 8.0  # standard deviations beyond which the tail of a Gaussian is negligible


def squared_error_of_kept(
    ratio: NDArray[np.float64], fraction: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return expected squared errors (t,) of terms, in units of the variances of their estimates.

    ratio: (t,) estimates without a prior, over their standard deviations. fraction: (t,) of
    these estimates that is kept, 0 to 1. Errors are posterior variances about the kept values.
    """
    half = np.square(ratio) / 2
    x, weight = np.polynomial.legendre.leggauss(NODES)
    # Shrinkage k = x^2 is uniform on 0..1; the likelihood is sqrt(k) exp(-k half).
    end = np.minimum(1.0, FAR / np.sqrt(np.maximum(2 * half, 1e-300)))[:, None]
    x = (x + 1) / 2 * end
    k = np.square(x)
    density = weight / 2 * end * 2 * k * np.exp(-k * half[:, None])
    evidence = density.sum(axis=1)
    chance = evidence / (evidence + np.exp(-half))
    density /= evidence[:, None]
    share = 1 - k
    variance = np.sum(density * share, axis=1)
    square = np.sum(density * np.square(share - fraction[:, None]), axis=1)
    return chance * (variance + 2 * half * square) + (1 - chance) * 2 * half * np.square(fraction)


def covariance_with_uncertain_terms(
    to_terms: NDArray[np.float64],
    variance: NDArray[np.float64],
    mean: NDArray[np.float64],
    covariance: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Add the uncertainty of which terms exist to the covariance (p, p) of coefficients.

    Each term is treated in turn, with the prior variances of the others as known.

    to_terms: (t, p) from coefficients to terms. variance: (t,) prior variances of the terms. mean,
    covariance: (p, p) posterior of the coefficients with these variances. Returns (p, p).
    """
    mixed = covariance @ to_terms.T
    term_variances = np.einsum('tp,pt->t', to_terms, mixed)
    kept_share = np.clip(1 - term_variances / variance, 1e-12, 1.0)
    without_prior = term_variances / kept_share  # variances of the estimates without their priors
    ratio = to_terms @ mean / kept_share / np.sqrt(without_prior)
    added_variance = np.maximum(
        squared_error_of_kept(ratio, kept_share) * without_prior - term_variances, 0.0
    )
    directions = mixed * (np.sqrt(added_variance) / term_variances)
    return covariance + directions @ directions.T


ZERO_PRECISION = 1e12  # prior precision that fixes a term at zero
MIN_DROP = 1e-3  # least relative decrease of the RMSE by a term
NEIGHBOURS = 8  # neighbours of an image point, whose mean residual shows the trend


class StepwiseTerms(AdjustedTerms):
    """The 31 terms of every fluoroscope of a network, and their selection for the model."""

    intermediate_tolerance = LOOSE  # the tests of significance need a solution
    needs_solution = True

    def __init__(self, problem: AdjustmentProblem) -> None:
        # The terms keep what no orientation can absorb.
        self.names, terms = expert_terms(GaugeKind.NONE in problem.gauges)
        self.parts: list[ExpertTerms] = [
            ExpertTerms(problem, f, terms) for f in range(len(problem.image_sizes))
        ]

    def renew(
        self, network: Network, matrix: FactorizedNormalMatrix, adjustment: Adjustment
    ) -> tuple[bool, tuple[NDArray[np.float64], ...]]:
        """Add or remove a term of every fluoroscope.

        Returns whether all terms stay the same, and the coefficients to continue with.
        """
        changed = [part.step(network, matrix, adjustment) for part in self.parts]
        return not any(changed), coefficients_of(adjustment)


class ExpertTerms(TermsOfFluoroscope):
    """Terms of one fluoroscope, and their selection.

    terms: (t, 2, m) coefficients of polynomials in u and v.
    """

    def __init__(
        self, problem: AdjustmentProblem, number: int, terms: NDArray[np.float64]
    ) -> None:
        super().__init__(problem, number)
        self.functions = Functions(self.image_size, HIGHEST)
        polynomials = self.functions(self.uv)
        interior = problem.before.parameters.interior[number]
        # The terms themselves have no shift, scale or tilt.
        kind = GaugeKind.NONE if self.gauge_kind is GaugeKind.TREND else self.gauge_kind
        terms = _without_gauge(terms, polynomials, gauge_basis(self.uv, interior, kind))
        #: (t, 2m) coefficients of the polynomials in each term
        self.to_polynomials = terms.reshape(len(terms), -1)
        self.values = np.einsum('nm,tam->nat', polynomials, terms)
        count = min(NEIGHBOURS + 1, len(self.uv))
        self._near = cKDTree(self.uv).query(self.uv, k=np.arange(2, count + 1))[1]
        #: (t,) whether each term is in the model
        self.selected = np.zeros(len(terms), dtype=bool)
        self._rejected = np.zeros(len(terms), dtype=bool)

    @property
    def count(self) -> int:
        """See `TermsOfFluoroscope`."""
        return len(self.selected)

    def additional(self) -> AdditionalParameters:
        """Return the terms; terms that are not selected are fixed at zero."""
        precision = np.where(self.selected, 0.0, ZERO_PRECISION)
        return AdditionalParameters(self.values, np.diag(precision))

    def fitted_series(self, adjustment: Adjustment, precise: Precision) -> Series:
        """See `TermsOfFluoroscope`."""
        coefficients, covariance = estimated_terms(self.number, adjustment, precise)
        return Series(
            self.functions,
            (coefficients @ self.to_polynomials).reshape(2, -1),
            sd_over_image(
                self.functions, self.to_polynomials.T @ covariance @ self.to_polynomials
            ),
        )

    def step(self, network: Network, matrix: FactorizedNormalMatrix, result: Adjustment) -> bool:
        """Add the best term, or remove a term that has become insignificant."""
        prior = prior_of_additional(network, self.number)
        information = information_of_additional(matrix, self.number) - prior
        coefficients = coefficients_of(result)[self.number]
        selected = self.selected
        dof = 2 * len(self.rows) - network.n_unknowns + self.count * network.n_fluoroscopes
        if network.exterior is not None:
            # Most unknowns are known beforehand.
            dof += network.n_observations - 2 * network.n_image_points
        # Significance of all terms together that are tested for one fluoroscope.
        limit = stdtrit(max(dof, 1), 1 - SIGNIFICANCE / (2 * self.count))  # quantile of t
        if self._remove_insignificant(information, coefficients, limit):
            return True
        score = prior @ coefficients  # gradient of the likelihood by terms fixed at zero
        mixed = np.linalg.solve(information[np.ix_(selected, selected)], information[selected])
        reduced = np.diagonal(information) - np.einsum('ij,ij->j', information[selected], mixed)
        dependent = reduced <= 1e-9 * np.diagonal(information)
        with np.errstate(divide='ignore', invalid='ignore'):
            excluded = selected | self._rejected | dependent
            t = np.where(excluded, 0, score / np.sqrt(reduced))
        for best in np.argsort(-np.abs(t)):
            if abs(t[best]) < limit:
                return False
            direction = -mixed[:, best] if selected.any() else np.zeros(0)
            change = self.values[:, :, best] + self.values[:, :, selected] @ direction
            if self._improves(result, change * score[best] / reduced[best], t[best]):
                selected[best] = True
                return True
            self._rejected[best] = True
        return False

    def _remove_insignificant(
        self, information: NDArray[np.float64], coefficients: NDArray[np.float64], limit: float
    ) -> bool:
        """Reject the least significant selected term for good if it is below the limit of t."""
        selected = np.flatnonzero(self.selected)
        if not len(selected):
            return False
        sd = np.sqrt(np.diagonal(np.linalg.inv(information[np.ix_(selected, selected)])))
        t = np.abs(coefficients[selected]) / sd
        worst = int(np.argmin(t))
        if t[worst] >= limit:
            return False
        self.selected[selected[worst]] = False
        self._rejected[selected[worst]] = True
        return True

    def _improves(self, result: Adjustment, change: NDArray[np.float64], t: float) -> bool:
        """Whether a significant change (n, 2) of the correction reduces the RMSE or the trend."""
        inliers = result.inliers[self.rows]
        residuals = result.residuals[self.rows]
        square = np.sum(result.q[self.rows][inliers])
        drop = 1 - np.sqrt(max(square - t * t, 0.0) / square)
        if drop >= MIN_DROP:
            return True
        return self._trend(residuals - change, inliers) < self._trend(residuals, inliers)

    def _trend(self, residuals: NDArray[np.float64], core: NDArray[np.bool_]) -> float:
        """Return the mean product of residuals with the mean of their neighbours [px^2]."""
        inside = np.where(core[:, None], residuals, 0.0)
        return float(np.mean(np.sum(inside * inside[self._near].mean(axis=1), axis=1)))


def _without_gauge(
    terms: NDArray[np.float64], values: NDArray[np.float64], gauge: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Remove the gauge part of terms (t, 2, m).

    terms: (t, 2, m) coefficients of the polynomials in u and v. values: (n, m) polynomials at the
    image points. gauge: (n, 2, g) gauge at the image points. Returns (t, 2, m).
    """
    if not gauge.shape[2]:
        return terms
    flat = gauge.reshape(-1, gauge.shape[2])
    as_polynomials = np.linalg.lstsq(values, gauge.reshape(len(values), -1), rcond=None)[0]
    as_polynomials = as_polynomials.reshape(values.shape[1], 2, -1).transpose(2, 1, 0)
    columns = np.einsum('nm,tam->nat', values, terms).reshape(-1, len(terms))
    share = np.linalg.lstsq(flat, columns, rcond=None)[0]
    return terms - np.einsum('gt,gam->tam', share, as_polynomials)
