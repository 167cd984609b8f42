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
    phantom = LaunchConfiguration('phantom')
    return LaunchDescription(
        [
            DeclareLaunchArgument('bag', description='bag to play: a folder or an MCAP file'),
            DeclareLaunchArgument(
                'bag_topics',
                default_value='',
                description='topics to play, e.g. [/a/target_observations] (default: all)',
            ),
            DeclareLaunchArgument(
                'bag_rate', default_value='', description='speed relative to the recording'
            ),
            DeclareLaunchArgument(
                'phantom',
                default_value='',
                description='phantom.csv; empty: use saved calibrations, do not calibrate',
            ),
            IncludeLaunchDescription(
                nodes,
                launch_arguments={
                    'bag': LaunchConfiguration('bag'),
                    'bag_topics': LaunchConfiguration('bag_topics'),
                    'bag_rate': LaunchConfiguration('bag_rate'),
                    'phantom': phantom,
                    'calibration': NotEqualsSubstitution(phantom, ''),
                }.items(),
            ),
        ]
    )
