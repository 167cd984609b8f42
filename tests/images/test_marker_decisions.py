# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Decisions on doubtful ids, exposure by exposure, and the evidence for them."""

from types import SimpleNamespace as Fake

import numpy as np
import pytest
from rigs import true_calibrations, true_orientation

from fluoro_calib_ros.images.marker_decisions import (
    BodyDecisions,
    DecidedView,
    RayDecisions,
    ViewCounts,
    _crossed,
)
from fluoro_calib_ros.images.marker_fit import MarkerMeasurement
from fluoro_calib_ros.images.marker_motion import MarkerStates, MeasuredMarkers, Motion
from fluoro_calib_ros.images.marker_rays import MarkerPlaces, RayFit
from fluoro_calib_ros.images.marker_watch import (
    MarkerCompany,
    MarkerDoubts,
    MarkerWatch,
    follow_beside,
    shift_together,
    velocity_beside,
)
from fluoro_calib_ros.images.shadow_fit import Beads
from fluoro_calib_ros.simulation.rig import virtual_rig

IDS = np.array([3, 5, 8, 11])
PLACES = np.array([[100.0, 100], [200, 100], [300, 300], [400, 100]])
RNG = np.random.default_rng(17)


class Tracker:
    """Doubts of a tracker by id, and the instructions that it received."""

    def __init__(self):
        self.doubts = MarkerDoubts(12)
        self.told = []

    def doubt(self, number, frame):
        self.doubts.add(number, frame)

    def doubted_since(self, number):
        return self.doubts.since(number)

    def partners(self, number):
        return set(self.doubts.partners(number))

    def part(self, one, other):
        self.told.append(('part', one, other))
        self.doubts.part(one, other)

    def confirm(self, number):
        self.told.append(('confirm', number))
        self.doubts.confirm(number)

    def exchange(self, one, other):
        self.told.append(('exchange', one, other))

    def forget(self, number):
        self.told.append(('forget', number))
        self.doubts.confirm(number)

    def doubtful(self):
        return np.flatnonzero(self.doubts.doubtful)


def view():
    return DecidedView(1, 'b', Tracker(), IDS, ViewCounts(len(IDS)))


def exposure(seen, tracker, lack=None, sigma=0.1):
    """Return an exposure as seen by the second of two views."""
    doubtful = np.isin(IDS, tracker.doubtful())
    lack = np.full(4, np.nan) if lack is None else np.asarray(lack, dtype=float)
    return Fake(
        observed=np.stack([np.full((4, 2), np.nan), seen]),
        doubtful=np.stack([np.zeros(4, bool), doubtful]),
        sigma=np.full((2, 4), sigma),
        standardised=np.stack([np.full(4, np.nan), lack]),
    )


def decided(decisions, one, seen, frames, place=PLACES, sd=0.05, sigma=0.1):
    """Return the decisions in exposures that see the same, as (kind, frame, since, ids)."""
    out = []
    for frame in frames:
        found = decisions.decide(
            exposure(seen, one.tracker, sigma=sigma), place, np.full(4, sd), frame
        )
        out += [(d.kind, d.frame, d.since, d.target_id) for d in found]
        assert {d.fluoroscope for d in found} <= {'b'}
    return out


def test_counts_begin_with_the_first_exposure_that_agrees():
    counts = ViewCounts(3)
    assert [counts.agree(1, agrees, frame) for frame, agrees in enumerate([1, 1, 0, 1, 1, 1])] == [
        1,
        2,
        0,
        1,
        2,
        3,
    ]
    assert counts.confirm(1) == 3
    assert counts.agree(1, True, 9) == 1 and counts.confirm(1) == 9
    counts.disagree(np.array([True, False, True]))
    counts.disagree(np.array([True, True]), np.array([0, 1]))
    assert counts.wrong.tolist() == [2, 1, 1]
    counts.clear([0])
    assert counts.wrong.tolist() == [0, 1, 1]
    counts.agree(2, True, 4)
    counts.clear([1, 2])
    assert counts.wrong.tolist() == [0, 0, 0] and counts.agree(2, True, 7) == 1
    assert counts.confirm(2) == 7
    # Exposures before a doubt do not count.
    assert [counts.agree(0, True, frame) for frame in (3, 4)] == [1, 2]
    assert [counts.agree(0, True, frame, began=8) for frame in (9, 10)] == [1, 2]
    assert counts.confirm(0) == 9


def test_an_id_is_confirmed_by_three_exposures_where_its_body_says():
    one = view()
    one.tracker.doubt(5, 20)
    found = decided(BodyDecisions(one), one, PLACES, range(21, 27))
    assert found == [('confirmed', 23, 21, (5,))]
    assert one.tracker.told == [('confirm', 5)]


@pytest.mark.parametrize('began', [None, 18])
def test_an_id_is_dropped_after_three_exposures_elsewhere(began):
    """It is dropped since the doubt began, otherwise since the first of the three."""
    one = view()
    if began:
        one.tracker.doubt(8, began)
    seen = PLACES + (np.arange(4) == 2)[:, None] * [1.6, 0]  # just beyond the limit of 1.5 px
    found = decided(BodyDecisions(one), one, seen, range(21, 24))
    assert found == [('dropped', 23, began or 21, (8,))]
    assert one.tracker.told == [('forget', 8)] and not one.counts.wrong.any()


@pytest.mark.parametrize(
    ('off', 'sd', 'sigma', 'is_doubted'),
    [
        (0.99, 0.0, 0.0, False),
        (1.01, 0.0, 0.0, True),
        (2.24, 0.3, 0.4, False),  # 4.5 deviations of both places
        (2.26, 0.3, 0.4, True),
        (np.nan, 0.0, 0.0, False),
    ],
)
def test_a_place_that_chance_does_not_explain_is_doubted_at_once(off, sd, sigma, is_doubted):
    """After three images in its place, it is confirmed."""
    one = view()
    decisions = BodyDecisions(one)
    seen = PLACES + (np.arange(4) == 0)[:, None] * [0.0, off]
    assert decided(decisions, one, seen, [11], sd=sd, sigma=sigma) == []
    assert one.tracker.doubts.since(3) == (11 if is_doubted else None)
    found = decided(decisions, one, PLACES, range(12, 16), sd=sd, sigma=sigma)
    assert found == ([('confirmed', 14, 12, (3,))] if is_doubted else [])


@pytest.mark.parametrize(
    ('off', 'sd', 'sigma', 'kinds'),
    [
        (0.99, 0.0, 0.0, ['confirmed']),
        (1.01, 0.0, 0.0, []),
        (1.49, 0.0, 0.0, []),
        (1.51, 0.0, 0.0, ['dropped']),
        (1.74, 0.3, 0.4, ['confirmed']),  # 3.5 deviations of both places
        (1.76, 0.3, 0.4, []),
        (2.62, 0.3, 0.4, []),
        (2.63, 0.3, 0.4, ['dropped']),
        (np.nan, 0.0, 0.0, []),
    ],
)
def test_a_marker_is_in_its_place_within_a_pixel_or_its_deviations(off, sd, sigma, kinds):
    one = view()
    one.tracker.doubt(3, 10)
    seen = PLACES + (np.arange(4) == 0)[:, None] * [0.0, off]
    found = decided(BodyDecisions(one), one, seen, range(21, 24), sd=sd, sigma=sigma)
    assert [kind for kind, *_ in found] == kinds


def test_an_id_stays_doubtful_where_another_could_be_as_well():
    for apart, kinds in ((1.4, []), (1.6, ['confirmed'])):
        place = PLACES.copy()
        place[1] = PLACES[0] + [0, apart]
        one = view()
        one.tracker.doubt(3, 10)
        seen = place.copy()
        seen[1] = np.nan
        found = decided(BodyDecisions(one), one, seen, range(21, 24), place)
        assert [kind for kind, *_ in found] == kinds


@pytest.mark.parametrize(('doubted', 'since'), [(None, 23), (21, 23), (24, 24)])
def test_ids_where_the_other_should_be_are_exchanged(doubted, since):
    """The exchange is dated after the last exposure in which one of them was in its place."""
    one = view()
    decisions = BodyDecisions(one)
    assert decided(decisions, one, PLACES, [20, 22]) == []
    if doubted:
        for number in (3, 8):
            one.tracker.doubt(number, doubted)
    found = decided(decisions, one, PLACES[[2, 1, 0, 3]], [25])
    since = 25 if doubted is None else since
    assert found == [('exchanged', 25, since, (3, 8))]
    assert one.tracker.told == [('exchange', 3, 8)] and not one.counts.wrong.any()


@pytest.mark.parametrize(
    ('off', 'pairs'),
    [(0.0, [(0, 2)]), (0.9, [(0, 2)]), (1.1, []), (-60.0, [])],
)
def test_pairs_have_crossed_where_both_are_where_the_other_should_be(off, pairs):
    seen = PLACES[[2, 1, 0, 3]] + [0, off]
    assert _crossed(seen, PLACES, np.ones(4), np.arange(4)) == pairs
    assert _crossed(seen, PLACES, np.ones(4), np.array([1, 3])) == []
    assert _crossed(seen, PLACES, np.ones(4), np.array([0])) == []
    assert _crossed(seen, PLACES, np.ones(4), np.array([2, 0])) == [one[::-1] for one in pairs]


@pytest.mark.parametrize(('apart', 'is_pair'), [(1.4, False), (1.6, True)])
def test_markers_beside_each_other_have_crossed_only_if_they_are_apart(apart, is_pair):
    place = PLACES.copy()
    place[1] = place[0] + [apart, 0]
    seen = place[[1, 0, 2, 3]]
    assert bool(_crossed(seen, place, np.ones(4), np.arange(4))) is is_pair


def test_three_that_change_places_in_a_ring_are_no_pair():
    assert _crossed(PLACES[[1, 2, 0, 3]], PLACES, np.ones(4), np.arange(4)) == []


# ---- rays


def ray_decisions(one, exchanged):
    rays = Fake(exchanged=lambda exposure, view, rows: np.array(exchanged, dtype=float))
    return RayDecisions(one, rays)


def ray_decided(decisions, one, lack, frames, known=(False,) * 4):
    out = []
    for frame in frames:
        given = exposure(PLACES, one.tracker, lack)
        found = decisions.decide(given, np.array(known), frame)
        out += [(d.kind, d.frame, d.since, d.target_id) for d in found]
    return out


@pytest.mark.parametrize(
    ('lack', 'confirmed'), [(3.9, [('confirmed', 27, 20, (5,))]), (4.0, []), (np.nan, [])]
)
def test_an_id_is_confirmed_by_eight_exposures_whose_rays_meet(lack, confirmed):
    one = view()
    one.tracker.doubt(5, 11)
    found = ray_decided(ray_decisions(one, []), one, [0, lack, 0, 0], range(20, 28))
    assert found == confirmed
    one.tracker.doubt(5, 40)
    assert not ray_decided(
        ray_decisions(one, []), one, [0, lack, 0, 0], range(20, 30), (False, True, False, False)
    )


def test_an_id_that_may_be_exchanged_is_not_confirmed_by_its_own_rays():
    """Its partner is not seen in this view, but may have taken its place."""
    one = view()
    one.tracker.doubts.add_pair(5, 11, 12)
    assert not ray_decided(ray_decisions(one, []), one, [0, 0, 0, np.nan], range(20, 30))


@pytest.mark.parametrize(('lack', 'is_doubted'), [(6.0, False), (6.1, True)])
def test_rays_that_do_not_belong_together_are_doubted(lack, is_doubted):
    one = view()
    ray_decided(ray_decisions(one, []), one, [0, 0, lack, np.nan], [20])
    assert one.tracker.doubted_since(8) == (20 if is_doubted else None)
    assert one.counts.wrong.tolist() == [0, 0, int(is_doubted), 0]


def test_two_ids_are_exchanged_or_kept_by_the_sum_of_their_evidence():
    """The evidence of an exposure is the difference of the squares, each at most 50."""

    def of(lack, exchanged):
        one = view()
        one.tracker.doubts.add_pair(3, 11, 12)
        decisions = ray_decisions(one, exchanged)
        return one, ray_decided(decisions, one, [lack[0], 0, 0, lack[1]], range(20, 26))

    one, found = of((1.0, 2.0), (4.0, 3.0))  # 25 - 5 in each exposure
    assert found == [('confirmed', 22, 20, (3,)), ('confirmed', 22, 20, (11,))]
    assert one.tracker.told == [('part', 3, 11)]
    one, found = of((4.0, 3.0), (1.0, 2.0))
    assert found[0] == ('exchanged', 22, 12, (3, 11))
    assert found[1:] == [('confirmed', 22, 22, (3,)), ('confirmed', 22, 22, (11,))]
    assert one.tracker.told == [('exchange', 3, 11), ('part', 3, 11)]
    one, found = of((3.0, 3.0), (9.0, np.nan))  # more than 50 in one exposure
    assert [kind for kind, frame, *_ in found if frame == 20] == ['confirmed', 'confirmed']
    _, found = of((5.0, 5.0), (5.0, 5.0))
    assert found == []


def test_an_id_is_kept_since_the_exchange_was_last_as_likely():
    one = view()
    one.tracker.doubts.add_pair(3, 11, 12)
    told = iter([(5.0, 0.0), (1.0, 0.0), (6.0, 0.0), (6.0, 0.0)])
    decisions = RayDecisions(one, Fake(exchanged=lambda *_: np.array(next(told))))
    found = ray_decided(decisions, one, [2.0, 0, 0, 0], range(20, 24))
    assert [(frame, since) for _, frame, since, _ in found] == [
        (22, 21)
    ] * 2  # the sum of the evidence just exceeds 50: 21 - 3 + 32


def test_an_exposure_in_which_one_of_two_is_something_else_tells_nothing_of_their_exchange():
    """The ids are confirmed since a later exposure."""
    one = view()
    one.tracker.doubts.add_pair(3, 11, 12)
    told = iter([(9.0, 0.0), (30.0, 5.0), (9.0, 0.0)])
    decisions = RayDecisions(one, Fake(exchanged=lambda *_: np.array(next(told))))
    assert not ray_decided(decisions, one, [4.0, 0, 0, 3.0], [20])
    assert not ray_decided(decisions, one, [4.0, 0, 0, 3.0], [21])
    assert ray_decided(decisions, one, [0.0, 0, 0, 0.0], [22]) == [
        ('confirmed', 22, 22, (3,)),
        ('confirmed', 22, 22, (11,)),
    ]


# ---- places of markers


def test_places_are_filled_and_go_on():
    known = np.array([[1.0, 2, 3], [np.nan] * 3])
    other = np.array([[9.0, 9, 9], [4.0, 5, 6]])
    ours = MarkerPlaces(known, np.tile(np.eye(3), (2, 1, 1)))
    theirs = MarkerPlaces(other, np.tile(2 * np.eye(3), (2, 1, 1)))
    filled = ours.filled(theirs)
    assert filled.xyz_mm.tolist() == [[1, 2, 3], [4, 5, 6]]
    assert filled.covariance[:, 0, 0].tolist() == [1, 2]
    assert theirs.filled(ours) is theirs and ours.known.tolist() == [True, False]
    assert ours.filled(MarkerPlaces.nowhere(2)) is ours
    before = MarkerPlaces(filled.xyz_mm - [[3.0, 0, 0], [0, 6, 0]], 4 * filled.covariance)
    moved = filled.moved_on(before, 0.5)
    np.testing.assert_allclose(moved.xyz_mm, [[2.5, 2, 3], [4, 8, 6]])
    # (1 + s)^2 C + s^2 C0, plus a third of the squared motion along each axis.
    np.testing.assert_allclose(moved.covariance[0], (2.25 + 1 + 0.75) * np.eye(3))
    np.testing.assert_allclose(moved.covariance[1], (4.5 + 2 + 3) * np.eye(3))


# ---- motion relative to neighbouring markers


def moving(uv, velocity, sd=0.3, speed_sd=0.1):
    motion = Motion.start(np.array(uv, dtype=float), sd)
    motion.velocity[:] = velocity
    motion.covariance[:, 1, 1] = speed_sd**2
    return motion


def seen_states(motion):
    return MarkerStates.start(motion, np.zeros(len(motion.uv), int))


def test_velocity_is_that_of_the_four_nearest_that_are_known():
    uv = [[0.0, 0], [10, 0], [20, 0], [30, 0], [40, 0], [500, 0]]
    velocity = [[9.0, 9], [1, 0], [2, 1], [3, 0], [4, -1], [50, 0]]
    states = MarkerStates.start(moving(uv, velocity), np.array([5, 0, 1, 0, 0, 0]))
    found, spread = velocity_beside(states, 0)
    assert found.tolist() == [2.5, 0.0] and spread == 1.5
    states.unseen[1] = 2
    assert velocity_beside(states, 0)[0].tolist() == [3.5, 0.0]
    states.motion.unlike[0, 5] = 1.0
    assert velocity_beside(states, 0)[0].tolist() == [3.5, 0.0]  # marker 1 is not seen
    states.motion.covariance[2, 1, 1] = 9.1
    assert velocity_beside(states, 0) is None  # three are left
    assert velocity_beside(states, 5) is None


def test_a_marker_of_unknown_velocity_is_where_those_beside_it_take_it():
    uv = [[0.0, 0], [10, 0], [20, 0], [30, 0], [40, 0]]
    motion = moving(uv, [[1.0, 1], [2, 0], [2, 0], [2, 0], [4, 0]])
    motion.covariance[0, 1, 1] = 36.0
    states = MarkerStates.start(motion, np.zeros(5, int))
    follow_beside(states, 3)
    assert motion.uv[0].tolist() == [3 * (2 - 1), -3] and motion.velocity[0].tolist() == [2, 0]
    np.testing.assert_allclose(motion.covariance[0], 4 * np.eye(2))  # they differ by 2 px
    assert motion.uv[1:].tolist() == uv[1:]
    # A place that has just been given refers to the present image and is not moved.
    motion.covariance[0, 1, 1] = 36.0
    states.placed[0] = 0
    before = motion.uv.copy()
    follow_beside(states, 3)
    assert motion.uv.tolist() == before.tolist()


def test_lost_markers_move_together_to_their_shadows():
    uv = np.array([[0.0, 0], [10, 0], [20, 10], [30, 0], [200, 200]])
    motion = moving(uv, [2.0, 0], sd=12.0)
    motion.covariance[4, 0, 0] = 0.1
    motion.covariance[1, 1, 1] = 36.0
    shift = np.array([12.0, -5.0])
    shift_together(seen_states(motion), Fake(uv=uv[:4] + shift), 4.5, 2)
    np.testing.assert_allclose(motion.uv[:4], uv[:4] + shift, atol=1e-9)
    np.testing.assert_allclose(motion.velocity, [[2, 0], shift / 2, [2, 0], [2, 0], [2, 0]])
    np.testing.assert_allclose(motion.uv[4], uv[4])
    np.testing.assert_allclose(motion.covariance[0], 2.25 * np.eye(2))
    for wide_sd, is_moved in ((10.6, False), (10.7, True)):  # gates just below and above 48 px
        motion = moving(uv, [2.0, 0], sd=wide_sd)
        shift_together(seen_states(motion), Fake(uv=uv + shift), 4.5, 2)
        assert bool(np.allclose(motion.uv, uv + shift)) is is_moved
    motion = moving(uv, [2.0, 0], sd=12.0)
    shift_together(seen_states(motion), Fake(uv=uv[:1] + shift), 4.5, 2)
    np.testing.assert_allclose(motion.uv, uv)


# ---- the watch


def watched(found_uv, free=(), measured=None, unseen=0, variance=0.1, speed_sd=0.1, **changes):
    """Return watch, states, findings and doubts (by row) of neighbouring markers."""
    uv = np.array(changes.pop('uv', PLACES), dtype=float)
    motion = moving(uv, np.zeros(2), np.sqrt(variance), speed_sd)
    states = MarkerStates.start(motion, np.full(4, unseen))
    doubts = MarkerDoubts(4)
    usual = {'gate': 4.5, 'margin': 14.0, 'lost_after': 6, 'density': 1e-5}
    watch = MarkerWatch(IDS, doubts, **{**usual, **changes})
    found = Fake(
        uv=np.array(found_uv, dtype=float),
        shadow=np.array(found_uv, dtype=float),
        free=np.array(free, dtype=float).reshape(-1, 2),
        measured=np.ones(4, bool) if measured is None else np.array(measured),
        sigma=np.full(4, 0.05),
    )
    return watch, states, found, doubts


@pytest.mark.parametrize(
    ('unseen', 'variance', 'is_doubted'),
    [(1, 60.0, False), (2, 60.0, True), (2, 30.0, False), (2, 32.0, True)],
)
def test_a_marker_found_again_in_a_wide_gate_is_doubted(unseen, variance, is_doubted):
    """A gate of 2000 px^2, from a variance of 31.4 px^2, has 0.02 expected false shadows."""
    watch, states, found, doubts = watched(
        PLACES, measured=[True, False, False, False], unseen=unseen, variance=variance
    )
    told = watch.recovered(found, states, 30)
    assert len(told) == is_doubted and doubts.doubtful.tolist() == [is_doubted] + [False] * 3
    if told:
        assert told[0].place.target_id == (3,) and told[0].numbers == {'images': 1}
        assert doubts.since(0) == 30 and watch.recovered(found, states, 31) == ()


@pytest.mark.parametrize(
    ('distance', 'unseen', 'is_doubted'),
    [(26.0, 2, True), (28.0, 2, False), (10.0, 2, True), (10.0, 1, False)],
)
def test_a_marker_found_again_may_be_another_lost_one(distance, unseen, is_doubted):
    """A gate of 1590 px^2 has 0.016 false shadows, and 0.004 of a marker 26.7 px away."""
    watch, states, found, doubts = watched(
        PLACES,
        uv=[PLACES[0], PLACES[0] + [distance, 0], *PLACES[2:]],
        measured=[True, False, False, False],
        unseen=2,
        variance=25.0,
    )
    states.unseen[1] = unseen
    assert len(watch.recovered(found, states, 30)) == is_doubted
    assert doubts.doubtful.tolist() == [is_doubted] + [False] * 3


@pytest.mark.parametrize(
    ('away', 'own', 'is_doubted'), [(1.4, 0.0, True), (1.6, 0.0, False), (1.6, 0.7, True)]
)
def test_a_shadow_beside_a_marker_may_be_its_own(away, own, is_doubted):
    """Squared distances over a variance of 0.1 + 0.25^2 px^2 may differ by 14, that is 1.51 px."""
    watch, states, found, doubts = watched(
        PLACES + (np.arange(4) == 1)[:, None] * [own, 0], free=PLACES[1:2] - [0, away]
    )
    told = watch.other_shadows(found, states, 9)
    assert [one.place.target_id for one in told] == [(5,)] * is_doubted
    assert doubts.partners(1) == ({1} if is_doubted else set())
    assert watch.other_shadows(found, states, 10) == ()
    states.motion.covariance[:, 1, 1] = 36.0
    doubts.confirm(1)
    assert watch.other_shadows(found, states, 11) == ()


def near_pair(apart=1.0):
    uv = PLACES.copy()
    uv[1] = uv[0] + [apart, 0]
    return uv


def test_markers_whose_shadows_met_are_doubted_once_their_velocity_is_known():
    uv = near_pair(0.8)
    for speed_sd, is_doubted in ((0.1, True), (5.0, False)):
        watch, states, found, doubts = watched(uv, uv=uv, speed_sd=speed_sd)
        kept, told = watch.shadows_met(found_frame(found), states, 7)
        assert kept.measured.all() and [one.place.target_id for one in told] == (
            [(3, 5)] if is_doubted else []
        )
        assert doubts.partners(0) == ({1} if is_doubted else set())
        assert watch.shadows_met(found_frame(found), states, 8)[1] == ()
        states.motion.covariance[0, 1, 1] = 36.0
        doubts.confirm(0)
        assert watch.shadows_met(found_frame(found), states, 9)[1] == ()
        states.placed[:2] = 0  # their places are given for this image, to a pixel or two
        assert [one.place.target_id for one in watch.shadows_met(found_frame(found), states, 9)[1]]


@pytest.mark.parametrize(
    ('unseen', 'speed_sd', 'apart', 'kept', 'doubted'),
    [
        (6, 0.1, 1.0, False, False),
        (7, 0.1, 1.0, True, True),
        (7, 5.0, 1.0, True, True),  # one shadow, whatever the velocities
        (6, 5.0, 1.0, False, False),
        (7, 5.0, 5.1, True, False),
    ],
)
def test_one_shadow_of_two_markers_is_taken_back_for_some_images(
    unseen, speed_sd, apart, kept, doubted
):
    uv = near_pair(apart)
    watch, states, found, doubts = watched(
        uv,
        measured=[True, False, True, True],
        unseen=unseen,
        speed_sd=speed_sd,
        uv=uv,
        margin=14.0 if apart < 2 else 1000.0,
    )
    states.unseen[0] = 0
    found_now, _ = watch.shadows_met(found_frame(found), states, 7)
    assert bool(found_now.measured[0]) is kept and not found_now.measured[1]
    assert (1 in doubts.partners(0)) is doubted


def found_frame(found):
    return MeasuredMarkers(
        found.measured,
        found.uv,
        found.shadow,
        sigma=found.sigma,
        depth=np.ones(4),
        overlapped=np.zeros(4, bool),
        free=found.free,
    )


def test_ways_are_compared_over_images_and_begin_anew():
    """The second strange image isolates a marker; 15 px in common confirm it."""
    company = MarkerCompany(3)
    velocity = np.array([[4.0, 0], [4.0, 1.3], [4.0, 1.5]])
    ratio = np.array([7.1, 7.0, 0.0])
    motion = Fake(
        strangeness=lambda measured: (np.arange(3), ratio, np.full((3, 2), [4.0, 0.0])),
        velocity=velocity,
    )
    doubtful = np.array([False, True, True])
    found = [company.compare(motion, None, doubtful, 2) for _ in range(3)]
    # 8 px per image; the differences are 0.33 and 0.38 of the motion.
    assert found == [([], []), ([0], [1]), ([], [])]
    assert company._shared[1].tolist() == [8, 0] and company._own[1].tolist() == [8, 2.6]
    assert company._shared[0].tolist() == [0, 0]
    company = MarkerCompany(3)
    doubtful[0] = True
    assert [company.compare(motion, None, doubtful, 1)[0] for _ in range(3)] == [[], [], []]


# ---- measurements accepted as those of markers


@pytest.mark.parametrize(
    ('changes', 'good'),
    [
        ({}, True),
        ({'sigma': 0.29}, True),
        ({'sigma': 0.31}, False),
        ({'misfit': 9.9}, True),
        ({'misfit': 10.1}, False),
        ({'measured': False}, False),
        ({'depth': 0.81}, True),  # half of 1.6
        ({'depth': 0.79}, False),
        ({'depth': 2.87}, True),
        ({'depth': 2.89}, False),
        ({'off': 3.2}, True),  # 5.5 deviations for 0.1 x 2 + 0.15 + 0.05^2 px^2
        ({'off': 3.3}, False),
    ],
)
def test_fitted_shadows_are_those_of_markers_within_their_limits(changes, good):
    states = MarkerStates.start(moving(PLACES, np.zeros(2), np.sqrt(0.3)), np.zeros(4, int))
    states.depth[:] = 1.6
    uv = PLACES[[2, 0]].copy()
    uv[0] += [0, changes.get('off', 0.0)]
    beads = Beads(
        uv,
        np.array([changes.get('sigma', np.sqrt(0.04)), 0.1]),
        np.array([changes.get('depth', 1.6), 1.6]),
        np.ones(2),
        np.array([changes.get('misfit', 1.0), 1.0]),
        np.zeros(2, bool),
        np.array([changes.get('measured', True), True]),
    )
    measurement = MarkerMeasurement(None, None, gate=4.5, shutter=0.5)
    found = measurement._acceptable(beads, np.array([2, 0]), states)
    assert bool(found[0]) is good


def test_a_marker_without_a_shadow_shares_that_of_the_nearest_one():
    """Both predictions are shifted such that their midpoint is the shadow."""
    motion = moving([[100.0, 100], [104, 100], [130, 100], [300, 300]], np.zeros(2))
    measurement = MarkerMeasurement(Fake(radius_px=3.0, blur_px=1.0), None, gate=4.5, shutter=0.5)
    start = motion.uv.copy()
    start[0], start[2] = [101.0, 102.0], [131.0, 100.0]
    assigned = np.array([True, False, True, False])
    measurement._share_shadows(start, assigned, motion)
    np.testing.assert_allclose(start[:2], [[99, 102], [103, 102]])
    np.testing.assert_allclose(start[2:], [[131, 100], [300, 300]])
    assert assigned.tolist() == [True, True, True, False]
    for change in ('wide', 'far'):
        other = moving([[100.0, 100], [104, 100]], np.zeros(2))
        if change == 'wide':
            other.covariance[1, 0, 0] = 7.1**2
        else:
            other.uv[1, 0] = 108.1
        start = np.array([[101.0, 100], [104, 100]])
        assigned = np.array([True, False])
        measurement._share_shadows(start, assigned, other)
        assert assigned.tolist() == [True, False]


def test_markers_get_shadows_in_their_gates():
    motion = moving(PLACES, np.zeros(2), sd=1.0)
    motion.covariance[1, 0, 0] = 30.0**2
    motion.uv[2] += [4.8, 0]
    states = MarkerStates.start(motion, np.zeros(4, int))
    measurement = MarkerMeasurement(None, None, gate=4.5, shutter=0.5)
    shadows = Fake(uv=np.vstack([PLACES[[3, 1, 0, 2]] + [0.0, 0.5], [[700.0, 700]]]))
    start, assigned, free = measurement._assign(shadows, states)
    assert assigned.tolist() == [True, True, False, True]
    expected = PLACES + np.array([[0, 0.5], [0, 0.5], [4.8, 0], [0, 0.5]])
    np.testing.assert_allclose(start, expected)
    np.testing.assert_allclose(free, [PLACES[2] + [0, 0.5], [700, 700]])


# ---- rays of three views


def test_of_three_rays_a_false_one_is_left_out():
    rig = virtual_rig(1, strength=0.0, names=('a', 'b', 'c'), between_deg=50.0)
    orientation = true_orientation(rig.fluoroscopes, true_calibrations(rig.fluoroscopes))
    xyz = RNG.uniform(-40, 40, (6, 3))
    uv = np.stack([f.ideal(xyz) for f in rig.fluoroscopes])
    uv += RNG.normal(0, 0.1, uv.shape)
    uv[1, 2] += [40.0, 40.0]  # false, one of three rays
    uv[0, 4] = np.nan  # two rays only
    uv[2, 5] = np.nan
    uv[1, 5] += [40.0, 40.0]  # false, one of two rays
    sigma = np.full((3, 6), 0.1)
    sigma[np.isnan(uv[..., 0])] = np.nan
    points, lack = RayFit(orientation).intersect(uv, sigma)
    good = [0, 1, 2, 3, 4]
    assert np.linalg.norm(points.xyz_mm[good] - xyz[good], axis=1).max() < 0.5
    assert np.nanmax(lack[:, [0, 1, 3, 4]]) < 4
    assert lack[1, 2] > 4 and max(lack[0, 2], lack[2, 2]) < 4
    assert np.isnan(lack[0, 4]) and np.isnan(lack[2, 5]) and lack[0, 5] > 4
    assert points.dropped_view.tolist() == [-1, -1, 1, -1, -1, -1]
