# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The lifecycle of the streaming nodes, their parameters, and two rigs at the same time."""

import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import rigs
from builtin_interfaces.msg import Time
from fluoro_calib_msgs.msg import CorrectedObservations
from fluoro_calib_msgs.srv import Capture
from lifecycle_msgs.msg import State, Transition
from lifecycle_msgs.srv import ChangeState, GetState
from rcl_interfaces.srv import DescribeParameters, ListParameters, SetParameters
from rclpy.lifecycle import TransitionCallbackReturn
from rclpy.parameter import Parameter
from ros_graph import NAMES, Graph, value_of
from rosgraph_msgs.msg import Clock
from std_msgs.msg import Header

from fluoro_calib_ros.bodies.body import Body
from fluoro_calib_ros.io.bodies import write_bodies
from fluoro_calib_ros.io.calibration import save_orientation
from fluoro_calib_ros.nodes.correction_node import CorrectionNode
from fluoro_calib_ros.nodes.image_node import ImageNode
from fluoro_calib_ros.nodes.reconstruction_node import ReconstructionNode
from fluoro_calib_ros.nodes.runtime.topics import observations_qos
from fluoro_calib_ros.simulation.rig import virtual_rig

MARKERS = np.array([[0, 0, 0], [30, 5, -4], [-6, 28, 9], [4, -8, 31.0]])
NODES = ('correction_node', 'reconstruction_node', 'image_node')


def expect(client, node):
    """Create the service clients of a node before it starts."""
    for kind, service in (
        (ChangeState, 'change_state'),
        (GetState, 'get_state'),
        (ListParameters, 'list_parameters'),
        (DescribeParameters, 'describe_parameters'),
    ):
        client.expect(kind, f'{node}/{service}')


def change(client, node, transition):
    return client.call(
        ChangeState, f'{node}/change_state', transition=Transition(id=transition)
    ).success


def state(client, node):
    return client.call(GetState, f'{node}/get_state').current_state.id


def test_node_processes_frames_only_while_active(graph, by_command, tracking):
    client = graph.client
    expect(client, 'correction_node')
    graph.calibration_node(by_command)
    node = graph.start('correction_node', {'autostart': 'false'}, wait=False)
    corrected = client.listen('a/corrected_observations')
    client.wait_until_known_to('correction_node')
    assert state(client, 'correction_node') == State.PRIMARY_STATE_UNCONFIGURED
    assert not client.count_publishers('a/corrected_observations')
    frame = tracking['a'][0]
    for turn in range(2):  # the second pass follows a complete cleanup
        assert change(client, 'correction_node', Transition.TRANSITION_CONFIGURE)
        assert state(client, 'correction_node') == State.PRIMARY_STATE_INACTIVE
        client.wait_for_diagnostics(
            'correction_node', lambda s: 'the node is not active' in s.message
        )
        client.publish(replace(frame, number=100 * turn + 1))  # no subscriber
        assert change(client, 'correction_node', Transition.TRANSITION_ACTIVATE)
        assert state(client, 'correction_node') == State.PRIMARY_STATE_ACTIVE
        client.wait_until(
            lambda: client.subscriptions_matched('correction_node'), what='the reader'
        )
        client.wait_until_known_to('correction_node')
        client.publish(replace(frame, number=100 * turn + 2))
        client.wait_until(
            lambda: corrected and corrected[-1].frame_number == 100 * turn + 2, what='the frame'
        )
        assert change(client, 'correction_node', Transition.TRANSITION_DEACTIVATE)
        client.publish(replace(frame, number=100 * turn + 3))
        assert change(client, 'correction_node', Transition.TRANSITION_CLEANUP)
        client.wait_until(
            lambda: not client.count_publishers('a/corrected_observations'), what='its end'
        )
        client.statuses.clear()
    assert [m.frame_number for m in corrected] == [2, 102]
    assert node.end() == 0 and 'Traceback' not in node.log


def test_paused_calibration_node_keeps_what_it_has(graph, exposures, tmp_path):
    """An inactive node takes no frames but answers; cleanup discards; parameters can be set."""
    client = graph.client
    expect(client, 'calibration_node')
    client.expect(SetParameters, 'calibration_node/set_parameters')
    node = graph.calibration_node(tmp_path / 'none')

    def publish(row):
        for name in NAMES:
            client.publish(exposures[name][row])

    def set_parameter(name, value):
        (done,) = client.call(
            SetParameters,
            'calibration_node/set_parameters',
            parameters=[Parameter(name, value=value).to_parameter_msg()],
        ).results
        return done

    publish(0)
    client.wait_for_status(lambda s: s.exposures == 1)
    assert not set_parameter('phantom', 'other.csv').successful
    assert 'must be one of still, request' in set_parameter('collect', 'luck').reason
    assert set_parameter('collect', 'request').successful
    publish(1)
    client.wait_for_status(lambda s: s.frames_received == 2)
    assert client.status().exposures == 1
    assert set_parameter('collect', 'still').successful
    assert change(client, 'calibration_node', Transition.TRANSITION_DEACTIVATE)
    publish(2)  # no subscriber
    assert client.wait_for_diagnostics(
        'calibration_node', lambda s: s.message == 'the node is not active'
    )
    answer = client.call(Capture, 'capture')
    assert answer.message == 'the node is not active, so no frames come in'
    assert change(client, 'calibration_node', Transition.TRANSITION_ACTIVATE)
    client.wait_until(lambda: client.subscriptions_matched('calibration_node'), what='the reader')
    client.wait_until_known_to('calibration_node')
    publish(3)
    status = client.wait_for_status(lambda s: s.frames_received == 3)
    assert status.exposures == 2
    assert change(client, 'calibration_node', Transition.TRANSITION_DEACTIVATE)
    assert change(client, 'calibration_node', Transition.TRANSITION_CLEANUP)
    client.wait_until(
        lambda: not client.count_publishers('a/calibration_status'), what='the end of its topics'
    )
    assert change(client, 'calibration_node', Transition.TRANSITION_CONFIGURE)
    client.messages['a/calibration_status'].clear()
    assert client.wait_for_status(lambda s: True).exposures == 0
    assert change(client, 'calibration_node', Transition.TRANSITION_INACTIVE_SHUTDOWN)
    assert node.end() == 0 and 'Traceback' not in node.log


@pytest.mark.parametrize('node', NODES)
def test_every_transition_and_a_clean_end(graph, node):
    expect(graph.client, node)
    process = graph.start(node)
    client = graph.client
    T = Transition
    for transition in (
        T.TRANSITION_DEACTIVATE,
        T.TRANSITION_ACTIVATE,
        T.TRANSITION_DEACTIVATE,
        T.TRANSITION_CLEANUP,
        T.TRANSITION_CONFIGURE,
        T.TRANSITION_ACTIVATE,
    ):
        assert change(client, node, transition), transition
    assert state(client, node) == State.PRIMARY_STATE_ACTIVE
    segments = own_segments(process)
    assert process.end() == 0 and 'Traceback' not in process.log
    assert not [path for path in segments if path.exists()], 'it has left the graph'


def own_segments(process):
    """Return the files of Fast DDS in shared memory that a process has locked as their owner."""
    links = Path(f'/proc/{process.pid}/fd').iterdir()
    targets = [link.readlink() for link in links if link.is_symlink()]
    return [path for path in targets if re.fullmatch(r'fastrtps_[0-9a-f]+_el', path.name)]


def test_shutdown_by_the_lifecycle(graph, by_command):
    expect(graph.client, 'correction_node')
    graph.both_nodes(by_command)
    assert change(graph.client, 'correction_node', Transition.TRANSITION_ACTIVE_SHUTDOWN)
    assert state(graph.client, 'correction_node') == State.PRIMARY_STATE_FINALIZED
    assert graph.processes[-1].end() == 0 and 'Traceback' not in graph.processes[-1].log


def test_failed_transition_gives_the_reason_and_changes_nothing(graph):
    """An invalid quality of service is noticed only when the topics are created."""
    client = graph.client
    topic = f'qos_overrides.{graph.namespace}/a/target_observations.subscription.reliability'
    expect(client, 'correction_node')
    node = graph.start('correction_node', {'autostart': 'false', topic: 'luck'}, wait=False)
    client.wait_until_known_to('correction_node')
    assert change(client, 'correction_node', Transition.TRANSITION_CONFIGURE)
    for _ in range(2):
        assert not change(client, 'correction_node', Transition.TRANSITION_ACTIVATE)
        assert state(client, 'correction_node') == State.PRIMARY_STATE_INACTIVE
    assert node.log.count('Unexpected QoS override for policy `reliability`: `luck`') == 2
    assert node.end() == 0 and 'Traceback' not in node.log


def test_deactivated_node_publishes_exposures_that_wait(graph):
    """Points wait for a view of the third fluoroscope, and poses for two later exposures."""
    client = graph.client
    ids = {name: SimpleNamespace(calibration_id=f'{name}-1') for name in 'abc'}
    orientation = rigs.true_orientation(virtual_rig(1, names=tuple(ids)).fluoroscopes, ids)
    body = Body('femur', np.arange(1, 5), MARKERS, np.full(4, 0.02))
    write_bodies(graph.directory / 'bodies.csv', [body])
    points = client.listen('reconstruction/points_with_covariance')
    poses = client.listen('reconstruction/body_poses')
    outputs = [
        client.create_publisher(
            CorrectedObservations, f'{name}/corrected_observations', observations_qos()
        )
        for name in 'ab'
    ]
    expect(client, 'reconstruction_node')
    parameters = {
        'fluoroscopes': '[a, b, c]',
        'orientation_file': save_orientation(graph.directory, orientation),
        'bodies': graph.directory / 'bodies.csv',
        'body_lag': 2,
    }
    graph.start('reconstruction_node', parameters)
    client.wait_until(lambda: all(out.get_subscription_count() for out in outputs))
    for number in range(1, 6):
        for view, output in enumerate(outputs):
            output.publish(corrected(number, orientation, view))
    status = client.wait_for_diagnostics(
        'reconstruction_node',
        lambda s: all(value_of(s, f'frames received of {name}') == '5' for name in 'ab'),
        'reconstruction',
    )
    assert value_of(status, 'exposures') == '0' and not points
    assert change(client, 'reconstruction_node', Transition.TRANSITION_DEACTIVATE)
    client.wait_until(lambda: len(points) == len(poses) == 5, what='points and poses')
    for messages in (points, poses):
        assert [message.frame_number for message in messages] == [1, 2, 3, 4, 5]


def corrected(number, orientation, view):
    """Return the message of a view of a body at the origin."""
    xp, yp, c = orientation.interior[view]
    x = (MARKERS - orientation.position_mm[view]) @ orientation.rotation[view].T
    return CorrectedObservations(
        header=Header(stamp=Time(sec=1, nanosec=4_000_000 * number)),
        frame_number=number,
        calibration_id=orientation.calibration_ids[view],
        target_id=[1, 2, 3, 4],
        u=xp + c * x[:, 0] / x[:, 2],
        v=yp + c * x[:, 1] / x[:, 2],
        sigma=[0.3] * 4,
        correction_sd=[0.1] * 4,
        status=bytes(4),
    )


@pytest.mark.parametrize('kind', [CorrectionNode, ImageNode, ReconstructionNode])
def test_cleanup_destroys_everything(ros, kind):
    """Nothing remains, however often a manager configures and cleans up a node."""
    node = kind()
    try:
        before = len(list(node.publishers))
        for _ in range(3):
            for transition in (
                node.trigger_configure,
                node.trigger_activate,
                node.trigger_deactivate,
                node.trigger_cleanup,
            ):
                assert transition() == TransitionCallbackReturn.SUCCESS
        assert len(list(node.publishers)) == before
        assert not any(
            map(
                len,
                (
                    node._managed_entities,
                    *map(list, (node.subscriptions, node.timers, node.clients)),
                ),
            )
        )
    finally:
        node.destroy_node()


@pytest.mark.parametrize('part', ['deactivate', 'reset'])
def test_transition_that_cannot_be_undone_leaves_nothing(ros, monkeypatch, part):
    node = CorrectionNode()
    try:
        before = len(list(node.publishers))
        original = getattr(node, part)
        failures = [RuntimeError('the middleware fails')]

        def failing():
            original()
            if failures:
                raise failures.pop()

        monkeypatch.setattr(node, part, failing)
        for transition in (node.trigger_configure, node.trigger_activate):
            assert transition() == TransitionCallbackReturn.SUCCESS
        results = [node.trigger_deactivate()]
        if part == 'reset':
            results.append(node.trigger_cleanup())
        assert results[-1] == TransitionCallbackReturn.ERROR and not failures
        assert len(list(node.publishers)) == before
        for transition in (node.trigger_configure, node.trigger_activate):
            assert transition() == TransitionCallbackReturn.SUCCESS
        node.stop()
    finally:
        node.destroy_node()


@pytest.mark.parametrize('node', NODES)
def test_every_parameter_is_described(graph, node):
    client = graph.client
    expect(client, node)
    graph.start(node)
    names = client.call(ListParameters, f'{node}/list_parameters').result.names
    own = [
        n
        for n in names
        if not n.startswith('qos_overrides')
        and n not in ('use_sim_time', 'start_type_description_service')
    ]
    described = client.call(
        DescribeParameters, f'{node}/describe_parameters', names=own
    ).descriptors
    assert 'autostart' in own and 'fluoroscopes' in own
    for descriptor in described:
        assert len(descriptor.description) > 10, descriptor.name
        number = descriptor.type in (2, 3)  # integer or double
        assert bool(descriptor.integer_range or descriptor.floating_point_range) == number, (
            descriptor.name
        )
    assert any(n.startswith('qos_overrides.') and n.endswith('.depth') for n in names)


def test_two_rigs_in_parallel(node_server, request, graph, by_command, tracking, tmp_path):
    """Two namespaces, one with simulated time, do not receive each other's messages."""
    (tmp_path / 'other').mkdir()
    other = Graph(tmp_path / 'other', node_server)
    request.node.graphs = [*getattr(request.node, 'graphs', ()), other]
    try:
        for one in (graph, other):
            one.points = one.client.listen('reconstruction/points_with_covariance')
        graph.whole_chain(by_command)
        other.both_nodes(by_command)
        simulated = other.start(
            'reconstruction_node', {'use_sim_time': 'true', 'pair_by': 'stamp'}
        )
        for one in (graph, other):
            one.wait_for_readers(1)
        other.client.wait_for_diagnostics('correction_node', lambda s: value_of(s, 'calibration'))
        other.client.wait_for_diagnostics(
            'correction_node', lambda s: value_of(s, 'calibration'), 'b'
        )
        other.client.wait_until(
            lambda: 'orientation rig-' in simulated.log, what='the orientation'
        )
        for row in range(20):
            for name in NAMES:
                graph.client.publish(tracking[name][row])
                if row < 10:
                    other.client.publish(replace(tracking[name][row], number=500 + row))
        for one, count in ((graph, 20), (other, 10)):
            one.client.wait_until(lambda: len(one.points) >= count, what='the points')
        assert [m.frame_number for m in graph.points] == [f.number for f in tracking['a'][:20]]
        assert [m.frame_number for m in other.points] == list(
            range(500, 510)
        )  # although they were paired by stamp
        clock = other.client.create_publisher(Clock, '/clock', 10)
        ticks = iter(range(1, 10**6))  # the timers of the node follow the simulated clock only

        def ticking():
            clock.publish(Clock(clock=Time(sec=next(ticks))))
            return 'reconstruction_node: reconstruction' in other.client.statuses

        other.client.wait_until(ticking, what='diagnostics at simulated time')
        other.client.destroy_publisher(clock)
    finally:
        other.close()
