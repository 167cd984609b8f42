# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Image points of identified targets in one frame, as messages and as bytes (CDR).

The frames of a stream are read from and written to bytes in CDR, the wire format of messages,
without message objects. Between two frames of a stream the processor caches go cold, and the cost
of a frame is then that of the code and memory touched once: creating the object of a message of 30
points takes 0.02 ms in a loop but 0.2 ms in a stream. docs/how_good/speed.md compares this with
rclpy and with the typestore of rosbags.

The bytes are CDR, version 1, little-endian (OMG DDSI-RTPS 2.5, section 10; OMG CORBA 3.4, part 2,
section 9.3): 4 bytes that identify the encoding, then the fields one after the other. Numbers are
aligned to their size, counted from the end of these 4 bytes; strings and sequences begin with
their length. Messages in any other encoding are first converted by rclpy.
"""

from __future__ import annotations

from array import array
from collections.abc import Sequence
from struct import Struct, error
from typing import Any, NamedTuple

import numpy as np
from builtin_interfaces.msg import Time
from fluoro_calib_msgs.msg import CorrectedObservations, TargetObservations
from numpy.typing import ArrayLike, NDArray
from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import JointState

from ...errors import DataError
from ...exposures.frame import Frame, stack_image_points
from ...exposures.stamps import NS_PER_S, nanoseconds_from_stamp

LITTLE_ENDIAN = b'\0\1'
ENCAPSULATION = LITTLE_ENDIAN + b'\0\0'
UINT32 = Struct('<I')
TWO_UINT32 = Struct('<II')
TIME = Struct('<iI')
_HEADER = Struct('<iII')  # seconds, nanoseconds, length of the frame id
TRUNCATED = 'the message is shorter than its header states'


def as_little_endian(data: bytes, kind: type) -> bytes:
    """Return the bytes of a message in the encoding that this module reads.

    Raises ValueError if they are not a message of that type.
    """
    if data[:2] == LITTLE_ENDIAN:
        return data
    try:
        return serialize_message(deserialize_message(data, kind))
    except Exception as error:  # depends on the middleware
        raise ValueError(str(error)) from None


def read_header(data: bytes) -> tuple[int, int, str, int]:
    """Read the header at the start of a message: seconds, nanoseconds, frame id, next offset."""
    sec, nanosec, length = _HEADER.unpack_from(data, 4)
    return sec, nanosec, *read_string(data, 16, length)


def read_string(data: bytes, start: int, length: int) -> tuple[str, int]:
    """Read a string of given length, up to its first zero; return it and the next offset."""
    end = start + length
    return data[start:end].partition(b'\0')[0].decode(errors='replace'), end + -end % 4


def read_columns(data: bytes, start: int, number: int) -> tuple[list[NDArray[np.float64]], int]:
    """Read sequences of float64; return them and the offset after them. Raises ValueError."""
    columns = []
    for _ in range(number):
        (count,) = UINT32.unpack_from(data, start)
        start += 4
        start += (4 - start) % 8 if count else 0
        end = start + 8 * count
        if end > len(data):
            raise ValueError(TRUNCATED)
        # Copy, because the numbers are not aligned in the memory of the message.
        columns.append(np.frombuffer(data[start:end]))
        start = end
    return columns, start


def string_bytes(text: str) -> bytes:
    """Return the bytes of a string, padded to the next multiple of 4."""
    data = text.encode() + b'\0'
    return b''.join((UINT32.pack(len(data)), data, b'\0' * (-len(data) % 4)))


def string_sequence_bytes(texts: Sequence[str]) -> bytes:
    """Return the bytes of a sequence of strings."""
    return b''.join((UINT32.pack(len(texts)), *map(string_bytes, texts)))


def columns_bytes(
    start: bytes,
    target_id: bytes,
    columns: Sequence[NDArray[np.float64]],
    octets: Sequence[NDArray[np.uint8]],
    end: bytes = b'',
) -> bytes:
    """Return a message that consists of columns of equal length.

    Parameters
    ----------
    start : bytes
        The message up to the target ids.
    target_id : bytes
        The ids as uint32.
    columns : sequence of np.ndarray
        Fields of float64, (n,) each.
    octets : sequence of np.ndarray
        Fields of uint8, (n,) each.
    end : bytes
        Fields after the columns, which begin aligned to 4 bytes.
    """
    number = len(target_id) // 4
    count = UINT32.pack(number)
    if not number:
        return start + count * (1 + len(columns) + len(octets)) + end
    parts: list[Any] = [start, count, target_id]
    # The first float64 is aligned after its count; the counts of the other columns are therefore
    # followed by four bytes of padding.
    prefix = count + b'\0' * (-(len(start) + 4 + len(target_id)) % 8)
    for column in columns:
        parts += prefix, column
        prefix = count + b'\0\0\0\0'
    padding = b'\0' * (-number % 4)
    for octet in octets:
        parts += count, octet, padding
    parts[-1] = end and padding + end
    return b''.join(parts)


# Fields common to many messages: stamps, and arrays of primitive numbers.


def stamp_from_nanoseconds(nanoseconds: int) -> Time:
    """Return the Time message for a time in nanoseconds."""
    return Time(sec=int(nanoseconds // NS_PER_S), nanosec=int(nanoseconds % NS_PER_S))


def float64_field(values: ArrayLike) -> array[Any]:
    """Return a float64[] field; an array of several dimensions is flattened."""
    return array('d', np.ascontiguousarray(values, dtype=np.float64).tobytes())


def uint32_field(values: ArrayLike) -> array[Any]:
    """Return a uint32[] field; an array of several dimensions is flattened."""
    return array('I', np.ascontiguousarray(values, dtype=np.uint32).tobytes())


def uint8_field(values: ArrayLike) -> array[Any]:
    """Return a uint8[] field; an array of several dimensions is flattened."""
    return array('B', np.ascontiguousarray(values, dtype=np.uint8).tobytes())


_IMAGE = Struct('<IIII')  # frame number, width, height, number of target ids


class ObservedFrame(NamedTuple):
    """A TargetObservations message read from its bytes, without validation."""

    #: stamp
    sec: int
    nanosec: int
    frame_id: str
    frame_number: int
    image_size: tuple[int, int]  #: width and height [px]
    target_id: bytes  #: the ids as uint32
    #: image points and their standard deviations [px], of any lengths
    u: NDArray[np.float64]
    v: NDArray[np.float64]
    sigma: NDArray[np.float64]
    #: the message up to the frame number, which is also the start of a CorrectedObservations
    start: bytes


def decode_target_observations(data: bytes) -> ObservedFrame:
    """Read a TargetObservations message from its bytes. Raises ValueError for damaged bytes."""
    data = as_little_endian(data, TargetObservations)
    try:
        sec, nanosec, frame_id, image_start = read_header(data)
        number, width, height, count = _IMAGE.unpack_from(data, image_start)
        end = image_start + 16 + 4 * count
        (u, v, sigma), _ = read_columns(data, end, 3)
    except error as reason:  # beyond the end of the bytes
        raise ValueError(str(reason)) from None
    return ObservedFrame(
        sec=sec,
        nanosec=nanosec,
        frame_id=frame_id,
        frame_number=number,
        image_size=(width, height),
        target_id=data[image_start + 16 : end],
        u=u,
        v=v,
        sigma=sigma,
        start=data[: image_start + 4],
    )


def frame_from_observed(
    observed: ObservedFrame, fluoroscope: str, angle: float | None = None
) -> Frame:
    """Return the Frame of a message; angle: of the C-arm [rad], None if unknown.

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
        sigma=sigma,
        stamp_ns=nanoseconds_from_stamp(observed),
        frame_id=observed.frame_id,
        angle=angle,
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
    """Set frame number and stamp of a message, so that it can be published again."""
    message.frame_number = number
    message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp_ns, NS_PER_S)


# CorrectedObservations: image points of one frame with the distortion removed.


class CorrectedFrame(NamedTuple):
    """A CorrectedObservations message read from its bytes, without validation."""

    #: stamp
    sec: int
    nanosec: int
    frame_id: str
    frame_number: int
    calibration_id: str
    target_id: NDArray[np.uint32]  #: uint32
    #: corrected points and standard deviations [px], of any lengths
    u: NDArray[np.float64]
    v: NDArray[np.float64]
    sigma: NDArray[np.float64]
    correction_sd: NDArray[np.float64]
    status: np.ndarray  #: uint8, of any length

    @property
    def columns(self) -> tuple[np.ndarray, ...]:
        """The arrays apart from the target ids."""
        return self.u, self.v, self.sigma, self.correction_sd, self.status


def decode_corrected_observations(data: bytes) -> CorrectedFrame:
    """Read a CorrectedObservations message from its bytes. Raises ValueError if damaged."""
    data = as_little_endian(data, CorrectedObservations)
    try:
        sec, nanosec, frame_id, offset = read_header(data)
        number, length = TWO_UINT32.unpack_from(data, offset)
        calibration_id, offset = read_string(data, offset + 8, length)
        (count,) = UINT32.unpack_from(data, offset)
        offset += 4
        target_id = np.frombuffer(data[offset : offset + 4 * count], np.uint32)
        offset += 4 * count
        (u, v, sigma, correction_sd), offset = read_columns(data, offset, 4)
        (count,) = UINT32.unpack_from(data, offset)
    except error as reason:  # beyond the end of the bytes
        raise ValueError(str(reason)) from None
    if offset + 4 + count > len(data):
        raise ValueError(TRUNCATED)
    return CorrectedFrame(
        sec=sec,
        nanosec=nanosec,
        frame_id=frame_id,
        frame_number=number,
        calibration_id=calibration_id,
        target_id=target_id,
        u=u,
        v=v,
        sigma=sigma,
        correction_sd=correction_sd,
        status=np.frombuffer(data, np.uint8, count, offset + 4),
    )


def encode_corrected_observations(
    source: ObservedFrame, calibration_id: str, corrected: Sequence[np.ndarray]
) -> bytes:
    """Return the bytes of the CorrectedObservations message of a frame.

    source: the observed frame with n target ids. corrected: u, v, sigma, correction_sd (n,)
    float64 [px] and status (n,) uint8.
    """
    *columns, status = corrected
    return columns_bytes(
        source.start + string_bytes(calibration_id), source.target_id, columns, (status,)
    )


# JointState: positions of joints, including the angles of C-arms.


def decode_joint_state(data: bytes) -> tuple[int, Sequence[str], Sequence[float]]:
    """Read a JointState message from its bytes: stamp [ns], names and positions [rad] of joints.

    Positions may be of any length. Raises one of DECODING_ERRORS.
    """
    message = deserialize_message(data, JointState)
    return nanoseconds_from_stamp(message.header.stamp), message.name, message.position
