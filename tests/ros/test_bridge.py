# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The bridge: what Foxglove receives over its WebSocket protocol."""

import asyncio
import json
import os
import re
import socket
import struct
import sys

import pytest
from fluoro_calib_msgs.msg import CalibrationStatus
from rclpy.serialization import deserialize_message
from ros_graph import NAMES, Process, entry_point

PROTOCOL = ['foxglove.sdk.v1']


def test_without_the_sdk_it_says_what_to_install(tmp_path, ros, monkeypatch):
    # Precedes the installed package on the path, as if that were missing.
    (tmp_path / 'foxglove.py').write_text('raise ImportError\n')
    monkeypatch.setenv('PYTHONPATH', os.pathsep.join([str(tmp_path), *sys.path]))
    node = Process(entry_point('bridge_node'), tmp_path / 'log')
    assert node.wait() == 1
    assert 'pip install foxglove-sdk' in node.log and 'Traceback' not in node.log


def test_foxglove_receives_the_messages_with_their_definition(graph, tmp_path):
    from websockets.asyncio.client import connect

    graph.calibration_node(tmp_path / 'out')
    graph.fork = False
    bridge = graph.start('bridge_node', {'port': 0})
    topic = f'{graph.namespace}/a/calibration_status'
    client = graph.client
    address = client.wait_until(lambda: re.search(r'ws://\S+', bridge.log))[0]

    async def foxglove():
        async with connect(address, subprotocols=PROTOCOL, max_size=None) as socket:
            subscription = ''
            while True:
                message = await asyncio.wait_for(socket.recv(), 60)
                if isinstance(message, bytes):
                    return message
                document = json.loads(message)
                for channel in document.get('channels', ()):
                    if channel['topic'] == topic:
                        offered.append(channel)
                        wanted = [{'id': 7, 'channelId': channel['id']}]
                        subscription = json.dumps({'op': 'subscribe', 'subscriptions': wanted})
                        await socket.send(subscription)
                if document['op'] == 'status':
                    # foxglove-sdk 0.30 advertises a channel just before it accepts subscribers.
                    assert document['message'].startswith('Unknown channel ID'), document
                    await socket.send(subscription)

    offered = []
    data = asyncio.run(foxglove())
    assert data[0] == 1 and struct.unpack_from('<I', data, 1)[0] == 7
    status = deserialize_message(data[13:], CalibrationStatus)
    assert status.fluoroscope in NAMES and status.exposures == 0
    (channel,) = offered
    assert channel['encoding'] == 'cdr' and channel['schemaEncoding'] == 'ros2msg'
    assert channel['schemaName'] == 'fluoro_calib_msgs/msg/CalibrationStatus'
    assert 'float64 coverage' in channel['schema']


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
