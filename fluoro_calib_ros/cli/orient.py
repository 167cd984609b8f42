# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""fluoro-calib orient."""

from __future__ import annotations

import argparse

from ..errors import DataError, ErrorsAt
from ..findings import Kind, first_few, sentences
from .arguments import (
    add_bag_options,
    add_shared,
    add_source,
    read_calibrated_exposures,
)
from .output import print_notes, print_result

NAME = 'orient'
HELP = 'Orient the rig from a capture of the phantom, which stands still in the rig frame.'
EXAMPLE = 'fluoro-calib orient capture --phantom phantom.csv --calibration result'
MAX_EXPOSURES = 10**6


def exposure_numbers(text: str) -> set[int]:
    """Parse 1,4-6 as a set of exposure numbers."""
    exposures: set[int] = set()
    try:
        for part in text.split(','):
            low, _, high = part.partition('-')
            numbers = range(int(low), int(high or low) + 1)
            if not numbers or numbers[0] < 0 or len(numbers) > MAX_EXPOSURES:
                raise ValueError
            exposures.update(numbers)
    except (ValueError, OverflowError):
        raise argparse.ArgumentTypeError(
            f'{text!r} is not a list of exposures, such as 1,4-6'
        ) from None
    return exposures


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    source = add_source(parser, 'image size of a file [px] (default: that of the calibration)')
    add_bag_options(parser)
    add_shared(parser, 'calibration')
    add_shared(source, 'phantom')
    parser.add_argument(
        '--frame-id',
        default='rig',
        metavar='NAME',
        help='name of the rig frame, defined by the phantom in the capture (default: rig)',
    )
    parser.add_argument(
        '--exposures',
        type=exposure_numbers,
        metavar='N,N-M',
        help='numbers of the frames in which the phantom stands in the rig frame (default: all)',
    )
    add_shared(parser, 'exit_zero')


def run(arguments: argparse.Namespace) -> bool:
    """Orient the rig and write DIR/rig_orientation.npz; return whether the targets meet.

    Raises DataError.
    """
    from ..io.result_document import orientation_document
    from ..jobs.orientation import orient
    from ..jobs.result_folder import belongs_to, replace_orientation, saved_orientation
    from ..report.tables import orientation_text

    survey, recording, calibrations = read_calibrated_exposures(arguments)
    frames = recording.frames
    if arguments.exposures is not None:
        known = {frame.number for view_frames in frames.values() for frame in view_frames}
        missing = sorted(arguments.exposures - known)
        if missing:
            raise DataError(
                f'{arguments.source}: no fluoroscope has the exposures {first_few(missing)} of '
                '--exposures'
            )
        frames = {
            name: [frame for frame in view_frames if frame.number in arguments.exposures]
            for name, view_frames in frames.items()
        }
    saved = saved_orientation(arguments.calibration)
    if saved is not None and not belongs_to(saved, calibrations):
        saved = None
    with ErrorsAt(arguments.source):
        outcome = orient(frames, survey.phantom, calibrations, arguments.frame_id, present=saved)
    path = replace_orientation(arguments.calibration, outcome.orientation)
    print_notes(outcome.findings)
    document = {
        'out': path,
        **orientation_document(outcome.orientation),
        'targets': outcome.targets,
        'rms_mm': outcome.rms_mm,
        'notes': sentences(outcome.findings),
    }
    lines = [orientation_text(outcome.orientation)]
    if outcome.targets:
        lines.append(
            f'{outcome.targets} targets intersected again lie {outcome.rms_mm:.3f} mm from '
            'their survey (RMS)'
        )
    lines.append(f'written to {path}')
    reconstruct = ('reconstruct', 'MEASURED', '--calibration', arguments.calibration)
    met = not any(finding.kind is Kind.RAYS_DO_NOT_MEET for finding in outcome.findings)
    next_step = (*reconstruct, '--out', 'points.csv') if met else ()
    print_result(arguments, document, '\n'.join(lines), next_step)
    return met
