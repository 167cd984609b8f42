# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""A correction plus a change of it."""

import numpy as np
import pytest
from rigs import calibrated, create_model, rig, true_calibrations

from fluoro_calib_ros.correction.base import CorrectionModel
from fluoro_calib_ros.correction.calibration_record import SD_GRID
from fluoro_calib_ros.correction.fluoroscope_calibration import with_drift, with_larger_sd
from fluoro_calib_ros.correction.series import Functions, Series
from fluoro_calib_ros.errors import DataError

SIZE = (1024, 1024)


def random_series(seed, functions, sd):
    rng = np.random.default_rng(seed)
    return Series(functions, rng.normal(size=(2, len(functions))), np.full((SD_GRID,) * 2, sd))


def test_sum_of_series_is_the_sum_of_their_corrections():
    """Degrees, numbers of sines and radial polynomials differ; the errors are independent."""
    one = random_series(1, Functions(SIZE, 2, 7, rings=1), 0.3)
    other = random_series(2, Functions(SIZE, 3, 4), 0.4)
    uv = np.random.default_rng(3).uniform(0, 1023, (50, 2))
    total = one.plus(other)
    np.testing.assert_allclose(total.predict(uv), one.predict(uv) + other.predict(uv), atol=1e-8)
    np.testing.assert_allclose(total.sd, 0.5)


def test_calibration_with_a_drift_corrects_by_it_too():
    calibration = calibrated('a', 6, max_iterations=2).calibrations['a']
    drift = random_series(4, Functions(SIZE, 3, 4), 0.2)
    changed = with_drift(calibration, drift.functions, drift.coefficients, drift.sd)
    uv = np.random.default_rng(5).uniform(300, 700, (40, 2))
    before = calibration.correct(uv, exact=True)
    after = changed.correct(uv, exact=True)
    np.testing.assert_allclose(before.uv - after.uv, drift.predict(uv), atol=1e-8)
    learned = changed.model.train_duv - calibration.model.train_duv
    np.testing.assert_allclose(learned, drift.predict(calibration.model.train_uv), atol=1e-12)
    assert changed.calibration_id != calibration.calibration_id
    assert (after.sigma > before.sigma).all()
    without = true_calibrations(rig().fluoroscopes)['a']
    with pytest.raises(DataError, match='has no field of standard deviations'):
        with_drift(without, drift.functions, drift.coefficients, drift.sd)


def test_calibration_with_a_larger_standard_deviation_corrects_as_before():
    """The larger sd applies; a repetition, or a model without sd, changes nothing."""
    calibration = calibrated('a', 6, max_iterations=2).calibrations['a']
    sd = np.linspace(0, 2 * calibration.model.series.sd.max(), SD_GRID**2).reshape(SD_GRID, -1)
    changed = with_larger_sd(calibration, sd)
    uv = np.random.default_rng(5).uniform(300, 700, (40, 2))
    before, after = (one.correct(uv, exact=True) for one in (calibration, changed))
    np.testing.assert_array_equal(after.uv, before.uv)
    np.testing.assert_array_equal(
        changed.model.series.sd, np.maximum(calibration.model.series.sd, sd)
    )
    assert (after.sigma >= before.sigma).all() and (after.sigma > before.sigma).any()
    assert changed.calibration_id != calibration.calibration_id
    assert with_larger_sd(changed, sd) is changed
    without = true_calibrations(rig().fluoroscopes)['a']
    assert with_larger_sd(without, sd) is without


def test_work_grows_with_points_and_functions():
    calibration = calibrated('a', 6, max_iterations=2).calibrations['a']
    drift = random_series(4, Functions(SIZE, 3, 4), 0.2)
    changed = with_drift(calibration, drift.functions, drift.coefficients, drift.sd).model
    plain = create_model('local_linear', 6, changed.train_uv, changed.train_duv, 0.2, 0.0)
    uv = np.random.default_rng(5).uniform(300, 700, (40, 2))
    count = len(changed.series.functions)
    assert count > 1
    assert CorrectionModel.bulk_work(changed, uv, np.inf) == 40 * count
    assert CorrectionModel.bulk_work(plain, uv, np.inf) == 40
