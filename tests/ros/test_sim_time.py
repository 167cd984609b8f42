# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""use_sim_time without /clock: nodes do not fall silent, and no peer can set the parameter."""

import pytest
from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
from rcl_interfaces.srv import SetParameters
from ros_graph import standing, value_of

from fluoro_calib_ros.io.bags.reader import read_frames

NODES = ('calibration_node', 'correction_node', 'reconstruction_node', 'recorder_node')
FRAMES = 5


@pytest.fixture
def client(graph, tmp_path):
    """Client of a graph whose nodes use a /clock that nobody publishes."""
    for node in NODES:
        graph.client.expect(SetParameters, f'{node}/set_parameters')
    graph.calibration_node(tmp_path / 'none', wait=False, use_sim_time='true')
    graph.start('correction_node', {'use_sim_time': 'true'}, wait=False)
    graph.start('reconstruction_node', {'use_sim_time': 'true'}, wait=False)
    recorder = {'use_sim_time': 'true', 'folder': tmp_path / 'bag'}
    graph.recorder = graph.start('recorder_node', recorder)
    return graph.client


def test_nodes_go_on_and_say_that_there_is_no_clock(graph, client, exposures, tmp_path):
    for node in NODES:
        client.wait_for_diagnostics(
            node, lambda s: 'nobody publishes /clock' in s.message, 'clock'
        )
    client.wait_until(
        lambda: (
            'recording ' + client.resolve_topic_name('a/target_observations') in graph.recorder.log
        ),
        what='the topic in the log of the recorder',
    )
    client.wait_until_known_to('recorder_node')
    for frame in standing(exposures['a'][0], FRAMES):
        client.publish(frame)
    client.wait_for_status(lambda s: s.frames_received == FRAMES)
    client.wait_for_diagnostics(
        'recorder_node', lambda s: int(value_of(s, 'messages')) >= FRAMES, 'recorder'
    )
    assert graph.recorder.end() == 0
    assert len(read_frames(tmp_path / 'bag').frames['a']) == FRAMES


def test_no_peer_sets_it(graph):
    """Otherwise a running node would change from one time to another."""
    client = graph.client
    client.expect(SetParameters, 'correction_node/set_parameters')
    graph.start('correction_node')
    wanted = ParameterValue(type=ParameterType.PARAMETER_BOOL, bool_value=True)
    found = client.call(
        SetParameters,
        'correction_node/set_parameters',
        parameters=[Parameter(name='use_sim_time', value=wanted)],
    )
    assert not found.results[0].successful
    assert 'use_sim_time is read when the node starts' in found.results[0].reason
