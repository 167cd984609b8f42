# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Numbers of checks on small inputs with known answers."""

import warnings
from dataclasses import replace
from types import SimpleNamespace as Fake

import numpy as np
import pytest
import rigs
from rigs import kinds
from scipy.special import ndtri

from fluoro_calib_ros.checks import field_checks, held_out, inputs, shape, verdict
from fluoro_calib_ros.checks.bead_intersection import Beads, _scale, distances
from fluoro_calib_ros.checks.beads import _layers, _sums, rejected_beads
from fluoro_calib_ros.checks.check import Check, more_exposures, verdict_of
from fluoro_calib_ros.checks.comparison import (
    CELLS,
    Comparison,
    FieldDifference,
    _difference,
    _test,
    cell_centres,
    place_name,
)
from fluoro_calib_ros.checks.drift_charts import (
    ERROR,
    OK,
    WARN,
    CusumCharts,
    DriftOptions,
    EpipolarObservations,
    ImageAreas,
)
from fluoro_calib_ros.checks.drift_watch import BlockClock
from fluoro_calib_ros.checks.held_out import _white, exposure_limits, misfits
from fluoro_calib_ros.checks.inputs import (
    _are_copied,
    copied_exposures,
    doubtful_image_sizes,
    find_wrong_phantom,
    implausible,
    shared_exposures,
    wrong_image_size,
    wrong_unit,
)
from fluoro_calib_ros.checks.pair_watch import LAGS, PairWatch, SystematicErrorField
from fluoro_calib_ros.checks.rig import doubtful, motion_between_stamps
from fluoro_calib_ros.checks.rig_watch import RigDriftWatch
from fluoro_calib_ros.correction.base import Correction
from fluoro_calib_ros.errors import DataError
from fluoro_calib_ros.estimation.estimator import orientation_fields
from fluoro_calib_ros.estimation.exposure_terms import Variation
from fluoro_calib_ros.exposures.frame import Frame
from fluoro_calib_ros.exposures.phantom import Phantom
from fluoro_calib_ros.findings import Finding, Kind, Place, Severity
from fluoro_calib_ros.photogrammetry.noise import INLIER_Q
from fluoro_calib_ros.rows import joined_rows

SIZE = (1024, 768)
RNG = np.random.default_rng(3)


def check(value, limit, kind=Kind.HALVES, name='a'):
    return Check(kind, 'x', Place((name,)), value=value, limit=limit)


@pytest.mark.parametrize(
    ('pairs', 'expected'),
    [
        ([], 'cannot tell'),
        ([(1, 1)], 'pass'),
        ([(1, 1), (1.01, 1)], 'fail'),
        ([(1, 1), (1, np.nan)], 'cannot tell'),
        ([(2, 1), (1, np.nan)], 'fail'),
    ],
)
def test_verdict_is_that_of_the_worst_check(pairs, expected):
    assert verdict_of([check(*pair) for pair in pairs]) == expected


def test_severity_of_a_check_follows_its_limit():
    found = [check(*pair).severity for pair in ((1, 2), (3, 2), (1, np.nan))]
    assert found == [Severity.NOTE, Severity.ERROR, Severity.WARNING]
    assert [more_exposures(count).split()[1] for count in (3, 10, 12)] == ['12', '5', '5']


# ---- inputs


def frame(number=1, uv=None, ids=None, **changes):
    uv = RNG.uniform(0, 700, (20, 2)) if uv is None else np.asarray(uv, float)
    ids = np.arange(len(uv)) if ids is None else np.asarray(ids)
    return Frame('a', number, ids, uv, SIZE, **changes)


def test_copies_have_nearly_all_points_the_same():
    uv = RNG.uniform(0, 700, (20, 2))

    def changed(count, by=1e-3):
        out = uv.copy()
        out[:count, 1] += by
        return out

    others = np.stack([uv, changed(2), changed(3), changed(20, 9e-7), changed(20, 1.1e-6)])
    assert _are_copied(uv, others).tolist() == [True, True, False, True, False]
    few = np.full((2, 20, 2), np.nan)
    few[0, :8] = uv[:8]
    few[1, :7] = uv[:7]
    assert _are_copied(uv, few).tolist() == [True, False]


def test_copied_exposures_are_named_with_their_originals():
    one, other = frame(1), frame(4)
    given = [replace(one, number=9), other, one, replace(other, number=6), frame(7)]
    found = [(copy.number, original.number) for copy, original in copied_exposures(given)]
    assert found == [(6, 4), (9, 1)] and copied_exposures([]) == []


def test_shared_exposures_are_of_both_fluoroscopes():
    one, other = [frame(n) for n in (1, 2, 3)], [frame(n) for n in (1, 2, 3)]
    other[2] = replace(one[1], number=3)
    other.append(replace(other[0], number=8))  # a copy in only one is a different case
    assert [(a.number, b.number) for a, b in shared_exposures(one, other)] == [(2, 3)]
    assert [(a.number, b.number) for a, b in shared_exposures(other, one)] == [(3, 2)]


@pytest.mark.parametrize(
    ('reach', 'is_wrong'),
    [((0.59, 0.59), True), ((0.7, 0.59), False), ((0.59, 0.7), False)],
)
def test_image_size_is_wrong_where_points_reach_neither_side(reach, is_wrong):
    corner = np.array(reach) * SIZE
    exposures = [frame(uv=[[1, 1], corner * [1, 0.2]]), frame(uv=[corner * [0.2, 1]])]
    found = wrong_image_size(exposures)
    assert (found is not None) is is_wrong
    if found:
        assert found.numbers == {'largest_u': corner[0], 'largest_v': corner[1]}
        assert found.severity is Severity.ERROR
    assert wrong_image_size([]) is None


@pytest.mark.parametrize(
    ('low', 'reach', 'is_doubtful'),
    [
        ((0.01, 0.02), (0.75, 0.76), True),  # the image is said to be a third too large
        ((0.01, 0.02), (0.95, 0.95), False),
        ((0.01, 0.02), (0.75, 0.95), False),  # a wide image
        ((0.1, 0.12), (0.75, 0.76), False),  # a round field
    ],
)
def test_image_size_is_doubtful_where_points_end_equally_far_from_two_borders(
    low, reach, is_doubtful
):
    exposures = {'a': [frame(uv=np.array([low, reach]) * SIZE)]}
    found = doubtful_image_sizes(exposures)
    assert len(found) == is_doubtful
    assert all(finding.severity is Severity.WARNING for finding in found)


@pytest.mark.parametrize(
    ('distance', 'kind', 'meant'),
    [
        (200.0, None, ''),
        (199.0, Kind.WRONG_UNIT, 'cm or inches'),
        (10_000.0, None, ''),
        (10_001.0, Kind.WRONG_UNIT, ''),
        (40.0, Kind.WRONG_UNIT, 'cm or inches'),
        (1.0, Kind.SOURCE_TOO_NEAR, ''),
    ],
)
def test_unit_is_wrong_by_the_distance_of_the_source(distance, kind, meant):
    phantom = Phantom(
        np.arange(4), np.array([[0.0, 0, 0], [6, 0, 0], [0, 8, 0], [0, 0, 0]]), np.ones(4)
    )
    found = wrong_unit(distance, phantom)
    assert (found and found.kind) == kind
    if found:
        assert found.numbers['extent_mm'] == 10 and meant in found.cause


def test_repeated_and_remote_targets_are_found_by_their_places():
    xyz = RNG.uniform(-50, 50, (40, 3))
    xyz[5] = xyz[9] = [1.0, 2, 3]
    xyz[7] = [900.0, 0, 0]
    ids = np.arange(40) + 100
    phantom = Phantom(ids, xyz, np.full(40, 0.1))
    repeated, remote = find_wrong_phantom({'a': [frame(ids=ids, uv=np.zeros((40, 2)))]}, phantom)
    assert repeated.kind is Kind.REPEATED_COORDINATES
    assert repeated.place.target_id == (105, 109)
    assert remote.kind is Kind.REMOTE_TARGETS and remote.place.target_id == (107,)
    middle = np.median(xyz, axis=0)
    assert remote.numbers['distance_mm'] == pytest.approx(np.linalg.norm(xyz[7] - middle))
    rows = np.linalg.norm(xyz - middle, axis=1)
    assert remote.numbers['extent_mm'] == pytest.approx(np.quantile(rows, 0.9))
    unseen = [frame(ids=ids[10:], uv=np.zeros((30, 2)))]
    assert find_wrong_phantom({'a': unseen}, phantom) == []
    with warnings.catch_warnings():
        warnings.simplefilter('error')  # no mean of an empty array
        assert find_wrong_phantom({'a': [frame(ids=[1], uv=[[0, 0]])]}, phantom) == []


def figures(**changes):
    values = {
        'rmse_after': np.array([0.3, 0.4]),
        'image_size': SIZE,
        'inliers': 90,
        'observations': 100,
        'exposures': [Fake(position_mm=np.array([0.0, 0, -900]))],
        'interior': np.array([511.5, 383.5, 4000.0]),
        'interior_sd': np.array([1.0, 1, 10]),
    }
    return Fake(**{**values, **changes})


def calibration(**changes):
    made = rigs.pincushion('a', SIZE)
    return replace(made, **{'interior': np.array([511.5, 383.5, 4000.0]), **changes})


def found_in(made, held=None, sigma=None):
    phantom = Phantom(np.arange(4), np.eye(4, 3) * 50, np.ones(4))
    request = Fake(frames={'a': [frame(sigma=sigma)]}, phantom=phantom)
    result = Fake(fluoroscopes={'a': made}, calibrations={'a': held or calibration()})
    return implausible(request, result)


@pytest.mark.parametrize(
    ('changes', 'kind'),
    [
        ({}, None),
        ({'rmse_after': np.array([2.6, 2.6])}, Kind.LARGE_RESIDUALS),
        ({'rmse_after': np.array([2.5, 2.5])}, None),
        ({'inliers': 49}, Kind.FEW_INLIERS),
        ({'inliers': 50}, None),
        ({'exposures': [Fake(position_mm=np.array([0, 0, -9e4]))]}, Kind.WRONG_UNIT),
        ({'interior_sd': np.array([1.0, 1, 201])}, Kind.INTERIOR_UNDETERMINED),
        ({'interior_sd': np.array([1.0, 201, 10])}, Kind.INTERIOR_UNDETERMINED),
        ({'interior_sd': np.array([199.0, 1, 199])}, None),
    ],
)
def test_impossible_results_are_found_at_their_limits(changes, kind):
    found = found_in(figures(**changes))
    assert kinds(found) == ([] if kind is None else [kind])
    if kind is Kind.FEW_INLIERS:
        assert 'only 49 % of the image points fit, at least 50 % are' in found[0].cause


def test_targets_on_a_line_are_not_looked_at_for_wrong_coordinates():
    """The direction of the line does not matter; a calibration reveals more about it."""
    along = np.append(np.arange(30.0), 1e5)[:, None]
    frames = {'a': [Fake(target_id=np.arange(31))]}
    for direction in ([1.0, 2, 3], [1.0, 0, 0]):
        line = along * direction + [20.0, -7, 5]
        assert not inputs.find_wrong_phantom(frames, Fake(target_id=np.arange(31), xyz_mm=line))
    bent = line + np.where(np.arange(31) % 2, 1.0, 0.0)[:, None] * [0, 3, 0]
    (found,) = inputs.find_wrong_phantom(frames, Fake(target_id=np.arange(31), xyz_mm=bent))
    assert found.kind is Kind.REMOTE_TARGETS and found.place.target_id == (30,)


def test_names_of_fluoroscopes_may_have_capitals_but_not_differ_in_these():
    inputs.validate_names(['A', 'b', 'Ab'])
    inputs.validate_names(['A', 'A'])
    with pytest.raises(DataError, match='fluoroscopes Ab and aB differ only in case') as told:
        inputs.validate_names(['b', 'Ab', 'c', 'aB'])
    assert told.value.finding.place.fluoroscopes == ('Ab', 'aB')


def test_sigma_is_plausible_within_its_limits():
    low, high = inputs.PLAUSIBLE['sigma_px']
    phantom = Phantom(np.arange(20), np.arange(60.0).reshape(20, 3), np.ones(20))
    inputs.validate_magnitudes({'a': [frame(sigma=np.linspace(low, high, 20))]}, phantom)
    for wrong in (np.nextafter(low, 0), np.nextafter(high, np.inf)):
        with pytest.raises(DataError) as refused:
            given = frame(sigma=np.append(np.ones(19), wrong))
            inputs.validate_magnitudes({'a': [given]}, phantom)
        assert refused.value.finding.kind is Kind.IMPLAUSIBLE_NUMBER
        assert refused.value.finding.numbers == {'sigma_px': wrong}
        assert refused.value.finding.place.target_id == (19,)


def test_residuals_may_be_as_large_as_their_sigma_says():
    made = figures(rmse_after=np.array([3.9, 3.9]))
    assert kinds(found_in(made)) == [Kind.LARGE_RESIDUALS]
    assert found_in(made, sigma=np.full(20, 1.0)) == []
    (found,) = found_in(figures(rmse_after=np.array([4.1, 4.1])), sigma=np.full(20, 1.0))
    assert found.numbers['limit_px'] == 4.0


@pytest.mark.parametrize(
    ('offset', 'about_middle', 'is_off'),
    [
        (900.0, 900.0, False),
        (1100.0, 1100.0, True),
        (900.0, 1100.0, False),
        (1100.0, 900.0, False),
    ],
)
def test_principal_point_is_within_an_image_of_the_middle(offset, about_middle, is_off):
    """In its own gauge, or in that of a correction about the image centre."""
    own, other = (np.array([511.5 + each, 383.5, 4000.0]) for each in (offset, about_middle))
    found = found_in(figures(interior=own), calibration(interior=other))
    assert kinds(found) == ([Kind.PRINCIPAL_POINT_OFF] if is_off else [])
    if is_off:
        assert found[0].numbers['offset_px'] == pytest.approx(offset, rel=0.1)


def test_principal_distance_that_is_fixed_is_compared_with_the_correction():
    uv = calibration().model.train_uv
    for scale, is_wrong in ((0.1, False), (0.4, True)):
        duv = scale * (uv - [511.5, 383.5])
        model = rigs.create_model('local_linear', 6, uv, duv, 0.2, 0.0)
        held = calibration(model=model, train_exposure=np.zeros(len(uv), int))
        found = found_in(figures(interior_sd=np.zeros(3)), held)
        assert kinds(found) == ([Kind.WRONG_PRINCIPAL_DISTANCE] if is_wrong else [])


def test_cause_is_named_where_more_than_half_of_the_exposures_have_it(monkeypatch):
    mirrored = Finding(Kind.IMAGE_MIRRORED, 'm')
    shifted = Finding(Kind.IDS_SHIFTED, 's')
    for causes, expected in (
        ([mirrored, shifted, mirrored, None, None], mirrored),
        ([mirrored, mirrored, None, None], None),
        ([shifted, None, None], None),
        ([shifted, shifted, None], shifted),
        ([], None),
    ):
        given = iter(causes)
        monkeypatch.setattr(inputs, '_cause', lambda *_, given=given: next(given))
        shown = [Fake(target_id=range(50)) for _ in causes]
        assert inputs._wrong_exposures(shown, None) is expected


# ---- precision and the verdict


def evidence(claimed=0.1, size=0.0, limit=0.05, sd=0.5, redundancy=0.5, shown=0.9):
    table = Fake(
        redundancy=np.array([redundancy, 9.0, 9.0]),
        fluoroscope=np.array(['a', 'a', 'b']),
        outlier=np.array([False, True, False]),
    )
    return Fake(
        trends={'a': Fake(claimed_sd=claimed, trend=Fake(size=size, limit=limit))},
        calibrations={'a': Fake(image_sd=sd, rmse_after=np.full(2, shown * sd))},
        frames={'a': range(8)},
        result=Fake(residuals=table),
        request=Fake(options=Fake(model_name='auto')),
    )


@pytest.mark.parametrize(
    ('given', 'ratio', 'noise'),
    [
        ({}, 0.2, 0.5),
        ({'size': 0.05}, 0.2, 0.5),
        ({'size': 0.2}, 0.1 / np.sqrt(0.25 - 0.08), np.sqrt(0.25 - 0.08)),
        ({'size': 0.6}, np.inf, 0.0),
    ],
)
def test_precision_is_that_of_the_correction_over_the_noise(given, ratio, noise):
    found = field_checks.check_precision(evidence(**given), 'a')
    assert found.value == pytest.approx(ratio) and found.limit == field_checks.MAX_RATIO
    assert found.numbers['noise_px'] == pytest.approx(noise)
    assert found.numbers['exposures'] == 8
    assert 'inf' not in str(found)
    growth = 100 * (np.hypot(1, ratio) - 1)
    assert (f'corrected points {growth:.0f} % larger' in found.cause) is bool(np.isfinite(ratio))


def test_precision_is_unknown_where_residuals_do_not_show_the_noise():
    found = field_checks.check_precision(evidence(shown=0.31), 'a')
    assert found.passed is None and found.numbers['sd_px'] == pytest.approx(0.1)
    assert field_checks.check_precision(evidence(shown=0.32), 'a').passed


def trends_of(monkeypatch, change=None, rejected=None, model_name='auto', corrects=True):
    """Checks of whiteness, worst area and drift for an image of 1000 x 500 px."""
    trend = Fake(size=0.2, place=np.array([300.0, 40.0]), cell_size=0.5, cell_limit=0.3)
    common = Fake(
        trend=trend,
        limit=0.1,
        rejected=rejected,
        claimed_sd=0.05,
        inliers='all',
        is_significant=False,
    )
    change = change or Fake(size=0.3, limit=0.2, cell_size=0.9, cell_limit=0.6)
    change.place = np.array([900.0, 450.0])
    monkeypatch.setattr(field_checks, 'change_of_trend', lambda inliers, size: change)
    model = Fake(corrects=corrects, kind='knn', evaluate=lambda uv: Fake(sd=np.array([0.1])))
    evidence = Fake(
        trends={'a': common},
        calibrations={'a': Fake(model=model, image_size=(1000, 500))},
        frames={'a': range(12)},
        request=Fake(options=Fake(model_name=model_name)),
    )
    return field_checks.check_trends(evidence, ['a'])


def test_trends_are_told_with_their_place_and_limit(monkeypatch):
    white, area, drift = trends_of(monkeypatch)
    assert (white.kind, white.value, white.limit) == (Kind.WHITENESS, 0.2, 0.1)
    assert (area.kind, area.value) == (Kind.WORST_AREA, 0.5)
    assert area.limit == pytest.approx(np.hypot(0.3, 3 * 0.1))
    assert (drift.kind, drift.value, drift.limit) == (Kind.DRIFT, 0.3, 0.2)
    for one, place in ((white, (300, 40)), (area, (300, 40)), (drift, (900, 450))):
        assert f'u {place[0]}, v {place[1]}' in str(one)
    only_area = Fake(size=0.1, limit=0.2, cell_size=0.9, cell_limit=0.6)
    assert trends_of(monkeypatch, only_area)[2].value == 0.9
    none = Fake(size=0.1, limit=0.2, cell_size=0.5, cell_limit=0.6)
    assert (trends_of(monkeypatch, none)[2].value, trends_of(monkeypatch, none)[2].limit) == (
        0.1,
        0.2,
    )


def test_rejected_points_that_agree_are_the_worst_area(monkeypatch):
    rejected = Fake(size_px=0.8, limit_px=0.7, place=np.array([100.0, 450.0]), rows=np.arange(17))
    area = trends_of(monkeypatch, rejected=rejected)[1]
    assert (area.value, area.limit, area.numbers) == (0.8, 0.7, {'rejected_points': 17})
    assert 'u 100, v 450' in str(area)
    rejected.size_px = 0.6
    assert trends_of(monkeypatch, rejected=rejected)[1].value == 0.5


def test_another_model_is_advised_where_one_was_asked_for(monkeypatch):
    automatic, asked, none = (
        trends_of(monkeypatch, model_name=name, corrects=corrects)[0].advice
        for name, corrects in (('auto', True), ('knn', True), ('none', False))
    )
    assert '--model' not in automatic
    assert asked.startswith(automatic) and '--model auto' in asked
    assert none.startswith('calibrate with a correction model')


def test_variation_of_few_points_in_each_exposure_is_not_cured_by_more_exposures():
    def made(beads, exposures):
        evidence = Fake(
            frames={'a': [None] * exposures},
            phantom=Fake(target_id=np.arange(beads)),
            variations={'a': None},
        )
        check = field_checks.check_variation(evidence, 'a')
        assert check.kind is Kind.VARIATION and check.passed is None
        return check.advice

    more = more_exposures(3)
    assert made(503, 3) == more
    assert len({made(24, 3), made(24, 16), made(503, 16), more}) == 3
    assert made(24, 16) == made(24, 3) and made(503, 16) != more


def test_a_distortion_may_vary_by_a_part_of_the_noise():
    frames = [Fake(angle=angle) for angle in (0.1, 0.4, 0.2)]
    evidence = Fake(
        frames={'a': frames},
        variations={'a': Variation(1.7, 0.21, 0.4)},
        trends={'a': Fake(is_significant=False)},
    )
    check = field_checks.check_variation(evidence, 'a')
    assert check.value == 0.21 and check.limit == pytest.approx(field_checks.HARMLESS * 0.4)
    assert (check.numbers['chi2_per_dof'], check.numbers['noise_px']) == (1.7, 0.4)


def test_achieved_deviation_joins_claim_halves_trend_and_variation():
    given = Fake(trends={'a': Fake(claimed_sd=0.3)})
    checks = [
        check(2.0, 1.0),
        check(0.8, 1.0, Kind.WHITENESS),
        check(9.0, 1.0, Kind.VARIATION, 'b'),
        check(np.nan, 1.0, Kind.VARIATION),
    ]
    assert verdict._achieved_sd(given, 'a', checks) == pytest.approx(1.0)
    assert verdict._achieved_sd(given, 'a', [check(0.5, 1.0)]) == pytest.approx(0.3)


def test_corrections_that_change_with_an_angle_are_taken_on_trust():
    turning, still = Fake(angle_field=object()), Fake(angle_field=None)
    (found,) = verdict.trusted_angles({'a': still, 'b': turning})
    assert found.kind is Kind.TAKEN_ON_TRUST and found.severity is Severity.NOTE
    assert found.place.fluoroscopes == ('b',)
    assert found.numbers == {'nse': 2.0, 'share': 0.07}


def test_limits_of_exposures_follow_their_scatter_and_noise():
    calm = np.full(10, 1.1)
    assert exposure_limits(calm, calm).tolist() == [1.6] * 10
    ratio = np.exp(np.tile([-0.1, 0.1], 5))
    factor = 4 + 20 / 10
    wide = np.exp(factor * 0.1 / ndtri(0.75))
    np.testing.assert_allclose(exposure_limits(ratio, np.full(10, 9.0)), wide)
    np.testing.assert_allclose(exposure_limits(ratio, np.full(10, 1.2)), 1.6 * 1.2)
    np.testing.assert_allclose(exposure_limits(ratio, np.full(10, 0.2)), 1.6)


def test_white_part_is_half_the_squared_difference_of_neighbours():
    uv = np.array([[0.0, 0], [1, 0], [50, 0], [51, 0]])
    r = np.array([[1.0, 0], [3, 0], [0, 1], [0, 1.5]])
    assert _white(uv, r, np.full(4, 9.0)) == pytest.approx(2 * 2 + 2 * 0.125)
    cap = INLIER_Q * 0.1**2
    assert _white(uv, r, np.full(4, 0.1)) == pytest.approx(2 * min(2, cap) + 2 * min(0.125, cap))
    assert _white(uv[:1], r[:1], np.ones(1)) == 0


def sums(number, outside, inside, predicted, points=50):
    return held_out.ExposureSums(
        number, points, points, outside, inside, predicted=predicted, white=inside
    )


def test_exposures_held_out_are_expected_to_have_noise_and_error_of_the_correction():
    common = Fake(trend=Fake(size=0.1), is_significant=False, of_exposure=None)
    given = Fake(trends={'a': common}, frames={'a': range(15)})
    parts = [sums(n, 14.0, 11.0, 3.0) for n in range(1, 15)] + [sums(20, 60.0, 11.0, 3.0)]
    whole, of_one = held_out._checks(given, 'a', parts)
    noise = 11 - 2 * 50 * 0.01
    assert whole.value == pytest.approx(np.sqrt((14 * 14 + 60) / (2 * 50 * 15)))
    assert whole.numbers['expected_px'] == pytest.approx(np.sqrt((noise + 3) / 100))
    assert whole.limit == pytest.approx(1.13 * whole.numbers['expected_px'])
    assert of_one.place.exposures == (20,)
    assert of_one.value == pytest.approx(np.sqrt(60 / (noise + 3))) and of_one.limit == 1.6
    common.trend.size = 9.0
    whole, _ = held_out._checks(given, 'a', parts)
    assert whole.numbers['expected_px'] == pytest.approx(np.sqrt((0.05 * 11 + 3) / 100))


@pytest.mark.parametrize(
    ('agreement', 'outside', 'is_told'),
    [(5.0, 14.0, True), (3.0, 14.0, False), (5.0, 60.0, False)],
)
def test_rejected_points_that_agree_are_told_where_no_exposure_stands_out(
    agreement, outside, is_told
):
    of_exposure = Fake(number=4, points=12, of=60, agreement=agreement, limit=4.0)
    common = Fake(trend=Fake(size=0.1), is_significant=False, of_exposure=of_exposure)
    given = Fake(trends={'a': common}, frames={'a': range(15)})
    parts = [sums(n, 14.0, 11.0, 3.0) for n in range(1, 15)] + [sums(20, outside, 11.0, 3.0)]
    _, of_one = held_out._checks(given, 'a', parts)
    if is_told:
        assert of_one.place.exposures == (4,) and (of_one.value, of_one.limit) == (5.0, 4.0)
        assert of_one.numbers == {'rejected_points': 12, 'points': 60} and not of_one.passed
    else:
        assert of_one.unit == '1' and of_one.passed is (outside < 50)


def test_fit_is_poor_from_a_multiple_of_the_noise():
    limit = held_out.MAX_NOISE * 0.5
    adjusted = rigs.adjusted(0.5, a=(9.0, 0.99 * limit), b=(9.0, 1.01 * limit), c=(0.1, 9.0))
    found = held_out.poor_fits(*adjusted)
    assert kinds(found) == [Kind.POOR_CALIBRATION_FIT] * 2
    assert [one.place.fluoroscopes for one in found] == [('b',), ('c',)]
    for one in found[:1]:
        assert one.numbers['rmse_px'] == pytest.approx(1.01 * limit)
        assert one.numbers['ratio'] == pytest.approx(1.01 * held_out.MAX_NOISE)


def test_misfits_are_of_residuals_over_the_noise_of_each_image_point():
    result, calibrations, frames = rigs.adjusted(0.5, a=(9.0, 1.2), b=(9.0, 0.9))
    assert misfits(result, calibrations, frames) == {'a': pytest.approx(2.4)}
    frames['a'] = [replace(frames['a'][0], sigma=np.array([0.5, 50.0]))]
    assert not misfits(result, calibrations, frames)
    result.residuals.outlier[1] = True
    assert misfits(result, calibrations, frames) == {'a': pytest.approx(2.4)}


# ---- comparison


def test_grids_lie_evenly_over_the_image():
    _, cells = cell_centres((640, 320), CELLS)
    assert cells[0].tolist() == [4.5, 4.5] and cells[-1].tolist() == [634.5, 314.5]
    assert len(cells) == 64 * 32
    names = [place_name(uv, (90, 90)) for uv in ((5, 5), (45, 45), (80, 45), (45, 80))]
    assert names == ['upper left', 'middle', 'middle right', 'lower middle']


def test_orientations_absorb_shift_scale_rotation_and_tilt():
    fields = orientation_fields([[2.0, 3.0]])
    assert fields.tolist() == [[[1, 0, 2, -3, 4, 6], [0, 1, 3, 2, 6, 9]]]


def test_difference_of_predictions_is_without_gauge_and_signed():
    _, uv = cell_centres(SIZE, 24)
    interior = np.array([511.5, 383.5, 2000.0])
    bump = np.exp(-np.sum((uv - [300, 500]) ** 2, axis=1) / 2 / 40**2)[:, None] * [3.0, -1]
    sd = np.full(len(uv), 0.3)
    one = Correction(np.zeros_like(uv), sd, np.zeros(len(uv), bool))
    other = Correction(bump + [4, 5] + 0.01 * (uv - 500), 4 / 3 * sd, one.outside)
    found = _difference(uv, (interior, interior), (one, other))
    np.testing.assert_allclose(found.sd, 0.5)
    peak = np.argmax(np.linalg.norm(bump, axis=1))
    assert found.duv[peak] == pytest.approx(bump[peak], abs=0.35)
    assert np.abs(found.duv[np.linalg.norm(bump, axis=1) < 1e-3]).max() < 0.4
    assert found.worst.tolist() == uv[peak].tolist()


def test_difference_is_normalised_by_two_coordinates():
    found = FieldDifference(np.eye(2), np.array([[3.0, 4], [0, 1]]), np.array([5.0, 0.5]))
    assert found.rms_px == pytest.approx(np.sqrt(26 / 4))
    assert found.normalised == pytest.approx(np.sqrt((25 / 50 + 1 / 0.5) / 2))
    assert found.worst.tolist() == [0, 1]


def test_interior_is_compared_where_it_has_a_variance():
    value, limit = _test(np.array([2.0, 9, 4]), np.diag([4.0, 0, 16]))
    assert value == pytest.approx(2.0) and limit == pytest.approx(9.21, abs=0.01)
    assert np.isnan(_test(np.ones(3), np.zeros((3, 3)))).all()


def test_comparison_counts_what_exceeds_its_quantile():
    duv = np.array([[0.3, 0.4], [0.0, 0.1], [0, 0.3], [0, 0]])
    found = Comparison(
        'a', SIZE, np.zeros(3), np.ones(3), 12.0, 11.0, np.eye(4, 2), duv, np.full(4, 0.1)
    )
    assert found.significant.tolist() == [True, False, False, False]  # 0.1 * 3.03
    assert found.field_changed and found.interior_changed
    assert found.rms_px == pytest.approx(np.sqrt((0.25 + 0.01 + 0.09) / 4))
    assert found.largest == (0.5, (1.0, 0.0))
    calm = replace(found, duv=0.5 * duv, interior_test=11.0)
    assert not calm.field_changed and not calm.interior_changed


# ---- beads


def beads(scale=1.0, shift=(0.0, 0, 0), n=12, sd=0.1):
    survey = RNG.uniform(-80, 80, (n, 3))
    xyz = scale * survey + shift
    covariance = np.tile(np.diag([0.01, 0.02, 0.03]), (n, 1, 1))
    return Beads(np.arange(n), xyz, covariance, np.full(n, 5), survey, np.full(n, sd))


def test_scale_of_beads_is_that_of_the_images():
    scale, sd = _scale(beads(1.002, (3, -4, 5)))
    assert scale == pytest.approx(0.002, rel=1e-6) and 0 < sd < 1e-3
    assert _scale(beads(0.999))[0] == pytest.approx(-0.001, rel=1e-6)
    assert _scale(beads(sd=1.0))[1] > 3 * _scale(beads(sd=0.0))[1]


def test_distances_of_three_beads_have_their_rms_and_expectation():
    survey = np.array([[0.0, 0, 0], [30, 0, 0], [0, 40, 0]]) + [7, -3, 20]
    xyz = survey + [[0, 0, 0], [0.3, 0, 0], [0, -0.4, 0]]
    given = Beads(
        np.arange(3),
        xyz,
        np.tile(np.diag([0.01, 0.04, 0.09]), (3, 1, 1)),
        np.full(3, 5),
        survey,
        np.full(3, 0.1),
    )
    found = distances(given)
    errors = [0.3, -0.4, np.hypot(30.3, 39.6) - 50]
    assert found.rmse_mm == pytest.approx(np.sqrt(np.mean(np.square(errors))))
    along = [2 * 0.02, 2 * 0.05, 2 * (0.36 * 0.02 + 0.64 * 0.05)]
    assert found.expected_mm == pytest.approx(np.sqrt(np.mean(along)))
    assert 1 < found.freedom < 3
    assert given.chi2[0] == 0 and given.chi2[1] == pytest.approx(0.09 / 0.02)
    assert given.without(np.array([1])).target_id.tolist() == [0, 2]


def test_beads_of_which_most_points_are_rejected_are_named():
    target = np.repeat(np.arange(10), 12)
    outlier = np.zeros(120, bool)
    outlier[12:24] = True  # all points of bead 1
    outlier[24:30] = True  # half of the points of bead 2
    outlier[36] = True
    exposure = np.arange(120) % 12
    name = np.full(120, 'a')
    table = Fake(target_id=target, outlier=outlier, exposure=exposure, fluoroscope=name)
    assert rejected_beads(table).tolist() == [1]
    outlier[30:33] = True
    assert rejected_beads(table).tolist() == [1, 2]


def test_layers_are_between_the_largest_gaps():
    coordinate = np.concatenate([np.zeros(12), np.full(8, 10.0), np.full(20, 30.0)])
    found = {tuple(pair) for pair in _layers(coordinate, np.full(40, 0.1)).tolist()}
    assert {(0, 12), (12, 20), (20, 40), (0, 20)} <= found
    assert all(stop - start <= 20 for start, stop in found)
    # The survey does not resolve gaps of less than 13 mm, so only the last gap is a border.
    vague = _layers(coordinate, np.full(40, 13 / 18**0.5)).tolist()
    assert vague == [[0, 20], [20, 40]]
    sums = _sums(np.arange(1.0, 6.0), np.array([0, 2]), np.array([2, 5]))
    assert sums.tolist() == [3, 12]


def test_strains_are_unit_tensors_without_a_common_scale():
    survey = RNG.uniform(-50, 50, (20, 3))
    tensors, displacement = shape._strains(survey)
    products = np.einsum('iab,jab->ij', tensors, tensors)
    np.testing.assert_allclose(products, np.eye(5), atol=1e-12)
    np.testing.assert_allclose(np.trace(tensors, axis1=1, axis2=2), 0, atol=1e-12)
    offset = survey - survey.mean(axis=0)
    np.testing.assert_allclose(displacement[:, :, 3], offset @ tensors[3])
    left = shape._without_similarity(displacement, survey, np.full(20, 0.1))
    for similarity in (np.eye(3)[0] + 0 * offset, np.cross([0, 1, 0], offset), offset):
        assert np.einsum('na,nat->t', similarity, left) == pytest.approx(np.zeros(5), abs=1e-6)


def test_largest_strain_has_a_positive_direction():
    direction, size = shape._principal(np.diag([0.1, -0.5, 0.2]))
    assert direction.tolist() == [0, 1, 0] and size == -0.5
    axis = np.array([-2.0, 1, 2]) / 3
    direction, size = shape._principal(0.4 * np.outer(axis, axis))
    assert size == pytest.approx(0.4) and abs(direction @ axis) == pytest.approx(1)
    assert direction[np.argmax(np.abs(direction))] > 0


@pytest.mark.parametrize(('nse', 'count'), [(1.0, 0), (1.1, 1)])
def test_strain_that_would_not_be_seen_is_told_above_its_limit(nse, count):
    numbers = {'hidden_nse': nse, 'hidden_strain': -0.02}
    numbers |= dict(zip(shape.HIDDEN, (0.0, 0.6, 0.8)))
    given = Check(Kind.SHAPE, 'x', numbers=numbers, value=0.0, limit=1.0)
    found = shape.trusted_shape([given, check(1, 2)])
    assert len(found) == count
    if found:
        assert found[0].numbers == {'strain': 0.02, 'nse': 1.1} and '2.00 %' in found[0].cause


# ---- the rig


def scatter(**changes):
    values = {
        'fluoroscopes': ('a', 'b'),
        'off_px': np.full(8, 0.4),
        'used': np.ones(8, bool),
        'exposures': np.arange(8) + 1,
        'unexplained': 1.2,
        'corrected': True,
        'angle_px': 0.0,
    }
    return Fake(**{**values, **changes})


def test_pairs_that_were_left_out_are_named_with_the_largest_displacement():
    assert doubtful(scatter(), 1000, 0.3) == (True, [])
    used = np.arange(8) != 4
    off = np.where(used, 0.4, 7.0)
    usable, (found,) = doubtful(scatter(used=used, off_px=off), 1000, 0.3)
    assert usable and found.place.exposures == (5,) and found.numbers['off_px'] == 7.0
    usable, (found,) = doubtful(scatter(corrected=False, angle_px=0.3), 1000, 0.3)
    assert usable and found.kind is Kind.RIG_DEPENDS_ON_ANGLE
    assert doubtful(scatter(corrected=False, angle_px=0.29), 1000, 0.3) == (True, [])


@pytest.mark.parametrize(
    ('unexplained', 'off', 'usable'),
    [(2.1, 2.5, True), (8.0, 9.0, True), (8.1, 2.5, True), (8.1, 2.6, False)],
)
def test_scatter_gives_no_orientation_where_it_is_large_in_both(
    monkeypatch, unexplained, off, usable
):
    monkeypatch.setattr('fluoro_calib_ros.checks.rig._cause', lambda _: (Kind.RIG_MOVED, (), 'm'))
    given = scatter(unexplained=unexplained, off_px=np.full(8, off))
    found, (doubt,) = doubtful(given, 1000, 0.3)
    assert found is usable and doubt.numbers == {'off_px': off, 'ratio': unexplained}
    assert doubtful(scatter(unexplained=2.0, off_px=np.full(8, 9.0)), 1000, 0.3) == (True, [])
    assert doubtful(scatter(unexplained=9.0, off_px=np.full(8, 0.2)), 1000, 0.3) == (True, [])


def test_motion_between_stamps_is_at_the_speed_between_exposures():
    uv = RNG.uniform(0, 700, (10, 2))

    def stamped(number, stamp, shift):
        return frame(number, uv + [shift, 0], stamp_ns=stamp)

    one = [stamped(n, 1000 * n, 6.0 * n) for n in (1, 2, 3, 4)]
    other = [stamped(n, 1000 * n + delay, 0) for n, delay in ((2, 250), (3, -250), (4, 500))]
    assert motion_between_stamps(one, other) == pytest.approx(1.5)
    assert motion_between_stamps(one[::-1], other) == pytest.approx(1.5)
    assert motion_between_stamps(one, [replace(f, stamp_ns=0) for f in other]) is None
    few = [replace(f, target_id=f.target_id[:7], uv=f.uv[:7]) for f in one]
    assert motion_between_stamps(few, other) is None


@pytest.mark.parametrize(
    ('last', 'now', 'due'),
    [(None, 5, True), (100, 174, False), (100, 175, True), (100, 100, False), (100, 99, True)],
)
def test_exposures_are_examined_at_a_rate_and_after_a_restart(last, now, due):
    watch = RigDriftWatch.__new__(RigDriftWatch)
    watch._last_ns, watch._min_interval_ns = last, 75
    assert watch.is_due(now) is due


def test_the_watch_tells_noise_from_what_is_common_to_exposures():
    """Claimed correction errors are not noise; rays that are far apart are no evidence."""
    told = []
    watch = RigDriftWatch.__new__(RigDriftWatch)
    watch._addition, watch._has_bodies, watch._names = None, False, ('a', 'b')
    watch._of_charts = watch._state = 'fine'
    watch._watch = Fake(state='fine', add_residuals=lambda *given: told.append(given))
    watch._change = Fake(add=lambda *given: told.append(given))
    one, two, three = np.full(4, 0.5), np.full(4, 0.8), np.array([0.0, 1, -5.39, 5.41])
    found = Fake(
        residual=three,
        sd=np.full(4, 0.3),
        sd_total=np.full(4, 0.6),
        normal_a=np.ones((4, 2)),
        normal_b=np.zeros((4, 2)),
        factor_a=one,
        factor_b=two,
    )
    watch._pairs = [(0, 1, Fake(residuals=lambda *given: found))]
    sigma = np.array([[0.5] * 4, [0.4] * 4])
    views = Fake(
        uv=np.ones((2, 4, 2)), sigma=sigma, correction_sd=np.array([[0.4] * 4, [0.5] * 4])
    )
    exposure = Fake(target_id=np.arange(4) + 7, views=views)
    assert watch.add_exposure(55, exposure) == 'fine' and watch._last_ns == 55
    (number, every), (stamp, pair, given) = told
    # Only the noise of a remains, that of b is all correction.
    np.testing.assert_allclose(every.noise, 0.5**2 * (0.5**2 - 0.4**2))
    assert number == 0 and every.residual is three
    assert (stamp, pair) == (55, 0) and given.target_id.tolist() == [7, 8, 9]
    np.testing.assert_allclose(given.noise + given.systematic, 0.6**2)
    np.testing.assert_allclose(given.noise, every.noise[:3])
    np.testing.assert_array_equal(given.residual, three[:3])


# ---- charts of the drift watch


@pytest.mark.parametrize(
    'wrong',
    [{'cells': 3}, {'warn_interval_h': 2000.0}, {'learn_s': 1.0, 'block_s': 0.3}, {'clip': 0.5}],
)
def test_options_of_the_watch_that_make_no_sense_are_refused(wrong):
    with pytest.raises(ValueError):
        DriftOptions(**wrong)
    assert DriftOptions(learn_s=1.2, block_s=0.3) and DriftOptions(warn_interval_h=1000.0)


def observations(n=4, **changes):
    values = {
        'target_id': np.arange(n),
        'uv_a': np.full((n, 2), 10.0),
        'uv_b': np.full((n, 2), 20.0),
        'residual': np.arange(n) + 1.0,
        'sd': np.full(n, 0.2),
        'sd_total': np.full(n, np.hypot(0.2, 0.1)),
        'noise': np.full(n, 0.2**2),
        'normal_a': np.tile([1.0, 0], (n, 1)),
        'normal_b': np.tile([0.0, 1], (n, 1)),
        'factor_a': np.full(n, 0.5),
        'factor_b': np.full(n, 0.8),
    }
    return EpipolarObservations(**{**values, **changes})


def test_observations_leave_out_what_is_not_finite():
    bad = observations(
        noise=np.array([0.2, 0, 0.2, 0.2]),
        residual=np.array([1, 2, np.nan, 4]),
        uv_b=np.array([[1, np.inf], [1, 1], [1, 1], [1, 1]]),
    )
    assert bad.usable().target_id.tolist() == [3]
    assert len(joined_rows([bad, observations()])) == 8
    for name in ('noise', 'factor_a', 'factor_b'):
        none = observations(**{name: np.array([0.1, 0.0, 0.3, -0.1])})
        assert none.usable().target_id.tolist() == [0, 2]


def test_areas_of_an_image_are_cells_windows_halves_and_the_whole():
    areas = ImageAreas(4)
    size = (400, 200)
    assert len(areas) == 16 + 9 + 5
    assert areas.cell(np.array([[-5.0, 10], [399, 199], [150, 60]]), size).tolist() == [0, 15, 5]
    names = {areas.describe(number, size)[1]: number for number in range(len(areas))}
    corners, _ = areas.describe(names['right half'], size)
    assert corners == (199.5, -0.5, 399.5, 199.5)
    assert areas.describe(names['lower half'], size)[0] == (-0.5, 99.5, 399.5, 199.5)
    assert areas.describe(names['middle'], size)[0] == (99.5, 49.5, 299.5, 149.5)
    assert areas.describe(names['upper right quarter'], size)[0] == (199.5, -0.5, 399.5, 99.5)
    assert {'whole image', 'upper middle', 'middle left'} <= set(names)
    assert areas.describe(3, size)[1].endswith('about (350, 24) px')
    assert areas.member[names['upper half']].reshape(4, 4).sum(axis=1).tolist() == [4, 4, 0, 0]
    assert areas.member[names['left half']].reshape(4, 4).sum(axis=0).tolist() == [4, 4, 0, 0]
    assert len(ImageAreas(2)) == 4 + 5


def test_charts_sum_the_likelihood_of_a_drift_beyond_the_band():
    charts = CusumCharts(1, 1, 0.2, 30.0)
    one, yes = np.ones((1, 1)), np.ones((1, 1), bool)
    gain = 0.2 * (3 - 0.5 * 4 - 0.1 * 4) / 1.25
    for number, expected in enumerate([gain, 2 * gain], 1):
        charts.update(3 * one, 4 * one, 0.5 * one, yes, 100 * number)
        assert charts.evidence[0, 0, 0] == pytest.approx(expected)
        assert charts.evidence[1, 0, 0] == 0
    assert charts.begin[0, 0, 0] == 100
    assert charts.log_likelihood()[0, 0, 0] == pytest.approx(36 / (2 * 8 * 1.25))
    charts.update(-9 * one, 4 * one, 0.5 * one, yes, 300)
    assert charts.evidence[0, 0, 0] == 0 and charts.begin[1, 0, 0] == 300
    assert charts.evidence[1, 0, 0] == pytest.approx(0.2 * (9 - 2 - 0.4) / 1.25)
    before = charts.evidence.copy()
    charts.update(-9 * one, 4 * one, 0.5 * one, ~yes, 400)
    charts.update(0 * one, 0 * one, 0.5 * one, yes, 500)
    assert np.array_equal(charts.evidence, before)
    capped = CusumCharts(1, 1, 0.2, 30.0)
    for _ in range(9):
        capped.update(1e6 * one, 4 * one, 0 * one, yes, 1)
    assert capped.evidence[0, 0, 0] == 30.0
    slow = CusumCharts(1, 1, 0.2, 30.0)
    slow.update(1e6 * one, 4 * one, 0 * one, yes, 1)
    assert slow.evidence[0, 0, 0] == pytest.approx(30 / 1.5 / 4)


def test_variance_of_blocks_is_that_of_their_differences():
    charts = CusumCharts(1, 2, 0.1, 30.0)
    yes = np.ones((1, 2), bool)
    for value in (0.0, 4.0):
        charts.update(np.array([[value, 0]]), np.ones((1, 2)), np.zeros((1, 2)), yes, 1)
    # 16 / 2, and 0; pooled with a variance as predicted
    pooled = (1 + 8) / 3
    expected = 1.25 * np.array([(20 * pooled + 8) / 21, 20 * pooled / 21])
    np.testing.assert_allclose(charts.variance_factor()[0], expected)
    charts.stretch[:] = 3
    np.testing.assert_allclose(charts.variance_factor()[0], 3 * expected)


def test_clock_closes_blocks_and_goes_on_after_a_restart():
    clock = BlockClock(0.5)
    half = 5 * 10**8
    assert clock.advance(100) is None and clock.advance(100 + half - 1) is None
    assert clock.advance(100 + half) == 100
    assert clock.advance(100 + half - 5) is None and clock.newest_ns == 100 + half
    assert clock.advance(100 + 4 * half + 7) == 100 + half  # three blocks later
    assert clock.advance(100 + 5 * half) == 100 + 4 * half
    newest = clock.newest_ns
    assert clock.advance(3) is None and clock.newest_ns == newest
    assert clock.advance(3 + half) == 100 + 5 * half and clock.newest_ns == newest + half


@pytest.mark.parametrize('calls', [1, 15])
def test_late_exposures_in_a_row_start_a_stream_anew(calls):
    """An exposure of six fluoroscopes is added in 15 pairs, and counts once."""
    clock = BlockClock(0.5)
    clock.advance(10**9)
    for late_ns in range(210, 110, -1):
        for _ in range(calls):
            clock.advance(10**9 - late_ns)
    assert clock._offset_ns == 0
    clock.advance(10**9 - 110)
    assert clock._offset_ns == 110


# ---- one pair of views


def test_interpolation_on_the_nodes_is_bilinear():
    field = SystematicErrorField([(140, 70), (70, 140)])
    nodes, weights = field.interpolation(np.array([[19.5 + 5, 9.5 + 2.5], [-9, 500]]), 0)
    assert nodes[0].tolist() == [9, 10, 17, 18]
    np.testing.assert_allclose(weights[0], [0.5625, 0.1875, 0.1875, 0.0625])
    assert nodes[1].tolist() == [48, 49, 56, 57] and weights[1].tolist() == [0, 0, 1, 0]
    assert field.interpolation(np.zeros((1, 2)), 1)[0][0, 0] == 64


def test_field_of_errors_follows_the_means_of_its_markers():
    field = SystematicErrorField([(140, 70), (140, 70)])
    uv = RNG.uniform(0, 70, (300, 2)) * [2, 1]
    found = [field.interpolation(uv, side) for side in (0, 1)]
    nodes = np.concatenate([one[0] for one in found], axis=1)
    weights = np.concatenate([one[1] for one in found], axis=1)
    marker = np.arange(300) // 1
    field.add(marker, nodes, weights, np.full(300, 0.4), np.full(300, 1e-4), np.full(300, 1.0))
    field.estimate(1.0)
    at = np.sum(field.mean[nodes] * weights, axis=1)
    np.testing.assert_allclose(at, 0.4, atol=0.02)
    unsure = SystematicErrorField([(140, 70), (140, 70)])
    unsure.add(marker, nodes, weights, np.full(300, 0.4), np.full(300, 1e4), np.full(300, 1.0))
    unsure.estimate(1.0)
    assert np.abs(unsure.mean).max() < 0.05
    assert np.diag(unsure.covariance).mean() > 1.9 * np.diag(field.covariance).mean()


def test_statistics_of_a_block_are_sums_over_its_areas():
    options = DriftOptions(tolerance_px=100.0, cells=2)
    areas = ImageAreas(2)
    watch = PairWatch([(100, 100), (100, 100)], areas, options)
    uv = np.array([[10.0, 10], [90, 10], [90, 90], [92, 92]])
    given = observations(uv_a=uv, uv_b=uv[::-1].copy(), sd_total=np.hypot(0.2, np.arange(4) / 10))
    block = watch.block(given)
    whole = len(areas) - 1
    a, b = 0.5 / 0.04, 0.8 / 0.04
    assert block.score[:, whole] == pytest.approx([10 * a, 10 * b, 10 * a, 10 * b])
    assert block.information[[0, 1], whole] == pytest.approx([4 * a * 0.5, 4 * b * 0.8])
    assert block.systematic[0, whole] == pytest.approx(0.6 * a / (4 * a * 0.5))
    assert block.normals[0, whole].tolist() == [4, 0]
    assert block.normals[1, whole].tolist() == [0, 4]
    assert block.enough[:, whole].all()
    left = int(np.flatnonzero((areas.box == [0, 0, 0.5, 1]).all(axis=1))[0])
    assert block.score[0, left] == pytest.approx(a) and not block.enough[0, left]
    assert block.score[1, left] == pytest.approx(4 * b)


@pytest.mark.parametrize('sign', [1, -1])
def test_residuals_are_clipped_at_noise_band_and_tolerance(sign):
    options = DriftOptions(cells=2)
    watch = PairWatch([(100, 100), (100, 100)], ImageAreas(2), options)
    given = observations(1, residual=np.array([sign * 50.0]))
    limit = 3 * 0.2 + 4 * 0.1 + 0.15 + 2 * 0.1
    score = watch.block(given).score[0, -1]
    assert score == pytest.approx(sign * limit * 0.5 / 0.04)


def test_stretch_is_that_of_noise_that_lasts():
    """1 for white noise, more for an autoregression, from differences over its lags."""
    rng = np.random.default_rng(1)
    white = rng.normal(size=8000)
    lasting = np.zeros(8000)
    for k in range(1, 8000):
        lasting[k] = 0.8 * lasting[k - 1] + 0.6 * white[k]
    found = []
    for series in (white, lasting):
        watch = PairWatch([(9, 9), (9, 9)], ImageAreas(2), DriftOptions(cells=2))
        assert watch.stretch() == 1.0
        for part in series.reshape(-1, 50):
            watch._update_correlation(np.zeros(50, int), part)
        found.append(watch.stretch())
    assert found[0] < 1.2
    n, r = 50 / (1 - LAGS[-1] / 50), 0.8
    long = (1 + r) / (1 - r)
    own = long - 2 * r * (1 - r**n) / (n * (1 - r) ** 2)
    shared = r * (1 - r**n) ** 2 / (n * (1 - r) ** 2)
    assert found[1] == pytest.approx(long / (own - shared), rel=0.1)


def test_levels_begin_at_their_thresholds():
    assert (OK, WARN, ERROR) == (Severity.NOTE, Severity.WARNING, Severity.ERROR)


@pytest.mark.parametrize(
    ('misfit', 'is_behind', 'distance_mm', 'relabelled', 'kind'),
    [
        (0.9 * inputs.FIT, False, 1000.0, None, None),
        (0.9 * inputs.FIT, True, 1000.0, None, Kind.IMAGE_MIRRORED),
        (0.9 * inputs.FIT, False, 1e6, None, Kind.WRONG_UNIT),
        (1.1 * inputs.FIT, True, 1000.0, None, Kind.IMAGE_MIRRORED),
        (1.1 * inputs.FIT, False, 1e6, None, Kind.WRONG_UNIT),
        (1.1 * inputs.FIT, False, None, None, None),
        (1.1 * inputs.OFF, True, 1000.0, None, Kind.OTHER_PHANTOM),
        (1.1 * inputs.OFF, True, 1000.0, 0.9 * inputs.AT, Kind.IDS_SHIFTED),
        (1.1 * inputs.OFF, True, 1000.0, 1.1 * inputs.AT, Kind.OTHER_PHANTOM),
        (1.1 * inputs.FIT, True, 1000.0, 1.3 * inputs.BETTER * inputs.FIT, Kind.IMAGE_MIRRORED),
    ],
)
def test_cause_of_an_exposure_is_that_of_its_fit(
    monkeypatch, misfit, is_behind, distance_mm, relabelled, kind
):
    """Misfits are relative to the image side; `relabelled` is the misfit with shifted ids."""
    fits = iter(
        [
            Fake(misfit_px=1000 * misfit, is_behind=is_behind, distance_mm=distance_mm),
            None if relabelled is None else Fake(misfit_px=1000 * relabelled),
        ]
    )
    monkeypatch.setattr(inputs, 'fit_to_phantom', lambda *_: next(fits, None))
    phantom = Phantom(np.arange(8), 100.0 * RNG.uniform(-1, 1, (8, 3)), np.full(8, 0.1))
    frame = Frame('a', 1, np.arange(8), np.zeros((8, 2)), (1000, 800))
    found = inputs._cause(frame, phantom)
    assert (found and found.kind) == kind
