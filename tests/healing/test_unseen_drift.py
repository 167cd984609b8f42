# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Drift of the distortion: claims of healed rigs where no marker has passed."""

import numpy as np
import pytest
from test_healing import SIZE, Scene

from fluoro_calib_ros.correction.series import sd_grid_pixels, sd_over_image
from fluoro_calib_ros.healing.diagnosis import Cause, Change, Diagnosis, _Tried
from fluoro_calib_ros.healing.healed_rig import _unseen_drift, healed_rig

B = 1  # the fluoroscope whose distortion drifts
GRID = sd_grid_pixels(SIZE)


def bent(observed, bend):
    """Image points with a quadratic and cubic drift of b: (6,) px at the edges."""
    change = np.zeros(observed.uv.shape)
    change[..., B, :] = field_at(observed.pixel[..., B, :], bend)
    return observed.changed(change)


def field_at(uv, bend):
    x, y = np.moveaxis((uv - 511.5) / 512, -1, 0)
    along_u = bend[0] * x * x + bend[1] * x * y + bend[2] * x**3
    return np.stack([along_u, bend[3] * y * y + bend[4] * x * y + bend[5] * y**3], axis=-1)


def diagnosis_of(diagnostician, observed, poses, *changes):
    """Diagnosis with these changes taken as known."""
    adjustment = diagnostician.adjustment
    prior = adjustment.healthy_prior(observed, 1e-4)
    start = np.zeros(adjustment.size), poses
    solution = adjustment.solve(observed, prior, start)
    if changes:
        best = _Tried((), observed, prior, solution, 0.0)
        tried = diagnostician._with(best, *changes, start)
        prior, solution = tried.prior, tried.solution
    known = (1.0,) * len(changes), (None,) * len(changes)
    return Diagnosis(
        changes, *known, observed, prior, solution, noise=1.0, no_further_probability=1.0
    )


def seen_by_b(observed):
    """Whether grid pixels (n,) lie among the markers that b has seen."""
    pixel = observed.pixel[..., B, :][observed.seen[..., B]]
    inside = (np.abs(pixel - 511.5) < 512).all(axis=1)
    low, high = np.quantile(pixel[inside], [0.1, 0.9], axis=0)
    return ((low < GRID) & (high > GRID)).all(axis=1)


def test_affine_part_of_an_unseen_drift_is_left_to_the_rig():
    """At the markers, no shift, rotation, scale or shear of the image remains."""
    scene = Scene(3)
    diagnostician = scene.diagnostician()
    found = diagnosis_of(diagnostician, scene.observe(), scene.poses())
    functions = diagnostician.adjustment.functions[B]
    pixel = found.observed.pixel[..., B, :][found.observed.seen[..., B]]
    values = functions(pixel)
    moments = _unseen_drift(diagnostician, found, B, np.zeros(18))
    fields = np.kron(np.eye(2), values) @ moments
    affine = np.column_stack([np.ones(len(values)), pixel - 511.5])
    size = np.abs(fields).max()
    for one in np.split(fields, 2):
        fit = np.linalg.lstsq(affine, one, rcond=None)[0]
        assert np.abs(affine @ fit).max() < 1e-6 * size


@pytest.mark.long
def test_drift_that_passes_as_nothing_is_claimed_where_no_marker_has_passed():
    """Over rigs, the claim matches the drift far from the markers and is small near them."""
    rng = np.random.default_rng(1)
    ratio = []
    for seed in range(3, 9):
        scene = Scene(seed)
        diagnostician = scene.diagnostician()
        bend = rng.uniform(-1, 1, 6)
        observed = bent(scene.observe(), bend)
        found = diagnosis_of(diagnostician, observed, scene.poses())
        healed = healed_rig(diagnostician, found, 1, len(observed.uv))
        assert not healed.drift and set(healed.unseen) == {0, B}
        sd = sd_over_image(*healed.unseen[B]).ravel()
        there = seen_by_b(observed)
        rms_there, rms_far = (np.sqrt(np.mean(sd[one] ** 2)) for one in (there, ~there))
        assert rms_far > 3 * rms_there
        ratio.append(np.mean(field_at(GRID[~there], bend) ** 2) / rms_far**2)
    assert 0.2 < np.mean(ratio) < 2


@pytest.mark.long
def test_healed_drift_goes_on_where_no_marker_has_passed_and_claims_what_is_left():
    """The polynomials have the size that the markers show, whatever the size of the diagnosis."""
    rng = np.random.default_rng(2)
    left, claimed, size = [], [], []
    for seed in range(3, 9):
        scene = Scene(seed)
        diagnostician = scene.diagnostician()
        bend = rng.uniform(-4, 4, 6)
        observed = bent(scene.observe(), bend)
        change = Change(Cause.DISTORTION, B)
        found = diagnosis_of(diagnostician, observed, scene.poses(), change)
        healed = healed_rig(diagnostician, found, 1, len(observed.uv))
        assert set(healed.drift) == {B} and set(healed.unseen) == {0}
        functions, coefficients, covariance = healed.drift[B]
        far = ~seen_by_b(observed)
        true = field_at(GRID[far], bend)
        error = functions(GRID[far]) @ coefficients.T - true
        left.append(np.mean(error**2))
        claimed.append(np.mean(sd_over_image(functions, covariance).ravel()[far] ** 2))
        size.append(np.mean(true**2))
    assert np.mean(left) < 0.7 * np.mean(size)
    assert np.mean(np.array(left) / claimed) == pytest.approx(1, abs=0.7)
