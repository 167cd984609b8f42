# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Invalid frames are counted, reported in one sentence, and do not affect later frames."""

import re
from array import array
from dataclasses import replace

import numpy as np
import pytest
from ros_graph import value_of

from fluoro_calib_ros.io.calibration import load_calibrations
from fluoro_calib_ros.nodes.messages.observations import float64_field, message_from_frame

BOTH = ('calibration_node', 'correction_node')
COLLECTS = ('calibration_node',)


def put(field, index, value):
    """Return a function that changes one element of an array of a message."""

    def change(message):
        getattr(message, field)[index] = value

    return change


def put_all(**fields):
    """Return a function that changes whole fields of a message."""

    def change(message):
        for name, value in fields.items():
            setattr(message, name, value(message) if callable(value) else value)

    return change


def empty(message):
    put_all(target_id=array('I'), u=array('d'), v=array('d'))(message)


def sigma_of(value):
    return put_all(sigma=lambda m: float64_field([0.2] * (len(m.u) - 1) + [value]))


BAD = {  # change of the message, nodes that refuse it, what they report
    'lengths': (put_all(u=lambda m: m.u[:-1]), BOTH, 'target ids, but'),
    'sigma lengths': (
        put_all(sigma=float64_field([0.2, 0.3])),
        BOTH,
        'target ids, but 2 values of sigma',
    ),
    'duplicate': (lambda m: put('target_id', 1, m.target_id[0])(m), BOTH, 'occurs 2 times'),
    'image size': (put_all(image_width=512), BOTH, 'the image is 512 x 1024 px'),
    'no image size': (put_all(image_width=0, image_height=0), BOTH, '0 x 0 px'),
    'negative sigma': (sigma_of(-0.1), BOTH, 'is not a positive number'),
    'NaN sigma': (sigma_of(np.nan), BOTH, 'is not a positive number'),
    'infinite sigma': (sigma_of(np.inf), BOTH, 'is not a positive number'),
    'NaN': (put('u', 3, np.nan), COLLECTS, 'is not a number'),
    'infinite': (put('v', 3, -np.inf), COLLECTS, 'is not a number'),
    'outside the image': (put('v', 3, 1024.0), COLLECTS, 'is outside the image of 1024 x 1024 px'),
    'unknown target': (
        put('target_id', -1, 99999),
        COLLECTS,
        'target 99999 is not on the phantom',
    ),
    'empty': (empty, COLLECTS, 'the frame is empty, it has no targets'),
}
ONE_POINT = {
    'NaN',
    'infinite',
    'outside the image',
}  # the correction marks this point and corrects the others


@pytest.fixture(scope='module')
def rig(module_graph, by_command, exposures):
    """Both nodes with a calibration, after all bad frames, each sent between two good ones.

    graph.bad: frame number by fault; graph.corrected: message by frame number.
    """
    graph = module_graph
    client = module_graph.client
    frame = exposures['a'][0]
    graph.nodes = graph.both_nodes(by_command, collect='request')
    corrected = client.listen('a/corrected_observations')
    used = load_calibrations(by_command)['a'].calibration_id
    client.wait_for_diagnostics('correction_node', lambda s: used in [v.value for v in s.values])
    graph.wait_for_readers(1, names='a')
    changes = [lambda message: None]
    for change, _, _ in BAD.values():
        changes += [change, lambda message: None]
    for number, change in enumerate(changes):
        message = message_from_frame(replace(frame, number=number))
        change(message)
        client.publish_message('a', message)
    graph.bad = {fault: 2 * i + 1 for i, fault in enumerate(BAD)}
    graph.published = len(changes)
    client.wait_until(
        lambda: corrected and corrected[-1].frame_number == graph.published - 1,
        what='the last frame',
    )
    client.wait_for_status(lambda s: s.frames_received == graph.published)
    graph.corrected = {m.frame_number: m for m in corrected}
    return graph


@pytest.mark.parametrize('fault', BAD)
def test_bad_frame(rig, fault):
    number = rig.bad[fault]
    (_, refusing, sentence) = BAD[fault]
    for node in refusing:
        lines = [line for line in rig.nodes[node].log.splitlines() if says(line, number)]
        assert len(lines) == 1 and sentence in lines[0]
    assert number - 1 in rig.corrected and number + 1 in rig.corrected, 'the good frames round it'
    if 'correction_node' in refusing:
        assert number not in rig.corrected
        return
    got = rig.corrected[number]
    assert len(got.u) == len(got.v) == len(got.sigma) == len(got.target_id) == len(got.status)
    invalid = np.array(got.status) == got.INVALID
    assert invalid.sum() == (fault in ONE_POINT)
    assert np.array_equal(np.isnan(got.u), invalid) and np.array_equal(
        np.isnan(got.sigma), invalid
    )


def test_bad_frames_are_counted_and_reported(rig):
    client = rig.client
    for node in rig.nodes:
        refused = [number for fault, number in rig.bad.items() if node in BAD[fault][1]]
        status = client.wait_for_diagnostics(
            node, lambda s: f'{len(refused)} frames refused' in s.message
        )
        assert status.level == b'\1'
    assert client.status().frames_rejected == len(BAD)
    values = {v.key: v.value for v in client.statuses['calibration_node: a'].values}
    assert values['frames rejected'] == str(len(BAD)) and says(
        values['last fault'], rig.bad['empty']
    )
    status = client.wait_for_diagnostics(
        'correction_node', lambda s: value_of(s, 'frames received') == str(rig.published)
    )
    assert value_of(status, 'invalid points') == str(len(ONE_POINT))


def says(sentence, number):
    """Return whether a sentence names the fluoroscope and the frame."""
    return 'fluoroscope a' in sentence and re.search(rf'frame {number}\b', sentence) is not None


def test_nodes_are_still_running_without_traceback(rig):
    for node in rig.nodes.values():
        assert node.running and 'Traceback' not in node.log


def test_frames_of_other_targets_are_ignored(rig, tracking):
    """Moving markers are no fault: the same stream shows them after the calibration."""
    rig.client.publish(tracking['a'][0])
    status = rig.client.wait_for_status(lambda s: s.frames_received == rig.published + 1)
    assert status.frames_rejected == len(BAD)
