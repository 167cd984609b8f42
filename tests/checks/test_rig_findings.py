# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Findings on the rig of two fluoroscopes, from given poses."""

from types import SimpleNamespace as Fake

import numpy as np
import pytest
from rigs import kinds

from fluoro_calib_ros.checks import rig
from fluoro_calib_ros.checks.rig import (
    NOT_ORIENTED,
    ORIENTED,
    RigFindings,
    check_rig,
    doubtful,
    interchanged,
    rig_findings,
)
from fluoro_calib_ros.errors import DataError
from fluoro_calib_ros.estimation.pair_scatter import PairScatter
from fluoro_calib_ros.exposures.frame import Frame
from fluoro_calib_ros.findings import Finding, Kind, Place, Severity
from fluoro_calib_ros.photogrammetry.rotations import (
    matrix_from_vector,
    quaternion_from_matrix,
)

RNG = np.random.default_rng(7)
TURN = matrix_from_vector(np.array([0.1, 1.0, -0.2]))  # from sensor to sensor
BASE_MM = np.array([900.0, 50.0, 600.0])  # second source in the frame of the first sensor


def poses(numbers, shifts_mm=0.0, turns_rad=0.0):
    """Results of two fluoroscopes; the second is shifted and rotated per exposure."""
    one, other = [], []
    shifts_mm = np.broadcast_to(shifts_mm, (len(numbers),))
    turns_rad = np.broadcast_to(turns_rad, (len(numbers),))
    for number, shift, turn in zip(numbers, shifts_mm, turns_rad):
        r = matrix_from_vector(RNG.normal(0, 0.5, 3))
        t = RNG.normal(0, 300, 3)
        second = matrix_from_vector(np.array([turn, 0.0, 0.0])) @ TURN @ r
        there = t + r.T @ (BASE_MM + [shift, 0, 0])
        for results, rotation, position in ((one, r, t), (other, second, there)):
            quaternion = quaternion_from_matrix(rotation)
            results.append(Fake(exposure=number, position_mm=position, quaternion_wxyz=quaternion))
    return Fake(exposures=tuple(one)), Fake(exposures=tuple(other))


def swapped(one, other, numbers):
    """Poses whose frames are interchanged in some exposures."""
    pairs = [
        (b, a) if a.exposure in numbers else (a, b) for a, b in zip(one.exposures, other.exposures)
    ]
    return tuple(Fake(exposures=tuple(side)) for side in zip(*pairs))


def test_interchanged_frames_are_named_by_their_exposures():
    one, other = poses(range(10, 18))
    assert interchanged(('a', 'b'), one, other) is None
    found = interchanged(('a', 'b'), *swapped(one, other, (11, 16)))
    assert found.kind is Kind.FLUOROSCOPES_INTERCHANGED
    assert (found.place.fluoroscopes, found.place.exposures) == (('a', 'b'), (11, 16))
    # A single distant pair is a different case, and two pairs show nothing.
    shifts = np.zeros(8)
    shifts[3] = 900.0
    assert interchanged(('a', 'b'), *poses(range(8), shifts)) is None
    assert interchanged(('a', 'b'), *swapped(*poses((1, 2)), (2,))) is None


# ---- scatter of pairs


def scatter(count=8, names=('a', 'b'), off_px=4.0, unexplained=3.0, steps=()):
    """Pairs of a rig whose second fluoroscope moves permanently by steps {index: (mm, rad)}."""
    shift = np.tile(BASE_MM, (count, 1)) + RNG.normal(0, 0.05, (count, 3))
    angle = np.zeros(count)
    for index, (mm, rad) in dict(steps).items():
        shift[index:, 1] += mm
        angle[index:] += rad
    turn = matrix_from_vector(angle[:, None] * np.array([0.0, 0, 1])) @ TURN
    return PairScatter(
        names,
        exposures=np.arange(count) + 21,
        off_px=np.full(count, off_px),
        off_sd=np.full(count, 3.0),
        used=np.ones(count, bool),
        growth=unexplained,
        unexplained=unexplained,
        angle_px=0.0,
        columns=np.ones((count, 1)),
        corrected=False,
        turn=turn,
        shift_mm=shift,
    )


def shuffled(pairs):
    """The same pairs in a different order."""
    order = RNG.permutation(len(pairs.exposures))
    names = ('exposures', 'off_px', 'off_sd', 'used', 'columns', 'turn', 'shift_mm')
    changed = {name: getattr(pairs, name)[order] for name in names}
    return PairScatter(**{**vars(pairs), **changed})


def test_rig_that_was_moved_once_is_told_with_its_move():
    moved = scatter(steps={3: (7.0, np.deg2rad(0.5))})
    for pairs in (moved, shuffled(moved)):
        usable, (found,) = doubtful(pairs, 1000, 0.3)
        assert found.kind is Kind.RIG_MOVED and usable
        assert found.place.exposures == (23, 24)
        assert '7.0 mm and 0.50 degrees' in found.cause
    for pairs in (
        scatter(),
        scatter(5, steps={3: (7.0, 0.01)}),
        scatter(steps={2: (7.0, 0.01), 4: (-7.0, -0.01), 6: (7.0, 0.01)}),
    ):
        _, (found,) = doubtful(pairs, 1000, 0.3)
        assert found.kind is Kind.PAIRS_CONTRADICT and found.place.exposures == ()


def test_size_of_displacements_is_a_number_a_range_or_a_bound():
    assert rig._size(np.array([2.0, 2.04])) == '2.0 px'
    assert rig._size(np.array([0.036, 0.04])) == '0.036 px'
    assert rig._size(np.array([3.5, 2.0])) == '2.0 to 3.5 px'
    assert rig._size(np.array([2.0, np.inf])) == '2.0 px and more'
    assert rig._size(np.array([np.inf])) == 'more than the image shows'


def finding(kind, names=('a', 'b'), cause='why', **numbers):
    return Finding(
        kind, cause, Place(names, name=ORIENTED), severity=Severity.WARNING, numbers=numbers
    )


def test_check_of_a_rig_is_the_scatter_of_each_pair_against_noise_and_prediction():
    """A fault of one pair is reported for that pair only."""
    first = scatter(off_px=4.0, unexplained=2.5)
    second = scatter(names=('a', 'c'), off_px=0.4, unexplained=0.8)
    first.used[0] = False
    first.off_px[0] = 1e3
    doubts = (
        finding(Kind.RIG_DEPENDS_ON_ANGLE, cause='angle'),
        finding(Kind.RIG_MOVED, cause='moved'),
    )
    given = RigFindings(('a', 'b', 'c'), None, doubts, (first, second), noise_px=0.3)
    of_b, of_c = check_rig(given)
    assert (of_b.value, of_b.cause, of_b.advice) == (4.0, 'moved', '')
    assert of_b.limit == pytest.approx(2 * 4.0 / 2.5) and not of_b.passed
    assert of_b.numbers == {'ratio': 2.5, 'noise_px': 0.3}
    assert (of_c.value, of_c.limit) == (0.4, 0.8) and of_c.passed
    assert of_c.place == Place(('a', 'c'), name=ORIENTED)
    assert '0.400 px, 0.8 times' in of_c.cause and of_c.advice == rig.CAPTURE
    (of_b, _) = check_rig(
        RigFindings(
            ('a', 'b', 'c'),
            None,
            (finding(Kind.PAIRS_CONTRADICT),),
            (first, second),
            noise_px=9.0,
        )
    )
    assert (of_b.cause, of_b.advice, of_b.limit) == ('why', rig.CAPTURE, 9.0)


def test_targets_behind_the_source_of_a_pair_fail_the_check():
    for off_px in (400.0, np.inf):
        pairs = scatter(off_px=off_px, unexplained=1758.0)
        usable, (doubt,) = doubtful(pairs, 1000, 0.25, 0.1)
        assert not usable and doubt.kind is Kind.PAIRS_CONTRADICT
        assert ('more than the image shows' in doubt.cause) == np.isinf(off_px)
        (check,) = check_rig(RigFindings(('a', 'b'), None, (doubt,), (pairs,), noise_px=0.25))
        assert check.passed is False and check.value == off_px and check.limit < 1


def test_check_of_a_rig_without_orientation_cannot_tell():
    (check,) = check_rig(RigFindings(('a', 'b'), None, (finding(Kind.RIG_NOT_ORIENTED),)))
    assert np.isnan([check.value, check.limit]).all() and check.passed is None
    assert check.unit == '' and check.advice == rig.CAPTURE
    assert check_rig(RigFindings()) == []


def test_notes_are_what_no_check_has_decided():
    doubts = tuple(
        map(finding, (Kind.PAIRS_EXCLUDED, Kind.PAIRS_CONTRADICT, Kind.RIG_DEPENDS_ON_ANGLE))
    )
    trusted = (finding(Kind.TAKEN_ON_TRUST),)
    found = RigFindings(('a', 'b'), None, doubts, trusted=trusted).notes
    assert kinds(found) == [
        Kind.PAIRS_EXCLUDED,
        Kind.RIG_DEPENDS_ON_ANGLE,
        Kind.TAKEN_ON_TRUST,
    ]


# ---- a rig as a whole


def stamped(number, stamp_ns, u):
    uv = np.column_stack([np.arange(10.0) * 30 + u, np.arange(10.0) * 20])
    return Frame('a', number, np.arange(10), uv, (1000, 800), stamp_ns=stamp_ns)


def findings_of(monkeypatch, scatters, figures=None, delay_ns=0, known=(), correction_sd=0.01):
    """Findings on three fluoroscopes whose pairs scatter as given."""
    names = ('a', 'b', 'c')[: len(scatters) + 1] if isinstance(scatters, list) else ('a', 'b')
    asked = {}

    def orientation_and_scatter(frames, phantom, calibrations, starts):
        asked.update(frames=list(frames), phantom=phantom, starts=starts)
        if isinstance(scatters, DataError):
            raise scatters
        return 'orientation', tuple(scatters)

    monkeypatch.setattr(rig, 'orientation_and_scatter', orientation_and_scatter)
    monkeypatch.setattr(rig, 'orientation_of_known', lambda *given: given)
    calm = poses(range(6))[0]
    frames = {
        name: [stamped(n, 1000 * n + (delay_ns if i else 0), 5.0 * n) for n in range(1, 7)]
        for i, name in enumerate(names)
    }
    calibrations = {
        name: Fake(
            image_sd=0.2 + 0.1 * i,
            image_size=(1000, 800),
            correction=lambda uv, angle: Fake(sd=np.full(len(uv), correction_sd)),
        )
        for i, name in enumerate(names)
    }
    result = Fake(
        fluoroscopes=figures or dict.fromkeys(names[:1], calm), calibrations='c', starts='s'
    )
    request = Fake(known_orientations=dict.fromkeys(known), phantom='p')
    return rig_findings(request, result, frames, calibrations), asked


def test_orientation_of_a_rig_comes_from_pairs_that_agree(monkeypatch):
    pairs = [scatter(unexplained=1.2), scatter(names=('a', 'c'), off_px=0.3)]
    found, asked = findings_of(monkeypatch, pairs)
    assert found.orientation == 'orientation' and found.doubts == ()
    assert found.fluoroscopes == ('a', 'b', 'c') and found.noise_px == 0.4
    assert asked == {'frames': ['a', 'b', 'c'], 'phantom': 'p', 'starts': 's'}
    assert found.scatter == tuple(pairs) and found.trusted == ()
    found, _ = findings_of(monkeypatch, pairs, delay_ns=120)  # 5 px in 1000 ns
    assert [one.numbers['moved_px'] for one in found.trusted] == pytest.approx([0.6, 0.6])
    assert {one.severity for one in found.trusted} == {Severity.WARNING}


def test_rig_of_which_one_pair_is_useless_has_no_orientation(monkeypatch):
    useless = scatter(names=('a', 'c'), off_px=9.0, unexplained=12.0)
    doubted = scatter(off_px=2.0, unexplained=3.0)
    found, _ = findings_of(monkeypatch, [doubted, useless])
    assert found.orientation is None
    assert [one.place.fluoroscopes for one in found.doubts] == [('a', 'c')]
    found, _ = findings_of(monkeypatch, [doubted])
    assert found.orientation == 'orientation' and len(found.doubts) == 1


@pytest.mark.parametrize(('correction_sd', 'is_doubted'), [(0.55, True), (0.56, False)])
def test_scatter_within_the_deviation_of_the_corrections_is_no_contradiction(
    monkeypatch, correction_sd, is_doubted
):
    """The limit is twice 2.1 / 3 px, as predicted for the pairs, and both corrections."""
    pairs = [scatter(off_px=2.1, unexplained=3.0)]
    found, _ = findings_of(monkeypatch, pairs, correction_sd=correction_sd)
    assert bool(found.doubts) is is_doubted
    (check,) = check_rig(found)
    assert check.passed is not is_doubted
    assert check.limit == pytest.approx(2 * np.sqrt(0.7**2 + 2 * correction_sd**2))


@pytest.mark.parametrize(('off_px', 'text'), [(0.036, ' 0.036 px'), (4.04, ' 4.0 px')])
def test_a_difference_that_matters_does_not_read_zero(off_px, text):
    _, (found,) = doubtful(scatter(off_px=off_px), 1000, 0.02)
    assert text in found.cause and '3.0 times' in found.cause


def test_rig_without_pairs_says_why(monkeypatch):
    found, _ = findings_of(monkeypatch, DataError('too few'))
    (doubt,) = found.doubts
    assert found.orientation is None and doubt.kind is Kind.RIG_NOT_ORIENTED
    assert doubt.cause == f'{NOT_ORIENTED}: too few' and found.noise_px == pytest.approx(0.3)


def test_known_orientations_are_taken_where_all_are_known(monkeypatch):
    found, asked = findings_of(monkeypatch, [scatter(unexplained=1.0)], known='ab')
    assert found.fluoroscopes == () and not asked
    known, figures, calibrations = found.orientation
    assert (list(known), list(figures), calibrations) == (['a', 'b'], ['a'], 'c')
    found, asked = findings_of(monkeypatch, [scatter(unexplained=1.0)], known='a')
    assert found.orientation == 'orientation' and asked
    assert findings_of(monkeypatch, [])[0] == RigFindings()
