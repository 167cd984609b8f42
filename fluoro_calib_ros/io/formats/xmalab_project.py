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
from .tables import Row, default_name, frame_of, named_targets, table_of


def read(path: Path, settings: FileSettings) -> Content:
    """Read the wanted parts of a project. Raises DataError."""
    with ProjectArchive(path) as archive:
        return _content(_Project(archive, settings))


def _content(project: _Project) -> Content:
    """Return the wanted parts of an open project."""
    settings = project.settings
    wanted = settings.wanted
    survey = project.survey()
    names = Names(
        survey.names.targets,
        {},
        {name: i for name, i in project.ids.items() if name != i},
    )
    parts: dict[str, Any] = {'notes': survey.notes if 'survey' in wanted else ()}
    if 'survey' in wanted:
        parts['survey'] = survey.survey
    if 'observations' in wanted:
        if settings.trial is None:
            observations, exposures = _Observations(project, survey).of_phantom()
            names = Names(names.targets, exposures, names.fluoroscopes)
        else:
            observations, targets = _Observations(project, survey).of_trial()
            names = Names(targets, {}, names.fluoroscopes)
        parts['observations'] = observations
    calibration = _Calibration(project)
    if 'stations' in wanted or 'cameras' in wanted:
        mm, notes = settings.unit_or('cm', str(project.archive.path))
        stations = tuple(calibration.stations(mm))
        parts['stations'] = stations
        parts['cameras'] = tuple(calibration.cameras(stations))
        parts['notes'] += notes
    if 'grids' in wanted:
        parts['grids'] = dict(calibration.grids())
    return Content(names=names, **parts)


def _is_set(element: ElementTree.Element, name: str = 'isCalibrated') -> bool:
    """Return whether a flag of an element is set."""
    value = element.get(name, '0')
    return value.isdigit() and int(value) > 0


class _Project:
    """Cameras, images and trials of an open project, with fluoroscope ids for the camera names."""

    def __init__(self, archive: ProjectArchive, settings: FileSettings) -> None:
        self.archive = archive
        self.settings = settings
        self.cameras = archive.root.findall('Camera')
        if not self.cameras:
            raise DataError(f'{archive.path}, {DOCUMENT}: the project has no cameras')
        self._names = [archive.text(camera, 'Name') for camera in self.cameras]
        known_names = settings.names.fluoroscopes
        if len(settings.fluoroscopes) == len(self.cameras) and not set(
            settings.fluoroscopes
        ) & set(self._names):
            known_names = dict(zip(self._names, settings.fluoroscopes))
        self.ids = safe_names(self._names, known_names)

    def named(self) -> Iterator[tuple[ElementTree.Element, str]]:
        """Yield the cameras with their fluoroscope ids."""
        for camera, name in zip(self.cameras, self._names):
            yield camera, self.ids[name]

    def survey(self) -> Content:
        """Return the frame specification; an empty Content without one, as for a checkerboard."""
        element = self.archive.root.find('CalibrationObject')
        name = '' if element is None else element.get('FrameSpecifications', '')
        if not name:
            return Content()
        return content_of(
            Path(f'{self.archive.path}, {name}'), self.archive.member_text(name), self.settings
        )

    def images(self, camera: ElementTree.Element) -> Iterator[tuple[int, ElementTree.Element]]:
        """Yield the calibration images of a camera with their exposure numbers."""
        for number, image in enumerate(camera.findall('CalibrationImage'), 1):
            yield (self.archive.whole(image, 'Frame') + 1 if image.get('Frame') else number), image

    def image_size(self, camera: ElementTree.Element) -> tuple[int, int]:
        """Return the image size of a camera from its sequence, images or the settings."""
        sequence = camera.find('CalibrationSequence')
        if sequence is not None:
            return self.archive.whole(sequence, 'Width'), self.archive.whole(sequence, 'Height')
        for image in camera.findall('CalibrationImage'):
            if image.get('Width'):
                return self.archive.whole(image, 'Width'), self.archive.whole(image, 'Height')
            name = self.archive.text(image, 'Filename')
            size = declared_size(memoryview(self.archive.member(name)))
            with ErrorsAt(f'{self.archive.path}: {name}'):
                check_size(*size)
            if min(size) > 0:
                return size
        name = self.archive.text(camera, 'Name')
        given = self.settings.size_of(self.ids[name])
        if given is None:
            raise DataError(
                f'{self.archive.path}: the project does not contain the image size of '
                f'{name}, --image-size WxH is needed'
            )
        return given

    def trial(self) -> ElementTree.Element:
        """Return the chosen trial. Raises DataError."""
        trials = {trial.get('Name', ''): trial for trial in self.archive.root.findall('Trial')}
        try:
            return trials[self.settings.trial or '']
        except KeyError:
            raise DataError(
                f'{self.archive.path}: there is no trial {self.settings.trial!r}, only '
                f'{", ".join(trials) or "none"}'
            ) from None


class _Part:
    """Base class of the readers of parts of a project."""

    def __init__(self, project: _Project) -> None:
        self._project = project
        self._settings = project.settings
        self._files = project.archive
        self._path = project.archive.path


class _Observations(_Part):
    """Image points of a project, of the calibration object or the markers of a trial."""

    def __init__(self, project: _Project, survey: Content) -> None:
        super().__init__(project)
        self._survey = survey

    def of_phantom(self) -> tuple[dict[str, list[Frame]], dict[str, int]]:
        """Return the frames of the calibration object, and the numbers of its named exposures."""
        frames: dict[str, list[Frame]] = {}
        exposures: dict[str, int] = {}
        for camera, name in self._project.named():
            size = self._project.image_size(camera)
            for number, image in self._project.images(camera):
                file = posixpath.basename(image.get('Filename', '').replace('\\', '/'))
                if file not in ('', 'external') and number not in exposures.values():
                    exposures[file] = number
                if _is_set(image):
                    frame = self._calibration_frame(image, name, number, size)
                    if len(frame.target_id):
                        frames.setdefault(name, []).append(frame)
        if not frames:
            raise DataError(f'{self._path}: the project has no calibrated images with points')
        return frames, without_trivial(exposures)

    def _calibration_frame(
        self,
        image: ElementTree.Element,
        name: str,
        number: int,
        size: tuple[int, int],
    ) -> Frame:
        """Return the points of a calibration image that XMALab used."""
        file = self._files.file_of(image, 'PointsDetected')
        uv = self._files.numbers(file)
        inlier = self._files.numbers(self._files.file_of(image, 'Inlier'))
        survey = self._survey.survey
        count = len(uv) if survey is None else len(survey.target_id)
        if uv.shape[1:] != (2,) or len(uv) != count or inlier.shape != (count, 1):
            raise DataError(
                f'{self._path}, {file}: {len(uv)} points and {len(inlier)} inliers, but the '
                f'calibration object has {count} beads'
            )
        used = (inlier[:, 0] == 1) & ~(uv == -1).all(axis=1)  # -1, -1: not found
        points = (self._bead_ids(count)[used], uv[used])
        return frame_of(f'{self._path}, {file}', name, number, *points, size)

    def _bead_ids(self, count: int) -> NDArray[np.int64]:
        """Return the ids of the beads in the order of the frame specification."""
        if self._survey.names.targets:
            return np.array(list(self._survey.names.targets.values()), dtype=np.int64)
        return np.arange(1, count + 1)

    def of_trial(self) -> tuple[dict[str, list[Frame]], dict[str, int]]:
        """Return the frames of the markers of a trial, and the ids of the markers by name."""
        trial = self._project.trial()
        markers = trial.findall('Marker')
        if not markers:
            raise DataError(f'{self._path}: the trial {self._settings.trial!r} has no markers')
        labels = [
            marker.get('Description') or default_name(self._files.whole(marker, 'ID') + 1)
            for marker in markers
        ]
        known_targets = self._settings.names.targets or self._survey.names.targets
        ids = number_names(labels, known_targets)
        if len(set(labels)) < len(labels):
            repeated = next(name for name in labels if labels.count(name) > 1)
            raise DataError(f'{self._path}: two markers of the trial are called {repeated!r}')
        count = len(self._project.cameras)
        tables = []
        for marker in markers:
            uv = self._files.numbers(self._files.text(marker, 'FilenamePoints2D'))
            status = self._files.numbers(self._files.text(marker, 'FilenameStatus2D'))
            if uv.shape != (len(status), 2 * count) or status.shape[1] != count:
                raise DataError(
                    f'{self._path}, {self._files.text(marker, "FilenamePoints2D")}: {uv.shape[1]} '
                    f'columns, but there are {count} cameras'
                )
            uv = uv.reshape(len(uv), count, 2)
            tables.append(np.where((status > 0)[..., None], uv, np.nan))  # 0: not seen
        if len({len(table) for table in tables}) > 1:
            raise DataError(f'{self._path}: the markers of the trial have different frames')
        target_id = np.array([ids[name] for name in labels], dtype=np.int64)
        points = np.stack(tables, axis=2)  # frame, camera, marker
        frames: dict[str, list[Frame]] = {}
        for column, (camera, name) in enumerate(self._project.named()):
            size = self._project.image_size(camera)
            for number, uv in enumerate(points[:, column], 1):
                is_seen = ~np.isnan(uv).any(axis=1)
                if is_seen.any():
                    where = f'{self._path}, trial {self._settings.trial}, frame {number}'
                    seen_id, seen_uv = target_id[is_seen], uv[is_seen]
                    frame = frame_of(where, name, number, seen_id, seen_uv, image_size=size)
                    frames.setdefault(name, []).append(frame)
        return frames, named_targets(ids)


class _Calibration(_Part):
    """Calibrated cameras of a project, their poses and undistortion grids."""

    def stations(self, mm: float) -> Iterator[Station]:
        """Yield the pose of every calibrated image."""
        for camera, name in self._project.named():
            for number, image in self._project.images(camera):
                if not _is_set(image):
                    continue
                file = self._files.file_of(image, 'RotationMatrix')
                rotation = self._files.numbers(file)
                translation = self._files.numbers(
                    self._files.file_of(image, 'TranslationVector')
                ).ravel()
                if rotation.shape != (3, 3) or translation.shape != (3,):
                    raise DataError(f'{self._path}, {file}: this is not a pose')
                check_rotation(f'{self._path}, {file}', rotation)
                yield Station(name, number, rotation, -rotation.T @ translation * mm)

    def cameras(self, stations: tuple[Station, ...]) -> Iterator[Camera]:
        """Yield the calibrated cameras in the frame of the calibration object.

        The poses are those of the reference image of the chosen trial, otherwise of the first
        image in which all cameras are calibrated.
        """
        calibrated = [(camera, name) for camera, name in self._project.named() if _is_set(camera)]
        reference = self._reference(stations, [name for _, name in calibrated])
        for camera, name in calibrated:
            file = self._files.text(camera, 'CameraMatrix')
            matrix = self._files.numbers(file)
            if matrix.shape != (3, 3):
                raise DataError(f'{self._path}, {file}: this is not a camera matrix')
            check_matrix(f'{self._path}, {file}', matrix)
            distortion: tuple[float, ...] = ()
            if camera.get('UndistortionParameter'):
                distortion = tuple(
                    self._files.numbers(self._files.text(camera, 'UndistortionParameter'))
                    .ravel()
                    .tolist()
                )
            size = self._project.image_size(camera)
            for station in stations:
                if (station.fluoroscope, station.exposure) == (name, reference):
                    translation = -station.rotation @ station.position_mm
                    yield Camera(
                        name,
                        matrix,
                        image_size=size,
                        rotation=station.rotation,
                        translation_mm=translation,
                        distortion=distortion,
                    )
                    break
            else:
                yield Camera(name, matrix, size, distortion=distortion)

    def _reference(self, stations: tuple[Station, ...], names: list[str]) -> int | None:
        """Return the exposure from which the poses of the cameras are taken."""
        if self._settings.trial is not None:
            return self._files.whole(self._project.trial(), 'referenceCalibration') + 1
        by_exposure: dict[int, set[str]] = {}
        for station in stations:
            by_exposure.setdefault(station.exposure, set()).add(station.fluoroscope)
        return min(
            (e for e, fluoroscopes in by_exposure.items() if fluoroscopes >= set(names)),
            default=None,
        )

    def grids(self) -> Iterator[tuple[str, NDArray[np.float64]]]:
        """Yield the grid points that XMALab used: observed u, v and reference u, v."""
        for camera, name in self._project.named():
            grid = camera.find('UndistortionGrid')
            if grid is None or not _is_set(grid, 'isComputed'):
                continue
            observed = self._files.numbers(self._files.file_of(grid, 'GridPointsDistorted'))
            reference = self._files.numbers(self._files.file_of(grid, 'GridPointsReferences'))
            inlier = self._files.numbers(self._files.file_of(grid, 'GridPointsInlier'))
            if not observed.shape == reference.shape == (len(inlier), 2):
                label = self._files.text(camera, 'Name')
                raise DataError(
                    f'{self._path}: the undistortion grid of {label} has {len(observed)}, '
                    f'{len(reference)} and {len(inlier)} points'
                )
            used = inlier[:, 0] == 1
            yield name, np.hstack([observed, reference])[used]


FORMAT = Format(
    'xma',
    'XMALab project',
    parts=('observations', 'survey', 'cameras', 'stations', 'grids'),
    recognise=lambda sample: sample.suffix == '.xma' and sample.head.startswith(b'PK'),
    read=read,
    write=None,
    says_units=False,
)


# Access to the ZIP file of an XMALab project.

DOCUMENT = 'project.xml'


class ProjectArchive:
    """An open project, as a context manager. root is the root element of project.xml.

    The constructor raises DataError if the file is not a project; the methods raise it for
    anything missing or damaged.
    """

    def __init__(self, path: Path) -> None:
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

    def __enter__(self) -> ProjectArchive:
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
        rows: list[Row] = table_of(f'{self.path}, {name}', self.member_text(name))
        values = [row.numbers_or_nan() for row in rows]
        for row, row_values in zip(rows, values):
            if len(row_values) != len(values[0]):
                row.fail(f'{len(row_values)} columns, but the first row has {len(values[0])}')
        return np.array(values)

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
