# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Main loop of a node process: start, interrupt and end."""

from __future__ import annotations

import gc
import os
import select
import shutil
import signal
import sys
import textwrap
import threading
import time
import traceback
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from itertools import pairwise
from types import ModuleType
from typing import Any, NoReturn

import rclpy
from rclpy._rclpy_pybind11 import InvalidHandle, RCLError, UnknownROSArgsError
from rclpy.exceptions import ParameterException
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from rclpy.utilities import remove_ros_args

from ...errors import DataError, printable, shortened
from ...io.access import check_regular_file
from ...options import Option
from .diagnostics import USER_ERRORS, StartError, log_line, one_line
from .parameters import parameters_of, settable_parameters, unknown_parameters
from .services import guard_services

MAX_FAILURES = 100  # limit of failed callbacks within a second, at which nothing else works
# Time in which further signals count as part of the first: launch and service managers signal a
# group of processes and each of them, with SIGINT and SIGTERM.
ONE_INTERRUPT_S = 1.0
# Time within which a node must end after a signal: launch sends the next one, SIGTERM, after 5 s.
# A node that has data to write has an attribute end_s instead.
END_S = 4.0


def run(make_node: Callable[[], Node], args: Sequence[str] | None = None) -> None:
    """Run a node until it is interrupted or the context is shut down, then exit.

    The exit status is 1 if the node cannot start (after one sentence) or if its flag `failed` is
    set; else 0. A node may have a method bring_up(), called before the loop, and a method stop(),
    which ends everything that its callbacks wait for. The callbacks end before the context does,
    whereas rclpy's own signal handlers would shut it down while they run. A node that has not
    ended within its time (END_S) after a signal is ended with exit status 1 and a sentence.
    """
    words = sys.argv[1:] if args is None else args
    if asks_for_help(words):
        print(help_text(sys.modules[make_node.__module__]))
        sys.exit(0)
    ended = threading.Event()
    woken = threading.Event()
    node = None
    executor = None
    code = 0
    try:
        _init(args)
        executor = SingleThreadedExecutor()

        def end() -> None:
            ended.set()
            with suppress(InvalidHandle):  # the executor is already shut down
                executor.create_task(lambda: None)  # makes spin_once return
            woken.set()

        _call_on_interrupt(end, lambda: getattr(node, 'end_s', END_S))
        node = _make(make_node)
        executor.add_node(node)
        for sentence in (*unknown_parameters(node), *unused_arguments(words)):
            node.get_logger().warning(sentence)
        guard_services(node, node.services)
        getattr(node, 'bring_up', lambda: None)()
        try:
            spin(executor, ended, node.get_logger().error)
        finally:
            getattr(node, 'stop', lambda: None)()
        code = int(getattr(node, 'failed', False))
    except (StartError, ParameterException) as error:
        rclpy.logging.get_logger('fluoro_calib').fatal(log_line(str(error)))
        code = 1
    finally:
        # Objects left to the end of the interpreter are destroyed in any order, while threads of
        # the middleware run: the process may end with a segmentation fault.
        if ended.is_set():
            woken.wait(ONE_INTERRUPT_S)  # for the thread that wakes the executor
        if executor is not None:
            executor.shutdown()
        if node is not None:
            node.destroy_node()
        gc.collect()
        rclpy.try_shutdown()
    _exit(code)


def _exit(code: int) -> NoReturn:
    """End the process without shutting down its interpreter.

    That shutdown takes long on a busy machine, does not handle signals, and waits for threads
    whose results are no longer needed.
    """
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)


def spin(
    executor: SingleThreadedExecutor, ended: threading.Event, report: Callable[[str], Any]
) -> None:
    """Run callbacks until `ended` is set.

    An exception in a callback is reported, and the node continues: a message or request of a peer
    must not end it. If callbacks do nothing but raise, the last exception is raised.
    """
    failures: deque[float] = deque(maxlen=MAX_FAILURES)
    while rclpy.ok() and not ended.is_set():
        try:
            executor.spin_once()
        except ExternalShutdownException:
            return
        except Exception as error:
            if not rclpy.ok() or ended.is_set():
                return
            failures.append(time.monotonic())
            if len(failures) == MAX_FAILURES and failures[-1] - failures[0] < 1.0:
                raise
            place = traceback.extract_tb(error.__traceback__)[-1]
            report(f'a callback failed ({place.name}, line {place.lineno}): {one_line(error)}')


def _init(args: Sequence[str] | None) -> None:
    """Initialise ROS. Raises StartError for invalid arguments."""
    arguments = sys.argv if args is None else args
    try:
        for option, path in pairwise(arguments):
            if option == '--params-file':
                check_regular_file(path)  # rcl would block on a pipe and ignore interrupts
        rclpy.init(args=args, signal_handler_options=SignalHandlerOptions.NO)
    except RCLError as error:  # invalid arguments after --ros-args
        raise StartError(str(error).partition(', at /')[0]) from None
    except UnknownROSArgsError as error:
        raise StartError(f'unknown arguments after --ros-args: {one_line(error)}') from None
    except DataError as error:
        raise StartError(str(error)) from None


def _make(make_node: Callable[[], Node]) -> Node:
    """Create the node. Raises StartError if its arguments are invalid."""
    try:
        return make_node()
    except BaseException as error:
        # A partly constructed node has joined the graph, too; find it in its constructor's frame.
        for frame, _ in traceback.walk_tb(error.__traceback__):
            partial_node = frame.f_locals.get('self')
            if isinstance(partial_node, Node):
                with suppress(Exception):  # parts that it does not have yet
                    partial_node.destroy_node()
                break
        if isinstance(error, USER_ERRORS):
            raise StartError(one_line(error)) from None
        raise


def _call_on_interrupt(end: Callable[[], None], patience_s: Callable[[], float]) -> None:
    """Call end() from a thread at SIGINT or SIGTERM, whatever the main thread waits for.

    The process ends at once on a further signal more than a second later, or when the time
    returned by patience_s() has passed.
    """
    reading, writing = os.pipe()
    os.set_blocking(writing, False)
    signal.set_wakeup_fd(writing)
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: None)

    def watch() -> None:
        os.read(reading, 1)
        end()
        time.sleep(ONE_INTERRUPT_S)
        os.set_blocking(reading, False)
        with suppress(BlockingIOError):  # no further signal has come
            os.read(reading, 1000)
        patience = patience_s()
        if select.select([reading], [], [], patience - ONE_INTERRUPT_S)[0]:
            os._exit(128 + signal.SIGINT)  # exit status of shells for this signal
        rclpy.logging.get_logger('fluoro_calib').fatal(
            f'ended by force: the current work takes longer than {patience:g} s'
        )
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def unused_arguments(words: Sequence[str]) -> list[str]:
    """Return a sentence if some arguments have no effect, because they are not of ROS."""
    unused = ' '.join(remove_ros_args(['', *words])[1:])
    text = f'arguments without effect: {printable(shortened(unused))}; parameters and names follow'
    return [f'{text} --ros-args'] if unused else []


# Output of a node for --help: its task, how to start it, and its parameters.


def asks_for_help(arguments: Sequence[str]) -> bool:
    """Return whether -h or --help is among the arguments before those of ROS."""
    words = list(arguments)
    if '--ros-args' in words:
        words = words[: words.index('--ros-args')]
    return any(word in ('-h', '--help') for word in words)


def help_text(module: ModuleType) -> str:
    """Return the help text of a node's module: its docstring, usage and PARAMETERS."""
    name = module.__name__.rpartition('.')[2]
    if name == '__main__' and module.__spec__ is not None:
        name = module.__spec__.name.rpartition('.')[2]
    width = min(100, shutil.get_terminal_size().columns)
    task = ' '.join((module.__doc__ or '').strip().partition('\n\n')[0].split())
    settable = settable_parameters(module.PARAMETERS)
    lines = [
        f'usage: {name} [--ros-args -p PARAMETER:=VALUE ... -r __ns:=/NAMESPACE]',
        '',
        *textwrap.wrap(task, width),
        '',
        'parameters (* may change while the node runs):',
    ]
    for parameter, declaration in parameters_of(module.PARAMETERS).items():
        mark = ' *' if parameter in settable else ''
        lines.append(f'  {parameter}{mark}')
        lines += textwrap.wrap(
            _description(declaration), width, initial_indent=' ' * 6, subsequent_indent=' ' * 6
        )
    lines += ['', 'topics, services and the meaning of the diagnostics: docs/nodes.md']
    return '\n'.join(lines)


def _description(declaration: Option) -> str:
    """Return description, values and default of a parameter."""
    default = declaration.default
    text = declaration.help
    if declaration.minimum is not None and declaration.maximum is not None:
        text += f'; {declaration.minimum:g} to {declaration.maximum:g}'
    if isinstance(default, bool):
        default_text = str(default).lower()
    elif isinstance(default, tuple):
        default_text = f'[{", ".join(map(str, default))}]'
    else:
        default_text = str(default) if default != '' else "''"
    return f'{text} (default: {default_text})'
