# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""A virtual right knee with markers in femur and tibia, walking or landing, with ground truth.

Frames of the bones are those of Grood and Suntay: x right, y anterior, z proximal. The person
faces along y of the rig. Coordinates of bodies are those of a CT with an arbitrary pose.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..bodies.anatomical_frames import AnatomicalFrame, frame_of_landmarks
from ..bodies.body import Body
from ..bodies.joints import Joint
from ..exposures.frame import Frame
from ..photogrammetry.rotations import matrix_from_vector
from .rig import StreamStart, VirtualRig, image_frames

CT_SD_MM = 0.1  # standard deviation of a coordinate of a marker in the CT
SIDE = 'right'
JOINT = 'knee'
CONVENTION = 'grood_suntay_knee'
# Markers [mm] in the frames of the bones, and the first id of each bone.
FIRST_ID = {'femur': 3001, 'tibia': 3011}
MARKERS_MM = {
    'femur': [[-31, -6, 16], [29, -14, 21], [6, 13, 46], [-9, -8, 66]],
    'tibia': [[-29, 6, -17], [27, -9, -21], [4, 16, -44], [-3, -7, -62]],
}
LANDMARKS_MM = {
    'femur': {
        'femoral_head': [0, 0, 425],
        'intercondylar': [0, 0, 0],
        'medial_posterior_condyle': [-24, -22, 4],
        'lateral_posterior_condyle': [26, -22, 4],
    },
    'tibia': {
        'medial_eminence': [-6, 0, 0],
        'lateral_eminence': [6, 0, 0],
        'ankle_centre': [0, 0, -375],
        'medial_plateau': [-23, -3, -5],
        'lateral_plateau': [24, -3, -5],
    },
}

# Flexion [deg] over a gait cycle that starts at initial contact: coefficients of cosines and
# sines, from harmonics 0 and 1 on. Fitted to the means of free walking, every 2 % of the cycle, of
# Schwartz et al., J. Biomech. 41 (2008) 1639; the largest residual is 0.44 degrees.
GAIT_COS_DEG = (23.338, -1.981, -14.122, -0.619, -0.895, -0.598)
GAIT_SIN_DEG = (-18.904, 6.962, 4.516, 0.641, 0.742)
CYCLE_S = 1.1  # duration of a gait cycle
THIGH_MM = 425.0  # length
SHANK_MM = 375.0  # length
GRAVITY = 9810.0  # mm/s^2

# Landing from 0.2 m on one leg. The pulse of the tibia, t exp(-t/RISE_S), absorbs its speed and
# has its maximum after RISE_S, speed / (e RISE_S) = 25 g.
DROP_MM = 200.0
RISE_S = 0.003
FLEX_S = 0.05  # time to the maximum angular velocity of the knee, 370 degrees/s
FALL_S = 0.06  # recorded time before the contact
LANDING_S = 0.4  # recorded time
LANDING_HZ = 500.0  # frame rate


@dataclass(frozen=True)
class VirtualKnee:
    """The bones of a knee in the coordinates of their CT."""

    bodies: tuple[Body, ...]  #: femur and tibia with their true markers; sd 0
    surveyed: tuple[Body, ...]  #: the same bodies with the errors of CT
    landmarks: Mapping[str, Mapping[str, NDArray[np.float64]]]  #: landmarks (3,) by body [mm]
    joint: Joint


@dataclass(frozen=True)
class KneeMotion:
    """True motion at times (T,) [s]: poses body -> rig by name, and joint coordinates.

    rotation (T, 3, 3), position_mm (T, 3); angles (T, 3) [rad] and translations (T, 3) [mm] as
    named by the convention.
    """

    times_s: NDArray[np.float64]
    rotation: Mapping[str, NDArray[np.float64]]
    position_mm: Mapping[str, NDArray[np.float64]]
    angles: NDArray[np.float64]
    translations: NDArray[np.float64]


@dataclass(frozen=True)
class SimulatedKnee:
    """A recording of a virtual knee: frames by fluoroscope, and the true motion."""

    frames: Mapping[str, list[Frame]]
    motion: KneeMotion


def virtual_knee(seed: int = 0) -> VirtualKnee:
    """Draw a knee at random; the same seed gives the same knee."""
    rng = np.random.default_rng([seed, 11])
    bodies = []
    surveyed = []
    landmarks = {}
    frames = {}
    for name, markers in MARKERS_MM.items():
        to_ct = matrix_from_vector(rng.uniform(-0.6, 0.6, 3))
        shift = rng.uniform(-150, 150, 3)
        xyz = (np.array(markers) + rng.uniform(-3, 3, (len(markers), 3))) @ to_ct.T + shift
        target_id = FIRST_ID[name] + np.arange(len(xyz))
        bodies.append(Body(name, target_id, xyz, np.zeros(len(xyz))))
        survey = np.round(xyz + rng.normal(0, CT_SD_MM, xyz.shape), 4)
        surveyed.append(Body(name, target_id, survey, np.full(len(xyz), CT_SD_MM)))
        places = {n: np.round(to_ct @ x + shift, 6) for n, x in LANDMARKS_MM[name].items()}
        landmarks[name] = places
        frames[name] = frame_of_landmarks(f'{name}_grood_suntay', places, SIDE)
    joint = Joint(
        JOINT,
        'femur',
        'tibia',
        CONVENTION,
        proximal_frame=frames['femur'],
        distal_frame=frames['tibia'],
        side=SIDE,
    )
    return VirtualKnee(tuple(bodies), tuple(surveyed), landmarks, joint)


def walking(knee: VirtualKnee, times_s: NDArray[np.float64]) -> KneeMotion:
    """Return the motion of a knee on a treadmill; the thigh swings by 20 degrees to both sides."""
    phase = 2 * np.pi * times_s / CYCLE_S
    order = np.arange(len(GAIT_COS_DEG))
    waves = np.cos(np.outer(phase, order)) @ GAIT_COS_DEG
    flexion = np.deg2rad(waves + np.sin(np.outer(phase, order[1:])) @ GAIT_SIN_DEG)
    swing = np.deg2rad(20) * np.cos(phase)
    zeros = np.zeros_like(phase)
    rotation = matrix_from_vector(np.column_stack([swing, zeros, zeros])) @ matrix_from_vector(
        np.deg2rad(3) * np.column_stack([zeros, np.sin(phase), np.sin(phase + 1)])
    )
    centre = np.column_stack(
        [
            8 * np.sin(phase),
            THIGH_MM * np.sin(swing),
            THIGH_MM * (np.cos(np.deg2rad(20)) - np.cos(swing)) + 20 * np.cos(2 * phase),
        ]
    )
    angles, translations = _coupled(flexion, phase)
    return _motion(knee, times_s, (rotation, centre), angles, translations)


def landing(knee: VirtualKnee, times_s: NDArray[np.float64]) -> KneeMotion:
    """Return the motion of a knee that falls and lands at the time FALL_S.

    The tibia is decelerated by a pulse, then tilts forward while the knee bends, both by
    1 - (1 + t/FLEX_S) exp(-t/FLEX_S).
    """
    speed = np.sqrt(2 * GRAVITY * DROP_MM)
    t = np.maximum(times_s - FALL_S, 0.0)
    before_contact = np.minimum(times_s - FALL_S, 0.0)
    s = t / RISE_S
    height = -speed * before_contact - GRAVITY / 2 * before_contact**2
    height -= speed * RISE_S * (2 - (2 + s) * np.exp(-s))
    bend = 1 - (1 + t / FLEX_S) * np.exp(-t / FLEX_S)
    tilt = np.deg2rad(4 + 18 * bend)
    zeros = np.zeros_like(t)
    rotation = matrix_from_vector(np.column_stack([-tilt, 0.05 * bend, 0.04 * bend]))
    start = np.deg2rad(4)
    centre = np.column_stack(
        [
            6 * bend,
            SHANK_MM * (np.sin(tilt) - np.sin(start)) - 60,
            SHANK_MM * (np.cos(tilt) - np.cos(start)) + height + 20,
        ]
    )
    flexion = np.deg2rad(15 + 50 * bend)
    angles, translations = _coupled(flexion, zeros)
    return _motion(knee, times_s, (rotation, centre), angles, translations, of_tibia=True)


def _coupled(
    flexion: NDArray[np.float64], phase: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return angles and translations (T, 3) that accompany flexion (T,) [rad].

    The coupled motions are a few degrees and millimetres, as measured with pins in the bones
    (Lafortune et al., J. Biomech. 25, 1992).
    """
    adduction = 0.03 * np.sin(phase) - 0.04 * np.sin(flexion)
    internal = 0.02 + 0.1 * np.sin(flexion) + 0.03 * np.cos(phase)
    lateral = 1.0 + 1.5 * np.sin(flexion)
    drawer = 4 - 6 * (1 - np.cos(flexion))
    distraction = 3 + 2 * np.sin(flexion) ** 2
    return (
        np.column_stack([flexion, adduction, internal]),
        np.column_stack([lateral, drawer, distraction]),
    )


def _motion(
    knee: VirtualKnee,
    times_s: NDArray[np.float64],
    driven: tuple[NDArray[np.float64], NDArray[np.float64]],
    angles: NDArray[np.float64],
    translations: NDArray[np.float64],
    of_tibia: bool = False,
) -> KneeMotion:
    """Return the motion of both bones; driven: pose of the femur, or of the tibia, in the rig."""
    unit = np.eye(3)
    by_flexion, by_adduction, by_turn = (
        matrix_from_vector(sign * angles[:, n : n + 1] * unit[n])
        for n, sign in enumerate((-1, 1, 1))
    )
    relative_rotation = by_flexion @ by_adduction @ by_turn
    # Shifts along the three axes; distraction is opposite to the last one.
    axes = np.stack(
        [np.broadcast_to(unit[0], angles.shape), by_flexion[:, :, 1], relative_rotation[:, :, 2]],
        axis=1,
    )
    shift = np.linalg.solve(axes, (translations * [1, 1, -1])[..., None])[..., 0]
    rotation, origin = driven
    if of_tibia:
        tibia = driven
        femur_rotation = rotation @ np.swapaxes(relative_rotation, 1, 2)
        femur = femur_rotation, origin - (femur_rotation @ shift[..., None])[..., 0]
    else:
        femur = driven
        tibia = rotation @ relative_rotation, origin + (rotation @ shift[..., None])[..., 0]
    poses = {
        'femur': _of_body(*femur, knee.joint.proximal_frame),
        'tibia': _of_body(*tibia, knee.joint.distal_frame),
    }
    return KneeMotion(
        times_s,
        {name: pose[0] for name, pose in poses.items()},
        {name: pose[1] for name, pose in poses.items()},
        angles=angles,
        translations=translations,
    )


def _of_body(
    rotation: NDArray[np.float64], origin: NDArray[np.float64], frame: AnatomicalFrame
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the pose of a body from the pose of its anatomical frame."""
    body_rotation = rotation @ frame.rotation.T
    return body_rotation, origin - body_rotation @ frame.origin_mm


def simulate_knee(
    rig: VirtualRig,
    knee: VirtualKnee,
    motion: KneeMotion,
    noise_px: float = 0.25,
    seed: int = 0,
    start: StreamStart | None = None,
) -> SimulatedKnee:
    """Simulate a recording of a knee: image points of the markers that are on the image.

    motion: for example walking(knee, times). noise_px: standard deviation of an image coordinate.
    seed: the same seed gives the same noise.
    """
    ids = np.concatenate([body.target_id for body in knee.bodies])
    points = np.concatenate(
        [
            body.xyz_mm @ np.swapaxes(motion.rotation[body.name], 1, 2)
            + motion.position_mm[body.name][:, None]
            for body in knee.bodies
        ],
        axis=1,
    )
    rng = np.random.default_rng([seed, 12])
    frames, _ = image_frames(
        rig,
        points,
        ids,
        motion.times_s.tolist(),
        noise_px=noise_px,
        rng=rng,
        start=start or StreamStart(),
    )
    return SimulatedKnee(frames, motion)


MOTIONS: Mapping[str, Callable[[VirtualKnee, NDArray[np.float64]], KneeMotion]] = {
    'walking': walking,
    'landing': landing,
}
