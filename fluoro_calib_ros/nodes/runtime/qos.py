# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Quality of service of the topics.

Every function returns a new profile: rclpy writes the overrides of one topic into the profile
object that it was given, so a shared one would carry them over to other topics.
"""

from __future__ import annotations

from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions

# A fluoroscope at 1000 frames a second and a reader that is busy for a tenth of a second.
OBSERVATION_DEPTH = 100
# Images take a megabyte or more, so few are queued, a twelfth of a second at 120 Hz. A slower
# reader gets the newest ones.
IMAGE_DEPTH = 10
RECORDED_LATCHED_DEPTH = 100
# Requests that come at once and are all answered; ROS's default is 10.
REQUEST_DEPTH = 200


def observations_qos() -> QoSProfile:
    """Profile of image points and reconstructed points."""
    return _reliable(OBSERVATION_DEPTH)


def images_qos() -> QoSProfile:
    """Profile of images."""
    return _reliable(IMAGE_DEPTH)


def latched_qos() -> QoSProfile:
    """Profile of topics whose last message late subscribers receive, too."""
    return _reliable(1, DurabilityPolicy.TRANSIENT_LOCAL)


def recorded_latched_qos() -> QoSProfile:
    """Profile for playing latched topics: one player replays what many publishers have latched."""
    return _reliable(RECORDED_LATCHED_DEPTH, DurabilityPolicy.TRANSIENT_LOCAL)


def clock_qos() -> QoSProfile:
    """Profile of /clock, as rosbag2 has it."""
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST, depth=1, reliability=ReliabilityPolicy.BEST_EFFORT
    )


def services_qos() -> QoSProfile:
    """Profile of services: a burst of requests is queued, and every one of them is answered."""
    return _reliable(REQUEST_DEPTH)


def qos_overrides() -> QoSOverridingOptions:
    """Let a user override history, depth and reliability of a topic by parameters."""
    return QoSOverridingOptions.with_default_policies()


def incompatible_qos_message(topic: str, policy: str) -> str:
    """Return the message about a publisher that offers less than a subscription requests."""
    return (
        f'topic {topic}: a publisher offers an incompatible quality of service ({policy}), '
        'its messages are not received'
    )


def _reliable(depth: int, durability: DurabilityPolicy = DurabilityPolicy.VOLATILE) -> QoSProfile:
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=depth,
        reliability=ReliabilityPolicy.RELIABLE,
        durability=durability,
    )
