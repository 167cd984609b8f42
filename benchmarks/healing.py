# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Accuracy of the diagnosis of changes of a rig, and of the healed rig.

The whole job heals recordings of scenarios without knowing the cause. Rigs, bodies, motion and
projection are created here with scipy's rotations and share no code with the package. Writes a
section of docs/how_good.md: python -m benchmarks.healing --seeds 10
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.special import chdtri
from threadpoolctl import threadpool_limits

from fluoro_calib_ros.bodies.body import declared_bodies
from fluoro_calib_ros.bodies.shapes import LearnedShapes
from fluoro_calib_ros.correction.fluoroscope_calibration import FluoroscopeCalibration
from fluoro_calib_ros.correction.registry import CollocationModel
from fluoro_calib_ros.correction.series import Functions, Series
from fluoro_calib_ros.exposures.frame import Frame
from fluoro_calib_ros.healing.diagnosis import Cause
from fluoro_calib_ros.healing.rig_errors import RigErrors, rig_errors
from fluoro_calib_ros.jobs.healing import HealingOutcome, heal_rig
from fluoro_calib_ros.jobs.learning import learn_shapes
from fluoro_calib_ros.photogrammetry.rig_orientation import RigOrientation
from tools.sections import write_section

from .bodies import Rig, table

NOISE_PX = 0.25
CORRECTION_PX = 0.03
FALSE_SHARE = 0.01
EXPOSURES = 600  # 5 s at 120 Hz, half of them for the verdict
LEARNED_S = 30.0  # duration of the recording from which shapes are learned, at the same rate
STEP_MM = 25.0  # spacing of the grid of points in the common field
# Standard deviations of the calibration: T [mm], w [rad], xp, yp, c [px]; a defines the rig frame.
RIG_SD = np.array([0.02] * 3 + [4e-5] * 3 + [0.2, 0.2, 0.6])
LEFT_PX = 0.2  # undetected drift of the distortion, at the markers, that is acceptable
TAIL = 1e-3  # probability that a change of orientation exceeds its covariance by chance
SIZE = (1024, 1024)
NAMES = ('a', 'b')


def bump(rng: np.random.Generator, times: np.ndarray) -> np.ndarray:
    """Move b by 5 mm and 0.5 degrees."""
    out = np.zeros(18)
    for rows, size in ((slice(9, 12), 5.0), (slice(12, 15), np.radians(0.5))):
        direction = rng.normal(size=3)
        out[rows] = size * direction / np.linalg.norm(direction)
    return np.tile(out, (len(times), 1))


def tenth(rng: np.random.Generator, times: np.ndarray) -> np.ndarray:
    """Move b by 0.5 mm and 0.05 degrees."""
    return bump(rng, times) / 10


def twentieth(rng: np.random.Generator, times: np.ndarray) -> np.ndarray:
    """Move b by 0.25 mm and 0.025 degrees."""
    return bump(rng, times) / 20


def bump_halfway(rng: np.random.Generator, times: np.ndarray) -> np.ndarray:
    """Move b in the middle of the recording."""
    return bump(rng, times) * (times >= times.mean())[:, None]


def creep(rng: np.random.Generator, times: np.ndarray) -> np.ndarray:
    """Move b gradually by as much as a bump during the recording."""
    return bump(rng, times) * (times / times[-1])[:, None]


def focus(rng: np.random.Generator, times: np.ndarray) -> np.ndarray:
    """Change the principal distance of a or b by 1 %."""
    out = np.zeros((len(times), 18))
    out[:, 9 * rng.integers(2) + 8] = 33.0
    return out


@dataclass(frozen=True)
class Scenario:
    """A change of a rig, and the expected diagnosis.

    change: returns additional errors (T, 18) of the rig from a random generator and times (T,).
    moving: fraction of the usual motion. shift_mm: amplitude of an additional common motion.
    is_steady: whether the rig stays unchanged during the recording.
    """

    name: str
    cause: Cause | None
    change: Callable[[np.random.Generator, np.ndarray], np.ndarray] | None = None
    bodies: int = 5
    markers: int = 6
    migration_mm: float = 0.0
    scatter_mm: float = 0.0
    exchanged: bool = False
    drift_px: float = 0.0
    moving: float = 1.0
    shift_mm: float = 0.0
    is_steady: bool = True


KNEE = Scenario('bump, two bodies of four', Cause.ORIENTATION, bump, bodies=2, markers=4)
SCENARIOS = (
    Scenario('nothing', None),
    Scenario('nothing, two bodies of four', None, bodies=2, markers=4),
    Scenario('bump', Cause.ORIENTATION, bump),
    KNEE,
    replace(KNEE, name='the same, move by 2 mm', moving=0.0, shift_mm=2.0),
    replace(KNEE, name='the same, stand still', moving=0.0),
    replace(KNEE, name='bump, one body of four', bodies=1),
    Scenario('creep', Cause.ORIENTATION, creep, is_steady=False),
    replace(
        KNEE,
        name='bump halfway, two bodies of four',
        change=bump_halfway,
        is_steady=False,
    ),
    Scenario('principal distance', Cause.INTERIOR, focus),
    Scenario('distortion, 1 px', Cause.DISTORTION, drift_px=1.0),
    Scenario('marker migrated', Cause.MIGRATED, migration_mm=0.5),
    Scenario('soft body', Cause.SOFT, scatter_mm=0.15),
    Scenario('ids exchanged', Cause.EXCHANGED, exchanged=True),
    Scenario('a tenth of the bump', Cause.ORIENTATION, tenth),
    Scenario('a twentieth of the bump', Cause.ORIENTATION, twentieth),
    Scenario('distortion, 4 px', Cause.DISTORTION, drift_px=4.0),
    replace(KNEE, name='bump, four bodies of four', bodies=4),
    Scenario('distortion, 0.3 px', Cause.DISTORTION, drift_px=0.3),
)


class Recording:
    """Bodies learned by a calibrated rig, and a recording after a scenario has happened."""

    def __init__(self, scenario: Scenario, seed: int) -> None:
        self.scenario = scenario
        number = SCENARIOS.index(scenario)
        self.rng = rng = np.random.default_rng([seed, number])
        self.rig = Rig((0.0, float(rng.uniform(60, 90))))
        sd = np.concatenate([np.zeros(6), RIG_SD[6:], RIG_SD])
        self.covariance = np.diag(sd**2)
        self.errors = rng.normal(0, 1, 18) * sd
        self.shapes = rng.uniform(-20, 20, (scenario.bodies, scenario.markers, 3))
        self.fields = [Field(rng) for _ in NAMES]
        self.bend = np.zeros(6)  # coefficients of the drift of the distortion of b
        times = np.linspace(0, 5, EXPOSURES)
        self._motion = (
            rng.uniform(0, 2 * np.pi, (scenario.bodies, 3)),
            rng.uniform(-1, 1, (3, scenario.bodies, 3)),
        )
        self.learned = self._learned()
        self.bodies = self.learned.bodies
        points = self.moving(times, scenario.moving)
        phase = 0.8 * np.pi * times
        shift = np.stack([np.sin(phase), np.cos(phase), np.sin(2 * phase)], axis=1)
        self.points = self._changed(points + scenario.shift_mm * shift[:, None, None])
        self.change = np.zeros((EXPOSURES, 18))
        if scenario.change is not None:
            self.change = scenario.change(rng, times)
        self.frames, self.false = self.seen(
            self.points, times, self.errors + self.change, scenario
        )

    def moving(self, times: np.ndarray, share: float) -> np.ndarray:
        """Return points (T, B, M, 3) of markers: turns up to 23 degrees, shifts up to 25 mm."""
        phase, (turn, centre, swing) = self._motion
        angle = 1.6 * np.pi * times[:, None, None] + phase
        turned = Rotation.from_rotvec((share * 0.4 * turn * np.sin(angle)).reshape(-1, 3))
        turned_matrix = turned.as_matrix().reshape(len(times), -1, 3, 3)
        place = 50 * centre + share * 25 * swing * np.sin(angle + 1)
        return self.shapes @ np.swapaxes(turned_matrix, 2, 3) + place[:, :, None]

    def _learned(self) -> LearnedShapes:
        """Return the shapes that the calibrated rig, with its errors, learns before the change."""
        times = np.arange(0, LEARNED_S, 5 / EXPOSURES)
        healthy = replace(self.scenario, drift_px=0.0, exchanged=False)
        frames, _ = self.seen(self.moving(times, 1.0), times, self.errors, healthy)
        markers = np.arange(self.scenario.markers)
        bodies = [
            f'bone{k}: {" ".join(map(str, 10 * k + markers))}' for k in range(len(self.shapes))
        ]
        declared = declared_bodies(bodies)
        return learn_shapes(frames, self.calibrations(), self.orientation(), declared)

    def shape_errors_mm(self) -> np.ndarray:
        """Return the RMS error of a coordinate of each learned body, apart from the scale."""
        out = []
        for body, shape in zip(self.bodies, self.shapes):
            own, arm = shape - shape.mean(axis=0), body.xyz_mm - body.xyz_mm.mean(axis=0)
            turned = Rotation.align_vectors(own, arm)[0].apply(arm)
            turned *= np.sum(turned * own) / np.sum(turned**2)
            out.append(np.sqrt(np.mean((turned - own) ** 2)))
        return np.array(out)

    def _changed(self, points: np.ndarray) -> np.ndarray:
        """Return points of bodies after the scenario has displaced markers."""
        if self.scenario.migration_mm:  # move along the line to another marker of the body
            away = points[:, 0, 2] - points[:, 0, 0]
            away /= np.linalg.norm(away, axis=1)[:, None]
            points[:, 0, 2] += self.scenario.migration_mm * away
        if self.scenario.scatter_mm:
            points[:, 1] += self.rng.normal(0, self.scenario.scatter_mm, points[:, 1].shape)
        return points

    def project(self, points: np.ndarray, errors: np.ndarray) -> np.ndarray:
        """Return image points (..., F, 2) of points (T, ..., 3) with errors (18,) or (T, 18)."""
        errors = np.tile(errors, (len(points), 1)) if errors.ndim == 1 else errors
        flat = points.reshape(len(points), -1, 3)
        out = []
        for f, (turn, source) in enumerate(self.rig.views()):
            d = errors[:, 9 * f : 9 * f + 9]
            turned = Rotation.from_rotvec(d[:, 3:6]).as_matrix() @ turn
            away = flat - (source + d[:, None, :3])
            x, y, z = np.moveaxis(away @ np.swapaxes(turned, 1, 2), -1, 0)
            c = self.rig.principal_px + d[:, 8:]
            shift = 511.5 + d[:, None, 6:8]
            uv = shift + np.stack([c * x / z, c * y / z], axis=-1)
            out.append(uv.reshape(*points.shape[:-1], 2))
        return np.stack(out, axis=-2)

    def drift(self, uv: np.ndarray) -> np.ndarray:
        """Return the drift (..., 2) of the distortion of b at pixels (..., 2)."""
        x, y = np.moveaxis((uv - 511.5) / 512, -1, 0)
        a = self.bend
        along_u = a[0] * x * x + a[1] * x * y + a[2] * x**3
        return np.stack([along_u, a[3] * y * y + a[4] * x * y + a[5] * y**3], axis=-1)

    def seen(
        self, points: np.ndarray, times: np.ndarray, errors: np.ndarray, scenario: Scenario
    ) -> tuple[dict[str, list[Frame]], np.ndarray]:
        """Return frames of points (T, B, M, 3) with noise, false matches and correction errors.

        times (T,) [s]; errors (T, 18) of the rig. Also return which (T, B M) have a false match.
        """
        uv = self.project(points, errors)
        uv = uv.reshape(len(points), -1, 2, 2)
        if scenario.drift_px:
            self.bend = self.rng.uniform(-1, 1, 6) * scenario.drift_px
            uv[..., 1, :] += self.drift(uv[..., 1, :])
        uv = uv + np.stack([field(uv[..., f, :]) for f, field in enumerate(self.fields)], axis=-2)
        uv += self.rng.normal(0, NOISE_PX, uv.shape)
        false = self.rng.random(uv.shape[:3]) < FALSE_SHARE
        uv[false] = self.rng.uniform(0, 1023, (np.count_nonzero(false), 2))
        if scenario.exchanged:
            uv[:, [0, 1]] = uv[:, [1, 0]]
        ids = (10 * np.arange(scenario.bodies)[:, None] + np.arange(scenario.markers)).ravel()
        frames: dict[str, list[Frame]] = {name: [] for name in NAMES}
        for f, name in enumerate(NAMES):
            for t, of_time in enumerate(uv[:, :, f]):
                on = ((of_time >= 0) & (of_time <= 1023)).all(axis=1)
                sigma = np.full(np.count_nonzero(on), NOISE_PX)
                stamp = 1 + round(1e9 * times[t])
                frame = Frame(name, t, ids[on], of_time[on], SIZE, sigma, stamp_ns=stamp)
                frames[name].append(frame)
        return frames, false.any(axis=2)

    def orientation(self) -> RigOrientation:
        """Return the orientation of the rig as calibrated."""
        ids = tuple(one.calibration_id for one in self.calibrations().values())
        return replace(self.rig.orientation(), covariance=self.covariance, calibration_ids=ids)

    def calibrations(self) -> dict[str, FluoroscopeCalibration]:
        """Return calibrations that correct nothing, with the claimed error of a correction."""
        axis = np.linspace(0, 1023, 33)
        uv = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
        functions = Functions(SIZE, 3)
        zero = np.zeros((2, len(functions)))
        series = Series(functions, zero, np.full((33, 33), CORRECTION_PX))
        model = CollocationModel(0, uv, np.zeros_like(uv), series=series)
        return {
            name: FluoroscopeCalibration(
                fluoroscope=name,
                image_size=SIZE,
                interior=self.rig.orientation().interior[f],
                interior_covariance=np.diag(RIG_SD[6:] ** 2),
                interior_estimated=True,
                model=model,
                train_exposure=np.zeros(0, dtype=int),
                image_sd=NOISE_PX,
                sigma0=1.0,
                nu=10.0,
                exposures=1,
                observations=1,
                inliers=1,
                rmse_before=np.ones(2),
                rmse_after=np.ones(2),
                cost_adjustment=0.0,
                cost_regression=0.0,
                iterations=1,
                converged=True,
                stamp_ns=0,
                frame_id=f'{name}_optical',
                source_digest='00',
            )
            for f, name in enumerate(NAMES)
        }

    def field(self) -> np.ndarray:
        """Return points (n, 3) of a grid that both fluoroscopes see after the bump."""
        axis = np.arange(-200, 201, STEP_MM)
        grid = np.stack(np.meshgrid(axis, axis, axis), axis=-1).reshape(1, -1, 3)
        uv = self.project(grid, self.errors + self.change[0])[0]
        return np.asarray(grid[0][((uv >= 0) & (uv <= 1023)).all(axis=(1, 2))])

    def heal(self) -> HealingOutcome:
        """Heal the rig."""
        return heal_rig(self.frames, self.calibrations(), self.orientation(), self.bodies)


class Field:
    """A smooth error of the correction of an image, with standard deviation CORRECTION_PX."""

    def __init__(self, rng: np.random.Generator, waves: int = 30) -> None:
        self.wave = rng.normal(0, 1 / 100, (waves, 2))  # correlated over about 100 px
        self.phase = rng.uniform(0, 2 * np.pi, (2, waves))
        self.size = CORRECTION_PX * np.sqrt(2 / waves)

    def __call__(self, uv: np.ndarray) -> np.ndarray:
        """Return errors (..., 2) [px] at pixels (..., 2)."""
        angle = uv @ self.wave.T
        return self.size * np.stack([np.sin(angle + one).sum(-1) for one in self.phase], axis=-1)


def intersected(rig: Rig, uv: np.ndarray, errors: np.ndarray) -> np.ndarray:
    """Intersect image points (..., F, 2) to points (..., 3), using a rig with errors (18,)."""
    rows = []
    right = []
    for f, (turn, source) in enumerate(rig.views()):
        d = errors[9 * f : 9 * f + 9]
        turned = Rotation.from_rotvec(d[3:6]).as_matrix() @ turn
        away = uv[..., f, :] - 511.5 - d[6:8]
        for axis in range(2):
            row = (rig.principal_px + d[8]) * turned[axis] - away[..., axis, None] * turned[2]
            rows.append(row)
            right.append(row @ (source + d[:3]))
    matrix = np.stack(rows, axis=-2)
    vector = np.stack(right, axis=-1)[..., None]
    transposed = np.swapaxes(matrix, -1, -2)
    return np.linalg.solve(transposed @ matrix, transposed @ vector)[..., 0]


@dataclass
class Result:
    """Results for the recordings of a scenario; errors refer to rigs that pass."""

    right: int = 0
    within: int = 0
    unsure: int = 0
    wrong: int = 0
    nse: list[float] = field(default_factory=list)  # mean NSE of the six parameters of b
    # RMS residual drift of a coordinate at the markers, after removing an affine map
    left_px: list[float] = field(default_factory=list)
    scale_ppm: list[float] = field(default_factory=list)
    scale_sd_ppm: list[float] = field(default_factory=list)
    # RMS distance [mm] at the markers, after the best rigid motion
    there_mm: list[float] = field(default_factory=list)
    there_sd_mm: list[float] = field(default_factory=list)
    # The same in the common field
    field_mm: list[float] = field(default_factory=list)
    field_sd_mm: list[float] = field(default_factory=list)
    # RMS distance of the best rigid motion at the markers, including rigs in which no change was
    # found
    common_mm: list[float] = field(default_factory=list)
    common_said_mm: list[float] = field(default_factory=list)

    def cells(self) -> list[str]:
        """Return the cells of a table row."""
        ratio = [one / sd for one, sd in zip(self.field_mm, self.field_sd_mm)]
        return [
            *(str(n) for n in (self.right, self.within, self.unsure, self.wrong)),
            f'{rms(self.left_px):.2f}' if self.left_px else '',
            f'{np.mean(self.nse):.2f}' if self.nse else '',
            *(f'{rms(x):.0f}' if x else '' for x in (self.scale_ppm, self.scale_sd_ppm)),
            *(f'{rms(x):.3f}' if x else '' for x in (self.there_mm, self.there_sd_mm)),
            *(f'{rms(x):.3f}' if x else '' for x in (self.field_mm, self.field_sd_mm)),
            f'{rms(ratio):.2f}' if ratio else '',
            *(f'{rms(x):.2f}' if x else '' for x in (self.common_mm, self.common_said_mm)),
        ]


def measure(scenario: Scenario, seeds: Iterable[int]) -> Result:
    """Heal the recordings of a scenario."""
    result = Result()
    for seed in seeds:
        recording = Recording(scenario, seed)
        outcome = recording.heal()
        causes = [one.cause for one in outcome.diagnosis.changes]
        right = causes == ([] if scenario.cause is None else [scenario.cause])
        right = right and scenario.is_steady
        if outcome.verdict != 'pass':
            result.unsure += 1
        else:
            _compare(recording, outcome, result)
            if right:
                result.right += 1
            elif not causes and scenario.is_steady and _is_within(result, scenario):
                result.within += 1
            else:
                result.wrong += 1
        print(scenario.name, seed, [one.value for one in causes], outcome.verdict, flush=True)
    return result


def _is_within(result: Result, scenario: Scenario) -> bool:
    """Return whether the undetected change of the last rig lies within its claimed errors."""
    if scenario.cause is Cause.DISTORTION:
        return result.left_px[-1] <= LEFT_PX
    return scenario.cause is Cause.ORIENTATION and 6 * result.nse[-1] <= chdtri(6, TAIL)


def _compare(recording: Recording, outcome: HealingOutcome, result: Result) -> None:
    """Add the errors of a rig that passes to a result."""
    if recording.scenario.cause is Cause.DISTORTION:
        _compare_distortion(recording, outcome, result)
    if recording.scenario.cause not in (Cause.ORIENTATION, None):
        return
    true = recording.errors + recording.change[0]
    estimated = np.zeros(18) if outcome.healed is None else outcome.healed.changes.ravel()
    error = (estimated - true)[9:15]
    covariance = outcome.orientation.covariance[9:15, 9:15]
    result.nse.append(float(error @ np.linalg.solve(covariance, error)) / 6)
    result.common_mm.append(_common_motion(recording, outcome))
    result.common_said_mm.append(outcome.common_motion.numbers['distance_mm'])
    common, there = recording.field(), recording.points[::10].reshape(-1, 3)
    for points, errors, claims in (
        (there, result.there_mm, result.there_sd_mm),
        (common, result.field_mm, result.field_sd_mm),
    ):
        errors.append(_error(recording, points, estimated, true))
        claims.append(float(np.sqrt(3) * _claimed(outcome, points).place_mm))
    found = intersected(recording.rig, recording.project(there[None], true)[0], estimated)
    result.scale_ppm.append(1e6 * _scale(found, there))
    result.scale_sd_ppm.append(1e6 * _claimed(outcome, there).scale)


def _compare_distortion(recording: Recording, outcome: HealingOutcome, result: Result) -> None:
    """Add the residual drift of b in a rig that passes."""
    there = recording.points[::10].reshape(-1, 3)
    uv = recording.project(there[None], recording.errors)[0]
    image = uv.copy()
    image[:, 1] += recording.drift(uv[:, 1])
    for f, name in enumerate(NAMES):
        u, v, *_ = outcome.calibrations[name].correct_arrays(*image[:, f].T)
        image[:, f] = np.stack([u, v], axis=1)
    design = np.column_stack([np.ones(len(uv)), uv[:, 1] - 511.5])
    left = (image - uv)[:, 1]
    left = left - design @ np.linalg.lstsq(design, left, rcond=None)[0]
    result.left_px.append(rms(left.ravel()))
    estimated = np.zeros(18) if outcome.healed is None else outcome.healed.changes.ravel()
    result.there_mm.append(_misfit(intersected(recording.rig, image, estimated), there))
    result.there_sd_mm.append(outcome.unseen_distortion.value)


def _common_motion(recording: Recording, outcome: HealingOutcome) -> float:
    """Return the RMS distance by which the rig in use afterwards shifts all points [mm]."""
    there = recording.points[::10].reshape(-1, 3)
    estimated = np.zeros(18) if outcome.healed is None else outcome.healed.changes.ravel()
    image = recording.project(there[None], recording.errors + recording.change[0])[0]
    found = intersected(recording.rig, image, estimated)
    turn, _ = Rotation.align_vectors(found - found.mean(axis=0), there - there.mean(axis=0))
    moved = turn.apply(there - there.mean(axis=0)) + found.mean(axis=0) - there
    return float(np.sqrt(np.mean(np.sum(moved**2, axis=1))))


def _claimed(outcome: HealingOutcome, points: np.ndarray) -> RigErrors:
    """Return the errors of points (n, 3) that the covariance of the healed rig claims."""
    return rig_errors(outcome.orientation, points)


def _scale(points: np.ndarray, others: np.ndarray) -> float:
    """Return the scale of points (n, 3) relative to others, minus 1."""
    arm = others - others.mean(axis=0)
    other = points - points.mean(axis=0)
    turned = Rotation.align_vectors(arm, other)[0].apply(other)
    return float(np.sum((turned - arm) * arm) / np.sum(arm**2))


def _error(
    recording: Recording, points: np.ndarray, estimated: np.ndarray, true: np.ndarray
) -> float:
    """Return RMS errors of points (n, 3) by the estimated rig after the best rigid motion [mm]."""
    image = recording.project(points[None], true)[0]
    return _misfit(intersected(recording.rig, image, estimated), points)


def _misfit(found: np.ndarray, points: np.ndarray) -> float:
    """Return the RMS distance of points (n, 3) from others after the best rigid motion [mm]."""
    one = found - found.mean(axis=0)
    other = points - points.mean(axis=0)
    rest = Rotation.align_vectors(other, one)[0].apply(one) - other
    return float(np.sqrt(np.mean(np.sum(rest**2, axis=1))))


def rms(values: Iterable[float]) -> float:
    """Return the root mean square."""
    return float(np.sqrt(np.mean(np.square(list(values)))))


TEXT = """
## Healing

Generated by `python -m benchmarks.healing --seeds {seeds} --first {first}`: {seeds} recordings
each, of 5 s with {exposures} exposures, every second block of which is kept for the verdict,
healed by the whole job. Two views at 60 to 90 degrees, noise of {noise} px, 1 % false matches, a
smooth error of the correction of {correction} px. Shapes are learned, as by `fluoro-calib bodies
--learn`, from {learned:.0f} s of a healthy recording by the same calibrated rig, with its errors;
a coordinate has an error of {shape:.4f} mm (RMS, apart from the scale), and a stated sd of
{claim:.4f} mm. There are five bodies of six markers unless stated otherwise. Rigs, bodies and
motion come from a generator that shares no code with the package. Bump: 0.5 degrees and 5 mm;
creep: the same in the course of the recording; principal distance: 1 %; distortion: quadratic and
cubic terms of up to 0.3, 1 or 4 px at the edges of the image; marker: 0.5 mm; soft body: 0.15 mm.

Right: the cause is named and the verdict is pass; never if the rig continues to change. Within:
no cause is named, the verdict is pass, and the change that was not found lies within the stated
uncertainty: six parameters of b by their covariance (chi-squared, {tail:g}), a distortion below
{left} px where the markers were (RMS). Not passed: the verdict says that it is not sure, or that
the rig changed meanwhile. Wrong: another cause, or none, passes. Left: remainder of the drift of
the distortion where the markers were, apart from an affine map of the image, which moves all
points together; the stated error is then `unseen_distortion`.

The other columns are for rigs that pass, moved or unchanged. NSE: squared error of the six
parameters over their stated covariance; the scale; errors as distances after the best rigid
motion, RMS, where the markers were and on a grid of {step:.0f} mm in the whole field of both
fluoroscopes; stated: from the covariance of the healed rig. Common motion: the distance by which
all points are moved together in the rig frame; stated: the value that `heal` gives.

{rows}
"""
HEADER = (
    'scenario|right|within|not passed|wrong|left [px]|NSE|scale [ppm]|stated [ppm]'
    '|error at the markers [mm]|stated [mm]|error in the field [mm]|stated [mm]|error / stated'
    '|common motion [mm]|stated [mm]'
)


def main() -> None:
    """Run the measurements and write the section."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--seeds', type=int, default=10, help='recordings of a scenario')
    parser.add_argument('--first', type=int, default=0, help='first seed')
    arguments = parser.parse_args()
    first = arguments.first
    rows = []
    with threadpool_limits(1):
        typical = Recording(SCENARIOS[0], first)
        for scenario in SCENARIOS:
            found = measure(scenario, range(first, first + arguments.seeds))
            rows.append([scenario.name, *found.cells()])
    text = TEXT.format(
        rows=table(HEADER, rows),
        seeds=arguments.seeds,
        first=first,
        exposures=EXPOSURES,
        noise=NOISE_PX,
        correction=CORRECTION_PX,
        learned=LEARNED_S,
        shape=rms(typical.shape_errors_mm()),
        claim=rms(np.concatenate([body.sd_mm for body in typical.bodies])),
        step=STEP_MM,
        tail=TAIL,
        left=LEFT_PX,
    )
    write_section(Path('docs/how_good.md'), 'healing', text)


if __name__ == '__main__':
    main()
