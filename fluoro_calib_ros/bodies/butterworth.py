# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Low-pass filter that labs use, for comparison: Butterworth, forwards and backwards.

The total order is 4, two in each direction, as in Winter ("Biomechanics and motor control of human
movement", 4th ed., 2009, 2.2.4.4). The user chooses the cutoff. Standard deviations are propagated
from errors that are independent between exposures; they do not include motion that is filtered
out.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import scipy  # loads scipy.signal, half a second, where it is used
from numpy.typing import NDArray

from ..errors import DataError
from ..photogrammetry.rotations import matrix_from_quaternion, quaternion_from_matrix
from .body import BodyPoses, PoseStatus

SETTLED = 1e-6  # share of the impulse response that is truncated


def filtered_poses(poses: BodyPoses, cutoff_hz: float) -> BodyPoses:
    """Return poses after a low-pass filter; gaps are interpolated beforehand, and marked.

    Raises DataError for a cutoff that the rate does not allow, for exposures that are not
    equidistant in time, and for fewer than ten poses.
    """
    known = poses.known
    if np.count_nonzero(known) < 10:
        raise DataError(
            f'body {poses.body}: {np.count_nonzero(known)} poses are too few for a filter, 10 '
            'are needed'
        )
    rate = _rate(poses)
    if not 0 < cutoff_hz < rate / 2:
        raise DataError(
            f'a cutoff of {cutoff_hz:g} Hz is not between 0 and half of the rate, {rate / 2:g} Hz'
        )
    b, a = scipy.signal.butter(2, cutoff_hz, fs=rate)  # second order in each direction
    time = np.arange(len(known))

    def smooth(values: NDArray[np.float64]) -> NDArray[np.float64]:
        flat = values.reshape(len(values), -1)
        interpolated = np.stack([np.interp(time, time[known], v[known]) for v in flat.T], axis=1)
        return scipy.signal.filtfilt(b, a, interpolated, axis=0).reshape(values.shape)

    quaternion = quaternion_from_matrix(np.where(known[:, None, None], poses.rotation, np.eye(3)))
    quaternion[known] = _continuous(quaternion[known])
    covariance = _propagated(poses.covariance_noise, known, (b, a))
    status = np.where(known, poses.status, PoseStatus.FILLED).astype(np.uint8)
    return replace(
        poses,
        rotation=matrix_from_quaternion(smooth(quaternion)),
        position_mm=smooth(poses.position_mm),
        covariance_noise=covariance,
        covariance_fixed=_nearest(poses.covariance_fixed, known),
        rig_root=_nearest(poses.rig_root, known),
        status=status,
    )


def _rate(poses: BodyPoses) -> float:
    """Return the rate [Hz] of the exposures. Raises DataError if they are not equidistant."""
    dt = np.diff(poses.stamp_ns) / 1e9
    typical = float(np.median(dt))
    if typical <= 0 or np.abs(dt - typical).max() > 0.2 * typical:
        raise DataError('a filter with a cutoff needs exposures at equal time intervals')
    return 1 / typical


def _continuous(quaternion: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return quaternions (T, 4) without sign changes."""
    same_sign = np.sum(quaternion[1:] * quaternion[:-1], axis=1) >= 0
    sign = np.cumprod(np.concatenate([[1.0], np.where(same_sign, 1.0, -1.0)]))
    return quaternion * sign[:, None]


def _propagated(
    covariance: NDArray[np.float64],
    known: NDArray[np.bool_],
    filter_: tuple[NDArray[np.float64], NDArray[np.float64]],
) -> NDArray[np.float64]:
    """Return filtered covariances (T, 6, 6): sums weighted by the squared impulse response."""
    size = len(covariance)
    impulse = np.zeros(2 * size + 1)
    impulse[size] = 1.0
    response = scipy.signal.filtfilt(*filter_, impulse) ** 2
    significant = np.flatnonzero(response > SETTLED * response.max())
    half = size - int(significant[0])
    response = response[size - half : size + half + 1]
    filled = _nearest(covariance, known).reshape(size, -1)
    padded = np.pad(filled, ((half, half), (0, 0)), mode='edge')
    filtered = scipy.signal.fftconvolve(padded, response[:, None], mode='valid', axes=0)
    return filtered.reshape(covariance.shape)


def _nearest(values: NDArray[np.float64], known: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Return values (T, ...), replaced by the nearest known exposure's where unknown."""
    rows = np.flatnonzero(known)
    middle = (rows[1:] + rows[:-1]) / 2
    return values[rows[np.searchsorted(middle, np.arange(len(known)), side='right')]]
