# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The recorder: the bag holds what was published, as rosbag2 would have written it."""

import signal
from types import SimpleNamespace

import numpy as np
import pytest
import rclpy
from rclpy.context import Context
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from ros_graph import NAMES, Process, entry_point, value_of
from rosbags.rosbag2 import Reader
from std_msgs.msg import Int32, String

from fluoro_calib_ros.io.bags.metadata import type_hash
from fluoro_calib_ros.io.bags.reader import read_frames, topics_of
from fluoro_calib_ros.io.bags.salvage import inspect_bag, recover_bag
from fluoro_calib_ros.nodes.runtime.topics import TopicDiscovery, latched_qos


def recorded(status, key='messages'):
    return int(value_of(status, key) or 0)


def wait_for_recorder(client, topics):
    """Wait until the recorder receives these topics and their publishers have discovered it."""
    client.wait_for_diagnostics(
        'recorder_node', lambda s: recorded(s, 'topics') == topics, 'recorder'
    )
    client.wait_until(
        lambda: client._outputs['a'].get_subscription_count() == 1, what='the subscription'
    )


def publish_all(client, exposures):
    for pair in zip(*exposures.values()):
        for frame in pair:
            client.publish(frame)


def test_recorded_bag_holds_what_was_published(graph, exposures, tmp_path):
    """The bag is exact to the last bit, with types, hashes, QoS, metadata and latched messages."""
    client = graph.client
    latched = client.create_publisher(String, 'note', latched_qos())
    latched.publish(String(data='before the recording'))
    topics = [f'{graph.namespace}/{n}/target_observations' for n in NAMES]
    graph.fork = False
    recorder = graph.start(
        'recorder_node',
        {'folder': tmp_path / 'bag', 'topics': str([*topics, f'{graph.namespace}/note'])},
    )
    wait_for_recorder(client, 3)
    client.wait_for_diagnostics('recorder_node', lambda s: recorded(s) == 1, 'recorder')
    publish_all(client, exposures)
    total = 1 + sum(map(len, exposures.values()))
    status = client.wait_for_diagnostics(
        'recorder_node', lambda s: recorded(s) == total, 'recorder'
    )
    assert value_of(status, 'messages dropped') == '0'
    recorder.interrupt()
    assert recorder.wait() == 0 and 'Traceback' not in recorder.log
    found = read_frames(tmp_path / 'bag')
    for name, topic in zip(NAMES, topics):
        for one, other in zip(found.frames[name], exposures[name], strict=True):
            assert np.array_equal(one.uv, other.uv)
            assert np.array_equal(one.target_id, other.target_id)
            assert (one.number, one.stamp_ns) == (other.number, other.stamp_ns)
        (profile,) = topics_of(tmp_path / 'bag')[topic].offered_qos
        assert (profile['reliability'], profile['durability']) == ('reliable', 'volatile')
    assert topics_of(tmp_path / 'bag')[f'{graph.namespace}/note'].offered_qos[0]['durability'] == (
        'transient_local'
    )
    with Reader(tmp_path / 'bag') as bag:  # checks metadata.yaml against the file
        assert bag.message_count == total
        for connection in bag.connections:
            assert connection.digest == type_hash(connection.msgtype)
    assert not inspect_bag(tmp_path / 'bag').damages


def test_killed_recording_is_recovered(graph, exposures, tmp_path):
    """Only messages of the last second may be lost, none that were reported as written to disk."""
    client = graph.client
    topic = f'{graph.namespace}/a/target_observations'
    recorder = graph.start(
        'recorder_node',
        {'folder': tmp_path / 'bag', 'topics': f"['{topic}']", 'flush_period': 0.05},
    )
    wait_for_recorder(client, 1)
    for frame in exposures['a']:
        client.publish(frame)
    count = len(exposures['a'])
    client.wait_for_diagnostics('recorder_node', lambda s: recorded(s) == count, 'recorder')
    # Diagnostics come once a second, long after the flush.
    client.publish(exposures['b'][0])
    recorder._process.send_signal(signal.SIGKILL)
    recorder.wait()
    assert recover_bag(tmp_path / 'bag', tmp_path / 'out').counts == {topic: count}


def test_command_ends_at_sigterm_with_a_complete_bag(graph, exposures, tmp_path):
    """`bag record` runs the node itself: it receives the signal and returns the exit status."""
    client = graph.client
    topic = f'{graph.namespace}/a/target_observations'
    process = Process(
        [*entry_point('cli'), 'bag', 'record', '--out', str(tmp_path / 'bag'), topic],
        tmp_path / 'log',
    )
    graph.processes.append(process)
    client.wait_until(lambda: f'recording {topic}' in process.log, what='the recorder')
    output = client._outputs['a']
    client.wait_until(lambda: output.get_subscription_count() == 1, what='the subscription')
    client.wait_until_known_to('/recorder_node')
    for frame in exposures['a']:
        client.publish(frame)
    assert output.wait_for_all_acked()
    process._process.send_signal(signal.SIGTERM)
    assert process.wait() == 0, process.log
    assert 'Traceback' not in process.log
    assert len(read_frames(tmp_path / 'bag').frames['a']) == len(exposures['a'])


def test_recorder_says_why_it_cannot_start(graph, tmp_path):
    (tmp_path / 'there').mkdir()
    for parameters, sentence in (
        ({}, 'parameter folder is not set'),
        ({'folder': tmp_path / 'there'}, 'already exists'),
        ({'folder': '/proc/bag'}, 'cannot be written'),
        ({'folder': tmp_path / 'new', 'topics': '[a/target-observations]'}, 'a/target-observ'),
    ):
        process = graph.start('recorder_node', parameters, wait=False)
        assert process.wait() == 1
        assert sentence in process.log and 'Traceback' not in process.log
    assert not (tmp_path / 'new').exists()  # so that the corrected command may use it


BEST_EFFORT = QoSProfile(depth=100, reliability=ReliabilityPolicy.BEST_EFFORT)
RELIABLE = QoSProfile(depth=100)


@pytest.mark.parametrize(
    'profiles', [(RELIABLE, BEST_EFFORT), (BEST_EFFORT, RELIABLE), (latched_qos(), RELIABLE)]
)
def test_publisher_that_restarts_with_another_quality_of_service_is_recorded(
    graph, tmp_path, profiles
):
    client = graph.client
    topic = f'{graph.namespace}/note'
    recorder = graph.start('recorder_node', {'folder': tmp_path / 'bag', 'topics': f'[{topic}]'})
    for number, profile in enumerate(profiles, 1):
        publisher = client.create_publisher(String, topic, profile)

        def requested():
            # none while the recorder renews its subscription
            found = client.get_subscriptions_info_by_topic(topic)
            return [(info.qos_profile.reliability, info.qos_profile.durability) for info in found]

        expected = [(profile.reliability, profile.durability)]
        client.wait_until(lambda: requested() == expected, what='the renewed subscription')
        client.wait_until(publisher.get_subscription_count, what='the subscription')
        client.wait_until_known_to('recorder_node')
        publisher.publish(String(data='x'))
        client.wait_for_diagnostics('recorder_node', lambda s: recorded(s) == number, 'recorder')
        client.destroy_publisher(publisher)
        client.wait_until(lambda: not client.count_publishers(topic))
    assert f'topic {topic}: the subscription is now' in recorder.log


@pytest.fixture
def peer(graph):
    """Node of another participant, which may use other types than the client."""
    context = Context()
    domain_id = int(graph.environment['ROS_DOMAIN_ID'])
    rclpy.init(args=[], context=context, domain_id=domain_id)
    node = Node('peer', context=context)
    yield node
    node.destroy_node()
    rclpy.shutdown(context=context)


def test_types_of_publishers_that_differ_prevent_a_recording_until_one_has_ended(
    graph, peer, monkeypatch
):
    """A recorder that knows only one of them yet records that one."""
    client = graph.client
    topic = f'{graph.namespace}/note'
    other = peer.create_publisher(Int32, topic, 10)
    client.create_publisher(String, topic, 10)
    client.wait_until(lambda: client.count_publishers(topic) == 2)
    said = []
    monkeypatch.setattr(client, 'get_logger', lambda: SimpleNamespace(warning=said.append))
    topics = TopicDiscovery(client, [topic], 'recorded')
    assert not [*topics.new(), *topics.new()]
    types = 'std_msgs/msg/Int32, std_msgs/msg/String'
    assert said == [f'{topic} is not recorded: it has the types {types}']
    peer.destroy_publisher(other)
    (found,) = client.wait_until(lambda: list(topics.new()), what='the topic')
    assert (found.name, found.kind) == (topic, String)


def test_types_of_subscribers_do_not_prevent_a_recording(graph, peer, tmp_path):
    client = graph.client
    topic = f'{graph.namespace}/note'
    peer.create_subscription(Int32, topic, print, 10)
    client.wait_until(lambda: client.count_subscribers(topic))
    graph.start('recorder_node', {'folder': tmp_path / 'bag', 'topics': f'[{topic}]'})
    publisher = client.create_publisher(String, topic, 10)
    client.wait_until(publisher.get_subscription_count, what='the subscription')
    client.wait_until_known_to('recorder_node')
    publisher.publish(String(data='x'))
    client.wait_for_diagnostics('recorder_node', lambda s: recorded(s) == 1, 'recorder')
