# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""From an alarm of the drift watch until healing, standard deviations include the change."""

import functools
from dataclasses import replace

import numpy as np
import pytest
from rigs import true_calibrations, true_orientation
from scipy.special import ndtri

from fluoro_calib_ros.bodies.body import Body
from fluoro_calib_ros.checks.drift_charts import ERROR, EpipolarObservations
from fluoro_calib_ros.checks.rig_change import RigChange
from fluoro_calib_ros.checks.rig_watch import RigDriftWatch
from fluoro_calib_ros.findings import Kind
from fluoro_calib_ros.jobs.bodies import BodiesOptions, track_bodies
from fluoro_calib_ros.jobs.reconstruction import reconstruct
from fluoro_calib_ros.photogrammetry.noise import ObservedScatter
from fluoro_calib_ros.photogrammetry.rotations import matrix_from_vector
from fluoro_calib_ros.reconstruction.epipolar import EpipolarGeometry
from fluoro_calib_ros.reconstruction.intersection import Intersector
from fluoro_calib_ros.reconstruction.reconstruct import RigRecording, reconstruct_exposure
from fluoro_calib_ros.simulation.rig import simulate_tracking, virtual_rig

NOISE_PX = 0.25
RATE_HZ = 30.0
BUMPED = 360  # first exposure after the knock
SEEDS = range(4)  # seeds of knocks: the error of points depends on the direction
BODY = np.arange(1001, 1007)


def moved(rig, change):
    a, b = rig.fluoroscopes
    other = replace(
        b,
        rotation=matrix_from_vector(change[3:]) @ b.rotation,
        position_mm=b.position_mm + change[:3],
    )
    return replace(rig, fluoroscopes=(a, other))


def recorded(rig):
    """A recording of markers in front of a rig, always with the same noise."""
    return simulate_tracking(rig, 16.0, RATE_HZ, seed=4, noise_px=NOISE_PX)


@functools.cache
def healthy_rig():
    """A rig, its calibrations, its orientation and a recording of it."""
    rig = virtual_rig(2, strength=0.0, names=('a', 'b'), between_deg=60.0)
    calibrations = true_calibrations(rig.fluoroscopes, NOISE_PX)
    return rig, calibrations, true_orientation(rig.fluoroscopes, calibrations), recorded(rig)


def scene(size, seed=0):
    """Calibrations, orientation, frames of a rig whose b is knocked, and true points."""
    rng = np.random.default_rng(seed)
    shift, turn = rng.normal(size=(2, 3))
    change = np.concatenate(
        [2.4 * shift / np.linalg.norm(shift), 0.0042 * turn / np.linalg.norm(turn)]
    )
    rig, calibrations, orientation, healthy = healthy_rig()
    late = recorded(moved(rig, size * change)) if size else healthy
    frames = {n: [*healthy.frames[n][:BUMPED], *late.frames[n][BUMPED:]] for n in 'ab'}
    return calibrations, orientation, frames, healthy


def squares(found, truth):
    """NSE of points by exposure; NaN if none is found."""
    out = []
    for frame in found:
        rows = np.searchsorted(truth.marker_id, frame.target_id)
        number = frame.number - found[0].number
        error = frame.points.xyz_mm - truth.points_mm[number, rows]
        good = np.isfinite(error).all(axis=1)
        error, covariance = error[good], frame.points.covariance[good]
        square = np.sum(error * np.linalg.solve(covariance, error[..., None])[..., 0], axis=1)
        out.append(np.mean(square) / 3 if len(square) else np.nan)
    return np.array(out)


def test_derivatives_are_those_of_differences():
    _, orientation, _, truth = scene(0.0)
    uv = [truth.frames[name][0].uv for name in 'ab']
    count = min(map(len, uv))
    uv = [one[:count] for one in uv]
    told = EpipolarGeometry(orientation, 'a', 'b').by_orientation(*uv)
    for column in range(18):
        f, k = divmod(column, 9)
        step = 1e-3 if k < 3 or k > 5 else 1e-6
        found = []
        for sign in (1, -1):
            position, rotation, interior = (
                getattr(orientation, n).copy() for n in ('position_mm', 'rotation', 'interior')
            )
            if k < 3:
                position[f, k] += sign * step
            elif k < 6:
                turn = matrix_from_vector(sign * step * np.eye(3)[k - 3])
                rotation[f] = turn @ rotation[f]
            else:
                interior[f, k - 6] += sign * step
            other = replace(
                orientation, position_mm=position, rotation=rotation, interior=interior
            )
            residuals = EpipolarGeometry(other, 'a', 'b').residuals(*uv, 1.0, 1.0)
            found.append(residuals.residual)
        difference = (found[0] - found[1]) / (2 * step)
        np.testing.assert_allclose(told[:, column], difference, rtol=0.02, atol=0.02)


@pytest.fixture(scope='module')
def geometry():
    fluoroscopes = virtual_rig(2, strength=0.0, names=('a', 'b'), between_deg=60.0).fluoroscopes
    orientation = true_orientation(fluoroscopes, true_calibrations(fluoroscopes, NOISE_PX))
    return orientation, EpipolarGeometry(orientation, 'a', 'b')


def shown_blocks(geometry, blocks):
    """RigChange after blocks of five exposures, each given by the misses of its rays [px]."""
    orientation, pair = geometry
    change = RigChange(orientation, [(0, 1, pair)])
    for missed in blocks:
        for row in np.broadcast_to(missed, (5, np.shape(missed)[-1])):
            uv = np.linspace([300.0, 700.0], [600.0, 400.0], len(row))
            one = np.ones(len(row))
            given = EpipolarObservations(
                row, one, one, uv, uv, one, one, np.arange(len(row)), uv, uv, 0.1 * one
            )
            change.add(0, given)
        change.close()
    return change


MEETS, APART = [0.1] * 4, [9.0] * 4


@pytest.mark.parametrize(
    ('blocks', 'share', 'apart'),
    [
        ([MEETS, APART], 0.0, 1),
        ([MEETS, APART, APART], 1.0, 2),
        ([MEETS, APART, [9.0, -9.0, 0.1, 9.0]], 0.75, 2),
        ([MEETS, APART, [9.0, 0.1, 0.1, 9.0]], 0.0, 0),  # as many rays meet
        ([MEETS, APART, MEETS, APART], 0.0, 1),
        ([APART, APART, APART], 0.0, 3),  # confused recordings, as the rays have never met
        ([MEETS, APART[:2], APART[:2]], 0.0, 0),  # too few markers
        ([MEETS, APART[:3], APART[:3]], 1.0, 2),
        ([MEETS, [APART, APART, MEETS, MEETS, MEETS]] * 2, 0.0, 0),  # false matches of some
    ],
)
def test_knock_is_shown_by_two_blocks_in_which_most_rays_are_apart(geometry, blocks, share, apart):
    change = shown_blocks(geometry, blocks)
    assert (change.share_apart, change.blocks_apart) == (share, apart)


def test_what_is_added_grows_with_what_the_rays_show(geometry):
    """Only the newest blocks count; without a block of enough markers nothing is known."""
    assert shown_blocks(geometry, [APART[:2]]).addition(1) is None
    change = shown_blocks(geometry, [APART, MEETS, MEETS])
    newest, all_three = change.addition(2), change.addition(3)
    capped = (3 * 0.1 / ndtri(0.75)) ** 2  # three robust standard deviations
    assert newest.miss == pytest.approx(0.1)
    assert all_three.miss == pytest.approx(np.sqrt((capped + 2 * 0.1**2) / 3))
    assert np.trace(all_three.covariance) > np.trace(newest.covariance)
    assert change.addition(0).miss == change.addition(1).miss == newest.miss
    np.testing.assert_array_equal(newest.covariance, newest.covariance.T)
    assert np.linalg.eigvalsh(newest.covariance).min() > -1e-12


@pytest.mark.long
def test_points_of_a_knocked_rig_are_found_with_honest_deviations():
    """Most rays no longer meet, so there would hardly be a point without the alarm."""
    alarm = BUMPED + round(1.5 * RATE_HZ)
    mean = []
    for seed in SEEDS:
        calibrations, orientation, frames, truth = scene(1.0, seed)
        outcome = reconstruct(frames, calibrations, orientation)
        assert outcome.drift.level == 'error'
        nse = squares(outcome.frames, truth)
        assert np.mean(nse[:BUMPED]) < 1.3
        mean.append(np.nanmean(nse[alarm:]))
        late = np.concatenate([frame.points.status for frame in outcome.frames[alarm:]])
        assert np.mean(late == 0) > 0.9
        widening = outcome.drift.widening
        assert widening.kind is Kind.WIDENED_BY_ALARM
        assert widening.numbers['sd_mm'] > 5 * widening.numbers['sd_before_mm']
    assert 0.2 < np.mean(mean) < 1.5
    plain = RigRecording(
        {n: of[alarm:] for n, of in frames.items()}, calibrations, Intersector(orientation)
    ).reconstruct()
    assert np.mean(np.concatenate([frame.points.status for frame in plain]) == 0) < 0.5


@pytest.mark.long
def test_small_drift_widens_points_while_rays_show_it():
    mean = []
    without = []
    for seed in SEEDS:
        calibrations, orientation, frames, truth = scene(0.3, seed)
        late = slice(BUMPED + round(3 * RATE_HZ), None)
        found = reconstruct(frames, calibrations, orientation).frames
        mean.append(squares(found, truth)[late])
        unwatched = {n: of[late] for n, of in frames.items()}
        found = RigRecording(unwatched, calibrations, Intersector(orientation)).reconstruct()
        without.append(squares(found, truth))
    assert 0.2 < np.nanmean(mean) < 1.5
    assert np.nanmean(without) > 10


@pytest.mark.long
def test_small_drift_widens_poses():
    calibrations, orientation, frames, truth = scene(0.3)
    rows = np.searchsorted(truth.marker_id, BODY)
    body = Body('bone', BODY, truth.points_mm[0, rows], np.full(len(BODY), 0.01))
    tracked = track_bodies(
        {n: of[: BUMPED + round(3 * RATE_HZ)] for n, of in frames.items()},
        calibrations,
        orientation,
        [body],
        options=BodiesOptions(smooth='lag', estimate_shapes=False),
    )
    sd = tracked.poses[0].sd[:, :3].max(axis=1)
    assert np.nanmedian(sd[-30:]) > 3 * np.nanmedian(sd[: BUMPED - 30])


def test_what_an_alarm_adds_ends_with_what_the_rays_show():
    """The alarm lasts for a while, but the addition follows the newest rays."""
    calibrations, orientation, frames, _ = scene(0.3)
    again = {n: [*of, *_later(of[: round(5 * RATE_HZ)])] for n, of in frames.items()}
    watch = RigDriftWatch(orientation, {n: calibrations[n].image_size for n in 'ab'})
    given = Intersector(orientation)
    count = len(frames['a'])
    sd = []
    for pair in zip(again['a'], again['b']):
        exposure = dict(zip('ab', pair))
        found = reconstruct_exposure(exposure, calibrations, given, watch, ObservedScatter())
        sd.append(np.nanmedian(found.points.sd_mm))
        if len(sd) == count:
            assert watch.state.level == ERROR and watch.widening is not None
    assert sd[count - 1] > 2 * sd[0]
    assert watch.state.level == ERROR and sd[-1] < 1.5 * sd[0]


def test_without_an_alarm_nothing_is_added():
    calibrations, orientation, frames, _ = scene(0.0)
    watch = RigDriftWatch(orientation, {n: calibrations[n].image_size for n in 'ab'})
    given = Intersector(orientation)
    recording = RigRecording(frames, calibrations, given)
    found = recording.reconstruct(watch)
    plain = recording.reconstruct()
    assert watch.widening is None and watch.widened(given) == (given, 0.0)
    np.testing.assert_array_equal(found[-1].points.covariance, plain[-1].points.covariance)


def _later(frames):
    """Repeat frames after the end of the recording."""
    count = round(16 * RATE_HZ)
    return [replace(f, number=f.number + count, stamp_ns=f.stamp_ns + round(16e9)) for f in frames]
