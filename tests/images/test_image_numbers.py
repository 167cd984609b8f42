# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Numerical results of parts of extraction and following, for a few points."""

from copy import deepcopy
from itertools import permutations
from types import SimpleNamespace as Fake

import numpy as np
import pytest
from scipy.spatial import cKDTree

from fluoro_calib_ros.findings import Kind
from fluoro_calib_ros.images import extraction
from fluoro_calib_ros.images.growth import (
    Coordinates,
    Match,
    Seen,
    _good_cells,
    _turn_to,
    pairs,
    supported,
)
from fluoro_calib_ros.images.lattice import _basis
from fluoro_calib_ros.images.marker_motion import (
    FIRST_SPEED_PX,
    MAX_SD_PX,
    MODEL_SD_PX,
    UNSTEADY_PX,
    MarkerStates,
    MeasuredMarkers,
    Motion,
    assign,
    common_shift,
    costs,
    doubtful_pairs,
)
from fluoro_calib_ros.images.marker_watch import (
    SHARED_PX,
    MarkerCompany,
    MarkerDoubts,
    follow_beside,
    shift_together,
)
from fluoro_calib_ros.images.measurement import circles
from fluoro_calib_ros.images.profile import Profile
from fluoro_calib_ros.images.view import Lens, View


def view(coefficients=np.zeros((2, 5))):
    lens = Lens((1024, 1024), 2000.0)
    return View(lens, np.eye(3), np.array([0.0, 0.0, -1000.0]), 2000.0, coefficients, 2)


def test_shadow_of_a_sphere_lies_farther_out_than_its_centre():
    """It is an ellipse; its middle is half way between the rays that touch the sphere."""
    sphere = np.array([[300.0, 0.0, 0.0], [0.0, -200.0, 0.0], [0.0, 0.0, 0.0]])
    shift = view().shadow_shift(sphere, np.full(3, 40.0))  # diameter 40 mm, distance 1 m
    for row, (column, away) in enumerate(((0, 300.0), (1, -200.0))):
        angle = np.arctan(away / 1000)
        wide = np.arcsin(20 / np.hypot(away, 1000))
        middle = 1000 * (np.tan(angle + wide) + np.tan(angle - wide))
        assert shift[row, column] == pytest.approx(middle - 2 * away, rel=0.02)
    assert np.abs(shift[[0, 1], [1, 0]]).max() < 1e-6 and np.abs(shift[2]).max() < 1e-9


def test_shadow_is_shifted_where_the_distortion_bends():
    """The shift is r^2 (3 u_xx + u_yy + 2 v_xy) / 8; a stretch of the image causes none."""
    half = 512.0
    stretch = np.array([[5.0, 3, 0, 0, 0], [2.0, -4, 0, 0, 0]])
    bends = np.array([[0.0, 0, 7.0, 0, -2], [0.0, 0, 0, 5.0, 0]])  # x^2, x y, y^2
    middle = np.zeros((1, 3))
    assert np.abs(view(stretch).shadow_shift(middle, np.array([20.0]))).max() < 1e-9
    shift = view(bends).shadow_shift(middle, np.array([20.0]))[0]
    expected = 20.0**2 * (3 * 14 + 2 * -2 + 2 * 5) / half**2 / 8
    assert shift[0] == pytest.approx(expected, rel=0.01) and abs(shift[1]) < 1e-9


def test_border_of_a_shadow_is_where_its_light_changes():
    sharp = Profile(20.0, 0.35, 6.0)
    assert sharp.border_px == pytest.approx(20.0, abs=0.5)
    assert 0 < Profile(20.0, 0.35, 0.1).border_px < sharp.border_px


def seen(uv, shape=(60, 80), radius=2.0):
    return Seen.of(np.asarray(uv, float), np.ones(shape, bool), radius)


def test_field_of_view_is_within_the_image_and_lit():
    one = seen([[1, 1], [5, 5], [9, 9], [20, 20]])
    one.field[10, 30] = False
    places = [[30, 10], [10, 30], [79.4, 59.4], [79.6, 0], [0, 59.6], [-0.6, 5], [np.nan, 5]]
    assert one.in_field(np.array(places)).tolist() == [False, True, True] + [False] * 4
    grid = np.stack(np.meshgrid(np.arange(5) * 20.0, np.arange(5) * 20.0), -1).reshape(-1, 2)
    assert seen(grid).tolerance_px == 4.0
    assert (seen(0.1 * grid).tolerance_px, seen(3 * grid).tolerance_px) == (2.5, 6.0)


def test_predictions_are_paired_with_what_is_nearest():
    one = seen([[10, 10], [20, 10], [50, 50]])
    predicted = np.array([[13.0, 10], [11, 10], [19, 10], [56, 50], [50, 47]])
    rows, found = pairs(predicted, one, np.full(5, 5.0))
    assert dict(zip(rows.tolist(), found.tolist())) == {1: 0, 2: 1, 4: 2}
    assert pairs(predicted, one, np.array([0.5, 2.0, 0.5, 0.5, 0.5]))[0].tolist() == [1]


def test_score_of_a_match_counts_what_is_missing():
    empty = np.zeros(0)
    known = {
        'found': 0.9,
        'apart': 0.9,
        'explained': 1,
        'scale_px': 1,
        'expected': 40,
        'against': 4,
        'evidence': 100,
    }
    one = Match(None, np.arange(30), empty, empty, **known)
    assert one.score == pytest.approx(26)


@pytest.mark.parametrize('ray', [(0.3, -0.2, 1.0), (0.0, 0.0, 2.0), (-0.1, 0.4, 1.0)])
def test_smallest_rotation_takes_the_axis_to_a_ray(ray):
    turn = _turn_to(np.array(ray))
    np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(turn @ [0, 0, 1], ray / np.linalg.norm(ray), atol=1e-12)
    across = np.cross([0, 0, 1], ray)
    np.testing.assert_allclose(turn @ across, across, atol=1e-12)


def test_beads_are_supported_by_most_of_their_neighbours():
    xyz = np.column_stack([np.arange(40.0), np.zeros((40, 2))])
    good = np.arange(40) < 20
    found = supported(xyz, good)
    assert found[:18].all() and not found[22:].any()
    alone = np.zeros(40, bool)
    alone[20] = True
    assert not supported(xyz, alone)[20]


def test_regions_with_few_beads_found_are_bad():
    uv = np.array([[5.0, 5]] * 5 + [[95.0, 5]] * 5 + [[5.0, 55]] * 4 + [[95, 55]] * 5)
    found = np.array([1, 1, 1, 0, 0] + [1, 1, 0, 0, 0] + [0] * 4 + [1] * 5, bool)
    assert _good_cells(uv, found, (60, 100)).tolist() == [True] * 5 + [False] * 5 + [True] * 9


def test_steps_of_a_lattice_are_the_shortest_two_across():
    grid = np.stack(np.meshgrid(np.arange(5) * 3.0, np.arange(5) * 4.0), -1).reshape(-1, 2)
    tree = seen(grid).tree
    found = _basis(grid, tree, 12)
    assert np.abs(found).tolist() == [[3, 0], [0, 4]]
    line = np.column_stack([np.arange(9.0), np.zeros(9)])
    assert _basis(line, seen(line).tree, 4) is None


def beads(**changes):
    n = 6
    values = {
        'uv': np.tile([10.0, 20], (n, 1)),
        'sigma': np.full(n, 0.05),
        'overlapped': np.zeros(n, bool),
        'light': np.full(n, 100.0),
        'depth': np.full(n, 0.3),
        'measured': np.ones(n, bool),
        'misfit': np.zeros(n),
    }
    return Fake(**{**values, **changes})


@pytest.mark.parametrize(
    ('name', 'good', 'bad', 'kind'),
    [
        ('misfit', extraction.MAX_MISFIT, 1.01 * extraction.MAX_MISFIT, extraction.DISTURBED.kind),
        ('sigma', extraction.MAX_SIGMA_PX, 1.01 * extraction.MAX_SIGMA_PX, extraction.HIDDEN.kind),
        ('depth', 1.01 * extraction.DEPTH[0], extraction.DEPTH[0], Kind.BEAD_CONTRAST),
        ('depth', 0.99 * extraction.DEPTH[1], extraction.DEPTH[1], Kind.BEAD_CONTRAST),
        ('measured', True, False, extraction.LOST.kind),
    ],
)
def test_bead_is_refused_at_its_limits(monkeypatch, name, good, bad, kind):
    monkeypatch.setattr(extraction, 'usual_depth', lambda beads: np.ones(6))
    for value, expected in ((good, None), (bad, kind)):
        one = beads(depth=np.ones(6))
        getattr(one, name)[2] = value
        reasons = extraction._reasons(one, one.uv, np.full(6, 2.5))
        assert [r and r.kind for r in reasons] == [None, None, expected, None, None, None]
    away = beads(depth=np.ones(6))
    limit = np.array([2.5, 2.5, 2.5, 9.0, 2.5, 2.5])
    predicted = away.uv + np.outer([0, 2.5, 2.51, 2.51, 0, 0], [0.6, 0.8])
    found = extraction._reasons(away, predicted, limit)
    assert [r is None for r in found] == [True, True, False, True, True, True]
    assert found[2].numbers['off_px'] == pytest.approx(2.51)


def checked(uv, sigma, predicted, sd_px):
    """Return the extraction from beads at uv (n, 2) with predictions (n, 2)."""
    n = len(uv)
    measured = extraction._Measured(
        np.arange(n),
        Fake(uv=uv, sigma=sigma, overlapped=np.zeros(n, bool)),
        [None] * n,
        radius_px=np.ones(n),
        imaging='imaging',
        predicted=Fake(view=None, uv=predicted, sd_px=sd_px),
    )
    return extraction._checked(None, Fake(bead=range(len(uv))), measured)


def test_beads_that_stray_or_are_vague_are_refused_by_the_scatter_of_the_others():
    n = 12
    off = np.full(n, 0.1)
    off[3] = 5.0
    sigma = np.full(n, 0.06)
    sigma[7] = 1.01 * extraction.MAX_SIGMAS * 0.06
    sigma[8] = 0.99 * extraction.MAX_SIGMAS * 0.06
    predicted = np.arange(2.0 * n).reshape(n, 2)
    sd_px = np.linspace(0.06, 0.1, n)
    found = checked(predicted + np.outer(off, [0.6, 0.8]), sigma, predicted, sd_px)
    assert found.bead.tolist() == [k for k in range(n) if k not in (3, 7)]
    assert [refusal.bead for refusal in found.refused] == [3, 7]
    kinds = [refusal.finding.kind for refusal in found.refused]
    assert kinds == [Kind.BEAD_AWAY, Kind.BEAD_UNSURE]
    assert found.refused[0].finding.numbers['off_px'] == pytest.approx(5)
    limit = extraction.RESIDUAL_SIGMAS * np.hypot(sd_px[3], 0.06)
    for part, is_kept in ((0.98, True), (1.02, False)):
        off[3] = part * limit
        found = checked(predicted + np.outer(off, [0.6, 0.8]), sigma, predicted, sd_px)
        assert (3 in found.bead) is is_kept


@pytest.mark.long
def test_chance_of_a_wrong_centre_is_that_of_errors_with_such_a_residual():
    rng = np.random.default_rng(4)
    sigma, scatter = 0.2, 0.12
    error = rng.normal(0, sigma, (4_000_000, 2))
    residual = np.linalg.norm(error - rng.normal(0, scatter, error.shape), axis=1)
    # Beyond the distance that one error in a thousand exceeds.
    is_wrong = np.linalg.norm(error, axis=1) > sigma * np.sqrt(2 * np.log(1000))
    assert is_wrong.mean() == pytest.approx(1e-3, rel=0.1)
    places = np.array([0.3, 0.7, 0.9])
    drawn = [is_wrong[np.abs(residual - place) < 0.01].mean() for place in places]
    told = extraction._chances_of_wrong(places, np.full(3, sigma), np.full(3, scatter))
    np.testing.assert_allclose(told, drawn, rtol=0.1, atol=5e-4)


def test_chance_of_a_wrong_centre_is_that_of_half_a_pixel_where_it_is_known_better():
    (told,) = extraction._chances_of_wrong(np.zeros(1), np.full(1, 0.12), np.full(1, 9.0))
    assert told == pytest.approx(np.exp(-(0.5**2) / (2 * 0.12**2)), rel=0.01)


@pytest.mark.parametrize(
    ('usual', 'scatter', 'is_likely'), [(0.05, 0.3, True), (0.05, 0.1, False), (0.2, 0.3, False)]
)
def test_a_vague_centre_among_sharp_ones_needs_neighbours_that_agree(usual, scatter, is_likely):
    sigma = np.array([0.2, *np.full(6, usual)])
    chance = extraction._chances_of_wrong(np.full(7, 0.2), sigma, np.full(7, scatter))
    assert bool(chance[0] > extraction.WRONG_SHARE) is is_likely


@pytest.mark.parametrize(('scatter', 'is_kept'), [(0.05, False), (0.3, True)])
def test_bead_that_is_likely_half_a_pixel_off_is_not_observed(scatter, is_kept):
    n = 20
    predicted = np.arange(2.0 * n).reshape(n, 2)
    uv = predicted.copy()
    uv[4, 0] += 0.5
    sigma = np.full(n, 0.05)
    sigma[4] = 0.12
    # The residual is within the limit of its own standard deviation.
    assert extraction.RESIDUAL_SIGMAS * np.hypot(0.05, 0.12) > 0.5
    found = checked(uv, sigma, predicted, np.full(n, scatter))
    assert (4 in found.bead) is is_kept and len(found.bead) == n - 1 + is_kept


def test_beads_of_a_line_start_where_they_were_found_alone():
    predicted = np.array([[0.0, 0], [30, 0], [33, 0], [80, 0], [200, 0]])
    outlines = circles(np.array([9.0, 4.5, 4.5, 2.25, 0]))
    view = Fake(outlines=lambda xyz: outlines, principal_distance_px=1.0, depth=lambda xyz: 1.0)
    predicted_by = Fake(
        view=view,
        bead=np.array([0, 1, 3]),
        found=np.array([[1.0, 1], [31, 1], [81, 1]]),
        uv=predicted,
    )
    seen = Fake(radius_px=2.0, in_field=lambda uv: uv[:, 0] < 100)
    found = extraction._expected(predicted_by, seen, Coordinates(None, np.zeros(5)))
    assert found.uv.tolist() == [[1, 1], [30, 0], [33, 0], [81, 1]]
    assert found.seen.tolist() == [True, True, False, True]
    assert found.alone.tolist() == [True, False, False, True]
    np.testing.assert_allclose(found.radius, [2, 1, 1, 0.5])
    # A bead that may be off by more than a radius starts where it was found in any case.
    rough = Coordinates(None, np.full(5, 0.7))
    displaced = extraction._expected(predicted_by, seen, rough)
    assert displaced.uv.tolist() == [[1, 1], [31, 1], [33, 0], [81, 1]]


def identified(places, sd_px, lost=(), undetected=()):
    """Return kinds of reasons against beads measured at their predictions, and others far away."""
    uv = np.array([[place, 0] for place in places] + [[0, 200], [0, 400], [0, 600], [0, 800]])
    n = len(uv)
    measured = extraction._Measured(
        np.arange(n),
        Fake(uv=uv.astype(float)),
        [extraction.LOST if row in lost else None for row in range(n)],
        radius_px=np.ones(n),
        imaging=Fake(profile=Fake(radius_px=6.0)),
        predicted=Fake(uv=uv.astype(float), sd_px=np.full(n, sd_px)),
    )
    reasons = extraction._identified(measured, np.setdiff1d(np.arange(n), undetected)).reasons
    assert reasons[len(places) :] == [None] * 4
    return [r and r.kind for r in reasons[: len(places)]]


def test_a_bead_is_observed_if_it_cannot_be_another_one():
    confused = Kind.BEAD_CONFUSED
    assert identified([0, 100, 200], 5.0) == [None] * 3
    # The first two are as near to each other's predictions as errors of 5 px make likely.
    assert identified([0, 20, 200], 5.0) == [confused, confused, None]
    assert identified([0, 20, 200], 0.5) == [None] * 3
    # With errors of 1.5 px they are identified, but their shadows may overlap.
    assert identified([0, 14, 200], 1.5) == [confused, confused, None]
    assert identified([0, 14, 200], 0.9) == [None] * 3
    # The second one was not measured: it may be 4.5 px from its prediction.
    assert identified([0, 19, 200], 1.5, lost=[1]) == [confused, Kind.BEAD_LOST, None]
    assert identified([0, 19, 200], 1.5) == [None] * 3
    # A fit that does not start at a detection may end beside the shadow.
    assert identified([0, 100, 200], 1.5, undetected=[1]) == [None, confused, None]
    assert identified([0, 100, 200], 0.9, undetected=[1]) == [None] * 3


# ---- markers in motion


def motion(n=6, spread=20.0):
    made = Motion.start(np.arange(2.0 * n).reshape(n, 2) * spread, 1.0)
    made.velocity[:] = [3.0, -1.0]
    made.covariance[:, 1, 1] = 0.01
    return made


def test_prediction_adds_velocity_and_acceleration():
    one = motion()
    one.squared[:] = 4.0
    one.squared[0] = 9.0
    before = one.uv.copy()
    one.covariance[:, 0, 1] = one.covariance[:, 1, 0] = 0.05
    one.predict(2)
    np.testing.assert_allclose(one.uv, before + [6, -2])
    for row, q in ((0, 9.0), (1, 4.0)):
        expected = 1 + 2 * 2 * 0.05 + 4 * 0.01 + q * 4
        assert one.variance[row] == pytest.approx(expected)
        assert one.covariance[row, 0, 1] == pytest.approx(0.05 + 2 * 0.01 + q * 4)
        assert one.covariance[row, 1, 1] == pytest.approx(0.01 + 4 * q)
    still = motion()
    still.squared[:] = 0
    still.predict(1)
    assert still.variance[0] == pytest.approx(1 + 0.01)
    for _ in range(99):
        one.predict(5)
    assert one.variance.max() == pytest.approx(MAX_SD_PX**2)


def test_doubts_are_of_pairs_and_begin_with_the_first():
    doubts = MarkerDoubts(4)
    doubts.add_pair(0, 1, 5)
    doubts.add(0, 9)
    doubts.add(3, 7)
    assert doubts.doubtful.tolist() == [True, True, False, True]
    assert [doubts.since(row) for row in range(4)] == [5, 5, None, 7]
    assert doubts.partners(0) == {0, 1} and doubts.partners(1) == {0}
    doubts.confirm_alone(0)
    doubts.confirm_alone(3)
    assert doubts.doubtful.tolist() == [True, True, False, False]
    doubts.part(1, 0)
    assert doubts.partners(0) == {0} and not doubts.partners(1)
    doubts.add_pair(0, 2, 11)
    doubts.confirm(0)
    assert not doubts.doubtful.any() and doubts.since(2) is None
    doubts.add(2, 12)
    assert doubts.since(2) == 12


def test_marker_that_shares_the_way_of_the_others_is_no_other_shadow():
    """SHARED_PX in common confirm it; one that moves alone is reported after two images."""
    rows = np.arange(3)
    doubtful = np.array([True, False, True])
    ratio = np.array([0.0, 99.0, 0.0])
    others = np.tile([5.0, 0.0], (3, 1))
    velocity = np.array([[5.0, 1], [0, 0], [1, 0]])
    given = Fake(strangeness=lambda measured: (rows, ratio, others), velocity=velocity)
    company = MarkerCompany(3)
    measured = np.ones(3, bool)
    steps = int(SHARED_PX // 10) + 1
    for step in range(1, steps + 1):
        alone, together = company.compare(given, measured, doubtful, 2)
        assert alone == ([1] if step == 2 else [])
        assert together == ([0] if step == steps else [])
    assert company.compare(given, measured, doubtful, 2)[1] == []


def test_marker_of_unknown_velocity_follows_those_beside_it():
    one = motion(7)
    one.covariance[2, 1, 1] = 1e4
    assert one.settled.tolist() == [k != 2 for k in range(7)]
    one.velocity[2] = [50.0, 50.0]
    before = one.uv.copy()
    follow_beside(MarkerStates.start(one, np.ones(7, int)), 2)
    np.testing.assert_allclose(one.uv[2], before[2] + 2 * (np.array([3, -1]) - 50))
    np.testing.assert_allclose(one.velocity[2], [3, -1])
    np.testing.assert_allclose(one.uv[[0, 1, 3, 4]], before[[0, 1, 3, 4]])
    few = motion(4)
    few.covariance[2, 1, 1] = 1e4
    before = few.uv.copy()
    follow_beside(MarkerStates.start(few, np.ones(4, int)), 2)
    assert np.array_equal(few.uv, before)


def two_herds():
    """Return twelve markers of two bodies that move differently, compared for some images."""
    one = motion(12)
    one.velocity[:] = np.where(np.arange(12)[:, None] % 2, [8.0, 0.0], [0.0, 3.0])
    for _ in range(6):
        one.lead(np.ones(12, bool), one.velocity.copy(), np.ones(12, bool))
    return one


def test_marker_that_is_not_seen_follows_those_that_move_alike():
    """It adopts the change of velocity of its own body, not of all markers or unsettled ones."""
    one = two_herds()
    own = np.arange(12) % 2 == 0
    assert (one.together[0, 1:] == 6).all()
    np.testing.assert_allclose(one.unlike[0, 1::2], 64 + 9)
    assert one.unlike[2, 4] == 0 and np.isinf(np.diagonal(one.unlike)).all()
    before = one.velocity.copy()
    one.velocity[own] += [1.0, -2.0]
    one.velocity[~own] += [0.0, 50.0]
    seen = np.ones(12, bool)
    seen[[4, 5, 6]] = False
    one.velocity[[4, 5, 6]] = before[[4, 5, 6]]
    one.covariance[6, 1, 1] = 1e4
    led = one.lead(seen, before, np.ones(12, bool))
    assert np.flatnonzero(led).tolist() == [4, 5]
    np.testing.assert_allclose(one.velocity[4], before[4] + [1.0, -2.0])
    np.testing.assert_allclose(one.velocity[5], before[5] + [0.0, 50.0])
    few = two_herds()
    seen = np.arange(12) < 3
    assert not few.lead(seen, few.velocity.copy(), np.ones(12, bool)).any()


def test_what_moves_alike_is_learned_from_sure_markers():
    """The first squared differences are averaged; later, each image replaces a tenth."""
    one = motion(6)
    sure = np.arange(6) != 5
    squares = []
    for n in range(15):
        one.velocity[0] = [n, 0.0]
        one.velocity[1:] = 0.0
        squares.append(float(n * n))
        one.lead(np.ones(6, bool), one.velocity.copy(), sure)
    expected = 0.0
    for n, square in enumerate(squares, 1):
        share = max(1 / n, 0.1)
        expected = (1 - share) * expected + share * square
    assert one.unlike[0, 1] == one.unlike[1, 0] == pytest.approx(expected)
    assert one.together[0, 5] == 0 and one.unlike[0, 5] == FIRST_SPEED_PX**2


def test_marker_that_leaves_its_body_is_strange():
    one = two_herds()
    one.velocity[3] += [6.0, 0.0]
    rows, ratio, others = one.strangeness(np.arange(12) != 7)
    assert rows.tolist() == [k for k in range(12) if k != 7]
    np.testing.assert_allclose(others, np.where(rows[:, None] % 2, [8.0, 0.0], [0.0, 3.0]))
    usual = np.zeros(11)
    np.testing.assert_allclose(ratio[rows == 3], 36 / UNSTEADY_PX**2)
    np.testing.assert_allclose(ratio[rows != 3], usual[rows != 3], atol=1e-12)
    assert not len(one.strangeness(np.arange(12) < 4)[0])
    # Markers that were compared in too few images are not judged.
    one.together[:] = 4
    assert (one.strangeness(np.ones(12, bool))[1] == 0).all()


def test_places_are_taken_in_as_by_a_kalman_filter():
    one = motion(2)
    one.covariance[:] = [[2.0, 0.3], [0.3, 0.5]]
    before = np.stack([one.uv, one.velocity], axis=1)
    uv = one.uv[[1]] + [1.0, -2.0]
    one.update(np.array([1]), uv, np.array([0.4]), 2)
    h = np.array([[1.0, 0.0]])
    p = np.array([[2.0, 0.3], [0.3, 0.5]])
    noise = 0.4**2 + MODEL_SD_PX**2
    gain = p @ h.T / (h @ p @ h.T + noise)
    expected = before[1] + gain @ (uv - before[1, :1])
    np.testing.assert_allclose(np.stack([one.uv[1], one.velocity[1]]), expected)
    np.testing.assert_allclose(one.covariance[1], p - gain @ h @ p)
    np.testing.assert_allclose(one.uv[0], before[0, 0])
    fresh = motion(2)
    square = (1 + 4) / 2 / 2**4 - 0.4**2
    assert one.squared[1] == pytest.approx(0.9 * fresh.squared[1] + 0.1 * max(square, 0))


def test_shadows_are_assigned_at_the_largest_likelihood():
    """The reference is the best of all permutations; as many markers as possible get a shadow."""
    rng = np.random.default_rng(4)
    uv = rng.uniform(0, 20, (5, 2))
    found = uv[[2, 0, 4, 1]] + rng.normal(0, 2.0, (4, 2))
    variance = rng.uniform(1, 9, 5)
    square = np.sum((uv[:, None] - found) ** 2, axis=2)
    cost = square / variance[:, None] + 2 * np.log(variance)[:, None]
    np.testing.assert_allclose(costs(uv, variance, found), cost)
    rows, columns = assign(uv, variance, found, 50.0)
    best = min(permutations(range(5), 4), key=lambda order: cost[list(order), range(4)].sum())
    assert dict(zip(columns.tolist(), rows.tolist())) == dict(enumerate(best))
    rows, columns = assign(uv, variance, found, 1.0)
    assert (square[rows, columns] < variance[rows]).all()
    assert not len(assign(uv, variance, np.zeros((0, 2)), 3.0)[0])


def test_markers_vote_for_a_shift_in_common():
    """Most neighbours find a shadow at the common shift; of two such shifts the smaller wins."""
    uv = np.array([[100.0, 100.0], [120, 100], [100, 130], [140, 140], [170, 90]])
    beside = np.array([1, 2, 3, 4])
    others = np.array([[104.0, 96.0], [500, 500]])

    def shift(places):
        return common_shift(uv, 0, beside, cKDTree(np.concatenate([places, others])), 30.0)

    np.testing.assert_allclose(shift(uv + [12.0, 5.0]), [12.0, 5.0])
    np.testing.assert_allclose(shift((uv + [12.0, 5.0])[[0, 1, 3]]), [12.0, 5.0])
    assert shift((uv + [12.0, 5.0])[[0, 1]]) is None
    assert common_shift(uv, 0, beside, cKDTree(others[1:]), 30.0) is None
    both = np.concatenate([uv + [12.0, 5.0], uv - [5.0, 0.0]])
    np.testing.assert_allclose(shift(both), [-5.0, 0.0])


def test_pairs_of_markers_are_doubtful_where_an_exchange_is_as_likely():
    uv = np.array([[0.0, 0.0], [3.0, 0.0], [40.0, 0.0], [6.0, 0.0]])
    variance = np.full(4, 4.0)
    measured = np.array([True, True, True, False])
    found = uv + [[1.0, 0], [-1.0, 0], [0, 0], [0, 0]]
    pairs = doubtful_pairs(uv, variance, measured, found, 1.6)
    # The exchange costs 2 (2^2 - 1^2) / 4 more.
    assert pairs.tolist() == [[0, 1]]
    assert doubtful_pairs(uv, variance, measured, found, 1.4).tolist() == []
    # The second shadow may be that of the fourth marker: (4^2 - 1^2) / 4 more.
    assert doubtful_pairs(uv, variance, measured, found, 3.9).tolist() == [[0, 1], [1, 3]]


def test_states_of_markers_are_exchanged_and_taken_in_together():
    states = MarkerStates.start(two_herds(), np.arange(12))
    states.depth[:] = np.arange(12.0)
    before = deepcopy(states)
    states.exchange(2, 5)
    order = np.arange(12)
    order[[2, 5]] = [5, 2]
    for name in ('uv', 'velocity', 'covariance', 'squared'):
        np.testing.assert_array_equal(
            getattr(states.motion, name), getattr(before.motion, name)[order]
        )
    for name in ('unlike', 'together'):
        np.testing.assert_array_equal(
            getattr(states.motion, name), getattr(before.motion, name)[np.ix_(order, order)]
        )
    np.testing.assert_array_equal(states.depth, order)
    np.testing.assert_array_equal(states.unseen, order)
    measured = np.arange(12) < 3
    overlapped = np.arange(12) == 1
    states.depth_sd[0] = 0.1
    found = MeasuredMarkers(
        measured,
        states.motion.uv + 1,
        states.motion.uv + 1,
        sigma=np.full(12, 0.2),
        depth=np.full(12, 4.0),
        overlapped=overlapped,
        free=np.zeros((0, 2)),
    )
    states.advance(1, None)
    states.update(found, 1)
    assert states.unseen.tolist()[:4] == [0, 0, 0, 4]
    np.testing.assert_allclose(states.depth[:3], [0.9 * 0 + 0.1 * 4.0, 1.0, 4.0])
    assert states.depth_sd[1] == 1.0 and states.depth_sd[2] < 0.2


def test_lost_markers_are_shifted_together_with_the_velocity_that_they_have():
    """If their velocity is unknown, they get that of the shift; sure markers stay in place."""
    one = motion(6)
    one.uv[:] = [[100.0, 100], [130, 100], [100, 140], [150, 150], [120, 170], [400, 400]]
    one.covariance[:4, 0, 0] = 17.0**2  # lost
    one.covariance[0, 1, 1] = 1e4  # and of unknown velocity
    one.covariance[4:, 0, 0] = 0.01
    one.velocity[:] = [2.0, 1.0]
    before = one.uv.copy()
    shift = np.array([8.0, -6.0])
    shift_together(MarkerStates.start(one, np.ones(6, int)), Fake(uv=before[:5] + shift), 3.0, 2)
    np.testing.assert_allclose(one.uv[:4], before[:4] + shift)
    np.testing.assert_allclose(one.velocity[0], shift / 2)
    np.testing.assert_allclose(one.velocity[1:], np.tile([2.0, 1.0], (5, 1)))
    np.testing.assert_allclose(one.uv[4:], before[4:])
    still = motion(6)
    shift_together(MarkerStates.start(still, np.ones(6, int)), Fake(uv=before + shift), 3.0, 2)
    np.testing.assert_allclose(still.velocity, motion(6).velocity)


def test_a_marker_among_those_of_another_bone_is_shifted_with_its_own():
    """The bones overlap: the four nearest markers belong to the other bone."""
    own = np.array([[100.0, 100], [130, 80], [60, 120], [110, 150], [90, 60]])
    other = np.array([[112.0, 101], [89, 97], [103, 113], [98, 86]])
    start = Motion.start(np.concatenate([own, other]), 4.0)
    states = MarkerStates.start(start, np.ones(9, int))
    shift = np.array([7.0, -4.0])
    shift_together(states, Fake(uv=np.concatenate([own + shift, other - [5, 9]])), 4.5, 1)
    np.testing.assert_allclose(start.uv[0], own[0] + shift)
    np.testing.assert_allclose(start.velocity[0], shift)
