# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The view of the dashboard, rendered from plain states."""

import asyncio
from dataclasses import replace
from types import SimpleNamespace as Fake

import pytest
from rclpy.task import Future
from rich.console import Console
from textual.widgets import Static

from fluoro_calib_ros.nodes.dashboard import actions
from fluoro_calib_ros.nodes.dashboard.state import (
    Diagnosis,
    FluoroscopeState,
    NodeState,
    RateMeter,
    SessionState,
    light,
)
from fluoro_calib_ros.nodes.dashboard.terminal import (
    Dashboard,
    _calibration,
    _coverage,
    _duration,
    session_text,
)

STATE = SessionState(
    fluoroscopes=(
        FluoroscopeState('a', 'collecting', 59.9, exposures=9, coverage=0.75, next_pose='6 more'),
        FluoroscopeState('b', 'calibrating', rejected=3, iteration=4, rmse_px=(0.21, 0.22)),
    ),
    nodes=(NodeState('calibration_node', 'ok', 'collecting exposures'),),
)


class Recorded:
    """A session that shows a given state and records requests."""

    def __init__(self, state=STATE):
        self.shown = state
        self.asked = []

    def state(self):
        return self.shown

    def request(self, action):
        self.asked.append(action)


def text_of(renderable):
    console = Console(width=120, record=True, file=open('/dev/null', 'w'))  # noqa: SIM115
    console.print(renderable)
    return console.export_text()


def run(session, scenario):
    async def main():
        app = Dashboard(session)
        async with app.run_test(size=(100, 36)) as pilot:
            await scenario(app, pilot)

    asyncio.run(main())


def test_text_holds_every_part_of_the_state():
    text = text_of(session_text(STATE))
    for part in ('59.9 a second', '75 %', '6 more', '3 refused', 'round 4  RMSE 0.210 0.220 px'):
        assert part in text
    assert 'none on the calibration in use' in text and 'none yet' in text


def test_findings_follow_the_verdict():
    state = replace(STATE, verdict='fail', findings=('the residuals have a trend',))
    text = text_of(session_text(state))
    assert text.index('verdict') < text.index('fail') < text.index('the residuals have a trend')


def test_a_diagnosis_is_shown_with_the_key_that_accepts_it():
    state = replace(STATE, diagnosis=HEALED)
    text = text_of(session_text(state))
    assert text.index('pass, a accepts it') < text.index('fluoroscope b has moved')
    in_use = text_of(session_text(replace(state, orientation_id='healed-1')))
    assert 'accepts it' not in in_use and 'fluoroscope b has moved' in in_use


def test_brackets_are_shown_and_control_characters_are_not():
    message = 'fluoroscopes [a, b]: [/x] \x1b[2Jgone'
    state = replace(STATE, nodes=(NodeState('calibration_node', 'warn', message),))
    text = text_of(session_text(state))
    assert '[a, b]: [/x]' in text and '\x1b[2J' not in text


def test_without_nodes_it_says_for_what_it_waits():
    assert 'waiting for a calibration node' in text_of(session_text(SessionState()))


def test_keys_ask_the_session():
    session = Recorded()

    async def scenario(_, pilot):
        await pilot.press('p', 'c', 'f', 'o', 'h', 'a', 'x')

    run(session, scenario)
    asked = [
        'capture',
        'calibrate',
        'calibrate_fast',
        'orient',
        'heal',
        'accept_healing',
        'cancel',
    ]
    assert session.asked == asked


def test_reset_needs_a_second_key():
    session = Recorded()

    async def scenario(app, pilot):
        await pilot.press('r')
        assert not session.asked
        assert 'press r again' in str(app.query_one('#log', Static).render())
        await pilot.press('r')

    run(session, scenario)
    assert session.asked == ['reset']


def test_a_key_confirms_only_what_it_asked_for():
    session = Recorded()

    async def scenario(app, pilot):
        await pilot.press('r', 'b')
        assert not session.asked
        assert 'press b again' in str(app.query_one('#log', Static).render())
        await pilot.press('b')

    run(session, scenario)
    assert session.asked == ['roll_back_healing']


def test_the_view_follows_the_state():
    session = Recorded()

    async def scenario(app, pilot):
        session.shown = replace(STATE, log=('12:00:00  calibrate: a, b calibrated in 3.0 s',))
        app.show()
        await pilot.pause()
        assert 'calibrated in 3.0 s' in str(app.query_one('#log', Static).render())

    run(session, scenario)


def test_rate_is_that_of_the_last_seconds_and_survives_a_restart():
    meter = RateMeter()
    for second in range(10):
        meter.add(second, 100 if second < 4 else 100 + 60 * (second - 3))
    assert meter.hz == pytest.approx(60.0)
    meter.add(10, 0)
    meter.add(11, 30)
    assert meter.hz == pytest.approx(30.0)


def test_rate_survives_a_clock_that_is_set_back():
    meter = RateMeter()
    for second in range(30):
        meter.add(1000.0 + second, 60 * second)
    for second in range(2):
        meter.add(900.0 + second, 60 * (30 + second))
    assert meter.hz == 60


@pytest.mark.parametrize('accepted', [False, True])
def test_calibration_is_cancelled_also_before_it_is_accepted(monkeypatch, accepted):
    sent = Future()
    client = Fake(server_is_ready=lambda: True, send_goal_async=lambda *_, **__: sent)
    monkeypatch.setattr(actions, 'ActionClient', lambda *_: client)
    cancelled = []
    goal = Fake(
        accepted=True,
        cancel_goal_async=lambda: cancelled.append(1),
        get_result_async=lambda: Fake(add_done_callback=lambda _: None),
    )
    lines = []
    requests = actions.Actions(Fake(get_namespace=lambda: '/'), lines.append, lambda **_: None)
    requests.cancel()
    assert 'nothing runs' in lines.pop()
    requests.request('calibrate')
    if accepted:
        sent.set_result(goal)
    requests.cancel()
    if not accepted:
        assert not cancelled
        sent.set_result(goal)
    assert cancelled == [1]


def test_cell_of_a_calibration_has_its_round_or_age_and_residuals():
    none = FluoroscopeState('a', 'calibrated')
    named = replace(none, calibration_id='a-77')
    assert _calibration(none) == 'none'
    assert _calibration(named) == 'a-77'
    full = replace(named, age_s=300.0, rmse_px=(0.25, 0.5))
    assert _calibration(full).split() == ['5', 'min', 'ago', 'RMSE', '0.250', '0.500', 'px']
    running = replace(full, state='calibrating', iteration=3)
    assert _calibration(running).split()[:2] == ['round', '3']
    assert _calibration(replace(running, rmse_px=(float('nan'),) * 2)).split() == ['round', '3']


@pytest.mark.parametrize(
    ('seconds', 'text'),
    [(59, '59 s'), (119, '119 s'), (120, '2 min'), (7200, '2 h'), (172800, '2 d'), (0.4, '0 s')],
)
def test_duration_has_the_largest_unit_of_which_there_are_two(seconds, text):
    assert _duration(seconds) == text


@pytest.mark.parametrize('share', [0.0, 0.3, 1.0])
def test_bar_of_the_coverage_is_as_long_as_it(share):
    text = _coverage(FluoroscopeState('a', coverage=share)).plain
    bar, percent, _ = text.split()
    assert len(bar) == 20 and bar.count('#') == round(20 * share)
    assert int(percent) == round(100 * share)


CALIBRATED = tuple(FluoroscopeState(n, 'calibrated', calibration_id=f'{n}-1') for n in 'ab')
GOOD = NodeState('correction_node', 'ok', 'correcting')
READY = FluoroscopeState('a', 'collecting', ready=True)
HEALED = Diagnosis('pass', ('fluoroscope b has moved',), 'healed-1')


@pytest.mark.parametrize(
    'changes, level, word',
    [
        ({'nodes': ()}, 'error', 'No signal'),
        ({'nodes': (GOOD, NodeState('x', 'error', 'broken'))}, 'error', 'Problem'),
        ({'nodes': (GOOD, NodeState('x', 'silent', 'gone'))}, 'error', 'Problem'),
        ({'job': 'round 3'}, 'busy', 'Calibrating'),
        ({'job': 'healing: 12 frames of markers'}, 'busy', 'Healing'),
        ({'diagnosis': HEALED, 'nodes': (NodeState('x', 'error', 'drift'),)}, 'warn', 'Healed'),
        ({'diagnosis': HEALED, 'orientation_id': 'healed-1'}, 'ok', 'OK'),
        ({'diagnosis': Diagnosis('fail', ('creeps',), 'healed-1')}, 'ok', 'OK'),
        ({'diagnosis': Diagnosis('pass', ('nothing has changed',))}, 'ok', 'OK'),
        ({'verdict': 'fail'}, 'error', 'Do not use'),
        ({'fluoroscopes': (*CALIBRATED, FluoroscopeState('c'))}, 'warn', 'Collecting'),
        ({'fluoroscopes': (READY,)}, 'warn', 'Ready'),
        ({'nodes': (GOOD, NodeState('x', 'warn', 'slow'))}, 'warn', 'Attention'),
        ({'verdict': 'cannot tell'}, 'warn', 'Attention'),
        ({'verdict': 'pass', 'drift': 'no drift detected'}, 'ok', 'OK'),
    ],
)
def test_light_is_the_worst_or_what_is_to_be_done_next(changes, level, word):
    state = replace(SessionState(fluoroscopes=CALIBRATED, nodes=(GOOD,)), **changes)
    shown = light(state)
    assert (shown.level, shown.word) == (level, word)
    assert shown.sentence


@pytest.mark.parametrize(
    'verdict, said', [('', 'no verdict in this session'), ('pass', 'verdict: pass')]
)
def test_a_calibrated_rig_says_whether_it_has_a_verdict(verdict, said):
    state = SessionState(fluoroscopes=CALIBRATED, nodes=(GOOD,), verdict=verdict)
    assert said in light(state).sentence


def test_a_broken_node_comes_before_everything_else():
    broken = NodeState('calibration_node', 'error', 'disk full')
    state = SessionState(
        fluoroscopes=(READY,), nodes=(GOOD, broken), job='round 3', verdict='fail'
    )
    assert light(state).sentence == 'calibration_node: disk full'
