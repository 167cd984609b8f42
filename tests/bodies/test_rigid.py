# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Rigid motions of points, some of which are false."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fluoro_calib_ros.bodies.body import fitted_pose, robust_pose


@pytest.mark.parametrize('count, false', [(3, 0), (4, 1), (6, 2), (12, 5)])
def test_robust_pose_is_that_of_the_true_points(count, false):
    rng = np.random.default_rng(count)
    for _ in range(20):
        source = rng.uniform(-20, 20, (count, 3))
        turn = Rotation.random(random_state=rng.integers(2**31))
        shift = rng.uniform(-100, 100, 3)
        target = turn.apply(source) + shift + rng.normal(0, 0.02, source.shape)
        target[:false] += rng.uniform(20, 60, (false, 3))
        rotation, found = robust_pose(source, target)
        true = slice(false, None)
        expected, centre = fitted_pose(source[true], target[true])
        away = source[true] @ (rotation - expected).T + found - centre
        assert np.abs(away).max() < 0.1
