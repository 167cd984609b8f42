# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Parts of a correction: change with the angle, candidate neighbours, and errors of its cells."""

from dataclasses import replace

import numpy as np
import pytest
from rigs import create_model, pincushion, turning
from scipy.spatial import cKDTree

from fluoro_calib_ros.api import DataError, correct
from fluoro_calib_ros.correction.fluoroscope_calibration import (
    packed_profile,
    unpacked_profile,
)
from fluoro_calib_ros.correction.grid import CHUNK, CorrectionGrid
from fluoro_calib_ros.correction.grid_cells import (
    MAX_PARTS,
    PLACES,
    TARGET_PX,
    build_cells,
    divide_cells,
    errors_where_curved,
)
from fluoro_calib_ros.correction.neighbours import KnnModel, blocks_with_candidates
from fluoro_calib_ros.correction.series import MARGIN, Functions, without_absent_bands

SIZE = (320, 240)
UV = np.random.default_rng(2).uniform(40, 200, (30, 2))


def test_angle_adds_its_change_and_variance_to_the_correction():
    turned = turning(pincushion('a', SIZE))
    plain = turned.model.evaluate(UV)
    for angle in (0.3, np.linspace(-0.9, 0.9, 30)):
        change, variance = turned.angle_field.change(UV, angle)
        found = turned.correction(UV, angle)
        np.testing.assert_allclose(found.duv, plain.duv + change, atol=1e-12)
        assert np.abs(change).max() > 0.1
        np.testing.assert_allclose(found.sd**2, plain.sd**2 + variance, atol=1e-12)
        assert np.array_equal(found.outside, plain.outside)
        exact = turned.correct(UV, exact=True, angle=angle)
        np.testing.assert_allclose(exact.uv, UV - found.duv, atol=1e-12)
    beyond = turned.correction(UV, np.deg2rad(80))
    assert beyond.outside.all()
    unknown = turned.correction(UV)
    mean, variance = turned.angle_field.change(UV, np.nan)
    np.testing.assert_allclose(unknown.duv, plain.duv + mean, atol=1e-12)
    np.testing.assert_allclose(unknown.sd**2, plain.sd**2 + variance, atol=1e-12)


@pytest.mark.parametrize(
    ('kind', 'k', 'changed'),
    [
        ('knn', 3, {'train_duv': np.zeros((29, 2))}),
        ('knn', 3, {'train_uv': np.where(UV.max() == UV, np.nan, UV)}),
        ('knn', 3, {'train_duv': np.where(UV.max() == UV, np.inf, 0.0)}),
        ('knn', 0, {}),
        ('knn', 31, {}),
        ('parametric', 0, {}),
        ('no such kind', 3, {}),
    ],
)
def test_content_that_is_no_correction_is_refused(kind, k, changed):
    """A damaged file or message yields no model instead of one that corrects by garbage."""
    content = {'train_uv': UV, 'train_duv': np.zeros((30, 2))}
    for possible in (1, 30):
        assert create_model('knn', possible, **content).k == possible
    with pytest.raises(ValueError):
        create_model(kind, k, **{**content, **changed})


@pytest.mark.parametrize(
    ('count', 'first', 'last'),
    [(4, 1, 1), (6, 2, 2), (10, 3, 4), (50, 3, 20), (250, 3, 100), (10_000, 3, 100)],
)
def test_neighbours_that_are_tried_reach_from_three_to_forty_percent(count, first, last):
    assert KnnModel.candidate_k(count).tolist() == list(range(first, last + 1))


@pytest.mark.parametrize('affordable', [10**9, 60])
def test_errors_of_cells_are_those_of_the_interpolation_at_their_places(affordable):
    """Reference: loops. If few values are affordable, the most curved cells are measured."""
    model = pincushion('a', SIZE).model
    columns, rows = np.linspace(0, 300, 9), np.linspace(10, 230, 7)
    corners = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2)
    values = model.evaluate_in_bulk(corners).reshape(3, 7, 9)
    errors = errors_where_curved(model, (columns, rows), values, affordable)
    measured = np.argwhere(np.isfinite(errors[0]))
    assert len(measured) == min(48, affordable // len(PLACES))
    for j, i in measured:
        largest = np.zeros(3)
        for x, y in PLACES:
            at = [[columns[i] + x * np.diff(columns)[i], rows[j] + y * np.diff(rows)[j]]]
            between = sum(
                wx * wy * values[:, j + n, i + m]
                for m, wx in enumerate((1 - x, x))
                for n, wy in enumerate((1 - y, y))
            )
            error = np.abs(between - model.evaluate_in_bulk(np.array(at))[:, 0])
            largest = np.maximum(largest, error)
        np.testing.assert_allclose(errors[:, j, i], [largest[:2].max(), largest[2]], atol=1e-9)


def test_sines_of_a_series_are_counted_along_the_longer_side():
    functions = Functions(SIZE, 2, 6, absent=(4,))
    longest = np.pi / (MARGIN * 320)
    assert functions.frequency_of_mode == pytest.approx(longest)
    u, v = functions._sines.T
    wanted = np.hypot(u * np.pi / (MARGIN * 320), v * np.pi / (MARGIN * 240))
    np.testing.assert_allclose(functions.frequency, wanted)
    band = np.rint(wanted / longest)
    assert functions.band.tolist() == band.tolist() and set(band) == {2, 3, 5, 6}
    assert (functions.complete, functions.highest) == (3, pytest.approx(3.5 * longest))
    assert wanted.max() <= 6.5 * longest
    assert len(functions) == 6 + len(u) and functions.trend == 6
    whole = Functions(SIZE, -1, 6)
    assert (whole.complete, whole.trend) == (6, 0) and len(whole) > len(u)


def test_cells_are_divided_by_how_far_they_miss_the_target():
    """Cells are halved once more than needed; coefficients are those of the model's values."""
    model = pincushion('a', SIZE).model
    cells = build_cells(model, SIZE)
    errors = np.zeros_like(cells.errors)
    for (row, column), error in {(2, 5): 0.9, (3, 4): 1.9, (7, 1): 3.9, (8, 8): 1e6}.items():
        errors[0, row, column] = error * TARGET_PX
    errors[1] = 99.0  # error of the standard deviation, which must not cause a division
    divided = divide_cells(model, replace(cells, errors=errors))
    assert list(zip(divided.row, divided.column)) == [(3, 4), (7, 1), (8, 8)]
    assert divided.parts.tolist() == [4, 8, MAX_PARTS]
    assert divided.first.tolist() == [0, 16, 80] and len(divided.table) == 80 + MAX_PARTS**2
    columns, rows = cells.nodes
    part = 1  # second part in the first row of cell (3, 4)
    step = (columns[5] - columns[4]) / 4, (rows[4] - rows[3]) / 4
    u, v = columns[4] + part * step[0], rows[3]
    places = np.array([[u, v], [u + step[0], v], [u, v + step[1]], [u + step[0], v + step[1]]])
    for place, value in zip(places, model.evaluate_in_bulk(places).T):
        terms = np.repeat([1.0, place[0], place[1], place[0] * place[1]], 3)
        found = (terms * divided.table[part]).reshape(4, 3).sum(axis=0)
        np.testing.assert_allclose(found, value, atol=1e-9)
    assert divide_cells(model, replace(cells, errors=0 * errors)) is None


@pytest.mark.parametrize(
    'values',
    [(0.0, 1, 1), (1, 0.0, 1), (1, 1, 0.0), (1, -1, 1), (1, 1, np.inf), (1, 1e4, 1), (1, 1)],
)
def test_noise_that_no_image_has_is_refused(values):
    with pytest.raises(ValueError, match='noise profile'):
        unpacked_profile(np.array(values))


def test_noise_profile_survives_its_packing():
    for profile in (None, unpacked_profile(np.array([1.0, 1.5, 0.7]))):
        assert unpacked_profile(packed_profile(profile)) == profile
    assert packed_profile(profile).tolist() == [1.0, 1.5, 0.7]


def test_lookup_in_divided_cells_is_nearer_to_the_model_and_says_by_how_much_it_is_off():
    model = pincushion('a', SIZE).model
    grid = CorrectionGrid(model, SIZE)
    assert grid.divided == 0 and grid.cell_px > 1
    cells = build_cells(model, SIZE)
    errors = np.zeros_like(cells.errors)
    errors[0, [2, 6], [7, 3]] = 7 * TARGET_PX
    divided = divide_cells(model, replace(cells, errors=errors))
    rng = np.random.default_rng(4)
    columns, rows = grid.nodes
    part = rng.random((2, 200))
    places = [
        np.concatenate([axis[k] + one * (axis[k + 1] - axis[k]) for k in of_cells])
        for axis, of_cells, one in ((columns, (7, 3), part[0]), (rows, (2, 6), part[1]))
    ]
    exact = model.evaluate_in_bulk(np.stack(places, axis=1))
    before = np.abs(grid.look_up(*places)[0] - exact)
    grid._set_divided(divided)
    found, status = grid.look_up(*places)
    after = np.abs(found - exact)
    assert set(status.tolist()) <= {0, 1} and grid.divided == 2
    told = grid._errors_of_divided(model, divided)
    assert told.shape == (2, 2) and np.isfinite(told).all()
    of_cells = after.reshape(3, 2, 200).max(axis=2)
    measured = np.stack([of_cells[:2].max(axis=0), of_cells[2]])
    np.testing.assert_allclose(told, measured, rtol=0.7, atol=1e-6)
    assert after[:2].max() < 0.5 * before[:2].max()


def test_lookup_of_many_points_is_that_of_each():
    grid = CorrectionGrid(pincushion('a', SIZE).model, SIZE)
    u, v = np.random.default_rng(5).uniform(-5, 330, (2, 2 * CHUNK + 7))
    values, status = grid.look_up(u, v)
    for start, stop in ((0, 3), (CHUNK - 2, CHUNK + 2), (2 * CHUNK, 2 * CHUNK + 7)):
        few, of_few = grid.look_up(u[start:stop], v[start:stop])
        np.testing.assert_array_equal(values[:, start:stop], few)
        np.testing.assert_array_equal(status[start:stop], of_few)
    off = (u < -0.5) | (u > SIZE[0] - 0.5) | (v < -0.5) | (v > SIZE[1] - 0.5)
    assert np.array_equal(status == 2, off) and np.array_equal(np.isnan(values[0]), off)


def test_series_with_rings_is_the_same_as_its_polynomials():
    rng = np.random.default_rng(6)
    uv = rng.uniform(0, [319, 239], (40, 2))
    with_rings = Functions(SIZE, 2, 4, rings=2)
    coefficients = rng.normal(size=(2, len(with_rings)))
    values = with_rings(uv) @ coefficients.T
    plain, same = with_rings.as_polynomials(coefficients)
    assert (plain.degree, plain.rings, plain.modes) == (7, 0, 4)
    np.testing.assert_allclose(plain(uv) @ same.T, values, atol=1e-9)
    back, again = plain.as_rings(same, 2, 2)
    assert (back.degree, back.rings) == (2, 2)
    np.testing.assert_allclose(again, coefficients, atol=1e-7)
    few = Functions(SIZE, 1, 4)
    found, matrix = few.as_rings(coefficients[:, : len(few)], 2, 1)
    np.testing.assert_allclose(
        found(uv) @ matrix.T, few(uv) @ coefficients[:, : len(few)].T, atol=1e-9
    )


def test_bands_without_coefficients_are_left_out():
    rng = np.random.default_rng(7)
    functions = Functions(SIZE, 1, 6)
    coefficients = rng.normal(size=(2, len(functions)))
    coefficients[:, functions.trend :][:, np.isin(functions.band, (3, 5))] = 0
    fewer, left = without_absent_bands(functions, coefficients)
    assert fewer.absent == (3, 5) and left.shape == (2, len(fewer)) and len(fewer) < len(functions)
    uv = rng.uniform(0, 200, (20, 2))
    np.testing.assert_allclose(fewer(uv) @ left.T, functions(uv) @ coefficients.T, atol=1e-9)
    coefficients[:, functions.trend :] = 0
    assert without_absent_bands(functions, coefficients)[0] is functions


@pytest.mark.parametrize('most', [10**6, 60])
def test_nearest_training_points_of_a_block_are_among_its_candidates(most):
    rng = np.random.default_rng(8)
    points = rng.uniform(0, 300, (500, 2))
    points[:80] = points[0]  # coincide: too many for one query
    uv = rng.uniform(0, 300, (400, 2))
    tree = cKDTree(points)
    distance = tree.query(uv, k=7)[0][:, -1]
    rows, given = [], 0
    for block, near in blocks_with_candidates(tree, uv, 7, most):
        rows += list(block)
        if near is None:
            continue
        given += 1
        assert len(near) <= most
        for row in block:
            inside = np.flatnonzero(np.linalg.norm(points - uv[row], axis=1) < distance[row])
            assert set(inside) <= set(near)
    assert sorted(rows) == list(range(400)) and given > 0


def test_points_of_another_shape_are_not_corrected():
    calibration = pincushion('a', (400, 300))
    with pytest.raises(DataError, match=r'uv has the shape \(2, 5\), expected \(n, 2\)'):
        correct(calibration, np.zeros((2, 5)))
    with pytest.raises(DataError, match=r'sigma has the shape \(2,\), expected \(3,\)'):
        correct(calibration, np.full((3, 2), 150.0), sigma=[1, 2])
    assert len(correct(calibration, [[100, 150.0]], sigma=[0.2]).uv) == 1
