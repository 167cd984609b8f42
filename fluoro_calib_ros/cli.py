"""The command fluoro-calib: simulate, calibrate, adjust and correct, without ROS running."""

import argparse
import sys
from pathlib import Path

from .cli_images import EXAMPLE as OF_IMAGES
from .cli_images import TEXT as ABOUT_CORRECT
from .cli_images import add_correct
from .cli_images import correct as run_correct
from .cli_reconstruct import EXAMPLES as OF_SPACE
from .cli_reconstruct import (
    TEXTS,
    add_orient,
    add_reconstruct,
    check_reconstruct,
    orientation_of_calibration,
    write_orientation,
)
from .cli_reconstruct import orient as run_orient
from .cli_reconstruct import reconstruct as run_reconstruct
from .cli_validate import EXAMPLE, TEXT, add_validate
from .cli_validate import validate as run_validate
from .errors import DataError

EXAMPLES = {
    'simulate': 'fluoro-calib simulate --out rig --seed 1 --exposures 15',
    'calibrate': 'fluoro-calib calibrate bags/calibration --phantom bags/phantom.csv --out result',
    'adjust': 'fluoro-calib adjust test --phantom phantom.csv --calibration result --out check',
    'correct': OF_IMAGES,
    'validate': EXAMPLE,
    **OF_SPACE,
}


MODELS = ('auto', 'collocation', 'hybrid', 'local_linear', 'knn', 'parametric', 'none')
OF_NEIGHBOURS = ('hybrid', 'local_linear', 'knn')


def image_size(text):
    """Argument WxH as (width, height) [px]."""
    try:
        width, height = (int(part) for part in text.lower().split('x'))
        if width > 0 and height > 0:
            return width, height
    except ValueError:
        pass
    raise argparse.ArgumentTypeError(f'{text!r} is not WIDTHxHEIGHT, such as 1024x1024')


def number_in(low, high, kind=float):
    """Type of an argument: a number from low to high."""

    def convert(text):
        try:
            value = kind(text)
        except ValueError:
            raise argparse.ArgumentTypeError(f'{text!r} is not a number') from None
        if not low <= value <= high:
            raise argparse.ArgumentTypeError(f'{text} is not between {low:g} and {high:g}')
        return value

    return convert


def numbers_of(count):
    """Type of an argument: count numbers above 0, with commas between."""

    def convert(text):
        try:
            values = tuple(float(part) for part in text.split(','))
        except ValueError:
            values = ()
        if len(values) != count or not all(0 < v < float('inf') for v in values):
            raise argparse.ArgumentTypeError(
                f'{text!r} is not {count} numbers above 0 with commas between'
            )
        return values

    return convert


def make_parser():
    """The command line."""
    parser = argparse.ArgumentParser(
        prog='fluoro-calib', description='Self-calibration of X-ray fluoroscopes.'
    )
    commands = parser.add_subparsers(dest='command', required=True, metavar='COMMAND')

    def command(name, text, run):
        sub = commands.add_parser(
            name, help=text, description=text, epilog=f'example: {EXAMPLES[name]}'
        )
        sub.set_defaults(run=run)
        sub.add_argument(
            '--json', action='store_true', help='print the result as JSON on standard output'
        )
        return sub

    _add_simulate(
        command('simulate', 'Write bags, CSV, phantom and truth of a virtual rig.', simulate)
    )
    sub = command('calibrate', 'Self-calibrate the fluoroscopes of a bag or CSV file.', calibrate)
    _add_source(sub)
    _add_calibrate(sub)
    sub = command(
        'adjust',
        'Adjust a bag or CSV file with the calibration held (out-of-sample test).',
        adjust,
    )
    _add_source(sub)
    sub.add_argument(
        '--calibration',
        required=True,
        type=Path,
        metavar='DIR',
        help='folder that calibrate has written',
    )
    _add_loss(sub)
    add_correct(
        command('correct', ABOUT_CORRECT, lambda o: run_correct(o, _calibrations_in, _report))
    )
    add_validate(command('validate', TEXT, validate), image_size)
    add_orient(command('orient', TEXTS['orient'], lambda o: run_orient(o, _report)), image_size)
    add_reconstruct(
        command('reconstruct', TEXTS['reconstruct'], lambda o: run_reconstruct(o, _report)),
        image_size,
        number_in,
    )
    return parser


def _add_simulate(sub):
    sub.add_argument('--out', required=True, type=Path, metavar='DIR', help='folder to write')
    sub.add_argument(
        '--seed', type=number_in(0, 2**31, int), default=1, help='number of the rig (default: 1)'
    )
    sub.add_argument(
        '--exposures',
        type=number_in(1, 100000, int),
        default=15,
        help='exposures of the phantom for the calibration (default: 15)',
    )
    sub.add_argument(
        '--test-exposures',
        type=number_in(0, 100000, int),
        default=0,
        help='further exposures, written as a bag and CSV of their own (default: 0)',
    )
    sub.add_argument(
        '--seconds',
        type=number_in(0, 86400),
        default=3.0,
        help='markers in motion [s] (default: 3)',
    )
    sub.add_argument(
        '--rate',
        type=number_in(1, 2000),
        default=120.0,
        help='frames a second of them (default: 120)',
    )
    sub.add_argument(
        '--noise', type=number_in(0, 100), default=0.25, help='image noise [px] (default: 0.25)'
    )
    sub.add_argument(
        '--false-matches',
        type=number_in(0, 0.5),
        default=0.01,
        help='part of the targets with a wrong number (default: 0.01)',
    )
    sub.add_argument(
        '--strength', type=number_in(0, 10), default=1.0, help='of the distortion (default: 1)'
    )


def _add_source(sub):
    sub.add_argument(
        'source',
        type=Path,
        metavar='SOURCE',
        help='bag (file or folder) or CSV fluoroscope,exposure,target_id,u,v[,sigma]',
    )
    sub.add_argument(
        '--phantom', required=True, type=Path, help='surveyed coordinates target_id,x,y,z,sd [mm]'
    )
    sub.add_argument('--out', required=True, type=Path, metavar='DIR', help='folder to write')
    sub.add_argument(
        '--image-size',
        type=image_size,
        metavar='WxH',
        help='of a CSV file, which does not tell it [px]',
    )
    sub.add_argument('--fluoroscopes', metavar='A,B', help='names of those to use (default: all)')


def _add_loss(sub):
    sub.add_argument(
        '--loss',
        choices=('student_t', 'huber', 'gaussian'),
        default='student_t',
        help='noise model of the image points (default: student_t)',
    )


def _add_calibrate(sub):
    sub.add_argument(
        '--model',
        choices=MODELS,
        default='auto',
        help='correction model (default: auto, chosen by cross-validation)',
    )
    sub.add_argument(
        '--interior',
        choices=('estimated', 'fixed'),
        default='estimated',
        help='interior orientation: estimated, or held and learned by the model (default: estimated)',
    )
    together = sub.add_mutually_exclusive_group()
    together.add_argument(
        '--joint', action='store_true', help='all fluoroscopes in one adjustment'
    )
    together.add_argument(
        '--separate', action='store_true', help='one after the other (the default)'
    )
    sub.add_argument(
        '--relative-orientation',
        choices=('none', 'soft', 'hard'),
        default='none',
        help='of the fluoroscopes, the same in every exposure: not asked for, within --relative-sd, or '
        'exactly; needs --joint (default: none)',
    )
    sub.add_argument(
        '--relative-sd',
        type=numbers_of(2),
        default=(0.5, 2e-4),
        metavar='MM,RAD',
        help='standard deviations of a soft relative orientation (default: 0.5,0.0002)',
    )
    sub.add_argument(
        '--datum',
        choices=('survey', 'inner'),
        default='survey',
        help='weighted surveyed coordinates, or a free network (default: survey)',
    )
    sub.add_argument(
        '--interior-sd',
        type=numbers_of(3),
        metavar='XP,YP,C',
        help='standard deviations [px] of the start values of the interior orientation: principal point '
        'in the middle of the image, and --principal-distance (default: they are not known)',
    )
    _add_loss(sub)
    sub.add_argument(
        '--principal-distance',
        type=number_in(1, 1e7),
        metavar='PX',
        help='start value, or with --interior fixed the held value (default: from the observations)',
    )
    sub.add_argument(
        '--k',
        type=number_in(1, 100000, int),
        help='neighbours of knn, local_linear or hybrid (default: by cross-validation)',
    )
    sub.add_argument(
        '--max-iterations',
        type=number_in(1, 10000, int),
        default=60,
        help='most rounds (default: 60)',
    )
    sub.add_argument(
        '--collect',
        choices=('auto', 'all', 'still'),
        default='auto',
        help='exposures of a bag: all frames, or those in which the phantom stands still in a new pose; '
        'auto: still for a stream of more than 10 frames a second (default: auto)',
    )
    sub.add_argument(
        '--figures', action='store_true', help='draw the figures of the paper into DIR/figures'
    )


def main(arguments=None):
    """Entry point: exit status 0 done, 1 failed for a reason in the data, 2 wrong usage."""
    parser = make_parser()
    options = parser.parse_args(arguments)
    if getattr(options, 'k', None) and options.model not in OF_NEIGHBOURS:
        parser.error(f'--k is a number of neighbours, it needs --model {", ".join(OF_NEIGHBOURS)}')
    if getattr(options, 'relative_orientation', 'none') != 'none' and not options.joint:
        parser.error('--relative-orientation needs --joint: the fluoroscopes in one adjustment')
    if getattr(options, 'interior_sd', None) and (
        options.interior == 'fixed' or options.principal_distance is None
    ):
        parser.error('--interior-sd needs --principal-distance and --interior estimated')
    if options.command == 'reconstruct':
        check_reconstruct(options, parser.error)
    try:
        options.run(options)
    except (DataError, OSError) as error:
        print(f'fluoro-calib {options.command}: {error}', file=sys.stderr)
        sys.exit(1)
    except KeyboardInterrupt:
        sys.exit(130)


def simulate(options):
    """Write a data set of the virtual rig."""
    from .jobs.dataset import write_exposures, write_rig, write_tracking
    from .simulation.rig import START_NS, simulate_exposures, simulate_tracking, virtual_rig

    rig = virtual_rig(options.seed, options.strength)
    made_with = {
        name: getattr(options, name)
        for name in (
            'seed',
            'exposures',
            'test_exposures',
            'seconds',
            'rate',
            'noise',
            'false_matches',
            'strength',
        )
    }
    write_rig(options.out, rig, **made_with)
    image = {'noise_px': options.noise, 'false_matches': options.false_matches}
    # Seeds of the parts differ, so that more of one does not change another.
    write_exposures(
        options.out,
        'calibration',
        rig,
        simulate_exposures(rig, options.exposures, options.seed, **image),
    )
    if options.test_exposures:
        write_exposures(
            options.out,
            'test',
            rig,
            simulate_exposures(
                rig,
                options.test_exposures,
                options.seed + 1_000_000,
                start_ns=START_NS + 3600 * 10**9,
                first_number=options.exposures + 1,
                **image,
            ),
        )
    if options.seconds:
        write_tracking(
            options.out,
            simulate_tracking(
                rig,
                options.seconds,
                options.rate,
                options.seed,
                options.noise,
                START_NS + 7200 * 10**9,
            ),
        )
    _report(options, {'out': str(options.out), **made_with}, f'written to {options.out}')


def calibrate(options):
    """Self-calibrate and write result and calibrations."""
    from .calibration.calibrate import calibrate as run
    from .calibration.options import CalibrationOptions
    from .files.calibration_sources import write_sources
    from .files.phantom import read_phantom

    phantom = read_phantom(options.phantom)
    frames = _frames_of(options, options.collect)
    how = (
        CalibrationOptions(
            options.model,
            options.interior,
            options.loss,
            options.k,
            options.max_iterations,
            relative_orientation=options.relative_orientation,
            relative_sd=options.relative_sd,
            datum=options.datum,
            interior_sd=options.interior_sd,
        ),
        options.joint,
        options.principal_distance,
    )
    job = run(frames, phantom, *how, _print_round)
    orientation = orientation_of_calibration(frames, phantom, job)
    _write_job(options, job)
    write_sources(options.out, frames, phantom, *how)
    write_orientation(options.out, orientation)


def adjust(options):
    """Adjust with calibrations held and write the result."""
    from .calibration.calibrate import adjust_with_calibrations
    from .files.phantom import read_phantom

    phantom = read_phantom(options.phantom)
    calibrations = _calibrations_in(options.calibration)
    frames = _frames_of(options, 'all')
    missing = [name for name in frames if name not in calibrations]
    if missing:
        raise DataError(
            f'{options.calibration}: there is no calibration of fluoroscope {missing[0]}, '
            f'only of {", ".join(calibrations)}'
        )
    job = adjust_with_calibrations(
        frames, phantom, {name: calibrations[name] for name in frames}, options.loss
    )
    _write_job(options, job)


def _write_job(options, job):
    """Write result, calibrations and, where they are asked for, figures of a job; report it."""
    from .files.calibration import save_calibration
    from .files.json_file import write_result
    from .files.result_document import result_document
    from .report.tables import summary_table

    document = result_document(job)
    for calibration in job.calibrations.values():
        save_calibration(options.out, calibration)
    write_result(options.out / 'result.json', document)
    if getattr(options, 'figures', False):
        from .report.figures import write_figures

        write_figures(job, options.out / 'figures')
    for sentence in job.left_out:
        print(f'not used: {sentence}', file=sys.stderr)
    _report(options, document, summary_table(job))


def validate(options):
    """Validate a calibration with the observations it was made of."""
    run_validate(options, lambda o: _frames_of(o, o.collect), _report)


def _calibrations_in(directory):
    from .files.calibration import load_calibrations

    calibrations = load_calibrations(directory)
    if not calibrations:
        raise DataError(f'{directory}: there is no calibration in this folder')
    return calibrations


def _frames_of(options, collect):
    """{fluoroscope: [Frame, ...]} of the source, those that are asked for. Raises DataError."""
    from .bags.reader import read_frames
    from .exposures.collector import collect_recorded
    from .files.observations import read_observations_csv

    if options.source.suffix.lower() == '.csv':
        frames = read_observations_csv(options.source, options.image_size)
    else:
        frames = read_frames(options.source).frames
    wanted = options.fluoroscopes.split(',') if options.fluoroscopes else list(frames)
    for name in wanted:
        if name not in frames:
            raise DataError(
                f'{options.source}: there is no fluoroscope {name!r}, only {", ".join(frames)}'
            )
    frames = {name: frames[name] for name in wanted}
    if options.source.suffix.lower() == '.csv' or options.command == 'adjust':
        return frames
    frames, unpaired = collect_recorded(frames, collect)
    lost = {name: count for name, count in unpaired.items() if count}
    if lost:
        print(
            f'{options.source}: frames without partner of the other fluoroscopes, not used: {lost}',
            file=sys.stderr,
        )
    return frames


def _print_round(label, this):
    """Progress on a terminal."""
    if sys.stderr.isatty():
        rmse = '  '.join(f'{n}: {r[0]:.3f} {r[1]:.3f} px' for n, r in this.rmse.items())
        print(
            f'{label}: round {this.iteration:2d}  F {this.F:12.2f}  G {this.G:12.2f}  k {max(this.k.values()):3d}  '
            f'RMSE {rmse}',
            file=sys.stderr,
        )


def _report(options, document, text):
    """The result on standard output: JSON, or text for people."""
    if options.json:
        from .files.json_file import result_text

        text = result_text(document)
    print(text.rstrip('\n'))


if __name__ == '__main__':
    main()
