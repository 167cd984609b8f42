# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0
"""Refinements of a collocation: when they are tried, and what they propose."""

from types import SimpleNamespace

import numpy as np
import pytest

from fluoro_calib_ros.correction.series import Functions
from fluoro_calib_ros.estimation import fluoroscope_terms
from fluoro_calib_ros.estimation.estimator import GaugeKind, gauge_basis
from fluoro_calib_ros.estimation.exposure_terms import exposure_functions
from fluoro_calib_ros.estimation.lack_of_fit import FittedPoints
from fluoro_calib_ros.estimation.priors import Prior, SeriesEquations
from fluoro_calib_ros.estimation.refinements import (
    MAX_MODES,
    MODE_CHANGES,
    START_MODES,
    NumberOfSines,
    Once,
    Solution,
    exposure_terms,
)
from fluoro_calib_ros.estimation.signal import Signal

SIZE = (1024, 1024)


def solution(reach=300.0, is_steady=True, level=1e2, own=None):
    """A solution with 16 sines along the image, for a field with correlation length reach [px]."""
    functions = Functions(SIZE, 3, 16)
    prior = Prior(Signal(0.5, reach), np.zeros(14))
    part = SimpleNamespace(number=0, functions=functions, prior=prior, own=own)
    information = level * np.eye(2 * len(functions))
    equations = SeriesEquations(
        functions, information, np.zeros(len(information)), 0 * information
    )
    return Solution([part], None, [equations], is_steady)


def test_as_many_sines_as_the_image_points_can_tell():
    """A shorter correlation length and more image points require more sines."""
    long, short = (NumberOfSines().propose(solution(reach))[0].modes for reach in (400.0, 150.0))
    assert long < short <= MAX_MODES
    more = NumberOfSines().propose(solution(400.0, level=1e4))[0].modes
    assert long < more


def test_the_number_of_sines_changes_a_few_times_and_anew_where_exposures_differ():
    """A difference between exposures may have been mistaken for a short signal."""
    refinement = NumberOfSines()
    found = [refinement.propose(solution(100.0)) for _ in range(MODE_CHANGES + 1)]
    assert [bool(change) for change in found] == [True] * MODE_CHANGES + [False]
    assert refinement.propose(solution(100.0, own=object()))


def test_few_sines_less_are_not_worth_a_change():
    """The first number of sines is only an initial value, though."""
    reaches = np.arange(100.0, 900.0, 10.0)
    first = {reach: NumberOfSines().propose(solution(reach)) for reach in reaches}
    fewer = [reach for reach, change in first.items() if change and 12 <= change[0].modes < 16]
    assert fewer
    for reach in fewer:
        assert NumberOfSines(changes=1).propose(solution(reach)) == {}


def test_a_change_is_looked_for_once_at_steady_priors():
    """The search is not repeated, whether it finds a change or not."""
    for found in ({}, {0: 'change'}):
        tried = []

        def search(there, found=found, tried=tried):
            tried.append(there)
            return found

        once = Once(search)
        assert once.propose(solution(is_steady=False)) == {}
        assert not tried
        assert once.propose(solution()) == found
        assert once.propose(solution()) == {}
        assert len(tried) == 1


@pytest.mark.parametrize('left, local, searched', [(0, 'a', 0), (4, None, 0), (4, 'a', 1)])
def test_places_are_searched_only_next_to_others_and_a_few_times(
    monkeypatch, left, local, searched
):
    """A given prior was refined when it was estimated."""
    tried = []
    given = SimpleNamespace(local=local, change=lambda last, functions: 0.2)
    monkeypatch.setattr(fluoroscope_terms, 'most_likely_prior', lambda equations, last: given)
    monkeypatch.setattr(
        fluoroscope_terms, 'with_more_places', lambda *found: tried.append(found) or given
    )
    part = SimpleNamespace(
        prior=given,
        place_searches=left,
        values=None,
        _gauge_conditions=lambda values: 'gauge',
        functions=SimpleNamespace(modes=4),
    )
    assert fluoroscope_terms.FluoroscopeTerms.renew_prior(part, 'equations')
    assert len(tried) == searched and part.place_searches == left - searched
    assert part.prior is given and part._gauge_rows == 'gauge'


@pytest.mark.parametrize('change, terms', [(None, 0), (2, 14), (4, 36)])
def test_exposures_get_terms_of_their_own_only_where_they_differ(change, terms):
    """A change of degree 2 needs cubic terms; one of degree 4 needs more."""
    rng = np.random.default_rng(4)
    uv = rng.uniform(0, 1024, (600, 2))
    exposure = np.repeat(np.arange(6), 100)
    interior = np.array([511.5, 511.5, 4000.0])
    residuals = rng.normal(0, 0.1, uv.shape)
    for own in np.arange(600).reshape(6, 100):  # orientations and beads absorb a part
        q, _ = np.linalg.qr(exposure_functions(uv, (1024, 1024), interior)[own].reshape(200, -1))
        residuals[own] -= (0.5 * q @ (q.T @ residuals[own].ravel())).reshape(-1, 2)
    if terms:  # a stretch along the diagonal that changes from exposure to exposure
        xy = (uv - 511.5) / 512
        field = np.column_stack([xy[:, 1] ** change, xy[:, 0] ** change]).ravel()
        gauge = gauge_basis(uv, interior).reshape(len(field), -1)
        field -= gauge @ np.linalg.lstsq(gauge, field, rcond=None)[0]
        residuals += field.reshape(-1, 2) * np.linspace(-2, 2, 6)[exposure, None]
    part = SimpleNamespace(
        number=0,
        uv=uv,
        image_size=(1024, 1024),
        interior=interior,
        rows=np.arange(len(uv)),
        exposure=exposure,
        angles=np.full(6, np.nan),
        gauge_kind=GaugeKind.FULL,
        functions=SimpleNamespace(complete=40),
        inliers=lambda adjustment: FittedPoints(uv, residuals, exposure),
    )
    found = exposure_terms(SimpleNamespace(parts=[part], adjustment=None))
    assert bool(found) == bool(terms)
    if terms:
        assert found[0].own.count == 6 * terms
        assert set(found) == {0} and found[0].modes == START_MODES
        assert found[0].own.size_px > 0.3
