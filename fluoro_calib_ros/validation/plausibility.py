# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Absolute tests of a calibration: what no calibration of a fluoroscope can look like.

The verdict compares parts of the exposures with each other, and a fault that all of them share
passes. These tests compare with what is physically possible, whatever the input claims. Their
limits are far from every calibration that was right (docs/verdict.md).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..calibration.calibrate import CalibrationResult, FluoroscopeResult
from ..calibration.request import CalibrationRequest
from ..calibration.result import FluoroscopeCalibration
from ..distortion.gauge import interior_about
from ..distortion.series import sd_grid_pixels
from ..exposures.frame import Frame
from .inputs import wrong_unit

MAX_MISFIT = 0.0025  # RMSE after the correction over the longer side of the image
MAX_MISFIT_SD = 4.0  # the same over the a-priori standard deviation of the image points
MIN_INLIERS = 0.5  # share of the image points
MAX_SD_DISTANCE = 0.05  # standard deviation of the principal distance over it
MAX_DISTANCE_CHANGE = 0.2  # of one that is held, by the scale of the correction
MAX_SD_POINT = 0.15  # of the principal point over the longer side of the image
MAX_OFF_CENTRE = 1.0  # distance of the principal point from the middle over the longer side


def implausible(request: CalibrationRequest, result: CalibrationResult) -> list[str]:
    """Return a sentence for everything that makes the result of a calibration impossible."""
    out = []
    for name, figures in result.fluoroscopes.items():
        frames = request.frames[name]
        sentences = [
            _wrong_misfit(figures, frames),
            _few_inliers(figures),
            _wrong_distance(figures, request),
            _wrong_interior(figures, result.calibrations[name]),
        ]
        out += [f'fluoroscope {name}: {sentence}' for sentence in sentences if sentence]
    return out


def _wrong_misfit(figures: FluoroscopeResult, frames: Sequence[Frame]) -> str:
    """Residuals that are larger than distortion and noise leave."""
    rmse = float(np.sqrt(np.mean(np.square(figures.rmse_after))))
    given = [np.median(frame.sigma) for frame in frames if frame.sigma is not None]
    limit = MAX_MISFIT * max(figures.image_size)
    if given:
        limit = max(limit, MAX_MISFIT_SD * float(np.median(given)))
    if rmse <= limit:
        return ''
    return (
        f'the residuals are too large: RMSE {rmse:.1f} px after the correction, at most '
        f'{limit:.1f} px are plausible; false matches, another phantom, or the distortion changed '
        'between the exposures'
    )


def _few_inliers(figures: FluoroscopeResult) -> str:
    share = figures.inliers / figures.observations
    if share >= MIN_INLIERS:
        return ''
    return (
        f'only {100 * share:.0f} % of the image points fit, at least {100 * MIN_INLIERS:.0f} % '
        'are needed; the others are false matches'
    )


def _wrong_distance(figures: FluoroscopeResult, request: CalibrationRequest) -> str:
    """A source so near or so far that the unit of the phantom must be wrong."""
    centre = request.phantom.xyz_mm.mean(axis=0)
    distances = [np.linalg.norm(e.position_mm - centre) for e in figures.exposures]
    return wrong_unit(float(np.median(distances)), request.phantom)


def _wrong_interior(figures: FluoroscopeResult, calibration: FluoroscopeCalibration) -> str:
    """An interior orientation that is not determined, or outside of anything built."""
    xp, yp, c = figures.interior
    sd = figures.interior_sd
    side = max(figures.image_size)
    if not np.any(sd) and (found := _wrong_given_distance(calibration)):
        return found
    if sd[2] > MAX_SD_DISTANCE * c or max(sd[:2]) > MAX_SD_POINT * side:
        return (
            f'the interior orientation is not determined: principal distance {c:.0f} px with a '
            f'standard deviation of {sd[2]:.0f} px, principal point within {max(sd[:2]):.0f} px'
        )
    if _off_centre(figures.interior, figures.image_size) <= MAX_OFF_CENTRE * side:
        return ''
    xp, yp, _ = _interior_about_middle(calibration)
    offset = _off_centre(np.array([xp, yp]), figures.image_size)
    if offset > MAX_OFF_CENTRE * side:
        return (
            f'the principal point ({xp:.0f}, {yp:.0f}) is {offset:.0f} px from the middle of the '
            'image: wrong target ids, a wrong image size, or another phantom'
        )
    return ''


def _wrong_given_distance(calibration: FluoroscopeCalibration) -> str:
    """A principal distance that is held, but far from the one that the correction makes of it."""
    given = float(calibration.interior[2])
    found = float(_interior_about_middle(calibration)[2])
    if abs(found / given - 1) <= MAX_DISTANCE_CHANGE:
        return ''
    return (
        f'the principal distance is held at {given:.0f} px, but the exposures show about '
        f'{found:.0f} px: it has to be given in pixels'
    )


def _off_centre(interior: np.ndarray, image_size: tuple[int, int]) -> float:
    """Distance [px] of a principal point from the middle of the image."""
    return float(np.linalg.norm(interior[:2] - (np.array(image_size) - 1) / 2))


def _interior_about_middle(calibration: FluoroscopeCalibration) -> np.ndarray:
    """Interior orientation (3,) [px] with a correction in the gauge about the middle of the image.

    A strong affine distortion can move the principal point far away, and its correction with it.
    """
    pixels = sd_grid_pixels(calibration.image_size)
    pixels = pixels[~calibration.model.outside(pixels)]
    middle = (np.array(calibration.image_size) - 1) / 2
    try:
        return interior_about(
            middle, pixels, calibration.model.predict(pixels), calibration.interior
        )
    except (ValueError, np.linalg.LinAlgError):
        return calibration.interior
