# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Fixtures for tests with real nodes: a ROS domain, graphs and a calibration."""

import fcntl
import os
import shutil
import subprocess

import pytest
from dds_ports import free_domain
from node_server import NodeServer
from ros_graph import BAGS, ROOT, Graph, entry_point

from fluoro_calib_ros.io.bags.reader import read_frames


def pytest_collection_modifyitems(items):
    for item in items:
        if 'tests/ros' in item.path.as_posix():
            item.add_marker(pytest.mark.ros)


@pytest.fixture(scope='session')
def ros(tmp_path_factory):
    """Initialise rclpy in the ROS domain of this session; nodes inherit its environment."""
    import rclpy

    domain, lock = free_domain()
    with pytest.MonkeyPatch.context() as patch, lock:
        patch.setenv('ROS_DOMAIN_ID', str(domain))
        patch.setenv('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
        patch.setenv('ROS_LOG_DIR', str(tmp_path_factory.mktemp('ros_log')))
        rclpy.init(args=[])
        yield
        rclpy.shutdown()


@pytest.fixture(scope='session')
def node_server():
    """Return the server process from which the nodes of this session are forked."""
    server = NodeServer()
    yield server
    server.close()


def _graph(request, directory):
    graph = Graph(directory, request.getfixturevalue('node_server'))
    request.node.graphs = [*getattr(request.node, 'graphs', ()), graph]
    with pytest.MonkeyPatch.context() as patch:
        for name, value in graph.environment.items():  # also for commands that a test runs itself
            patch.setenv(name, value)
        yield graph
    graph.close()
    request.node.graphs.remove(graph)  # a context is freed with its last reference


@pytest.fixture
def graph(ros, request, tmp_path):
    """Graph of one test."""
    yield from _graph(request, tmp_path)


@pytest.fixture(scope='module')
def module_graph(ros, request, tmp_path_factory):
    """Graph of all tests of a file."""
    yield from _graph(request, tmp_path_factory.mktemp('graph'))


@pytest.hookimpl(hookwrapper=True)
def pytest_runtest_makereport(item):
    """Show the last messages of the nodes, and where their threads are, when a test fails."""
    report = (yield).get_result()
    if report.failed:
        for node in item.listchain():
            for graph in getattr(node, 'graphs', ()):
                report.sections.extend(
                    graph.last_words(end=node is item)
                )  # other tests still need their nodes


@pytest.fixture(scope='session')
def exposures():
    """Frames of bags/calibration, by fluoroscope."""
    return read_frames(BAGS / 'calibration').frames


@pytest.fixture(scope='session')
def tracking():
    """Frames of bags/tracking, by fluoroscope."""
    return read_frames(BAGS / 'tracking').frames


def made_once(tmp_path_factory, name, make):
    """Return a folder that make(folder) fills once per session, in the first worker to need it.

    Tests must not change the folder.
    """
    root = tmp_path_factory.getbasetemp()
    if 'PYTEST_XDIST_WORKER' in os.environ:
        root = root.parent
    folder = root / name
    with open(root / f'{name}.lock', 'w') as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not folder.exists():
            begun = root / f'{name}.begun'
            shutil.rmtree(begun, ignore_errors=True)
            make(begun)
            begun.rename(folder)
    return folder


def _calibrate_by_command(folder):
    command = [*entry_point('cli'), 'calibrate', BAGS / 'calibration']
    command += ['--phantom', BAGS / 'phantom.csv', '--out', folder, '--fast']
    subprocess.run(command, cwd=ROOT, stdout=subprocess.DEVNULL, timeout=240, check=True)


@pytest.fixture(scope='session')
def by_command(tmp_path_factory):
    """Folder with a calibration of bags/calibration made by the command line."""
    folder = tmp_path_factory.mktemp('by_command') / 'result'
    shutil.copytree(
        made_once(tmp_path_factory, 'by_command', _calibrate_by_command), folder
    )  # nodes may save to this folder
    return folder


@pytest.fixture(scope='session')
def by_second_command(tmp_path_factory):
    """Folder with the result of a second run of the same command."""
    folder = tmp_path_factory.mktemp('by_second_command')
    _calibrate_by_command(folder)
    return folder


@pytest.fixture
def calibrated(by_command, tmp_path):
    """Folder with a calibration of a and b that a test may change."""
    return shutil.copytree(by_command, tmp_path / 'calibrated')
