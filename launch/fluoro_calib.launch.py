"""Calibration, correction and reconstruction of the fluoroscopes of one rig.

ros2 launch fluoro_calib_ros fluoro_calib.launch.py phantom:=/path/to/phantom.csv [namespace:=rig1]
[params_file:=my.yaml] [bag:=recording] [simulate:=true] [images:=true]
"""

import os

from ament_index_python.packages import get_package_share_directory
from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration, PythonExpression
from launch_ros.actions import Node


def generate_launch_description():
    """Nodes of one rig, in one namespace."""
    parameters = os.path.join(
        get_package_share_directory('fluoro_calib_ros'), 'config', 'fluoro_calib.yaml'
    )
    arguments = [
        DeclareLaunchArgument(
            'phantom', description='phantom.csv with the surveyed coordinates of the beads [mm]'
        ),
        DeclareLaunchArgument('namespace', default_value='', description='namespace of the rig'),
        DeclareLaunchArgument(
            'params_file', default_value=parameters, description='parameters of the nodes'
        ),
        DeclareLaunchArgument('bag', default_value='', description='bag to play (default: none)'),
        DeclareLaunchArgument(
            'images', default_value='false', description='true: correct images too'
        ),
        DeclareLaunchArgument(
            'simulate', default_value='false', description='true: with the virtual rig'
        ),
    ]
    namespace = LaunchConfiguration('namespace')
    params_file = LaunchConfiguration('params_file')

    def node(executable, *parameters, condition=None):
        return Node(
            package='fluoro_calib_ros',
            executable=executable,
            namespace=namespace,
            output='screen',
            parameters=[params_file, *parameters],
            condition=condition,
        )

    has_bag = PythonExpression(["'", LaunchConfiguration('bag'), "' != ''"])
    return LaunchDescription(
        arguments
        + [
            node('calibration_node', {'phantom': LaunchConfiguration('phantom')}),
            node('correction_node'),
            node('reconstruction_node'),
            node('image_node', condition=IfCondition(LaunchConfiguration('images'))),
            node(
                'player_node',
                {'bag': LaunchConfiguration('bag'), 'wait_for_readers': 2},
                condition=IfCondition(has_bag),
            ),
            node('simulator_node', condition=IfCondition(LaunchConfiguration('simulate'))),
        ]
    )
