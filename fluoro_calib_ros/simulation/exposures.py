# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Simulated exposures of the phantom, with their truth."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..exposures.frame import Frame, points_on_image
from ..photogrammetry.rotations import matrix_from_vector
from .rig import Pose, VirtualFluoroscope, VirtualRig
from .streams import DECIMALS, StreamStart


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

    Parameters
    ----------
    rig : VirtualRig
    count : int
        Number of poses.
    seed : int
        The same seed gives the same exposures.
    detection : Detection, optional
    start : StreamStart, optional
    interval_s : float
        Time between exposures.

    Returns
    -------
    SimulatedExposures
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

    Parameters
    ----------
    rng : numpy.random.Generator
    fluoroscope : VirtualFluoroscope
    points_mm : ndarray
        (k, 3), beads in the rig frame.
    target_id : ndarray
        (k,)
    detection : Detection, optional

    Returns
    -------
    target_id : ndarray
        (n,), ids of the detected beads.
    observed : ndarray
        (n, 2) [px].
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
