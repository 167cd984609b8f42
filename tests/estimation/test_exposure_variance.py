# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""How far the distortion of a later exposure differs: what object points can absorb is not it."""

from dataclasses import replace

import numpy as np
import pytest
import rigs

from fluoro_calib_ros.estimation.collocation import CollocationTerms
from fluoro_calib_ros.estimation.estimator import AdjustmentProblem, GaugeKind
from fluoro_calib_ros.estimation.exposure_terms import (
    ExposureTerms,
    estimates_beside_free_points,
    exposure_functions,
    variance_between_exposures,
)
from fluoro_calib_ros.photogrammetry.adjustment import adjust
from fluoro_calib_ros.photogrammetry.collinearity import (
    AdditionalParameters,
    project,
    project_with_jacobian,
)
from fluoro_calib_ros.photogrammetry.elimination import factorize
from fluoro_calib_ros.photogrammetry.noise import Noise
from fluoro_calib_ros.photogrammetry.normal_equations import normal_equations
from fluoro_calib_ros.photogrammetry.precision import information_of_additional

SIZE = (1024, 1024)
SIZE_PX = 0.5
EXPOSURES = 10


@pytest.fixture(scope='module')
def case():
    """Network, its adjustment and derivatives, and terms of the exposures."""
    network, true = rigs.small_network(EXPOSURES, 80, survey_sd_mm=0.2, free=False, seed=3)
    found = adjust(network, true, np.zeros_like(network.uv), Noise('gaussian', 0.3))
    _, by_exterior, by_point, _ = project_with_jacobian(*network.per_image_point(found.parameters))
    functions = exposure_functions(network.uv, SIZE, found.parameters.interior[0])
    return (
        network,
        found,
        by_exterior,
        by_point,
        ExposureTerms(functions, network.exposure, SIZE_PX),
    )


def mean_square_left(network, by_exterior, values):
    """Mean square of values (N, 2) without what the orientation of each exposure absorbs."""
    square = 0.0
    for number in range(network.n_exposures):
        at = network.exposure == number
        y = values[at].ravel()
        a = by_exterior[at].reshape(len(y), -1)
        a = a / np.linalg.norm(a, axis=0)
        square += np.sum((y - a @ np.linalg.lstsq(a, y, rcond=None)[0]) ** 2)
    return square / values.size


def test_terms_that_differ_at_random_have_their_own_size(case):
    network, found, by_exterior, _, terms = case
    rng = np.random.default_rng(1)
    exact = np.zeros((terms.count, terms.count))
    ratios = []
    for _ in range(10):
        coefficients = rng.normal(0, np.sqrt(np.tile(terms.variance, terms.exposures)))
        true = mean_square_left(network, by_exterior, terms.values @ coefficients)
        got = variance_between_exposures(network, found, 0, terms, coefficients, exact).mean()
        ratios.append(got / true)
    assert np.mean(ratios) == pytest.approx(1, abs=0.05)
    assert np.std(ratios) < 0.1
    # Coefficients that are only known to be within their prior are as large as it says.
    prior = np.diag(np.tile(terms.variance, terms.exposures))
    got = variance_between_exposures(network, found, 0, terms, np.zeros(terms.count), prior).mean()
    draws = [rng.normal(0, np.sqrt(np.diagonal(prior))) for _ in range(20)]
    expected = np.mean([mean_square_left(network, by_exterior, terms.values @ c) for c in draws])
    assert got == pytest.approx(expected, rel=0.1)


def test_a_phantom_that_has_shrunk_is_no_variation(case):
    network, found, by_exterior, by_point, terms = case
    loose = replace(network, survey_sd_mm=np.full(network.n_points, 3.0))
    shrunk = network.survey_mm * [2e-3, -2e-3, 0]
    shift = np.einsum('nak,nk->na', by_point, shrunk[network.point])
    values = terms.values.reshape(2 * len(shift), -1)
    coefficients = np.linalg.lstsq(values, shift.ravel(), rcond=None)[0]
    like_variation = terms.values @ coefficients
    scale = np.sqrt(np.mean(like_variation**2))
    assert scale > 0.1  # the terms can follow it
    exact = np.zeros((terms.count, terms.count))
    got = variance_between_exposures(loose, found, 0, terms, coefficients, exact).mean()
    assert got < 0.3 * mean_square_left(network, by_exterior, like_variation)


def estimated_size(network, true):
    """Size of the terms of exposures [px] after some renewals, and by estimates under the survey.

    The errors of the survey are taken to be independent there.
    """
    sizes = []
    for beside_free_points in (True, False):
        functions = exposure_functions(network.uv, SIZE, true.interior[0])
        terms = ExposureTerms(functions, network.exposure, SIZE_PX)
        start = replace(true, additional=(np.zeros(terms.count),))
        for _ in range(8):
            own = AdditionalParameters(
                np.zeros((len(network.uv), 0)), np.diag(terms.precision), terms.functions
            )
            varying = replace(network, additional=(own,))
            found = adjust(varying, start, noise=Noise('gaussian', 0.3))
            if beside_free_points:
                mean, variance = estimates_beside_free_points(varying, found)[0]
            else:
                mean = found.parameters.additional[0]
                matrix = factorize(
                    varying, normal_equations(varying, found.parameters, 0.0, found.noise)
                )
                variance = np.diagonal(np.linalg.inv(information_of_additional(matrix, 0)))
            terms.renew(mean, variance)
        sizes.append(terms.size_px)
    return sizes


def test_a_bent_phantom_makes_no_terms_of_exposures():
    network, true = rigs.small_network(EXPOSURES, 80, survey_sd_mm=0.05, free=False, seed=3)
    x, y, z = true.points_mm.T / np.max(np.abs(true.points_mm))
    bent = true.points_mm + 0.4 * np.stack([y * z, x * z, x * y], axis=1)
    true = replace(true, points_mm=bent)
    rng = np.random.default_rng(4)
    noise = rng.normal(0, 0.3, network.uv.shape) * network.sigma[:, None]
    uv = project(*network.per_image_point(true)) + noise
    free, surveyed = estimated_size(replace(network, uv=uv), true)
    assert free < 0.5 * surveyed


def test_terms_of_exposures_are_found_beside_free_points(case):
    network, found, _, _, terms = case
    rng = np.random.default_rng(2)
    coefficients = rng.normal(0, np.sqrt(np.tile(terms.variance, terms.exposures)))
    varying = replace(network, uv=network.uv + terms.values @ coefficients)
    free, surveyed = estimated_size(varying, found.parameters)
    assert free == pytest.approx(SIZE_PX, rel=0.15)
    assert surveyed == pytest.approx(SIZE_PX, rel=0.15)


def test_a_self_calibration_renews_its_terms_of_exposures_until_they_settle(case):
    network, found, _, _, true = case
    rng = np.random.default_rng(5)
    coefficients = rng.normal(0, np.sqrt(true.variance), (EXPOSURES, len(true.variance)))
    network = replace(network, uv=network.uv + true.values @ coefficients.ravel())
    problem = AdjustmentProblem(network, [SIZE], found, (GaugeKind.FULL,))
    terms = CollocationTerms(problem, modes=0)
    terms._refinements = []
    terms.parts[0].own = ExposureTerms(true.functions.values, network.exposure, 0.3 * SIZE_PX)
    parameters = replace(found.parameters, additional=terms.zeros())
    sizes = []
    for _ in range(5):
        varying = terms.with_additional(network)
        adjusted = adjust(varying, parameters, noise=Noise('gaussian', 0.3))
        parameters = adjusted.parameters
        matrix = factorize(varying, normal_equations(varying, parameters, 0.0, adjusted.noise))
        terms.renew(varying, matrix, adjusted)
        sizes.append(terms.parts[0].own.size_px)
    # The mean over the exposures is no difference between them.
    there = np.sqrt(np.sum(np.var(coefficients, axis=0, ddof=1)))
    assert sizes[-1] == pytest.approx(there, rel=0.1)
    assert sizes[-1] == sizes[-2]
