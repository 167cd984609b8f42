# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Backgrounds of windows beyond a polynomial: eliminated as by a covariance, and estimated."""

from __future__ import annotations

import numpy as np
import pytest

from fluoro_calib_ros.images.light import Cosines
from fluoro_calib_ros.images.shadow_fit import window_offsets

OFFSET = window_offsets(8.0)
COSINES = Cosines(OFFSET, np.float64)
PIXELS = len(OFFSET)


def windows(count: int, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return light behind beads (g, m), derivatives (g, 7, m) and weights (g, m)."""
    rng = np.random.default_rng(seed)
    x, y = OFFSET.T / 8
    relative = np.broadcast_to(1 - 0.5 * np.exp(-4 * (x * x + y * y)), (count, PIXELS))
    background = np.stack([np.ones(PIXELS), x, y, x * x, x * y, y * y]) * relative[0]
    jacobian = np.stack([np.vstack([background, rng.normal(size=PIXELS)]) for _ in range(count)])
    return relative, jacobian, rng.uniform(0.5, 2.0, (count, PIXELS))


def test_elimination_is_weighting_by_the_covariance_of_the_background():
    relative, jacobian, weight = windows(2, 1)
    residual = np.random.default_rng(2).normal(size=(2, PIXELS))
    strength = np.array([0.7, 20.0])
    taken = COSINES.eliminated(
        strength, relative=relative, jacobian=jacobian, weight=weight, residual=residual
    )
    for k in range(2):
        waves = relative[k] * COSINES.waves
        covariance = np.diag(1 / weight[k])
        covariance += strength[k] * (waves.T * COSINES.variance) @ waves
        inverse = np.linalg.inv(covariance)
        left = (jacobian[k] * weight[k]) @ jacobian[k].T - taken[0][k]
        right = jacobian[k] @ (weight[k] * residual[k]) - taken[1][k]
        squared = residual[k] @ (weight[k] * residual[k]) - taken[2][k]
        assert left == pytest.approx(jacobian[k] @ inverse @ jacobian[k].T, rel=1e-6)
        assert right == pytest.approx(jacobian[k] @ inverse @ residual[k], rel=1e-6, abs=1e-6)
        assert squared == pytest.approx(residual[k] @ inverse @ residual[k], rel=1e-6)


@pytest.mark.parametrize('true', [1.0, 30.0])
def test_strengths_are_those_of_the_backgrounds(true):
    relative, jacobian, weight = windows(200, 3)
    rng = np.random.default_rng(4)
    amplitude = rng.normal(size=(200, len(COSINES.variance))) * np.sqrt(true * COSINES.variance)
    residual = relative * (amplitude @ COSINES.waves) + rng.normal(size=relative.shape) / np.sqrt(
        weight
    )
    spectra = COSINES.spectra(relative, jacobian=jacobian, weight=weight, residual=residual)
    assert np.median(spectra.strengths(1.0).variance) == pytest.approx(true, rel=0.5)


def test_noise_alone_has_no_background():
    relative, jacobian, weight = windows(200, 5)
    residual = np.random.default_rng(6).normal(size=relative.shape) / np.sqrt(weight)
    spectra = COSINES.spectra(relative, jacobian=jacobian, weight=weight, residual=residual)
    assert np.count_nonzero(spectra.strengths(1.0).variance) <= 2


@pytest.mark.parametrize('scale', [0.5, 4.0])
def test_backgrounds_of_some_windows_are_found_whatever_the_noise(scale):
    relative, jacobian, weight = windows(200, 7)
    rng = np.random.default_rng(8)
    residual = rng.normal(size=relative.shape) / np.sqrt(weight) * np.sqrt(scale)
    amplitude = rng.normal(size=(60, len(COSINES.variance)))
    amplitude *= np.sqrt(30.0 * scale * COSINES.variance)
    residual[:60] += relative[:60] * (amplitude @ COSINES.waves)
    spectra = COSINES.spectra(relative, jacobian=jacobian, weight=weight, residual=residual)
    found = spectra.strengths(1.0).variance
    # In units of the noise variance that the weights imply.
    assert np.log2(np.median(found[:60]) / 30.0) == pytest.approx(0, abs=1)
    assert np.count_nonzero(found[:60]) >= 54
    assert np.count_nonzero(found[60:]) <= 3


def test_slow_waves_of_correlated_noise_are_no_background():
    relative, jacobian, weight = windows(200, 9)
    rng = np.random.default_rng(10)
    side = 2 * int(OFFSET.max()) + 1
    white = rng.normal(size=(200, side + 2, side + 2))
    rows, columns = (OFFSET - OFFSET.min()).T[::-1]
    summed = sum(white[:, i : i + side, j : j + side] for i in range(3) for j in range(3)) / 3
    residual = summed[:, rows, columns] / np.sqrt(weight)
    spectra = COSINES.spectra(relative, jacobian=jacobian, weight=weight, residual=residual)
    assert np.count_nonzero(spectra.strengths(1.0).variance) > 150
    assert np.count_nonzero(spectra.strengths(9.0).variance) <= 2


@pytest.mark.parametrize('direction', [0.0, 0.6])
def test_a_straight_edge_has_more_evidence_than_a_background_without_direction(direction):
    relative, jacobian, weight = windows(100, 11)
    rng = np.random.default_rng(12)
    across = OFFSET @ [np.cos(direction), np.sin(direction)]
    edge = 8 * np.maximum(across - rng.uniform(-4, 4, 100)[:, None], 0)
    residual = relative * edge + rng.normal(size=relative.shape) / np.sqrt(weight)

    def evidence(cosines):
        spectra = cosines.spectra(relative, jacobian=jacobian, weight=weight, residual=residual)
        return spectra.strengths_at(1.0, 1.0).evidence

    without = evidence(COSINES)
    assert np.mean(evidence(Cosines(OFFSET, np.float64, direction)) > without) > 0.9
    # In a wrong direction it has not.
    assert np.mean(evidence(Cosines(OFFSET, np.float64, direction + 1.0)) > without) < 0.1
