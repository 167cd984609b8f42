# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Messages that arrive faster than a node processes them."""

import threading

import pytest
from rclpy.duration import Duration
from rclpy.qos import DurabilityPolicy, QoSProfile
from std_msgs.msg import Int32

from fluoro_calib_ros.nodes.runtime.streams import FaultHandlers, StreamReader

DEPTH = 10
COUNT = 50


@pytest.mark.parametrize('latched', [False, True])
def test_messages_that_the_queue_has_displaced_are_counted(graph, latched):
    """Every message is received or counted; of latched topics only the newest messages matter."""
    client = graph.client
    heard = []
    lost = []
    busy = threading.Event()

    def on_message(message, _):
        heard.append(message.data)
        busy.wait()

    def overrun(topic, count):
        lost.append((topic, count))

    durability = DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE
    qos = QoSProfile(depth=DEPTH, durability=durability)
    faults = FaultHandlers(
        heard.append, lambda *fault: heard.append(fault), heard.append, overrun=overrun
    )
    reader = StreamReader(client, faults)
    reader.subscribe(Int32, 'numbers', on_message, qos)
    output = client.create_publisher(Int32, 'numbers', qos)
    client.wait_until(output.get_subscription_count, what='the subscription')
    reader.start()
    output.publish(Int32(data=0))
    client.wait_until(lambda: heard, what='the first message')
    for number in range(1, COUNT):
        output.publish(Int32(data=number))
        assert output.wait_for_all_acked(Duration(seconds=30))
    busy.set()
    client.wait_until(lambda: heard[-1] == COUNT - 1, what='the last message')
    reader.stop()
    assert heard == [0, *range(COUNT - DEPTH, COUNT)]
    expected = [] if latched else [('numbers', COUNT - len(heard))]
    assert lost == expected


def test_messages_of_another_publisher_are_not_lost(graph):
    """Each publisher numbers its messages: after one has ended, the other continues its own."""
    client = graph.client
    heard = []
    lost = []
    faults = FaultHandlers(
        heard.append,
        lambda *fault: heard.append(fault),
        heard.append,
        overrun=lambda _, count: lost.append(count),
    )
    reader = StreamReader(client, faults)
    qos = QoSProfile(depth=DEPTH)
    first = client.create_publisher(Int32, 'shared', qos)
    for number in range(COUNT):  # before anybody reads
        first.publish(Int32(data=number))
    reader.subscribe(Int32, 'shared', lambda message, _: heard.append(message.data), qos)
    reader.start()
    second = client.create_publisher(Int32, 'shared', qos)

    def publish(publisher):
        client.wait_until(publisher.get_subscription_count, what='the subscription')
        count = len(heard)
        publisher.publish(Int32())
        client.wait_until(lambda: len(heard) > count, what='the message')

    for publisher in (first, second):
        publish(publisher)
    client.destroy_publisher(second)
    client.wait_until(lambda: client.count_publishers(first.topic_name) == 1)
    publish(first)
    reader.stop()
    assert not lost


def test_messages_that_have_arrived_are_handled_at_the_end_where_that_is_asked_for(graph):
    client = graph.client
    heard = []
    faults = FaultHandlers(heard.append, lambda *fault: heard.append(fault), heard.append)
    reader = StreamReader(client, faults)
    reader.subscribe(
        Int32, 'pending', lambda message, _: heard.append(message.data), QoSProfile(depth=DEPTH)
    )
    output = client.create_publisher(Int32, 'pending', QoSProfile(depth=DEPTH))
    client.wait_until(output.get_subscription_count, what='the subscription')
    for number in range(DEPTH):
        output.publish(Int32(data=number))
    assert output.wait_for_all_acked(Duration(seconds=30))
    reader.stop(take_pending=True)
    assert heard == [*range(DEPTH)]
