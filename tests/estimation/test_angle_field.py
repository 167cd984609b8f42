# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Distortion that changes with the angle of a C-arm."""

from dataclasses import replace

import numpy as np
import pytest
from rigs import calibrated, exposures, rig
from rigs import smooth_pincushion as simple_calibration
from rigs import turning as with_change
from turning_rig import CHANGE_PX, recording, turned, turning

from fluoro_calib_ros.correction.angle_field import MAX_DISTANCE, AngleField, harmonics
from fluoro_calib_ros.correction.base import CorrectionStatus
from fluoro_calib_ros.correction.calibration_record import HARMONICS, SD_GRID, VARIANCES
from fluoro_calib_ros.correction.series import Functions
from fluoro_calib_ros.errors import DataError
from fluoro_calib_ros.estimation.calibrate import adjust_with_calibrations, calibrate
from fluoro_calib_ros.estimation.exposure_terms import can_be_fitted

SIZE = (800, 600)
ANGLES = np.deg2rad([-80.0, -50.0, -35.0, -10.0, 5.0, 30.0, 60.0, 85.0])


def field(seed=0):
    """An AngleField with random coefficients."""
    rng = np.random.default_rng(seed)
    root = rng.normal(0, 0.1, (HARMONICS, HARMONICS))
    covariance = root @ root.T
    pairs = [covariance[j, k] for j in range(HARMONICS) for k in range(j, HARMONICS)]
    grids = np.zeros((VARIANCES, SD_GRID, SD_GRID))
    grids[HARMONICS:] = np.array(pairs)[:, None, None]
    return AngleField(SIZE, ANGLES, rng.normal(0, 0.5, (HARMONICS, 2, 10)), grids), covariance


@pytest.mark.parametrize('degree', [3, 5])
def test_a_series_at_an_angle_has_the_change_of_any_degree(degree):
    calibration = with_change(simple_calibration('a', (1024, 1024)), degree=degree)
    uv = np.random.default_rng(3).uniform(100, 900, (50, 2))
    angle = np.deg2rad(-25)
    one = calibration.correct(uv, exact=True, angle=angle)
    other = calibration.at_angle(angle).correct(uv, exact=True)
    np.testing.assert_allclose(one.uv, other.uv, atol=1e-9)


def test_harmonics_are_cosines_and_sines_of_the_angle_and_of_twice_it():
    a = 0.4
    expected = [np.cos(a), np.sin(a), np.cos(2 * a), np.sin(2 * a)]
    np.testing.assert_allclose(harmonics(a), expected)
    assert harmonics(np.zeros((3, 2))).shape == (3, 2, HARMONICS)


def test_change_is_the_sum_of_the_fields_of_all_harmonics():
    found, covariance = field()
    uv = np.random.default_rng(1).uniform(0, 1, (20, 2)) * SIZE
    angle = np.deg2rad(20)
    duv, variance = found.change(uv, angle)
    weights = harmonics(angle) - harmonics(ANGLES).mean(axis=0)
    expected = sum(
        w * Functions(SIZE, 3)(uv) @ part.T for w, part in zip(weights, found.coefficients)
    )
    np.testing.assert_allclose(duv, expected, atol=1e-12)
    np.testing.assert_allclose(variance, weights @ covariance @ weights)


def test_changes_of_the_exposures_have_mean_zero():
    found, _ = field()
    uv = np.array([[100.0, 200.0]])
    total = sum(found.change(uv, angle)[0] for angle in ANGLES)
    np.testing.assert_allclose(total, 0, atol=1e-12)


def test_unknown_angle_has_the_variance_of_all_exposures():
    found, _ = field()
    uv = np.array([[100.0, 200.0], [700.0, 50.0]])
    duv, variance = found.change(uv, np.nan)
    assert not duv.any()
    changes = np.array([found.change(uv, angle)[0] for angle in ANGLES])
    uncertain = np.mean([found.change(uv, angle)[1] for angle in ANGLES], axis=0)
    expected = np.mean(np.mean(changes**2, axis=0), axis=1) + uncertain
    np.testing.assert_allclose(variance, expected)


def test_an_angle_for_each_point_gives_the_same_as_one_angle_for_all():
    found, _ = field()
    uv = np.random.default_rng(2).uniform(0, 1, (6, 2)) * SIZE
    angles = np.array([0.1, np.nan, 0.1, -0.5, np.nan, 0.7])
    duv, variance = found.change(uv, angles)
    for i, angle in enumerate(angles):
        one, of_one = found.change(uv[i], angle)
        np.testing.assert_allclose(duv[i], one[0], atol=1e-12)
        np.testing.assert_allclose(variance[i], of_one[0])


def test_angles_far_from_all_exposures_are_not_covered():
    found, _ = field()
    assert found.covers(ANGLES[3] + 0.9 * MAX_DISTANCE)
    assert found.covers(ANGLES[3] + 2 * np.pi)
    assert found.covers(np.nan)
    np.testing.assert_array_equal(found.covers(np.deg2rad([0.0, 170.0])), [True, False])


@pytest.mark.parametrize(
    'angles, possible',
    [
        (ANGLES, True),
        (ANGLES[:3], False),
        (np.full(8, 0.3), False),
        (np.append(ANGLES, np.nan), False),
    ],
    ids=['enough', 'too few', 'all alike', 'one unknown'],
)
def test_angles_must_be_known_enough_and_different(angles, possible):
    assert can_be_fitted(angles) is possible


@pytest.mark.parametrize('name', ['angles', 'coefficients', 'variances'])
def test_damaged_content_is_refused(name):
    found, _ = field()
    for wrong in (getattr(found, name)[..., :-1][:0], np.full_like(getattr(found, name), np.nan)):
        with pytest.raises(ValueError, match=name):
            replace(found, **{name: wrong})


# ---- on the virtual rig: a field that changes with the C-arm angle


def rmse_of_test(calibration, frames):
    """RMSE [px] of exposures that were not used for the calibration."""
    job = adjust_with_calibrations({'a': frames}, rig().phantom, {'a': calibration})
    return float(np.linalg.norm(job.fluoroscopes['a'].rmse_after))


@pytest.mark.long
def test_calibration_with_angles_fits_exposures_at_other_angles():
    test = recording()[1]
    with_angle = rmse_of_test(turning().calibrations['a'], test)
    without = rmse_of_test(turning(False).calibrations['a'], recording(False)[1])
    at_rest = rmse_of_test(calibrated('a').calibrations['a'], exposures(22, seed=11)['a'][14:])
    assert with_angle < 1.1 * at_rest
    assert without > 1.2 * at_rest


@pytest.mark.long
def test_change_is_found_and_stated():
    calibration = turning().calibrations['a']
    found = calibration.angle_field
    uv = np.random.default_rng(3).uniform(150, 850, (200, 2))
    angles = (np.deg2rad(-40), np.deg2rad(55))
    one, other = (calibration.correction(uv, angle) for angle in angles)
    true = turned(uv, angles[1], calibration.image_size)
    true = true - turned(uv, angles[0], calibration.image_size)
    # The orientations of the exposures absorb the effect of a sensor rotation.
    error = other.duv - one.duv - true
    x, y = (uv - 511.5).T / 512
    zero = np.zeros_like(x)
    turns = [(-y, x), (zero + 1, zero), (zero, zero + 1), (x, y), (x * x, x * y), (x * y, y * y)]
    basis = np.stack([np.stack(t, axis=1) for t in turns], axis=2).reshape(-1, len(turns))
    left = error.ravel() - basis @ np.linalg.lstsq(basis, error.ravel(), rcond=None)[0]
    assert np.sqrt(np.mean(left**2)) < 0.12
    assert 0.1 * CHANGE_PX < found.size_px < 0.5 * CHANGE_PX  # CHANGE_PX is that at the corners


@pytest.mark.long
def test_constant_distortion_has_no_field_of_the_angle():
    frames = [
        replace(frame, angle=angle)
        for frame, angle in zip(exposures()['a'], np.linspace(-1.2, 1.2, 15))
    ]
    plain = calibrated('a').calibrations['a']
    found = calibrate({'a': frames}, rig().phantom).calibrations['a']
    assert found.angle_field is None
    np.testing.assert_array_equal(found.model.train_duv, plain.model.train_duv)


@pytest.mark.long
def test_points_are_corrected_at_their_angle():
    calibration = turning().calibrations['a']
    uv = np.array([[200.0, 300.0], [800.0, 700.0], [5000.0, 0.0]])
    angle = np.deg2rad(30)
    exact = calibration.correct(uv, exact=True, angle=angle)
    looked_up = calibration.correct(uv, angle=angle)
    np.testing.assert_allclose(looked_up.uv, exact.uv, atol=0.01)
    np.testing.assert_allclose(looked_up.sigma, exact.sigma, atol=0.01)
    assert looked_up.status.tolist() == [0, 0, CorrectionStatus.INVALID]
    unknown = calibration.correct(uv)
    assert (unknown.sigma[:2] > 1.1 * looked_up.sigma[:2]).all()
    assert np.abs(unknown.uv - looked_up.uv)[:2].max() > 0.2
    each = calibration.correct(uv, angle=[angle, np.nan, angle])
    np.testing.assert_allclose(each.uv[0], looked_up.uv[0])
    np.testing.assert_allclose(each.uv[1], unknown.uv[1])


@pytest.mark.long
def test_calibration_at_an_angle_gives_the_same_corrections_without_one():
    calibration = turning().calibrations['a']
    uv = np.random.default_rng(3).uniform(100, 900, (50, 2))
    angle = np.deg2rad(-25)
    at_angle = calibration.at_angle(angle)
    assert at_angle.angle_field is None
    assert at_angle.calibration_id != calibration.calibration_id
    one, two = calibration.correct(uv, exact=True, angle=angle), at_angle.correct(uv, exact=True)
    np.testing.assert_allclose(one.uv, two.uv, atol=1e-9)
    np.testing.assert_allclose(one.sigma, two.sigma, atol=1e-3)
    assert calibration.at_angle(None) is calibration
    with pytest.raises(DataError, match='180 degrees is too far from the angles'):
        calibration.at_angle(np.pi)


@pytest.mark.long
def test_points_at_an_angle_that_was_not_calibrated_are_outside():
    calibration = turning().calibrations['a']
    found = calibration.correct([[500.0, 500.0]], angle=np.pi)
    assert found.status.tolist() == [CorrectionStatus.OUTSIDE]
