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
