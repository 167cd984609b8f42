# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Calibrations of the same exposures by OpenCV and mrcal."""

from __future__ import annotations

import os
import subprocess
import tempfile
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from fluoro_calib_ros.exposures.frame import Frame
from fluoro_calib_ros.exposures.phantom import Phantom

from .scoring import OpenCVCamera, RayCamera

MODELS = {
    'OpenCV Brown': 0,
    'OpenCV rational': cv2.CALIB_RATIONAL_MODEL,
    'OpenCV tilted': (
        cv2.CALIB_RATIONAL_MODEL | cv2.CALIB_THIN_PRISM_MODEL | cv2.CALIB_TILTED_MODEL
    ),
}
MRCAL_MODELS = {
    'mrcal OpenCV8': 'LENSMODEL_OPENCV8',
    'mrcal splined': 'LENSMODEL_SPLINED_STEREOGRAPHIC_order=3_Nx={nx}_Ny={ny}_fov_x_deg={fov}',
}
MRCAL_SCRIPT = Path(__file__).with_name('mrcal_fit.py')
STOP = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 300, 1e-12)
DISTORTION_SIZE = 14
MIN_FOV_DEG = 30.0
FOV_MARGIN = 1.15


def _points(frame: Frame, phantom: Phantom) -> np.ndarray:
    """Return surveyed coordinates (n, 3) [mm] of the targets of a frame."""
    return phantom.xyz_mm[phantom.index(frame.target_id)]


def calibrate_with_opencv(
    frames: Sequence[Frame], phantom: Phantom, interior: np.ndarray, flags: int
) -> tuple[OpenCVCamera, list[np.ndarray]]:
    """Return the camera by cv2.calibrateCamera, and the poses (6,) of the frames.

    interior (3,) [px]: initial values, which OpenCV requires for non-planar targets.
    """
    xp, yp, c = interior
    matrix = np.array([[c, 0, xp], [0, c, yp], [0, 0, 1.0]])
    _, matrix, distortion, rotations, shifts = cv2.calibrateCamera(
        [_points(frame, phantom).astype(np.float32) for frame in frames],
        [frame.uv.astype(np.float32) for frame in frames],
        frames[0].image_size,
        matrix,
        np.zeros(DISTORTION_SIZE),
        flags=flags | cv2.CALIB_USE_INTRINSIC_GUESS,
        criteria=STOP,
    )
    poses = [np.concatenate([r.ravel(), t.ravel()]) for r, t in zip(rotations, shifts)]
    return OpenCVCamera(matrix, distortion), poses


def calibrate_with_mrcal(
    python: str,
    frames: Sequence[Frame],
    phantom: Phantom,
    start: tuple[OpenCVCamera, list[np.ndarray]],
    pixels: np.ndarray,
) -> dict[str, RayCamera]:
    """Return cameras by mrcal, which runs in a separate interpreter.

    start: camera and poses by OpenCV. pixels (n, 2): pixels whose directions will be needed.
    """
    camera, poses = start
    size = frames[0].image_size
    fov = 2 * np.rad2deg(np.arctan(FOV_MARGIN * np.hypot(*size) / 2 / camera.matrix[0, 0]))
    fov = max(round(float(fov)), MIN_FOV_DEG)
    count = np.repeat(np.arange(len(frames)), [len(frame.uv) for frame in frames])
    names = {name: model.format(nx=11, ny=8, fov=int(fov)) for name, model in MRCAL_MODELS.items()}
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / 'task.npz'
        np.savez(
            path,
            uv=np.concatenate([frame.uv for frame in frames]),
            row=np.concatenate([phantom.index(frame.target_id) for frame in frames]),
            exposure=count,
            xyz=phantom.xyz_mm,
            poses=np.array(poses),
            size=size,
            matrix=camera.matrix,
            distortion=np.resize(np.append(camera.distortion.ravel()[:5], [0, 0, 0]), 8),
            pixels=pixels,
            names=list(names),
            models=list(names.values()),
        )
        # The interpreter has its own packages.
        environment = {k: v for k, v in os.environ.items() if k != 'PYTHONPATH'}
        done = subprocess.run(
            [python, str(MRCAL_SCRIPT), str(path)],
            env=environment,
            capture_output=True,
            text=True,
            check=False,
        )
        if done.returncode:
            raise RuntimeError(f'mrcal: {done.stderr.strip().splitlines()[-1:]}')
        with np.load(path.with_name('result.npz')) as found:
            rays = {name: found[name] for name in names if name in found}
    order = {tuple(pixel): i for i, pixel in enumerate(pixels.tolist())}

    def camera_of(table: np.ndarray) -> RayCamera:
        return RayCamera(lambda uv: table[[order[tuple(pixel)] for pixel in uv.tolist()]])

    return {name: camera_of(table) for name, table in rays.items()}
