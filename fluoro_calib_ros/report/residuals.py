# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Residuals of a calibration, computed again from what its result folder contains."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..correction.fluoroscope_calibration import FluoroscopeCalibration
from ..exposures.frame import Frame
from ..photogrammetry.collinearity import project

Pose = tuple[np.ndarray, np.ndarray]


@dataclass(frozen=True)
class Residuals:
    """Image residuals of one fluoroscope."""

    exposure: NDArray[np.int64]  #: (n,)
    target_id: NDArray[np.int64]  #: (n,)
    uv: NDArray[np.float64]  #: (n, 2), observed pixels
    #: (n, 2), observed and corrected minus computed [px]
    before: NDArray[np.float64]
    after: NDArray[np.float64]
    inlier: NDArray[np.bool_]  #: (n,), False for image points that fail their test
    #: (n,), of the C-arm [rad], NaN where it is unknown; None: it is nowhere known
    angle: NDArray[np.float64] | None = None

    def of_exposures(self) -> list[tuple[int, int, float, float]]:
        """Return number, inliers, and RMS before and after [px] of every exposure."""
        out = []
        for number in np.unique(self.exposure):
            rows = (self.exposure == number) & self.inlier
            out.append(
                (int(number), int(rows.sum()), _rms(self.before[rows]), _rms(self.after[rows]))
            )
        return out


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2))) if len(values) else float('nan')


def residuals_of(
    calibration: FluoroscopeCalibration,
    frames: Sequence[Frame],
    poses: Mapping[int, Pose],
    points_mm: Mapping[int, NDArray[np.float64]],
    outliers: set[tuple[int, int]],
) -> Residuals:
    """Return the residuals of the frames of a fluoroscope.

    Parameters
    ----------
    calibration : FluoroscopeCalibration
    frames : sequence of Frame
    poses : mapping of int to (rotation, position_mm)
        Exterior orientation by exposure; frames of other exposures were not used.
    points_mm : mapping of int to (3,) ndarray
        Adjusted object points by target.
    outliers : set of (exposure, target)

    Returns
    -------
    Residuals
    """
    exposure = []
    target_id = []
    uv = []
    angle = []
    computed = []
    for frame in frames:
        if frame.number not in poses:
            continue
        known = [i for i, target in enumerate(frame.target_id.tolist()) if target in points_mm]
        ids = frame.target_id[known]
        rotation, position = poses[frame.number]
        points = np.array([points_mm[i] for i in ids.tolist()]).reshape(-1, 3)
        count = len(ids)
        exposure.append(np.full(count, frame.number))
        target_id.append(ids)
        uv.append(frame.uv[known])
        angle.append(np.full(count, np.nan if frame.angle is None else frame.angle))
        computed.append(
            project(
                np.broadcast_to(rotation, (count, 3, 3)),
                np.broadcast_to(position, (count, 3)),
                points,
                calibration.interior,
            )
        )
    if not exposure:
        empty = np.zeros((0, 2))
        none = np.zeros(0, dtype=int)
        return Residuals(none, none, uv=empty, before=empty, after=empty, inlier=none.astype(bool))
    numbers, ids, observed, expected = map(np.concatenate, (exposure, target_id, uv, computed))
    angles = np.concatenate(angle)
    corrected = calibration.correct(observed, exact=True, angle=angles).uv
    inlier = np.array([pair not in outliers for pair in zip(numbers.tolist(), ids.tolist())])
    return Residuals(
        numbers,
        ids,
        uv=observed,
        before=observed - expected,
        after=corrected - expected,
        inlier=inlier.astype(bool),
        angle=angles,
    )
