# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""A result folder with files that do not belong together is reported."""

import json
import shutil

import pytest
from rigs import calibrated, exposures, kinds, rig, run

from fluoro_calib_ros.checks.check import Check, Validation
from fluoro_calib_ros.estimation.options import CalibrationOptions, CalibrationRequest
from fluoro_calib_ros.findings import Kind, Severity
from fluoro_calib_ros.io.calibration import disagreements, load_calibrations
from fluoro_calib_ros.io.calibration_request import write_request
from fluoro_calib_ros.io.result_document import write_validation
from fluoro_calib_ros.jobs.result_folder import save_result
from fluoro_calib_ros.report import html as html_report

OPTIONS = {'max_iterations': 2}


@pytest.fixture(scope='module')
def written(tmp_path_factory):
    """Result folder of fluoroscope a."""
    path = tmp_path_factory.mktemp('written') / 'result'
    save_result(path, calibrated('a', 6, **OPTIONS))
    request = CalibrationRequest(
        {'a': exposures()['a'][:6]}, rig().phantom, CalibrationOptions(**OPTIONS)
    )
    write_request(path, request)
    return path


@pytest.fixture
def folder(written, tmp_path, monkeypatch):
    """A copy of the result folder; figures of the report are not drawn."""
    monkeypatch.setattr(html_report, '_figures', lambda *_: [])
    (tmp_path / 'points.csv').write_text('fluoroscope,u,v\na,100,200\n')
    return shutil.copytree(written, tmp_path / 'result')


def exchange(folder):
    """Replace the calibration by that of another run with the same exposures."""
    other = folder.parent / 'other'
    save_result(other, calibrated('a', 6, model='none'))
    shutil.copy(other / 'a.calibration.npz', folder)


def edit(folder, change):
    path = folder / 'result.json'
    document = json.loads(path.read_text())
    change(document)
    path.write_text(json.dumps(document))


def correct(folder):
    out = folder.parent / 'corrected.csv'
    return run('correct', folder.parent / 'points.csv', '--calibration', folder, '--out', out)


def improve(document):
    document['fluoroscopes']['a']['rmse_px']['after'] = [0.01, 0.01]


def test_a_folder_as_it_was_written_passes_without_a_word(folder, capsys):
    assert disagreements(folder, load_calibrations(folder)) == []
    edit(folder, lambda document: None)  # another layout of the same values
    assert disagreements(folder, load_calibrations(folder)) == []
    assert correct(folder) == 0
    assert run('report', folder) == 0
    assert capsys.readouterr().err == ''
    assert 'changed after' not in (folder / 'report.html').read_text()


def test_an_exchanged_calibration_is_named(folder, capsys):
    exchange(folder)
    sentence = (
        f'{folder}: the calibration file of a and result.json belong to different calibrations: '
        'one of them was replaced'
    )
    assert correct(folder) == 0
    assert capsys.readouterr().err.startswith(sentence)
    for command in ('report', 'validate'):
        assert run(command, folder) == 1
        assert sentence in capsys.readouterr().err
    assert not (folder / 'report.html').exists()


@pytest.mark.long
def test_an_edited_result_is_named(folder, capsys):
    edit(folder, improve)
    sentence = f'{folder / "result.json"}: the file was changed after it was written'
    assert correct(folder) == 0
    assert capsys.readouterr().err.startswith(sentence)
    assert run('report', folder) == 0
    assert sentence in (folder / 'report.html').read_text()
    run('validate', folder)
    assert 'the file was changed after it was written' in capsys.readouterr().out.replace(
        '\n  ', ' '
    )


@pytest.fixture
def judged(folder):
    """Write a verdict into the folder."""
    checks = (Check(Kind.HALVES, 'halves', value=3.0, limit=2.0),)
    ids = {'a': load_calibrations(folder)['a'].calibration_id}
    write_validation(folder, Validation('fail', checks, ids, 0.0))
    return folder


def change_bytes(path):
    path.write_bytes(path.read_bytes().replace(b'1', b'2', 1))


def forge(path):
    document = json.loads(path.read_text())
    document['verdict'] = 'pass'
    path.write_text(json.dumps(document))


@pytest.mark.parametrize(
    'name, change',
    [
        ('validation.json', forge),
        ('observations.csv', change_bytes),
        ('phantom.csv', change_bytes),
        ('names.csv', lambda path: path.write_text('kind,id,name\n')),
        ('options.json', lambda path: path.write_text('{}')),
        ('options.json', lambda path: path.unlink()),
        ('validation.json', lambda path: path.write_text('{')),
    ],
)
def test_a_verdict_is_of_the_whole_folder(judged, name, change):
    assert kinds(disagreements(judged, load_calibrations(judged))) == [Kind.FAILED_VERDICT]
    change(judged / name)
    (found,) = disagreements(judged, load_calibrations(judged))
    assert str(judged / name) in str(found)
    assert found.kind in (Kind.EDITED_RESULT, Kind.DATA)


def test_a_verdict_that_is_fail_is_told_by_every_reader(folder, capsys):
    write_validation(folder, Validation('fail', (), {}, 0.0))
    (found,) = disagreements(folder, load_calibrations(folder))
    assert (found.kind, found.severity) == (Kind.FAILED_VERDICT, Severity.WARNING)
    assert correct(folder) == 0
    assert 'the verdict on the calibration is fail' in capsys.readouterr().err


def test_a_forged_verdict_is_not_reported(judged):
    assert run('report', judged) == 0
    assert 'Verdict: fail' in (judged / 'report.html').read_text()
    forge(judged / 'validation.json')
    assert run('report', judged) == 0
    text = (judged / 'report.html').read_text()
    assert 'Verdict: pass' not in text and 'the file was changed after it was written' in text


def test_results_of_earlier_versions_are_read_as_before(folder, capsys):
    def to_earlier(document):
        document['format_version'] = 2
        del document['digest'], document['rig_note']
        del document['fluoroscopes']['a']['calibration_id']
        improve(document)

    edit(folder, to_earlier)
    exchange(folder)
    assert correct(folder) == 0
    assert run('report', folder) == 0
    assert capsys.readouterr().err == ''


@pytest.mark.parametrize('text', ['[', '{"fluoroscopes": []}', '{"fluoroscopes": {"a": 1}}', '7'])
def test_a_damaged_result_does_not_prevent_a_correction(folder, text, capsys):
    (folder / 'result.json').write_text(text)
    assert correct(folder) == 0
    assert 'Traceback' not in capsys.readouterr().err
    (folder / 'result.json').unlink()
    assert correct(folder) == 0
    assert capsys.readouterr().err == ''
