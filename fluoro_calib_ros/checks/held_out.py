# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Checks 'held_out' and 'exposures': exposures fit a calibration made without them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from ..correction.fluoroscope_calibration import Calibrations, FluoroscopeCalibration
from ..errors import DataError
from ..estimation.result import CalibrationResult
from ..estimation.rounds import ResidualTable
from ..exposures.collector import RECOMMENDED_EXPOSURES
from ..exposures.frame import Frame, Frames
from ..findings import Finding, Kind, Place
from ..photogrammetry.noise import CERTAIN, INLIER_Q, NORMAL_MEDIAN
from .calibration_evidence import Evidence, Subject
from .check import Check, more_exposures, rms, too_little_data
from .residual_tests import RejectedExposure, noise_of, residuals_of

# Tests whether exposures fit fixed calibrations.
#
# With a fixed calibration, residuals have the noise with which it was determined. If they are much
# larger, the calibration does not belong to the exposures: the image has changed, the fluoroscopes
# are interchanged, or the image points are already corrected.

MAX_NOISE = 2.0  # maximum RMSE of image points over their noise


def misfits(
    result: CalibrationResult, calibrations: Calibrations, frames: Frames
) -> dict[str, float]:
    """Return the ratio of residuals and noise of fluoroscopes that their calibration misfits."""
    ratios = {
        name: _lack_of_fit(result.residuals, calibrations[name], name, frames[name])
        for name in result.fluoroscopes
    }
    return {name: ratio for name, ratio in ratios.items() if ratio > MAX_NOISE}


def _lack_of_fit(
    table: ResidualTable, calibration: FluoroscopeCalibration, name: str, frames: Sequence[Frame]
) -> float:
    """Return the RMSE of image points that are not false matches, over their noise."""
    ratios = []
    for frame in frames:
        rows = (table.fluoroscope == name) & (table.exposure == frame.number) & ~table.outlier
        ordered = frame.sorted()
        place = np.searchsorted(ordered.target_id, table.target_id[rows])
        noise = calibration.noise_sd(ordered)[place]
        ratios.append(table.residual[rows] / noise[:, None])
    return rms(np.concatenate(ratios))


def corrected_already(
    result: CalibrationResult,
    without: CalibrationResult,
    calibrations: Calibrations,
    frames: Frames,
) -> Finding | None:
    """Return a finding on the fluoroscopes whose image points are already corrected.

    without: adjustment with the `uncorrected` calibrations, which fits these exposures.
    """
    fit = misfits(without, calibrations, frames)
    names = [name for name in misfits(result, calibrations, frames) if name not in fit]
    if not names:
        return None
    rmse, rmse_without = (
        max(rms(adjusted.fluoroscopes[name].rmse_after) for name in names)
        for adjusted in (result, without)
    )
    return Finding(
        Kind.CORRECTED_ALREADY,
        f'the image points are already corrected, their RMSE is {rmse:.2f} px with the '
        f'correction and {rmse_without:.2f} px without',
        Place(tuple(names)),
        'give the observed image points',
        numbers={'rmse_px': rmse, 'rmse_without_px': rmse_without},
    )


def poor_fits(
    result: CalibrationResult, calibrations: Calibrations, frames: Frames
) -> list[Finding]:
    """Return a finding for every fluoroscope whose calibration does not fit its exposures."""
    out = []
    for name, ratio in misfits(result, calibrations, frames).items():
        rmse = rms(result.fluoroscopes[name].rmse_after)
        out.append(
            Finding(
                Kind.POOR_CALIBRATION_FIT,
                f'RMSE {rmse:.2f} px with the calibration fixed, {ratio:.1f} times the noise with '
                'which it was determined',
                Place((name,)),
                'the image has changed, or the calibration is of another fluoroscope',
                numbers={'rmse_px': rmse, 'ratio': ratio},
            )
        )
    return out


KINDS = (Kind.HELD_OUT, Kind.EXPOSURES)
FOLDS = 4
# Limits from simulated rigs: docs/verdict.md, benchmarks/verdict.py.
# Margin over the expectation with RECOMMENDED_EXPOSURES; proportional to 1 / sqrt(exposures).
MARGIN = 0.13
EXPOSURE_LIMIT = 1.6  # minimum limit, as a multiple of the expectation
# The worst of n exposures may deviate by CERTAIN + SCATTER_OF_FEW / n robust standard deviations,
# those of the logarithms over all exposures. If noise differs between exposures, an exposure with
# much noise is not at fault. But noise also differs between neighbouring image points: an exposure
# whose neighbours agree has a misfit, whatever the scatter.
SCATTER_OF_FEW = 20.0
MIN_NOISE = 0.05  # minimum noise share of the squared residuals in sample, whatever the trend


class ExposureSums(NamedTuple):
    """Sums over the image points of an exposure."""

    number: int  #: number of the exposure
    points: int
    #: sum of the weights of points, 1 where their noise is that of the fluoroscope; points that
    #: are stated to be less precise may have larger residuals
    weight: float
    #: squared residuals [px^2] with a calibration made without the exposure, and with one made
    #: with it; both are adjusted in the same way, so that the adjustment absorbs the same part of
    #: the residuals
    outside: float
    inside: float
    predicted: float  #: predicted variance of the correction [px^2]
    #: half the squared differences of the residuals of nearest neighbours [px^2]: noise, without
    #: the misfit of an area
    white: float


def check_held_out(evidence: Evidence, names: Sequence[str]) -> list[Check]:
    """Compare residuals out of sample with their expectation; two checks per fluoroscope."""
    fewest = evidence.fewest_exposures(names)
    folds = min(FOLDS, fewest)
    sums: dict[str, list[ExposureSums]] = {name: [] for name in names}
    try:
        for fold in range(FOLDS):
            evidence.report_step(
                f'{"+".join(names)}: held-out exposures, part {fold + 1} of {FOLDS}'
            )
            if fold < folds:
                squares = _hold_out(evidence, names, fold, folds)
                for name in names:
                    sums[name] += squares[name]
    except DataError as error:
        reason = f'a part of the exposures cannot be calibrated or adjusted alone ({error})'
        return [too_little_data(kind, name, reason, fewest) for name in names for kind in KINDS]
    return [check for name in names for check in _checks(evidence, name, sums[name])]


def _hold_out(
    evidence: Evidence, names: Sequence[str], fold: int, folds: int
) -> dict[str, list[ExposureSums]]:
    """Calibrate without the exposures of a fold; return the sums of the fold by fluoroscope."""
    frames = evidence.part(names, lambda i: i % folds == fold)
    training = evidence.part(names, lambda i: i % folds != fold)
    calibrations = evidence.calibrate(training)
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
        sd = noise_of(inside, evidence.calibrations[name], frames[name])
        factor = sd / evidence.calibrations[name].image_sd
        squared_outside = outside.capped(sd) / factor**2
        squared_inside = inside.capped(sd) / factor**2
        predicted = 2 * (calibrations[name].correction(outside.uv, outside.angle).sd / factor) ** 2
        r = outside.r / factor[:, None]
        out[name] = []
        for row, number in enumerate(outside.numbers):
            points = outside.exposure == row
            out[name].append(
                ExposureSums(
                    int(number),
                    points.sum(),
                    weight=np.sum(factor[points] ** -2),
                    outside=squared_outside[points].sum(),
                    inside=squared_inside[points].sum(),
                    predicted=predicted[points].sum(),
                    white=_white(outside.uv[points], r[points], (sd / factor)[points]),
                )
            )
    return out


def _white(uv: NDArray[np.float64], r: NDArray[np.float64], sd: NDArray[np.float64]) -> float:
    """Sum half the squared differences (n, 2) [px] between neighbours, capped like residuals.

    Differences of independent residuals have twice their variance (von Neumann, "Distribution of
    the ratio of the mean square successive difference to the variance", Annals of Mathematical
    Statistics 12, 1941).
    """
    _, nearest = cKDTree(uv).query(uv, k=[min(2, len(uv))])
    squares = np.sum((r - r[nearest[:, 0]]) ** 2, axis=1) / 2
    return float(np.sum(np.minimum(squares, INLIER_Q * sd**2)))


def _checks(evidence: Evidence, name: str, sums: Sequence[ExposureSums]) -> list[Check]:
    trends = evidence.trends[name]
    count = len(evidence.frames[name])
    number, n, weight, outside, inside, predicted, white = map(np.array, zip(*sums))
    # A trend that remains in sample is not noise.
    noise = np.maximum(inside - 2 * weight * trends.trend.size**2, MIN_NOISE * inside)
    value = float(np.sqrt(outside.sum() / (2 * n.sum())))
    expected = float(np.sqrt((noise + predicted).sum() / (2 * n.sum())))
    limit = 1 + MARGIN * np.sqrt(RECOMMENDED_EXPOSURES / count)
    held_out = Check(
        Kind.HELD_OUT,
        f'residuals of held-out exposures are {value:.3f} px, where {expected:.3f} px is expected',
        Place((name,)),
        f'the calibration does not hold for exposures it has not used; {more_exposures(count)} in '
        'other poses',
        numbers={'expected_px': expected},
        value=value,
        limit=limit * expected,
        unit='px',
    )
    # If something moved during an exposure, it does not fit in sample either. Its expected noise
    # is therefore that of the other exposures.
    expected_of_one = n * np.median(noise / n) + predicted
    ratio = np.sqrt(outside / expected_of_one)
    limits = exposure_limits(ratio, np.sqrt(white / expected_of_one))
    worst = int(np.argmax(ratio / limits))
    exposures = Check(
        Kind.EXPOSURES,
        f'exposure {number[worst]} deviates most from the calibration of the others, its '
        f'residuals are {ratio[worst]:.2f} times the expected ones',
        Place((name,), (int(number[worst]),), name=f'fluoroscope {name}'),
        'inspect it (phantom or fluoroscope moved, wrong ids), exclude it by a decision in '
        'doubtful.csv and calibrate again',
        value=ratio[worst],
        limit=limits[worst],
        unit='1',
    )
    rejected = trends.of_exposure
    if rejected is not None and rejected.agreement > rejected.limit and exposures.passed:
        exposures = _rejected_exposure(name, rejected)
    return [check.after_trend(trends.is_significant) for check in (held_out, exposures)]


def _rejected_exposure(name: str, rejected: RejectedExposure) -> Check:
    """Return the check that fails because rejected image points of an exposure agree."""
    return Check(
        Kind.EXPOSURES,
        f'{rejected.points} of {rejected.of} image points of exposure {rejected.number} are '
        'rejected as false matches, but agree with their neighbours',
        Place((name,), (rejected.number,), name=f'fluoroscope {name}'),
        'the calibration does not hold in this exposure: inspect it (phantom, lens or '
        'fluoroscope moved, wrong ids), exclude it by a decision in doubtful.csv and calibrate '
        'again',
        numbers={'rejected_points': rejected.points, 'points': rejected.of},
        value=rejected.agreement,
        limit=rejected.limit,
        unit='sd of chance',
    )


def exposure_limits(ratio: NDArray[np.float64], white: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the limits (m,) of the residuals of exposures over their expectation.

    ratio (m,): of all exposures; at most half of them are at fault. white (m,): the same ratio for
    the noise of each exposure alone, by which its limit may increase. The scatter of the
    logarithms is the median absolute deviation over NORMAL_MEDIAN (Huber, "Robust Statistics",
    1981). The largest of 6 to 100 normal deviates exceeds the limit in 0.5 to 1.5 % of samples.
    """
    size = np.log(ratio)
    scatter = np.median(np.abs(size - np.median(size))) / NORMAL_MEDIAN
    factor = CERTAIN + SCATTER_OF_FEW / len(ratio)
    upper_limit = EXPOSURE_LIMIT * np.maximum(1.0, white)
    return np.clip(np.exp(factor * scatter), EXPOSURE_LIMIT, upper_limit)


HELD_OUT = Subject(check_held_out, steps=FOLDS)
