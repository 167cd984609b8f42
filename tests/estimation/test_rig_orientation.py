# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Orientation of a rig: dense covariances, averaged frames, and selection of pairs."""

from dataclasses import replace
from types import SimpleNamespace as Fake

import numpy as np
import pytest
import rigs
from rigs import exposures

from fluoro_calib_ros.errors import DataError
from fluoro_calib_ros.estimation import rig_orientation
from fluoro_calib_ros.estimation.fixed_calibration import (
    fixed_corrections,
    network_of_calibrations,
)
from fluoro_calib_ros.estimation.result import ExposureResult
from fluoro_calib_ros.estimation.rig_orientation import (
    MAX_PAIRS,
    _adjusted,
    _paired,
    _relative_to_first,
    _seen_by_first,
    orientation_and_scatter,
    orientation_of_capture,
    orientation_of_known,
    standing_frames,
)
from fluoro_calib_ros.exposures.frame import Frame
from fluoro_calib_ros.exposures.phantom import Phantom
from fluoro_calib_ros.photogrammetry.rig_orientation import KnownOrientation
from fluoro_calib_ros.photogrammetry.rotations import (
    matrix_from_vector,
    quaternion_from_matrix,
    vector_from_matrix,
)
from fluoro_calib_ros.photogrammetry.unknowns import mean_pose, relative_poses
from fluoro_calib_ros.simulation.rig import Detection, simulate_exposures, virtual_rig

NAMES = ('a', 'b')


def rig_without_distortion(targets=60):
    """A rig without distortion, with few targets, and its uncertain calibrations."""
    rig = virtual_rig(1, strength=0.0)
    kept = np.random.default_rng(2).permutation(len(rig.true_mm))[:targets]
    kept.sort()
    phantom = Phantom(
        rig.phantom.target_id[kept], rig.phantom.xyz_mm[kept], rig.phantom.sd_mm[kept]
    )
    root = np.array([[1.2, 0, 0], [0.3, 2.0, 0], [0.2, -0.2, 1.0]])
    calibrations = {
        name: replace(
            one,
            interior_covariance=(1 + f) * root @ root.T,
            sigma0=0.25,
            nu=30.0,
            noise_profile=None,
        )
        for f, (name, one) in enumerate(rigs.true_calibrations(rig.fluoroscopes).items())
    }
    return rig, phantom, calibrations


def frames_of(rig, phantom, count=1, seed=3):
    """Frames by fluoroscope of the targets of a phantom."""
    found = simulate_exposures(rig, count, seed, detection=Detection(false_matches=0.0)).frames
    return {
        name: [f.rows(np.isin(f.target_id, phantom.target_id)) for f in of_one]
        for name, of_one in found.items()
    }


def dense(measured, after, calibrations):
    """Covariance of exteriors (6m, 6m), their derivatives (6m, 3F), covariance of interiors."""
    _, network = fixed_corrections(measured, calibrations)
    network = replace(network, interior_free=np.ones(2, dtype=bool))
    factor = after.noise.information_factor(after.q)
    normal = rigs.dense_normal_matrix(network, after, factor)
    known = np.linalg.inv(normal[:-6, :-6])
    m = 6 * network.n_exposures
    by_interior = (-known @ normal[:-6, -6:])[:m]
    interiors = np.zeros((6, 6))
    for f, name in enumerate(measured.fluoroscopes):
        interiors[3 * f : 3 * f + 3, 3 * f : 3 * f + 3] = calibrations[name].interior_covariance
    return known[:m, :m], by_interior, interiors


def assert_same_covariance(found, expected, atol=1e-4):
    scale = np.sqrt(np.diagonal(expected))
    np.testing.assert_allclose(
        found / np.outer(scale, scale), expected / np.outer(scale, scale), atol=atol
    )


def test_covariance_of_a_capture_equals_the_dense_one():
    """Exteriors with fixed but uncertain interior orientations, and mixed covariances."""
    rig, phantom, calibrations = rig_without_distortion()
    frames = frames_of(rig, phantom)
    found = orientation_of_capture(frames, phantom, calibrations, 'lab')
    fixed = _adjusted(network_of_calibrations(frames, phantom, calibrations), calibrations, True)
    known, by_interior, interiors = dense(fixed.measured, fixed.after, calibrations)
    mixed = by_interior @ interiors
    every = np.block([[known + mixed @ by_interior.T, mixed], [mixed.T, interiors]])
    order = [*range(6), 12, 13, 14, *range(6, 12), 15, 16, 17]
    assert_same_covariance(found.covariance, every[np.ix_(order, order)])
    assert (found.frame_id, found.source, found.exposures) == ('lab', 'capture', 1)
    np.testing.assert_array_equal(found.interior, [f.interior for f in rig.fluoroscopes])
    assert found.optical_frame_ids == ('a_optical', 'b_optical')
    assert fixed.after.noise.scale == 0.25


def test_relative_orientation_of_exposures_equals_the_dense_one():
    """Reference: finite differences of the weighted mean, enlarged by the scatter of the pairs."""
    rig, phantom, calibrations = rig_without_distortion()
    frames = frames_of(rig, phantom, 4)
    frames['b'] = frames['b'][1:]
    # The network has frames in ascending order; the order of those of b does not matter.
    measured = network_of_calibrations(frames, phantom, calibrations)
    fixed = _adjusted(measured, calibrations, False)
    exteriors, (scatter,) = _relative_to_first(fixed, ())
    parameters = fixed.after.parameters
    covariance, by_interior, _ = dense(measured, fixed.after, calibrations)
    pairs = np.array([[1, 4], [2, 5], [3, 6]])
    middle = mean_pose(parameters, pairs)

    def off(x):
        moved = x.reshape(-1, 6)
        there = replace(
            parameters,
            position_mm=parameters.position_mm + moved[:, :3],
            rotation=matrix_from_vector(moved[:, 3:]) @ parameters.rotation,
        )
        turn, shift = relative_poses(there, pairs)
        return np.concatenate(
            [shift - middle.translation_mm, vector_from_matrix(turn @ middle.rotation.T)], axis=1
        )

    steps = np.tile([1e-3] * 3 + [1e-7] * 3, 7)
    d = np.stack([(off(h * e) - off(-h * e)) / (2 * h) for h, e in zip(steps, np.eye(42))], axis=2)
    weights = np.linalg.inv(d @ covariance @ d.transpose(0, 2, 1))
    mean = np.einsum('ab,kbc,kcd->ad', np.linalg.inv(weights.sum(axis=0)), weights, d)
    expected = scatter.growth**2 * mean @ covariance @ mean.T
    assert_same_covariance(exteriors.covariance[6:, 6:], expected, 2e-3)
    assert not exteriors.covariance[:6].any() and not exteriors.by_interior[:6].any()
    scale = np.abs(mean @ by_interior).max(axis=1, keepdims=True)
    np.testing.assert_allclose(
        exteriors.by_interior[6:] / scale, mean @ by_interior / scale, atol=2e-3
    )
    pose = mean_pose(parameters, pairs, weights)
    np.testing.assert_allclose(exteriors.position_mm[1], pose.translation_mm, atol=1e-3)
    np.testing.assert_allclose(exteriors.rotation[1], pose.rotation, atol=1e-6)
    assert scatter.fluoroscopes == NAMES and scatter.exposures.tolist() == [2, 3, 4]
    deviation = np.sqrt(
        [o @ w @ o / 6 for o, w in zip(off_from(parameters, pairs, pose), weights)]
    )
    np.testing.assert_allclose(scatter.off_sd, deviation, rtol=0.02)
    assert scatter.angle_px == 0 and not scatter.corrected and scatter.columns.shape == (3, 1)
    turn, shift = relative_poses(parameters, pairs)
    np.testing.assert_array_equal(scatter.turn, turn)
    np.testing.assert_array_equal(scatter.shift_mm, shift)


def off_from(parameters, pairs, pose):
    turn, shift = relative_poses(parameters, pairs)
    return np.concatenate(
        [shift - pose.translation_mm, vector_from_matrix(turn @ pose.rotation.T)], axis=1
    )


def test_points_that_the_first_fluoroscope_sees_are_in_its_sensor_frame():
    rig, phantom, calibrations = rig_without_distortion()
    frames = frames_of(rig, phantom, 2)
    measured = network_of_calibrations(frames, phantom, calibrations)
    points = _seen_by_first(Fake(measured=measured, after=Fake(parameters=measured.start)))
    uv = np.concatenate([f.uv for f in frames['a']])
    interior = rig.fluoroscopes[0].interior
    seen = interior[:2] + interior[2] * points[:, :2] / points[:, 2:]
    assert np.sqrt(np.mean((seen - uv) ** 2)) < 1.0
    found, _ = orientation_and_scatter(frames_of(rig, phantom, 3), phantom, calibrations)
    assert (found.frame_id, found.source, found.exposures) == ('a_optical', 'joint calibration', 3)
    assert not found.position_mm[0].any()
    a, b = rig.fluoroscopes
    true = a.rotation @ (b.position_mm - a.position_mm)
    assert np.linalg.norm(found.position_mm[1] - true) < 4 * np.linalg.norm(found.sd_mm[1])


def test_orientation_of_known_fluoroscopes_is_the_mean_of_their_exposures():
    rig, _, calibrations = rig_without_distortion()
    rng = np.random.default_rng(4)
    figures, known = {}, {}
    for one, sd in zip(rig.fluoroscopes, (None, (2.0, 3e-3))):
        known[one.name] = KnownOrientation(
            one.interior, one.rotation, one.position_mm, exterior_sd=sd
        )
        turns = rng.normal(0, 1e-3, (5, 3))
        turns -= turns.mean(axis=0)
        figures[one.name] = Fake(
            exposures=[
                ExposureResult(
                    n,
                    one.position_mm + [n - 2.0, 0, 2 * (n - 2.0)],
                    quaternion_from_matrix(matrix_from_vector(turns[n]) @ one.rotation),
                    np.zeros(3),
                    np.zeros(3),
                )
                for n in range(5)
            ]
        )
    found = orientation_of_known(known, figures, calibrations)
    for f, one in enumerate(rig.fluoroscopes):
        np.testing.assert_allclose(found.position_mm[f], one.position_mm, atol=1e-6)
        np.testing.assert_allclose(found.rotation[f], one.rotation, atol=1e-5)
    sd = [3e-4] * 3 + [1e-7] * 3
    np.testing.assert_allclose(np.diagonal(found.covariance)[:6], np.square(sd), rtol=1e-6)
    np.testing.assert_allclose(
        np.diagonal(found.covariance)[9:15], [4.0] * 3 + [9e-6] * 3, rtol=1e-6
    )
    for f, name in enumerate(NAMES):
        at = slice(9 * f + 6, 9 * f + 9)
        np.testing.assert_allclose(
            found.covariance[at, at], calibrations[name].interior_covariance, rtol=1e-6
        )
    assert not found.covariance[:9, 9:].any() and found.frame_id == 'lab'
    assert found.stamp_ns == max(c.stamp_ns for c in calibrations.values())


# ---- frames of a capture


def still(shifts, sigma=None, ids=((3, 5, 9),) * 9, first=1):
    """Frames of a phantom shifted by (n, 2) [px]; sigma: of each frame."""
    place = np.array([[100.0, 100.0], [500.0, 300.0], [900.0, 700.0]])
    out = []
    for n, shift in enumerate(shifts):
        own = np.isin([3, 5, 9], ids[n])
        sd = None if sigma is None else np.full(own.sum(), sigma[n])
        out.append(
            Frame(
                'a',
                first + n,
                np.array(ids[n]),
                place[own] + shift,
                (1024, 1024),
                sd,
                1000 * n,
                'frame',
                0.25,
            )
        )
    return out


def mean(frames, image_sd=0.25):
    return standing_frames({'a': frames}, {'a': Fake(image_sd=image_sd)})['a']


def test_mean_of_frames_is_weighted_by_sigma():
    frames = still([[0.0, 0.0], [0.4, -0.2], [0.8, 0.2]], [0.5, 0.25, 1.0])
    found = mean(frames)
    weight = np.array([4.0, 16.0, 1.0])
    shift = weight @ [[0.0, 0.0], [0.4, -0.2], [0.8, 0.2]] / weight.sum()
    np.testing.assert_allclose(found.uv[1], [500.0, 300.0] + shift)
    np.testing.assert_allclose(found.sigma, weight.sum() ** -0.5)
    assert (found.number, found.stamp_ns, found.frame_id, found.angle) == (
        3,
        2000,
        'frame',
        frames[2].angle,
    )
    back = mean(frames[::-1])
    np.testing.assert_allclose(back.uv, found.uv)
    assert back.number == 3
    assert mean(frames[:1]) is frames[0]


def test_targets_of_some_frames_have_their_own_weight():
    ids = ((3, 5, 9), (3, 9), (3,), (3, 5))
    frames = still([[0.0, 0.0], [0.3, 0.0], [0.0, 0.3], [-0.3, 0.3]], ids=ids)
    found = mean(frames)
    assert found.target_id.tolist() == [3, 5, 9]
    np.testing.assert_allclose(found.sigma, [0.5, 2**-0.5, 2**-0.5])
    expected = np.array([[100.0, 100.15], [499.85, 300.15], [900.15, 700.0]])
    np.testing.assert_allclose(found.uv, expected, atol=1e-12)


@pytest.mark.parametrize(
    'off, image_sd, used',
    [(1.2, 0.25, True), (1.3, 0.25, False), (0.95, 0.1, True), (1.05, 0.1, False)],
)
def test_false_matches_of_a_capture_are_those_far_from_the_median(off, image_sd, used):
    """The limit is five standard deviations, but at least a pixel."""
    frames = still([[0.0, 0.0]] * 5)
    uv = frames[2].uv.copy()
    uv[1] += [0.6 * off, -0.8 * off]
    frames[2] = replace(frames[2], uv=uv)
    found = mean(frames, image_sd)
    shift = np.array([0.6 * off, -0.8 * off]) / 5 if used else np.zeros(2)
    np.testing.assert_allclose(found.uv[1], [500.0, 300.0] + shift, atol=1e-12)
    assert found.sigma[1] == pytest.approx((5 if used else 4) ** -0.5)


def test_a_target_of_two_frames_that_contradict_each_other_is_left_out():
    """Either of them may be false."""
    frames = still([[0.0, 0.0], [0.0, 0.0]])
    uv = frames[1].uv.copy()
    uv[1] += [30.0, 0.0]
    assert mean([frames[0], replace(frames[1], uv=uv)]).target_id.tolist() == [3, 9]


@pytest.mark.parametrize('image_sd, limit', [(0.2, 1.0), (0.5, 2.0)])
def test_a_phantom_that_moves_is_refused_from_frame_to_frame_and_slowly(image_sd, limit):
    """The limit is four standard deviations, but at least a pixel."""
    uv = np.random.default_rng(5).uniform(100, 900, (9, 2))
    ids = np.arange(9)

    def of(shifts):
        return mean(
            [Frame('a', n, ids, uv + shift, (1024, 1024)) for n, shift in enumerate(shifts)],
            image_sd,
        )

    for factor, moves in ((0.95, False), (1.05, True)):
        size = factor * limit
        for shifts in ([[0, 0], [size, 0], [0, 0]], [[0, 0.5 * n * size] for n in range(3)]):
            if moves:
                with pytest.raises(DataError, match='the phantom does not stand still'):
                    of(shifts)
            else:
                assert len(of(shifts).uv) == 9
    apart = still([[0.0, 0.0], [50.0, 0.0]], ids=((3,), (5,)))
    assert mean(apart).target_id.tolist() == [3, 5]  # no common target to compare


# ---- selection of pairs


def test_many_exposures_are_thinned_evenly():
    """Exposures seen by all fluoroscopes take precedence."""
    frame = exposures(6)['a'][0]
    frames = {
        name: [replace(frame, fluoroscope=name, number=n) for n in range(*numbers)]
        for name, numbers in (('a', (0, 400)), ('b', (0, 400, 2)), ('c', (0, 400)))
    }
    used = _paired(frames)
    numbers = {name: [f.number for f in of_one] for name, of_one in used.items()}
    assert numbers['a'] == numbers['b'] == numbers['c'] and len(numbers['a']) == MAX_PAIRS
    assert (
        numbers['a'][0] == 0
        and numbers['a'][-1] == 398
        and max(np.diff(numbers['a'])) <= 800 / MAX_PAIRS
    )
    frames['b'] = frames['b'][:3]
    numbers = {name: [f.number for f in of_one] for name, of_one in _paired(frames).items()}
    assert len(numbers['a']) == MAX_PAIRS and numbers['a'] == numbers['c']
    frames['b'], frames['c'] = frames['c'], frames['b'][1:] + frames['a'][7:10]
    numbers = {name: {f.number for f in of_one} for name, of_one in _paired(frames).items()}
    assert numbers['c'] == {f.number for f in frames['c']}  # none of the few is left out


@pytest.mark.parametrize('turning', [(), ('a',), ('b',)])
def test_corrections_that_change_with_the_angle_of_either_fluoroscope_count(monkeypatch, turning):
    told = []

    def mean_and_scatter(fixed, pairs, corrected):
        told.append(corrected)
        pose = Fake(rotation=np.eye(3), translation_mm=np.zeros(3))
        return pose, np.zeros((6, 12)), Fake(growth=np.ones(6))

    monkeypatch.setattr(rig_orientation, '_mean_and_scatter', mean_and_scatter)
    monkeypatch.setattr(rig_orientation, 'paired_exposures', lambda measured, b: [(0, 1)])
    fixed = Fake(
        measured=Fake(fluoroscopes=('a', 'b'), frames=[None, None]),
        covariance=np.eye(12),
        by_interior=np.zeros((12, 6)),
    )
    rig_orientation._relative_to_first(fixed, turning)
    assert told == [bool(turning)]
