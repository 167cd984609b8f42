# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""A phantom that does not exist: one sentence, and launch ends by itself."""

import unittest

import launch_testing
from shipped import DEADLINE, FOLDER, rig


def generate_test_description():
    """Start a rig whose calibration node cannot start."""
    return rig(phantom=FOLDER / 'none.csv', calibration_directory=FOLDER / 'calibrations')


class TestStart(unittest.TestCase):
    """While the others run."""

    def test_the_reason_is_given(self, proc_output, proc_info):
        """In one sentence; the node ends."""
        proc_output.assertWaitFor('none.csv: there is no such', timeout=DEADLINE, stream='stderr')
        proc_info.assertWaitForShutdown(process='calibration_node', timeout=DEADLINE)


@launch_testing.post_shutdown_test()
class TestEnd(unittest.TestCase):
    """After launch has ended."""

    def test_calibration_node_failed_and_the_others_did_not(self, proc_info):
        """Exit status 1, and 0 of those that were interrupted."""
        for process in proc_info:
            expected = 1 if 'calibration_node' in process.process_name else 0
            assert process.returncode == expected, process.process_name
