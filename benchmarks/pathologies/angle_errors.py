# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Errors of a correction at angles of a C-arm, with fixed or free interior orientation."""

import numpy as np
from scipy.optimize import least_squares

from fluoro_calib_ros.estimation.estimator import GaugeKind, gauge_coefficients
from fluoro_calib_ros.photogrammetry.rotations import matrix_from_vector

TURN_SCALE = 1e-3  # rad


class Truth:
    """True corrections of a camera at pixels (n, 2), in a gauge over the first `count` of them."""

    def __init__(self, camera, pixels, count, interior):
        self.pixels = pixels
        self.count = count
        self.interior = interior
        self.back = np.linalg.inv(_matrix(camera.interior))

    def seen_by(self, x, true):
        """Return true corrections (n, 2) for interior orientation and sensor rotation x (6,)."""
        ideal = np.column_stack([self.pixels - true, np.ones(len(self.pixels))])
        turned = ideal @ (_matrix(x[:3]) @ matrix_from_vector(x[3:]) @ self.back).T
        return self.pixels - turned[:, :2] / turned[:, 2:]

    def gauge(self, true, found, held=None):
        """Return the orientation (6,) for which true and found corrections agree in the gauge.

        held (3,): fixed interior orientation; None: it is free.
        """
        kind = GaugeKind.FULL if held is None else GaugeKind.TURNS
        uv = self.pixels[: self.count]

        def whole(x):
            return x if held is None else np.concatenate([held, x])

        def misclosure(x):
            left = (self.seen_by(whole(x), true) - found)[: self.count]
            return gauge_coefficients(uv, left, self.interior, kind)

        turn = np.zeros(3)
        start = turn if held is not None else np.concatenate([self.interior, turn])
        scale = np.append(np.ones(len(start) - 3), np.full(3, TURN_SCALE))
        return whole(least_squares(misclosure, start, x_scale=scale, xtol=1e-14).x)


def _matrix(k):
    return np.array([[k[2], 0, k[0]], [0, k[2], k[1]], [0, 0, 1.0]])


def errors_at_angles(scene, calibration, uv, grid, angles, free_field=None):
    """Return errors (n, 2) and stated sd (n,) of fluoroscope a at pixels grid (g, 2), all angles.

    uv: image points of the fit. The result has the key 'held', where the truth is in the gauge of
    the mean correction over the exposures with a rotation of the sensor at each angle. If
    free_field is given, a field without variance of a change of the interior orientation, the
    result also has the key 'free': see `angle_claims`.
    """
    pixels = np.concatenate([uv, grid])
    camera = scene.cameras[0]
    truth = Truth(camera, pixels, len(uv), calibration.interior)

    def true_at(angle):
        return camera.at(scene.case, angle).distortion.correction(pixels)

    mean = np.mean([true_at(angle) for angle in scene.angles], axis=0)
    interior = truth.gauge(mean, calibration.correction(pixels, None).duv)[:3]
    parts = {'held': []} if free_field is None else {'held': [], 'free': []}
    for angle in angles:
        true = true_at(angle)
        found = calibration.correction(pixels, angle)
        sd = found.sd[len(uv) :]
        for kind, of_kind in parts.items():
            held = interior if kind == 'held' else None
            if held is None:
                field = calibration.angle_field
                less = field.change(grid, angle)[1] - free_field.change(grid, angle)[1]
                sd = np.sqrt(np.maximum(sd**2 - less, 0))
            orientation = truth.gauge(true, found.duv, held)
            error = (found.duv - truth.seen_by(orientation, true))[len(uv) :]
            of_kind.append((error, sd))
    return {kind: [np.concatenate(c) for c in zip(*pairs)] for kind, pairs in parts.items()}
