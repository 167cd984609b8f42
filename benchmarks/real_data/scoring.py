# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Residuals of unseen exposures with estimated poses, and targets estimated within their survey.

The camera is fixed, and all cameras are treated alike. The pose of the targets minimises a robust
sum of residuals (scipy's soft L1, scale one pixel) in observed pixels: residuals of a camera that
corrects pixels are divided by the derivative of the correction. Surveys have errors, and a camera
that was calibrated with fixed targets has learned some of them. Targets are therefore also
estimated, alternating with the poses, with their surveyed coordinates as observations.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import cv2
import numpy as np
from scipy.optimize import least_squares
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from fluoro_calib_ros.correction.fluoroscope_calibration import FluoroscopeCalibration
from fluoro_calib_ros.exposures.frame import Frame
from fluoro_calib_ros.exposures.phantom import Phantom

STEP_PX = 0.5  # step for the derivative of a correction
FAR_PX = 1e4
ROUNDS = 8  # alternations between poses and targets
NU = 10.0  # degrees of freedom in the weights of rays that move a target
MEDIAN_OF_NORM = 1.18  # median length of a vector of two standard normal variables
MIN_SD_PX = 1e-3
# An image point is a false match if it deviates by this many robust standard deviations for every
# camera.
GROSS = 8.0
GROSS_PX = 1.0
# A calibration has failed if its typical residual is this many times that of the best camera.
FAILED = 30.0


# Residuals (n, 2) [px] of an exposure for a pose (6,) and targets (n, 3).
Residuals = Callable[[np.ndarray, np.ndarray], np.ndarray]


class Camera(Protocol):
    """Interface of a scored camera."""

    def residuals(self, frame: Frame) -> Residuals:
        """Return the residuals of a frame as a function of pose and targets."""


@dataclass(frozen=True)
class RayCamera:
    """A camera defined by the directions x/z, y/z of pixels (n, 2)."""

    rays: Callable[[np.ndarray], np.ndarray]

    def residuals(self, frame: Frame) -> Residuals:
        """Return the residuals of a frame; see `Camera`."""
        ray = self.rays(frame.uv)
        steps = STEP_PX * np.eye(2)
        derivative = np.stack(
            [
                (self.rays(frame.uv + step) - self.rays(frame.uv - step)) / (2 * STEP_PX)
                for step in steps
            ],
            axis=2,
        )
        to_px = np.linalg.inv(derivative)

        def of_pose(pose: np.ndarray, xyz: np.ndarray) -> np.ndarray:
            x = Rotation.from_rotvec(pose[:3]).apply(xyz) + pose[3:]
            return (to_px @ (ray - x[:, :2] / x[:, 2:])[..., None])[..., 0]

        return of_pose


@dataclass(frozen=True)
class OpenCVCamera:
    """An OpenCV camera: matrix (3, 3) and distortion coefficients."""

    matrix: np.ndarray
    distortion: np.ndarray

    def residuals(self, frame: Frame) -> Residuals:
        """Return the residuals of a frame; see `Camera`."""

        def of_pose(pose: np.ndarray, xyz: np.ndarray) -> np.ndarray:
            uv, _ = cv2.projectPoints(xyz, pose[:3], pose[3:], self.matrix, self.distortion)
            return frame.uv - uv.reshape(-1, 2)

        return of_pose


def calibrated_camera(calibration: FluoroscopeCalibration) -> RayCamera:
    """Return a calibration of this package as a camera."""
    xp, yp, c = calibration.interior

    def rays(uv: np.ndarray) -> np.ndarray:
        return (uv - calibration.model.predict(uv) - [xp, yp]) / c

    return RayCamera(rays)


def unseen_residuals(
    camera: Camera,
    frames: Sequence[Frame],
    phantom: Phantom,
    start: Mapping[int, np.ndarray],
) -> tuple[np.ndarray, np.ndarray]:
    """Return residuals (N, 2) [px] of frames with fixed survey, and with estimated targets.

    start: approximate poses (6,) by frame number.
    """
    of_frames = [camera.residuals(frame) for frame in frames]
    rows = [phantom.index(frame.target_id) for frame in frames]
    poses = [start[frame.number] for frame in frames]
    xyz = phantom.xyz_mm.copy()
    held = None
    for _ in range(ROUNDS):
        poses = [
            _pose(of_frame, xyz[row], pose) for of_frame, row, pose in zip(of_frames, rows, poses)
        ]
        residuals = [
            of_frame(pose, xyz[row]) for of_frame, row, pose in zip(of_frames, rows, poses)
        ]
        if held is None:
            held = np.concatenate(residuals)
        _move_targets(xyz, phantom, of_frames, rows, poses)
    last = [of_frame(pose, xyz[row]) for of_frame, row, pose in zip(of_frames, rows, poses)]
    assert held is not None
    return held, np.concatenate(last)


def _pose(of_frame: Residuals, xyz: np.ndarray, start: np.ndarray) -> np.ndarray:
    """Estimate the pose (6,) of an exposure with targets (n, 3)."""
    size = float(np.linalg.norm(start[3:]))
    scale = np.array([1, 1, 1, size, size, size])

    def residuals(x: np.ndarray) -> np.ndarray:
        r = of_frame(x * scale, xyz).ravel()
        return np.nan_to_num(r, nan=FAR_PX, posinf=FAR_PX, neginf=-FAR_PX)

    found = least_squares(
        residuals, start / scale, loss='soft_l1', x_scale='jac', xtol=1e-9, ftol=1e-9
    )
    return found.x * scale


def _move_targets(
    xyz: np.ndarray,
    phantom: Phantom,
    of_frames: Sequence[Residuals],
    rows: Sequence[np.ndarray],
    poses: Sequence[np.ndarray],
) -> None:
    """Move targets (n, 3) by one robust Gauss-Newton step with fixed poses."""
    normal = np.zeros((len(xyz), 3, 3))
    right = np.zeros((len(xyz), 3))
    parts = []
    for of_frame, row, pose in zip(of_frames, rows, poses):
        step = 1e-3 * float(np.median(phantom.sd_mm)) + 1e-6
        r = of_frame(pose, xyz[row])
        derivative = np.stack(
            [(of_frame(pose, xyz[row] + step * e) - r) / step for e in np.eye(3)], axis=2
        )
        parts.append((row, r, derivative))
    sizes = np.concatenate([np.linalg.norm(r, axis=1) for _, r, _ in parts])
    sd = max(float(np.nanmedian(sizes)) / MEDIAN_OF_NORM, MIN_SD_PX)
    for row, r, derivative in parts:
        weight = 1 / (1 + np.sum(r**2, axis=1) / (NU * sd**2))
        weight = np.where(np.isfinite(weight), weight, 0.0) / sd**2
        derivative = np.nan_to_num(derivative)
        np.add.at(
            normal, row, weight[:, None, None] * (derivative.transpose(0, 2, 1) @ derivative)
        )
        gradient = (derivative.transpose(0, 2, 1) @ np.nan_to_num(r)[..., None])[..., 0]
        np.add.at(right, row, -weight[:, None] * gradient)
    prior = 1 / phantom.sd_mm**2
    normal += prior[:, None, None] * np.eye(3)
    right -= prior[:, None] * (xyz - phantom.xyz_mm)
    xyz += np.linalg.solve(normal, right[..., None])[..., 0]


def inside_hull(training: Sequence[Frame], uv: np.ndarray) -> np.ndarray:
    """Return whether pixels (n, 2) are in the convex hull of the image points of exposures."""
    hull = ConvexHull(np.concatenate([frame.uv for frame in training]))
    return (uv @ hull.equations[:, :2].T + hull.equations[:, 2] <= 1e-9).all(axis=1)


def solved(residuals: Mapping[str, np.ndarray]) -> list[str]:
    """Return the cameras whose calibration has not failed, from residuals (n, 2) by camera."""
    size = {name: float(np.median(np.linalg.norm(r, axis=1))) for name, r in residuals.items()}
    best = min(value for value in size.values() if np.isfinite(value))
    return [name for name, value in size.items() if value <= FAILED * best]


def false_matches(residuals: Mapping[str, np.ndarray]) -> np.ndarray:
    """Return image points (n,) that no camera explains, from residuals (n, 2) by camera."""
    out = np.ones(len(next(iter(residuals.values()))), dtype=bool)
    for r in residuals.values():
        size = np.linalg.norm(r, axis=1)
        out &= size > max(GROSS * float(np.median(size)) / MEDIAN_OF_NORM, GROSS_PX)
    return out


def rms(residuals: np.ndarray) -> float:
    """Return the RMS of a coordinate of residuals (n, 2), NaN if there are none."""
    return float(np.sqrt(np.mean(residuals**2))) if len(residuals) else float('nan')
