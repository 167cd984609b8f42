# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Messages of hostile peers: a flood, manipulated contents, and names with line breaks."""

import re
import sys
import xml.etree.ElementTree as ElementTree
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from fluoro_calib_msgs.msg import FluoroscopeCalibration, RigOrientation
from rigs import create_model
from ros_graph import ROOT, Process, value_of

from fluoro_calib_ros.exposures.frame import Frame
from fluoro_calib_ros.io.calibration import load_calibration
from fluoro_calib_ros.nodes.messages.fluoroscope_calibration import message_from_calibration
from fluoro_calib_ros.nodes.messages.observations import message_from_frame
from fluoro_calib_ros.nodes.runtime.topics import latched_qos

FRAMES = 100
LARGE = 10  # messages of the flood whose shedding is checked
MEMORY_KB = 700_000  # limit for the node; the large messages of its queue alone would take 240 MB
FORGED = '\n[FATAL] [1.0] [rig.correction_node]: forged\x1b[2J'


@pytest.fixture(scope='module')
def chain(module_graph, by_command):
    """The whole chain, with listeners."""
    client = module_graph.client
    client.listen('a/corrected_observations')
    module_graph.corrected = client.listen('b/corrected_observations')
    module_graph.orientations = client.listen('rig_orientation')
    module_graph.nodes = module_graph.whole_chain(by_command)
    client.wait_until(lambda: module_graph.orientations, what='the orientation')
    module_graph.wait_for_readers(2)
    module_graph.folder = by_command
    return module_graph


def memory_kb(process):
    """Return the peak resident memory of a process."""
    status = Path(f'/proc/{process.pid}/status').read_text()
    return int(re.search(r'VmHWM:\s*(\d+) kB', status)[1])


def test_names_cannot_forge_lines_of_the_log(chain, tracking):
    client = chain.client
    message = message_from_frame(tracking['a'][0])
    message.header.frame_id = 'a' + FORGED
    client.publish_message('a', message)
    output = client.create_publisher(RigOrientation, 'rig_orientation', latched_qos())
    client.wait_until(output.get_subscription_count, what='the readers of orientations')
    orientation = RigOrientation(orientation_id=FORGED, source=FORGED, fluoroscope=[FORGED])
    output.publish(orientation)
    logs = [chain.nodes[n] for n in ('correction_node', 'reconstruction_node')]
    client.wait_until(lambda: 'a\\n[FATAL]' in logs[0].log, what='the refusal of the frame')
    client.wait_until(lambda: 'orientation refused' in logs[1].log, what='that of the orientation')
    for node in logs:
        assert '\n[FATAL]' not in node.log and '\x1b' not in node.log
    client.destroy_publisher(output)


def allowed(node):
    """Return the names that the policy allows a node, by kind: 'publish', 'reply', ..."""
    policy = ElementTree.parse(ROOT / 'config' / 'sros2_policy.xml')
    profile = policy.find(f".//profile[@node='{node}']")
    found = {}
    for group in profile:
        (access,) = group.keys()
        found[access] = {element.text for element in group}
    return found


@pytest.mark.parametrize('node', ['calibration_node', 'correction_node', 'reconstruction_node'])
def test_policy_of_sros2_covers_the_graph(chain, node):
    """All endpoints of the running nodes are covered; only the calibration node may calibrate."""
    client = chain.client
    namespace = client.get_namespace()
    policy = allowed(node)
    for access, endpoints in (
        ('publish', client.get_publisher_names_and_types_by_node),
        ('subscribe', client.get_subscriber_names_and_types_by_node),
        ('reply', client.get_service_names_and_types_by_node),
        ('request', client.get_client_names_and_types_by_node),
    ):
        names = {name for name, _ in endpoints(node, namespace) if '/_action/' not in name}
        own = f'{namespace}/{node}/'
        names = {n.replace(own, '~/').removeprefix(f'{namespace}/') for n in names}
        assert names <= policy.get(access, set()), access
    publishes = any(name.endswith('/calibration') for name in policy['publish'])
    assert publishes == (node == 'calibration_node')


def test_points_without_sigma_meet_the_limit_at_the_first_node(chain):
    """The limit is 20,000 points; by size in bytes 40,000 would pass, but not once corrected."""
    client = chain.client
    count = 30_000
    uv = np.random.default_rng(2).uniform(0, 1000, (count, 2))
    frame = Frame('a', 1, np.arange(count), uv, (1024, 1024))
    client.publish_message('a', message_from_frame(frame))
    client.wait_for_diagnostics(
        'correction_node', lambda s: value_of(s, 'refused: too large') == '1'
    )
    client.wait_until(
        lambda: 'more than the parameter max_points' in chain.nodes['calibration_node'].log,
        what='the refusal by the calibration node',
    )


def test_good_stream_goes_on_beside_a_flood(chain, tracking, tmp_path):
    client = chain.client
    node = chain.nodes['correction_node']
    script = Path(__file__).with_name('flooder.py')
    flooder = Process([sys.executable, script, client.get_namespace()], tmp_path / 'flooder.log')
    chain.processes.append(flooder)
    try:
        client.wait_for_diagnostics(
            'correction_node', lambda s: int(value_of(s, 'refused: too large')) >= 2
        )
        before = len(chain.corrected)
        messages = [
            ('b', message_from_frame(replace(tracking['b'][i], number=i))) for i in range(FRAMES)
        ]
        client.publish_in_step(messages, lambda: len(chain.corrected) - before)
        client.wait_until(lambda: len(chain.corrected) == before + FRAMES, what='all frames of b')
        shed = client.wait_for_diagnostics(
            'correction_node', lambda s: int(value_of(s, 'refused: too large')) >= LARGE
        )
    finally:
        flooder.kill()
    assert int(value_of(shed, 'refused: image size')) > LARGE
    assert [m.frame_number for m in chain.corrected[before:]] == list(range(FRAMES))
    for one in chain.nodes.values():
        assert one.running and memory_kb(one) < MEMORY_KB, memory_kb(one)
    assert len(node.log) < 100_000


def test_changed_calibration_under_its_id_is_refused(chain):
    client = chain.client
    node = chain.nodes['correction_node']
    used = client.wait_for_diagnostics('correction_node', lambda s: value_of(s, 'calibration'))
    output = client.create_publisher(FluoroscopeCalibration, 'a/calibration', latched_qos())
    client.wait_until(output.get_subscription_count, what='the readers of calibrations')
    calibration = load_calibration(chain.folder / 'a.calibration.npz')
    for name, value in (('c', 4321.0), ('inliers', 1)):
        message = message_from_calibration(calibration)
        setattr(message, name, value)
        count = node.log.count('does not match its id')
        output.publish(message)
        client.wait_until(
            lambda count=count: node.log.count('does not match its id') > count,
            what='the refusal',
        )
    assert value_of(used, 'calibration') == calibration.calibration_id
    client.destroy_publisher(output)


def test_changed_orientation_under_its_id_is_refused(chain):
    client = chain.client
    node = chain.nodes['reconstruction_node']
    output = client.create_publisher(RigOrientation, 'rig_orientation', latched_qos())
    client.wait_until(output.get_subscription_count, what='the readers of orientations')
    sent = chain.orientations[0]
    message = RigOrientation(**{n: getattr(sent, n) for n in sent.get_fields_and_field_types()})
    message.x = [sent.x[0] + 1e-6, *sent.x[1:]]
    output.publish(message)
    client.wait_until(lambda: 'does not match its id' in node.log, what='the refusal')
    status = client.wait_for_diagnostics(
        'reconstruction_node', lambda s: value_of(s, 'orientation'), 'reconstruction'
    )
    assert value_of(status, 'orientation') == sent.orientation_id
    client.destroy_publisher(output)


def test_stream_goes_on_beside_a_hostile_calibration(chain, tracking):
    """The calibration has 200,000 training points on 4 square pixels; its grid took minutes."""
    client = chain.client
    node = chain.nodes['correction_node']
    count = 200_000
    uv = 500 + np.random.default_rng(1).uniform(0, 2, (count, 2))
    hostile = replace(
        load_calibration(chain.folder / 'a.calibration.npz'),
        model=create_model('local_linear', 50, uv, np.sin(uv), 0.1, 0.0),
        train_exposure=np.zeros(count, dtype=np.int64),
    )
    output = client.create_publisher(FluoroscopeCalibration, 'a/calibration', latched_qos())
    client.wait_until(output.get_subscription_count, what='the readers of calibrations')
    output.publish(message_from_calibration(hostile))
    before = len(chain.corrected)
    messages = [
        ('b', message_from_frame(replace(tracking['b'][i], number=i))) for i in range(FRAMES)
    ]
    client.publish_in_step(messages, lambda: len(chain.corrected) - before)
    client.wait_until(lambda: len(chain.corrected) == before + FRAMES, what='all frames of b')
    client.wait_until(
        lambda: f'calibration {hostile.calibration_id} in use' in node.log, what='its use'
    )
    assert node.running and memory_kb(node) < MEMORY_KB
    client.destroy_publisher(output)


def test_calibration_larger_than_the_limit_is_not_read(graph):
    node = graph.start('correction_node', {'max_training_points': 1000})
    client = graph.client
    output = client.create_publisher(FluoroscopeCalibration, 'a/calibration', latched_qos())
    client.wait_until(output.get_subscription_count, what='the reader of calibrations')
    for data, told in (
        (bytes(3_000_000), 'the message has 3 MB, calibrations of more than 2 MB are not read'),
        (bytes(7), 'the message on topic a/calibration cannot be decoded'),
    ):
        output.publish(data)
        client.wait_until(lambda told=told: told in node.log, what='the refusal')
    assert node.running and 'Traceback' not in node.log
    client.destroy_publisher(output)
