# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Formats of this package: bag, observations, phantom, points, grid, known orientations.

Targets, exposures and fluoroscopes may have names instead of ids.

Known orientations are a YAML file with K, R and t_mm of every fluoroscope, an input of the
calibration. The file does not contain the image size.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from ...errors import DataError, ErrorsAt
from ...exposures.names import Names, without_trivial
from ...photogrammetry.rig_orientation import KnownOrientation
from ..access import PathLike, check_layout_version, read_text, write_text
from ..bags.writer import write_bag
from ..bodies import NAME_COLUMN
from ..bodies import POINT_COLUMNS as POINTS
from ..csv_table import Table, has_columns, read_all
from ..documents import are_numbers, read_yaml
from ..observations import COLUMNS as OBSERVATIONS
from ..observations import read_named_observations, write_observations_csv
from ..phantom import COLUMNS as PHANTOM
from ..phantom import read_named_phantom, write_phantom
from .content import (
    Content,
    FileSettings,
    Format,
    Points,
    Reader,
    Writer,
    Written,
    camera_at,
    common_focal_length,
    refuse_distortion,
)
from .tables import rate_of

POINTS_NEEDED = ('frame', 'target_id', 'x', 'y', 'z')
GRID = ('fluoroscope', 'u', 'v', 'u_reference', 'v_reference')


def _write_bag(path: Path, content: Content, settings: FileSettings) -> Written:
    assert content.observations is not None
    write_bag(path, content.observations)
    return Written((str(path),))


def _read_observations(path: Path, settings: FileSettings) -> Content:
    frames, names, stray, corrected_by = read_named_observations(
        path, lambda name: settings.image_size_of(path, name), settings.names
    )
    return Content(
        observations=frames,
        names=names,
        notes=(stray,) if stray else (),
        corrected_by=corrected_by,
    )


def _write_observations(path: Path, content: Content, settings: FileSettings) -> Written:
    """Write image points, with names instead of ids as `write_observations_csv` does."""
    assert content.observations is not None
    write_observations_csv(path, content.observations, content.names, content.corrected_by)
    return Written((str(path),))


def _read_phantom(path: Path, settings: FileSettings) -> Content:
    survey, names = read_named_phantom(path, settings.names)
    return Content(survey=survey, names=names)


def _write_phantom(path: Path, content: Content, settings: FileSettings) -> Written:
    assert content.survey is not None
    write_phantom(path, content.survey, content.names)
    return Written((str(path),))


def _read_points(path: Path, settings: FileSettings) -> Content:
    """Read reconstructed points. Raises DataError."""
    rows = read_all(path, POINTS_NEEDED)
    frame = rows.ids('frame')
    target = rows.ids('target_id')
    numbers = {
        name: rows.floats_or_nan(name)
        for name in ('x', 'y', 'z', 'sd_x', 'sd_y', 'sd_z', 'residual', 'stamp_ns')
        if name in rows
    }
    unknown = np.full(len(frame), np.nan)
    frames, row = np.unique(frame, return_inverse=True)
    targets, column = np.unique(target, return_inverse=True)
    rows.require_different(
        row * len(targets) + column, lambda n: f'target {target[n]} of frame {frame[n]}'
    )
    shape = (len(frames), len(targets))

    def table(values: NDArray[np.float64]) -> NDArray[np.float64]:
        array = np.full(shape, np.nan)
        array[row, column] = values
        return array

    xyz = np.stack([table(numbers[axis]) for axis in 'xyz'], axis=2)
    xyz[np.isnan(xyz).any(axis=2)] = np.nan
    sd = [numbers.get(f'sd_{axis}', unknown) for axis in 'xyz']
    points = Points(
        frames,
        targets,
        xyz_mm=xyz,
        sd_mm=table(np.sqrt(sum(values**2 for values in sd))),
        residual_px=table(numbers.get('residual', unknown)),
        rate_hz=rate_of(frame, numbers.get('stamp_ns', unknown)),
    )
    names = Names()
    if NAME_COLUMN in rows:
        cells = zip(rows.strings(NAME_COLUMN), target.tolist())
        names = Names(without_trivial({name: identity for name, identity in cells if name}))
    return Content(points=points, names=names)


def _write_points(path: Path, content: Content, settings: FileSettings) -> Written:
    """Write the known points with their residuals, without standard deviations."""
    points = content.points
    assert points is not None
    rate = settings.rate_hz or points.rate_hz
    rows = _point_rows(points, rate, content.names.target_names())
    Table((*POINTS, NAME_COLUMN), rows).write(path)
    note = f'{path}: standard deviations of the coordinates are not written, only coordinates'
    return Written((str(path),), (note,))


def _point_rows(
    points: Points, rate: float | None, named: Mapping[int, str]
) -> Iterator[list[object]]:
    first_frame = int(points.frame[0])
    for row, column in np.argwhere(~np.isnan(points.xyz_mm[..., 0])).tolist():
        number = int(points.frame[row])
        target = int(points.target_id[column])
        cells = {
            **dict.fromkeys(POINTS, ''),
            'frame': number,
            'stamp_ns': '' if rate is None else round((number - first_frame) / rate * 1e9),
            'target_id': target,
            **dict(zip('xyz', points.xyz_mm[row, column].tolist())),
            'residual': float(points.residual_px[row, column]),
        }
        yield [*cells.values(), named.get(target, '')]


def _read_grid(path: Path, settings: FileSettings) -> Content:
    rows = read_all(path, GRID)
    names = np.array(rows.strings('fluoroscope'))
    numbers = np.column_stack([rows.floats(name) for name in GRID[1:]])
    return Content(grids={str(n): numbers[names == n] for n in dict.fromkeys(names.tolist())})


def _write_grid(path: Path, content: Content, settings: FileSettings) -> Written:
    rows = ([name, *row] for name, grid in content.grids.items() for row in grid.tolist())
    Table(GRID, rows).write(path)
    return Written((str(path),))


def _own(
    kind: str, title: str, part: str, columns: Sequence[str], functions: tuple[Reader, Writer]
) -> Format:
    """Return a CSV format of this package, recognised by its columns; functions read and write."""
    return Format(
        kind,
        f'{title}, CSV of fluoro_calib_ros',
        parts=(part,),
        recognise=lambda sample: has_columns(sample.lines, columns),
        read=functions[0],
        write=functions[1],
    )


FORMATS = (
    # Bags are read by the jobs, which also need other topics, such as the angles of C-arms.
    Format(
        'bag',
        'MCAP bag as rosbag2 writes it',
        parts=('observations',),
        recognise=lambda sample: False,
        read=None,
        write=_write_bag,
    ),
    _own(
        'observations',
        'image points',
        'observations',
        OBSERVATIONS,
        (_read_observations, _write_observations),
    ),
    _own('phantom', 'phantom', 'survey', PHANTOM, (_read_phantom, _write_phantom)),
    _own('points', 'reconstructed points', 'points', POINTS_NEEDED, (_read_points, _write_points)),
    _own('grid', 'points of a distortion grid', 'grids', GRID, (_read_grid, _write_grid)),
)


TITLE = 'known orientations'


def read(path: Path, settings: FileSettings) -> Content:
    """Read the cameras. Raises DataError."""
    cameras = []
    for name, known in read_known_orientations(path).items():
        xp, yp, c = known.interior.tolist()
        matrix = np.array([[c, 0, xp], [0, c, yp], [0, 0, 1]])
        camera = camera_at(name, matrix, settings.image_size, known.rotation, known.position_mm)
        cameras.append(camera)
    return Content(cameras=tuple(cameras))


def write(path: Path, content: Content, settings: FileSettings) -> Written:
    """Write all cameras into one file. Raises DataError."""
    orientations = {}
    for camera in content.cameras:
        refuse_distortion(path, camera, TITLE)
        common_focal_length(path, camera, TITLE)
        with ErrorsAt(f'camera {camera.name}'):
            orientations[camera.name] = KnownOrientation.from_matrices(camera.matrix, *camera.pose)
    write_known_orientations(path, orientations)
    return Written((str(path),))


KNOWN_ORIENTATION = Format(
    'known_orientation',
    f'{TITLE} of fluoro_calib_ros',
    parts=('cameras',),
    recognise=lambda sample: {'fluoroscopes', 'K'} <= sample.keys,
    read=read,
    write=write,
)


# Known orientations of fluoroscopes as YAML; docs/special_rigs.md describes the file.

VERSION = 1  # version of known_orientation.yaml
KEYS = ('K', 'R', 't_mm', 'interior_sd_px', 'exterior_sd')


def holds_known_orientations(path: PathLike) -> bool:
    """Return whether a file is YAML with an entry fluoroscopes. Raises DataError."""
    if Path(path).suffix.lower() not in ('.yaml', '.yml'):
        return False
    return any(line.startswith('fluoroscopes:') for line in read_text(path).splitlines())


def read_known_orientations(path: PathLike) -> dict[str, KnownOrientation]:
    """Read the known orientations of a YAML file, by fluoroscope.

    Raises DataError with path and fluoroscope for a file that cannot be read or is invalid.
    """
    document = read_yaml(path)
    if not isinstance(document, Mapping) or not isinstance(document.get('fluoroscopes'), Mapping):
        raise DataError(f'{path}: there is no entry "fluoroscopes" with names and K, R, t_mm')
    check_layout_version(path, document.get('format_version', VERSION), VERSION)
    return {
        str(name): _orientation(entry, f'{path}, fluoroscope {name}')
        for name, entry in document['fluoroscopes'].items()
    }


def _orientation(entry: Any, where: str) -> KnownOrientation:
    """Return the orientation of one entry. Raises DataError."""
    if not isinstance(entry, Mapping):
        raise DataError(f'{where}: the entry has no K, R and t_mm')
    for key in entry:
        if key not in KEYS:
            raise DataError(f'{where}: {key!r} is unknown, an entry has {", ".join(KEYS)}')
    for key in KEYS[:3]:
        if key not in entry:
            raise DataError(f'{where}: {key} is missing')
    try:
        if not all(are_numbers(entry[key]) for key in KEYS if entry.get(key) is not None):
            raise TypeError
        k, r, t = (np.array(entry[key], dtype=float) for key in KEYS[:3])
        return KnownOrientation.from_matrices(
            k, r, t, entry.get('interior_sd_px'), entry.get('exterior_sd')
        )
    except (TypeError, ValueError, OverflowError) as error:
        # DataError is a ValueError.
        cause = error if isinstance(error, DataError) else 'a value is not a number'
        raise DataError(f'{where}: {cause}') from None


def write_known_orientations(path: PathLike, known: Mapping[str, KnownOrientation]) -> None:
    """Write known orientations; reading the file restores them. Raises DataError."""
    entries: dict[str, Any] = {}
    for name, orientation in known.items():
        xp, yp, c = orientation.interior.tolist()
        entry: dict[str, Any] = {
            'K': [[c, 0.0, xp], [0.0, c, yp], [0.0, 0.0, 1.0]],
            'R': orientation.rotation.tolist(),
            't_mm': (-orientation.rotation @ orientation.position_mm).tolist(),
        }
        if orientation.interior_sd is not None:
            entry['interior_sd_px'] = list(orientation.interior_sd)
        if orientation.exterior_sd is not None:
            entry['exterior_sd'] = list(orientation.exterior_sd)
        entries[name] = entry
    document = {'format_version': VERSION, 'fluoroscopes': entries}
    write_text(path, yaml.safe_dump(document, sort_keys=False))
