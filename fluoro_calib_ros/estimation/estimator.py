# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""How a self-calibration obtains a correction model: terms in the adjustment, and regression."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from ..photogrammetry.noise import INLIER_Q
from ..photogrammetry.noise_estimation import SETTLED
from .gauge import GaugeKind
from .lack_of_fit import LeftOut

if TYPE_CHECKING:
    from ..correction.angle_field import AngleField
    from ..correction.series import Series
    from ..photogrammetry.adjustment import Adjustment
    from ..photogrammetry.elimination import FactorizedNormalMatrix
    from ..photogrammetry.network import Network
    from ..photogrammetry.precision import Precision

MIN_TRAINING = 60  # inliers of a fluoroscope that a correction model needs
# An inlier becomes an outlier above STAY_IN times the limit (five sigma of each coordinate), an
# outlier an inlier below half of it.
STAY_IN = 1.5
FOLDS = 10  # of the cross-validation
FINAL_TOLERANCE = 1e-5  # decrease of F that the last adjustment may leave

Model_co = TypeVar('Model_co', covariant=True)  # the correction model that a regression gives


@dataclass(frozen=True)
class AdjustmentProblem:
    """A network whose adjustment is to estimate terms of the correction."""

    network: Network  #: network without additional parameters
    #: width and height [px] of the image of each fluoroscope
    image_sizes: Sequence[tuple[int, int]]
    before: Adjustment  #: adjustment of the network without correction
    gauges: Sequence[GaugeKind]  #: what the orientation of each fluoroscope can express
    #: (e,) angles of the C-arm [rad] in the exposures of each fluoroscope, in the order of the
    #: network; NaN where unknown; None: all are unknown
    angles: Sequence[NDArray[np.float64]] | None = None


@dataclass(frozen=True)
class TrainingPoints:
    """Image points of one fluoroscope to whose residuals a model is fitted."""

    uv: NDArray[np.float64]  #: (N, 2) observed pixels; they do not change between rounds
    exposure: NDArray[np.int64]  #: (N,) exposure of each image point
    image_size: tuple[int, int]  #: width and height of the image [px]
    gauge: GaugeKind  #: what the orientation can express
    #: (N, m) functions whose coefficients are estimated in the adjustment, the same for u and v;
    #: the correction is then kept orthogonal to all of them instead of the gauge
    trend: NDArray[np.float64] | None = None


class AdjustedTerms(ABC):
    """Terms of the correction, of all fluoroscopes of a network, that the adjustment estimates.

    Attributes
    ----------
    intermediate_tolerance : float
        Decrease of the cost at which an adjustment before the last may stop.
    final_tolerance : float
        Decrease of the cost that the last adjustment may leave.
    noise_tolerance : float
        Relative change of the scale of the noise at which the terms may settle.
    needs_solution : bool
        Whether terms are renewed with the normal matrix at a solution, not with one near it.
    """

    intermediate_tolerance: float
    final_tolerance = FINAL_TOLERANCE
    noise_tolerance = SETTLED
    needs_solution = False

    @property
    @abstractmethod
    def values(self) -> list[np.ndarray]:
        """Functions at the image points of each fluoroscope, (N, m) or (N, 2, p)."""

    @abstractmethod
    def with_additional(self, network: Network) -> Network:
        """Return the network with the terms as additional parameters."""

    def start(self) -> tuple[np.ndarray, ...]:
        """Coefficients to start with, by fluoroscope."""
        return self.zeros()

    @abstractmethod
    def zeros(self) -> tuple[np.ndarray, ...]:
        """Coefficients of no correction, by fluoroscope."""

    @abstractmethod
    def series(self, f: int, coefficients: np.ndarray, covariance: np.ndarray) -> Series:
        """Return the series of fluoroscope f from its coefficients (p,) and their covariance."""

    @abstractmethod
    def renew(
        self, network: Network, matrix: FactorizedNormalMatrix, adjustment: Adjustment
    ) -> tuple[bool, tuple[np.ndarray, ...]]:
        """Renew what the terms assume, from the solved normal matrix of an adjustment.

        Returns whether nothing changed, and the coefficients with which to continue.
        """

    def left_out(self, f: int) -> LeftOut | None:
        """What the series of fluoroscope f leaves out by design; None: nothing."""
        return None

    def fit_angles(self, f: int, adjustment: Adjustment, precise: Precision) -> AngleField | None:
        """Fit what differs between the exposures of fluoroscope f to the angles of the C-arm.

        The series and the variance between exposures are then those beside this field. None: there
        is no such field.
        """
        return None

    def variance_between_exposures(
        self, f: int, network: Network, adjustment: Adjustment, precise: Precision
    ) -> np.ndarray:
        """Variances [px^2] by which the distortion of fluoroscope f differs between exposures.

        They are those of its inliers (i,), without what orientations absorb. network: that with
        the terms as additional parameters; adjustment and precise: of this network.
        """
        return np.zeros(int(adjustment.inliers[network.rows(f)].sum()))

    def fitted_series(self, f: int, adjustment: Adjustment, precise: Precision) -> Series:
        """Return the series of fluoroscope f that an adjustment has estimated."""
        coefficients = adjustment.parameters.additional[f]
        covariance = precise.additional[f]
        if coefficients is None or covariance is None:
            raise ValueError(f'no terms were estimated for fluoroscope number {f}')
        return self.series(f, coefficients, covariance)


class RegressionStep(ABC, Generic[Model_co]):
    """Correction model of one fluoroscope through the rounds of a self-calibration.

    Attributes
    ----------
    k : int
        Number of neighbours chosen; 0 for a model without.
    score : float
        G, weighted square sum of the errors of cross-validation.
    inliers : (N,) ndarray of bool
        Image points to which the model is fitted.
    changed : bool
        Whether inliers or k differ from the last round.
    iterates : bool
        Whether a second round can give another correction than the first.
    """

    iterates = True

    def __init__(self, points: TrainingPoints) -> None:
        self.points = points
        self.k = 0
        self.score = 0.0
        self.changed = False
        self.inliers: np.ndarray | None = None

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
    def without_gauge(self, values: np.ndarray, interior: np.ndarray) -> NDArray[np.float64]:
        """Change values (N, 2) so that their fitted correction is orthogonal to the gauge."""

    @abstractmethod
    def smooth(self, values: np.ndarray) -> NDArray[np.float64]:
        """Fit values (N, 2) [px] at the inliers; return the corrections (N, 2) at all points."""

    @abstractmethod
    def model(self, values: np.ndarray, series: Series | None = None) -> Model_co:
        """Return the correction model of values (N, 2) with its noise and bias.

        series: terms that were estimated in the adjustment and are not in the values.
        """

    def _updated_inliers(self, q: np.ndarray) -> np.ndarray:
        """Inliers (N,) by normalised squared residuals q (N,); sets `changed`.

        The limit depends on the last state: a point that moves about it would otherwise start the
        neighbour search and the acceleration anew in every round.
        """
        inliers = q <= INLIER_Q
        if self.inliers is not None:
            inliers = np.where(self.inliers, q <= STAY_IN * INLIER_Q, q <= INLIER_Q / 2)
        self.changed = self.inliers is None or not np.array_equal(inliers, self.inliers)
        return inliers


def no_terms(problem: AdjustmentProblem) -> None:
    """No terms of the model are unknowns of the adjustment."""


def no_regression(points: TrainingPoints, k: int | None) -> None:
    """Nothing is fitted to the residuals between adjustments."""


@dataclass(frozen=True)
class Estimator:
    """How a self-calibration obtains the models of a kind."""

    kind: str
    #: returns the terms that are unknowns of the adjustment; None: there are none
    adjusted_terms: Callable[[AdjustmentProblem], AdjustedTerms | None] = no_terms
    #: returns the regression of the residuals between adjustments for the number k of neighbours
    #: that the user asks for (None: to be chosen); None: the model needs no regression
    regression: Callable[[TrainingPoints, int | None], RegressionStep[Any] | None] = no_regression


def require_training(count: int) -> None:
    """Raise ValueError where count inliers are too few for a correction model."""
    if count < MIN_TRAINING:
        raise ValueError(
            f'{count} inliers are too few for the correction model, {MIN_TRAINING} are needed'
        )


def coefficients_of(adjustment: Adjustment) -> tuple[np.ndarray, ...]:
    """Coefficients of the additional parameters by fluoroscope, which all have some."""
    return tuple(c for c in adjustment.parameters.additional if c is not None)


def prior_of_additional(network: Network, f: int) -> NDArray[np.float64]:
    """Prior precision matrix (p, p) of the additional parameters of fluoroscope f."""
    additional = network.additional[f]
    if additional is None:
        raise ValueError(f'fluoroscope number {f} has no additional parameters')
    return additional.prior


def exposure_folds(exposure: np.ndarray, folds: int = FOLDS) -> np.ndarray:
    """Fold (N,) of each image point: the exposures (N,) are dealt out in turn.

    Of a single exposure the image points are dealt out.
    """
    _, number = np.unique(exposure, return_inverse=True)
    if not number.any():
        return np.arange(len(exposure)) % folds
    return number % min(folds, number.max() + 1)
