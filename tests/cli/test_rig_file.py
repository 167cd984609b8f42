# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""rig.toml, names of arguments, completion and colours of the command line."""

import subprocess
from pathlib import Path

import pytest
from rigs import run

from fluoro_calib_ros.cli import COMMANDS, main, make_parser
from fluoro_calib_ros.cli.arguments import angle_options
from fluoro_calib_ros.cli.rig import find_rig
from fluoro_calib_ros.errors import DataError
from fluoro_calib_ros.io.rig_file import RigFile, read_rig_file
from fluoro_calib_ros.report import html as html_report


@pytest.fixture
def rig(tmp_path):
    def write(text, name='rig.toml'):
        path = tmp_path / name
        path.write_text(text)
        return path

    return write


JOINTS = """
fluoroscopes = ["a", "b"]
angle_joint = {a = "frontal", b = "lateral"}
angle_max_age = 2
"""


def parsed(words, rig_file=None):
    return make_parser(words[0], rig_file).parse_args(words)


WHOLE = """
fluoroscopes = ["a", "b"]
image_size = [1024, 1000]
phantom = "cube/phantom.csv"
units = "cm"
phantom_sd = 0.05
calibration = "result"
"""


def test_rig_file_makes_flags_unnecessary(rig, tmp_path):
    content = read_rig_file(rig(WHOLE))
    arguments = parsed(['calibrate', 'points.csv'], content)
    assert arguments.fluoroscopes == ['a', 'b'] and arguments.image_size == (1024, 1000)
    assert arguments.phantom == tmp_path / 'cube' / 'phantom.csv'
    assert arguments.out == tmp_path / 'result'
    assert parsed(['orient', 'capture'], content).calibration == tmp_path / 'result'
    assert (arguments.units, arguments.phantom_sd) == ('cm', 0.05)
    out = ['convert', 'result', '--to', 'mayacam2', '--out', 'cameras']
    assert parsed(out, content).units is None  # units would apply to its output
    flags = ['calibrate', 'points.csv', '--out', 'x', '--fluoroscopes', 'c']
    arguments = parsed(flags, content)
    assert arguments.out == Path('x') and arguments.fluoroscopes == ['c']


def test_a_rig_file_is_read_by_commands_that_use_it_only(rig, monkeypatch):
    monkeypatch.chdir(rig('no = rig').parent)
    assert find_rig(['simulate', '--out', 'x'], 'simulate') is None
    with pytest.raises(DataError):
        find_rig(['calibrate', 'points.csv'], 'calibrate')


READ_A_BAG = {
    'extract': ['bag', '--fluoroscope', 'a', '--out', 'o.csv'],
    'calibrate': ['bag', '--phantom', 'p.csv', '--out', 'o'],
    'adjust': ['bag', '--phantom', 'p.csv', '--calibration', 'c', '--out', 'o'],
    'validate': ['c', '--source', 'bag'],
    'survey': ['bag', '--phantom', 'p.csv', '--out', 'o.csv'],
    'orient': ['bag', '--phantom', 'p.csv', '--calibration', 'c'],
    'reconstruct': ['bag', '--calibration', 'c', '--out', 'o.csv'],
    'bodies': ['bag', '--bodies', 'b.csv', '--calibration', 'c', '--out', 'o'],
    'heal': ['bag', '--calibration', 'c', '--out', 'o'],
    'convert': ['bag', '--to', 'observations', '--out', 'o.csv'],
}


@pytest.mark.parametrize('command', READ_A_BAG)
def test_joints_of_the_rig_give_the_angle_in_every_command_that_reads_a_bag(rig, command):
    content = read_rig_file(rig(JOINTS))
    words = [command, *READ_A_BAG[command]]
    options = angle_options(parsed(words, content))
    assert options.joints(['a', 'b']) == {'a': 'frontal', 'b': 'lateral'}
    assert options.joints(['a']) == {'a': 'frontal'}  # a recording of one of the fluoroscopes
    assert options.angle_max_age == 2.0
    assert angle_options(parsed([*words, '--angle-max-age', '3'], content)).angle_max_age == 3.0
    assert angle_options(parsed(words)).angle_max_age == 0.5
    flag = angle_options(parsed([*words, '--angle-joint', 'carm'], content))
    assert flag.joints(['a', 'b']) == dict.fromkeys('ab', 'carm') and not flag.of_rig
    assert not angle_options(parsed([*words, '--angle-joint', ''], content)).joints(['a'])
    assert not angle_options(parsed(words)).joints(['a'])


def test_one_joint_of_the_rig_is_that_of_all_fluoroscopes(rig):
    content = read_rig_file(rig('angle_joint = "carm"'))
    assert content.angle_joint == 'carm'
    assert read_rig_file(rig('angle_joint = "a:x,b:y"')).angle_joint == 'a:x,b:y'


def test_what_the_rig_file_does_not_say_is_required_as_before(rig, capsys):
    with pytest.raises(SystemExit):
        parsed(['calibrate', 'points.csv'], RigFile(Path('rig.toml')))
    assert '--phantom, --out' in capsys.readouterr().err


def test_what_the_file_says_about_the_rig_is_in_the_report(rig, tmp_path, monkeypatch):
    monkeypatch.setattr(html_report, '_figures', lambda *_: [])
    folder = tmp_path / 'data'
    assert run('simulate', '--out', folder, '--exposures', 5, '--seconds', 0.05) == 0
    file = rig('[about]\nsite = "<gait> laboratory"\nkV = 80\n')
    calibrate = ('calibrate', folder / 'calibration', '--phantom', folder / 'phantom.csv')
    fast = ('--model', 'none', '--fast', '--rig', file, '--out', tmp_path / 'result')
    assert run(*calibrate, *fast) == 0 and run('report', tmp_path / 'result') == 0
    text = (tmp_path / 'result' / 'report.html').read_text()
    for key, value in (('site', '&lt;gait&gt; laboratory'), ('kV', '80')):
        assert f'<tr><td>{key}</td><td class="text">{value}</td></tr>' in text
    assert str(folder / 'phantom.csv') in text


@pytest.mark.parametrize(
    'text, cause',
    [
        ('about = "x"', 'about: expected a table'),
        ('[about]\nsite = ["x"]', 'about.site: expected a text or a number'),
        (f'[about]\nsite = "{"x" * 1000}"', 'about.site: expected a text or a number'),
        (
            'phantm = "p.csv"',
            'key phantm: unknown, expected one of fluoroscopes, image_size, phantom',
        ),
        ('image_size = [1024]', 'key image_size: expected width and height'),
        ('image_size = "1024x1024"', 'key image_size: expected width and height'),
        ('image_size = [true, 5]', 'key image_size: expected width and height'),
        ('fluoroscopes = ["a", "a"]', 'key fluoroscopes: expected a list of different names'),
        ('fluoroscopes = "a"', 'key fluoroscopes: expected a list of different names'),
        ('phantom = 3', 'key phantom: expected a path'),
        ('units = "inch"', 'key units: expected "mm", "cm" or "m"'),
        ('units = []', 'key units: expected "mm", "cm" or "m"'),
        ('phantom_sd = 0', 'key phantom_sd: expected a standard deviation [mm]'),
        ('phantom_sd = true', 'key phantom_sd: expected a standard deviation [mm]'),
        ('phantom_sd = nan', 'key phantom_sd: expected a standard deviation [mm]'),
        ('phantom = ', 'TOML'),
        ('angle_joint = 3', 'key angle_joint: expected a joint, such as "carm", or one for each'),
        ('angle_joint = ""', 'key angle_joint: expected a joint, such as'),
        ('angle_joint = "a,b"', 'key angle_joint: expected a joint, such as'),
        ('angle_max_age = -1', 'key angle_max_age: expected a time [s], such as 0.5'),
        ('angle_max_age = "1"', 'key angle_max_age: expected a time [s]'),
        ('angle_max_age = true', 'key angle_max_age: expected a time [s]'),
        ('angle_max_age = nan', 'key angle_max_age: expected a time [s]'),
        ('angle_joint = {}', 'key angle_joint: expected a joint, such as'),
        ('angle_joint = {a = 1}', 'key angle_joint: expected a joint, such as'),
        ('angle_joint = {a = "x:y"}', 'key angle_joint: expected a joint, such as'),
        (
            'fluoroscopes = ["a", "b"]\nangle_joint = {c = "x"}',
            "key angle_joint: there is no fluoroscope 'c', only a, b",
        ),
        ('a = ' + 5000 * '[', 'TOML'),
    ],
)
def test_wrong_rig_file_is_refused_with_file_and_key(rig, text, cause):
    path = rig(text)
    with pytest.raises(DataError) as refusal:
        read_rig_file(path)
    assert str(refusal.value).startswith(str(path)) and cause in str(refusal.value)


def test_rig_file_of_the_working_directory_and_of_the_flag(rig, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    rig('calibration = "nowhere"')
    other = rig('calibration = "elsewhere"', 'other.toml')
    for words, name in (['report'], 'nowhere'), (['report', '--rig', str(other)], 'elsewhere'):
        with pytest.raises(SystemExit) as ended:
            main(words)
        error = capsys.readouterr().err
        assert ended.value.code == 1 and name in error
        assert error.startswith('defaults of ')
    with pytest.raises(SystemExit):
        main(['report', '--rig', 'missing.toml'])
    assert 'missing.toml: there is no such file' in capsys.readouterr().err


def test_result_folder_is_given_by_place_or_by_flag():
    for words in (['report', 'result'], ['report', '--calibration', 'result']):
        arguments = parsed(words)
        arguments.module.check(arguments, pytest.fail)
        assert arguments.directory == Path('result')
    words = ['correct', 'p.csv', '--calibration', 'r', '--out', 'o.csv']
    for flag in ('--fluoroscope', '--fluoroscopes'):
        assert parsed([*words, flag, 'a']).fluoroscope == 'a'


def test_source_is_the_first_argument_of_every_command():
    parser = make_parser()
    commands = next(a for a in parser._actions if a.dest == 'command').choices
    for module in COMMANDS:
        places = [a for a in commands[module.NAME]._actions if not a.option_strings]
        if places and module.NAME not in (
            'bag',
            'compare',
            'phantom',
            'process',
            'report',
            'validate',
        ):
            assert places[0].metavar == 'SOURCE', module.NAME


def test_completion_script_is_valid_bash(capsys):
    with pytest.raises(SystemExit) as ended:
        main(['--print-completion', 'bash'])
    script = capsys.readouterr().out
    assert ended.value.code == 0 and 'mayacam2' in script
    checked = subprocess.run(['bash', '-n'], input=script, text=True, capture_output=True)
    assert checked.returncode == 0, checked.stderr


def test_shortened_option_names_the_rig_file_too(rig):
    """An abbreviation that argparse accepts must not be ignored."""
    path = rig(WHOLE, 'other.toml')
    assert find_rig(['calibrate', 'points.csv', '--ri', str(path)], 'calibrate').path == path
