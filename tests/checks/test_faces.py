# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Displaced faces of a phantom, and exposures of different noise."""

import numpy as np
import pytest

from fluoro_calib_ros.checks.bead_intersection import Beads
from fluoro_calib_ros.checks.beads import compare_with_survey, displaced_layer
from fluoro_calib_ros.checks.held_out import EXPOSURE_LIMIT, exposure_limits

SD_MM = 0.15


def plates(rng):
    """Two plates of 100 beads, at z = -60 and 60 mm."""
    axis = np.linspace(-110, 110, 10)
    x, y = (a.ravel() for a in np.meshgrid(axis, axis))
    return np.concatenate([np.column_stack([x, y, np.full(100, z)]) for z in (-60.0, 60.0)])


def cloud(rng):
    """Beads at random positions in a box."""
    return rng.uniform(-120, 120, (160, 3))


def beads_of(survey, displacement, rng):
    """Beads whose images show the survey plus a displacement (n, 3) [mm], with noise."""
    n = len(survey)
    found = survey + displacement + rng.normal(0, SD_MM, (n, 3))
    covariance = np.tile((SD_MM**2 - 0.1**2) * np.eye(3), (n, 1, 1))
    return Beads(np.arange(n), found, covariance, np.full(n, 4), survey, np.full(n, 0.1))


def test_a_plate_that_is_shifted_is_named():
    rng = np.random.default_rng(1)
    survey = plates(rng)
    shift = (survey[:, 2:] > 0) * np.array([0.0, 0.6, 0.8])
    # The orientations follow all beads, so half of the shift is seen in either plate.
    beads = beads_of(survey, shift - shift.mean(axis=0), rng)
    layer = displaced_layer(beads)
    assert layer.axis == 2 and set(layer.target_id) in ({*range(100)}, {*range(100, 200)})
    assert np.linalg.norm(layer.shift_mm) == pytest.approx(1.0, abs=0.1)
    check = compare_with_survey(beads)[0]
    assert check.passed is False and len(check.place.target_id) == 100
    assert check.numbers['shift_mm'] == pytest.approx(1.0, abs=0.1)


def test_a_plate_is_named_where_no_single_bead_stands_out():
    rng = np.random.default_rng(5)
    survey = plates(rng)
    shift = (survey[:, 2:] > 0) * np.array([0.4, 0.0, 0.0])
    check = compare_with_survey(beads_of(survey, shift - shift.mean(axis=0), rng))[0]
    assert check.passed is False and check.value == pytest.approx(0.4, abs=0.05)
    assert check.limit < 0.3 and 'shift_mm' in check.numbers


@pytest.mark.parametrize('along', [0, 1])
def test_a_plate_that_is_tilted_is_named(along):
    """By 1 mm at its rim, and not at all in its middle."""
    rng = np.random.default_rng(2)
    survey = plates(rng)
    tilt = np.where(survey[:, 2] > 0, survey[:, along] / 110.0, 0.0)[:, None] * [0, 0, 1.0]
    layer = displaced_layer(beads_of(survey, tilt, rng))
    assert layer.axis == 2 and len(layer.target_id) == 100
    assert layer.tilt_rad == pytest.approx(1 / 110, rel=0.1)
    assert np.linalg.norm(layer.shift_mm) < 0.2


def test_a_layer_is_displaced_alike_wherever_the_phantom_has_its_origin():
    survey = plates(None)
    tilt = np.where(survey[:, 2] > 0, survey[:, 0] / 110.0, 0.0)[:, None] * [0, 0, 1.0]
    tilt = tilt + (survey[:, 2:] > 0) * [0.5, 0, 0]
    here, there = (
        displaced_layer(beads_of(survey + origin, tilt, np.random.default_rng(2)))
        for origin in ([0, 0, 0], [300.0, -200, 900])
    )
    np.testing.assert_array_equal(there.target_id, here.target_id)
    np.testing.assert_allclose(there.shift_mm, here.shift_mm, atol=1e-6)
    assert there.tilt_rad == pytest.approx(here.tilt_rad)
    assert there.size_mm == pytest.approx(here.size_mm)


def test_an_inner_layer_is_named_with_its_bounds():
    rng = np.random.default_rng(3)
    survey = cloud(rng)
    inner = np.abs(survey[:, 1] - 20) < 25
    layer = displaced_layer(beads_of(survey, inner[:, None] * np.array([1.0, 0, 0]), rng))
    assert layer.axis == 1
    assert abs(layer.low + 5) < 10 and abs(layer.high - 45) < 10


@pytest.mark.parametrize('shape', [plates, cloud])
def test_single_beads_and_noise_are_no_layer(shape):
    for seed in range(5):
        rng = np.random.default_rng(seed)
        survey = shape(rng)
        none = np.zeros_like(survey)
        assert displaced_layer(beads_of(survey, none, rng)) is None
        none[rng.permutation(len(survey))[:4]] = 2.0
        beads = beads_of(survey, none, rng)
        assert displaced_layer(beads) is None
        check = compare_with_survey(beads)[0]
        assert 4 <= len(check.place.target_id) <= 5 and 'shift_mm' not in check.numbers
        worst = check.place.target_id[0]
        assert check.value == pytest.approx(2 * np.sqrt(3), abs=0.5)
        assert f'bead {worst} is wrong by {check.value:.1f} mm' in check.cause


@pytest.mark.parametrize('shape', [plates, cloud])
def test_errors_of_the_survey_select_no_layer(shape):
    """Beads of a plate that were surveyed too high do not form a layer."""
    rng = np.random.default_rng(6)
    for _ in range(20):
        true = shape(rng)
        survey = true + rng.normal(0, 0.1, true.shape)
        found = true + rng.normal(0, SD_MM, true.shape)
        covariance = np.tile(SD_MM**2 * np.eye(3), (len(true), 1, 1))
        count = len(true)
        beads = Beads(
            np.arange(count), found, covariance, np.full(count, 4), survey, np.full(count, 0.1)
        )
        assert displaced_layer(beads) is None


def test_noise_that_differs_between_exposures_accuses_none():
    """An exposure stands out only relative to the scatter of all exposures."""
    rng = np.random.default_rng(4)
    same = np.exp(rng.normal(0, 0.04, 15))
    assert np.all(exposure_limits(same, same) <= EXPOSURE_LIMIT * np.maximum(same, 1))
    moved = same.copy()
    moved[:3] = 2.5
    assert np.all(exposure_limits(moved, moved) == EXPOSURE_LIMIT)
    for _ in range(20):
        ratio = np.exp(rng.uniform(np.log(0.1), np.log(0.6), 15))
        ratio /= np.median(ratio)
        assert np.all(ratio < exposure_limits(ratio, ratio))
    for count in (6, 15, 60):
        ratios = np.exp(rng.normal(0, 0.3, (2000, count)))
        ratios /= np.median(ratios, axis=1, keepdims=True)
        accused = [np.any(ratio > exposure_limits(ratio, ratio)) for ratio in ratios]
        assert np.mean(accused) < 0.02


def test_a_misfit_accuses_an_exposure_however_much_the_others_scatter():
    """Its residuals agree with their neighbours, so they are not noise of this exposure."""
    rng = np.random.default_rng(5)
    ratio = np.exp(rng.uniform(np.log(0.1), np.log(0.6), 15))
    ratio /= np.median(ratio)
    ratio[4] = 2.0
    white = ratio.copy()
    assert np.all(ratio < exposure_limits(ratio, white))
    white[4] = 1.0
    assert ratio[4] > exposure_limits(ratio, white)[4]
