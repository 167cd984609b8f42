# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Counts, decisions and outputs of parts of the nodes, on plain objects without a graph."""

import threading
from collections import Counter
from dataclasses import replace
from types import SimpleNamespace as Fake

import body_views
import numpy as np
import pytest
import rigs
from rclpy.duration import Duration
from rclpy.qos import (
    DurabilityPolicy,
    HistoryPolicy,
    LivelinessPolicy,
    QoSProfile,
    ReliabilityPolicy,
)
from rclpy.topic_endpoint_info import TopicEndpointInfo
from rclpy.type_hash import TypeHash
from sensor_msgs.msg import Image
from std_msgs.msg import Header

from fluoro_calib_ros.checks.drift_charts import DriftOptions
from fluoro_calib_ros.errors import DataError
from fluoro_calib_ros.exposures.angles import AngleOptions
from fluoro_calib_ros.nodes import (
    calibration_settings,
    healing_services,
    player_node,
)
from fluoro_calib_ros.nodes.angle_input import AngleInput, beyond_text
from fluoro_calib_ros.nodes.bridge_node import Admission
from fluoro_calib_ros.nodes.calibration_node import CalibrationNode
from fluoro_calib_ros.nodes.calibration_settings import check_folders
from fluoro_calib_ros.nodes.dashboard import state as session_state
from fluoro_calib_ros.nodes.dashboard import terminal
from fluoro_calib_ros.nodes.dashboard.state import (
    FluoroscopeState,
    NodeState,
    RateMeter,
    SessionState,
)
from fluoro_calib_ros.nodes.drift_monitor import DriftMonitor, DriftParameters
from fluoro_calib_ros.nodes.frame_validation import (
    FrameValidator,
    TooLarge,
    validate_corrected,
    with_limit,
)
from fluoro_calib_ros.nodes.image_stream import ExposureQueue, ImageStream
from fluoro_calib_ros.nodes.messages.rig_orientation import message_from_orientation
from fluoro_calib_ros.nodes.reconstruction_output import PointsCounter
from fluoro_calib_ros.nodes.recorder_node import qos_document
from fluoro_calib_ros.nodes.rig_input import RigInput
from fluoro_calib_ros.nodes.runtime import diagnostics
from fluoro_calib_ros.nodes.runtime.diagnostics import (
    WARN,
    RateLimitedLogger,
    RefusalLog,
    Refused,
)
from fluoro_calib_ros.nodes.runtime.topics import adapted_qos, type_hash_text
from fluoro_calib_ros.reconstruction.intersection import (
    FAILED,
    OUTSIDE,
    REJECTED,
    SINGLE_VIEW,
)


class Log:
    """A logger that stores messages by level."""

    def __init__(self):
        self.lines = Counter()
        self.texts = []

    def __getattr__(self, level):
        def write(text):
            self.lines[level] += 1
            self.texts.append(str(text))

        return write


def refusals():
    return RefusalLog('frame', RateLimitedLogger(Log()))


def test_log_takes_a_burst_then_a_message_a_second_and_counts_the_others(monkeypatch):
    now = 0.0
    monkeypatch.setattr(diagnostics, 'time', Fake(monotonic=lambda: now))
    log = Log()
    limited = RateLimitedLogger(log)
    for _ in range(25):
        limited.warning('late')
    assert log.lines == {'warning': 20}
    now = 0.9
    limited.error('lost')
    assert log.lines == {'warning': 20}
    now = 1.1
    limited.error('lost')
    limited.error('lost')
    assert log.lines == {'warning': 20, 'error': 1} and '(6 similar' in log.texts[-1]
    now = 1000.0  # a long silence allows no more than one burst
    for _ in range(25):
        limited.warning('late')
    assert log.lines == {'warning': 40, 'error': 1}
    assert '(1 similar' in log.texts[21] and log.texts[22] == 'late'


# ---- dashboard


def test_rate_is_of_the_readings_of_a_window():
    meter = RateMeter()
    assert np.isnan(meter.hz)
    meter.add(0.0, 0)
    assert np.isnan(meter.hz)
    meter.add(session_state.RATE_WINDOW_S, 50)  # just within the window
    assert meter.hz == 50 / session_state.RATE_WINDOW_S
    meter.add(session_state.RATE_WINDOW_S + 1, 90)
    assert meter.hz == 40.0
    uneven = RateMeter()
    for seconds, count in ((0.0, 0), (1.0, 10), (2.0, 50)):
        uneven.add(seconds, count)
    assert uneven.hz == 25.0
    still = RateMeter()
    for _ in range(2):
        still.add(3.0, 7)
    assert np.isnan(still.hz)


def cells(table):
    return [[str(cell) for cell in column.cells] for column in table.columns]


def test_tables_of_the_dashboard_have_their_columns():
    names, levels, texts = cells(
        terminal._nodes(SessionState(nodes=(NodeState('n', 'warn', 'm'),)))
    )
    assert (names, levels, texts) == (['n'], ['warn'], ['m'])
    assert cells(terminal._nodes(SessionState())) == [['none'], [''], ['']]
    state = SessionState(
        points_hz=30.0,
        points_latency_ms=(1.5, 2.5),
        drift_level='warn',
        drift='a drifts',
        verdict='fail',
        findings=('one', 'two'),
    )
    labels, values = cells(terminal._results(state))
    assert labels == ['points in space', 'orientation', 'drift', 'verdict', '', '']
    assert values == [
        '30.0 a second  1.50 ms (99 %: 2.50)',
        'none yet',
        'a drifts',
        'fail',
        'one',
        'two',
    ]
    one = FluoroscopeState('a', 'collecting', corrected_hz=60.0, latency_p50_ms=0.5)
    one = replace(one, latency_p99_ms=0.75, exposures=3, rejected=2, frames_hz=59.0)
    labels, values = cells(terminal._fluoroscopes(SessionState(fluoroscopes=(one,))))
    found = dict(zip(labels, values))
    assert found['corrected'] == '60.0 a second  0.50 ms (99 %: 0.75)'
    assert (found['state'], found['exposures']) == ('collecting', '3')
    assert found['frames'] == '59.0 a second, 2 refused'
    silent = replace(one, state='', corrected_hz=np.nan, rejected=0)
    found = dict(zip(*cells(terminal._fluoroscopes(SessionState(fluoroscopes=(silent,))))))
    assert (found['exposures'], found['corrected'], found['state']) == ('-', '-', '-')


# ---- validation of frames


CALIBRATION = Fake(image_size=(64, 48), frame_id='a_optical')


def observed(ids=(3, 5), **changes):
    values = {
        'target_id': np.array(ids, np.uint32).tobytes(),
        'u': np.array([1.0, 2]),
        'v': np.array([3.0, 4]),
        'sigma': np.array([0.2, 0.3]),
        'image_size': (64, 48),
        'frame_id': 'a_optical',
        'frame_number': 9,
    }
    return Fake(**{**values, **changes})


@pytest.mark.parametrize(
    ('changes', 'kind'),
    [
        ({'u': np.zeros(3)}, 'lengths'),
        ({'v': np.zeros(1)}, 'lengths'),
        ({'sigma': np.ones(1)}, 'lengths'),
        ({'image_size': (48, 64)}, 'image size'),
        ({'frame_id': 'b_optical'}, 'frame id'),
        ({'ids': (3, 3)}, 'repeated target'),
        ({'sigma': np.array([0.2, 0.0])}, 'sigma'),
        ({'sigma': np.array([0.2, np.inf])}, 'sigma'),
        ({'sigma': np.array([np.nan, 0.2])}, 'sigma'),
    ],
)
def test_frame_that_cannot_be_corrected_is_refused_by_kind(changes, kind):
    with pytest.raises(Refused) as error:
        FrameValidator('a').validated_arrays(observed(**changes), CALIBRATION)
    assert error.value.kind == kind and 'frame 9' in str(error.value)


def test_frame_that_can_be_corrected_is_passed_on():
    validator = FrameValidator('a')
    given = observed()
    found = validator.validated_arrays(given, CALIBRATION)
    assert found == (given.u, given.v, given.sigma)
    assert validator.validated_arrays(observed(sigma=np.zeros(0)), CALIBRATION)[2] is None
    for unnamed in (observed(frame_id=''), observed()):
        assert validator.validated_arrays(unnamed, CALIBRATION)
    assert validator.validated_arrays(observed(), replace_id('')) is not None
    # Changed ids are checked again.
    with pytest.raises(Refused):
        validator.validated_arrays(observed((5, 5)), CALIBRATION)


def replace_id(frame_id):
    return Fake(image_size=(64, 48), frame_id=frame_id)


def corrected(**changes):
    values = {
        'u': np.zeros(2),
        'v': np.zeros(2),
        'sigma': np.array([0.2, np.nan]),
        'correction_sd': np.array([0.0, np.nan]),
        'status': np.array([0, 2]),
        'target_id': np.array([4, 6]),
        'frame_number': 7,
    }
    return Fake(**{**values, **changes})


@pytest.mark.parametrize(
    ('changes', 'kind'),
    [
        ({}, None),
        ({'v': np.zeros(3)}, 'lengths'),
        ({'status': np.zeros(1)}, 'lengths'),
        ({'target_id': np.array([4, 4])}, 'repeated target'),
        ({'sigma': np.array([0.2, 0.0])}, 'sigma'),
        ({'sigma': np.array([0.2, np.inf])}, 'sigma'),
        ({'correction_sd': np.array([0.2, -0.1])}, 'sigma'),
        ({'correction_sd': np.array([0.2, np.inf])}, 'sigma'),
    ],
)
def test_corrected_frame_is_validated(changes, kind):
    if kind is None:
        validate_corrected('a', corrected())
        return
    with pytest.raises(Refused) as error:
        validate_corrected('a', corrected(**changes))
    assert error.value.kind == kind
    if kind in ('sigma', 'repeated target'):
        assert f'target {changes.get("target_id", [6])[0]} ' in str(error.value)


def test_points_of_a_frame_are_limited_by_number():
    decode = with_limit(lambda data: Fake(u=data), 3)
    assert decode([1, 2, 3]).u == [1, 2, 3]
    with pytest.raises(TooLarge):
        decode([1, 2, 3, 4])


# ---- angles of the C-arm


def angles():
    log = Log()
    made = AngleInput(AngleOptions('a:carm'), ['a', 'b'], RateLimitedLogger(log))
    made._on_state((10**9, ['carm'], [0.1]), {})
    made._on_state((101 * 10**7, ['carm'], [0.3]), {})
    return made, log


def test_parts_that_need_the_angle_of_a_frame_count_it_once():
    made, _ = angles()
    part = Fake(add=lambda name, frame, angle: angle())
    node = Fake(
        settings=Fake(angles=AngleOptions('a:carm')),
        _angles=made,
        _exposures=part,
        _healing=part,
        _learning=part,
    )
    CalibrationNode._on_frame(node, 'a', Fake(sec=99, nanosec=0), {})
    assert made.values('a')['frames without angle'] == 1


def test_angles_are_given_counted_and_doubted_once():
    made, log = angles()
    assert made.of_frame('a', 1005 * 10**6, needed=True) == pytest.approx(0.1)
    values = made.values('a')
    assert float(values['angle [deg]']) == pytest.approx(np.degrees(0.1), abs=5e-4)
    assert (values['joint states received'], values['frames without angle']) == (2, 0)
    assert made.values('b') == {} and made.health('a', {}) is None
    for _ in range(3):
        assert made.of_frame('a', 99 * 10**9, needed=True) is None
    assert made.of_frame('a', 99 * 10**9, needed=False) is None
    assert made.values('a')['frames without angle'] == 3 and made.values('a')['angle [deg]'] == ''
    assert log.lines['warning'] == 1
    found = made.health('a', {})
    assert found.level == WARN and made.health('a', {}) is None
    assert 'joint carm' in found.message and '97.990 s older' in found.message
    made.of_frame('b', 1, needed=True)
    assert made.values('b')['frames without angle'] == 1
    assert made.health('b', {'joint_states': 'no match'}).message == 'no match'
    made.of_frame('b', 2, needed=True)
    assert 'names no joint' in made.health('b', {}).message
    made.of_frame('a', 1005 * 10**6, needed=True)
    made.of_frame('a', 99 * 10**9, needed=True)
    assert log.lines['warning'] == 3  # reported again after the angle was known in between


def test_faults_of_joint_states_are_not_those_of_the_stream():
    made, _ = angles()
    told = []
    names = ('undecodable', 'callback_error', 'reader_error', 'too_large', 'overrun')
    given = Fake(**{n: lambda *words, n=n: told.append((n, *words)) for n in names})
    guarded = made._faults(given)
    guarded.undecodable('joint_states')
    guarded.too_large('joint_states', 5)
    guarded.callback_error('joint_states', KeyError())
    assert made.values('a')['joint states refused'] == 3 and not told
    assert guarded.overrun is None
    guarded.reader_error('the thread')
    assert told == [('reader_error', 'the thread')]


def test_nearest_calibrated_angle_is_round_the_circle():
    text = beyond_text(np.deg2rad(175.0), np.deg2rad([0.0, 90, -170]))
    assert '175.0 degrees' in text and 'the nearest is -170.0' in text
    assert 'the nearest is 80.0' in beyond_text(np.deg2rad(100.0), np.deg2rad([0.0, 80, -170]))


# ---- calibrations that arrive


# ---- captures and jobs


def frame(name, number=1):
    return replace(rigs.exposures()['a'][0], fluoroscope=name, number=number)


def test_folders_below_the_calibrations_are_counted(tmp_path):
    for name in ('x', 'y'):
        (tmp_path / name).mkdir()
    check_folders(tmp_path / 'z', tmp_path, 3)
    with pytest.raises(DataError):
        check_folders(tmp_path / 'z', tmp_path, 2)
    with pytest.raises(DataError):
        check_folders(tmp_path / 'z' / 'deep', tmp_path, 3)
    check_folders(tmp_path / 'x', tmp_path, 0)
    check_folders(tmp_path.parent / 'elsewhere', tmp_path, 0)


def test_default_folder_follows_the_namespace(monkeypatch):
    monkeypatch.setenv('ROS_HOME', '/ros')
    found = calibration_settings.default_calibration_directory('/lab/left/')
    assert str(found) == '/ros/fluoro_calib/lab/left'


# ---- healing


def collection(monkeypatch, most=3, **options):
    monkeypatch.setattr(healing_services, 'MAX_FRAMES', most)
    monkeypatch.setattr(healing_services, 'frame_from_observed', lambda seen, name, angle: seen)
    bodies = [Fake(target_id=np.array([5, 2])), Fake(target_id=np.array([40]))]
    calibrations = {'a': Fake(image_size=(1024, 1024))}
    return healing_services.MarkerCollection(bodies, calibrations, **options)


def test_collection_keeps_the_markers_of_bodies(monkeypatch):
    found = collection(monkeypatch)
    uv = np.arange(8.0).reshape(4, 2)
    shown = replace(
        frame('a'), target_id=np.array([2, 3, 40, 77]), uv=uv, sigma=np.array([1.0, 2, 3, 4])
    )
    found.add('a', shown, None)
    found.add('b', shown, None)
    (kept,) = found.frames['a']
    assert kept.target_id.tolist() == [2, 40] and kept.sigma.tolist() == [1, 3]
    assert kept.uv.tolist() == [[0, 1], [4, 5]] and found.count == 1
    found.add('a', replace(shown, image_size=(9, 9)), None)
    assert found.count == 1 and len(found.refused) == 1
    for _ in range(5):
        found.add('a', replace(shown, sigma=None), None)
    assert found.count == 3 and found.frames['a'][-1].sigma is None
    found.finish()
    found.finish()
    del found.frames['a'][:]
    found.add('a', shown, None)
    assert found.count == 0


def test_window_has_the_frames_of_a_time_in_which_markers_are_seen(monkeypatch):
    found = collection(monkeypatch, most=100, seconds=1.0)
    other, shown = (
        replace(frame('a'), target_id=np.array([target]), uv=np.zeros((1, 2)), sigma=None)
        for target in (3, 40)
    )
    for stamp_s, one in ((0, other), (1, shown), (1.5, shown), (1.7, other), (9, shown)):
        found.add('a', replace(one, stamp_ns=int(1e9 * stamp_s)), None)
    assert found.count == 3 and found.seen_s == 0.5 and not found.is_complete
    for stamp_s in (9.4, 9.8, 10.0):  # the second frame completes the window
        found.add('a', replace(shown, stamp_ns=int(1e9 * stamp_s)), None)
    assert found.count == 5 and found.is_complete
    assert found.frames['a'][-1].stamp_ns == int(1e9 * 9.8)


# ---- drift


def test_parameters_that_only_ask_make_no_new_watches():
    options = DriftOptions()
    monitor = DriftMonitor('ab', DriftParameters(), options, Log())
    assert not monitor.use(DriftParameters(collect_on_drift=True, heal_on_drift=True), options)
    changed = DriftParameters(collect_on_drift=True, heal_on_drift=True, drift_rate=5.0)
    assert monitor.use(changed, options)
    later = DriftOptions(warn_interval_h=1.0)
    assert monitor.use(changed, later) and not monitor.use(changed, later)
    assert monitor.make_watch(None) is None  # image sizes are unknown
    assert monitor.use(DriftParameters(drift_watch=False), options)
    monitor.newest = None, 'o', 7
    assert monitor.publish_state() == []


# ---- points and images


def test_points_are_counted_by_status():
    counter = PointsCounter()
    for status in ([0, 0, OUTSIDE], [REJECTED, REJECTED, FAILED, SINGLE_VIEW, SINGLE_VIEW, 0]):
        counter.add(Fake(status=np.array(status)))
    counter.add(Fake(status=np.zeros(4, int)))
    assert counter.values() == {
        'points': 13,
        'points outside': 1,
        'points rejected': 2,
        'points failed': 1,
        'points in a single view': 2,
    }


def test_stream_of_images_measures_its_rate_and_what_was_shed():
    stream = ImageStream('a', refusals(), topic='a/image_raw')
    found = Fake(reason='', followed=True, note='', seconds=0.25)
    for each in (found, found, Fake(reason='dark', followed=False, note='', seconds=0.5)):
        stream.count(Image(), each)
    assert (stream.extracted, stream.followed, stream.without, stream.seconds) == (2, 2, 1, 1.0)
    stream.shed = 4
    then, *_ = stream._before
    stream._before = (then - 10, 1, 1)
    stream.measure()
    assert stream.rate_hz == pytest.approx(0.2, rel=0.01) and stream.shed_now == 3
    stream.measure()
    assert stream.rate_hz == 0 and stream.shed_now == 0


def test_image_of_another_size_or_frame_is_refused():
    stream = ImageStream('a', refusals(), topic='a/image_raw')
    shape = {'now': (4, 6)}
    stream.converter = Fake(
        decoded=lambda message: (np.zeros(shape['now']), 'mono8'),
        refusal=lambda kind, message, text: Refused(kind, text),
    )
    message = Image(header=Header(frame_id='x'))
    for _ in range(2):
        assert stream.decoded(message).shape == (4, 6)
    shape['now'] = (6, 4)
    with pytest.raises(Refused) as error:
        stream.decoded(message)
    assert error.value.kind == 'image size' and '4 x 6 px' in str(error.value)
    with pytest.raises(Refused) as error:
        stream.decoded(Image(header=Header(frame_id='y')))
    assert error.value.kind == 'frame id'


def test_number_that_is_used_again_loses_the_one_before():
    queue = ExposureQueue('ab', 5)
    assert queue.put('a', 3, 'old') == [] and queue.put('a', 3, 'new') == ['a']
    assert queue.waiting('a') == 1 and queue.get('a') == (3, {'a': 'new'})


# ---- orientations of the rig


def rig_input(*ids):
    made = RigInput(('a', 'b', 'c'), 4.0, None, refusals=None, logger=None)
    made._rigs = {one: f'rig {number}' for number, one in enumerate(ids)}
    return made


def test_rig_is_the_newest_with_the_calibrations_of_all_views():
    made = rig_input(('a1', 'b1', 'c1'), ('a2', 'b1', 'c1'), ('a2', 'b2', 'c1'))
    assert made.newest == 'rig 2'
    assert made.rig_of({'a': 'a1', 'b': 'b1', 'c': 'c1'}) == 'rig 0'
    assert made.rig_of({'b': 'b1', 'c': 'c1'}) == 'rig 1'
    assert made.rig_of({'a': 'a2'}) == 'rig 2'
    assert made.rig_of({'a': 'a1', 'b': 'b2'}) is None
    assert made.rig_of({'a': 'a9', 'b': 'b1', 'c': 'c1'}) is None
    assert rig_input().newest is None and rig_input().camera_of('a') == ('', None)


def test_orientation_that_is_received_again_keeps_its_watch():
    """A new watch would take a drift for the reference, and end its alarm."""
    watches = iter(['first', 'second', 'third'])
    drift = Fake(make_watch=lambda _: next(watches))
    logger = Fake(info=lambda _: None, warning=lambda _: None)
    made = RigInput(('a', 'b'), 4.0, drift, refusals=None, logger=logger)
    given = body_views.orientation()
    healed = replace(given, position_mm=given.position_mm + 0.1)
    other = replace(given, calibration_ids=('a2', 'b2'))
    messages = [message_from_orientation(one) for one in (given, other, healed)]
    assert made.add(messages[0]) and made.add(messages[1]) and made.add(messages[0])
    assert made.newest.watch == 'first' and len(made._rigs) == 2
    assert made.add(messages[2]) and made.newest.watch == 'third'


# ---- simulator, player, recorder, bridge


def test_pace_of_a_player_stops_goes_on_and_changes(monkeypatch):
    now = {'s': 100.0}
    monkeypatch.setattr(player_node, 'time', Fake(monotonic=lambda: now['s']))
    pace = player_node.Pace(2.0)
    now['s'] += 3
    assert pace.position_s == 6.0 and not pace.paused
    pace.pause()
    now['s'] += 5
    assert pace.position_s == 6.0 and pace.paused
    pace.change(0.5)
    now['s'] += 1
    assert pace.position_s == 6.0
    pace.resume()
    now['s'] += 4
    assert pace.position_s == 8.0
    pace.change(4.0)
    now['s'] += 1
    assert pace.position_s == 12.0
    waited = []

    def wait(seconds):
        waited.append(seconds)
        now['s'] += seconds

    monkeypatch.setattr(pace._changed, 'wait', wait)
    assert pace.wait(13.0) is False and waited == [pytest.approx(0.25)]
    pace.end()
    assert pace.wait(2.0) is True and pace.wait(99.0) is True


def test_steps_are_made_in_their_pause_only():
    pace = player_node.Pace(1.0, paused=True)
    assert pace.position_s == 0
    pace.step()
    assert pace.wait(5.0) is False and pace.position_s == 5
    pace.step()
    pace.resume()  # before the step was made
    assert pace.wait(5.0) is False
    pace.pause()
    played = []
    waiting = threading.Thread(target=lambda: played.append(pace.wait(5.0)))
    waiting.start()
    pace.end()
    waiting.join()
    assert played == [True]


def publisher(reliable=True, latched=True, depth=5):
    profile = QoSProfile(
        reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
        depth=depth,
        history=HistoryPolicy.KEEP_LAST,
        liveliness=LivelinessPolicy.AUTOMATIC,
        deadline=Duration(nanoseconds=2_500_000_000),
        liveliness_lease_duration=Duration(nanoseconds=7),
        avoid_ros_namespace_conventions=False,
    )
    return TopicEndpointInfo(qos_profile=profile)


@pytest.mark.parametrize(
    ('publishers', 'reliable', 'latched'),
    [
        ([publisher(), publisher()], True, True),
        ([publisher(), publisher(reliable=False)], False, True),
        ([publisher(), publisher(latched=False)], True, False),
    ],
)
def test_recorder_asks_for_what_all_publishers_offer(publishers, reliable, latched):
    found = adapted_qos(publishers, 7)
    assert found.depth == 7
    assert (found.reliability == ReliabilityPolicy.RELIABLE) is reliable
    assert (found.durability == DurabilityPolicy.TRANSIENT_LOCAL) is latched


def test_offered_profile_is_written_as_it_is():
    found = qos_document(publisher(latched=False).qos_profile)
    assert found['deadline'] == {'sec': 2, 'nsec': 500_000_000}
    assert found['liveliness_lease_duration'] == {'sec': 0, 'nsec': 7}
    assert (found['reliability'], found['durability']) == ('reliable', 'volatile')
    assert (found['history'], found['liveliness'], found['depth']) == ('keep_last', 'automatic', 5)


@pytest.mark.parametrize(
    ('version', 'value', 'text'),
    [(1, [0, 171], 'RIHS01_00ab'), (2, [1], ''), (1, [0, 0], '')],
)
def test_hash_of_a_type_is_told_where_it_is_known(version, value, text):
    endpoint = TopicEndpointInfo(topic_type_hash=TypeHash(version, bytes(value)))
    assert type_hash_text(endpoint) == text


@pytest.mark.parametrize(
    ('request_line', 'origin', 'admitted'),
    [
        ('GET /?token=secret HTTP/1.1', '', True),
        ('GET /?token=secret HTTP/1.1', 'https://here', True),
        ('GET /?token=secret HTTP/1.1', 'https://there', False),
        ('GET /?token=secret HTTP/1.1', 'HTTP://here', False),
        ('GET /?token=secret HTTP/1.1', 'null', False),
        ('GET /?token=secret HTTP/1.1', 'file://x', True),
        ('GET /?token=other HTTP/1.1', '', False),
        ('GET / HTTP/1.1', '', False),
        ('POST /?token=secret HTTP/1.1', '', False),
        ('GET /?token=secret', '', False),
    ],
)
def test_bridge_admits_by_token_and_origin(request_line, origin, admitted):
    lines = [request_line, 'Host: x', *([f'Origin: {origin}'] if origin else []), '', '']
    refusal = Admission('secret', ['https://here']).refusal('\r\n'.join(lines).encode())
    assert (refusal == '') is admitted
