# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Formats of image points, phantoms, points in space and poses: written, read, and refused."""

import csv
import dataclasses
import json
import os
import pathlib
import re
import struct
import subprocess
import sys

import ezc3d
import h5py
import numpy as np
import pandas
import pytest
from scipy.spatial.transform import Rotation

from fluoro_calib_ros.bodies.joints import Joint, JointMotion
from fluoro_calib_ros.errors import DataError
from fluoro_calib_ros.exposures.frame import Frame
from fluoro_calib_ros.exposures.names import Names, number_names, safe_names
from fluoro_calib_ros.exposures.phantom import Phantom
from fluoro_calib_ros.io.formats import reader_process, registry
from fluoro_calib_ros.io.formats.bodies import write_joint_motion
from fluoro_calib_ros.io.formats.content import (
    Bodies,
    Camera,
    Content,
    FileSettings,
    Points,
    Station,
    points_without_precision,
)
from fluoro_calib_ros.io.formats.tables import rate_of, table_of
from fluoro_calib_ros.jobs.sources import read_source
from fuzz.targets.c3d import run_forked

SIZE = (1024, 768)
SETTINGS = FileSettings(image_size=SIZE, units='mm')


def frames(sigma=False, numbers=(1, 3)):
    """Return frames of two fluoroscopes; some targets are not seen and an exposure is missing."""
    rng = np.random.default_rng(5)
    out = {}
    for name, seen in (('cam1', [7, 8, 9]), ('cam2', [8, 9, 12])):
        out[name] = [
            Frame(
                name,
                number,
                np.array(seen[: 2 + index]),
                rng.uniform(0, 767, (2 + index, 2)),
                SIZE,
                rng.uniform(0.1, 0.3, 2 + index) if sigma else None,
            )
            for index, number in enumerate(numbers)
        ]
    return out


def assert_same_frames(found, expected, atol=0.0):
    assert sorted(found) == sorted(expected)
    for name, of_fluoroscope in expected.items():
        assert [f.number for f in found[name]] == [f.number for f in of_fluoroscope]
        for one, other in zip(found[name], of_fluoroscope):
            assert one.image_size == other.image_size
            np.testing.assert_array_equal(one.target_id, other.target_id)
            np.testing.assert_allclose(one.uv, other.uv, rtol=0, atol=atol)


def phantom():
    rng = np.random.default_rng(2)
    xyz = np.round(rng.uniform(-100, 100, (6, 3)), 5)
    return Phantom(np.array([7, 8, 9, 10, 11, 12]), xyz, np.full(6, 0.1))


def refused(path, settings=SETTINGS, kind=None):
    with pytest.raises(DataError) as caught:
        registry.read(path, settings, kind)
    assert '\n' not in str(caught.value)
    return str(caught.value)


@pytest.fixture
def forked(monkeypatch):
    """Fork the process that reads a binary file; tests without this fixture start a program."""
    monkeypatch.setattr(reader_process, 'run_module', run_forked)


# ---- names


def test_names_numbered_alike_have_their_numbers():
    """Thus a phantom and a recording that were named independently agree."""
    assert number_names(['bead12', 'bead03']) == {'bead12': 12, 'bead03': 3}
    assert number_names(['cam1_0017.tif', 'cam1_0004.tif']) == {
        'cam1_0017.tif': 17,
        'cam1_0004.tif': 4,
    }


def test_other_names_are_counted_after_the_known_ones():
    known = {'left': 1, 'right': 2}
    assert number_names(['top', 'right', 'low'], known) == {**known, 'top': 3, 'low': 4}
    assert number_names(['m01', 'm1']) == {'m01': 1, 'm1': 2}
    assert number_names(['x1', 'x2'], {'a': 2}) == {'a': 2, 'x1': 3, 'x2': 4}


def test_fluoroscopes_get_names_that_files_and_topics_may_have():
    assert safe_names(['cam 1', 'cam_1', 'Röntgen/2']) == {
        'cam 1': 'cam_1',
        'cam_1': 'cam_1_2',
        'Röntgen/2': 'R_ntgen_2',
    }


# ---- XMALab 2-D points


@pytest.mark.parametrize(
    'header, given, expected, notes',
    [
        ('pt1_cam1_X,pt1_cam1_Y', {}, (10, 20), 1),
        ('pt1_cam1_X,pt1_cam1_Y', {'one_based': True}, (9, 19), 0),  # DLTdv8
        ('pt1_cam1_X,pt1_cam1_Y', {'one_based': True, 'y_up': True}, (9, SIZE[1] - 20), 0),
        ('Track 1_cam_1_x,Track 1_cam_1_y', {'y_up': True}, (10, SIZE[1] - 21), 0),  # Argus
        ('Track 1_cam_1_x,Track 1_cam_1_y', {}, (10, 20), 1),
        ('tib_cam1_X,tib_cam1_Y', {}, (10, 20), 0),
    ],
)
def test_points_of_dltdv_and_argus_have_their_origin(tmp_path, header, given, expected, notes):
    """The names reveal the program, and a note names the flags if none is given."""
    path = tmp_path / 'xypts.csv'
    path.write_text(f'{header}\nNaN,NaN\n10,20\n')
    content = registry.read(path, FileSettings(image_size=SIZE, **given))
    (frame,) = content.observations['cam1']
    assert (frame.number, frame.uv.tolist()) == (2, [list(expected)])
    assert len(content.notes) == notes


@pytest.mark.parametrize('one_based', [False, True])
@pytest.mark.parametrize('y_up', [False, True])
def test_xmalab_points_return(tmp_path, one_based, y_up):
    """All variants of XMALab's dialogue are tested."""
    path = tmp_path / 'points.csv'
    settings = FileSettings(image_size=SIZE, one_based=one_based, y_up=y_up)
    registry.write(path, 'xmalab2d', Content(observations=frames()), settings)
    rows = list(csv.DictReader(path.open()))
    assert len(rows) == 3  # exposure 2 was not seen
    assert set(rows[1].values()) == {'NaN'}
    frame = frames()['cam1'][0]
    u, v = frame.uv[0]
    expected = (u + one_based, (SIZE[1] - 1 - v if y_up else v) + one_based)
    cells = (rows[0]['marker007_cam1_X'], rows[0]['marker007_cam1_Y'])
    np.testing.assert_allclose([float(c) for c in cells], expected, atol=1e-12)
    content = registry.read(path, settings)
    assert_same_frames(content.observations, frames(), atol=2e-13 if one_based or y_up else 0)
    assert not content.names


PREDICTED = """scorer,DLC_resnet50_kneeMay1shuffle1_50000,DLC,DLC,DLC,DLC,DLC
bodyparts,tib lat,tib lat,tib lat,fem,fem,fem
coords,x,y,likelihood,x,y,likelihood
0,10.5,20.25,0.99,300,400,0.98
1,11.5,21.25,0.59,301,401,0.98
2,,,,302,402,0.1
"""
LABELLED = """scorer,,,anna,anna,anna,anna
individuals,,,left,left,single,single
bodyparts,,,fem,fem,scale,scale
coords,,,x,y,x,y
labeled-data,cam2_run1,img0007.png,10.5,20.25,1,2
labeled-data,cam2_run1,img0012.png,,,3,4
"""


def test_points_predicted_by_deeplabcut(tmp_path):
    """Frames count from 0; points that DeepLabCut itself considers unseen are not used."""
    path = tmp_path / 'camADLC_resnet50_kneeMay1shuffle1_50000.csv'
    path.write_text(PREDICTED)
    content = registry.read(path, SETTINGS)
    (first, second) = content.observations['camA']
    assert (first.number, second.number) == (0, 1)
    assert content.names.targets == {'tib lat': 1, 'fem': 2}
    assert first.uv.tolist() == [[10.5, 20.25], [300, 400]]
    assert second.target_id.tolist() == [2]
    np.testing.assert_allclose(first.sigma, [1 / 0.99, 1 / 0.98])
    assert '2 points with a likelihood below 0.6' in content.notes[0]
    # Compare with the way in which DeepLabCut itself reads the file.
    table = pandas.read_csv(path, header=[0, 1, 2], index_col=0)
    assert table.iloc[0].xs('fem', level='bodyparts').tolist()[:2] == first.uv[1].tolist()


def test_points_labelled_in_deeplabcut(tmp_path):
    path = tmp_path / 'CollectedData_anna.csv'
    path.write_text(LABELLED)
    content = registry.read(path, FileSettings(image_size=SIZE, fluoroscopes=('a',)))
    assert [frame.number for frame in content.observations['a']] == [7, 12]
    assert content.names.targets == {'left fem': 1, 'scale': 2}
    assert content.observations['a'][1].uv.tolist() == [[3, 4]]


def test_a_folder_of_deeplabcut_returns(tmp_path):
    names = Names({'tib lat': 7, 'tib med': 8, 'fem': 9, 'pat': 12})
    given = Content(observations=frames(numbers=(0, 3)), names=names)
    registry.write(tmp_path / 'points', 'deeplabcut', given, SETTINGS)
    table = pandas.read_csv(tmp_path / 'points' / 'cam2.csv', header=[0, 1, 2], index_col=0)
    assert table.columns.names == ['scorer', 'bodyparts', 'coords']
    assert table.index.tolist() == [0, 3]
    uv = given.observations['cam2'][1].uv
    assert table.loc[3].xs('pat', level='bodyparts').tolist() == [*uv[2], 1.0]
    content = registry.read(tmp_path / 'points', FileSettings(image_size=SIZE, names=names))
    assert_same_frames(content.observations, given.observations)
    # Without known ids, a name still has the same id in both files.
    new = registry.read(tmp_path / 'points', SETTINGS)
    assert sorted(new.names.targets) == sorted(names.targets)
    for name, own in new.observations.items():
        known = given.observations[name]
        ids = {i: label for label, i in new.names.targets.items()}
        old = {i: label for label, i in names.targets.items()}
        for one, other in zip(own, known):
            assert [ids[i] for i in one.target_id] == [old[i] for i in other.target_id]


@pytest.mark.parametrize(
    ('text', 'settings', 'cause'),
    [
        (PREDICTED, FileSettings(), '--image-size WxH is needed'),
        (PREDICTED.replace('0.99', 'good'), SETTINGS, "row 4: column 4 is 'good'"),
        (
            PREDICTED.replace('10.5', '1e9'),
            SETTINGS,
            'row 4: the point (1e+09, 20.25) is outside the image',
        ),
        (PREDICTED.replace('fem', 'tib lat'), SETTINGS, "row 2: the body part 'tib lat' is"),
        (
            PREDICTED.replace('x,y,likelihood,x,y', 'x,y,likelihood,y,x'),
            SETTINGS,
            'row 3: the col',
        ),
        (PREDICTED.replace('\n1,', '\n0,'), SETTINGS, 'row 5: frame 0 is given twice'),
        (PREDICTED.replace('\n1,', '\nimg,'), SETTINGS, "row 5: 'img' is neither a frame nor"),
        (PREDICTED.replace(',0.98\n1', '\n1'), SETTINGS, 'row 4: 6 columns'),
        (PREDICTED[: PREDICTED.index('0,10.5')], SETTINGS, 'row 1: a DeepLabCut table has rows'),
    ],
)
def test_a_damaged_deeplabcut_table_is_refused(tmp_path, text, settings, cause):
    path = tmp_path / 'camA.csv'
    path.write_text(text)
    with pytest.raises(DataError, match=re.escape(cause)):
        registry.read(path, settings)


def with_attributes(item, **attributes):
    for name, value in attributes.items():
        item.attrs[name] = np.bytes_(value) if isinstance(value, (str, bytes)) else value


def stored(columns):
    """Return the column axis as pandas stores it: protocol 0 instructions, with each text once."""
    known = {}

    def cell(name):
        if name in known:
            return f'g{known[name]}\n'
        known[name] = len(known)
        return f'V{name}\np{known[name]}\n'

    names = (
        f'({"".join(map(cell, one))}t' if isinstance(one, tuple) else cell(one) for one in columns
    )
    return f'(l(I1\n(l{"".join(f"{name}a" for name in names)}ta.'


def pandas_table(path, text, axes=None):
    """Write a CSV table as DeepLabCut stores predictions: by to_hdf with format='table'."""
    rows = [line.split(',') for line in text.splitlines()]
    columns = list(zip(*(row[1:] for row in rows[:3])))
    values = np.array([[float(cell or 'nan') for cell in row[1:]] for row in rows[3:]])
    kind = [('index', '<i8'), ('values_block_0', '<f8', (values.shape[1],))]
    table = np.array([(int(row[0]), v) for row, v in zip(rows[3:], values)], dtype=kind)
    with h5py.File(path, 'w') as file:
        group = file.create_group('df_with_missing')
        group['table'] = table
        axes = stored(columns) if axes is None else axes
        with_attributes(group, pandas_type='frame_table', non_index_axes=axes)
    return path


def pandas_fixed(path, text, **attributes):
    """Write a CSV table as DeepLabCut stores labels: by to_hdf, with levels of both axes."""
    rows = [line.split(',') for line in text.splitlines()]
    headers = sum(not row[1] for row in rows)
    axes = {
        'block0_items': [row[3:] for row in rows[:headers]],
        'axis1': list(zip(*(row[:3] for row in rows[headers:]))),
    }
    with h5py.File(path, 'w') as file:
        group = file.create_group('df_with_missing')
        with_attributes(group, pandas_type='frame', nblocks=1)
        for axis, levels in axes.items():
            group.attrs[f'{axis}_nlevels'] = len(levels)
            for level, cells in enumerate(levels):
                names, labels = np.unique(cells, return_inverse=True)
                group[f'{axis}_level{level}'] = names.astype('S')
                group[f'{axis}_label{level}'] = labels.astype('i1')
        group['block0_values'] = np.array(
            [[float(cell or 'nan') for cell in row[3:]] for row in rows[headers:]]
        )
        with_attributes(group['block0_values'], transposed=1)
        with_attributes(group, **attributes)
    return path


@pytest.mark.parametrize(('write', 'text'), [(pandas_table, PREDICTED), (pandas_fixed, LABELLED)])
def test_hdf5_of_deeplabcut_is_what_its_csv_is(tmp_path, write, text):
    settings = FileSettings(image_size=SIZE, fluoroscopes=('a',))
    table = tmp_path / 'a.csv'
    table.write_text(text)
    expected = registry.read(table, settings)
    content = registry.read(write(tmp_path / 'a.h5', text), settings)
    assert_same_frames(content.observations, expected.observations)
    assert content.names.targets == expected.names.targets
    assert [note.partition(':')[2] for note in content.notes] == [
        note.partition(':')[2] for note in expected.notes
    ]


def test_no_code_of_a_file_of_deeplabcut_is_run(tmp_path):
    """The instructions, open(path, 'w'), would make a file if they were executed."""
    axes = f'(l(I1\ncbuiltins\nopen\n(V{tmp_path / "trapped"}\nVw\ntRta.'
    path = pandas_table(tmp_path / 'a.h5', PREDICTED, axes)
    with pytest.raises(DataError, match='its columns are stored by GLOBAL, which is not read'):
        registry.read(path, SETTINGS)
    assert not (tmp_path / 'trapped').exists()


@pytest.mark.parametrize(
    ('write', 'cause'),
    [
        (lambda p: pandas_table(p, PREDICTED, b'(lp0\n'), 'pickle exhausted before'),
        (
            lambda p: pandas_table(p, PREDICTED, stored(['x'] * 6)),
            'its columns ',
        ),
        (lambda p: pandas_table(p, PREDICTED, stored([('x', 'y')] * 6)), '2 head'),
        (lambda p: pandas_fixed(p, LABELLED, nblocks=2), 'its columns are not of one kind'),
        (lambda p: pandas_fixed(p, LABELLED, pandas_type='series'), 'it is a series of pandas'),
    ],
)
def test_hdf5_of_pandas_that_is_not_of_deeplabcut_is_refused(tmp_path, write, cause, forked):
    with pytest.raises(DataError, match=cause) as error:
        registry.read(write(tmp_path / 'a.h5'), SETTINGS)
    assert '\n' not in str(error.value)


SLEAP_UV = np.array(  # frames, tracks, nodes, x and y
    [
        [[[10.5, 20.25], [30, 40]], [[11, 21], [31, 41]]],
        [[[np.nan] * 2] * 2] * 2,
        [[[12, 22], [np.nan, np.nan]], [[13, 23], [33, 43]]],
    ]
)
SLEAP_SCORES = np.array([[[1.0, 0.5], [0.8, 0.0]], np.full((2, 2), np.nan), [[1, np.nan]] * 2])


def sleap_file(path, order, named=True, **others):
    """Write an analysis file as SLEAP does, or as sleap-io does with another order of the axes."""
    axes = ('frame', 'track', 'node', 'xy')
    with h5py.File(path, 'w') as file:
        tracks = file.create_dataset(
            'tracks', data=SLEAP_UV.transpose([axes.index(a) for a in order])
        )
        if named:
            tracks.attrs['dims'] = json.dumps(order)
        plain = [axes.index(a) for a in order if a != 'xy']
        values = {
            'point_scores': SLEAP_SCORES.transpose(plain),
            'node_names': np.array([b'hip', b'knee']),
            'track_names': np.array([b'left', b'right']),
            **others,
        }
        for name, value in values.items():
            if value is not None:
                file[name] = value
    return path


@pytest.mark.parametrize(
    ('order', 'named'),
    [
        (('track', 'xy', 'node', 'frame'), False),
        (('track', 'xy', 'node', 'frame'), True),
        (('frame', 'track', 'node', 'xy'), True),
    ],
)
def test_points_of_sleap(tmp_path, order, named, forked):
    path = sleap_file(tmp_path / 'labels.v001.000_camA.analysis.h5', order, named)
    content = registry.read(path, SETTINGS)
    ids = {'left hip': 1, 'left knee': 2, 'right hip': 3, 'right knee': 4}
    assert content.names.targets == ids
    first, second = content.observations['camA']
    assert (first.number, second.number) == (0, 2)
    assert first.target_id.tolist() == [1, 2, 3] and second.target_id.tolist() == [1, 3, 4]
    assert first.uv.tolist() == [[10.5, 20.25], [30, 40], [11, 21]]
    np.testing.assert_allclose(first.sigma, [1, 2, 1.25])
    assert second.sigma.tolist() == [1, 1, 1], 'labelled by hand'
    assert '1 points are not used, their score is 0' in content.notes[0]


def test_a_folder_of_sleap_returns(tmp_path):
    names = Names({'tib lat': 7, 'tib med': 8, 'fem': 9, 'pat': 12})
    given = Content(observations=frames(numbers=(0, 3)), names=names)
    registry.write(tmp_path / 'points', 'sleap', given, SETTINGS)
    content = registry.read(tmp_path / 'points', FileSettings(image_size=SIZE, names=names))
    assert_same_frames(content.observations, given.observations)
    with h5py.File(tmp_path / 'points' / 'cam2.analysis.h5') as file:
        assert file['tracks'].shape == (1, 2, 3, 4)
        assert file['track_occupancy'][:].ravel().tolist() == [1, 0, 0, 1]


@pytest.mark.parametrize(
    ('others', 'cause'),
    [
        ({'node_names': None}, 'it is not an analysis file of SLEAP'),
        ({'node_names': np.array([b'hip'] * 2)}, 'two points have the same name'),
        ({'node_names': np.array([b'hip'])}, 'tracks, point_scores and node_names are of'),
        ({'point_scores': np.ones((2, 2, 5))}, 'tracks, point_scores and node_names are of'),
    ],
)
def test_hdf5_of_something_else_is_refused(tmp_path, others, cause, forked):
    path = sleap_file(tmp_path / 'a.h5', ('track', 'xy', 'node', 'frame'), **others)
    with pytest.raises(DataError, match=re.escape(cause)):
        registry.read(path, SETTINGS)


def test_points_of_sleap_off_the_image_are_named(tmp_path, forked):
    path = sleap_file(tmp_path / 'a.h5', ('track', 'xy', 'node', 'frame'))
    with pytest.raises(
        DataError, match=r'frame 2: the point .* is outside the image of 35 x 42 px'
    ):
        registry.read(path, FileSettings(image_size=(35, 42)))


def test_names_of_markers_return(tmp_path):
    names = Names({'tib lat': 7, 'tib med': 8, 'fem': 9, 'pat': 12})
    path = tmp_path / 'points.csv'
    content = Content(observations=frames(), names=names)
    registry.write(path, 'xmalab2d', content, SETTINGS)
    assert path.read_text().startswith('tib lat_cam1_X,tib lat_cam1_Y,tib lat_cam2_X')
    again = registry.read(path, FileSettings(image_size=SIZE, names=names))
    assert again.names == names
    assert_same_frames(again.observations, frames())
    assert registry.read(path, SETTINGS).names.targets == {
        'tib lat': 1,
        'tib med': 2,
        'fem': 3,
        'pat': 4,
    }


def test_offset_columns_of_xmalab_are_read(tmp_path):
    """XMALab does not separate them in the header, but other programs do."""
    path = tmp_path / 'points.csv'
    for header in (
        'cam0_offsetcam1_offsetm1_cam1_X,m1_cam1_Y,m1_cam2_X,m1_cam2_Y',
        'cam0_offset,cam1_offset,m1_cam1_X,m1_cam1_Y,m1_cam2_X,m1_cam2_Y',
    ):
        path.write_text(f'{header}\n0,0,1.5,2.5,NaN,NaN\n')
        (frame,) = registry.read(path, SETTINGS).observations['cam1']
        np.testing.assert_array_equal(frame.uv, [[1.5, 2.5]])
        path.write_text(f'{header}\n0,3,1.5,2.5,NaN,NaN\n')
        assert 'row 2: the cameras are offset against each other in time' in refused(path)


def test_semicolons_with_decimal_commas_are_recognised(tmp_path):
    """Spreadsheets write tables like this in many countries."""
    path = tmp_path / 'points.csv'
    path.write_text('Frame;m1_cam1_X;m1_cam1_Y\n4;1,5;2,25\n9;nan;nan\n')
    (frame,) = registry.read(path, SETTINGS).observations['cam1']
    assert frame.number == 4
    np.testing.assert_array_equal(frame.uv, [[1.5, 2.25]])
    path.write_text(
        'fluoroscope;exposure;target_id;u;v;sigma\ncam 1;trial 3.tif;bead01;1,5;2;0,25\n'
    )
    content = registry.read(path, SETTINGS)
    assert content.names == Names({'bead01': 1}, {'trial 3.tif': 3}, {'cam 1': 'cam_1'})
    (frame,) = content.observations['cam_1']
    assert (frame.number, frame.sigma.tolist()) == (3, [0.25])
    np.testing.assert_array_equal(frame.uv, [[1.5, 2.0]])
    path.write_text(
        'target_id;x;y;z;sd\n' + ''.join(f'b{i};{i},5;0;{i * i},1;0,1\n' for i in range(5))
    )
    survey = registry.read(path, SETTINGS).survey
    assert survey.xyz_mm[4].tolist() == [4.5, 0, 16.1]


@pytest.mark.parametrize(
    ('text', 'sentence'),
    [
        ('m_cam1_X,m_cam1_Y\n1,x\n', "row 2: column 2 is 'x', not a number"),
        ('m_cam1_X,m_cam1_Y\n1,2,3\n', 'row 2: 3 columns, but the header has 2'),
        ('m_cam1_X,m_cam2_Y\n1,2\n', 'row 1: the column m_cam1_X is not followed by m_cam1_Y'),
        (
            'm_cam1_X,m_cam1_Y\n1,900\n',
            'row 2: the point (1, 900) of m in cam1 is outside the image',
        ),
        (
            'm_cam1_X,m_cam1_Y,n_cam2_X,n_cam2_Y\n1,2,3,4\n5,6,7,900\n',
            'row 3: the point (7, 900) of n in cam2 is outside the image',
        ),
        ('m_cam1_X,m_cam1_Y,m_cam1_X,m_cam1_Y\n1,2,1,2\n', 'row 1: m_cam1 is given twice'),
        ('m_cam1_X,m_cam1_Y\n', 'the file has a header, but no rows'),
    ],
)
def test_wrong_xmalab_points_name_the_row(tmp_path, text, sentence):
    path = tmp_path / 'points.csv'
    path.write_text(text)
    assert sentence in refused(path)


def test_columns_mixing_ids_and_names_are_refused(tmp_path):
    path = tmp_path / 'points.csv'
    path.write_text('fluoroscope,exposure,target_id,u,v\na,1,3,5,5\na,1,bead4,6,6\n')
    assert refused(path) == f"{path}, row 3: target_id is 'bead4', not an integer"


# ---- phantoms


@pytest.mark.parametrize('units', ['cm', 'mm', 'm'])
def test_frame_specification_returns(tmp_path, units):
    path = tmp_path / 'frame.csv'
    settings = FileSettings(units=units)
    names = Names({f'bead {i}': i for i in range(7, 13)})
    registry.write(path, 'framespec', Content(survey=phantom(), names=names), settings)
    content = registry.read(path, settings)
    np.testing.assert_array_equal(content.survey.xyz_mm, phantom().xyz_mm)
    np.testing.assert_array_equal(content.survey.target_id, phantom().target_id)
    assert content.names == names


def test_frame_specification_of_a_lab_is_read(tmp_path):
    """Lengths are in cm by default; factors, white beads and rows without names are read."""
    path = tmp_path / 'frame.csv'
    beads = '0,0,1.5\n1,0,0\n0,1,0\n1,1,1\n'
    for header, factor in (('x y z', 10), ('white', 10), ('s2,s2,s2,x', 20), ('x,y,z', 10)):
        path.write_text(f'{header}\n{beads}')
        content = registry.read(path, FileSettings())
        assert content.survey.target_id.tolist() == [1, 2, 3, 4]
        assert content.survey.xyz_mm[0].tolist() == [0, 0, 1.5 * factor]
        assert 'lengths in cm' in content.notes[0]
    beads = ''.join(f'{row},{name}\n' for row, name in zip(beads.split(), (8, 4, 5, 6)))
    for header, text in (
        ('x,y,z', beads),
        ('x;y;z', beads.replace(',', ';')),
        ('x;y;z', beads.replace(',', ';').replace('.', ',')),
    ):
        path.write_text(f'{header}\n{text}')
        survey = registry.read(path, FileSettings()).survey
        assert survey.target_id.tolist() == [4, 5, 6, 8]
        assert survey.xyz_mm[3].tolist() == [0, 0, 15]
    path.write_text('x y z\n0,0,1.5\n1,0\n')
    assert 'row 3: 2 columns, but a bead has x,y,z' in refused(path)
    path.write_text('x y z\n0,0,1.5,a\n1,0,2,a\n')
    assert "row 3: the bead 'a' is given twice" in refused(path)


# ---- the program of Chow et al.


def stations():
    rng = np.random.default_rng(8)
    out = []
    for name in ('cam1', 'cam2'):
        for exposure in (1, 3):
            rotation = Rotation.random(random_state=rng).as_matrix()
            out.append(Station(name, exposure, rotation, rng.uniform(-900, 900, 3)))
    return tuple(out)


def chow_content():
    matrices = [np.array([[c, 0, 500.5], [0, c, 380.25], [0, 0, 1]]) for c in (4000.0, 4100.0)]
    cameras = tuple(Camera(f'cam{i}', m, SIZE) for i, m in enumerate(matrices, 1))
    return Content(
        observations=frames(sigma=True), survey=phantom(), cameras=cameras, stations=stations()
    )


def test_files_of_chow_et_al_return(tmp_path):
    content = chow_content()
    registry.write(tmp_path, 'bundle', content, SETTINGS)
    assert sorted(p.name for p in tmp_path.iterdir()) == [
        f'bundle.{s}' for s in ('eop', 'iop', 'pho', 'xyz')
    ]
    again = registry.read(tmp_path / 'bundle.pho', FileSettings(units='mm'))
    assert_same_frames(again.observations, content.observations)
    for one, other in zip(again.cameras, content.cameras):
        assert (one.name, one.image_size) == (other.name, SIZE)
        np.testing.assert_array_equal(one.matrix, other.matrix)
    for one, other in zip(again.stations, content.stations):
        assert (one.fluoroscope, one.exposure) == (other.fluoroscope, other.exposure)
        np.testing.assert_allclose(one.rotation, other.rotation, atol=1e-12)
        np.testing.assert_array_equal(one.position_mm, other.position_mm)
    np.testing.assert_array_equal(again.survey.xyz_mm, phantom().xyz_mm)


def test_files_of_chow_et_al_satisfy_its_collinearity_equations(tmp_path):
    """They are those of its source, x = xp - c X/Z and y = yp - c Y/Z, with omega, phi, kappa."""
    registry.write(tmp_path, 'bundle', chow_content(), SETTINGS)
    iop = np.loadtxt(tmp_path / 'bundle.iop')
    eop = np.loadtxt(tmp_path / 'bundle.eop')
    assert iop.shape == (2, 25) and (iop[:, 1] == 1).all()
    for row, station in zip(eop, stations()):
        w, p, k = np.radians(row[5:])
        sw, sp, sk = np.sin([w, p, k])
        cw, cp, ck = np.cos([w, p, k])
        turn = np.array(
            [
                [cp * ck, cw * sk + sw * sp * ck, sw * sk - cw * sp * ck],
                [-cp * sk, cw * ck - sw * sp * sk, sw * ck + cw * sp * sk],
                [sp, -sw * cp, cw * cp],
            ]
        )
        point = station.position_mm + station.rotation.T @ [30.0, -20.0, 1000.0]
        x, y, z = turn @ (point - row[2:5])
        _, _, _, _, _, _, xp, yp, c = iop[int(row[1]) - 1, :9]
        image = np.array([xp - c * x / z, yp - c * y / z])
        f = chow_content().cameras[int(row[1]) - 1].matrix
        expected = f[0, 2] + f[0, 0] * 0.03, f[1, 2] - f[0, 0] * 0.02
        np.testing.assert_allclose([image[0], -image[1]], expected, atol=1e-8)


def test_wrong_files_of_chow_et_al_name_the_row(tmp_path):
    registry.write(tmp_path, 'bundle', chow_content(), SETTINGS)
    path = tmp_path / 'bundle.pho'
    lines = path.read_text().splitlines()
    path.write_text('\n'.join([*lines[:3], lines[3].replace('-', '', 1)]))
    assert 'row 4: the point is outside the image of 1024 x 768 px; y is negative' in refused(path)
    path.write_text('\n'.join([lines[0], lines[0]]))
    assert 'row 2: target 7 of this station is already given in row 1' in refused(path)
    path.write_text('1 2 3\n')
    assert 'row 1: 3 columns, but a .pho file has 8' in refused(path)


# ---- points in space


def points(rate=200.0):
    rng = np.random.default_rng(4)
    xyz = np.round(rng.uniform(-50, 50, (5, 3, 3)), 4)
    xyz[1, 2] = np.nan
    xyz[3] = np.nan
    sd = np.where(np.isnan(xyz[..., 0]), np.nan, rng.uniform(0.01, 0.09, (5, 3)))
    return Points(np.array([11, 12, 13, 14, 15]), np.array([1, 2, 5]), xyz, sd, sd, rate)


NAMED = Names({'tib lat': 1, 'tib med': 2, 'fem': 5})


def test_c3d_is_read_by_ezc3d(tmp_path):
    """Names, unit, rate, first frame, coordinates and residual agree; a gap has residual -1."""
    path = tmp_path / 'points.c3d'
    registry.write(path, 'c3d', Content(points=points(), names=NAMED), FileSettings())
    file = ezc3d.c3d(str(path))
    parameters = file['parameters']['POINT']
    assert parameters['LABELS']['value'] == ['tib lat', 'tib med', 'fem']
    assert parameters['UNITS']['value'] == ['mm']
    assert file['header']['points']['frame_rate'] == 200
    assert file['header']['points']['first_frame'] == 10  # ezc3d counts from 0
    xyz = file['data']['points'][:3].transpose(2, 1, 0)
    seen = ~np.isnan(points().xyz_mm)
    np.testing.assert_array_equal(xyz[seen], points().xyz_mm[seen].astype(np.float32))
    residual = file['data']['meta_points']['residuals'][0].T
    np.testing.assert_array_equal(residual < 0, ~seen[..., 0])


def test_scale_and_residuals_of_c3d_are_where_the_user_guide_has_them(tmp_path, forked):
    """As in py-c3d, the fourth word has the residual in its low byte, cameras in its high one."""
    path = tmp_path / 'points.c3d'
    registry.write(path, 'c3d', Content(points=points(), names=NAMED), FileSettings())
    content = path.read_bytes()
    points_of_frame, analog, first, last, _, scale, data = struct.unpack_from('<5HfH', content, 2)
    assert (points_of_frame, analog, first, last) == (3, 0, 11, 15)
    assert scale == np.float32(ezc3d.c3d(str(path))['parameters']['POINT']['SCALE']['value'][0])
    words = np.frombuffer(content, '<f4', 60, (data - 1) * 512).reshape(5, 3, 4)[..., 3]
    missing = np.isnan(points().sd_mm)
    np.testing.assert_array_equal(words == -1, missing)
    assert words.max() == 255
    np.testing.assert_allclose(
        words[~missing] * -scale, points().sd_mm[~missing], atol=-scale / 2 + 1e-6
    )


def dec(values):
    """Return numbers in the format of DEC processors: swapped halves, exponent larger by two."""
    return (values.astype('<f4') * 4).view('<u2').reshape(-1, 2)[:, ::-1].tobytes()


@pytest.mark.parametrize('kind', ['float', 'integer', 'DEC float'])
def test_residuals_of_cameras_are_read_from_c3d(tmp_path, kind, forked):
    """Vicon and Qualisys write them with a mask of cameras in the high byte."""
    path = tmp_path / 'points.c3d'
    registry.write(path, 'c3d', Content(points=points(), names=NAMED), FileSettings())
    content = bytearray(path.read_bytes())
    (data,) = struct.unpack_from('<H', content, 16)
    values = np.frombuffer(content, '<f4', 60, (data - 1) * 512).copy()
    values[3::4] = np.where(values[3::4] < 0, -1, 0b101 * 256 + 200)
    step = 0.01
    scale = step if kind == 'integer' else -step
    if kind == 'integer':
        values[np.arange(60) % 4 != 3] /= step
        values = np.round(values).astype('<i2')
    as_bytes = np.ndarray.tobytes
    if kind == 'DEC float':
        as_bytes = dec
        content[(content[0] - 1) * 512 + 3] = 85
    content[(data - 1) * 512 :] = as_bytes(values).ljust(512, b'\0')
    place = content.index(b'SCALE') + 9  # after the offset of 2 bytes, type and dimensions
    content[12:16] = content[place : place + 4] = as_bytes(np.array([scale], dtype='<f4'))
    path.write_bytes(content)
    found = registry.read(path, FileSettings()).points
    seen = ~np.isnan(points().xyz_mm)
    np.testing.assert_allclose(found.xyz_mm[seen], points().xyz_mm[seen], atol=step)
    np.testing.assert_allclose(found.sd_mm[seen[..., 0]], 200 * step, rtol=1e-6)


def test_damaged_c3d_is_refused(tmp_path):
    """One file is truncated; the parameters of the other make ezc3d fail."""
    path = tmp_path / 'points.c3d'
    registry.write(path, 'c3d', Content(points=points(), names=NAMED), FileSettings())
    whole = path.read_bytes()
    count, _, first, last = struct.unpack_from('<4H', whole, 2)
    end = (whole[16] - 1) * 512 + (last - first + 1) * count * 16  # four float32 per point
    for length in (100, 700, end - 1):
        path.write_bytes(whole[:length])
        assert 'this C3D file is truncated' in refused(path)
    place = whole.index(b'LABELS')
    path.write_bytes(whole[:place] + b'LOBELS' + whole[place + 6 :])
    assert refused(path) == f'{path}: 3 points, but 0 different names'


def test_sleap_of_frames_that_are_a_date_is_refused(tmp_path):
    given = Content(observations=frames(numbers=(0, 20240131)), names=Names())
    with pytest.raises(DataError, match='frame 20240131 would need as many rows'):
        registry.write(tmp_path / 'points', 'sleap', given, SETTINGS)


@pytest.mark.parametrize('kind', ['c3d', 'trc', 'xmalab3d', 'points'])
def test_points_in_space_return(tmp_path, kind):
    path = tmp_path / f'out.{kind if kind in ("c3d", "trc") else "csv"}'
    registry.write(path, kind, Content(points=points(), names=NAMED), SETTINGS)
    content = registry.read(path, FileSettings(units='mm', names=NAMED))
    expected = points().xyz_mm.astype(np.float32) if kind == 'c3d' else points().xyz_mm
    found = content.points.xyz_mm
    if kind == 'points':  # it has no rows for frames without points
        expected = expected[[0, 1, 2, 4]]
    np.testing.assert_array_equal(found, expected)
    assert content.points.frame[0] == 11
    assert content.points.target_id.tolist() == [1, 2, 5]
    assert content.names == NAMED
    assert content.points.rate_hz == (None if kind == 'xmalab3d' else 200)


# opensim changes the environment of its process such that no ROS process can start from it.
READ_BY_OPENSIM = """
import json, sys
import opensim
opensim.Logger.setLevelString('Off')
table = opensim.TimeSeriesTableVec3(sys.argv[1])
rows = range(table.getNumRows())
columns = [table.getDependentColumn(name) for name in table.getColumnLabels()]
json.dump({
    'labels': list(table.getColumnLabels()),
    'unit': table.getTableMetaDataAsString('Units'),
    'rate': float(table.getTableMetaDataAsString('DataRate')),
    'times': list(table.getIndependentColumn()),
    'xyz': [[[column[row].get(axis) for axis in range(3)] for column in columns] for row in rows],
}, sys.stdout)
"""


def test_trc_is_read_by_opensim(tmp_path):
    """Labels, unit, rate, times and coordinates agree; a gap is NaN."""
    if sys.version_info < (3, 11):
        pytest.skip('opensim has no wheel for Python 3.10')
    path = tmp_path / 'points.trc'
    registry.write(path, 'trc', Content(points=points(), names=NAMED), FileSettings())
    done = subprocess.run(
        [sys.executable, '-c', READ_BY_OPENSIM, path], capture_output=True, text=True, check=True
    )
    table = json.loads(done.stdout)
    assert table['labels'] == ['tib lat', 'tib med', 'fem']
    assert (table['unit'], table['rate']) == ('mm', 200)
    np.testing.assert_allclose(table['times'], np.arange(5) / 200, atol=1e-12)
    np.testing.assert_array_equal(np.array(table['xyz'], float), points().xyz_mm)


def test_frames_left_out_are_gaps_at_a_constant_rate(tmp_path):
    sparse = points_without_precision(
        np.array([1, 4]), np.array([1]), np.array([[[1.0, 2, 3]], [[4.0, 5, 6]]])
    )
    path = tmp_path / 'points.trc'
    with pytest.raises(DataError, match='does not contain the frame rate, --rate HZ is needed'):
        registry.write(path, 'trc', Content(points=sparse), FileSettings())
    registry.write(path, 'trc', Content(points=sparse), FileSettings(rate_hz=100.0))
    found = registry.read(path, FileSettings()).points
    assert found.frame.tolist() == [1, 2, 3, 4]
    assert np.isnan(found.xyz_mm[1:3]).all() and found.xyz_mm[3, 0].tolist() == [4, 5, 6]


def test_trc_of_an_unknown_unit_needs_the_unit(tmp_path):
    path = tmp_path / 'points.trc'
    registry.write(path, 'trc', Content(points=points()), FileSettings(units='mm'))
    lines = path.read_text().split('\n')
    lines[2] = lines[2].replace('mm', 'furlong')
    path.write_text('\n'.join(lines))
    sentence = f"{path}, row 3: the unit is 'furlong', give it with --units"
    assert refused(path, FileSettings()) == sentence
    found = registry.read(path, FileSettings(units='cm')).points.xyz_mm
    np.testing.assert_allclose(found, 10 * points().xyz_mm)


@pytest.mark.parametrize(
    'header', ['Frame,a_X,b_Y,a_Z', 'Frame,a_X,a_Y', 'Frame,a_X,a_Z,a_Y', 'Frame,a_X,a_Y,a_Z,a_X']
)
def test_columns_that_are_not_triples_of_a_target_are_refused(tmp_path, header):
    path = tmp_path / 'points.csv'
    path.write_text(f'{header}\n1{",5" * header.count(",")}\n')
    assert f'{path}, row 1: the column' in refused(path, SETTINGS, 'xmalab3d')


def test_trc_without_frames_is_refused(tmp_path):
    path = tmp_path / 'points.trc'
    registry.write(path, 'trc', Content(points=points()), FileSettings(units='mm'))
    header = path.read_text().splitlines()[:5]
    path.write_text('\n'.join(header) + '\n\n')
    assert 'no frames' in refused(path, FileSettings())


def test_xmalab_3d_points_of_a_lab_are_read(tmp_path):
    """There is no column Frame and no unit; a marker that is not seen is NaN."""
    path = tmp_path / 'points.csv'
    path.write_text('m1_X,m1_Y,m1_Z,m2_X,m2_Y,m2_Z\n1,2,3,NaN,NaN,NaN\n4,5,6,7,8,9\n')
    found = registry.read(path, FileSettings(units='cm')).points
    assert found.frame.tolist() == [1, 2]
    assert found.xyz_mm[1, 1].tolist() == [70, 80, 90] and np.isnan(found.xyz_mm[0, 1]).all()
    assert 'does not state the unit' in refused(path, FileSettings())


@pytest.mark.parametrize('kind', ['trc', 'xmalab3d', 'rigidbody'])
@pytest.mark.parametrize('order', [(1, 0, 2), (0, 1, 1)])
def test_frames_out_of_order_are_refused(tmp_path, kind, order):
    path = tmp_path / ('a.trc' if kind == 'trc' else 'a.csv')
    bodies = Bodies(
        ('b',), np.array([4, 5, 6]), np.tile(np.eye(3), (3, 1, 1, 1)), np.zeros((3, 1, 3))
    )
    content = Content(points=points(9.0), bodies=bodies)
    registry.write(path, kind, content, SETTINGS)
    *head, first, second, third = path.read_text().splitlines()
    rows = [[first, second, third][index] for index in order]
    path.write_text('\n'.join([*head, *rows]) + '\n')
    assert 'comes after frame' in refused(path, SETTINGS, kind)


def test_trc_that_is_cut_off_has_a_note(tmp_path):
    path = tmp_path / 'a.trc'
    registry.write(path, 'trc', Content(points=points(9.0)), SETTINGS)
    assert not registry.read(path, SETTINGS).notes
    lines = path.read_text().splitlines()
    path.write_text('\n'.join(lines[:-1]) + '\n')
    (note,) = registry.read(path, SETTINGS).notes
    rows = len(lines) - 6
    assert note == f'{path}: the header states {rows} frames, the file has {rows - 1}'


# ---- rigid bodies


def test_rigid_bodies_return(tmp_path):
    turn = Rotation.random(3, random_state=np.random.default_rng(1)).as_matrix()
    shift = np.round(np.random.default_rng(2).uniform(-9, 9, (3, 1, 3)), 6)
    turn = turn[:, None]
    turn[1] = shift[1] = np.nan
    bodies = Bodies(('femur',), np.array([1, 2, 3]), turn, shift)
    path = tmp_path / 'bodies.csv'
    registry.write(path, 'rigidbody', Content(bodies=bodies), FileSettings(units='cm'))
    found = registry.read(path, FileSettings(units='cm')).bodies
    assert found.names == ('femur',)
    np.testing.assert_array_equal(found.rotation, turn)
    np.testing.assert_array_equal(found.translation_mm, shift)
    # The first four numbers are the first column of the matrix that moves the bone: Maya's row.
    row = [float(cell) for cell in path.read_text().splitlines()[1].split(',')]
    matrix = np.array(row[1:]).reshape(4, 4)
    moved = np.array([1.0, 2, 3, 1]) @ matrix
    np.testing.assert_allclose(moved[:3], (turn[0, 0] @ [10.0, 20, 30] + shift[0, 0]) / 10)


def test_matrix_that_is_no_rotation_is_refused(tmp_path):
    path = tmp_path / 'bodies.csv'
    bodies = Bodies(('b',), np.array([1]), np.eye(3)[None, None] * 2, np.zeros((1, 1, 3)))
    registry.write(path, 'rigidbody', Content(bodies=bodies), SETTINGS)
    assert 'row 2: the matrix of b is not a rotation' in refused(path)


def moving_bodies(rate=250.0):
    """Return two bodies in frames 4, 5 and 7; in frame 5 the second body has no pose."""
    rng = np.random.default_rng(4)
    turn = Rotation.random(6, random_state=rng).as_matrix().reshape(3, 2, 3, 3)
    shift = np.round(rng.uniform(-200, 200, (3, 2, 3)), 4)
    turn[1, 1] = shift[1, 1] = np.nan
    return Bodies(('femur', 'tibia'), np.array([4, 5, 7]), turn, shift, rate)


def test_rotations_of_c3d_are_read_by_ezc3d(tmp_path):
    """Bodies may come with points; frame 6 has no poses. We read the same values as ezc3d."""
    path = tmp_path / 'bodies.c3d'
    bodies = moving_bodies(200.0)
    for content in (Content(bodies=bodies), Content(bodies=bodies, points=points(), names=NAMED)):
        registry.write(path, 'c3d', content, FileSettings())
        file = ezc3d.c3d(str(path))
        assert file['parameters']['ROTATION']['LABELS']['value'] == ['femur', 'tibia']
        assert file['parameters']['ROTATION']['RATE']['value'].tolist() == [200]
        first = file['header']['points']['first_frame'] + 1
        matrices = file['data']['rotations'][..., bodies.frame - first]
        np.testing.assert_allclose(
            matrices[:3, :3].transpose(3, 2, 0, 1), bodies.rotation, atol=1e-6
        )
        np.testing.assert_allclose(
            matrices[:3, 3].transpose(2, 1, 0), bodies.translation_mm, rtol=1e-6
        )
        assert np.isnan(file['data']['rotations'][..., 6 - first]).all()
        found = registry.read(path, FileSettings())
        assert found.parts == content.parts
        assert (found.bodies.names, found.bodies.rate_hz) == (bodies.names, 200)
        rows = np.isin(found.bodies.frame, bodies.frame)
        np.testing.assert_allclose(found.bodies.rotation[rows], bodies.rotation, atol=1e-6)
        np.testing.assert_allclose(
            found.bodies.translation_mm[rows], bodies.translation_mm, rtol=1e-6
        )
        assert np.isnan(found.bodies.rotation[~rows]).all()
    metres = FileSettings(units='m')
    registry.write(path, 'c3d', Content(bodies=bodies), metres)
    found = registry.read(path, FileSettings()).bodies
    np.testing.assert_allclose(found.translation_mm[0], bodies.translation_mm[0], rtol=1e-5)
    with pytest.raises(DataError, match='--rate HZ is needed'):
        registry.write(path, 'c3d', Content(bodies=moving_bodies(None)), FileSettings())


def test_rotation_of_c3d_that_is_none_is_refused(tmp_path, forked):
    bodies = moving_bodies()
    scaled = dataclasses.replace(bodies, rotation=2 * bodies.rotation)
    path = tmp_path / 'bodies.c3d'
    registry.write(path, 'c3d', Content(bodies=scaled), FileSettings())
    assert 'frame 4: the matrix of femur is not a rotation' in refused(path)


def test_tracking_of_autoscoper(tmp_path):
    """The matrices are written row by row; every frame has a row, which is NaN without a pose."""
    path = tmp_path / 'trial.tra'
    bodies = moving_bodies(None)
    written = registry.write(path, 'autoscoper', Content(bodies=bodies), FileSettings(units='mm'))
    assert 'row 1 is frame 4' in written.notes[0]
    rows = np.array([[float(cell) for cell in r.split(',')] for r in path.read_text().split()])
    assert rows.shape == (4, 32)
    assert np.isnan(rows[2]).all() and np.isnan(rows[1, 16:]).all()
    matrix = rows[3, 16:].reshape(4, 4)
    np.testing.assert_array_equal(matrix[:3, :3], bodies.rotation[2, 1])
    np.testing.assert_array_equal(matrix[:3, 3], bodies.translation_mm[2, 1])
    np.testing.assert_array_equal(matrix[3], [0, 0, 0, 1])
    assert 'only written' in refused(path)


POSES_BY_OPENSIM = """
import json, sys
import opensim
opensim.Logger.setLevelString('Off')
out = []
kinds = (opensim.TimeSeriesTableQuaternion, 4), (opensim.TimeSeriesTableVec3, 3)
for path, (kind, size) in zip(sys.argv[1:], kinds):
    table = kind(path)
    rows = [table.getRowAtIndex(t) for t in range(table.getNumRows())]
    out.append({
        'labels': list(table.getColumnLabels()),
        'times': list(table.getIndependentColumn()),
        'values': [
            [[row.getElt(0, b).get(k) for k in range(size)] for b in range(row.size())]
            for row in rows
        ],
    })
json.dump(out, sys.stdout)
"""


def by_opensim(script, folder, *paths):
    """Run a script with opensim and return what it writes as JSON."""
    if sys.version_info < (3, 11):
        pytest.skip('opensim has no wheel for Python 3.10')
    done = subprocess.run(
        [sys.executable, '-c', script, *paths],
        capture_output=True,
        text=True,
        check=True,
        cwd=folder,
    )
    return json.loads(done.stdout)


def test_poses_are_read_by_opensim(tmp_path):
    """Orientations, and positions in metres, are NaN in frame 6 and where a body has no pose."""
    bodies = moving_bodies()
    written = registry.write(
        tmp_path / 'poses.sto', 'opensim', Content(bodies=bodies), FileSettings()
    )
    assert [pathlib.Path(p).name for p in written.paths] == ['poses.sto', 'poses_positions.sto']
    turns, places = by_opensim(POSES_BY_OPENSIM, tmp_path, *written.paths)
    for table in (turns, places):
        assert table['labels'] == ['femur', 'tibia']
        np.testing.assert_allclose(table['times'], np.arange(4) / 250)
    rows = bodies.frame - 4
    wxyz = np.array(turns['values'])
    position = 1000 * np.array(places['values'])
    assert np.isnan(wxyz[2]).all() and np.isnan(position[2]).all()
    np.testing.assert_allclose(position[rows], bodies.translation_mm)
    assert (np.isnan(wxyz[rows]).any(axis=2) == np.isnan(position[rows]).any(axis=2)).all()
    known = np.isfinite(wxyz[rows]).all(axis=2)
    matrices = Rotation.from_quat(wxyz[rows][known][:, [1, 2, 3, 0]]).as_matrix()
    np.testing.assert_allclose(matrices, bodies.rotation[known], atol=1e-12)
    assert 'only written' in refused(tmp_path / 'poses.sto')


def joint_of_two(name, count=3):
    """Return the motion of a knee that is unknown in the second exposure."""
    angles = np.array([[0.5, -0.25, 7.0], [np.nan] * 3, [0.1, 0.2, 0.3]])
    return JointMotion(
        Joint(name, 'femur', 'tibia', 'grood_suntay_knee', side='left'),
        np.arange(count),
        np.arange(count) * 4_000_000 + 10**18,
        angles=angles,
        translations=10 * angles,
        covariance=np.zeros((count, 6, 6)),
        status=np.zeros(count, np.uint8),
        determined=np.isfinite(angles).all(axis=1),
    )


MOTION_BY_OPENSIM = """
import json, sys
import opensim
opensim.Logger.setLevelString('Off')
table = opensim.TimeSeriesTable(sys.argv[1])
storage = opensim.Storage(sys.argv[1])
vectors = [storage.getStateVector(t) for t in range(storage.getSize())]
json.dump({
    'in_degrees': table.getTableMetaDataString('inDegrees') == 'yes' and storage.isInDegrees(),
    'times': list(table.getIndependentColumn()),
    'columns': {
        name: table.getDependentColumn(name).to_numpy().tolist()
        for name in table.getColumnLabels()
    },
    'storage': [[v.getData().get(k) for k in range(v.getSize())] for v in vectors],
}, sys.stdout)
"""


def test_joint_motion_is_read_by_opensim(tmp_path):
    """Both of its readers are tested; an exposure with an unknown motion is omitted."""
    path = tmp_path / 'joints.mot'
    motions = [joint_of_two('knee_l'), joint_of_two('knee_r')]
    write_joint_motion(path, motions, 10**18)
    found = by_opensim(MOTION_BY_OPENSIM, tmp_path, path)
    known = [0, 2]
    assert found['in_degrees']
    np.testing.assert_allclose(found['times'], [0, 0.008])
    columns = {name: np.array(values) for name, values in found['columns'].items()}
    np.testing.assert_allclose(
        np.deg2rad(columns['knee_r_internal_rotation']), motions[1].angles[known, 2]
    )
    np.testing.assert_allclose(
        1000 * columns['knee_l_anterior_drawer'], motions[0].translations[known, 1]
    )
    np.testing.assert_allclose(found['storage'], np.column_stack(list(columns.values())))


def test_joint_motion_that_cannot_be_written_is_refused(tmp_path):
    path = tmp_path / 'joints.mot'
    unknown = dataclasses.replace(joint_of_two('knee'), angles=np.full((3, 3), np.nan))
    for motions, cause in (
        ([], 'one joint at least'),
        ([unknown], 'no exposure'),
        ([joint_of_two('a\tb')], 'tabulator'),
    ):
        with pytest.raises(DataError, match=cause):
            write_joint_motion(path, motions, 0)
    assert not path.exists()


POSE_HEADER = 'body,exposure,time_s,x_mm,y_mm,z_mm,qx,qy,qz,qw,status\n'


def test_poses_of_bodies_are_read(tmp_path):
    """Rows may have any order; a body may have no pose or no row in an exposure."""
    path = tmp_path / 'poses.csv'
    half = repr(0.5**0.5)
    path.write_text(
        POSE_HEADER
        + f'tibia,9,0.02,4,5,6,0,0,{half},{half},OK\n'
        + 'femur,5,0,1,2,3,0,0,0,1,OK\n'
        + 'tibia,5,0,,,,,,,,FAILED\n'
    )
    bodies = registry.read(path, FileSettings()).bodies
    assert (bodies.names, bodies.frame.tolist()) == (('tibia', 'femur'), [5, 9])
    assert bodies.rate_hz == 200
    assert np.isnan(bodies.rotation[0, 0]).all() and np.isnan(bodies.translation_mm[1, 1]).all()
    np.testing.assert_array_equal(bodies.rotation[0, 1], np.eye(3))
    turned = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]
    np.testing.assert_allclose(bodies.rotation[1, 0], turned, atol=1e-15)
    np.testing.assert_array_equal(
        bodies.translation_mm[:, ::-1][[0, 1], [0, 1]], [[1, 2, 3], [4, 5, 6]]
    )


@pytest.mark.parametrize(
    ('row', 'cause'),
    [
        ('femur,5,0,1,2,3,0,0,0,1,OK', 'row 3: exposure 5 of femur is already given in row 2'),
        ('femur,6,0,1,2,3,0,0,1,1,OK', 'row 3: the quaternion does not have length one'),
        ('femur,6,0,one,2,3,0,0,0,1,OK', "row 3: x_mm is 'one'"),
        ('femur,6,0,inf,2,3,0,0,0,1,OK', "row 3: x_mm is 'inf'"),
    ],
)
def test_wrong_poses_are_refused(tmp_path, row, cause):
    path = tmp_path / 'poses.csv'
    path.write_text(f'{POSE_HEADER}femur,5,0,1,2,3,0,0,0,1,OK\n{row}\n')
    assert cause in refused(path)


def test_file_without_an_image_point_is_refused(tmp_path):
    path = tmp_path / 'points.csv'
    path.write_text('bead_cam1_X,bead_cam1_Y,bead_cam2_X,bead_cam2_Y\nNaN,NaN,NaN,NaN\n')
    with pytest.raises(DataError, match=r'points\.csv: the file has no image points'):
        read_source(path, image_size=SIZE)


def test_rate_is_that_of_the_stamps_also_where_exposures_are_missing():
    assert rate_of(np.array([4, 5, 7]), np.array([0, 4, 12]) * 10**6) == pytest.approx(250)


# ---- lookup tables


def test_lookup_table_returns(tmp_path):
    """Every float32 is the same to the last bit; -1 is a pixel without support."""
    maps = np.random.default_rng(1).uniform(-3, 70, (2, 48, 64)).astype(np.float32)
    maps[:, 3, 5] = np.nan
    registry.write(tmp_path, 'lut', Content(lookups={'a': maps}), FileSettings())
    path = tmp_path / 'a_LUT.csv'
    rows = path.read_text().splitlines()
    assert len(rows) == 96 and rows[3].split(', ')[5] == rows[51].split(', ')[5] == '-1'
    np.testing.assert_array_equal(registry.read(path, FileSettings()).lookups['a'], maps)
    path.write_text('\n'.join(rows[:95]))
    assert '95 rows, but a lookup table has as many for the rows' in refused(path, FileSettings())


# ---- damage


def test_pipe_is_refused(tmp_path):
    """Reading a pipe would never end."""
    for name in ('points.csv', 'points.pho', 'points.dat'):
        os.mkfifo(tmp_path / name)
        assert 'this is a pipe, device or socket' in refused(tmp_path / name)
        with pytest.raises(DataError, match='this is a pipe'):
            read_source(tmp_path / name, image_size=SIZE)


@pytest.mark.parametrize('text', ['', '\n \n', ',,\n , \n'])
@pytest.mark.parametrize('separator', [None, ' ', ','])
def test_table_without_rows_is_refused(text, separator):
    if separator == ' ' and text.strip():
        return  # with spaces these are words
    with pytest.raises(DataError, match='no rows'):
        table_of('x.csv', text, separator)


@pytest.mark.parametrize(
    ('text', 'separator', 'cells'),
    [
        ('a;b\n1,5;2\n', None, [['a', 'b'], ['1.5', '2']]),
        ('\na\tb\n\n1\t2\n', None, [['a', 'b'], ['1', '2']]),
        ('a,b\n1.5,2\n', None, [['a', 'b'], ['1.5', '2']]),
        ('a  b\n1 2', ' ', [['a', 'b'], ['1', '2']]),
    ],
)
def test_separator_of_a_table_is_that_of_its_first_row(text, separator, cells):
    rows = table_of('x.csv', text, separator)
    assert [[str(cell) for cell in row.cells] for row in rows] == cells


@pytest.mark.filterwarnings('error')
@pytest.mark.parametrize(
    'kind', registry.kinds(lambda f: f.write and f.kind not in ('bag', 'c3d', 'lut'))
)
def test_damaged_files_are_refused_in_one_sentence(tmp_path, kind, forked):
    """They are truncated, or have missing, doubled or changed parts; only DataError is raised."""
    matrix = np.array([[4000.0, 0, 500], [0, 4000, 380], [0, 0, 1]])
    camera = Camera('cam1', matrix, SIZE, np.eye(3), np.zeros(3))
    bodies = Bodies(('f',), np.array([1]), np.eye(3)[None, None], np.ones((1, 1, 3)), 50.0)
    shifted = Camera('cam1', matrix, SIZE, np.eye(3), np.array([0.0, 0, 1000]))
    content = Content(
        observations={'cam1': frames(sigma=True)['cam1']},
        survey=phantom(),
        cameras=(shifted if kind == 'dlt' else camera,),
        stations=stations()[:2],
        points=points(),
        bodies=bodies,
        grids={'a': np.arange(8.0).reshape(2, 4)},
    )
    out = tmp_path / {'anipose': 'a.toml', 'trc': 'a.trc'}.get(kind, 'a.csv')
    written = registry.write(out, kind, content, SETTINGS)
    rng = np.random.default_rng(7)
    for path in map(pathlib.Path, written.paths):
        whole = path.read_bytes()
        for _ in range(1 if kind == 'sleap' else 8):  # reading sleap starts a process
            for damaged in _damaged(whole, rng):
                path.write_bytes(damaged)
                for as_kind in (None, kind):
                    try:
                        registry.read(path, SETTINGS, as_kind)
                    except DataError as error:
                        assert '\n' not in str(error)
        path.write_bytes(whole)


def _damaged(whole, rng):
    """Yield the content of a file, damaged in three ways."""
    yield whole[: rng.integers(len(whole))]
    content = bytearray(whole)
    for _ in range(3):
        content[rng.integers(len(whole))] = rng.integers(256)
    yield bytes(content)
    lines = whole.split(b'\n')
    lines[rng.integers(len(lines))] = lines[rng.integers(len(lines))]
    yield b'\n'.join(lines)


MARKED = {'#1': 1, '-a': 2, '=b': 3, "'c": 4, 'd': 5}  # a comment, formulas, an apostrophe


@pytest.mark.parametrize('kind', ['phantom', 'points', 'observations', 'xmalab2d', 'xmalab3d'])
def test_names_that_begin_with_a_mark_return(tmp_path, kind):
    """A row that begins with # is a comment, a cell with = a formula; a name may begin so."""
    ids = np.array(list(MARKED.values()))
    xyz = np.random.default_rng(1).uniform(-50, 50, (2, 5, 3))
    content = Content(
        observations={'cam1': [Frame('cam1', 1, ids, 500 + xyz[0, :, :2], SIZE)]},
        survey=Phantom(ids, xyz[0], np.full(5, 0.1)),
        points=points_without_precision(np.array([1, 2]), ids, xyz, 10.0),
        names=Names(MARKED),
    )
    registry.write(tmp_path / 'out.csv', kind, content, SETTINGS)
    found = registry.read(tmp_path / 'out.csv', SETTINGS)
    assert found.names.targets == MARKED
    if kind == 'phantom':
        assert np.array_equal(found.survey.xyz_mm, xyz[0])


@pytest.mark.parametrize(
    ('kind', 'name', 'cause'),
    [
        ('xmalab2d', 'a,b', 'a comma'),
        ('xmalab3d', 'a,b', 'a comma'),
        ('xmalab3d', 'a\nb', 'a line end'),
        ('trc', 'a\tb', 'a tabulator'),
        ('deeplabcut', 'a\rb', 'a line end'),
        ('deeplabcut', '\na', 'a line end'),
    ],
)
def test_names_that_would_be_two_cells_are_not_written(tmp_path, kind, name, cause):
    ids = np.array([1, 2, 3, 4])
    xyz = np.random.default_rng(1).uniform(0, 50, (1, 4, 3))
    content = Content(
        observations={'cam1': [Frame('cam1', 1, ids, xyz[0, :, :2], SIZE)]},
        points=points_without_precision(np.array([1]), ids, xyz, 10.0),
        names=Names({name: 1}),
    )
    with pytest.raises(DataError, match=cause):
        registry.write(tmp_path / 'out', kind, content, SETTINGS)
    assert not [path for path in tmp_path.rglob('*') if path.is_file()]


POSE_ROWS = (
    'body,exposure,time_s,x_mm,y_mm,z_mm,qx,qy,qz,qw',
    'tibia,1,0.0,1.5,2.5,3.5,0.0,0.0,0.0,1.0',
    'tibia,2,0.1,1.5,2.5,4.5,0.0,0.0,0.0,1.0',
)


@pytest.mark.parametrize(
    'rewritten',
    [
        lambda text: text.replace(',', ';').replace('.', ','),  # as spreadsheets save it
        lambda text: text.replace('body', '"body"').replace('time_s', '"time_s"'),
        lambda text: '# walking\n' + text,
        lambda text: text.replace(',', ', '),
    ],
)
def test_poses_are_recognised_however_they_were_saved(tmp_path, rewritten):
    path = tmp_path / 'poses.csv'
    path.write_text(rewritten('\n'.join(POSE_ROWS) + '\n'))
    bodies = registry.read(path, SETTINGS).bodies
    assert bodies.names == ('tibia',) and bodies.rate_hz == 10
    assert bodies.translation_mm[:, 0].tolist() == [[1.5, 2.5, 3.5], [1.5, 2.5, 4.5]]


def test_coordinates_that_are_not_finite_are_refused(tmp_path):
    """Other programs, and this one, do not read a file with them."""
    path = tmp_path / 'points.csv'
    path.write_text('frame,target_id,x,y,z\n1,1,1,2,3\n2,1,inf,2,3\n')
    with pytest.raises(DataError, match="row 3: x is 'inf', not a finite number"):
        registry.read(path, SETTINGS)
