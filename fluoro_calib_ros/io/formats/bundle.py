# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Files of the program of Chow et al.: NAME.pho, NAME.iop, NAME.eop and NAME.xyz.

The layout is that of the program's README (github.com/jckchow/BundleAdjustment), numbers separated
by blanks. .pho: target, station, x, y, their noise, corrections to be added. .iop: camera,
direction of the y axis, x min, y min, x max, y max, xp, yp, c, seven coefficients of Brown's model
and nine empirical ones. .eop: station, camera, X, Y, Z, omega, phi, kappa [degrees]. .xyz: target,
X, Y, Z and their standard deviations. Its camera looks along -z with y upwards: x = u, y = -v. If
there are several cameras, the stations of camera 2 are numbered 2000 + exposure (20 + exposure for
fewer than ten exposures, and so on). The files do not state the unit of lengths.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from ...errors import DataError, ErrorsAt
from ...exposures.frame import Frame, Frames, points_on_image
from ...exposures.phantom import Phantom, first_repeated
from ..access import make_folder, write_text
from .content import (
    Y_UP_TO_DOWN,
    Camera,
    Content,
    FileSettings,
    Format,
    Station,
    Written,
    common_focal_length,
    from_units,
    in_units,
    refuse_distortion,
)
from .image_points import camera_order
from .tables import Row, joined, read_table, require_width

NAME = 'bundle'  # name of the files written
WIDTHS = {'.pho': 8, '.iop': 25, '.eop': 8, '.xyz': 7}


@dataclass(frozen=True)
class _Cameras:
    """Names of the cameras by id; camera and exposure of every station."""

    names: Mapping[int, str]
    of_station: Mapping[int, int]
    exposures: Mapping[int, int]

    def fluoroscope(self, station: int) -> str:
        """Return the name of the camera of a station."""
        return self.names[self.of_station[station]]


def read(path: Path, settings: FileSettings) -> Content:
    """Read the wanted parts from the file and those next to it. Raises DataError."""
    files = {ending: path.with_suffix(ending) for ending in WIDTHS}
    rows = {
        ending: read_table(file, ' ')
        for ending, file in files.items()
        if file.exists() or file == path
    }
    for ending, file_rows in rows.items():
        require_width(file_rows, WIDTHS[ending], f'a {ending} file')
    stations = rows.get('.eop', [])
    cameras = _cameras(rows, settings)
    parts: dict[str, Any] = {}
    wanted = settings.wanted
    if 'observations' in wanted and '.pho' in rows:
        parts['observations'] = _observations(rows, cameras, settings)
    if 'cameras' in wanted and '.iop' in rows:
        parts['cameras'] = tuple(_camera(row, cameras) for row in rows['.iop'])
    if 'stations' in wanted and stations:
        mm = settings.unit_read(files['.eop'])
        parts['stations'] = tuple(_station(row, cameras, mm) for row in stations)
    if 'survey' in wanted and '.xyz' in rows:
        parts['survey'] = _survey(files['.xyz'], rows['.xyz'], settings.unit_read(files['.xyz']))
    return Content(**parts)


def _cameras(rows: Mapping[str, Sequence[Row]], settings: FileSettings) -> _Cameras:
    """Return the cameras listed in .eop and .iop, or a single one if neither exists."""
    camera_of_station = {
        row.whole(0, 'the station'): row.whole(1, 'the camera') for row in rows.get('.eop', ())
    }
    numbers = sorted({row.whole(0, 'the camera') for row in rows.get('.iop', ())})
    numbers = sorted(set(numbers) | set(camera_of_station.values())) or [1]
    if not camera_of_station and '.pho' in rows:
        if len(numbers) > 1:
            raise DataError(
                f'{rows[".pho"][0].path}: there are {len(numbers)} cameras, and without the .eop '
                'file their stations are unknown'
            )
        camera_of_station = {row.whole(1, 'the station'): numbers[0] for row in rows['.pho']}
    names = {number: f'cam{number}' for number in numbers}
    if len(settings.fluoroscopes) == len(numbers):
        names = dict(zip(numbers, settings.fluoroscopes))
    return _Cameras(names, camera_of_station, _exposures(camera_of_station))


def _exposures(of_station: Mapping[int, int]) -> dict[int, int]:
    """Return the exposure of every station; for the numbering see the module docstring."""
    cameras = set(of_station.values())
    base = 10
    while len(cameras) > 1 and base <= max(of_station, default=0):
        if all(station // base == camera for station, camera in of_station.items()):
            return {station: station % base for station in of_station}
        base *= 10
    return {station: station for station in of_station}


def _observations(
    rows: Mapping[str, Sequence[Row]], cameras: _Cameras, settings: FileSettings
) -> dict[str, list[Frame]]:
    """Return the frames by fluoroscope. Raises DataError."""
    sizes = {cameras.names[row.whole(0, 'the camera')]: _size(row) for row in rows.get('.iop', ())}
    path = rows['.pho'][0].path
    by_station: dict[int, list[Row]] = {}
    for row in rows['.pho']:
        station = row.whole(1, 'the station')
        if station not in cameras.of_station:
            row.fail(f'the .eop file has no station {station}')
        by_station.setdefault(station, []).append(row)
    frames: dict[str, list[Frame]] = {}
    for station in sorted(by_station):
        name = cameras.fluoroscope(station)
        size = settings.image_size or sizes.get(name) or settings.size_of(name)
        if size is None:
            raise DataError(
                f'{path}: without the .iop file the image size is unknown, --image-size WxH is '
                'needed'
            )
        frames.setdefault(name, []).append(
            _frame(by_station[station], name, cameras.exposures[station], size)
        )
    return dict(sorted(frames.items()))


def _frame(rows: Sequence[Row], name: str, exposure: int, size: tuple[int, int]) -> Frame:
    ids = np.array([row.whole(0, 'the target') for row in rows], dtype=np.int64)
    values = np.array([row.numbers(2) for row in rows])
    uv = values[:, :2] * [1.0, -1.0]
    sigma = np.sqrt(np.mean(values[:, 2:4] ** 2, axis=1))
    on_image = points_on_image(uv, size)
    if not on_image.all():
        rows[int(np.argmin(on_image))].fail(
            f'the point is outside the image of {size[0]} x {size[1]} px; y is negative downwards'
        )
    is_positive = (values[:, 2:4] > 0).all(axis=1)
    if not is_positive.all():
        rows[int(np.argmin(is_positive))].fail('the noise is not above 0')
    repeated = first_repeated(ids)
    if repeated is not None:
        rows[repeated[1]].fail(
            f'target {ids[repeated[1]]} of this station is already given in row '
            f'{rows[repeated[0]].line}'
        )
    return Frame(
        name,
        exposure,
        target_id=ids,
        uv=uv,
        image_size=size,
        sigma=sigma,
        frame_id=f'{name}_optical',
    )


def _size(row: Row) -> tuple[int, int]:
    """Return the image size: the pixels from the smallest to the largest, both included."""
    left, bottom, right, top = row.numbers()[2:6]
    return round(right - left) + 1, round(top - bottom) + 1


def _camera(row: Row, cameras: _Cameras) -> Camera:
    values = row.numbers()
    xp, yp, c = values[6:9]
    if any(values[9:]):
        row.fail('the additional parameters are not 0, cameras with them cannot be read')
    if not c > 0:
        row.fail(f'the principal distance is {c:g}, not above 0')
    matrix = np.array([[c, 0, xp], [0, c, -yp], [0, 0, 1]])
    return Camera(cameras.names[int(values[0])], matrix, _size(row))


def _station(row: Row, cameras: _Cameras, mm: float) -> Station:
    number = row.whole(0, 'the station')
    values = row.numbers(2)
    rotation = Rotation.from_euler('XYZ', values[3:], degrees=True).as_matrix().T
    return Station(
        cameras.fluoroscope(number),
        cameras.exposures[number],
        Y_UP_TO_DOWN @ rotation,
        from_units(np.array(values[:3]), mm),
    )


def _survey(path: Path, rows: Sequence[Row], mm: float) -> Phantom:
    values = np.array([row.numbers() for row in rows])
    sd = np.sqrt(np.mean(values[:, 4:] ** 2, axis=1))
    ids = [row.whole(0, 'the target') for row in rows]
    with ErrorsAt(path):
        return Phantom(np.array(ids), from_units(values[:, 1:4], mm), from_units(sd, mm))


def write(path: Path, content: Content, settings: FileSettings) -> Written:
    """Write the existing parts as bundle.pho, .iop, .eop and .xyz into the folder path."""
    mm, notes = settings.unit_or('mm', str(path))
    observations = content.observations or {}
    names = camera_order(
        list(observations)
        or list(dict.fromkeys(s.fluoroscope for s in content.stations))
        or [camera.name for camera in content.cameras]
    )
    if len(observations) > 1 and not content.stations:
        raise DataError(
            f'{path}: image points of {", ".join(observations)} need the exterior orientations '
            'of the .eop file, which assign the stations: convert a result folder, or choose one '
            'with --fluoroscopes'
        )
    numbering = _Numbering(names, content)
    texts = {
        '.pho': _pho(observations, numbering),
        '.iop': [
            _iop(path, c, numbering.camera[c.name]) for c in content.cameras if c.name in names
        ],
        '.eop': [_eop(s, numbering, mm) for s in content.stations if s.fluoroscope in names],
        '.xyz': _xyz(content.survey, mm),
    }
    make_folder(path)
    paths = []
    for ending, lines in texts.items():
        if lines:
            paths.append(os.path.join(path, NAME + ending))
            write_text(paths[-1], '\n'.join(lines) + '\n')
    order = ', '.join(f'{number} is {name}' for name, number in numbering.camera.items())
    more_notes: tuple[str, ...] = (f'{path}: camera {order}',) if names else ()
    if any(f.sigma is None for view_frames in observations.values() for f in view_frames):
        more_notes += (f'{path}: image points without sigma have a noise of 1 px',)
    return Written(tuple(paths), notes + more_notes)


class _Numbering:
    """Numbers of cameras, from 1, and of stations."""

    def __init__(self, names: Sequence[str], content: Content) -> None:
        self.camera = {name: number for number, name in enumerate(names, 1)}
        frames = [f for view_frames in (content.observations or {}).values() for f in view_frames]
        exposures = [*(s.exposure for s in content.stations), *(f.number for f in frames)]
        self._base = 0 if len(names) < 2 else 10 ** len(str(max(exposures, default=0)))

    def station(self, fluoroscope: str, exposure: int) -> int:
        """Return the number of a station."""
        return self.camera[fluoroscope] * self._base + exposure


def _pho(observations: Frames, numbering: _Numbering) -> list[str]:
    lines = []
    for name, frames in observations.items():
        for frame in frames:
            station = numbering.station(name, frame.number)
            noise = np.ones(len(frame.uv)) if frame.sigma is None else frame.sigma
            for target, (u, v), sd in zip(frame.target_id.tolist(), frame.uv.tolist(), noise):
                numbers = joined([u, -v, sd, sd, 0.0, 0.0], ' ')
                lines.append(f'{target} {station} {numbers}')
    return lines


def _iop(path: Path, camera: Camera, number: int) -> str:
    refuse_distortion(path, camera, 'an .iop file')
    c = common_focal_length(path, camera, 'an .iop file')
    width, height = camera.size
    values = [0, 1 - height, width - 1, 0, camera.matrix[0, 2], -camera.matrix[1, 2], c]
    return f'{number} 1 {joined([*values, *[0.0] * 16], " ")}'


def _eop(station: Station, numbering: _Numbering, mm: float) -> str:
    rotation = (Y_UP_TO_DOWN @ station.rotation).T
    angles = Rotation.from_matrix(rotation).as_euler('XYZ', degrees=True)
    number = numbering.station(station.fluoroscope, station.exposure)
    camera = numbering.camera[station.fluoroscope]
    return f'{number} {camera} {joined([*in_units(station.position_mm, mm), *angles], " ")}'


def _xyz(survey: Phantom | None, mm: float) -> list[str]:
    if survey is None:
        return []
    sd = in_units(np.repeat(survey.sd_mm[:, None], 3, axis=1), mm)
    table = np.column_stack([in_units(survey.xyz_mm, mm), sd])
    return [f'{i} {joined(row, " ")}' for i, row in zip(survey.target_id.tolist(), table)]


FORMAT = Format(
    'bundle',
    'file of the program of Chow et al.',
    parts=('observations', 'cameras', 'stations', 'survey'),
    recognise=lambda sample: sample.suffix in WIDTHS,
    read=read,
    write=write,
    says_units=False,
)
