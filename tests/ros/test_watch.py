# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The dashboard's client and the calibration node: a session without the ros2 command."""

import os
import signal

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from ros_graph import BAGS, NAMES, standing
from sensor_msgs.msg import Image

from fluoro_calib_ros.images.overlay import MATCHED
from fluoro_calib_ros.nodes.dashboard.watch import SessionClient
from fluoro_calib_ros.nodes.runtime.topics import latched_qos


@pytest.fixture
def watch(graph):
    watch = SessionClient(graph.namespace, graph.client.context)
    graph.client._spinner.add_node(watch)
    yield watch
    graph.client._spinner.remove_node(watch)
    watch.destroy_node()


def test_session_is_run_from_the_dashboard(graph, watch, exposures, tmp_path):
    """The dashboard shows exposures and what is missing; it captures, resets and calibrates."""
    node = graph.calibration_node(tmp_path / 'out', collect='request', phantm='mistyped')
    client = graph.client
    assert 'there is no parameter phantm, it has no effect; did you mean phantom?' in node.log
    pictures = []
    client.create_subscription(Image, 'a/coverage', pictures.append, latched_qos())

    def fluoroscope():
        return next((f for f in watch.state().fluoroscopes if f.name == 'a' and f.state), None)

    client.wait_until(fluoroscope, what='the status of fluoroscope a')
    assert fluoroscope().exposures == 0 and not fluoroscope().ready
    assert fluoroscope().next_pose == 'show the phantom and keep it still'
    watch.request('calibrate_fast')
    client.wait_until(
        lambda: any('0 exposures are too few' in line for line in watch.state().log),
        what='the refusal of a calibration without exposures',
    )
    assert not watch.state().job

    streams = [standing(exposures[name][0], 10**6) for name in NAMES]
    client.stream(zip(*streams), rate=30.0)
    watch.request('capture')
    client.wait_until(lambda: fluoroscope().exposures == 1, what='the captured exposure')
    client.wait_until(lambda: '14 more, with beads' in fluoroscope().next_pose)
    client.wait_until(lambda: pictures, what='a picture of the coverage')
    picture = pictures[-1]
    colours = np.frombuffer(picture.data, np.uint8).reshape(picture.height, picture.width, 3)
    green = (colours[: picture.width] == MATCHED).all(axis=2).mean()
    assert abs(green - fluoroscope().coverage) < 0.05
    client.wait_until(
        lambda: 'ready: receiving a/target_observations, b/target_observations' in node.log,
        what='the line that the node is ready',
    )
    watch.request('reset')
    client.wait_until(lambda: fluoroscope().exposures == 0, what='the reset')
    client.end_stream()
    (state,) = watch.state().nodes
    assert state.name == 'calibration_node'

    assert node.end() == 0
    client.wait_until(lambda: watch.state().nodes[0].level == 'silent')


def test_folder_of_the_results_is_the_one_that_the_node_uses(graph, watch, tmp_path):
    graph.environment['ROS_HOME'] = str(tmp_path)  # contains the default folder
    graph.start('calibration_node', {'phantom': BAGS / 'phantom.csv'})
    folder = tmp_path / 'fluoro_calib' / graph.namespace.strip('/')
    graph.client.wait_until(lambda: watch.state().results == str(folder), what='the folder')


def test_only_what_is_reported_now_counts(graph, watch, monkeypatch):
    """Other functions of a node are no fluoroscopes, and values that are not numbers no reason to
    stop.
    """
    monkeypatch.setattr('fluoro_calib_ros.nodes.dashboard.watch.SILENT_S', 0.5)
    client = graph.client
    output = client.create_publisher(DiagnosticArray, '/diagnostics', 10)
    levels = {}

    def report(**functions):
        """Report levels of functions; return the worst that is shown, and what was in its time."""
        message = DiagnosticArray()
        message.status = [
            DiagnosticStatus(
                name=f'{graph.namespace}/calibration_node: {function}',
                level=level,
                values=[KeyValue(key='frames received', value='n/a')] if function == 'a' else [],
            )
            for function, level in functions.items()
        ]
        output.publish(message)
        levels.update({node.name: node.level for node in watch.state().nodes})
        return levels.get('calibration_node')

    client.wait_until(output.get_subscription_count, what='the dashboard')
    client.wait_until(lambda: report(a=b'\0', clock=b'\1') == 'warn', what='the warning')
    client.wait_until(lambda: report(a=b'\0') == 'ok', what='the end of the warning')
    assert [f.name for f in watch.state().fluoroscopes] == ['a']


@pytest.mark.parametrize('action', ['capture', 'calibrate_fast'])
def test_request_without_answer_is_reported(graph, watch, tmp_path, monkeypatch, action):
    """A suspended node represents every lost answer; a late answer is shown."""
    monkeypatch.setattr('fluoro_calib_ros.nodes.dashboard.watch.ANSWER_S', 0.1)
    node = graph.calibration_node(tmp_path / 'out', collect='request', capture_timeout=0.1)
    wait = graph.client.wait_until
    wait(lambda: watch.state().nodes, what='the node')
    wait(lambda: watch.state().fluoroscopes, what='the fluoroscopes')
    os.kill(node.pid, signal.SIGSTOP)
    try:
        watch.request(action)
        wait(lambda: 'no answer yet' in watch.state().log[-1], what='the lost answer')
        assert not watch.state().job
    finally:
        os.kill(node.pid, signal.SIGCONT)
    failed = f'{action.removesuffix("_fast")} failed'
    wait(lambda: failed in watch.state().log[-1], what='the late answer')
    assert not watch.state().job
