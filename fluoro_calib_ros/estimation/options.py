# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Options of a self-calibration."""

from __future__ import annotations

import dataclasses
from collections.abc import Container, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

from ..correction.registry import neighbour_models, selectable_models
from ..exposures.frame import Frame
from ..exposures.names import Names
from ..exposures.phantom import Phantom
from ..limits import MAX_NEIGHBOURS
from ..options import option, validate_options
from ..photogrammetry.known_orientation import KnownOrientation
from ..photogrammetry.network import DATUMS
from ..photogrammetry.noise import LOSSES
from .user_regressor import is_regressor, regressor_name

if TYPE_CHECKING:
    from sklearn.base import RegressorMixin

AUTO = 'auto'
INTERIORS = ('estimated', 'fixed')
RELATIVE_ORIENTATIONS = ('none', 'soft', 'hard')


def model_choices() -> tuple[str, ...]:
    """Names of the correction models that can be asked for, 'auto' first."""
    return (AUTO, *selectable_models())


@dataclass(frozen=True)
class CalibrationOptions:
    """Options of a self-calibration.

    Attributes
    ----------
    model : str or scikit-learn regressor
        Correction model; 'auto': chosen by cross-validation. A regressor of the user's own is
        given as an object (see `estimation.user_regressor.resolve_model`).
    interior : str
        'estimated', or 'fixed', its error being learned by the model.
    loss : str
        Noise model of the image points.
    k : int or None
        Number of neighbours of a model that has any; None: chosen by cross-validation.
    max_iterations : int
        Largest number of rounds.
    tolerance : float
        Relative change of F and G at which the rounds end.
    relative_orientation : str
        Constraint on fluoroscopes that are adjusted together: 'none', 'soft' or 'hard'.
    relative_sd : (float, float)
        Standard deviations of each component of a soft one [mm, rad].
    datum : str
        'survey': weighted surveyed coordinates; 'inner': a free network.
    interior_sd : (float, float, float) or None
        Standard deviations of the start values of xp, yp and c [px]; None: they are not known.

    Raises
    ------
    ValueError
        If a value is not allowed, or two options exclude each other.
    """

    model: str | RegressorMixin = option(  # noqa: RUF009
        AUTO, 'correction model', choices=model_choices
    )
    interior: str = option(
        'estimated',
        'interior orientation, estimated, or fixed, its error being learned by the model',
        choices=INTERIORS,
    )
    loss: str = option('student_t', 'noise model of the image points', choices=LOSSES)
    k: int | None = option(
        None,
        'neighbours of knn, local_linear or hybrid; by default chosen',
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
        'standard deviations of the start values of xp, yp and c; by default they are not known',
        unit='px',
        length=3,
    )

    def __post_init__(self) -> None:
        self._validate_model()
        if self.k is not None and self.model not in neighbour_models():
            raise ValueError(
                f'k is a number of neighbours, which the model {self.model_name} does not have'
            )
        if self.max_iterations < 1 or not self.tolerance > 0:
            raise ValueError('max_iterations is at least 1 and tolerance above 0')
        for name, size in (('relative_sd', 2), ('interior_sd', 3)):
            value = getattr(self, name)
            if value is not None:
                # As read from a file it is a list.
                object.__setattr__(self, name, tuple(float(v) for v in value))
                if len(value) != size or not all(v > 0 for v in value):
                    raise ValueError(f'{name} is {size} numbers above 0')
        if self.interior_sd is not None and self.interior == 'fixed':
            raise ValueError('interior_sd goes with an interior orientation that is estimated')
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
            raise ValueError(f'model is a name or a scikit-learn regressor, not {self.model!r}')

    @property
    def model_name(self) -> str:
        """Name of the model; of a user's regressor its module and class, 'module:Class'."""
        return self.model if isinstance(self.model, str) else regressor_name(self.model)

    def to_document(self) -> dict[str, Any]:
        """Return the options as plain values for a file, a user's regressor by its name."""
        values = {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}
        return {**values, 'model': self.model_name}


# What a calibration is made from.


@dataclass(frozen=True)
class CalibrationRequest:
    """Observations and options of a calibration.

    Attributes
    ----------
    frames : mapping of str to sequence of Frame
        Exposures of the phantom by fluoroscope.
    phantom : Phantom
        Its survey.
    options : CalibrationOptions
    joint : bool
        Whether all fluoroscopes are adjusted together; else one after the other.
    principal_distance : float or None
        Start value, or with interior 'fixed' the value [px]; None: from the observations.
    names : Names
        Names of targets, exposures and fluoroscopes in the files that they were read from.
    known_orientations : mapping of str to KnownOrientation
        Orientations that are known beforehand, by fluoroscope; the phantom is then surveyed in
        their frame.
    """

    frames: Mapping[str, Sequence[Frame]]
    phantom: Phantom
    options: CalibrationOptions = field(default_factory=CalibrationOptions)
    joint: bool = False
    principal_distance: float | None = None
    names: Names = field(default_factory=Names)
    known_orientations: Mapping[str, KnownOrientation] = field(default_factory=dict)

    def with_exposures(self, numbers: Mapping[str, Container[int]]) -> CalibrationRequest:
        """Return the request with the exposures of these numbers, by fluoroscope, only."""
        frames = {
            name: [frame for frame in of_one if frame.number in numbers[name]]
            for name, of_one in self.frames.items()
        }
        return replace(self, frames=frames)

    @property
    def groups(self) -> list[tuple[str, ...]]:
        """Names of the fluoroscopes that are adjusted together, group by group."""
        return [tuple(self.frames)] if self.joint else [(name,) for name in self.frames]
