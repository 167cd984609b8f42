# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The bridge: what Foxglove receives over its WebSocket protocol."""

import json
import os
import re
import socket
import struct
import sys
import threading
from contextlib import ExitStack, suppress

import pytest
from fluoro_calib_msgs.msg import CalibrationStatus
from geometry_msgs.msg import TransformStamped
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message
from ros_graph import NAMES, Process, entry_point
from std_msgs.msg import String
from tf2_msgs.msg import TFMessage

from fluoro_calib_ros.nodes.runtime.topics import latched_qos

PROTOCOL = ['foxglove.sdk.v1']


def test_without_the_sdk_it_says_what_to_install(tmp_path, ros, monkeypatch):
    # Precedes the installed package on the path, as if that were missing.
    (tmp_path / 'foxglove.py').write_text('raise ImportError\n')
    monkeypatch.setenv('PYTHONPATH', os.pathsep.join([str(tmp_path), *sys.path]))
    node = Process(entry_point('bridge_node'), tmp_path / 'log')
    assert node.wait() == 1
    assert 'pip install foxglove-sdk' in node.log and 'Traceback' not in node.log


class Foxglove:
    """Client that subscribes to a topic by the protocol of Foxglove."""

    def __init__(self, socket, topic):
        self.socket = socket
        self.topic = topic
        self.channel = None
        self.subscription = ''

    def receive(self):
        """Return the next message, a CDR."""
        while True:
            message = self.socket.recv(60)
            if isinstance(message, bytes):
                assert message[0] == 1 and struct.unpack_from('<I', message, 1)[0] == 7
                return message[13:]
            document = json.loads(message)
            for channel in document.get('channels', ()):
                if channel['topic'] == self.topic:
                    self.channel = channel
                    wanted = [{'id': 7, 'channelId': channel['id']}]
                    self.subscription = json.dumps({'op': 'subscribe', 'subscriptions': wanted})
                    self.socket.send(self.subscription)
            if document['op'] == 'status':
                # foxglove-sdk 0.30 advertises a channel just before it accepts subscribers.
                assert document['message'].startswith('Unknown channel ID'), document
                self.socket.send(self.subscription)


def connected(graph, bridge):
    """Return a connection, a context manager."""
    from websockets.sync.client import connect

    address = graph.client.wait_until(lambda: re.search(r'ws://\S+', bridge.log))[0]
    return connect(address, subprotocols=PROTOCOL, max_size=None)


def test_foxglove_receives_the_messages_with_their_definition(graph, tmp_path):
    graph.calibration_node(tmp_path / 'out')
    graph.fork = False
    bridge = graph.start('bridge_node', {'port': 0})
    topic = f'{graph.namespace}/a/calibration_status'
    with connected(graph, bridge) as socket:
        foxglove = Foxglove(socket, topic)
        status = deserialize_message(foxglove.receive(), CalibrationStatus)
    assert status.fluoroscope in NAMES and status.exposures == 0
    channel = foxglove.channel
    assert channel['encoding'] == 'cdr' and channel['schemaEncoding'] == 'ros2msg'
    assert channel['schemaName'] == 'fluoro_calib_msgs/msg/CalibrationStatus'
    assert 'float64 coverage' in channel['schema']


def test_every_client_receives_the_last_message_of_each_publisher_of_a_latched_topic(graph):
    frames = ('rig', 'robot')
    topic = f'{graph.namespace}/tf_static'
    publishers = [graph.client.create_publisher(TFMessage, topic, latched_qos()) for _ in frames]
    for publisher, frame in zip(publishers, frames):
        transform = TransformStamped(child_frame_id=frame)
        publisher.publish(TFMessage(transforms=[transform]))
    graph.client.wait_until(lambda: graph.client.count_publishers(topic) == 2)
    bridge = graph.start('bridge_node', {'port': 0, 'topics': f'[{topic}]'})
    with ExitStack() as sockets:
        for _ in range(2):
            foxglove = Foxglove(sockets.enter_context(connected(graph, bridge)), topic)
            messages = [deserialize_message(foxglove.receive(), TFMessage) for _ in frames]
            assert {m.transforms[0].child_frame_id for m in messages} == set(frames)


def test_publisher_that_restarts_with_best_effort_is_shown(graph):
    from websockets.exceptions import ConnectionClosed

    client = graph.client
    topic = f'{graph.namespace}/note'
    received = []
    bridge = graph.start('bridge_node', {'port': 0, 'topics': f'[{topic}]'})
    with connected(graph, bridge) as socket:
        foxglove = Foxglove(socket, topic)

        def receive():
            with suppress(ConnectionClosed):
                while True:
                    received.append(foxglove.receive())

        thread = threading.Thread(target=receive)
        thread.start()
        for reliability in (ReliabilityPolicy.RELIABLE, ReliabilityPolicy.BEST_EFFORT):
            publisher = client.create_publisher(
                String, topic, QoSProfile(depth=10, reliability=reliability)
            )
            received.clear()

            def shown(publisher=publisher):
                publisher.publish(String(data='x'))
                return received

            client.wait_until(shown, what='a message')
            client.destroy_publisher(publisher)
    thread.join()


def test_only_who_knows_the_token_and_no_foreign_page_is_let_through(graph):
    from websockets.exceptions import InvalidStatus
    from websockets.sync.client import connect

    bridge = graph.start('bridge_node', {'port': 0, 'token': 'the token', 'topics': '[/x]'})
    find = r'(ws://127.0.0.1:\d+/)(\S+)'
    base, token = graph.client.wait_until(lambda: re.search(find, bridge.log)).groups()
    assert token == '?token=the%20token'
    page = 'https://app.foxglove.dev'
    for origin in (None, page, 'file://'):
        with connect(base + token, subprotocols=PROTOCOL, origin=origin) as socket:
            assert json.loads(socket.recv())['op'] == 'serverInfo'
    for query, origin in (
        ('', None),
        ('', page),
        ('?token=the', None),
        ('?token=the%20token%20', page),
        (token, 'https://evil.example'),
        (token, 'http://localhost:8080'),
        (token, 'null'),
    ):
        with pytest.raises(InvalidStatus) as caught:
            connect(base + query, subprotocols=PROTOCOL, origin=origin)
        assert caught.value.response.status_code == 403
    with socket_of(base) as raw:  # send no request at all
        raw.sendall(b'x' * 100_000)
        assert not raw.recv(1000).startswith(b'HTTP/1.1 101')
    assert bridge.log.count('refused: the token is missing or wrong') == 4
    assert bridge.log.count('refused: its Origin is not allowed') == 3
    assert bridge.end() == 0


def socket_of(base):
    """Return a connection with the host and port of an address."""
    host, port = base.removeprefix('ws://').strip('/').split(':')
    return socket.create_connection((host, int(port)), timeout=30)
