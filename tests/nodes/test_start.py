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


@pytest.mark.parametrize('node', NOT_LOADED)
def test_node_loads_only_what_it_uses(node):
    code = f'import sys; import fluoro_calib_ros.nodes.{node}; print(*sys.modules)'
    loaded = subprocess.run(
        [sys.executable, '-c', code], capture_output=True, text=True, check=True
    )
    assert not NOT_LOADED[node] & set(loaded.stdout.split())
