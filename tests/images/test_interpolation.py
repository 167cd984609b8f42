# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Interpolated residuals of beads agree with their neighbours, with realistic deviations."""

import numpy as np
import pytest

from fluoro_calib_ros.images.growth import interpolated

LENGTH_PX = 250.0


def residuals(seed: int, noise: float, count: int = 400) -> tuple[np.ndarray, np.ndarray]:
    """Return places (n, 2) and values of a smooth field with noise there."""
    rng = np.random.default_rng(seed)
    place = rng.uniform(0, 1000, (count, 2))
    x, y = place.T / 1000
    field = np.column_stack([0.5 * np.sin(5 * x + 2 * y), 0.4 * np.cos(4 * y - x)])
    return place, field + rng.normal(0, noise, field.shape)


@pytest.mark.parametrize('noise', [0.02, 0.2])
def test_deviations_are_honest_at_matched_beads_and_at_others(noise):
    place, residual = residuals(1, noise)
    bead = np.arange(0, 400, 2)
    found = interpolated(place, bead, residual[bead], LENGTH_PX)
    off = (found.value - residual) / found.sd_px[:, None]
    for part in (off[::2], off[1::2]):
        assert 0.8 < np.sqrt(np.mean(part**2)) < 1.2
    assert np.median(found.sd_px) < 1.5 * noise


def test_a_bead_takes_no_part_in_its_own_value_and_one_far_off_not_in_others():
    place, residual = residuals(2, 0.02)
    bead = np.arange(400)
    before = interpolated(place, bead, residual, LENGTH_PX)
    residual[7] += 3.0
    after = interpolated(place, bead, residual, LENGTH_PX)
    np.testing.assert_allclose(after.value[7], before.value[7], atol=0.02)
    assert np.abs(after.value - before.value).max() < 0.05
    assert np.linalg.norm(residual[7] - after.value[7]) > 20 * after.sd_px[7]


def test_a_bead_far_from_all_others_is_predicted_by_none():
    place, residual = residuals(3, 0.02, 60)
    place = np.vstack([place, [[5000.0, 5000.0], [np.nan, np.nan]]])
    found = interpolated(place, np.arange(60), residual, LENGTH_PX)
    np.testing.assert_allclose(found.value[60:], 0, atol=1e-6)
    assert found.sd_px[60:].min() > 3 * np.median(found.sd_px[:60])


def test_four_beads_are_enough():
    place, residual = residuals(4, 0.02, 4)
    found = interpolated(place, np.arange(4), residual, LENGTH_PX)
    assert np.isfinite(found.value).all() and np.isfinite(found.sd_px).all()
