"""Comparison of two independent calibrations of one fluoroscope, and the names of places on its
image.

As the cross-validation of mrcal does it (D. Kogan, mrcal documentation, "A tour of mrcal:
cross-validation"): two calibrations that share no exposure predict the same, but for what the
orientation absorbs and for their noise.
"""

from dataclasses import dataclass

import numpy as np

GRID = 24  # points across the image at which predictions are compared
MIN_POINTS = 20  # of the grid in both calibrated areas
# no prediction is better than this: it keeps a model without uncertainty from a division by 0
MIN_SD_PX = 1e-3


@dataclass(frozen=True)
class Difference:
    """Difference of two predictions at uv (n, 2): duv (n, 2) [px] less the gauge, and its
    predicted sd (n,) [px].
    """

    uv: np.ndarray
    duv: np.ndarray
    sd: np.ndarray

    @property
    def normalised(self):
        """Root of the mean square of the differences over their predicted standard deviations; 1
        is expected.
        """
        return float(np.sqrt(np.mean(np.sum(self.duv**2, axis=1) / (2 * self.sd**2))))

    @property
    def rms_px(self):
        """RMS of a coordinate of the differences [px]."""
        return float(np.sqrt(np.mean(self.duv**2)))

    @property
    def worst(self):
        """Point (2,) [px] with the largest difference over its standard deviation."""
        return self.uv[np.argmax(np.linalg.norm(self.duv, axis=1) / self.sd)]


def image_grid(image_size):
    """Pixels (GRID^2, 2) evenly over an image of image_size (width, height)."""
    u, v = ((np.arange(GRID) + 0.5) / GRID * size - 0.5 for size in image_size)
    return np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)


def orientation_fields(xy):
    """Displacements (2n, 6) of points xy (n, 2), in units of the principal distance, that
    orientations absorb.

    A shift of the image in both directions, its scale, its turn, and its tilt about both axes (the
    linearised projective map of a turned sensor).
    """
    x, y = np.asarray(xy, dtype=float).T
    one = np.ones_like(x)
    zero = np.zeros_like(x)
    u = np.stack([one, zero, x, -y, x * x, x * y], axis=1)
    v = np.stack([zero, one, y, x, x * y, y * y], axis=1)
    return np.stack([u, v], axis=1).reshape(-1, 6)


def difference(one, other):
    """Difference of what two calibrations predict over the image both cover, or None where that is
    too small.

    one, other: FluoroscopeCalibration. An observed pixel u stands for the ray (u - du - (xp, yp))
    / c; the rays are compared, as pixels at the mean principal distance, after the best
    combination of orientation_fields is taken off.
    """
    grid = image_grid(one.image_size)
    corrections = [c.model.evaluate(grid) for c in (one, other)]
    both = ~(corrections[0].outside | corrections[1].outside)
    if both.sum() < MIN_POINTS:
        return None
    uv = grid[both]
    rays = [
        (uv - p.duv[both] - c.interior[:2]) / c.interior[2]
        for c, p in zip((one, other), corrections)
    ]
    c_mean = (one.interior[2] + other.interior[2]) / 2
    sd = np.sqrt(sum(p.sd[both] ** 2 for p in corrections))
    sd = np.maximum(sd, MIN_SD_PX)
    d = c_mean * (rays[0] - rays[1])
    basis = orientation_fields(sum(rays) / 2)
    weight = 1 / np.repeat(sd, 2)
    fit, *_ = np.linalg.lstsq(basis * weight[:, None], d.ravel() * weight, rcond=None)
    return Difference(uv, d - (basis @ fit).reshape(-1, 2), sd)


def interior_misclosure(one, other):
    """Difference (3,) [px] of two interior orientations and its root mean square over its standard
    deviation.

    1 is expected of the second where the covariances are right.
    """
    d = one.interior - other.interior
    covariance = one.interior_covariance + other.interior_covariance
    return d, float(np.sqrt(max(d @ np.linalg.pinv(covariance, hermitian=True) @ d, 0.0) / 3))


def place_name(uv, image_size):
    """Where a pixel (2,) lies on the image, in words: 'upper left', ..., 'lower right'."""
    column, row = np.clip((np.asarray(uv) + 0.5) / np.asarray(image_size) * 3, 0, 2.999).astype(
        int
    )
    across = ('left', 'middle', 'right')[column]
    down = ('upper', 'middle', 'lower')[row]
    return 'middle' if across == down else f'{down} {across}'
