# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Beads from the images alone agree with those of an independent least-squares solver."""

from types import SimpleNamespace as Fake

import numpy as np
import pytest
from scipy.optimize import least_squares

from fluoro_calib_ros.checks.bead_intersection import (
    intersect,
    least_chi2_without_a_ray,
    rays_of,
)
from fluoro_calib_ros.correction.base import Correction
from fluoro_calib_ros.exposures.frame import Frame
from fluoro_calib_ros.exposures.phantom import Phantom
from fluoro_calib_ros.photogrammetry.rotations import (
    matrix_from_vector,
    quaternion_from_matrix,
)

COUNT = 12
FALSE = 3  # bead with one false match
MOSTLY_FALSE, SELDOM = 5, 7  # beads that cannot be intersected
NOISE_PX, CORRECTION_SD_PX, SHIFT_PX = 0.3, 0.4, np.array([3.0, -2.0])
VARIANCE = NOISE_PX**2 + CORRECTION_SD_PX**2


def seen(rotation, position, interior, xyz):
    """Image points (n, 2) by the collinearity equations."""
    x, y, z = (rotation @ (xyz - position).T)[:3]
    return np.column_stack([interior[0] + interior[2] * x / z, interior[1] + interior[2] * y / z])


@pytest.fixture(scope='module')
def scene():
    """Result, frames and phantom of two fluoroscopes; rays (uv, pose, interior) by bead."""
    rng = np.random.default_rng(11)
    ids = 100 + np.arange(COUNT)
    xyz = rng.uniform(-60, 60, (COUNT, 3))
    phantom = Phantom(ids, xyz + rng.normal(0, 0.1, xyz.shape), np.full(COUNT, 0.2))
    frames, figures, rays = {}, {}, {target: [] for target in ids.tolist()}
    for name, interior in (('a', [500.0, 480.0, 4000.0]), ('b', [520.0, 470.0, 3000.0])):
        frames[name], poses = [], []
        for number in range(4):
            rotation = matrix_from_vector(rng.normal(0, 0.6, 3))
            position = rotation.T @ np.array([5.0, -8.0, -900.0])
            shown = ids if number < 2 else np.delete(ids, SELDOM)
            if name == 'b':
                shown = np.delete(ids, SELDOM)
            uv = seen(rotation, position, interior, xyz[shown - 100])
            uv += rng.normal(0, NOISE_PX, uv.shape)
            if name == 'a':
                uv[(shown == 100 + FALSE) & (number == 1)] += 25.0
                uv[shown == 100 + MOSTLY_FALSE] += rng.uniform(-90, 90, 2)
                uv[(shown == 100 + MOSTLY_FALSE) & (number == 0)] += 60.0
            else:
                uv[(shown == 100 + MOSTLY_FALSE) & (number == 0)] -= 200.0
            order = rng.permutation(len(shown))
            frames[name].append(
                Frame(name, number + 1, shown[order], uv[order] + SHIFT_PX, (1024, 1024))
            )
            quaternion = quaternion_from_matrix(rotation)
            poses.append(
                Fake(exposure=number + 1, position_mm=position, quaternion_wxyz=quaternion)
            )
            for target, point in zip(shown.tolist(), uv):
                rays[target].append((point, rotation, position, interior))
        figures[name] = Fake(exposures=poses, interior=np.array(interior))
    calibration = Fake(
        correction=lambda uv, angle: Correction(
            np.tile(SHIFT_PX, (len(uv), 1)), np.full(len(uv), CORRECTION_SD_PX), None
        ),
        noise_sd=lambda frame: np.full(len(frame.target_id), NOISE_PX),
    )
    start = np.vstack([[[900.0, 900, 900]], xyz + rng.normal(0, 0.5, xyz.shape)])
    targets = Fake(target_id=np.append(7, ids), xyz_mm=start)  # bead 7 is not seen
    job = Fake(fluoroscopes=figures, calibrations={'a': calibration, 'b': calibration})
    job.targets = targets
    return job, frames, phantom, rays


def solved(rays, start):
    """Point (3,), its covariance, and the residuals over their sd, by scipy."""

    def misfit(point):
        return np.concatenate(
            [(seen(r, t, i, point[None])[0] - uv) / VARIANCE**0.5 for uv, r, t, i in rays]
        )

    found = least_squares(misfit, start, xtol=1e-12, ftol=1e-12, gtol=1e-12)
    return found.x, np.linalg.inv(found.jac.T @ found.jac), found.fun.reshape(-1, 2)


def test_beads_are_those_of_least_squares_of_the_rays_that_agree(scene):
    job, frames, phantom, rays = scene
    found = intersect(rays_of(job, frames), job.targets, phantom)
    expected = np.delete(100 + np.arange(COUNT), [MOSTLY_FALSE, SELDOM])
    assert found.target_id.tolist() == expected.tolist()
    for row, target in enumerate(expected.tolist()):
        own = rays[target]
        if target == 100 + FALSE:
            own = [ray for number, ray in enumerate(own) if number != 1]
        point, covariance, _ = solved(own, phantom.xyz_mm[target - 100])
        np.testing.assert_allclose(found.xyz_mm[row], point, atol=1e-6)
        np.testing.assert_allclose(found.covariance[row], covariance, rtol=1e-3, atol=1e-9)
        assert found.views[row] == len(own)
        assert found.survey_mm[row].tolist() == phantom.xyz_mm[target - 100].tolist()


def test_a_bead_is_tried_without_each_of_its_rays(scene):
    job, frames, phantom, rays = scene
    ids = 100 + np.array([2, FALSE, MOSTLY_FALSE])
    found = least_chi2_without_a_ray(rays_of(job, frames), job.targets, phantom, ids)
    own = rays[102]
    squares = []
    for left_out in range(len(own)):
        rest = [ray for number, ray in enumerate(own) if number != left_out]
        point, covariance, _ = solved(rest, phantom.xyz_mm[2])
        off = point - phantom.xyz_mm[2]
        squares.append(off @ np.linalg.solve(covariance + 0.2**2 * np.eye(3), off))
    assert found[0] == pytest.approx(min(squares), rel=1e-4)
    assert found[1] > 0 and found[2] == 0
