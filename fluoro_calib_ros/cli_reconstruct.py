"""The commands fluoro-calib orient and reconstruct: where the fluoroscopes stand, and points in
space.
"""

import argparse
import sys
from pathlib import Path

import numpy as np

from .errors import DataError

TEXTS = {
    'orient': 'Orientation of the rig from a capture of the phantom standing still in the rig frame.',
    'reconstruct': 'Points in space from the observed image points of two or more fluoroscopes.',
}
EXAMPLES = {
    'orient': 'fluoro-calib orient capture --phantom phantom.csv --calibration result',
    'reconstruct': 'fluoro-calib reconstruct bags/tracking --calibration result --out points.csv',
}


def exposure_numbers(text):
    """Argument such as 1,4-6 as a set of numbers."""
    out = set()
    try:
        for part in text.split(','):
            low, _, high = part.partition('-')
            numbers = range(int(low), int(high or low) + 1)
            if not numbers or numbers[0] < 0 or len(numbers) > 10**6:
                raise ValueError
            out.update(numbers)
    except ValueError:
        raise argparse.ArgumentTypeError(
            f'{text!r} is not a list of exposures, such as 1,4-6'
        ) from None
    return out


def add_orient(sub, image_size):
    """Arguments of the command; image_size: type of an argument WxH."""
    _add_source(sub, image_size)
    sub.add_argument(
        '--phantom', required=True, type=Path, help='surveyed coordinates target_id,x,y,z,sd [mm]'
    )
    sub.add_argument(
        '--frame-id',
        default='rig',
        metavar='NAME',
        help='name of the rig frame, which is that of the standing phantom (default: rig)',
    )
    sub.add_argument(
        '--exposures',
        type=exposure_numbers,
        metavar='N,N-M',
        help='numbers of the frames in which the phantom stands in the rig frame (default: all)',
    )


def add_reconstruct(sub, image_size, number_in):
    """Arguments of the command; image_size and number_in(low, high): types of arguments."""
    _add_source(sub, image_size)
    sub.add_argument('--out', required=True, type=Path, metavar='OUT.csv', help='file to write')
    sub.add_argument(
        '--orientation',
        type=Path,
        metavar='FILE',
        help='orientation of the rig (default: rig_orientation.npz in the folder of the calibration)',
    )
    sub.add_argument(
        '--pair-by',
        choices=('frame_number', 'stamp'),
        default='frame_number',
        help='what the frames of one exposure have in common (default: frame_number)',
    )
    sub.add_argument(
        '--reject',
        type=number_in(0.1, 1e6),
        default=4.0,
        metavar='S',
        help='standard deviations of the epipolar distance from which a match is false (default: 4)',
    )
    sub.add_argument(
        '--cluster',
        action='append',
        default=[],
        metavar="'NAME: ID ID ...'",
        help='rigid cluster of targets, whose distances the drift watch looks at too, such as '
        "'tibia: 1001 1002 1003'; may be given again",
    )
    sub.add_argument(
        '--no-drift-watch',
        action='store_true',
        help='do not look in the recording for a drift of the calibration, which takes a part of the time',
    )


def check_reconstruct(options, error):
    """Read the clusters of the command line; error(sentence) is called where the options do not go
    together.
    """
    from .drift.rig_watch import clusters_of

    try:
        options.clusters = clusters_of(options.cluster)
    except ValueError as fault:
        error(f'--cluster: {fault}')
    if options.clusters and options.no_drift_watch:
        error('--cluster is for the drift watch, it does not go with --no-drift-watch')
    if options.clusters and options.source.suffix.lower() == '.csv':
        error(
            f'--cluster is for the drift watch, and {options.source}, a CSV file, does not tell the time of its '
            'exposures'
        )


def _add_source(sub, image_size):
    sub.add_argument(
        'source',
        type=Path,
        metavar='SOURCE',
        help='observed image points: bag (file or folder) or CSV '
        'fluoroscope,exposure,target_id,u,v[,sigma]',
    )
    sub.add_argument(
        '--calibration',
        required=True,
        type=Path,
        metavar='DIR',
        help='folder that calibrate has written',
    )
    sub.add_argument(
        '--image-size',
        type=image_size,
        metavar='WxH',
        help='of a CSV file, which does not tell it [px] (default: that of the calibration)',
    )
    sub.add_argument('--fluoroscopes', metavar='A,B', help='names of those to use (default: all)')


def orient(options, report):
    """Write DIR/rig_orientation.npz from a capture; report(options, document, text) prints the
    result.
    """
    from .calibration.rig_orientation import orientation_of_capture
    from .files.calibration import load_calibrations
    from .files.phantom import read_phantom
    from .files.rig_orientation import save_orientation

    phantom = read_phantom(options.phantom)
    calibrations = load_calibrations(options.calibration)
    frames = _frames_of(options, calibrations)
    if options.exposures is not None:
        frames = {
            name: [f for f in of_one if f.number in options.exposures]
            for name, of_one in frames.items()
        }
    try:
        orientation = orientation_of_capture(frames, phantom, calibrations, options.frame_id)
    except DataError as error:
        raise DataError(f'{options.source}: {error}') from None
    path = save_orientation(options.calibration, orientation)
    rms, count = _distance_from_survey(frames, phantom, calibrations, orientation)
    document = {'out': path, **orientation_document(orientation), 'targets': count, 'rms_mm': rms}
    check = (
        f'\n{count} targets intersected again lie {rms:.3f} mm from their survey (RMS)'
        if count
        else ''
    )
    report(options, document, f'{orientation_text(orientation)}{check}\nwritten to {path}')


def reconstruct(options, report):
    """Write the points of a recording; report(options, document, text) prints the result."""
    from .files.calibration import load_calibrations
    from .files.reconstructed_points import write_reconstruction
    from .files.rig_orientation import load_orientation, orientation_path
    from .reconstruction.intersection import STATUS, Intersector
    from .reconstruction.reconstruct import reconstruct_recording

    calibrations = load_calibrations(options.calibration)
    path = options.orientation or orientation_path(options.calibration)
    orientation = load_orientation(path)
    frames = _frames_of(options, calibrations)
    if options.pair_by == 'stamp' and options.source.suffix.lower() == '.csv':
        raise DataError(
            f'{options.source}: a CSV file does not tell the time of its exposures, '
            'pair them by frame_number'
        )
    names = [name for name in orientation.fluoroscopes if name in frames]
    if len(names) < 2:
        raise DataError(
            f'{options.source}: there are image points of {", ".join(frames)}, but two fluoroscopes of the '
            f'orientation ({", ".join(orientation.fluoroscopes)}) are needed'
        )
    orientation = orientation.subset(names)
    try:
        orientation.check_calibrations(
            {name: c.calibration_id for name, c in calibrations.items()}
        )
    except DataError as error:
        raise DataError(f'{path}: {error}') from None
    watch, drift = _watch_of(options, orientation, calibrations)
    try:
        found, unpaired = reconstruct_recording(
            frames, calibrations, Intersector(orientation, options.reject), options.pair_by, watch
        )
    except DataError as error:
        raise DataError(f'{options.source}: {error}') from None
    if not found:
        raise DataError(
            f'{options.source}: no frames of {" and ".join(names)} belong together by {options.pair_by}'
        )
    write_reconstruction(options.out, found)
    status = np.bincount(
        np.concatenate([frame.points.status for frame in found]), minlength=len(STATUS)
    )
    counts = dict(zip(STATUS, status.tolist()))
    incomplete = sum(len(frame.fluoroscopes) < len(names) for frame in found)
    drift = watch.verdict() if watch else drift
    lost = {name: count for name, count in unpaired.items() if count}
    if lost:
        print(
            f'{options.source}: frames without partner of the other fluoroscopes, not used: {lost}',
            file=sys.stderr,
        )
    report(
        options,
        {
            'out': str(options.out),
            'frames': len(found),
            'incomplete': incomplete,
            'points': int(status.sum()),
            'status': counts,
            'unpaired': unpaired,
            'drift': drift_document(drift, found[0].stamp_ns),
            'orientation': orientation_document(orientation),
        },
        f'{status.sum()} points of {len(found)} frames written to {options.out}: '
        + ', '.join(f'{count} {name}' for name, count in counts.items() if count)
        + (
            f'\n{incomplete} of the frames without all fluoroscopes ({", ".join(names)})'
            if incomplete
            else ''
        )
        + (f'\ndrift watch: {drift.message}' if drift else ''),
    )


def _watch_of(options, orientation, calibrations):
    """RecordingWatch of a recording, or None and the DriftVerdict that says why there is none;
    None and None where it is not wanted.
    """
    from .drift.rig_watch import DriftVerdict, RecordingWatch

    if options.no_drift_watch:
        return None, None
    if options.source.suffix.lower() == '.csv':
        return None, DriftVerdict(
            'unknown', 'a CSV file does not tell the time of its exposures, no drift can be told'
        )
    try:
        return RecordingWatch(
            orientation,
            {name: calibrations[name].image_size for name in orientation.fluoroscopes},
            clusters=options.clusters,
        ), None
    except DataError as error:
        return None, DriftVerdict('unknown', f'no drift can be told: {error}')


def drift_document(verdict, begin_ns):
    """A DriftVerdict as a dict, None where there is none; times [s] after the exposure at
    begin_ns.
    """
    if verdict is None:
        return None
    out = {
        'level': verdict.level,
        'message': verdict.message,
        'level_at_end': verdict.level_at_end,
        'watched_s': verdict.watched_s,
    }
    names = {
        'fluoroscope': 'fluoroscope',
        'place': 'place',
        'area_px': 'area',
        'size_px': 'size',
        'sd_px': 'sd',
        'direction': 'direction',
        'against': 'against',
        'source': 'source',
        'evidence': 'evidence',
        'threshold_warn': 'threshold_warn',
        'threshold_error': 'threshold_error',
        'observations': 'observations',
    }
    out.update(
        {
            key: getattr(verdict.state, name) if verdict.state else None
            for key, name in names.items()
        }
    )
    for key, stamp_ns in (('found', verdict.found_ns), ('began', verdict.began_ns)):
        out[f'{key}_stamp_ns'] = stamp_ns
        out[f'{key}_s'] = None if stamp_ns is None else (stamp_ns - begin_ns) / 1e9
    return out


def orientation_of_calibration(frames, phantom, job):
    """RigOrientation of the exposures of a calibration, None where there is none to be had: of one
    fluoroscope, and of exposures that do not belong together, which is said.
    """
    from .calibration.rig_orientation import orientation_of_exposures

    if len(frames) < 2:
        return None
    try:
        return orientation_of_exposures(frames, phantom, job.calibrations)
    except DataError as error:
        print(f'no orientation of the rig: {error}', file=sys.stderr)
        return None


def write_orientation(directory, orientation):
    """Write the RigOrientation of a calibration to directory, if there is one; that of a capture
    which belongs to the same calibrations stays.
    """
    from .files.rig_orientation import load_orientation, orientation_path, save_orientation

    if orientation is None:
        return
    try:
        before = load_orientation(orientation_path(directory))
    except DataError:
        before = None  # there is none, or none that is of use
    if (
        before is None
        or before.source != 'capture'
        or before.calibration_ids != orientation.calibration_ids
    ):
        save_orientation(directory, orientation)


def orientation_document(orientation):
    """A RigOrientation as a dict: lengths in mm, pixels in px, angles in rad."""
    from .photogrammetry.rotations import quaternion_from_matrix

    return {
        'orientation_id': orientation.orientation_id,
        'frame_id': orientation.frame_id,
        'source': orientation.source,
        'exposures': orientation.exposures,
        'fluoroscopes': {
            name: {
                'calibration_id': identity,
                'position_mm': position,
                'quaternion_wxyz': quaternion_from_matrix(rotation),
                'sd_mm': sd_mm,
                'sd_rad': sd_rad,
            }
            for name, identity, position, rotation, sd_mm, sd_rad in zip(
                orientation.fluoroscopes,
                orientation.calibration_ids,
                orientation.position_mm,
                orientation.rotation,
                orientation.sd_mm,
                orientation.sd_rad,
            )
        },
    }


def orientation_text(orientation):
    """A RigOrientation for people."""
    lines = [
        f'orientation of the rig {orientation.orientation_id} in frame {orientation.frame_id}, from a '
        f'{orientation.source} (exposures: {orientation.exposures})'
    ]
    for name, position, sd, sd_rad in zip(
        orientation.fluoroscopes, orientation.position_mm, orientation.sd_mm, orientation.sd_rad
    ):
        place, error = (
            ', '.join(f'{value:.{digits}f}' for value in values)
            for values, digits in ((position, 2), (sd, 2))
        )
        lines.append(
            f'{name}: source at {place} mm (sd {error}), rotation sd '
            f'{np.rad2deg(np.sqrt(np.mean(sd_rad**2))):.4f} degrees'
        )
    return '\n'.join(lines)


def _distance_from_survey(frames, phantom, calibrations, orientation):
    """RMS distance [mm] of the targets of a capture, intersected in its orientation, from their
    survey, and their number: a check for people, those of all frames together.
    """
    from .calibration.rig_orientation import standing_frames
    from .reconstruction.intersection import Intersector
    from .reconstruction.reconstruct import reconstruct_frame

    found = reconstruct_frame(
        standing_frames(frames, calibrations), calibrations, Intersector(orientation)
    )
    off = found.points.xyz_mm - phantom.xyz_mm[phantom.index(found.target_id)]
    good = np.isfinite(off).all(axis=1)
    return (
        float(np.sqrt(np.mean(np.sum(off[good] ** 2, axis=1)))) if good.any() else float('nan')
    ), int(good.sum())


def _frames_of(options, calibrations):
    """{fluoroscope: [Frame, ...]} of the source, those that are asked for and calibrated. Raises
    DataError.
    """
    from .bags.reader import read_frames
    from .files.observations import read_observations_csv

    if options.source.suffix.lower() == '.csv':
        size = options.image_size or next(iter(calibrations.values())).image_size
        frames = read_observations_csv(options.source, size)
    else:
        # A frame of a recording may be empty, or a point be lost in it: that is no reason to
        # refuse the others.
        frames = read_frames(options.source, check=options.command == 'orient').frames
    wanted = options.fluoroscopes.split(',') if options.fluoroscopes else list(frames)
    for name in wanted:
        if name not in frames:
            raise DataError(
                f'{options.source}: there is no fluoroscope {name!r}, only {", ".join(frames)}'
            )
        if name not in calibrations:
            raise DataError(
                f'{options.calibration}: there is no calibration of fluoroscope {name}, '
                f'only of {", ".join(calibrations)}'
            )
    return {name: frames[name] for name in wanted}
