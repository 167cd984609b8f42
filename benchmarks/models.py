# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Compare correction models and scikit-learn regressors out of sample on virtual rigs.

python -m benchmarks.models            the table of docs/how_good.md
python -m benchmarks.models --rigs 3   on more rigs
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from sklearn.ensemble import RandomForestRegressor
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel
from sklearn.svm import SVR

from fluoro_calib_ros.correction.neighbours import KnnModel
from fluoro_calib_ros.estimation.calibrate import adjust_with_calibrations, calibrate
from fluoro_calib_ros.estimation.estimator import gauge_basis, gauge_coefficients
from fluoro_calib_ros.estimation.options import CalibrationOptions
from fluoro_calib_ros.estimation.result import CalibrationResult
from fluoro_calib_ros.exposures.frame import Frame
from fluoro_calib_ros.simulation.rig import (
    SimulatedExposures,
    StreamStart,
    VirtualRig,
    simulate_exposures,
    virtual_rig,
)
from tools.sections import write_section

from .timing import section, timed

TRAIN_EXPOSURES = 15
TEST_EXPOSURES = 40
TEST_SEED = 10**6
MAX_ROUNDS = 15  # for a scikit-learn regressor, since each round costs seven fits
GRID_PX = 16.0  # spacing of the pixels at which the correction is compared
NAME = 'a'  # fluoroscope

OURS = ('none', 'knn', 'local_linear', 'parametric', 'hybrid', 'collocation')
THEIRS: dict[str, Callable[[], Any]] = {
    'RandomForestRegressor(50, min_samples_leaf=3)': lambda: RandomForestRegressor(
        50, min_samples_leaf=3
    ),
    'SVR(C=10, gamma=2, epsilon=0.2)': lambda: SVR(C=10, gamma=2, epsilon=0.2),
    'GaussianProcessRegressor(25 * RBF(0.3) + WhiteKernel(0.06))': lambda: (
        GaussianProcessRegressor(
            ConstantKernel(25.0) * RBF(0.3) + WhiteKernel(0.06), optimizer=None
        )
    ),
}
HEADER = [
    'model',
    'object points [mm]',
    'ratio to known distortion',
    'correction [px]',
    'rounds',
    'seconds',
]


@dataclass(frozen=True)
class Scene:
    """A virtual rig with exposures of one fluoroscope for calibration and test."""

    rig: VirtualRig
    train: SimulatedExposures
    test: SimulatedExposures


@dataclass(frozen=True)
class Figures:
    """Measured figures of a model on one rig.

    points_mm: 3-D RMSE of the points of test exposures, adjusted with the calibration fixed;
    ratio: points_mm relative to known distortion; correction_px: RMS difference of a coordinate
    from the true distortion over the calibrated area, without the gauge; rounds; converged;
    seconds of the calibration.
    """

    points_mm: float
    ratio: float
    correction_px: float
    rounds: int
    converged: bool
    seconds: float


def make_scene(seed: int) -> Scene:
    """Return the scene of rig number seed."""
    rig = virtual_rig(seed)
    train = simulate_exposures(rig, TRAIN_EXPOSURES, seed)
    return Scene(
        rig,
        train,
        simulate_exposures(rig, TEST_EXPOSURES, TEST_SEED, start=StreamStart(number=1001)),
    )


def points_error(scene: Scene, frames: list[Frame], result: CalibrationResult) -> float:
    """Return the 3-D RMSE [mm] of object points of frames, adjusted with a fixed calibration."""
    found = adjust_with_calibrations({NAME: frames}, scene.rig.phantom, result.calibrations)
    true = scene.rig.true_mm[scene.rig.phantom.index(found.targets.target_id)]
    return float(np.sqrt(np.mean(np.sum((found.targets.xyz_mm - true) ** 2, axis=1))))


def undistorted(exposures: SimulatedExposures) -> list[Frame]:
    """Return frames of exposures as an undistorted image would show them."""
    pairs = zip(exposures.frames[NAME], exposures.undistorted[NAME])
    return [replace(frame, uv=uv) for frame, uv in pairs]


def known_distortion_error(scene: Scene) -> float:
    """Return the 3-D RMSE [mm] of the object points with exactly known distortion."""
    result = calibrate(
        {NAME: undistorted(scene.train)}, scene.rig.phantom, CalibrationOptions('none')
    )
    return points_error(scene, undistorted(scene.test), result)


def correction_errors(scene: Scene, result: CalibrationResult) -> tuple[np.ndarray, np.ndarray]:
    """Return grid pixels (n, 2) and errors (n, 2) [px] of the correction, gauge removed."""
    calibration = result.calibrations[NAME]
    true = next(f for f in scene.rig.fluoroscopes if f.name == NAME).distortion
    axes = [np.arange(0.0, size, GRID_PX) for size in calibration.image_size]
    uv = np.stack(np.meshgrid(*axes), axis=2).reshape(-1, 2)
    covered = np.concatenate([frame.uv for frame in scene.train.frames[NAME]])
    uv = uv[~KnnModel(1, covered, np.zeros_like(covered)).outside(uv)]
    error = calibration.model.predict(uv) - true(uv)
    basis = gauge_basis(uv, calibration.interior)
    return uv, error - basis @ gauge_coefficients(uv, error, calibration.interior)


def measure(scene: Scene, known_mm: float, options: CalibrationOptions) -> Figures:
    """Return the figures of a model on a scene; known_mm: error with known distortion."""
    frames = {NAME: scene.train.frames[NAME]}
    result, seconds = timed(lambda: calibrate(frames, scene.rig.phantom, options))
    points_mm = points_error(scene, scene.test.frames[NAME], result)
    return Figures(
        points_mm,
        points_mm / known_mm,
        float(np.sqrt(np.mean(correction_errors(scene, result)[1] ** 2))),
        len(result.history[NAME]),
        result.converged,
        seconds,
    )


def row(name: str, figures: list[Figures]) -> list[str]:
    """Return the row of a model: means over the rigs."""

    def mean(attribute: str) -> float:
        return float(np.mean([getattr(one, attribute) for one in figures]))

    stopped = '' if all(one.converged for one in figures) else ', stopped'
    return [
        f'`{name}`',
        f'{mean("points_mm"):.4f}',
        f'{mean("ratio"):.3f}',
        f'{mean("correction_px"):.3f}',
        f'{mean("rounds"):.0f}{stopped}',
        f'{mean("seconds"):.1f}',
    ]


def models_section(rigs: int = 2) -> str:
    """Return the section with the table of all models, means over rigs 1 to rigs."""
    scenes = [make_scene(seed) for seed in range(1, rigs + 1)]
    known = [known_distortion_error(scene) for scene in scenes]
    candidates = {name: CalibrationOptions(name) for name in OURS}
    for name, make in THEIRS.items():
        candidates[name] = CalibrationOptions(make(), max_iterations=MAX_ROUNDS)
    rows = []
    for name, options in candidates.items():
        pairs = zip(scenes, known)
        rows.append(row(name, [measure(scene, error, options) for scene, error in pairs]))
        sys.stderr.write(f'{" | ".join(rows[-1])}\n')
    return section(
        'Correction models',
        f'`python -m benchmarks.models`: means over {rigs} virtual rigs, one fluoroscope: '
        f'{TRAIN_EXPOSURES} exposures to calibrate, {TEST_EXPOSURES} others to test. Object '
        'points: 3-D RMSE of the test exposures, adjusted with the calibration fixed; with '
        'the distortion known exactly it is '
        f'{np.mean(known):.4f} mm. '
        'Correction: RMS difference of a coordinate from the true distortion over the calibrated '
        'area, without the part that interior and exterior orientation absorb. The regressors of '
        f'scikit-learn are stopped after {MAX_ROUNDS} rounds.',
        HEADER,
        rows,
    )


def main(arguments: list[str] | None = None) -> None:
    """Print the section, or write it into a page."""
    parser = argparse.ArgumentParser(
        prog='python -m benchmarks.models', description=(__doc__ or '').splitlines()[0]
    )
    parser.add_argument('--rigs', type=int, default=2, help='number of rigs (default: 2)')
    parser.add_argument('--out', type=Path, help='page with the section, docs/how_good.md')
    options = parser.parse_args(arguments)
    text = models_section(options.rigs)
    if options.out:
        write_section(options.out, 'models', text)
    else:
        sys.stdout.write(f'{text}\n')


if __name__ == '__main__':
    main()
