# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""How good a healed rig is in the whole common field, by how far the bodies moved.

A knee stands still, moves by 2 mm or walks after a bump. The whole job heals the rig. Rigs,
bodies, motion and projection are made here with scipy's rotations; nothing of them is shared with
the package. Writes a section of docs/how_good.md: python -m benchmarks.healing_field --seeds 10
"""

from __future__ import annotations

import argparse
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation
from threadpoolctl import threadpool_limits

from fluoro_calib_ros.bodies.body import Body
from fluoro_calib_ros.bodies.rig_adjustment import rig_errors
from fluoro_calib_ros.correction.fluoroscope_calibration import FluoroscopeCalibration
from fluoro_calib_ros.correction.registry import CollocationModel
from fluoro_calib_ros.correction.series import Functions, Series
from fluoro_calib_ros.exposures.frame import Frame
from fluoro_calib_ros.jobs.healing import HealingOutcome, heal_rig
from fluoro_calib_ros.photogrammetry.rig_orientation import RigOrientation
from tools.sections import write_section

from .bodies import Rig, table
from .healing import (
    CORRECTION_PX,
    FALSE_SHARE,
    NOISE_PX,
    RIG_SD,
    SHAPE_SD_MM,
    SIZE,
    bump,
)

EXPOSURES = 100  # of 2 s, half of them for the verdict
STEP_MM = 25.0  # of the grid of points in the common field
NAMES = ('a', 'b')
# Share of the motion of a walk, and a shift [mm]
MOTIONS = {
    'stands still': (0.0, 0.0),
    'moves by 2 mm': (0.0, 2.0),
    'walks': (1.0, 0.0),
}


@dataclass(frozen=True)
class Case:
    """A recording, and when the rig is bumped: at the start, or halfway."""

    motion: str
    halfway: bool = False


class Knee:
    """A knee of two bones with four markers each that a calibrated rig learned, then a bump."""

    def __init__(self, case: Case, seed: int) -> None:
        self.rng = rng = np.random.default_rng([seed, 7])
        self.rig = Rig((0.0, float(rng.uniform(60, 90))))
        sd = np.concatenate([np.zeros(6), RIG_SD[6:], RIG_SD])
        self.covariance = np.diag(sd**2)
        self.errors = rng.normal(0, 1, 18) * sd
        self.shapes = rng.uniform(-32, 32, (2, 4, 3)) + [[[0, -40, 0]], [[0, 40, 0]]]
        self.centre = rng.uniform(-30, 30, 3)
        self.turn = Rotation.from_rotvec(rng.uniform(-0.3, 0.3, 3))
        self.fields = [Field(rng) for _ in NAMES]
        self.bodies = self._learned()
        self.change = bump(rng, np.zeros(1))[0]
        self.points = self._moving(*MOTIONS[case.motion])
        bumped = np.arange(EXPOSURES) >= EXPOSURES // 2 * case.halfway
        errors = self.errors + bumped[:, None] * self.change
        self.frames = self._frames(errors)

    def _moving(self, share: float, shift_mm: float) -> np.ndarray:
        """Points (T, 2, 4, 3) of the markers."""
        phase = 2 * np.pi * np.linspace(0, 2, EXPOSURES)
        zero = np.zeros_like(phase)
        swing = share * np.radians(20) * np.cos(phase)
        flexion = share * np.radians(30) * (1 - np.cos(phase + 1))
        place = share * np.stack([60 * np.sin(phase), 20 * np.cos(2 * phase), 10 * np.sin(phase)])
        place += shift_mm * np.stack([np.sin(phase), np.cos(phase), np.sin(2 * phase)])
        out = []
        for angle, shape in zip((swing, swing - flexion), self.shapes):
            turn = Rotation.from_rotvec(np.stack([zero, 0.3 * angle, angle], axis=1))
            moved = np.stack([turn.apply(x) for x in shape], axis=1) + place.T[:, None]
            out.append(self.turn.apply(moved.reshape(-1, 3)).reshape(moved.shape) + self.centre)
        return np.stack(out, axis=1)

    def _learned(self) -> tuple[Body, ...]:
        """Shapes as the calibrated rig, with its errors, sees them in a healthy walk."""
        truth = self._moving(1.0, 0.0)
        seen = intersected(self.rig, self.project(truth, self.errors), np.zeros(18))
        bodies = []
        for k, name in enumerate(('femur', 'tibia')):
            shape = self.shapes[k] - self.shapes[k].mean(axis=0)
            aligned = []
            for x in seen[:, k]:
                arm = x - x.mean(axis=0)
                aligned.append(Rotation.align_vectors(shape, arm)[0].apply(arm))
            xyz = np.mean(aligned, axis=0) + self.rng.normal(0, SHAPE_SD_MM, (4, 3))
            bodies.append(Body(name, 10 * k + np.arange(4), xyz, np.full(4, SHAPE_SD_MM)))
        return tuple(bodies)

    def project(self, points: np.ndarray, errors: np.ndarray) -> np.ndarray:
        """Image points (..., F, 2) of points (T, ..., 3) with errors (18,) or (T, 18)."""
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

    def _frames(self, errors: np.ndarray) -> dict[str, list[Frame]]:
        """Frames with noise, false matches and errors of the correction."""
        uv = self.project(self.points, errors).reshape(EXPOSURES, 8, 2, 2)
        uv = uv + np.stack([field(uv[..., f, :]) for f, field in enumerate(self.fields)], axis=-2)
        uv += self.rng.normal(0, NOISE_PX, uv.shape)
        false = self.rng.random(uv.shape[:3]) < FALSE_SHARE
        uv[false] = self.rng.uniform(0, 1023, (np.count_nonzero(false), 2))
        ids = np.concatenate([body.target_id for body in self.bodies])
        frames: dict[str, list[Frame]] = {name: [] for name in NAMES}
        for f, name in enumerate(NAMES):
            for t, of_time in enumerate(uv[:, :, f]):
                on = ((of_time >= 0) & (of_time <= 1023)).all(axis=1)
                sigma = np.full(np.count_nonzero(on), NOISE_PX)
                frame = Frame(name, t, ids[on], of_time[on], SIZE, sigma, stamp_ns=1 + 20 * t)
                frames[name].append(frame)
        return frames

    def orientation(self) -> RigOrientation:
        """Return the rig as it was calibrated."""
        ids = tuple(one.calibration_id for one in self.calibrations().values())
        return replace(self.rig.orientation(), covariance=self.covariance, calibration_ids=ids)

    def calibrations(self) -> dict[str, FluoroscopeCalibration]:
        """Calibrations that correct nothing, with the claimed error of a correction."""
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
        """Points (n, 3) of a grid that both fluoroscopes see after the bump."""
        axis = np.arange(-200, 201, STEP_MM)
        grid = np.stack(np.meshgrid(axis, axis, axis), axis=-1).reshape(1, -1, 3)
        uv = self.project(grid, self.errors + self.change)[0]
        return np.asarray(grid[0][((uv >= 0) & (uv <= 1023)).all(axis=(1, 2))])

    def heal(self) -> HealingOutcome:
        """Heal the rig."""
        return heal_rig(self.frames, self.calibrations(), self.orientation(), self.bodies)


class Field:
    """A smooth error of the correction of an image, of CORRECTION_PX."""

    def __init__(self, rng: np.random.Generator, waves: int = 30) -> None:
        self.wave = rng.normal(0, 1 / 100, (waves, 2))  # some 100 px until it is another one
        self.phase = rng.uniform(0, 2 * np.pi, (2, waves))
        self.size = CORRECTION_PX * np.sqrt(2 / waves)

    def __call__(self, uv: np.ndarray) -> np.ndarray:
        """Errors (..., 2) [px] at pixels (..., 2)."""
        angle = uv @ self.wave.T
        return self.size * np.stack([np.sin(angle + one).sum(-1) for one in self.phase], axis=-1)


def intersected(rig: Rig, uv: np.ndarray, errors: np.ndarray) -> np.ndarray:
    """Points (..., 3) from image points (..., F, 2), by a rig with errors (18,)."""
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


@dataclass(frozen=True)
class Result:
    """Of one recording."""

    verdict: str
    changed_meanwhile: bool
    nse: float = np.nan  # of the six parameters of b, a mean
    error_mm: float = np.nan  # RMS of the distance in the field, after the best rigid motion
    claimed_mm: float = np.nan
    error_there_mm: float = np.nan  # where the markers were
    claimed_there_mm: float = np.nan


def measure(case: Case, seed: int) -> Result:
    """Heal a recording and compare the rig with the true one."""
    knee = Knee(case, seed)
    outcome = knee.heal()
    result = Result(outcome.verdict, outcome.changed_meanwhile)
    if outcome.healed is None or outcome.healed.drift:
        return result
    true = knee.errors + knee.change
    estimated = outcome.healed.changes.ravel()
    error = (estimated - true)[9:15]
    covariance = outcome.orientation.covariance[9:15, 9:15]
    field, there = knee.field(), knee.points[::10].reshape(-1, 3)
    return replace(
        result,
        nse=float(error @ np.linalg.solve(covariance, error)) / 6,
        error_mm=_error(knee, field, estimated, true),
        claimed_mm=_claimed(outcome, field),
        error_there_mm=_error(knee, there, estimated, true),
        claimed_there_mm=_claimed(outcome, there),
    )


def _claimed(outcome: HealingOutcome, points: np.ndarray) -> float:
    """RMS distance of points (n, 3) that the covariance of the healed rig claims [mm]."""
    return float(np.sqrt(3) * rig_errors(outcome.orientation, points).place_mm)


def _error(knee: Knee, points: np.ndarray, estimated: np.ndarray, true: np.ndarray) -> float:
    """RMS distance of points (n, 3) by the estimated rig after the best rigid motion [mm]."""
    found = intersected(knee.rig, knee.project(points[None], true)[0], estimated)
    one = found - found.mean(axis=0)
    other = points - points.mean(axis=0)
    rest = Rotation.align_vectors(other, one)[0].apply(one) - other
    return float(np.sqrt(np.mean(np.sum(rest**2, axis=1))))


def rms(values: Iterable[float]) -> float:
    """Root mean square."""
    return float(np.sqrt(np.mean(np.square(list(values)))))


CASES = (*(Case(motion) for motion in MOTIONS), *(Case(motion, True) for motion in MOTIONS))


def row_of(case: Case, seeds: int) -> list[str]:
    """Row of the table: verdicts of a case, and errors of the rigs that pass."""
    found = []
    for seed in range(seeds):
        found.append(measure(case, seed))
        print(case, seed, found[-1], flush=True)
    passed = [one for one in found if one.verdict == 'pass']
    name = f'{case.motion}{", bumped halfway" if case.halfway else ""}'
    row = [name, str(len(passed)), str(sum(one.changed_meanwhile for one in found))]
    compared = [one for one in passed if np.isfinite(one.nse)]
    if case.halfway or not compared:
        return [*row, *([''] * 6)]
    names = ('error_there_mm', 'claimed_there_mm', 'error_mm', 'claimed_mm')
    sizes = [f'{rms(getattr(one, name) for one in compared):.3f}' for name in names]
    ratio = rms(one.error_mm / one.claimed_mm for one in compared)
    nse = np.mean([one.nse for one in compared])
    return [*row, f'{nse:.2f}', *sizes, f'{ratio:.2f}']


TEXT = """
### In the whole common field

Generated by `python -m benchmarks.healing_field --seeds {seeds}`: {seeds} recordings each of a
knee, two bodies of four markers, with {exposures} exposures in 2 s. The rig is bumped by 0.5
degrees and 5 mm, before the recording or halfway, and healed by the whole job. Shapes were
learned to {shape} mm in a healthy walk through the same calibrated rig, with its errors; the
correction has a smooth error of {correction} px. Errors are distances after the best rigid motion,
RMS, where the markers were and on a grid of {step:.0f} mm in all that both fluoroscopes see;
claimed: from the covariance of the healed rig. Of rigs that pass.

{rows}
"""


def main() -> None:
    """Measure and write the section."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--seeds', type=int, default=10, help='recordings of a case')
    arguments = parser.parse_args()
    with threadpool_limits(1):
        rows = [row_of(case, arguments.seeds) for case in CASES]
    header = (
        'knee|pass|told that the rig changed during the recording|NSE|error at the markers [mm]'
        '|claimed [mm]|error in the field [mm]|claimed [mm]|error / claimed'
    )
    text = TEXT.format(
        rows=table(header, rows),
        seeds=arguments.seeds,
        exposures=EXPOSURES,
        shape=SHAPE_SD_MM,
        correction=CORRECTION_PX,
        step=STEP_MM,
    )
    write_section(Path('docs/how_good.md'), 'healing-field', text)


if __name__ == '__main__':
    main()
