# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Benchmark of the lookup grid: points per second, frames of 30 points compared with scikit-learn,
build time, accuracy.

python -m benchmarks.lookup             all correction models
python -m benchmarks.lookup knn auto    these only
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from sklearn.neighbors import KNeighborsRegressor
from threadpoolctl import threadpool_limits

from fluoro_calib_ros.correction.grid import CorrectionGrid
from fluoro_calib_ros.correction.registry import selectable_models
from fluoro_calib_ros.estimation.calibrate import calibrate
from fluoro_calib_ros.estimation.options import CalibrationOptions
from fluoro_calib_ros.simulation.rig import Detection, simulate_exposures, virtual_rig

from .timing import section, timed

MODELS = tuple(name for name in selectable_models() if name != 'none')
POINTS = 2**20  # points in a large array
FRAME = 30  # points per frame
ROUNDS = 41  # calls of each function in a measurement
HEADER = [
    'model',
    'cell [px]',
    'maximum difference [px]',
    'build time',
    'points per second',
    f'{FRAME} points',
    f'{FRAME} points corrected',
    'KNeighborsRegressor.predict',
    'speed-up',
]


@dataclass(frozen=True)
class Figures:
    """Measured figures of a correction model.

    kind and k; cell_px; error_px: largest difference of a coordinate from the exact model at
    20,000 random pixels of the calibrated area, stated_px: as stated by the grid; build_s;
    points_per_s of a large array on one core; look_up_s, correct_s and predict_s of a frame, and
    ratio of predict_s to look_up_s.
    """

    kind: str
    k: int
    cell_px: float
    error_px: float
    stated_px: float
    build_s: float
    points_per_s: float
    look_up_s: float
    correct_s: float
    predict_s: float
    ratio: float


def mean_time(function: Callable[[], Any], calls: int) -> float:
    """Return the mean wall time [s] of a call."""
    began = time.perf_counter()
    for _ in range(calls):
        function()
    return (time.perf_counter() - began) / calls


def side_by_side(
    ours: Callable[[], Any], correct: Callable[[], Any], theirs: Callable[[], Any]
) -> tuple[float, float, float, float]:
    """Return median times [s] of three functions, and the median ratio of the third to the first.

    They are called in turn, so that other load on the machine affects all of them.
    """
    rounds = np.array(
        [
            [mean_time(ours, 100), mean_time(correct, 100), mean_time(theirs, 5)]
            for _ in range(ROUNDS)
        ]
    )
    return *np.median(rounds, axis=0), float(np.median(rounds[:, 2] / rounds[:, 0]))


def points_per_second(grid: CorrectionGrid, rng: np.random.Generator) -> float:
    """Return how many points of a large array one core looks up per second; median of 15 runs.

    The pixels are in random order, which is the worst case for the cache.
    """
    u, v = rng.uniform(-0.5, np.array(grid.image_size)[:, None] - 0.5, (2, POINTS))
    seconds = []
    for _ in range(15):
        began = time.thread_time()
        grid.look_up(u, v)
        seconds.append(time.thread_time() - began)
    return float(POINTS / np.median(seconds))


def measure(model: str) -> Figures:
    """Measure a correction model, given by name, on a calibration from 15 virtual exposures."""
    rig = virtual_rig(1)
    rng = np.random.default_rng(0)
    frames = {
        'a': simulate_exposures(rig, 15, 1, detection=Detection(beads=(130, 134))).frames['a']
    }
    calibration = calibrate(frames, rig.phantom, CalibrationOptions(model)).calibrations['a']
    exact = calibration.model
    grid, build_s = timed(lambda: CorrectionGrid(exact, calibration.image_size), 3)
    uv = rng.uniform(-0.5, np.array(calibration.image_size) - 0.5, (20_000, 2))
    found = grid.look_up(*uv.T)[0][:2].T
    error = np.abs(found - exact.predict(uv))[~exact.outside(uv)].max()

    calibration.prepare()
    frame = rng.uniform(80, 940, (FRAME, 2))
    u, v = np.ascontiguousarray(frame.T)
    # For a model without neighbours, compare with the regressor of the paper, k = 3.
    peer = KNeighborsRegressor(exact.k or 3, algorithm='kd_tree').fit(
        exact.train_uv, exact.train_duv
    )
    times = side_by_side(
        lambda: grid.look_up(u, v),
        lambda: calibration.correct_arrays(u, v),
        lambda: peer.predict(frame),
    )
    return Figures(
        exact.kind,
        exact.k,
        grid.cell_px,
        float(error),
        grid.error_px,
        build_s,
        points_per_second(grid, rng),
        *times,
    )


def row(f: Figures) -> list[str]:
    """Return a row of the table."""
    return [
        f'{f.kind}, k = {f.k}' if f.k else f.kind,
        f'{f.cell_px:g}',
        f'{f.error_px:.4f}',
        f'{f.build_s:.2f} s',
        f'{f.points_per_s / 1e6:.0f} million',
        f'{f.look_up_s * 1e6:.1f} us',
        f'{f.correct_s * 1e6:.1f} us',
        f'{f.predict_s * 1e6:.0f} us',
        f'{f.ratio:.0f}',
    ]


def lookup_section(models: Sequence[str] = MODELS) -> str:
    """Return the section on the lookup grid, by correction model."""
    return section(
        'Lookup of the correction',
        'A grid is built when a calibration arrives; looking up a point gives du, dv, standard '
        f'deviation and status. Points per second: {POINTS:,} pixels in random order, on one '
        'core. "Corrected" gives what the node needs: u, v, the standard deviation including that '
        'of the observation, and the status. KNeighborsRegressor of scikit-learn is timed in the '
        'same rounds, with the same training points and the same k (3 for a model without '
        'neighbours). The maximum difference from the exact model is taken over 20,000 random '
        'pixels of the calibrated area; knn is piecewise constant, and its lookups lie between '
        'the values at the corners of a cell.',
        HEADER,
        [row(measure(model)) for model in models],
    )


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(
        prog='python -m benchmarks.lookup', description=__doc__.splitlines()[0]
    )
    parser.add_argument(
        'model', nargs='*', help=f'correction models (default: {", ".join(MODELS)})'
    )
    models = parser.parse_args(arguments).model or MODELS
    with threadpool_limits(1):
        sys.stdout.write(lookup_section(models) + '\n')


if __name__ == '__main__':
    main()
