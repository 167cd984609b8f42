# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Pairing of three or more fluoroscopes with missing views: exposures, their order, and counts."""

import itertools
from dataclasses import dataclass, replace

import numpy as np
import pytest

from fluoro_calib_ros.exposures.pairing import (
    PairingOptions,
    PartialPairer,
    RecordedPairing,
    exposure_pairer,
)
from fluoro_calib_ros.exposures.stamps import Order, StampTolerance, order_of
from fluoro_calib_ros.findings import Kind

MS = 1_000_000
BY = ('frame_number', 'stamp')


@dataclass(frozen=True)
class Frame:
    """The attributes of a frame that the pairing needs; row: number of its exposure."""

    fluoroscope: str
    number: int
    stamp_ns: int
    row: int


def frame(name, row, first=1, jitter_ns=0):
    return Frame(name, first + row, round(row * 10 * MS) + jitter_ns, row)


def streams(rng, names, count, loss, jitter_ms=0.9):
    """Return {name: [Frame, ...]} of count exposures; each view is lost with probability loss."""
    return {
        name: [
            frame(name, row, 1, int(rng.uniform(0, jitter_ms) * MS))
            for row in range(count)
            if rng.random() >= loss
        ]
        for name in names
    }


def merged(rng, of_each, most_behind=None):
    """Return the frames of all streams in a random order that keeps the order of each stream.

    most_behind: largest lag of a stream, in exposures.
    """
    left = {name: list(of_one) for name, of_one in of_each.items()}
    out = []
    while any(left.values()):
        first = min(of_one[0].row for of_one in left.values() if of_one)
        ready = [
            of_one
            for of_one in left.values()
            if of_one and (most_behind is None or of_one[0].row <= first + most_behind)
        ]
        out.append(ready[rng.integers(len(ready))].pop(0))
    return out


def orders(places):
    """Return all different orders of the letters of a word."""
    return [
        first + rest
        for first in sorted(set(places))
        for rest in orders(places.replace(first, '', 1))
    ] or ['']


def expected(of_each, min_views=2):
    """Return [(row, names)] of the exposures with enough views."""
    rows = {name: {f.row for f in of_one} for name, of_one in of_each.items()}
    there = [
        (row, {name for name, of_one in rows.items() if row in of_one})
        for row in sorted(set().union(*rows.values()))
    ]
    return [(row, names) for row, names in there if len(names) >= min_views]


def paired(pairer, frames, flush=True):
    """Return [(row, names)] of the paired exposures; check that their views belong together."""
    exposures = [e for f in frames for e in pairer.add(f)]
    exposures += pairer.flush() if flush else ()
    assert all(
        len({f.row for f in e.values()}) == 1
        and all(f.fluoroscope == name for name, f in e.items())
        for e in exposures
    )
    return [(next(iter(e.values())).row, set(e)) for e in exposures]


@pytest.mark.parametrize('by', BY)
@pytest.mark.parametrize('lost', list(itertools.product([(), (0,), (1,), (0, 1)], repeat=3)))
def test_every_order_of_arrival_gives_each_exposure_once_and_in_order(by, lost):
    """All orders of two exposures and a complete third one, from three ordered streams."""
    of_each = {
        name: [frame(name, row, 1, k * MS // 2) for row in range(3) if row not in gone]
        for k, (name, gone) in enumerate(zip('abc', lost))
    }
    wanted = expected(of_each)
    places = ''.join(name * len(of_one) for name, of_one in of_each.items())
    for order in orders(places):
        rows = {name: iter(of_one) for name, of_one in of_each.items()}
        pairer = exposure_pairer('abc', RecordedPairing(by).unlimited())
        assert paired(pairer, [next(rows[name]) for name in order], flush=False) == wanted
        assert sum(pairer.unpaired.values()) == len(order) - sum(len(names) for _, names in wanted)
        assert sum(pairer.late.values()) == 0 and pairer.incomplete == sum(
            len(names) < 3 for _, names in wanted
        )


@pytest.mark.parametrize('seed', range(30))
def test_random_losses_jitter_and_delays(seed):
    """Three to five fluoroscopes: frames that lag by less than the patience are awaited."""
    rng = np.random.default_rng(seed)
    names = 'abcde'[: 3 + seed % 3]
    patience = int(rng.integers(24, 40))
    of_each = streams(rng, names, 300, rng.choice([0.0, 0.1, 0.3]))
    frames = merged(rng, of_each, patience // 2)
    pairer = exposure_pairer(names, PairingOptions(BY[seed % 2], 0.001, 64, patience))
    assert paired(pairer, frames) == expected(of_each)
    assert sum(pairer.late.values()) == 0 and pairer.incomplete == sum(
        len(views) < len(names) for _, views in expected(of_each)
    )


@pytest.mark.parametrize('seed', range(30))
def test_delays_beyond_the_patience_only_cost_views(seed):
    """Exposures are in order, each at most once; every frame is used or counted."""
    rng = np.random.default_rng(seed)
    waiting = int(rng.integers(1, 12))
    patience = int(rng.integers(1, 12))
    of_each = streams(rng, 'abc', 300, 0.2)
    frames = merged(rng, of_each)
    whole = dict(expected(of_each))
    pairer = exposure_pairer('abc', PairingOptions(BY[seed % 2], 0.001, waiting, patience))
    found = []
    for f in frames:
        found += [(next(iter(e.values())).row, set(e)) for e in pairer.add(f)]
        assert max(len(queue) for queue in pairer._queues.values()) <= waiting
    found += paired(pairer, [])
    rows = [row for row, _ in found]
    assert rows == sorted(set(rows)) and all(
        len(views) >= 2 and views <= whole[row] for row, views in found
    )
    assert len(frames) == sum(len(views) for _, views in found) + sum(pairer.unpaired.values())
    assert all(pairer.late[name] <= pairer.unpaired[name] for name in 'abc')
    assert pairer.incomplete == sum(len(views) < 3 for _, views in found)


@pytest.mark.parametrize('by', BY)
def test_a_lost_view_is_certain_with_the_next_frame(by):
    pairer = exposure_pairer('abc', PairingOptions(by, 0.001))
    out = [
        [sorted(e) for e in pairer.add(f)]
        for f in (frame('a', 0), frame('b', 0), frame('a', 1), frame('c', 1), frame('b', 1))
    ]
    assert out == [[], [], [], [['a', 'b']], [['a', 'b', 'c']]]


@pytest.mark.parametrize('by', BY)
def test_a_silent_fluoroscope_is_awaited_once_and_resumed(by):
    """The others then continue at once; when it delivers again, its first frame is late."""
    pairer = exposure_pairer('abc', PairingOptions(by, 0.001, 64, 5))
    out = []
    for row in range(20):
        out.append([e for name in 'ab' for e in paired(pairer, [frame(name, row)], flush=False)])
    assert [len(some) for some in out] == [0] * 5 + [6] + [1] * 14 and pairer.silent == {'c'}
    assert (
        paired(pairer, [frame('c', 19)], flush=False) == []
        and pairer.late['c'] == 1
        and not pairer.silent
    )
    for row in range(20, 23):
        assert paired(pairer, [frame(name, row) for name in 'abc'], flush=False) == [
            (row, {'a', 'b', 'c'})
        ]
    assert pairer.incomplete == 20 and pairer.unpaired == {'a': 0, 'b': 0, 'c': 1}


@pytest.mark.parametrize(('row', 'is_awaited'), [(14, False), (15, True)])
def test_a_silent_fluoroscope_is_awaited_if_it_lags_by_no_more_than_the_patience(row, is_awaited):
    pairer = exposure_pairer('abc', PairingOptions(patience=5))
    for other in range(20):
        paired(pairer, [frame(name, other) for name in 'ab'], flush=False)
    assert pairer.silent == {'c'}
    paired(pairer, [frame('c', row)], flush=False)
    assert pairer.silent == (set() if is_awaited else {'c'}) and pairer.late['c'] == 1


def test_a_fluoroscope_that_lags_for_good_does_not_delay_the_others():
    """A stream far behind, or with different numbers, only has its frames counted."""
    for first in (-1000, 1000, 10**6):
        pairer = exposure_pairer('abc', PairingOptions(waiting=8, patience=5))
        out = []
        for row in range(2000, 2100):
            out.append(
                paired(
                    pairer,
                    [frame('a', row), frame('c', row, 1 + first), frame('b', row)],
                    flush=False,
                )
            )
        assert [e for some in out for e in some] == [
            (row, {'a', 'b'}) for row in range(2000, 2100)
        ]
        assert all(len(some) == 1 for some in out[6:])
        assert pairer.unpaired['a'] == pairer.unpaired['b'] == 0 and pairer.unpaired['c'] >= 90


def test_a_single_view_waits_as_long_as_its_queue():
    """A single view makes no exposure, so patience does not apply to it."""
    pairer = exposure_pairer('abc', PairingOptions(waiting=8, patience=2))
    assert paired(pairer, [frame('a', row) for row in range(10)], flush=False) == []
    assert pairer.unpaired == {'a': 2, 'b': 0, 'c': 0} and not pairer.silent
    assert paired(pairer, [frame('b', row) for row in range(10)], flush=False) == [
        (row, {'a', 'b'}) for row in range(2, 10)
    ]
    assert pairer.unpaired == {'a': 2, 'b': 2, 'c': 0}


@pytest.mark.parametrize('names', ['ab', 'abc'])
def test_fewer_frames_wait_once_the_limit_is_lowered(names):
    pairer = exposure_pairer(names, PairingOptions(waiting=64))
    assert paired(pairer, [frame('a', row) for row in range(60)], flush=False) == []
    pairer.use(PairingOptions(waiting=4))
    assert paired(pairer, [frame('a', 60)], flush=False) == [] and pairer.unpaired['a'] == 57
    frames = [frame(name, row) for row in range(61) for name in names[1:]]
    rows = [row for row, views in paired(pairer, frames, flush=False) if 'a' in views]
    assert rows == [57, 58, 59, 60]


@pytest.mark.parametrize('count', [5, 200])
@pytest.mark.parametrize('later', [True, False])
def test_restarted_streams(count, later):
    """Restarted fluoroscopes, or a repeated recording: stamps continue or fall back."""
    pairer = exposure_pairer('abc', PairingOptions(waiting=64))
    for turn in range(3):
        frames = [
            replace(frame(name, row), stamp_ns=(turn if later else 0) * 10**12 + row * 10**9 // 2)
            for row in range(count)
            for name in 'abc'
            if name != 'c' or row != 1
        ]
        rows = paired(pairer, frames, flush=False)
        assert rows == [(row, {'a', 'b'} if row == 1 else {'a', 'b', 'c'}) for row in range(count)]
    assert sum(pairer.unpaired.values()) == 0
    by_stamp = exposure_pairer('abc', PairingOptions('stamp'))
    for _ in range(2):
        assert (
            len(
                paired(
                    by_stamp,
                    [frame(name, row) for row in range(200) for name in 'abc'],
                    flush=False,
                )
            )
            == 200
        )


def trial(names, number, begin_ns, count=500, ahead=0, lost=()):
    """Return the frames of a trial, row = 1000 trial + number; the last fluoroscope is ahead."""
    of_each = {
        name: [
            Frame(name, n, begin_ns + n * 10 * MS, 1000 * number + n)
            for n in range(1, count + 1)
            if (name, n) not in lost
        ]
        for name in names
    }
    leading = of_each[names[-1]][:ahead]
    rest = [f for name in names for f in of_each[name] if f not in leading]
    return leading + sorted(rest, key=lambda f: f.number - ahead * (f.fluoroscope == names[-1]))


@pytest.mark.parametrize(
    ('names', 'skipped'), [('ab', ''), ('ab', 'a'), ('ab', 'b'), ('abc', ''), ('abc', 'b')]
)
@pytest.mark.parametrize('ahead', [0, 3])
@pytest.mark.parametrize('count', [20, 500])
def test_frames_left_from_one_trial_do_not_belong_to_the_next(names, ahead, count, skipped):
    """Numbers begin at 1 in each trial; a frame is lost, or a fluoroscope misses a trial."""
    pairer = exposure_pairer(names)
    rows = []
    for number in range(4):
        lost = {('a', 10)} if number == 0 else set()
        views = [name for name in names if number != 2 or name != skipped]
        frames = trial(views, number, 10**12 + number * 60 * 10**9, count, ahead, lost)
        rows += [row for row, _ in paired(pairer, frames, flush=False)]
    trials = 3 if skipped and names == 'ab' else 4
    assert trials * count - 1 - 3 * ahead <= len(rows) == len(set(rows)) <= trials * count


def test_bursts_that_follow_each_other_quickly_are_kept_apart():
    pairer = exposure_pairer('ab')
    frames = []
    for burst in range(3):
        frames += trial('ab', burst, 10**12 + burst * 500 * MS, 20, lost={('a', 5)})
    assert len(paired(pairer, frames, flush=False)) == 3 * 19


def test_a_restarted_stream_releases_waiting_frames():
    pairer = exposure_pairer('abc')
    assert not paired(pairer, [frame('a', 500), frame('b', 500), frame('a', 501)], flush=False)
    assert paired(pairer, [replace(frame('a', 0), stamp_ns=10**12)], flush=False) == [
        (500, {'a', 'b'})
    ]
    assert pairer.unpaired == {'a': 1, 'b': 0, 'c': 0}


@pytest.mark.parametrize(
    ('stamp_ns', 'order'),
    [
        (5 * 10**9 + 1, Order.IN_ORDER),
        (5 * 10**9, Order.LATE),
        (4 * 10**9, Order.LATE),
        (4 * 10**9 - 1, Order.RESTART),
        (0, Order.RESTART),
    ],
)
def test_a_stamp_is_in_order_late_or_after_a_restart(stamp_ns, order):
    assert order_of(stamp_ns, 5 * 10**9) is order


@pytest.mark.parametrize('by', BY)
def test_repeated_and_unordered_frames_are_late(by):
    pairer = exposure_pairer('abc', PairingOptions(by, 0.001))
    frames = [
        frame('a', 5),
        frame('a', 5),
        frame('a', 4),
        frame('b', 5),
        frame('c', 5),
        frame('c', 5),
        frame('b', 4),
    ]
    assert paired(pairer, frames) == [(5, {'a', 'b', 'c'})]
    assert pairer.late == pairer.unpaired == {'a': 2, 'b': 1, 'c': 1}


@pytest.mark.parametrize('names', ['ab', 'abc'])
@pytest.mark.parametrize('by', BY)
@pytest.mark.parametrize('behind', [0, 1, 5])
def test_an_exposure_that_two_nodes_publish_is_paired_once(by, names, behind):
    """The second node publishes the same frames, `behind` exposures after the first one."""
    pairer = exposure_pairer(names, PairingOptions(by, 0.001))
    rows = [row for n in range(1, 60) for row in (n, n - behind) if row > 0]
    frames = [frame(name, row) for row in rows for name in names]
    assert [row for row, _ in paired(pairer, frames)] == list(range(1, 60))
    assert set(pairer.late.values()) == {len(rows) - 59}
    assert pairer.late == pairer.unpaired


@pytest.mark.parametrize('names', ['ab', 'abc'])
def test_frames_without_stamps_are_not_taken_for_repeated_ones(names):
    pairer = exposure_pairer(names)
    frames = [replace(frame(name, row), stamp_ns=0) for row in range(30) for name in names]
    assert len(paired(pairer, frames)) == 30


@pytest.mark.parametrize('names', ['ab', 'abc'])
def test_a_lost_frame_does_not_shift_later_ones_if_the_tolerance_is_too_large(names):
    """At 1000 Hz the default tolerance of 2 ms covers two frame intervals."""
    pairer = exposure_pairer(names, PairingOptions('stamp'))
    frames = [
        Frame(name, row, 10**9 + row * MS, row)
        for row in range(500)
        for name in reversed(names)
        if (name, row) != (names[-1], 100)
    ]
    assert len(paired(pairer, frames, flush=False)) == 499 + (names == 'abc')


@pytest.mark.parametrize(
    ('tolerance_ms', 'used_ns'), [(0.4, 400_000), (0.5, 499_999), (20, 499_999)]
)
def test_tolerance_is_kept_below_half_of_the_frame_interval(tolerance_ms, used_ns):
    """The interval is that of the fastest stream; lost, repeated and late frames do not count."""
    tolerance = StampTolerance(round(tolerance_ms * MS))
    assert tolerance.finding() is None
    for row in range(50):
        tolerance.add('slow', 10**9 + row * 10 * MS)
        for shift in (0, 0, -2):
            if row % 4:
                tolerance.add('fast', 10**9 + (row + shift) * MS)
        tolerance.add('without stamps', 0)
    assert tolerance.ns == used_ns
    found = tolerance.finding()
    if tolerance_ms < 0.5:
        assert found is None
    else:
        assert found.kind is Kind.WIDE_TOLERANCE
        assert found.numbers == pytest.approx({'tolerance_ms': tolerance_ms, 'interval_ms': 1.0})


def test_single_shots_and_restarts_leave_the_tolerance_as_it_is():
    tolerance = StampTolerance(2 * MS)
    for stamp_ns in (10**9, 10**9 + MS, 1, 2, 10**10, 10**10 + MS):
        tolerance.add('a', stamp_ns)
    assert tolerance.ns == 2 * MS and tolerance.finding() is None


class CountedStamp(int):
    """A stamp that counts how often stamps are subtracted or compared."""

    count = 0

    def __sub__(self, other):
        CountedStamp.count += 1
        return int(self) - int(other)

    def __lt__(self, other):
        CountedStamp.count += 1
        return int(self) < int(other)


@pytest.mark.parametrize('waiting', [100, 1600])
def test_frames_that_wait_cost_no_time_for_each_further_frame(waiting):
    """One fluoroscope of a recording was started earlier, so its frames have no partners."""
    pairer = exposure_pairer('ab', RecordedPairing('stamp', 0.001).unlimited())
    frames = [frame('a', row) for row in range(waiting)]
    frames += [frame(name, row) for row in range(waiting, waiting + 200) for name in 'ab']
    frames = [replace(f, stamp_ns=CountedStamp(f.stamp_ns)) for f in frames]
    CountedStamp.count = 0
    assert len(paired(pairer, frames)) == 200 and pairer.unpaired == {'a': waiting, 'b': 0}
    assert CountedStamp.count < 60 * len(frames)


def test_exposures_paired_by_stamp_are_numbered():
    """Frames within the tolerance of the earliest belong together, whatever their numbers."""
    pairer = exposure_pairer('abc', PairingOptions('stamp', 0.002))
    frames = [
        Frame('b', 70, 1 * MS, 0),
        Frame('a', 5, 0, 0),
        Frame('c', 9, 2 * MS, 0),
        Frame('a', 6, 10 * MS, 1),
        Frame('b', 71, 12 * MS, 1),
        Frame('c', 8, 12 * MS + 1, 2),
        Frame('a', 7, 20 * MS, 3),
    ]
    found = [e for f in frames for e in pairer.add(f)]
    assert [{name: f.number for name, f in e.items()} for e in found] == [
        {'a': 1, 'b': 1, 'c': 1},
        {'a': 2, 'b': 2},
    ]


@pytest.mark.parametrize('by', BY)
def test_two_fluoroscopes_are_paired_completely(by):
    """Only complete exposures are returned; the partner of a displaced frame is late."""
    pairer = exposure_pairer('ab', PairingOptions(by, 0.001, 3, 1))
    assert not isinstance(pairer, PartialPairer)
    assert paired(pairer, [frame('a', row) for row in range(5)], flush=False) == []
    assert paired(pairer, [frame('b', row) for row in (1, 4, 2)], flush=False) == [
        (4, {'a', 'b'}),
        (2, {'a', 'b'}),
    ]
    assert (
        list(pairer.flush()) == []
        and pairer.unpaired == {'a': 3, 'b': 1}
        and pairer.late == {'a': 0, 'b': 1}
    )
    assert pairer.incomplete == 0 and not pairer.silent


@pytest.mark.parametrize('names', ['ab', 'abc'])
def test_unknown_kinds_of_pairing_are_refused(names):
    with pytest.raises(ValueError, match="not 'id'"):
        exposure_pairer(names, PairingOptions('id'))
