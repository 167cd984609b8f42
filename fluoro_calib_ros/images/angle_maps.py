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

"""Maps of corrected images for a correction that depends on the angle of a C-arm.

While a C-arm turns, every image needs another map, and the iteration of a map for each pixel
takes far longer than an image may. It is not repeated: with the mean correction d and the change e
of an angle, the source S of pixel x is S = x + d(S) + e(S), which is the source of pixel x + e(S)
by d alone. So the map of an angle is that of the mean, looked up at places shifted by e(S); e is
smooth, and it is iterated at every eighth pixel only.

Angles are rounded to steps within which no pixel moves by more than LIMIT_PX, so that a map serves
all images of an arm that stands still, and depends on the angle only, not on the images before.
"""

from __future__ import annotations

import cv2
import numpy as np

from ..calibration.result import FluoroscopeCalibration
from ..distortion.angle_field import AngleField
from ..distortion.status import CorrectionStatus
from .corrector import LIMIT_PX, ROWS, ImageCorrector, is_folded, iterated

NODE_PX = 8  # between nodes at which the change is iterated
STEPS = 3  # of this iteration; each leaves the fraction by which the change differs per pixel
TURN = np.deg2rad(np.arange(360.0))  # angles at which the rate of change is measured
SIDE = 17  # of the grid of pixels at which it is measured
MIN_RATE = 1e-3  # of change of a pixel [px/rad], below which one map serves all angles


class AngleMaps:
    """Correctors of the images of one fluoroscope at the angles of its C-arm.

    The corrector of the last angle is kept. One thread may use it.

    Parameters
    ----------
    calibration : FluoroscopeCalibration
    interpolation, border
        See `ImageCorrector`.

    Attributes
    ----------
    mean : ImageCorrector
        By the mean over the angles: where the angle is unknown, and where it changes nothing.
    step : float
        To which angles are rounded [rad]; infinite where the correction has no change.
    built : int
        Number of maps that were made for angles.

    Raises
    ------
    DataError
        As ImageCorrector.
    """

    def __init__(
        self, calibration: FluoroscopeCalibration, interpolation: str = 'linear', border: int = 0
    ) -> None:
        self.mean = ImageCorrector(calibration, interpolation, border)
        self.built = 0
        self.step = np.inf
        self._calibration = calibration
        self._last: tuple[float, ImageCorrector] | None = None
        self._field = calibration.angle_field
        if self._field is not None:
            rate, largest = _rate(self._field)
            self.step = 2 * LIMIT_PX / rate if rate > MIN_RATE else np.inf
            self._base = _Base(calibration, int(np.ceil(largest)) + 2)

    def rounded(self, angle: float | None) -> float | None:
        """Return the angle [rad] of the map for an angle; None for the mean."""
        if angle is None or np.isinf(self.step):
            return None
        return round(angle / self.step) * self.step

    def at(self, angle: float | None) -> ImageCorrector:
        """Return the corrector for an angle [rad], None where it is unknown.

        At an angle far from all calibrated ones, all pixels are OUTSIDE.
        """
        angle = self.rounded(angle)
        if angle is None or self._field is None:
            return self.mean
        if self._last is None or self._last[0] != angle:
            sources = self._base.sources(self._field, angle)
            mean = self.mean
            corrector = ImageCorrector(self._calibration, mean.interpolation, mean.border, sources)
            self._last = angle, corrector
            self.built += 1
        return self._last[1]


class _Base:
    """Map of the mean, also around the image, as displacements of its sources.

    margin: of pixels around the image, for pixels whose source the change moves.
    """

    def __init__(self, calibration: FluoroscopeCalibration, margin: int) -> None:
        self._size = calibration.image_size
        self._margin = margin
        width, height = (side + 2 * margin for side in self._size)
        low = -0.5
        high = np.array(self._size)[:, None] - 0.5
        grid = calibration.grid
        source = np.empty((2, height, width), dtype=np.float32)
        self._status = np.empty((height, width), dtype=np.uint8)
        bad = np.empty((height, width), dtype=np.uint8)
        for start in range(0, height, ROWS):
            rows = np.arange(start, min(start + ROWS, height))
            u = np.tile(np.arange(width), len(rows)) - margin
            v = np.repeat(rows, width) - margin
            ideal = np.stack([u, v]).astype(float)
            observed = iterated(grid, ideal)
            (du, dv, _), status = grid.look_up(*np.clip(observed, low, high - 1e-6))
            error = np.abs(observed - (du, dv) - ideal).max(axis=0)
            source[:, rows] = observed.reshape(2, -1, width)
            self._status[rows] = status.reshape(-1, width)
            bad[rows] = ~(error <= LIMIT_PX).reshape(-1, width)
        bad |= is_folded(source)
        # A source is interpolated between four pixels, none of which may be bad.
        self._status[cv2.dilate(bad, np.ones((3, 3), np.uint8)) > 0] = CorrectionStatus.INVALID
        pixels = np.moveaxis(np.indices((height, width))[::-1], 0, 2).astype(np.float32)
        self._shift = np.moveaxis(source, 0, 2) - pixels + np.float32(margin)
        self._pixels = pixels[margin : height - margin, margin : width - margin]
        nodes = [np.arange(0.5 - NODE_PX / 2 - 1, side + NODE_PX, NODE_PX) for side in self._size]
        self._nodes = np.stack(np.meshgrid(*nodes), axis=2).astype(np.float32) + np.float32(margin)

    def sources(self, field: AngleField, angle: float) -> tuple[np.ndarray, np.ndarray]:
        """Return sources (2, h, w) and their status (h, w) at an angle [rad]."""
        width, height = self._size
        change = self._change(field, angle)
        rows, columns = change.shape[:2]
        # The first node is half a step before the image: resizing begins between two nodes.
        change = cv2.resize(change, (columns * NODE_PX, rows * NODE_PX))
        at = self._pixels + change[NODE_PX : NODE_PX + height, NODE_PX : NODE_PX + width]
        shift = cv2.remap(self._shift, at, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        status = cv2.remap(
            self._status,
            at,
            None,
            cv2.INTER_NEAREST,
            borderMode=cv2.BORDER_CONSTANT,
            borderValue=int(CorrectionStatus.INVALID),
        )
        source = np.stack(cv2.split(at + shift))
        source -= np.float32(self._margin)
        if not field.covers(angle):
            status[status != CorrectionStatus.INVALID] = CorrectionStatus.OUTSIDE
        high = np.array(self._size, dtype=np.float32)[:, None, None] - np.float32(0.5)
        off = ((source < -0.5) | (source >= high)).any(axis=0)
        status[off | is_folded(source)] = CorrectionStatus.INVALID
        source[:, status == CorrectionStatus.INVALID] = np.nan
        return source, status

    def _change(self, field: AngleField, angle: float) -> np.ndarray:
        """Change (rows, columns, 2) of the correction at the sources of the nodes [px]."""
        change = np.zeros_like(self._nodes)
        high = np.array(self._size) - 0.5
        for _ in range(STEPS):
            at = self._nodes + change
            shift = cv2.remap(
                self._shift, at, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
            )
            source = np.clip(at + shift - self._margin, -0.5, high).reshape(-1, 2)
            change = field.change(source, angle)[0].reshape(at.shape).astype(np.float32)
        return change


def _rate(field: AngleField) -> tuple[float, float]:
    """Largest rate of change of a pixel [px/rad], and the largest change [px], at all angles."""
    width, height = field.image_size
    u, v = np.meshgrid(np.linspace(-0.5, width - 0.5, SIDE), np.linspace(-0.5, height - 0.5, SIDE))
    uv = np.column_stack([u.ravel(), v.ravel()])
    changes = np.array([field.change(uv, float(angle))[0] for angle in TURN])
    rates = np.diff(changes, axis=0, append=changes[:1]) / (TURN[1] - TURN[0])
    return _longest(rates), _longest(changes)


def _longest(vectors: np.ndarray) -> float:
    """Length of the longest of vectors (..., 2)."""
    return float(np.hypot(vectors[..., 0], vectors[..., 1]).max())
