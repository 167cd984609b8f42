# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Angle of the C-arm in an exposure, from the position of a joint.

The same rule applies to live streams and bags. The angle of an exposure is the position of the
joint in its last state at or before the stamp of the exposure, if that state is no older than
`angle_max_age`; otherwise it is unknown. Stamps decide, not the order in which messages arrive.
There is no interpolation: the state after an exposure arrives later than the exposure itself, and
no frame waits for it.
"""

from __future__ import annotations

import math
from array import array
from bisect import bisect_left, bisect_right
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ..options import option, validate_options
from .frame import MAX_ANGLE, angle_in_degrees
from .stamps import Order, order_of

CAPACITY = 10_000  # maximum number of states of a joint in a live track


@dataclass(frozen=True)
class AngleOptions:
    """Source of the angle of the C-arm. Raises ValueError for an invalid value.

    of_rig: the joints are those of a whole rig (rig.toml); a recording may contain only some of
    its fluoroscopes, or no times.
    """

    angle_joint: str = option(
        '',
        'joint whose position is the angle of the C-arm, or one for each fluoroscope, such as '
        'a:frontal,b:lateral; empty: no angle',
    )
    angle_max_age: float = option(
        0.5,
        'longest time from the last state of the joint to an exposure; after it the angle is '
        'unknown',
        minimum=0.0,
        maximum=1e6,
        unit='s',
    )
    of_rig: bool = False

    def __post_init__(self) -> None:
        validate_options(self)
        joints_by_fluoroscope(self.angle_joint)

    def joints(self, fluoroscopes: Iterable[str], others: bool = False) -> dict[str, str]:
        """Return the joint of each fluoroscope that has one.

        Raises ValueError if a joint is given for another fluoroscope, unless of_rig or others is
        set.
        """
        names = tuple(fluoroscopes)
        joints = joints_by_fluoroscope(self.angle_joint)
        if isinstance(joints, str):
            return dict.fromkeys(names, joints) if joints else {}
        if self.of_rig or others:
            return {name: joint for name, joint in joints.items() if name in names}
        for name in joints:
            if name not in names:
                raise ValueError(
                    f'angle_joint: there is no fluoroscope {name!r}, only {", ".join(names)}'
                )
        return joints

    def tracks(self, fluoroscopes: Iterable[str], capacity: int | None = CAPACITY) -> JointAngles:
        """Return the joint angles of fluoroscopes, without states yet. Raises ValueError."""
        return JointAngles(self.joints(fluoroscopes), self.angle_max_age, capacity)


def joints_by_fluoroscope(text: str) -> str | dict[str, str]:
    """Parse an option: return the joint of all fluoroscopes, or one for each.

    'carm' applies to all, 'a:frontal,b:lateral' to each. Raises ValueError.
    """
    if ':' not in text:
        if ',' in text:
            raise ValueError(f'angle_joint: {text!r} is neither a joint nor like a:joint,b:joint')
        return text.strip()
    joints: dict[str, str] = {}
    for part in text.split(','):
        name, _, joint = (word.strip() for word in part.partition(':'))
        if not name or not joint or name in joints:
            raise ValueError(f'angle_joint: {text!r} is not like a:joint,b:joint')
        joints[name] = joint
    return joints


class AngleTrack:
    """Positions of a joint by stamp.

    A position that is not finite, or not an angle in radians, counts as unknown. A state older
    than max_age_s gives no angle. The newest `capacity` states are kept, all for None, as of a
    recording. A live track starts anew if the clock is set back, as `order_of` tells. late counts
    the states that were added after the angle at or after their stamp had been requested: the
    answer would have been different.
    """

    def __init__(self, max_age_s: float, capacity: int | None = CAPACITY) -> None:
        self._max_age_ns = round(max_age_s * 1e9)
        self._capacity = capacity
        self._asked: int | None = None
        self.late = 0
        self._clear()

    def add(self, stamp_ns: int, angle: float) -> None:
        """Add a state: angle [rad], rounded like that of a `Frame`.

        A second state with the same stamp replaces the first.
        """
        angle = float(np.radians(angle_in_degrees(angle)))
        if not abs(angle) <= MAX_ANGLE:
            angle = math.nan
        order = order_of(stamp_ns, self._stamps[-1]) if self._stamps else Order.IN_ORDER
        if order is Order.RESTART and self._capacity is not None:
            self._clear()
        index = len(self._stamps)
        if index and stamp_ns <= self._stamps[-1]:
            index = bisect_left(self._stamps, stamp_ns)
            if self._stamps[index] == stamp_ns:
                self._angles[index] = angle
                return
        self.late += self._asked is not None and stamp_ns <= self._asked
        self._stamps.insert(index, stamp_ns)
        self._angles.insert(index, angle)
        if self._capacity is not None and len(self._stamps) > self._capacity:
            half = len(self._stamps) // 2
            del self._stamps[:half]
            del self._angles[:half]

    def at(self, stamp_ns: int) -> float | None:
        """Return the angle at a time [rad], None if unknown."""
        self._asked = max(stamp_ns, self._asked or 0)
        is_known = not self.doubt(stamp_ns)
        return self._angles[bisect_right(self._stamps, stamp_ns) - 1] if is_known else None

    def doubt(self, stamp_ns: int) -> str:
        """Return why the angle at a time is unknown, '' if it is known."""
        if not self._stamps:
            return 'it has no state yet'
        index = bisect_right(self._stamps, stamp_ns) - 1
        if index < 0:
            return 'it has no state at or before the stamp of the exposure'
        age_ns = stamp_ns - self._stamps[index]
        if age_ns > self._max_age_ns:
            return (
                f'its last state is {age_ns * 1e-9:.3f} s older than the exposure, more than '
                f'angle_max_age, {self._max_age_ns * 1e-9:g} s'
            )
        if math.isnan(self._angles[index]):
            return f'its position is not an angle between -{MAX_ANGLE:.2f} and {MAX_ANGLE:.2f} rad'
        return ''

    def _clear(self) -> None:
        self._stamps = array('q')
        self._angles = array('d')
        self._asked = None


class JointAngles:
    """Angles of the C-arms of fluoroscopes, from the states of their joints.

    joints by fluoroscope; several may share a joint. max_age_s and capacity as in `AngleTrack`.
    """

    def __init__(
        self, joints: Mapping[str, str], max_age_s: float, capacity: int | None = CAPACITY
    ) -> None:
        self.joints = dict(joints)
        self._tracks = {joint: AngleTrack(max_age_s, capacity) for joint in joints.values()}

    def add(self, stamp_ns: int, names: Sequence[str], positions: Sequence[float]) -> None:
        """Add the states of joints: positions [rad], empty if unknown.

        Other joints are ignored.
        """
        if len(positions) != len(names):
            return
        for name, position in zip(names, positions):
            track = self._tracks.get(name)
            if track is not None:
                track.add(stamp_ns, float(position))

    def at(self, fluoroscope: str, stamp_ns: int) -> float | None:
        """Return the angle of a fluoroscope at a time [rad], None if unknown."""
        joint = self.joints.get(fluoroscope)
        return None if joint is None else self._tracks[joint].at(stamp_ns)

    def late(self, fluoroscope: str) -> int:
        """Return the number of states that arrived after an exposure that needed them."""
        joint = self.joints.get(fluoroscope)
        return 0 if joint is None else self._tracks[joint].late

    def doubt(self, fluoroscope: str, stamp_ns: int) -> str:
        """Return a clause that says why an angle is unknown, '' if it is known."""
        joint = self.joints.get(fluoroscope)
        if joint is None:
            return 'parameter angle_joint names no joint'
        reason = self._tracks[joint].doubt(stamp_ns)
        return f'joint {joint}: {reason}' if reason else ''
