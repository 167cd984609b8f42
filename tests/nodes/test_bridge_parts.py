# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The gate of the bridge without a graph: what its end closes."""

import socket
import threading
from contextlib import ExitStack, suppress

import pytest

from fluoro_calib_ros.nodes import bridge_node
from fluoro_calib_ros.nodes.bridge_node import Admission, Gate

HOST = '127.0.0.1'
REQUEST = b'GET /?token=t HTTP/1.1\r\nHost: x\r\n\r\n'
MUCH = b'x' * 20_000_000  # more than the buffers of sockets hold


@pytest.fixture
def inner():
    """Server behind a gate that answers each connection with what a test appends."""
    answer = []
    with socket.create_server((HOST, 0)) as server:

        def serve():
            while True:
                try:
                    connection, _ = server.accept()
                except OSError:
                    return
                threading.Thread(target=reply, args=(connection,), daemon=True).start()

        def reply(connection):
            with connection:
                try:
                    connection.sendall(b''.join(answer))
                    while connection.recv(1000):
                        pass
                except OSError:
                    pass

        thread = threading.Thread(target=serve, daemon=True)
        thread.start()
        yield server.getsockname(), answer
        server.shutdown(socket.SHUT_RDWR)
        thread.join()


def received(connection):
    """Return the number of bytes that arrive until the connection ends."""
    count = 0
    with suppress(ConnectionResetError):
        while data := connection.recv(1_000_000):
            count += len(data)
    return count


def test_only_admitted_clients_count(inner, monkeypatch):
    """Connections without a token do not keep the right one out."""
    monkeypatch.setattr(bridge_node, 'MAX_CLIENTS', 1)
    address, answers = inner
    answers.append(b'hello')
    refused = []
    gate = Gate(HOST, 0, address, Admission('t', ()), lambda _, reason: refused.append(reason))
    with ExitStack() as clients:

        def connect():
            address = HOST, gate.port
            return clients.enter_context(socket.create_connection(address, 30))

        for _ in range(5):
            connect()
        admitted = connect()
        admitted.sendall(REQUEST)
        assert admitted.recv(5) == b'hello' and not refused
        second = connect()
        second.sendall(REQUEST)
        assert second.recv(12) == b'HTTP/1.1 403' and refused == ['there are too many clients']
        gate.close()


@pytest.mark.parametrize('answer', [b'hello', MUCH], ids=['reads', 'does not read'])
def test_closed_gate_neither_listens_nor_keeps_clients(inner, answer, caplog):
    address, answers = inner
    answers.append(answer)
    gate = Gate(HOST, 0, address, Admission('t', ()), on_refused=lambda *_: None)
    with (
        socket.create_connection((HOST, gate.port), 30) as admitted,
        socket.create_connection((HOST, gate.port), 30) as silent,  # sends no request
    ):
        admitted.sendall(REQUEST)
        assert admitted.recv(5)
        gate.close()
        assert 5 + received(admitted) < len(MUCH)
        assert not received(silent)
        with pytest.raises(ConnectionRefusedError):
            socket.create_connection((HOST, gate.port), 30)
    assert not caplog.records  # asyncio logs the errors of tasks
