# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0
"""A survey that is strained as a whole is found; strain that exposures cannot show is stated."""

import functools
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from fluoro_calib_ros.checks import shape
from fluoro_calib_ros.checks.calibration_evidence import Evidence
from fluoro_calib_ros.checks.check import Check
from fluoro_calib_ros.checks.shape import (
    Strain,
    _strains,
    _strains_that_show,
    _without_similarity,
    check_shape,
    strain_of_survey,
    trusted_shape,
)
from fluoro_calib_ros.estimation.calibrate import adjust_with_calibrations, calibrate
from fluoro_calib_ros.estimation.options import CalibrationOptions, CalibrationRequest
from fluoro_calib_ros.exposures.phantom import Phantom
from fluoro_calib_ros.findings import Kind, Severity
from fluoro_calib_ros.simulation.rig import simulate_exposures, virtual_rig


@functools.cache
def rig():
    """A rig without distortion, and its exposures."""
    out = virtual_rig(1, strength=0.0, names=('a',))
    return out, simulate_exposures(out, 15, 1).frames


def with_targets(frame, ids):
    """A frame with these targets only."""
    used = np.isin(frame.target_id, ids)
    return replace(frame, target_id=frame.target_id[used], uv=frame.uv[used])


@functools.cache
def evidence(shrunk=0.0, seed=0, small=False):
    """Evidence on a calibration with a survey that is too short in z and has random errors.

    small: use every sixth bead in six exposures, without a correction.
    """
    rng = np.random.default_rng(seed)
    here, frames = rig()
    options = CalibrationOptions(model='parametric', max_iterations=4)
    ids, true, sd = here.phantom.target_id, here.true_mm, here.phantom.sd_mm
    if small:
        options = CalibrationOptions(model='none')
        ids, true, sd = ids[::6], true[::6], sd[::6]
        frames = {'a': [with_targets(frame, ids) for frame in frames['a'][:6]]}
    survey = true * [1, 1, 1 - shrunk] + rng.normal(0, sd[:, None], (len(sd), 3))
    phantom = Phantom(ids, survey, sd)
    request = CalibrationRequest(frames, phantom, options)
    calibrations = calibrate(request.frames, phantom, options).calibrations
    result = adjust_with_calibrations(request.frames, phantom, calibrations)
    return Evidence(request, calibrations, result, lambda step: None)


@pytest.mark.long
@pytest.mark.parametrize('seed', [1, 2, 3])
def test_an_honest_survey_has_no_strain(seed):
    """The statistic is approximately chi-square with five degrees of freedom."""
    (check,) = check_shape(evidence(seed=seed), ('a',))
    assert check.kind is Kind.SHAPE and check.passed
    assert check.numbers['test'] < 18  # exceeded in 0.3 % of cases
    assert trusted_shape([check]) == []


@pytest.mark.long
def test_a_phantom_that_is_short_in_one_axis_is_found_with_axis_and_size():
    """It is short by 0.2 %, so no bead is off by more than three sd of its survey."""
    found = strain_of_survey(evidence(0.002))
    assert found.test > 3 * found.critical
    values, vectors = np.linalg.eigh(found.tensor)
    assert abs(vectors[2, 0]) > 0.95  # the shortest axis
    # The common scale is removed, and the correction has followed a part.
    assert -0.002 < values[0] < -0.0007
    (check,) = check_shape(evidence(0.002), ('a',))
    assert check.passed is False and check.value > check.limit


def test_strain_is_that_of_the_normal_equations_and_what_hides_most_is_told(monkeypatch):
    rng = np.random.default_rng(7)
    survey = rng.uniform(-50, 50, (20, 3)) + [300, 0, 0]
    root, pull = rng.normal(size=(5, 5)), 100 * rng.normal(size=5)
    information = 1e4 * (root @ root.T + np.eye(5))
    followed, sd = rng.normal(size=(20, 3, 5)), rng.uniform(0.1, 0.3, (20, 3))
    score = shape._Score(information, pull, followed)
    monkeypatch.setattr(shape, '_score', lambda evidence, solved, displacement: score)
    network = SimpleNamespace(survey_mm=survey, datum='survey', survey_sd_mm=np.full(20, 0.1))
    solved = SimpleNamespace(measured=SimpleNamespace(network=network))
    covariance = np.einsum('na,ab->nab', sd**2, np.eye(3))
    result = SimpleNamespace(solved={'a': solved}, targets=SimpleNamespace(covariance=covariance))
    found = strain_of_survey(SimpleNamespace(result=result, variations={'a': None}))
    tensors, _ = shape._strains(survey)
    own, hidden = (
        np.einsum('tab,ab->t', tensors, tensor) for tensor in (found.tensor, found.hidden)
    )

    def increase(strain):
        return np.mean(np.sum((followed @ strain / sd) ** 2, axis=1)) / 3

    np.testing.assert_allclose(own, np.linalg.solve(information, pull))
    assert found.test == pytest.approx(own @ pull)
    # The mean is over three coordinates.
    assert found.nse == pytest.approx(increase(own))
    assert hidden @ information @ hidden == pytest.approx(found.critical)
    assert increase(hidden) == pytest.approx(found.hidden_nse)
    for other in rng.normal(size=(50, 5)):
        other *= np.sqrt(found.critical / (other @ information @ other))
        assert increase(other) <= found.hidden_nse
    offset = survey - survey.mean(axis=0)
    moved = offset @ found.tensor
    # An upper bound: the part that a similarity absorbs is no strain.
    assert 0 < found.rms_mm <= np.sqrt(np.mean(np.sum(moved**2, axis=1)))


def test_a_strain_that_nobody_would_see_is_taken_on_trust():
    numbers = {'hidden_strain': 4e-3, 'hidden_x': 1.0, 'hidden_y': 0.0, 'hidden_z': 0.0}
    for nse, expected in ((0.3, 0), (8.0, 1)):
        check = Check(Kind.SHAPE, '', numbers={**numbers, 'hidden_nse': nse}, value=0, limit=1)
        found = trusted_shape([check])
        assert [one.kind for one in found] == [Kind.TAKEN_ON_TRUST] * expected
        assert all(one.severity is Severity.NOTE for one in found)


@pytest.mark.parametrize(
    ('test', 'nse', 'limit'),
    [
        (40.0, 1.0, 0.2 * np.sqrt(20 / 40)),  # limit set by chance
        (40.0, 0.3, 0.2 * np.sqrt(0.25 / 0.3)),  # limit set by what matters
        (5.0, 1.0, 0.4),
    ],
)
def test_strain_is_compared_with_what_chance_exceeds_and_what_matters(
    monkeypatch, test, nse, limit
):
    axis = np.array([1.0, 2.0, -2.0]) / 3
    found = Strain(
        np.diag([-3e-3, 1e-3, 2e-3]),
        rms_mm=0.2,
        test=test,
        critical=20.0,
        nse=nse,
        hidden_nse=3.0,
        hidden=5e-3 * np.outer(axis, axis),
    )
    monkeypatch.setattr(shape, 'strain_of_survey', lambda evidence: found)
    (check,) = check_shape(None, ('a',))
    assert (check.value, check.limit) == (0.2, pytest.approx(limit))
    assert check.numbers['strain'] == pytest.approx(-3e-3) and '-0.300 %' in check.cause
    assert '(1.00, 0.00, 0.00)' in check.cause and '0.200 mm' in check.cause
    hidden = [check.numbers[f'hidden_{coordinate}'] for coordinate in 'xyz']
    np.testing.assert_allclose(np.abs(hidden), np.abs(axis), atol=1e-12)
    assert check.numbers['hidden_strain'] == pytest.approx(5e-3)
    (trusted,) = trusted_shape([check])
    assert trusted.numbers == {'strain': pytest.approx(5e-3), 'nse': 3.0}
    assert '0.50 %' in trusted.cause and '2.0 times' in trusted.cause
    monkeypatch.setattr(shape, 'strain_of_survey', lambda evidence: None)
    assert check_shape(None, ('a',)) == []


@pytest.mark.parametrize(('beads', 'datum'), [(9, 'survey'), (10, 'inner')])
def test_few_beads_and_free_networks_have_no_strain_of_a_survey(beads, datum):
    network = SimpleNamespace(survey_mm=np.eye(beads, 3), datum=datum)
    solved = SimpleNamespace(measured=SimpleNamespace(network=network))
    given = SimpleNamespace(result=SimpleNamespace(solved={'a': solved}))
    assert strain_of_survey(given) is None


def test_strain_of_a_small_set_has_axis_and_size():
    """0.4 % in one axis, less the third that is a common scale."""
    found = strain_of_survey(evidence(0.004, small=True))
    values, vectors = np.linalg.eigh(found.tensor)
    assert abs(vectors[2, 0]) > 0.99
    assert values == pytest.approx([-0.00267, 0.00133, 0.00133], abs=4e-4)
    assert np.trace(found.tensor) == pytest.approx(0.0, abs=1e-9)
    honest = strain_of_survey(evidence(small=True))
    assert found.test > 10 * honest.test and honest.test < 18  # chi-square, five degrees: 0.3 %
    (check,) = check_shape(evidence(small=True), ('a',))
    assert check.kind is Kind.SHAPE and check.passed and check.value < check.limit


def test_a_flat_phantom_has_two_strains():
    """A strain along its normal acts as a rotation or a scale, which no image shows."""
    rng = np.random.default_rng(3)
    survey = np.column_stack([rng.uniform(-90, 90, (40, 2)), np.zeros(40)])
    tilt = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    for beads, count in ((survey, 2), (survey @ tilt.T + 500, 2), (rng.normal(size=(40, 3)), 5)):
        displacement = _without_similarity(_strains(beads)[1], beads, np.full(40, 0.1))
        assert _strains_that_show(displacement).shape == (5, count)
        # Shift, rotation and scale are removed completely.
        offset = beads - beads.mean(axis=0)
        assert np.einsum('nai->ai', displacement) == pytest.approx(0.0, abs=1e-9)
        assert np.einsum('nai,na->i', displacement, offset) == pytest.approx(0.0, abs=1e-6)
        turns = np.cross(offset[:, :, None], displacement, axisa=1, axisb=1)
        assert turns.sum(axis=0) == pytest.approx(0.0, abs=1e-6)
