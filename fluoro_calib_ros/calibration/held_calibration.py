# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Networks whose interior orientations and corrections are held at their calibrations."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace

import numpy as np

from ..exposures.frame import Frame, angles_of
from ..exposures.phantom import Phantom
from ..photogrammetry.network import Network
from ..photogrammetry.noise import Noise
from .initial_network import (
    Frames,
    Known,
    KnownSensor,
    Measured,
    StartValues,
    network_of_known_sensors,
)
from .result import FluoroscopeCalibration
from .robust_adjustment import start_noise

# Mean number of image points of a target from which the noise can be estimated: with fewer the
# noise cannot be told from errors of the survey.
MIN_RAYS_FOR_NOISE = 3


def network_of_calibrations(
    frames: Frames,
    phantom: Phantom,
    calibrations: Mapping[str, FluoroscopeCalibration],
    raise_if_cancelled: Callable[[], None] | None = None,
    known: Known | None = None,
    starts: StartValues | None = None,
) -> Measured:
    """Return network and start values of frames {fluoroscope: [Frame, ...]}.

    calibrations {fluoroscope: FluoroscopeCalibration} are held, as are exterior orientations that
    are known {fluoroscope: KnownOrientation}. starts: of an earlier adjustment of the frames.
    Raises DataError as `measured_network`.
    """
    sensors = {name: _sensor(calibrations[name]) for name in frames}
    return network_of_known_sensors(frames, phantom, sensors, raise_if_cancelled, known, starts)


def _sensor(calibration: FluoroscopeCalibration) -> KnownSensor:
    """Return interior orientation and correction of a calibration."""

    def correction(frame: Frame) -> np.ndarray:
        if calibration.angle_field is None:
            return calibration.model.predict(frame.uv)
        return calibration.correction(frame.uv, frame.angle).duv

    return KnownSensor(calibration.interior, correction)


def _angles(measured: Measured, rows: np.ndarray) -> np.ndarray:
    """Angle [rad] of the C-arm for image points (r,), NaN where it is unknown."""
    return angles_of(measured.frames)[measured.network.exposure[rows]]


def held_corrections(
    measured: Measured, calibrations: Mapping[str, FluoroscopeCalibration]
) -> tuple[np.ndarray, Network]:
    """Corrections (N, 2) [px] by calibrations, and the network with their uncertainty in sigma.

    Where a correction is uncertain, at the rim and beyond the calibrated area, an image point has
    less weight, and where the noise of the calibration is larger, unless it has a sigma itself.
    """
    network = measured.network
    correction = np.zeros_like(network.uv)
    sigma = network.sigma.copy()
    has_sigma = np.array([frame.sigma is not None for frame in measured.frames])
    for f, name in enumerate(measured.fluoroscopes):
        rows = network.rows(f)
        calibration = calibrations[name]
        found = calibration.correction(network.uv[rows], _angles(measured, rows))
        correction[rows] = found.duv
        without = rows[~has_sigma[network.exposure[rows]]]
        sigma[without] *= calibration.noise_factors(network.uv[without])
        sigma[rows] = np.hypot(sigma[rows], found.sd / calibration.sigma0)
    return correction, replace(network, sigma=sigma)


def noise_of_calibrations(loss: str, calibrations: Iterable[FluoroscopeCalibration]) -> Noise:
    """Return the noise model of calibrations: medians of their scales and degrees of freedom."""
    used = list(calibrations)
    return replace(
        start_noise(loss),
        scale=float(np.median([c.sigma0 for c in used])),
        nu=float(np.median([c.nu for c in used])),
    )


def too_few_rays_for_noise(network: Network) -> bool:
    """Whether the noise of a network cannot be estimated and is that of the calibrations."""
    return len(network.uv) < MIN_RAYS_FOR_NOISE * len(network.survey_mm)
