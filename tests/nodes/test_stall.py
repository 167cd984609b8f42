# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""A stream that stops, and faults that have ended."""

from fluoro_calib_ros.nodes.runtime.diagnostics import RECENT_S, RecentCounts, StallDetector


class Clock:
    """A clock that is set manually."""

    def __init__(self):
        self.time = 100.0

    def __call__(self):
        return self.time


def messages(counts):
    """Return the messages of a detector that is queried about its counts once a second."""
    clock = Clock()
    detector = StallDetector(clock)
    said = []
    for count in counts:
        clock.time += 1.0
        said.append(detector.message(count))
    return said


def test_stop_of_a_stream_is_told_within_two_seconds_and_its_return_too():
    said = messages([250, 500, 500, 500, 750])
    assert said[:2] == ['', '']
    assert said[2] == 'no frame for 1 s; before, there were 250 a second'
    assert said[3].startswith('no frame for 2 s')
    assert said[4] == ''


def test_exposures_taken_one_by_one_are_no_stream():
    assert messages([0, 1, 1, 1, 2, 2]) == [''] * 6


def test_nothing_is_said_before_the_first_frame():
    assert messages([0, 0, 0]) == [''] * 3


def test_counts_that_start_again_are_no_stop():
    assert messages([250, 500, 20, 270])[2:] == ['', '']


def test_what_was_counted_a_minute_ago_is_not_told_any_more():
    clock = Clock()
    recent = RecentCounts(clock)
    assert recent.growth('a', refused=4, unpaired=0) == {'refused': 4, 'unpaired': 0}
    clock.time += RECENT_S / 2
    assert recent.growth('a', refused=9, unpaired=0)['refused'] == 9
    assert recent.growth('b', refused=1) == {'refused': 1}
    clock.time += RECENT_S / 2
    assert recent.growth('a', refused=9, unpaired=2) == {'refused': 5, 'unpaired': 2}
    clock.time += RECENT_S / 2
    assert recent.growth('a', refused=9, unpaired=2)['refused'] == 0
    clock.time += RECENT_S
    assert recent.growth('a', refused=9, unpaired=2) == {'refused': 0, 'unpaired': 0}
    assert recent.growth('a', refused=0)['refused'] == 0  # the node was reset
