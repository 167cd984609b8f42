# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Values just at a limit lie on its correct side; sums are spelt out on a few numbers."""

from dataclasses import replace
from types import SimpleNamespace as Fake

import numpy as np
import pytest
import rigs

from fluoro_calib_ros.checks import (
    beads as beads_module,
)
from fluoro_calib_ros.checks import (
    field_checks,
    held_out,
    inputs,
    mixed_units,
    pair_watch,
    residual_tests,
    rig,
    rig_change,
)
from fluoro_calib_ros.checks.bead_intersection import Beads
from fluoro_calib_ros.checks.beads import _Candidate, _layers, compare_with_survey, rejected_beads
from fluoro_calib_ros.checks.comparison import compare_calibrations, describe_place
from fluoro_calib_ros.checks.drift_charts import (
    CusumCharts,
    DriftOptions,
    EpipolarObservations,
    ImageAreas,
)
from fluoro_calib_ros.checks.residual_tests import Residuals, _joins
from fluoro_calib_ros.exposures.frame import Frame
from fluoro_calib_ros.exposures.phantom import Phantom
from fluoro_calib_ros.findings import Kind
from fluoro_calib_ros.photogrammetry.noise import INLIER_Q

RNG = np.random.default_rng(12)


def residuals(r, exposure=None, uv=None):
    r = np.asarray(r, dtype=float)
    exposure = np.zeros(len(r), dtype=int) if exposure is None else np.asarray(exposure)
    numbers = np.arange(exposure.max() + 1) + 1
    uv = np.column_stack([np.arange(len(r)), np.arange(len(r))]) if uv is None else np.array(uv)
    return Residuals(uv, r, exposure, np.arange(len(r)), numbers, np.full(len(numbers), np.nan))


def test_a_residual_at_the_border_of_the_core_belongs_to_it(monkeypatch):
    monkeypatch.setattr(residual_tests, 'INLIER_Q', 9.0)
    monkeypatch.setattr(residual_tests, 'LARGEST_SD', 6.0)
    given = residuals([[3, 0], [3.01, 0], [0, 5.99], [0, 6.0]])
    sd = np.ones(4)
    assert given.inliers(sd).target_id.tolist() == [0]
    assert given.rejected(sd).target_id.tolist() == [1, 2]
    assert given.capped(sd).tolist() == [9.0] * 4


def test_exposures_without_neighbours_in_each_other_have_no_joins():
    uv = [[0.0, 0], [0, 1], [900, 0], [900, 1]]
    given = residuals([[1.0, 2], [3, 4], [1, 0], [5, 0]], [0, 1, 2, 2], uv)
    with np.errstate(all='raise'):
        joins = _joins(given, 1)
    assert (joins.earlier.tolist(), joins.later.tolist()) == ([0], [1])
    assert joins.mean.tolist() == [11.0] and joins.count.tolist() == [2.0]


# ---- input


def test_residuals_just_as_large_as_is_plausible_are():
    figures = Fake(rmse_after=np.array([2.5, 2.5]), image_size=(1000, 800))
    assert inputs._large_residuals(figures, []) is None
    figures.rmse_after = np.nextafter(figures.rmse_after, 3.0)
    assert inputs._large_residuals(figures, []).kind is Kind.LARGE_RESIDUALS


@pytest.mark.parametrize(
    ('distance', 'rounded'),
    [(12_345.0, 10_000.0), (1.7, 2.0), (0.0123, 0.01), (260.0, 300.0), (0.0, 0.0), (None, None)],
)
def test_distance_of_the_source_is_told_by_its_first_digit(monkeypatch, distance, rounded):
    """Rounding makes all exposures have the same finding."""
    monkeypatch.setattr(inputs, 'wrong_unit', lambda mm, phantom: (mm, phantom))
    found = inputs._unit_cause('phantom', inputs.Fit(1.0, False, distance))
    assert found == (None if rounded is None else (pytest.approx(rounded), 'phantom'))


def test_targets_and_their_multiples_are_told_apart_by_a_projection():
    xyz = RNG.uniform(-80, 80, (30, 3))
    projection = np.hstack([np.diag([4000.0, 4000, 1]), [[0.0], [0.0], [900.0]]])
    projection[:2, 2] = 500.0
    image = np.column_stack([xyz, np.ones(30)]) @ projection.T
    uv = image[:, :2] / image[:, 2:]
    is_multiple = np.arange(30) % 3 == 0
    given = np.where(is_multiple[:, None], xyz / 10, xyz)
    near = projection * (1 + 1e-4 * RNG.normal(size=(3, 4)))
    scaled, median = mixed_units._refined(near, np.stack([given, 10 * given]), uv)
    assert scaled.tolist() == is_multiple.tolist() and median < 1e-6
    phantom = Phantom(np.arange(30) + 5, given, np.ones(30))
    frame = Frame('a', 1, np.arange(30) + 5, uv, (1024, 1024))
    factor, chosen = mixed_units._factor_by_samples(frame, given, np.arange(30), phantom)
    assert factor == 10.0 and chosen.tolist() == is_multiple.tolist()
    right = Phantom(np.arange(30) + 5, xyz, np.ones(30))
    assert mixed_units._factor_by_samples(frame, xyz, np.arange(30), right) is None


@pytest.mark.parametrize(
    ('degrees', 'what', 'is_asked'),
    [
        ((np.nan, 10.0), 'a C-arm at another angle', True),
        ((10.0, 10.0), 'a C-arm at another angle', False),
        ((0.0, 6.28), 'in radians', False),
        ((0.0, 6.29), 'belong to other exposures', False),
    ],
)
def test_what_may_be_wrong_with_angles_depends_on_their_range(degrees, what, is_asked):
    given = Fake(frames={'a': [Fake(angle=float(np.deg2rad(one))) for one in degrees]})
    assert what in field_checks._angles(given, 'a')
    assert bool(field_checks._how_to_give_angles(given, 'a')) is is_asked


# ---- beads


@pytest.mark.parametrize(
    ('start', 'stop', 'halves'),
    [
        (0, 5, [(0, 5), (5, 10)]),
        (5, 10, [(5, 10), (0, 5)]),
        (2, 7, [(2, 7)]),
        (0, 4, [(0, 4)]),
        (6, 10, [(6, 10)]),
    ],
)
def test_of_two_faces_with_as_many_beads_either_may_be_displaced(start, stop, halves):
    found = _Candidate(2, np.arange(10)[::-1], start, stop, 5.0).halves()
    assert [(one.start, one.stop) for one in found] == halves
    assert found[0].own.tolist() == list(range(10))[::-1][start:stop]


def test_a_border_of_a_layer_is_clear_of_the_deviations_of_both_beads_beside_it():
    coordinate = np.concatenate([np.zeros(10), np.full(10, 5.0), np.full(10, 10.0)])
    sd = np.full(30, 0.1)
    every = [[0, 10], [10, 20], [20, 30]]
    assert _layers(coordinate, sd).tolist() == every
    for row, left in ((9, [[20, 30]]), (10, [[20, 30]]), (19, [[0, 10]]), (20, [[0, 10]])):
        vague = sd.copy()
        vague[row] = 5 / 3
        assert _layers(coordinate, vague).tolist() == left
        vague[row] = 1.6
        assert _layers(coordinate, vague).tolist() == every


def test_ten_beads_are_enough_for_a_comparison_with_their_survey():
    xyz = RNG.uniform(-50, 50, (10, 3))
    beads = Beads(
        np.arange(10), xyz, np.tile(0.01 * np.eye(3), (10, 1, 1)), np.full(10, 4), xyz, np.ones(10)
    )
    assert [check.passed for check in compare_with_survey(beads)] == [True, True]
    found = compare_with_survey(beads.without(np.array([3])))
    assert [check.passed for check in found] == [None, None]
    assert [check.numbers for check in found] == [{'beads': 9}] * 2
    off = replace(beads, xyz_mm=xyz + (np.arange(10) == 4)[:, None] * [0.0, 20, 0])
    first, second = compare_with_survey(off)
    assert first.passed is False and first.place.target_id == (4,)
    assert second.passed is None and second.kind is Kind.DISTANCES  # nine distances remain


# ---- the rig and its drift


def test_motion_is_that_of_the_first_fluoroscope_between_its_stamps():
    """The second fluoroscope sees the phantom move twice as fast."""

    def stamped(number, stamp, speed):
        uv = np.arange(20.0).reshape(10, 2) + [speed * number, 0]
        return Frame('a', number, np.arange(10), uv, (1000, 800), stamp_ns=stamp)

    frames = {
        'a': [stamped(n, 1000 * n, 6.0) for n in (1, 2, 3, 4)],
        'b': [stamped(n, 1000 * n + 100, 12.0) for n in (1, 2, 3, 4)],
    }
    found = rig._trusted(frames, Fake(fluoroscopes=('a', 'b')), 0.5)
    assert found.numbers == {'moved_px': pytest.approx(0.6)}
    assert rig._trusted(frames, Fake(fluoroscopes=('b', 'a')), 0.5).numbers == {
        'moved_px': pytest.approx(1.2)
    }
    assert rig._trusted(frames, Fake(fluoroscopes=('a', 'b')), 0.6) is None


def test_what_an_alarm_adds_to_image_points_is_the_excess_of_their_variance(monkeypatch):
    change = rig_change.RigChange.__new__(rig_change.RigChange)
    rays = rig_change._Rays(
        residual=np.array([1.0, -1.0, 1.0]),
        noise=np.array([0.5, 1.0, 9.0]),
        systematic=np.array([1.0, 2.0, 0.0]),
        by_rig=np.tile([1.0, 3.0], (3, 1)),
        is_apart=np.zeros(3, bool),
    )
    change._hypotheses = [np.array([2.0, 0.6]), np.array([0.0, 0.8])]
    change._blocks = [rays, rays]
    asked = []
    monkeypatch.setattr(
        rig_change, '_weights', lambda *given: asked.append(given) or (3.0, np.ones(len(given[1])))
    )
    # Noise plus twice the systematic part: 2.5, 5 and 9.
    assert change.addition(2).image_sd == pytest.approx(np.sqrt(2 * 5.0))
    assert change.addition(1).image_sd == pytest.approx(np.sqrt(2 * 3.0))
    for design, residual, _ in asked:
        # Derivatives with respect to unknowns of unit variance: four times all causes together.
        np.testing.assert_allclose(design, np.tile([8.0, 12.0], (len(residual), 1)))
    assert asked[-1][2].tolist() == [1.5, 3.0, 9.0]
    monkeypatch.setattr(rig_change, '_weights', lambda *given: (1.0, np.ones(len(given[1]))))
    assert change.addition(2).image_sd == 0


def observations(residual, marker=None):
    n = len(residual)
    return EpipolarObservations(
        np.asarray(residual, dtype=float),
        sd=np.full(n, 0.2),
        sd_total=np.hypot(np.full(n, 0.2), 0.1),
        target_id=np.arange(n) if marker is None else np.asarray(marker),
        uv_a=np.full((n, 2), 10.0),
        uv_b=np.full((n, 2), 90.0),
        normal_a=np.tile([1.0, 0], (n, 1)),
        normal_b=np.tile([0.0, 1], (n, 1)),
        factor_a=np.full(n, 0.5),
        factor_b=np.full(n, 0.8),
        noise=np.full(n, 0.2) ** 2,
    )


@pytest.mark.parametrize(('markers', 'enough'), [(2, False), (3, True)])
def test_an_area_is_tested_with_so_many_different_markers(markers, enough):
    watch = pair_watch.PairWatch([(100, 100)] * 2, ImageAreas(2), DriftOptions(cells=2))
    block = watch.block(observations(np.zeros(6), np.arange(6) % markers))
    assert block.enough[:, -1].tolist() == [enough] * 4


def test_noise_that_lasts_is_seen_in_the_residuals_of_each_marker():
    """Per marker, in the order of frames, relative to the stated noise."""
    rng = np.random.default_rng(3)
    noise = np.zeros((3, 3000))
    for k in range(1, 3000):
        noise[:, k] = 0.8 * noise[:, k - 1] + 0.6 * rng.normal(size=3)
    watch, direct = (
        pair_watch.PairWatch([(100, 100)] * 2, ImageAreas(2), DriftOptions(cells=2))
        for _ in range(2)
    )
    for part in noise.reshape(3, 60, 50).transpose(1, 2, 0):
        watch.block(observations(0.2 * part.ravel(), np.tile([7, 9, 30], 50)))
        clipped = np.clip(part, -5.75, 5.75)  # 3 deviations of noise, 4 x 0.1 and 0.35 px
        direct._update_correlation(np.tile([0, 1, 2], 50), clipped.ravel())
    assert watch.stretch() == pytest.approx(direct.stretch()) and watch.stretch() > 1.1


def test_a_block_without_information_is_passed_over():
    """The next difference refers to the last block with information."""
    charts = CusumCharts(1, 1, 0.1, 30.0)
    one, yes = np.ones((1, 1)), np.ones((1, 1), bool)
    for score, information in ((0.0, 1.0), (0.0, 0.0), (4.0, 1.0)):
        charts.update(score * one, information * one, 0 * one, yes, 1)
    assert charts.variance_factor()[0, 0] == pytest.approx(1.25 * (20 * 4.5 + 8) / 21)


# ---- more on input


def phantom_of(count=30):
    return Phantom(np.arange(count) + 5, RNG.uniform(-80, 80, (count, 3)), np.ones(count))


def shown(phantom, number=1, mirrored=False):
    """A frame of all targets, seen from 900 mm."""
    x, y, z = (phantom.xyz_mm + [0, 0, 900.0]).T
    uv = 500.0 + 4000.0 * np.column_stack([-x if mirrored else x, y]) / z[:, None]
    return Frame('a', number, phantom.target_id, uv, (1000, 1000))


@pytest.mark.parametrize('mirrored', [False, True])
def test_an_exposure_fits_its_phantom_from_its_distance(mirrored):
    phantom = phantom_of()
    fit = inputs.fit_to_phantom(shown(phantom, mirrored=mirrored), phantom, phantom.target_id)
    assert fit.misfit_px < 1e-3 and fit.is_behind is mirrored
    middle = phantom.xyz_mm.mean(axis=0) + [0, 0, 900]
    assert fit.distance_mm == pytest.approx(np.linalg.norm(middle), rel=0.3 if mirrored else 1e-3)


def test_half_of_the_targets_have_to_be_on_the_phantom():
    phantom = phantom_of()
    frame = shown(phantom)
    for known, fits in ((15, True), (14, False)):
        ids = np.where(np.arange(30) < known, phantom.target_id, 999 + np.arange(30))
        found = inputs.fit_to_phantom(frame, phantom, ids)
        assert (found is not None) is fits
        if found:
            assert found.misfit_px < 1e-3


@pytest.mark.parametrize(('targets', 'is_tested'), [(19, False), (20, True)])
def test_exposures_of_twenty_targets_are_tested(monkeypatch, targets, is_tested):
    tested = []
    monkeypatch.setattr(inputs, '_wrong_exposures', lambda frames, phantom: tested.extend(frames))
    ids = np.arange(targets)
    frame = Frame('a', 1, ids, RNG.uniform(0, 900, (targets, 2)), (1000, 1000))
    inputs.require_phantom({'a': [frame]}, phantom_of())
    assert bool(tested) is is_tested


@pytest.mark.parametrize(('reach', 'is_wrong'), [(600.0, False), (599.9, True)])
def test_image_points_that_reach_to_the_limit_are_of_the_right_size(reach, is_wrong):
    uv = np.array([[reach, 100.0], [100.0, 400.0]])
    found = inputs.wrong_image_size([Frame('a', 1, np.arange(2), uv, (1000, 1000))])
    assert (found is not None) is is_wrong


@pytest.mark.parametrize(
    ('count', 'rejected', 'doubted'),
    [
        (600, 300, False),  # half of them: not more than allowed
        (600, 301, True),
        (6, 4, False),  # may happen by chance to one of so many beads
        (7, 6, True),
    ],
)
def test_beads_are_doubted_by_most_of_their_points_and_beyond_chance(count, rejected, doubted):
    target = np.concatenate([np.zeros(count, int), 1 + np.arange(4000) % 100])
    outlier = np.zeros(len(target), bool)
    outlier[:rejected] = True
    outlier[count::11] = True
    exposure = np.zeros(len(target), int)
    name = np.full(len(target), 'a')
    table = Fake(target_id=target, outlier=outlier, exposure=exposure, fluoroscope=name)
    assert rejected_beads(table).tolist() == ([0] if doubted else [])


def test_layers_begin_also_where_no_gap_is_among_the_largest():
    lower, upper = np.arange(200.0), 300 + 2 * np.arange(200.0)
    found = _layers(np.concatenate([lower, upper]), np.full(400, 0.1))
    inner = np.unique(found[found[:, 1] <= 199])
    regular = np.linspace(0, 400, 20).astype(int)
    assert inner.tolist() == regular[regular < 199].tolist()
    assert regular[-2] in found


# ---- comparison, and held-out exposures


def test_a_place_is_told_in_words_and_numbers():
    told = describe_place((900.0, 100.0), (1000, 300))
    assert told == 'the middle right of the image (about u 900, v 100)'


@pytest.mark.parametrize('which', [(), ('first',), ('second',), ('first', 'second')])
def test_interiors_are_compared_in_one_gauge_unless_both_were_fixed(which):
    one = rigs.pincushion('a', (400, 300))
    made = {
        name: replace(
            one,
            interior=np.array([200.0, 150.0, 4000.0]) + shift,
            interior_estimated=name not in which,
            interior_covariance=np.diag([4.0, 4, 100.0]) * (name not in which),
        )
        for name, shift in (('first', np.zeros(3)), ('second', np.array([3.0, -2, 20])))
    }
    found = compare_calibrations(made['first'], made['second'])
    np.testing.assert_allclose(
        found.interior_sd, np.sqrt((2 - len(which)) * np.array([4, 4, 100]))
    )
    if len(which) == 2:
        np.testing.assert_allclose(found.interior, [3, -2, 20])
    else:
        assert found.interior == pytest.approx([3, -2, 20], abs=3)
        np.testing.assert_allclose(found.interior[:2], [3, -2], atol=0.2)


def test_sums_of_an_exposure_held_out_are_of_what_its_noise_leaves(monkeypatch):
    """Image points with twice the stated noise count a quarter."""
    rng = np.random.default_rng(5)
    n = 40
    exposure = np.repeat([0, 1], n // 2)
    uv = rng.uniform(0, 900, (n, 2))
    numbers = np.array([3, 8])
    outside, inside = (
        Residuals(uv, rng.normal(0, 0.5, (n, 2)), exposure, np.arange(n), numbers, np.zeros(2))
        for _ in range(2)
    )
    outside.r[4] = 50.0
    sd = np.where(np.arange(n) % 3, 0.5, 1.0)
    found = iter([outside, inside])
    monkeypatch.setattr(held_out, 'residuals_of', lambda *_: next(found))
    monkeypatch.setattr(held_out, 'noise_of', lambda *_: sd)
    of_fold = Fake(correction=lambda uv, angle: Fake(sd=np.full(len(uv), 0.3)))
    evidence = Fake(
        part=lambda names, chosen: {'a': [i for i in range(8) if chosen(i)]},
        calibrate=lambda frames: {'a': of_fold},
        adjust=lambda frames, calibrations: None,
        calibrations={'a': Fake(image_sd=0.5)},
    )
    first, second = held_out._hold_out(evidence, ('a',), 0, 4)['a']
    assert (first.number, second.number, first.points, second.points) == (3, 8, 20, 20)
    factor = sd / 0.5
    for sums, rows in ((first, exposure == 0), (second, exposure == 1)):
        assert sums.weight == pytest.approx(np.sum(1 / factor[rows] ** 2))
        assert sums.predicted == pytest.approx(np.sum(2 * (0.3 / factor[rows]) ** 2))
        for value, given in ((sums.outside, outside), (sums.inside, inside)):
            squares = np.minimum(np.sum(given.r**2, axis=1), INLIER_Q * sd**2) / factor**2
            assert value == pytest.approx(squares[rows].sum())
        white = held_out._white(uv[rows], (outside.r / factor[:, None])[rows], np.full(20, 0.5))
        assert sums.white == pytest.approx(white)


def test_targets_of_which_nearly_all_are_in_one_place_are_not_remote_from_it():
    xyz = np.vstack([np.zeros((30, 3)), [[900.0, 0, 0], [0, 900.0, 0]]])
    phantom = Phantom(np.arange(32), xyz, np.ones(32))
    frame = Frame('a', 1, np.arange(32), np.zeros((32, 2)), (1000, 1000))
    (found,) = inputs.find_wrong_phantom({'a': [frame]}, phantom)
    assert found.kind is Kind.REPEATED_COORDINATES and len(found.place.target_id) == 30


# ---- layers of beads


def motion_of(beads, rows):
    """Motion (6,) of beads by weighted least squares, and the decrease of their square sum."""
    design, left, weight = [], [], []
    for row in rows:
        x, y, z = beads.survey_mm[row] - beads.survey_mm.mean(axis=0)
        turn = np.array([[0, z, -y], [-z, 0, x], [y, -x, 0]])  # w x P
        design.append(np.hstack([np.eye(3), turn]))
        left.append(beads.misclosure[row])
        weight.append(np.linalg.cholesky(np.linalg.inv(beads.total_covariance[row])).T)
    a = np.vstack([w @ d for w, d in zip(weight, design)])
    b = np.concatenate([w @ one for w, one in zip(weight, left)])
    motion = np.linalg.lstsq(a, b, rcond=None)[0]
    return motion, b @ b - np.sum((b - a @ motion) ** 2), b @ b


def test_gain_of_a_layer_is_that_of_two_motions_over_one():
    rng = np.random.default_rng(9)
    survey = rng.uniform(-60, 60, (40, 3)) + [100.0, 0, -50]
    half = rng.normal(size=(40, 3, 3))
    covariance = 0.01 * (half @ half.transpose(0, 2, 1) + np.eye(3))
    off = (survey[:, 1:2] > 10) * [0.5, 0.2, 0.0] + rng.normal(0, 0.1, survey.shape)
    beads = Beads(
        np.arange(40), survey + off, covariance, np.full(40, 4), survey, np.full(40, 0.1)
    )
    fit = beads_module._Fit(beads)
    _, of_all, squares = motion_of(beads, range(40))
    assert fit.excess == pytest.approx(squares - of_all - 3 * 40)
    for axis in range(3):
        candidates = fit.candidates(axis)
        assert len(candidates) > 3
        for one in candidates[:: max(1, len(candidates) // 4)]:
            rest = np.setdiff1d(np.arange(40), one.own)
            motion, gain, _ = motion_of(beads, one.own)
            other, of_rest, _ = motion_of(beads, rest)
            assert one.axis == axis and one.gain == pytest.approx(gain + of_rest - of_all)
            assert survey[one.own, axis].max() - survey[one.own, axis].min() <= 120
            told = fit.described(one, one.gain / 4)
            relative = motion - other
            assert told.tilt_rad == pytest.approx(np.linalg.norm(relative[3:]))
            middle = survey[one.own].mean(axis=0) - survey.mean(axis=0)
            shift = relative[:3] + np.cross(relative[3:], middle)
            np.testing.assert_allclose(told.shift_mm, shift, atol=1e-9)
            offset = survey[one.own] - survey.mean(axis=0)
            moved = relative[:3] + np.cross(relative[3:], offset)
            size = np.sqrt(np.mean(np.sum(moved**2, axis=1)))
            assert told.size_mm == pytest.approx(size)
            assert told.limit_mm == pytest.approx(size / 2)  # the gain grows as the square
            assert set(told.target_id) == set(one.own)
            inside = np.ones(40, bool)
            if told.low is not None:
                inside &= survey[:, axis] > told.low
            if told.high is not None:
                inside &= survey[:, axis] < told.high
            assert np.flatnonzero(inside).tolist() == sorted(one.own.tolist())
            squares = [
                [
                    c @ np.linalg.solve(beads.total_covariance[row], c)
                    for row in one.own
                    for c in [
                        beads.misclosure[row]
                        - m[:3]
                        - np.cross(m[3:], survey[row] - survey.mean(axis=0))
                    ]
                ]
                for m in (other, motion)
            ]
            expected = np.median(squares[0]) / np.median(squares[1])
            assert fit.improvement(one) == pytest.approx(expected)


@pytest.mark.parametrize(('count', 'is_found'), [(15, False), (16, True), (17, True)])
def test_a_layer_and_the_rest_have_eight_beads_each(count, is_found):
    rng = np.random.default_rng(2)
    survey = rng.uniform(-50, 50, (count, 3))
    survey[:, 2] = np.where(np.arange(count) < count // 2, -60.0, 60.0)
    off = (np.arange(count) < count // 2)[:, None] * [2.0, 0, 0] + rng.normal(0, 0.02, (count, 3))
    beads = Beads(
        np.arange(count),
        survey + off,
        np.tile(0.01 * np.eye(3), (count, 1, 1)),
        np.full(count, 4),
        survey,
        np.full(count, 0.01),
    )
    assert (beads_module.displaced_layer(beads) is not None) is is_found


def test_a_layer_explains_at_least_half_of_what_is_wrong():
    """Single beads that are wrong by much more prevent a finding."""
    rng = np.random.default_rng(4)
    survey = rng.uniform(-50, 50, (60, 3))
    survey[:, 2] = np.where(np.arange(60) < 25, -60.0, 60.0)
    off = (np.arange(60) < 25)[:, None] * [0, 0, 0.8] + rng.normal(0, 0.05, (60, 3))

    def layer(wrong):
        found = survey + off
        found[30:34] += wrong
        beads = Beads(
            np.arange(60),
            found,
            np.tile(0.01 * np.eye(3), (60, 1, 1)),
            np.full(60, 4),
            survey,
            np.full(60, 0.01),
        )
        return beads_module.displaced_layer(beads)

    assert set(layer(0.0).target_id) in (set(range(25)), set(range(25, 60)))
    assert layer(20.0) is None


def test_an_exposure_of_a_plane_has_no_distance_and_no_side():
    phantom = phantom_of()
    flat = replace(phantom, xyz_mm=phantom.xyz_mm * [1, 1, 1e-3])
    fit = inputs.fit_to_phantom(shown(flat), flat, flat.target_id)
    assert fit.misfit_px < 1.0 and fit.distance_mm is None and not fit.is_behind
    assert inputs.fit_to_phantom(shown(phantom), phantom, phantom.target_id).distance_mm
