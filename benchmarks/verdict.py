# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Error rates of the verdict on a calibration: false alarms, and detected faults of a given size.

Every case simulates rigs with one fluoroscope, calibrates it and validates the calibration. The
results are stored in a file, so that an interrupted run continues where it stopped. Prints the
table of docs/how_good.md.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from fluoro_calib_ros.checks.verdict import validate
from fluoro_calib_ros.estimation.calibrate import calibrate
from fluoro_calib_ros.estimation.options import CalibrationOptions, CalibrationRequest
from fluoro_calib_ros.exposures.frame import Frame
from fluoro_calib_ros.exposures.phantom import Phantom
from fluoro_calib_ros.report.tables import markdown_table
from fluoro_calib_ros.simulation.rig import simulate_exposures, virtual_rig
from tools.sections import write_section

FIRST_SEED = 5018  # first seed of the rigs, which were not used to set a limit
RIPPLE_PX = 80.0  # width of the local ripple that appears in the middle of the exposures
PX_PER_MM = 2.67  # image displacement per displacement of the phantom
MAX_PX = 1023  # largest image coordinate


@dataclass(frozen=True)
class Case:
    """A fault, its size, and the rigs that have it.

    Attributes
    ----------
    fault : {'', 'drift', 'bead', 'survey', 'blur'}
    size : float
        Size in the unit of the fault: px, mm, multiples of the sd, mm.
    exposures : int
    model : str
        Correction model; '' for the one that the user selects.
    rigs : int
        Number of rigs.
    """

    fault: str = ''
    size: float = 0.0
    exposures: int = 15
    model: str = ''
    rigs: int = 3


CASES = {
    'good, 15 exposures': Case(rigs=30),
    'good, 8 exposures': Case(exposures=8, rigs=6),
    'good, 25 exposures': Case(exposures=25, rigs=2),
    'no correction model': Case(model='none'),
    'ripple of 1 px from the middle on': Case('drift', 1.0),
    'ripple of 0.5 px from the middle on': Case('drift', 0.5),
    'bead 3 mm off its survey': Case('bead', 3.0),
    'bead 1 mm off its survey': Case('bead', 1.0),
    'survey twice as bad as its sd': Case('survey', 2.0),
    'phantom moved 1 mm in an exposure': Case('blur', 1.0),
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


def simulate(seed: int, case: Case) -> tuple[list[Frame], Phantom]:
    """Return the frames of a fluoroscope and the survey of its phantom, with the fault."""
    rig = virtual_rig(seed, names=('a',))
    frames = list(simulate_exposures(rig, case.exposures, seed).frames['a'])
    phantom = rig.phantom
    rng = np.random.default_rng([seed, 4])
    if case.fault == 'drift':
        frames = with_ripple(frames, case.size, rng.uniform(350, 650, 2))
    elif case.fault == 'bead':
        xyz = phantom.xyz_mm.copy()
        counts = np.bincount(np.concatenate([f.target_id for f in frames]), minlength=504)
        direction = rng.normal(size=3)
        offset = case.size * direction / np.linalg.norm(direction)
        xyz[rng.choice(np.flatnonzero(counts[1:] >= 5))] += offset
        phantom = Phantom(phantom.target_id, xyz, phantom.sd_mm)
    elif case.fault == 'survey':
        xyz = rig.true_mm + case.size * (phantom.xyz_mm - rig.true_mm)
        phantom = Phantom(phantom.target_id, xyz, phantom.sd_mm)
    elif case.fault == 'blur':
        # The phantom moved during an exposure, so half of its targets are displaced.
        number = int(rng.integers(case.exposures))
        uv = frames[number].uv.copy()
        uv[rng.random(len(uv)) < 0.5] += case.size * PX_PER_MM * np.array([0.8, 0.6])
        frames[number] = replace(frames[number], uv=np.clip(uv, 0, MAX_PX))
    return frames, phantom


def with_ripple(frames: Sequence[Frame], height: float, centre: np.ndarray) -> list[Frame]:
    """Add a local ripple of given height [px] to the second half of the frames."""
    out = []
    for i, frame in enumerate(frames):
        bump = np.exp(-np.sum((frame.uv - centre) ** 2, axis=1) / (2 * RIPPLE_PX**2))
        shift = height * bump[:, None] * np.array([0.8, 0.6]) * (i >= len(frames) // 2)
        out.append(replace(frame, uv=np.clip(frame.uv + shift, 0, MAX_PX)))
    return out


def measure(name: str, seed: int, model: str) -> dict[str, Any]:
    """Return the verdict on a rig, and value, limit and result of every check."""
    case = CASES[name]
    frames, phantom = simulate(seed, case)
    options = CalibrationOptions(model=case.model or model)
    request = CalibrationRequest({'a': frames}, phantom, options)
    calibrations = calibrate({'a': frames}, phantom, options).calibrations
    found = validate(request, calibrations)
    return {
        'case': name,
        'seed': seed,
        'model': model,
        'kind': calibrations['a'].model.kind,
        'verdict': found.verdict,
        'findings': list(map(str, found.findings)),
        'checks': {c.name: [c.value, c.limit, c.passed] for c in found.checks},
    }


def table(rows: Sequence[Mapping[str, Any]]) -> str:
    """Return a Markdown table with the number of rigs of each case that failed, also by check."""
    lines = []
    for name in CASES:
        of_case = [row for row in rows if row['case'] == name]
        if of_case:
            failed = [sum(row['checks'][c][2] is False for row in of_case) for c in CHECKS]
            verdicts = sum(row['verdict'] == 'fail' for row in of_case)
            lines.append([name, len(of_case), verdicts, *failed])
    return markdown_table(['case', 'rigs', 'fail', *CHECKS], lines)


def rigs_to_measure(prefix: str, done: Iterable[tuple[str, int]]) -> list[tuple[str, int]]:
    """Return case and seed of rigs that are not done, for cases with this prefix."""
    finished = set(done)
    rigs = [
        (name, FIRST_SEED + i)
        for name, case in CASES.items()
        if name.startswith(prefix)
        for i in range(case.rigs)
    ]
    return [rig for rig in rigs if rig not in finished]


def main() -> None:
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
        help='file of the results (default: %(default)s)',
    )
    parser.add_argument('--cases', help='prefix of the cases (default: all)', default='')
    parser.add_argument('--out', type=Path, help='page with the table, docs/how_good.md')
    options = parser.parse_args()
    rows = []
    if options.rows.exists():
        rows = [json.loads(line) for line in options.rows.read_text().splitlines()]
    rows = [row for row in rows if row['model'] == options.model]
    done = [(row['case'], row['seed']) for row in rows]
    for name, seed in rigs_to_measure(options.cases, done):
        row = measure(name, seed, options.model)
        rows.append(row)
        with open(options.rows, 'a', encoding='utf-8') as file:
            file.write(json.dumps(row) + '\n')
        print(name, seed, row['verdict'], *row['findings'], sep=' | ', file=sys.stderr)
    if options.out:
        write_section(options.out, 'error rates of the verdict', table(rows))
    else:
        print(table(rows))


if __name__ == '__main__':
    main()
