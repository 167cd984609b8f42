# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""A transposed, mirrored, inverted or brighter image gives the same results."""

import functools
from types import SimpleNamespace as Fake

import cv2
import numpy as np
import pytest

from fluoro_calib_ros.errors import DataError
from fluoro_calib_ros.images.clipping import UNCLIPPED
from fluoro_calib_ros.images.detection import Look, detect_beads, field_of_view
from fluoro_calib_ros.images.light import LAGS, Light, Noise, estimate_noise
from fluoro_calib_ros.images.marker_fit import MarkerGuess, fit_markers
from fluoro_calib_ros.images.marker_intensity import (
    FilteredImage,
    LightWindows,
    MarkerLook,
    MarkerSearch,
    first_shadows,
    learn_start,
    search_image,
    search_windows,
)
from fluoro_calib_ros.images.marker_motion import MarkerStates, Motion
from fluoro_calib_ros.images.measurement import circles, measure_beads
from fluoro_calib_ros.images.profile import Profile

WHITE = np.zeros((2 * LAGS + 1, 2 * LAGS + 1))
WHITE[LAGS, LAGS] = 1.0
RADIUS_PX, BLUR_PX, ATTENUATION = 5.0, 1.1, 1.2
PLACES = np.array(
    [[30.3, 40.6], [90.2, 35.5], [150.8, 60.1], [40.4, 110.7], [99.6, 100.2], [160.5, 120.3],
     [109.9, 103.4], [60.1, 70.2], [130.2, 25.4], [190.7, 35.8], [200.3, 90.4], [70.6, 130.9]]
)  # fmt: skip
SHAPE = (150, 230)


@functools.cache
def scene(radius=RADIUS_PX, seed=4):
    """Return an image (h, w) of uint16: dark spheres, two of which touch, in a ramp of light."""
    fine = 4
    v, u = (np.mgrid[: fine * SHAPE[0], : fine * SHAPE[1]] + 0.5) / fine - 0.5
    light = 900.0 - 1.5 * u + 0.8 * v
    for x, y in PLACES:
        squared = (u - x) ** 2 + (v - y) ** 2
        light *= np.exp(-2 * ATTENUATION * np.sqrt(np.maximum(1 - squared / radius**2, 0)))
    light = cv2.GaussianBlur(light, (0, 0), fine * BLUR_PX)
    light = light.reshape(SHAPE[0], fine, SHAPE[1], fine).mean(axis=(1, 3))
    image = np.random.default_rng(seed).normal(light, 0.1 * np.sqrt(light))
    return np.rint(20 * image).astype(np.uint16)


def swapped(uv):
    return uv[:, ::-1]


def in_order(uv):
    return uv[np.lexsort(np.rint(uv).T)]


# ---- beads


@pytest.mark.parametrize('look', [None, Look(5.5, False)])
def test_beads_are_found_in_the_transposed_and_the_mirrored_image(look):
    image = scene()
    found = detect_beads(image, 12, look)
    away = np.linalg.norm(in_order(found.uv)[:, None] - PLACES[None], axis=2)
    assert len(found.uv) == 12 and away.min(axis=0).max() < 0.8 and not found.inverted
    assert 0.6 * RADIUS_PX < found.radius_px < RADIUS_PX + BLUR_PX
    turned = detect_beads(np.ascontiguousarray(image.T), 12, look)
    off = np.abs(in_order(swapped(turned.uv)) - in_order(found.uv))
    assert np.median(off) == 0 and off.max() <= 1  # one pixel off for discs that overlap
    assert sorted(turned.strength) == pytest.approx(sorted(found.strength), rel=1e-3)
    assert turned.radius_px == pytest.approx(found.radius_px, rel=1e-6)
    np.testing.assert_allclose(turned.noise.correlation, found.noise.correlation.T, atol=1e-5)
    mirrored = detect_beads(np.ascontiguousarray(image[:, ::-1]), 12, look)
    there = [SHAPE[1] - 1, 0] + mirrored.uv * [-1, 1]
    off = np.abs(in_order(there) - in_order(found.uv))
    assert np.median(off) == 0 and off.max() <= 1
    np.testing.assert_array_equal(turned.light.field, found.light.field.T)


def test_bright_beads_are_found_as_dark_ones_are():
    image = scene()
    bright = (image.max() + image.min() - image).astype(np.uint16)
    found, turned = detect_beads(image, 12), detect_beads(bright, 12)
    assert turned.inverted and not found.inverted
    assert len(turned.uv) == len(found.uv)
    away = np.linalg.norm(in_order(turned.uv) - in_order(found.uv), axis=1)
    assert np.median(away) < 0.01 and away.max() < 1.5  # two of them overlap
    again = detect_beads(bright, 12, Look(found.radius_px, True))
    assert again.inverted and len(again.uv) == 12
    np.testing.assert_array_equal(again.light.grey, bright.max() - bright.astype(float))


def test_detections_do_not_depend_on_the_unit_of_the_light():
    image = scene()
    found, brighter = detect_beads(image, 12), detect_beads(3 * image, 12)
    np.testing.assert_allclose(in_order(brighter.uv), in_order(found.uv), atol=1e-3)
    np.testing.assert_allclose(brighter.strength, found.strength, rtol=1e-3)
    assert brighter.radius_px == found.radius_px


def test_noise_grows_with_the_unit_of_the_light_and_turns_with_the_image():
    v, u = np.mgrid[: SHAPE[0], : SHAPE[1]]
    mean = 8000.0 + 3 * u - 2 * v
    light = np.random.default_rng(8).normal(mean, np.sqrt(0.2 * mean)).astype(np.float32)
    usable = np.ones(SHAPE, bool)
    usable[:, 5:15] = False
    light[~usable] = 9.0
    one = estimate_noise(light, usable)
    assert one.variance(mean) == pytest.approx(0.2 * mean, rel=0.25)
    # A power of two does not change the rounding, which decides on correlations at their limit.
    four = estimate_noise(4 * light, usable)
    assert four.gain == pytest.approx(4 * one.gain, rel=1e-3)
    assert four.constant == pytest.approx(16 * one.constant, rel=1e-2, abs=0.1)
    turned = estimate_noise(np.ascontiguousarray(light.T), np.ascontiguousarray(usable.T))
    assert turned.gain == pytest.approx(one.gain, rel=0.02)
    np.testing.assert_allclose(turned.correlation, one.correlation.T, atol=1e-6)


def test_field_of_view_turns_with_the_image():
    v, u = np.mgrid[:200, :260]
    lit = np.where((u - 120) ** 2 + (v - 90) ** 2 < 80**2, 900.0, 20.0).astype(np.float32)
    field = field_of_view(lit, 2.0)
    inner = (u - 120) ** 2 + (v - 90) ** 2 < 72**2
    outer = (u - 120) ** 2 + (v - 90) ** 2 < 84**2
    assert field[inner].all() and not field[~outer].any()
    transposed = field_of_view(np.ascontiguousarray(lit.T), 2.0)
    assert np.mean(transposed != field.T) < 0.005  # an ellipse of pixels is not quite round
    assert np.mean(field_of_view(lit[::-1].copy(), 2.0) != field[::-1]) < 0.005
    np.testing.assert_array_equal(field_of_view(7 * lit, 2.0), field)


PROFILE = Profile(RADIUS_PX, BLUR_PX, ATTENUATION)


def measured(image, uv, unit=1.0, **changes):
    light = Light(image.astype(np.float32) * unit, np.ones(image.shape, bool), **changes)
    noise = Noise(0.0, 0.2 * unit, WHITE)
    return measure_beads(light, uv, circles(np.ones(len(uv))), profile=PROFILE, noise=noise)


def test_beads_are_measured_alike_in_a_turned_and_in_a_brighter_image():
    start = PLACES + 0.3
    found = measured(scene(), start)
    assert found.measured.all() and found.overlapped.sum() == 2
    away = np.abs(found.uv - PLACES).max(axis=1)
    assert np.all(away < 5 * found.sigma) and found.sigma.max() < 0.1
    assert found.depth == pytest.approx(1.0, abs=0.1)
    assert found.misfit == pytest.approx(1.0, abs=0.5)
    expected = 20 * (900 - 1.5 * PLACES[:, 0] + 0.8 * PLACES[:, 1])
    np.testing.assert_allclose(found.light, expected, rtol=0.02)
    turned = measured(np.ascontiguousarray(scene().T), swapped(start))
    brighter = measured(scene(), start, 2.0)
    for other, uv in ((turned, swapped(turned.uv)), (brighter, brighter.uv)):
        np.testing.assert_allclose(uv, found.uv, atol=2e-3)
        np.testing.assert_allclose(other.sigma, found.sigma, rtol=5e-3)
        np.testing.assert_allclose(other.depth, found.depth, atol=2e-3)
        np.testing.assert_allclose(other.misfit, found.misfit, rtol=2e-2)
        assert other.overlapped.tolist() == found.overlapped.tolist()
    np.testing.assert_allclose(brighter.light, 2 * found.light, rtol=1e-3)


# ---- markers


def look_of(image, inverted=False):
    light = FilteredImage(image).of_scale(3.0)[int(inverted)]
    strength = float(np.median(np.sort(light.relative[light.maxima])[-12:]))
    return MarkerLook(
        3.0,
        65535 if inverted else None,
        np.ones(image.shape, bool),
        strength,
        floor=0.1 * strength,
        light=15000.0,
    )


def negative(image):
    return np.uint16(65535) - image


def test_markers_are_found_in_a_turned_image_and_in_its_negative():
    image = scene()
    found = search_image(image, look_of(image))
    assert len(found.uv) == 12
    away = np.linalg.norm(found.uv[:, None] - PLACES[None], axis=2)
    assert away.min(axis=0).max() < 1.0
    transposed = np.ascontiguousarray(image.T)
    for other, look, back in (
        (transposed, look_of(transposed), swapped),
        (negative(image), look_of(negative(image), True), np.asarray),
    ):
        again = search_image(other, look)
        np.testing.assert_allclose(in_order(back(again.uv)), in_order(found.uv), atol=0.02)
        assert sorted(again.strength) == pytest.approx(sorted(found.strength), rel=1e-2)


def test_an_image_says_itself_whether_its_markers_are_bright():
    image = scene()
    dark = first_shadows(FilteredImage(image).of_scale(3.0), 12)
    bright = first_shadows(FilteredImage(negative(image)).of_scale(3.0), 12)
    np.testing.assert_allclose(in_order(bright.uv), in_order(dark.uv), atol=0.02)
    sides = FilteredImage(image).of_scale(3.0)
    turned = FilteredImage(negative(image)).of_scale(3.0)
    assert [one.white for one in (*sides, *turned)] == [None, 65535, None, 65535]
    np.testing.assert_allclose(sides[0].light, turned[1].light, atol=0.1)
    np.testing.assert_allclose(sides[0].around, turned[1].around, rtol=1e-4)
    np.testing.assert_allclose(sides[0].response, turned[1].response, atol=2.0)
    np.testing.assert_allclose(sides[1].response, turned[0].response, atol=2.0)


@pytest.mark.parametrize('is_bright', [False, True])
def test_markers_are_told_from_noise_that_is_stronger_where_there_is_less_light(is_bright):
    """The light of bright markers is the largest grey value minus that of dark markers."""
    v, u = np.mgrid[: SHAPE[0], : SHAPE[1]]
    light = np.full(SHAPE, 57000.0)
    for x, y in PLACES:
        light *= 1 - 0.2 * np.exp(-0.5 * ((u - x) ** 2 + (v - y) ** 2) / 1.6**2)
    image = np.rint(np.random.default_rng(4).normal(light, 1300.0)).astype(np.uint16)
    found = first_shadows(FilteredImage(negative(image) if is_bright else image).of_scale(1.5), 12)
    np.testing.assert_allclose(in_order(found.uv), in_order(PLACES), atol=0.7)


def test_windows_are_read_as_the_image_is_beyond_its_edges_too():
    image = scene()
    field = np.ones(SHAPE, bool)
    field[60:70, 80:95] = False
    offset = np.stack(np.meshgrid(np.arange(-4, 5), np.arange(-4, 5)), axis=-1).reshape(-1, 2)
    for inverted in (False, True):
        windows = LightWindows(
            image, Fake(field=field, white=65535 if inverted else None, clipping=UNCLIPPED)
        )
        expected = np.pad(65535 - image if inverted else image, 9, mode='edge')
        inside = np.pad(field, 9)
        for middle in ([50, 30], [4, 4], [3, 70], [70, 3], [225, 145], [226, 80], [100, 146],
                       [82, 62], [-2, 152]):  # fmt: skip
            grey, valid = windows.read(np.array([middle]), offset)
            column, row = (offset + middle).T + 9
            np.testing.assert_array_equal(grey[0], expected[row, column])
            np.testing.assert_array_equal(valid[0], inside[row, column])
        many, valid = windows.read(np.array([[50, 30], [3, 70]]), offset)
        one, there = windows.read(np.array([[3, 70]]), offset)
        np.testing.assert_array_equal(many[1], one[0])
        np.testing.assert_array_equal(valid[1], there[0])
    empty, _ = windows.read(np.zeros((0, 2), int), offset)
    assert empty.shape == (0, 81)


def test_windows_show_the_shadows_that_the_whole_image_has_there():
    """Each shadow is found once, whether it is in one window or in two."""
    image = scene()
    look = look_of(image)
    whole = search_image(image, look)
    windows = LightWindows(image, look)
    shifts = [[5, -6], [-7, 7], [-3, 6], [2, 1], [0, 8]]
    middle = np.rint(PLACES).astype(int)[[0, 1, 1, 7, 10]] + shifts
    found = search_windows(windows, middle, 12, look)
    expected = [uv for uv in whole.uv if np.abs(uv - middle).max(axis=1).min() <= 12.4]
    assert len(found.uv) == len(expected) == 4
    np.testing.assert_allclose(in_order(found.uv), in_order(np.array(expected)), atol=0.25)
    none = search_windows(windows, np.array([[30, 75]]), 8, look)
    assert len(none.uv) == 0
    transposed = np.ascontiguousarray(image.T)
    look = look_of(transposed)
    turned = search_windows(LightWindows(transposed, look), middle[:, ::-1], 12, look)
    # The light around a pixel is estimated along the rows.
    np.testing.assert_allclose(in_order(swapped(turned.uv)), in_order(found.uv), atol=0.25)


def guess_of(uv, motion=(0.0, 0.0)):
    n = len(uv)
    return MarkerGuess(uv, np.ones(n), np.full(n, 0.15), np.tile(motion, (n, 1)))


def fitted(image, uv, motion=(0.0, 0.0), inverted=False, unit=1.0):
    white = 65535 if inverted else None
    windows = LightWindows(
        image, Fake(field=np.ones(image.shape, bool), white=white, clipping=UNCLIPPED)
    )
    return fit_markers(windows, guess_of(uv, motion), PROFILE, Noise(0.0, 0.2 * unit, WHITE), {})


@pytest.mark.parametrize('motion', [(0.0, 0.0), (1.5, 0.0), (-1.2, 3.0)])
def test_markers_are_measured_alike_in_a_turned_image_and_in_its_negative(motion):
    start = PLACES + [0.3, -0.2]
    found = fitted(scene(), start, motion)
    assert found.measured.all() and found.overlapped.sum() == 2
    if motion == (0.0, 0.0):
        away = np.abs(found.uv - PLACES).max(axis=1)
        assert np.all(away < 5 * found.sigma) and found.sigma.max() < 0.1
    turned = fitted(np.ascontiguousarray(scene().T), swapped(start), motion[::-1])
    dark = fitted(negative(scene()), start, motion, inverted=True)
    backward = fitted(scene(), start, (-motion[0], -motion[1]))
    for other, uv in ((turned, swapped(turned.uv)), (dark, dark.uv), (backward, backward.uv)):
        np.testing.assert_allclose(uv, found.uv, atol=3e-3)
        np.testing.assert_allclose(other.sigma, found.sigma, rtol=1e-2)
        np.testing.assert_allclose(other.depth, found.depth, atol=3e-3)
        np.testing.assert_allclose(other.misfit, found.misfit, rtol=3e-2)
    brighter = fitted(3 * scene(), start, motion, unit=3.0)
    np.testing.assert_allclose(brighter.uv, found.uv, atol=3e-3)
    np.testing.assert_allclose(brighter.sigma, found.sigma, rtol=1e-2)
    np.testing.assert_allclose(brighter.light, 3 * found.light, rtol=1e-3)


# ---- the first image, and the search


def test_a_first_image_says_which_markers_are_there():
    image = scene()
    uv = np.vstack([PLACES + 0.8, [[np.nan, np.nan], [30.0, 90.0]]])
    ids = np.arange(14) + 50
    start = learn_start(FilteredImage(image), ids, uv)
    assert start.states.unseen.tolist() == [0] * 12 + [1, 1]
    assert np.abs(start.states.motion.uv[:12] - PLACES).max() < 1.0
    assert start.states.motion.uv[13].tolist() == [30, 90]
    assert (start.states.motion.uv[12] == -2e4).all()
    assert start.size == (230, 150) and start.density == 2e-6
    assert start.profile.radius_px == pytest.approx(RADIUS_PX, rel=0.2)
    assert start.look.white is None
    few = learn_start(FilteredImage(image), ids[:6], uv[:6])
    free = 6 / start.look.field.sum()
    assert few.density == pytest.approx(free, rel=0.01)
    for outside in ([-0.5, 40.0], [229.5, 40.0], [40.0, -0.6], [40.0, 149.5]):
        with pytest.raises(DataError, match='marker 51 of the first frame lies outside'):
            learn_start(FilteredImage(image), ids[:2], np.array([PLACES[0], outside]))
    twice = PLACES[[0, 1, 2, 3, 0, 1, 2, 3]] + [0, 0.5]
    assert learn_start(FilteredImage(image), ids[:8], twice).states.unseen.sum() == 4
    twice[3:] = PLACES[[0, 0, 1, 1, 2]] - [1, 0]
    with pytest.raises(DataError, match='only 3 of 8 markers of the first frame'):
        learn_start(FilteredImage(image), ids[:8], twice)


@pytest.mark.parametrize(
    ('number', 'lost', 'every', 'there_too'),
    [(31, 11, 30, False), (30, 10, 30, False), (30, 11, 1, True), (31, 11, 1, True)],
)
def test_a_lost_marker_is_searched_in_the_whole_image(number, lost, every, there_too):
    image = scene()
    look = look_of(image)
    unseen = np.zeros(12, int)
    unseen[5] = lost
    states = MarkerStates.start(Motion.start(PLACES + 0.5, 1.0), unseen)
    states.motion.uv[5] = [20.0, 20.0]
    search = MarkerSearch(look, gate=4.5, lost_after=10, search_every=every)
    assert search.lost(states).tolist() == [False] * 5 + [lost > 10] + [False] * 6
    found = search.shadows(image, LightWindows(image, look), states, number)
    there = np.linalg.norm(found.uv[:, None] - PLACES[None], axis=2).min(axis=0) < 1
    assert there.tolist() == [True] * 5 + [there_too] + [True] * 6
    assert len(found.uv) == there.sum()


@pytest.mark.parametrize('every', [30, 4])
def test_strips_of_an_image_are_searched_in_turn(every):
    image = scene()
    look = look_of(image)
    states = MarkerStates.start(Motion.start(PLACES - 500.0, 30.0), np.full(12, 99))
    search = MarkerSearch(look, gate=4.5, lost_after=10, search_every=every)
    whole = search_image(image, look)
    windows = LightWindows(image, look)
    found = [search.shadows(image, windows, states, number) for number in range(60, 60 + every)]
    assert np.count_nonzero([len(one.uv) for one in found]) <= min(every, 6)
    uv = np.concatenate([one.uv for one in found])
    strength = np.concatenate([one.strength for one in found])
    away = np.linalg.norm(uv[:, None] - whole.uv[None], axis=2)
    # Each shadow is found once, as in the whole image.
    assert len(uv) == len(whole.uv) == 12
    assert away.min(axis=0).max() < 1e-3
    assert strength == pytest.approx(whole.strength[away.argmin(axis=1)], rel=1e-4)


def test_markers_that_may_be_anywhere_are_not_searched_in_windows():
    image = scene()
    look = look_of(image)
    search = MarkerSearch(look, gate=4.5, lost_after=10, search_every=30)
    states = MarkerStates.start(Motion.start(PLACES[:2] + 0.5, 11.0), np.array([99, 99]))
    assert len(search.shadows(image, LightWindows(image, look), states, 7).uv) == 0
    states.motion.covariance[1, 0, 0] = 10.5**2  # 4.5 x 10.5 = 47.3 px of 48
    found = search.shadows(image, LightWindows(image, look), states, 7).uv
    assert np.linalg.norm(found - PLACES[1], axis=1).min() < 1
    assert np.abs(found - PLACES[1]).max() <= 49


@pytest.mark.parametrize('edge', range(4))
def test_shadows_in_the_middle_of_which_the_image_ends_are_not_found(edge):
    """All others are found. The edge is on the left, below, on the right and above in turn."""
    left = scene()[:, 40:]  # the new edge cuts the fourth marker
    cut = np.ascontiguousarray(np.rot90(left, edge))
    there = (PLACES - [40, 0])[PLACES[:, 0] > 50]
    for _ in range(edge):
        there = there @ [[0, -1], [1, 0]]
    there = there + [[0, 0], [0, 189], [189, 149], [149, 0]][edge]
    look = look_of(cut)
    found = search_image(cut, look)
    away = np.linalg.norm(found.uv[:, None] - there[None], axis=2)
    assert len(found.uv) == len(there) == 10
    assert away.min(axis=0).max() < 1 and away.min(axis=1).max() < 1
    whole = detect_beads(cut, 12)
    off = np.linalg.norm(whole.uv[:, None] - there[None], axis=2)
    assert off.min(axis=0).max() < 2
