"""The bytes of observations, beside the serialization of rclpy."""

from array import array
from types import SimpleNamespace

import numpy as np
import pytest
from builtin_interfaces.msg import Time
from fluoro_calib_msgs.msg import CorrectedObservations, ReconstructedPoints, TargetObservations
from rclpy.serialization import deserialize_message, serialize_message
from std_msgs.msg import Header

from fluoro_calib_ros.nodes.messages.corrected_observations import (
    decode_corrected_observations,
    encode_corrected_observations,
)
from fluoro_calib_ros.nodes.messages.fields import float64_field, uint32_field
from fluoro_calib_ros.nodes.messages.reconstructed_points import (
    PointsContent,
    encode_reconstructed_points,
    message_from_points,
)
from fluoro_calib_ros.nodes.messages.target_observations import decode_target_observations
from fluoro_calib_ros.reconstruction.intersection import IntersectedPoints

SIZES = [
    (n, frame_id, sigma)
    for n in (0, 1, 2, 3, 30, 2028)
    for sigma in (False, True)
    for frame_id in ('', 'a', 'a_optical', 'röntgen', 'x' * 256)
]


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
    """The CorrectedObservations message as rclpy makes it."""
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


def test_observations_of_which_some_are_missing_are_read():
    """An empty sequence is not aligned, what comes behind it is."""
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
        assert len(data) <= len(
            serialize_message(expected)
        )  # that may end with bytes that mean nothing
        assert repr(deserialize_message(data, CorrectedObservations)) == repr(
            expected
        )  # NaN differs from itself


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


@pytest.mark.parametrize('n', [0, 1, 2, 3, 4, 5, 30])
@pytest.mark.parametrize(
    'frame_id, ids', [('rig', ('a-1', 'b-2')), ('a_optical', ('a-12', 'b-123', 'c')), ('', ())]
)
def test_points_are_written_as_rclpy_reads_them(n, frame_id, ids):
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
    content = PointsContent(
        1_700_000_000_123_456_789,
        4_000_000_000,
        'rig-60b34b648ddef0f3',
        SimpleNamespace(frame_id=frame_id, calibration_ids=ids),
        rng.integers(0, 2**32, n, dtype=np.uint32),
        points,
    )
    expected = message_from_points(content)
    found = deserialize_message(encode_reconstructed_points(content), ReconstructedPoints)
    assert found == expected and list(found.rays) == rays.tolist()
    assert deserialize_message(serialize_message(expected), ReconstructedPoints) == found


READERS = [
    (decode_target_observations, lambda: serialize_message(observed(30))),
    (
        decode_corrected_observations,
        lambda: serialize_message(message_of(observed(30), 'a-1', corrected(30))),
    ),
]


@pytest.mark.parametrize('read, data', READERS)
def test_a_message_that_was_cut_off_is_none(read, data):
    data = data()
    for length in range(len(data)):
        with pytest.raises(ValueError):
            read(data[:length])


@pytest.mark.parametrize('read, data', READERS)
def test_damaged_bytes_never_do_worse_than_be_refused(read, data):
    rng = np.random.default_rng(1)
    data = data()
    for _ in range(3000):
        damaged = bytearray(data)
        for place in rng.integers(0, len(data) if rng.random() < 0.5 else 100, 3):
            damaged[place] = rng.choice([0, 1, 127, 128, 255, rng.integers(256)])
        try:
            read(bytes(damaged))
        except ValueError:
            pass


@pytest.mark.parametrize('read, data', READERS)
def test_big_endian_messages_are_read_too(read, data):
    """A message of empty sequences, written by hand in the other order of bytes."""
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
