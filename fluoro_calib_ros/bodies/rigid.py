# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The rigid motion that takes points to others."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def fitted_pose(
    source: np.ndarray, target: np.ndarray, weight: np.ndarray | None = None
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Rotation (3, 3) and shift (3,) that take points (k, 3) to others, by least squares.

    weight (k,): of the points, by default the same for all. Kabsch, "A solution for the best
    rotation to relate two sets of vectors", Acta Cryst. A32, 1976.
    """
    share = np.full(len(source), 1 / len(source)) if weight is None else weight / weight.sum()
    a = share @ source
    b = share @ target
    u, _, vt = np.linalg.svd((source - a).T @ (share[:, None] * (target - b)))
    sign = np.diag([1.0, 1.0, np.sign(np.linalg.det(vt.T @ u.T))])
    rotation = vt.T @ sign @ u.T
    return rotation, b - rotation @ a
