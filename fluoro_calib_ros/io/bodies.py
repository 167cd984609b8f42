# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Bodies as CSV, joints as TOML, and poses, motion and 3-D points as CSV.

Bodies are CSV `body,marker,x,y,z,sd`, in millimetres; marker is the id of a target. A marker with
an unknown position has empty x, y, z and sd; one with an unknown standard deviation an empty sd.

joints.toml defines joints, joints.csv contains their motion.

    [[joint]]
    name = "knee"
    proximal = "femur"                  # bodies
    distal = "tibia"
    convention = "grood_suntay_knee"
    side = "right"
    neutral = [1, 100]                  # first and last exposure of the neutral trial

    [joint.proximal_frame]              # in the coordinates of the body [mm]
    landmarks = {femoral_head = [12.1, 3.4, 801.0], ...}

    [joint.distal_frame]
    axes = {x = [1, 0, 0], z = [0, 0, 1]}   # or quaternion_wxyz = [1, 0, 0, 0]
    origin = [0, 0, 0]                      # or matrix = [[...], [...], [...], [0, 0, 0, 1]]

Without a frame, the axes are those of the body. docs/bodies.md describes both files.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..bodies.anatomical_frames import (
    BODY_FRAME,
    AnatomicalFrame,
    Convention,
    convention,
    frame_of_axes,
    frame_of_landmarks,
    frame_of_quaternion,
)
from ..bodies.body import STATUS_NAMES as POSE_STATUS
from ..bodies.body import Body, BodyPoses, check_bodies
from ..bodies.joints import STATUS_NAMES, Joint, JointMotion, check_frames, check_joints
from ..bodies.tracking import TrackedExposure
from ..errors import DataError, ErrorsAt
from ..exposures.names import Names
from ..exposures.phantom import first_repeated
from ..limits import MAX_JOINTS, read_limits
from ..photogrammetry.rotations import quaternion_from_matrix
from ..reconstruction.intersection import STATUS_NAMES as POINT_STATUS
from ..reconstruction.reconstruct import ReconstructedFrame
from .access import PathLike
from .csv_table import Block, Table, read_all
from .documents import check_keys, numbers_of, read_toml

BODY_COLUMNS = ('body', 'marker', 'x', 'y', 'z', 'sd')


def read_bodies(path: PathLike) -> tuple[Body, ...]:
    """Read bodies from a CSV file, in file order. Raises DataError that names the row."""
    rows = read_all(path, BODY_COLUMNS)
    unknown = [name for name in rows.header if name not in BODY_COLUMNS]
    if unknown:
        raise DataError(
            f'{path}: the column {unknown[0]!r} is unknown, expected one of '
            f'{",".join(BODY_COLUMNS)}'
        )
    names = rows.strings('body')
    markers = rows.ids('marker')
    numbers = _numbers(rows)
    if '' in names:
        rows.fail(names.index(''), 'the body has no name')
    repeated = first_repeated(markers)
    if repeated is not None:
        first, second = repeated
        marker, name, row = markers[second], names[second], rows.lines[first]
        cause = f'marker {marker} of {name} is already given in row {row}'
        if name != names[first]:
            cause = (
                f'marker {marker} is one of {names[first]} in row {row} and one of {name} here; '
                'a marker belongs to one body'
            )
        rows.fail(second, cause)
    max_markers = read_limits().max_targets
    if len(markers) > max_markers:
        raise DataError(f'{path}: bodies of more than {max_markers} markers are not read')
    of_body: dict[str, list[int]] = {}
    for index, name in enumerate(names):
        of_body.setdefault(name, []).append(index)
    bodies = [
        Body(name, markers[chosen], numbers[chosen, :3], numbers[chosen, 3])
        for name, chosen in of_body.items()
    ]
    check_bodies(bodies)
    return tuple(bodies)


def _numbers(block: Block) -> NDArray[np.float64]:
    """Return x, y, z, sd (n, 4); unknown ones are NaN, sd infinite. Raises DataError."""
    columns = []
    for name in BODY_COLUMNS[2:]:
        values = block.floats_or_nan(name)
        empty = np.array([not cell for cell in block.strings(name)])
        block.require(name, empty | np.isfinite(values), 'not a finite number')
        columns.append(values)
    x, y, z, sd = columns
    known = np.isfinite(x)
    for name, values in (('y', y), ('z', z)):
        block.require(name, np.isfinite(values) == known, 'but x, y and z are known together')
    block.require('sd', ~(sd < 0), 'below 0')
    return np.column_stack([x, y, z, np.where(np.isfinite(sd), sd, np.inf)])


def write_bodies(path: PathLike, bodies: Sequence[Body]) -> None:
    """Write bodies to a CSV file; reading it restores the same values. Raises DataError."""
    shape_table(bodies).write(path)


def shape_table(bodies: Sequence[Body]) -> Table:
    """Return the markers of bodies as a table."""
    return Table(BODY_COLUMNS, (row for body in bodies for row in _marker_rows(body)))


def _marker_rows(body: Body) -> Iterator[list[object]]:
    sd = np.where(np.isfinite(body.sd_mm), body.sd_mm, np.nan)
    numbers = np.column_stack([body.xyz_mm, sd])
    numbers[~body.known] = np.nan
    for marker, values in zip(body.target_id.tolist(), numbers.tolist()):
        yield [body.name, marker, *values]


REQUIRED = ('name', 'proximal', 'distal', 'convention')
KEYS = (*REQUIRED, 'side', 'neutral', 'proximal_frame', 'distal_frame')
FRAME_KEYS = ('landmarks', 'axes', 'quaternion_wxyz', 'matrix', 'origin')
JOINT_COLUMNS = (
    'joint',
    'exposure',
    'time_s',
    *(f'angle_{n}_deg' for n in (1, 2, 3)),
    *(f'translation_{n}_mm' for n in (1, 2, 3)),
    *(f'sd_angle_{n}_deg' for n in (1, 2, 3)),
    *(f'sd_translation_{n}_mm' for n in (1, 2, 3)),
    'status',
)


@dataclass(frozen=True)
class JointEntry:
    """A joint of a joints.toml.

    Attributes
    ----------
    joint : Joint
    neutral : (int, int) or None
        First and last exposure in neutral position; None: angles are those of the axes.
    """

    joint: Joint
    neutral: tuple[int, int] | None = None


def read_joints(path: PathLike, bodies: Iterable[Body | str]) -> tuple[JointEntry, ...]:
    """Read a joints.toml with joints between the given bodies, or bodies of the given names.

    Raises DataError that names file and joint.
    """
    document = read_toml(path)
    check_keys(path, document, ('joint',))
    tables = document.get('joint')
    if not isinstance(tables, list) or not tables:
        raise DataError(f'{path}: the file has no table [[joint]]')
    if len(tables) > MAX_JOINTS:
        raise DataError(f'{path}: {len(tables)} joints; the limit is {MAX_JOINTS}')
    entries = tuple(_entry(path, n, table) for n, table in enumerate(tables, 1))
    with ErrorsAt(path):
        by_name = {body if isinstance(body, str) else body.name: body for body in bodies}
        check_joints([entry.joint for entry in entries], by_name)
        for entry in entries:
            check_frames(entry.joint, [b for b in by_name.values() if isinstance(b, Body)])
    return entries


def _entry(path: PathLike, number: int, table: Any) -> JointEntry:
    """Return a joint of the file. Raises DataError."""
    where = f'{path}, joint {number}'
    if not isinstance(table, Mapping):
        raise DataError(f'{where}: this is not a table')
    if isinstance(table.get('name'), str) and table['name']:
        where = f'{path}, joint {table["name"]}'
    check_keys(where, table, KEYS)
    texts: dict[str, str] = {}
    for key in (*REQUIRED, 'side'):
        value = table.get(key, '' if key == 'side' else None)
        if not isinstance(value, str) or (not value and key != 'side'):
            raise DataError(f'{where}, key {key}: expected a text')
        texts[key] = value
    with ErrorsAt(where):
        joint_convention = convention(texts['convention'])
        joint_convention.check_side(texts['side'])
        frames = {
            end: _frame(joint_convention, end, table.get(f'{end}_frame'), texts['side'])
            for end in ('proximal', 'distal')
        }
        joint = Joint(
            texts['name'],
            texts['proximal'],
            texts['distal'],
            texts['convention'],
            proximal_frame=frames['proximal'],
            distal_frame=frames['distal'],
            side=texts['side'],
        )
    return JointEntry(joint, _neutral(where, table.get('neutral')))


def _neutral(where: str, value: Any) -> tuple[int, int] | None:
    if value is None:
        return None
    are_integers = isinstance(value, list) and all(type(v) is int for v in value)
    if not are_integers or len(value) != 2 or not 0 <= value[0] <= value[1]:
        raise DataError(
            f'{where}, key neutral: expected first and last exposure, such as [1, 100]'
        )
    return value[0], value[1]


def _frame(of: Convention, end: str, table: Any, side: str) -> AnatomicalFrame:
    """Return the frame of one end of a joint. Raises DataError that names the end."""
    if table is None:
        return BODY_FRAME
    with ErrorsAt(f'{end}_frame'):
        if not isinstance(table, Mapping):
            raise DataError('this is not a table')
        for key in table:
            if key not in FRAME_KEYS:
                raise DataError(
                    f'the key {key} is unknown, expected one of {", ".join(FRAME_KEYS)}'
                )
        given_keys = [key for key in FRAME_KEYS[:4] if key in table]
        if len(given_keys) != 1:
            raise DataError(f'one of {", ".join(FRAME_KEYS[:4])} is needed, not {len(given_keys)}')
        return _frame_of(of, end, table, side)


def _frame_of(of: Convention, end: str, table: Mapping[str, Any], side: str) -> AnatomicalFrame:
    """Return the frame given by landmarks, axes, quaternion or matrix. Raises DataError."""
    has_origin = 'matrix' not in table and 'landmarks' not in table
    if has_origin != ('origin' in table):
        raise DataError(f'the key origin is {"missing" if has_origin else "given twice"}')
    if 'landmarks' in table:
        kind = of.proximal_landmarks if end == 'proximal' else of.distal_landmarks
        if not kind:
            raise DataError(f'{of.name} has no landmarks for it, give axes or a neutral trial')
        return frame_of_landmarks(kind, _points(table, 'landmarks'), side)
    if 'matrix' in table:
        matrix = numbers_of(end, table, 'matrix', (4, 4))
        if (matrix[3] != [0, 0, 0, 1]).any():
            raise DataError('the last row of the matrix is not 0, 0, 0, 1')
        return AnatomicalFrame(matrix[:3, :3], matrix[:3, 3])
    origin = numbers_of(end, table, 'origin', (3,))
    if 'axes' in table:
        return frame_of_axes(_points(table, 'axes'), origin)
    return frame_of_quaternion(numbers_of(end, table, 'quaternion_wxyz', (4,)), origin)


def _points(table: Mapping[str, Any], key: str) -> dict[str, NDArray[np.float64]]:
    """Return coordinates (3,) by name. Raises DataError."""
    if not isinstance(table[key], Mapping):
        raise DataError(f'{key} is not a table of names and coordinates')
    return {name: numbers_of(key, table[key], name, (3,)) for name in table[key]}


def joint_definition(
    joint: Joint, landmarks: Mapping[str, Mapping[str, NDArray[np.float64]]]
) -> str:
    """Return the text of a joints.toml with one joint, from landmarks (3,) by body [mm]."""
    keys = {name: getattr(joint, name) for name in (*REQUIRED, 'side') if getattr(joint, name)}
    lines = ['[[joint]]', *(f'{key} = "{value}"' for key, value in keys.items())]
    for end in ('proximal', 'distal'):
        lines += ['', f'[joint.{end}_frame.landmarks]']
        points = landmarks[getattr(joint, end)]
        lines += [f'{name} = {np.asarray(x).tolist()!r}' for name, x in points.items()]
    return '\n'.join(lines) + '\n'


def joint_table(motions: Sequence[JointMotion], start_ns: int) -> Table:
    """Return joints.csv: one row a joint and exposure, times relative to start_ns."""
    rows = (row for motion in motions for row in _motion_rows(motion, start_ns))
    return Table(JOINT_COLUMNS, rows)


def _motion_rows(motion: JointMotion, start_ns: int) -> Iterator[list[object]]:
    time_s = (motion.stamp_ns - start_ns)[:, None] / 1e9
    sd_deg = np.rad2deg(motion.sd[:, :3])
    numbers = np.hstack(
        [time_s, np.rad2deg(motion.angles), motion.translations, sd_deg, motion.sd[:, 3:]]
    )
    rows = zip(motion.number.tolist(), numbers.tolist(), motion.status.tolist())
    for number, values, status in rows:
        yield [motion.joint.name, number, *values, STATUS_NAMES[status]]


# Results in space as CSV: poses and motion of bodies, and reconstructed points.
#
# Poses and motion have one row a body and exposure, in mm, s and rad. A pose maps points of the
# body to the frame of the reconstructed points; rotation errors are about the axes of that frame.
# The motion is that of the centre of the markers of a body.

COLUMNS = (
    *('body', 'exposure', 'time_s', 'x_mm', 'y_mm', 'z_mm', 'qx', 'qy', 'qz', 'qw'),
    *('sd_x_mm', 'sd_y_mm', 'sd_z_mm', 'sd_rx_rad', 'sd_ry_rad', 'sd_rz_rad', 'markers', 'status'),
)
_VALUES = (
    *('vx_mm_s', 'vy_mm_s', 'vz_mm_s', 'wx_rad_s', 'wy_rad_s', 'wz_rad_s'),
    *('ax_mm_s2', 'ay_mm_s2', 'az_mm_s2', 'alpha_x_rad_s2', 'alpha_y_rad_s2', 'alpha_z_rad_s2'),
)
MOTION_COLUMNS = ('body', 'exposure', 'time_s', *_VALUES, *(f'sd_{name}' for name in _VALUES))


def pose_table(poses: Sequence[BodyPoses], start_ns: int) -> Table:
    """Return poses.csv, times relative to start_ns."""
    return Table(COLUMNS, (row for body_poses in poses for row in _rows(body_poses, start_ns)))


def _rows(one: BodyPoses, start_ns: int) -> Iterator[list[object]]:
    known = one.known
    quaternion = np.full((len(known), 4), np.nan)
    quaternion[known] = quaternion_from_matrix(one.rotation[known])
    time_s = (one.stamp_ns - start_ns)[:, None] / 1e9
    numbers = np.hstack([time_s, one.position_mm, np.roll(quaternion, -1, axis=1), one.sd])
    rows = zip(one.number.tolist(), numbers.tolist(), one.markers.tolist(), one.status)
    for number, values, markers, status in rows:
        yield [one.body, number, *values, markers, POSE_STATUS[status]]


def motion_table(
    bodies: Sequence[Body], exposures: Sequence[TrackedExposure], start_ns: int
) -> Table:
    """Return motion.csv: velocities and accelerations with their standard deviations."""
    rows = (
        _motion(body, row, exposure, start_ns)
        for row, body in enumerate(bodies)
        for exposure in exposures
    )
    return Table(MOTION_COLUMNS, rows)


def _motion(body: Body, row: int, one: TrackedExposure, start_ns: int) -> list[object]:
    sd = np.sqrt(np.diagonal(one.covariance[row])[6:])
    values = np.concatenate([one.velocity[row], one.acceleration[row], sd])
    time_s = (one.stamp_ns - start_ns) / 1e9
    return [body.name, one.number, time_s, *values.tolist()]


# Reconstructed points as CSV: one row a point and frame, lengths in mm, residuals in px.

POINT_COLUMNS = (
    *('frame', 'stamp_ns', 'target_id', 'x', 'y', 'z'),
    *('sd_x', 'sd_y', 'sd_z', 'residual', 'rays', 'status'),
)
NAME_COLUMN = 'name'  # last column, if targets have names


def write_reconstruction(
    path: PathLike, frames: Iterable[ReconstructedFrame], names: Names | None = None
) -> None:
    """Write reconstructed frames to a CSV file, with a column name if targets have names.

    Unknown values, such as the coordinates of a point seen by a single fluoroscope, are empty
    cells. Raises DataError if the file cannot be written.
    """
    point_table(frames, names).write(path)


def point_table(frames: Iterable[ReconstructedFrame], names: Names | None = None) -> Table:
    """Return reconstructed frames as a table, with a column name if targets have names."""
    labels = (names or Names()).target_names()
    rows = (
        [*row, labels.get(row[2], '')] if labels else row
        for frame in frames
        for row in _point_rows(frame)
    )
    return Table((*POINT_COLUMNS, NAME_COLUMN) if labels else POINT_COLUMNS, rows)


def _point_rows(frame: ReconstructedFrame) -> Iterable[list[Any]]:
    points = frame.points
    numbers = np.column_stack([points.xyz_mm, points.sd_mm, points.residual])
    for target, values, rays, status in zip(
        frame.target_id.tolist(), numbers.tolist(), points.rays.tolist(), points.status.tolist()
    ):
        yield [frame.number, frame.stamp_ns, target, *values, rays, POINT_STATUS[status]]
