# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Relative orientation of two fluoroscopes, and the constraint that it does not change.

`relative_orientation` holds the mathematics of the constraint.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .rotations import matrix_from_vector

POSE_SIZE = 6  # translation [mm], rotation vector [rad]
# Standard deviations that stand for a rigid mounting: a thousandth of what one pair of exposures
# determines from images of 0.25 px noise. The solution is that of the limit within some 1e-5
# standard deviations, and rounding errors are still far away.
RIGID_SD_MM = 3e-4
RIGID_SD_RAD = 1e-7


@dataclass(frozen=True)
class RelativeConstraint:
    """Constraint that the relative orientation of two fluoroscopes is the same in all pairs."""

    fluoroscopes: tuple[int, int]  #: numbers of the fluoroscopes a and b
    pairs: NDArray[np.int64]  #: (k, 2) rows of the common exposures of a and of b
    #: standard deviations of each component of translation and rotation
    sd_mm: float
    sd_rad: float
    #: distance of the sources at which `sd_mm` holds; it makes the constraint follow the scale of
    #: a free network; None where the scale is fixed
    length_mm: float | None = None

    @property
    def weights(self) -> NDArray[np.float64]:
        """Weights (6,) of the components of the constraint."""
        return np.repeat([self.sd_mm**-2.0, self.sd_rad**-2.0], 3)


@dataclass(frozen=True)
class RelativePose:
    """Relative orientation of fluoroscope b with respect to a.

    rotation (3, 3) from the sensor frame of a to that of b; translation_mm (3,) of the source of b
    in the sensor frame of a.
    """

    rotation: np.ndarray
    translation_mm: np.ndarray

    def updated(self, step: np.ndarray) -> RelativePose:
        """The pose after a step (6,): translation [mm], rotation [rad] on the left."""
        step = np.asarray(step)
        return RelativePose(
            matrix_from_vector(step[3:]) @ self.rotation, self.translation_mm + step[:3]
        )
