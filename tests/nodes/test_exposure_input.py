# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Exposures collected from the streams of a calibration node, without its graph."""

from types import SimpleNamespace

import numpy as np
import pytest
import rigs

from fluoro_calib_ros.exposures.collector import StillOptions
from fluoro_calib_ros.exposures.pairing import PairingOptions
from fluoro_calib_ros.nodes.exposure_input import ExposureInput, captured_frames
from fluoro_calib_ros.nodes.messages.observations import ObservedFrame


class Lines:
    """A logger that keeps its lines."""

    def __init__(self):
        self.lines = []

    def info(self, text):
        self.lines.append(text)

    warning = info


@pytest.fixture
def logger():
    return Lines()


@pytest.fixture
def exposures(logger):
    settings = SimpleNamespace(
        pairing=PairingOptions(),
        still=StillOptions(),
        node=SimpleNamespace(collect='still'),
        limits=SimpleNamespace(max_exposures=100),
    )
    phantom = rigs.rig().phantom
    return ExposureInput('ab', phantom, settings, lambda: None, logger)


def observed(name, number, stamp_s):
    """Return an exposure of the rig as a message; its number is that of the pose."""
    frame = rigs.exposures()[name][number - 1]
    return message_of(frame, number, stamp_s, np.full(len(frame.uv), 0.1))


def message_of(frame, number, stamp_s, sigma):
    return ObservedFrame(
        stamp_s,
        0,
        f'{frame.fluoroscope}_optical',
        number,
        frame.image_size,
        np.asarray(frame.target_id, np.uint32).tobytes(),
        *frame.uv.T,
        sigma=sigma,
        start=b'',
    )


def test_counts_of_frames_are_kept_by_a_reset(exposures):
    for number in (1, 2, 3):
        for name in 'ab' if number == 2 else 'a':
            exposures.add(name, observed(name, number, number))
    exposures.add('a', observed('a', 1, 100))  # the stream restarts
    before = exposures.collected('a').status
    assert (before.frames_received, before.frames_unpaired, before.exposures) == (4, 2, 1)
    assert exposures.reset() == 1
    after = exposures.collected('a').status
    assert (after.frames_received, after.frames_unpaired, after.exposures) == (4, 2, 0)


def test_frames_without_a_stamp_are_collected_only_by_a_capture_and_the_log_says_so(
    exposures, logger
):
    for number in range(1, 4):
        for name in 'ab':
            exposures.add(name, observed(name, number, 0))
    assert exposures.collected('a').status.exposures == 0
    assert 'without a stamp' in exposures.streams['a'].refusals.last_fault
    assert 'use the service capture' in logger.lines[0]
    captured = exposures.next_pairs(collected=True)
    for name in 'ab':
        exposures.add(name, observed(name, 15, 0))
    assert captured.done.done() and captured.pairs[0]['a'].number == 15
    assert exposures.collected('a').status.exposures == 1


def test_a_wait_for_pairs_ends_with_its_last_pair_or_is_given_up(exposures):
    """Also where nothing is collected, as without a stamp."""
    wait, other = exposures.next_pairs(2), exposures.next_pairs(3)
    for number in (1, 2):
        assert not wait.done.done()
        for name in 'ab':
            exposures.add(name, observed(name, number, 0))
    assert wait.done.done() and [pair['b'].number for pair in wait.pairs] == [1, 2]
    assert not other.done.done() and len(other.pairs) == 2
    captured = exposures.next_pairs(collected=True)
    for given_up in (other, captured, wait):  # the last one is over
        exposures.give_up(given_up)
    assert other.done.done() and captured.done.done() and not captured.pairs
    for name in 'ab':
        exposures.add(name, observed(name, 3, 0))
    assert len(wait.pairs) == len(other.pairs) == 2
    assert exposures.collected('a').status.exposures == 0


def test_each_capture_has_the_number_of_exposures_with_its_own(exposures):
    captures = [exposures.next_pairs(collected=True) for _ in range(3)]
    for number in (1, 2, 3):
        for name in 'ab':
            exposures.add(name, observed(name, number, 0))
    assert [capture.exposures for capture in captures] == [1, 2, 3]


@pytest.fixture
def sheets(logger):
    """Return the input of a node whose phantom is a cube with a sheet."""
    settings = SimpleNamespace(
        pairing=PairingOptions(waiting=3),
        still=StillOptions(),
        node=SimpleNamespace(collect='request'),
        limits=SimpleNamespace(max_exposures=100),
    )
    return ExposureInput('ab', rigs.sheet_and_cube()[1], settings, lambda: None, logger)


CUBE, SHEET = 0, 1


def of_part(name, part, number):
    """Return an exposure of a part as a message."""
    frame = rigs.sheet_and_cube()[0][name][part]
    return message_of(frame, number, number, frame.sigma)


def counts(exposures):
    return [exposures.collected(name).status.exposures for name in 'ab']


def test_a_sheet_needs_no_partner_but_a_cube_does(sheets):
    sheets.use(
        SimpleNamespace(**{**vars(sheets._settings), 'node': SimpleNamespace(collect='still')})
    )
    sheets.add('a', of_part('a', SHEET, 1))
    assert counts(sheets) == [1, 0]
    sheets.add('b', of_part('b', SHEET, 2))
    assert counts(sheets) == [1, 1]
    sheets.add('a', of_part('a', CUBE, 3))
    assert counts(sheets) == [1, 1]
    sheets.add('b', of_part('b', CUBE, 3))
    assert counts(sheets) == [2, 2]
    assert [frame.number for frame in sheets.frames()['b']] == [2, 3]
    assert sheets.collected('a').status.frames_unpaired == 0


def test_a_capture_of_sheets_takes_a_frame_of_each_fluoroscope(sheets):
    capture = sheets.next_pairs(collected=True)
    for number in (1, 2):
        sheets.add('a', of_part('a', SHEET, number))
    assert not capture.done.done()
    sheets.add('b', of_part('b', SHEET, 2))
    assert capture.done.done() and counts(sheets) == [1, 1] and capture.exposures == 1
    assert captured_frames(capture, 'ab') == 'frame 1 of a, frame 2 of b'


def test_a_capture_of_a_sheet_ends_if_the_other_fluoroscope_shows_none(sheets):
    captures = [sheets.next_pairs(collected=True) for _ in range(2)]
    orient = sheets.next_pairs()
    for number in range(1, 5):
        assert not captures[0].done.done()
        sheets.add('a', of_part('a', SHEET, number))
    assert captures[0].done.done() and counts(sheets) == [1, 0]
    assert captured_frames(captures[0], 'ab') == 'frame 1 of a'
    sheets.add('a', of_part('a', SHEET, 5))
    sheets.give_up(captures[1])
    assert captured_frames(captures[1], 'ab') == 'frame 5 of a'
    assert not orient.pairs, 'a sheet does not orient the rig'
