# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""From the tables of a lab to the input of the next program, by the command line."""

import csv
import json
import os
from dataclasses import replace

import cv2
import numpy as np
import pytest
from rigs import run

from fluoro_calib_ros.exposures.frame import Frame
from fluoro_calib_ros.exposures.names import Names
from fluoro_calib_ros.io.calibration import load_calibrations, save_calibration
from fluoro_calib_ros.io.calibration_request import read_request
from fluoro_calib_ros.io.csv_table import read_names
from fluoro_calib_ros.io.formats import registry
from fluoro_calib_ros.io.formats.content import Content, FileSettings
from fluoro_calib_ros.io.phantom import read_phantom
from fluoro_calib_ros.jobs.sources import read_source, read_survey

IMAGE = ('--image-size', '1024x1024')
# Each command makes the lookup grid anew, which is quick for this model.
FAST = ('--model', 'collocation', '--max-iterations', '2', '--fast')


@pytest.fixture(scope='module')
def lab(tmp_path_factory):
    """A virtual lab: its XMALab tables with names, and the same data as CSV of this package."""
    folder = tmp_path_factory.mktemp('lab')
    rig = folder / 'rig'
    options = ('--exposures', 5, '--test-exposures', 1, '--seconds', 0.02)
    assert run('simulate', '--out', rig, *options) == 0
    phantom = read_phantom(rig / 'phantom.csv')
    frames = read_source(rig / 'calibration', collect='all').frames
    names = Names({f'bead {i:03d}': i for i in phantom.target_id.tolist()})
    write = registry.write
    content = Content(observations=frames, survey=phantom, names=names)
    write(folder / 'points.csv', 'xmalab2d', content, FileSettings())
    write(folder / 'cube.csv', 'framespec', content, FileSettings(units='cm'))
    write(folder / 'own.csv', 'observations', Content(observations=frames), FileSettings())
    write(folder / 'phantom.csv', 'phantom', Content(survey=phantom), FileSettings())
    return folder


@pytest.fixture(scope='module')
def result(lab):
    """The calibration from XMALab's tables."""
    arguments = ('--phantom', lab / 'cube.csv', '--out', lab / 'result', '--fluoroscopes', 'a,b')
    assert run('calibrate', lab / 'points.csv', *arguments, *IMAGE, *FAST) == 0
    return lab / 'result'


@pytest.fixture(scope='module')
def reconstructed(lab, result):
    """Points in space of the first exposures, in rows by frame and target."""
    path = lab / 'space.csv'
    options = ('--calibration', result, '--out', path, '--fluoroscopes', 'a,b')
    assert run('reconstruct', lab / 'points.csv', *options) == 0
    return path


def rows_of(path):
    with open(path) as file:
        return list(csv.DictReader(file))


@pytest.mark.long
def test_calibration_from_xmalab_is_the_same(lab, result, capsys):
    """It equals that from our files with the deviation that frame specifications do not have."""
    phantom = rows_of(lab / 'phantom.csv')
    with open(lab / 'sd.csv', 'w') as file:
        writer = csv.DictWriter(file, phantom[0])
        writer.writeheader()
        writer.writerows({**row, 'sd': '0.1'} for row in phantom)
    arguments = ('--phantom', lab / 'sd.csv', '--out', lab / 'own')
    assert run('calibrate', lab / 'own.csv', *arguments, *IMAGE, *FAST) == 0
    found, expected = load_calibrations(result), load_calibrations(lab / 'own')
    for name in ('a', 'b'):
        np.testing.assert_array_equal(found[name].interior, expected[name].interior)
        assert found[name].source_digest == expected[name].source_digest
    assert read_names(result).targets['bead 017'] == 17
    assert not (lab / 'own' / 'names.csv').exists()
    capsys.readouterr()


def test_source_of_a_calibration_is_recognised_by_its_names(lab, result):
    """`validate --source` relies on it: the observations have the digest of the calibration."""
    calibrations = load_calibrations(result)
    known = FileSettings(names=read_names(result))
    recording = read_source(
        lab / 'points.csv', image_size=(1024, 1024), fluoroscopes=['a', 'b'], settings=known
    )
    survey = read_survey(lab / 'cube.csv', known)
    request = read_request(result, calibrations, recording.frames, survey.phantom)
    assert request.names == read_names(result)
    assert survey.names.targets == request.names.targets


def test_names_are_used_again_on_output(lab, reconstructed, capsys):
    """They appear in the table of points, and in the C3D file made of it."""
    rows = rows_of(reconstructed)
    assert all(row['name'] == f'bead {int(row["target_id"]):03d}' for row in rows)
    path = lab / 'space.c3d'
    assert run('convert', reconstructed, '--to', 'c3d', '--out', path, '--rate', 50) == 0
    found = registry.read(path, FileSettings())
    assert found.points.rate_hz == 50
    assert set(found.names.targets) == {row['name'] for row in rows}
    capsys.readouterr()


def test_opencv_triangulates_our_points_from_mayacam(lab, result, reconstructed, capsys):
    """The corrected image points and the MayaCam files suffice, and also give our residuals."""
    mayacam = lab / 'mayacam'
    corrected = lab / 'corrected.csv'
    assert run('convert', result, '--to', 'mayacam2', '--out', mayacam, '--json') == 0
    out, err = capsys.readouterr()
    assert [name[-14:] for name in json.loads(out)['files']] == [
        'a_MayaCam2.txt',
        'b_MayaCam2.txt',
    ]
    assert 'lengths in mm' in err
    options = ('--to', 'observations', '--out', corrected, '--fluoroscopes', 'a,b')
    correction = ('--corrected', '--calibration', result)
    assert run('convert', lab / 'points.csv', *options, *correction) == 0
    matrices = {}
    for name in 'ab':
        lines = (mayacam / f'{name}_MayaCam2.txt').read_text().split('\n')
        k, r = (
            np.array([[float(c) for c in line.split(',')] for line in lines[i : i + 3]])
            for i in (4, 9)
        )
        matrices[name] = k @ np.hstack([r, np.array([[float(t)] for t in lines[14:17]])])
    seen = {
        (row['fluoroscope'], row['exposure'], row['target_id']): (float(row['u']), float(row['v']))
        for row in rows_of(corrected)
    }
    distances = []
    for row in rows_of(reconstructed):
        key = (row['frame'], row['name'])
        if row['status'] != 'OK' or ('a', *key) not in seen or ('b', *key) not in seen:
            continue
        uv = [np.array(seen[(name, *key)]) for name in 'ab']
        xyz = np.array([float(row[axis]) for axis in 'xyz'])
        projected = [matrices[name] @ np.append(xyz, 1) for name in 'ab']
        misfit = np.concatenate([p[:2] / p[2] - at for p, at in zip(projected, uv)])
        assert abs(np.sqrt(np.mean(misfit**2)) - float(row['residual'])) < 1e-6
        x = cv2.triangulatePoints(matrices['a'], matrices['b'], *(at[:, None] for at in uv))
        distances.append((float(row['residual']), np.linalg.norm(x[:3, 0] / x[3, 0] - xyz)))
    residual, distance = np.array(distances).T
    # OpenCV does not weight the rays: its point is the same insofar as the rays meet, and
    # neighbouring rays have similar weights.
    assert len(residual) > 100 and np.max(distance / residual) < 0.5
    assert distance.min() < 0.002
    capsys.readouterr()


def test_lookup_table_maps_corrected_points_onto_the_observed_ones(lab, result, capsys):
    """Between pixels, the rule of cv2.remap applies; -1 is outside the calibrated area."""
    whole = load_calibrations(result)['a']
    save_calibration(lab / 'quarter', replace(whole, image_size=(512, 512)))
    calibration = load_calibrations(lab / 'quarter')['a']
    assert run('convert', lab / 'quarter', '--to', 'lut', '--out', lab / 'lut') == 0
    frames = read_source(lab / 'own.csv', image_size=(1024, 1024)).frames['a']
    uv = np.concatenate([frame.uv for frame in frames])
    uv = uv[(uv < 512).all(axis=1)]
    points = calibration.correct(uv)
    lines = (lab / 'lut' / 'a_LUT.csv').read_text().splitlines()
    maps = np.array([np.fromstring(line, sep=',') for line in lines]).reshape(2, 512, 512)
    at = points.uv.astype(np.float32)[:, None]
    found = np.stack(
        [cv2.remap(m.astype(np.float32), at, None, cv2.INTER_LINEAR)[:, 0] for m in maps], axis=1
    )
    cells = np.floor(points.uv).astype(int)
    inside = ((cells >= 0) & (cells < 511)).all(axis=1) & (points.status == 0)
    column, row = np.where(inside[:, None], cells, 0).T
    supported = [(maps[0, row + i, column + j] != -1) for i in (0, 1) for j in (0, 1)]
    inside &= np.all(supported, axis=0)
    assert inside.sum() > 0.8 * len(uv)
    # cv2.remap interpolates in steps of 1/32 px.
    assert np.abs(found - uv)[inside].max() < 0.04
    assert np.abs(found - points.uv)[inside].max() > 1
    assert (maps == -1).any() and ((maps[0] == -1) == (maps[1] == -1)).all()
    capsys.readouterr()


def test_result_folder_fills_the_files_of_chow_et_al(lab, result, capsys):
    """It fills all four, from which the image points are computed again."""
    assert run('convert', result, '--to', 'bundle', '--out', lab / 'chow', '--units', 'mm') == 0
    content = registry.read(lab / 'chow' / 'bundle.pho', FileSettings(units='mm'))
    frames = read_source(lab / 'own.csv', image_size=(1024, 1024)).frames
    assert [f.number for f in content.observations['cam2']] == [f.number for f in frames['b']]
    np.testing.assert_array_equal(content.observations['cam2'][1].uv, frames['b'][1].uv)
    assert len(content.stations) == 10 and len(content.cameras) == 2
    capsys.readouterr()


def test_poses_of_the_phantom_agree_with_its_points(lab, result, reconstructed, capsys):
    """The rigid body maps the survey to the reconstructed beads of the exposure."""
    path = lab / 'bodies.csv'
    assert run('convert', result, '--to', 'rigidbody', '--out', path, '--units', 'mm') == 0
    bodies = registry.read(path, FileSettings(units='mm')).bodies
    phantom = read_phantom(lab / 'phantom.csv')
    rows = [row for row in rows_of(reconstructed) if row['frame'] == '3' and row['x']]
    found = np.array([[float(row[axis]) for axis in 'xyz'] for row in rows])
    survey = phantom.xyz_mm[phantom.index([int(row['target_id']) for row in rows])]
    index = bodies.frame.tolist().index(3)
    expected = survey @ bodies.rotation[index, 0].T + bodies.translation_mm[index, 0]
    assert np.median(np.linalg.norm(found - expected, axis=1)) < 1.5
    capsys.readouterr()


def test_correct_reads_points_of_xmalab(lab, result, capsys):
    """The output has one row per point, with the names."""
    path = lab / 'corrected_rows.csv'
    names = ('cam1', 'cam2')
    frames = {
        n: [Frame('a', 2, np.array([3]), np.array([[500.0, 400.5]]), (1024, 1024))]
        for n in names[:1]
    }
    registry.write(
        lab / 'one.csv',
        'xmalab2d',
        Content(observations=frames, names=Names({'bead 003': 3})),
        FileSettings(),
    )
    options = ('--calibration', result, '--fluoroscope', 'a', '--out', path)
    assert run('correct', lab / 'one.csv', *options) == 0
    (row,) = rows_of(path)
    assert (row['fluoroscope'], row['exposure'], row['target_id']) == ('a', '2', 'bead 003')
    expected = load_calibrations(result)['a'].correct([[500.0, 400.5]]).uv[0]
    np.testing.assert_allclose([float(row['u_corrected']), float(row['v_corrected'])], expected)
    capsys.readouterr()


@pytest.mark.parametrize(
    ('arguments', 'sentence'),
    [
        (('points.csv', '--to', 'mayacam2'), 'needs cameras, but the source has image points'),
        (
            ('phantom.csv', '--to', 'c3d'),
            'C3D needs 3-D points or poses of rigid bodies, but the source has a phantom',
        ),
        (('missing.csv', '--to', 'bag'), 'missing.csv: there is no such file'),
        (('result', '--to', 'mayacam2', '--exposure', '77'), 'there is no exposure 77'),
        (('result', '--to', 'dlt', '--fluoroscopes', 'c'), "no fluoroscope 'c', only a, b"),
        (('own.csv', '--to', 'xmalab2d', '--from', 'xma'), 'looks like image points, CSV'),
    ],
)
def test_wrong_conversion_says_why(lab, result, capsys, arguments, sentence):
    out = lab / 'nothing'
    status = run('convert', lab / arguments[0], *arguments[1:], '--out', out, *IMAGE)
    _, err = capsys.readouterr()
    assert status == 1 and sentence in err and err.count('\n') == 1
    assert not out.exists()


def test_output_that_is_no_file_is_refused_before_anything_is_written(lab, result, tmp_path):
    pipe = tmp_path / 'pipe.csv'
    os.mkfifo(pipe)
    arguments = ('convert', lab / 'points.csv', *IMAGE, '--to')
    assert run(*arguments, 'observations', '--out', pipe) == 1
    assert pipe.is_fifo()
    # Formats with several files fill a folder.
    (tmp_path / 'folder').mkdir()
    assert run('convert', result, '--to', 'mayacam2', '--out', tmp_path / 'folder') == 0
    assert len(list((tmp_path / 'folder').iterdir())) == 2


def test_source_of_another_kind_says_what_it_is(lab, result, capsys):
    arguments = ('--phantom', lab / 'cube.csv', '--out', lab / 'no', *IMAGE)
    assert run('calibrate', lab / 'cube.csv', *arguments) == 1
    assert 'looks like XMALab frame specification (framespec)' in capsys.readouterr().err
    assert run('calibrate', lab / 'points.csv', '--phantom', lab / 'own.csv', *arguments[2:]) == 1
    assert 'which has image points, but a phantom is needed' in capsys.readouterr().err
