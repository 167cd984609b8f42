# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Simulated exposures of the phantom, of moving markers and of a grid, with their truth."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..exposures.frame import Frame, points_on_image
from ..photogrammetry.rotations import matrix_from_vector
from .rig import DECIMALS, Pose, StreamStart, VirtualFluoroscope, VirtualRig


@dataclass(frozen=True)
class Detection:
    """How beads are detected in an exposure."""

    noise_px: float = 0.25  #: standard deviation of an image coordinate
    false_matches: float = 0.01  #: fraction of the detected beads that get the id of a bead nearby
    beads: tuple[int, int] = (130, 160)  #: smallest and largest number of detected beads


@dataclass(frozen=True)
class SimulatedExposures:
    """Exposures of the phantom."""

    frames: Mapping[str, list[Frame]]  #: by fluoroscope
    poses: Sequence[Pose]  #: rotation and shift [mm] of the phantom in the rig frame
    #: by fluoroscope the undistorted image points (n, 2) of each frame, with noise and false
    #: matches [px]
    undistorted: Mapping[str, list[NDArray[np.float64]]]


def phantom_poses(rng: np.random.Generator, count: int) -> list[Pose]:
    """Poses of the phantom on a turntable, tilted and shifted at random."""
    turns = 2 * np.pi * (np.arange(count) + rng.uniform(0, 1, count)) / count
    poses = []
    for turn in turns:
        tilt = matrix_from_vector(np.append(rng.uniform(-0.35, 0.35, 2), 0))
        shift = rng.uniform([-80, -80, -70], [80, 80, 70])
        poses.append((tilt @ matrix_from_vector([0, 0, turn]), shift))
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
    undistorted: dict[str, list[np.ndarray]] = {f.name: [] for f in rig.fluoroscopes}
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
) -> tuple[np.ndarray, np.ndarray]:
    """Simulate the detection of beads in one image.

    points_mm: (k, 3), beads in the rig frame. target_id: (k,). Returns target_id: (n,), ids of the
    detected beads; observed: (n, 2) [px].
    """
    detection = detection or Detection()
    ideal = fluoroscope.ideal(points_mm)
    observed = fluoroscope.distortion.distort(ideal)
    observed = observed + rng.normal(0, detection.noise_px, ideal.shape)
    visible = np.flatnonzero(points_on_image(observed, fluoroscope.image_size))
    low, high = detection.beads
    found = np.sort(rng.permutation(visible)[: rng.integers(low, high + 1)])
    seen = np.round(observed[found], DECIMALS)
    for row in np.flatnonzero(rng.random(len(found)) < detection.false_matches):
        distance = np.sum((observed[visible] - observed[found[row]]) ** 2, axis=1)
        wrong = visible[np.argsort(distance, kind='stable')[rng.integers(1, 9)]]
        seen[row] = np.round(observed[wrong], DECIMALS)
    return target_id[found], seen


CLUSTER_MARKERS = 6  # of a rigid body
# Centres of the clusters [mm]; the first two are on the one bone.
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
GRID = (52, 39)  # points of a calibration grid across and down


@dataclass(frozen=True)
class SimulatedTracking:
    """A recording of moving markers."""

    frames: Mapping[str, list[Frame]]  #: by fluoroscope
    marker_id: NDArray[np.int64]  #: (k,)
    points_mm: NDArray[np.float64]  #: (frames, k, 3) positions in the rig frame
    #: by fluoroscope the ideal image points (frames, k, 2) without noise [px]
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
    points = np.array([_markers_at(time_s, shapes) for time_s in times_s])
    points = points.reshape(len(times_s), len(ids), 3)
    frames, ideal = image_frames(
        rig, points, ids, times_s, noise_px=noise_px, rng=rng, start=start
    )
    return SimulatedTracking(frames, ids, points, ideal)


def image_frames(
    rig: VirtualRig,
    points_mm: np.ndarray,
    target_id: np.ndarray,
    times_s: Sequence[float],
    noise_px: float,
    rng: np.random.Generator,
    start: StreamStart,
) -> tuple[dict[str, list[Frame]], dict[str, NDArray[np.float64]]]:
    """Return frames of moving points and their ideal image points (T, k, 2), by fluoroscope.

    points_mm (T, k, 3) are those of the targets (k,) at times (T,). A frame has the points that
    are on the image.
    """
    frames: dict[str, list[Frame]] = {}
    ideal: dict[str, NDArray[np.float64]] = {}
    for fluoroscope in rig.fluoroscopes:
        uv = fluoroscope.ideal(points_mm.reshape(-1, 3)).reshape(*points_mm.shape[:2], 2)
        observed = fluoroscope.distortion.distort(uv.reshape(-1, 2)).reshape(uv.shape)
        observed = np.round(observed + rng.normal(0, noise_px, uv.shape), DECIMALS)
        seen = points_on_image(observed.reshape(-1, 2), fluoroscope.image_size)
        seen = seen.reshape(observed.shape[:2])
        ideal[fluoroscope.name] = uv
        frames[fluoroscope.name] = [
            start.frame(fluoroscope, t, time_s, target_id[seen[t]], observed[t, seen[t]])
            for t, time_s in enumerate(times_s)
        ]
    return frames, ideal


def _markers_at(time_s: float, shapes: list[np.ndarray]) -> np.ndarray:
    """Positions (k, 3) [mm] of all markers at a time [s]; shapes: clusters (6, 3) [mm]."""
    t = time_s
    bend = np.deg2rad(25) * np.sin(2 * np.pi * 0.5 * t)
    sway = 70 * np.array(
        [np.sin(2 * np.pi * 0.31 * t), np.cos(2 * np.pi * 0.23 * t), 0.6 * np.sin(t)]
    )
    out = []
    for number, (shape, centre) in enumerate(zip(shapes, CLUSTER_CENTRES)):
        about_x = bend if number < 2 else -bend
        turn = matrix_from_vector([about_x, 0.3 * np.sin(1.1 * t + number), 0])
        out.append((shape + centre) @ turn.T + sway)
    return np.concatenate(out) if out else np.zeros((0, 3))


def simulate_grid(
    rig: VirtualRig,
    count: int,
    seed: int = 0,
    noise_px: float = 0.25,
) -> dict[str, list[Frame]]:
    """Simulate count frames of a grid of 2,028 points in front of the detector, at 30 Hz.

    seed: the same one gives the same frames. noise_px: standard deviation of an image coordinate.
    """
    start = StreamStart()
    rng = np.random.default_rng([seed, 5])
    frames = {}
    for fluoroscope in rig.fluoroscopes:
        width, height = fluoroscope.image_size
        across = np.linspace(0.08, 0.92, GRID[0]) * width
        down = np.linspace(0.08, 0.92, GRID[1]) * height
        ideal = np.stack(np.meshgrid(across, down), axis=-1).reshape(-1, 2)
        distorted = fluoroscope.distortion.distort(ideal)
        ids = np.arange(2001, 2001 + len(ideal))
        of_fluoroscope = []
        for index in range(count):
            observed = np.round(distorted + rng.normal(0, noise_px, distorted.shape), DECIMALS)
            time_s = index / 30.0
            of_fluoroscope.append(start.frame(fluoroscope, index, time_s, ids, observed))
        frames[fluoroscope.name] = of_fluoroscope
    return frames
