# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Exposures used by the checks for calibration and for testing are disjoint."""

from types import SimpleNamespace

import pytest

from fluoro_calib_ros.checks import field_checks, held_out
from fluoro_calib_ros.checks.calibration_evidence import Evidence
from fluoro_calib_ros.checks.held_out import _hold_out
from fluoro_calib_ros.errors import DataError
from fluoro_calib_ros.findings import Kind

COUNT = 11


class Recorded(SimpleNamespace):
    """Evidence that records which exposures are requested; exposures are numbers here."""

    def __init__(self, fails=False, count=COUNT):
        names = ('a', 'b')
        super().__init__(frames={name: list(range(count)) for name in names}, fails=fails)
        self.calibrated, self.adjusted = [], []
        self.fewest_exposures = lambda names: count
        self.report_step = lambda step: None
        self.calibrations = dict.fromkeys(names)

    def part(self, names, is_chosen):
        return Evidence.part(self, names, is_chosen)

    def calibrate(self, frames):
        self.calibrated.append(frames)
        if self.fails:
            raise DataError('too little')
        return {name: set(of_one) for name, of_one in frames.items()}

    def adjust(self, frames, calibrations):
        self.adjusted.append(frames)
        raise DataError('enough')


def test_halves_share_no_exposure_and_leave_none_out(monkeypatch):
    compared = []
    monkeypatch.setattr(field_checks, '_agreement', lambda *given: compared.append(given))
    assert len(field_checks.check_halves(Recorded(), ('a', 'b'))) == 2
    assert [name for name, *_ in compared] == ['a', 'b']
    for _, one, other, count in compared:
        assert not one & other and one | other == set(range(COUNT)) and count == COUNT
        assert abs(len(one) - len(other)) == 1


@pytest.mark.parametrize('evidence', [Recorded(fails=True), Recorded(count=5)])
def test_halves_that_cannot_be_calibrated_tell_nothing(evidence):
    found = field_checks.check_halves(evidence, ('a', 'b'))
    assert [check.kind for check in found] == [Kind.HALVES] * 2
    assert all(check.passed is None for check in found)
    assert [check.place.fluoroscopes for check in found] == [('a',), ('b',)]


def test_exposures_that_are_held_out_are_in_no_calibration():
    held = []
    for fold in range(3):
        evidence = Recorded()
        with pytest.raises(DataError, match='enough'):
            _hold_out(evidence, ('a', 'b'), fold, 3)
        (trained,), (tested,) = evidence.calibrated, evidence.adjusted
        for name in 'ab':
            assert not set(trained[name]) & set(tested[name])
            assert set(trained[name]) | set(tested[name]) == set(range(COUNT))
        held += tested['a']
    assert sorted(held) == list(range(COUNT))  # each exposure once


def test_parts_that_are_held_out_are_counted(monkeypatch):
    """All four are announced, even if only three exposures can be held out."""
    for count, folds in ((3, 3), (4, 4), (11, 4)):
        evidence, shown, asked = Recorded(count=count), [], []
        evidence.report_step = shown.append
        monkeypatch.setattr(
            held_out, '_hold_out', lambda *given, asked=asked: asked.append(given) or {'a': [1]}
        )
        monkeypatch.setattr(held_out, '_checks', lambda evidence, name, sums: [(name, len(sums))])
        assert held_out.check_held_out(evidence, ('a',)) == [('a', folds)]
        assert shown == [f'a: held-out exposures, part {n} of 4' for n in (1, 2, 3, 4)]
        assert [given[1:] for given in asked] == [(('a',), n, folds) for n in range(folds)]


def test_exposures_that_cannot_be_held_out_tell_nothing():
    checks = held_out.check_held_out(Recorded(fails=True), ('a', 'b'))
    assert [(check.kind, check.place.fluoroscope) for check in checks] == [
        (kind, name) for name in 'ab' for kind in (Kind.HELD_OUT, Kind.EXPOSURES)
    ]
    assert all(check.passed is None and 'too little' in check.cause for check in checks)
