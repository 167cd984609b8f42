# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Networks with interior orientations and corrections fixed at their calibrations."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..correction.fluoroscope_calibration import Calibrations, FluoroscopeCalibration
from ..exposures.frame import Frame, Frames, angles_of
from ..exposures.phantom import Phantom
from ..photogrammetry.adjustment import Adjustment, adjust
from ..photogrammetry.diagnosis import global_names
from ..photogrammetry.elimination import CovarianceBlocks, factorize
from ..photogrammetry.network import MIN_RAYS, Network
from ..photogrammetry.noise import Noise
from ..photogrammetry.normal_equations import normal_equations
from ..photogrammetry.precision import (
    Precision,
    covariance_blocks,
    equations_with_fixed_interiors,
    joint_covariance,
)
from ..photogrammetry.unknowns import Parameters
from .initial_network import (
    ROUND_TOLERANCE,
    Known,
    KnownSensor,
    Measured,
    StartValues,
    measured_network,
    start_noise,
)

# The covariance matrix of all unknowns of an adjustment, computed on request.

# Position of the source in the frame of the phantom; rotation about the axes of the sensor.
EXTERIOR = ('x', 'y', 'z', 'turn x', 'turn y', 'turn z')


@dataclass(frozen=True)
class JointPrecision:
    """Covariance matrix of all unknowns of an adjustment."""

    #: (u,) names of the unknowns: x, y, z of the source [mm] and its rotations about the axes of
    #: the sensor [rad] for each exposure; x, y, z [mm] of each target; xp, yp, c [px] of each
    #: fluoroscope; estimated relative orientations and coefficients of the correction
    names: tuple[str, ...]
    values: NDArray[np.float64]  #: (u,) estimates; NaN for rotations, which have no value
    covariance: NDArray[np.float64]  #: (u, u); zeros for fixed unknowns


@dataclass(frozen=True)
class SolvedNetwork:
    """A network and its adjustment."""

    measured: Measured
    adjustment: Adjustment
    correction: NDArray[np.float64]  #: (N, 2) fixed correction [px]
    #: (F, 3, 3) covariances of fixed interior orientations [px^2]
    fixed: NDArray[np.float64] | None = None
    #: stated precision, where it differs from that of the network: the matrix then has these
    #: standard deviations, and the correlations of the network
    stated: Precision | None = None

    def joint_precision(self) -> JointPrecision:
        """Return the covariance matrix of all unknowns.

        Raises numpy.linalg.LinAlgError if the network does not determine them.
        """
        blocks = self.blocks()
        network = self.measured.network
        parameters = self.adjustment.parameters
        angles = np.full((network.n_exposures, 3), np.nan)
        additional = [p.ravel() for p in parameters.additional if p is not None]
        relative = [np.append(p.translation_mm, angles[0]) for p in parameters.relative]
        return JointPrecision(
            (*self._names(), *global_names(network, self.measured.fluoroscopes)),
            np.concatenate(
                [
                    np.hstack([parameters.position_mm, angles]).ravel(),
                    parameters.points_mm.ravel(),
                    parameters.interior.ravel(),
                    *relative,
                    *additional,
                ]
            ),
            self._as_stated(joint_covariance(blocks)),
        )

    def covariance_of_points(
        self,
    ) -> Callable[[NDArray[np.int64], NDArray[np.int64]], NDArray[np.float64]]:
        """Return a function of p, q (k,): covariances (k, 3, 3) of targets p with q [mm^2].

        p and q are rows of targets. Raises numpy.linalg.LinAlgError as `joint_precision`.
        """
        blocks = self.blocks()
        factor = np.ones((len(blocks.pp), 3))
        if self.stated is not None:
            stated = np.diagonal(self.stated.points, axis1=1, axis2=2)
            factor = np.sqrt(stated / np.diagonal(blocks.pp, axis1=1, axis2=2))

        def between(p: NDArray[np.int64], q: NDArray[np.int64]) -> NDArray[np.float64]:
            covariance = blocks.points_between(p, q)
            return factor[p][:, :, None] * covariance * factor[q][:, None, :]

        return between

    def blocks(self) -> CovarianceBlocks:
        """Return the blocks of the covariance matrix of the network; raises LinAlgError."""
        network = self.measured.network
        noise = self.adjustment.noise
        if self.fixed is not None:
            network, equations = equations_with_fixed_interiors(
                network, self.adjustment, self.correction, self.fixed
            )
        else:
            factor = noise.information_factor(self.adjustment.q)
            equations = normal_equations(
                network, self.adjustment.parameters, self.correction, noise, factor
            )
        return covariance_blocks(factorize(network, equations))

    def _as_stated(self, covariance: NDArray[np.float64]) -> NDArray[np.float64]:
        """Scale a covariance matrix to the stated standard deviations of the unknowns."""
        if self.stated is None:
            return covariance
        stated = np.concatenate(
            [
                np.diagonal(blocks, axis1=1, axis2=2).ravel()
                for blocks in (self.stated.exterior, self.stated.points, self.stated.interior)
            ]
        )
        variance = np.diagonal(covariance)[: len(stated)]
        scale = np.ones(len(covariance))
        free = variance > 0  # exclude fixed unknowns
        scale[: len(stated)][free] = np.sqrt(stated[free] / variance[free])
        return scale[:, None] * covariance * scale

    def _names(self) -> list[str]:
        """Return the names of the unknowns of exposures and targets."""
        exposures = [f'exposure {f.number} of {f.fluoroscope}' for f in self.measured.frames]
        targets = [f'target {number}' for number in self.measured.target_id]
        return [
            *(f'{name}: {part}' for name in exposures for part in EXTERIOR),
            *(f'{name}: {part}' for name in targets for part in 'xyz'),
        ]


def network_of_calibrations(
    frames: Frames,
    phantom: Phantom,
    calibrations: Calibrations,
    known: Known | None = None,
    starts: StartValues | None = None,
) -> Measured:
    """Return the network and the initial values of frames {fluoroscope: [Frame, ...]}.

    calibrations {fluoroscope: FluoroscopeCalibration} are fixed, and so are known exterior
    orientations {fluoroscope: KnownOrientation}. starts: initial values from an earlier adjustment
    of the frames. Raises DataError as `measured_network`.
    """
    sensors = {name: _sensor(calibrations[name]) for name in frames}
    return measured_network(frames, phantom, known=known, starts=starts, sensors=sensors)


def _sensor(calibration: FluoroscopeCalibration) -> KnownSensor:
    """Return the interior orientation and the correction of a calibration."""

    def correction(frame: Frame) -> NDArray[np.float64]:
        if calibration.angle_field is None:
            return calibration.model.predict(frame.uv)
        return calibration.correction(frame.uv, frame.angle).duv

    return KnownSensor(calibration.interior, correction)


def _angles(measured: Measured, rows: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return the angles [rad] of the C-arm of image points (r,); NaN where unknown."""
    return angles_of(measured.frames)[measured.network.exposure[rows]]


def fixed_corrections(
    measured: Measured, calibrations: Calibrations
) -> tuple[NDArray[np.float64], Network]:
    """Return corrections (N, 2) [px] by calibrations, and the network with their sd in sigma.

    An image point has less weight where its correction is uncertain, at the border and beyond the
    calibrated area. Without a sigma of its own, it also has less weight where the noise of the
    calibration is larger.
    """
    network = measured.network
    correction = np.zeros_like(network.uv)
    sigma = network.sigma.copy()
    has_sigma = np.array([frame.sigma is not None for frame in measured.frames])
    for f, name in enumerate(measured.fluoroscopes):
        rows = network.rows(f)
        calibration = calibrations[name]
        evaluated = calibration.correction(network.uv[rows], _angles(measured, rows))
        correction[rows] = evaluated.duv
        without_sigma = rows[~has_sigma[network.exposure[rows]]]
        sigma[without_sigma] *= calibration.noise_factors(network.uv[without_sigma])
        sigma[rows] = np.hypot(sigma[rows], evaluated.sd / calibration.sigma0)
    return correction, replace(network, sigma=sigma)


# Standard deviation of image points over sigma0 if their sigma was 1: inliers of a Student's t
# with at least 3 degrees of freedom scatter by 1 to 1.4 times its scale.
UNIT_SIGMA = (0.9, 1.6)


def with_comparable_sigma(frames: Frames, calibrations: Calibrations) -> dict[str, list[Frame]]:
    """Return frames without sigma where the points of their calibration had none.

    Its sigma0 is then the noise of image points [px], and not a factor of their sigma [px].
    """
    return {
        name: [replace(frame, sigma=None) for frame in exposures]
        if UNIT_SIGMA[0] < calibrations[name].image_sd / calibrations[name].sigma0 < UNIT_SIGMA[1]
        else list(exposures)
        for name, exposures in frames.items()
    }


def noise_of_calibrations(loss: str, calibrations: Iterable[FluoroscopeCalibration]) -> Noise:
    """Return the noise model of calibrations: medians of their scales and degrees of freedom."""
    known = list(calibrations)
    return replace(
        start_noise(loss),
        scale=float(np.median([c.sigma0 for c in known])),
        nu=float(np.median([c.nu for c in known])),
    )


def start_within_survey(
    network: Network, start: Parameters, correction: NDArray[np.float64], noise: Noise
) -> Parameters:
    """Return initial values near which the survey makes no image point seem false.

    Where errors of the survey are larger in the image than the noise, a robust adjustment that
    starts at the survey would keep them and reject the image points. Therefore the noise includes
    them at first, and is halved from adjustment to adjustment (graduated non-convexity: Blake and
    Zisserman, "Visual Reconstruction", MIT Press 1987).
    """
    if network.datum != 'survey' or not len(network.uv):
        return start
    distance_mm = np.linalg.norm(start.position_mm, axis=1)
    magnification = start.interior[network.fluoroscope, 2] / distance_mm  # px/mm
    survey_px = network.survey_sd_mm[network.point] * magnification[network.exposure]
    scale = float(np.hypot(noise.scale, np.median(survey_px / network.sigma)))
    while scale > 2 * noise.scale:
        wide_noise = replace(noise, scale=scale)
        adjustment = adjust(
            network, start, correction=correction, noise=wide_noise, tolerance=ROUND_TOLERANCE
        )
        start = adjustment.parameters
        scale /= 2
    return start


def too_few_rays_for_noise(network: Network) -> bool:
    """Whether a network has too few rays to estimate the noise; calibrations then give it.

    The noise cannot be separated from errors of the survey.
    """
    return len(network.uv) < MIN_RAYS * len(network.survey_mm)
