# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0
"""A survey that is strained as a whole is found; what the exposures cannot tell is said."""

import functools

import numpy as np
import pytest

from fluoro_calib_ros.checks.calibration_evidence import Evidence
from fluoro_calib_ros.checks.check import Check
from fluoro_calib_ros.checks.shape import check_shape, strain_of_survey, trusted_shape
from fluoro_calib_ros.estimation.calibrate import adjust_with_calibrations, calibrate
from fluoro_calib_ros.estimation.options import CalibrationOptions, CalibrationRequest
from fluoro_calib_ros.exposures.phantom import Phantom
from fluoro_calib_ros.findings import Kind, Severity
from fluoro_calib_ros.simulation.exposures import simulate_exposures
from fluoro_calib_ros.simulation.rig import virtual_rig

pytestmark = pytest.mark.long


@functools.cache
def rig():
    """A rig without distortion, and its exposures."""
    out = virtual_rig(1, strength=0.0, names=('a',))
    return out, simulate_exposures(out, 15, 1).frames


@functools.cache
def evidence(shrunk=0.0, seed=0):
    """Evidence on a calibration with a survey that is too short in z, with errors of its own."""
    rng = np.random.default_rng(seed)
    here, frames = rig()
    sd = here.phantom.sd_mm
    survey = here.true_mm * [1, 1, 1 - shrunk] + rng.normal(0, sd[:, None], (len(sd), 3))
    phantom = Phantom(here.phantom.target_id, survey, sd)
    options = CalibrationOptions(model='parametric', max_iterations=4)
    request = CalibrationRequest(frames, phantom, options)
    calibrations = calibrate(request.frames, phantom, options).calibrations
    result = adjust_with_calibrations(request.frames, phantom, calibrations)
    return Evidence(request, calibrations, result, lambda step: None)


@pytest.mark.parametrize('seed', [1, 2, 3])
def test_an_honest_survey_has_no_strain(seed):
    """The statistic is chi-square with five degrees of freedom, nearly."""
    (check,) = check_shape(evidence(seed=seed), ('a',))
    assert check.kind is Kind.SHAPE and check.passed
    assert check.numbers['test'] < 18  # 0.3 %
    assert trusted_shape([check]) == []


def test_a_phantom_that_is_short_in_one_axis_is_found_with_axis_and_size():
    """By 0.2 %, where no bead is off by more than three times the sd of its survey."""
    found = strain_of_survey(evidence(0.002))
    assert found.test > 3 * found.critical
    values, vectors = np.linalg.eigh(found.tensor)
    assert abs(vectors[2, 0]) > 0.95  # the shortest axis
    # Without the common scale, and less what the correction has followed.
    assert -0.002 < values[0] < -0.0007
    (check,) = check_shape(evidence(0.002), ('a',))
    assert check.passed is False and check.value > check.limit


def test_a_strain_that_nobody_would_see_is_taken_on_trust():
    numbers = {'hidden_strain': 4e-3, 'hidden_x': 1.0, 'hidden_y': 0.0, 'hidden_z': 0.0}
    for nse, expected in ((0.3, 0), (8.0, 1)):
        check = Check(Kind.SHAPE, '', numbers={**numbers, 'hidden_nse': nse}, value=0, limit=1)
        found = trusted_shape([check])
        assert [one.kind for one in found] == [Kind.TAKEN_ON_TRUST] * expected
        assert all(one.severity is Severity.NOTE for one in found)
