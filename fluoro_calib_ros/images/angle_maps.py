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
from .corrector import (
    LIMIT_PX,
    ROWS,
    ImageCorrector,
    Sources,
    continued,
    is_folded,
    iterated,
    steps,
)

NODE_PX = 8  # between nodes at which the change is iterated
STRIPE = 32  # rows that are handled at once: they fit into the cache
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
            self._base = _Base(calibration, int(np.ceil(largest)) + NODE_PX)

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
    """Map of the mean, also around the image.

    margin: of pixels around the image, for pixels whose source the change moves.
    """

    def __init__(self, calibration: FluoroscopeCalibration, margin: int) -> None:
        self._grid = calibration.grid
        self._size = calibration.image_size
        self._margin = margin
        width, height = (side + 2 * margin for side in self._size)
        source = np.empty((2, height, width), dtype=np.float32)
        bad = np.empty((height, width), dtype=np.uint8)
        for start in range(0, height, ROWS):
            rows = np.arange(start, min(start + ROWS, height))
            u = np.tile(np.arange(width), len(rows)) - margin
            v = np.repeat(rows, width) - margin
            ideal = np.stack([u, v]).astype(float)
            # A bend at the rim would not be interpolated well between nodes on both sides of it.
            observed = iterated(self._grid, ideal, continued)
            error = np.abs(observed - continued(self._grid, observed) - ideal).max(axis=0)
            source[:, rows] = observed.reshape(2, -1, width)
            bad[rows] = ~(error <= LIMIT_PX).reshape(-1, width)
        bad |= is_folded(source)
        right, down = steps(source)
        self._least_area = float((right[0] * down[1] - right[1] * down[0]).min())
        self._longest_step = float(max(np.abs(right).max(), np.abs(down).max()))
        # A source is interpolated between four pixels, none of which may be bad.
        self._bad = cv2.dilate(bad, np.ones((3, 3), np.uint8)) if bad.any() else None
        own = slice(margin, -margin)
        self._source = np.ascontiguousarray(source[:, own, own])
        self._high = np.array(self._size, dtype=np.float32)[:, None, None] - np.float32(0.5)
        self._stripes = [self._stripe(start) for start in range(0, self._size[1], STRIPE)]
        pixels = np.moveaxis(np.indices((height, width))[::-1], 0, 2).astype(np.float32)
        shift = np.moveaxis(source, 0, 2) - pixels + np.float32(margin)
        self._shift = np.ascontiguousarray(shift)  # else OpenCV copies it each time
        nodes = [np.arange(0.5 - NODE_PX / 2 - 1, side + NODE_PX, NODE_PX) for side in self._size]
        self._nodes = np.stack(np.meshgrid(*nodes), axis=2).astype(np.float32) + np.float32(margin)
        self._shift_of_nodes = self._shift_at(self._nodes)

    def _stripe(self, start: int) -> tuple[slice, slice]:
        """Rows from the first one, and the columns between those whose sources are near the rim.

        By the mean, the sources of these are further from it than any angle shifts them.
        """
        width, height = self._size
        rows = slice(start, min(start + STRIPE, height))
        own = self._source[:, rows]
        near = (own < self._margin - 0.5) | (own >= self._high - self._margin)
        columns = np.flatnonzero(near.reshape(-1, width).any(axis=0))
        middle = width // 2
        left, right = columns[columns < middle], columns[columns >= middle]
        return rows, slice(left.max(initial=-1) + 1, right.min(initial=width))

    def sources(self, field: AngleField, angle: float) -> Sources:
        """Return the sources at an angle [rad]."""
        change, shift = self._at_nodes(field, angle)
        source = np.empty_like(self._source)
        for rows, _ in self._stripes:
            for out, mean, of_nodes in zip(source, self._source, shift):
                cv2.add(mean[rows], self._between(of_nodes, rows), dst=out[rows])
        folded = self._folded(source, change) if self._may_fold(shift) else None
        is_near = np.abs(shift).max() < self._margin
        for rows, inner in self._stripes:
            parts = [slice(0, inner.start), slice(inner.stop, None)] if is_near else [slice(None)]
            for columns in parts:
                own = source[:, rows, columns]
                own[:, ~((own >= -0.5) & (own < self._high)).all(axis=0)] = np.nan
        if folded is not None:
            source[:, folded] = np.nan
        return Sources(source, lambda: self._status(source, bool(field.covers(angle))))

    def _between(self, of_nodes: np.ndarray, rows: slice) -> np.ndarray:
        """Values (r, w) at the pixels of rows from those of nodes; r and the first are multiples.

        The first node is half a step before the image: resizing begins between two nodes.
        """
        first, last = rows.start // NODE_PX, -(-rows.stop // NODE_PX) + 2
        own = of_nodes[first:last]
        fine = cv2.resize(own, (own.shape[1] * NODE_PX, own.shape[0] * NODE_PX))
        count = rows.stop - rows.start
        return fine[NODE_PX : NODE_PX + count, NODE_PX : NODE_PX + self._size[0]]

    def _may_fold(self, shift: np.ndarray) -> bool:
        """Whether pixels may be seen mirrored by sources that are shifted (2, rows, columns)."""
        if self._bad is not None:
            return True
        # The determinant of the steps changes by no more than this.
        turn = max(np.abs(np.diff(shift, axis=axis)).max() for axis in (1, 2)) / NODE_PX
        return bool(self._least_area <= 4 * self._longest_step * turn + 2 * turn**2)

    def _folded(self, source: np.ndarray, change: np.ndarray) -> np.ndarray:
        """Whether (h, w) sources are folded, or those of a pixel that has none by the mean."""
        folded = is_folded(source)
        if self._bad is None:
            return folded
        for rows, _ in self._stripes:
            u, v = (self._between(part, rows) for part in cv2.split(change))
            u = u + (np.arange(u.shape[1], dtype=np.float32) + self._margin)
            v = v + (np.arange(rows.start, rows.stop, dtype=np.float32) + self._margin)[:, None]
            folded[rows] |= cv2.remap(self._bad, u, v, cv2.INTER_NEAREST, borderValue=1) > 0
        return folded

    def _status(self, source: np.ndarray, is_covered: bool) -> np.ndarray:
        """Status (h, w) of sources (2, h, w), those of no angle near by are OUTSIDE."""
        status = np.empty((self._size[1], self._size[0]), dtype=np.uint8)
        for start in range(0, len(status), ROWS):
            rows = slice(start, start + ROWS)
            own = source[:, rows].astype(float).reshape(2, -1)
            status[rows] = self._grid.look_up(*own)[1].reshape(-1, status.shape[1])
        if not is_covered:
            status[status != CorrectionStatus.INVALID] = CorrectionStatus.OUTSIDE
        return status

    def _at_nodes(self, field: AngleField, angle: float) -> tuple[np.ndarray, np.ndarray]:
        """Change of the correction, and by what it moves the sources (2, rows, columns) [px]."""
        shift = self._shift_of_nodes
        change = np.zeros_like(self._nodes)
        for _ in range(STEPS):
            source = self._nodes + change + shift - self._margin
            change = field.duv(source.reshape(-1, 2), angle).reshape(change.shape)
            change = change.astype(np.float32)
            shift = self._shift_at(self._nodes + change)
        return change, np.stack(cv2.split(change + shift - self._shift_of_nodes))

    def _shift_at(self, places: np.ndarray) -> np.ndarray:
        """Source less pixel (rows, columns, 2) of the mean, at places around the image [px]."""
        return cv2.remap(
            self._shift, places, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
        )


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
