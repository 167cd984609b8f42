# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The oracle: a Gaussian adjustment with known distortion and without false matches."""

import numpy as np

from fluoro_calib_ros.estimation.calibrate import calibrate
from fluoro_calib_ros.estimation.options import CalibrationOptions
from fluoro_calib_ros.exposures.frame import Frame

from .scene import NAMES

PAD = 1000  # padding around the image [px], so that undistorted image points lie on it


def interior_of_oracle(scene):
    """Return the interior orientations (2, 3) [px] estimated by the oracle."""
    side = scene.case.side + 2 * PAD
    frames = {name: [] for name in NAMES}
    for image in scene.images:
        keep = ~image.false
        frames[NAMES[image.camera]].append(
            Frame(
                NAMES[image.camera],
                image.number,
                image.rows[keep] + 1,
                (image.clean - image.correction)[keep] + PAD,
                (side, side),
            )
        )
    options = CalibrationOptions(model='none', loss='gaussian')
    found = calibrate(frames, scene.phantom, options)
    interior = np.stack([found.fluoroscopes[name].interior for name in NAMES])
    return interior - np.array([PAD, PAD, 0.0])
