# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Replay a bag with the recorded time, which the player publishes."""

import time
import unittest

import launch_testing
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from shipped import BAGS, DEADLINE, FOLDER, rig

NODES = {'calibration_node', 'correction_node', 'reconstruction_node'}


def generate_test_description():
    """Start the nodes and the player."""
    return rig(
        'replay',
        phantom=BAGS / 'phantom.csv',
        calibration_directory=FOLDER / 'calibrations',
        bag=BAGS / 'calibration',
        use_sim_time='true',
    )


class TestNodes(unittest.TestCase):
    """Tests that run while the bag is played."""

    def test_diagnostics_of_all_nodes_have_the_time_of_the_recording(self):
        """No node falls silent or reports that its clock has stopped."""
        stamps = {}
        faults = []

        def on_diagnostics(message):
            for status in message.status:
                node = status.name.partition(':')[0].strip('/')
                stamps.setdefault(node, set()).add(message.header.stamp.sec)
                if status.hardware_id == 'clock' and stamps[node] - {0}:
                    faults.append(status.message)

        rclpy.init(args=[])
        node = rclpy.create_node('listener')
        node.create_subscription(DiagnosticArray, '/diagnostics', on_diagnostics, 50)
        end = time.monotonic() + DEADLINE
        while time.monotonic() < end and not all(len(stamps.get(n, ())) > 3 for n in NODES):
            rclpy.spin_once(node, timeout_sec=0.5)
        node.destroy_node()
        rclpy.shutdown()
        self.assertTrue(stamps.keys() >= NODES, stamps)
        for name in NODES:
            self.assertLess(max(stamps[name]), time.time() - 86400, stamps)
            self.assertGreater(len(stamps[name]), 3, stamps)
        self.assertEqual(faults, [])


@launch_testing.post_shutdown_test()
class TestEnd(unittest.TestCase):
    """Tests that run after launch has interrupted the nodes."""

    def test_all_nodes_end_cleanly(self, proc_info):
        """Every exit status is 0."""
        launch_testing.asserts.assertExitCodes(proc_info)
