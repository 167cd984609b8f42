# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Adjustment and self-calibration with independent programs for comparison.

COLMAP's bundle adjuster (pycolmap, Ceres) with a Cauchy loss of scale b = sigma sqrt(nu) minimises
b^2/2 sum ln(1 + |r|^2 / b^2): the negative log-likelihood of the bivariate Student-t, except for
its constant and the factor (nu + 2) / b^2. Its pixel centres are at 0.5, ours at integers.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pycolmap
from sklearn.model_selection import GridSearchCV, PredefinedSplit
from sklearn.neighbors import KNeighborsRegressor

from fluoro_calib_ros.estimation.estimator import gauge_basis
from fluoro_calib_ros.photogrammetry.collinearity import project
from fluoro_calib_ros.photogrammetry.network import Network
from fluoro_calib_ros.photogrammetry.noise import INLIER_Q, Noise
from fluoro_calib_ros.photogrammetry.unknowns import Parameters

from .timing import timed

PIXEL_CENTRE = 0.5
# Standard deviations of the survey that represent COLMAP's constant and free points.
HELD_SD_MM = 1e-6
LOOSE_SD_MM = 1e6
# Ceres stops at the first criterion that is met: here, at rounding error.
TIGHT = {
    'function_tolerance': 0.0,
    'gradient_tolerance': 1e-10,
    'parameter_tolerance': 1e-14,
    'max_num_iterations': 500,
}
# Tolerances within the loop, where the next round continues the adjustment.
LOOP = {
    'function_tolerance': 1e-8,
    'gradient_tolerance': 0.0,
    'parameter_tolerance': 0.0,
    'max_num_iterations': 100,
}
CANDIDATES = tuple(range(3, 50))  # values of k in Chow et al.


def with_datum(network: Network, held: np.ndarray) -> Network:
    """Return the network with object points fixed to their survey where `held` (n,), else free.

    COLMAP supports constant and free points, but not surveyed coordinates with standard
    deviations.
    """
    return replace(network, survey_sd_mm=np.where(held, HELD_SD_MM, LOOSE_SD_MM))


def drop_rarely_seen_points(
    network: Network, start: Parameters, min_exposures: int
) -> tuple[Network, Parameters]:
    """Return network and initial values without points seen in fewer than min_exposures."""
    kept = np.bincount(network.point, minlength=len(network.survey_mm)) >= min_exposures
    rows = kept[network.point]
    number = np.cumsum(kept) - 1
    network = replace(
        network,
        uv=network.uv[rows],
        sigma=network.sigma[rows],
        exposure=network.exposure[rows],
        point=number[network.point[rows]],
        survey_mm=network.survey_mm[kept],
        survey_sd_mm=network.survey_sd_mm[kept],
    )
    return network, replace(start, points_mm=start.points_mm[kept])


class ColmapAdjustment:
    """Adjustment of a network of one fluoroscope by COLMAP's bundle adjuster.

    solve() may be called again after the observations have changed; it continues where it ended.

    Parameters
    ----------
    network : Network
        One fluoroscope; sigma of all image points is one.
    start : Parameters
        Initial values.
    noise : Noise
        Student-t noise model; not estimated.
    held : (n,) ndarray of bool
        Object points that are fixed to their survey.
    tolerances : mapping, optional
        Options of the Ceres solver.
    """

    def __init__(
        self,
        network: Network,
        start: Parameters,
        noise: Noise,
        held: np.ndarray,
        tolerances: Mapping[str, float] | None = None,
    ) -> None:
        if (
            network.n_fluoroscopes != 1
            or noise.loss != 'student_t'
            or not np.all(network.sigma == 1)
        ):
            raise ValueError('COLMAP needs one fluoroscope, Student-t noise and sigma one')
        self._network = network
        self._noise = noise
        self._held = held
        self._reconstruction = _reconstruction(network, start, held)
        self._config = pycolmap.BundleAdjustmentConfig()
        for image in self._reconstruction.reg_image_ids():
            self._config.add_image(image)
        for point in np.flatnonzero(held):
            self._config.add_constant_point(int(point) + 1)
        if not network.interior_free[0]:
            self._config.set_constant_cam_intrinsics(1)
        self._options = _options(noise, tolerances or {})

    def observe(self, uv: np.ndarray) -> None:
        """Replace the observed pixels (N, 2), in the order of the network."""
        rows = iter((np.asarray(uv) + PIXEL_CENTRE).tolist())
        for image in range(1, len(self._network.fluoroscope) + 1):
            for point in self._reconstruction.image(image).points2D:
                point.xy = next(rows)

    def set_noise(self, noise: Noise) -> None:
        """Replace the noise model."""
        self._noise = noise
        self._options.ceres.loss_function_scale = noise.scale * np.sqrt(noise.nu)

    def solve(self) -> Any:
        """Run the adjustment and return the summary of Ceres."""
        self._adjuster = pycolmap.create_default_ceres_bundle_adjuster(
            self._options, self._config, self._reconstruction
        )
        summary: Any = self._adjuster.solve()
        return summary.ceres_summary

    def cost(self, summary: Any) -> float:
        """Return F of the image points at the solution, including the distribution's constant."""
        noise = self._noise
        factor = (noise.nu + 2) / (noise.nu * noise.scale**2)
        return factor * summary.final_cost + len(self._network.uv) * np.log(
            2 * np.pi * noise.scale**2
        )

    def parameters(self) -> Parameters:
        """Return the current parameters."""
        f, cx, cy = self._reconstruction.camera(1).params
        poses = [
            self._reconstruction.image(i).cam_from_world()
            for i in range(1, len(self._network.fluoroscope) + 1)
        ]
        rotation = np.array([pose.rotation.matrix() for pose in poses])
        position = -np.array([r.T @ pose.translation for r, pose in zip(rotation, poses)])
        points = np.array(
            [self._reconstruction.point3D(i + 1).xyz for i in range(len(self._network.survey_mm))]
        )
        return Parameters(
            np.array([[cx - PIXEL_CENTRE, cy - PIXEL_CENTRE, f]]), rotation, position, points
        )

    def interior_covariance(self) -> np.ndarray:
        """Return the covariance (3, 3) [px^2] of xp, yp, c from the weighted normal matrix."""
        options = pycolmap.BACovarianceOptions()
        options.params = pycolmap.BACovarianceOptionsParams.ALL
        options.damping = 0.0
        found: Any = pycolmap.estimate_ba_covariance(options, self._reconstruction, self._adjuster)
        order = [1, 2, 0]  # COLMAP's order is f, cx, cy
        covariance = found.get_other_params_cov(self._reconstruction.camera(1).params)[
            np.ix_(order, order)
        ]
        # Ceres weights by 1/(1 + |r|^2/b^2), the likelihood by (nu + 2)/b^2 times this weight.
        return covariance * self._noise.nu * self._noise.scale**2 / (self._noise.nu + 2)


def _options(noise: Noise, tolerances: Mapping[str, float]) -> Any:
    """Return options of COLMAP's bundle adjuster: refine everything, on one thread."""
    options = pycolmap.BundleAdjustmentOptions()
    options.refine_principal_point = True
    options.print_summary = False
    options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    options.ceres.loss_function_scale = noise.scale * np.sqrt(noise.nu)
    options.ceres.solver_options.num_threads = 1
    for name, value in tolerances.items():
        setattr(options.ceres.solver_options, name, value)
    return options


def _reconstruction(network: Network, start: Parameters, held: np.ndarray) -> Any:
    """Return a COLMAP reconstruction: camera 1, images and points numbered from 1 in order."""
    xp, yp, c = start.interior[0]
    size = np.ceil(network.uv.max(axis=0)).astype(int) + 1
    out = pycolmap.Reconstruction()
    out.add_camera_with_trivial_rig(
        pycolmap.Camera(
            model='SIMPLE_PINHOLE',
            width=int(size[0]),
            height=int(size[1]),
            params=[c, xp + PIXEL_CENTRE, yp + PIXEL_CENTRE],
            camera_id=1,
        )
    )
    for e, (rotation, position) in enumerate(zip(start.rotation, start.position_mm)):
        image = pycolmap.Image(
            name=str(e),
            keypoints=network.uv[network.exposure == e] + PIXEL_CENTRE,
            camera_id=1,
            image_id=e + 1,
        )
        out.add_image_with_trivial_frame(
            image, pycolmap.Rigid3d(np.column_stack([rotation, -rotation @ position]))
        )
    first = np.searchsorted(network.exposure, np.arange(len(start.rotation)))
    number = np.arange(len(network.uv)) - first[network.exposure]  # index in its image
    xyz = np.where(held[:, None], network.survey_mm, start.points_mm)
    order = np.argsort(network.point, kind='stable')
    starts = np.searchsorted(network.point[order], np.arange(len(xyz) + 1))
    for p in range(len(xyz)):
        rows = order[starts[p] : starts[p + 1]]
        track = pycolmap.Track(
            [
                pycolmap.TrackElement(int(e) + 1, int(i))
                for e, i in zip(network.exposure[rows], number[rows])
            ]
        )
        assert out.add_point3D(xyz[p], track) == p + 1
    return out


@dataclass(frozen=True)
class PeerCalibration:
    """Result of the loop.

    Attributes
    ----------
    interior : (3,) ndarray
        xp, yp, c [px].
    k : int
        Number of neighbours.
    rounds : int
    converged : bool
    rmse : (2,) ndarray
        RMSE of the inlier residuals [px].
    search_seconds : float
        Time of the grid searches.
    """

    interior: np.ndarray
    k: int
    rounds: int
    converged: bool
    rmse: np.ndarray
    search_seconds: float


def self_calibrate_with_peers(
    network: Network,
    start: Parameters,
    folds: int = 10,
    rounds: int = 30,
    settled_px: float = 2e-3,
) -> PeerCalibration:
    """Run the loop of Chow et al. with COLMAP's bundle adjuster and scikit-learn's grid search.

    The folds and the reconstruction, from which each adjustment continues, are built once. The
    datum is defined by object points seen in fewer than three exposures, and every tenth point.
    Like ours, the loop ends when the next round would change the correction by less than
    settled_px, or after `rounds`.
    """
    network, start = drop_rarely_seen_points(network, start, 2)
    held = (np.arange(len(network.survey_mm)) % 10 == 0) | (np.bincount(network.point) < 3)
    fold = network.exposure % min(folds, len(network.fluoroscope))
    noise = Noise('student_t', 1.0, 5.0)
    correction = np.zeros_like(network.uv)
    converged = False
    colmap = ColmapAdjustment(network, start, noise, held, LOOP)
    search_seconds = 0.0
    number = 0
    for _ in range(rounds):
        number += 1
        colmap.observe(network.uv - correction)
        colmap.set_noise(noise)
        colmap.solve()
        parameters = colmap.parameters()
        residuals = network.uv - correction - project(*network.per_image_point(parameters))
        squared = np.sum(residuals**2, axis=1)
        # The median of chi-square with two degrees of freedom is 2 ln 2.
        noise = replace(noise, scale=float(np.sqrt(np.median(squared) / (2 * np.log(2)))))
        inliers = squared <= INLIER_Q * noise.scale**2
        search = GridSearchCV(
            KNeighborsRegressor(),
            {'n_neighbors': CANDIDATES},
            scoring='neg_mean_squared_error',
            cv=PredefinedSplit(fold[inliers]),
            n_jobs=1,
        )
        _, seconds = timed(
            lambda: search.fit(network.uv[inliers], (residuals + correction)[inliers])
        )
        search_seconds += seconds
        fitted = _without_gauge(
            network.uv, search.predict(network.uv), inliers, parameters.interior[0]
        )
        change = np.sqrt(np.mean((fitted - correction)[inliers] ** 2))
        if change <= settled_px:
            converged = True
            break
        correction = fitted
    return PeerCalibration(
        parameters.interior[0],
        search.best_params_['n_neighbors'],
        number,
        converged,
        np.sqrt(np.mean(residuals[inliers] ** 2, axis=0)),
        search_seconds,
    )


def _without_gauge(
    uv: np.ndarray, fitted: np.ndarray, inliers: np.ndarray, interior: np.ndarray
) -> np.ndarray:
    """Return the fitted correction (N, 2) without its gauge component; otherwise c would drift."""
    basis = gauge_basis(uv, interior)
    part, *_ = np.linalg.lstsq(
        basis[inliers].reshape(-1, basis.shape[2]), fitted[inliers].ravel(), rcond=None
    )
    return fitted - basis @ part
