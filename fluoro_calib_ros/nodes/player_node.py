# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Node that publishes the messages of a bag as they were recorded, and ends."""

from __future__ import annotations

import threading
import time
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from itertools import chain

from rclpy.exceptions import NameValidationException
from rclpy.publisher import Publisher
from rclpy.time import Time
from rosgraph_msgs.msg import Clock
from std_srvs.srv import SetBool, Trigger

from ..errors import DataError
from ..io.bags.mcap_file import (
    ChannelInfo,
    channels_of_bag,
    channels_of_file,
    is_foreign,
    storage_files,
)
from ..io.bags.metadata import known_definition
from ..io.bags.reader import TopicInfo, iterate_messages, topics_of
from ..io.bags.recording import PlayingOptions
from ..options import option
from .runtime.diagnostics import StartError, one_line
from .runtime.main import run
from .runtime.parameters import READ_LIMITS, ParameterGroup, declare_read_limits
from .runtime.services import ServiceEntry, create_services
from .runtime.topics import (
    clock_qos,
    installed_type,
    observations_qos,
    qos_overrides,
    recorded_latched_qos,
    resolved_names,
    wait_for_readers,
    wait_until_acknowledged,
)
from .runtime.worker import WorkerNode

LONGEST_S = 3600.0  # of a single wait


class Pace:
    """Times at which positions of a recording are due.

    rate: speed relative to the recording. paused: whether to start paused.
    """

    def __init__(self, rate: float, paused: bool = False) -> None:
        self._changed = threading.Condition()
        self._rate = rate
        self._paused = paused
        self._steps = 0  # requested during this pause
        self._ended = False
        self.start()

    def start(self) -> None:
        """Set the current position to 0."""
        self._move_to(0.0)

    def _move_to(self, position_s: float) -> None:
        """Set the current position, and let waits consider it."""
        with self._changed:
            self._position_s = position_s
            self._since_s = time.monotonic()
            self._changed.notify_all()

    @property
    def paused(self) -> bool:
        """Whether playing is paused."""
        return self._paused

    @property
    def position_s(self) -> float:
        """Current position [s]."""
        with self._changed:
            passed_s = 0.0 if self._paused else time.monotonic() - self._since_s
            return self._position_s + passed_s * self._rate

    def pause(self) -> None:
        """Stop at the current position."""
        with self._changed:
            self._move_to(self.position_s)
            self._paused = True

    def resume(self) -> None:
        """Continue from the current position; steps that were not made are dropped."""
        with self._changed:
            self._move_to(self.position_s)
            self._paused = False
            self._steps = 0

    def step(self) -> None:
        """End one wait during a pause."""
        with self._changed:
            self._steps += 1
            self._changed.notify_all()

    def change(self, rate: float) -> None:
        """Continue from the current position at another speed."""
        with self._changed:
            self._move_to(self.position_s)
            self._rate = rate

    def end(self) -> None:
        """End all waits, also later ones."""
        with self._changed:
            self._ended = True
            self._changed.notify_all()

    def wait(self, position_s: float) -> bool:
        """Wait until a position [s] is due; return whether end() ended the wait."""
        with self._changed:
            while not self._ended:
                remaining_s = (position_s - self.position_s) / self._rate
                if self._paused and self._steps:
                    self._steps -= 1
                    self._move_to(position_s)
                    break
                if not self._paused and remaining_s <= 0:
                    break
                self._changed.wait(LONGEST_S if self._paused else min(remaining_s, LONGEST_S))
            return self._ended


OBSERVATIONS = 'TargetObservations'
# Message types of the other streams that the nodes process, each with at least one reader.
OTHER_STREAMS = ('CorrectedObservations', 'Image', 'CompressedImage')


@dataclass(frozen=True)
class PlayerParameters(PlayingOptions):
    """Parameters of the player."""

    bag: str = option('', 'bag to play: an .mcap file or a folder of rosbag2')
    wait_for_readers: int = option(
        1,
        'subscriptions to wait for, of every topic with target observations; without any, one of '
        'every topic with corrected observations or images, or else of all topics',
        minimum=0,
        maximum=100,
    )
    strip_prefix: str = option('', 'first parts of their names, removed from recorded topics')
    topics: tuple[str, ...] = option(('',), 'topics to play; empty: all')


_NODE = ParameterGroup(PlayerParameters, settable=('rate', 'loop'))
PARAMETERS = (_NODE, READ_LIMITS)


class PlayerNode(WorkerNode):
    """Plays a bag once or in a loop; stamps are those of the recording."""

    def __init__(self) -> None:
        super().__init__('player_node')
        declare_read_limits(self)
        self._settings = _NODE.declare(self)
        if not self._settings.bag:
            raise StartError('parameter bag is not set: it names the bag to play')
        self._outputs = self._create_outputs(self._settings.bag)
        self._pace = Pace(self._settings.rate, self._settings.start_paused)
        self._start_ns: int | None = None  # time of the recording at which playing begins
        _NODE.follow(self, self._use)
        services = (
            ServiceEntry('~/pause', SetBool, self._on_pause),
            ServiceEntry('~/step', Trigger, self._on_step),
        )
        create_services(self, services)
        self._publish_clock()
        self.start()

    def _use(self, settings: PlayerParameters) -> None:
        """Apply new settings from now on."""
        self._settings = settings
        self._pace.change(settings.rate)

    def _on_pause(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        """Pause or continue."""
        response.success = self._pace.paused != request.data
        if request.data:
            self._pace.pause()
        else:
            self._pace.resume()
        state = 'paused' if request.data else 'playing'
        response.message = state if response.success else f'already {state}'
        return response

    def _on_step(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        """Play one message during a pause."""
        response.success = self._pace.paused
        if response.success:
            self._pace.step()
        response.message = 'one message' if response.success else 'not paused: call ~/pause first'
        return response

    def _publish_clock(self) -> None:
        """Publish the time of the recording at the rate of the parameter clock."""
        if not self._settings.clock:
            return
        output = self.create_publisher(Clock, '/clock', clock_qos())

        def publish() -> None:
            if self._start_ns is not None:
                now_ns = self._start_ns + round(self._pace.position_s * 1e9)
                output.publish(Clock(clock=Time(nanoseconds=now_ns).to_msg()))

        self.create_timer(1 / self._settings.clock, publish)

    def _create_outputs(self, bag: str) -> dict[str, Publisher]:
        """Return the publishers of the topics to play. Raises StartError."""
        try:
            topics = topics_of(bag)
            channels = (
                channels_of_bag(bag)
                if is_foreign(bag)
                else chain.from_iterable(map(channels_of_file, storage_files(bag)))
            )
            channel_of = {info.channel.topic: info for info in channels}
        except DataError as error:
            raise StartError(str(error)) from None
        # Names in the bag: remapping applies to the names under which they are played.
        wanted = resolved_names(self, filter(None, self._settings.topics), only_expand=True)
        missing = sorted(wanted - set(topics))
        if missing:
            self.get_logger().warning(f'{bag}: there is no topic {", ".join(missing)}')
        outputs = {}
        for topic, info in topics.items():
            if (not wanted or topic in wanted) and self._is_playable(channel_of[topic]):
                output = self._create_output(topic, info)
                if output is not None:
                    outputs[topic] = output
        self._latched = {output for topic, output in outputs.items() if is_latched(topics[topic])}
        if not outputs:
            raise StartError(
                f'{bag}: there is nothing to play among its topics {", ".join(topics) or "(none)"}'
            )
        if not any(topics[topic].count for topic in outputs):
            raise StartError(f'{bag}: there are no messages on {", ".join(outputs)}')
        return outputs

    def _is_playable(self, info: ChannelInfo) -> bool:
        """Return whether messages are in CDR, and warn if they, or their type, are others."""
        topic = info.channel.topic
        encoding = info.channel.message_encoding
        if encoding != 'cdr':
            self.get_logger().warning(f'{topic} is not played: it is encoded as {encoding!r}')
            return False
        recorded = info.definition.type_hash
        with suppress(DataError):  # a type of another package
            if recorded and recorded != known_definition(info.msg_type).type_hash:
                self.get_logger().warning(
                    f'{topic} was recorded with another definition of {info.msg_type}: only '
                    'nodes that know that definition can read it'
                )
        return True

    def _create_output(self, topic: str, info: TopicInfo) -> Publisher | None:
        """Return the publisher of a topic, with a relative name so that it can be remapped.

        Returns None if the type is not installed. Raises StartError.
        """
        message_type = installed_type(info.type)
        if message_type is None:
            self.get_logger().warning(
                f'{topic} is not played: the type {info.type or "(none)"} is not installed'
            )
            return None
        prefix = f'/{self._settings.strip_prefix.strip("/")}/'.replace('//', '/')
        relative_name = f'{topic}/'.removeprefix(prefix).strip('/')
        try:
            return self.create_publisher(
                message_type,
                relative_name,
                recorded_latched_qos() if is_latched(info) else observations_qos(),
                qos_overriding_options=qos_overrides(),
            )
        except NameValidationException as error:
            raise StartError(
                f'{topic} cannot be played as {relative_name!r}: {one_line(error)}'
            ) from None

    def _wait_for_readers(self) -> None:
        """Wait for the readers of streams only: other topics, such as /rosout, may have none."""
        kinds = {output: output.msg_type.__name__ for output in self._outputs.values()}
        count = self._settings.wait_for_readers
        awaited = [output for output, kind in kinds.items() if kind == OBSERVATIONS]
        if not awaited:
            awaited = [output for output, kind in kinds.items() if kind in OTHER_STREAMS]
            count = min(count, 1) if awaited else count
        wait_for_readers(self, awaited or list(kinds), count, self.stopping)

    def work(self) -> None:
        """Play the bag once or in a loop. Raises DataError."""
        self._wait_for_readers()
        while not self.stopping.is_set():
            self._play_once()
            if not self._settings.loop:
                break
        arrived = wait_until_acknowledged(self._outputs.values(), self.stopping)
        if not arrived and not self.stopping.is_set():
            self.get_logger().warning('not all messages have arrived: a reader does not respond')

    def _play_once(self) -> None:
        """Publish every message at its time; before the start offset, only latched ones."""
        start = time.monotonic()
        start_ns = None
        count = 0
        for message in iterate_messages(self._settings.bag, list(self._outputs)):
            if start_ns is None:
                start_ns = message.log_time_ns + round(self._settings.start_offset * 1e9)
            output = self._outputs[message.topic]
            if message.log_time_ns < start_ns:
                if output in self._latched:
                    output.publish(message.data)
                continue
            if not count:
                self._pace.start()
                self._start_ns = start_ns
            if self._pace.wait((message.log_time_ns - start_ns) * 1e-9):
                return
            output.publish(message.data)
            count += 1
        if not count:
            raise DataError(
                f'{self._settings.bag}: there is no message {self._settings.start_offset:g} s '
                'after the first one (parameter start_offset)'
            )
        self.get_logger().info(f'{count} messages played in {time.monotonic() - start:.1f} s')

    def stop(self) -> None:
        """Stop playing before the node is destroyed."""
        self._pace.end()
        super().stop()


def is_latched(info: TopicInfo) -> bool:
    """Return whether a recorded topic was latched, so that late subscribers received it."""
    return any(profile.get('durability') == 'transient_local' for profile in info.offered_qos)


main = partial(run, PlayerNode)

if __name__ == '__main__':
    main()
