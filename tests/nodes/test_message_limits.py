# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Messages that exceed the limits or contain nonsense are reported in one sentence."""

import numpy as np
import pytest
import rigs
from fluoro_calib_msgs.msg import RigOrientation
from rclpy.serialization import serialize_message

from fluoro_calib_ros.errors import DataError
from fluoro_calib_ros.exposures.frame import Frame
from fluoro_calib_ros.limits import ReadLimits, use_read_limits
from fluoro_calib_ros.nodes.frame_validation import with_limit
from fluoro_calib_ros.nodes.messages.fluoroscope_calibration import (
    calibration_from_message,
    message_from_calibration,
)
from fluoro_calib_ros.nodes.messages.observations import (
    decode_target_observations,
    message_from_frame,
)
from fluoro_calib_ros.nodes.messages.rig_orientation import (
    message_from_orientation,
    orientation_from_message,
)
from fluoro_calib_ros.nodes.runtime.streams import TooLarge
from fuzz.seeds import orientation

pytestmark = pytest.mark.ros


@pytest.fixture
def limited():
    """Set limits, and restore the default ones after the test."""
    yield lambda **changes: use_read_limits(ReadLimits(**changes))
    use_read_limits(ReadLimits())


def test_calibration_of_too_many_training_points(limited):
    calibration = rigs.pincushion('a', (64, 64))
    message = message_from_calibration(calibration)
    count = len(calibration.model.train_uv)
    limited(max_training_points=count - 1)
    with pytest.raises(DataError, match=f'{count} training points'):
        calibration_from_message(message)


@pytest.mark.parametrize('with_sigma', [False, True])
def test_limit_of_points_is_the_same_with_and_without_sigma(with_sigma):
    def message(count):
        points = np.zeros(count)
        sigma = np.ones(count) if with_sigma else None
        ids = np.arange(count)
        return bytes(
            serialize_message(
                message_from_frame(
                    Frame('a', 1, ids, np.stack([points, points], 1), (9, 9), sigma)
                )
            )
        )

    decode = with_limit(decode_target_observations, 20)
    assert len(decode(message(20)).u) == 20
    with pytest.raises(TooLarge):
        decode(message(21))


def test_orientation_without_fluoroscopes():
    with pytest.raises(DataError, match='it has no fluoroscopes'):
        orientation_from_message(RigOrientation())


@pytest.mark.parametrize('name', ['covariance', 'x', 'qw', 'c'])
def test_orientation_with_giant_numbers(name):
    message = message_from_orientation(orientation())
    getattr(message, name)[0] = 1.7e308
    with pytest.raises(DataError, match=f'the array {name} holds a number'):
        orientation_from_message(message)
