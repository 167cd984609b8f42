# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Services of a node, made from a table, and what their answers wait for."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import Any, NamedTuple

from rclpy.callback_groups import CallbackGroup
from rclpy.node import Node
from rclpy.service import Service
from rclpy.task import Future

from .lifecycle import guard_services
from .parameters import ParameterNode
from .streams import services_qos


class ServiceEntry(NamedTuple):
    """A service: name, type, and a handler (request, response) -> response, also a coroutine."""

    name: str
    kind: type
    handler: Callable[[Any, Any], Any]


def create_services(
    node: Node, table: Iterable[ServiceEntry], group: CallbackGroup | None = None
) -> list[Service]:
    """Make the services of a table; one whose handler raises says so in its answer.

    Handlers that are coroutines need a reentrant group, or they keep others from being answered.
    """
    services = [
        node.create_service(
            entry.kind,
            entry.name,
            entry.handler,
            qos_profile=services_qos(),
            callback_group=group,
        )
        for entry in table
    ]
    guard_services(node, services)
    return services


class Requests:
    """Counts the requests whose answers wait for something."""

    def __init__(self) -> None:
        self.waiting = 0

    @contextmanager
    def one(self) -> Iterator[None]:
        """Count a request while it is being answered."""
        self.waiting += 1
        try:
            yield
        finally:
            self.waiting -= 1


async def within(
    node: ParameterNode, timeout_s: float, future: Future, give_up: Callable[[], object]
) -> Any:
    """Return the result of a Future; give_up() is called when the time is up and has to set it."""
    timer = node.create_timer(timeout_s, give_up)
    result = await future
    node.destroy_timer(timer)
    return result


def in_thread(node: Node, function: Callable[[], Any]) -> tuple[Future, threading.Thread]:
    """Run a function in a thread of its own; returns the Future of its result, and the thread."""
    done = Future()

    def work() -> None:
        try:
            done.set_result(function())
        except Exception as error:  # for the one who awaits it
            done.set_exception(error)
        wake(node)

    thread = threading.Thread(target=work, daemon=True)
    thread.start()
    return done, thread


def wake(node: Node) -> None:
    """Make the executor of a node continue what awaits a result of another thread."""
    if node.executor is not None:
        node.executor.wake()
