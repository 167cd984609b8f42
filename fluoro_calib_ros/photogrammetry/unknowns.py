# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The unknowns of a bundle adjustment: their layout, their values and a step of the values.

Relative orientation of two fluoroscopes, and the constraint that it does not change.
`relative_orientation` holds the mathematics of the constraint.

Unknowns that belong to one exposure or to one object point form small blocks. All others are
global, as they touch many image points: interior orientations, relative orientations, additional
parameters, in this order.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from .rotations import matrix_from_vector

POSE_SIZE = 6  # translation [mm], rotation vector [rad]
# Standard deviations that stand for a rigid mounting: a thousandth of what one pair of exposures
# determines from images of 0.25 px noise. The solution is that of the limit within some 1e-5
# standard deviations, and rounding errors are still far away.
RIGID_SD_MM = 3e-4
RIGID_SD_RAD = 1e-7


@dataclass(frozen=True)
class RelativeConstraint:
    """Constraint that the relative orientation of two fluoroscopes is the same in all pairs."""

    fluoroscopes: tuple[int, int]  #: numbers of the fluoroscopes a and b
    pairs: NDArray[np.int64]  #: (k, 2) rows of the common exposures of a and of b
    #: standard deviations of each component of translation and rotation
    sd_mm: float
    sd_rad: float
    #: distance of the sources at which `sd_mm` holds; it makes the constraint follow the scale of
    #: a free network; None where the scale is fixed
    length_mm: float | None = None

    @property
    def weights(self) -> NDArray[np.float64]:
        """Weights (6,) of the components of the constraint."""
        return np.repeat([self.sd_mm**-2.0, self.sd_rad**-2.0], 3)


@dataclass(frozen=True)
class RelativePose:
    """Relative orientation of fluoroscope b with respect to a.

    rotation (3, 3) from the sensor frame of a to that of b; translation_mm (3,) of the source of b
    in the sensor frame of a.
    """

    rotation: np.ndarray
    translation_mm: np.ndarray

    def updated(self, step: np.ndarray) -> RelativePose:
        """The pose after a step (6,): translation [mm], rotation [rad] on the left."""
        step = np.asarray(step)
        return RelativePose(
            matrix_from_vector(step[3:]) @ self.rotation, self.translation_mm + step[:3]
        )


EXTERIOR_SIZE = 6  # source T [mm], rotation vector w [rad]
POINT_SIZE = 3
INTERIOR_SIZE = 3  # xp, yp, c [px]


@dataclass(frozen=True)
class ReducedLayout:
    """Order of the unknowns after an elimination: blocks of one kind, then the free globals."""

    #: number and size of the blocks: exposures or object points
    n_blocks: int
    block_size: int
    n_globals: int  #: number of free global unknowns

    @property
    def blocks(self) -> slice:
        """Rows of all blocks."""
        return slice(0, self.n_blocks * self.block_size)

    @property
    def globals(self) -> slice:
        """Rows of the free global unknowns."""
        return slice(self.blocks.stop, self.size)

    @property
    def size(self) -> int:
        """Number of unknowns."""
        return self.blocks.stop + self.n_globals

    @property
    def block_rows(self) -> np.ndarray:
        """Rows (n_blocks, block_size) of each block."""
        return np.arange(self.blocks.stop).reshape(self.n_blocks, self.block_size)


@dataclass(frozen=True)
class UnknownLayout:
    """Where the unknowns of a network stand."""

    #: numbers of the block unknowns
    n_exposures: int
    n_points: int
    #: columns of the interior orientation of each fluoroscope among the global unknowns
    interiors: tuple[slice, ...]
    #: columns of each constrained relative orientation among the global unknowns
    relative: tuple[slice, ...]
    #: columns of the additional parameters of each fluoroscope among the global unknowns, empty
    #: where there are none
    additional: tuple[slice, ...]
    free: NDArray[np.bool_]  #: (G,) which global unknowns are estimated
    datum_defect: int  #: number of unknowns that the datum of a free network fixes

    @classmethod
    def of(
        cls,
        shape: tuple[int, int],
        interior_free: NDArray[np.bool_],
        n_relative: int,
        additional_sizes: Sequence[int],
        datum_defect: int,
    ) -> UnknownLayout:
        """Layout of the unknowns of a network.

        Parameters
        ----------
        shape : (int, int)
            Numbers of exposures and of object points.
        interior_free : (F,) ndarray of bool
            Whether the interior orientation of a fluoroscope is estimated.
        n_relative : int
            Number of constrained relative orientations.
        additional_sizes : sequence of int
            Numbers of additional parameters of the fluoroscopes.
        datum_defect : int
            Number of unknowns that the datum of a free network fixes.
        """
        n_fluoroscopes = len(interior_free)
        sizes = [INTERIOR_SIZE] * n_fluoroscopes
        sizes += [POSE_SIZE] * n_relative
        sizes += additional_sizes
        stops = np.cumsum(sizes, dtype=int)
        columns = [slice(int(stop - size), int(stop)) for stop, size in zip(stops, sizes)]
        first_additional = n_fluoroscopes + n_relative
        free = np.ones(sum(sizes), dtype=bool)
        free[: INTERIOR_SIZE * n_fluoroscopes] = np.repeat(interior_free, INTERIOR_SIZE)
        return cls(
            *shape,
            tuple(columns[:n_fluoroscopes]),
            tuple(columns[n_fluoroscopes:first_additional]),
            tuple(columns[first_additional:]),
            free,
            datum_defect,
        )

    @property
    def n_globals(self) -> int:
        """Number G of global unknowns, free or fixed."""
        return len(self.free)

    @cached_property
    def n_free_globals(self) -> int:
        """Number of estimated global unknowns."""
        return int(self.free.sum())

    @property
    def n_unknowns(self) -> int:
        """Number of scalar unknowns, less those that the datum of a free network fixes."""
        blocks = EXTERIOR_SIZE * self.n_exposures + POINT_SIZE * self.n_points
        return blocks + self.n_free_globals - self.datum_defect

    @property
    def all_interiors(self) -> slice:
        """Columns of all interior orientations among the global unknowns."""
        return slice(0, INTERIOR_SIZE * len(self.interiors))

    @property
    def all_orientations(self) -> slice:
        """Columns of all interior and relative orientations among the global unknowns."""
        return slice(0, self.all_interiors.stop + POSE_SIZE * len(self.relative))

    @property
    def all_additional(self) -> slice:
        """Columns of the additional parameters of all fluoroscopes among the global unknowns."""
        return slice(self.all_orientations.stop, self.n_globals)

    @cached_property
    def without_points(self) -> ReducedLayout:
        """Order of the unknowns after the elimination of the object points."""
        return ReducedLayout(self.n_exposures, EXTERIOR_SIZE, self.n_free_globals)

    @cached_property
    def without_exposures(self) -> ReducedLayout:
        """Order of the unknowns after the elimination of the exposures."""
        return ReducedLayout(self.n_points, POINT_SIZE, self.n_free_globals)

    def expand_globals(self, free_values: np.ndarray) -> np.ndarray:
        """Values (G, ...) of all global unknowns from the free ones; zeros where fixed."""
        out = np.zeros((self.n_globals, *free_values.shape[1:]))
        out[self.free] = free_values
        return out


@dataclass(frozen=True)
class UnknownVector:
    """A vector, or columns of vectors, over the unknowns of a network, split by kind."""

    exteriors: NDArray[np.float64]  #: (m, 6, ...) of T [mm] and w [rad] of the exposures
    points: NDArray[np.float64]  #: (n, 3, ...) of the object points [mm]
    globals: NDArray[np.float64]  #: (G, ...) of the global unknowns; zeros where fixed


@dataclass(frozen=True)
class Parameters:
    """Values of the unknowns of a network."""

    interior: NDArray[np.float64]  #: (F, 3) xp, yp, c of the fluoroscopes [px]
    rotation: NDArray[np.float64]  #: (m, 3, 3) rotations phantom -> sensor of the exposures
    position_mm: NDArray[np.float64]  #: (m, 3) positions of the source
    points_mm: NDArray[np.float64]  #: (n, 3) object points
    #: (p,) coefficients of the additional parameters of each fluoroscope
    additional: tuple[NDArray[np.float64] | None, ...] = ()
    #: relative orientation of each constraint of the network
    relative: tuple[RelativePose, ...] = ()

    def additional_of(self, f: int) -> NDArray[np.float64]:
        """Coefficients of the additional parameters of fluoroscope f, which has some."""
        coefficients = self.additional[f]
        assert coefficients is not None
        return coefficients
