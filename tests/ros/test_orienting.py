# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Orientation of the rig, from a calibration or a capture, and the calibrations to which it
belongs.
"""

import numpy as np
from fluoro_calib_msgs.srv import Calibrate, Orient, Reset
from ros_graph import BAGS, NAMES, value_of
from test_reconstruction import coordinates, publish, truth

from fluoro_calib_ros.io.calibration import load_orientation, orientation_path
from fluoro_calib_ros.nodes.messages.rig_orientation import orientation_from_message


def test_calibration_publishes_an_orientation_in_mid_stream(graph, tmp_path, tracking):
    """Calibrate twice in mid-stream: each exposure is reconstructed with its own orientation."""
    client = graph.client
    published = client.listen('rig_orientation')
    points = client.listen('reconstruction/points_with_covariance')
    corrected = {name: client.listen(f'{name}/corrected_observations') for name in NAMES}
    graph.both_nodes(tmp_path / 'calibrations', collect='request', model='none')
    node = graph.start('reconstruction_node')
    graph.wait_for_readers(2)
    client.wait_for_diagnostics(
        'reconstruction_node', lambda s: 'no orientation' in s.message, 'reconstruction'
    )
    collect(graph)
    assert client.call(Calibrate, 'calibrate').success
    client.wait_until(lambda: published, what='the orientation')
    assert published[0].source == 'joint calibration' and published[0].exposures == 15
    for name in NAMES:
        client.wait_for_diagnostics('correction_node', lambda s: value_of(s, 'calibration'), name)
    client.wait_for_diagnostics(
        'reconstruction_node', lambda s: value_of(s, 'orientation'), 'reconstruction'
    )
    publish(client, tracking, range(50), answer='b/corrected_observations')
    client.wait_until(lambda: len(points) >= 50, what='the first points')
    # Another calibration gives another orientation.
    answer = client.call(Calibrate, 'calibrate', loss='gaussian')
    assert answer.success
    publish(client, tracking, range(50, 100), answer='b/corrected_observations')
    for f, name in enumerate(NAMES):
        client.wait_for_diagnostics(
            'correction_node',
            lambda s: value_of(s, 'calibration') == answer.calibration_id[f],
            name,
        )
    client.wait_until(lambda: len(published) == 2, what='the second orientation')
    client.wait_for_diagnostics(
        'reconstruction_node',
        lambda s: value_of(s, 'orientation') == published[-1].orientation_id,
        'reconstruction',
    )
    publish(client, tracking, range(100, 150), answer='b/corrected_observations')
    client.wait_until(
        lambda: points[-1].frame_number == tracking['a'][149].number, what='the last points'
    )
    # The correction loses no frame, and every exposure is reconstructed whose views belong to the
    # same orientation.
    ids = {
        name: {m.frame_number: m.calibration_id for m in of_one}
        for name, of_one in corrected.items()
    }
    assert all(len(of_one) == len(ids[name]) == 150 for name, of_one in corrected.items())
    known = {tuple(m.calibration_id): m.orientation_id for m in published}
    assert len(known) == 2
    pairs = {n: (ids['a'][n], ids['b'][n]) for n in ids['a']}
    assert [m.frame_number for m in points] == [n for n, pair in pairs.items() if pair in known]
    assert all(m.orientation_id == known[pairs[m.frame_number]] for m in points)
    assert 'Traceback' not in node.log


def collect(graph, readers=2):
    """Play the recorded exposures; the phantom has a different pose in each."""
    graph.client.call(Reset, 'collect_anew')
    graph.play(BAGS / 'calibration', readers=readers)
    for name in NAMES:
        graph.client.wait_for_status(lambda s: s.exposures == 15, name, 'all exposures')


def test_capture_defines_the_rig_frame_of_the_points(graph, calibrated, tracking):
    client = graph.client
    published = client.listen('rig_orientation')
    points = client.listen('reconstruction/points_with_covariance')
    graph.whole_chain(calibrated, rig_frame='lab')
    client.wait_until(lambda: published, what='the first orientation')
    simulator = graph.start('simulator_node', {'scene': 'standing', 'rate': 20.0}, wait=False)
    answer = client.call(Orient, 'orient', frames=5, timeout_sec=30.0)
    assert answer.success, answer.message
    assert simulator.end() == 0
    for name in NAMES:
        client.listen(f'{name}/corrected_observations')
    graph.wait_for_readers(2)
    client.wait_until(
        lambda: published[-1].orientation_id == answer.orientation_id, what='the new orientation'
    )
    message = published[-1]
    assert (message.source, message.header.frame_id, message.exposures) == ('capture', 'lab', 5)
    saved = load_orientation(orientation_path(calibrated))
    assert saved.orientation_id == answer.orientation_id
    sent = orientation_from_message(message)
    assert np.allclose(sent.position_mm, saved.position_mm, atol=1e-9)
    assert np.allclose(sent.covariance, saved.covariance, rtol=1e-9)
    client.wait_for_diagnostics(
        'reconstruction_node',
        lambda s: value_of(s, 'orientation') == answer.orientation_id,
        'reconstruction',
    )
    publish(client, tracking, range(30), answer='b/corrected_observations')

    def of_markers():  # points of the phantom may still be in transit
        found = [m for m in points if len(m.target_id) and m.target_id[0] == 1001]
        return found if len(found) >= 30 else None

    true = truth()
    errors = []
    for m in client.wait_until(of_markers, what='the points'):
        assert m.header.frame_id == 'lab' and m.orientation_id == answer.orientation_id
        errors.append((coordinates(m)[0] - true[m.frame_number])[np.array(m.status) <= 1])
    assert (
        np.sqrt((np.concatenate(errors) ** 2).sum(axis=1).mean()) < 0.25
    )  # mm, against the true points


def test_refused_orientation_gives_the_reason(graph, tmp_path, calibrated):
    client = graph.client
    graph.calibration_node(tmp_path)
    answer = client.call(Orient, 'orient', timeout_sec=0.2)
    assert not answer.success and 'fluoroscope a is not calibrated yet' in answer.message
    assert graph.processes[-1].end() == 0
    client.wait_until(
        lambda: not client.count_publishers('rig_orientation'), what='the node to be gone'
    )
    graph.calibration_node(calibrated)
    answer = client.call(Orient, 'orient', timeout_sec=0.2, frames=3)
    assert (
        not answer.success
        and '0 of 3 frames of all fluoroscopes (a, b) came within 0.2 s' in answer.message
    )


def test_new_exposures_are_collected_on_request(graph, by_command):
    client = graph.client
    graph.calibration_node(by_command, collect='request')
    collect(graph, readers=1)
    answer = client.call(Reset, 'collect_anew')
    assert answer.success and '15 exposures discarded' in answer.message
    assert client.wait_for_status(lambda s: s.exposures == 0).calibration_id, (
        'the calibration stays'
    )
