# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Verdict on calibrations of a rotating C-arm."""

from dataclasses import replace

import numpy as np
import pytest
from rigs import rig
from turning_rig import recording, turning

from fluoro_calib_ros.checks import verdict as verdict_module
from fluoro_calib_ros.checks.field_checks import VARIATION
from fluoro_calib_ros.checks.verdict import validate
from fluoro_calib_ros.estimation.options import CalibrationRequest
from fluoro_calib_ros.findings import Kind
from fluoro_calib_ros.jobs.calibration import run_calibration


def verdict(known):
    """Verdict on the calibration with known or unknown angles."""
    request = CalibrationRequest({'a': recording(known)[0]}, rig().phantom)
    return validate(request, turning(known).calibrations)


@pytest.mark.long
def test_calibration_with_known_angles_passes():
    found = verdict(known=True)
    assert found.verdict == 'pass', found.findings
    of_angles = [one for one in found.notes if one.place.fluoroscopes == ('a',)]
    assert [one.kind for one in of_angles] == [Kind.TAKEN_ON_TRUST]


@pytest.mark.long
def test_calibration_with_unknown_angles_fails_and_is_told_to_give_them(monkeypatch):
    monkeypatch.setattr(verdict_module, 'SUBJECTS', (VARIATION,))
    found = verdict(known=False)
    assert found.verdict == 'fail'
    (check,) = [check for check in found.findings if check.kind is Kind.VARIATION]
    assert np.isnan(check.numbers['angle_range_deg']) and 'angle_deg' in check.advice


@pytest.mark.long
@pytest.mark.parametrize(
    ('change', 'cause'),
    [
        (np.deg2rad, 'angles of the C-arm that are in radians'),
        (lambda angles: np.roll(angles, 1), 'angles of the C-arm that belong to other'),
    ],
)
def test_wrong_angles_fail_with_their_cause(change, cause, monkeypatch):
    monkeypatch.setattr(verdict_module, 'SUBJECTS', (VARIATION,))
    frames = recording(True)[0]
    angles = change(np.array([frame.angle for frame in frames]))
    wrong = [replace(frame, angle=float(angle)) for frame, angle in zip(frames, angles)]
    outcome = run_calibration(CalibrationRequest({'a': wrong}, rig().phantom), validate=True)
    assert outcome.validation.verdict == 'fail'
    assert any(cause in check.advice for check in outcome.validation.findings)
