# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The lookup grid of the correction: accuracy, status, invalid points, image sizes and threads."""

import copy
import functools
import threading
import tracemalloc
import warnings
from dataclasses import replace

import numpy as np
import pytest
import rigs
from rigs import create_model
from scipy.spatial import Delaunay

from fluoro_calib_ros.correction import grid_cells
from fluoro_calib_ros.correction.base import CorrectionStatus
from fluoro_calib_ros.correction.grid import CHUNK, DIVIDED, CorrectionGrid
from fluoro_calib_ros.correction.grid_cells import LIMIT_PX
from fluoro_calib_ros.correction.registry import no_correction
from fluoro_calib_ros.errors import DataError
from fluoro_calib_ros.exposures.frame import points_on_image

OK, OUTSIDE, INVALID = CorrectionStatus

pytestmark = pytest.mark.long

KINDS = ('none', 'knn', 'local_linear', 'parametric', 'hybrid', 'collocation')
SMOOTH = tuple(kind for kind in KINDS if kind != 'knn')
SIZE = (120, 93)


def calibration_of(kind):
    """A calibration of the virtual rig with its lookup grid."""
    return rigs.calibrated('a', model=kind).calibrations['a']


def looked_up(grid, uv):
    """Corrections (n, 2), standard deviations (n,) and status (n,) at pixels (n, 2)."""
    values, status = grid.look_up(*np.asarray(uv, dtype=float).T)
    return values[:2].T, values[2], status


def any_pixels(grid, n=6000, seed=0):
    """Random pixels, and corners, edge midpoints, centres and borders of cells: largest errors."""
    rng = np.random.default_rng(seed)
    uv = rng.uniform(-0.5, np.array(grid.image_size) - 0.5, (n, 2))
    for part, halves in ((slice(0, n // 4), 1), (slice(n // 4, n // 2), 2)):
        for c, line in enumerate(grid.nodes):
            all_of = np.linspace(line[0], line[-1], halves * (len(line) - 1) + 1)
            uv[part, c] = rng.choice(all_of, len(uv[part]))
    uv[n // 2 : 5 * n // 8, 0] = rng.choice(grid.nodes[0], len(uv[n // 2 : 5 * n // 8]))
    return uv


def difference(grid, model, uv):
    """Largest coordinate difference (n,) between the lookup and the exact model."""
    return np.abs(looked_up(grid, uv)[0] - model.predict(uv)).max(axis=1)


def corners_of(grid, uv):
    """The four corners (4, n, 2) of the cells of pixels. A pixel on a border belongs to either
    cell.
    """
    place = []
    for line, x in zip(grid.nodes, uv.T):
        i = np.clip(np.searchsorted(line, x - 1e-9, side='right') - 1, 0, len(line) - 2)
        place.append((line[i], line[i + 1]))
    return np.array([np.stack([u, v], axis=1) for u in place[0] for v in place[1]])


def training(n=300, seed=0, noise=0.1, size=SIZE):
    rng = np.random.default_rng(seed)
    uv = rng.uniform(-0.5, np.array(size) - 0.5, (n, 2))
    return uv, 3 * np.sin(uv / 40) + rng.normal(0, noise, uv.shape)


# ---- accuracy


@pytest.mark.parametrize('kind', SMOOTH)
def test_lookup_agrees_with_the_model_within_a_hundredth_of_a_pixel(kind):
    """Checked at random pixels, where cells are least accurate, and near the worst pixels."""
    calibration = calibration_of(kind)
    grid = calibration.grid
    model = calibration.model
    uv = any_pixels(grid)
    found = difference(grid, model, uv)
    rng = np.random.default_rng(1)
    for _ in range(3):  # search uphill for the largest error
        worst = uv[np.argsort(found)[-40:]]
        near = (worst[:, None] + rng.uniform(-1, 1, (40, 40, 2)) * grid.cell_px).reshape(-1, 2)
        uv = np.concatenate([worst, near[points_on_image(near, grid.image_size)]])
        found = difference(grid, model, uv)
    assert found.max() <= LIMIT_PX
    stated = max(grid.error_px, grid.error_outside_px)
    assert stated <= LIMIT_PX and grid.error_px <= LIMIT_PX
    # The stated error is measured at midpoints. A smooth function has its largest error there; the
    # maximum at a kink may lie next to them.
    assert found.max() <= 1.5 * stated + 1e-9 and found.max() >= 0.5 * stated


@pytest.mark.parametrize('kind', KINDS)
def test_lookup_is_exact_at_the_corners_of_cells(kind):
    calibration = calibration_of(kind)
    rng = np.random.default_rng(2)
    uv = np.stack([rng.choice(line, 3000) for line in calibration.grid.nodes], axis=1)
    exact = calibration.model.evaluate(uv)
    duv, sd, _ = looked_up(calibration.grid, uv)
    np.testing.assert_allclose(duv, exact.duv, rtol=0, atol=1e-8)
    np.testing.assert_allclose(sd, exact.sd, rtol=0, atol=1e-8)


def test_lookup_of_nearest_neighbours_lies_between_the_corners_of_the_cell():
    """The knn model is piecewise constant, and its cells are small."""
    calibration = calibration_of('knn')
    grid = calibration.grid
    assert grid.cell_px == min(grid_cells.CELL_PX)
    uv = any_pixels(grid)
    corners = np.array([calibration.model.predict(c) for c in corners_of(grid, uv)])
    duv, sd, _ = looked_up(grid, uv)
    assert (duv >= corners.min(axis=0) - 1e-8).all() and (duv <= corners.max(axis=0) + 1e-8).all()
    assert np.ptp(corners, axis=0).max() > 0.1, 'nothing was tested'
    np.testing.assert_allclose(sd, calibration.model.evaluate(uv).sd, rtol=1e-9)


@pytest.mark.parametrize('kind', KINDS)
def test_standard_deviations(kind):
    calibration = calibration_of(kind)
    uv = any_pixels(calibration.grid, seed=3)
    _, sd, _ = looked_up(calibration.grid, uv)
    exact = calibration.model.evaluate(uv).sd
    assert np.abs(sd - exact).max() <= 2 * calibration.grid.sd_error_px + 1e-9
    assert np.abs(sd - exact).max() <= 0.03 * np.median(exact)


@pytest.mark.parametrize(
    'kind, k', [('knn', 1), ('knn', 7), ('local_linear', 6), ('local_linear', 40)]
)
@pytest.mark.parametrize('points', ['even', 'few', 'clusters', 'duplicates', 'beside'])
def test_corners_have_the_neighbours_of_the_model_for_any_training_points(kind, k, points):
    rng = np.random.default_rng(7)
    uv, duv = training()
    if points == 'few':
        uv = uv[:40]
        duv = duv[:40]
    if points == 'clusters':
        uv = np.clip(
            np.concatenate([rng.normal(c, 6, (100, 2)) for c in ([20, 20], [100, 30], [60, 80])]),
            0,
            92,
        )
    if points == 'duplicates' and k < 40:
        uv = np.repeat(uv[:60], k + 1, axis=0)
        duv = np.repeat(duv[:60], k + 1, axis=0)
    if points == 'beside':
        uv = uv * 0.2
    model = create_model(kind, k, uv, duv, noise_px=0.2)
    grid = CorrectionGrid(model, SIZE)
    corner = np.stack(np.meshgrid(*grid.nodes), axis=2).reshape(-1, 2)
    exact = model.evaluate(corner)
    found, sd, _ = looked_up(grid, corner)
    assert np.isfinite(found).all() and np.isfinite(sd).all()
    # Planes of neighbours far to one side are ill-conditioned, and so are their last digits.
    certain = exact.sd < 1
    assert certain.mean() > 0.9 or points in ('clusters', 'beside', 'duplicates') or k == 6
    np.testing.assert_allclose(found[certain], exact.duv[certain], rtol=0, atol=1e-6)
    # The model takes any k of equally distant neighbours, the grid takes all.
    if points != 'duplicates':
        np.testing.assert_allclose(sd[certain], exact.sd[certain], rtol=1e-6, atol=1e-8)


def test_insufficient_accuracy_is_reported():
    """Rough values and few neighbours: no cell size is small enough."""
    uv, duv = training(noise=3.0)
    model = create_model('local_linear', 6, uv, duv)
    grid = CorrectionGrid(model, SIZE)
    inside = looked_up(grid, any_pixels(grid))[2] == OK
    found = difference(grid, model, any_pixels(grid))
    assert grid.cell_px <= 2 and grid.error_px > LIMIT_PX
    assert 0.5 * found[inside].max() < grid.error_px


@pytest.mark.parametrize('k, noise, height', [(12, 0.1, 0.1), (30, 0.3, 0.3)])
def test_cells_that_are_not_accurate_enough_are_divided(k, noise, height):
    """Few neighbours cause kinks. Pixels lie in divided cells, on their edges and on edges of
    their parts.
    """
    uv, duv = training(1500, noise=noise, size=(500, 400))
    model = create_model('local_linear', k, uv, height * duv)
    grid = CorrectionGrid(model, (500, 400))
    assert 20 < grid.divided < 1000
    inner = grid._status.reshape(len(grid.nodes[1]) + 1, -1)[1:-1, 1:-1] >= DIVIDED
    assert np.count_nonzero(inner) == grid.divided
    j, i = np.nonzero(inner)
    rng = np.random.default_rng(11)
    at = rng.choice([0, 0.25, 0.5, 1, 1e-9, *rng.random(5)], (2, 20, len(j)))
    uv = np.stack(
        [
            (line[n] + part * (line[n + 1] - line[n])).ravel()
            for line, n, part in zip(grid.nodes, (i, j), at)
        ],
        axis=1,
    )
    uv = np.concatenate([uv, any_pixels(grid, 20_000)])
    found = difference(grid, model, uv)
    status = looked_up(grid, uv)[2]
    assert found.max() <= LIMIT_PX and set(status) <= {OK, OUTSIDE}
    assert not (model.outside(uv) & (status == OK)).any()
    one_by_one = [grid.look_up(uv[n : n + 1, 0], uv[n : n + 1, 1]) for n in range(300)]
    values, status = grid.look_up(*uv.T)
    assert (
        np.concatenate([v for v, _ in one_by_one], axis=1).tobytes() == values[:, :300].tobytes()
    )
    assert np.concatenate([s for _, s in one_by_one]).tobytes() == status[:300].tobytes()


def test_cells_are_as_large_as_the_accuracy_allows():
    cells = {kind: calibration_of(kind).grid.cell_px for kind in KINDS}
    assert cells['none'] == cells['parametric'] == 8 and cells['local_linear'] < 8
    assert calibration_of('none').grid.error_px == 0


def test_large_image_has_larger_cells(monkeypatch):
    uv, duv = training()
    model = create_model('local_linear', 40, uv, duv)
    found = []
    for memory in (10**9, 300_000, 80_000, 20_000, 3_000):
        monkeypatch.setattr(grid_cells, 'MAX_TABLE_BYTES', memory)
        grid = CorrectionGrid(model, SIZE)
        found.append(grid.cell_px)
        assert difference(grid, model, any_pixels(grid)).max() <= 1.6 * max(
            grid.error_px, grid.error_outside_px
        )
    assert found[0] == 2 and found == sorted(found) and found[-1] > 8


def hostile_points(kind, count):
    """Unrealistic training points (count, 2) in an image of 1024 x 1024 px."""
    rng = np.random.default_rng(7)
    if kind == 'heap':
        return 500 + rng.uniform(0, 2, (count, 2))
    if kind == 'two heaps':
        return np.where(rng.random((count, 1)) < 0.5, 100, 900) + rng.uniform(0, 3, (count, 2))
    return rng.uniform(0, 1024, (count, 2))


@pytest.mark.parametrize(
    'kind, model, k', [('heap', 'local_linear', 50), ('two heaps', 'knn', 1000), ('all', 'knn', 5)]
)
def test_work_on_hostile_training_points_is_bounded(monkeypatch, kind, model, k):
    """200,000 such points took minutes; now cells are larger instead, and errors are known."""
    uv = hostile_points(kind, 200_000)
    found = create_model(model, k, uv, np.sin(uv / 100), 0.1, 0.0)
    done = []
    original = type(found).evaluate_in_bulk

    def evaluate(self, pixels):
        done.append(self.bulk_work(pixels, np.inf))
        return original(self, pixels)

    monkeypatch.setattr(type(found), 'evaluate_in_bulk', evaluate)
    if kind != 'all':
        grid = CorrectionGrid(found, (1024, 1024))
        assert grid.cell_px > 8
        assert sum(done) < 2 * grid_cells.MAX_WORK
    else:
        with pytest.raises(DataError, match='takes too long: its 200000 training points'):
            CorrectionGrid(found, (2**13, 2**13))
        assert not done


@pytest.mark.parametrize('size', [(1, 1), (3, 2), (17, 33), (130, 7), (121, 94)])
def test_images_of_any_size(size):
    """Cells extend from edge to edge, whatever the image size."""
    model = create_model('local_linear', 40, *training())
    grid = CorrectionGrid(model, size)
    uv = any_pixels(grid, 800)
    assert (looked_up(grid, uv)[2] != INVALID).all()
    assert difference(grid, model, uv).max() <= max(
        2 * max(grid.error_px, grid.error_outside_px), 1e-8
    )


# ---- status


@pytest.mark.parametrize('kind', KINDS)
def test_ok_is_inside_and_outside_begins_at_most_one_cell_early(kind):
    calibration = calibration_of(kind)
    grid = calibration.grid
    model = calibration.model
    uv = any_pixels(grid, 20_000)
    status = looked_up(grid, uv)[2]
    outside = model.outside(uv)
    assert set(status) <= {OK, OUTSIDE}
    assert not (outside & (status == OK)).any()
    too_early = uv[~outside & (status == OUTSIDE)]
    near = np.array(
        [
            model.outside(too_early + step)
            for step in grid.cell_px * np.array([[i, j] for i in (-1, 0, 1) for j in (-1, 0, 1)])
        ]
    )
    assert near.any(axis=0).all()
    assert (status == OUTSIDE).any() == outside.any() == (kind != 'none')


def test_outside_against_a_triangulation():
    rng = np.random.default_rng(4)
    uv = rng.normal([60, 45], 12, (200, 2))
    grid = CorrectionGrid(create_model('knn', 3, uv, np.zeros((200, 2))), SIZE)
    query = any_pixels(grid)
    inside = np.array([Delaunay(uv).find_simplex(c) >= 0 for c in corners_of(grid, query)]).all(
        axis=0
    )
    border = np.zeros(len(query), dtype=bool)
    for line, x in zip(grid.nodes, query.T):
        border |= np.abs(x[:, None] - line).min(axis=1) < 1e-6  # may belong to either of two cells
    assert 0.1 < inside.mean() < 0.9 and 0.1 < border.mean() < 0.9
    np.testing.assert_array_equal((looked_up(grid, query)[2] == OK)[~border], inside[~border])


def test_training_points_on_a_line_enclose_nothing():
    line = np.column_stack([np.linspace(0, 110, 80), np.linspace(0, 80, 80)])
    grid = CorrectionGrid(create_model('local_linear', 12, line, np.sin(line / 50)), SIZE)
    duv, sd, status = looked_up(grid, any_pixels(grid))
    assert (status == OUTSIDE).all() and np.isfinite(duv).all() and np.isfinite(sd).all()
    assert grid.error_px == 0, 'of no cell'


@pytest.mark.parametrize('kind', ['collocation', 'local_linear'])
def test_points_at_the_edge_and_off_the_image(kind):
    calibration = calibration_of(kind)
    w, h = calibration.image_size
    on = np.array(
        [
            [u, v]
            for u in (-0.5, 0, w / 2, w - 1, w - 0.5)
            for v in (-0.5, 0, h / 3, h - 1, h - 0.5)
        ]
    )
    off = np.array(
        [
            [-0.5 - 1e-6, 5],
            [5, -0.5 - 1e-6],
            [w - 0.5 + 1e-6, 5],
            [5, h - 0.5 + 1e-6],
            [np.nan, 5],
            [5, np.nan],
            [np.nan, np.nan],
            [np.inf, 5],
            [5, np.inf],
            [-np.inf, 5],
            [5, -np.inf],
            [np.inf, -np.inf],
            [1e300, 5],
            [5, -1e300],
            [-3, 5],
            [5, 1e5],
            [2.0**63, 2.0**31],
        ]
    )
    order = np.random.default_rng(0).permutation(len(on) + len(off))
    uv = np.concatenate([on, off])[order]
    with warnings.catch_warnings():
        warnings.simplefilter('error')
        found = calibration.correct(uv)
        exact = calibration.correct(uv, exact=True)
    good = points_on_image(uv, calibration.image_size)
    for each in (found, exact):
        np.testing.assert_array_equal(each.status == INVALID, ~good)
        np.testing.assert_array_equal(np.isnan(each.uv), np.repeat(~good[:, None], 2, axis=1))
        np.testing.assert_array_equal(np.isnan(each.sigma), ~good)
    np.testing.assert_allclose(found.uv, exact.uv, rtol=0, atol=LIMIT_PX)


# ---- the same numbers by every interface


def test_frames_and_large_arrays_give_the_same_bits():
    calibration = calibration_of('collocation')
    uv = np.random.default_rng(5).uniform(-20, 1040, (6 * CHUNK + 77, 2))
    sigma = np.random.default_rng(6).uniform(0.1, 2, len(uv))
    whole = calibration.correct(uv, sigma)
    assert 0.9 < (whole.status != INVALID).mean() < 1
    start = 0
    for size in [
        0,
        1,
        2,
        29,
        30,
        31,
        32,
        33,
        64,
        500,
        512,
        513,
        1024,
        1025,
        2048,
        2049,
        CHUNK - 1,
        CHUNK,
        CHUNK + 1,
    ]:
        part = slice(start, start + size)
        once = calibration.correct(uv[part], sigma[part])
        again = calibration.correct(uv[part], sigma[part])
        arrays = calibration.correct_arrays(uv[part, 0].copy(), uv[part, 1].copy(), sigma[part])
        for each in (once, again):
            for name in ('uv', 'sigma', 'status'):
                assert getattr(each, name).tobytes() == getattr(whole, name)[part].tobytes(), (
                    size,
                    name,
                )
        assert np.stack(arrays[:2], axis=1).tobytes() == whole.uv[part].tobytes()
        assert arrays[2].tobytes() == whole.sigma[part].tobytes()
        assert arrays[3].tobytes() == looked_up(calibration.grid, uv[part])[1].tobytes()
        assert arrays[4].tobytes() == whole.status[part].tobytes() and arrays[4].dtype == np.uint8
        start += size
    assert start < len(uv)


def test_a_later_lookup_does_not_change_an_earlier_result():
    grid = calibration_of('parametric').grid
    u, v = np.random.default_rng(7).uniform(0, 1000, (2, CHUNK + 500))
    values, _ = grid.look_up(u, v)
    kept = values.copy()
    grid.look_up(v, u)
    assert values.tobytes() == kept.tobytes()


def test_two_grids_of_one_calibration_are_the_same():
    """Live and offline processes each build their own grid."""
    for kind in ('local_linear', 'collocation'):
        calibration = calibration_of(kind)
        other = replace(calibration)
        assert (
            other.grid is not calibration.grid
            and other.calibration_id == calibration.calibration_id
        )
        uv = any_pixels(calibration.grid, 2000)
        assert other.correct(uv).uv.tobytes() == calibration.correct(uv).uv.tobytes()


def test_copy_of_a_grid_gives_the_same():
    calibration = calibration_of('parametric')
    uv = any_pixels(calibration.grid, 100)
    calibration.correct(uv[::-1])
    other = copy.deepcopy(calibration.grid)  # the copy protocol that is used for another process
    assert looked_up(other, uv)[0].tobytes() == looked_up(calibration.grid, uv)[0].tobytes()


def test_sigma_includes_observation_and_correction():
    calibration = calibration_of('collocation')
    uv = np.array([[300.0, 400.0], [700.5, 500.25]])
    sd = looked_up(calibration.grid, uv)[1]
    np.testing.assert_allclose(
        calibration.correct(uv).sigma, np.hypot(calibration.image_sd_at(uv), sd), rtol=1e-12
    )
    np.testing.assert_allclose(
        calibration.correct(uv, [2.0, 0.01]).sigma, np.hypot([2.0, 0.01], sd), rtol=1e-12
    )
    np.testing.assert_allclose(
        calibration.correct(uv, [2.0, 0.01], exact=True).sigma,
        np.hypot([2.0, 0.01], calibration.model.evaluate(uv).sd),
        rtol=1e-12,
    )


# ---- many calls, many threads


def test_threads_share_a_grid():
    """Frames of different lengths at the same time, including the first lookups, give correct
    numbers.
    """
    grid = CorrectionGrid(calibration_of('collocation').model, (1024, 1024))
    rng = np.random.default_rng(8)
    frames = [rng.uniform(0, 1000, (2, n)) for n in (30, 31, 30, 503, 5000, 20_000, 1, 30)]
    expected = [grid.look_up(u.copy(), v.copy())[0].tobytes() for u, v in frames]
    grid = copy.deepcopy(grid)
    wrong = []
    start = threading.Barrier(len(frames))

    def work(number):
        start.wait()
        for _ in range(300 if frames[number].shape[1] < 1000 else 30):
            if grid.look_up(*frames[number])[0].tobytes() != expected[number]:
                wrong.append(number)

    threads = [threading.Thread(target=work, args=(i,)) for i in range(len(frames))]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert wrong == []


def test_memory_does_not_grow_with_the_number_of_frames():
    calibration = calibration_of('local_linear')
    rng = np.random.default_rng(9)
    frames = [
        rng.uniform(-5, 1030, (2, n)) for n in (1, 10, 29, 30, 31, 200, 503, 600, 3000, 9000)
    ]

    def correct_all(times):
        for _ in range(times):
            for u, v in frames:
                calibration.correct_arrays(u, v)

    correct_all(2)
    tracemalloc.start()
    try:
        correct_all(5)
        before = tracemalloc.get_traced_memory()[0]
        correct_all(200)
        after = tracemalloc.get_traced_memory()[0]
    finally:
        tracemalloc.stop()
    assert after - before < 2000


def test_no_correction():
    grid = CorrectionGrid(no_correction(), SIZE)
    duv, sd, status = looked_up(grid, any_pixels(grid))
    assert not duv.any() and not sd.any() and not status.any()
    assert grid.error_px == grid.sd_error_px == 0


@functools.cache
def sparse(kind):
    """A calibration of five exposures, which leaves large parts of the image uncovered."""
    return rigs.calibrated('a', 5, model=kind).calibrations['a']


@pytest.mark.parametrize('kind', ['local_linear', 'hybrid', 'collocation'])
def test_accuracy_holds_with_few_exposures(kind):
    calibration = sparse(kind)
    uv = any_pixels(calibration.grid)
    status = looked_up(calibration.grid, uv)[2]
    found = difference(calibration.grid, calibration.model, uv)
    assert found[status == OK].max() <= LIMIT_PX
    assert found.max() <= 2 * max(calibration.grid.error_px, calibration.grid.error_outside_px)
