# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Formats of cameras: other programs compute from the files what this package means."""

import json
import sys
from dataclasses import replace

import cv2
import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

from fluoro_calib_ros.errors import DataError
from fluoro_calib_ros.io.formats import registry
from fluoro_calib_ros.io.formats.content import Camera, Content, FileSettings, camera_at
from fluoro_calib_ros.photogrammetry.collinearity import project
from fluoro_calib_ros.simulation.rig import looking_at_origin

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

SIZE = (1024, 768)
MM = FileSettings(image_size=SIZE, units='mm')


def cameras():
    """Two cameras off the axes that face the origin; their principal points are off the centre."""
    out = []
    for name, position, c, xp, yp in (
        ('a', (300.0, -1100.0, 50.0), 4000.5, 520.25, 301.0),
        ('b', (-900.0, -600.0, -80.0), 4103.0, 480.0, 390.75),
    ):
        turn = Rotation.from_rotvec([0.02, -0.03, 0.4]).as_matrix()
        rotation = turn @ looking_at_origin(np.array(position))
        matrix = np.array([[c, 0, xp], [0, c, yp], [0, 0, 1]])
        out.append(camera_at(name, matrix, SIZE, rotation, np.array(position)))
    return tuple(out)


def points_mm(count=30):
    return np.random.default_rng(3).uniform(-60, 60, (count, 3))


def pixels(camera, points):
    """Return the pixels by our own collinearity equations."""
    matrix = camera.matrix
    interior = np.array([matrix[0, 2], matrix[1, 2], matrix[0, 0]])
    position = -camera.rotation.T @ camera.translation_mm
    count = len(points)
    return project(
        np.tile(camera.rotation, (count, 1, 1)),
        np.tile(position, (count, 1)),
        points,
        np.tile(interior, (count, 1)),
    )


def triangulated(matrices, uv):
    """Return OpenCV triangulation from projection matrices (3, 4) and pixels (n, 2) of both."""
    found = cv2.triangulatePoints(*matrices, *(np.ascontiguousarray(p.T) for p in uv))
    return (found[:3] / found[3]).T


def assert_same(found, expected, tolerance=1e-9):
    assert [camera.name for camera in found] == [camera.name for camera in expected]
    for one, other in zip(found, expected):
        assert one.image_size == other.image_size
        np.testing.assert_allclose(one.matrix, other.matrix, rtol=0, atol=tolerance * 1e3)
        np.testing.assert_allclose(one.rotation, other.rotation, rtol=0, atol=tolerance)
        np.testing.assert_allclose(
            one.translation_mm, other.translation_mm, rtol=0, atol=tolerance * 1e3
        )


@pytest.mark.parametrize('units', ['mm', 'cm', 'm'])
@pytest.mark.parametrize(
    ('kind', 'tolerance'),
    [
        ('mayacam2', 0),
        ('opencv', 0),
        ('anipose', 1e-15),
        ('dlt', 1e-10),
        ('known_orientation', 1e-12),
    ],
)
def test_cameras_return_from_every_format(tmp_path, kind, tolerance, units):
    """Every unit is possible; the last digit is kept if the numbers themselves are stored."""
    settings = FileSettings(image_size=SIZE, units=units, fluoroscopes=('a', 'b'))
    registry.write(tmp_path / 'out', kind, Content(cameras=cameras()), settings)
    path = tmp_path / 'out'
    if kind == 'anipose':
        path = path.rename(tmp_path / 'calibration.toml')
    # Moving the decimal point of a translation of 17 digits rounds it once more.
    tolerance = tolerance if units == 'mm' else max(tolerance, 1e-15)
    assert_same(registry.read(path, settings).cameras, cameras(), tolerance)


@pytest.mark.parametrize('name', ['lab "2"', 'C:\\left', '\\"', 'plain'])
def test_names_of_cameras_return_from_toml(tmp_path, name):
    """Quotes and backslashes are escaped exactly once."""
    given = (replace(cameras()[0], name=name), cameras()[1])
    path = tmp_path / 'calibration.toml'
    registry.write(path, 'anipose', Content(cameras=given), MM)
    assert tomllib.loads(path.read_text())['cam_0']['name'] == name
    assert [c.name for c in registry.read(path, MM).cameras] == [name, 'b']


def autoscoper_mayacam2(path):
    """Return a camera as Autoscoper's loader reads it: by line number, with y turned upwards.

    The result is: image size, focal lengths, principal point with y upwards, the camera's axes in
    the world as columns (x right, y up, z backwards), and its position.
    """
    lines = path.read_text().split('\n')
    assert lines[0] == 'image size'
    width, height = map(float, lines[1].split(','))
    k = np.array([[float(c) for c in lines[i].split(',')] for i in (4, 5, 6)])
    r = np.array([[float(c) for c in lines[i].split(',')] for i in (9, 10, 11)])
    t = np.array([float(lines[i]) for i in (14, 15, 16)])
    flip = np.diag([-1.0, 1.0, -1.0])
    r = flip @ r
    t = flip @ t
    cy = (height - 1) - k[1, 2]
    axes = r.T.copy()
    position = -axes @ t
    axes[:, :2] *= -1
    return (width, height), (k[0, 0], k[1, 1]), (k[0, 2], cy), axes, position


def test_autoscoper_sees_the_same_pixels(tmp_path):
    """Its camera looks along -z with y upwards; its rows are counted from the bottom."""
    written = registry.write(tmp_path, 'mayacam2', Content(cameras=cameras()), MM)
    assert len(written.paths) == 2
    for camera in cameras():
        path = tmp_path / f'{camera.name}_MayaCam2.txt'
        size, (fx, fy), (cx, cy), axes, position = autoscoper_mayacam2(path)
        assert size == SIZE
        local = (points_mm() - position) @ axes
        assert (local[:, 2] < 0).all()  # in front of a camera that looks along -z
        column = cx - fx * local[:, 0] / local[:, 2]
        up = cy - fy * local[:, 1] / local[:, 2]
        expected = pixels(camera, points_mm())
        np.testing.assert_allclose(column, expected[:, 0], atol=1e-8)
        np.testing.assert_allclose(SIZE[1] - 1 - up, expected[:, 1], atol=1e-8)


def test_opencv_triangulates_our_points_from_mayacam(tmp_path):
    """K [R | t] of the files, without any of our code."""
    registry.write(tmp_path, 'mayacam2', Content(cameras=cameras()), MM)
    matrices = []
    for name in 'ab':
        lines = (tmp_path / f'{name}_MayaCam2.txt').read_text().split('\n')
        k, r = (
            np.array([[float(c) for c in line.split(',')] for line in lines[i : i + 3]])
            for i in (4, 9)
        )
        t = np.array([[float(line)] for line in lines[14:17]])
        matrices.append(k @ np.hstack([r, t]))
    found = triangulated(matrices, [pixels(camera, points_mm()) for camera in cameras()])
    np.testing.assert_allclose(found, points_mm(), atol=1e-8)


def test_mayacam2_with_distortion_returns(tmp_path):
    """XMALab adds eight coefficients of OpenCV's model, one per line."""
    base = cameras()[0]
    distortion = (0.1, -0.2, 0.003, 0.004, 0.05, 0.0, 0.0, 0.0)
    camera = Camera('a', base.matrix, SIZE, base.rotation, base.translation_mm, distortion)
    registry.write(tmp_path, 'mayacam2', Content(cameras=(camera,)), MM)
    (found,) = registry.read(tmp_path, MM).cameras
    assert found.distortion == distortion
    with pytest.raises(DataError, match=r'camera a has a distortion, which a DLT cannot contain'):
        registry.write(tmp_path / 'dlt.csv', 'dlt', Content(cameras=(found,)), MM)


def xmalab_mayacam1(camera):
    """Return the fifteen numbers that XMALab writes, following its getMayaCam step by step."""
    height = SIZE[1]
    flip = np.diag([-1.0, 1.0, -1.0])
    r = flip @ camera.rotation
    t = flip @ camera.translation_mm
    cx = camera.matrix[0, 2]
    cy = height - 1 - camera.matrix[1, 2]
    r = np.linalg.inv(r)
    t = -r @ t
    angles = np.degrees(
        [
            np.arctan2(-r[2, 1], r[2, 2]),
            np.arctan2(r[2, 0], np.hypot(r[2, 1], r[2, 2])),
            np.arctan2(-r[1, 0], -r[0, 0]),
        ]
    )
    f = -0.5 * (camera.matrix[0, 0] + camera.matrix[1, 1])
    plane = [(0.5 * SIZE[0] - (cx + 1)) * 0.1, (0.5 * height - (cy + 1)) * 0.1, 0.1 * f]
    return [t, angles, plane, [cx + 1, cy + 1, f], [0.1, *SIZE]]


def test_mayacam1_of_xmalab_is_read(tmp_path):
    for camera in cameras():
        rows = xmalab_mayacam1(camera)
        text = '\n'.join(','.join(f'{value:.15g}' for value in row) for row in rows)
        (tmp_path / f'{camera.name}_MayaCam.csv').write_text(text + '\n')
    assert_same(registry.read(tmp_path, MM).cameras, cameras())


@pytest.mark.parametrize('count', [0, 4, 6])
def test_mayacam1_has_five_rows(tmp_path, count):
    rows = [*xmalab_mayacam1(cameras()[0]), [1, 2, 3]][:count]
    path = tmp_path / 'a_MayaCam.csv'
    path.write_text('\n'.join(','.join(f'{value:.15g}' for value in row) for row in rows) + '\n')
    with pytest.raises(DataError, match=f'{count} rows' if count else 'no rows'):
        registry.read(path, MM, 'mayacam1')


def test_coefficients_of_dlt_without_an_image_size_are_refused(tmp_path):
    path = tmp_path / 'dlt.csv'
    registry.write(path, 'dlt', Content(cameras=cameras()), MM)
    with pytest.raises(DataError, match='does not contain the image size, --image-size WxH'):
        registry.read(path, FileSettings(units='mm'))


def test_dlt_gives_pixels_from_one_upwards(tmp_path):
    """XMALab and DLTdv define eleven coefficients: L1 X + L2 Y + L3 Z + L4 over the third row."""
    path = tmp_path / 'dlt.csv'
    registry.write(path, 'dlt', Content(cameras=cameras()), MM)
    table = np.loadtxt(path, delimiter=',')
    assert table.shape == (11, 2)
    homogeneous = np.column_stack([points_mm(), np.ones(30)])
    for column, camera in zip(table.T, cameras()):
        x, y, w = np.append(column, 1.0).reshape(3, 4) @ homogeneous.T
        expected = pixels(camera, points_mm())
        np.testing.assert_allclose(x / w, expected[:, 0] + 1, atol=1e-8)
        np.testing.assert_allclose(y / w, SIZE[1] - expected[:, 1], atol=1e-8)


def test_dlt_of_dltdv8_counts_rows_downwards(tmp_path):
    """DLTdv8 and easyWand6 do this from the first pixel, 1; the origin shows it."""
    path = tmp_path / 'dlt.csv'
    from_one = np.array([[1.0, 0, 1], [0, 1, 1], [0, 0, 1]])
    columns = []
    for camera in cameras():
        pose = np.column_stack([camera.rotation, camera.translation_mm])
        projection = from_one @ camera.matrix @ pose
        columns.append((projection / projection[2, 3]).ravel()[:11])
    np.savetxt(path, np.array(columns).T, delimiter=',')
    content = registry.read(path, MM)
    assert len(content.notes) == 1
    for found, expected in zip(content.cameras, cameras()):
        np.testing.assert_allclose(
            pixels(found, points_mm()), pixels(expected, points_mm()), atol=1e-6
        )
    registry.write(path, 'dlt', Content(cameras=cameras()), MM)
    assert not registry.read(path, MM).notes


def test_anipose_file_projects_with_opencv(tmp_path):
    """Rotation vector, translation and matrix as aniposelib gives them to cv2.projectPoints."""
    path = tmp_path / 'calibration.toml'
    registry.write(path, 'anipose', Content(cameras=cameras()), MM)
    document = tomllib.loads(path.read_text())
    assert list(document) == ['cam_0', 'cam_1', 'metadata']
    for number, camera in enumerate(cameras()):
        table = document[f'cam_{number}']
        assert (table['name'], table['size']) == (camera.name, list(SIZE))
        found, _ = cv2.projectPoints(
            points_mm(),
            np.array(table['rotation']),
            np.array(table['translation']),
            np.array(table['matrix']),
            np.array(table['distortions']),
        )
        np.testing.assert_allclose(found[:, 0], pixels(camera, points_mm()), atol=1e-8)


def test_camera_info_is_that_of_ros(tmp_path):
    """It has the interior orientation only, with the entries that camera_info_manager parses."""
    written = registry.write(tmp_path, 'camera_info', Content(cameras=cameras()), MM)
    assert 'no position and attitude' in written.notes[0]
    document = yaml.safe_load((tmp_path / 'a_camera_info.yaml').read_text())
    assert document['camera_name'] == 'a' and document['image_width'] == SIZE[0]
    assert document['projection_matrix']['data'][:3] == cameras()[0].matrix[0].tolist()
    assert document['distortion_model'] == 'plumb_bob'
    for found, expected in zip(registry.read(tmp_path, MM).cameras, cameras()):
        assert (found.name, found.image_size) == (expected.name, SIZE)
        np.testing.assert_array_equal(found.matrix, expected.matrix)
        assert found.rotation is None


@pytest.mark.parametrize('size', [('-5', '960'), ('1280', '1.5'), ('0', '960')])
@pytest.mark.parametrize('kind', ['camera_info', 'anipose'])
def test_image_size_that_is_not_one_is_refused(tmp_path, kind, size):
    path = tmp_path / ('a_camera_info.yaml' if kind == 'camera_info' else 'a.toml')
    registry.write(
        tmp_path if kind == 'camera_info' else path, kind, Content(cameras=cameras()), MM
    )
    text = path.read_text()
    for name, number, wrong in zip(('image_width: ', 'image_height: '), SIZE, size):
        text = text.replace(f'{name}{number}', f'{name}{wrong}')
    text = text.replace(str(list(SIZE)), f'[{", ".join(size)}]')
    path.write_text(text)
    with pytest.raises(DataError, match='is not of whole numbers above 0'):
        registry.read(path, MM)


def test_opencv_reads_the_file_itself(tmp_path):
    registry.write(tmp_path, 'opencv', Content(cameras=cameras()), MM)
    storage = cv2.FileStorage(str(tmp_path / 'b_opencv.yaml'), cv2.FILE_STORAGE_READ)
    np.testing.assert_array_equal(storage.getNode('camera_matrix').mat(), cameras()[1].matrix)
    np.testing.assert_array_equal(storage.getNode('R').mat(), cameras()[1].rotation)
    assert int(storage.getNode('image_width').real()) == SIZE[0]


@pytest.mark.parametrize(
    'matrix',
    ['K2: 5', 'K: !!opencv-matrix\n   rows: 2\n   cols: 3\n   dt: d\n   data: [1,0,5,0,1,5]'],
)
def test_file_of_opencv_without_a_camera_matrix_is_refused(tmp_path, matrix):
    path = tmp_path / 'a_opencv.yaml'
    path.write_text(f'%YAML:1.0\n---\n{matrix}\n')
    with pytest.raises(DataError, match='there is no camera_matrix of 3 x 3 numbers'):
        registry.read(path, MM, 'opencv')


def changed(lines, row, text):
    return [*lines[: row - 1], text, *lines[row:]]


@pytest.mark.parametrize(
    ('row', 'text', 'sentence'),
    [
        (2, '1024', 'row 2: 1 numbers, but MayaCam 2.0 has 2 here'),
        (4, 'camera', "row 4: 'camera' is where MayaCam 2.0 has the line 'camera matrix'"),
        (6, '0,x,1', "row 6: column 2 is 'x', not a number"),
        (10, '1,1,1', 'row 10: the matrix is not a rotation, its rows are not orthonormal'),
    ],
)
def test_wrong_mayacam2_names_the_row(tmp_path, row, text, sentence):
    registry.write(tmp_path, 'mayacam2', Content(cameras=cameras()[:1]), MM)
    path = tmp_path / 'a_MayaCam2.txt'
    path.write_text('\n'.join(changed(path.read_text().split('\n'), row, text)))
    with pytest.raises(DataError) as caught:
        registry.read(path, MM)
    assert str(caught.value) == f'{path}, {sentence}'


def test_unit_is_never_silent(tmp_path):
    """It is requested if a file does not state it, and reported if the usual unit is written."""
    written = registry.write(tmp_path, 'mayacam2', Content(cameras=cameras()), FileSettings())
    assert 'lengths in mm' in written.notes[0]
    with pytest.raises(
        DataError, match=r'does not state the unit of its lengths, --units mm\|cm\|m'
    ):
        registry.read(tmp_path, FileSettings())


def test_camera_without_pose_is_refused(tmp_path):
    content = Content(cameras=(Camera('a', np.eye(3), SIZE),))
    with pytest.raises(DataError, match='has no position and attitude'):
        registry.write(tmp_path / 'out', 'mayacam2', content, MM)
    assert not (tmp_path / 'out').exists()


def test_folder_of_two_formats_is_refused(tmp_path):
    for kind in ('mayacam2', 'opencv'):
        registry.write(tmp_path, kind, Content(cameras=cameras()), MM)
    with pytest.raises(DataError, match='the folder has files of mayacam2 and opencv'):
        registry.read(tmp_path, MM)
    assert len(registry.read(tmp_path, MM, 'opencv').cameras) == 2


def test_file_of_another_format_says_what_it_looks_like(tmp_path):
    registry.write(tmp_path, 'mayacam2', Content(cameras=cameras()), MM)
    with pytest.raises(DataError) as caught:
        registry.read(tmp_path / 'a_MayaCam2.txt', MM, 'dlt')
    assert 'there are 11 coefficients' in str(caught.value)
    assert str(caught.value).endswith('the file looks like MayaCam 2.0 (mayacam2)')
    (tmp_path / 'x.dat').write_text('hello\n')
    with pytest.raises(DataError, match=r"the format is not known; it begins with 'hello'"):
        registry.read(tmp_path / 'x.dat', MM)
    (tmp_path / 'x.json').write_text(json.dumps({}))
    with pytest.raises(DataError, match='the format is not known'):
        registry.read(tmp_path / 'x.json', MM)


@pytest.mark.parametrize('value', ['"12.5"', 'true'])
def test_numbers_of_a_camera_are_not_texts_or_flags(tmp_path, value):
    """A text that numpy would convert, and true as 1, are slips of a person."""
    path = tmp_path / 'calibration.toml'
    registry.write(path, 'anipose', Content(cameras=cameras()[:1]), MM)
    lines = path.read_text().splitlines()
    lines = [f'translation = [1.0, {value}, 2.0]' if 'translation' in n else n for n in lines]
    path.write_text('\n'.join(lines))
    with pytest.raises(DataError, match='translation does not have 3 numbers'):
        registry.read(path, MM)
