# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Primitives of CDR, the byte format of messages, for streams without message objects.

Between two frames of a stream the caches of the processor go cold. What a frame costs then is the
code and memory that is touched once: making an object of a message of 30 points takes 0.02 ms in a
loop and 0.2 ms in a stream. So the frames of a stream are read from bytes and written as bytes.
docs/how_good/speed.md compares this with rclpy and with the typestore of rosbags.

The bytes are CDR, version 1, little-endian (OMG DDSI-RTPS 2.5, section 10; OMG CORBA 3.4, part 2,
section 9.3): 4 bytes that say so, then the fields one after the other. Numbers are aligned to
their size, counted from behind these 4 bytes; strings and sequences begin with their length. rclpy
converts messages in any other encoding first.
"""

from __future__ import annotations

from collections.abc import Sequence
from struct import Struct
from typing import Any

import numpy as np
from rclpy.serialization import deserialize_message, serialize_message

LITTLE_ENDIAN = b'\0\1'
ENCAPSULATION = LITTLE_ENDIAN + b'\0\0'
UINT32 = Struct('<I')
TWO_UINT32 = Struct('<II')
TIME = Struct('<iI')
_HEADER = Struct('<iII')  # seconds, nanoseconds, length of the frame id
_EMPTY = np.zeros(0)
TRUNCATED = 'the message is shorter than it says'


def as_little_endian(data: bytes, kind: type) -> bytes:
    """Return the bytes of a message of a type in the encoding that is read here.

    Raises ValueError where they are no message of that type.
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
    """Read a string of a length, up to its first zero; returns the next aligned offset."""
    end = start + length
    return data[start:end].partition(b'\0')[0].decode(errors='replace'), end + -end % 4


def read_float64_sequence(data: bytes, start: int) -> tuple[np.ndarray, int]:
    """Read a sequence of float64 and return the offset behind it. Raises ValueError."""
    (count,) = UINT32.unpack_from(data, start)
    start += 4
    if not count:
        return _EMPTY, start
    start += (4 - start) % 8
    end = start + 8 * count
    if end > len(data):
        raise ValueError(TRUNCATED)
    # A copy: the numbers are not aligned in the memory of the message.
    return np.frombuffer(data[start:end]), end


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
    columns: Sequence[np.ndarray],
    octets: Sequence[np.ndarray],
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
        Fields behind, which begin aligned to 4 bytes.
    """
    number = len(target_id) // 4
    count = UINT32.pack(number)
    if not number:
        return start + count * (1 + len(columns) + len(octets)) + end
    parts: list[Any] = [start, count, target_id]
    # The first float64 is aligned behind its count; the counts of the others are then followed by
    # four bytes of padding.
    before = count + b'\0' * (-(len(start) + 4 + len(target_id)) % 8)
    for column in columns:
        parts += before, column
        before = count + b'\0\0\0\0'
    padding = b'\0' * (-number % 4)
    for column in octets:
        parts += count, column, padding
    parts[-1] = end and padding + end
    return b''.join(parts)
