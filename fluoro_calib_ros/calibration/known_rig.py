# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Orientation of a rig whose fluoroscopes were calibrated with known orientations."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from ..photogrammetry.exterior_prior import HELD_SD_MM, HELD_SD_RAD
from ..photogrammetry.rig_orientation import ORIENTATION_SIZE, RigOrientation
from ..photogrammetry.rotations import matrix_from_quaternion
from .calibrate import FluoroscopeResult
from .initial_network import Known
from .result import FluoroscopeCalibration

FRAME_ID = 'lab'


def orientation_of_known(
    known: Known,
    figures: Mapping[str, FluoroscopeResult],
    calibrations: Mapping[str, FluoroscopeCalibration],
) -> RigOrientation:
    """Return the orientation of the rig in the frame in which its fluoroscopes are known.

    It is the mean of those of the exposures: the known one where it is held, else the weighted
    one. Its standard deviations are the given ones: an error of a known orientation is the same in
    all exposures.
    """
    names = tuple(figures)
    rotations = np.array([_mean_rotation(figures[name]) for name in names])
    positions = np.array(
        [np.mean([e.position_mm for e in figures[name].exposures], axis=0) for name in names]
    )
    size = ORIENTATION_SIZE * len(names)
    covariance = np.zeros((size, size))
    for f, name in enumerate(names):
        sd_mm, sd_rad = known[name].exterior_sd or (HELD_SD_MM, HELD_SD_RAD)
        at = slice(ORIENTATION_SIZE * f, ORIENTATION_SIZE * (f + 1))
        own = np.diag(np.repeat([sd_mm**2, sd_rad**2, 0.0], 3))
        own[6:, 6:] = calibrations[name].interior_covariance
        covariance[at, at] = own
    used = [calibrations[name] for name in names]
    return RigOrientation(
        names,
        np.array([calibration.interior for calibration in used]),
        rotations,
        positions,
        covariance,
        FRAME_ID,
        'capture',
        tuple(calibration.calibration_id for calibration in used),
        max(calibration.stamp_ns for calibration in used),
        min(calibration.exposures for calibration in used),
        tuple(c.frame_id or f'{name}_optical' for name, c in zip(names, used)),
    ).rounded()


def _mean_rotation(figures: FluoroscopeResult) -> np.ndarray:
    """Mean rotation (3, 3) of exposures: the nearest to the sum of their matrices."""
    total = matrix_from_quaternion([e.quaternion_wxyz for e in figures.exposures]).sum(axis=0)
    u, _, vt = np.linalg.svd(total)
    return u @ vt
