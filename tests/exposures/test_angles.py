# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Angle of the C-arm in an exposure: the last joint state before it, by stamp."""

import math
import random

import numpy as np
import pytest

from fluoro_calib_ros.exposures.angles import AngleOptions, AngleTrack, joints_by_fluoroscope
from fluoro_calib_ros.exposures.frame import Frame

S = 10**9


def track(states, **options):
    out = AngleTrack(0.5, **options)
    for stamp_ns, angle in states:
        out.add(stamp_ns, angle)
    return out


def test_angle_is_that_of_the_last_state_at_or_before_the_exposure():
    found = track([(S, 0.1), (2 * S, 0.2), (3 * S, 0.3)])
    assert found.at(2 * S) == found.at(2 * S + S // 4) == pytest.approx(0.2, abs=1e-8)
    assert found.at(3 * S - 1) is None  # the state of 2 s is older than 0.5 s
    assert found.at(S - 1) is None
    assert found.at(3 * S + S // 2) == pytest.approx(0.3, abs=1e-8)
    assert found.at(3 * S + S // 2 + 1) is None


def test_angle_does_not_depend_on_the_order_in_which_states_arrive():
    states = [(k * S // 50, 0.01 * k) for k in range(200)]
    shuffled = list(states)
    random.Random(1).shuffle(shuffled)
    times = [k * S // 170 for k in range(700)]
    one, other = track(states), track(shuffled, capacity=None)
    assert [one.at(t) for t in times] == [other.at(t) for t in times]


def test_newest_states_are_kept_and_give_the_same_angles():
    states = [(k * S // 100, 0.001 * k) for k in range(1, 5001)]
    short = track(states, capacity=100)
    complete = track(states, capacity=None)
    last = states[-1][0]
    assert short.at(last) == complete.at(last) == pytest.approx(5.0)
    assert short.at(last - S // 5) == complete.at(last - S // 5)
    assert complete.at(S) is not None and short.at(S) is None


@pytest.mark.parametrize(('capacity', 'back_s'), [(10, 2), (10, 9), (10_000, 2), (10_000, 900)])
def test_clock_that_is_set_back_begins_anew(capacity, back_s):
    """Between the new states lie those of the former run, which no longer count."""
    found = track([(k * S // 4, 0.1) for k in range(4000)], capacity=capacity)
    begin_ns = (1000 - back_s) * S
    for k in range(4):
        found.add(begin_ns + k * S // 2, 0.5)
        assert found.at(begin_ns + k * S // 2 + S // 3) == pytest.approx(0.5)
    assert found.late == 0


def test_state_out_of_order_is_used_live():
    found = track([(S, 0.1), (2 * S, 0.2), (S + S // 2, 0.3)])
    assert found.at(2 * S - 1) == pytest.approx(0.3) and found.at(2 * S) == pytest.approx(0.2)


def test_recorded_states_are_all_kept_when_the_clock_is_set_back():
    found = track([(10 * S, 0.1), (20 * S, 0.2), (S, 0.3)], capacity=None)
    assert [found.at(k * S) for k in (1, 10, 20)] == pytest.approx([0.3, 0.1, 0.2])


@pytest.mark.parametrize('position', [math.nan, math.inf, 90.0, -90.0])
def test_position_that_is_no_angle_in_radians_is_unknown(position):
    found = track([(S, 0.1), (2 * S, position)])
    assert found.at(2 * S) is None
    assert 'not an angle between -12.57 and 12.57 rad' in found.doubt(2 * S)


def test_angle_is_that_of_a_frame_to_the_last_bit():
    angle = 0.123456789012345
    frame = Frame('a', 1, np.zeros(1), np.zeros((1, 2)), (9, 9), angle=angle)
    assert track([(S, angle)]).at(S) == frame.angle != angle


def test_doubt_says_why_an_angle_is_unknown():
    assert 'no state yet' in track([]).doubt(S)
    found = track([(S, 0.1)])
    assert 'at or before' in found.doubt(0)
    assert '2.000 s older than the exposure, more than angle_max_age, 0.5 s' in found.doubt(3 * S)
    assert found.doubt(S) == ''


def test_states_that_come_after_their_exposure_are_counted():
    found = track([(S, 0.1)])
    assert found.at(2 * S - S // 2) == pytest.approx(0.1)
    found.add(S + 1, 0.2)
    found.add(2 * S, 0.3)
    assert found.late == 1


def test_joints_are_given_for_all_fluoroscopes_or_for_each():
    assert AngleOptions().joints(['a', 'b']) == {}
    assert AngleOptions('carm').joints(['a', 'b']) == {'a': 'carm', 'b': 'carm'}
    each = AngleOptions('a:frontal, b:robot::lateral')
    assert each.joints(['a', 'b']) == {'a': 'frontal', 'b': 'robot::lateral'}
    assert AngleOptions('b:lateral').joints(['a', 'b']) == {'b': 'lateral'}


@pytest.mark.parametrize(
    'text', ['frontal,lateral', 'a:', ':frontal', 'a:frontal,lateral', 'a:x,a:y']
)
def test_malformed_joints_are_refused(text):
    with pytest.raises(ValueError, match=r'angle_joint: .* like a:joint,b:joint'):
        joints_by_fluoroscope(text)


def test_joint_of_another_fluoroscope_is_refused():
    with pytest.raises(ValueError, match="no fluoroscope 'c', only a, b"):
        AngleOptions('c:frontal').tracks(['a', 'b'])


def test_other_joints_and_states_without_positions_are_ignored():
    angles = AngleOptions('a:frontal,b:lateral').tracks(['a', 'b', 'c'])
    angles.add(S, ['table', 'lateral'], [9.0, 0.4])
    angles.add(S + 1, ['frontal', 'lateral'], [])
    angles.add(S + 2, ['lateral', 'frontal'], [0.6])
    assert angles.at('b', 2 * S - S // 2) == pytest.approx(0.4)
    assert angles.at('a', 2 * S) is None and angles.at('c', 2 * S) is None
    assert angles.doubt('a', 2 * S) == 'joint frontal: it has no state yet'
    assert angles.doubt('c', 2 * S) == 'parameter angle_joint names no joint'


def test_state_is_late_after_any_exposure_that_needed_it():
    """Also if an earlier exposure, of another fluoroscope, was asked for in the meantime."""
    found = track([(S, 0.1)])
    found.at(S + 10)
    found.at(S + 5)
    found.add(S + 7, 0.2)
    assert found.late == 1
