# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""fluoro-calib bodies."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ..errors import DataError, ErrorsAt
from .arguments import add_oriented_source, add_out, number_in, options_of, read_oriented_source
from .output import ProgressBar, print_findings, print_notes, print_result, print_unpaired

if TYPE_CHECKING:
    from ..jobs.bodies import BodiesOutcome

NAME = 'bodies'
HELP = 'Find the poses of bones from their markers, and the motion of joints, with their sd.'
EXAMPLE = (
    'fluoro-calib bodies rig/walking --bodies rig/bodies.csv --joints rig/joints.toml '
    '--calibration result --out motion'
)


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
    add_out(parser, 'folder to write')
    parser.add_argument(
        '--keep-shapes',
        action='store_true',
        help='take the coordinates of the markers as they are, do not estimate them anew',
    )
    parser.add_argument(
        '--figures',
        action='store_true',
        help='draw joints and bodies over time, with bands, into DIR/figures',
    )
    parser.add_argument(
        '--rate',
        type=number_in(0.001, 1e6),
        metavar='HZ',
        help='rate of the exposures, for files without times',
    )


def run(arguments: argparse.Namespace) -> None:
    """Write poses and joints of a recording. Raises DataError."""
    from ..io.bodies import read_bodies
    from ..io.calibration import orientation_path
    from ..io.joints import read_joints
    from ..jobs.bodies import BodiesOptions, check_bodies_folder, save_bodies, track_bodies
    from ..jobs.sources import is_bag

    path = arguments.orientation or orientation_path(arguments.calibration)
    inputs = [arguments.source, arguments.calibration, path, arguments.bodies]
    check_bodies_folder(arguments.out, [*inputs, arguments.joints or path])
    bodies = read_bodies(arguments.bodies)
    names = [body.name for body in bodies]
    joints = read_joints(arguments.joints, names) if arguments.joints else ()
    recording, calibrations, orientation = read_oriented_source(arguments, path)
    print_notes(recording.notes)
    if arguments.rate is None and not is_bag(arguments.source):
        raise DataError(
            f'{arguments.source}: the file does not contain the times of its exposures; give '
            'their rate, --rate HZ'
        )
    options = options_of(
        BodiesOptions,
        arguments,
        estimate_shapes=not arguments.keep_shapes,
        rate=arguments.rate,
    )
    with ErrorsAt(arguments.source), ProgressBar('exposures') as bar:
        outcome = track_bodies(
            recording.frames,
            calibrations,
            orientation,
            bodies,
            joints=joints,
            options=options,
            progress=bar,
        )
    save_bodies(arguments.out, outcome, arguments.figures)
    print_unpaired(arguments.source, outcome.unpaired)
    print_findings(outcome.findings, 'doubtful: ')
    _print(arguments, outcome)


def _print(arguments: argparse.Namespace, outcome: BodiesOutcome) -> None:
    """Print how well poses and joints are known."""
    lines = [f'{len(outcome.exposures)} exposures, written to {arguments.out}']
    document: dict[str, Any] = {'out': str(arguments.out), 'bodies': {}, 'joints': {}}
    for poses, shape in zip(outcome.poses, outcome.shapes):
        known = poses.known
        sd = np.median(poses.sd[known], axis=0) if known.any() else np.full(6, np.nan)
        position = float(np.sqrt(np.mean(sd[:3] ** 2)))
        rotation = float(np.degrees(np.sqrt(np.mean(sd[3:] ** 2))))
        document['bodies'][poses.body] = {
            'poses': int(np.count_nonzero(known)),
            'sd_mm': position,
            'sd_deg': rotation,
            'condition_per_m': shape.condition,
            'mean_error_mm': shape.mean_error_mm,
        }
        lines.append(
            f'{poses.body}: {np.count_nonzero(known)} poses, sd {position:.3f} mm and '
            f'{rotation:.3f} degrees (medians); condition number {shape.condition:.0f} per m, '
            f'mean error of the rigid body {shape.mean_error_mm:.3f} mm'
        )
    for motion in outcome.joints:
        angles = np.degrees(motion.angles[np.isfinite(motion.angles).all(axis=1)])
        span = np.ptp(angles, axis=0) if len(angles) else np.full(3, np.nan)
        sd = np.degrees(np.nanmedian(motion.sd[:, :3], axis=0))
        document['joints'][motion.joint.name] = {
            name: {'range_deg': float(a), 'sd_deg': float(s)}
            for name, a, s in zip(motion.angle_names, span, sd)
        }
        lines += [
            f'{motion.joint.name}: {name} over {a:.1f} degrees, sd {s:.3f} (median)'
            for name, a, s in zip(motion.angle_names, span, sd)
        ]
    print_result(arguments, document, '\n'.join(lines))
