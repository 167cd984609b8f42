# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Options of a self-calibration; a user's own scikit-learn regressor as its model.

Correction model from a user's own scikit-learn regressor. Any regressor with `fit(X, y)` and
`predict(X)` will do; like other models, it is fitted to the residuals of the inliers between
adjustments. X (n, 2) are image coordinates relative to the centre of the image in units of half
its longer side, so from -1 to 1; y (n, 2) is (du, dv) [px]. A regressor with one output is fitted
to du and to dv. The saved model is `lookup`, the fitted correction on a grid.
"""

from __future__ import annotations

import dataclasses
import importlib
from collections import deque
from collections.abc import Container, Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..brief import brief_repr
from ..correction.registry import (
    LookupModel,
    grid_nodes,
    hull_corners,
    neighbour_models,
    selectable_models,
)
from ..correction.series import Series
from ..exposures.frame import Frames
from ..exposures.names import Names
from ..exposures.phantom import Phantom
from ..limits import MAX_NEIGHBOURS
from ..options import option, validate_options
from ..photogrammetry.network import DATUMS
from ..photogrammetry.noise import LOSSES
from ..photogrammetry.rig_orientation import KnownOrientation
from .estimator import (
    Estimator,
    RegressionStep,
    TrainingPoints,
    exposure_folds,
    gauge_basis,
    gauge_coefficients,
    require_training,
)
from .neighbour_regression import weighted_square_sum

if TYPE_CHECKING:
    from sklearn.base import RegressorMixin

CV_FOLDS = 5  # fewer than for the other models, because each fold costs a fit


def resolve_model(name: str) -> Any:
    """Resolve the option --model: a name as it is, 'module:Class' to a regressor.

    The module is imported from the Python path. The object may be a regressor, or a class or
    function that is called without arguments. It must never come from a file or a message, because
    it runs code.

    Raises ValueError if there is no such object, or if it is not a regressor.
    """
    if ':' not in name:
        return name
    module, _, attribute = name.partition(':')
    try:
        regressor = getattr(importlib.import_module(module), attribute)
    except (ImportError, AttributeError, ValueError) as error:
        raise ValueError(f'model {name!r} cannot be imported: {error}') from None
    if not is_regressor(regressor):
        try:
            regressor = regressor()
        except TypeError as error:
            raise ValueError(f'model {name!r} cannot be made without arguments: {error}') from None
    if not is_regressor(regressor):
        raise ValueError(f'model {name!r} is not a scikit-learn regressor')
    return regressor


def is_regressor(thing: Any) -> bool:
    """Whether an object has the interface of a scikit-learn regressor."""
    if isinstance(thing, type):
        return False
    return all(callable(getattr(thing, name, None)) for name in ('fit', 'predict', 'get_params'))


def regressor_name(regressor: Any) -> str:
    """Return module and class of a regressor as 'module:Class'."""
    return f'{type(regressor).__module__}:{type(regressor).__qualname__}'


def user_estimator(regressor: Any) -> Estimator:
    """Return an estimator that fits a scikit-learn regressor to the residuals."""
    return Estimator(
        LookupModel.kind, regression=lambda points, k: UserRegression(regressor, points)
    )


class UserRegression(RegressionStep[LookupModel]):
    """A user's regressor for one fluoroscope through the rounds of a self-calibration.

    The correction is always that of the lookup grid, so that the network is adjusted with the same
    model that is saved.
    """

    def __init__(self, regressor: Any, points: TrainingPoints) -> None:
        super().__init__(points)
        self._regressor = _repeatable_multi_output(regressor)
        self._nodes = grid_nodes(points.image_size)
        self._interior: NDArray[np.float64] | None = None
        self._held_out_error2 = 0.0
        # Fits of the last round: those of its values and of the next values. `model` needs the
        # first again, with the gauge of its round.
        self._last_fits: deque[tuple[NDArray[np.float64], LookupModel]] = deque(maxlen=2)

    def choose(
        self, values: NDArray[np.float64], q: NDArray[np.float64], information: NDArray[np.float64]
    ) -> None:
        """Update the inliers, and compute G by cross-validation over exposures."""
        from sklearn.model_selection import PredefinedSplit, cross_val_predict

        inliers = self._updated_inliers(q)
        require_training(int(inliers.sum()))
        self.inliers = inliers
        held_out = cross_val_predict(
            self._regressor,
            self._features(self.points.uv[inliers]),
            values[inliers],
            cv=PredefinedSplit(exposure_folds(self.points.exposure[inliers], CV_FOLDS)),
        )
        error = values[inliers] - held_out
        self.score = float(weighted_square_sum(error[None], information[inliers])[0])
        self._held_out_error2 = float(np.mean(error**2))

    def without_gauge(
        self, values: NDArray[np.float64], interior: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return the values unchanged; `smooth` removes the gauge of this interior orientation."""
        self._interior = interior
        return values

    def smooth(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Fit values (N, 2) [px] at the inliers; return the corrections (N, 2) at all points."""
        fitted = self._fit(values)
        self._last_fits.append((values.copy(), fitted))
        return fitted.predict(self.points.uv)

    def model(self, values: NDArray[np.float64], series: Series | None = None) -> LookupModel:
        """Return the lookup grid of the regressor fitted to values (N, 2).

        For a least-squares fit and for a mean of neighbours, the error variance of a training
        point is below the noise variance by as much as that of a held-out point is above it
        (Efron, Journal of the American Statistical Association 81, 1986): by the variance of the
        prediction. Noise and prediction variance are estimated from these two errors.
        """
        known = [fit for fitted_to, fit in self._last_fits if np.array_equal(fitted_to, values)]
        fitted = known[0] if known else self._fit(values)
        error2 = np.mean((values - fitted.predict(self.points.uv))[self.inliers] ** 2)
        noise2 = (error2 + self._held_out_error2) / 2
        prediction2 = max((self._held_out_error2 - error2) / 2, 0.0)
        return LookupModel(
            0, fitted.train_uv, fitted.train_duv, float(np.sqrt(noise2)), float(prediction2**0.5)
        )

    def _fit(self, values: NDArray[np.float64]) -> LookupModel:
        """Fit values (N, 2) at the inliers; return the correction without gauge, on the grid."""
        from sklearn.base import clone

        uv = self.points.uv[self.inliers]
        regressor = clone(self._regressor).fit(self._features(uv), values[self.inliers])
        pixels = np.concatenate([self._nodes, hull_corners(uv)])
        duv = np.asarray(regressor.predict(self._features(pixels)), dtype=float)
        fitted = LookupModel(0, pixels, duv).predict(uv)
        basis = self._gauge(uv)
        if not basis.shape[2]:
            return LookupModel(0, pixels, duv)
        assert self._interior is not None, 'without_gauge comes before smooth'
        coefficients = gauge_coefficients(uv, fitted, self._interior, self.points.gauge)
        return LookupModel(0, pixels, duv - self._gauge(pixels) @ coefficients)

    def _gauge(self, uv: NDArray[np.float64]) -> NDArray[np.float64]:
        assert self._interior is not None, 'without_gauge comes before smooth'
        return gauge_basis(uv, self._interior, self.points.gauge)

    def _features(self, uv: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return image coordinates (n, 2) from -1 to 1 along the longer side."""
        size = np.asarray(self.points.image_size)
        return (uv - (size - 1) / 2) / (size.max() / 2)


def _repeatable_multi_output(regressor: Any) -> Any:
    """Return a regressor with two outputs that repeats its numbers for the same observations."""
    from sklearn.base import clone
    from sklearn.multioutput import MultiOutputRegressor

    from .regressors import supports_multi_output

    regressor = clone(regressor)
    for name, value in regressor.get_params(deep=True).items():
        if name.rpartition('__')[2] == 'random_state' and value is None:
            regressor.set_params(**{name: 0})
    if supports_multi_output(regressor):
        return regressor
    return MultiOutputRegressor(regressor)


AUTO = 'auto'
INTERIORS = ('estimated', 'fixed')
RELATIVE_ORIENTATIONS = ('none', 'soft', 'hard')


def model_choices() -> tuple[str, ...]:
    """Return the names of the correction models that a user can select, 'auto' first."""
    return (AUTO, *selectable_models())


@dataclass(frozen=True)
class CalibrationOptions:
    """Options of a self-calibration.

    Attributes
    ----------
    model : str or scikit-learn regressor
        Correction model; 'auto': chosen by cross-validation. A user's own regressor is given
        as an object (see `estimation.options.resolve_model`).
    interior : str
        'estimated', or 'fixed'; the model then learns the error of the interior orientation.
    loss : str
        Noise model of the image points.
    k : int or None
        Number of neighbours, for models that use neighbours; None: chosen by cross-validation.
    max_iterations : int
        Largest number of rounds.
    tolerance : float
        Relative change of F and G at which the rounds end.
    relative_orientation : str
        Constraint on fluoroscopes that are adjusted together: 'none', 'soft' or 'hard'.
    relative_sd : (float, float)
        Standard deviations of each component of a soft constraint [mm, rad].
    datum : str
        'survey': weighted surveyed coordinates; 'inner': a free network.
    interior_sd : (float, float, float) or None
        Standard deviations of the initial values of xp, yp and c [px]; None: unknown.

    Raises
    ------
    ValueError
        If a value is not allowed, or two options are incompatible.
    """

    model: str | RegressorMixin = option(  # noqa: RUF009
        AUTO, 'correction model', choices=model_choices
    )
    interior: str = option(
        'estimated',
        'interior orientation: estimated, or fixed, where the model absorbs its error',
        choices=INTERIORS,
    )
    loss: str = option('student_t', 'noise model of the image points', choices=LOSSES)
    k: int | None = option(
        None,
        'neighbours of knn, local_linear or hybrid; automatic by default',
        minimum=1,
        maximum=MAX_NEIGHBOURS,
    )
    max_iterations: int = option(60, 'largest number of rounds', minimum=1, maximum=10000)
    tolerance: float = option(1e-4, 'relative change of F and G at which the rounds end')
    relative_orientation: str = option(
        'none',
        'constraint on the relative orientation of fluoroscopes that are adjusted together',
        choices=RELATIVE_ORIENTATIONS,
    )
    relative_sd: tuple[float, ...] = option(
        (0.5, 2e-4),
        'standard deviations of a soft relative orientation',
        unit='mm, rad',
        length=2,
    )
    datum: str = option(
        'survey', 'weighted surveyed coordinates, or a free network', choices=DATUMS
    )
    interior_sd: tuple[float, ...] | None = option(
        None,
        'standard deviations of the start values of xp, yp and c; unknown by default',
        unit='px',
        length=3,
    )

    def __post_init__(self) -> None:
        self._validate_model()
        if self.k is not None and self.model not in neighbour_models():
            raise ValueError(
                f'k is a number of neighbours, but the model {self.model_name} has none'
            )
        if self.max_iterations < 1 or not self.tolerance > 0:
            raise ValueError('max_iterations must be at least 1, and tolerance above 0')
        for name, size in (('relative_sd', 2), ('interior_sd', 3)):
            value = getattr(self, name)
            if value is not None:
                # a list if it was read from a file
                object.__setattr__(self, name, tuple(float(v) for v in value))
                if len(value) != size or not all(v > 0 for v in value):
                    raise ValueError(f'{name} must be {size} numbers above 0')
        if self.interior_sd is not None and self.interior == 'fixed':
            raise ValueError('interior_sd requires an estimated interior orientation')
        validate_options(self, except_for=() if isinstance(self.model, str) else ('model',))

    def _validate_model(self) -> None:
        """Raise ValueError for a model that is neither a name of a model nor a regressor."""
        if isinstance(self.model, str):
            if ':' in self.model:
                # A class named in a file, message or parameter would be code from a stranger.
                raise ValueError(
                    f'model {self.model!r} names a regressor of the user, which is accepted only '
                    'on the command line and in Python, not from a file, message or parameter'
                )
        elif not is_regressor(self.model):
            raise ValueError(
                f'model must be a name or a scikit-learn regressor, not {self.model!r}'
            )

    @property
    def model_name(self) -> str:
        """Name of the model, or 'module:Class' of a user's regressor."""
        return self.model if isinstance(self.model, str) else regressor_name(self.model)

    def to_document(self) -> dict[str, Any]:
        """Return the options as plain values for a file, with a user's regressor by its name."""
        values = {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}
        return {**values, 'model': self.model_name}


# Input of a calibration.


@dataclass(frozen=True)
class CalibrationRequest:
    """Observations and options of a calibration.

    Attributes
    ----------
    frames : mapping of str to sequence of Frame
        Exposures of the phantom by fluoroscope.
    phantom : Phantom
        The phantom, with its survey.
    options : CalibrationOptions
    joint : bool
        Whether to adjust all fluoroscopes together, or one after the other.
    principal_distance : float or None
        Initial value [px], or with interior 'fixed' the value; None: from the observations.
    names : Names
        Names of targets, exposures and fluoroscopes in the files that were read.
    known_orientations : mapping of str to KnownOrientation
        Orientations known beforehand, by fluoroscope; the phantom is then surveyed in their
        frame.
    about : mapping of str to str
        Notes on rig and input for the report, such as site and operator; not used to calculate.
    """

    __repr__ = brief_repr

    frames: Frames
    phantom: Phantom
    options: CalibrationOptions = field(default_factory=CalibrationOptions)
    joint: bool = False
    principal_distance: float | None = None
    names: Names = field(default_factory=Names)
    known_orientations: Mapping[str, KnownOrientation] = field(default_factory=dict)
    about: Mapping[str, str] = field(default_factory=dict)

    def with_exposures(self, numbers: Mapping[str, Container[int]]) -> CalibrationRequest:
        """Return the request with only the exposures of these numbers, by fluoroscope."""
        frames = {
            name: [frame for frame in exposures if frame.number in numbers[name]]
            for name, exposures in self.frames.items()
        }
        return replace(self, frames=frames)

    @property
    def groups(self) -> list[tuple[str, ...]]:
        """Names of the fluoroscopes that are adjusted together, group by group."""
        return [tuple(self.frames)] if self.joint else [(name,) for name in self.frames]
