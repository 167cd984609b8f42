# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Orientation of a rig from a capture or from exposures, its file, and the commands using it."""

import csv
import json
import pathlib
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rigs import calibrated, exposures, rig, run

from fluoro_calib_ros.correction.registry import no_correction
from fluoro_calib_ros.errors import DataError
from fluoro_calib_ros.estimation.rig_orientation import (
    orientation_and_scatter,
    orientation_of_capture,
    standing_frames,
)
from fluoro_calib_ros.exposures.frame import Frame
from fluoro_calib_ros.exposures.phantom import Phantom
from fluoro_calib_ros.io.bags.writer import write_bag
from fluoro_calib_ros.io.calibration import (
    ORIENTATION_FIELDS,
    load_orientation,
    save_calibration,
    save_orientation,
)
from fluoro_calib_ros.io.observations import write_observations_csv
from fluoro_calib_ros.photogrammetry.collinearity import project
from fluoro_calib_ros.photogrammetry.rig_orientation import (
    datum_transformation,
    with_datum_of_points,
)
from fluoro_calib_ros.photogrammetry.rotations import matrix_from_vector, vector_from_matrix
from fluoro_calib_ros.reconstruction.intersection import OK, Intersector
from fluoro_calib_ros.reconstruction.reconstruct import RigRecording
from fluoro_calib_ros.simulation.rig import (
    Detection,
    VirtualRig,
    detect_beads,
    phantom_poses,
    simulate_exposures,
    simulate_tracking,
    virtual_rig,
)

pytestmark = pytest.mark.long

NOISE_PX = 0.25


def capture(of_rig=None, count=1, seed=3, pose=(np.eye(3), np.zeros(3)), false_matches=0.01):
    """Frames by fluoroscope of the phantom standing in one pose."""
    of_rig = of_rig or rig()
    rng = np.random.default_rng(seed)
    points = of_rig.true_mm @ pose[0].T + pose[1]
    return {
        f.name: [
            Frame(
                f.name,
                k + 1,
                *detect_beads(
                    rng, f, points, of_rig.phantom.target_id, Detection(NOISE_PX, false_matches)
                ),
                f.image_size,
                None,
                k * 10**7,
            )
            for k in range(count)
        ]
        for f in of_rig.fluoroscopes
    }


def calibrations():
    """Calibrations of the fluoroscopes of the test rig."""
    return {name: calibrated(name).calibrations[name] for name in ('a', 'b')}


def without_distortion(seed=1):
    """A virtual rig without distortion; the seed selects a new survey."""
    still = virtual_rig(1, strength=0.0)
    survey = still.true_mm + np.random.default_rng(seed).normal(0, 0.1, still.true_mm.shape)
    return VirtualRig(
        still.fluoroscopes,
        still.true_mm,
        Phantom(still.phantom.target_id, survey, still.phantom.sd_mm),
    )


def drawn_calibrations(of_rig, seed):
    """Calibrations without distortion whose interior orientations scatter by their standard
    deviations.
    """
    rng = np.random.default_rng([seed, 8])
    out = {}
    root = np.array([[1.2, 0, 0], [0.3, 2.0, 0], [0.2, -0.2, 1.0]])
    for f in of_rig.fluoroscopes:
        out[f.name] = replace(
            calibrated('a', 6, max_iterations=2).calibrations['a'],
            fluoroscope=f.name,
            interior=f.interior + root @ rng.normal(size=3),
            interior_covariance=root @ root.T,
            model=no_correction(),
            sigma0=NOISE_PX,
            image_sd=NOISE_PX,
            nu=200.0,
        )
    return out


def normalised(step, covariance):
    """Mean normalised squared error of a step."""
    return step @ np.linalg.solve(covariance, step) / len(step)


# ---- from a capture


def test_errors_of_points_after_a_capture_agree_with_their_covariances():
    """Moving markers with estimated corrections; few false matches remain undetected."""
    orientation = orientation_of_capture(capture(), rig().phantom, calibrations())
    assert (
        orientation.source == 'capture'
        and orientation.frame_id == 'rig'
        and orientation.exposures == 1
    )
    assert orientation.calibration_ids == tuple(c.calibration_id for c in calibrations().values())
    tracking = simulate_tracking(rig(), 1.0, 40, seed=1)
    found = RigRecording(tracking.frames, calibrations(), Intersector(orientation)).reconstruct()
    error = np.concatenate([frame.points.xyz_mm for frame in found]) - tracking.points_mm.reshape(
        -1, 3
    )
    covariance = np.concatenate([frame.points.covariance for frame in found])
    good = np.isfinite(error).all(axis=1)
    squares = (
        np.einsum('ni,nij,nj->n', error[good], np.linalg.inv(covariance[good]), error[good]) / 3
    )
    assert good.mean() > 0.999 and 0.9 < squares.mean() < 1.1
    assert np.sqrt(np.mean(np.sum(error[good] ** 2, axis=1))) < 0.165


def test_covariance_of_a_capture_against_monte_carlo():
    """Noise, survey and fixed interior orientations: full covariance of all 18 unknowns."""
    squares = []
    for seed in range(40):
        still = without_distortion(seed)
        held = drawn_calibrations(still, seed)
        found = orientation_of_capture(capture(still, seed=seed), still.phantom, held)
        step = [
            np.concatenate(
                [
                    position - f.position_mm,
                    vector_from_matrix(rotation @ f.rotation.T),
                    interior - f.interior,
                ]
            )
            for f, position, rotation, interior in zip(
                still.fluoroscopes, found.position_mm, found.rotation, found.interior
            )
        ]
        squares.append(normalised(np.concatenate(step), found.covariance))
    assert np.mean(squares) == pytest.approx(1, abs=0.15)


def test_frames_of_a_capture_are_averaged():
    """Order does not matter, a false match does no harm, and the noise is that of the mean."""
    frames = capture(count=12, false_matches=0.0)
    one = orientation_of_capture(
        {n: f[:1] for n, f in frames.items()}, rig().phantom, calibrations()
    )
    many = orientation_of_capture(frames, rig().phantom, calibrations())
    assert (many.sd_mm < one.sd_mm).all() and many.exposures == 12 and many.stamp_ns == 11 * 10**7
    back = orientation_of_capture(
        {n: f[::-1] for n, f in frames.items()}, rig().phantom, calibrations()
    )
    np.testing.assert_allclose(back.position_mm, many.position_mm, atol=1e-6)
    merged = standing_frames(frames, calibrations())['a']
    times = np.bincount(np.concatenate([f.target_id for f in frames['a']]))[merged.target_id]
    np.testing.assert_allclose(merged.sigma, times**-0.5)
    wrong = [replace(f, uv=f.uv.copy()) for f in frames['a']]
    row = int(np.flatnonzero(np.isin(wrong[3].target_id, merged.target_id[times > 4]))[0])
    wrong[3].uv[row] = wrong[3].uv[row][::-1] + 3
    again = standing_frames({'a': wrong}, calibrations())['a']
    which = again.target_id == wrong[3].target_id[row]
    np.testing.assert_allclose(again.uv[which], merged.uv[which], atol=0.5)
    np.testing.assert_array_equal(again.uv[~which], merged.uv[~which])


def test_moving_phantom_is_refused():
    frames = capture(count=3)
    later = capture(pose=(np.eye(3), np.array([0.0, 0.0, 2.0])))
    frames['b'][2] = replace(later['b'][0], number=3)
    with pytest.raises(
        DataError,
        match='fluoroscope b: the phantom does not stand still, between frames 2 and 3 it '
        r'moves by \d+\.\d px',
    ):
        orientation_of_capture(frames, rig().phantom, calibrations())


def test_more_precise_targets_give_a_more_precise_orientation():
    """The phantom consists of the object points of the calibration."""
    targets = calibrated('a').targets
    sd = np.sqrt(np.trace(targets.covariance, axis1=1, axis2=2) / 3)
    assert np.median(sd) < 0.08
    better = Phantom(targets.target_id, targets.xyz_mm, sd)
    frames = {
        n: [
            replace(f, target_id=f.target_id[keep], uv=f.uv[keep])
            for f in of_one
            for keep in [np.isin(f.target_id, better.target_id)]
        ]
        for n, of_one in capture().items()
    }
    surveyed = orientation_of_capture(frames, rig().phantom, calibrations())
    learned = orientation_of_capture(frames, better, calibrations())
    assert np.trace(learned.covariance[:3, :3]) < np.trace(surveyed.covariance[:3, :3])
    np.testing.assert_allclose(learned.position_mm, surveyed.position_mm, atol=1.0)


@pytest.mark.parametrize(
    'change, sentence',
    [
        (
            lambda f, c: ({'a': f['a']}, c),
            'a rig needs two fluoroscopes or more, there are frames of a only',
        ),
        (lambda f, c: (f, {'a': c['a']}), 'there is no calibration of fluoroscope b, only of a'),
        (lambda f, c: ({**f, 'b': []}, c), 'fluoroscope b: there is no frame of the phantom'),
        (
            lambda f, c: ({**f, 'b': [replace(f['b'][0], image_size=(2048, 2048))]}, c),
            'fluoroscope b, frame 1: the image is 2048 x 2048 px, '
            'but the calibration is for 1024 x 1024 px',
        ),
        (
            lambda f, c: (
                {
                    **f,
                    'a': [
                        replace(f['a'][0], target_id=f['a'][0].target_id[:9], uv=f['a'][0].uv[:9])
                    ],
                },
                c,
            ),
            'fluoroscope a: the capture shows 9 targets of the phantom, 12 are needed',
        ),
        (
            lambda f, c: (
                {**f, 'a': [replace(f['a'][0], target_id=f['a'][0].target_id + 10**6)]},
                c,
            ),
            r'fluoroscope a, frame 1: target \d+ is not on the phantom',
        ),
    ],
)
def test_invalid_capture_is_refused_in_one_sentence(change, sentence):
    frames, held = change(capture(), calibrations())
    with pytest.raises(DataError, match=sentence):
        orientation_of_capture(frames, rig().phantom, held)


# ---- from the exposures of a calibration


def test_covariance_of_a_relative_orientation_against_monte_carlo():
    """In the datum of points at the place of the phantom; 12 of the 18 unknowns remain in a fixed
    frame.
    """
    squares = []
    points = np.random.default_rng(0).uniform(-100, 100, (60, 3)) + [0, 0, 1500]
    for seed in range(12):
        still = without_distortion(seed)
        held = drawn_calibrations(still, seed)
        frames = simulate_exposures(still, 4, seed, detection=Detection(false_matches=0.0)).frames
        found = orientation_and_scatter(frames, still.phantom, held)[0]
        a, b = still.fluoroscopes
        step = np.concatenate(
            [
                np.zeros(6),
                found.interior[0] - a.interior,
                found.position_mm[1] - a.rotation @ (b.position_mm - a.position_mm),
                vector_from_matrix(found.rotation[1] @ (b.rotation @ a.rotation.T).T),
                found.interior[1] - b.interior,
            ]
        )
        assert not found.position_mm[0].any() and np.array_equal(found.rotation[0], np.eye(3))
        s = datum_transformation(found, points)
        left = s @ step
        squares.append(
            left
            @ np.linalg.pinv(s @ found.covariance @ s.T, rcond=1e-12, hermitian=True)
            @ left
            / 12
        )
    assert np.mean(squares) == pytest.approx(1, abs=0.3)


def test_datum_removes_only_the_common_motion_of_points():
    """Distances keep their variances; centre and attitude of the points have none. Applying the
    transformation twice changes nothing.
    """
    found = orientation_and_scatter(exposures(), rig().phantom, calibrations())[0]
    rng = np.random.default_rng(1)
    points = rng.uniform(-80, 80, (40, 3)) + [0, 0, 1500]
    s = datum_transformation(found, points)
    np.testing.assert_allclose(s @ s, s, atol=1e-6)
    again = with_datum_of_points(with_datum_of_points(found, points), points).covariance
    np.testing.assert_allclose(again, with_datum_of_points(found, points).covariance, atol=1e-9)
    uv = np.stack(
        [
            project(np.broadcast_to(r, (40, 3, 3)), np.broadcast_to(t, (40, 3)), points, i)
            for r, t, i in zip(found.rotation, found.position_mm, found.interior)
        ]
    )
    step = 1e-3 * found.covariance_root() @ rng.normal(size=18)
    ways = [moved_orientation(found, change) for change in (step, s @ step)]
    sigma = np.full((2, 40), 0.1)
    moved = [Intersector(way, None).intersect(uv, sigma).xyz_mm for way in ways]
    distance = [np.linalg.norm(m[:, None] - m, axis=2) for m in moved]
    np.testing.assert_allclose(distance[0], distance[1], atol=1e-7)
    off = moved[1] - points
    arm = points - points.mean(axis=0)
    far = np.abs(moved[0] - points).max()
    assert (
        np.abs(off.mean(axis=0)).max() < 1e-3 * far
        and np.abs(np.cross(arm, off).mean(axis=0)).max() < 0.1 * far
    )


def moved_orientation(orientation, step):
    """The orientation after a change of its unknowns by step (18,)."""
    step = step.reshape(-1, 9)
    return replace(
        orientation,
        position_mm=orientation.position_mm + step[:, :3],
        rotation=matrix_from_vector(step[:, 3:6]) @ orientation.rotation,
        interior=orientation.interior + step[:, 6:],
    )


def test_orientation_of_the_exposures_of_a_calibration():
    """The scale is that of the phantom, and the rays of both views meet."""
    found = orientation_and_scatter(exposures(), rig().phantom, calibrations())[0]
    assert (
        found.source == 'joint calibration'
        and found.frame_id == 'a_optical'
        and found.exposures == 15
    )
    a, b = rig().fluoroscopes
    length = np.linalg.norm(b.position_mm - a.position_mm)
    assert np.linalg.norm(found.position_mm[1]) == pytest.approx(length, abs=1.0)
    tracking = simulate_tracking(rig(), 0.5, 40, seed=2)
    points = [
        f.points
        for f in RigRecording(tracking.frames, calibrations(), Intersector(found)).reconstruct()
    ]
    assert np.mean([p.status == OK for p in points]) > 0.99
    assert 0.6 < np.mean([p.standardised**2 for p in points]) < 1.4
    apart = np.linalg.norm(np.diff([p.xyz_mm for p in points], axis=1), axis=2)
    true = np.linalg.norm(np.diff(tracking.points_mm, axis=1), axis=2)
    assert np.nanmean(apart - true) == pytest.approx(0, abs=0.03)


def test_exposures_that_do_not_belong_together_are_refused():
    frames = exposures()
    apart = {'a': frames['a'], 'b': [replace(f, number=f.number + 100) for f in frames['b']]}
    with pytest.raises(
        DataError,
        match='fluoroscopes a and b: no exposures have the same number, so their relative '
        'orientation is unknown',
    ):
        orientation_and_scatter(apart, rig().phantom, calibrations())[0]


# ---- the file


@pytest.fixture(scope='module')
def found():
    """An orientation of the test rig."""
    return orientation_of_capture(capture(), rig().phantom, calibrations())


def test_file_round_trip_is_exact(tmp_path, found):
    """The orientation and the bytes of the file are the same after reading and writing."""
    path = save_orientation(tmp_path / 'new' / 'folder', found)
    content = Path(path).read_bytes()
    again = load_orientation(path)
    for name in found.__dataclass_fields__:
        assert np.array_equal(getattr(again, name), getattr(found, name)), name
    assert Path(save_orientation(tmp_path, again)).read_bytes() == content
    with np.load(path, allow_pickle=False) as file:
        assert (
            file.files == ['format_version', *(field.name for field in ORIENTATION_FIELDS)]
            and file['format_version'] == 1
        )


@pytest.mark.parametrize(
    'change, sentence',
    [
        ({'format_version': np.array(7)}, 'layout version 7, this program reads version 1'),
        (
            {'format_version': None},
            'this is not a rig orientation file, it has no array format_version',
        ),
        ({'rotation': None}, 'the rig orientation has no array rotation'),
        (
            {'interior': np.zeros((2, 3), dtype=np.float32)},
            'the array interior has dtype float32, not float64',
        ),
        (
            {'interior': np.array([object()], dtype=object)},
            'the array interior does not contain plain numbers or text',
        ),
        (
            {'position_mm': np.zeros((2, 2))},
            r'the array position_mm has shape \(2, 2\), not \(F, 3\)',
        ),
        (
            {'position_mm': np.zeros((3, 3))},
            r'rig orientation: position_mm has shape \(3, 3\), not \(2, 3\)',
        ),
        (
            {'rotation': np.zeros((2, 3, 3))},
            'the rotation of fluoroscope a is not a rotation matrix',
        ),
        ({'covariance': np.full((18, 18), np.nan)}, 'the array covariance holds nan'),
        ({'fluoroscope': np.array(['a', '../b'])}, "the fluoroscope is called '../b'"),
        ({'position_mm': np.zeros((2, 3))}, 'the content does not belong to its orientation_id'),
    ],
)
def test_invalid_files_are_refused_in_one_sentence(tmp_path, found, change, sentence):
    path = save_orientation(tmp_path, found)
    with np.load(path) as file:
        arrays = {**file, **change}
    np.savez(path, **{name: array for name, array in arrays.items() if array is not None})
    with pytest.raises(DataError, match=sentence):
        load_orientation(path)


def test_damaged_files_are_refused(tmp_path, found):
    """A wrong byte or a truncation is found anywhere; a failed write keeps the earlier file."""
    path = save_orientation(tmp_path, found)
    content = pathlib.Path(path).read_bytes()
    rng = np.random.default_rng(0)
    for place in rng.integers(0, len(content), 60):
        damaged = bytearray(content)
        damaged[place] ^= 0x55
        pathlib.Path(path).write_bytes(bytes(damaged))
        try:
            assert (
                load_orientation(path).orientation_id == found.orientation_id
            )  # a byte that no value is read from
        except DataError as error:
            assert str(path) in str(error)
    for size in (0, 10, len(content) // 2, len(content) - 1):
        pathlib.Path(path).write_bytes(content[:size])
        with pytest.raises(DataError):
            load_orientation(path)
    with pytest.raises(DataError, match='there is no such file'):
        load_orientation(tmp_path / 'missing.npz')
    pathlib.Path(path).write_bytes(content)
    with pytest.raises(DataError, match="the fluoroscope is called 'a/b'"):
        save_orientation(tmp_path, replace(found, fluoroscopes=('a/b', 'b')))
    assert pathlib.Path(path).read_bytes() == content


# ---- the commands


@pytest.fixture(scope='module')
def folder(tmp_path_factory):
    """Calibrations of both fluoroscopes with an orientation, and a bag of the phantom standing in
    the rig frame.
    """
    path = tmp_path_factory.mktemp('orient')
    assert run('simulate', '--out', path, '--seconds', 0.1) == 0
    for calibration in calibrations().values():
        save_calibration(path / 'result', calibration)
    save_orientation(
        path / 'result', orientation_and_scatter(exposures(), rig().phantom, calibrations())[0]
    )
    write_bag(path / 'capture', capture(count=3))
    return path


def rows_of(path):
    with open(path, newline='') as file:
        return list(csv.DictReader(file))


def said(capsys, *arguments):
    """The one sentence with which a command fails."""
    capsys.readouterr()
    assert run(*arguments) == 1
    out, err = capsys.readouterr()
    assert out == '' and err.count('\n') == 1 and err.startswith(f'fluoro-calib {arguments[0]}: ')
    return err


def test_calibrate_writes_an_orientation(folder, tmp_path, capsys):
    """Exposures of one group give an orientation; a capture whose calibrations did not change
    keeps its orientation.
    """
    assert run('simulate', '--out', tmp_path / 'rig', '--exposures', 4, '--seconds', 0) == 0
    write = (
        'calibrate',
        tmp_path / 'rig' / 'calibration',
        '--phantom',
        folder / 'phantom.csv',
        '--model',
        'none',
        '--fast',
    )
    path = tmp_path / 'both' / 'rig_orientation.npz'
    assert run(*write, '--out', tmp_path / 'one', '--fluoroscopes', 'a') == 0
    assert not (tmp_path / 'one' / 'rig_orientation.npz').exists()
    assert run(*write, '--out', tmp_path / 'both', '--joint') == 0
    found = load_orientation(path)
    assert (
        found.frame_id == 'a_optical'
        and found.source == 'joint calibration'
        and found.exposures == 4
    )
    assert (
        run(
            'orient',
            folder / 'capture',
            '--phantom',
            folder / 'phantom.csv',
            '--calibration',
            tmp_path / 'both',
        )
        == 0
    )
    captured = path.read_bytes()
    assert run(*write, '--out', tmp_path / 'both', '--joint') == 0
    assert path.read_bytes() == captured
    assert (
        run(*write, '--out', tmp_path / 'both') == 0
    )  # after new calibrations, the orientation by the capture is invalid
    assert load_orientation(path).source == 'joint calibration'
    capsys.readouterr()
    table = tmp_path / 'apart.csv'
    write_observations_csv(
        table,
        [
            f if n == 'a' else replace(f, number=f.number + 50)
            for n, of_one in exposures(4).items()
            for f in of_one
        ],
    )
    assert (
        run(
            'calibrate',
            table,
            *write[2:],
            '--image-size',
            '1024x1024',
            '--out',
            tmp_path / 'apart',
        )
        == 0
    )
    assert (
        'no orientation of the rig: fluoroscopes a and b: no exposures have the same'
        in capsys.readouterr().err
    )
    assert not (tmp_path / 'apart' / 'rig_orientation.npz').exists()


def test_orient_keeps_the_orientation_that_a_doubtful_one_replaces(folder, tmp_path):
    result = tmp_path / 'result'
    shutil.copytree(folder / 'result', result)
    path = result / 'rig_orientation.npz'
    previous = result / 'rig_orientation.npz.previous'
    orient = ('--phantom', folder / 'phantom.csv', '--calibration', result)
    assert run('orient', folder / 'capture', *orient) == 0
    good = path.read_bytes()
    frames = capture(count=1)
    (frame,) = frames['b']
    uv = frame.uv.copy()
    uv[::3] += np.random.default_rng(1).normal(0, 6, uv[::3].shape)
    write_bag(tmp_path / 'doubtful', {**frames, 'b': [replace(frame, uv=uv)]})
    for more, status in ((), 3), (('--exit-zero',), 0):
        assert run('orient', tmp_path / 'doubtful', *orient, *more) == status
        assert path.read_bytes() != good == previous.read_bytes()


def test_orient_and_reconstruct(folder, tmp_path, capsys):
    """Points from a bag, in the frame of the standing phantom, agree with the truth within their
    standard deviations.
    """
    result = folder / 'result'
    out = tmp_path / 'points.csv'
    assert (
        run(
            'orient',
            folder / 'capture',
            '--phantom',
            folder / 'phantom.csv',
            '--calibration',
            result,
            '--frame-id',
            'lab',
            '--json',
        )
        == 0
    )
    document = json.loads(capsys.readouterr().out)
    assert (
        document['frame_id'] == 'lab'
        and document['exposures'] == 3
        and document['source'] == 'capture'
    )
    assert document['rms_mm'] < 0.3 and document['targets'] > 30
    assert (
        load_orientation(result / 'rig_orientation.npz').orientation_id
        == document['orientation_id']
    )

    assert (
        run('reconstruct', folder / 'tracking', '--calibration', result, '--out', out, '--json')
        == 0
    )
    document = json.loads(capsys.readouterr().out)
    rows = rows_of(out)
    assert (
        ','.join(rows[0]) == 'frame,stamp_ns,target_id,x,y,z,sd_x,sd_y,sd_z,residual,rays,status'
    )
    assert len(rows) == document['points'] == 24 * document['frames'] and document['unpaired'] == {
        'a': 0,
        'b': 0,
    }
    assert (
        document['status']['OK'] == sum(row['status'] == 'OK' for row in rows) > 0.95 * len(rows)
    )
    truth = {
        (row['frame'], row['target_id']): row for row in rows_of(folder / 'truth' / 'markers.csv')
    }
    xyz = [[float(row[c]) for c in 'xyz'] for row in rows if row['status'] == 'OK']
    sd = [[float(row['sd_' + c]) for c in 'xyz'] for row in rows if row['status'] == 'OK']
    columns = [next(c for c in next(iter(truth.values())) if c.startswith(axis)) for axis in 'xyz']
    true = [
        [float(truth[row['frame'], row['target_id']][c]) for c in columns]
        for row in rows
        if row['status'] == 'OK'
    ]
    assert 0.6 < np.mean(((np.array(xyz) - true) / sd) ** 2) < 1.6


def test_reconstruct_reports_what_is_missing(folder, tmp_path, capsys):
    """Frames and targets without partner and false matches are counted; their cells are empty."""
    tracking = simulate_tracking(rig(), 0.05, 60, seed=1)
    frames = {name: list(of_one) for name, of_one in tracking.frames.items()}
    first = frames['b'][0]
    uv = first.uv[1:].copy()
    uv[0] += 40
    frames['b'] = [replace(first, target_id=first.target_id[1:], uv=uv), *frames['b'][2:]]
    write_bag(tmp_path / 'bag', frames)
    assert (
        run(
            'reconstruct',
            tmp_path / 'bag',
            '--calibration',
            folder / 'result',
            '--out',
            tmp_path / 'out.csv',
        )
        == 0
    )
    out, err = capsys.readouterr()
    assert 'frames without partner of the other fluoroscopes, not used: a 1' in err
    assert '48 points of 2 frames' in out and '1 SINGLE_VIEW' in out
    rows = rows_of(tmp_path / 'out.csv')
    assert (
        rows[0]['status'] == 'SINGLE_VIEW'
        and rows[0]['x'] == rows[0]['sd_z'] == rows[0]['residual'] == ''
    )
    assert (
        rows[1]['status'] == 'REJECTED' and rows[1]['x'] == '' and float(rows[1]['residual']) > 4
    )
    assert (
        run(
            'reconstruct',
            tmp_path / 'bag',
            '--calibration',
            folder / 'result',
            '--out',
            tmp_path / 'out.csv',
            '--reject',
            1000,
            '--pair-by',
            'stamp',
        )
        == 0
    )
    assert rows_of(tmp_path / 'out.csv')[1]['status'] in ('OK', 'OUTSIDE')


def test_reconstruct_refuses_invalid_input_in_one_sentence(folder, tmp_path, capsys):
    """The command writes no file."""
    result = folder / 'result'
    out = tmp_path / 'out.csv'
    other = tmp_path / 'other'
    for calibration in calibrations().values():
        save_calibration(other, replace(calibration, source_digest='another'))
    source = ('reconstruct', folder / 'tracking', '--calibration')
    assert 'the orientation has to be determined again' in said(
        capsys, *source, other, '--out', out, '--orientation', result / 'rig_orientation.npz'
    )
    message = said(capsys, *source, other, '--out', out)
    assert f'{other}: no orientation of the rig was determined' in message
    assert 'fluoro-calib orient' in message
    (other / 'result.json').write_text('{"rig_note": "no orientation of the rig: why"}')
    assert f'{other}: no orientation of the rig: why: cal' in said(
        capsys, *source, other, '--out', out
    )
    assert 'x.npz: there is no such file' in said(
        capsys, *source, other, '--out', out, '--orientation', tmp_path / 'x.npz'
    )
    assert 'are needed' in said(capsys, *source, result, '--out', out, '--fluoroscopes', 'a')
    assert "there is no fluoroscope 'c'" in said(
        capsys, *source, result, '--out', out, '--fluoroscopes', 'a,c'
    )
    table = tmp_path / 'points.csv'
    table.write_text('fluoroscope,exposure,target_id,u,v\na,1,1,500,500\nb,2,1,500,500\n')
    source = ('reconstruct', table, '--calibration', result, '--out', out)
    assert 'no frames of a and b belong together by frame_number' in said(capsys, *source)
    assert 'the recording does not contain the times of its exposures' in said(
        capsys, *source, '--pair-by', 'stamp'
    )
    assert not out.exists()
    table.write_text('fluoroscope,exposure,target_id,u,v\na,1,1,500,500\nb,1,1,500,500\n')
    assert 'the image is 800 x 800 px, but the calibration is for 1024 x 1024 px' in said(
        capsys, *source, '--image-size', '800x800'
    )
    assert run(*source) == 0 and len(rows_of(out)) == 1


def test_orient_refuses_invalid_input_in_one_sentence(folder, capsys):
    """The existing orientation is kept."""
    result = folder / 'result'
    before = (result / 'rig_orientation.npz').read_bytes()
    given = ('--phantom', folder / 'phantom.csv', '--calibration', result)
    assert 'the phantom does not stand still, between frames 1 and 2' in said(
        capsys, 'orient', folder / 'calibration', '--exposures', '1-2', *given
    )
    assert 'no fluoroscope has the exposures 99 of --exposures' in said(
        capsys, 'orient', folder / 'calibration', '--exposures', '99', *given
    )
    assert 'is not on the phantom' in said(capsys, 'orient', folder / 'tracking', *given)
    assert run('orient', folder / 'calibration', '--exposures', '2-x', *given) == 2
    assert (result / 'rig_orientation.npz').read_bytes() == before
    capsys.readouterr()


def test_one_exposure_can_define_the_rig_frame(folder, tmp_path):
    """The rig frame is that of the phantom in this exposure."""
    copy = tmp_path / 'result'
    copy.mkdir()
    for path in (folder / 'result').glob('*.calibration.npz'):
        (copy / path.name).write_bytes(path.read_bytes())
    assert (
        run(
            'orient',
            folder / 'calibration.csv',
            '--exposures',
            '4',
            '--phantom',
            folder / 'phantom.csv',
            '--calibration',
            copy,
        )
        == 0
    )
    found = load_orientation(copy / 'rig_orientation.npz')
    rotation, shift = phantom_poses(np.random.default_rng([1, 2]), 15)[3]
    true = [rotation.T @ (f.position_mm - shift) for f in rig().fluoroscopes]
    np.testing.assert_allclose(found.position_mm, true, atol=3.0)
