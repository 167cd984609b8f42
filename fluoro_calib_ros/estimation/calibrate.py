# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""A complete calibration or adjustment, from the frames to the results to publish and save."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from datetime import datetime, timezone
from functools import partial
from typing import Any

import numpy as np

from ..correction.base import CorrectionModel
from ..correction.fluoroscope_calibration import (
    Calibrations,
    FluoroscopeCalibration,
    NoiseProfile,
    digest_of_sources,
)
from ..exposures.collector import MIN_EXPOSURES
from ..exposures.frame import Frames, validate_frame
from ..exposures.phantom import Phantom
from ..findings import Finding
from ..photogrammetry.adjustment import Adjustment
from ..photogrammetry.noise import MIN_REDUNDANCY
from ..photogrammetry.precision import (
    Precision,
    geometric_redundancy,
    precision_with_fixed_interiors,
)
from ..photogrammetry.rig_orientation import KnownOrientation
from ..photogrammetry.rotations import quaternion_from_matrix
from ..photogrammetry.threads import one_thread
from ..rows import joined_rows
from .constraints import connected_frames, relative_orientations
from .fixed_calibration import (
    SolvedNetwork,
    fixed_corrections,
    network_of_calibrations,
    noise_of_calibrations,
    start_within_survey,
    too_few_rays_for_noise,
)
from .initial_network import (
    ROUND_TOLERANCE,
    Measured,
    StartValues,
    adjusted_with_precision,
    measured_network,
)
from .lack_of_fit import fitted_profile
from .options import CalibrationOptions, CalibrationRequest
from .result import CalibrationResult, ExposureResult, FluoroscopeResult, Targets, combined_targets
from .rounds import (
    Round,
    SelfCalibration,
    correlations_of,
    exposures_that_do_not_fit,
    outliers_of,
    residuals_of_adjustment,
    rmse_of_inliers,
    statistics_of,
)
from .self_calibration import self_calibrate

MAX_REPEATS = 3  # most repetitions of a calibration to exclude exposures that do not fit
EQUAL_WEIGHTS_NU = 100.0  # degrees of freedom above which the weights of inliers hardly differ


def calibrate(
    frames: Frames,
    phantom: Phantom,
    options: CalibrationOptions | None = None,
    joint: bool = False,
    principal_distance: float | None = None,
    progress: Callable[[str, Round], None] | None = None,
) -> CalibrationResult:
    """Self-calibrate fluoroscopes, one after the other or in one adjustment.

    For the same observations, in any order, the result is identical to the last bit.

    Parameters
    ----------
    frames : mapping of str to sequence of Frame
        Frames of each fluoroscope.
    phantom : Phantom
    options : CalibrationOptions, optional
    joint : bool
        True for one adjustment of all fluoroscopes.
    principal_distance : float, optional
        Initial value [px]; by default it is found from the observations.
    progress : callable, optional
        Called with the name of the fluoroscope and the Round after every round; may raise to stop.

    Raises
    ------
    DataError
        If the observations do not suffice.
    ValueError
        If the relative orientation is to be constrained in separate adjustments.
    """
    request = CalibrationRequest(
        frames, phantom, options or CalibrationOptions(), joint, principal_distance
    )
    return calibrate_request(request, progress)


def calibrate_request(
    request: CalibrationRequest,
    progress: Callable[[str, Round], None] | None = None,
    starts: StartValues | None = None,
) -> CalibrationResult:
    """Self-calibrate the fluoroscopes of a request; see `calibrate` for the other arguments.

    starts: initial values from an earlier calibration with these exposures.

    Raises DataError and ValueError as `calibrate`, and ValueError for options that are
    incompatible with known orientations.
    """
    _require_compatible(request)
    options = request.options
    began = time.perf_counter()
    figures: dict[str, FluoroscopeResult] = {}
    calibrations: dict[str, FluoroscopeCalibration] = {}
    runs: dict[str, SelfCalibration] = {}
    # One thread is faster than two for these sizes, and keeps the order of summation fixed.
    with one_thread():
        for group in request.groups:
            start = time.perf_counter()
            label = '+'.join(group)
            group_frames = {name: request.frames[name] for name in group}
            report = None if progress is None else partial(progress, label)
            run = _calibrated_group(request, group_frames, report, starts)
            seconds = time.perf_counter() - start
            runs[label] = run
            figures |= _figures_of_run(run)
            noise = {name: _image_noise(run, f, name) for f, name in enumerate(group)}
            calibrations |= _calibrations_of_run(run, request, seconds, noise)
        relative = [
            relative_orientations(run, options.relative_orientation) for run in runs.values()
        ]
    targets = [_targets(run.measured, run.after, run.claims) for run in runs.values()]
    return CalibrationResult(
        figures,
        calibrations,
        targets=combined_targets(
            targets,
            request.phantom,
            weighted=options.datum == 'survey',
            open_datum=not request.known_orientations,
        ),
        history={label: run.history for label, run in runs.items()},
        runs=runs,
        findings=tuple(finding for run in runs.values() for finding in run.measured.excluded),
        converged=all(run.converged for run in runs.values()),
        seconds=time.perf_counter() - began,
        relative=tuple(orientation for orientations in relative for orientation in orientations),
        outliers=_outliers_of_all(runs.values()),
        correlations=tuple(
            correlation for run in runs.values() for correlation in correlations_of(run)
        ),
        statistics=tuple(
            statistics_of(run.measured, run.after, run.precision) for run in runs.values()
        ),
        residuals=joined_rows(
            [
                residuals_of_adjustment(run.measured, run.after, run.precision, run.correction)
                for run in runs.values()
            ]
        ),
        created=_now(),
        solved={label: run.solved for label, run in runs.items()},
    )


def calibrate_part(
    request: CalibrationRequest, starts: StartValues, earlier: Calibrations
) -> dict[str, FluoroscopeCalibration]:
    """Self-calibrate with some of the exposures of an earlier calibration.

    request: has the frames of these exposures. starts, earlier: from the calibration of all
    exposures, whose image noise is used. Raises DataError if the exposures do not suffice.
    """
    out: dict[str, FluoroscopeCalibration] = {}
    with one_thread():
        for group in request.groups:
            start = time.perf_counter()
            frames = {name: request.frames[name] for name in group}
            run = _calibrated_group(request, frames, None, starts)
            seconds = time.perf_counter() - start
            noise = {
                name: _ImageNoise(earlier[name].image_sd, earlier[name].noise_profile)
                for name in group
            }
            out |= _calibrations_of_run(run, request, seconds, noise)
    return out


def _now() -> str:
    """Return the date and time (UTC, ISO 8601)."""
    return datetime.now(timezone.utc).isoformat(timespec='seconds')


def _figures_of_run(run: SelfCalibration) -> dict[str, FluoroscopeResult]:
    """Return the figures of the fluoroscopes of a self-calibration."""
    return {
        name: _figures(
            run.measured,
            run.before,
            after=run.after,
            precise=run.claims,
            f=f,
            model=run.models[name],
        )
        for f, name in enumerate(run.measured.fluoroscopes)
    }


def _calibrations_of_run(
    run: SelfCalibration,
    request: CalibrationRequest,
    seconds: float,
    noise: Mapping[str, _ImageNoise],
) -> dict[str, FluoroscopeCalibration]:
    """Return the calibrations of the fluoroscopes of a self-calibration that took `seconds`.

    noise: image noise by fluoroscope.
    """
    return {
        name: _calibration(
            run,
            f,
            name=name,
            digest=digest_of_sources(request.frames[name], request.phantom),
            seconds=seconds,
            noise=noise[name],
        )
        for f, name in enumerate(run.measured.fluoroscopes)
    }


def _calibrated_group(
    request: CalibrationRequest,
    frames: Frames,
    progress: Callable[[Round], None] | None,
    starts: StartValues | None,
) -> SelfCalibration:
    """Calibrate fluoroscopes in one adjustment, and exclude exposures that do not fit."""
    excluded: tuple[Finding, ...] = ()
    if request.options.datum == 'inner':
        frames, excluded = connected_frames(frames)
    for repeat in range(MAX_REPEATS):
        measured = measured_network(
            frames,
            request.phantom,
            principal_distance=request.principal_distance,
            known=request.known_orientations,
            starts=starts,
        )
        earlier = None if starts is None else starts.earlier
        run = self_calibrate(measured, request.options, progress, earlier)
        misfits = exposures_that_do_not_fit(run)
        fitting = {
            name: [f for f in exposures if (name, f.number) not in misfits]
            for name, exposures in frames.items()
        }
        too_few = any(len(exposures) < MIN_EXPOSURES for exposures in fitting.values())
        if not misfits or too_few or repeat == MAX_REPEATS - 1:
            break
        excluded += tuple(misfits.values())
        frames = fitting
    return replace(
        run, measured=replace(run.measured, excluded=(*excluded, *run.measured.excluded))
    )


def _require_compatible(request: CalibrationRequest) -> None:
    """Raise ValueError for incompatible options."""
    options = request.options
    if options.relative_orientation != 'none' and not request.joint:
        raise ValueError('a relative orientation constraint needs the joint adjustment')
    if request.known_orientations and (
        options.relative_orientation != 'none' or options.datum != 'survey'
    ):
        raise ValueError(
            'known orientations exclude a relative orientation constraint and a free network'
        )


def _outliers_of_all(runs: Iterable[SelfCalibration]) -> tuple[tuple[Any, ...], tuple[Any, ...]]:
    """Return the outliers of all runs: image points, and targets."""
    outliers = [outliers_of(run) for run in runs]
    return (
        tuple(point for points, _ in outliers for point in points),
        tuple(target for _, targets in outliers for target in targets),
    )


def adjust_with_calibrations(
    frames: Frames,
    phantom: Phantom,
    calibrations: Calibrations,
    loss: str = 'student_t',
    known: Mapping[str, KnownOrientation] | None = None,
    starts: StartValues | None = None,
) -> CalibrationResult:
    """Adjust frames with interior orientations and corrections fixed at their calibrations.

    Covariances include the uncertainty of both. That of the interior orientation is common to all
    exposures; that of the correction is part of the noise of every image point.

    frames: by fluoroscope; all share the object points. loss: noise model of the image points.
    known: orientations known beforehand, by fluoroscope. starts: initial values from an earlier
    adjustment of the frames, if only residuals are needed: residuals without correction are then
    not computed (their RMSE is NaN), and covariances exclude the uncertainty of the interiors.

    Raises DataError if a frame is invalid or has another image size than its calibration.
    """
    began = time.perf_counter()
    for name, exposures in frames.items():
        for frame in exposures:
            validate_frame(frame, phantom, calibrations[name].image_size)
    with one_thread():
        measured = network_of_calibrations(
            frames, phantom, calibrations=calibrations, known=known, starts=starts
        )
        correction, network = fixed_corrections(measured, calibrations)
        noise = noise_of_calibrations(loss, calibrations.values())
        after, precise = adjusted_with_precision(
            network,
            start_within_survey(network, measured.start, correction, noise),
            correction,
            noise,
            noise_fixed=too_few_rays_for_noise(network),
        )
        before = None
        solved = replace(measured, network=network)
        fixed = np.stack([calibrations[name].interior_covariance for name in frames])
        if starts is None:
            precise = precision_with_fixed_interiors(network, after, correction, precise, fixed)
            before, _ = adjusted_with_precision(
                network,
                after.parameters,
                0.0,
                after.noise,
                tolerance=ROUND_TOLERANCE,  # only the residuals of this adjustment are reported
            )
    figures = {
        name: _figures(
            measured, before, after=after, precise=precise, f=f, model=calibrations[name].model
        )
        for f, name in enumerate(frames)
    }
    return CalibrationResult(
        figures,
        dict(calibrations),
        targets=_targets(measured, after, precise),
        history={},
        runs={},
        findings=measured.excluded,
        converged=after.converged,
        seconds=time.perf_counter() - began,
        statistics=(statistics_of(solved, after, precise),),
        residuals=residuals_of_adjustment(measured, after, precise, correction),
        created=_now(),
        solved={'+'.join(frames): SolvedNetwork(solved, after, correction, fixed)},
    )


def _targets(measured: Measured, adjustment: Adjustment, precise: Precision) -> Targets:
    return Targets(
        measured.target_id, adjustment.parameters.points_mm, precise.points, precise.joint_points
    )


def _figures(
    measured: Measured,
    before: Adjustment | None,
    after: Adjustment,
    precise: Precision,
    f: int,
    model: CorrectionModel,
) -> FluoroscopeResult:
    """Return the figures of fluoroscope number f; before: adjustment without correction."""
    rows = measured.network.rows(f)
    exposures = []
    for j in np.flatnonzero(measured.network.fluoroscope == f):
        sd = np.sqrt(np.diagonal(precise.exterior[j]))
        exposures.append(
            ExposureResult(
                measured.frames[j].number,
                after.parameters.position_mm[j],
                quaternion_from_matrix(after.parameters.rotation[j]),
                sd[:3],
                sd[3:],
            )
        )
    return FluoroscopeResult(
        after.parameters.interior[f],
        np.sqrt(np.diagonal(precise.interior[f])),
        image_size=measured.image_size[f],
        model_kind=model.kind,
        k=model.k,
        rmse_before=np.full(2, np.nan) if before is None else rmse_of_inliers(before, rows),
        rmse_after=rmse_of_inliers(after, rows),
        observations=len(rows),
        inliers=int(after.inliers[rows].sum()),
        exposures=tuple(exposures),
    )


@dataclass(frozen=True)
class _ImageNoise:
    """Standard deviation of an image coordinate [px], and its factors over the image."""

    sd: float
    profile: NoiseProfile | None


def _image_noise(run: SelfCalibration, f: int, name: str) -> _ImageNoise:
    """Return the noise of an image coordinate of fluoroscope number f.

    Its variance is that of the inlier residuals, which are smaller than the noise by the root of
    their redundancy numbers, plus that of the distortion of an exposure about the model. The scale
    of a Student-t noise cannot replace it: where the tails are heavy, that scale is smaller than
    the standard deviation of its core. Residuals that show less than half of the noise would lead
    to a smaller value if the survey is better than its standard deviations; it is not used then.
    """
    noise_model = run.after.noise
    if noise_model.loss != 'huber' and noise_model.nu >= EQUAL_WEIGHTS_NU:
        redundancy = run.precision.redundancy.mean(axis=1)
    else:
        redundancy = geometric_redundancy(run.measured.network, run.after.parameters, noise_model)
    rows = run.measured.network.rows(f)
    rows = rows[run.after.inliers[rows]]
    square = np.sum(run.after.residuals[rows] ** 2, axis=1) / 2
    between = run.between_exposures.get(name, np.zeros(len(rows)))
    variance = np.sum(square) / np.sum(redundancy[rows])
    if np.mean(redundancy[rows]) < 0.5:
        scale = noise_model.scale * float(np.median(run.measured.network.sigma[rows]))
        variance = max(variance, scale**2)
    variance += np.mean(between)
    squares = square / np.maximum(redundancy[rows], MIN_REDUNDANCY) + between
    profile = fitted_profile(run.measured.network.uv[rows], squares, run.measured.image_size[f])
    return _ImageNoise(float(np.sqrt(variance)), profile)


def _calibration(
    run: SelfCalibration,
    f: int,
    name: str,
    digest: str,
    seconds: float,
    noise: _ImageNoise,
) -> FluoroscopeCalibration:
    """Return the calibration of fluoroscope number f of a self-calibration."""
    rows = run.measured.network.rows(f)
    last = run.history[-1]
    frames = [frame for frame in run.measured.frames if frame.fluoroscope == name]
    numbers = np.array([frame.number for frame in run.measured.frames])
    model = run.models[name]
    if model.keeps_training_points:
        train_exposure = numbers[run.measured.network.exposure[rows[run.trained[rows]]]]
    else:
        train_exposure = np.zeros(len(model.train_uv), dtype=numbers.dtype)
    return FluoroscopeCalibration(
        fluoroscope=name,
        image_size=run.measured.image_size[f],
        interior=run.after.parameters.interior[f],
        interior_covariance=run.claims.interior[f],
        interior_estimated=bool(run.measured.network.interior_free[f]),
        model=model,
        train_exposure=train_exposure,
        image_sd=noise.sd,
        sigma0=run.after.noise.scale,
        nu=run.after.noise.nu,
        exposures=len(frames),
        observations=len(rows),
        inliers=int(run.after.inliers[rows].sum()),
        rmse_before=rmse_of_inliers(run.before, rows),
        rmse_after=rmse_of_inliers(run.after, rows),
        cost_adjustment=last.F,
        cost_regression=last.G,
        iterations=last.iteration,
        converged=run.converged,
        stamp_ns=max(frame.stamp_ns for frame in frames),
        frame_id=frames[0].frame_id,
        source_digest=digest,
        angle_field=run.angle_fields.get(name),
        noise_profile=noise.profile,
        seconds=seconds,
    )
