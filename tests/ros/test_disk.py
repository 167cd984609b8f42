# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Nodes on a disk that is really full."""

import shutil

import pytest
from fluoro_calib_msgs.srv import Calibrate
from ros_graph import JOB_DEADLINE, NAMES, value_of
from small_disk import Disk

from fluoro_calib_ros.io.bags.reader import iterate_messages
from fluoro_calib_ros.io.bags.salvage import recover_bag
from fluoro_calib_ros.io.calibration import load_calibrations


@pytest.fixture
def disk(tmp_path):
    with Disk(tmp_path / 'disk') as disk:
        yield disk


def test_calibration_is_used_and_the_saved_one_kept_where_the_disk_is_full(
    graph, disk, by_command, exposures
):
    """A disk with no space at all is reported before the job, any other shortage in the answer."""
    client = graph.client
    folder = disk.path / 'calibrations'
    shutil.copytree(by_command, folder)
    saved = {name: c.calibration_id for name, c in load_calibrations(folder).items()}
    node = graph.calibration_node(folder)
    for pair in zip(*(frames[:5] for frames in exposures.values())):
        for frame in pair:
            client.publish(frame)
    client.wait_for_status(lambda s: s.exposures == 5)
    disk.leave(0)
    before = disk.contents()
    answer = client.call(Calibrate, 'calibrate', model='none')
    assert not answer.success and 'cannot be written (no space left on device)' in answer.message
    disk.leave(20)
    answer = client.result_of(
        client.call_async(Calibrate, 'calibrate', model='none'), JOB_DEADLINE, 'the calibration'
    )
    assert answer.success and 'in use but not saved' in answer.message
    assert 'no space left on device' in answer.message and disk.contents() == before
    client.wait_for_status(lambda s: s.calibration_id == answer.calibration_id[0])
    assert node.end() == 0 and 'Traceback' not in node.log
    published = {name: client.listen(f'{name}/calibration') for name in NAMES}
    graph.calibration_node(folder)
    client.wait_until(lambda: all(published.values()), what='the saved calibrations')
    assert {name: m[-1].calibration_id for name, m in published.items()} == saved


def test_recorder_on_a_full_disk_says_so_and_keeps_what_it_has(graph, disk, exposures, tmp_path):
    client = graph.client
    topic = f'{graph.namespace}/a/target_observations'
    disk.leave(60)
    recorder = graph.start(
        'recorder_node',
        {'folder': disk.path / 'bag', 'topics': f"['{topic}']", 'flush_period': 0.05},
    )
    client.wait_until(
        lambda: client._outputs['a'].get_subscription_count() == 1, what='the subscription'
    )
    client.wait_until_known_to('recorder_node')
    frames = exposures['a']

    def is_told():
        for frame in frames:
            client.publish(frame)
        status = client.statuses.get('recorder_node: recorder')
        return status and status.level == b'\2' and value_of(status, 'messages dropped') != '0'

    client.wait_until(is_told, what='the fault')
    assert 'no space left on device' in client.statuses['recorder_node: recorder'].message
    recorder.interrupt()
    assert recorder.wait() == 1 and 'Traceback' not in recorder.log
    recovered = recover_bag(disk.path / 'bag', tmp_path / 'out').counts
    assert recovered[topic] == len(list(iterate_messages(tmp_path / 'out'))) > 0
