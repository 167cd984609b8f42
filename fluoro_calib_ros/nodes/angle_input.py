# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Angles of the C-arms, from the states of their joints on joint_states."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sensor_msgs.msg import JointState

from ..exposures.angles import AngleOptions
from ..limits import MEGABYTE
from .messages.observations import decode_joint_state
from .runtime.diagnostics import WARN, Health, RateLimitedLogger, StartError
from .runtime.lifecycle import StreamNode
from .runtime.streams import FaultHandlers, StreamReader
from .runtime.topics import observations_qos

TOPIC = 'joint_states'


class AngleInput:
    """Receives joint states in the stream thread and gives each frame the angle of its C-arm.

    Without a joint it subscribes to nothing, and all angles are unknown.

    names: fluoroscopes. Raises StartError if a joint is configured for an unknown fluoroscope.
    """

    def __init__(
        self, options: AngleOptions, names: Iterable[str], logger: RateLimitedLogger
    ) -> None:
        try:
            self._angles = options.tracks(names)
        except ValueError as error:
            raise StartError(f'parameter {error}') from None
        self._logger = logger
        self._received = 0
        self._refused = 0
        # Last requests: stamp of the exposure [ns], and angle [rad] or None.
        self._asked: dict[str, tuple[int, float | None]] = {}
        self._unknown = dict.fromkeys(names, 0)  # exposures without an angle
        self._seen = dict.fromkeys(names, 0)  # value at the last health()
        self._doubted: set[str] = set()

    def create_reader(self, node: StreamNode, faults: FaultHandlers) -> StreamReader:
        """Return a new stream reader of a node that also receives the joint states.

        faults: handlers of the node's other topics.
        """
        reader = node.create_reader(faults)
        if self._angles.joints:
            reader.subscribe(
                JointState,
                TOPIC,
                self._on_state,
                observations_qos(),
                decode=decode_joint_state,
                max_bytes=MEGABYTE,
                # Before frames, so that a queued one does not get the angle of an earlier one.
                first=self._faults(faults),
            )
        return reader

    def _faults(self, faults: FaultHandlers) -> FaultHandlers:
        """Return the fault handlers of the joint states; faults: those of the other topics."""
        message = f'a message on {TOPIC}'
        return FaultHandlers(
            lambda _: self._refuse(f'{message} cannot be decoded'),
            lambda _, error: self._refuse(
                f'{message} is lost due to an internal error: {error!r}'
            ),
            faults.reader_error,
            lambda _, size: self._refuse(f'{message} has {size} bytes, more than the limit'),
        )

    def of_frame(self, name: str, stamp_ns: int, needed: bool) -> float | None:
        """Return the angle of an exposure [rad], or None if it is unknown.

        needed: whether a result depends on the angle, so that an unknown angle is counted and
        logged.
        """
        angle = self._angles.at(name, stamp_ns)
        self._asked[name] = stamp_ns, angle
        if angle is not None:
            self._doubted.discard(name)
        elif needed:
            self._unknown[name] += 1
            if name not in self._doubted:
                self._doubted.add(name)
                self._logger.warning(f'fluoroscope {name}: {self._doubt(name)}')
        return angle

    def values(self, name: str) -> dict[str, object]:
        """Return the diagnostic values of a fluoroscope; empty if it has no joint."""
        if name not in self._angles.joints and not self._unknown[name]:
            return {}
        _, angle = self._asked.get(name, (0, None))
        return {
            'angle [deg]': '' if angle is None else f'{math.degrees(angle):.3f}',
            'frames without angle': self._unknown[name],
            'joint states received': self._received,
            'joint states late': self._angles.late(name),
            'joint states refused': self._refused,
        }

    def health(self, name: str, incompatible: Mapping[str, str]) -> Health | None:
        """Return a warning if new frames of a fluoroscope had no angle, else None.

        incompatible: messages about publishers that cannot be received, by topic.
        """
        before, self._seen[name] = self._seen[name], self._unknown[name]
        if self._unknown[name] == before:
            return None
        return Health(WARN, incompatible.get(TOPIC) or self._doubt(name))

    def _doubt(self, name: str) -> str:
        """Return why the angle of the last exposure, or of an earlier one, is unknown."""
        stamp_ns, _ = self._asked[name]
        reason = self._angles.doubt(name, stamp_ns) or 'some exposures had none'
        return f'the angle of the C-arm is unknown: {reason}'

    def _on_state(self, state: tuple[Any, ...], _: Mapping[str, int]) -> None:
        self._angles.add(*state)
        self._received += 1

    def _refuse(self, reason: str) -> None:
        self._refused += 1
        self._logger.warning(reason)


def beyond_text(angle: float, calibrated: NDArray[np.float64]) -> str:
    """Return a sentence about an angle [rad] that is far from all calibrated angles."""
    nearest = calibrated[np.abs(np.angle(np.exp(1j * (calibrated - angle)))).argmin()]
    return (
        f'the angle of the C-arm, {math.degrees(angle):.1f} degrees, is far from all calibrated '
        f'ones, the nearest is {math.degrees(nearest):.1f} degrees'
    )
