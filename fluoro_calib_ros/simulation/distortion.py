"""Distortion fields of a virtual fluoroscope.

A field gives the correction (du, dv) [px] as a function of the observed pixel, so that undistorted
= observed - (du, dv). It has the parts that image intensifiers are known for (Gronenschild,
Medical Physics 24, 1997): pincushion of the curved input screen, S-shape of the earth's magnetic
field, spiral of a field along the axis, and local ripples of screen and optics.
"""

from dataclasses import dataclass

import numpy as np

EDGE_PX = 512.0  # half of the image of 1024 pixels: the fields below are given by their size there


@dataclass(frozen=True)
class DistortionField:
    """Correction field, callable with pixels (n, 2), that gives (n, 2) [px].

    centre (2,) [px]; pincushion, s_shape (2,) and spiral: their size at the edge of the image
    [px]; ripples (k, 5): centre u, v, width, and height in u and v of Gaussian bumps [px].
    """

    centre: np.ndarray
    pincushion: float
    s_shape: np.ndarray
    spiral: float
    ripples: np.ndarray

    def __call__(self, uv):
        uv = np.asarray(uv, dtype=float)
        x = (uv - self.centre) / EDGE_PX
        r2 = np.sum(x * x, axis=1, keepdims=True)
        turned = np.stack([-x[:, 1], x[:, 0]], axis=1)
        # The S of each line: a cubic that leaves the centre and the two thirds' point in place.
        s = x[:, ::-1] * (x[:, ::-1] ** 2 - 0.4) / 0.6
        out = r2 * (self.pincushion * x + self.spiral * turned) + self.s_shape * s
        for u, v, width, height_u, height_v in self.ripples:
            bump = np.exp(-np.sum((uv - (u, v)) ** 2, axis=1) / (2 * width**2))
            out += bump[:, None] * (height_u, height_v)
        return out

    def distort(self, uv):
        """Observed pixels (n, 2) whose undistorted positions are uv (n, 2) (fixed-point
        iteration).
        """
        uv = np.asarray(uv, dtype=float)
        observed = uv + self(uv)
        for _ in range(100):
            last = observed
            observed = uv + self(observed)
            if np.max(np.abs(observed - last), initial=0.0) < 1e-11:
                break
        return observed


def random_field(rng, strength=1.0, image_size=(1024, 1024)):
    """A field drawn at random: at strength 1 some 15 px along the rim of the image, 26 to 35 px in
    its corners.
    """
    sign = rng.choice([-1.0, 1.0], size=4)
    centre = np.asarray(image_size) / 2 - 0.5 + rng.uniform(-20, 20, 2)
    count = 14
    ripples = np.column_stack(
        [
            rng.uniform(0, image_size[0], count),
            rng.uniform(0, image_size[1], count),
            rng.uniform(70, 130, count),
            rng.uniform(-1.2, 1.2, (count, 2)),
        ]
    )
    ripples[:, 3:] *= strength
    return DistortionField(
        centre,
        strength * rng.uniform(9.0, 10.2),
        strength * sign[:2] * rng.uniform(1.2, 2.4, 2),
        strength * sign[2] * rng.uniform(1.2, 2.4),
        ripples,
    )
