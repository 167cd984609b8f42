"""How often the verdict on a calibration is right: false alarms on good rigs, and faults of a
given size found.

Every case draws virtual rigs with one fluoroscope, calibrates it and validates the calibration.
The rows are kept in a file, so that a run that was stopped goes on where it ended. Prints the
tables of docs/verdict.md.
"""

import argparse
import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

from fluoro_calib_ros.calibration.calibrate import calibrate
from fluoro_calib_ros.calibration.options import CalibrationOptions
from fluoro_calib_ros.calibration.request import CalibrationRequest
from fluoro_calib_ros.exposures.phantom import Phantom
from fluoro_calib_ros.report.tables import markdown_table
from fluoro_calib_ros.simulation.exposures import simulate_exposures
from fluoro_calib_ros.simulation.rig import virtual_rig
from fluoro_calib_ros.validation.verdict import validate

FIRST_SEED = 5018  # rigs from which no limit was set
RIPPLE_PX = 80.0  # width of the local ripple that comes in the middle of the exposures
# case: what is wrong, its size, exposures, model (None: the one asked for); how many rigs of it
# are drawn
CASES = {
    'good, 15 exposures': (None, 0, 15, None, 30),
    'good, 8 exposures': (None, 0, 8, None, 6),
    'good, 25 exposures': (None, 0, 25, None, 2),
    'no correction model': (None, 0, 15, 'none', 3),
    'ripple of 1 px from the middle on': ('drift', 1.0, 15, None, 3),
    'ripple of 0.5 px from the middle on': ('drift', 0.5, 15, None, 3),
    'bead 3 mm off its survey': ('bead', 3.0, 15, None, 3),
    'bead 1 mm off its survey': ('bead', 1.0, 15, None, 3),
    'survey twice as bad as its sd': ('survey', 2.0, 15, None, 3),
    'phantom moved 1 mm in an exposure': ('blur', 1.0, 15, None, 3),
}
CHECKS = (
    'halves',
    'whiteness',
    'worst_area',
    'drift',
    'held_out',
    'exposures',
    'beads',
    'distances',
)


def scene(seed, fault, size, exposures):
    """Frames of a fluoroscope and its phantom, with a fault of a size."""
    rig = virtual_rig(seed, names=('a',))
    frames = simulate_exposures(rig, exposures, seed).frames['a']
    phantom = rig.phantom
    rng = np.random.default_rng([seed, 4])
    if fault == 'drift':
        frames = with_ripple(frames, size, rng.uniform(350, 650, 2))
    elif fault == 'bead':
        xyz = phantom.xyz_mm.copy()
        counts = np.bincount(np.concatenate([f.target_id for f in frames]), minlength=504)
        direction = rng.normal(size=3)
        xyz[rng.choice(np.flatnonzero(counts[1:] >= 5))] += (
            size * direction / np.linalg.norm(direction)
        )
        phantom = Phantom(phantom.target_id, xyz, phantom.sd_mm)
    elif fault == 'survey':
        phantom = Phantom(
            phantom.target_id, rig.true_mm + size * (phantom.xyz_mm - rig.true_mm), phantom.sd_mm
        )
    elif fault == 'blur':  # half of the targets of an exposure were found before it moved
        number = int(rng.integers(exposures))
        uv = frames[number].uv.copy()
        uv[rng.random(len(uv)) < 0.5] += size * 2.67 * np.array([0.8, 0.6])
        frames = [
            replace(f, uv=np.clip(uv, 0, 1023)) if i == number else f for i, f in enumerate(frames)
        ]
    return frames, phantom


def with_ripple(frames, height, middle):
    """Frames whose later half has a further local ripple [px]."""
    out = []
    for i, frame in enumerate(frames):
        bump = np.exp(-np.sum((frame.uv - middle) ** 2, axis=1) / (2 * RIPPLE_PX**2))
        shift = height * bump[:, None] * np.array([0.8, 0.6]) * (i >= len(frames) // 2)
        out.append(replace(frame, uv=np.clip(frame.uv + shift, 0, 1023)))
    return out


def measured(case, seed, model):
    """Row of a rig: verdict and, by check, value, limit and whether it passed."""
    fault, size, exposures, other, _ = CASES[case]
    frames, phantom = scene(seed, fault, size, exposures)
    options = CalibrationOptions(model=other or model)
    request = CalibrationRequest({'a': frames}, phantom, options)
    calibrations = calibrate({'a': frames}, phantom, options).calibrations
    found = validate(request, calibrations)
    return {
        'case': case,
        'seed': seed,
        'model': model,
        'kind': calibrations['a'].model.kind,
        'verdict': found.verdict,
        'findings': found.findings,
        'checks': {c.name: [c.value, c.limit, c.passed] for c in found.checks},
    }


def table(rows):
    """Markdown table: a line for each case, how many rigs failed, and by which checks."""
    lines = []
    for case in CASES:
        mine = [row for row in rows if row['case'] == case]
        if mine:
            failed = [sum(row['checks'][name][2] is False for row in mine) for name in CHECKS]
            lines.append([case, len(mine), sum(row['verdict'] == 'fail' for row in mine), *failed])
    return markdown_table(['case', 'rigs', 'fail', *CHECKS], lines)


def main():
    """Entry point."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        '--model',
        default=CalibrationOptions().model,
        help='correction model (default: that of calibrate)',
    )
    parser.add_argument(
        '--rows',
        type=Path,
        default=Path('verdict.jsonl'),
        help='file of the rows (default: %(default)s)',
    )
    parser.add_argument('--cases', help='cases that begin so (default: all)', default='')
    options = parser.parse_args()
    rows = (
        [json.loads(line) for line in options.rows.read_text().splitlines()]
        if options.rows.exists()
        else []
    )
    done = {(row['case'], row['seed']) for row in rows if row['model'] == options.model}
    rows = [row for row in rows if row['model'] == options.model]
    for case, (*_, count) in CASES.items():
        for seed in (
            range(FIRST_SEED, FIRST_SEED + count) if case.startswith(options.cases) else ()
        ):
            if (case, seed) not in done:
                rows.append(measured(case, seed, options.model))
                with open(options.rows, 'a', encoding='utf-8') as file:
                    file.write(json.dumps(rows[-1]) + '\n')
                print(
                    case,
                    seed,
                    rows[-1]['verdict'],
                    *rows[-1]['findings'],
                    sep=' | ',
                    file=sys.stderr,
                )
    print(table(rows))


if __name__ == '__main__':
    main()
