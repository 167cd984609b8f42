# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Beads with overlapping shadows are separated by fitting discs into the mask of dark pixels."""

import cv2
import numpy as np
import pytest
from scipy.spatial import cKDTree

from fluoro_calib_ros.images.discs import set_apart


def light_of(places: np.ndarray, radius: float, seed: int = 1) -> np.ndarray:
    """Return relative light (300, 300) behind discs that transmit a fifth of it."""
    v, u = np.mgrid[:300, :300]
    image = np.ones((300, 300))
    for x, y in places:
        image[(u - x) ** 2 + (v - y) ** 2 < radius**2] = 0.2
    image = cv2.GaussianBlur(image, (0, 0), 1.2)
    return image + np.random.default_rng(seed).normal(0, 0.03, image.shape)


ALONE = np.array([[40.3, 50.2], [250.6, 60.1], [60.2, 240.7], [150.1, 40.4]])


@pytest.mark.parametrize(('radius', 'apart'), [(7, 1.6), (10, 1.0), (10, 1.8), (18, 0.8)])
def test_a_blob_of_two_beads_becomes_both(radius, apart):
    middle = np.array([160.4, 170.3])
    pair = middle + np.outer([-0.5, 0.5], [0.6, 0.8]) * apart * radius
    true = np.concatenate([ALONE, pair])
    uv, found_radius = set_apart(light_of(true, radius), np.concatenate([ALONE, [middle]]))
    away, nearest = cKDTree(uv).query(true)
    assert len(uv) == len(true)
    assert sorted(nearest) == list(range(len(true)))
    assert away.max() < 1.5
    assert found_radius == pytest.approx(radius, rel=0.25)


def test_places_of_beads_alone_stay():
    uv, _ = set_apart(light_of(ALONE, 10.0), ALONE)
    np.testing.assert_array_equal(np.sort(uv, axis=0), np.sort(ALONE, axis=0))


def test_nothing_is_found_in_what_is_wider_than_a_bead():
    light = light_of(ALONE, 8.0)
    light[100:200, 100:220] -= 0.8  # a plate
    uv, _ = set_apart(light, ALONE)
    np.testing.assert_array_equal(np.sort(uv, axis=0), np.sort(ALONE, axis=0))


def test_a_bar_as_wide_as_a_bead_is_none():
    light = light_of(ALONE, 8.0)
    bar = np.ones((300, 300), np.float32)
    cv2.line(bar, (120, 120), (200, 260), 0.2, 16)
    light += cv2.GaussianBlur(bar, (0, 0), 1.2) - 1
    blobs = np.concatenate([ALONE, [[160.0, 190.0]]])
    uv, _ = set_apart(light, blobs)
    np.testing.assert_array_equal(np.sort(uv, axis=0), np.sort(blobs, axis=0))


def test_three_beads_in_a_line_are_three():
    true = np.array([170.0, 180.0]) + np.outer([-0.8, 0, 0.8], [12.0, 9.0])
    uv, _ = set_apart(light_of(np.concatenate([ALONE, true]), 15.0), np.r_[ALONE, true[1:2]])
    assert len(uv) == len(ALONE) + 3
    assert cKDTree(uv).query(true)[0].max() < 1.5


def test_beads_of_few_pixels_stay_as_they_are():
    pair = np.array([[160.0, 170.0], [162.0, 170.0]])
    uv, radius = set_apart(light_of(np.concatenate([ALONE, pair]), 2.0), ALONE)
    assert radius is None
    np.testing.assert_array_equal(uv, ALONE)
