# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""fluoro-calib reconstruct."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn

from ..errors import ErrorsAt
from .arguments import (
    add_oriented_source,
    add_shared,
    input_paths,
    options_of,
    read_oriented_source,
    rigid_clusters,
)
from .output import (
    ProgressBar,
    print_note,
    print_notes,
    print_result,
    print_rig_evidence,
    print_unpaired,
)

if TYPE_CHECKING:
    from ..jobs.reconstruction import ReconstructionOutcome

NAME = 'reconstruct'
HELP = 'Reconstruct points in space from the image points of two or more fluoroscopes.'
EXAMPLE = 'fluoro-calib reconstruct bags/tracking --calibration result --out points.csv'


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    from ..jobs.reconstruction import ReconstructionOptions

    add_oriented_source(parser, ReconstructionOptions, reject='S')
    add_shared(parser, 'out', help='file to write', metavar='OUT.csv')
    parser.add_argument(
        '--figure',
        type=Path,
        metavar='FILE.png',
        help='draw the paths in space, when each target was found, and its sd',
    )
    add_shared(
        parser,
        'cluster',
        help="rigid cluster of targets, such as 'tibia: 1001 1002 1003', whose distances the "
        'drift watch also monitors; may be repeated',
    )
    parser.add_argument(
        '--no-drift-watch',
        action='store_true',
        help='do not watch for a drift of the calibration, which saves time',
    )


def check(arguments: argparse.Namespace, error: Callable[[str], NoReturn]) -> None:
    """Read the bodies; call error with a sentence for arguments that exclude each other."""
    from ..io.bags.mcap_file import is_bag

    arguments.bodies = rigid_clusters(arguments, error)
    if arguments.bodies and arguments.no_drift_watch:
        error('--cluster is for the drift watch, it cannot be used with --no-drift-watch')
    if arguments.bodies and not is_bag(arguments.source):
        error(
            '--cluster is for the drift watch, which needs the times of the exposures: '
            f'{arguments.source} is not a bag'
        )


def run(arguments: argparse.Namespace) -> None:
    """Reconstruct the points of a recording and write them. Raises DataError."""
    from ..io.access import write_bytes
    from ..io.bags.mcap_file import is_bag
    from ..io.bodies import write_reconstruction
    from ..io.folder import check_output_file
    from ..jobs.reconstruction import ReconstructionOptions, reconstruct

    inputs = input_paths(arguments)
    check_output_file(arguments.out, inputs)
    if arguments.figure is not None:
        check_output_file(arguments.figure, [*inputs, arguments.out])
    recording, calibrations, orientation = read_oriented_source(arguments)
    print_notes(recording.notes)
    frames = recording.frames
    options = options_of(
        ReconstructionOptions,
        arguments,
        drift_watch=not arguments.no_drift_watch,
        bodies=arguments.bodies,
        has_stamps=is_bag(arguments.source),
    )
    with ErrorsAt(arguments.source), ProgressBar('points', 'exposure') as bar:
        outcome = reconstruct(frames, calibrations, orientation, options, bar)
    write_reconstruction(arguments.out, outcome.frames, recording.names)
    if arguments.figure is not None:
        from ..report.figures import png_bytes

        write_bytes(arguments.figure, png_bytes(outcome.plot(recording.names)))
    print_unpaired(arguments.source, outcome.unpaired)
    print_rig_evidence(arguments.source, outcome, arguments.reject)
    for finding in outcome.lost_targets:
        print_note(f'{arguments.source}: {finding}')
    _print(arguments, outcome)


def _print(arguments: argparse.Namespace, outcome: ReconstructionOutcome) -> None:
    """Print the summary of a reconstruction."""
    from ..io.result_document import finding_document, orientation_document, rig_document

    counts = outcome.status_counts
    total = sum(counts.values())
    names = outcome.orientation.fluoroscopes
    document = {
        'out': str(arguments.out),
        'frames': len(outcome.frames),
        'incomplete': outcome.incomplete,
        'points': total,
        'status': counts,
        'unpaired': outcome.unpaired,
        **rig_document(outcome, outcome.frames[0].stamp_ns),
        'lost_targets': [finding_document(finding) for finding in outcome.lost_targets],
        'orientation': orientation_document(outcome.orientation),
    }
    by_status = ', '.join(f'{count} {name}' for name, count in counts.items() if count)
    frames = '1 frame' if len(outcome.frames) == 1 else f'{len(outcome.frames)} frames'
    lines = [f'{total} points of {frames} written to {arguments.out}: {by_status}']
    if outcome.incomplete:
        lines.append(
            f'{outcome.incomplete} of the frames without all fluoroscopes ({", ".join(names)})'
        )
    if outcome.drift:
        lines.append(f'drift watch: {outcome.drift.message}')
    c3d = arguments.out.with_suffix('.c3d')
    convert = ('convert', arguments.out, '--to', 'c3d', '--rate', 'HZ', '--out', c3d)
    print_result(arguments, document, '\n'.join(lines), convert)
