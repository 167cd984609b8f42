# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Images of a virtual fluoroscope: dark beads on a smooth background with noise."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, DTypeLike

BEAD_PX = 3.0  # standard deviation of a blob
CONTRAST = 0.55  # fraction of the light that a bead absorbs
REACH = 5.5  # extent of a drawn blob, in standard deviations: beyond, it is invisible in 16 bits
BRIGHTNESS = 0.78  # grey value in the middle of the image, as a fraction of the maximum


def bead_image(
    uv: ArrayLike,
    image_size: tuple[int, int] = (1024, 1024),
    dtype: DTypeLike = np.uint8,
    bead_px: float = BEAD_PX,
    contrast: float = CONTRAST,
    noise: float = 0.01,
    seed: int = 0,
) -> np.ndarray:
    """Draw an image of beads.

    Each bead attenuates the light behind it, so two overlapping beads absorb more than one. Beads
    outside the image are drawn as far as they extend into it.

    Parameters
    ----------
    uv : array_like
        (n, 2), observed pixels of the beads.
    image_size : tuple of int
        Width and height [px].
    dtype : numpy.uint8 or numpy.uint16
    bead_px : float
        Standard deviation of a blob.
    contrast : float
        Fraction of the light that a bead absorbs.
    noise : float
        Standard deviation of a grey value, as a fraction of the largest one.
    seed : int
        The same seed gives the same noise.

    Returns
    -------
    ndarray
        (h, w)
    """
    largest = np.iinfo(dtype).max
    image = background(image_size)
    for u, v in np.asarray(uv, dtype=float).reshape(-1, 2):
        _draw_bead(image, (u, v), bead_px, contrast)
    image *= largest
    if noise:
        image += np.float32(noise * largest) * np.random.default_rng(seed).standard_normal(
            image.shape, dtype=np.float32
        )
    return np.clip(np.rint(image, out=image), 0, largest, out=image).astype(dtype)


def background(image_size: tuple[int, int]) -> np.ndarray:
    """Return object-free light (h, w) from 0 to 1: brightest in the middle, darker to one side."""
    width, height = image_size
    x = np.linspace(-1, 1, width, dtype=np.float32)
    y = np.linspace(-1, 1, height, dtype=np.float32)[:, None]
    return BRIGHTNESS * (1 - np.float32(0.22) * (x * x + y * y) + np.float32(0.05) * x)


def _draw_bead(
    image: np.ndarray, uv: tuple[float, float], bead_px: float, contrast: float
) -> None:
    """Subtract the light absorbed by a bead at pixel uv from an image (h, w)."""
    u, v = uv
    if not (np.isfinite(u) and np.isfinite(v)):
        return
    columns = _range_around(u, REACH * bead_px)
    rows = _range_around(v, REACH * bead_px)
    part = image[rows, columns]
    if not part.size:
        return
    x = np.arange(columns.start, columns.start + part.shape[1])
    y = np.arange(rows.start, rows.start + part.shape[0])
    along_u = np.exp(-0.5 * ((x - u) / bead_px) ** 2)
    along_v = np.exp(-0.5 * ((y - v) / bead_px) ** 2)
    part *= 1 - contrast * along_v[:, None] * along_u


def _range_around(centre: float, reach: float) -> slice:
    """Return the slice of nonnegative pixels of a row or column within `reach` of a coordinate."""
    start = max(0, int(np.ceil(centre - reach)))
    stop = max(0, int(np.floor(centre + reach)) + 1)
    return slice(start, stop)
