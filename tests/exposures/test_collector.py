# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Pairing of frames, collection of still exposures, and coverage of the image."""

import itertools

import numpy as np
import pytest

from fluoro_calib_ros.errors import DataError
from fluoro_calib_ros.exposures.collector import (
    Coverage,
    ExposureCollector,
    Readiness,
    StillOptions,
    collect_recorded,
    displacement,
    readiness,
)
from fluoro_calib_ros.exposures.frame import Frame
from fluoro_calib_ros.exposures.pairing import CompletePairer, PairingOptions

SIZE = (1000, 800)
MS = 1_000_000


def frame(name='a', number=1, stamp_ms=0.0, shift=0.0, ids=range(20)):
    """A frame of 20 targets, displaced by shift [px] along u."""
    ids = np.array(ids)
    uv = np.column_stack([100 + 20.0 * ids + shift, 200 + 10.0 * ids])
    return Frame(name, number, ids, uv, SIZE, None, round(stamp_ms * MS))


def pair(number=1, stamp_ms=0.0, shift=0.0, shift_b=None):
    stamp_ms += 1000  # 0 is an unknown time
    return {
        'a': frame('a', number, stamp_ms, shift),
        'b': frame('b', number, stamp_ms, shift if shift_b is None else shift_b),
    }


# ---- pairing


def completed(pairer, frame):
    """Return the exposure that a frame completes, or None."""
    exposures = pairer.add(frame)
    assert len(exposures) <= 1
    return exposures[0] if exposures else None


def test_frames_are_paired_by_number_in_any_order():
    pairer = CompletePairer('ab')
    assert (
        completed(pairer, frame('a', 1, 0)) is None and completed(pairer, frame('a', 2, 5)) is None
    )
    found = completed(pairer, frame('b', 2, 900))
    assert (found['a'].stamp_ns, found['b'].stamp_ns) == (5 * MS, 900 * MS)
    assert completed(pairer, frame('b', 1, 899))['a'].number == 1
    pairer.flush()
    assert pairer.unpaired == {'a': 0, 'b': 0}


def test_frames_are_paired_by_stamp_within_the_tolerance():
    """The nearest frame is paired; pairs get new numbers, as numbers of frames may differ."""
    pairer = CompletePairer('ab', PairingOptions('stamp', 0.002))
    for number, stamp in ((70, 0), (71, 3), (72, 50)):
        assert completed(pairer, frame('a', number, stamp)) is None
    found = completed(pairer, frame('b', 5, 2.5))
    assert (found['a'].stamp_ns, found['a'].number, found['b'].number) == (3 * MS, 1, 1)
    assert completed(pairer, frame('b', 6, 52.1)) is None, 'beyond the tolerance'
    assert completed(pairer, frame('b', 7, 48.0))['b'].number == 2
    pairer.flush()
    assert pairer.unpaired == {'a': 1, 'b': 1}


def test_number_of_waiting_frames_is_limited():
    """A frame that is dropped without a partner is counted, and is not paired later."""
    pairer = CompletePairer('ab', PairingOptions(waiting=3))
    for number in range(1, 6):
        assert completed(pairer, frame('a', number)) is None
    assert pairer.unpaired == {'a': 2, 'b': 0}
    assert completed(pairer, frame('b', 2)) is None
    assert completed(pairer, frame('b', 3)) is not None
    pairer.flush()
    assert pairer.unpaired == {'a': 4, 'b': 1}
    assert pairer.late == {'a': 0, 'b': 1}
    assert completed(pairer, frame('b', 4)) is None, 'flush gives all up'


@pytest.mark.parametrize('by', ['frame_number', 'stamp'])
def test_frames_of_a_restarted_fluoroscope_are_not_late(by):
    pairer = CompletePairer('ab', PairingOptions(by, waiting=3))
    for number in range(10_000, 10_006):
        pairer.add(frame('a', number, number))
    for number in range(1, 4):
        assert completed(pairer, frame('b', number, number)) is None
        assert completed(pairer, frame('a', number, number)) is not None
    assert pairer.late == {'a': 0, 'b': 0}


def test_repeated_number_replaces_the_waiting_frame():
    pairer = CompletePairer('ab')
    pairer.add(frame('a', 1, 0))
    pairer.add(frame('a', 1, 7))
    assert pairer.unpaired == {'a': 1, 'b': 0}
    assert completed(pairer, frame('b', 1))['a'].stamp_ns == 7 * MS


def test_single_fluoroscope_needs_no_partner():
    assert completed(CompletePairer(['a']), frame('a', 4))['a'].number == 4


def test_unknown_kind_of_pairing_is_refused():
    with pytest.raises(ValueError, match="not 'id'"):
        CompletePairer('ab', PairingOptions('id'))


# ---- still exposures


def test_displacement_is_the_median_of_common_targets():
    """Some false matches have no effect; frames with too few common targets count as different."""
    one = frame()
    other = frame(shift=3.0)
    other.uv[:5] += 400
    assert displacement(one, other) == pytest.approx(3)
    assert displacement(frame(ids=range(8)), frame(shift=2.0)) == pytest.approx(2)
    assert displacement(frame(ids=range(7)), frame()) == np.inf
    reordered = frame(ids=range(19, -1, -1), shift=1.0)
    assert displacement(frame(), reordered) == pytest.approx(1)


def test_exposures_are_collected_where_the_phantom_stands_still_in_a_new_pose():
    """A stream of 50 frames per second: standing, moving, standing elsewhere, and back again."""
    collector = ExposureCollector('ab')
    taken = []
    shifts = (
        [0] * 20
        + list(np.linspace(0, 100, 20))
        + [100] * 20
        + list(np.linspace(100, 0, 20))
        + [0] * 20
    )
    said = []
    for number, shift in enumerate(shifts, 1):
        said.append(collector.offer(pair(number, 20.0 * number, shift)))
        if not said[-1]:
            taken.append(number)
    # Frame 40 is the first at rest. An exposure is taken 100 ms later, and none is taken in a pose
    # that is already collected.
    assert taken == [1, 45], said
    assert [e['a'].number for e in collector.exposures] == taken
    assert said[10] == 'this pose of the phantom is already collected'
    assert said[30] == 'the phantom moves' and said[-1] == said[10]


def test_movement_seen_by_one_fluoroscope_counts():
    """The motion is along the axis of the other fluoroscope: neither still nor the same pose."""
    collector = ExposureCollector('ab')
    assert collector.offer(pair(1, 0)) == ''
    assert collector.offer(pair(2, 20, 0, 50)) == 'the phantom moves'
    assert collector.offer(pair(3, 2000, 0, 50)) == ''
    assert [p['a'].number for p in collector.exposures] == [3], 'the first one was in motion'


def test_first_frame_of_a_stream_in_motion_is_not_kept():
    """The first frame looks like a single shot until the next frames come."""
    collector = ExposureCollector('ab')
    for number in range(10):
        collector.offer(pair(number + 1, 20 * number, 3.0 * number))
    assert collector.exposures == [] and collector.coverage == {}
    for number in range(10, 20):
        collector.offer(pair(number + 1, 20 * number, 27.0))
    assert len(collector.exposures) == 1 and set(collector.coverage) == {'a', 'b'}


def test_single_shot_is_kept_where_the_phantom_moves_later():
    collector = ExposureCollector('ab')
    for number, (stamp, shift) in enumerate([(0, 0), (20, 0), (150, 50), (170, 60)]):
        collector.offer(pair(number + 1, stamp, shift))
    assert [p['a'].number for p in collector.exposures] == [1]


def test_every_single_shot_in_a_new_pose_is_collected():
    """Frames further apart than the still time can only be compared with the collected poses."""
    collector = ExposureCollector('ab', StillOptions(still_time_s=0.1, new_px=10))
    assert collector.offer(pair(1, 0, 0)) == ''
    assert collector.offer(pair(2, 500, 9.9)) == 'this pose of the phantom is already collected'
    assert collector.offer(pair(3, 1000, 10.1)) == ''


def test_moving_phantom_after_a_gap_in_a_stream_is_not_collected():
    """A busy machine loses frames of a stream; a frame after the gap is not a single shot."""
    collector = ExposureCollector('ab')
    taken = []
    times = [
        20.0 * n for n in range(80) if not 25 <= n < 35 and not 36 <= n < 42
    ]  # gaps of 0.2 and 0.14 s
    for number, time in enumerate(times, 1):
        if not collector.offer(
            pair(number, time, np.clip(time - 400, 0, 800) / 4)
        ):  # the phantom moves from 400 ms to 1200 ms
            taken.append(time)
    assert taken == [0.0, 1300.0]
    assert collector.offer(pair(90, 3000.0, 50)) == ''  # long after the end of the stream


def test_add_requires_only_a_new_number():
    collector = ExposureCollector('ab')
    assert collector.add(pair(1)) == '' and collector.add(pair(2)) == ''
    assert collector.add(pair(2, 99)) == 'frame 2 is collected already'
    assert [e['b'].number for e in collector.exposures] == [1, 2]


class CountedPair(dict):
    """A pair that counts how often its frames are read."""

    reads = 0

    def __getitem__(self, name):
        self.reads += 1
        return super().__getitem__(name)


def test_a_collected_pair_is_not_read_again_for_each_later_one():
    """The time of a recording had grown with the square of its exposures."""
    collector = ExposureCollector('ab')
    first = CountedPair(pair(1))
    assert not collector.add(first)
    reads = first.reads
    assert not any(collector.add(pair(number)) for number in range(2, 30))
    assert first.reads == reads


def test_pairs_without_a_stamp_are_collected_only_on_request():
    collector = ExposureCollector('ab')
    reasons = {collector.offer(pair(number, -1000, 50 * number)) for number in range(1, 5)}
    assert collector.exposures == [] and len(reasons) == 1 and '' not in reasons
    assert collector.add(pair(5, -1000)) == '' and collector.offer(pair(6, 0, 50)) == ''
    assert [p['a'].number for p in collector.exposures] == [5, 6]


def test_frames_by_fluoroscope():
    collector = ExposureCollector('ab')
    collector.add(pair(1))
    collector.add(pair(2))
    assert {n: [f.number for f in fs] for n, fs in collector.frames().items()} == {
        'a': [1, 2],
        'b': [1, 2],
    }
    assert list(collector.frames(['b'])) == ['b']
    with pytest.raises(DataError, match='fluoroscope c is unknown, expected one of a, b'):
        collector.frames(['c'])


# ---- recordings


def recording(shifts, interval_ms):
    return {
        name: [frame(name, n, interval_ms * n, shift) for n, shift in enumerate(shifts, 1)]
        for name in 'ab'
    }


def test_all_single_shots_of_a_recording_are_collected():
    frames, unpaired = collect_recorded(recording([0, 0, 50], 500.0))
    assert [f.number for f in frames['a']] == [1, 2, 3] and unpaired == {'a': 0, 'b': 0}
    frames, _ = collect_recorded(recording([0, 0, 50], 500.0), 'still')
    assert [f.number for f in frames['a']] == [1, 3]


def test_still_exposures_of_a_stream_are_collected():
    shifts = [0] * 20 + list(np.linspace(0, 100, 20)) + [100] * 20
    frames, _ = collect_recorded(recording(shifts, 20.0))
    assert [f.number for f in frames['b']] == [1, 45]
    frames, _ = collect_recorded(recording(shifts, 20.0), 'all')
    assert len(frames['b']) == 60


def test_unpaired_frames_are_left_out_and_counted():
    recorded = recording([0] * 5, 500.0)
    del recorded['a'][1], recorded['b'][3]
    recorded['b'].reverse()
    frames, unpaired = collect_recorded(recorded)
    assert [f.number for f in frames['a']] == [1, 3, 5] == [f.number for f in frames['b']]
    assert unpaired == {'a': 1, 'b': 1}


@pytest.mark.parametrize('by', ['frame_number', 'stamp'])
def test_frames_that_need_no_partner_are_exposures(by):
    recorded = {
        'a': [frame('a', n, 500.0 * n, ids=range(20 if n < 3 else 50, 70)) for n in (1, 2, 3, 5)],
        'b': [frame('b', n, 500.0 * n, ids=range(20 if n < 3 else 50, 70)) for n in (2, 4, 6)],
    }
    frames, unpaired = collect_recorded(
        recorded, pair_by=by, alone=lambda frame: min(frame.target_id) == 50
    )
    assert [f.stamp_ns // 500_000_000 for f in frames['a']] == [2, 3, 5]
    assert [f.stamp_ns // 500_000_000 for f in frames['b']] == [2, 4, 6]
    assert unpaired == {'a': 1, 'b': 0}
    numbers = {name: [f.number for f in view] for name, view in frames.items()}
    assert set(numbers['a']) & set(numbers['b']) == {numbers['a'][0]} == {numbers['b'][0]}


@pytest.mark.parametrize(('gap_ms', 'count'), [(10, 0), (10_000, 2)])
def test_two_frames_are_exposures_unless_they_are_a_stream(gap_ms, count):
    """Nobody moves a phantom to another pose within the time for which it has to be still."""
    frames = {
        name: [frame(name, 1 + i, (1 + i) * gap_ms, shift=50.0 * i) for i in range(2)]
        for name in 'ab'
    }
    kept, _ = collect_recorded(frames)
    assert [len(kept[name]) for name in 'ab'] == [count, count]


def test_recording_without_stamps_has_no_still_exposures():
    recorded = recording([0, 50, 100], 0.0)
    assert len(collect_recorded(recorded)[0]['a']) == 3
    with pytest.raises(DataError, match='without a stamp'):
        collect_recorded(recorded, 'still')


def test_empty_recording():
    assert collect_recorded({'a': [], 'b': []}) == ({'a': [], 'b': []}, {'a': 0, 'b': 0})


# ---- coverage


def test_coverage_grows_from_zero_to_the_whole_image():
    coverage = Coverage(SIZE)
    rng = np.random.default_rng(1)
    seen = []
    assert coverage.fraction == 0
    for _ in range(40):
        coverage.add(rng.uniform(-0.5, np.array(SIZE) - 0.5, (60, 2)))
        seen.append(coverage.fraction)
    assert (
        all(a <= b for a, b in itertools.pairwise(seen)) and 0.2 < seen[0] < 0.5 and seen[-1] == 1
    )
    coverage.add(np.zeros((0, 2)))
    assert coverage.fraction == 1


def test_an_image_point_covers_its_surroundings_within_the_image():
    """It covers its cell of 32 x 32 and its eight neighbours, of which a corner has three."""
    middle = Coverage(SIZE)
    corner = Coverage(SIZE)
    far_corner = Coverage(SIZE)
    middle.add([[500.0, 400.0]])
    corner.add([[-0.5, -0.5]])
    far_corner.add([[999.5, 799.5]])
    assert (middle.fraction, corner.fraction, far_corner.fraction) == (
        9 / 1024,
        4 / 1024,
        4 / 1024,
    )
    far_corner.add([[-0.5, -0.5]])
    assert far_corner.fraction == 8 / 1024
    half = Coverage(SIZE)
    half.add(
        np.stack(np.meshgrid(np.arange(0, 480.0), np.arange(0, 800.0)), axis=2).reshape(-1, 2)
    )
    assert half.fraction == pytest.approx(17 / 32)  # the left half and the next column


def test_coverage_by_fluoroscope():
    collector = ExposureCollector('ab')
    collector.add({'a': frame('a', 1), 'b': frame('b', 1, ids=range(3))})
    assert collector.coverage['a'].fraction > collector.coverage['b'].fraction > 0


# ---- what a calibration still needs


def points_within(radius, count=4000, seed=3):
    """Return image points in a circle around the centre; radius: fraction of half the height."""
    rng = np.random.default_rng(seed)
    angle, distance = rng.uniform(0, 2 * np.pi, count), np.sqrt(rng.uniform(0, 1, count))
    reach = radius * distance[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
    return (0.5 + 0.5 * reach) * SIZE - 0.5


def test_without_exposures_the_phantom_is_asked_for():
    assert readiness(0, None) == Readiness(False, 'show the phantom and keep it still')


def test_empty_areas_are_named_the_emptiest_first():
    coverage = Coverage(SIZE)
    left = np.stack(np.meshgrid(np.arange(0, 600.0, 5), np.arange(0, 800.0, 5)), axis=2)
    coverage.add(left.reshape(-1, 2))
    found = readiness(15, coverage)
    assert not found.ready and found.areas == (2, 5)  # the right column, from the top
    assert 'in the upper right corner and at the right edge' in found.advice
    assert readiness(10, coverage).advice.startswith('5 more, ')
    assert not any(c.isdigit() for c in found.advice)  # there are enough exposures


@pytest.mark.parametrize(('columns', 'missing'), [(29, (2, 5, 8)), (30, ())])
def test_areas_are_named_below_85_percent(columns, missing):
    """The last area has 11 of 32 columns; a point also covers the neighbouring column."""
    coverage = Coverage(SIZE)
    width, height = np.array(SIZE) / 32
    u, v = np.meshgrid((np.arange(columns) + 0.5) * width, (np.arange(32) + 0.5) * height)
    coverage.add(np.stack([u.ravel(), v.ravel()], axis=1) - 0.5)
    assert coverage.missing_areas == missing


def test_a_round_field_of_view_has_no_corners():
    """The corners of an image intensifier never show a bead."""
    whole = Coverage(SIZE)
    whole.add(points_within(1.0))
    assert whole.fraction < 0.9 <= whole.fraction_of_field and whole.is_round
    found = readiness(15, whole)
    assert found.ready and found.areas == () and 'not round' in found.advice
    assert not readiness(14, whole).ready
    small = Coverage(SIZE)
    small.add(points_within(0.5))  # too little of the field to recognise its shape
    assert not small.is_round and not readiness(15, small).ready
    corner = Coverage(SIZE)
    corner.add(np.vstack([points_within(1.0), [[2.0, 2.0]]]))
    assert not corner.is_round
