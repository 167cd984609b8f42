# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Flat targets: grids and boards in tilted views, on the image intensifier, and with a phantom."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
import rigs
from rigs import kinds, refused

from benchmarks.targets import (
    both,
    facing,
    grid_frames,
    grid_points,
    grid_survey,
    points_rmse,
    small_cube,
    without_distortion,
)
from fluoro_calib_ros.checks.inputs import find_wrong_input
from fluoro_calib_ros.estimation.calibrate import calibrate
from fluoro_calib_ros.estimation.options import CalibrationOptions, CalibrationRequest
from fluoro_calib_ros.exposures.phantom import Phantom
from fluoro_calib_ros.findings import Kind, Place
from fluoro_calib_ros.io.calibration import load_calibrations
from fluoro_calib_ros.io.observations import write_observations_csv
from fluoro_calib_ros.io.phantom import write_phantom
from fluoro_calib_ros.jobs.calibration import run_calibration
from fluoro_calib_ros.photogrammetry.collinearity import project
from fluoro_calib_ros.photogrammetry.plane_resection import (
    mirrored_pose,
    plane_of,
    poses_of_homography,
    principal_distance_of_planes,
)
from fluoro_calib_ros.photogrammetry.resection import robust_dlt
from fluoro_calib_ros.photogrammetry.rotations import rotation_angle
from fluoro_calib_ros.simulation.rig import Detection, simulate_exposures

POINTS = grid_points(12, 12, 23.0)
SURVEY = grid_survey(POINTS)
PLAIN = CalibrationOptions(model='none')


def fluoroscope():
    return rigs.rig().fluoroscopes[0]


def poses(tilts, seed=1, shift_mm=60.0):
    rng = np.random.default_rng(seed)
    return [facing(fluoroscope(), rng, tilt, 0.0, shift_mm) for tilt in tilts]


def exposures(tilts, seed=1, shift_mm=60.0, points=POINTS):
    return grid_frames(fluoroscope(), points, poses(tilts, seed, shift_mm), seed)


def ideal(pose, interior):
    """Image points of the grid in a pose, without distortion."""
    rotation, source = fluoroscope().exterior(pose)
    n = len(POINTS)
    return project(
        np.broadcast_to(rotation, (n, 3, 3)), np.broadcast_to(source, (n, 3)), POINTS, interior
    )


def test_homographies_give_pose_and_principal_distance():
    """Exact image points with 40 % false matches. The mirrored pose is its own inverse."""
    interior = np.array([500.0, 520.0, 3900.0])
    plane = plane_of(POINTS)
    found = []
    rng = np.random.default_rng(3)
    for pose in poses([10, 25, 40]):
        uv = ideal(pose, interior)
        wrong = rng.permutation(len(uv))[: int(0.4 * len(uv))]
        uv[wrong] += rng.uniform(-300, 300, (len(wrong), 2))
        found.append(robust_dlt(plane.coordinates(POINTS), uv))
        rotation, source = fluoroscope().exterior(pose)
        candidates = poses_of_homography(found[-1], plane, interior)
        assert rotation_angle(candidates[0][0] @ rotation.T) < 1e-6
        np.testing.assert_allclose(candidates[0][1], source, atol=1e-3)
        back = mirrored_pose(*candidates[1], plane)
        assert rotation_angle(back[0] @ rotation.T) < 1e-6
        assert rotation_angle(candidates[1][0] @ rotation.T) > np.deg2rad(15)
    assert principal_distance_of_planes(found, interior[:2]) == pytest.approx(3900, rel=1e-6)
    flat = [robust_dlt(plane.coordinates(POINTS), ideal(p, interior)) for p in poses([0])]
    assert principal_distance_of_planes(flat, interior[:2]) is None


def test_the_adjustment_of_a_board_is_that_of_opencv():
    """Least squares without distortion, exact board: the interior orientations are the same."""
    interior = np.array([500.0, 520.0, 3900.0])
    rng = np.random.default_rng(5)
    tilts = [15, 30, 35, 25, 40, 20]
    frames = exposures(tilts, shift_mm=20.0)
    exact = Phantom(SURVEY.target_id, POINTS, np.full(len(POINTS), 1e-6))
    noisy = []
    for frame, pose in zip(frames, poses(tilts, shift_mm=20.0)):
        uv = ideal(pose, interior) + rng.normal(0, 0.25, (len(POINTS), 2))
        noisy.append(replace(frame, target_id=SURVEY.target_id, uv=uv))
    options = CalibrationOptions(model='none', loss='gaussian')
    ours = calibrate({'a': noisy}, exact, options).fluoroscopes['a'].interior
    flags = cv2.CALIB_FIX_ASPECT_RATIO | cv2.CALIB_ZERO_TANGENT_DIST
    flags |= cv2.CALIB_FIX_K1 | cv2.CALIB_FIX_K2 | cv2.CALIB_FIX_K3
    start = np.array([[3900.0, 0, 511.5], [0, 3900.0, 511.5], [0, 0, 1]])
    _, k, *_ = cv2.calibrateCamera(
        [POINTS.astype(np.float32)] * len(noisy),
        [f.uv.astype(np.float32) for f in noisy],
        (1024, 1024),
        start,
        None,
        flags=flags | cv2.CALIB_USE_INTRINSIC_GUESS,
    )
    np.testing.assert_allclose(ours, [k[0, 2], k[1, 2], k[0, 0]], rtol=0, atol=0.05)


@pytest.mark.long
def test_a_tilted_grid_calibrates_nearly_as_well_as_known_distortion_allows():
    frames = exposures([12, 18, 24, 30, 36, 27])
    found = calibrate({'a': frames}, SURVEY).calibrations['a']
    undistorted = without_distortion(frames, fluoroscope())
    known = calibrate({'a': undistorted}, SURVEY, PLAIN).calibrations['a']
    test = simulate_exposures(rigs.rig(), 6, 51, Detection(false_matches=0.0)).frames['a']
    ours = points_rmse(rigs.rig(), test, found.interior, found.model.predict)
    best = points_rmse(
        rigs.rig(), without_distortion(test, fluoroscope()), known.interior, np.zeros_like
    )
    assert ours < 1.11 * best


def test_a_grid_parallel_to_the_image_needs_the_principal_distance():
    """Without it there is one finding; with it, a single exposure yields the distortion."""
    frames = exposures([0.0, 0.0, 0.0, 0.0], shift_mm=20.0)
    with refused(Kind.UNTILTED_TARGETS) as error:
        run_calibration(CalibrationRequest({'a': frames}, SURVEY))
    assert error.value.finding.place == Place(('a',))
    c = float(fluoroscope().interior[2])
    request = CalibrationRequest({'a': frames[:1]}, SURVEY, principal_distance=c)
    calibration = run_calibration(request).result.calibrations['a']
    assert not calibration.interior_estimated
    assert calibration.interior[2] == c
    inside = frames[1].uv[~calibration.model.outside(frames[1].uv)]
    error = calibration.model.predict(inside) - fluoroscope().distortion(inside)
    # A homography absorbs what the exposures cannot show: shift, scale, rotation and tilt.
    corrected = inside + error
    h = robust_dlt(inside, corrected)
    mapped = np.column_stack([inside, np.ones(len(inside))]) @ h.T
    left = mapped[:, :2] / mapped[:, 2:] - corrected
    assert np.sqrt(np.mean(left**2)) < 0.25
    assert np.sqrt(np.mean(fluoroscope().distortion(inside) ** 2)) > 1.5


def test_a_grid_that_is_not_in_plane_with_its_survey_is_refused():
    frames = exposures([20, 25, 30, 35])
    other = Phantom(SURVEY.target_id, np.random.default_rng(1).permutation(POINTS), SURVEY.sd_mm)
    assert kinds(find_wrong_input({'a': frames}, other)) == [Kind.OTHER_PHANTOM]
    assert find_wrong_input({'a': frames}, SURVEY) == []


@pytest.mark.long
def test_a_grid_completes_a_cube_that_leaves_the_rim_uncovered():
    cube = small_cube(rigs.rig(), 1, 6)
    large = 1.4 * POINTS
    grid = exposures([0.0, 0.0], shift_mm=20.0, points=large)
    grid = [replace(f, number=f.number + 100) for f in grid]
    both_targets = both(cube.phantom, grid_survey(large))
    found = calibrate({'a': cube.frames + grid}, both_targets).calibrations['a']
    alone = calibrate({'a': cube.frames}, both_targets).calibrations['a']
    pixels = np.stack(np.meshgrid(*[np.arange(0.0, 1024, 16)] * 2), axis=2).reshape(-1, 2)
    covered = [np.mean(~one.model.outside(pixels)) for one in (alone, found)]
    assert covered[0] < 0.6 < 0.8 < covered[1]
    new = pixels[alone.model.outside(pixels) & ~found.model.outside(pixels)]
    assert found.model.evaluate(new).sd.mean() < 0.5 * alone.model.evaluate(new).sd.mean()


def test_the_command_calibrates_a_grid(tmp_path):
    write_observations_csv(tmp_path / 'grid.csv', {'a': exposures([15, 30, 35, 25])})
    write_phantom(tmp_path / 'phantom.csv', SURVEY)
    arguments = ('calibrate', tmp_path / 'grid.csv', '--image-size', '1024x1024', '--phantom')
    arguments += (
        tmp_path / 'phantom.csv',
        '--model',
        'none',
        '--out',
        tmp_path / 'result',
        '--fast',
    )
    assert rigs.run(*arguments) == 0
    assert load_calibrations(tmp_path / 'result')['a'].exposures == 4
