# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Exposures of a case: two fluoroscopes, a phantom, its survey, poses and image points."""

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.distance import pdist
from scipy.spatial.transform import Rotation

from fluoro_calib_ros.exposures.frame import Frame
from fluoro_calib_ros.exposures.phantom import Phantom

from .fields import Distortion, Turning, Wander

BETWEEN = np.deg2rad(80)  # angle between the axes of the fluoroscopes
NAMES = ('a', 'b')
EDGE = 0.5  # minimum distance of image points from the edge of the image [px]
MAX_TRIES = 40  # maximum number of random poses until one shows the phantom
ARM = np.deg2rad(90)  # maximum angle of the C-arm, in either direction
NARROW = np.deg2rad(5)
FRESH_NOISE = 0.3  # noise of further frames of a pose, relative to the first frame


@dataclass(frozen=True)
class Camera:
    """A fluoroscope: interior (3,) [px], rotation (3, 3) and source (3,) [mm] in the rig frame."""

    name: str
    interior: np.ndarray
    rotation: np.ndarray
    source: np.ndarray
    distortion: Distortion
    turning: list | None = None

    def at(self, case, angle):
        """Return the camera at an angle [rad] of the C-arm."""
        if angle is None:
            return self
        return replace(
            self,
            distortion=Distortion(
                (*self.distortion.parts, Turning(case.arm, angle)),
                (*self.distortion.drawn, self.turning),
                self.distortion.side,
            ),
        )

    def exterior(self, pose):
        """Return the rotation from phantom to sensor and the source in the phantom frame [mm]."""
        turn, shift = pose
        return self.rotation @ turn, turn.T @ (self.source - shift)

    def ideal(self, points, pose):
        """Return ideal image points (n, 2) of points (n, 3) of the phantom."""
        turn, source = self.exterior(pose)
        x = (points - source) @ turn.T
        return self.interior[:2] + self.interior[2] * x[:, :2] / x[:, 2:]


@dataclass(frozen=True)
class Image:
    """Image points of one exposure, with the truth.

    rows (n,) of the beads; observed (n, 2) with noise and false matches; clean (n, 2) without
    false matches; correction (n, 2) of the clean ones; false (n,) bool.
    """

    camera: int
    number: int
    rows: np.ndarray
    observed: np.ndarray
    clean: np.ndarray
    correction: np.ndarray
    false: np.ndarray
    sigma: np.ndarray | None


@dataclass(frozen=True)
class Scene:
    """A case drawn with a seed."""

    case: object
    cameras: tuple
    true_mm: np.ndarray
    phantom: Phantom
    poses: list
    images: list
    test_poses: list
    displaced: np.ndarray
    angles: list
    test_angles: list

    def frames(self):
        """Return the frames for the calibration, by fluoroscope."""
        out = {name: [] for name in NAMES}
        for image in self.images:
            behind = self.case.behind if image.camera else 0
            out[NAMES[image.camera]].append(
                Frame(
                    NAMES[image.camera],
                    (image.number + behind - 1) % self.case.exposures + 1,
                    image.rows + 1,
                    image.observed,
                    (self.case.side, self.case.side),
                    image.sigma,
                    angle=self.angles[image.number - 1] if self.case.angle_known else None,
                )
            )
        return out


def draw(case, seed, recording=0, change=None):
    """Draw the scene of a case.

    Other recordings have the same rig, phantom and survey; change is a part of the distortion that
    is present only in this one.
    """
    rng = np.random.default_rng([seed, *case.name.encode()])
    true_mm = case.phantom(rng)
    survey = true_mm + rng.normal(0, case.survey_sd * case.survey_factor, true_mm.shape)
    displaced = rng.permutation(len(true_mm))[: case.displaced[0]]
    direction = rng.normal(0, 1, (len(displaced), 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    survey[displaced] += case.displaced[1] * direction
    if case.face_mm:
        face = true_mm[:, 0] > np.quantile(true_mm[:, 0], 0.8)
        survey[face] += case.face_mm * np.array([0.0, 0.6, 0.8])
    survey[:, 0] *= 1 - case.short
    if case.exchanged_mm:
        distance = np.abs(pdist(true_mm) - case.exchanged_mm)
        displaced = np.stack(np.triu_indices(len(true_mm), 1))[:, distance.argmin()]
        survey[displaced] = survey[displaced[::-1]]
    phantom = Phantom(
        np.arange(1, len(survey) + 1), np.round(survey, 4), np.full(len(survey), case.survey_sd)
    )
    cameras = tuple(_camera(case, rng, f) for f in range(2))
    if recording:
        rng = np.random.default_rng([recording, seed, *case.name.encode()])
    if change is not None:
        cameras = tuple(_changed(camera, change, rng) for camera in cameras)
    images = []
    poses = []
    angles = _angles(case, rng, case.exposures)
    for number in range(1, case.exposures + 1):
        if (number - 1) % case.repeats:
            poses.append(poses[-1])
            images += [_again(case, rng, image, number) for image in images[-2:]]
            continue
        pose = _pose(case, rng, cameras, true_mm, number)
        poses.append(pose)
        here = [camera.at(case, angles[number - 1]) for camera in cameras]
        if number <= case.magnified[0]:
            factor = np.array([1.0, 1.0, case.magnified[1]])
            here = [replace(camera, interior=camera.interior * factor) for camera in here]
        seen = [pose, _moved(case, rng, pose)]
        images += [_image(case, rng, f, here[f], true_mm, seen[f], number) for f in range(2)]
    tests = [_pose(case, rng, cameras, true_mm, n) for n in range(1, case.tests + 1)]
    test_angles = _angles(case, rng, case.tests)
    return Scene(
        case, cameras, true_mm, phantom, poses, images, tests, displaced, angles, test_angles
    )


def _angles(case, rng, count):
    """Draw the C-arm angles [rad] of the exposures; None if it does not rotate."""
    if not case.arm:
        return [None] * count
    return [float(angle) for angle in rng.uniform(-ARM, ARM, count)]


def _camera(case, rng, f):
    side = case.side
    angle = (f - 0.5) * BETWEEN + rng.normal(0, 0.02)
    source = case.distance * np.array([np.cos(angle), np.sin(angle), rng.normal(0, 0.02)])
    z = -source / np.linalg.norm(source)
    x = np.cross(z, [0, 0, 1.0])
    x /= np.linalg.norm(x)
    looking = np.stack([x, np.cross(z, x), z])
    tilt = Rotation.from_rotvec(rng.normal(0, [0.01, 0.01, 0.05])).as_matrix()
    middle = (side - 1) / 2 + np.asarray(case.principal) * side / 1024 + rng.normal(0, 6, 2)
    interior = np.append(middle, case.c * side * rng.uniform(0.97, 1.03))
    if np.any(case.principal):
        # Turn the camera so that the image still shows the phantom, off the axis of the image.
        offset = np.append(np.asarray(case.principal) * side / 1024 / interior[2], 0)
        tilt = Rotation.from_rotvec([-offset[1], offset[0], 0]).as_matrix() @ tilt
    distortion = Distortion.of(case.parts, rng, side)
    turning = Turning(case.arm, 0.0).draw(rng) if case.arm else None
    return Camera(NAMES[f], interior, tilt @ looking, source, distortion, turning)


def _moved(case, rng, pose):
    """Return the pose in which b sees the phantom."""
    if not any(case.late):
        return pose
    turn, shift = pose
    way = rng.normal(0, 1, (2, 3))
    way *= np.array(case.late)[:, None] / np.linalg.norm(way, axis=1, keepdims=True)
    return Rotation.from_rotvec(way[1]).as_matrix() @ turn, shift + way[0]


def _again(case, rng, image, number):
    """Return another frame of the pose of an image, with mostly the same noise."""
    fresh = FRESH_NOISE * rng.normal(0, case.noise.sd, image.observed.shape)
    return replace(
        image, number=number, observed=image.observed + fresh, clean=image.clean + fresh
    )


def _changed(camera, change, rng):
    before = camera.distortion
    distortion = Distortion(
        (*before.parts, change), (*before.drawn, change.draw(rng)), before.side
    )
    return replace(camera, distortion=distortion)


def _pose(case, rng, cameras, true_mm, number):
    """Draw a pose in which both fluoroscopes see a sufficient part of the phantom."""
    for _ in range(MAX_TRIES):
        shift = rng.uniform(-case.spread, case.spread, 3)
        if case.poses == 'narrow':
            turn = Rotation.from_rotvec(rng.normal(0, NARROW, 3))
            shift = shift / 2
        elif case.poses == 'turntable':
            angle = 2 * np.pi * (number + rng.uniform(0, 1)) / case.exposures
            turn = Rotation.from_rotvec(rng.normal(0, 0.15, 3)) * Rotation.from_rotvec(
                [0, 0, angle]
            )
        else:
            turn = Rotation.random(random_state=int(rng.integers(2**31)))
        pose = (turn.as_matrix(), shift)
        seen = [_on_image(case, camera.ideal(true_mm, pose)).mean() for camera in cameras]
        if min(seen) > case.min_seen:
            break
    return pose


def _on_image(case, uv):
    return ((uv > EDGE) & (uv < case.side - 1 - EDGE)).all(axis=1)


def _image(case, rng, f, camera, true_mm, pose, number):
    distortion = camera.distortion
    if case.wander:
        # The field of this exposure; the nominal field is the mean over all exposures.
        change = Distortion.of((Wander(case.wander),), rng, case.side)
        distortion = Distortion(
            distortion.parts + change.parts, distortion.drawn + change.drawn, case.side
        )
    points = true_mm
    if number <= case.moved[0]:
        half = rng.random(len(points)) < 0.5
        points = points + half[:, None] * rng.normal(0, case.moved[1], 3)
    observed = distortion.observed(camera.ideal(points, pose))
    sds = case.noise.sds(observed) if case.sigma_known else None
    observed = case.noise(rng, observed, case.side)
    visible = _on_image(case, observed)
    if case.blind is not None:
        visible &= ~case.blind(observed / (case.side - 1))
    rows = np.sort(rng.permutation(np.flatnonzero(visible))[: case.beads])
    clean = observed[rows]
    seen, false = case.false(rng, clean, case.side)
    seen = np.clip(seen, EDGE, case.side - 1 - EDGE)
    sigma = None if sds is None else sds[rows]
    return Image(f, number, rows, seen, clean, distortion.correction(clean), false, sigma)
