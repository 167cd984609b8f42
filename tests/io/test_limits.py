# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Limits of reading: what exceeds them is refused in one sentence before anything is decoded."""

from operator import methodcaller

import cv2
import numpy as np
import pytest
import rigs
from rigs import create_model

from fluoro_calib_ros.correction.fluoroscope_calibration import FluoroscopeCalibration
from fluoro_calib_ros.errors import DataError
from fluoro_calib_ros.exposures.phantom import Phantom
from fluoro_calib_ros.images.codec import decode
from fluoro_calib_ros.io import access
from fluoro_calib_ros.io.calibration import (
    load_calibration,
    load_orientation,
    save_calibration,
    save_orientation,
)
from fluoro_calib_ros.io.phantom import read_phantom, write_phantom
from fluoro_calib_ros.jobs.scheduling import LocalWorkers
from fluoro_calib_ros.limits import ReadLimits, read_limits, use_read_limits
from fuzz.seeds import orientation


@pytest.fixture
def limited():
    """Yield a function that sets limits; the default limits return after the test."""
    yield lambda **changes: use_read_limits(ReadLimits(**changes))
    use_read_limits(ReadLimits())


def refused(function, *arguments):
    with pytest.raises(DataError) as caught:
        function(*arguments)
    assert '\n' not in str(caught.value)
    return str(caught.value)


def some_calibration(count=30):
    """Return a calibration with `count` training points."""
    uv = np.random.default_rng(1).uniform(0, 64, (count, 2))
    return FluoroscopeCalibration(
        fluoroscope='a',
        image_size=(64, 64),
        interior=np.array([32.0, 32.0, 100.0]),
        interior_covariance=np.eye(3),
        interior_estimated=True,
        model=create_model('knn', 5, uv, np.zeros((count, 2)), 0.1, 0.0),
        train_exposure=np.zeros(count, dtype=np.int64),
        image_sd=0.2,
        sigma0=0.2,
        nu=4.0,
        exposures=5,
        observations=count,
        inliers=count,
        rmse_before=np.ones(2),
        rmse_after=np.ones(2),
        cost_adjustment=1.0,
        cost_regression=1.0,
        iterations=1,
        converged=True,
        stamp_ns=0,
        frame_id='a_optical',
        source_digest='',
    )


def test_size_of_files(limited, tmp_path):
    path = tmp_path / 'large.csv'
    path.write_bytes(bytes(1_100_000))
    access.read_bytes(path)
    limited(max_file_mb=1)
    said = f'{path}: the file has 1 MB; the limit is 1 MB'
    assert refused(access.read_bytes, path) == said


def test_size_of_images(limited, monkeypatch):
    content = cv2.imencode('.png', np.zeros((1100, 1000), np.uint8))[1].tobytes()
    assert decode(content).shape == (1100, 1000)
    limited(max_image_megapixels=1)
    monkeypatch.setattr(cv2, 'imdecode', None)
    assert 'images of more than 1 megapixels are not read' in refused(decode, content)


def test_training_points_of_calibrations(limited, tmp_path):
    path = save_calibration(tmp_path, some_calibration())
    limited(max_training_points=30)
    load_calibration(path)
    limited(max_training_points=29)
    assert '30 training points; the limit is 29' in refused(load_calibration, path)


def test_targets_of_phantoms(limited, tmp_path):
    path = tmp_path / 'phantom.csv'
    write_phantom(path, Phantom(np.arange(9), np.arange(27.0).reshape(9, 3), np.ones(9)))
    limited(max_targets=9)
    read_phantom(path)
    limited(max_targets=8)
    assert 'phantoms of more than 8 targets are not read' in refused(read_phantom, path)


def test_fluoroscopes_of_orientations(limited, tmp_path):
    path = save_orientation(tmp_path, orientation())
    limited(max_fluoroscopes=2)
    load_orientation(path)
    limited(max_fluoroscopes=1)
    assert 'has 2 fluoroscopes; the limit is 1' in refused(load_orientation, path)


def test_length_of_names(limited):
    access.check_safe_name('abc', 'x')
    limited(max_name_length=2)
    assert 'at most 2 of them' in refused(access.check_safe_name, 'abc', 'x')


def test_command_line_sets_limits(tmp_path, capsys):
    path = tmp_path / 'points.csv'
    path.write_text('u,v\n' + '1,2\n' * 300_000)
    save_calibration(tmp_path, some_calibration())
    arguments = ('correct', path, '--calibration', tmp_path, '--out', tmp_path / 'out.csv')
    assert rigs.run(*arguments, '--max-file-mb', '1') == 1
    assert 'points.csv: the file has 1 MB; the limit is 1 MB' in capsys.readouterr().err
    assert not (tmp_path / 'out.csv').exists()
    path.write_text('u,v\n1,2\n')
    assert rigs.run(*arguments) == 0
    assert read_limits() == ReadLimits()


def test_workers_have_the_limits_of_their_parent(limited):
    limited(max_file_mb=7)
    with LocalWorkers(2) as workers:
        limits = workers.map(methodcaller('__call__'), [read_limits])
        assert next(limits) == ReadLimits(max_file_mb=7)
