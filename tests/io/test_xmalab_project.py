# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""XMALab projects, written like those of ProjectFileIO of XMALab 2.2.7."""

import zipfile

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fluoro_calib_ros.errors import DataError
from fluoro_calib_ros.io.formats import registry
from fluoro_calib_ros.io.formats.content import FileSettings

SIZE = (320, 256)
BEADS = np.array([[0, 0, 1.5], [1, 0, 0], [0, 1, 0], [1, 1, 1], [2, 1, 0]])
NAMES = ('p1', 'p2', 'q1', 'q2', 'q3')
POSES = {camera: Rotation.from_rotvec([0.1 * camera, 0.2, -0.3]).as_matrix() for camera in (1, 2)}
TRANSLATION = np.array([1.5, -2.5, 90.0])


def table(rows, separator=', '):
    return ''.join(separator.join(f'{v:.12g}' for v in np.atleast_1d(r)) + '\n' for r in rows)


def calibration_points(camera, image):
    """Return pixels of the beads and flags: whether XMALab found and uses them."""
    uv = np.random.default_rng(10 * camera + image).uniform(5, 250, (len(BEADS), 2))
    inlier = np.array([1, 1, 0, 1, -1])  # 0: switched off by the user, -1: not found
    uv[4] = -1
    return uv, inlier


def marker_points(camera, marker):
    uv = np.random.default_rng(100 * camera + marker).uniform(5, 250, (3, 2))
    status = np.array([50, 0, 10]) if marker else np.array([40, 60, -20])
    return uv, status


def image_bytes():
    return cv2.imencode('.png', np.zeros(SIZE[::-1], dtype=np.uint8))[1].tobytes()


def camera_xml(camera, separator, files):
    """Return a camera element with a grid and two images, the second of which is calibrated."""
    folder = f'cam {camera}'
    data = f'{folder}{separator}data{separator}'
    files[f'{folder}/data/cam_CameraMatrix.csv'] = table([[900, 0, 150], [0, 905, 120], [0, 0, 1]])
    grid = np.random.default_rng(camera).uniform(0, 200, (4, 4))
    files[f'{folder}/data/grid_D.csv'] = table(grid[:, :2])
    files[f'{folder}/data/grid_R.csv'] = table(grid[:, 2:])
    files[f'{folder}/data/grid_I.csv'] = table([1, 1, 0, 1])
    images = ''
    for image in (1, 2):
        name = f'cal {camera}_{image}.png'
        files[f'{folder}/{name}'] = image_bytes()
        inside = ''
        if image == 2:
            uv, inlier = calibration_points(camera, image)
            files[f'{folder}/data/i_PointsDetected.csv'] = table(uv)
            files[f'{folder}/data/i_PointsInlier.csv'] = table(inlier)
            files[f'{folder}/data/i_RotationMatrix.csv'] = table(POSES[camera])
            files[f'{folder}/data/i_TranslationVector.csv'] = table(TRANSLATION)
            inside = ''.join(
                f'<{tag} Filename="{data}i_{file}.csv"/>'
                for tag, file in (
                    ('PointsDetectedAll', 'PointsDetectedAll'),
                    ('PointsDetected', 'PointsDetected'),
                    ('Inlier', 'PointsInlier'),
                    ('RotationMatrix', 'RotationMatrix'),
                    ('TranslationVector', 'TranslationVector'),
                )
            )
        images += (
            f'<CalibrationImage Filename="{folder}{separator}{name}" isCalibrated="{image - 1}">'
            f'{inside}</CalibrationImage>'
        )
    return (
        f'<Camera Name="{folder}" isLightCamera="0" isCalibrated="1" isOptimized="1" '
        f'isFlipped="0" CameraMatrix="{data}cam_CameraMatrix.csv">'
        f'<UndistortionGrid Filename="{folder}{separator}grid.png" isComputed="1">'
        f'<GridPointsDistorted Filename="{data}grid_D.csv"/>'
        f'<GridPointsReferences Filename="{data}grid_R.csv"/>'
        f'<GridPointsInlier Filename="{data}grid_I.csv"/></UndistortionGrid>{images}</Camera>'
    )


def write_project(path, separator='/', **changes):
    """Write a project; `changes` replace files of the archive, or omit them if None."""
    files = {}
    cameras = ''.join(camera_xml(camera, separator, files) for camera in (1, 2))
    files['CalibrationObject/cube.csv'] = 'x y z\n' + ''.join(
        ','.join(f'{v:g}' for v in bead) + f',{name}\n' for bead, name in zip(BEADS, NAMES)
    )
    markers = ''
    for marker in (0, 1):
        uv, status = zip(*(marker_points(camera, marker) for camera in (1, 2)))
        base = f'walk{separator}data{separator}Marker{marker:03d}'
        files[f'walk/data/Marker{marker:03d}points2d.csv'] = table(np.hstack(uv), ',')
        files[f'walk/data/Marker{marker:03d}status2d.csv'] = table(np.stack(status, 1), ',')
        markers += (
            f'<Marker Description="{"tib" if marker else ""}" ID="{marker}" '
            f'FilenamePoints2D="{base}points2d.csv" FilenameStatus2D="{base}status2d.csv"/>'
        )
    files['project.xml'] = (
        '<?xml version="1.0" encoding="UTF-8"?>\n<Project Version="0.3" CalibrationType="1">'
        f'{cameras}<CalibrationObject isPLanar="0" '
        f'FrameSpecifications="CalibrationObject{separator}cube.csv" References=""/>'
        f'<Trial Name="walk" referenceCalibration="1">{markers}</Trial></Project>\n'
    )
    files.update(changes)
    with zipfile.ZipFile(path, 'w', zipfile.ZIP_DEFLATED) as archive:
        for name, content in files.items():
            if content is not None:
                archive.writestr(name, content)
    return path


@pytest.mark.parametrize('separator', ['/', '\\'])
def test_calibration_of_a_project_is_read(tmp_path, separator):
    """It has the image points that XMALab used; projects from Windows are read, too."""
    content = registry.read(write_project(tmp_path / 'p.xma', separator), FileSettings(units='mm'))
    assert list(content.observations) == ['cam_1', 'cam_2']
    for camera in (1, 2):
        (frame,) = content.observations[f'cam_{camera}']
        uv, _ = calibration_points(camera, 2)
        assert frame.number == 2 and frame.image_size == SIZE
        np.testing.assert_allclose(frame.uv, uv[[0, 1, 3]], atol=1e-9)
        beads = content.survey.xyz_mm[content.survey.index(frame.target_id)]
        np.testing.assert_array_equal(beads, BEADS[[0, 1, 3]])
    assert content.names.fluoroscopes == {'cam 1': 'cam_1', 'cam 2': 'cam_2'}
    assert content.names.exposures['cal 1_2.png'] == 2
    assert content.names.targets == dict(zip(NAMES, range(1, 6)))
    assert content.grids['cam_1'].shape == (3, 4)


def test_cameras_of_a_project_are_those_of_the_reference_image(tmp_path):
    """They are in cm, the unit of frame specifications, with a note that says so."""
    content = registry.read(write_project(tmp_path / 'p.xma'), FileSettings())
    for number, camera in enumerate(content.cameras, 1):
        assert camera.name == f'cam_{number}' and camera.image_size == SIZE
        np.testing.assert_allclose(camera.rotation, POSES[number], atol=1e-11)
        np.testing.assert_allclose(camera.translation_mm, 10 * TRANSLATION)
        assert camera.matrix[1, 1] == 905
    assert any('lengths in cm' in note for note in content.notes)


def test_markers_of_a_trial_are_read(tmp_path):
    """A marker is seen if its status is above 0; one without description is named marker001."""
    path = write_project(tmp_path / 'p.xma')
    content = registry.read(path, FileSettings(trial='walk', wanted=('observations',)))
    frames = content.observations['cam_2']
    assert [f.number for f in frames] == [1, 2, 3]
    ids = content.names.targets
    assert frames[0].target_id.tolist() == [ids.get('marker001', 6), ids['tib']]
    np.testing.assert_allclose(frames[2].uv, marker_points(2, 1)[0][2:], atol=1e-9)
    with pytest.raises(DataError, match="there is no trial 'run', only walk"):
        registry.read(path, FileSettings(trial='run'))


@pytest.mark.parametrize(
    ('changes', 'sentence'),
    [
        ({'project.xml': None}, 'the project does not contain project.xml'),
        ({'project.xml': '<Project>'}, 'project.xml, row 1: this is not XML'),
        (
            {'project.xml': '<!DOCTYPE a><Project/>'},
            'a document type, entities and CDATA are not read',
        ),
        (
            {'cam 1/data/i_PointsDetected.csv': '1,2\n'},
            '1 points and 5 inliers, but the calibration object has 5 beads',
        ),
        ({'cam 2/data/i_RotationMatrix.csv': '1,x\n'}, "row 1: column 2 is 'x', not a number"),
    ],
)
def test_damaged_project_is_refused(tmp_path, changes, sentence):
    path = write_project(tmp_path / 'p.xma', **changes)
    with pytest.raises(DataError) as caught:
        registry.read(path, FileSettings(units='mm'))
    assert sentence in str(caught.value) and '\n' not in str(caught.value)


def test_truncated_project_is_refused(tmp_path):
    path = write_project(tmp_path / 'p.xma')
    path.write_bytes(path.read_bytes()[:2000])
    with pytest.raises(DataError, match='this is not an XMALab project, which is a ZIP file'):
        registry.read(path, FileSettings())
