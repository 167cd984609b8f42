# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Topics of the ROS graph: their discovery, types, and quality of service."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Iterable, Iterator, Sequence
from copy import copy
from functools import partial
from importlib import import_module
from typing import Any, NamedTuple

from ament_index_python.packages import (
    PackageNotFoundError,
    get_package_prefix,
    get_package_share_directory,
)
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import (
    DurabilityPolicy,
    HistoryPolicy,
    QoSProfile,
    ReliabilityPolicy,
)
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.subscription import Subscription
from rclpy.topic_endpoint_info import TopicEndpointInfo
from rclpy.type_support import check_for_type_support
from rclpy.validate_topic_name import validate_topic_name

from ...errors import DataError
from ...io.access import read_text
from ...io.bags.metadata import Definition, fields_of, known_definition, with_dependencies

# Discovery of topics, and waiting for readers.

# Time for readers to discover a publisher that discovered them: several times the measured one.
SETTLING_S = 0.3
DISCOVERY_S = 0.1  # period of the search for new topics


def wait_for_readers(
    node: Node, publishers: Iterable[Publisher], count: int, stop: threading.Event
) -> None:
    """Wait until each publisher of a node has `count` readers that have discovered it.

    A publisher and a reader discover each other independently. Messages published between the two
    discoveries are lost, reliable or not, and nothing signals the second one. Setting `stop` ends
    the wait.
    """
    while missing := [p.topic_name for p in publishers if p.get_subscription_count() < count]:
        node.get_logger().info(
            f'waiting for {count} readers of {", ".join(missing)}', throttle_duration_sec=5.0
        )
        if stop.wait(0.05):
            return
    if count:
        stop.wait(SETTLING_S)


def resolved_names(node: Node, topics: Iterable[str], only_expand: bool = False) -> set[str]:
    """Return the full names of topics as a node uses them; only_expand: without remapping.

    Raises NameValidationException.
    """
    return {
        node.resolve_topic_name(topic, only_expand=only_expand)
        for topic in topics
        if validate_topic_name(topic)
    }


class PublishedTopic(NamedTuple):
    """A topic of the graph that can be received."""

    name: str
    type_name: str
    kind: type[Any]  #: class of the messages
    definition: Definition
    publishers: Sequence[TopicEndpointInfo]


class TopicDiscovery:
    """Finds the topics of the graph that have a publisher, each once.

    wanted: topic names as the node uses them; if empty, all topics except hidden ones (with a name
    part that begins with an underscore). purpose: what the node does with topics, such as
    'recorded'; it warns of topics that cannot be received. Raises NameValidationException.
    """

    def __init__(self, node: Node, wanted: Iterable[str], purpose: str) -> None:
        self._node = node
        self._purpose = purpose
        self._found: set[str] = set()
        self._refused: dict[str, str] = {}  # reasons by topic
        self.wanted = resolved_names(node, wanted)

    def new(self) -> Iterator[PublishedTopic]:
        """Yield topics that were not found before and can be received."""
        for name, _ in self._node.get_topic_names_and_types():
            hidden = any(part.startswith('_') for part in name.split('/'))
            is_wanted = name in self.wanted if self.wanted else not hidden
            publishers = ()
            if is_wanted and name not in self._found:
                publishers = self._node.get_publishers_info_by_topic(name)
            if not publishers:
                continue
            types = sorted({publisher.topic_type for publisher in publishers})
            kind = installed_type(types[0])
            if len(types) > 1:
                self._refuse(name, f'it has the types {", ".join(types)}')
            elif kind is None:
                self._refuse(name, f'the type {types[0]} is not installed')
            else:
                self._found.add(name)
                definition = definition_of(types[0], type_hash_text(publishers[0]))
                yield PublishedTopic(name, types[0], kind, definition, publishers)

    def _refuse(self, name: str, reason: str) -> None:
        """Warn once that a topic cannot be received."""
        if self._refused.get(name) != reason:
            self._refused[name] = reason
            self._node.get_logger().warning(f'{name} is not {self._purpose}: {reason}')


def several_publishers(node: Node, topic: str) -> str:
    """Return a message if several nodes publish a topic, else ''.

    A killed node counts until DDS notices, within half a minute.
    """
    publishers = node.get_publishers_info_by_topic(node.resolve_topic_name(topic))
    if len(publishers) < 2:
        return ''
    names = sorted(
        f'{p.node_namespace.rstrip("/")}/{p.node_name}'
        for p in publishers
        if 'UNKNOWN' not in p.node_name  # DDS announces the names of nodes later
    )
    return f'{len(publishers)} nodes publish {topic} ({", ".join(names)})'


def publisher_conflict(node: Node, topic: str) -> str:
    """Return a message if several nodes publish a topic that only one should, else ''."""
    text = several_publishers(node, topic)
    return text and f'{text}: no new calibration is used until only one remains'


ACKNOWLEDGED_S = 10.0  # time limit for readers to acknowledge the last messages


def wait_until_acknowledged(publishers: Iterable[Publisher], stop: threading.Event) -> bool:
    """Wait until all messages have been acknowledged; return whether they have.

    Unacknowledged messages are lost when the process ends. Setting `stop` ends the wait.
    """
    end = time.monotonic() + ACKNOWLEDGED_S
    for publisher in publishers:
        while not publisher.wait_for_all_acked(Duration(seconds=0.1)):
            if stop.is_set() or time.monotonic() > end:
                return False
    return True


# Installed message types: their classes and definitions.


def installed_type(name: str) -> type[Any] | None:
    """Return the class of a message type, or None if it is not installed.

    Only packages in the ament index are imported: a bag or a peer must not name any other module.
    """
    package, _, kind = name.partition('/msg/')
    try:
        get_package_prefix(package)
        message_type: type[Any] = getattr(import_module(f'{package}.msg'), kind)
        check_for_type_support(message_type)
    except (PackageNotFoundError, ValueError, ImportError, AttributeError):
        return None
    return message_type


def type_hash_text(publisher: TopicEndpointInfo) -> str:
    """Return the type hash of a publisher, '' if the middleware does not provide it."""
    type_hash = publisher.topic_type_hash
    if type_hash is None or type_hash.version != 1 or not any(type_hash.value):
        return ''
    return f'RIHS01_{bytes(type_hash.value).hex()}'


def definition_of(name: str, type_hash: str) -> Definition:
    """Return the definition of a message type in the form that a bag contains.

    It is the definition in this package if that has the hash that publishers offer ('' if
    unknown), else that of the installed .msg files. The text is empty if there is none.
    """
    try:
        known = known_definition(name)
        if type_hash in ('', known.type_hash):
            return known
    except DataError:
        pass
    try:
        return Definition(with_dependencies(name, _installed, set()), 'ros2msg', type_hash)
    except (DataError, PackageNotFoundError, ValueError):
        return Definition('', 'ros2msg', type_hash)


def _installed(name: str) -> tuple[str, Iterable[Any]]:
    """Return the .msg file of an installed type and its fields. Raises DataError."""
    package, _, kind = name.partition('/msg/')
    text = read_text(os.path.join(get_package_share_directory(package), 'msg', f'{kind}.msg'))
    return text, fields_of(name, text, 'ros2msg')[name]


# Quality of service of the topics.
#
# Every function returns a new profile: rclpy writes the overrides of a topic into the profile
# object that it was given, so a shared object would carry them over to other topics.

# Queue for a fluoroscope at 1000 frames per second while the reader is busy for 0.1 s.
OBSERVATION_DEPTH = 100
# Images take a megabyte or more, so few are queued: a twelfth of a second at 120 Hz. A slower
# reader gets the newest ones.
IMAGE_DEPTH = 10
RECORDED_LATCHED_DEPTH = 100  # one message each of as many publishers
# Simultaneous requests that are all answered; the default of ROS is 10.
REQUEST_DEPTH = 200


def _reliable(depth: int, durability: DurabilityPolicy = DurabilityPolicy.VOLATILE) -> QoSProfile:
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=depth,
        reliability=ReliabilityPolicy.RELIABLE,
        durability=durability,
    )


observations_qos = partial(_reliable, OBSERVATION_DEPTH)  # image points and reconstructed points
images_qos = partial(_reliable, IMAGE_DEPTH)
services_qos = partial(_reliable, REQUEST_DEPTH)  # a burst of requests is queued, and answered
# Topics whose last message late subscribers also receive.
latched_qos = partial(_reliable, 1, DurabilityPolicy.TRANSIENT_LOCAL)
# The same for a player, which replays many publishers.
recorded_latched_qos = partial(_reliable, RECORDED_LATCHED_DEPTH, DurabilityPolicy.TRANSIENT_LOCAL)
# Of /clock, as in rosbag2.
clock_qos = partial(
    QoSProfile,
    history=HistoryPolicy.KEEP_LAST,
    depth=1,
    reliability=ReliabilityPolicy.BEST_EFFORT,
)
# Options by which users may override history, depth and reliability of a topic.
qos_overrides = QoSOverridingOptions.with_default_policies


def adapted_qos(publishers: Sequence[TopicEndpointInfo], depth: int) -> QoSProfile:
    """Return the profile for receiving the messages of all given publishers."""
    return received_by_all(QoSProfile(depth=depth), publishers)


def received_by_all(current: QoSProfile, publishers: Sequence[TopicEndpointInfo]) -> QoSProfile:
    """Return the profile of a subscription that is to receive the messages of all publishers."""
    qos = copy(current)
    profiles = [publisher.qos_profile for publisher in publishers]
    if profiles:
        reliable = all(p.reliability == ReliabilityPolicy.RELIABLE for p in profiles)
        latched = all(p.durability == DurabilityPolicy.TRANSIENT_LOCAL for p in profiles)
        qos.reliability = ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT
        qos.durability = DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE
    return qos


def reliable_if_offered(
    current: QoSProfile, publishers: Sequence[TopicEndpointInfo]
) -> QoSProfile:
    """Return the profile of a subscription with the reliability on which all publishers agree.

    Camera drivers often publish as best effort, and a reliable subscription receives nothing then.
    """
    qos = copy(current)
    offered = {publisher.qos_profile.reliability for publisher in publishers}
    for reliability in (ReliabilityPolicy.RELIABLE, ReliabilityPolicy.BEST_EFFORT):
        if offered == {reliability}:
            qos.reliability = reliability
    return qos


def differs(one: QoSProfile, other: QoSProfile) -> bool:
    """Return whether two profiles differ in reliability or durability."""
    return (one.reliability, one.durability) != (other.reliability, other.durability)


def is_outdated(node: Node, subscription: Subscription) -> bool:
    """Return whether a subscription must be renewed to receive all publishers; see adapted_qos."""
    publishers = node.get_publishers_info_by_topic(subscription.topic_name)
    current = subscription.qos_profile
    return differs(received_by_all(current, publishers), current)


def adaptation_message(topic: str, qos: QoSProfile) -> str:
    """Return the message about a subscription that was renewed with another profile."""
    best_effort = qos.reliability == ReliabilityPolicy.BEST_EFFORT
    latched = qos.durability == DurabilityPolicy.TRANSIENT_LOCAL
    return (
        f'topic {topic}: the subscription is now {"best effort" if best_effort else "reliable"} '
        f'and {"latched" if latched else "volatile"}, as its publishers require'
        + ('; lost messages are not sent again' if best_effort else '')
    )
