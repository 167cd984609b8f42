# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The nodes of docs/integration.md: the Python node runs in a graph, the C++ node compiles."""

import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from ament_index_python.packages import get_packages_with_prefixes
from geometry_msgs.msg import PoseStamped
from ros_graph import NAMES, ROOT, Process, value_of
from scipy.spatial.transform import Rotation

EXAMPLES = ROOT / 'examples'
CLUSTER = range(1001, 1007)


def test_python_node_tracks_a_cluster(graph, calibrated, tracking):
    """The pose maps the cluster of the first frame onto that of every later frame."""
    client = graph.client
    parameters = {'calibration_directory': calibrated}
    nodes = [
        graph.start(name, parameters, wait=False)
        for name in ('correction_node', 'reconstruction_node')
    ]
    command = [sys.executable, str(EXAMPLES / 'motion_tracking_node.py'), '--ros-args']
    command += ['-r', f'__ns:={graph.namespace}', '-p', f'targets:={list(CLUSTER)}']
    example = Process(command, graph.directory / 'example.log')
    graph.processes.append(example)
    points = client.listen('reconstruction/points_with_covariance')
    poses = []
    client.create_subscription(PoseStamped, 'pose', poses.append, 100)
    for name in NAMES:
        client.wait_for_diagnostics(
            'correction_node', lambda s: value_of(s, 'calibration') and s.level == b'\0', name
        )
    client.wait_for_diagnostics(
        'reconstruction_node', lambda s: value_of(s, 'orientation'), 'reconstruction'
    )
    numbers = iter(range(1, 10_000))

    def first_pose():
        """Publish a frame until all nodes have discovered each other."""
        number = next(numbers)
        for name in NAMES:
            client.publish(replace(tracking[name][0], number=number))
        return poses

    client.wait_until(first_pose, what='the first pose')
    for row in (100, 200, 300):
        number = 100_000 + row
        for name in NAMES:
            client.publish(replace(tracking[name][row], number=number))
    client.wait_until(
        lambda: (
            poses[-1].header.stamp == points[-1].header.stamp
            and points[-1].frame_number == 100_300
        ),
        what='the last pose',
    )
    first = cluster(points[0])
    for message in points[-3:]:
        pose = next(p.pose for p in poses if p.header == message.header)
        q = pose.orientation
        turned = Rotation.from_quat([q.x, q.y, q.z, q.w]).apply(first - first.mean(axis=0))
        now = cluster(message)
        error = now - now.mean(axis=0) - turned
        assert np.sqrt(np.mean(error**2)) < 2e-4, 'm; points have some 0.1 mm'
        centre = [pose.position.x, pose.position.y, pose.position.z]
        assert np.allclose(centre, now.mean(axis=0), atol=2e-4)
    assert np.linalg.norm(cluster(points[-1]).mean(axis=0) - first.mean(axis=0)) > 0.005, (
        'it moved'
    )
    assert all(node.running for node in (*nodes, example)) and 'Traceback' not in example.log


def cluster(message):
    """Return the points of the cluster (6, 3) [m]."""
    rows = [list(message.target_id).index(target) for target in CLUSTER]
    assert {message.status[k] for k in rows} == {message.OK}
    return np.transpose([message.x, message.y, message.z])[rows]


def test_cpp_node_compiles():
    """Compile against the generated message headers, and rclcpp or declarations of it."""
    if not shutil.which('g++'):
        pytest.skip('there is no g++')
    include = {Path(prefix) / 'include' for prefix in get_packages_with_prefixes().values()}
    folders = [folder for one in include for folder in sorted(one.glob('*')) if folder.is_dir()]
    if not any((folder / 'fluoro_calib_msgs/msg').is_dir() for folder in folders):
        pytest.skip('the messages were built without C++')
    if not any((folder / 'rclcpp').is_dir() for folder in folders):
        folders.append(Path(__file__).parent / 'cpp')
    done = subprocess.run(
        ['g++', '-std=c++17', '-fsyntax-only', '-Wall', '-Wextra', '-Werror']
        + [f'-I{folder}' for folder in folders]
        + [str(EXAMPLES / 'motion_tracking_node.cpp')],
        capture_output=True,
        text=True,
    )
    assert not done.returncode, done.stderr[-3000:]


@pytest.mark.parametrize('language', ['py', 'cpp'])
def test_documentation_shows_the_examples(language):
    """docs/integration.md shows the classes of the examples unchanged."""
    source = (EXAMPLES / f'motion_tracking_node.{language}').read_text()
    end = source.index('\n\nif __name__' if language == 'py' else '\nint main')
    shown = source[source.index('class MotionTracking') : end].rstrip()
    assert shown in (ROOT / 'docs' / 'integration.md').read_text()
