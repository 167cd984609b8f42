# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Shares of earlier images in an image, by the faint shadows that they leave."""

from __future__ import annotations

import numpy as np
import pytest

from fluoro_calib_ros.images.marker_echo import Echo
from fluoro_calib_ros.images.marker_motion import Motion


def observed(shares, sd, factor=1.0, images=1):
    """Return what is known of shares (2,) that each image determines to a standard deviation."""
    echo = Echo()
    echo.add(np.zeros((1, 2)))
    echo.add(np.zeros((1, 2)))
    information = np.diag(np.full(2, sd**-2.0))
    for _ in range(images):
        now = np.append(echo.shares, np.zeros(2 - len(echo.shares)))
        echo.observe(information, information @ (shares - now), factor)
    return echo.shares.tolist()


@pytest.mark.parametrize(
    ('shares', 'sd', 'factor', 'used'),
    [
        ((0.3, 0.09), 0.05, 1.0, (0.3, 0.09)),
        ((0.3, -0.02), 0.05, 1.0, (0.3, 0.0)),
        ((0.3, 0.09), 0.08, 1.0, ()),  # 3.75 standard deviations
        ((0.3, 0.09), 0.05, 1.6, ()),
        ((0.04, 0.0), 0.001, 1.0, ()),
        ((0.0, 0.3), 0.01, 1.0, ()),  # not without the last image
    ],
)
def test_shares_count_if_neither_noise_nor_the_shutter_explains_them(shares, sd, factor, used):
    assert observed(np.array(shares), sd, factor) == pytest.approx(used)


def test_shares_of_all_images_are_changes_of_those_in_use():
    shares = np.array([0.3, 0.09])
    assert observed(shares, 0.1) == []
    assert observed(shares, 0.1, images=8) == pytest.approx(shares)


def test_without_images_before_nothing_is_known():
    echo = Echo()
    echo.add(np.zeros((1, 2)))
    echo.observe(1e6 * np.eye(2), 1e6 * np.array([0.3, 0.1]), 1.0)
    assert echo.shares.tolist() == []
    echo.add(np.zeros((1, 2)))
    echo.observe(np.zeros((2, 2)), np.zeros(2), 1.0)  # nothing moves
    assert echo.shares.tolist() == []


def test_markers_were_where_they_were_measured_or_where_they_came_from():
    motion = Motion.start(np.array([[10.0, 20], [30, 40], [50, 60]]), 0.1)
    motion.velocity[:] = [2, -1]
    echo = Echo()
    echo.add(np.array([[1.0, 1], [2, 2], [3, 3]]))
    echo.add(np.array([[4.0, 4], [5, 5], [np.nan, np.nan]]))
    found = echo.before(np.array([0, 2]), motion, 2)
    assert found.tolist() == [[[4, 4], [46, 62]], [[1, 1], [3, 3]]]
