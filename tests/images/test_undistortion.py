# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Corrected images: positions of beads, edges, folds, pixel depths, and invalid images."""

import functools
import threading
from dataclasses import replace

import numpy as np
import pytest
import rigs
from rigs import create_model
from scipy.ndimage import map_coordinates

from benchmarks.bead_images import BEAD_PX, background, bead_image
from fluoro_calib_ros.correction.base import CorrectionStatus
from fluoro_calib_ros.errors import DataError
from fluoro_calib_ros.images.corrector import LIMIT_PX, ImageCorrector

OK, OUTSIDE, INVALID = CorrectionStatus

SIZE = (1024, 1024)
DEPTHS = (np.uint8, np.uint16)


@functools.cache
def calibration(kind='auto'):
    """Return a calibration of the virtual rig."""
    return rigs.calibrated('a', model=kind).calibrations['a']


def corrector(interpolation='linear', kind='auto', border=0):
    """Return an ImageCorrector of this calibration."""
    return _corrector(interpolation, kind, border)  # f() and f('linear') differ for a cache


@functools.cache
def _corrector(interpolation, kind, border):
    return ImageCorrector(calibration(kind), interpolation, border)


def with_model(model, size):
    """Return the calibration for images of another size, with another model."""
    return replace(calibration(), model=model, image_size=size)


def model_of(uv, duv, kind='local_linear', k=6):
    """Return a CorrectionModel of training points and corrections (n, 2) [px]."""
    return create_model(
        kind, k, np.asarray(uv, dtype=float), np.asarray(duv, dtype=float), 0.2, 0.0
    )


def lattice(size, step=8.0):
    """Return pixels (n, 2) all over an image."""
    axes = [np.linspace(-0.5, s - 0.5, round(s / step) + 1) for s in size]
    return np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 2)


@functools.cache
def random_image(dtype, size=SIZE):
    """Return smooth noise over the range of grey values, which interpolation can reproduce."""
    rng = np.random.default_rng(0)
    y, x = np.mgrid[: size[1], : size[0]]
    waves = sum(np.sin(x * a + y * b + c) for a, b, c in rng.uniform(-0.15, 0.15, (6, 3)))
    return np.rint((waves - waves.min()) / np.ptp(waves) * np.iinfo(dtype).max).astype(dtype)


def off(image, light, uv, reach=9):
    """Return distances (n, 2) [px] of the blobs in an image (h, w) from nearby pixels uv (n, 2).
    The blobs are missing in light (h, w). A Gaussian with its first and second moments is fitted
    on a plane by least squares.
    """
    taken = 1 - image / light
    out = []
    for u, v in uv:
        part = np.s_[
            round(v) - reach : round(v) + reach + 1, round(u) - reach : round(u) + reach + 1
        ]
        y, x = np.mgrid[part].reshape(2, -1) - [[v], [u]]
        blob = np.exp(-0.5 * (x * x + y * y) / BEAD_PX**2)
        one = np.ones_like(x)
        columns = np.stack(
            [*(blob * p for p in (one, x, y, x * x, y * y, x * y)), one, x, y], axis=1
        )
        found = np.linalg.lstsq(columns, taken[part].ravel(), rcond=None)[0]
        out.append(found[1:3] / found[0] * BEAD_PX**2)
    return np.array(out)


# ---- positions


@pytest.mark.long
@pytest.mark.parametrize('kind', ['auto', 'local_linear', 'parametric'])
def test_corrected_source_of_a_pixel_is_the_pixel(kind):
    """The map of sources is the inverse of the correction of points."""
    this = corrector(kind=kind)
    corrected = calibration(kind).correct(this.source[:, this.mask].T)
    v, u = np.nonzero(this.mask)
    assert np.abs(corrected.uv - np.stack([u, v], axis=1)).max() < LIMIT_PX
    assert (
        np.mean(corrected.status == this.status[this.mask]) > 0.9999
    )  # the rounding to 32 bits may cross the edge of a cell
    assert (
        np.isnan(this.source[:, ~this.mask]).all()
        and not np.isnan(this.source[:, this.mask]).any()
    )
    assert {OK, OUTSIDE, INVALID} == set(np.unique(this.status).tolist())


@pytest.mark.parametrize('interpolation', ['linear', 'cubic'])
@pytest.mark.parametrize('dtype', DEPTHS)
@pytest.mark.long
def test_beads_move_as_points_do(dtype, interpolation):
    """Blobs drawn at observed positions appear where calibration.correct puts them; the distortion
    is up to 17 px.
    """
    at = np.stack(np.meshgrid(np.arange(62, 980, 60), np.arange(62, 980, 60)), axis=-1).reshape(
        -1, 2
    )
    observed = at + np.random.default_rng(1).uniform(-9, 9, at.shape)
    wanted = calibration().correct(observed).uv
    assert np.abs(wanted - observed).max() > 10
    image = bead_image(observed, SIZE, dtype, noise=0.0)
    light = corrector().correct(bead_image([], SIZE, np.uint16, noise=0.0)) / (
        65_535 / np.iinfo(dtype).max
    )
    with np.errstate(divide='ignore', invalid='ignore'):  # the rim has no light
        error = off(corrector(interpolation).correct(image), light, wanted)
    assert np.sqrt(np.mean(error**2)) < 0.01 and np.abs(error).max() < 0.03


@pytest.mark.parametrize('interpolation, limit', [('linear', 1 / 64), ('cubic', 1 / 45)])
def test_map_is_as_accurate_as_documented(interpolation, limit):
    """In an image of coordinates, the error is OpenCV's 1/32 px plus rounding."""
    this = corrector(interpolation)
    inner = this.mask & np.all((this.source > 1) & (this.source < 1022), axis=0)
    for axis, ramp in enumerate(np.mgrid[:1024, :1024][::-1] * 60):
        seen = this.correct(ramp.astype(np.uint16))[inner] / 60
        error = np.abs(seen - this.source[axis][inner])
        assert error.max() < limit + 0.5 / 60 + 1e-3
        assert np.sqrt(np.mean(error**2)) < 0.012


@pytest.mark.parametrize('interpolation, order', [('linear', 1), ('cubic', 3)])
@pytest.mark.parametrize('dtype', DEPTHS)
def test_against_scipy(dtype, interpolation, order):
    """map_coordinates at the same sources gives the same image within 1/64 px of its slope. Its
    cubic is a spline through the pixels, OpenCV's a convolution: they agree on a smooth image.
    """
    image = random_image(dtype)
    this = corrector(interpolation)
    source = np.nan_to_num(this.source.astype(float), nan=0.0)[::-1]
    wanted = map_coordinates(image.astype(float), source, order=order, mode='nearest')
    slope = np.hypot(*np.gradient(image.astype(float))).max()
    difference = np.abs(this.correct(image) - wanted)[this.mask]
    assert difference.max() < slope / 45 + 0.01 * np.ptp(image) * (order == 3) + 1
    assert difference.mean() < slope / 100 + 0.5


@pytest.mark.parametrize('interpolation, limit', [('linear', 0.02), ('cubic', 0.005)])
def test_distorted_and_corrected_image_is_the_original(interpolation, limit):
    """The image is distorted by the correction and corrected again; the difference is due to
    interpolation.
    """
    this = corrector(interpolation)
    image = random_image(np.uint16)
    v, u = np.mgrid[:1024, :1024].astype(float)
    straight = (
        calibration().correct(np.stack([u.ravel(), v.ravel()], axis=1)).uv.T.reshape(2, 1024, 1024)
    )
    bent = map_coordinates(image.astype(float), straight[::-1], order=3, mode='nearest')
    bent = np.clip(np.rint(bent), 0, 65_535).astype(np.uint16)
    inner = this.mask & np.all((this.source > 2) & (this.source < 1021), axis=0)
    inner[:3] = inner[-3:] = inner[:, :3] = inner[:, -3:] = False
    before, after = (
        np.sqrt(np.mean((np.float64(x) - image)[inner] ** 2)) for x in (bent, this.correct(bent))
    )
    assert after < limit * before


# ---- rims, folds and holes


@pytest.mark.parametrize('interpolation', ['linear', 'cubic'])
@pytest.mark.parametrize('dtype', DEPTHS)
def test_constant_image_stays_constant(dtype, interpolation):
    """It does up to the edge of the observed area, without mixing with the border; pixels beyond
    have the border value.
    """
    small = rigs.smooth_pincushion('a', (480, 360))
    this = ImageCorrector(small, interpolation, border=7)
    constant = np.full((360, 480), np.iinfo(dtype).max, dtype=dtype)
    got = this.correct(constant)
    assert (got[this.mask] == constant[0, 0]).all() and (got[~this.mask] == 7).all()
    assert 0 < np.mean(~this.mask) < 0.05
    assert ImageCorrector(small, interpolation).correct(constant)[~this.mask].max() == 0


@pytest.mark.parametrize('interpolation', ['linear', 'cubic'])
@pytest.mark.parametrize('dtype', DEPTHS)
@pytest.mark.parametrize('size', [(37, 20), (1, 1), (16, 33)])
def test_identity_without_distortion(size, dtype, interpolation):
    """Every bit up to the last pixel is the same, for images of any size."""
    uv = lattice((40, 40))
    calibration_of_none = with_model(model_of(uv, 0 * uv, 'none', 0), size)
    image = np.random.default_rng(0).integers(
        0, np.iinfo(dtype).max, size[::-1], dtype, endpoint=True
    )
    this = ImageCorrector(calibration_of_none, interpolation)
    assert this.mask.all() and np.array_equal(this.correct(image), image)


def test_shift_by_whole_pixels():
    """The image moves, and unobserved pixels stay empty."""
    size = (64, 48)
    uv = lattice((64, 48))
    this = ImageCorrector(with_model(model_of(uv, np.tile([5.0, -3.0], (len(uv), 1))), size))
    image = np.random.default_rng(0).integers(1, 255, size[::-1]).astype(np.uint8)
    got = this.correct(image)
    assert np.array_equal(got[3:, :-5], image[:-3, 5:])  # undistorted = observed - (5, -3)
    assert not got[:3].any() and not got[:, -5:].any()
    assert np.array_equal(this.mask, got > 0)


def test_source_in_the_outer_half_of_a_pixel():
    """It is on the image and has the value of that pixel."""
    size = (32, 32)
    uv = lattice((32, 32))
    this = ImageCorrector(with_model(model_of(uv, np.tile([0.4, 0.0], (len(uv), 1))), size))
    assert this.mask.all()
    assert (this.correct(np.full((32, 32), 200, np.uint8)) == 200).all()


def test_fold_is_left_empty():
    """A correction that grows faster than the image coordinate would show the image mirrored."""
    size = (96, 96)
    uv = lattice((96, 96), 4)
    duv = np.zeros_like(uv)
    middle = np.abs(uv[:, 0] - 48) < 10
    duv[:, 0] = np.clip((uv[:, 0] - 48) * 1.8, -18, 18)  # 1.8 px per px, 20 px wide
    this = ImageCorrector(with_model(model_of(uv, duv), size))
    assert middle.any() and this.mask.any() and not this.mask.all()
    step = np.diff(this.source[0], axis=1)
    assert np.nanmin(step) > 0
    corrected = with_model(model_of(uv, duv), size).correct(this.source[:, this.mask].T).uv
    assert np.abs(corrected - np.argwhere(this.mask)[:, ::-1]).max() < LIMIT_PX


@pytest.mark.long
def test_steps_of_nearest_neighbours_leave_few_holes():
    """The model knn is piecewise constant, but nearly all pixels have a source."""
    this = corrector(kind='knn')
    assert np.mean(this.mask[100:-100, 100:-100]) > 0.99


# ---- images, valid and invalid


def test_sixteen_bits_are_preserved():
    """Differences smaller than a grey level of eight bits are preserved."""
    image = np.full(SIZE[::-1], 40_000, np.uint16)
    image[:, ::2] += 1
    got = corrector().correct(image)
    assert got.dtype == np.uint16 and set(np.unique(got[corrector().mask])) <= {40_000, 40_001}


def test_cubic_does_not_wrap_around():
    """Cubic interpolation overshoots at an edge from black to white: values are clipped."""
    image = np.zeros(SIZE[::-1], np.uint8)
    image[:, 500:] = 255
    for dtype in DEPTHS:
        got = corrector('cubic').correct(image.astype(dtype) * (np.iinfo(dtype).max // 255))
        assert (got[300:700, 300:480] == 0).all() and (
            got[300:700, 520:700] == np.iinfo(dtype).max
        ).all()


def test_output_array_and_rows_with_gaps():
    """A given output array, strided rows and read-only input do not change the numbers."""
    this = corrector()
    image = random_image(np.uint16)
    wanted = this.correct(image)
    out = np.empty_like(image)
    assert this.correct(image, out) is out and np.array_equal(out, wanted)
    wide = np.zeros((1024, 1100), np.uint16)
    wide[:, :1024] = image
    assert np.array_equal(this.correct(wide[:, :1024]), wanted)
    image.flags.writeable = False
    assert np.array_equal(this.correct(image), wanted)
    for backward in (image[::-1], image.T):
        assert np.array_equal(this.correct(backward), this.correct(backward.copy()))


def test_invalid_images_are_refused():
    """Each is refused in one sentence."""
    this = corrector()
    image = np.zeros(SIZE[::-1], np.uint8)
    for wrong, sentence in (
        (image[:-1], 'the image is 1024 x 1023 px, but the calibration is for 1024 x 1024 px'),
        (np.zeros((1024, 1024, 3), np.uint8), 'not grey, it has 1024 x 1024 x 3 values'),
        (image.astype(np.float32), 'pixels of float32, not of 8 or 16 bits'),
        (image.astype('>u2'), 'pixels of >u2, not of'),
    ):
        with pytest.raises(DataError, match=sentence):
            this.correct(wrong)
    for out in (
        np.zeros((1024, 1023), np.uint8),
        np.zeros((1024, 1024), np.uint16),
        np.zeros((2048, 1024), np.uint8)[::2],
    ):
        with pytest.raises(DataError, match='array for the corrected image'):
            this.correct(image, out)
    with pytest.raises(DataError, match="one of linear, cubic, not 'nearest'"):
        ImageCorrector(calibration(), 'nearest')
    with pytest.raises(DataError, match='40000 x 10 px is too large'):
        ImageCorrector(replace(calibration(), image_size=(40_000, 10)))


def test_threads_share_a_corrector():
    """All threads get the same numbers."""
    image = random_image(np.uint8)
    results = {}

    def work(number):
        results[number] = [
            corrector(i).correct(image) for i in ('linear', 'cubic') for _ in range(3)
        ]

    threads = [threading.Thread(target=work, args=(n,)) for n in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    wanted = [corrector(i).correct(image) for i in ('linear', 'cubic') for _ in range(3)]
    assert len(results) == 4 and all(np.array_equal(of_one, wanted) for of_one in results.values())


# ---- the renderer


@pytest.mark.parametrize('dtype', DEPTHS)
def test_virtual_image(dtype):
    """Beads lie at the given positions, the background is smooth, and the noise is reproducible
    and of the given size.
    """
    uv = np.array([[100.3, 80.7], [200.0, 40.25], [-3.0, 50.0], [1000.0, 1000.0], [np.nan, 3.0]])
    size = (256, 200)
    clean = bead_image(uv, size, dtype, noise=0.0)
    light = background(size) * np.iinfo(dtype).max
    assert clean.shape == size[::-1] and clean.dtype == dtype
    assert np.abs(off(clean, light, uv[:2])).max() < 0.01
    far = np.ones(clean.shape, bool)
    far[30:120, :] = False
    far[:80, 170:230] = False
    assert np.abs(clean[far] - light[far]).max() <= 0.51
    assert clean[50, 0] < 0.8 * light[50, 0]  # from a bead outside the image
    noisy = bead_image(uv, size, dtype, noise=0.02, seed=3)
    assert np.array_equal(noisy, bead_image(uv, size, dtype, noise=0.02, seed=3))
    sd = np.std((noisy.astype(float) - clean)[far]) / np.iinfo(dtype).max
    assert abs(sd / 0.02 - 1) < 0.05
