# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Node that shows the topics of a rig to Foxglove, also on machines without ROS.

The server of foxglove-sdk does not authenticate its clients: any web page open on this machine
could read from it. It therefore listens on a random loopback address that nobody can guess. A gate
in front of it checks token and Origin in the request of each client (RFC 6455, 4.1), and forwards
only admitted clients to the server.

The WebSocket server of foxglove-sdk passes messages on unchanged (CDR), with their definitions. A
topic is subscribed to only while a client reads it.
"""

from __future__ import annotations

import asyncio
import hmac
import secrets
import threading
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from typing import Any
from urllib.parse import parse_qs, quote, urlsplit

from rclpy.qos import DurabilityPolicy
from rclpy.subscription import Subscription

from ..options import option
from .runtime.diagnostics import RateLimitedLogger, StartError
from .runtime.main import run
from .runtime.parameters import ParameterGroup, ParameterNode
from .runtime.topics import (
    DISCOVERY_S,
    IMAGE_DEPTH,
    RECORDED_LATCHED_DEPTH,
    TopicDiscovery,
    adapted_qos,
    is_outdated,
)

HEAD_S = 5.0  # time limit for receiving the head of a request
MAX_CLIENTS = 32  # simultaneous clients that are admitted
CLIENT_ERRORS = (
    OSError,
    asyncio.TimeoutError,
    asyncio.IncompleteReadError,
    asyncio.LimitOverrunError,
)
REFUSED = b'HTTP/1.1 403 Forbidden\r\nConnection: close\r\nContent-Length: 0\r\n\r\n'


def hidden_address() -> str:
    """Return a random loopback address of this machine, in 127.0.0.0/8 (RFC 1122, 3.2.1.3)."""
    return '127.' + '.'.join(str(secrets.randbelow(254) + 1) for _ in range(3))


@dataclass(frozen=True)
class Admission:
    """Decides which clients are let through."""

    token: str  #: that the address of a client has to end with: ?token=...
    #: web pages that may connect, such as https://app.foxglove.dev; other programs send no Origin,
    #: or none of http(s)
    origins: Sequence[str]

    def refusal(self, head: bytes) -> str:
        """Return why a client is refused, '' if it is admitted; head: of its request."""
        request, *lines = head.decode('latin-1').split('\r\n')
        words = request.split(' ')
        fields = (line.partition(':') for line in lines)
        headers = {name.strip().lower(): value.strip() for name, _, value in fields}
        if len(words) != 3 or words[0] != 'GET':
            return 'this is not a WebSocket request'
        token = ''
        with suppress(ValueError):
            token = parse_qs(urlsplit(words[1]).query).get('token', [''])[0]
        if not hmac.compare_digest(token.encode(), self.token.encode()):
            return 'the token is missing or wrong'
        origin = headers.get('origin', '')
        is_page = origin == 'null' or origin.lower().startswith(('http:', 'https:'))
        return 'its Origin is not allowed' if is_page and origin not in self.origins else ''


class Gate:
    """TCP server, in its own thread, that forwards the connections of admitted clients.

    host, port: where it listens; port 0 is any free one. inner: host and port of the server behind
    it. on_refused: called in that thread with the address and the reason of a refused client.
    Raises OSError if it cannot listen.
    """

    def __init__(
        self,
        host: str,
        port: int,
        inner: tuple[str, int],
        admission: Admission,
        on_refused: Callable[[str, str], None],
    ) -> None:
        self._inner = inner
        self._admission = admission
        self._on_refused = on_refused
        self._admitted = 0  # number of clients
        self._loop = asyncio.new_event_loop()
        self._server = self._loop.run_until_complete(asyncio.start_server(self._serve, host, port))
        self.port: int = self._server.sockets[0].getsockname()[1]
        self._thread = threading.Thread(target=self._loop.run_forever, name='gate', daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop listening, and end all connections."""
        asyncio.run_coroutine_threadsafe(self._end(), self._loop).result()
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()
        self._loop.close()

    async def _end(self) -> None:
        self._server.close()
        tasks = asyncio.all_tasks() - {asyncio.current_task()}
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Serve a client until it or the gate ends."""
        try:
            with suppress(*CLIENT_ERRORS):
                await self._admit(reader, writer)
        except asyncio.CancelledError:  # by close(); asyncio would log it
            writer.transport.abort()  # close() would wait for a client that does not read
        finally:
            writer.close()

    async def _admit(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        head = await asyncio.wait_for(reader.readuntil(b'\r\n\r\n'), HEAD_S)
        reason = self._admission.refusal(head)
        if not reason and self._admitted >= MAX_CLIENTS:
            reason = 'there are too many clients'
        if reason:
            self._on_refused(str(writer.get_extra_info('peername')), reason)
            writer.write(REFUSED)
            await writer.drain()
            return
        self._admitted += 1
        try:
            await self._forward(head, reader, writer)
        finally:
            self._admitted -= 1

    async def _forward(
        self, head: bytes, reader: asyncio.StreamReader, writer: asyncio.StreamWriter
    ) -> None:
        """Forward the request with this head, then data in both directions."""
        inner_reader, inner_writer = await asyncio.open_connection(*self._inner)
        inner_writer.write(b'GET / HTTP/1.1' + head[head.index(b'\r\n') :])
        try:
            transfers = (_pass_on(reader, inner_writer), _pass_on(inner_reader, writer))
            tasks = [asyncio.ensure_future(transfer) for transfer in transfers]
            _, pending = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
            for task in pending:
                task.cancel()
        finally:
            inner_writer.close()


async def _pass_on(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    """Forward data until one side ends; wait for a slow receiver."""
    with suppress(OSError):
        while data := await reader.read(65_536):
            writer.write(data)
            await writer.drain()


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
        '', 'token that ends the address of a client, ?token=...; empty: a new one at every start'
    )
    origins: tuple[str, ...] = option(
        ('https://app.foxglove.dev',), 'web pages that may connect; others are refused'
    )


_NODE = ParameterGroup(BridgeParameters)
PARAMETERS = (_NODE,)


@dataclass
class _Shown:
    """Topic that is offered to clients."""

    topic: str
    kind: type
    channel: Any
    subscription: Subscription | None = None
    is_latched: bool = False  #: whether publishers send their last messages to new subscriptions


class BridgeNode(ParameterNode):
    """Offers topics on a WebSocket and passes messages on to clients that subscribe."""

    def __init__(self) -> None:
        super().__init__('bridge_node')
        settings = _NODE.declare(self)
        self._foxglove = _foxglove()
        self._topics_of_graph = TopicDiscovery(self, filter(None, settings.topics), 'shown')
        self._shown: dict[str, _Shown] = {}
        self._lock = threading.Lock()
        self._readers: Counter[str] = Counter()  # by topic; changed by server threads
        self._newcomers: set[str] = set()  # topics with a reader who missed the latched messages
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
        """Open the gate that lets clients through to the server. Raises StartError."""

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
        """Offer new topics, subscribe to those with readers, and unsubscribe from the others."""
        self._discover()
        with self._lock:
            read_topics = {topic for topic, count in self._readers.items() if count > 0}
            newcomers = self._newcomers
            self._newcomers = set()
        for shown in self._shown.values():
            is_read = shown.topic in read_topics
            if shown.subscription is not None and (
                not is_read
                or (shown.topic in newcomers and shown.is_latched)
                or is_outdated(self, shown.subscription)
            ):
                self.destroy_subscription(shown.subscription)
                shown.subscription = None
            if is_read and shown.subscription is None:
                self._subscribe(shown)

    def _discover(self) -> None:
        for topic in self._topics_of_graph.new():
            definition = topic.definition
            schema = self._foxglove.Schema(
                name=topic.type_name, encoding=definition.encoding, data=definition.text.encode()
            )
            channel = self._foxglove.Channel(topic.name, schema=schema, message_encoding='cdr')
            self._shown[topic.name] = _Shown(topic.name, topic.kind, channel)

    def _subscribe(self, shown: _Shown) -> None:
        qos = adapted_qos(self.get_publishers_info_by_topic(shown.topic), IMAGE_DEPTH)
        shown.is_latched = qos.durability == DurabilityPolicy.TRANSIENT_LOCAL
        if shown.is_latched:
            qos.depth = RECORDED_LATCHED_DEPTH
        shown.subscription = self.create_subscription(
            shown.kind, shown.topic, shown.channel.log, qos, raw=True
        )

    def stop(self) -> None:
        """Close the WebSocket."""
        self._gate.close()
        self._server.stop()


def _foxglove() -> Any:
    """Import foxglove-sdk. Raises StartError if it is not installed."""
    try:
        import foxglove
    except ImportError:
        raise StartError(
            'the bridge needs foxglove-sdk, which is not installed: pip install foxglove-sdk'
        ) from None
    return foxglove


main = partial(run, BridgeNode)

if __name__ == '__main__':
    main()
