# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Phantoms as they are exchanged: lists of coordinates, their faults, and files from drawings."""

import numpy as np
import pytest
import rigs

from fluoro_calib_ros.errors import DataError
from fluoro_calib_ros.exposures.phantom import Drawing, Phantom, require_size
from fluoro_calib_ros.findings import Kind
from fluoro_calib_ros.io.formats import registry
from fluoro_calib_ros.io.formats.content import FileSettings
from fluoro_calib_ros.io.phantom import read_phantom
from fluoro_calib_ros.jobs.sources import read_survey

XYZ = np.array([[0, 0, 0], [64.5, 0, 0], [0, 64, 0], [0, 0, -63.25], [60, 61, 62]])
NUMBERS = [5, 7, 8, 11, 12]


def written(path, rows, separator, header=()):
    lines = [separator.join(header)] if header else []
    lines += [separator.join(str(cell) for cell in row) for row in rows]
    path.write_text('# cube of the lab\n' + '\n'.join(lines) + '\n')
    return path


def rows_of(scale=1.0, first=(), last=()):
    cells = [[repr(v) for v in (xyz / scale).tolist()] for xyz in XYZ]
    return [[*(first[i : i + 1]), *row, *(last[i : i + 1])] for i, row in enumerate(cells)]


@pytest.mark.parametrize('separator', [' ', '\t', ',', ';', '   '])
@pytest.mark.parametrize('suffix', ['.txt', '.csv', '.xyz'])
def test_plain_lists_are_read(tmp_path, separator, suffix):
    path = tmp_path / f'cube{suffix}'
    for rows, ids in (
        (rows_of(), [1, 2, 3, 4, 5]),
        (rows_of(first=NUMBERS), NUMBERS),
        (rows_of(first=[f'bead{n:02d}' for n in NUMBERS]), NUMBERS),
        (rows_of(last=[f'bead{n:02d}' for n in NUMBERS]), NUMBERS),
    ):
        found = read_survey(written(path, rows, separator), FileSettings(units='mm'))
        np.testing.assert_array_equal(found.phantom.xyz_mm, XYZ)
        assert found.phantom.target_id.tolist() == ids
        assert 'no standard deviation' in found.notes[0]
        said = read_survey(path, FileSettings(units='mm', phantom_sd_mm=0.02))
        assert (said.phantom.sd_mm == 0.02).all() and not said.notes


@pytest.mark.parametrize(
    'header, scale',
    [
        (('Bead', 'X (mm)', 'Y (mm)', 'Z (mm)', 'sd', 'diameter'), 1),
        (('id', 'x_cm', 'y_cm', 'z_cm', 'sigma', 'd'), 10),
        (('Name', 'x [m]', 'y [m]', 'z [m]', 'sd', 'diameter'), 1000),
    ],
)
def test_headers_say_columns_and_unit(tmp_path, header, scale):
    rows = [[f'b{n}', *row, 0.05 / scale, 2.0 / scale] for n, row in zip(NUMBERS, rows_of(scale))]
    path = written(tmp_path / 'cube.csv', rows, ',', header)
    phantom = read_survey(path).phantom
    np.testing.assert_allclose(phantom.xyz_mm, XYZ, rtol=1e-12, atol=0)
    np.testing.assert_allclose(phantom.sd_mm, 0.05)
    np.testing.assert_allclose(phantom.diameter_mm, 2.0)
    assert phantom.target_id.tolist() == NUMBERS


def test_the_columns_of_a_header_may_have_any_order(tmp_path):
    rows = [[z, n, y, x] for n, (x, y, z) in zip(NUMBERS, rows_of())]
    path = written(tmp_path / 'a.txt', rows, '\t', ('z_mm', 'id', 'y_mm', 'x_mm'))
    phantom = read_survey(path).phantom
    np.testing.assert_array_equal(phantom.xyz_mm, XYZ)


@pytest.mark.parametrize(
    'text, cause',
    [
        ('id,x_mm,y_mm,z_mm\n1,0,0,0\n2,9,0,0\n1,0,9,0\n3,0,0,9\n', "row 4: bead '1' is already"),
        ('id,x_mm,y_mm,z_mm\n1,0,0,0\n2,nan,0,0\n3,0,9,0\n', 'row 3: x is'),
        ('id,x_mm,y_mm,z_mm\n1,0,0,0\n2,"1,5",0,0\n3,0,9,0\n', "row 3: x is '1,5', not a"),
        ('id,x_mm,y_mm,z_mm\n1,0,0,0\n2,"1,5",0,0\n3,0,9,0\n', 'with semicolons between the'),
        ('id,x_mm,y_mm,z_mm\n1,0,0,0\n2,9,0,0\n1.0,0,9,0\n', "row 4: bead '1' is already"),
        ('id,x_mm,y_mm,z_mm\n1,0,0,0\n2,9,0\n3,0,9,0\n', 'row 3: 3 columns'),
        ('id,x_mm,y_mm,z_mm,sd\n1,0,0,0,0\n2,9,0,0,1\n', "row 2: sd is '0', not above 0"),
        ('id,x_mm,y_mm,z_mm\n1,0,0,0\n2,9,0,0\n3,0,9,0\n', '3 targets are too few'),
        ('1 0 0 0\n99999999999999999999 9 0 0\n3 0 9 0\n4 0 0 9\n', 'row 2: id is'),
        ('1 0 0 0\n2 9 0 0\n3 0 9 0\n4 0 0 9\n', '--units mm|cm|m is needed'),
        ('target_id,x,y,z\n1,0,0,0\n2,9,0,0\n', 'no column sd'),
    ],
)
def test_bad_files_are_refused_in_one_sentence(tmp_path, text, cause):
    path = tmp_path / 'bad.csv'
    path.write_text(text)
    with rigs.refused(Kind.DATA) as caught:
        read_survey(path, FileSettings(units='mm' if 'id is' in cause else None))
    assert str(path) in str(caught.value)
    assert cause in str(caught.value)


def test_decimal_commas_are_read(tmp_path):
    rows = [[cell.replace('.', ',') for cell in row] for row in rows_of()]
    path = written(tmp_path / 'a.csv', rows, ';')
    np.testing.assert_array_equal(read_survey(path, FileSettings(units='mm')).phantom.xyz_mm, XYZ)


def test_header_and_user_must_not_contradict_each_other(tmp_path):
    path = written(tmp_path / 'a.csv', rows_of(first=NUMBERS), ',', ('id', 'x_mm', 'y_mm', 'z_mm'))
    with rigs.refused(Kind.DATA):
        read_survey(path, FileSettings(units='cm'))


@pytest.mark.parametrize('factor', [0.2 / 64.5, 2e5 / 64.5])
def test_a_size_that_no_phantom_has_is_refused(tmp_path, factor):
    path = tmp_path / 'phantom.csv'
    lines = [','.join(map(str, (n, *xyz, 0.1))) for n, xyz in zip(NUMBERS, XYZ * factor)]
    path.write_text('target_id,x,y,z,sd\n' + '\n'.join(lines) + '\n')
    with rigs.refused(Kind.WRONG_UNIT):
        read_survey(path)
    require_size(
        read_survey(written(tmp_path / 'b.txt', rows_of(), ' '), FileSettings(units='mm')).phantom
    )


def test_other_files_are_no_lists_of_coordinates(tmp_path):
    for name, text in (
        ('dlt.csv', '\n'.join(['1.5,2.5,3.5'] * 11)),
        ('observations.csv', 'fluoroscope,exposure,target_id,u,v\na,1,3,5,5\n'),
        ('points.csv', 'frame,target_id,x,y,z\n1,2,3,4,5\n'),
        ('notes.txt', 'the cube\nof the lab\n'),
    ):
        path = tmp_path / name
        path.write_text(text + '\n')
        found = registry.recognised(path)
        assert found is None or found.kind != 'coordinates'


# ---- drawings


def test_a_hexagonal_sheet_has_neighbours_at_its_pitch():
    drawing = Drawing(45, 45, pitch_mm=(7.0,) * 3, hexagonal=True, blocked=[(10, 12)])
    phantom = drawing.phantom()
    assert drawing.blocked_id.tolist() == [9 * 45 + 12]
    assert len(phantom.target_id) == 45 * 45 - 1
    assert phantom.index(drawing.blocked_id).tolist() == [-1]
    inner = drawing.places_mm[22 * 45 + 22]
    distance = np.sort(np.linalg.norm(drawing.places_mm - inner, axis=1))
    np.testing.assert_allclose(distance[1:7], 7.0, atol=1e-5)
    assert distance[7] > 12


def test_a_cube_has_layers():
    drawing = Drawing(3, 2, 4, pitch_mm=(10.0, 20.0, 30.0), blocked=[(2, 3, 4)])
    assert drawing.places_mm[-1].tolist() == [20, 20, 90]
    assert drawing.phantom().target_id.tolist() == list(range(1, 24))


@pytest.mark.parametrize(
    'fault',
    [
        dict(blocked=[(6, 1)]),
        dict(blocked=[(1,)]),
        dict(diameter_mm=10.0),
        dict(columns=0),
        dict(pitch_mm=(0.0, 1.0, 1.0)),
        dict(pitch_mm=(1.0, np.inf, 1.0)),
        dict(pitch_mm=(1.0, 1.0, -1.0)),
        dict(pitch_mm=(1.0, np.nan, 1.0)),
    ],
)
def test_what_cannot_be_drawn_is_refused(fault):
    with pytest.raises(DataError) as caught:
        Drawing(**{'columns': 5, 'rows': 5, **fault})
    if 'pitch_mm' in fault:
        assert caught.value.finding.kind is Kind.IMPLAUSIBLE_NUMBER


def test_the_command_writes_file_and_picture(tmp_path, capsys):
    out = tmp_path / 'sheet.csv'
    words = ('--pitch', 7, '--diameter', 3, '--blocked', '2,2', out)
    assert rigs.run('phantom', '--hex', '6x5', *words) == 0
    phantom = read_phantom(out)
    assert isinstance(phantom, Phantom)
    assert len(phantom.target_id) == 29
    assert phantom.diameter_mm.tolist() == [3.0] * 29
    picture = (tmp_path / 'sheet.svg').read_text()
    assert '>8<' in picture  # the blocked hole
    assert '>30<' in picture
    words = ('--pitch', 20, '--picture', tmp_path / 'cube.png', '--out', tmp_path / 'cube.csv')
    assert rigs.run('phantom', '--cube', '3x3x3', *words) == 0
    assert (tmp_path / 'cube.png').read_bytes()[:4] == b'\x89PNG'
    capsys.readouterr()
    assert rigs.run('phantom', '--square', '5x5', '--pitch', 0.01, tmp_path / 'no.csv') == 1
    assert rigs.run('phantom', '--square', '5', '--pitch', 10, tmp_path / 'no.csv') == 2
    assert rigs.run('phantom', '--square', '5x5', '--pitch', 10) == 2
    assert not (tmp_path / 'no.csv').exists()


@pytest.mark.parametrize('hexagonal', [False, True])
def test_beads_of_neighbouring_layers_do_not_overlap(hexagonal):
    pitch = (10.0, 10.0, 2.0)
    with rigs.refused(Kind.IMPLAUSIBLE_NUMBER):
        Drawing(3, 3, 2, pitch_mm=pitch, hexagonal=hexagonal, diameter_mm=5.0)
    Drawing(3, 3, pitch_mm=pitch, hexagonal=hexagonal, diameter_mm=5.0)


@pytest.mark.parametrize(('count', 'looks_like'), [(5, 'MayaCam'), (11, 'DLT')])
def test_beads_that_look_like_a_camera_need_a_header(tmp_path, count, looks_like):
    """Rows of three numbers may be either; the sentence says what to do."""
    path = tmp_path / 'beads.csv'
    rows = [f'{i}.5,{i * i},{7 * i % 5}' for i in range(count)]
    path.write_text('\n'.join(rows) + '\n')
    with pytest.raises(DataError, match=f'{looks_like}.*a header, such as x,y,z'):
        read_survey(path, FileSettings(units='mm'))
    path.write_text('\n'.join(['x,y,z', *rows]) + '\n')
    assert len(read_survey(path, FileSettings(units='mm')).phantom.target_id) == count
