# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""fluoro-calib extract."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn

from ..errors import ErrorsAt
from .arguments import (
    add_angle_options,
    add_file_options,
    add_options,
    add_scheduler,
    add_shared,
    angle_of,
    angle_options,
    cluster_of,
    file_settings,
    input_paths,
    names,
    options_of,
    rigid_clusters,
)
from .output import ProgressBar, print_note, print_notes, print_result

if TYPE_CHECKING:
    from ..exposures.frame import Frame
    from ..jobs.extraction import ExtractionOutcome
    from ..jobs.marker_extraction import MarkerOutcome, MarkerRequest

NAME = 'extract'
HELP = 'Find and measure the beads of a phantom in radiographs, or follow implanted markers.'
EXAMPLE = (
    'fluoro-calib extract images/a --phantom phantom.csv --fluoroscope a --out observations.csv'
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.add_argument(
        'sources',
        type=Path,
        nargs='+',
        metavar='SOURCE',
        help='grey images (png, tif, jpg, bmp, pgm), folders of images, TIFF stacks, videos '
        '(avi, mkv, mp4, cine), DICOM files, bags with images; an exposure has the number in the '
        'name of its file, else its position in the order',
    )
    add_shared(
        parser,
        'phantom',
        required=False,
        help='surveyed coordinates target_id,x,y,z,sd[,diameter] [mm], or an XMALab frame '
        'specification, project or .xyz file',
    )
    parser.add_argument(
        '--fluoroscope',
        '--fluoroscopes',
        dest='fluoroscope',
        required=True,
        type=names,
        metavar='NAME',
        help='of the images; A,B or more for markers of calibrated fluoroscopes, with one SOURCE '
        'for each, or one that has a folder or a topic of each',
    )
    add_shared(parser, 'out', help='file of observations to write', metavar='CSV')
    add_shared(
        parser,
        'principal_distance',
        help='to some 10 %% (default: not known, about four times the width of the image)',
    )
    parser.add_argument(
        '--overlay',
        type=Path,
        metavar='DIR',
        help='folder for pictures of found, matched and rejected beads',
    )
    add_shared(parser, 'workers')
    add_scheduler(parser)
    parser.add_argument(
        '--regular-grid',
        action='store_true',
        help='the phantom is a regular flat grid, which fits at many offsets: accept any of '
        'them; this suffices for the distortion of one fluoroscope, not for the orientation of '
        'two',
    )
    _add_markers(parser.add_argument_group('markers in motion'))
    angles = parser.add_argument_group('angle of a C-arm')
    add_angle_options(angles)
    add_shared(
        angles,
        'angle_deg',
        help='angle of the C-arm of all images, where no joint gives it, for a calibration that '
        'depends on it (default: unknown)',
    )
    add_file_options(parser)


def _add_markers(group: argparse._ArgumentGroup) -> None:
    """Add the arguments for the extraction of moving markers."""
    from ..images.markers import MarkerOptions

    group.add_argument(
        '--markers',
        type=Path,
        metavar='FILE',
        help='ids and image points of the markers in one exposure, to a pixel or two: '
        'fluoroscope,exposure,target_id,u,v, or XMALab points; markers are followed from this '
        'exposure; those given for later exposures start or resume there',
    )
    group.add_argument(
        '--calibration',
        type=Path,
        metavar='DIR',
        help='result folder of calibrate, for fluoroscopes that are followed together',
    )
    add_shared(group, 'orientation')
    add_shared(
        group,
        'cluster',
        help="markers that are rigid together, such as 'tibia: 1001 1002 1003'; with two "
        'fluoroscopes or more, they predict and check each other; may be repeated',
    )
    group.add_argument(
        '--cluster-shapes',
        type=Path,
        metavar='FILE',
        help='coordinates target_id,x,y,z,sd [mm] of the markers of each --cluster in any frame, '
        'or in any phantom format; without --markers, they determine the ids',
    )
    group.add_argument(
        '--bodies',
        type=Path,
        metavar='FILE',
        help='bodies.csv: rigid bodies and the coordinates of their markers, instead of '
        '--cluster; without --markers, the shapes determine the ids',
    )
    add_options(group, MarkerOptions, ('shutter', 'gate', 'lost_after', 'search_every'))


def check(arguments: argparse.Namespace, error: Callable[[str], NoReturn]) -> None:
    """Read the bodies; call error with a sentence for arguments that exclude each other."""
    arguments.rigid = rigid_clusters(arguments, error)
    if arguments.bodies is not None and arguments.rigid:
        error('--bodies: it names the markers of each body, as --cluster does')
    if arguments.cluster_shapes is not None and not arguments.rigid:
        error('--cluster-shapes: name the markers of each cluster with --cluster')
    if not _follows_markers(arguments):
        if arguments.phantom is None:
            error('give --phantom for beads of a phantom, or --markers for markers in motion')
        if len(arguments.fluoroscope) != 1:
            error('--fluoroscope: the images of a phantom are of one fluoroscope')
        if arguments.rigid:
            error('--cluster needs --markers')
        return
    if len(arguments.fluoroscope) > 1:
        if arguments.calibration is None:
            error('markers of several fluoroscopes need their --calibration')
        if len(arguments.sources) not in (1, len(arguments.fluoroscope)):
            error('give one SOURCE for each fluoroscope, or one for all')
    elif arguments.rigid or arguments.bodies is not None:
        error(
            'rigid bodies need two fluoroscopes or more, --fluoroscope A,B, and their '
            '--calibration'
        )


def _follows_markers(arguments: argparse.Namespace) -> bool:
    paths = (arguments.markers, arguments.cluster_shapes, arguments.bodies)
    return any(path is not None for path in paths)


def run(arguments: argparse.Namespace) -> None:
    """Extract the beads or markers of images. Raises DataError."""
    if _follows_markers(arguments):
        _run_markers(arguments)
    else:
        _run_phantom(arguments)


def _run_phantom(arguments: argparse.Namespace) -> None:
    """Extract the beads of a phantom. Raises DataError."""
    from ..io.access import check_safe_name
    from ..io.folder import check_output_file
    from ..io.observations import FLAGS, write_extracted
    from ..jobs.extraction import ExtractionRequest, run_extraction
    from ..jobs.image_sources import ImageAngles
    from ..jobs.sources import read_survey

    fluoroscope = arguments.fluoroscope[0]
    check_safe_name(fluoroscope, '--fluoroscope')
    check_output_file(arguments.out, input_paths(arguments))
    survey = read_survey(arguments.phantom, file_settings(arguments))
    print_notes(survey.notes)
    angles = ImageAngles(angle_options(arguments), angle_of(arguments))
    angles.check(arguments.sources, arguments.fluoroscope)
    request = options_of(
        ExtractionRequest,
        arguments,
        phantom=survey.phantom,
        fluoroscope=fluoroscope,
        principal_distance_px=arguments.principal_distance,
        scheduler=cluster_of(arguments),
        angles=angles,
    )
    with ProgressBar('extract') as bar:
        outcome = run_extraction(request, bar)
    observed = [(r.frame, [r.overlapped]) for r in outcome.results if r.frame is not None]
    write_extracted(arguments.out, observed, survey.names.target_names(), FLAGS[:1])
    for result in outcome.refused:
        print_note(f'not used: {result.finding}')
    print_notes(outcome.notes)
    _print_phantom(arguments, outcome)


def _print_phantom(arguments: argparse.Namespace, outcome: ExtractionOutcome) -> None:
    """Print the summary of the beads of a phantom."""
    out = arguments.out
    frames = outcome.frames
    beads = sum(len(frame.target_id) for frame in frames)
    document = {
        'out': str(out),
        'fluoroscope': outcome.fluoroscope,
        'images': len(outcome.results),
        'observations': beads,
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
    text = f'{len(frames)} of {len(outcome.results)} images with {beads} beads, '
    text += f'{beads / len(frames):.0f} an image\nwritten to {out}'
    print_result(arguments, document, text)


def _run_markers(arguments: argparse.Namespace) -> None:
    """Track markers through images. Raises DataError."""
    from ..exposures.names import Names
    from ..io.access import check_safe_name
    from ..io.decisions import DOUBTFUL, doubtful_table
    from ..io.folder import check_output_file
    from ..io.observations import write_extracted
    from ..jobs.marker_extraction import doubtful_ids, run_marker_extraction

    for name in arguments.fluoroscope:
        check_safe_name(name, '--fluoroscope')
    inputs = input_paths(arguments)
    doubtful_path = arguments.out.with_name(f'{arguments.out.stem}.{DOUBTFUL}')
    check_output_file(arguments.out, inputs)
    check_output_file(doubtful_path, inputs)
    request = _marker_request(arguments)
    with ProgressBar('extract') as bar:
        outcome = run_marker_extraction(request, bar)
    observed = [(frame, flags) for frame, *flags in outcome.frames()]
    write_extracted(arguments.out, observed, request.target_names)
    for name, results in outcome.results.items():
        for result in results:
            if result.markers.reason:
                print_note(f'fluoroscope {name}: {result.place}: {result.markers.reason}')
        if outcome.before[name]:
            print_note(
                f'fluoroscope {name}: {outcome.before[name]} images before exposure '
                f'{results[0].exposure}, for which the markers are given, are not used'
            )
    print_notes(outcome.notes)
    for span in outcome.spans():
        name, *others = (
            request.target_names.get(i, str(i)) for i in (span.target_id, *span.others)
        )
        doubt = f'may be {" or ".join(others) or "another object"}'
        print_note(
            f'fluoroscope {span.fluoroscope}: marker {name} {doubt} in exposures {span.first} to '
            f'{span.last}: {span.reason}'
        )
    doubtful = doubtful_ids(outcome)
    if doubtful:
        marker_names = Names({name: number for number, name in request.target_names.items()})
        doubtful_table(doubtful, marker_names).write(doubtful_path)
        print_note(
            f'{doubtful_path}: decide on the doubtful ids in this file, and pass it with '
            '--decisions'
        )
    _print_markers(arguments, outcome)


def _marker_request(arguments: argparse.Namespace) -> MarkerRequest:
    """Read the inputs of the extraction of markers. Raises DataError."""
    from ..correction.fluoroscope_calibration import ids_of
    from ..images.markers import MarkerOptions
    from ..io.bodies import read_bodies
    from ..io.calibration import load_orientation, orientation_path
    from ..jobs.image_sources import ImageAngles
    from ..jobs.marker_extraction import MarkerRequest, sequences, shaped
    from ..jobs.sources import read_calibrations, read_source, read_survey

    angles = ImageAngles(angle_options(arguments), angle_of(arguments))
    angles.check(arguments.sources, arguments.fluoroscope)
    sources, image_size = sequences(arguments.sources, arguments.fluoroscope)
    first_frames: Mapping[str, list[Frame]] = {}
    target_names: Mapping[int, str] = {}
    if arguments.markers is not None:
        recording = read_source(
            arguments.markers,
            image_size=image_size,
            fluoroscopes=arguments.fluoroscope,
            settings=file_settings(arguments, image_size=image_size),
        )
        print_notes(recording.notes)
        first_frames = recording.frames
        target_names = recording.names.target_names()
    bodies = arguments.rigid
    if arguments.bodies is not None:
        bodies = read_bodies(arguments.bodies)
    if arguments.cluster_shapes is not None:
        survey = read_survey(arguments.cluster_shapes, file_settings(arguments))
        print_notes(survey.notes)
        bodies = shaped(bodies, survey.phantom, arguments.cluster_shapes)
        target_names = target_names or survey.names.target_names()
    calibrations = {}
    orientation = None
    if len(sources) > 1:
        calibrations = read_calibrations(arguments.calibration, arguments.fluoroscope)
        path = arguments.orientation or orientation_path(arguments.calibration)
        orientation = load_orientation(path).subset(arguments.fluoroscope)
        with ErrorsAt(path):
            orientation.check_calibrations(ids_of(calibrations))
    return MarkerRequest(
        sources,
        first_frames,
        options_of(MarkerOptions, arguments),
        calibrations,
        orientation,
        bodies=bodies,
        overlay=arguments.overlay,
        target_names=target_names,
        angles=angles,
    )


def _print_markers(arguments: argparse.Namespace, outcome: MarkerOutcome) -> None:
    """Print the summary of markers in motion."""
    document = {
        'out': str(arguments.out),
        'fluoroscopes': {
            name: {
                'images': len(results),
                'observations': sum(len(r.markers.target_id) for r in results),
                'overlapped': sum(int(r.markers.overlapped.sum()) for r in results),
                'doubtful': sum(int(r.markers.doubtful.sum()) for r in results),
                'missing': sum(len(r.markers.missing) for r in results),
                'exposures': [
                    {
                        'exposure': r.exposure,
                        'place': r.place,
                        'observations': len(r.markers.target_id),
                        'missing': r.markers.missing.tolist(),
                        'doubtful': r.markers.target_id[r.markers.doubtful].tolist(),
                        'reason': r.markers.reason,
                        'seconds': r.markers.seconds,
                    }
                    for r in results
                ],
            }
            for name, results in outcome.results.items()
        },
        'doubtful_ids': [vars(span) for span in outcome.spans()],
        'decisions': [vars(decision) for decision in outcome.decisions],
    }
    lines = []
    for name, results in outcome.results.items():
        measured = sum(len(r.markers.target_id) for r in results)
        total = measured + sum(len(r.markers.missing) for r in results)
        doubtful = sum(int(r.markers.doubtful.sum()) for r in results)
        lines.append(
            f'fluoroscope {name}: {len(results)} images, {measured} of {total} image points of '
            f'markers measured, {doubtful} with a doubtful id'
        )
    exchanged = [d for d in outcome.decisions if d.kind == 'exchanged']
    if exchanged:
        lines.append(f'{len(exchanged)} exchanged pairs of ids were restored')
    lines.append(f'written to {arguments.out}')
    print_result(arguments, document, '\n'.join(lines))
