# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Findings on what a network cannot determine, and absence of false alarms."""

from dataclasses import replace

import numpy as np
import pytest
import rigs
from test_relative import dense, disturbed, rigid_network
from threadpoolctl import threadpool_limits

from fluoro_calib_ros.errors import DataError
from fluoro_calib_ros.estimation.calibrate import calibrate
from fluoro_calib_ros.estimation.initial_network import measured_network
from fluoro_calib_ros.estimation.options import CalibrationOptions
from fluoro_calib_ros.estimation.self_calibration import self_calibrate
from fluoro_calib_ros.exposures.frame import Frame
from fluoro_calib_ros.exposures.phantom import Phantom
from fluoro_calib_ros.findings import Kind, Place
from fluoro_calib_ros.photogrammetry.adjustment import adjust
from fluoro_calib_ros.photogrammetry.collinearity import project
from fluoro_calib_ros.photogrammetry.diagnosis import (
    describe_directions,
    high_correlations,
    reduced_normal_matrix,
    undetermined_directions,
    undetermined_interiors,
)
from fluoro_calib_ros.photogrammetry.noise import Noise
from fluoro_calib_ros.photogrammetry.outliers import adjust_and_estimate_noise
from fluoro_calib_ros.photogrammetry.precision import precision
from fluoro_calib_ros.photogrammetry.rotations import matrix_from_vector
from fluoro_calib_ros.simulation.rig import looking_at_origin, simulate_exposures, virtual_rig

SOURCE = np.array([0.0, -1500.0, 0.0])
INTERIOR = np.array([511.5, 511.5, 4000.0])


@pytest.fixture(autouse=True, scope='module')
def one_thread():
    with threadpool_limits(1):
        yield


def frames_of_poses(poses, points, noise_px=0.25, seed=0):
    """Frames and Phantom of points (n, 3) [mm] in poses (rotation, shift); y is the image axis."""
    rng = np.random.default_rng(seed)
    look = looking_at_origin(SOURCE)
    frames = []
    for j, (rotation, shift) in enumerate(poses):
        n = len(points)
        uv = project(
            np.tile(look, (n, 1, 1)),
            np.tile(SOURCE, (n, 1)),
            points @ rotation.T + shift,
            INTERIOR,
        )
        uv = uv + rng.normal(0, noise_px, uv.shape)
        keep = ((uv > 0) & (uv < 1023)).all(axis=1)
        frames.append(Frame('a', j + 1, np.flatnonzero(keep) + 1, uv[keep], (1024, 1024)))
    return frames, Phantom(np.arange(1, len(points) + 1), points, np.full(len(points), 0.1))


def beads(depth_mm, count=120, seed=1):
    """Beads in a slab of 200 mm whose thickness along the image axis is depth_mm."""
    return np.random.default_rng(seed).uniform(-1, 1, (count, 3)) * [100, depth_mm / 2, 100]


def moved_across(count=6):
    """Poses rotated about the image axis and shifted across it, but not tilted."""
    return [
        (matrix_from_vector([0, 0.9 * j, 0]), np.array([20.0 * (j % 3 - 1), 0, 15.0 * (j % 2)]))
        for j in range(count)
    ]


def tilted(count=6):
    """The same poses, tilted by half a radian in addition."""
    return [
        (matrix_from_vector([0.5 * np.cos(1.1 * j), 0, 0.5 * np.sin(1.1 * j)]) @ rotation, shift)
        for j, (rotation, shift) in enumerate(moved_across(count))
    ]


@pytest.mark.parametrize('seed', [1, 2, 3])
@pytest.mark.parametrize('count', [3, 5])
def test_no_false_alarm_on_the_virtual_rig(count, seed):
    rig = virtual_rig(seed)
    for name, frames in simulate_exposures(rig, count, seed).frames.items():
        fewer = [replace(f, target_id=f.target_id[::2], uv=f.uv[::2]) for f in frames]
        measured = measured_network({name: fewer}, rig.phantom)
        self_calibrate(measured, CalibrationOptions(model='none'))


def test_poses_parallel_to_the_image_do_not_separate_c_and_the_distance():
    frames, phantom = frames_of_poses(moved_across(), beads(8.0))
    with pytest.raises(
        DataError,
        match=r'fluoroscope a: principal distance and distance to the phantom cannot be sep.*'
        r'nearly in one plane.*tilted',
    ):
        calibrate(
            {'a': frames}, phantom, CalibrationOptions(model='none'), principal_distance=4000.0
        )


def test_tilted_poses_separate_c_and_the_distance():
    frames, phantom = frames_of_poses(tilted(), beads(8.0))
    job = calibrate(
        {'a': frames}, phantom, CalibrationOptions(model='none'), principal_distance=4000.0
    )
    assert job.fluoroscopes['a'].interior[2] == pytest.approx(
        4000, abs=5 * job.fluoroscopes['a'].interior_sd[2]
    )


def test_fixed_interior_orientation_needs_no_tilt():
    frames, phantom = frames_of_poses(moved_across(), beads(8.0))
    calibrate(
        {'a': frames},
        phantom,
        CalibrationOptions(model='none', interior='fixed'),
        principal_distance=4000.0,
    )


def test_beads_in_a_plane_are_calibrated_where_it_is_tilted():
    frames, phantom = frames_of_poses(tilted(), beads(0.01))
    found = calibrate({'a': frames}, phantom, CalibrationOptions(model='none'))
    figures = found.fluoroscopes['a']
    assert figures.interior[2] == pytest.approx(4000, abs=5 * figures.interior_sd[2])


def test_exposure_with_two_targets_is_reported():
    network, truth = rigs.small_network(exposures=4, targets=30, seen=1.0)
    keep = (network.exposure != 1) | (network.point < 2)
    network = replace(
        network,
        uv=network.uv[keep],
        sigma=network.sigma[keep],
        exposure=network.exposure[keep],
        point=network.point[keep],
    )
    found = undetermined_directions(network, truth, ('a',), [11, 12, 13, 14])
    assert len(found) == 2 and all(
        name.startswith('exposure 12 of a') for names in found for name in names
    )
    assert describe_directions(found) == 'the orientation of exposure 12 of a is undetermined'
    assert not undetermined_directions(
        rigs.small_network()[0], rigs.small_network()[1], ('a',), [1, 2, 3, 4]
    )


def test_datum_of_a_free_network_is_not_reported():
    network, truth = rigs.small_network(exposures=5, targets=30, seen=1.0)
    assert not undetermined_directions(replace(network, datum='inner'), truth, ('a',), range(5))


def test_reduced_normal_matrix_equals_the_dense_schur_complement():
    network, truth = rigid_network(4, 30)
    result = adjust(
        network,
        disturbed(truth),
        noise=Noise('gaussian', 1 / np.median(network.sigma)),
    )
    full = dense(network, result)[0]
    m, n = network.n_exposures, network.n_points
    points = np.arange(6 * m, 6 * m + 3 * n)
    rest = np.r_[0 : 6 * m, 6 * m + 3 * n : len(full)]
    schur = full[np.ix_(rest, rest)] - full[np.ix_(rest, points)] @ np.linalg.solve(
        full[np.ix_(points, points)], full[np.ix_(points, rest)]
    )
    turn = np.eye(len(rest))
    for j, rotation in enumerate(result.parameters.rotation):
        turn[6 * j : 6 * j + 3, 6 * j : 6 * j + 3] = rotation
    scale = np.sqrt(np.diagonal(schur))
    np.testing.assert_allclose(
        reduced_normal_matrix(network, result.parameters) / np.outer(scale, scale),
        turn @ schur @ turn.T / np.outer(scale, scale),
        atol=1e-5,
    )


def test_correlations_equal_the_dense_inverse():
    network, truth = rigid_network(5, 40)
    result = adjust_and_estimate_noise(network, disturbed(truth), noise=Noise('gaussian'))
    numbers = [1, 2, 3, 4, 5] * 2
    found = high_correlations(
        network, result.parameters, precision(network, result), ('a', 'b'), numbers
    )
    assert found and len(found) <= 20
    assert all(abs(v) > 0.95 for _, _, v in found)
    assert list(found) == sorted(found, key=lambda c: -abs(c[2]))
    covariance = np.linalg.inv(dense(network, result)[0])
    m, n = network.n_exposures, network.n_points
    turn = np.eye(len(covariance))
    for j, rotation in enumerate(result.parameters.rotation):
        turn[6 * j : 6 * j + 3, 6 * j : 6 * j + 3] = rotation
    covariance = turn @ covariance @ turn.T
    column = {
        f'{f}: {part}': 6 * m + 3 * n + 3 * i + k
        for i, f in enumerate('ab')
        for k, part in enumerate(('xp', 'yp', 'c'))
    }
    parts = ('X', 'Y', 'Z', 'rotation about x', 'rotation about y', 'rotation about z')
    column |= {
        f'relative orientation of a and b: {part}': len(covariance) - 6 + k
        for k, part in enumerate(parts)
    }
    column |= {
        f'exposure {numbers[j]} of {"ab"[network.fluoroscope[j]]}: {part}': 6 * j + k
        for j in range(m)
        for k, part in enumerate(parts)
    }
    for one, other, value in found:
        i = column[one]
        j = column[other]
        assert value == pytest.approx(
            covariance[i, j] / np.sqrt(covariance[i, i] * covariance[j, j]), abs=1e-5
        )


def test_undetermined_principal_point_is_reported():
    """Precision is judged at a noise of one pixel at most, whatever distortion adds."""
    network, truth = rigs.small_network()
    precise = precision(network, adjust_and_estimate_noise(network, truth))
    assert not undetermined_interiors(network, truth, precise, ('a',), 0.3)
    worse = replace(precise, interior=precise.interior + np.diag([300.0**2, 0, 0]))
    (found,) = undetermined_interiors(network, truth, worse, ('a',), 0.3)
    assert found.kind is Kind.INTERIOR_UNDETERMINED and found.place == Place(('a',))
    assert found.numbers['sd_point_px'] > 250
    assert not undetermined_interiors(network, truth, worse, ('a',), 5.0)
    assert not undetermined_interiors(
        replace(network, interior_free=np.array([False])), truth, worse, ('a',), 0.3
    )
