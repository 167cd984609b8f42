# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Correction errors of moving markers: what the mean errors have in common."""

import tracemalloc

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fluoro_calib_ros.bodies.body import Body, fitted_pose
from fluoro_calib_ros.bodies.correction_errors import REACH, covariance_of_means
from fluoro_calib_ros.bodies.shapes import estimate_shape, places_of

SIDE_PX = 1024.0
CORNERS = np.array([[-15.0, -12, -3], [14, -10, 5], [2, 16, -8], [-6, 3, 15]])
PX_PER_MM = 3.0
CORRECTION_PX = 0.1


def paths(rng, exposures=40, swing=0.1):
    """Image points (T, m, F, 2) of moving markers, in units of the image side."""
    start = rng.uniform(0.4, 0.6, (5, 2, 2))
    return start + swing * rng.normal(0, 1, (exposures, 1, 2, 2))


def field_at(rng, uv, draws):
    """Draws (n, k) of a field with correlation exp(-distance / REACH) at pixels (k, 2)."""
    distance = np.linalg.norm(uv[:, None] - uv[None], axis=2)
    root = np.linalg.cholesky(np.exp(-distance / REACH) + 1e-10 * np.eye(len(uv)))
    return rng.normal(0, 1, (draws, len(uv))) @ root.T


def test_means_of_errors_scatter_as_claimed():
    rng = np.random.default_rng(1)
    uv = paths(rng)
    uv[rng.random(uv.shape[:3]) < 0.2] = np.nan
    claimed = covariance_of_means(uv)
    for view in range(2):
        path = uv[:, :, view]
        seen = np.isfinite(path).all(axis=2)
        drawn = np.full((4000, *seen.shape), np.nan)
        drawn[:, seen] = field_at(rng, path[seen], 4000)
        found = np.cov(np.nanmean(drawn, axis=1).T)
        np.testing.assert_allclose(claimed[view], found, atol=0.06)


def test_errors_of_a_marker_that_stands_still_stay_and_those_of_one_that_moves_far_do_not():
    still = np.full((30, 1, 1, 2), 0.5)
    assert covariance_of_means(still).item() == pytest.approx(1)
    rng = np.random.default_rng(2)
    assert covariance_of_means(rng.uniform(0, 10, (100, 1, 1, 2))).item() < 0.05
    together = np.repeat(still, 2, axis=1)
    np.testing.assert_allclose(covariance_of_means(together), np.ones((1, 2, 2)))
    assert not covariance_of_means(np.full((30, 1, 2, 2), np.nan)).any()


def test_marker_that_a_few_exposures_of_a_long_recording_show_has_an_error():
    """It stands still in 80 of 10,000 exposures, so its error is constant."""
    uv = np.full((10_000, 3, 1, 2), 0.5)
    uv[:, 2] = np.nan
    uv[5060:5140, 2] = 0.5 + 0.2 * REACH
    (claimed,) = covariance_of_means(uv)
    shared = np.exp(-0.2 * np.sqrt(2))
    expected = [[1, 1, shared], [1, 1, shared], [shared, shared, 1]]
    np.testing.assert_allclose(claimed, expected)


def test_learned_shapes_scatter_as_claimed_where_corrections_have_errors():
    """Views along x and y see a moving body; the image points have the errors of a field."""
    rng = np.random.default_rng(3)
    squares = []
    for _ in range(30):
        turn = Rotation.from_rotvec(rng.normal(0, 0.2, (30, 3))).as_matrix()
        places = CORNERS @ np.swapaxes(turn, 1, 2) + rng.normal(0, 10, (30, 1, 3))
        views = np.stack([places[..., [0, 2]], places[..., [1, 2]]], axis=2)  # (T, m, F, 2)
        uv = 0.5 + views * PX_PER_MM / SIDE_PX
        error = np.empty(views.shape)
        for view in range(2):
            drawn = field_at(rng, uv[:, :, view].reshape(-1, 2), 2)
            error[:, :, view] = CORRECTION_PX / PX_PER_MM * drawn.T.reshape(*uv.shape[:2], 2)
        places += np.stack(
            [error[..., 0, 0], error[..., 1, 0], error[..., 1].mean(axis=2)], axis=-1
        )
        places += rng.normal(0, 0.01, places.shape)
        fixed = (CORRECTION_PX / PX_PER_MM) ** 2 * np.diag([1.0, 1.0, 0.5])
        points = [
            {
                'xyz_mm': xyz,
                'noise': np.broadcast_to(0.01**2 * np.eye(3), (4, 3, 3)),
                'fixed': np.broadcast_to(fixed, (4, 3, 3)),
                'uv': pixel,
            }
            for xyz, pixel in zip(places, uv)
        ]
        body = Body('femur', np.arange(4), np.full((4, 3), np.nan), np.full(4, np.inf))
        shape = estimate_shape(body, places_of(body, [body.target_id] * 30, points)).body
        turned, shift = fitted_pose(CORNERS, shape.xyz_mm)
        away = (shape.xyz_mm - CORNERS @ turned.T - shift).ravel()
        variance, axes = np.linalg.eigh(shape.covariance_mm2)
        squares.append(np.mean((axes[:, 6:].T @ away) ** 2 / variance[6:]))
    # 30 shapes with 6 parameters each: the mean has a standard deviation of 0.1.
    assert 0.65 < np.mean(squares) < 1.35


def test_means_of_many_markers_need_little_memory():
    """Of 40 markers, as in a hand; all pairs of their samples would take 128 MB."""
    uv = np.random.default_rng(4).uniform(0, 1, (100, 40, 1, 2))
    tracemalloc.start()
    covariance_of_means(uv)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 30e6
