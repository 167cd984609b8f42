# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""How a self-calibration obtains a correction model, and the gauge between it and orientations.

A free correction competes with the orientation of the sensor if it can reproduce the effect of a
change of interior and exterior orientation on the image: this effect is the gauge. To first order,
such changes move an image point (x, y) = (u - xp, v - yp) by

    (1, 0), (0, 1)                    principal point,
    (x, y)                            principal distance,
    (-y, x)                           rotation of the sensor about its axis,
    (x x, x y)/c, (x y, y y)/c        rotation about its rows and columns, without a shift

(derivatives of the collinearity condition; the last three are common to all exposures and leave
sources and object points where they are). The fitted correction is kept orthogonal to them. If
the interior orientation is fixed, only the rotations remain, with their shifts: (-y, x),
(c + x x/c, x y/c), (x y/c, c + y y/c). If the exterior orientations are known too, none remains.

Flat targets parallel to the image determine neither principal distance nor principal point, and
the distance of the source absorbs any scale. Where these are given, they are those of a distortion
without shift, scale and tilt, such as that of Brown. The gauge part then vanishes in the cubic
polynomial that fits the correction best, not in the correction as a whole.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from enum import Enum
from typing import TYPE_CHECKING, Any, Generic, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import least_squares

from ..correction.terms import CUBIC, cubic_terms, polynomial_coefficients, polynomial_powers
from ..photogrammetry.noise import INLIER_Q
from ..photogrammetry.outliers import SETTLED
from ..photogrammetry.rotations import matrix_from_vector
from .lack_of_fit import LeftOut

if TYPE_CHECKING:
    from ..correction.angle_field import AngleField
    from ..correction.series import Series
    from ..photogrammetry.adjustment import Adjustment
    from ..photogrammetry.collinearity import AdditionalParameters
    from ..photogrammetry.elimination import FactorizedNormalMatrix
    from ..photogrammetry.network import Network
    from ..photogrammetry.precision import Precision


class GaugeKind(Enum):
    """Changes that the orientation can absorb, and a correction must not reproduce.

    FULL: interior orientation and rotations. TREND: the same, where the interior orientation is
    given as that of a cubic distortion, and the exposures do not determine it. TURNS: rotations
    only; the interior orientation is fixed, and the correction learns its errors. NONE: the
    exterior orientations are known too.
    """

    FULL = 'full'
    TREND = 'trend'
    TURNS = 'turns'
    NONE = 'none'


# Unit of the image coordinates in the basis: with half a usual image, the basis is about one.
UNIT_PX = 512.0


def orientation_fields(xy: ArrayLike) -> NDArray[np.float64]:
    """Return the displacements (n, 2, 6) of points xy (n, 2) that orientations absorb.

    xy may have any unit. The displacements are a shift of the image in both directions, its scale,
    its rotation, and its tilt about both axes (the linearised projective map of a rotated sensor).
    """
    x, y = np.asarray(xy, dtype=float).T
    one = np.ones_like(x)
    zero = np.zeros_like(x)
    columns = [(one, zero), (zero, one), (x, y), (-y, x), (x * x, x * y), (x * y, y * y)]
    return np.stack([np.stack(column, axis=1) for column in columns], axis=2)


def gauge_basis(
    uv: ArrayLike,
    interior: NDArray[np.float64],
    kind: GaugeKind = GaugeKind.FULL,
    unit_px: float = UNIT_PX,
) -> NDArray[np.float64]:
    """Return the basis (n, 2, g) of the gauge at pixels uv (n, 2).

    interior: (3,) xp, yp, c [px]. g is 3 for the rotations (TURNS), 0 for NONE, else 6. unit_px:
    unit of the image coordinates; with half an image, the basis is about one.
    """
    xy = (np.asarray(uv) - interior[:2]) / unit_px
    if kind is GaugeKind.NONE:
        return np.zeros((len(xy), 2, 0))
    if kind is not GaugeKind.TURNS:
        return orientation_fields(xy)
    x, y = xy.T
    square = (unit_px / interior[2]) ** 2
    columns = [
        (-y, x),
        (1 + square * x * x, square * x * y),
        (square * x * y, 1 + square * y * y),
    ]
    return np.stack([np.stack(column, axis=1) for column in columns], axis=2)


def gauge_coefficients(
    uv: ArrayLike,
    fitted: NDArray[np.float64],
    interior: NDArray[np.float64],
    kind: GaugeKind = GaugeKind.FULL,
) -> NDArray[np.float64]:
    """Return the coefficients (g,) of the part of fitted corrections that is in the gauge.

    uv: (n, 2) pixels. fitted: (n, 2) corrections there [px]. interior: (3,) xp, yp, c [px].
    """
    basis = gauge_basis(uv, interior, kind)
    if kind is GaugeKind.TREND:
        basis = np.concatenate([basis, _cubic_terms(uv, interior)], axis=2)
    count = 6 if kind is GaugeKind.TREND else basis.shape[2]
    flat = basis.reshape(-1, basis.shape[2])
    coefficients = np.linalg.lstsq(flat, fitted.reshape(-1), rcond=None)[0][:count]
    return np.asarray(coefficients, dtype=np.float64)


def gauge_rows(
    values: NDArray[np.float64],
    uv: NDArray[np.float64],
    interior: NDArray[np.float64],
    kind: GaugeKind = GaugeKind.FULL,
) -> NDArray[np.float64]:
    """Return rows (g, 2m) whose products with the coefficients of a series give its gauge part.

    The products vanish for a series without a gauge part. values (n, m): functions of the series
    at pixels uv (n, 2); interior (3,) [px]. The coefficients of u precede those of v.
    """
    # Half the side of a square that the points fill evenly: a small image fixes the gauge as well.
    square = np.mean(np.sum((uv - interior[:2]) ** 2, axis=1))
    unit_px = float(np.sqrt(1.5 * square))
    basis = gauge_basis(uv, interior, kind, unit_px)
    count = basis.shape[2]
    if kind is GaugeKind.TREND:
        basis = np.concatenate([basis, _cubic_terms(uv, interior, unit_px)], axis=2)
        flat = basis.reshape(-1, basis.shape[2])
        solved = np.linalg.solve(flat.T @ flat, flat.T)[:count]
        basis = solved.T.reshape(len(uv), 2, count) * len(uv)
    rows = [basis[:, axis].T @ values for axis in (0, 1)]
    return np.concatenate(rows, axis=1) / len(uv)


def _cubic_terms(
    uv: ArrayLike, interior: NDArray[np.float64], unit_px: float = UNIT_PX
) -> NDArray[np.float64]:
    """Return terms (n, 2, 14) that complete the gauge to all cubic polynomials about (xp, yp)."""
    x, y = (np.asarray(uv) - interior[:2]).T / unit_px
    powers = np.stack([x**i * y**j for i, j in polynomial_powers(CUBIC)], axis=1)
    terms = [polynomial_coefficients(CUBIC, parts) for parts in cubic_terms().values()]
    return np.stack([powers @ term.T for term in terms], axis=2)


def interior_about(
    centre: NDArray[np.float64],
    uv: NDArray[np.float64],
    correction: NDArray[np.float64],
    interior: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Return the interior orientation (3,) [px] in the gauge about another principal point.

    A sensor that is rotated by R and has another camera matrix K' sees the same rays if its
    corrected image is that of the homography K' R K^-1 (Hartley and Zisserman, "Multiple View
    Geometry", 2003, 8.4). To second order, a rotation with its shift d of the principal point
    stretches the image by d^2/c^2. A correction with a large affine part is therefore orthogonal
    to the gauge about a near principal point, and also about far ones, where it may be smaller.

    Parameters
    ----------
    centre : (2,) ndarray
        The other principal point [px].
    uv : (n, 2) ndarray
        Pixels.
    correction : (n, 2) ndarray
        Corrections there [px].
    interior : (3,) ndarray
        xp, yp, c [px] that belong to these corrections.

    Returns
    -------
    (3,) ndarray

    Raises
    ------
    ValueError
        If there is none: the corrections are not finite, or image points come to lie behind.
    """
    rays = np.column_stack([(uv - correction - interior[:2]) / interior[2], np.ones(len(uv))])
    reference = np.array([*centre, interior[2]])

    def misclosure(x: NDArray[np.float64]) -> NDArray[np.float64]:
        rotated = rays @ matrix_from_vector(x[3:]).T
        if not (rotated[:, 2] > 0).all():
            raise ValueError('no orientation about this principal point')
        ideal = x[:2] + x[2] * rotated[:, :2] / rotated[:, 2:]
        return gauge_coefficients(uv, uv - ideal, reference)

    start = np.concatenate([interior, np.zeros(3)])
    # A rotation by 1/c displaces the image as much as a shift of the principal point by a pixel.
    scale = np.repeat([1.0, 1 / interior[2]], 3)
    return least_squares(misclosure, start, x_scale=scale).x[:3]


MIN_TRAINING = 60  # inliers of a fluoroscope that a correction model needs
# An inlier becomes an outlier above STAY_IN times the limit (five sigma of each coordinate); an
# outlier becomes an inlier below half the limit.
STAY_IN = 1.5
FOLDS = 10  # number of folds of the cross-validation
FINAL_TOLERANCE = 1e-5  # decrease of F that the last adjustment may leave

Model_co = TypeVar('Model_co', covariant=True)  # correction model that a regression returns


@dataclass(frozen=True)
class AdjustmentProblem:
    """A network whose adjustment will estimate terms of the correction."""

    network: Network  #: network without additional parameters
    #: width and height [px] of the image of each fluoroscope
    image_sizes: Sequence[tuple[int, int]]
    before: Adjustment  #: adjustment of the network without correction
    gauges: Sequence[GaugeKind]  #: changes that the orientation of each fluoroscope can absorb
    #: (e,) angles of the C-arm [rad] in the exposures of each fluoroscope, in the order of the
    #: network; NaN where unknown; None: all are unknown
    angles: Sequence[NDArray[np.float64]] | None = None


@dataclass(frozen=True)
class TrainingPoints:
    """Image points of one fluoroscope to whose residuals a model is fitted."""

    uv: NDArray[np.float64]  #: (N, 2) observed pixels; they do not change between rounds
    exposure: NDArray[np.int64]  #: (N,) exposure of each image point
    image_size: tuple[int, int]  #: width and height of the image [px]
    gauge: GaugeKind  #: changes that the orientation can absorb
    #: (N, m) functions whose coefficients the adjustment estimates, the same for u and v; the
    #: correction is then kept orthogonal to all of them instead of the gauge
    trend: NDArray[np.float64] | None = None


class TermsOfFluoroscope(ABC):
    """Terms of the correction of one fluoroscope that the adjustment estimates."""

    values: NDArray[np.float64]  #: (n, m) or (n, 2, p) functions at its n image points

    def __init__(self, problem: AdjustmentProblem, number: int) -> None:
        self.number = number  #: number of the fluoroscope in the network
        self.rows = problem.network.rows(number)
        self.uv = problem.network.uv[self.rows]  #: (n, 2) image points [px]
        self.image_size = problem.image_sizes[number]  #: width and height [px]
        self.gauge_kind = problem.gauges[number]

    @property
    @abstractmethod
    def count(self) -> int:
        """Number of coefficients."""

    @abstractmethod
    def additional(self) -> AdditionalParameters:
        """Return the terms as additional parameters."""

    @abstractmethod
    def fitted_series(self, adjustment: Adjustment, precise: Precision) -> Series:
        """Return the series that an adjustment has estimated.

        With a field of the angle, it is the series that belongs to the field.
        """

    def left_out(self) -> tuple[LeftOut, ...]:
        """Return what the series omits by design."""
        return ()

    def fit_angles(self, adjustment: Adjustment, precise: Precision) -> AngleField | None:
        """Fit differences between the exposures to the angles of the C-arm.

        Afterwards the series and the variance between exposures are those that remain with this
        field. None: there is no such field.
        """
        return None

    def variance_between_exposures(
        self, network: Network, adjustment: Adjustment, precise: Precision
    ) -> NDArray[np.float64]:
        """Return variances [px^2] between exposures of the distortion.

        The variances are those of the inliers (i,), without the part that orientations absorb.
        network: with the terms as additional parameters; adjustment and precise: of this network.
        """
        return np.zeros(int(adjustment.inliers[self.rows].sum()))


class AdjustedTerms(ABC):
    """Terms of the corrections of all fluoroscopes of a network that the adjustment estimates."""

    parts: Sequence[TermsOfFluoroscope]
    #: decrease of the cost at which an adjustment before the last may stop
    intermediate_tolerance: float
    final_tolerance = FINAL_TOLERANCE  #: decrease of the cost that the last adjustment may leave
    #: relative change of the noise scale at which the terms may settle
    noise_tolerance = SETTLED
    #: whether updating the terms needs the normal matrix at a solution, not one near it
    needs_solution = False

    def with_additional(self, network: Network) -> Network:
        """Return the network with the terms as additional parameters."""
        return replace(network, additional=tuple(part.additional() for part in self.parts))

    def start(self) -> tuple[NDArray[np.float64], ...]:
        """Return the initial coefficients, by fluoroscope; by default those of no correction."""
        return tuple(np.zeros(part.count) for part in self.parts)

    @abstractmethod
    def renew(
        self, network: Network, matrix: FactorizedNormalMatrix, adjustment: Adjustment
    ) -> tuple[bool, tuple[NDArray[np.float64], ...]]:
        """Update the assumptions of the terms from the solved normal matrix of an adjustment.

        Returns whether nothing changed, and the coefficients to continue with.
        """


class RegressionStep(ABC, Generic[Model_co]):
    """Correction model of one fluoroscope through the rounds of a self-calibration."""

    iterates = True  #: whether a second round can give another correction than the first

    def __init__(self, points: TrainingPoints) -> None:
        self.points = points
        self.k = 0  #: number of neighbours that was chosen; 0 for a model without neighbours
        self.score = 0.0  #: G, weighted square sum of the errors of cross-validation
        self.changed = False  #: whether inliers or k differ from those of the last round
        #: (N,) image points to which the model is fitted
        self.inliers: NDArray[np.bool_] | None = None

    @abstractmethod
    def choose(
        self, values: NDArray[np.float64], q: NDArray[np.float64], information: NDArray[np.float64]
    ) -> None:
        """Update the inliers, and choose k by its score.

        values: (N, 2) values to which the model is fitted [px]. q: (N,) normalised squared
        residuals. information: (N, 2, 2) inverse of the residual covariance C_r [1/px^2]. Raises
        ValueError if there are too few inliers.
        """

    @abstractmethod
    def without_gauge(
        self, values: NDArray[np.float64], interior: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Change values (N, 2) so that their fitted correction is orthogonal to the gauge."""

    @abstractmethod
    def smooth(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Fit values (N, 2) [px] at the inliers; return the corrections (N, 2) at all points."""

    @abstractmethod
    def model(self, values: NDArray[np.float64], series: Series | None = None) -> Model_co:
        """Return the correction model of values (N, 2), with its noise and bias.

        series: terms that the adjustment has estimated and the values do not contain.
        """

    def _updated_inliers(self, q: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Return the inliers (N,) by normalised squared residuals q (N,); set `changed`.

        The limit depends on the last state, because a point that fluctuates about a single limit
        would restart the neighbour search and the acceleration in every round.
        """
        inliers = q <= INLIER_Q
        if self.inliers is not None:
            inliers = np.where(self.inliers, q <= STAY_IN * INLIER_Q, q <= INLIER_Q / 2)
        self.changed = self.inliers is None or not np.array_equal(inliers, self.inliers)
        return inliers


@dataclass(frozen=True)
class Estimator:
    """How a self-calibration obtains models of one kind."""

    kind: str
    #: returns the terms that are unknowns of the adjustment; None: there are none
    adjusted_terms: Callable[[AdjustmentProblem], AdjustedTerms] | None = None
    #: returns the regression of the residuals between adjustments with the number k of neighbours
    #: that the user asks for (None: to be chosen); None: nothing is fitted to the residuals
    regression: Callable[[TrainingPoints, int | None], RegressionStep[Any]] | None = None


def require_training(count: int) -> None:
    """Raise ValueError if count inliers are too few for a correction model."""
    if count < MIN_TRAINING:
        raise ValueError(
            f'{count} inliers are too few for the correction model, {MIN_TRAINING} are needed'
        )


def coefficients_of(adjustment: Adjustment) -> tuple[NDArray[np.float64], ...]:
    """Return the additional parameters that are not None, in the order of the fluoroscopes."""
    return tuple(c for c in adjustment.parameters.additional if c is not None)


def estimated_terms(
    f: int, adjustment: Adjustment, precise: Precision
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return additional parameters (p,) of fluoroscope f, and their covariance (p, p).

    Raises ValueError if there are none.
    """
    coefficients = adjustment.parameters.additional[f]
    covariance = precise.additional[f]
    if coefficients is None or covariance is None:
        raise ValueError(f'no terms were estimated for fluoroscope number {f}')
    return coefficients, covariance


def prior_of_additional(network: Network, f: int) -> NDArray[np.float64]:
    """Return the prior precision matrix (p, p) of the additional parameters of fluoroscope f."""
    additional = network.additional[f]
    assert additional is not None
    return additional.precision


def exposure_folds(exposure: NDArray[np.int64], folds: int = FOLDS) -> NDArray[np.int64]:
    """Deal the exposures (N,) out in turn; return the fold (N,) of each image point.

    If there is only one exposure, its image points are dealt out.
    """
    _, number = np.unique(exposure, return_inverse=True)
    if not number.any():
        return np.arange(len(exposure)) % folds
    return number % min(folds, number.max() + 1)
