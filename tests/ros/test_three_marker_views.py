# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Markers of three fluoroscopes, live: images, ids from the shapes of bodies, points in space."""

from array import array

import numpy as np
from marker_scenes import SCENE, THREE, bodies, covered, ids, save_three, sequence
from ros_graph import JOB_DEADLINE
from sensor_msgs.msg import Image

from fluoro_calib_ros.io.bodies import write_bodies
from fluoro_calib_ros.nodes.messages.observations import stamp_from_nanoseconds
from fluoro_calib_ros.nodes.runtime.topics import images_qos

EXPOSURES = 5
LOST = 4  # exposure whose image of b is missing
HIDDEN = 1  # row of a marker that c does not see


def message_of(image, name, number):
    message = Image(
        height=image.shape[0],
        width=image.shape[1],
        encoding='mono16',
        step=2 * image.shape[1],
        data=array('B', image.astype('<u2').tobytes()),
    )
    message.header.stamp = stamp_from_nanoseconds(10**18 + number * 10**8)
    message.header.frame_id = f'{name}_optical'
    return message


def test_markers_of_three_fluoroscopes_are_followed_together(graph):
    """A marker hidden from c is identified by a and b; one exposure has no image of b."""
    folder = graph.directory / 'result'
    save_three(folder)
    write_bodies(graph.directory / 'bodies.csv', bodies())
    client = graph.client
    found = {name: client.listen(f'{name}/target_observations') for name in THREE}
    points = client.listen('reconstruction/points_with_covariance')
    saved = {'fluoroscopes': '[a, b, c]', 'calibration_directory': folder}
    markers = {'mode': 'markers', 'bodies': graph.directory / 'bodies.csv'}
    node = graph.start('extraction_node', {**saved, **markers, 'shutter': SCENE.shutter})
    graph.start('correction_node', saved)
    graph.start('reconstruction_node', {**saved, 'patience': 1})
    images = {
        name: client.create_publisher(Image, f'{name}/image_raw', images_qos()) for name in THREE
    }
    client.wait_until(
        lambda: (
            all(output.get_subscription_count() for output in images.values())
            and client.count_subscribers('a/corrected_observations')
            and all(client.count_publishers(f'{name}/corrected_observations') for name in THREE)
        ),
        what='the nodes',
    )
    client.wait_for_diagnostics(
        'reconstruction_node',
        lambda status: any(v.key == 'orientation' and v.value for v in status.values),
        'reconstruction',
        'the orientation',
    )
    graph.wait_for_readers(2, 'extraction_node', THREE)  # the correction node and the client
    graph.wait_for_readers(1, names=THREE)
    for number, of in enumerate(sequence()[:EXPOSURES], 1):
        for name, image in of.items():
            if (name, number) != ('b', LOST):
                shown = covered(image, [HIDDEN]) if name == 'c' else image.image
                images[name].publish(message_of(shown, name, number))
        # Nodes that get no CPU time would take the views of several waiting exposures one after
        # the other, and the last view for late. An exposure without b waits for the next one.
        if number < LOST:
            client.wait_until(
                lambda number=number: len(points) == number, JOB_DEADLINE, f'points {number}'
            )
    client.wait_until(
        lambda: len(found['a']) == len(found['c']) == EXPOSURES and len(found['b']) == 4,
        JOB_DEADLINE,
        'the markers of all views',
    )
    for name, messages in found.items():
        numbers = [n for n in range(1, EXPOSURES + 1) if (name, n) != ('b', LOST)]
        assert [m.frame_number - found['a'][0].frame_number + 1 for m in messages] == numbers
        for number, message in zip(numbers, messages):
            assert (ids()[HIDDEN] in message.target_id) == (name != 'c')
            true = sequence()[number - 1][name].uv
            rows = np.searchsorted(ids(), message.target_id)
            away = np.column_stack([message.u, message.v]) - true[rows]
            assert len(away) > 5 and np.abs(away).max() < 1.0
    client.wait_until(lambda: len(points) >= EXPOSURES - 1, what='points in space')
    by_rays = dict(zip(points[0].target_id, points[0].rays))
    assert by_rays.pop(ids()[HIDDEN]) == 2 and set(by_rays.values()) == {3}
    assert node.running and 'Traceback' not in node.log


def test_three_views_that_cannot_be_followed_together_are_refused(graph):
    folder = graph.directory / 'result'
    save_three(folder)
    first = graph.directory / 'first.csv'
    first.write_text(
        'fluoroscope,exposure,target_id,u,v\n' + ''.join(f'{n},1,1,50,50\n' for n in 'ab')
    )
    node = graph.start(
        'extraction_node',
        {
            'fluoroscopes': '[a, b, c]',
            'mode': 'markers',
            'markers': first,
            'calibration_directory': folder,
        },
        wait=False,
    )
    assert node.wait() == 1
    assert "there is no fluoroscope 'c', only a, b" in node.log and 'Traceback' not in node.log
