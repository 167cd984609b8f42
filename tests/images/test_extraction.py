# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Beads of rendered radiographs are found, measured and matched; other objects are refused."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import cv2
import numpy as np
import pytest
from rigs import refused
from scipy.spatial import cKDTree

from benchmarks.bead_images import bead_image
from fluoro_calib_ros.errors import DataError
from fluoro_calib_ros.findings import Kind
from fluoro_calib_ros.images.clipping import Clipping
from fluoro_calib_ros.images.detection import Look, detect_beads
from fluoro_calib_ros.images.extraction import Extraction, extract_beads
from fluoro_calib_ros.images.following import Far, follow, moved_on
from fluoro_calib_ros.images.growth import Seen
from fluoro_calib_ros.images.light import Light, Noise, estimate_noise
from fluoro_calib_ros.images.matching import PhantomModel, match
from fluoro_calib_ros.images.measurement import circles, measure_beads
from fluoro_calib_ros.images.profile import Absorbed, Profile, fit_profile, shadow_derivatives
from fluoro_calib_ros.images.view import Lens, View, exponents, fit_view, lacks_certain_pose
from fluoro_calib_ros.photogrammetry.rotations import matrix_from_vector
from fluoro_calib_ros.simulation.radiographs import HARD, Radiography
from fluoro_calib_ros.simulation.rig import VirtualRig, phantom_poses, virtual_rig

LENS = Lens((1024, 1024), 4000.0)


@cache
def rig() -> VirtualRig:
    return virtual_rig(8)


@cache
def model() -> PhantomModel:
    return PhantomModel.of(rig().phantom.xyz_mm)


@cache
def radiograph() -> tuple[np.ndarray, np.ndarray, Radiography]:
    """Return a noisy image with clutter, the true centres, and the radiography."""
    radiography = Radiography(rig().fluoroscopes[0], HARD)
    pose = phantom_poses(np.random.default_rng(4), 3)[1]
    image = radiography.image(rig().true_mm, pose, seed=4)
    return image, radiography.centres(rig().true_mm, pose), radiography


@cache
def extraction() -> Extraction:
    return extract_beads(radiograph()[0], model(), LENS)


@pytest.mark.long
def test_free_beads_are_found_and_no_match_is_false():
    found = extraction()
    _, true, radiography = radiograph()
    error = found.uv - true[found.bead]
    assert np.abs(error).max() < 1.0
    free = radiography.in_field(true, 10) & (cKDTree(true).query(true, k=2)[0][:, 1] > 10)
    assert free.sum() > 200
    assert np.isin(np.flatnonzero(free), found.bead).mean() > 0.95


@pytest.mark.long
def test_centres_are_as_precise_as_their_sigma_says():
    found = extraction()
    _, true, _ = radiograph()
    free = ~found.overlapped
    error = (found.uv - true[found.bead])[free]
    assert np.median(np.abs(error)) / 0.6745 < 0.055
    normalised = np.median(np.abs(error) / found.sigma[free, None]) / 0.6745
    assert 0.8 < normalised < 1.25
    assert np.all(np.abs(np.median(error, axis=0)) < 0.01)


def test_bright_beads_are_the_same_beads():
    image = radiograph()[0][:512]
    dark = detect_beads(image)
    bright = detect_beads(255 - image)
    assert bright.inverted and not dark.inverted
    distance, _ = cKDTree(bright.uv).query(dark.uv)
    assert np.mean(distance < 0.01) > 0.98
    assert abs(len(bright.uv) - len(dark.uv)) < 0.02 * len(dark.uv)


def test_beads_of_one_size_are_found_without_a_search_for_larger_ones():
    """A previous image provides the noise, and that no bead is much larger than the others."""
    image, true, _ = radiograph()
    found = detect_beads(image)
    look = Look(found.radius_px, False, found.noise, alike=True)
    again = detect_beads(image, look=look)
    assert again.noise is found.noise
    # Without the search for larger beads, two beads that touch are not taken for a large one.
    of_true = [np.count_nonzero(cKDTree(one.uv).query(true)[0] < 1) for one in (found, again)]
    assert of_true[1] >= of_true[0] > 0.7 * len(true)
    away, _ = cKDTree(true).query(again.uv)
    assert np.mean(away < 2) > 0.9  # the others are clutter


@pytest.mark.long
def test_centres_in_a_windowed_image_are_as_precise_as_their_sigma_says():
    image, true, _ = radiograph()
    windowed = np.clip(np.rint((image.astype(float) - 70) * 1.6), 0, 255).astype(np.uint8)
    found = extract_beads(windowed, model(), LENS)
    assert found.imaging.black == pytest.approx(-70 * 1.6, rel=0.2)
    error = found.uv - true[found.bead]
    off = np.abs(error) / found.sigma[:, None]
    assert np.sqrt(np.mean(off**2)) < 1.15
    assert (off > 5).sum() <= 2
    again = extract_beads(windowed, model(), LENS, found.nearby)
    assert again.followed and again.imaging.black == found.imaging.black
    shared = np.isin(again.bead, found.bead)
    assert shared.mean() > 0.99


def test_each_refused_bead_has_a_reason():
    found = extraction()
    assert found.refused
    assert all(refusal.finding.kind.value.startswith('bead_') for refusal in found.refused)
    assert not set(found.bead.tolist()) & {refusal.bead for refusal in found.refused}


OVERLAPPING = np.array([[40.2, 40.4], [55.9, 40.9], [100.3, 40.1]])


def blurred_shadows(
    centres: np.ndarray, radii: np.ndarray, light: float, attenuation: float
) -> np.ndarray:
    """Return light (80, 140) behind spheres (n,) [px]; attenuation along 12 px, blur of 1 px."""
    axis = np.arange(0, 560) / 4
    u, v = np.meshgrid(axis, axis[:320])
    grey = light * np.ones(u.shape)
    for centre, radius in zip(centres, radii):
        squared = (u - centre[0]) ** 2 + (v - centre[1]) ** 2
        grey *= np.exp(-attenuation / 12 * 2 * np.sqrt(np.maximum(radius**2 - squared, 0)))
    return cv2.GaussianBlur(grey, (0, 0), 4 * np.sqrt(1.0**2 + 1 / 12))[::4, ::4]


def overlapping_beads(radius_px, most=np.inf):
    """Return beads of radius 12 px, two of which overlap, as measured with another radius.

    most: grey value at which the light is clipped.
    """
    light = blurred_shadows(OVERLAPPING, np.full(3, 12.0), 800.0, 1.9)
    image = np.minimum(np.random.default_rng(3).poisson(light), most).astype(np.float32)
    field = np.ones(image.shape, bool)
    noise = replace(
        estimate_noise(image, field), constant=0.1, gain=1.0, correlation=np.ones((1, 1))
    )
    profile = Profile(radius_px, 1.0, 1.9, 0.0)
    shown = Light(image, field, Clipping(high=most))
    return measure_beads(shown, OVERLAPPING + 0.2, circles(np.ones(3)), profile, noise)


def test_beads_that_overlap_are_as_sure_as_their_radius_is_known():
    """The true radius of 12 px is taken as 12.12 px; this does not move an isolated bead."""
    beads = overlapping_beads(12.12)
    off = np.linalg.norm(beads.uv - OVERLAPPING, axis=1)
    assert list(beads.overlapped) == [True, True, False]
    assert off[:2].min() > 0.03 and off[2] < 0.03
    assert (off < 3 * beads.sigma).all()
    # The isolated bead is limited by the noise only.
    assert beads.sigma[2] < 0.011 < 0.025 < beads.sigma[:2].min()


def test_a_shadow_that_a_larger_one_hides_is_less_sure():
    """Errors of both radii move it where its edge is hidden; the larger bead hardly moves."""
    profile = Profile(6.0, 1.0, 0.6, 0.0)
    size = np.array([1.0, 2.0])
    uv = np.array([[40.2, 40.4], [50.6, 40.9]])
    light = blurred_shadows(uv, 6.0 * size, 1e5, 1.2)
    shown = Light(light.astype(np.float32), np.ones(light.shape, bool))
    noise = Noise(0.1, 1.0, np.ones((1, 1)))
    small, right, large = (
        measure_beads(shown, uv, circles(np.full(2, radius)), profile, noise, size=size)
        for radius in (0.999, 1.0, 1.001)
    )
    moved = np.linalg.norm(large.uv - small.uv, axis=1) / 2
    assert moved[0] > 2 * moved[1]
    # A coordinate, for 1 % of the radii. Here both radii change together and move the small bead
    # the same way; independent errors move it by up to a factor of sqrt(2) less.
    expected = 10 * moved / np.sqrt(2)
    assert expected[0] / np.sqrt(2) < right.sigma[0] < expected[0]
    assert expected[1] < right.sigma[1] < 2 * expected[1]


def test_beads_that_overlap_in_clipped_light_are_less_sure():
    """Only the inside of their shadows determines the radius; a bead alone is far surer."""
    beads = overlapping_beads(12.12)
    clipped = overlapping_beads(12.12, most=500.0)
    assert list(clipped.overlapped) == [True, True, False]
    assert clipped.sigma[:2].min() > 2 * beads.sigma[:2].max()
    assert (np.linalg.norm(clipped.uv - OVERLAPPING, axis=1) < 3 * clipped.sigma).all()
    assert clipped.sigma[2] < 0.2 * clipped.sigma[:2].min()


def test_two_overlapping_beads_have_honest_sigmas():
    profile = Profile(2.8, 0.9, 1.2, 0.0)
    rng = np.random.default_rng(3)
    true = np.array([[10.3, 11.8], [14.6, 12.4]])
    # Attenuate the light on a fine grid, blur it, and sample it at the pixels.
    axis = np.arange(-10, 240) / 10
    fine = np.stack(np.meshgrid(axis, axis), axis=-1)
    light = 800.0 * np.ones(fine.shape[:2])
    for centre in true:
        squared = np.sum((fine - centre) ** 2, axis=2)
        light *= np.exp(-1.2 * 2 * np.sqrt(np.maximum(2.8**2 - squared, 0)) / 2.8)
    light = cv2.GaussianBlur(light, (0, 0), 10 * np.sqrt(0.9**2 + 1 / 12))[10::10, 10::10]
    normalised = []
    sigmas = []
    for _ in range(30):
        image = rng.poisson(light).astype(np.float32)
        noise = replace(
            estimate_noise(image, np.ones(image.shape, bool)),
            constant=0.1,
            gain=1.0,
            correlation=np.ones((1, 1)),
        )
        start = true + rng.normal(0, 0.3, true.shape)
        beads = measure_beads(
            Light(image, np.ones(image.shape, bool)), start, circles(np.ones(2)), profile, noise
        )
        assert beads.overlapped.all()
        normalised.append((beads.uv - true) / beads.sigma[:, None])
        sigmas.append(beads.sigma)
    assert 0.8 < np.sqrt(np.mean(np.square(normalised))) < 1.25
    assert np.mean(sigmas) > 0.015


def test_shadow_whose_border_the_image_cuts_is_not_measured():
    """For objects other than spheres, such as holes of a sheet, the centre would be biased."""
    profile = Profile(4.0, 0.9, 1.2, 0.0)
    field = np.ones((60, 60), bool)
    true = np.array([[3.6, 30.0], [30.0, 55.2], [30.0, 4.6], [54.4, 30.0]])
    grid = np.stack(np.meshgrid(np.arange(60.0), np.arange(60.0)), axis=-1)
    light = np.full((60, 60), 900.0)
    for centre in true:
        light *= 1 - profile.shadow(np.linalg.norm(grid - centre, axis=2))[0]
    image = np.random.default_rng(3).poisson(light).astype(np.float32)
    noise = replace(estimate_noise(image, field), constant=0.1, gain=1.0)
    beads = measure_beads(Light(image, field), true, circles(np.ones(4)), profile, noise)
    assert beads.measured.tolist() == [False, False, True, True]
    assert np.abs(beads.uv - true)[2:].max() < 4 * beads.sigma[2:].max() < 0.2


@pytest.mark.parametrize('shape', [(3.0, 0.9, 1.5), (2.0, 1.5, 0.5), (9.0, 1.2, 3.0)])
def test_shadow_has_the_derivatives_of_its_differences(shape):
    """The differences are so wide that the grid of the shadow does not matter."""
    distance = np.arange(0, shape[0] + 3 * shape[1], 0.25)
    for profile in (Profile(*shape), Profile(*shape, 0.0, sharpening=1.5, mask_px=2.5)):
        derivatives = shadow_derivatives(profile, distance)
        steps = {'radius_px': 0.3, **dict.fromkeys(derivatives, 0.02)} | {'radius_px': 0.3}
        for name, step in steps.items():
            if not profile.sharpening and name in ('sharpening', 'mask_px'):
                continue
            value = getattr(profile, name)
            above, _ = replace(profile, **{name: value + step}).shadow(distance)
            below, _ = replace(profile, **{name: value - step}).shadow(distance)
            expected = (above - below) / (2 * step)
            tolerance = 0.03 * np.abs(expected).max()
            np.testing.assert_allclose(derivatives[name], expected, atol=tolerance)


def test_an_unsharp_mask_adds_the_difference_from_a_wider_blur():
    """The image is sharpened numerically; three reaches away, no shadow is left."""
    profile = Profile(4.0, 1.0, 0.8, 0.1, sharpening=1.2, mask_px=3.0)
    axis = np.arange(-200, 201) * 0.1
    x, y = np.meshgrid(axis, axis)
    raw = profile.absorbed(x * x + y * y)
    plain = cv2.GaussianBlur(raw, (0, 0), 10 * np.sqrt(1 + 1 / 12))
    masked = plain + 1.2 * (plain - cv2.GaussianBlur(plain, (0, 0), 30))
    distance = np.arange(0, profile.reach_px, 0.5)
    expected = np.interp(distance, axis[200:], masked[200, 200:])
    np.testing.assert_allclose(profile.shadow(distance)[0], expected, atol=4e-3)
    assert expected.min() < -0.05
    sized = profile.sized(0.5)
    assert (sized.sharpening, sized.mask_px, sized.radius_px) == (1.2, 3.0, 2.0)


def test_profile_is_fitted_to_its_shadow():
    true = Profile(3.4, 0.8, 1.3, 0.1)
    distance = np.random.default_rng(2).uniform(0, 6, 4000)
    share = 0.9 * true.shadow(distance)[0]
    absorbed = Absorbed(distance, share, *np.ones((3, 4000)))
    start = Profile(3.0, 1.0, 1.5, 0.1)
    for _ in range(10):  # each call makes a few steps only
        start = fit_profile(absorbed, start)
    assert start.radius_px == pytest.approx(3.4, rel=0.002)
    assert start.blur_px == pytest.approx(0.8, rel=0.02)
    assert (1 - start.scatter) * start.shadow(np.zeros(1))[0] == pytest.approx(
        0.9 * true.shadow(np.zeros(1))[0], rel=0.005
    )


def test_profile_is_the_convolution_of_the_sphere():
    profile = Profile(3.0, 1.0, 0.8)
    axis = np.arange(-120, 121) * 0.1
    x, y = np.meshgrid(axis, axis)
    chord = 2 * np.sqrt(np.maximum(9 - x * x - y * y, 0)) / 3
    blurred = cv2.GaussianBlur(1 - np.exp(-0.8 * chord), (0, 0), 10 * np.sqrt(1 + 1 / 12))
    distance = np.array([0.0, 1.3, 2.7, 4.2])
    value, slope = profile.shadow(distance)
    assert np.allclose(value, np.interp(distance, axis[120:], blurred[120, 120:]), atol=2e-3)
    step = 0.05
    ahead, behind = (profile.shadow(distance[1:] + side)[0] for side in (step, -step))
    numeric = (ahead - behind) / (2 * step)
    assert np.allclose(slope[1:], numeric, atol=2e-3)


def test_a_view_is_fitted_to_its_own_projection():
    rng = np.random.default_rng(0)
    xyz = rng.uniform(-130, 130, (200, 3))
    coefficients = rng.normal(0, 1, (2, len(exponents(5)))) * LENS.deviations(5)
    true = View(LENS, np.eye(3), np.array([0, 0, -1500.0]), 4100.0, coefficients, 5)
    start = replace(
        true,
        rotation=matrix_from_vector([0.01, -0.02, 0.03]),
        position=np.array([5.0, -5, -1480]),
        principal_distance_px=4000.0,
        coefficients=0 * coefficients,
    )
    fitted, _ = fit_view(start, xyz, true.project(xyz), 12, 0.01)
    assert np.abs(fitted.project(xyz) - true.project(xyz)).max() < 0.05


@pytest.mark.long
def test_the_pose_of_a_regular_phantom_is_refused():
    axis = np.arange(4) * 40.0 - 60
    cube = np.stack(np.meshgrid(axis, axis, axis), axis=-1).reshape(-1, 3)
    view = View(
        LENS, matrix_from_vector([0.4, 0.3, 0.2]), np.zeros(3), 4000.0, np.zeros((2, 2)), 1
    )
    view = replace(view, position=-view.rotation.T @ np.array([0, 0, 1500.0]))
    field = np.ones((1024, 1024), bool)
    uv = view.project(cube)
    with refused(Kind.POSE_AMBIGUOUS):
        match(Seen.of(uv, field, 3.0), PhantomModel.of(cube), LENS)
    # A few beads off the grid make the pose unique.
    rng = np.random.default_rng(1)
    marked = cube + rng.uniform(-6, 6, cube.shape)
    uv = view.project(marked)
    found = match(Seen.of(uv, field, 3.0), PhantomModel.of(marked), LENS)
    assert np.array_equal(found.bead, found.detection)
    assert len(found.bead) > 60


def regular_cube(large: list[int]) -> tuple[np.ndarray, np.ndarray]:
    """Return 64 beads in four layers and their diameters: 2 mm, but 3 mm for rows of `large`."""
    axis = np.arange(4) * 40.0 - 60
    cube = np.stack(np.meshgrid(axis, axis, axis), axis=-1).reshape(-1, 3)
    diameter = np.full(64, 2.0)
    diameter[large] = 3.0
    return cube, diameter


@pytest.mark.long
def test_reference_beads_of_another_size_tell_the_sides_of_a_regular_cube():
    cube, diameter = regular_cube([0, 5, 23, 61])
    radiography = Radiography(rig().fluoroscopes[0], replace(HARD, bits=16))
    pose = (matrix_from_vector([0.5, 0.3, 0.2]), np.zeros(3))
    image = radiography.image(cube, pose, 3, diameter)
    found = extract_beads(image, PhantomModel.of(cube, diameter), LENS)
    true = radiography.centres(cube, pose)
    assert np.abs(found.uv - true[found.bead]).max() < 1.0
    assert len(found.bead) > 50
    with refused(Kind.POSE_AMBIGUOUS):
        extract_beads(image, PhantomModel.of(cube), LENS)


def small_phantom(seed: int) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-90, 90, (80, 3))


def seen_of(xyz: np.ndarray) -> Seen:
    """Return the detections of points in some pose."""
    rotation = matrix_from_vector([0.3, -0.5, 0.2])
    position = -rotation.T @ np.array([10.0, -5.0, 1500.0])
    view = View(LENS, rotation, position, 4000.0, np.zeros((2, 2)), 1)
    return Seen.of(view.project(xyz), np.ones((1024, 1024), bool), 3.0)


@pytest.mark.long
def test_another_phantom_is_refused():
    seen = seen_of(small_phantom(1))
    assert len(match(seen, PhantomModel.of(small_phantom(1)), LENS).bead) == 80
    with pytest.raises(DataError) as error:
        match(seen, PhantomModel.of(small_phantom(2)), LENS)
    assert lacks_certain_pose(error.value.finding)


def test_a_phantom_built_by_hand_is_found_from_rough_coordinates():
    true = small_phantom(3)[:40]
    rough = true + np.random.default_rng(4).normal(0, 1.0, true.shape)
    sd_mm = np.full(40, 1.0)
    found = match(seen_of(true), PhantomModel.of(rough, sd_mm=sd_mm), LENS)
    assert np.array_equal(found.bead, found.detection) and len(found.bead) > 30
    other = PhantomModel.of(small_phantom(5)[:40], sd_mm=sd_mm)
    with pytest.raises(DataError) as error:
        match(seen_of(true), other, LENS)
    assert lacks_certain_pose(error.value.finding)


def test_neighbours_are_not_told_apart_by_coordinates_that_are_too_rough():
    true = np.stack(np.meshgrid(*[np.arange(4) * 8.0] * 3), -1).reshape(-1, 3)
    true += np.random.default_rng(6).uniform(-1, 1, true.shape)
    spacing = PhantomModel.of(true).spacing_mm
    assert PhantomModel.of(true, sd_mm=np.full(64, 9.0)).sd_mm.max() < 0.12 * spacing
    rough = true + np.random.default_rng(7).normal(0, 1.5, true.shape)
    with pytest.raises(DataError) as error:
        match(seen_of(true), PhantomModel.of(rough, sd_mm=np.full(64, 1.5)), LENS)
    assert lacks_certain_pose(error.value.finding)


def test_labels_beside_the_phantom_do_not_hide_it():
    xyz = np.random.default_rng(3).uniform(-30, 30, (36, 3))
    beads = seen_of(xyz).uv
    # Four lines of text, 24 characters each.
    column = 20 + 15.0 * np.arange(24)
    lines = [(x + dx, y) for dx, y in ((0, 30), (630, 60), (0, 970), (630, 1000)) for x in column]
    seen = Seen.of(np.concatenate([beads, lines]), np.ones((1024, 1024), bool), 3.0)
    found = match(seen, PhantomModel.of(xyz), LENS)
    assert np.array_equal(found.bead, found.detection)
    assert len(found.bead) > 30


@pytest.mark.parametrize('shift_mm', [0.3, 12.0])
def test_a_pose_nearby_is_followed(shift_mm):
    xyz = small_phantom(1)
    seen = seen_of(xyz)
    model = PhantomModel.of(xyz)
    found = match(seen, model, LENS)
    turn = matrix_from_vector([0.003, -0.002, 0.004])
    moved = replace(
        found.view,
        rotation=turn @ found.view.rotation,
        position=found.view.position + shift_mm * found.view.rotation[0],
    )
    followed = follow(seen, model, moved, 0.1)
    assert np.array_equal(np.sort(followed.bead), np.sort(found.bead))
    assert np.allclose(followed.view.position, found.view.position, atol=0.1)


@pytest.mark.parametrize('degrees', [8, 25])
def test_a_pose_far_off_is_followed(degrees):
    """Such steps occur between exposures of a film most of which are excluded."""
    xyz = small_phantom(1)
    seen = seen_of(xyz)
    model = PhantomModel.of(xyz)
    found = match(seen, model, LENS)
    turn = matrix_from_vector(np.deg2rad(degrees) * np.array([0.6, 0.0, 0.8]))
    rotation = turn @ found.view.rotation
    position = rotation.T @ (found.view.rotation @ found.view.position) + [9.0, -4.0, 20.0]
    moved = replace(found.view, rotation=rotation, position=position)
    followed = follow(seen, model, moved, 0.1, Far())
    assert np.array_equal(np.sort(followed.bead), np.sort(found.bead))
    assert np.allclose(followed.view.position, found.view.position, atol=0.1)


def test_a_motion_goes_on():
    """A phantom that turns and moves evenly is predicted correctly."""
    turn = np.array([0.02, -0.03, 0.01])
    centre = np.array([5.0, 6.0, 7.0])

    def view(number: int) -> View:
        rotation = matrix_from_vector(number * turn) @ matrix_from_vector([0.3, 0.2, 0.1])
        sensor = np.array([10.0, -20.0, 1000.0]) + number * np.array([2.0, 1.0, -3.0])
        return View(LENS, rotation, centre - rotation.T @ sensor, 4000.0, np.zeros((2, 2)), 1)

    ahead = moved_on(view(0), view(2), centre, 2.5)
    assert np.allclose(ahead.rotation, view(7).rotation)
    assert np.allclose(ahead.position, view(7).position)
    assert moved_on(view(0), view(2), centre, 30.0) is None  # too far to be trusted


def test_a_grid_is_not_followed_by_a_step_of_its_pattern():
    """A regular grid looks alike in several places, none of which is guessed."""
    side = np.arange(11) * 10.0 - 50
    xyz = np.stack(np.meshgrid(side, side, [0.0]), axis=-1).reshape(-1, 3)
    rotation = matrix_from_vector([0.1, 0.2, 0.0])
    view = View(LENS, rotation, -rotation.T @ [0.0, 0.0, 800.0], 4000.0, np.zeros((2, 2)), 1)
    uv = view.project(xyz)
    seen = Seen.of(uv, np.ones((1024, 1024), bool), 3.0)
    step = replace(view, position=view.position + rotation.T @ [14.0, 0.0, 0.0])
    followed = follow(seen, PhantomModel.of(xyz), step, 0.1, Far())
    assert followed is None or np.allclose(
        view.project(xyz[followed.bead]), uv[followed.detection]
    )


def test_another_phantom_is_not_followed():
    found = match(seen_of(small_phantom(1)), PhantomModel.of(small_phantom(1)), LENS)
    assert (
        follow(seen_of(small_phantom(2)), PhantomModel.of(small_phantom(1)), found.view, 1) is None
    )


def test_an_image_followed_has_the_observations_of_one_searched():
    image, true, _ = radiograph()
    first = extraction()
    followed = extract_beads(image, model(), LENS, first.nearby)
    both = np.intersect1d(first.bead, followed.bead)
    assert len(both) > 0.98 * len(first.bead)
    searched, error = (np.abs(one.uv - true[one.bead]) for one in (first, followed))
    assert error.max() < 1.0
    assert np.median(error) < 1.05 * np.median(searched)


def test_a_survey_with_wrong_beads_gives_no_wrong_observation():
    _, true, _ = radiograph()
    xyz = rig().phantom.xyz_mm.copy()
    rng = np.random.default_rng(2)
    wrong = rng.permutation(len(xyz))[:40]
    xyz[wrong] += rng.normal(0, 6, (40, 3))
    seen_of = extraction().detections
    seen = Seen.of(seen_of.uv, seen_of.light.field, seen_of.radius_px)
    found = match(seen, PhantomModel.of(xyz), Lens((1024, 1024), 4400.0))
    error = np.linalg.norm(seen.uv[found.detection] - true[found.bead], axis=1)
    right = ~np.isin(found.bead, wrong)
    assert np.mean(error[right] < 1.5) > 0.98
    assert right.sum() > 300


@pytest.mark.parametrize(
    ('image', 'kind'),
    [
        (np.zeros((1, 1), np.uint8), Kind.DATA),
        (np.zeros((200, 200), np.uint16), Kind.IMAGE_EMPTY),
        (np.full((200, 200), 255, np.uint8), Kind.IMAGE_EMPTY),
        (
            np.where(np.arange(40000) % 3, 255, 90).reshape(200, 200).astype(np.uint8),
            Kind.IMAGE_EMPTY,
        ),
        (np.zeros((64, 64, 3), np.uint8), Kind.DATA),
        (
            np.random.default_rng(0).poisson(200, (300, 300)).astype(np.uint16),
            Kind.FEW_BEADS,
        ),
    ],
)
def test_an_image_without_beads_is_refused(image, kind):
    with refused(kind) as error:
        extract_beads(image, model(), LENS)
    assert not lacks_certain_pose(error.value.finding)


def test_a_large_bead_among_small_ones_is_found_once():
    rng = np.random.default_rng(8)
    place = np.stack(np.meshgrid(np.arange(5), np.arange(4)), -1).reshape(-1, 2) * 70 + 60.0
    place += rng.uniform(-8, 8, place.shape)
    image = bead_image(place, (400, 400), noise=0.01).astype(float)
    v, u = np.mgrid[:400, :400]
    large = np.array([340.0, 340.0])
    image[np.hypot(u - large[0], v - large[1]) < 10] *= 0.4
    found = detect_beads(cv2.GaussianBlur(image, (0, 0), 1).astype(np.uint8), 21).uv
    distance = np.linalg.norm(found - large, axis=1)
    assert np.sum(distance < 20) == 1
    assert distance.min() < 3
    assert np.linalg.norm(place[:, None] - found, axis=2).min(axis=1).max() < 2


def test_fewer_beads_than_expected_are_found():
    found = detect_beads(bead_image([[100, 120], [300, 90]], (400, 400), noise=0.01), 60).uv
    assert len(found) == 2


def test_an_image_with_faint_beads_says_how_faint():
    rng = np.random.default_rng(9)
    plain = np.full((400, 400), 30000.0)
    beads = bead_image(rng.uniform(20, 380, (30, 2)), (400, 400), noise=0).astype(float)
    image = plain * (1 - 0.04 * (1 - beads / beads.max())) + rng.normal(0, 20, plain.shape)
    with pytest.raises(DataError) as raised:
        detect_beads(image.astype(np.uint16), 30, Look(4.0, False))
    finding = raised.value.finding
    assert finding.kind is Kind.FEW_BEADS
    assert 0.005 < finding.numbers['contrast'] < 0.05
