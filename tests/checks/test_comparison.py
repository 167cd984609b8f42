# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Changes between two calibrations of a fluoroscope."""

import functools
import json
from dataclasses import replace

import numpy as np
import pytest
from rigs import calibrated, create_model, run

from fluoro_calib_ros.checks.comparison import compare_calibrations
from fluoro_calib_ros.errors import DataError
from fluoro_calib_ros.jobs.result_folder import save_result
from fluoro_calib_ros.photogrammetry.rotations import matrix_from_quaternion, matrix_from_vector

NOISE_PX = 0.2
PLACE = np.array([300.0, 700.0])


@functools.cache
def base():
    return calibrated('a', 6, max_iterations=2)


def calibration(seed, bump=0.0, gauge=0.0):
    """A calibration from 1500 noisy training points of its own.

    bump [px]: a local change of the image; gauge: a scale that belongs to the principal distance.
    """
    return _calibration(seed, bump, gauge)  # a cache keeps defaults apart from equal values


@functools.cache
def _calibration(seed, bump, gauge):
    rng = np.random.default_rng(seed)
    uv = rng.uniform(0, 1023, (1500, 2))
    centred = (uv - 511.5) / 512
    duv = 6 * centred * np.sum(centred**2, axis=1)[:, None] + gauge * centred
    duv[:, 0] += bump * np.exp(-np.sum((uv - PLACE) ** 2, axis=1) / (2 * 100**2))
    duv += rng.normal(0, NOISE_PX, duv.shape)
    model = create_model('local_linear', 40, uv, duv, NOISE_PX)
    one = base().calibrations['a']
    return replace(one, model=model, train_exposure=np.zeros(len(uv), dtype=np.int64))


def test_calibration_does_not_differ_from_itself():
    found = compare_calibrations(calibration(1), calibration(1))
    assert found.rms_px < 1e-9 and found.interior_test == 0
    assert not found.field_changed and not found.interior_changed


@pytest.mark.parametrize('seed', [2, 3, 4])
def test_noise_is_no_change(seed):
    """Different training points of the same distortion, also with another principal distance."""
    for gauge in (0.0, 5.0):
        found = compare_calibrations(calibration(1), calibration(seed, gauge=gauge))
        assert not found.field_changed, found.significant.mean()
        assert found.rms_px < 0.2


def test_change_of_the_image_is_found_where_it_is():
    found = compare_calibrations(calibration(1), calibration(2, bump=1.5))
    assert found.field_changed
    size, place = found.largest
    assert np.hypot(*(np.array(place) - PLACE)) < 100
    assert 0.9 < size < 2
    near = np.hypot(*(found.uv - PLACE).T) < 100
    assert found.significant[near].mean() > 0.9


def test_change_of_the_interior_orientation_is_told():
    one = calibration(1)
    sd = np.sqrt(np.diag(one.interior_covariance))
    found = compare_calibrations(one, replace(one, interior=one.interior + [0, 0, 8 * sd[2]]))
    assert found.interior_changed and not found.field_changed
    np.testing.assert_allclose(found.interior_sd, np.sqrt(2) * sd)


@functools.cache
def turned(seed, rad=0.01, gauge=0.0):
    """The same rays from a rotated sensor, with its principal point elsewhere."""
    one = calibration(seed, gauge=gauge)
    interior = one.interior + [rad * one.interior[2], 0, 0]
    uv = one.model.train_uv
    rays = np.column_stack(
        [(uv - one.model.train_duv - one.interior[:2]) / one.interior[2], np.ones(len(uv))]
    )
    rays = rays @ matrix_from_vector(np.array([0.0, -rad, 0.0])).T
    ideal = interior[:2] + interior[2] * rays[:, :2] / rays[:, 2:]
    model = replace(one.model, train_duv=uv - ideal)
    return replace(one, interior=interior, model=model)


def test_interior_orientations_in_other_gauges_are_the_same():
    """The principal point moves by 40 px when the sensor rotates by 10 mrad."""
    for other in (turned(1), turned(2)):
        found = compare_calibrations(calibration(1), other)
        assert abs(other.interior[0] - calibration(1).interior[0]) > 30
        assert not found.interior_changed and not found.field_changed
        assert np.abs(found.interior[:2]).max() < 4 * found.interior_sd[:2].max()


def test_interior_orientations_in_gauges_about_far_principal_points_are_the_same():
    """Two recordings of a strong distortion may yield sensors rotated by 8 degrees."""
    one, other = turned(1, -0.14, gauge=30.0), turned(2, 0.14, gauge=30.0)
    assert abs(other.interior[0] - one.interior[0]) > 800
    found = compare_calibrations(one, other)
    assert not found.interior_changed and not found.field_changed


def test_other_image_sizes_are_not_compared():
    other = replace(calibration(1), image_size=(512, 512))
    with pytest.raises(DataError, match='the images are 1024 x 1024 px and 512 x 512 px'):
        compare_calibrations(calibration(1), other)


def test_compare_tells_what_changed(tmp_path, capsys):
    """Changes are in px and mm, with a picture; folders without calibrations are refused."""
    for name, one in (('one', calibration(1)), ('other', calibration(2, bump=1.5))):
        save_result(tmp_path / name, replace(base(), calibrations={'a': one}))
    figure = tmp_path / 'changes.png'
    arguments = ('compare', tmp_path / 'one', tmp_path / 'other')
    assert run(*arguments, '--figure', figure, '--json') == 0
    (entry,) = json.loads(capsys.readouterr().out)['fluoroscopes'].values()
    assert entry['field_changed'] is True
    centre = base().targets.xyz_mm.mean(axis=0)
    exposures = base().fluoroscopes['a'].exposures
    turns = [matrix_from_quaternion(e.quaternion_wxyz) for e in exposures]
    depths = [(t @ (centre - e.position_mm))[2] for t, e in zip(turns, exposures)]
    distance = np.median(depths)
    scale = distance / calibration(1).interior[2]
    assert entry['rms_mm'] == pytest.approx(entry['rms_px'] * scale)
    assert figure.read_bytes().startswith(b'\x89PNG')
    assert run(*arguments) == 0
    assert 'of the image: significant' in capsys.readouterr().out
    (tmp_path / 'empty').mkdir()
    assert run('compare', tmp_path / 'one', tmp_path / 'empty') == 1
    assert 'there is no calibration in this folder' in capsys.readouterr().err
