# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Image points without sigma get the noise that their rays show, if it is noise."""

import functools
from dataclasses import replace

import numpy as np
import pytest
from rigs import true_calibrations, true_orientation

from fluoro_calib_ros.bodies.body import declared_bodies
from fluoro_calib_ros.exposures.frame import frames_of_targets
from fluoro_calib_ros.findings import Kind
from fluoro_calib_ros.jobs.bodies import track_bodies
from fluoro_calib_ros.jobs.reconstruction import ReconstructionOptions, reconstruct
from fluoro_calib_ros.photogrammetry.rotations import matrix_from_vector
from fluoro_calib_ros.reconstruction.intersection import Intersector
from fluoro_calib_ros.reconstruction.observed_noise import NoiseOfRays, with_observed_noise
from fluoro_calib_ros.reconstruction.reconstruct import RigRecording, match_views
from fluoro_calib_ros.simulation.rig import (
    StreamStart,
    image_frames,
    simulate_tracking,
    virtual_rig,
)

BEADS_PX = 0.05  # noise of the image points of the calibration
RATE_HZ = 100.0


@functools.cache
def rig(names):
    """A rig without distortion, with its true calibrations and orientation."""
    made = virtual_rig(7, strength=0.0, names=tuple(names), between_deg=60.0)
    calibrations = true_calibrations(made.fluoroscopes, BEADS_PX)
    return made, calibrations, true_orientation(made.fluoroscopes, calibrations)


@functools.cache
def tracking(noise_px, names='ab', seconds=1.0):
    return simulate_tracking(rig(names)[0], seconds, RATE_HZ, seed=5, noise_px=noise_px)


def observed(frames, names='ab', **options):
    return of_rig(frames, *rig(names)[1:], **options)


def of_rig(frames, calibrations, orientation, **options):
    recording = RigRecording(frames, calibrations, Intersector(orientation))
    noisy, finding = with_observed_noise(recording, **options)
    return noisy.frames, finding


def turned(orientation, degrees):
    """The orientation after a knock of its second fluoroscope."""
    rotation = orientation.rotation.copy()
    rotation[1] = matrix_from_vector(np.radians([degrees, 0, 0])) @ rotation[1]
    return replace(orientation, rotation=rotation)


@pytest.mark.parametrize(('names', 'noise_px'), [('ab', 0.1), ('ab', 0.4), ('abc', 0.2)])
def test_noise_is_that_of_the_markers(names, noise_px):
    frames, found = observed(tracking(noise_px, names).frames, names)
    assert found.kind is Kind.NOISE_OBSERVED
    assert found.numbers['noise_px'] == pytest.approx(noise_px, rel=0.08)
    assert found.numbers['calibration_px'] == pytest.approx(BEADS_PX)
    for name in names:
        for frame in frames[name]:
            assert frame.sigma == pytest.approx(np.full(len(frame.uv), found.numbers['noise_px']))


@pytest.mark.parametrize('noise_px', [0.01, BEADS_PX, 0.055])
def test_markers_as_precise_as_beads_or_more_have_the_noise_of_the_calibration(noise_px):
    given = tracking(noise_px).frames
    frames, found = observed(given)
    assert frames is given and found is None


@pytest.mark.parametrize('share', [0.1, 0.25, 0.4])
def test_false_matches_are_no_noise(share):
    rng = np.random.default_rng(8)

    def confused(frame):
        wrong = np.flatnonzero(rng.random(len(frame.uv)) < share)
        order = np.arange(len(frame.uv))
        order[wrong] = rng.permutation(wrong)
        return replace(frame, uv=frame.uv[order])

    given = {name: list(map(confused, of_one)) for name, of_one in tracking(0.05).frames.items()}
    assert observed(given)[1] is None


def test_stated_sigma_holds():
    given = dict(tracking(0.4).frames)
    given['a'] = [replace(frame, sigma=np.full(len(frame.uv), 0.1)) for frame in given['a']]
    frames, found = observed(given)
    assert frames is given and found is None


def factors(sigma, noise_px=0.2, names='ab', step=1):
    """Factors on the standard deviations of the exposures of a stream, which follow them."""
    _, calibrations, orientation = rig(names)
    recording = RigRecording(
        tracking(noise_px, names).frames, calibrations, Intersector(orientation)
    )
    noise = NoiseOfRays(orientation, [calibrations[name].image_size[0] for name in names])
    out = []
    for exposure in recording.exposures[::step]:
        out.append(noise.factor)
        noise.add(match_views([None] * len(names[1:]) + [recording.corrected(exposure['a'])]))
        stated = [
            replace(exposure[name], sigma=np.full(len(exposure[name].uv), sigma * noise.factor))
            for name in names
        ]
        noise.add(match_views([recording.corrected(frame) for frame in stated]))
    return np.array(out)


@pytest.mark.parametrize('names', ['ab', 'abc'])
def test_rays_of_a_stream_tell_by_how_much_its_noise_is_larger_than_stated(names):
    found = factors(0.1, names=names)
    assert found[:2].tolist() == [1, 1]  # a difference needs two exposures
    assert found[-1] == pytest.approx(2.0, rel=0.08)
    assert found[40:] == pytest.approx(found[-1], rel=0.15)


@pytest.mark.parametrize('sigma', [0.2, 0.4])
def test_noise_of_a_stream_that_is_stated_or_less_widens_nothing(sigma):
    found = factors(sigma)
    assert found.max() < 1.25  # the scatter of few differences
    assert found[40:] == pytest.approx(1.0, abs=0.05)


def test_remote_exposures_of_a_stream_tell_nothing():
    assert (factors(0.1, step=40) == 1).all()


def test_few_or_remote_exposures_tell_nothing():
    given = tracking(0.4).frames
    single = {name: of_one[:1] for name, of_one in given.items()}
    assert observed(single)[1] is None
    remote = {name: of_one[::40] for name, of_one in given.items()}
    few = frames_of_targets(remote, np.arange(1001, 1005))
    assert observed(few)[1] is None


def test_what_is_no_noise_is_not_taken_for_it():
    _, calibrations, orientation = rig('ab')
    knocked = turned(orientation, 0.5)
    precise = tracking(BEADS_PX).frames
    assert of_rig(precise, calibrations, knocked)[1] is None
    noisy = tracking(0.4).frames
    assert of_rig(noisy, calibrations, knocked)[1] is None
    found = of_rig(noisy, calibrations, knocked, must_explain=False)[1]
    assert found.numbers['noise_px'] == pytest.approx(0.4, rel=0.08)
    shifted = {**precise, 'b': [replace(f, target_id=f.target_id + 1) for f in precise['b']]}
    assert observed(shifted)[1] is None
    mirrored = {**precise, 'b': [replace(f, uv=1023 - f.uv) for f in precise['b']]}
    assert observed(mirrored)[1] is None


def test_points_of_imprecise_markers_are_kept_and_as_precise_as_claimed():
    _, calibrations, orientation = rig('ab')
    made = tracking(0.4)
    options = ReconstructionOptions(drift_watch=False)
    outcome = reconstruct(made.frames, calibrations, orientation, options)
    assert outcome.noise.kind is Kind.NOISE_OBSERVED and outcome.widening == 1.0
    counts = outcome.status_counts
    assert counts['REJECTED'] <= 0.002 * sum(counts.values())
    errors = np.concatenate(
        [frame.points.xyz_mm - true for frame, true in zip(outcome.frames, made.points_mm)]
    )
    sd = np.concatenate([frame.points.sd_mm for frame in outcome.frames])
    kept = np.isfinite(errors)
    assert np.mean((errors[kept] / sd[kept]) ** 2) == pytest.approx(1, abs=0.15)


def test_bodies_of_imprecise_markers_are_rigid():
    _, calibrations, orientation = rig('ab')
    bodies = declared_bodies(['tibia: 1001 1002 1003 1004 1005 1006'])
    outcome = track_bodies(tracking(0.4).frames, calibrations, orientation, bodies)
    assert outcome.noise.kind is Kind.NOISE_OBSERVED and not outcome.findings
    (poses,) = outcome.poses
    assert poses.known.mean() > 0.99


def test_residuals_of_different_views_are_not_compared():
    """Of markers in the middle of all images, of which one is missing in turn."""
    made, calibrations, orientation = rig('abc')
    points = np.random.default_rng(7).uniform(-12, 12, (8, 3))
    frames, _ = image_frames(
        made,
        np.broadcast_to(points, (80, 8, 3)),
        np.arange(1, 9),
        (np.arange(80) / RATE_HZ).tolist(),
        noise_px=BEADS_PX,
        rng=np.random.default_rng(3),
        start=StreamStart(),
    )
    sd = np.tile(np.repeat([0.3, 5e-4, 0.1], 3), 3)
    some = {
        name: [frame for frame in of_view if 'abc'[frame.number % 3] != name]
        for name, of_view in frames.items()
    }
    for seed in range(3):
        wrong = (np.random.default_rng(seed).normal(size=27) * sd).reshape(3, 9)
        moved = replace(
            orientation,
            position_mm=orientation.position_mm + wrong[:, :3],
            rotation=matrix_from_vector(wrong[:, 3:6]) @ orientation.rotation,
            covariance=np.diag(sd**2),
        )
        for given in (frames, some):
            assert of_rig(given, calibrations, moved)[1] is None
