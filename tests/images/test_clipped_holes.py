# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Holes of an over-exposed sheet: centres are as precise as their standard deviations state."""

from __future__ import annotations

import cv2
import numpy as np
from scipy.spatial import cKDTree

from fluoro_calib_ros.images.extraction import extract_beads
from fluoro_calib_ros.images.matching import PhantomModel
from fluoro_calib_ros.images.view import Lens

SIDE = 14
PITCH_MM = 6.0
SIZE = 560
PRINCIPAL_PX = 2200.0
DISTANCE_MM = 380.0
RADIUS_PX = 7.0
SHEET = 184.0  # grey value behind the sheet
OPEN = 420.0  # that behind holes, if pixels were not clipped at 255
GAIN = 0.14  # variance of the noise over the light


def scene(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return an image of 8 bits, the holes (n, 3) [mm], and their centres (n, 2) [px]."""
    grid = (np.stack(np.mgrid[:SIDE, :SIDE], -1).reshape(-1, 2) - (SIDE - 1) / 2) * PITCH_MM
    xyz = np.column_stack([grid, np.zeros(len(grid))])
    tilt = np.deg2rad(rng.uniform(5, 12))
    depth = DISTANCE_MM + np.sin(tilt) * grid[:, 0]
    seen_mm = grid * (np.cos(tilt), 1.0) + rng.uniform(-2, 2, 2)
    uv = PRINCIPAL_PX * seen_mm / depth[:, None] + (SIZE - 1) / 2
    v, u = np.mgrid[:SIZE, :SIZE]
    away = cKDTree(uv).query(np.stack([u, v], -1))[0]
    share = cv2.GaussianBlur(np.clip(0.5 + RADIUS_PX - away, 0, 1), (0, 0), 1.3)
    light = SHEET + (OPEN - SHEET) * share
    grey = light + rng.normal(size=light.shape) * np.sqrt(GAIN * light)
    return np.clip(np.rint(grey), 0, 255).astype(np.uint8), xyz, uv


def test_centres_of_clipped_holes_are_as_precise_as_their_sigma():
    rng = np.random.default_rng(5)
    normalised = []
    for _ in range(2):
        image, xyz, uv = scene(rng)
        found = extract_beads(
            image, PhantomModel.of(xyz, regular=True), Lens((SIZE, SIZE), PRINCIPAL_PX)
        )
        away, nearest = cKDTree(uv).query(found.uv)
        assert len(found.uv) > 0.9 * len(uv) and away.max() < 0.5
        normalised.append((found.uv - uv[nearest]) / found.sigma[:, None])
    assert 0.8 < np.sqrt(np.mean(np.concatenate(normalised) ** 2)) < 1.25
