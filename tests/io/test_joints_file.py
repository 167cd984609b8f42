# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""joints.toml and joints.csv."""

import csv

import numpy as np
import pytest
import rigs

from fluoro_calib_ros.bodies.anatomical_frames import BODY_FRAME
from fluoro_calib_ros.bodies.body import Body
from fluoro_calib_ros.bodies.joints import Joint, JointMotion, JointStatus
from fluoro_calib_ros.errors import DataError
from fluoro_calib_ros.findings import Kind
from fluoro_calib_ros.io.bodies import joint_table, read_joints
from fluoro_calib_ros.limits import DOCUMENT_BYTES, MAX_DEPTH, MAX_JOINTS

BODIES = ('femur', 'tibia', 'talus')
KNEE = """
[[joint]]
name = "knee"
proximal = "femur"
distal = "tibia"
convention = "grood_suntay_knee"
side = "left"
neutral = [3, 40]

[joint.proximal_frame.landmarks]
femoral_head = [0, 0, 400]
intercondylar = [0, 0, 0.0]
medial_posterior_condyle = [25, -20, 4]
lateral_posterior_condyle = [-25, -20, 4]

[joint.distal_frame]
axes = {x = [2, 0, 0], z = [0, 0, 1.0]}
origin = [1, 2, 3]
"""
ANKLE = """
[[joint]]
name = "ankle"
proximal = "tibia"
distal = "talus"
convention = "cardan_zxy"
[joint.proximal_frame]
matrix = [[0, -1, 0, 5], [1, 0, 0, 6], [0, 0, 1, 7], [0, 0, 0, 1]]
[joint.distal_frame]
quaternion_wxyz = [0.7071068, 0, 0, 0.7071068]
origin = [0, 0, 0]
"""


def written(tmp_path, text):
    path = tmp_path / 'joints.toml'
    path.write_text(text)
    return path


def test_joints_are_read(tmp_path):
    """Frames are given by landmarks, axes, a matrix and a quaternion."""
    knee, ankle = read_joints(written(tmp_path, KNEE + ANKLE), BODIES)
    assert knee.neutral == (3, 40) and ankle.neutral is None
    assert (knee.joint.name, knee.joint.proximal, knee.joint.distal) == ('knee', 'femur', 'tibia')
    assert (knee.joint.convention, knee.joint.side) == ('grood_suntay_knee', 'left')
    np.testing.assert_allclose(knee.joint.proximal_frame.rotation, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(knee.joint.distal_frame.rotation, np.eye(3), atol=1e-12)
    np.testing.assert_array_equal(knee.joint.distal_frame.origin_mm, [1, 2, 3])
    turned = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]
    np.testing.assert_allclose(ankle.joint.proximal_frame.rotation, turned, atol=1e-12)
    np.testing.assert_array_equal(ankle.joint.proximal_frame.origin_mm, [5, 6, 7])
    np.testing.assert_allclose(ankle.joint.distal_frame.rotation, turned, atol=1e-6)
    plain = KNEE[: KNEE.index('[joint.proximal_frame')]
    (entry,) = read_joints(written(tmp_path, plain), BODIES)
    assert entry.joint.proximal_frame is BODY_FRAME


def body(name, xyz):
    return Body(name, np.arange(len(xyz)) + 10 * len(name), xyz, np.full(len(xyz), 0.1))


def test_a_frame_is_in_the_coordinates_of_its_body(tmp_path):
    """Landmarks in cm, or of another bone, are far from the markers; a frame needs coordinates."""
    near = np.array([[20.0, 0, 50], [0, 20, 60], [-20, 0, 70], [0, -20, 150]])
    tibia = body('tibia', near)
    read_joints(written(tmp_path, KNEE), [body('femur', near), tibia])
    with rigs.refused(Kind.WRONG_UNIT, extent_mm=pytest.approx(400.8, abs=1)) as caught:
        read_joints(written(tmp_path, KNEE), [body('femur', near + [0, 0, 1000]), tibia])
    assert 'joints.toml: joint knee, frame of femur' in str(caught.value)
    in_cm = KNEE.replace('[0, 0, 400]', '[0, 0, 40]').replace('25, -20', '2.5, -2')
    with rigs.refused(Kind.WRONG_UNIT):
        read_joints(written(tmp_path, in_cm), [body('femur', near), tibia])
    tibia_frame = KNEE[KNEE.index('[joint.distal_frame]') :]
    landmarks = (
        'medial_eminence = [5, 0, 0]\nlateral_eminence = [-5, 0, 0]\n'
        'ankle_centre = [0, 0, -3800]\n'
        'medial_plateau = [25, 0, 0]\nlateral_plateau = [-25, 0, 0]\n'
    )
    long = KNEE.replace(tibia_frame, '[joint.distal_frame.landmarks]\n' + landmarks)
    with rigs.refused(Kind.WRONG_UNIT, larger_mm=pytest.approx(3800, abs=1)):
        read_joints(written(tmp_path, long), [body('femur', near), tibia])
    read_joints(written(tmp_path, long.replace('3800', '380')), [body('femur', near), tibia])
    unknown = body('femur', np.where(np.arange(4)[:, None] < 2, near, np.nan))
    with pytest.raises(DataError, match='frame of femur: three markers'):
        read_joints(written(tmp_path, KNEE), [unknown, tibia])
    plain = KNEE[: KNEE.index('[joint.proximal_frame')]
    read_joints(written(tmp_path, plain), [unknown, tibia])


@pytest.mark.parametrize(
    ('change', 'cause'),
    [
        (('"femur"', '"patella"'), 'no body patella'),
        (('"tibia"\nconv', '"femur"\nconv'), 'both of its bodies are femur'),
        (('grood_suntay_knee', 'grood'), "convention 'grood' is unknown"),
        (('"left"', '"both"'), "side is 'both'"),
        (('side = "left"', ''), 'left or right'),
        (('name = "knee"', ''), 'key name'),
        (('name = "knee"', 'name = 3'), 'key name'),
        (('[3, 40]', '[40, 3]'), 'key neutral'),
        (('[3, 40]', '[3.5, 40]'), 'key neutral'),
        (('side =', 'sides ='), 'key sides: unknown'),
        (('[0, 0, 400]', '[0, 0, nan]'), 'femoral_head has a number that is not finite'),
        (('[0, 0, 400]', f'[0, 0, 1{"0" * 400}]'), 'an integer is too large'),
        (('[0, 0, 400]', '[' * (MAX_DEPTH + 1) + ']' * (MAX_DEPTH + 1)), 'nested too deeply'),
        (('landmarks]', 'a.' * MAX_DEPTH + 'landmarks]'), 'nested too deeply'),
        (('[0, 0, 400]', '[0, 400]'), 'femoral_head does not have 3 numbers'),
        (('[0, 0, 400]', '[0, 0, "400"]'), 'femoral_head does not have 3 numbers'),
        (('[0, 0, 400]', '[0, 0, true]'), 'femoral_head does not have 3 numbers'),
        (('femoral_head = [0, 0, 400]', ''), 'the landmark femoral_head is missing'),
        (('femoral_head', 'head'), 'the landmark femoral_head is missing'),
        (('z = [0, 0, 1.0]', 'y = [0, 1, 0], z = [0, 0, -1]'), 'left-handed'),
        (('z = [0, 0, 1.0]', 'y = [0.1, 1, 0]'), 'not perpendicular'),
        (('z = [0, 0, 1.0]', 'w = [0, 0, 1]'), 'axes x, y and z'),
        (('origin = [1, 2, 3]', ''), 'origin is missing'),
        (('axes =', 'axis ='), 'key axis is unknown'),
        (('axes = {x = [2, 0, 0], z = [0, 0, 1.0]}', 'axes = 1'), 'axes is not a table'),
        (('axes = {x', 'quaternion_wxyz = [1, 0, 0, 0]\naxes = {x'), 'one of'),
        (('[joint.distal_frame]', '[joint.distal_frame]\n[joint.other]'), 'other'),
        (('[[joint]]', '[[joint]'), 'not TOML'),
        (('[[joint]]', 'version = 2\n[[joint]]'), 'key version: unknown'),
    ],
)
def test_faults_are_named(tmp_path, change, cause):
    text = KNEE.replace(*change, 1)
    assert text != KNEE
    path = written(tmp_path, text)
    with pytest.raises(DataError) as caught:
        read_joints(path, BODIES)
    assert cause in str(caught.value) and str(path) in str(caught.value)
    assert '\n' not in str(caught.value)


def test_a_file_beyond_the_budget_of_documents_is_not_parsed(tmp_path):
    path = written(tmp_path, KNEE + '#' * DOCUMENT_BYTES['TOML'])
    with pytest.raises(DataError, match=r'the TOML text has .* MB; the limit is .* MB'):
        read_joints(path, BODIES)


@pytest.mark.parametrize(
    ('text', 'cause'),
    [
        (KNEE + KNEE, 'two joints are called knee'),
        (KNEE + ANKLE.replace('talus', 'femur'), 'closes a cycle'),
        ('', 'empty'),
        ('\n', 'no table'),
        ('joint = []', 'no table'),
        ('joint = [1]', 'not a table'),
        ('[joint]\nname = "knee"', 'no table'),
        (ANKLE.replace('0, 0, 0, 1]]', '0, 0, 0, 2]]'), 'last row'),
        (ANKLE.replace('0.7071068, 0, 0', '0.9, 0, 0'), 'length one'),
        (ANKLE.replace('matrix =', 'origin = [0, 0, 0]\nmatrix ='), 'given twice'),
        (
            ANKLE.replace('cardan_zxy"', 'isb_ankle"\nside = "left"').replace(
                'quaternion_wxyz = [0.7071068, 0, 0, 0.7071068]\norigin = [0, 0, 0]',
                'landmarks = {heel = [0, 0, 0]}',
            ),
            'isb_ankle has no landmarks',
        ),
        ('[[joint]]\n' * (MAX_JOINTS + 1), f'the limit is {MAX_JOINTS}'),
    ],
)
def test_wrong_files_are_refused(tmp_path, text, cause):
    with pytest.raises(DataError, match=cause.replace('[', r'\[')):
        read_joints(written(tmp_path, text), BODIES)


def test_motion_of_joints_is_written(tmp_path):
    """There is one row for each joint and exposure; cells are empty if the motion is unknown."""
    count = 3
    angles = np.array([[0.5, -0.25, 7.0], [np.nan] * 3, [0.1, 0.2, 0.3]])
    covariance = np.tile(np.diag([1e-4, 4e-4, 9e-4, 0.01, 0.04, 0.09]), (count, 1, 1))
    covariance[1] = np.nan
    motion = JointMotion(
        Joint('knee', 'femur', 'tibia', 'cardan_xyz'),
        np.array([5, 6, 9]),
        np.array([10, 14, 26]) * 10**6 + 10**18,
        angles=angles,
        translations=10 * angles,
        covariance=covariance,
        status=np.array([JointStatus.OK, JointStatus.FAILED, JointStatus.GIMBAL], np.uint8),
        determined=np.array([True, False, False]),
    )
    path = tmp_path / 'joints.csv'
    joint_table([motion, motion], 10**18).write(path)
    text = path.read_text().splitlines()
    assert text[0] == (
        'joint,exposure,time_s,angle_1_deg,angle_2_deg,angle_3_deg,translation_1_mm,'
        'translation_2_mm,translation_3_mm,sd_angle_1_deg,sd_angle_2_deg,sd_angle_3_deg,'
        'sd_translation_1_mm,sd_translation_2_mm,sd_translation_3_mm,status'
    )
    rows = list(csv.DictReader(text))
    assert len(rows) == 6 and rows[:3] == rows[3:]
    assert [(row['exposure'], row['status']) for row in rows[:3]] == [
        ('5', 'OK'),
        ('6', 'FAILED'),
        ('9', 'GIMBAL'),
    ]
    assert float(rows[2]['time_s']) == pytest.approx(0.026)
    assert np.deg2rad(float(rows[0]['angle_3_deg'])) == pytest.approx(7.0)
    assert np.deg2rad(float(rows[0]['sd_angle_2_deg'])) == pytest.approx(0.02)
    assert float(rows[0]['translation_2_mm']) == -2.5
    assert float(rows[0]['sd_translation_3_mm']) == pytest.approx(0.3)
    assert rows[1]['angle_1_deg'] == rows[1]['sd_translation_1_mm'] == ''
