# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Verdict on a calibration: good ones pass, faults are found and named."""

import functools
import json
import pathlib
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from rigs import calibrated, exposures, rig, run

from fluoro_calib_ros.checks import verdict as verdict_module
from fluoro_calib_ros.checks.bead_intersection import (
    Beads,
    distances,
    intersect,
    least_chi2_without_a_ray,
    rays_of,
)
from fluoro_calib_ros.checks.beads import compare_with_survey, rejected_beads
from fluoro_calib_ros.checks.calibration_evidence import Evidence, Subject
from fluoro_calib_ros.checks.check import Check, Validation, verdict_of
from fluoro_calib_ros.checks.comparison import difference, place_name
from fluoro_calib_ros.checks.field_checks import PRECISION, TRENDS
from fluoro_calib_ros.checks.held_out import HELD_OUT
from fluoro_calib_ros.checks.residual_tests import (
    Residuals,
    change_of_trend,
    common_trend,
    rejected_exposure,
    rejected_trend,
    residuals_of,
)
from fluoro_calib_ros.checks.verdict import REPAIR_FIRST, validate, validate_or_report
from fluoro_calib_ros.errors import DataError
from fluoro_calib_ros.estimation.calibrate import (
    adjust_with_calibrations,
    calibrate,
    calibrate_request,
)
from fluoro_calib_ros.estimation.estimator import orientation_fields
from fluoro_calib_ros.estimation.options import CalibrationOptions, CalibrationRequest
from fluoro_calib_ros.exposures.phantom import Phantom
from fluoro_calib_ros.findings import Kind, Place, Severity
from fluoro_calib_ros.io.calibration import load_calibrations, save_calibration
from fluoro_calib_ros.io.calibration_request import read_request, write_request
from fluoro_calib_ros.io.result_document import validation_document
from fluoro_calib_ros.photogrammetry.outliers import FALSE_ALARM
from fluoro_calib_ros.report.tables import verdict_text
from fluoro_calib_ros.simulation.rig import Detection, simulate_exposures, virtual_rig

pytestmark = pytest.mark.long

CHECKS = [
    'halves',
    'whiteness',
    'worst_area',
    'drift',
    'variation',
    'held_out',
    'exposures',
    'precision',
    'beads',
    'distances',
    'shape',
]
OF_PHANTOM = ('beads', 'distances', 'shape')
SIZE = (1024, 1024)
LOCAL = {'model': 'local_linear'}


def rippled(frames, height=1.0, middle=(400.0, 600.0)):
    """Frames with an additional local ripple of height [px] in the second half."""
    out = []
    for i, frame in enumerate(frames):
        bump = np.exp(-np.sum((frame.uv - middle) ** 2, axis=1) / (2 * 80.0**2))
        out.append(
            replace(
                frame, uv=frame.uv + (i >= len(frames) // 2) * height * bump[:, None] * (0.8, 0.6)
            )
        )
    return out


@functools.cache
def verdict(fault='', **options):
    """Validation of fluoroscope a of the rig with a fault in its exposures."""
    frames = {'a': exposures()['a'] if fault != 'drift' else rippled(exposures()['a'])}
    job = (
        calibrated('a', **options)
        if not fault
        else calibrate(frames, rig().phantom, CalibrationOptions(**options))
    )
    request = CalibrationRequest(frames, rig().phantom, CalibrationOptions(**options))
    return validate(request, job.calibrations)


@functools.cache
def weighted(error, sd, strength=0.1):
    """Validation with a given principal distance that is off by a relative error.

    strength: that of the distortion, which is not corrected.
    """
    of_rig = virtual_rig(1, names=('a',), strength=strength)
    frames = simulate_exposures(of_rig, 10, 1).frames
    options = CalibrationOptions(model='none', interior_sd=(sd, sd, sd))
    shown = of_rig.fluoroscopes[0].interior
    distance = (1 + error) * shown[2]
    request = CalibrationRequest(frames, of_rig.phantom, options, principal_distance=distance)
    steps = []
    calibrations = calibrate_request(request).calibrations
    validation = validate(request, calibrations, lambda *step: steps.append(step[1:]))
    assert steps == [(done, len(steps)) for done in range(len(steps))]
    return validation, shown


def test_a_given_principal_distance_that_the_exposures_contradict_is_the_first_finding():
    validation, shown = weighted(0.05, 1.0)
    assert validation.verdict == 'fail'
    first, *others = validation.findings
    assert first.kind is Kind.GIVEN_INTERIOR and first.place.fluoroscope == 'a'
    assert abs(first.numbers['c_px'] - shown[2]) < 10 and 0 < first.numbers['sd_c_px'] < 10
    assert others
    assert all(check.advice == REPAIR_FIRST for check in others)


def test_a_contradicted_principal_distance_fails_where_the_noise_takes_its_misfit_up():
    """An error of 5 % is 3 times the estimated noise, so no other check fails."""
    validation, shown = weighted(0.05, 1.0, strength=0.0)
    (found,) = validation.findings
    assert validation.verdict == 'fail' and found.kind is Kind.GIVEN_INTERIOR
    assert abs(found.numbers['c_px'] - shown[2]) < 10


@pytest.mark.parametrize('error', [0.0, 0.05])
def test_a_weak_given_interior_orientation_is_not_accused(error):
    """The exposures determine it better."""
    validation, _ = weighted(error, 200.0)
    assert 'given_interior' not in [check.name for check in validation.checks]


def failed(validation):
    """Names of the failed checks."""
    return {check.name for check in validation.checks if check.passed is False}


def noise(seed, exposures=12, count=120, sd=0.25, trend=lambda uv, e: 0.0):
    """Residuals of white noise plus a trend, which is a function of pixels and exposures."""
    rng = np.random.default_rng(seed)
    uv = rng.uniform(0, 1023, (exposures * count, 2))
    e = np.repeat(np.arange(exposures), count)
    r = rng.normal(0, sd, uv.shape) + trend(uv, e)
    numbers = np.arange(exposures)
    return Residuals(uv, r, e, np.zeros(len(e), dtype=int), numbers, np.full(exposures, np.nan))


def rejected(direction, targets=12):
    """Image points (n,) in one place, of four exposures; direction (n,) of residuals [rad]."""
    rng = np.random.default_rng(1)
    n = len(direction)
    uv = rng.uniform(300, 350, (n, 2))
    r = 2.5 * np.column_stack([np.cos(direction), np.sin(direction)])
    e = np.arange(n) % 4
    target_id = np.arange(n) % targets
    return Residuals(uv, r, e, target_id, np.arange(4), np.full(4, np.nan))


# ---- complete validations


def test_good_calibration_passes():
    found = verdict()
    assert found.verdict == 'pass' and found.findings == ()
    assert [check.name for check in found.checks] == CHECKS
    for check in found.checks:
        assert check.passed and 0 <= check.value <= check.limit and check.sentence
        assert check.severity is Severity.NOTE
        assert check.place.fluoroscope == ('' if check.name in OF_PHANTOM else 'a')
    assert found.calibration_id == {'a': calibrated('a').calibrations['a'].calibration_id}


def test_distortion_without_a_model_fails():
    """Shown by the trend in residuals and by held-out exposures, whose residuals are no noise."""
    found = verdict(model='none')
    assert found.verdict == 'fail' and {'whiteness', 'worst_area', 'held_out'} <= failed(found)
    # Whatever is claimed, nothing is corrected: the trend is the achieved precision.
    trend = next(c.value for c in found.checks if c.kind is Kind.WHITENESS)
    assert found.achieved_sd_px['a'] >= trend > 0
    assert '--model auto' in found.findings[0].advice
    assert all(check.severity is Severity.ERROR for check in found.findings)
    assert not [check for check in found.findings if len(check.place.target_id) > 1]


def test_rejected_points_that_agree_are_no_false_matches():
    """They show a distortion that the model does not follow, unless few targets are affected."""
    rng = np.random.default_rng(2)
    others = rejected(np.ones(100))  # image points of the same place that fit
    found = rejected_trend(rejected(rng.normal(1.0, 0.3, 12)), others, SIZE)
    assert found.size_px > found.limit_px and len(found.rows) == 12
    assert np.linalg.norm(found.place - 325) < 25
    for _ in range(20):
        found = rejected_trend(rejected(rng.uniform(0, 2 * np.pi, 12)), others, SIZE)
        assert found.size_px <= found.limit_px
    assert rejected_trend(rejected(np.ones(12), targets=3), others, SIZE) is None


def test_few_rejected_points_that_agree_are_enough_where_nearly_all_of_a_place_are():
    few = rejected(np.array([0.9, 1.0, 1.1, 1.0, 0.8, 1.2]))
    elsewhere = rejected(np.ones(2000))
    elsewhere = replace(elsewhere, uv=elsewhere.uv / 5)
    found = rejected_trend(few, elsewhere, SIZE)
    assert found.size_px > found.limit_px and len(found.rows) == 6
    found = rejected_trend(few, rejected(np.ones(100)), SIZE)
    assert found.size_px <= found.limit_px


def test_rejected_points_of_an_exposure_that_agree_are_no_false_matches():
    """A smooth misfit of one exposure; directions of false matches are random."""
    rng = np.random.default_rng(3)

    def found(misfit):
        uv = rng.uniform(0, 1023, (60, 2))
        e = np.repeat(np.arange(4), 15)
        angle = rng.uniform(0, 2 * np.pi, 60)
        r = 3.0 * np.column_stack([np.cos(angle), np.sin(angle)])
        own = e == 2
        r[own] = (1 - misfit) * r[own] + misfit * np.array([3.0, 1.0]) * (uv[own] / 512 - 0.4)
        numbers = np.arange(11, 15)
        points = Residuals(uv, r, e, np.arange(60), numbers, np.full(4, np.nan))
        return rejected_exposure(points, points)

    one = found(1.0)
    assert one.agreement > one.limit and one.number == 13 and (one.points, one.of) == (15, 30)
    false = [found(0.0) for _ in range(300)]
    assert np.mean([one.agreement > one.limit for one in false]) < 0.02


def test_changing_distortion_fails_with_its_place(monkeypatch):
    monkeypatch.setattr(verdict_module, 'SUBJECTS', (TRENDS,))
    found = verdict('drift')
    drift = next(check for check in found.checks if check.kind is Kind.DRIFT)
    assert found.verdict == 'fail' and drift.passed is False
    assert np.linalg.norm(np.subtract(drift.place.pixel, (400, 600))) < 150
    assert drift in found.findings


def test_too_few_exposures_for_halves():
    frames = {'a': exposures()['a'][:5]}
    job = calibrate(frames, rig().phantom, CalibrationOptions(max_iterations=3))
    options = CalibrationOptions(max_iterations=3)
    found = validate(CalibrationRequest(frames, rig().phantom, options), job.calibrations)
    halves = found.checks[0]
    assert halves.name == 'halves' and halves.passed is None and np.isnan(halves.value)
    assert halves.severity is Severity.WARNING and halves.numbers['exposures'] == 5
    assert found.verdict in ('cannot tell', 'fail') and halves in found.findings


def test_joint_validation_reports_progress_and_can_be_cancelled():
    options = CalibrationOptions(model='none')
    frames = {n: f[:6] for n, f in exposures().items()}
    job = calibrate(frames, rig().phantom, options, joint=True)
    steps = []
    request = CalibrationRequest(frames, rig().phantom, options, joint=True)
    found = validate(request, job.calibrations, progress=lambda *step: steps.append(step))
    assert [(c.name, c.place.fluoroscope) for c in found.checks] == [
        *((name, f) for f in 'ab' for name in CHECKS[: -len(OF_PHANTOM)]),
        *((name, '') for name in OF_PHANTOM),
        ('orientation', 'a'),
    ]
    assert [done for _, done, _ in steps] == list(range(6)) and {total for *_, total in steps} == {
        6
    }

    def stop(*_):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        validate(request, job.calibrations, progress=stop)


def test_failed_adjustment_gives_cannot_tell():
    """The node keeps its calibration; the command ends with the finding."""
    calibrations = calibrated('a', **LOCAL).calibrations
    few = {'a': [replace(f, target_id=f.target_id[:5], uv=f.uv[:5]) for f in exposures()['a']]}
    request = CalibrationRequest(few, rig().phantom)
    with pytest.raises(DataError):
        validate(request, calibrations)
    found = validate_or_report(request, calibrations)
    assert found.verdict == 'cannot tell'
    assert [check.kind for check in found.findings] == [Kind.VALIDATION]


def test_fail_takes_precedence_over_cannot_tell_and_pass():
    limits = {True: 2.0, False: 0.5, None: np.nan}

    def of(*passed):
        return verdict_of([Check(Kind.BEADS, 's', value=1.0, limit=limits[p]) for p in passed])

    assert (of(True, True), of(True, None)) == ('pass', 'cannot tell')
    assert (of(None, False, True), of()) == ('fail', 'cannot tell')


def test_new_check_is_one_subject(monkeypatch):
    """A check consists of a module with a Subject and its entry in SUBJECTS."""

    def count_exposures(evidence, names):
        evidence.report_step('counting')
        return [
            Check(
                Kind.EXPOSURES,
                'counted',
                Place((name,)),
                value=1,
                limit=len(evidence.frames[name]),
                unit='1',
            )
            for name in names
        ]

    monkeypatch.setattr(verdict_module, 'SUBJECTS', (Subject(count_exposures, steps=1),))
    request = CalibrationRequest({'a': exposures()['a']}, rig().phantom)
    steps = []
    found = validate(
        request, calibrated('a', **LOCAL).calibrations, lambda *step: steps.append(step)
    )
    (check,) = found.checks
    assert (check.name, check.place.fluoroscope, check.limit) == ('exposures', 'a', 15.0)
    assert found.verdict == 'pass' and steps[1:] == [('counting', 1, 2)]


@pytest.mark.long
@pytest.mark.parametrize(('claimed', 'passes'), [(2.0, True), (0.25, False)])
def test_points_that_are_said_to_be_imprecise_are_no_misfit_of_their_exposure(
    monkeypatch, claimed, passes
):
    """As for overlapping beads: a quarter of one exposure has an sd of 2 px."""
    monkeypatch.setattr(verdict_module, 'SUBJECTS', (HELD_OUT,))
    rng = np.random.default_rng(8)
    frames = [replace(f, sigma=np.full(len(f.uv), 0.25)) for f in exposures()['a'][:8]]
    fifth = frames[4]
    some = np.arange(len(fifth.uv)) % 4 == 0
    noise = rng.normal(0, 2.0, fifth.uv.shape) * some[:, None]
    sigma = np.where(some, claimed, fifth.sigma)
    frames[4] = replace(fifth, uv=fifth.uv + noise, sigma=sigma)
    request = CalibrationRequest(
        {'a': frames}, rig().phantom, CalibrationOptions(model='collocation')
    )
    calibrations = calibrate(request.frames, request.phantom, request.options).calibrations
    found = validate(request, calibrations)
    (check,) = [check for check in found.checks if check.kind is Kind.EXPOSURES]
    assert check.place.exposures == (5,) or passes
    assert check.passed == passes


def test_points_more_precise_than_the_survey_are_not_rejected_in_a_few_exposures():
    """Noise of 0.03 px, as of bead images, where the survey of 0.1 mm corresponds to 0.3 px."""
    detection = Detection(noise_px=0.03, false_matches=0.01)
    frames = {'a': simulate_exposures(rig(), 9, 5, detection).frames['a']}
    whole = calibrate(frames, rig().phantom).calibrations
    part = adjust_with_calibrations({'a': frames['a'][:3]}, rig().phantom, whole)
    residuals = part.residuals
    assert np.mean(residuals.outlier) < 0.02
    assert np.std(residuals.residual[~residuals.outlier]) < 0.05


def test_part_from_the_solution_is_that_from_observations_alone():
    """The effect of the initial values on a calibration is far below its errors."""
    whole = calibrated('a')
    request = CalibrationRequest({'a': exposures()['a']}, rig().phantom)
    held = adjust_with_calibrations(request.frames, request.phantom, whole.calibrations)
    evidence = Evidence(request, whole.calibrations, held, lambda step: None)
    part = evidence.part(['a'], lambda i: i % 3 != 0)
    found = evidence.calibrate(part)['a']
    anew = calibrate(part, rig().phantom).calibrations['a']
    apart = difference(found, anew)
    own = difference(found, whole.calibrations['a'])
    assert apart.rms_px < 0.1 * np.mean(apart.sd) and apart.rms_px < 0.3 * own.rms_px
    np.testing.assert_allclose(found.interior, anew.interior, atol=1)
    np.testing.assert_allclose(found.sigma0, anew.sigma0, rtol=5e-3)
    at = found.model.train_uv
    np.testing.assert_allclose(found.model.evaluate(at).sd, anew.model.evaluate(at).sd, rtol=0.1)


# ---- two halves


def test_difference_ignores_what_orientations_absorb():
    """A calibration with rays rotated, shifted, scaled and tilted gives the same predictions."""
    one = calibrated('a', **LOCAL).calibrations['a']
    model = one.model
    (xp, yp, c) = one.interior
    xy = (model.train_uv - model.train_duv - (xp, yp)) / c
    moved_by = (orientation_fields(xy) @ [1e-3, -2e-3, 3e-3, 1e-3, 5e-3, -4e-3]).reshape(-1, 2) * c
    other = replace(one, model=replace(model, train_duv=model.train_duv + moved_by))
    assert difference(one, other).rms_px < 0.02 < np.abs(moved_by).max()
    assert difference(one, replace(one, interior=one.interior + (8, -5, 30))).rms_px < 0.02


def test_difference_has_the_right_size_and_place():
    one = calibrated('a', **LOCAL).calibrations['a']
    bump = np.exp(-np.sum((one.model.train_uv - (300, 300)) ** 2, axis=1) / (2 * 100**2))
    other = replace(
        one, model=replace(one.model, train_duv=one.model.train_duv + 2.5 * bump[:, None])
    )
    found = difference(one, other)
    assert found.normalised > 3 and np.linalg.norm(found.worst - (300, 300)) < 60
    assert 0.7 < np.abs(found.duv).max() < 2.5


def test_place_names():
    places = ((10, 10), (500, 10), (1000, 500), (500, 500), (1023.4, 1023.4), (-0.5, 900))
    names = [place_name(uv, SIZE) for uv in places]
    assert names == [
        'upper left',
        'upper middle',
        'middle right',
        'middle',
        'lower right',
        'lower left',
    ]


# ---- residuals


def test_false_alarm_rate_of_white_residuals():
    """Also with an offset and rotation of every exposure, with which a test of single residuals
    would fail.
    """

    def of_exposure(uv, e):
        rng = np.random.default_rng(int(uv[0, 0] * 1e6))
        return (
            rng.normal(0, 0.1, (12, 2))[e] + (uv[:, ::-1] - 512) * rng.normal(0, 2e-4, 12)[e, None]
        )

    alarms = np.zeros(4)
    for seed in range(100):
        residuals = noise(seed, trend=of_exposure)
        for i, trend in enumerate(
            (common_trend(residuals, SIZE), change_of_trend(residuals, SIZE))
        ):
            alarms[2 * i] += trend.size > trend.limit
            alarms[2 * i + 1] += trend.cell_size > trend.cell_limit
    # At a rate of 0.2 %, four or more of 100 draws occur once in 100,000 tests.
    assert FALSE_ALARM == 2e-3 and alarms.max() <= 3


def test_trend_is_detected_with_size_and_place():
    def trend(uv, e):
        return (
            0.5
            * np.exp(-np.sum((uv - (700, 200)) ** 2, axis=1) / (2 * 100**2))[:, None]
            * (0.6, 0.8)
        )

    found = common_trend(noise(1, trend=trend), SIZE)
    assert found.size > found.limit and found.cell_size > found.cell_limit
    assert np.linalg.norm(found.place - (700, 200)) < 100 and abs(found.cell_size - 0.45) < 0.15
    assert (
        change_of_trend(noise(1, trend=trend), SIZE).size
        <= change_of_trend(noise(1, trend=trend), SIZE).limit
    )


@pytest.mark.parametrize(('wavelength', 'size'), [(25.0, 0.6), (40.0, 0.4), (60.0, 0.4)])
def test_ripple_shorter_than_the_distance_of_neighbours_is_detected(wavelength, size):
    def ripple(uv, e):
        return size * np.sin(2 * np.pi / wavelength * (uv @ (0.6, 0.8)))[:, None] * (0.0, 1.0)

    for seed in range(5):
        found = common_trend(noise(seed, trend=ripple), SIZE)
        assert found.size > found.limit
        assert found.size == pytest.approx(size / 2, rel=0.5)  # RMS of a coordinate


def test_change_of_trend_is_detected_with_its_size():
    found = change_of_trend(
        noise(2, trend=lambda uv, e: (e >= 6)[:, None] * (0.2, 0.0) - 0.1), SIZE
    )
    assert found.size > found.limit and abs(found.size - 0.2 / np.sqrt(2)) < 0.05


@pytest.mark.parametrize('middle', [(448.0, 448.0), (512.0, 512.0)])
def test_local_change_is_found_wherever_it_is(middle):
    """In the middle of a cell and where four cells meet; noise alone stays far below the limit."""

    def ripple(uv, e):
        bump = np.exp(-np.sum((uv - middle) ** 2, axis=1) / (2 * 60.0**2))
        return (e >= 6)[:, None] * 0.7 * bump[:, None] * (0.8, 0.6)

    found = change_of_trend(noise(4, trend=ripple), SIZE)
    assert found.cell_size > found.cell_limit
    assert np.linalg.norm(found.place - middle) < 100
    honest = change_of_trend(noise(4), SIZE)
    assert honest.cell_size < 0.9 * honest.cell_limit


def test_residuals_agree_with_the_adjustment():
    job = calibrated('a', **LOCAL)
    frames = exposures()['a']
    held = adjust_with_calibrations({'a': frames}, rig().phantom, job.calibrations)
    found = residuals_of(held, 'a', frames)
    calibration = job.calibrations['a']
    assert len(found.uv) == sum(len(f.target_id) for f in frames) and list(found.numbers) == list(
        range(1, 16)
    )
    inliers = found.inliers(calibration.image_sd)
    np.testing.assert_allclose(
        np.sqrt(np.mean(inliers.r**2, axis=0)), held.fluoroscopes['a'].rmse_after, rtol=0.05
    )


# ---- beads


def phantom_with_a_wrong_bead(mm=3.0):
    """The survey of the rig with one displaced bead, and the id of that bead."""
    phantom = rig().phantom
    seen = np.bincount(np.concatenate([f.target_id for f in exposures()['a']]), minlength=504)
    row = int(np.flatnonzero(seen[phantom.target_id] >= 6)[3])
    xyz = phantom.xyz_mm.copy()
    xyz[row] += mm * np.array([0.6, 0.0, 0.8])
    return Phantom(phantom.target_id, xyz, phantom.sd_mm), int(phantom.target_id[row])


def test_bead_with_a_wrong_survey_is_reported_with_its_error():
    phantom, wrong = phantom_with_a_wrong_bead()
    frames = {'a': exposures()['a']}
    job = calibrate(frames, phantom, CalibrationOptions(max_iterations=6, **LOCAL))
    held = adjust_with_calibrations(frames, phantom, job.calibrations)
    rays = rays_of(held, frames)
    beads, dist = compare_with_survey(intersect(rays, held.targets, phantom))
    # The bead is displaced whichever ray is excluded.
    least = least_chi2_without_a_ray(rays, held.targets, phantom, np.array([wrong]))
    assert least[0] > 100
    assert beads.passed is False and beads.place.target_id == (wrong,)
    assert abs(beads.value - 3.0) < 0.4 and beads.limit < 1.5
    assert dist.passed  # the named bead is excluded


def test_a_bead_that_one_ray_puts_out_of_place_is_not_accused():
    n = 40
    rng = np.random.default_rng(4)
    survey = rng.uniform(-100, 100, (n, 3))
    found = survey + rng.normal(0, 0.1, (n, 3))
    found[7] += 3.0
    covariance = np.tile(0.01 * np.eye(3), (n, 1, 1))
    beads = Beads(np.arange(n), found, covariance, np.full(n, 4), survey, np.full(n, 0.01))
    assert compare_with_survey(beads)[0].passed is False
    checks = compare_with_survey(beads, least_chi2=lambda ids: np.full(len(ids), 2.0))
    assert all(check.passed for check in checks)


def table_of(target_id, outlier, exposure=None):
    """Residual table of one fluoroscope, with the columns that rejected_beads needs."""
    count = len(target_id)
    exposure = np.zeros(count, dtype=int) if exposure is None else exposure
    name = np.full(count, 'a')
    return SimpleNamespace(
        target_id=target_id, outlier=outlier, exposure=exposure, fluoroscope=name
    )


def test_a_bead_of_which_nearly_all_points_are_rejected_is_doubted():
    """No doubt arises if false matches are so frequent that chance explains it."""
    target_id = np.repeat(np.arange(100), 4)
    outlier = np.zeros(400, dtype=bool)
    outlier[:5] = [True, True, True, False, True]  # three points of bead 0, one of bead 1
    assert rejected_beads(table_of(target_id, outlier)).tolist() == [0]
    rng = np.random.default_rng(1)
    for share in (0.01, 0.2, 0.4):
        for _ in range(20):
            table = table_of(target_id, rng.random(400) < share)
            assert not len(rejected_beads(table))


def test_beads_that_two_exposures_show_are_doubted_together():
    """By chance, all points of one such bead may be rejected, but not those of three."""
    target_id = np.repeat(np.arange(400), np.where(np.arange(400) < 40, 2, 6))
    exposure = np.arange(len(target_id)) % 17
    chance = np.random.default_rng(2).random(len(target_id)) < 0.01
    for wrong, doubted in (([3], []), ([3, 9, 31], [3, 9, 31])):
        outlier = chance | np.isin(target_id, wrong)
        assert rejected_beads(table_of(target_id, outlier, exposure)).tolist() == doubted


@pytest.mark.parametrize('bad', [0.1, 0.5, 0.8])
def test_an_exposure_with_many_false_matches_puts_no_bead_in_doubt(bad):
    rng = np.random.default_rng(3)
    for _ in range(20):
        target_id = np.concatenate([rng.permutation(300)[:100] for _ in range(12)])
        exposure = np.repeat(np.arange(12), 100)
        outlier = rng.random(1200) < np.where(exposure < 3, bad, 0.01)
        assert not len(rejected_beads(table_of(target_id, outlier, exposure)))


def test_errors_of_intersected_beads_agree_with_their_covariance():
    frames = {'a': exposures()['a']}
    held = adjust_with_calibrations(frames, rig().phantom, calibrated('a', **LOCAL).calibrations)
    beads = intersect(rays_of(held, frames), held.targets, rig().phantom)
    assert len(beads.target_id) > 350 and 2.5 < np.mean(beads.chi2) < 3.5
    true = rig().true_mm[rig().phantom.index(beads.target_id)]
    error = np.einsum(
        'na,nab,nb->n', beads.xyz_mm - true, np.linalg.inv(beads.covariance), beads.xyz_mm - true
    )
    assert 2.0 < np.mean(error) < 4.0
    assert all(check.passed for check in compare_with_survey(beads)) and FALSE_ALARM < 0.01


def test_distances_give_scale_and_precision():
    rng = np.random.default_rng(0)
    true = rng.uniform(-130, 130, (150, 3))
    n = 150
    beads = Beads(
        np.arange(n),
        1.001 * true + rng.normal(0, 0.05, true.shape),
        np.tile(0.05**2 * np.eye(3), (n, 1, 1)),
        np.full(n, 4),
        true + rng.normal(0, 0.1, true.shape),
        np.full(n, 0.1),
    )
    found = distances(beads)
    assert abs(found.scale - 1e-3) < 4 * found.scale_sd < 1e-3
    assert found.expected_mm == pytest.approx(np.sqrt(2 * (0.05**2 + 0.1**2)))
    straight = distances(replace(beads, xyz_mm=beads.xyz_mm / 1.001))
    assert (
        straight.rmse_mm == pytest.approx(found.expected_mm, rel=0.1)
        and found.rmse_mm > straight.rmse_mm
    )
    assert compare_with_survey(replace(beads, survey_sd_mm=np.full(n, 0.02)))[1].passed is False


def test_distances_of_few_beads_scatter_as_expected():
    """By chance, good surveys of a small phantom fail as rarely as those of a large one."""
    rng = np.random.default_rng(1)
    n = 20
    survey = rng.uniform(-60, 60, (n, 3))
    factor = 0.1 * rng.normal(size=(n, 3, 3))
    covariance = factor @ factor.transpose(0, 2, 1)

    def beads(factor):
        error = (factor @ rng.normal(size=(n, 3, 1)))[:, :, 0]
        return Beads(
            np.arange(n), survey + error, covariance, np.full(n, 4), survey, np.full(n, 1e-6)
        )

    found = [distances(beads(factor)) for _ in range(1000)]
    square = np.array([d.rmse_mm**2 / d.expected_mm**2 for d in found])
    assert np.var(square) == pytest.approx(2 / found[0].freedom, rel=0.15)
    checks = [compare_with_survey(beads(factor))[1].passed for _ in range(300)]
    assert checks.count(False) <= 4
    assert compare_with_survey(beads(1.5 * factor))[1].passed is False


def test_too_few_beads():
    none = Beads(
        np.arange(2),
        np.zeros((2, 3)),
        np.zeros((2, 3, 3)),
        np.full(2, 4),
        np.zeros((2, 3)),
        np.ones(2),
    )
    assert [check.passed for check in compare_with_survey(none)] == [None, None]


# ---- files, text and command


@pytest.fixture(scope='module')
def folder(tmp_path_factory):
    """A folder written by calibrate: fluoroscope a, six exposures, few rounds."""
    place = tmp_path_factory.mktemp('validate')
    root = pathlib.Path(__file__).resolve().parents[2] / 'bags'
    lines = (root / 'calibration.csv').read_text().splitlines()
    few = [line for line in lines if not line.startswith('a,') or int(line.split(',')[1]) <= 6]
    (place / 'few.csv').write_text('\n'.join(few) + '\n')
    assert (
        run(
            'calibrate',
            place / 'few.csv',
            '--fast',
            '--image-size',
            '1024x1024',
            '--phantom',
            root / 'phantom.csv',
            '--out',
            place / 'result',
            '--fluoroscopes',
            'a',
            '--model',
            'local_linear',
            '--max-iterations',
            2,
        )
        == 0
    )
    return place / 'result'


def copied(folder, to):
    """A copy of the files of a folder."""
    to.mkdir()
    for path in folder.iterdir():
        (to / path.name).write_bytes(path.read_bytes())
    return to


def test_sources_round_trip(tmp_path):
    """Also with fluoroscopes of different image sizes."""
    job = calibrated('a', **LOCAL)
    frames = exposures()['a']
    calibration = job.calibrations['a']
    options = CalibrationOptions(k=20, loss='huber', **LOCAL)
    save_calibration(str(tmp_path), calibration)
    write_request(
        tmp_path, CalibrationRequest({'a': frames}, rig().phantom, options, True, 4000.0)
    )
    found = read_request(tmp_path, load_calibrations(str(tmp_path)))
    assert (found.options, found.joint, found.principal_distance) == (options, True, 4000.0)
    assert all(
        np.array_equal(f.sorted().uv, g.sorted().uv) and f.image_size == g.image_size
        for f, g in zip(frames, found.frames['a'])
    )


def test_command_writes_and_prints_the_verdict(folder, tmp_path, capsys):
    place = copied(folder, tmp_path / 'x')
    capsys.readouterr()
    status = run('validate', place, '--json')
    out, err = capsys.readouterr()
    document = json.loads(out)
    assert document == json.loads((place / 'validation.json').read_text())
    assert [check['name'] for check in document['checks']] == CHECKS
    assert document['verdict'] in ('pass', 'cannot tell', 'fail')
    assert status == (0 if document['verdict'] == 'pass' else 3) and not err
    ids = {name: c.calibration_id for name, c in load_calibrations(str(place)).items()}
    assert document['calibration_id'] == ids


def test_command_ends_with_its_own_status_after_writing_the_verdict(
    folder, tmp_path, capsys, monkeypatch
):
    place = copied(folder, tmp_path / 'x')
    bad = Check(Kind.DRIFT, 'it moved', Place(('a',)), value=1.0, limit=0.1, unit='px')
    monkeypatch.setattr(
        'fluoro_calib_ros.checks.verdict.validate',
        lambda *_, **__: Validation('fail', (bad, bad), {'a': 'a-1'}, 1.0),
    )
    assert run('validate', place) == 3
    out, err = capsys.readouterr()
    assert not err
    assert (
        'Verdict: fail' in out
        and json.loads((place / 'validation.json').read_text())['verdict'] == 'fail'
    )


@pytest.mark.parametrize(
    'name, content, cause',
    [
        ('observations.csv', None, 'there is no such file'),
        ('phantom.csv', None, 'there is no such file'),
        ('options.json', None, 'calibrate again'),
        ('options.json', '{', 'row 1: this is not JSON'),
        ('options.json', '{}', 'layout version None'),
        (
            'options.json',
            '{"format_version": 1, "options": {"model": "x"}}',
            'not options of a calibration',
        ),
        (
            'options.json',
            '{"format_version": 1, "options": {}, "joint": 3}',
            'joint or principal_distance',
        ),
        (
            'options.json',
            '{"format_version": 1, "options": 7, "joint": true}',
            'not options of a calibration',
        ),
        ('observations.csv', 'fluoroscope,exposure,target_id,u,v\na,1,1,5,x\n', "row 2: v is 'x'"),
        (
            'observations.csv',
            'fluoroscope,exposure,target_id,u,v\na,1,1,5,6\n',
            'these are not the observations',
        ),
        (
            'observations.csv',
            'fluoroscope,exposure,target_id,u,v\nb,1,1,5,6\n',
            'no observations of fluoroscope a',
        ),
        ('a.calibration.npz', 'x', 'damaged'),
    ],
)
def test_missing_and_damaged_files_are_reported_in_one_sentence(
    folder, tmp_path, capsys, name, content, cause
):
    place = copied(folder, tmp_path / 'x')
    (place / name).unlink() if content is None else (place / name).write_text(content)
    assert run('validate', place) == 1
    out, err = capsys.readouterr()
    assert out == '' and err.startswith('fluoro-calib validate: ') and err.count('\n') == 1
    assert name in err and cause in err and not (place / 'validation.json').exists()


def test_unknown_fluoroscope_and_missing_folder_are_reported(folder, tmp_path, capsys):
    assert (
        run('validate', folder, '--fluoroscopes', 'c') == 1
        and run('validate', tmp_path / 'none') == 1
    )
    err = capsys.readouterr().err
    assert (
        "no calibration of fluoroscope 'c', only of a" in err and 'there is no such folder' in err
    )


def test_table_fits_a_terminal_and_gives_advice():
    checks = (
        Check(Kind.HALVES, 'fine', Place(('a' * 60,)), value=1.2, limit=2, unit='predicted sd'),
        Check(Kind.HELD_OUT, 'not to be had ' * 20, Place(('a',))),
        Check(Kind.DRIFT, 'take them anew', value=0.3, limit=0.1, unit='px'),
    )
    text = verdict_text(Validation('fail', checks, {}, 3.0))
    assert max(map(len, text.splitlines())) <= 100
    assert (
        'FAILED' in text
        and 'not made' in text
        and '- take them anew' in text
        and 'fine' not in text
    )
    json.dumps(validation_document(Validation('fail', checks[:1], {'a': 'x'}, 1.0)))


def test_imprecise_correction_does_not_pass(monkeypatch):
    """A neighbour model that follows the noise: errors 50 % above those with known distortion."""
    monkeypatch.setattr(verdict_module, 'SUBJECTS', (PRECISION,))
    few_rounds = {'model': 'knn', 'max_iterations': 4}
    job = calibrated(count=8, **few_rounds)
    request = CalibrationRequest(
        {'a': exposures()['a'][:8]}, rig().phantom, CalibrationOptions(**few_rounds)
    )
    verdict = validate(request, job.calibrations)
    (check,) = verdict.checks
    assert check.kind is Kind.PRECISION
    assert verdict.verdict == 'fail' and not check.passed and check.value > check.limit
    assert check.numbers['exposures'] == 8
    assert check.numbers['sd_px'] / check.numbers['noise_px'] == pytest.approx(check.value)


def test_model_that_does_not_follow_the_distortion_is_named(monkeypatch):
    """Its misfit is not image noise, next to which the correction would look precise."""
    monkeypatch.setattr(verdict_module, 'SUBJECTS', (PRECISION,))
    job = calibrated('a', model='parametric')
    request = CalibrationRequest(
        {'a': exposures()['a']}, rig().phantom, CalibrationOptions(model='parametric')
    )
    verdict = validate(request, job.calibrations)
    (check,) = verdict.checks
    assert check.kind is Kind.PRECISION
    assert not check.passed
    assert 'choose another model (--model auto)' in check.advice
