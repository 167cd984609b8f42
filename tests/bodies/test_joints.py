# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Joint angles against SciPy and the printed formulas, their covariance against Monte Carlo."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fluoro_calib_ros.bodies.anatomical_frames import (
    CONVENTIONS,
    LANDMARK_FRAMES,
    AnatomicalFrame,
    convention,
    frame_of_axes,
    frame_of_landmarks,
    frame_of_quaternion,
)
from fluoro_calib_ros.bodies.body import BodyPoses, PoseStatus
from fluoro_calib_ros.bodies.joints import (
    Joint,
    JointStatus,
    angle_errors,
    check_joints,
    joint_motion,
    main_rotation,
    with_neutral,
)
from fluoro_calib_ros.errors import DataError
from fluoro_calib_ros.jobs.bodies import _bends_elsewhere

CLINICAL = [name for name in CONVENTIONS if not name.startswith(('cardan', 'euler'))]
JCS = [name for name in CLINICAL if CONVENTIONS[name].along_axes]


def poses(body, rotation, position=None, noise=None, fixed=None, root=None, status=None):
    """BodyPoses of rotations (T, 3, 3) and positions (T, 3), by default without errors."""
    rotation = np.atleast_3d(np.asarray(rotation, dtype=float)).reshape(-1, 3, 3)
    count = len(rotation)
    zero = np.zeros((count, 6, 6))
    return BodyPoses(
        body,
        np.arange(1, count + 1),
        np.arange(count) * 4_000_000,
        rotation=rotation,
        position_mm=np.zeros((count, 3)) if position is None else np.asarray(position),
        covariance_noise=zero if noise is None else np.broadcast_to(noise, zero.shape),
        covariance_fixed=zero if fixed is None else np.broadcast_to(fixed, zero.shape),
        rig_root=np.zeros((count, 6, 3)) if root is None else root,
        markers=np.full(count, 4),
        status=np.zeros(count, np.uint8) if status is None else np.asarray(status, np.uint8),
    )


def random_poses(rng, body, count, **errors):
    return poses(
        body, Rotation.random(count, rng).as_matrix(), rng.normal(0, 50, (count, 3)), **errors
    )


def random_covariance(rng, scale=1.0):
    """Covariance (6, 6) of a pose with correlations, about 0.2 mm and 0.005 rad."""
    root = rng.normal(size=(6, 6)) * np.r_[[0.1] * 3, [2e-3] * 3][:, None] * scale
    return root @ root.T


def random_frame(rng):
    return AnatomicalFrame(Rotation.random(random_state=rng).as_matrix(), rng.normal(0, 30, 3))


def turn(axis, degrees):
    return Rotation.from_euler(axis, degrees, degrees=True).as_matrix()


@pytest.mark.parametrize('name', [n for n in CONVENTIONS if n not in CLINICAL])
def test_cardan_and_euler_angles_are_those_of_scipy(name):
    """All 12 sequences, for the rotation distal -> proximal; translations along proximal axes."""
    rng = np.random.default_rng(1)
    joint = Joint('j', 'p', 'd', name, random_frame(rng), random_frame(rng))
    p, d = random_poses(rng, 'p', 50), random_poses(rng, 'd', 50)
    motion = joint_motion(joint, p, d, before=np.zeros(3))
    axes_p = p.rotation @ joint.proximal_frame.rotation
    axes_d = d.rotation @ joint.distal_frame.rotation
    expected = Rotation.from_matrix(np.swapaxes(axes_p, 1, 2) @ axes_d).as_euler(name[-3:].upper())
    difference = motion.angles - expected
    np.testing.assert_allclose(np.sin(difference), 0, atol=1e-9)
    np.testing.assert_allclose(np.cos(difference), 1, atol=1e-9)
    origins = [
        x.position_mm + x.rotation @ f.origin_mm
        for x, f in ((p, joint.proximal_frame), (d, joint.distal_frame))
    ]
    between = (np.swapaxes(axes_p, 1, 2) @ (origins[1] - origins[0])[..., None])[..., 0]
    np.testing.assert_allclose(motion.translations, between, atol=1e-9)
    assert (motion.status == JointStatus.OK).all()


def grood_suntay(femur, tibia, between, side):
    """Angles [rad] and translations by the vectors of Grood and Suntay (1983), one exposure.

    femur, tibia: axes in the columns; between: from the femoral to the tibial origin.
    """
    e1, e3 = femur[:, 0], tibia[:, 2]
    e2 = np.cross(e3, e1)
    e2 /= np.linalg.norm(e2)
    right = 1 if side == 'right' else -1
    flexion = np.arctan2(-e2 @ femur[:, 2], e2 @ femur[:, 1])
    adduction = right * (np.pi / 2 - np.arccos(e1 @ e3))
    external = np.arctan2(-right * (e2 @ tibia[:, 0]), e2 @ tibia[:, 1])
    return (
        [flexion, adduction, -external],
        [right * (between @ e1), between @ e2, -between @ e3],
    )


@pytest.mark.parametrize('side', ['left', 'right'])
def test_knee_angles_are_those_of_grood_and_suntay(side):
    rng = np.random.default_rng(2)
    joint = Joint(
        'knee', 'p', 'd', 'grood_suntay_knee', random_frame(rng), random_frame(rng), side
    )
    p, d = random_poses(rng, 'p', 40), random_poses(rng, 'd', 40)
    motion = joint_motion(joint, p, d)
    for t in range(40):
        axes = [
            x.rotation[t] @ f.rotation
            for x, f in ((p, joint.proximal_frame), (d, joint.distal_frame))
        ]
        between = (
            d.position_mm[t]
            + d.rotation[t] @ joint.distal_frame.origin_mm
            - p.position_mm[t]
            - p.rotation[t] @ joint.proximal_frame.origin_mm
        )
        angles, shifts = grood_suntay(*axes, between, side)
        difference = motion.angles[t] - angles
        np.testing.assert_allclose(np.exp(1j * difference), 1, atol=1e-9)
        np.testing.assert_allclose(motion.translations[t], shifts, atol=1e-9)


def alone(name, rotation, side='right', position=(0.0, 0, 0)):
    """Angles [deg] and translations by name, of the distal frame turned against the proximal."""
    joint = Joint('j', 'p', 'd', name, side=side)
    motion = joint_motion(joint, poses('p', np.eye(3)), poses('d', rotation, [position]))
    return dict(
        zip(
            (*motion.angle_names, *motion.translation_names),
            (*np.rad2deg(motion.angles[0]), *motion.translations[0]),
        )
    )


def test_clinical_signs_of_a_right_knee():
    """Check where the distal end, front or origin of the tibia moves. x points to the right."""
    assert alone('grood_suntay_knee', turn('x', -30))['flexion'] == pytest.approx(30)
    # The heel moves back: the distal end (-z) gets a negative y.
    assert (turn('x', -30) @ [0, 0, -1])[1] < 0
    assert alone('grood_suntay_knee', turn('y', 5))['adduction'] == pytest.approx(5)
    assert (turn('y', 5) @ [0, 0, -1])[0] < 0  # to the left, which is medial
    assert alone('grood_suntay_knee', turn('z', 7))['internal_rotation'] == pytest.approx(7)
    assert (turn('z', 7) @ [0, 1, 0])[0] < 0  # the toes point to the left
    moved = alone('grood_suntay_knee', np.eye(3), position=(1, 2, -3))
    assert (moved['lateral_shift'], moved['anterior_drawer'], moved['distraction']) == (1, 2, 3)


def test_clinical_signs_of_isb():
    """Axes of a right limb: x anterior, y proximal, z right."""
    down = np.array([0, -1, 0])
    cases = [
        ('isb_hip', turn('z', 20), 'flexion', 0, 1),  # the knee goes forward
        ('isb_hip', turn('x', 20), 'adduction', 2, -1),  # to the left
        ('isb_elbow', turn('z', 20), 'flexion', 0, 1),
        ('isb_elbow', turn('x', 20), 'adduction', 2, -1),
        ('isb_wrist', turn('z', 20), 'flexion', 0, 1),  # x is volar
        ('isb_wrist', turn('x', 20), 'ulnar_deviation', 2, -1),
    ]
    for name, rotation, angle, axis, sign in cases:
        assert alone(name, rotation)[angle] == pytest.approx(20)
        assert sign * (rotation @ down)[axis] > 0
    for name in ('isb_hip', 'isb_ankle'):
        assert alone(name, turn('y', 20))['internal_rotation'] == pytest.approx(20)
    assert (turn('y', 20) @ [1, 0, 0])[2] < 0  # the front turns to the left
    assert alone('isb_ankle', turn('z', 10))['dorsiflexion'] == pytest.approx(10)
    assert (turn('z', 10) @ [1, 0, 0])[1] > 0  # toes up
    assert alone('isb_ankle', turn('x', 10))['inversion'] == pytest.approx(10)
    assert (turn('x', 10) @ down)[2] < 0  # the sole faces to the left
    assert alone('isb_elbow', turn('y', 60))['pronation'] == pytest.approx(60)
    for name in ('isb_thoracohumeral', 'isb_glenohumeral'):
        abducted = turn('x', -40)
        assert (abducted @ down)[2] > 0  # the elbow goes to the right
        angles = alone(name, abducted)
        assert angles['elevation'] == pytest.approx(40)
        assert angles['plane_of_elevation'] == pytest.approx(0, abs=1e-9)
        flexed = turn('y', 90) @ abducted
        assert (flexed @ down)[0] > 0.6  # forward
        angles = alone(name, flexed @ turn('y', 15))
        assert angles['plane_of_elevation'] == pytest.approx(90)
        assert angles['elevation'] == pytest.approx(40)
        assert angles['internal_rotation'] == pytest.approx(15)


@pytest.mark.parametrize('name', CLINICAL)
def test_a_left_limb_is_a_mirrored_right_one(name):
    """Angles, translations and standard deviations equal those of the mirror image."""
    rng = np.random.default_rng(3)
    of = convention(name)
    mirror = of.mirror('left')
    axial = np.kron(np.eye(2), mirror) * np.r_[[1.0] * 3, [-1.0] * 3][:, None]
    frames = [random_frame(rng) for _ in range(2)]
    covariance = [random_covariance(rng) for _ in range(3)]
    root = rng.normal(0, 1e-2, (30, 6, 3))
    p = random_poses(rng, 'p', 30, noise=covariance[0], fixed=covariance[1], root=root)
    d = random_poses(rng, 'd', 30, noise=covariance[2], root=root)
    right = joint_motion(Joint('j', 'p', 'd', name, *frames, 'right'), p, d)

    def mirrored(x):
        return dataclasses.replace(
            x,
            rotation=mirror @ x.rotation @ mirror,
            position_mm=x.position_mm @ mirror,
            covariance_noise=axial @ x.covariance_noise @ axial.T,
            covariance_fixed=axial @ x.covariance_fixed @ axial.T,
            rig_root=axial @ x.rig_root,
        )

    flipped = [AnatomicalFrame(mirror @ f.rotation @ mirror, mirror @ f.origin_mm) for f in frames]
    left = joint_motion(Joint('j', 'p', 'd', name, *flipped, 'left'), mirrored(p), mirrored(d))
    np.testing.assert_allclose(left.angles, right.angles, atol=1e-9)
    np.testing.assert_allclose(left.translations, right.translations, atol=1e-9)
    np.testing.assert_allclose(left.covariance, right.covariance, atol=1e-9)


def perturbed(x, error):
    """Poses displaced by errors (T, 6) in the convention of BodyPoses."""
    return dataclasses.replace(
        x,
        rotation=Rotation.from_rotvec(error[:, 3:]).as_matrix() @ x.rotation,
        position_mm=x.position_mm + error[:, :3],
    )


def vector(motion):
    return np.concatenate([motion.angles, motion.translations], axis=1)


@pytest.mark.parametrize('side', ['left', 'right'])
@pytest.mark.parametrize('name', ['cardan_zyx', 'euler_yzy', *CLINICAL])
def test_covariance_is_that_of_finite_differences(name, side):
    """Full covariances of both poses, with the common unknowns of the rig stacked."""
    rng = np.random.default_rng(4)
    joint = Joint('j', 'p', 'd', name, random_frame(rng), random_frame(rng), side)
    own = [1e-4 * random_covariance(rng) for _ in range(4)]
    root = 1e-4 * rng.normal(size=(20, 6, 5))
    other_root = root + 1e-5 * rng.normal(size=(20, 6, 5))
    p = random_poses(rng, 'p', 20, noise=own[0], fixed=own[1], root=root)
    d = random_poses(rng, 'd', 20, noise=own[2], fixed=own[3], root=other_root)
    motion = joint_motion(joint, p, d)
    step = 1e-6
    columns = []
    for which in range(2):
        for k in range(6):
            ends = []
            for sign in (1, -1):
                error = np.zeros((20, 6))
                error[:, k] = sign * step
                moved = joint_motion(
                    joint,
                    perturbed(p, error) if which == 0 else p,
                    perturbed(d, error) if which == 1 else d,
                    before=motion.angles[0],
                )
                ends.append(vector(moved))
            difference = ends[0] - ends[1]
            difference[:, :3] -= 2 * np.pi * np.round(difference[:, :3] / (2 * np.pi))
            columns.append(difference / (2 * step))
    jacobian = np.stack(columns, axis=-1)
    by_p, by_d = jacobian[..., :6], jacobian[..., 6:]
    of_rig = by_p @ root + by_d @ other_root
    expected = (
        by_p @ (own[0] + own[1]) @ np.swapaxes(by_p, 1, 2)
        + by_d @ (own[2] + own[3]) @ np.swapaxes(by_d, 1, 2)
        + of_rig @ np.swapaxes(of_rig, 1, 2)
    )
    assert (motion.status == JointStatus.OK).all()
    scale = np.sqrt(np.einsum('tii,tjj->tij', expected, expected))
    np.testing.assert_allclose(motion.covariance / scale, expected / scale, atol=1e-6)


def test_errors_of_the_rig_cancel():
    """Rotating the whole rig rotates both bodies and changes no angle and no translation."""
    rng = np.random.default_rng(5)
    p, d = random_poses(rng, 'p', 10), random_poses(rng, 'd', 10)

    def with_root(x):
        root = np.zeros((10, 6, 3))
        root[:, :3] = 0.01 * np.array([np.cross(np.eye(3), t).T for t in x.position_mm])
        root[:, 3:] = 0.01 * np.eye(3)
        return dataclasses.replace(x, rig_root=root)

    joint = Joint('j', 'p', 'd', 'grood_suntay_knee', side='right')
    common = joint_motion(joint, with_root(p), with_root(d))
    np.testing.assert_allclose(common.sd, 0, atol=1e-7)
    one = joint_motion(joint, with_root(p), d)
    assert one.sd[:, :3].min() > 1e-3


def near_lock(name, sd_deg, distance_deg):
    """Error (T, 6), covariance and status of a joint measured near gimbal lock."""
    rng = np.random.default_rng(6)
    of = convention(name)
    distance = np.deg2rad(distance_deg(rng))
    count = len(distance)
    second = distance if of.is_euler else np.pi / 2 - distance
    angles = np.column_stack(
        [rng.uniform(-3, 3, count), of.branch * second, rng.uniform(-3, 3, count)]
    )
    mixed = rng.normal(size=(6, 12))
    sd = np.r_[[0.05] * 3, [np.deg2rad(sd_deg)] * 3] * rng.uniform(0.7, 1.3, 6)
    covariance = np.corrcoef(mixed) * np.outer(sd, sd)
    joint = Joint('j', 'p', 'd', name, side='right')
    p = poses('p', np.broadcast_to(np.eye(3), (count, 3, 3)))
    d = poses(
        'd',
        Rotation.from_euler(of.sequence.upper(), angles).as_matrix(),
        rng.normal(0, 10, (count, 3)),
    )
    truth = joint_motion(joint, p, d)
    noisy = perturbed(d, rng.multivariate_normal(np.zeros(6), covariance, count))
    noise = np.broadcast_to(covariance, (count, 6, 6))
    measured = joint_motion(joint, p, dataclasses.replace(noisy, covariance_noise=noise))
    error = vector(measured) - vector(truth)
    signs = np.array(of.angle_signs)
    error[:, :3] = signs * angle_errors(of, measured.angles * signs, truth.angles * signs)
    return error, measured.covariance, measured.status


def nse(error, covariance):
    return np.sum(error * np.linalg.solve(covariance, error[..., None])[..., 0], axis=1) / 6


@pytest.mark.parametrize('sd_deg', [0.05, 0.3])
@pytest.mark.parametrize('name', ['grood_suntay_knee', 'isb_glenohumeral'])
def test_standard_deviations_near_gimbal_lock(name, sd_deg):
    """NSE of angles and translations within 20 degrees of lock; only the nearest are flagged."""
    distance = np.random.default_rng(7).uniform(0, 20, 3000)
    error, covariance, status = near_lock(name, sd_deg, lambda rng: distance)
    assert 0.95 < nse(error, covariance).mean() < 1.06
    for low, high in ((2, 5), (5, 10), (10, 20)):
        band = (distance >= low) & (distance < high)
        assert 0.9 < nse(error, covariance)[band].mean() < 1.1
    gimbal = status == JointStatus.GIMBAL
    assert gimbal[distance < 2 * sd_deg].all()
    assert not gimbal[distance > 12 * sd_deg].any()


@pytest.mark.parametrize('name', ['grood_suntay_knee', 'isb_glenohumeral'])
def test_standard_deviations_in_gimbal_lock(name):
    """Rotations uniform within three sd of lock, where a linear covariance fails."""
    error, covariance, status = near_lock(
        name, 1.0, lambda rng: 3 * np.sqrt(rng.uniform(0, 1, 600))
    )
    assert (status == JointStatus.GIMBAL).mean() > 0.97  # noise moves some beyond five sd
    assert 0.85 < nse(error, covariance).mean() < 1.3
    sd_of_a_turn = np.pi / np.sqrt(3)  # sd of an angle that may have any value
    assert np.sqrt(covariance[:, 0, 0]).max() < 1.1 * sd_of_a_turn


def test_angles_count_full_turns():
    """Also across exposures without a pose, and across noise in gimbal lock."""
    steps = np.deg2rad(np.arange(0, 900, 20))
    rotation = Rotation.from_euler('z', steps[:, None]).as_matrix()
    rotation[10:14] = np.nan
    joint = Joint('j', 'p', 'd', 'cardan_zxy')
    p = poses('p', np.broadcast_to(np.eye(3), rotation.shape))
    motion = joint_motion(joint, p, poses('d', rotation))
    known = np.isfinite(motion.angles[:, 0])
    assert (np.flatnonzero(~known) == np.arange(10, 14)).all()
    assert (motion.status[~known] == JointStatus.FAILED).all()
    np.testing.assert_allclose(motion.angles[known, 0], steps[known], atol=1e-9)
    later = joint_motion(joint, p, poses('d', rotation), before=np.array([4 * np.pi + 0.1, 0, 0]))
    np.testing.assert_allclose(later.angles[known, 0], steps[known] + 4 * np.pi, atol=1e-9)

    # The first angle takes all values during turns in lock; afterwards it has its old value.
    around = np.deg2rad(np.arange(0, 720, 40))
    locked = Rotation.from_euler(
        'ZXY',
        np.column_stack([around, np.full(len(around), np.pi / 2 - 1e-3), np.zeros(len(around))]),
    ).as_matrix()
    through = np.concatenate([np.eye(3)[None], locked, np.eye(3)[None]])
    noise = np.diag([0.01] * 3 + [1e-3] * 3) ** 2
    motion = joint_motion(
        joint,
        poses('p', np.broadcast_to(np.eye(3), through.shape)),
        poses('d', through, noise=noise),
    )
    assert motion.status.tolist() == [0] + [JointStatus.GIMBAL] * len(locked) + [0]
    np.testing.assert_allclose(motion.angles[-1], 0, atol=1e-9)


def test_exposure_by_exposure_gives_the_numbers_of_the_trial():
    """Results agree to the last bit, with turns, missing poses and gimbal lock."""
    rng = np.random.default_rng(11)
    count = 120
    angles = np.column_stack(
        [np.linspace(0, 25, count), np.linspace(-1.9, 1.9, count), np.linspace(3, -30, count)]
    )
    rotation = Rotation.from_euler('ZXY', angles).as_matrix()
    rotation[rng.choice(count, 8, replace=False)] = np.nan
    joint = Joint('j', 'p', 'd', 'cardan_zxy')
    noise = np.diag([0.1] * 3 + [0.02] * 3) ** 2
    p = poses('p', np.broadcast_to(np.eye(3), rotation.shape))
    d = poses('d', rotation, noise=noise)
    trial = joint_motion(joint, p, d)
    assert {0, int(JointStatus.FAILED), int(JointStatus.GIMBAL)} == set(trial.status.tolist())
    before = None
    for t in range(count):
        one = joint_motion(
            joint,
            poses('p', np.eye(3)),
            poses('d', rotation[t], noise=noise),
            before=before,
        )
        np.testing.assert_array_equal(one.angles[0], trial.angles[t])
        assert one.status[0] == trial.status[t]
        if one.status[0] == JointStatus.OK:
            before = one.angles[0]


def test_status_is_that_of_the_worse_body():
    states = [0, PoseStatus.WEAK, PoseStatus.FILLED, PoseStatus.FAILED, PoseStatus.AMBIGUOUS]
    count = len(states)
    rotation = np.broadcast_to(np.eye(3), (count, 3, 3))
    joint = Joint('j', 'p', 'd', 'cardan_xyz')
    for p, d in ((states, [0] * count), ([0] * count, states), (states, [1, 1, 1, 2, 1])):
        motion = joint_motion(
            joint, poses('p', rotation, status=p), poses('d', rotation, status=d)
        )
        expected = [max(a, b) for a, b in zip(p, d)]
        expected[3] = JointStatus.FAILED
        assert motion.status.tolist() == expected


@pytest.mark.parametrize('side', ['left', 'right'])
def test_a_neutral_trial_makes_zero(side):
    """The mean over the trial is zero; its noise is part of the covariance, by Monte Carlo."""
    rng = np.random.default_rng(8)
    joint = Joint('j', 'p', 'd', 'grood_suntay_knee', random_frame(rng), random_frame(rng), side)
    noise = np.diag([0.05] * 3 + [0.01, 0.02, 0.03]) ** 2
    p = random_poses(rng, 'p', 1)
    d = random_poses(rng, 'd', 1)

    def repeated(x, count, **changes):
        return poses(
            x.body, np.repeat(x.rotation, count, 0), np.repeat(x.position_mm, count, 0), **changes
        )

    standing = [
        perturbed(repeated(x, 8, noise=noise), rng.multivariate_normal(np.zeros(6), noise, 8))
        for x in (p, d)
    ]
    zeroed = with_neutral(joint, *standing)
    np.testing.assert_allclose(joint_motion(zeroed, *standing).angles.mean(0), 0, atol=2e-3)
    later = random_poses(rng, 'd', 1)
    angles = []
    for _ in range(200):
        drawn = [
            perturbed(repeated(x, 8, noise=noise), rng.multivariate_normal(np.zeros(6), noise, 8))
            for x in (p, d)
        ]
        one = with_neutral(joint, *drawn)
        angles.append(joint_motion(one, p, later, before=np.zeros(3)).angles[0])
    sd = joint_motion(
        with_neutral(joint, repeated(p, 8, noise=noise), repeated(d, 8, noise=noise)), p, later
    ).sd[0]
    np.testing.assert_allclose(np.std(angles, axis=0), sd[:3], rtol=0.12)

    gone = repeated(p, 8, status=[PoseStatus.FILLED] * 8)
    with pytest.raises(DataError, match='no exposure of the neutral trial'):
        with_neutral(joint, gone, standing[1])


def mannequin(kind, side):
    """Landmarks of a bone whose axes are those of the room, for a symmetric person.

    Coordinates are right (of the person), front, up; medial and lateral depend on the side.
    """
    out = 1 if side == 'right' else -1
    places = {
        'femoral_head': (0, 0, 420),
        'intercondylar': (0, 0, 0),
        'medial_posterior_condyle': (-25 * out, -20, 5),
        'lateral_posterior_condyle': (25 * out, -20, 5),
        'medial_eminence': (-5 * out, 0, 0),
        'lateral_eminence': (5 * out, 0, 0),
        'ankle_centre': (0, 0, -380),
        'medial_plateau': (-22 * out, 3, -4),
        'lateral_plateau': (22 * out, 3, -4),
        'hip_centre': (90 * out, 0, 0) if kind == 'pelvis_isb' else (0, 0, 400),
        'left_asis': (-120, 60, 80),
        'right_asis': (120, 60, 80),
        'left_psis': (-40, -90, 80),
        'right_psis': (40, -90, 80),
        'medial_epicondyle': (-40 * out, 0, 0),
        'lateral_epicondyle': (40 * out, 0, 0),
        'medial_malleolus': (-30 * out, 0, 0),
        'lateral_malleolus': (30 * out, 0, 0),
        'medial_condyle': (-35 * out, 0, 370),
        'lateral_condyle': (35 * out, 0, 370),
        'suprasternal_notch': (0, 60, 0),
        'c7': (0, -60, 0),
        'xiphoid': (0, 70, -150),
        't8': (0, -70, -150),
        'acromial_angle': (60 * out, 0, 0),
        'trigonum_spinae': (-40 * out, 0, 0),
        'inferior_angle': (-40 * out, 0, -110),
        'glenohumeral_centre': (0, 0, 300),
        'ulnar_styloid': (0, 0, -250),
        'radial_styloid': (45 * out, 0, -250),
        'proximal_radius': (0, 0, 240),
        'distal_radius': (0, 0, 0),
        'sigmoid_notch': (-10 * out, 0, 5),
        'metacarpal_head': (0, 0, -60),
        'metacarpal_base': (0, 0, 0),
        'palmar_point': (0, 8, -30),
    }
    if kind == 'radius_isb':
        places['radial_styloid'] = (15 * out, 0, -5)
    return {name: np.array(places[name], dtype=float) for name in LANDMARK_FRAMES[kind].landmarks}


@pytest.mark.parametrize('side', ['left', 'right'])
@pytest.mark.parametrize('kind', LANDMARK_FRAMES)
def test_frames_of_landmarks(kind, side):
    """Axes point to the front, up and right, for a bone anywhere in the CT."""
    rng = np.random.default_rng(9)
    to_ct = Rotation.random(random_state=rng).as_matrix()
    shift = rng.normal(0, 100, 3)
    landmarks = {name: to_ct @ x + shift for name, x in mannequin(kind, side).items()}
    frame = frame_of_landmarks(kind, landmarks, side)
    right, front, up = to_ct[:, 0], to_ct[:, 1], to_ct[:, 2]
    axes = (right, front, up) if kind.endswith('grood_suntay') else (front, up, right)
    np.testing.assert_allclose(frame.rotation, np.column_stack(axes), atol=1e-9)
    named = [landmarks[name] for name in LANDMARK_FRAMES[kind].origin]
    np.testing.assert_allclose(frame.origin_mm, np.mean(named, axis=0), atol=1e-9)


@pytest.mark.parametrize('side', ['left', 'right'])
@pytest.mark.parametrize('kind', ['femur_grood_suntay', 'pelvis_isb'])
def test_bones_of_the_other_side_and_mirrored_bones_are_refused(kind, side):
    bone = mannequin(kind, side)
    mirrored = {name: x * [-1, 1, 1] for name, x in bone.items()}
    other = 'left' if side == 'right' else 'right'
    for landmarks, named in ((bone, other), (mirrored, side)):
        with pytest.raises(DataError, match='the side is wrong'):
            frame_of_landmarks(kind, landmarks, named)
    pair = [name for name in bone if name.startswith(('medial', 'lateral', 'left', 'right'))][:2]
    exchanged = {**bone, pair[0]: bone[pair[1]], pair[1]: bone[pair[0]]}
    with pytest.raises(DataError, match='two landmarks are exchanged'):
        frame_of_landmarks(kind, exchanged, side)


def test_a_bone_whose_axes_are_nearly_parallel_is_refused():
    """The lateral plateau with a wrong sign: 50 degrees from the perpendicular."""
    bone = mannequin('tibia_grood_suntay', 'right')
    bone['lateral_plateau'] = bone['lateral_plateau'] + [0, 0, 60]
    with pytest.raises(DataError, match='a coordinate of a landmark is wrong'):
        frame_of_landmarks('tibia_grood_suntay', bone, 'right')


def bending(axis, degrees):
    """Motion of a right knee from -20 degrees about an axis (3,) of the femur, and back."""
    angles = np.deg2rad(np.linspace(-20, degrees, 50))
    d = poses('d', Rotation.from_rotvec(np.outer(-angles, axis)).as_matrix())
    joint = Joint('knee', 'p', 'd', 'grood_suntay_knee', side='right')
    return joint_motion(joint, poses('p', np.broadcast_to(np.eye(3), (50, 3, 3))), d)


@pytest.mark.parametrize('away_deg', [0.0, 10.0, 40.0])
def test_the_main_rotation_of_a_knee_shows_where_it_bends(away_deg):
    away = np.deg2rad(away_deg)
    span, angle = main_rotation(bending([np.cos(away), np.sin(away), 0], 60))
    assert span == pytest.approx(np.deg2rad(72), rel=0.01)  # 90 % of it
    assert angle == pytest.approx(away, abs=1e-6)
    found = _bends_elsewhere(bending([np.cos(away), np.sin(away), 0], 60))
    assert (found is not None) == (away_deg > 30)
    assert _bends_elsewhere(bending([np.cos(away), np.sin(away), 0], 5)) is None


def test_the_second_landmark_direction_only_spans_a_plane():
    """The mechanical axis of the femur is kept; the posterior condyles are made perpendicular."""
    landmarks = mannequin('femur_grood_suntay', 'right')
    landmarks['lateral_posterior_condyle'] = np.array([25.0, -20, 15])
    frame = frame_of_landmarks('femur_grood_suntay', landmarks, 'right')
    np.testing.assert_allclose(frame.rotation, np.eye(3), atol=1e-9)


def test_frames_of_axes_and_quaternions():
    rng = np.random.default_rng(10)
    turned = Rotation.random(random_state=rng)
    x, y, z = turned.as_matrix().T
    origin = np.array([1.0, 2, 3])
    quaternion = turned.as_quat()[[3, 0, 1, 2]]
    for frame in (
        frame_of_axes({'x': 3 * x, 'y': y}, origin),
        frame_of_axes({'z': z, 'x': x}, origin),
        frame_of_axes({'x': np.round(x, 4), 'y': np.round(y, 4), 'z': np.round(z, 4)}, origin),
        frame_of_quaternion(quaternion, origin),
    ):
        np.testing.assert_allclose(frame.rotation, turned.as_matrix(), atol=2e-4)
        np.testing.assert_allclose(frame.rotation.T @ frame.rotation, np.eye(3), atol=1e-12)
        np.testing.assert_array_equal(frame.origin_mm, origin)


EYE = np.eye(3)
FEMUR = mannequin('femur_grood_suntay', 'right')


@pytest.mark.parametrize(
    ('make', 'cause'),
    [
        (
            lambda: frame_of_axes({'x': EYE[0], 'y': EYE[1], 'z': -EYE[2]}, [0, 0, 0]),
            'left-handed',
        ),
        (lambda: frame_of_axes({'x': EYE[0], 'y': [0.1, 1, 0]}, [0, 0, 0]), 'perpendicular'),
        (lambda: frame_of_axes({'x': EYE[0]}, [0, 0, 0]), 'two or three'),
        (lambda: frame_of_axes({'x': EYE[0], 'y': [0, 0, 0]}, [0, 0, 0]), 'y axis'),
        (lambda: frame_of_axes({'x': EYE[0], 'y': EYE[1]}, [0, np.nan, 0]), 'not finite'),
        (lambda: frame_of_quaternion([1, 1, 0, 0], [0, 0, 0]), 'length one'),
        (
            lambda: frame_of_landmarks(
                'femur_grood_suntay', {**FEMUR, 'femoral_head': FEMUR['intercondylar']}, 'right'
            ),
            '0 mm apart',
        ),
        (
            lambda: frame_of_landmarks(
                'femur_grood_suntay',
                {**FEMUR, 'lateral_posterior_condyle': np.array([-25.0, -20, 60])},
                'right',
            ),
            'on a line',
        ),
        (
            lambda: frame_of_landmarks(
                'femur_grood_suntay', {'femoral_head': FEMUR['femoral_head']}, 'right'
            ),
            'intercondylar is missing',
        ),
        (
            lambda: frame_of_landmarks('femur_grood_suntay', {**FEMUR, 'nose': EYE[0]}, 'right'),
            'nose is unknown',
        ),
        (lambda: Joint('knee', 'a', 'a', 'cardan_xyz'), 'both of its bodies'),
        (lambda: Joint('knee', 'a', 'b', 'cardan_xxy'), 'unknown'),
        (lambda: Joint('knee', 'a', 'b', 'grood_suntay_knee'), 'left or right'),
        (lambda: Joint('knee', 'a', 'b', 'grood_suntay_knee', side='both'), 'left or right'),
        (lambda: check_joints([Joint('j', 'a', 'b', 'cardan_xyz')], ['a']), 'no body b'),
        (
            lambda: check_joints(
                [Joint('j', 'a', 'b', 'cardan_xyz'), Joint('j', 'b', 'a', 'cardan_xyz')], 'ab'
            ),
            'two joints',
        ),
        (
            lambda: check_joints(
                [
                    Joint(f'j{a}', a, b, 'cardan_xyz')
                    for a, b in (('a', 'b'), ('b', 'c'), ('c', 'a'))
                ],
                'abc',
            ),
            'cycle',
        ),
        (
            lambda: joint_motion(
                Joint('j', 'a', 'b', 'cardan_xyz'), poses('a', EYE), poses('c', EYE)
            ),
            'not of b',
        ),
        (
            lambda: joint_motion(
                Joint('j', 'a', 'b', 'cardan_xyz'), poses('a', EYE), poses('b', [EYE, EYE])
            ),
            'different exposures',
        ),
    ],
)
def test_wrong_joints_and_frames_are_refused(make, cause):
    with pytest.raises(DataError, match=cause):
        make()


def test_two_joints_of_one_bone_are_no_cycle():
    """Shoulder: humerus relative to the thorax and to the scapula."""
    pairs = (('thorax', 'scapula'), ('scapula', 'humerus'), ('thorax', 'humerus'))
    joints = [Joint(f'{a}-{b}', a, b, 'cardan_xyz') for a, b in pairs]
    check_joints(joints, ['thorax', 'scapula', 'humerus'])


def test_the_documentation_has_all_names():
    """Conventions, names of angles and translations, landmarks and states."""
    text = (Path(__file__).parents[2] / 'docs' / 'bodies.md').read_text()
    names = [name for frame in LANDMARK_FRAMES.values() for name in frame.landmarks]
    for name in CLINICAL:
        names += [name, *CONVENTIONS[name].angles]
        if CONVENTIONS[name].along_axes:
            names += CONVENTIONS[name].translations
    names += [status.name for status in JointStatus]
    assert not [name for name in names if name not in text]
