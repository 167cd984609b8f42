# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Compare errors of a correction at angles of a C-arm with its claimed covariance there.

Two comparisons for each case of the group `turning` whose angles are given:

- held: rays of all angles have the same interior orientation. The truth is in the gauge of the
  mean correction over the exposures, with a rotation of the sensor at each angle. This is what a
  correction states.
  A valid claim has a mean NSE of one, but a whole correction has few independent errors, so the
  NSE of a single calibration scatters. It is therefore compared with the NSE of errors that are
  drawn from the claimed covariance: its rank among them, and the fraction of them above 2.
- free: each angle has its own interior orientation, so the error has no component that an interior
  orientation can express. The claim excludes the variance of a change of interior orientation.
"""

import argparse
import json
import multiprocessing
import sys
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from fluoro_calib_ros.correction.angle_field import harmonics
from fluoro_calib_ros.correction.calibration_record import HARMONICS
from fluoro_calib_ros.correction.series import Functions
from fluoro_calib_ros.correction.terms import CUBIC
from fluoro_calib_ros.estimation import fluoroscope_terms
from fluoro_calib_ros.estimation.calibrate import calibrate
from fluoro_calib_ros.estimation.exposure_terms import TERMS, field_of
from fluoro_calib_ros.estimation.options import CalibrationOptions

from .angle_errors import errors_at_angles
from .cases import CASES
from .measure import COVER, calibrated_grid, test_angles
from .scene import NAMES, draw

FIRST = 101
MANY = 2.0  # limit of the NSE
DRAWS = 300
EVERY = 7  # step between the grid points at which errors are drawn
HELD_CASES = [case for case in CASES if case.group == 'turning' and case.angle_known]


@dataclass(frozen=True)
class Errors:
    """Errors (n, 2) of a correction and their stated standard deviations (n,) [px]."""

    error: np.ndarray
    sd: np.ndarray

    def figures(self, name):
        """Return NSE, cover95 and RMS of the errors."""
        normalised = np.abs(self.error) / self.sd[:, None]
        return {
            f'{name}_nse': float(np.mean(normalised**2)),
            f'{name}_cover': float(np.mean(normalised <= COVER)),
            f'{name}_px': float(np.sqrt(np.mean(self.error**2))),
            f'{name}_sd_px': float(np.sqrt(np.mean(self.sd**2))),
        }


@contextmanager
def recorded_fits():
    """Yield a list that collects (estimated, angles, fit) of fits to angles within the context."""
    original = fluoroscope_terms.fit_angles
    fits = []

    def fit_angles(estimated, angles):
        fit = original(estimated, angles)
        fits.append((estimated, angles, fit))
        return fit

    fluoroscope_terms.fit_angles = fit_angles
    try:
        yield fits
    finally:
        fluoroscope_terms.fit_angles = original


def without_interior(estimated, angles, fit):
    """Return an angle field without the variance of a change of the interior orientation."""
    count = len(fit.effects.mean) // HARMONICS
    kept = np.tile(np.arange(count) < TERMS, HARMONICS).astype(float)
    effects = replace(
        fit.effects,
        covariance=fit.effects.covariance * np.outer(kept, kept),
        mixed=fit.effects.mixed * kept,
    )
    return field_of(estimated, angles, effects)


def terms_of(estimated):
    """Return a function of pixels (n, 2) that evaluates the terms of exposures (n, 2, t)."""
    cubic = Functions(estimated.functions.image_size, CUBIC)
    values = cubic(estimated.uv)
    of_terms = estimated.terms.functions.values
    # Terms are cubic polynomials, so this solution is exact.
    matrices = [np.linalg.lstsq(values, of_terms[:, axis], rcond=None)[0] for axis in (0, 1)]
    return lambda uv: np.stack([cubic(uv) @ matrix for matrix in matrices], axis=1)


def drawn_nse(fit, calibration, grid, angles):
    """Return the NSE (DRAWS,) of errors drawn from the covariance that a correction claims.

    fit: (estimated, angles, fit) of `recorded_fits`; angles: at which errors are compared.
    """
    estimated, _, fit = fit
    series, count = len(fit.coefficients), len(fit.effects.mean)
    mixed = fit.effects.mixed
    claimed = np.block([[fit.covariance, mixed], [mixed.T, fit.effects.covariance]])
    size, axes = np.linalg.eigh((claimed + claimed.T) / 2)
    drawn = np.random.default_rng(1).normal(size=(series + count, DRAWS))
    drawn = axes @ (np.sqrt(np.maximum(size, 0))[:, None] * drawn)
    field = calibration.angle_field
    grid = grid[::EVERY]
    values = estimated.functions(grid)
    terms_at = terms_of(estimated)(grid)
    of_series = np.einsum('gm,amd->gad', values, drawn[:series].reshape(2, -1, DRAWS))
    of_effects = drawn[series:].reshape(HARMONICS, -1, DRAWS)
    mean = harmonics(field.angles).mean(axis=0)
    found = []
    for angle in angles:
        terms = np.tensordot(harmonics(angle) - mean, of_effects, axes=1)
        error = of_series + np.einsum('gak,kd->gad', terms_at, terms)
        sd = calibration.correction(grid, angle).sd
        found.append(np.mean((error / sd[:, None, None]) ** 2, axis=(0, 1)))
    return np.mean(found, axis=0)


def measured(case, seed):
    """Return the figures of one case with one seed."""
    scene = draw(case, seed)
    name = NAMES[0]
    with recorded_fits() as fits:
        result = calibrate(
            {name: scene.frames()[name]}, scene.phantom, CalibrationOptions(**case.options)
        )
    out = {'case': case.name, 'seed': seed}
    calibration = result.calibrations[name]
    if calibration.angle_field is None:
        return {**out, 'said': 'no field of the angle'}
    free_field = without_interior(*fits[-1])
    run = result.runs[name]
    uv = run.measured.network.uv[run.trained]
    grid = calibrated_grid(scene, calibration)
    angles = test_angles(scene, calibration)
    errors = errors_at_angles(scene, calibration, uv, grid, angles, free_field)
    for kind, found in errors.items():
        out |= Errors(*found).figures(kind)
    drawn = drawn_nse(fits[-1], calibration, grid, angles)
    out['rank'] = float(np.mean(drawn < out['held_nse']))
    out['drawn_above'] = float(np.mean(drawn > MANY))
    return out


def table(results):
    """Return the rows of a Markdown table: means and medians over the seeds, by case."""
    lines = [
        '| case | seeds | held: mean NSE | median | > 2 | > 2, drawn | free: mean NSE | median |'
    ]
    lines.append('|---|---:|---:|---:|---:|---:|---:|---:|')
    names = [case.name for case in HELD_CASES]
    for name in [*names, 'all']:
        own = [r for r in results if 'said' not in r and (name == 'all' or r['case'] == name)]
        if not own:
            continue
        cells = []
        for kind in ('held', 'free'):
            nse = [r[f'{kind}_nse'] for r in own]
            cells += [f'{np.mean(nse):.2f}', f'{np.median(nse):.2f}']
            if kind == 'held':
                shares = np.mean(np.array(nse) > MANY), np.mean([r['drawn_above'] for r in own])
                cells += [f'{100 * share:.0f} %' for share in shares]
        lines.append(f'| {name} | {len(own)} | {" | ".join(cells)} |')
    return '\n'.join(lines)


def main(arguments=None):
    """Entry point."""
    parser = argparse.ArgumentParser(prog='python -m benchmarks.pathologies.angle_claims')
    parser.add_argument('--seeds', type=int, default=10, help='seeds of each case (default: 10)')
    parser.add_argument('--first', type=int, default=FIRST, help=f'first seed (default: {FIRST})')
    parser.add_argument('--processes', type=int, default=2)
    parser.add_argument('--results', type=Path, help='JSON lines to write')
    options = parser.parse_args(arguments)
    seeds = range(options.first, options.first + options.seeds)
    jobs = [(index, seed) for seed in seeds for index in range(len(HELD_CASES))]
    results = []
    with multiprocessing.get_context('spawn').Pool(options.processes) as pool:
        for result in pool.imap_unordered(_one, jobs):
            results.append(result)
            print(json.dumps(result), file=sys.stderr, flush=True)
    if options.results:
        options.results.write_text(''.join(json.dumps(r) + '\n' for r in results))
    print(table(results))


def _one(job):
    index, seed = job
    return measured(HELD_CASES[index], seed)


if __name__ == '__main__':
    main()
