# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Inputs of a calibration: observations.csv, phantom.csv and options.json in its folder.

A validation reads them; see docs/verdict.md.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path

from ..correction.fluoroscope_calibration import (
    Calibrations,
    digest_of_sources,
)
from ..errors import DataError, ErrorsAt
from ..estimation.options import CalibrationOptions, CalibrationRequest
from ..exposures.frame import Frame, Frames, validate_frame
from ..exposures.phantom import Phantom
from ..images.codec import JPEG_START
from ..limits import MEGABYTE
from .access import (
    PathLike,
    check_layout_version,
    check_safe_name,
    make_folder,
    read_bytes,
    write_bytes,
)
from .calibration import KNOWN_ORIENTATION, OBSERVATIONS, OPTIONS, PHANTOM
from .csv_table import read_names, write_names
from .documents import read_json, write_json
from .formats.native import read_known_orientations, write_known_orientations
from .observations import read_observations_csv, write_observations_csv
from .phantom import read_phantom, write_phantom

VERSION = 1  # version of options.json


def write_request(directory: PathLike, request: CalibrationRequest) -> None:
    """Write the inputs of a calibration into a new folder.

    Raises DataError if a file cannot be written.
    """
    directory = Path(directory)
    write_observations_csv(directory / OBSERVATIONS, request.frames)
    write_phantom(directory / PHANTOM, request.phantom)
    document = {
        'format_version': VERSION,
        'options': request.options.to_document(),
        'joint': bool(request.joint),
        'principal_distance': request.principal_distance,
        'about': dict(request.about),
    }
    write_json(directory / OPTIONS, document)
    write_names(directory, request.names)
    if request.known_orientations:
        write_known_orientations(directory / KNOWN_ORIENTATION, request.known_orientations)


def read_request(
    directory: PathLike,
    calibrations: Calibrations,
    frames: Frames | None = None,
    phantom: Phantom | None = None,
) -> CalibrationRequest:
    """Read the request from which the calibrations in a folder were made.

    Parameters
    ----------
    directory : path-like
    calibrations : mapping of str to FluoroscopeCalibration
        By fluoroscope.
    frames : mapping of str to sequence of Frame, optional
        Used instead of observations.csv.
    phantom : Phantom, optional
        Used instead of phantom.csv.

    Raises
    ------
    DataError
        For a missing or damaged file, and for frames or a phantom from which the calibrations
        were not made.
    """
    directory = Path(directory)
    options, joint, distance = read_options(directory / OPTIONS)
    where: object = 'the source'
    if frames is None:
        where = directory / OBSERVATIONS
        frames = read_calibrated_frames(directory, calibrations)
    if phantom is None:
        phantom = read_phantom(_require_file(directory / PHANTOM, '--phantom'))
    for name, calibration in calibrations.items():
        if name not in frames:
            raise DataError(
                f'{where}: there are no observations of fluoroscope {name}, which is calibrated'
            )
        if digest_of_sources(frames[name], phantom) != calibration.source_digest:
            raise DataError(
                f'{where}: these are not the observations and the phantom from which the '
                f'calibration of fluoroscope {name} was made'
            )
    calibrated_frames = {name: frames[name] for name in calibrations}
    names = read_names(directory)
    path = directory / KNOWN_ORIENTATION
    known_orientations = read_known_orientations(path) if path.exists() else {}
    return CalibrationRequest(
        calibrated_frames,
        phantom,
        options=options,
        joint=joint,
        principal_distance=distance,
        names=names,
        known_orientations=known_orientations,
    )


def _require_file(path: Path, option: str = '') -> Path:
    """Return the path if the file exists, otherwise raise DataError.

    option: command-line option that can be given instead.
    """
    if not path.exists():
        remedy = f'give {option}, or calibrate again' if option else 'calibrate again'
        raise DataError(
            f'{path}: there is no such file, the calibration was written without it: {remedy}'
        )
    return path


def read_calibrated_frames(directory: Path, calibrations: Calibrations) -> dict[str, list[Frame]]:
    """Read the frames from which the calibrations in a folder were made. Raises DataError."""
    path = directory / OBSERVATIONS
    widths, heights = zip(*(c.image_size for c in calibrations.values()))
    all_frames = read_observations_csv(
        _require_file(path, '--source'), (max(widths), max(heights))
    )
    frames: dict[str, list[Frame]] = {}
    with ErrorsAt(path):
        for name, view_frames in all_frames.items():
            if name in calibrations:
                size = calibrations[name].image_size
                frames[name] = [replace(frame, image_size=size) for frame in view_frames]
                for frame in frames[name]:
                    validate_frame(frame)
    return frames


def read_options(path: Path) -> tuple[CalibrationOptions, bool, float | None]:
    """Read the options of a calibration, whether it was joint, and its principal distance [px]."""
    document = read_json(_require_file(path))
    check_layout_version(path, document.get('format_version'), VERSION)
    try:
        options = CalibrationOptions(**document['options'])
    except (KeyError, TypeError, ValueError) as error:
        raise DataError(f'{path}: these are not options of a calibration ({error})') from None
    joint = document.get('joint')
    distance = document.get('principal_distance')
    is_distance = distance is None or (type(distance) in (int, float) and distance > 0)
    if not isinstance(joint, bool) or not is_distance:
        raise DataError(
            f'{path}: these are not options of a calibration '
            f'(joint or principal_distance is wrong)'
        )
    return options, joint, distance


# The folder DIR/radiographs: small JPEGs of exposures that were extracted from images.
#
# A file is named <fluoroscope>_<exposure>.jpg.

RADIOGRAPHS = 'radiographs'

Radiographs = Mapping[str, Mapping[int, bytes]]  # JPEG content by fluoroscope and exposure


def write_radiographs(directory: PathLike, radiographs: Radiographs) -> None:
    """Write the radiographs of a result into its folder. Raises DataError."""
    if any(radiographs.values()):
        make_folder(Path(directory) / RADIOGRAPHS)
    for name, view_radiographs in radiographs.items():
        check_safe_name(name, directory)
        for exposure, content in view_radiographs.items():
            write_bytes(_path(directory, name, exposure), content)


def read_radiographs(
    directory: PathLike, wanted: Iterable[tuple[str, int]]
) -> dict[str, dict[int, bytes]]:
    """Return the existing radiographs of the wanted fluoroscopes and exposures.

    Raises DataError for a file that is too large or not a JPEG.
    """
    radiographs: dict[str, dict[int, bytes]] = {}
    for name, exposure in wanted:
        path = _path(directory, name, exposure)
        if not path.is_file():
            continue
        if path.stat().st_size > MEGABYTE:  # 512 x 512 px without compression: a quarter of it
            raise DataError(
                f'{path}: this is not a small radiograph, it has over {MEGABYTE} bytes'
            )
        content = read_bytes(path)
        if not content.startswith(JPEG_START):
            raise DataError(f'{path}: this is not a JPEG image')
        radiographs.setdefault(name, {})[exposure] = content
    return radiographs


def _path(directory: PathLike, name: str, exposure: int) -> Path:
    return Path(directory) / RADIOGRAPHS / f'{name}_{exposure}.jpg'
