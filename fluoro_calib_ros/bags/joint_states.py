# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Angles of C-arms in a bag, from the states of their joints."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace

from ..errors import DataError
from ..exposures.angles import AngleOptions, JointAngles
from ..exposures.frame import Frame
from .definitions import from_cdr
from .reader import iterate_messages, topics_of
from .storage import PathLike

JOINT_STATE = 'sensor_msgs/msg/JointState'


def joint_topics(source: PathLike) -> list[str]:
    """Return the topics of a bag that hold states of joints. Raises DataError."""
    return [
        name for name, info in topics_of(source).items() if info.type == JOINT_STATE and info.count
    ]


def with_angles(
    source: PathLike, frames: Mapping[str, Sequence[Frame]], options: AngleOptions
) -> tuple[dict[str, list[Frame]], tuple[str, ...]]:
    """Return frames of a bag with the angles that the nodes give them, and notes about them.

    Parameters
    ----------
    source : path-like
    frames : mapping of str to sequence of Frame
        By fluoroscope.
    options : AngleOptions
        Which joint is the C-arm, in any topic of joint states.

    Raises
    ------
    DataError
        For a bag without this joint, with states of it on several topics or damaged ones, and for
        a joint of another fluoroscope.
    """
    angles = angles_in(source, frames, options)
    if not angles.joints:
        return {name: list(each) for name, each in frames.items()}, ()
    out = {
        name: [replace(frame, angle=angles.at(name, frame.stamp_ns)) for frame in each]
        for name, each in frames.items()
    }
    return out, tuple(_notes(source, out, angles))


def angles_in(source: PathLike, fluoroscopes: Iterable[str], options: AngleOptions) -> JointAngles:
    """Return the angles of fluoroscopes by all joint states of a bag.

    Raises DataError as with_angles.
    """
    try:
        angles = options.tracks(fluoroscopes, capacity=None)
    except ValueError as error:
        raise DataError(f'{source}: {error}') from None
    try:
        if angles.joints:
            _read_states(source, angles)
    except DataError as error:
        hint = "; the joint is that of rig.toml, --angle-joint '' leaves it out"
        raise DataError(f'{error}{hint if options.of_rig else ""}') from None
    return angles


def _read_states(source: PathLike, angles: JointAngles) -> None:
    """Add all states of joints in a bag to their tracks. Raises DataError."""
    topics = joint_topics(source)
    wanted = set(angles.joints.values())
    if not topics:
        raise DataError(
            f'{source}: the bag has no joint states ({JOINT_STATE}), so the angle of joint '
            f'{", ".join(sorted(wanted))} is unknown'
        )
    found: dict[str, set[str]] = {}  # topics by joint
    for message in iterate_messages(source, topics):
        try:
            state = from_cdr(message.data, JOINT_STATE)
        except DataError as error:
            raise DataError(f'{source}, topic {message.topic}: {error}') from None
        for joint in state.name:
            found.setdefault(joint, set()).add(message.topic)
        stamp = state.header.stamp
        angles.add(stamp.sec * 10**9 + stamp.nanosec, state.name, state.position)
    for joint in sorted(wanted):
        if joint not in found:
            raise DataError(
                f'{source}: the bag has no joint {joint!r}, only {", ".join(sorted(found))}'
            )
        if len(found[joint]) > 1:
            raise DataError(
                f'{source}: joint {joint!r} is on the topics {", ".join(sorted(found[joint]))}; '
                'its angle must come from one of them'
            )


def _notes(
    source: PathLike, frames: Mapping[str, Sequence[Frame]], angles: JointAngles
) -> Iterable[str]:
    """Yield a sentence for each fluoroscope with frames whose angle is unknown."""
    for name, each in frames.items():
        unknown = [frame for frame in each if frame.angle is None]
        if name in angles.joints and unknown:
            yield (
                f'{source}: {len(unknown)} of {len(each)} frames of fluoroscope {name} have no '
                f'angle, the first is frame {unknown[0].number} '
                f'({angles.doubt(name, unknown[0].stamp_ns)})'
            )
