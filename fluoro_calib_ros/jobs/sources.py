# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Reading of job input: frames and phantoms from bags and files of any format, calibrations."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..brief import brief_repr
from ..correction.angle_field import note_on_angles
from ..correction.fluoroscope_calibration import Calibrations, FluoroscopeCalibration
from ..errors import DataError, ErrorsAt
from ..exposures.angles import AngleOptions
from ..exposures.collector import collect_recorded
from ..exposures.decisions import decided
from ..exposures.frame import Frame, Frames
from ..exposures.names import Names
from ..exposures.pairing import PairingOptions, disagreement_of_recording
from ..exposures.phantom import Phantom, require_size
from ..findings import Kind, sentences
from ..io.access import PathLike
from ..io.bags.mcap_file import is_bag
from ..io.bags.reader import joint_topics, read_frames, with_angles
from ..io.calibration import disagreements, load_calibrations
from ..io.csv_table import read_names
from ..io.decisions import read_decisions
from ..io.formats import registry
from ..io.formats.content import PARTS, Content, FileSettings
from ..io.formats.native import holds_known_orientations, read_known_orientations
from ..io.observations import (
    CORRECTED_BY,
    PointsFile,
    observation_table,
    points_of_frames,
    read_points,
)
from ..photogrammetry.plane_resection import frames_without_partner
from ..photogrammetry.rig_orientation import KnownOrientation

if TYPE_CHECKING:
    import pandas


@dataclass(frozen=True)
class Recording:
    """Frames of a source.

    Attributes
    ----------
    frames : dict of str to list of Frame
        By fluoroscope.
    unpaired : mapping of str to int
        Number of excluded frames without partner, by fluoroscope.
    names : Names
        Known names, merged with those of the source.
    notes : tuple of str
        Notes for the user about the source.
    radiographs : mapping of str to mapping of int to bytes
        Small JPEGs by fluoroscope and exposure, if the source has images.
    """

    frames: dict[str, list[Frame]]
    unpaired: Mapping[str, int] = field(default_factory=dict)
    names: Names = field(default_factory=Names)
    notes: tuple[str, ...] = ()
    radiographs: Mapping[str, Mapping[int, bytes]] = field(default_factory=dict)

    def __repr__(self) -> str:
        counts = ', '.join(f'{name}: {len(frames)} frames' for name, frames in self.frames.items())
        return f'<Recording {counts or "empty"}>'

    def to_dataframe(self) -> pandas.DataFrame:
        """Return the observations as a pandas DataFrame. Raises DataError without pandas."""
        frames = [
            frame for fluoroscope_frames in self.frames.values() for frame in fluoroscope_frames
        ]
        return observation_table(frames, self.names).to_dataframe()


@dataclass(frozen=True)
class BagSelection:
    """Selection of the frames of a bag, and how they are paired."""

    #: time window relative to the stamp of the first frame [s]; None: unlimited
    start_s: float | None = None
    end_s: float | None = None
    pair_by: str = 'frame_number'  #: {'frame_number', 'stamp'}
    #: largest difference between the stamps of an exposure [s]
    tolerance_s: float = PairingOptions.tolerance_s
    #: joint that gives the angle of the C-arm
    angles: AngleOptions = field(default_factory=AngleOptions)
    phantom: Phantom | None = None  #: what the frames show; frames of its sheets need no partner

    def check_file(self, path: object) -> None:
        """Raise DataError if the selection needs the times that a file does not have."""
        if self.start_s is not None or self.end_s is not None or self.pair_by == 'stamp':
            raise DataError(
                f'{path}: a time window and the pairing by stamp need a bag, this file does not '
                'contain the times of its exposures'
            )
        if self.angles.angle_joint and not self.angles.of_rig:
            raise DataError(
                f'{path}: the angle of a joint needs a bag; a CSV file has the angles in a column '
                'angle_deg'
            )

    def frames(self, path: object, recorded: Frames) -> dict[str, list[Frame]]:
        """Return the frames in the time window. Raises DataError if a fluoroscope has none."""
        origin = min(frame.stamp_ns for frames in recorded.values() for frame in frames)
        low = -math.inf if self.start_s is None else self.start_s
        high = math.inf if self.end_s is None else self.end_s
        selected = {
            name: [frame for frame in frames if low <= (frame.stamp_ns - origin) * 1e-9 <= high]
            for name, frames in recorded.items()
        }
        for name, frames in selected.items():
            if not frames:
                last = max(frame.stamp_ns for frame in recorded[name])
                raise DataError(
                    f'{path}: there is no frame of fluoroscope {name} in the time window, its '
                    f'last frame is at {(last - origin) * 1e-9:.3f} s'
                )
        return selected


@dataclass(frozen=True)
class Survey:
    """A phantom, the names of its beads, and notes for the user about them."""

    __repr__ = brief_repr

    phantom: Phantom
    names: Names
    notes: tuple[str, ...] = ()


def read_content(path: PathLike, settings: FileSettings, part: str, default: str) -> Content:
    """Read a part of a file of any format.

    default: kind of a CSV file that is not recognised, whose reader then reports what is wrong.
    Raises DataError for a format without this part.
    """
    format_ = registry.recognised(path)
    kind = None if format_ else default if Path(path).suffix.lower() == '.csv' else None
    if format_ and part not in format_.parts:
        parts = ' and '.join(PARTS[name] for name in format_.parts)
        needed = f'{PARTS[part]} {"is" if part == "survey" else "are"} needed'
        if part == 'survey' and format_.kind in ('dlt', 'mayacam1'):  # rows of numbers
            needed += '; if the rows are beads, name their columns in a header, such as x,y,z'
        raise DataError(
            f'this looks like {format_.title} ({format_.kind}), which has {parts}, but {needed}',
            at=path,
            kind=Kind.WRONG_FORMAT,
        )
    return registry.read(path, replace(settings, wanted=(part,)), kind)


def read_survey(path: PathLike, settings: FileSettings | None = None) -> Survey:
    """Read a phantom from a file of any format. Raises DataError."""
    content = read_content(path, settings or FileSettings(), 'survey', 'phantom')
    if content.survey is None:
        raise DataError(f'{path}: the file has no phantom')
    with ErrorsAt(path):
        require_size(content.survey)
    return Survey(content.survey, content.names, content.notes)


def read_orientations(
    paths: Iterable[PathLike], settings: FileSettings
) -> dict[str, KnownOrientation]:
    """Read known orientations of fluoroscopes, by name.

    paths: YAML files of docs/special_rigs.md, or camera files of any format, such as MayaCam 2.
    Raises DataError, also for a fluoroscope that occurs in two files.
    """
    out: dict[str, KnownOrientation] = {}
    for path in paths:
        if holds_known_orientations(path):
            orientations = read_known_orientations(path)
        else:
            orientations = _orientations_of_cameras(path, settings)
        for name in orientations:
            if name in out:
                raise DataError(f'{path}: the orientation of fluoroscope {name} is already given')
        out |= orientations
    return out


def _orientations_of_cameras(
    path: PathLike, settings: FileSettings
) -> dict[str, KnownOrientation]:
    """Read the cameras of a file. Raises DataError for a camera without position and attitude."""
    content = read_content(path, settings, 'cameras', 'camera')
    out = {}
    for camera in content.cameras:
        with ErrorsAt(f'{path}, camera {camera.name}'):
            out[camera.name] = KnownOrientation.from_matrices(camera.matrix, *camera.pose)
    return out


def read_source(
    path: PathLike,
    *,
    image_size: tuple[int, int] | None = None,
    fluoroscopes: Sequence[str] | None = None,
    collect: str | None = None,
    validate: bool = True,
    settings: FileSettings | None = None,
    selection: BagSelection | None = None,
) -> Recording:
    """Read the frames of a bag, or of a file with image points of any format.

    Parameters
    ----------
    path : path-like
        A bag (file or folder), a CSV file `fluoroscope,exposure,target_id,u,v[,sigma]`, or a file
        of another program (docs/formats.md).
    image_size : (int, int), optional
        Width and height [px]; required for a file that does not contain it.
    fluoroscopes : sequence of str, optional
        Names of those to read, in this order; by default all. If there are as many names as
        cameras and none occurs in the file, they name the cameras that the file only numbers.
    collect : {'auto', 'all', 'still'}, optional
        How exposures are collected from a bag; by default all frames are returned, including
        unpaired ones. A CSV file already consists of exposures.
    validate : bool
        Whether every frame of a bag is validated; otherwise only the lengths of its arrays are.
    settings : exchange.content.FileSettings, optional
        Conventions that the file does not state, and known names.
    selection : BagSelection, optional
        Time window and pairing; pairing by stamp also renumbers the frames by exposure.

    Raises
    ------
    DataError
        For a source that cannot be read, and for a fluoroscope that it does not contain.
    """
    settings = settings or FileSettings()
    selection = selection or BagSelection()
    bag = Path(path).is_dir() or is_bag(path)  # the reader refuses a folder that is no bag
    if bag:
        contents = read_frames(path, validate)
        observations = selection.frames(path, contents.frames)
        observations, notes = with_angles(path, observations, selection.angles)
        content = Content(notes=(*contents.notes, *notes))
    else:
        selection.check_file(path)
        settings = replace(settings, image_size=image_size, fluoroscopes=tuple(fluoroscopes or ()))
        observations, content = _observed(path, settings)
    names = settings.names.merged(content.names)
    selected = list(observations) if fluoroscopes is None else list(fluoroscopes)
    for name in selected:
        if name not in observations:
            raise DataError(
                f'{path}: there is no fluoroscope {name!r}, only {", ".join(observations)}'
            )
    frames = {name: observations[name] for name in selected}
    if not bag or (collect is None and selection.pair_by == 'frame_number'):
        return with_decisions(Recording(frames, {}, names, content.notes), settings.decisions)
    notes = content.notes
    if selection.pair_by == 'frame_number':
        disagreement = disagreement_of_recording(frames)
        notes = (*notes, disagreement.at(path).sentence) if disagreement else notes
    collected = collect_recorded(
        frames,
        collect or 'all',
        selection.pair_by,
        tolerance_s=selection.tolerance_s,
        alone=frames_without_partner(selection.phantom),
    )
    return with_decisions(Recording(*collected, names, notes), settings.decisions)


def with_decisions(recording: Recording, path: PathLike | None) -> Recording:
    """Return a recording with the decisions in a table applied, if any. Raises DataError."""
    if path is None:
        return recording
    decisions = read_decisions(path, recording.names)
    frames, (exposures, points, renamed) = decided(recording.frames, decisions)
    note = (
        f'{path}: by decision, {exposures} exposures and {points} further image points are '
        f'excluded, and {renamed} have another id'
    )
    return replace(recording, frames=frames, notes=(*recording.notes, note))


def _observed(path: PathLike, settings: FileSettings) -> tuple[dict[str, list[Frame]], Content]:
    """Read the frames of a file, and its other content. Raises DataError."""
    content = read_content(path, settings, 'observations', 'observations')
    require_observed(path, content.corrected_by)
    observations = {name: list(frames) for name, frames in (content.observations or {}).items()}
    if not observations:
        raise DataError(f'{path}: the file has no image points')
    return observations, content


def select_calibrations(
    calibrations: Calibrations, fluoroscopes: Iterable[str], where: PathLike = ''
) -> dict[str, FluoroscopeCalibration]:
    """Return the calibrations of some fluoroscopes.

    where: start of the message of the DataError that is raised for a missing calibration.
    """
    place = f'{where}: ' if where else ''
    if not calibrations:
        raise DataError(f'{place}there is no calibration')
    for name in fluoroscopes:
        if name not in calibrations:
            raise DataError(
                f'{place}there is no calibration of fluoroscope {name!r}, '
                f'only of {", ".join(calibrations)}{_numbered_hint(name, calibrations)}'
            )
    return {name: calibrations[name] for name in fluoroscopes}


def _numbered_hint(name: str, calibrations: Calibrations) -> str:
    """Return advice for a camera that its file only numbers."""
    if not re.fullmatch(r'cam\d+', name):
        return ''
    return f'; name the cameras of the file with --fluoroscopes {",".join(calibrations)}'


def read_calibrations(
    directory: PathLike, fluoroscopes: Sequence[str] | None = None
) -> dict[str, FluoroscopeCalibration]:
    """Read the calibrations in a result folder, by default all.

    Raises DataError for a folder without calibrations, a missing calibration, and a damaged file.
    """
    calibrations = load_calibrations(directory)
    return select_calibrations(
        calibrations, calibrations if fluoroscopes is None else fluoroscopes, directory
    )


def calibrated_settings(
    settings: FileSettings, directory: PathLike, calibrations: Calibrations
) -> FileSettings:
    """Return settings with the names of a result folder and the image sizes of calibrations."""
    sizes = {name: calibration.image_size for name, calibration in calibrations.items()}
    return replace(settings, names=read_names(directory).merged(settings.names), sizes=sizes)


def require_observed(path: object, corrected_by: Mapping[str, str]) -> None:
    """Raise DataError for image points that are already corrected by a calibration."""
    for name, identity in corrected_by.items():
        raise DataError(
            f'{path}: the image points of fluoroscope {name} are already corrected, by the '
            f'calibration {identity}: give the observed image points, or remove the column '
            f'{CORRECTED_BY} if this is wrong'
        )


def read_calibrated_source(
    path: PathLike,
    directory: PathLike,
    *,
    settings: FileSettings | None = None,
    selection: BagSelection | None = None,
    **options: Any,
) -> tuple[Recording, dict[str, FluoroscopeCalibration]]:
    """Read all frames of a source whose fluoroscopes are calibrated, and all calibrations.

    Parameters
    ----------
    path : path-like
        A bag or a file of any format.
    directory : path-like
        The result folder with the calibrations, whose names are known.
    settings, selection, **options
        As in `read_source`; image sizes are by default those of the calibrations.

    Returns
    -------
    recording : Recording
    calibrations : dict of str to FluoroscopeCalibration

    Raises
    ------
    DataError
        Also for a fluoroscope of the source without calibration.
    """
    calibrations = read_calibrations(directory)
    recording = read_source(
        path,
        settings=calibrated_settings(settings or FileSettings(), directory, calibrations),
        selection=selection,
        **options,
    )
    select_calibrations(calibrations, recording.frames, directory)
    angle_notes = _unknown_angles(path, recording.frames, calibrations, selection)
    disagreement_notes = sentences(disagreements(directory, calibrations))
    return replace(
        recording, notes=(*recording.notes, *angle_notes, *disagreement_notes)
    ), calibrations


def _unknown_angles(
    path: PathLike, frames: Frames, calibrations: Calibrations, selection: BagSelection | None
) -> Iterable[str]:
    """Yield a note for each fluoroscope whose correction needs angles that are unknown."""
    for name, fluoroscope_frames in frames.items():
        angles = [frame.angle for frame in fluoroscope_frames]
        note = note_on_angles(name, calibrations[name].angle_field, angles)
        if not note:
            continue
        hint = ''
        if not (selection and selection.angles.angle_joint) and is_bag(path):
            topics = joint_topics(path)
            if topics:
                hint = f'; name the joint on {", ".join(topics)} with --angle-joint'
        yield f'{path}: {note}{hint}'


def read_point_table(path: PathLike, settings: FileSettings) -> tuple[PointsFile, tuple[str, ...]]:
    """Read image points to be corrected with calibrations, and notes about them.

    settings: those of `calibrated_settings`. A CSV file with columns u and v keeps its rows and
    other columns; a file of another program is converted to one row per point. Raises DataError.
    """
    names = settings.names
    recognised = registry.recognised(path)
    if (
        recognised is None
        or recognised.kind == 'observations'
        or 'observations' not in recognised.parts
    ):
        return read_points(path, names.fluoroscopes), ()
    content = read_content(path, settings, 'observations', recognised.kind)
    points = points_of_frames(path, content.observations or {}, names.merged(content.names))
    return points, content.notes
