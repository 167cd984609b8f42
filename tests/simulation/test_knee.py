# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The virtual knee: its files agree with its motion, and its motion with that of people."""

import csv

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fluoro_calib_ros.bodies.body import BodyPoses
from fluoro_calib_ros.bodies.joints import joint_motion
from fluoro_calib_ros.cli import main
from fluoro_calib_ros.io.bags.reader import read_frames
from fluoro_calib_ros.io.bodies import read_bodies, read_joints
from fluoro_calib_ros.jobs.simulation import SimulationOptions
from fluoro_calib_ros.simulation.knee import (
    CYCLE_S,
    FALL_S,
    MOTIONS,
    _coupled,
    landing,
    simulate_knee,
    virtual_knee,
    walking,
)
from fluoro_calib_ros.simulation.rig import virtual_rig

GRAVITY = 9810.0  # acceleration of gravity [mm/s^2]


def markers_at(knee, motion):
    """Return the markers (T, 8, 3) [mm] of femur and tibia in the rig."""
    return np.concatenate(
        [
            np.einsum('tij,mj->tmi', motion.rotation[b.name], b.xyz_mm)
            + motion.position_mm[b.name][:, None]
            for b in knee.bodies
        ],
        axis=1,
    )


def exact_poses(body, rotation, position):
    count = len(rotation)
    zero = np.zeros((count, 6, 6))
    return BodyPoses(
        body,
        np.arange(1, count + 1),
        np.zeros(count, dtype=np.int64),
        rotation=rotation,
        position_mm=position,
        covariance_noise=zero,
        covariance_fixed=zero,
        rig_root=np.zeros((count, 6, 0)),
        markers=np.full(count, 4),
        status=np.zeros(count, np.uint8),
    )


def table(path, first):
    """Return the numeric columns of a CSV file by name, for rows whose first cell is `first`."""
    with path.open() as file:
        rows = list(csv.reader(file))
    values = np.array([row[1:] for row in rows[1:] if row[0] == first], dtype=float)
    return dict(zip(rows[0][1:], values.T))


@pytest.fixture(scope='module')
def folder(tmp_path_factory):
    """A data set written by the command."""
    path = tmp_path_factory.mktemp('knee') / 'rig'
    flags = ['--bodies', '--seconds', '0.4', '--rate', '100', '--exposures', '1', '--seed', '3']
    main(['simulate', '--out', str(path), *flags])
    return path


def test_without_the_flag_there_is_no_knee(tmp_path):
    assert SimulationOptions().bodies is False
    flags = ['--seconds', '0', '--exposures', '1']
    main(['simulate', '--out', str(tmp_path / 'rig'), *flags])
    assert not (tmp_path / 'rig' / 'bodies.csv').exists()


@pytest.mark.parametrize('name', MOTIONS)
def test_the_files_belong_together(folder, name):
    """Poses agree with joint and angles; image points with bodies, poses and the written rig."""
    bodies = read_bodies(folder / 'bodies.csv')
    true = read_bodies(folder / 'truth' / 'bodies.csv')
    (entry,) = read_joints(folder / 'joints.toml', bodies)
    poses = {}
    for body, exact in zip(bodies, true):
        assert body.name == exact.name and (body.sd_mm == 0.1).all()
        error = body.xyz_mm - exact.xyz_mm
        assert 0.02 < np.sqrt(np.mean(error**2)) < 0.25
        t = table(folder / 'truth' / f'{name}_poses.csv', body.name)
        rotation = Rotation.from_quat(np.column_stack([t[f'q{a}'] for a in 'xyzw'])).as_matrix()
        position = np.column_stack([t[f'{a}_mm'] for a in 'xyz'])
        poses[body.name] = exact_poses(body.name, rotation, position)
    motion = joint_motion(entry.joint, poses['femur'], poses['tibia'])
    t = table(folder / 'truth' / f'{name}_joints.csv', 'knee')
    angles = np.column_stack([t[f'angle_{n}_deg'] for n in (1, 2, 3)])
    shifts = np.column_stack([t[f'translation_{n}_mm'] for n in (1, 2, 3)])
    np.testing.assert_allclose(np.rad2deg(motion.angles), angles, atol=1e-6)
    np.testing.assert_allclose(motion.translations, shifts, atol=1e-6)

    frames = read_frames(folder / name).frames
    rig = virtual_rig(3)
    errors = []
    for fluoroscope in rig.fluoroscopes:
        of_one = frames[fluoroscope.name]
        assert [frame.number for frame in of_one] == t['exposure'].astype(int).tolist()
        seconds = [(frame.stamp_ns - of_one[0].stamp_ns) / 1e9 for frame in of_one]
        np.testing.assert_allclose(seconds, t['time_s'], atol=1e-8)
        for index, frame in enumerate(of_one):
            for body in true:
                rows = np.isin(body.target_id, frame.target_id)
                points = body.xyz_mm[rows] @ poses[body.name].rotation[index].T
                uv = fluoroscope.distortion.distort(
                    fluoroscope.ideal(points + poses[body.name].position_mm[index])
                )
                mine = np.isin(frame.target_id, body.target_id)
                errors.append(frame.uv[mine] - uv)
    assert np.sqrt(np.mean(np.concatenate(errors) ** 2)) == pytest.approx(0.25, rel=0.06)


def test_walking_is_that_of_people():
    """Flexion at initial contact, in stance and in swing agrees with Schwartz et al. (2008)."""
    knee = virtual_knee(1)
    cycle = np.array([0, 0.12, 0.42, 0.6, 0.72, 0.96])
    flexion = np.rad2deg(walking(knee, cycle * CYCLE_S).angles[:, 0])
    np.testing.assert_allclose(flexion, [5.5, 19.7, 6.7, 34.1, 60.5, 4.5], atol=0.5)
    motion = walking(knee, np.array([0.3, 0.3 + CYCLE_S]))
    np.testing.assert_allclose(*markers_at(knee, motion), atol=1e-9)
    assert np.abs(np.rad2deg(motion.angles[:, 1:])).max() < 10


def test_landing_has_an_impact():
    """After free fall, tens of g act for a few milliseconds, but the velocity does not jump."""
    knee = virtual_knee(1)
    step = 1e-4
    times = np.arange(0, 0.4, step)
    points = markers_at(knee, landing(knee, times))
    velocity = np.diff(points, axis=0) / step
    acceleration = np.linalg.norm(np.diff(velocity, axis=0), axis=2) / step / GRAVITY
    middle = times[1:-1]
    np.testing.assert_allclose(acceleration[middle < FALL_S - 2 * step], 1, atol=0.01)
    contact = (middle > FALL_S) & (middle < FALL_S + 0.005)
    assert (acceleration[contact].max(axis=0) > 20).all()
    assert acceleration[middle > FALL_S + 0.03].max() < 5
    assert np.linalg.norm(np.diff(velocity, axis=0), axis=2).max() < 30  # mm/s in a step
    assert np.linalg.norm(velocity[-1], axis=1).max() < 100


@pytest.mark.parametrize('name', MOTIONS)
def test_the_markers_are_seen(name):
    """Both fluoroscopes see nearly all markers; the same seed gives the same recording."""
    rig = virtual_rig(2)
    knee = virtual_knee(2)
    motion = MOTIONS[name](knee, np.arange(0, 0.4, 0.01))
    one = simulate_knee(rig, knee, motion, seed=5)
    same = simulate_knee(rig, knee, motion, seed=5)
    for fluoroscope, frames in one.frames.items():
        assert np.mean([len(frame.target_id) for frame in frames]) > 7.5
        for frame, other in zip(frames, same.frames[fluoroscope]):
            np.testing.assert_array_equal(frame.uv, other.uv)
    ids = np.concatenate([body.target_id for body in knee.bodies])
    assert len(set(ids.tolist())) == 8 and ids.min() > 2000


def test_what_goes_with_flexion_is_a_few_degrees_and_millimetres():
    """Between an extended knee and one bent by 90 degrees, the drawer moves back by 6 mm."""
    angles, translations = _coupled(np.deg2rad([0.0, 90.0]), np.zeros(2))
    assert np.rad2deg(angles[:, 0]) == pytest.approx([0.0, 90.0])
    assert angles[1, 1:] - angles[0, 1:] == pytest.approx([-0.04, 0.1])
    assert translations == pytest.approx(np.array([[1.0, 4.0, 3.0], [2.5, -2.0, 5.0]]))
