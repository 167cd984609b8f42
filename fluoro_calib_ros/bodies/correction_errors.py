# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Errors of the correction that markers share, and that are constant while they move little."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.distance import cdist

# The errors of a correction at two pixels are correlated by exp(-distance / REACH). Unit: longer
# side of the image, as measured by benchmarks/reach.py.
REACH = 0.15


def covariance_of_means(uv: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return covariances (F, m, m) of m markers' mean errors over T exposures, for unit variance.

    uv (T, m, F, 2): image points in units of the longer side of the images, NaN where not seen.
    The covariance is the mean correlation of the errors of two markers in any two exposures; it is
    0 for a marker that is not seen.
    """
    # 100 evenly spread exposures of a recording suffice to locate its markers.
    rows = np.unique(np.linspace(0, len(uv) - 1, 100).astype(int))
    out = []
    for path in np.moveaxis(uv[rows], 2, 0):
        seen = np.isfinite(path).all(axis=2)
        share = seen / np.maximum(seen.sum(axis=0), 1)
        flat = np.where(seen[..., None], path, 0.0).reshape(-1, 2)
        correlation = np.exp(-cdist(flat, flat) / REACH).reshape(*seen.shape, *seen.shape)
        out.append(np.einsum('tk,tksl,sl->kl', share, correlation, share, optimize=True))
    return np.array(out)
