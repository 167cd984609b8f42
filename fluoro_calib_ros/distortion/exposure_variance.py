# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What the terms of exposures (see `exposure_terms`) are if the survey has errors in common.

Errors of the survey are taken to be independent. Errors that it has in common, such as a sheet
that is bent or has shrunk in one direction, look like terms that change as the phantom is turned:
such terms are more likely than errors of so many points. Object points must not lend the terms
their likelihood. The variances of the terms are therefore estimated with object points that are
nearly free, by restricted likelihood (Patterson and Thompson, "Recovery of inter-block information
when block sizes are unequal", Biometrika 58, 1971). How far the distortion of a later exposure
differs is the size of the part which neither orientations nor object points absorb, a variance
component by the method of moments (Searle, Casella and McCulloch, "Variance Components", Wiley
1992, chapter 5).
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
from ..photogrammetry.precision import information_of_additional, solved_additional
from .exposure_terms import ExposureTerms

UNUSED = 1e6  # factor of the standard deviation of an outlier
NEARLY_FREE = 10.0  # factor of the standard deviations of the survey


def estimates_beside_free_points(
    network: Network, adjustment: Adjustment
) -> tuple[tuple[np.ndarray, np.ndarray], ...]:
    """Coefficients (p,) and their variances (p,) by fluoroscope, with points that are nearly free.

    network has additional parameters for each fluoroscope; it is linearised at the adjustment.
    Raises numpy.linalg.LinAlgError where it does not determine them.
    """
    free = replace(network, survey_sd_mm=NEARLY_FREE * network.survey_sd_mm)
    factor = adjustment.noise.information_factor(adjustment.q)
    equations = normal_equations(free, adjustment.parameters, 0.0, adjustment.noise, factor)
    matrix = factorize(free, equations)
    means = solved_additional(matrix, free, adjustment)
    informations = (information_of_additional(matrix, f) for f in range(len(means)))
    return tuple((mean, np.diagonal(np.linalg.inv(one))) for mean, one in zip(means, informations))


def variance_between_exposures(
    network: Network,
    adjustment: Adjustment,
    f: int,
    terms: ExposureTerms,
    coefficients: np.ndarray,
    covariance: np.ndarray,
) -> np.ndarray:
    """Variances [px^2] of image coordinates by terms of exposures, less what orientations absorb.

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
    (i,) ndarray
        Of the inliers among the image points of the fluoroscope.

    Raises
    ------
    numpy.linalg.LinAlgError
        Where the network does not determine orientations and object points.
    """
    variance = np.tile(terms.variance, terms.exposures)
    information = _information(network, adjustment, f, terms)
    expected = float(variance @ np.diagonal(information))
    if not expected > 0:
        return np.zeros(int(adjustment.inliers[network.rows(f)].sum()))
    found = float(coefficients @ information @ coefficients + np.sum(information * covariance))
    return found / expected * _variances_left(network, adjustment, f, terms)


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


def _variances_left(
    network: Network, adjustment: Adjustment, f: int, terms: ExposureTerms
) -> np.ndarray:
    """Expected squares (i,) [px^2] of the terms, without what orientations absorb, of inliers."""
    rows = network.rows(f)
    inliers = adjustment.inliers[rows]
    _, by_exterior, _, _ = project_with_jacobian(*network.per_image_point(adjustment.parameters))
    exposure = network.exposure[rows]
    squares = np.zeros(len(rows))
    for number in np.unique(exposure):
        at = inliers & (exposure == number)
        own = terms.functions.values[at].reshape(2 * int(at.sum()), -1)
        # In units in which the six unknowns matter alike.
        absorbed = by_exterior[rows[at]].reshape(len(own), -1)
        absorbed = absorbed / np.linalg.norm(absorbed, axis=0)
        left = own - absorbed @ np.linalg.lstsq(absorbed, own, rcond=None)[0]
        squares[at] = (left**2 @ terms.variance).reshape(-1, 2).mean(axis=1)
    return squares[inliers]
