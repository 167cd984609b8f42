"""Options of a self-calibration."""

from __future__ import annotations

from dataclasses import dataclass

from ..distortion.smoothers import KINDS, SMOOTHERS
from ..options import option, validate_options
from ..photogrammetry.datum import DATUMS
from ..photogrammetry.noise import LOSSES

MODELS = ('auto', *KINDS)
INTERIORS = ('estimated', 'fixed')
RELATIVE_ORIENTATIONS = ('none', 'soft', 'hard')


@dataclass(frozen=True)
class CalibrationOptions:
    """Options of a self-calibration.

    With model 'auto' the kind of model is chosen by cross-validation. k is the number of
    neighbours of a model that has any, None: chosen. tolerance is the relative change of F and G
    at which the alternation of adjustment and regression ends. relative_orientation constrains
    fluoroscopes that are adjusted together, 'soft' with standard deviations relative_sd of each
    component [mm, rad]. interior_sd is that of the start values of xp, yp and c [px], None: they
    are not known. Raises ValueError for a value that is none of these.
    """

    model: str = option('auto', 'correction model', choices=MODELS)
    interior: str = option(
        'estimated',
        'interior orientation, estimated, or held and learned by the model',
        choices=INTERIORS,
    )
    loss: str = option('student_t', 'noise model of the image points', choices=LOSSES)
    k: int | None = option(
        None, 'neighbours of knn, local_linear or hybrid; by default chosen', minimum=1
    )
    max_iterations: int = option(60, 'most rounds', minimum=1, maximum=10000)
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
        if self.k is not None and self.model not in SMOOTHERS:
            raise ValueError(
                f'k is a number of neighbours, and the model {self.model} has none to be given'
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
        validate_options(self)
