# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""TargetObservations: image points of identified targets in one frame."""

from __future__ import annotations

from struct import Struct, error
from typing import NamedTuple

import numpy as np
from fluoro_calib_msgs.msg import TargetObservations

from ...errors import DataError
from ...exposures.frame import Frame, stack_image_points
from .cdr import as_little_endian, read_float64_sequence, read_header
from .fields import (
    NS_PER_S,
    float64_field,
    stamp_from_nanoseconds,
    uint32_field,
)

_IMAGE = Struct('<IIII')  # frame number, width, height, number of target ids


class ObservedFrame(NamedTuple):
    """A TargetObservations message, read from its bytes; nothing is validated.

    Attributes
    ----------
    sec, nanosec : int
        Stamp.
    frame_id : str
    frame_number : int
    image_size : (int, int)
        Width and height [px].
    target_id : bytes
        The ids as uint32.
    u, v, sigma : np.ndarray
        Image points and their standard deviations [px], of any lengths.
    start : bytes
        The message up to the frame number: so a CorrectedObservations message begins, too.
    """

    sec: int
    nanosec: int
    frame_id: str
    frame_number: int
    image_size: tuple[int, int]
    target_id: bytes
    u: np.ndarray
    v: np.ndarray
    sigma: np.ndarray
    start: bytes


def decode_target_observations(data: bytes) -> ObservedFrame:
    """Read a TargetObservations message from its bytes. Raises ValueError for damaged ones."""
    data = as_little_endian(data, TargetObservations)
    try:
        sec, nanosec, frame_id, at = read_header(data)
        number, width, height, count = _IMAGE.unpack_from(data, at)
        end = at + 16 + 4 * count
        u, offset = read_float64_sequence(data, end)
        v, offset = read_float64_sequence(data, offset)
        sigma, _ = read_float64_sequence(data, offset)
    except error as reason:  # beyond the end of the bytes
        raise ValueError(str(reason)) from None
    return ObservedFrame(
        sec,
        nanosec,
        frame_id,
        number,
        (width, height),
        data[at + 16 : end],
        u,
        v,
        sigma,
        data[: at + 4],
    )


def frame_from_observed(
    observed: ObservedFrame, fluoroscope: str, angle: float | None = None
) -> Frame:
    """Return the Frame of a message; angle: of the C-arm [rad], None where it is unknown.

    Raises DataError for arrays of different lengths.
    """
    try:
        target_id, uv, sigma = stack_image_points(
            np.frombuffer(observed.target_id, np.uint32), observed.u, observed.v, observed.sigma
        )
    except DataError as error:
        raise DataError(
            f'fluoroscope {fluoroscope}, frame {observed.frame_number}: {error}'
        ) from None
    return Frame(
        fluoroscope,
        observed.frame_number,
        target_id,
        uv,
        observed.image_size,
        sigma,
        NS_PER_S * observed.sec + observed.nanosec,
        observed.frame_id,
        angle,
    )


def message_from_frame(frame: Frame) -> TargetObservations:
    """Return the message of a Frame."""
    message = TargetObservations()
    message.header.stamp = stamp_from_nanoseconds(frame.stamp_ns)
    message.header.frame_id = frame.frame_id
    message.frame_number = frame.number
    message.image_width, message.image_height = frame.image_size
    message.target_id = uint32_field(frame.target_id)
    message.u = float64_field(frame.uv[:, 0])
    message.v = float64_field(frame.uv[:, 1])
    message.sigma = float64_field([] if frame.sigma is None else frame.sigma)
    return message


def set_number_and_stamp(message: TargetObservations, number: int, stamp_ns: int) -> None:
    """Change frame number and stamp of a message that is published again."""
    message.frame_number = number
    message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp_ns, NS_PER_S)
