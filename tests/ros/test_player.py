# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The player starts with an offset, steps, pauses, and publishes the recorded time."""

from __future__ import annotations

import time

import pytest
from mcap.writer import Writer
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rigs import write_frame
from ros_graph import BAGS
from rosgraph_msgs.msg import Clock
from std_srvs.srv import SetBool, Trigger

from fluoro_calib_ros.io.bags.reader import iterate_messages
from fluoro_calib_ros.io.bags.writer import BagWriter

TOPIC = '/a/target_observations'
OFFSET_S = 0.5


def test_player_steps_pauses_and_publishes_the_time(graph):
    times = [m.log_time_ns for m in iterate_messages(BAGS / 'tracking', [TOPIC])]
    begin_ns = times[0] + round(OFFSET_S * 1e9)
    later = [time for time in times if time >= begin_ns]
    client = graph.client
    received = client.listen('a/target_observations')
    clock: list[int] = []
    client.create_subscription(
        Clock,
        '/clock',
        lambda m: clock.append(m.clock.sec * 10**9 + m.clock.nanosec),
        QoSProfile(depth=100, reliability=ReliabilityPolicy.BEST_EFFORT),
    )
    client.expect(Trigger, 'player_node/step')
    client.expect(SetBool, 'player_node/pause')
    player = graph.start(
        'player_node',
        {
            'bag': BAGS / 'tracking',
            'topics': f'[{TOPIC}]',
            'start_offset': OFFSET_S,
            'start_paused': True,
            'clock': 100.0,
        },
        wait=False,
    )
    for count in (1, 2, 3):
        assert client.call(Trigger, 'player_node/step').success
        client.wait_until(lambda count=count: len(received) == count, what='a message')
    # During the pause, the time stays at the last message.
    client.wait_until(lambda: clock and clock[-1] == later[2], what='the time of the message')
    assert not client.call(SetBool, 'player_node/pause', data=True).success  # already paused
    resumed = time.monotonic()
    assert client.call(SetBool, 'player_node/pause', data=False).success
    client.wait_until(lambda: len(received) > 10, what='messages')
    assert not client.call(Trigger, 'player_node/step').success  # not paused
    client.wait_until(lambda: not player.running, what='the end of the bag')
    assert player.wait() == 0
    client.wait_until(lambda: len(received) == len(later), what='all messages')
    assert clock == sorted(clock)
    played_s = time.monotonic() - resumed
    assert begin_ns <= clock[0] and clock[-1] <= later[2] + played_s * 1e9


def test_offset_behind_the_end_is_told(graph):
    player = graph.start(
        'player_node',
        {'bag': BAGS / 'tracking', 'start_offset': 1e6, 'wait_for_readers': 0},
        wait=False,
    )
    assert player.wait() == 1
    assert 'there is no message 1e+06 s after the first one' in player.log


@pytest.mark.parametrize(
    ('parameters', 'topics'),
    [
        ({'strip_prefix': '/rig'}, ['/a/target_observations', '/rig_b/b/target_observations']),
        (
            {'topics': '[rig/a/target_observations, /rig_b/b/mistyped]'},
            ['/rig/a/target_observations'],
        ),
    ],
)
def test_topics_and_prefixes_are_whole_names(graph, exposures, tmp_path, parameters, topics):
    client = graph.client
    with BagWriter(tmp_path / 'bag') as bag:
        write_frame(bag, exposures['a'][0], '/rig/a/target_observations')
        write_frame(bag, exposures['b'][0], '/rig_b/b/target_observations')
    player = graph.start(
        'player_node',
        {'bag': tmp_path / 'bag', 'start_paused': True, **parameters},
        {'__ns': '/'},
        wait=False,
    )

    def played():
        found = client.get_publisher_names_and_types_by_node('player_node', '/')
        return sorted(name for name, _ in found if name.endswith('observations'))

    client.wait_until(
        lambda: ('player_node', '/') in client.get_node_names_and_namespaces() and played(),
        what='the player',
    )
    client.wait_until(lambda: played() == topics, what='its topics')
    said = 'there is no topic /rig_b/b/mistyped' in player.log
    assert said == ('topics' in parameters)


def test_messages_of_another_definition_or_encoding_are_not_played_silently(graph, tmp_path):
    path = tmp_path / 'bag.mcap'
    with open(path, 'wb') as file:
        writer = Writer(file)
        writer.start('ros2', 'test')
        text = writer.register_schema('std_msgs/msg/String', 'ros2msg', b'uint32 number')
        other = {'topic_type_hash': f'RIHS01_{"0" * 64}'}
        channels = [
            writer.register_channel('/other', 'cdr', text, other),
            writer.register_channel('/json', 'json', text, {}),
        ]
        for channel in channels:
            writer.add_message(channel, 1, b'\0\1\0\0\5\0\0\0', 1)
        writer.finish()
    player = graph.start('player_node', {'bag': path, 'wait_for_readers': 0}, wait=False)
    assert player.wait() == 0
    assert '/other was recorded with another definition of std_msgs/msg/String' in player.log
    assert "/json is not played: it is encoded as 'json'" in player.log
    assert '1 messages played' in player.log
