# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""fluoro-calib bodies: from a recording of a virtual knee to poses and joint angles."""

import csv
import json
import re
import shutil
import sys

import cv2
import numpy as np
import pandas
import pytest
from rigs import run

import fluoro_calib_ros as fc
from fluoro_calib_ros.images.overlay import draw_bodies
from fluoro_calib_ros.io.bags.reader import read_frames

pytestmark = pytest.mark.long

COLUMNS = (
    'body,exposure,time_s,x_mm,y_mm,z_mm,qx,qy,qz,qw,sd_x_mm,sd_y_mm,sd_z_mm,sd_rx_rad,sd_ry_rad,'
    'sd_rz_rad,markers,status'
)


@pytest.fixture(scope='module')
def knee(tmp_path_factory):
    """A rig, its calibration and a recording of a knee that walks for half a second."""
    folder = tmp_path_factory.mktemp('knee') / 'rig'
    simulate = ('simulate', '--out', folder, '--bodies', '--exposures', '8', '--seconds', '0.5')
    assert run(*simulate) == 0
    calibrate = ('calibrate', folder / 'calibration', '--phantom', folder / 'phantom.csv')
    options = ('--model', 'collocation', '--fast', '--out', folder / 'result')
    assert run(*calibrate, *options) == 0
    return folder


def bodies(knee, out, *more):
    return run(
        *('bodies', knee / 'walking', '--bodies', knee / 'bodies.csv'),
        *('--calibration', knee / 'result', '--out', out, *more),
    )


def rows(path):
    with open(path, newline='') as file:
        return list(csv.DictReader(file))


def test_poses_and_joints_with_their_deviations(knee, tmp_path, capsys):
    joints = ('--joints', knee / 'joints.toml')
    assert bodies(knee, tmp_path / 'motion', *joints, '--json') == 0
    document = json.loads(capsys.readouterr().out)
    assert set(document['bodies']) == {'femur', 'tibia'} and set(document['joints']) == {'knee'}
    names = sorted(path.name for path in (tmp_path / 'motion').iterdir())
    assert names == ['joints.csv', 'joints.mot', 'motion.csv', 'poses.csv', 'shapes.csv']
    assert (tmp_path / 'motion' / 'poses.csv').read_text().splitlines()[0] == COLUMNS
    found = rows(tmp_path / 'motion' / 'joints.csv')
    true = rows(knee / 'truth' / 'walking_joints.csv')
    for name in ('angle_1_deg', 'angle_2_deg', 'angle_3_deg'):
        error = np.array([float(a[name]) - float(b[name]) for a, b in zip(found, true)])
        sd = np.array([float(a[f'sd_{name}']) for a in found])
        # An error of 0.1 mm in CT coordinates turns an anatomical frame by 0.2 degrees throughout.
        assert np.abs(error).max() < 4 * sd.max() < 2.0
        assert np.std(error) < 0.2
    assert {row['status'] for row in found} == {'OK'}


def test_python_has_the_tables_of_the_command_and_its_figures(knee, tmp_path, monkeypatch):
    recording = fc.read_source(knee / 'walking')
    calibrations = fc.read_calibrations(knee / 'result')
    orientation = fc.load_orientation(knee / 'result' / 'rig_orientation.npz')
    known = fc.read_bodies(knee / 'bodies.csv')
    joints = fc.read_joints(knee / 'joints.toml', known)
    outcome = fc.track_bodies(recording.frames, calibrations, orientation, known, joints=joints)
    fc.save_bodies(tmp_path / 'motion', outcome)
    for name in ('poses', 'motion', 'joints', 'shapes'):
        table = outcome.to_dataframe(name)
        saved = pandas.read_csv(tmp_path / 'motion' / f'{name}.csv')
        pandas.testing.assert_frame_equal(table, saved, check_dtype=False, check_exact=True)
    observed = recording.to_dataframe()
    assert len(observed) == sum(len(f.target_id) for own in recording.frames.values() for f in own)
    reconstructed = fc.reconstruct(recording.frames, calibrations, orientation)
    points = reconstructed.to_dataframe()
    paths, found, _ = reconstructed.plot().axes
    assert len(paths.lines) == points.target_id.nunique() == 8
    assert found.get_xlabel() == 'time [s]' and '3001: 100 %' in [
        label.get_text() for label in found.get_yticklabels()
    ]
    assert (points.query('status == "OK"')[['sd_x', 'sd_y', 'sd_z']] > 0).all(axis=None)
    titles = [outcome.plot(name).get_suptitle() for name in ('knee', 'tibia', None)]
    assert titles == ['knee', 'tibia', 'Paths of the origins of the bodies']
    with pytest.raises(fc.DataError, match="no joint or body is named 'hip'"):
        outcome.plot('hip')
    with pytest.raises(fc.DataError, match="no table is named 'angles'"):
        outcome.to_dataframe('angles')
    monkeypatch.setitem(sys.modules, 'pandas', None)
    with pytest.raises(fc.DataError, match='pandas is not installed'):
        outcome.to_dataframe()


def test_report_of_joints_and_bodies_needs_nothing_else(knee, tmp_path):
    joints = ('--joints', knee / 'joints.toml', '--report', '--smooth', 'lag')
    assert bodies(knee, tmp_path / 'motion', *joints) == 0
    text = (tmp_path / 'motion' / 'report.html').read_text()
    shown = re.findall('<figcaption>(.*?)</figcaption>', text)
    assert shown == ['joint knee', 'paths in space', 'body femur', 'body tibia']
    assert text.count('data:image/svg+xml;base64,') == 4
    assert not re.search('https?:', re.sub('base64,[^"]+', '', text))
    assert '<td>flexion</td>' in text and '60 OK' in text


def test_neutral_position_of_another_recording(knee, tmp_path, capsys):
    """A recording that is its own neutral trial has a mean rotation of zero."""
    text = (knee / 'joints.toml').read_text()
    whole = text.replace('[joint.proximal_frame', 'neutral = [1, 60]\n\n[joint.proximal_frame', 1)
    (tmp_path / 'whole.toml').write_text(whole)
    given = ('--smooth', 'none', '--joints')
    own = (*given, knee / 'joints.toml', '--neutral', knee / 'walking')
    assert bodies(knee, tmp_path / 'key', *given, tmp_path / 'whole.toml') == 0
    assert bodies(knee, tmp_path / 'own', *own) == 0
    angles, of_key = (
        np.array([float(row['angle_1_deg']) for row in rows(tmp_path / name / 'joints.csv')])
        for name in ('own', 'key')
    )
    assert angles == pytest.approx(of_key, abs=1e-9) and abs(angles.mean()) < 1
    capsys.readouterr()
    assert bodies(knee, tmp_path / 'none', '--neutral', knee / 'walking') == 2
    assert 'give --joints' in capsys.readouterr().err


def test_film_has_the_markers_where_they_were_observed(knee, tmp_path, monkeypatch):
    """Markers are drawn in the radiographs as recorded, including their distortion."""
    shown = (1, 30, 31)
    for name in 'ab':
        (tmp_path / 'images' / name).mkdir(parents=True)
        for number in (*shown, 1000):
            picture = np.random.default_rng(0).integers(0, 255, (1024, 1024), dtype=np.uint8)
            cv2.imwrite(str(tmp_path / 'images' / name / f'{number:04d}.png'), picture)
    views = []

    def draw(image, title, bodies):
        views.append(bodies)
        return draw_bodies(image, title, bodies)

    monkeypatch.setattr('fluoro_calib_ros.jobs.bodies.draw_bodies', draw)
    counted = []
    monkeypatch.setattr(
        'fluoro_calib_ros.cli.output.ProgressBar.__call__',
        lambda bar, done, total: counted.append((bar._name, bar._unit, done, total)),
    )
    film = ('--smooth', 'none', '--film', tmp_path / 'images')
    assert bodies(knee, tmp_path / 'motion', *film) == 0
    frames = read_frames(knee / 'walking').frames
    seen = [{f.number: f for f in frames[name]}[number] for name in 'ab' for number in shown]
    assert len(views) == len(seen)
    of_film = [each[1:] for each in counted if each[0] == 'film']
    assert of_film == 2 * [('image', number + 1, 4) for number in range(4)]
    for frame, of_image in zip(seen, views):
        markers = np.concatenate([view.markers for view in of_image])
        ids = np.array([3001, 3002, 3003, 3004, 3011, 3012, 3013, 3014])
        distance = np.linalg.norm(
            markers[np.searchsorted(ids, frame.target_id)] - frame.uv, axis=1
        )
        assert len(distance) > 5 and distance.max() < 5 * 0.25
    for name in 'ab':
        video = cv2.VideoCapture(str(tmp_path / 'motion' / f'film_{name}.mp4'))
        assert video.get(cv2.CAP_PROP_FRAME_COUNT) == len(shown)
        assert video.read()[1].shape[1] == 1024


def test_film_without_images_of_a_fluoroscope_is_refused(knee, tmp_path, capsys):
    (tmp_path / 'images' / 'a').mkdir(parents=True)
    cv2.imwrite(str(tmp_path / 'images' / 'a' / '1.png'), np.zeros((1024, 1024), np.uint8))
    film = ('--smooth', 'none', '--film', tmp_path / 'images')
    assert bodies(knee, tmp_path / 'motion', *film) == 1
    assert 'there is no folder b with images' in capsys.readouterr().err
    assert not (tmp_path / 'motion').exists()


def test_without_smoothing_and_with_a_lag(knee, tmp_path):
    assert bodies(knee, tmp_path / 'none', '--smooth', 'none') == 0
    assert bodies(knee, tmp_path / 'lag', '--smooth', 'lag', '--lag', '3') == 0
    assert bodies(knee, tmp_path / 'low', '--smooth', 'butterworth', '--cutoff', '12') == 0
    sd = {}
    for kind in ('none', 'lag', 'low'):
        poses = rows(tmp_path / kind / 'poses.csv')
        assert len(poses) == 2 * 60 and all(row['x_mm'] for row in poses)
        sd[kind] = np.median([float(row['sd_rx_rad']) for row in poses])
    assert sd['lag'] < sd['none'] and sd['low'] < sd['none']


def test_a_result_is_replaced_as_a_whole_and_only_by_a_result(knee, tmp_path):
    assert bodies(knee, tmp_path / 'motion', '--smooth', 'none') == 0
    (tmp_path / 'motion' / 'notes.txt').write_text('mine')
    assert bodies(knee, tmp_path / 'motion', '--smooth', 'lag') == 0
    assert (tmp_path / 'motion' / 'notes.txt').read_text() == 'mine'
    assert bodies(knee, knee / 'result', '--smooth', 'none') == 1
    assert (knee / 'result' / 'result.json').exists()


def test_shapes_can_be_kept(knee, tmp_path, capsys):
    assert bodies(knee, tmp_path / 'motion', '--keep-shapes', '--smooth', 'none') == 0
    assert 'nan' not in capsys.readouterr().out
    given = rows(knee / 'bodies.csv')
    kept = rows(tmp_path / 'motion' / 'shapes.csv')
    assert [float(row['x']) for row in given] == [float(row['x']) for row in kept]


def test_a_body_whose_markers_nobody_sees_is_named(knee, tmp_path, capsys):
    shutil.copy(knee / 'bodies.csv', tmp_path / 'bodies.csv')
    with open(tmp_path / 'bodies.csv', 'a') as file:
        file.writelines(f'talus,{9000 + k},{10 * k % 7},{k},{k * k},0.1\n' for k in range(4))
    code = run(
        *('bodies', knee / 'walking', '--bodies', tmp_path / 'bodies.csv', '--smooth', 'none'),
        *('--calibration', knee / 'result', '--out', tmp_path / 'motion'),
    )
    assert code == 0 and 'body talus' in capsys.readouterr().err
    poses = [row for row in rows(tmp_path / 'motion' / 'poses.csv') if row['body'] == 'talus']
    assert {row['status'] for row in poses} == {'FAILED'} and not any(p['x_mm'] for p in poses)


def changed_bodies(knee, path, change):
    """Write the bodies with changed coordinates (n, 3); return the path."""
    given = rows(knee / 'bodies.csv')
    xyz = change(np.array([[float(row[name]) for name in 'xyz'] for row in given]))
    lines = [
        ','.join(map(str, (row['body'], row['marker'], *place, row['sd'])))
        for row, place in zip(given, xyz.tolist())
    ]
    path.write_text('\n'.join(['body,marker,x,y,z,sd', *lines]) + '\n')
    return path


@pytest.mark.parametrize(
    ('factor', 'cause'), [((-1, 1, 1), 'mirrored'), ((0.1, 0.1, 0.1), 'in cm, not in mm')]
)
@pytest.mark.parametrize('kept', [(), ('--keep-shapes',)])
def test_coordinates_in_which_no_pose_has_a_meaning_are_refused(
    knee, tmp_path, capsys, factor, cause, kept
):
    changed = changed_bodies(knee, tmp_path / 'bodies.csv', lambda xyz: xyz * factor)
    options = ('--bodies', changed, '--smooth', 'none', *kept)
    assert bodies(knee, tmp_path / 'motion', *options) == 1
    err = capsys.readouterr().err
    assert cause in err and 'body femur' in err and 'body tibia' in err
    assert not (tmp_path / 'motion').exists()


def test_angles_that_no_knee_reaches_are_not_a_success(knee, tmp_path, capsys):
    """The plateau with medial and lateral exchanged: its axes point to the other side."""
    text = (knee / 'joints.toml').read_text()
    exchanged = {'medial_plateau': 'lateral_plateau', 'lateral_plateau': 'medial_plateau'}
    text = re.sub('|'.join(exchanged), lambda match: exchanged[match[0]], text)
    (tmp_path / 'joints.toml').write_text(text)
    options = ('--joints', tmp_path / 'joints.toml', '--json')
    for neutral in ((), ('--neutral', knee / 'walking')):
        assert bodies(knee, tmp_path / 'motion', *options, *neutral) == 3
        (found,) = json.loads(capsys.readouterr().out)['findings']
        assert found['kind'] == 'joint_impossible' and abs(found['numbers']['least_deg']) > 90


@pytest.mark.filterwarnings('error')
def test_bodies_and_joints_without_poses_have_no_figures(knee, tmp_path, capsys):
    """Nothing is printed about poses and angles that are not."""
    text = (knee / 'bodies.csv').read_text().replace(',30', ',90')
    (tmp_path / 'unseen.csv').write_text(text.replace('tibia,90', 'tibia,30'))
    files = ('--bodies', tmp_path / 'unseen.csv', '--joints', knee / 'joints.toml')
    assert bodies(knee, tmp_path / 'motion', *files) == 0
    out = capsys.readouterr().out
    assert 'femur: no pose' in out and 'knee: no angles' in out and 'nan' not in out


@pytest.mark.parametrize(
    ('text', 'cause'),
    [
        ('femur,3001,1,2,3,0.1\nfemur,3002,1,4,5,0.1\n', 'body femur'),
        ('femur,3001,1,2,3,0.1\nfemur,3001,1,4,5,0.1\n', 'marker 3001'),
        ('femur,3001,1,2,nan,0.1\n', 'bodies.csv'),
    ],
)
def test_bodies_that_cannot_be_used_are_refused(knee, tmp_path, capsys, text, cause):
    path = tmp_path / 'bodies.csv'
    path.write_text('body,marker,x,y,z,sd\n' + text)
    (tmp_path / 'motion').mkdir()
    code = run(
        *('bodies', knee / 'walking', '--bodies', path),
        *('--calibration', knee / 'result', '--out', tmp_path / 'motion'),
    )
    err = capsys.readouterr().err
    assert code == 1 and cause in err and err.count('\n') == 1
    assert not list((tmp_path / 'motion').iterdir())


def test_joints_of_unknown_bodies_are_refused(knee, tmp_path, capsys):
    text = (knee / 'joints.toml').read_text().replace('"tibia"', '"fibula"')
    (tmp_path / 'joints.toml').write_text(text)
    assert bodies(knee, tmp_path / 'motion', '--joints', tmp_path / 'joints.toml') == 1
    assert 'no body fibula' in capsys.readouterr().err


def test_a_table_without_times_asks_for_the_rate(knee, tmp_path, capsys):
    table = tmp_path / 'w.csv'
    assert run('convert', knee / 'walking', '--to', 'observations', '--out', table) == 0
    arguments = (
        *('bodies', table, '--bodies', knee / 'bodies.csv', '--smooth', 'lag'),
        *('--calibration', knee / 'result', '--out', tmp_path / 'motion'),
    )
    capsys.readouterr()
    assert run(*arguments) == 1
    assert '--rate HZ' in capsys.readouterr().err
    assert run(*arguments, '--rate', '120') == 0
    poses = rows(tmp_path / 'motion' / 'poses.csv')
    assert float(poses[12]['time_s']) == pytest.approx(0.1, abs=1e-6)
    in_bag = ('bodies', knee / 'walking', *arguments[2:], '--rate', '60')
    assert run(*in_bag) == 1  # the times of a bag are not replaced
    assert 'has the times of its exposures' in capsys.readouterr().err


@pytest.mark.parametrize(
    ('late', 'swap', 'cause'), [(1, False, 'frame numbers'), (0, True, 'interchanged')]
)
def test_rays_that_do_not_meet_give_no_joint_angles(knee, tmp_path, capsys, late, swap, cause):
    table = tmp_path / 'w.csv'
    assert run('convert', knee / 'walking', '--to', 'observations', '--out', table) == 0
    seen = rows(table)
    for row in seen:
        if row['fluoroscope'] == 'b':
            row['exposure'] = int(row['exposure']) + late
        if swap:
            row['fluoroscope'] = {'a': 'b', 'b': 'a'}[row['fluoroscope']]
    lines = [','.join(str(value) for value in row.values()) for row in seen]
    table.write_text('\n'.join([','.join(seen[0]), *lines]) + '\n')
    code = run(
        *('bodies', table, '--bodies', knee / 'bodies.csv', '--rate', '120'),
        *('--calibration', knee / 'result', '--out', tmp_path / 'motion'),
    )
    assert code == 1 and cause in capsys.readouterr().err
    assert not (tmp_path / 'motion').exists()


def test_poses_are_converted_for_other_programs(knee, tmp_path):
    assert bodies(knee, tmp_path / 'motion', '--smooth', 'lag') == 0
    poses = tmp_path / 'motion' / 'poses.csv'
    out = tmp_path / 'bodies_xmalab.csv'
    assert run('convert', poses, '--to', 'rigidbody', '--out', out) == 0
    back = tmp_path / 'back.csv'
    assert run('convert', out, '--to', 'rigidbody', '--units', 'mm', '--out', back) == 0
    assert out.read_bytes() == back.read_bytes()
    first = np.array(out.read_text().splitlines()[1].split(','), dtype=float)
    row = rows(poses)[0]
    assert first[13:16] == pytest.approx([float(row[f'{axis}_mm']) for axis in 'xyz'])
