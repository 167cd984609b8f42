# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Figures and tables of a calibration: their files and the numbers in them."""

import dataclasses
import os
from pathlib import Path

import matplotlib
import numpy as np
import pytest
import rigs
from PIL import Image

from fluoro_calib_ros.errors import DataError
from fluoro_calib_ros.estimation.calibrate import adjust_with_calibrations, calibrate
from fluoro_calib_ros.estimation.options import CalibrationOptions
from fluoro_calib_ros.findings import Finding, Kind, Place, Severity
from fluoro_calib_ros.report import report_figures
from fluoro_calib_ros.report.figures import STYLE
from fluoro_calib_ros.report.report_figures import relative_costs, write_figures
from fluoro_calib_ros.report.residuals import normalised_residuals
from fluoro_calib_ros.report.rig_geometry import uncalibrated_share
from fluoro_calib_ros.report.tables import markdown_table, summary_table
from fluoro_calib_ros.simulation.rig import simulate_exposures, virtual_rig

OF_FLUOROSCOPE = ('residuals_histogram', 'residuals_position', 'distortion')
QUICK = {'model': 'local_linear', 'k': 30, 'max_iterations': 3}


@pytest.fixture(scope='module')
def scene():
    """A phantom, and six exposures of it for each fluoroscope."""
    rig = virtual_rig(1)
    frames = simulate_exposures(rig, 6, 1).frames
    fewer = {
        name: [dataclasses.replace(f, target_id=f.target_id[::2], uv=f.uv[::2]) for f in of_one]
        for name, of_one in frames.items()
    }
    return rig.phantom, fewer


@pytest.fixture(scope='module')
def job(scene):
    """Two fluoroscopes, calibrated one after the other."""
    phantom, frames = scene
    return calibrate(frames, phantom, CalibrationOptions(**QUICK))


@pytest.fixture(scope='module')
def plain(scene):
    """One fluoroscope without a correction model."""
    phantom, frames = scene
    return calibrate({'a': frames['a']}, phantom, CalibrationOptions(model='none'))


@pytest.fixture
def without_pixels(monkeypatch):
    """Do not render the figures, which takes most of the time."""
    monkeypatch.setattr(report_figures, 'png_bytes', lambda figure: b'pixels')


@pytest.mark.long
def test_figures_are_complete(job, tmp_path):
    """Every figure exists, can be read and is not empty, and no other file is left."""
    paths = write_figures(job, tmp_path / 'new' / 'folder')
    names = [f'cost_{n}.png' for n in 'ab'] + [
        f'{kind}_{n}.png' for kind in OF_FLUOROSCOPE for n in 'ab'
    ]
    assert sorted(os.path.basename(p) for p in paths) == sorted(names)
    assert sorted(os.listdir(tmp_path / 'new' / 'folder')) == sorted(names)
    for path in paths:
        with Image.open(path) as picture:
            assert picture.format == 'PNG' and all(600 <= side <= 2400 for side in picture.size)
            assert picture.info['dpi'][0] == pytest.approx(120, abs=0.1)
            assert np.asarray(picture.convert('L')).std() > 10


@pytest.mark.long
def test_figures_are_reproducible(plain, tmp_path, monkeypatch):
    """The same result gives the same bytes for any settings of matplotlib, which do not change."""
    first = {path: Path(path).read_bytes() for path in write_figures(plain, tmp_path)}
    monkeypatch.setitem(matplotlib.rcParams, 'axes.facecolor', 'black')
    settings = {key: matplotlib.rcParams[key] for key in ('axes.facecolor', *STYLE)}
    assert write_figures(plain, tmp_path) == list(first)
    assert all(Path(path).read_bytes() == content for path, content in first.items())
    assert {key: matplotlib.rcParams[key] for key in settings} == settings


@pytest.mark.long
def test_figures_of_joint_run_with_interior_held(scene, tmp_path, without_pixels):
    """A joint run has one cost figure; a name cannot lead out of the folder."""
    phantom, frames = scene
    joint = calibrate(
        frames,
        phantom,
        CalibrationOptions(model='knn', interior='fixed', k=5, max_iterations=2),
        joint=True,
    )
    names = {os.path.basename(path) for path in write_figures(joint, tmp_path)}
    assert names == {'cost_a+b.png'} | {f'{kind}_{n}.png' for kind in OF_FLUOROSCOPE for n in 'ab'}
    run = joint.runs['a+b']
    run = dataclasses.replace(
        run, measured=dataclasses.replace(run.measured, fluoroscopes=('../a', 'b'))
    )
    with pytest.raises(DataError, match='name'):
        write_figures(dataclasses.replace(joint, runs={'../a+b': run}), tmp_path / 'other')
    assert os.listdir(tmp_path / 'other') == []


def test_figures_without_model_or_runs(scene, plain, tmp_path, without_pixels):
    """Without a model there is no cost or distortion; without runs there are no figures."""
    phantom, frames = scene
    names = {os.path.basename(path) for path in write_figures(plain, tmp_path)}
    assert names == {'residuals_histogram_a.png', 'residuals_position_a.png'}
    adjusted = adjust_with_calibrations({'a': frames['a']}, phantom, plain.calibrations)
    assert write_figures(adjusted, tmp_path) == []
    rows = [line.split() for line in summary_table(adjusted).splitlines()]
    assert ['iterations', '-'] in rows and ['converged', 'yes'] in rows
    rows = [line.split() for line in summary_table(plain).splitlines()]
    assert ['neighbours', 'k', '-'] in rows and [
        'median',
        'sd',
        'of',
        'the',
        'correction',
        '[px]',
        '-',
    ] in rows


def test_folder_that_cannot_be_written(plain, tmp_path, without_pixels):
    """A file in place of the folder, a folder in place of a figure; no temporary file is left."""
    (tmp_path / 'file').write_text('mine')
    with pytest.raises(DataError, match='file'):
        write_figures(plain, tmp_path / 'file')
    assert (tmp_path / 'file').read_text() == 'mine'
    (tmp_path / 'out' / 'residuals_position_a.png').mkdir(parents=True)
    with pytest.raises(DataError, match=r'residuals_position_a\.png'):
        write_figures(plain, tmp_path / 'out')
    assert not [name for name in os.listdir(tmp_path / 'out') if name.endswith('.tmp')]


def test_costs_and_normalised_residuals(job):
    """Costs are in percent of those without correction; residuals are in units of the noise."""
    run = job.runs['a']
    f, g, recorded = relative_costs(run)
    assert len(f) == len(run.history) + 1 and len(g) == len(recorded) == len(run.history)
    assert (f[0], g[0], recorded[0]) == pytest.approx((100, 100, 100))
    assert f[-1] < 50 and g[-1] < 50
    np.testing.assert_allclose(recorded / 100, [r.G / run.history[0].G for r in run.history])
    rows = np.arange(len(run.correction))
    redundancy = np.full(len(rows), 0.7)
    before, after = normalised_residuals(run, rows, redundancy)
    assert len(before) == run.before.inliers.sum() and len(after) == run.after.inliers.sum()
    assert np.mean(after**2) == pytest.approx(1) and before.std() > 2


def test_summary_holds_the_numbers(job):
    """Figures of each fluoroscope are in its column, in pixels, and the text fits a terminal."""
    text = summary_table(job, {'p50': 0.1234, 'p99': 0.5, 'max': 2.25, 'frames': 480})
    line = {row[:36].strip(): row[36:].split() for row in text.splitlines()}
    a = job.fluoroscopes['a']
    b = job.fluoroscopes['b']
    assert line['Fluoroscope'] == ['a', 'b']
    for axis, coordinate in enumerate('uv'):
        assert line[f'RMSE {coordinate} before [px]'] == [
            f'{x.rmse_before[axis]:.3f}' for x in (a, b)
        ]
        assert line[f'RMSE {coordinate} after [px]'] == [
            f'{x.rmse_after[axis]:.3f}' for x in (a, b)
        ]
        gain = 100 * (1 - a.rmse_after[axis] / a.rmse_before[axis])
        assert line[f'improvement {coordinate} [%]'][0] == f'{gain:.1f}'
    for quantity, i in (('xp', 0), ('yp', 1), ('c', 2)):
        assert line[f'{quantity} [px]'] == [f'{x.interior[i]:.2f}' for x in (a, b)]
        assert line[f'{quantity} standard deviation [px]'] == [
            f'{x.interior_sd[i]:.2f}' for x in (a, b)
        ]
    assert line['correction model'] == ['local_linear'] * 2 and line['neighbours k'] == [
        '30',
        '30',
    ]
    assert line['iterations'] == [str(len(job.history[name])) for name in 'ab']
    assert line['converged'] == [
        {True: 'yes', False: 'NO'}[job.runs[name].converged] for name in 'ab'
    ]
    assert line['observations'] == [str(x.observations) for x in (a, b)]
    assert line['inliers'][::3] == [str(x.inliers) for x in (a, b)]
    shares = [f'({100 * x.inliers / x.observations:.1f}' for x in (a, b)]
    assert line['inliers'][1::3] == shares
    model = job.calibrations['a'].model
    assert float(line['median sd of the correction [px]'][0]) == pytest.approx(
        np.median(model.evaluate(model.train_uv).sd), abs=5e-4
    )
    shares = [100 * uncalibrated_share(job.calibrations[name]) for name in 'ab']
    assert line['image that is not calibrated [%]'] == [f'{share:.1f}' for share in shares]
    assert 'median 0.123 ms, 99 % below 0.5 ms, largest 2.25 ms (480 frames)' in text
    assert 'Latency' not in summary_table(job)


def test_summary_has_what_was_not_used_unless_it_is_printed_elsewhere(job):
    note = Finding(Kind.STRAY_POINTS, 'why', severity=Severity.NOTE)
    noted = dataclasses.replace(job, findings=(note,))
    assert summary_table(noted).splitlines()[-1] == 'Not used: why'
    assert summary_table(noted, has_notes=False) == summary_table(job, has_notes=False)


def test_sd_of_the_correction_in_the_summary_is_that_at_the_angles_of_the_exposures(job):
    turning = rigs.turning(job.calibrations['a'])
    text = summary_table(dataclasses.replace(job, calibrations={**job.calibrations, 'a': turning}))
    line = {row[:36].strip(): row[36:].split() for row in text.splitlines()}
    uv = turning.model.train_uv
    sd = [turning.correction(uv, angle).sd for angle in turning.angle_field.angles]
    found = float(line['median sd of the correction [px]'][0])
    assert found == pytest.approx(np.median(sd), abs=5e-4)
    assert found > np.median(turning.model.evaluate(uv).sd)


def test_summary_fits_a_terminal(job):
    """Many fluoroscopes, long names and long sentences stay within 100 columns."""
    names = [f'a_very_long_name_of_a_fluoroscope_{i}' for i in range(5)]
    many = dataclasses.replace(
        job,
        fluoroscopes=dict.fromkeys(names, job.fluoroscopes['a']),
        calibrations=dict.fromkeys(names, job.calibrations['a']),
        runs={},
        findings=(
            Finding(
                Kind.FEW_TARGETS,
                'too few targets ' * 10,
                Place(('a',), (7,)),
                severity=Severity.NOTE,
            ),
        ),
    )
    text = summary_table(many)
    assert max(map(len, text.splitlines())) <= 100
    assert text.count('a_very_long_name') == 5 and 'Not used: fluoroscope a, exposure 7' in text


def test_markdown_table():
    """Cells are aligned, numbers to the right; bars and line breaks do not break the table."""
    assert markdown_table(['model', 'RMSE [px]'], [['knn', 0.31], ['a|b\nc', '-']]) == (
        '| model  | RMSE [px] |\n'
        '| ------ | --------: |\n'
        '| knn    |      0.31 |\n'
        '| a\\|b c |         - |\n'
    )
    assert markdown_table(['x'], []) == '| x   |\n| --- |\n'
    with pytest.raises(ValueError, match='2 cells'):
        markdown_table(['x'], [[1, 2]])
