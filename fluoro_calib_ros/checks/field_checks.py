# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Checks of a correction: 'precision', 'variation', 'halves', 'whiteness', 'worst_area', 'drift'.

Checks 'whiteness', 'worst_area' and 'drift': residuals have no trend, and no trend that changed.
An area also fails if rejected image points of different exposures agree there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ..correction.base import CorrectionModel
from ..correction.fluoroscope_calibration import FluoroscopeCalibration
from ..errors import DataError
from ..estimation.exposure_terms import MIN_POINTS, VARYING
from ..estimation.lack_of_fit import RejectedArea
from ..estimation.options import AUTO
from ..exposures.collector import MIN_EXPOSURES
from ..exposures.frame import angles_of
from ..findings import Kind, Place, too_few
from ..photogrammetry.noise import MIN_REDUNDANCY, SURE
from .calibration_evidence import (
    MIN_VARYING_EXPOSURES,
    CommonTrend,
    Evidence,
    Subject,
    for_each,
)
from .check import Check, more_exposures, too_little_data
from .comparison import describe_place, difference
from .residual_tests import change_of_trend

# Maximum ratio of the standard deviations of the correction and of an image coordinate.
# Independent errors add in square: this ratio makes them 1.14 times those with known distortion.
MAX_RATIO = 0.55
# Share of the noise variance in the residuals below which the noise is only a bound: where they do
# not show it, a calibration keeps their redundancy above MIN_REDUNDANCY, in steps of two.
NOISE_SHOWN = 2 * MIN_REDUNDANCY


def check_precision(evidence: Evidence, name: str) -> Check:
    """Compare the claimed precision of the correction with the noise."""
    trends = evidence.trends[name]
    # Use the noise instead of residuals: these are smaller, as all unknowns follow the noise.
    noise = evidence.calibrations[name].image_sd
    count = len(evidence.frames[name])
    if np.mean(np.square(evidence.calibrations[name].rmse_after)) < NOISE_SHOWN * noise**2:
        reason = 'targets that are seen once do not show the image noise; the correction has a '
        reason += f'standard deviation of {trends.claimed_sd:.3f} px'
        check = too_little_data(Kind.PRECISION, name, reason, count)
        return replace(check, numbers={**check.numbers, 'sd_px': trends.claimed_sd})
    advice = f'{more_exposures(count)}, or a phantom with more beads'
    if trends.trend.size > trends.trend.limit:
        # Distortion that a model cannot follow enlarges its residuals and its claimed sd.
        misfit = trends.trend.size**2 / _redundancy(evidence, name)
        noise = float(np.sqrt(max(noise**2 - misfit, 0.0)))
        if evidence.request.options.model_name != AUTO:
            advice = f'choose another model (--model auto), or {advice}'
    ratio = trends.claimed_sd / noise if noise > 0 else np.inf
    comparison = 'residuals explained by its lack of fit: the image noise is unknown'
    if np.isfinite(ratio):
        growth = 100 * (np.sqrt(1 + ratio**2) - 1)
        comparison = f'an image noise of {noise:.3f} px: it makes the errors of corrected points '
        comparison += f'{growth:.0f} % larger'
    return Check(
        Kind.PRECISION,
        f'the correction has a standard deviation of {trends.claimed_sd:.3f} px, at {comparison}',
        Place((name,)),
        advice,
        numbers={'sd_px': trends.claimed_sd, 'noise_px': noise, 'exposures': count},
        value=ratio,
        limit=MAX_RATIO,
        unit='noise sd',
    )


def _redundancy(evidence: Evidence, name: str) -> float:
    """Return the mean redundancy number of the inliers, which relates residuals to noise."""
    table = evidence.result.residuals
    return float(np.mean(table.redundancy[(table.fluoroscope == name) & ~table.outlier]))


PRECISION = Subject(for_each(check_precision))


# Maximum harmless change of the distortion, in standard deviations of residuals. In a later
# exposure the change is an error in addition to its noise, which is larger than residuals: the
# errors of its points are then up to 8 % larger.
HARMLESS = 0.45


def _too_few_points(evidence: Evidence, name: str) -> Check:
    """Return the check that could not be made; more exposures with as few points do not help."""
    count = len(evidence.frames[name])
    reason = f'fewer than {MIN_VARYING_EXPOSURES} exposures have {MIN_POINTS} image points'
    check = too_little_data(Kind.VARIATION, name, reason, count)
    if len(evidence.phantom.target_id) < MIN_POINTS:
        return replace(check, advice=f'use a phantom with {MIN_POINTS} beads or more')
    if count < MIN_VARYING_EXPOSURES:
        return check
    return replace(check, advice='take exposures that show more beads')


def check_variation(evidence: Evidence, name: str) -> Check:
    """Fit low-order terms to the residuals of each exposure."""
    count = len(evidence.frames[name])
    variation = evidence.variations[name]
    if variation is None:
        return _too_few_points(evidence, name)
    return Check(
        Kind.VARIATION,
        f'the distortion differs between exposures by {variation.size_px:.3f} px '
        f'(chi2/dof {variation.chi2_per_dof:.2f}, constant up to {VARYING:.2f})',
        Place((name,)),
        f'{_angles(evidence, name)}, a refocused or zoomed lens, an unstable source or detector, '
        f'or a phantom that moved, was bent or has a wrong survey; {more_exposures(count)} at '
        'the angle and setting in use, or calibrate each' + _how_to_give_angles(evidence, name),
        numbers={
            'chi2_per_dof': variation.chi2_per_dof,
            'noise_px': variation.noise_px,
            'angle_range_deg': float(np.rad2deg(np.ptp(angles_of(evidence.frames[name])))),
        },
        value=variation.size_px,
        limit=HARMLESS * variation.noise_px,
        unit='px',
    ).after_trend(evidence.trends[name].is_significant)


def _angles(evidence: Evidence, name: str) -> str:
    """Return what may be wrong with the angles of the C-arm."""
    angles = angles_of(evidence.frames[name])
    if not np.isfinite(angles).all() or np.ptp(angles) == 0:
        return 'a C-arm at another angle'
    if np.ptp(angles) < np.deg2rad(2 * np.pi):  # as degrees, less than a full turn in radians
        return 'angles of the C-arm that are in radians, not in degrees'
    return 'angles of the C-arm that belong to other exposures'


def _how_to_give_angles(evidence: Evidence, name: str) -> str:
    """Return additional advice for unknown angles of the C-arm."""
    if np.isfinite(angles_of(evidence.frames[name])).all():
        return ''
    return '; or give the angle of the C-arm with each exposure (angle_deg, or joint_states)'


VARIATION = Subject(for_each(check_variation))


LIMIT = 1.9  # predicted sds, from simulated rigs: docs/verdict.md, benchmarks/verdict.py


def check_halves(evidence: Evidence, names: Sequence[str]) -> list[Check]:
    """Compare the calibrations of two halves of the exposures; one check per fluoroscope."""
    evidence.report_step(f'{"+".join(names)}: two halves')
    fewest = evidence.fewest_exposures(names)
    if fewest < 2 * MIN_EXPOSURES:
        reason = f'{too_few(fewest, "exposure")} for two halves of {MIN_EXPOSURES} or more'
        return [too_little_data(Kind.HALVES, name, reason, fewest) for name in names]
    try:
        even = evidence.calibrate(evidence.part(names, lambda i: i % 2 == 0))
        odd = evidence.calibrate(evidence.part(names, lambda i: i % 2 == 1))
    except DataError as error:
        reason = f'half of the exposures cannot be calibrated ({error})'
        return [too_little_data(Kind.HALVES, name, reason, fewest) for name in names]
    return [_agreement(name, even[name], odd[name], len(evidence.frames[name])) for name in names]


def _agreement(
    name: str, one: FluoroscopeCalibration, other: FluoroscopeCalibration, count: int
) -> Check:
    compared = difference(one, other)
    if compared is None:
        reason = 'the areas of the image that two halves of the exposures cover overlap too little'
        return too_little_data(Kind.HALVES, name, reason, count)
    expected = float(np.sqrt(np.mean(compared.sd**2)))
    return Check(
        Kind.HALVES,
        'two halves of the exposures give corrections that differ by '
        f'{compared.rms_px:.3f} px, where {expected:.3f} px is predicted, most at '
        f'{describe_place(compared.worst, one.image_size)}',
        Place.at(name, compared.worst),
        f'{more_exposures(count)} that show beads there, and keep phantom and fluoroscope still '
        'during each',
        numbers={'difference_px': compared.rms_px, 'predicted_px': expected},
        value=compared.normalised,
        limit=LIMIT,
        unit='predicted sd',
    )


HALVES = Subject(check_halves, steps=1)


def check_trends(evidence: Evidence, names: Sequence[str]) -> list[Check]:
    """Test the residuals of all exposures for a common trend, and for its change."""
    checks = []
    for name in names:
        trend = evidence.trends[name]
        checks += [
            _whiteness(evidence, name, trend),
            _worst_area(evidence, name, trend),
            _drift(evidence, name, trend),
        ]
    return checks


def _not_compared(kind: Kind, evidence: Evidence, name: str) -> Check:
    """Return the check that cannot be made because too few exposures can be compared."""
    reason = 'too few exposures show beads in the same areas of the image'
    return too_little_data(kind, name, reason, len(evidence.frames[name]))


def _whiteness(evidence: Evidence, name: str, common: CommonTrend) -> Check:
    trend = common.trend
    if np.isinf(common.limit):
        return _not_compared(Kind.WHITENESS, evidence, name)
    model = evidence.calibrations[name].model
    position = describe_place(trend.place, evidence.calibrations[name].image_size)
    return Check(
        Kind.WHITENESS,
        f'the residuals have a trend of {trend.size:.3f} px, most at {position}',
        Place.at(name, trend.place),
        _advice(evidence.request.options.model_name, model, len(evidence.frames[name])),
        value=trend.size,
        limit=common.limit,
        unit='px',
    )


def _advice(requested: str, model: CorrectionModel, count: int) -> str:
    """Return the advice on a trend; requested: model option, model: model in use."""
    if not model.corrects:
        return 'calibrate with a correction model (--model auto), there is none'
    alternative = '' if requested == 'auto' else ', or choose another model (--model auto)'
    return (
        f'the correction model {model.kind} does not follow the distortion there; '
        f'{more_exposures(count)} that show beads there{alternative}'
    )


def _worst_area(evidence: Evidence, name: str, common: CommonTrend) -> Check:
    rejected = common.rejected
    if rejected is not None and rejected.size_px > rejected.limit_px:
        return _rejected_area(evidence, name, rejected)
    trend = common.trend
    calibration = evidence.calibrations[name]
    correction_sd = max(
        float(calibration.model.evaluate(trend.place[None]).sd[0]), common.claimed_sd
    )
    return Check(
        Kind.WORST_AREA,
        f'the largest mean residual of an area, {trend.cell_size:.3f} px, is at '
        f'{describe_place(trend.place, calibration.image_size)}',
        Place.at(name, trend.place),
        f'{more_exposures(len(evidence.frames[name]))} that show beads there, or choose '
        'another model',
        value=trend.cell_size,
        limit=np.hypot(trend.cell_limit, SURE * correction_sd),
        unit='px',
    )


def _rejected_area(evidence: Evidence, name: str, rejected: RejectedArea) -> Check:
    """Return the check that fails because rejected image points agree."""
    size = evidence.calibrations[name].image_size
    return Check(
        Kind.WORST_AREA,
        f'{len(rejected.rows)} image points of different exposures were rejected as false '
        f'matches, but agree with each other: {rejected.size_px:.3f} px on average at '
        f'{describe_place(rejected.place, size)}',
        Place.at(name, rejected.place),
        'the correction model does not follow the distortion there; '
        f'{more_exposures(len(evidence.frames[name]))} that show beads there, or choose a '
        'model with neighbours (--model hybrid)',
        numbers={'rejected_points': len(rejected.rows)},
        value=rejected.size_px,
        limit=rejected.limit_px,
        unit='px',
    )


def _drift(evidence: Evidence, name: str, common: CommonTrend) -> Check:
    size = evidence.calibrations[name].image_size
    change = change_of_trend(common.inliers, size)
    if np.isinf(change.limit) and np.isinf(change.cell_limit):
        return _not_compared(Kind.DRIFT, evidence, name)
    # The whole image decides, unless only the worst area has changed.
    is_of_image = change.size > change.limit or change.cell_size <= change.cell_limit
    return Check(
        Kind.DRIFT,
        f'earlier and later exposures differ by {change.size:.3f} px, '
        f'most at {describe_place(change.place, size)} by {change.cell_size:.3f} px',
        Place.at(name, change.place),
        'the distortion has changed between the exposures; take all of them again in one '
        'session, with nothing switched, moved or warming up',
        value=change.size if is_of_image else change.cell_size,
        limit=change.limit if is_of_image else change.cell_limit,
        unit='px',
    ).after_trend(common.is_significant)


TRENDS = Subject(check_trends)
