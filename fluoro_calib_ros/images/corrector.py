# Copyright 2026 fluoro_calib_ros maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""The corrected image: the observed picture with every pixel where it would be without distortion.

The correction is a function of the observed pixel, whereas an image needs the inverse: for each of
its own pixels, the place where it was observed. This inverse of undistorted = observed - (du, dv)
has no formula. It is iterated once for every pixel, on the lookup grid that also corrects points,
so that a bead in a corrected image lies where the corrected bead of the observed image lies. Each
image then takes a single remap of OpenCV.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from ..calibration.result import FluoroscopeCalibration
from ..distortion.grid import CorrectionGrid
from ..distortion.status import CorrectionStatus
from ..errors import DataError
from ..limits import MAX_IMAGE_SIDE

INTERPOLATIONS = {'linear': cv2.INTER_LINEAR, 'cubic': cv2.INTER_CUBIC}
LIMIT_PX = 0.01  # largest difference between a pixel and its corrected source
STEP_PX = 0.001  # a source is no longer iterated below this step
# Number of steps: full ones, then half ones where those do not converge.
FULL_STEPS = 12
HALF_STEPS = 60
# Rows that are iterated at once: they fit into the cache, and other threads do not wait for long.
ROWS = 16
NOWHERE = -10_000.0  # source of a pixel without one: far off any image
SHARPNESS = -0.75  # of OpenCV's cubic convolution


class ImageCorrector:
    """Corrects the images of one fluoroscope by a map that is built once.

    The sources are exact to LIMIT_PX, and OpenCV rounds them to 1/32 px, so that an image is
    within 1/64 px of where it should be (cubic: 1/45 px). Threads may share a corrector.

    Parameters
    ----------
    calibration : FluoroscopeCalibration
    interpolation : {'linear', 'cubic'}
    border : int
        Grey value where nothing was observed.
    sources : (ndarray, ndarray), optional
        Attributes source and status, where they are known; by default they are those of the
        calibration, of a correction that depends on an angle the mean (see `angle_maps`).

    Attributes
    ----------
    calibration_id : str
    image_size, shape : tuple of int
        Width and height, and height and width [px].
    source : ndarray
        (2, h, w) of float32, columns and rows of the observed image at which the pixels of the
        corrected one were seen [px]; NaN where there is none: off the image, or where the
        correction folds it.
    mask : ndarray
        (h, w) of bool, where there is a source.
    status : ndarray
        (h, w) of uint8: OK, OUTSIDE of the calibrated area, or INVALID without a source.

    Raises
    ------
    DataError
        For an unknown interpolation, and for an image that is too large.
    """

    def __init__(
        self,
        calibration: FluoroscopeCalibration,
        interpolation: str = 'linear',
        border: int = 0,
        sources: tuple[np.ndarray, np.ndarray] | None = None,
    ) -> None:
        if interpolation not in INTERPOLATIONS:
            raise DataError(
                f'the interpolation is one of {", ".join(INTERPOLATIONS)}, not {interpolation!r}'
            )
        if max(calibration.image_size) > MAX_IMAGE_SIDE:
            raise DataError(
                f'an image of {_size_text(calibration.image_size)} px is too large, its sides may '
                f'have {MAX_IMAGE_SIDE} px'
            )
        self.calibration_id = calibration.calibration_id
        self.image_size = tuple(calibration.image_size)
        self.shape = self.image_size[::-1]
        self.interpolation = interpolation
        self.border = border
        self.source, self.status = sources or _sources(calibration.grid, self.image_size)
        self.mask = self.status != CorrectionStatus.INVALID
        self._empty = np.flatnonzero(~self.mask)
        high = np.array(self.image_size, dtype=np.float32)[:, None, None] - 1
        # A source in the outer half of a pixel at the rim takes the value of that pixel.
        u, v = np.where(self.mask, np.clip(self.source, 0, high), np.float32(NOWHERE))
        if interpolation == 'cubic':
            u = _cubic_coordinates(u)
            v = _cubic_coordinates(v)
        self._map_1, self._map_2 = cv2.convertMaps(u, v, cv2.CV_16SC2)

    def correct(self, image: np.ndarray, out: np.ndarray | None = None) -> np.ndarray:
        """Correct an image (h, w) of uint8 or uint16; its rows need not be contiguous.

        out, if given, receives the corrected image; it must be contiguous, have the shape and
        type of the image, and share no memory with it. Raises DataError for another image or out.
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
        """Remap with the two pixels needed beyond the rim equal to the outermost ones."""
        if image.dtype == np.uint8:  # OpenCV is three times as fast with 16 bits
            wide = cv2.remap(
                image.astype(np.uint16),
                self._map_1,
                self._map_2,
                cv2.INTER_CUBIC,
                borderMode=cv2.BORDER_REPLICATE,
            )
            np.minimum(wide, 255, out=out, casting='unsafe')
        else:
            cv2.remap(
                image,
                self._map_1,
                self._map_2,
                cv2.INTER_CUBIC,
                dst=out,
                borderMode=cv2.BORDER_REPLICATE,
            )
        out.ravel()[self._empty] = self.border


def _sources(grid: CorrectionGrid, image_size: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Sources (2, h, w) of float32 and their status (h, w) of uint8, see ImageCorrector."""
    width, height = image_size
    source = np.empty((2, height, width), dtype=np.float32)
    status = np.empty((height, width), dtype=np.uint8)
    for start in range(0, height, ROWS):
        rows = np.arange(start, min(start + ROWS, height))
        u = np.tile(np.arange(width), len(rows))
        v = np.repeat(rows, width)
        observed, row_status = _invert_correction(grid, np.stack([u, v]).astype(float))
        source[:, rows] = observed.reshape(2, -1, width)
        status[rows] = row_status.reshape(-1, width)
    status[is_folded(source)] = CorrectionStatus.INVALID
    source[:, status == CorrectionStatus.INVALID] = np.nan
    return source, status


def _invert_correction(
    grid: CorrectionGrid, undistorted: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Observed pixels (2, n) of undistorted ones (2, n) [px], and their status (n,)."""
    observed = iterated(grid, undistorted)
    (du, dv, _), status = grid.look_up(*observed)  # off the image it is INVALID
    error = np.abs(observed - (du, dv) - undistorted).max(axis=0)
    status[~(error <= LIMIT_PX)] = CorrectionStatus.INVALID
    return observed, status


def iterated(grid: CorrectionGrid, undistorted: np.ndarray) -> np.ndarray:
    """Observed pixels (2, n) of undistorted ones (2, n) [px], also where they do not converge.

    The iteration is observed = undistorted + (du, dv)(observed). Each step leaves the fraction of
    the error by which the correction changes per pixel, some hundredths. Off the image, the
    correction continues as it is at the rim, so that a step too far comes back. Where it changes
    so much that full steps do not converge, half steps may.
    """
    low = -0.5
    high = np.array(grid.image_size)[:, None] - 0.5
    observed = undistorted.copy()
    active = np.arange(undistorted.shape[1])
    for number in range(FULL_STEPS + HALF_STEPS):
        at = observed[:, active]
        correction = grid.look_up(*np.clip(at, low, high))[0][:2]
        step = undistorted[:, active] + correction - at
        observed[:, active] = at + (step if number < FULL_STEPS else step / 2)
        active = active[np.abs(step).max(axis=0) > STEP_PX]
        if not len(active):
            break
    return observed


def is_folded(source: np.ndarray) -> np.ndarray:
    """Whether (h, w) the neighbours of a pixel are seen mirrored by the sources (2, h, w)."""
    right = np.diff(source, axis=2)[:, :-1]
    down = np.diff(source, axis=1)[:, :, :-1]
    folded = right[0] * down[1] - right[1] * down[0] <= 0
    return np.pad(folded, ((0, 1), (0, 1))) | np.pad(folded, ((1, 0), (1, 0)))


def _cubic_coordinates(wanted: np.ndarray) -> np.ndarray:
    """Coordinates at which OpenCV's cubic convolution shows what is at other ones (h, w) [px].

    With its sharpness, the first moment of the kernel is not the fraction of a pixel that it is
    asked for: a straight ramp, and every blob, would be displaced by up to 0.05 px.
    """
    a = SHARPNESS
    x = np.linspace(0, 1, 1025)
    near = [((a + 2) * d - (a + 3)) * d * d + 1 for d in (x, 1 - x)]
    far = [((a * d - 5 * a) * d + 8 * a) * d - 4 * a for d in (1 + x, 2 - x)]
    moment = near[1] + 2 * far[1] - far[0]
    whole = np.floor(wanted)
    return (whole + np.interp(wanted - whole, moment, x)).astype(np.float32)


def _size_text(size: Sequence[int]) -> str:
    return f'{size[0]} x {size[1]}'
