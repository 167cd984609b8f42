"""The corrected image: the same picture as the observed one, with every pixel where it would be
without distortion.

The correction is a function of the observed pixel; an image is made the other way round, by asking
for each of its own pixels where that was observed. That is the inverse of undistorted = observed -
(du, dv)(observed), which has no formula. It is iterated once for every pixel, from the lookup grid
that corrects points too, so that a bead in a corrected image lies where the corrected bead of the
observed image lies. What is left for a frame is one remap of OpenCV.
"""

import cv2
import numpy as np

from ..distortion.status import CorrectionStatus
from ..errors import DataError

INTERPOLATIONS = {'linear': cv2.INTER_LINEAR, 'cubic': cv2.INTER_CUBIC}
LIMIT_PX = 0.01  # what the source of a pixel, corrected, may differ from that pixel
STEP_PX = 0.001  # step below which a source is not iterated further
# steps at most: whole ones, then half ones where those have not settled
PLAIN = 12
DAMPED = 60
ROWS = 16  # that are iterated at once: they fit the cache, and no other thread waits for long
NOWHERE = -10_000.0  # source of a pixel that has none: far off any image
SHARPNESS = -0.75  # of OpenCV's cubic convolution
MAX_PX = 32_000  # longer side of an image: OpenCV holds whole pixels in 16 bits


class ImageCorrector:
    """Corrects the images of one fluoroscope by a map that is made once.

    calibration: its FluoroscopeCalibration; interpolation: 'linear' or 'cubic'; border: grey value
    where there is nothing to show. source (2, h, w) float32: columns and rows [px] of the observed
    image at which the pixels of the corrected one are seen, NaN where there is none: off the
    image, or where the correction folds it. mask (h, w) bool: where there is one. status (h, w)
    uint8: OK, OUTSIDE of the calibrated area, or INVALID where there is no source. The sources are
    exact to LIMIT_PX, and OpenCV takes them in steps of 1/32 px, so that an image is within 1/64
    px of where it should be (cubic: 1/45 px). Any number of threads may share a corrector. Raises
    DataError where interpolation is none of these.
    """

    def __init__(self, calibration, interpolation='linear', border=0):
        if interpolation not in INTERPOLATIONS:
            raise DataError(
                f'the interpolation is one of {", ".join(INTERPOLATIONS)}, not {interpolation!r}'
            )
        if max(calibration.image_size) > MAX_PX:
            raise DataError(
                f'an image of {_size(calibration.image_size)} px is too large, its sides may have '
                f'{MAX_PX} px'
            )
        self.calibration_id = calibration.calibration_id
        self.image_size = tuple(calibration.image_size)
        self.shape = self.image_size[::-1]
        self.interpolation = interpolation
        self.border = border
        self.source, self.status = _sources(calibration.grid, self.image_size)
        self.mask = self.status != CorrectionStatus.INVALID
        self._empty = np.flatnonzero(~self.mask)
        high = np.array(self.image_size, dtype=np.float32)[:, None, None] - 1
        # A source in the outer half of a pixel at the rim has that pixel's value.
        inside = np.where(self.mask, np.clip(self.source, 0, high), np.float32(NOWHERE))
        self._map = cv2.convertMaps(
            *(inside if interpolation == 'linear' else map(_for_cubic, inside)), cv2.CV_16SC2
        )

    def correct(self, image, out=None):
        """The corrected image (h, w), of the type of image (h, w) uint8 or uint16.

        Rows of image may be longer in memory than they are in the image. out: contiguous array to
        put it into, of the same shape and type and no part of image. Raises DataError where image
        is not such an image.
        """
        self.check(image)
        if out is None:
            out = np.empty(self.shape, dtype=image.dtype)
        elif out.shape != self.shape or out.dtype != image.dtype or not out.flags.c_contiguous:
            raise DataError(
                f'the array for the corrected image has {out.shape} pixels of {out.dtype}, it must be '
                f'contiguous and have {self.shape} of {image.dtype}'
            )
        if self.interpolation == 'linear':
            cv2.remap(
                image,
                *self._map,
                cv2.INTER_LINEAR,
                dst=out,
                borderMode=cv2.BORDER_CONSTANT,
                borderValue=self.border,
            )
        else:
            self._cubic(image, out)
        return out

    def check(self, image):
        """Raise DataError unless image is one that can be corrected."""
        if image.ndim != 2:
            raise DataError(
                f'the image is not grey, it has {" x ".join(map(str, image.shape))} values'
            )
        if image.dtype not in (np.uint8, np.uint16):
            raise DataError(f'the image has pixels of {image.dtype}, not of 8 or 16 bits')
        if image.shape != self.shape:
            raise DataError(
                f'the image is {_size(image.shape[::-1])} px, but the calibration is for '
                f'{_size(self.image_size)} px'
            )

    def _cubic(self, image, out):
        """What is needed beyond the rim, two pixels, is as the outermost ones are."""
        if image.dtype == np.uint8:  # OpenCV is three times as fast with 16 bits
            wide = cv2.remap(
                image.astype(np.uint16),
                *self._map,
                cv2.INTER_CUBIC,
                borderMode=cv2.BORDER_REPLICATE,
            )
            np.minimum(wide, 255, out=out, casting='unsafe')
        else:
            cv2.remap(image, *self._map, cv2.INTER_CUBIC, dst=out, borderMode=cv2.BORDER_REPLICATE)
        out.ravel()[self._empty] = self.border


def _sources(grid, image_size):
    """Observed pixels (2, h, w) float32 of the pixels of the corrected image, NaN where there are
    none, and their status (h, w) uint8.
    """
    width, height = image_size
    source = np.empty((2, height, width), dtype=np.float32)
    status = np.empty((height, width), dtype=np.uint8)
    for start in range(0, height, ROWS):
        rows = np.arange(start, min(start + ROWS, height))
        wanted = np.stack([np.tile(np.arange(width), len(rows)), np.repeat(rows, width)]).astype(
            float
        )
        observed, state = _iterated(grid, wanted)
        source[:, rows] = observed.reshape(2, -1, width)
        status[rows] = state.reshape(-1, width)
    folded = _folded(source)
    status[folded] = CorrectionStatus.INVALID
    source[:, status == CorrectionStatus.INVALID] = np.nan
    return source, status


def _iterated(grid, wanted):
    """Observed pixels (2, n) whose corrected ones are wanted (2, n) [px], and their status (n,).

    observed = wanted + (du, dv)(observed), again and again: each step leaves the part of the error
    that the correction changes by a pixel, some hundredths. Off the image the correction goes on
    as it is at the rim, so that a step too far comes back. Where it changes so much that whole
    steps do not settle, half ones may.
    """
    low = -0.5
    high = np.array(grid.image_size)[:, None] - 0.5
    observed = wanted.copy()
    left = np.arange(wanted.shape[1])
    for number in range(PLAIN + DAMPED):
        at = observed[:, left]
        step = wanted[:, left] + grid.look_up(*np.clip(at, low, high))[0][:2] - at
        observed[:, left] = at + (step if number < PLAIN else step / 2)
        left = left[np.abs(step).max(axis=0) > STEP_PX]
        if not len(left):
            break
    (du, dv, _), status = grid.look_up(*observed)  # off the image it is INVALID
    error = np.abs(observed - (du, dv) - wanted).max(axis=0)
    status[~(error <= LIMIT_PX)] = CorrectionStatus.INVALID
    return observed, status


def _folded(source):
    """True (h, w) for pixels at which the sources (2, h, w) turn round: neighbours are seen
    mirrored.
    """
    right = np.diff(source, axis=2)[:, :-1]
    down = np.diff(source, axis=1)[:, :, :-1]
    turned = right[0] * down[1] - right[1] * down[0] <= 0
    return np.pad(turned, ((0, 1), (0, 1))) | np.pad(turned, ((1, 0), (1, 0)))


def _for_cubic(at):
    """Coordinates to ask OpenCV's cubic convolution for, to see what is at coordinates at (h, w)
    [px].

    With its sharpness the first moment of its kernel is not the part of a pixel that it is asked
    for: a straight ramp, and every blob, would be moved by up to 0.05 px.
    """
    a = SHARPNESS
    x = np.linspace(0, 1, 1025)
    near = [((a + 2) * d - (a + 3)) * d * d + 1 for d in (x, 1 - x)]
    far = [((a * d - 5 * a) * d + 8 * a) * d - 4 * a for d in (1 + x, 2 - x)]
    whole = np.floor(at)
    return (whole + np.interp(at - whole, near[1] + 2 * far[1] - far[0], x)).astype(np.float32)


def _size(size):
    return f'{size[0]} x {size[1]}'
