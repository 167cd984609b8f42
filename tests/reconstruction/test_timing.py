# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Fluoroscopes that are delayed, or have lost a frame."""

import functools
from dataclasses import replace

import numpy as np
import pytest
from rigs import refused, true_calibrations, true_orientation
from scipy.integrate import quad
from scipy.spatial.transform import Rotation

from fluoro_calib_ros.findings import Kind, Severity
from fluoro_calib_ros.jobs.reconstruction import reconstruct
from fluoro_calib_ros.reconstruction.intersection import Intersector
from fluoro_calib_ros.reconstruction.reconstruct import (
    RigRecording,
    corrected_view,
)
from fluoro_calib_ros.reconstruction.timing import (
    KEPT,
    LOSS,
    ROBUST,
    Delay,
    RecentExposures,
    delay_finding,
    timing_of_recording,
)
from fluoro_calib_ros.simulation.rig import simulate_tracking, virtual_rig

NOISE_PX = 0.25
RATE_HZ = 60.0


@functools.cache
def rig():
    """A rig of three fluoroscopes without distortion."""
    return virtual_rig(2, strength=0.0, names=('a', 'b', 'c'), between_deg=60.0)


@functools.cache
def known(names='ab'):
    """True calibrations and orientation of some fluoroscopes of the rig."""
    calibrations = true_calibrations(rig().fluoroscopes, NOISE_PX)
    orientation = true_orientation(rig().fluoroscopes, calibrations).subset(list(names))
    return {name: calibrations[name] for name in names}, orientation


@functools.cache
def tracked(seed, seconds, rate_hz):
    """Frames of all fluoroscopes by name."""
    return simulate_tracking(rig(), seconds, rate_hz, seed=seed, noise_px=NOISE_PX).frames


@functools.cache
def recorded(steps, names='ab', seed=4, seconds=2.0, rate_hz=RATE_HZ):
    """Frames of which those of the last fluoroscope are late by quarters of a frame interval."""
    frames = tracked(seed, seconds, 4 * rate_hz)
    late = {name: steps if name == names[-1] else 0 for name in names}
    return {
        name: [
            replace(frame, number=(frame.number - late[name]) // 4)
            for frame in frames[name][4 + late[name] :: 4]
        ]
        for name in names
    }


def found(frames, names='ab', orientation=None):
    calibrations, known_orientation = known(names)
    intersector = Intersector((orientation or known_orientation).subset(list(names)))
    return timing_of_recording(RigRecording(frames, calibrations, intersector))


@pytest.mark.parametrize('names', ['ab', 'abc'])
@pytest.mark.parametrize('steps', [-1, 1, 2, 3])
def test_a_fluoroscope_that_is_late_or_early_is_named(steps, names):
    finding = found(recorded(steps, names), names)
    assert (finding.kind, finding.severity) == (Kind.FRAMES_DELAYED, Severity.WARNING)
    assert finding.place.fluoroscopes == ('a', names[-1])
    assert abs(finding.numbers['frames'] - steps / 4) < 4 * finding.numbers['sd'] < 0.1
    assert finding.numbers['interval_s'] == pytest.approx(1 / RATE_HZ, rel=1e-6)


@pytest.mark.parametrize('steps', [5, 6, 17])
def test_a_delay_of_more_than_an_interval_is_measured(steps):
    finding = found(recorded(steps))
    assert finding.kind is Kind.FRAMES_DELAYED
    assert abs(finding.numbers['frames'] - steps / 4) < 4 * finding.numbers['sd'] < 0.1


@pytest.mark.parametrize('shift', [1, -1, 2, -5, 12])
def test_frame_numbers_that_are_off_are_named(shift):
    frames = recorded(0)
    renumbered = [replace(frame, number=frame.number + shift) for frame in frames['b']]
    finding = found({**frames, 'b': renumbered})
    assert (finding.kind, finding.place.fluoroscopes) == (Kind.FRAMES_SHIFTED, ('b',))
    assert finding.numbers == {'shift': shift}


def test_the_standard_deviation_is_that_of_repetitions():
    found_numbers = [found(recorded(2, seed=seed, seconds=1.0)).numbers for seed in range(20)]
    errors = np.array([numbers['frames'] for numbers in found_numbers]) - 0.5
    stated = np.sqrt(np.mean([numbers['sd'] ** 2 for numbers in found_numbers]))
    # The standard deviation of 20 values is known to 16 %.
    assert 0.6 < np.std(errors) / stated < 1.4 and abs(errors.mean()) < stated


def dented(frames):
    """Frames of which those of b have a local distortion of 1 px."""

    def change(frame):
        shift = np.exp(-np.sum((frame.uv - [500, 600]) ** 2, axis=1) / (2 * 150**2))
        return replace(frame, uv=frame.uv + shift[:, None] * [0.6, 0.8])

    return {**frames, 'b': [change(frame) for frame in frames['b']]}


def renamed(frames):
    """Frames of which every fifth of b has wrong ids."""
    b = [
        replace(frame, target_id=np.roll(frame.target_id, 1)) if frame.number % 5 == 0 else frame
        for frame in frames['b']
    ]
    return {**frames, 'b': b}


@pytest.mark.parametrize('change', [dict, dented, renamed])
def test_other_faults_are_no_delay(change):
    assert found(change(recorded(0))) is None


def test_a_moved_fluoroscope_is_no_delay():
    _, orientation = known()
    rotation = orientation.rotation.copy()
    rotation[1] = Rotation.from_rotvec([0.004, -0.003, 0.002]).as_matrix() @ rotation[1]
    moved = replace(orientation, rotation=rotation)
    assert found(recorded(0), orientation=moved) is None


def without(frames, name, *lost):
    """Frames of which a fluoroscope has lost some, numbered without a gap."""
    kept = [frame for frame in frames[name] if frame.number not in lost]
    first = frames[name][0].number
    return {**frames, name: [replace(f, number=first + row) for row, f in enumerate(kept)]}


@pytest.mark.parametrize('exposure', [4, 60, 114])
@pytest.mark.parametrize('name', ['a', 'b'])
def test_a_lost_frame_is_named(name, exposure):
    finding = found(without(recorded(0), name, exposure))
    assert finding.kind is Kind.FRAME_LOST and finding.place.fluoroscopes == (name,)
    assert finding.numbers == {'exposure': exposure, 'frames': 1}


@pytest.mark.parametrize('lost', [(60, 61, 62), (40, 80), (30, 60, 90), (40, 41, 80)])
def test_several_lost_frames_are_named(lost):
    finding = found(without(recorded(0), 'b', *lost))
    assert finding.kind is Kind.FRAME_LOST and finding.place.fluoroscopes == ('b',)
    assert finding.numbers == {'exposure': lost[0], 'frames': len(lost)}
    # Frames of a burst are one loss; numbers of a count exposures, those of b have lost some.
    firsts = tuple(number for number in lost if number - 1 not in lost)
    assert finding.place.exposures == firsts
    finding = found(without(without(recorded(0), 'b', 80), 'a', 40))
    assert finding.place.fluoroscopes == ('a', 'b') and finding.numbers['frames'] == 2


def test_a_lost_frame_of_a_long_recording_is_named_with_its_exposure():
    """It is found between the exposures that are tested first, and is no delay by a half."""
    finding = found(without(recorded(0, seconds=20.0), 'b', 603))
    assert finding.kind is Kind.FRAME_LOST
    assert finding.numbers == {'exposure': 603, 'frames': 1}


def test_a_lost_frame_is_not_named_beside_another_fault():
    assert found(dented(without(recorded(0), 'b', 60))) is None


def test_noise_has_the_stated_losses():
    def mean(function):
        def density(x):
            return function(x) * np.exp(-x * x / 2) / np.sqrt(2 * np.pi)

        return quad(density, -20, 20)[0]

    assert mean(lambda x: np.log1p((x / ROBUST) ** 2)) == pytest.approx(LOSS, abs=5e-4)
    kept = mean(lambda x: x * x / (1 + (x / ROBUST) ** 2))
    assert kept / mean(lambda x: 1 / (1 + (x / ROBUST) ** 2)) == pytest.approx(KEPT, abs=1e-3)


@pytest.mark.parametrize(
    ('frames', 'sd', 'kind'),
    [
        (0.9, 0.01, Kind.FRAMES_DELAYED),
        (0.99, 0.01, Kind.FRAMES_SHIFTED),
        (3.01, 0.001, Kind.FRAMES_SHIFTED),
        (3.05, 0.001, Kind.FRAMES_DELAYED),
        (-0.8, 0.05, Kind.FRAMES_DELAYED),
        (-0.95, 0.02, Kind.FRAMES_SHIFTED),
    ],
)
def test_a_delay_of_a_whole_interval_is_a_wrong_number(frames, sd, kind):
    assert delay_finding(('a', 'b'), Delay(frames, sd, 1.0), 0.0).kind is kind


def test_points_without_noise_are_judged():
    calibrations, orientation = known()
    exact = {
        name: [replace(f, sigma=np.full(len(f.uv), 1e-12)) for f in frames]
        for name, frames in recorded(2).items()
    }
    recording = RigRecording(exact, calibrations, Intersector(orientation))
    with np.errstate(all='raise'):
        timing_of_recording(recording)


def test_points_at_rest_and_short_recordings_tell_nothing():
    frames = recorded(2)
    still = {name: [replace(f, uv=fs[0].uv) for f in fs] for name, fs in frames.items()}
    assert found(still) is None
    assert found({name: fs[:2] for name, fs in frames.items()}) is None


def test_reconstruction_of_a_recording_tells_the_delay():
    calibrations, orientation = known()
    outcome = reconstruct(recorded(1), calibrations, orientation)
    assert outcome.timing.kind is Kind.FRAMES_DELAYED
    assert outcome.drift.finding.kind is Kind.NOT_WATCHED
    assert reconstruct(recorded(0), calibrations, orientation).timing is None


def test_a_stream_is_judged_if_its_rays_miss():
    calibrations, orientation = known()
    recent = RecentExposures(lambda frame: corrected_view(frame, calibrations[frame.fluoroscope]))
    frames = recorded(2, seconds=12.0, rate_hz=5.0)
    recording = RigRecording(frames, calibrations, Intersector(orientation))
    for exposure, frame in zip(recording.exposures, recording.reconstruct(), strict=True):
        recent.add(exposure, frame.points)
    misses, timing = recent.faults(orientation, is_doubtful=False)
    assert misses.kind is timing.kind is Kind.FRAMES_DELAYED and misses.numbers['share'] > 0.5
    slow = RecentExposures(lambda frame: corrected_view(frame, calibrations[frame.fluoroscope]))
    frames = recorded(2)
    recording = RigRecording(frames, calibrations, Intersector(orientation))
    for exposure, frame in zip(recording.exposures, recording.reconstruct()):
        slow.add(exposure, frame.points)
    assert slow.faults(orientation, is_doubtful=False) == (None, None)
    assert slow.faults(orientation, is_doubtful=True)[1].kind is Kind.FRAMES_DELAYED


def test_a_delay_is_the_cause_if_most_rays_miss():
    calibrations, orientation = known()
    with refused(Kind.FRAMES_DELAYED):
        reconstruct(recorded(2, seconds=12.0, rate_hz=5.0), calibrations, orientation)
