# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The interface of the correction models.

A model is a subclass of `CorrectionModel` and one line in `registry`. It defines its predictions
(`predict` and `standard_deviation`) and the properties that users and the lookup grid need
(`description`, `smoothness`, `min_k`). How a self-calibration obtains a model is defined in
`estimation.self_calibration`, which a program that only corrects does not load.

docs/models.md shows how to add one.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from enum import Enum, IntEnum
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import ConvexHull, QhullError, cKDTree

from ..limits import MAX_CORNERS
from .calibration_record import SD_GRID
from .series import BULK_CHUNK, SERIES_FIELDS, Series, packed


class CorrectionStatus(IntEnum):
    """Status of a corrected image point, as sent in messages and written to files."""

    OK = 0
    OUTSIDE = 1  # beyond the calibrated area
    INVALID = 2  # off the image, or not finite


# Radius of an empty disc that counts as a hole, in mean spacings of the training points. Among
# points scattered at random (Poisson) a disc is empty with probability exp(-9 pi); where they are
# nine times less dense, with probability exp(-pi).
HOLE_SPACINGS = 3.0


class Smoothness(Enum):
    """Variation of a correction over the image, which decides the cell size of its lookup grid."""

    SMOOTH = 'smooth'  # differentiable
    KINKED = 'kinked'  # continuous, with jumps of the slope
    STEPPED = 'stepped'  # piecewise constant


@dataclass(frozen=True)
class Correction:
    """A correction at n pixels."""

    duv: NDArray[np.float64]  #: (n, 2) du, dv [px]; undistorted = observed - (du, dv)
    sd: NDArray[np.float64]  #: (n,) standard deviation of each coordinate [px]
    outside: NDArray[np.bool_]  #: (n,) True beyond the calibrated area


@dataclass(frozen=True)
class CorrectionModel(ABC):
    """Distortion (du, dv) as a function of the observed pixel.

    The fields are the complete content of a model: calibration files and messages carry nothing
    else. A subclass derives everything it needs from them in `_prepare`.

    Raises ValueError if the arrays differ in length or are not finite, if a series is missing or
    unexpected, or if there are too few training points for k.
    """

    kind: ClassVar[str]
    description: ClassVar[str]
    smoothness: ClassVar[Smoothness] = Smoothness.SMOOTH
    min_k: ClassVar[int | None] = None  # smallest number of neighbours; None for models without
    has_series: ClassVar[bool] = False
    selectable: ClassVar[bool] = True  # False: not available to users by name
    corrects: ClassVar[bool] = True  # False: the model leaves every pixel unchanged
    keeps_training_points: ClassVar[bool] = True  # whether train_uv are image points of exposures

    k: int  #: number of neighbours; 0 for a model without neighbours
    train_uv: NDArray[np.float64]  #: (N, 2) observed training pixels
    train_duv: NDArray[np.float64]  #: (N, 2) corrections at the training pixels [px]
    noise_px: float = 0.0  #: standard deviation of one training correction
    bias_px: float = 0.0  #: systematic error of a prediction, as a standard deviation
    series: Series | None = None  #: terms estimated in the adjustment
    _hull: NDArray[np.float64] = field(init=False, repr=False, compare=False)
    _holes: Holes | None = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        uv = np.ascontiguousarray(self.train_uv, dtype=float).reshape(-1, 2)
        duv = np.ascontiguousarray(self.train_duv, dtype=float).reshape(-1, 2)
        if len(uv) != len(duv):
            raise ValueError(f'{len(uv)} training points, but {len(duv)} corrections')
        if not (np.isfinite(uv).all() and np.isfinite(duv).all()):
            raise ValueError('a training point or its correction is not a number')
        if (self.series is not None) != self.has_series:
            requirement = 'needs a series' if self.has_series else 'has no series'
            raise ValueError(f'the correction model {self.kind} {requirement}')
        if self.min_k is not None and not self.min_k <= self.k <= len(uv):
            raise ValueError(
                f'{self.kind} with k = {self.k} is not possible with {len(uv)} training points'
            )
        hull = _half_planes(self._calibrated_points(uv))
        if len(hull) > MAX_CORNERS:
            raise ValueError(
                f'the calibrated area has {len(hull)} corners, at most {MAX_CORNERS} are possible'
            )
        holes = _holes_of(uv, hull) if self.keeps_training_points else None
        self._set(train_uv=uv, train_duv=duv, _hull=hull, _holes=holes)
        self._prepare()

    def _set(self, **values: Any) -> None:
        """Set attributes of the frozen instance during construction."""
        for name, value in values.items():
            object.__setattr__(self, name, value)

    def _prepare(self) -> None:  # noqa: B027
        """Derive from the fields what predictions need; called once, by the constructor."""

    def _calibrated_points(self, uv: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the points whose convex hull bounds the calibrated area."""
        return uv

    @abstractmethod
    def predict(self, uv: ArrayLike) -> NDArray[np.float64]:
        """Return corrections (n, 2) [px] at pixels uv (n, 2)."""

    def standard_deviation(self, uv: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return standard deviations (n,) [px] of the predictions at pixels uv (n, 2)."""
        return self._sd(np.zeros(len(uv)), uv)

    def _sd(self, norm2: NDArray[np.float64], uv: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return standard deviations (n,) [px] from squared norms (n,) of prediction weights."""
        variance = self.noise_px**2 * norm2 + self.bias_px**2
        return np.sqrt(variance if self.series is None else variance + self.series.sd_at(uv) ** 2)

    def evaluate(self, uv: ArrayLike) -> Correction:
        """Return the Correction at pixels uv (n, 2), with standard deviations."""
        uv = np.asarray(uv, dtype=float).reshape(-1, 2)
        return Correction(self.predict(uv), self.standard_deviation(uv), self.outside(uv))

    def evaluate_in_bulk(self, uv: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return du, dv and standard deviation (3, n) [px] at many pixels uv (n, 2).

        The lookup grid is built with this method. Override it in a subclass that has a faster way
        than calling `predict` in chunks.
        """
        out = np.empty((3, len(uv)))
        for start in range(0, len(uv), BULK_CHUNK):
            part = slice(start, start + BULK_CHUNK)
            out[:2, part] = self.predict(uv[part]).T
            out[2, part] = self.standard_deviation(uv[part])
        return out

    def bulk_work(self, uv: NDArray[np.float64], limit: float) -> float:
        """Return the work of `evaluate_in_bulk` at pixels uv (n, 2), in units of some 50 ns.

        By default it is the number of function values that are summed. A result above the limit
        may be too small.
        """
        return float(len(uv)) * (1 if self.series is None else len(self.series.functions))

    def outside(self, uv: ArrayLike) -> NDArray[np.bool_]:
        """Return True (n,) where a pixel uv (n, 2) is beyond the calibrated area.

        Such a pixel is beyond the convex hull of the training points, or in a hole between them:
        where no target was seen, the correction has not been measured.
        """
        uv = np.asarray(uv, dtype=float)
        out = _beyond(self._hull, uv)
        return out if self._holes is None else out | self._holes.contain(uv)

    def to_values(self) -> dict[str, Any]:
        """Return the values of those fields of a calibration's record that define the model.

        `registry.model_from_values` creates an equal model from them.
        """
        return {
            'model_kind': self.kind,
            'model_k': self.k,
            'train_uv': self.train_uv,
            'train_duv': self.train_duv,
            'noise_px': self.noise_px,
            'bias_px': self.bias_px,
            **dict(zip(SERIES_FIELDS, packed(self.series))),
        }


@dataclass(frozen=True)
class Holes:
    """Discs without training points: centres, and their common radius [px]."""

    centres: cKDTree
    radius: float

    def contain(self, uv: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Return True (n,) where a pixel uv (n, 2) is in one of the discs."""
        distance, _ = self.centres.query(uv, distance_upper_bound=self.radius)
        return np.isfinite(distance)


def _holes_of(uv: NDArray[np.float64], hull: NDArray[np.float64]) -> Holes | None:
    """Return the holes between training points uv (N, 2) within their hull, or None without holes.

    The union of the holes is what an alpha shape excludes (Edelsbrunner, Kirkpatrick and Seidel,
    "On the shape of a set of points in the plane", IEEE Transactions on Information Theory 29,
    1983). The radius of a hole is at least the spacing of the nodes of the standard deviation.
    """
    outline = convex_hull(uv)
    if outline is None:
        return None
    area = outline.volume  # in the plane, `volume` is the area
    low, high = uv.min(axis=0), uv.max(axis=0)
    radius = max(
        HOLE_SPACINGS * float(np.sqrt(area / len(uv))), float(np.max(high - low)) / (SD_GRID - 1)
    )
    u, v = (np.arange(a, b, radius / 3) for a, b in zip(low, high))  # candidate centres
    centres = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)
    centres = centres[~_beyond(hull, centres)]
    distance, _ = cKDTree(uv).query(centres, distance_upper_bound=radius)
    empty = np.isinf(distance)
    return Holes(cKDTree(centres[empty]), radius) if empty.any() else None


def _beyond(hull: NDArray[np.float64], uv: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return True (n,) where a pixel uv (n, 2) is beyond half-planes (h, 3)."""
    return (uv @ hull[:, :2].T + hull[:, 2] > 0).any(axis=1)


def _half_planes(uv: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return half-planes (h, 3) whose intersection is the convex hull of uv (N, 2).

    A pixel (u, v) is inside where a u + b v + c <= 0 for every row (a, b, c).
    """
    outline = convex_hull(uv)
    # Without an area, everything is outside.
    return np.array([[0.0, 0.0, 1.0]]) if outline is None else outline.equations


def convex_hull(uv: NDArray[np.float64]) -> ConvexHull | None:
    """Return the convex hull of points uv (N, 2), None if they span no area."""
    try:
        return ConvexHull(uv)
    except (QhullError, ValueError):
        return None
