# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Parts of extraction against written-out formulas: views, noise, fits of shadows, symmetries."""

from dataclasses import replace
from types import SimpleNamespace as Fake

import cv2
import numpy as np
import pytest
from scipy.signal import convolve2d
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from scipy.stats import norm

from fluoro_calib_ros.errors import DataError
from fluoro_calib_ros.findings import Finding, Kind
from fluoro_calib_ros.images import growth, matching
from fluoro_calib_ros.images.background import TERMS, Background, HiddenLight
from fluoro_calib_ros.images.clipping import Clipping
from fluoro_calib_ros.images.growth import Match
from fluoro_calib_ros.images.light import (
    LAGS,
    Light,
    Noise,
    _seen_by,
    correlation_of,
    estimate_noise,
    less_common,
)
from fluoro_calib_ros.images.matching import (
    EVIDENT,
    SURE,
    PhantomModel,
    _scale_by_extent,
    _scales,
    is_evident,
    is_sure,
    seeds_of,
    unambiguous,
)
from fluoro_calib_ros.images.profile import Absorbed, Profile, fit_profile
from fluoro_calib_ros.images.shadow_fit import (
    DEPTHS,
    OWN,
    FitSettings,
    ShadowFit,
    _correlation,
    _images,
    _inflation,
    _sd_of_centre,
)
from fluoro_calib_ros.images.texture import window_offsets
from fluoro_calib_ros.images.view import (
    Lens,
    View,
    _linearised,
    _moved,
    assumed_lens,
    exponents,
    fit_view,
    lacks_certain_pose,
    shared_lens,
)

LENS = Lens((1000, 800), 3000.0)


def some_view(degree=3, seed=1, lens=LENS):
    rng = np.random.default_rng(seed)
    count = len(exponents(degree))
    return View(
        lens,
        Rotation.from_rotvec([0.3, -0.2, 0.4]).as_matrix(),
        Rotation.from_rotvec([-0.3, 0.2, -0.4]).apply([5.0, -3.0, -900.0]),
        2900.0,
        rng.normal(0, 6.0, (2, count)),
        degree,
    )


def beads(count=60, seed=2):
    return np.random.default_rng(seed).uniform(-90, 90, (count, 3))


def stepped(view, step):
    """Return the view after a step of its unknowns, without limiting the step."""
    return replace(
        view,
        position=view.position + step[:3],
        rotation=Rotation.from_rotvec(step[3:6]).as_matrix() @ view.rotation,
        principal_distance_px=view.principal_distance_px * np.exp(step[6]),
        coefficients=view.coefficients + step[7:].reshape(2, -1),
    )


# ---- views


def test_derivatives_of_a_view_are_those_of_its_projection():
    view, xyz = some_view(), beads()
    uv = view.project(xyz) + 1.5
    residual, jacobian = _linearised(view, xyz, uv)
    np.testing.assert_allclose(residual, 1.5, atol=1e-9)
    steps = np.r_[[1e-3] * 3, [1e-6] * 3, 1e-6, np.full(jacobian.shape[2] - 7, 1e-3)]
    for column, h in enumerate(steps):
        unit = h * np.eye(len(steps))[column]
        ahead, back = (stepped(view, s * unit).project(xyz) for s in (1, -1))
        np.testing.assert_allclose(
            jacobian[:, :, column], (ahead - back) / (2 * h), rtol=1e-4, atol=1e-3
        )


def test_distortion_stays_beyond_one_and_a_half_of_the_image():
    view = some_view()
    far = LENS.centre + [[1.4 * 500, 0], [1.6 * 500, 0], [3.0 * 500, 0]]
    inside, one, other = view._distortion(far)[0]
    np.testing.assert_allclose(one, other)
    assert np.abs(inside - one).max() > 0.1


def test_a_view_is_fitted_with_the_weight_of_what_is_expected():
    """The dense solution has robust weights, and priors of distance and coefficients."""
    lens = replace(LENS, coefficients=np.full((2, 5), 2.0), certainty=0.5)
    view, xyz = some_view(2, lens=lens), beads()
    true = stepped(view, np.r_[0.5, -0.3, 1.0, 2e-3, -1e-3, 1e-3, 2e-3, np.full(10, 0.5)])
    uv = true.project(xyz) + np.random.default_rng(3).normal(0, 0.3, (60, 2))
    uv[7] += 80.0
    residual, jacobian = _linearised(view, xyz, uv)
    squared = np.sum(residual**2, axis=1)
    scale = np.sqrt(np.median(squared) / (2 * np.log(2)))
    weight = 1 / (1 + squared / (2.5 * scale) ** 2) / scale**2
    normal = np.einsum('nai,n,naj->ij', jacobian, weight, jacobian)
    right = np.einsum('nai,n,na->i', jacobian, weight, residual)
    sd = 0.5 * 500 * np.array([0.01, 0.01, 0.012, 0.012, 0.012])
    prior = np.r_[np.zeros(6), 0.08**-2, np.tile(sd**-2.0, 2)]
    off = np.r_[np.zeros(6), np.log(2900 / 3000), view.coefficients.ravel() - 2.0]
    normal += np.diag(prior)
    normal[np.diag_indices(17)] *= 1 + 1e-6
    step = np.linalg.solve(normal, right - prior * off)
    expected = stepped(view, step)
    found, seen_scale = fit_view(view, xyz, uv, steps=1)
    assert seen_scale == pytest.approx(scale)
    np.testing.assert_allclose(found.position, expected.position, atol=1e-2)
    np.testing.assert_allclose(found.rotation, expected.rotation, atol=1e-5)
    np.testing.assert_allclose(found.coefficients, expected.coefficients, atol=1e-3)
    assert found.principal_distance_px == pytest.approx(expected.principal_distance_px, rel=1e-5)
    again, scale = fit_view(view, xyz, uv, steps=6)
    good = np.arange(60) != 7
    assert np.sqrt(np.mean((again.project(xyz) - uv)[good] ** 2)) < 0.35 and scale < 0.4
    same, nothing = fit_view(view, xyz[:2], uv[:2], floor_px=0.2)
    assert same is view and nothing == np.inf


def test_a_wild_step_of_a_view_is_shortened():
    view = some_view(1)
    step = np.r_[1.0, 2.0, 3.0, 0.6, 0.0, 0.8, 0.5, np.arange(4.0)]
    found = _moved(view, step)
    turn = Rotation.from_matrix(found.rotation @ view.rotation.T).as_rotvec()
    np.testing.assert_allclose(turn, [0.18, 0, 0.24], atol=1e-9)
    assert found.principal_distance_px == pytest.approx(2900 * np.exp(0.1))
    np.testing.assert_allclose(found.position, view.position + [1, 2, 3])
    np.testing.assert_allclose(found.coefficients, view.coefficients + [[0, 1], [2, 3]])
    small = _moved(view, -0.1 * step)
    np.testing.assert_allclose(
        Rotation.from_matrix(small.rotation @ view.rotation.T).as_rotvec(),
        [-0.06, 0, -0.08],
        atol=1e-12,
    )
    assert small.principal_distance_px == pytest.approx(2900 * np.exp(-0.05))


def test_a_view_of_another_degree_keeps_its_coefficients():
    view = some_view(3)
    more, less = view.with_degree(4), view.with_degree(2)
    np.testing.assert_array_equal(more.coefficients[:, :9], view.coefficients)
    assert not more.coefficients[:, 9:].any() and more.coefficients.shape == (2, 14)
    np.testing.assert_array_equal(less.coefficients, view.coefficients[:, :5])
    xyz = beads()
    np.testing.assert_allclose(more.project(xyz), view.project(xyz))
    np.testing.assert_allclose(view.depth(xyz), ((xyz - view.position) @ view.rotation.T)[:, 2])
    behind = view.position - view.rotation[2]
    assert np.isnan(view.project(behind[None])).all()
    np.testing.assert_array_equal(LENS.centre, [499.5, 399.5])
    assert LENS.half_px == 500


def test_what_other_images_show_of_a_fluoroscope_helps_with_the_next():
    views = [some_view(3, seed) for seed in range(4)]
    views = [replace(v, principal_distance_px=2800.0 + 100 * k) for k, v in enumerate(views)]
    assert shared_lens(LENS, views[:2]) is None
    found = shared_lens(LENS, views[:3])
    assert found.principal_distance_px == 2900 and found.principal_distance_sd == 0.03
    middle = np.median([v.coefficients for v in views[:3]], axis=0)
    np.testing.assert_array_equal(found.coefficients, middle)
    assert found.certainty == 0.3
    np.testing.assert_allclose(found.deviations(1), 0.3 * 500 * 0.01)
    np.testing.assert_array_equal(found.expected(4)[:, :9], middle)
    assert not found.expected(4)[:, 9:].any()
    given, usual = assumed_lens((1000, 800), 3300.0), assumed_lens((1000, 800), None)
    assert (given.principal_distance_px, given.principal_distance_sd) == (3300, 0.08)
    assert (usual.principal_distance_px, usual.principal_distance_sd) == (4000, 0.25)
    assert not lacks_certain_pose(None)
    assert lacks_certain_pose(Finding(Kind.NO_POSE, '')) and not lacks_certain_pose(
        Finding(Kind.FEW_BEADS, '')
    )


# ---- noise


@pytest.mark.parametrize('blur', [False, True])
def test_noise_of_an_image_is_that_of_its_pixels(blur):
    """The noise of a ramp of light grows with the light; one case is correlated along the rows."""
    rng = np.random.default_rng(4)
    light = np.tile(np.linspace(100, 900, 400), (300, 1))
    white = rng.normal(size=light.shape)
    if blur:
        white = convolve2d(white, [[0.25, 0.5, 0.25]], 'same', 'wrap') / np.sqrt(0.375)
    image = (light + np.sqrt(20 + 0.5 * light) * white).astype(np.float32)
    found = estimate_noise(image, np.ones(image.shape, bool))
    for level in (200.0, 800.0):
        assert found.variance(level) == pytest.approx(20 + 0.5 * level, rel=0.12)
    expected = [0.0, 1 / 6, 2 / 3, 1, 2 / 3, 1 / 6, 0.0] if blur else [0.0] * 3 + [1] + [0.0] * 3
    np.testing.assert_allclose(found.correlation[LAGS, 1:-1], expected, atol=0.08)
    assert not found.correlation[:LAGS, LAGS].any()
    few = estimate_noise(image, np.arange(image.size).reshape(image.shape) < 500)
    assert (few.constant, few.gain) == (1 / 12, 0.0)


def test_noise_may_fall_with_the_light():
    """In an inverted image, that of photons does; below a bound it keeps rising."""
    rng = np.random.default_rng(5)
    light = np.tile(np.linspace(5, 120, 400), (300, 1))
    image = (light + np.sqrt(0.14 * (255 - light)) * rng.normal(size=light.shape)).astype('f4')
    found = estimate_noise(image, np.ones(image.shape, bool))
    for level in (-50.0, 10.0, 110.0):
        assert found.variance(level) == pytest.approx(0.14 * (255 - level), rel=0.12)


def test_variance_is_that_of_rounding_at_least():
    noise = Noise(-5.0, 0.5, np.ones((1, 1)))
    np.testing.assert_allclose(
        noise.variance(np.array([-9.0, 10.0, 10.3])), [1 / 12, 1 / 12, 0.15]
    )


def test_differences_see_a_part_of_correlated_noise():
    """The expected value follows from the covariance of pixels in second differences both ways."""
    lags = np.arange(-2, 3)
    correlation = np.exp(-np.abs(lags))[:, None] * np.exp(-0.5 * np.abs(lags))
    kernel = np.array([1.0, -2.0, 1.0])
    place = np.arange(3)
    whole = sum(
        kernel[a] * kernel[b] * kernel[c] * kernel[d] * correlation[2 + a - c, 2 + b - d]
        for a in place
        for b in place
        for c in place
        for d in place
    )
    assert _seen_by(kernel, correlation) == pytest.approx(whole / np.sum(kernel**2) ** 2)


def test_correlation_of_residuals_counts_valid_pairs():
    rng = np.random.default_rng(5)
    noise = rng.normal(size=(40, 30, 30))
    mixed = noise + 0.6 * np.roll(noise, (1, 2), axis=(1, 2))
    valid = rng.random(mixed.shape) < 0.8
    found = correlation_of(np.where(valid, mixed, 0.0), valid.astype(float))
    expected = np.zeros_like(found)
    expected[LAGS, LAGS] = 1
    expected[LAGS + 1, LAGS + 2] = expected[LAGS - 1, LAGS - 2] = 0.6 / 1.36
    np.testing.assert_allclose(found, expected, atol=0.03)


def test_clipped_values_are_more_frequent_than_those_beside():
    rng = np.random.default_rng(6)
    grey = np.clip(np.rint(rng.normal(500, 100, (100, 100))), 300, 650)
    assert Clipping.of(grey) == Clipping(300, 650)
    assert not Clipping.of(np.rint(rng.normal(500, 100, (100, 100))))


@pytest.mark.parametrize('quality', [15, 30, 60])
def test_clipped_values_are_found_after_compression_with_losses(quality):
    rng = np.random.default_rng(7)
    light = 420 - 400 * np.exp(-0.5 * ((np.mgrid[:96, :96] - 48) ** 2).sum(axis=0) / 8**2)
    image = np.clip(rng.normal(light, 6), 0, 255).astype(np.uint8)
    _, data = cv2.imencode('.jpg', image, [cv2.IMWRITE_JPEG_QUALITY, quality])
    grey = cv2.imdecode(data, cv2.IMREAD_GRAYSCALE).astype(np.float32)
    high = Clipping.of(grey).high
    assert 252 <= high <= 255
    assert np.mean(grey >= high) == pytest.approx(np.mean(image == 255), abs=0.05)


def test_steps_with_clipped_pixels_are_those_of_newton():
    light = np.linspace(60, 140, 9)
    grey = np.full(9, 100.0)
    variance = np.full(9, 15.0**2)
    step = 1e-3
    for clipping, beyond in ((Clipping(high=100), 1), (Clipping(low=100), -1)):
        residual, information = clipping.observed(grey, light, variance)

        def log_likelihood(light):
            return norm.logcdf((beyond * (light - 100) + 0.5) / 15)

        before, at, after = (log_likelihood(light + one) for one in (-step, 0, step))
        first = (after - before) / (2 * step)
        second = (before - 2 * at + after) / step**2
        used = information > 0
        assert used.sum() == 8
        np.testing.assert_allclose((residual * information / variance)[used], first[used], 1e-5)
        np.testing.assert_allclose((information / variance)[used], -second[used], rtol=1e-4)


def test_light_beyond_the_bound_is_estimated_without_bias():
    rng = np.random.default_rng(8)
    for true in (90.0, 100.0, 110.0):
        grey = np.minimum(np.rint(rng.normal(true, 10, 40_000)), 100)
        light = 100.0
        for _ in range(20):
            residual, information = Clipping(high=100).observed(
                grey, np.full(grey.shape, light), np.full(grey.shape, 100.0)
            )
            light += (residual @ information) / information.sum()
        assert light == pytest.approx(true, abs=0.3)


def test_spread_of_hidden_light_is_that_of_the_windows():
    rng = np.random.default_rng(9)
    count = 400
    # Edges cross some windows; half of the others hardly determine their terms.
    is_crossed = np.arange(count) % 20 == 1
    spread = np.where(is_crossed, 1.0, 0.1)
    background = Background(count, window_offsets(8.0), 8.0)
    terms = rng.normal(0, spread[:, None], (count, TERMS - 1))
    sd = np.where(np.arange(count) % 2, 0.02, 2.0)[:, None]
    observed = terms + rng.normal(0, sd, terms.shape)
    normal = np.tile(np.eye(TERMS + 3), (count, 1, 1))
    normal[:, range(1, TERMS), range(1, TERMS)] = sd**-2.0
    right = np.zeros((count, TERMS + 3))
    right[:, 1:TERMS] = observed / sd**2
    hidden = HiddenLight(count)
    hidden.note(np.arange(count), normal, right, background)
    found = hidden.spread(np.ones(count, bool), 1.0)
    assert found.shape == (count, 1)
    assert np.median(found) == pytest.approx(0.1, rel=0.15)
    assert np.median(found[is_crossed]) > 5 * np.median(found)
    background.spread = found
    noted = normal.copy()
    noted[:, range(1, TERMS), range(1, TERMS)] += background.prior(np.arange(count))[:, 1:]
    hidden.note(np.arange(count), noted, right, background)
    np.testing.assert_allclose(hidden.spread(np.ones(count, bool), 1.0), found, rtol=1e-6)


# ---- fits of shadows


class Discs(ShadowFit):
    """A fit with a linear model of beads: direct light, and three given functions of each bead."""

    def _model(self, rows, near):
        k = near.shape[1]
        rng = np.random.default_rng(7)
        direct = self.background.direct(rows)
        jacobian = self._jacobian(rows, direct, 1 + k)
        jacobian[:, TERMS:] = rng.normal(size=jacobian[:, TERMS:].shape)
        return self.background.scattered(rows) + direct, jacobian

    def _disturbed(self, rows, near, final):
        return np.zeros(len(rows), dtype=bool)

    def _depth_sd(self, rows, near):
        return 0.7

    def _solve(self, rows, near, equations, final):
        return np.linalg.solve(equations.matrix, equations.right[..., None])[..., 0]


SETTINGS = FitSettings(3, (), ((1, 2), (3, 4)), 0.5, 100.0, 1.3)


def fit_of(count=3, near=None):
    noise = Noise(4.0, 0.0, np.ones((1, 1)))
    uv = 30.0 * np.arange(1, count + 1)[:, None] + [0.2, -0.3]
    fit = Discs(SETTINGS, Profile(4.0, 1.0, 0.5), noise, uv, np.linspace(0.8, 1.2, count), 6.0)
    rng = np.random.default_rng(8)
    grey = 100 + rng.normal(0, 2.0, (count, len(fit.offset)))
    valid = rng.random(grey.shape) < 0.9
    fit._set_windows(grey, valid, grey)
    fit._set_groups(np.full((count, 2), -1) if near is None else near)
    return fit


@pytest.mark.parametrize('count', [12, 200])
def test_what_windows_have_in_common_is_no_noise_where_it_changes_over_the_image(count):
    """What remains has the variance of the noise, in usual windows and in others."""
    rng = np.random.default_rng(9)
    place = rng.uniform(0, 1000, (count, 2))
    x, y = (place.T - 500) / 500
    size = rng.choice([0.7, 1.0, 1.4], count)
    pixels = 200
    common = rng.normal(size=(5, pixels))
    usual = np.arange(count) % 4 > 0
    valid = rng.random((count, pixels)) < 0.9
    left = []
    for _ in range(20):
        noise = rng.normal(size=(count, pixels))
        pattern = np.stack([np.ones_like(x), x, y, x * y, np.log(size)], axis=1) @ common
        given = ((noise + pattern) * valid).astype(np.float32)
        left.append(less_common(place, size, given, valid, usual))
    assert not np.stack(left)[:, ~valid].any()
    variance = np.mean(np.square(left), axis=(0, 2)) / valid.mean(axis=1)
    many = count > 100
    # A few windows leave part of the common pattern; without a correction the variance would be 4.
    assert np.mean(variance[usual]) == pytest.approx(1, abs=0.05 if many else 0.5)
    assert np.mean(variance[~usual]) == pytest.approx(1, abs=0.05 if many else 1.0)
    noise_alone = [
        less_common(place, size, rng.normal(size=(count, pixels)), valid | True, usual)
        for _ in range(20)
    ]
    variance = np.mean(np.square(noise_alone), axis=(0, 2))
    np.testing.assert_allclose(variance, 1, atol=0.1)
    np.testing.assert_array_equal(less_common(place, size, given, valid, usual & False), given)


def test_correlation_of_the_noise_is_the_smaller_one_of_windows_and_background():
    """Each contains more than the noise: lack of fit in windows, other beads in the background."""
    fit = fit_of(40)
    rng = np.random.default_rng(12)
    white = rng.normal(size=(40, len(fit.offset)))
    images = _images(fit.offset, white)
    blurred = np.stack([images[:, 1:, :], images[:, :-1, :]]).sum(axis=0)
    smooth = np.pad(blurred, ((0, 0), (0, 1), (0, 0)))
    half = int(np.abs(fit.offset).max())
    correlated = smooth[:, fit.offset[:, 1] + half, fit.offset[:, 0] + half]
    valid = np.ones(white.shape, dtype=bool)
    background = np.zeros((2 * LAGS + 1, 2 * LAGS + 1))
    background[LAGS, LAGS] = 1.0
    background[LAGS + 1, LAGS] = background[LAGS - 1, LAGS] = 0.2
    fit.noise = Noise(4.0, 0.0, background)
    assert _correlation(fit, white, valid).sum() < 1.2
    assert _correlation(fit, correlated, valid) is background
    # Too few pixels give no estimate.
    assert _correlation(fit, white[:2], valid[:2]) is background


@pytest.mark.parametrize('neighbours', [0, 2])
def test_steps_of_a_fit_are_those_of_weighted_least_squares(neighbours):
    fit = fit_of(near=np.tile([1, 2][:neighbours], (3, 1)).reshape(3, neighbours))
    ((rows, near),) = fit.groups
    fit.depth = fit.expected_depth + 0.1
    light, jacobian = fit._model(rows, near)
    centres, depth, background = fit._step(rows, near, True)
    prior = np.zeros(OWN + 3 * neighbours)
    prior[TERMS + 2] = 0.7**-2
    prior[OWN:] = np.tile([1.0, 1.0, 0.2**-2], neighbours)
    for k in range(3):
        used = fit.valid[k]
        a = jacobian[k][:, used].T.astype(float)
        y = (fit.grey[k] - light[k])[used].astype(float)
        right = a.T @ y / 4.0
        right[TERMS + 2] -= prior[TERMS + 2] * 0.1
        step = np.linalg.solve(a.T @ a / 4.0 + np.diag(prior), right)
        # The unit of a step of the background is the direct light in the middle.
        terms = fit.background.terms[k]
        relative = step[:TERMS] / np.exp(terms[0])
        np.testing.assert_allclose(background[k], terms + relative, atol=1e-5)
        moved = np.clip(step[TERMS : TERMS + 2], -0.5, 0.5)
        np.testing.assert_allclose(centres[k], fit.uv[k] + moved, atol=1e-3)
        assert depth[k] == pytest.approx(
            np.clip(fit.depth[k] + step[TERMS + 2], *DEPTHS), abs=1e-3
        )
        misfit = np.sum(y**2) / 4.0 / (used.sum() - OWN)
        assert fit.misfit[k] == pytest.approx(misfit, rel=1e-4)


def test_beads_are_grouped_by_their_neighbours_and_alone_first():
    near = np.array([[1, -1, -1, -1], [-1] * 4, [0, 1, 4, -1], [0, 1, -1, -1], [0, 1, 2, 3]])
    groups = fit_of(5, near).groups
    assert [rows.tolist() for rows, _ in groups] == [[1], [0, 3], [2, 4]]
    assert [one.shape[1] for _, one in groups] == [0, 2, 4]
    np.testing.assert_array_equal(groups[1][1], near[[0, 3], :2])


def test_windows_begin_with_the_upper_quartile_and_need_most_of_their_pixels():
    fit = fit_of()
    for k in range(3):
        light = np.exp(fit.background.terms[k, 0])
        assert np.mean(fit.grey[k] < light) == pytest.approx(0.75, abs=0.02)
    valid = fit.valid.copy()
    valid[1] = np.arange(len(fit.offset)) < 0.59 * len(fit.offset)
    fit._set_windows(fit.grey, valid, fit.grey)
    assert fit.usable.tolist() == [True, False, True]


def test_clipped_pixels_do_not_count_where_they_agree():
    fit = fit_of()
    fit.clipping = Clipping(50.0, 150.0)
    fit.grey = np.array([[50.0, 150.0, 50.0, 150.0, 100.0]], np.float32)
    fit.valid = np.ones((1, 5), bool)
    light = np.array([[10.0, 190.0, 90.0, 110.0, 100.0]], np.float32)
    residual, weight, information = fit._observed(np.array([0]), light)
    assert weight[0, :2].tolist() == [0, 0]
    np.testing.assert_allclose(residual[0, 2:], [-40, 40, 0], atol=2.0)
    np.testing.assert_allclose(information[0, 2:], 1, atol=0.1)


def test_typical_lack_of_fit_is_the_median_of_usable_beads():
    fit = fit_of(5)
    fit.misfit = np.array([1.0, 9.0, 2.0, np.inf, 4.0])
    fit.usable = np.array([True, False, True, True, True])
    assert fit.typical() == 2.0
    fit.usable[1] = True
    assert fit.typical() == 3.0
    fit.usable[:] = False
    assert fit.typical() == 1.0


def test_standard_deviations_follow_the_noise_of_the_bead_and_of_all():
    fit = fit_of(4)
    pixels = fit.valid.sum(axis=1)
    fit.misfit = np.array([4.0, 1.0, 1.0, 0.5])
    fit.sigma = fit.noise_sigma = np.full(4, 0.1)
    fit.inflation = 3.0
    fit.distance = np.array([50.0, 7.9, 8.1, 100.0])
    found = fit._beads(np.ones(4, bool), 1.0)
    pooled = (fit.misfit * pixels + 100.0) / (pixels + 100)
    factor = np.sqrt(np.maximum(pooled, 1.0)) * [1, 1.3, 1, 1]
    np.testing.assert_allclose(found.sigma, 0.1 * np.sqrt(3) * factor)
    np.testing.assert_allclose(found.misfit, fit.misfit)
    reach = fit.profile.reach_px
    assert found.overlapped.tolist() == (fit.distance < 2 * reach * 0.85).tolist()
    noise = np.array([0.5, 0.2, 0.3, 0.9])
    told = fit._beads(np.array([True, True, True, False]), 1.0, noise)
    pooled = (noise * pixels + 0.3 * 100) / (pixels + 100)
    factor = np.sqrt(np.maximum(pooled, 0.3)) * [1, 1.3, 1, 1]
    np.testing.assert_allclose(told.sigma, 0.1 * np.sqrt(3) * factor)


def test_correlated_noise_enlarges_variances_by_its_sums():
    rng = np.random.default_rng(9)
    influence = rng.normal(size=(2, 7, 7)).cumsum(axis=2)
    correlation = np.zeros((3, 3))
    correlation[1] = [0.4, 1.0, 0.4]
    correlated = np.sum(influence**2) + 0.8 * np.sum(influence[:, :, 1:] * influence[:, :, :-1])
    assert _inflation(influence, correlation) == pytest.approx(correlated / np.sum(influence**2))
    assert _inflation(influence, np.diag([0.0, 1.0, 0.0])) == 1.0
    covariance = np.zeros((1, OWN, OWN))
    covariance[0, TERMS, TERMS], covariance[0, TERMS + 1, TERMS + 1] = 0.02, 0.06
    assert _sd_of_centre(covariance) == pytest.approx(0.2)


def test_a_window_is_round():
    offsets = window_offsets(4.5)
    assert len(offsets) == sum(i * i + j * j <= 4.5**2 for i in range(-5, 6) for j in range(-5, 6))
    assert np.abs(offsets).max() == 4 and len(np.unique(offsets, axis=0)) == len(offsets)


def test_a_profile_is_fitted_to_what_it_absorbs():
    true = Profile(5.0, 1.2, 0.8, 0.1)
    rng = np.random.default_rng(10)
    distance = rng.uniform(0, 9, 4000)
    share = (1 - true.scatter) * true.shadow(distance)[0] + rng.normal(0, 0.01, 4000)
    absorbed = Absorbed(distance, share, *np.ones((3, 4000)))
    found = fit_profile(absorbed, Profile(4.5, 1.0, 0.9, 0.05))
    assert found.radius_px == pytest.approx(5.0, abs=0.15)
    assert found.blur_px == pytest.approx(1.2, abs=0.15)
    fitted = (1 - found.scatter) * found.shadow(distance)[0]
    np.testing.assert_allclose(fitted, (1 - true.scatter) * true.shadow(distance)[0], atol=5e-3)
    small = true.sized(0.5)
    assert (small.radius_px, small.blur_px, small.attenuation) == (2.5, 1.2, 0.4)
    assert true.reach_px == pytest.approx(5.0 + 3.2 * 1.2)


# ---- views of a phantom from other sides


def test_regular_phantoms_are_flat_grids():
    with pytest.raises(DataError, match='not a flat grid'):
        PhantomModel.of(beads(), regular=True)


def found_match(number, scale_px, beads_of=40, turn=0, against=0):
    """Return a match of `number` beads, whose score is about that number."""
    bead = (np.arange(number) + turn) % 60
    return Match(
        Fake(),
        bead,
        np.arange(number),
        np.zeros(number),
        found=0.9,
        apart=0.9,
        explained=0.9,
        scale_px=scale_px,
        expected=beads_of,
        against=against,
        evidence=100.0,
    )


def decided(monkeypatch, first, rivals, **model):
    monkeypatch.setattr(matching, '_climbed', lambda *_: (first, rivals))
    monkeypatch.setattr(matching, '_best_by_size', lambda *_: None)
    return unambiguous(first, None, Fake(regular=False, **model))


@pytest.mark.parametrize('against', [0, 4, 24])
def test_a_pose_is_ambiguous_where_another_fits_nearly_as_well(monkeypatch, against):
    first = found_match(50, 1.0, against=against)
    # Of 50 beads, one more than were missing may be missing by chance.
    margin = np.log(1e4) / np.log(50 / (against + 1))
    score = first.score
    near, far = found_match(50, 1.1, turn=5), found_match(50, 1.1, turn=5)
    monkeypatch.setattr(
        Match,
        'score',
        property(
            lambda one: {
                id(first): score,
                id(near): score - margin + 0.5,
                id(far): score - margin - 0.5,
            }[id(one)]
        ),
    )
    assert decided(monkeypatch, first, [far]) is first
    with pytest.raises(DataError) as error:
        decided(monkeypatch, first, [far, near])
    assert error.value.finding.kind is Kind.POSE_AMBIGUOUS
    assert unambiguous(first, None, Fake(regular=True)) is first


def test_of_two_poses_the_one_with_half_the_residuals_is_taken(monkeypatch):
    first, other = found_match(50, 1.0), found_match(50, 0.49, turn=5)
    assert decided(monkeypatch, first, [other]) is other
    with pytest.raises(DataError):
        decided(monkeypatch, first, [found_match(50, 0.51, turn=5)])
    assert decided(monkeypatch, first, [found_match(50, 2.1, turn=5)]) is first
    assert decided(monkeypatch, first, [found_match(50, 1.0)]) is first  # the same beads


@pytest.mark.parametrize('limits, decide', [(EVIDENT, is_evident), (SURE, is_sure)])
def test_evidence_of_a_pose_is_what_is_found_and_explained(limits, decide):
    def pose(found, explained, evidence=28.0):
        return Fake(found=found, apart=found, explained=explained, evidence=evidence)

    for found, explained in limits:
        assert decide(pose(found, explained))
        assert not decide(pose(found, explained, evidence=27.0))
    (much, little), (few, most) = limits
    assert not decide(pose(much - 0.01, most - 0.01))
    assert not decide(pose(few - 0.01, 1.0))
    assert not decide(pose(1.0, little - 0.01))


@pytest.mark.parametrize('decide', [is_evident, is_sure])
def test_beads_that_overlap_do_not_count_against_a_pose_that_explains_the_image(decide):
    pose = Fake(found=0.59, apart=0.87, explained=0.99, evidence=1000.0)
    assert decide(pose)
    pose.explained = 0.8
    assert not decide(pose)


def test_poses_that_detections_anywhere_explain_have_no_evidence():
    # Hits of ten predictions where a twentieth of the places have a detection: 10 ln 20.
    assert growth._evidence(np.ones(10, bool), 0.05) == pytest.approx(10 * np.log(20))
    half = np.arange(10) < 5
    expected = 10 * (0.5 * np.log(0.5 / 0.05) + 0.5 * np.log(0.5 / 0.95))
    assert growth._evidence(half, 0.05) == pytest.approx(expected)
    assert growth._evidence(half, 0.5) == 0
    assert growth._evidence(half[:0], 0.1) == 0


def test_scales_are_those_of_the_extent_and_of_the_size_of_beads():
    rng = np.random.default_rng(11)
    xyz = rng.normal(0, 20.0, (4000, 3))
    uv = 500 + 3.0 * xyz[:, :2]
    seen = Fake(uv=uv, radius_px=6.0)
    model = Fake(xyz=xyz, diameter_mm=None, spacing_mm=8.0)
    assert _scale_by_extent(seen, model) == pytest.approx(3.0, rel=0.03)
    low, high = _scales(seen, model, (0.85, 1.4))
    assert (low, high) == (pytest.approx(2.55, rel=0.03), pytest.approx(4.2, rel=0.03))
    # Beads of 6 px, 8 mm apart, are separate from 1.5 px/mm.
    assert _scales(seen, model, (0.1, 1.4))[0] == pytest.approx(1.5)
    sized = Fake(
        xyz=xyz, diameter_mm=np.full(4000, 3.0), spacing_mm=8.0
    )  # 12 px are 3 mm: 4 px/mm
    low, high = _scales(seen, sized, (0.5, 3.0))
    assert (low, high) == (pytest.approx(2.2), pytest.approx(6.4))


def test_seeds_begin_in_the_middle_and_go_on_with_beads_apart():
    rng = np.random.default_rng(12)
    crowd = rng.uniform(0, 100, (200, 2))
    apart = np.stack(np.meshgrid(np.arange(10), np.arange(10)), -1).reshape(-1, 2) * 60.0 - 250
    uv = np.concatenate([crowd, apart])
    order = seeds_of(Fake(uv=uv, tree=cKDTree(uv)))
    assert sorted(order) == list(range(300))
    distance = np.linalg.norm(uv - np.median(uv, axis=0), axis=1)
    assert order[0] == np.argmin(distance)
    assert (distance[order[:8]] <= np.sort(distance)[149]).all()
    spacing = np.sort(np.linalg.norm(uv[:, None] - uv[None], axis=2), axis=1)[:, 3]
    later = order[8:180]
    assert np.median(spacing[later[:160]]) > np.median(spacing[order[200:]])


def test_borders_of_shadows_are_those_of_the_cones_that_touch_spheres():
    """The wide view has a distortion; the expected borders are projected ray by ray."""
    lens = Lens((1000, 1000), 1200.0)
    coefficients = np.zeros((2, len(exponents(3))))
    coefficients[:, 5:] = [[20.0, 0.0, 20.0, 0.0], [0.0, 20.0, 0.0, 20.0]]
    view = View(lens, np.eye(3), np.array([0.0, 0.0, -900.0]), 1200.0, coefficients, 3)
    xyz = np.array([[0.0, 0.0, 0.0], [250.0, -120.0, 30.0], [-300.0, 280.0, -60.0]])
    radius = 0.5
    turn = 2 * np.pi * np.arange(48) / 48
    circle = np.column_stack([np.cos(turn), np.sin(turn)])
    for centre, outline in zip(xyz, view.outlines(xyz)):
        away = centre - view.position
        distance = np.linalg.norm(away)
        across = np.cross(away, [0.3, 1.0, 0.2])
        across /= np.linalg.norm(across)
        down = np.cross(away / distance, across)
        sine = radius / distance
        touched = centre - sine**2 * away
        touched = touched + radius * np.sqrt(1 - sine**2) * circle @ np.stack([across, down])
        border = view.project(touched)
        border -= border.mean(axis=0)
        seen = np.linalg.norm(border @ np.linalg.inv(radius * outline).T, axis=1)
        np.testing.assert_allclose(seen, 1.0, atol=2e-3)
    assert (view.outlines(np.array([[0.0, 0.0, -901.0]])) == 0).all()


def test_beads_of_several_sizes_tell_attenuation_from_scattered_light():
    """Beads of one size hardly do: a sharper edge with a wider blur looks alike."""
    true = Profile(5.0, 1.2, 0.8, 0.1)
    rng = np.random.default_rng(11)
    size = rng.choice([0.7, 1.0, 1.4], 12000)
    distance = rng.uniform(0, 11, 12000)
    share = np.empty(12000)
    for one in (0.7, 1.0, 1.4):
        own = size == one
        share[own] = (1 - true.scatter) * true.sized(one).shadow(distance[own])[0]
    share += rng.normal(0, 0.01, 12000)
    found = Profile(4.5, 1.0, 1.5, 0.1)
    for _ in range(4):  # each call makes a few steps only
        absorbed = Absorbed(distance, share, np.ones(12000), size, np.ones(12000))
        found = fit_profile(absorbed, found)
    assert found.radius_px == pytest.approx(5.0, abs=0.03)
    assert found.attenuation == pytest.approx(0.8, abs=0.05)
    assert found.scatter == pytest.approx(0.1, abs=0.015)


def test_shadows_in_different_light_tell_attenuation_from_scattered_light():
    """Where there is little direct light, a larger share of the light is scattered."""
    true = Profile(5.0, 1.2, 0.8, 0.1)
    rng = np.random.default_rng(13)
    distance = rng.uniform(0, 9, 12000)
    around = rng.choice([0.8, 1.0, 2.0, 4.0], 12000)
    share = (1 - true.scatter * around) * true.shadow(distance)[0] + rng.normal(0, 0.01, 12000)
    found = Profile(4.5, 1.0, 1.5, 0.3)
    for _ in range(4):  # each call makes a few steps only
        found = fit_profile(Absorbed(distance, share, *np.ones((2, 12000)), around), found)
    assert found.attenuation == pytest.approx(0.8, abs=0.05)
    assert found.scatter == pytest.approx(0.1, abs=0.005)


def test_surrounding_light_is_a_wide_mean():
    grey = np.full((512, 640), 100, np.float32)
    grey[:, 320:] = 300
    light = Light(grey, np.ones(grey.shape, bool))
    around = light.around(np.array([[0.0, 0], [319.5, 250], [359.5, 250], [639, 511], [900, 900]]))
    assert around == pytest.approx([100, 200, 200 + 200 * 0.3413, 300, 300], abs=10)


def test_noise_that_is_blurred_is_correlated_in_two_directions_as_well():
    """A blur of half a pixel: a correlation of 0.27 along the rows, and of 0.07 diagonally."""
    rng = np.random.default_rng(12)
    noise = cv2.GaussianBlur(rng.normal(size=(1, 300, 300))[0], (0, 0), 0.5)[None]
    found = correlation_of(noise, np.ones(noise.shape))
    along = found[LAGS, LAGS + 1]
    assert along == pytest.approx(0.27, abs=0.02)
    assert found[LAGS + 1, LAGS + 1] == pytest.approx(along**2, abs=0.02)
    white = correlation_of(rng.normal(size=(1, 300, 300)), np.ones((1, 300, 300)))
    assert white.sum() == 1
