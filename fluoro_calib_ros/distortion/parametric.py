# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The model `parametric`: terms of the expert, selected stepwise without the expert.

Section 3 of Chow et al.: additional parameters are added one at a time. One stays if it reduces
the RMSE of the residuals, is significant by Student's t-test, and reduces the trend that is left
in the residuals. Where the last two disagree the expert decides; here a significant term stays if
one of the other two criteria holds.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial import cKDTree
from scipy.special import stdtrit

from ..photogrammetry.additional_parameters import AdditionalParameters
from ..photogrammetry.noise_estimation import LOOSE
from ..photogrammetry.precision import information_of_additional
from .estimation import AdjustedTerms, AdjustmentProblem, coefficients_of, prior_of_additional
from .gauge import GaugeKind, gauge_basis
from .series import Functions, Series, sd_over_image
from .series_model import SeriesModel
from .terms import HIGHEST, expert_terms

if TYPE_CHECKING:
    from ..photogrammetry.adjustment import Adjustment
    from ..photogrammetry.elimination import FactorizedNormalMatrix
    from ..photogrammetry.network import Network

SIGNIFICANCE = 0.01  # of all terms together that are tested for one fluoroscope
ZERO_PRECISION = 1e12  # prior that holds a term at zero
MIN_DROP = 1e-3  # relative decrease of the RMSE that counts as one
NEIGHBOURS = 8  # of an image point, whose mean residual shows the trend


class ParametricModel(SeriesModel):
    """Polynomial terms of lens and image-intensifier distortion, selected by significance."""

    kind = 'parametric'
    description = 'physical terms in the adjustment, selected stepwise'

    @classmethod
    def adjusted_terms(cls, problem: AdjustmentProblem) -> AdjustedTerms:
        """The 31 terms."""
        return StepwiseTerms(problem)


class StepwiseTerms(AdjustedTerms):
    """The 31 terms of every fluoroscope of a network, and which of them are in the model.

    Attributes
    ----------
    names : list of str
        Names of the terms.
    selected : list of (31,) ndarray of bool
        Terms in the model, by fluoroscope.
    """

    intermediate_tolerance = LOOSE  # the tests of significance need a solution
    needs_solution = True

    def __init__(self, problem: AdjustmentProblem) -> None:
        self.network = problem.network
        # What no orientation can take up is left to the terms.
        self.names, terms = expert_terms(GaugeKind.NONE in problem.gauges)
        self.functions: list[Functions] = []
        self.values: list[np.ndarray] = []
        self._maps: list[np.ndarray] = []
        self._near: list[np.ndarray] = []
        for f, size in enumerate(problem.image_sizes):
            uv = self.network.uv[self.network.rows(f)]
            functions = Functions(size, HIGHEST)
            values = functions(uv)
            interior = problem.before.parameters.interior[f]
            # The terms themselves have no shift, scale or tilt.
            kind = problem.gauges[f]
            kind = GaugeKind.NONE if kind is GaugeKind.TREND else kind
            terms_f = _without_gauge(terms, values, gauge_basis(uv, interior, kind))
            self.functions.append(functions)
            self._maps.append(terms_f.reshape(len(terms), -1))
            self.values.append(np.einsum('nm,tam->nat', values, terms_f))
            count = min(NEIGHBOURS + 1, len(uv))
            self._near.append(cKDTree(uv).query(uv, k=np.arange(2, count + 1))[1])
        self.selected = [np.zeros(len(terms), dtype=bool) for _ in self.functions]
        self._rejected = [np.zeros(len(terms), dtype=bool) for _ in self.functions]

    def with_additional(self, network: Network) -> Network:
        """Return the network with the terms; those that are not selected are held at zero."""
        additional = tuple(
            AdditionalParameters(values, np.diag(np.where(selected, 0.0, ZERO_PRECISION)))
            for values, selected in zip(self.values, self.selected)
        )
        return replace(network, additional=additional)

    def zeros(self) -> tuple[np.ndarray, ...]:
        """Coefficients of no correction, by fluoroscope."""
        return tuple(np.zeros(len(self.names)) for _ in self.functions)

    def series(self, f: int, coefficients: np.ndarray, covariance: np.ndarray) -> Series:
        """Return the series of fluoroscope f from its coefficients (31,) and their covariance."""
        functions = self.functions[f]
        to_polynomials = self._maps[f]
        return Series(
            functions,
            (coefficients @ to_polynomials).reshape(2, -1),
            sd_over_image(functions, to_polynomials.T @ covariance @ to_polynomials),
        )

    def renew(
        self, network: Network, matrix: FactorizedNormalMatrix, adjustment: Adjustment
    ) -> tuple[bool, tuple[np.ndarray, ...]]:
        """Add or remove a term of every fluoroscope.

        Returns whether no term was, and the coefficients with which to continue.
        """
        changed = [self._step(f, network, matrix, adjustment) for f in range(len(self.functions))]
        return not any(changed), coefficients_of(adjustment)

    def _step(
        self, f: int, network: Network, matrix: FactorizedNormalMatrix, result: Adjustment
    ) -> bool:
        """Add the best term of fluoroscope f, or remove one that is not significant any more."""
        present = prior_of_additional(network, f)
        information = information_of_additional(matrix, f) - present
        information *= matrix.information_factor
        coefficients = coefficients_of(result)[f]
        selected = self.selected[f]
        rows = network.rows(f)
        dof = 2 * len(rows) - network.n_unknowns + len(self.names) * len(self.selected)
        if network.exterior is not None:
            # Most unknowns are known beforehand.
            dof += network.n_observations - 2 * network.n_image_points
        limit = stdtrit(max(dof, 1), 1 - SIGNIFICANCE / (2 * len(self.names)))  # quantile of t
        if self._remove_insignificant(f, information, coefficients, limit):
            return True
        score = present @ coefficients  # gradient of the likelihood by terms held at zero
        mixed = np.linalg.solve(information[np.ix_(selected, selected)], information[selected])
        own = np.diagonal(information) - np.einsum('ij,ij->j', information[selected], mixed)
        dependent = own <= 1e-9 * np.diagonal(information)
        with np.errstate(divide='ignore', invalid='ignore'):
            excluded = selected | self._rejected[f] | dependent
            t = np.where(excluded, 0, score / np.sqrt(own))
        for best in np.argsort(-np.abs(t)):
            if abs(t[best]) < limit:
                return False
            direction = -mixed[:, best] if selected.any() else np.zeros(0)
            change = self.values[f][:, :, best] + self.values[f][:, :, selected] @ direction
            if self._improves(f, result, rows, change * score[best] / own[best], t[best]):
                selected[best] = True
                return True
            self._rejected[f][best] = True
        return False

    def _remove_insignificant(
        self, f: int, information: np.ndarray, coefficients: np.ndarray, limit: float
    ) -> bool:
        """Reject the least significant selected term for good if it is below the limit of t."""
        selected = np.flatnonzero(self.selected[f])
        if not len(selected):
            return False
        sd = np.sqrt(np.diagonal(np.linalg.inv(information[np.ix_(selected, selected)])))
        t = np.abs(coefficients[selected]) / sd
        worst = int(np.argmin(t))
        if t[worst] >= limit:
            return False
        self.selected[f][selected[worst]] = False
        self._rejected[f][selected[worst]] = True
        return True

    def _improves(
        self, f: int, result: Adjustment, rows: np.ndarray, change: np.ndarray, t: float
    ) -> bool:
        """Whether a significant change (n, 2) of the correction reduces the RMSE or the trend."""
        core = result.inliers[rows]
        residuals = result.residuals[rows]
        square = np.sum(result.q[rows][core])
        drop = 1 - np.sqrt(max(square - t * t, 0.0) / square)
        if drop >= MIN_DROP:
            return True
        return self._trend(f, residuals - change, core) < self._trend(f, residuals, core)

    def _trend(self, f: int, residuals: np.ndarray, core: np.ndarray) -> float:
        """Mean product of the residuals with the mean residual of their neighbours [px^2]."""
        inside = np.where(core[:, None], residuals, 0.0)
        return float(np.mean(np.sum(inside * inside[self._near[f]].mean(axis=1), axis=1)))


def _without_gauge(terms: np.ndarray, values: np.ndarray, gauge: np.ndarray) -> np.ndarray:
    """Terms (t, 2, m) less their part in the gauge.

    Parameters
    ----------
    terms : (t, 2, m) ndarray
        Coefficients of the polynomials in u and v.
    values : (n, m) ndarray
        Polynomials at the image points.
    gauge : (n, 2, g) ndarray
        Gauge at the image points.

    Returns
    -------
    (t, 2, m) ndarray
    """
    if not gauge.shape[2]:
        return terms
    flat = gauge.reshape(-1, gauge.shape[2])
    as_polynomials = np.linalg.lstsq(values, gauge.reshape(len(values), -1), rcond=None)[0]
    as_polynomials = as_polynomials.reshape(values.shape[1], 2, -1).transpose(2, 1, 0)
    own = np.einsum('nm,tam->nat', values, terms).reshape(-1, len(terms))
    share = np.linalg.lstsq(flat, own, rcond=None)[0]
    return terms - np.einsum('gt,gam->tam', share, as_polynomials)
