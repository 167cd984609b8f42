# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Collecting exposures: by capture or from a stationary phantom; pairing by number or by stamp."""

import subprocess
from dataclasses import replace

import rigs
from fluoro_calib_msgs.srv import Calibrate, Capture
from ros_graph import JOB_DEADLINE, NAMES, entry_point, standing

from fluoro_calib_ros.io.bags.writer import write_bag
from fluoro_calib_ros.io.phantom import write_phantom


def pairs_of(exposures, i=0, count=10**6, **options):
    """Return a stream of the phantom as in exposure i, moved by shift px per frame."""
    return zip(*(standing(exposures[n][i], count, **options) for n in NAMES))


def test_capture_collects_one_exposure_per_call(graph, exposures, tmp_path):
    client = graph.client
    graph.calibration_node(tmp_path / 'none', collect='request', capture_timeout=0.5)
    answer = client.call(Capture, 'capture')
    assert not answer.success and answer.exposures == 0
    assert (
        answer.message
        == 'no frame of all fluoroscopes (a, b) came within 0.5 s; frames received: a 0, b 0'
    )
    client.stream(pairs_of(exposures), 60.0)
    for number in (1, 2, 3):
        answer = client.call(Capture, 'capture', timeout_sec=30.0)
        assert answer.success and answer.exposures == number, answer.message
        assert f'captured, {number} exposures now' in answer.message
    several = [
        client.call_async(Capture, 'capture', timeout_sec=30.0) for _ in range(8)
    ]  # a service call holds ten
    client.wait_until(lambda: all(one.done() for one in several), what='the captures')
    assert sorted(one.result().exposures for one in several) == list(range(4, 12)), (
        'a frame for each'
    )
    published = client.published
    client.wait_until(
        lambda: client.published > published + 30, what='frames that nobody captures'
    )
    client.end_stream()
    client.wait_for_status(lambda s: s.frames_received == client.published)
    assert client.status().exposures == 11


def test_capture_needs_all_fluoroscopes_and_a_new_frame(graph, exposures, tmp_path):
    client = graph.client
    graph.calibration_node(tmp_path / 'none', collect='request', capture_timeout=1.0)
    client.stream(((frame,) for frame in standing(exposures['a'][0], 10**6)), 60.0)
    answer = client.call(Capture, 'capture')
    client.end_stream()
    assert (
        not answer.success
        and 'no frame of all fluoroscopes (a, b) came within 1 s' in answer.message
    )
    client.stream(
        (tuple(replace(exposures[n][0], number=7) for n in NAMES) for _ in range(10**6)), 60.0
    )
    assert client.call(Capture, 'capture', timeout_sec=30.0).success
    answer = client.call(Capture, 'capture')  # only the same frame arrives
    client.end_stream()
    assert not answer.success and answer.message == 'frame 7 is collected already'
    answer = client.call(Capture, 'capture', timeout_sec=-1.0)
    assert (
        not answer.success and answer.message == 'timeout_sec must be a time in seconds, not -1.0'
    )


def test_standing_phantom_gives_one_exposure_and_a_moving_one_none(graph, exposures, tmp_path):
    client = graph.client
    sent = 0
    graph.calibration_node(tmp_path / 'none')

    def stream(count, **options):
        nonlocal sent
        client.stream(
            pairs_of(
                exposures, count=count, first=sent + 1, start_ns=10**18 + sent * 10**9, **options
            ),
            200,
        )  # only the stamps count
        client.wait_until(
            lambda: client.published == count, what=f'{count} frames to be published'
        )
        client.end_stream()
        sent += count
        return client.wait_for_status(
            lambda s: s.frames_received == sent, what='all frames counted'
        ).exposures

    assert stream(60) == 1, 'stands'
    # The first frame counts as a single shot if none has arrived in the preceding time, so make it
    # the known pose
    assert stream(60, shift=3.0) == 1, 'moves'
    assert stream(60, i=1) == 2, 'stands in a new pose'
    assert stream(30, i=1) == 2 and stream(30) == 2, 'stands where it has stood'


def test_simulated_phantom_is_collected_automatically(graph, tmp_path):
    client = graph.client
    graph.calibration_node(tmp_path / 'none')
    graph.start('simulator_node', {'stand_time': 0.4, 'move_time': 0.4, 'rate': 60.0})
    status = client.wait_for_status(
        lambda s: s.exposures >= 3, what='three exposures of the virtual rig'
    )
    assert status.frames_rejected == 0 and status.observations > 3 * 120
    # at most one per turn of 0.8 s, plus one that is already on its way at the start
    assert status.exposures <= status.frames_received / (0.8 * 60) + 2


def test_frames_without_partner_are_counted_and_reported(graph, exposures, tmp_path):
    client = graph.client
    graph.calibration_node(tmp_path / 'none')
    for frame in standing(exposures['a'][0], 80):
        client.publish(frame)  # nothing of b: 64 frames wait, the others are dropped
    client.wait_for_status(lambda s: s.frames_received == 80)
    assert client.wait_for_status(lambda s: s.frames_unpaired == 16).exposures == 0
    status = client.wait_for_diagnostics(
        'calibration_node', lambda s: s.level == b'\1' and 'partner' in s.message
    )
    assert status.message.startswith('16 frames without partner of the other fluoroscopes')
    assert {v.key: v.value for v in status.values}['frames unpaired'] == '16'
    assert client.wait_for_status(lambda s: True, 'b').frames_unpaired == 0


def test_pairing_by_stamp(graph, exposures, tmp_path):
    client = graph.client
    graph.calibration_node(tmp_path / 'none', pair_by='stamp', pair_tolerance=0.002)
    for a, b in list(zip(*exposures.values()))[:5]:  # unrelated frame numbers
        client.publish(replace(a, number=0))
        client.publish(replace(b, number=1000 - b.number, stamp_ns=b.stamp_ns + 1_500_000))
    status = client.wait_for_status(lambda s: s.exposures == 5)
    assert status.frames_unpaired == 0
    a = exposures['a'][5]
    b = exposures['b'][5]
    client.publish(a)
    client.publish(replace(b, stamp_ns=b.stamp_ns + 2_500_000))  # too far apart in time
    client.wait_for_status(lambda s: s.frames_received == 6)
    assert client.wait_for_status(lambda s: s.frames_received == 6, 'b').exposures == 5


def test_a_sheet_in_front_of_each_detector_in_turn_calibrates_as_offline(graph, tmp_path):
    """The other fluoroscope shows no phantom meanwhile; the cube is a pair."""
    client = graph.client
    shown, phantom = rigs.sheet_and_cube()
    write_phantom(tmp_path / 'both.csv', phantom)
    (cube_a, sheet_a), (cube_b, sheet_b) = (
        [replace(frame, frame_id=f'{name}_optical') for frame in shown[name]] for name in NAMES
    )
    start_ns = 1_800_000_000 * 10**9
    frames = [
        replace(frame, number=number, stamp_ns=start_ns + number * 10**9)
        for number, frame in enumerate([sheet_a, sheet_b], 1)
    ]
    frames += [replace(f, number=3, stamp_ns=start_ns + 3 * 10**9) for f in (cube_a, cube_b)]
    graph.calibration_node(tmp_path / 'live', phantom=tmp_path / 'both.csv')
    for frame in frames:
        client.publish(frame)
    for name in NAMES:
        status = client.wait_for_status(lambda s: s.exposures == 2, name, 'both exposures')
        assert status.frames_unpaired == 0
    answer = client.call(Calibrate, 'calibrate')
    assert answer.success, answer.message
    write_bag(tmp_path / 'bag', {n: [f for f in frames if f.fluoroscope == n] for n in NAMES})
    command = [*entry_point('cli'), 'calibrate', tmp_path / 'bag', '--out', tmp_path / 'offline']
    command += ['--phantom', tmp_path / 'both.csv', '--fast']
    subprocess.run(command, stdout=subprocess.DEVNULL, timeout=JOB_DEADLINE, check=True)
    for file in ('interior.csv', 'targets.csv', 'residuals.csv'):
        live, offline = (tmp_path / folder / file for folder in ('live', 'offline'))
        assert live.read_bytes() == offline.read_bytes()
