# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""fluoro-calib adjust."""

from __future__ import annotations

import argparse

from ..findings import Kind
from .arguments import (
    add_bag_options,
    add_options,
    add_shared,
    add_source,
    input_paths,
    read_calibrated_exposures,
)
from .output import print_findings, print_result, styled_verdict

HOLDS = 'The calibration holds for these exposures; its interior orientation was fixed.'
DOES_NOT_HOLD = (
    'The calibration does not hold for these exposures; its interior orientation was fixed. '
    'Calibrate again, from exposures of the fluoroscopes as they are now.'
)

NAME = 'adjust'
HELP = 'Adjust the exposures of a bag or CSV file with the calibration fixed (out-of-sample test).'
EXAMPLE = 'fluoro-calib adjust test --phantom phantom.csv --calibration result --out check'


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    from ..estimation.options import CalibrationOptions

    source = add_source(
        parser,
        'image size of a file that does not contain it [px] (default: that of the calibration)',
    )
    add_shared(source, 'phantom')
    add_bag_options(parser)
    add_shared(parser, 'out', help='result folder to write')
    add_shared(parser, 'covariance', 'exit_zero', 'calibration')
    add_options(parser, CalibrationOptions, ['loss'])


def run(arguments: argparse.Namespace) -> bool:
    """Adjust exposures and write the result folder; return whether the calibration holds.

    Raises DataError.
    """
    from ..io.folder import check_output_folder
    from ..io.result_document import result_document
    from ..jobs.calibration import adjust
    from ..jobs.result_folder import (
        RESULT_FOLDER,
        reused_exposures,
        save_result,
    )
    from ..jobs.sources import select_calibrations
    from ..report.tables import summary_table

    check_output_folder(arguments.out, RESULT_FOLDER, input_paths(arguments))
    survey, recording, calibrations = read_calibrated_exposures(arguments)
    frames = recording.frames
    calibrations = select_calibrations(calibrations, frames, arguments.calibration)
    result = adjust(frames, survey.phantom, calibrations, arguments.loss)
    save_result(arguments.out, result, covariance=arguments.covariance)
    reused = reused_exposures(arguments.calibration, calibrations, frames)
    print_findings((*result.findings, *([reused] if reused else [])), 'doubtful: ')
    holds = not any(f.kind is Kind.POOR_CALIBRATION_FIT for f in result.findings)
    text = HOLDS if holds else DOES_NOT_HOLD
    verdict = styled_verdict(text, 'pass' if holds else 'fail')
    document = {**result_document(result), 'holds': holds, 'out_of_sample': reused is None}
    table = summary_table(result, has_notes=False).rstrip()  # they are already printed
    print_result(arguments, document, f'{table}\n\n{verdict}')
    return holds
