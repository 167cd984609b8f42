# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Sums used by the checks and the drift watch, against explicit loops."""

from types import SimpleNamespace as Fake

import numpy as np
import pytest
from scipy import special

from fluoro_calib_ros.checks.body_watch import _inverse
from fluoro_calib_ros.checks.residual_tests import (
    Residuals,
    _cell_sums,
    _joins,
    _may_be,
    _scatter,
    change_of_trend,
    common_trend,
    rejected_exposure,
    unexplained,
)
from fluoro_calib_ros.checks.rig import doubtful
from fluoro_calib_ros.estimation.pair_scatter import PairScatter
from fluoro_calib_ros.findings import Kind
from fluoro_calib_ros.photogrammetry.noise import INLIER_Q
from fluoro_calib_ros.photogrammetry.outliers import FALSE_ALARM
from fluoro_calib_ros.photogrammetry.rotations import (
    matrix_from_vector,
    quaternion_from_matrix,
)


def test_joins_are_the_products_of_neighbours_of_two_exposures():
    rng = np.random.default_rng(1)
    uv = rng.uniform(0, 100, (40, 2))
    r = rng.normal(size=(40, 2))
    exposure = np.sort(rng.integers(0, 3, 40))
    residuals = Residuals(uv, r, exposure, np.arange(40), np.arange(3), np.full(3, np.nan))
    products = {}
    for i in range(40):
        near = np.argsort(np.linalg.norm(uv - uv[i], axis=1))[1:5]
        for j in near:
            pair = tuple(sorted((exposure[i], exposure[j])))
            products.setdefault(pair, []).append(float(r[i] @ r[j]))
    joins = _joins(residuals, 4)
    pairs = list(zip(joins.earlier.tolist(), joins.later.tolist()))
    assert pairs == sorted(pair for pair in products if pair[0] < pair[1])
    for pair, mean, count in zip(pairs, joins.mean, joins.count):
        assert count == len(products[pair]) and mean == pytest.approx(np.mean(products[pair]))


def test_scatter_has_a_degree_of_freedom_less_for_the_mean_of_each_group():
    """Unit noise gives, cell by cell, the degrees of freedom in the mean."""
    rng = np.random.default_rng(2)
    counts = rng.integers(0, 6, (400, 8))
    sums = rng.normal(size=(400, 8, 2)) * np.sqrt(counts)[..., None]
    groups = [np.arange(3), np.arange(3, 8)]
    means = [
        sums[:, group].sum(axis=1) / np.maximum(counts[:, group].sum(axis=1), 1)[:, None]
        for group in groups
    ]
    scatter, freedom = _scatter(sums, counts, groups, means)
    seen = counts > 0
    expected = [sum(2 * max(row[group].sum() - 1, 0) for group in groups) for row in seen]
    assert freedom.tolist() == expected
    assert scatter.sum() / freedom.sum() == pytest.approx(1, abs=5 / np.sqrt(freedom.sum()))


SIZE = (800, 400)
CELL = np.array([349.5, 224.5])  # centre of the cell in column 3, row 4 of 8


def residuals(trend=(0.0, 0.0), bump=(0.0, 0.0), half=(0.0, 0.0), exposures=10, seed=4):
    """Residuals of noise 0.3 px. trend: everywhere, bump: about CELL, half: between the halves."""
    rng = np.random.default_rng(seed)
    per = 400
    uv = rng.uniform(-0.5, np.array(SIZE) - 0.5, (exposures * per, 2))
    exposure = np.repeat(np.arange(exposures), per)
    r = rng.normal(0, 0.3, uv.shape) + trend
    r[(np.abs(uv - CELL) < [50, 25]).all(axis=1)] += bump
    r += np.where(exposure[:, None] >= exposures // 2, 0.5, -0.5) * half
    angles = np.full(exposures, np.nan)
    return Residuals(uv, r, exposure, np.arange(len(uv)), np.arange(exposures) + 1, angles)


def test_trend_of_all_exposures_is_found_with_its_size_and_place():
    """Its overall size is per coordinate, that of a cell is a length."""
    calm = common_trend(residuals(), SIZE)
    assert calm.size < calm.limit < 0.05 and calm.cell_size < calm.cell_limit
    found = common_trend(residuals(trend=(0.3, -0.4)), SIZE)
    assert found.size == pytest.approx(0.5 / np.sqrt(2), rel=0.05) and found.size > found.limit
    assert found.cell_size == pytest.approx(0.5, rel=0.4) and found.cell_size > found.cell_limit
    local = common_trend(residuals(bump=(-0.3, 0.4)), SIZE)
    np.testing.assert_allclose(local.place, CELL)
    assert local.cell_size == pytest.approx(0.5, rel=0.2) and local.cell_size > local.cell_limit
    assert local.size < 0.2
    # About 62 points of noise 0.3 px in a cell, and 18 degrees of freedom in each of 64 cells.
    variance = 0.3**2 / (4000 / 64)
    expected = np.sqrt(2 * variance * special.fdtri(2, 64 * 18, 1 - FALSE_ALARM / 64))
    assert local.cell_limit == pytest.approx(expected, rel=0.25)


def test_trend_of_one_exposure_is_not_common():
    given = residuals()
    given.r[given.exposure == 3] += [3.0, 2.0]
    found = common_trend(given, SIZE)
    assert found.size < found.limit and found.cell_size < found.cell_limit


def test_change_between_the_halves_is_found_with_its_size():
    calm = change_of_trend(residuals(trend=(0.3, -0.4)), SIZE)
    assert calm.size < calm.limit and calm.cell_size < calm.cell_limit
    found = change_of_trend(residuals(half=(0.6, 0.8)), SIZE)
    assert found.size == pytest.approx(1 / np.sqrt(2), rel=0.05) and found.size > found.limit
    assert found.cell_size == pytest.approx(1.0, rel=0.3) and found.cell_size > found.cell_limit
    odd = change_of_trend(residuals(half=(0.6, 0.8), exposures=7), SIZE)
    assert odd.size == pytest.approx(1 / np.sqrt(2), rel=0.1)


def test_few_image_points_show_no_trend():
    given = residuals(trend=(5.0, 0.0), exposures=2)
    found = common_trend(given, SIZE)  # a single pair has no scatter
    assert (found.size, found.limit) == (0.0, np.inf)
    few = given._part(np.arange(len(given.uv)) % 40 == 0)
    found = common_trend(few, SIZE)
    assert (found.cell_size, found.cell_limit) == (0.0, np.inf)
    np.testing.assert_allclose(found.place, [400, 200])


def test_cells_that_overlap_are_sums_of_their_parts():
    given = residuals(exposures=3)
    for overlap in (1, 2):
        sums, counts, centres = _cell_sums(given, SIZE, overlap)
        side = 8 * overlap - overlap + 1
        assert sums.shape == (side**2, 3, 2) and counts.shape == (side**2, 3)
        for cell in (0, side - 1, side + 3, side**2 - 1):
            inside = (np.abs(given.uv - centres[cell]) < [50, 25]).all(axis=1)
            for row in range(3):
                own = inside & (given.exposure == row)
                assert counts[cell, row] == own.sum()
                np.testing.assert_allclose(sums[cell, row], given.r[own].sum(axis=0))


def test_residuals_are_divided_at_the_core_of_the_noise():
    r = np.array([[0.0, 0.1], [0.0, 99.0], [3e3, 0.0], [np.nan, 0.0]])
    exposure = np.arange(4)
    given = Residuals(r, r, exposure, exposure + 10, exposure + 1, np.full(4, 0.5))
    sd = np.array([0.5, 9.0, 9.0, 2.0])
    assert given.inliers(sd).target_id.tolist() == [10]
    assert given.rejected(sd).target_id.tolist() == [11]  # 11 standard deviations, not 333
    assert given.capped(sd) == pytest.approx([0.01, *(INLIER_Q * sd[1:] ** 2)])
    assert given.angle.tolist() == [0.5] * 4
    assert given.inliers(sd).numbers.tolist() == [1, 2, 3, 4]


def test_rejected_points_of_an_exposure_agree_where_neighbours_are_alike():
    rng = np.random.default_rng(6)
    uv = rng.uniform(0, 400, (60, 2))
    exposure = np.repeat([0, 1, 2], [25, 34, 1])
    r = rng.normal(0, 5, (60, 2))
    r[exposure == 1] = [4.0, 3.0] + rng.normal(0, 0.1, (34, 2))
    given = Residuals(uv, r, exposure, np.arange(60), np.array([4, 7, 9]), np.full(3, np.nan))
    fitted = given._part(np.arange(60) % 2 == 0)
    found = rejected_exposure(given, fitted)
    inside = int(np.sum(exposure[::2] == 1))
    assert (found.number, found.points, found.of) == (7, 34, 34 + inside)
    pairs = set()
    for i in range(25, 59):
        distance = np.linalg.norm(uv[25:59] - uv[i], axis=1)
        distance[i - 25] = np.inf
        pairs.add(frozenset((i, 25 + int(np.argmin(distance)))))
    # Products of 5 px by 5 px, over the root of half the sum of their squares.
    assert found.agreement == pytest.approx(np.sqrt(2 * len(pairs)), rel=0.05)
    assert found.limit == pytest.approx(special.ndtri(1 - FALSE_ALARM / 3))
    false = rejected_exposure(given._part(exposure == 0), fitted)
    assert false.number == 4 and false.agreement < false.limit
    assert rejected_exposure(given._part(exposure == 2), fitted) is None
    given.r[:] = 0
    with np.errstate(all='raise'):
        assert rejected_exposure(given, fitted).agreement == 0


def corner_of_exposures(alike, rng):
    """Rejected points of six exposures in a corner, and far ones of the first; some are alike."""
    exposure = np.repeat(np.arange(6), [20, 4, 4, 4, 4, 4])
    uv = rng.uniform(900, 1000, (40, 2))
    uv[:6] -= 800
    angle = rng.uniform(0, 2 * np.pi, 40)
    r = 5 * np.column_stack([np.cos(angle), np.sin(angle)])
    r[np.isin(exposure, alike)] = [4.0, 3.0]
    return Residuals(uv, r, exposure, np.arange(40), np.arange(6), np.full(6, np.nan))


def test_an_exposure_is_not_blamed_for_what_other_exposures_show_too():
    given = corner_of_exposures(range(6), np.random.default_rng(3))
    fitted = given._part(np.zeros(40, dtype=bool))
    assert rejected_exposure(given, fitted).number == 0
    left = unexplained(given, 64.0)
    assert left.exposure.tolist() == [0] * 6 + [1] * 4 + [2] * 4 + [3] * 4 + [4] * 4 + [5] * 4
    assert left.uv[:6].max() < 300


@pytest.mark.parametrize('alike', [[0], [0, 1]])
def test_an_exposure_that_differs_is_blamed_among_false_matches_or_with_one_other(alike):
    rng = np.random.default_rng(5)
    kept = [
        np.count_nonzero(unexplained(corner_of_exposures(alike, rng), 64.0).exposure == 0) == 20
        for _ in range(300)
    ]
    assert np.mean(kept) > 0.99


def test_inverse_of_an_open_rotation_is_large_and_not_negative():
    rng = np.random.default_rng(3)
    half = rng.normal(size=(5, 6, 6))
    normal = half @ np.swapaxes(half, 1, 2)
    np.testing.assert_allclose(
        _inverse(normal) @ normal, np.broadcast_to(np.eye(6), (5, 6, 6)), atol=1e-4
    )
    open_one = np.diag([4.0, 4, 4, 4, 4, 0])[None]
    assert _inverse(open_one)[0, 5, 5] > 1e8


def test_exposures_of_another_orientation_are_named_with_the_largest_displacement():
    used = np.array([True, True, True, False, False])
    off = np.array([0.1, 0.1, 0.1, 3.0, 7.0])
    scatter = PairScatter(
        ('a', 'b'),
        np.arange(5),
        off_px=off,
        off_sd=off / 0.1,
        used=used,
        growth=1.0,
        unexplained=1.0,
        angle_px=0.0,
        columns=np.ones((5, 1)),
        corrected=False,
        turn=np.broadcast_to(np.eye(3), (5, 3, 3)),
        shift_mm=np.zeros((5, 3)),
    )
    usable, (found,) = doubtful(scatter, 1024, 0.2)
    assert usable and found.kind is Kind.PAIRS_EXCLUDED
    assert found.place.exposures == (3, 4) and found.numbers == {'off_px': 7.0}


def test_image_points_that_fail_may_be_targets_that_nothing_else_is():
    """Nearest first; each only for its nearest point, by the pose of their exposure."""
    rotation = matrix_from_vector(np.array([0.1, -0.2, 0.3]))
    position = rotation.T @ np.array([5.0, -3.0, -900.0])
    interior = np.array([500.0, 400.0, 4000.0])
    rng = np.random.default_rng(2)
    ids = np.arange(10) + 20
    xyz = rng.uniform(-60, 60, (10, 3))
    xyz[4] = xyz[3] + [1.0, 0, 0]  # 4.4 px next to it
    x = (xyz - position) @ rotation.T
    ideal = interior[:2] + interior[2] * x[:, :2] / x[:, 2:]
    correction = np.tile([3.0, -2.0], (4, 1))
    # The first two image points fit; the last two are exchanged for others.
    given = np.array([20, 21, 22, 23])
    uv = ideal[[0, 1, 3, 6]] + correction + [[0.1, 0], [0.1, 0], [0.5, 0], [0.3, 0]]
    pose = {'quaternion_wxyz': quaternion_from_matrix(rotation), 'position_mm': position}
    other = {'quaternion_wxyz': np.array([1.0, 0, 0, 0]), 'position_mm': position}
    exposures = [Fake(exposure=2, **other), Fake(exposure=5, **pose), Fake(exposure=9, **other)]
    table = Fake(
        fluoroscope=np.array(['a'] * 4),
        exposure=np.full(4, 5),
        target_id=given,
        uv=uv,
        correction=correction,
    )
    result = Fake(
        fluoroscopes={'a': Fake(exposures=exposures, interior=interior)},
        targets=Fake(target_id=ids, xyz_mm=xyz),
        residuals=table,
    )
    here, rows = np.ones(4, bool), np.array([2, 3])
    found = _may_be(result, here, rows, np.array([20.0, 20.0]))
    # Target 24 is next to 23, which is assigned to the other failing point.
    assert found == [(23, 24), (26,)]
    assert _may_be(result, here, rows, np.array([2.0, 0.2])) == [(23,), ()]
    table.target_id = np.array([20, 23, 22, 26])  # 23 fits elsewhere, and 26 has its own id
    assert _may_be(result, here, rows, np.array([20.0, 20.0])) == [(24,), ()]
    few = Fake(**{**vars(result), 'targets': Fake(target_id=ids[:2], xyz_mm=xyz[:2])})
    table.target_id = given
    assert _may_be(few, here, rows, np.array([20.0, 20.0])) == [(), ()]
