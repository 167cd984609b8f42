# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Cases of the validation experiment: calibrate with some exposures of a rig, test with others.

The reference is the ground truth of the virtual rig: bead coordinates, source positions and
distortion field. A Case describes the task and an Outcome contains the resulting numbers, so that
cases can run in other processes.
"""

from __future__ import annotations

import functools
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np
from scipy.spatial import ConvexHull
from threadpoolctl import threadpool_limits

from fluoro_calib_ros.correction.base import CorrectionModel
from fluoro_calib_ros.correction.fluoroscope_calibration import FluoroscopeCalibration
from fluoro_calib_ros.correction.registry import selectable_models
from fluoro_calib_ros.errors import DataError
from fluoro_calib_ros.estimation.calibrate import calibrate
from fluoro_calib_ros.estimation.fixed_calibration import fixed_corrections, too_few_rays_for_noise
from fluoro_calib_ros.estimation.initial_network import (
    KnownSensor,
    Measured,
    measured_network,
    start_noise,
)
from fluoro_calib_ros.estimation.options import AUTO, CalibrationOptions
from fluoro_calib_ros.estimation.result import CalibrationResult
from fluoro_calib_ros.exposures.frame import Frame, points_on_image
from fluoro_calib_ros.photogrammetry.adjustment import adjust
from fluoro_calib_ros.photogrammetry.noise import Noise
from fluoro_calib_ros.photogrammetry.outliers import adjust_and_estimate_noise
from fluoro_calib_ros.photogrammetry.precision import geometric_redundancy
from fluoro_calib_ros.photogrammetry.rotations import matrix_from_vector
from fluoro_calib_ros.photogrammetry.unknowns import Parameters
from fluoro_calib_ros.report.report_figures import relative_costs
from fluoro_calib_ros.simulation.rig import (
    Detection,
    DistortionField,
    SimulatedExposures,
    simulate_exposures,
    virtual_rig,
)

NOISE_PX = 0.25
BEFORE = 'before'
HELD = 'knn, interior fixed'
KNOWN = 'known distortion'
# In the order of the tables; models that CalibrationOptions refuses are excluded.
MODELS = tuple(name for name in (*selectable_models(), AUTO) if name != 'none')
RELATIVE = ('none', 'soft', 'hard')
TEST_TOLERANCE = 1e-4  # decrease of F at which a test adjustment stops: a hundredth of a sigma
GRID_PX = 16  # spacing of the pixels at which the correction is compared with the truth


@dataclass(frozen=True)
class Case:
    """A calibration of the experiment.

    seed of the rig; variant: BEFORE, HELD, KNOWN or a model (interior orientation estimated);
    exposures: number in the recording; every: step between the exposures for the calibration (10:
    every tenth), the others are for the test; training: number of separate exposures for the
    calibration, None: those of the recording; joint: adjust all fluoroscopes together; relative:
    relative orientation constraint; survey: factor on the stated standard deviation of the survey;
    rounds: maximum number; detail: whether to return residuals too.
    """

    seed: int
    variant: str
    fluoroscopes: tuple[str, ...] = ('a',)
    training: int | None = None
    strength: float = 1.0
    false_matches: float = 0.01
    joint: bool = False
    relative: str = 'none'
    exposures: int = 150
    every: int = 10
    survey: float = 1.0
    rounds: int = 60
    detail: bool = field(default=False, compare=False)

    @property
    def scene(self) -> tuple[int, float, float, int, int, float]:
        """Key of the rig and its recording."""
        return (
            self.seed,
            self.strength,
            self.false_matches,
            self.exposures,
            self.every,
            self.survey,
        )


@dataclass(frozen=True)
class Residuals:
    """In-sample residuals of one fluoroscope.

    uv (n, 2) observed pixels, residual (n, 2) [px], sd (n,) its standard deviation from the
    simulated noise [px], weight (n,) robust weight, inlier (n,).
    """

    uv: np.ndarray
    residual: np.ndarray
    sd: np.ndarray
    weight: np.ndarray
    inlier: np.ndarray

    def cost(self) -> float:
        """Return r^T C_r^-1 r, robustly weighted, in units of the simulated noise."""
        return float(np.sum(self.weight[:, None] * (self.residual / self.sd[:, None]) ** 2))

    def raw(self) -> np.ndarray:
        """Return the RMSE (2,) [px] of the inlier residuals."""
        return np.sqrt(np.mean(self.residual[self.inlier] ** 2, axis=0))

    def reweighted(self) -> np.ndarray:
        """Return the RMSE (2,) [px] of all residuals times the square root of their weights."""
        return np.sqrt(np.mean(self.weight[:, None] * self.residual**2, axis=0))

    def together(self, other: Residuals) -> Residuals:
        """Return the residuals of two fluoroscopes as one set."""
        return Residuals(
            *(
                np.concatenate([getattr(r, f.name) for r in (self, other)])
                for f in fields(Residuals)
            )
        )


@dataclass(frozen=True)
class Outcome:
    """Result of a case; failed: the reason if there are no numbers.

    inside and outside (6,): RMSE [mm] in and out of sample of object points X, Y, Z and sources
    Xo, Yo, Zo; error_map (rows, columns, 2) [px] by fluoroscope: error of the correction over the
    image, see error_over_image; model: kind and k by fluoroscope; seconds of the calibration;
    rounds of its loop; residuals by fluoroscope and costs: F and G in percent of the first, for
    detailed cases.
    """

    failed: str = ''
    inside: np.ndarray = None  # type: ignore[assignment]
    outside: np.ndarray = None  # type: ignore[assignment]
    error_map: dict[str, np.ndarray] = field(default_factory=dict)
    model: dict[str, tuple[str, int]] = field(default_factory=dict)
    seconds: float = np.nan
    rounds: int = 0
    converged: bool = False
    residuals: dict[str, Residuals] = field(default_factory=dict)
    costs: tuple[np.ndarray, ...] = ()

    def image_px(self, name: str, within: np.ndarray | None = None) -> float:
        """Return the RMSE [px] of a coordinate of the correction over the calibrated area.

        within: error map whose area restricts the evaluation.
        """
        errors = self.error_map[name]
        if within is not None:
            errors = errors[np.isfinite(errors) & np.isfinite(within)]
        return float(np.sqrt(np.nanmean(errors**2)))

    def covered(self, name: str) -> float:
        """Return the fraction of the image inside the calibrated area."""
        return float(np.mean(np.isfinite(self.error_map[name][..., 0])))

    def points_mm(self) -> float:
        """Return the out-of-sample 3-D RMSE [mm] of the object points."""
        return float(np.linalg.norm(self.outside[:3]))

    def source_mm(self) -> float:
        """Return the out-of-sample 3-D RMSE [mm] of the sources."""
        return float(np.linalg.norm(self.outside[3:]))


def available_models() -> tuple[str, ...]:
    """Return the correction models that CalibrationOptions accepts, in the order of the tables."""
    return tuple(name for name in MODELS if _accepted(model=name))


def available_relative() -> tuple[str, ...]:
    """Return the relative orientation constraints of CalibrationOptions, except 'none'."""
    return tuple(name for name in RELATIVE[1:] if _accepted(relative_orientation=name))


def _accepted(**options: Any) -> bool:
    try:
        CalibrationOptions(**options)
    except (TypeError, ValueError):
        return False
    return True


def options_of(case: Case) -> CalibrationOptions:
    """Return the CalibrationOptions of a case."""
    model, interior = {
        BEFORE: ('none', 'fixed'),
        HELD: ('knn', 'fixed'),
        KNOWN: ('none', 'estimated'),
    }.get(case.variant, (case.variant, 'estimated'))
    relative: dict[str, Any] = {}
    if case.relative != 'none':
        relative['relative_orientation'] = case.relative
    return CalibrationOptions(
        model=model, interior=interior, max_iterations=case.rounds, **relative
    )


# ------------------------------------------------------------------------------------------
# rigs


class Scene:
    """A virtual rig with its exposures for calibration and test."""

    def __init__(
        self,
        seed: int,
        strength: float,
        false_matches: float,
        exposures: int,
        every: int,
        survey: float,
    ) -> None:
        rig = virtual_rig(seed, strength)
        self.rig = replace(rig, phantom=replace(rig.phantom, sd_mm=survey * rig.phantom.sd_mm))
        self._seed = seed
        self._false_matches = false_matches
        self._every = every
        self.recording = simulate_exposures(
            self.rig, exposures, seed, Detection(NOISE_PX, false_matches)
        )
        self._tested: dict[tuple[tuple[str, ...], bool], Measured] = {}

    def training(
        self, count: int | None, known: bool
    ) -> tuple[dict[str, list[Frame]], SimulatedExposures]:
        """Return the frames for the calibration, by fluoroscope.

        count: number of separate exposures; None: a regular subset of the recording.
        """
        if count is None:
            return self._frames(
                self.recording, known, lambda i: i % self._every == 0
            ), self.recording
        # Use separate exposures, so that the test is the same for every count.
        own = simulate_exposures(
            self.rig, count, 1000 * self._seed + count, Detection(NOISE_PX, self._false_matches)
        )
        return self._frames(own, known), own

    def test_network(self, fluoroscopes: tuple[str, ...], known: bool) -> Measured:
        """Return a network of the test exposures, starting from the true calibration."""
        key = fluoroscopes, known
        if key not in self._tested:
            frames = self._frames(self.recording, known, lambda i: i % self._every != 0)
            sensors = {
                f.name: KnownSensor(f.interior, _correction(None if known else f.distortion))
                for f in self.rig.fluoroscopes
            }
            self._tested[key] = measured_network(
                {n: frames[n] for n in fluoroscopes}, self.rig.phantom, sensors=sensors
            )
        return self._tested[key]

    def _frames(
        self,
        simulated: SimulatedExposures,
        known: bool,
        chosen: Callable[[int], bool] = lambda i: True,
    ) -> dict[str, list[Frame]]:
        """Return frames by fluoroscope; known: remove the true distortion."""
        out = {}
        for name, frames in simulated.frames.items():
            out[name] = [
                _undistorted(frame, simulated.undistorted[name][i]) if known else frame
                for i, frame in enumerate(frames)
                if chosen(i)
            ]
        return out

    def field(self, name: str) -> DistortionField:
        """Return the true distortion of a fluoroscope."""
        return next(f.distortion for f in self.rig.fluoroscopes if f.name == name)

    def errors(
        self,
        targets_id: np.ndarray,
        xyz_mm: np.ndarray,
        exposures: Iterable[tuple[str, int, np.ndarray]],
        simulated: SimulatedExposures,
    ) -> np.ndarray:
        """Return the RMSE (6,) [mm] of object points and of sources.

        exposures: (fluoroscope, number, position_mm).
        """
        points = xyz_mm - self.rig.true_mm[targets_id - self.rig.phantom.target_id[0]]
        rigs = {f.name: f for f in self.rig.fluoroscopes}
        sources = np.array(
            [
                position - rigs[name].exterior(simulated.poses[number - 1])[1]
                for name, number, position in exposures
            ]
        )
        return np.sqrt(np.concatenate([np.mean(points**2, axis=0), np.mean(sources**2, axis=0)]))


def _correction(distortion: DistortionField | None) -> Callable[[Frame], np.ndarray]:
    """Return the correction of the image points of a frame; None: they are free of distortion."""
    if distortion is None:
        return lambda frame: np.zeros_like(frame.uv)
    return lambda frame: distortion(frame.uv)


def _undistorted(frame: Frame, uv: np.ndarray) -> Frame:
    """Return a frame with other image points, without those that fall outside the image."""
    on = points_on_image(uv, frame.image_size)
    return replace(frame, target_id=frame.target_id[on], uv=uv[on])


@functools.lru_cache(maxsize=2)
def scene_of(*key: Any) -> Scene:
    """Return the Scene with this key; run cases of the same scene one after the other."""
    return Scene(*key)


# ------------------------------------------------------------------------------------------
# cases


def run_case(case: Case) -> Outcome:
    """Run a case and return its outcome."""
    known = case.variant == KNOWN
    scene = scene_of(*case.scene)
    frames, simulated = scene.training(case.training, known)
    began = time.perf_counter()
    try:
        job = calibrate(
            {n: frames[n] for n in case.fluoroscopes},
            scene.rig.phantom,
            options_of(case),
            case.joint,
        )
        seconds = time.perf_counter() - began
        with threadpool_limits(1):
            outside = errors_of_test(scene, case, job.calibrations)
    except (DataError, np.linalg.LinAlgError) as error:  # a failure is also a result
        return Outcome(failed=f'{type(error).__name__}: {error}')
    exposures = [
        (name, e.exposure, e.position_mm)
        for name in case.fluoroscopes
        for e in job.fluoroscopes[name].exposures
    ]
    inside = scene.errors(job.targets.target_id, job.targets.xyz_mm, exposures, simulated)
    models = {name: job.calibrations[name].model for name in case.fluoroscopes}
    maps = (
        {}
        if known
        else {
            name: error_over_image(
                models[name],
                scene.field(name),
                np.concatenate([f.uv for f in frames[name]]),
                job.fluoroscopes[name].image_size,
            )
            for name in case.fluoroscopes
        }
    )
    detail = _details(job) if case.detail else {}
    return Outcome(
        inside=inside,
        outside=outside,
        error_map=maps,
        model={n: (f.model_kind, f.k) for n, f in job.fluoroscopes.items()},
        seconds=seconds,
        rounds=sum(len(r.history) for r in job.runs.values()),
        converged=job.converged,
        **detail,
    )


def errors_of_test(
    scene: Scene, case: Case, calibrations: Mapping[str, FluoroscopeCalibration]
) -> np.ndarray:
    """Return the RMSE (6,) [mm] of the test exposures, adjusted with fixed calibrations.

    Same as adjust_with_calibrations except for the initial values, and without the covariances and
    the adjustment before the correction, which are not needed here; takes a third of the time.
    """
    measured = scene.test_network(case.fluoroscopes, case.variant == KNOWN)
    correction, network = fixed_corrections(measured, calibrations)
    start = with_interior(
        measured, np.array([calibrations[n].interior for n in case.fluoroscopes])
    )
    noise = replace(
        start_noise('student_t'),
        scale=float(np.median([c.sigma0 for c in calibrations.values()])),
        nu=float(np.median([c.nu for c in calibrations.values()])),
    )
    if too_few_rays_for_noise(network):
        after = adjust(network, start, correction, noise, TEST_TOLERANCE)
    else:
        after = adjust_and_estimate_noise(network, start, correction, noise, TEST_TOLERANCE)
    exposures = [
        (frame.fluoroscope, frame.number, after.parameters.position_mm[j])
        for j, frame in enumerate(measured.frames)
    ]
    return scene.errors(measured.target_id, after.parameters.points_mm, exposures, scene.recording)


def with_interior(measured: Measured, interior: np.ndarray) -> Parameters:
    """Return initial values of a network for other interior orientations (F, 3), same image.

    A shift of the principal point is compensated by a rotation of the sensor, and another
    principal distance by another distance of the source.
    """
    start = measured.start
    network = measured.network
    rotation = start.rotation.copy()
    position = start.position_mm.copy()
    for f, (last, now) in enumerate(zip(start.interior, interior)):
        rows = network.fluoroscope == f
        x, y = (last[:2] - now[:2]) / now[2]
        rotation[rows] = matrix_from_vector([-y, x, 0.0]) @ rotation[rows]
        axis = rotation[rows, 2]
        depth = np.sum(axis * (start.points_mm.mean(axis=0) - position[rows]), axis=1)
        position[rows] -= ((now[2] / last[2] - 1) * depth)[:, None] * axis
    return replace(start, interior=interior, rotation=rotation, position_mm=position)


def _details(job: CalibrationResult) -> dict[str, Any]:
    """Return residuals by fluoroscope and relative costs of a calibration."""
    residuals = {}
    costs: tuple[np.ndarray, ...] = ()
    for run in job.runs.values():
        network = run.measured.network
        after = run.after
        weight = after.noise.weight(after.q)
        # Use C_r with the simulated noise as C_l, the same unit for every variant, so that costs
        # are comparable.
        redundancy = geometric_redundancy(network, after.parameters, Noise('gaussian', NOISE_PX))
        sd = NOISE_PX * network.sigma * np.sqrt(np.maximum(redundancy, 0.05))
        for f, name in enumerate(run.measured.fluoroscopes):
            rows = np.flatnonzero(network.fluoroscope[network.exposure] == f)
            residuals[name] = Residuals(
                network.uv[rows],
                after.residuals[rows],
                sd[rows],
                weight[rows],
                after.inliers[rows],
            )
        if len(run.history) > 1:
            costs = relative_costs(run)[:2]
    return {'residuals': residuals, 'costs': costs}


# ------------------------------------------------------------------------------------------
# correction itself


def error_over_image(
    model: CorrectionModel,
    true_field: Callable[[np.ndarray], np.ndarray],
    training_uv: np.ndarray,
    image_size: tuple[int, int],
) -> np.ndarray:
    """Return errors (rows, columns, 2) [px] of a correction on a grid, NaN if not calibrated.

    These remain after the best projective map of corrected to true coordinates: shift, scale,
    rotation and tilt of the image plane belong to the orientation of the fluoroscope, not to its
    distortion.
    """
    u, v = np.meshgrid(*(np.arange(GRID_PX / 2 - 0.5, size, GRID_PX) for size in image_size))
    pixels = np.column_stack([u.ravel(), v.ravel()])
    hull = ConvexHull(training_uv).equations
    inside = (pixels @ hull[:, :2].T + hull[:, 2] <= 0).all(axis=1) & ~model.outside(pixels)
    out = np.full(pixels.shape, np.nan)
    observed = pixels[inside]
    out[inside] = projective_residuals(
        observed - model.predict(observed), observed - true_field(observed)
    )
    return out.reshape(*u.shape, 2).astype(np.float32)


def projective_residuals(uv: np.ndarray, ideal: np.ndarray) -> np.ndarray:
    """Return residuals (n, 2) of the least-squares projective map (8 parameters) to ideal."""
    centre = np.mean(ideal, axis=0)
    half = np.max(np.ptp(ideal, axis=0)) / 2
    x, y = ((uv - centre) / half).T
    goal = (ideal - centre) / half
    one = np.ones_like(x)
    zero = np.zeros_like(x)
    h = np.array([1.0, 0, 0, 0, 1, 0, 0, 0])
    for _ in range(5):  # Gauss-Newton: the linear solution has a slightly different cost
        below = h[6] * x + h[7] * y + 1
        mapped = (
            np.stack([h[0] * x + h[1] * y + h[2], h[3] * x + h[4] * y + h[5]], axis=1)
            / below[:, None]
        )
        rows = (
            np.stack(
                [
                    np.stack(
                        [x, y, one, zero, zero, zero, -mapped[:, 0] * x, -mapped[:, 0] * y], axis=1
                    ),
                    np.stack(
                        [zero, zero, zero, x, y, one, -mapped[:, 1] * x, -mapped[:, 1] * y], axis=1
                    ),
                ],
                axis=1,
            )
            / below[:, None, None]
        )
        step, *_ = np.linalg.lstsq(rows.reshape(-1, 8), (goal - mapped).ravel(), rcond=None)
        h = h + step
    below = h[6] * x + h[7] * y + 1
    mapped = (
        np.stack([h[0] * x + h[1] * y + h[2], h[3] * x + h[4] * y + h[5]], axis=1) / below[:, None]
    )
    return half * (mapped - goal)
