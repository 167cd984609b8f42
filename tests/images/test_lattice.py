# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Flat grids in images are numbered along rows and columns, even if these are curved."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from rigs import refused

from fluoro_calib_ros.errors import DataError
from fluoro_calib_ros.findings import Kind
from fluoro_calib_ros.images import lattice
from fluoro_calib_ros.images.growth import Seen, settle
from fluoro_calib_ros.images.lattice import FlatGrid, number_lattice
from fluoro_calib_ros.images.matching import PhantomModel, match
from fluoro_calib_ros.images.view import Lens
from fluoro_calib_ros.photogrammetry.rotations import matrix_from_vector

LENS = Lens((1024, 1024), 4000.0)
SQUARE = np.array([[10.0, 0.0], [0.0, 10.0]])
HEXAGONAL = np.array([[10.0, 0.0], [5.0, 8.66]])


def grid(steps: np.ndarray, count: int = 15, missing: int = 0) -> np.ndarray:
    place = np.array([(i, j) for i in range(count) for j in range(count)]) - count // 2
    xyz = np.column_stack([place @ steps, np.zeros(len(place))])
    kept = np.random.default_rng(1).permutation(len(xyz))[: len(xyz) - missing]
    return xyz[np.sort(kept)]


def pixels(xyz: np.ndarray, tilt: tuple[float, float, float]) -> np.ndarray:
    """Return pixels with a pincushion distortion of 30 px at the rim; NaN outside the image."""
    x = xyz @ matrix_from_vector(tilt).T + (4.0, -6.0, 1000.0)
    ideal = 4000 * x[:, :2] / x[:, 2:]
    uv = ideal * (1 + 0.06 * np.sum((ideal / 512) ** 2, axis=1, keepdims=True)) + 511.5
    inside = ((uv > 0) & (uv < 1023)).all(axis=1)
    return np.where(inside[:, None], uv, np.nan)


def seen_of(uv: np.ndarray, extra: int = 0) -> Seen:
    rng = np.random.default_rng(3)
    there = uv[np.isfinite(uv[:, 0])]
    points = np.concatenate(
        [there + rng.normal(0, 0.1, there.shape), rng.uniform(0, 1023, (extra, 2))]
    )
    return Seen.of(points, np.ones((1024, 1024), bool), 3.0)


@pytest.mark.parametrize('steps', [SQUARE, HEXAGONAL])
@pytest.mark.parametrize('tilt', [(0.0, 0.0, 0.3), (0.3, -0.4, 2.0), (-0.5, 0.1, 4.0)])
def test_a_grid_with_missing_beads_is_told_from_its_symmetries(steps, tilt):
    xyz = grid(steps, missing=15)
    true = pixels(xyz, tilt)
    seen = seen_of(true, extra=20)
    found = match(seen, PhantomModel.of(xyz), LENS)
    away = np.linalg.norm(seen.uv[found.detection] - true[found.bead], axis=1)
    assert np.mean(away < 1) > 0.97
    assert len(found.bead) > 0.9 * np.isfinite(true[:, 0]).sum()


@pytest.mark.long
def test_a_regular_grid_is_ambiguous_unless_any_place_will_do():
    xyz = grid(SQUARE, 27)  # extends beyond the image
    seen = seen_of(pixels(xyz, (0.2, 0.1, 0.5)))
    with refused(Kind.POSE_AMBIGUOUS):
        match(seen, PhantomModel.of(xyz), LENS)
    found = match(seen, PhantomModel.of(xyz, regular=True), LENS)
    assert len(found.bead) > 0.97 * len(seen.uv)
    # The place is arbitrary, but beads that are neighbours in the image are so in the grid.
    _, near = seen.tree.query(seen.uv[found.detection], k=2)
    row = np.full(len(seen.uv), -1)
    row[found.detection] = found.bead
    pairs = row[near]
    pairs = pairs[(pairs >= 0).all(axis=1)]
    assert np.allclose(np.linalg.norm(xyz[pairs[:, 0]] - xyz[pairs[:, 1]], axis=1), 10.0)


@pytest.mark.parametrize('steps', [SQUARE, HEXAGONAL])
@pytest.mark.parametrize('blocked', [1, 2, 5])
def test_blocked_holes_tell_where_a_sheet_is(steps, blocked):
    every = grid(steps)
    # The first mark lies on no axis of symmetry, so that the sheet looks different from behind.
    order = np.argsort(np.linalg.norm(every - (21.0, 9.0, 0.0), axis=1))
    xyz = np.delete(every, order[:blocked], axis=0)
    true = pixels(xyz, (0.1, -0.05, 2.0))
    seen = seen_of(true)
    found = match(seen, PhantomModel.of(xyz), LENS)
    away = np.linalg.norm(seen.uv[found.detection] - true[found.bead], axis=1)
    assert len(found.bead) > 0.97 * len(seen.uv)
    assert away.max() < 1


SIDE = 11  # rows of holes whose responses differ


def with_responses(seen: Seen, true: np.ndarray, enlarged: list[int]) -> Seen:
    """Return the detections with the responses to the holes, which scatter most at the rim."""
    response = np.random.default_rng(5).normal(0, 0.04, len(true))
    place = np.arange(len(true))
    rim = np.isin([place // SIDE, place % SIDE], (0, SIDE - 1)).any(axis=0)
    response[rim] -= np.random.default_rng(6).uniform(0, 0.6, rim.sum())
    response[enlarged] += 0.35
    return replace(seen, strength=np.exp(response))


@pytest.mark.parametrize('steps', [SQUARE, HEXAGONAL])
@pytest.mark.parametrize('count', [1, 2])
def test_enlarged_holes_tell_where_a_sheet_is(steps, count):
    xyz = grid(steps, SIDE)
    order = np.argsort(np.linalg.norm(xyz - (21.0, 9.0, 0.0), axis=1))
    diameter = np.full(len(xyz), 2.0)
    diameter[order[:count]] *= 1.4
    for tilt in ((0.1, -0.05, 2.0), (np.pi, 0.1, 1.0)):
        true = pixels(xyz, tilt)
        assert np.isfinite(true).all()
        seen = with_responses(seen_of(true), true, list(order[:count]))
        found = match(seen, PhantomModel.of(xyz, diameter), LENS)
        assert np.array_equal(found.bead, found.detection)


def test_an_enlarged_hole_on_an_axis_of_symmetry_does_not_tell_the_side_of_a_sheet():
    xyz = grid(SQUARE, SIDE)
    diameter = np.full(len(xyz), 2.0)
    mark = int(np.argmin(np.linalg.norm(xyz - (20.0, 20.0, 0.0), axis=1)))
    diameter[mark] *= 1.4
    true = pixels(xyz, (0.1, -0.05, 2.0))
    seen = with_responses(seen_of(true), true, [mark])
    with refused(Kind.POSE_AMBIGUOUS):
        match(seen, PhantomModel.of(xyz, diameter), LENS)


def test_a_mark_outside_of_the_image_does_not_tell_where_a_sheet_is():
    xyz = grid(SQUARE, 27)
    xyz = np.delete(xyz, 1, axis=0)
    with refused(Kind.POSE_AMBIGUOUS):
        match(seen_of(pixels(xyz, (0.2, 0.1, 0.5))), PhantomModel.of(xyz), LENS)


@pytest.mark.long
def test_a_sheet_without_mark_is_indexed_from_the_middle():
    xyz = grid(HEXAGONAL, 41)
    seen = seen_of(pixels(xyz, (0.1, 0.05, 0.2)))
    found = match(seen, PhantomModel.of(xyz, regular=True), LENS)
    centre = found.bead[np.argmin(np.linalg.norm(xyz[found.bead], axis=1))]
    at = seen.uv[found.detection[found.bead == centre]][0]
    spacing = float(np.median(seen.tree.query(seen.uv, k=[2])[0]))
    assert np.linalg.norm(xyz[centre]) == 0
    assert np.linalg.norm(at - LENS.centre) < 0.7 * spacing
    # Upright: what is on the right in the sheet is on the right in the image.
    assert np.corrcoef(xyz[found.bead, 0], seen.uv[found.detection, 0])[0, 1] > 0.8


def test_a_phantom_in_space_is_no_regular_grid():
    xyz = np.random.default_rng(2).uniform(-50, 50, (60, 3))
    with pytest.raises(DataError, match='not a flat grid'):
        PhantomModel.of(xyz, regular=True)


def test_scattered_points_have_no_lattice():
    points = np.random.default_rng(4).uniform(0, 100, (200, 2))
    assert number_lattice(points) is None
    assert number_lattice(points[:5]) is None


@pytest.mark.parametrize('turn', [(0.0, 0.0, 0.0), (0.4, 1.9, -0.7), (2.2, 0.1, 0.9)])
def test_a_grid_is_told_whatever_the_frame_of_its_survey_is(turn):
    """The axes used are those of the beads, not of the frame."""
    xyz = grid(np.array([[10.0, 0.0], [0.0, 16.0]]), 11, missing=9)
    true = pixels(xyz, (0.2, -0.3, 0.4))
    seen = seen_of(true)
    surveyed = xyz @ matrix_from_vector(turn).T + [300.0, -50, 20]
    found = match(seen, PhantomModel.of(surveyed), LENS)
    away = np.linalg.norm(seen.uv[found.detection] - true[found.bead], axis=1)
    assert np.mean(away < 1) > 0.97
    assert len(found.bead) > 0.9 * np.isfinite(true[:, 0]).sum()


def test_a_hexagonal_sheet_with_a_blocked_hole_has_equally_long_steps():
    """With rounding errors, the shortest two of its three steps had been exchanged for ever."""
    i, j = np.mgrid[:20, :20].reshape(2, -1) - 9.5
    y = 6 * j * (np.sqrt(3) / 2)
    xyz = np.column_stack([6 * (i + 0.5 * (j % 2)), y, np.zeros(400)])
    for blocked in (163, 0, 210):
        grid = FlatGrid.of(np.delete(xyz, blocked, axis=0))
        places = np.delete(xyz, blocked, axis=0)[grid.lattice.row, :2]
        terms = np.column_stack([grid.lattice.index, np.ones(len(places))])
        steps = np.linalg.lstsq(terms, places, rcond=None)[0][:2]
        np.testing.assert_allclose(np.linalg.norm(steps, axis=1), 6.0, atol=1e-9)


@pytest.mark.parametrize('steps', [SQUARE, HEXAGONAL])
def test_a_lattice_is_numbered_along_its_shortest_steps_also_where_it_begins_in_a_gap(steps):
    place = np.array([(i, j) for i in range(-4, 5) for j in range(-4, 5)])
    gone = [(1, 0), (-1, 0), (0, 1), (-1, 1), (1, -1)]
    place = place[~(place[:, None] == gone).all(axis=2).any(axis=1)]
    found = number_lattice(place @ steps)
    assert len(found.row) == len(place)
    known = np.column_stack([found.index, np.ones(len(place))])
    along = np.linalg.lstsq(known, (place @ steps)[found.row], rcond=None)[0][:2]
    np.testing.assert_allclose(np.linalg.norm(along, axis=1), 10, rtol=1e-3)


def test_a_grid_that_is_told_by_its_first_pose_is_not_fitted_elsewhere(monkeypatch):
    fitted = []
    monkeypatch.setattr(lattice, 'settle', lambda *given: fitted.append(1) or settle(*given))
    rng = np.random.default_rng(2)
    xyz = grid(SQUARE, 21, missing=25)
    true = pixels(xyz, (0.2, -0.1, 0.7))
    found = match(seen_of(true), PhantomModel.of(xyz), LENS)
    assert len(found.bead) > 0.9 * np.isfinite(true[:, 0]).sum() and len(fitted) == 1
    # With irregular places, few poses are fitted.
    fitted.clear()
    xyz[:, :2] = (grid(SQUARE, 21) + rng.uniform(-1.5, 1.5, (441, 3)))[: len(xyz), :2]
    match(seen_of(pixels(xyz, (0.2, -0.1, 0.7))), PhantomModel.of(xyz), LENS)
    assert len(fitted) <= 8


def test_a_lattice_of_unlike_steps_is_numbered_around_its_gaps():
    """A point next to it, nearer than the long step, does not become a place of the lattice."""
    place = np.array([(i, j) for i in range(9) for j in range(6)])
    place = place[~((place[:, 0] == 4) & (place[:, 1] < 4))]
    points = place * [10.0, 45.0]
    points = np.vstack([points, [[38.0, 10.0], [42.0, 57.0]]])
    found = number_lattice(points)
    kept = found.row < len(place)
    assert kept.sum() == len(place)
    change = np.linalg.lstsq(
        place[found.row[kept]] - place[found.row[kept]].mean(axis=0),
        found.index[kept] - found.index[kept].mean(axis=0),
        rcond=None,
    )[0]
    np.testing.assert_allclose(change, np.rint(change), atol=1e-9)
    assert abs(np.linalg.det(change)) == pytest.approx(1)
    assert kept.all()
