# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0
"""The calibrated area ends where no target was seen, also inside the image."""

import numpy as np
import pytest
from rigs import create_model

from fluoro_calib_ros.correction.grid import CorrectionGrid

SIDE = 1024
HOLE = np.array([450.0, 560.0])
RADIUS = 140.0


def model(count=2000, hole=True, seed=1):
    """A smooth correction, trained without points inside a disc."""
    rng = np.random.default_rng(seed)
    uv = rng.uniform(0, SIDE - 1, (count, 2))
    if hole:
        uv = uv[np.linalg.norm(uv - HOLE, axis=1) > RADIUS]
    duv = 1e-3 * (uv - SIDE / 2)
    return create_model('local_linear', 20, uv, duv, 0.1)


def pixels(step=8, margin=120):
    axis = np.arange(margin, SIDE - margin, step, dtype=float)
    return np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)


def test_a_hole_is_outside_and_nothing_else():
    uv = pixels()
    distance = np.linalg.norm(uv - HOLE, axis=1)
    outside = model().outside(uv)
    assert outside[distance < RADIUS - 20].all()
    assert not outside[distance > RADIUS + 40].any()


@pytest.mark.parametrize('count', [150, 600, 2000, 20_000])
def test_gaps_between_points_at_random_are_no_holes(count):
    for seed in range(5):
        assert not model(count, hole=False, seed=seed).outside(pixels(16, 200)).any()


def test_points_three_times_sparser_in_a_part_of_the_image_are_no_hole():
    rng = np.random.default_rng(2)
    uv = rng.uniform(0, SIDE - 1, (4000, 2))
    uv = uv[(uv[:, 0] < SIDE / 2) | (rng.random(len(uv)) < 1 / 3)]
    sparse = create_model('local_linear', 20, uv, 0 * uv, 0.1)
    assert not sparse.outside(pixels(16, 200)).any()


def test_lookup_has_the_status_of_the_model_but_for_a_cell():
    found = model()
    grid = CorrectionGrid(found, (SIDE, SIDE))
    uv = pixels(5)
    distance = np.linalg.norm(uv - HOLE, axis=1)
    _, status = grid.look_up(*uv.T)
    assert (status[distance < RADIUS - 20] == 1).all()
    assert not status[distance > RADIUS + 60].any()
