# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Three fluoroscopes, live: calibration, orientation, and points with missing views."""

import csv
import json
import subprocess
from dataclasses import replace

import numpy as np
from fluoro_calib_msgs.msg import CorrectedObservations, TargetObservations
from fluoro_calib_msgs.srv import Calibrate, Orient
from rcl_interfaces.srv import SetParameters
from rclpy.parameter import Parameter
from ros_graph import entry_point, value_of

from fluoro_calib_ros.exposures.frame import Frame
from fluoro_calib_ros.io.bags.writer import write_bag
from fluoro_calib_ros.nodes.messages.observations import message_from_frame
from fluoro_calib_ros.nodes.runtime.topics import observations_qos
from fluoro_calib_ros.simulation.rig import (
    START_NS,
    StreamStart,
    detect_beads,
    simulate_exposures,
    simulate_tracking,
    virtual_rig,
)

THREE = ('a', 'b', 'c')
POSES = 9
RATE_HZ = 15.0
PATIENCE = 8
# frames of markers; c ends here, and b drifts from here on
FRAMES = 360
SILENT = 300
DRIFT = 210
NUMBER = 10_001
START = START_NS + 10**12


def a_rig():
    """Return the rig whose phantom is that of bags/, with a third fluoroscope."""
    return virtual_rig(1, names=THREE, between_deg=60.0)


def standing(of_rig, number, stamp_ns):
    """Return a frame of each fluoroscope with the phantom stationary in the rig frame."""
    rng = np.random.default_rng(number)
    for f in of_rig.fluoroscopes:
        ids, uv = detect_beads(rng, f, of_rig.true_mm, of_rig.phantom.target_id)
        yield Frame(f.name, number, ids, uv, f.image_size, None, stamp_ns, f'{f.name}_optical')


def started(graph, folder):
    """Start the three nodes for three fluoroscopes; return the reconstruction node."""
    client = graph.client
    three = {'fluoroscopes': '[a, b, c]'}
    client._outputs['c'] = client.create_publisher(
        TargetObservations, 'c/target_observations', observations_qos()
    )
    client.listen('c/calibration_status')
    graph.calibration_node(folder, **three)
    graph.start('correction_node', three)
    node = graph.start(
        'reconstruction_node', {**three, 'patience': PATIENCE, 'drift_rate': 1000.0}
    )
    client.wait_until(lambda: client.subscriptions_matched('correction_node'), what='the readers')
    return node


def calibrated(graph, of_rig):
    """Calibrate, orient by a capture, and return the id of the orientation."""
    client = graph.client
    for frames in zip(*simulate_exposures(of_rig, POSES, 1).frames.values()):
        for frame in frames:
            client.publish(frame)
    client.wait_for_status(lambda s: s.exposures == POSES, 'c', 'all exposures')
    answer = client.call(Calibrate, 'calibrate', model='collocation')
    assert answer.success and list(answer.fluoroscope) == list(THREE), answer.message
    future = client.call_async(Orient, 'orient', timeout_sec=30.0)
    numbers = iter(range(100, 1000))

    def show():
        if not future.done():
            number = next(numbers)
            for frame in standing(of_rig, number, START_NS + number * 10**9):
                client.publish(frame)
        return future.done()

    client.wait_until(show, what='the orientation')
    assert future.result().success, future.result().message
    for name in THREE:
        client.wait_for_diagnostics('correction_node', lambda s: value_of(s, 'calibration'), name)
    client.wait_for_diagnostics(
        'reconstruction_node',
        lambda s: value_of(s, 'orientation') == future.result().orientation_id,
        'reconstruction',
    )
    return future.result().orientation_id


def restart_drift_watch(graph, node, markers, points):
    """Restart the drift watch by one of its options; return its DiagnosticStatus.

    The same orientation, received again, would not restart it.
    """
    client = graph.client
    key = 'reconstruction_node: reconstruction'
    for number in range(2000, NUMBER):
        for name in THREE:
            client.publish(
                replace(markers[name][0], number=number, stamp_ns=START_NS + number * 10**9)
            )
        client.wait_until(lambda: points and points[-1].frame_number == number, what='the points')
        status = client.statuses.get('reconstruction_node: drift')
        if status is not None and value_of(status, 'observations') and max(points[-1].rays) == 3:
            break
    client.expect(SetParameters, 'reconstruction_node/set_parameters')
    client.wait_until_known_to('reconstruction_node')
    for hours in (1001.0, 1000.0):  # and back to the default, as offline
        parameter = Parameter('drift_error_interval', value=hours).to_parameter_msg()
        answer = client.call(
            SetParameters, 'reconstruction_node/set_parameters', parameters=[parameter]
        )
        assert answer.results[0].successful
    text = 'the drift watch starts anew'
    client.wait_until(lambda: node.log.count(text) == 2, what='a new watch')
    client.statuses.pop(key)
    return client.wait_until(lambda: client.statuses.get(key), what='fresh counts')


def marker_frames(of_rig):
    """Return the tracking with a drift of b and lost frames of c.

    Half of the image of b is shifted by 1 px at the end. c loses frames at random, and all frames
    at the end.
    """
    tracking = simulate_tracking(
        of_rig, FRAMES / RATE_HZ, RATE_HZ, 5, start=StreamStart(START, NUMBER)
    )
    frames = tracking.frames
    there = np.random.default_rng(3).random(SILENT) > 0.3
    for k in range(DRIFT, FRAMES):
        left = frames['b'][k].uv[:, 0] < 512
        frames['b'][k] = replace(frames['b'][k], uv=frames['b'][k].uv + np.outer(left, [0.0, 1.0]))
    kept = {**frames, 'c': [frame for frame, here in zip(frames['c'], there) if here]}
    return tracking, kept, np.append(there, np.zeros(FRAMES - SILENT, dtype=bool))


def streamed(client, kept, points):
    """Publish frames exposure by exposure, in step with the points; return the point messages."""
    by_number = {}
    for frame in sorted(
        (f for of_one in kept.values() for f in of_one), key=lambda f: (f.number, f.fluoroscope)
    ):
        by_number.setdefault(frame.number, []).append(frame)
    before = len(points)
    sent = np.cumsum([0, *map(len, by_number.values())])
    # Stay just far enough ahead for c to be recognised as silent: with more, c would count as
    # silent while its frames wait.
    client.publish_in_step(
        [(f.fluoroscope, message_from_frame(f)) for of_one in by_number.values() for f in of_one],
        lambda: sent[len(points) - before],
        2 * (PATIENCE + 1),
    )
    client.wait_until(lambda: len(points) - before >= FRAMES, what='the points of all exposures')
    return points[before:]


def check_points(messages, tracking, there):
    """Check that exposures come once and in order; three rays are more precise than two."""
    assert [m.frame_number for m in messages] == list(range(NUMBER, NUMBER + FRAMES))
    errors = {2: [], 3: []}
    sd = {2: [], 3: []}
    for k, (message, three) in enumerate(zip(messages, there)):
        good = np.array(message.status) <= message.OUTSIDE
        assert message.header.frame_id == 'rig' and set(np.array(message.rays)[good]) <= (
            {2, 3} if three else {2}
        )
        if k < DRIFT:
            assert good.mean() > 0.9
            full = good & (np.array(message.rays) == (3 if three else 2))
            xyz = 1e3 * np.stack([message.x, message.y, message.z], axis=1)
            errors[3 if three else 2].append((xyz - tracking.points_mm[k])[full])
            variance = sum(np.array(getattr(message, f'cov_{c}')) for c in ('xx', 'yy', 'zz'))
            sd[3 if three else 2].append(1e3 * np.sqrt(variance)[full])
    rms = {
        rays: np.sqrt(np.mean(np.sum(np.concatenate(e) ** 2, axis=1)))
        for rays, e in errors.items()
    }
    assert rms[3] < 0.95 * rms[2] < 0.3
    assert np.median(np.concatenate(sd[3])) < 0.9 * np.median(np.concatenate(sd[2]))


def check_mixed(client, last, markers, points):
    """Check that views whose calibrations belong to different orientations are not intersected."""
    before = int(
        value_of(
            client.statuses['reconstruction_node: reconstruction'], 'exposures without orientation'
        )
    )
    outputs = [
        client.create_publisher(
            CorrectedObservations, f'{name}/corrected_observations', observations_qos()
        )
        for name in 'ab'
    ]
    client.wait_until(
        lambda: all(output.get_subscription_count() for output in outputs), what='the reader'
    )
    client.wait_until_known_to('reconstruction_node')
    for number, ids in (
        (20_001, ('a-other', last.calibration_id[1])),
        (20_002, last.calibration_id[:2]),
    ):
        for output, calibration_id, name in zip(outputs, ids, 'ab'):
            source = message_from_frame(markers[name][-1])
            output.publish(
                CorrectedObservations(
                    header=source.header,
                    frame_number=number,
                    calibration_id=calibration_id,
                    target_id=source.target_id,
                    u=source.u,
                    v=source.v,
                    sigma=[0.3] * len(source.u),
                    correction_sd=[0.1] * len(source.u),
                    status=bytes(len(source.u)),
                )
            )
    client.wait_until(
        lambda: points[-1].frame_number == 20_002, what='the points of the views that fit'
    )
    assert points[-2].frame_number == last.frame_number
    client.wait_for_diagnostics(
        'reconstruction_node',
        lambda s: int(value_of(s, 'exposures without orientation')) == before + 1,
        'reconstruction',
    )


def offline(folder, kept, path):
    """Return rows of points and the result of the command line for a bag of the same frames."""
    write_bag(path / 'bag', kept)
    command = [
        *entry_point('cli'),
        'reconstruct',
        path / 'bag',
        '--calibration',
        folder,
        '--out',
        path / 'out.csv',
        '--json',
    ]
    result = json.loads(subprocess.run(command, capture_output=True, check=True).stdout)
    with open(path / 'out.csv', newline='') as file:
        return list(csv.DictReader(file)), result


def test_points_are_published_while_views_are_missing(graph, tmp_path):
    """Frames of c are lost at random, then c falls silent; the drift of b is found as offline."""
    client = graph.client
    folder = tmp_path / 'calibration'
    of_rig = a_rig()
    points, drift = (
        client.listen(f'reconstruction/{name}') for name in ('points_with_covariance', 'drift')
    )
    node = started(graph, folder)
    oriented = calibrated(graph, of_rig)
    tracking, kept, there = marker_frames(of_rig)
    before = restart_drift_watch(graph, node, tracking.frames, points)
    messages = streamed(client, kept, points)
    check_points(messages, tracking, there)
    assert all(m.orientation_id == oriented and len(m.calibration_id) == 3 for m in messages)
    status = client.wait_for_diagnostics(
        'reconstruction_node',
        lambda s: (
            int(value_of(s, 'exposures incomplete'))
            == int(value_of(before, 'exposures incomplete')) + FRAMES - there.sum()
        ),
        'reconstruction',
        'the count of incomplete exposures',
    )
    assert value_of(status, 'frames late') == value_of(before, 'frames late')
    # The other streams may have ended by now; the message would mention that, too.
    assert 'no frames of c, points are reconstructed from the other fluoroscopes' in status.message
    rows, result = offline(folder, kept, tmp_path)
    live = np.concatenate([1e3 * np.stack([m.x, m.y, m.z], axis=1) for m in messages])
    of_file = np.array([[float(row[c] or 'nan') for c in 'xyz'] for row in rows])
    assert [int(row['rays']) for row in rows] == [rays for m in messages for rays in m.rays]
    np.testing.assert_allclose(live, of_file, atol=1e-6)
    found = result['drift']
    assert (
        result['frames'] == FRAMES
        and result['incomplete'] == FRAMES - there.sum()
        and found['fluoroscope'] == 'b'
    )
    said = client.wait_until(
        lambda: drift and drift[-1].observations == found['observations'] and drift[-1],
        what='the state of the drift watch',
    )
    assert found['level'] == 'error' and said.level == said.ERROR and said.fluoroscope == 'b'
    np.testing.assert_allclose(
        [said.size, said.sd, said.evidence, said.u0, said.v1],
        [
            found['size_px'],
            found['sd_px'],
            found['evidence'],
            found['area_px'][0],
            found['area_px'][3],
        ],
        rtol=1e-6,
    )
    check_mixed(client, messages[-1], tracking.frames, points)
    assert 'Traceback' not in node.log
