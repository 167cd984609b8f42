"""What the nodes share: parameters with descriptions, diagnostics, logging that does not flood,
start and end.
"""

import os
import re
import signal
import sys
import threading
import time
import traceback
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from fluoro_calib_msgs.msg import TargetObservations
from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rclpy._rclpy_pybind11 import RCLError
from rclpy.duration import Duration
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.exceptions import NameValidationException, ParameterException
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.lifecycle import LifecycleNode, TransitionCallbackReturn
from rclpy.qos import qos_policy_name_from_kind
from rclpy.signals import SignalHandlerOptions

from ..errors import DataError
from .qos import OBSERVATIONS, overridable
from .streams import StreamReader

OK = DiagnosticStatus.OK
WARN = DiagnosticStatus.WARN
ERROR = DiagnosticStatus.ERROR
# in which readers get to know a publisher that knows them, several times what was measured
SETTLING_S = 0.3
LONGEST_S = 86400.0  # that somebody may ask a node to wait
NAME = re.compile(
    '[A-Za-z_][A-Za-z0-9_]{0,99}'
)  # of a fluoroscope: a file name, and part of a topic's


def declare(node, name, default, description, low=None, high=None):
    """Declare a read-only parameter with description and range; returns its value."""
    descriptor = ParameterDescriptor(description=description, read_only=True)
    if low is not None and isinstance(default, int):
        descriptor.integer_range = [IntegerRange(from_value=low, to_value=high)]
    elif low is not None:
        descriptor.floating_point_range = [FloatingPointRange(from_value=low, to_value=high)]
    try:
        value = node.declare_parameter(name, default, descriptor).value
    except ParameterException as error:
        raise StartError(f'parameter {name}: {error}') from None
    return (
        [] if value is None else value
    )  # an empty list has no type, and is taken for a parameter that is not set


class Sentences:
    """Logs sentences as they come, but at most a burst of them and then one a second; the rest is
    counted.
    """

    def __init__(self, logger, burst=20):
        self._logger = logger
        self._allowance = float(burst)
        self._burst = burst
        self._last = time.monotonic()
        self._hidden = 0

    def warn(self, sentence):
        """Log a sentence as a warning, unless there have been too many."""
        now = time.monotonic()
        self._allowance = min(self._burst, self._allowance + now - self._last)
        self._last = now
        if self._allowance < 1:
            self._hidden += 1
            return
        more = f' ({self._hidden} more like this were not shown)' if self._hidden else ''
        self._logger.warning(sentence + more)
        self._allowance = self._allowance - 1
        self._hidden = 0


class Diagnostics:
    """Publishes the state of a node on /diagnostics."""

    def __init__(self, node):
        self._node = node
        self._publisher = node.create_publisher(DiagnosticArray, '/diagnostics', 10)

    def publish(self, parts):
        """Publish one status for every (name, level, message, {key: value}) of parts."""
        array = DiagnosticArray()
        array.header.stamp = self._node.get_clock().now().to_msg()
        full_name = self._node.get_fully_qualified_name()
        for name, level, message, values in parts:
            status = DiagnosticStatus(
                level=level, name=f'{full_name}: {name}', message=message, hardware_id=name
            )
            status.values = [KeyValue(key=key, value=str(value)) for key, value in values.items()]
            array.status.append(status)
        self._publisher.publish(array)

    def close(self):
        """Take the publisher back."""
        self._node.destroy_publisher(self._publisher)


class Latencies:
    """The last latencies [ns], written by one thread and read by another."""

    def __init__(self, count=2000):
        self._ring = np.zeros(count, dtype=np.int64)
        self._number = 0

    def add(self, nanoseconds):
        """Take a latency."""
        self._ring[self._number % len(self._ring)] = nanoseconds
        self._number += 1

    def values(self):
        """Diagnostic values; none where there are none."""
        if not self._number:
            return {}
        p50, p99 = np.percentile(self._ring[: self._number], [50, 99]) * 1e-6
        return {'latency p50 [ms]': f'{p50:.3f}', 'latency p99 [ms]': f'{p99:.3f}'}


def _on_interrupt(end):
    """Call end() from a thread at SIGINT or SIGTERM, whatever the main thread waits for; a second
    one exits at once.
    """
    reading, writing = os.pipe()
    os.set_blocking(writing, False)
    signal.set_wakeup_fd(writing)
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: None)

    def watch():
        os.read(reading, 1)
        end()
        os.read(reading, 1)
        os._exit(130)

    threading.Thread(target=watch, daemon=True).start()


def _init(args):
    try:
        rclpy.init(args=args, signal_handler_options=SignalHandlerOptions.NO)
    except RCLError as error:  # arguments after --ros-args that are none
        raise StartError(str(error).partition(', at /')[0]) from None


class ManagedNode(LifecycleNode):
    """Node with the lifecycle of ROS 2 that brings itself up, unless its parameter autostart is
    false.

    It has its topics from configure on, and takes messages between activate and deactivate. open()
    makes what configure makes, begin() what activate does; end() and close() take them back, in
    whatever state they are.
    """

    def __init__(self, name):
        super().__init__(name)
        self._autostart = declare(
            self,
            'autostart',
            True,
            'configure and activate the node at its start; false: that '
            'is left to whoever manages the lifecycle',
        )
        self.failed = False
        self._starting = False
        self._fault = ''

    def bring_up(self):
        """Configure and activate the node where it does so by itself. Raises StartError."""
        if self._autostart:
            self._starting = True
            if not all(
                done() == TransitionCallbackReturn.SUCCESS
                for done in (self.trigger_configure, self.trigger_activate)
            ):
                raise StartError(self._fault)
            self._starting = False

    def fail(self, text):
        """End the node for a fault of its own, told with a text."""
        self.get_logger().fatal(text)
        self.failed = True
        rclpy.try_shutdown()

    def destroy_publisher(self, publisher):
        """Take a publisher back, also from those that the lifecycle switches on and off."""
        return self.destroy_lifecycle_publisher(publisher)

    def on_configure(self, state):
        return self._tried(self.open, self.close)

    def on_activate(self, state):
        super().on_activate(state)
        result = self._tried(self.begin, self.end)
        if result != TransitionCallbackReturn.SUCCESS:
            super().on_deactivate(state)
        return result

    def _tried(self, function, undo):
        """Result of a transition by a function; where it fails, that is told and undone: rclpy
        would not say a word.
        """
        try:
            function()
        except Exception as error:
            told = isinstance(error, TOLD)
            self._fault = sentence_of(error) if told else traceback.format_exc()
            if not self._starting:
                self.get_logger().error(self._fault)
            undo()
            return TransitionCallbackReturn.FAILURE
        return TransitionCallbackReturn.SUCCESS

    def on_deactivate(self, state):
        self.end()
        return super().on_deactivate(state)

    def on_cleanup(self, state):
        self.close()
        return TransitionCallbackReturn.SUCCESS

    def on_shutdown(self, state):
        self.stop()
        return TransitionCallbackReturn.SUCCESS

    def stop(self):
        """Take everything down: the node is to go."""
        self.end()
        self.close()


class StreamNode(ManagedNode):
    """Managed node with outputs, readers of streams, and its state in the diagnostics once a
    second.

    make(): makes what it has from configure on, by publisher() and kept(); listen(): makes its
    readers, by reader(); report(): its state as Diagnostics.publish takes it; forget(): what it
    knows before the first message.
    """

    def __init__(self, name):
        super().__init__(name)
        self.sentences = Sentences(self.get_logger())
        self.readers = []
        self._kept = ExitStack()

    def kept(self, thing, take_back, *arguments):
        """A thing for which take_back(*arguments) is called when the node is taken down, the last
        one first.
        """
        self._kept.callback(take_back, *arguments)
        return thing

    def publisher(self, kind, topic, qos):
        """Publisher of a stream: silent while the node is not active, its quality of service can
        be overridden.
        """
        made = self.create_lifecycle_publisher(
            kind, topic, qos, qos_overriding_options=overridable()
        )
        return self.kept(made, self.destroy_publisher, made)

    def reader(self, on_undecodable):
        """StreamReader that begins with the node and ends with it."""
        self.readers.append(StreamReader(self, on_undecodable, self.fail))
        return self.readers[-1]

    def open(self):
        """Make outputs, and what calibrations come in by."""
        self.make()
        diagnostics = Diagnostics(self)
        self.kept(diagnostics, diagnostics.close)
        timer = self.create_timer(1.0, lambda: diagnostics.publish(self.report()))
        self.kept(timer, self.destroy_timer, timer)

    def begin(self):
        """Take streams."""
        self.listen()
        for reader in self.readers:
            reader.start()

    def end(self):
        """Take no more of them."""
        for reader in self.readers:
            reader.stop()
        self.readers = []

    def close(self):
        """Take the outputs back, and forget what was received."""
        self._kept.close()
        self.forget()


def deafness(reader, sentences):
    """Sentence for every topic {topic: sentence} on which nothing can come to a StreamReader, or
    None; told too.
    """
    found = {} if reader is None else reader.incompatible()
    for sentence in found.values():
        sentences.warn(sentence)
    return found


def fluoroscopes_of(node, least=1):
    """Declare the parameter fluoroscopes; returns the names. Raises StartError."""
    names = list(declare(node, 'fluoroscopes', ['a', 'b'], 'names of the fluoroscopes'))
    if len(names) < least or len(set(names)) != len(names):
        raise StartError(
            f'parameter fluoroscopes: {names} is not a list of different names'
            + (f', {least} or more' if least > 1 else '')
        )
    for name in names:
        if not NAME.fullmatch(name):
            raise StartError(
                f'parameter fluoroscopes: {name!r} cannot be part of the name of a topic, which consists '
                'of letters, digits and _, and does not begin with a digit'
            )
    return names


def check_timeout(seconds):
    """Raise ValueError unless somebody can wait for so many seconds."""
    if not 0 < seconds <= LONGEST_S:
        most = f', at most {LONGEST_S:g}' if seconds > LONGEST_S else ''
        raise ValueError(f'timeout_sec is a time in seconds{most}, not {seconds}')


def path_of(text):
    """Path of a text, in which ~ is the home of a user. Raises DataError."""
    try:
        return Path(text).expanduser()
    except RuntimeError:
        raise DataError(f'{text}: there is no such home folder') from None


def run(make_node, args=None):
    """Run a node until it is interrupted, or has ended by rclpy.shutdown(); exit status 1 and one
    sentence where it cannot start, exit status 1 where its flag `failed` is set.

    stop() of a node ends what its callbacks wait for. They end before the context does, which
    rclpy's own signal handlers would take away from under them.
    """
    ended = threading.Event()
    node = None
    code = 0
    try:
        _init(args)
        executor = SingleThreadedExecutor()

        def end():
            ended.set()
            executor.create_task(lambda: None)  # something to do, so that spin_once returns

        _on_interrupt(end)
        node = _made(make_node)
        executor.add_node(node)
        getattr(node, 'bring_up', lambda: None)()
        try:
            while rclpy.ok() and not ended.is_set():
                executor.spin_once()
        except ExternalShutdownException:
            pass
        finally:
            getattr(node, 'stop', lambda: None)()
            executor.shutdown()
        code = int(getattr(node, 'failed', False))
    except (StartError, ParameterException) as error:
        rclpy.logging.get_logger('fluoro_calib').fatal(str(error))
        code = 1
    finally:
        if node is not None:
            node.destroy_node()
        rclpy.try_shutdown()
    sys.exit(code)


def _made(make_node):
    """The node. Raises StartError for what its arguments make impossible."""
    try:
        return make_node()
    except TOLD as error:
        raise StartError(sentence_of(error)) from None


def sentence_of(error):
    """An exception in one line."""
    return ' '.join(str(error).split())[:1000] or type(error).__name__


def subscribe_observations(node, name, on_frame, on_deaf):
    """Subscribe a node to the target observations of a fluoroscope.

    on_frame(name, message) for every frame; on_deaf(name, sentence) where nothing can come from a
    publisher, since it offers less than is asked for.
    """
    topic = f'{name}/target_observations'

    def incompatible(event):
        policy = qos_policy_name_from_kind(event.last_policy_kind)
        on_deaf(
            name,
            f'topic {topic}: a publisher offers an incompatible quality of service ({policy}), '
            'nothing comes from it',
        )

    node.create_subscription(
        TargetObservations,
        topic,
        lambda message: on_frame(name, message),
        OBSERVATIONS,
        event_callbacks=SubscriptionEventCallbacks(incompatible_qos=incompatible),
        qos_overriding_options=overridable(),
    )


def wait_for_readers(node, publishers, count, ending):
    """Wait until each publisher of a node has so many readers, and these know it; ending: an Event
    that ends the waiting.

    A publisher hears of a reader and the reader of it independently of each other. What is
    published between these moments is lost, reliable or not, and nobody tells when the second one
    has come.
    """
    while missing := [p.topic_name for p in publishers if p.get_subscription_count() < count]:
        node.get_logger().info(
            f'waiting for {count} readers of {", ".join(missing)}', throttle_duration_sec=5.0
        )
        if ending.wait(0.05):
            return
    if count:
        ending.wait(SETTLING_S)


def wait_until_taken(publishers, ending, seconds=10.0):
    """Wait until all that was published has arrived; what is not acknowledged is lost when the
    process goes. Returns whether it has, ending: an Event that ends the waiting.
    """
    end = time.monotonic() + seconds
    for publisher in publishers:
        while not publisher.wait_for_all_acked(Duration(seconds=0.1)):
            if ending.is_set() or time.monotonic() > end:
                return False
    return True


class StartError(RuntimeError):
    """Why a node cannot start, in one sentence."""


# What names, parameters and overridden qualities of service that are none end in; RCLError is a
# RuntimeError.
TOLD = (ParameterException, NameValidationException, RuntimeError, DataError)
