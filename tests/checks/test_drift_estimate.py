# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Drift estimated from the newest blocks: weighted means, in closed form."""

from types import SimpleNamespace

import numpy as np
import pytest

from fluoro_calib_ros.checks.drift_evidence import EpipolarEvidence
from fluoro_calib_ros.checks.pair_watch import PairBlock

AREAS = 3
BEGIN, COUNT = 4, 10  # first block with the drift, and number of blocks
RNG = np.random.default_rng(5)
INFORMATION = RNG.uniform(50, 150, (COUNT, 4, AREAS))
SYSTEMATIC = RNG.uniform(0.01, 0.05, (COUNT, 4, AREAS))


def estimate(series, area, size, factor=1.0, both=False):
    """Estimate a drift in one series of the pair a, b; both: in the series of a and b alike."""
    shape = (2, 4, AREAS)
    likelihood = np.zeros(shape)
    likelihood[0, series, area] = 100.0
    charts = SimpleNamespace(
        evidence=likelihood,
        log_likelihood=likelihood.copy,
        begin=np.zeros(shape, dtype=int),
        variance_factor=lambda: np.full((4, AREAS), factor),
        update=lambda *_: None,
    )
    found = EpipolarEvidence(charts, ('a', 'b'), COUNT)
    for block in range(COUNT):
        score = np.zeros((4, AREAS))
        if block >= BEGIN:
            for one in {series, series ^ 1} if both else {series}:
                score[one, area] = size * INFORMATION[block, one, area]
        normals = np.zeros((2, AREAS, 2))
        normals[series % 2, area] = [3.0, -4.0]
        enough = np.ones((4, AREAS), bool)
        added = PairBlock(score, INFORMATION[block], SYSTEMATIC[block], enough, normals)
        found.update(block * 10**9, added, None, None)
    return found.estimate(10.0)


@pytest.mark.parametrize('series, name, against', [(0, 'a', 'calibration'), (3, 'b', 'start')])
@pytest.mark.parametrize('factor', [1.0, 4.0])
def test_size_and_sd_are_those_of_the_weighted_mean(series, name, against, factor):
    found = estimate(series, 2, -0.3, factor)
    weight = INFORMATION[BEGIN:, series, 2]
    assert found.size == pytest.approx(-0.3)
    systematic = np.average(SYSTEMATIC[BEGIN:, series, 2], weights=weight)
    assert found.sd == pytest.approx(np.hypot(np.sqrt(factor / weight.sum()), systematic))
    assert found.fluoroscopes == (name,) and found.area == 2 and found.against == against
    assert found.begin_ns == BEGIN * 10**9 and found.confirmed
    assert found.direction == pytest.approx([0.6, -0.8])


def test_fluoroscopes_that_are_about_as_likely_are_both_named():
    assert set(estimate(2, 1, 0.2, both=True).fluoroscopes) == {'a', 'b'}
