# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The drift watch: rate of false alarms, and place and size of the drifts found."""

import copy
import functools
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.distance import pdist

from fluoro_calib_ros.bodies.body import Body, declared_bodies
from fluoro_calib_ros.checks.body_watch import BodyWatch
from fluoro_calib_ros.checks.drift_charts import (
    ERROR,
    OK,
    WARN,
    CusumCharts,
    DriftOptions,
    EpipolarObservations,
    ImageAreas,
)
from fluoro_calib_ros.checks.drift_watch import DriftWatch
from fluoro_calib_ros.checks.pair_watch import SystematicErrorField
from fluoro_calib_ros.errors import DataError
from fluoro_calib_ros.findings import Kind
from fluoro_calib_ros.photogrammetry.rig_orientation import RigOrientation
from fluoro_calib_ros.reconstruction.epipolar import EpipolarGeometry
from fluoro_calib_ros.reconstruction.intersection import Intersector
from fluoro_calib_ros.reconstruction.reconstruct import IntersectedViews, MatchedViews
from fluoro_calib_ros.simulation.rig import virtual_rig

sys.path.append(str(Path(__file__).resolve().parents[2]))  # benchmarks are not installed
from benchmarks.drift import (
    BEADS,
    FRAMES,
    IDS,
    QUARTERS,
    RATE_HZ,
    WHOLE,
    Drift,
    Scene,
    blocks,
    detection,
    feed,
    intersected,
    markers,
)

SIZES = {'a': (1024, 1024), 'b': (1024, 1024)}
NORMAL = np.array([0.0, 1.0])
FACTOR = np.sqrt(0.5)
SYSTEMATIC_PX = 0.05
# One false alarm in 10 minutes and long blocks, so that hours are simulated in seconds.
OFTEN = DriftOptions(
    error_interval_h=1 / 6, warn_interval_h=1 / 6, cells=2, block_s=1.0, learn_s=30.0
)


def moving(rng, count, seconds, rate_hz):
    """Pixels (T, count, 2) of markers in both images; v is equal, as with horizontal epipolar
    lines.
    """
    t = np.arange(int(seconds * rate_hz)) / rate_hz
    phase = rng.uniform(0, 2 * np.pi, (3, count))
    speed = rng.uniform(0.05, 0.4, (3, count))
    middle = rng.uniform(350, 670, (3, count))
    size = rng.uniform(150, 300, (3, count))
    ua, ub, v = (
        middle[i] + size[i] * np.sin(2 * np.pi * speed[i] * t[:, None] + phase[i])
        for i in range(3)
    )
    return np.stack([ua, v], axis=2), np.stack([ub, v], axis=2)


def autoregressive(rng, shape, correlation):
    """Noise (T, n) of variance 1 with a given correlation between successive rows."""
    noise = rng.normal(size=shape)
    for k in range(1, len(noise) if correlation else 0):
        noise[k] = correlation * noise[k - 1] + np.sqrt(1 - correlation**2) * noise[k]
    return noise


def residuals(ids, uv_a, uv_b, residual, systematic=SYSTEMATIC_PX):
    """EpipolarObservations with residuals (n,) of markers with ids (n,)."""
    n = len(ids)
    normal = np.broadcast_to(NORMAL, (n, 2))
    factor = np.full(n, FACTOR)
    return EpipolarObservations(
        residual,
        sd=np.full(n, 0.25),
        sd_total=np.full(n, np.hypot(0.25, systematic)),
        normal_a=normal,
        normal_b=normal,
        factor_a=factor,
        factor_b=factor,
        target_id=ids,
        uv_a=uv_a,
        uv_b=uv_b,
        noise=np.full(n, 0.25**2),
    )


def add_residuals(watch, stamp_s, ids, uv_a, uv_b, residual, pair=0):
    """State after adding residuals (n,) at one stamp."""
    return watch.add_residuals(round(stamp_s * 1e9), pair, residuals(ids, uv_a, uv_b, residual))


def state_after(
    watch, seconds, residual_of, seed=0, count=12, rate_hz=24, start_s=0.0, noise=0.25, each=None
):
    """State after a stream of frames with count markers. residual_of(t, uv_a, uv_b) [px] is the
    residual to which noise [px] is added.
    """
    rng = np.random.default_rng(seed)
    uv_a, uv_b = moving(rng, count, seconds, rate_hz)
    state = watch.state
    for k, (a, b) in enumerate(zip(uv_a, uv_b)):
        t = start_s + k / rate_hz
        state = add_residuals(
            watch, t, np.arange(count), a, b, residual_of(t, a, b) + rng.normal(0, noise, count)
        )
        if each is not None:
            each(t, state)
    return state


def quarter_of(side, size, begin_s=0.0, quarter='upper left'):
    """residual_of for a drift [px] downwards in a quarter of image number side."""
    column, row = QUARTERS[quarter]

    def residual(t, a, b):
        uv = (a, b)[side]
        return (
            FACTOR
            * size
            * (t >= begin_s)
            * ((uv[:, 0] >= 512) == column)
            * ((uv[:, 1] >= 512) == row)
        )

    return residual


# ---- false alarms


@pytest.mark.parametrize('correlation', [0.0, 0.5])
def test_mean_time_to_a_false_alarm_of_a_chart_is_at_least_the_bound(correlation):
    """400 charts, mean at the edge of their dead band, noise larger than predicted."""
    rng = np.random.default_rng(1)
    threshold = 6.0
    series = 400
    band = 0.2
    charts = CusumCharts(series, 1, DriftOptions().step_px, 1.5 * threshold)
    noise = 1.3
    alarms = 0
    blocks_seen = 0
    last = rng.normal(size=series)
    information = np.full((series, 1), 900 * FACTOR**2 / 0.25**2 / 4)
    for number in range(1200):
        last = correlation * last + np.sqrt(1 - correlation**2) * rng.normal(size=series)
        mean = np.where(np.arange(series) % 2, band, -band) + noise * last / np.sqrt(
            information[:, 0]
        )
        charts.stretch[:] = (1 + correlation) / (
            1 - correlation
        ) ** 2  # for blocks; PairWatch usually estimates it
        charts.update(
            mean[:, None] * information,
            information,
            np.full((series, 1), band),
            np.full((series, 1), number >= 80),
            number,
        )
        gone = (charts.evidence > threshold).any(axis=0)
        alarms = alarms + int(gone.sum())
        blocks_seen = blocks_seen + series * (number >= 80)
        charts.evidence[:, gone] = 0
    assert blocks_seen / max(alarms, 1) >= np.exp(threshold)


@pytest.mark.long
@pytest.mark.parametrize('seed', [1, 2])
def test_stated_rate_of_false_alarms_holds_with_correlated_noise_and_false_matches(
    seed,
):
    """36 minutes: means at both edges of the band, noise 1.3 times the predicted one, correlation
    0.5, 2 % false matches.
    """
    rng = np.random.default_rng(seed)
    rate = 24
    count = 12
    hours = 0.6
    watch = DriftWatch(SIZES, OFTEN)
    n = 24
    alarms = 0
    uv_a, uv_b = moving(rng, count, hours * 3600, rate)
    edge = FACTOR * OFTEN.tolerance_px  # against the start; `total` is against the calibration
    total = FACTOR * np.hypot(OFTEN.tolerance_px, OFTEN.band_calibration * SYSTEMATIC_PX / FACTOR)
    residual = 0.25 * 1.3 * autoregressive(rng, uv_a.shape[:2], 0.5) + total - edge
    residual[int((OFTEN.learn_s + 0.5) * rate) :] += edge
    wrong = rng.random(residual.shape) < 0.02
    residual[wrong] = rng.uniform(-1, 1, int(wrong.sum()))
    ids = np.tile(np.arange(count), n)
    for k in range(0, len(residual), n):
        state = add_residuals(
            watch,
            k / rate,
            ids,
            uv_a[k : k + n].reshape(-1, 2),
            uv_b[k : k + n].reshape(-1, 2),
            residual[k : k + n].ravel(),
        )
        if state.level != OK:  # restart, but keep the learned means and noise
            alarms += 1
            watch._epipolar.charts.evidence[:] = 0
            watch._level = OK
    assert alarms <= 6 * hours  # the stated rate is 6 an hour on average


def test_correlated_noise_raises_the_variance():
    rng = np.random.default_rng(3)
    r = 0.8
    watch = DriftWatch(SIZES, OFTEN)
    uv_a, uv_b = moving(rng, 20, 50, 120)
    residual = 0.25 * autoregressive(rng, uv_a.shape[:2], r)
    for k in range(0, len(residual), FRAMES):
        add_residuals(
            watch,
            k / 120,
            np.tile(np.arange(20), FRAMES),
            uv_a[k : k + FRAMES].reshape(-1, 2),
            uv_b[k : k + FRAMES].reshape(-1, 2),
            residual[k : k + FRAMES].ravel(),
        )
    assert np.median(watch._epipolar.charts.variance_factor()) >= 0.95 * (1 + r) / (1 - r)


def test_systematic_errors_within_the_stated_precision_are_no_drift():
    def residual(t, a, b):  # 2.5 standard deviations, varying over the image
        return 2.5 * SYSTEMATIC_PX * np.sin(a[:, 0] / 90) * np.cos(b[:, 0] / 120 + a[:, 1] / 100)

    largest = []
    state = state_after(
        DriftWatch(SIZES), 60, residual, seed=4, each=lambda t, s: largest.append(s.evidence)
    )
    assert state.level == OK and max(largest) < 0.5 * state.threshold_warn
    assert state.finding.kind is Kind.NO_DRIFT and not state.learning


# ---- detection by epipolar residuals


def first_times(
    size, side=0, quarter='upper left', begin_s=20.0, seconds=32.0, seed=5, drift=None, **more
):
    """Times of WARN and ERROR after the start of a drift [s], and the last state."""
    at = {WARN: np.inf, ERROR: np.inf}

    def note(t, state):
        for level in at:
            if state.level >= level:
                at[level] = min(at[level], t - begin_s)

    drift = drift or quarter_of(side, size, begin_s, quarter)
    state = state_after(DriftWatch(SIZES), seconds, drift, seed, each=note, **more)
    return at[WARN], at[ERROR], state


@pytest.mark.parametrize(
    'side, quarter, size',
    [
        (0, 'upper left', 0.5),
        (0, 'lower right', -0.5),
        (1, 'upper right', 0.5),
        (1, 'lower left', -0.35),
    ],
)
def test_drift_of_a_quarter_is_found_within_five_seconds_and_described(side, quarter, size):
    warn, error, state = first_times(size, side, quarter, seconds=27.0, count=30, rate_hz=120)
    assert 0 < warn <= error <= 5.0
    assert state.level == ERROR and state.fluoroscope == 'ab'[side] and quarter in state.place
    assert (
        state.source == 'epipolar'
        and state.evidence >= state.threshold_error > state.threshold_warn
    )
    assert abs(state.size - abs(size)) <= 3 * state.sd <= 0.25
    np.testing.assert_allclose(state.direction, np.sign(size) * NORMAL, atol=1e-9)
    assert state.since_s == pytest.approx(7.0, abs=1.5)
    u0, v0, u1, v1 = state.area
    column, row = QUARTERS[quarter]
    assert -0.5 <= u0 < u1 <= 1023.5 and -0.5 <= v0 < v1 <= 1023.5
    assert ((u0 + u1) / 2 > 511) == column and ((v0 + v1) / 2 > 511) == row
    assert state.finding.kind is Kind.IMAGE_DRIFT
    assert state.finding.place.fluoroscopes == ('ab'[side],)
    assert state.finding.numbers['size_px'] == state.size


def test_drift_of_the_whole_image_is_found_and_both_images_are_named():
    _, error, state = first_times(0, drift=lambda t, a, b: 0.35 * (t >= 20) * np.ones(len(a)))
    assert (
        error <= 5.0 and state.fluoroscope in ('a or b', 'b or a') and state.place == 'whole image'
    )
    assert abs(state.size - 0.35 / FACTOR) <= 3 * state.sd


def test_slow_drift_is_found_before_it_reaches_its_size():
    at = 20.0

    def growing(t, a, b):  # 0.5 px in 100 s
        return quarter_of(0, 0.5, at)(t, a, b) * max(0.0, min(1.0, (t - at) / 100))

    warn, error, state = first_times(0, drift=growing, seconds=110.0)
    assert warn < error < 85 and 0.15 < state.size < 0.6 and state.level == ERROR


def test_drift_before_the_start_is_compared_with_the_calibration():
    at = []
    state = state_after(
        DriftWatch(SIZES),
        25,
        quarter_of(1, 0.6, 0.0),
        seed=7,
        each=lambda t, s: s.level == ERROR and at.append(t),
    )
    assert at and 10 <= at[0] <= 16 and state.against == 'calibration' and state.fluoroscope == 'b'
    assert abs(state.size - 0.6) <= 3 * state.sd


def test_less_precise_calibration_has_a_wider_dead_band():
    """A step of 0.35 px against the calibration is a drift at 0.05 px, but none at 0.2 px."""
    found = []
    for systematic in (0.05, 0.2):
        watch = DriftWatch(SIZES)
        rng = np.random.default_rng(8)
        uv_a, uv_b = moving(rng, 12, 20, 24)
        for k, (a, b) in enumerate(zip(uv_a, uv_b)):
            observed = 0.35 + rng.normal(0, 0.25, 12)
            state = watch.add_residuals(
                round(k / 24 * 1e9),
                0,
                residuals(np.arange(12), a, b, observed, systematic),
            )
        found.append(state.level)
    assert found == [ERROR, OK]


def test_alarm_ends_with_the_drift_and_with_a_reset():
    levels = {}

    def passing(t, a, b):
        return quarter_of(0, 0.6, 15.0)(t, a, b) * (t < 22)

    watch = DriftWatch(SIZES)
    state = state_after(
        watch, 40, passing, seed=9, each=lambda t, s: levels.update({round(t): s.level})
    )
    assert levels[22] == ERROR and levels[38] == OK == state.level
    state_after(watch, 8, quarter_of(0, 0.6), seed=10, start_s=41)
    assert watch.state.level == ERROR
    watch.reset()
    assert (
        watch.state.level == OK
        and watch.state.observations == 0
        and watch.state.finding.kind is Kind.NO_MARKERS
    )
    state = state_after(watch, 15, quarter_of(0, 0.0), seed=11, start_s=50)
    assert state.level == OK and state.evidence < 0.5 * state.threshold_warn


# ---- unusual input


def test_nan_empty_late_and_earlier_frames_are_accepted():
    watch = DriftWatch(SIZES)
    rng = np.random.default_rng(12)
    uv_a, uv_b = moving(rng, 12, 30, 24)
    nothing = np.zeros((0, 2))
    for k, (a, b) in enumerate(zip(uv_a, uv_b)):
        residual = 0.25 * rng.normal(size=12) + quarter_of(0, 0.6, 18)(k / 24, a, b)
        residual[rng.random(12) < 0.2] = np.nan
        a = np.where(rng.random((12, 1)) < 0.05, np.nan, a)
        late = (
            k / 24 - 0.3 * (k % 5 == 0) - 1000 * (k > 500)
        )  # late frames, and a recording that starts again
        state = add_residuals(watch, late, np.arange(12), a, b, residual)
        state = add_residuals(watch, late, np.zeros(0, dtype=int), nothing, nothing, np.zeros(0))
    assert state.level == ERROR and state.fluoroscope == 'a' and 0 <= state.since_s < 14
    assert 0.6 * 12 * 720 < state.observations < 0.9 * 12 * 720


@pytest.mark.parametrize('count', [1, 2])
def test_one_or_two_markers_raise_no_alarm(count):
    state = state_after(DriftWatch(SIZES), 20, lambda t, a, b: 1.0 * (t > 12), count=count)
    assert state.level == OK and state.evidence == 0


def test_lasting_false_match_of_one_marker_is_no_drift():
    def residual(t, a, b):
        return np.where(np.arange(len(a)) == 3, 0.95 * (t > 14), 0.0)

    assert state_after(DriftWatch(SIZES), 30, residual, seed=13, count=30).level == OK


def test_three_fluoroscopes():
    sizes = dict(SIZES, c=(800, 600))
    watch = DriftWatch(sizes)
    rng = np.random.default_rng(14)
    uv_a, uv_b = moving(rng, 15, 24, 24)
    for k, (a, b) in enumerate(zip(uv_a, uv_b)):
        c = b * (800 / 1024, 600 / 1024)
        drift = quarter_of(0, 0.6, 16)(k / 24, b, a)  # drift of b
        state = add_residuals(
            watch, k / 24, np.arange(15), a, b, drift + rng.normal(0, 0.25, 15), pair=0
        )
        state = add_residuals(watch, k / 24, np.arange(15), a, c, rng.normal(0, 0.25, 15), pair=1)
        state = add_residuals(
            watch, k / 24, np.arange(15), b, c, drift + rng.normal(0, 0.25, 15), pair=2
        )
    assert state.level == ERROR and state.fluoroscope == 'b' and 'upper left' in state.place


@pytest.mark.parametrize(
    'wrong, sentence',
    [
        ({'cells': 3}, 'cells must be an even number'),
        ({'cells': 40}, 'cells must be between 2 and 16'),
        ({'error_interval_h': 0.0}, 'error_interval_h must be between 0.001 and 1e\\+09'),
        ({'step_px': float('nan')}, 'step_px must be between 0.001 and 100'),
        ({'warn_interval_h': 2000.0}, 'warn_interval_h must not exceed error_interval_h'),
        ({'clip': 0.5}, 'clip must be between 1 and 10'),
        ({'learn_s': 1.0, 'block_s': 0.5}, 'learn_s must be at least 4 blocks'),
    ],
)
def test_options_out_of_range_are_refused(wrong, sentence):
    with pytest.raises(ValueError, match=sentence):
        DriftOptions(**wrong)


@pytest.mark.parametrize('n', [2, 4, 8])
def test_areas_cover_the_image_and_have_names(n):
    areas = ImageAreas(n)
    corners = np.array([areas.describe(i, (1000, 800))[0] for i in range(len(areas.member))])
    names = [areas.describe(i, (1000, 800))[1] for i in range(len(areas.member))]
    size = (corners[:, 2] - corners[:, 0]) * (corners[:, 3] - corners[:, 1])
    np.testing.assert_allclose(areas.member.sum(axis=1) / n**2, size / 8e5)
    assert len(set(names)) == len(names) and names[-1] == 'whole image'
    assert {'upper left quarter', 'lower right quarter', 'left half', 'lower half'} <= set(names)
    uv = np.array([[-0.5, -0.5], [999.4, 799.4], [5000.0, -3.0]])
    assert areas.cell(uv, (1000, 800)).tolist() == [0, n * n - 1, n - 1]


def test_field_of_systematic_errors_is_estimated():
    rng = np.random.default_rng(15)
    field = SystematicErrorField([(1024, 1024)] * 2)

    def truth(a, b):
        return 0.1 * np.sin(a[:, 0] / 200) + 0.1 * np.cos(b[:, 0] / 180)

    for _ in range(200):
        a, b = rng.uniform(100, 900, (2, 30, 2))
        (na, wa) = field.interpolation(a, 0)
        (nb, wb) = field.interpolation(b, 1)
        field.add(
            np.arange(30),
            np.hstack([na, nb]),
            np.hstack([wa, wb]),
            truth(a, b) + rng.normal(0, 0.25, 30),
            np.full(30, 0.0625),
            np.full(30, 0.1),
        )
    field.estimate(1.0)
    a, b = rng.uniform(150, 850, (2, 500, 2))
    (na, wa) = field.interpolation(a, 0)
    (nb, wb) = field.interpolation(b, 1)
    nodes = np.hstack([na, nb])
    weights = np.hstack([wa, wb])
    error = np.sum(field.mean[nodes] * weights, axis=1) - truth(a, b)
    j = np.zeros((500, len(field.mean)))
    np.put_along_axis(j, nodes, weights, axis=1)
    sd = np.sqrt(np.sum((j @ field.covariance) * j, axis=1))
    assert np.sqrt(np.mean(error**2)) < 0.03 and 0.6 < np.sqrt(np.mean((error / sd) ** 2)) < 1.3


# ---- clusters, and end to end


class Known:
    """Stand-in for a calibration that corrects to within 0.04 px."""

    image_sd = 0.25

    def correct(self, uv, sigma):
        return SimpleNamespace(
            uv=uv.copy(), sigma=np.hypot(sigma, 0.04), status=np.zeros(len(uv), dtype=np.uint8)
        )


@functools.cache
def perfect(learned_s=12):
    """Scene of a rig without distortion and with known orientation, its watch after the start, and
    the blocks of the start.
    """
    rig = virtual_rig(3, strength=0.0)
    f = rig.fluoroscopes
    orientation = RigOrientation(
        ('a', 'b'),
        np.stack([x.interior for x in f]),
        np.stack([x.rotation for x in f]),
        np.stack([x.position_mm for x in f]),
        np.zeros((18, 18)),
        'rig',
        'capture',
        ('one', 'other'),
    )
    rng = np.random.default_rng(16)
    points = markers(rng, rng.uniform(-22, 22, (5, BEADS, 3)), 40)
    pixels = {x.name: x.ideal(points.reshape(-1, 3)).reshape(*points.shape[:2], 2) for x in f}
    scene = Scene(
        ('a', 'b'),
        {'a': Known(), 'b': Known()},
        orientation,
        EpipolarGeometry(orientation, 'a', 'b'),
        Intersector(orientation, None),
        pixels,
    )
    watch = scene.watch()
    first = learned_s * RATE_HZ // FRAMES
    for block in blocks(scene, rng, 0, first):
        feed(scene, watch, block)
    return scene, watch, first


@pytest.mark.parametrize(
    'name, quarter, direction', [('a', 'upper left', 0), ('b', 'lower right', 180)]
)
@pytest.mark.long
def test_clusters_see_a_drift_along_the_epipolar_lines(name, quarter, direction):
    scene, watch, first = perfect()
    drift = Drift(name, quarter, 0.5, direction)
    found = detection(
        scene, copy.deepcopy(watch), first, drift, np.random.default_rng(17), after_s=12
    )
    assert found['error'] <= 8 and found['named'] == name and found['place']
    assert found['source'].startswith('cluster bone')
    assert abs(found['size_error']) <= 3 * found['sd'] <= 0.3 and found['kind'] == 'image_drift'
    blind = copy.deepcopy(watch)
    blind._body_watch = None
    missed = detection(scene, blind, first, drift, np.random.default_rng(17), False, after_s=5)
    assert missed['warn'] == np.inf


@pytest.mark.long
def test_undetectable_drift_is_not_reported():
    """Shifting a whole image along the epipolar lines moves all points alike."""
    scene, watch, first = perfect()
    for size in (0.5, 0.0):
        found = detection(
            scene,
            copy.deepcopy(watch),
            first,
            Drift('a', WHOLE, size, 0),
            np.random.default_rng(18),
            after_s=6,
        )
        assert found['warn'] == np.inf


def projected(orientation, view, place):
    """Ideal pixel (2,) of a point (3,) [mm]."""
    xp, yp, c = orientation.interior[view]
    x, y, z = orientation.rotation[view] @ (place - orientation.position_mm[view])
    return np.array([xp + c * x / z, yp + c * y / z])


def test_moved_bead_is_named_as_a_possible_cause():
    scene, watch, first = perfect()
    watch = copy.deepcopy(watch)
    rng = np.random.default_rng(19)
    orientation = scene.orientation
    for _, corrected, _, stamps in blocks(scene, rng, first, 18):
        for k, stamp in enumerate(stamps):
            rows = slice(k * len(IDS), (k + 1) * len(IDS))
            uv = np.stack([corrected[n][rows] for n in 'ab'])
            systematic = np.full((2, len(IDS)), 0.04)
            place = intersected(scene, uv, systematic, (0.25, 0.25)).points.xyz_mm[7]
            for view in (0, 1):
                there = projected(orientation, view, place + (0.0, 0.0, 2.0))
                uv[view, 7] += there - projected(orientation, view, place)
            state = watch.add_points(stamp, intersected(scene, uv, systematic, (0.25, 0.25)))
    assert state.level >= WARN and state.source == 'cluster bone 2'
    assert state.finding.kind is Kind.CLUSTER_CHANGE


def test_shapes_can_be_declared():
    scene, watch, first = perfect()
    rng = np.random.default_rng(16)
    beads = rng.uniform(-22, 22, (5, BEADS, 3))
    bodies = [
        Body(str(i), IDS[BEADS * i : BEADS * (i + 1)], xyz, np.full(BEADS, 0.01))
        for i, xyz in enumerate(beads)
    ]
    declared = DriftWatch(SIZES, DriftOptions(), bodies, scene.orientation)
    for learned, given in zip(watch._body_watch.bodies, bodies):
        np.testing.assert_allclose(pdist(learned.xyz_mm), pdist(given.xyz_mm), atol=0.05)
        assert learned.sd_mm.max() < 0.05
    for block in blocks(scene, np.random.default_rng(20), first, 8):
        state = feed(scene, declared, block)
    assert (
        state.level == OK
        and np.isfinite(declared._bodies._records[-1][1].score).all()
        and declared._bodies._records[-1][1].information.sum() > 0
    )


def test_score_of_a_body_is_the_most_likely_drift():
    """Score over information equals a known shift, also with two beads."""
    scene, _, first = perfect()
    beads = np.random.default_rng(16).uniform(-22, 22, (5, BEADS, 3))
    areas = ImageAreas(4)
    for count in (BEADS, 2):
        bodies = [
            Body(str(i), IDS[BEADS * i : BEADS * i + count], xyz[:count], np.zeros(count))
            for i, xyz in enumerate(beads)
        ]
        watch = BodyWatch(bodies, scene.orientation, [(1024, 1024)] * 2, areas, DriftOptions())
        size = 0.2
        for _, corrected, _, stamps in blocks(scene, np.random.default_rng(3), first, 40):
            for k in range(0, len(stamps), 3):
                rows = slice(k * len(IDS), (k + 1) * len(IDS))
                uv = np.stack([corrected[n][rows] for n in 'ab'])
                uv[0, :, 0] += size * (uv[0, :, 0] < 511.5)
                watch.add(intersected(scene, uv, np.full((2, len(IDS)), 0.01), (0.25, 0.25)))
        block = watch.block()
        names = [areas.describe(area, (1024, 1024))[1] for area in range(len(areas))]
        left = names.index('left half')
        information = block.information[0, left]
        assert information > 100
        assert block.score[0, left] / information == pytest.approx(
            size, abs=4 / np.sqrt(information)
        )


def exposure_of(views, ids=IDS):
    n = len(ids)
    seen = MatchedViews(
        ids, *np.zeros((1, views, n, 2)), *np.ones((2, views, n)), np.zeros((views, n), bool)
    )
    return IntersectedViews(
        seen, perfect()[0].intersector.intersect(np.zeros((2, n, 2)), np.ones((2, n)))
    )


def test_invalid_watches_are_refused():
    o = perfect()[0].orientation
    bodies = declared_bodies(['c: 1 2 3'])
    with pytest.raises(ValueError, match='two fluoroscopes'):
        DriftWatch({'a': (1024, 1024)})
    with pytest.raises(ValueError, match='orientation of the rig'):
        DriftWatch(SIZES, bodies=bodies)
    with pytest.raises(DataError, match='a marker belongs to one body'):
        DriftWatch(SIZES, DriftOptions(), [*bodies, *declared_bodies(['d: 3 4'])], o)
    watch = DriftWatch(SIZES, DriftOptions(), bodies, o)
    with pytest.raises(ValueError, match='pixels of 2 views, not 3'):
        watch.add_points(0, exposure_of(3))
    assert watch.add_points(0, exposure_of(2, IDS[:0])).level == OK


@pytest.mark.parametrize('length_s, watched_s', [(0.5, 5), (3.0, 40)])
def test_bag_in_a_loop_is_watched_as_one_stream(length_s, watched_s):
    """Blocks end although the stamps never exceed those of the bag, and exposures do not pile up.

    In a bag of less than a second, a restart is noticed only after 100 exposures.
    """
    options = DriftOptions(cells=2, block_s=1.0, learn_s=5.0)
    watch = DriftWatch(SIZES, options)
    for start in range(round(120 / length_s)):
        state_after(watch, length_s, lambda t, a, b: 0 * a[:, 0], seed=start, rate_hz=60)
    assert watch.watched_s > watched_s
    assert max(map(len, watch._collected)) <= 10 * 60
