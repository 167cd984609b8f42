# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Adding a model takes one file and one registry entry, as the example of docs/models.md shows."""

import importlib.util
import re
from pathlib import Path

import numpy as np
import pytest
import rigs

from fluoro_calib_ros.correction import registry
from fluoro_calib_ros.correction.grid_cells import LIMIT_PX
from fluoro_calib_ros.estimation.calibrate import calibrate
from fluoro_calib_ros.estimation.options import CalibrationOptions
from fluoro_calib_ros.io.calibration import load_calibration, save_calibration
from fluoro_calib_ros.options import declared

DOCUMENT = Path(__file__).resolve().parents[2] / 'docs' / 'models.md'
NAME = 'inverse_distance'


@pytest.fixture
def added(tmp_path, monkeypatch):
    """The example model of docs/models.md, written to a file and registered."""
    blocks = re.findall(r'```python\n(.*?)```', DOCUMENT.read_text(), re.S)
    (code,) = (block for block in blocks if f"kind = '{NAME}'" in block)
    path = tmp_path / f'{NAME}.py'
    path.write_text(code)
    spec = importlib.util.spec_from_file_location(NAME, path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    monkeypatch.setitem(registry.MODELS, NAME, module.InverseDistanceModel)
    return module.InverseDistanceModel


@pytest.mark.usefixtures('added')
@pytest.mark.long
def test_added_model_calibrates_saves_loads_and_looks_up(tmp_path):
    frames = {'a': rigs.exposures()['a'][:8]}
    result = calibrate(frames, rigs.rig().phantom, CalibrationOptions(NAME, max_iterations=4))
    calibration = result.calibrations['a']
    model = calibration.model
    without = rigs.calibrated('a', 8, model='none').calibrations['a']
    assert model.kind == result.fluoroscopes['a'].model_kind == NAME and model.k >= 2
    assert calibration.rmse_after.max() < 0.4 * without.rmse_after.max()
    assert model.noise_px > 0

    loaded = load_calibration(save_calibration(str(tmp_path), calibration))
    assert loaded.calibration_id == calibration.calibration_id
    uv = np.random.default_rng(0).uniform(200, 800, (300, 2))
    exact = loaded.model.evaluate(uv)
    np.testing.assert_array_equal(exact.duv, model.predict(uv))
    assert (exact.sd > 0).all()
    values, status = loaded.grid.look_up(*uv.T)
    assert not status.any() and loaded.grid.cell_px <= 4
    bound = 2 * max(LIMIT_PX, loaded.grid.error_px)
    assert np.abs(values[:2].T - exact.duv).max() < bound


@pytest.mark.usefixtures('added')
def test_number_of_neighbours_of_an_added_model_can_be_given():
    frames = {'a': rigs.exposures()['a'][:4]}
    options = CalibrationOptions(NAME, k=5, max_iterations=1)
    assert calibrate(frames, rigs.rig().phantom, options).calibrations['a'].model.k == 5


@pytest.mark.usefixtures('added')
def test_added_model_is_in_the_help_of_the_command(capsys):
    assert rigs.run('calibrate', '--help') == 0
    assert NAME in capsys.readouterr().out


@pytest.mark.usefixtures('added')
def test_options_declare_an_added_model():
    """Node parameters, configuration and documentation are generated from the declaration."""
    assert NAME in declared(CalibrationOptions)['model'].choices


def test_model_that_is_not_registered_is_refused():
    with pytest.raises(ValueError, match=f"model must be one of auto, .*, not '{NAME}'"):
        CalibrationOptions(NAME)
