# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Diagnostics as lists of conditions, and guarded services."""

import asyncio
from collections import Counter
from types import MappingProxyType, SimpleNamespace

import pytest
from fluoro_calib_msgs.msg import CalibrationStatus
from fluoro_calib_msgs.srv import Reset
from rclpy.task import Future

from fluoro_calib_ros.exposures.pairing import PairingOptions, exposure_pairer
from fluoro_calib_ros.exposures.stamps import StampTolerance
from fluoro_calib_ros.findings import Finding, Kind
from fluoro_calib_ros.nodes import calibration_output, correcting_node, image_stream
from fluoro_calib_ros.nodes import reconstruction_output as reconstruction
from fluoro_calib_ros.nodes.runtime.conditions import fails, health_of, warns
from fluoro_calib_ros.nodes.runtime.diagnostics import (
    ERROR,
    OK,
    WARN,
    Health,
    RateLimitedLogger,
    RefusalLog,
    Refused,
)
from fluoro_calib_ros.nodes.runtime.lifecycle import Stream, stream_faults
from fluoro_calib_ros.nodes.runtime.services import Requests, ServiceEntry, create_services, within

LOGGER = SimpleNamespace(warning=lambda text: None, error=lambda text: None)


def refusals():
    return RefusalLog('frame', RateLimitedLogger(LOGGER))


def test_the_first_condition_that_holds_is_told_and_the_rest_is_not_asked():
    asked = []

    def condition(name, health):
        def holds(state):
            asked.append((name, state))
            return health

        return holds

    conditions = [
        condition('a', None),
        condition('b', Health(WARN, 'b')),
        condition('c', Health(OK, 'c')),
    ]
    assert health_of(7, conditions) == (WARN, 'b')
    assert asked == [('a', 7), ('b', 7)]
    assert fails(str)('') is None and fails(str)('x') == (ERROR, 'x')
    assert warns(str)('') is None and warns(str)('x') == (WARN, 'x')


@pytest.mark.parametrize(
    'conditions',
    [
        calibration_output.CONDITIONS,
        correcting_node.CONDITIONS,
        image_stream.CONDITIONS,
        reconstruction.CONDITIONS,
    ],
)
def test_lost_messages_come_first_and_the_last_condition_always_holds(conditions):
    lost = refusals()
    lost.fail('a/topic', IndexError('thirteen'))
    level, message = health_of(SimpleNamespace(refusals=lost), conditions)
    assert level == ERROR and message.endswith('topic a/topic: IndexError: thirteen')
    state = SimpleNamespace(collected=SimpleNamespace(status=CalibrationStatus()))
    assert conditions[-1](state).level == OK


def reconstruction_state(stalled, publishers=MappingProxyType({}), **changes):
    streams = {name: SimpleNamespace(stalled=lambda text=text: text) for name, text in stalled}
    values = {
        'node': SimpleNamespace(
            readers=['active'],
            incompatible={},
            has_publisher=lambda topic: True,
            resolve_topic_name=lambda topic: f'/rig/{topic}',
            get_publishers_info_by_topic=lambda topic: publishers.get(topic, ()),
        ),
        'topics': tuple(f'{name}/corrected_observations' for name in streams),
        'refusals': refusals(),
        'streams': streams,
        'rigs': SimpleNamespace(newest='a rig'),
        'pairer': SimpleNamespace(
            stamps=SimpleNamespace(disagreement=lambda: None),
            tolerance=StampTolerance(1),
            silent=frozenset(),
        ),
        'misses': None,
        'timing': None,
        'recent': Counter(),
    }
    return reconstruction.ReconstructionState(**{**values, **changes})


def test_stopped_streams_stand_before_what_else_is_wrong():
    well = reconstruction_state([('a', ''), ('b', '')])
    assert health_of(well, reconstruction.CONDITIONS) == (OK, 'reconstructing')
    stopped = reconstruction_state([('a', 'no frame for 2 s'), ('b', '')])
    assert health_of(stopped, reconstruction.CONDITIONS) == (WARN, 'a: no frame for 2 s')
    missing = Finding(Kind.RAYS_DO_NOT_MEET, 'the rays miss each other')
    both = reconstruction_state([('a', 'no frame for 2 s'), ('b', '')], misses=missing)
    found = health_of(both, reconstruction.CONDITIONS)
    assert found == (ERROR, 'a: no frame for 2 s; the rays miss each other')


def test_fluoroscopes_that_are_not_synchronous_are_a_warning():
    late = Finding(Kind.FRAMES_DELAYED, 'b is late')
    state = reconstruction_state([('a', '')], timing=late)
    assert health_of(state, reconstruction.CONDITIONS) == (WARN, 'b is late')


def test_stamps_that_fit_two_exposures_are_a_warning():
    pairer = exposure_pairer('ab', PairingOptions('stamp', tolerance_s=0.002))
    state = reconstruction_state([('a', '')], pairer=pairer)
    assert health_of(state, reconstruction.CONDITIONS).level == OK
    for stamp_ns in range(10**9, 10**9 + 10**7, 10**6):
        pairer.tolerance.add('a', stamp_ns)
    assert health_of(state, reconstruction.CONDITIONS).level == WARN
    pairer.use(PairingOptions('stamp', tolerance_s=0.0004))
    assert health_of(state, reconstruction.CONDITIONS).level == OK


def test_messages_lost_at_the_input_are_told_before_the_partners_that_they_leave_alone():
    recent = Counter(unpaired=7, overrun=7)
    found = health_of(reconstruction_state([('a', '')], recent=recent), reconstruction.CONDITIONS)
    assert found.level == WARN and found.message.startswith('7 messages lost at the input')
    recent = Counter(unpaired=3)
    found = health_of(reconstruction_state([('a', '')], recent=recent), reconstruction.CONDITIONS)
    assert found.level == WARN and found.message.startswith('3 frames without partner')


def test_two_nodes_that_publish_a_stream_are_named_where_frames_have_no_partner():
    nodes = [
        SimpleNamespace(node_namespace='/rig', node_name=name) for name in ('correction', 'player')
    ]
    publishers = {'/rig/a/corrected_observations': nodes}
    state = reconstruction_state([('a', '')], publishers, recent=Counter(unpaired=3))
    assert health_of(state, reconstruction.CONDITIONS).message.endswith(
        'in the last minute; 2 nodes publish a/corrected_observations (/rig/correction, '
        '/rig/player)'
    )
    well = reconstruction_state([('a', '')], publishers)
    assert health_of(well, reconstruction.CONDITIONS).level == OK


def test_a_damaged_calibration_is_named_until_another_one_is_in_use():
    stream = correcting_node.CorrectedStream('a', refusals())
    node = SimpleNamespace(
        item='frame',
        subject='observations',
        incompatible={},
        readers=['active'],
        has_publisher=lambda topic: False,
        prepared=lambda name: None,
        resolve_topic_name=str,
        get_publishers_info_by_topic=lambda topic: (),
    )
    state = correcting_node.CorrectingState(
        node, ('a/target_observations',), stream.refusals, Counter(), stream
    )
    stream.refused_calibration = 'a.calibration.npz: this is no calibration file'
    assert health_of(state, correcting_node.CONDITIONS) == (
        WARN,
        'no calibration yet: 0 frames were not corrected; a.calibration.npz: this is no '
        'calibration file',
    )
    node.prepared = lambda name: 'calibration'
    assert health_of(state, correcting_node.CONDITIONS).message == 'no publisher of observations'


def test_the_calibration_node_tells_why_frames_have_no_partner_first():
    state = SimpleNamespace(
        node=SimpleNamespace(readers=['active'], incompatible={}, resolve_topic_name=str),
        topics=('a/target_observations',),
        refusals=refusals(),
        recent=Counter(unpaired=7),
        stream=SimpleNamespace(name='a', received=9),
        output=SimpleNamespace(load_fault='', save_fault='', refused={}),
        collected=SimpleNamespace(status=CalibrationStatus()),
        disagreement='frames of a are not numbered',
    )
    state.node.get_publishers_info_by_topic = lambda topic: ()
    found = health_of(state, calibration_output.CONDITIONS)
    assert found == (WARN, 'frames of a are not numbered')
    state.disagreement = ''
    found = health_of(state, calibration_output.CONDITIONS)
    assert found.message.startswith('7 frames without partner')


def test_faults_are_counted_in_the_stream_of_their_topic():
    streams = {name: Stream(name, refusals()) for name in 'ab'}
    faults = stream_faults(streams, print)
    faults.undecodable('a/target_observations')
    faults.too_large('a/target_observations', 10**9)
    faults.callback_error('b/target_observations', IndexError('x'))
    faults.overrun('b/target_observations', 3)
    a, b = streams.values()
    assert (a.received, a.refusals.total, b.received, b.refusals.failures) == (2, 2, 0, 1)
    assert (a.overrun, b.overrun) == (0, 3)
    assert 'max_points' in a.refusals.last_fault
    a.refusals.refuse(Refused('sigma', 'no'))
    assert a.refusals.values(['sigma', 'too large'])['refused: too large'] == 1


def test_a_handler_that_raises_answers_why():
    def plain(request, response):
        raise IndexError('a bug')

    async def awaiting(request, response):
        raise KeyError('another')

    made = []

    def create_service(kind, name, handler, **_):
        made.append(SimpleNamespace(callback=handler, srv_name=f'/rig/{name}'))
        return made[-1]

    node = SimpleNamespace(create_service=create_service, get_logger=lambda: LOGGER)
    table = [ServiceEntry('plain', Reset, plain), ServiceEntry('awaiting', Reset, awaiting)]
    assert create_services(node, table) == made
    answer = made[0].callback(Reset.Request(), Reset.Response(success=True))
    assert not answer.success and answer.message == 'a bug'
    answer = asyncio.run(made[1].callback(Reset.Request(), Reset.Response(success=True)))
    assert not answer.success and 'another' in answer.message


def test_requests_that_wait_are_counted_until_they_fail():
    requests = Requests()
    with pytest.raises(KeyError), requests.one():
        assert requests.waiting == 1
        raise KeyError
    assert requests.waiting == 0


def test_timer_of_a_request_ends_also_if_its_future_raises():
    timers = []
    node = SimpleNamespace(
        create_timer=lambda *_: timers.append('timer') or 'timer', destroy_timer=timers.remove
    )
    failing = Future()
    failing.set_exception(OSError('no'))
    with pytest.raises(OSError, match='no'):
        within(node, 1.0, failing, lambda: None).send(None)
    assert not timers
