# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Calibration, correction and reconstruction of the fluoroscopes of one rig.

ros2 launch fluoro_calib_ros fluoro_calib.launch.py phantom:=/path/to/phantom.csv
ros2 launch fluoro_calib_ros fluoro_calib.launch.py phantom:=/path/to/phantom.csv from_images:=true
ros2 launch fluoro_calib_ros fluoro_calib.launch.py --show-args
"""

import os
from dataclasses import dataclass
from pathlib import Path

import yaml
from ament_index_python.packages import (
    PackageNotFoundError,
    get_package_prefix,
    get_package_share_directory,
)
from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch_ros.actions import Node, SetParameter

from fluoro_calib_ros.errors import DataError
from fluoro_calib_ros.io.rig_file import read_rig_file

PACKAGE = 'fluoro_calib_ros'
SWITCH = ['true', 'false']
CLOCK_HZ = 100.0  # of the /clock that the player publishes
# Arguments that are numbers, and those that are texts also where they read like a number.
NUMBERS = ('rate', 'bag_rate', 'principal_distance', 'angle_max_age')
TEXTS = (
    *('phantom', 'calibration_directory', 'rig_frame', 'bodies', 'joints'),
    *('angle_joint', 'bag', 'record'),
)


@dataclass(frozen=True)
class Argument:
    """A launch argument."""

    name: str
    default: str
    description: str
    choices: tuple = ()

    def declare(self):
        """Return the action that declares it."""
        return DeclareLaunchArgument(
            self.name,
            default_value=self.default,
            description=self.description,
            choices=list(self.choices) or None,
        )


# Passed on to the nodes that have the parameter, where they are not empty.
PARAMETERS = (
    Argument('phantom', '', 'phantom.csv with the surveyed coordinates of the beads [mm]'),
    Argument('fluoroscopes', '', 'names of the fluoroscopes, e.g. [a, b]'),
    Argument(
        'calibration_directory',
        '',
        'folder of the saved calibrations, from which all nodes start (default: '
        'fluoro_calib/<namespace> in $ROS_HOME or ~/.ros, for the calibration node)',
    ),
    Argument('rig_frame', '', 'name of the rig frame on /tf_static'),
    Argument('bodies', '', 'bodies.csv with rigid bodies and their markers: poses, live'),
    Argument('joints', '', 'joints.toml with joints between these bodies: angles, live'),
    Argument('principal_distance', '', 'principal distance, to some 10 %, for from_images [px]'),
    Argument(
        'angle_joint',
        '',
        'joint on joint_states whose position is the angle of the C-arm, or one for each '
        'fluoroscope, e.g. a:frontal,b:lateral',
    ),
    Argument(
        'angle_max_age', '', 'longest time from the last state of the joint to an exposure [s]'
    ),
    Argument('autostart', '', 'false: a lifecycle manager configures and activates the nodes'),
)
SWITCHES = (
    Argument('calibration', 'true', 'false: without the calibration node', SWITCH),
    Argument(
        'from_images',
        'false',
        'true: find the beads of the phantom in images; the simulator then publishes radiographs',
        SWITCH,
    ),
    Argument('images', 'false', 'true: correct images, too', SWITCH),
    Argument('simulate', 'false', 'true: with the virtual rig', SWITCH),
    Argument(
        'rviz',
        'false',
        'true: show points and optical frames in RViz; auto: where rviz2 is installed',
        [*SWITCH, 'auto'],
    ),
    Argument(
        'use_sim_time',
        'false',
        'true: take the time from /clock, which the player of a bag publishes',
        SWITCH,
    ),
    Argument('respawn', 'false', 'true: restart a node that has failed', SWITCH),
)
OTHERS = (
    Argument(
        'rig',
        '',
        'rig.toml, whose fluoroscopes, phantom, angle_joint and angle_max_age hold where these '
        'arguments are empty',
    ),
    Argument('namespace', '', 'namespace of the rig'),
    Argument('params_file', '', 'parameters of the nodes (default: config/fluoro_calib.yaml)'),
    Argument('log_level', 'info', 'debug, info, warn, error or fatal'),
    Argument('bag', '', 'bag to play (default: none)'),
    Argument('bag_topics', '', 'topics of the bag to play, e.g. [/a/target_observations]'),
    Argument('bag_rate', '', 'speed relative to the recording'),
    Argument('record', '', 'folder of a new bag, into which all topics are recorded'),
    Argument('record_topics', '', 'topics to record, e.g. [/a/target_observations]'),
    Argument('scene', '', 'scene of the simulator: phantom or markers'),
    Argument('rate', '', 'frame rate of the simulator [Hz]'),
)
# Parameters of the nodes that launch arguments set.
RIG = ('fluoroscopes', 'calibration_directory', 'autostart')
ANGLE = ('angle_joint', 'angle_max_age')
OF_NODE = {
    'extraction_node': (
        'phantom',
        'fluoroscopes',
        'autostart',
        'principal_distance',
        *ANGLE,
    ),
    'calibration_node': ('phantom', *RIG, 'rig_frame', *ANGLE),
    'correction_node': (*RIG, *ANGLE),
    'reconstruction_node': (*RIG, 'rig_frame', 'bodies', 'joints'),
    'image_node': (*RIG, *ANGLE),
}


def fail_if_not_started(event, context):
    """Raise where a node could not start, such as with a wrong phantom: its exit status is 1.

    Launch ends the other nodes then, and its own exit status is 1. A node that crashes later
    leaves the others running.
    """
    if event.returncode == 1:
        raise RuntimeError(f'{event.process_name} could not start')


def with_rig(values):
    """Return the launch arguments with what the file of the argument rig says."""
    if not values['rig']:
        return values
    try:
        rig = read_rig_file(Path(values['rig']))
    except DataError as error:
        raise RuntimeError(str(error)) from None
    found = {
        'fluoroscopes': yaml.safe_dump(rig.fluoroscopes, default_flow_style=True).strip()
        if rig.fluoroscopes
        else '',
        'phantom': str(rig.phantom.absolute()) if rig.phantom else '',
        'angle_joint': rig.angle_joint or '',
        'angle_max_age': '' if rig.angle_max_age is None else str(rig.angle_max_age),
    }
    return {**values, **{name: text for name, text in found.items() if not values[name]}}


def parameter_of(name, text):
    """Return the parameter of a launch argument. Raises RuntimeError that names the argument."""
    if name in TEXTS:
        return text
    expected = 'a number' if name in NUMBERS else 'YAML'
    try:
        return float(text) if name in NUMBERS else yaml.safe_load(text)
    except (ValueError, yaml.YAMLError):
        raise RuntimeError(f'{name}:={text} is not {expected}') from None


def with_rviz(values):
    """Return whether to start RViz. Raises RuntimeError where it is missing."""
    if values['rviz'] == 'false':
        return False
    try:
        get_package_prefix('rviz2')
    except PackageNotFoundError:
        if values['rviz'] == 'auto':
            return False
        raise RuntimeError(
            'rviz:=true, but rviz2 is not installed: install the package rviz2, or start with '
            'rviz:=false'
        ) from None
    return True


def nodes_of_rig(context):
    """Return the nodes with their parameters.

    Raises RuntimeError, before any node is started, for an argument that is wrong.
    """
    values = {
        argument.name: context.launch_configurations[argument.name]
        for argument in (*PARAMETERS, *SWITCHES, *OTHERS)
    }
    values = with_rig(values)
    shows = with_rviz(values)
    share = get_package_share_directory(PACKAGE)
    params_file = values['params_file'] or os.path.join(share, 'config', 'fluoro_calib.yaml')
    if not os.path.isfile(params_file):
        raise RuntimeError(f'params_file:={params_file}: there is no such file')

    def node(executable, parameters, fixed=None, needed=False):
        given = {
            parameter: parameter_of(argument, values[argument])
            for parameter, argument in parameters.items()
            if values[argument]
        }
        given.update(fixed or {})
        return Node(
            package=PACKAGE,
            executable=executable,
            # With its name, launch's parameters take precedence over any pattern in the file.
            name=executable,
            namespace=values['namespace'],
            output='screen',
            parameters=[params_file, *([given] if given else [])],
            arguments=['--ros-args', '--log-level', values['log_level']],
            respawn=values['respawn'] == 'true',
            respawn_delay=1.0,
            on_exit=fail_if_not_started if needed else None,
        )

    def configured(executable, needed=False):
        return node(executable, {name: name for name in OF_NODE[executable]}, needed=needed)

    actions = [SetParameter('use_sim_time', values['use_sim_time'] == 'true')]
    if values['calibration'] == 'true':
        actions.append(configured('calibration_node', needed=values['respawn'] == 'false'))
    if values['from_images'] == 'true':
        actions.append(configured('extraction_node', needed=values['respawn'] == 'false'))
    has_bodies = bool(values['bodies'])
    actions += [
        configured('correction_node'),
        configured('reconstruction_node', needed=has_bodies and values['respawn'] == 'false'),
    ]
    if values['images'] == 'true':
        actions.append(configured('image_node'))
    if shows:
        display = os.path.join(share, 'config', 'rig.rviz')
        actions.append(
            Node(
                package='rviz2',
                executable='rviz2',
                namespace=values['namespace'],
                arguments=['-d', display, '-f', values['rig_frame'] or 'rig'],
            )
        )
    if values['record']:
        recorded = {'folder': 'record', 'topics': 'record_topics', 'angle_joint': 'angle_joint'}
        actions.append(node('recorder_node', recorded))
    if values['bag']:
        played = {'bag': 'bag', 'topics': 'bag_topics', 'rate': 'bag_rate'}
        # Readers of target observations: the correction node, and those that are started with it.
        readers = 1 + (values['calibration'] == 'true') + bool(values['record'])
        clock = CLOCK_HZ if values['use_sim_time'] == 'true' else 0.0
        actions.append(node('player_node', played, {'wait_for_readers': readers, 'clock': clock}))
    if values['simulate'] == 'true':
        simulated = {name: name for name in ('fluoroscopes', 'scene', 'rate')}
        images = {'images': 'clean'} if values['from_images'] == 'true' else {}
        actions.append(node('simulator_node', simulated, images))
    return actions


def generate_launch_description():
    """Nodes of one rig, in one namespace."""
    arguments = [argument.declare() for argument in (*PARAMETERS, *SWITCHES, *OTHERS)]
    return LaunchDescription([*arguments, OpaqueFunction(function=nodes_of_rig)])
