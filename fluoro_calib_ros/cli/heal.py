# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""fluoro-calib heal."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from .arguments import (
    add_oriented_source,
    add_shared,
    input_paths,
    options_of,
    read_oriented_source,
)
from .output import ProgressBar, print_findings, print_notes, print_result, styled_verdict

if TYPE_CHECKING:
    from ..jobs.healing import HealingOutcome

NAME = 'heal'
HELP = 'Identify from ordinary markers what has changed in a rig, and recalibrate it.'
EXAMPLE = 'fluoro-calib heal rig/walking --calibration result --out healed'


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    from ..jobs.healing import HealingOptions

    add_oriented_source(parser, HealingOptions)
    parser.add_argument(
        '--bodies',
        type=Path,
        metavar='FILE',
        help='shapes of the bodies as they were while the rig was healthy: shapes.csv of '
        'fluoro-calib bodies (default: those that were learned with the calibration, by '
        'fluoro-calib bodies --learn or by calibration_node)',
    )
    add_shared(
        parser,
        'out',
        help='folder to write: calibrations and orientation as they are now, healing.json',
    )
    add_shared(parser, 'exit_zero')


def run(arguments: argparse.Namespace) -> bool:
    """Heal a rig; return whether the verdict is pass. Raises DataError."""
    from ..errors import ErrorsAt
    from ..io.bodies import read_bodies
    from ..io.folder import check_output_folder
    from ..jobs.healing import (
        HEALING_FOLDER,
        HealingOptions,
        heal_rig,
        healing_document,
        save_healing,
    )
    from ..jobs.learning import learned_for

    check_output_folder(arguments.out, HEALING_FOLDER, input_paths(arguments))
    bodies = read_bodies(arguments.bodies) if arguments.bodies else ()
    recording, calibrations, orientation = read_oriented_source(arguments)
    learned = None if bodies else learned_for(arguments.calibration, orientation)
    print_notes(recording.notes)
    options = options_of(HealingOptions, arguments)
    with ErrorsAt(arguments.source), ProgressBar('heal', 'step') as bar:
        outcome = heal_rig(
            recording.frames,
            calibrations,
            orientation,
            bodies=bodies if learned is None else learned.bodies,
            options=options,
            progress=bar,
        )
    if outcome.healed is not None:
        save_healing(arguments.out, outcome, orientation, learned)
    if outcome.noise is not None:
        print_notes([f'{arguments.source}: {outcome.noise.sentence}'])
    print_findings(outcome.findings, 'changed: ')
    document = healing_document(outcome, orientation)
    print_result(arguments, document, '\n'.join(_lines(arguments, outcome)))
    return outcome.verdict == 'pass'


def _lines(arguments: argparse.Namespace, outcome: HealingOutcome) -> list[str]:
    """Return lines about the changes, the resulting accuracy and the verdict."""
    from ..healing.diagnosis import OF_RIG
    from ..jobs.healing import CHANGED_MEANWHILE

    lines = []
    healed = outcome.healed
    is_changed = any(change.cause in OF_RIG for change in outcome.diagnosis.changes)
    if outcome.changed_meanwhile:
        lines.append(CHANGED_MEANWHILE)
    if healed is None or not is_changed:
        is_evident = is_changed or outcome.changed_meanwhile
        prefix = '' if is_evident else 'no change of the rig is evident: '
        caveat = 'its sd include an undetected knock and an undetected drift of the distortion'
        conclusion = 'nothing is written' if healed is None else caveat
        lines.append(f'{prefix}the calibration stays as it was, {conclusion}')
    if healed is not None:
        for f, name in enumerate(outcome.orientation.fluoroscopes):
            if healed.changes[f].any():
                lines.append(f'{name}: {_change(healed.changes[f], healed.sd[f])}')
            if f in healed.drift:
                lines.append(f'{name}: its correction has changed')
        after, before = (
            f'{errors.place_mm:.3f} mm, scale {1e6 * errors.scale:.0f} ppm'
            for errors in (outcome.after, outcome.before)
        )
        lines.append(f'points relative to each other: sd {after} (as calibrated {before})')
        lines.append(f'written to {arguments.out}')
    lines.append(outcome.common_motion.sentence)
    if outcome.unseen_distortion.passed:  # otherwise it is one of the checks that follow
        lines.append(outcome.unseen_distortion.sentence)
    lines += [check.sentence for check in outcome.checks if not check.passed]
    lines.append(styled_verdict(f'Verdict: {outcome.verdict}', outcome.verdict))
    return lines


def _change(value: NDArray[np.float64], sd: NDArray[np.float64]) -> str:
    """Return the changes of an orientation with their standard deviations, as text."""
    parts = []
    if value[:6].any():
        shift = ', '.join(f'{v:.2f} (sd {s:.2f})' for v, s in zip(value[:3], sd[:3]))
        rotation = ', '.join(
            f'{v:.3f} (sd {s:.3f})' for v, s in zip(np.degrees(value[3:6]), np.degrees(sd[3:6]))
        )
        parts.append(f'source moved by {shift} mm, sensor turned by {rotation} degrees')
    if value[6:8].any():
        shift = ', '.join(f'{v:.2f} (sd {s:.2f})' for v, s in zip(value[6:8], sd[6:8]))
        parts.append(f'principal point moved by {shift} px')
    if value[8]:
        parts.append(f'principal distance changed by {value[8]:.1f} (sd {sd[8]:.1f}) px')
    return '; '.join(parts)
