# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""fluoro-calib calibrate."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

from ..errors import DataError
from ..options import Option, declared
from .arguments import (
    add_bag_options,
    add_collect,
    add_option,
    add_scheduler,
    add_shared,
    add_source,
    angle_options,
    bag_selection,
    cluster_of,
    file_settings,
    input_paths,
    options_of,
    print_inputs,
    source_of,
)
from .output import (
    ProgressBar,
    print_findings,
    print_note,
    print_result,
    print_round,
    print_step,
    styled_verdict,
)

if TYPE_CHECKING:
    from ..estimation.options import CalibrationRequest
    from ..io.calibration_request import Radiographs
    from ..jobs.calibration import CalibrationOutcome
    from ..jobs.sources import Recording, Survey

NAME = 'calibrate'
HELP = 'Self-calibrate the fluoroscopes of a bag, file of image points or folder of radiographs.'
EXAMPLE = 'fluoro-calib calibrate bags/calibration --phantom bags/phantom.csv --out result'
OF_MODEL = ('model', 'k')
INTERNAL = ('tolerance',)  # options that the command does not offer


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    source = add_source(
        parser,
        'image size of a file that does not contain it [px]',
        '; or radiographs: a folder with a folder of images for each fluoroscope, a bag with '
        'images',
    )
    add_shared(source, 'phantom')
    add_collect(source)
    add_scheduler(parser)
    add_bag_options(parser)
    _add_adjustment(parser)
    result = parser.add_argument_group('result')
    add_shared(result, 'out', help='result folder to write')
    result.add_argument(
        '--force',
        action='store_true',
        help='calibrate even if the input or the result is implausible, for example with another '
        'phantom; the reasons are written to result.json',
    )
    result.add_argument(
        '--fast',
        action='store_true',
        help='skip the verdict (see validate) and the report, which take about twice as long as '
        'the calibration',
    )
    result.add_argument(
        '--figures', action='store_true', help='draw the figures of the paper into DIR/figures'
    )
    add_shared(result, 'covariance', 'exit_zero')


def _add_adjustment(parser: argparse.ArgumentParser) -> None:
    """Add the options of correction model and adjustment."""
    from ..estimation.options import CalibrationOptions

    model = parser.add_argument_group('correction model')
    adjustment = parser.add_argument_group('adjustment')
    for name, option in declared(CalibrationOptions).items():
        if name == 'model':
            _add_model(model, option)
        elif name not in INTERNAL:
            group = model if name in OF_MODEL else adjustment
            add_option(group, option, **_METAVARS.get(name, {}))
    exclusive = adjustment.add_mutually_exclusive_group()
    exclusive.add_argument(
        '--joint', action='store_true', help='all fluoroscopes in one adjustment'
    )
    exclusive.add_argument(
        '--separate', action='store_true', help='one fluoroscope after the other (the default)'
    )
    add_shared(
        adjustment,
        'principal_distance',
        help='start value, or with --interior fixed the value (default: from the observations)',
    )
    adjustment.add_argument(
        '--known-orientation',
        type=Path,
        action='append',
        default=[],
        metavar='FILE',
        help='K, R and t of the fluoroscopes, a YAML file or a camera of another program, such as '
        'MayaCam 2; repeatable: only the distortion is estimated; the phantom is then given in '
        'the frame of the lab, in motion with a column exposure',
    )


def _add_model(parser: argparse._ArgumentGroup, option: Option) -> None:
    """Add --model: the name of a model, or the user's own regressor."""

    def convert(text: str) -> Any:
        from ..estimation.options import resolve_model

        if ':' not in text:
            if text in option.choices:
                return text
            raise argparse.ArgumentTypeError(
                f'invalid choice: {text!r} (choose from {", ".join(option.choices)})'
            )
        try:
            return resolve_model(text)
        except ValueError as error:
            raise argparse.ArgumentTypeError(str(error)) from None

    parser.add_argument(
        '--model',
        type=convert,
        default=option.default,
        metavar=f'{{{",".join(option.choices)},MODULE:CLASS}}',
        help=f'{option.description}, or the class of a scikit-learn regressor '
        f'(default: {option.default})',
    )


_METAVARS = {
    'relative_sd': {'metavar': 'MM,RAD'},
    'interior_sd': {'metavar': 'XP,YP,C'},
    'k': {'metavar': 'K'},
    'max_iterations': {'metavar': 'N'},
}


def check(arguments: argparse.Namespace, error: Callable[[str], NoReturn]) -> None:
    """Call error with a sentence for arguments that exclude each other."""
    from ..correction.registry import neighbour_models

    models = neighbour_models()
    if arguments.k and arguments.model not in models:
        error(f'--k is a number of neighbours, it needs --model {", ".join(models)}')
    if arguments.relative_orientation != 'none' and not arguments.joint:
        error('--relative-orientation needs --joint: the fluoroscopes in one adjustment')
    if arguments.known_orientation and (
        arguments.relative_orientation != 'none' or arguments.datum != 'survey'
    ):
        error('--known-orientation excludes --relative-orientation and --datum inner')
    if arguments.interior_sd and (
        arguments.interior == 'fixed' or arguments.principal_distance is None
    ):
        error('--interior-sd needs --principal-distance and --interior estimated')


def run(arguments: argparse.Namespace) -> bool:
    """Self-calibrate and write the result folder.

    Returns False if the verdict is not pass, otherwise True. Raises DataError.
    """
    from ..io.calibration_request import write_radiographs
    from ..io.folder import check_output_folder
    from ..jobs.calibration import run_calibration
    from ..jobs.result_folder import RESULT_FOLDER, save_outcome, write_covariances

    check_output_folder(arguments.out, RESULT_FOLDER, input_paths(arguments))
    request, radiographs = _request(arguments)
    outcome = run_calibration(
        request,
        validate=not arguments.fast,
        force=arguments.force,
        progress=print_round,
        report_step=print_step,
    )

    def write_more(folder: Path) -> None:
        write_radiographs(folder, radiographs)
        if arguments.figures:
            from ..report.report_figures import write_figures

            write_figures(outcome.result, folder / 'figures')
        if arguments.covariance:
            write_covariances(folder, outcome.result)

    save_outcome(arguments.out, outcome, write_more=write_more)
    _print(arguments, outcome)
    return outcome.validation is None or outcome.validation.verdict == 'pass'


def _request(arguments: argparse.Namespace) -> tuple[CalibrationRequest, Radiographs]:
    """Read the inputs named by the arguments, with radiographs of images. Raises DataError."""
    from ..estimation.options import CalibrationOptions, CalibrationRequest
    from ..exposures.names import Names
    from ..io.phantom import has_exposures, read_moving_points
    from ..jobs.image_sources import contains_images, dose_texts
    from ..jobs.sources import read_orientations, read_survey

    known_orientations = read_orientations(arguments.known_orientation, file_settings(arguments))
    moving = bool(known_orientations) and has_exposures(arguments.phantom)
    survey = None if moving else read_survey(arguments.phantom, file_settings(arguments))
    recording = _recording(arguments, survey)
    print_inputs(arguments.source, survey, recording)
    if survey is None:
        # Its targets have an id of their own in every exposure.
        frames, phantom = read_moving_points(arguments.phantom).as_phantom(recording.frames)
        names = Names()
    else:
        frames = recording.frames
        phantom = survey.phantom
        names = recording.names
    doses = dose_texts(arguments.source) if contains_images(arguments.source) else {}
    request = CalibrationRequest(
        frames,
        phantom,
        options_of(CalibrationOptions, arguments),
        joint=arguments.joint,
        principal_distance=arguments.principal_distance,
        names=names,
        known_orientations=known_orientations,
        about={
            'observations': str(arguments.source),
            'phantom': str(arguments.phantom),
            **({'decisions': str(arguments.decisions)} if arguments.decisions else {}),
            **{f'dose {name}'.strip(): text for name, text in doses.items()},
            **((arguments.rig_file and arguments.rig_file.about) or {}),
        },
    )
    return request, recording.radiographs


def _recording(arguments: argparse.Namespace, survey: Survey | None) -> Recording:
    """Read the observations, or extract them from images. Raises DataError."""
    from ..exposures.names import Names
    from ..jobs.extraction import recording_of_images
    from ..jobs.image_sources import ImageAngles, contains_images
    from ..jobs.sources import read_source, with_decisions

    if not contains_images(arguments.source):
        names = Names() if survey is None else survey.names
        phantom = None if survey is None else survey.phantom
        selection = bag_selection(arguments, phantom=phantom)
        source = source_of(arguments, selection, names=names)
        return read_source(collect=arguments.collect, **source)
    if survey is None:
        raise DataError(
            f'{arguments.source}: beads in images need a phantom file with fixed coordinates, '
            'without a column exposure'
        )
    with ProgressBar('extract') as bar:
        recording = recording_of_images(
            arguments.source,
            survey,
            arguments.fluoroscopes,
            arguments.principal_distance,
            scheduler=cluster_of(arguments),
            progress=bar,
            angles=ImageAngles(angle_options(arguments)),
        )
    return with_decisions(recording, arguments.decisions)


def _print(arguments: argparse.Namespace, outcome: CalibrationOutcome) -> None:
    """Print notes, the summary, and the verdict with the report."""
    from ..io.result_document import result_document, validation_document
    from ..report.tables import summary_table, verdict_line

    print_findings(outcome.result.findings, 'implausible: ')
    document = result_document(outcome.result)
    lines = [summary_table(outcome.result, has_notes=False).rstrip()]
    if outcome.validation is not None:
        report = _report(arguments.out)
        document |= {'validation': validation_document(outcome.validation), 'report': report}
        verdict = outcome.validation.verdict
        lines += ['', styled_verdict(verdict_line(outcome.validation), verdict)]
        lines += [f'Report: {report}'] if report else []
    print_result(arguments, document, '\n'.join(lines), _next_step(arguments, outcome))


def _next_step(arguments: argparse.Namespace, outcome: CalibrationOutcome) -> tuple[object, ...]:
    """Return the next command: it uses the calibration, or validates it."""
    if outcome.validation is None:
        return 'validate', arguments.out
    if outcome.validation.verdict != 'pass':
        return ()  # the verdict contains the advice
    if outcome.orientation is None:
        return 'correct', 'POINTS.csv', '--calibration', arguments.out, '--out', 'corrected.csv'
    return 'reconstruct', 'MEASURED', '--calibration', arguments.out, '--out', 'points.csv'


def _report(directory: Path) -> str | None:
    """Write the report and return its path; None, with a note, if it cannot be written.

    This happens with a regressor of the user: the report reads files, which do not name it.
    """
    from ..jobs.report import write_report

    try:
        with ProgressBar('report', 'picture') as bar:
            return write_report(directory, bar)
    except DataError as error:
        print_note(f'no report: {error}')
        return None
