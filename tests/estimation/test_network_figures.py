# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Adjustment figures: statistics, covariances and relative orientations, against dense ones."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import rigs

from fluoro_calib_ros.errors import DataError
from fluoro_calib_ros.estimation.constraints import (
    _mean_of_run,
    gauges_of,
    interiors_to_estimate,
    relative_orientations,
    with_constraints,
)
from fluoro_calib_ros.estimation.estimator import GaugeKind
from fluoro_calib_ros.estimation.fixed_calibration import (
    SolvedNetwork,
    fixed_corrections,
    noise_of_calibrations,
    start_within_survey,
    too_few_rays_for_noise,
)
from fluoro_calib_ros.estimation.initial_network import Measured
from fluoro_calib_ros.estimation.options import CalibrationOptions
from fluoro_calib_ros.estimation.rounds import (
    History,
    Round,
    SelfCalibration,
    exposures_that_do_not_fit,
    has_settled,
    outliers_of,
    residuals_of_adjustment,
    statistics_of,
)
from fluoro_calib_ros.estimation.survey import _rays, _scale_sd
from fluoro_calib_ros.exposures.frame import Frame
from fluoro_calib_ros.findings import Kind, Place
from fluoro_calib_ros.photogrammetry.adjustment import adjust
from fluoro_calib_ros.photogrammetry.noise import Noise
from fluoro_calib_ros.photogrammetry.precision import precision
from fluoro_calib_ros.photogrammetry.rig_orientation import KnownOrientation
from fluoro_calib_ros.photogrammetry.rotations import vector_from_matrix
from fluoro_calib_ros.photogrammetry.unknowns import mean_pose, relative_poses
from fluoro_calib_ros.rows import joined_rows

SIZE = (1024, 1024)


def measured(network, truth):
    """Measurements of a small network: exposures from 11 on, targets from 101 on."""
    names = tuple('abc'[: network.n_fluoroscopes])
    per = network.n_exposures // network.n_fluoroscopes
    frames = tuple(
        Frame(names[f], 11 + row % per, np.zeros(0, dtype=int), np.zeros((0, 2)), SIZE)
        for row, f in enumerate(network.fluoroscope)
    )
    return Measured(
        network, truth, names, (SIZE,) * len(names), frames, 101 + np.arange(network.n_points), ()
    )


def case(noise=None, **shape):
    """The measurements, their adjustment and its precision."""
    network, truth = rigs.small_network(**shape)
    after = adjust(network, truth, noise=noise or Noise('student_t', 0.3, 8.0))
    return measured(network, truth), after, precision(network, after)


def calibration_of(found, after, precise):
    """A self-calibration without a model."""
    nothing = np.zeros_like(found.network.uv)
    return SelfCalibration(found, after, after, precise, nothing, after.inliers, {}, (), True)


# ---- statistics


def test_statistics_are_those_of_the_whole_adjustment():
    """Redundancy numbers sum to the number of observations less that of unknowns."""
    found, after, precise = case(Noise('gaussian', 0.3), exposures=5, targets=30)
    network = found.network
    got = statistics_of(found, after, precise)
    observations = 2 * len(network.uv) + 3 * 30
    unknowns = 5 * 6 + 3 * 30 + 3
    assert (got.observations, got.unknowns) == (observations, unknowns)
    assert got.degrees_of_freedom == pytest.approx(observations - unknowns, rel=1e-6)
    survey = (after.parameters.points_mm - network.survey_mm) / network.survey_sd_mm[:, None]
    square = np.sum((after.residuals / (0.3 * network.sigma[:, None])) ** 2) + np.sum(survey**2)
    assert got.variance_factor == pytest.approx(square / (observations - unknowns))
    rays = np.bincount(network.point)
    assert (got.least_rays, got.mean_rays) == (rays.min(), pytest.approx(rays.mean()))
    assert got.least_redundancy == pytest.approx(precise.redundancy.min())
    assert got.mean_redundancy == pytest.approx(precise.redundancy.mean())
    assert (got.image_points, got.exposures, got.targets) == (len(network.uv), 5, 30)
    assert (got.fluoroscopes, got.loss, got.sigma0, got.nu) == (('a',), 'gaussian', 0.3, np.inf)
    assert got.outliers == np.count_nonzero(~after.inliers)


def test_statistics_leave_out_points_of_little_weight_and_count_constraints():
    network, truth = rigs.small_network(exposures=4, targets=30, fluoroscopes=2)
    uv = network.uv.copy()
    uv[3] += 9.0
    network = replace(network, uv=uv)
    start = measured(network, truth)
    options = CalibrationOptions(relative_orientation='soft', relative_sd=(900.0, 2.0))
    start = with_constraints(start, options)
    after = adjust(start.network, start.start, noise=Noise('student_t', 0.3, 8.0))
    precise = precision(start.network, after)
    got = statistics_of(start, after, precise)
    assert got.observations == 2 * len(uv) + 3 * 30 + 4 * 6
    weight = after.noise.weight(after.q)
    assert weight[3] < 0.5 and got.outliers >= 1
    assert got.least_redundancy == pytest.approx(precise.redundancy[weight >= 0.5].min())
    total = precise.redundancy.sum() + precise.survey_redundancy.sum()
    total += precise.relative_redundancy[0].sum()
    assert got.degrees_of_freedom == pytest.approx(total)
    survey = (after.parameters.points_mm - network.survey_mm) / network.survey_sd_mm[:, None]
    turn, shift = relative_poses(after.parameters, start.network.relative[0].pairs)
    pose = after.parameters.relative[0]
    off = (shift - pose.translation_mm) / 900.0, vector_from_matrix(turn @ pose.rotation.T) / 2.0
    square = np.sum(weight * after.q) + np.sum(survey**2) + np.sum(np.square(off))
    assert got.variance_factor == pytest.approx(square / total)


def test_residuals_are_listed_by_fluoroscope_exposure_and_target():
    found, after, precise = case(exposures=3, targets=15, fluoroscopes=2)
    correction = np.random.default_rng(1).normal(size=found.network.uv.shape)
    table = residuals_of_adjustment(found, after, precise, correction)
    row = 17
    e = found.network.exposure[row]
    assert table.fluoroscope[row] == 'ab'[e // 3] and table.exposure[row] == 11 + e % 3
    assert table.target_id[row] == 101 + found.network.point[row]
    assert table.correction is correction
    np.testing.assert_array_equal(table.outlier, ~after.inliers)
    np.testing.assert_allclose(table.weight, after.noise.weight(after.q))
    both = joined_rows([table, table])
    assert (
        len(both.uv) == 2 * len(table.uv)
        and both.target_id[len(table.uv) + row] == 101 + found.network.point[row]
    )


def test_outliers_are_named_with_their_statistics():
    network, truth = rigs.small_network(exposures=6, targets=30, fluoroscopes=2, noise_px=0.2)
    uv = network.uv.copy()
    row = int(np.flatnonzero(network.fluoroscope[network.exposure] == 1)[5])
    uv[row] += [6.0, -5.0]
    survey = network.survey_mm.copy()
    wrong = int(network.point[row] + 1) % 30
    survey[wrong] += [3.0, -2.0, 2.0]
    network = replace(network, uv=uv, survey_mm=survey)
    start = measured(network, truth)
    after = adjust(network, truth, noise=Noise('student_t', 0.2, 8.0))
    points, targets = outliers_of(calibration_of(start, after, precision(network, after)))
    own = [p for p in points if p['fluoroscope'] == 'b']
    assert [(p['exposure'], p['target_id']) for p in own] == [
        (11 + network.exposure[row] % 6, 101 + network.point[row])
    ]
    assert own[0]['value'] > own[0]['critical'] > 0
    assert [t['target_id'] for t in targets] == [101 + wrong]
    assert targets[0]['value'] > targets[0]['critical'] > 0
    np.testing.assert_allclose(targets[0]['offset_mm'], [-3.0, 2.0, -2.0], atol=0.5)


@pytest.mark.parametrize('spoilt, found', [((1,), 1), ((1, 2, 3), 0)])
def test_an_exposure_of_false_matches_is_found_unless_most_are_like_it(spoilt, found):
    """The median decides; exposures of the other fluoroscope have no influence."""
    network, truth = rigs.small_network(exposures=4, targets=30, fluoroscopes=2)
    start = measured(network, truth)
    after = adjust(network, truth, noise=Noise('student_t', 0.3, 8.0))
    q = np.ones(len(network.uv))
    for e in spoilt:
        rows = np.flatnonzero(network.exposure == e)
        q[rows[: int(0.6 * len(rows)) + 1]] = 1e4
    rows = np.flatnonzero(network.exposure == 6)
    q[rows[: len(rows) // 2 - 1]] = 1e4  # more than half of the points fit
    run = SimpleNamespace(measured=start, after=replace(after, q=q))
    findings = exposures_that_do_not_fit(run)
    assert len(findings) == found
    if found:
        one = findings['a', 12]
        assert one.kind is Kind.FALSE_MATCHES and one.place == Place(('a',), (12,))
        rows = network.exposure == 1
        assert one.numbers['share'] == pytest.approx(np.mean(q[rows] == 1))


def test_rounds_settle_where_costs_and_correction_do():
    def rounds(f=0.0, g=0.0, change=1e-3, cost=(500.0, 1000.0)):
        last = Round(1, cost[0], cost[1], {}, {}, 0.0, 1.0)
        return [last, Round(2, cost[0] + f, cost[1] + g, {}, {}, 0.0, change)]

    assert not has_settled(rounds()[:1], 1.0)
    assert has_settled(rounds(), 1e-4)
    for sign in (-1, 1):
        assert has_settled(rounds(f=sign * 0.09), 1e-4)  # relative to the larger of both costs
        assert not has_settled(rounds(f=sign * 0.11), 1e-4)
        assert has_settled(rounds(g=sign * 0.09), 1e-4)
        assert not has_settled(rounds(g=sign * 0.11), 1e-4)
    assert not has_settled(rounds(change=2.1e-3), 1e-4)
    assert has_settled(rounds(f=0.19, cost=(-2000.0, 1000.0)), 1e-4)
    assert not has_settled(rounds(f=0.21, cost=(-2000.0, 1000.0)), 1e-4)


def test_history_has_the_figures_of_every_round():
    found, after, _ = case(exposures=3, targets=15, fluoroscopes=2)
    told = []
    history = History(found, told.append)
    history.add(after, 7.5, {'a': 3, 'b': 4}, 0.2)
    history.add(after, 7.0, {'a': 3, 'b': 5}, 0.1)
    assert told == history.rounds and [one.iteration for one in told] == [1, 2]
    one = told[0]
    assert (one.F, one.G, one.change) == (after.cost, 7.5, 0.2)
    weight = after.noise.weight(after.q)
    assert one.quadratic == pytest.approx(np.sum(weight[:, None] * after.residuals**2))
    rows = found.network.rows(1)
    rows = rows[after.inliers[rows]]
    np.testing.assert_allclose(one.rmse['b'], np.sqrt(np.mean(after.residuals[rows] ** 2, axis=0)))
    assert str(told[1]).startswith('round  2  k   5  RMSE a: ')
    assert 'k' not in str(replace(one, k={'a': 0})).split('RMSE')[0]


# ---- covariances of all unknowns


def dense_covariance(network, after):
    factor = after.noise.information_factor(after.q)
    return np.linalg.inv(rigs.dense_normal_matrix(network, after, factor))


def test_covariance_of_all_unknowns_equals_the_dense_inverse():
    found, after, _ = case(exposures=3, targets=12)
    joint = SolvedNetwork(found, after, np.zeros_like(found.network.uv)).joint_precision()
    expected = dense_covariance(found.network, after)
    scale = np.sqrt(np.diagonal(expected))
    np.testing.assert_allclose(
        joint.covariance / np.outer(scale, scale), expected / np.outer(scale, scale), atol=1e-6
    )
    assert joint.names[:7] == (
        *(f'exposure 11 of a: {p}' for p in ('x', 'y', 'z', 'turn x', 'turn y', 'turn z')),
        'exposure 12 of a: x',
    )
    assert joint.names[18:22] == (
        'target 101: x',
        'target 101: y',
        'target 101: z',
        'target 102: x',
    )
    parameters = after.parameters
    np.testing.assert_array_equal(joint.values[6:9], parameters.position_mm[1])
    assert np.isnan(joint.values[3:6]).all()
    np.testing.assert_array_equal(joint.values[18:54], parameters.points_mm.ravel())
    np.testing.assert_array_equal(joint.values[54:], parameters.interior[0])


def test_covariances_are_scaled_to_what_the_unknowns_claim():
    """Correlations stay unchanged, and fixed unknowns have no variance."""
    network, truth = rigs.small_network(exposures=3, targets=12, free=False)
    found = measured(network, truth)
    after = adjust(network, truth, noise=Noise('student_t', 0.3, 8.0))
    precise = precision(network, after)
    claims = replace(precise, points=4.0 * precise.points, exterior=9.0 * precise.exterior)
    nothing = np.zeros_like(network.uv)
    plain = SolvedNetwork(found, after, nothing)
    stated = SolvedNetwork(found, after, nothing, stated=claims)
    factor = np.concatenate([np.full(18, 3.0), np.full(36, 2.0), np.zeros(3)])
    expected = np.outer(factor, factor) * plain.joint_precision().covariance
    np.testing.assert_allclose(
        stated.joint_precision().covariance, expected, rtol=1e-6, atol=1e-15
    )
    assert not stated.joint_precision().covariance[54:].any()
    p, q = np.array([0, 3, 5]), np.array([0, 4, 2])
    dense = dense_covariance(network, after)[18:54, 18:54].reshape(12, 3, 12, 3)
    for solved, size in ((plain, 1.0), (stated, 4.0)):
        np.testing.assert_allclose(
            solved.covariance_of_points()(p, q), size * dense[p, :, q], rtol=1e-5, atol=1e-12
        )


def test_fixed_interiors_are_uncertain_in_the_covariance_of_all_unknowns():
    network, truth = rigs.small_network(exposures=3, targets=12, free=False)
    after = adjust(network, truth, noise=Noise('gaussian', 0.3))
    fixed = np.diag([1.0, 4.0, 9.0])[None]
    nothing = np.zeros_like(network.uv)
    found = SolvedNetwork(measured(network, truth), after, nothing, fixed).joint_precision()
    normal = rigs.dense_normal_matrix(replace(network, interior_free=np.array([True])), after)
    known = np.linalg.inv(normal[:54, :54])
    by_interior = -known @ normal[:54, 54:]
    mixed = by_interior @ fixed[0]
    expected = np.block([[known + mixed @ by_interior.T, mixed], [mixed.T, fixed[0]]])
    scale = np.outer(*[np.sqrt(np.diagonal(expected))] * 2)
    np.testing.assert_allclose(found.covariance / scale, expected / scale, atol=1e-5)


# ---- relative orientations


def joint_case():
    network, truth = rigs.small_network(exposures=3, targets=25, fluoroscopes=2, seed=4)
    pairs = np.array([[0, 3], [1, 4], [2, 5]])
    # One relative orientation serves all pairs.
    turn, shift = relative_poses(truth, pairs)
    rotation, position = truth.rotation.copy(), truth.position_mm.copy()
    rotation[3:] = turn[0] @ rotation[:3]
    position[3:] = position[:3] + rotation[:3].transpose(0, 2, 1) @ shift[0]
    return network, replace(truth, rotation=rotation, position_mm=position), pairs


def test_covariance_of_a_mean_relative_orientation_equals_the_dense_one():
    """Reference: finite differences of the weighted mean, over all unknowns of the adjustment."""
    network, truth = rigs.small_network(exposures=3, targets=25, fluoroscopes=2, seed=4)
    found = measured(network, truth)
    after = adjust(network, truth, noise=Noise('student_t', 0.3, 8.0))
    pairs = np.array([[0, 3], [1, 4], [2, 5]])
    run = calibration_of(found, after, precision(network, after))
    covariance = dense_covariance(network, after)
    weights = []
    steps = np.tile([1e-3] * 3 + [1e-7] * 3, 6)

    def derivatives(function):
        columns = []
        for column, h in enumerate(steps):
            x = np.zeros(network.n_unknowns)
            x[column] = h
            forth, back = (rigs.moved(network, after.parameters, s * x) for s in (1, -1))
            columns.append((function(forth) - function(back)) / (2 * h))
        return np.stack(columns, axis=1)

    middle = mean_pose(after.parameters, pairs)

    def off(parameters, pose):
        turn, shift = relative_poses(parameters, pairs)
        return np.concatenate(
            [shift - pose.translation_mm, vector_from_matrix(turn @ pose.rotation.T)], axis=1
        )

    for k in range(3):
        d = derivatives(lambda parameters, k=k: off(parameters, middle)[k])
        weights.append(np.linalg.inv(d @ covariance[:36, :36] @ d.T))
    weights = np.array(weights)
    pose, got = _mean_of_run(run, pairs)
    expected = mean_pose(after.parameters, pairs, weights)
    np.testing.assert_allclose(pose.translation_mm, expected.translation_mm, rtol=1e-4)
    np.testing.assert_allclose(pose.rotation, expected.rotation, atol=1e-5)

    def mean(parameters):
        # Linear mean, about the pose at which the weights belong to the discrepancies.
        total = np.linalg.inv(weights.sum(axis=0))
        return total @ np.einsum('kab,kb->a', weights, off(parameters, middle))

    d = derivatives(mean)
    dense = d @ covariance[:36, :36] @ d.T
    scale = np.sqrt(np.diagonal(dense))
    np.testing.assert_allclose(
        got / np.outer(scale, scale), dense / np.outer(scale, scale), atol=1e-3
    )


def test_relative_orientations_have_the_scatter_of_their_pairs():
    found, after, precise = case(exposures=4, targets=25, fluoroscopes=3, seed=4)
    one, other = relative_orientations(calibration_of(found, after, precise), 'none')
    assert (one.fluoroscopes, other.fluoroscopes) == (('a', 'b'), ('a', 'c'))
    assert one.exposures == other.exposures == 4 and one.constraint == 'none'
    for b, got in ((1, one), (2, other)):
        turn, shift = relative_poses(after.parameters, np.arange(4)[:, None] + [0, 4 * b])
        off = shift - got.pose.translation_mm
        np.testing.assert_allclose(got.scatter_mm, np.sqrt(np.sum(off**2, axis=0) / 3))
        w = vector_from_matrix(turn @ got.pose.rotation.T)
        np.testing.assert_allclose(got.scatter_rad, np.sqrt(np.sum(w**2, axis=0) / 3))
        np.testing.assert_array_equal(got.sd_mm, np.sqrt(np.diagonal(got.covariance))[:3])
        np.testing.assert_array_equal(got.sd_rad, np.sqrt(np.diagonal(got.covariance))[3:])
    apart = replace(
        found,
        frames=tuple(
            replace(f, number=f.number + 50 * (f.fluoroscope == 'b')) for f in found.frames
        ),
    )
    (only,) = relative_orientations(calibration_of(apart, after, precise), 'none')
    assert only.fluoroscopes == ('a', 'c')


def test_a_single_pair_has_its_own_relative_orientation():
    found, after, precise = case(exposures=1, targets=25, fluoroscopes=2, free=False)
    (got,) = relative_orientations(calibration_of(found, after, precise), 'none')
    np.testing.assert_allclose(got.scatter_mm, 0, atol=1e-6)
    assert (got.sd_mm > 0).all()


def test_constrained_relative_orientations_are_those_of_the_adjustment():
    network, truth, pairs = joint_case()
    start = with_constraints(
        measured(network, truth), CalibrationOptions(relative_orientation='soft')
    )
    constraint = start.network.relative[0]
    np.testing.assert_array_equal(constraint.pairs, pairs)
    assert (constraint.sd_mm, constraint.sd_rad, constraint.length_mm) == (0.5, 2e-4, None)
    pose = start.start.relative[0]
    run = SimpleNamespace(
        measured=start,
        after=SimpleNamespace(parameters=start.start),
        precision=SimpleNamespace(relative=[np.eye(6)]),
    )
    (got,) = relative_orientations(run, 'soft')
    assert got.pose is pose and got.constraint == 'soft' and got.exposures == 3
    np.testing.assert_allclose(got.scatter_mm, 0, atol=1e-6)
    np.testing.assert_array_equal(got.covariance, np.eye(6))


def test_constraints_of_a_free_network_follow_its_scale():
    """Targets with fewer than three rays are excluded, too."""
    network, truth, _ = joint_case()
    keep = (network.point != 7) | (np.cumsum(network.point == 7) <= 2)
    keep &= (network.point != 3) | (np.cumsum(network.point == 3) <= 3)
    network = replace(
        network,
        uv=network.uv[keep],
        sigma=network.sigma[keep],
        exposure=network.exposure[keep],
        point=network.point[keep],
    )
    start = with_constraints(
        measured(network, truth), CalibrationOptions(relative_orientation='hard', datum='inner')
    )
    constraint = start.network.relative[0]
    assert constraint.length_mm == pytest.approx(
        np.linalg.norm(truth.position_mm[3] - truth.position_mm[0]), rel=1e-6
    )
    assert constraint.sd_mm < 1e-3 and start.network.datum == 'inner'
    (few,) = start.excluded
    assert few.kind is Kind.FEW_RAYS and few.place.target_id == (108,)
    np.testing.assert_array_equal(start.target_id, 101 + np.delete(np.arange(25), 7))
    old = network.point[network.point != 7]
    np.testing.assert_array_equal(start.target_id[start.network.point], 101 + old)
    np.testing.assert_array_equal(start.network.uv, network.uv[network.point != 7])
    for name in ('survey_mm', 'survey_sd_mm'):
        np.testing.assert_array_equal(
            getattr(start.network, name), np.delete(getattr(network, name), 7, axis=0)
        )
    np.testing.assert_array_equal(start.start.points_mm, np.delete(truth.points_mm, 7, axis=0))
    plain = with_constraints(measured(network, truth), CalibrationOptions())
    assert plain.network.n_points == 25 and not plain.excluded


def test_a_free_network_without_a_target_of_three_rays_is_refused():
    network, truth = rigs.small_network(exposures=2, targets=20, seen=1.0)
    with pytest.raises(DataError, match='no target is seen in three exposures'):
        with_constraints(measured(network, truth), CalibrationOptions(datum='inner'))


def known(sd=None):
    return KnownOrientation(
        np.array([500.0, 500.0, 4000.0]), np.eye(3), np.zeros(3), interior_sd=sd
    )


def test_interiors_are_estimated_unless_known_or_not_shown():
    network, truth = rigs.small_network(exposures=2, targets=10, fluoroscopes=3)
    start = measured(network, truth)
    plain = CalibrationOptions()
    fixed = CalibrationOptions(interior='fixed')
    weighted = CalibrationOptions(interior_sd=(1.0, 2.0, 3.0))
    flat = replace(start, untilted=(False, True, False))
    with_known = replace(flat, known={'c': known()})
    uncertain = replace(flat, known={'c': known((4.0, 5.0, 6.0))})
    assert interiors_to_estimate(start, plain).tolist() == [True] * 3
    assert interiors_to_estimate(start, fixed).tolist() == [False] * 3
    assert interiors_to_estimate(with_known, plain).tolist() == [True, False, False]
    assert interiors_to_estimate(uncertain, plain).tolist() == [True, False, True]
    assert interiors_to_estimate(uncertain, weighted).tolist() == [True, True, True]
    full, trend, turns, none = (
        GaugeKind.FULL,
        GaugeKind.TREND,
        GaugeKind.TURNS,
        GaugeKind.NONE,
    )
    assert gauges_of(with_known, plain) == (full, trend, none)
    assert gauges_of(with_known, fixed) == (turns, trend, none)
    assert gauges_of(start, plain) == (full,) * 3
    assert with_constraints(start, plain).network.interior_sd is None
    assert with_constraints(with_known, plain).network.interior_sd is None
    got = with_constraints(uncertain, plain).network
    np.testing.assert_array_equal(got.interior_sd, [[np.inf] * 3, [np.inf] * 3, [4.0, 5.0, 6.0]])
    np.testing.assert_array_equal(got.interior_mean, truth.interior)
    got = with_constraints(uncertain, weighted).network
    np.testing.assert_array_equal(got.interior_sd, [[1.0, 2.0, 3.0]] * 2 + [[4.0, 5.0, 6.0]])
    got = with_constraints(with_known, weighted).network
    np.testing.assert_array_equal(got.interior_sd[2], [np.inf] * 3)


# ---- with fixed calibrations


def test_noise_of_calibrations_is_that_of_the_median():
    used = [SimpleNamespace(sigma0=s, nu=nu) for s, nu in ((0.2, 5.0), (0.9, 9.0), (0.3, 30.0))]
    noise = noise_of_calibrations('student_t', used)
    assert (noise.loss, noise.scale, noise.nu, noise.gross) == ('student_t', 0.3, 9.0, 0.01)
    assert noise_of_calibrations('huber', used).gross == 0


def test_image_points_are_weighted_by_what_a_calibration_claims_there():
    """The noise profile applies to points without sigma, the sd of the correction to all."""
    network, truth = rigs.small_network(3, 20, 2)
    start = measured(network, truth)
    told = np.full(20, 0.7)
    frames = tuple(
        replace(f, sigma=told, angle=0.1) if i == 4 else f for i, f in enumerate(start.frames)
    )
    seen = []

    class Calibration:
        sigma0 = 0.25

        def __init__(self, factor):
            self.factor = factor

        def correction(self, uv, angle):
            seen.append(angle)
            return SimpleNamespace(duv=self.factor * uv, sd=np.full(len(uv), 0.1 * self.factor))

        def noise_factors(self, uv):
            return 1.0 + uv[:, 0] / 1000

    calibrations = {'a': Calibration(1.0), 'b': Calibration(2.0)}
    correction, weighted = fixed_corrections(replace(start, frames=frames), calibrations)
    f = 1.0 + network.fluoroscope[network.exposure]
    np.testing.assert_allclose(correction, f[:, None] * network.uv)
    profile = np.where(network.exposure == 4, 1.0, 1.0 + network.uv[:, 0] / 1000)
    expected = np.hypot(network.sigma * profile, 0.1 * f / 0.25)
    np.testing.assert_allclose(weighted.sigma, expected)
    own = network.exposure[network.rows(1)] == 4
    np.testing.assert_allclose(seen[1][own], 0.1, atol=1e-6)
    assert np.isnan(seen[1][~own]).all() and np.isnan(seen[0]).all()


@pytest.mark.parametrize('rays, few', [(2, True), (3, False)])
def test_noise_needs_three_rays_of_a_target(rays, few):
    network = SimpleNamespace(uv=np.zeros((20 * rays, 2)), survey_mm=np.zeros((20, 3)))
    assert too_few_rays_for_noise(network) == few


def test_a_rough_survey_rejects_no_image_points():
    """Survey errors are 30 px in the image; a robust adjustment started there would keep them."""
    network, truth = rigs.small_network(exposures=6, targets=60, survey_sd_mm=12.0, free=False)
    noise = Noise('student_t', 0.3, 8.0, gross=0.01)
    start = replace(truth, points_mm=network.survey_mm)
    nothing = np.zeros_like(network.uv)
    better = start_within_survey(network, start, nothing, noise)
    found = adjust(network, better, noise=noise)
    assert found.inliers.mean() > 0.97
    assert adjust(network, start, noise=noise).inliers.mean() < 0.9
    free = replace(network, datum='inner')
    assert start_within_survey(free, start, nothing, noise) is start
    sharp = replace(network, survey_sd_mm=np.full(60, 1e-3))
    assert start_within_survey(sharp, start, nothing, noise) is start


# ---- a survey from exposures


def test_rays_of_a_bead_are_counted_with_their_largest_angle():
    network, truth = rigs.small_network(exposures=5, targets=12, seen=0.6)
    after = adjust(network, truth, noise=Noise('gaussian', 0.3))
    inliers = np.arange(len(network.uv)) % 5 > 0
    adjustment = SimpleNamespace(parameters=after.parameters, inliers=inliers)
    rays, angle = _rays(network, adjustment)
    for p in range(12):
        rows = np.flatnonzero((network.point == p) & inliers)
        assert rays[p] == len(rows)
        to = after.parameters.points_mm[p] - after.parameters.position_mm[network.exposure[rows]]
        to = to / np.linalg.norm(to, axis=1)[:, None]
        cosines = [abs(a @ b) for i, a in enumerate(to) for b in to[:i]]
        assert angle[p] == pytest.approx(np.arccos(min(cosines)) if cosines else 0, abs=1e-7)
    assert rays.max() > 1


def test_scale_of_given_coordinates_is_as_uncertain_as_they_are():
    """Compare with a Monte Carlo of the least-squares scale of the coordinates."""
    rng = np.random.default_rng(3)
    given = rng.normal(0, 50.0, (8, 3)) + [100.0, 0, 0]
    sd = rng.uniform(0.2, 1.0, 8)
    arm = given - given.mean(axis=0)
    drawn = rng.normal(size=(4000, 8, 3)) * sd[:, None]
    scales = np.einsum('kna,na->k', drawn, arm) / np.sum(arm**2)
    assert _scale_sd(given, sd) == pytest.approx(scales.std(), rel=0.04)
