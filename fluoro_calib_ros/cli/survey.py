# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""fluoro-calib survey."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING, Any

from ..errors import DataError, ErrorsAt
from .arguments import (
    add_bag_options,
    add_collect,
    add_options,
    add_shared,
    add_source,
    bag_selection,
    file_settings,
    input_paths,
    options_of,
    print_inputs,
    source_of,
)
from .output import print_findings, print_result, print_round

if TYPE_CHECKING:
    from ..estimation.survey import MeasuredDistance
    from ..exposures.names import Names
    from ..jobs.sources import Survey
    from ..jobs.survey import SurveyOutcome

NAME = 'survey'
HELP = 'Survey the beads of your own phantom from its exposures: coordinates with their sd.'
EXAMPLE = (
    'fluoro-calib survey recording --phantom rough.csv --distance 1,45,120.05,0.02 '
    '--distance 3,17,98.4,0.02 --out phantom.csv'
)
OPTIONS = ('model', 'loss', 'max_iterations', 'interior_sd')


def distance(text: str) -> tuple[str, str, float, float]:
    """Parse A,B,MM,SD as two beads, a length and its standard deviation."""
    parts = [part.strip() for part in text.split(',')]
    try:
        first, second, length, sd = parts
        return first, second, float(length), float(sd)
    except ValueError:
        raise argparse.ArgumentTypeError(
            f'{text!r} is not BEAD,BEAD,MM,SD, such as 1,45,120.05,0.02'
        ) from None


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    from ..estimation.options import CalibrationOptions

    source = add_source(parser, 'image size of a file that does not contain it [px]')
    add_shared(
        source,
        'phantom',
        required=False,
        help='approximate coordinates, to a few centimetres for a phantom of a few decimetres; '
        'any phantom file, or one of the command phantom (default: found from the image points, '
        'with the ids that they have)',
    )
    add_collect(source)
    add_bag_options(parser)
    parser.add_argument(
        '--distance',
        type=distance,
        action='append',
        default=[],
        metavar='BEAD,BEAD,MM,SD',
        help='measured distance between the centres of two beads, and its sd [mm]; repeat it: '
        'the scale follows from one, and a second one checks it (default: scale of --phantom)',
    )
    group = parser.add_argument_group('adjustment')
    add_options(group, CalibrationOptions, OPTIONS)
    add_shared(
        group, 'principal_distance', help='start value [px] (default: from the observations)'
    )
    parser.add_argument(
        '--keep-given',
        action='store_true',
        help='beads that cannot be surveyed keep their given coordinates, with the sd that the '
        'others show (default: excluded)',
    )
    parser.add_argument(
        '--force', action='store_true', help='write the coordinates even if the verdict is fail'
    )
    add_shared(parser, 'out', help='phantom file to write', metavar='OUT.csv')


def run(arguments: argparse.Namespace) -> None:
    """Survey a phantom and write it. Raises DataError, also for the verdict 'fail'."""
    from ..estimation.options import CalibrationOptions
    from ..exposures.names import Names
    from ..io.folder import check_output_file
    from ..io.phantom import write_phantom
    from ..jobs.sources import read_source, read_survey
    from ..jobs.survey import SurveyRequest, survey

    check_output_file(arguments.out, input_paths(arguments))
    if arguments.keep_given and arguments.phantom is None:
        raise DataError('--keep-given needs the coordinates of --phantom')
    initial: Survey | None = None
    names = Names()
    if arguments.phantom is not None:
        initial = read_survey(arguments.phantom, file_settings(arguments))
        names = initial.names
    given = None if initial is None else initial.phantom
    source = source_of(arguments, bag_selection(arguments, phantom=given), names=names)
    recording = read_source(collect=arguments.collect, **source)
    if initial is None:
        names = recording.names
    print_inputs(arguments.source, initial, recording)
    request = SurveyRequest(
        recording.frames,
        given,
        _distances(arguments, names),
        options_of(CalibrationOptions, arguments),
        arguments.principal_distance,
        keep_given=arguments.keep_given,
    )
    with ErrorsAt(arguments.source):
        outcome = survey(request, print_round)
    print_findings(outcome.findings, 'implausible: ')
    failed = [check for check in outcome.validation.checks if check.passed is False]
    is_written = not failed or arguments.force
    if is_written:
        write_phantom(arguments.out, outcome.phantom, names)
    path = str(arguments.out) if is_written else None
    calibrate = ('calibrate', 'OTHER_EXPOSURES', '--phantom', arguments.out, '--out', 'result')
    print_result(
        arguments, _document(outcome, path), _text(outcome, path), calibrate if is_written else ()
    )
    if failed:
        hint = '' if is_written else ', nothing is written (--force writes it)'
        raise DataError(
            f'the verdict is fail{hint}: {failed[0]}', at=arguments.source, kind=failed[0].kind
        )


def _distances(arguments: argparse.Namespace, names: Names) -> list[MeasuredDistance]:
    """Return the distances of the arguments, with target ids. Raises DataError."""
    from ..estimation.survey import MeasuredDistance

    def target(bead: str) -> int:
        if bead in names.targets:
            return names.targets[bead]
        if not (bead.isascii() and bead.isdigit()):
            path = arguments.phantom or arguments.source
            raise DataError(f'--distance: {path} has no bead {bead!r}')
        return int(bead)

    return [
        MeasuredDistance(target(first), target(second), length, sd)
        for first, second, length, sd in arguments.distance
    ]


def _document(outcome: SurveyOutcome, path: str | None) -> dict[str, Any]:
    from ..io.result_document import validation_document

    beads = outcome.beads
    columns = (beads.target_id, beads.xyz_mm, beads.covariance, beads.rays)
    return {
        'out': path,
        'validation': validation_document(outcome.validation),
        'scale': beads.scale,
        'scale_sd': beads.scale_sd,
        'beads': [
            {'target_id': target, 'xyz_mm': xyz, 'covariance_mm2': covariance, 'rays': rays}
            for target, xyz, covariance, rays in zip(*(column.tolist() for column in columns))
        ],
    }


def _text(outcome: SurveyOutcome, path: str | None) -> str:
    from ..report.tables import verdict_text

    sd = outcome.beads.sd_mm
    summary = f'{len(sd)} beads surveyed, sd of a coordinate {min(sd):.3f} to {max(sd):.3f} mm'
    written = '' if path is None else f'written to {path}'
    return '\n'.join([summary, verdict_text(outcome.validation), written])
