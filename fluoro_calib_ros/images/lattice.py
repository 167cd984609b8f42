# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Poses of flat grids: beads are numbered along rows and columns in the image and in the phantom.

Both numberings differ by a change of the basis of the lattice and a shift. All small changes of
the basis are tried, with the shifts that have the fewest contradictions: beads detected where the
phantom has none, and missing beads whose surroundings are detected. Thus one blocked hole of a
sheet determines its position.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from itertools import product

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_closing, binary_erosion
from scipy.spatial import cKDTree

from ..findings import Finding, Kind, Severity
from .growth import MIN_SHARE, Coordinates, Match, Seen, settle
from .view import Lens, View, fit_view

FLAT = 0.02  # largest thickness over the extent of a flat phantom
REACH = 0.3  # largest distance of a bead from its place, over the distance between neighbours
MIN_ANGLE = np.deg2rad(35.0)  # least angle between the steps of a lattice, also in an oblique view
CENTRAL = 8  # number of beads in the middle from which a search starts
MIN_NUMBERED = 0.6  # share of the beads that a numbering must reach
# Relative reduction of a squared step that is not a rounding error: of a hexagonal lattice, three
# steps are equally long.
SHORTER = 1e-9
GAP = 2  # half the width of the largest gap, in missing beads
SHIFTS = 6  # number of best shifts for each basis
DEGREE = 3  # degree of the distortion during the refinement of a candidate
STEPS = 3  # number of steps of the refinement

# Note on images of a grid of which any place is accepted.
NOT_MARKED = Finding(
    Kind.GRID_NOT_MARKED,
    'the grid is treated as unmarked: ids count from the hole nearest to the centre of each image',
    advice='this suffices for the distortion of one fluoroscope, not for the orientation of two',
    severity=Severity.NOTE,
)


@dataclass(frozen=True)
class Lattice:
    """Beads of a plane, numbered in rows and columns."""

    row: NDArray[np.int64]  #: (n,), rows of the numbered beads
    index: NDArray[np.int64]  #: (n, 2), indices of the beads along both steps of the lattice


@dataclass(frozen=True)
class FlatGrid:
    """A flat phantom on a lattice."""

    lattice: Lattice
    centre: NDArray[np.float64]  #: (3,) [mm]
    axes: NDArray[np.float64]  #: (3, 3), rows: two directions in the plane, and its normal

    @classmethod
    def of(cls, xyz: NDArray[np.float64]) -> FlatGrid | None:
        """Return the grid of beads (n, 3) [mm]; None if they are not flat, or form no lattice."""
        centre = xyz.mean(axis=0)
        _, extent, axes = np.linalg.svd(xyz - centre, full_matrices=False)
        if len(extent) < 3 or extent[2] > FLAT * extent[0]:
            return None
        lattice = number_lattice((xyz - centre) @ axes[:2].T)
        return None if lattice is None else cls(lattice, centre, axes)


def number_lattice(points: NDArray[np.float64]) -> Lattice | None:
    """Number points (n, 2) of a plane along the steps of their lattice; None for no lattice.

    The lattice may be bent: a step is compared with neighbouring steps.
    """
    if len(points) < 9:
        return None
    tree = cKDTree(points)
    central = np.argsort(np.linalg.norm(points - np.median(points, axis=0), axis=1), kind='stable')
    for start in central[:CENTRAL]:
        basis = _basis(points, tree, int(start))
        if basis is None:
            continue
        number = _numbered(points, tree, int(start), basis)
        if len(number) >= MIN_NUMBERED * len(points):
            row = np.array(list(number))
            return Lattice(row, _shortest_steps(np.array(list(number.values())), points[row]))
    return None


def _shortest_steps(index: NDArray[np.int64], points: NDArray[np.float64]) -> NDArray[np.int64]:
    """Return indices (n, 2) of points (n, 2) along the two shortest steps of their lattice.

    If beads are missing around the first bead, its steps are too long. Gauss's reduction (Cohen, A
    Course in Computational Algebraic Number Theory, 1993, algorithm 1.3.14).
    """
    short, long = _steps(index, points)
    change = np.eye(2, dtype=np.int64)
    while True:
        if short @ short > long @ long:
            short, long, change = long, short, change[:, ::-1]
        times = round(float(short @ long / (short @ short)))
        shorter = long - times * short
        if shorter @ shorter > (1 - SHORTER) * (long @ long):
            return index @ change
        long = shorter
        change = change + np.outer(change[:, 1], [times, 0])


def _basis(points: NDArray[np.float64], tree: cKDTree, start: int) -> NDArray[np.float64] | None:
    """Return two steps (2, 2) of the lattice at a point: the shortest, and the next across it."""
    _, near = tree.query(points[start], k=min(13, len(points)))
    steps = points[near[1:]] - points[start]
    first = steps[0]
    for second in steps[1:]:
        length = np.linalg.norm(first) * np.linalg.norm(second)
        sine = abs(first[0] * second[1] - first[1] * second[0]) / max(length, 1e-12)
        if sine > np.sin(MIN_ANGLE):
            return np.stack([first, second])
    return None


def _numbered(
    points: NDArray[np.float64], tree: cKDTree, start: int, basis: NDArray[np.float64]
) -> dict[int, tuple[int, int]]:
    """Return the indices of points that can be reached step by step from a start."""
    number = {start: (0, 0)}
    used = {(0, 0)}
    steps = {start: basis}
    waiting = deque([start])
    while waiting:
        point = waiting.popleft()
        local = steps[point]
        reach = REACH * float(np.linalg.norm(local, axis=1).min())
        for axis, sign in product((0, 1), (1, -1)):
            index = list(number[point])
            index[axis] += sign
            key = (index[0], index[1])
            if key in used:
                continue
            distance, neighbour = tree.query(points[point] + sign * local[axis])
            if distance > reach or neighbour in number:
                continue
            used.add(key)
            number[neighbour] = key
            # Average the new step with the old: one misplaced bead does not turn the lattice.
            new_steps = local.copy()
            new_steps[axis] = 0.5 * (local[axis] + sign * (points[neighbour] - points[point]))
            steps[neighbour] = new_steps
            waiting.append(neighbour)
    return number


@dataclass(frozen=True)
class GridPose:
    """Placement of detections on a flat grid."""

    #: number of beads detected where the grid has none, and of missing beads of the grid
    against: int
    numbered: int  #: number of beads detected in rows and columns
    fit: Callable[[], Match | None]  #: returns the match, None if no pose fits


def grid_poses(grid: FlatGrid, phantom: Coordinates, seen: Seen, lens: Lens) -> Iterator[GridPose]:
    """Yield poses of a flat grid, those with the fewest contradictions first.

    Poses with equally many are in order of tilt, the least tilted first, then by how upright they
    are, then by the distance of their middle from that of the image.
    """
    xyz = phantom.xyz
    detected = number_lattice(seen.uv)
    if detected is None:
        return
    missing = _missing(detected.index)
    middle_index = detected.index[
        np.argmin(np.linalg.norm(seen.uv[detected.row] - lens.centre, axis=1))
    ]
    image_steps = _steps(detected.index, seen.uv[detected.row])
    grid_steps = _steps(grid.lattice.index, (xyz[grid.lattice.row] - grid.centre) @ grid.axes.T)
    central = np.argmin(np.linalg.norm(xyz[grid.lattice.row] - grid.centre, axis=1))
    target = grid.lattice.index[central]
    candidates = []
    for change in _changes():
        view = np.linalg.pinv(grid_steps) @ np.linalg.inv(change) @ image_steps
        long, short = np.linalg.svd(view, compute_uv=False)
        upright = (grid.axes.T @ view)[:2].trace() / (long + short)
        turned = detected.index @ change
        shifts = _shifts(
            turned, missing @ change, grid.lattice.index, target - middle_index @ change
        )
        for shift, against in shifts:
            key = (against, -round(short / long, 1), -round(upright, 1))
            candidates.append((key, change, shift))
    candidates.sort(key=lambda candidate: candidate[0])
    row_at = {tuple(place): row for place, row in zip(grid.lattice.index, grid.lattice.row)}

    def fit(change: NDArray[np.int64], shift: NDArray[np.int64]) -> Match | None:
        places = detected.index @ change + shift
        bead = np.array([row_at.get((int(a), int(b)), -1) for a, b in places])
        known = bead >= 0
        if np.count_nonzero(known) < MIN_SHARE * len(known):
            return None
        view = _view(grid, xyz[bead[known]], seen.uv[detected.row[known]], lens)
        return None if view is None else settle(view, phantom, seen)

    for (against, *_), change, shift in candidates:
        yield GridPose(against, len(detected.index), partial(fit, change, shift))


def _steps(index: NDArray[np.int64], points: NDArray[np.float64]) -> np.ndarray:
    """Return mean steps (2, k) of a lattice with indices (n, 2) of points (n, k)."""
    centred = index - index.mean(axis=0)
    return np.linalg.lstsq(centred, points - points.mean(axis=0), rcond=None)[0]


def _missing(index: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return indices (k, 2) of a lattice without a detection but with detections all around."""
    corner = index.min(axis=0) - 2 * GAP
    occupied = np.pad(_raster(index - corner), ((0, 2 * GAP), (0, 2 * GAP))) > 0
    enclosed = binary_closing(occupied, np.ones((3, 3)), iterations=GAP)
    enclosed = binary_erosion(enclosed, np.ones((3, 3)))
    return np.argwhere(enclosed & ~occupied) + corner


def _changes() -> Iterator[NDArray[np.int64]]:
    """Yield changes (2, 2) of the basis of a lattice by at most one step."""
    for entries in product((-1, 0, 1), repeat=4):
        change = np.array(entries).reshape(2, 2)
        if abs(round(float(np.linalg.det(change)))) == 1:
            yield change


def _shifts(
    indices: NDArray[np.int64],
    missing: NDArray[np.int64],
    grid: NDArray[np.int64],
    wanted: np.ndarray,
) -> list[tuple[NDArray[np.int64], int]]:
    """Return shifts (2,) of indices (n, 2) onto a grid (m, 2), with their contradictions.

    Shifts with equally many are in order of their distance from a wanted shift (2,).
    """
    found_corner = indices.min(axis=0)
    grid_corner = grid.min(axis=0)
    grid_raster = _raster(grid - grid_corner)
    found_raster = _raster(indices - found_corner)
    missing_raster = np.zeros_like(found_raster)
    missing_raster[tuple((missing - found_corner).T)] = 1
    shape = tuple(np.array(grid_raster.shape) + found_raster.shape - 1)
    # A detected bead counts for a shift, a missing bead against it.
    kernel = np.fft.rfft2((found_raster - missing_raster)[::-1, ::-1], shape)
    overlap = np.rint(np.fft.irfft2(np.fft.rfft2(grid_raster, shape) * kernel, shape)).astype(int)
    start = grid_corner - found_corner - (np.array(found_raster.shape) - 1)
    i, j = np.indices(overlap.shape)
    distance = np.hypot(i + start[0] - wanted[0], j + start[1] - wanted[1])
    best = np.lexsort((distance.ravel(), -overlap.ravel()))[:SHIFTS]
    return [
        (np.array(place) + start, len(indices) - int(overlap[tuple(place)]))
        for place in np.column_stack(np.unravel_index(best, overlap.shape))
    ]


def _raster(places: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return an image with 1 at places (n, 2), which are not negative."""
    image = np.zeros(places.max(axis=0) + 1)
    image[tuple(places.T)] = 1
    return image


def _view(
    grid: FlatGrid, xyz: NDArray[np.float64], uv: NDArray[np.float64], lens: Lens
) -> View | None:
    """Return the view of matched beads of a grid; None if no pose fits them.

    Collins and Bartoli, "Infinitesimal plane-based pose estimation", IJCV 109, 2014.
    """
    c = lens.principal_distance_px
    interior = np.array([[c, 0, lens.centre[0]], [0, c, lens.centre[1]], [0, 0, 1]])
    turn = grid.axes if np.linalg.det(grid.axes) > 0 else grid.axes * [[1], [1], [-1]]
    plane = (xyz - grid.centre) @ turn.T
    plane[:, 2] = 0
    try:
        _, vectors, shifts, _ = cv2.solvePnPGeneric(
            plane, uv, interior, None, flags=cv2.SOLVEPNP_IPPE
        )
    except cv2.error:
        return None
    best: tuple[float, View] | None = None
    for vector, shift in zip(vectors, shifts):
        rotation = cv2.Rodrigues(vector)[0] @ turn
        position = grid.centre - rotation.T @ shift.ravel()
        view = View(
            lens,
            rotation,
            position=position,
            principal_distance_px=c,
            coefficients=lens.expected(DEGREE),
            degree=DEGREE,
        )
        if (view.depth(xyz) <= 0).any():
            continue
        view, scale = fit_view(view, xyz, uv, STEPS, 0.3)
        if best is None or scale < best[0]:
            best = scale, view
    return None if best is None else best[1]
