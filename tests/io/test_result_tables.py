# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Statistics of an adjustment in result.json, and the tables of a result folder."""

import csv
import json

import numpy as np
import pytest

from fluoro_calib_ros.estimation.calibrate import adjust_with_calibrations, calibrate
from fluoro_calib_ros.estimation.options import CalibrationOptions
from fluoro_calib_ros.io.result_document import NAMES
from fluoro_calib_ros.jobs.result_folder import save_result
from fluoro_calib_ros.simulation.rig import Detection, simulate_exposures, virtual_rig


@pytest.fixture(scope='module')
def calibrated():
    rig = virtual_rig(5, strength=0.0)
    frames = simulate_exposures(rig, 5, 5, Detection(beads=(100, 110))).frames
    frames = {'a': frames['a']}
    return calibrate(frames, rig.phantom, CalibrationOptions('none')), frames, rig.phantom


def rows_of(path):
    """Return the rows of a CSV file as dicts."""
    with path.open() as file:
        return list(csv.DictReader(file))


def test_statistics_of_an_adjustment(calibrated):
    """Without priors, redundancy numbers sum to observations - unknowns; the noise is 0.25 px."""
    statistics = calibrated[0].statistics[0]
    freedom = statistics.observations - statistics.unknowns
    assert statistics.degrees_of_freedom == pytest.approx(freedom, abs=1e-3)
    assert statistics.variance_factor == pytest.approx(1, abs=0.12)
    assert statistics.sigma0 == pytest.approx(0.25, rel=0.1)
    assert 0 <= statistics.least_redundancy < statistics.mean_redundancy < 1
    run = calibrated[0].runs['a']
    assert statistics.outliers == (~run.after.inliers).sum()
    network = run.measured.network
    of_survey = (run.after.parameters.points_mm - network.survey_mm) / network.survey_sd_mm[
        :, None
    ]
    of_image = run.after.noise.weight(run.after.q) @ run.after.q
    square = statistics.variance_factor * statistics.degrees_of_freedom
    assert square == pytest.approx(of_image + np.sum(of_survey**2))
    assert np.sum(of_survey**2) > 1e-3 * of_image


def test_tables_contain_what_the_result_says(calibrated, tmp_path):
    job, frames, _ = calibrated
    save_result(tmp_path / 'made', job)
    document = json.loads((tmp_path / 'made' / 'result.json').read_text())
    assert document['format_version'] == 3 and document['created'].endswith('+00:00')
    assert document['units']['image'] == 'px'
    of_adjustment = document['adjustments'][0]
    assert (
        of_adjustment['network']['image_points'] == document['fluoroscopes']['a']['observations']
    )
    residuals = rows_of(tmp_path / 'made' / 'residuals.csv')
    assert len(residuals) == of_adjustment['network']['image_points']
    redundancy = sum(float(r['redundancy_u']) + float(r['redundancy_v']) for r in residuals)
    assert 0 < redundancy < of_adjustment['degrees_of_freedom']
    core = [r for r in residuals if r['outlier'] == '0']
    rmse = np.sqrt(np.mean([float(r['residual_u_px']) ** 2 for r in core]))
    assert rmse == pytest.approx(document['fluoroscopes']['a']['rmse_px']['after'][0])
    exposures = rows_of(tmp_path / 'made' / 'exposures.csv')
    assert [int(r['exposure']) for r in exposures] == [f.number for f in frames['a']]
    assert float(exposures[2]['x_mm']) == job.fluoroscopes['a'].exposures[2].position_mm[0]
    assert sum(int(r['image_points']) for r in exposures) == len(residuals)
    targets = rows_of(tmp_path / 'made' / 'targets.csv')
    assert sum(int(r['image_points']) for r in targets) == len(residuals)
    assert (
        float(rows_of(tmp_path / 'made' / 'interior.csv')[0]['c_px'])
        == (job.fluoroscopes['a'].interior[2])
    )


def test_an_adjustment_with_held_calibrations_has_the_same_tables(calibrated, tmp_path):
    job, frames, phantom = calibrated
    held = adjust_with_calibrations(frames, phantom, job.calibrations)
    save_result(tmp_path / 'held', held)
    assert all((tmp_path / 'held' / name).exists() for name in NAMES)
    assert held.statistics[0].variance_factor == pytest.approx(1, abs=0.12)
    assert len(rows_of(tmp_path / 'held' / 'residuals.csv')) == sum(
        len(f.target_id) for f in frames['a']
    )
