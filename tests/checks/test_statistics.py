# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Sums that the checks and the drift watch rest on, against loops that spell them out."""

import numpy as np
import pytest

from fluoro_calib_ros.checks.body_watch import _inverse
from fluoro_calib_ros.checks.residual_tests import Residuals, _joins, _scatter
from fluoro_calib_ros.checks.rig import doubtful
from fluoro_calib_ros.estimation.pair_scatter import PairScatter
from fluoro_calib_ros.findings import Kind


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
    """Unit noise gives, cell by cell, the degrees of freedom themselves in the mean."""
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
