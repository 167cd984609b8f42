# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Node that records topics into a bag, as bytes, until it is interrupted."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

from rclpy.duration import Duration
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.topic_endpoint_info import TopicEndpointInfo

from ..errors import DataError
from ..io.bags.recording import Recording, RecordingOptions, TopicToRecord, lost_text
from ..options import option
from .runtime.conditions import fails, health_of, healthy, warns
from .runtime.diagnostics import DiagnosticsPublisher, RateLimitedLogger, StartError, Status
from .runtime.main import run
from .runtime.parameters import ParameterGroup, ParameterNode, expand_path
from .runtime.streams import FaultHandlers, StreamReader
from .runtime.topics import (
    DISCOVERY_S,
    PublishedTopic,
    TopicDiscovery,
    adapted_qos,
    received_by_all,
)

JOINT_STATES = 'joint_states'
DEPTH = 1000  # queue length of each topic for the reading thread


@dataclass(frozen=True)
class RecorderParameters:
    """Parameters of the recorder."""

    folder: str = option('', 'folder of the new bag, which must not exist')
    topics: tuple[str, ...] = option(('',), 'topics to record; empty: all')
    angle_joint: str = option(
        '',
        'joint of the C-arm, as for the correction node; if set, joint_states is recorded in '
        'addition to topics',
    )


_NODE = ParameterGroup(RecorderParameters)
_RECORDING = ParameterGroup(RecordingOptions)
PARAMETERS = (_NODE, _RECORDING)


CONDITIONS = (
    fails(lambda node: node.fault()),
    warns(lambda node: node.loss()),
    warns(lambda node: node.lost_at_input()),
    healthy('recording'),
)


class RecorderNode(ParameterNode):
    """Records the messages of topics unchanged, from the discovery of their first publisher."""

    end_s = 60.0  # time for writing what was received, see runtime.main

    def __init__(self) -> None:
        super().__init__('recorder_node')
        self._settings = _NODE.declare(self)
        options = _RECORDING.declare(self)
        if not self._settings.folder:
            raise StartError('parameter folder is not set: it names the bag to record')
        topics = [topic for topic in self._settings.topics if topic]
        if topics and self._settings.angle_joint:
            topics.append(JOINT_STATES)
        self._topics_of_graph = TopicDiscovery(self, topics, 'recorded')  # may refuse names
        try:
            self._recording = Recording(expand_path(self._settings.folder), options)
            self._recording.start()
        except DataError as error:
            raise StartError(str(error)) from None
        self._topics: set[str] = set()
        self._latched: dict[str, TopicToRecord] = {}
        self._overrun: Counter[str] = Counter()  # messages lost at the input by topic
        self._limited_logger = RateLimitedLogger(self.get_logger())
        self._reader = StreamReader(
            self,
            FaultHandlers(
                lambda topic: self._limited_logger.error(f'{topic}: a message cannot be taken'),
                lambda topic, error: self._limited_logger.error(f'{topic}: {error!r}'),
                self.fail,
                overrun=lambda topic, count: self._overrun.update({topic: count}),
            ),
            received_by_all,
        )
        self._reader.start()
        self._diagnostics = DiagnosticsPublisher(self)
        self._discover()
        self.create_timer(DISCOVERY_S, self._discover)
        self.create_timer(1.0, self._on_timer)
        self.get_logger().info(f'recording to {self._recording.path}')

    def _discover(self) -> None:
        """Subscribe to topics that have appeared since the last call."""
        for topic in self._topics_of_graph.new():
            self._subscribe(topic)
        for name, entry in self._latched.items():
            count = latched_count(self.get_publishers_info_by_topic(name))
            if count > entry.latched:
                self._latched[name] = entry._replace(latched=count)
                self._recording.add_topic(self._latched[name])

    def _subscribe(self, published: PublishedTopic) -> None:
        """Record a topic."""
        topic = published.name
        qos = adapted_qos(published.publishers, DEPTH)
        is_latched = qos.durability == DurabilityPolicy.TRANSIENT_LOCAL
        entry = TopicToRecord(
            topic,
            published.type_name,
            [qos_document(publisher.qos_profile) for publisher in published.publishers],
            published.definition,
            latched_count(published.publishers) if is_latched else 0,
        )
        try:
            self._recording.add_topic(entry)
        except DataError as error:
            self.get_logger().warning(f'{topic} is not recorded: {error}')
            return
        self._topics.add(topic)
        if is_latched:
            self._latched[topic] = entry

        def on_message(data: bytes, info: dict[str, int]) -> None:
            received = info.get('received_timestamp') or time.time_ns()
            sent = info.get('source_timestamp') or received
            if not self._recording.put(topic, data, received, sent):
                self._limited_logger.error(self.loss())

        self._reader.subscribe(published.kind, topic, on_message, qos, decode=lambda data: data)
        self.get_logger().info(f'recording {topic} [{published.type_name}]')

    def fault(self) -> str:
        """Return a message if writing has failed, '' if it has not."""
        return self._recording.fault and (self.loss() or self._recording.fault)

    def loss(self) -> str:
        """Return a message about dropped messages and the cause, '' if none was dropped."""
        dropped = lost_text(self._recording.dropped)
        cause = self._recording.fault or 'the disk is too slow'
        return f'messages are dropped, {cause}: {dropped}' if dropped else ''

    def lost_at_input(self) -> str:
        """Return a message about messages lost at the input, '' if none was lost."""
        lost = lost_text(self._overrun)
        return f'messages are lost at the input, they come too fast: {lost}' if lost else ''

    def _on_timer(self) -> None:
        """Adapt subscriptions to publishers that have restarted; publish the diagnostics."""
        self._reader.adapt()
        recording = self._recording
        if recording.fault:
            self._limited_logger.error(recording.fault)
        counts = {
            'messages': recording.counts.total(),
            'messages dropped': recording.dropped.total(),
            'messages lost at the input': self._overrun.total(),
            'topics': len(self._topics),
            'files': recording.files,
            'waiting [MB]': f'{recording.waiting_bytes / 1e6:.1f}',
        }
        self._diagnostics.publish([Status('recorder', *health_of(self, CONDITIONS), counts)])

    def stop(self) -> None:
        """Write all received messages, and close the bag."""
        self._reader.stop(take_pending=True)
        self._recording.stop()
        self.failed = self.failed or bool(self._recording.fault)
        for fault in filter(None, (self.fault() or self.loss(), self.lost_at_input())):
            self.get_logger().error(fault)
        missing = sorted(self._topics_of_graph.wanted - self._topics)
        if missing:
            self.get_logger().warning(f'nobody has published {", ".join(missing)}')
        self.get_logger().info(
            f'{self._recording.counts.total()} messages of {len(self._topics)} topics recorded to '
            f'{self._recording.path}, {self._recording.dropped.total()} dropped; at most '
            f'{self._recording.most_waiting_bytes / 1e6:.1f} MB waited'
        )


def latched_count(publishers: Sequence[TopicEndpointInfo]) -> int:
    """Return how many messages of latched publishers a node that begins to listen receives.

    The middleware may not tell the depth of a publisher (0), which is 1 for latched topics.
    """
    return sum(max(publisher.qos_profile.depth, 1) for publisher in publishers)


def qos_document(profile: QoSProfile) -> dict[str, Any]:
    """Return an offered QoS profile in the form that bags contain."""
    return {
        'history': profile.history.name.lower(),
        'depth': profile.depth,
        'reliability': profile.reliability.name.lower(),
        'durability': profile.durability.name.lower(),
        'deadline': _duration(profile.deadline),
        'lifespan': _duration(profile.lifespan),
        'liveliness': profile.liveliness.name.lower(),
        'liveliness_lease_duration': _duration(profile.liveliness_lease_duration),
        'avoid_ros_namespace_conventions': profile.avoid_ros_namespace_conventions,
    }


def _duration(duration: Duration) -> dict[str, int]:
    seconds, nanoseconds = divmod(duration.nanoseconds, 10**9)
    return {'sec': seconds, 'nsec': nanoseconds}


main = partial(run, RecorderNode)

if __name__ == '__main__':
    main()
