# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Compare calibrations of two recordings of a rig: how often is a change found significant?

Each pair has one rig, one phantom and one survey, and two recordings with their own poses, noise
and false matches. With --change, the field of the second recording differs by so many pixels, and
the fraction found significant is the power of the comparison.
"""

import argparse
import json
import multiprocessing
import sys
from pathlib import Path

import numpy as np
from scipy.stats import binomtest

from fluoro_calib_ros.checks.comparison import compare_calibrations
from fluoro_calib_ros.errors import DataError
from fluoro_calib_ros.estimation.options import CalibrationOptions, CalibrationRequest
from fluoro_calib_ros.jobs.calibration import run_calibration

from .cases import CASES
from .fields import Magnetic
from .run import chosen, read
from .scene import NAMES, draw

FIRST = 1001
# Excluded: distortion or phantom differs between exposures, or the rig is not a good one.
LEFT_OUT = ('varying', 'turning', 'survey', 'models')


def compared(case, seed, change=0.0):
    """Return one dict per fluoroscope of a pair, or a single dict with the refusal."""
    out = {'case': case.name, 'seed': seed, 'change': change}
    try:
        first = _calibrated(draw(case, seed, 1), case)
        second = _calibrated(draw(case, seed, 2, Magnetic(change) if change else None), case)
        found = [compare_calibrations(first[name], second[name]) for name in NAMES]
    except DataError as error:
        return [{**out, 'said': str(error)}]
    return [
        {
            **out,
            'fluoroscope': one.fluoroscope,
            'share': float(one.significant.mean()),
            'field': one.field_changed,
            'interior': one.interior_changed,
            'interior_ratio': one.interior_test / one.interior_limit,
            'nse': float(np.mean(one.size**2 / (2 * one.sd**2))),
            'rms_px': one.rms_px,
        }
        for one in found
    ]


def _calibrated(scene, case):
    request = CalibrationRequest(scene.frames(), scene.phantom, CalibrationOptions(**case.options))
    return run_calibration(request).calibrations


def main(arguments=None):
    """Entry point."""
    parser = argparse.ArgumentParser(prog='python -m benchmarks.pathologies.pairs')
    parser.add_argument('--seeds', type=int, default=4, help='pairs of each case (default: 4)')
    parser.add_argument('--first', type=int, default=FIRST, help=f'first seed (default: {FIRST})')
    parser.add_argument('--change', type=float, default=0.0, help='of the field [px]')
    parser.add_argument('--cases', nargs='+', default=[], help='names of cases or groups')
    parser.add_argument('--processes', type=int, default=1)
    parser.add_argument('--results', type=Path, default=Path('.build/pairs.jsonl'))
    options = parser.parse_args(arguments)
    cases = chosen(options.cases)
    if not options.cases:
        cases = [case for case in cases if case.group not in LEFT_OUT]
    jobs = [
        (CASES.index(case), seed, options.change)
        for seed in range(options.first, options.first + options.seeds)
        for case in cases
    ]
    options.results.parent.mkdir(parents=True, exist_ok=True)
    options.results.write_text('')
    with multiprocessing.get_context('spawn').Pool(options.processes) as pool:
        for number, rows in enumerate(pool.imap_unordered(_one, jobs), 1):
            with options.results.open('a') as file:
                file.writelines(json.dumps(row) + '\n' for row in rows)
            print(f'{number}/{len(jobs)} {rows[0]["case"]}', file=sys.stderr, flush=True)
    print(table(read(options.results)))


def table(rows):
    """Return the results of the comparison as text, for all cases and by case."""
    good = [row for row in rows if 'said' not in row]
    lines = [f'{len(good)} comparisons, {len(rows) - len(good)} pairs refused']
    for name in ('field', 'interior'):
        count = sum(row[name] for row in good)
        low, high = binomtest(count, len(good)).proportion_ci()
        lines.append(
            f'{name}: {count} significant, {count / len(good):.1%} '
            f'(95 % interval {low:.1%} to {high:.1%})'
        )
    lines.append(f'NSE of the difference: median {np.median([r["nse"] for r in good]):.2f}')
    for case in dict.fromkeys(row['case'] for row in good):
        of_case = [row for row in good if row['case'] == case]
        nse, share = (np.mean([row[key] for row in of_case]) for key in ('nse', 'share'))
        counts = [sum(row[key] for row in of_case) for key in ('field', 'interior')]
        lines.append(
            f'{case}: field {counts[0]}, interior {counts[1]} of {len(of_case)}; '
            f'NSE {nse:.2f}, {share:.1%} of the area'
        )
    return '\n'.join(lines)


def _one(job):
    index, seed, change = job
    return compared(CASES[index], seed, change)


if __name__ == '__main__':
    main()
