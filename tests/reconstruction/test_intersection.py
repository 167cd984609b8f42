# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Points in space: orientation, epipolar check, intersection, matching of views, recordings."""

from dataclasses import fields, replace

import numpy as np
import pycolmap
import pytest
from rigs import calibrated
from scipy.optimize import least_squares

from fluoro_calib_ros.bodies.body import declared_bodies
from fluoro_calib_ros.errors import DataError
from fluoro_calib_ros.exposures.frame import Frame
from fluoro_calib_ros.exposures.pairing import RecordedPairing
from fluoro_calib_ros.photogrammetry.noise import ObservedScatter
from fluoro_calib_ros.photogrammetry.rig_orientation import RigOrientation
from fluoro_calib_ros.photogrammetry.rotations import matrix_from_vector
from fluoro_calib_ros.reconstruction.cameras import Cameras
from fluoro_calib_ros.reconstruction.epipolar import EpipolarGeometry
from fluoro_calib_ros.reconstruction.intersection import (
    FAILED,
    OK,
    OUTSIDE,
    REJECTED,
    SINGLE_VIEW,
    Intersector,
)
from fluoro_calib_ros.reconstruction.reconstruct import (
    CorrectedView,
    RigRecording,
    match_views,
)
from fluoro_calib_ros.simulation.rig import virtual_rig

SIGMA = 0.25


def orientation_of(names=('a', 'b'), uncertain=1.0, seed=1):
    """True RigOrientation of a virtual rig, with a full covariance.

    uncertain: factor on realistic standard deviations.
    """
    fluoroscopes = virtual_rig(seed, names=names).fluoroscopes
    count = 9 * len(names)
    spread = np.random.default_rng(seed).normal(size=(count, count)) / np.sqrt(count)
    root = (
        spread
        * np.tile([0.03] * 3 + [2e-5] * 3 + [0.2, 0.2, 0.3], len(names))[:, None]
        * uncertain
    )
    return RigOrientation(
        names,
        *(
            np.array([getattr(f, name) for f in fluoroscopes])
            for name in ('interior', 'rotation', 'position_mm')
        ),
        root @ root.T,
        'rig',
        'capture',
        names,
    )


def moved(orientation, step):
    """The orientation after a step (9F,) of its unknowns."""
    step = np.reshape(step, (-1, 9))
    return replace(
        orientation,
        interior=orientation.interior + step[:, 6:],
        rotation=matrix_from_vector(step[:, 3:6]) @ orientation.rotation,
        position_mm=orientation.position_mm + step[:, :3],
    )


def projected(orientation, xyz):
    """Image points (F, n, 2) of points (n, 3), computed point by point with Eq. 1."""
    out = []
    for (xp, yp, c), rotation, position in zip(
        orientation.interior, orientation.rotation, orientation.position_mm
    ):
        x = (xyz - position) @ rotation.T
        out.append(np.column_stack([xp + c * x[:, 0] / x[:, 2], yp + c * x[:, 1] / x[:, 2]]))
    return np.array(out)


def seen(orientation, count=30, seed=0, noise_px=SIGMA):
    """Points (n, 3), their noisy image points (F, n, 2) and sigma (F, n)."""
    rng = np.random.default_rng(seed)
    xyz = rng.uniform(-90, 90, (count, 3))
    uv = projected(orientation, xyz)
    return xyz, uv + rng.normal(0, noise_px, uv.shape), np.full(uv.shape[:2], SIGMA)


def central(function, count, steps):
    """Derivatives (..., count) of a function of count numbers, by central differences."""
    columns = []
    for i in range(count):
        step = np.zeros(count)
        step[i] = steps[i % len(steps)]
        columns.append((function(step) - function(-step)) / (2 * step[i]))
    return np.stack(columns, axis=-1)


STEPS = [1e-2] * 3 + [1e-6] * 3 + [1e-2] * 3


@pytest.mark.parametrize('names', [('a', 'b'), ('a', 'b', 'c')])
def test_intersection_is_the_least_squares_solution(names):
    """Same points as by scipy, with a different sigma for every image point."""
    orientation = orientation_of(names)
    _, uv, sigma = seen(orientation, 12)
    sigma = sigma * np.random.default_rng(3).uniform(0.5, 2, sigma.shape)
    found = Intersector(orientation, reject=None).intersect(uv, sigma)
    for k in range(12):
        peer = least_squares(
            lambda x, k=k: (
                (projected(orientation, x[None])[:, 0] - uv[:, k]) / sigma[:, k, None]
            ).ravel(),
            np.zeros(3),
            xtol=1e-15,
            ftol=1e-15,
            gtol=1e-15,
        )
        np.testing.assert_allclose(found.xyz_mm[k], peer.x, atol=1e-5)
        np.testing.assert_allclose(
            found.covariance_noise[k], np.linalg.inv(peer.jac.T @ peer.jac), rtol=1e-3, atol=1e-6
        )
        left = projected(orientation, peer.x[None])[:, 0] - uv[:, k]
        np.testing.assert_allclose(found.residual[k], np.sqrt(np.mean(left**2)), rtol=1e-3)
    assert (
        (found.status == OK).all()
        and (found.rays == len(names)).all()
        and (found.dropped_view == -1).all()
    )


def test_limit_follows_the_scatter_of_a_recording():
    """The noise is twice the stated sigma, and one match in ten is false."""
    orientation = orientation_of(uncertain=0.3)
    intersector = Intersector(orientation)
    scatter = ObservedScatter()
    rejected = []
    alone = []
    false = []
    for seed in range(60):
        _, uv, sigma = seen(orientation, 30, seed, 2 * SIGMA)
        uv[0, :3] += np.random.default_rng(seed).normal(0, 40, (3, 2))
        status = intersector.intersect(uv, sigma, None, scatter).status
        false.append(status[:3] == REJECTED)
        if seed >= 10:
            rejected.append(status[3:] == REJECTED)
            alone.append(intersector.intersect(uv, sigma).status[3:] == REJECTED)
    assert np.mean(alone) > 0.03
    assert np.mean(rejected) < 0.005
    assert np.mean(false) > 0.85


def test_pycolmap_triangulates_the_same_points():
    """COLMAP minimises angles; with equal weights, this differs by less than the noise."""
    orientation = orientation_of()
    _, uv, sigma = seen(orientation, 10)
    found = Intersector(orientation).intersect(uv, sigma)
    cameras = []
    for xp, yp, c in orientation.interior:  # COLMAP pixels start at the image corner
        cameras.append(
            pycolmap.Camera(
                model='SIMPLE_PINHOLE', width=1024, height=1024, params=[c, xp + 0.5, yp + 0.5]
            )
        )
    poses = [
        pycolmap.Rigid3d(np.column_stack([r, -r @ t]))
        for r, t in zip(orientation.rotation, orientation.position_mm)
    ]
    for k in range(10):
        peer = pycolmap.estimate_triangulation(uv[:, k] + 0.5, poses, cameras)
        np.testing.assert_allclose(found.xyz_mm[k], peer['xyz'], atol=0.02)


def test_derivatives_of_the_image_points_by_the_orientation():
    orientation = orientation_of()
    xyz = np.array([[40.0, -30.0, 60.0]])
    numeric = central(lambda step: projected(moved(orientation, step), xyz)[:, 0], 18, STEPS)
    cameras = Cameras(orientation)
    image = cameras.image(xyz)
    uv = image[..., :2] / image[..., 2:]
    (analytic,) = cameras.by_orientation(uv, cameras.by_place(uv, image[..., 2]))
    for f in range(2):
        np.testing.assert_allclose(
            analytic[f], numeric[f, :, 9 * f : 9 * f + 9], rtol=1e-5, atol=1e-4
        )
        assert np.abs(np.delete(numeric[f], np.r_[9 * f : 9 * f + 9], axis=1)).max() == 0


@pytest.mark.parametrize('names', [('a', 'b'), ('a', 'b', 'c')])
def test_covariance_is_that_of_noise_and_orientation(names):
    """Reference: propagation with finite differences of the intersected point."""
    orientation = orientation_of(names)
    _, uv, sigma = seen(orientation, 5, noise_px=0)
    found = Intersector(orientation).intersect(uv, sigma)
    by_rig = central(
        lambda step: Intersector(moved(orientation, step)).intersect(uv, sigma).xyz_mm,
        9 * len(names),
        STEPS,
    )
    by_image = central(
        lambda step: (
            Intersector(orientation).intersect(uv + step.reshape(len(names), 1, 2), sigma).xyz_mm
        ),
        2 * len(names),
        [1e-2],
    )
    noise = by_image @ by_image.transpose(0, 2, 1) * SIGMA**2
    np.testing.assert_allclose(found.covariance_noise, noise, rtol=1e-4, atol=1e-7)
    every = noise + by_rig @ orientation.covariance @ by_rig.transpose(0, 2, 1)
    np.testing.assert_allclose(found.covariance, every, rtol=1e-3, atol=1e-6)
    np.testing.assert_allclose(
        found.sd_mm, np.sqrt(np.diagonal(every, axis1=1, axis2=2)), rtol=1e-3
    )


def test_covariance_against_monte_carlo():
    """Normalised squares of points, epipolar distances and ray tests have a mean of one."""
    orientation = orientation_of()
    xyz, uv, sigma = seen(orientation, 20, noise_px=0)
    rng = np.random.default_rng(5)
    root = orientation.covariance_root()
    squares = []
    noise_only = []
    tests = []
    distances = []
    known = Intersector(orientation, reject=None)
    for _ in range(300):
        noisy = uv + rng.normal(0, SIGMA, uv.shape)
        wrong = moved(orientation, root @ rng.normal(size=len(root)))
        found = Intersector(wrong, reject=None).intersect(noisy, sigma)
        error = found.xyz_mm - xyz
        squares.append(
            np.einsum('ni,nij,nj->n', error, np.linalg.inv(found.covariance), error) / 3
        )
        tests.append(found.standardised**2)
        distance = EpipolarGeometry(wrong, 'a', 'b').residuals(*noisy, SIGMA, SIGMA)
        distances.append((distance.residual / distance.sd_total) ** 2)
        error = known.intersect(noisy, sigma).xyz_mm - xyz
        noise_only.append(
            np.einsum('ni,nij,nj->n', error, np.linalg.inv(found.covariance_noise), error) / 3
        )
    assert [np.mean(a) for a in (squares, tests, distances)] == pytest.approx([1, 1, 1], abs=0.1)
    assert np.mean(noise_only) == pytest.approx(1, abs=0.03)
    assert np.trace(known.intersect(uv, sigma).covariance[0]) > 1.2 * np.trace(
        known.intersect(uv, sigma).covariance_noise[0]
    )


def test_epipolar_distance_and_its_standard_deviations():
    """Signs, normals, factors and standard deviations, against finite differences."""
    orientation = orientation_of()
    _, uv, _ = seen(orientation, 8)
    geometry = EpipolarGeometry(orientation, 'a', 'b')
    sigma = np.linspace(0.1, 0.8, 8), np.linspace(0.5, 0.2, 8)
    found = geometry.residuals(*uv, *sigma)
    by_a, by_b = (
        central(
            lambda step, side=side: (
                geometry.residuals(
                    *(uv + (np.arange(2) == side)[:, None, None] * step), *sigma
                ).residual
            ),
            2,
            [1e-3],
        )
        for side in (0, 1)
    )
    np.testing.assert_allclose(
        found.factor_a[:, None] * found.normal_a, by_a, rtol=1e-3, atol=1e-4
    )
    np.testing.assert_allclose(
        found.factor_b[:, None] * found.normal_b, by_b, rtol=1e-3, atol=1e-4
    )
    np.testing.assert_allclose(found.factor_a**2 + found.factor_b**2, 1)
    np.testing.assert_allclose(
        found.sd, np.hypot(found.factor_a * sigma[0], found.factor_b * sigma[1])
    )
    by_rig = central(
        lambda step: (
            EpipolarGeometry(moved(orientation, step), 'a', 'b').residuals(*uv, *sigma).residual
        ),
        18,
        STEPS,
    )
    of_rig = np.einsum('ni,ij,nj->n', by_rig, orientation.covariance, by_rig)
    np.testing.assert_allclose(found.sd_total**2, found.sd**2 + of_rig, rtol=1e-3)


def test_epipolar_distance_is_the_smallest_shift_that_makes_the_rays_meet():
    """For two views of equal sigma, it is the length of the residuals, also if standardised."""
    orientation = orientation_of()
    _, uv, sigma = seen(orientation, 8)
    distance = EpipolarGeometry(orientation, 'b', 'a').residuals(*uv[::-1], SIGMA, SIGMA)
    points = Intersector(orientation, reject=None).intersect(uv, sigma)
    np.testing.assert_allclose(np.abs(distance.residual), 2 * points.residual, rtol=1e-3)
    np.testing.assert_allclose(
        np.abs(distance.residual) / distance.sd_total, points.standardised, rtol=1e-3
    )
    other = EpipolarGeometry(orientation, 'a', 'b').residuals(*uv, SIGMA, SIGMA)
    np.testing.assert_allclose(np.abs(other.residual), np.abs(distance.residual), rtol=1e-9)


def test_residuals_alone_are_those_with_their_deviations():
    orientation = orientation_of()
    _, uv, sigma = seen(orientation, 4)
    uv[1, 3] += 2.0
    geometry = EpipolarGeometry(orientation, 'a', 'b')
    np.testing.assert_array_equal(geometry.misses(*uv), geometry.residuals(*uv, *sigma).residual)


def test_epipolar_nan_stays_nan():
    orientation = orientation_of()
    _, uv, sigma = seen(orientation, 4)
    uv[0, 1] = np.nan
    sigma[1, 2] = np.nan
    found = EpipolarGeometry(orientation, 'a', 'b').residuals(*uv, *sigma)
    assert np.isnan(found.residual).tolist() == [False, True, False, False]
    assert np.isnan(found.sd_total).tolist() == [False, True, True, False]


def test_false_match_of_two_views_is_rejected():
    """A shift across the epipolar line is detected, a shift along it is not."""
    orientation = orientation_of()
    xyz, uv, sigma = seen(orientation)
    normal = EpipolarGeometry(orientation, 'a', 'b').residuals(*uv, SIGMA, SIGMA).normal_b
    uv[1, 4] += 8 * normal[4]
    uv[1, 7] += 8 * normal[7, ::-1] * (1, -1)
    found = Intersector(orientation).intersect(uv, sigma)
    assert np.flatnonzero(found.status == REJECTED).tolist() == [4]
    assert (
        np.isnan(found.xyz_mm[4]).all()
        and np.isnan(found.covariance[4]).all()
        and found.standardised[4] > 4
    )
    assert np.isnan(found.covariance_noise[4]).all() and found.residual[4] > 1
    good = np.delete(np.arange(30), [4, 7])
    assert np.abs(found.xyz_mm[good] - xyz[good]).max() < 0.6 and (found.status[good] == OK).all()
    kept = Intersector(orientation, reject=None).intersect(uv, sigma)
    assert (kept.status == OK).all() and np.isfinite(kept.xyz_mm).all()


@pytest.mark.parametrize('names', [('a', 'b', 'c'), ('a', 'b', 'c', 'd')])
def test_false_match_of_more_views_loses_its_ray(names):
    orientation = orientation_of(names, uncertain=0.3)
    xyz, uv, sigma = seen(orientation, 40)
    rng = np.random.default_rng(1)
    count = len(names)
    false = np.arange(20) % count
    uv[false, np.arange(20)] += rng.choice([-1, 1], (20, 2)) * rng.uniform(20, 50, (20, 2))
    found = Intersector(orientation).intersect(uv, sigma)
    saved = found.status[:20] == OK
    assert saved.mean() >= 0.8 and set(found.status[:20][~saved]) <= {REJECTED}
    assert (found.dropped_view[:20] == np.where(saved, false, -1)).all()
    assert (found.rays[:20] == np.where(saved, count - 1, count)).all()
    assert (np.abs(found.xyz_mm[:20] - xyz[:20]) / found.sd_mm[:20])[saved].max() < 5
    assert (found.status[20:] == OK).all() and (found.dropped_view[20:] == -1).all()
    alone = Intersector(orientation.subset(names[1:])).intersect(uv[1:, :1], sigma[1:, :1])
    np.testing.assert_allclose(found.xyz_mm[0], alone.xyz_mm[0], atol=1e-6)
    np.testing.assert_allclose(found.covariance[0], alone.covariance[0], rtol=1e-3, atol=1e-7)


def test_false_match_loses_its_ray_where_other_points_are_seen_by_two():
    """Points of two, three and one view in one frame give the same as in separate frames."""
    orientation = orientation_of(('a', 'b', 'c'))
    _, uv, sigma = seen(orientation, 12)
    uv[2, 4] += 40.0  # a false match of the third view
    uv[0, 7:9] = np.nan
    uv[1:, 9] = np.nan
    sigma[1] = 2 * SIGMA
    intersector = Intersector(orientation)
    found = intersector.intersect(uv, sigma)
    assert (found.dropped_view[4], found.rays[4], found.status[4]) == (2, 2, OK)
    assert found.rays[7:10].tolist() == [2, 2, 1] and found.status[9] == SINGLE_VIEW
    for row in (0, 4, 7):
        alone = intersector.intersect(uv[:, [row]], sigma[:, [row]])
        np.testing.assert_allclose(found.xyz_mm[row], alone.xyz_mm[0], atol=1e-6)
        np.testing.assert_allclose(
            found.covariance[row], alone.covariance[0], rtol=1e-3, atol=1e-6
        )
    two = Intersector(orientation.subset(['a', 'b'])).intersect(uv[:2, [4]], sigma[:2, [4]])
    np.testing.assert_allclose(found.xyz_mm[4], two.xyz_mm[0], atol=1e-6)


def test_points_seen_by_few_fluoroscopes():
    """Every point is intersected from the rays that it has."""
    orientation = orientation_of(('a', 'b', 'c'))
    _, uv, sigma = seen(orientation, 6)
    uv[0, 0] = np.nan
    uv[2, 1] = np.nan
    sigma[1, 2] = np.nan
    uv[:2, 3] = np.nan
    uv[:, 4] = np.nan
    found = Intersector(orientation).intersect(uv, sigma)
    assert found.rays.tolist() == [2, 2, 2, 1, 0, 3]
    assert found.status.tolist() == [OK, OK, OK, SINGLE_VIEW, SINGLE_VIEW, OK]
    for k, names in enumerate([('b', 'c'), ('a', 'b'), ('a', 'c')]):
        rows = [orientation.index(name) for name in names]
        alone = Intersector(orientation.subset(names)).intersect(
            uv[rows][:, k : k + 1], sigma[rows][:, k : k + 1]
        )
        np.testing.assert_allclose(found.xyz_mm[k], alone.xyz_mm[0], atol=1e-5)
        np.testing.assert_allclose(found.covariance[k], alone.covariance[0], rtol=1e-3, atol=1e-6)
    assert np.isnan(found.xyz_mm[3:5]).all() and np.isnan(found.residual[3:5]).all()
    nothing = Intersector(orientation).intersect(uv[:, 3:5], sigma[:, 3:5])
    assert nothing.status.tolist() == [SINGLE_VIEW] * 2


def test_ray_with_an_infinite_standard_deviation_counts_as_not_seen():
    orientation = orientation_of(('a', 'b', 'c'))
    _, uv, sigma = seen(orientation, 6)
    outside = np.zeros((3, 6), dtype=bool)
    outside[2, 1] = True
    with_ray, without_ray = sigma.copy(), sigma.copy()
    with_ray[2, :3] = np.inf
    without_ray[2, :3] = np.nan
    found, expected = (
        Intersector(orientation).intersect(uv, of_case, outside)
        for of_case in (with_ray, without_ray)
    )
    assert found.rays.tolist() == [2, 2, 2, 3, 3, 3] and not found.status.any()
    for field in fields(found):
        assert np.array_equal(getattr(found, field.name), getattr(expected, field.name))


def test_points_outside_the_calibrated_area_have_a_status():
    orientation = orientation_of()
    _, uv, sigma = seen(orientation, 5)
    outside = np.zeros((2, 5), dtype=bool)
    outside[1, 2] = outside[0, 3] = outside[0, 4] = True
    uv[1, 3] = np.nan
    uv[1, 4] += 80
    found = Intersector(orientation).intersect(uv, sigma, outside)
    assert found.status.tolist() == [OK, OK, OUTSIDE, SINGLE_VIEW, REJECTED]
    assert np.isfinite(found.xyz_mm[2]).all()


def test_rays_that_do_not_meet_in_front_of_the_sources():
    """Behind the source, parallel, or from one place: status and NaN, but no exception."""
    orientation = orientation_of()
    across = orientation.rotation[1] @ orientation.rotation[0].T
    direction = np.array([0.0, 0.0, 1.0])
    parallel = [[0, 0], (across @ direction)[:2] / (across @ direction)[2]]
    uv = (
        orientation.interior[:, None, :2]
        + orientation.interior[:, None, 2:] * np.array(parallel)[:, None]
    )
    behind = 3 * (orientation.position_mm[0] + orientation.position_mm[1])
    uv = np.concatenate([uv, projected(orientation, behind[None])], axis=1)
    for reject in (None, 4.0):
        found = Intersector(orientation, reject).intersect(uv, np.ones((2, 2)))
        assert found.status.tolist() == [FAILED] * 2 and np.isnan(found.xyz_mm).all()
    same = replace(
        orientation,
        rotation=orientation.rotation[[0, 0]],
        position_mm=orientation.position_mm[[0, 0]],
    )
    assert set(Intersector(same).intersect(np.full((2, 3, 2), 400.0), np.ones((2, 3))).status) == {
        FAILED
    }
    with pytest.raises(DataError, match='coincident sources'):
        EpipolarGeometry(same, 'a', 'b')


def test_empty_frame_and_wrong_shapes():
    intersector = Intersector(orientation_of())
    assert intersector.intersect(np.zeros((2, 0, 2)), np.zeros((2, 0))).xyz_mm.shape == (0, 3)
    for uv, sigma in ((np.zeros((3, 4, 2)), np.ones((3, 4))), (np.zeros((2, 4, 2)), np.ones(4))):
        with pytest.raises(ValueError, match=r'image points must be \(2, n, 2\)'):
            intersector.intersect(uv, sigma)
    with pytest.raises(DataError, match='a single fluoroscope sees no third dimension'):
        Intersector(orientation_of().subset(['b']))
    with pytest.raises(ValueError, match='reject must be above 0'):
        Intersector(orientation_of(), reject=0)


@pytest.mark.parametrize(
    'change, sentence',
    [
        (
            {'fluoroscopes': ('a', 'a')},
            'the fluoroscopes are a, a, but each needs a unique name',
        ),
        ({'calibration_ids': ('a',)}, '2 fluoroscopes, but 1 calibrations'),
        ({'optical_frame_ids': ('a',)}, '2 fluoroscopes, but 1 optical frames'),
        (
            {'source': 'guess'},
            "its source must be one of capture, joint calibration, healing, not 'guess'",
        ),
        ({'frame_id': ''}, 'the rig frame has no name'),
        ({'position_mm': np.zeros(3)}, r'position_mm has shape \(3,\), not \(2, 3\)'),
        (
            {'position_mm': np.full((2, 3), np.nan)},
            'position_mm holds nan, which is not a finite number',
        ),
        (
            {'interior': np.array([[1, 1, 100], [1, 1, -100.0]])},
            'the principal distance of fluoroscope b is -100 px',
        ),
        (
            {'rotation': np.tile(np.diag([1, 1, -1.0]), (2, 1, 1))},
            'the rotation of fluoroscope a is not a rotation matrix',
        ),
        (
            {'rotation': np.tile(1.01 * np.eye(3), (2, 1, 1))},
            'the rotation of fluoroscope a is not a rotation matrix',
        ),
        ({'covariance': np.eye(18) + np.eye(18, k=1)}, 'its covariance is not symmetric'),
        (
            {'covariance': np.ones((18, 18)) - np.eye(18)},
            'its covariance has a negative eigenvalue',
        ),
    ],
)
def test_invalid_orientations_are_refused(change, sentence):
    with pytest.raises(DataError, match='^rig orientation: ' + sentence):
        replace(orientation_of(), **change)


def test_orientation_by_name():
    """Subsets in any order keep the values of each fluoroscope; the id depends on the content."""
    orientation = orientation_of(('a', 'b', 'c'))
    part = orientation.subset(['c', 'a'])
    assert part.fluoroscopes == ('c', 'a') and part.calibration_ids == ('c', 'a')
    assert part.optical_frame_ids == ('c_optical', 'a_optical')
    np.testing.assert_array_equal(part.rotation, orientation.rotation[[2, 0]])
    np.testing.assert_array_equal(part.covariance[:9, 9:], orientation.covariance[18:, :9])
    np.testing.assert_array_equal(part.sd_mm, orientation.sd_mm[[2, 0]])
    np.testing.assert_allclose(
        orientation.covariance_root() @ orientation.covariance_root().T,
        orientation.covariance,
        atol=1e-12,
    )
    with pytest.raises(DataError, match="there is no fluoroscope 'd', only a, b, c"):
        orientation.subset(['a', 'd'])
    assert replace(orientation).orientation_id == orientation.orientation_id
    assert (
        len(
            {
                orientation.orientation_id,
                part.orientation_id,
                replace(orientation, stamp_ns=1).orientation_id,
            }
        )
        == 3
    )
    orientation.check_calibrations({'a': 'a', 'b': 'b', 'c': 'c', 'd': 'x'})
    with pytest.raises(DataError, match='there is no calibration of its fluoroscope c'):
        orientation.check_calibrations({'a': 'a', 'b': 'b'})
    with pytest.raises(
        DataError,
        match='it belongs to the calibration b of fluoroscope b, but the present one is x; ',
    ):
        orientation.check_calibrations({'a': 'a', 'b': 'x', 'c': 'c'})


def test_views_are_matched_by_id():
    uv = [np.arange(6.0).reshape(3, 2), np.arange(8.0).reshape(4, 2) + 100]
    sigma = [np.ones(3), np.full(4, 2.0)]
    outside = [np.array([True, False, False]), np.zeros(4, dtype=bool)]
    ids = [np.array([7, 2, 9]), np.array([2, 5, 7, 1])]
    found = match_views([CorrectedView(*view) for view in zip(ids, uv, sigma, sigma, outside)])
    assert found.target_id.tolist() == [1, 2, 5, 7, 9]
    points = found.uv
    np.testing.assert_array_equal(points[0], [[np.nan] * 2, [2, 3], [np.nan] * 2, [0, 1], [4, 5]])
    np.testing.assert_array_equal(
        points[1], [[106, 107], [100, 101], [102, 103], [104, 105], [np.nan] * 2]
    )
    np.testing.assert_array_equal(np.isnan(found.sigma), np.isnan(points[:, :, 0]))
    np.testing.assert_array_equal(found.correction_sd, found.sigma)
    beyond = found.outside
    assert beyond[0].tolist() == [False, False, False, True, False] and not beyond[1].any()
    same = CorrectedView(ids[0], uv[0], sigma[0], sigma[0], outside[1][:3])
    other = replace(same, target_id=ids[0].copy(), uv=uv[1][:3], sigma=sigma[1][:3])
    found = match_views([same, other])
    assert found.target_id.tolist() == [7, 2, 9] and not found.outside.any()
    np.testing.assert_array_equal(found.uv, [uv[0], uv[1][:3]])
    assert found.sigma.shape == (2, 3)


def recording(count=3, **change):
    """Frames of fluoroscopes a and b with three targets, calibrations, Intersector and truth."""
    rig = virtual_rig(1)
    calibrations = {
        name: calibrated(name, 6, max_iterations=2).calibrations[name] for name in ('a', 'b')
    }
    orientation = replace(
        orientation_of(), calibration_ids=tuple(c.calibration_id for c in calibrations.values())
    )
    xyz = np.array([[10.0, 20, 30], [-10, 0, 5], [40, -20, 10]])
    frames = {
        f.name: [
            Frame(
                f.name,
                k + 1,
                np.array([3, 1, 2]),
                f.distortion.distort(f.ideal(xyz)),
                f.image_size,
                None,
                k * 10**7,
            )
            for k in range(count)
        ]
        for f in rig.fluoroscopes
    }
    return frames, calibrations, Intersector(replace(orientation, **change)), xyz


@pytest.mark.long
def test_recording_frame_by_frame():
    """Observed points are corrected first; frames without a partner are counted."""
    frames, calibrations, intersector, xyz = recording()
    frames['b'] = [replace(frames['b'][0], target_id=np.array([3, 1, 8])), *frames['b'][2:]]
    by_number = RigRecording(frames, calibrations, intersector)
    found = by_number.reconstruct()
    assert [frame.number for frame in found] == [1, 3]
    assert by_number.unpaired == {'a': 1, 'b': 0}
    assert found[0].target_id.tolist() == [1, 2, 3, 8]
    assert found[0].points.status.tolist() == [OK, SINGLE_VIEW, OK, SINGLE_VIEW]
    assert np.abs(found[1].points.xyz_mm - xyz).max() < 1.0
    other = {**frames, 'b': [replace(f, number=f.number + 10) for f in frames['b']]}
    by_time = RigRecording(other, calibrations, intersector, RecordedPairing('stamp'))
    again = by_time.reconstruct()
    assert len(again) == 2 and by_time.unpaired == {'a': 1, 'b': 0}
    np.testing.assert_array_equal(again[1].points.xyz_mm, found[1].points.xyz_mm)


def test_invalid_recordings_are_refused():
    frames, calibrations, intersector, _ = recording(1)
    for change, sentence in (
        (
            {'image_size': (512, 512)},
            'fluoroscope b, frame 1: the image is 512 x 512 px, but the calibration is '
            'for 1024 x 1024 px',
        ),
        ({'target_id': np.array([1, 2, 1])}, 'fluoroscope b, frame 1: target 1 occurs 2 times'),
    ):
        wrong = {**frames, 'b': [replace(frames['b'][0], **change)]}
        with pytest.raises(DataError, match=sentence):
            RigRecording(wrong, calibrations, intersector).reconstruct()
    with pytest.raises(DataError, match='there are no frames of fluoroscope b, only of a'):
        RigRecording({'a': frames['a']}, calibrations, intersector).reconstruct()


@pytest.mark.parametrize(
    'texts, sentence',
    [
        (['1001 1002'], "does not declare a body, as 'tibia: 1001 1002 1003' does"),
        (['tibia:'], 'does not declare a body'),
        (['tibia: 1 x'], 'does not declare a body'),
        (['tibia: 1'], 'body tibia: needs two markers or more'),
        (['tibia: 1 2', 'tibia: 3 4'], 'two bodies are called tibia'),
        (['tibia: 1 2', 'femur: 2 3'], 'marker 2 is one of tibia and of femur'),
    ],
)
def test_invalid_declarations_of_bodies_are_refused(texts, sentence):
    with pytest.raises(ValueError, match=sentence):
        declared_bodies(texts)


def test_declared_bodies():
    bodies = declared_bodies(['tibia: 3 1,2', 'my femur :4 5'])
    assert [(body.name, body.target_id.tolist()) for body in bodies] == [
        ('tibia', [1, 2, 3]),
        ('my femur', [4, 5]),
    ]
    assert not any(body.known.any() for body in bodies)
