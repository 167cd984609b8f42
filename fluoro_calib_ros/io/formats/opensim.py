# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Tables of OpenSim: orientations and positions of bodies (.sto), and joint motion (.mot).

A header of key=value up to endheader, then a row of labels and a row a frame, between tabulators.
OpenSim reads elements by DataType: quaternions w,x,y,z body -> world, and vectors in metres, as
its models are; NaN where there is no pose. Angles are in degrees where inDegrees=yes. Programs
read a .mot as TimeSeriesTable or as Storage, which silently reads other numbers for NaN.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

from ...bodies.joints import JointMotion
from ...errors import DataError
from ...photogrammetry.rotations import quaternion_from_matrix
from ..access import PathLike, atomic_file
from .content import Content, FileSettings, Format, Written, in_units
from .frames_of_points import bodies_of, frames_of
from .text import joined

END = 'endheader'
METRE = 1000.0  # mm


def write(path: Path, content: Content, settings: FileSettings) -> Written:
    """Write the orientations of bodies, and beside them NAME_positions.sto. Raises DataError."""
    assert content.bodies is not None
    frames = frames_of(path, [content.bodies], settings)
    bodies = bodies_of(content.bodies, frames)
    positions = path.with_name(f'{path.stem}_positions{path.suffix}')
    known = np.isfinite(bodies.rotation).all(axis=(2, 3))
    quaternions = np.full((*known.shape, 4), np.nan)
    quaternions[known] = quaternion_from_matrix(bodies.rotation[known])
    metres = in_units(bodies.translation_mm, METRE)
    for out, kind, values in ((path, 'Quaternion', quaternions), (positions, 'Vec3', metres)):
        header = (f'DataRate={frames.rate_hz!r}', f'DataType={kind}', 'version=3')
        cells = ([joined(element) for element in row] for row in values)
        _write(out, header, bodies.names, frames.times_s, cells)
    return Written((str(path), str(positions)))


def write_joint_motion(path: PathLike, motions: Sequence[JointMotion], start_ns: int) -> None:
    """Write the motion of joints as coordinates: angles [deg] and translations [m].

    Their labels are JOINT_NAME with the names of the convention, such as knee_flexion; times are
    since start_ns. Exposures in which the motion of a joint is unknown are left out. Raises
    DataError for no joints, for motion of other exposures, where nothing is known, and where the
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
        [part for m in motions for part in (np.rad2deg(m.angles), m.translations / METRE)]
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
    times_s: np.ndarray,
    cells: Iterable[Sequence[str]],
) -> None:
    """Write a table. Raises DataError for a label that would be two, or no column."""
    for label in labels:
        if any(mark in label for mark in '\t\r\n'):
            raise DataError(f'{path}: the name {label!r} contains a tabulator or a line end')
    with atomic_file(path, 'w') as file:
        for line in (*header, END, '\t'.join(('time', *labels))):
            file.write(line + '\n')
        for time_s, row in zip(times_s.tolist(), cells):
            file.write('\t'.join((repr(time_s), *row)) + '\n')


FORMAT = Format(
    'opensim',
    'OpenSim table',
    parts=('bodies',),
    recognise=lambda sample: sample.suffix in ('.sto', '.mot') and END in sample.lines,
    read=None,
    write=write,
    looks_like='a header that ends with endheader',
)
