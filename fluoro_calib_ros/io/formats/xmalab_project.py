# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""XMALab project (.xma), read only: a ZIP file with project.xml and the files that it names.

The layout is that of `ProjectFileIO` of XMALab 2.2.7, project version 0.3. The following is read:
the detected points of the calibration object (those that XMALab marks as inliers), the markers of
a trial, the frame specification, the cameras with their calibrated poses, and the points of the
undistortion grids. Points are those of the observed, distorted image, pixel centres at integers
from (0, 0), v downwards. The exposure is the number of the calibration image or of the frame of a
trial, counted from 1. Lengths have the unit of the frame specification, which XMALab does not
state: by default cm, as there.
"""

from __future__ import annotations

import posixpath
import sys
import zipfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from ...errors import DataError, ErrorsAt
from ...exposures.frame import Frame
from ...exposures.names import Names, number_names, safe_names, without_trivial
from ...images.codec import check_size, declared_size
from ...limits import MAX_MEMBER, read_limits
from ..access import os_errors
from ..documents import parse_xml
from .content import Camera, Content, FileSettings, Format, Station, check_matrix, check_rotation
from .phantoms import content_of
from .tables import default_name, frame_of, named_targets, require_width, table_of


def read(path: Path, settings: FileSettings) -> Content:
    """Read the wanted parts of a project. Raises DataError."""
    with _Project(path, settings) as project:
        return _content(project, settings)


def _content(project: _Project, settings: FileSettings) -> Content:
    """Return the wanted parts of an open project."""
    wanted = settings.wanted
    survey = project.survey()
    fluoroscopes = {name: i for name, i in project.ids.items() if name != i}
    names = Names(survey.names.targets, {}, fluoroscopes)
    parts: dict[str, Any] = {'notes': survey.notes if 'survey' in wanted else ()}
    if 'survey' in wanted:
        parts['survey'] = survey.survey
    if 'observations' in wanted:
        if settings.trial is None:
            observations, exposures = _phantom_frames(project, survey)
            names = Names(names.targets, exposures, names.fluoroscopes)
        else:
            observations, targets = _trial_frames(project, survey)
            names = Names(targets, {}, names.fluoroscopes)
        parts['observations'] = observations
    if 'stations' in wanted or 'cameras' in wanted:
        mm, notes = settings.unit_or('cm', str(project.path))
        stations = tuple(_stations(project, mm))
        parts['stations'] = stations
        parts['cameras'] = tuple(_cameras(project, stations))
        parts['notes'] += notes
    if 'grids' in wanted:
        parts['grids'] = dict(_grids(project))
    return Content(names=names, **parts)


def _is_set(element: ElementTree.Element, name: str = 'isCalibrated') -> bool:
    """Return whether a flag of an element is set."""
    value = element.get(name, '0')
    return value.isdigit() and int(value) > 0


DOCUMENT = 'project.xml'


class _Project:
    """An open project, as a context manager, with fluoroscope ids for the camera names.

    root is the root element of project.xml. The constructor raises DataError if the file is not a
    project; the methods raise it for anything missing or damaged.
    """

    def __init__(self, path: Path, settings: FileSettings) -> None:
        self.path = path
        try:
            with os_errors(path, 'cannot be read'):
                self._archive = zipfile.ZipFile(path)
        except zipfile.BadZipFile:
            raise DataError(
                f'{path}: this is not an XMALab project, which is a ZIP file'
            ) from None
        self._members = {
            posixpath.normpath(info.filename.replace('\\', '/')): info
            for info in self._archive.infolist()
        }
        self.root = self._document()
        self.settings = settings
        self.cameras = self.root.findall('Camera')
        if not self.cameras:
            raise DataError(f'{path}, {DOCUMENT}: the project has no cameras')
        self._names = [self.text(camera, 'Name') for camera in self.cameras]
        known_names = settings.names.fluoroscopes
        if len(settings.fluoroscopes) == len(self.cameras) and not set(
            settings.fluoroscopes
        ) & set(self._names):
            known_names = dict(zip(self._names, settings.fluoroscopes))
        self.ids = safe_names(self._names, known_names)

    def __enter__(self) -> _Project:
        return self

    def __exit__(self, *_: object) -> None:
        self._archive.close()

    def _document(self) -> ElementTree.Element:
        root = parse_xml(self.member_text(DOCUMENT), f'{self.path}, {DOCUMENT}')
        if root.tag != 'Project':
            raise DataError(f'{self.path}, {DOCUMENT}: this is not a project of XMALab')
        return root

    def member(self, name: str, most: int = sys.maxsize) -> bytes:
        """Return a file of the archive; it may have at most `most` bytes."""
        info = self._members.get(posixpath.normpath(name.replace('\\', '/')))
        if info is None:
            raise DataError(f'{self.path}: the project does not contain {name}')
        if info.file_size > min(most, read_limits().max_file_bytes):
            raise DataError(f'{self.path}: {name} is too large, {info.file_size} bytes')
        try:
            return self._archive.read(info)
        except Exception as error:  # zipfile and its decompressors raise various exceptions
            raise DataError(f'{self.path}: {name} is damaged ({error})') from None

    def member_text(self, name: str) -> str:
        """Return a file of the archive as text."""
        return self.member(name, MAX_MEMBER).decode('utf-8', 'replace')

    def numbers(self, name: str) -> NDArray[np.float64]:
        """Return a table of numbers. Rows of different lengths are an error, too."""
        rows = table_of(f'{self.path}, {name}', self.member_text(name))
        require_width(rows, len(rows[0].cells), 'the first row')
        return np.array([row.numbers_or_nan() for row in rows])

    def text(self, element: ElementTree.Element, name: str) -> str:
        """Return an attribute of an element."""
        value = element.get(name)
        if value is None:
            raise DataError(f'{self.path}, {DOCUMENT}: a {element.tag} has no attribute {name}')
        return value

    def whole(self, element: ElementTree.Element, name: str) -> int:
        """Return an attribute that is a non-negative integer."""
        text = self.text(element, name)
        if not text.isascii() or not text.isdigit():
            raise DataError(
                f'{self.path}, {DOCUMENT}: {name} of a {element.tag} is {text!r}, not an integer'
            )
        return int(text)

    def file_of(self, element: ElementTree.Element, tag: str) -> str:
        """Return the file name of a child element."""
        child = element.find(tag)
        if child is None:
            raise DataError(f'{self.path}, {DOCUMENT}: a {element.tag} has no {tag}')
        return self.text(child, 'Filename')

    def named(self) -> Iterator[tuple[ElementTree.Element, str]]:
        """Yield the cameras with their fluoroscope ids."""
        for camera, name in zip(self.cameras, self._names):
            yield camera, self.ids[name]

    def survey(self) -> Content:
        """Return the frame specification; an empty Content without one, as for a checkerboard."""
        element = self.root.find('CalibrationObject')
        name = '' if element is None else element.get('FrameSpecifications', '')
        if not name:
            return Content()
        return content_of(Path(f'{self.path}, {name}'), self.member_text(name), self.settings)

    def images(self, camera: ElementTree.Element) -> Iterator[tuple[int, ElementTree.Element]]:
        """Yield the calibration images of a camera with their exposure numbers."""
        for number, image in enumerate(camera.findall('CalibrationImage'), 1):
            yield (self.whole(image, 'Frame') + 1 if image.get('Frame') else number), image

    def image_size(self, camera: ElementTree.Element) -> tuple[int, int]:
        """Return the image size of a camera from its sequence, images or the settings."""
        sequence = camera.find('CalibrationSequence')
        if sequence is not None:
            return self.whole(sequence, 'Width'), self.whole(sequence, 'Height')
        for image in camera.findall('CalibrationImage'):
            if image.get('Width'):
                return self.whole(image, 'Width'), self.whole(image, 'Height')
            name = self.text(image, 'Filename')
            size = declared_size(memoryview(self.member(name)))
            with ErrorsAt(f'{self.path}: {name}'):
                check_size(*size)
            if min(size) > 0:
                return size
        name = self.text(camera, 'Name')
        given = self.settings.size_of(self.ids[name])
        if given is None:
            raise DataError(
                f'{self.path}: the project does not contain the image size of '
                f'{name}, --image-size WxH is needed'
            )
        return given

    def trial(self) -> ElementTree.Element:
        """Return the chosen trial. Raises DataError."""
        trials = {trial.get('Name', ''): trial for trial in self.root.findall('Trial')}
        try:
            return trials[self.settings.trial or '']
        except KeyError:
            raise DataError(
                f'{self.path}: there is no trial {self.settings.trial!r}, only '
                f'{", ".join(trials) or "none"}'
            ) from None


def _phantom_frames(
    project: _Project, survey: Content
) -> tuple[dict[str, list[Frame]], dict[str, int]]:
    """Return the frames of the calibration object, and the numbers of its named exposures."""
    frames: dict[str, list[Frame]] = {}
    exposures: dict[str, int] = {}
    for camera, name in project.named():
        size = project.image_size(camera)
        for number, image in project.images(camera):
            file = posixpath.basename(image.get('Filename', '').replace('\\', '/'))
            if file not in ('', 'external') and number not in exposures.values():
                exposures[file] = number
            if _is_set(image):
                place, target_id, uv = _points_of_image(project, survey, image)
                if len(target_id):
                    frame = frame_of(place, name, number, target_id, uv=uv, image_size=size)
                    frames.setdefault(name, []).append(frame)
    if not frames:
        raise DataError(f'{project.path}: the project has no calibrated images with points')
    return frames, without_trivial(exposures)


def _points_of_image(
    project: _Project, survey: Content, image: ElementTree.Element
) -> tuple[str, NDArray[np.int64], NDArray[np.float64]]:
    """Return place, ids (n,) and points (n, 2) of a calibration image that XMALab used."""
    file = project.file_of(image, 'PointsDetected')
    uv = project.numbers(file)
    inlier = project.numbers(project.file_of(image, 'Inlier'))
    count = len(uv) if survey.survey is None else len(survey.survey.target_id)
    if uv.shape[1:] != (2,) or len(uv) != count or inlier.shape != (count, 1):
        raise DataError(
            f'{project.path}, {file}: {len(uv)} points and {len(inlier)} inliers, but the '
            f'calibration object has {count} beads'
        )
    # Ids in the order of the frame specification.
    ids = np.array(list(survey.names.targets.values()) or range(1, count + 1), dtype=np.int64)
    used = (inlier[:, 0] == 1) & ~(uv == -1).all(axis=1)  # -1, -1: not found
    return f'{project.path}, {file}', ids[used], uv[used]


def _trial_frames(
    project: _Project, survey: Content
) -> tuple[dict[str, list[Frame]], dict[str, int]]:
    """Return the frames of the markers of a trial, and the ids of the markers by name."""
    trial = project.trial()
    where = f'{project.path}, trial {project.settings.trial}'
    markers = trial.findall('Marker')
    if not markers:
        raise DataError(f'{project.path}: the trial {project.settings.trial!r} has no markers')
    labels = [
        marker.get('Description') or default_name(project.whole(marker, 'ID') + 1)
        for marker in markers
    ]
    ids = number_names(labels, project.settings.names.targets or survey.names.targets)
    if len(set(labels)) < len(labels):
        repeated = next(name for name in labels if labels.count(name) > 1)
        raise DataError(f'{project.path}: two markers of the trial are called {repeated!r}')
    tables = [_points_of_marker(project, marker) for marker in markers]
    if len({len(table) for table in tables}) > 1:
        raise DataError(f'{project.path}: the markers of the trial have different frames')
    target_id = np.array([ids[name] for name in labels], dtype=np.int64)
    points = np.stack(tables, axis=2)  # frame, camera, marker
    frames: dict[str, list[Frame]] = {}
    for column, (camera, name) in enumerate(project.named()):
        size = project.image_size(camera)
        for number, uv in enumerate(points[:, column], 1):
            seen = ~np.isnan(uv).any(axis=1)
            if seen.any():
                place = f'{where}, frame {number}'
                seen_id, seen_uv = target_id[seen], uv[seen]
                frame = frame_of(place, name, number, seen_id, uv=seen_uv, image_size=size)
                frames.setdefault(name, []).append(frame)
    return frames, named_targets(ids)


def _points_of_marker(project: _Project, marker: ElementTree.Element) -> NDArray[np.float64]:
    """Return the points of a marker by frame and camera (m, c, 2), NaN where not seen."""
    count = len(project.cameras)
    uv = project.numbers(project.text(marker, 'FilenamePoints2D'))
    status = project.numbers(project.text(marker, 'FilenameStatus2D'))
    if uv.shape != (len(status), 2 * count) or status.shape[1] != count:
        raise DataError(
            f'{project.path}, {project.text(marker, "FilenamePoints2D")}: {uv.shape[1]} columns, '
            f'but there are {count} cameras'
        )
    return np.where((status > 0)[..., None], uv.reshape(len(uv), count, 2), np.nan)


def _stations(project: _Project, mm: float) -> Iterator[Station]:
    """Yield the pose of every calibrated image."""
    for camera, name in project.named():
        for number, image in project.images(camera):
            if not _is_set(image):
                continue
            file = project.file_of(image, 'RotationMatrix')
            rotation = project.numbers(file)
            translation = project.numbers(project.file_of(image, 'TranslationVector')).ravel()
            if rotation.shape != (3, 3) or translation.shape != (3,):
                raise DataError(f'{project.path}, {file}: this is not a pose')
            check_rotation(f'{project.path}, {file}', rotation)
            yield Station(name, number, rotation, -rotation.T @ translation * mm)


def _cameras(project: _Project, stations: tuple[Station, ...]) -> Iterator[Camera]:
    """Yield the calibrated cameras in the frame of the calibration object.

    The poses are those of the reference image of the chosen trial, otherwise of the first image
    in which all cameras are calibrated.
    """
    calibrated = [(camera, name) for camera, name in project.named() if _is_set(camera)]
    reference = _reference(project, stations, {name for _, name in calibrated})
    poses = {s.fluoroscope: s for s in reversed(stations) if s.exposure == reference}
    for camera, name in calibrated:
        file = project.text(camera, 'CameraMatrix')
        matrix = project.numbers(file)
        if matrix.shape != (3, 3):
            raise DataError(f'{project.path}, {file}: this is not a camera matrix')
        check_matrix(f'{project.path}, {file}', matrix)
        distortion: tuple[float, ...] = ()
        if camera.get('UndistortionParameter'):
            parameters = project.numbers(project.text(camera, 'UndistortionParameter'))
            distortion = tuple(parameters.ravel().tolist())
        size = project.image_size(camera)
        unposed = Camera(name, matrix, size, distortion=distortion)
        if name not in poses:
            yield unposed
            continue
        rotation = poses[name].rotation
        translation = -rotation @ poses[name].position_mm
        yield replace(unposed, rotation=rotation, translation_mm=translation)


def _reference(
    project: _Project, stations: tuple[Station, ...], fluoroscopes: set[str]
) -> int | None:
    """Return the exposure from which the poses of the cameras are taken."""
    if project.settings.trial is not None:
        return project.whole(project.trial(), 'referenceCalibration') + 1
    by_exposure: dict[int, set[str]] = {}
    for station in stations:
        by_exposure.setdefault(station.exposure, set()).add(station.fluoroscope)
    return min((e for e, names in by_exposure.items() if names >= fluoroscopes), default=None)


def _grids(project: _Project) -> Iterator[tuple[str, NDArray[np.float64]]]:
    """Yield the grid points that XMALab used: observed u, v and reference u, v."""
    for camera, name in project.named():
        grid = camera.find('UndistortionGrid')
        if grid is None or not _is_set(grid, 'isComputed'):
            continue
        observed, reference, inlier = (
            project.numbers(project.file_of(grid, f'GridPoints{part}'))
            for part in ('Distorted', 'References', 'Inlier')
        )
        if not observed.shape == reference.shape == (len(inlier), 2):
            raise DataError(
                f'{project.path}: the undistortion grid of {project.text(camera, "Name")} has '
                f'{len(observed)}, {len(reference)} and {len(inlier)} points'
            )
        yield name, np.hstack([observed, reference])[inlier[:, 0] == 1]


FORMAT = Format(
    'xma',
    'XMALab project',
    parts=('observations', 'survey', 'cameras', 'stations', 'grids'),
    recognise=lambda sample: sample.suffix == '.xma' and sample.head.startswith(b'PK'),
    read=read,
    write=None,
    says_units=False,
)
