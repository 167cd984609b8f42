# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""XMALab frame specification: the beads of a calibration object, `x,y,z[,name]` in cm.

The layout is that of `CalibrationObject::loadCoords` of XMALab 2.2.7: the first row is a header,
`x y z`, or `white` for bright beads, or `s10,s10,s10` for factors of the three coordinates; then
one row a bead. The number of the row, from 1, is the bead's id unless the bead has a name. XMALab
does not say a unit; its users give centimetres.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from ...errors import DataError
from ...exposures.names import Names, number_names, without_trivial
from ...exposures.phantom import Phantom
from ..access import read_text, write_text
from .content import Content, FileSettings, Format, Sample, Written, from_units, in_units
from .text import Row, joined, separator_of, table_of

DEFAULT_SD_MM = 0.1  # the format has no standard deviation
_HEADER = re.compile(r'(white|x[\s,;]+y[\s,;]+z|s[\d.,]+([,;]\s*s[\d.,]+){2}).*', re.IGNORECASE)


def recognise(sample: Sample) -> bool:
    """Return whether the file begins with the header of a frame specification, then a bead."""
    if len(sample.lines) < 2 or not _HEADER.fullmatch(sample.lines[0]):
        return False
    return 3 <= len(re.split(r'[,;\t]', sample.lines[1])) <= 4 and 'target' not in sample.lines[0]


def read(path: Path, settings: FileSettings) -> Content:
    """Read the survey of a phantom; its standard deviation is 0.1 mm. Raises DataError."""
    return content_of(path, read_text(path), settings)


def content_of(path: Path, text: str, settings: FileSettings) -> Content:
    """Return the survey in a text; path is for messages. Raises DataError."""
    # The header need not have the separator of the beads.
    rows = table_of(path, text, separator_of('\n'.join(text.splitlines()[1:])))
    scale = _factors(rows[0])
    beads = rows[1:]
    if not beads:
        raise DataError(f'{path}: the file has a header, but no beads')
    mm, notes = settings.unit_or('cm', str(path))
    xyz = from_units(np.array([_coordinates(row) for row in beads]) * scale, mm)
    given = [row.cells[3] if len(row.cells) > 3 else '' for row in beads]
    if any(given) and not all(given):
        index = given.index('')
        beads[index].fail('the bead has no name, but others have one')
    ids = number_names(given if all(given) else [str(i) for i in range(1, len(beads) + 1)])
    if len(ids) < len(beads):
        index = next(i for i, name in enumerate(given) if name in given[:i])
        beads[index].fail(f'the bead {given[index]!r} is given twice')
    notes = (
        *notes,
        f'{path}: the format has no standard deviation, {DEFAULT_SD_MM:g} mm is used',
    )
    try:
        survey = Phantom(np.array(list(ids.values())), xyz, np.full(len(xyz), DEFAULT_SD_MM))
    except DataError as error:
        raise error.at(path) from None
    return Content(survey=survey, names=Names(without_trivial(ids)), notes=notes)


def _factors(row: Row) -> np.ndarray:
    """Return the factors (3,) of the coordinates."""
    cells = row.cells
    if len(cells) < 3 or not all(cell.lower().startswith('s') for cell in cells[:3]):
        return np.ones(3)
    return np.array(Row(row.path, row.line, [cell[1:] for cell in cells[:3]]).numbers())


def _coordinates(row: Row) -> list[float]:
    if not 3 <= len(row.cells) <= 4:
        row.fail(f'{len(row.cells)} columns, but a bead has x,y,z and perhaps a name')
    return Row(row.path, row.line, row.cells[:3]).numbers()


def write(path: Path, content: Content, settings: FileSettings) -> Written:
    """Write the survey of a phantom."""
    survey = content.survey
    assert survey is not None
    mm, notes = settings.unit_or('cm', str(path))
    named = content.names.target_names()
    lines = ['x y z']
    for target, xyz in zip(survey.target_id.tolist(), in_units(survey.xyz_mm, mm)):
        name = named.get(target, str(target))
        if set(name) & set(',;\n'):
            raise DataError(f'{path}: a bead cannot be called {name!r} in this format')
        lines.append(f'{joined(xyz)},{name}')
    write_text(path, '\n'.join(lines) + '\n')
    lost = f'{path}: the format has no standard deviation, those of the survey are lost'
    return Written((str(path),), (*notes, lost))


FORMAT = Format(
    'framespec',
    'XMALab frame specification',
    parts=('survey',),
    recognise=recognise,
    read=read,
    write=write,
    looks_like='x y z, then rows -1.27,0,6.35,bead01',
    says_units=False,
)
