# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""A stream in which every tenth message is damaged: the nodes correct all good messages and count
the damaged ones.
"""

import itertools

import numpy as np
import pytest
from fluoro_calib_msgs.msg import TargetObservations
from rclpy.serialization import deserialize_message, serialize_message
from ros_graph import NAMES, value_of

from fluoro_calib_ros.nodes.messages.observations import float64_field, message_from_frame


def shorter(message):
    message.u = message.u[:-1]


def other_size(message):
    message.image_width = 512


def other_frame(message):
    message.header.frame_id = 'b_optical'


def repeated(message):
    message.target_id[1] = message.target_id[0]


def bad_sigma(message):
    message.sigma = float64_field([0.2] * (len(message.u) - 1) + [-0.2])


def no_number(message):
    message.u[3] = np.nan


def off_the_image(message):
    message.v[3] = 5000.0


KINDS = {
    'lengths': shorter,
    'image size': other_size,
    'frame id': other_frame,
    'repeated target': repeated,
    'sigma': bad_sigma,
    'undecodable': None,
    'NaN': no_number,
    'off': off_the_image,
}
ONE_POINT = ('NaN', 'off')  # the other points of these frames are corrected
COUNT = 1600


@pytest.fixture(scope='module')
def stream(module_graph, by_command, tracking):
    """1,600 messages of each fluoroscope; every tenth message of a is damaged in some way."""
    graph = module_graph
    client = module_graph.client
    graph.corrected = {name: client.listen(f'{name}/corrected_observations') for name in NAMES}
    graph.points = client.listen('reconstruction/points_with_covariance')
    graph.nodes = graph.whole_chain(by_command)
    graph.wait_for_readers(2)
    kinds = itertools.cycle(KINDS)
    graph.damaged = {number: next(kinds) for number in range(5, COUNT, 10)}
    damaged = {'a': graph.damaged, 'b': {}}
    messages = [
        (name, message_of(tracking[name][number % 360], number, damaged[name].get(number)))
        for number in range(COUNT)
        for name in NAMES
    ]
    last = graph.corrected['b'], graph.points
    client.publish_in_step(
        messages, lambda: 2 * min(of_one[-1].frame_number if of_one else 0 for of_one in last)
    )
    graph.good = [n for n in range(COUNT) if graph.damaged.get(n, 'NaN') in ONE_POINT]
    client.wait_until(
        lambda: all(
            of_one and of_one[-1].frame_number == COUNT - 1 for of_one in graph.corrected.values()
        ),
        what='the last corrected frames',
    )
    client.wait_until(
        lambda: graph.points and graph.points[-1].frame_number == COUNT - 1, what='the last points'
    )
    return graph


def message_of(frame, number, kind):
    message = message_from_frame(frame)
    message.frame_number = number
    if kind == 'undecodable':
        return bytes(serialize_message(message))[:60]
    if kind:
        KINDS[kind](message)
    return message


def test_every_good_frame_is_corrected_once_and_in_order(stream):
    assert [m.frame_number for m in stream.corrected['a']] == stream.good
    assert [m.frame_number for m in stream.corrected['b']] == list(range(COUNT))
    assert [m.frame_number for m in stream.points] == stream.good


def test_single_bad_points_are_invalid_and_the_others_corrected(stream):
    for message in stream.corrected['a']:
        invalid = np.flatnonzero(np.array(message.status) == message.INVALID)
        expected = [3] if stream.damaged.get(message.frame_number) in ONE_POINT else []
        assert list(invalid) == expected and list(np.flatnonzero(np.isnan(message.u))) == expected
        assert list(np.flatnonzero(np.isnan(message.correction_sd))) == expected


def test_bad_frames_are_counted_by_kind(stream):
    each = len(stream.damaged) // len(KINDS)
    status = stream.client.wait_for_diagnostics(
        'correction_node', lambda s: value_of(s, 'frames received') == str(COUNT)
    )
    for kind in KINDS:
        if kind not in ONE_POINT:
            assert value_of(status, f'refused: {kind}') == str(each), kind
    assert value_of(status, 'invalid points') == str(2 * each)
    assert value_of(status, 'frames corrected') == str(len(stream.good)) and status.level == b'\1'
    other = stream.client.wait_for_diagnostics('correction_node', lambda s: True, 'b')
    assert value_of(other, 'frames refused') == '0'


def test_nodes_are_still_running_without_traceback(stream):
    for node in stream.nodes.values():
        assert node.running and 'Traceback' not in node.log


def test_truncated_bytes_cannot_be_decoded_by_rclpy(tracking):
    """The damage is real: rclpy cannot decode the bytes."""
    with pytest.raises(Exception):  # noqa: B017 the type depends on the middleware
        deserialize_message(message_of(tracking['a'][0], 1, 'undecodable'), TargetObservations)
