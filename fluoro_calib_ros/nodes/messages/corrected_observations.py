# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""CorrectedObservations: image points of one frame without distortion."""

from __future__ import annotations

from collections.abc import Sequence
from struct import error
from typing import NamedTuple

import numpy as np
from fluoro_calib_msgs.msg import CorrectedObservations

from .cdr import (
    TRUNCATED,
    TWO_UINT32,
    UINT32,
    as_little_endian,
    columns_bytes,
    read_float64_sequence,
    read_header,
    read_string,
    string_bytes,
)
from .target_observations import ObservedFrame


class CorrectedFrame(NamedTuple):
    """A CorrectedObservations message, read from its bytes; nothing is validated.

    Attributes
    ----------
    sec, nanosec : int
        Stamp.
    frame_id : str
    frame_number : int
    calibration_id : str
    target_id : np.ndarray
        uint32.
    u, v, sigma, correction_sd : np.ndarray
        Corrected points and standard deviations [px], of any lengths.
    status : np.ndarray
        uint8, of any length.
    """

    sec: int
    nanosec: int
    frame_id: str
    frame_number: int
    calibration_id: str
    target_id: np.ndarray
    u: np.ndarray
    v: np.ndarray
    sigma: np.ndarray
    correction_sd: np.ndarray
    status: np.ndarray


def decode_corrected_observations(data: bytes) -> CorrectedFrame:
    """Read a CorrectedObservations message from its bytes. Raises ValueError for damaged ones."""
    data = as_little_endian(data, CorrectedObservations)
    try:
        sec, nanosec, frame_id, at = read_header(data)
        number, length = TWO_UINT32.unpack_from(data, at)
        calibration_id, at = read_string(data, at + 8, length)
        (count,) = UINT32.unpack_from(data, at)
        at += 4
        target_id = np.frombuffer(data[at : at + 4 * count], np.uint32)
        at += 4 * count
        u, at = read_float64_sequence(data, at)
        v, at = read_float64_sequence(data, at)
        sigma, at = read_float64_sequence(data, at)
        correction_sd, at = read_float64_sequence(data, at)
        (count,) = UINT32.unpack_from(data, at)
    except error as reason:  # beyond the end of the bytes
        raise ValueError(str(reason)) from None
    if at + 4 + count > len(data):
        raise ValueError(TRUNCATED)
    return CorrectedFrame(
        sec,
        nanosec,
        frame_id,
        number,
        calibration_id,
        target_id,
        u,
        v,
        sigma,
        correction_sd,
        np.frombuffer(data, np.uint8, count, at + 4),
    )


def encode_corrected_observations(
    source: ObservedFrame, calibration_id: str, corrected: Sequence[np.ndarray]
) -> bytes:
    """Return the bytes of the CorrectedObservations message of a frame.

    Parameters
    ----------
    source : ObservedFrame
        The observed frame with n target ids.
    calibration_id : str
    corrected : sequence of np.ndarray
        u, v, sigma, correction_sd (n,) float64 [px] and status (n,) uint8.
    """
    *columns, status = corrected
    return columns_bytes(
        source.start + string_bytes(calibration_id), source.target_id, columns, (status,)
    )
