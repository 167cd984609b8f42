# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The conversion job: convert a bag, a result folder or a file of any format to another format."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..correction.angle_field import note_on_angles
from ..correction.base import CorrectionStatus
from ..correction.fluoroscope_calibration import Calibrations, FluoroscopeCalibration
from ..errors import DataError
from ..exposures.angles import AngleOptions
from ..exposures.frame import Frame, Frames
from ..images.corrector import ImageCorrector
from ..io.access import PathLike
from ..io.bags.mcap_file import is_bag
from ..io.bags.reader import read_frames, with_angles
from ..io.calibration import (
    OBSERVATIONS,
    SUFFIX,
    load_calibrations,
    load_orientation,
    orientation_path,
)
from ..io.calibration import PHANTOM as PHANTOM_FILE
from ..io.calibration import RESULT_NAME as RESULT
from ..io.calibration_request import read_calibrated_frames
from ..io.csv_table import read_names
from ..io.documents import read_json
from ..io.formats import registry
from ..io.formats.content import (
    Bodies,
    Camera,
    Content,
    FileSettings,
    Station,
    Written,
    camera_at,
)
from ..io.phantom import read_phantom
from ..photogrammetry.rig_orientation import RigOrientation
from ..photogrammetry.rotations import matrix_from_quaternion
from .result_folder import belongs_to
from .sources import calibrated_settings, require_observed, select_calibrations

PHANTOM_BODY = 'phantom'  # name of the phantom as a rigid body


@dataclass(frozen=True)
class ConversionRequest:
    """Source, target and options of a conversion.

    Attributes
    ----------
    source : path-like
        Bag, result folder, file of any format, or folder with one file per camera.
    kind : str
        Format to write, one of `registry.FORMATS`.
    out : path-like
        File to write; for formats with one file per fluoroscope, folder to write.
    source_kind : str or None
        Format of the source; if None, it is recognised.
    exposure : int or None
        Exposure of a result folder whose exterior orientations the cameras have, in the frame of
        the phantom; if None, the orientation of the rig is used.
    calibration : path-like or None
        Result folder whose image size and names apply to the source.
    corrected : bool
        Whether image points are corrected by this calibration.
    fluoroscopes : sequence of str
        Those to convert, in this order; empty: all.
    settings : FileSettings
        Conventions that files do not state. The unit applies to source and output. Pixels from 1
        and rows upwards apply to the source if it is of another program, else to the output.
    out_units : {'mm', 'cm', 'm'} or None
        Unit of the output.
    angle : float or None
        Angle of the C-arm [rad] for corrections that are written, and for corrected points without
        their own angle; None: the mean over the exposures.
    angles : AngleOptions
        Joints that give the angles of the frames of a bag.
    """

    source: PathLike
    kind: str
    out: PathLike
    source_kind: str | None = None
    exposure: int | None = None
    calibration: PathLike | None = None
    corrected: bool = False
    fluoroscopes: Sequence[str] = ()
    settings: FileSettings = field(default_factory=FileSettings)
    out_units: str | None = None
    angle: float | None = None
    angles: AngleOptions = field(default_factory=AngleOptions)


def convert(request: ConversionRequest) -> Written:
    """Convert a source into another format.

    Raises DataError if the source cannot be read or lacks what the format needs, or if the output
    cannot be written.
    """
    settings = request.settings
    calibrations: Calibrations = {}
    if request.calibration is not None:
        calibrations = load_calibrations(request.calibration)
        settings = calibrated_settings(settings, request.calibration, calibrations)
    wanted = registry.FORMATS[request.kind].parts
    read_settings = replace(settings, wanted=wanted, fluoroscopes=tuple(request.fluoroscopes))
    content, is_own = _read(request, read_settings)
    content = replace(content, names=settings.names.merged(content.names))
    content = _selected(content, request)
    if request.corrected:
        observations, notes = _corrected(content, calibrations, request)
        require_observed(request.source, content.corrected_by)
        content = replace(
            content,
            observations=observations,
            notes=(*content.notes, *notes),
            corrected_by={name: calibrations[name].calibration_id for name in observations},
        )
    written = _write(request, content, is_own)
    notes = _lost_angles(request, content.observations or {})
    return Written(written.paths, (*content.notes, *written.notes, *notes))


def _read(request: ConversionRequest, settings: FileSettings) -> tuple[Content, bool]:
    """Return the content of the source, and whether it uses the conventions of this package."""
    source = Path(request.source)
    from_bag = not is_result_folder(source) and request.source_kind is None and is_bag(source)
    if request.angles.angle_joint and not request.angles.of_rig and not from_bag:
        raise DataError(f'{source}: the angle of a joint needs a bag, which this is not')
    if is_result_folder(source):
        return result_content(source, settings, request.exposure, request.angle), True
    if request.exposure is not None:
        raise DataError(f'{source}: --exposure is for a result folder')
    if from_bag:
        contents = read_frames(source)
        frames, notes = with_angles(source, contents.frames, request.angles)
        return Content(observations=frames, notes=(*contents.notes, *notes)), True
    content = registry.read(source, settings, request.source_kind)
    kind = request.source_kind
    if kind is None and source.is_file():
        recognised = registry.recognised(source)
        kind = recognised.kind if recognised else ''
    return content, kind in ('observations', 'phantom', 'points', 'poses', 'grid')


def _lost_angles(request: ConversionRequest, observations: Frames) -> tuple[str, ...]:
    """Return a note if angles of the C-arm are lost in the output."""
    has_angle = any(
        frame.angle is not None for frames in observations.values() for frame in frames
    )
    holds_angles = request.kind == 'observations'
    parts = registry.FORMATS[request.kind].parts
    if holds_angles or not has_angle or 'observations' not in parts:
        return ()
    return (f'{request.out}: this format has no angles of the C-arm, they are not written',)


def is_result_folder(path: Path) -> bool:
    """Return whether a path is a folder with calibrations."""
    return path.is_dir() and any(name.name.endswith(SUFFIX) for name in path.iterdir())


def _selected(content: Content, request: ConversionRequest) -> Content:
    """Return the content of the requested fluoroscopes. Raises DataError."""
    wanted = list(request.fluoroscopes)
    if not wanted:
        return content
    cameras_by_name = {camera.name: camera for camera in content.cameras}
    tables: list[Mapping[str, Any]] = [cameras_by_name, content.lookups, content.grids]
    tables.append(content.observations or {})
    names = list(dict.fromkeys(name for table in tables for name in table))
    for name in wanted:
        if names and name not in names:
            raise DataError(
                f'{request.source}: there is no fluoroscope {name!r}, only {", ".join(names)}'
            )
    cameras, lookups, grids, observations = (
        {name: table[name] for name in wanted if name in table} for table in tables
    )
    return replace(
        content,
        cameras=tuple(cameras.values()),
        lookups=lookups,
        grids=grids,
        observations=observations or None,
        stations=tuple(s for s in content.stations if s.fluoroscope in wanted),
    )


def _write(request: ConversionRequest, content: Content, is_own: bool) -> Written:
    settings = request.settings
    keeps_unit = not registry.FORMATS[request.kind].says_units
    units = request.out_units or (settings.units if keeps_unit else None)
    if not is_own:
        settings = replace(settings, one_based=False, y_up=False)
    return registry.write(request.out, request.kind, content, replace(settings, units=units))


def _corrected(
    content: Content, calibrations: Calibrations, request: ConversionRequest
) -> tuple[dict[str, list[Frame]], tuple[str, ...]]:
    """Return frames with the image points that could be corrected, and notes."""
    out: dict[str, list[Frame]] = {}
    notes: list[str] = []
    observations = content.observations or {}
    select_calibrations(calibrations, observations, request.source)
    for name, frames in observations.items():
        out[name] = []
        angles = [frame.angle for frame in frames]
        note = note_on_angles(name, calibrations[name].angle_field, angles)
        if note and request.angle is None:
            notes.append(f'{request.source}: {note}')
        for frame in frames:
            angle = request.angle if frame.angle is None else frame.angle
            points = calibrations[name].correct(frame.uv, frame.sigma, angle=angle)
            valid = points.status != CorrectionStatus.INVALID
            out[name].append(replace(frame, uv=points.uv, sigma=points.sigma).rows(valid))
    return out, tuple(notes)


# ---- result folders


def result_content(
    directory: PathLike,
    settings: FileSettings | None = None,
    exposure: int | None = None,
    angle: float | None = None,
) -> Content:
    """Return the wanted parts of a result folder, for the fluoroscopes named in settings.

    exposure: the one whose exterior orientations the cameras have; angle: of the C-arm [rad], for
    corrections that depend on it. Raises DataError.
    """
    directory = Path(directory)
    settings = settings or FileSettings()
    wanted = set(settings.wanted)
    calibrations = load_calibrations(directory)
    parts: dict[str, Any] = {'names': read_names(directory)}
    stations: tuple[Station, ...] = ()
    if {'stations', 'bodies'} & wanted or exposure is not None:
        stations = tuple(stations_of(directory / RESULT))
        parts['stations'] = stations
    orientation = _orientation(directory, calibrations)
    if 'cameras' in wanted:
        poses = _poses(directory, stations, orientation, exposure)
        parts['cameras'] = tuple(_camera(c, poses) for c in calibrations.values())
    if 'bodies' in wanted:
        parts['bodies'] = _phantom_poses(directory, stations, orientation)
    if 'lookups' in wanted:
        names = select_calibrations(calibrations, settings.fluoroscopes or calibrations, directory)
        parts['lookups'] = {name: _lookup(c.at_angle(angle)) for name, c in names.items()}
        turning = [name for name, c in names.items() if c.angle_field is not None]
        if turning and angle is None:
            parts['notes'] = (
                f'{directory}: the corrections of {", ".join(turning)} depend on the angle of the '
                'C-arm: lookup tables are the mean over the angles, --angle-deg is not given',
            )
    if 'survey' in wanted and (directory / PHANTOM_FILE).exists():
        parts['survey'] = read_phantom(directory / PHANTOM_FILE)
    if 'observations' in wanted and (directory / OBSERVATIONS).exists():
        parts['observations'] = read_calibrated_frames(directory, calibrations)
    return Content(**parts)


def _orientation(directory: Path, calibrations: Calibrations) -> RigOrientation | None:
    """Return the orientation of the rig, or None. Raises DataError if it does not belong here."""
    path = Path(orientation_path(directory))
    if not path.exists():
        return None
    orientation = load_orientation(path)
    if not belongs_to(orientation, calibrations):
        raise DataError(
            f'{path}: the orientation belongs to other calibrations than those in the folder'
        )
    return orientation


def stations_of(path: Path) -> Iterable[Station]:
    """Yield the exterior orientations of a result.json. Raises DataError."""
    document = read_json(path)
    try:
        for name, fluoroscope in document['fluoroscopes'].items():
            for entry in fluoroscope['exposures']:
                quaternion = np.array(entry['quaternion_wxyz'], dtype=float)
                position = np.array(entry['position_mm'], dtype=float)
                if not math.isclose(float(np.linalg.norm(quaternion)), 1, abs_tol=1e-6):
                    raise ValueError
                rotation = matrix_from_quaternion(quaternion)
                yield Station(str(name), int(entry['exposure']), rotation, position)
    except (AttributeError, KeyError, TypeError, ValueError):
        raise DataError(f'{path}: this is not the result of a calibration') from None


Poses = Mapping[str, tuple[NDArray[np.float64], NDArray[np.float64]]]


def _poses(
    directory: Path,
    stations: Sequence[Station],
    orientation: RigOrientation | None,
    exposure: int | None,
) -> Poses:
    """Return rotation and position of each fluoroscope with known ones. Raises DataError."""
    if exposure is None:
        if orientation is None:
            return {}
        poses = zip(orientation.rotation, orientation.position_mm)
        return dict(zip(orientation.fluoroscopes, poses))
    known_poses = {
        s.fluoroscope: (s.rotation, s.position_mm) for s in stations if s.exposure == exposure
    }
    if not known_poses:
        raise DataError(f'{directory / RESULT}: there is no exposure {exposure}')
    return known_poses


def _camera(calibration: FluoroscopeCalibration, poses: Poses) -> Camera:
    """Return the camera of the corrected images of a fluoroscope."""
    xp, yp, c = calibration.interior.tolist()
    matrix = np.array([[c, 0, xp], [0, c, yp], [0, 0, 1]])
    name = calibration.fluoroscope
    if name not in poses:
        return Camera(name, matrix, calibration.image_size)
    return camera_at(name, matrix, calibration.image_size, *poses[name])


def _lookup(calibration: FluoroscopeCalibration) -> NDArray[np.float32]:
    """Return the observed pixel (2, h, w) of each corrected pixel, NaN outside the support."""
    corrector = ImageCorrector(calibration)
    return np.where(corrector.status == CorrectionStatus.OK, corrector.source, np.float32(np.nan))


def _phantom_poses(
    directory: Path, stations: Sequence[Station], orientation: RigOrientation | None
) -> Bodies:
    """Return the poses of the phantom in the rig frame, as seen by the first fluoroscope.

    Without an orientation of the rig, they are in the optical frame of that fluoroscope.
    """
    first = stations[0].fluoroscope if orientation is None else orientation.fluoroscopes[0]
    first_stations = sorted(
        (s for s in stations if s.fluoroscope == first), key=lambda s: s.exposure
    )
    if not first_stations:
        raise DataError(f'{directory / RESULT}: there are no exposures of fluoroscope {first}')
    to_rig = np.eye(3) if orientation is None else orientation.rotation[0].T
    origin = np.zeros(3) if orientation is None else orientation.position_mm[0]
    rotation = np.array([to_rig @ s.rotation for s in first_stations])
    translation = np.array([origin - to_rig @ s.rotation @ s.position_mm for s in first_stations])
    numbers = np.array([s.exposure for s in first_stations])
    return Bodies((PHANTOM_BODY,), numbers, rotation[:, None], translation[:, None])
