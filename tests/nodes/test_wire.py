# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The bytes of stream messages, compared with the serialization of rclpy and of rosbags."""

import contextlib
from array import array
from types import SimpleNamespace

import numpy as np
import pytest
from builtin_interfaces.msg import Time
from fluoro_calib_msgs.msg import CorrectedObservations, ReconstructedPoints, TargetObservations
from rclpy.serialization import deserialize_message, serialize_message
from std_msgs.msg import Header

from fluoro_calib_ros.io.bags.metadata import from_cdr, typestore
from fluoro_calib_ros.nodes import reconstruction_output
from fluoro_calib_ros.nodes.messages.observations import (
    decode_corrected_observations,
    decode_target_observations,
    encode_corrected_observations,
    float64_field,
    stamp_from_nanoseconds,
    uint8_field,
    uint32_field,
)
from fluoro_calib_ros.nodes.messages.points import (
    PointsContent,
    encode_reconstructed_points,
)
from fluoro_calib_ros.reconstruction.intersection import IntersectedPoints

OBSERVED, CORRECTED, POINTS = (
    f'fluoro_calib_msgs/msg/{name}'
    for name in ('TargetObservations', 'CorrectedObservations', 'ReconstructedPoints')
)
SIZES = [
    (n, frame_id, sigma)
    for n in (0, 1, 2, 3, 30, 2028)
    for sigma in (False, True)
    for frame_id in ('', 'a', 'a_optical', 'röntgen', 'x' * 256)
]


# Field of each term of the covariance, and its index in the flattened matrix.
_COVARIANCE = {'cov_xx': 0, 'cov_xy': 1, 'cov_xz': 2, 'cov_yy': 4, 'cov_yz': 5, 'cov_zz': 8}


def message_from_points(content):
    """Return the message of reconstructed points, field by field."""
    orientation = content.orientation
    points = content.points
    message = ReconstructedPoints()
    message.header.stamp = stamp_from_nanoseconds(content.stamp_ns)
    message.header.frame_id = orientation.frame_id
    message.frame_number = content.frame_number
    message.target_id = uint32_field(content.target_id)
    message.x, message.y, message.z = (float64_field(column) for column in points.xyz_mm.T / 1000)
    terms = points.covariance.reshape(-1, 9).T * 1e-6
    for name, row in _COVARIANCE.items():
        setattr(message, name, float64_field(terms[row]))
    message.residual = float64_field(points.residual)
    message.rays = uint8_field(points.rays)
    message.status = uint8_field(points.status)
    message.orientation_id = content.orientation_id
    message.calibration_id = list(orientation.calibration_ids)
    return message


def observed(n, frame_id='a_optical', sigma=True):
    rng = np.random.default_rng(n)
    message = TargetObservations(
        header=Header(stamp=Time(sec=-5, nanosec=4_000_000_000), frame_id=frame_id),
        frame_number=4_000_000_000,
        image_width=1024,
        image_height=768,
    )
    message.target_id = uint32_field(rng.integers(0, 2**32, n))
    message.u = float64_field(rng.normal(500, 100, n))
    message.v = float64_field(rng.normal(500, 100, n))
    message.sigma = float64_field(rng.random(n) if sigma else [])
    return message


def corrected(n, seed=0):
    rng = np.random.default_rng(seed)
    values = rng.normal(500, 100, (4, n))
    values[:, :1] = np.nan
    return *values, rng.integers(0, 3, n).astype(np.uint8)


def message_of(source, calibration_id, arrays):
    """Return the CorrectedObservations message as built with rclpy."""
    message = CorrectedObservations(
        header=source.header,
        frame_number=source.frame_number,
        calibration_id=calibration_id,
        target_id=source.target_id,
    )
    message.u, message.v, message.sigma, message.correction_sd = (
        float64_field(a) for a in arrays[:4]
    )
    message.status = array('B', arrays[4].tobytes())
    return message


@pytest.mark.parametrize('n, frame_id, sigma', SIZES)
def test_observations_are_read_as_rclpy_reads_them(n, frame_id, sigma):
    message = observed(n, frame_id, sigma)
    found = decode_target_observations(serialize_message(message))
    assert (found.sec, found.nanosec, found.frame_id) == (-5, 4_000_000_000, frame_id)
    assert (found.frame_number, found.image_size) == (4_000_000_000, (1024, 768))
    assert found.target_id == message.target_id.tobytes()
    for name in 'u', 'v', 'sigma':
        values = getattr(found, name)
        assert np.array_equal(values, getattr(message, name)) and values.flags.aligned


def test_observations_with_empty_arrays_are_read():
    """An empty sequence is not aligned, but the data after it are."""
    for lengths in ((0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1), (1, 0, 1), (2, 1, 0), (0, 3, 3)):
        for ids in (0, 1, 2):
            message = TargetObservations(target_id=uint32_field(range(ids)))
            message.u, message.v, message.sigma = (
                float64_field(np.arange(n) + 0.5) for n in lengths
            )
            found = decode_target_observations(serialize_message(message))
            assert found.target_id == message.target_id.tobytes()
            assert all(
                np.array_equal(a, b)
                for a, b in zip(found[6:9], (message.u, message.v, message.sigma))
            )


@pytest.mark.parametrize('n, frame_id, sigma', SIZES)
def test_corrected_observations_are_written_as_rclpy_reads_them(n, frame_id, sigma):
    source = observed(n, frame_id, sigma)
    arrays = corrected(n)
    for calibration_id in ('', 'a-123', 'a-2802e916511fc237'):
        data = encode_corrected_observations(
            decode_target_observations(serialize_message(source)), calibration_id, arrays
        )
        expected = message_of(source, calibration_id, arrays)
        assert len(data) <= len(serialize_message(expected))  # rclpy may append meaningless bytes
        # Compare representations, since NaN differs from itself.
        assert repr(deserialize_message(data, CorrectedObservations)) == repr(expected)


@pytest.mark.parametrize('n, frame_id, _', SIZES)
def test_corrected_observations_are_read_as_rclpy_writes_them(n, frame_id, _):
    arrays = corrected(n)
    message = message_of(observed(n, frame_id), 'a-2802e916511fc237', arrays)
    found = decode_corrected_observations(serialize_message(message))
    assert (
        found.sec,
        found.nanosec,
        found.frame_id,
        found.frame_number,
        found.calibration_id,
    ) == (-5, 4_000_000_000, frame_id, 4_000_000_000, 'a-2802e916511fc237')
    assert (
        np.array_equal(found.target_id, message.target_id) and found.target_id.dtype == np.uint32
    )
    for name, values in zip(('u', 'v', 'sigma', 'correction_sd', 'status'), arrays):
        assert np.array_equal(getattr(found, name), values, equal_nan=True)


def points_content(n, frame_id, ids):
    """Return the content of a ReconstructedPoints message of n points."""
    rng = np.random.default_rng(n)
    rays = rng.integers(0, 3, n)
    points = IntersectedPoints(
        rng.normal(0, 100, (n, 3)),
        rng.normal(0, 1, (n, 3, 3)),
        rng.normal(0, 1, (n, 3, 3)),
        rng.random(n),
        rays,
        rng.random(n),
        rng.integers(0, 5, n).astype(np.uint8),
        rays - 1,
    )
    return PointsContent(
        1_700_000_000_123_456_789,
        4_000_000_000,
        'rig-60b34b648ddef0f3',
        SimpleNamespace(frame_id=frame_id, calibration_ids=ids),
        rng.integers(0, 2**32, n, dtype=np.uint32),
        points,
    )


@pytest.mark.parametrize('n', [0, 1, 2, 3, 4, 5, 30])
@pytest.mark.parametrize(
    'frame_id, ids', [('rig', ('a-1', 'b-2')), ('a_optical', ('a-12', 'b-123', 'c')), ('', ())]
)
def test_points_are_written_as_rclpy_reads_them(n, frame_id, ids):
    content = points_content(n, frame_id, ids)
    expected = message_from_points(content)
    found = deserialize_message(encode_reconstructed_points(content), ReconstructedPoints)
    assert found == expected and list(found.rays) == content.points.rays.tolist()
    assert deserialize_message(serialize_message(expected), ReconstructedPoints) == found


def test_points_are_encoded_once_for_all_forms(monkeypatch):
    encoded, published = [], {}

    def encode(content):
        encoded.append(content)
        return encode_reconstructed_points(content)

    def create_output(kind, topic, qos):
        return SimpleNamespace(
            publish=lambda message: published.setdefault(topic.rpartition('/')[2], message),
            get_subscription_count=lambda: 1,
        )

    monkeypatch.setattr(reconstruction_output, 'encode_reconstructed_points', encode)
    content = points_content(5, 'rig', ('a-1', 'b-2'))
    content.points.covariance[:] = np.eye(3)
    output = reconstruction_output.PointsOutput(SimpleNamespace(create_output=create_output))
    output.publish(content, sigmas=10.0, rate_hz=30.0)
    assert len(encoded) == 1 and {'points_with_covariance', 'points', 'markers'} <= set(published)
    good = np.count_nonzero(content.points.status <= 1)
    assert published['points'].width == good > 0


READERS = [
    (decode_target_observations, lambda: serialize_message(observed(30))),
    (
        decode_corrected_observations,
        lambda: serialize_message(message_of(observed(30), 'a-1', corrected(30))),
    ),
]


@pytest.mark.parametrize('read, data', READERS)
def test_a_truncated_message_is_refused(read, data):
    data = data()
    for length in range(len(data)):
        with pytest.raises(ValueError):
            read(data[:length])


@pytest.mark.parametrize('read, data', READERS)
def test_damaged_bytes_raise_nothing_but_value_error(read, data):
    rng = np.random.default_rng(1)
    data = data()
    for _ in range(3000):
        damaged = bytearray(data)
        for place in rng.integers(0, len(data) if rng.random() < 0.5 else 100, 3):
            damaged[place] = rng.choice([0, 1, 127, 128, 255, rng.integers(256)])
        with contextlib.suppress(ValueError):
            read(bytes(damaged))


@pytest.mark.parametrize('read, data', READERS)
def test_big_endian_messages_are_read_too(read, data):
    """A message of empty sequences, written manually in big-endian order."""
    count = 3 if read is decode_target_observations else 0
    numbers = (
        [(1, 4), (2, 4), (2, 4), (0x61000000, 4), (7, 4)]
        + [(640, 4), (480, 4)] * bool(count)
        + ([] if count else [(1, 4), (0, 4)])
    )
    body = b''.join(value.to_bytes(size, 'big') for value, size in numbers) + b'\0\0\0\0' * (
        4 if count else 6
    )
    found = read(b'\0\0\0\0' + body)
    assert (found.sec, found.nanosec, found.frame_id, found.frame_number) == (1, 2, 'a', 7)
    assert not len(found.u) and not len(found.target_id)


# ---- against the typestore of rosbags


@pytest.mark.parametrize('n, frame_id, sigma', SIZES)
def test_observations_of_rosbags_are_read(n, frame_id, sigma):
    source = observed(n, frame_id, sigma)
    types = typestore().types
    stamp = types['builtin_interfaces/msg/Time'](-5, 4_000_000_000)
    message = types[OBSERVED](
        types['std_msgs/msg/Header'](stamp, frame_id),
        source.frame_number,
        source.image_width,
        source.image_height,
        *(np.array(getattr(source, name)) for name in ('target_id', 'u', 'v', 'sigma')),
    )
    found = decode_target_observations(bytes(typestore().serialize_cdr(message, OBSERVED)))
    assert (found.sec, found.nanosec) == (-5, 4_000_000_000)
    assert (found.frame_id, found.frame_number) == (frame_id, message.frame_number)
    assert found.image_size == (message.image_width, message.image_height)
    assert found.target_id == message.target_id.tobytes()
    for name in 'u', 'v', 'sigma':
        assert np.array_equal(getattr(found, name), getattr(message, name))


@pytest.mark.parametrize('n, frame_id, sigma', SIZES)
def test_corrected_observations_go_to_rosbags_and_back(n, frame_id, sigma):
    source = decode_target_observations(serialize_message(observed(n, frame_id, sigma)))
    arrays = corrected(n)
    data = encode_corrected_observations(source, 'a-2802e916511fc237', arrays)
    message = typestore().deserialize_cdr(data, CORRECTED)
    assert (message.header.frame_id, message.calibration_id) == (frame_id, 'a-2802e916511fc237')
    assert (message.header.stamp.sec, message.frame_number) == (-5, 4_000_000_000)
    assert message.target_id.tobytes() == source.target_id
    again = decode_corrected_observations(bytes(typestore().serialize_cdr(message, CORRECTED)))
    for name, values in zip(('u', 'v', 'sigma', 'correction_sd', 'status'), arrays):
        assert np.array_equal(getattr(message, name), values, equal_nan=True)
        assert np.array_equal(getattr(again, name), values, equal_nan=True)
    assert again.target_id.tobytes() == source.target_id


@pytest.mark.parametrize('n', [0, 1, 2, 3, 4, 5, 30])
@pytest.mark.parametrize('ids', [('a-1', 'b-2'), ('a-12', 'b-123', 'c'), ()])
def test_points_are_read_by_rosbags(n, ids):
    content = points_content(n, 'a_optical', ids)
    found = typestore().deserialize_cdr(encode_reconstructed_points(content), POINTS)
    expected = message_from_points(content)
    assert found.header.frame_id == 'a_optical' and found.frame_number == 4_000_000_000
    assert found.orientation_id == content.orientation_id and list(found.calibration_id) == [*ids]
    for name in ('target_id', 'x', 'y', 'z', 'cov_xx', 'cov_yz', 'residual', 'rays', 'status'):
        assert np.array_equal(getattr(found, name), getattr(expected, name)), name


@pytest.mark.parametrize('n', [0, 1, 2, 20, 21])
@pytest.mark.parametrize('sigma', [True, False])
def test_bags_read_what_rclpy_writes(n, sigma):
    """Include messages without sigma, where Fast DDS pads after the last, empty sequence."""
    message = TargetObservations(frame_number=7, image_width=8, image_height=9)
    message.target_id = uint32_field(np.arange(n))
    message.u = message.v = float64_field(np.arange(n) / 3)
    if sigma:
        message.sigma = float64_field(np.full(n, 0.5))
    found = from_cdr(serialize_message(message), 'fluoro_calib_msgs/msg/TargetObservations')
    assert found.frame_number == 7
    np.testing.assert_array_equal(found.target_id, np.arange(n))
    np.testing.assert_array_equal(found.v, np.arange(n) / 3)
    np.testing.assert_array_equal(found.sigma, np.full(n if sigma else 0, 0.5))
