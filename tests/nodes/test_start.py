# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What a node loads when it starts: one that only corrects is ready without any estimator."""

import subprocess
import sys

import pytest

ESTIMATION = {'fluoro_calib_ros.estimation', 'scipy.stats', 'scipy.optimize', 'sklearn'}


@pytest.mark.parametrize('node', ['correction_node', 'image_node'])
def test_node_that_corrects_loads_no_estimator(node):
    code = f'import sys; import fluoro_calib_ros.nodes.{node}; print(*sys.modules)'
    loaded = subprocess.run(
        [sys.executable, '-c', code], capture_output=True, text=True, check=True
    )
    assert not ESTIMATION & set(loaded.stdout.split())
