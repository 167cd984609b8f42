# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""An image determines the shadow of a typical bead and the sizes of all beads."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from fluoro_calib_ros.images.clipping import Clipping
from fluoro_calib_ros.images.detection import field_of_view
from fluoro_calib_ros.images.imaging import (
    Expected,
    Imaging,
    _Sizes,
    _typical,
    estimate_profile,
    first_imaging,
)
from fluoro_calib_ros.images.light import Light, Noise, estimate_noise
from fluoro_calib_ros.images.measurement import BeadFit, _by_scatter, circles, measure_beads
from fluoro_calib_ros.images.profile import Profile

FINE = 4  # grid points per pixel, along each axis
PITCH = 60
ABSORBED = 0.1  # share of the light per pixel of steel


def image_of(radii: np.ndarray, blur_px: float, seed: int = 5) -> tuple[np.ndarray, np.ndarray]:
    """Return a radiograph (h, w) of spheres with radii [px], and their centres (n, 2) [px]."""
    rng = np.random.default_rng(seed)
    across = int(np.ceil(np.sqrt(len(radii))))
    size = PITCH * across
    row, column = np.divmod(np.arange(len(radii)), across)
    uv = PITCH * (np.column_stack([column, row]) + 0.5) + rng.uniform(-3, 3, (len(radii), 2))
    place = (np.arange(FINE * size) + 0.5) / FINE - 0.5
    depth = np.zeros((FINE * size, FINE * size))
    for (x, y), radius in zip(uv, radii):
        us, vs = (slice(*np.searchsorted(place, [c - radius, c + radius])) for c in (x, y))
        square = (place[vs, None] - y) ** 2 + (place[us] - x) ** 2
        depth[vs, us] += 2 * np.sqrt(np.maximum(radius**2 - square, 0))
    light = cv2.GaussianBlur(900 * np.exp(-ABSORBED * depth), (0, 0), FINE * blur_px)
    light = light.reshape(size, FINE, size, FINE).mean(axis=(1, 3))
    return rng.poisson(light).astype(np.float32), uv


def completed(
    radii: np.ndarray, size: np.ndarray | None, radius_px: float, blur_px: float = 1.2
) -> tuple[Imaging, Light, np.ndarray]:
    """Return the imaging estimated from an image of spheres, the image, and the true centres."""
    image, uv = image_of(radii, blur_px)
    light = Light(image, np.ones(image.shape, bool))
    n = len(uv)
    size = np.full(n, np.nan) if size is None else size
    shadows = Expected(np.arange(n), uv, circles(np.ones(n)), np.ones(n, bool), np.ones(n, bool))
    noise = estimate_noise(image, light.field)
    return first_imaging(light, noise, shadows, radius_px, size=size), light, uv


@pytest.mark.parametrize('radius_px', [6.0, 11.0])
def test_profile_does_not_depend_on_the_first_radius(radius_px):
    imaging, *_ = completed(np.full(30, 10.0), None, radius_px)
    assert imaging.profile.radius_px == pytest.approx(10, abs=0.15)
    assert imaging.profile.blur_px == pytest.approx(1.2, abs=0.15)
    assert (imaging.size == 1).all()


def test_profile_of_small_shadows_that_move_is_an_estimate():
    rng = np.random.default_rng(5)
    pitch, across, count = 60, 6, 29
    row, column = np.divmod(np.arange(count), across)
    uv = pitch * (np.column_stack([column, row]) + 0.5) + rng.uniform(-3, 3, (count, 2))
    ways = rng.normal(0, 3.0, (count, 2))
    rows, columns = (np.mgrid[: FINE * pitch * across, : FINE * pitch * across] + 0.5) / FINE - 0.5
    light = np.full(rows.shape, 150.0)
    for (x, y), (a, b) in zip(uv, ways):
        near = np.s_[
            int(FINE * (y - 15)) : int(FINE * (y + 15)),
            int(FINE * (x - 15)) : int(FINE * (x + 15)),
        ]
        passed = 0.0
        for t in np.linspace(-0.5, 0.5, 7):
            squared = (columns[near] - x - t * a) ** 2 + (rows[near] - y - t * b) ** 2
            passed += np.exp(-2 * np.sqrt(np.maximum(1.3**2 - squared, 0))) / 7
        light[near] *= passed
    light = cv2.GaussianBlur(light, (0, 0), FINE * 1.0)
    size = pitch * across
    light = light.reshape(size, FINE, size, FINE).mean(axis=(1, 3))
    image = Light(rng.poisson(light).astype(np.float32), np.ones(light.shape, bool))
    profile = estimate_profile(image, uv + 0.3, circles(np.ones(count)), 1.875)
    # Motion adds to the blur.
    assert 1.0 < profile.blur_px < 1.4
    assert 1.0 < profile.radius_px < 1.7


@pytest.mark.parametrize('radius_px', [5.5, 8.0])
@pytest.mark.parametrize('others', [[8.0, 8.0, 10.5], [5.5, 8.0, 10.5]])
def test_sizes_that_are_not_told_are_seen(radius_px, others):
    """The first profile, which is of beads of all sizes, fits few of them."""
    radii = np.tile([5.5, *others], 2)
    imaging, *_ = completed(radii, None, radius_px)
    size = imaging.size / np.median(imaging.size[radii == 8])
    np.testing.assert_allclose(size, radii / 8, rtol=0.05)


@pytest.mark.parametrize('told', [True, False])
@pytest.mark.long
def test_centres_of_beads_of_several_sizes_are_as_good_as_their_sigma(told):
    radii = np.tile([5.5, 8.0, 10.5], 8)
    imaging, light, uv = completed(radii, radii / 8 if told else None, 8.0)
    beads = measure_beads(
        light,
        uv + 0.2,
        circles(np.ones(len(uv))),
        profile=imaging.profile,
        noise=imaging.noise,
        size=imaging.size,
    )
    off = (beads.uv - uv) / beads.sigma[:, None]
    assert 0.75 < np.sqrt(np.mean(off**2)) < 1.3
    assert (np.abs(beads.depth - 1) < 0.2).all()
    assert beads.misfit.max() < 1.5


def test_windows_hold_the_largest_shadow_and_each_its_own():
    image, _ = image_of(np.full(9, 8.0), 1.2)
    light = Light(image, np.ones(image.shape, bool))
    uv = np.array([[60.0, 60.0], [120.0, 60.0], [90.0, 110.0]])
    size = np.array([0.8, 1.0, 2.5])
    profile = Profile(8.0, 1.2, 0.1, 0.0)
    noise = estimate_noise(image, light.field)
    fit = BeadFit(light, uv, circles(np.ones(3)), profile=profile, noise=noise, size=size)
    reach = profile.reach_px * size
    length = np.linalg.norm(fit.offset, axis=1)
    assert length.max() >= reach.max()
    used = [length[valid].max() for valid in fit.valid]
    assert (used >= reach).all() and (used <= reach + 5).all()


def test_centres_in_a_compressed_image_are_as_good_as_their_sigma():
    off = []
    error = []
    for seed in range(2):
        image, uv = image_of(np.full(36, 7.5), 1.2, seed)
        _, data = cv2.imencode('.jpg', np.clip(image / 5, 0, 255), [cv2.IMWRITE_JPEG_QUALITY, 15])
        image = cv2.imdecode(data, cv2.IMREAD_GRAYSCALE).astype(np.float32)
        light = Light(image, np.ones(image.shape, bool))
        noise = estimate_noise(image, light.field)
        shadows = Expected(
            np.arange(36), uv, circles(np.ones(36)), np.ones(36, bool), np.ones(36, bool)
        )
        imaging = first_imaging(light, noise, shadows, 7.0, size=np.ones(36))
        beads = measure_beads(
            light, uv + 0.2, circles(np.ones(36)), profile=imaging.profile, noise=noise
        )
        error.append(beads.uv - uv)
        off.append(error[-1] / beads.sigma[:, None])
    assert np.sqrt(np.mean(np.square(error))) < 0.2
    assert 0.7 < np.sqrt(np.mean(np.square(off))) < 1.3


def test_something_beside_a_few_beads_is_no_other_size():
    image, uv = image_of(np.full(36, 8.0), 1.2)
    image[40:, :60] *= 0.8  # the edge of a plate, across the first bead of each row
    light = Light(image, np.ones(image.shape, bool))
    shadows = Expected(
        np.arange(36), uv, circles(np.ones(36)), np.ones(36, bool), np.ones(36, bool)
    )
    noise = estimate_noise(image, light.field)
    imaging = first_imaging(light, noise, shadows, 8.0, size=np.full(36, np.nan))
    assert (imaging.size == 1).all()


def test_field_of_view_goes_on_beyond_a_plate_and_ends_before_letters():
    v, u = np.mgrid[:400, :400]
    light = 180.0 * (np.hypot(u - 200, v - 200) < 170).astype(np.float32)
    cut = light.copy()
    cut[np.abs(u - v + 150) < 20] *= 0.08
    both = np.hypot(u - 200, v - 200) < 155
    assert field_of_view(cut, 3.0)[both].all()
    light[370:392, 20:110] = 180
    assert field_of_view(light, 3.0)[both].all()
    assert not field_of_view(light, 3.0)[360:, :120].any()


def measured_in(
    image: np.ndarray, uv: np.ndarray, size: np.ndarray, radius_px: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return errors (n, 2) and standard deviations (n,) of centres [px] for given sizes (n,)."""
    n = len(uv)
    light = Light(image, np.ones(image.shape, bool))
    noise = estimate_noise(image, light.field)
    shadows = Expected(np.arange(n), uv, circles(np.ones(n)), np.ones(n, bool), np.ones(n, bool))
    imaging = first_imaging(light, noise, shadows, radius_px, size=size)
    beads = measure_beads(
        light, uv + 0.2, circles(np.ones(n)), profile=imaging.profile, noise=noise, size=size
    )
    return beads.uv - uv, beads.sigma


def test_what_all_shadows_have_in_common_is_no_noise():
    """The shadows are holes of a thick, tilted plate: two discs each, one for either face."""
    off = []
    rng = np.random.default_rng(7)
    across, count = 8, 64
    row, column = np.divmod(np.arange(count), across)
    place = (np.arange(FINE * PITCH * across) + 0.5) / FINE - 0.5
    for _ in range(2):
        uv = PITCH * (np.column_stack([column, row]) + 0.5) + rng.uniform(-3, 3, (count, 2))
        light = np.full((len(place), len(place)), 400.0)
        for x, y in uv:
            us, vs = (slice(*np.searchsorted(place, [c - 10, c + 10])) for c in (x, y))
            for side in (-1, 1):
                square = (place[vs, None] - y - side * 0.5) ** 2 + (place[us] - x - side) ** 2
                light[vs, us] *= np.where(square < 6.0**2, 0.6, 1.0)
        light = cv2.GaussianBlur(light, (0, 0), FINE * 1.2)
        light = light.reshape(PITCH * across, FINE, PITCH * across, FINE).mean(axis=(1, 3))
        image = rng.poisson(light).astype(np.float32)
        error, sigma = measured_in(image, uv, np.ones(count), 6.0)
        off.append(error / sigma[:, None])
    assert 0.85 < np.sqrt(np.mean(np.square(off))) < 1.2


def test_window_of_a_bead_is_not_that_of_the_largest():
    """The edge of a plate is 14 px from small beads, which is inside the window of large ones."""
    radii = np.full(36, 6.0)
    radii[-3:] = 12.0  # not in the first column
    image, uv = image_of(radii, 1.2)
    right = int(np.ceil(uv[::6, 0].max())) + 14
    image[:, right : right + 12] *= 0.5
    error, sigma = measured_in(image, uv, radii / 6, 6.0)
    assert np.abs(error[::6]).max() < 0.08
    assert sigma[:30:6].max() < 1.3 * np.median(sigma[:30])


def sizes_of(count=5, others=()):
    """Return the comparison of sizes of beads in a row; its lack of fit may be replaced."""
    uv = np.vstack([100.0 * np.arange(count)[:, None] * [1, 0], *others])
    n = len(uv)
    shadows = Expected(np.arange(n), uv, circles(np.ones(n)), np.ones(n, bool), np.ones(n, bool))
    imaging = Imaging(
        None, Profile(5.0, 1.0, 1.0), np.append(np.ones(count), np.full(n - count, 2))
    )
    return _Sizes(None, shadows, imaging)


def test_size_is_where_the_fit_is_best_to_a_part_of_a_step(monkeypatch):
    true = np.array([0.645, 0.71, 1.0, 1.33, 1.85])
    sizes = sizes_of()
    monkeypatch.setattr(
        _Sizes,
        'lacks',
        lambda self, rows, sizes: np.array([1 + np.log(one / true[rows]) ** 2 for one in sizes]),
    )
    found = sizes.best(np.arange(5))
    np.testing.assert_allclose(found, true, rtol=1e-6)
    # For a true size outside the compared range, there is no parabola to interpolate.
    true[0] = 0.2
    assert 0.3 < sizes.best(np.arange(5))[0] < 0.5


def test_sizes_are_compared_with_the_shadows_around(monkeypatch):
    """The windows include the neighbouring shadows that they may show, with their known sizes."""
    asked = []

    class Fit:
        def __init__(self, light, uv, shape, profile, noise, size, reach_px):
            asked.append((uv, size))
            assert reach_px == pytest.approx(5.0 + 3.2)
            self.misfit = np.arange(len(uv)) + size

        def run(self, steps):
            pass

    monkeypatch.setattr('fluoro_calib_ros.images.imaging.BeadFit', Fit)
    reach = (1.6 + 2.0) * (5.0 + 3.2)  # of the largest compared and the known size
    others = np.array([[0.0, 0.99 * reach], [0.0, 1.01 * reach], [100.0, -0.99 * reach]])
    sizes = sizes_of(2, others)
    found = sizes.lacks(np.array([0, 1]), [np.array([0.5, 0.6]), np.array([1.5, 1.6])])
    np.testing.assert_allclose(found, [[0.5, 1.6], [1.5, 2.6]])
    for uv, size in asked:
        assert uv.tolist() == [[0, 0], [100, 0], others[0].tolist(), others[2].tolist()]
        assert size[2:].tolist() == [2, 2]


@pytest.mark.parametrize(
    ('common', 'own', 'share', 'is_equal'),
    [
        (1.5, 1.0, 1.0, True),  # below the effect of a neighbouring object
        (1.7, 1.0, 0.2, True),
        (1.7, 1.0, 0.3, False),
        (1.7, 1.2, 0.3, True),  # their own size fits hardly better
    ],
)
def test_sizes_differ_where_the_common_one_fits_badly(monkeypatch, common, own, share, is_equal):
    rows = np.arange(10)
    others = rows < 10 * share
    sizes = sizes_of(10)
    monkeypatch.setattr(_Sizes, 'best', lambda self, rows: np.where(others, 1.5, 1.0))

    def lacks(self, rows, sizes):
        out = []
        for one in sizes:
            is_own = np.isclose(one, np.where(others, 1.5, 1.0))
            same = np.where(others & np.isclose(one, 1.0), common, 1.0)
            out.append(np.where(is_own & others, own, same))
        return np.array(out)

    monkeypatch.setattr(_Sizes, 'lacks', lacks)
    monkeypatch.setattr(
        'fluoro_calib_ros.images.imaging._typical', lambda *_: sizes.imaging.profile
    )
    assert sizes.are_equal(rows) is is_equal
    assert sizes.are_equal(rows[:0])


NOISE = Noise(1.0, 0.0, np.ones((1, 1)))


def test_windows_at_the_edge_of_an_image_have_the_pixels_that_are_there():
    """Beads are unused if a third is beyond the image or field, or if their edge is."""
    shape = (60, 80)
    grey = np.random.default_rng(3).uniform(100, 200, shape).astype(np.float32)
    field = np.ones(shape, bool)
    field[:, 30:33] = False
    profile = Profile(4.0, 1.0, 1.0)
    u = np.array([40.0, 76, 74.9, 75, 4, 3.9, 40, 40, 40, 31, 60])
    uv = np.column_stack([u, [30, 30, 30, 30, 30, 30, 55, 56, 4, 30, 55.1]])
    fit = BeadFit(Light(grey, field), uv, circles(np.ones(11)), profile=profile, noise=NOISE)
    reach = profile.reach_px + 2
    for row, (u, v) in enumerate(np.rint(uv).astype(int)):
        for k, (du, dv) in enumerate(fit.offset):
            there = 0 <= u + du < 80 and 0 <= v + dv < 60 and du * du + dv * dv <= reach**2
            assert fit.valid[row, k] == bool(there and field[v + dv, u + du])
            if there:
                assert fit.grey[row, k] == grey[v + dv, u + du]
    # The edge of the shadow, 4 px from its centre, has to lie within the image.
    expected = np.minimum(uv, np.array([79, 59]) - uv).min(axis=1) >= 4.0
    assert fit.usable.tolist() == expected.tolist()


def test_neighbours_are_those_within_reach_the_nearest_first():
    uv = np.array([[40.0, 30], [47, 30], [40, 42], [200, 30], [47, 30]])
    light = Light(np.full((90, 260), 100.0, np.float32), np.ones((90, 260), bool))
    profile = Profile(4.0, 1.0, 1.0)
    fit = BeadFit(light, uv, circles(np.ones(5)), profile=profile, noise=NOISE)
    together = 2 * profile.reach_px + 2
    away = np.linalg.norm(uv[:, None] - uv[None], axis=2)
    np.fill_diagonal(away, np.inf)
    for rows, near in fit.groups:
        for row, beside in zip(rows, near):
            expected = np.flatnonzero(away[row] < together)
            assert set(beside[beside >= 0]) == set(expected)
            found = away[row][beside[beside >= 0]]
            assert found.tolist() == sorted(found)
    assert sorted(np.concatenate([rows for rows, _ in fit.groups])) == [0, 1, 2, 3, 4]
    assert fit.distance.tolist() == [7, 0, 12, np.inf, 0]


def test_windows_of_beads_that_look_larger_are_larger():
    """They depend on the place in the image and on the size of the bead."""
    uv = np.array([[50.0, 50], [150, 50], [250, 50], [350, 50]])
    light = Light(np.full((100, 400), 100.0, np.float32), np.ones((100, 400), bool))
    profile = Profile(5.0, 1.0, 1.0)
    stretch, size = np.array([0.5, 1.0, 1.6, 1.6]), np.array([1.0, 1.0, 1.0, 0.5])
    fit = BeadFit(light, uv, circles(stretch), profile=profile, noise=NOISE, size=size)
    reach = profile.reach_px * size * stretch + 2
    length = np.linalg.norm(fit.offset, axis=1)
    for valid, own in zip(fit.valid, reach):
        assert valid.tolist() == (length <= own).tolist()
    assert length.max() <= reach.max() and fit.radius.tolist() == (stretch * size).tolist()
    wide = BeadFit(light, uv, circles(stretch), profile, NOISE, size=size, reach_px=12.0)
    length = np.linalg.norm(wide.offset, axis=1)
    for valid, own in zip(wide.valid, 12.0 * stretch + 2):
        assert valid.tolist() == (length <= own).tolist()


RADIUS = 8.0


SHADOWS = ('row', 'uv', 'shape', 'seen', 'alone')


def radiograph_of_pairs(scatter: float, photons: float = 300) -> tuple[np.ndarray, Expected]:
    """Return a radiograph (h, w) with scatter, and shadows: 20 spheres alone and 16 in pairs."""
    rng = np.random.default_rng(3)
    row, column = np.divmod(np.arange(28), 6)
    place = PITCH * (np.column_stack([column, row]) + 0.5) + rng.uniform(-3, 3, (28, 2))
    away = rng.normal(size=(8, 2))
    away *= RADIUS * rng.uniform(0.8, 1.7, 8)[:, None] / np.linalg.norm(away, axis=1)[:, None]
    uv = np.concatenate([place, place[20:] + away])
    height, width = 5 * PITCH, 6 * PITCH
    place = ((np.arange(FINE * width) + 0.5) / FINE - 0.5).astype(np.float32)
    depth = np.zeros((FINE * height, FINE * width), np.float32)
    for x, y in uv:
        us, vs = (slice(*np.searchsorted(place, [c - RADIUS, c + RADIUS])) for c in (x, y))
        squared = (place[us] - x) ** 2 + (place[vs, None] - y) ** 2
        depth[vs, us] += 2 * np.sqrt(np.maximum(RADIUS**2 - squared, 0))
    light = photons * (scatter + (1 - scatter) * np.exp(-ABSORBED * depth))
    light = cv2.GaussianBlur(light, (0, 0), FINE * 1.2)
    light = light.reshape(height, FINE, width, FINE).mean(axis=(1, 3))
    alone = np.arange(36) < 20
    shadows = Expected(np.arange(36), uv, circles(np.ones(36)), np.ones(36, bool), alone)
    return rng.poisson(light).astype(np.float32), shadows


@pytest.mark.parametrize(('scatter', 'photons'), [(0.03, 300), (0.1, 100)])
def test_shadows_that_overlap_tell_the_scattered_light(scatter, photons):
    image, shadows = radiograph_of_pairs(scatter, photons)
    light = Light(image, np.ones(image.shape, bool))
    noise = estimate_noise(image, light.field)
    imaging = first_imaging(light, noise, shadows, RADIUS, size=np.ones(36))
    alone = _typical(light, shadows, np.ones(36), RADIUS)
    assert imaging.profile.scatter == pytest.approx(scatter, abs=0.01)
    assert imaging.profile.attenuation == pytest.approx(ABSORBED * RADIUS, abs=0.02)
    assert abs(alone.scatter - scatter) > 0.015


def test_scattered_light_stays_where_shadows_are_not_those_of_spheres():
    image, shadows = radiograph_of_pairs(0.3)
    v, u = np.indices(image.shape)
    for x, y in shadows.uv:  # make the spheres look as if they had a hole
        image += 200 * np.exp(-0.5 * ((u - x) ** 2 + (v - y) ** 2) / 1.5**2).astype(np.float32)
    light = Light(image, np.ones(image.shape, bool))
    noise = estimate_noise(image, light.field)
    imaging = first_imaging(light, noise, shadows, RADIUS, size=np.ones(36))
    assert imaging.profile == _typical(light, shadows, np.ones(36), RADIUS)


def over_exposed(seed: int, bright: float, most: float) -> tuple[np.ndarray, np.ndarray]:
    """Return a radiograph of equal spheres whose light has slopes, clipped; centres (n, 2)."""
    rng = np.random.default_rng(seed)
    count = 36
    _, uv = image_of(np.full(count, RADIUS), 1.2, seed)
    slope = 0.004 * rng.standard_t(4, (count, 2))
    size = PITCH * 6
    light = np.zeros((FINE * size, FINE * size))
    cell = np.arange(FINE * PITCH)
    for number, centre in enumerate(uv):
        row, column = np.multiply(np.divmod(number, 6), FINE * PITCH)[:, None] + cell
        x, y = ((at + 0.5) / FINE - 0.5 - c for at, c in zip((column, row), centre))
        chord = 2 * np.sqrt(np.maximum(RADIUS**2 - x**2 - y[:, None] ** 2, 0))
        across = slope[number, 0] * x + slope[number, 1] * y[:, None]
        light[np.ix_(row, column)] = bright * np.exp(np.maximum(across, -0.4) - ABSORBED * chord)
    light = cv2.GaussianBlur(light, (0, 0), FINE * 1.2)
    light = light.reshape(size, FINE, size, FINE).mean(axis=(1, 3))
    return np.minimum(rng.poisson(light), most).astype(np.float32), uv


@pytest.mark.parametrize('seed', [0, 1])
def test_the_shadow_of_a_bead_is_estimated_in_over_exposed_images(seed):
    """Only the insides of shadows are visible, up to three quarters of the light around."""
    image, uv = over_exposed(seed, 900.0, 700.0)
    light = Light(image, np.ones(image.shape, bool), Clipping(high=700.0))
    n = len(uv)
    shadows = Expected(np.arange(n), uv, circles(np.ones(n)), np.ones(n, bool), np.ones(n, bool))
    noise = Noise(0.0, 1.0, np.eye(1))
    profile = first_imaging(light, noise, shadows, RADIUS, size=np.ones(n)).profile
    assert profile.radius_px == pytest.approx(RADIUS, rel=0.02)
    assert profile.blur_px == pytest.approx(1.2, rel=0.1)
    assert profile.attenuation * (1 - profile.scatter) == pytest.approx(ABSORBED * RADIUS, rel=0.1)


@pytest.mark.parametrize(
    ('factor', 'scatter', 'clipped'), [(0.0, 0.1, 0), (1.5, 0.1, 0), (1.5, 0.02, 50)]
)
def test_an_unsharp_mask_is_estimated_if_there_is_one(factor, scatter, clipped):
    """Isolated shadows tell it; those that touch move apart without it. Few pixels are clipped."""
    unmasked, shadows = radiograph_of_pairs(scatter, 10_000)
    image = unmasked
    image = image + factor * (image - cv2.GaussianBlur(image, (0, 0), 2.5))
    high = np.sort(image, axis=None)[-1 - clipped] if clipped else np.inf
    image = np.minimum(image, high)
    light = Light(image, np.ones(image.shape, bool), Clipping(high=high))
    noise = estimate_noise(image, light.field)
    imaging = first_imaging(light, noise, shadows, RADIUS, size=np.ones(36))
    profile = imaging.profile
    assert profile.radius_px == pytest.approx(RADIUS, abs=0.1)
    if not factor:
        assert profile.sharpening == profile.mask_px == 0
        return
    assert profile.sharpening == pytest.approx(factor, rel=0.15)
    assert profile.mask_px == pytest.approx(2.5, rel=0.15)
    beads = measure_beads(light, shadows.uv, shadows.shape, profile, noise)
    plain = _typical(light, shadows, np.ones(36), RADIUS)
    without = measure_beads(light, shadows.uv, shadows.shape, plain, noise)
    errors = [np.sqrt(np.mean((one.uv - shadows.uv)[20:] ** 2)) for one in (beads, without)]
    assert errors[0] < 0.5 * errors[1]
    # A mask makes shadows darker, but not their noise.
    column, row = np.rint(shadows.uv[:20]).astype(int).T
    amplified = (1 + factor) ** 2 * unmasked[row, column].mean()
    assert imaging.noise.variance(image[row, column]).mean() == pytest.approx(amplified, rel=0.4)
    # Without shadows that touch, the mask is still a part of the model.
    rows = np.flatnonzero(shadows.alone)
    alone = Expected(*(getattr(shadows, name)[rows] for name in SHADOWS))
    imaging = first_imaging(light, noise, alone, RADIUS, size=np.ones(36))
    assert imaging.profile.sharpening == pytest.approx(factor, rel=0.15)


def test_an_unsharp_mask_is_estimated_beside_edges_of_plates():
    """Edges cross the windows of 12 of 20 isolated shadows; the others decide."""
    image, shadows = radiograph_of_pairs(0.1, 10_000)
    rng = np.random.default_rng(0)
    y, x = np.indices(image.shape)
    passed = np.ones(image.shape)
    for u, v in shadows.uv[:12]:
        angle = rng.uniform(0, np.pi)
        across = (x - u) * np.cos(angle) + (y - v) * np.sin(angle)
        passed[(np.hypot(x - u, y - v) < 26) & (across > rng.uniform(3, 8))] = 0.75
    image = image * cv2.GaussianBlur(passed, (0, 0), 1.0)
    image = (image + 1.5 * (image - cv2.GaussianBlur(image, (0, 0), 2.5))).astype(np.float32)
    light = Light(image, np.ones(image.shape, bool))
    noise = estimate_noise(image, light.field)
    profile = first_imaging(light, noise, shadows, RADIUS, size=np.ones(36)).profile
    assert profile.sharpening == pytest.approx(1.5, rel=0.05)
    assert profile.mask_px == pytest.approx(2.5, rel=0.05)
    assert profile.radius_px == pytest.approx(RADIUS, abs=0.05)


def test_an_unsharp_mask_may_leave_less_than_no_direct_light():
    light = Light(np.full((60, 60), 1000.0, np.float32), np.ones((60, 60), bool))
    for sharpening, mask_px in ((0.0, 0.0), (1.5, 2.5)):
        profile = Profile(RADIUS, 1.2, 2.0, 0.1, sharpening, mask_px)
        fit = BeadFit(light, np.array([[30.0, 30]]), circles(np.ones(1)), profile, NOISE)
        fit.depth[:] = 1.1
        ((rows, near),) = fit.groups
        absorbed, _ = profile.shadow(np.linalg.norm(fit.offset, axis=1))
        expected = 100 + 900 * (1 - 1.1 * absorbed)
        model, _ = fit._model(rows, near)
        assert expected.min() < 100
        if not sharpening:
            expected = np.maximum(expected, 100)
        np.testing.assert_allclose(model[0], expected, atol=20)
        assert (model.min() < 80) == bool(sharpening)


def test_light_behind_two_beads_changes_with_the_scattered_light():
    """Shadows of single beads do not change: the depth compensates the loss of direct light."""
    image, shadows = radiograph_of_pairs(0.2)
    light = Light(image, np.ones(image.shape, bool))
    profile = Profile(RADIUS, 1.2, ABSORBED * RADIUS, 0.2)
    fit = BeadFit(
        light, shadows.uv, shadows.shape, profile, Noise(0.0, 1.0, np.ones((1, 1))), np.ones(36)
    )
    fit.run(4)
    fit.background.terms[:] = np.log(800.0), 0, 0, 0, 0, 0
    fit.background.around[:] = 900.0
    fit._cross()
    rows, near = (np.concatenate(parts) for parts in zip(*fit.groups[1:]))
    before, jacobian = fit._model(rows, near)
    slope = _by_scatter(fit, rows, near, before, jacobian)
    change = 1e-3
    fit.profile = replace(profile, scatter=0.2 + change)
    fit.background.scatter = 0.2 + change
    # The light without beads stays the same.
    direct = np.exp(fit.background.terms[:, 0])
    fit.background.terms[:, 0] = np.log(direct - change * fit.background.around)
    fit.depth *= direct / (direct - change * fit.background.around)
    fit._cross()
    after, _ = fit._model(rows, near)
    # The tolerance allows for the blur of touching shadows on three grid points per pixel.
    np.testing.assert_allclose((after - before) / change, slope, atol=0.02 * np.abs(slope).max())
    assert np.abs(slope).max() > 30


def test_another_share_of_scattered_light_leaves_the_middle_as_dark():
    profile = Profile(6.0, 1.2, 0.9, 0.1)
    other = profile.with_scatter(0.2)
    assert other.scatter == 0.2 and other.attenuation > profile.attenuation
    middles = [(1 - one.scatter) * one.absorbed(np.zeros(1)) for one in (profile, other)]
    np.testing.assert_allclose(middles[1], middles[0], rtol=1e-12)
    assert np.isfinite(Profile(6.0, 1.2, 5.0, 0.0).with_scatter(0.6).attenuation)
