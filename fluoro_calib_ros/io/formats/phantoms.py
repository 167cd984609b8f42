# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Phantoms: lists of bead coordinates from labs and makers; XMALab frame specification.

A list has one row a bead, separated by blanks, commas, tabs or semicolons. Without a header the
columns are x y z (beads are then counted from 1), id x y z, or x y z name. With a header the
columns x, y, z, id or name, sd and diameter may be in any order, with a unit after the name of a
column (x_mm, "x [mm]", X (cm)). Rows that begin with # are comments.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...errors import DataError, ErrorsAt, quoted
from ...exposures.names import Names, number_names, without_trivial
from ...exposures.phantom import Phantom
from ...limits import read_limits
from ..access import read_text, write_text
from ..csv_table import Block, is_number, without_zeros
from .content import UNITS_MM, Content, FileSettings, Format, Sample, Written, from_units, in_units
from .tables import Row, check_labels, joined, require_width, separator_of, table_of

_COLUMN = re.compile(r'"?([a-z]+)(?:[ _]*[\[(]?(mm|cm|m)[\])]?)?"?')
# Synonyms of column names.
_SAME = {
    **dict.fromkeys(('bead', 'label', 'marker', 'name', 'no', 'nr', 'number', 'point'), 'id'),
    **dict.fromkeys(('sigma', 'std', 'accuracy', 'precision'), 'sd'),
    'd': 'diameter',
}
# Columns of other files with coordinates; their own readers report what is missing.
_OTHERS = {'target_id', 'frame', 'exposure'}
MOST_CELLS = 12  # maximum number of columns in the header of a bead list


def _is_coordinates(sample: Sample) -> bool:
    """Return whether the first rows look like a list of bead coordinates."""
    lines = [line for line in sample.lines if not line.startswith('#')]
    if len(lines) < 2:
        return False
    separator = _separator(lines)
    rows = [row.cells for row in table_of(sample.path, '\n'.join(lines), separator)]
    header = _header(rows[0])
    if header is not None:
        return len(rows[0]) <= MOST_CELLS
    return all(
        _without_header(row) == _without_header(rows[0]) != [] for row in rows[1:-1] or rows
    )


def _read_coordinates(path: Path, settings: FileSettings) -> Content:
    """Read the survey of a phantom. Raises DataError that names the row."""
    text = read_text(path)
    lines = ['' if line.lstrip().startswith('#') else line for line in text.splitlines()]
    separator = _separator([line.strip() for line in lines if line.strip()])
    rows = table_of(path, '\n'.join(lines), separator)
    header = _header(rows[0].cells)
    names, unit = header or (_without_header(rows[0].cells), None)
    lines_of_beads = rows if header is None else rows[1:]
    if not lines_of_beads:
        raise DataError(f'{path}: the file has a header, but no beads')
    max_targets = read_limits().max_targets
    if len(lines_of_beads) > max_targets:
        raise DataError(f'{path}: phantoms of more than {max_targets} targets are not read')
    if not names:
        rows[0].fail(
            f'{len(rows[0].cells)} columns without a header that names x, y and z; a bead is '
            'x y z, id x y z or x y z name'
        )
    require_width(lines_of_beads, len(rows[0].cells), 'the first row')
    cells, numbers = zip(*((row.cells, row.line) for row in lines_of_beads))
    beads = Block(path, names, list(cells), np.array(numbers))
    mm = _unit(path, unit, settings)
    xyz = from_units(np.column_stack([beads.floats(axis) for axis in 'xyz']), mm)
    notes: tuple[str, ...] = ()
    if 'sd' in beads:
        sd = beads.positive('sd') * mm
    else:
        sd, notes = _sd_unsaid(path, len(cells), settings)
    diameter = beads.positive('diameter') * mm if 'diameter' in beads else None
    ids = _ids(beads)
    with ErrorsAt(path):
        survey = Phantom(np.array(list(ids.values())), xyz, sd, diameter)
    return Content(survey=survey, names=Names(without_trivial(ids)), notes=notes)


def _separator(lines: Sequence[str]) -> str:
    """Return the separator found in the second row, ' ' for blanks."""
    sample_line = lines[1] if len(lines) > 1 else ''.join(lines)
    return next((mark for mark in ';\t,' if mark in sample_line), ' ')


def _header(cells: Sequence[str]) -> tuple[list[str], str | None] | None:
    """Return names of columns and the unit in a header, None if the row is not a header.

    A column without a meaning is called ''; the unit is None if the header states none.
    """
    names: list[str] = []
    units = set()
    for cell in cells:
        match = _COLUMN.fullmatch(cell.strip().lower())
        name = '' if match is None else _SAME.get(match[1], match[1])
        if name and name in names:
            return None
        names.append(name)
        if match is not None and match[2] and name in ('x', 'y', 'z'):
            units.add(match[2])
    if not {'x', 'y', 'z'} <= set(names) or _OTHERS & {cell.lower() for cell in cells}:
        return None
    return names, ''.join(units) if len(units) == 1 else None


def _without_header(cells: Sequence[str]) -> list[str]:
    """Return the column names of a row without a header, [] if the row fits no such layout."""
    numbers = [is_number(cell) for cell in cells]
    if len(cells) == 3 and all(numbers):
        return ['x', 'y', 'z']
    if len(cells) == 4 and all(numbers[1:]) and (cells[0].isdigit() or not numbers[0]):
        return ['id', 'x', 'y', 'z']
    if len(cells) == 4 and all(numbers[:3]) and not numbers[3]:
        return ['x', 'y', 'z', 'id']
    return []


def _unit(path: Path, unit: str | None, settings: FileSettings) -> float:
    """Return the unit in mm. Raises DataError if header and user contradict each other."""
    if unit is None:
        return settings.unit_read(path)
    if settings.units not in (None, unit):
        raise DataError(f'{path}: the header has {unit}, but --units is {settings.units}')
    return UNITS_MM[unit]


def _ids(beads: Block) -> dict[str, int]:
    """Return the ids by name, in the order of the rows. Raises DataError for a repeated name."""
    if 'id' not in beads:
        return {str(number): number for number in range(1, len(beads.rows) + 1)}
    cells = list(map(without_zeros, beads.strings('id')))
    if '' in cells:
        beads.fail(cells.index(''), 'the bead has no id')
    codes = np.unique(cells, return_inverse=True)[1]
    beads.require_different(codes, lambda row: f'bead {quoted(cells[row])}')
    if not all(cell.isascii() and cell.isdigit() for cell in cells):
        return number_names(cells)
    return dict(zip(cells, beads.ids('id').tolist()))


COORDINATES = Format(
    'coordinates',
    'list of bead coordinates',
    parts=('survey',),
    recognise=_is_coordinates,
    read=_read_coordinates,
    write=None,
    says_units=False,
)


# XMALab frame specification: the beads of a calibration object, `x,y,z[,name]` in cm.
#
# The layout is that of `CalibrationObject::loadCoords` of XMALab 2.2.7. The first row is a header:
# `x y z`, or `white` for bright beads, or `s10,s10,s10` for factors of the three coordinates. Then
# follows one row a bead. The id of a bead is the number of its row, from 1, unless it has a name.
# XMALab does not state a unit; its users give centimetres.

DEFAULT_SD_MM = 0.1  # used if neither the file nor the user states a standard deviation
_FIRST_ROW = re.compile(r'(white|x[\s,;]+y[\s,;]+z|s[\d.,]+([,;]\s*s[\d.,]+){2}).*', re.IGNORECASE)


def _is_framespec(sample: Sample) -> bool:
    """Return whether the file begins with the header of a frame specification, then a bead."""
    if len(sample.lines) < 2 or not _FIRST_ROW.fullmatch(sample.lines[0]):
        return False
    header, bead = sample.lines[:2]
    return 3 <= len(bead.split(separator_of(bead))) <= 4 and 'target' not in header


def content_of(path: Path, text: str, settings: FileSettings) -> Content:
    """Return the survey in a text; path is for messages. Raises DataError."""
    # The header may have another separator than the beads.
    rows = table_of(path, text, separator_of('\n'.join(text.splitlines()[1:])))
    scale = _factors(rows[0])
    beads = rows[1:]
    if not beads:
        raise DataError(f'{path}: the file has a header, but no beads')
    mm, notes = settings.unit_or('cm', str(path))
    for row in beads:
        if not 3 <= len(row.cells) <= 4:
            row.fail(f'{len(row.cells)} columns, but a bead has x,y,z and perhaps a name')
    xyz = np.array([Row(row.path, row.line, row.cells[:3]).numbers() for row in beads])
    xyz = from_units(xyz * scale, mm)
    bead_names = [row.cells[3] if len(row.cells) > 3 else '' for row in beads]
    if any(bead_names) and not all(bead_names):
        index = bead_names.index('')
        beads[index].fail('the bead has no name, but others have one')
    ids = number_names(
        bead_names if all(bead_names) else [str(i) for i in range(1, len(beads) + 1)]
    )
    if len(ids) < len(beads):
        index = next(i for i, name in enumerate(bead_names) if name in bead_names[:i])
        beads[index].fail(f'the bead {bead_names[index]!r} is given twice')
    sd, sd_notes = _sd_unsaid(path, len(xyz), settings)
    with ErrorsAt(path):
        survey = Phantom(np.array(list(ids.values())), xyz, sd)
    return Content(survey=survey, names=Names(without_trivial(ids)), notes=(*notes, *sd_notes))


def _sd_unsaid(
    path: Path, count: int, settings: FileSettings
) -> tuple[NDArray[np.float64], tuple[str, ...]]:
    """Return standard deviations (n,) [mm] from the settings, else the default with a note."""
    if settings.phantom_sd_mm is not None:
        return np.full(count, settings.phantom_sd_mm), ()
    note = f'{path}: the file has no standard deviation, {DEFAULT_SD_MM:g} mm is used; change it '
    return np.full(count, DEFAULT_SD_MM), (note + 'with --phantom-sd',)


def _factors(row: Row) -> NDArray[np.float64]:
    """Return the factors (3,) of the coordinates."""
    cells = row.cells
    if len(cells) < 3 or not all(cell.lower().startswith('s') for cell in cells[:3]):
        return np.ones(3)
    return np.array(Row(row.path, row.line, [cell[1:] for cell in cells[:3]]).numbers())


def _write_framespec(path: Path, content: Content, settings: FileSettings) -> Written:
    """Write the survey of a phantom."""
    survey = content.survey
    assert survey is not None
    mm, notes = settings.unit_or('cm', str(path))
    target_names = content.names.target_names()
    lines = ['x y z']
    for target, xyz in zip(survey.target_id.tolist(), in_units(survey.xyz_mm, mm)):
        name = target_names.get(target, str(target))
        check_labels(path, [name], ',;')
        lines.append(f'{joined(xyz)},{name}')
    write_text(path, '\n'.join(lines) + '\n')
    loss_note = f'{path}: the format has no standard deviation, those of the survey are lost'
    return Written((str(path),), (*notes, loss_note))


FRAMESPEC = Format(
    'framespec',
    'XMALab frame specification',
    parts=('survey',),
    recognise=_is_framespec,
    read=lambda path, settings: content_of(path, read_text(path), settings),
    write=_write_framespec,
    says_units=False,
)
