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

"""fluoro-calib bridge."""

from __future__ import annotations

import argparse

from .arguments import names, number_in
from .bag import become_node

NAME = 'bridge'
HELP = (
    'Show the topics of a live rig to Foxglove, also on machines without ROS (needs ROS 2 here).'
)
EXAMPLE = 'fluoro-calib bridge --host 0.0.0.0'


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.add_argument(
        '--host',
        default='127.0.0.1',
        help='address on which it listens, 0.0.0.0 for all of this machine (default: 127.0.0.1)',
    )
    parser.add_argument(
        '--port',
        type=number_in(0, 65535, int),
        default=8765,
        help='port of the WebSocket (default: 8765)',
    )
    parser.add_argument(
        '--topics', type=names, metavar='T,T', help='topics to show (default: all)'
    )


def run(arguments: argparse.Namespace) -> None:
    """Become the bridge."""
    parameters = {'host': arguments.host, 'port': arguments.port}
    if arguments.topics:
        parameters['topics'] = arguments.topics
    become_node('bridge_node', parameters)
