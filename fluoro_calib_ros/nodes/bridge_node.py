# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Node that shows the topics of a rig to Foxglove, also on machines without ROS.

Messages are passed on as they are (CDR), with their definitions, by a WebSocket of foxglove-sdk. A
topic is subscribed only while somebody looks at it.
"""

from __future__ import annotations

import secrets
import threading
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any
from urllib.parse import quote

from rclpy.qos import DurabilityPolicy
from rclpy.subscription import Subscription

from ..options import option
from .bridge_gate import Admission, Gate, hidden_address
from .recorder_node import adapted_qos, type_hash_text
from .runtime.logging import RateLimitedLogger, StartError
from .runtime.main import run
from .runtime.parameters import ParameterGroup, ParameterNode
from .runtime.streams import TopicDiscovery, definition_of, installed_type

DISCOVERY_S = 0.2  # period in which new topics, and new readers, are looked for
DEPTH = 10  # messages that wait, of one topic


@dataclass(frozen=True)
class BridgeParameters:
    """Parameters of the bridge."""

    host: str = option(
        '127.0.0.1',
        'address on which it listens: 127.0.0.1 for programs of this machine, 0.0.0.0 for all',
    )
    port: int = option(8765, 'port of the WebSocket; 0: any free one', minimum=0, maximum=65535)
    topics: tuple[str, ...] = option(('',), 'topics to show; empty: all')
    token: str = option(
        '', 'what the address of a client ends with, ?token=...; empty: a new one at every start'
    )
    origins: tuple[str, ...] = option(
        ('https://app.foxglove.dev',), 'web pages that may connect; others are refused'
    )


_NODE = ParameterGroup(BridgeParameters)
PARAMETERS = (_NODE,)


@dataclass
class _Shown:
    """A topic that is offered."""

    topic: str
    kind: type
    channel: Any
    subscription: Subscription | None = None
    last: bytes = b''  # of a latched topic


class BridgeNode(ParameterNode):
    """Offers topics on a WebSocket, and passes messages on to those who subscribe."""

    def __init__(self) -> None:
        super().__init__('bridge_node')
        settings = _NODE.declare(self)
        self._foxglove = _foxglove()
        self._topics_of_graph = TopicDiscovery(self, filter(None, settings.topics))
        self._shown: dict[str, _Shown] = {}
        self._lock = threading.Lock()
        self._readers: Counter[str] = Counter()  # by topic; changed by the server's threads
        self._newcomers: set[str] = set()  # topics with a reader who missed the latched message
        self._limited_logger = RateLimitedLogger(self.get_logger())
        self._token = settings.token or secrets.token_urlsafe(16)
        self._server = self._start_server()
        self._gate = self._open_gate(settings)
        self.create_timer(DISCOVERY_S, self._update)
        address = f'ws://{settings.host}:{self._gate.port}/?token={quote(self._token)}'
        self.get_logger().info(f'open {address} in Foxglove; the layout is config/foxglove.json')

    def _start_server(self) -> Any:
        """Start the WebSocket server, on an address that only the gate knows."""
        node = self

        class Listener(self._foxglove.ServerListener):  # type: ignore[name-defined]
            def on_subscribe(self, client: Any, channel: Any) -> None:
                node._count_reader(channel.topic, 1)

            def on_unsubscribe(self, client: Any, channel: Any) -> None:
                node._count_reader(channel.topic, -1)

        self._address = hidden_address()
        return self._foxglove.start_server(
            name=f'fluoro_calib_ros {self.get_namespace()}',
            host=self._address,
            port=0,
            server_listener=Listener(),
        )

    def _open_gate(self, settings: BridgeParameters) -> Gate:
        """Let clients through to the server. Raises StartError."""

        def on_refused(client: str, reason: str) -> None:
            self._limited_logger.warning(f'client {client} refused: {reason}')

        try:
            return Gate(
                settings.host,
                settings.port,
                (self._address, self._server.port),
                admission=Admission(self._token, settings.origins),
                on_refused=on_refused,
            )
        except OSError as error:
            raise StartError(
                f'no WebSocket on {settings.host}:{settings.port} ({error}); parameter port '
                'chooses another'
            ) from None

    def _count_reader(self, topic: str, change: int) -> None:
        with self._lock:
            self._readers[topic] += change
            if change > 0:
                self._newcomers.add(topic)

    def _update(self) -> None:
        """Offer new topics; subscribe to those with readers, and to no others."""
        self._discover()
        with self._lock:
            read = {topic for topic, count in self._readers.items() if count > 0}
            newcomers = self._newcomers
            self._newcomers = set()
        for shown in self._shown.values():
            if shown.topic in read and shown.subscription is None:
                self._subscribe(shown)
            elif shown.topic not in read and shown.subscription is not None:
                self.destroy_subscription(shown.subscription)
                shown.subscription = None
                shown.last = b''
            elif shown.topic in newcomers and shown.last:
                shown.channel.log(shown.last)

    def _discover(self) -> None:
        for topic, types, publishers in self._topics_of_graph.new():
            kind = installed_type(types[0]) if len(types) == 1 else None
            if kind is None:
                self.get_logger().warning(f'{topic} is not shown: its type is not installed')
                continue
            definition = definition_of(types[0], type_hash_text(publishers[0]))
            schema = self._foxglove.Schema(
                name=types[0], encoding=definition.encoding, data=definition.text.encode()
            )
            channel = self._foxglove.Channel(topic, schema=schema, message_encoding='cdr')
            self._shown[topic] = _Shown(topic, kind, channel)

    def _subscribe(self, shown: _Shown) -> None:
        qos = adapted_qos(self.get_publishers_info_by_topic(shown.topic))
        is_latched = qos.durability == DurabilityPolicy.TRANSIENT_LOCAL
        qos.depth = DEPTH

        def on_message(data: bytes) -> None:
            shown.channel.log(data)
            if is_latched:
                shown.last = data

        shown.subscription = self.create_subscription(
            shown.kind, shown.topic, on_message, qos, raw=True
        )

    def stop(self) -> None:
        """Close the WebSocket."""
        self._gate.close()
        self._server.stop()


def _foxglove() -> Any:
    """Import the SDK. Raises StartError where it is not installed."""
    try:
        import foxglove
    except ImportError:
        raise StartError(
            'the bridge needs foxglove-sdk, which is not installed: pip install foxglove-sdk'
        ) from None
    return foxglove


def main(args: Sequence[str] | None = None) -> None:
    """Run the node."""
    run(BridgeNode, args)


if __name__ == '__main__':
    main()
