# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Frames that are paired by number but were recorded at different times."""

from dataclasses import dataclass

import numpy as np
import pytest

from fluoro_calib_ros.exposures.pairing import (
    CompletePairer,
    PairingOptions,
    disagreement_of_recording,
    exposure_pairer,
)
from fluoro_calib_ros.exposures.stamps import _frame_interval
from fluoro_calib_ros.findings import Kind

MS = 1_000_000
INTERVAL = 40 * MS  # frame interval [ns] at 25 Hz


@dataclass(frozen=True)
class Frame:
    """The attributes of a frame that the pairing needs."""

    fluoroscope: str
    number: int
    stamp_ns: int


def stream(name, count=20, first=1, delay_ns=0, origin_ns=10**9):
    return [
        Frame(name, first + i, origin_ns + i * INTERVAL + delay_ns if origin_ns else 0)
        for i in range(count)
    ]


def recording(**streams):
    return {name: stream(name, **options) for name, options in streams.items()}


@pytest.mark.parametrize('delay_ms', [0, 3, -15])
def test_small_difference_is_no_disagreement(delay_ms):
    assert not disagreement_of_recording(recording(a={}, b={'delay_ns': delay_ms * MS}))


def test_one_frame_behind_is_told_with_time_and_frames():
    found = disagreement_of_recording(recording(a={}, b={'delay_ns': INTERVAL}))
    assert (found.kind, found.place.fluoroscopes) == (Kind.STAMPS_APART, ('a', 'b'))
    assert found.numbers == {'apart_ms': pytest.approx(40.0), 'frames': pytest.approx(1.0)}


def test_third_fluoroscope_is_compared_too():
    found = disagreement_of_recording(recording(a={}, b={}, c={'delay_ns': -2 * INTERVAL}))
    assert found.place.fluoroscopes == ('a', 'c')
    assert found.numbers['frames'] == pytest.approx(2.0)


def test_frames_without_stamps_are_not_compared():
    assert not disagreement_of_recording(recording(a={}, b={'origin_ns': 0}))
    third = recording(a={}, b={'origin_ns': 0}, c={'delay_ns': INTERVAL})
    assert disagreement_of_recording(third).place.fluoroscopes == ('a', 'c')


def test_few_exposures_say_nothing():
    found = disagreement_of_recording(
        recording(a={'count': 4}, b={'count': 4, 'delay_ns': INTERVAL})
    )
    assert not found


@pytest.mark.parametrize('names', ['ab', 'abc'])
def test_live_pairer_tells_it_and_forgets_it(names):
    pairer = exposure_pairer(names)
    for wrong, right in zip(stream('b', delay_ns=INTERVAL), stream('a')):
        for name in names:
            pairer.add(wrong if name == 'b' else Frame(name, right.number, right.stamp_ns))
    assert pairer.stamps.disagreement().place.fluoroscopes == ('a', 'b')
    # After a restart of the cameras, the newest exposures count.
    for frames in zip(*(stream(name, 300, origin_ns=2 * 10**12) for name in names)):
        for frame in frames:
            pairer.add(frame)
    assert not pairer.stamps.disagreement()


def test_pairing_by_stamp_has_no_disagreement():
    pairer = CompletePairer('ab', PairingOptions('stamp'))
    for frame in (*stream('a'), *stream('b', delay_ns=INTERVAL, first=7)):
        pairer.add(frame)
    assert not pairer.stamps.disagreement()


@pytest.mark.parametrize('delay_ms', [0, 40])
def test_numbers_that_never_grow_are_told_and_give_no_frame_interval(delay_ms):
    """A driver does not number frames, so that those of one exposure cannot be told apart."""
    repeated = {
        name: [Frame(name, 7, frame.stamp_ns) for frame in stream(name, delay_ns=delay * MS)]
        for name, delay in (('a', 0), ('b', delay_ms))
    }
    pairer = CompletePairer('ab')
    for pair in zip(*repeated.values()):
        for frame in pair:
            pairer.add(frame)
    found = pairer.stamps.disagreement()
    assert (found.kind, found.place.fluoroscopes) == (Kind.FRAMES_UNNUMBERED, ('a',))
    assert found.numbers == {'number': 7, 'frames': 20}
    number, stamp_ns = np.array([5, 5, 4]), np.array([10, 20, 30])
    assert _frame_interval(number, stamp_ns) == 0
    assert _frame_interval(np.array([5, 7, 6, 8]), np.array([10, 30, 40, 90])) == 17.5
