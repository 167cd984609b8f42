# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The examples run, and they import exactly the public interface."""

import contextlib
import io
import json
import pathlib
import re
import runpy
import subprocess
import sys
from dataclasses import replace

import matplotlib
import pytest

import fluoro_calib_ros as fc
from fluoro_calib_ros import api
from fluoro_calib_ros.io.bags.writer import write_bag

ROOT = pathlib.Path(__file__).resolve().parents[2]
EXAMPLES = ROOT / 'examples'


@pytest.fixture(scope='module')
def place(tmp_path_factory):
    """Folder with bags/ in which examples run; its calibration bag is a short one."""
    folder = tmp_path_factory.mktemp('examples')
    bags = folder / 'bags'
    bags.mkdir()
    for name in ('phantom.csv', 'tracking'):
        (bags / name).symlink_to(ROOT / 'bags' / name)
    frames = api.read_source(ROOT / 'bags' / 'calibration', collect='all').frames
    write_bag(bags / 'calibration', {name: of[:8] for name, of in frames.items()})
    return folder


def example(name, *arguments, place=ROOT):
    """Run an example as a program in a folder with bags/ and return what it prints."""
    said = io.StringIO()
    with pytest.MonkeyPatch.context() as patch, contextlib.redirect_stdout(said):
        patch.chdir(place)
        patch.setattr(sys, 'argv', [name, *map(str, arguments)])
        runpy.run_path(str(EXAMPLES / name), run_name='__main__')
    return said.getvalue()


def test_paths_are_taken_and_shown_in_a_line(place):
    recording = fc.read_source(ROOT / 'bags' / 'calibration')
    assert repr(recording) == '<Recording a: 15 frames, b: 15 frames>'
    options = fc.CalibrationOptions(model='none', max_iterations=1)
    outcome = fc.calibrate(place / 'bags' / 'calibration', place / 'bags' / 'phantom.csv', options)
    assert repr(outcome) == '<CalibrationOutcome of a, b: not validated>'
    assert 'RMSE u after [px]' in outcome.summary()
    assert outcome._repr_html_() == f'<pre>{outcome.summary()}</pre>'
    for name, cause in (
        ('a', 'the model none corrects nothing'),
        ('c', 'there is no calibration'),
    ):
        with pytest.raises(fc.DataError, match=cause):
            outcome.plot(name)
    assert dir(fc) == sorted(fc.__all__)


@pytest.mark.long
def test_progress_of_a_calibration_is_told_and_may_stop_it(place):
    recording = fc.read_source(place / 'bags' / 'calibration')
    phantom = ROOT / 'bags' / 'phantom.csv'
    told = []
    few = [replace(f, target_id=f.target_id[::3], uv=f.uv[::3]) for f in recording.frames['a']]
    fc.calibrate(
        {'a': few},
        phantom,
        fc.CalibrationOptions(model='none'),
        validated=True,
        progress=lambda *step: told.append(step),
    )
    rounds = [step for step in told if step[2] == 0]
    assert rounds[0][0].startswith('a: round  1  RMSE a: ')
    assert [done for _, done, _ in rounds] == list(range(1, len(rounds) + 1))
    steps = told[len(rounds) :]
    assert [done for _, done, _ in steps] == list(range(len(steps)))
    assert {total for _, _, total in steps} == {len(steps)}

    def stop(*_):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fc.calibrate(recording.frames, phantom, progress=stop)


def test_public_names_are_those_of_the_api():
    assert sorted(fc.__all__) == sorted(api.__all__)
    for name in fc.__all__:
        assert getattr(fc, name) is getattr(api, name)
    with pytest.raises(AttributeError, match='no attribute'):
        fc.no_such_name  # noqa: B018


def test_public_interface_needs_no_ros_and_nothing_slow():
    code = 'import sys; import fluoro_calib_ros.api; print(*sys.modules)'
    done = subprocess.run([sys.executable, '-c', code], cwd=ROOT, capture_output=True, text=True)
    loaded = done.stdout.split()
    assert 'fluoro_calib_ros.api' in loaded, done.stderr
    unwanted = {'rclpy', 'fluoro_calib_msgs', 'scipy.stats', 'scipy.signal', 'sklearn'}
    assert not unwanted & set(loaded)


def test_every_example_is_listed_and_tested():
    scripts = {path.name for path in EXAMPLES.glob('*.py')}
    readme = (EXAMPLES / 'README.md').read_text()
    assert scripts == {name for name in scripts if f'`{name}`' in readme}
    tests = pathlib.Path(__file__).read_text()
    of_nodes = (ROOT / 'tests' / 'ros' / 'test_motion_tracking.py').read_text()
    for name in scripts:
        assert f"example('{name}'" in tests or f"EXAMPLES / '{name}'" in of_nodes, name


@pytest.mark.long
def test_notebook_runs_and_prints_what_it_shows(monkeypatch, capsys):
    def short(source, **settings):
        recording = api.read_source(source, **settings)
        count = 8 if source.name == 'calibration' else 30
        frames = {name: of[:count] for name, of in recording.frames.items()}
        return replace(recording, frames=frames)

    matplotlib.use('Agg')
    monkeypatch.chdir(EXAMPLES)
    monkeypatch.setattr(fc, 'read_source', short)
    cells = json.loads((EXAMPLES / 'calibration.ipynb').read_text())['cells']
    names: dict = {}
    shown = ''
    for cell in cells:
        if cell['cell_type'] == 'code':
            exec(''.join(cell['source']), names)
            texts = [o['text'] for o in cell['outputs'] if o['output_type'] == 'stream']
            shown += ''.join(line for text in texts for line in text)
    said = capsys.readouterr().out
    assert said.split(':')[0] == 'a' and re.findall('[a-z]+', said) == re.findall('[a-z]+', shown)
    assert names['reconstruction'].status_counts['OK'] > 700


@pytest.mark.long
def test_calibrate_a_bag_then_reconstruct(tmp_path, place):
    said = example('calibrate_bag.py', tmp_path / 'result', place=place)
    assert 'verdict: pass' in said
    assert (tmp_path / 'result' / 'validation.json').is_file()
    said = example('points_in_space.py', tmp_path / 'result', place=place)
    assert '360 exposures' in said
    assert 'target 1001: ' in said


@pytest.mark.long
def test_out_of_sample_test_of_a_calibration(tmp_path):
    said = example('test_a_calibration.py', tmp_path / 'rig').splitlines()
    beads, survey = (float(line.split()[-2]) for line in said)
    assert beads < 0.6 * survey


@pytest.mark.long
def test_own_regressor_is_saved_as_a_lookup_grid(tmp_path, place):
    said = example('own_regressor.py', tmp_path / 'result', place=place)
    assert said.startswith('lookup: RMSE 0.')
