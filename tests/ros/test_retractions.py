# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Wrong ids that were published live are retracted, also for points in space and in bags."""

import numpy as np
import pytest
from rclpy.serialization import serialize_message
from ros_graph import NAMES
from sensor_msgs.msg import Image

from benchmarks.extraction_live import FIRST_ID, write_chain
from fluoro_calib_ros.exposures.frame import Frame
from fluoro_calib_ros.exposures.stamps import nanoseconds_from_stamp
from fluoro_calib_ros.io.bags.reader import iterate_messages, read_frames
from fluoro_calib_ros.io.bags.writer import BagWriter
from fluoro_calib_ros.io.observations import write_observations_csv
from fluoro_calib_ros.nodes.runtime.topics import images_qos

EXPOSURES = 6
WRONG, OTHER = 0, 6  # rows of a marker, and of a marker of another body whose shadow it is given
SIZE = (1024, 1024)


@pytest.fixture
def rig(graph):
    """The chain from images to points, with images; one marker of a gets the shadow of another."""
    folder = graph.directory / 'chain'
    folder.mkdir()
    write_chain(folder, EXPOSURES)
    with np.load(folder / 'truth.npz') as truth:
        first = {name: truth[name][0].copy() for name in NAMES}
    first['a'][WRONG] = first['a'][OTHER]
    first['a'][OTHER] = np.nan
    frames = {}
    for name, uv in first.items():
        seen = np.isfinite(uv[:, 0])
        frames[name] = [Frame(name, 1, FIRST_ID + np.flatnonzero(seen), uv[seen], SIZE)]
    write_observations_csv(folder / 'first.csv', frames)
    client = graph.client
    client.listen('reconstruction/retractions')
    for name in NAMES:
        client.listen(f'{name}/retractions')
        client.listen(f'{name}/target_observations')
    client.listen('reconstruction/points_with_covariance')
    saved = {'calibration_directory': folder / 'calibration'}
    known = {'bodies': folder / 'bodies.csv', 'markers': folder / 'first.csv', 'mode': 'markers'}
    graph.start('extraction_node', {**saved, **known})
    graph.start('correction_node', saved)
    graph.start('reconstruction_node', saved)
    graph.folder = folder
    return graph


def test_a_marker_that_was_something_else_is_taken_back(rig):
    client = rig.client
    outputs = {n: client.create_publisher(Image, f'{n}/image_raw', images_qos()) for n in NAMES}
    points = client.messages['reconstruction/points_with_covariance']
    observed = {name: client.messages[f'{name}/target_observations'] for name in NAMES}
    client.wait_until(
        lambda: (
            all(output.get_subscription_count() for output in outputs.values())
            and client.count_subscribers('a/corrected_observations')
            and all(client.count_publishers(f'{name}/corrected_observations') for name in NAMES)
        ),
        what='the nodes',
    )
    client.wait_for_diagnostics(
        'reconstruction_node',
        lambda status: any(v.key == 'orientation' and v.value for v in status.values),
        'reconstruction',
        'the orientation',
    )
    rig.wait_for_readers(2, 'extraction_node')  # the correction node and the client
    rig.wait_for_readers(2, 'extraction_node', key='readers of retractions')
    rig.wait_for_readers(1)
    for number, message in enumerate(iterate_messages(rig.folder / 'images')):
        outputs[message.topic.split('/')[1]].publish(message.data)
        if number % 2:  # both views of an exposure are published
            count = number // 2 + 1
            client.wait_until(
                lambda count=count: (
                    all(len(of_view) >= count for of_view in observed.values())
                    and len(points) >= count
                ),
                what=f'exposure {count}',
            )
    taken = client.messages['a/retractions']
    in_space = client.messages['reconstruction/retractions']
    client.wait_until(lambda: taken and len(in_space) == len(taken), what='the retractions')
    stamps = [nanoseconds_from_stamp(m.header.stamp) for m in observed['a']]
    for message, point in zip(taken, in_space):
        assert list(message.target_id) == list(point.target_id) == [FIRST_ID + WRONG]
        exposure = stamps.index(nanoseconds_from_stamp(message.header.stamp))
        assert FIRST_ID + WRONG in observed['a'][exposure].target_id
        assert message.header == observed['a'][exposure].header
        assert message.frame_number == point.frame_number == observed['a'][exposure].frame_number
        assert point.header == points[exposure].header
    assert not client.messages['b/retractions']
    # A bag of the same messages, read offline, contains none of these image points.
    with BagWriter(rig.folder / 'bag') as bag:
        for kind, messages in (('TargetObservations', observed['a']), ('Retraction', taken)):
            topic = 'retractions' if kind == 'Retraction' else 'target_observations'
            for message in messages:
                stamp_ns = nanoseconds_from_stamp(message.header.stamp)
                data = serialize_message(message)
                bag.write(f'/a/{topic}', f'fluoro_calib_msgs/msg/{kind}', data, stamp_ns)
    contents = read_frames(rig.folder / 'bag')
    wrong = {m.frame_number for m in taken}
    for frame, message in zip(contents.frames['a'], observed['a'], strict=True):
        taken_back = {FIRST_ID + WRONG} if frame.number in wrong else set()
        expected = set(message.target_id) - taken_back
        assert set(frame.target_id.tolist()) == expected
    assert contents.notes == (f'not used: {len(taken)} image points whose ids were retracted',)
