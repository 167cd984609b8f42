# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Grey values of virtual radiographs: effects of beads, plates, bones and the detector.

Expected values follow from path lengths in mm by elementary geometry and the Beer-Lambert law.
"""

from dataclasses import replace

import numpy as np
import pytest

from fluoro_calib_ros.simulation.marker_images import (
    BONE_ATTENUATION,
    MARKER_SETTINGS,
    MarkerRadiography,
    MarkerScene,
    MovingMarkers,
)
from fluoro_calib_ros.simulation.radiographs import (
    CLEAN,
    DARK,
    OPEN_BEAM,
    RadiographSettings,
    Radiography,
    chords,
    clutter,
    detected,
    focal_spot,
    illumination,
)
from fluoro_calib_ros.simulation.rig import CUBE_MM, virtual_rig

SIZE = 64
# Absorption only.
IDEAL = RadiographSettings(blur_px=0.0, glare=0.0, focal_spot_mm=0.0, round_field=False)
STILL = (np.eye(3), np.zeros(3))
MIDDLE = (SIZE // 2, SIZE // 2)


def fluoroscope():
    """Return a fluoroscope that looks down z from 1000 mm; small images, no distortion."""
    turned = np.diag([1.0, -1.0, -1.0])
    return replace(
        virtual_rig(1, strength=0.0).fluoroscopes[0],
        interior=np.array([*MIDDLE, 250.0]),
        image_size=(SIZE, SIZE),
        rotation=turned,
        position_mm=np.array([0.0, 0.0, 1000.0]),
    )


def transmission(points, settings=IDEAL, plates=False, diameter=None):
    """Return the transmitted light relative to the open beam."""
    taken = Radiography(fluoroscope(), settings)
    given = (np.reshape(points, (-1, 3)), STILL, 1)
    return taken.light(*given, diameter_mm=diameter, plates=plates) / taken.light(
        np.zeros((0, 3)), STILL, plates=False
    )


def test_a_bead_absorbs_along_its_diameter_where_it_is():
    # 20 mm to the right are 5 px. As the source is above, y points up in the image.
    diameter = np.array([40.0])
    settings = replace(IDEAL, bead_attenuation=0.02)
    found = transmission([[20.0, 40.0, 0.0]], settings, diameter=diameter)
    v, u = np.unravel_index(found.argmin(), found.shape)
    assert (u - MIDDLE[0], v - MIDDLE[1]) == (5, -10)
    assert found.min() == pytest.approx(np.exp(-0.02 * 40), rel=0.01)
    assert found.max() == pytest.approx(1.0, abs=1e-6)
    inside = (found < 0.999).sum()
    assert inside == pytest.approx(np.pi * 5**2, rel=0.25)  # a radius of 20 mm is 5 px


def test_lengths_of_rays_inside_a_sphere():
    centre = np.array([0.0, 0.0, 100.0])
    rays = np.array([[0.0, 0.0, 50.0], [0.0, 3.0, 100.0], [0.0, 60.0, 100.0]])
    distance = 100 * np.sin(np.arctan2(rays[:, 1], rays[:, 2]))
    expected = 2 * np.sqrt(np.maximum(25 - distance**2, 0))
    assert chords(centre, rays, np.array(5.0)) == pytest.approx(expected, abs=1e-9)


def test_plates_darken_what_they_cover():
    """A ray down the axis passes between the side faces, a ray from the side through two."""
    found = transmission(np.zeros((0, 3)), replace(IDEAL, plate_attenuation=0.01), plates=True)
    assert found.max() <= 1.0 + 1e-6
    inside = found[MIDDLE]
    assert inside == pytest.approx(1.0, abs=1e-6)  # the axis is between the faces
    thick = IDEAL.plate_mm
    from_side = replace(
        fluoroscope(),
        rotation=np.array([[0.0, 1, 0], [0, 0, 1], [1, 0, 0]]),
        position_mm=np.array([-1000.0, 0, 0]),
        interior=np.array([*MIDDLE, 100.0]),
    )
    seen = Radiography(from_side, replace(IDEAL, plate_attenuation=0.01))
    light = seen.light(np.zeros((0, 3)), STILL, plates=True)
    empty = seen.light(np.zeros((0, 3)), STILL, plates=False)
    ratio = light / empty
    assert ratio[MIDDLE] == pytest.approx(np.exp(-0.01 * 2 * thick), rel=1e-3)
    assert ratio[MIDDLE[0], 1] == pytest.approx(1.0, abs=1e-6)  # outside the cube
    assert ratio.min() > np.exp(-0.01 * CUBE_MM * 1.2)


@pytest.mark.parametrize('bits, dtype', [(8, np.uint8), (16, np.uint16)])
@pytest.mark.parametrize('inverted', [False, True])
def test_grey_values_of_dark_and_open_beam(bits, dtype, inverted):
    settings = replace(IDEAL, bits=bits, inverted=inverted, photons=1e6, bead_attenuation=10.0)
    taken = Radiography(fluoroscope(), settings)
    image = taken.image(np.array([[0.0, 0, 0]]), STILL, 3, np.array([80.0]), plates=False)
    assert image.shape == (SIZE, SIZE) and image.dtype == dtype
    largest = 2**bits - 1
    light = taken.light(np.zeros((0, 3)), STILL, 3, plates=False)
    place = (SIZE // 2, SIZE - 8)
    for value, expected in (
        (image[MIDDLE], DARK),
        (image[place], DARK + (OPEN_BEAM - DARK) * light[place]),
    ):
        expected = 1 - expected if inverted else expected
        assert value / largest == pytest.approx(expected, abs=0.01)


def test_more_light_than_the_range_is_the_largest_value():
    """The noise of few photons exceeds the range."""
    settings = replace(IDEAL, photons=4.0, bits=8)
    image = Radiography(fluoroscope(), settings).image(np.zeros((0, 3)), STILL, 1, plates=False)
    assert image.max() == 255 and image.min() < 100


@pytest.mark.parametrize('blur', [0.0, 1.0])
def test_noise_is_that_of_the_photons(blur):
    settings = replace(IDEAL, photons=500.0, noise_blur_px=blur)
    taken = Radiography(fluoroscope(), settings)
    light = taken.light(np.zeros((0, 3)), STILL, plates=False)
    part = np.s_[8:-8, 8:-8]
    images = [taken.image(np.zeros((0, 3)), STILL, s, plates=False)[part] for s in range(4)]
    counted = (np.array(images) / (2**16 - 1) - DARK) / (OPEN_BEAM - DARK) * 500
    expected = 500 * light[part]
    assert counted.mean() == pytest.approx(expected.mean(), rel=0.01)
    # A Gaussian blur of one pixel leaves 1 / (4 pi) of the variance of white noise.
    share = 1 / (4 * np.pi) if blur else 1.0
    assert np.mean((counted - expected) ** 2 / expected) == pytest.approx(share, rel=0.1)


def test_the_detector_scatters_and_blurs_but_keeps_the_light():
    light = np.zeros((128, 128), np.float32)
    light[:, 64:] = 1.0
    found = detected(light, replace(CLEAN, glare=0.2, blur_px=2.0))
    assert found.mean() == pytest.approx(0.5, abs=0.01)
    assert found[64, 2] == pytest.approx(0.2 * detected(light, replace(CLEAN, glare=1.0))[64, 2])
    edge = np.diff(detected(light, replace(CLEAN, glare=0.0, blur_px=2.0))[64])
    place = np.arange(len(edge)) - 63
    assert edge.sum() == pytest.approx(1.0, abs=1e-3)
    assert np.sqrt((edge * place**2).sum()) == pytest.approx(2.0, rel=0.05)
    assert detected(light, replace(CLEAN, glare=0.0, blur_px=0.0)) is light


def test_the_focal_spot_has_the_second_moment_of_a_disc():
    spot = focal_spot(0.8)
    assert spot[:, 2] == pytest.approx(0.0) and spot.mean(axis=0) == pytest.approx(0.0)
    assert (spot[:, 0] ** 2).mean() == pytest.approx(0.4**2 / 4)
    assert (spot[:, 1] ** 2).mean() == pytest.approx(0.4**2 / 4)
    assert focal_spot(0.0).tolist() == [[0.0, 0.0, 0.0]]


@pytest.mark.parametrize('is_round', [True, False])
def test_the_field_is_open_inside_and_dark_outside(is_round):
    settings = replace(IDEAL, round_field=is_round)
    grid = np.stack(np.meshgrid(np.arange(200), np.arange(160)), axis=-1)
    light = illumination(grid, (200, 160), settings)
    assert light.shape == (160, 200)
    assert light[80, 100] == pytest.approx(1.0, abs=0.02)
    assert light[80, 0] < 0.05 and light[0, 0] < 0.05
    # Only a rectangular field is open near its corners.
    assert (light[12, 14] > 0.4) is not is_round


def test_clutter_only_absorbs():
    found = clutter(np.random.default_rng(1), (120, 160), 8)
    assert found.shape == (120, 160) and found.max() == pytest.approx(1.0) and found.min() > 0
    assert 0.02 < (found < 0.99).mean() < 0.9
    assert (clutter(np.random.default_rng(1), (120, 160), 0) == 1).all()


def test_a_bone_absorbs_along_its_wall():
    """It lies between an ellipsoid and one of 0.78 of its size; the ray is through the middle."""
    scene = MarkerScene(clusters=1)
    markers = MovingMarkers(scene, 1)
    settings = replace(MARKER_SETTINGS, clutter=0, focal_spot_mm=0.0)
    ((rotation, shift),) = markers.poses(0.0)
    seen = replace(fluoroscope(), position_mm=shift + [0.0, 0.0, 1000.0])
    taken = MarkerRadiography(seen, markers, settings, frames=2, seed=1)
    light = taken._bones([(rotation, shift)])
    axes = scene.spread_mm * np.array([0.75, 0.75, 2.2])
    along = rotation.T @ [0.0, 0.0, 1.0]
    length = 2 / np.linalg.norm(along / axes)
    assert light[MIDDLE] == pytest.approx(np.exp(-BONE_ATTENUATION * length * 0.22), rel=1e-3)
    assert light.max() == pytest.approx(1.0, abs=1e-6)


@pytest.mark.parametrize('focal_spot_mm', [0.0, 0.6])
def test_beads_absorb_in_their_shadow_alone(focal_spot_mm):
    """With a point as focal spot, too."""
    scene = MarkerScene(clusters=1, hidden=0.0, bones=False)
    markers = MovingMarkers(scene, 1)
    settings = replace(MARKER_SETTINGS, focal_spot_mm=focal_spot_mm, round_field=False)
    whole = virtual_rig(1).fluoroscopes[0]
    middle = replace(whole, image_size=(768, 768), interior=whole.interior - [128, 128, 0])
    taken = MarkerRadiography(middle, markers, settings)
    light, uv, _ = taken._light(1, np.arange(scene.markers))
    far = np.ones(light.shape, bool)
    for u, v in np.rint(uv[:, taken.in_field(uv[0], 30.0)]).astype(int).reshape(-1, 2):
        far[v - 20 : v + 21, u - 20 : u + 21] = False
    relative = light / taken._open_beam
    np.testing.assert_allclose(relative[far], 1.0, rtol=1e-5)
    assert 0 < relative.min() < 0.2 and (relative > 0.99).mean() > 0.9
