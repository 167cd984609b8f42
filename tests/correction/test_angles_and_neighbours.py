# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What an angle of the C-arm adds to a correction, and how many neighbours are tried."""

import numpy as np
import pytest
from rigs import pincushion, turning

from fluoro_calib_ros.correction.neighbours import KnnModel

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
    beyond = turned.correction(UV, np.deg2rad(80))
    assert beyond.outside.all()
    unknown = turned.correction(UV)
    mean, variance = turned.angle_field.change(UV, np.nan)
    np.testing.assert_allclose(unknown.duv, plain.duv + mean, atol=1e-12)
    np.testing.assert_allclose(unknown.sd**2, plain.sd**2 + variance, atol=1e-12)


@pytest.mark.parametrize(
    ('count', 'first', 'last'),
    [(4, 1, 1), (6, 2, 2), (10, 3, 4), (50, 3, 20), (250, 3, 100), (10_000, 3, 100)],
)
def test_neighbours_that_are_tried_reach_from_three_to_forty_percent(count, first, last):
    assert KnnModel.candidate_k(count).tolist() == list(range(first, last + 1))
