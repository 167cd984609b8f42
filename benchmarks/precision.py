# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Errors of many simulated calibrations relative to their stated standard deviations.

Every calibration has its own rig. Errors are relative to the truth in the gauge of the
calibration: a shift, scale or rotation of the whole image can be part of the orientation or of the
distortion, so the true distortion is transformed by the projective map that makes it orthogonal to
the gauge, like the estimated one.
"""

from __future__ import annotations

import argparse
import multiprocessing
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Protocol

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from fluoro_calib_ros.estimation.calibrate import calibrate
from fluoro_calib_ros.estimation.estimator import gauge_coefficients
from fluoro_calib_ros.estimation.options import CalibrationOptions
from fluoro_calib_ros.estimation.result import CalibrationResult
from fluoro_calib_ros.photogrammetry.rotations import matrix_from_quaternion, matrix_from_vector
from fluoro_calib_ros.simulation.rig import (
    Detection,
    SimulatedExposures,
    VirtualRig,
    simulate_exposures,
    virtual_rig,
)
from tools.sections import write_section

QUANTITIES = ('xp', 'yp', 'c', 'T', 'q', 'object points')
MARGIN_PX = 8.0  # distance of the grid from the edge of the image


class Fluoroscope(Protocol):
    """True interior orientation (3,) [px] and distortion of a fluoroscope."""

    @property
    def interior(self) -> np.ndarray:
        """Interior orientation xp, yp, c [px]."""

    @property
    def distortion(self) -> Callable[[np.ndarray], np.ndarray]:
        """Correction (n, 2) [px] of pixels (n, 2)."""


def truth_in_gauge(
    fluoroscope: Fluoroscope,
    uv: np.ndarray,
    interior: np.ndarray,
    fitted: np.ndarray | float = 0.0,
) -> tuple[np.ndarray, np.ndarray, Callable[[np.ndarray], np.ndarray]]:
    """Return true interior orientation, sensor rotation and correction in a calibration's gauge.

    uv (n, 2) are the image points over which its correction is orthogonal to the gauge, interior
    (3,) is its interior orientation [px]. If it is not orthogonal, fitted (n, 2) are its
    corrections of these points [px]; the true ones get the same component in the gauge.
    """

    def camera(k: np.ndarray) -> np.ndarray:
        return np.array([[k[2], 0, k[0]], [0, k[2], k[1]], [0, 0, 1.0]])

    back = np.linalg.inv(camera(fluoroscope.interior))

    def correction(x: np.ndarray, pixels: np.ndarray) -> np.ndarray:
        ideal = np.column_stack([pixels - fluoroscope.distortion(pixels), np.ones(len(pixels))])
        turned = ideal @ (camera(x[:3]) @ matrix_from_vector(x[3:]) @ back).T
        return pixels - turned[:, :2] / turned[:, 2:]

    found = least_squares(
        lambda x: gauge_coefficients(uv, correction(x, uv) - fitted, interior),
        np.concatenate([interior, np.zeros(3)]),
        x_scale=[1, 1, 1, 1e-3, 1e-3, 1e-3],
        xtol=1e-14,
    )
    return found.x[:3], matrix_from_vector(found.x[3:]), lambda pixels: correction(found.x, pixels)


def normalised(seed: int, exposures: int = 15, model: str = 'auto') -> dict[str, float]:
    """Return the errors of one calibration; see errors_of."""
    rig = virtual_rig(seed)
    simulated = simulate_exposures(rig, exposures, seed, detection=Detection(beads=(125, 139)))
    return errors_of(
        calibrate({'a': simulated.frames['a']}, rig.phantom, CalibrationOptions(model)),
        rig,
        simulated,
    )


def errors_of(
    job: CalibrationResult, rig: VirtualRig, simulated: SimulatedExposures
) -> dict[str, float]:
    """Return mean normalised squared errors of a calibration of fluoroscope a, by quantity.

    Also return 'interval', the fraction of the correction within its 95 % interval, and
    'correction', its RMSE [px].
    """
    run = job.runs['a']
    figures = job.fluoroscopes['a']
    fluoroscope = rig.fluoroscopes[0]
    interior, turn, true = truth_in_gauge(
        fluoroscope, run.measured.network.uv, run.after.parameters.interior[0]
    )
    out = dict(zip(QUANTITIES, ((figures.interior - interior) / figures.interior_sd) ** 2))
    squares: dict[str, list[np.ndarray]] = {'T': [], 'q': []}
    for e in figures.exposures:
        rotation, position = fluoroscope.exterior(simulated.poses[e.exposure - 1])
        squares['T'].append(((e.position_mm - position) / e.sd_mm) ** 2)
        error = Rotation.from_matrix(
            matrix_from_quaternion(e.quaternion_wxyz) @ (turn @ rotation).T
        ).as_rotvec()
        squares['q'].append((error / e.sd_rad) ** 2)
    out.update({name: float(np.mean(value)) for name, value in squares.items()})
    points = job.targets.xyz_mm - rig.true_mm[job.targets.target_id - 1]
    out['object points'] = float(
        np.mean(points**2 / np.diagonal(job.targets.covariance, axis1=1, axis2=2))
    )
    grid = np.stack(
        np.meshgrid(*[np.linspace(MARGIN_PX, 1023 - MARGIN_PX, 41)] * 2), axis=-1
    ).reshape(-1, 2)
    found = job.calibrations['a'].model.evaluate(grid)
    inside = ~found.outside
    out['interval'] = float(
        np.mean(np.abs(found.duv - true(grid))[inside] <= 1.96 * found.sd[inside, None])
    )
    out['correction'] = float(np.sqrt(np.mean((found.duv - true(grid))[inside] ** 2)))
    out['converged'] = job.converged
    out['sigma0'] = run.after.noise.scale
    return out


TEXT = """## Precision

Generated by `make precision` (`python -m benchmarks.precision`): {count} simulated calibrations,
each of a different rig, with {exposures} exposures of about 132 targets, noise 0.25 px, 1 % false
matches, model {model}. The mean of the normalised squared error, (error / stated standard
deviation)^2, is 1 if the standard deviation is honest, and larger if it is too optimistic. T and
q are the exterior orientations, three coordinates each. Errors are computed in the gauge of the
calibration.

{table}

The 95 % intervals of the correction cover the truth at {interval:.1f} % of the pixels (a grid
within the calibrated area); the RMSE of the correction is {correction:.4f} px. The mean of the
estimated noise scale is {sigma0:.4f} px (true value: 0.25 px). {converged} of {count}
calibrations converged.
"""


def main(arguments: Sequence[str] | None = None) -> None:
    """Entry point."""
    parser = argparse.ArgumentParser(prog='python -m benchmarks.precision', description=__doc__)
    parser.add_argument(
        '--count', type=int, default=200, help='number of calibrations (default: 200)'
    )
    parser.add_argument(
        '--first', type=int, default=1000, help='seed of the first rig (default: 1000)'
    )
    parser.add_argument(
        '--exposures', type=int, default=15, help='exposures of each (default: 15)'
    )
    parser.add_argument('--model', default='auto', help='correction model (default: auto)')
    parser.add_argument(
        '--out', type=Path, default=Path('docs/how_good.md'), help='page with the section'
    )
    options = parser.parse_args(arguments)
    start = time.monotonic()
    results = []
    with multiprocessing.get_context('spawn').Pool(2) as pool:
        seeds = range(options.first, options.first + options.count)
        jobs = [(seed, options.exposures, options.model) for seed in seeds]
        for result in pool.imap_unordered(_one, jobs):
            results.append(result)
            print(f'{len(results)} of {options.count}', file=sys.stderr, end='\r')
    lines = [
        '| quantity | mean normalised squared error | standard error |',
        '|---|---:|---:|',
    ]
    for name in QUANTITIES:
        values = np.array([r[name] for r in results])
        lines.append(
            f'| {name} | {values.mean():.3f} | {values.std() / np.sqrt(len(values)):.3f} |'
        )
    text = TEXT.format(
        count=len(results),
        exposures=options.exposures,
        model=options.model,
        table='\n'.join(lines),
        interval=100 * np.mean([r['interval'] for r in results]),
        converged=sum(r['converged'] for r in results),
        correction=np.sqrt(np.mean([r['correction'] ** 2 for r in results])),
        sigma0=np.mean([r['sigma0'] for r in results]),
    )
    write_section(options.out, 'precision', text)
    print(text)
    print(f'{time.monotonic() - start:.0f} s', file=sys.stderr)


def _one(arguments: tuple[int, int, str]) -> dict[str, float]:
    return normalised(*arguments)


if __name__ == '__main__':
    main()
