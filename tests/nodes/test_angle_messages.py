# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Angles in messages: the angle field of a calibration, earlier definitions, joint states."""

import functools
from dataclasses import replace

import numpy as np
import pytest
import rigs
from builtin_interfaces.msg import Time
from rclpy.serialization import serialize_message
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from sensor_msgs.msg import JointState

from fluoro_calib_ros.correction.angle_field import packed_angles
from fluoro_calib_ros.correction.fluoroscope_calibration import NoiseProfile
from fluoro_calib_ros.errors import DataError
from fluoro_calib_ros.io.bags.metadata import (
    ADDED,
    FLUOROSCOPE_CALIBRATION,
    earlier_text,
    from_cdr,
    present_cdr,
)
from fluoro_calib_ros.nodes.messages.fluoroscope_calibration import (
    calibration_from_message,
    decode_fluoroscope_calibration,
    message_from_calibration,
)
from fluoro_calib_ros.nodes.messages.observations import decode_joint_state

# Type hashes (REP-2016) of FluoroscopeCalibration before it had angles, and before it had a noise
# profile.
EARLIER_HASHES = (
    'RIHS01_0f953840578d8b58b031c13ce41212b81930fc2fb1ab721e149235d7490eaf4a',
    'RIHS01_114db66782793eb5b2d2a006354e69009304cdc156d56be9b3abae2d333fa6a6',
)


@pytest.fixture(scope='module')
def plain():
    return rigs.calibrated('a', 6, max_iterations=2).calibrations['a']


@pytest.fixture(scope='module', params=[3, 5])
def turning(plain, request):
    return rigs.turning(plain, degree=request.param)


@functools.cache
def earlier_store(changes):
    """Return message types with the definition after `changes` changes; do not modify them."""
    store = get_typestore(Stores.ROS2_JAZZY)
    text = earlier_text(FLUOROSCOPE_CALIBRATION, changes)
    store.register(get_types_from_msg(text, FLUOROSCOPE_CALIBRATION))
    return store


def earlier_bytes(calibration, changes=0):
    """Return a message as encoded after the first `changes` changes of its definition."""
    present = from_cdr(
        serialize_message(message_from_calibration(calibration)), FLUOROSCOPE_CALIBRATION
    )
    store = earlier_store(changes)
    kind = store.types[FLUOROSCOPE_CALIBRATION]
    added = [name for names in ADDED[FLUOROSCOPE_CALIBRATION][changes:] for name in names]
    fields = {n: v for n, v in vars(present).items() if n not in added and n != '__msgtype__'}
    return bytes(store.serialize_cdr(kind(**fields), FLUOROSCOPE_CALIBRATION))


def test_angle_field_of_a_message_is_the_same_to_the_last_bit(turning):
    data = serialize_message(message_from_calibration(turning))
    found = calibration_from_message(decode_fluoroscope_calibration(data))
    assert found.calibration_id == turning.calibration_id
    for one, other in zip(packed_angles(found.angle_field), packed_angles(turning.angle_field)):
        assert np.array_equal(one, other)
    uv = np.random.default_rng(0).uniform(100, 800, (50, 2))
    for angle in (0.3, None):
        one, other = found.correct(uv, angle=angle), turning.correct(uv, angle=angle)
        assert np.array_equal(one.uv, other.uv) and np.array_equal(one.sigma, other.sigma)


def test_calibration_without_angles_has_empty_arrays(plain):
    message = message_from_calibration(plain)
    assert not any(len(getattr(message, name)) for name in ADDED[FLUOROSCOPE_CALIBRATION][0])
    assert calibration_from_message(message).angle_field is None


@pytest.mark.parametrize(
    'name, values, said',
    [
        (
            'angle_coefficients',
            [0.0] * 79,
            'angle_coefficients has 79 values, 80 or 168',
        ),
        ('angle_coefficients', [], 'coefficients of an angle field have shape'),
        ('angle_variances', [0.0] * 33, 'angle_variances has 33 values, 15246 are expected'),
        ('angles', [], 'angles of an angle field'),
        ('angles', [np.nan] * 5, 'angles holds nan'),
        ('angles', [90.0] * 5, 'angles'),
        ('angle_coefficients', [1e300] * 80, 'angle_coefficients'),
    ],
)
def test_damaged_angles_are_refused_in_one_sentence(turning, name, values, said):
    message = message_from_calibration(turning)
    setattr(message, name, values)
    with pytest.raises(DataError, match=said) as refused:
        calibration_from_message(message)
    assert '\n' not in str(refused.value)


def test_changed_angles_do_not_match_the_id(turning):
    message = message_from_calibration(turning)
    message.angles[0] += 1e-9
    with pytest.raises(DataError, match='does not match its id'):
        calibration_from_message(message)


@pytest.mark.parametrize('changes, expected', list(enumerate(EARLIER_HASHES)))
def test_earlier_definition_is_the_one_that_was_recorded(changes, expected):
    assert earlier_store(changes).hash_rihs01(FLUOROSCOPE_CALIBRATION) == expected


@pytest.mark.parametrize('changes', range(len(EARLIER_HASHES)))
@pytest.mark.parametrize(
    'model, padding', [('collocation', 0), ('knn', 0), ('knn', 4), ('none', 0), ('none', 4)]
)
def test_message_of_an_earlier_definition_is_read(model, padding, changes):
    calibration = rigs.calibrated('a', 6, model=model, max_iterations=2).calibrations['a']
    calibration = replace(calibration, noise_profile=None)
    # Each empty float64 sequence may leave four padding bytes of arbitrary content at the end.
    data = earlier_bytes(calibration, changes) + b'\xff' * padding
    found = calibration_from_message(decode_fluoroscope_calibration(data))
    assert found.calibration_id == calibration.calibration_id
    offline = from_cdr(data, FLUOROSCOPE_CALIBRATION)
    assert offline.calibration_id == calibration.calibration_id and not len(offline.angles)
    assert from_cdr(present_cdr(data, FLUOROSCOPE_CALIBRATION), FLUOROSCOPE_CALIBRATION)


def test_turning_calibration_of_the_definition_before_noise_profiles_is_read(turning):
    turning = replace(turning, noise_profile=None)
    found = calibration_from_message(decode_fluoroscope_calibration(earlier_bytes(turning, 1)))
    assert found.calibration_id == turning.calibration_id


def test_noise_profile_of_a_message_is_the_same_to_the_last_bit(plain):
    plain = replace(plain, noise_profile=NoiseProfile(0.8, 1.3, 1.1))
    data = serialize_message(message_from_calibration(plain))
    found = calibration_from_message(decode_fluoroscope_calibration(data))
    assert found.noise_profile == plain.noise_profile
    assert found.calibration_id == plain.calibration_id


@pytest.mark.parametrize(
    'values, said',
    [
        ([1.0, 2.0], 'has 2 values, 3 are expected'),
        ([1.0, 1e9, 1.0], 'noise_profile holds a value beyond'),
        ([0.0, 1.0, 1.0], 'factors that no image has'),
        ([1.0, np.nan, 1.0], 'noise_profile holds nan'),
        ([1.0, 1.0, -1.0], 'noise_profile holds -1.0'),
    ],
)
def test_damaged_noise_profile_is_refused_in_one_sentence(plain, values, said):
    message = message_from_calibration(plain)
    message.noise_profile = values
    with pytest.raises(DataError, match=said) as refused:
        calibration_from_message(message)
    assert '\n' not in str(refused.value)


def test_truncated_messages_are_refused(turning, plain):
    for data in (
        serialize_message(message_from_calibration(turning)),
        earlier_bytes(plain),
        earlier_bytes(turning, 1),
    ):
        for length in (len(data) // 2, len(data) - 9, 20, 3, 0):
            with pytest.raises((ValueError, RuntimeError)):
                calibration_from_message(decode_fluoroscope_calibration(data[:length]))


def test_joint_state_is_read():
    message = JointState(name=['table', 'carm'], position=[0.1, -0.7])
    message.header.stamp = Time(sec=12, nanosec=34)
    stamp_ns, names, positions = decode_joint_state(serialize_message(message))
    assert stamp_ns == 12 * 10**9 + 34
    assert list(names) == ['table', 'carm'] and list(positions) == [0.1, -0.7]
    with pytest.raises((ValueError, RuntimeError)):
        decode_joint_state(serialize_message(message)[:20])
