# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The shipped launch files on real ROS launch, where it is installed: tests/ros/launch/."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from ros_graph import BAGS, ROOT

FOLDER = Path(__file__).parent / 'launch'
FILES = sorted(FOLDER.glob('*.py'))
LAUNCH_RIG = """\
import sys
from launch import LaunchService
from shipped import rig
service = LaunchService()
service.include_launch_description(rig('rig', **dict(a.split(':=') for a in sys.argv[1:])))
sys.exit(service.run())
"""


@pytest.fixture
def run(ros, tmp_path, monkeypatch):
    """Return a function that runs Python with the modules of tests/ros/launch/ on its path."""
    for module in ('launch_ros', 'launch_testing'):
        pytest.importorskip(module, reason=f'{module} is not installed: it has no wheel')
    paths = f'{FOLDER}{os.pathsep}{ROOT}'
    monkeypatch.setenv('PYTHONPATH', paths, prepend=os.pathsep)
    monkeypatch.setenv('LAUNCH_TEST_FOLDER', str(tmp_path))
    monkeypatch.setenv('ROS_HOME', str(tmp_path / 'ros_home'))

    def run(*arguments):
        done = subprocess.run(
            [sys.executable, *arguments], cwd=ROOT, capture_output=True, text=True
        )
        return done.returncode, done.stdout + done.stderr

    return run


@pytest.mark.parametrize(
    'path', [p for p in FILES if p.name != 'shipped.py'], ids=lambda path: path.stem
)
def test_launch(run, path):
    status, output = run('-m', 'launch_testing.launch_test', str(path))
    assert not status, output[-6000:]


@pytest.mark.parametrize(
    'arguments, sentence',
    [
        (['rig:=RIG'], 'RIG, key angle_joint: expected a joint, such as "carm"'),
        (['rviz:=true'], 'rviz:=true, but rviz2 is not installed'),
        (['simulate:=true', 'rate:=abc'], 'rate:=abc is not a number'),
        (['fluoroscopes:=[a'], 'fluoroscopes:=[a is not YAML'),
        (['params_file:=RIG/none'], 'params_file:=RIG/none: there is no such file'),
    ],
)
def test_wrong_argument_ends_launch_before_a_node_is_started(run, tmp_path, arguments, sentence):
    rig = tmp_path / 'rig.toml'
    rig.write_text('angle_joint = 3')
    given = [f'phantom:={BAGS}/phantom.csv', *(a.replace('RIG', str(rig)) for a in arguments)]
    status, output = run('-c', LAUNCH_RIG, *given)
    assert status == 1, output
    assert sentence.replace('RIG', str(rig)) in output
    assert 'Traceback' not in output
    assert 'process started' not in output


def test_launch_fails_where_a_node_cannot_start(run, tmp_path):
    status, output = run('-c', LAUNCH_RIG, f'phantom:={tmp_path}/none.csv', 'rviz:=false')
    assert status == 1, output
    assert 'none.csv: there is no such file' in output
    assert re.search(r'calibration_node-\d+ could not start', output)
    assert re.findall(r'exit code \d+', output) == ['exit code 1']
    assert output.count('process has finished cleanly') == 2, output  # the other nodes
