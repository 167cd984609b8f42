# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The published calibration is latched, reloaded after a restart, and replaced in mid-stream."""

import itertools
import shutil
from dataclasses import replace

import numpy as np
from fluoro_calib_msgs.srv import LoadCalibration, SaveCalibration
from ros_graph import NAMES

from fluoro_calib_ros.io.calibration import load_calibrations, save_calibration


def ids_in(folder):
    return {name: c.calibration_id for name, c in load_calibrations(folder).items()}


def test_late_joiner_and_restart(graph, calibrated):
    client = graph.client
    ids = ids_in(calibrated)
    for _ in range(2):  # the second pass uses a new node
        node = graph.calibration_node(calibrated)
        for name in NAMES:
            late = client.listen(f'{name}/calibration')
            client.wait_until(lambda: late, what='the latched calibration')
            assert [m.calibration_id for m in late] == [ids[name]]
            assert (
                client.wait_for_status(lambda s: s.calibration_id, name).calibration_id
                == ids[name]
            )
            client.messages[f'{name}/calibration_status'].clear()
        assert node.end() == 0, node.log
        client.wait_until(
            lambda: not client.count_publishers('a/calibration'), what='the node to be gone'
        )


def test_damaged_file_is_reported_and_kept(graph, calibrated):
    file = calibrated / 'a.calibration.npz'
    client = graph.client
    damaged = file.read_bytes()[:5000]
    file.write_bytes(damaged)
    node = graph.calibration_node(calibrated)
    status = client.wait_for_diagnostics('calibration_node', lambda s: True)
    assert status.level == b'\2' and str(file) in status.message and 'damaged' in status.message
    assert f'no calibration loaded: {file}' in node.log
    assert client.wait_for_status(lambda s: True).calibration_id == ''
    answer = client.call(LoadCalibration, 'load_calibration')
    assert not answer.success and str(file) in answer.message
    assert file.read_bytes() == damaged


def test_save_and_load(graph, calibrated, tmp_path):
    client = graph.client
    ids = ids_in(calibrated)
    graph.calibration_node(tmp_path / 'none', any_directory='true')
    published = client.listen('a/calibration')
    answer = client.call(SaveCalibration, 'save_calibration')
    assert not answer.success and answer.message == 'not saved: there is no calibration to save'
    answer = client.call(LoadCalibration, 'load_calibration')
    assert not answer.success and str(tmp_path / 'none') in answer.message
    assert client.call(LoadCalibration, 'load_calibration', directory=str(calibrated)).success
    client.wait_until(lambda: published, what='the loaded calibration')
    assert published[0].calibration_id == ids['a']
    assert client.call(
        SaveCalibration, 'save_calibration', directory=str(tmp_path / 'copy')
    ).success
    assert ids_in(tmp_path / 'copy') == ids


def test_correction_before_and_after_a_calibration_in_mid_stream(
    graph, calibrated, tmp_path, tracking
):
    client = graph.client
    first = ids_in(calibrated)['a']
    other = tmp_path / 'other'
    shutil.copytree(calibrated, other)
    a = load_calibrations(other)['a']
    save_calibration(other, replace(a, interior=a.interior + [0, 0, 1.0]))
    second = ids_in(other)['a']
    corrected = client.listen('a/corrected_observations')
    graph.start('correction_node')
    pairs = (
        tuple(replace(tracking[n][i % 300], number=i + 1) for n in NAMES)
        for i in itertools.count()
    )

    for pair in itertools.islice(pairs, 10):  # there is no calibration yet
        client.publish(pair[0])
    status = client.wait_for_diagnostics('correction_node', lambda s: '10 frames' in s.message)
    assert (
        status.level == b'\1'
        and status.message == 'no calibration yet: 10 frames were not corrected'
    )
    assert corrected == []

    graph.calibration_node(calibrated, any_directory='true')
    client.wait_for_diagnostics('correction_node', lambda s: first in [v.value for v in s.values])
    client.stream(pairs, 100.0, lambda: len(corrected))  # the calibration changes within it
    client.wait_until(
        lambda: len(corrected) > 20, what='frames corrected with the first calibration'
    )
    answer = client.call_async(LoadCalibration, 'load_calibration', directory=str(other))
    client.wait_until(
        lambda: sum(m.calibration_id == second for m in corrected[-50:]) >= 20,
        what='frames corrected with the second calibration',
    )
    client.end_stream()
    assert client.result_of(answer).success
    count = client.published
    client.wait_until(lambda: len(corrected) >= count, what='all corrected frames')
    assert [m.frame_number for m in corrected] == list(range(11, count + 11)), (
        'no frame lost, none twice, in order'
    )
    ids = [m.calibration_id for m in corrected]
    assert set(ids) == {first, second} and sum(x != y for x, y in itertools.pairwise(ids)) == 1
    assert all(np.isfinite(m.u).all() for m in corrected)
