# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Lattices against a count of all shifts, pictures by pixel, and predictions between views."""

from dataclasses import replace
from types import SimpleNamespace as Fake

import cv2
import numpy as np
import pytest
from rigs import pincushion, true_calibrations, true_orientation
from scipy.spatial.transform import Rotation

from fluoro_calib_ros.bodies.body import Body
from fluoro_calib_ros.errors import DataError
from fluoro_calib_ros.images import corrector, lattice, marker_ids, overlay
from fluoro_calib_ros.images.marker_decisions import DecidedView, ViewCounts
from fluoro_calib_ros.images.marker_motion import MarkerStates, Motion
from fluoro_calib_ros.images.marker_points import ShadowPoints, _explaining, shadow_points
from fluoro_calib_ros.images.marker_rays import CalibratedRig, MarkerBodies, MarkerPlaces
from fluoro_calib_ros.images.marker_views import JoinedViews, _later, _names, _ViewPredictions
from fluoro_calib_ros.images.markers import MarkerFrame
from fluoro_calib_ros.images.view import Lens
from fluoro_calib_ros.reconstruction.reconstruct import MatchedViews
from fluoro_calib_ros.simulation.rig import virtual_rig

RNG = np.random.default_rng(41)


# ---- lattices


def places(rows, columns, without=()):
    every = [(i, j) for i in range(rows) for j in range(columns)]
    return np.array([one for one in every if one not in without])


def test_shifts_of_a_lattice_are_those_of_which_most_beads_agree():
    """All shifts are counted: found beads support a shift, missing ones contradict it."""
    grid = places(6, 8, [(2, 3), (4, 6)]) - [3, 2]
    found = places(4, 5, [(1, 2)]) + [7, -4]
    missing = np.array([[8, -2]])
    wanted = np.array([-9.0, 4.0])
    told = lattice._shifts(found, missing, grid, wanted)
    every = {tuple(one) for one in grid.tolist()}
    counts = {}
    for a in range(-20, 5):
        for b in range(-6, 20):
            hits = sum((x + a, y + b) in every for x, y in found.tolist())
            gone = sum((x + a, y + b) in every for x, y in missing.tolist())
            counts[a, b] = len(found) - (hits - gone)
    for shift, against in told:
        assert counts[tuple(shift)] == against
    against = [one for _, one in told]
    assert against == sorted(against)
    assert against == sorted(counts.values())[: len(told)]
    best = [shift for shift, one in told if one == against[0]]
    away = [np.hypot(*(shift - wanted)) for shift in best]
    assert away == sorted(away)


def test_what_is_missing_in_a_lattice_has_beads_all_around():
    found = places(7, 9, [(3, 4), (0, 5), (6, 8)]) + [-4, 11]
    assert lattice._missing(found).tolist() == [[-1, 15]]
    assert len(lattice._missing(places(7, 9))) == 0


def test_steps_of_a_lattice_are_those_of_its_plane():
    index = places(3, 4) + [5, -2]
    steps = np.array([[10.0, 1.0, 0.5], [-2.0, 7.0, 0.0]])
    found = lattice._steps(index, index @ steps + [3, 4, 5])
    np.testing.assert_allclose(found, steps, atol=1e-12)


@pytest.mark.parametrize('mirrored', [False, True])
@pytest.mark.parametrize('origin', [0.0, 300.0])
def test_a_view_of_a_grid_projects_it_whatever_its_axes_are(mirrored, origin):
    lens = Lens((1000, 800), 4000.0)
    turn = Rotation.from_rotvec([0.2, -0.3, 0.1]).as_matrix()
    flat = np.column_stack([places(6, 7) * 10.0, np.zeros(42)]) - [25.0, 30.0, 0.0]
    own = Rotation.from_rotvec([1.0, 0.4, -0.3]).as_matrix()
    xyz = flat @ own.T + origin
    axes = own.T * [[1], [1], [-1 if mirrored else 1]]
    sensor = flat @ turn.T + [4.0, -6.0, 900.0]
    uv = lens.centre + 4000.0 * sensor[:, :2] / sensor[:, 2:]
    grid = lattice.FlatGrid(None, xyz.mean(axis=0), axes)
    view = lattice._view(grid, xyz, uv, lens)
    np.testing.assert_allclose(view.project(xyz), uv, atol=0.5)
    assert np.linalg.det(view.rotation) == pytest.approx(1) and (view.depth(xyz) > 0).all()
    assert view.depth(xyz).mean() == pytest.approx(900.0, rel=0.1)


def test_points_are_numbered_along_a_bent_lattice():
    index = places(6, 7)
    uv = index * [30.0, 22.0] + 0.15 * index[:, ::-1] ** 2 + [100, 50]
    order = RNG.permutation(42)
    found = lattice.number_lattice(uv[order])
    assert sorted(found.row) == list(range(42))
    numbers = found.index[np.argsort(found.row)][np.argsort(order)]
    change = np.linalg.lstsq(index - index.mean(0), numbers - numbers.mean(0), rcond=None)[0]
    assert abs(np.linalg.det(change)) == pytest.approx(1)
    np.testing.assert_allclose(change, np.rint(change), atol=1e-9)
    assert lattice.number_lattice(uv[:8]) is None
    # Most of the points have to lie on the lattice.
    assert lattice.number_lattice(np.vstack([uv[:9], RNG.uniform(400, 900, (30, 2))])) is None


# ---- pictures


def test_a_picture_has_full_contrast():
    image = np.arange(0, 4000, dtype=np.uint16).reshape(40, 100)
    low, high = np.percentile(image[::4, ::4], [0.5, 99.8])
    shown = overlay.full_contrast(image)
    assert shown.dtype == np.uint8 and shown.min() == 0 and shown.max() == 255
    inside = (image > low) & (image < high)
    expected = 255 * (image[inside] - low) / (high - low)
    assert np.abs(shown[inside] - expected).max() <= 1
    assert overlay.full_contrast(np.full((9, 9), 7, np.uint8)).max() == 0
    picture, factor = overlay._picture(image[:, :50])
    assert factor == 2 and picture.shape == (80, 100, 3)
    assert (picture[::2, ::2] == picture[1::2, 1::2]).all()
    assert overlay._picture(np.zeros((512, 513), np.uint8))[1] == 1
    assert overlay._picture(np.zeros((512, 512), np.uint8))[1] == 2
    assert overlay._place([10.3, 4.8], 1) == (10, 5)
    assert overlay._place([10.0, 4.0], 2) == (20, 8)  # 20.5 and 8.5 are rounded to even


def test_a_large_image_is_reduced_and_a_small_one_is_not():
    image = np.tile(np.arange(200, dtype=np.uint8), (100, 1))
    for largest, shape in ((50, (25, 50)), (200, (100, 200)), (500, (100, 200))):
        small = overlay.small_jpeg(image, largest)
        assert cv2.imdecode(np.frombuffer(small, np.uint8), cv2.IMREAD_GRAYSCALE).shape == shape


def colours_at(picture, u, v):
    return tuple(int(x) for x in picture[v, u])


def test_detections_are_explained_even_if_a_bead_is_behind_the_source():
    image = np.zeros((600, 700), np.uint8)
    found = Fake(
        detections=Fake(uv=np.array([[100.0, 200], [400, 300]])),
        match=Fake(predicted=np.array([[101.0, 200], [np.nan, np.nan]])),
        imaging=Fake(profile=Fake(reach_px=8.0)),
        uv=np.zeros((0, 2)),
        overlapped=np.zeros(0, dtype=bool),
        bead=np.zeros(0, dtype=int),
        refused=(),
    )
    picture = overlay.draw_overlay(image, found)
    assert colours_at(picture, 392, 292) == overlay.UNEXPLAINED
    assert not picture[180:220, 80:120].any()


def test_markers_are_drawn_in_their_colours_where_they_are():
    image = np.zeros((600, 700), np.uint8)
    found = Fake(
        target_id=np.array([1, 2, 3]),
        uv=np.array([[100.0, 200], [300, 200], [500, 200]]),
        overlapped=np.array([False, True, True]),
        doubtful=np.array([False, False, True]),
        missing=np.array([4, 5, 6]),
        predicted=np.array([[100.0, 400], [np.nan, np.nan], [3e4, 50.0]]),
        reason='',
    )
    picture = overlay.draw_markers(image, found, {1: ''})
    assert picture.shape == (600 + 3 * 18 + 8, 700, 3)
    for u, colour in (
        (100, overlay.MATCHED),
        (300, overlay.OVERLAPPED),
        (500, overlay.UNEXPLAINED),
    ):
        for du, dv in ((7, 0), (-7, 0), (0, 7), (0, -7)):
            near = picture[200 + dv - 1 : 200 + dv + 2, u + du - 1 : u + du + 2].reshape(-1, 3)
            assert (np.abs(near.astype(int) - colour).sum(axis=1) < 120).any()
        assert not picture[200, u].any()
    assert colours_at(picture, 100, 400) == overlay.REFUSED
    red = np.flatnonzero((picture[:600] == overlay.REFUSED).all(axis=2).any(axis=1))
    assert red.min() >= 390 and red.max() <= 410
    found.reason = 'why'
    assert overlay.draw_markers(image, found).shape == (600 + 4 * 18 + 8, 700, 3)


def test_bodies_are_drawn_with_their_axes():
    image = np.zeros((600, 700), np.uint8)
    axes = np.array([[300.0, 300], [350, 300], [300, 350], [260, 260]])
    body = overlay.BodyView('', 'OK', np.array([[100.0, 100]]), axes)
    picture = overlay.draw_bodies(image, '', [body])
    assert picture.shape[0] % 2 == 0 and picture.shape[1] == 700
    for (u, v), colour in zip(((330, 300), (300, 330), (275, 275)), overlay.AXIS_COLOURS):
        assert colours_at(picture, u, v) == colour
    lost = overlay.BodyView('', 'LOST', np.array([[np.nan, 9]]), axes)
    assert not overlay.draw_bodies(image, '', [lost])[:600].any()
    odd = overlay.draw_bodies(image[:, :699], '', [body])
    assert odd.shape[1] == 698
    far = overlay.BodyView('', 'OK', np.array([[2**14 + 1.0, 9]]), axes)
    assert not overlay.draw_bodies(image, '', [far])[:600].any()


@pytest.mark.parametrize('background', [0, 255])
def test_the_name_of_a_body_is_legible_on_any_background(background):
    image = np.full((600, 700), background, np.uint8)
    image[0, 0] = 255 - background
    axes = np.array([[300.0, 300], [350, 300], [300, 350], [260, 260]])
    unnamed, named = (
        overlay.draw_bodies(image, '', [overlay.BodyView(name, 'OK', np.zeros((0, 2)), axes)])[
            :600
        ]
        for name in ('', 'femur')
    )
    changed = (named != unnamed).any(axis=2)
    text = named[changed]
    assert text.min() < 40 and text.max() > 215
    assert not changed[297:304, 300:350].any(), 'the name is apart from the axis'


@pytest.mark.parametrize('size', [(480, 240), (300, 600)])
def test_covered_cells_are_green_where_they_are(size):
    covered = np.array([[True, False], [False, False], [False, True]])
    picture = overlay.coverage_picture(covered, size, ('line',), [5])
    rows = round(480 * size[1] / size[0])
    assert picture.shape == (rows + 18 + 8, 480, 3)

    def at(x, y):
        return colours_at(picture, int(x * 480), int(y * rows))

    assert at(0.2, 0.1) == overlay.MATCHED and at(0.8, 0.1) == overlay.MISSING
    assert at(0.2, 0.9) == overlay.MISSING and at(0.8, 0.9) == overlay.MATCHED
    assert colours_at(picture, 160, 3) == overlay.TEXT == colours_at(picture, 320, 3)
    assert colours_at(picture, 3, rows // 3) == colours_at(picture, 3, 2 * rows // 3)
    framed = (picture[:rows] == overlay.UNEXPLAINED).all(axis=2)
    v, u = np.nonzero(framed)
    assert u.min() >= 320 and u.max() < 480
    assert v.min() >= rows // 3 and v.max() < 2 * rows // 3 and framed.any()
    assert not framed[rows // 2, 400]


# ---- corrected images


def test_a_fold_is_where_neighbours_are_seen_mirrored():
    v, u = np.mgrid[:6, :7].astype(float)
    assert not corrector.is_folded(np.stack([u, v])).any()
    for mirrored in ([-u, v], [u, -v], [v, u], [u, 0 * v]):
        folded = corrector.is_folded(np.stack(mirrored))
        assert folded[:-1, :-1].all() and folded[1:, 1:].all()
    assert not corrector.is_folded(np.stack([-v, u])).any()  # turned, not mirrored
    bent = np.stack([np.where(u > 3, 6 - u, u), v])
    folded = corrector.is_folded(bent)
    assert folded[1:-1, 3:].all() and not folded[:, :3].any()
    right, down = corrector.steps(np.stack([2 * u + v, 3 * v]))
    assert (right == np.array([2, 0])[:, None, None]).all() and right.shape == (2, 5, 6)
    assert (down == np.array([1, 3])[:, None, None]).all() and down.shape == (2, 5, 6)


def test_a_correction_goes_on_beyond_the_border_as_steep_as_before():
    """A linear correction is linear everywhere."""

    def look_up(u, v):
        inside = (u >= -0.5) & (u < 99.5) & (v >= -0.5) & (v < 79.5)
        return np.stack([0.01 * u - 0.02 * v + 1, 0.03 * u, 0 * u]), np.where(inside, 0, 2)

    grid = Fake(image_size=(100, 80), look_up=look_up)
    at = np.array([[50.0, -5.5, 109.5, 50, 50, 104.5], [40.0, 40, 40, -10.5, 89.5, 84.5]])
    expected = np.stack([0.01 * at[0] - 0.02 * at[1] + 1, 0.03 * at[0]])
    np.testing.assert_allclose(corrector.continued(grid, at), expected, atol=1e-4)
    rim = np.clip(at, -0.5, [[99.5], [79.5]])
    expected = np.stack([0.01 * rim[0] - 0.02 * rim[1] + 1, 0.03 * rim[0]])
    np.testing.assert_allclose(corrector.as_at_rim(grid, at), expected, atol=1e-4)
    undistorted = at[:, :1]
    observed = corrector.iterated(grid, undistorted)
    moved = look_up(*observed)[0][:2]
    np.testing.assert_allclose(observed - moved, undistorted, atol=1e-3)


# ---- what views predict for each other


class Tracker:
    def __init__(self, unsure=()):
        self._unsure = np.array(unsure)
        self.told = []

    def unsure(self):
        return self._unsure

    def suggest(self, ids, uv, velocity, sd):
        self.told.append((ids.tolist(), uv, velocity, sd))


def states_at(uv):
    states = MarkerStates.start(Motion.start(np.array(uv, dtype=float), 0.3), np.zeros(len(uv)))
    states.unseen = states.unseen.astype(int)
    states.motion.covariance[:, 1, 1] = 0.04
    return states


def test_places_of_a_body_tell_the_velocity_by_the_second_image():
    states = states_at([[100, 100], [200, 100], [300, 100]])
    states.advance(1, None)
    states.place(np.array([0, 2]), np.array([[120.0, 110], [300.2, 100]]), frames=1)
    # The third marker is already there, and the second one was not requested.
    assert states.motion.uv.tolist() == [[120, 110], [200, 100], [300, 100]]
    assert states.motion.covariance[0].tolist() == [[2.25, 0], [0, 36]]
    assert not states.motion.velocity.any() and states.placed[0] == 0 and states.unseen[0] == 1
    states.unseen[:] = 0  # measured
    states.advance(2, None)
    states.place(np.array([0]), np.array([[150.0, 116]]), frames=2)
    assert states.motion.velocity[0].tolist() == [15, 3]
    assert states.motion.covariance[0].tolist() == [[2.25, 0], [0, 2.25]]
    states.unseen[0] = 9  # unseen for long: the previous place is not used
    states.place(np.array([0]), np.array([[10.0, 20]]), frames=1)
    assert states.motion.uv[0].tolist() == [10, 20] and not states.motion.velocity[0].any()


def test_a_body_of_which_less_than_half_is_seen_again_is_elsewhere():
    bodies = MarkerBodies.__new__(MarkerBodies)
    lost = []
    bodies._count, bodies._tracker = 9, Fake(lose=lambda rows: lost.append(rows.tolist()))
    bodies._rows = [np.array([0, 1, 2]), np.array([4, 5, 6]), np.array([7, 8])]
    before = np.zeros((2, 9), dtype=bool)
    before[:, [0, 1, 2, 4, 5, 7]] = True
    now = np.zeros((2, 9), dtype=bool)
    now[0, [0, 1, 4, 5, 6]] = True
    # Seen again: two of six; two of four, which is half (not counting a new marker); none of two.
    missed, by_view = bodies.miss(now, before)
    assert np.flatnonzero(missed).tolist() == [0, 1, 2]
    # The second view sees none of the first body, and had seen only two of the second one.
    assert [np.flatnonzero(view).tolist() for view in by_view] == [[], [0, 1, 2]]
    assert lost == [[True, False, False]]
    missed, by_view = bodies.miss(now[:0], before[:0])
    assert not missed.any() and by_view.shape == (0, 9)
    bodies._tracker = None
    missed, by_view = bodies.miss(now, before)
    assert not missed.any() and by_view.shape == (2, 9) and not by_view.any()


def test_what_a_view_still_measures_of_a_body_that_is_elsewhere_there_is_doubted():
    doubted = {}
    joined = JoinedViews.__new__(JoinedViews)
    joined._target_id, joined._missed = np.arange(6), np.zeros(6, dtype=bool)
    joined._measured = np.ones((2, 6), dtype=bool)
    joined._bodies = Fake(
        miss=lambda measured, before: (
            np.zeros(6, dtype=bool),
            np.array([[True] * 4 + [False] * 2, [False] * 6]),
        )
    )
    joined._views = [
        Fake(
            view=view,
            name=name,
            tracker=Fake(doubtful=lambda name=name: doubted.get(name, [])),
            doubt=lambda rows, frame, name=name: doubted.update({name: rows.tolist()}),
        )
        for view, name in enumerate('ab')
    ]
    frames = {'a': found_frame([2, 5]), 'b': found_frame(range(6))}
    out = joined._without_missed(frames, 3)
    assert doubted == {'a': [2], 'b': []}
    assert out['a'].doubtful.tolist() == [True, False] and not out['b'].doubtful.any()


def found_frame(target_id):
    count = len(target_id)
    return MarkerFrame(
        3,
        np.array(target_id),
        np.zeros((count, 2)),
        np.ones(count),
        np.zeros(count, dtype=bool),
        np.zeros(count, dtype=bool),
        np.zeros(0, dtype=int),
        np.zeros((0, 2)),
        np.zeros(0, dtype=bool),
    )


@pytest.mark.parametrize('is_placed', [True, False])
def test_a_missed_body_that_its_markers_place_is_not_missed_any_more(is_placed):
    joined = JoinedViews.__new__(JoinedViews)
    joined._views, joined._predictions, joined._by_body, joined._by_rays = [], [], [], []
    joined._target_id, joined._rig = np.array([3, 5]), Fake(angles={})
    joined._measured = np.zeros((0, 2), dtype=bool)
    joined._missed, joined._again = np.array([True, False]), []
    none = np.zeros(2, dtype=bool)
    views = MatchedViews(joined._target_id, np.zeros((1, 2, 2)), *[none[None]] * 3)
    seen = Fake(sure=none, agree=none[None], doubtful=none[None], intersected=Fake(views=views))
    joined._rays = Fake(intersect=lambda found, angles: seen)
    joined._noise = Fake(add=lambda views: None)
    nowhere = MarkerPlaces.nowhere(2)
    joined._bodies = Fake(
        miss=lambda measured, before: (np.zeros(2, dtype=bool), np.zeros((0, 2), dtype=bool)),
        update=lambda exposure, frame: None,
        present=MarkerPlaces(np.zeros((2, 3)), nowhere.covariance) if is_placed else nowhere,
        unplaced=none.copy,
        among=lambda supported: none,
        learn=lambda exposure, sure: None,
    )
    joined.decided({}, 4)
    assert joined._missed.tolist() == [not is_placed, False]


@pytest.mark.parametrize(('once', 'among'), [((2,), ()), ((), (2,)), ((), ()), ((2,), (2,))])
def test_markers_of_a_body_without_pose_are_doubted_where_no_other_view_supports_them(once, among):
    doubted = []
    joined = JoinedViews.__new__(JoinedViews)
    tracker = Fake(seen_anew=lambda: (2, 5))
    joined._views = [
        Fake(view=0, tracker=tracker, doubt=lambda rows, frame: doubted.append(rows.tolist()))
    ]
    joined._target_id = np.arange(1, 8)
    # Markers 3 and 7 belong to the second body, all others to other bodies.
    second = np.array([0, 0, 1, 0, 0, 0, 1], dtype=bool)
    joined._again = [Fake(target_id=np.array([3, 7]))] if once else []
    agree = np.array([[0, 0, 0, 0, 1, 0, 0]], dtype=bool)
    joined._bodies = Fake(
        unplaced=lambda: np.array([0, 1, 1, 1, 1, 0, 1], dtype=bool),
        among=lambda supported: second & bool(among) & (supported == agree[0]).all(),
    )
    joined._measured = np.array([[1, 1, 1, 0, 1, 1, 1]], dtype=bool)
    joined._doubt_unsupported(Fake(agree=agree), 9)
    assert doubted == [[1, 2, 6] if once or among else [1]]


def test_bodies_give_a_pose_by_three_supported_markers():
    bodies = MarkerBodies.__new__(MarkerBodies)
    bodies._count = 8
    bodies._rows = [np.array([0, 1, 2, 5]), np.array([3, 4, 6])]
    supported = np.array([1, 1, 0, 1, 1, 1, 0, 1], dtype=bool)
    assert np.flatnonzero(bodies.among(supported)).tolist() == [0, 1, 2, 5]


def test_views_are_those_of_the_orientation_in_its_order():
    rig = Fake(fluoroscopes=('a', 'b', 'c'))
    assert _names({'c': None, 'a': None}, rig) == ('a', 'c')
    assert _names({'x': None}, None) == ('x',)
    for first, orientation in (({'a': 1, 'b': 2}, None), ({'a': 1, 'x': 2}, rig), ({}, rig)):
        with pytest.raises(DataError):
            _names(first, orientation)
    ids = np.array([1, 2, 3])
    assert _later(ids, None) is ids
    assert _later(ids, Fake(target_id=np.array([2, 7]))).tolist() == [1, 3]


def test_what_is_told_is_expected_to_go_on_by_the_exposures_between():
    def at(x):
        return MarkerPlaces(np.array([[x, 0.0, 0]]), np.eye(3)[None])

    told = _ViewPredictions(at(0.0), at(0.0)).next(at(1.0), 4).next(at(3.0), 6)
    # The motion is 2 mm in 2 exposures.
    assert told.expected(7).xyz_mm[0, 0] == 4.0 and told.expected(10).xyz_mm[0, 0] == 7.0
    assert (told.frame, told.frame_before) == (6, 4)


@pytest.fixture(scope='module')
def rig():
    made = virtual_rig(1, strength=0.0, names=('a', 'b', 'c'), between_deg=50.0)
    calibrations = true_calibrations(made.fluoroscopes)
    return made, CalibratedRig(true_orientation(made.fluoroscopes, calibrations), calibrations, {})


def test_spread_of_a_point_is_that_of_its_projection(rig):
    """The projection is differentiated numerically along the axes of the covariance."""
    made, known = rig
    xyz = np.array([[10.0, -20, 30]])
    half = RNG.normal(size=(3, 3))
    covariance = half @ half.T
    for view, fluoroscope in enumerate(made.fluoroscopes):
        steps = [
            (fluoroscope.ideal(xyz + 1e-3 * one) - fluoroscope.ideal(xyz - 1e-3 * one))[0] / 2e-3
            for one in half.T
        ]
        expected = np.sqrt(np.sum(np.square(steps)) / 2)
        assert known.spread(view, xyz, covariance[None])[0] == pytest.approx(expected, rel=1e-4)
        uv = known.project(view, np.vstack([xyz, [[np.nan] * 3]]))
        np.testing.assert_allclose(uv[0], fluoroscope.ideal(xyz)[0], atol=1e-6)
        assert np.isnan(uv[1]).all()


def test_points_behind_the_source_are_not_projected(rig):
    _, known = rig
    source = known.orientation.position_mm[0]
    behind = np.array([[0.0, 0, 0], 1.5 * source])
    assert np.isfinite(known.project(0, behind)).all(axis=1).tolist() == [True, False]


def test_projections_are_corrected_to_where_they_come_from(rig):
    """The error of the inverse of a distortion is far below the noise, also at the border."""
    _, known = rig
    smooth = pincushion('a', (1024, 1024))
    steep = replace(smooth.model, train_duv=5 * smooth.model.train_duv)
    calibrations = dict.fromkeys('abc', replace(smooth, model=steep))
    distorted = CalibratedRig(known.orientation, calibrations, {})
    points = np.random.default_rng(2).uniform(-110, 110, (400, 3))
    for view, name in enumerate('abc'):
        seen = distorted.project(view, points)
        inside = ((seen > 0) & (seen < 1023)).all(axis=1)
        ideal = known.project(view, points)
        corrected = distorted.calibrations[name].correct(seen[inside]).uv
        assert inside.sum() > 100 and np.abs(corrected - ideal[inside]).max() < 2e-3


def test_shadows_of_three_views_meet_in_points(rig):
    made, known = rig
    xyz = np.array([[10.0, -20, 5], [-15, 12, 30], [28, 30, -20], [-30, -25, -10]])
    shadows = [f.ideal(xyz) for f in made.fluoroscopes]
    shadows[1] = np.vstack([shadows[1][[2, 0, 3]], [[900.0, 40.0]]])  # not the second point
    shadows[2] = shadows[2][[1, 3, 0, 2]]
    found = shadow_points(shadows, known)
    expected = {(0, 1, 2): xyz[0], (1, -1, 0): xyz[1], (2, 0, 3): xyz[2], (3, 2, 1): xyz[3]}
    rows = {tuple(row): place for row, place in zip(found.shadow.tolist(), found.xyz)}
    for key, place in expected.items():
        np.testing.assert_allclose(rows[key], place, atol=1e-3)
    assert len(rows) <= 6 and (found.variance > 0).all()
    # Points of two rays are less accurate than those of three.
    three = (found.shadow >= 0).all(axis=1)
    assert found.variance[three].max() < found.variance[~three].min() * 1.5


def test_points_of_fewer_rays_explain_what_others_do_not():
    shadow = np.array(
        [[0, 1, -1], [0, 1, 2], [0, -1, 3], [4, 5, -1], [0, 1, 2], [-1, 1, 2], [6, -1, 2]]
    )
    assert _explaining(shadow).tolist() == [1, 2, 3, 6]


def test_views_are_told_where_unsure_markers_are_expected():
    """Places come from bodies, otherwise from other views; the velocity, from two exposures."""
    ids = np.array([3, 5, 8])
    joined = JoinedViews.__new__(JoinedViews)
    tracker = Tracker(unsure=[5, 8])
    joined._target_id = ids
    joined._frame = 10
    joined._views = [DecidedView(0, 'a', tracker, ids, ViewCounts(3))]

    def at(values):
        xyz = np.repeat(np.array(values, dtype=float)[:, None], 3, axis=1)
        return MarkerPlaces(xyz, np.tile(np.eye(3), (3, 1, 1)))

    joined._bodies = Fake(
        present=at([1.0, 2.0, np.nan]), predicted=lambda frame: at([1.5, 3.0, np.nan])
    )
    told = at([7.0, 7.0, 8.0])
    joined._predictions = [Fake(places=told, expected=lambda frame: at([9.0, 9.0, 10.0]))]
    joined._rig = Fake(
        project=lambda view, xyz: xyz[:, :2] * 10,
        spread=lambda view, xyz, covariance: xyz[:, 0] / 100,
    )
    joined._rig_before = Fake(project=lambda view, xyz: xyz[:, :2] * 20)
    joined._suggest(12, np.zeros(3, dtype=bool))
    ((told_ids, uv, velocity, sd),) = tracker.told
    assert told_ids == [5, 8]
    assert uv.tolist() == [[30, 30], [100, 100]] and sd.tolist() == [0.03, 0.1]
    # The places before are 2 and 8 at the previous angle, two exposures earlier.
    assert velocity.tolist() == [[-5, -5], [-30, -30]]
    # A body that has just been found predicts its marker better.
    joined._suggest(12, ids == 8)
    assert tracker.told[-1][0] == [5]


@pytest.mark.parametrize(('seen', 'is_told'), [(4, True), (3, True), (2, False)])
def test_markers_of_a_body_are_where_their_shadows_are_or_would_be(rig, seen, is_told):
    made, known = rig
    shape = RNG.normal(0, 15, (5, 3))
    body = Body('bone', np.array([4, 5, 6, 7, 8]), shape, np.full(5, 0.1))
    there = Rotation.from_rotvec([0.3, 0.2, -0.5]).apply(shape) + [5.0, -10, 3]
    point = np.array([1, 0, 3, -1, 2])
    xyz = np.zeros((4, 3))
    xyz[point[point >= 0]] = there[point >= 0]
    shadow = np.full((4, 3), -1)
    shadow[:seen, 1] = [2, 0, 3, 1][:seen]
    points = ShadowPoints(xyz, np.ones(4), shadow)
    ideal = made.fluoroscopes[1].ideal(there)
    shadows = np.zeros((4, 2))
    for member, row in enumerate(point):
        if row >= 0 and shadow[row, 1] >= 0:
            shadows[shadow[row, 1]] = ideal[member] + 0.3
    fit = marker_ids._Fit(point, 0.1, 1.0)
    found = marker_ids._first(1, known, [(body, fit)], points, shadows)
    if not is_told:
        assert found is None
        return
    assert found.target_id.tolist() == [4, 5, 6, 7, 8]
    off = [0.3 if row >= 0 and row < seen else 0.0 for row in point]
    np.testing.assert_allclose(
        found.uv - ideal, np.repeat(np.array(off)[:, None], 2, 1), atol=1e-3
    )


def test_markers_beyond_the_image_are_not_told(rig):
    _, known = rig
    shape = RNG.normal(0, 15, (4, 3))
    body = Body('bone', np.arange(4), shape, np.full(4, 0.1))
    width, height = known.calibrations['a'].image_size
    shadow = np.zeros((4, 3), int) + np.arange(4)[:, None]
    points = ShadowPoints(shape, np.ones(4), shadow)
    places = np.array([[5.0, 5], [width - 1.5, 5], [width - 0.5, 5], [5, height - 0.5]])
    found = marker_ids._first(
        0, known, [(body, marker_ids._Fit(np.arange(4), 0.1, 1.0))], points, places
    )
    assert found.target_id.tolist() == [0, 1]
