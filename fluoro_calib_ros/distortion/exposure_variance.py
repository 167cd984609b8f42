# Copyright 2026 fluoro_calib_ros maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""How far the distortion of a later exposure differs from the common one.

The variances of the terms of the exposures (see `exposure_terms`) have the largest likelihood
under the survey, whose errors are taken to be independent. Errors that the survey has in common,
such as a sheet that has shrunk in one direction, look like terms that change as the phantom is
turned. Object points could absorb such terms, but not terms drawn from these variances. The size
is therefore that of the part which neither orientations nor object points absorb; only the
distribution over the terms is that of the variances: a variance component by the method of
moments (Searle, Casella and McCulloch, "Variance Components", Wiley 1992, chapter 5).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..photogrammetry.additional_parameters import AdditionalParameters
from ..photogrammetry.adjustment import Adjustment
from ..photogrammetry.collinearity import project_with_jacobian
from ..photogrammetry.elimination import factorize
from ..photogrammetry.network import Network
from ..photogrammetry.noise import Noise
from ..photogrammetry.normal_equations import normal_equations
from ..photogrammetry.precision import information_of_additional
from .exposure_terms import ExposureTerms

UNUSED = 1e6  # factor of the standard deviation of an outlier


def variance_between_exposures(
    network: Network,
    adjustment: Adjustment,
    f: int,
    terms: ExposureTerms,
    coefficients: np.ndarray,
    covariance: np.ndarray,
) -> float:
    """Variance [px^2] of an image coordinate by terms of exposures, less what orientations absorb.

    Parameters
    ----------
    network : Network
    adjustment : Adjustment
        Of the network.
    f : int
        Number of the fluoroscope.
    terms : ExposureTerms
        Of its exposures.
    coefficients : (p,) ndarray
        Estimated coefficients of the terms [px].
    covariance : (p, p) ndarray
        Their covariance.

    Returns
    -------
    float

    Raises
    ------
    numpy.linalg.LinAlgError
        Where the network does not determine orientations and object points.
    """
    variance = np.tile(terms.variance, terms.exposures)
    information = _information(network, adjustment, f, terms)
    expected = float(variance @ np.diagonal(information))
    if not expected > 0:
        return 0.0
    found = float(coefficients @ information @ coefficients + np.sum(information * covariance))
    return found / expected * _mean_square_left(network, adjustment, f, terms)


def _information(
    network: Network, adjustment: Adjustment, f: int, terms: ExposureTerms
) -> np.ndarray:
    """Information (p, p) of the terms where only orientations and object points are unknown."""
    additional: list[AdditionalParameters | None] = [None] * network.n_fluoroscopes
    start: list[np.ndarray | None] = [None] * network.n_fluoroscopes
    none = np.zeros((len(network.rows(f)), 0))
    additional[f] = AdditionalParameters(none, np.diag(terms.precision), terms.functions)
    start[f] = np.zeros(terms.count)
    plain = replace(
        network,
        sigma=np.where(adjustment.inliers, network.sigma, UNUSED * network.sigma),
        interior_free=np.zeros(network.n_fluoroscopes, dtype=bool),
        additional=tuple(additional),
    )
    parameters = replace(adjustment.parameters, additional=tuple(start))
    equations = normal_equations(plain, parameters, 0.0, Noise('gaussian', adjustment.noise.scale))
    matrix = factorize(plain, equations)
    return information_of_additional(matrix, f) - np.diag(terms.precision)


def _mean_square_left(
    network: Network, adjustment: Adjustment, f: int, terms: ExposureTerms
) -> float:
    """Expected mean square [px^2] of the terms without what orientations absorb of them."""
    rows = network.rows(f)
    inliers = adjustment.inliers[rows]
    _, by_exterior, _, _ = project_with_jacobian(*network.per_image_point(adjustment.parameters))
    exposure = network.exposure[rows]
    square = 0.0
    for number in np.unique(exposure):
        at = inliers & (exposure == number)
        own = terms.functions.values[at].reshape(2 * int(at.sum()), -1)
        # In units in which the six unknowns matter alike.
        absorbed = by_exterior[rows[at]].reshape(len(own), -1)
        absorbed = absorbed / np.linalg.norm(absorbed, axis=0)
        left = own - absorbed @ np.linalg.lstsq(absorbed, own, rcond=None)[0]
        square += float(np.sum(left**2, axis=0) @ terms.variance)
    return square / (2 * int(inliers.sum()))
