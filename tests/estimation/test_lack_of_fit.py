# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Lack of fit of a series from its residuals, and rejected points that are no false matches."""

import numpy as np
import pytest
from scipy.stats import truncnorm

from fluoro_calib_ros.correction.calibration_record import SD_GRID
from fluoro_calib_ros.correction.series import Functions, Series
from fluoro_calib_ros.estimation.lack_of_fit import (
    MIN_TARGETS,
    FittedPoints,
    LeftOut,
    _Products,
    _products,
    _variance_beyond,
    areas_of_rejected,
    sd_with_lack_of_fit,
)

SIZE = (800, 600)
NOISE = 0.25


def flat_series(sd):
    return Series(Functions(SIZE, 1), np.zeros((2, 3)), np.full((SD_GRID, SD_GRID), sd))


def image_points(count=2400, seed=1):
    """Image points of twelve exposures, and a generator."""
    rng = np.random.default_rng(seed)
    return rng.uniform(0, 1, (count, 2)) * SIZE, np.arange(count) % 12, rng


def test_products_are_those_with_neighbours_of_other_exposures():
    """Products are per coordinate: half of the sum over both coordinates."""
    uv, exposure, rng = image_points(60)
    exposure = exposure // 6
    r = rng.normal(size=(60, 2))
    redundancy = rng.uniform(0.2, 0.9, 60)
    found = _products(FittedPoints(uv, r, exposure, redundancy))
    rows = []
    for i in range(60):
        near = np.argsort(np.linalg.norm(uv - uv[i], axis=1))[1:6]
        near = near[exposure[near] != exposure[i]]
        if len(near):
            far = np.linalg.norm(uv[near] - uv[i], axis=1).mean()
            rows.append(
                (np.mean(r[near] @ r[i]) / 2, np.mean(redundancy[near]) * redundancy[i], far)
            )
    value, shown, distance = np.transpose(rows)
    np.testing.assert_allclose(found.value, value)
    np.testing.assert_allclose(found.shown, shown)
    np.testing.assert_allclose(found.distance, distance)


def test_mean_product_is_as_uncertain_as_exposures_scatter():
    """Exposures are weighted by their number of image points."""
    value = np.array([1.0, 2.0, 3.0, 6.0, 4.0, 5.0])
    exposure = np.array([7, 7, 7, 2, 2, 9])
    products = _Products(np.zeros((6, 2)), value, value, exposure, value, 1.0)
    mean, error = products.mean_of_all()
    assert mean == pytest.approx(value.mean())
    means = np.array([2.0, 5.0, 5.0])
    variance = np.average((means - 3.5) ** 2, weights=[3, 2, 1]) / 2
    assert error == pytest.approx(np.sqrt(variance))
    assert not products.is_significant()
    two = _Products(np.zeros((6, 2)), value, value, exposure // 5, value, 1.0)
    assert two.mean_of_all() == (0.0, np.inf) and not two.is_significant()
    alike = _Products(np.zeros((6, 2)), 1 + 1e-3 * value, value, exposure, value, 1.0)
    assert alike.is_significant()


def products_with(mean, error, part=0.6, distance=20.0):
    """Products of three exposures with a given mean and its standard error."""
    spread = np.array([-1.0, 0.0, 1.0]) * error * np.sqrt(3)
    value = np.repeat(mean + spread, 50)
    return _Products(
        np.tile([400.0, 300.0], (150, 1)),
        value,
        np.full(150, part),
        np.repeat([0, 1, 2], 50),
        np.full(150, distance),
        1.0,
    )


@pytest.mark.parametrize('mean', [-0.02, 0.0, 0.004, 0.02])
@pytest.mark.parametrize('sd', [0.0, 0.1])
def test_variance_beyond_a_series_is_the_mean_of_a_truncated_gaussian(mean, sd):
    """An exponential prior shifts a Gaussian; the variance is positive."""
    error, part, correlation, expected = 0.006, 0.6, 0.7, 0.05
    products = products_with(mean, error, part)
    found = _variance_beyond(
        products, flat_series(sd), expected, lambda distance: np.full(len(distance), correlation)
    )
    of_variance = error / (part * correlation)
    middle = (mean / part + sd**2) / correlation - of_variance**2 / expected
    posterior = truncnorm(-middle / of_variance, np.inf, middle, of_variance)
    assert found == pytest.approx(min(posterior.mean(), expected), rel=1e-6)


def test_variance_beyond_a_series_far_below_zero_is_that_of_the_tail():
    found = [
        _variance_beyond(products_with(m, 1e-3), flat_series(0.0), 0.04, np.ones_like)
        for m in (-0.05, -0.1)
    ]
    assert found[0] == pytest.approx((1e-3 / 0.6) ** 2 / (0.05 / 0.6 + 7e-5), rel=0.02)
    assert found[0] == pytest.approx(2 * found[1], rel=0.02)


def test_products_that_show_nothing_leave_what_is_expected():
    def beyond(products, correlation=1.0):
        return _variance_beyond(
            products, flat_series(0.0), 0.09, lambda distance: np.full(len(distance), correlation)
        )

    assert beyond(products_with(0.0, 1e-3), 0.04) == pytest.approx(0.09)
    assert beyond(products_with(0.0, 1e-3), 0.06) < 0.03
    assert beyond(products_with(0.0, 0.0)) == pytest.approx(0.09)


def test_what_is_left_out_in_places_is_scaled_by_what_these_show():
    """Bumps where half of the expected variance is present, and nothing elsewhere."""
    uv, exposure, rng = image_points()
    middle = np.array([300.0, 250.0])

    def variance(at):
        return 0.3 * np.exp(-np.sum((at - middle) ** 2, axis=1) / 60.0**2)

    common = np.sqrt(0.5 * variance(uv))[:, None] * np.sign(np.sin(uv / 60))
    residuals = common + rng.normal(0, 0.05, uv.shape)
    left_out = (LeftOut(variance, np.ones_like),)
    found = sd_with_lack_of_fit(FittedPoints(uv, residuals, exposure), flat_series(0.01), left_out)
    row, column = round(250 / 600 * (SD_GRID - 1)), round(300 / 800 * (SD_GRID - 1))
    assert found[row, column] ** 2 == pytest.approx(0.15, rel=0.35)
    quiet = rng.normal(0, 0.05, uv.shape)
    nothing = sd_with_lack_of_fit(FittedPoints(uv, quiet, exposure), flat_series(0.01), left_out)
    assert nothing[row, column] < 0.06
    none = LeftOut(lambda at: np.zeros(len(at)), np.ones_like)
    same = sd_with_lack_of_fit(FittedPoints(uv, quiet, exposure), flat_series(0.01), [none])
    np.testing.assert_allclose(same, 0.01)
    # Without image points, the expected variance stays.
    away = np.linalg.norm(uv - middle, axis=1) > 320
    there = FittedPoints(uv[away], quiet[away], exposure[away])
    elsewhere = LeftOut(lambda at: variance(at) * (len(at) == SD_GRID**2), np.ones_like)
    kept = sd_with_lack_of_fit(there, flat_series(0.01), [elsewhere])
    assert kept[row, column] ** 2 == pytest.approx(0.3, rel=0.1)


def test_few_image_points_leave_a_series_what_it_claims():
    uv, exposure, _ = image_points(100)
    few = FittedPoints(uv, np.ones_like(uv), exposure)
    np.testing.assert_allclose(sd_with_lack_of_fit(few, flat_series(0.3)), 0.3)
    everywhere = LeftOut(lambda at: np.full(len(at), 0.16), np.ones_like)
    found = sd_with_lack_of_fit(few, flat_series(0.3), [everywhere])
    np.testing.assert_allclose(found, 0.5)


# ---- rejected image points


def rejected_points(count, place=None, seed=2):
    """Rejected image points (n,) of different targets, all over the image or around a place."""
    rng = np.random.default_rng(seed)
    uv = (
        rng.uniform(0, 1, (count, 2)) * SIZE
        if place is None
        else rng.normal(place, 15.0, (count, 2))
    )
    angle = rng.uniform(0, 2 * np.pi, count)
    residuals = 4.0 * np.column_stack([np.cos(angle), np.sin(angle)])
    return FittedPoints(uv, residuals, rng.integers(0, 9, count)), rng


def exceeding(points, target, inliers):
    found = areas_of_rejected(points, target, inliers, SIZE)
    return found, [area for area in found if area.size_px > area.limit_px]


def test_false_matches_exceed_the_limit_in_hardly_any_area():
    alarms = 0
    for seed in range(16):
        points, rng = rejected_points(300, seed=seed)
        inliers = rng.uniform(0, 1, (3000, 2)) * SIZE
        alarms += bool(exceeding(points, np.arange(300), inliers)[1])
    assert alarms <= 1  # the expected rate is one in 500


def test_rejected_points_of_one_place_agree():
    points, rng = rejected_points(24, (260.0, 200.0))
    inliers = rng.uniform(0, 1, (3000, 2)) * SIZE
    common = FittedPoints(points.uv, np.tile([3.0, -2.0], (24, 1)), points.exposure)
    found, wrong = exceeding(common, np.arange(24), inliers)
    assert len(wrong) == len(found) >= 1
    best = max(wrong, key=lambda area: len(area.rows))
    assert best.size_px == pytest.approx(np.hypot(3.0, 2.0))
    assert len(best.rows) > 16
    # Opposite residuals, or those of only two exposures, do not agree.
    opposite = common.residuals * np.where(np.arange(24) % 2, 1.0, -1.0)[:, None]
    assert not exceeding(
        FittedPoints(points.uv, opposite, points.exposure), np.arange(24), inliers
    )[1]
    two = FittedPoints(points.uv, common.residuals, points.exposure % 2)
    assert not exceeding(two, np.arange(24), inliers)[1]
    three = FittedPoints(points.uv, common.residuals, points.exposure % 3)
    assert exceeding(three, np.arange(24), inliers)[1]


def test_image_points_of_one_target_count_once():
    """The surveyed coordinates of a single target may be wrong."""
    points, rng = rejected_points(24, (260.0, 200.0))
    inliers = rng.uniform(0, 1, (3000, 2)) * SIZE
    common = np.tile([3.0, -2.0], (24, 1))
    seen = FittedPoints(points.uv, common, points.exposure)
    assert not areas_of_rejected(seen, np.arange(24) % (MIN_TARGETS - 1), inliers, SIZE)
    assert areas_of_rejected(seen, np.arange(24) % MIN_TARGETS, inliers, SIZE)
    # Seven points of one target do not outweigh six of others.
    weighted = np.where(np.arange(24)[:, None] < 18, 4.0, -1.0) * np.array([[1.0, 0.0]])
    target = np.where(np.arange(24) < 18, 0, np.arange(24))
    alone = FittedPoints(
        np.tile([260.0, 200.0], (24, 1)), weighted, np.maximum(np.arange(24) - 17, 0)
    )
    area = max(areas_of_rejected(alone, target, inliers, SIZE), key=lambda one: len(one.rows))
    assert len(area.rows) == 24
    assert area.size_px == pytest.approx(abs(4.0 - 6.0) / 7)
    limit = area.limit_px / (np.sqrt(4.0**2 + 6.0) / 7)
    count = len(areas_of_rejected(alone, target, inliers, SIZE))
    assert limit == pytest.approx(np.sqrt(np.log(count / 0.05)), rel=1e-6)


def test_areas_overlap_by_half_and_cover_the_image():
    """A cluster lies in up to four areas, at a corner of the image in one."""
    for place, count in (((260.0, 200.0), 4), ((2.0, 2.0), 1), ((2.0, 200.0), 2)):
        uv = np.tile(place, (8, 1)) + np.random.default_rng(3).uniform(0, 1, (8, 2))
        points = FittedPoints(uv, np.ones((8, 2)), np.arange(8))
        assert len(areas_of_rejected(points, np.arange(8), np.zeros((0, 2)), SIZE)) == count


def test_a_cluster_of_rejected_points_needs_less_to_agree():
    """If more points are rejected than by chance, the limit is that of one case in 20."""
    rng = np.random.default_rng(4)
    uv = np.concatenate(
        [rng.uniform(0, 1, (200, 2)) * SIZE, rng.normal((260.0, 200.0), 8.0, (24, 2))]
    )
    points = FittedPoints(uv, rng.normal(size=(224, 2)), rng.integers(0, 9, 224))
    beside = rng.uniform(0, 1, (2000, 2)) * SIZE
    crowd = np.concatenate([beside, rng.normal((260.0, 200.0), 15.0, (1200, 2))])
    limits = []
    for inliers in (beside, crowd):
        found = areas_of_rejected(points, np.arange(224), inliers, SIZE)
        own = [area for area in found if np.count_nonzero(area.rows >= 200) == 24]
        limits.append((len(found), max(own, key=lambda area: len(area.rows)).limit_px))
    (count, clustered), (same, plain) = limits
    assert count == same
    expected = np.sqrt(np.log(count / 0.05) / np.log(count / 2e-3))
    assert clustered / plain == pytest.approx(expected, rel=1e-6)


def few_at_a_corner(angles, exposure):
    """Test rejected points with these residual directions among inliers nearby and elsewhere."""
    rng = np.random.default_rng(6)
    uv = rng.uniform(0, 12, (len(angles), 2))
    residuals = 1.3 * np.column_stack([np.cos(angles), np.sin(angles)])
    beside = rng.uniform(0, 30, (6, 2))
    inliers = np.concatenate([beside, rng.uniform(0.2, 1, (1000, 2)) * SIZE])
    return exceeding(
        FittedPoints(uv, residuals, np.array(exposure)), np.arange(len(angles)), inliers
    )


def test_three_rejected_points_that_agree_are_enough_where_hardly_any_others_are():
    """At a border that few exposures show, a dent causes few rejected image points."""
    found, wrong = few_at_a_corner([0.7, 0.75, 0.72], [0, 0, 1])
    assert len(found) == len(wrong) == 1 and len(wrong[0].rows) == 3
    assert wrong[0].size_px == pytest.approx(1.3, rel=1e-3)
    # Points of a single exposure, and only two points, show nothing.
    assert not few_at_a_corner([0.7, 0.75, 0.72], [0, 0, 0])[1]
    assert not few_at_a_corner([0.7, 0.75], [0, 1])[0]
    # Random directions exceed the limit in one of 20 cases.
    rng = np.random.default_rng(7)
    alarms = sum(
        bool(few_at_a_corner(rng.uniform(0, 2 * np.pi, 3), [0, 1, 2])[1]) for _ in range(200)
    )
    assert 2 <= alarms <= 19


def test_few_rejected_points_among_many_inliers_are_not_looked_at():
    rng = np.random.default_rng(8)
    uv = rng.uniform(0, 12, (3, 2))
    points = FittedPoints(uv, np.ones((3, 2)), np.arange(3))
    crowd = rng.uniform(0, 60, (2000, 2))
    assert not areas_of_rejected(points, np.arange(3), crowd, SIZE)
