# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""fluoro-calib bodies."""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

from ..errors import DataError, ErrorsAt
from ..findings import Severity
from .arguments import (
    add_oriented_source,
    add_shared,
    input_paths,
    number_in,
    options_of,
    read_oriented_source,
)
from .output import (
    ProgressBar,
    print_findings,
    print_notes,
    print_result,
    print_rig_evidence,
    print_unpaired,
)

if TYPE_CHECKING:
    from ..jobs.bodies import BodiesOutcome

NAME = 'bodies'
HELP = 'Estimate the poses of bones from their markers, and the motion of joints, with their sd.'
EXAMPLE = (
    'fluoro-calib bodies rig/walking --bodies rig/bodies.csv --joints rig/joints.toml '
    '--calibration result --out motion'
)

NO_TIMES = 'the file does not contain the times of its exposures; give their rate, --rate HZ'
TIMES = 'the recording has the times of its exposures; --rate is for files without them'


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    from ..jobs.bodies import BodiesOptions

    add_oriented_source(parser, BodiesOptions, reject='S')
    parser.add_argument(
        '--bodies',
        required=True,
        type=Path,
        metavar='FILE',
        help='bodies and their markers, CSV body,marker,x,y,z,sd in mm; x, y, z and sd are empty '
        'where they are not known from CT',
    )
    parser.add_argument(
        '--joints', type=Path, metavar='FILE', help='joints between the bodies, TOML'
    )
    parser.add_argument(
        '--neutral',
        type=Path,
        metavar='RECORDING',
        help='another recording with all joints in neutral position, instead of the exposures '
        'that the joints file names',
    )
    add_shared(parser, 'out', help='folder to write')
    parser.add_argument(
        '--keep-shapes',
        action='store_true',
        help='use the coordinates of the markers as given, without estimating them',
    )
    parser.add_argument(
        '--learn',
        action='store_true',
        help='save the shapes of the bodies, recorded with a healthy rig, with the calibration: '
        'fluoro-calib heal identifies later changes from them',
    )
    parser.add_argument(
        '--report',
        action='store_true',
        help='write DIR/report.html: joints and bodies over time, with bands, and paths in space',
    )
    parser.add_argument(
        '--film',
        type=Path,
        metavar='IMAGES',
        help='radiographs of the recording, a bag or a folder with a folder for each fluoroscope; '
        'draw markers and axes of the bodies into them, DIR/film_<fluoroscope>.mp4',
    )
    parser.add_argument(
        '--rate',
        type=number_in(0.001, 1e6),
        metavar='HZ',
        help='rate of the exposures, for files without times',
    )
    add_shared(parser, 'exit_zero')


def check(arguments: argparse.Namespace, error: Callable[[str], NoReturn]) -> None:
    """Call error with a sentence for a neutral recording without joints."""
    if arguments.neutral is not None and arguments.joints is None:
        error('--neutral: there are no joints, give --joints')


def run(arguments: argparse.Namespace) -> bool:
    """Track the bodies of a recording; write poses and joints. Raises DataError.

    Returns whether the bodies are those of the recording, as far as the findings say.
    """
    from ..io.bodies import read_bodies, read_joints
    from ..io.folder import check_output_folder
    from ..io.versions import write_learned_shapes
    from ..jobs.bodies import (
        BODIES_FOLDER,
        BodiesOptions,
        Film,
        has_times,
        save_bodies,
        track_bodies,
    )
    from ..jobs.learning import learn_shapes

    check_output_folder(arguments.out, BODIES_FOLDER, input_paths(arguments))
    bodies = read_bodies(arguments.bodies)
    joints = read_joints(arguments.joints, bodies) if arguments.joints else ()
    recording, calibrations, orientation = read_oriented_source(arguments)
    print_notes(recording.notes)
    if has_times(recording.frames) == (arguments.rate is not None):
        raise DataError(f'{arguments.source}: {NO_TIMES if arguments.rate is None else TIMES}')
    neutral = None
    if arguments.neutral is not None:
        neutral_arguments = argparse.Namespace(**{**vars(arguments), 'source': arguments.neutral})
        neutral = read_oriented_source(neutral_arguments)[0].frames
    options = options_of(
        BodiesOptions,
        arguments,
        estimate_shapes=not arguments.keep_shapes,
        rate=arguments.rate,
        neutral=neutral,
    )
    observed = recording.frames, calibrations, orientation, bodies
    with ErrorsAt(arguments.source), ProgressBar('bodies', 'step') as bar:
        outcome = track_bodies(*observed, joints=joints, options=options, progress=bar)
    learned = None
    if arguments.learn:
        with ErrorsAt(arguments.source), ProgressBar('learned shapes', 'exposure') as bar:
            learned = learn_shapes(*observed, options=options, progress=bar)
    with ProgressBar('film') as bar:
        film = None
        if arguments.film is not None:
            views = orientation.subset(list(recording.frames))
            film = Film(arguments.film, calibrations, views, bar)
        save_bodies(arguments.out, outcome, arguments.report, film)
    if learned is not None:
        write_learned_shapes(arguments.calibration, learned)
        names = ', '.join(body.name for body in learned.bodies)
        print_notes([f'{arguments.calibration}: shapes of {names} are learned'])
    print_unpaired(arguments.source, outcome.unpaired)
    print_rig_evidence(arguments.source, outcome, arguments.reject)
    print_findings(outcome.findings, 'doubtful: ')
    _print(arguments, outcome)
    return all(finding.severity is not Severity.ERROR for finding in outcome.findings)


def _print(arguments: argparse.Namespace, outcome: BodiesOutcome) -> None:
    """Print a summary of the accuracy of poses and joints."""
    from ..io.result_document import finding_document, rig_document

    summary = outcome.summary()
    lines = [f'{len(outcome.exposures)} exposures, written to {arguments.out}']
    lines += [_body_line(name, figures) for name, figures in summary['bodies'].items()]
    for joint, angles in summary['joints'].items():
        lines += _joint_lines(joint, angles)
    if outcome.drift:
        lines.append(f'drift watch: {outcome.drift.message}')
    document = {
        'out': str(arguments.out),
        **summary,
        **rig_document(outcome, outcome.exposures[0].stamp_ns),
        'findings': [finding_document(finding) for finding in outcome.findings],
    }
    print_result(arguments, document, '\n'.join(lines))


def _body_line(name: str, figures: Mapping[str, Any]) -> str:
    """Return poses and shape of a body as text, without figures that are not known."""
    poses = 'no pose'
    if figures['poses']:
        poses = (
            f'{figures["poses"]} poses, sd {figures["sd_mm"]:.3f} mm and '
            f'{figures["sd_deg"]:.3f} degrees (medians)'
        )
    shape = {
        'condition number {:.0f} per m': figures['condition_per_m'],
        'mean error of the rigid body {:.3f} mm': figures['mean_error_mm'],
    }
    known = [text.format(value) for text, value in shape.items() if not math.isnan(value)]
    return f'{name}: ' + '; '.join(filter(None, [poses, ', '.join(known)]))


def _joint_lines(joint: str, angles: Mapping[str, Mapping[str, float]]) -> list[str]:
    """Return the ranges of the angles of a joint as lines of text."""
    if all(math.isnan(figures['range_deg']) for figures in angles.values()):
        return [f'{joint}: no angles: no exposure has poses of both bodies']
    return [
        f'{joint}: {name} {figures["least_deg"]:.1f} to {figures["most_deg"]:.1f} degrees, sd '
        f'{figures["sd_deg"]:.3f} (median)'
        for name, figures in angles.items()
    ]
