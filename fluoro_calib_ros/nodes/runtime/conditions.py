# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Conditions that make the status of a node WARN or ERROR; those of the inputs of all nodes.

A condition takes a state and returns its Health, None if it does not hold. A node has a list of
them, the most severe first; the last one always holds.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any, TypeAlias, TypeVar

from .diagnostics import ERROR, OK, WARN, Health, RefusalLog
from .lifecycle import Stream, StreamNode
from .topics import publisher_conflict, several_publishers

State = TypeVar('State')
Condition: TypeAlias = Callable[[State], Health | None]
Text: TypeAlias = Callable[[Any], Any]  # returns the message about a state, '' or None if well


def health_of(state: State, conditions: Iterable[Condition[State]]) -> Health:
    """Return the health from the first condition that holds.

    Later conditions are not evaluated.
    """
    return next(health for condition in conditions if (health := condition(state)) is not None)


def warns(text: Text) -> Condition[Any]:
    """Return the condition that is a WARN if there is a message."""
    return lambda state: Health(WARN, message) if (message := text(state)) else None


def fails(text: Text) -> Condition[Any]:
    """Return the condition that is an ERROR if there is a message."""
    return lambda state: Health(ERROR, message) if (message := text(state)) else None


def healthy(message: str) -> Callable[[Any], Health]:
    """Return the condition that nothing is wrong, which always holds."""
    return lambda state: Health(OK, message)


def counted(name: str, text: str) -> Condition[Any]:
    """Return a condition that warns of events within the last minute; text contains {count}."""
    return warns(lambda state: text.format(count=n) if (n := state.recent[name]) else '')


@dataclass(frozen=True)
class InputState:
    """State from which the health of an input is diagnosed."""

    node: StreamNode
    topics: tuple[str, ...]  #: topics that the node subscribes to
    refusals: RefusalLog
    recent: Mapping[str, int]  #: counts within the last minute; see RecentCounts


@dataclass(frozen=True)
class StreamState(InputState):
    """State from which the health of a stream is diagnosed; one of its topics suffices."""

    stream: Stream


Kind = TypeVar('Kind', bound=StreamState)


def state_of(
    kind: type[Kind],
    node: StreamNode,
    stream: Stream,
    counts: Mapping[str, int] | None = None,
    **values: Any,
) -> Kind:
    """Return the state of the stream of a fluoroscope.

    counts: further counts of which the growth matters. values: further fields of this kind of
    state.
    """
    refused, overrun = stream.refusals.total, stream.overrun
    return kind(
        node=node,
        topics=tuple(f'{stream.name}/{topic}' for topic in node.topics),
        refusals=stream.refusals,
        recent=node.recent.growth(stream.name, refused=refused, overrun=overrun, **(counts or {})),
        stream=stream,
        **values,
    )


def missing_publisher(state: StreamState) -> str:
    """Return a message if nobody publishes the stream."""
    has_publisher = any(map(state.node.has_publisher, state.topics))
    return '' if has_publisher else f'no publisher of {state.node.subject}'


def _unpaired(state: InputState) -> str:
    """Return a message about frames without partner, and the nodes that publish them twice."""
    count = state.recent['unpaired']
    text = f'{count} frames without partner of the other fluoroscopes in the last minute'
    twice = (several_publishers(state.node, topic) for topic in state.topics)
    return '; '.join([text, *filter(None, twice)]) if count else ''


# Messages were lost by internal errors.
lost_messages = fails(lambda state: state.refusals.failure())
# A publisher offers less than is requested.
incompatible_publisher = warns(
    lambda state: next(filter(None, map(state.node.incompatible.get, state.topics)), '')
)
# The node is not active and receives nothing.
inactive_node = warns(lambda state: '' if state.node.readers else 'the node is not active')
refused_messages = warns(lambda state: state.refusals.refusal(state.recent['refused']))
# Messages were lost before the node took them.
overrun_input = counted(
    'overrun',
    '{count} messages lost at the input in the last minute: they come faster than they are taken, '
    'and the queue was full',
)
# Other fluoroscopes did not see the same exposures.
unpaired_frames = warns(_unpaired)
# Several calibration nodes serve the fluoroscope.
several_nodes = fails(
    lambda state: publisher_conflict(state.node, f'{state.stream.name}/calibration_status')
)
no_publisher = warns(missing_publisher)
# The stream has stopped.
stalled_stream = warns(lambda state: state.stream.stalled())
