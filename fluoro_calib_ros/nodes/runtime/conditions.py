# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Conditions of the diagnostics that the streams of all nodes have in common."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from .diagnostics import Health, RefusalLog, fault, warning
from .lifecycle import StreamNode
from .stream import Stream


@dataclass(frozen=True)
class InputState:
    """What the diagnostics of an input are decided by."""

    node: StreamNode
    topics: tuple[str, ...]  #: what the node subscribes to
    refusals: RefusalLog
    incompatible: Mapping[str, str]  #: messages about publishers that are not received, by topic
    recent: Mapping[str, int]  #: what was counted within the last minute; see RecentCounts


@dataclass(frozen=True)
class StreamState(InputState):
    """What the diagnostics of a stream are decided by; one of its topics suffices.

    subject: what is published there, in words.
    """

    stream: Stream
    subject: str


def lost_messages(state: InputState) -> Health | None:
    """Messages were lost by internal errors."""
    return fault(state.refusals.failure())


def incompatible_publisher(state: InputState) -> Health | None:
    """A publisher offers less than is requested."""
    found = [state.incompatible[topic] for topic in state.topics if topic in state.incompatible]
    return warning(found[0] if found else '')


def inactive_node(state: InputState) -> Health | None:
    """The node does not receive anything."""
    return warning('' if state.node.readers else 'the node is not active')


def refused_messages(state: InputState) -> Health | None:
    """Messages were refused."""
    return warning(state.refusals.refusal(state.recent['refused']))


def overrun_input(state: InputState) -> Health | None:
    """Messages were lost before the node took them."""
    count = state.recent['overrun']
    lost = (
        f'{count} messages lost at the input in the last minute: they come faster than they are '
        'taken, and the queue was full'
    )
    return warning(lost if count else '')


def unpaired_frames(state: InputState) -> Health | None:
    """Other fluoroscopes did not see the same exposures."""
    count = state.recent['unpaired']
    text = f'{count} frames without partner of the other fluoroscopes in the last minute'
    return warning(text if count else '')


def missing_publisher(state: StreamState) -> Health | None:
    """Nobody publishes the stream."""
    found = any(map(state.node.has_publisher, state.topics))
    return warning('' if found else f'no publisher of {state.subject}')


def stalled_stream(state: StreamState) -> Health | None:
    """The stream has stopped."""
    return warning(state.stream.stalled())
