# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What has changed in a rig, inferred from visible bodies; views are made without the package."""

from dataclasses import replace
from types import SimpleNamespace as Fake

import numpy as np
import pytest
from body_views import orientation, project
from scipy.spatial.transform import Rotation

from fluoro_calib_ros.bodies.body import Body
from fluoro_calib_ros.healing.diagnosis import OF_RIG, Cause, Change, Diagnostician, _Tried
from fluoro_calib_ros.healing.healed_rig import healed_rig
from fluoro_calib_ros.healing.pose_modes import _choices, with_best_modes
from fluoro_calib_ros.healing.rig_adjustment import (
    LinearPoints,
    Mixture,
    ObservedBodies,
    Poses,
    RigAdjustment,
    _design,
)
from fluoro_calib_ros.healing.rig_errors import _errors, rig_errors
from fluoro_calib_ros.healing.sizes import SIZES

NOISE_PX = 0.2
SHAPE_SD_MM = 0.01
EXPOSURES = 12
BODIES = 3
MARKERS = 5
SIZE = (1024, 1024)
# Standard deviations of a healthy rig: T [mm], w [rad], xp, yp, c [px].
RIG_SD = np.array([0.02] * 3 + [2e-5] * 3 + [0.1, 0.1, 0.3])


class Scene:
    """Bodies moving through a rig whose parameters may have changed."""

    def __init__(self, seed):
        self.rng = rng = np.random.default_rng(seed)
        self.covariance = np.diag(np.concatenate([np.zeros(6), RIG_SD[6:], RIG_SD]) ** 2)
        self.rig = replace(orientation(2), covariance=self.covariance)
        self.errors = rng.normal(0, 1, 18) * np.sqrt(np.diagonal(self.covariance))
        self.shapes = rng.uniform(-20, 20, (BODIES, MARKERS, 3))
        learned = self.shapes + rng.normal(0, SHAPE_SD_MM, self.shapes.shape)
        self.bodies = [
            Body(f'bone{k}', 10 * k + np.arange(MARKERS), xyz, np.full(MARKERS, SHAPE_SD_MM))
            for k, xyz in enumerate(learned)
        ]
        angle = 2 * np.pi * np.arange(EXPOSURES)[:, None, None] / EXPOSURES
        turn = rng.uniform(-0.5, 0.5, (BODIES, 3)) * np.sin(angle + rng.uniform(0, 6, (BODIES, 3)))
        self.rotation = Rotation.from_rotvec(turn.reshape(-1, 3)).as_matrix()
        self.rotation = self.rotation.reshape(EXPOSURES, BODIES, 3, 3)
        self.centre = rng.uniform(-50, 50, (BODIES, 3)) + 30 * np.sin(
            angle + rng.uniform(0, 6, (BODIES, 3))
        )

    def observe(self, changed=np.zeros(18), scatter_mm=()):
        """Image points of the rig with changes (18,). scatter_mm: bodies whose markers scatter."""
        points = self.shapes @ np.swapaxes(self.rotation, 2, 3) + self.centre[:, :, None]
        for body, markers, sd in scatter_mm:
            points[:, body, markers] += self.rng.normal(0, sd, points[:, body, markers].shape)
        uv = project(self.rig, points.reshape(-1, 3), self.errors + changed)
        uv = uv.transpose(1, 0, 2).reshape(EXPOSURES, len(self.bodies), MARKERS, 2, 2)
        uv = uv + self.rng.normal(0, NOISE_PX, uv.shape)
        false = self.rng.random(uv.shape[:4]) < 0.01
        uv[false] = self.rng.uniform(0, 1023, (np.count_nonzero(false), 2))
        variance = np.full(uv.shape[:4], NOISE_PX**2)
        correction = np.full(uv.shape[1:4], 0.01**2)
        return ObservedBodies(uv, uv, variance, correction, np.ones(uv.shape[:4], bool))

    def poses(self):
        """Initial poses, off by a millimetre and a degree."""
        turn = Rotation.from_rotvec(self.rng.normal(0, 0.02, (EXPOSURES * BODIES, 3))).as_matrix()
        return Poses(
            turn.reshape(self.rotation.shape) @ self.rotation,
            self.centre + self.rng.normal(0, 1, self.centre.shape),
            np.ones((EXPOSURES, BODIES), dtype=bool),
        )

    def diagnostician(self):
        adjustment = RigAdjustment(self.rig, self.bodies, [SIZE, SIZE])
        scale = rig_errors(self.rig, self.centre.reshape(-1, 3)).scale
        return Diagnostician(adjustment, scale)


def test_derivatives_are_those_of_differences():
    scene = Scene(1)
    adjustment = scene.diagnostician().adjustment
    observed = scene.observe()
    poses = scene.poses()
    rng = np.random.default_rng(2)
    values = rng.normal(0, 1e-3, adjustment.size)
    values[adjustment.drift] = 0.0  # the gradient of a drift is neglected relative to 1

    def residual(at, of=poses):
        return LinearPoints.of(adjustment, observed, at, of).residual

    linear = LinearPoints.of(adjustment, observed, values, poses)
    for row in range(BODIES):
        unknowns = adjustment.of_body(row)
        design = np.zeros((*linear.residual[:, row].shape, adjustment.size))
        for f, axis in np.ndindex(2, 2):
            columns = unknowns.of_coordinate(f, axis)
            design[:, :, f, axis, columns] = _design(linear, row, f, axis)[..., :-1]
        for column in rng.choice(np.concatenate([each.ravel() for each in unknowns]), 40, False):
            step = np.zeros(adjustment.size)
            step[column] = 1e-5
            found = (residual(values - step) - residual(values + step))[:, row] / 2e-5
            np.testing.assert_allclose(design[..., column], found, atol=2e-3, rtol=2e-3)
        for axis in range(3):
            step = np.zeros(3)
            step[axis] = 1e-4
            ahead = replace(poses, centre_mm=poses.centre_mm + step)
            back = replace(poses, centre_mm=poses.centre_mm - step)
            found = (residual(values, back) - residual(values, ahead))[:, row] / 2e-4
            np.testing.assert_allclose(linear.by_pose(row)[..., axis], found, atol=1e-5)


def test_inliers_are_told_from_false_matches_that_lie_anywhere():
    """One point of a hundred is false, with the density of the image area."""
    residual = np.array([[0.1, 0.2], [0.8, -0.3], [1.5, 1.0]])[None, None, :, None]
    variance = np.array([0.04, 0.09, 0.16])[None, None, :, None]
    scale = np.array([[[1.0, 2.0, 1.0]]])
    area = 1e6
    good = np.ones((1, 1, 3, 1), dtype=bool)
    found = Mixture.of(
        Fake(_area=area),
        Fake(residual=residual, seen=np.ones((1, 1, 3, 1), dtype=bool), good=good),
        Fake(variance=variance),
        Fake(inflation=scale),
    )
    of_noise = variance * scale[..., None] ** 2
    square = np.sum(residual**2, axis=-1) / of_noise
    density = 0.99 * np.exp(-square / 2) / (2 * np.pi * of_noise)
    np.testing.assert_allclose(found.inlier(), density / (density + 0.01 / area))
    # The likelihood relative to that of a zero residual without the scale.
    likelihood = (density + 0.01 / area) * 2 * np.pi * variance / 0.99
    np.testing.assert_allclose(found.losses, -2 * np.log(likelihood))
    # A marker behind the source cannot have made its image point.
    behind = replace(found, good=np.array([True, True, False]).reshape(good.shape))
    assert behind.inlier()[0, 0, 2, 0] == 0
    assert behind.losses[0, 0, 2, 0] == pytest.approx(-2 * np.log(found.false[0, 0, 2, 0]))


def test_errors_of_points_are_of_their_scale_of_each_and_of_all_together():
    rng = np.random.default_rng(3)
    points = rng.uniform(-50, 50, (20, 3))
    arm = points - points.mean(axis=0)
    shift = np.tile([0.3, 0.0, 0.4], 20)
    turn = np.cross([0.0, 0.01, 0.0], arm).ravel()
    found = _errors(points, np.stack([shift, turn, 1e-3 * arm.ravel()], axis=1))
    assert found.scale == pytest.approx(1e-3)
    assert found.place_mm == pytest.approx(1e-3 * np.sqrt(np.mean(arm**2)))
    assert found.common_mm == pytest.approx(np.sqrt(0.5**2 + np.sum(turn**2) / 20))


def test_error_of_a_correction_counts_once():
    """The constant part of each marker and the smooth part sum to the claimed variance."""
    scene = Scene(3)
    adjustment = scene.diagnostician().adjustment
    observed = scene.observe()
    prior = adjustment.healthy_prior(observed, 1e-4)
    root = adjustment.root(prior)
    covariance = root @ root.T
    of_drift = np.diagonal(covariance)[adjustment.drift].reshape(2, 2, -1)
    functions = adjustment.functions_at(observed.pixel)
    smooth = np.mean(np.sum(functions**2 * of_drift[:, 0], axis=-1), axis=(0, 1, 2))
    of_markers = np.diagonal(covariance)[adjustment.bias].reshape(BODIES, MARKERS, 2, 2)
    stays = np.mean(of_markers[..., 0], axis=(0, 1))
    assert (0.2 * observed.correction[0, 0] < smooth).all()
    np.testing.assert_allclose(smooth + stays, observed.correction[0, 0])


def test_healthy_rig_has_not_changed():
    scene = Scene(3)
    found = scene.diagnostician().diagnose(scene.observe(), scene.poses())
    assert found.changes == () and found.no_further_probability > 0.95 and found.sure
    assert found.noise < 1.1


@pytest.mark.long
def test_knock_would_be_told_by_bodies_that_move_and_not_by_a_single_one_that_stands():
    scene = Scene(3)
    diagnostician = scene.diagnostician()
    found = diagnostician.diagnose(scene.observe(), scene.poses())
    healed = healed_rig(diagnostician, found, 7, EXPOSURES)
    assert not healed.changes.any() and healed.orientation.source == 'healing'
    known = scene.rig.rounded()
    np.testing.assert_array_equal(healed.orientation.position_mm, known.position_mm)
    claimed, known = (np.diagonal(one.covariance) for one in (healed.orientation, known))
    assert (claimed[9:15] > known[9:15]).all()
    np.testing.assert_allclose(claimed[15:], known[15:], rtol=1e-6)
    by_all = healed.weakest
    still = Scene(3)
    still.bodies = [replace(still.bodies[0], sd_mm=np.full(MARKERS, 1.0))]
    still.shapes = still.shapes[:1]
    still.rotation = np.repeat(still.rotation[:1, :1], EXPOSURES, axis=0)
    still.centre = np.repeat(still.centre[:1, :1], EXPOSURES, axis=0)
    diagnostician = still.diagnostician()
    poses = Poses(still.rotation, still.centre, np.ones((EXPOSURES, 1), dtype=bool))
    found = diagnostician.diagnose(still.observe(), poses)
    by_one = healed_rig(diagnostician, found, 7, EXPOSURES).weakest
    assert by_all < 0.2 and by_one > 0.5


def test_unseen_knock_is_claimed_by_the_evidence_of_its_size():
    """The claim is smaller than after a certain hard knock, and larger than as calibrated."""
    scene = Scene(3)
    diagnostician = scene.diagnostician()
    found = diagnostician.diagnose(scene.observe(), scene.poses())
    claimed = healed_rig(diagnostician, found, 7, EXPOSURES).orientation
    adjustment = diagnostician.adjustment
    hard = np.zeros(adjustment.size)
    for knock in diagnostician.knocks():
        hard += diagnostician.sd_of(knock)
    prior = found.prior.widened(hard)
    knocked = adjustment.with_fixed(found.observed, prior, found.solution, hard > 0)
    change = knocked.values[adjustment.rig]
    covariance = knocked.covariance[adjustment.rig, adjustment.rig] + np.outer(change, change)
    points = scene.centre.reshape(-1, 3)
    least, most = scene.rig, replace(scene.rig, covariance=covariance)
    of_all = [rig_errors(one, points).common_mm for one in (least, claimed, most)]
    assert of_all[0] < of_all[1] < 0.9 * of_all[2]


@pytest.mark.long
def test_moved_fluoroscope_is_found_and_estimated_with_its_deviations():
    """Over several rigs, the change of b is estimated as well as its covariance claims."""
    squares = []
    for seed in range(4, 7):
        scene = Scene(seed)
        moved = np.zeros(18)
        moved[9:15] = [4.0, -3.0, 2.0, 0.006, -0.004, 0.005]
        diagnostician = scene.diagnostician()
        observed = scene.observe(moved)
        found = diagnostician.diagnose(observed, scene.poses())
        assert [(one.cause, one.fluoroscope) for one in found.changes] == [(Cause.ORIENTATION, 1)]
        assert found.sure
        healed = healed_rig(diagnostician, found, 7, EXPOSURES)
        assert healed.orientation.source == 'healing' and healed.orientation.stamp_ns == 7
        assert healed.weakest < 0.5 and not healed.drift
        assert not healed.changes[0].any() and not healed.changes[1, 6:].any()
        error = (healed.changes[1] - moved[9:] - scene.errors[9:])[:6]
        covariance = healed.orientation.covariance[9:15, 9:15]
        squares.append(error @ np.linalg.solve(covariance, error))
        # The fixed unknowns keep their covariance.
        np.testing.assert_allclose(
            healed.orientation.covariance[15:, 15:], scene.covariance[15:, 15:], rtol=1e-6
        )
    # chi-square with 18 degrees of freedom: 0.5 % lie beyond each limit
    assert 6.3 < np.sum(squares) < 37.2


@pytest.mark.long
def test_estimate_does_not_depend_on_the_size_that_was_likeliest():
    """The bodies stand still, so some directions of the change are hardly determined."""
    scene = Scene(8)
    scene.rotation = np.repeat(scene.rotation[:1], EXPOSURES, axis=0)
    scene.centre = np.repeat(scene.centre[:1], EXPOSURES, axis=0)
    moved = np.zeros(18)
    moved[9:15] = [4.0, -3.0, 2.0, 0.006, -0.004, 0.005]
    diagnostician = scene.diagnostician()
    observed = scene.observe(moved)
    found = diagnostician.diagnose(observed, scene.poses())
    assert [one.cause for one in found.changes] == [Cause.ORIENTATION]
    healthy = diagnostician.adjustment.healthy_prior(observed, 1e-4)
    estimated = []
    for size in (1.0, 0.125):
        prior = healthy.widened(size * diagnostician.sd_of(found.changes[0]))
        diagnosis = replace(found, prior=prior)
        estimated.append(healed_rig(diagnostician, diagnosis, 7, EXPOSURES))
    large, small = estimated
    np.testing.assert_allclose(small.sd[1, :6], large.sd[1, :6], rtol=0.02)
    difference = np.abs(small.changes - large.changes)[1, :6]
    assert (difference < 0.02 * large.sd[1, :6]).all()
    error = (large.changes[1] - moved[9:] - scene.errors[9:])[:6]
    assert (np.abs(error) < 4 * large.sd[1, :6]).all()


@pytest.mark.long
@pytest.mark.parametrize('cause', [Cause.ORIENTATION, Cause.INTERIOR])
def test_evidence_of_a_cause_is_the_mean_over_its_sizes(cause):
    """Reference: solutions for every second size, as equations are valid only near one."""
    scene = Scene(9)
    moved = np.zeros(18)
    moved[9:15] = [0.4, -0.3, 0.2, 0.0006, -0.0004, 0.0005]
    diagnostician = scene.diagnostician()
    adjustment = diagnostician.adjustment
    observed = scene.observe(moved)
    healthy = adjustment.healthy_prior(observed, 1e-4)
    start = np.zeros(adjustment.size), scene.poses()
    solution = adjustment.solve(observed, healthy, start)
    change = Change(cause, 1)
    best = _Tried((), observed, healthy, solution, 0.0)
    found = diagnostician._with(best, change, start)
    shift, turn = diagnostician.parts_of(change)
    start = found.solution.values, found.solution.poses
    total = 0.0
    weights = SIZES[::2] / (1 + SIZES[::2] ** 2)
    for a, of_a in zip(SIZES[::2], weights):
        for b, of_b in zip(SIZES[::2], weights):
            prior = healthy.widened(np.hypot(a * shift, b * turn))
            one = adjustment.refine(observed, prior, start)
            total += of_a * of_b * np.exp(one.evidence - found.solution.evidence)
    expected = found.solution.evidence + np.log(total / weights.sum() ** 2)
    assert found.evidence == pytest.approx(expected, abs=0.5)
    # The size used in the solution differs from the mean.
    assert abs(found.by_size) > 0.5


@pytest.mark.long
@pytest.mark.parametrize('view', [0, 1])
def test_changed_interior_is_told_from_a_moved_fluoroscope(view):
    scene = Scene(20 + view)
    changed = np.zeros(18)
    changed[9 * view + 6 : 9 * view + 9] = [0.0, 6.0, 60.0]
    found = scene.diagnostician().diagnose(scene.observe(changed), scene.poses())
    assert (found.changes[0].cause, found.changes[0].fluoroscope) == (Cause.INTERIOR, view)


@pytest.mark.long
def test_markers_and_bodies_that_have_changed_are_named():
    scene = Scene(30)
    scene.shapes[1, 2] += [0.3, -0.3, 0.3]
    found = scene.diagnostician().diagnose(scene.observe(), scene.poses())
    assert [(o.cause, o.body, o.markers) for o in found.changes] == [(Cause.MIGRATED, 1, (2,))]
    scene = Scene(31)
    scatter = scene.observe(scatter_mm=[(2, slice(None), 0.15)])
    found = scene.diagnostician().diagnose(scatter, scene.poses())
    assert [(one.cause, one.body) for one in found.changes] == [(Cause.SOFT, 2)]
    scene = Scene(32)
    found = scene.diagnostician().diagnose(scene.observe(scatter_mm=[(0, 3, 0.2)]), scene.poses())
    assert [(o.cause, o.body, o.markers) for o in found.changes] == [(Cause.LOOSE, 0, (3,))]
    scene = Scene(33)
    exchanged = scene.observe().exchanged(1, 0, 4)
    found = scene.diagnostician().diagnose(exchanged, scene.poses())
    assert [(o.cause, o.body, o.markers) for o in found.changes] == [(Cause.EXCHANGED, 1, (0, 4))]


def test_changes_of_a_body_that_cannot_explain_what_others_show_are_not_solved_for(monkeypatch):
    tried = []
    solve = Diagnostician._with

    def noted(self, best, change, start):
        tried.append(change.cause)
        return solve(self, best, change, start)

    monkeypatch.setattr(Diagnostician, '_with', noted)
    scene = Scene(0)
    moved = np.zeros(18)
    moved[9:15] = [2.0, 2.0, 2.0, 0.004, 0.004, 0.004]
    found = scene.diagnostician().diagnose(scene.observe(moved), scene.poses())
    assert [one.cause for one in found.changes] == [Cause.ORIENTATION]
    assert set(tried) == set(OF_RIG)


@pytest.mark.long
def test_no_further_cause_is_looked_for_after_one_that_is_enough():
    scene = Scene(30)
    scene.shapes[1, 2] += [0.3, -0.3, 0.3]
    moved = np.zeros(18)
    moved[9:15] = [4.0, -3.0, 2.0, 0.006, -0.004, 0.005]
    diagnostician = scene.diagnostician()
    observed, poses = scene.observe(moved), scene.poses()
    found = diagnostician.diagnose(observed, poses)
    assert [one.cause for one in found.changes] == [Cause.ORIENTATION, Cause.MIGRATED]
    first = diagnostician.diagnose(observed, poses, until=OF_RIG)
    assert first.changes == found.changes[:1] and not first.complete


def test_hypothesis_that_turns_the_rig_into_another_one_ends_before():
    """Images of b have a third of their size, as if by an impossible principal distance."""
    scene = Scene(51)
    diagnostician = scene.diagnostician()
    adjustment = diagnostician.adjustment
    observed = scene.observe()
    uv = observed.uv.copy()
    uv[..., 1, :] = 511.5 + (uv[..., 1, :] - 511.5) / 3
    observed = replace(observed, uv=uv, pixel=uv)
    sd = 1e3 * diagnostician.sd_of(Change(Cause.INTERIOR, 1))
    prior = adjustment.healthy_prior(observed, 1e-4).widened(sd)
    found = adjustment.solve(observed, prior, (np.zeros(adjustment.size), scene.poses()))
    assert np.isfinite(found.evidence)
    distance = adjustment.rig_at(found.values).interior[1, 2]
    assert distance > scene.rig.interior[1, 2] / 2


def test_pose_with_two_false_matches_does_not_take_others_for_false():
    """The start fits no marker, and two other markers of the body are seen by one view only."""
    scene = Scene(50)
    adjustment = scene.diagnostician().adjustment
    observed = scene.observe()
    uv = observed.uv.copy()
    uv[5, 1, [0, 3], 1] = [[200.0, 700.0], [800.0, 300.0]]
    seen = observed.seen.copy()
    seen[5, 1, 4] = False  # leaves a body of four markers
    observed = replace(observed, uv=uv, pixel=uv, seen=seen)
    prior = adjustment.healthy_prior(observed, 1e-4)
    right = adjustment.solve(observed, prior, (np.zeros(adjustment.size), scene.poses()))
    rotation = right.poses.rotation.copy()
    rotation[5, 1] = Rotation.from_rotvec([3.1, 0, 0]).as_matrix() @ rotation[5, 1]
    start = right.values, replace(right.poses, rotation=rotation)
    astray = adjustment.refine(observed, prior, start)
    assert astray.inliers_of_pose[5, 1] < 0.7
    found = with_best_modes(adjustment, observed, prior, astray)
    assert found.inliers_of_pose[5, 1] == pytest.approx(0.75, abs=0.02)
    assert found.evidence > astray.evidence + 10
    turn = found.poses.rotation[5, 1] @ scene.rotation[5, 1].T
    assert Rotation.from_matrix(turn).magnitude() < 0.02


@pytest.mark.parametrize('seed', [50, 51, 52])
def test_markers_behind_a_source_are_false_matches(seed):
    """In one view, two of four image points are false; a pose behind the source explains none."""
    scene = Scene(seed)
    adjustment = scene.diagnostician().adjustment
    observed = scene.observe()
    uv = observed.uv.copy()
    uv[5, 1, [0, 3], 0] = [[200.0, 700.0], [800.0, 300.0]]
    seen = observed.seen.copy()
    seen[5, 1, :, 1] = False
    seen[5, 1, 4] = False
    observed = replace(observed, uv=uv, pixel=uv, seen=seen)
    prior = adjustment.healthy_prior(observed, 1e-4)
    start = adjustment.solve(observed, prior, (np.zeros(adjustment.size), scene.poses()))
    found = with_best_modes(adjustment, observed, prior, start)
    linear = LinearPoints.of(adjustment, observed, found.values, found.poses)
    assert linear.good[5, 1, :4, 0].all()
    assert found.inliers_of_pose[5, 1] == pytest.approx(0.5, abs=0.02)


def test_false_matches_are_tried_alone_and_in_pairs_of_bodies_with_few_image_points():
    few = _choices((4, 2))
    assert few.shape == (1 + 8 + 28, 4, 2) and not few[0].any()
    assert len(np.unique(few.reshape(len(few), -1), axis=0)) == len(few)
    assert few.reshape(len(few), -1).sum(axis=1).max() == 2
    assert len(_choices((20, 2))) == 1 + 40


@pytest.mark.long
def test_errors_of_points_by_the_rig_are_those_of_random_rigs():
    """Scale and places of points after random errors of the rig, by Monte Carlo."""
    scene = Scene(40)
    covariance = np.diag(np.tile(RIG_SD, 2) ** 2)
    rig = replace(scene.rig, covariance=covariance)
    points = scene.rng.uniform(-60, 60, (20, 3))
    claimed = rig_errors(rig, points)
    scales = []
    squares = []
    for _ in range(400):
        errors = scene.rng.normal(0, 1, 18) * np.tile(RIG_SD, 2)
        uv = project(rig, points, errors)
        moved = np.array([_intersection(rig, uv[:, k]) for k in range(len(points))])
        arm = points - points.mean(axis=0)
        change = moved - moved.mean(axis=0) - arm
        motion = np.stack([np.cross(axis, arm).ravel() for axis in np.eye(3)], axis=1)
        scales.append(np.linalg.lstsq(np.c_[motion, arm.ravel()], change.ravel())[0][-1])
        squares.append(
            np.mean((change.ravel() - motion @ np.linalg.lstsq(motion, change.ravel())[0]) ** 2)
        )
    assert np.std(scales) == pytest.approx(claimed.scale, rel=0.12)
    assert np.sqrt(np.mean(squares)) == pytest.approx(claimed.place_mm, rel=0.12)


def _intersection(rig, uv):
    """Point (3,) nearest to two rays, by linear least squares of the image equations."""
    rows = []
    right = []
    for f in range(2):
        xp, yp, c = rig.interior[f]
        for axis, value in enumerate((uv[f, 0] - xp, uv[f, 1] - yp)):
            row = c * rig.rotation[f][axis] - value * rig.rotation[f][2]
            rows.append(row)
            right.append(row @ rig.position_mm[f])
    return np.linalg.lstsq(np.array(rows), np.array(right))[0]
