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

"""Parameters that the shipped launch file gives to the nodes, without launch itself."""

import runpy
import sys
import types
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


class Anything:
    """Stands for an action of launch; it keeps what it is made of."""

    def __init__(self, *arguments, **named):
        self.arguments = arguments
        self.named = named


@pytest.fixture
def parameters_of(monkeypatch):
    """Return a function: the parameters of each node, from launch arguments."""
    modules = {
        'launch': ('LaunchDescription',),
        'launch.actions': ('DeclareLaunchArgument', 'OpaqueFunction', 'Shutdown'),
        'launch_ros': (),
        'launch_ros.actions': ('Node', 'SetParameter'),
        'ament_index_python': (),
        'ament_index_python.packages': (),
    }
    for name, classes in modules.items():
        module = types.ModuleType(name)
        for one in classes:
            setattr(module, one, type(one, (Anything,), {}))
        monkeypatch.setitem(sys.modules, name, module)
    packages = sys.modules['ament_index_python.packages']
    packages.get_package_share_directory = lambda _: str(ROOT)
    file = runpy.run_path(str(ROOT / 'launch' / 'fluoro_calib.launch.py'))

    def found(**arguments):
        declared = (*file['PARAMETERS'], *file['SWITCHES'], *file['OTHERS'])
        values = {one.name: one.default for one in declared}
        assert set(arguments) <= set(values)
        context = types.SimpleNamespace(
            launch_configurations={**values, **{k: str(v) for k, v in arguments.items()}}
        )
        nodes = [one for one in file['nodes_of_rig'](context) if 'executable' in one.named]
        return {
            one.named['executable']: {
                name: value
                for given in one.named['parameters'][1:]
                for name, value in given.items()
            }
            for one in nodes
        }

    return found


ALL = {'from_images': 'true', 'images': 'true', 'record': 'folder'}
WITH_ANGLE = ('extraction_node', 'calibration_node', 'correction_node', 'image_node')


def test_joint_reaches_every_node_that_needs_the_angle(parameters_of):
    found = parameters_of(angle_joint='a:frontal,b:lateral', **ALL)
    for node in (*WITH_ANGLE, 'recorder_node'):
        assert found[node]['angle_joint'] == 'a:frontal,b:lateral', node
    assert 'angle_joint' not in found['reconstruction_node']
    for parameters in parameters_of(**ALL).values():
        assert 'angle_joint' not in parameters


def test_rig_file_gives_what_the_arguments_leave_open(parameters_of, tmp_path):
    rig = tmp_path / 'rig.toml'
    rig.write_text(
        'fluoroscopes = ["front", "side"]\nphantom = "cube.csv"\n'
        'angle_joint = {front = "x", side = "y"}\n'
    )
    found = parameters_of(rig=rig, **ALL)
    for node in WITH_ANGLE:
        assert found[node]['angle_joint'] == 'front:x,side:y', node
        assert found[node]['fluoroscopes'] == ['front', 'side'], node
    assert found['calibration_node']['phantom'] == str(tmp_path / 'cube.csv')
    found = parameters_of(rig=rig, angle_joint='carm', phantom='other.csv', **ALL)
    assert found['image_node']['angle_joint'] == 'carm'
    assert found['calibration_node']['phantom'] == 'other.csv'


def test_wrong_rig_file_ends_launch_in_a_sentence(parameters_of, tmp_path):
    rig = tmp_path / 'rig.toml'
    rig.write_text('angle_joint = 3')
    with pytest.raises(RuntimeError, match='key angle_joint: a joint, such as "carm"'):
        parameters_of(rig=rig)
