"""Self-calibration with parametric terms, chosen as the expert of the paper does, without the
expert.

Section 3 of Chow et al.: additional parameters are added one at a time; one stays if it reduces
the RMSE of the residuals, is significant by Student's t-test, and reduces the trend that is left
in the residuals. Where the last two do not agree the expert decides; here a significant term stays
if one of the other two holds.
"""

from dataclasses import replace

import numpy as np
from scipy import stats
from scipy.spatial import cKDTree

from ..distortion.gauge import gauge_basis
from ..distortion.series import Functions, Series, sd_over_image
from ..distortion.terms import HIGHEST, expert_terms
from ..photogrammetry.additional_parameters import AdditionalParameters
from ..photogrammetry.noise_estimation import LOOSE
from ..photogrammetry.precision import information_of_additional

SIGNIFICANCE = 0.01  # of all terms that are tested for one together
HELD = 1e12  # precision that holds a term at zero
MIN_DROP = 1e-3  # relative drop of the RMSE that counts as one
NEIGHBOURS = 8  # of an image point, whose mean residual tells the trend


class Terms:
    """The 31 terms of every fluoroscope of a network, and which of them are in the model."""

    on_the_way = LOOSE  # the tests of significance want a solution

    def __init__(self, measured, before, interior_held):
        self.network = measured.network
        self.names, terms = expert_terms()
        self.functions = []
        self._maps = []
        self._values = []
        self._near = []
        for f, size in enumerate(measured.image_size):
            uv = self.network.uv[self.network.rows(f)]
            functions = Functions(size, HIGHEST)
            values = functions(uv)
            terms_f = _without_gauge(
                terms, functions, uv, values, before.parameters.interior[f], interior_held
            )
            self.functions.append(functions)
            self._maps.append(terms_f.reshape(len(terms), -1))
            self._values.append(np.einsum('nm,tam->nat', values, terms_f))
            count = min(NEIGHBOURS + 1, len(uv))
            self._near.append(cKDTree(uv).query(uv, k=np.arange(2, count + 1))[1])
        self.chosen = [np.zeros(len(terms), dtype=bool) for _ in self.functions]
        self._tried = [np.zeros(len(terms), dtype=bool) for _ in self.functions]

    def with_additional(self, network):
        """The network with the terms as additional parameters; those not chosen are held at zero."""
        return replace(
            network,
            additional=tuple(
                AdditionalParameters(values, np.diag(np.where(chosen, 0.0, HELD)))
                for values, chosen in zip(self._values, self.chosen)
            ),
        )

    def zeros(self):
        """Coefficients of no correction."""
        return tuple(np.zeros(len(self.names)) for _ in self.functions)

    def series(self, f, coefficients, covariance):
        """Series of fluoroscope f of its coefficients (31,) and their covariance."""
        functions = self.functions[f]
        to_polynomials = self._maps[f]
        return Series(
            functions,
            (coefficients @ to_polynomials).reshape(2, -1),
            sd_over_image(functions, to_polynomials.T @ covariance @ to_polynomials),
        )

    def renew(self, network, matrix, adjustment):
        """Add or take out a term of every fluoroscope; returns whether none was, and the
        coefficients to go on with.
        """
        changed = [self._step(f, network, matrix, adjustment) for f in range(len(self.functions))]
        return not any(changed), adjustment.parameters.additional

    def _step(self, f, network, matrix, result):
        """Add the best term of fluoroscope f, or take out one that is not significant; returns
        whether one was.
        """
        present = network.additional[f].prior
        information = information_of_additional(matrix, f) - present
        coefficients = result.parameters.additional[f]
        chosen = self.chosen[f]
        rows = network.rows(f)
        dof = 2 * len(rows) - network.n_unknowns + len(self.names) * len(self.chosen)
        limit = stats.t.ppf(1 - SIGNIFICANCE / (2 * len(self.names)), max(dof, 1))
        if self._take_out(f, information, coefficients, limit):
            return True
        score = (
            present @ coefficients
        )  # gradient of the likelihood for those that are held at zero
        mixed = np.linalg.solve(information[np.ix_(chosen, chosen)], information[chosen])
        own = np.diagonal(information) - np.einsum('ij,ij->j', information[chosen], mixed)
        with np.errstate(divide='ignore', invalid='ignore'):
            t = np.where(
                chosen | self._tried[f] | (own <= 1e-9 * np.diagonal(information)),
                0,
                score / np.sqrt(own),
            )
        for best in np.argsort(-np.abs(t)):
            if abs(t[best]) < limit:
                return False
            direction = -mixed[:, best] if chosen.any() else np.zeros(0)
            change = self._values[f][:, :, best] + self._values[f][:, :, chosen] @ direction
            if self._is_worth_it(f, result, rows, change * score[best] / own[best], t[best]):
                chosen[best] = True
                return True
            self._tried[f][best] = True
        return False

    def _take_out(self, f, information, coefficients, limit):
        """Hold the least significant of the chosen terms at zero, for good, if it is not
        significant any more.
        """
        chosen = np.flatnonzero(self.chosen[f])
        if not len(chosen):
            return False
        sd = np.sqrt(np.diagonal(np.linalg.inv(information[np.ix_(chosen, chosen)])))
        t = np.abs(coefficients[chosen]) / sd
        worst = int(np.argmin(t))
        if t[worst] >= limit:
            return False
        self.chosen[f][chosen[worst]] = False
        self._tried[f][chosen[worst]] = True
        return True

    def _is_worth_it(self, f, result, rows, change, t):
        """Whether a significant change of the correction (n, 2) reduces the RMSE, or the trend of
        the residuals.
        """
        core = result.inliers[rows]
        residuals = result.residuals[rows]
        square = np.sum(result.q[rows][core])
        drop = 1 - np.sqrt(max(square - t * t, 0.0) / square)
        return drop >= MIN_DROP or self._trend(f, residuals - change, core) < self._trend(
            f, residuals, core
        )

    def _trend(self, f, residuals, core):
        """Mean product of the residuals of inliers with the mean residual of their neighbours
        [px^2].
        """
        inside = np.where(core[:, None], residuals, 0.0)
        return float(np.mean(np.sum(inside * inside[self._near[f]].mean(axis=1), axis=1)))


def _without_gauge(terms, functions, uv, values, interior, interior_held):
    """Terms (t, 2, m) less their part in the gauge at pixels uv, of which values (n, m) are the
    polynomials.
    """
    gauge = gauge_basis(uv, interior, interior_held)
    flat = gauge.reshape(-1, gauge.shape[2])
    as_polynomials = np.linalg.lstsq(
        values, gauge.transpose(0, 1, 2).reshape(len(uv), -1), rcond=None
    )[0]
    as_polynomials = as_polynomials.reshape(len(functions), 2, -1).transpose(2, 1, 0)
    own = np.einsum('nm,tam->nat', values, terms).reshape(-1, len(terms))
    share = np.linalg.lstsq(flat, own, rcond=None)[0]
    return terms - np.einsum('gt,gam->tam', share, as_polynomials)
