# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Small images of markers in motion for the tests."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import rigs

from fluoro_calib_ros.bodies.body import Body
from fluoro_calib_ros.correction.fluoroscope_calibration import FluoroscopeCalibration
from fluoro_calib_ros.io.calibration import save_calibration, save_orientation
from fluoro_calib_ros.photogrammetry.rig_orientation import RigOrientation
from fluoro_calib_ros.simulation.marker_images import (
    MARKER_SETTINGS,
    MarkerImage,
    MarkerScene,
    MarkerSequence,
    MovingMarkers,
)
from fluoro_calib_ros.simulation.rig import (
    BETWEEN_DEG,
    DistortionField,
    VirtualRig,
    virtual_rig,
)

SIZE = 288
SCENE = MarkerScene(
    clusters=2, markers=4, spread_mm=13.0, apart_mm=26.0, speed_mm=0.9, hidden=0.06
)


def small_rig(names: Sequence[str] = 'ab', between_deg: float = BETWEEN_DEG) -> VirtualRig:
    """A rig with small images and no distortion."""
    straight = DistortionField(np.zeros(2), 0.0, np.zeros(2), 0.0, np.zeros((0, 5)))
    middle = (SIZE - 1) / 2
    found = virtual_rig(3, names=names, between_deg=between_deg)
    return replace(
        found,
        fluoroscopes=tuple(
            replace(
                f,
                interior=np.array([middle, middle, 4000.0]),
                image_size=(SIZE, SIZE),
                distortion=straight,
            )
            for f in found.fluoroscopes
        ),
    )


def covered(of: MarkerImage, rows: slice | Sequence[int]) -> np.ndarray:
    """Return the image with some of its markers painted over."""
    rng = np.random.default_rng(3)
    light = of.image.astype(np.float32)
    noise = np.median(np.abs(light - cv2.GaussianBlur(light, (0, 0), 3))) / 0.6745
    marks = np.zeros((SIZE, SIZE), np.uint8)
    for place in np.rint(of.uv[rows]).astype(int).tolist():
        cv2.circle(marks, place, 6, 255, -1)
    plain = light.copy()
    for _ in range(20):
        plain = np.where(marks > 0, cv2.blur(plain, (15, 15)), light)
    plain += np.where(marks > 0, rng.normal(0, noise, plain.shape), 0.0).astype(np.float32)
    return np.clip(plain, 0, 65535).astype(np.uint16)


# A rig of three fluoroscopes, with two bodies moving in front of it.

THREE = 'abc'
FRAMES = 19
SEED = 26


@cache
def rig() -> VirtualRig:
    return small_rig(THREE, between_deg=60.0)


@cache
def sequence() -> tuple[dict[str, MarkerImage], ...]:
    """Return the images of all exposures, each keyed by fluoroscope."""
    settings = replace(MARKER_SETTINGS, round_field=False)
    images = MarkerSequence(rig(), MovingMarkers(SCENE, SEED), settings, FRAMES, SEED)
    return tuple(dict(of) for of in images)


def ids() -> np.ndarray:
    return MovingMarkers(SCENE, SEED).target_id


@cache
def calibration() -> tuple[dict[str, FluoroscopeCalibration], RigOrientation]:
    """Return the true calibrations and the true orientation."""
    calibrations = {
        name: replace(each, image_size=(SIZE, SIZE))
        for name, each in rigs.true_calibrations(rig().fluoroscopes, 0.05).items()
    }
    return calibrations, rigs.true_orientation(rig().fluoroscopes, calibrations)


def bodies() -> tuple[Body, ...]:
    local = MovingMarkers(SCENE, SEED).local_mm
    sd = np.full(4, 0.05)
    return Body('one', ids()[:4], local[:4], sd), Body('two', ids()[4:], local[4:], sd)


def save_three(folder: Path) -> None:
    """Write a result folder of the three fluoroscopes."""
    calibrations, orientation = calibration()
    folder.mkdir()
    for each in calibrations.values():
        save_calibration(folder, each)
    save_orientation(folder, orientation)
