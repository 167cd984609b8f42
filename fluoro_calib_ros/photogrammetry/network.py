# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Data of a bundle adjustment: image points, their links, survey, constraints and datum.

Datum of a free network: inner constraints over the object points. Without surveyed coordinates the
images leave seven directions undetermined: the network can be shifted, rotated and scaled. The
datum makes the least-squares similarity transformation between object points and surveyed
coordinates the identity: B^T (P - P0) = 0, where B contains the seven directions at the surveyed
coordinates. The adjustment itself fixes another seven directions, which changes neither residuals
nor estimable quantities; parameters and covariances are transformed into the datum afterwards
(S-transformation: Baarda, "S-transformations and criterion matrices", Netherlands Geodetic
Commission 1973; inner constraints in photogrammetry: Granshaw, "Bundle adjustment methods in
engineering photogrammetry", Photogrammetric Record 10, 1980).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from itertools import accumulate

import numpy as np
from numpy.typing import NDArray

from .collinearity import AdditionalParameters
from .rig_orientation import ExteriorPrior
from .rotations import cross_matrix, matrix_from_vector
from .unknowns import (
    INTERIOR_SIZE,
    POSE_SIZE,
    Parameters,
    RelativeConstraint,
    RelativePose,
    UnknownLayout,
    UnknownVector,
    exposures_after_step,
)

DATUM_DEFECT = 7  # unknowns that the datum of a free network fixes: shift, rotation and scale


@dataclass(frozen=True)
class Network:
    """Image points of one or more fluoroscopes, with prior information on their network.

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
    exterior: ExteriorPrior | None = None  #: prior of the exterior orientations
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
        exterior = 0 if self.exterior is None else int(np.isfinite(self.exterior.sd).sum())
        return 2 * self.n_image_points + survey + constraints + exterior

    @cached_property
    def layout(self) -> UnknownLayout:
        """Layout of the unknowns of the network."""
        of_interiors = [INTERIOR_SIZE] * self.n_fluoroscopes
        of_relative = [POSE_SIZE] * len(self.relative)
        of_additional = [0 if a is None else a.count for a in self.additional]
        sizes = [*of_interiors, *of_relative, *of_additional]
        columns = [slice(end - size, end) for size, end in zip(sizes, accumulate(sizes))]
        first_additional = len(of_interiors) + len(of_relative)
        interior_free = np.asarray(self.interior_free, dtype=bool)
        is_other = np.ones(sum(of_relative) + sum(of_additional), dtype=bool)
        return UnknownLayout(
            self.n_exposures,
            self.n_points,
            interiors=tuple(columns[: len(of_interiors)]),
            relative=tuple(columns[len(of_interiors) : first_additional]),
            additional=tuple(columns[first_additional:]),
            free=np.concatenate([np.repeat(interior_free, INTERIOR_SIZE), is_other]),
            datum_defect=DATUM_DEFECT if self.datum == 'inner' else 0,
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
    def _rows(self) -> tuple[NDArray[np.int64], ...]:
        fluoroscope = self.fluoroscope[self.exposure]
        return tuple(np.flatnonzero(fluoroscope == f) for f in range(self.n_fluoroscopes))

    def rows(self, f: int) -> NDArray[np.int64]:
        """Return the rows of the image points of fluoroscope f."""
        return self._rows[f]

    def additional_correction(self, parameters: Parameters) -> NDArray[np.float64]:
        """Return corrections (N, 2) [px] by the additional parameters; zeros if there are none."""
        out = np.zeros_like(self.uv)
        for f, additional in enumerate(self.additional):
            coefficients = parameters.additional[f] if additional is not None else None
            if additional is not None and coefficients is not None:
                out[self.rows(f)] = additional.correction(coefficients)
        return out

    def per_image_point(
        self, parameters: Parameters
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """Return rotation, position, object point and interior orientation by image point."""
        return (
            parameters.rotation[self.exposure],
            parameters.position_mm[self.exposure],
            parameters.points_mm[self.point],
            parameters.interior[self.fluoroscope[self.exposure]],
        )

    def parameters_after(self, parameters: Parameters, step: UnknownVector) -> Parameters:
        """Return parameters after a step; rotations are varied from the left, R -> exp([w]x) R.

        The second exposures of constrained pairs follow their constraint (see
        unknowns.exposures_after_step).
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
        updated = Parameters(
            parameters.interior + interior_step,
            matrix_from_vector(step.exteriors[:, 3:]) @ parameters.rotation,
            position_mm=parameters.position_mm + step.exteriors[:, :3],
            points_mm=parameters.points_mm + step.points,
            additional=additional,
            relative=relative,
        )
        return exposures_after_step(self.relative, layout, parameters, updated, step)


DATUMS = ('survey', 'inner')
# Inliers that an object point without a survey needs: two may be a false match and an accidental
# partner.
MIN_RAYS = 3


@dataclass(frozen=True)
class Gauge:
    """Directions that the images do not determine."""

    directions: UnknownVector  #: 7 columns: changes of the unknowns along the directions
    #: (n, 3, 7) B: directions of the object points at the surveyed coordinates
    constraint: NDArray[np.float64]


def similarity_directions(
    points: NDArray[np.float64], centre: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return changes (n, 3, 7) of points (n, 3) [mm] by shift, rotation, scale about a centre."""
    offset = points - centre
    shift = np.broadcast_to(np.eye(3), (len(points), 3, 3))
    return np.concatenate([shift, -cross_matrix(offset), offset[:, :, None]], axis=2)


def open_gauge(network: Network, parameters: Parameters) -> Gauge | None:
    """Return the gauge of a network at some parameters; None if the survey defines the datum."""
    if network.datum == 'survey':
        return None
    centre = network.survey_mm.mean(axis=0)
    e = np.zeros((network.n_exposures, 6, DATUM_DEFECT))
    e[:, :3] = similarity_directions(parameters.position_mm, centre)
    e[:, 3:, 3:6] = -parameters.rotation
    constraint = similarity_directions(network.survey_mm, centre)
    if network.in_datum is not None:
        constraint *= network.in_datum[:, None, None]
    g = np.zeros((network.layout.n_globals, DATUM_DEFECT))
    for columns, pose in zip(network.layout.relative, parameters.relative):
        g[columns][:3, 6] = pose.translation_mm
    return Gauge(
        UnknownVector(e, similarity_directions(parameters.points_mm, centre), g), constraint
    )


def in_determined_datum(
    network: Network, parameters: Parameters, inliers: NDArray[np.bool_]
) -> tuple[Network, Parameters]:
    """Define the datum of a free network by object points with enough inliers (N,).

    A point with one ray may lie anywhere along it. As part of the datum, it would shift, rotate
    and scale all other points by its own uncertainty.
    """
    if network.datum == 'survey':
        return network, parameters
    rays = np.bincount(network.point[inliers], minlength=network.n_points)
    network = replace(network, in_datum=rays >= MIN_RAYS)
    return network, transform_to_datum(network, parameters)


def stabilising_factor(
    directions: NDArray[np.float64], diagonal: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return D (q, 7) such that adding D D^T to a normal matrix fixes its undetermined directions.

    directions (q, 7): undetermined; diagonal (q,): of the normal matrix. D D^T is a projector in
    the unknowns scaled by the diagonal, so that its size is that of the matrix.
    """
    scaled = diagonal[:, None] * directions
    return np.linalg.solve(np.linalg.cholesky(directions.T @ scaled), scaled.T).T


def transform_to_datum(network: Network, parameters: Parameters) -> Parameters:
    """Transform the parameters of a free network into its datum.

    They are unchanged if the survey defines the datum. Least-squares rotation: Horn, Hilden and
    Negahdaripour, JOSA A 5, 1988. The scale is the one at which the survey fits the points.
    """
    if network.datum == 'survey':
        return parameters
    in_datum = slice(None) if network.in_datum is None else network.in_datum
    centre = parameters.points_mm[in_datum].mean(axis=0)
    survey_centre = network.survey_mm[in_datum].mean(axis=0)
    estimated = parameters.points_mm[in_datum] - centre
    surveyed = network.survey_mm[in_datum] - survey_centre
    u, _, vt = np.linalg.svd(surveyed.T @ estimated)
    turn = u @ np.diag([1, 1, np.sign(np.linalg.det(u @ vt))]) @ vt
    scale = np.sum(surveyed**2) / np.sum(surveyed * (estimated @ turn.T))

    def transform(points: NDArray[np.float64]) -> NDArray[np.float64]:
        return survey_centre + scale * (points - centre) @ turn.T

    return replace(
        parameters,
        rotation=parameters.rotation @ turn.T,
        position_mm=transform(parameters.position_mm),
        points_mm=transform(parameters.points_mm),
        relative=tuple(
            RelativePose(p.rotation, scale * p.translation_mm) for p in parameters.relative
        ),
    )


class STransformation:
    """Covariances in the datum of a free network: S C S^T with S = 1 - E (B^T E)^-1 B^T.

    gauge: directions E and constraint B; covariance_times_b: products C B of the covariance C to
    transform. Blocks are transformed one by one: each side of a block is a pair (H, V) of rows of
    E (B^T E)^-1 and of C B, from `exteriors`, `points` or `globals`.
    """

    def __init__(self, gauge: Gauge, covariance_times_b: UnknownVector) -> None:
        e = gauge.directions
        inverse = np.linalg.inv(np.einsum('nia,nib->ab', gauge.constraint, e.points))
        self.exteriors = (e.exteriors @ inverse, covariance_times_b.exteriors)
        self.points = (e.points @ inverse, covariance_times_b.points)
        self.globals = (e.globals @ inverse, covariance_times_b.globals)
        self._middle = np.einsum('nia,nib->ab', gauge.constraint, covariance_times_b.points)

    def transform(
        self,
        covariance: NDArray[np.float64],
        left: tuple[NDArray[np.float64], NDArray[np.float64]],
        right: tuple[NDArray[np.float64], NDArray[np.float64]],
    ) -> NDArray[np.float64]:
        """Return covariances (..., i, j) in the new datum; left and right: sides of the block."""
        h_left, v_left = left
        h_right, v_right = right
        h_right_t = np.swapaxes(h_right, -1, -2)
        v_right_t = np.swapaxes(v_right, -1, -2)
        return (
            covariance
            - h_left @ v_right_t
            - v_left @ h_right_t
            + h_left @ self._middle @ h_right_t
        )
