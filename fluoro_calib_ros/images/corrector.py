# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Corrected images: every pixel is shown where it would be without distortion.

The correction is a function of the observed pixel, whereas an image needs the inverse: for each of
its own pixels, the place where it was observed. This inverse of undistorted = observed - (du, dv)
has no closed form. It is iterated once for every pixel, on the lookup grid that also corrects
points, so that a bead in a corrected image coincides with the corrected bead of the observed
image. Each image then takes a single remap of OpenCV.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from ..correction.base import CorrectionStatus
from ..correction.fluoroscope_calibration import FluoroscopeCalibration
from ..correction.grid import CorrectionGrid
from ..errors import DataError
from ..limits import MAX_IMAGE_SIDE

INTERPOLATIONS = {'linear': cv2.INTER_LINEAR, 'cubic': cv2.INTER_CUBIC}
LIMIT_PX = 0.01  # largest difference between a pixel and its corrected source
STEP_PX = 0.001  # step below which the iteration of a source ends
# Number of steps: full steps, then half steps where full steps do not converge.
FULL_STEPS = 12
HALF_STEPS = 60
STRIPE = 64  # rows made at once: they fit into a cache, and other threads do not wait for long
NOWHERE = -float(MAX_IMAGE_SIDE)  # source of a pixel that has none: off any image
SHARPNESS = -0.75  # parameter of OpenCV's cubic convolution (`interpolateCubic`)


class Sources(Protocol):
    """Sources of the pixels of a corrected image, see `ImageCorrector`."""

    @property
    def source(self) -> NDArray[np.float32]:
        """Sources (2, h, w)."""
        ...

    @property
    def status(self) -> NDArray[np.uint8]:
        """Status (h, w)."""
        ...

    def of_stripe(self, start: int) -> NDArray[np.float32]:
        """Return the source (2, r, w) of up to STRIPE rows from a row on."""
        ...


@dataclass(frozen=True)
class _KnownSources:
    """See `Sources`."""

    source: NDArray[np.float32]
    status: NDArray[np.uint8]

    def of_stripe(self, start: int) -> NDArray[np.float32]:
        return self.source[:, start : start + STRIPE]


class ImageCorrector:
    """Corrects the images of one fluoroscope by a map that is built once.

    Sources are exact to LIMIT_PX, and OpenCV rounds them to 1/32 px, so that an image is within
    1/64 px of its correct place (cubic: 1/45 px). Threads may share a corrector.

    Parameters
    ----------
    calibration : FluoroscopeCalibration
    interpolation : {'linear', 'cubic'}
    border : int
        Grey value where nothing was observed.
    sources : Sources, optional
        Sources if known; by default those of the calibration. For a correction that depends on an
        angle, these are the sources of the mean (see `angle_maps`).

    Raises
    ------
    DataError
        For an unknown interpolation, or an image that is too large.
    """

    def __init__(
        self,
        calibration: FluoroscopeCalibration,
        interpolation: str = 'linear',
        border: int = 0,
        sources: Sources | None = None,
    ) -> None:
        if interpolation not in INTERPOLATIONS:
            raise DataError(
                f'the interpolation must be one of {", ".join(INTERPOLATIONS)}, not '
                f'{interpolation!r}'
            )
        if max(calibration.image_size) > MAX_IMAGE_SIDE:
            raise DataError(
                f'an image of {_size_text(calibration.image_size)} px is too large, its sides may '
                f'have {MAX_IMAGE_SIDE} px'
            )
        self.calibration_id = calibration.calibration_id
        #: width and height, and height and width [px]
        self.image_size = tuple(calibration.image_size)
        self.shape = self.image_size[::-1]
        self.interpolation = interpolation
        self.border = border
        self._sources = sources or _sources(calibration.grid, self.image_size)
        self._map_1 = np.empty((*self.shape, 2), dtype=np.int16)
        self._map_2 = np.empty(self.shape, dtype=np.uint16)
        high = np.array(self.image_size, dtype=np.float32)[:, None, None] - 1
        for start in range(0, self.shape[0], STRIPE):
            rows = slice(start, start + STRIPE)
            # A source in the outer half of a pixel at the border takes the value of that pixel.
            u, v = np.clip(self._sources.of_stripe(start), 0, high)
            cv2.patchNaNs(u, NOWHERE)
            cv2.patchNaNs(v, NOWHERE)
            if interpolation == 'cubic':
                u = _cubic_coordinates(u)
                v = _cubic_coordinates(v)
            cv2.convertMaps(u, v, cv2.CV_16SC2, self._map_1[rows], self._map_2[rows])

    @property
    def source(self) -> NDArray[np.float32]:
        """Pixels (2, h, w) of the observed image that the corrected one shows, columns first [px].

        NaN if there is none: off the image, or where the correction folds it.
        """
        return self._sources.source

    @property
    def status(self) -> NDArray[np.uint8]:
        """Status (h, w) uint8: OK, OUTSIDE the calibrated area, or INVALID without a source."""
        return self._sources.status

    @cached_property
    def mask(self) -> NDArray[np.bool_]:
        """Whether a pixel has a source (h, w)."""
        return ~np.isnan(self.source[0])

    @cached_property
    def _empty(self) -> NDArray[np.int64]:
        return np.flatnonzero(~self.mask)

    def correct(self, image: np.ndarray, out: np.ndarray | None = None) -> np.ndarray:
        """Correct an image (h, w) of uint8 or uint16; its rows need not be contiguous.

        out, if given, receives the corrected image; it must be contiguous, have the shape and
        type of the image, and share no memory with it. Raises DataError if either is unsuitable.
        """
        self.check(image)
        if out is None:
            out = np.empty(self.shape, dtype=image.dtype)
        elif out.shape != self.shape or out.dtype != image.dtype or not out.flags.c_contiguous:
            raise DataError(
                f'the array for the corrected image has {out.shape} pixels of {out.dtype}, it '
                f'must be contiguous and have {self.shape} of {image.dtype}'
            )
        if self.interpolation == 'linear':
            cv2.remap(
                image,
                self._map_1,
                self._map_2,
                cv2.INTER_LINEAR,
                dst=out,
                borderMode=cv2.BORDER_CONSTANT,
                borderValue=self.border,
            )
        else:
            self._remap_cubic(image, out)
        return out

    def check(self, image: np.ndarray) -> None:
        """Raise DataError unless an image can be corrected."""
        if image.ndim != 2:
            raise DataError(
                f'the image is not grey, it has {" x ".join(map(str, image.shape))} values'
            )
        if image.dtype not in (np.uint8, np.uint16):
            raise DataError(f'the image has pixels of {image.dtype}, not of 8 or 16 bits')
        if image.shape != self.shape:
            raise DataError(
                f'the image is {_size_text(image.shape[::-1])} px, but the calibration is for '
                f'{_size_text(self.image_size)} px'
            )

    def _remap_cubic(self, image: np.ndarray, out: np.ndarray) -> None:
        """Remap with the two pixels needed beyond the border equal to the outermost pixels."""
        narrow = image.dtype == np.uint8  # OpenCV is three times as fast with 16 bits
        remapped = cv2.remap(
            image.astype(np.uint16) if narrow else image,
            self._map_1,
            self._map_2,
            cv2.INTER_CUBIC,
            dst=None if narrow else out,
            borderMode=cv2.BORDER_REPLICATE,
        )
        if narrow:
            np.minimum(remapped, 255, out=out, casting='unsafe')
        out.ravel()[self._empty] = self.border


def _sources(grid: CorrectionGrid, image_size: tuple[int, ...]) -> Sources:
    """Return the sources of all pixels, by iteration."""
    width, height = image_size
    source = np.empty((2, height, width), dtype=np.float32)
    status = np.empty((height, width), dtype=np.uint8)
    for start in range(0, height, STRIPE):
        rows = np.arange(start, min(start + STRIPE, height))
        u = np.tile(np.arange(width), len(rows))
        v = np.repeat(rows, width)
        observed, row_status = _invert_correction(grid, np.stack([u, v]).astype(float))
        source[:, rows] = observed.reshape(2, -1, width)
        status[rows] = row_status.reshape(-1, width)
    status[is_folded(source)] = CorrectionStatus.INVALID
    source[:, status == CorrectionStatus.INVALID] = np.nan
    return _KnownSources(source, status)


def _invert_correction(
    grid: CorrectionGrid, undistorted: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
    """Return observed pixels (2, n) of undistorted pixels (2, n) [px], and their status (n,)."""
    observed = iterated(grid, undistorted)
    (du, dv, _), status = grid.look_up(*observed)  # off the image it is INVALID
    error = np.abs(observed - (du, dv) - undistorted).max(axis=0)
    status[~(error <= LIMIT_PX)] = CorrectionStatus.INVALID
    return observed, status


def iterated(
    grid: CorrectionGrid,
    undistorted: NDArray[np.float64],
    look_up: Callable[[CorrectionGrid, NDArray[np.float64]], NDArray[np.float64]] | None = None,
) -> NDArray[np.float64]:
    """Return observed pixels (2, n) of undistorted pixels (2, n) [px], converged or not.

    The iteration is observed = undistorted + (du, dv)(observed). Each step leaves the fraction of
    the error by which the correction changes per pixel, some hundredths. Off the image, the
    correction continues as it is at the border, so that too long a step is reversed. Where it
    changes so much that full steps do not converge, half steps may. look_up returns corrections
    (2, n) at pixels (2, n); by default it is `as_at_rim`.
    """
    look_up = look_up or as_at_rim
    observed = undistorted.copy()
    active = np.arange(undistorted.shape[1])
    for number in range(FULL_STEPS + HALF_STEPS):
        position = observed[:, active]
        step = undistorted[:, active] + look_up(grid, position) - position
        observed[:, active] = position + (step if number < FULL_STEPS else step / 2)
        active = active[np.abs(step).max(axis=0) > STEP_PX]
        if not len(active):
            break
    return observed


def observed_pixels(
    calibration: FluoroscopeCalibration,
    undistorted: NDArray[np.float64],
    angle: float | None = None,
) -> NDArray[np.float64]:
    """Return observed pixels (2, n) of undistorted pixels (2, n) [px] at an angle [rad]."""
    field = calibration.angle_field
    if field is None or angle is None or np.isnan(angle):
        return iterated(calibration.grid, undistorted)

    def at_angle(grid: CorrectionGrid, at: NDArray[np.float64]) -> NDArray[np.float64]:
        nearest = np.clip(at, -0.5, _end(grid))
        return as_at_rim(grid, nearest) + field.duv(nearest.T, angle).T

    return iterated(calibration.grid, undistorted, at_angle)


def as_at_rim(grid: CorrectionGrid, at: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return corrections (2, n) at pixels (2, n); off the image, those of the nearest pixel."""
    return grid.look_up(*np.clip(at, -0.5, _end(grid)))[0][:2]


def continued(grid: CorrectionGrid, at: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return corrections (2, n) at pixels (2, n), extrapolated with the slope at the border."""
    out = as_at_rim(grid, at)
    outside = np.flatnonzero(((at < -0.5) | (at > _end(grid))).any(axis=0))
    mirrored = 2 * np.clip(at[:, outside], -0.5, _end(grid)) - at[:, outside]
    out[:, outside] = 2 * out[:, outside] - as_at_rim(grid, mirrored)
    return out


def _end(grid: CorrectionGrid) -> NDArray[np.float64]:
    """Return the largest column and row (2, 1) on the image."""
    return np.array(grid.image_size)[:, None] - 0.5 - 1e-6


def is_folded(source: NDArray[np.floating]) -> NDArray[np.bool_]:
    """Return (h, w) whether the neighbours of a pixel are mirrored by the sources (2, h, w)."""
    right, down = steps(source)
    folded = right[0] * down[1] - right[1] * down[0] <= 0
    return np.pad(folded, ((0, 1), (0, 1))) | np.pad(folded, ((1, 0), (1, 0)))


def steps(source: NDArray[np.floating]) -> tuple[NDArray[np.floating], NDArray[np.floating]]:
    """Return steps from each source to those right of and below it (2, h - 1, w - 1) [px]."""
    return np.diff(source, axis=2)[:, :-1], np.diff(source, axis=1)[:, :, :-1]


def _cubic_coordinates(wanted: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return coordinates (h, w) at which OpenCV's cubic convolution shows the wanted ones [px].

    With its sharpness, the first moment of the kernel differs from the requested fraction of a
    pixel: a straight ramp, and every blob, would be displaced by up to 0.05 px.
    """
    a = SHARPNESS
    x = np.linspace(0, 1, 1025)
    near_weight = [((a + 2) * d - (a + 3)) * d * d + 1 for d in (x, 1 - x)]
    far_weight = [((a * d - 5 * a) * d + 8 * a) * d - 4 * a for d in (1 + x, 2 - x)]
    moment = near_weight[1] + 2 * far_weight[1] - far_weight[0]
    pixel = np.floor(wanted)
    return (pixel + np.interp(wanted - pixel, moment, x)).astype(np.float32)


def _size_text(size: Sequence[int]) -> str:
    return f'{size[0]} x {size[1]}'
