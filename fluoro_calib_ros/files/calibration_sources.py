"""What a validation needs beside the calibration, and its result: observations.csv, phantom.csv,
options.json and validation.json in the folder of a calibration (docs/verdict.md).
"""

import dataclasses
import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from ..calibration.options import CalibrationOptions
from ..calibration.request import CalibrationRequest
from ..calibration.result import FluoroscopeCalibration, digest_of_sources
from ..errors import DataError
from ..exposures.frame import Frame, validate_frame
from ..exposures.phantom import Phantom
from .access import os_error_reason
from .atomic import write_text
from .json_file import read_json, to_json_values, write_json
from .observations import read_observations_csv, write_observations_csv
from .phantom import read_phantom, write_phantom

OBSERVATIONS = 'observations.csv'
PHANTOM = 'phantom.csv'
OPTIONS = 'options.json'
RESULT = 'validation.json'
VERSION = 1  # of options.json


def write_sources(directory: str | os.PathLike[str], request: CalibrationRequest) -> None:
    """Write what a calibration was made from, and delete the verdict on an earlier one.

    Raises DataError where a file cannot be written.
    """
    directory = Path(directory)
    try:
        (directory / RESULT).unlink(missing_ok=True)
    except OSError as error:
        raise DataError(
            f'{directory / RESULT}: cannot be deleted ({os_error_reason(error)})'
        ) from None
    write_observations_csv(directory / OBSERVATIONS, request.frames)
    write_phantom(directory / PHANTOM, request.phantom)
    document = {
        'format_version': VERSION,
        'options': request.options.to_document(),
        'joint': bool(request.joint),
        'principal_distance': request.principal_distance,
    }
    write_text(
        directory / OPTIONS, json.dumps(to_json_values(document), indent=2, allow_nan=False) + '\n'
    )


def read_sources(
    directory: str | os.PathLike[str],
    calibrations: Mapping[str, FluoroscopeCalibration],
    frames: Mapping[str, Sequence[Frame]] | None = None,
    phantom: Phantom | None = None,
) -> CalibrationRequest:
    """Read the request that the calibrations in a folder were made from.

    Parameters
    ----------
    directory : path-like
    calibrations : mapping of str to FluoroscopeCalibration
        By fluoroscope.
    frames : mapping of str to sequence of Frame, optional
        Used instead of observations.csv.
    phantom : Phantom, optional
        Used instead of phantom.csv.

    Returns
    -------
    CalibrationRequest

    Raises
    ------
    DataError
        For a file that is missing or damaged, and for frames or a phantom that the calibrations
        were not made from.
    """
    directory = Path(directory)
    options, joint, distance = _read_options(directory / OPTIONS)
    where = directory / OBSERVATIONS if frames is None else 'the source'
    if frames is None:
        frames = _read_frames(directory / OBSERVATIONS, calibrations)
    if phantom is None:
        phantom = read_phantom(_there(directory / PHANTOM, '--phantom'))
    for name, calibration in calibrations.items():
        if name not in frames:
            raise DataError(
                f'{where}: there are no observations of fluoroscope {name}, which is calibrated'
            )
        if digest_of_sources(frames[name], phantom) != calibration.source_digest:
            raise DataError(
                f'{where}: these are not the observations and the phantom of which the calibration of '
                f'fluoroscope {name} was made'
            )
    used = {name: frames[name] for name in calibrations}
    return CalibrationRequest(used, phantom, options, joint, distance)


def _there(path, option=''):
    """path, if there is such a file; option: that which can stand for it. Raises DataError."""
    if not path.exists():
        instead = f'give {option}, or calibrate again' if option else 'calibrate again'
        raise DataError(
            f'{path}: there is no such file, the calibration was written without it: {instead}'
        )
    return path


def _read_frames(path, calibrations):
    """Frames of the calibrated fluoroscopes, each with the image size of its calibration."""
    sizes = [c.image_size for c in calibrations.values()]
    largest = tuple(max(size[axis] for size in sizes) for axis in (0, 1))
    found = read_observations_csv(_there(path, '--source'), largest)
    frames = {
        name: [replace(f, image_size=calibrations[name].image_size) for f in of_one]
        for name, of_one in found.items()
        if name in calibrations
    }
    for frame in (f for of_one in frames.values() for f in of_one):
        try:
            validate_frame(frame)
        except DataError as error:
            raise DataError(f'{path}: {error}') from None
    return frames


def _read_options(path):
    """CalibrationOptions, joint and principal distance of a calibration."""
    document = read_json(_there(path))
    if document.get('format_version') != VERSION:
        raise DataError(
            f'{path}: the file has layout version {document.get("format_version")}, this program knows '
            f'version {VERSION}'
        )
    joint = document.get('joint')
    distance = document.get('principal_distance')
    good = isinstance(joint, bool) and (
        distance is None or (type(distance) in (int, float) and distance > 0)
    )
    try:
        options = CalibrationOptions(**document['options'])
    except (KeyError, TypeError, ValueError) as error:
        raise DataError(f'{path}: these are not options of a calibration ({error})') from None
    if not good:
        raise DataError(
            f'{path}: these are not options of a calibration (joint or principal_distance is wrong)'
        )
    return options, joint, distance


def validation_document(validation):
    """Dict of a Validation, as it is written to validation.json."""
    return {
        'verdict': validation.verdict,
        'findings': list(validation.findings),
        'checks': [dataclasses.asdict(check) for check in validation.checks],
        'calibration_id': dict(validation.calibration_id),
        'seconds': validation.seconds,
    }


def write_validation(directory, validation):
    """Write validation.json into a directory. Raises DataError."""
    write_json(Path(directory) / RESULT, validation_document(validation))
