# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Checks 'whiteness', 'worst_area' and 'drift': residuals have no trend, and it did not change.

An area also fails where image points of different exposures were rejected though they agree.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..correction.base import CorrectionModel
from ..findings import Kind, Place
from .calibration_evidence import CommonTrend, Evidence, Subject
from .check import Check, more_exposures
from .comparison import describe_place
from .residual_tests import RejectedTrend, change_of_trend

# Standard deviations of the correction by which the mean residual of an area may be off.
CLAIMED_SD = 3.0


def check_trends(evidence: Evidence, names: Sequence[str]) -> list[Check]:
    """Test the residuals of all exposures for a common trend, and for a change of it."""
    checks = []
    for name in names:
        common = evidence.trends[name]
        checks += [
            _whiteness(evidence, name, common),
            _worst_area(evidence, name, common),
            _drift(evidence, name, common),
        ]
    return checks


def _whiteness(evidence: Evidence, name: str, common: CommonTrend) -> Check:
    trend = common.trend
    model = evidence.calibrations[name].model
    where = describe_place(trend.place, evidence.calibrations[name].image_size)
    return Check(
        Kind.WHITENESS,
        f'the residuals have a trend of {trend.size:.2f} px, most at {where}',
        Place.at(name, trend.place),
        _advice(evidence.request.options.model_name, model, len(evidence.frames[name])),
        value=trend.size,
        limit=common.limit,
        unit='px',
    )


def _advice(requested: str, model: CorrectionModel, count: int) -> str:
    """Return what to do about a trend: requested is the model option, model the one in use."""
    if not model.corrects:
        return 'calibrate with a correction model (--model auto), it was made without one'
    other = '' if requested == 'auto' else ', or choose another model (--model auto)'
    return (
        f'the correction model {model.kind} does not follow the distortion there; '
        f'{more_exposures(count)} that show beads there{other}'
    )


def _worst_area(evidence: Evidence, name: str, common: CommonTrend) -> Check:
    rejected = common.rejected
    if rejected is not None and rejected.size > rejected.limit:
        return _rejected_area(evidence, name, rejected)
    trend = common.trend
    calibration = evidence.calibrations[name]
    claimed = max(float(calibration.model.evaluate(trend.place[None]).sd[0]), common.claimed_sd)
    return Check(
        Kind.WORST_AREA,
        f'the worst mean residual of an area, {trend.cell_size:.2f} px, is at '
        f'{describe_place(trend.place, calibration.image_size)}',
        Place.at(name, trend.place),
        f'{more_exposures(len(evidence.frames[name]))} that show beads there, or choose '
        'another model',
        value=trend.cell_size,
        limit=np.hypot(trend.cell_limit, CLAIMED_SD * claimed),
        unit='px',
    )


def _rejected_area(evidence: Evidence, name: str, rejected: RejectedTrend) -> Check:
    """Check that fails because image points are rejected though they agree."""
    size = evidence.calibrations[name].image_size
    return Check(
        Kind.WORST_AREA,
        f'{rejected.points} image points of different exposures were '
        f'rejected as false matches, but agree: {rejected.size:.2f} px on average at '
        f'{describe_place(rejected.place, size)}',
        Place.at(name, rejected.place),
        'the correction model does not follow the distortion there; '
        f'{more_exposures(len(evidence.frames[name]))} that show beads there, or choose a '
        'model with neighbours (--model hybrid)',
        numbers={'rejected_points': rejected.points},
        value=rejected.size,
        limit=rejected.limit,
        unit='px',
    )


def _drift(evidence: Evidence, name: str, common: CommonTrend) -> Check:
    size = evidence.calibrations[name].image_size
    change = change_of_trend(common.inliers, size)
    # The whole image decides, unless only the worst area has changed.
    whole = change.size > change.limit or change.cell_size <= change.cell_limit
    return Check(
        Kind.DRIFT,
        f'earlier and later exposures differ by {change.size:.2f} px, '
        f'most at {describe_place(change.place, size)} by {change.cell_size:.2f} px',
        Place.at(name, change.place),
        'the distortion has changed between the exposures; take all of them again in one '
        'session, with nothing switched, moved or warming up',
        value=change.size if whole else change.cell_size,
        limit=change.limit if whole else change.cell_limit,
        unit='px',
    ).after_trend(common.is_significant)


TRENDS = Subject(check_trends)
