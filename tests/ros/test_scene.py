# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Messages that the page of the dashboard shows."""

import pytest
from fluoro_calib_msgs.msg import ReconstructedPoints, TargetObservations
from rclpy.qos import QoSProfile, ReliabilityPolicy

from fluoro_calib_ros.nodes.dashboard.scene import Scene

POINTS = 'reconstruction/points_with_covariance'


@pytest.fixture
def scene(graph):
    scene = Scene(graph.namespace, graph.client.context)
    yield scene
    scene.close()


def observations(number, **columns):
    columns = {'target_id': [1], 'u': [float(number)], 'v': [5.0], **columns}
    message = TargetObservations(image_width=9, image_height=9, **columns)
    message.header.stamp.sec = number
    return message


def publish_until(client, output, message, shown):
    """Publish a message again and again until it is shown; return what is."""

    def published():
        output.publish(message)
        return shown()

    return client.wait_until(published, what='the message on the page')


def test_points_of_a_bag_in_a_loop_and_of_a_restarted_publisher_are_shown(graph, scene):
    client = graph.client
    for qos in (10, QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)):
        output = client.create_publisher(TargetObservations, 'c/target_observations', qos)
        for number in (1, 2, 1, 2):

            def shown(number=number):
                return scene.radiograph('c').get('points') == [[1, number, 5]]

            publish_until(client, output, observations(number), shown)
        client.destroy_publisher(output)


def test_messages_with_columns_of_unequal_length_are_left_out(graph, scene):
    client = graph.client
    output = client.create_publisher(TargetObservations, 'c/target_observations', 10)
    publish_until(client, output, observations(1), lambda: scene.radiograph('c'))
    output.publish(observations(2, u=[1.0, 2.0]))
    publish_until(
        client,
        output,
        observations(3),
        lambda: scene.radiograph('c').get('points') == [[1, 3, 5]],
    )

    output = client.create_publisher(ReconstructedPoints, POINTS, 10)

    def points(x, number):
        one = [1.0]
        return ReconstructedPoints(
            target_id=[1], x=x, y=one, z=one, status=[0], frame_number=number
        )

    publish_until(client, output, points([1.0], 1), lambda: scene.space()['points'])
    client.wait_until(
        lambda: output.publish(points([1.0, 2.0], 2)) or not scene.space()['points'],
        what='the end of the points',
    )
