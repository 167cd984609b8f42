# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Frames and TargetObservations messages, as dataclasses of the rosbags typestore."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..errors import DataError
from ..exposures.frame import Frame, stack_image_points
from .definitions import TARGET_OBSERVATIONS, message_class

TOPIC_NAME = 'target_observations'


def frame_from_message(message: Any, fluoroscope: str) -> Frame:
    """Return the Frame of a TargetObservations message.

    Raises DataError for arrays of different lengths; nothing else is validated.
    """
    try:
        target_id, uv, sigma = stack_image_points(
            message.target_id, message.u, message.v, message.sigma
        )
    except DataError as error:
        raise DataError(f'frame {message.frame_number}: {error}') from None
    stamp = message.header.stamp
    return Frame(
        fluoroscope,
        int(message.frame_number),
        target_id,
        uv,
        (int(message.image_width), int(message.image_height)),
        sigma,
        stamp.sec * 10**9 + stamp.nanosec,
        message.header.frame_id,
    )


def message_from_frame(frame: Frame) -> Any:
    """Return the TargetObservations message of a Frame."""
    uv = np.asarray(frame.uv, dtype=np.float64).reshape(-1, 2)
    stamp = message_class('builtin_interfaces/msg/Time')(*divmod(int(frame.stamp_ns), 10**9))
    sigma: Any = [] if frame.sigma is None else frame.sigma
    return message_class(TARGET_OBSERVATIONS)(
        header=message_class('std_msgs/msg/Header')(stamp, frame.frame_id),
        frame_number=int(frame.number),
        image_width=int(frame.image_size[0]),
        image_height=int(frame.image_size[1]),
        target_id=np.asarray(frame.target_id).astype(np.uint32),
        u=np.ascontiguousarray(uv[:, 0]),
        v=np.ascontiguousarray(uv[:, 1]),
        sigma=np.asarray(sigma, dtype=np.float64),
    )


def observations_topic(fluoroscope: str, namespace: str = '') -> str:
    """Return the absolute topic of the observations of a fluoroscope.

    namespace is that of the rig, such as '/rig'.
    """
    parts = [*namespace.strip('/').split('/'), fluoroscope, TOPIC_NAME]
    return '/' + '/'.join(parts).lstrip('/')


def fluoroscope_of_topic(topic: str) -> str:
    """Return the fluoroscope of a topic, which is the part of its name before the last.

    Raises DataError for a name of one part.
    """
    parts = [part for part in topic.split('/') if part]
    if len(parts) < 2:
        raise DataError(
            f'topic {topic} does not name the fluoroscope, <fluoroscope>/{TOPIC_NAME} is expected'
        )
    return parts[-2]
