# Copyright 2026 fluoro_calib_ros maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""fluoro-calib extract."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from .arguments import add_phantom, add_scheduler, file_settings, number_in
from .output import ProgressBar, print_note, print_notes, print_result

if TYPE_CHECKING:
    from ..jobs.extraction import ExtractionOutcome

NAME = 'extract'
HELP = 'Find, measure and match the beads of a phantom in radiographs.'
EXAMPLE = (
    'fluoro-calib extract images/a --phantom phantom.csv --fluoroscope a --out observations.csv'
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    from .arguments import add_file_options

    parser.add_argument(
        'sources',
        type=Path,
        nargs='+',
        metavar='SOURCE',
        help='grey images (png, tif, jpg, bmp, pgm), folders of images, TIFF stacks, videos '
        '(avi, mkv, mp4), bags with images; an exposure has the number in the name of its file, '
        'else its place in the order',
    )
    add_phantom(
        parser,
        help='surveyed coordinates target_id,x,y,z,sd[,diameter] [mm], or an XMALab frame '
        'specification, project or .xyz file',
    )
    parser.add_argument('--fluoroscope', required=True, metavar='NAME', help='of the images')
    parser.add_argument(
        '--out', required=True, type=Path, metavar='CSV', help='file of observations to write'
    )
    parser.add_argument(
        '--principal-distance',
        type=number_in(1, 1e7),
        metavar='PX',
        help='to some 10 %% (default: not known, about four times the width of the image)',
    )
    parser.add_argument(
        '--overlay',
        type=Path,
        metavar='DIR',
        help='folder for pictures of what was found, matched and refused',
    )
    parser.add_argument(
        '--workers',
        type=number_in(1, 1024, int),
        default=0,
        metavar='N',
        help='processes (default: as many as there are cores)',
    )
    add_scheduler(parser)
    parser.add_argument(
        '--regular-grid',
        action='store_true',
        help='the phantom is a regular flat grid, which fits in many places: take any of them; '
        'this serves the distortion of one fluoroscope, not the orientation of two',
    )
    add_file_options(parser)


def run(arguments: argparse.Namespace) -> None:
    """Extract the beads of images. Raises DataError."""
    from ..files.access import check_safe_name
    from ..files.extracted import write_extracted
    from ..files.folder import check_output_file
    from ..jobs.extraction import ExtractionRequest, run_extraction
    from ..jobs.sources import read_survey

    check_safe_name(arguments.fluoroscope, '--fluoroscope')
    check_output_file(arguments.out, (*arguments.sources, arguments.phantom))
    survey = read_survey(arguments.phantom, file_settings(arguments))
    print_notes(survey.notes)
    request = ExtractionRequest(
        arguments.sources,
        survey.phantom,
        arguments.fluoroscope,
        arguments.principal_distance,
        arguments.overlay,
        arguments.workers,
        arguments.scheduler,
        arguments.regular_grid,
    )
    with ProgressBar('extract') as bar:
        outcome = run_extraction(request, bar)
    observed = [(r.frame, r.overlapped) for r in outcome.results if r.frame is not None]
    write_extracted(arguments.out, observed, survey.names.target_names())
    for result in outcome.refused:
        print_note(f'not used: {result.place}: {result.reason}')
    print_result(arguments, _document(arguments.out, outcome), _text(arguments.out, outcome))


def _document(out: Path, outcome: ExtractionOutcome) -> dict[str, Any]:
    """Return the summary that --json prints."""
    return {
        'out': str(out),
        'fluoroscope': outcome.fluoroscope,
        'images': len(outcome.results),
        'observations': sum(len(frame.target_id) for frame in outcome.frames),
        'exposures': [
            {
                'exposure': result.exposure,
                'place': result.place,
                'observations': 0 if result.frame is None else len(result.frame.target_id),
                'overlapped': int(result.overlapped.sum()),
                'expected': result.expected,
                'found': result.found,
                'explained': result.explained,
                'followed': result.followed,
                'reason': result.reason,
                'seconds': result.seconds,
            }
            for result in outcome.results
        ],
    }


def _text(out: Path, outcome: ExtractionOutcome) -> str:
    """Return the summary for people."""
    frames = outcome.frames
    beads = sum(len(frame.target_id) for frame in frames)
    return (
        f'{len(frames)} of {len(outcome.results)} images with {beads} beads, '
        f'{beads / len(frames):.0f} an image\nwritten to {out}'
    )
