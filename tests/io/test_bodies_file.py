# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""bodies.csv: files are read as they were written, and every fault is named with its row."""

import numpy as np
import pytest

from fluoro_calib_ros import limits
from fluoro_calib_ros.bodies.body import Body
from fluoro_calib_ros.errors import DataError
from fluoro_calib_ros.io.bodies import read_bodies, write_bodies

HEADER = 'body,marker,x,y,z,sd\n'


def test_bodies_are_read_as_written(tmp_path):
    """Places may be unknown or have no standard deviation."""
    rng = np.random.default_rng(1)
    xyz = rng.normal(0, 30, (4, 3))
    xyz[2] = np.nan
    femur = Body('femur', np.array([4, 9, 2, 7]), xyz, np.array([0.1, np.inf, np.inf, 0.0]))
    tibia = Body('tibia', np.array([1]), rng.normal(0, 30, (1, 3)), np.array([0.1]))
    write_bodies(tmp_path / 'bodies.csv', [tibia, femur])
    read = read_bodies(tmp_path / 'bodies.csv')
    assert [body.name for body in read] == ['tibia', 'femur']
    for body, written in zip(read, (tibia, femur)):
        for name in ('target_id', 'xyz_mm', 'sd_mm'):
            np.testing.assert_array_equal(getattr(body, name), getattr(written, name))


def test_columns_and_rows_may_have_any_order(tmp_path):
    path = tmp_path / 'bodies.csv'
    path.write_text('marker,body,sd,z,y,x\n5,a,.1,3,2,1\n1,b,,,,\n2,a,,6,5,4\n')
    a, b = read_bodies(path)
    assert (a.name, a.target_id.tolist(), a.xyz_mm.tolist()) == (
        'a',
        [2, 5],
        [[4, 5, 6], [1, 2, 3]],
    )
    assert a.sd_mm.tolist() == [np.inf, 0.1] and not b.known.any()


@pytest.mark.parametrize(
    ('rows', 'where', 'cause'),
    [
        ('a,1,0,0,0,.1\na,1,1,0,0,.1\n', 'row 3', 'marker 1 of a is already given in row 2'),
        ('a,1,0,0,0,.1\nb,1,1,0,0,.1\n', 'row 3', 'one of a in row 2 and one of b'),
        ('a,1,nan,0,0,.1\n', 'row 2', "x is 'nan'"),
        ('a,1,0,inf,0,.1\n', 'row 2', "y is 'inf'"),
        ('a,1,0,0,,.1\n', 'row 2', "z is ''"),
        ('a,1,,,0,.1\n', 'row 2', "z is '0'"),
        ('a,1,0,0,0,-1\n', 'row 2', "sd is '-1', below 0"),
        ('a,1,0,0,0,nan\n', 'row 2', "sd is 'nan'"),
        ('a,one,0,0,0,.1\n', 'row 2', "marker is 'one'"),
        (',1,0,0,0,.1\n', 'row 2', 'no name'),
        ('a,1,0,0,0\n', 'row 2', '5 columns'),
        ('', 'bodies.csv', 'no rows'),
    ],
)
def test_faults_are_named(tmp_path, rows, where, cause):
    path = tmp_path / 'bodies.csv'
    path.write_text(HEADER + rows)
    with pytest.raises(DataError) as caught:
        read_bodies(path)
    assert where in str(caught.value) and cause in str(caught.value)
    assert '\n' not in str(caught.value)


def test_faults_of_the_header_are_named(tmp_path):
    path = tmp_path / 'bodies.csv'
    for header, cause in (
        (HEADER[:-1] + ',mass', "'mass' is unknown"),
        ('body,x,y,z,sd', 'marker'),
    ):
        path.write_text(header + '\n' + ','.join('1' * (header.count(',') + 1)) + '\n')
        with pytest.raises(DataError, match=cause):
            read_bodies(path)


def test_bodies_of_too_many_markers_are_not_read(tmp_path, monkeypatch):
    monkeypatch.setattr(limits, '_of_this_process', [limits.ReadLimits(max_targets=2)])
    path = tmp_path / 'bodies.csv'
    path.write_text(HEADER + ''.join(f'a,{n},0,0,{n},.1\n' for n in range(3)))
    with pytest.raises(DataError, match='more than 2'):
        read_bodies(path)
