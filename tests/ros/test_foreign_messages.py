# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Messages of other programs, and bugs that a message triggers: neither ends a node."""

import time
from dataclasses import replace

import pytest
import rclpy
from fluoro_calib_msgs.msg import TargetObservations
from rclpy.lifecycle import TransitionCallbackReturn
from rclpy.node import Node
from rclpy.qos import ReliabilityPolicy
from ros_graph import DEADLINE, NAMES, value_of
from sensor_msgs.msg import CameraInfo

from fluoro_calib_ros.nodes.correction_node import CorrectionNode
from fluoro_calib_ros.nodes.messages.observations import message_from_frame
from fluoro_calib_ros.nodes.runtime import diagnostics
from fluoro_calib_ros.nodes.runtime.topics import latched_qos, observations_qos


def drift_observations(status):
    return int(value_of(status, 'observations') or 0)


def test_camera_info_of_another_camera_does_not_restart_the_drift_watch(
    graph, by_command, tracking
):
    """The other camera is named, and the watch keeps its previous observations."""
    client = graph.client
    points = client.listen('reconstruction/points_with_covariance')
    node = graph.whole_chain(by_command)['reconstruction_node']

    def show(numbers):
        for number in numbers:
            for name in NAMES:
                client.publish(tracking[name][number])
            client.wait_until(lambda shown=number + 1: len(points) >= shown - 20, what='points')

    show(range(180))
    before = client.wait_for_diagnostics(
        'reconstruction_node', lambda s: drift_observations(s) > 0, 'drift'
    )
    foreign = client.create_publisher(CameraInfo, 'a/camera_info', latched_qos())
    client.wait_until(foreign.get_subscription_count, what='the reconstruction node')
    webcam = CameraInfo(width=640, height=480)
    webcam.header.frame_id = 'webcam'
    near = CameraInfo(width=640, height=480)
    near.header.frame_id = 'a_optical'
    for info, told in (
        (webcam, 'the camera_info is of frame webcam, not of a_optical'),
        (near, 'the camera_info of 640 x 480 px has the principal distance 0 px'),
    ):
        foreign.publish(info)
        client.wait_until(lambda told=told: told in node.log, what='the warning')
    show(range(180, 360))
    client.wait_for_diagnostics(
        'reconstruction_node',
        lambda s: drift_observations(s) > 1.5 * drift_observations(before),
        'drift',
    )
    client.destroy_publisher(foreign)


def test_camera_info_without_image_size_is_ignored(graph, by_command, tracking):
    """The driver of an uncalibrated camera publishes such messages on a topic of the same name."""
    client = graph.client
    foreign = client.create_publisher(CameraInfo, 'a/camera_info', latched_qos())
    foreign.publish(CameraInfo())
    points = client.listen('reconstruction/points_with_covariance')
    node = graph.whole_chain(by_command)['reconstruction_node']
    client.wait_until(foreign.get_subscription_count, what='the reconstruction node')

    def warned(info, text):
        foreign.publish(info)  # publish again: the message of the correction node may replace it
        return text in node.log

    client.wait_until(lambda: warned(CameraInfo(), 'size is 0 x 0 px'), what='the first warning')
    client.wait_until(
        lambda: warned(CameraInfo(width=1024), '1024 x 0 px'), what='the second warning'
    )
    for row in range(3):
        for name in NAMES:
            client.publish(replace(tracking[name][row], number=row))
    client.wait_until(lambda: len(points) == 3, what='the points')
    client.wait_for_diagnostics(
        'reconstruction_node',
        lambda s: value_of(s, 'exposures reconstructed') == '3',
        'reconstruction',
    )
    client.destroy_publisher(foreign)
    assert node.running and 'a/camera_info: the image size is 0 x 0 px' in node.log
    assert 'Traceback' not in node.log and node.end() == 0


@pytest.mark.parametrize('end', ['publisher', 'subscription'])
def test_qos_override_of_one_topic_leaves_the_others_alone(graph, end):
    client = graph.client
    topic = {'publisher': 'corrected_observations', 'subscription': 'target_observations'}[end]
    full_name = f'{graph.namespace}/a/{topic}'
    graph.start(
        'correction_node',
        {
            f'qos_overrides.{full_name}.{end}.reliability': 'best_effort',
            f'qos_overrides.{full_name}.{end}.depth': 7,
        },
        wait=False,
    )

    def reliability(get, name, other):
        ends = get(f'{graph.namespace}/{name}/{other}')
        found = {e.qos_profile.reliability for e in ends if e.node_name == 'correction_node'}
        return found.pop() if found else None

    def outputs(name):
        return reliability(client.get_publishers_info_by_topic, name, 'corrected_observations')

    def inputs(name):
        return reliability(client.get_subscriptions_info_by_topic, name, 'target_observations')

    client.wait_until(lambda: all(outputs(n) and inputs(n) for n in NAMES), what='the node')
    found = {(kind, n): get(n) for kind, get in (('out', outputs), ('in', inputs)) for n in NAMES}
    changed = ('out' if end == 'publisher' else 'in', 'a')
    expected = dict.fromkeys(found, ReliabilityPolicy.RELIABLE)
    expected[changed] = ReliabilityPolicy.BEST_EFFORT
    assert found == expected


def test_an_exception_in_a_callback_costs_one_frame(ros, monkeypatch, tracking):
    """A bug in a callback: the frame is lost, counted and reported, and the node continues."""
    original = CorrectionNode._on_frame

    def with_bug(self, name, frame, info):
        if frame.frame_number == 13:
            raise IndexError('thirteen')
        original(self, name, frame, info)

    monkeypatch.setattr(CorrectionNode, '_on_frame', with_bug)
    node = CorrectionNode()
    client = Node('client')
    try:
        for transition in (node.trigger_configure, node.trigger_activate):
            assert transition() == TransitionCallbackReturn.SUCCESS
        output = client.create_publisher(
            TargetObservations, 'a/target_observations', observations_qos()
        )
        stream = node.streams['a']

        def publish(number):
            output.publish(message_from_frame(replace(tracking['a'][0], number=number)))

        def first_received():
            publish(12)  # lost until the reader discovers the publisher
            return stream.waiting

        wait_until(client, first_received)
        for number in (13, 14):
            publish(number)
        wait_until(client, lambda: stream.refusals.failures)
        before = stream.waiting
        wait_until(client, lambda: publish(14) or stream.waiting > before)
        wait_until(client, lambda: stream.received == stream.waiting)
        assert stream.refusals.failures == 1
        a, b = node.diagnose()
        assert a.level == diagnostics.ERROR and b.level == diagnostics.WARN
        assert a.message == (
            '1 frames lost by internal errors: topic a/target_observations: IndexError: thirteen'
        )
        assert a.values['frames lost by internal errors'] == 1 and not node.failed
    finally:
        node.stop()
        node.destroy_node()
        client.destroy_node()


def wait_until(node, condition):
    """Spin a node until a condition is true."""
    end = time.monotonic() + DEADLINE
    while not condition():
        assert time.monotonic() < end
        rclpy.spin_once(node, timeout_sec=0.05)
