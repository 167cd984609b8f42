# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Distortion fields of a virtual fluoroscope.

A field gives the correction (du, dv) [px] as a function of the observed pixel, so that undistorted
= observed - (du, dv). It has the parts that image intensifiers are known for (Gronenschild,
Medical Physics 24, 1997): the pincushion of the curved input screen, the S shape of the earth's
magnetic field, the spiral of a field along the axis, and local ripples of screen and optics.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

EDGE_PX = 512.0  # half the width of an image; the parts of a field are given by their size there
MAX_ITERATIONS = 100
TOLERANCE_PX = 1e-11
RIPPLES = 14


@dataclass(frozen=True)
class DistortionField:
    """Correction field: a function of pixels (n, 2) that returns corrections (n, 2) [px].

    Attributes
    ----------
    centre : ndarray
        (2,) [px].
    pincushion, spiral : float
        Size at the edge of the image [px].
    s_shape : ndarray
        (2,), size along u and v at the edge of the image [px].
    ripples : ndarray
        (k, 5), Gaussian bumps: centre u, v, width, and height along u and v [px].
    """

    centre: NDArray[np.float64]
    pincushion: float
    s_shape: NDArray[np.float64]
    spiral: float
    ripples: NDArray[np.float64]

    def __call__(self, uv: ArrayLike) -> np.ndarray:
        """Corrections (n, 2) [px] of observed pixels uv (n, 2)."""
        uv = np.asarray(uv, dtype=float)
        x = (uv - self.centre) / EDGE_PX
        r2 = np.sum(x * x, axis=1, keepdims=True)
        turned = np.stack([-x[:, 1], x[:, 0]], axis=1)
        # The S of each line: a cubic that leaves the centre and the point at two thirds in place.
        s = x[:, ::-1] * (x[:, ::-1] ** 2 - 0.4) / 0.6
        out = r2 * (self.pincushion * x + self.spiral * turned) + self.s_shape * s
        for u, v, width, height_u, height_v in self.ripples:
            bump = np.exp(-np.sum((uv - (u, v)) ** 2, axis=1) / (2 * width**2))
            out += bump[:, None] * (height_u, height_v)
        return out

    def distort(self, uv: ArrayLike) -> np.ndarray:
        """Observed pixels (n, 2) of undistorted ones uv (n, 2), by fixed-point iteration."""
        uv = np.asarray(uv, dtype=float)
        observed = uv + self(uv)
        for _ in range(MAX_ITERATIONS):
            last = observed
            observed = uv + self(observed)
            if np.max(np.abs(observed - last), initial=0.0) < TOLERANCE_PX:
                break
        return observed


def random_field(
    rng: np.random.Generator, strength: float = 1.0, image_size: tuple[int, int] = (1024, 1024)
) -> DistortionField:
    """Draw a field at random.

    At strength 1 it is some 15 px along the border of the image and 26 to 35 px in its corners.
    """
    sign = rng.choice([-1.0, 1.0], size=4)
    centre = np.asarray(image_size) / 2 - 0.5 + rng.uniform(-20, 20, 2)
    ripples = np.column_stack(
        [
            rng.uniform(0, image_size[0], RIPPLES),
            rng.uniform(0, image_size[1], RIPPLES),
            rng.uniform(70, 130, RIPPLES),
            rng.uniform(-1.2, 1.2, (RIPPLES, 2)),
        ]
    )
    ripples[:, 3:] *= strength
    pincushion = strength * rng.uniform(9.0, 10.2)
    s_shape = strength * sign[:2] * rng.uniform(1.2, 2.4, 2)
    spiral = strength * sign[2] * rng.uniform(1.2, 2.4)
    return DistortionField(centre, pincushion, s_shape, spiral, ripples)
