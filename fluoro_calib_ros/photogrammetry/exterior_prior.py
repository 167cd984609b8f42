# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Exterior orientations that are known beforehand: weighted observations of the adjustment."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .rotations import vector_from_matrix

# Standard deviations that stand for an orientation that is held: a thousandth of what images of
# 0.25 px noise determine.
HELD_SD_MM = 3e-4
HELD_SD_RAD = 1e-7


@dataclass(frozen=True)
class ExteriorPrior:
    """Exterior orientations of m exposures as observed.

    Attributes
    ----------
    rotation : (m, 3, 3) ndarray
        Rotations phantom -> sensor.
    position_mm : (m, 3) ndarray
        Positions of the sources.
    sd : (m, 6) ndarray
        Standard deviations of the positions [mm] and of the rotations about the axes of the
        sensor [rad].
    """

    rotation: np.ndarray
    position_mm: np.ndarray
    sd: np.ndarray

    @property
    def weights(self) -> np.ndarray:
        """Weights (m, 6) of the components."""
        return 1 / self.sd**2

    def discrepancies(self, rotation: np.ndarray, position_mm: np.ndarray) -> np.ndarray:
        """Discrepancies (m, 6) of orientations from the observed ones.

        Those of a rotation R are log(R R0^T), whose derivative by a rotation on the left is the
        unit matrix to first order (Barfoot, "State Estimation for Robotics", 2017, 7.1).
        """
        turned = rotation @ self.rotation.transpose(0, 2, 1)
        return np.concatenate([position_mm - self.position_mm, vector_from_matrix(turned)], axis=1)
