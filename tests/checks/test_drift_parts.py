# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Parts of the drift watch against explicit matrices and sums."""

from dataclasses import replace
from types import SimpleNamespace as Fake

import numpy as np
import pytest
from rigs import true_calibrations, true_orientation

from fluoro_calib_ros.bodies.body import Body
from fluoro_calib_ros.bodies.image_points import ImagePoints, Linear
from fluoro_calib_ros.checks import rig_change
from fluoro_calib_ros.checks.body_watch import BodyWatch, _by_area, _Drift
from fluoro_calib_ros.checks.drift_charts import (
    ERROR,
    EVIDENCE_CAP,
    OK,
    WARN,
    Block,
    DriftOptions,
    DriftState,
    EpipolarObservations,
    ImageAreas,
)
from fluoro_calib_ros.checks.drift_evidence import BodyEvidence, DriftEstimate, EpipolarEvidence
from fluoro_calib_ros.checks.drift_watch import DriftWatch
from fluoro_calib_ros.checks.pair_watch import PairWatch, SystematicErrorField
from fluoro_calib_ros.checks.rig_change import Addition, RigChange
from fluoro_calib_ros.checks.rig_watch import RecordingDriftWatch, RigDriftWatch
from fluoro_calib_ros.findings import Finding, Kind
from fluoro_calib_ros.healing.sizes import FOCUS, KNOCK_MM, KNOCK_RAD, SHIFT_PX, ChangeStatistics
from fluoro_calib_ros.reconstruction.reconstruct import IntersectedViews, MatchedViews
from fluoro_calib_ros.simulation.rig import virtual_rig

RNG = np.random.default_rng(21)
SIZES = {'a': (1000, 800), 'b': (1000, 800)}


def positive(n, rng=RNG):
    half = rng.normal(size=(n, n))
    return half @ half.T + np.eye(n)


# ---- information of the rays on a change


def test_moment_and_evidence_are_those_of_a_normal_prior():
    normal, right = 50 * positive(5), 20 * RNG.normal(size=5)
    sd = np.array([0.5, 0.0, 2.0, 0.1, 0.0])
    rows = np.flatnonzero(sd)
    n, g = normal[np.ix_(rows, rows)], right[rows]
    d = np.diag(sd[rows] ** 2)
    p = np.linalg.inv(n + np.linalg.inv(d))
    expected = np.zeros((5, 5))
    expected[np.ix_(rows, rows)] = np.outer(p @ g, p @ g) + p
    told = ChangeStatistics(normal, right)
    log_z = told.evidence(sd)
    np.testing.assert_allclose(told.moments(sd), expected, atol=1e-12)
    determinant = np.linalg.det(np.eye(3) + n @ d)
    assert log_z == pytest.approx(0.5 * (g @ p @ g - np.log(determinant)))


@pytest.mark.parametrize('scale', [0.5, 3.0])
def test_factor_of_the_variance_is_that_of_residuals_less_what_unknowns_take(scale):
    """15 unknowns absorb a part of 40 residuals; false matches hardly count."""
    rng = np.random.default_rng(4)
    variance = rng.uniform(0.5, 2.0, 40)
    found = []
    for _ in range(60):
        design = 30 * rng.normal(size=(40, 15))
        residual = design @ rng.normal(size=15) + scale * np.sqrt(variance) * rng.normal(size=40)
        residual[:2] += 500.0
        factor, weight = rig_change._weights(design, residual, variance)
        found.append(factor)
        assert np.all(weight[:2] < 1e-2 / (variance * factor)[:2])
        assert np.all(weight <= (rig_change.NU + 1) / rig_change.NU / (variance * factor) + 1e-12)
    expected = max(1.0, scale**2)
    assert np.median(found) == pytest.approx(expected, rel=0.25)
    assert min(found) >= 1.0


def orientation(names):
    count = len(names)
    return Fake(
        fluoroscopes=names,
        interior=np.tile([500.0, 400.0, 4000.0], (count, 1)) + np.arange(count)[:, None],
        covariance=np.eye(9 * count),
        covariance_rows=lambda i: np.concatenate([9 * k + np.arange(9) for k in i]),
    )


@pytest.mark.parametrize(('names', 'knocked'), [('ab', [1]), ('abc', [0, 1, 2])])
def test_causes_are_a_knock_and_a_shift_of_each_fluoroscope(names, knocked):
    """With two fluoroscopes, a knock of the first is equivalent to one of the second."""
    found = rig_change._hypotheses(orientation(tuple(names)))
    expected = []
    for f in range(len(names)):
        if f in knocked:
            sd = np.zeros(9 * len(names))
            sd[9 * f : 9 * f + 6] = [KNOCK_MM] * 3 + [KNOCK_RAD] * 3
            expected.append(sd)
        sd = np.zeros(9 * len(names))
        sd[9 * f + 6 : 9 * f + 9] = [SHIFT_PX, SHIFT_PX, FOCUS * (4000.0 + f)]
        expected.append(sd)
    np.testing.assert_allclose(found, expected)


def rays(ids, uv, residual, sd_total, noise):
    given = observations(residual, ids)
    ones = np.ones(len(ids))
    return replace(given, uv_a=uv, uv_b=uv + 1, sd_total=sd_total * ones, noise=noise * ones)


def test_a_block_has_the_median_residual_of_each_marker():
    """With the variance of a median, at the position of the marker then."""
    geometry = Fake(by_orientation=lambda a, b: np.hstack([a, b, np.zeros((len(a), 14))]))
    change = RigChange(orientation(('a', 'b', 'c')), [(0, 1, geometry), (0, 2, geometry)])
    ids = np.array([4, 9, 5])
    for step, residual in enumerate(([3.0, -1, 0], [1.0, 5, np.nan], [2.0, -9, 0.2])):
        residual = np.array(residual)
        uv = np.full((3, 2), 10.0 * step)
        change.add(1, rays(ids, uv, residual, sd_total=2.0, noise=1.0 + step))
    change.close()
    (block,) = change._blocks
    assert block.residual.tolist() == [2.0, 0.2, -1.0]  # of ids 4, 5 (the upper of two) and 9
    expected = np.pi / 2 * np.array([3.0, 3.0, 1.0]) / [3, 2, 3]
    np.testing.assert_allclose(block.noise, expected)
    np.testing.assert_allclose(block.systematic, [1.0, 1.0, 3.0])
    assert block.by_rig[:, :2].tolist() == [[20, 20], [20, 20], [0, 0]]
    assert block.by_rig[:, 2:4].tolist() == [[21, 21], [21, 21], [1, 1]]
    assert block.by_rig.shape == (3, 27) and not block.by_rig[:, 4:].any()
    assert not block.is_apart.any()


@pytest.mark.parametrize(('residual', 'apart'), [(8.0, False), (8.1, True), (-8.1, True)])
def test_rays_are_apart_beyond_four_standard_deviations(residual, apart):
    geometry = Fake(by_orientation=lambda a, b: np.zeros((len(a), 18)))
    change = RigChange(orientation(('a', 'b')), [(0, 1, geometry)])
    uv = np.zeros((3, 2))
    change.add(0, rays(np.arange(3), uv, np.full(3, residual), sd_total=2.0, noise=5.0))
    change.close()
    assert change.blocks_apart == apart
    assert change._blocks[0].systematic.tolist() == [0, 0, 0]  # the noise exceeds the total


# ---- bodies


def body_scene(n=3, markers=5, views=3, seed=7):
    """Image points of bodies in a pose, some of them not seen."""
    rng = np.random.default_rng(seed)
    seen = np.ones((n, markers, views), dtype=bool)
    seen[np.arange(n), np.arange(n), np.arange(n) % views] = False
    seen[0, -1] = False
    shape = (n, markers, views)
    by_place = rng.normal(size=(*shape, 2, 3)) * seen[..., None, None]
    residual = rng.normal(0, 0.5, (*shape, 2)) * seen[..., None]
    by_pose = rng.normal(size=(n, markers, 3, 6)) * seen.any(axis=2)[..., None, None]
    points = ImagePoints(
        rng.uniform(0, 800, (*shape, 2)),
        rng.uniform(0.05, 0.2, shape),
        rng.uniform(0.01, 0.05, shape),
        seen,
    )
    linear = Linear(residual, by_place, points.uv, by_pose, seen)
    return linear, points, rng.uniform(0, 0.1, shape[:2])


def test_what_a_body_tells_of_a_shift_is_that_of_least_squares_with_its_pose():
    """Places are observed with information S, and the pose is estimated with the shift."""
    linear, points, variance = body_scene()
    n, markers, views = points.seen.shape
    drift = _Drift.of(linear, points, variance)
    inside = (RNG.random((n, views, markers, 4)) < 0.6) * points.seen.transpose(0, 2, 1)[..., None]
    displacement = drift.displacement
    score, information, amplitude = _by_area(drift, displacement, inside)
    for body in range(n):
        shown = [m for m in range(markers) if points.seen[body, m].any()]
        s, moved, place = {}, {}, {}
        systematic = 0.0
        for m in shown:
            s[m] = np.zeros((3, 3))
            told = np.zeros(3)
            for f in np.flatnonzero(points.seen[body, m]):
                b = linear.by_place[body, m, f]
                w = 1 / points.noise[body, m, f]
                s[m] += w * b.T @ b
                told += w * b.T @ linear.residual[body, m, f]
            place[m] = np.linalg.solve(s[m], told)
            np.testing.assert_allclose(drift.displacement[body, m], place[m])
            np.testing.assert_allclose(drift.s_matrix[body, m], s[m])
            own = variance[body, m] * np.trace(s[m])
            for f in np.flatnonzero(points.seen[body, m]):
                for k in range(2):
                    # Change of the place by a shift of one pixel.
                    moved[m, f, k] = np.linalg.solve(
                        s[m], linear.by_place[body, m, f, k] / points.noise[body, m, f]
                    )
                    square = moved[m, f, k] @ s[m] @ moved[m, f, k]
                    own += points.correction[body, m, f] * square
                    assert drift.square[body, m, f, k] == pytest.approx(square)
            assert drift.systematic[body, m] == pytest.approx(own / 3)
            systematic += own / 3
        pose = sum(linear.by_pose[body, m].T @ s[m] @ linear.by_pose[body, m] for m in shown)
        np.testing.assert_allclose(drift.inverse[body], np.linalg.inv(pose), rtol=1e-5)
        for f in range(views):
            for k in range(2):
                for area in range(4):
                    rows = [m for m in shown if inside[body, f, m, area]]
                    pull = sum(moved[m, f, k] @ s[m] @ place[m] for m in rows)
                    own = sum(moved[m, f, k] @ s[m] @ moved[m, f, k] for m in rows)
                    cross = sum(
                        (linear.by_pose[body, m].T @ s[m] @ moved[m, f, k] for m in rows),
                        np.zeros(6),
                    )
                    left = own - cross @ np.linalg.solve(pose, cross)
                    series = 2 * f + k
                    assert score[body, series, area] == pytest.approx(pull)
                    assert information[body, series, area] == pytest.approx(left, abs=1e-4)
                    share = systematic / len([m for m in shown if inside[body, :, m].any()])
                    assert amplitude[body, series, area] == pytest.approx(
                        np.sqrt(share * max(left, 0)), abs=1e-2
                    )


def test_displacements_of_a_body_are_clipped_from_its_robust_pose():
    """If all fit, the displacements left have no pose part; a false one is limited."""
    linear, points, variance = body_scene(n=2, markers=12)
    watch = BodyWatch.__new__(BodyWatch)
    watch._options = DriftOptions()
    turn = 1e-3 * RNG.normal(size=(2, 6))
    shift = (linear.by_pose @ turn[:, None, :, None])[..., 0]
    seen = points.seen[..., None]
    residual = (linear.by_place @ shift[:, :, None, :, None])[..., 0] * seen
    exact = _Drift.of(replace(linear, residual=residual), points, variance)
    there = points.seen.any(axis=2)
    np.testing.assert_allclose(watch._clipped(exact)[there], 0, atol=1e-9)
    residual[0, 4] += 300.0 * points.seen[0, 4][:, None]
    false = _Drift.of(replace(linear, residual=residual), points, variance)
    clipped = watch._clipped(false)
    length = np.sqrt(np.einsum('nmi,nmij,nmj->nm', clipped, false.s_matrix, clipped))
    # 3 deviations of one coordinate are as rare as 3.76 of three, by chi-square.
    strongest = np.sqrt(false.square.max(axis=(2, 3)))
    limit = 3.76 + 3 * np.sqrt(3 * false.systematic) + (0.15 + 2 * 0.1) * strongest
    assert 0.4 * limit[0, 4] < length[0, 4] < 1.3 * limit[0, 4]
    others = np.delete(np.arange(12), 4)
    assert length[0, others].max() < 0.8 * limit[0, 4]
    np.testing.assert_allclose(clipped[1][there[1]], 0, atol=1e-9)


# ---- one pair of views


def test_stretch_counts_white_noise_apart_from_noise_that_lasts():
    """Expected squared differences are those of white noise plus an autoregression."""
    for white, r in ((0.5, 0.8), (0.2, 0.5), (2.0, 0.9)):
        watch = PairWatch([(9, 9), (9, 9)], ImageAreas(2), DriftOptions(cells=2))
        watch._count, n = 1e9, 30
        watch._frames = n * watch._count
        watch._squares = watch._count * np.array([white + 1 - r**lag for lag in (1, 2, 4)])
        total = np.array([r ** abs(i - j) for i in range(n) for j in range(n)]).reshape(n, n)
        own = white + total.sum() / n
        shared = sum(r ** (n + j - i) for i in range(n) for j in range(n)) / n
        expected = (white + (1 + r) / (1 - r)) / (own - shared)
        assert watch.stretch() == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize(('factor', 'is_stretched'), [(0.9, False), (1.1, True)])
def test_noise_lasts_where_differences_grow_significantly(factor, is_stretched):
    watch = PairWatch([(9, 9), (9, 9)], ImageAreas(2), DriftOptions(cells=2))
    watch._count, watch._frames = 400.0, 40 * 400.0
    growth = factor * 6 / np.sqrt(400)
    watch._squares = 400.0 * np.array([1.0, 1 + growth, 1 + 2 * growth])
    assert bool(watch.stretch() > 1.0) is is_stretched


def test_correlation_is_of_frames_of_the_same_marker_and_fades():
    watch = PairWatch([(9, 9), (9, 9)], ImageAreas(2), DriftOptions(cells=2))
    marker = np.array([0, 1] * 6 + [1])
    z = RNG.normal(size=13)
    watch._update_correlation(marker, z)
    series = [z[marker == 0], z[marker == 1]]
    squares = [
        sum(np.sum((one[lag : lag + len(one) - 4] - one[:-4]) ** 2) / 2 for one in series)
        for lag in (1, 2, 4)
    ]
    np.testing.assert_allclose(watch._squares, squares)
    assert watch._count == 2 + 3 and watch._frames == pytest.approx(5 * 13 / 2)
    watch._update_correlation(np.array([0, 0, 1, 1]), z[:4])  # too few frames of each marker
    assert watch._count == 5
    watch._update_correlation(marker, z)
    assert watch._count == pytest.approx(5 * (2 - 1 / 160))
    np.testing.assert_allclose(watch._squares, (2 - 1 / 160) * np.array(squares))
    assert watch._frames == pytest.approx(32.5 * (2 - 1 / 160))


def test_field_has_the_normal_equations_of_mean_residuals_and_its_prior():
    field = SystematicErrorField([(140, 70), (70, 140)])
    count = 10
    marker = np.array([0, 1, 2, 0, 1, 2, 0, 1, 2, 0])
    uv = [RNG.uniform(0, 70, (count, 2)) for _ in range(2)]
    found = [field.interpolation(one, side) for side, one in enumerate(uv)]
    nodes = np.hstack([one for one, _ in found])
    weights = np.hstack([one for _, one in found])
    residual, variance = RNG.normal(size=count), RNG.uniform(0.1, 0.3, count)
    systematic = RNG.uniform(0.2, 0.4, count)
    field.add(marker, nodes, weights, residual=residual, variance=variance, systematic=systematic)
    design = np.zeros((count, 128))
    np.put_along_axis(design, nodes, weights, axis=1)
    rows = np.array([design[marker == m].mean(axis=0) for m in range(3)])
    weight = [1 / (variance[marker == m].sum() / np.sum(marker == m) ** 2) for m in range(3)]
    means = [residual[marker == m].mean() for m in range(3)]
    field.estimate(1.7)
    place = np.array([(j, i) for i in range(8) for j in range(8)]) / 7
    square = np.sum((place[:, None] - place) ** 2, axis=2)
    prior = (np.exp(-square / (2 * 0.12**2)) + np.exp(-square / 2)) / 2 + 1e-6 * np.eye(64)
    prior = np.mean(systematic**2) * np.kron(np.eye(2), prior)
    # Least-squares collocation in the space of the observations.
    noise = 1.7 * np.diag(1 / np.array(weight))
    gain = prior @ rows.T @ np.linalg.inv(rows @ prior @ rows.T + noise)
    np.testing.assert_allclose(field.mean, gain @ means, atol=1e-8)
    np.testing.assert_allclose(field.covariance, prior - gain @ rows @ prior, atol=1e-8)


def observations(residual, ids=None):
    n = len(residual)
    uv = np.random.default_rng(8).uniform(0, 800, (2, n, 2))
    return EpipolarObservations(
        np.asarray(residual, dtype=float),
        sd=np.linspace(0.2, 0.4, n),
        sd_total=np.hypot(np.linspace(0.2, 0.4, n), 0.1),
        target_id=np.arange(n) if ids is None else ids,
        uv_a=uv[0],
        uv_b=uv[1],
        normal_a=np.tile([1.0, 0], (n, 1)),
        normal_b=np.tile([0.0, 1], (n, 1)),
        factor_a=np.full(n, 0.6),
        factor_b=np.full(n, 0.8),
        noise=np.linspace(0.2, 0.4, n) ** 2,
    )


def test_series_against_the_start_are_less_the_field_and_as_unsure_as_it():
    areas = ImageAreas(2)
    watch = PairWatch([(1000, 800)] * 2, areas, DriftOptions(cells=2))
    given = observations(RNG.normal(0, 0.2, 12))
    watch.field.mean = RNG.normal(0, 0.1, 128)
    watch.field.covariance = 1e-3 * positive(128)
    block = watch.block(given)
    nodes, weights = (
        np.hstack(both)
        for both in zip(*(watch.field.interpolation(uv, i) for i, uv in enumerate(given.uv)))
    )
    design = np.zeros((12, 128))
    np.put_along_axis(design, nodes, weights, axis=1)
    left = given.residual - design @ watch.field.mean
    for side, factor in ((0, 0.6), (1, 0.8)):
        weight = factor / given.noise
        cell = areas.cell(given.uv[side], (1000, 800))
        for area in range(len(areas)):
            own = areas.member[area, cell] > 0
            if not own.any():
                continue
            assert block.score[2 + side, area] == pytest.approx(np.sum((weight * left)[own]))
            information = factor * weight[own].sum()
            pull = weight[own] @ design[own]
            unknown = pull @ watch.field.covariance @ pull / information**2
            nugget = 0.35 * 0.1 * weight[own].sum() / information
            expected = np.sqrt(unknown + nugget**2)
            assert block.systematic[2 + side, area] == pytest.approx(expected)


# ---- evidence


def blocks(scores, informations):
    """Blocks of one series and area, one per second, with their starts."""
    zero = np.zeros((1, 1))
    return [
        (10**9 * k, Block(np.array([[s]]), np.array([[i]]), zero, zero > 0))
        for k, (s, i) in enumerate(zip(scores, informations))
    ]


@pytest.mark.parametrize(
    ('scores', 'informations', 'first'),
    [
        ([0.0, 5, 5, 5], [10.0] * 4, 1),
        ([0.0, 0, 0, 5], [10.0] * 4, 3),
        ([5.0, 5, 5, 5], [10.0] * 4, 0),
        ([0.0, -5, -5, -5], [10.0] * 4, 1),
        ([9.0, 0, 5, 5], [1e9, 0.0, 10, 10], 2),
    ],
)
def test_a_drift_begins_where_the_newest_blocks_show_most(scores, informations, first):
    charts = Fake(evidence=np.zeros((2, 1, 1)))
    found = EpipolarEvidence(charts, ('a', 'b'), 4)
    given = blocks(scores, informations)
    found._records.extend(given)
    begin, run = found._run(0, 0, -7)
    assert run == [block for _, block in given[first:]]
    assert begin == (10**9 * first if first else -7)
    assert found._run(0, 0, 5 * 10**9)[0] == 10**9 * first


def test_charts_against_the_start_are_preferred_where_one_of_them_shows_a_drift():
    found = EpipolarEvidence(Fake(), ('a', 'b'), 4)
    for series in (2, 3):
        likelihood = np.full((2, 4, 3), -1.0)
        likelihood[0, 0, 1] = 50.0
        assert found._preferred(likelihood.copy())[0, 0, 1] == 50.0
        likelihood[1, series, 2] = 0.0
        preferred = found._preferred(likelihood.copy())
        assert preferred[0, 0, 1] == -1 and preferred[1, series, 2] == 0.0


def test_likeliest_fluoroscope_is_that_of_all_its_pairs():
    """Fluoroscopes a, b, c have the series of ab, ac and bc, for the first and second one."""
    found = EpipolarEvidence(Fake(), ('a', 'b', 'c'), 4)
    likelihood = np.zeros((12, 3))
    likelihood[[3, 10], 2] = [10.0, 12.0]  # b in ab and in bc, against the start
    likelihood[0, 1] = 90.0  # against the calibration
    assert found._likeliest(likelihood, 2) == (('b',), 10, 2)
    likelihood[7, 0] = 18.0  # c in ac
    assert found._likeliest(likelihood, 3) == (('b', 'c'), 10, 2)
    likelihood[7, 0] = 17.5
    assert found._likeliest(likelihood, 3)[0] == ('b',)
    assert found._likeliest(likelihood, 0) == (('a',), 0, 1)


def test_likeliest_view_of_bodies_has_the_largest_component():
    found = BodyEvidence(Fake(), ('a', 'b'), 4, ('one', 'two'))
    likelihood = np.zeros((4, 3))
    likelihood[3, 1], likelihood[0, 2] = 10.0, 7.9
    assert found._likeliest(likelihood, 0) == (('b',), 3, 1)
    likelihood[0, 2] = 8.0
    assert found._likeliest(likelihood, 0) == (('b', 'a'), 3, 1)


@pytest.mark.parametrize(
    ('scores', 'source', 'confirmed'),
    [
        ((20.0, 20.0, 0.0), 'cluster one', False),  # 20 / sqrt(2 * 25 * factor)
        ((20.0, 22.0, 0.0), 'cluster two', False),
        ((50.0, 31.0, 0.0), 'cluster one', True),
        ((-50.0, -31.0, 0.0), 'cluster one', True),
        ((50.0, 29.0, 0.0), 'cluster one', False),
        ((-50.0, 31.0, 0.0), 'cluster one', False),
    ],
)
def test_a_drift_is_confirmed_by_the_other_bodies(scores, source, confirmed):
    """Scores must exceed three standard deviations: information 2 x 25, variance factor 2."""
    charts = Fake(variance_factor=lambda: np.full((4, 2), 2.0))
    found = BodyEvidence(charts, ('a', 'b'), 4, ('one', 'two', 'three'))
    score = np.zeros((3, 4, 2))
    score[:, 3, 1] = np.array(scores) / 2
    information = np.full((3, 4, 2), 12.5)
    run = [Fake(score_of_body=score, information_of_body=information)] * 2
    direction, _, told, is_confirmed = found._described(run, 3, 1)
    assert direction.tolist() == [0, 1] and told == source and is_confirmed is confirmed


# ---- the watch


def test_thresholds_are_those_of_all_charts():
    watch = DriftWatch(dict.fromkeys('abc', (100, 100)), DriftOptions(cells=2))
    charts = 2 * (3 * 4) * 9  # directions, series of three pairs, areas
    blocks = np.array([10.0, 1000.0]) * 3600 / 0.25
    assert watch.thresholds == pytest.approx(np.log(charts * blocks))
    assert watch._epipolar.charts._cap == pytest.approx(EVIDENCE_CAP * watch.thresholds[1])
    assert watch._epipolar._records.maxlen == 120
    assert watch._bodies.charts.evidence.shape == (2, 6, 9)
    body = Body('bone', np.arange(4), RNG.normal(size=(4, 3)), np.ones(4))
    fluoroscopes = virtual_rig(1, strength=0.0, names=('a', 'b', 'c')).fluoroscopes
    rig = true_orientation(fluoroscopes, true_calibrations(fluoroscopes))
    sizes = dict.fromkeys('abc', (100, 100))
    both = DriftWatch(sizes, DriftOptions(cells=2), [body], rig)
    # Two more series per view.
    assert both.thresholds == pytest.approx(np.log(2 * (3 * 4 + 6) * 9 * blocks))
    assert watch._bodies.charts._step == pytest.approx(2 * watch._epipolar.charts._step)


def estimated(size=0.5, begin_ns=0, **changes):
    values = {
        'fluoroscopes': ('b',),
        'area': 0,
        'size': size,
        'sd': 0.1,
        'direction': np.array([0.6, 0.8]),
        'against': 'start',
        'source': 'epipolar',
        'confirmed': True,
        'begin_ns': begin_ns,
    }
    return DriftEstimate(**{**values, **changes})


def test_levels_have_hysteresis():
    watch = DriftWatch(SIZES)
    warn, error = watch.thresholds
    asked = []
    watch._epipolar.estimate = lambda least: asked.append(least) or estimated()
    for evidence, level in (
        (0.99 * warn, OK),
        (warn, WARN),
        (0.51 * warn, WARN),
        (0.49 * warn, OK),
        (0.6 * warn, OK),
        (error, ERROR),
        (warn, ERROR),
        (0.51 * warn, ERROR),
        (0.49 * warn, OK),
    ):
        watch._epipolar.charts.evidence[1, 2, 3] = evidence
        state = watch._present_state()
        assert state.level == level and state.evidence == evidence
        if level != OK:
            assert asked[-1] == min(evidence, warn)
    watch._bodies.charts.evidence[0, 0, 0] = error
    watch._bodies.estimate = lambda least: estimated(source='cluster x')
    assert watch._present_state().source == 'cluster x'


@pytest.mark.parametrize(('size', 'direction'), [(0.5, (0.6, 0.8)), (-0.5, (-0.6, -0.8))])
def test_an_alarm_has_a_positive_size_and_the_time_since_it_began(size, direction):
    watch = DriftWatch(SIZES)
    watch._clock.newest_ns = 9 * 10**9
    state = watch._drift_state(WARN, estimated(size, 2 * 10**9), 30.0)
    assert (state.size, state.since_s, state.sd) == (0.5, 7.0, 0.1)
    assert state.direction == pytest.approx(direction)
    assert state.finding.numbers == {'size_px': 0.5, 'sd_px': 0.1, 'since_s': 7.0}
    assert state.finding.kind is Kind.IMAGE_DRIFT and 'a bead may' not in state.finding.cause
    later = watch._drift_state(WARN, estimated(size, 10**10), 30.0)
    assert later.since_s == 0
    alone = watch._drift_state(WARN, estimated(source='cluster x', confirmed=False), 30.0)
    assert alone.finding.kind is Kind.CLUSTER_CHANGE and 'a bead may' in alone.finding.cause


def test_rows_that_are_not_finite_make_no_block():
    watch = DriftWatch(SIZES)
    for second in range(4):
        state = watch.add_residuals(10**9 * second, 0, observations([np.nan] * 5))
    assert state.observations == 0 and state.finding.kind is Kind.NO_MARKERS
    assert not watch._epipolar._records


def test_the_start_is_learned_block_by_block_and_then_tested(monkeypatch):
    options = DriftOptions(learn_s=2.0, block_s=0.5)
    watch = DriftWatch(SIZES, options)
    asked = []
    field = watch._watches[0].field
    monkeypatch.setattr(field, 'estimate', asked.append)
    found = []
    for block in range(8):
        watch.add_residuals(5 * 10**8 * block, 0, observations(np.zeros(12)))
        found.append((watch.state.finding.kind, watch.state.learning, watch.watched_s))
    # A block is closed by the next one; the first four are used for learning.
    assert [kind for kind, _, _ in found] == (
        [Kind.NO_MARKERS] + [Kind.LEARNING] * 3 + [Kind.NO_DRIFT] * 4
    )
    assert [learning for _, learning, _ in found] == [True] * 4 + [False] * 4
    assert [watched for _, _, watched in found] == [0, 0, 0, 0, 0, 0.5, 1.0, 1.5]
    factor = np.median(watch._epipolar.charts.variance_factor()[:2])
    assert asked == [pytest.approx(factor, rel=0.2)]
    assert watch.state.observations == 7 * 12


def test_dead_band_is_tolerance_and_systematic_deviations_together():
    watch = DriftWatch(SIZES, DriftOptions(tolerance_px=0.3))
    found = watch._dead_band(np.array([[4.0], [3.0]]), np.array([[0.1, np.nan], [0.2, 0.0]]))
    np.testing.assert_allclose(found, [[0.5, 0.3], [np.hypot(0.3, 0.6), 0.3]])


# ---- the watch of an oriented rig


def rig_drift_watch(**changes):
    watch = RigDriftWatch.__new__(RigDriftWatch)
    values = {
        '_names': ('a', 'b'),
        '_orientation': orientation(('a', 'b')),
        '_addition': None,
        '_wide': None,
        '_watch': Fake(options=DriftOptions()),
        'widening': 'before',
    }
    vars(watch).update({**values, **changes})
    return watch


def state_of(level=WARN, kind=Kind.IMAGE_DRIFT, **changes):
    values = {'size': 0.5, 'sd': 0.1, 'since_s': 2.0, 'source': 'epipolar', 'evidence': 30.0}
    values |= changes
    evidence = values.pop('evidence')
    return DriftState(Finding(kind, 'x', severity=level), evidence, 20.0, 40.0, 9, False, **values)


@pytest.mark.parametrize(
    ('state', 'blocks', 'shifted'),
    [
        (state_of(OK), None, False),
        (state_of(kind=Kind.CLUSTER_CHANGE), None, False),
        (state_of(), 8, False),
        (state_of(source='cluster x'), 8, True),
        (state_of(source='cluster x', size=np.nan), 8, False),
        (state_of(since_s=0.6), 2, False),
    ],
)
def test_an_alarm_adds_what_the_blocks_since_its_begin_tell(monkeypatch, state, blocks, shifted):
    asked = []
    added = Addition(np.eye(18), 0.2, 0.3)
    change = Fake(addition=lambda count: asked.append(count) or added)
    watch = rig_drift_watch(_state=state, _change=change)
    monkeypatch.setattr(RigDriftWatch, '_widening', lambda self, exposure, added: 'said')
    monkeypatch.setattr(RigDriftWatch, '_with_shift', lambda self, added, state: 'shifted')
    watch._widen('exposure')
    assert asked == ([] if blocks is None else [blocks])
    expected = None if blocks is None else 'shifted' if shifted else added
    assert watch._addition is expected
    assert watch.widening == (None if blocks is None else 'said')
    change.addition = lambda count: None
    watch._widen('exposure')
    assert watch._addition is None and watch.widening is None


def test_a_shift_that_bodies_show_is_one_of_the_principal_point():
    watch = rig_drift_watch()
    state = state_of(fluoroscopes=('b',), size=0.3, sd=0.4)
    found = watch._with_shift(Addition(np.eye(18), 0.2, 0.3), state)
    expected = np.ones(18)
    expected[[9 + 6, 9 + 7]] += 0.25
    np.testing.assert_allclose(found.covariance, np.diag(expected))


def test_what_was_added_to_image_points_is_taken_off_again():
    exposure = exposure_of(0.5, 0.3)
    watch = rig_drift_watch()
    assert watch._as_calibrated(exposure) is exposure
    watch._addition = Addition(np.eye(18), 0.0, 0.3)
    assert watch._as_calibrated(exposure) is exposure
    watch._addition = Addition(np.eye(18), 0.4, 0.3)
    views = watch._as_calibrated(exposure).views
    np.testing.assert_allclose(views.sigma, 0.3)
    np.testing.assert_allclose(views.correction_sd, 0.0)


def exposure_of(sigma, correction_sd):
    views = MatchedViews(
        np.arange(3),
        np.zeros((2, 3, 2)),
        np.full((2, 3), sigma),
        np.full((2, 3), correction_sd),
        np.zeros((2, 3), bool),
    )
    return IntersectedViews(views, None)


@pytest.mark.parametrize(('share', 'is_knock'), [(0.0, False), (0.75, True)])
def test_rays_that_no_longer_meet_are_an_error_since_they_do_not(share, is_knock):
    given = state_of(OK)
    watch = rig_drift_watch(_of_charts=given, _change=Fake(share_apart=share, blocks_apart=3))
    found = watch._present_state()
    if not is_knock:
        assert found is given
        return
    assert found.level == ERROR and found.source == 'epipolar' and found.since_s == 0.75


def recorded(states, seconds=None, widenings=(), watched_s=20.0, monkeypatch=None):
    """Verdict on a recording with these states, one per second."""
    watch = RecordingDriftWatch.__new__(RecordingDriftWatch)
    quiet = state_of(OK, evidence=0.0)
    vars(watch).update(
        _first_ns=None,
        _last_ns=None,
        _worst=quiet,
        _worst_ns=0,
        _found_ns=0,
        _widest=None,
        _state=quiet,
        _watch=Fake(options=DriftOptions(), watched_s=watched_s),
        widening=None,
    )
    given = iter(states)

    def add(self, stamp_ns, exposure):
        self._last_ns = stamp_ns
        self._state = next(given)
        self.widening = exposure
        return self._state

    monkeypatch.setattr(RigDriftWatch, 'add_exposure', add)
    for number, _ in enumerate(states):
        widening = widenings[number] if widenings else None
        watch.add_exposure(10**9 * (number + 100), widening)
    return watch.verdict()


def test_verdict_on_a_recording_is_that_of_its_worst_state(monkeypatch):
    warn, error = state_of(evidence=25.0), state_of(ERROR, evidence=50.0, since_s=1.5)
    later, calm = state_of(ERROR, evidence=60.0, since_s=3.0), state_of(OK, evidence=1.0)
    wide = [Finding(Kind.WIDENED_BY_ALARM, 'x', numbers={'sd_mm': sd}) for sd in (2.0, 5.0, 3.0)]
    states = [calm, warn, error, later, error, calm]
    found = recorded(states, widenings=[None, *wide, None, None], monkeypatch=monkeypatch)
    assert found.state is later and found.level == 'error' and found.level_at_end == 'ok'
    assert found.found_ns == 102 * 10**9  # time at which the level was first reached
    assert found.began_ns == 103 * 10**9 - 3 * 10**9
    assert found.widening is wide[1] and found.watched_s == 20.0
    assert 'alarm 2.0 s after the start; no longer detected at the end' in found.finding.cause
    assert found.finding.advice == 'the calibration no longer holds'
    found = recorded([calm, warn], monkeypatch=monkeypatch)
    assert found.level == 'warn' and found.found_ns == 101 * 10**9
    assert 'gone' not in found.finding.cause
    assert found.finding.advice == 'the calibration may no longer hold'


@pytest.mark.parametrize(
    ('watched_s', 'seconds', 'kind', 'level'),
    [
        (1.0, 30, Kind.NO_DRIFT, 'ok'),
        (0.9, 12, Kind.NOT_WATCHED, 'unknown'),
        (0.9, 11, Kind.NOT_WATCHED, 'unknown'),  # 11 s: 10 to learn, 1 to find
        (0.9, 10, Kind.SHORT_RECORDING, 'learning'),
    ],
)
def test_a_recording_without_an_alarm_is_calm_short_or_not_watched(
    monkeypatch, watched_s, seconds, kind, level
):
    calm = [state_of(OK, evidence=0.0)] * (seconds + 1)
    found = recorded(calm, watched_s=watched_s, monkeypatch=monkeypatch)
    assert found.finding.kind is kind and found.level == level and found.watched_s == watched_s
    assert found.state is None and found.found_ns is None
    if kind is Kind.SHORT_RECORDING:
        assert found.finding.numbers == {'length_s': 10.0, 'learn_s': 10.0}
