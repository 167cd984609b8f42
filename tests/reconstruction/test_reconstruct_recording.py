# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Recordings: exposures with missing views, and the verdict of the drift watch."""

import csv
import functools
import json
from dataclasses import replace

import numpy as np
import pytest
from rigs import run, true_calibrations, true_orientation

from fluoro_calib_ros.bodies.body import declared_bodies
from fluoro_calib_ros.checks.drift_charts import ERROR, DriftOptions
from fluoro_calib_ros.checks.rig_watch import RecordingDriftWatch, RigDriftWatch
from fluoro_calib_ros.exposures.pairing import RecordedPairing
from fluoro_calib_ros.findings import Kind, Severity
from fluoro_calib_ros.io.bags.writer import write_bag
from fluoro_calib_ros.io.calibration import save_calibration, save_orientation
from fluoro_calib_ros.io.observations import write_observations_csv
from fluoro_calib_ros.reconstruction.intersection import OK, SINGLE_VIEW, Intersector
from fluoro_calib_ros.reconstruction.reconstruct import (
    CorrectedView,
    RigRecording,
    intersect_exposure,
    match_views,
    watch_exposure,
)
from fluoro_calib_ros.simulation.rig import simulate_tracking, virtual_rig

NOISE_PX = 0.25
CLUSTERS = ('tibia: 1001 1002 1003 1004 1005 1006', 'femur: 1013 1014 1015 1016 1017 1018')


@functools.cache
def rig(names='abc'):
    """A rig without distortion."""
    return virtual_rig(2, strength=0.0, names=tuple(names), between_deg=60.0)


@functools.cache
def known(names='abc'):
    """Calibrations and orientation of the rig: true values with a small covariance."""
    fluoroscopes = rig(names).fluoroscopes
    calibrations = true_calibrations(fluoroscopes, NOISE_PX)
    return calibrations, true_orientation(fluoroscopes, calibrations)


@functools.cache
def tracking(seconds, rate_hz, names='abc'):
    return simulate_tracking(rig(names), seconds, rate_hz, seed=4, noise_px=NOISE_PX)


def shifted(frames, name, begin_s, end_s=np.inf, size_px=1.0):
    """Frames in which the left half of a fluoroscope's image is shifted down for some time."""

    def change(frame):
        t = (frame.stamp_ns - frames[name][0].stamp_ns) / 1e9
        return replace(
            frame,
            uv=frame.uv
            + np.column_stack(
                [
                    np.zeros(len(frame.uv)),
                    size_px * (frame.uv[:, 0] < 512) * (begin_s <= t < end_s),
                ]
            ),
        )

    return {**frames, name: [change(frame) for frame in frames[name]]}


def watched(frames, names, clusters=(), options=DriftOptions()):
    """RecordingDriftWatch after it has processed a recording."""
    calibrations, orientation = known(names)
    watch = RecordingDriftWatch(
        orientation,
        {n: c.image_size for n, c in calibrations.items()},
        options,
        declared_bodies(clusters),
    )
    RigRecording(frames, calibrations, Intersector(orientation)).reconstruct(watch)
    return watch


# ---- missing views


def test_a_missing_view_is_matched_as_one_that_sees_nothing():
    ids = np.array([7, 2, 9])
    uv = np.arange(6.0).reshape(3, 2)
    sigma = np.array([0.1, 0.2, 0.3])
    inside = np.zeros(3, dtype=bool)
    for outside in (inside, np.array([True, False, False])):
        first = CorrectedView(ids, uv, sigma, sigma / 2, outside)
        found = match_views([first, None, CorrectedView(ids, uv + 1, sigma, sigma, inside)])
        assert found.target_id.tolist() == [7, 2, 9]
        np.testing.assert_array_equal(found.uv, [uv, np.full((3, 2), np.nan), uv + 1])
        np.testing.assert_array_equal(found.sigma, [sigma, np.full(3, np.nan), sigma])
        np.testing.assert_array_equal(found.correction_sd, [sigma / 2, np.full(3, np.nan), sigma])
        assert found.outside.tolist() == [outside.tolist()] + 2 * [3 * [False]]
    first = CorrectedView(ids[:2], uv[:2], sigma[:2], sigma[:2], inside[:2])
    other = match_views([first, None, CorrectedView(ids, uv, sigma, sigma, inside)])
    assert (
        other.target_id.tolist() == [2, 7, 9]
        and np.isnan(other.uv[0, 2]).all()
        and np.isnan(other.sigma[1]).all()
        and not other.outside.any()
    )


@pytest.mark.parametrize('missing', 'abc')
def test_without_a_view_the_points_are_those_of_the_other_two(missing):
    """The numbers are those of a rig of two; all three together are more accurate."""
    calibrations, orientation = known()
    frames = tracking(0.5, 40).frames
    others = [name for name in 'abc' if name != missing]
    recording = RigRecording(frames, calibrations, Intersector(orientation))
    whole = recording.reconstruct()
    two = replace(recording, intersector=Intersector(orientation.subset(others))).reconstruct()
    kept = [f for f in frames[missing] if f.number % 2]
    partial = recording.with_frames({**frames, missing: kept})
    found, unpaired = partial.reconstruct(), partial.unpaired
    assert [f.number for f in found] == [f.number for f in whole] and not any(unpaired.values())
    for frame, of_three, of_two in zip(found, whole, two):
        same = of_three if frame.number % 2 else of_two
        assert frame.stamp_ns == same.stamp_ns and (frame.points.status == OK).all()
        assert frame.fluoroscopes == (('a', 'b', 'c') if frame.number % 2 else tuple(others))
        assert set(frame.points.rays) == {3 if frame.number % 2 else 2}
        np.testing.assert_allclose(frame.points.xyz_mm, same.points.xyz_mm, atol=1e-6)
        np.testing.assert_allclose(
            frame.points.covariance, same.points.covariance, rtol=1e-5, atol=1e-6
        )
    true = tracking(0.5, 40).points_mm
    error = [
        np.sqrt(
            np.mean([np.sum((f.points.xyz_mm - true[f.number - 1]) ** 2, axis=1) for f in part])
        )
        for part in (found[::2], found[1::2])
    ]
    assert error[0] < 0.95 * error[1]


@pytest.mark.parametrize('by', ['frame_number', 'stamp'])
@pytest.mark.parametrize('seed', range(3))
def test_every_exposure_of_two_views_is_reconstructed(by, seed):
    """With views lost at random and one fluoroscope off for the second half, each exposure occurs
    once, in order of time.
    """
    rng = np.random.default_rng(seed)
    (calibrations, orientation) = known()
    frames = tracking(0.5, 80).frames
    there = {name: rng.random(40) < 0.7 for name in 'abc'}
    there['b'][20:] = False
    kept = {name: [f for f, here in zip(frames[name], there[name]) if here] for name in 'abc'}
    if by == 'stamp':  # different numbers, and stamps that differ slightly
        kept = {
            name: [
                replace(f, number=f.number + 7 * k, stamp_ns=f.stamp_ns + 300_000 * k)
                for f in of_one
            ]
            for k, (name, of_one) in enumerate(kept.items())
        }
    recording = RigRecording(kept, calibrations, Intersector(orientation), RecordedPairing(by))
    found, unpaired = recording.reconstruct(), recording.unpaired
    views = np.sum(list(there.values()), axis=0)
    rows = np.flatnonzero(views >= 2)
    start = frames['a'][0].stamp_ns
    assert [round((f.stamp_ns - start) * 80 / 1e9) for f in found] == rows.tolist()
    assert [len(f.fluoroscopes) for f in found] == views[rows].tolist()
    assert all(set(f.points.rays) == {len(f.fluoroscopes)} for f in found)
    assert sum(unpaired.values()) == np.count_nonzero(views == 1)


def test_a_target_in_one_view_of_two_has_the_status_single_view():
    calibrations, orientation = known()
    frames = {name: of_one[:1] for name, of_one in tracking(0.5, 40).frames.items() if name != 'c'}
    one = frames['a'][0]
    frames['a'] = [replace(one, target_id=one.target_id[3:], uv=one.uv[3:])]
    recording = RigRecording({**frames, 'c': []}, calibrations, Intersector(orientation))
    (found,) = recording.reconstruct()
    assert found.points.status.tolist() == 3 * [SINGLE_VIEW] + 21 * [OK]


# ---- the drift watch of a recording


@functools.cache
def drifted():
    """Frames of a drifting recording, and the watch after processing it."""
    frames = shifted(tracking(30.0, 30.0, 'ab').frames, 'b', 16.0)
    return frames, watched(frames, 'ab')


@pytest.mark.long
def test_a_drift_of_a_recording_is_found_and_reported():
    frames, watch = drifted()
    start = frames['a'][0].stamp_ns
    found = watch.verdict()
    assert (found.level, found.level_at_end, found.state.fluoroscope) == ('error', 'error', 'b')
    assert found.state.level == ERROR and 'left' in found.state.place and found.state.size > 0.5
    assert (
        16 < (found.found_ns - start) / 1e9 < 22 and abs((found.began_ns - start) / 1e9 - 16) < 1.5
    )
    assert found.finding.kind is Kind.IMAGE_DRIFT and found.finding.severity is Severity.ERROR
    assert found.finding.place.fluoroscopes == ('b',)
    assert 18 < found.watched_s < 21


@pytest.mark.long
@pytest.mark.parametrize('outside', [True, False])
def test_points_beyond_the_calibrated_area_are_no_drift(outside):
    """The correction is extrapolated there: its error may be a pixel and vary over the image."""
    calibrations, orientation = known('ab')
    watch = RecordingDriftWatch(orientation, {n: c.image_size for n, c in calibrations.items()})
    frames = shifted(tracking(20, 120, 'ab').frames, 'a', 12.0)
    for exposure in zip(*(frames[name] for name in 'ab')):
        views = [
            CorrectedView(
                f.target_id,
                f.uv,
                np.full(len(f.uv), NOISE_PX),
                np.full(len(f.uv), 0.02),
                outside & (f.fluoroscope == 'a') & (f.uv[:, 0] < 520),
            )
            for f in exposure
        ]
        found = intersect_exposure(views, Intersector(orientation))
        watch_exposure(watch, exposure[0].stamp_ns, found)
    assert watch.verdict().level == ('ok' if outside else 'error')


@pytest.mark.long
def test_the_state_is_that_of_a_watch_fed_frame_by_frame():
    """A RecordingDriftWatch gives the states of the RigDriftWatch in the node."""
    calibrations, orientation = known('ab')
    frames, watch = drifted()
    live = RigDriftWatch(orientation, {n: c.image_size for n, c in calibrations.items()})
    RigRecording(frames, calibrations, Intersector(orientation)).reconstruct(live)
    assert live.state == watch.state and live.state.level == ERROR


@pytest.mark.long
def test_a_drift_that_ended_before_the_recording_is_reported():
    frames = shifted(tracking(45.0, 30.0, 'ab').frames, 'b', 14.0, 20.0)
    found = watched(frames, 'ab').verdict()
    assert (found.level, found.level_at_end) == ('error', 'ok') and found.state.fluoroscope == 'b'
    assert (
        'after the start; no longer detected at the end: the calibration no longer holds'
        in found.message
    )


def test_a_healthy_recording_is_ok():
    found = watched(tracking(30.0, 30.0, 'ab').frames, 'ab', CLUSTERS).verdict()
    assert (found.level, found.state, found.found_ns, found.level_at_end) == (
        'ok',
        None,
        None,
        'ok',
    )
    assert found.finding.kind is Kind.NO_DRIFT and 18 < found.watched_s < 21
    assert found.finding.numbers['watched_s'] == found.watched_s


@pytest.mark.long
def test_an_undecided_verdict_is_not_ok():
    """Recordings that are too short, or have no or too few common markers."""
    frames = tracking(30.0, 30.0, 'ab').frames
    short = watched({name: of_one[:320] for name, of_one in frames.items()}, 'ab').verdict()
    assert short.level == 'learning' and short.finding.kind is Kind.SHORT_RECORDING
    assert short.finding.numbers['length_s'] == pytest.approx(10.6, abs=0.05)
    apart = {**frames, 'b': [replace(f, target_id=f.target_id + 100) for f in frames['b']]}
    few = {
        name: [replace(f, target_id=f.target_id[:2], uv=f.uv[:2]) for f in of_one]
        for name, of_one in frames.items()
    }
    for found in (watched(apart, 'ab').verdict(), watched(few, 'ab').verdict()):
        assert found.level == 'unknown' and found.finding.kind is Kind.NOT_WATCHED
    assert watched({'a': [], 'b': []}, 'ab').verdict().level == 'learning'


@pytest.mark.long
def test_missing_views_are_no_drift_and_hide_none():
    """Of three fluoroscopes, one is off for half of the time and loses frames: its pairs have a
    start of their own.
    """
    frames = tracking(30.0, 30.0).frames
    rng = np.random.default_rng(1)
    kept = [f for k, f in enumerate(frames['c']) if k < 450 and rng.random() < 0.7]
    watch = watched({**frames, 'c': kept}, 'abc', CLUSTERS)
    assert watch.verdict().level == 'ok'
    found = watched(shifted({**frames, 'c': kept}, 'b', 18.0), 'abc', CLUSTERS).verdict()
    assert (
        found.level == 'error'
        and 'b' in found.state.fluoroscope
        and 'c' not in found.state.fluoroscope
    )


# ---- the command


@pytest.fixture(scope='module')
def folder(tmp_path_factory):
    """Calibrations and orientation of a rig of three, with healthy, drifting and short bags."""
    path = tmp_path_factory.mktemp('recording')
    calibrations, orientation = known()
    for calibration in calibrations.values():
        save_calibration(path / 'result', calibration)
    save_orientation(path / 'result', orientation)
    frames = {name: of_one[:660] for name, of_one in tracking(30.0, 30.0).frames.items()}
    frames['c'] = frames['c'][::2][:200]
    write_bag(path / 'drifted', shifted(frames, 'b', 14.0))
    write_bag(path / 'short', {name: of_one[:40] for name, of_one in frames.items()})
    write_observations_csv(
        path / 'short.csv', {name: of_one[:40] for name, of_one in frames.items()}
    )
    return path


def command(folder, source, *more):
    return (
        'reconstruct',
        folder / source,
        '--calibration',
        folder / 'result',
        '--out',
        folder / 'out.csv',
        *more,
    )


def document(capsys, *arguments):
    capsys.readouterr()
    assert run(*arguments, '--json') == 0
    return json.loads(capsys.readouterr().out)


@pytest.mark.long
def test_reconstruct_reports_a_drift_and_missing_views(folder, capsys):
    """The command writes the points nevertheless and exits with status 0."""
    said = document(capsys, *command(folder, 'drifted'))
    drift = said['drift']
    assert (
        said['frames'] == 660
        and said['incomplete'] == 460
        and said['unpaired'] == {'a': 0, 'b': 0, 'c': 0}
    )
    assert (drift['level'], drift['level_at_end'], drift['fluoroscope']) == ('error', 'error', 'b')
    assert (
        drift['size_px'] > 0.5
        and drift['sd_px'] > 0
        and 'left' in drift['place']
        and len(drift['area_px']) == 4
    )
    assert 14 < drift['found_s'] < 20 and abs(drift['began_s'] - 14) < 1.5
    assert drift['found_stamp_ns'] - drift['began_stamp_ns'] == pytest.approx(
        1e9 * (drift['found_s'] - drift['began_s']), abs=1e3
    )
    assert drift['evidence'] >= drift['threshold_error'] > drift['threshold_warn']
    with open(folder / 'out.csv', newline='') as file:
        rays = [int(row['rays']) for row in csv.DictReader(file)]
    assert len(rays) == 24 * 660 and 0.9 < np.mean(np.array(rays) == 2) / (460 / 660) < 1.1
    assert (
        run(*command(folder, 'drifted', '--cluster', CLUSTERS[0], '--cluster', CLUSTERS[1])) == 0
    )
    out = capsys.readouterr().out
    assert '460 of the frames without all fluoroscopes (a, b, c)' in out
    assert (
        'drift watch: ERROR: the image of fluoroscope b has drifted by' in out
        and 'no longer holds' in out
    )
    assert (
        document(capsys, *command(folder, 'drifted', '--cluster', CLUSTERS[0]))['drift'][
            'observations'
        ]
        > drift['observations']
    )


def test_reconstruct_reports_where_no_drift_can_be_detected(folder, capsys):
    short = document(capsys, *command(folder, 'short'))['drift']
    assert short['level'] == 'learning' and short['size_px'] is None and short['found_s'] is None
    assert 'too short to detect a drift: it has 1.3 s' in short['message']
    assert document(capsys, *command(folder, 'short', '--no-drift-watch'))['drift'] is None
    assert run(*command(folder, 'short', '--no-drift-watch')) == 0
    assert 'drift' not in capsys.readouterr().out
    table = document(capsys, *command(folder, 'short.csv'))
    assert (
        table['drift']['level'] == 'unknown'
        and 'does not contain the times' in table['drift']['message']
    )
    assert table['frames'] == 40 and table['incomplete'] == 20  # c records every other exposure


@pytest.mark.parametrize(
    'source, more, sentence',
    [
        (
            'short',
            ['--cluster', '1001 1002'],
            "--cluster: '1001 1002' does not declare a body, as 'tibia: 1001 1002",
        ),
        ('short', ['--cluster', 'tibia: 1'], '--cluster: body tibia: needs two markers or more'),
        (
            'short',
            ['--cluster', 'tibia: 1 2', '--cluster', 'femur: 2 3'],
            '--cluster: marker 2 is one of tibia and of femur',
        ),
        (
            'short',
            ['--cluster', 'tibia: 1 2', '--no-drift-watch'],
            'it cannot be used with --no-drift-watch',
        ),
        (
            'short.csv',
            ['--cluster', 'tibia: 1 2'],
            'short.csv is not a bag',
        ),
    ],
)
def test_invalid_clusters_are_refused(folder, capsys, source, more, sentence):
    (folder / 'out.csv').unlink(missing_ok=True)
    assert run(*command(folder, source, *more)) == 2
    out, err = capsys.readouterr()
    assert out == '' and sentence in err.splitlines()[-1] and not (folder / 'out.csv').exists()
