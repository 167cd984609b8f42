"""A whole calibration or adjustment: from frames to what is published and saved."""

import time
from dataclasses import dataclass, replace

import numpy as np
from threadpoolctl import threadpool_limits

from ..exposures.frame import validate_frame
from ..photogrammetry.precision import geometric_redundancy
from ..photogrammetry.rotations import quaternion_from_matrix
from .constraints import relative_orientations
from .diagnostics import correlations_of, outliers_of
from .initial_network import measured_network
from .options import CalibrationOptions
from .result import FluoroscopeCalibration, digest_of_sources
from .robust_adjustment import adjusted_with_precision, start_noise
from .rounds import rmse_of_inliers
from .self_calibration import self_calibrate

# mean number of image points of a target from which an adjustment estimates the noise itself
SEEN_FOR_NOISE = 3


@dataclass(frozen=True)
class ExposureResult:
    """Exterior orientation of an exposure: position_mm (3,), quaternion_wxyz (4,), their sd_mm
    (3,) and sd_rad (3,) about the axes of the sensor.
    """

    exposure: int
    position_mm: np.ndarray
    quaternion_wxyz: np.ndarray
    sd_mm: np.ndarray
    sd_rad: np.ndarray


@dataclass(frozen=True)
class FluoroscopeResult:
    """Figures of one fluoroscope: interior (3,) and interior_sd (3,) [px], rmse before and after
    (2,) [px].
    """

    interior: np.ndarray
    interior_sd: np.ndarray
    image_size: tuple
    model_kind: str
    k: int
    rmse_before: np.ndarray
    rmse_after: np.ndarray
    observations: int
    inliers: int
    exposures: tuple


@dataclass(frozen=True)
class Targets:
    """Object points: target_id (n,), xyz_mm (n, 3), covariance (n, 3, 3) [mm^2]."""

    target_id: np.ndarray
    xyz_mm: np.ndarray
    covariance: np.ndarray


@dataclass(frozen=True)
class CalibrationResult:
    """Result of a job: figures and calibrations by fluoroscope, targets, and for the report the
    runs behind it.

    history: Rounds by fluoroscope, or by '+'.join(fluoroscopes) where they were adjusted together;
    runs: SelfCalibration by the same names; left_out: a sentence for every exposure that was not
    used; relative: a RelativeOrientation of every further fluoroscope with the first where they
    were adjusted together; outliers: dicts of image points and of targets that fail their tests;
    correlations above 0.95: (name, name, value).
    """

    fluoroscopes: dict
    calibrations: dict
    targets: Targets
    history: dict
    runs: dict
    left_out: tuple
    converged: bool
    seconds: float
    relative: tuple = ()
    outliers: tuple = ((), ())
    correlations: tuple = ()


def calibrate(
    frames,
    phantom,
    options=CalibrationOptions(),
    joint=False,
    principal_distance=None,
    progress=None,
    raise_if_cancelled=None,
):
    """Self-calibrate fluoroscopes, one after the other or in one adjustment (joint).

    frames {fluoroscope: [Frame, ...]}; progress(fluoroscope, Round) after every round;
    raise_if_cancelled() may raise to stop. Returns CalibrationResult, the same to the last bit for the
    same observations, whatever their order. Raises DataError for observations that do not suffice,
    ValueError for a relative orientation that is to be constrained while the fluoroscopes are not
    adjusted together.
    """
    if options.relative_orientation != 'none' and not joint:
        raise ValueError('a relative orientation constraint needs the joint adjustment')
    began = time.perf_counter()
    groups = [tuple(frames)] if joint else [(name,) for name in frames]
    figures = {}
    calibrations = {}
    runs = {}
    targets = []
    left_out = []
    relative = ()
    # One thread: faster than two for these sizes, and the sums are always made in the same order.
    with threadpool_limits(1):
        for group in groups:
            start = time.perf_counter()
            label = '+'.join(group)
            measured = measured_network(
                {name: frames[name] for name in group},
                phantom,
                principal_distance,
                raise_if_cancelled=raise_if_cancelled,
            )
            run = self_calibrate(
                measured,
                options,
                raise_if_cancelled=raise_if_cancelled,
                progress=progress and (lambda r, label=label: progress(label, r)),
            )
            runs[label] = run
            seconds = time.perf_counter() - start
            targets.append(_targets(run.measured, run.after, run.precision))
            left_out += run.measured.left_out
            relative += relative_orientations(run, options.relative_orientation)
            for f, name in enumerate(group):
                figures[name] = _figures(
                    run.measured, run.before, run.after, run.precision, f, run.models[name]
                )
                calibrations[name] = _calibration(
                    run, f, name, options, digest_of_sources(frames[name], phantom), seconds
                )
    return CalibrationResult(
        figures,
        calibrations,
        combined_targets(targets, phantom, options.datum == 'survey'),
        {label: run.history for label, run in runs.items()},
        runs,
        tuple(left_out),
        all(run.converged for run in runs.values()),
        time.perf_counter() - began,
        relative,
        *_judged(runs.values()),
    )


def _judged(runs):
    """Outliers (image points, targets) of all runs, and their correlations."""
    found = [outliers_of(run) for run in runs]
    return (
        tuple(sum((part[i] for part in found), []) for i in (0, 1)),
        tuple(c for run in runs for c in correlations_of(run)),
    )


def adjust_with_calibrations(
    frames, phantom, calibrations, loss='student_t', raise_if_cancelled=None
):
    """Adjust frames with calibrations held: interior orientations and corrections are not changed.

    frames {fluoroscope: [Frame, ...]}, calibrations {fluoroscope: FluoroscopeCalibration}. All
    fluoroscopes share the object points. Returns CalibrationResult. Raises DataError for wrong frames,
    also those of another image size than the calibration's.
    """
    began = time.perf_counter()
    for name, of_fluoroscope in frames.items():
        for frame in of_fluoroscope:
            validate_frame(frame, phantom, calibrations[name].image_size)
    interior = {name: calibrations[name].interior for name in frames}
    with threadpool_limits(1):
        measured = measured_network(
            frames,
            phantom,
            interior=interior,
            interior_free=False,
            min_exposures=1,
            corrections={n: calibrations[n].model.predict for n in frames},
            raise_if_cancelled=raise_if_cancelled,
        )
        correction, network = held_corrections(measured, calibrations)
        # Few exposures do not tell noise from errors of the survey; then it is that of the
        # calibration.
        held = len(network.uv) < SEEN_FOR_NOISE * len(network.survey_mm)
        noise = replace(
            start_noise(loss),
            scale=float(np.median([c.sigma0 for c in calibrations.values()])),
            nu=float(np.median([c.nu for c in calibrations.values()])),
        )
        after, precise = adjusted_with_precision(
            network,
            measured.start,
            correction,
            noise,
            raise_if_cancelled=raise_if_cancelled,
            noise_held=held,
        )
        before, _ = adjusted_with_precision(
            network,
            after.parameters,
            np.zeros_like(correction),
            after.noise,
            tolerance=1e-4,
            raise_if_cancelled=raise_if_cancelled,
        )
    figures = {
        name: _figures(measured, before, after, precise, f, calibrations[name].model)
        for f, name in enumerate(frames)
    }
    return CalibrationResult(
        figures,
        dict(calibrations),
        _targets(measured, after, precise),
        {},
        {},
        measured.left_out,
        after.converged,
        time.perf_counter() - began,
    )


def held_corrections(measured, calibrations):
    """Corrections (N, 2) [px] by calibrations, and the network with their uncertainty in its
    sigma.

    Where a correction is uncertain, at the rim and beyond the calibrated area, an image point
    weighs less.
    """
    network = measured.network
    correction = np.zeros_like(network.uv)
    sigma = network.sigma.copy()
    for f, name in enumerate(measured.fluoroscopes):
        rows = network.rows(f)
        found = calibrations[name].model.evaluate(network.uv[rows])
        correction[rows] = found.duv
        sigma[rows] = np.hypot(sigma[rows], found.sd / calibrations[name].sigma0)
    return correction, replace(network, sigma=sigma)


def _targets(measured, adjustment, precise):
    return Targets(measured.target_id, adjustment.parameters.points_mm, precise.points)


def combined_targets(parts, phantom, weighted=True):
    """One set of object points from separate adjustments of the same phantom (Targets, ...).

    Each holds the survey once; in the sum of their information it is to count once only, so that
    of the survey is taken off for every further one; weighted False: none holds the survey.
    """
    if len(parts) == 1:
        return parts[0]
    target_id = np.unique(np.concatenate([p.target_id for p in parts]))
    row = phantom.index(target_id)
    survey = np.eye(3) / phantom.sd_mm[row, None, None] ** 2
    information = np.zeros((len(row), 3, 3))
    right = np.zeros((len(row), 3))
    seen = np.zeros(len(row))
    for part in parts:
        at = np.searchsorted(target_id, part.target_id)
        own = np.linalg.inv(part.covariance)
        information[at] += own
        right[at] += (own @ part.xyz_mm[..., None])[..., 0]
        seen[at] += 1
    further = (seen - 1) * weighted
    information -= further[:, None, None] * survey
    right -= further[:, None] * (survey @ phantom.xyz_mm[row, :, None])[..., 0]
    covariance = np.linalg.inv(information)
    return Targets(target_id, (covariance @ right[..., None])[..., 0], covariance)


def _rows_of(measured, f):
    return np.flatnonzero(measured.network.fluoroscope[measured.network.exposure] == f)


def _figures(measured, before, after, precise, f, model):
    """FluoroscopeResult of fluoroscope number f of an adjustment."""
    rows = _rows_of(measured, f)
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
        measured.image_size[f],
        model.kind,
        model.k,
        rmse_of_inliers(before, rows),
        rmse_of_inliers(after, rows),
        len(rows),
        int(after.inliers[rows].sum()),
        tuple(exposures),
    )


def _image_sd(run, rows):
    """Standard deviation [px] of an image coordinate, from the inlier residuals of the image
    points rows.

    A residual is smaller than the noise by the root of its redundancy number. The scale of a
    Student-t will not do: where the tails are heavy it is smaller than the standard deviation of
    what is in its core.
    """
    redundancy = geometric_redundancy(run.measured.network, run.after.parameters, run.after.noise)
    rows = rows[run.after.inliers[rows]]
    return float(np.sqrt(np.sum(run.after.residuals[rows] ** 2) / np.sum(2 * redundancy[rows])))


def _calibration(run, f, name, options, digest, seconds):
    """FluoroscopeCalibration of fluoroscope number f of a self-calibration."""
    rows = _rows_of(run.measured, f)
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
        interior_covariance=run.precision.interior[f],
        interior_estimated=options.interior == 'estimated',
        model=model,
        train_exposure=train_exposure,
        image_sd=_image_sd(run, rows),
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
        seconds=seconds,
    )
