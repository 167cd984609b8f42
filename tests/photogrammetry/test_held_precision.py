# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Covariances of adjustments whose fixed interior orientations are uncertain."""

from dataclasses import replace

import numpy as np
import pytest
import rigs

from fluoro_calib_ros.photogrammetry.adjustment import adjust
from fluoro_calib_ros.photogrammetry.noise import Noise
from fluoro_calib_ros.photogrammetry.precision import precision, precision_with_fixed_interiors

NOISE = Noise('gaussian', 0.3)
SD_PX = np.array([2.0, 3.0, 4.0])  # standard deviations of xp, yp and c


def held(network, truth, interior, noise=0.0):
    """Adjustment of noisy observations with the interior orientation fixed."""
    network = replace(network, uv=network.uv + noise)
    start = replace(truth, interior=interior)
    return network, adjust(network, start, noise=NOISE)


@pytest.mark.parametrize('shape', [dict(exposures=3, targets=20), dict(exposures=12, targets=8)])
def test_covariances_are_those_of_consider_parameters(shape):
    """N^-1 + J S J^T by dense matrices, for both orders of elimination."""
    network, truth = rigs.small_network(**shape, free=False)
    covariance = np.diag(SD_PX**2) + 0.5
    network, result = held(network, truth, truth.interior)
    precise = precision(network, result)
    found = precision_with_fixed_interiors(network, result, 0.0, precise, covariance[None])
    m, n = network.n_exposures, network.n_points
    everything = rigs.dense_normal_matrix(replace(network, interior_free=[True]), result)
    own = slice(6 * m + 3 * n)
    inverse = np.linalg.inv(everything[own, own])
    moved = -inverse @ everything[own, own.stop :]
    expected = inverse + moved @ covariance @ moved.T
    for j in range(m):
        part = slice(6 * j, 6 * j + 6)
        np.testing.assert_allclose(found.exterior[j], expected[part, part], rtol=1e-4, atol=1e-9)
    points = slice(6 * m, 6 * m + 3 * n)
    np.testing.assert_allclose(found.joint_points, expected[points, points], rtol=1e-4, atol=1e-9)
    np.testing.assert_allclose(found.interior[0], covariance, rtol=1e-6)
    np.testing.assert_array_equal(found.redundancy, precise.redundancy)


def test_errors_of_sources_agree_with_their_covariances():
    """Monte Carlo over noise, survey and the error of the fixed interior orientation."""
    rng = np.random.default_rng(3)
    squares = []
    without = []
    for seed in range(40):
        network, truth = rigs.small_network(exposures=3, targets=25, free=False, seed=seed)
        interior = truth.interior + rng.normal(0, SD_PX)
        network, result = held(network, truth, interior)
        known = precision(network, result)
        precise = precision_with_fixed_interiors(
            network, result, 0.0, known, np.diag(SD_PX**2)[None]
        )
        error = result.parameters.position_mm - truth.position_mm
        for out, one in ((squares, precise), (without, known)):
            covariance = one.exterior[:, :3, :3]
            out.append(np.einsum('na,nab,nb->n', error, np.linalg.inv(covariance), error) / 3)
    assert np.mean(squares) == pytest.approx(1.0, abs=0.25)
    assert np.mean(without) > 2.0
