# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Check 'precision': corrected points are nearly as precise as with perfectly known distortion."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..estimation.options import AUTO
from ..findings import Kind, Place
from .calibration_evidence import Evidence, Subject
from .check import Check, more_exposures

# Standard deviation of the correction over that of an image coordinate. Independent errors add in
# square: with this ratio, those of corrected points are 1.14 times those with known distortion.
MAX_RATIO = 0.55


def check_precision(evidence: Evidence, names: Sequence[str]) -> list[Check]:
    """Compare the claimed precision of the correction with the noise, for each fluoroscope."""
    return [_check(evidence, name) for name in names]


def _check(evidence: Evidence, name: str) -> Check:
    common = evidence.trends[name]
    # Residuals are smaller than the noise: orientations, object points and correction follow it.
    noise = evidence.calibrations[name].image_sd
    count = len(evidence.frames[name])
    advice = f'{more_exposures(count)}, or a phantom with more beads'
    if common.trend.size > common.trend.limit:
        # What a model cannot follow is in its residuals, and in its claim.
        misfit = common.trend.size**2 / _redundancy(evidence, name)
        noise = float(np.sqrt(max(noise**2 - misfit, 0.0)))
        if evidence.request.options.model_name != AUTO:
            advice = f'choose another model (--model auto), or {advice}'
    ratio = common.claimed_sd / noise if noise > 0 else np.inf
    growth = 100 * (np.sqrt(1 + ratio**2) - 1)
    return Check(
        Kind.PRECISION,
        f'the correction has a standard deviation of {common.claimed_sd:.2f} px, at an image '
        f'noise of {noise:.2f} px: it makes the errors of corrected points {growth:.0f} % larger',
        Place((name,)),
        advice,
        numbers={'sd_px': common.claimed_sd, 'noise_px': noise, 'exposures': count},
        value=ratio,
        limit=MAX_RATIO,
        unit='noise sd',
    )


def _redundancy(evidence: Evidence, name: str) -> float:
    """Mean redundancy number of the inliers, by which residuals are enlarged to noise."""
    table = evidence.result.residuals
    if table is None:
        return 1.0
    return float(np.mean(table.redundancy[(table.fluoroscope == name) & ~table.outlier]))


PRECISION = Subject(check_precision)
