# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""XMALab project (.xma), read only: a ZIP file of project.xml and the files it names.

The layout is that of `ProjectFileIO` of XMALab 2.2.7, project version 0.3. Read are the detected
points of the calibration object (those that XMALab calls inliers), the markers of a trial, the
frame specification, the cameras with their calibrated poses, and the points of the undistortion
grids. Points are those of the observed, distorted image, pixel centres at integers from (0, 0), v
downwards. A calibration image is the exposure of its number, counted from 1; a frame of a trial,
too. The unit is that of the frame specification, which XMALab does not say: cm, as there.
"""

from __future__ import annotations

import posixpath
import zipfile
from collections.abc import Iterator
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from ..errors import DataError
from ..exposures.frame import Frame, points_on_image
from ..exposures.names import Names, number_names, safe_names, without_trivial
from ..files.access import os_error_reason
from ..images.declared_size import check_size, declared_size
from ..limits import read_limits
from . import xmalab_frame
from .base import Format, Sample
from .camera_files import check_matrix, check_rotation
from .content import Camera, Content, FileSettings, Station
from .labels import default_name, named_targets
from .text import Row, table_of

DOCUMENT = 'project.xml'
_SEEN = 0  # a marker is seen where its status is above
_INLIER = 1
NO_POINT = -1.0


def recognise(sample: Sample) -> bool:
    """Return whether the file is a ZIP file with the suffix of a project."""
    return sample.suffix == '.xma' and sample.head.startswith(b'PK')


def read(path: Path, settings: FileSettings) -> Content:
    """Read the wanted parts of a project. Raises DataError."""
    with _Project(path, settings) as project:
        return project.content()


class _Project:
    """An open project; a context manager."""

    def __init__(self, path: Path, settings: FileSettings) -> None:
        self._path = path
        self._settings = settings
        try:
            self._archive = zipfile.ZipFile(path)
        except OSError as error:
            raise DataError(f'{path}: cannot be read ({os_error_reason(error)})') from None
        except zipfile.BadZipFile:
            raise DataError(
                f'{path}: this is not an XMALab project, which is a ZIP file'
            ) from None
        self._members = {
            posixpath.normpath(info.filename.replace('\\', '/')): info
            for info in self._archive.infolist()
        }
        self._root = self._document()
        self._cameras = self._root.findall('Camera')
        if not self._cameras:
            raise DataError(f'{path}, {DOCUMENT}: the project has no cameras')
        self._names = [self._text(camera, 'Name') for camera in self._cameras]
        known = settings.names.fluoroscopes
        if len(settings.fluoroscopes) == len(self._cameras) and not set(
            settings.fluoroscopes
        ) & set(self._names):
            known = dict(zip(self._names, settings.fluoroscopes))
        self._ids = safe_names(self._names, known)

    def __enter__(self) -> _Project:
        return self

    def __exit__(self, *_: object) -> None:
        self._archive.close()

    # ---- files of the archive

    def _document(self) -> ElementTree.Element:
        text = self._member(DOCUMENT).decode('utf-8', 'replace')
        if '<!' in text.replace('<!--', ''):  # entities can make a small file huge
            raise DataError(f'{self._path}, {DOCUMENT}: a project has no document type')
        try:
            root = ElementTree.fromstring(text)
        except ElementTree.ParseError as error:
            raise DataError(
                f'{self._path}, {DOCUMENT}, row {error.position[0]}: this is not XML'
            ) from None
        if root.tag != 'Project':
            raise DataError(f'{self._path}, {DOCUMENT}: this is not a project of XMALab')
        return root

    def _member(self, name: str) -> bytes:
        """Return a file of the archive. Raises DataError."""
        info = self._members.get(posixpath.normpath(name.replace('\\', '/')))
        if info is None:
            raise DataError(f'{self._path}: the project does not contain {name}')
        if info.file_size > read_limits().max_file_bytes:
            raise DataError(f'{self._path}: {name} is too large, {info.file_size} bytes')
        try:
            return self._archive.read(info)
        except Exception as error:  # whatever zipfile and its decompressors make of the damage
            raise DataError(f'{self._path}: {name} is damaged ({error})') from None

    def _member_text(self, name: str) -> str:
        return self._member(name).decode('utf-8', 'replace')

    def _rows(self, name: str) -> list[Row]:
        return table_of(f'{self._path}, {name}', self._member_text(name))

    def _numbers(self, name: str) -> np.ndarray:
        """Return a table of numbers. Raises DataError, also for rows of different lengths."""
        rows = self._rows(name)
        values = [row.numbers_or_nan() for row in rows]
        for row, of_row in zip(rows, values):
            if len(of_row) != len(values[0]):
                row.fail(f'{len(of_row)} columns, but the first row has {len(values[0])}')
        return np.array(values)

    def _text(self, element: ElementTree.Element, name: str) -> str:
        value = element.get(name)
        if value is None:
            raise DataError(f'{self._path}, {DOCUMENT}: a {element.tag} has no attribute {name}')
        return value

    def _whole(self, element: ElementTree.Element, name: str) -> int:
        text = self._text(element, name)
        if not text.isascii() or not text.isdigit():
            raise DataError(
                f'{self._path}, {DOCUMENT}: {name} of a {element.tag} is {text!r}, not a whole '
                'number'
            )
        return int(text)

    def _file_of(self, element: ElementTree.Element, tag: str) -> str:
        """Return the name of the file of a child."""
        child = element.find(tag)
        if child is None:
            raise DataError(f'{self._path}, {DOCUMENT}: a {element.tag} has no {tag}')
        return self._text(child, 'Filename')

    # ---- content

    def content(self) -> Content:
        """Return the wanted parts."""
        wanted = self._settings.wanted
        survey = self._survey()
        names = Names(
            survey.names.targets,
            {},
            {name: i for name, i in self._ids.items() if name != i},
        )
        found: dict = {'notes': survey.notes if 'survey' in wanted else ()}
        if 'survey' in wanted:
            found['survey'] = survey.survey
        if 'observations' in wanted:
            if self._settings.trial is None:
                observations, exposures = self._calibration_points(survey)
                names = Names(names.targets, exposures, names.fluoroscopes)
            else:
                observations, targets = self._markers(survey)
                names = Names(targets, {}, names.fluoroscopes)
            found['observations'] = observations
        if 'stations' in wanted or 'cameras' in wanted:
            mm, notes = self._settings.unit_or('cm', str(self._path))
            stations = tuple(self._stations(mm))
            found['stations'] = stations
            found['cameras'] = tuple(self._calibrated_cameras(stations))
            found['notes'] += notes
        if 'grids' in wanted:
            found['grids'] = dict(self._grids())
        return Content(names=names, **found)

    def _survey(self) -> Content:
        """Return the frame specification, an empty Content for a checkerboard or without one."""
        element = self._root.find('CalibrationObject')
        name = '' if element is None else element.get('FrameSpecifications', '')
        if not name:
            return Content()
        return xmalab_frame.content_of(
            Path(f'{self._path}, {name}'), self._member_text(name), self._settings
        )

    def _images(self, camera: ElementTree.Element) -> Iterator[tuple[int, ElementTree.Element]]:
        """Yield the calibration images of a camera with their exposures."""
        for number, image in enumerate(camera.findall('CalibrationImage'), 1):
            yield (self._whole(image, 'Frame') + 1 if image.get('Frame') else number), image

    @staticmethod
    def _is_calibrated(element: ElementTree.Element, name: str = 'isCalibrated') -> bool:
        value = element.get(name, '0')
        return value.isdigit() and int(value) > 0

    def _image_size(self, camera: ElementTree.Element) -> tuple[int, int]:
        """Return the image size of a camera, of its sequence or its first image."""
        sequence = camera.find('CalibrationSequence')
        if sequence is not None:
            return self._whole(sequence, 'Width'), self._whole(sequence, 'Height')
        for image in camera.findall('CalibrationImage'):
            if image.get('Width'):
                return self._whole(image, 'Width'), self._whole(image, 'Height')
            name = self._text(image, 'Filename')
            size = declared_size(memoryview(self._member(name)))
            try:
                check_size(*size)
            except DataError as error:
                raise DataError(f'{self._path}: {name}: {error}') from None
            if min(size) > 0:
                return size
        if self._settings.image_size is None:
            raise DataError(
                f'{self._path}: the project does not contain the image size of '
                f'{self._text(camera, "Name")}, --image-size WxH is needed'
            )
        return self._settings.image_size

    def _calibration_points(
        self, survey: Content
    ) -> tuple[dict[str, list[Frame]], dict[str, int]]:
        """Return the frames of the calibration object, and the names of its exposures."""
        frames: dict[str, list[Frame]] = {}
        exposures: dict[str, int] = {}
        for camera, label in zip(self._cameras, self._names):
            size = self._image_size(camera)
            for number, image in self._images(camera):
                name = posixpath.basename(image.get('Filename', '').replace('\\', '/'))
                if name not in ('', 'external') and number not in exposures.values():
                    exposures[name] = number
                if self._is_calibrated(image):
                    frame = self._calibration_frame(image, survey, self._ids[label], number, size)
                    if len(frame.target_id):
                        frames.setdefault(self._ids[label], []).append(frame)
        if not frames:
            raise DataError(f'{self._path}: the project has no calibrated images with points')
        return frames, without_trivial(exposures)

    def _calibration_frame(
        self,
        image: ElementTree.Element,
        survey: Content,
        name: str,
        number: int,
        size: tuple[int, int],
    ) -> Frame:
        """Return the points of a calibration image that XMALab used."""
        file = self._file_of(image, 'PointsDetected')
        uv = self._numbers(file)
        inlier = self._numbers(self._file_of(image, 'Inlier'))
        count = len(uv) if survey.survey is None else len(survey.survey.target_id)
        if uv.shape[1:] != (2,) or len(uv) != count or inlier.shape != (count, 1):
            raise DataError(
                f'{self._path}, {file}: {len(uv)} points and {len(inlier)} inliers, but the '
                f'calibration object has {count} beads'
            )
        used = (inlier[:, 0] == _INLIER) & ~(uv == NO_POINT).all(axis=1)
        return self._frame(
            file, name, number, (self._bead_ids(survey, count)[used], uv[used]), size
        )

    @staticmethod
    def _bead_ids(survey: Content, count: int) -> np.ndarray:
        """Return the ids of the beads in the order of the frame specification."""
        if survey.names.targets:
            return np.array(list(survey.names.targets.values()), dtype=np.int64)
        return np.arange(1, count + 1)

    def _frame(
        self,
        file: str,
        name: str,
        number: int,
        points: tuple[np.ndarray, np.ndarray],
        size: tuple[int, int],
    ) -> Frame:
        ids, uv = points
        on_image = points_on_image(uv, size)
        if not on_image.all():
            index = int(np.argmin(on_image))
            raise DataError(
                f'{self._path}, {file}: the point ({uv[index, 0]:g}, {uv[index, 1]:g}) is off the '
                f'image of {size[0]} x {size[1]} px'
            )
        return Frame(name, number, ids, uv, size, frame_id=f'{name}_optical')

    def _trial(self) -> ElementTree.Element:
        trials = {trial.get('Name', ''): trial for trial in self._root.findall('Trial')}
        try:
            return trials[self._settings.trial or '']
        except KeyError:
            raise DataError(
                f'{self._path}: there is no trial {self._settings.trial!r}, only '
                f'{", ".join(trials) or "none"}'
            ) from None

    def _markers(self, survey: Content) -> tuple[dict[str, list[Frame]], dict[str, int]]:
        """Return the frames of the markers of a trial, and the names of the markers."""
        trial = self._trial()
        markers = trial.findall('Marker')
        if not markers:
            raise DataError(f'{self._path}: the trial {self._settings.trial!r} has no markers')
        labels = [
            marker.get('Description') or default_name(self._whole(marker, 'ID') + 1)
            for marker in markers
        ]
        known = self._settings.names.targets or survey.names.targets
        ids = number_names(labels, known)
        if len(set(labels)) < len(labels):
            double = next(name for name in labels if labels.count(name) > 1)
            raise DataError(f'{self._path}: two markers of the trial are called {double!r}')
        count = len(self._cameras)
        tables = []
        for marker in markers:
            uv = self._numbers(self._text(marker, 'FilenamePoints2D'))
            status = self._numbers(self._text(marker, 'FilenameStatus2D'))
            if uv.shape != (len(status), 2 * count) or status.shape[1] != count:
                raise DataError(
                    f'{self._path}, {self._text(marker, "FilenamePoints2D")}: {uv.shape[1]} '
                    f'columns, but there are {count} cameras'
                )
            uv = uv.reshape(len(uv), count, 2)
            tables.append(np.where((status > _SEEN)[..., None], uv, np.nan))
        if len({len(table) for table in tables}) > 1:
            raise DataError(f'{self._path}: the markers of the trial have different frames')
        target_id = np.array([ids[name] for name in labels], dtype=np.int64)
        points = np.stack(tables, axis=2)  # frame, camera, marker
        frames: dict[str, list[Frame]] = {}
        for column, (camera, label) in enumerate(zip(self._cameras, self._names)):
            size = self._image_size(camera)
            name = self._ids[label]
            for number, uv in enumerate(points[:, column], 1):
                seen = ~np.isnan(uv).any(axis=1)
                if seen.any():
                    frame = self._frame(
                        f'trial {self._settings.trial}, frame {number}',
                        name,
                        number,
                        (target_id[seen], uv[seen]),
                        size,
                    )
                    frames.setdefault(name, []).append(frame)
        return frames, named_targets(ids)

    def _stations(self, mm: float) -> Iterator[Station]:
        """Yield the pose of every calibrated image."""
        for camera, label in zip(self._cameras, self._names):
            for number, image in self._images(camera):
                if not self._is_calibrated(image):
                    continue
                file = self._file_of(image, 'RotationMatrix')
                rotation = self._numbers(file)
                translation = self._numbers(self._file_of(image, 'TranslationVector')).ravel()
                if rotation.shape != (3, 3) or translation.shape != (3,):
                    raise DataError(f'{self._path}, {file}: this is not a pose')
                check_rotation(f'{self._path}, {file}', rotation)
                yield Station(self._ids[label], number, rotation, -rotation.T @ translation * mm)

    def _calibrated_cameras(self, stations: tuple[Station, ...]) -> Iterator[Camera]:
        """Yield the calibrated cameras in the frame of the calibration object.

        The pose is that of the reference image of the chosen trial, else of the first one that all
        cameras are calibrated in.
        """
        calibrated = [
            (camera, label)
            for camera, label in zip(self._cameras, self._names)
            if self._is_calibrated(camera)
        ]
        reference = self._reference(stations, [self._ids[label] for _, label in calibrated])
        for camera, label in calibrated:
            file = self._text(camera, 'CameraMatrix')
            matrix = self._numbers(file)
            if matrix.shape != (3, 3):
                raise DataError(f'{self._path}, {file}: this is not a camera matrix')
            check_matrix(f'{self._path}, {file}', matrix)
            distortion: tuple[float, ...] = ()
            if camera.get('UndistortionParameter'):
                distortion = tuple(
                    self._numbers(self._text(camera, 'UndistortionParameter')).ravel().tolist()
                )
            size = self._image_size(camera)
            name = self._ids[label]
            for station in stations:
                if (station.fluoroscope, station.exposure) == (name, reference):
                    translation = -station.rotation @ station.position_mm
                    yield Camera(name, matrix, size, station.rotation, translation, distortion)
                    break
            else:
                yield Camera(name, matrix, size, distortion=distortion)

    def _reference(self, stations: tuple[Station, ...], names: list[str]) -> int | None:
        """Return the exposure whose poses the cameras have."""
        if self._settings.trial is not None:
            return self._whole(self._trial(), 'referenceCalibration') + 1
        by_exposure: dict[int, set[str]] = {}
        for station in stations:
            by_exposure.setdefault(station.exposure, set()).add(station.fluoroscope)
        return min((e for e, of in by_exposure.items() if of >= set(names)), default=None)

    def _grids(self) -> Iterator[tuple[str, np.ndarray]]:
        """Yield the points of the undistortion grids that XMALab used, observed and reference."""
        for camera, label in zip(self._cameras, self._names):
            grid = camera.find('UndistortionGrid')
            if grid is None or not self._is_calibrated(grid, 'isComputed'):
                continue
            observed = self._numbers(self._file_of(grid, 'GridPointsDistorted'))
            reference = self._numbers(self._file_of(grid, 'GridPointsReferences'))
            inlier = self._numbers(self._file_of(grid, 'GridPointsInlier'))
            if not observed.shape == reference.shape == (len(inlier), 2):
                raise DataError(
                    f'{self._path}: the undistortion grid of {label} has {len(observed)}, '
                    f'{len(reference)} and {len(inlier)} points'
                )
            used = inlier[:, 0] == _INLIER
            yield self._ids[label], np.hstack([observed, reference])[used]


FORMAT = Format(
    'xma',
    'XMALab project',
    ('observations', 'survey', 'cameras', 'stations', 'grids'),
    recognise,
    read,
    None,
    'a ZIP file with project.xml',
    says_units=False,
)
