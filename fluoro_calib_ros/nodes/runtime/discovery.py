# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Waiting for the other end of a topic."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterable

from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import ReliabilityPolicy
from rclpy.subscription import Subscription

# Time in which readers discover a publisher that has discovered them, several times the measured
# one.
SETTLING_S = 0.3


def wait_for_readers(
    node: Node, publishers: Iterable[Publisher], count: int, stop: threading.Event
) -> None:
    """Wait until each publisher of a node has `count` readers, and these know it.

    A publisher discovers a reader and the reader the publisher independently of each other. What
    is published between these moments is lost, reliable or not, and nothing signals the second
    one. Setting `stop` ends the wait.
    """
    while missing := [p.topic_name for p in publishers if p.get_subscription_count() < count]:
        node.get_logger().info(
            f'waiting for {count} readers of {", ".join(missing)}', throttle_duration_sec=5.0
        )
        if stop.wait(0.05):
            return
    if count:
        stop.wait(SETTLING_S)


def needs_best_effort(node: Node, subscription: Subscription) -> bool:
    """Return whether a reliable subscription has publishers, all of them best effort."""
    if subscription.qos_profile.reliability != ReliabilityPolicy.RELIABLE:
        return False
    publishers = node.get_publishers_info_by_topic(subscription.topic_name)
    return bool(publishers) and all(
        p.qos_profile.reliability == ReliabilityPolicy.BEST_EFFORT for p in publishers
    )


def best_effort_message(topic: str) -> str:
    """Return the message about a topic that is subscribed best effort from now on."""
    return (
        f'topic {topic}: its publishers offer best effort only; it is subscribed best effort now, '
        'so lost messages are not sent again'
    )


def publisher_conflict(node: Node, topic: str) -> str:
    """Return a message where several nodes publish a topic that belongs to one, else ''.

    A node that was killed counts until DDS notices, within half a minute.
    """
    publishers = node.get_publishers_info_by_topic(node.resolve_topic_name(topic))
    if len(publishers) < 2:
        return ''
    names = sorted(
        f'{p.node_namespace.rstrip("/")}/{p.node_name}'
        for p in publishers
        if 'UNKNOWN' not in p.node_name  # DDS announces the names of nodes later
    )
    return (
        f'{len(publishers)} nodes publish {topic} ({", ".join(names)}): no new calibration is '
        'used until only one is left'
    )


def wait_until_acknowledged(
    publishers: Iterable[Publisher], stop: threading.Event, timeout_s: float = 10.0
) -> bool:
    """Wait until all messages have arrived, and return whether they have.

    What is not acknowledged is lost when the process ends. Setting `stop` ends the wait.
    """
    end = time.monotonic() + timeout_s
    for publisher in publishers:
        while not publisher.wait_for_all_acked(Duration(seconds=0.1)):
            if stop.is_set() or time.monotonic() > end:
                return False
    return True
