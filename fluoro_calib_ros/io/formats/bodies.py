# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Poses of rigid bodies: files of XMALab, Autoscoper and OpenSim, and poses.csv.

XMALab: 16 columns a body, one row a frame, NaN without a pose. The layout is that of
`Trial::saveRigidBodyTransformations` of XMALab 2.2.7: the 4 x 4 matrix from the body (a bone's
model) to the world, column by column (r11, r21, r31, 0, r12, and so on, t1, t2, t3, 1), which Maya
reads as rows. XMALab names its columns R11, R12, R13, 01, R21, and so on, TX, TY, TZ, 1; the
column Frame is optional. Lengths have the unit of the calibration object, which the file does not
state.

Tables of OpenSim: orientations and positions of bodies (.sto), and joint motion (.mot). A header
of key=value up to endheader is followed by a row of labels and one row a frame, separated by
tabulators. OpenSim reads elements by DataType: quaternions w,x,y,z body -> world, and vectors in
metres, as in its models; NaN where there is no pose. Angles are in degrees if inDegrees=yes.
Programs read a .mot as TimeSeriesTable or as Storage, which silently replaces NaN by numbers.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...bodies.joints import JointMotion
from ...errors import DataError
from ...photogrammetry.rotations import (
    ROTATION_TOLERANCE,
    matrix_from_quaternion,
    quaternion_from_matrix,
)
from ..access import PathLike, atomic_file
from ..bodies import COLUMNS as POSE_COLUMNS
from ..csv_table import as_text, has_columns, read_all
from .content import (
    UNITS_MM,
    Bodies,
    Content,
    FileSettings,
    Format,
    Written,
    from_units,
    homogeneous,
    in_units,
    pose_parts,
)
from .tables import (
    Row,
    ascending_frames,
    at_all_frames,
    check_labels,
    frames_of,
    joined,
    rate_of,
    read_frames,
    require_width,
    write_frames,
)

COLUMNS = (
    *('R11', 'R12', 'R13', '01', 'R21', 'R22', 'R23', '02', 'R31', 'R32', 'R33', '03'),
    *('TX', 'TY', 'TZ', '1'),
)
_FIRST = re.compile(r'(?P<body>.+)_R11(?P<filter>_[\d.]+Hz)?')


def _read_xmalab(path: Path, settings: FileSettings) -> Content:
    """Read the poses of rigid bodies. Raises DataError."""
    header, rows, first_column = read_frames(path)
    names = _bodies(header, first_column)
    require_width(rows, len(header.cells), 'the header')
    mm = settings.unit_read(path)
    frame = ascending_frames(rows, first_column)
    values = np.array([row.numbers_or_nan(first_column) for row in rows])
    matrices = values.reshape(len(rows), len(names), 4, 4).transpose(0, 1, 3, 2)
    rotation, translation, is_invalid = pose_parts(matrices)
    for row, column in np.argwhere(is_invalid):
        rows[row].fail(f'the matrix of {names[column]} is not a rotation')
    is_other = (matrices[..., 3, :] != [0, 0, 0, 1]).any(axis=2) & ~np.isnan(translation[..., 0])
    for row, column in np.argwhere(is_other):
        rows[row].fail(f'the columns 01, 02, 03 and 1 of {names[column]} are not 0, 0, 0 and 1')
    return Content(bodies=Bodies(tuple(names), frame, rotation, from_units(translation, mm)))


def _bodies(row: Row, first: int) -> list[str]:
    """Return the names of the bodies in a header. Raises DataError."""
    cells = row.cells[first:]
    if len(cells) % len(COLUMNS):
        row.fail(f'{len(cells)} columns, but a rigid body has {len(COLUMNS)}')
    names = []
    for start in range(0, len(cells), len(COLUMNS)):
        match = _FIRST.fullmatch(cells[start])
        if match is None:
            row.fail(f'the column {cells[start]!r} is not <body>_R11')
        expected = [f'{match["body"]}_{column}{match["filter"] or ""}' for column in COLUMNS]
        found_cells = cells[start : start + len(COLUMNS)]
        for cell, name in zip(found_cells, expected):
            if cell != name:
                row.fail(f'the column {cell!r} should be {name!r}')
        names.append(match['body'] + (match['filter'] or ''))
    return names


def _write_xmalab(path: Path, content: Content, settings: FileSettings) -> Written:
    """Write the poses of rigid bodies, with a header and the column Frame."""
    bodies = content.bodies
    assert bodies is not None
    mm, notes = settings.unit_or('mm', str(path))
    matrices = homogeneous(bodies, mm)
    columns = [f'{as_text(name)}_{column}' for name in bodies.names for column in COLUMNS]
    write_frames(path, columns, bodies.frame, matrices.transpose(0, 1, 3, 2))
    return Written((str(path),), notes)


RIGIDBODY = Format(
    'rigidbody',
    'XMALab rigid body transformations',
    parts=('bodies',),
    recognise=lambda sample: '_R11' in sample.first and '_TX' in sample.first,
    read=_read_xmalab,
    write=_write_xmalab,
    says_units=False,
)


# Tracking files (.tra) of Autoscoper: one row a frame, 16 columns a body, NaN without a pose.
#
# The layout is that of `save_tracking_results` of Autoscoper with its default options: matrices
# row by row (r11, r12, r13, t1, r21, and so on, 0, 0, 0, 1), separated by commas, in mm, without a
# header. Row 1 is the first frame. A matrix maps a volume to the world. The origin of a volume of
# Autoscoper is its first voxel, with its own axes; they differ from those of the CT in which the
# markers of a body were located.


def _write_autoscoper(path: Path, content: Content, settings: FileSettings) -> Written:
    """Write the poses of bodies in all frames from the first to the last. Raises DataError."""
    assert content.bodies is not None
    mm, notes = settings.unit_or('mm', str(path))
    frames = frames_of(path, [content.bodies], settings, needs_rate=False)
    matrices = homogeneous(at_all_frames(content.bodies, frames), mm)
    with atomic_file(path, 'w') as file:
        file.writelines(joined(frame_matrices.ravel()) + '\n' for frame_matrices in matrices)
    order = f'{path}: row 1 is frame {frames.first}, bodies are {", ".join(content.bodies.names)}'
    return Written((str(path),), (*notes, order))


AUTOSCOPER = Format(
    'autoscoper',
    'Autoscoper tracking',
    parts=('bodies',),
    recognise=lambda sample: sample.suffix == '.tra',
    read=None,
    write=_write_autoscoper,
    says_units=False,
)


# poses.csv of the command bodies is read, to convert its poses to formats of other programs.

_POSES = POSE_COLUMNS[:10]  # without standard deviations: files of true poses have none


def _read_poses(path: Path, settings: FileSettings) -> Content:
    """Read the poses of bodies. Raises DataError that names the row."""
    rows = read_all(path, _POSES)
    body = np.array(rows.strings('body'))
    frame = rows.ids('exposure')
    seconds, *columns = (rows.floats_or_nan(name) for name in _POSES[2:])
    values = np.column_stack(columns)
    names = list(dict.fromkeys(body.tolist()))
    frames, row = np.unique(frame, return_inverse=True)
    body_index = np.array([names.index(name) for name in body.tolist()])
    rows.require_different(
        row * len(names) + body_index, lambda n: f'exposure {frame[n]} of {body[n]}'
    )
    known = ~np.isnan(values).any(axis=1)
    is_invalid = known & ~(np.abs(np.linalg.norm(values[:, 3:], axis=1) - 1) < ROTATION_TOLERANCE)
    if is_invalid.any():
        rows.fail(int(np.argmax(is_invalid)), 'the quaternion does not have length one')
    shape = (len(frames), len(names), 3)
    translation = np.full(shape, np.nan)
    rotation = np.full((*shape, 3), np.nan)
    index = row[known], body_index[known]
    translation[index] = values[known, :3]
    rotation[index] = matrix_from_quaternion(values[known][:, [6, 3, 4, 5]])
    rate = rate_of(frame, seconds * 1e9)
    return Content(bodies=Bodies(tuple(names), frames, rotation, translation, rate))


POSES = Format(
    'poses',
    'poses of bodies, poses.csv of the command bodies',
    parts=('bodies',),
    recognise=lambda sample: has_columns(sample.lines, _POSES),
    read=_read_poses,
    write=None,
)


END = 'endheader'


def write(path: Path, content: Content, settings: FileSettings) -> Written:
    """Write the orientations of bodies, and NAME_positions.sto next to it. Raises DataError."""
    assert content.bodies is not None
    frames = frames_of(path, [content.bodies], settings)
    bodies = at_all_frames(content.bodies, frames)
    positions = path.with_name(f'{path.stem}_positions{path.suffix}')
    known = np.isfinite(bodies.rotation).all(axis=(2, 3))
    quaternions = np.full((*known.shape, 4), np.nan)
    quaternions[known] = quaternion_from_matrix(bodies.rotation[known])
    metres = in_units(bodies.translation_mm, UNITS_MM['m'])
    for file_path, kind, values in (
        (path, 'Quaternion', quaternions),
        (positions, 'Vec3', metres),
    ):
        header = (f'DataRate={frames.rate_hz!r}', f'DataType={kind}', 'version=3')
        cells = ([joined(element) for element in row] for row in values)
        _write(file_path, header, bodies.names, frames.times_s, cells)
    return Written((str(path), str(positions)))


def write_joint_motion(path: PathLike, motions: Sequence[JointMotion], start_ns: int) -> None:
    """Write the motion of joints as coordinates: angles [deg] and translations [m].

    Labels are JOINT_NAME with the names of the convention, such as knee_flexion; times are
    relative to start_ns. Exposures in which the motion of any joint is unknown are omitted. Raises
    DataError if there are no joints, if their exposures differ, if no exposure remains, and if the
    file cannot be written.
    """
    if not motions or any(not np.array_equal(m.number, motions[0].number) for m in motions):
        raise DataError(
            f'{path}: joints are written of one joint at least, and the same exposures'
        )
    names = [
        f'{m.joint.name}_{name}'
        for m in motions
        for name in (*m.angle_names, *m.translation_names)
    ]
    values = np.hstack(
        [block for m in motions for block in (np.rad2deg(m.angles), m.translations / 1000)]
    )
    known = np.isfinite(values).all(axis=1)
    if not known.any():
        raise DataError(f'{path}: there is no exposure in which the motion of all joints is known')
    values = values[known]
    times_s = (motions[0].stamp_ns[known] - start_ns) / 1e9
    header = (
        'Coordinates',
        'version=1',
        f'nRows={len(values)}',
        f'nColumns={len(names) + 1}',
        'inDegrees=yes',
    )
    cells = ([joined([value]) for value in row] for row in values)
    _write(path, header, names, times_s, cells)


def _write(
    path: PathLike,
    header: Iterable[str],
    labels: Sequence[str],
    times_s: NDArray[np.float64],
    cells: Iterable[Sequence[str]],
) -> None:
    """Write a table. Raises DataError for a label that contains a tabulator or a line end."""
    check_labels(path, labels, '\t')
    with atomic_file(path, 'w') as file:
        for line in (*header, END, '\t'.join(('time', *labels))):
            file.write(line + '\n')
        for time_s, row in zip(times_s.tolist(), cells):
            file.write('\t'.join((repr(time_s), *row)) + '\n')


OPENSIM = Format(
    'opensim',
    'OpenSim table',
    parts=('bodies',),
    recognise=lambda sample: sample.suffix in ('.sto', '.mot') and END in sample.lines,
    read=None,
    write=write,
)
