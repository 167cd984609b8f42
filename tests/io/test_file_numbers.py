# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Numbers and refusals of files at their limits, with the smallest content that reaches them."""

import io
import json
import struct
from types import SimpleNamespace as Fake

import numpy as np
import pytest

from fluoro_calib_ros.bodies.body import BodyPoses, PoseStatus
from fluoro_calib_ros.correction.fluoroscope_calibration import digest_of_sources
from fluoro_calib_ros.errors import DataError
from fluoro_calib_ros.estimation.options import CalibrationOptions, CalibrationRequest
from fluoro_calib_ros.exposures.frame import Frame
from fluoro_calib_ros.exposures.names import Names
from fluoro_calib_ros.exposures.phantom import Phantom
from fluoro_calib_ros.images.codec import decode
from fluoro_calib_ros.io import image_reading, image_writing, recordings
from fluoro_calib_ros.io.bodies import COLUMNS, POINT_COLUMNS, point_table, pose_table
from fluoro_calib_ros.io.calibration_request import (
    VERSION,
    read_options,
    read_request,
    write_request,
)
from fluoro_calib_ros.io.observations import correct_points, points_of_frames
from fluoro_calib_ros.io.recordings import DicomHeader, _cine_rate, _dicom_rate, _grey
from fluoro_calib_ros.io.result_document import drift_document
from fluoro_calib_ros.reconstruction.intersection import OK, REJECTED, STATUS_NAMES


@pytest.mark.parametrize(
    ('changes', 'is_wrong'),
    [
        ({}, False),
        ({'joint': 1}, True),
        ({'joint': None}, True),
        ({'principal_distance': 900}, False),
        ({'principal_distance': 0}, True),
        ({'principal_distance': '9'}, True),
        ({'principal_distance': True}, True),
        ({'format_version': VERSION + 1}, True),
        ({'options': {'modl': 'knn'}}, True),
        ({'options': {'model': 'nothing'}}, True),
    ],
)
def test_options_of_a_calibration_are_read_or_refused(tmp_path, changes, is_wrong):
    document = {
        'format_version': VERSION,
        'options': {'model': 'knn'},
        'joint': True,
        'principal_distance': None,
        **changes,
    }
    path = tmp_path / 'options.json'
    path.write_text(json.dumps(document))
    if is_wrong:
        with pytest.raises(DataError):
            read_options(path)
        return
    options, joint, distance = read_options(path)
    assert (options.model, joint, distance) == ('knn', True, document['principal_distance'])


class Video:
    """A video of some images, which records its release."""

    def __init__(self, images):
        self.images = list(images)
        self.released = False

    def read(self):
        return (True, self.images.pop(0)) if self.images else (False, None)

    def release(self):
        self.released = True


@pytest.mark.parametrize(
    ('number', 'count', 'is_cut'),
    [(5, 5, False), (4, 5, False), (3, 5, True), (0, 0, True), (98, 100, False), (2, 1, False)],
)
def test_video_may_lack_its_last_image(monkeypatch, number, count, is_cut):
    monkeypatch.setattr(image_reading, 'FRAME_COUNT_TOLERANCE', 0.01)
    video = Video(np.full((2, 3), k, np.uint8) for k in range(number))
    images = image_reading._read_frames('v.avi', video, count)
    if is_cut:
        with pytest.raises(DataError, match=f'only {number} of {count}'):
            list(images)
    else:
        found = list(images)
        assert [image[0, 0] for _, image in found] == list(range(number))
        assert found[-1][0] == f'v.avi, frame {number}'
    assert video.released


def setup(rate, length, exact):
    """Return the setup of a cine file: rate, mark and length of the extension, and exact rate."""
    content = bytearray(recordings.FRAME_RATE + 8)
    struct.pack_into('<H', content, 0, rate)
    struct.pack_into('<2sH', content, recordings.SETUP_MARK, b'ST', length)
    struct.pack_into('<I', content, recordings.FRAME_RATE, exact)
    return io.BytesIO(bytes(3) + bytes(content))


@pytest.mark.parametrize(
    ('rate', 'more', 'exact', 'found'),
    [(250, 4, 1000, 1000.0), (250, 3, 1000, 250.0), (250, 4, 0, 250.0), (0, 4, 500, 500.0)],
)
def test_rate_of_a_cine_file_is_the_exact_one_where_it_has_one(rate, more, exact, found):
    assert _cine_rate(setup(rate, recordings.FRAME_RATE + more, exact), 3) == found


def test_cine_file_without_a_rate_is_refused():
    with pytest.raises(DataError, match='rate'):
        _cine_rate(setup(0, 0, 500), 3)


@pytest.mark.parametrize(
    ('values', 'rate'),
    [
        ({'FrameTime': 4.0, 'CineRate': 99}, 250.0),
        ({'FrameTime': 0, 'CineRate': 30}, 30.0),
        ({'RecommendedDisplayFrameRate': 15}, 15.0),
        ({}, None),
        ({'CineRate': 1e6}, None),
    ],
)
def test_rate_of_a_dicom_file(values, rate):
    assert _dicom_rate(values) == rate


def test_grey_values_of_a_dicom_file_begin_at_zero_and_rise_with_brightness():
    def header(**changes):
        values = {'count': 1, 'bits': 10, 'signed': False, 'inverted': False, 'shape': (1, 2)}
        return DicomHeader(**{**values, 'frame_rate': None, **changes})

    frame = np.array([[3, 0xFC05]], np.uint16)
    assert _grey(frame, header()).tolist() == [[3, 5]]
    assert _grey(frame, header(inverted=True)).tolist() == [[1020, 1018]]
    signed = np.array([[-512, 511]], np.int16)
    assert _grey(signed, header(signed=True)).tolist() == [[0, 1023]]
    with pytest.raises(ValueError):
        _grey(frame.T, header())


def test_empty_image_and_output_that_is_a_folder_are_refused(tmp_path):
    with pytest.raises(DataError, match='empty'):
        decode(b'')
    source = tmp_path / 'a.png'
    source.touch()
    out = tmp_path / 'out'
    out.mkdir()
    with pytest.raises(DataError, match='folder, but'):
        image_writing.correct_images(source, out, None)


def state(**changes):
    names = (
        *('fluoroscope', 'place', 'area', 'size', 'sd', 'direction', 'against', 'source'),
        *('evidence', 'threshold_warn', 'threshold_error', 'observations'),
    )
    return Fake(**{**{name: f'the {name}' for name in names}, **changes})


def test_drift_of_a_recording_has_its_state_and_times():
    finding = Fake(kind=Fake(value='image_drift'))
    verdict = Fake(
        finding=finding,
        level='error',
        message='m',
        level_at_end='warn',
        watched_s=7.0,
        state=state(),
        found_ns=5 * 10**9,
        began_ns=None,
    )
    found = drift_document(verdict, 2 * 10**9)
    assert (found['size_px'], found['area_px']) == ('the size', 'the area')
    assert (found['found_s'], found['found_stamp_ns']) == (3.0, 5 * 10**9)
    assert found['began_s'] is None and found['level_at_end'] == 'warn'
    verdict.state = None
    assert drift_document(verdict, 0)['size_px'] is None
    assert drift_document(None, 0) is None


def test_tables_of_points_and_poses_have_their_columns():
    points = Fake(
        xyz_mm=np.array([[1.0, 2, 3], [4, 5, 6]]),
        sd_mm=np.array([[0.1, 0.2, 0.3]] * 2),
        residual=np.array([0.5, 0.6]),
        rays=np.array([2, 3]),
        status=np.array([OK, REJECTED]),
    )
    frame = Fake(points=points, target_id=np.array([7, 9]), number=4, stamp_ns=11)
    table = point_table([frame])
    row = dict(zip(POINT_COLUMNS, next(iter(table.rows))))
    assert tuple(table.columns) == POINT_COLUMNS
    assert (row['frame'], row['stamp_ns'], row['target_id'], row['z']) == (4, 11, 7, 3)
    assert (row['sd_y'], row['residual'], row['rays']) == (0.2, 0.5, 2)
    assert row['status'] == STATUS_NAMES[OK]
    named = list(point_table([frame], Names({'knee': 9})).rows)
    assert [one[-1] for one in named] == ['', 'knee']
    half = np.diag([1.0, -1, -1])  # half a turn about x
    poses = BodyPoses(
        'tibia',
        np.array([3, 4]),
        np.array([5 * 10**8, 15 * 10**8]),
        np.stack([half, np.full((3, 3), np.nan)]),
        np.array([[1.0, 2, 3], [np.nan] * 3]),
        covariance_noise=np.tile(np.diag([1.0, 4, 9, 16, 25, 36]), (2, 1, 1)),
        covariance_fixed=np.zeros((2, 6, 6)),
        rig_root=np.zeros((2, 6, 2)),
        markers=np.array([4, 0]),
        status=np.array([PoseStatus.OK, PoseStatus.FAILED], dtype=np.uint8),
    )
    first, second = (dict(zip(COLUMNS, row)) for row in pose_table([poses], 5 * 10**8).rows)
    assert (first['body'], first['exposure'], first['time_s']) == ('tibia', 3, 0.0)
    assert abs(first['qx']) == pytest.approx(1) and first['qw'] == pytest.approx(0)
    assert (first['x_mm'], first['sd_x_mm'], first['sd_rz_rad']) == (1, 1, 6)
    assert second['time_s'] == 1.0 and np.isnan(second['qx']) and second['markers'] == 0
    assert (first['status'], second['status']) == ('OK', 'FAILED')


def test_missing_source_of_a_calibration_is_named_with_what_can_be_given_instead(tmp_path):
    rng = np.random.default_rng(2)
    frame = Frame('a', 1, np.arange(5), rng.uniform(0, 90, (5, 2)), (100, 100))
    phantom = Phantom(np.arange(5), rng.uniform(-5, 5, (5, 3)), np.full(5, 0.1))
    request = CalibrationRequest({'a': [frame]}, phantom, CalibrationOptions())
    calibrations = {
        'a': Fake(image_size=(100, 100), source_digest=digest_of_sources([frame], phantom))
    }
    write_request(tmp_path, request)
    assert read_request(tmp_path, calibrations).frames['a'][0].target_id.tolist() == [*range(5)]
    for name, option in (('observations.csv', '--source'), ('phantom.csv', '--phantom')):
        (tmp_path / name).rename(tmp_path / 'away')
        with pytest.raises(DataError) as caught:
            read_request(tmp_path, calibrations)
        assert f'{name}: ' in str(caught.value) and f'give {option}' in str(caught.value)
        (tmp_path / 'away').rename(tmp_path / name)
    assert read_request(tmp_path, calibrations, {'a': [frame]}, phantom).phantom is phantom


def test_points_of_frames_are_rows_below_the_header():
    frames = {
        name: [Frame(name, 7, np.array([3, 9]), np.array([[1.5, 2], [3, 4]]), (9, 9), angle=angle)]
        for name, angle in (('a', None), ('b', 0.25))
    }
    points = points_of_frames('x.trc', frames, Names({'bead': 9}, {'pose': 7}))
    assert points.rows[1] == ['a', 'pose', 'bead', '3.0', '4.0'] and points.rows[2][0] == 'b'
    assert points.lines.tolist() == [2, 3, 4, 5] and points.uv[0].tolist() == [1.5, 2]
    assert np.isnan(points.angle[:2]).all() and points.angle[2:] == pytest.approx(0.25)
    with pytest.raises(DataError, match=r'x\.trc, row 4: '):
        correct_points(points, {'a': None})
    with pytest.raises(DataError, match='no image points'):
        points_of_frames('x.trc', {'a': []}, Names())
