# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The data of a bundle adjustment: image points, what they connect, survey and constraints."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from .additional_parameters import AdditionalParameters
from .known_orientation import ExteriorPrior
from .relative_orientation import exposures_after_step
from .relative_pose import POSE_SIZE, RelativeConstraint
from .rotations import matrix_from_vector
from .unknowns import INTERIOR_SIZE, Parameters, UnknownLayout, UnknownVector

DATUM_DEFECT = 7  # unknowns that the datum of a free network fixes: shift, turn and scale


@dataclass(frozen=True)
class Network:
    """Image points of one or more fluoroscopes, and what is known about their network.

    N image points, m exposures, n object points, F fluoroscopes.
    """

    uv: NDArray[np.float64]  #: (N, 2) observed image points [px]
    #: (N,) a-priori standard deviations of the image points [px], or ones
    sigma: NDArray[np.float64]
    #: (N,) rows of the exposure and of the object point of each image point. `exposure` ascends;
    #: each pair occurs at most once
    exposure: NDArray[np.int64]
    point: NDArray[np.int64]
    fluoroscope: NDArray[np.int64]  #: (m,) fluoroscope of each exposure
    survey_mm: NDArray[np.float64]  #: (n, 3) surveyed coordinates of the object points
    survey_sd_mm: NDArray[np.float64]  #: (n,) their standard deviations
    #: (F,) whether the interior orientation of a fluoroscope is estimated
    interior_free: NDArray[np.bool_]
    #: additional parameters of each fluoroscope, or an empty tuple
    additional: tuple[AdditionalParameters | None, ...] = ()
    #: one constraint per constrained pair of fluoroscopes; the first fluoroscope of the pair is
    #: the same in all of them
    relative: tuple[RelativeConstraint, ...] = ()
    #: (F, 3) prior of the interior orientations [px]; an infinite standard deviation means no
    #: prior
    interior_mean: NDArray[np.float64] | None = None
    interior_sd: NDArray[np.float64] | None = None
    exterior: ExteriorPrior | None = None  #: what is known of the exterior orientations
    #: 'survey': the surveyed coordinates are weighted observations. 'inner': they have no weight,
    #: and inner constraints over the object points define the datum: {'survey', 'inner'}
    datum: str = 'survey'
    #: (n,) object points that define the datum of a free network; by default all
    in_datum: NDArray[np.bool_] | None = None

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
        """Number of scalar observations, without priors of the global unknowns."""
        survey = self.survey_mm.size if self.datum == 'survey' else 0
        constraints = POSE_SIZE * sum(len(r.pairs) for r in self.relative)
        exterior = 0 if self.exterior is None else self.exterior.sd.size
        return 2 * self.n_image_points + survey + constraints + exterior

    @cached_property
    def layout(self) -> UnknownLayout:
        """Layout of the unknowns of the network."""
        return UnknownLayout.of(
            (self.n_exposures, self.n_points),
            np.asarray(self.interior_free, dtype=bool),
            len(self.relative),
            [0 if a is None else a.count for a in self.additional],
            DATUM_DEFECT if self.datum == 'inner' else 0,
        )

    @property
    def n_unknowns(self) -> int:
        """Number of scalar unknowns, less those that the datum of a free network fixes."""
        return self.layout.n_unknowns

    @cached_property
    def interior_weight(self) -> NDArray[np.float64]:
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

    def additional_correction(self, parameters: Parameters) -> NDArray[np.float64]:
        """Corrections (N, 2) [px] by the additional parameters; zeros where there are none."""
        out = np.zeros_like(self.uv)
        for f, additional in enumerate(self.additional):
            coefficients = parameters.additional[f] if additional is not None else None
            if additional is not None and coefficients is not None:
                out[self.rows(f)] = additional.correction(coefficients)
        return out

    def per_image_point(
        self, parameters: Parameters
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Rotation, position, object point and interior orientation of every image point."""
        return (
            parameters.rotation[self.exposure],
            parameters.position_mm[self.exposure],
            parameters.points_mm[self.point],
            parameters.interior[self.fluoroscope[self.exposure]],
        )

    def parameters_after(self, parameters: Parameters, step: UnknownVector) -> Parameters:
        """Parameters after a step; rotations are varied on the left, R -> exp([w]x) R.

        The second exposures of constrained pairs follow their constraint (see
        relative_orientation.exposures_after_step).
        """
        layout = self.layout
        interior_step = step.globals[layout.all_interiors].reshape(-1, INTERIOR_SIZE)
        additional = tuple(
            a if a is None or self.additional[f] is None else a + step.globals[columns]
            for f, (a, columns) in enumerate(zip(parameters.additional, layout.additional))
        )
        relative = tuple(
            pose.updated(step.globals[columns])
            for pose, columns in zip(parameters.relative, layout.relative)
        )
        moved = Parameters(
            parameters.interior + interior_step,
            matrix_from_vector(step.exteriors[:, 3:]) @ parameters.rotation,
            position_mm=parameters.position_mm + step.exteriors[:, :3],
            points_mm=parameters.points_mm + step.points,
            additional=additional,
            relative=relative,
        )
        return exposures_after_step(self.relative, layout, parameters, moved, step)
