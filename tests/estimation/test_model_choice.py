# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Choice of the model, and errors of models estimated from their difference to collocation."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import rigs
from rigs import create_model

from fluoro_calib_ros.correction.calibration_record import SD_GRID
from fluoro_calib_ros.correction.series import Functions, Series, sd_grid_pixels
from fluoro_calib_ros.estimation.collocation import CollocationTerms
from fluoro_calib_ros.estimation.estimator import (
    AdjustmentProblem,
    GaugeKind,
    exposure_folds,
    gauge_basis,
)
from fluoro_calib_ros.estimation.exposure_terms import ExposureTerms, exposure_functions
from fluoro_calib_ros.estimation.model_choice import (
    _held_out,
    _held_out_of_terms,
    _precision_by,
    better_model,
    with_errors_by,
)
from fluoro_calib_ros.estimation.priors import prior_precision
from fluoro_calib_ros.estimation.signal import Signal
from fluoro_calib_ros.photogrammetry.adjustment import adjust
from fluoro_calib_ros.photogrammetry.noise import Noise
from fluoro_calib_ros.photogrammetry.precision import Precision
from fluoro_calib_ros.photogrammetry.rotations import matrix_from_vector
from fluoro_calib_ros.photogrammetry.unknowns import Parameters

SIZE = (1024, 1024)
INTERIOR = np.array([500.0, 520.0, 4000.0])


def case(gauge=GaugeKind.FULL, modes=10, **shape):
    """A small network, its adjustment, and terms of collocation for it."""
    network, truth = rigs.small_network(**{'exposures': 6, 'targets': 60, **shape})
    before = adjust(network, truth, noise=Noise('gaussian', 0.3))
    kinds = (gauge,) * network.n_fluoroscopes
    problem = AdjustmentProblem(network, [SIZE] * network.n_fluoroscopes, before, kinds)
    terms = CollocationTerms(problem, modes)
    for part in terms.parts:
        part.prior = replace(part.prior, signal=Signal(3.0, 150.0))
    return network, before, terms


def held_out_densely(design, precision, values, weight, fold):
    """Predict values (N, 2) with functions (N, 2, p) fitted to all folds except their own."""
    out = np.empty_like(values)
    for number in np.unique(fold):
        used = fold != number
        a = design[used].reshape(-1, design.shape[2])
        w = np.repeat(weight[used], 2)
        found = np.linalg.solve(
            a.T @ (w[:, None] * a) + precision, a.T @ (w * values[used].ravel())
        )
        out[~used] = design[~used] @ found
    return out


@pytest.mark.parametrize('gauge', GaugeKind)
def test_predictions_of_held_out_exposures_are_those_of_a_dense_solution(gauge):
    network, _, terms = case(gauge, seed=3)
    part = terms.parts[0]
    rng = np.random.default_rng(1)
    part.prior = replace(part.prior, trend=rng.uniform(0.1, 9.0, len(part.prior.trend)))
    values = rng.normal(0, 2.0, network.uv.shape)
    weight = rng.uniform(1.0, 9.0, len(values))
    fold = exposure_folds(network.exposure, 3)
    precision = prior_precision(part.functions, part.prior) + part.gauge
    found = _held_out(precision, part.values, values, weight, fold)
    design = np.einsum('nm,ab->nabm', part.values, np.eye(2)).reshape(len(values), 2, -1)
    expected = held_out_densely(design, precision, values, weight, fold)
    # The gauges make the condition 2e16: either solution is then off by up to 1e-4 px, which is
    # small against the noise of 2 px.
    np.testing.assert_allclose(found, expected, atol=1e-3)


def test_predictions_by_terms_are_those_of_weighted_least_squares():
    rng = np.random.default_rng(2)
    functions = rng.normal(size=(90, 2, 5)) * [1.0, 10.0, 1e3, 1e-2, 5.0]
    values = rng.normal(size=(90, 2))
    weight = rng.uniform(0.1, 4.0, 90)
    fold = np.arange(90) % 4
    found = _held_out_of_terms(functions, values, weight, fold)
    expected = held_out_densely(functions, np.zeros((5, 5)), values, weight, fold)
    np.testing.assert_allclose(found, expected, atol=1e-7)


def squares(uv):
    """Steps (n, 2) [px] in squares of 100 px."""
    inside = np.floor(uv / 100).sum(axis=1) % 2
    return np.where(inside[:, None] == 0, 1.0, -1.0) * [3.0, 2.0]


def smooth(uv):
    """A field (n, 2) [px] that collocation can follow, without its gauge part."""
    field = 3.0 * np.sin(uv / 75.0)
    flat = gauge_basis(uv, INTERIOR).reshape(2 * len(uv), -1)
    return field - (flat @ np.linalg.lstsq(flat, field.ravel(), rcond=None)[0]).reshape(-1, 2)


def calibrated_with(network, before, residuals):
    """A self-calibration by collocation with residuals (N, 2) and zero correction."""
    q = np.sum(residuals**2, axis=1) / (0.3 * network.sigma) ** 2
    after = replace(before, residuals=residuals, q=np.minimum(q, 1.0))
    measured = SimpleNamespace(
        network=network, image_size=[SIZE] * network.n_fluoroscopes, fluoroscopes=['a', 'b']
    )
    measured.fluoroscopes = measured.fluoroscopes[: network.n_fluoroscopes]
    return SimpleNamespace(
        measured=measured, before=before, after=after, correction=np.zeros_like(residuals)
    )


def test_a_model_is_better_where_it_predicts_held_out_exposures_better():
    network, before, terms = case(exposures=10, targets=130)
    noise = np.random.default_rng(4).normal(0, 0.1, network.uv.shape)
    stepped = calibrated_with(network, before, squares(network.uv) + noise)
    assert better_model(stepped, terms) in ('knn', 'local_linear')
    bent = calibrated_with(network, before, smooth(network.uv) + noise)
    assert better_model(bent, terms) is None
    part = terms.parts[0]
    functions = exposure_functions(part.uv, SIZE, part.interior)
    part.own = ExposureTerms(functions, part.exposure, 0.5)
    assert better_model(stepped, terms) is None  # no other model can follow differences


def test_scores_of_models_are_weighted_by_sigma_and_summed_over_fluoroscopes():
    """Steps with a low weight, by sigma or next to a stronger signal, do not change the choice."""
    network, before, terms = case(exposures=10, targets=130, fluoroscopes=2)
    noise = np.random.default_rng(4).normal(0, 0.1, network.uv.shape)
    of_second = network.fluoroscope[network.exposure] == 1
    both = squares(network.uv) + noise
    both[~of_second] = smooth(network.uv[~of_second]) + noise[~of_second]
    assert better_model(calibrated_with(network, before, both), terms) in ('knn', 'local_linear')
    blurred = replace(network, sigma=np.where(of_second, 300.0, 1.0))
    assert better_model(calibrated_with(blurred, before, both), terms) is None


def parameters(rng):
    rotation = matrix_from_vector(rng.normal(size=(3, 3)))
    return Parameters(
        rng.normal(size=(1, 3)), rotation, rng.normal(size=(3, 3)), rng.normal(size=(2, 3))
    )


def spread(rng, count, size):
    root = rng.normal(size=(count, size, size))
    return root @ root.transpose(0, 2, 1)


def test_unknowns_state_their_difference_from_those_of_the_reference():
    rng = np.random.default_rng(5)
    other = parameters(rng)
    step = rng.normal(0, 0.1, (3, 6))
    interior = np.array([[0.3, -0.2, 0.5]])
    points = np.array([[0.1, 0.2, -0.4], [0.5, 0.0, -0.1]])
    found = Parameters(
        other.interior + interior,
        matrix_from_vector(step[:, 3:]) @ other.rotation,
        other.position_mm + step[:, :3],
        other.points_mm + points,
    )
    joint = spread(rng, 1, 6)[0]
    of_reference = Precision(
        spread(rng, 1, 3),
        spread(rng, 3, 6),
        spread(rng, 2, 3),
        *(None,) * 3,
        additional=(),
        relative=(),
        relative_redundancy=(),
        all_global=None,
        exterior_global=None,
        joint_points=joint,
    )
    mine = replace(of_reference, all_global='of the network')
    runs = [
        SimpleNamespace(after=SimpleNamespace(parameters=p), precision=precise)
        for p, precise in ((other, of_reference), (found, mine))
    ]
    stated = _precision_by(*runs)
    for name, differences in (('interior', interior), ('exterior', step), ('points', points)):
        expected = [c + np.outer(d, d) for c, d in zip(getattr(of_reference, name), differences)]
        np.testing.assert_allclose(getattr(stated, name), expected, atol=1e-12)
    np.testing.assert_allclose(
        stated.joint_points, joint + np.outer(points.ravel(), points.ravel()), atol=1e-12
    )
    assert stated.all_global == 'of the network'
    runs[0].precision = replace(of_reference, joint_points=None)
    assert _precision_by(*runs).joint_points is None


def series(uv, field, sd):
    """A series that approximates a field at pixels, with a standard deviation [px]."""
    functions = Functions(SIZE, 5)
    coefficients = np.linalg.lstsq(functions(uv), field, rcond=None)[0].T
    return Series(functions, coefficients, np.full((SD_GRID, SD_GRID), sd))


def errors_by(model, reference, monkeypatch, uv):
    """The model with its errors estimated from a reference model."""
    module = 'fluoro_calib_ros.estimation.model_choice._precision_by'
    monkeypatch.setattr(module, lambda *runs: None)
    rows = np.arange(len(uv))
    network = SimpleNamespace(rows=lambda f: rows, uv=uv)
    run = SimpleNamespace(
        models={'a': model},
        measured=SimpleNamespace(network=network, image_size=[SIZE]),
        trained=rows % 7 > 0,
        after=SimpleNamespace(parameters=SimpleNamespace(interior=INTERIOR[None])),
    )
    module = 'fluoro_calib_ros.estimation.model_choice.replace'
    monkeypatch.setattr(
        module,
        lambda one, **changes: changes['models'] if one is run else replace(one, **changes),
    )
    other = SimpleNamespace(models={'a': reference})
    return with_errors_by(other, run, [GaugeKind.FULL])['a']


def test_expected_error_is_the_difference_without_gauge_and_the_variance(monkeypatch):
    rng = np.random.default_rng(6)
    uv = rng.uniform(0, 1023, (900, 2))
    x, y = ((uv - 511.5) / 512).T
    cubic = np.stack([x**3, -x * y], axis=1)
    # The part that orientations absorb, from the points to which the model was fitted.
    basis = gauge_basis(uv, INTERIOR)
    kept = np.arange(len(uv)) % 7 > 0
    flat = basis[kept].reshape(-1, 6)
    share = np.linalg.lstsq(flat, cubic[kept].ravel(), rcond=None)[0]
    reference = create_model(
        'collocation', 0, uv, np.zeros_like(uv), series=series(uv, np.zeros_like(uv), 0.2)
    )
    turned = 4.0 * basis @ rng.normal(size=6)
    model = create_model(
        'parametric', 0, uv, np.zeros_like(uv), series=series(uv, cubic + turned, 0.05)
    )
    found = errors_by(model, reference, monkeypatch, uv)
    pixels = sd_grid_pixels(SIZE)
    x, y = ((pixels - 511.5) / 512).T
    left = np.stack([x**3, -x * y], axis=1) - gauge_basis(pixels, INTERIOR) @ share
    expected = np.sqrt(np.mean(left**2, axis=1) + 0.2**2)
    np.testing.assert_allclose(found.series.sd.ravel(), expected, atol=1e-6)
    np.testing.assert_array_equal(found.predict(uv), model.predict(uv))


def test_errors_of_a_model_of_neighbours_are_those_expected_in_the_mean(monkeypatch):
    rng = np.random.default_rng(7)
    uv = rng.uniform(200, 823, (500, 2))
    wave = 0.5 * np.sin(uv / 40)
    model = create_model('knn', 12, uv, wave, noise_px=0.3, bias_px=0.1)
    reference = create_model(
        'collocation', 0, uv, np.zeros_like(uv), series=series(uv, np.zeros_like(uv), 0.2)
    )
    found = errors_by(model, reference, monkeypatch, uv)
    pixels = sd_grid_pixels(SIZE)
    pixels = pixels[~model.outside(pixels)]
    kept = np.arange(len(uv)) % 7 > 0
    flat = gauge_basis(uv[kept], INTERIOR).reshape(-1, 6)
    share = np.linalg.lstsq(flat, model.predict(uv[kept]).ravel(), rcond=None)[0]
    left = model.predict(pixels) - gauge_basis(pixels, INTERIOR) @ share
    expected = np.mean(left**2) + 0.2**2
    assert np.mean(found.evaluate(pixels).sd ** 2) == pytest.approx(expected, rel=1e-6)
    exact = replace(reference, series=replace(reference.series, sd=np.zeros((SD_GRID, SD_GRID))))
    certain = create_model('knn', 12, uv, np.zeros_like(uv), noise_px=0.3, bias_px=0.1)
    assert errors_by(certain, exact, monkeypatch, uv).bias_px == 0
