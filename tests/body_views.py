# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Corrected views of bodies for the tests, made without the package's own projection."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from fluoro_calib_ros.bodies.body import Body
from fluoro_calib_ros.photogrammetry.rig_orientation import RigOrientation
from fluoro_calib_ros.reconstruction.intersection import Intersector
from fluoro_calib_ros.reconstruction.reconstruct import CorrectedView, intersect_exposure

DISTANCE_PX = 3300.0
MIDDLE_PX = 511.5


def orientation(views=2, covariance=None, step_deg=60.0):
    """Fluoroscopes 1 m from the origin, by default 60 degrees apart."""
    rotations = []
    positions = []
    for angle in np.radians(step_deg * np.arange(views)):
        position = 1000 * np.array([np.sin(angle), 0, -np.cos(angle)])
        z = -position / 1000
        y = np.array([0.0, 1.0, 0.0])
        rotations.append(np.stack([np.cross(y, z), y, z]))
        positions.append(position)
    names = tuple('abc'[:views])
    return RigOrientation(
        names,
        np.tile([MIDDLE_PX, MIDDLE_PX, DISTANCE_PX], (views, 1)),
        np.array(rotations),
        np.array(positions),
        np.zeros((9 * views, 9 * views)) if covariance is None else covariance,
        'rig',
        'capture',
        names,
    )


@dataclass(frozen=True)
class Noise:
    """Noise of image points: standard deviations of the random part and of the correction."""

    px: float = 0.2
    correction_px: float = 0.0
    shift: np.ndarray | None = None  # (F, n, 2), error of the correction [px]; None for no error


def project(rig, points, errors=None):
    """Image points (F, n, 2) of points (n, 3); errors (9F,) of the orientation."""
    out = []
    for f in range(len(rig.fluoroscopes)):
        d = np.zeros(9) if errors is None else errors[9 * f : 9 * f + 9]
        turn = Rotation.from_rotvec(d[3:6]).as_matrix() @ rig.rotation[f]
        x, y, z = turn @ (points - rig.position_mm[f] - d[:3]).T
        xp, yp, c = rig.interior[f] + d[6:]
        out.append(np.stack([xp + c * x / z, yp + c * y / z], axis=1))
    return np.array(out)


def exposure(rig, ids, uv, noise, reject=4.0):
    """Return IntersectedViews of image points (F, n, 2); NaN marks points that are not seen."""
    total = np.full(len(ids), np.hypot(noise.px, noise.correction_px))
    views = [
        CorrectedView(
            np.asarray(ids),
            of_view,
            total,
            np.full(len(ids), noise.correction_px),
            np.zeros(len(ids), dtype=bool),
        )
        for of_view in uv
    ]
    return intersect_exposure(views, Intersector(rig, reject))


def observed(rig, ids, points, rng, noise=Noise(), errors=None):
    """Return IntersectedViews of the noisy projections of points (n, 3)."""
    uv = project(rig, points, errors)
    shift = np.zeros_like(uv) if noise.shift is None else noise.shift
    return exposure(rig, ids, uv + shift + rng.normal(0, noise.px, uv.shape), noise)


def body(rng, markers=4, name='femur', first=1, sd=0.0, half=15.0):
    """Return a body with markers in a cube away from its origin; they are not nearly collinear."""
    across = 0.0
    while across < half:
        xyz = rng.uniform(-half, half, (markers, 3)) + [80.0, 0.0, 40.0]
        across = np.linalg.svd(xyz - xyz.mean(axis=0), compute_uv=False)[1]
    return Body(name, np.arange(first, first + markers), xyz, np.full(markers, sd))
