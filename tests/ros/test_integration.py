# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Issues that integrators meet: saved calibrations, duplicate nodes, remapped inputs, TF."""

import os
import select
import shutil
import signal
import subprocess
import sys

from fluoro_calib_msgs.srv import Calibrate, LoadCalibration, Orient
from ros_graph import BAGS, NAMES, ROOT, standing, value_of

from fluoro_calib_ros.estimation.calibrate import calibrate
from fluoro_calib_ros.estimation.options import CalibrationOptions
from fluoro_calib_ros.io.calibration import load_calibrations, save_calibration
from fluoro_calib_ros.io.phantom import read_phantom


def ids_in_use(client, node='correction_node'):
    """Return the calibration in use by fluoroscope, as the diagnostics state it."""
    return {
        name: value_of(client.statuses[f'{node}: {name}'], 'calibration')
        for name in NAMES
        if f'{node}: {name}' in client.statuses
    }


def wait_for_ids(client, expected, node='correction_node'):
    client.wait_until(lambda: ids_in_use(client, node) == expected, what='the calibrations')


def ids_of(folder):
    return {n: c.calibration_id for n, c in load_calibrations(folder).items()}


def save_other_calibrations(exposures, folder):
    """Save calibrations of the same rig with another model."""
    job = calibrate(exposures, read_phantom(BAGS / 'phantom.csv'), CalibrationOptions('none'))
    for calibration in job.calibrations.values():
        save_calibration(folder, calibration)
    return folder


def test_streams_are_corrected_without_a_calibration_node(graph, calibrated, exposures):
    """Correction and reconstruction start from the files of an earlier session."""
    client = graph.client
    client.listen('a/corrected_observations')
    for node in ('correction_node', 'reconstruction_node'):
        graph.start(node, {'calibration_directory': calibrated})
    wait_for_ids(client, ids_of(calibrated))
    client.wait_for_diagnostics(
        'reconstruction_node', lambda s: value_of(s, 'orientation'), 'reconstruction'
    )
    graph.wait_for_readers(1)
    client.publish(exposures['a'][0])
    corrected = client.messages['a/corrected_observations']
    client.wait_until(lambda: corrected, what='the corrected frame')
    assert corrected[0].calibration_id == ids_of(calibrated)['a']


def test_folder_without_calibrations_is_named_and_waited_for(graph, tmp_path):
    """A missing first calibration is no fault: the log names the folder."""
    node = graph.start('correction_node', {'calibration_directory': tmp_path})
    status = graph.client.wait_for_diagnostics(
        'correction_node', lambda s: 'no calibration yet' in s.message
    )
    assert not value_of(status, 'last fault')
    assert f'{tmp_path} has no calibrations yet' in node.log


def test_calibration_node_without_phantom_serves_saved_calibrations(graph, calibrated):
    client = graph.client
    graph.start('calibration_node', {'calibration_directory': calibrated})
    graph.start('correction_node')
    wait_for_ids(client, ids_of(calibrated))
    for kind, service in ((Calibrate, 'calibrate'), (Orient, 'orient')):
        answer = client.call(kind, service)
        assert not answer.success
        assert 'parameter phantom is not set: the node only serves saved' in answer.message


def test_calibrations_of_another_phantom_are_not_taken_up(graph, calibrated, tmp_path):
    """They are taken up only if the service asks for it."""
    client = graph.client
    phantom = tmp_path / 'other.csv'
    lines = (BAGS / 'phantom.csv').read_text().splitlines()
    phantom.write_text('\n'.join([*lines[:-2], lines[-1]]) + '\n')
    graph.start('calibration_node', {'phantom': phantom, 'calibration_directory': calibrated})
    status = client.wait_for_diagnostics('calibration_node', lambda s: s.level == b'\2')
    assert 'its calibrations were made with another phantom than' in status.message
    assert client.call(LoadCalibration, 'load_calibration', directory=str(calibrated)).success
    client.wait_for_diagnostics('calibration_node', lambda s: s.message == 'calibrated')


def test_every_namespace_has_its_own_folder(graph, by_command, tmp_path, monkeypatch):
    """The folders are below ROS_HOME where that is set."""
    monkeypatch.setenv('ROS_HOME', str(tmp_path / 'home'))
    folder = tmp_path / 'home' / 'fluoro_calib' / graph.namespace.strip('/')
    shutil.copytree(by_command, folder)
    graph.start('calibration_node', {'phantom': BAGS / 'phantom.csv'})
    graph.client.wait_for_diagnostics(
        'calibration_node', lambda s: value_of(s, 'calibration') == ids_of(folder)['a']
    )


def test_two_calibration_nodes_of_a_rig_are_reported(graph, calibrated, exposures, tmp_path):
    """No calibration is accepted until one of the nodes has ended."""
    client = graph.client
    other = save_other_calibrations(exposures, tmp_path / 'other')
    first = graph.calibration_node(calibrated)
    graph.start('correction_node')
    wait_for_ids(client, ids_of(calibrated))
    graph.start(
        'calibration_node',
        {'phantom': BAGS / 'phantom.csv', 'calibration_directory': other},
        {'__node': 'second_node'},
        wait=False,
    )
    names = f'{graph.namespace}/calibration_node, {graph.namespace}/second_node'
    for node in ('calibration_node', 'correction_node', 'second_node'):
        client.wait_for_diagnostics(
            node, lambda s: s.level == b'\2' and names in s.message, what='an ERROR'
        )
    assert ids_in_use(client) == ids_of(calibrated)
    assert first.end() == 0
    wait_for_ids(client, ids_of(other))
    client.wait_for_diagnostics('correction_node', lambda s: s.level != b'\2')


def test_remapped_inputs_count_as_published(graph, calibrated, exposures):
    """There is no warning about missing publishers while frames are corrected."""
    client = graph.client
    graph.calibration_node(calibrated)
    graph.start(
        'correction_node',
        {'fluoroscopes': '[a]'},
        {'a/target_observations': 'b/target_observations'},
        wait=False,
    )
    client.wait_for_diagnostics('correction_node', lambda s: s.message == 'correcting')


def test_tf_has_one_root_whatever_the_source_of_the_orientation(graph, calibrated, exposures):
    """Orientation from the calibration, then from a capture: same parent, nothing outdated."""
    client = graph.client
    client.listen('/tf_static')
    graph.whole_chain(calibrated)
    transforms = client.messages['/tf_static']
    client.wait_until(lambda: transforms, what='the transforms')
    rotations = {t.child_frame_id: t.transform.rotation for t in transforms[-1].transforms}
    assert set(rotations) == {'a_optical', 'b_optical'} and rotations['a_optical'].w == 1.0
    answer = client.call_async(Orient, 'orient', frames=3)
    pairs = zip(*(standing(exposures[name][0], 100) for name in NAMES))
    client.stream(pairs, 60.0)
    client.wait_until(answer.done, what='the answer')
    client.end_stream()
    assert answer.result().success, answer.result().message
    client.wait_until(lambda: len(transforms) > 1, what='the transforms of the capture')
    for message in transforms:
        assert {t.header.frame_id for t in message.transforms} == {'rig'}
        assert {t.child_frame_id for t in message.transforms} == {'a_optical', 'b_optical'}


def test_job_ends_with_its_killed_node(tmp_path):
    """A node that was killed with SIGKILL cannot terminate its worker process."""
    program = f"""
import sys
sys.path.insert(0, {str(ROOT / 'tests')!r})
from fluoro_calib_ros.io.bags.reader import read_frames
from fluoro_calib_ros.estimation.options import CalibrationRequest
from fluoro_calib_ros.io.phantom import read_phantom
from fluoro_calib_ros.jobs.calibration import run_in_worker_process
import multiprocessing, threading

def report(label, last):
    print(multiprocessing.active_children()[0].pid, flush=True)

if __name__ == '__main__':
    frames = read_frames({str(BAGS / 'calibration')!r}).frames
    request = CalibrationRequest(frames, read_phantom({str(BAGS / 'phantom.csv')!r}))
    run_in_worker_process(request, progress=report)
"""
    script = tmp_path / 'job.py'
    script.write_text(program)
    with subprocess.Popen(
        [sys.executable, script], cwd=ROOT, stdout=subprocess.PIPE, text=True
    ) as node:
        worker = os.pidfd_open(int(node.stdout.readline()))  # readable once the worker has ended
        os.kill(node.pid, signal.SIGKILL)
        ended, _, _ = select.select([worker], [], [], 10)
        os.close(worker)
    assert ended
