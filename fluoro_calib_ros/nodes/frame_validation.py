# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Validation of frames on the live path, within microseconds."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, TypeVar

import numpy as np
from fluoro_calib_msgs.msg import CorrectedObservations, TargetObservations
from numpy.typing import NDArray

from ..correction.fluoroscope_calibration import FluoroscopeCalibration
from ..exposures.frame import image_size_error, length_error, repeated_target_error, sigma_error
from .messages.observations import (
    CorrectedFrame,
    ObservedFrame,
    decode_corrected_observations,
    decode_target_observations,
)
from .runtime.diagnostics import TOO_LARGE, Refused
from .runtime.lifecycle import StreamNode
from .runtime.streams import StreamReader, TooLarge
from .runtime.topics import observations_qos

# Kinds of refusals.
OBSERVED_REFUSALS = (
    'undecodable',
    TOO_LARGE,
    'lengths',
    'image size',
    'frame id',
    'repeated target',
    'sigma',
)
CORRECTED_ARRAYS = ('u', 'v', 'sigma', 'correction_sd', 'status')
CORRECTED_REFUSALS = ('undecodable', TOO_LARGE, 'lengths', 'repeated target', 'sigma')


Decoded = TypeVar('Decoded', ObservedFrame, CorrectedFrame)


def with_limit(decode: Callable[[bytes], Decoded], most: int) -> Callable[[bytes], Decoded]:
    """Return a decoder of frames that raises TooLarge for more than `most` points.

    The limit is then the same at every node: the size in bytes depends on the columns present.
    """

    def decode_limited(data: bytes) -> Decoded:
        frame = decode(data)
        if len(frame.u) > most:
            raise TooLarge(f'{len(frame.u)} points')
        return frame

    return decode_limited


# Message type of the frames on a topic, and the decoder of its bytes.
FRAMES: dict[str, tuple[type, Callable[[bytes], Any]]] = {
    'target_observations': (TargetObservations, decode_target_observations),
    'corrected_observations': (CorrectedObservations, decode_corrected_observations),
}


def subscribe_frames(
    reader: StreamReader, node: StreamNode, topic: str, on_frame: Callable[..., None]
) -> None:
    """Receive the frames of all fluoroscopes of a node on <fluoroscope>/<topic>, a key of FRAMES.

    on_frame: called with fluoroscope, frame and times; see StreamReader.subscribe.
    """
    kind, decode = FRAMES[topic]
    limits = node.settings.limits
    for name in node.names:
        reader.subscribe(
            kind,
            f'{name}/{topic}',
            partial(on_frame, name),
            observations_qos(),
            decode=with_limit(decode, limits.max_points),
            max_bytes=limits.max_bytes,
        )


class FrameValidator:
    """Validates the frames of one fluoroscope before they are corrected.

    A stream shows the same targets frame after frame, so ids are checked only when they change.
    """

    def __init__(self, fluoroscope: str) -> None:
        self._fluoroscope = fluoroscope
        self._unique: bytes | None = None  # last target ids that were checked

    def validated_arrays(
        self, frame: ObservedFrame, calibration: FluoroscopeCalibration
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64] | None]:
        """Return u, v (n,) and sigma (n,) or None of a frame that a calibration can correct.

        Raises Refused for a frame that cannot be corrected as a whole.
        """
        ids, sigma = np.frombuffer(frame.target_id, np.uint32), frame.sigma
        if not len(ids) == len(frame.u) == len(frame.v) or len(sigma) not in (0, len(ids)):
            arrays = {'u': frame.u, 'v': frame.v, **({'sigma': sigma} if len(sigma) else {})}
            self._require('lengths', frame, length_error(ids, **arrays))
        error = image_size_error(frame.image_size, calibration.image_size)
        self._require('image size', frame, error)
        frame_id = frame.frame_id
        if frame_id != calibration.frame_id and frame_id and calibration.frame_id:
            error = f'the frame id is {frame_id}, but the calibration is of {calibration.frame_id}'
            self._require('frame id', frame, error)
        if frame.target_id != self._unique:
            self._require('repeated target', frame, repeated_target_error(ids))
            self._unique = frame.target_id
        if not len(sigma):
            return frame.u, frame.v, None
        if not (sigma.min() > 0 and sigma.max() < np.inf):  # false for NaN, too
            self._require('sigma', frame, sigma_error(ids, sigma))
        return frame.u, frame.v, sigma

    def _require(self, kind: str, frame: ObservedFrame, error: str) -> None:
        """Raise Refused if there is an error."""
        if error:
            where = f'fluoroscope {self._fluoroscope}, frame {frame.frame_number}'
            raise Refused(kind, f'{where}: {error}')


def validate_corrected(fluoroscope: str, frame: CorrectedFrame) -> None:
    """Raise Refused for arrays of different lengths, repeated targets and invalid deviations.

    Standard deviations may be NaN, as they are for points with the status INVALID.
    """
    count = len(frame.target_id)
    where = f'fluoroscope {fluoroscope}, frame {frame.frame_number}'
    lengths = map(len, (frame.u, frame.v, frame.sigma, frame.correction_sd, frame.status))
    if set(lengths) != {count}:
        arrays = {name: getattr(frame, name) for name in CORRECTED_ARRAYS}
        raise Refused('lengths', f'{where}: {length_error(frame.target_id, **arrays)}')
    if len(set(frame.target_id.tolist())) < count:  # a tenth of the time of first_repeated
        raise Refused('repeated target', f'{where}: {repeated_target_error(frame.target_id)}')
    for name, invalid in (
        ('sigma', (frame.sigma <= 0) | (frame.sigma == np.inf)),
        ('correction_sd', (frame.correction_sd < 0) | (frame.correction_sd == np.inf)),
    ):  # false for NaN
        if invalid.any():
            raise Refused(
                'sigma',
                f'{where}: {name} of target {frame.target_id[invalid.argmax()]} is not a standard '
                'deviation',
            )
