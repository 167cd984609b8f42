"""Trend and signal of the distortion among the unknowns of the adjustment: least-squares
collocation.
"""

from dataclasses import replace

import numpy as np

from ..distortion.priors import gauge_precision, most_likely_prior, prior_precision, starting_prior
from ..distortion.series import MARGIN, Functions, Series, sd_over_image
from ..photogrammetry.additional_parameters import AdditionalParameters
from ..photogrammetry.precision import information_of_additional

DEGREE = (
    3  # of the trend: pincushion, S-shape and spiral are cubic to first order (Gronenschild 1997)
)
MODES = 18  # half waves along the image, until the reach of the signal is known
MODES_RANGE = (10, 24)  # more cost more than they bring: unknowns grow with the square
# reach times frequency beyond which a Matern signal has less than 1e-4 of its spectral density
CUT_OFF = 8.0
SETTLED_PRIOR = 0.15  # change of the logarithms of reach and sd: no correction changes visibly


class Collocation:
    """Trend and signal of all fluoroscopes of a network, and their priors, through the turns of a
    calibration.
    """

    on_the_way = 1.0  # noise and prior are still to be renewed

    def __init__(self, measured, before, interior_held, modes=MODES):
        self.network = measured.network
        self.interior_held = interior_held
        self._fitted = False
        self.sizes = measured.image_size
        self.interior = before.parameters.interior
        self.functions = []
        self.priors = []
        self.gauges = []
        self.values = []
        for f, size in enumerate(self.sizes):
            core = before.residuals[self.network.rows(f)][before.inliers[self.network.rows(f)]]
            self._take(f, Functions(size, DEGREE, modes))
            self.priors.append(
                starting_prior(self.functions[f], max(float(np.sqrt(np.mean(core**2))), 0.1))
            )

    def _take(self, f, functions):
        """Use these functions for fluoroscope f."""
        self.functions[f : f + 1] = [functions]
        self.values[f : f + 1] = [functions(self.network.uv[self.network.rows(f)])]
        self.gauges[f : f + 1] = [self._gauge(f)]

    def _gauge(self, f):
        uv = self.network.uv[self.network.rows(f)]
        return gauge_precision(self.values[f], uv, self.interior[f], self.interior_held)

    def with_additional(self, network):
        """The network with additional parameters under the present priors."""
        return replace(
            network,
            additional=tuple(
                AdditionalParameters(values, prior_precision(functions, prior) + gauge)
                for values, functions, prior, gauge in zip(
                    self.values, self.functions, self.priors, self.gauges
                )
            ),
        )

    def zeros(self):
        """Coefficients of no correction."""
        return tuple(np.zeros(2 * len(functions)) for functions in self.functions)

    def series(self, f, coefficients, covariance):
        """Series of fluoroscope f of its coefficients (2m,), those of u first, and their
        covariance (2m, 2m).
        """
        functions = self.functions[f]
        return Series(functions, coefficients.reshape(2, -1), sd_over_image(functions, covariance))

    def renew(self, network, matrix, adjustment):
        """Priors from a Solved normal matrix at the solution, and gauges, the first time also the
        number of modes.

        Returns whether the priors have settled, and the coefficients to go on with.
        """
        settled = True
        coefficients = adjustment.parameters.additional
        self.interior = adjustment.parameters.interior
        for f, functions in enumerate(self.functions):
            last = self.priors[f]
            present = network.additional[f].prior
            information = information_of_additional(matrix, f) - present
            right = (information + present) @ coefficients[f]
            now = most_likely_prior(functions, information, right, self.gauges[f], last)
            self.priors[f] = now
            self.gauges[f] = self._gauge(f)
            settled &= (
                abs(np.log(now.sd / last.sd)) + abs(np.log(now.reach / last.reach)) < SETTLED_PRIOR
            )
        if self._fitted:
            return settled, coefficients
        self._fitted = True
        return False, self._fit_modes(coefficients)

    def _fit_modes(self, coefficients):
        """Take as many modes as the reach of each signal asks for; returns the coefficients for
        them.
        """
        out = []
        for f, (functions, prior) in enumerate(zip(self.functions, self.priors)):
            modes = int(
                np.clip(
                    np.ceil(CUT_OFF / prior.reach * MARGIN * max(self.sizes[f]) / np.pi),
                    *MODES_RANGE,
                )
            )
            self._take(f, Functions(self.sizes[f], DEGREE, modes))
            out.append(self.functions[f].taken_over(functions, coefficients[f]))
        return tuple(out)
