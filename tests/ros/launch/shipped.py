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

"""The shipped launch file with arguments, as part of a launch test."""

import os
from pathlib import Path

from launch import LaunchDescription
from launch.actions import IncludeLaunchDescription, SetEnvironmentVariable
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch_testing.actions import ReadyToTest

ROOT = Path(__file__).resolve().parents[3]
BAGS = ROOT / 'bags'
FOLDER = Path(os.environ['LAUNCH_TEST_FOLDER'])  # of files that a test writes
DEADLINE = 60.0  # seconds


def rig(**arguments):
    """Return a LaunchDescription of the shipped launch file, whose tests begin at once."""
    source = PythonLaunchDescriptionSource(str(ROOT / 'launch' / 'fluoro_calib.launch.py'))
    return LaunchDescription(
        [
            SetEnvironmentVariable('PYTHONUNBUFFERED', '1'),
            IncludeLaunchDescription(
                source, launch_arguments=[(k, str(v)) for k, v in arguments.items()]
            ),
            ReadyToTest(),
        ]
    )
