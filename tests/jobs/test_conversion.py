# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Conversion of small sources with known content: what is kept, corrected, and omitted."""

import functools
import json
from dataclasses import replace

import numpy as np
import pytest
import rigs

from fluoro_calib_ros.errors import DataError
from fluoro_calib_ros.exposures.angles import AngleOptions
from fluoro_calib_ros.exposures.frame import Frame
from fluoro_calib_ros.io.bags.mcap_file import is_bag
from fluoro_calib_ros.io.bags.writer import write_bag
from fluoro_calib_ros.io.calibration import RESULT_NAME, save_calibration, save_orientation
from fluoro_calib_ros.io.formats.content import FileSettings
from fluoro_calib_ros.io.observations import read_observations_csv, write_observations_csv
from fluoro_calib_ros.jobs.conversion import (
    ConversionRequest,
    convert,
    is_result_folder,
    result_content,
    stations_of,
)
from fluoro_calib_ros.jobs.sources import read_calibrated_source
from fluoro_calib_ros.photogrammetry.rotations import matrix_from_quaternion

SIZE = (320, 240)
TURN = [0.5, 0.5, -0.5, 0.5]  # quaternion w, x, y, z of a third of a full turn
PLACES = {3: [10.0, 20, -900], 7: [-5.0, 0, -800]}  # position [mm] of the source of a, by exposure


@functools.cache
def calibration(name):
    """A fluoroscope with a distortion of a few pixels."""
    return rigs.smooth_pincushion(name, SIZE)


def frames(angle=None):
    """Three exposures of each of two fluoroscopes."""
    rng = np.random.default_rng(1)
    ids = np.arange(12) + 1
    return {
        name: [
            Frame(name, n, ids, rng.uniform(20, 220, (12, 2)), SIZE, np.full(12, 0.3), angle=angle)
            for n in (2, 3, 7)
        ]
        for name in 'ab'
    }


@pytest.fixture
def table(tmp_path):
    path = tmp_path / 'seen.csv'
    write_observations_csv(path, frames())
    return path


@pytest.fixture
def result(tmp_path):
    """A result folder of a and b with exterior orientations, for which a has observations."""
    folder = tmp_path / 'result'
    for name in 'ab':
        save_calibration(folder, calibration(name))
    entries = {
        n: {'exposure': n, 'quaternion_wxyz': TURN, 'position_mm': place}
        for n, place in PLACES.items()
    }
    document = {
        'fluoroscopes': {
            'a': {'exposures': [entries[7], entries[3]]},
            'b': {'exposures': [entries[3]]},
        }
    }
    (folder / RESULT_NAME).write_text(json.dumps(document))
    other = [replace(frame, fluoroscope='z') for frame in frames()['b']]
    write_observations_csv(folder / 'observations.csv', {'a': frames()['a'], 'z': other})
    return folder


def request(source, kind, out, size=SIZE, **more):
    return ConversionRequest(source, kind, out, settings=FileSettings(image_size=size), **more)


def points_of(path):
    return {
        (name, frame.number): (frame.target_id.tolist(), frame.uv)
        for name, found in read_observations_csv(path, SIZE).items()
        for frame in found
    }


def test_table_and_bag_hold_the_same_points(table, tmp_path):
    bag = tmp_path / 'bag'
    assert convert(request(table, 'bag', bag)).paths == (str(bag),)
    again = tmp_path / 'again.csv'
    written = convert(request(bag, 'observations', again))
    assert list(written.paths) == [str(again)] and written.notes == ()
    before, after = points_of(table), points_of(again)
    assert before.keys() == after.keys() and len(before) == 6
    for key, (ids, uv) in before.items():
        assert after[key][0] == ids
        np.testing.assert_allclose(after[key][1], uv, atol=1e-9)


def test_only_the_fluoroscopes_that_are_asked_for_are_written(table, tmp_path):
    out = tmp_path / 'of_b.csv'
    convert(request(table, 'observations', out, fluoroscopes=('b',)))
    assert {name for name, _ in points_of(out)} == {'b'}
    with pytest.raises(DataError, match="no fluoroscope 'c', only a, b"):
        convert(request(table, 'observations', out, fluoroscopes=('b', 'c')))


def test_corrected_points_are_those_of_the_calibration(table, result, tmp_path):
    """The image size is taken from the calibration; sigma grows by that of the correction."""
    out = tmp_path / 'corrected.csv'
    given = request(table, 'observations', out, None, calibration=result, corrected=True)
    assert convert(given).notes == ()
    seen = frames()
    for (name, number), (_, uv) in points_of(out).items():
        one = next(frame for frame in seen[name] if frame.number == number)
        wanted = calibration(name).correct(one.uv, one.sigma)
        np.testing.assert_allclose(uv, wanted.uv, atol=1e-6)
        assert np.abs(uv - one.uv).max() > 0.1
    with pytest.raises(DataError, match='corrected'):
        convert(replace(given, source=out, out=tmp_path / 'twice.csv'))
    (result / 'b.calibration.npz').unlink()
    with pytest.raises(DataError, match="no calibration of fluoroscope 'b', only of a"):
        convert(given)


def test_angles_that_a_format_does_not_hold_are_told(tmp_path):
    turned = tmp_path / 'turned.csv'
    write_observations_csv(turned, frames(angle=0.25))
    for kind, count in (('observations', 0), ('xmalab2d', 1)):
        written = convert(request(turned, kind, tmp_path / kind, fluoroscopes=('a',)))
        assert len([note for note in written.notes if 'angles of the C-arm' in note]) == count
    plain = tmp_path / 'plain.csv'
    write_observations_csv(plain, frames())
    written = convert(request(plain, 'xmalab2d', tmp_path / 'p', fluoroscopes=('a',)))
    assert not any('angle' in note for note in written.notes)


def test_what_belongs_to_another_kind_of_source_is_refused(table, result, tmp_path):
    out = tmp_path / 'out.csv'
    with pytest.raises(DataError, match='--exposure is for a result folder'):
        convert(request(table, 'observations', out, exposure=3))
    joint = AngleOptions(angle_joint='carm')
    with pytest.raises(DataError, match='needs a bag'):
        convert(request(table, 'observations', out, angles=joint))
    (result / 'observations.csv').unlink()
    with pytest.raises(DataError, match='bag as rosbag2 writes it needs image points'):
        convert(request(result, 'bag', tmp_path / 'bag'))
    assert not out.exists() and not (tmp_path / 'bag').exists()


def test_folders_are_told_apart_by_their_files(result, tmp_path):
    assert is_result_folder(result) and not is_bag(result)
    bag = tmp_path / 'bag'
    write_bag(bag, frames())
    assert not is_result_folder(bag) and is_bag(bag)
    (bag / 'metadata.yaml').unlink()
    assert is_bag(bag)  # the mcap file is enough
    file = next(bag.iterdir())
    assert not is_result_folder(file) and is_bag(file)
    (tmp_path / 'empty').mkdir()
    assert not is_bag(tmp_path / 'empty') and not is_result_folder(tmp_path / 'empty')


# ---- result folders


def content(folder, *wanted, **more):
    return result_content(folder, FileSettings(wanted=wanted), **more)


def test_stations_of_a_result_are_its_exterior_orientations(result):
    found = {(s.fluoroscope, s.exposure): s for s in stations_of(result / RESULT_NAME)}
    assert list(found) == [('a', 7), ('a', 3), ('b', 3)]
    assert found['a', 7].position_mm.tolist() == PLACES[7]
    np.testing.assert_allclose(
        found['b', 3].rotation, matrix_from_quaternion(np.array(TURN)), atol=1e-12
    )
    document = json.loads((result / RESULT_NAME).read_text())
    document['fluoroscopes']['b']['exposures'][0]['quaternion_wxyz'] = [0.5, 0.5, 0.5, 0.49]
    (result / RESULT_NAME).write_text(json.dumps(document))
    with pytest.raises(DataError, match='not the result of a calibration'):
        list(stations_of(result / RESULT_NAME))


def test_cameras_of_a_result_stand_as_in_an_exposure_or_in_the_rig(result):
    plain = content(result, 'cameras').cameras
    xp, yp, c = calibration('a').interior
    for camera, name in zip(plain, 'ab'):
        assert (camera.name, camera.image_size) == (name, SIZE)
        assert camera.matrix.tolist() == [[c, 0, xp], [0, c, yp], [0, 0, 1]]
    of_exposure = content(result, 'cameras', exposure=7).cameras
    turn = matrix_from_quaternion(np.array(TURN))
    np.testing.assert_allclose(of_exposure[0].rotation, turn, atol=1e-12)
    np.testing.assert_allclose(of_exposure[0].translation_mm, -turn @ PLACES[7], atol=1e-9)
    assert of_exposure[1].rotation is None
    with pytest.raises(DataError, match='no exposure 5'):
        content(result, 'cameras', exposure=5)
    calibrations = {name: calibration(name) for name in 'ab'}
    rig = rigs.true_orientation(rigs.rig().fluoroscopes, calibrations)
    save_orientation(result, rig)
    for camera, rotation in zip(content(result, 'cameras').cameras, rig.rotation):
        np.testing.assert_allclose(camera.rotation, rotation, atol=1e-12)
    save_orientation(result, replace(rig, calibration_ids=('other', 'ids')))
    with pytest.raises(DataError, match='belongs to other calibrations'):
        content(result, 'cameras')


def test_poses_of_the_phantom_are_in_the_order_of_the_exposures(result):
    """They refer to the optical frame of the first fluoroscope or, if oriented, to the rig."""
    turn = matrix_from_quaternion(np.array(TURN))
    bodies = content(result, 'bodies').bodies
    assert bodies.frame.tolist() == [3, 7]
    for row, number in enumerate((3, 7)):
        np.testing.assert_allclose(bodies.rotation[row, 0], turn, atol=1e-12)
        np.testing.assert_allclose(
            bodies.translation_mm[row, 0], -turn @ PLACES[number], atol=1e-9
        )
    calibrations = {name: calibration(name) for name in 'ab'}
    rig = rigs.true_orientation(rigs.rig().fluoroscopes, calibrations)
    save_orientation(result, rig)
    bodies = content(result, 'bodies').bodies
    to_rig = rig.rotation[0].T
    for row, number in enumerate((3, 7)):
        np.testing.assert_allclose(bodies.rotation[row, 0], to_rig @ turn, atol=1e-12)
        wanted = rig.position_mm[0] - to_rig @ turn @ PLACES[number]
        np.testing.assert_allclose(bodies.translation_mm[row, 0], wanted, atol=1e-9)


def test_observations_of_a_result_are_those_of_its_calibrations(result):
    found = content(result, 'observations').observations
    assert list(found) == ['a'] and [frame.number for frame in found['a']] == [2, 3, 7]
    assert {frame.image_size for frame in found['a']} == {SIZE}
    assert content(result, 'cameras').observations is None
    assert content(result, 'survey').survey is None


def test_lookup_of_a_correction_gives_the_observed_pixel(result):
    found = content(result, 'lookups').lookups
    assert list(found) == ['a', 'b']
    only = result_content(result, FileSettings(wanted=('lookups',), fluoroscopes=('b',)))
    assert list(only.lookups) == ['b'] and only.notes == ()
    lookup = found['a']
    assert lookup.shape == (2, SIZE[1], SIZE[0])
    v, u = 60, 250
    corrected = calibration('a').correct(lookup[:, v, u][None].astype(float)).uv
    np.testing.assert_allclose(corrected, [[u, v]], atol=0.02)


def test_lookup_at_an_unknown_angle_is_told(result):
    save_calibration(result, rigs.turning(calibration('b')))
    (note,) = content(result, 'lookups').notes
    assert ' b depend' in note
    assert content(result, 'lookups', angle=0.5).notes == ()


TALL = (320, 300)  # image size of the second of two different detectors [px]


@pytest.fixture
def different(tmp_path):
    """Result folder of fluoroscopes with detectors of different size, and frames of theirs."""
    for name, size in (('a', SIZE), ('b', TALL)):
        save_calibration(tmp_path / 'different', rigs.smooth_pincushion(name, size))
    uv = np.array([[100.0, 90], [200, 280]])
    views = {'a': Frame('a', 1, np.array([1]), uv[:1], SIZE)}
    views['b'] = Frame('b', 1, np.array([1, 2]), uv, TALL)
    return tmp_path / 'different', views


def test_file_without_image_size_has_that_of_each_calibration(different, tmp_path):
    folder, views = different
    write_observations_csv(tmp_path / 'seen.csv', views.values())
    recording, _ = read_calibrated_source(tmp_path / 'seen.csv', folder)
    assert recording.notes == ()
    for name, view in views.items():
        (frame,) = recording.frames[name]
        assert frame.image_size == view.image_size and frame.uv.tolist() == view.uv.tolist()
    write_observations_csv(tmp_path / 'z.csv', [replace(views['b'], fluoroscope='z')])
    with pytest.raises(DataError, match="no calibration of fluoroscope 'z', only of a, b, "):
        read_calibrated_source(tmp_path / 'z.csv', folder)


def test_rows_from_the_bottom_count_from_that_of_each_detector(different, tmp_path):
    folder, views = different
    rows = [[f'm{i}_cam{c}_{x}' for i in (1, 2) for c in (1, 2) for x in 'XY'], []]
    for row in (0, 1):
        for view in views.values():
            cells = ['NaN', 'NaN']
            if row < len(view.uv):
                u, v = view.uv[row]
                cells = [str(u), str(view.image_size[1] - 1 - v)]
            rows[1] += cells
    (tmp_path / 'xma.csv').write_text('\n'.join(map(','.join, rows)) + '\n')
    settings = FileSettings(y_up=True)
    options = {'calibration': folder, 'fluoroscopes': ('a', 'b'), 'settings': settings}
    convert(
        ConversionRequest(tmp_path / 'xma.csv', 'observations', tmp_path / 'seen.csv', **options)
    )
    recording, _ = read_calibrated_source(tmp_path / 'seen.csv', folder)
    for name, view in views.items():
        np.testing.assert_allclose(recording.frames[name][0].uv, view.uv, atol=1e-9)
