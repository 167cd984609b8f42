# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""RViz starts with the shipped configuration and the rig frame.

RViz needs a display, so a program of the same name that prints its arguments replaces it.
"""

import os
import unittest
from pathlib import Path

from shipped import DEADLINE, FOLDER, rig


def generate_test_description():
    """Start a rig without a calibration node, paused, with the replacement for rviz2."""
    prefix = FOLDER / 'prefix'
    program = prefix / 'lib' / 'rviz2' / 'rviz2'
    index = prefix / 'share' / 'ament_index' / 'resource_index' / 'packages' / 'rviz2'
    for path in (program, index):
        path.parent.mkdir(parents=True)
        path.touch()
    program.write_text('#!/bin/sh\necho "rviz2 $@"\n')
    program.chmod(0o755)
    os.environ['AMENT_PREFIX_PATH'] = f'{prefix}{os.pathsep}{os.environ["AMENT_PREFIX_PATH"]}'
    return rig(calibration='false', autostart='false', rviz='true', rig_frame='table')


class TestRviz(unittest.TestCase):
    """Tests that run while the nodes are up."""

    def test_arguments(self, proc_output):
        """The configuration exists, and the fixed frame is that of the rig."""
        proc_output.assertWaitFor('-f table', timeout=DEADLINE, stream='stdout')
        lines = b''.join(output.text for output in proc_output).decode().splitlines()
        line = next(line for line in lines if line.startswith('rviz2 '))
        assert Path(line.split()[2]).is_file() and line.split()[2].endswith('rig.rviz'), line
