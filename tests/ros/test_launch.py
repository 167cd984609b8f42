# Copyright 2026 fluoro_calib_ros maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""The shipped launch file on real launch, where that is installed: tests/ros/launch/."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from ros_graph import ROOT

FILES = sorted(Path(__file__).parent.glob('launch/*.py'))


@pytest.mark.parametrize(
    'path', [p for p in FILES if p.name != 'shipped.py'], ids=lambda path: path.stem
)
def test_launch(ros, path, tmp_path, monkeypatch):
    for module in ('launch_ros', 'launch_testing'):
        pytest.importorskip(module, reason=f'{module} is not installed: it has no wheel')
    monkeypatch.setenv('PYTHONPATH', f'{path.parent}{os.pathsep}{ROOT}', prepend=os.pathsep)
    monkeypatch.setenv('LAUNCH_TEST_FOLDER', str(tmp_path))
    monkeypatch.setenv('ROS_HOME', str(tmp_path / 'ros_home'))
    done = subprocess.run(
        [sys.executable, '-m', 'launch_testing.launch_test', str(path)],
        cwd=ROOT,
        capture_output=True,
        text=True,
    )
    assert not done.returncode, (done.stdout + done.stderr)[-6000:]
