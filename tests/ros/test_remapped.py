# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Remapped streams: fault reports contain the name of the fluoroscope."""

import pytest
from fluoro_calib_msgs.msg import CorrectedObservations, TargetObservations
from ros_graph import value_of

from fluoro_calib_ros.nodes.runtime.topics import observations_qos


@pytest.mark.parametrize(
    'node, topic, kind, about',
    [
        ('correction_node', 'target_observations', TargetObservations, 'a'),
        ('reconstruction_node', 'corrected_observations', CorrectedObservations, 'reconstruction'),
    ],
)
def test_undecodable_message_on_a_remapped_topic(graph, node, topic, kind, about):
    client = graph.client
    output = client.create_publisher(kind, 'hospital/camera/left', observations_qos())
    process = graph.start(node, remaps={f'a/{topic}': 'hospital/camera/left'}, wait=False)
    client.wait_until(output.get_subscription_count, what='the reader')
    client.wait_until_known_to(node)
    output.publish(b'\0\1\0\0no message')
    status = client.wait_for_diagnostics(
        node, lambda s: value_of(s, 'refused: undecodable') == '1', about
    )
    assert 'fluoroscope a: a message on ' in value_of(status, 'last fault')
    assert process.end() == 0 and 'Traceback' not in process.log
