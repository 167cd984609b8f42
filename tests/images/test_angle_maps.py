# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Maps of corrected images at the angles of a C-arm."""

import functools
from dataclasses import replace

import numpy as np
import pytest
import rigs
import turning_rig
from rigs import create_model

from benchmarks.bead_images import bead_image
from fluoro_calib_ros.correction.angle_field import AngleField, harmonics
from fluoro_calib_ros.correction.base import CorrectionStatus
from fluoro_calib_ros.errors import DataError
from fluoro_calib_ros.images.angle_maps import AngleMaps, _rate
from fluoro_calib_ros.images.corrector import LIMIT_PX, ImageCorrector

OK, OUTSIDE, INVALID = CorrectionStatus
SIZE = (512, 512)
ANGLES = (-0.9, -0.2, 0.3, 1.0)
WORST_PX = 0.1  # largest error [px], which occurs outside the calibrated area


@functools.cache
def calibration():
    """Return a calibration of small images with changes by the angle of up to about 5 px."""
    return rigs.turning(rigs.smooth_pincushion('a', SIZE), size_px=0.4)


@functools.cache
def maps():
    return AngleMaps(calibration())


def errors(corrector, angle):
    """Return distances (n,) of pixels from their corrected sources, and their status (n,)."""
    v, u = np.nonzero(corrector.mask)
    x, y, *_ = calibration().correct_arrays(*corrector.source[:, v, u].astype(float), None, angle)
    return np.hypot(x - u, y - v), corrector.status[v, u]


@pytest.mark.long
@pytest.mark.parametrize('angle', ANGLES)
def test_sources_of_pixels_are_corrected_to_them_at_the_angle(angle):
    corrector = maps().at(angle)
    error, status = errors(corrector, maps().rounded(angle))
    assert error[status == OK].max() < LIMIT_PX
    assert error.max() < WORST_PX and np.quantile(error, 0.999) < LIMIT_PX
    # Rounding the angle moves a pixel by less than the same limit once more.
    exact, _ = errors(corrector, angle)
    assert exact[status == OK].max() < 2 * LIMIT_PX
    mean, _ = errors(corrector, None)
    assert mean.max() > 1


@pytest.mark.long
@pytest.mark.parametrize('interpolation', ['linear', 'cubic'])
def test_image_is_that_of_the_calibration_at_the_angle(interpolation):
    """The direct way has a lookup grid of its own and iterates at every pixel."""
    of_rig = rigs.turning(rigs.calibrated('a').calibrations['a'], size_px=0.4)
    found = AngleMaps(of_rig, interpolation)
    angle = found.rounded(0.7)
    direct = ImageCorrector(of_rig.at_angle(angle), interpolation)
    uv = np.random.default_rng(1).uniform(60, 960, (80, 2))
    image = bead_image(uv, of_rig.image_size, np.uint16)
    difference = found.at(angle).correct(image).astype(int) - direct.correct(image)
    both = found.at(angle).mask & direct.mask
    assert (found.at(angle).mask != direct.mask).sum() < 200
    scale = np.ptp(image.astype(int))
    assert np.abs(difference[both]).max() < 0.02 * scale
    away = found.mean.correct(image).astype(int) - direct.correct(image)
    assert np.abs(away[both]).max() > 0.2 * scale


def test_map_is_made_anew_only_where_a_pixel_moves():
    found = AngleMaps(calibration())
    step = found.step
    angle = found.rounded(0.3)
    first = found.at(angle)
    for part in (-0.45, 0.45, 0.0):
        assert found.at(angle + part * step) is first
    assert found.built == 1
    next_one = found.at(angle + step)
    assert next_one is not first and found.built == 2
    moved = np.abs(next_one.source - first.source)
    assert 0 < np.nanquantile(moved, 0.99) < 3 * LIMIT_PX
    # The same angle gives the same map, whatever angle came before.
    again = found.at(angle)
    assert np.array_equal(again.source, first.source, equal_nan=True)


def test_unknown_angle_gives_the_mean():
    mean = ImageCorrector(calibration())
    found = maps().at(None)
    assert np.array_equal(found.source, mean.source, equal_nan=True)
    assert np.array_equal(found.status, mean.status)
    built = maps().built
    assert maps().at(None) is found and maps().built == built


@pytest.mark.long
def test_angle_changes_nothing_where_the_correction_does_not_depend_on_it():
    still = rigs.pincushion('a', SIZE)
    found = AngleMaps(still)
    assert found.at(0.3) is found.at(None) is found.mean
    assert found.built == 0 and found.rounded(0.3) is None
    zero = rigs.turning(still, size_px=0.0)
    assert AngleMaps(zero).at(0.3).source[0, 250, 250] == found.mean.source[0, 250, 250]


def test_image_far_from_all_calibrated_angles_is_outside():
    corrector = maps().at(np.deg2rad(80.0))
    assert set(np.unique(corrector.status)) <= {OUTSIDE, INVALID}
    assert corrector.mask.mean() > 0.9


def test_maps_are_for_the_angles_that_are_covered():
    """Between -10 and 10 degrees a field changes by some pixels, far beyond by hundreds."""
    angles = np.deg2rad(np.linspace(-10, 10, 15))
    shape = harmonics(angles) - harmonics(angles).mean(axis=0)
    coefficients = np.random.default_rng(0).normal(size=(4, 2, 10))
    coefficients *= 0.3 / np.sqrt(np.mean(shape**2, axis=0))[:, None, None]
    field = AngleField(SIZE, angles, coefficients, np.zeros((14, 33, 33)))
    corners = np.array([[0.0, 0], [511, 0], [0, 511], [511, 511]])
    reached = max(np.abs(field.change(corners, angle)[0]).max() for angle in angles)
    _, largest = _rate(field)
    assert reached < largest < 15 * reached


def test_unknown_interpolation_is_refused():
    with pytest.raises(DataError, match='the interpolation must be one of'):
        AngleMaps(calibration(), 'none')


@pytest.mark.long
def test_images_follow_a_field_that_was_estimated_from_exposures():
    """The angles were not calibrated; the reference is the true change of the distortion."""
    estimated = turning_rig.turning().calibrations['a']
    found = AngleMaps(estimated)
    calibrated, others = turning_rig.recording()

    size = estimated.image_size

    def true_change(uv, angle):
        mean = [turning_rig.turned(uv, f.angle, size) for f in calibrated]
        return turning_rig.turned(uv, angle, size) - np.mean(mean, axis=0)

    for angle in [frame.angle for frame in others[:2]]:
        corrector = found.at(angle)
        v, u = np.nonzero((corrector.status == OK) & found.mean.mask)
        by_mean = found.mean.source[:, v, u].T.astype(float)
        change = true_change(by_mean, angle)
        error = corrector.source[:, v, u].T - by_mean - change
        # Ignore shift, scale and shear, which the interior orientation may absorb as well.
        affine = np.column_stack([np.ones(len(u)), by_mean])

        def rms(values, affine=affine):
            return np.std(values - affine @ np.linalg.lstsq(affine, values, rcond=None)[0])

        assert rms(error) < 0.3 * rms(change) and rms(error) < 0.05


@pytest.mark.long
@pytest.mark.parametrize(
    'size, worst', [((1000, 703), LIMIT_PX), ((333, 1024), LIMIT_PX), ((70, 45), 0.3)]
)
def test_map_of_an_image_of_any_size(size, worst):
    """One of the images is so small that its change is steep."""
    found = rigs.turning(rigs.pincushion('a', size), size_px=0.4)
    maps = AngleMaps(found)
    corrector = maps.at(0.6)
    assert corrector.shape == size[::-1] and corrector.mask.mean() > 0.7
    v, u = np.nonzero(corrector.mask)
    observed = corrector.source[:, v, u].astype(float)
    x, y, *_ = found.correct_arrays(*observed, None, maps.rounded(0.6))
    assert np.hypot(x - u, y - v).max() < worst
    assert np.array_equal(corrector.mask, corrector.status != INVALID)


@pytest.mark.long
@pytest.mark.parametrize('size, size_px', [((5, 9), 0.4), ((20, 15), 50.0)])
def test_change_as_large_as_the_image_leaves_it_empty(size, size_px):
    corrector = AngleMaps(rigs.turning(rigs.pincushion('a', size), size_px=size_px)).at(0.6)
    assert corrector.correct(np.full(size[::-1], 9, np.uint8)).shape == size[::-1]
    assert corrector.mask.mean() < 0.5


def steep(size, steepness):
    """Return a calibration whose correction grows by `steepness` px per px in the middle."""
    u, v = (np.linspace(0, side - 1, 25) for side in size)
    uv = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)
    duv = np.zeros_like(uv)
    duv[:, 0] = np.clip(steepness * (uv[:, 0] - 48), -18, 18)
    model = create_model('local_linear', 6, uv, duv, 0.2, 0.0)
    exposure = np.zeros(len(uv), dtype=np.int64)
    return replace(rigs.pincushion('a', size), model=model, train_exposure=exposure)


@pytest.mark.parametrize('steepness', [0.9, 1.8])
def test_folds_are_left_empty_at_an_angle(steepness):
    """Either the mean correction folds, or only its change with the angle makes it fold."""
    corrector = AngleMaps(rigs.turning(steep((96, 96), steepness), size_px=2.0)).at(0.6)
    assert corrector.mask.any() and not corrector.mask.all()
    assert np.nanmin(np.diff(corrector.source[0], axis=1)) > 0


@pytest.mark.parametrize('height', [40, 300])
def test_what_the_mean_leaves_empty_stays_empty_where_hardly_anything_changes(height):
    found = AngleMaps(rigs.turning(steep((96, height), 0.9), size_px=0.01))
    folded = ~found.mean.mask[:, 30:66]  # in the middle, between columns that have a source
    assert 0 < folded.mean() < 0.2
    assert not found.at(0.6).mask[:, 30:66][folded].any()
