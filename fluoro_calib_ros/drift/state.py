# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What the drift watch reports: its level and the drift it has found."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum


class DriftLevel(IntEnum):
    """Level of an alarm; the values are those of the message DriftStatus."""

    OK = 0
    WARN = 1
    ERROR = 2


OK = DriftLevel.OK
WARN = DriftLevel.WARN
ERROR = DriftLevel.ERROR


@dataclass(frozen=True)
class DriftState:
    """Present state of the drift watch.

    Attributes
    ----------
    level : DriftLevel
    fluoroscope : str
        Name of the fluoroscope whose image has drifted, 'a or b' where the two cannot be
        distinguished, '' without a drift.
    area : tuple of float
        Corners u0, v0, u1, v1 of the area that has drifted [px].
    place : str
        The same area in words.
    size, sd : float
        Size of the drift along `direction` and its standard deviation [px]. As residuals are
        clipped, a size of more than a pixel is a lower bound.
    direction : tuple of float
        Unit vector (2,) in the image: the normal of the epipolar lines, or u or v where the drift
        was found by clusters.
    against : str
        Reference of the drift: 'calibration' or 'start'.
    source : str
        'epipolar' or 'cluster NAME'.
    evidence : float
        Largest log-likelihood ratio of all charts.
    threshold_warn, threshold_error : float
        Evidence at which the levels WARN and ERROR begin.
    since_s : float
        Estimated time since the drift began [s].
    observations : int
        Residuals and distances since the last reset.
    learning : bool
        Whether the reference is still being learned from the start of the stream.
    message : str
        One sentence.

    Without a drift, size, sd, since_s, area and direction are NaN.
    """

    level: DriftLevel
    fluoroscope: str
    area: tuple[float, ...]
    place: str
    size: float
    sd: float
    direction: tuple[float, ...]
    against: str
    source: str
    evidence: float
    threshold_warn: float
    threshold_error: float
    since_s: float
    observations: int
    learning: bool
    message: str
