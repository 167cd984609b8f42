# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Out-of-sample errors of a calibration, relative to its claims and to the oracle's errors."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.precision import truth_in_gauge

from .angle_errors import errors_at_angles
from .scene import NAMES

RESECTION_STEPS = 6
INTERSECTION_STEPS = 4
GRID = 31
ANGLES = 4  # C-arm angles at which a correction is compared with the truth
MIN_POINTS = 6  # minimum number of points of a test pose
SAMPLE = 1000  # image points whose joint covariance is used
COVER = 1.96  # standard deviations of a 95 % interval
FAR_MM = 0.3  # error that would make a user doubt a point
FAR_SDS = 4.0


@dataclass(frozen=True)
class Truth:
    """A camera with the interface of `truth_in_gauge`: interior orientation and correction."""

    interior: np.ndarray
    distortion: object


def resect(rays, points, rotation, source):
    """Refine rotation and source to fit rays (n, 2) of points (n, 3), from approximate values."""
    for _ in range(RESECTION_STEPS):
        x = (points - source) @ rotation.T
        inverse = 1 / x[:, 2]
        xy = x[:, :2] * inverse[:, None]
        s = np.zeros((len(x), 2, 3))
        s[:, 0, 0] = s[:, 1, 1] = inverse
        s[:, :, 2] = -xy * inverse[:, None]
        cross = np.zeros((len(x), 3, 3))
        cross[:, 0, 1], cross[:, 0, 2], cross[:, 1, 2] = -x[:, 2], x[:, 1], -x[:, 0]
        cross -= cross.transpose(0, 2, 1)
        jacobian = np.concatenate([-s @ rotation, -s @ cross], axis=2).reshape(-1, 6)
        scale = np.linalg.norm(jacobian, axis=0)
        step = np.linalg.lstsq(jacobian / scale, (rays - xy).ravel(), rcond=None)[0] / scale
        source = source + step[:3]
        rotation = Rotation.from_rotvec(step[3:]).as_matrix() @ rotation
    return rotation, source


def intersect(rays, exteriors, points):
    """Refine points (n, 3) to fit the rays (n, 2) of two fluoroscopes, from approximate values."""
    for _ in range(INTERSECTION_STEPS):
        jacobian = []
        misclosure = []
        for ray, (rotation, source) in zip(rays, exteriors):
            x = (points - source) @ rotation.T
            xy = x[:, :2] / x[:, 2:]
            s = (rotation[:2] - xy[:, :, None] * rotation[2]) / x[:, 2, None, None]
            jacobian.append(s)
            misclosure.append(ray - xy)
        a = np.concatenate(jacobian, axis=1)
        normal = a.transpose(0, 2, 1) @ a
        right = a.transpose(0, 2, 1) @ np.concatenate(misclosure, axis=1)[..., None]
        points = points + np.linalg.solve(normal, right)[..., 0]
    return points


def out_of_sample(scene, corrected, seed):
    """Return RMS error [px] of noise-free test points; errors (n, 3) [mm] of noisy stereo points.

    corrected(f, observed, angle) returns rays (n, 2), c and a mask (n,) of the points to use;
    angle is that of the C-arm [rad].
    """
    rng = np.random.default_rng([seed, 5])
    sd = scene.case.noise.sd
    squares = []
    errors = []
    for pose, angle in zip(scene.test_poses, scene.test_angles):
        rays = []
        exteriors = []
        used = np.ones(len(scene.true_mm), dtype=bool)
        for f, camera in enumerate(scene.cameras):
            here = camera.at(scene.case, angle)
            observed = here.distortion.observed(camera.ideal(scene.true_mm, pose))
            on = ((observed > 0) & (observed < scene.case.side - 1)).all(axis=1)
            # Add the noise to observed pixels, because a correction may stretch the image.
            noisy = observed + rng.normal(0, sd, observed.shape)
            both, c, inside = corrected(f, np.concatenate([observed, noisy]), angle)
            ray, noisy_ray = np.split(both, 2)
            on &= inside[: len(observed)]
            used &= on
            if on.sum() < MIN_POINTS:  # the C-arm angle is beyond the calibrated ones
                break
            exterior = resect(ray[on], scene.true_mm[on], *camera.exterior(pose))
            x = (scene.true_mm - exterior[1]) @ exterior[0].T
            if f == 0:
                squares.append(((ray - x[:, :2] / x[:, 2:])[on] * c) ** 2)
            rays.append(noisy_ray)
            exteriors.append(exterior)
        if len(rays) < len(scene.cameras):
            continue
        found = intersect([r[used] for r in rays], exteriors, scene.true_mm[used])
        errors.append(found - scene.true_mm[used])
    return float(np.sqrt(np.mean(np.concatenate(squares)))), np.concatenate(errors)


def ratios(scene, result, oracle, seed):
    """Return the ratio of image and stereo errors to those of the oracle with interiors (2, 3)."""
    models = [result.calibrations[name] for name in NAMES]
    inside_of = {}

    def calibrated(f, observed, angle):
        angle = angle if scene.case.angle_known else None
        found = models[f].correction(np.clip(observed, 0, scene.case.side - 1), angle)
        xp, yp, c = models[f].interior
        inside_of.setdefault(f, []).append(~found.outside)
        return (observed - found.duv - [xp, yp]) / c, c, ~found.outside

    def known(f, observed, angle):
        xp, yp, c = oracle[f]
        correction = scene.cameras[f].at(scene.case, angle).distortion.correction(observed)
        return (observed - correction - [xp, yp]) / c, c, inside_of[f].pop(0)

    image, stereo = out_of_sample(scene, calibrated, seed)
    image_oracle, stereo_oracle = out_of_sample(scene, known, seed)
    sd = scene.case.noise.sd
    return {
        'ratio': float(np.hypot(image, sd) / np.hypot(image_oracle, sd)),
        'stereo': float(np.sqrt(np.mean(stereo**2) / np.mean(stereo_oracle**2))),
        'stereo_far': _far(stereo),
        'stereo_far_oracle': _far(stereo_oracle),
        'error_px': image,
    }


def _far(errors):
    """Return the fraction of errors (n, 3) that are longer than FAR_MM."""
    return float(np.mean(np.linalg.norm(errors, axis=1) > FAR_MM))


def claims(scene, result):
    """Return NSE and cover95 of correction, points and sources of fluoroscope a.

    points_far: object points with errors above FAR_MM and FAR_SDS, out of points_number.
    """
    name = NAMES[0]
    camera = scene.cameras[0]
    run = result.runs[name]
    # A regression is orthogonal to the gauge over the image points to which it is fitted, not over
    # all.
    network = run.measured.network
    uv = network.uv[run.trained]
    calibration = result.calibrations[name]
    model = calibration.model
    angles = test_angles(scene, calibration)
    if scene.case.arm and scene.case.angle_known and calibration.angle_field is not None:
        # The sd stated at an angle refers to the same interior orientation at all angles.
        grid = calibrated_grid(scene, calibration)
        error, sd = errors_at_angles(scene, calibration, uv, grid, angles)['held']
    else:
        found = [_errors_at(scene, calibration, uv, angle) for angle in angles]
        error, sd = (np.concatenate(parts) for parts in zip(*found))
    out = _statistics('correction', error, np.broadcast_to(sd[:, None], error.shape))
    out['correction_px'] = float(np.sqrt(np.mean(error**2)))
    out['correction_sd_px'] = float(np.sqrt(np.mean(sd**2)))
    out['correction_freedom'] = independent_errors(run, model)
    good = ~np.isin(result.targets.target_id - 1, scene.displaced)
    offset = result.targets.xyz_mm - scene.true_mm[result.targets.target_id - 1]
    sd = np.sqrt(np.diagonal(result.targets.covariance, axis1=1, axis2=2))
    out |= _statistics('points', offset[good], sd[good])
    length = np.linalg.norm(offset, axis=1)
    far = (length > FAR_MM) & (np.abs(offset) > FAR_SDS * sd).any(axis=1)
    out['points_far'] = int(np.count_nonzero(far))
    out['points_number'] = len(far)
    if result.targets.joint_covariance is not None:
        out['points_freedom'] = _freedom(result.targets.joint_covariance, np.repeat(good, 3))
    exposures = result.fluoroscopes[name].exposures
    true_sources = np.stack([camera.exterior(scene.poses[e.exposure - 1])[1] for e in exposures])
    offset = np.stack([e.position_mm for e in exposures]) - true_sources
    out |= _statistics('sources', offset, np.stack([e.sd_mm for e in exposures]))
    return out


def calibrated_grid(scene, calibration):
    """Return grid pixels (g, 2) within the calibrated area."""
    axis = np.linspace(0, scene.case.side - 1, GRID)
    grid = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
    return grid[~calibration.model.outside(grid)]


def _errors_at(scene, calibration, uv, angle):
    """Return errors (n, 2) and stated sd (n,) of a correction in the calibrated area, at an angle.

    uv: image points to which it was fitted. If angle is None, it is unknown and the truth is the
    mean over the exposures.
    """
    grid = calibrated_grid(scene, calibration)
    camera = scene.cameras[0]
    both = np.concatenate([uv, grid])
    angles = scene.angles if angle is None and scene.case.arm else [angle]
    true = np.mean([camera.at(scene.case, a).distortion.correction(both) for a in angles], axis=0)
    found = calibration.correction(both, angle)
    known = {id(uv): true[: len(uv)], id(grid): true[len(uv) :]}
    truth = Truth(camera.interior, lambda pixels: known[id(pixels)])
    on_grid = slice(len(uv), None)
    _, _, in_gauge = truth_in_gauge(truth, uv, calibration.interior, found.duv[: len(uv)])
    return found.duv[on_grid] - in_gauge(grid), found.sd[on_grid]


def test_angles(scene, calibration):
    """Return angles at which a correction is compared with the truth; None if unknown."""
    field = calibration.angle_field
    if not (scene.case.arm and scene.case.angle_known):
        return [None]
    return [a for a in scene.test_angles if field is None or field.covers(a)][:ANGLES]


def independent_errors(run, model):
    """Return the number of independent errors in the claimed covariance of a correction.

    The covariance is that at the image points. An NSE of so many errors scatters as chi squared
    over its degrees of freedom (Box 1954, Theorem 3.1). None if the adjustment does not estimate
    the model.
    """
    network = run.measured.network
    additional = network.additional[0] if network.additional else None
    if additional is None or additional.functions.ndim != 2 or run.stated is not None:
        return None
    covariance = run.precision.additional[0]
    rows = np.arange(len(additional.functions))[:: len(additional.functions) // SAMPLE + 1]
    values = additional.functions[rows]
    scaled = values / model.evaluate(network.uv[network.rows(0)][rows]).sd[:, None]
    m = values.shape[1]
    parts = covariance[: 2 * m, : 2 * m].reshape(2, m, 2, m)
    blocks = [[scaled @ parts[i, :, j] @ scaled.T for j in (0, 1)] for i in (0, 1)]
    normalised = np.block(blocks)
    return float(np.trace(normalised) ** 2 / np.sum(normalised**2))


def _freedom(covariance, rows):
    """Return the number of independent errors among those of rows (n,) of a covariance (n, n)."""
    part = covariance[np.ix_(rows, rows)]
    sd = np.sqrt(np.diagonal(part))
    return float(len(part) ** 2 / np.sum((part / np.outer(sd, sd)) ** 2))


def _statistics(name, error, sd):
    normalised = np.abs(error) / np.maximum(sd, 1e-12)
    return {
        f'{name}_nse': float(np.mean(normalised**2)),
        f'{name}_cover': float(np.mean(normalised <= COVER)),
    }
