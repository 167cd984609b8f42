# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""A rig with its own fluoroscopes, live: all nodes, RViz, and a bag if wanted.

ros2 launch fluoro_calib_ros rig.launch.py phantom:=/path/to/phantom.csv record:=/path/to/new_bag
ros2 launch fluoro_calib_ros rig.launch.py --show-args

All arguments of fluoro_calib.launch.py are passed on. RViz is started where it is installed.
"""

import os

from ament_index_python.packages import get_package_share_directory
from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, IncludeLaunchDescription
from launch.launch_description_sources import PythonLaunchDescriptionSource


def generate_launch_description():
    """Return the graph with RViz, and with a phantom that has to be given."""
    share = get_package_share_directory('fluoro_calib_ros')
    nodes = PythonLaunchDescriptionSource(os.path.join(share, 'launch', 'fluoro_calib.launch.py'))
    return LaunchDescription(
        [
            DeclareLaunchArgument(
                'phantom',
                description='phantom.csv with the surveyed coordinates of the beads [mm]',
            ),
            DeclareLaunchArgument(
                'rviz',
                default_value='auto',
                choices=['true', 'false', 'auto'],
                description='false: without RViz; auto: where rviz2 is installed',
            ),
            IncludeLaunchDescription(nodes),  # which sees these arguments
        ]
    )
