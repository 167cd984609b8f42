# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The door of the bridge: lets those who know its token through to the server of foxglove-sdk.

The server of the SDK asks nobody anything: a web page that is open on this machine could read it.
So it listens on an address of this machine that nobody can guess, and the gate in front of it
looks at the request of each client (RFC 6455, 4.1): token and Origin.
"""

from __future__ import annotations

import asyncio
import hmac
import secrets
import threading
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from urllib.parse import parse_qs, urlsplit

MAX_HEAD = 16_384  # bytes of a request
HEAD_S = 5.0  # in which it has to come
MAX_CLIENTS = 32
BLOCK = 65_536
CLIENT_ERRORS = (
    OSError,
    asyncio.TimeoutError,
    asyncio.IncompleteReadError,
    asyncio.LimitOverrunError,
)
REFUSED = b'HTTP/1.1 403 Forbidden\r\nConnection: close\r\nContent-Length: 0\r\n\r\n'


def hidden_address() -> str:
    """Return a random address of this machine, 127.0.0.0/8 (RFC 1122, 3.2.1.3)."""
    return '127.' + '.'.join(str(secrets.randbelow(254) + 1) for _ in range(3))


@dataclass(frozen=True)
class Admission:
    """Who is let through."""

    token: str  #: what the address has to end with: ?token=...
    #: web pages that may connect, such as https://app.foxglove.dev; programs that are no web page
    #: send no Origin, or none of http
    origins: Sequence[str]

    def refusal(self, head: bytes) -> str:
        """Return why a client is not let through, '' where it is; head: of its request."""
        request, *lines = head.decode('latin-1').split('\r\n')
        words = request.split(' ')
        fields = (line.partition(':') for line in lines)
        headers = {name.strip().lower(): value.strip() for name, _, value in fields}
        if len(words) != 3 or words[0] != 'GET':
            return 'this is no request of a WebSocket'
        with suppress(ValueError):
            given = parse_qs(urlsplit(words[1]).query).get('token', [''])[0]
            if hmac.compare_digest(given.encode(), self.token.encode()):
                return self._refusal_of_origin(headers.get('origin', ''))
        return 'the token is missing or wrong'

    def _refusal_of_origin(self, origin: str) -> str:
        is_page = origin == 'null' or origin.lower().startswith(('http:', 'https:'))
        return 'its Origin is not allowed' if is_page and origin not in self.origins else ''


class Gate:
    """A TCP server that passes the connections of admitted clients on, in a thread of its own.

    Parameters
    ----------
    host, port : str and int
        Where it listens; port 0 is any free one.
    inner : (str, int)
        Host and port of the server behind it.
    admission : Admission
    on_refused : callable
        Called with the address of a client and the reason, in the thread.

    Raises
    ------
    OSError
        Where it cannot listen.
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
        self._clients: set[asyncio.Task[None]] = set()
        self._loop = asyncio.new_event_loop()
        server = self._loop.run_until_complete(
            asyncio.start_server(self._serve, host, port, limit=MAX_HEAD)
        )
        self.port: int = server.sockets[0].getsockname()[1]
        threading.Thread(target=self._loop.run_forever, name='gate', daemon=True).start()

    def close(self) -> None:
        """Let nobody through any more."""
        self._loop.call_soon_threadsafe(self._loop.stop)

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Look at the request of a client, and pass on what both sides send."""
        task = asyncio.current_task()
        assert task is not None
        self._clients.add(task)
        try:
            with suppress(*CLIENT_ERRORS):
                await self._admit(reader, writer)
        finally:
            self._clients.discard(task)
            writer.close()

    async def _admit(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        reason = 'there are too many clients'
        head = b''
        if len(self._clients) <= MAX_CLIENTS:
            head = await asyncio.wait_for(reader.readuntil(b'\r\n\r\n'), HEAD_S)
            reason = self._admission.refusal(head)
        if reason:
            self._on_refused(str(writer.get_extra_info('peername')), reason)
            writer.write(REFUSED)
            await writer.drain()
            return
        from_inner, to_inner = await asyncio.open_connection(*self._inner)
        to_inner.write(b'GET / HTTP/1.1' + head[head.index(b'\r\n') :])
        try:
            ways = (_pass_on(reader, to_inner), _pass_on(from_inner, writer))
            tasks = [asyncio.ensure_future(way) for way in ways]
            _, rest = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
            for task in rest:
                task.cancel()
        finally:
            to_inner.close()


async def _pass_on(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    """Pass on what comes until one side ends; a slow reader is waited for."""
    with suppress(OSError):
        while data := await reader.read(BLOCK):
            writer.write(data)
            await writer.drain()
