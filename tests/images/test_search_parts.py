# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Parts of the search for phantoms and markers against written-out formulas."""

from types import SimpleNamespace as Fake

import cv2
import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from fluoro_calib_ros.errors import DataError
from fluoro_calib_ros.findings import Kind
from fluoro_calib_ros.images import growth, pose_search
from fluoro_calib_ros.images.clipping import UNCLIPPED
from fluoro_calib_ros.images.detection import PIXELS_AT_ONCE, responses
from fluoro_calib_ros.images.growth import (
    Coordinates,
    Seen,
    _good_cells,
    _judged,
    _Kriging,
    _noise_share,
    _scale,
    pairs,
    start_view,
    supported,
)
from fluoro_calib_ros.images.lattice import FlatGrid, _view
from fluoro_calib_ros.images.marker_fit import _MarkerFit
from fluoro_calib_ros.images.marker_intensity import LightWindows, Shadows, check_image
from fluoro_calib_ros.images.marker_motion import GIVEN_SD_PX, MeasuredMarkers, Motion
from fluoro_calib_ros.images.marker_watch import MarkerDoubts, MarkerWatch
from fluoro_calib_ros.images.pose_search import (
    LocalPose,
    _chances,
    _rotation,
    _solutions,
    _votes,
    enough_seeds,
    nearby_map,
    neighbours_of,
    triples_of,
)
from fluoro_calib_ros.images.view import Lens

BEADS = np.random.default_rng(1).uniform(-50, 50, (24, 3))
LENS = Lens((1024, 1024), 4000.0)


# ---- triples of beads


def test_triples_are_a_bead_and_two_of_its_neighbours():
    triples = triples_of(BEADS, 3)
    _, near = cKDTree(BEADS).query(BEADS, k=13)  # 12 neighbours vote: half of the beads
    for row in range(0, len(triples.bead), 7):
        one, two, three = triples.bead[row]
        assert {two, three} <= set(near[one, 1:4].tolist()) and two != three
        a, b = BEADS[two] - BEADS[one], BEADS[three] - BEADS[one]
        np.testing.assert_array_equal(triples.sides[row], [a, b])
        inner = [a @ a, b @ b, a @ b, np.sum(np.cross(a, b) ** 2)]
        np.testing.assert_allclose(triples.products[:, row], inner)
        assert inner[3] > 0.3**2 * inner[0] * inner[1]
        axes = np.stack([a, b, np.cross(a, b)])
        others = BEADS[near[one, 1:]] - BEADS[one]
        np.testing.assert_allclose(triples.voter[..., row] @ axes, others, atol=1e-3)
    # Three neighbours form six ordered pairs; those that are nearly collinear are dropped.
    assert 0.8 * 6 * len(BEADS) < len(triples.bead) <= 6 * len(BEADS)
    chosen = np.arange(len(BEADS)) < 2
    assert set(triples.of_beads(chosen).bead[:, 0].tolist()) == {0, 1}


def test_voters_in_one_plane_tell_no_mirrored_pose():
    sheet = np.array([(x, y, 0.0) for x in range(5) for y in range(5)]) * 10
    assert triples_of(sheet, 4).planar.all()
    rough = sheet + np.random.default_rng(5).uniform(0, 0.4, (25, 1)) * [0, 0, 1]
    triples = triples_of(rough, 4)
    _, near = cKDTree(rough).query(rough, k=13)
    for row, (a, b) in enumerate(triples.sides):
        normal = np.cross(a, b) / np.linalg.norm(np.cross(a, b))
        height = np.abs(
            (rough[near[triples.bead[row, 0], 1:]] - rough[triples.bead[row, 0]]) @ normal
        )
        shorter = min(np.linalg.norm(a), np.linalg.norm(b))
        assert triples.planar[row] == (height.max() < 0.1 * shorter)
    assert 0.1 < triples.planar.mean() < 0.9


def test_three_beads_give_the_scale_and_the_rotation():
    triples = triples_of(BEADS, 4)
    for number in range(0, len(triples.bead), 9):
        turn = Rotation.random(random_state=number).as_matrix()
        p, q = 3.5 * triples.sides[number] @ turn[:2].T
        row, axes, scale = _solutions(p, q, triples, (3.0, 4.0))
        if not len(row):  # nearly collinear in the image
            assert abs(p[0] * q[1] - p[1] * q[0]) <= 0.2 * np.hypot(*p) * np.hypot(*q)
            continue
        assert ((scale > 3) & (scale < 4)).all()
        own = np.flatnonzero(row == number)
        np.testing.assert_allclose(scale[own], 3.5)
        found = [_rotation(triples.sides[number], axes[one], 3.5) for one in own]
        assert len(found) == 2 and min(np.abs(one - turn).max() for one in found) < 1e-3
        # Both solutions have the same image of the three beads.
        for one in found:
            np.testing.assert_allclose(
                3.5 * triples.sides[number] @ one[:2].T, [p, q], rtol=1e-3, atol=1e-2
            )
        assert not len(_solutions(p, q, triples.of_beads(np.zeros(24, bool)), (3.0, 4.0))[0])
        assert number not in _solutions(p, q, triples, (3.6, 4.0))[0]
        assert number not in _solutions(p, q, triples, (3.0, 3.4))[0]
    assert not len(_solutions(np.array([9.0, 0]), np.array([9.0, 1.7]), triples, (0.0, 9.0))[0])


def test_votes_are_shares_of_the_voters_in_the_field():
    hits, inside = np.array([5, 5, 5]), np.array([10, 8, 2])
    np.testing.assert_allclose(_votes(hits, inside, 10), [0.5, 5 / 8, 5 / 6])


def test_neighbours_in_several_directions_come_before_nearer_ones():
    line = [(u, 0.0) for u in (0, 1, 2, -1.5, 3, 4, -5, 6)]
    away = [(1.0, 9.0), (-1.0, 10.0), (1.5, -11.0), (-1.5, -12.0), (2.0, 9.5)]
    uv = np.array(line + away)
    first, _ = neighbours_of(uv, np.array([0, 8]), 6)
    # There is one in each sector of 60 degrees, beginning with that of the nearest neighbour.
    np.testing.assert_array_equal(first, [1, 3, 8, 9, 10, 11])
    # If a sector is empty, the nearest of the others follow.
    np.testing.assert_array_equal(neighbours_of(uv[:8], np.array([0]), 6)[0], [1, 3, 2, 4, 5, 6])
    assert set(neighbours_of(uv[:3], np.array([1]), 6)[0].tolist()) == {0, 2}


def test_a_bead_is_not_its_own_neighbour_where_another_one_is_at_its_place():
    uv = np.array([(0.0, 0.0), (0.0, 0.0), (1.0, 0.0), (0.0, 2.0)])
    for row in range(4):
        assert row not in neighbours_of(uv, np.array([row]), 3)[0]


def test_what_is_near_a_bead_is_marked():
    uv = np.array([[10.4, 5.0], [1.6, 18.0], [30.0, 3.0], [3.0, -1.0], [20.0, 3.0]])
    near = nearby_map(uv, (20, 19), 2.2)
    v, u = np.mgrid[:19, :20]
    far = np.min([np.hypot(u - 10, v - 5), np.hypot(u - 2, v - 18)], axis=0)
    np.testing.assert_array_equal(near, far <= 2.2)
    assert near.dtype == np.uint8


@pytest.mark.parametrize('neighbours', [(2, 4), (4, 2)])
def test_a_search_is_sure_where_all_neighbours_are_a_bead_s_own(monkeypatch, neighbours):
    monkeypatch.setattr(pose_search, 'MIN_FOUND', 1.1)
    five = 50 * np.array([(0, 0, 0), (1, 0, 0), (0, 1.1, 0), (0, 0, 1.2), (1, 1.3, 1)])
    chance = _chances(five, 1.0, 1e-3, neighbours)
    np.testing.assert_array_equal(chance, np.ones(pose_search.VIEWS))
    # 1 / 2^10 is below the limit of 1 / 1000.
    assert enough_seeds(five, 5, 1e-3, neighbours) == 5
    monkeypatch.setattr(pose_search, 'MIN_EXPLAINED', 1.0)
    assert enough_seeds(five, 50, 1e-3, neighbours) == 10
    assert not len(_chances(five[:3], 1.0, 1e-3, neighbours))
    (once, *_), (half, *_) = (_chances(BEADS, share, 1e-3, (23, 6)) for share in (1.0, 0.5))
    assert half < 0.5 < once


# ---- growth of a pose


def test_a_pose_begins_with_its_bead_where_it_was_found():
    turn = Rotation.from_euler('xyz', [20, -30, 50], degrees=True).as_matrix()
    for uv in (LENS.centre, LENS.centre + [300.0, -200.0]):
        pose = LocalPose(3, np.array(uv), turn, 2.5, 1.0)
        view = start_view(pose, LENS, BEADS)
        near = BEADS[3] + [[0, 0, 0], [0.01, 0, 0], [0, 0.01, 0], [0, 0, 0.01]]
        seen = view.project(near)
        np.testing.assert_allclose(seen[0], uv, atol=1e-6)
        ray = np.append((uv - LENS.centre) / 4000, 1.0)
        np.testing.assert_allclose(
            view.rotation @ turn.T @ [0, 0, 1], ray / np.linalg.norm(ray), atol=1e-12
        )
        # Across the ray the scale is that of the pose; the sensor is slightly inclined to the ray.
        expected = 2.5 * 0.01 * turn[:2].T
        np.testing.assert_allclose(seen[1:] - seen[0], expected, atol=0.011 * 0.025)


def exact(xyz):
    return Coordinates(xyz, np.zeros(len(xyz)))


def test_pairs_are_nearest_to_each_other():
    seen = Seen.of(np.array([[10.0, 10], [20, 10], [30, 10], [40, 10]]), np.ones((50, 50)), 2.0)
    assert seen.tolerance_px == pytest.approx(0.2 * 25)
    predicted = np.array([[11.0, 10], [10.5, 10], [21, 11], [35, 12], [36.5, 10], [39, 30]])
    bead, detection = pairs(predicted, seen, np.full(6, 5.0))
    assert dict(zip(bead.tolist(), detection.tolist())) == {1: 0, 2: 1, 4: 3}


def test_places_in_the_field_are_those_of_its_pixels():
    field = np.zeros((4, 6), bool)
    field[1, 2:] = True
    seen = Seen.of(np.ones((4, 2)), field, 1.0)
    uv = [[2, 1], [1.4, 1], [1.6, 1.4], [5.4, 1], [5.6, 1], [2, 1.6], [np.nan, 1], [3, -1], [3, 4]]
    expected = [True, False, True, True, False, False, False, False, False]
    assert seen.in_field(np.array(uv)).tolist() == expected


def test_evidence_of_a_match_counts_what_is_predicted_and_what_is_found():
    """Five of 64 predictions are not found, and two detections are not predicted."""
    v, u = np.mgrid[50:800:100, 50:800:100]
    predicted = np.stack([u.ravel(), v.ravel()], axis=1).astype(float)
    xyz = np.column_stack([predicted, np.zeros(64)])
    missed = [0, 13, 30, 44, 61]
    there = np.delete(np.arange(64), missed)
    uv = np.concatenate([predicted[there] + 0.5, [[100.0, 100], [500, 300]]])
    seen = Seen.of(uv, np.ones((800, 800), bool), 5.0)
    outside = np.array([[900.0, 20], [np.nan, 4]])
    view = Fake(principal_distance_px=1.0, depth=lambda xyz: np.ones(len(xyz)))
    match = _judged(
        view,
        exact(np.concatenate([xyz, [[1e4, 0, 0], [0, 1e4, 0]]])),
        seen,
        np.concatenate([predicted, outside]),
        0.3,
    )
    assert match.expected == 64 and match.scale_px == 0.3
    assert match.found == pytest.approx(59 / 64) and match.explained == pytest.approx(59 / 61)
    assert match.bead.tolist() == there.tolist() and match.detection.tolist() == list(range(59))
    assert match.score == pytest.approx(59 - 5)
    assert _judged(view, exact(xyz), seen, predicted + 2000, 0.3) is None
    # Two neighbouring predictions share a detection: both count as found, neither is matched.
    doubled = np.concatenate([predicted, predicted[there[:1]] + [1.5, 0]])
    twice = exact(np.concatenate([xyz, xyz[there[:1]] + [1, 0, 0]]))
    two = _judged(view, twice, seen, doubled, 0.3)
    assert two.found == pytest.approx(60 / 65)
    assert two.bead.tolist() == there[1:].tolist()


def test_a_bead_is_supported_by_half_of_its_neighbours():
    line = np.arange(40.0)[:, None] * [1, 0, 0]
    good = np.arange(40) < 20
    # With six neighbours on either side, beads before the 20th have at least as many good ones.
    assert supported(line, good)[:19].all() and not supported(line, good)[21:].any()
    assert supported(line[:3], np.array([True, True, False])).tolist() == [True, True, True]
    assert not supported(line[:3], np.array([True, False, False]))[0]


def test_regions_with_few_of_their_beads_are_left_out():
    uv = np.repeat([[10.0, 10], [90, 10], [10, 190], [90, 190], [50, 100]], 5, axis=0)
    found = np.array(5 * [1] + [1, 1, 0, 0, 0] + [1, 1, 1, 0, 0] + 5 * [1] + 5 * [0], bool)
    good = _good_cells(uv, found, (200, 100)).reshape(5, 5)
    assert [one.all() for one in good] == [True, False, True, True, False]
    assert (good == good[:, :1]).all()
    assert _good_cells(uv[:4], np.zeros(4, bool), (200, 100)).all()
    # Width and height are not exchanged: a region is 20 px wide and 40 px high.
    beside = np.repeat([[10.0, 10], [30, 10]], 5, axis=0)
    assert _good_cells(beside, np.arange(10) < 5, (200, 100)).tolist() == 5 * [True] + 5 * [False]
    over = np.repeat([[10.0, 10], [10, 30]], 5, axis=0)
    assert not _good_cells(over, np.arange(10) < 5, (200, 100)).any()


def test_residuals_are_predicted_as_by_dense_kriging():
    rng = np.random.default_rng(2)
    place, bead = rng.uniform(0, 3, (30, 2)), np.arange(3, 28)
    residual, noise = rng.normal(size=(25, 2)), rng.uniform(0.1, 0.4, 25)
    kriging = _Kriging.of(place, bead)
    value, variance = kriging.at(residual, noise)

    def matern(one, other):
        away = np.sqrt(3) * np.linalg.norm(one[:, None] - other[None], axis=2)
        return (1 + away) * np.exp(-away)

    for row in range(30):
        far = np.linalg.norm(place[bead] - place[row], axis=1)
        near = np.argsort(far)[:9]
        near = near[bead[near] != row]
        dense = matern(place[bead[near]], place[bead[near]]) + np.diag(noise[near])
        cross = matern(place[row : row + 1], place[bead[near]])[0]
        weight = np.linalg.solve(dense, cross)
        np.testing.assert_allclose(value[row], weight @ residual[near], atol=1e-12)
        assert variance[row] == pytest.approx(1 + noise.min() - weight @ cross)
    some, _ = kriging.chosen(np.array([4, 9])).at(residual, noise)
    np.testing.assert_allclose(some, value[[4, 9]])


@pytest.mark.parametrize('sd, share', [(0.0, 0.001), (5.0, 1.0)])
def test_share_of_noise_is_that_which_predicts_best(sd, share):
    rng = np.random.default_rng(3)
    v, u = np.mgrid[:12, :12] * 0.3
    place = np.stack([u.ravel(), v.ravel()], axis=1)
    residual = np.stack([np.sin(place[:, 0]), np.cos(place[:, 1])], axis=1)
    residual = residual + rng.normal(0, sd, residual.shape)
    bead = np.arange(144)
    assert _noise_share(_Kriging.of(place, bead), residual, bead) == share


def test_the_scale_of_residuals_is_that_of_normal_ones():
    squared = np.sum(np.random.default_rng(4).normal(0, 1.5, (20000, 2)) ** 2, axis=1)
    assert _scale(squared) == pytest.approx(1.5**2, rel=0.03)
    assert _scale(np.zeros(4)) > 0


# ---- markers


def watched(uv, variance, unseen=None):
    """Return a watch on markers 10, 11, ..., their doubts and states; the last is not settled."""
    motion = Motion.start(uv, 1.0)
    motion.covariance[:, 0, 0] = variance
    motion.covariance[:-1, 1, 1] = 0.01
    doubts = MarkerDoubts(len(uv))
    watch = MarkerWatch(
        np.arange(len(uv)) + 10, doubts, gate=4.0, margin=6.0, lost_after=6, density=1e-4
    )
    unseen = np.array(unseen or len(uv) * [0])
    return watch, doubts, Fake(motion=motion, unseen=unseen, placed=np.full(len(uv), 9))


def found_at(uv, measured, free=(), shadow=None):
    nothing = np.zeros(len(uv))
    return MeasuredMarkers(
        np.array(measured, bool),
        np.array(uv, float),
        np.array(uv if shadow is None else shadow, float),
        sigma=nothing + 0.1,
        depth=nothing,
        overlapped=nothing > 0,
        free=np.array(free, float).reshape(-1, 2),
    )


def test_a_shadow_of_no_marker_leaves_open_which_one_is_meant():
    """It is doubted if the free shadow is hardly less likely than the shadow of the marker."""
    at = np.array([[0.0, 0], [100, 0], [200, 0], [300, 0], [400, 0]])
    watch, doubts, states = watched(at, 4 - 0.5**2)
    free = [[5.0, 0], [107, 0], [204, 0], [305, 0], [405, 0], [1000, 0]]
    seen = found_at(at + [[2.0, 0], [2, 0], [0, 0], [2, 0], [2, 0]], [1, 1, 1, 0, 1], free)
    variance = states.motion.variance[0] + 0.25
    excess = (np.array([5, 7, 4]) ** 2 - np.array([2, 2, 0]) ** 2) / variance
    assert (excess < 6).tolist() == [True, False, True]
    told = watch.other_shadows(seen, states, 7)
    assert [one.place.target_id for one in told] == [(10,), (12,)]
    assert {one.kind for one in told} == {Kind.OTHER_SHADOW} and told[0].place.exposures == (7,)
    assert doubts.doubtful.tolist() == [True, False, True, False, False]
    assert doubts.since(0) == 7
    assert not watch.other_shadows(seen, states, 8) and doubts.since(0) == 7
    assert not watch.other_shadows(found_at(at, 5 * [1]), states, 8)


@pytest.mark.parametrize('moved', [0.0, 1.0, 2.0])
def test_a_fit_makes_no_shadow_likelier_than_one_as_near_to_the_prediction(moved):
    """Inside a metal disc, a fit moves from a false shadow to the predicted place."""
    at = np.array([[0.0, 0], [100, 0]])
    watch, doubts, states = watched(at, 0.1)
    shadow = at + [2.0, 0]
    found = found_at(shadow - [moved, 0], [1, 1], free=[[-2.0, 0]], shadow=shadow)
    (told,) = watch.other_shadows(found, states, 7)
    assert told.place.target_id == (10,) and doubts.doubtful.tolist() == [True, False]


@pytest.mark.parametrize(
    ('apart', 'measured', 'unseen', 'settled', 'taken_back', 'doubtful'),
    [
        (3.0, [1, 0], 2, True, True, False),  # the measurement may belong to the other marker
        (3.0, [1, 0], 6, True, True, False),
        (3.0, [1, 0], 7, True, False, True),  # unseen for too many images
        (3.0, [1, 0], 7, False, False, True),  # merged
        (3.0, [1, 0], 2, False, True, False),
        (6.0, [1, 0], 7, True, False, True),
        (6.0, [1, 0], 7, False, False, False),  # the velocity of one marker is unknown
        (3.0, [1, 1], 0, True, False, True),
        (3.0, [1, 1], 0, False, False, False),
        (60.0, [1, 0], 7, True, False, False),
    ],
)
def test_markers_that_met(apart, measured, unseen, settled, taken_back, doubtful):
    at = np.array([[500.0, 300], [500 + apart, 300], [900, 900]])
    watch, doubts, states = watched(at, 16.0, [0, unseen, 0])
    if not settled:
        states.motion.covariance[1, 1, 1] = 1e6
    seen = found_at(at, [*measured, 1])
    found, told = watch.shadows_met(seen, states, 4)
    assert found.measured.tolist() == [not taken_back and bool(m) for m in measured] + [True]
    assert [one.place.target_id for one in told] == ([(10, 11)] if doubtful else [])
    assert doubts.doubtful.tolist() == [doubtful, doubtful, False]
    assert seen.measured.tolist() == [bool(m) for m in measured] + [True]
    assert not watch.shadows_met(seen, states, 5)[1]


@pytest.mark.parametrize(('apart', 'doubtful'), [(1.0, True), (2.4, True), (6.0, False)])
def test_places_of_the_first_image_tell_no_markers_apart_that_are_nearer_to_each_other(
    apart, doubtful
):
    """Whoever gives the places, they are accurate to a pixel or two."""
    at = np.array([[500.0, 300], [500 + apart, 300], [900, 900]])
    watch, doubts, states = watched(at, GIVEN_SD_PX**2, [0, 0, 0])
    states.motion.covariance[:, 1, 1] = 1e6  # no velocity is known
    seen = found_at(at, [1, 1, 1])
    assert not watch.shadows_met(seen, states, 4)[1]
    found, told = watch.shadows_met(seen, states, 4, is_first=True)
    assert found.measured.all()
    assert doubts.doubtful.tolist() == [doubtful, doubtful, False] and len(told) == doubtful


def test_a_marker_found_again_in_a_wide_gate_is_doubtful():
    at = 100.0 * np.arange(5)[:, None] * [1, 0]
    few = 0.02 / (np.pi * 4.0**2 * 1e-4)  # variance at which 0.02 false shadows are expected
    variance = few * np.array([1.1, 0.9, 1.1, 1.1, 1.1])
    watch, doubts, states = watched(at, variance, [2, 5, 1, 4, 9])
    told = watch.recovered(found_at(at, [1, 1, 1, 0, 1]), states, 3)
    assert [one.place.target_id for one in told] == [(10,), (14,)]
    assert [one.numbers['images'] for one in told] == [1, 8]
    assert not watch.recovered(found_at(at, [1, 1, 1, 0, 1]), states, 4)
    assert doubts.doubtful.tolist() == [True, False, False, False, True]


def test_doubts_are_of_both_markers_and_are_taken_back_for_both():
    doubts = MarkerDoubts(4)
    doubts.add_pair(0, 1, 5)
    doubts.add_pair(1, 2, 8)
    doubts.add(3, 9)
    assert [doubts.since(row) for row in range(4)] == [5, 5, 8, 9]
    assert doubts.partners(1) == {0, 2}
    doubts.part(0, 1)
    assert doubts.doubtful.tolist() == [False, True, True, True]
    doubts.confirm_alone(1)
    doubts.confirm_alone(3)
    assert doubts.doubtful.tolist() == [False, True, True, False]
    doubts.add(2, 11)
    assert doubts.since(2) == 8
    doubts.confirm(2)
    assert not doubts.doubtful.any() and doubts.since(1) is None


def test_the_stronger_one_of_two_shadows_at_a_place_is_kept():
    uv = np.array([[10.0, 10], [10.7, 10.6], [30, 10], [30.9, 10], [31.5, 10]])
    shadows = Shadows(uv, np.array([1.0, 3.0, 2.0, 5.0, 1.5]))
    kept = shadows.distinct()
    assert kept.strength.tolist() == [5.0, 3.0]
    np.testing.assert_array_equal(kept.uv, uv[[3, 1]])
    two = shadows.strongest(3)
    assert two.strength.tolist() == [5.0, 3.0, 2.0]
    np.testing.assert_array_equal(two.uv, uv[[3, 1, 2]])


@pytest.mark.parametrize('inverted', [False, True])
def test_windows_of_light_end_at_the_border(inverted):
    image = np.arange(6 * 8, dtype=np.uint8).reshape(6, 8)
    field = np.ones((6, 8), bool)
    field[3, 4] = False
    offset = np.array([[0, 0], [-1, 0], [1, 2]])
    for middle in ([[4, 3]], [[5, 3], [2, 2]], [[0, 0]], [[7, 5], [4, 3]], [[6, 3]], [[2, 4]]):
        reader = LightWindows(
            image, Fake(field=field, white=255 if inverted else None, clipping=UNCLIPPED)
        )
        grey, valid = reader.read(np.array(middle), offset)
        for place, greys, valids in zip(np.array(middle), grey, valid):
            for (u, v), value, there in zip(place + offset, greys, valids):
                assert there == (0 <= u < 8 and 0 <= v < 6 and (u, v) != (4, 3))
                if there:
                    assert value == (255.0 - (8 * v + u) if inverted else 8 * v + u)


def test_images_in_which_nothing_can_be_seen_are_refused():
    good = np.arange(64 * 80, dtype=np.uint16).reshape(64, 80)
    check_image(good)
    check_image(good, (80, 64))
    check_image(np.pad(np.ones((1, 1), np.uint8), 40))
    for bad, size, words in (
        (good[None], None, 'rows and columns'),
        (good.astype(float), None, 'float64'),
        (good[:3], None, '80 x 3 px'),
        (good, (64, 80), 'image is 80 x 64 px, but the first one is 64 x 80 px'),
        (np.full((64, 80), 7, np.uint8), None, 'grey value 7'),
    ):
        with pytest.raises(DataError, match=words):
            check_image(bad, size)


def test_a_marker_moves_by_the_larger_one_of_its_coordinates():
    fit = _MarkerFit.__new__(_MarkerFit)
    fit.uv = np.array([[1.0, 2], [3, 4], [5, 6]])
    fit.depth, fit.background = np.zeros(3), Fake(terms=np.zeros(3))
    rows = np.array([2, 0])
    step = np.array([[5.1, 5.5], [1.4, 2.0]]), np.array([0.3, 0.2]), np.array([30.0, 20])
    fit._step = lambda *given: step
    np.testing.assert_allclose(fit._take_step(rows, np.zeros((2, 0)), True), [0.5, 0.4])
    np.testing.assert_array_equal(fit.uv, [[1.4, 2.0], [3, 4], [5.1, 5.5]])
    assert fit.depth.tolist() == [0.2, 0, 0.3] and fit.background.terms.tolist() == [20, 0, 30]


def test_response_to_a_shadow_is_the_smaller_eigenvalue_of_the_hessian():
    """The tested rows include those where two separately filtered parts meet."""
    width = 4096
    image = np.random.default_rng(6).uniform(0, 100, (24, width)).astype(np.float32)
    assert PIXELS_AT_ONCE // width == 16
    smooth = cv2.GaussianBlur(image, (0, 0), 1.5).astype(float)
    dark, bright = responses(image, 1.5)
    np.testing.assert_array_equal(responses(image, 1.5, (True,)), [bright])
    for v, u in ((3, 4), (10, 20), (15, 9), (16, 70), (17, 9)):
        near = smooth[v - 1 : v + 2, u - 1 : u + 2]
        across = (near[2, 2] - near[2, 0] - near[0, 2] + near[0, 0]) / 4
        own = near[[1, 0], [0, 1]] + near[[1, 2], [2, 1]] - 2 * near[1, 1]
        values = 1.5**2 * np.linalg.eigvalsh([[own[0], across], [across, own[1]]])
        assert dark[v, u] == pytest.approx(max(values[0], 0), abs=1e-3)
        assert bright[v, u] == pytest.approx(max(-values[1], 0), abs=1e-3)
    assert (dark > 0).any() and (bright > 0).any()


@pytest.mark.parametrize('normal', [1.0, -1.0])
def test_a_flat_grid_is_seen_from_where_it_is(normal):
    """The direction of its normal does not matter."""
    v, u = np.mgrid[-60:61:15, -75:76:15]
    tilt = Rotation.from_rotvec([0.5, -0.3, 0.8]).as_matrix()
    xyz = np.column_stack([u.ravel(), v.ravel(), np.zeros(u.size)]) @ tilt.T + [20.0, 30, -10]
    turn = Rotation.from_rotvec([-0.2, 0.1, 0.4]).as_matrix()
    sensor = (xyz - xyz.mean(axis=0)) @ turn.T + [5.0, -8, 1500]
    uv = 4000 * sensor[:, :2] / sensor[:, 2:] + LENS.centre
    axes = tilt.T * [[1], [1], [normal]]
    view = _view(FlatGrid(None, xyz.mean(axis=0), axes), xyz, uv, LENS)
    np.testing.assert_allclose(view.rotation @ view.rotation.T, np.eye(3), atol=1e-9)
    np.testing.assert_allclose(view.rotation, turn, atol=0.02)
    np.testing.assert_allclose(view.project(xyz), uv, atol=0.05)


@pytest.mark.parametrize('count', [3, 5, 40])
def test_support_is_the_share_of_the_nearest_beads_in_space(count):
    rng = np.random.default_rng(count)
    xyz = rng.uniform(-50, 50, (count, 3))
    good = rng.random(count) < 0.5
    near = np.argsort(np.linalg.norm(xyz[:, None] - xyz[None], axis=2), axis=1)[:, 1:]
    share = good[near[:, : growth.SUPPORT]].mean(axis=1)
    assert supported(xyz, good).tolist() == (share >= growth.MIN_SHARE).tolist()
    assert 0 < supported(xyz, good).mean() < 1 or count < 40


def test_cells_of_an_image_are_bad_by_the_beads_that_are_found_in_them():
    rng = np.random.default_rng(8)
    uv = rng.uniform(-20, [1020, 620], (400, 2))
    found = rng.random(400) < 0.55
    cell = np.clip(np.floor(uv / [1000, 600] * growth.CELLS), 0, growth.CELLS - 1)
    expected = []
    for own in cell:
        same = (cell == own).all(axis=1)
        many = same.sum() >= growth.MIN_CELL
        expected.append(not (many and found[same].sum() < 0.6 * same.sum()))
    assert _good_cells(uv, found, (600, 1000)).tolist() == expected
    assert 0.1 < np.mean(expected) < 0.9
