# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The rounds of a self-calibration, its result, and the diagnostics of its adjustments."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..correction.angle_field import AngleField
from ..correction.base import CorrectionModel
from ..errors import DataError
from ..findings import Finding, Kind, Severity
from ..photogrammetry.adjustment import Adjustment
from ..photogrammetry.diagnosis import (
    describe_directions,
    high_correlations,
    undetermined_directions,
    undetermined_interiors,
)
from ..photogrammetry.outliers import find_outliers
from ..photogrammetry.precision import Precision
from ..photogrammetry.unknowns import discrepancies
from .fixed_calibration import SolvedNetwork
from .initial_network import Measured

SETTLED_PX = 2e-3  # RMS change of the correction below which a round is the last


@dataclass(frozen=True)
class Round:
    """One round of a self-calibration."""

    iteration: int  #: number of the round, from 1
    F: float  #: negative log-likelihood of the adjustment
    #: weighted square sum of the cross-validation, or of the inlier residuals if the model is
    #: estimated in the adjustment
    G: float
    k: Mapping[str, int]  #: number of neighbours by fluoroscope; 0 for a model without neighbours
    #: (2,) RMSE of the inlier residuals in u and v [px], by fluoroscope
    rmse: Mapping[str, NDArray[np.float64]]
    quadratic: float  #: robustly weighted square sum of the residuals [px^2]
    change: float  #: RMS change of the correction that the next round would make [px]

    def __str__(self) -> str:
        k = max(self.k.values())
        neighbours = f'k {k:3d}  ' if k else ''
        rmse = '  '.join(f'{n}: {u:.3f} {v:.3f} px' for n, (u, v) in self.rmse.items())
        return f'round {self.iteration:2d}  {neighbours}RMSE {rmse}'


@dataclass(frozen=True)
class SelfCalibration:
    """Result of a self-calibration."""

    measured: Measured  #: the network, with the additional parameters of the model
    #: adjustments without correction and with the final correction
    before: Adjustment
    after: Adjustment
    precision: Precision  #: precision of the adjustment `after`
    #: (N, 2) correction of the image points [px], additional parameters included
    correction: NDArray[np.float64]
    trained: NDArray[np.bool_]  #: (N,) image points to which the models were fitted
    models: Mapping[str, CorrectionModel]  #: by fluoroscope
    history: tuple[Round, ...]
    converged: bool  #: False if the largest number of rounds was reached
    #: precision with the errors of the models (see `model_choice`); None: it is `precision`
    stated: Precision | None = None
    #: (i,) variances [px^2] by which the distortion of a fluoroscope differs between exposures at
    #: its inliers, without what orientations absorb
    between_exposures: Mapping[str, NDArray[np.float64]] = field(default_factory=dict)
    #: by fluoroscope, where the distortion changes with the angle of the C-arm
    angle_fields: Mapping[str, AngleField] = field(default_factory=dict)

    @property
    def claims(self) -> Precision:
        """Stated precision of the unknowns, including errors of the models."""
        return self.stated or self.precision

    @property
    def solved(self) -> SolvedNetwork:
        """The network and its adjustment."""
        estimated = self.measured.network.additional_correction(self.after.parameters)
        correction = self.correction - estimated
        return SolvedNetwork(self.measured, self.after, correction, stated=self.stated)


class History:
    """The rounds of a running self-calibration.

    progress: called with the Round after every round.
    """

    def __init__(self, measured: Measured, progress: Callable[[Round], None] | None) -> None:
        self._measured = measured
        self._progress = progress
        self.rounds: list[Round] = []

    def add(
        self, adjustment: Adjustment, g_cost: float, k: Mapping[str, int], change: float
    ) -> None:
        """Record a round, and report it; see `Round` for the arguments."""
        weighted = adjustment.noise.weight(adjustment.q)[:, None] * adjustment.residuals**2
        rmse = {
            name: rmse_of_inliers(adjustment, self._measured.network.rows(f))
            for f, name in enumerate(self._measured.fluoroscopes)
        }
        self.rounds.append(
            Round(
                len(self.rounds) + 1,
                adjustment.cost,
                G=float(g_cost),
                k=k,
                rmse=rmse,
                quadratic=float(weighted.sum()),
                change=change,
            )
        )
        if self._progress is not None:
            self._progress(self.rounds[-1])


def has_settled(rounds: Sequence[Round], tolerance: float) -> bool:
    """Whether F, G and the correction have stopped changing."""
    if len(rounds) < 2:
        return False
    last = rounds[-2]
    current = rounds[-1]
    # F is a log-likelihood and may pass through zero, so its change is also compared with G, which
    # is about the number of image points.
    d_f = abs(current.F - last.F) / max(abs(current.F), current.G)
    d_g = abs(current.G - last.G) / max(current.G, 1e-300)
    return d_f <= tolerance and d_g <= tolerance and current.change <= SETTLED_PX


def rmse_of_inliers(adjustment: Adjustment, rows: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return the unweighted RMSE (2,) [px] in u and v of the inliers among some image points."""
    r = adjustment.residuals[rows][adjustment.inliers[rows]]
    return np.sqrt(np.mean(r * r, axis=0)) if len(r) else np.full(2, np.nan)


# Statistics and residuals of adjustments, for reports.


@dataclass(frozen=True)
class AdjustmentStatistics:
    """Statistics of one adjustment and of its network."""

    fluoroscopes: tuple[str, ...]
    loss: str  #: noise model of the image points
    #: scale of the noise: standard deviation of an image coordinate of weight one [px], or its
    #: ratio to sigma if sigma is given
    sigma0: float
    nu: float  #: degrees of freedom of the Student-t; infinite for other noise models
    #: weighted square sum of all residuals over the degrees of freedom; expected value 1
    variance_factor: float
    #: numbers of scalar observations without priors, and of unknowns
    observations: int
    unknowns: int
    #: sum of the redundancy numbers; with priors, such as of a signal, it exceeds observations -
    #: unknowns
    degrees_of_freedom: float
    image_points: int
    outliers: int
    exposures: int
    targets: int
    #: redundancy numbers of image coordinates of weight one half or more
    least_redundancy: float
    mean_redundancy: float
    #: image points of a target
    least_rays: float
    mean_rays: float


@dataclass(frozen=True)
class ResidualTable:
    """Residuals of all image points of adjustments."""

    fluoroscope: NDArray[np.str_]  #: (N,)
    #: (N,) numbers of exposure and target
    exposure: NDArray[np.int64]
    target_id: NDArray[np.int64]
    uv: NDArray[np.float64]  #: (N, 2) observed pixels
    correction: NDArray[np.float64]  #: (N, 2) correction [px]
    residual: NDArray[np.float64]  #: (N, 2) observed - correction - projected [px]
    #: (N, 2) redundancy numbers: part of an error that the residual shows
    redundancy: NDArray[np.float64]
    weight: NDArray[np.float64]  #: (N,) robust weights, 0 to about 1
    #: (N,) outside the core of the noise: four standard deviations, more if the tails are heavy or
    #: the image points of the exposure scatter more than those of other exposures
    outlier: NDArray[np.bool_]


def statistics_of(
    measured: Measured, adjustment: Adjustment, precise: Precision
) -> AdjustmentStatistics:
    """Return the statistics of an adjustment."""
    network = measured.network
    noise = adjustment.noise
    weight = noise.weight(adjustment.q)
    square = float(np.sum(weight * adjustment.q)) + _square_of_others(measured, adjustment)
    redundancy = float(
        precise.redundancy.sum()
        + precise.survey_redundancy.sum()
        + sum(part.sum() for part in precise.relative_redundancy)
    )
    well_weighted = precise.redundancy[weight >= 0.5]
    rays = np.bincount(network.point, minlength=network.n_points)
    return AdjustmentStatistics(
        fluoroscopes=tuple(measured.fluoroscopes),
        loss=noise.loss,
        sigma0=float(noise.scale),
        nu=float(noise.nu),
        variance_factor=square / redundancy if redundancy > 0 else float('nan'),
        observations=network.n_observations,
        unknowns=network.n_unknowns,
        degrees_of_freedom=redundancy,
        image_points=network.n_image_points,
        outliers=int((~adjustment.inliers).sum()),
        exposures=network.n_exposures,
        targets=network.n_points,
        least_redundancy=float(well_weighted.min()) if len(well_weighted) else float('nan'),
        mean_redundancy=float(well_weighted.mean()) if len(well_weighted) else float('nan'),
        least_rays=float(rays.min()),
        mean_rays=float(rays.mean()),
    )


def _square_of_others(measured: Measured, adjustment: Adjustment) -> float:
    """Return the weighted square sum of residuals of survey and relative orientations."""
    network = measured.network
    parameters = adjustment.parameters
    out = 0.0
    if network.datum == 'survey':
        difference = (parameters.points_mm - network.survey_mm) / network.survey_sd_mm[:, None]
        out += float(np.sum(difference**2))
    for constraint, pose in zip(network.relative, parameters.relative):
        out += float(np.sum(discrepancies(constraint, pose, parameters) ** 2 @ constraint.weights))
    return out


def residuals_of_adjustment(
    measured: Measured, adjustment: Adjustment, precise: Precision, correction: NDArray[np.float64]
) -> ResidualTable:
    """Return the residuals of an adjustment; correction: (N, 2) [px], including all its parts."""
    network = measured.network
    frames = measured.frames
    name = np.array([frame.fluoroscope for frame in frames])
    number = np.array([frame.number for frame in frames], dtype=np.int64)
    return ResidualTable(
        fluoroscope=name[network.exposure],
        exposure=number[network.exposure],
        target_id=measured.target_id[network.point],
        uv=network.uv,
        correction=correction,
        residual=adjustment.residuals,
        redundancy=precise.redundancy,
        weight=adjustment.noise.weight(adjustment.q),
        outlier=~adjustment.inliers,
    )


MIN_FITTING = 0.5  # least share of fitting image points, of an exposure or of a fluoroscope


def undetermined_unknowns(measured: Measured) -> Finding | None:
    """Return a finding on unknowns that are undetermined at the initial values, or None."""
    directions = undetermined_directions(
        measured.network, measured.start, measured.fluoroscopes, _exposure_numbers(measured)
    )
    if not directions:
        return None
    return Finding(
        Kind.UNDETERMINED,
        f'the exposures do not determine the unknowns: {describe_directions(directions)}; '
        'add exposures with the phantom turned and moved, with more targets',
        numbers={'directions': len(directions)},
    )


def raise_if_undetermined(measured: Measured, adjustment: Adjustment, precise: Precision) -> None:
    """Raise DataError for undetermined interior orientations, with a finding for each."""
    scale = adjustment.noise.scale
    findings = undetermined_interiors(
        measured.network, adjustment.parameters, precise, measured.fluoroscopes, scale
    )
    if findings:
        raise DataError(*findings)


def correlations_of(run: SelfCalibration) -> tuple[tuple[str, str, float], ...]:
    """Return high correlations between unknowns: ((name, name, value), ...)."""
    return high_correlations(
        run.measured.network,
        run.after.parameters,
        run.precision,
        run.measured.fluoroscopes,
        _exposure_numbers(run.measured),
    )


def outliers_of(run: SelfCalibration) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Return outliers of a self-calibration: image points and targets, with test statistics."""
    measured = run.measured
    detected = find_outliers(measured.network, run.after, run.precision)
    exposures = measured.network.exposure[detected.image_point]
    points = [
        {
            'fluoroscope': measured.frames[j].fluoroscope,
            'exposure': measured.frames[j].number,
            'target_id': int(measured.target_id[measured.network.point[row]]),
            'value': float(value),
            'critical': detected.critical_image,
        }
        for row, j, value in zip(detected.image_point, exposures, detected.value)
    ]
    targets = [
        {
            'target_id': int(measured.target_id[row]),
            'offset_mm': offset,
            'value': float(value),
            'critical': detected.critical_target,
        }
        for row, offset, value in zip(detected.target, detected.offset_mm, detected.target_value)
    ]
    return points, targets


def exposures_that_do_not_fit(run: SelfCalibration) -> dict[tuple[str, int], Finding]:
    """Return a finding for every exposure of which less than half fits, by name and number.

    If most exposures of a fluoroscope are like this, none of them stands out, and the calibration
    as a whole has to be judged.
    """
    network = run.measured.network
    count = np.bincount(network.exposure, minlength=network.n_exposures)
    # Use the core of the noise: false matches of such an exposure make the tails heavy, and thus
    # the limit of gross errors wide.
    fits = run.after.noise.inliers(run.after.q)
    fitting = np.bincount(network.exposure, fits, network.n_exposures)
    share = fitting / count
    out = {}
    for row, frame in enumerate(run.measured.frames):
        same_fluoroscope = network.fluoroscope == network.fluoroscope[row]
        if share[row] < MIN_FITTING and np.median(share[same_fluoroscope]) >= MIN_FITTING:
            out[frame.fluoroscope, frame.number] = Finding(
                Kind.FALSE_MATCHES,
                f'only {100 * share[row]:.0f} % of the image points fit, the others are false '
                'matches',
                frame.place,
                severity=Severity.NOTE,
                numbers={'share': float(share[row])},
            )
    return out


def _exposure_numbers(measured: Measured) -> list[int]:
    return [frame.number for frame in measured.frames]
