# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Services of the nodes, and requests whose answers have to wait."""

from __future__ import annotations

import inspect
import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import Any, NamedTuple

from rcl_interfaces.msg import SetParametersResult
from rcl_interfaces.srv import SetParameters, SetParametersAtomically
from rclpy.callback_groups import CallbackGroup
from rclpy.node import Node
from rclpy.service import Service
from rclpy.task import Future

from ...errors import DataError
from ...limits import MAX_TEXT
from .diagnostics import Logger, one_line
from .parameters import ParameterNode
from .topics import services_qos

# Services that answer a request that cannot be handled, instead of ending the node.
#
# rclpy's own services raise if a transition does not fit the state of a managed node, or if a
# parameter has an unknown type. Without a guard, one such request of any peer ends the node. rcl
# logs texts in a request unchanged, such as the label of a transition.

Callback = Callable[[Any, Any], Any]
MAX_TIMEOUT_S = 86400.0  # longest time that a request may ask a node to wait


def guard_services(node: Node, services: Iterable[Service]) -> None:
    """Make services of a node refuse the requests for which their callbacks raise."""
    for service in services:
        service.callback = _guarded(node, service.srv_name, service.callback)


def _guarded(node: Node, name: str, callback: Callback) -> Callback:
    def refused(request: Any, response: Any, error: Exception) -> Any:
        reason = one_line(error)
        node.get_logger().error(f'service {name}: request refused: {reason}')
        return _refusal_of(request, type(response)(), reason)

    def guarded(request: Any, response: Any) -> Any:
        try:
            _check_texts(request)
            return callback(request, response)
        except Exception as error:  # a request may contain anything
            return refused(request, response, error)

    async def guarded_coroutine(request: Any, response: Any) -> Any:
        try:
            _check_texts(request)
            return await callback(request, response)
        except Exception as error:
            return refused(request, response, error)

    return guarded_coroutine if inspect.iscoroutinefunction(callback) else guarded


def _check_texts(value: Any, where: str = 'request') -> None:
    """Raise ValueError unless all texts in a request or field are printable and short enough."""
    if isinstance(value, str):
        if len(value) > MAX_TEXT or not value.isprintable():
            raise ValueError(f'{where} is printable text of at most {MAX_TEXT} characters')
    elif isinstance(value, list):
        for item in value:
            _check_texts(item, where)
    elif hasattr(value, 'get_fields_and_field_types'):
        for name in value.get_fields_and_field_types():
            _check_texts(getattr(value, name), name)


def _refusal_of(request: Any, response: Any, reason: str) -> Any:
    """Return the response that nothing was done; its flags are false by default."""
    refusal = SetParametersResult(successful=False, reason=reason)
    if isinstance(request, SetParameters.Request):
        response.results = [refusal] * len(request.parameters)
    elif isinstance(request, SetParametersAtomically.Request):
        response.result = refusal
    elif hasattr(response, 'message'):
        response.message = reason
    return response


class ServiceEntry(NamedTuple):
    """Service: name, type, and handler (request, response) -> response, possibly a coroutine."""

    name: str
    kind: type
    handler: Callable[[Any, Any], Any]


def telling_service(
    name: str, kind: type, refused: str, act: Callable[[Any], str], logger: Logger
) -> ServiceEntry:
    """Return a service that carries out a request, and answers what was done or why not.

    act may raise DataError and OSError; refused is the text before the reason.
    """

    def answer(request: Any, response: Any) -> Any:
        try:
            response.message = act(request)
        except (DataError, OSError) as error:
            response.message = f'{refused}: {error}'
            logger.error(response.message)
            return response
        response.success = True
        logger.info(response.message)
        return response

    return ServiceEntry(name, kind, answer)


def create_services(
    node: Node, table: Iterable[ServiceEntry], group: CallbackGroup | None = None
) -> list[Service]:
    """Create the services of a table; if a handler raises, the answer says so.

    Handlers that are coroutines need a reentrant group, or they block the other services.
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
    """Counts the requests that are waiting for their answers."""

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


def check_timeout(seconds: float) -> None:
    """Raise ValueError for a time that a node cannot wait."""
    if not 0 < seconds <= MAX_TIMEOUT_S:
        limit = f', at most {MAX_TIMEOUT_S:g}' if seconds > MAX_TIMEOUT_S else ''
        raise ValueError(f'timeout_sec must be a time in seconds{limit}, not {seconds}')


async def within(
    node: ParameterNode, timeout_s: float, future: Future, give_up: Callable[[], object]
) -> Any:
    """Return the result of a Future; call give_up(), which must set it, after the timeout."""
    timer = node.create_timer(timeout_s, give_up)
    try:
        return await future
    finally:
        node.destroy_timer(timer)


def in_thread(node: Node, function: Callable[[], Any]) -> tuple[Future, threading.Thread]:
    """Run a function in a new thread; return the Future of its result, and the thread."""
    done = Future()

    def work() -> None:
        try:
            done.set_result(function())
        except Exception as error:  # raised where the Future is awaited
            done.set_exception(error)
        wake(node)

    thread = threading.Thread(target=work, daemon=True)
    thread.start()
    return done, thread


class Cancelled(Exception):
    """Raised when running work has to stop."""


class Worker:
    """Runs work in a thread, which can be cancelled and ends with its node."""

    def __init__(self, node: Node) -> None:
        self._node: Any = node
        self._stopping = threading.Event()
        self._thread: threading.Thread | None = None

    def stop(self) -> None:
        """Cancel the running work and all later one."""
        self._stopping.set()

    def end(self) -> None:
        """Cancel the running work and wait for its end."""
        self.stop()
        if self._thread is not None:
            self._thread.join()

    def _start(self, work: Callable[..., Any], is_cancelled: Callable[[], bool] = bool) -> Future:
        """Start work in a thread; return the Future of its result.

        work: called with the argument raise_if_cancelled, a function to call repeatedly.
        """

        def run() -> Any:
            return work(raise_if_cancelled=lambda: self._raise_if_cancelled(is_cancelled()))

        future, self._thread = in_thread(self._node, run)
        return future

    def _raise_if_cancelled(self, is_cancelled: bool = False) -> None:
        """Raise Cancelled if the work has to stop."""
        if is_cancelled or self._stopping.is_set():
            raise Cancelled


def wake(node: Node) -> None:
    """Make the executor of a node resume coroutines that await a result of another thread."""
    if node.executor is not None:
        node.executor.wake()
