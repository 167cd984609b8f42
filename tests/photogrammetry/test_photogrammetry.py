# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Rotations, collinearity, resection, noise models and the checks of frames and phantoms."""

from dataclasses import replace

import numpy as np
import pytest
import rigs
from scipy import integrate, optimize, stats
from scipy.spatial.transform import Rotation

from fluoro_calib_ros.errors import DataError
from fluoro_calib_ros.exposures.frame import Frame, points_on_image, validate_frame
from fluoro_calib_ros.exposures.phantom import Phantom
from fluoro_calib_ros.photogrammetry.collinearity import project, project_with_jacobian, to_sensor
from fluoro_calib_ros.photogrammetry.noise import HUBER_DELTA, INLIER_Q, LOSSES, NU_RANGE, Noise
from fluoro_calib_ros.photogrammetry.resection import (
    decompose,
    direct_linear_transformation,
    principal_distance_of,
    resect,
    robust_dlt,
)
from fluoro_calib_ros.photogrammetry.rotations import (
    cross_matrix,
    matrix_from_quaternion,
    matrix_from_vector,
    quaternion_from_matrix,
    rotation_angle,
)

ANGLES = [0.0, 1e-15, 1e-9, 1e-5, 0.3, np.pi / 2, 3.0, np.pi - 1e-5, np.pi - 1e-9, np.pi]


def some_axes():
    """Unit vectors: the six coordinate axes, and others."""
    rng = np.random.default_rng(1)
    other = rng.normal(size=(40, 3))
    return np.concatenate(
        [np.eye(3), -np.eye(3), other / np.linalg.norm(other, axis=1, keepdims=True)]
    )


# ---- rotations


@pytest.mark.parametrize('angle', ANGLES)
def test_rotation_matrices_of_vectors_and_quaternions_equal_scipy(angle):
    vectors = angle * some_axes()
    theirs = Rotation.from_rotvec(vectors)
    np.testing.assert_allclose(matrix_from_vector(vectors), theirs.as_matrix(), rtol=0, atol=1e-14)
    quaternions = theirs.as_quat()[:, [3, 0, 1, 2]]
    np.testing.assert_allclose(
        matrix_from_quaternion(quaternions), theirs.as_matrix(), rtol=0, atol=1e-14
    )


@pytest.mark.parametrize('angle', ANGLES)
def test_quaternion_of_a_matrix_round_trips_at_every_angle(angle):
    """The quaternion has unit norm and w >= 0, and reproduces the matrix."""
    matrix = Rotation.from_rotvec(angle * some_axes()).as_matrix()
    q = quaternion_from_matrix(matrix)
    np.testing.assert_allclose(np.linalg.norm(q, axis=1), 1, rtol=1e-14)
    assert (q[:, 0] >= 0).all()
    np.testing.assert_allclose(matrix_from_quaternion(q), matrix, rtol=0, atol=1e-14)
    theirs = Rotation.from_matrix(matrix).as_quat()[:, [3, 0, 1, 2]]
    np.testing.assert_allclose(np.abs(np.sum(q * theirs, axis=1)), 1, rtol=1e-14)


@pytest.mark.parametrize('angle', ANGLES)
def test_rotation_angle_is_exact_near_zero_and_pi(angle):
    found = rotation_angle(Rotation.from_rotvec(angle * some_axes()).as_matrix())
    np.testing.assert_allclose(found, angle, rtol=1e-13, atol=5e-16)


def test_rotation_vectors_keep_small_turns_to_the_last_digit():
    w = np.array([3e-9, -4e-9, 1e-9])
    np.testing.assert_allclose(
        matrix_from_vector(w) - np.eye(3), cross_matrix(w), rtol=0, atol=2e-17
    )


def test_quaternions_are_normalised_and_follow_the_convention():
    """Order w, x, y, z: a quarter turn about z takes x to y, for a quaternion of any norm."""
    np.testing.assert_allclose(
        matrix_from_quaternion([3.0, 0, 0, 3.0]) @ [1, 0, 0], [0, 1, 0], atol=1e-15
    )
    np.testing.assert_allclose(cross_matrix([1.0, 0, 0]) @ [0, 1, 0], [0, 0, 1])


# ---- collinearity


def test_image_coordinates_follow_the_convention():
    """The axis meets the image in (xp, yp); u grows to the right (x), v downwards (y), both as c
    X/Z.
    """
    interior = np.array([500.0, 520.0, 4000.0])
    points = np.array(
        [[0.0, 0, 1000], [10, 0, 1000], [0, 10, 1000], [10, -20, 2000], [0, 0, -1000]]
    )
    uv = project(np.tile(np.eye(3), (5, 1, 1)), np.zeros((5, 3)), points, interior)
    np.testing.assert_allclose(
        uv[:4], [[500, 520], [540, 520], [500, 560], [520, 480]], rtol=1e-14
    )
    assert np.isnan(uv[4]).all(), 'a point behind the source has no image'


def test_source_and_rotation_are_relative_to_the_phantom():
    """X = R (P - T): the source itself is the origin of the sensor frame."""
    rotation = matrix_from_vector([0.1, 0.5, -0.3])
    np.testing.assert_allclose(
        to_sensor(rotation[None], np.array([[1.0, 2, 3]]), np.array([[1.0, 2, 3]])), 0
    )
    np.testing.assert_allclose(
        to_sensor(rotation[None], np.array([[1.0, 2, 3]]), np.array([[2.0, 2, 3]]))[0],
        rotation[:, 0],
    )


def test_analytic_derivatives_equal_central_differences():
    network, truth = rigs.small_network(exposures=3, targets=20, fluoroscopes=2)
    rotation, position, points, interior = network.per_image_point(truth)
    uv, d_exterior, d_point, d_interior = project_with_jacobian(
        rotation, position, points, interior
    )
    np.testing.assert_allclose(uv, project(rotation, position, points, interior), rtol=1e-14)

    def differences(image, h):
        return np.stack([(image(h * e) - image(-h * e)) / (2 * h) for e in np.eye(3)], axis=2)

    numeric = {
        'source': (
            d_exterior[:, :, :3],
            differences(lambda d: project(rotation, position + d, points, interior), 1e-2),
        ),
        'turn': (
            d_exterior[:, :, 3:],
            differences(
                lambda d: project(matrix_from_vector(d) @ rotation, position, points, interior),
                1e-5,
            ),
        ),
        'point': (
            d_point,
            differences(lambda d: project(rotation, position, points + d, interior), 1e-2),
        ),
        'interior': (
            d_interior,
            differences(lambda d: project(rotation, position, points, interior + d), 1e-1),
        ),
    }
    for name, (analytic, other) in numeric.items():
        assert np.max(np.abs(analytic - other)) < 1e-7 * np.max(np.abs(other)), name


# ---- resection


def one_exposure(seed=0, targets=60):
    """Object points, their exact image points, and the exterior and interior orientation behind
    them.
    """
    network, truth = rigs.small_network(exposures=1, targets=targets, seed=seed, seen=1.0)
    return (
        truth.points_mm,
        project(*network.per_image_point(truth)),
        truth.rotation[0],
        truth.position_mm[0],
        truth.interior[0],
    )


def test_a_projection_that_is_computed_once_belongs_to_each_who_asks():
    xyz, uv, *_ = one_exposure(0, targets=8)
    first = robust_dlt(xyz, uv)
    before = first.copy()
    first *= 2
    np.testing.assert_array_equal(robust_dlt(xyz, uv), before)
    assert not np.array_equal(robust_dlt(xyz, uv + 1), before)


@pytest.mark.parametrize('seed', range(5))
def test_resection_of_exact_data_is_exact(seed):
    """From the minimum number of targets, in any attitude."""
    xyz, uv, rotation, position, interior = one_exposure(seed, targets=8)
    assert principal_distance_of(robust_dlt(xyz, uv)) == pytest.approx(interior[2], rel=1e-6)
    found = resect(xyz, uv, interior)
    np.testing.assert_allclose(found.rotation, rotation, rtol=0, atol=1e-8)
    np.testing.assert_allclose(found.position_mm, position, rtol=0, atol=1e-5)
    assert found.inliers.all()


def test_projection_matrix_is_decomposed_into_its_parts():
    """decompose: calibration matrix with positive diagonal, rotation and source, whatever the sign
    of the matrix.
    """
    _, _, rotation, position, (xp, yp, c) = one_exposure()
    k = np.array([[c, 0, xp], [0, c, yp], [0, 0, 1]])
    projection = k @ rotation @ np.column_stack([np.eye(3), -position])
    for factor in (1.0, -3.0):
        parts = decompose(factor * projection)
        for got, wanted in zip(parts, (k, rotation, position)):
            np.testing.assert_allclose(got, wanted, rtol=1e-9, atol=1e-9)


def test_direct_linear_transformation_uses_its_weights():
    """Points of zero weight have no influence."""
    xyz, uv, *_ = one_exposure()
    spoilt = uv.copy()
    weights = np.ones(len(uv))
    spoilt[::4] += 200
    weights[::4] = 0
    p = direct_linear_transformation(xyz, spoilt)(weights)
    image = xyz @ p[:, :3].T + p[:, 3]
    np.testing.assert_allclose(image[:, :2] / image[:, 2:], uv, atol=1e-6)


@pytest.mark.parametrize('seed', range(4))
def test_resection_is_robust_to_false_matches_and_distortion(seed):
    """A fifth of the targets have wrong ids; the image is distorted by 10 px and noisy."""
    xyz, uv, rotation, position, interior = one_exposure(seed, targets=100)
    rng = np.random.default_rng(seed)
    x = (uv - 511.5) / 512
    uv = uv + 10 * np.sum(x * x, axis=1, keepdims=True) * x + rng.normal(0, 0.3, uv.shape)
    false = rng.permutation(100)[:20]
    uv[false] = uv[np.roll(false, 1)]
    assert principal_distance_of(robust_dlt(xyz, uv)) == pytest.approx(interior[2], rel=0.04)
    found = resect(xyz, uv, interior)
    assert rotation_angle(found.rotation @ rotation.T) < np.deg2rad(0.3)
    assert (
        np.linalg.norm(found.position_mm - position) < 15
    )  # of 1500 mm, the effect of the distortion
    assert found.scale < 3
    moved_far = (
        np.linalg.norm(
            uv[false]
            - project(
                np.tile(rotation, (20, 1, 1)), np.tile(position, (20, 1)), xyz[false], interior
            ),
            axis=1,
        )
        > 40
    )
    assert moved_far.sum() > 10 and not found.inliers[false[moved_far]].any()
    true = np.setdiff1d(np.arange(100), false)
    assert found.inliers[true].mean() > 0.9


@pytest.mark.parametrize(
    'spoil, message',
    [
        (lambda xyz: xyz[:7], '7 targets are too few for a resection, 8 are needed'),
        (lambda xyz: xyz * (1, 1, 0), 'all targets are coplanar'),
        (
            lambda xyz: xyz @ np.diag([1, 1, 1e-4]) @ matrix_from_vector([1.0, 2, 3]),
            'all targets are coplanar',
        ),
    ],
)
def test_resection_rejects_too_few_and_planar_targets(spoil, message):
    xyz, uv, _, _, interior = one_exposure()
    xyz = spoil(xyz)
    with pytest.raises(DataError, match=message):
        resect(xyz, uv[: len(xyz)], interior)


# ---- noise


def bivariate_t(rng, n, nu, scale):
    return scale * rng.normal(size=(n, 2)) / np.sqrt(rng.chisquare(nu, (n, 1)) / nu)


def test_cost_is_the_negative_log_likelihood_of_scipy():
    """Including all constants, with one sigma for each image point."""
    rng = np.random.default_rng(2)
    r = rng.normal(0, 2, (50, 2))
    sigma = rng.uniform(0.2, 3, 50)
    scale = 0.7
    q = np.sum(r * r, axis=1) / (scale * sigma) ** 2
    shape = [np.eye(2) * (scale * s) ** 2 for s in sigma]
    theirs = -sum(stats.multivariate_t(np.zeros(2), s, df=4.3).logpdf(x) for x, s in zip(r, shape))
    assert Noise('student_t', scale, 4.3).cost(q, sigma) == pytest.approx(theirs, rel=1e-12)
    theirs = -sum(stats.multivariate_normal(np.zeros(2), s).logpdf(x) for x, s in zip(r, shape))
    assert Noise('gaussian', scale).cost(q, sigma) == pytest.approx(theirs, rel=1e-12)


@pytest.mark.parametrize('loss', LOSSES)
def test_density_of_every_loss_integrates_to_one(loss):
    noise = Noise(loss, 0.6, 4.0)
    sigma = np.array([1.7])
    unit = noise.scale * sigma[0]  # unit of the radius r [px]
    inside, _ = integrate.quad(
        lambda r: 2 * np.pi * r * np.exp(-noise.cost(np.array([(r / unit) ** 2]), sigma)),
        0,
        np.inf,
        epsabs=1e-12,
    )
    assert inside == pytest.approx(1, abs=1e-8)


@pytest.mark.parametrize('loss', LOSSES)
def test_weight_is_twice_the_slope_of_the_cost(loss):
    noise = Noise(loss, 1.0, 4.0)
    one = np.ones(1)
    h = 1e-6
    for q in (1e-4, 0.5, HUBER_DELTA**2 - 0.01, HUBER_DELTA**2 + 0.01, 30.0, 1e4):
        slope = (noise.cost(np.array([q + h]), one) - noise.cost(np.array([q - h]), one)) / (2 * h)
        assert noise.weight(np.array([q]))[0] == pytest.approx(2 * slope, rel=1e-4), q


@pytest.mark.parametrize(
    'loss, nu',
    [
        ('student_t', 3.0),
        ('student_t', 10.0),
        ('huber', np.inf),
        ('huber', 3.0),
        ('gaussian', np.inf),
    ],
)
@pytest.mark.long
def test_information_factor_against_monte_carlo(loss, nu):
    """Variance of 1500 location estimates of 100 points is 1 / (factor * sum of weights)."""
    rng = np.random.default_rng(5)
    runs = 1500
    n = 100
    x = rng.normal(size=(runs, n, 2))
    if np.isfinite(nu):
        x /= np.sqrt(rng.chisquare(nu, (runs, n, 1)) / nu)
    noise = Noise(loss, 1.0, nu if np.isfinite(nu) else 5.0)
    place = np.zeros((runs, 1, 2))
    for _ in range(25):
        w = noise.weight(np.sum((x - place) ** 2, axis=2))[..., None]
        place = np.sum(w * x, axis=1, keepdims=True) / np.sum(w, axis=1, keepdims=True)
    q = np.sum((x - place) ** 2, axis=2).ravel()
    expected = 1 / (noise.information_factor(q) * n * np.mean(noise.weight(q)))
    # The variance of 3000 estimates is known to 2.6 %.
    assert np.mean(place**2) == pytest.approx(expected, rel=0.08)


def test_information_factor_of_student_t_follows_from_its_definition():
    """E[w^2 q] / 2 over E[w], where q/2 is F distributed with 2 and nu degrees of freedom."""
    for nu in (3.0, 5.0, 50.0):
        noise = Noise(nu=nu)
        f = stats.f(2, nu)
        score = integrate.quad(lambda x: noise.weight(2 * x) ** 2 * x * f.pdf(x), 0, np.inf)[0]
        weight = integrate.quad(lambda x: noise.weight(2 * x) * f.pdf(x), 0, np.inf)[0]
        assert noise.information_factor(np.zeros(1)) == pytest.approx(score / weight, rel=1e-6)


@pytest.mark.parametrize('nu', [4.0, 12.0])
def test_scale_and_degrees_of_freedom_equal_direct_maximum_likelihood(nu):
    """ECME maximises the likelihood, and 20,000 points reproduce the truth."""
    squared = np.sum(bivariate_t(np.random.default_rng(7), 20_000, nu, 0.3) ** 2, axis=1)
    ones = np.ones(len(squared))

    def cost(x):
        noise = Noise('student_t', np.exp(x[0]), np.exp(x[1]))
        return noise.cost(squared / noise.scale**2, ones)

    best = optimize.minimize(
        cost, np.log([0.5, 6.0]), method='Nelder-Mead', options={'xatol': 1e-6, 'fatol': 1e-6}
    )
    found = Noise('student_t', 1.0, 5.0).estimate_from(squared)
    assert cost(np.log([found.scale, found.nu])) - best.fun < 0.05
    assert found.scale == pytest.approx(np.exp(best.x[0]), rel=2e-3)
    assert found.nu == pytest.approx(np.exp(best.x[1]), rel=2e-2)
    assert found.scale == pytest.approx(0.3, rel=0.02)
    assert found.nu == pytest.approx(nu, rel=0.15)


@pytest.mark.parametrize('loss', LOSSES)
def test_scale_is_estimated_from_residuals_of_unequal_redundancy(loss):
    """Residuals are smaller than the noise by the root of their redundancy numbers. The estimated
    scale is that of the noise.
    """
    rng = np.random.default_rng(8)
    share = rng.choice([0.2, 0.9], 60_000)
    noise = rng.normal(0, 0.25, (len(share), 2))
    found = Noise(loss).estimate_from(share * np.sum(noise**2, axis=1), 2 * (1 - share))
    assert found.scale == pytest.approx(0.25, rel=0.015)
    if loss == 'student_t':
        assert found.nu > 60


@pytest.mark.parametrize('nu', [4.0, 200.0])
def test_estimated_gross_errors_do_not_affect_the_core(nu):
    """One in twenty points is a false match anywhere in the image: scale and degrees of freedom
    are those without them.
    """
    rng = np.random.default_rng(4)
    noise = bivariate_t(rng, 20_000, nu, 0.25)
    squared = np.sum(noise**2, axis=1)
    clean = Noise().estimate_from(squared)
    squared[:1000] = np.sum(rng.uniform(-300, 300, (1000, 2)) ** 2, axis=1)
    found = Noise(gross=0.01).estimate_from(squared)
    assert found.gross == pytest.approx(0.05, abs=0.003)
    assert found.scale == pytest.approx(clean.scale, rel=0.02)
    assert 1 / found.nu == pytest.approx(1 / clean.nu, abs=0.02)
    assert Noise().estimate_from(squared).nu == pytest.approx(NU_RANGE[0], rel=1e-2)
    weight = found.weight(squared / found.scale**2)
    assert weight[:1000].max() < 0.2 and np.median(weight[:1000]) < 1e-6


def test_robust_scale_is_robust_to_false_matches():
    """With a tenth of huge residuals, Student-t and Huber keep the scale within some ten percent,
    Gauss does not.
    """
    rng = np.random.default_rng(9)
    squared = np.sum(rng.normal(0, 0.25, (5000, 2)) ** 2, axis=1)
    squared[:500] = 1e4
    assert Noise('huber').estimate_from(squared).scale == pytest.approx(0.25, rel=0.15)
    assert Noise('student_t').estimate_from(squared).scale == pytest.approx(0.25, rel=0.35)
    assert Noise('gaussian').estimate_from(squared).scale > 10


def test_degrees_of_freedom_stay_within_their_range():
    rng = np.random.default_rng(10)
    gaussian = np.sum(rng.normal(size=(20_000, 2)) ** 2, axis=1)
    assert 60 < Noise().estimate_from(gaussian).nu <= NU_RANGE[1]
    cauchy = np.sum(bivariate_t(rng, 20_000, 1.0, 1.0) ** 2, axis=1)
    assert Noise().estimate_from(cauchy).nu == pytest.approx(NU_RANGE[0], rel=1e-2)
    assert np.isfinite(Noise().estimate_from(np.zeros(100)).scale)


def test_inliers_are_9999_of_10000_gaussian_residuals():
    assert stats.chi2(2).cdf(INLIER_Q) == pytest.approx(0.9999, abs=1e-12)
    assert Noise().inliers(np.array([INLIER_Q * 0.999, INLIER_Q * 1.001])).tolist() == [
        True,
        False,
    ]


@pytest.mark.parametrize('nu, share', [(3.0, 0.025), (6.0, 0.004), (8.0, 0.002), (200.0, 0.001)])
def test_few_true_image_points_are_gross_errors(nu, share):
    """The limit is at most six sigma; heavier tails are not considered plausible."""
    rng = np.random.default_rng(11)
    q = np.sum(bivariate_t(rng, 100_000, nu, 1.0) ** 2, axis=1)
    noise = Noise(nu=nu, gross=0.01)
    assert np.mean(~noise.accepts(q)) < share
    assert np.sqrt(noise.limit) < 6.1
    assert not noise.accepts(np.array([1e4])).any()
    assert noise.limit >= INLIER_Q


def test_unknown_loss_is_rejected():
    with pytest.raises(ValueError, match="student_t, huber, gaussian, not 'cauchy'"):
        Noise('cauchy')


# ---- observations


def some_frame(**changes):
    rng = np.random.default_rng(3)
    values = dict(
        fluoroscope='a',
        number=7,
        target_id=np.array([5, 3, 9, 4]),
        uv=rng.uniform(0, 500, (4, 2)),
        image_size=(640, 480),
        sigma=np.full(4, 0.2),
    )
    return Frame(**{**values, **changes})


def some_phantom():
    return Phantom([9, 3, 4, 5], np.arange(12.0).reshape(4, 3), np.array([0.9, 0.3, 0.4, 0.5]))


@pytest.mark.parametrize(
    'changes, message',
    [
        (
            {'target_id': np.array([], int), 'uv': np.zeros((0, 2)), 'sigma': None},
            'the frame is empty',
        ),
        ({'target_id': np.array([5, 3, 9])}, '3 target ids, but image points of shape'),
        ({'sigma': np.ones(3)}, '4 target ids, but 3 values of sigma'),
        ({'sigma': np.array([1, 1, 0, 1.0])}, 'sigma of target 9 is not a positive number'),
        ({'sigma': np.array([1, np.nan, 1, 1.0])}, 'sigma of target 3 is not a positive number'),
        (
            {'uv': np.array([[1, 1], [2, 2], [3, np.nan], [4, 4.0]])},
            'the image point of target 9 is not a number',
        ),
        (
            {'uv': np.array([[1, 1], [np.inf, 2], [3, 3], [4, 4.0]])},
            'the image point of target 3 is not a number',
        ),
        (
            {'uv': np.array([[1, 1], [2, 2], [3, 3], [639.6, 4]])},
            'target 4 is outside the image of 640 x 480 px',
        ),
        ({'target_id': np.array([5, 3, 5, 4])}, 'target 5 occurs 2 times'),
        ({'target_id': np.array([5, 3, 8, 4])}, 'target 8 is not on the phantom'),
        ({'image_size': (0, 480)}, 'the image size is 0 x 480 px'),
        (
            {'image_size': (640, 481)},
            r'the image is 640 x 481 px, but the calibration is for 640 x 480 px',
        ),
    ],
)
def test_invalid_frame_is_rejected(changes, message):
    """One sentence naming fluoroscope, frame and cause."""
    validate_frame(some_frame(uv=np.full((4, 2), 9.0)), some_phantom(), (640, 480))
    with pytest.raises(DataError, match=f'^fluoroscope a, frame 7: .*{message}'):
        validate_frame(some_frame(**changes), some_phantom(), (640, 480))


def test_image_extends_half_a_pixel_beyond_its_outer_pixel_centres():
    uv = np.array(
        [
            [-0.5, -0.5],
            [639.5, 479.5],
            [-0.51, 0],
            [639.51, 0],
            [0, -0.51],
            [0, 479.51],
            [np.nan, 5],
        ]
    )
    assert points_on_image(uv, (640, 480)).tolist() == [True, True] + [False] * 5


def test_phantom_is_sorted_and_looked_up_by_id():
    phantom = some_phantom()
    assert phantom.target_id.tolist() == [3, 4, 5, 9]
    np.testing.assert_array_equal(phantom.sd_mm, [0.3, 0.4, 0.5, 0.9])
    np.testing.assert_array_equal(phantom.xyz_mm[3], [0, 1, 2])
    assert phantom.index([9, 3, 6, 100, 0]).tolist() == [3, 0, -1, -1, -1]
    with pytest.raises(ValueError):
        phantom.xyz_mm[0, 0] = 1.0


@pytest.mark.parametrize(
    'changes, message',
    [
        ({'target_id': [1, 2, 3, 1]}, 'target 1 is given twice'),
        ({'target_id': [1, 2, 3]}, '3 target ids, but coordinates of shape'),
        (
            {'xyz_mm': np.where(np.arange(12).reshape(4, 3) == 7, np.nan, 1.0)},
            'target 3 has an invalid coordinate',
        ),
        ({'sd_mm': [0.1, 0.0, 0.1, 0.1]}, 'target 2 has an invalid sd'),
        (
            {'target_id': [1, 2, 3], 'xyz_mm': np.zeros((3, 3)), 'sd_mm': np.ones(3)},
            '3 targets are too few',
        ),
    ],
)
def test_invalid_phantom_is_rejected(changes, message):
    good = {'target_id': [1, 2, 3, 4], 'xyz_mm': np.zeros((4, 3)), 'sd_mm': np.full(4, 0.1)}
    Phantom(**good)
    with pytest.raises(DataError, match=message):
        Phantom(**{**good, **changes})


def test_sorting_a_frame_keeps_its_rows_together():
    frame = some_frame(sigma=np.array([5.0, 3, 9, 4]))
    ordered = frame.sorted()
    assert ordered.target_id.tolist() == [3, 4, 5, 9] == ordered.sigma.tolist()
    np.testing.assert_array_equal(ordered.uv, frame.uv[[1, 3, 0, 2]])
    assert replace(ordered, target_id=None, uv=None, sigma=None) == replace(
        frame, target_id=None, uv=None, sigma=None
    )
