# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""fluoro-calib process: a study of trials is done once, resumed, and judged trial by trial."""

import contextlib
import csv
import json
import multiprocessing
import os
import shutil
import subprocess
from types import SimpleNamespace

import pytest
from rigs import run

from fluoro_calib_ros import processes
from fluoro_calib_ros.cli.process import STATE, Done, _Work, trial_row
from fluoro_calib_ros.errors import DataError
from fluoro_calib_ros.io.calibration import load_calibration, rig_verdict, with_digests
from fluoro_calib_ros.io.csv_table import Table
from fluoro_calib_ros.io.rig_file import read_study

STUDY = """
trials = ["trials/*.csv"]
calibration = "result"
[reconstruct]
drift_watch = false
[convert.trc]
rate = 100
"""


def write_study(folder, text):
    folder.mkdir(exist_ok=True)
    (folder / 'study.toml').write_text(text)
    return folder


@pytest.fixture(scope='module')
def rig(tmp_path_factory):
    """A rig calibrated from its bag, for two trials with image points of ten exposures each."""
    folder = tmp_path_factory.mktemp('study') / 'rig'
    more = ('--exposures', 6, '--test-exposures', 10, '--seconds', 0.05)
    assert run('simulate', '--out', folder, *more) == 0
    calibrate = ('calibrate', folder / 'calibration', '--phantom', folder / 'phantom.csv')
    fast = ('--model', 'parametric', '--fast', '--max-iterations', 2)
    assert run(*calibrate, '--out', folder / 'result', *fast) == 0
    return folder


@pytest.fixture
def study(rig, tmp_path):
    """A study of two trials whose calibration has not been validated."""
    folder = write_study(tmp_path / 'study', STUDY.replace('drift_watch = false\n', ''))
    shutil.copytree(rig / 'result', folder / 'result')
    (folder / 'trials').mkdir()
    for name in ('walk', 'run'):
        shutil.copy(rig / 'test.csv', folder / 'trials' / f'{name}.csv')
    return folder


class Forked:
    """Run a command in a fork of this process instead of a program that loads all modules."""

    def __init__(self, command, stdout, stderr, start_new_session):
        assert command[1:3] == ['-m', 'fluoro_calib_ros.cli'] and start_new_session

        def work():
            for stream, number in ((stdout, 1), (stderr, 2)):
                os.dup2(stream.fileno(), number)
            with (
                open(1, 'w', closefd=False) as out,
                open(2, 'w', closefd=False) as err,
                contextlib.redirect_stdout(out),
                contextlib.redirect_stderr(err),
            ):
                status = run(*command[3:])
            os._exit(status)

        self._process = multiprocessing.get_context('fork').Process(target=work)
        self._process.start()

    def poll(self):
        return self._process.exitcode

    returncode = property(poll)


@pytest.fixture
def forked(monkeypatch):
    of_programs = SimpleNamespace(Popen=Forked, TimeoutExpired=subprocess.TimeoutExpired)
    monkeypatch.setattr(processes, 'subprocess', of_programs)


def load_result_ids(folder):
    return {
        name: load_calibration(str(folder / f'{name}.calibration.npz')).calibration_id
        for name in 'ab'
    }


def rows_of(study):
    with open(study / 'results' / 'trials.csv', newline='') as file:
        return {row['trial']: row for row in csv.DictReader(file)}


def changed_by(study, *more):
    """Run the study; return the result files that this run wrote, and its exit status."""
    results = study / 'results'
    before = {p: p.stat().st_mtime_ns for p in results.rglob('*') if p.is_file()}
    status = run('process', study, '--workers', 2, *more)
    after = {p: p.stat().st_mtime_ns for p in results.rglob('*') if p.is_file()}
    ends = ('.csv', '.trc')
    changed = [p for p in after if after[p] != before.get(p) and p.suffix in ends]
    return {str(p.relative_to(results)) for p in changed} - {'trials.csv'}, status


@pytest.mark.long
def test_trials_are_processed_once_and_again_where_something_changed(study, forked):
    everything = {
        f'trials/{name}/points.{kind}' for name in ('walk', 'run') for kind in ('csv', 'trc')
    }
    assert changed_by(study) == (everything, 3)  # status 3: the calibration has not been validated
    for row in rows_of(study).values():
        assert row['verdict'] == 'cannot tell' and row['frames'] == '10'
        assert 0 < int(row['points_ok']) < int(row['points'])
    assert changed_by(study) == (set(), 3)
    os.utime(study / 'trials' / 'walk.csv')
    walk = {'trials/walk/points.csv', 'trials/walk/points.trc'}
    assert changed_by(study, '--exit-zero') == (walk, 0)
    text = (study / 'study.toml').read_text()
    (study / 'study.toml').write_text(text.replace('rate = 100', 'rate = 50'))
    trc = {'trials/walk/points.trc', 'trials/run/points.trc'}
    assert changed_by(study) == (trc, 3)
    assert changed_by(study, '--again') == (everything, 3)
    (study / 'trials' / 'walk.csv').unlink()
    (study / 'study.toml').write_text(text.partition('[convert')[0])
    given = load_result_ids(study / 'result')
    document = {'verdict': 'pass', 'checks': [], 'findings': [], 'calibration_id': given}
    document = with_digests(study / 'result', document, 'ab')
    (study / 'result' / 'validation.json').write_text(json.dumps(document))
    assert changed_by(study) == ({'trials/run/points.csv'}, 0)
    assert [row['verdict'] for row in rows_of(study).values()] == ['pass']
    assert rig_verdict(study / 'result') == 'pass'
    only_a = {**document, 'calibration_id': {'a': given['a']}}
    only_a = with_digests(study / 'result', only_a, 'a')
    (study / 'result' / 'validation.json').write_text(json.dumps(only_a))
    assert rig_verdict(study / 'result') == 'cannot tell'  # nothing is known about b


def test_a_trial_that_fails_does_not_stop_the_others(study, capsys, forked):
    (study / 'trials' / 'walk.csv').write_text('fluoroscope,exposure,target_id,u,v\na,1,x\n')
    assert run('process', study) == 1
    err = capsys.readouterr().err
    assert 'Traceback' not in err and '1 of 2 trials failed' in err
    rows = rows_of(study)
    assert rows['trials/walk']['verdict'] == 'refused'
    assert 'trials/walk.csv' in rows['trials/walk']['cause']
    assert rows['trials/run']['verdict'] == 'cannot tell'
    assert not (study / 'results/trials/walk/points.trc').exists()
    shutil.copy(study / 'trials' / 'run.csv', study / 'trials' / 'walk.csv')
    walk = {'trials/walk/points.csv', 'trials/walk/points.trc'}
    assert changed_by(study) == (walk, 3)  # the failed trial is tried again


def test_a_trial_of_a_rig_that_has_moved_fails(study, forked):
    """The trial looks as if recorded after a knock: the rays of its points miss each other."""
    path = study / 'trials' / 'walk.csv'
    with open(path, newline='') as file:
        rows = list(csv.DictReader(file))
    for row in rows:
        if row['fluoroscope'] == 'b':
            row['v'] = float(row['v']) + 10
    Table(tuple(rows[0]), (row.values() for row in rows)).write(path)
    assert run('process', study) == 3
    rows = rows_of(study)
    assert rows['trials/walk']['verdict'] == 'fail' and 'rays' in rows['trials/walk']['cause']
    assert rows['trials/run']['verdict'] == 'cannot tell'


def test_calibration_that_fails_ends_the_study_with_its_cause(study, capsys, forked):
    text = STUDY.replace('calibration = "result"\n', '')
    calibrate = '[calibrate]\nsource = "trials/walk.csv"\nphantom = "phantom.csv"\n'
    write_study(study, text + calibrate)
    (study / 'phantom.csv').write_text('target_id,x,y,z,sd\n1,0,0\n')
    assert run('process', study) == 1
    err = capsys.readouterr().err.splitlines()[-1]
    assert 'no calibration: ' in err and 'phantom.csv' in err and 'log' in err
    assert not (study / 'results' / 'trials').exists()


def test_trials_of_a_calibration_that_failed_are_not_processed(study, capsys):
    given = load_result_ids(study / 'result')
    document = {'verdict': 'fail', 'checks': [], 'findings': [], 'calibration_id': given}
    (study / 'result' / 'validation.json').write_text(json.dumps(document))
    assert run('process', study) == 1
    assert 'verdict of the calibration is fail' in capsys.readouterr().err
    assert not (study / 'results' / 'trials').exists()


@pytest.mark.long
def test_calibration_and_trials_from_one_file(tmp_path, capsys):
    """The rig has no distortion, so that there is little to estimate."""
    rig = tmp_path / 'rig'
    more = ('--exposures', 6, '--test-exposures', 10, '--seconds', 0.05, '--strength', 0)
    assert run('simulate', '--out', rig, *more) == 0
    capsys.readouterr()
    text = STUDY.replace('calibration = "result"\n', '').replace('drift_watch = false\n', '')
    calibrate = '[calibrate]\nsource = "calibration"\nphantom = "phantom.csv"\nmodel = "none"\n'
    folder = write_study(tmp_path / 'study', text + calibrate)
    shutil.copytree(rig / 'calibration', folder / 'calibration')
    shutil.copy(rig / 'phantom.csv', folder)
    (folder / 'trials').mkdir()
    shutil.copy(rig / 'test.csv', folder / 'trials' / 'walk.csv')
    assert run('process', folder, '--json') in (0, 3)
    document = json.loads(capsys.readouterr().out)
    assert document['calibration'] in ('pass', 'cannot tell')
    assert [row['verdict'] for row in document['trials']] == [document['calibration']]
    assert (folder / 'results/calibration/report.html').exists()


def test_dry_run_prints_the_commands_and_writes_nothing(study, capsys):
    assert run('process', study, '--dry-run') == 0
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 4
    assert lines[0] == (
        'fluoro-calib reconstruct trials/run.csv --calibration result '
        '--out results/trials/run/points.csv'
    )
    assert not (study / 'results').exists()


def test_radiographs_are_extracted_first(study, capsys):
    text = (study / 'study.toml').read_text().replace('"trials/*.csv"', '"films/*"')
    clusters = 'cluster = ["tibia: 1 2 3", "femur: 4 5 6"]\n'
    extract = '[extract]\nmarkers = "m.csv"\nfluoroscope = "a,b"\n' + clusters
    (study / 'study.toml').write_text(text + extract)
    (study / 'films' / 'walk').mkdir(parents=True)
    assert run('process', study, '--dry-run') == 0
    first, then, _ = capsys.readouterr().out.splitlines()
    for word in ('extract films/walk', '--cluster=tibia: 1 2 3', '--cluster=femur: 4 5 6'):
        assert word in first
    assert 'reconstruct results/films/walk/observations.csv --calibration result' in then


@pytest.mark.parametrize(
    ('text', 'words'),
    [
        ('trials = ["*"]\n', ['[calibrate]', 'calibration']),
        ('trials = ["*"]\ncalibration = "r"\n[calibrate]\n', ['[calibrate]', 'calibration']),
        ('calibration = "r"\n', ['trials', 'patterns']),
        ('trials = ["none/*"]\ncalibration = "r"\n', ['none/*', 'matches']),
        ('trials = ["x*"]\ncalibration = "r"\n', ['x.csv', 'x.mcap', 'same results']),
        ('trials = ["*"]\ncalibration = 3\n', ['calibration', 'path']),
        ('trials = ["*"]\ncalibration = "r"\nbodys = 1\n', ['bodys', 'unknown', 'bodies']),
        ('trials = ["*"]\ncalibration = "r"\nbodies = 1\n', ['bodies', 'table']),
        ('trials = ["x.csv"]\n[calibrate]\nphantom = "p"\n', ['source', 'missing']),
        ('trials = ["x.csv"]\ncalibration = "r"\n[convert.c3d]\n', ['convert', 'points']),
        ('trials = ["/x"]\ncalibration = "r"\n', ['/x', 'relative']),
    ],
)
def test_wrong_study_is_named_with_its_key(tmp_path, text, words):
    write_study(tmp_path, text)
    for name in ('x.csv', 'x.mcap'):
        (tmp_path / name).touch()
    with pytest.raises(DataError) as caught:
        read_study(tmp_path)
    assert str(caught.value).startswith(str(tmp_path / 'study.toml'))
    for word in words:
        assert word in str(caught.value)


@pytest.mark.parametrize(
    ('table', 'words'),
    [
        ('[reconstruct]\nreject = "x"\n', ['table reconstruct', '--reject', "'x'"]),
        ('[reconstruct]\nrejct = 3\n', ['table reconstruct', '--rejct']),
        ('[reconstruct]\nout = "here"\n', ['table reconstruct', 'out', 'set by']),
        ('[reconstruct]\nhelp-all = true\n', ['table reconstruct', 'help-all', 'set by']),
        ('[reconstruct]\nhelp_all = true\n', ['table reconstruct', 'help_all', 'set by']),
        ('[reconstruct]\nreject = {a = 1}\n', ['table reconstruct', 'reject']),
        ('[bodies]\nbodies = "b"\nlearn = true\n', ['table bodies', 'learn', 'single command']),
        ('[extract]\noverlay = "o"\n', ['table extract', 'overlay', 'single command']),
        ('[bodies]\njoints = "j"\n', ['table bodies', '--bodies']),
    ],
)
def test_wrong_option_is_named_before_anything_runs(tmp_path, capsys, table, words):
    folder = write_study(tmp_path / 'study', f'trials = ["x"]\ncalibration = "result"\n{table}')
    (folder / 'x').touch()
    assert run('process', folder) == 1
    out, err = capsys.readouterr()
    assert out == '' and err.count('\n') == 1
    for word in words:
        assert word in err
    assert not (folder / 'results' / STATE).exists()


def test_doubt_about_a_body_makes_a_trial_doubtful():
    class Bodies:
        command = 'bodies'

    class Given:
        ok = True
        document = {
            'bodies': {'tibia': {'poses': 5, 'sd_mm': 0.1, 'sd_deg': 0.2}},
            'joints': {'knee': {'flexion': {'range_deg': 30.0, 'sd_deg': 0.1}}},
            'findings': [
                {'sentence': 'marker 3 has moved', 'severity': 'warning'},
                {'sentence': 'marker 4 is near marker 5', 'severity': 'note'},
            ],
        }

    row = trial_row('walk', 'pass', [(Bodies, Given)])
    assert row['verdict'] == 'cannot tell' and row['cause'] == 'marker 3 has moved'
    assert row['tibia_poses'] == 5 and row['knee_flexion_range_deg'] == 30.0
    assert trial_row('walk', 'fail', [(Bodies, Given)])['verdict'] == 'fail'
    Given.document['findings'].append({'sentence': 'it is mirrored', 'severity': 'error'})
    row = trial_row('walk', 'pass', [(Bodies, Given)])
    assert row['verdict'] == 'fail' and row['cause'] == 'marker 3 has moved; it is mirrored'


def test_a_trial_with_a_delayed_fluoroscope_fails_with_that_cause():
    document = {
        'frames': 9,
        'points': 90,
        'status': {'OK': 90},
        'lost_targets': [],
        'widening': 1.5,
        'drift': None,
        'timing': {'sentence': 'b is late', 'severity': 'warning'},
    }
    step = SimpleNamespace(command='reconstruct')
    row = trial_row('walk', 'pass', [(step, Done(0, document))])
    assert row['verdict'] == 'fail' and row['cause'] == 'b is late'
    document['widening'] = 1.0
    row = trial_row('walk', 'pass', [(step, Done(0, document))])
    assert row['verdict'] == 'fail' and row['cause'] == 'b is late'
    # Stamps that are far apart do not tell whether the clocks or the exposures differ.
    document |= {'timing': None, 'disagreement': {'sentence': 'apart', 'severity': 'warning'}}
    row = trial_row('walk', 'pass', [(step, Done(0, document))])
    assert row['verdict'] == 'cannot tell' and row['cause'] == 'apart'
    bodies = SimpleNamespace(command='bodies')
    wrong = {'bodies': {}, 'joints': {}, 'findings': [{'sentence': 'no', 'severity': 'error'}]}
    row = trial_row('walk', 'pass', [(step, Done(0, document)), (bodies, Done(3, wrong))])
    assert row['verdict'] == 'fail' and row['cause'] == 'no'


def test_step_is_kept_only_with_its_digest_and_all_that_it_wrote(tmp_path):
    step = SimpleNamespace(key='k', out=tmp_path / 'out', document=tmp_path / 'document.json')
    work = SimpleNamespace(_state={'k': {'digest': 'd', 'status': 3}, 'other': 5})

    def kept(digest='d', key='k'):
        step.key = key
        return _Work._kept(work, step, digest)

    assert kept() is None
    step.out.mkdir()
    assert kept() is None
    step.document.write_text('{"a": 1}')
    assert kept() == Done(3, {'a': 1})
    assert kept('e') is None and kept(key='other') is None and kept(key='unknown') is None
    step.out.rmdir()
    assert kept() is None
