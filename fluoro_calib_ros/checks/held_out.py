# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Checks 'held_out' and 'exposures': exposures fit a calibration that has not used them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from ..correction.fluoroscope_calibration import FluoroscopeCalibration
from ..correction.models import no_correction
from ..errors import DataError
from ..estimation.result import CalibrationResult
from ..findings import Finding, Kind, Place
from .calibration_evidence import Evidence, Subject
from .check import GOOD_EXPOSURES, Check, more_exposures, too_little_data
from .residual_tests import residuals_of

# Doubts whether exposures fit calibrations that are fixed.
#
# A fixed calibration leaves the noise that it was determined with. Where exposures leave much
# more, it is not theirs: the image has changed, the fluoroscopes are interchanged, or the image
# points are corrected already.

MAX_NOISE = 2.0  # RMSE over the noise of an image coordinate of the calibration
CORRECTED = 0.6  # RMSE without the correction over that with it, of points that are corrected


def uncorrected(
    calibrations: Mapping[str, FluoroscopeCalibration],
) -> dict[str, FluoroscopeCalibration]:
    """Return calibrations without their corrections, to try image points that are corrected."""
    return {
        name: replace(
            calibration,
            model=no_correction(),
            train_exposure=np.zeros(0, dtype=np.int64),
            angle_field=None,
        )
        for name, calibration in calibrations.items()
    }


def misfits(
    result: CalibrationResult, calibrations: Mapping[str, FluoroscopeCalibration]
) -> dict[str, float]:
    """Return the RMSE over the noise of each fluoroscope whose exposures a calibration misfits."""
    ratios = {
        name: _rmse(figures.rmse_after) / calibrations[name].image_sd
        for name, figures in result.fluoroscopes.items()
    }
    return {name: ratio for name, ratio in ratios.items() if ratio > MAX_NOISE}


def corrected_already(
    result: CalibrationResult,
    without: CalibrationResult,
    calibrations: Mapping[str, FluoroscopeCalibration],
) -> Finding | None:
    """Return a finding on the fluoroscopes whose image points are corrected already.

    without: the adjustment with the `uncorrected` calibrations, which fits their exposures.
    """
    fit = misfits(without, calibrations)
    names = [name for name in misfits(result, calibrations) if name not in fit]
    if not names:
        return None
    one, other = (
        max(_rmse(found.fluoroscopes[name].rmse_after) for name in names)
        for found in (result, without)
    )
    return Finding(
        Kind.CORRECTED_ALREADY,
        f'the image points are corrected already, their RMSE is {one:.2f} px with the correction '
        f'and {other:.2f} px without',
        Place(tuple(names)),
        'give the observed ones',
        numbers={'rmse_px': one, 'rmse_without_px': other},
    )


def _rmse(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def poor_fits(
    result: CalibrationResult, calibrations: Mapping[str, FluoroscopeCalibration]
) -> list[Finding]:
    """Return a finding for every fluoroscope whose exposures its calibration does not fit."""
    out = []
    for name, figures in result.fluoroscopes.items():
        after = _rmse(figures.rmse_after)
        noise = calibrations[name].image_sd
        if after <= MAX_NOISE * noise:
            continue
        before = _rmse(figures.rmse_before)
        kind = Kind.POOR_CALIBRATION_FIT
        why = 'the image has changed, or the calibration is that of another fluoroscope'
        if before < CORRECTED * after:
            kind = Kind.CORRECTED_ALREADY
            why = 'the image points seem to be corrected already'
        out.append(
            Finding(
                kind,
                f'RMSE {after:.2f} px with the calibration fixed, {after / noise:.1f} times the '
                'noise with which it was determined',
                Place((name,)),
                why,
                numbers={'rmse_px': after, 'ratio': after / noise},
            )
        )
    return out


KINDS = (Kind.HELD_OUT, Kind.EXPOSURES)
FOLDS = 4
# Limits from simulated rigs: docs/verdict.md, benchmarks/verdict.py.
MARGIN = (
    0.13  # over the expectation, with GOOD_EXPOSURES; it grows as the root of their number falls
)
EXPOSURE_LIMIT = 1.6  # times the expectation
# Robust standard deviations of the logarithms over all exposures that one of many exposures may
# stand out by; n exposures add SCATTER_OF_FEW / n. Where the noise differs from exposure to
# exposure, much of it in one is no fault of that one.
EXPOSURE_SCATTER = 4.0
SCATTER_OF_FEW = 20.0
MIN_NOISE = 0.05  # part of the squared residuals in sample that is noise, whatever the trend


class ExposureSums(NamedTuple):
    """Sums of an exposure over its image points.

    Attributes
    ----------
    number : int
        Of the exposure.
    points : int
    outside, inside : float
        Squared residuals [px^2] with a calibration that has not used the exposure, and with one
        that has. The same exposures are adjusted in the same way, so that the adjustment absorbs
        the same part of the residuals.
    predicted : float
        Predicted variance of the correction [px^2].
    """

    number: int
    points: int
    outside: float
    inside: float
    predicted: float


def check_held_out(evidence: Evidence, names: Sequence[str]) -> list[Check]:
    """Compare residuals out of sample with their expectation, two checks a fluoroscope."""
    fewest = evidence.fewest_exposures(names)
    folds = min(FOLDS, fewest)
    sums: dict[str, list[ExposureSums]] = {name: [] for name in names}
    try:
        for fold in range(FOLDS):
            evidence.report_step(
                f'{"+".join(names)}: held-out exposures, part {fold + 1} of {FOLDS}'
            )
            if fold < folds:
                found = _hold_out(evidence, names, fold, folds)
                for name in names:
                    sums[name] += found[name]
    except DataError as error:
        reason = f'a part of the exposures cannot be calibrated or adjusted alone ({error})'
        return [too_little_data(kind, name, reason, fewest) for name in names for kind in KINDS]
    return [check for name in names for check in _checks(evidence, name, sums[name])]


def _hold_out(
    evidence: Evidence, names: Sequence[str], fold: int, folds: int
) -> dict[str, list[ExposureSums]]:
    """Calibrate without the exposures of a fold; return their sums by fluoroscope."""
    frames = evidence.part(names, lambda i: i % folds == fold)
    others = evidence.part(names, lambda i: i % folds != fold)
    calibrations = evidence.calibrate(others)
    job_outside = evidence.adjust(frames, calibrations)
    job_inside = evidence.adjust(frames, {name: evidence.calibrations[name] for name in names})
    out: dict[str, list[ExposureSums]] = {}
    for name in names:
        outside = residuals_of(job_outside, name, frames[name])
        inside = residuals_of(job_inside, name, frames[name])
        if not np.array_equal(outside.numbers, inside.numbers):
            raise DataError(
                f'fluoroscope {name}: an exposure does not fit a calibration without it'
            )
        sd = evidence.calibrations[name].image_sd_at(outside.uv)
        squared_outside = outside.capped(sd)
        squared_inside = inside.capped(sd)
        predicted = 2 * calibrations[name].correction(outside.uv, outside.angle).sd ** 2
        out[name] = []
        for row, number in enumerate(outside.numbers):
            points = outside.exposure == row
            out[name].append(
                ExposureSums(
                    int(number),
                    points.sum(),
                    squared_outside[points].sum(),
                    squared_inside[points].sum(),
                    predicted[points].sum(),
                )
            )
    return out


def _checks(evidence: Evidence, name: str, sums: Sequence[ExposureSums]) -> list[Check]:
    common = evidence.trends[name]
    count = len(evidence.frames[name])
    number, n, outside, inside, predicted = (np.array(column) for column in zip(*sums))
    # A trend that is left in sample is not noise.
    noise = np.maximum(inside - 2 * n * common.trend.size**2, MIN_NOISE * inside)
    value = float(np.sqrt(outside.sum() / (2 * n.sum())))
    expected = float(np.sqrt((noise + predicted).sum() / (2 * n.sum())))
    limit = 1 + MARGIN * np.sqrt(GOOD_EXPOSURES / count)
    held_out = Check(
        Kind.HELD_OUT,
        f'residuals of exposures held out are {value:.3f} px, {expected:.3f} px are expected',
        Place((name,)),
        f'the calibration does not hold for exposures it has not used; {more_exposures(count)} in '
        'other poses',
        numbers={'expected_px': expected},
        value=value,
        limit=limit * expected,
        unit='px',
    )
    # Where something moved during an exposure, it does not fit in sample either. So the noise of
    # the others is expected of it.
    ratio = np.sqrt(outside / (n * np.median(noise / n) + predicted))
    worst = int(np.argmax(ratio))
    exposures = Check(
        Kind.EXPOSURES,
        f'exposure {number[worst]} fits the calibration of the others worst, '
        f'with {ratio[worst]:.2f} times the expected residuals',
        Place((name,), (int(number[worst]),), name=f'fluoroscope {name}'),
        'inspect it (phantom or fluoroscope moved, wrong ids), exclude it and calibrate again',
        value=ratio[worst],
        limit=exposure_limit(ratio),
        unit='1',
    )
    return [check.after_trend(common.is_significant) for check in (held_out, exposures)]


def exposure_limit(ratio: np.ndarray) -> float:
    """Limit of the residuals of an exposure over their expectation.

    ratio (m,): of all exposures; half of them or fewer are at fault. The scatter of their
    logarithms is the median absolute deviation, times 1.4826 (Huber, "Robust Statistics", 1981).
    The largest of 6 to 100 normal deviates exceeds the limit in 0.5 to 1.5 % of samples.
    """
    size = np.log(ratio)
    scatter = 1.4826 * np.median(np.abs(size - np.median(size)))
    factor = EXPOSURE_SCATTER + SCATTER_OF_FEW / len(ratio)
    return float(max(EXPOSURE_LIMIT, np.exp(factor * scatter)))


HELD_OUT = Subject(check_held_out, steps=FOLDS)
