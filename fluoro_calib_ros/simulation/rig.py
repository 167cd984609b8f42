# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The virtual rig: phantom, fluoroscopes with positions and distortion, and streams of frames.

Two fluoroscopes with crossing axes look at the origin of the rig frame (z up, mm). Their sources
are about 1.5 m from it and about 2 m apart. The phantom is a cube of 260 mm with 503 beads on its
four side faces.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..exposures.frame import DECIMALS, Frame, points_on_image
from ..exposures.phantom import Phantom
from ..photogrammetry.collinearity import project
from ..photogrammetry.rotations import matrix_from_vector

IMAGE_SIZE = (1024, 1024)
CUBE_MM = 260.0  # edge length of the phantom
BEADS = 503  # number of beads on the phantom
SURVEY_SD_MM = 0.1  # standard deviation of a coordinate of a bead
BETWEEN_DEG = 84.0  # angle between the axes of neighbouring fluoroscopes
BETWEEN_THREE_DEG = 60.0  # the same for three fluoroscopes

# Rotation (3, 3) and shift (3,) [mm] from the frame of the phantom to the rig frame.
Pose = tuple[NDArray[np.float64], NDArray[np.float64]]


@dataclass(frozen=True)
class VirtualFluoroscope:
    """A fluoroscope of a virtual rig."""

    name: str
    interior: NDArray[np.float64]  #: (3,) xp, yp, c [px]
    rotation: NDArray[np.float64]  #: (3, 3) rig frame -> sensor frame
    position_mm: NDArray[np.float64]  #: (3,) position of the source in the rig frame
    distortion: DistortionField
    image_size: tuple[int, int] = IMAGE_SIZE  #: width and height [px]

    def exterior(self, pose: Pose) -> Pose:
        """Return the exterior orientation for a pose of the phantom.

        It consists of the rotation (3, 3) phantom -> sensor frame and the source (3,) in the frame
        of the phantom [mm].
        """
        rotation, shift = pose
        return self.rotation @ rotation, rotation.T @ (self.position_mm - shift)

    def ideal(self, points_mm: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the undistorted image points (n, 2) [px] of points (n, 3) in the rig frame."""
        return project(self.rotation, self.position_mm, points_mm, self.interior)


@dataclass(frozen=True)
class VirtualRig:
    """A rig: fluoroscopes, the true coordinates of the phantom [mm] and its survey."""

    fluoroscopes: tuple[VirtualFluoroscope, ...]
    true_mm: NDArray[np.float64]
    phantom: Phantom


def bead_coordinates(rng: np.random.Generator) -> NDArray[np.float64]:
    """Return coordinates (503, 3) [mm] of beads on the sides of the cube, in a perturbed grid."""
    across, up = np.meshgrid(
        (np.arange(11) - 5) * 23.0, (np.arange(12) - 5.5) * 21.0, indexing='ij'
    )
    face = np.column_stack([across.ravel(), up.ravel()])
    beads = []
    for side in range(4):
        indices = np.sort(rng.permutation(len(face))[: 126 if side < BEADS % 4 else 125])
        face_points = face[indices] + rng.uniform(-3, 3, (len(indices), 2))
        rotation = matrix_from_vector([0, 0, side * np.pi / 2])
        depth = np.full(len(face_points), CUBE_MM / 2)
        beads.append(np.column_stack([face_points[:, 0], depth, face_points[:, 1]]) @ rotation.T)
    return np.round(np.concatenate(beads), 6)


def looking_at_origin(position_mm: ArrayLike) -> NDArray[np.float64]:
    """Return the rotation (3, 3) rig -> sensor of a source at position_mm (3,), facing the origin.

    The y axis of the sensor points down.
    """
    z = -np.asarray(position_mm) / np.linalg.norm(position_mm)
    x = np.cross(z, [0.0, 0.0, 1.0])
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z])


def virtual_rig(
    seed: int = 0,
    strength: float = 1.0,
    names: Sequence[str] = ('a', 'b'),
    survey_sd_mm: float = SURVEY_SD_MM,
    between_deg: float = BETWEEN_DEG,
) -> VirtualRig:
    """Draw a rig at random; the same seed gives the same rig.

    Parameters
    ----------
    seed : int
    strength : float
        Scale factor of the distortion.
    names : sequence of str
        Names of any number of fluoroscopes.
    survey_sd_mm : float
        Standard deviation of the survey of the phantom.
    between_deg : float
        Angle between neighbouring fluoroscopes. At 84 degrees their sources are some 2 m apart;
        with three fluoroscopes, 60 degrees leave every two of them a good base.
    """
    rng = np.random.default_rng([seed, 1])
    true_mm = bead_coordinates(rng)
    survey = np.round(true_mm + rng.normal(0, survey_sd_mm, true_mm.shape), 4)
    phantom = Phantom(np.arange(1, BEADS + 1), survey, np.full(BEADS, survey_sd_mm))
    fluoroscopes = []
    for number, name in enumerate(names):
        angle = np.deg2rad(between_deg / 2) * (2 * number - (len(names) - 1))
        angle = angle + rng.uniform(-0.03, 0.03)
        position = 1500 * np.array([np.sin(angle), -np.cos(angle), 0]) + rng.uniform(-30, 30, 3)
        tilt = matrix_from_vector(rng.uniform(-0.01, 0.01, 3))
        interior = np.array([511.5, 511.5, 4000.0]) + rng.uniform([-15, -15, -150], [15, 15, 150])
        fluoroscopes.append(
            VirtualFluoroscope(
                name,
                interior,
                tilt @ looking_at_origin(position),
                position,
                random_field(rng, strength),
            )
        )
    return VirtualRig(tuple(fluoroscopes), true_mm, phantom)


EDGE_PX = IMAGE_SIZE[0] / 2  # the components of a field are given by their size there
RIPPLES = 14  # number of ripples in a random field
CHUNK = 2000  # pixels at once, for which the ripples of a field fit into the cache


@dataclass(frozen=True)
class DistortionField:
    """Correction field: a function from pixels (n, 2) to corrections (n, 2) [px]."""

    centre: NDArray[np.float64]  #: (2,) [px]
    #: size of the pincushion distortion at the edge of the image [px]
    pincushion: float
    s_shape: NDArray[np.float64]  #: (2,) size along u and v at the edge of the image [px]
    spiral: float
    #: (k, 5), Gaussian bumps: centre u, v, width, and height along u and v [px]
    ripples: NDArray[np.float64]

    def __call__(self, uv: ArrayLike) -> NDArray[np.float64]:
        """Return the corrections (n, 2) [px] of observed pixels uv (n, 2)."""
        uv = np.asarray(uv, dtype=float)
        x = (uv - self.centre) / EDGE_PX
        r2 = np.sum(x * x, axis=1, keepdims=True)
        perpendicular = np.stack([-x[:, 1], x[:, 0]], axis=1)
        # S shape of each line: a cubic that fixes the centre and the point at 0.63.
        s = x[:, ::-1] * (x[:, ::-1] ** 2 - 0.4) / 0.6
        displacement = r2 * (self.pincushion * x + self.spiral * perpendicular) + self.s_shape * s
        u, v, width, *heights = self.ripples.T[:, :, None]
        for start in range(0, len(uv), CHUNK):
            part = slice(start, start + CHUNK)
            square = (uv[part, 0] - u) ** 2 + (uv[part, 1] - v) ** 2
            bump = np.exp(-square / (2 * width**2))
            for axis, height in enumerate(heights):
                terms = np.concatenate([displacement[None, part, axis], bump * height])
                displacement[part, axis] = np.add.reduce(terms, axis=0)
        return displacement

    def distort(self, uv: ArrayLike) -> NDArray[np.float64]:
        """Return observed pixels (n, 2) of undistorted ones uv (n, 2), by fixed-point iteration.

        Far beyond the image it may diverge; such pixels are NaN or infinite.
        """
        uv = np.asarray(uv, dtype=float)
        with np.errstate(over='ignore', invalid='ignore'):
            observed = uv + self(uv)
            for _ in range(100):
                last = observed
                observed = uv + self(observed)
                if np.max(np.abs(observed - last), initial=0.0) < 1e-11:  # below rounding errors
                    break
        return observed


def random_field(rng: np.random.Generator, strength: float = 1.0) -> DistortionField:
    """Draw a field at random.

    At strength 1 it is some 15 px along the border of the image and 26 to 35 px in its corners.
    """
    sign = rng.choice([-1.0, 1.0], size=4)
    centre = np.asarray(IMAGE_SIZE) / 2 - 0.5 + rng.uniform(-20, 20, 2)
    ripples = np.column_stack(
        [
            rng.uniform(0, IMAGE_SIZE[0], RIPPLES),
            rng.uniform(0, IMAGE_SIZE[1], RIPPLES),
            rng.uniform(70, 130, RIPPLES),
            rng.uniform(-1.2, 1.2, (RIPPLES, 2)),
        ]
    )
    ripples[:, 3:] *= strength
    pincushion = strength * rng.uniform(9.0, 10.2)
    s_shape = strength * sign[:2] * rng.uniform(1.2, 2.4, 2)
    spiral = strength * sign[2] * rng.uniform(1.2, 2.4)
    return DistortionField(centre, pincushion, s_shape, spiral, ripples)


START_NS = 1_767_225_600_000_000_000  # stamp of the first frame


@dataclass(frozen=True)
class StreamStart:
    """Stamp [ns] and number of the first frame of a stream."""

    stamp_ns: int = START_NS
    number: int = 1

    def frame(
        self,
        fluoroscope: VirtualFluoroscope,
        index: int,
        time_s: float,
        target_id: NDArray[np.int64],
        observed: NDArray[np.float64],
    ) -> Frame:
        """Return the frame with this index, counted from 0, at a time after the first one [s].

        target_id (n,) and observed (n, 2) [px] are its image points.
        """
        return Frame(
            fluoroscope=fluoroscope.name,
            number=self.number + index,
            target_id=target_id,
            uv=observed,
            image_size=fluoroscope.image_size,
            sigma=None,
            stamp_ns=self.stamp_ns + round(time_s * 1e9),
            frame_id=f'{fluoroscope.name}_optical',
        )


# Simulated exposures of the phantom, of moving markers and of a grid, with ground truth.


@dataclass(frozen=True)
class Detection:
    """Properties of the detection of beads in an exposure."""

    noise_px: float = 0.25  #: standard deviation of an image coordinate
    false_matches: float = 0.01  #: fraction of detected beads with the id of a nearby bead
    beads: tuple[int, int] = (130, 160)  #: minimum and maximum number of detected beads


@dataclass(frozen=True)
class SimulatedExposures:
    """Exposures of the phantom."""

    frames: Mapping[str, list[Frame]]  #: by fluoroscope
    poses: Sequence[Pose]  #: rotation and shift [mm] of the phantom in the rig frame
    #: by fluoroscope, the undistorted image points (n, 2) of each frame [px], with noise and false
    #: matches
    undistorted: Mapping[str, list[NDArray[np.float64]]]


def phantom_poses(rng: np.random.Generator, count: int) -> list[Pose]:
    """Return poses of the phantom on a turntable, tilted and shifted at random."""
    angles = 2 * np.pi * (np.arange(count) + rng.uniform(0, 1, count)) / count
    poses = []
    for angle in angles:
        tilt = matrix_from_vector(np.append(rng.uniform(-0.35, 0.35, 2), 0))
        shift = rng.uniform([-80, -80, -70], [80, 80, 70])
        poses.append((tilt @ matrix_from_vector([0, 0, angle]), shift))
    return poses


def simulate_exposures(
    rig: VirtualRig,
    count: int,
    seed: int = 0,
    detection: Detection | None = None,
    start: StreamStart | None = None,
    interval_s: float = 0.5,
) -> SimulatedExposures:
    """Simulate exposures of the phantom in different poses.

    count: number of poses. seed: the same seed gives the same exposures. interval_s: time between
    exposures.
    """
    detection = detection or Detection()
    start = start or StreamStart()
    rng = np.random.default_rng([seed, 2])
    poses = phantom_poses(rng, count)
    frames: dict[str, list[Frame]] = {f.name: [] for f in rig.fluoroscopes}
    undistorted: dict[str, list[NDArray[np.float64]]] = {f.name: [] for f in rig.fluoroscopes}
    for index, (rotation, shift) in enumerate(poses):
        points = rig.true_mm @ rotation.T + shift
        for fluoroscope in rig.fluoroscopes:
            ids, observed = detect_beads(
                rng, fluoroscope, points, rig.phantom.target_id, detection
            )
            frame = start.frame(fluoroscope, index, index * interval_s, ids, observed)
            frames[fluoroscope.name].append(frame)
            undistorted[fluoroscope.name].append(observed - fluoroscope.distortion(observed))
    return SimulatedExposures(frames, poses, undistorted)


def detect_beads(
    rng: np.random.Generator,
    fluoroscope: VirtualFluoroscope,
    points_mm: NDArray[np.float64],
    target_id: NDArray[np.int64],
    detection: Detection | None = None,
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Simulate the detection of beads in one image.

    points_mm: beads (k, 3) in the rig frame; target_id: (k,). Returns the ids (n,) of the detected
    beads and their observed pixels (n, 2).
    """
    detection = detection or Detection()
    ideal = fluoroscope.ideal(points_mm)
    observed = fluoroscope.distortion.distort(ideal)
    observed = observed + rng.normal(0, detection.noise_px, ideal.shape)
    visible = np.flatnonzero(points_on_image(observed, fluoroscope.image_size))
    low, high = detection.beads
    detected = np.sort(rng.permutation(visible)[: rng.integers(low, high + 1)])
    # Rounding also hides differences between CPUs in the last bit.
    detected_uv = np.round(observed[detected], DECIMALS)
    for row in np.flatnonzero(rng.random(len(detected)) < detection.false_matches):
        distance = np.sum((observed[visible] - observed[detected[row]]) ** 2, axis=1)
        wrong_bead = visible[np.argsort(distance, kind='stable')[rng.integers(1, 9)]]
        detected_uv[row] = np.round(observed[wrong_bead], DECIMALS)
    return target_id[detected], detected_uv


CLUSTER_MARKERS = 6  # number of markers in a rigid cluster
# Centres of the clusters [mm]; the first two belong to one bone, the others to the other.
CLUSTER_CENTRES = np.array(
    [
        [-8, 0, 85],
        [12, 10, 40],
        [-10, -8, -35],
        [10, 5, -80],
        [30, -25, -55],
        [-35, 30, -60],
        [35, 30, -20],
        [-35, -30, -10],
    ],
    dtype=float,
)
GRID = (52, 39)  # number of points of a calibration grid across and down


@dataclass(frozen=True)
class SimulatedTracking:
    """A recording of moving markers."""

    frames: Mapping[str, list[Frame]]  #: by fluoroscope
    marker_id: NDArray[np.int64]  #: (k,)
    points_mm: NDArray[np.float64]  #: (frames, k, 3), positions in the rig frame
    #: by fluoroscope, the ideal image points (frames, k, 2) without noise [px]
    ideal: Mapping[str, NDArray[np.float64]]


def simulate_tracking(
    rig: VirtualRig,
    seconds: float = 4.0,
    rate_hz: float = 120.0,
    seed: int = 0,
    noise_px: float = 0.25,
    start: StreamStart | None = None,
    clusters: int = 4,
) -> SimulatedTracking:
    """Simulate markers on the two bones of a joint that bends and straightens.

    Parameters
    ----------
    rig : VirtualRig
    seconds, rate_hz : float
        Length and frame rate of the recording.
    seed : int
        The same seed gives the same recording.
    noise_px : float
        Standard deviation of an image coordinate.
    start : StreamStart, optional
    clusters : int
        Number of rigid clusters of six markers, up to eight.
    """
    start = start or StreamStart()
    rng = np.random.default_rng([seed, 3])
    shapes = [rng.uniform(-22, 22, (CLUSTER_MARKERS, 3)) for _ in CLUSTER_CENTRES[:clusters]]
    ids = np.arange(1001, 1001 + CLUSTER_MARKERS * len(shapes))
    times_s = [index / rate_hz for index in range(round(seconds * rate_hz))]
    points = _markers_at(times_s, shapes)
    frames, ideal = image_frames(
        rig, points, ids, times_s, noise_px=noise_px, rng=rng, start=start
    )
    return SimulatedTracking(frames, ids, points, ideal)


def image_frames(
    rig: VirtualRig,
    points_mm: NDArray[np.float64],
    target_id: NDArray[np.int64],
    times_s: Sequence[float],
    noise_px: float,
    rng: np.random.Generator,
    start: StreamStart,
) -> tuple[dict[str, list[Frame]], dict[str, NDArray[np.float64]]]:
    """Return frames of moving points and their ideal image points (T, k, 2), by fluoroscope.

    points_mm (T, k, 3) are the positions of the targets (k,) at times (T,). A frame contains the
    points that are on the image.
    """
    frames: dict[str, list[Frame]] = {}
    ideal: dict[str, NDArray[np.float64]] = {}
    for fluoroscope in rig.fluoroscopes:
        uv = fluoroscope.ideal(points_mm.reshape(-1, 3)).reshape(*points_mm.shape[:2], 2)
        observed = fluoroscope.distortion.distort(uv.reshape(-1, 2)).reshape(uv.shape)
        observed = np.round(observed + rng.normal(0, noise_px, uv.shape), DECIMALS)
        on_image = points_on_image(observed.reshape(-1, 2), fluoroscope.image_size)
        on_image = on_image.reshape(observed.shape[:2])
        ideal[fluoroscope.name] = uv
        frames[fluoroscope.name] = [
            start.frame(fluoroscope, t, time_s, target_id[on_image[t]], observed[t, on_image[t]])
            for t, time_s in enumerate(times_s)
        ]
    return frames, ideal


def _markers_at(
    times_s: Sequence[float], shapes: list[NDArray[np.float64]]
) -> NDArray[np.float64]:
    """Return positions (T, k, 3) [mm] of all markers at times (T,) [s].

    shapes: clusters (6, 3) [mm].
    """
    bends = [np.deg2rad(25) * np.sin(2 * np.pi * 0.5 * t) for t in times_s]
    sway = 70 * np.array(
        [
            [np.sin(2 * np.pi * 0.31 * t), np.cos(2 * np.pi * 0.23 * t), 0.6 * np.sin(t)]
            for t in times_s
        ]
    ).reshape(-1, 1, 3)
    points = [np.zeros((len(times_s), 0, 3))]
    for number, (shape, centre) in enumerate(zip(shapes, CLUSTER_CENTRES)):
        vectors = [
            [bend if number < 2 else -bend, 0.3 * np.sin(1.1 * t + number), 0]
            for bend, t in zip(bends, times_s)
        ]
        rotations = matrix_from_vector(np.reshape(vectors, (-1, 3)))
        points.append((shape + centre) @ np.swapaxes(rotations, 1, 2) + sway)
    return np.concatenate(points, axis=1)


def simulate_grid(
    rig: VirtualRig,
    count: int,
    seed: int = 0,
    noise_px: float = 0.25,
) -> dict[str, list[Frame]]:
    """Simulate `count` frames of a grid of 2,028 points in front of the detector, at 30 Hz.

    seed: the same seed gives the same frames. noise_px: standard deviation of an image coordinate.
    """
    start = StreamStart()
    rng = np.random.default_rng([seed, 5])
    frames = {}
    for fluoroscope in rig.fluoroscopes:
        width, height = fluoroscope.image_size
        u = np.linspace(0.08, 0.92, GRID[0]) * width
        v = np.linspace(0.08, 0.92, GRID[1]) * height
        ideal = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)
        distorted = fluoroscope.distortion.distort(ideal)
        ids = np.arange(2001, 2001 + len(ideal))
        view_frames = []
        for index in range(count):
            observed = np.round(distorted + rng.normal(0, noise_px, distorted.shape), DECIMALS)
            time_s = index / 30.0
            view_frames.append(start.frame(fluoroscope, index, time_s, ids, observed))
        frames[fluoroscope.name] = view_frames
    return frames
