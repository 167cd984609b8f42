# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The command fluoro-calib: its files, its output, and its error messages."""

import argparse
import csv
import filecmp
import html
import io
import json
import os
import pathlib
import re
import shutil
import subprocess
import sys

import numpy as np
import pytest
from rigs import run
from scipy.spatial.distance import pdist

from fluoro_calib_ros.cli import COMMANDS, main, make_parser
from fluoro_calib_ros.cli.arguments import input_paths
from fluoro_calib_ros.correction.base import CorrectionStatus
from fluoro_calib_ros.io.bags.writer import write_bag
from fluoro_calib_ros.io.calibration import load_calibration

ROOT = pathlib.Path(__file__).resolve().parents[2]
IMAGE = ('--image-size', '1024x1024')
EXPOSURES = 6


def command(*arguments, **options):
    """Run the command in a process of its own."""
    return subprocess.run(
        [sys.executable, '-m', 'fluoro_calib_ros.cli', *map(str, arguments)],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=120,
        **options,
    )


def files_of(folder):
    """Return {path: content} of all files below a folder."""
    return {
        str(p.relative_to(folder)): p.read_bytes()
        for p in sorted(pathlib.Path(folder).rglob('*'))
        if p.is_file()
    }


@pytest.fixture(scope='module')
def rig(tmp_path_factory):
    """A data set of the virtual rig, including exposures for a test."""
    folder = tmp_path_factory.mktemp('rig')
    more = ('--exposures', EXPOSURES, '--test-exposures', 5, '--seconds', 0.05)
    assert run('simulate', '--out', folder, *more) == 0
    return folder


@pytest.fixture(scope='module')
def result(rig, tmp_path_factory):
    """The folder written by a short calibration of both fluoroscopes."""
    folder = tmp_path_factory.mktemp('calibrated') / 'result'
    assert (
        run(
            'calibrate',
            rig / 'calibration',
            '--phantom',
            rig / 'phantom.csv',
            '--out',
            folder,
            '--max-iterations',
            2,
            '--fast',
        )
        == 0
    )
    return folder


def calibrate(rig, out, *more, source='calibration', phantom='phantom.csv'):
    files = ('--phantom', rig / phantom, '--out', out)
    return ('calibrate', rig / source, *files, '--fast', *more)


def said(capsys, arguments, status=1):
    """Return the one sentence with which a command fails; nothing is on standard output."""
    assert run(*arguments) == status
    out, err = capsys.readouterr()
    assert out == '' and 'Traceback' not in err
    if status == 1:
        assert (
            err.startswith(f'fluoro-calib {arguments[0]}: ')
            and err.count('\n') == 1
            and err.endswith('\n')
        )
    return err


# ---- simulate


def test_simulate_is_reproducible(tmp_path):
    """All files are the same for the same seed and different for another seed."""
    for name, seed in (('one', 5), ('other', 5), ('third', 6)):
        assert (
            run(
                'simulate',
                '--out',
                tmp_path / name,
                '--seed',
                seed,
                '--exposures',
                3,
                '--test-exposures',
                2,
                '--seconds',
                0.1,
            )
            == 0
        )
    one, other, third = (files_of(tmp_path / name) for name in ('one', 'other', 'third'))
    assert one == other and one.keys() == third.keys()
    assert all(one[name] != third[name] for name in one if not name.endswith('metadata.yaml'))
    assert {
        'phantom.csv',
        'calibration.csv',
        'test.csv',
        'calibration/metadata.yaml',
        'calibration/calibration_0.mcap',
        'test/test_0.mcap',
        'tracking/tracking_0.mcap',
        'truth/phantom.csv',
        'truth/rig.json',
        'truth/markers.csv',
        'truth/calibration_exposures.csv',
        'truth/calibration_undistorted.csv',
    } <= one.keys()


@pytest.mark.long
def test_sample_bags_were_made_by_the_documented_command(tmp_path):
    """The folder bags/ is, file by file, what fluoro-calib simulate --out bags writes."""
    assert 'fluoro-calib simulate --out bags' in (ROOT / 'bags' / 'README.md').read_text()
    assert run('simulate', '--out', tmp_path) == 0
    made = files_of(tmp_path)
    assert made.keys() == files_of(ROOT / 'bags').keys() - {'README.md'}
    _, different, failed = filecmp.cmpfiles(tmp_path, ROOT / 'bags', made, shallow=False)
    assert not different and not failed


def test_simulate_has_any_number_of_fluoroscopes(tmp_path):
    assert (
        run('simulate', '--out', tmp_path, '--fluoroscopes', 3, '--exposures', 3, '--seconds', 0.1)
        == 0
    )
    with open(tmp_path / 'calibration.csv') as file:
        seen = {row['fluoroscope'] for row in csv.DictReader(file)}
    assert seen == {'a', 'b', 'c'}
    rig = json.loads((tmp_path / 'truth' / 'rig.json').read_text())
    sources = np.array([one['position_mm'] for one in rig['fluoroscopes'].values()])
    between = np.degrees(np.arccos(1 - pdist(sources, 'cosine')))
    assert between[[0, 2]] == pytest.approx(60, abs=6)  # angle between neighbours


def test_size_of_one_part_does_not_change_the_others(tmp_path, rig):
    """The exposures for the calibration are the same with and without a test."""
    assert run('simulate', '--out', tmp_path, '--exposures', EXPOSURES) == 0
    assert (tmp_path / 'calibration.csv').read_bytes() == (rig / 'calibration.csv').read_bytes()
    assert not (tmp_path / 'test').exists()


# ---- calibrate

NUMBERS = {
    'fluoroscopes': dict,
    'targets': list,
    'history': list,
    'converged': bool,
    'seconds': float,
}


def check_result(document, names, exposures):
    """Check the layout of result.json."""
    assert {*NUMBERS, 'relative_orientation'} <= document.keys()
    assert all(isinstance(document[key], kind) for key, kind in NUMBERS.items())
    assert list(document['fluoroscopes']) == names
    for figures in document['fluoroscopes'].values():
        assert {
            'interior',
            'image_size',
            'model',
            'rmse_px',
            'inliers',
            'observations',
            'exposures',
        } <= figures.keys()
        assert {'xp', 'yp', 'c', 'sd'} == figures['interior'].keys() and len(
            figures['interior']['sd']
        ) == 3
        assert figures['image_size'] == [1024, 1024] and {'kind', 'k'} == figures['model'].keys()
        assert len(figures['rmse_px']['before']) == len(figures['rmse_px']['after']) == 2
        assert 0 < figures['inliers'] <= figures['observations']
        assert [e['exposure'] for e in figures['exposures']] == exposures
        for exposure in figures['exposures']:
            assert [
                len(exposure[key]) for key in ('position_mm', 'quaternion_wxyz', 'sd_mm', 'sd_rad')
            ] == [3, 4, 3, 3]
            assert np.linalg.norm(exposure['quaternion_wxyz']) == pytest.approx(1)
            assert min(exposure['sd_mm'] + exposure['sd_rad']) > 0
    ids = [target['target_id'] for target in document['targets']]
    assert ids == sorted(set(ids)) and len(ids) > 300
    assert all(
        len(t['xyz_mm']) == len(t['sd_mm']) == 3 and min(t['sd_mm']) > 0
        for t in document['targets']
    )
    for this in document['history']:
        assert {'F', 'G', 'k'} <= this.keys() and set(this['k']) <= set(names)


def test_calibrate_writes_result_and_calibrations(result):
    document = json.loads((result / 'result.json').read_text())
    check_result(document, ['a', 'b'], list(range(1, EXPOSURES + 1)))
    assert len(document['history']) == 4 and not document['converged']
    for name, figures in document['fluoroscopes'].items():
        assert max(figures['rmse_px']['after']) < 0.3 < 1 < min(figures['rmse_px']['before'])
        with np.load(result / f'{name}.calibration.npz', allow_pickle=False) as arrays:
            np.testing.assert_array_equal(
                arrays['interior'], [figures['interior'][key] for key in ('xp', 'yp', 'c')]
            )
            assert int(arrays['model_k']) == figures['model']['k']
    assert sorted(p.name for p in result.iterdir()) == [
        'a.calibration.npz',
        'b.calibration.npz',
        'doubtful.csv',
        'exposures.csv',
        'interior.csv',
        'observations.csv',
        'options.json',
        'phantom.csv',
        'residuals.csv',
        'result.json',
        'rig_orientation.npz',
        'targets.csv',
    ]


@pytest.mark.long
def test_bag_and_csv_give_the_same_numbers(rig, tmp_path):
    """They agree to the last digit, also in another process with two threads."""
    more = ('--max-iterations', 1, '--fluoroscopes', 'a', '--model', 'parametric')
    assert run(*calibrate(rig, tmp_path / 'bag', *more)) == 0
    assert run(*calibrate(rig, tmp_path / 'csv', *more, *IMAGE, source='calibration.csv')) == 0
    done = command(
        *calibrate(rig, tmp_path / 'file', *more, source='calibration/calibration_0.mcap'),
        env={**os.environ, 'OPENBLAS_NUM_THREADS': '2'},
    )
    assert done.returncode == 0 and done.stderr == '', done.stderr
    bag, table, file = (
        {
            **json.loads((tmp_path / name / 'result.json').read_text()),
            'seconds': 0.0,
            'created': '',
            'digest': '',
        }
        for name in ('bag', 'csv', 'file')
    )
    assert bag == table == file
    check_result(bag, ['a'], list(range(1, EXPOSURES + 1)))


@pytest.mark.long
def test_json_is_the_only_standard_output(rig, tmp_path, capfd):
    """It has the content of result.json; libraries write nothing to standard error either."""
    more = ('--json', '--max-iterations', 1, '--fluoroscopes', 'b', '--model', 'none')
    assert run(*calibrate(rig, tmp_path, *more)) == 0
    out, err = capfd.readouterr()
    assert err == ''
    assert json.loads(out) == json.loads((tmp_path / 'result.json').read_text())


def test_summary_is_printed_without_json(rig, tmp_path, capsys):
    assert (
        run(
            *calibrate(
                rig, tmp_path, '--max-iterations', 1, '--fluoroscopes', 'b', '--model', 'none'
            )
        )
        == 0
    )
    out, err = capsys.readouterr()
    assert err == '' and out.count('\n') >= 2 and 'NaN' not in out and not out.startswith('{')


@pytest.mark.long
@pytest.mark.parametrize(
    'options, check',
    [
        (
            ('--interior', 'fixed', '--principal-distance', 4000),
            lambda f: f['interior'] == {'xp': 511.5, 'yp': 511.5, 'c': 4000, 'sd': [0, 0, 0]},
        ),
        (('--model', 'knn', '--k', 9), lambda f: f['model'] == {'kind': 'knn', 'k': 9}),
        (
            ('--loss', 'gaussian', '--model', 'none'),
            lambda f: f['inliers'] > 0.9 * f['observations'],
        ),
        (('--joint', '--model', 'none'), lambda f: f['model']['kind'] == 'none'),
    ],
)
def test_options_of_calibrate_reach_the_result(rig, tmp_path, options, check):
    names = ['a', 'b'] if '--joint' in options else ['a']
    assert (
        run(
            *calibrate(
                rig, tmp_path, '--max-iterations', 1, '--fluoroscopes', ','.join(names), *options
            )
        )
        == 0
    )
    document = json.loads((tmp_path / 'result.json').read_text())
    assert list(document['fluoroscopes']) == names and check(document['fluoroscopes']['a'])
    assert [this['fluoroscopes'] for this in document['history']] == [names]


# ---- adjust


def test_adjust_holds_the_calibration(rig, result, tmp_path):
    """Residuals of unused exposures decrease; the calibrations of the folder do not change."""
    assert (
        run(
            'adjust',
            rig / 'test',
            '--phantom',
            rig / 'phantom.csv',
            '--calibration',
            result,
            '--out',
            tmp_path,
        )
        == 0
    )
    document = json.loads((tmp_path / 'result.json').read_text())
    check_result(document, ['a', 'b'], list(range(EXPOSURES + 1, EXPOSURES + 6)))
    assert document['history'] == [] and document['converged']
    before = json.loads((result / 'result.json').read_text())
    for name, figures in document['fluoroscopes'].items():
        held = before['fluoroscopes'][name]['interior']
        assert {**figures['interior'], 'sd': 0} == {**held, 'sd': 0}
        # The interior is fixed, but it keeps its uncertainty.
        assert np.allclose(figures['interior']['sd'], held['sd'], rtol=0.05)
        assert max(figures['rmse_px']['after']) < 0.35 < 1 < min(figures['rmse_px']['before'])
        assert (tmp_path / f'{name}.calibration.npz').read_bytes() == (
            result / f'{name}.calibration.npz'
        ).read_bytes()


# ---- correct


def test_correct_removes_the_distortion(rig, result, tmp_path, capsys):
    """u_corrected = u - du at the observed pixel, row by row; all other columns are kept."""
    out = tmp_path / 'corrected.csv'
    assert run('correct', rig / 'test.csv', '--calibration', result, '--out', out, '--json') == 0
    told = json.loads(capsys.readouterr().out)
    with open(rig / 'test.csv', newline='') as file:
        given = list(csv.DictReader(file))
    with open(out, newline='') as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == len(given) == told['points'] == sum(told['status'].values())
    assert told['status']['OK'] > 0.9 * len(rows)
    assert list(rows[0]) == [*given[0], 'u_corrected', 'v_corrected', 'sigma', 'status']
    for name in 'ab':
        calibration = load_calibration(str(result / f'{name}.calibration.npz'))
        mine = [(g, r) for g, r in zip(given, rows) if r['fluoroscope'] == name]
        uv = np.array([[float(g['u']), float(g['v'])] for g, _ in mine])
        corrected = np.array([[float(r['u_corrected']), float(r['v_corrected'])] for _, r in mine])
        np.testing.assert_allclose(
            corrected, uv - calibration.model.predict(uv), atol=0.01
        )  # tolerance of the lookup grid
        assert all(g == {key: r[key] for key in g} for g, r in mine)
        if name == 'a':  # for one fluoroscope only: making another grid takes a second
            wanted = calibration.correct(uv)
            assert np.array_equal(corrected, wanted.uv)
            assert [r['status'] == 'OUTSIDE' for _, r in mine] == (
                wanted.status == CorrectionStatus.OUTSIDE
            ).tolist()


def test_correct_tells_a_missing_file_from_one_of_another_kind(result, tmp_path, capsys):
    path = tmp_path / 'points.xlsx'
    arguments = ('correct', path, '--calibration', result, '--out', tmp_path / 'x.csv')
    assert 'no such file' in said(capsys, arguments)
    path.write_text('u,v\n')
    err = said(capsys, arguments)
    assert 'xlsx' in err and 'only csv, ' in err


# ---- what users get wrong


@pytest.mark.parametrize(
    'arguments',
    [
        (),
        ('calibrat',),
        ('simulate',),
        ('simulate', '--out', 'x', '--exposures', '0'),
        ('simulate', '--out', 'x', '--noise', 'nan'),
        ('simulate', '--out', 'x', '--seed', '1.5'),
        ('calibrate', 'bags', '--out', 'x'),
        ('calibrate', 'bags', '--phantom', 'p.csv'),
        ('calibrate', 'bags', '--phantom', 'p.csv', '--out', 'x', '--model', 'spline'),
        ('calibrate', 'bags', '--phantom', 'p.csv', '--out', 'x', '--loss', 'cauchy'),
        ('calibrate', 'bags', '--phantom', 'p.csv', '--out', 'x', '--image-size', '1024'),
        ('calibrate', 'bags', '--phantom', 'p.csv', '--out', 'x', '--image-size', '0x9'),
        ('calibrate', 'bags', '--phantom', 'p.csv', '--out', 'x', '--k', '0'),
        ('calibrate', 'bags', '--phantom', 'p.csv', '--out', 'x', '--joint', '--separate'),
        ('calibrate', 'bags', '--phantom', 'p.csv', '--out', 'x', '--principal-distance', '-5'),
        ('adjust', 'bags', '--phantom', 'p.csv', '--out', 'x'),
        ('correct', 'p.csv', '--out', 'x'),
    ],
)
def test_wrong_usage_exits_with_status_2_and_the_usage(arguments, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert 'usage: fluoro-calib' in said(capsys, arguments, status=2)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize('command', COMMANDS, ids=lambda command: command.NAME)
def test_every_command_has_help_with_an_example_that_parses(command, capsys):
    from fluoro_calib_ros.cli import make_parser

    assert run(command.NAME, '--help') == 0
    text = ' '.join(capsys.readouterr().out.split())
    assert f'example: {command.EXAMPLE}' in text
    assert make_parser().parse_args(command.EXAMPLE.split()[1:]).command == command.NAME


def test_help_is_short_and_help_all_whole(capsys):
    """Rarely used options are named by their group only; required arguments are never hidden."""
    from fluoro_calib_ros.cli import RARE, make_parser

    texts = {}
    for flag in ('--help', '--help-all'):
        assert run('calibrate', flag) == 0
        texts[flag] = capsys.readouterr().out
    assert '--phantom' in texts['--help'] and '--max-file-mb' not in texts['--help']
    assert '--help-all shows' in texts['--help'] and 'limits of what is read' in texts['--help']
    assert '--max-file-mb' in texts['--help-all'] and '--known-orientation' in texts['--help-all']
    assert texts['--help'].count('\n') < 0.6 * texts['--help-all'].count('\n')
    usage = said(capsys, ('calibrate',), status=2)
    assert '--fast' in usage and '--max-file-mb' not in usage
    for command in COMMANDS:
        (commands,) = (a for a in make_parser(command.NAME)._actions if a.dest == 'command')
        for group in commands.choices[command.NAME]._action_groups:
            if group.title in RARE:
                assert not any(action.required for action in group._group_actions)


def test_a_misspelt_command_is_suggested(capsys):
    assert "did you mean 'calibrate'?" in said(capsys, ('calibrte',), status=2)


def test_missing_files_are_reported_by_name(rig, tmp_path, capsys):
    nowhere = tmp_path / 'nowhere'
    for arguments in (
        calibrate(rig, tmp_path / 'x', source=nowhere),
        calibrate(rig, tmp_path / 'x', phantom=nowhere),
        calibrate(rig, tmp_path / 'x', *IMAGE, source=nowhere.with_suffix('.csv')),
        (
            'adjust',
            rig / 'test',
            '--phantom',
            rig / 'phantom.csv',
            '--calibration',
            nowhere,
            '--out',
            tmp_path / 'x',
        ),
        ('correct', nowhere, '--calibration', nowhere, '--out', tmp_path / 'x'),
    ):
        assert str(nowhere) in said(capsys, arguments)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.long
def test_failing_process_prints_one_sentence(rig, tmp_path):
    """The exit status is 1 and there is no traceback, whatever else the process prints."""
    done = command(*calibrate(rig, tmp_path / 'x', source='nowhere'))
    assert (done.returncode, done.stdout) == (1, '') and done.stderr.count('\n') == 1
    assert done.stderr.startswith('fluoro-calib calibrate: ') and 'nowhere' in done.stderr
    assert command('calibrate').returncode == 2


def test_bag_without_observations_is_refused(rig, tmp_path, capsys):
    write_bag(tmp_path / 'empty', {'a': []})
    sentence = said(capsys, calibrate(rig, tmp_path / 'x', source=tmp_path / 'empty'))
    assert str(tmp_path / 'empty') in sentence and 'observations' in sentence.lower()
    (tmp_path / 'folder').mkdir()
    assert 'folder' in said(capsys, calibrate(rig, tmp_path / 'x', source=tmp_path / 'folder'))
    (tmp_path / 'torn.mcap').write_bytes(
        (rig / 'calibration' / 'calibration_0.mcap').read_bytes()[:4]
    )
    assert 'torn.mcap' in said(
        capsys, calibrate(rig, tmp_path / 'x', source=tmp_path / 'torn.mcap')
    )


@pytest.mark.parametrize(
    'bad, cause',
    [
        ('7,1,2,x,0.1', "row 9: z is 'x', not a number"),
        ('7,1,2,nan,0.1', 'row 9: z'),
        ('7,1,2,3,0', 'row 9: sd'),
        ('7,1,2,3', 'row 9: 4 columns'),
        ('1,1,2,3,0.1', 'row 9: target 1 is already given in row 2'),
        ('-7,1,2,3,0.1', 'row 9: target_id'),
    ],
)
def test_invalid_row_of_the_phantom_is_reported(rig, tmp_path, capsys, bad, cause):
    lines = (rig / 'phantom.csv').read_text().splitlines()
    lines[8] = bad
    (tmp_path / 'phantom.csv').write_text('\n'.join(lines) + '\n')
    sentence = said(capsys, calibrate(rig, tmp_path / 'x', phantom=tmp_path / 'phantom.csv'))
    assert f'{tmp_path / "phantom.csv"}, ' in sentence and cause in sentence


def test_csv_requires_the_image_size(rig, tmp_path, capsys):
    sentence = said(capsys, calibrate(rig, tmp_path / 'x', source='calibration.csv'))
    assert 'calibration.csv' in sentence and '--image-size WxH' in sentence


def test_points_off_the_image_are_refused_with_their_row(rig, tmp_path, capsys):
    sentence = said(
        capsys, calibrate(rig, tmp_path / 'x', '--image-size', '512x512', source='calibration.csv')
    )
    assert re.search(r'calibration.csv, row \d+: the point .* is outside the image', sentence)


def test_unknown_fluoroscope_is_reported(rig, tmp_path, capsys):
    sentence = said(capsys, calibrate(rig, tmp_path / 'x', '--fluoroscopes', 'a,c'))
    assert "no fluoroscope 'c', only a, b" in sentence


def test_too_few_exposures_are_reported(rig, tmp_path, capsys):
    lines = (rig / 'calibration.csv').read_text().splitlines()
    few = [line for line in lines if line[0] != 'a' or line.split(',')[1] in ('1', '2')]
    (tmp_path / 'few.csv').write_text('\n'.join(few) + '\n')
    sentence = said(capsys, calibrate(rig, tmp_path / 'x', *IMAGE, source=tmp_path / 'few.csv'))
    assert 'fluoroscope a: 2 exposures are too few, 3 are needed' in sentence
    assert not (tmp_path / 'x').exists()


def test_k_that_no_model_can_have_is_reported(rig, tmp_path, capsys):
    more = ('--fluoroscopes', 'a', '--max-iterations', 1, '--model', 'local_linear', '--k')
    assert run(*calibrate(rig, tmp_path / 'x', *more, 100000)) == 2
    assert 'argument --k: ' in capsys.readouterr().err
    assert 'fluoroscope a: local_linear with k = 3' in said(
        capsys, calibrate(rig, tmp_path / 'x', *more, 3)
    )


def test_k_for_a_model_without_neighbours_is_wrong_usage(rig, tmp_path, capsys):
    with pytest.raises(SystemExit) as ended:
        main([str(a) for a in calibrate(rig, tmp_path / 'x', '--k', 30)])
    assert ended.value.code == 2 and '--k is a number of neighbours' in capsys.readouterr().err


def test_empty_or_damaged_calibration_folder_is_reported(rig, result, tmp_path, capsys):
    empty = tmp_path / 'empty'
    damaged = tmp_path / 'damaged'
    empty.mkdir()
    damaged.mkdir()
    content = (result / 'a.calibration.npz').read_bytes()
    (damaged / 'a.calibration.npz').write_bytes(content[:-100])
    for folder, cause in ((empty, 'there is no calibration'), (damaged, 'damaged')):
        for arguments in (
            ('adjust', rig / 'test', '--phantom', rig / 'phantom.csv'),
            ('correct', rig / 'test.csv'),
        ):
            sentence = said(capsys, (*arguments, '--calibration', folder, '--out', tmp_path / 'x'))
            assert str(folder) in sentence and cause in sentence
    assert not (tmp_path / 'x').exists()


def test_fluoroscope_without_calibration_is_reported(rig, result, tmp_path, capsys):
    (tmp_path / 'only').mkdir()
    (tmp_path / 'only' / 'b.calibration.npz').write_bytes(
        (result / 'b.calibration.npz').read_bytes()
    )
    more = ('--calibration', tmp_path / 'only', '--out', tmp_path / 'x')
    assert "no calibration of fluoroscope 'a', only of b" in said(
        capsys, ('adjust', rig / 'test', '--phantom', rig / 'phantom.csv', *more)
    )
    assert "row 2: there is no calibration of fluoroscope 'a'" in said(
        capsys, ('correct', rig / 'test.csv', *more)
    )


def test_frames_of_another_image_size_are_refused(rig, result, tmp_path, capsys):
    sentence = said(
        capsys,
        (
            'adjust',
            rig / 'test.csv',
            '--image-size',
            '2048x2048',
            '--phantom',
            rig / 'phantom.csv',
            '--calibration',
            result,
            '--out',
            tmp_path / 'x',
        ),
    )
    assert 'the image is 2048 x 2048 px, but the calibration is for 1024 x 1024 px' in sentence


@pytest.mark.long
def test_failing_command_leaves_earlier_results(rig, result, tmp_path, capsys):
    """The commands that fail are a calibration at its second fluoroscope, an adjustment and a
    correction; the results stay the same byte for byte.
    """
    before = files_of(result)
    lines = (rig / 'calibration.csv').read_text().splitlines()
    few = [line for line in lines if line[0] != 'b' or line.split(',')[1] in ('1', '2')]
    (tmp_path / 'few.csv').write_text('\n'.join(few) + '\n')
    (tmp_path / 'bad.csv').write_text('fluoroscope,u,v\na,1,2\na,1,x\n')
    corrected = tmp_path / 'corrected.csv'
    corrected.write_text('earlier')
    said(
        capsys, calibrate(rig, result, *IMAGE, '--max-iterations', 1, source=tmp_path / 'few.csv')
    )
    said(
        capsys,
        (
            'adjust',
            tmp_path / 'bad.csv',
            '--phantom',
            rig / 'phantom.csv',
            *IMAGE,
            '--calibration',
            result,
            '--out',
            result,
        ),
    )
    assert "row 3: v is 'x'" in said(
        capsys, ('correct', tmp_path / 'bad.csv', '--calibration', result, '--out', corrected)
    )
    assert files_of(result) == before and corrected.read_text() == 'earlier'


def test_impossible_output_is_reported(rig, tmp_path, capsys):
    (tmp_path / 'file').write_text('')
    for arguments in (
        ('simulate', '--out', tmp_path / 'file', '--exposures', 1, '--seconds', 0),
        calibrate(
            rig, tmp_path / 'file', '--max-iterations', 1, '--fluoroscopes', 'a', '--model', 'none'
        ),
    ):
        assert str(tmp_path / 'file') in said(capsys, arguments)


def test_exposures_that_are_left_out_are_reported(rig, tmp_path, capsys):
    """Excluded exposures appear on standard error and in the result; the calibration goes on."""
    lines = (rig / 'calibration.csv').read_text().splitlines()
    third = [n for n, line in enumerate(lines) if line.startswith('a,3,')]
    kept = [
        line for n, line in enumerate(lines) if n not in third[10:] and not line.startswith('b')
    ]
    (tmp_path / 'less.csv').write_text('\n'.join(kept) + '\n')
    assert (
        run(
            *calibrate(
                rig,
                tmp_path / 'x',
                *IMAGE,
                '--max-iterations',
                1,
                '--json',
                '--model',
                'none',
                source=tmp_path / 'less.csv',
            )
        )
        == 0
    )
    out, err = capsys.readouterr()
    assert err == 'not used: fluoroscope a, exposure 3: 10 targets are too few, 12 are needed\n'
    document = json.loads(out)
    assert document['left_out'] == [err[len('not used: ') : -1]]
    check_result(document, ['a'], [n for n in range(1, EXPOSURES + 1) if n != 3])


@pytest.mark.long
def test_calibrate_ends_with_verdict_and_report(rig, tmp_path, capsys):
    arguments = (rig / 'calibration', '--phantom', rig / 'phantom.csv', '--out', tmp_path / 'new')
    options = ('--fluoroscopes', 'a', '--model', 'none')
    assert run('calibrate', *arguments, *options) == 3
    *_, verdict, report = capsys.readouterr().out.strip().splitlines()
    found = json.loads((tmp_path / 'new' / 'validation.json').read_text())
    assert verdict.startswith(f'Verdict: {found["verdict"]}; ')
    assert report == f'Report: {tmp_path / "new" / "report.html"}'
    text = (tmp_path / 'new' / 'report.html').read_text()
    assert found['findings'][0].split(';')[0] in html.unescape(text)


def numbers_of(command):
    """Yield the arguments of a command that take one number."""
    parser = argparse.ArgumentParser()
    command.add_arguments(parser)
    for action in parser._actions:
        if getattr(action.type, '__qualname__', '').startswith('number_in'):
            yield action


@pytest.mark.parametrize('command', COMMANDS, ids=lambda command: command.NAME)
def test_numbers_of_a_command_have_a_range(command):
    """Each accepts an ordinary number and its own default, but neither NaN nor absurd numbers."""
    for action in numbers_of(command):

        def is_taken(text, action=action):
            try:
                action.type(text)
            except argparse.ArgumentTypeError:
                return False
            return True

        assert any(map(is_taken, ('0.5', '1', '5', '100', '4000'))), action.dest
        assert not any(map(is_taken, ('nan', 'x', '-1e30', '1e30'))), action.dest
        if action.default:  # a default of 0 means that no value is given
            assert is_taken(str(action.default)), action.dest


def test_the_arguments_of_the_process_are_those_of_the_command(monkeypatch, capsys):
    monkeypatch.setattr(sys, 'argv', ['fluoro-calib', '--version'])
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == 0 and 'fluoro_calib_ros' in capsys.readouterr().out


def test_version(capsys):
    assert run('--version') == 0
    assert re.match(r'fluoro_calib_ros \S.* \(Python 3\.\d+\.\d+', capsys.readouterr().out)


def test_version_needs_no_library():
    code = 'import sys; from fluoro_calib_ros.report import versions; versions.versions()'
    code += '; print(*sys.modules)'
    loaded = subprocess.check_output([sys.executable, '-c', code], text=True).split()
    assert not {'numpy', 'matplotlib', 'jinja2'} & set(loaded)


def test_output_of_any_name_is_told_on_any_terminal(result, tmp_path, monkeypatch, capsys):
    """The result is written; a terminal that cannot show its name gets it escaped."""

    def shown(*words):
        terminal = io.TextIOWrapper(io.BytesIO(), encoding='ascii')
        with monkeypatch.context() as patch:
            patch.setattr(sys, 'stdout', terminal)
            assert run(*words) == 0
        terminal.flush()
        assert capsys.readouterr().err == ''
        return terminal.buffer.getvalue().decode('ascii')

    points = tmp_path / 'points.csv'
    points.write_text('fluoroscope,u,v\na,500,500\n')
    words = ('correct', points, '--calibration', result, '--out', tmp_path / 'Größe.csv')
    assert 'Gr\\xf6\\xdfe.csv' in shown(*words)
    told = json.loads(shown(*words, '--json'))
    assert told['out'] == str(tmp_path / 'Größe.csv')


def test_angles_of_images_are_not_ignored_for_image_points(result, tmp_path, capsys):
    points = tmp_path / 'points.csv'
    points.write_text('fluoroscope,u,v\na,500,500\n')
    words = ('correct', points, '--calibration', result, '--out', tmp_path / 'corrected.csv')
    assert run(*words, '--angles', tmp_path / 'angles.csv') == 1
    assert 'a column angle_deg' in capsys.readouterr().err
    assert not (tmp_path / 'corrected.csv').exists()


def test_orient_names_exposures_that_are_not_in_the_capture(rig, result, tmp_path, capsys):
    folder = shutil.copytree(result, tmp_path / 'result')
    words = ('orient', rig / 'calibration', '--phantom', rig / 'phantom.csv')
    capsys.readouterr()
    assert run(*words, '--calibration', folder, '--exposures', '1,98-99') == 1
    assert 'no fluoroscope has the exposures 98, 99' in capsys.readouterr().err


@pytest.mark.parametrize('command', ['adjust', 'orient', 'bodies', 'heal'])
def test_decisions_are_inputs_of_every_command(command):
    """No command overwrites a file that it has read, whichever option names it."""
    words = [command, 'source', '--calibration', 'c', '--decisions', 'doubtful.csv']
    words += {
        'adjust': ['--phantom', 'p.csv', '--out', 'out'],
        'orient': ['--phantom', 'p.csv'],
        'bodies': ['--bodies', 'b.csv', '--joints', 'j.toml', '--neutral', 'n', '--out', 'out'],
        'heal': ['--orientation', 'o.npz', '--out', 'out'],
    }[command]
    found = {str(path) for path in input_paths(make_parser(command).parse_args(words))}
    given = {word for word in words[1:] if not word.startswith('--')}
    assert found == given - {'out'}


def test_adjust_names_exposures_that_the_calibration_has_used(rig, result, tmp_path, capsys):
    words = ('--phantom', rig / 'phantom.csv', '--calibration', result, '--out', tmp_path / 'out')
    for source, is_new in ((rig / 'calibration', False), (rig / 'test', True)):
        capsys.readouterr()
        run('adjust', source, *words, '--json')
        printed = capsys.readouterr()
        assert json.loads(printed.out)['out_of_sample'] is is_new
        assert ('were used for the calibration' in printed.err) is not is_new


def test_adjust_does_not_overwrite_its_decisions(rig, result, tmp_path, capsys):
    """The table of doubtful points of an earlier adjustment is a part of its folder."""
    out = tmp_path / 'out'
    words = ('adjust', rig / 'test', '--phantom', rig / 'phantom.csv', '--calibration', result)
    assert run(*words, '--out', out, '--exit-zero') == 0
    (out / 'doubtful.csv').write_text('fluoroscope,exposure,target_id,decision\n')
    decided = (*words, '--decisions', out / 'doubtful.csv')
    assert run(*decided, '--out', out) == 1
    assert 'would be overwritten' in capsys.readouterr().err
