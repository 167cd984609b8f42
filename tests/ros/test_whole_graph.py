# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The main task on real nodes: collect exposures, calibrate, correct moving markers."""

import csv
import json

import numpy as np
import pytest
from fluoro_calib_msgs.msg import CalibrationStatus, CorrectedObservations
from fluoro_calib_msgs.srv import Calibrate
from ros_graph import BAGS, JOB_DEADLINE, NAMES, SUCCEEDED

from fluoro_calib_ros.io.calibration import load_calibrations
from fluoro_calib_ros.nodes.messages.fluoroscope_calibration import calibration_from_message
from fluoro_calib_ros.photogrammetry.collinearity import project
from fluoro_calib_ros.photogrammetry.rotations import matrix_from_quaternion

NOISE_PX = 0.25
RESULT_FIELDS = (
    'fluoroscope',
    'calibration_id',
    'model_kind',
    'k',
    'iterations',
    'converged',
    'xp',
    'yp',
    'c',
    'sd_xp',
    'sd_yp',
    'sd_c',
    'rmse_before_u',
    'rmse_before_v',
    'rmse_after_u',
    'rmse_after_v',
    'observations',
    'inliers',
)


@pytest.fixture(scope='module')
def rig(module_graph, tmp_path_factory):
    """The graph with all recorded exposures collected."""
    graph = module_graph
    graph.fork = False
    client = module_graph.client
    graph.directory_of_calibrations = tmp_path_factory.mktemp('calibrations')
    graph.both_nodes(graph.directory_of_calibrations)
    for topic in ('calibration', 'corrected_observations', 'camera_info'):
        for name in NAMES:
            client.listen(f'{name}/{topic}')
    graph.play(BAGS / 'calibration', readers=2)
    for name in NAMES:
        client.wait_for_status(lambda s: s.exposures == 15, name, 'all 15 exposures')
    return graph


@pytest.fixture(scope='module')
def by_service(rig):
    """Answer of the service calibrate."""
    return rig.client.call(Calibrate, 'calibrate')


@pytest.fixture(scope='module')
def tracked(rig, by_service, tracking):
    """Corrected messages of bags/tracking, by fluoroscope."""
    client = rig.client
    for name, used in zip(by_service.fluoroscope, by_service.calibration_id):
        client.wait_for_diagnostics(
            'correction_node', lambda s, used=used: used in [v.value for v in s.values], name
        )
    rig.play(BAGS / 'tracking', readers=2, rate=0.5)
    got = {n: client.messages[f'{n}/corrected_observations'] for n in NAMES}
    client.wait_until(
        lambda: all(len(got[n]) >= len(tracking[n]) for n in NAMES), what='all corrected frames'
    )
    return got


def test_exposures_are_collected(rig, exposures):
    for name in NAMES:
        status = rig.client.status(name)
        assert status.fluoroscope == name
        assert (
            status.frames_received == 15 and status.frames_rejected == status.frames_unpaired == 0
        )
        assert status.observations == sum(len(f.target_id) for f in exposures[name])
        assert 0.9 < status.coverage <= 1


def test_service_calibrates(rig, by_service):
    assert by_service.success and 'a, b calibrated' in by_service.message
    assert list(by_service.fluoroscope) == list(NAMES) and all(by_service.converged)
    for f, name in enumerate(NAMES):
        status = rig.client.wait_for_status(
            lambda s: s.state == CalibrationStatus.CALIBRATED, name
        )
        assert status.calibration_id == by_service.calibration_id[f]
        assert status.iteration == by_service.iterations[f] and status.calibration_age >= 0
        assert max(by_service.rmse_after_u[f], by_service.rmse_after_v[f]) < 0.25
        assert min(by_service.rmse_before_u[f], by_service.rmse_before_v[f]) > 1.0
        assert 0.95 < by_service.inliers[f] / by_service.observations[f] <= 1
        assert abs(by_service.c[f] - 4000) < 200 and 0 < by_service.sd_c[f] < 10
        published = calibration_from_message(rig.client.messages[f'{name}/calibration'][-1])
        assert (
            published.calibration_id == by_service.calibration_id[f] and published.exposures == 15
        )
    saved = load_calibrations(rig.directory_of_calibrations)
    assert [c.calibration_id for c in saved.values()] == list(by_service.calibration_id)


def test_action_gives_feedback_and_the_same_result(rig, by_service):
    handle = rig.client.goal()
    answer = rig.client.result_of(
        handle.get_result_async(), JOB_DEADLINE, 'the result of the action'
    )
    assert answer.status == SUCCEEDED and answer.result.success
    rig.client.wait_until(
        lambda: len(rig.client.feedback) == sum(by_service.iterations), what='all feedback'
    )
    for field in RESULT_FIELDS:
        assert list(getattr(answer.result, field)) == list(getattr(by_service, field)), field
    for f, name in enumerate(NAMES):
        rounds = [m for m in rig.client.feedback if m.fluoroscope == name]
        assert [m.iteration for m in rounds] == list(range(1, by_service.iterations[f] + 1))
        rmse = np.hypot([m.rmse_u for m in rounds], [m.rmse_v for m in rounds])
        assert (np.diff(rmse) < 2e-3).all() and rmse[-1] < 0.99 * rmse[
            0
        ]  # decreases to that value, then stays flat
        assert (
            rounds[-1].k == by_service.k[f]
            and rounds[-1].cost_adjustment < rounds[0].cost_adjustment
        )


def test_command_line_gives_the_same_calibration(by_service, by_command):
    saved = load_calibrations(by_command)
    assert [c.calibration_id for c in saved.values()] == list(by_service.calibration_id)
    for f, calibration in enumerate(saved.values()):
        live = [by_service.xp[f], by_service.yp[f], by_service.c[f]]
        assert np.abs(calibration.interior - live).max() <= 1e-9


@pytest.mark.parametrize('name', NAMES)
def test_command_line_twice_gives_the_same_bytes(by_command, by_second_command, name):
    one, two = (
        (folder / f'{name}.calibration.npz').read_bytes()
        for folder in (by_command, by_second_command)
    )
    assert one == two


@pytest.mark.parametrize('name', NAMES)
def test_every_frame_is_corrected_with_its_header(tracked, tracking, by_service, name):
    assert len(tracked[name]) == len(tracking[name])
    for message, frame in zip(tracked[name], tracking[name]):
        assert message.frame_number == frame.number and message.header.frame_id == frame.frame_id
        assert message.header.stamp.sec * 10**9 + message.header.stamp.nanosec == frame.stamp_ns
        assert np.array_equal(message.target_id, frame.target_id)
        assert message.calibration_id == by_service.calibration_id[NAMES.index(name)]
        assert (
            len(message.u)
            == len(message.v)
            == len(message.sigma)
            == len(message.status)
            == len(frame.target_id)
        )
    status = np.concatenate([m.status for m in tracked[name]])
    assert (status == CorrectedObservations.OK).mean() > 0.99
    sigma = np.concatenate([m.sigma for m in tracked[name]])[status == CorrectedObservations.OK]
    # The scale of the Student-t noise, which is below its standard deviation, combined with that
    # of the correction
    assert sigma.min() > 0.6 * NOISE_PX and sigma.max() < 1.5 * NOISE_PX


@pytest.mark.parametrize('name', NAMES)
def test_corrected_markers_match_the_truth(tracked, tracking, name):
    ideal = ideal_pixels(name)
    true = np.concatenate([[ideal[m.frame_number, i] for i in m.target_id] for m in tracked[name]])
    corrected = np.concatenate([np.column_stack([m.u, m.v]) for m in tracked[name]])
    observed = np.concatenate([frame.uv for frame in tracking[name]])
    assert rmse_after_homography(corrected, true) < 1.2 * NOISE_PX
    # a homography cannot remove it, whichever part of the image the markers cross
    assert rmse_after_homography(observed, true) > 2 * NOISE_PX


@pytest.mark.parametrize('name', NAMES)
def test_camera_info_of_the_corrected_stream(rig, tracked, by_service, name):
    f = NAMES.index(name)
    info = rig.client.messages[f'{name}/camera_info'][-1]
    xp = by_service.xp[f]
    yp = by_service.yp[f]
    c = by_service.c[f]
    assert list(info.k) == [c, 0, xp, 0, c, yp, 0, 0, 1]
    assert list(info.p) == [c, 0, xp, 0, 0, c, yp, 0, 0, 0, 1, 0]
    assert len(info.d) == 5 and not any(info.d) and list(info.r) == [1, 0, 0, 0, 1, 0, 0, 0, 1]
    assert (info.width, info.height) == (1024, 1024) and info.header.frame_id == f'{name}_optical'


def ideal_pixels(name):
    """Return the ideal pixels (2,) of the markers by (frame, marker), from the truth."""
    rig = json.loads((BAGS / 'truth' / 'rig.json').read_text())['fluoroscopes'][name]
    with open(BAGS / 'truth' / 'markers.csv', newline='') as file:
        rows = [
            (
                int(r['frame']),
                int(r['target_id']),
                float(r['x_mm']),
                float(r['y_mm']),
                float(r['z_mm']),
            )
            for r in csv.DictReader(file)
        ]
    points = np.array([row[2:] for row in rows])
    rotation = matrix_from_quaternion(np.array(rig['quaternion_wxyz']))
    interior = np.array([rig['interior'][key] for key in ('xp', 'yp', 'c')])
    pixels = project(
        np.broadcast_to(rotation, (len(rows), 3, 3)),
        np.broadcast_to(rig['position_mm'], (len(rows), 3)),
        points,
        interior,
    )
    return {row[:2]: pixel for row, pixel in zip(rows, pixels)}


def rmse_after_homography(uv, true):
    """Return the RMSE [px] of uv (n, 2) against true (n, 2) after the best projective map.

    A calibration cannot determine more: shift, rotation and scale of the sensor are part of the
    orientation.
    """
    x, y = ((true - 512) / 512).T
    u, v = ((uv - 512) / 512).T
    one = np.ones_like(u)
    nil = np.zeros_like(u)
    left = np.concatenate(
        [
            np.column_stack([u, v, one, nil, nil, nil, -x * u, -x * v]),
            np.column_stack([nil, nil, nil, u, v, one, -y * u, -y * v]),
        ]
    )
    h = np.append(np.linalg.lstsq(left, np.concatenate([x, y]), rcond=None)[0], 1.0).reshape(3, 3)
    mapped = np.column_stack([u, v, one]) @ h.T
    return float(
        512 * np.sqrt(np.mean((mapped[:, :2] / mapped[:, 2:] - np.column_stack([x, y])) ** 2))
    )
