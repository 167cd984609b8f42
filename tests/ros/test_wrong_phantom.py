# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""A calibration that cannot be right is neither saved nor published; diagnostics report this."""

from dataclasses import replace

from fluoro_calib_msgs.srv import Calibrate, Reset
from ros_graph import NAMES


def relabelled(frame):
    """Return the frame with ids that are 1 too large."""
    ids = frame.target_id + 1
    known = ids <= 503
    return replace(frame, target_id=ids[known], uv=frame.uv[known])


def test_wrong_ids_are_refused_with_their_cause(graph, exposures, tmp_path):
    client = graph.client
    folder = tmp_path / 'calibrations'
    graph.calibration_node(folder)
    for name in NAMES:
        client.listen(f'{name}/calibration')
    pairs = list(zip(*exposures.values()))[:6]
    for pair in pairs:
        for frame in pair:
            client.publish(relabelled(frame))
    client.wait_for_status(lambda s: s.exposures == 6, what='six exposures')
    answer = client.call(Calibrate, 'calibrate')
    assert not answer.success
    for name in NAMES:
        assert f'fluoroscope {name}: the target ids are too large by 1' in answer.message
        status = client.wait_for_diagnostics(
            'calibration_node', lambda s: s.level == b'\2', name, what='an ERROR'
        )
        assert status.message.startswith('the last calibration was refused: fluoroscope a: ')
        assert status.message.endswith('no calibration is in use')
        assert client.messages[f'{name}/calibration'] == []
    assert not folder.exists() or not list(folder.iterdir())
    # With the correct ids, the node recovers.
    assert client.call(Reset, 'reset').success
    client.wait_for_diagnostics('calibration_node', lambda s: s.level != b'\2')
    for pair in pairs:
        for frame in pair:
            client.publish(frame)
    client.wait_for_status(lambda s: s.exposures == 6, what='six exposures')
    answer = client.call(Calibrate, 'calibrate', model='none')
    assert answer.success, answer.message
    client.wait_until(
        lambda: all(client.messages[f'{n}/calibration'] for n in NAMES), what='the calibrations'
    )
    client.wait_for_diagnostics('calibration_node', lambda s: 'calibrated' in s.message)
