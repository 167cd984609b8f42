# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Modules that a node loads at startup, which takes most of the time until it is ready."""

import subprocess
import sys

import pytest

ESTIMATION = {'fluoro_calib_ros.estimation', 'scipy.stats', 'sklearn'}
NOT_LOADED = {
    'correction_node': {*ESTIMATION, 'scipy.optimize'},
    'image_node': {*ESTIMATION, 'scipy.optimize'},
    'reconstruction_node': {*ESTIMATION, 'cv2'},
    'recorder_node': {'scipy', 'cv2', 'sqlite3'},
    'player_node': {'scipy', 'cv2'},
    'bridge_node': {'scipy', 'cv2'},
}


# A process forked for each node, from one with what all nodes load.
CODE = """
import importlib, os, sys
import fluoro_calib_ros.nodes.runtime.main

for node in sys.argv[1:]:
    child = os.fork()
    if not child:
        importlib.import_module(f'fluoro_calib_ros.nodes.{node}')
        print(node, *sys.modules, flush=True)
        os._exit(0)
    if os.waitpid(child, 0)[1]:
        sys.exit(1)
"""


@pytest.fixture(scope='module')
def loaded():
    """Names of the modules that each node loads."""
    command = [sys.executable, '-c', CODE, *NOT_LOADED]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    return {node: set(names) for node, *names in map(str.split, done.stdout.splitlines())}


@pytest.mark.parametrize('node', NOT_LOADED)
def test_node_loads_only_what_it_uses(loaded, node):
    assert 'rclpy' in loaded[node] and not NOT_LOADED[node] & loaded[node]
