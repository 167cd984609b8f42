# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Argument types, and arguments shared by several commands."""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable, Iterable
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn, TypeVar

from ..errors import ErrorsAt
from ..io.rig_file import NAME
from ..limits import ReadLimits
from ..options import Option, declared
from .output import print_notes, print_unpaired
from .rig import JointOfRig

if TYPE_CHECKING:
    from ..bodies.body import Body
    from ..correction.fluoroscope_calibration import FluoroscopeCalibration
    from ..exposures.angles import AngleOptions
    from ..exposures.phantom import Phantom
    from ..io.formats.content import FileSettings
    from ..jobs.scheduling import Cluster
    from ..jobs.sources import BagSelection, Recording, Survey
    from ..photogrammetry.rig_orientation import RigOrientation

Parser = argparse.ArgumentParser | argparse._ArgumentGroup
T = TypeVar('T')
UNITS = ('mm', 'cm', 'm')
_NO_INPUTS = ('out', 'figure', 'overlay', 'film')  # a film may contain the output
READ_LIMITS = ('max_file_mb', 'max_image_megapixels', 'max_training_points')  # with options


def image_size(text: str) -> tuple[int, int]:
    """Parse WxH as (width, height) [px]."""
    try:
        width, height = (int(part) for part in text.lower().split('x'))
        if width > 0 and height > 0:
            return width, height
    except ValueError:
        pass
    raise argparse.ArgumentTypeError(f'{text!r} is not WIDTHxHEIGHT, such as 1024x1024')


def number_in(low: float, high: float, kind: type = float) -> Callable[[str], Any]:
    """Return an argument type: a number from low to high."""

    def convert(text: str) -> Any:
        try:
            value = kind(text)
        except ValueError:
            raise argparse.ArgumentTypeError(f'{text!r} is not a number') from None
        if not low <= value <= high:
            raise argparse.ArgumentTypeError(f'{text} is not between {low:g} and {high:g}')
        return value

    return convert


def numbers_of(count: int) -> Callable[[str], tuple[float, ...]]:
    """Return an argument type: `count` positive numbers, separated by commas."""

    def convert(text: str) -> tuple[float, ...]:
        try:
            values = tuple(float(part) for part in text.split(','))
        except ValueError:
            values = ()
        if len(values) != count or not all(0 < v < math.inf for v in values):
            raise argparse.ArgumentTypeError(
                f'{text!r} is not {count} numbers above 0, separated by commas'
            )
        return values

    return convert


def names(text: str) -> list[str]:
    """Parse A,B as a list of names."""
    return text.split(',')


# Arguments that several commands have: keyword arguments of `add_argument`, by name.
_SHARED: dict[str, dict[str, Any]] = {
    'out': {'required': True, 'type': Path, 'metavar': 'DIR'},
    'phantom': {
        'required': True,
        'type': Path,
        'help': 'surveyed coordinates target_id,x,y,z,sd [mm], or another list of coordinates, an '
        'XMALab frame specification, project or .xyz file',
    },
    'calibration': {
        'required': True,
        'type': Path,
        'metavar': 'DIR',
        'help': 'result folder of calibrate',
    },
    'orientation': {
        'type': Path,
        'metavar': 'FILE',
        'help': 'orientation of the rig (default: rig_orientation.npz in the result folder)',
    },
    'image_size': {'type': image_size, 'metavar': 'WxH'},
    'fluoroscopes': {
        'type': names,
        'metavar': 'A,B',
        'help': 'names of the fluoroscopes to use (default: all)',
    },
    'principal_distance': {'type': number_in(1, 1e7), 'metavar': 'PX'},
    'angle_deg': {'type': number_in(-720, 720), 'metavar': 'DEG'},  # see angle_of
    'cluster': {'action': 'append', 'default': [], 'metavar': "'NAME: ID ID ...'"},
    'covariance': {
        'action': 'store_true',
        'help': 'also write the covariance matrix of all unknowns (*.covariance.npz)',
    },
    'exit_zero': {
        'action': 'store_true',
        'help': 'exit with status 0 whatever the verdict; by default with 3 unless it is pass',
    },
    'workers': {
        'type': number_in(1, 1024, int),
        'default': 0,
        'metavar': 'N',
        'help': 'processes (default: as many as there are cores)',
    },
}


def add_shared(parser: argparse._ActionsContainer, *shared: str, **changes: Any) -> None:
    """Add arguments that several commands have; changes replace keyword arguments."""
    for name in shared:
        parser.add_argument('--' + name.replace('_', '-'), **{**_SHARED[name], **changes})


def add_option(parser: Parser, option: Option, **changes: Any) -> None:
    """Add the argument of a declared option: --name with its choices, default and description.

    An option that is False by default becomes a flag. changes replace keyword arguments of
    `add_argument`.
    """
    settings: dict[str, Any] = {'default': option.default}
    unit = f' [{option.unit}]' if option.unit else ''
    text = str(option.default)
    if isinstance(option.default, tuple):
        text = ','.join(f'{value:g}' for value in option.default)
    default = '' if option.default is None else f' (default: {text})'
    settings['help'] = f'{option.description}{unit}{default}'
    if option.default is False:
        settings = {'action': 'store_true', 'help': option.description}
    elif option.choices:
        settings['choices'] = option.choices
    elif option.length is not None:
        settings['type'] = numbers_of(option.length)
    elif option.default is None or isinstance(option.default, int | float):
        low = -math.inf if option.minimum is None else option.minimum
        high = math.inf if option.maximum is None else option.maximum
        kind = float if isinstance(option.default, float) else int
        settings['type'] = number_in(low, high, kind)
    settings.update(changes)
    parser.add_argument('--' + option.name.replace('_', '-'), **settings)


def add_options(
    parser: Parser, kind: type, only: Iterable[str] = (), **changes: dict[str, Any]
) -> None:
    """Add the arguments of the options that a dataclass declares: all of them, or `only` some.

    changes: keyword arguments of `add_argument`, by option.
    """
    options = declared(kind)
    for name in only or options:
        add_option(parser, options[name], **changes.get(name, {}))


def add_address(parser: argparse.ArgumentParser, server: str, port: int) -> None:
    """Add --host and --port of a server, with a default port; server: name of the server."""
    parser.add_argument(
        '--host',
        default='127.0.0.1',
        help=f'address of {server}, 0.0.0.0 for all interfaces (default: 127.0.0.1)',
    )
    parser.add_argument(
        '--port',
        type=number_in(0, 65535, int),
        default=port,
        help=f'port of {server}, 0 for any free port (default: {port})',
    )


def add_oriented_source(parser: argparse.ArgumentParser, options: type, **metavars: str) -> None:
    """Add the inputs of `read_oriented_source`, and options that include `RecordedPairing`."""
    add_source(parser, 'image size of a file [px] (default: that of the calibration)')
    add_bag_options(parser, pairing=False)
    add_shared(parser, 'calibration', 'orientation')
    metavars = {'pair_tolerance': 'S', **metavars}
    add_options(parser, options, **{name: {'metavar': text} for name, text in metavars.items()})


def read_oriented_source(
    arguments: argparse.Namespace,
) -> tuple[Recording, dict[str, FluoroscopeCalibration], RigOrientation]:
    """Read a recording, its calibrations, and the orientation of the rig.

    Raises DataError, also if the orientation belongs to other calibrations.
    """
    from ..correction.fluoroscope_calibration import ids_of
    from ..io.calibration import load_orientation, orientation_path
    from ..jobs.sources import read_calibrated_source

    recording, calibrations = read_calibrated_source(
        directory=arguments.calibration,
        # A frame without points, or with an invalid one, must not reject a recording.
        validate=False,
        **source_of(arguments, bag_selection(arguments, pairing=False)),
    )
    path = arguments.orientation or orientation_path(arguments.calibration)
    orientation = load_orientation(path)
    names = [name for name in orientation.fluoroscopes if name in recording.frames]
    with ErrorsAt(path):
        used = orientation.subset(names) if names else orientation
        used.check_calibrations(ids_of(calibrations))
    return recording, calibrations, orientation


def source_of(
    arguments: argparse.Namespace, selection: BagSelection, **settings: Any
) -> dict[str, Any]:
    """Return the arguments of `read_source` by name; settings replace some of `file_settings`."""
    return {
        'path': arguments.source,
        'image_size': arguments.image_size,
        'fluoroscopes': arguments.fluoroscopes,
        'settings': file_settings(arguments, **settings),
        'selection': selection,
    }


def read_calibrated_exposures(
    arguments: argparse.Namespace,
) -> tuple[Survey, Recording, dict[str, FluoroscopeCalibration]]:
    """Read a phantom, exposures of it and calibrations, print notes. Raises DataError."""
    from ..io.csv_table import read_names
    from ..jobs.sources import read_calibrated_source, read_survey

    stored_names = read_names(arguments.calibration)
    survey = read_survey(arguments.phantom, file_settings(arguments, names=stored_names))
    recording, calibrations = read_calibrated_source(
        directory=arguments.calibration,
        **source_of(
            arguments,
            bag_selection(arguments, phantom=survey.phantom),
            names=survey.names,
        ),
    )
    print_inputs(arguments.source, survey, recording)
    return survey, recording, calibrations


def input_paths(arguments: argparse.Namespace) -> list[Path]:
    """Return the files and folders that the arguments name, without those to write."""
    return [
        path
        for name, value in vars(arguments).items()
        if name not in _NO_INPUTS
        for path in (value if isinstance(value, list) else [value])
        if isinstance(path, Path)
    ]


def print_inputs(source: Path, survey: Survey | None, recording: Recording) -> None:
    """Print the notes on a phantom and a recording, and its frames without partner."""
    print_notes((*(() if survey is None else survey.notes), *recording.notes))
    print_unpaired(source, recording.unpaired)


def rigid_clusters(
    arguments: argparse.Namespace, error: Callable[[str], NoReturn]
) -> tuple[Body, ...]:
    """Return the bodies given by --cluster; call error with a sentence for an invalid one."""
    from ..bodies.body import declared_bodies

    try:
        return declared_bodies(arguments.cluster)
    except ValueError as fault:
        error(f'--cluster: {fault}')


def options_of(kind: type[T], arguments: argparse.Namespace, /, **values: Any) -> T:
    """Return a dataclass of options, or of a request, from the arguments of the same names.

    values replace them; a field without an argument keeps its default. Raises ValueError.
    """
    names = [field.name for field in fields(kind)]  # type: ignore[arg-type]
    parsed = {n: getattr(arguments, n) for n in names if hasattr(arguments, n)}
    return kind(**{**parsed, **values})


def add_read_limits(parser: argparse.ArgumentParser) -> None:
    """Add the limits for input files."""
    group = parser.add_argument_group('limits of what is read')
    metavar = {'metavar': 'N'}
    add_options(group, ReadLimits, READ_LIMITS, **dict.fromkeys(READ_LIMITS, metavar))


def add_source(
    parser: argparse.ArgumentParser, image_size_help: str, more: str = ''
) -> argparse._ArgumentGroup:
    """Add SOURCE, --image-size and --fluoroscopes; more: further kinds of SOURCE, for the help.

    Returns the group of the inputs.
    """
    parser.add_argument(
        'source',
        type=Path,
        metavar='SOURCE',
        help='bag (file or folder), CSV file with the columns fluoroscope, exposure, target_id, '
        'u, v and, where known, sigma and angle_deg, or image points of another program: XMALab '
        '2-D points or project, DeepLabCut, SLEAP, .pho (docs/formats.md)' + more,
    )
    group = parser.add_argument_group('input')
    add_shared(group, 'image_size', help=image_size_help)
    add_shared(group, 'fluoroscopes')
    group.add_argument(
        '--decisions',
        type=Path,
        metavar='CSV',
        help='table of doubtful image points and exposures (doubtful.csv) with your decisions: '
        '"leave out", or the correct target_id',
    )
    add_file_options(parser)
    return group


def add_bag_options(parser: argparse.ArgumentParser, pairing: bool = True) -> None:
    """Add the options for bags: time window, angle of the C-arm and, if wanted, pairing."""
    from ..exposures.pairing import RecordedPairing

    group = parser.add_argument_group('bags')
    for name, text in (('start', 'first'), ('end', 'last')):
        group.add_argument(
            f'--{name}',
            type=number_in(0, 1e9),
            metavar='S',
            help=f'{text} time that is used [s from the stamp of the first frame] (default: all)',
        )
    if pairing:
        add_options(group, RecordedPairing, pair_tolerance={'metavar': 'S'})
    add_angle_options(group)


def add_angle_options(parser: Parser) -> None:
    """Add the options for the source of the angle of the C-arm in the exposures of a bag."""
    from ..exposures.angles import AngleOptions, joints_by_fluoroscope

    def convert(text: str) -> str:
        try:
            joints_by_fluoroscope(text)
        except ValueError as error:
            raise argparse.ArgumentTypeError(str(error)) from None
        return text

    joint = {
        'type': convert,
        'metavar': 'JOINT',
        'help': 'joint of the joint states in a bag whose position is the angle of the C-arm, or '
        f"one for each fluoroscope: A:JOINT,B:JOINT; '' for none (default: that of {NAME}, else "
        'none)',
    }
    add_options(parser, AngleOptions, angle_joint=joint, angle_max_age={'metavar': 'S'})


def angle_options(arguments: argparse.Namespace) -> AngleOptions:
    """Return the options added by `add_angle_options`."""
    from ..exposures.angles import AngleOptions

    joint = arguments.angle_joint
    return options_of(
        AngleOptions, arguments, angle_joint=str(joint), of_rig=isinstance(joint, JointOfRig)
    )


def bag_selection(
    arguments: argparse.Namespace, pairing: bool = True, phantom: Phantom | None = None
) -> BagSelection:
    """Return the selection added by `add_bag_options`, from frames of a phantom if it is given."""
    from ..jobs.sources import BagSelection

    return BagSelection(
        start_s=arguments.start,
        end_s=arguments.end,
        pair_by=arguments.pair_by if pairing else 'frame_number',
        tolerance_s=arguments.pair_tolerance,
        angles=angle_options(arguments),
        phantom=phantom,
    )


def add_file_options(parser: argparse.ArgumentParser) -> None:
    """Add settings for facts that files of other programs do not contain."""
    group = parser.add_argument_group('files of other programs')
    group.add_argument(
        '--units', choices=UNITS, help='unit of lengths, where the format does not state it'
    )
    group.add_argument(
        '--phantom-sd',
        type=number_in(1e-6, 100.0),
        metavar='MM',
        help='standard deviation of the coordinates of beads, where the file has none',
    )
    group.add_argument(
        '--one-based', action='store_true', help='pixels of XMALab points count from 1'
    )
    group.add_argument(
        '--y-up', action='store_true', help='rows of XMALab points count upwards from the bottom'
    )
    group.add_argument(
        '--trial', metavar='NAME', help='trial of an XMALab project (default: its calibration)'
    )


def file_settings(arguments: argparse.Namespace, **changes: Any) -> FileSettings:
    """Return the settings added by `add_file_options`; changes replace some of them."""
    from ..io.formats.content import FileSettings

    # --fluoroscopes chooses some of a source; only where it names cameras is it a change here.
    settings = {'phantom_sd_mm': arguments.phantom_sd, 'fluoroscopes': (), **changes}
    return options_of(FileSettings, arguments, **settings)


def add_scheduler(parser: argparse.ArgumentParser, task: str = 'extract the images') -> None:
    """Add --scheduler, the address of a Dask cluster for images."""
    group = parser.add_argument_group('images on a cluster')
    group.add_argument(
        '--scheduler',
        metavar='tls://HOST:PORT',
        help=f'Dask scheduler whose workers {task}, instead of local processes (needs: pip '
        'install fluoro_calib_ros[cluster]); scheduler and workers can run any code here: tcp:// '
        'only on this machine, else with certificates',
    )
    for name, description in (
        ('ca', 'certificate of the authority of the cluster'),
        ('cert', 'certificate of this process'),
        ('key', 'its key'),
    ):
        group.add_argument(
            f'--tls-{name}', default='', metavar='FILE', help=f'with tls://: {description} (PEM)'
        )
    group.add_argument(
        '--trusted-network',
        action='store_true',
        help='allow tcp:// to another machine: anyone in its network can run code here',
    )


def cluster_of(arguments: argparse.Namespace) -> Cluster | None:
    """Return the cluster given by the arguments of `add_scheduler`, None without one."""
    from ..jobs.scheduling import Cluster

    if arguments.scheduler is None:
        return None
    return options_of(Cluster, arguments)


def angle_of(arguments: argparse.Namespace) -> float | None:
    """Return the angle of the C-arm [rad] from --angle-deg, None without it."""
    return None if arguments.angle_deg is None else math.radians(arguments.angle_deg)


def add_result_folder(parser: argparse.ArgumentParser) -> None:
    """Add DIR, which can also be given as --calibration and by a rig.toml; see `result_folder`."""
    parser.add_argument(
        'directory',
        type=Path,
        nargs='?',
        metavar='DIR',
        help='result folder of calibrate',
    )
    parser.add_argument(
        '--calibration', type=Path, metavar='DIR', help='the same, as other commands name it'
    )


def result_folder(arguments: argparse.Namespace, error: Callable[[str], NoReturn]) -> Path:
    """Return the folder of `add_result_folder`; call error with a sentence if there is none."""
    if arguments.directory is None and arguments.calibration is None:
        error('the following arguments are required: DIR')
    folder: Path = arguments.directory or arguments.calibration
    return folder


def add_collect(parser: Parser, source: str = 'a bag') -> None:
    """Add --collect."""
    from ..exposures.collector import COLLECT_MODES

    parser.add_argument(
        '--collect',
        choices=COLLECT_MODES,
        default='auto',
        help=f'exposures of {source} to use: all frames, or those in which the phantom stands '
        'still in a new pose; auto: still for a stream of more than 10 frames per second, else '
        'all (default: auto)',
    )
