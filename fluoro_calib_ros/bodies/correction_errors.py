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
SAMPLE = 100  # number of exposures that suffice to locate a marker


def covariance_of_means(uv: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return covariances (F, m, m) of m markers' mean errors over T exposures, for unit variance.

    uv (T, m, F, 2): image points in units of the longer side of the images, NaN where not seen.
    The covariance is the mean correlation of the errors of two markers in any two exposures; it is
    0 for a marker that is not seen.
    """
    out = []
    for path in np.moveaxis(uv, (2, 1), (0, 1)):
        samples = [_sample(track[np.isfinite(track).all(axis=1)]) for track in path]
        points = np.concatenate(samples)
        counts = np.array([len(sample) for sample in samples])
        marker = np.repeat(np.arange(len(counts)), counts)
        share = (marker == np.arange(len(counts))[:, None]) / np.maximum(counts, 1)[:, None]
        sums = [np.exp(-cdist(sample, points) / REACH).sum(axis=0) for sample in samples]
        out.append(np.array(sums) @ share.T / np.maximum(counts, 1)[:, None])
    return np.array(out)


def _sample(track: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return up to SAMPLE evenly spread image points (n, 2) of a marker that is seen."""
    return track[np.linspace(0, len(track) - 1, min(len(track), SAMPLE)).astype(int)]
