# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Markers in space: projection into the observed image, and poses of rigid clusters."""

from __future__ import annotations

import numpy as np

from ..correction.fluoroscope_calibration import FluoroscopeCalibration
from ..photogrammetry.rig_orientation import RigOrientation

STEPS = 3  # the correction changes slowly


def project_observed(
    orientation: RigOrientation,
    view: int,
    calibration: FluoroscopeCalibration,
    xyz: np.ndarray,
    angle: float | None = None,
) -> np.ndarray:
    """Observed pixels (k, 2) of points (k, 3) in the rig frame [mm].

    view is the row of the fluoroscope in the orientation; angle that of its C-arm [rad], None
    where it is unknown. The correction is a function of the
    observed pixel, so it is solved for by fixed-point iteration; where it is not defined, it is 0.
    """
    xp, yp, c = orientation.interior[view]
    sensor = (xyz - orientation.position_mm[view]) @ orientation.rotation[view].T
    ideal = sensor[:, :2] * (c / sensor[:, 2:]) + np.array([xp, yp])
    observed = ideal
    for _ in range(STEPS):
        u, v, _, _, _ = calibration.correct_arrays(
            observed[:, 0].copy(), observed[:, 1].copy(), angle=angle
        )
        step = ideal - np.stack([u, v], axis=1)
        observed = observed + np.where(np.isfinite(step), step, 0.0)
    return observed


def fitted_pose(source: np.ndarray, target: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rotation (3, 3) and shift (3,) that take points (k, 3) to others, by least squares.

    Kabsch, "A solution for the best rotation to relate two sets of vectors", Acta Cryst. A32,
    1976.
    """
    a = source.mean(axis=0)
    b = target.mean(axis=0)
    u, _, vt = np.linalg.svd((source - a).T @ (target - b))
    sign = np.diag([1.0, 1.0, np.sign(np.linalg.det(vt.T @ u.T))])
    rotation = vt.T @ sign @ u.T
    return rotation, b - rotation @ a
