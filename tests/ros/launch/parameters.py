# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Parameters of the launched nodes: from rig.toml and from arguments, which take precedence.

The nodes stay unconfigured, as for a lifecycle manager, and are asked for their parameters.
"""

import shutil
import time
import unittest
from pathlib import Path

import launch_testing
import rclpy
from rclpy.parameter import parameter_value_to_python
from rclpy.parameter_client import AsyncParameterClient
from shipped import BAGS, DEADLINE, FOLDER, rig

WITH_NAMES = ('extraction_node', 'calibration_node', 'correction_node', 'image_node')
WITH_ANGLE = (*WITH_NAMES, 'recorder_node')
WITH_PHANTOM = ('extraction_node', 'calibration_node')
RIG = """\
fluoroscopes = ["front", "side"]
phantom = "cube.csv"
angle_joint = {front = "x", side = "y"}
angle_max_age = 2
"""
PHANTOM = FOLDER / 'other.csv'
CASES = {  # arguments, and expected values: fluoroscopes, phantom, joint, maximum age
    'rig': (
        {'rig': FOLDER / 'rig.toml'},
        ['front', 'side'],
        FOLDER / 'cube.csv',
        'front:x,side:y',
        2.0,
    ),
    'rig and arguments': (
        {'rig': FOLDER / 'rig.toml', 'phantom': PHANTOM, 'angle_joint': 'front:u,side:v'},
        ['front', 'side'],
        PHANTOM,
        'front:u,side:v',
        2.0,
    ),
    'no rig and no joint': ({'phantom': PHANTOM}, ['a', 'b'], PHANTOM, '', 0.5),
}


@launch_testing.parametrize('case', list(CASES))
def generate_test_description(case):
    """Start all nodes that use the joint angle, and the reconstruction node, which does not."""
    (FOLDER / 'rig.toml').write_text(RIG)
    for name in ('cube.csv', PHANTOM.name):
        shutil.copy(BAGS / 'phantom.csv', FOLDER / name)
    given, fluoroscopes, phantom, angle_joint, angle_max_age = CASES[case]
    description = rig(
        from_images='true',
        images='true',
        record=FOLDER / case,
        calibration_directory=FOLDER / 'calibrations',
        autostart='false',
        **given,
    )
    expected = {
        'fluoroscopes': fluoroscopes,
        'phantom': str(phantom),
        'angle_joint': angle_joint,
        'angle_max_age': angle_max_age,
    }
    return description, {'expected': expected}


class TestNodes(unittest.TestCase):
    """Tests that run while the nodes are up."""

    @classmethod
    def setUpClass(cls):
        """Create a node that queries the others."""
        rclpy.init(args=[])
        cls.node = rclpy.create_node('asker')

    @classmethod
    def tearDownClass(cls):
        """Destroy the querying node."""
        cls.node.destroy_node()
        rclpy.shutdown()

    def value(self, node, name):
        """Return the value of a parameter; ask again, since the first answer may be lost."""
        client = AsyncParameterClient(self.node, node)
        end = time.monotonic() + DEADLINE
        while time.monotonic() < end:
            if client.wait_for_services(1.0):
                answer = client.get_parameters([name])
                rclpy.spin_until_future_complete(self.node, answer, timeout_sec=1.0)
                if answer.done():
                    return parameter_value_to_python(answer.result().values[0])
        return self.fail(f'{node} did not answer')

    def test_parameters_reach_every_node_that_needs_them(self, expected):
        """The joint also reaches the recorder node."""
        for name, nodes in (
            ('fluoroscopes', (*WITH_NAMES, 'reconstruction_node')),
            ('phantom', WITH_PHANTOM),
            ('angle_joint', WITH_ANGLE),
            ('angle_max_age', WITH_NAMES),
        ):
            for node in nodes:
                with self.subTest(node=node, parameter=name):
                    self.assertEqual(self.value(node, name), expected[name])


@launch_testing.post_shutdown_test()
class TestEnd(unittest.TestCase):
    """Tests that run after launch has interrupted the nodes."""

    def test_all_nodes_end_cleanly(self, proc_info):
        """Every exit status is 0."""
        launch_testing.asserts.assertExitCodes(proc_info)

    def test_reconstruction_node_is_given_no_joint(self, proc_info):
        """The last parameter file of the node is the one that launch wrote from the arguments."""
        (command,) = (one.cmd for one in proc_info if 'reconstruction_node' in one.process_name)
        given = Path(command[-1]).read_text()
        self.assertIn('calibration_directory', given)
        self.assertNotIn('angle_joint', given)
