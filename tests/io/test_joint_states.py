# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Angles of the C-arm in the frames of a bag, from joint states."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from rigs import write_frame

import tests.rigs as rigs
from fluoro_calib_ros.errors import DataError
from fluoro_calib_ros.estimation.rig_orientation import standing_frames
from fluoro_calib_ros.exposures.angles import AngleOptions
from fluoro_calib_ros.io.bags.metadata import message_class
from fluoro_calib_ros.io.bags.reader import COMPRESSED_IMAGE, JOINT_STATE
from fluoro_calib_ros.io.bags.writer import BagWriter
from fluoro_calib_ros.io.calibration import save_calibration
from fluoro_calib_ros.io.observations import read_observations_csv, write_observations_csv
from fluoro_calib_ros.jobs.image_sources import ImageAngles, open_sources
from fluoro_calib_ros.jobs.sources import BagSelection, read_calibrated_source, read_source

START_NS = 10**18
STEP_NS = 40_000_000
SIZE = (1024, 1024)


def joint_state(stamp_ns, names, positions):
    time = message_class('builtin_interfaces/msg/Time')(*divmod(stamp_ns, 10**9))
    header = message_class('std_msgs/msg/Header')(time, '')
    empty = np.zeros(0)
    return message_class(JOINT_STATE)(header, names, np.asarray(positions, float), empty, empty)


def frames_of(name, count=5):
    return [
        replace(frame, number=k, stamp_ns=START_NS + k * STEP_NS)
        for k, frame in enumerate(rigs.exposures()[name][:count])
    ]


def write_bag(path, states, frames=None):
    """Write frames of a and b, then out-of-order states (topic, stamp, names, positions)."""
    with BagWriter(path) as writer:
        for frame in frames or (*frames_of('a'), *frames_of('b')):
            write_frame(writer, frame)
        for topic, stamp_ns, names, positions in states:
            message = joint_state(stamp_ns, names, positions)
            writer.write(topic, JOINT_STATE, message, START_NS + 10**10)
    return path


def with_joint(text, **options):
    return BagSelection(angles=AngleOptions(text, **options))


STATES = [
    ('/joint_states', START_NS + k * STEP_NS - 1, ['table', 'carm'], [2.0, 0.1 * k])
    for k in range(4)
]


def test_frames_get_the_position_of_the_last_state_before_them(tmp_path):
    bag = write_bag(tmp_path / 'bag', STATES)
    recording = read_source(bag, selection=with_joint('carm'))
    for name in 'ab':
        angles = [frame.angle for frame in recording.frames[name]]
        assert angles == pytest.approx([0.0, 0.1, 0.2, 0.3, 0.3], abs=1e-8)
    assert not recording.notes


def test_each_fluoroscope_has_its_own_joint_on_any_topic(tmp_path):
    other = [('/rig/b/states', s, ['lateral'], [-p[1]]) for _, s, _, p in STATES]
    bag = write_bag(tmp_path / 'bag', [*STATES, *other])
    frames = read_source(bag, selection=with_joint('a:carm,b:lateral')).frames
    assert [f.angle for f in frames['b']] == [-f.angle for f in frames['a']]
    frames = read_source(bag, selection=with_joint('b:lateral')).frames
    assert {f.angle for f in frames['a']} == {None}


def test_frames_whose_angle_is_unknown_are_counted(tmp_path):
    bag = write_bag(tmp_path / 'bag', STATES[:2])
    recording = read_source(bag, selection=with_joint('carm', angle_max_age=0.05))
    angles = [f.angle for f in recording.frames['a']]
    assert angles[:3] == pytest.approx([0.0, 0.1, 0.1], abs=1e-8)
    assert angles[3:] == [None, None]
    assert len(recording.notes) == 2
    assert (
        '2 of 5 frames of fluoroscope a have no angle, the first is frame 3'
        in (recording.notes[0])
    )
    assert 'more than angle_max_age, 0.05 s' in recording.notes[0]


@pytest.mark.parametrize(
    'states, joint, said',
    [
        ([], 'carm', 'the bag has no joint states'),
        (STATES, 'c-arm', "the bag has no joint 'c-arm', only carm, table"),
        (STATES, 'c:carm', "there is no fluoroscope 'c', only a, b"),
        (
            [*STATES, ('/other/joint_states', START_NS, ['carm'], [1.0])],
            'carm',
            "joint 'carm' is on the topics /joint_states, /other/joint_states",
        ),
    ],
)
def test_what_is_not_in_the_bag_is_said(tmp_path, states, joint, said):
    bag = write_bag(tmp_path / 'bag', states)
    with pytest.raises(DataError, match=said):
        read_source(bag, selection=with_joint(joint))


def test_joint_for_a_file_is_refused():
    with pytest.raises(DataError, match='a CSV file has the angles in a column angle_deg'):
        read_source('points.csv', image_size=(9, 9), selection=with_joint('carm'))


def test_correction_without_the_angle_it_needs_is_noted(tmp_path):
    bag = write_bag(tmp_path / 'bag', STATES, frames_of('a'))
    turning = rigs.turning(rigs.calibrated('a', 5, model='none').calibrations['a'])
    save_calibration(tmp_path / 'result', turning)
    recording, _ = read_calibrated_source(bag, tmp_path / 'result')
    (note,) = recording.notes
    assert 'depends on the angle of the C-arm, which is unknown for 5 of 5 frames' in note
    assert 'name the joint on /joint_states with --angle-joint' in note
    recording, _ = read_calibrated_source(bag, tmp_path / 'result', selection=with_joint('carm'))
    assert not recording.notes


@pytest.mark.parametrize('count', [1, 2])
def test_frames_of_a_standing_phantom_keep_their_angle(count):
    calibration = rigs.calibrated('a', 5, model='none').calibrations['a']
    frame = replace(rigs.exposures()['a'][0], angle=0.4)
    found = standing_frames({'a': [frame] * count}, {'a': calibration})
    assert found['a'].angle == frame.angle == pytest.approx(0.4)


def converted(path, *words):
    """Return the frames that `convert` writes to a CSV file."""
    assert rigs.run('convert', *words, '--to', 'observations', '--out', path) == 0
    return read_observations_csv(path, SIZE)


def test_convert_writes_the_angles_of_a_bag(tmp_path, capsys, monkeypatch):
    """They are selected by the flag or by rig.toml, and calibrations from the file use them."""
    bag = write_bag(tmp_path / 'bag', STATES[:2])
    words = (bag, '--angle-joint', 'carm', '--angle-max-age', 0.05)
    frames = converted(tmp_path / 'o.csv', *words)
    expected = read_source(bag, selection=with_joint('carm', angle_max_age=0.05)).frames
    for name in 'ab':
        angles = [frame.angle for frame in expected[name]]
        assert angles[:2] == pytest.approx([0.0, 0.1], abs=1e-8) and angles[4] is None
        assert [frame.angle for frame in frames[name]] == angles
    assert '2 of 5 frames of fluoroscope a have no angle' in capsys.readouterr().err
    assert 'angle_deg' not in converted_text(tmp_path / 'none.csv', bag)
    (tmp_path / 'rig.toml').write_text('angle_joint = {a = "carm"}')
    monkeypatch.chdir(tmp_path)
    frames = converted(tmp_path / 'rig.csv', bag)
    assert [f.angle for f in frames['a']][1] == pytest.approx(0.1, abs=1e-8)
    assert {f.angle for f in frames['b']} == {None}
    assert 'angle_deg' not in converted_text(tmp_path / 'none.csv', bag, '--angle-joint', '')


def converted_text(path, *words):
    converted(path, *words)
    return path.read_text()


def test_convert_says_what_becomes_of_angles(tmp_path, capsys):
    bag = write_bag(tmp_path / 'bag', STATES)
    words = ('convert', bag, '--angle-joint', 'carm')
    assert rigs.run(*words, '--to', 'bag', '--out', tmp_path / 'other') == 0
    assert 'has no angles of the C-arm' in capsys.readouterr().err
    assert rigs.run('convert', bag, '--to', 'bag', '--out', tmp_path / 'another') == 0
    assert 'angle' not in capsys.readouterr().err
    converted(tmp_path / 'o.csv', bag)
    words = ('convert', tmp_path / 'o.csv', '--image-size', '1024x1024', '--to', 'observations')
    words += ('--out', tmp_path / 'p.csv', '--angle-joint', 'carm')
    assert rigs.run(*words) == 1
    assert 'o.csv: the angle of a joint needs a bag' in capsys.readouterr().err


def test_convert_corrects_at_the_angles_of_a_bag(tmp_path, capsys):
    bag = write_bag(tmp_path / 'bag', STATES, frames_of('a'))
    turning = rigs.turning(rigs.calibrated('a', 5, model='none').calibrations['a'])
    save_calibration(tmp_path / 'result', turning)
    corrected = (bag, '--corrected', '--calibration', tmp_path / 'result')

    def largest_difference(frames, angles):
        return max(
            np.abs(f.uv - turning.correct(g.uv, g.sigma, angle=angle).uv).max()
            for f, g, angle in zip(frames['a'], frames_of('a'), angles, strict=True)
        )

    known = [0.0, 0.1, 0.2, 0.3, 0.3]
    frames = converted(tmp_path / 'o.csv', *corrected, '--angle-joint', 'carm')
    assert largest_difference(frames, known) < 1e-4
    assert 'depends on the angle' not in capsys.readouterr().err
    frames = converted(tmp_path / 'o.csv', *corrected, '--angle-deg', 10)
    assert largest_difference(frames, 5 * [np.deg2rad(10)]) < 1e-4
    frames = converted(tmp_path / 'o.csv', *corrected)
    assert largest_difference(frames, 5 * [None]) < 1e-4 < largest_difference(frames, known)
    assert 'which is unknown for 5 of 5 frames' in capsys.readouterr().err


@pytest.mark.long
def test_lookup_table_by_the_mean_over_the_angles_is_said(tmp_path, capsys):
    turning = rigs.turning(rigs.calibrated('a').calibrations['a'])
    save_calibration(tmp_path / 'result', turning)
    words = ('convert', tmp_path / 'result', '--to', 'lut', '--out', tmp_path / 'lut')
    assert rigs.run(*words) == 0
    assert 'lookup tables are the mean over the angles' in capsys.readouterr().err
    assert rigs.run(*words, '--angle-deg', 10) == 0
    assert 'mean over' not in capsys.readouterr().err


def test_joint_of_the_rig_may_be_without_times_but_not_missing_in_a_bag(tmp_path):
    rig = BagSelection(angles=AngleOptions('a:carm,c:other', of_rig=True))
    bag = write_bag(tmp_path / 'bag', STATES)
    frames = read_source(bag, selection=rig).frames
    assert frames['a'][1].angle == pytest.approx(0.1, abs=1e-8)
    write_observations_csv(tmp_path / 'o.csv', frames)
    again = read_source(tmp_path / 'o.csv', image_size=SIZE, selection=rig).frames
    assert [f.angle for f in again['a']] == [f.angle for f in frames['a']]
    bag = write_bag(tmp_path / 'still', [])
    with pytest.raises(DataError, match=r'no joint states.*disables it'):
        read_source(bag, selection=rig)


def test_command_line_reads_the_angles_of_a_bag(tmp_path, capsys):
    frames = [
        replace(frame, number=k, stamp_ns=START_NS + k * STEP_NS)
        for k, frame in enumerate(rigs.exposures()['a'])
    ]
    states = [
        ('/joint_states', frame.stamp_ns, ['carm'], [0.05 * k]) for k, frame in enumerate(frames)
    ]
    bag = write_bag(tmp_path / 'bag', states, frames)
    recording = read_source(bag, selection=with_joint('carm'))
    angles = [f.angle for f in recording.frames['a']]
    assert angles == pytest.approx([0.05 * k for k in range(len(frames))], abs=1e-8)
    bad = ['calibrate', str(bag), '--phantom', 'p', '--out', 'o', '--angle-joint', 'a:']
    assert rigs.run(*bad) == 2
    assert 'is not like a:joint,b:joint' in capsys.readouterr().err


@pytest.mark.parametrize(
    ('joint', 'angles'),
    [('carm', [0.1, 0.2, 0.2]), ('a:carm', [0.1, 0.2, 0.2]), ('', [None] * 3)],
)
def test_images_of_a_bag_get_the_position_of_the_last_state(tmp_path, joint, angles):
    """The state is that of the joint of their fluoroscope."""
    header = message_class('std_msgs/msg/Header')
    time = message_class('builtin_interfaces/msg/Time')
    grey = np.full((4, 6), 7, np.uint8)
    with BagWriter(tmp_path / 'bag') as bag:
        for k in (1, 2, 3):
            data = np.frombuffer(cv2.imencode('.png', grey + k)[1], np.uint8)
            image = message_class(COMPRESSED_IMAGE)(header(time(k, 0), ''), 'png', data)
            bag.write('/a/image_raw/compressed', COMPRESSED_IMAGE, image, k * 10**9)
            if k < 3:
                state = joint_state(k * 10**9 - 10**8, ['carm'], [0.1 * k])
                bag.write('/joint_states', JOINT_STATE, state, k * 10**9)
    options = AngleOptions(joint, angle_max_age=2.0)
    sources = open_sources([tmp_path / 'bag'], 'a', ImageAngles(options))
    images = list(sources.images())
    assert sources.count == 3 and [one.exposure for one in images] == [1, 2, 3]
    assert [one.angle for one in images] == pytest.approx(angles)
    assert [int(one.image[0, 0]) for one in images] == [8, 9, 10]
