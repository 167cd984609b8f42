# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Shapes are learned live; a bumped rig is healed with the same numbers as by the command."""

import itertools
import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
from fluoro_calib_msgs.msg import ReconstructedPoints
from fluoro_calib_msgs.srv import Reset
from rclpy.serialization import deserialize_message
from rigs import run
from ros_graph import ABORTED, CANCELED, JOB_DEADLINE, NAMES, SUCCEEDED, value_of
from test_reconstruction import coordinates
from test_web import page

from fluoro_calib_ros.checks.rig_watch import RigDriftWatch
from fluoro_calib_ros.io.bags.writer import write_bag
from fluoro_calib_ros.io.bodies import write_bodies
from fluoro_calib_ros.io.calibration import load_calibrations, load_orientation, orientation_path
from fluoro_calib_ros.io.versions import LEARNED_SHAPES, read_learned_shapes
from fluoro_calib_ros.jobs.healing import BLOCKS
from fluoro_calib_ros.jobs.reconstruction import ReconstructionOptions
from fluoro_calib_ros.nodes.messages.observations import message_from_frame
from fluoro_calib_ros.nodes.messages.points import PointsContent, encode_reconstructed_points
from fluoro_calib_ros.photogrammetry.rotations import matrix_from_vector
from fluoro_calib_ros.reconstruction.intersection import Intersector
from fluoro_calib_ros.reconstruction.reconstruct import RigRecording
from fluoro_calib_ros.simulation.knee import simulate_knee, virtual_knee, walking
from fluoro_calib_ros.simulation.rig import virtual_rig

SEED = 1  # rig seed of the bags
EXPOSURES = 60
RATE_HZ = 120.0
MOVED_MM = np.array([3.0, -2.0, 3.5])  # norm 5 mm
TURNED_RAD = np.radians([0.35, -0.28, 0.22])  # norm 0.5 degrees
COVARIANCE = [f'cov_{name}' for name in ('xx', 'xy', 'xz', 'yy', 'yz', 'zz')]
FAULTS = ('accept_healing', 'roll_back_healing')


def bumped_rig():
    """Return the rig of the bags after fluoroscope b was bumped."""
    rig = virtual_rig(SEED)
    a, b = rig.fluoroscopes
    moved = replace(
        b,
        rotation=matrix_from_vector(TURNED_RAD) @ b.rotation,
        position_mm=b.position_mm + MOVED_MM,
    )
    return replace(rig, fluoroscopes=(a, moved))


def later(frame):
    """Return a frame of the bumped rig with a stamp after those of the healthy rig."""
    stamp_ns = frame.stamp_ns + round(1e9 * EXPOSURES / 60)
    return replace(frame, number=frame.number + EXPOSURES, stamp_ns=stamp_ns)


class Rig:
    """All nodes with a calibration; a knee walks, and continues in a bumped rig."""

    def __init__(self, graph, folder, by_command):
        self.graph = graph
        self.client = graph.client
        self.calibrated = shutil.copytree(by_command, folder / 'by_command')
        self.folder = shutil.copytree(by_command, folder / 'calibrations')
        self.knee = virtual_knee(SEED)
        self.motion = walking(self.knee, np.arange(EXPOSURES) / 60)
        self.bodies = folder / 'bodies.csv'
        write_bodies(self.bodies, self.knee.surveyed)
        self.healthy = simulate_knee(virtual_rig(SEED), self.knee, self.motion).frames
        write_bag(folder / 'walking', self.healthy)
        given = ('--bodies', self.bodies, '--calibration', self.calibrated, '--learn')
        assert run('bodies', folder / 'walking', *given, '--out', folder / 'motion') == 0
        bumped = simulate_knee(bumped_rig(), self.knee, self.motion).frames
        self.frames = {name: [later(frame) for frame in bumped[name]] for name in NAMES}
        self.bag = folder / 'bumped'
        write_bag(self.bag, self.frames)
        self.points = self.client.listen('reconstruction/points_with_covariance')
        self.orientations = self.client.listen('rig_orientation')
        self.transforms = self.client.listen('/tf_static')
        # One exposure fewer would not be enough.
        nodes = graph.whole_chain(
            self.folder, learn_bodies=self.bodies, learn_time=(EXPOSURES - 1.5) / 60
        )
        self.reconstruction = nodes['reconstruction_node']
        self.client.wait_until(lambda: self.orientations, what='the first orientation')
        assert not (self.folder / LEARNED_SHAPES).exists()
        self.publish(self.healthy)
        self.client.wait_for_diagnostics(
            'calibration_node', lambda s: s.message.startswith('shapes of'), 'shapes', 'shapes'
        )

    def publish(self, frames=None):
        """Publish exposures, by default all of the bumped rig; return points (T, n, 3) [mm]."""
        before = len(self.points)
        pairs = zip(*((frames or self.frames)[name] for name in NAMES))
        messages = [(one.fluoroscope, message_from_frame(one)) for pair in pairs for one in pair]
        self.client.publish_in_step(messages, lambda: 2 * (len(self.points) - before))
        self.client.wait_until(
            lambda: len(self.points) == before + EXPOSURES, what='points of all exposures'
        )
        markers = np.concatenate([body.target_id for body in self.knee.bodies])
        out = np.full((EXPOSURES, len(markers), 3), np.nan)
        for row, message in enumerate(self.points[before:]):
            found = dict(zip(message.target_id, coordinates(message)[0]))
            for k, marker in enumerate(markers.tolist()):
                out[row, k] = found.get(marker, np.nan)
        return out

    def healed(self, **fields):
        """Heal the rig from exactly these exposures; return the result of the action."""
        answer = self.client.heal(**fields).get_result_async()
        self.client.wait_until(lambda: self.client.feedback or answer.done(), what='the start')
        self.publish()
        return self.client.result_of(answer)

    def stream(self, of_rig=None):
        """Yield pairs of frames of an endlessly walking knee, seen by the last rig of a list."""
        of_rig = of_rig or [self.frames]
        step_ns = round(1e9 / RATE_HZ)
        for number in itertools.count(10**6):
            pair = [of_rig[-1][name][number % EXPOSURES] for name in NAMES]
            yield [replace(f, number=number, stamp_ns=10**18 + number * step_ns) for f in pair]

    def by_command(self, tmp_path, capsys):
        """Return the healing.json that the command computes from the same exposures."""
        capsys.readouterr()
        given = ('--calibration', self.calibrated, '--out', tmp_path / 'healed')
        assert run('heal', self.bag, *given, '--json') == 0
        return json.loads(capsys.readouterr().out)

    def restart_reconstruction(self):
        """End the reconstruction node and start a new one."""
        assert self.reconstruction.end() == 0
        self.transforms.clear()
        self.reconstruction = self.graph.start('reconstruction_node')
        self.client.wait_until(
            lambda: self.transforms and len(self.transforms[-1].transforms) > 2, what='transforms'
        )
        self.graph.wait_for_readers(1)

    def wait_for_orientation(self, orientation_id):
        self.client.wait_for_diagnostics(
            'reconstruction_node',
            lambda s: value_of(s, 'orientation') == orientation_id,
            'reconstruction',
        )

    def shape_error_mm(self, points):
        """Return the RMS error of relative point positions [mm], after the best rigid motion."""
        true = np.concatenate(
            [
                body.xyz_mm @ np.swapaxes(self.motion.rotation[body.name], 1, 2)
                + self.motion.position_mm[body.name][:, None]
                for body in self.knee.bodies
            ],
            axis=1,
        )
        errors = []
        for found, truth in zip(points, true):
            good = np.isfinite(found).all(axis=1)
            one, other = found[good] - found[good].mean(0), truth[good] - truth[good].mean(0)
            u, _, v = np.linalg.svd(one.T @ other)
            turn = u @ np.diag([1, 1, np.linalg.det(u @ v)]) @ v
            errors.append(one @ turn - other)
        return float(np.sqrt((np.concatenate(errors) ** 2).sum(axis=1).mean()))


def found_share(points):
    return np.isfinite(points).all(axis=2).mean()


@pytest.fixture(scope='module')
def rig(module_graph, by_command, tmp_path_factory):
    return Rig(module_graph, tmp_path_factory.mktemp('healing'), by_command)


@pytest.fixture
def learned(rig, calibrated):
    """Folder with a calibration and learned shapes; a test may change it."""
    shutil.copy(rig.calibrated / LEARNED_SHAPES, calibrated)
    return calibrated


def test_shapes_are_learned_live_to_the_same_bytes(rig):
    live, offline = (folder / LEARNED_SHAPES for folder in (rig.folder, rig.calibrated))
    assert live.read_bytes() == offline.read_bytes()
    learned = read_learned_shapes(rig.folder)
    assert learned.exposures == EXPOSURES
    assert learned.begin_ns == rig.healthy['a'][0].stamp_ns
    assert learned.end_ns == rig.healthy['a'][-1].stamp_ns
    for body in learned.bodies:
        assert body.covariance_mm2.shape == (12, 12) and (body.sd_mm < 0.1).all()


def test_deviations_between_alarm_and_healing_are_those_of_the_recording(rig):
    """Live and offline covariances are the same bytes, before the alarm and with what it adds."""
    first = len(rig.points) - EXPOSURES
    points = rig.publish()
    frames = {name: [*rig.healthy[name], *rig.frames[name]] for name in NAMES}
    calibrations = load_calibrations(rig.folder)
    orientation = load_orientation(orientation_path(rig.folder))
    sizes = {name: calibrations[name].image_size for name in NAMES}
    watch = RigDriftWatch(orientation, sizes)
    intersector = Intersector(orientation, ReconstructionOptions().reject)
    offline = RigRecording(frames, calibrations, intersector).reconstruct(watch)
    assert watch.widening is not None
    for message, frame in zip(rig.points[first:], offline, strict=True):
        content = PointsContent(
            frame.stamp_ns,
            frame.number,
            message.orientation_id,
            orientation=orientation,
            target_id=frame.target_id,
            points=frame.points,
        )
        data = encode_reconstructed_points(content)
        expected = deserialize_message(data, ReconstructedPoints)
        for name in COVARIANCE:
            assert getattr(message, name).tobytes() == getattr(expected, name).tobytes()
    assert found_share(points[:10]) < 0.1, 'views that do not fit give no points'
    before, after = (np.nanmedian(rig.points[row].cov_zz) for row in (first, -1))
    assert after > 10 * before, 'along the view of a'


def test_bumped_rig_is_healed_accepted_and_rolled_back(rig, tmp_path, capsys):
    """Live numbers equal those of the command, points are right again, and the parent is kept."""
    before = load_orientation(orientation_path(rig.folder))
    for service in FAULTS:
        refused = rig.client.call(Reset, service)
        assert not refused.success
    assert 'was not healed, there is nothing to roll back' in refused.message
    answer = rig.healed(seconds=3.0)
    assert answer.status == SUCCEEDED, answer.result.message
    result = answer.result
    expected = rig.by_command(tmp_path, capsys)
    rig.client.wait_until(
        lambda: {f.stage for f in rig.client.feedback} == {'collecting', 'diagnosing'},
        what='the feedback of both stages',
    )
    assert result.exposures == expected['exposures'] and result.verdict == 'pass'
    assert result.orientation_id == expected['orientation_id']
    assert result.findings == [one['sentence'] for one in expected['findings']]
    assert list(result.fluoroscope) == ['b']
    change = expected['changes']['b']
    assert list(result.change[:3]) == change['position_mm']
    assert list(result.sd[:3]) == change['position_sd_mm']
    np.testing.assert_allclose(np.degrees(result.change[3:6]), change['rotation_deg'], rtol=1e-12)
    assert rig.orientations[-1].orientation_id == before.orientation_id, 'nothing is changed yet'

    accepted = rig.client.call(Reset, 'accept_healing')
    assert accepted.success, accepted.message
    rig.wait_for_orientation(result.orientation_id)
    rig.client.wait_for_diagnostics(
        'calibration_node', lambda s: value_of(s, 'source of the orientation') == 'healing'
    )
    shift = np.linalg.norm(result.change[:3])
    assert f'transforms of the rig jump: b by {shift:.2f} mm and ' in rig.reconstruction.log
    transforms = {one.child_frame_id: one for one in rig.transforms[-1].transforms}
    child = transforms['b_optical']
    kept = transforms[child.header.frame_id]
    assert (child.header.frame_id, kept.header.frame_id) == ('b_optical_as_calibrated', 'rig')
    (first,) = (o for o in rig.transforms[0].transforms if o.child_frame_id == 'b_optical')
    assert kept.transform == first.transform, 'the frame as calibrated does not jump'
    moved = child.transform.translation
    assert 1000 * np.linalg.norm([moved.x, moved.y, moved.z]) == pytest.approx(shift, rel=1e-6)
    rig.restart_reconstruction()
    again = {one.child_frame_id: one for one in rig.transforms[-1].transforms}
    assert again == transforms, 'the frame as calibrated outlives the node'
    saved = load_orientation(orientation_path(rig.folder))
    assert (saved.orientation_id, saved.source) == (result.orientation_id, 'healing')
    versions = {path.name for path in (rig.folder / 'versions').iterdir()}
    assert versions == {before.orientation_id, result.orientation_id}
    points = rig.publish()
    assert rig.points[-1].orientation_id == result.orientation_id
    assert found_share(points) > 0.9
    assert rig.shape_error_mm(points) < 0.2
    assert not rig.client.call(Reset, 'accept_healing').success

    back = rig.client.call(Reset, 'roll_back_healing')
    assert back.success, back.message
    rig.wait_for_orientation(before.orientation_id)
    assert load_orientation(orientation_path(rig.folder)).orientation_id == before.orientation_id
    assert not rig.client.call(Reset, 'roll_back_healing').success


def test_page_heals_accepts_and_rolls_back(rig):
    before = load_orientation(orientation_path(rig.folder)).orientation_id
    wait = rig.client.wait_until
    with page(rig.graph) as (_, browser):
        browser.enter()

        def state():
            return browser.json('/state')

        wait(lambda: state()['orientation_id'] == before, what='the rig as calibrated')

        def refused():
            # The answer is lost if the service has not yet discovered the client.
            assert browser.ask('accept_healing')[0] == 204
            return 'no healed rig to accept' in str(state()['log'])

        wait(refused, what='a refusal')

        def started():
            # The page may discover the services before the action.
            if not (job := state()['job']):
                assert browser.ask('heal')[0] == 204
            return 'frames of markers' in job

        wait(started, what='the start')
        rig.publish()
        found = wait(lambda: (s := state())['acceptable'] and s, JOB_DEADLINE, 'a healed rig')
        assert found['light']['word'] == 'Healed' and not found['job']
        assert found['diagnosis']['verdict'] == 'pass' and found['diagnosis']['findings']
        assert browser.ask('accept_healing')[0] == 204
        healed = found['diagnosis']['orientation_id']
        wait(lambda: state()['orientation_id'] == healed, what='the healed rig in use')
        wait(lambda: not state()['diagnosis']['verdict'], what='the answer')
        assert state()['orientation'] == 'healing' and not state()['acceptable']
        assert browser.ask('roll_back_healing')[0] == 204
        wait(lambda: state()['orientation_id'] == before, what='the rig before')


def test_stream_goes_on_while_a_rig_is_healed(rig):
    before = len(rig.points)

    def came():
        return len(rig.points) - before

    answer = rig.client.heal(seconds=1.0).get_result_async()
    rig.client.stream(rig.stream(), RATE_HZ, came)
    rig.client.wait_until(answer.done, JOB_DEADLINE, 'the healing')
    published = rig.client.published
    rig.client.end_stream()
    assert answer.result().status == SUCCEEDED, answer.result().result.message
    assert published > RATE_HZ
    rig.client.wait_until(lambda: came() == published, what='points of all exposures')
    numbers = [m.frame_number for m in rig.points[before:]]
    assert numbers == list(range(10**6, 10**6 + published))


def test_cancelled_healing_changes_nothing_and_a_second_one_is_refused(rig):
    handle = rig.client.heal(seconds=60.0)
    answer = handle.get_result_async()
    second = rig.client.result_of(rig.client.heal().get_result_async())
    assert second.status == ABORTED
    assert second.result.message == 'refused: a healing is already running'
    rig.client.result_of(handle.cancel_goal_async())
    cancelled = rig.client.result_of(answer)
    assert cancelled.status == CANCELED and 'cancelled' in cancelled.result.message
    assert 'no healed rig' in rig.client.call(Reset, 'accept_healing').message


@pytest.mark.parametrize(
    'fields, message',
    [
        ({'seconds': -1.0}, 'seconds must be above 0 and at most 60, not -1'),
        ({'seconds': float('nan')}, 'seconds must be above 0 and at most 60, not nan'),
        ({'seconds': 0.2}, 'no frame with a marker of a body came within 0.2 s'),
    ],
)
def test_refused_healing_gives_the_reason(rig, fields, message):
    def refused():
        answer = rig.client.result_of(rig.client.heal(**fields).get_result_async())
        assert answer.status == ABORTED
        return answer.result.message == message

    # The node may still read frames of an earlier stream.
    rig.client.wait_until(refused, what='the reason')


def test_what_is_missing_is_told(graph, tmp_path, calibrated):
    for directory, message in (
        (calibrated, 'no shapes of bodies were learned while the rig was healthy'),
        (tmp_path / 'empty', 'fluoroscope a is not calibrated'),
    ):
        node = graph.calibration_node(directory)
        answer = graph.client.result_of(graph.client.heal().get_result_async())
        assert answer.status == ABORTED and message in answer.result.message
        assert node.end() == 0
        graph.client.wait_until(
            lambda: not graph.client.count_publishers('rig_orientation'), what='its end'
        )


def test_healed_rig_accepted_by_the_parameter_outlives_the_node(rig, graph, learned):
    before = load_orientation(orientation_path(learned)).orientation_id
    client = graph.client
    published = client.listen('rig_orientation')
    node = graph.calibration_node(learned, heal_accept=True)
    answer = client.heal(seconds=3.0).get_result_async()  # enough for them on a busy machine
    client.stream(itertools.islice(rig.stream(), 2 * EXPOSURES), RATE_HZ)
    result = client.result_of(answer).result
    client.end_stream()
    assert result.verdict == 'pass' and 'accepted and in use' in result.message
    client.wait_until(
        lambda: published[-1].orientation_id == result.orientation_id, what='the healed rig'
    )
    assert node.end() == 0
    client.wait_until(lambda: not client.count_publishers('rig_orientation'), what='its end')
    published.clear()
    graph.calibration_node(learned)
    client.wait_until(lambda: published, what='the saved rig')
    assert published[-1].orientation_id == result.orientation_id
    back = client.call(Reset, 'roll_back_healing')
    assert back.success, back.message
    client.wait_until(lambda: published[-1].orientation_id == before, what='the parent')
    assert load_orientation(orientation_path(learned)).orientation_id == before
    assert len(read_learned_shapes(learned).orientation_ids) == 2


def stream_of(rig, virtual, motion):
    """Yield pairs of frames of a knee seen by a virtual rig."""
    frames = simulate_knee(virtual, rig.knee, motion, seed=3).frames
    for pair in zip(*(frames[n] for n in NAMES)):
        yield [replace(f, stamp_ns=10**18 + f.number * 10**7) for f in pair]


def test_healthy_rig_stays_where_it_is_and_claims_what_is_not_seen(rig, graph, learned):
    client = graph.client
    before = load_orientation(orientation_path(learned))
    graph.calibration_node(learned, heal_accept=True)
    answer = client.heal(seconds=3.0).get_result_async()
    client.stream(stream_of(rig, virtual_rig(SEED), rig.motion), RATE_HZ)
    result = client.result_of(answer).result
    client.end_stream()
    assert result.success and not result.findings and not result.fluoroscope, result.message
    after = load_orientation(orientation_path(learned))
    assert after.orientation_id == result.orientation_id != before.orientation_id
    of_healed, of_parent = (load_calibrations(folder) for folder in (learned, rig.calibrated))
    assert after.calibration_ids == tuple(of_healed[name].calibration_id for name in NAMES)
    for name in NAMES:
        new, old = (one[name].model.series for one in (of_healed, of_parent))
        np.testing.assert_array_equal(new.coefficients, old.coefficients)
        assert (new.sd >= old.sd).all() and new.sd[0, 0] > old.sd[0, 0]
    np.testing.assert_array_equal(after.position_mm, before.position_mm)
    np.testing.assert_array_equal(after.rotation, before.rotation)
    of_b = before.covariance_rows([1])[:6]
    assert (np.diagonal(after.covariance - before.covariance)[of_b] > 0).all()


def test_rig_that_moves_while_it_is_recorded_is_not_accepted(rig, graph, learned):
    client = graph.client
    before = load_orientation(orientation_path(learned)).orientation_id
    graph.calibration_node(learned, heal_accept=True)
    answer = client.heal(seconds=3.0).get_result_async()
    # The blocks that the diagnosis does not use show the rig before the bump.
    rigs = zip(
        stream_of(rig, bumped_rig(), rig.motion), stream_of(rig, virtual_rig(SEED), rig.motion)
    )
    client.stream((pair[row * BLOCKS // EXPOSURES % 2] for row, pair in enumerate(rigs)), RATE_HZ)
    result = client.result_of(answer).result
    client.end_stream()
    assert result.success and result.verdict == 'fail' and result.checks, result.message
    refused = client.call(Reset, 'accept_healing')
    assert not refused.success
    assert result.orientation_id
    assert refused.message.startswith('not accepted: the verdict on the healed rig is fail: ')
    assert load_orientation(orientation_path(learned)).orientation_id == before


def test_too_few_exposures_are_refused(rig, graph, learned):
    client = graph.client
    graph.calibration_node(learned)
    answer = client.heal(seconds=3.0).get_result_async()  # enough for the frames on a busy machine
    few = itertools.islice(stream_of(rig, bumped_rig(), rig.motion), 8)
    client.stream(few, RATE_HZ)
    refused = client.result_of(answer)
    client.end_stream()
    assert refused.status == ABORTED
    assert refused.result.message.endswith('two views, 20 are needed')


def test_alarm_of_the_drift_watch_heals_the_rig(rig, graph, learned):
    """No user request: drift watch, healing and acceptance follow the bump automatically."""
    client = graph.client
    before = load_orientation(orientation_path(learned)).orientation_id
    orientations = client.listen('rig_orientation')
    points = client.listen('reconstruction/points_with_covariance')
    graph.whole_chain(
        learned,
        {'heal_on_drift': True},
        heal_accept=True,
        heal_time=2.0,
    )
    healthy, bumped = (
        list(stream_of(rig, virtual, rig.motion)) for virtual in (virtual_rig(SEED), bumped_rig())
    )
    is_bumped = False

    def stream():
        for number in itertools.count(10**6):
            pair = (bumped if is_bumped else healthy)[number % EXPOSURES]
            stamp_ns = 10**18 + number * 2 * 10**7
            yield [replace(f, number=number, stamp_ns=stamp_ns) for f in pair]

    client.stream(stream(), RATE_HZ, lambda: len(points))
    client.wait_for_diagnostics(
        'reconstruction_node', lambda s: int(value_of(s, 'observations') or 0) > 4500, 'drift'
    )
    assert {one.orientation_id for one in orientations} == {before}
    is_bumped = True
    client.wait_for_diagnostics(
        'reconstruction_node',
        lambda s: 'until the rig is healed' in value_of(s, 'standard deviations'),
        'drift',
    )
    client.wait_until(lambda: orientations[-1].orientation_id != before, JOB_DEADLINE, 'healing')
    healed = orientations[-1].orientation_id
    client.wait_until(
        lambda: points[-1].orientation_id == healed and len(points[-1].target_id) == 8,
        what='points of the healed rig',
    )
    client.end_stream()
    assert orientations[-1].source == 'healing'
    assert load_orientation(orientation_path(learned)).orientation_id == healed


def test_nothing_is_learned_after_an_alarm_of_the_drift_watch(rig, graph, calibrated):
    """Nor after restarts of the node that raised the alarm and of the one that received it."""
    client = graph.client
    parameters = {'learn_bodies': rig.bodies, 'learn_time': 600.0}
    points = client.listen('reconstruction/points_with_covariance')
    nodes = graph.whole_chain(calibrated, **parameters)

    def told(message):
        client.wait_for_diagnostics('calibration_node', lambda s: message in s.message, 'shapes')

    told('markers seen for')
    of_rig = [rig.healthy]
    client.stream(rig.stream(of_rig), RATE_HZ, lambda: len(points))
    client.wait_for_diagnostics(
        'reconstruction_node', lambda s: int(value_of(s, 'observations') or 0) > 1000, 'drift'
    )
    of_rig.append(rig.frames)
    told('the drift watch has given an alarm')
    client.end_stream()
    for name in ('reconstruction_node', 'calibration_node'):
        assert nodes[name].end() == 0
    client.statuses.clear()
    graph.calibration_node(calibrated, **parameters)
    graph.start('reconstruction_node')
    told('the drift watch has given an alarm')
    assert not (calibrated / LEARNED_SHAPES).exists()


def test_no_exposure_is_lost_while_shapes_are_learned(rig, graph, calibrated):
    client = graph.client
    points = client.listen('reconstruction/points_with_covariance')
    graph.whole_chain(calibrated, learn_bodies=rig.bodies, learn_time=2.0)
    client.stream(rig.stream([rig.healthy]), RATE_HZ, lambda: len(points))
    client.wait_for_diagnostics(
        'calibration_node', lambda s: s.message.startswith('shapes of'), 'shapes', 'shapes'
    )
    published = client.published
    client.end_stream()
    client.wait_until(lambda: len(points) == published, what='points of all exposures')
    numbers = [m.frame_number for m in points]
    assert numbers == list(range(10**6, 10**6 + published)) and published > 2 * RATE_HZ
    assert read_learned_shapes(calibrated).exposures == pytest.approx(2 * RATE_HZ, abs=2)


def test_node_ends_while_it_heals(rig, graph, learned):
    node = graph.calibration_node(learned)
    graph.client.heal(seconds=60.0)
    assert node.end() == 0
    assert 'Traceback' not in node.log
