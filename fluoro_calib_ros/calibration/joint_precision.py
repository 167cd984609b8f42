# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Covariance matrix of all unknowns of an adjustment, computed on request."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..photogrammetry.adjustment import Adjustment
from ..photogrammetry.diagnosis import global_names
from ..photogrammetry.elimination import factorize
from ..photogrammetry.held_precision import equations_with_held_interiors
from ..photogrammetry.normal_equations import normal_equations
from ..photogrammetry.precision import Precision, covariance_blocks, joint_covariance
from .initial_network import Measured

# Position of the source in the frame of the phantom, rotation about the axes of the sensor.
EXTERIOR = ('x', 'y', 'z', 'turn x', 'turn y', 'turn z')


@dataclass(frozen=True)
class JointPrecision:
    """Covariance matrix of all unknowns of an adjustment.

    Attributes
    ----------
    names : tuple of str
        Of the unknowns: x, y, z of the source [mm] and its turns about the axes of the sensor
        [rad] of each exposure; x, y, z [mm] of each target; xp, yp, c [px] of each fluoroscope;
        relative orientations and coefficients of the correction, where they were estimated.
    values : (u,) ndarray
        NaN for rotations, which have no value.
    covariance : (u, u) ndarray
        Zeros for what was held.
    """

    names: tuple[str, ...]
    values: np.ndarray
    covariance: np.ndarray


@dataclass(frozen=True)
class SolvedNetwork:
    """A network and its adjustment.

    Attributes
    ----------
    measured : Measured
    adjustment : Adjustment
    correction : (N, 2) ndarray
        Correction that was held [px].
    held : (F, 3, 3) ndarray or None
        Covariances of interior orientations that were held [px^2].
    stated : Precision or None
        What the unknowns claim where that is not the precision of the network: the matrix then
        has these standard deviations, and the correlations of the network.
    """

    measured: Measured
    adjustment: Adjustment
    correction: np.ndarray
    held: np.ndarray | None = None
    stated: Precision | None = None

    def joint_precision(self) -> JointPrecision:
        """Covariance matrix of all unknowns.

        Raises numpy.linalg.LinAlgError where the network does not determine them.
        """
        network = self.measured.network
        parameters = self.adjustment.parameters
        noise = self.adjustment.noise
        if self.held is not None:
            network, equations = equations_with_held_interiors(
                network, self.adjustment, self.correction, self.held
            )
        else:
            factor = noise.information_factor(self.adjustment.q)
            equations = normal_equations(network, parameters, self.correction, noise, factor)
        blocks = covariance_blocks(factorize(network, equations))
        angles = np.full((network.n_exposures, 3), np.nan)
        others = [p.ravel() for p in parameters.additional if p is not None]
        relative = [np.append(p.translation_mm, angles[0]) for p in parameters.relative]
        return JointPrecision(
            (*self._exterior_names(), *self._target_names(), *self._global_names()),
            np.concatenate(
                [
                    np.hstack([parameters.position_mm, angles]).ravel(),
                    parameters.points_mm.ravel(),
                    parameters.interior.ravel(),
                    *relative,
                    *others,
                ]
            ),
            self._as_stated(joint_covariance(blocks).matrix),
        )

    def _as_stated(self, covariance: np.ndarray) -> np.ndarray:
        """Scale a covariance matrix to the standard deviations that the unknowns claim."""
        if self.stated is None:
            return covariance
        claimed = np.concatenate(
            [
                np.diagonal(blocks, axis1=1, axis2=2).ravel()
                for blocks in (self.stated.exterior, self.stated.points, self.stated.interior)
            ]
        )
        variance = np.diagonal(covariance)[: len(claimed)]
        scale = np.ones(len(covariance))
        free = variance > 0  # not of what was held
        scale[: len(claimed)][free] = np.sqrt(claimed[free] / variance[free])
        return scale[:, None] * covariance * scale

    def _exterior_names(self) -> list[str]:
        return [
            f'exposure {frame.number} of {frame.fluoroscope}: {part}'
            for frame in self.measured.frames
            for part in EXTERIOR
        ]

    def _target_names(self) -> list[str]:
        return [f'target {number}: {part}' for number in self.measured.target_id for part in 'xyz']

    def _global_names(self) -> list[str]:
        return global_names(self.measured.network, self.measured.fluoroscopes)
