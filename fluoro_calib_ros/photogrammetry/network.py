"""The data of a bundle adjustment: image points, what they connect, survey and constraints."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from .additional_parameters import AdditionalParameters
from .relative_orientation import POSE_SIZE, RelativeConstraint
from .unknowns import UnknownLayout

if TYPE_CHECKING:
    from .unknowns import Parameters


@dataclass(frozen=True)
class Network:
    """Image points of one or more fluoroscopes, and what is known about their network.

    N image points, m exposures, n object points, F fluoroscopes.

    Attributes
    ----------
    uv : (N, 2) ndarray
        Observed image points [px].
    sigma : (N,) ndarray
        A-priori standard deviations of the image points [px], or ones.
    exposure, point : (N,) ndarray of int
        Rows of the exposure and of the object point of each image point. `exposure` ascends; each
        pair occurs at most once.
    fluoroscope : (m,) ndarray of int
        Fluoroscope of each exposure.
    survey_mm : (n, 3) ndarray
        Surveyed coordinates of the object points.
    survey_sd_mm : (n,) ndarray
        Their standard deviations.
    interior_free : (F,) ndarray of bool
        Whether the interior orientation of a fluoroscope is estimated.
    additional : tuple of AdditionalParameters or None
        Additional parameters of each fluoroscope, or an empty tuple.
    relative : tuple of RelativeConstraint
        One constraint per constrained pair of fluoroscopes; the first fluoroscope of the pair is
        the same in all of them.
    interior_mean, interior_sd : (F, 3) ndarray, optional
        Prior of the interior orientations [px]; an infinite standard deviation means no prior.
    datum : {'survey', 'inner'}
        'survey': the surveyed coordinates are weighted observations. 'inner': they have no weight,
        and inner constraints over the object points define the datum.
    """

    uv: np.ndarray
    sigma: np.ndarray
    exposure: np.ndarray
    point: np.ndarray
    fluoroscope: np.ndarray
    survey_mm: np.ndarray
    survey_sd_mm: np.ndarray
    interior_free: np.ndarray
    additional: tuple[AdditionalParameters | None, ...] = ()
    relative: tuple[RelativeConstraint, ...] = ()
    interior_mean: np.ndarray | None = None
    interior_sd: np.ndarray | None = None
    datum: str = 'survey'

    @property
    def n_image_points(self) -> int:
        """Number of image points."""
        return len(self.uv)

    @property
    def n_exposures(self) -> int:
        """Number of exposures."""
        return len(self.fluoroscope)

    @property
    def n_points(self) -> int:
        """Number of object points."""
        return len(self.survey_mm)

    @property
    def n_fluoroscopes(self) -> int:
        """Number of fluoroscopes."""
        return len(self.interior_free)

    @property
    def n_observations(self) -> int:
        """Number of scalar observations, without priors."""
        survey = self.survey_mm.size if self.datum == 'survey' else 0
        constraints = POSE_SIZE * sum(len(r.pairs) for r in self.relative)
        return 2 * self.n_image_points + survey + constraints

    @cached_property
    def layout(self) -> UnknownLayout:
        """Layout of the unknowns of the network."""
        return UnknownLayout.of(self)

    @property
    def n_unknowns(self) -> int:
        """Number of scalar unknowns, less those that the datum of a free network fixes."""
        return self.layout.n_unknowns

    @cached_property
    def interior_weight(self) -> np.ndarray:
        """Weights (F, 3) [1/px^2] of the prior of the interior orientations."""
        if self.interior_sd is None:
            return np.zeros((self.n_fluoroscopes, 3))
        return 1 / np.asarray(self.interior_sd, dtype=float) ** 2

    @cached_property
    def _rows(self) -> tuple[np.ndarray, ...]:
        fluoroscope = self.fluoroscope[self.exposure]
        return tuple(np.flatnonzero(fluoroscope == f) for f in range(self.n_fluoroscopes))

    def rows(self, f: int) -> np.ndarray:
        """Rows of the image points of fluoroscope f."""
        return self._rows[f]

    def additional_correction(self, parameters: Parameters) -> np.ndarray:
        """Corrections (N, 2) [px] by the additional parameters; zeros where there are none."""
        out = np.zeros_like(self.uv)
        for f, additional in enumerate(self.additional):
            coefficients = parameters.additional[f] if additional is not None else None
            if additional is not None and coefficients is not None:
                out[self.rows(f)] = additional.correction(coefficients)
        return out
