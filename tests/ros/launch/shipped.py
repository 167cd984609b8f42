# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The shipped launch files with arguments, for use in a launch test."""

import os
from pathlib import Path

from launch import LaunchDescription
from launch.actions import IncludeLaunchDescription, SetEnvironmentVariable
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch_testing.actions import ReadyToTest

ROOT = Path(__file__).resolve().parents[3]
BAGS = ROOT / 'bags'
FOLDER = Path(os.environ['LAUNCH_TEST_FOLDER'])  # for files written by a test
DEADLINE = 60.0  # seconds


def rig(name='fluoro_calib', /, **arguments):
    """Return a LaunchDescription of a shipped launch file whose tests begin immediately."""
    source = PythonLaunchDescriptionSource(str(ROOT / 'launch' / f'{name}.launch.py'))
    return LaunchDescription(
        [
            SetEnvironmentVariable('PYTHONUNBUFFERED', '1'),
            IncludeLaunchDescription(
                source, launch_arguments=[(k, str(v)) for k, v in arguments.items()]
            ),
            ReadyToTest(),
        ]
    )
