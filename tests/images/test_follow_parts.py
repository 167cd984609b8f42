# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Parts of following and of finding: limits, written-out sums, and shadows that touch."""

import functools
from dataclasses import replace
from itertools import permutations, product
from math import comb
from types import SimpleNamespace as Fake

import cv2
import numpy as np
import pytest
from scipy.spatial.distance import pdist
from scipy.spatial.transform import Rotation

from fluoro_calib_ros.bodies.body import Body
from fluoro_calib_ros.errors import DataError
from fluoro_calib_ros.findings import Kind
from fluoro_calib_ros.images import following, marker_ids, matching
from fluoro_calib_ros.images.clipping import UNCLIPPED, Clipping
from fluoro_calib_ros.images.fine_grid import Absorbers, FineGrid
from fluoro_calib_ros.images.lattice import GridPose
from fluoro_calib_ros.images.light import LAGS, Light, Noise
from fluoro_calib_ros.images.marker_fit import MarkerGuess, fit_markers
from fluoro_calib_ros.images.marker_intensity import (
    FilteredImage,
    LightWindows,
    _rise,
    first_shadows,
)
from fluoro_calib_ros.images.marker_motion import MarkerStates, MeasuredMarkers, Motion
from fluoro_calib_ros.images.marker_points import ShadowPoints
from fluoro_calib_ros.images.marker_rays import MarkerBodies
from fluoro_calib_ros.images.marker_watch import MarkerDoubts
from fluoro_calib_ros.images.markers import FirstMarkers, MarkerTracker
from fluoro_calib_ros.images.matching import PhantomModel
from fluoro_calib_ros.images.measurement import circles, measure_beads
from fluoro_calib_ros.images.pose_search import _hits, triples_of
from fluoro_calib_ros.images.profile import Profile
from fluoro_calib_ros.images.texture import window_offsets
from fluoro_calib_ros.images.view import Lens, View

RNG = np.random.default_rng(31)
WHITE = np.zeros((2 * LAGS + 1, 2 * LAGS + 1))
WHITE[LAGS, LAGS] = 1.0


# ---- shadows that touch


def light_behind(places, radius, blur, attenuation, ways=(0.0,), shape=(70, 100)):
    """Return light (h, w) without noise behind spheres that stay at each of the ways (q, 2)."""
    fine = 5
    v, u = (np.mgrid[: fine * shape[0], : fine * shape[1]] + 0.5) / fine - 0.5
    total = np.zeros_like(u)
    for way in ways:
        light = np.full(u.shape, 20000.0)
        for x, y in np.asarray(places) + way:
            squared = (u - x) ** 2 + (v - y) ** 2
            light *= np.exp(-2 * attenuation * np.sqrt(np.maximum(1 - squared / radius**2, 0)))
        total += light / len(ways)
    total = cv2.GaussianBlur(total, (0, 0), fine * blur)
    return total.reshape(shape[0], fine, shape[1], fine).mean(axis=(1, 3))


@functools.cache
def touching(apart):
    places = np.array([[30.3, 35.2], [30.3 + 0.8 * apart, 35.2 + 0.6 * apart], [75.4, 30.1]])
    return places, light_behind(places, 5.0, 1.2, 0.9)


@pytest.mark.parametrize('apart', [4.0, 7.0, 10.0])
def test_beads_that_touch_are_where_they_are_without_noise(apart):
    """The overlap of two shadows is blurred as a whole, not as a product of blurred shadows."""
    places, light = touching(apart)
    found = measure_beads(
        Light(light.astype(np.float32), np.ones(light.shape, bool)),
        places + [[0.4, -0.3], [-0.3, 0.3], [0.3, 0.3]],
        circles(np.ones(3)),
        profile=Profile(5.0, 1.2, 0.9),
        noise=Noise(100.0**2, 0.0, WHITE),
    )
    assert found.measured.all() and found.overlapped.tolist() == [True, True, False]
    np.testing.assert_allclose(found.uv, places, atol=0.02)
    np.testing.assert_allclose(found.depth, 1.0, atol=0.01)


def looked(image, clipping=UNCLIPPED):
    return Fake(field=np.ones(image.shape, bool), white=None, clipping=clipping)


@pytest.mark.parametrize(
    ('apart', 'motion'), [(4.0, (0.0, 0.0)), (10.0, (0.0, 0.0)), (7.0, (2.0, -1.0))]
)
def test_markers_that_touch_are_where_they_are_without_noise(apart, motion):
    places, light = touching(apart)
    if any(motion):
        ways = (np.arange(8) - 3.5)[:, None] / 8 * motion
        light = light_behind(places, 5.0, 1.2, 0.9, ways)
    image = np.rint(light).astype(np.uint16)
    windows = LightWindows(image, looked(image))
    guess = MarkerGuess(
        places + [[0.4, -0.3], [-0.3, 0.3], [0.3, 0.3]],
        np.ones(3),
        np.full(3, 0.15),
        np.tile(motion, (3, 1)),
    )
    found = fit_markers(windows, guess, Profile(5.0, 1.2, 0.9), Noise(100.0**2, 0.0, WHITE), {})
    assert found.measured.all() and found.overlapped.tolist() == [True, True, False]
    np.testing.assert_allclose(found.uv, places, atol=0.05)
    np.testing.assert_allclose(found.depth, 1.0, atol=0.03)


def test_markers_beside_light_that_is_clipped_have_honest_sigmas():
    """The light increases across the marker, and a third of its window is clipped."""
    rng = np.random.default_rng(5)
    place = np.array([[20.3, 20.6]])
    profile, noise = Profile(5.0, 1.2, 0.9), Noise(0.1, 1.0, WHITE)
    x = np.arange(41) - 20
    light = 820 * np.exp(0.01 * x) * light_behind(place, 5.0, 1.2, 0.9)[:41, :41] / 20000
    errors = {clipping: [] for clipping in (UNCLIPPED, Clipping(high=850.0))}
    for _ in range(40):
        image = np.minimum(rng.poisson(light), 850).astype(np.uint16)
        start = place + rng.normal(0, 0.2, (1, 2))
        guess = MarkerGuess(start, np.ones(1), np.full(1, 0.2), np.zeros((1, 2)))
        for clipping, normalised in errors.items():
            windows = LightWindows(image, looked(image, clipping))
            found = fit_markers(windows, guess, profile, noise, {})
            normalised.append((found.uv - place)[0] / found.sigma)
    without, honest = (np.sqrt(np.mean(np.square(values))) for values in errors.values())
    assert 0.8 < honest < 1.25 < without


@pytest.mark.parametrize('blur', [0.5, 2.0])
@pytest.mark.parametrize('place', [(1.3, -0.4), (6.0, 3.0)])
def test_light_is_blurred_behind_two_beads_that_move(blur, place):
    """Two Gaussian shadows at one place, inside the window or at its border, move by 2 px."""
    offset = window_offsets(6.0)
    path = np.array([[0.0, 0.0], [2.0, 0.0]])
    beads = Absorbers(
        np.broadcast_to(place + path[:, None, None], (2, 1, 2, 2)),
        np.array([0.3, 0.7]),
        depth=np.full((1, 2), 0.5),
        extent_px=np.full((1, 2), 5.0),
        absorbed=lambda _, x, y: np.exp(-0.5 * (x * x + y * y)),
    )
    (light,) = FineGrid(offset, Profile(3.0, blur, 1.0)).light_behind(beads)

    def blurred(variance, shift):
        wider = variance + blur**2 + 1 / 12
        squared = np.sum((offset - place - shift) ** 2, axis=1)
        return variance / wider * np.exp(-0.5 * squared / wider)

    # (1 - s / 2)^2 = 1 - s + s^2 / 4, and s^2 is a Gaussian of half the variance.
    first, second = (1 - blurred(1.0, shift) + blurred(0.5, shift) / 4 for shift in path)
    np.testing.assert_allclose(light, 0.3 * first + 0.7 * second, atol=0.02)


# ---- responses


def test_noise_of_a_response_grows_in_the_dark():
    around = np.array([1000.0, 250.0, 4000.0, 0.0])
    np.testing.assert_allclose(_rise(1000.0, around), [1, 2, 1, np.sqrt(1000)])


def test_noise_in_the_dark_does_not_determine_how_markers_look():
    """Relative to hardly any light, a grey value more or less is a strong response."""
    rng = np.random.default_rng(5)
    image = np.full((300, 300), 200.0)
    image[:, 200:] = 0.3
    uv = np.stack(np.meshgrid([30.0, 70, 110, 150], [50.0, 150, 250]), axis=-1).reshape(-1, 2)
    v, u = np.mgrid[:300, :300]
    for x, y in uv:
        image *= 1 - 0.4 * np.exp(-0.5 * ((u - x) ** 2 + (v - y) ** 2) / 1.5**2)
    image = rng.poisson(image).astype(np.uint8)
    shadows = first_shadows(FilteredImage(image).of_scale(1.5), len(uv)).strongest(len(uv))
    distance = np.linalg.norm(shadows.uv[:, None] - uv, axis=2)
    assert (distance.min(axis=0) < 1).all()


def test_voters_are_counted_where_they_are_found_in_the_field():
    """A pixel begins half a pixel before its centre; the value 2 marks pixels off the field."""
    field = np.zeros((9, 12), np.uint8)
    field[6, 4] = 1
    field[2, 9] = 2
    padded = np.pad(field, 1, constant_values=2)
    voter = np.array([[[0.0], [0.0], [0.0]], [[1.0], [0.0], [0.0]], [[0.0], [2.0], [0.0]]])
    axes = np.array([[[5.0, -4.0], [40.0, 40.0], [0.0, 0.0]]], np.float32)
    for centre, hits, inside in (
        ((4.4, 6.4), 1, 1),  # itself; the other is off the field
        ((3.6, 5.6), 1, 1),
        ((4.6, 6.4), 0, 2),
        ((4.4, 6.6), 0, 2),
        ((3.4, 5.6), 0, 2),
    ):
        found = _hits(np.array(centre), axes, np.array([0]), voter, padded)
        assert found[0].tolist() == [hits] and found[1].tolist() == [inside], centre


# ---- motion


def moving(uv, velocity=0.0, sd=0.3, speed_sd=0.1):
    motion = Motion.start(np.array(uv, dtype=float), sd)
    motion.velocity[:] = velocity
    motion.covariance[:, 1, 1] = speed_sd**2
    return motion


def test_acceleration_is_learned_from_innovations_of_settled_markers():
    motion = moving(np.zeros((4, 2)), sd=1.0)
    motion.covariance[3, 1, 1] = 9.0  # unsettled: a quarter of the first variance
    motion.squared[:] = [0.5, 0.5, 0.5, 0.5]
    sigma = np.array([0.3, 0.3, 5.0, 0.3])
    np.testing.assert_allclose(motion.innovation_variance(sigma), 1 + sigma**2 + 0.05**2)
    uv = np.array([[3.0, 4.0], [0.0, 0.0], [1.0, 0.0], [3.0, 4.0]])
    motion.update(np.arange(4), uv, sigma, 2)
    seen = 12.5 / 16 - 0.09  # half a squared length over frames^4, minus sigma^2
    np.testing.assert_allclose(motion.squared, [0.45 + 0.1 * seen, 0.45, 0.45, 0.5])
    gain = 1 / (1 + sigma**2 + 0.05**2)
    np.testing.assert_allclose(motion.uv, gain[:, None] * uv)
    np.testing.assert_allclose(motion.covariance[:, 0, 0], 1 - gain)


def test_a_prediction_is_that_of_a_white_acceleration():
    motion = moving([[10.0, 20]], [2.0, -1.0], sd=0.5, speed_sd=0.4)
    motion.covariance[0, 0, 1] = motion.covariance[0, 1, 0] = 0.05
    motion.squared[:] = 0.3
    before = motion.covariance[0].copy()
    motion.predict(3)
    move = np.array([[1.0, 3.0], [0.0, 1.0]])
    noise = 0.3 * np.array([[3**4 / 4, 3**3 / 2], [3**3 / 2, 3**2]])
    np.testing.assert_allclose(motion.covariance[0], move @ before @ move.T + noise)
    assert motion.uv.tolist() == [[16.0, 17.0]]
    led = moving([[0.0, 0], [0, 0]])
    led.squared[:] = [0.2, 0.6]
    led.predict(1, np.array([True, False]))
    told = led.covariance[:, 1, 1] - 0.01
    np.testing.assert_allclose(told, [0.25 * 0.4, 0.6])
    led.covariance[0, 0, 0] = 1e5
    led.predict(1)
    assert led.covariance[0, 0, 0] == pytest.approx(3600.0)


def test_markers_led_by_others_are_where_their_standard_deviation_says():
    """Of 14 markers of a body that is jolted, four are hidden for 30 images.

    Half of an acceleration is that of the body: 0.75 of its variance.
    """
    told = []
    for seed in range(15):
        rng = np.random.default_rng([3, seed])
        uv = rng.uniform(100, 900, (14, 2))
        velocity = np.zeros((14, 2))
        motion = Motion.start(uv, 0.05)
        led = None
        for image in range(90):
            own = 0.5 * rng.normal(size=(14, 2))
            acceleration = 0.3 * (np.sqrt(0.75) * rng.normal(size=2) + own)
            uv = uv + velocity + acceleration / 2
            velocity = velocity + acceleration
            motion.predict(1, led)
            before = motion.velocity.copy()
            seen = (np.arange(14) >= 4) | (image < 60)
            rows = np.flatnonzero(seen)
            measured = uv[rows] + rng.normal(0, 0.05, (len(rows), 2))
            motion.update(rows, measured, np.full(len(rows), 0.05), 1)
            led = motion.lead(seen, before, np.ones(14, bool))
            if image >= 75:
                told.append((motion.uv[:4] - uv[:4]) ** 2 / motion.variance[:4, None])
    assert 0.7 < np.mean(told) < 2.0


@pytest.mark.parametrize(('together', 'is_known'), [(4, False), (5, True)])
def test_velocities_are_compared_once_markers_were_seen_together(together, is_known):
    motion = moving(np.zeros((6, 2)), 1.0)
    motion.velocity[0] = [4.0, 5.0]
    motion.unlike[:] = 0.09
    motion.together[:] = together
    rows, ratio, others = motion.strangeness(np.ones(6, bool))
    assert rows.tolist() == list(range(6)) and others.tolist() == [[1, 1]] * 6
    expected = 25 / (0.09 + 0.5**2) if is_known else 0.0
    assert ratio[0] == pytest.approx(expected)
    assert len(motion.strangeness(np.arange(6) < 4)[0]) == 0  # none has four others to compare


# ---- a tracker that is given the places of markers


def tracker():
    out = MarkerTracker(first=FirstMarkers(np.array([3, 5, 9]), np.zeros((3, 2))))
    motion = moving([[100.0, 100], [200, 100], [300, 100]], [1.0, 0.0], sd=1.0)
    states = MarkerStates.start(motion, np.array([0, 1, 2]))
    out._followed = Fake(states=states, doubts=MarkerDoubts(3), size=(500, 400))
    return out, states


def test_a_marker_is_put_where_a_person_sees_it_unless_it_is_there_anyway():
    one, states = tracker()
    reach = 3.0 * np.sqrt(1 + 1.5**2)
    given = np.array([[100.0, 100 + 0.99 * reach], [200, 100 + 1.01 * reach], [300, 100]])
    one.place(FirstMarkers(np.array([3, 5, 9]), given))
    assert one._place_given().tolist() == [0, 1, 2]
    np.testing.assert_allclose(states.motion.uv, [[100, 100], given[1], [300, 100]])
    assert states.unseen.tolist() == [0, 1, 1]
    np.testing.assert_allclose(states.motion.covariance[1:, 0, 0], 1.5**2)
    assert states.motion.velocity[1].tolist() == [0, 0] and not states.motion.settled[1]
    assert one._place_given().tolist() == []


def test_given_markers_that_are_measured_are_sure_unless_their_shadows_meet():
    one, _ = tracker()
    doubts = one._followed.doubts
    for row in range(3):
        doubts.add(row, 4)
    kinds = Kind.OTHER_SHADOW, Kind.OTHER_SHADOW, Kind.MARKER_FOUND_AGAIN, Kind.SHADOWS_MET
    ids = (3,), (5,), (9,), (3, 9)
    told = tuple(Fake(kind=kind, place=Fake(target_id=of)) for kind, of in zip(kinds, ids))
    left = one._believe(np.array([0]), told)
    assert left == told[1:] and doubts.doubtful.tolist() == [False, True, True]
    doubts.add_pair(0, 2, 5)
    one._believe(np.array([0]), told)
    assert doubts.doubtful.tolist() == [True, True, True]
    doubts.part(0, 2)
    assert one.doubtful().tolist() == [5, 9] and one.unsure().tolist() == [5, 9]
    assert one.doubted_since(5) == 4
    one.forget(9)
    assert one.doubtful().tolist() == [5]
    assert one._followed.states.unseen[2] == one.options.lost_after + 1
    with pytest.raises(DataError, match='no marker 4'):
        one.doubt(4, 9)


def test_following_begins_with_four_markers_that_are_suggested_closely():
    ids = np.arange(6)
    one = MarkerTracker(first=None, later=ids)
    uv = np.array([[5.0, 5], [50, 60], [70, 20], [98.9, 78.9], [99, 40], [40, 0]])
    one.suggest(ids, uv, np.zeros((6, 2)), np.full(6, 1.49))
    places = one._first_places((80, 100), 7)
    assert np.isfinite(places[:, 0]).tolist() == [True] * 4 + [False] * 2  # two at the edge
    np.testing.assert_allclose(places[:4], uv[:4])
    with pytest.raises(DataError):
        one._first_places((80, 100), 36)  # none before 30 more images
    assert len(one._first_places((80, 100), 37)) == 6
    other = MarkerTracker(first=None, later=ids)
    other.suggest(ids[:4], uv[:4], np.zeros((4, 2)), np.array([1.0, 1.0, 1.0, 1.5]))
    with pytest.raises(DataError):
        other._first_places((80, 100), 7)


def test_an_image_takes_at_least_no_time_and_says_where_markers_are_believed():
    one, states = tracker()
    one._followed.search = Fake(lost=lambda states: states.unseen > 1)
    states.motion.uv[1] = [-2e4, -2e4]
    found = one._result(MeasuredMarkers.nothing(3), (), None, 0.0)
    assert found.missing.tolist() == [3, 5, 9] and found.lost.tolist() == [False, False, True]
    assert np.isnan(found.predicted[1]).all() and found.predicted[2].tolist() == [300, 100]
    measured = replace(MeasuredMarkers.nothing(3), measured=np.array([True, False, False]))
    assert one._result(measured, (), None, 0.0).missing.tolist() == [5, 9]


# ---- bodies in shadows


@pytest.mark.parametrize('count', [2, 3, 4])
def test_bodies_of_three_markers_give_a_pose(monkeypatch, count):
    made = []
    monkeypatch.setattr(
        'fluoro_calib_ros.images.marker_rays.BodyTracker', lambda rig, bodies: made.append(bodies)
    )
    body = Body('bone', np.array([2, 4, 6, 8]), RNG.normal(0, 9, (4, 3)), np.full(4, 0.1))
    known = np.array([1, *[2, 4, 6, 8][:count]])
    found = MarkerBodies(None, known, [body])
    assert len(found._bodies) == len(made) == (count > 2)
    if count > 2:
        assert found._rows[0].tolist() == list(range(1, count + 1))
        assert made[0][0].target_id.tolist() == [2, 4, 6, 8][:count]
        assert made[0][0].sd_mm == pytest.approx(np.hypot(0.1, 0.1))


def test_expected_fits_by_chance_are_those_of_points_anywhere():
    xyz = RNG.uniform(-50, 50, (30, 3))
    body = Body('bone', np.arange(6), RNG.normal(0, 12, (6, 3)), np.full(6, 0.1))
    point = np.array([3, 7, -1, 9, 11, 2])
    fit = marker_ids._Fit(point, 0.2, 4.0)
    density = 30 / np.prod(np.ptp(xyz, axis=0))
    d = pdist(body.xyz_mm[point >= 0]).mean()
    shell = density * 4 * np.pi * d**2 * 2 * 0.4
    ring = density * 2 * np.pi * (d / 2) * 0.8**2
    ball = density * 4 / 3 * np.pi * 0.4**3
    expected = comb(6, 5) * 30 * shell * ring * ball**2
    assert marker_ids._by_chance(body, fit, xyz, density / 2) == pytest.approx(expected)
    # A sphere, a circle and two balls.
    assert marker_ids._by_chance(body, fit, xyz, 3 * density) == pytest.approx(3**4 * expected)


def test_points_around_a_fit_are_those_of_other_shadows():
    """Letters of a label are close together: four of them resemble a body by chance."""
    body = Body('bone', np.arange(4), RNG.normal(0, 12, (4, 3)), np.full(4, 0.1))
    extent = pdist(body.xyz_mm).max()
    far = np.array([[-900.0, -900, -900], [900, 900, 900]])
    xyz = np.concatenate([RNG.uniform(-0.3, 0.3, (30, 3)) * extent, far])
    shadow = np.tile(np.arange(32)[:, None], 2)
    shadow[4:9, 1] = 0  # points of a shadow of the fit
    points = ShadowPoints(xyz, np.full(32, 0.01), shadow)
    free = np.arange(32) != 9
    fit = marker_ids._Fit(np.arange(4), 0.2, 4.0)
    density = marker_ids._around(body, fit, points, free)
    assert density == pytest.approx(20 / (4 / 3 * np.pi * extent**3))


def searched(body, xyz, sd=0.1):
    count = len(xyz)
    points = ShadowPoints(xyz, np.full(count, sd**2), np.zeros((count, 2), int))
    search = marker_ids._Search(body, points, np.ones(count, bool))
    search.run()
    return search


def test_a_body_is_found_among_points_with_its_residuals():
    rng = np.random.default_rng(3)
    shape = rng.normal(0, 15, (5, 3))
    body = Body('bone', np.arange(5), shape, np.full(5, 0.1))
    turn = Rotation.from_rotvec([0.4, -0.9, 0.3])
    there = turn.apply(shape) + [10.0, 5, -3]
    there = there + rng.normal(0, 0.1, there.shape)
    order = np.array([6, 1, 4, 0, 8])
    xyz = rng.uniform(-60, 60, (9, 3))
    xyz[order] = there
    best = searched(body, xyz).best
    assert best.point.tolist() == order.tolist() and best.count == 5
    aligned, _ = Rotation.align_vectors(there - there.mean(axis=0), shape - shape.mean(axis=0))
    left = there - there.mean(axis=0) - aligned.apply(shape - shape.mean(axis=0))
    squares = np.sum(left**2, axis=1)
    assert best.rms_mm == pytest.approx(np.sqrt(np.mean(squares)), rel=1e-6)
    assert best.chi2 == pytest.approx(np.sum(squares) / 0.02, rel=1e-6)
    xyz[8] += [3.0, 0, 0]
    assert searched(body, xyz).best.point.tolist() == [6, 1, 4, 0, -1]
    xyz[0] += [0, 3.0, 0]
    assert searched(body, xyz).best is None
    mirrored = searched(body, xyz * [1, 1, -1])
    assert mirrored.best is None


def test_a_search_has_an_end(monkeypatch):
    body = Body('bone', np.arange(4), RNG.normal(0, 15, (4, 3)), np.full(4, 0.1))
    steps = searched(body, np.zeros((0, 3)).reshape(0, 3)).steps
    monkeypatch.setattr(marker_ids, 'MAX_STEPS', steps)
    searched(body, np.zeros((0, 3)))
    monkeypatch.setattr(marker_ids, 'MAX_STEPS', steps - 1)
    with pytest.raises(DataError, match='too many round shadows'):
        searched(body, np.zeros((0, 3)))


# ---- views that go on, and grids


def some_view(turn, shift):
    rotation = Rotation.from_rotvec(turn).as_matrix()
    position = -rotation.T @ np.array([shift[0], shift[1], 900.0])
    return View(Lens((1000, 800), 4000.0), rotation, position, 4000.0, np.zeros((2, 3)), 2)


@pytest.mark.parametrize('factor', [1.0, 2.5])
def test_a_phantom_goes_on_in_its_way_and_its_turn(factor):
    before, last = some_view([0.1, 0, 0], (0, 0)), some_view([0.1, 0.05, 0], (6, -3))
    centre = np.array([5.0, 10, -4])
    ahead = following.moved_on(before, last, centre, factor)
    turn = Rotation.from_matrix(last.rotation @ before.rotation.T).as_rotvec()
    expected = Rotation.from_rotvec(factor * turn).as_matrix() @ last.rotation
    np.testing.assert_allclose(ahead.rotation, expected, atol=1e-12)
    first, second, third = (
        one.rotation @ (centre - one.position) for one in (before, last, ahead)
    )
    np.testing.assert_allclose(third, second + factor * (second - first), atol=1e-9)
    assert following.moved_on(before, last, centre, 13.0) is None  # would turn by 0.65 rad
    assert following.moved_on(before, last, centre, 12.0) is not None


@pytest.mark.parametrize(
    ('scale', 'beads', 'is_evident', 'fits'),
    [(0.99, 20, True, True), (1.01, 20, True, False), (0.99, 20, False, False),
     (0.99, matching.MIN_BEADS, True, True), (0.99, matching.MIN_BEADS - 1, True, False)],
)  # fmt: skip
def test_a_pose_that_is_followed_has_residuals_as_before(
    monkeypatch, scale, beads, is_evident, fits
):
    monkeypatch.setattr(following, 'is_evident', lambda found: is_evident)
    found = Fake(scale_px=scale, bead=np.arange(beads))
    assert following._fits(found, 1.0) is fits
    assert following._fits(None, 1.0) is False
    monkeypatch.setattr(following, 'settle', lambda view, xyz, seen: found)
    monkeypatch.setattr(following, '_elsewhere', lambda *given: iter([None]))
    seen = Fake(uv=np.zeros((matching.MIN_BEADS, 2)))
    # The limit is 1.5 times the previous scatter plus a tenth of a pixel.
    assert following.follow(seen, Fake(xyz=None), None, 0.6) is (found if fits else None)
    few = Fake(uv=np.zeros((matching.MIN_BEADS - 1, 2)))
    assert following.follow(few, Fake(xyz=None), None, 0.6) is None


def test_extent_of_a_phantom_does_not_depend_on_its_origin():
    xyz = RNG.normal(0, 20.0, (400, 3))
    seen = Fake(uv=500 + 3.0 * xyz[:, :2])
    here, there = (
        matching._scale_by_extent(seen, Fake(xyz=xyz + origin))
        for origin in (0.0, [900.0, -300, 50])
    )
    assert there == pytest.approx(here)
    moved = matching._scale_by_extent(Fake(uv=seen.uv + [3000, 70]), Fake(xyz=xyz))
    assert moved == pytest.approx(here)


@pytest.mark.parametrize(('more', 'could'), [(0, True), (1, True), (3, True), (5, False)])
def test_a_pose_could_be_by_what_speaks_against_it(more, could):
    # A contradiction has a probability of a tenth.
    assert matching._could_be(more, 110, 10) is could
    # If anything may be missing, nothing is certain.
    assert matching._could_be(10 * more - 20, 10, 40)


def grid_match(monkeypatch, scales, regular=False, by_size=None):
    matches = [
        scale and Fake(scale_px=scale, bead=np.arange(20 + k)) for k, scale in enumerate(scales)
    ]
    poses = [GridPose(0, 100, lambda match=match: match) for match in matches]
    monkeypatch.setattr(matching, 'grid_poses', lambda *given: iter(poses))
    monkeypatch.setattr(matching, 'is_evident', lambda found: True)
    monkeypatch.setattr(matching, '_best_by_size', lambda matches, seen, model: by_size)
    found = matching._grid_match(None, None, Fake(xyz=None, regular=regular), None)
    return None if found is None else matches.index(found)


def test_of_two_poses_of_a_grid_one_has_half_the_residuals(monkeypatch):
    assert grid_match(monkeypatch, []) is None
    assert grid_match(monkeypatch, [0.5]) == 0
    assert grid_match(monkeypatch, [0.5, 1.0]) == 0
    assert grid_match(monkeypatch, [0.5, 0.24]) == 1
    assert grid_match(monkeypatch, [0.5, 0.9, 0.24]) == 2
    assert grid_match(monkeypatch, [None, 0.5, None]) == 1
    assert grid_match(monkeypatch, [*[None] * matching.FITTED, 0.5]) is None
    with pytest.raises(DataError, match='ambiguous'):
        grid_match(monkeypatch, [0.5, *[None] * matching.FITTED, 0.5])
    # The first FITTED matches all fit, so that the last one is not fitted.
    assert grid_match(monkeypatch, [0.5, *[1.0] * (matching.FITTED - 1), 0.5]) == 0
    for rival in (0.99, 0.25, 0.5):
        with pytest.raises(DataError, match='ambiguous') as told:
            grid_match(monkeypatch, [0.5, rival])
        assert told.value.finding.numbers == {'beads': 20, 'beads_of_other': 21}
    assert grid_match(monkeypatch, [0.5, 0.5], regular=True) == 0


@pytest.mark.parametrize(
    ('rivals', 'by_size', 'taken'),
    [
        ([], None, 0),
        ([(9.0, 0.2)], None, 0),  # clearly fewer beads
        ([(99.5, 1.0)], 1, 1),
        ([(99.5, 0.24)], 0, 1),  # half the residuals
        ([(99.5, 1.01)], 1, 0),  # twice as large
        ([(99.5, 0.6)], None, None),
    ],
)
def test_of_poses_that_fit_alike_sizes_tell(monkeypatch, rivals, by_size, taken):
    first = Fake(score=100.0, scale_px=0.5, bead=np.arange(40), against=0)
    others = [Fake(score=score, scale_px=scale, bead=np.arange(39)) for score, scale in rivals]
    asked = []
    seen, model = Fake(), Fake(regular=False)
    every = [first, *others]
    monkeypatch.setattr(matching, '_climbed', lambda *given: (first, others))
    monkeypatch.setattr(matching, '_same', lambda one, other: False)

    def best_by_size(matches, *given):
        asked.append((matches, *given))
        return None if by_size is None else every[by_size]

    monkeypatch.setattr(matching, '_best_by_size', best_by_size)
    if taken is None:
        with pytest.raises(DataError, match='ambiguous'):
            matching.unambiguous(first, seen, model)
    else:
        assert matching.unambiguous(first, seen, model) is every[taken]
    assert asked in ([], [(every, seen, model)])
    assert matching.unambiguous(first, seen, Fake(regular=True)) is first


def test_outliers_of_responses_do_not_decide_between_poses():
    """Three of 64 beads are larger, and every seventh response is that of beads that overlap."""
    rng = np.random.default_rng(5)
    size = np.where(np.arange(64) < 3, 0.4, 0.0)
    decided = []
    for _ in range(40):
        uv = rng.uniform(100, 900, (64, 2))
        outlier = np.where(rng.random(64) < 0.15, rng.uniform(-1.5, 1.5, 64), 0)
        response = 2 * size + rng.normal(0, 0.1, 64) + outlier
        sizes = [size, *(rng.permutation(size) for _ in range(23))]
        likelihoods = [matching._likelihood_of_sizes(one, response, uv) for one in sizes]
        order = np.argsort(likelihoods)
        if likelihoods[order[-1]] - likelihoods[order[-2]] > matching.LIKELIER:
            decided.append(order[-1])
    assert len(decided) > 10
    assert set(decided) == {0}


def test_sizes_tell_the_pose_where_most_responses_of_one_half_are_outliers():
    """A sheet covers the left half: its beads overlap, and 60 % of responses tell no size."""
    rng = np.random.default_rng(5)
    size = np.where(np.arange(64) < 12, 0.4, 0.0)
    leads = []
    for _ in range(15):
        uv = rng.uniform(100, 900, (64, 2))
        covered = (uv[:, 0] < 500) & (rng.random(64) < 0.6)
        response = 4 + uv[:, 1] / 4000 + 2 * size + rng.normal(0, 0.1, 64)
        response += covered * rng.uniform(-1.5, 1.5, 64)
        sizes = [size, *(rng.permutation(size) for _ in range(23))]
        likelihoods = [matching._likelihood_of_sizes(one, response, uv) for one in sizes]
        leads.append(likelihoods[0] - max(likelihoods[1:]))
    assert np.count_nonzero(np.array(leads) > matching.LIKELIER) >= 14


def test_one_bead_without_a_response_hardly_matters():
    """No other bead is an outlier: the probability of one is not taken for zero."""
    rng = np.random.default_rng(9)
    size = np.where(np.arange(64) < 12, 0.4, 0.0)
    uv = rng.uniform(100, 900, (64, 2))
    response = 4 + 2 * size + rng.uniform(-0.1, 0.1, 64)
    with_all = matching._likelihood_of_sizes(size, response, uv)
    response[40] = np.log(1e-3)
    assert 5 < with_all - matching._likelihood_of_sizes(size, response, uv) < 20


def bodies_that_learn(monkeypatch, known):
    """Return MarkerBodies of a body with four markers, the data for its shape, and its updates."""
    learned = []
    told = []
    monkeypatch.setattr(
        'fluoro_calib_ros.images.marker_rays.BodyTracker',
        lambda rig, bodies: Fake(reshape=told.append),
    )

    def learned_shape(body, xyz, covariance):
        learned.append((xyz, covariance))
        xyz_mm = np.where(np.isnan(body.xyz_mm), 1.0, body.xyz_mm)
        return replace(body, xyz_mm=xyz_mm, sd_mm=np.full(4, 0.1))

    monkeypatch.setattr('fluoro_calib_ros.images.marker_rays.learned_shape', learned_shape)
    xyz = np.where(np.array(known)[:, None], RNG.normal(0, 9, (4, 3)), np.nan)
    body = Body('bone', np.array([2, 4, 6, 8]), xyz, np.where(known, 0.1, np.nan))
    return MarkerBodies(None, np.array([1, 2, 4, 6, 8]), [body]), learned, told


def seen_at(xyz):
    covariance = np.tile(0.01 * np.eye(3), (5, 1, 1))
    return Fake(xyz_mm=xyz, intersected=Fake(points=Fake(covariance_noise=covariance)))


def test_a_shape_is_learned_from_exposures_of_three_sure_markers(monkeypatch):
    bodies, learned, told = bodies_that_learn(monkeypatch, [False] * 4)
    xyz = RNG.normal(0, 30, (5, 3))
    bodies.learn(seen_at(xyz), np.array([True, True, True, False, False]))
    assert not learned  # only two markers of the body
    for number in range(1, 6):
        bodies.learn(seen_at(xyz + number), np.array([True, True, True, True, False]))
    # The shape is learned at the first, the second and the fourth exposure.
    assert [len(places) for places, _ in learned] == [1, 2, 4] and len(told) == 3
    places, covariance = learned[-1]
    np.testing.assert_allclose(places[3, :3], xyz[1:4] + 4)
    assert np.isnan(places[:, 3]).all() and covariance.shape == (4, 4, 3, 3)
    assert bodies._learned[0].tolist() == [5, 5, 5, 0]


def test_a_known_shape_is_not_learned_and_markers_off_their_place_are_not_used(monkeypatch):
    bodies, learned, _ = bodies_that_learn(monkeypatch, [True] * 4)
    xyz = RNG.normal(0, 30, (5, 3))
    every = np.ones(5, bool)
    bodies.learn(seen_at(xyz), every)
    assert not learned
    bodies, learned, _ = bodies_that_learn(monkeypatch, [True, True, True, False])
    for off, use in ((0.39, True), (0.41, False)):
        bodies.present = replace(bodies.present, xyz_mm=xyz + [0, 0, off] * np.eye(5)[1][:, None])
        del learned[:]
        bodies._seen[0].clear()
        bodies.learn(seen_at(xyz), every)
        assert bool(np.isfinite(learned[0][0][0, 0]).all()) is use  # limit: four times 0.1 mm


def test_bodies_are_lost_whose_pose_is_not_known(monkeypatch):
    tracker = Fake(filter=Fake(alive=np.array([True, False])))
    monkeypatch.setattr(
        'fluoro_calib_ros.images.marker_rays.BodyTracker', lambda rig, bodies: tracker
    )
    one, other = (
        Body(name, ids, RNG.normal(0, 9, (3, 3)), np.full(3, 0.1))
        for name, ids in (('one', np.arange(3)), ('other', np.arange(3, 6)))
    )
    bodies = MarkerBodies(None, np.arange(6), [one, other])
    assert [body.name for body in bodies.lost()] == ['other']
    assert MarkerBodies(None, np.arange(2), [one]).lost() == ()


@pytest.mark.parametrize(
    ('sure', 'agree', 'alive', 'is_used'),
    [(2, 4, False, True), (2, 3, False, False), (3, 4, False, False), (2, 4, True, False)],
)
def test_doubtful_ids_that_fit_a_shape_support_each_other(
    monkeypatch, sure, agree, alive, is_used
):
    """It requires a lost body and at most two sure markers, too few for its pose."""
    tracker = Fake(filter=Fake(alive=np.array([alive])))
    monkeypatch.setattr(
        'fluoro_calib_ros.images.marker_rays.BodyTracker', lambda rig, bodies: tracker
    )
    body = Body('one', np.arange(5), RNG.normal(0, 9, (5, 3)), np.full(5, 0.1))
    bodies = MarkerBodies(None, np.arange(5), [body])
    doubtful = np.tile(np.arange(5) >= sure, (2, 1))
    agrees = np.tile(np.arange(5) < agree, (2, 1))
    exposure = Fake(
        corrected=np.zeros((2, 5, 2)),
        doubtful=doubtful,
        agree=agrees,
        sure=(agrees & ~doubtful).all(axis=0),
    )
    found = bodies._usable(exposure)
    assert found.tolist() == (agrees if is_used else agrees & ~doubtful).tolist()


@pytest.mark.parametrize('needed', [1, 3, 9, 16, 20])
def test_sizes_of_shadows_are_tried_until_all_bodies_are_found(monkeypatch, needed):
    """Each size is tried with as many of the strongest shadows as markers, then as one body.

    It is tried first with the likely polarity of each image, then with dark and bright shadows.
    """
    looks = []

    class Search:
        def __init__(self, images, rig, bodies):
            self.missing = list(bodies)

        def look(self, scale, strongest, bright):
            looks.append((bright, scale, strongest))
            if len(looks) == needed:
                self.missing = []

        def markers(self):
            return 'found'

    monkeypatch.setattr(marker_ids, '_ImageSearch', Search)
    monkeypatch.setattr(marker_ids, 'check_image', lambda image, size: None)
    bodies = [
        Body(name, ids, RNG.normal(0, 9, (4, 3)), np.full(4, 0.1))
        for name, ids in (('one', np.arange(4)), ('other', np.arange(4, 8)))
    ]
    rig = Fake(fluoroscopes=('a', 'b'))
    calibrations = dict.fromkeys('ab', Fake(image_size=(9, 9)))
    images = dict.fromkeys('ab')
    assert marker_ids.identify_markers(images, calibrations, rig, bodies) == 'found'
    every = list(product((None, False, True), marker_ids.MARKER_SCALES[:3], (8, 4)))
    assert looks == every[: min(needed, 18)]
    with pytest.raises(DataError, match='no body with 4 markers'):
        marker_ids.identify_markers(images, calibrations, rig, [])


def image_search(monkeypatch, outcomes):
    """Return a search of bodies 'one' and 'other', and the calls of its parts."""
    filtered, asked = [], []
    monkeypatch.setattr(
        marker_ids,
        'FilteredImage',
        lambda image: Fake(of_scale=lambda scale: filtered.append((image, scale)) or image),
    )

    def first_shadows(lights, count):
        if outcomes[0] == 'blind':
            outcomes.pop(0)
            raise DataError('nothing round')
        return Fake(strongest=lambda most: Fake(uv=(lights, count)))

    def find_bodies(shadows, rig, missing):
        asked.append((shadows, [body.name for body in missing]))
        return outcomes.pop(0)

    monkeypatch.setattr(marker_ids, 'first_shadows', first_shadows)
    monkeypatch.setattr(marker_ids, 'find_bodies', find_bodies)
    rig = Fake(orientation=Fake(fluoroscopes=('a', 'b', 'c')))
    images = {'a': 'A', 'b': 'B', 'c': 'C'}
    bodies = [Fake(name='one'), Fake(name='other')]
    return marker_ids._ImageSearch(images, rig, bodies), filtered, asked


def told(*numbers):
    return FirstMarkers(np.array(numbers), np.repeat(np.array(numbers, float)[:, None], 2, axis=1))


def test_what_one_size_of_shadows_does_not_show_is_looked_for_with_another(monkeypatch):
    why, later = DataError('other'), DataError('later')
    outcomes = [({'a': told(1, 2), 'b': told(1)}, {'other': why}), ({'a': told(7)}, {})]
    search, filtered, asked = image_search(monkeypatch, outcomes)
    search.look(2.0, 8)
    assert [body.name for body in search.missing] == ['other']
    search.look(2.0, 4)
    assert sorted(filtered[:3]) == [(image, 2.0) for image in 'ABC'] and search.missing == []
    assert asked[0] == ([(image, 8) for image in 'ABC'], ['one', 'other'])
    assert asked[1] == ([(image, 4) for image in 'ABC'], ['other'])
    found = search.markers()
    assert {name: one.target_id.tolist() for name, one in found.items()} == {
        'a': [1, 2, 7],
        'b': [1],
    }
    assert found['a'].uv[:, 0].tolist() == [1, 2, 7]
    search, filtered, _ = image_search(monkeypatch, [({}, {'one': why, 'other': later})] * 2)
    search.look(2.0, 8)
    search.look(3.0, 8)
    assert len(filtered) == 6
    with pytest.raises(DataError) as first:
        search.markers()
    assert first.value is why
    search, *_ = image_search(monkeypatch, ['blind', ({'b': told(1)}, {})])
    search.look(2.0, 8)
    assert len(search.missing) == 2
    with pytest.raises(DataError, match='nothing round'):
        search.markers()
    search.look(2.0, 4)
    with pytest.raises(DataError, match='fluoroscope a sees none'):
        search.markers()


def test_residuals_have_to_distinguish_neighbouring_beads():
    view = Fake(principal_distance_px=5000.0, depth=lambda xyz: np.full(len(xyz), 1000.0))
    model = Fake(xyz=np.zeros((40, 3)), spacing_mm=10.0)
    # Two neighbours, three standard deviations off each, in opposite directions: half a spacing.
    largest_px = 5 * 10.0 / 2 / (3 * np.sqrt(2))
    best = Fake(view=view, bead=np.arange(20), scale_px=0.99 * largest_px)
    matching._check_residuals(best, model)
    best.scale_px = 1.01 * largest_px
    with pytest.raises(DataError, match='too large to distinguish beads') as told:
        matching._check_residuals(best, model)
    assert told.value.finding.kind is Kind.POSE_UNSURE
    assert told.value.finding.numbers['residual_mm'] == pytest.approx(1.01 * largest_px / 5)


@pytest.mark.parametrize(
    ('found', 'explained', 'beads', 'cause'),
    [
        (0.72, 0.4, 10, None),
        (0.71, 0.4, 10, 'predicts 30 beads in the image, of which only 71% are found'),
        (0.6, 0.85, 10, None),
        (0.6, 0.84, 40, 'of which only 60% are found'),
        (0.9, 0.9, 9, 'of which only 90% are found'),
        (0.9, 0.39, 10, 'explains only 39% of the beads in its outline'),
        (0.9, 0.39, 9, 'of which only 90% are found'),
        (0.3, 0.39, 10, 'explains only 39%'),
    ],
)
def test_a_pose_is_sure_by_what_it_predicts_and_by_what_it_explains(
    found, explained, beads, cause
):
    evidence = matching.MIN_EVIDENCE
    best = Fake(
        found=found,
        apart=found,
        explained=explained,
        bead=np.arange(beads),
        expected=30,
        evidence=evidence,
    )
    if cause is None:
        matching._check_evidence(best)
        best.evidence = evidence - 0.1
        cause = 'may fit by chance'
    with pytest.raises(DataError, match=cause) as told:
        matching._check_evidence(best)
    finding = told.value.finding
    assert finding.kind is Kind.POSE_UNSURE
    assert finding.numbers == {
        'expected': 30,
        'found': found,
        'explained': explained,
        'evidence': best.evidence,
    }


def test_poses_are_compared_by_the_sizes_of_the_beads_that_all_of_them_have(monkeypatch):
    """Logarithms of shadow sizes and of responses are compared for at least ten common beads."""
    xyz = RNG.normal(0, 20, (14, 3))
    diameter = np.where(np.arange(14) % 3, 2.0, 3.0)
    seen = Fake(strength=RNG.uniform(0.5, 2, 16), uv=RNG.uniform(0, 900, (16, 2)))
    seen.strength[5] = 0.0
    matches = [
        Fake(
            bead=np.roll(np.arange(14), shift)[: 14 - drop],
            detection=(np.arange(14) + 1)[: 14 - drop],
            view=Fake(depth=lambda xyz, sign=sign: sign * (900 + xyz[:, 2])),
        )
        for shift, drop, sign in ((0, 0, 1), (3, 2, -1))
    ]
    asked, values = [], [0.0, 0.0]

    def likelihood(size, response, uv):
        asked.append((size, response, uv))
        return values[len(asked) % 2 - 1]

    monkeypatch.setattr(matching, '_likelihood_of_sizes', likelihood)
    model = PhantomModel.of(xyz, diameter)
    values[:] = [5.0, 5.0 + matching.LIKELIER]
    assert matching._best_by_size(matches, seen, model) is matches[1]
    for one, (size, response, uv) in zip(matches, asked):
        bead, detection = one.bead[:12], one.detection[:12]
        np.testing.assert_allclose(size, np.log(diameter[bead] / (900 + xyz[bead, 2])))
        expected = np.log(np.maximum(seen.strength[detection], 1e-3))
        np.testing.assert_allclose(response, expected)
        assert uv.tolist() == seen.uv[detection].tolist()
    values[:] = [5.0, 4.9 + matching.LIKELIER]
    assert matching._best_by_size(matches, seen, model) is None  # no pose stands out
    values[:] = [99.0, 5.0]
    assert matching._best_by_size(matches, seen, model) is matches[0]
    matches[1].detection = matches[1].detection + 3  # nine beads in common
    matches[0].detection, matches[0].bead = matches[0].detection[:12], matches[0].bead[:12]
    assert matching._best_by_size(matches, seen, model) is None
    for other in (None, np.full(14, 2.0)):
        assert matching._best_by_size(matches, seen, PhantomModel.of(xyz, other)) is None


def test_a_shadow_that_a_body_has_is_not_that_of_another(monkeypatch):
    """The larger body chooses first; a point whose shadows are all taken is not free."""
    shadow = np.array([[0, 0], [1, 1], [2, 2], [0, 1], [3, 0]])
    points = ShadowPoints(np.zeros((5, 3)), np.ones(5), shadow)
    asked = []

    def fit(body, points, free):
        asked.append((body.name, free.tolist()))
        if body.name == 'middle':
            raise DataError('none')
        return marker_ids._Fit(np.array([1, -1, 0]), 0.1, 1.0)

    monkeypatch.setattr(marker_ids, 'shadow_points', lambda shadows, rig: points)
    monkeypatch.setattr(marker_ids, '_fit', fit)
    monkeypatch.setattr(
        marker_ids, '_first', lambda view, *given: (view, given[-1]) if view else None
    )
    sizes = {'small': 3, 'large': 5, 'middle': 4}
    bodies = [Fake(name=name, target_id=range(count)) for name, count in sizes.items()]
    rig = Fake(orientation=Fake(fluoroscopes=('a', 'b')))
    found, missing = marker_ids.find_bodies(['A', 'B'], rig, bodies)
    assert found == {'b': (1, 'B')} and list(missing) == ['middle']
    every, left = [True] * 5, [False, False, True, False, True]
    assert asked == [('large', every), ('middle', left), ('small', left)]


def test_triples_of_few_beads_are_all_of_them():
    xyz = 20.0 * np.eye(4, 3)
    found = triples_of(xyz, 12).bead
    assert sorted(map(tuple, found.tolist())) == sorted(permutations(range(4), 3))
