# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Points in space from two corrected streams: accuracy, stated precision and reported faults."""

import csv
import subprocess
from dataclasses import replace

import numpy as np
import pytest
from fluoro_calib_msgs.msg import CorrectedObservations
from rcl_interfaces.srv import SetParameters
from rclpy.parameter import Parameter
from ros_graph import BAGS, NAMES, entry_point, value_of

from fluoro_calib_ros.io.calibration import load_orientation, orientation_path
from fluoro_calib_ros.nodes.messages.observations import message_from_frame
from fluoro_calib_ros.nodes.messages.points import POINT_TYPE

FRAMES = 120


@pytest.fixture(scope='module')
def rig(module_graph, by_command, tracking):
    """All three nodes, after the first frames of moving markers."""
    graph = module_graph
    client = module_graph.client
    graph.fork = False
    for topic in ('points_with_covariance', 'points', 'markers', 'drift'):
        client.listen(f'reconstruction/{topic}')
    client.listen('/tf_static')
    graph.nodes = graph.whole_chain(by_command, {'drift_rate': 1000.0})
    publish(client, tracking, range(FRAMES))
    graph.points = client.messages['reconstruction/points_with_covariance']
    return graph


def publish(
    client,
    tracking,
    rows,
    change=lambda frame: frame,
    answer='reconstruction/points_with_covariance',
):
    """Publish frames of both fluoroscopes in step with the messages that answer them."""
    came = client.messages[answer]
    before = len(came)
    messages = [
        (name, message_from_frame(change(tracking[name][row]))) for row in rows for name in NAMES
    ]
    client.publish_in_step(messages, lambda: 2 * (len(came) - before))
    client.wait_until(lambda: len(came) >= before + len(messages) // 2, what='the answers')


def truth():
    """True markers (24, 3) [mm], by frame."""
    out = {}
    with open(BAGS / 'truth' / 'markers.csv', newline='') as file:
        for row in csv.DictReader(file):
            out.setdefault(int(row['frame']), []).append(
                [float(row[key]) for key in ('x_mm', 'y_mm', 'z_mm')]
            )
    return {frame: np.array(points) for frame, points in out.items()}


def coordinates(message):
    """Return points (n, 3) [mm] and their covariances (n, 3, 3) [mm^2]."""
    c = {
        name: np.array(getattr(message, f'cov_{name}'))
        for name in ('xx', 'xy', 'xz', 'yy', 'yz', 'zz')
    }
    covariance = np.stack(
        [c['xx'], c['xy'], c['xz'], c['xy'], c['yy'], c['yz'], c['xz'], c['yz'], c['zz']], axis=1
    )
    return 1e3 * np.stack([message.x, message.y, message.z], axis=1), 1e6 * covariance.reshape(
        -1, 3, 3
    )


def turned_onto(points, true):
    """Return the errors (n, 3) of points after their best-fitting rotation and shift.

    The rig frame of a joint calibration is the optical frame of the first fluoroscope; the truth
    uses a different frame.
    """
    a = points - points.mean(axis=0)
    b = true - true.mean(axis=0)
    u, _, vt = np.linalg.svd(a.T @ b)
    turn = u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt
    return a - b @ turn.T


def test_points_are_as_accurate_as_stated(rig):
    true = truth()
    found = [coordinates(m) for m in rig.points]
    points, covariance = (np.concatenate(part) for part in zip(*found))
    status = np.concatenate([m.status for m in rig.points])
    good = status <= 1
    assert good.mean() > 0.99
    errors = turned_onto(
        points[good], np.concatenate([true[m.frame_number] for m in rig.points])[good]
    )
    assert 0.1 < np.sqrt((errors**2).sum(axis=1).mean()) < 0.2  # mm, with 0.25 px of noise
    normalised = np.einsum('ni,nij,nj->n', errors, np.linalg.inv(covariance[good]), errors) / 3
    assert 0.85 < normalised.mean() < 1.15


def test_header_ids_and_sizes(rig, tracking, by_command):
    orientation = load_orientation(orientation_path(by_command))
    assert [m.frame_number for m in rig.points] == [f.number for f in tracking['a'][:FRAMES]]
    for message, frame in zip(rig.points, tracking['a']):
        assert message.header.stamp.sec * 10**9 + message.header.stamp.nanosec == frame.stamp_ns
        assert message.header.frame_id == 'a_optical'
        assert message.orientation_id == orientation.orientation_id
        assert tuple(message.calibration_id) == orientation.calibration_ids
        assert np.array_equal(message.target_id, frame.target_id) and set(message.rays) == {2}
        assert (
            len(message.x)
            == len(message.cov_yz)
            == len(message.residual)
            == len(message.target_id)
        )


def test_the_command_line_gives_the_same_numbers(rig, by_command, tmp_path):
    out = tmp_path / 'points.csv'
    command = [
        *entry_point('cli'),
        'reconstruct',
        BAGS / 'tracking',
        '--calibration',
        by_command,
        '--out',
        out,
    ]
    assert subprocess.run(command, capture_output=True).returncode == 0
    with open(out, newline='') as file:
        rows = [r for r in csv.DictReader(file) if int(r['frame']) <= rig.points[-1].frame_number]
    live = np.concatenate([np.column_stack([coordinates(m)[0], m.residual]) for m in rig.points])
    offline = np.array(
        [[float(r[key] or 'nan') for key in ('x', 'y', 'z', 'residual')] for r in rows]
    )
    assert np.array_equal(np.isnan(live), np.isnan(offline))
    assert np.nanmax(np.abs(live - offline)) < 1e-6  # mm, px: the precision of the file


def test_cloud_and_ellipsoids_are_the_same_points(rig):
    message = rig.points[FRAMES - 1]
    cloud = rig.client.wait_until(
        lambda: [
            m
            for m in rig.client.messages['reconstruction/points']
            if m.header.stamp == message.header.stamp
        ],
        what='the cloud',
    )[0]
    points = np.frombuffer(bytes(cloud.data), dtype=POINT_TYPE)
    good = np.array(message.status) <= 1
    assert cloud.width == len(points) == good.sum() and cloud.point_step == POINT_TYPE.itemsize
    assert np.array_equal(points['id'], np.array(message.target_id)[good])
    assert np.allclose(points['x'], np.array(message.x)[good], atol=1e-6)
    _, covariance = coordinates(message)
    sigma = np.sqrt(np.trace(covariance, axis1=1, axis2=2) / 3)[good] / 1e3
    assert np.allclose(points['sigma'], sigma, rtol=1e-5)
    array = rig.client.wait_until(
        lambda: rig.client.messages['reconstruction/markers'], what='the ellipsoids'
    )[-1]
    assert {m.id for m in array.markers} <= set(message.target_id) and len(array.markers) > 20
    marker = array.markers[0]
    turn = np.array(
        [
            marker.pose.orientation.w,
            marker.pose.orientation.x,
            marker.pose.orientation.y,
            marker.pose.orientation.z,
        ]
    )
    assert np.isclose(np.linalg.norm(turn), 1)
    # Ten standard deviations on each side; the geometry makes depth less certain than the
    # transverse directions.
    axes = np.array([marker.scale.x, marker.scale.y, marker.scale.z]) / 20
    assert (
        np.allclose(np.sum(axes**2), 3 * np.mean(sigma**2), rtol=0.2)
        and axes.max() > 1.1 * axes.min()
    )


def test_tf_has_the_positions_of_the_sources(rig, by_command):
    orientation = load_orientation(orientation_path(by_command))
    found = rig.client.wait_until(
        lambda: [
            t
            for m in rig.client.messages['/tf_static']
            for t in m.transforms
            if t.child_frame_id == 'b_optical'
        ],
        what='the transform of b',
    )[-1]
    assert found.header.frame_id == 'rig'
    t = found.transform.translation
    assert np.allclose([t.x, t.y, t.z], orientation.position_mm[1] / 1000, atol=1e-9)


def test_only_the_false_match_is_rejected(rig, tracking):
    """Two markers are exchanged in one view, so their rays do not meet."""

    def exchanged(frame):
        if frame.fluoroscope == 'a':
            return replace(frame, number=90_001)
        uv = frame.uv.copy()
        uv[[0, 23]] = uv[[23, 0]]
        return replace(frame, number=90_001, uv=uv)

    publish(rig.client, tracking, [7], exchanged)
    message = rig.client.wait_until(
        lambda: rig.points[-1].frame_number == 90_001 and rig.points[-1], what='the points'
    )
    status = np.array(message.status)
    assert list(np.flatnonzero(status == message.REJECTED)) == [0, 23]
    assert (
        np.isnan(np.array(message.x)[[0, 23]]).all()
        and np.isfinite(np.array(message.x)[1:23]).all()
    )
    assert min(np.array(message.residual)[[0, 23]]) > 1.0


def test_thresholds_can_be_set_while_it_runs(rig, tracking):
    """With a threshold of 1000 standard deviations, a shift of 5 px is accepted."""
    client = rig.client
    client.expect(SetParameters, 'reconstruction_node/set_parameters')
    client.wait_until_known_to('reconstruction_node')

    def set_parameter(name, value):
        parameter = Parameter(name, value=value).to_parameter_msg()
        answer = client.call(
            SetParameters, 'reconstruction_node/set_parameters', parameters=[parameter]
        )
        return answer.results[0]

    def rejected(number):
        def shifted(frame):
            uv = frame.uv + ([[0.0, 5.0]] if frame.fluoroscope == 'b' else 0.0)
            return replace(frame, number=number, uv=uv)

        publish(client, tracking, [7], shifted)
        (message,) = [m for m in rig.points if m.frame_number == number]
        return message.REJECTED in message.status

    assert rejected(90_101)
    assert set_parameter('reject', 1000.0).successful
    assert not rejected(90_102)
    assert 'reject' in set_parameter('reject', 0.5).reason
    assert set_parameter('reject', 4.0).successful
    assert rejected(90_103)
    assert 'is read when the node starts' in set_parameter('rig_frame', 'other').reason


def test_target_in_a_single_view_is_reported(rig, tracking):
    def fewer(frame):
        keep = slice(0, 20) if frame.fluoroscope == 'a' else slice(2, 24)
        return replace(frame, number=90_002, target_id=frame.target_id[keep], uv=frame.uv[keep])

    publish(rig.client, tracking, [8], fewer)
    message = rig.client.wait_until(
        lambda: rig.points[-1].frame_number == 90_002 and rig.points[-1], what='the points'
    )
    single = np.array(message.target_id)[np.array(message.status) == message.SINGLE_VIEW]
    assert list(single) == [1001, 1002, 1021, 1022, 1023, 1024] and len(message.target_id) == 24


def test_unpaired_and_late_frames_are_counted(rig, tracking):
    client = rig.client
    before = {
        key: int(value_of(client.statuses['reconstruction_node: reconstruction'], key))
        for key in ('frames unpaired', 'frames late')
    }
    received = int(
        value_of(client.statuses['reconstruction_node: reconstruction'], 'frames received of a')
    )
    for number in range(100_001, 100_101):
        client.publish(replace(tracking['a'][0], number=number))
        if number % 20 == 0:  # unpaired: those of the 100 that no longer fit in the queue of 64
            client.wait_for_diagnostics(
                'reconstruction_node',
                lambda s: int(value_of(s, 'frames received of a')) >= received + number - 100_000,
                'reconstruction',
            )
    client.publish(replace(tracking['b'][0], number=100_002))  # its partner has been dropped
    status = client.wait_for_diagnostics(
        'reconstruction_node',
        lambda s: int(value_of(s, 'frames late')) == before['frames late'] + 1,
        'reconstruction',
        'a late frame',
    )
    assert int(value_of(status, 'frames unpaired')) == before['frames unpaired'] + 100 - 64 + 1
    assert 'without partner' in status.message


def test_the_drift_watch_is_in_the_diagnostics(rig):
    client = rig.client

    def watching(status):
        return int(value_of(status, 'observations')) > 0 and status.level == b'\0'

    status = client.wait_for_diagnostics('reconstruction_node', watching, 'drift')
    drift = client.messages['reconstruction/drift']
    client.wait_until(lambda: drift and drift[-1].level == 0, what='a state without drift')
    assert (
        float(value_of(status, 'threshold of ERROR'))
        > float(value_of(status, 'threshold of WARN'))
        > 0
    )


def test_damaged_corrected_frames_are_counted_by_kind(rig, tracking):
    """Frames from another publisher: invalid frames are refused, later ones reconstructed."""
    client = rig.client
    output = client.create_publisher(CorrectedObservations, 'a/corrected_observations', 10)
    client.wait_until(lambda: output.get_subscription_count() > 0, what='the reader')
    client.wait_until_known_to('reconstruction_node')
    source = message_from_frame(tracking['a'][0])
    for change in (
        {'u': source.u[:-1]},
        {'status': []},
        {'target_id': [source.target_id[0]] * len(source.target_id)},
        {'sigma': -np.asarray(source.u)},
        {'correction_sd': -np.asarray(source.u)},
    ):
        message = CorrectedObservations(
            header=source.header,
            frame_number=95_000,
            target_id=source.target_id,
            u=source.u,
            v=source.v,
            sigma=source.u,
            correction_sd=source.u,
            status=bytes(len(source.u)),
        )
        for field, value in change.items():
            setattr(message, field, value)
        output.publish(message)
    output.publish(b'\0\1\0\0rubbish')
    status = client.wait_for_diagnostics(
        'reconstruction_node',
        lambda s: value_of(s, 'refused: undecodable') == '1',
        'reconstruction',
    )
    assert (
        value_of(status, 'refused: lengths') == '2'
        and value_of(status, 'refused: repeated target') == '1'
    )
    assert value_of(status, 'refused: sigma') == '2'
    client.destroy_publisher(output)
    publish(client, tracking, [9], lambda frame: replace(frame, number=95_001))
    client.wait_until(lambda: rig.points[-1].frame_number == 95_001, what='the next good exposure')
    assert 'Traceback' not in rig.nodes['reconstruction_node'].log


def test_rays_that_miss_each_other_are_an_error(rig, tracking):
    """The image of one fluoroscope is upside down."""

    def upside_down(frame):
        number = 200_000 + frame.number
        if frame.fluoroscope == 'a':
            return replace(frame, number=number)
        height = frame.image_size[1]
        uv = np.column_stack([frame.uv[:, 0], height - 1 - frame.uv[:, 1]])
        return replace(frame, number=number, uv=uv)

    publish(rig.client, tracking, range(80), upside_down)
    status = rig.client.wait_for_diagnostics(
        'reconstruction_node',
        lambda s: 'rays miss each other' in s.message,
        'reconstruction',
        'rays that miss each other',
    )
    assert status.level == b'\2'
    assert 'do not belong together' in status.message
