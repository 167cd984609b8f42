# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The virtual rig is reproducible and has the documented geometry; its truth agrees with the
observations.
"""

import numpy as np
import pytest
import rigs

from fluoro_calib_ros.exposures.collector import Coverage
from fluoro_calib_ros.exposures.frame import points_on_image, validate_frame
from fluoro_calib_ros.photogrammetry.collinearity import project
from fluoro_calib_ros.photogrammetry.rotations import rotation_angle
from fluoro_calib_ros.simulation.rig import (
    BEADS,
    CUBE_MM,
    IMAGE_SIZE,
    START_NS,
    Detection,
    StreamStart,
    looking_at_origin,
    random_field,
    simulate_exposures,
    simulate_tracking,
    virtual_rig,
)

SEEDS = range(8)
GRID = np.stack(
    np.meshgrid(np.arange(-0.5, 1024, 32.0), np.arange(-0.5, 1024, 32.0)), axis=2
).reshape(-1, 2)


def same_frames(one, other):
    return all(
        np.array_equal(a.uv, b.uv)
        and np.array_equal(a.target_id, b.target_id)
        and (a.number, a.stamp_ns, a.frame_id) == (b.number, b.stamp_ns, b.frame_id)
        for name in one
        for a, b in zip(one[name], other[name], strict=True)
    )


def test_same_seed_gives_the_same_numbers():
    """They agree to the last bit; another seed gives another rig and other exposures."""
    one = virtual_rig(3)
    other = virtual_rig(3)
    third = virtual_rig(4)
    np.testing.assert_array_equal(one.true_mm, other.true_mm)
    np.testing.assert_array_equal(one.phantom.xyz_mm, other.phantom.xyz_mm)
    for a, b in zip(one.fluoroscopes, other.fluoroscopes):
        np.testing.assert_array_equal(
            np.r_[a.interior, a.position_mm, a.rotation.ravel(), a.distortion(GRID).ravel()],
            np.r_[b.interior, b.position_mm, b.rotation.ravel(), b.distortion(GRID).ravel()],
        )
    assert not np.array_equal(one.true_mm, third.true_mm)
    assert not np.array_equal(one.fluoroscopes[0].interior, third.fluoroscopes[0].interior)
    assert same_frames(
        simulate_exposures(one, 3, 7).frames, simulate_exposures(other, 3, 7).frames
    )
    assert not same_frames(
        simulate_exposures(one, 3, 7).frames, simulate_exposures(one, 3, 8).frames
    )
    assert same_frames(
        simulate_tracking(one, 0.1, seed=7).frames, simulate_tracking(other, 0.1, seed=7).frames
    )


@pytest.mark.parametrize('seed', SEEDS)
def test_the_sources_are_where_the_documentation_says(seed):
    """They are about 1.5 m from the middle, which they look at, and 2 m apart. The image is
    upright: v points down the z axis of the rig.
    """
    a, b = virtual_rig(seed).fluoroscopes
    assert (a.name, b.name) == ('a', 'b')
    for f in (a, b):
        assert np.linalg.norm(f.position_mm) == pytest.approx(1500, abs=60)
        np.testing.assert_allclose(f.ideal(np.zeros((1, 3)))[0], f.interior[:2], atol=80)
        up = f.ideal(np.array([[0, 0, 50.0]]))[0] - f.ideal(np.zeros((1, 3)))[0]
        assert up[1] < -100 and abs(up[0]) < 10
        np.testing.assert_allclose(f.rotation @ f.rotation.T, np.eye(3), atol=1e-14)
        assert np.linalg.det(f.rotation) == pytest.approx(1)
        np.testing.assert_allclose(f.interior, [511.5, 511.5, 4000], atol=151)
    assert np.linalg.norm(a.position_mm - b.position_mm) == pytest.approx(2000, abs=150)


def test_rigs_of_more_fluoroscopes():
    """The default is unchanged; with three, neighbouring axes differ by the given angle."""
    same = virtual_rig(3, between_deg=84.0).fluoroscopes
    for one, other in zip(virtual_rig(3).fluoroscopes, same):
        np.testing.assert_array_equal(one.rotation, other.rotation)
        np.testing.assert_array_equal(one.position_mm, other.position_mm)
    three = virtual_rig(3, names=('a', 'b', 'c'), between_deg=60.0)
    axes = np.array([f.rotation[2] for f in three.fluoroscopes])
    np.testing.assert_allclose(
        np.rad2deg(np.arccos((axes @ axes.T)[[0, 1, 0], [1, 2, 2]])), [60, 60, 120], atol=6
    )
    assert all(
        len(of_one[0].target_id) > 100 for of_one in simulate_exposures(three, 1).frames.values()
    )


def test_looking_at_the_origin_puts_it_on_the_axis():
    rotation = looking_at_origin(np.array([300.0, -900.0, 400.0]))
    there = rotation @ -np.array([300.0, -900.0, 400.0])
    np.testing.assert_allclose(there, [0, 0, np.linalg.norm([300, 900, 400])], atol=1e-10)
    assert rotation[1] @ [0, 0, 1] < 0 and np.linalg.det(rotation) == pytest.approx(1)


@pytest.mark.parametrize('seed', SEEDS)
def test_the_phantom_is_a_cube_of_503_beads_with_a_survey(seed):
    """Beads lie on its four side faces without duplicates; the survey has its deviation."""
    rig = virtual_rig(seed)
    assert rig.true_mm.shape == (BEADS, 3) == (503, 3)
    x, y, z = np.abs(rig.true_mm).T
    on_x = np.isclose(x, CUBE_MM / 2, atol=1e-5)
    on_y = np.isclose(y, CUBE_MM / 2, atol=1e-5)
    assert (on_x ^ on_y).all() and max(x.max(), y.max(), z.max()) <= CUBE_MM / 2 + 1e-5
    faces = [
        np.sum(on & (side * rig.true_mm[:, axis] > 0))
        for axis, on in ((0, on_x), (1, on_y))
        for side in (1, -1)
    ]
    assert sorted(faces) == [125, 126, 126, 126]
    gaps = np.linalg.norm(rig.true_mm[:, None] - rig.true_mm[None], axis=2) + 1000 * np.eye(503)
    assert gaps.min() > 10
    assert np.sqrt(np.mean((rig.phantom.xyz_mm - rig.true_mm) ** 2)) == pytest.approx(
        0.1, rel=0.08
    )
    assert (rig.phantom.sd_mm == 0.1).all()
    wide = virtual_rig(seed, survey_sd_mm=0.5)
    assert np.sqrt(np.mean((wide.phantom.xyz_mm - wide.true_mm) ** 2)) == pytest.approx(
        0.5, rel=0.08
    )
    np.testing.assert_array_equal(wide.true_mm, rig.true_mm)


@pytest.mark.parametrize('seed', range(20))
def test_distortion_is_large_at_the_edge_and_small_in_the_middle(seed):
    """14 to 17 px along the edge and 26 to 35 px in the corners; smooth, and proportional to its
    strength, down to none.
    """
    field = random_field(np.random.default_rng(seed))
    size = np.linalg.norm(field(GRID), axis=1)
    rim = np.abs(GRID - 511.5).max(axis=1) > 511
    assert 14 < size[rim].mean() < 17.5 and 26 < size.max() < 35.5
    assert (
        size[rim].max() == size.max()
        and size[np.linalg.norm(GRID - 511.5, axis=1) < 200].max() < 8
    )
    assert np.linalg.norm(field(GRID + [1, 0]) - field(GRID), axis=1).max() < 0.2
    np.testing.assert_allclose(
        random_field(np.random.default_rng(seed), 0.5)(GRID), field(GRID) / 2, rtol=1e-12
    )
    assert not random_field(np.random.default_rng(seed), 0.0)(GRID).any()


@pytest.mark.parametrize('seed', SEEDS)
def test_distort_is_the_inverse_of_the_correction(seed):
    """Undistorted = observed - correction(observed)."""
    field = random_field(np.random.default_rng(seed))
    observed = field.distort(GRID)
    np.testing.assert_allclose(observed - field(observed), GRID, rtol=0, atol=1e-9)
    assert field.distort(np.zeros((0, 2))).shape == (0, 2)


def test_number_and_size_of_the_exposures():
    rig = rigs.rig()
    simulated = simulate_exposures(rig, 20, 5)
    counts = np.array([len(f.target_id) for fs in simulated.frames.values() for f in fs])
    assert counts.min() >= 130 and counts.max() <= 160 and len(set(counts)) > 10
    for name, frames in simulated.frames.items():
        assert [f.number for f in frames] == list(range(1, 21))
        assert [f.stamp_ns for f in frames] == [START_NS + j * 500_000_000 for j in range(20)]
        for f in frames:
            validate_frame(f, rig.phantom, IMAGE_SIZE)
            assert f.fluoroscope == name and f.frame_id == f'{name}_optical' and f.sigma is None
            np.testing.assert_array_equal(f.uv, np.round(f.uv, 4))
    later = simulate_exposures(
        rig, 2, 5, Detection(beads=(20, 20)), StreamStart(99, 7), interval_s=0.25
    ).frames['b']
    assert [(f.number, f.stamp_ns, len(f.target_id)) for f in later] == [
        (7, 99, 20),
        (8, 99 + 250_000_000, 20),
    ]


def errors_of_image_points(rig, simulated):
    """Return observed minus true image points (N, 2), from the true rig and poses."""
    out = []
    for f in rig.fluoroscopes:
        for frame, (rotation, shift) in zip(simulated.frames[f.name], simulated.poses):
            points = rig.true_mm[rig.phantom.index(frame.target_id)] @ rotation.T + shift
            out.append(frame.uv - f.distortion.distort(f.ideal(points)))
    return np.concatenate(out)


def test_noise_and_false_matches_have_the_given_size():
    """A false match is at another bead nearby; all other errors are Gaussian noise."""
    rig = rigs.rig()
    for share, noise in ((0.01, 0.25), (0.2, 0.25), (0.0, 1.0)):
        error = errors_of_image_points(
            rig, simulate_exposures(rig, 10, 6, Detection(noise, share))
        )
        size = np.linalg.norm(error, axis=1)
        false = size > 6 * noise  # beads of opposite faces may coincide, even for false matches
        assert false.mean() == pytest.approx(share, abs=3 * np.sqrt(share / len(error)))
        assert np.sqrt(np.mean(error[~false] ** 2)) == pytest.approx(noise, rel=0.03)
        if share:
            assert 10 < np.median(size[false]) < 80 and size.max() < 300


def test_the_exterior_orientation_of_a_pose_gives_the_image_points():
    """exterior() is relative to the phantom, as in the result of an adjustment."""
    rig = rigs.rig()
    simulated = simulate_exposures(rig, 4, 6)
    for f in rig.fluoroscopes:
        for pose in simulated.poses:
            rotation, position = f.exterior(pose)
            n = len(rig.true_mm)
            direct = project(
                np.tile(rotation, (n, 1, 1)), np.tile(position, (n, 1)), rig.true_mm, f.interior
            )
            np.testing.assert_allclose(
                direct, f.ideal(rig.true_mm @ pose[0].T + pose[1]), atol=1e-8
            )


def test_undistorted_points_are_the_observed_ones_without_distortion():
    rig = rigs.rig()
    simulated = simulate_exposures(rig, 3, 6)
    for f in rig.fluoroscopes:
        for frame, undistorted in zip(simulated.frames[f.name], simulated.undistorted[f.name]):
            np.testing.assert_allclose(
                undistorted, frame.uv - f.distortion(frame.uv), rtol=0, atol=1e-12
            )


def test_the_image_is_covered_by_15_exposures():
    for frames in rigs.exposures().values():
        coverage = Coverage(IMAGE_SIZE)
        for f in frames:
            coverage.add(f.uv)
        assert coverage.fraction > 0.9


def test_the_poses_turn_the_phantom_all_round():
    poses = simulate_exposures(rigs.rig(), 15, 1).poses
    turns = [rotation_angle(r @ poses[0][0].T) for r, _ in poses]
    assert max(turns) > np.deg2rad(150)
    assert np.ptp([shift for _, shift in poses], axis=0).min() > 100


def test_tracking_shows_rigid_clusters_in_motion():
    """Four rigid clusters of six markers are visible throughout; their image points agree with
    their positions.
    """
    rig = rigs.rig()
    tracking = simulate_tracking(rig, 2.0, 60.0, seed=1)
    assert tracking.points_mm.shape == (120, 24, 3)
    for cluster in range(4):
        part = tracking.points_mm[:, 6 * cluster : 6 * cluster + 6]
        sides = np.linalg.norm(part[:, :, None] - part[:, None], axis=3)
        np.testing.assert_allclose(sides, np.broadcast_to(sides[0], sides.shape), atol=1e-9)
    assert np.ptp(tracking.points_mm, axis=0).max() > 50
    for f in rig.fluoroscopes:
        frames = tracking.frames[f.name]
        assert [frame.stamp_ns for frame in frames[:3]] == [
            START_NS + round(k / 60 * 1e9) for k in range(3)
        ]
        observed = np.array([frame.uv for frame in frames])
        assert points_on_image(observed.reshape(-1, 2), IMAGE_SIZE).all()
        for k in (0, 119):
            np.testing.assert_allclose(
                tracking.ideal[f.name][k], f.ideal(tracking.points_mm[k]), atol=1e-9
            )
        error = observed.reshape(-1, 2) - f.distortion.distort(
            tracking.ideal[f.name].reshape(-1, 2)
        )
        assert np.sqrt(np.mean(error**2)) == pytest.approx(0.25, rel=0.05)
        assert (frames[0].target_id == tracking.marker_id).all() and len(
            set(tracking.marker_id)
        ) == 24
    assert not set(tracking.marker_id) & set(rig.phantom.target_id)
