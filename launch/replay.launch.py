# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""A recorded bag through all nodes, as on the day of the recording.

ros2 launch fluoro_calib_ros replay.launch.py bag:=/path/to/bag phantom:=/path/to/phantom.csv
ros2 launch fluoro_calib_ros replay.launch.py bag:=/path/to/bag calibration_directory:=result
ros2 launch fluoro_calib_ros replay.launch.py --show-args

All arguments of fluoro_calib.launch.py are passed on. Without a phantom there is no calibration
node: the saved calibrations are used.
"""

import os

from ament_index_python.packages import get_package_share_directory
from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, IncludeLaunchDescription
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import LaunchConfiguration, NotEqualsSubstitution


def generate_launch_description():
    """Return the graph with the player, and with a bag that has to be given."""
    share = get_package_share_directory('fluoro_calib_ros')
    nodes = PythonLaunchDescriptionSource(os.path.join(share, 'launch', 'fluoro_calib.launch.py'))
    phantom = LaunchConfiguration('phantom')  # and all others reach the included file
    return LaunchDescription(
        [
            DeclareLaunchArgument('bag', description='bag to play: a folder or an MCAP file'),
            DeclareLaunchArgument(
                'phantom',
                default_value='',
                description='phantom.csv; empty: use saved calibrations, do not calibrate',
            ),
            IncludeLaunchDescription(
                nodes, launch_arguments=[('calibration', NotEqualsSubstitution(phantom, ''))]
            ),
        ]
    )
