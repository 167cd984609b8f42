# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Solution of the normal equations, with object points or exposures eliminated first.

Schur complement: Triggs, McLauchlan, Hartley and Fitzgibbon, "Bundle Adjustment - A Modern
Synthesis", 2000, section 6. Eliminating the object points leaves a system of exposures, and
eliminating the exposures leaves one of object points; each is bordered by the global unknowns.
Exposures that are coupled by a relative orientation are eliminated together. The class
`Elimination` hides everything that depends on this choice.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import blas, cho_factor, cho_solve, lapack

from .collinearity import ALL
from .network import Gauge, Network, stabilising_factor
from .normal_equations import NormalEquations
from .rotations import mirror_lower
from .unknowns import POINT_SIZE, POSE_SIZE, RelativeConstraint, UnknownVector

T = TypeVar('T')


@dataclass(frozen=True)
class BorderedSystem:
    """Normal equations [B C; C^T D] (x_b, x_r) = (b, r) with a block-diagonal part B."""

    blocks: NDArray[np.float64]  #: (k, s, s) B: blocks of the eliminated unknowns
    border: NDArray[np.float64]  #: (k, s, q) C: their mixed blocks with the remaining unknowns
    remaining: NDArray[np.float64]  #: (q, q) D: normal matrix of the remaining unknowns
    block_right: NDArray[np.float64]  #: (k, s) right side b
    rest_right: NDArray[np.float64]  #: (q,) right side r

    @property
    def right(self) -> NDArray[np.float64]:
        """Right side (x,): b, block by block, then r."""
        return np.concatenate([self.block_right.ravel(), self.rest_right])

    def damped(self, mu: float) -> BorderedSystem:
        """Return a copy with the diagonal multiplied by 1 + mu."""
        blocks = self.blocks + mu * self.blocks * np.eye(self.blocks.shape[1])
        remaining = self.remaining.copy()
        remaining.ravel()[:: len(remaining) + 1] *= 1 + mu
        return replace(self, blocks=blocks, remaining=remaining)

    def predicted_decrease(
        self, x_blocks: NDArray[np.float64], x_remaining: NDArray[np.float64], mu: float
    ) -> float:
        """Return the decrease of the linearised cost by a step damped by mu.

        Not finite if the step is too large for floating point.
        """
        with np.errstate(over='ignore', invalid='ignore'):
            undamped = np.sum(x_blocks * self.block_right) + np.sum(x_remaining * self.rest_right)
            damping = mu * (
                np.einsum('ki,kii,ki', x_blocks, self.blocks, x_blocks)
                + np.sum(x_remaining * x_remaining * np.diag(self.remaining))
            )
            return float((undamped + damping) / 2)

    def singular_schur_complement(self) -> NDArray[np.float64]:
        """Return the Schur complement (q, q) by pseudo-inverses, as the blocks may be singular."""
        inverse = np.linalg.pinv(self.blocks, hermitian=True)
        size = len(self.remaining)
        flat = self.border.reshape(-1, size)
        return self.remaining - flat.T @ (inverse @ self.border).reshape(-1, size)

    def factorize(self) -> BorderedFactor:
        """Return Cholesky factors of the system; overwrites `remaining`.

        Raises numpy.linalg.LinAlgError if the matrix is not positive definite, and ValueError if
        it is not finite.
        """
        inverse = np.linalg.inv(np.linalg.cholesky(self.blocks))
        half = (inverse @ self.border).reshape(-1, self.border.shape[2])
        if not half.shape[1]:  # BLAS reports empty matrices as an error
            return BorderedFactor(inverse, half, np.zeros((0, 0)))
        # BLAS stores by columns, where `half` is its own transpose: no copy is made, and dsyrk
        # takes half the operations of a full product.
        schur = blas.dsyrk(
            -1.0, half.T, beta=1.0, c=self.remaining.T, trans=0, lower=1, overwrite_c=1
        )
        return BorderedFactor(inverse, half, cho_factor(schur, lower=True, overwrite_a=True)[0])


@dataclass(frozen=True)
class BorderedFactor:
    """Cholesky factors of a BorderedSystem."""

    inverse: NDArray[np.float64]  #: (k, s, s) inverse Cholesky factors L^-1 of the blocks
    half_border: NDArray[np.float64]  #: (k s, q) H = L^-1 C
    #: (q, q) lower Cholesky factor of the Schur complement D - H^T H; its upper triangle is
    #: undefined
    schur: NDArray[np.float64]

    def solve(
        self, block_right: NDArray[np.float64], rest_right: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return x_b (k, s, ...) and x_r (q, ...) for right sides (k, s, ...) and (q, ...)."""
        columns = int(np.prod(block_right.shape[2:]))
        shape = (*self.inverse.shape[:2], columns)
        half = (self.inverse @ block_right.reshape(shape)).reshape(-1, columns)
        right = rest_right.reshape(-1, columns) - self.half_border.T @ half
        x_remaining = cho_solve((self.schur, True), right)
        remaining = (half - self.half_border @ x_remaining).reshape(shape)
        x_blocks = self.inverse.transpose(0, 2, 1) @ remaining
        return x_blocks.reshape(block_right.shape), x_remaining.reshape(rest_right.shape)

    def covariance(self) -> BorderedCovariance:
        """Return the blocks of the inverse of the matrix."""
        k, size = self.inverse.shape[:2]
        q = len(self.schur)
        lower, _ = lapack.dpotri(self.schur, lower=1)
        remaining = mirror_lower(lower)
        transposed = self.inverse.transpose(0, 2, 1)
        gain = transposed @ self.half_border.reshape(k, size, q)
        border = -(gain.reshape(-1, q) @ remaining).reshape(k, size, q)
        conditional = transposed @ self.inverse
        blocks = conditional - border @ gain.transpose(0, 2, 1)
        return BorderedCovariance(blocks, border, remaining, conditional, gain)


@dataclass(frozen=True)
class BorderedCovariance:
    """Blocks of the inverse of a bordered matrix."""

    blocks: NDArray[np.float64]  #: (k, s, s)
    border: NDArray[np.float64]  #: (k, s, q)
    #: (q, q); for the part between two different blocks, see `conditional` and `gain`
    remaining: NDArray[np.float64]
    #: (k, s, s) B^-1: covariances of the blocks with the remaining unknowns fixed
    conditional: NDArray[np.float64]
    #: (k, s, q) B^-1 C. The inverse between blocks i and j is (i = j) B^-1 - border[i] gain[j]^T
    gain: NDArray[np.float64]


@dataclass(frozen=True)
class CovarianceBlocks:
    """Blocks of the inverse normal matrix; zeros if a global unknown is fixed."""

    ee: NDArray[np.float64]  #: (m, 6, 6) of exposures e
    pp: NDArray[np.float64]  #: (n, 3, 3) of object points p
    gg: NDArray[np.float64]  #: (G, G) of global unknowns g
    eg: NDArray[np.float64]  #: (m, 6, G)
    pg: NDArray[np.float64]  #: (n, 3, G)
    #: pe(e, p): blocks (k, 3, 6) of object points p (k,) with exposures e (k,)
    pe: Callable[[NDArray[np.int64], NDArray[np.int64]], NDArray[np.float64]]
    #: between(e, f): blocks (k, 6, 6) of exposures e (k,) with exposures f (k,)
    between: Callable[[NDArray[np.int64], NDArray[np.int64]], NDArray[np.float64]]
    #: points_between(p, q): blocks (k, 3, 3) of object points p (k,) with object points q (k,)
    points_between: Callable[[NDArray[np.int64], NDArray[np.int64]], NDArray[np.float64]]


def eliminates_exposures(network: Network) -> bool:
    """Return whether to eliminate exposures, not points: what leaves the smaller system."""
    layout = network.layout
    return layout.without_points.blocks.stop >= layout.without_exposures.blocks.stop


class Elimination:
    """Order of the unknowns of a network for the solution of its normal equations.

    Blocks of one kind, exposures or object points, are eliminated; those of the other kind remain,
    followed by the free global unknowns, in the order of `layout`. Exposures that are eliminated
    and coupled by a constraint share a cell, that of the exposure of their first fluoroscope, so
    that their matrix is block-diagonal by cells. `cell` and `place` locate each eliminated block;
    every cell has `n_places`.

    of_exposures: whether exposures are eliminated; by default what leaves the smaller system.
    """

    def __init__(self, network: Network, of_exposures: bool | None = None) -> None:
        layout = network.layout
        self.network = network
        self.of_exposures = eliminates_exposures(network) if of_exposures is None else of_exposures
        self.layout, self.size = layout.without_points, POINT_SIZE
        count = network.n_points
        constraints: tuple[RelativeConstraint, ...] = ()
        if self.of_exposures:
            self.layout, self.size = layout.without_exposures, POSE_SIZE
            count = network.n_exposures
            constraints = network.relative
        representative = np.arange(count)
        self.place = np.zeros(count, dtype=int)
        for number, constraint in enumerate(constraints):
            a, b = constraint.pairs.T
            representative[b] = a
            self.place[b] = number + 1
        cells, self.cell = np.unique(representative, return_inverse=True)
        self.n_cells = len(cells)
        self.n_places = len(constraints) + 1
        #: places of the blocks among those of all cells
        self._slot = ALL if self.n_places == 1 else self.cell * self.n_places + self.place

    def _in_order(self, of_exposures: T, of_points: T) -> tuple[T, T]:
        """Return what belongs to eliminated and to remaining blocks, or both back by kind."""
        both = of_exposures, of_points
        return both if self.of_exposures else both[::-1]

    def bordered_system(self, equations: NormalEquations) -> BorderedSystem:
        """Return the normal equations in the order of this elimination.

        Fixed global unknowns are omitted. The undetermined directions of a free network are fixed
        in the part that remains.
        """
        eliminated, remaining_blocks = self._in_order(equations.ee, equations.pp)
        own_globals, globals_of_remaining = self._in_order(equations.eg, equations.pg)
        remaining = self._remaining_matrix(remaining_blocks, globals_of_remaining, equations)
        if equations.gauge is not None:
            directions = equations.gauge.directions
            _, of_remaining = self._in_order(directions.exteriors, directions.points)
            self._fix_gauge(remaining, of_remaining)
        return BorderedSystem(
            self._cell_blocks(eliminated, equations),
            self._cell_border(own_globals, equations.pe),
            remaining,
            *self.right_sides(equations.right),
        )

    def right_sides(self, right: UnknownVector) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return right sides (k, s, ...) of eliminated and (q, ...) of remaining unknowns."""
        own, other = self._in_order(right.exteriors, right.points)
        columns = own.shape[2:]
        cell_right = np.zeros((self.n_cells * self.n_places, self.size, *columns))
        cell_right[self._slot] = own
        remaining = [other.reshape(-1, *columns), right.globals[self.network.layout.free]]
        return cell_right.reshape(self.n_cells, -1, *columns), np.concatenate(remaining)

    def to_unknowns(
        self, x_blocks: NDArray[np.float64], x_remaining: NDArray[np.float64]
    ) -> UnknownVector:
        """Return eliminated (k, s, ...) and remaining (q, ...) unknowns by kind."""
        shape = (*self.layout.block_rows.shape, *x_remaining.shape[1:])
        other = x_remaining[self.layout.blocks].reshape(shape)
        x_globals = self.network.layout.expand_globals(x_remaining[self.layout.globals])
        return UnknownVector(*self._in_order(self._of_blocks(x_blocks), other), x_globals)

    def covariance_blocks(self, covariance: BorderedCovariance) -> CovarianceBlocks:
        """Return covariances by kind of unknown."""
        remaining_blocks, gg, globals_of_remaining = self._split_remaining(covariance)
        border = self._of_blocks(covariance.border)
        gain = self._of_blocks(covariance.gain)
        pairs, own_globals = self._split_border(border)
        cell, place, rows = self.cell, self.place, self.layout.block_rows
        shape = (self.n_cells, self.n_places, self.size)
        blocks = covariance.blocks.reshape(*shape, *shape[1:])
        conditional = covariance.conditional.reshape(*shape, *shape[1:])

        def between(i: NDArray[np.int64], j: NDArray[np.int64]) -> NDArray[np.float64]:
            same_cell = (cell[i] == cell[j])[:, None, None]
            fixed = np.where(same_cell, conditional[cell[i], place[i], :, place[j], :], 0.0)
            count, size, width = border.shape
            if 2 * len(i) * width < size * count**2:  # too few pairs to multiply all blocks
                return fixed - border[i] @ gain[j].transpose(0, 2, 1)
            every = border.reshape(-1, width) @ gain.reshape(-1, width).T
            return fixed - every.reshape(count, size, count, size)[i, :, j, :]

        def between_remaining(i: NDArray[np.int64], j: NDArray[np.int64]) -> NDArray[np.float64]:
            return covariance.remaining[rows[i][:, :, None], rows[j][:, None, :]]

        def mixed(e: NDArray[np.int64], p: NDArray[np.int64]) -> NDArray[np.float64]:
            i, j = self._in_order(e, p)
            out = pairs[i, :, j, :]
            return out.transpose(0, 2, 1) if self.of_exposures else out

        ee, pp = self._in_order(blocks[cell, place, :, place, :], remaining_blocks)
        eg, pg = self._in_order(own_globals, globals_of_remaining)
        of_exposures, of_points = self._in_order(between, between_remaining)
        return CovarianceBlocks(
            ee=ee,
            pp=pp,
            gg=gg,
            eg=eg,
            pg=pg,
            pe=mixed,
            between=of_exposures,
            points_between=of_points,
        )

    def _of_blocks(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return values of the eliminated blocks from those of their cells (k, s, ...)."""
        return values.reshape(-1, self.size, *values.shape[2:])[self._slot]

    def _cell_blocks(
        self, own: NDArray[np.float64], equations: NormalEquations
    ) -> NDArray[np.float64]:
        """Return blocks (k, s, s) of the cells; an empty place has ones in its diagonal."""
        if self.n_places == 1:
            return own
        cell = self.cell
        place = self.place
        shape = (self.n_cells, self.n_places, self.size)
        blocks = np.zeros((*shape, *shape[1:]))
        diagonal = np.einsum('kiaia->kia', blocks)  # a view
        diagonal[...] = 1
        blocks[cell, place, :, place, :] = own
        a, b = equations.coupled_pairs.T
        blocks[cell[a], place[a], :, place[b], :] = equations.coupled
        blocks[cell[a], place[b], :, place[a], :] = equations.coupled.transpose(0, 2, 1)
        width = self.size * self.n_places
        return blocks.reshape(self.n_cells, width, width)

    def _cell_border(
        self, own_globals: NDArray[np.float64], pe: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return mixed blocks (k, s, q) of the cells with remaining blocks and global unknowns."""
        own, other = self._in_order(self.network.exposure, self.network.point)
        border = np.zeros((self.n_cells * self.n_places, self.size, self.layout.size))
        by_other = border[..., self.layout.blocks]
        by_other = by_other.reshape(*border.shape[:2], *self.layout.block_rows.shape)
        slot = self.cell[own] * self.n_places + self.place[own]
        by_other[slot, :, other, :] = pe.transpose(0, 2, 1) if self.of_exposures else pe
        columns = self.network.layout.free_columns
        border[self._slot, :, self.layout.globals] = own_globals[:, :, columns]
        return border.reshape(self.n_cells, -1, self.layout.size)

    def _remaining_matrix(
        self,
        remaining_blocks: NDArray[np.float64],
        own_globals: NDArray[np.float64],
        equations: NormalEquations,
    ) -> NDArray[np.float64]:
        """Return the matrix (q, q) of remaining blocks (c, s, s), mixed blocks (c, s, G), gg."""
        rows = self.layout.block_rows
        blocks = self.layout.blocks
        border = self.layout.globals
        free = self.network.layout.free
        out = np.zeros((self.layout.size, self.layout.size))
        out[rows[:, :, None], rows[:, None, :]] = remaining_blocks
        if not self.of_exposures:
            a, b = (rows[exposures] for exposures in equations.coupled_pairs.T)
            out[a[:, :, None], b[:, None, :]] = equations.coupled
            out[b[:, :, None], a[:, None, :]] = equations.coupled.transpose(0, 2, 1)
        out[blocks, border] = own_globals.reshape(rows.size, -1)[
            :, self.network.layout.free_columns
        ]
        out[border, blocks] = out[blocks, border].T
        out[border, border] = equations.gg[np.ix_(free, free)]
        return out

    def _fix_gauge(self, remaining: NDArray[np.float64], directions: NDArray[np.float64]) -> None:
        """Fix the undetermined directions (c, s, 7) of the remaining blocks in their matrix."""
        blocks = self.layout.blocks
        directions = directions.reshape(blocks.stop, -1)
        factor = stabilising_factor(directions, np.diagonal(remaining)[blocks])
        remaining[blocks, blocks] += factor @ factor.T

    def _split_remaining(
        self, covariance: BorderedCovariance
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """Split covariances of the remaining unknowns: (c, s, s), gg (G, G), mixed (c, s, G)."""
        remaining = covariance.remaining
        rows = self.layout.block_rows
        layout = self.network.layout
        gg = np.zeros((layout.n_globals, layout.n_globals))
        gg[np.ix_(layout.free, layout.free)] = remaining[self.layout.globals, self.layout.globals]
        mixed = np.zeros((*rows.shape, layout.n_globals))
        mixed[:, :, layout.free_columns] = remaining[
            self.layout.blocks, self.layout.globals
        ].reshape(*rows.shape, -1)
        return remaining[rows[:, :, None], rows[:, None, :]], gg, mixed

    def _split_border(
        self, border: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Split covariances (k, t, q) of other unknowns with the remaining unknowns.

        Returns those with the remaining blocks (k, t, c, s) and with all globals (k, t, G).
        """
        shape = border.shape[:2]
        with_globals = np.zeros((*shape, self.network.layout.n_globals))
        with_globals[:, :, self.network.layout.free_columns] = border[:, :, self.layout.globals]
        with_blocks = border[:, :, self.layout.blocks]
        return with_blocks.reshape(*shape, *self.layout.block_rows.shape), with_globals


@dataclass(frozen=True)
class FactorizedNormalMatrix:
    """A normal matrix after elimination and Cholesky factorization.

    gauge: undetermined directions of the network, or None. information_factor: part of the weights
    of the image points that is information (see `Noise`), if the matrix has the full weights; 1 if
    it already has that part.
    """

    elimination: Elimination
    factor: BorderedFactor
    gauge: Gauge | None = None
    information_factor: float = 1.0

    @property
    def network(self) -> Network:
        """The network that the matrix belongs to."""
        return self.elimination.network

    def solve(self, right: UnknownVector) -> UnknownVector:
        """Solve the normal equations for a right side, or for columns of right sides.

        For a free network, other directions are fixed than in its datum.
        """
        return self.elimination.to_unknowns(
            *self.factor.solve(*self.elimination.right_sides(right))
        )


def factorize(network: Network, equations: NormalEquations) -> FactorizedNormalMatrix:
    """Factorize normal equations.

    Raises numpy.linalg.LinAlgError if the matrix is singular.
    """
    elimination = Elimination(network)
    factor = elimination.bordered_system(equations).factorize()
    return FactorizedNormalMatrix(elimination, factor, equations.gauge)
