# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Start and end of the nodes: one sentence if a node cannot start, exit status 0 after an
interrupt.
"""

import shutil
import signal
from dataclasses import replace
from pathlib import Path

import pytest
from fluoro_calib_msgs.msg import TargetObservations
from fluoro_calib_msgs.srv import Capture, LoadCalibration, Orient, SaveCalibration
from mcap.writer import Writer
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.serialization import serialize_message
from ros_graph import BAGS, NAMES, standing, value_of

from fluoro_calib_ros.io.calibration import load_calibrations
from fluoro_calib_ros.nodes.messages.fluoroscope_calibration import message_from_calibration
from fluoro_calib_ros.nodes.messages.observations import message_from_frame

TROUBLE = ('Traceback', 'Exception', 'exception', 'Error:', 'never retrieved', 'never awaited')


def bad_phantom(folder):
    lines = (BAGS / 'phantom.csv').read_text().splitlines()
    lines[4] = lines[4].replace(',', ',x', 1)
    (folder / 'phantom.csv').write_text('\n'.join(lines))
    return {'phantom': folder / 'phantom.csv'}


def damaged_bag(folder):
    shutil.copytree(BAGS / 'tracking', folder / 'bag')
    file = folder / 'bag' / 'tracking_0.mcap'
    content = bytearray(file.read_bytes())
    content[len(content) // 3] ^= 0xFF  # inside a chunk: noticed only while playing
    file.write_bytes(content)
    return {'bag': folder / 'bag', 'wait_for_readers': 0, 'rate': 1000.0}


def foreign_bag(folder):
    from fluoro_calib_ros.io.bags.writer import BagWriter

    with BagWriter(folder / 'bag'):
        pass
    return {'bag': folder / 'bag'}


def small_bag(folder, type_name='std_msgs/msg/Int64', topic='/x', messages=1, **how):
    """Write a bag with one topic; return the parameters that play it."""
    with open(folder / 'small.mcap', 'wb') as file:
        writer = Writer(file)
        writer.start('ros2', 'test')
        schema = writer.register_schema(type_name, 'ros2msg', b'int64 data') if type_name else 0
        channel = writer.register_channel(topic, 'cdr', schema)
        for number in range(messages):
            writer.add_message(channel, number, bytes((0, 1, 0, 0)) + bytes(8), number)
        writer.finish()
    return {'bag': folder / 'small.mcap', 'wait_for_readers': 0, **how}


def bag_without_messages(folder):
    return small_bag(folder, messages=0, loop='true')


def bag_without_type(folder):
    return small_bag(folder, type_name='')


def bag_of_no_message_type(folder):
    return small_bag(folder, type_name='std_msgs/msg/__file__')


def bag_with_a_wrong_topic(folder):
    return small_bag(folder, topic='/x y')


PHANTOM = {'phantom': BAGS / 'phantom.csv'}


@pytest.mark.parametrize(
    'node, parameters, sentence',
    [
        ('calibration_node', {}, 'parameter phantom is not set'),
        ('calibration_node', {'phantom': '/nowhere/phantom.csv'}, '/nowhere/phantom.csv: '),
        ('calibration_node', bad_phantom, 'phantom.csv, row 5'),
        (
            'calibration_node',
            {'phantom': BAGS / 'phantom.csv', 'model': 'spline'},
            'model must be one of',
        ),
        (
            'calibration_node',
            {'phantom': BAGS / 'phantom.csv', 'pair_by': 'luck'},
            'pair_by must be',
        ),
        (
            'calibration_node',
            {'phantom': BAGS / 'phantom.csv', 'still_px': -1.0},
            'parameter still_px must be between',
        ),
        (
            'calibration_node',
            {'phantom': BAGS / 'phantom.csv', 'fluoroscopes': '[a, a]'},
            'parameter fluoroscopes: ',
        ),
        (
            'calibration_node',
            {'phantom': '~nobody_of_that_name/x.csv'},
            'x.csv: there is no such home folder',
        ),
        (
            'calibration_node',
            {**PHANTOM, 'calibration_directory': '~nobody_of_that_name'},
            'there is no such home folder',
        ),
        (
            'calibration_node',
            {**PHANTOM, 'fluoroscopes': "['a b']"},
            "'a b' cannot be part of the name of a topic",
        ),
        ('correction_node', {'fluoroscopes': '[a, a]'}, 'parameter fluoroscopes: '),
        (
            'correction_node',
            {'fluoroscopes': '[]'},
            'parameter fluoroscopes: [] is not a list of different names',
        ),
        (
            'correction_node',
            {'fluoroscopes': '[x/y]'},
            "'x/y' cannot be part of the name of a topic",
        ),
        ('image_node', {'fluoroscopes': "['1']"}, "'1' cannot be part of the name of a topic"),
        (
            'simulator_node',
            {'fluoroscopes': '[a-b]'},
            "'a-b' cannot be part of the name of a topic",
        ),
        (
            'correction_node',
            {
                'qos_overrides./test/a/corrected_observations.publisher.reliability': 'luck',
                '__ns': '/test',
            },
            'Unexpected QoS override',
        ),
        (
            'correction_node',
            {
                'qos_overrides./test/a/target_observations.subscription.reliability': 'luck',
                '__ns': '/test',
            },
            'Unexpected QoS override',
        ),
        (
            'simulator_node',
            {
                'qos_overrides./test/a/target_observations.publisher.reliability': 'luck',
                '__ns': '/test',
            },
            'Unexpected QoS override',
        ),
        ('simulator_node', {'scene': 'cat'}, 'parameter scene must be one of'),
        ('player_node', {}, 'parameter bag is not set'),
        ('player_node', {'bag': '/nowhere/bag'}, '/nowhere/bag: there is no such bag'),
        (
            'player_node',
            {'bag': BAGS / 'calibration', 'topics': '[/c/target_observations]'},
            'there is nothing to play',
        ),
        (
            'player_node',
            {'bag': BAGS / 'calibration', 'rate': 'fast'},
            "parameter rate must be a number, not 'fast'",
        ),
        (
            'player_node',
            {'bag': BAGS / 'tracking', 'strip_prefix': '/a/target_observations'},
            "cannot be played as ''",
        ),
        ('player_node', foreign_bag, 'there is nothing to play'),
        ('player_node', bag_without_messages, 'there are no messages on /x'),
        ('player_node', bag_without_type, 'there is nothing to play'),
        ('player_node', bag_of_no_message_type, 'there is nothing to play'),
        ('player_node', bag_with_a_wrong_topic, "/x y cannot be played as 'x y'"),
        ('player_node', damaged_bag, 'is damaged'),
    ],
    ids=lambda value: value.__name__ if callable(value) else None,
)
def test_node_that_cannot_start_gives_the_reason(graph, tmp_path, node, parameters, sentence):
    parameters = dict(parameters(tmp_path) if callable(parameters) else parameters)
    namespace = {'__ns': parameters.pop('__ns')} if '__ns' in parameters else None
    process = graph.start(node, parameters, namespace, wait=False)
    assert process.wait() == 1
    lines = [line for line in process.log.splitlines() if '[FATAL]' in line]
    assert len(lines) == 1 and sentence in lines[0]
    assert not any(word in process.log for word in TROUBLE), process.log


def test_interrupt_in_the_stream_ends_every_node_cleanly(graph, by_command, exposures):
    client = graph.client
    graph.fork = False
    client.listen('a/corrected_observations')
    nodes = [
        *graph.both_nodes(by_command).values(),
        graph.start('simulator_node', {'scene': 'markers', 'rate': 120.0}),
        graph.start(
            'player_node', {'bag': BAGS / 'tracking', 'loop': True, 'wait_for_readers': 1}
        ),
    ]
    client.wait_until(
        lambda: len(client.messages['a/corrected_observations']) > 100, what='corrected frames'
    )
    for node in reversed(nodes):
        node.interrupt()
        node._process.send_signal(signal.SIGTERM)  # service managers send both signals at once
    client.wait_until(lambda: not any(n.running for n in nodes), 15, 'the nodes to end')
    for node in nodes:
        assert node.wait() == 0
        assert not any(word in node.log for word in TROUBLE), node.log


@pytest.mark.parametrize(
    'node, parameters',
    [
        ('calibration_node', {'phantom': BAGS / 'phantom.csv'}),
        ('player_node', {'bag': BAGS / 'tracking'}),
        ('recorder_node', {'folder': 'bag'}),
        ('simulator_node', {}),
    ],
)
def test_signal_at_the_first_moment_that_a_node_handles_it(graph, tmp_path, node, parameters):
    """The node has not even joined the graph."""
    if 'folder' in parameters:
        parameters = {'folder': tmp_path / parameters['folder']}
    graph.fork = False
    process = graph.start(node, parameters, wait=False)
    status = Path('/proc', str(process._process.pid), 'status')

    def handles_sigterm():
        assert process.running, process.log
        caught = next(x for x in status.read_text().splitlines() if x.startswith('SigCgt'))
        return int(caught.split()[1], 16) >> (signal.SIGTERM - 1) & 1

    graph.client.wait_until(handles_sigterm, what='the handler')
    process._process.send_signal(signal.SIGTERM)
    assert process.wait() == 0
    assert not any(word in process.log for word in TROUBLE), process.log


def test_interrupt_ends_a_running_job_and_a_waiting_capture(graph, exposures, tmp_path):
    client = graph.client
    node = graph.calibration_node(tmp_path / 'none')
    for pair in zip(*exposures.values()):
        for frame in pair:
            client.publish(frame)
    client.wait_for_status(lambda s: s.exposures == 15)
    client.call_async(Capture, 'capture', timeout_sec=600.0)
    handle = client.goal()
    handle.get_result_async()
    client.wait_until(lambda: client.feedback, what='the first feedback')
    node.interrupt()
    client.wait_until(lambda: not node.running, 15, 'the node to end')
    assert node.wait() == 0 and not any(word in node.log for word in TROUBLE), node.log
    assert not (tmp_path / 'none').exists()


def test_namespaces_are_separate(graph, exposures, tmp_path):
    """A node receives nothing from another namespace unless it is remapped."""
    client = graph.client
    graph.calibration_node(tmp_path / 'none')
    other = graph.start('correction_node', remaps={'__ns': '/elsewhere'}, wait=False)
    remapped = graph.start(
        'correction_node',
        remaps={
            '__node': 'second',
            '__ns': '/elsewhere',
            **{
                f'{n}/target_observations': f'{graph.namespace}/{n}/target_observations'
                for n in NAMES
            },
        },
        wait=False,
    )
    client.wait_until(lambda: client.subscriptions_matched('second'), what='the remapped node')
    # An interrupt while a process still loads its modules would end it with another status.
    client.wait_until(
        lambda: ('correction_node', '/elsewhere') in client.get_node_names_and_namespaces(),
        what='the other node',
    )
    for frame in standing(exposures['a'][0], 3):
        client.publish(frame)
    client.wait_for_status(lambda s: s.frames_received == 3)
    assert not any(
        r.node_namespace == '/elsewhere' and r.node_name == 'correction_node'
        for r in client.get_subscriptions_info_by_topic(f'{graph.namespace}/a/target_observations')
    )
    assert other.end() == 0 and remapped.end() == 0


def test_impossible_requests_are_answered(graph, tmp_path):
    """Impossible timeouts and unknown home folders are refused, and the node continues."""
    node = graph.calibration_node(tmp_path)
    client = graph.client
    for seconds in (1e300, 1e10):
        answer = client.call(Capture, 'capture', timeout_sec=seconds)
        assert (
            not answer.success
            and 'timeout_sec must be a time in seconds, at most 86400, not' in answer.message
        )
        assert not client.call(Orient, 'orient', timeout_sec=seconds).success
    for kind, service in (
        (SaveCalibration, 'save_calibration'),
        (LoadCalibration, 'load_calibration'),
    ):
        answer = client.call(kind, service, directory='~nobody_of_that_name/x')
        assert (
            not answer.success
            and '~nobody_of_that_name/x: there is no such home folder' in answer.message
        )
    assert node.end() == 0 and not any(word in node.log for word in TROUBLE), node.log


def test_player_latches_recorded_latched_topics(graph, by_command):
    """A late subscriber receives a latched calibration from a recording."""
    from fluoro_calib_ros.io.bags.metadata import PROFILES, to_yaml

    calibration = load_calibrations(by_command)['a']
    with open(graph.directory / 'latched.mcap', 'wb') as file:
        writer = Writer(file)
        writer.start('ros2', 'test')
        schema = writer.register_schema(
            'fluoro_calib_msgs/msg/FluoroscopeCalibration', 'ros2msg', b'string id'
        )
        channel = writer.register_channel(
            '/a/calibration',
            'cdr',
            schema,
            {'offered_qos_profiles': to_yaml([PROFILES['latched']])},
        )
        writer.add_message(
            channel, 1, bytes(serialize_message(message_from_calibration(calibration))), 1
        )
        writer.finish()
    graph.start('correction_node')
    player = graph.start(
        'player_node', {'bag': graph.directory / 'latched.mcap', 'wait_for_readers': 1}, wait=False
    )
    graph.client.wait_for_diagnostics(
        'correction_node', lambda s: value_of(s, 'calibration') == calibration.calibration_id
    )
    assert player.wait() == 0


def test_best_effort_publisher_is_received(graph, calibrated, exposures):
    """Drivers publish this way; the log warns that lost messages are not resent."""
    client = graph.client
    client.listen('a/corrected_observations')
    qos = QoSProfile(depth=100, reliability=ReliabilityPolicy.BEST_EFFORT)
    publisher = client.create_publisher(TargetObservations, 'relay', qos)
    remaps = {f'{name}/target_observations': 'relay' for name in NAMES}
    nodes = [
        graph.start(
            'calibration_node',
            {'phantom': BAGS / 'phantom.csv', 'calibration_directory': calibrated},
            remaps,
            wait=False,
        ),
        graph.start('correction_node', {'fluoroscopes': '[a]'}, remaps, wait=False),
    ]
    corrected = client.messages['a/corrected_observations']
    numbers = iter(range(1, 10_000))

    def received():
        frame = replace(exposures['a'][0], number=next(numbers))
        publisher.publish(message_from_frame(frame))
        status = client.statuses.get('calibration_node: a')
        return corrected and status and int(value_of(status, 'frames received'))

    client.wait_until(received, what='frames from the relay')
    for node in nodes:
        assert 'a/target_observations: the subscription is now best effort' in node.log
    client.destroy_publisher(publisher)
    publisher = client.create_publisher(TargetObservations, 'relay', 100)
    for node in nodes:
        wait = client.wait_until
        wait(lambda node=node: 'observations: the subscription is now reliable' in node.log)


def test_mixed_publishers_are_reported(graph, tmp_path):
    """A reliable subscription remains while one publisher is reliable; the other one is named."""
    client = graph.client
    graph.calibration_node(tmp_path)
    graph.start('correction_node')
    publisher = client.create_publisher(
        TargetObservations,
        'a/target_observations',
        QoSProfile(depth=5, reliability=ReliabilityPolicy.BEST_EFFORT),
    )
    for node in ('calibration_node', 'correction_node'):
        status = client.wait_for_diagnostics(node, lambda s: 'incompatible' in s.message)
        assert status.level == b'\1'
        assert 'a/target_observations' in status.message and 'reliab' in status.message.lower()
    client.destroy_publisher(publisher)
