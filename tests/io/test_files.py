# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Files: round trips are exact, and every fault is reported in one sentence."""

import json
import os
import time
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rigs import create_model, write_frame

from fluoro_calib_ros.correction.angle_field import AngleField, packed_angles
from fluoro_calib_ros.correction.calibration_record import FIELDS
from fluoro_calib_ros.correction.fluoroscope_calibration import (
    FluoroscopeCalibration,
    NoiseProfile,
)
from fluoro_calib_ros.correction.registry import no_correction
from fluoro_calib_ros.errors import DataError
from fluoro_calib_ros.exposures.frame import Frame
from fluoro_calib_ros.exposures.names import Names
from fluoro_calib_ros.exposures.phantom import Phantom
from fluoro_calib_ros.io import csv_table
from fluoro_calib_ros.io.access import atomic_file, write_bytes, write_text
from fluoro_calib_ros.io.bags.writer import BagWriter
from fluoro_calib_ros.io.calibration import (
    load_calibration,
    load_calibrations,
    load_orientation,
    save_calibration,
    save_orientation,
)
from fluoro_calib_ros.io.documents import read_json, write_json
from fluoro_calib_ros.io.folder import FolderKind, replaced_folder
from fluoro_calib_ros.io.formats import registry
from fluoro_calib_ros.io.formats.content import FileSettings
from fluoro_calib_ros.io.observations import (
    correct_points,
    read_named_observations,
    read_observations_csv,
    read_points,
    write_observations_csv,
    write_points,
)
from fluoro_calib_ros.io.phantom import read_phantom, write_phantom
from fluoro_calib_ros.jobs.sources import read_content, read_source
from fluoro_calib_ros.photogrammetry.rig_orientation import RigOrientation

SIZE = (1024, 960)
CALIBRATED = (256, 240)  # size of the images of some_calibration, small for a small lookup grid
OBSERVATIONS = 'fluoroscope,exposure,target_id,u,v,sigma\n'


def text_file(folder, name, text):
    path = folder / name
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return str(path)


def message_of(function, *arguments):
    """Return the sentence of the DataError that a call raises."""
    with pytest.raises(DataError) as caught:
        function(*arguments)
    text = str(caught.value)
    assert text and '\n' not in text and 'Traceback' not in text
    return text


def some_phantom(n=12):
    rng = np.random.default_rng(3)
    return Phantom(rng.permutation(500)[:n], rng.normal(0, 50, (n, 3)), rng.uniform(0.01, 0.1, n))


def some_frames(exposures=5, targets=9):
    rng = np.random.default_rng(4)
    return {
        name: [
            Frame(
                name,
                number,
                rng.permutation(503)[:targets],
                rng.uniform(0, 900, (targets, 2)),
                SIZE,
                rng.uniform(0.1, 1, targets) if number % 2 else None,
            )
            for number in range(exposures)
        ]
        for name in 'ab'
    }


def some_calibration(name='a', n=400, **changes):
    rng = np.random.default_rng(5)
    uv = rng.uniform(12, 225, (n, 2))
    model = (
        create_model('local_linear', 20, uv, np.sin(uv / 200) * 5, 0.08, 0.01)
        if n
        else no_correction()
    )
    values = dict(
        fluoroscope=name,
        image_size=CALIBRATED,
        interior=np.array([127.1, 120.2, 500.3]),
        interior_covariance=np.diag([1.0, 2.0, 3.0]),
        interior_estimated=True,
        model=model,
        train_exposure=rng.integers(0, 15, n),
        image_sd=0.27,
        sigma0=0.25,
        nu=4.5,
        exposures=15,
        observations=n + 9,
        inliers=n,
        rmse_before=np.array([5.0, 6.0]),
        rmse_after=np.array([0.25, 0.26]),
        cost_adjustment=-12.5,
        cost_regression=99.0,
        iterations=7,
        converged=True,
        stamp_ns=1_700_000_000_123_456_789,
        frame_id=f'{name}_optical',
        source_digest='0f' * 32,
        seconds=3.25,
    )
    return FluoroscopeCalibration(**{**values, **changes})


# ---------------------------------------------------------------- every reader, and files of
# other kinds

READERS = {
    'phantom': read_phantom,
    'observations': lambda path: read_observations_csv(path, SIZE),
    'calibration': load_calibration,
    'points': read_points,
    'result': read_json,
}


@pytest.mark.parametrize('read', READERS.values(), ids=READERS)
def test_unreadable_files_are_reported_by_name(read, tmp_path):
    assert 'no such file' in message_of(read, str(tmp_path / 'missing'))
    assert 'folder' in message_of(read, str(tmp_path))
    assert 'empty' in message_of(read, text_file(tmp_path, 'empty', ''))
    for content in (
        b'\x89PNG\r\n\x1a\n\x00\x00',
        b'\xff\xfeu\x00,\x00v\x00',
        b'\x00' * 100,
        b'PK\x03\x04' + b'x' * 50,
        b'hello\n',
        b'\n\n\n',
        b'"',
        b'a,b\n"c,d\n',
        b'[1]',
    ):
        path = text_file(tmp_path, 'damaged', content)
        assert path in message_of(read, path)


@pytest.mark.parametrize('read', READERS.values(), ids=READERS)
def test_file_without_permission_is_reported_by_name(read, tmp_path, monkeypatch):
    def refuse(*_, **__):
        raise PermissionError(
            13, 'Permission denied'
        )  # a mock, as root in containers may read everything

    monkeypatch.setattr('builtins.open', refuse)
    assert 'secret: cannot be read (permission denied)' in message_of(
        read, str(tmp_path / 'secret')
    )


# ---------------------------------------------------------------- atomic writing


def test_exception_leaves_only_the_old_file(tmp_path):
    path = tmp_path / 'result.json'
    write_text(path, 'old')
    with pytest.raises(RuntimeError), atomic_file(path, 'w') as file:
        file.write('half of the new')
        raise RuntimeError
    assert path.read_text() == 'old'
    assert os.listdir(tmp_path) == ['result.json']


def test_impossible_write_is_reported(tmp_path):
    said = message_of(write_bytes, tmp_path / 'no' / 'file', b'x')
    assert said.endswith(f'cannot be written, there is no folder {tmp_path / "no"}')
    (tmp_path / 'folder').mkdir()
    assert 'directory' in message_of(write_bytes, tmp_path / 'folder', b'x')
    assert os.listdir(tmp_path) == ['folder']


def test_symbolic_link_is_kept_and_permissions_follow_the_umask(tmp_path):
    write_bytes(tmp_path / 'file', b'old')
    (tmp_path / 'link').symlink_to(tmp_path / 'file')
    write_bytes(tmp_path / 'link', b'new')
    assert (tmp_path / 'link').is_symlink() and (tmp_path / 'file').read_bytes() == b'new'
    umask = os.umask(0)
    os.umask(umask)
    assert os.stat(tmp_path / 'file').st_mode & 0o777 == 0o666 & ~umask


# ---------------------------------------------------------------- phantom


def test_phantom_round_trip(tmp_path):
    phantom = some_phantom()
    write_phantom(tmp_path / 'phantom.csv', phantom)
    again = read_phantom(str(tmp_path / 'phantom.csv'))
    for name in ('target_id', 'xyz_mm', 'sd_mm'):
        assert np.array_equal(getattr(again, name), getattr(phantom, name))
    assert (tmp_path / 'phantom.csv').read_text().startswith('target_id,x,y,z,sd\n')


def test_phantom_exported_from_a_spreadsheet(tmp_path):
    text = '\ufeff# surveyed 2020\r\n\r\nz, sd ,target_id,x,y,remark\r\n' + ''.join(
        f'3.5,0.1,{i}, 1e1 ,-2,"bead, no. {i}"\r\n# comment\r\n' for i in (4, 2, 9, 7)
    )
    phantom = read_phantom(text_file(tmp_path, 'phantom.csv', text))
    assert phantom.target_id.tolist() == [2, 4, 7, 9]
    assert phantom.xyz_mm.tolist() == [[10, -2, 3.5]] * 4


@pytest.mark.parametrize(
    'row, sentence',
    [
        ('5,1,abc,3,0.1', "row 6: y is 'abc', not a number"),
        ('5,1,,3,0.1', "row 6: y is '', not a number"),
        ('5,1,nan,3,0.1', "row 6: y is 'nan', not a finite number"),
        ('5,1,2,inf,0.1', "row 6: z is 'inf', not a finite number"),
        ('5,1,1_0,3,0.1', "row 6: y is '1_0', not a number"),
        ('5.5,1,2,3,0.1', "row 6: target_id is '5.5', not an integer"),
        ('5.,1,2,3,0.1', "row 6: target_id is '5.', not an integer"),
        ('3.0,1,2,3,0.1', 'row 6: target 3 is already given in row 5'),
        ('5,1,"2,5",3,0.1', "row 6: y is '2,5', not a number: it has a decimal comma; write"),
        ('-5,1,2,3,0.1', "row 6: target_id is '-5', not between 0 and 4294967295"),
        ('99999999999999999999,1,2,3,0.1', 'not between 0 and 4294967295'),
        ('5,1,2,3,0', "row 6: sd is '0', not above 0"),
        ('3,1,2,3,0.1', 'row 6: target 3 is already given in row 5'),
        ('5,1,2,3', 'row 6: 4 columns, but the header has 5'),
        ('5,1,2,3,0.1,7', 'row 6: 6 columns, but the header has 5'),
        ('5,1,"2,3,0.1', 'row 6: this is not CSV'),
        ('5,1,2,3,\x00', 'row 6: '),
    ],
)
def test_phantom_errors_name_row_and_cause(tmp_path, row, sentence):
    good = ''.join(f'{i},1,2,3,0.1\n' for i in range(4))
    path = text_file(tmp_path, 'phantom.csv', f'target_id,x,y,z,sd\n{good}{row}\n')
    assert message_of(read_phantom, path).startswith(path) and sentence in message_of(
        read_phantom, path
    )


def test_phantom_header_encoding_and_number_of_targets(tmp_path):
    def said(text):
        return message_of(read_phantom, text_file(tmp_path, 'phantom.csv', text))

    assert 'row 1: the header has no column sd' in said('target_id,x,y,z\n1,2,3,4\n')
    assert 'row 1: the header lacks the columns x, y, z; target_id,' in said('target_id,sd\n1,2\n')
    assert 'the column x twice' in said('target_id,x,y,z,sd,x\n1,2,3,4,5,6\n')
    assert 'no rows' in said('target_id,x,y,z,sd\n')
    assert 'at least 4' in said('target_id,x,y,z,sd\n1,2,3,4,5\n')
    assert 'row 3: this is not UTF-8 text (byte 0xe4)' in said(
        b'target_id,x,y,z,sd\n1,2,3,4,5\n\xe4'
    )


PHANTOM = 'target_id,x,y,z,sd\n' + ''.join(f'{i},{i},2,{i * i},.1\n' for i in range(1, 6))


@pytest.mark.parametrize('encoding', ['utf-8-sig', 'utf-16'])  # as spreadsheets save text
def test_encodings_of_spreadsheets_are_read(tmp_path, encoding):
    path = text_file(tmp_path, 'phantom.csv', PHANTOM.encode(encoding))
    assert read_phantom(path).target_id.tolist() == [1, 2, 3, 4, 5]
    assert registry.recognised(path).kind == 'phantom'


@pytest.mark.parametrize(
    'start, remedy',
    [
        (b'PK\x03\x04\x14\0', 'xlsx spreadsheet or another zip archive; save the table as CSV'),
        (b'\xd0\xcf\x11\xe0\xa1', 'xls spreadsheet; save the table as CSV'),
    ],
)
def test_tables_that_are_no_text_are_named(tmp_path, start, remedy):
    path = text_file(tmp_path, 'points.table', start + bytes(range(256)))
    assert remedy in message_of(read_phantom, path)
    settings = FileSettings(image_size=(100, 100))
    assert remedy in message_of(lambda p: registry.read(p, settings), path)


@pytest.mark.parametrize(
    'text, remedy',
    [
        ('NO_OF_FRAMES\t3\nNO_OF_CAMERAS\t13\nNO_OF_MARKERS\t2\n', 'as C3D, which is read'),
        ('FILE_VERSION\t2.0.0\nNO_OF_FRAMES\t3\n', 'as C3D, which is read'),
        ('\n\nTrajectories\n100\n,,Mouse:foot,,\n', 'the C3D file of the trial, which is read'),
        ('Sparse format camera coordinates file\n9\t4\t8\n1\t1\t5.5\n', 'in flat format, as CSV'),
    ],
)
@pytest.mark.parametrize('name', ['points.tsv', 'points.csv'])
def test_texts_of_other_programs_that_are_not_read_are_named(tmp_path, text, remedy, name):
    """The message says what to do, for Qualisys Track Manager, Vicon Nexus and DLTdv8."""
    path = text_file(tmp_path, name, text)
    settings = FileSettings(image_size=(100, 100))
    for part, default in (('survey', 'phantom'), ('observations', 'observations')):
        message = message_of(lambda p, *a: read_content(p, settings, *a), path, part, default)
        assert message.endswith(remedy)


def test_hdf5_that_is_no_table_is_named(tmp_path):
    path = text_file(tmp_path, 'points.h5', b'\x89HDF\r\n\x1a\n' + bytes(range(256)))
    assert 'HDF5 file; of these, files of DeepLabCut and analysis' in message_of(
        read_phantom, path
    )
    settings = FileSettings(image_size=(100, 100))
    assert 'this HDF5 file cannot be' in message_of(lambda p: registry.read(p, settings), path)


def test_row_numbers_count_line_ends_inside_cells(tmp_path):
    text = 'target_id,x,y,z,sd,note\n1,2,3,4,5,"two\nlines"\n2,2,3,4,5,\n\n3,2,3,x,5,\n'
    assert "row 6: z is 'x'" in message_of(read_phantom, text_file(tmp_path, 'phantom.csv', text))


# ---------------------------------------------------------------- observations


def test_observations_round_trip(tmp_path):
    frames = some_frames()
    write_observations_csv(tmp_path / 'o.csv', frames)
    again = read_observations_csv(str(tmp_path / 'o.csv'), SIZE)
    assert list(again) == ['a', 'b']
    for name in frames:
        for one, two in zip(frames[name], again[name], strict=True):
            assert (one.number, one.image_size) == (two.number, two.image_size)
            assert np.array_equal(one.target_id, two.target_id) and np.array_equal(one.uv, two.uv)
            assert (one.sigma is None and two.sigma is None) or np.array_equal(
                one.sigma, two.sigma
            )
    write_observations_csv(tmp_path / 'again.csv', again)
    assert (tmp_path / 'again.csv').read_bytes() == (tmp_path / 'o.csv').read_bytes()


def test_angles_of_exposures_are_kept_to_the_bit(tmp_path):
    frames = some_frames()
    frames['a'] = [replace(f, angle=0.1 + f.number) for f in frames['a']]
    write_observations_csv(tmp_path / 'o.csv', frames)
    again = read_observations_csv(str(tmp_path / 'o.csv'), SIZE)
    assert [f.angle for f in again['a']] == [f.angle for f in frames['a']]
    assert [f.angle for f in again['b']] == [None] * len(frames['b'])
    assert again['a'][0].angle == pytest.approx(0.1 + frames['a'][0].number, abs=1e-7)


def test_observations_in_any_order_of_rows_and_columns(tmp_path):
    path = text_file(
        tmp_path,
        'o.csv',
        'v,u,extra,exposure,fluoroscope,target_id\n'
        '1,10,x,7,b,3\n2,20,x,7,a,3\n3,30,x,2,b,5\n4,40,x,7,b,1\n',
    )
    frames = read_observations_csv(path, SIZE)
    assert list(frames) == ['a', 'b'] and [f.number for f in frames['b']] == [2, 7]
    last = frames['b'][1]
    assert (
        last.target_id.tolist() == [3, 1]
        and last.uv.tolist() == [[10, 1], [40, 4]]
        and last.sigma is None
    )


@pytest.mark.parametrize('known', [None, Names()])
def test_whole_numbers_that_are_written_as_floats_are_read(tmp_path, known):
    """As pandas writes a column in which a value was missing."""
    path = text_file(tmp_path, 'o.csv', OBSERVATIONS + 'a,1.0,7.0,1,2,\na,10.00,7,1,2,\n')
    if known is None:
        frames = read_observations_csv(path, SIZE)
    else:
        frames, names, *_ = read_named_observations(path, lambda _: SIZE, known)
        assert not names
    assert [(f.number, f.target_id.tolist()) for f in frames['a']] == [(1, [7]), (10, [7])]


def test_observations_require_the_image_size(tmp_path):
    path = text_file(tmp_path, 'o.csv', OBSERVATIONS + 'a,0,1,2,3,\n')
    assert '--image-size' in message_of(read_source, path)


@pytest.mark.parametrize(
    'row, sentence',
    [
        ('a,0,3,abc,2,', "row 4: u is 'abc', not a number"),
        ('a,0,3,nan,2,', "row 4: u is 'nan', not a finite number: remove the rows of targets"),
        ('a,0,3,1,,', "row 4: v is '', not a number: remove the rows of targets that are not"),
        ('a,1.5,3,1,2,', "row 4: exposure is '1.5', not an integer"),
        ('a,0,3,1,-inf,', "row 4: v is '-inf', not a finite number"),
        ('a,x,3,1,2,', "row 4: exposure is 'x', not an integer"),
        ('a,0,3,1024,2,', 'row 4: the point (1024, 2) is outside the image of 1024 x 960 px'),
        ('a,0,1,1,2,', 'row 4: target 1 of fluoroscope a, exposure 0 is already given in row 2'),
        ('a,0,3,1,2,0.5', 'sigma of target 1 of fluoroscope a, exposure 0 is empty'),
        ('a,1,3,1,2,0', "row 4: sigma is '0', not a finite number above 0"),
        ('a,1,3,1,2,nan', "row 4: sigma is 'nan', not a finite number above 0"),
        ('../a,0,3,1,2,', "row 4: the fluoroscope is called '../a'"),
        (',0,3,1,2,', "row 4: the fluoroscope is called ''"),
        ('a,0,3,1,2,,9000', "row 4: angle_deg is '9000', not an angle"),
        ('a,0,3,1,2,,x', "row 4: angle_deg is 'x', not a number"),
        ('a,0,3,1,2,,12', 'angle_deg of fluoroscope a, exposure 0 is 12, but nan in row 2'),
    ],
)
def test_observation_errors_name_row_and_cause(tmp_path, row, sentence):
    header = OBSERVATIONS
    rows = f'a,0,1,1,2,\nb,0,2,1,2,\n{row}\n'
    if row.count(',') == OBSERVATIONS.count(',') + 1:
        header = OBSERVATIONS.replace('\n', ',angle_deg\n')
        rows = rows.replace(',1,2,\n', ',1,2,,\n')
    path = text_file(tmp_path, 'o.csv', header + rows)
    said = message_of(read_observations_csv, path, SIZE)
    assert said.startswith(path) and sentence in said


@pytest.mark.parametrize('off', [0, 1, 5, 6])
def test_up_to_a_twentieth_of_the_points_may_be_off_the_image(tmp_path, off):
    """Of 100 points, the first is named and the others are counted."""
    rows = [f'a,{i // 50},{i % 50},{2000 if 20 <= i < 20 + off else 7},1,\n' for i in range(100)]
    path = text_file(tmp_path, 'o.csv', OBSERVATIONS + ''.join(rows))
    if off == 6:
        assert 'row 22: ' in message_of(read_named_observations, path, lambda _: SIZE, Names())
        return
    frames, _, said, _ = read_named_observations(path, lambda _: SIZE, Names())
    left = np.concatenate([frame.target_id for frame in frames['a']])
    assert left.tolist() == [i % 50 for i in range(100) if not 20 <= i < 20 + off]
    assert ('row 22: ' in said, ', and 4 more' in said) == (off > 0, off == 5)
    assert ' more' not in said or off == 5


def test_row_number_is_exact_in_a_large_file(tmp_path, monkeypatch):
    monkeypatch.setattr(csv_table, 'BLOCK', 1000)
    rows = [f'a,{i // 100},{i % 100},{i % 900}.5,1,\n' for i in range(6000)]
    rows[5432] = 'a,1,1,1.5.2,1,\n'
    said = message_of(
        read_observations_csv, text_file(tmp_path, 'o.csv', OBSERVATIONS + ''.join(rows)), SIZE
    )
    assert "row 5434: u is '1.5.2'" in said


def test_large_file_is_read_block_by_block(tmp_path, monkeypatch):
    """The file has several blocks, and exposures that cross their borders."""
    monkeypatch.setattr(csv_table, 'BLOCK', 1000)
    frames = some_frames(13, 140)
    write_observations_csv(tmp_path / 'o.csv', frames)
    found = read_observations_csv(str(tmp_path / 'o.csv'), SIZE)
    for name, expected in frames.items():
        assert [f.number for f in found[name]] == [f.number for f in expected]
        for one, other in zip(found[name], expected):
            np.testing.assert_array_equal(one.sorted().uv, other.sorted().uv)


# ---------------------------------------------------------------- calibration


@pytest.mark.parametrize(
    'calibration',
    [
        some_calibration(),
        some_calibration(nu=np.inf),
        some_calibration('b-2_c', n=0, rmse_after=[np.nan, np.nan]),
        some_calibration(
            frame_id='', interior_covariance=np.zeros((3, 3)), interior_estimated=False
        ),
    ],
    ids=['usual', 'gaussian', 'no model', 'held'],
)
def test_calibration_round_trip_is_exact(tmp_path, calibration):
    path = save_calibration(tmp_path / 'new' / 'folder', calibration)
    again = load_calibration(path)
    assert path == str(tmp_path / 'new' / 'folder' / f'{calibration.fluoroscope}.calibration.npz')
    assert again.calibration_id == calibration.calibration_id and np.isnan(again.seconds)
    for name in set(FluoroscopeCalibration.__dataclass_fields__) - {'model', 'seconds'}:
        one = getattr(calibration, name)
        two = getattr(again, name)
        assert np.array_equal(one, two, equal_nan=isinstance(one, (list, np.ndarray))), name
    pixels = np.random.default_rng(1).uniform(-20, 1000, (2000, 2))
    one = calibration.correct(pixels)
    two = again.correct(pixels)
    for name in ('uv', 'sigma', 'status'):
        assert getattr(one, name).tobytes() == getattr(two, name).tobytes()


def some_angle_field():
    rng = np.random.default_rng(4)
    grids = rng.uniform(0, 0.01, (14, 33, 33))
    return AngleField(CALIBRATED, np.linspace(-1, 1, 9), rng.normal(0, 1, (4, 2, 10)), grids)


def test_calibration_that_changes_with_an_angle_is_kept_to_the_bit(tmp_path):
    calibration = some_calibration(angle_field=some_angle_field())
    assert calibration.calibration_id != some_calibration().calibration_id
    again = load_calibration(save_calibration(tmp_path, calibration))
    assert again.calibration_id == calibration.calibration_id
    for one, two in zip(
        packed_angles(calibration.angle_field), packed_angles(again.angle_field), strict=True
    ):
        assert one.tobytes() == two.tobytes()
    pixels = np.random.default_rng(1).uniform(0, 1000, (50, 2))
    one, two = (c.correct(pixels, angle=0.3) for c in (calibration, again))
    assert one.uv.tobytes() == two.uv.tobytes()


def test_same_calibration_gives_the_same_bytes(tmp_path, monkeypatch):
    first = Path(save_calibration(tmp_path / '1', some_calibration())).read_bytes()
    monkeypatch.setattr(time, 'time', lambda: 2_000_000_000.0)
    monkeypatch.setattr(time, 'localtime', lambda *_: time.gmtime(2_000_000_000))
    second = Path(save_calibration(tmp_path / '2', some_calibration(seconds=99.0))).read_bytes()
    again = load_calibration(tmp_path / '1' / 'a.calibration.npz')
    third = Path(save_calibration(tmp_path / '3', again)).read_bytes()
    assert first == second == third


def test_numpy_reads_the_file_without_pickle_and_every_array_is_documented(tmp_path):
    with np.load(save_calibration(tmp_path, some_calibration()), allow_pickle=False) as file:
        assert file.files == ['format_version', *(field.name for field in FIELDS)]
        assert file['format_version'] == 4
        docs = Path(__file__).parents[2] / 'docs'
        document = (docs / 'files.md').read_text()
        for name in file.files:
            dtype = 'text' if file[name].dtype.kind == 'U' else file[name].dtype.name
            assert f'| `{name}` | {dtype} |' in document


def changed(tmp_path, **arrays):
    """Return the path of a calibration file in which some arrays are replaced, or removed if they
    are None.
    """
    with np.load(save_calibration(tmp_path, some_calibration()), allow_pickle=False) as file:
        arrays = {**{name: file[name] for name in file.files}, **arrays}
    path = str(tmp_path / 'a.calibration.npz')
    np.savez(path, **{name: array for name, array in arrays.items() if array is not None})
    return path


ARRAYS_OF_VERSION = {
    2: ('series_degree', 'series_modes', 'series_coefficients', 'series_sd'),
    3: ('angles', 'angle_coefficients', 'angle_variances'),
    4: ('noise_profile',),
}


@pytest.mark.parametrize('version', [1, 2, 3])
def test_calibration_of_an_earlier_layout_is_read(tmp_path, version):
    later = [name for v, names in ARRAYS_OF_VERSION.items() if v > version for name in names]
    path = changed(tmp_path, format_version=np.array(version), **dict.fromkeys(later))
    assert load_calibration(path).calibration_id == some_calibration().calibration_id


def test_noise_profile_is_read_to_the_last_bit(tmp_path):
    calibration = some_calibration(noise_profile=NoiseProfile(0.81, 1.37, 1.13))
    found = load_calibration(save_calibration(tmp_path, calibration))
    assert found.noise_profile == calibration.noise_profile
    uv = np.array([[125.0, 125.0], [25.0, 225.0], [np.nan, 3.0]])
    sigma = found.correct(uv).sigma
    assert np.array_equal(sigma, calibration.correct(uv).sigma, equal_nan=True)
    alone = [found.correct(uv[:2], [1e-9, 1e-9]).sigma, found.image_sd_at(uv[:2])]
    np.testing.assert_allclose(sigma[:2], np.hypot(*alone), rtol=1e-9)
    assert sigma[1] > sigma[0]


class Bomb:
    def __reduce__(self):
        return os.mkdir, ('/tmp/this_must_never_be_made',)


@pytest.mark.parametrize(
    'arrays, sentence',
    [
        ({'format_version': np.array(7)}, 'layout version 7, this program reads versions 1 to 4'),
        ({'noise_profile': np.array([1.0, 1e3, 1.0])}, 'factors that no image has'),
        ({'noise_profile': np.array([1.0, 2.0])}, 'its noise profile has 2 values'),
        ({'format_version': np.array('1')}, 'format_version is not an integer'),
        ({'format_version': None}, 'it has no array format_version'),
        ({'interior': None}, 'has no array interior'),
        ({'interior': np.zeros(4)}, 'the array interior has shape (4,), not (3)'),
        ({'interior': np.zeros(3, dtype=np.float32)}, 'has dtype float32, not float64'),
        ({'interior': np.array([1, np.nan, 3])}, 'the array interior holds nan'),
        ({'train_uv': np.zeros((400, 3))}, 'the array train_uv has shape (400, 3), not (N, 2)'),
        ({'train_uv': np.zeros((399, 2))}, 'the training arrays differ in length'),
        ({'train_duv': np.full((400, 2), np.inf)}, 'the array train_duv holds inf'),
        ({'nu': np.array(np.nan)}, 'the array nu holds nan'),
        ({'sigma0': np.array(-1.0)}, 'the array sigma0 holds -1.0, which is below 0'),
        ({'model_kind': np.array('magic')}, "not 'magic'"),
        ({'model_k': np.array(401)}, 'k = 401'),
        ({'fluoroscope': np.array('../../etc')}, "called '../../etc'"),
        ({'fluoroscope': np.array('b')}, 'does not belong to its calibration_id'),
        ({'interior': np.array([1.0, 2.0, 3.0])}, 'does not belong to its calibration_id'),
        (
            {'interior': np.array([Bomb()] * 3, dtype=object)},
            'the array interior does not contain plain numbers',
        ),
        ({'format_version': np.array(Bomb(), dtype=object)}, 'does not contain plain numbers'),
    ],
)
def test_invalid_calibration_is_refused(tmp_path, arrays, sentence):
    path = changed(tmp_path, **arrays)
    said = message_of(load_calibration, path)
    assert said.startswith(path) and sentence in said
    assert not os.path.exists('/tmp/this_must_never_be_made')


def test_calibration_of_an_earlier_version_gets_the_id_of_its_content(tmp_path):
    """So does the orientation next to it, which names the calibrations that it belongs to."""
    found = some_calibration()
    earlier = found.earlier_id
    assert (
        load_calibration(changed(tmp_path, calibration_id=np.array(earlier))).calibration_id
        == found.calibration_id
    )
    orientation = RigOrientation(
        ('a',),
        found.interior[None],
        np.eye(3)[None],
        np.zeros((1, 3)),
        np.eye(9),
        'phantom',
        'joint calibration',
        (earlier,),
    )
    saved = load_orientation(save_orientation(tmp_path, orientation))
    assert saved.calibration_ids == (found.calibration_id,)
    details = changed(tmp_path, calibration_id=np.array(earlier), converged=np.array(False))
    assert load_calibration(details).calibration_id not in (earlier, found.calibration_id)


def test_truncated_or_damaged_calibration_is_refused(tmp_path):
    path = save_calibration(tmp_path, some_calibration())
    content = Path(path).read_bytes()
    good = load_calibration(path)
    for length in (1, 10, 200, len(content) // 2, len(content) - 100, len(content) - 1):
        assert path in message_of(
            load_calibration, text_file(tmp_path, 'a.calibration.npz', content[:length])
        )
    directory = bytearray(
        content
    )  # the end claims another offset: the members would begin before the file
    directory[-6:-2] = (int.from_bytes(content[-6:-2], 'little') + 999).to_bytes(4, 'little')
    assert 'or it is damaged' in message_of(
        load_calibration, text_file(tmp_path, 'a.calibration.npz', bytes(directory))
    )
    for place in np.linspace(0, len(content) - 1, 300).astype(int):
        damaged = bytearray(content)
        damaged[place] ^= 0x55
        text_file(tmp_path, 'a.calibration.npz', bytes(damaged))
        try:
            again = load_calibration(path)  # the byte may have no meaning, as in a date
        except DataError:
            continue
        assert again.calibration_id == good.calibration_id
        assert (
            np.array_equal(again.train_exposure, good.train_exposure)
            and again.stamp_ns == good.stamp_ns
        )


def test_other_archive_is_refused(tmp_path):
    path = str(tmp_path / 'x.npz')
    with zipfile.ZipFile(path, 'w') as archive:
        archive.writestr('readme.txt', 'hello')
    assert 'not a calibration file' in message_of(load_calibration, path)


def test_calibration_that_could_not_be_read_is_not_written(tmp_path):
    save_calibration(tmp_path, some_calibration())
    before = (tmp_path / 'a.calibration.npz').read_bytes()
    assert 'interior' in message_of(
        save_calibration, tmp_path, some_calibration(interior=np.array([1, 2, np.nan]))
    )
    assert 'differ in length' in message_of(
        save_calibration, tmp_path, some_calibration(train_exposure=np.arange(3))
    )
    assert "'../a'" in message_of(save_calibration, tmp_path, some_calibration('../a'))
    assert os.listdir(tmp_path) == ['a.calibration.npz']
    assert (tmp_path / 'a.calibration.npz').read_bytes() == before


def test_load_all_calibrations_of_a_folder(tmp_path):
    assert 'no calibration in this folder' in message_of(load_calibrations, str(tmp_path))
    assert 'no such folder' in message_of(load_calibrations, str(tmp_path / 'missing'))
    for name in ('b', 'a'):
        save_calibration(tmp_path, some_calibration(name))
    text_file(tmp_path, 'result.json', '{}')
    assert 'a file, not a folder' in message_of(load_calibrations, str(tmp_path / 'result.json'))
    assert list(load_calibrations(tmp_path)) == ['a', 'b']
    os.rename(tmp_path / 'a.calibration.npz', tmp_path / 'c.calibration.npz')
    assert 'calibration of fluoroscope a' in message_of(load_calibrations, tmp_path)


# ---------------------------------------------------------------- image points


def corrected_rows(tmp_path, text, calibrations):
    points = read_points(text_file(tmp_path, 'p.csv', text))
    write_points(tmp_path / 'out.csv', points, correct_points(points, calibrations))
    return [row.split(',') for row in (tmp_path / 'out.csv').read_text().splitlines()]


def test_names_like_formulas_stay_as_they_are(tmp_path):
    text = "note,u,v\n'-lateral,100,125\n''-x,100,125\n'plain,100,125\nit's,100,125\n"
    _, *rows = corrected_rows(tmp_path, text, {'a': some_calibration()})
    assert [row[0] for row in rows] == ["'-lateral", "''-x", "'plain", "it's"]


@pytest.mark.parametrize('end', ['\n', '\r\n', '\r'])
def test_tables_of_spreadsheets_are_read(tmp_path, end):
    """Also with semicolons and decimal commas; empty rows at the end are of no importance."""
    rows = ('fluoroscope;exposure;target_id;u;v', 'a;1;1;5,5;5,5', ';;;;')
    path = text_file(tmp_path, 'o.csv', end.join(['# note, by hand', *rows]))
    (frame,) = read_observations_csv(path, (100, 100))['a']
    assert frame.uv.tolist() == [[5.5, 5.5]]
    lines = [row.replace(',', '.').replace(';', ',') for row in rows]
    path = text_file(tmp_path, 'o.csv', end.join(lines) + end)
    (frame,) = read_observations_csv(path, (100, 100))['a']
    assert frame.uv.tolist() == [[5.5, 5.5]]


def test_points_are_corrected_and_other_columns_kept(tmp_path):
    calibration = some_calibration()
    header, good, empty, off, outside = corrected_rows(
        tmp_path, 'note,v,u\n kept ,125.25,100\n1,,3\n2,5,nan\n3,1,1\n', {'a': calibration}
    )
    assert header == ['note', 'v', 'u', 'u_corrected', 'v_corrected', 'sigma', 'status']
    wanted = calibration.correct([[100, 125.25]])
    assert good[:3] == [' kept ', '125.25', '100'] and good[6] == 'OK'
    assert list(map(float, good[3:6])) == [*wanted.uv[0], wanted.sigma[0]]
    assert empty == ['1', '', '3', '', '', '', 'INVALID'] and off == [
        '2',
        '5',
        'nan',
        '',
        '',
        '',
        'INVALID',
    ]
    assert outside[6] == 'OUTSIDE' and float(outside[3])


def test_points_are_corrected_at_the_angle_of_their_row(tmp_path):
    calibration = some_calibration(angle_field=some_angle_field())
    _, one, two = corrected_rows(
        tmp_path, 'u,v,angle_deg\n100,125,20\n100,125,\n', {'a': calibration}
    )
    for row, angle in ((one, np.radians(20)), (two, None)):
        wanted = calibration.correct([[100, 125]], angle=angle)
        assert list(map(float, row[3:6])) == pytest.approx([*wanted.uv[0], wanted.sigma[0]])
    assert one[3] != two[3]


def test_points_of_two_fluoroscopes_with_their_own_sigma(tmp_path):
    calibrations = {'a': some_calibration('a'), 'b': some_calibration('b', n=0)}
    header, one, two, three = corrected_rows(
        tmp_path, 'fluoroscope,u,v,sigma\nb,10,20,0.5\na,75,100,\nb,10,5000,1\n', calibrations
    )
    assert header[4:] == ['u_corrected', 'v_corrected', 'sigma_corrected', 'status']
    assert one == ['b', '10', '20', '0.5', '10.0', '20.0', '0.5', 'OK']
    assert float(two[6]) == calibrations['a'].correct([[75, 100]]).sigma[0]
    assert three[-1] == 'INVALID'


@pytest.mark.parametrize(
    'text, sentence',
    [
        ('u,v\n1,2\nx,2\n', "row 3: u is 'x', not a number"),
        ('u,v,sigma\n1,2,-1\n', "row 2: sigma is '-1', not a finite number above 0"),
        (
            'fluoroscope,u,v\na,1,2\nc,1,2\n',
            "row 3: there is no calibration of fluoroscope 'c', only of a, b",
        ),
        ('u,v\n1,2\n', 'no column fluoroscope, and there are calibrations of a, b'),
        ('fluoroscope,u,v,status\na,1,2,3\n', 'already has a column status'),
        ('u\n1\n', 'no column v'),
    ],
)
def test_point_errors_name_row_and_cause(tmp_path, text, sentence):
    calibrations = {name: some_calibration(name) for name in 'ab'}
    assert sentence in message_of(corrected_rows, tmp_path, text, calibrations)


# ---------------------------------------------------------------- results


def test_results_round_trip_and_have_no_nan(tmp_path):
    result = {
        'a': np.float64(1) / 3,
        'n': np.int64(5),
        'nan': float('nan'),
        'inf': [np.inf],
        'xyz': np.eye(2),
        'yes': np.bool_(True),
        'none': None,
        'text': 'Größe',
    }
    write_json(tmp_path / 'result.json', result)
    again = read_json(str(tmp_path / 'result.json'))
    assert again == {
        'a': 1 / 3,
        'n': 5,
        'nan': None,
        'inf': [None],
        'xyz': [[1, 0], [0, 1]],
        'yes': True,
        'none': None,
        'text': 'Größe',
    }
    assert list(again) == list(result)
    json.loads((tmp_path / 'result.json').read_text(), parse_constant=pytest.fail)


def test_damaged_json_is_reported_with_its_row(tmp_path):
    assert 'row 2: this is not JSON' in message_of(
        read_json, text_file(tmp_path, 'r.json', '{"a": 1,\n b}')
    )
    assert 'no object' in message_of(read_json, text_file(tmp_path, 'r.json', '[1]'))
    assert 'nested' in message_of(read_json, text_file(tmp_path, 'r.json', '[' * 100_000))


def test_names_as_long_as_a_file_system_allows_are_written(tmp_path):
    """Hidden names on the way there are longer by their marks, and limited in bytes."""
    name = '日' * 80  # 240 bytes
    write_text(tmp_path / f'{name}.csv', 'text')
    assert (tmp_path / f'{name}.csv').read_text() == 'text'
    with replaced_folder(tmp_path / name, FolderKind('a folder', ('*',), ('*',))) as folder:
        (folder / 'part').write_text('part')
    assert (tmp_path / name / 'part').exists()
    bag = tmp_path / ('n' * 240)
    with BagWriter(bag) as writer:
        write_frame(writer, Frame('a', 1, np.array([1]), np.array([[1.0, 2.0]]), SIZE))
    assert sorted(os.listdir(tmp_path)) == sorted([f'{name}.csv', name, bag.name])


def test_file_names_that_are_not_utf_8_are_escaped_in_texts(tmp_path):
    write_json(tmp_path / 'about.json', {'source': 'caf\udce9.csv'})
    assert read_json(tmp_path / 'about.json') == {'source': 'caf\udce9.csv'}
    write_text(tmp_path / 'report.html', 'caf\udce9.csv')
    assert (tmp_path / 'report.html').read_bytes() == b'caf\\udce9.csv'
