# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""fluoro-calib bridge."""

from __future__ import annotations

import argparse

from .arguments import add_address, names
from .bag import become_node

NAME = 'bridge'
HELP = (
    'Show the topics of a live rig to Foxglove, also on machines without ROS (needs ROS 2 here).'
)
EXAMPLE = 'fluoro-calib bridge --host 0.0.0.0'


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    add_address(parser, 'the WebSocket', 8765)
    parser.add_argument(
        '--token',
        default='',
        help='token that ends the address of a client, ?token=... (default: a new one, printed)',
    )
    parser.add_argument(
        '--origins',
        type=names,
        metavar='O,O',
        help='web pages that may connect (default: https://app.foxglove.dev)',
    )
    parser.add_argument(
        '--topics', type=names, metavar='T,T', help='topics to show (default: all)'
    )


def run(arguments: argparse.Namespace) -> None:
    """Replace this process by the bridge node."""
    parameters = {'host': arguments.host, 'port': arguments.port}
    if arguments.token:
        parameters['token'] = arguments.token
    if arguments.origins:
        parameters['origins'] = arguments.origins
    if arguments.topics:
        parameters['topics'] = arguments.topics
    become_node('bridge_node', parameters)
