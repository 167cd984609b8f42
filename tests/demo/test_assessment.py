# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Figures of the demonstration, for results whose errors are known."""

import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace as Fake

import numpy as np
import pytest

from fluoro_calib_ros.demo import assessment
from fluoro_calib_ros.demo.image_twin import LiveKnee
from fluoro_calib_ros.photogrammetry.rotations import matrix_from_vector
from fluoro_calib_ros.simulation.knee import landing, virtual_knee

BAGS = Path(__file__).parents[2] / 'bags'
FRAMES = range(1, 31)


@pytest.fixture(scope='module')
def truth():
    """Return the true rig of the bags and its markers."""
    return assessment.RecordedRig.of(BAGS, ['a', 'b'])


def markers_of(truth, frame):
    ids = np.array([target for number, target in truth if number == frame])
    return ids, np.array([truth[frame, target] for target in ids])


def test_latency_is_from_the_frame_to_its_correction():
    sent = {('a', 1): (None, 5_000_000), ('a', 2): (None, 8_000_000), ('b', 1): (None, 0)}
    corrected = {('a', 2): (None, 9_500_000), ('a', 1): (None, 7_000_000)}
    np.testing.assert_allclose(assessment.latencies_ms(sent, corrected), [1.5, 2.0])


def test_points_in_space_are_compared_after_the_best_rotation_and_shift(truth):
    rng = np.random.default_rng(1)
    turn = matrix_from_vector(np.array([0.3, -0.2, 0.5]))
    sd = np.array([0.1, 0.2, 0.4])
    points, sent = [], {}
    for frame in FRAMES:
        ids, xyz = markers_of(truth.markers, frame)
        measured = (xyz + rng.normal(0, sd, xyz.shape)) @ turn.T + [10.0, -20.0, 30.0]
        covariance = np.broadcast_to(turn @ np.diag(sd**2) @ turn.T, (len(ids), 3, 3))
        found = Fake(
            frame_number=frame,
            target_id=ids,
            xyz_mm=measured,
            covariance=covariance,
            total=2 * len(ids),
        )
        points.append((found, 1_000_000 * frame + 3_000_000))
        if frame > 1:
            sent['a', frame] = (None, 1_000_000 * frame)
    figures = assessment.space_figures(truth, points, sent, 'a')
    assert figures.rmse_mm == pytest.approx(np.sqrt(np.sum(sd**2)), rel=0.1)
    assert figures.normalised == pytest.approx(1, rel=0.1)
    assert (figures.good_fraction, figures.exposures) == (0.5, len(FRAMES))
    assert figures.latency_ms == pytest.approx(3.0)


def test_image_errors_are_what_no_projective_map_explains(truth):
    rng = np.random.default_rng(2)
    sent, corrected = {}, {}
    for frame in FRAMES:
        ids, xyz = markers_of(truth.markers, frame)
        for fluoroscope, noise in zip(truth.rig.fluoroscopes, (0.5, 0.1)):
            name = fluoroscope.name
            ideal = fluoroscope.ideal(xyz)
            observed = ideal + rng.normal(0, 5 * noise, ideal.shape)
            # The sensor plane of a calibration may be any; errors refer to the true plane.
            turned = 1.5 * ideal @ [[1.02, 0.03], [-0.02, 0.97]] + [12.0, -7.0]
            turned = turned / (1 + turned @ [[2e-5], [-1e-5]])
            turned += rng.normal(0, 1.5 * noise, ideal.shape)
            sent[name, frame] = (Fake(u=observed[:, 0], v=observed[:, 1]), 0)
            corrected[name, frame] = (Fake(u=turned[:, 0], v=turned[:, 1], target_id=ids), 0)
    errors = assessment.image_errors(truth, sent, corrected)
    np.testing.assert_allclose(errors['a'], (2.5, 0.5), rtol=0.1)
    np.testing.assert_allclose(errors['b'], (0.5, 0.1), rtol=0.1)


def test_a_calibration_has_the_error_that_its_correction_leaves(truth):
    field = truth.rig.fluoroscopes[0].distortion
    only_a = replace(truth, rig=replace(truth.rig, fluoroscopes=truth.rig.fluoroscopes[:1]))

    def corrected(share):
        def correct(u, v):
            uv = np.stack([u, v], axis=1)
            return (*(uv - share * field(uv)).T, None)

        return Fake(correct_arrays=correct)

    left = [
        assessment.calibration_errors(only_a, {'a': corrected(share)})['a']
        for share in (1.0, 0.9, 0.0)
    ]
    assert left[0] < 1e-6
    assert left[1] == pytest.approx(0.1 * left[2], rel=0.05) and left[2] > 0.3


def test_live_angles_are_compared_with_those_of_the_same_frame(tmp_path):
    live = LiveKnee.__new__(LiveKnee)
    live._knee = virtual_knee(1)
    live._truth = landing(live._knee, np.arange(40) / 40)
    off = np.radians([1.0, -2.0, 0.5])
    sd = np.append(np.radians([0.5, 1.0, 0.25]), [1e-3] * 3)  # turns [rad], shifts [m]
    messages = [
        Fake(
            frame_number=number,
            header=Fake(stamp=Fake(sec=7, nanosec=number)),
            angle=live._truth.angles[number - 1] + off if number != 9 else np.full(3, np.nan),
            translation=np.zeros(3),
            covariance=np.diag(sd**2).ravel(),
            status=[0],
        )
        for number in (5, 9, 31, 12)
    ]
    line = live.assess(messages, tmp_path / 'knee.png')
    assert (tmp_path / 'knee.png').stat().st_size > 1000
    count, total, *figures = map(float, re.findall(r'\d+(?:\.\d+)?', line.partition('; pic')[0]))
    assert (count, total) == (3, 40)
    assert figures == [1.0, 2.0, 0.5, 4.0]  # RMSE of each angle; squared error over variance
