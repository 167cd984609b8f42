# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""A self-calibration in parallel with the stream; if cancelled or refused, it changes nothing."""

import pytest
from fluoro_calib_msgs.msg import CalibrationStatus
from fluoro_calib_msgs.srv import Calibrate, Capture, Reset
from ros_graph import ABORTED, CANCELED, JOB_DEADLINE, NAMES, SUCCEEDED, standing

REFUSED = 'refused: a self-calibration is already running'


class Rig:
    """Both nodes with a loaded calibration and 15 collected exposures."""

    def __init__(self, graph, folder, exposures):
        self.folder = folder
        self.client = graph.client
        # Deep enough for a machine that is too busy to keep up with the rate.
        graph.both_nodes(
            folder,
            **{
                f'qos_overrides.{graph.namespace}/{n}/target_observations.subscription.depth': 5000
                for n in NAMES
            },
        )
        for topic in ('calibration', 'corrected_observations'):
            for name in NAMES:
                self.client.listen(f'{name}/{topic}')
        self.collect(exposures)
        self.client.wait_until(
            lambda: all(self.messages('calibration').values()), what='the loaded calibrations'
        )
        for name in NAMES:
            self.client.wait_for_diagnostics(
                'correction_node', lambda s: 'no calibration' not in s.message, name
            )

    def collect(self, exposures):
        """Publish exposures and wait until all are collected."""
        before = self.client.status().exposures if self.client.status() else 0
        pairs = list(zip(*exposures.values()))
        for pair in pairs:
            for frame in pair:
                self.client.publish(frame)
        self.client.wait_for_status(
            lambda s: s.exposures == before + len(pairs), what=f'{len(pairs)} exposures'
        )

    def messages(self, topic):
        return {n: self.client.messages[f'{n}/{topic}'] for n in NAMES}

    def state(self):
        """Return everything that a job may change: files and published calibrations."""
        files = {path.name: path.read_bytes() for path in self.folder.iterdir()}
        return files, {n: len(m) for n, m in self.messages('calibration').items()}


@pytest.fixture(scope='module')
def rig(module_graph, by_command, exposures, tmp_path_factory):
    folder = tmp_path_factory.mktemp('calibrations')
    for path in by_command.glob('*.npz'):
        (folder / path.name).write_bytes(path.read_bytes())
    return Rig(module_graph, folder, exposures)


def test_stream_continues_while_a_job_runs(rig, exposures):
    client = rig.client
    rate = 120.0
    received = client.wait_for_status(lambda s: s.exposures == 15).frames_received
    corrected = rig.messages('corrected_observations')
    before = {n: len(m) for n, m in corrected.items()}
    published = rig.state()[1]['a']
    frames = [standing(exposures[n][0], 10**6, 1000, rate) for n in NAMES]
    answer = client.goal(model='local_linear', fluoroscopes=['a']).get_result_async()

    def came():
        return min(len(corrected[n]) - before[n] for n in NAMES)

    def taken():
        """Count as came does, but stay at most some seconds ahead of the number of frames that the
        calibration node has reported as received.
        """
        return min(came(), client.status().frames_received - received + round(2 * rate))

    client.stream(zip(*frames), rate, taken)
    counted = set()

    def done():
        status = client.status()
        if status.state == CalibrationStatus.CALIBRATING:
            counted.add(status.frames_received)
        return answer.done()

    client.wait_until(done, JOB_DEADLINE, 'the self-calibration')
    during = client.published
    came_during = came()
    client.end_stream()
    assert answer.result().status == SUCCEEDED
    assert came_during > 150, 'frames were corrected while the job was running'
    assert during > 200 and len(counted) > 1, 'frames were counted while the job was running'
    client.wait_for_status(
        lambda s: s.frames_received == received + during, what=f'all {during} frames counted'
    )
    client.wait_until(
        lambda: all(len(corrected[n]) == before[n] + during for n in NAMES), what='all corrected'
    )
    client.wait_until(
        lambda: rig.state()[1]['a'] == published + 1, what='the new calibration of a'
    )
    for name in NAMES:
        assert client.status(name).exposures == 15 and client.status(name).frames_unpaired == 0
        assert [m.frame_number for m in corrected[name][before[name] :]] == list(
            range(1000, 1000 + during)
        )


def test_cancelled_job_changes_nothing_and_the_next_one_works(rig):
    client = rig.client
    before = rig.state()
    handle = client.goal()
    answer = handle.get_result_async()
    client.wait_until(lambda: client.feedback or answer.done(), what='the first feedback')
    assert client.result_of(handle.cancel_goal_async()).goals_canceling
    assert client.result_of(answer).status == CANCELED
    assert {f.fluoroscope for f in client.feedback} == {'a'}, 'the job ended before b was begun'
    assert not answer.result().result.success and 'cancelled' in answer.result().result.message
    assert rig.state() == before
    client.wait_for_status(
        lambda s: s.state == CalibrationStatus.CALIBRATED, what='the end of the job in the status'
    )

    handle = client.goal(model='none', fluoroscopes=['b'])  # no correction: a single, quick round
    assert client.result_of(handle.get_result_async()).status == SUCCEEDED
    files, published = rig.state()
    assert (
        files['a.calibration.npz'] == before[0]['a.calibration.npz']
        and published['a'] == before[1]['a']
    )
    assert files['b.calibration.npz'] != before[0]['b.calibration.npz']
    client.wait_until(
        lambda: rig.state()[1]['b'] == before[1]['b'] + 1, what='the new calibration of b'
    )


def test_second_request_is_refused_while_one_runs(rig):
    client = rig.client
    first = client.goal()
    answer = first.get_result_async()
    client.wait_until(lambda: client.feedback or answer.done(), what='the first feedback')
    second = client.call(Calibrate, 'calibrate')
    assert not second.success and second.message == REFUSED
    third = client.result_of(client.goal().get_result_async())
    assert third.status == ABORTED and third.result.message == REFUSED
    assert not answer.done(), 'the first job goes on'
    client.result_of(first.cancel_goal_async())
    assert client.result_of(answer).status == CANCELED


@pytest.mark.parametrize(
    'request_fields, message',
    [
        ({'fluoroscopes': ['a', 'z']}, 'fluoroscope z is unknown, expected one of a, b'),
        (
            {'model': 'spline'},
            'model must be one of auto, none, knn, local_linear, parametric, hybrid, collocation, '
            "not 'spline'",
        ),
        ({'interior': 'free'}, "interior must be one of estimated, fixed, not 'free'"),
        ({'loss': 'cauchy'}, "loss must be one of student_t, huber, gaussian, not 'cauchy'"),
        ({'principal_distance': -1.0}, 'principal_distance must be a length in pixels, not -1.0'),
        (
            {'principal_distance': float('nan')},
            'principal_distance must be a length in pixels, not nan',
        ),
    ],
)
def test_invalid_request_is_refused_in_one_sentence(rig, request_fields, message):
    before = rig.state()
    answer = rig.client.call(Calibrate, 'calibrate', **request_fields)
    assert not answer.success and answer.message == message
    assert rig.state() == before
    answer = rig.client.result_of(rig.client.goal(**request_fields).get_result_async())
    assert answer.status == ABORTED and answer.result.message == message
    assert rig.state() == before


def test_too_few_exposures_are_refused(rig, exposures):
    before = rig.state()
    answer = rig.client.call(Reset, 'reset')
    assert (
        answer.success and answer.message == '15 exposures discarded, the calibration stays in use'
    )
    rig.client.wait_for_status(lambda s: s.exposures == 0)
    rig.collect({n: f[:2] for n, f in exposures.items()})
    answer = rig.client.call(Calibrate, 'calibrate')
    assert (
        not answer.success
        and answer.message == 'fluoroscope a: 2 exposures are too few, 3 are needed'
    )
    assert rig.state() == before


def test_exposures_of_one_pose_are_refused(rig, exposures):
    client = rig.client
    before = rig.state()
    client.call(Reset, 'reset')
    client.wait_for_status(lambda s: s.exposures == 0)
    client.stream(zip(*(standing(exposures[n][0], 10**6) for n in NAMES)), 30.0)
    for _ in range(4):  # the node collects a pose by itself only once
        assert client.call(Capture, 'capture', timeout_sec=30.0).success
    client.end_stream()
    answer = client.call(Calibrate, 'calibrate')
    assert not answer.success and '\n' not in answer.message
    assert (
        answer.message.startswith('fluoroscope a: all ')
        and 'show the phantom in one pose' in answer.message
    )
    assert rig.state() == before
    assert client.status().calibration_id


def test_unwritable_folder_is_noticed_before_the_job(graph):
    """It is also reported before anything that the job itself lacks."""
    graph.calibration_node('/proc/calibrations')
    graph.client.expect(Calibrate, 'calibrate')
    answer = graph.client.call(Calibrate, 'calibrate')
    assert not answer.success
    assert answer.message.startswith('/proc/calibrations: ') and 'written' in answer.message
