# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Publish 10,000 observations of fluoroscope a per second until terminated.

Every hundredth message has 100,000 points; the others have none of the calibrated fluoroscope.
"""

import itertools
import sys
import time

import rclpy
from fluoro_calib_msgs.msg import TargetObservations
from rclpy.serialization import serialize_message

from fluoro_calib_ros.nodes.messages.observations import float64_field, uint32_field
from fluoro_calib_ros.nodes.runtime.topics import observations_qos

POINTS = 100_000
PERIOD_S = 1e-4
LARGE = 100


def main():
    rclpy.init()
    node = rclpy.create_node('flooder', namespace=sys.argv[1])
    output = node.create_publisher(TargetObservations, 'a/target_observations', observations_qos())
    small = TargetObservations(image_width=7, image_height=7)
    large = TargetObservations(image_width=1024, image_height=1024)
    large.target_id = uint32_field(range(POINTS))
    large.u = large.v = float64_field([512.0] * POINTS)
    contents = [bytes(serialize_message(message)) for message in (small, large)]
    start = time.monotonic()
    for number in itertools.count():
        while time.monotonic() < start + number * PERIOD_S:
            pass
        output.publish(contents[number % LARGE == 0])


if __name__ == '__main__':
    main()
