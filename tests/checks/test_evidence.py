# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Calibration of parts of a recording, and contradiction of a given interior orientation."""

import time
from types import SimpleNamespace as Fake

import numpy as np
import pytest

from fluoro_calib_ros.checks import calibration_evidence, held_out, verdict
from fluoro_calib_ros.checks.calibration_evidence import CommonTrend, Evidence, Subject
from fluoro_calib_ros.checks.check import Check
from fluoro_calib_ros.errors import DataError
from fluoro_calib_ros.estimation.exposure_terms import MIN_POINTS
from fluoro_calib_ros.estimation.initial_network import StartValues
from fluoro_calib_ros.estimation.options import CalibrationOptions, CalibrationRequest
from fluoro_calib_ros.exposures.frame import Frame
from fluoro_calib_ros.findings import Kind, Place

SIZE = (1000, 800)


def frames(count, points=100):
    return [
        Frame('a', n, np.arange(points), np.zeros((points, 2)), SIZE) for n in range(1, count + 1)
    ]


def calibration(kind='collocation', kept=500, c=4000.0, series=None, **changes):
    model = Fake(kind=kind, train_uv=np.zeros((kept, 2)), series=series)
    values = {'angle_field': None, 'sigma0': 0.3, 'nu': 5.0}
    return Fake(model=model, interior=np.array([500.0, 400.0, c]), **{**values, **changes})


def evidence(calibrations=None, parts=(), monkeypatch=None, **request):
    """Evidence of two fluoroscopes with 6 exposures, and the calls of `calibrate_part`."""
    given = {'a': frames(6), 'b': frames(6)}
    options = CalibrationOptions(**request)
    targets = Fake(target_id=np.arange(100), xyz_mm=np.zeros((100, 3)))
    out = Evidence(
        CalibrationRequest(given, 'phantom', options, principal_distance=1234.0),
        calibrations or {'a': calibration(), 'b': calibration()},
        Fake(targets=targets, starts=StartValues({}, {})),
        lambda step: None,
    )
    vars(out)['variations'] = {'a': None, 'b': Fake(is_varying=True)}
    calls = []
    left = list(parts)

    def calibrate_part(part, starts, whole):
        calls.append((part, starts))
        found = left.pop(0) if left else 'found'
        if isinstance(found, DataError):
            raise found
        return found

    if monkeypatch:
        monkeypatch.setattr(calibration_evidence, 'calibrate_part', calibrate_part)
    return out, calls


@pytest.mark.parametrize(('asked', 'rounds'), [(3, 3), (25, 25), (60, 25)])
def test_rounds_of_a_part_are_limited(monkeypatch, asked, rounds):
    given, calls = evidence(monkeypatch=monkeypatch, model='none', max_iterations=asked)
    assert given.calibrate({'a': frames(2)}) == 'found'
    ((part, starts),) = calls
    assert part.options.max_iterations == rounds and part.options.model == 'none'
    assert [frame.number for frame in part.frames['a']] == [1, 2]
    assert part.principal_distance == 1234.0 and starts is given.starts


def test_a_fixed_interior_is_that_of_the_calibrations(monkeypatch):
    ours = {'a': calibration(c=3000.0), 'b': calibration(c=4000.0)}
    given, calls = evidence(ours, monkeypatch=monkeypatch, model='none', interior='fixed')
    given.calibrate({'a': [], 'b': []})
    given.calibrate({'a': []})
    assert [part.principal_distance for part, _ in calls] == [3500.0, 3000.0]


@pytest.mark.parametrize(
    ('kinds', 'asked', 'model'),
    [
        (('knn', 'knn'), 'auto', 'knn'),
        (('knn', 'none'), 'auto', 'auto'),
        (('knn', 'knn'), 'local_linear', 'local_linear'),
        (('of another', 'of another'), 'auto', 'auto'),
    ],
)
def test_a_part_has_the_model_that_is_validated(monkeypatch, kinds, asked, model):
    ours = {name: calibration(kind) for name, kind in zip('ab', kinds)}
    given, calls = evidence(ours, monkeypatch=monkeypatch, model=asked)
    given.calibrate({'a': [], 'b': []})
    assert calls[0][0].options.model == model


@pytest.mark.parametrize(
    ('first', 'count'),
    [
        ({'a': calibration(kept=160)}, 1),  # 80 % of 200, the number of the whole
        ({'a': calibration(kept=155)}, 1),
        ({'a': calibration(kept=153)}, 2),
        (DataError('not enough'), 2),
    ],
)
def test_a_part_goes_on_from_the_whole_unless_it_loses_image_points(monkeypatch, first, count):
    ours = {'a': calibration(kept=480, series='of a'), 'b': calibration(kept=300)}
    given, calls = evidence(ours, [first], monkeypatch, model='collocation')
    found = given.calibrate({'a': frames(2)})
    assert found is first if count == 1 else found == 'found'
    assert len(calls) == count
    earlier = calls[0][1].earlier
    assert dict(earlier.series) == {'a': 'of a'} and earlier.varying == {'b'}
    assert (earlier.noise.scale, earlier.noise.nu) == (0.3, 5.0)
    assert earlier.target_id is given.result.targets.target_id
    assert all(starts.earlier is None for _, starts in calls[1:])


def test_fluoroscopes_vary_by_their_angles_or_their_residuals():
    ours = {'a': calibration(angle_field='known'), 'b': calibration()}
    assert evidence(ours)[0].earlier.varying == {'a', 'b'}
    given, _ = evidence()
    assert given.earlier.varying == {'b'}
    assert given.fewest_exposures(('a', 'b')) == 6
    given.request.frames['b'].pop()
    assert given.fewest_exposures(('a', 'b')) == 5 and given.fewest_exposures(('a',)) == 6


def test_without_what_was_given_all_exposures_are_calibrated(monkeypatch):
    given, calls = evidence(monkeypatch=monkeypatch, model='none', interior_sd=(1.0, 1.0, 9.0))
    given.calibrate_free(('b',))
    ((part, _),) = calls
    assert part.options.interior_sd is None
    assert {name: len(of_one) for name, of_one in part.frames.items()} == {'b': 6}


@pytest.mark.parametrize(
    ('size', 'limit', 'claimed', 'is_significant'),
    [(0.5, 0.3, 0.4, False), (0.51, 0.3, 0.4, True), (np.nan, 0.3, 0.4, True)],
)
def test_trend_is_significant_beyond_chance_and_claim(size, limit, claimed, is_significant):
    found = CommonTrend(None, Fake(size=size, limit=limit), claimed)
    assert found.limit == pytest.approx(0.5) and found.is_significant is is_significant


# ---- held-out exposures


def test_exposures_that_fit_only_with_their_own_calibration_stop_the_check(monkeypatch):
    given, _ = evidence()
    found = iter([Fake(numbers=np.array([1, 3])), Fake(numbers=np.array([1, 2, 3]))])
    monkeypatch.setattr(held_out, 'residuals_of', lambda *_: next(found))
    monkeypatch.setattr(Evidence, 'calibrate', lambda self, frames: self.calibrations)
    monkeypatch.setattr(Evidence, 'adjust', lambda self, frames, calibrations: None)
    with pytest.raises(DataError, match='does not fit a calibration without it'):
        held_out._hold_out(given, ('a',), 0, 3)


# ---- a given interior orientation


def contradicted(rmse, free, sd=(3.0, 3.0, 30.0), corrects=True):
    """Check of an interior given as (499.5, 399.5, 4000) with sd 4, 4, 40."""
    present = Fake(
        rmse_after=np.array(rmse[0]), image_size=SIZE, model=Fake(corrects=corrects), name='a'
    )
    other = Fake(
        rmse_after=np.array(rmse[1]),
        interior=np.array(free),
        interior_covariance=np.diag(np.square(sd)),
    )
    given = Fake(
        calibrations={'a': present},
        request=Fake(options=Fake(interior_sd=(4.0, 4.0, 40.0))),
    )
    return verdict._given_interior_check(given, 'a', other, 4000.0)


@pytest.mark.parametrize(
    ('rmse', 'free', 'corrects', 'value'),
    [
        (((1.06, 1.06), (1.0, 1.0)), (499.5, 399.5, 4201.0), True, 4.02),
        (((1.04, 1.04), (1.0, 1.0)), (499.5, 399.5, 4201.0), True, None),
        (((1.06, 1.06), (1.0, 1.0)), (499.5, 399.5, 4199.0), True, None),
        (((1.06, 1.06), (1.0, 1.0)), (499.5, 399.5, 3799.0), True, 4.02),
        (((1.06, 1.06), (1.0, 1.0)), (499.5, 420.0, 4100.0), True, 4.1),
        (((1.9, 1.9), (1.0, 1.0)), (499.5, 399.5, 4300.0), False, None),
        (((2.1, 2.1), (1.0, 1.0)), (499.5, 399.5, 4300.0), False, 6.0),
        (((1.0, 1.4), (1.2, 1.0)), (499.5, 399.5, 4300.0), True, 6.0),  # for both coordinates
    ],
)
def test_a_given_interior_is_contradicted_by_residuals_and_by_what_is_found(
    rmse, free, corrects, value
):
    found = contradicted(rmse, free, corrects=corrects)
    if value is None:
        assert found is None
        return
    assert found.kind is Kind.GIVEN_INTERIOR and found.passed is False
    assert found.value == pytest.approx(value) and found.limit == 4.0
    assert [found.numbers[f'{one}_px'] for one in ('xp', 'yp', 'c')] == list(free)
    assert found.numbers['sd_c_px'] == 30.0
    which = 'yp = 399.5 (sd 4)' if free[1] > 400 else 'c = 4000.0 (sd 40)'
    assert f'orientation, {which} px, contradicts' in found.cause
    shown = 'yp = 420.0 (sd 3.0)' if free[1] > 400 else f'c = {free[2]:.1f} (sd 30.0)'
    assert f'show {shown} px' in found.cause


def test_what_fails_waits_for_the_given_interior_of_its_fluoroscope(monkeypatch):
    contradiction = Check(Kind.GIVEN_INTERIOR, 'x', Place(('a',)), value=5.0, limit=4.0)
    asked = []

    def check_of(evidence, name, free, distance):
        asked.append((name, free, distance))
        return contradiction if name == 'a' else None

    monkeypatch.setattr(verdict, '_given_interior_check', check_of)
    checks = [
        Check(Kind.HALVES, 'x', Place((name,) if name else ()), 'own', value=value, limit=1.0)
        for name, value in (('a', 2.0), ('a', 0.5), ('b', 2.0), ('', 2.0))
    ]
    request = Fake(
        options=Fake(interior_sd=(1.0, 1.0, 1.0)),
        principal_distance=4000.0,
        groups=[('a',), ('b', 'c')],
        known_orientations={'c': 'known'},
    )
    given = Fake(
        request=request,
        report_step=lambda step: None,
        calibrate_free=lambda names: {name: f'free {name}' for name in names},
    )
    first, *others = verdict.with_given_interior(given, checks)
    assert first is contradiction
    assert asked == [('a', 'free a', 4000.0), ('b', 'free b', 4000.0)]
    advised = [one.advice == verdict.REPAIR_FIRST for one in others]
    assert advised == [True, False, False, True]
    monkeypatch.setattr(verdict, '_given_interior_check', lambda *_: None)
    assert verdict.with_given_interior(given, checks) == checks
    for changes in ({'principal_distance': None}, {'options': Fake(interior_sd=None)}):
        asked.clear()
        monkeypatch.setattr(verdict, '_given_interior_check', check_of)
        given.request = Fake(**{**vars(request), **changes})
        assert verdict.with_given_interior(given, checks) == checks and not asked


# ---- the verdict


def test_checks_are_in_the_order_of_fluoroscopes_and_those_of_the_rig_are_last(monkeypatch):
    """Checks contain the numbers of the frames that were used, and steps are counted."""

    def check_of(kind, name):
        return Check(kind, 'x', Place((name,) if name else ()), value=0.5, limit=1.0)

    seen = []

    def of_rig(evidence, names):
        seen.append(
            ('rig', names, {n: [f.number for f in of] for n, of in evidence.frames.items()})
        )
        return [check_of(Kind.BEADS, '')]

    def of_group(kind):
        def run(evidence, names):
            evidence.report_step(kind.value)
            seen.append((kind, names))
            return [check_of(kind, name) for name in names]

        return run

    subjects = (
        Subject(of_rig, of_rig=True),
        Subject(of_group(Kind.HALVES), steps=1),
        Subject(of_group(Kind.DRIFT), steps=1),
    )
    monkeypatch.setattr(verdict, 'SUBJECTS', subjects)
    used = {'a': (3, 1), 'b': (2, 4)}
    result = Fake(
        fluoroscopes={n: Fake(exposures=[Fake(exposure=e) for e in of]) for n, of in used.items()}
    )
    monkeypatch.setattr(verdict, 'adjust_with_calibrations', lambda *given, **options: result)
    monkeypatch.setattr(verdict, 'ids_of', lambda calibrations: {'a': 'x'})
    monkeypatch.setattr(verdict, '_achieved_sd', lambda evidence, name, checks: len(checks))
    monkeypatch.setattr(verdict, 'with_given_interior', lambda evidence, checks: checks)
    monkeypatch.setattr(verdict, 'check_rig', lambda rig: [check_of(Kind.ORIENTATION, 'a')])
    request = CalibrationRequest({'a': frames(5)[::-1], 'b': frames(5)}, 'phantom')
    steps = []
    began = time.perf_counter()
    found = verdict.validate(
        request, {}, progress=lambda *step: steps.append(step), rig=Fake(notes=('note',))
    )
    told = [(check.kind, check.place.fluoroscope) for check in found.checks]
    assert told == [
        (Kind.HALVES, 'a'), (Kind.DRIFT, 'a'), (Kind.HALVES, 'b'), (Kind.DRIFT, 'b'),
        (Kind.BEADS, ''), (Kind.ORIENTATION, 'a'),
    ]  # fmt: skip
    assert seen[0] == ('rig', ('a', 'b'), {'a': [1, 3], 'b': [2, 4]})
    assert seen[1:] == [(kind, (name,)) for name in 'ab' for kind in (Kind.HALVES, Kind.DRIFT)]
    assert [(number, total) for _, number, total in steps] == [(n, 5) for n in range(5)]
    assert found.notes == ('note',) and found.verdict == 'pass'
    assert found.achieved_sd_px == {'a': 6, 'b': 6}
    assert 0 <= found.seconds <= time.perf_counter() - began


@pytest.mark.parametrize(('exposures', 'is_told'), [(3, False), (4, True)])
def test_distortions_vary_by_the_residuals_of_four_exposures_of_enough_points(
    monkeypatch, exposures, is_told
):
    ours = {'a': Fake(image_size=SIZE, interior='interior'), 'b': None}
    given, _ = evidence(ours)
    del vars(given)['variations']
    exposure = np.repeat(np.arange(exposures + 1), [MIN_POINTS] * exposures + [MIN_POINTS - 1])
    inliers = Fake(uv='uv', r='r', exposure=exposure)
    vars(given)['trends'] = {'a': Fake(inliers=inliers)}
    monkeypatch.setattr(calibration_evidence, 'exposure_functions', lambda *given: given)
    monkeypatch.setattr(calibration_evidence, 'variation', lambda *given: given)
    found = given._variation('a')
    if is_told:
        assert found == ('r', exposure, ('uv', SIZE, 'interior'))
    else:
        assert found is None
