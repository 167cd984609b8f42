# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The virtual rig: phantom, fluoroscopes and where they stand, and its streams of frames.

Two fluoroscopes look across each other at the middle of the rig frame (z up, mm). Their sources
are about 1.5 m from it and about 2 m apart. The phantom is a cube of 260 mm with 503 beads on its
four side faces.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..exposures.frame import Frame
from ..exposures.phantom import Phantom
from ..photogrammetry.collinearity import project
from ..photogrammetry.rotations import matrix_from_vector

IMAGE_SIZE = (1024, 1024)
CUBE_MM = 260.0  # edge of the phantom
BEADS = 503  # of the phantom
SURVEY_SD_MM = 0.1  # of a coordinate of a bead
BETWEEN_DEG = 84.0  # angle between the axes of neighbouring fluoroscopes

# Rotation (3, 3) and shift (3,) [mm] that take points of the phantom into the rig frame.
Pose = tuple[np.ndarray, np.ndarray]


@dataclass(frozen=True)
class VirtualFluoroscope:
    """A fluoroscope of a virtual rig."""

    name: str
    interior: NDArray[np.float64]  #: (3,) xp, yp, c [px]
    rotation: NDArray[np.float64]  #: (3, 3) rig frame -> sensor frame
    position_mm: NDArray[np.float64]  #: (3,) of the source in the rig frame
    distortion: DistortionField
    image_size: tuple[int, int] = IMAGE_SIZE  #: width and height [px]

    def exterior(self, pose: Pose) -> Pose:
        """Exterior orientation for a pose of the phantom.

        Returns the rotation (3, 3) phantom -> sensor frame and the source (3,) in the frame of the
        phantom [mm].
        """
        rotation, shift = pose
        return self.rotation @ rotation, rotation.T @ (self.position_mm - shift)

    def ideal(self, points_mm: np.ndarray) -> np.ndarray:
        """Undistorted image points (n, 2) [px] of points (n, 3) in the rig frame."""
        n = len(points_mm)
        return project(
            np.broadcast_to(self.rotation, (n, 3, 3)),
            np.broadcast_to(self.position_mm, (n, 3)),
            points_mm,
            self.interior,
        )


@dataclass(frozen=True)
class VirtualRig:
    """A rig: fluoroscopes, the true coordinates of the phantom [mm] and its survey."""

    fluoroscopes: tuple[VirtualFluoroscope, ...]
    true_mm: np.ndarray
    phantom: Phantom


def bead_coordinates(rng: np.random.Generator) -> np.ndarray:
    """Coordinates (503, 3) [mm] of beads on the side faces of the cube, in a disturbed grid."""
    across, up = np.meshgrid(
        (np.arange(11) - 5) * 23.0, (np.arange(12) - 5.5) * 21.0, indexing='ij'
    )
    face = np.column_stack([across.ravel(), up.ravel()])
    beads = []
    for side in range(4):
        chosen = np.sort(rng.permutation(len(face))[: 126 if side < BEADS % 4 else 125])
        flat = face[chosen] + rng.uniform(-3, 3, (len(chosen), 2))
        turn = matrix_from_vector([0, 0, side * np.pi / 2])
        depth = np.full(len(flat), CUBE_MM / 2)
        beads.append(np.column_stack([flat[:, 0], depth, flat[:, 1]]) @ turn.T)
    return np.round(np.concatenate(beads), 6)


def looking_at_origin(position_mm: ArrayLike) -> np.ndarray:
    """Rotation (3, 3) rig -> sensor frame of a source at position_mm (3,) that faces the origin.

    The y axis of the sensor points down.
    """
    z = -np.asarray(position_mm) / np.linalg.norm(position_mm)
    x = np.cross(z, [0.0, 0.0, 1.0])
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z])


def virtual_rig(
    seed: int = 0,
    strength: float = 1.0,
    names: Sequence[str] = ('a', 'b'),
    survey_sd_mm: float = SURVEY_SD_MM,
    between_deg: float = BETWEEN_DEG,
) -> VirtualRig:
    """Draw a rig at random; the same seed gives the same rig.

    Parameters
    ----------
    seed : int
    strength : float
        Factor on the distortion.
    names : sequence of str
        Fluoroscopes, any number.
    survey_sd_mm : float
        Standard deviation of the survey of the phantom.
    between_deg : float
        Angle between neighbouring fluoroscopes. At 84 degrees their sources are some 2 m apart;
        with three fluoroscopes, 60 degrees leave every two of them a good base.
    """
    rng = np.random.default_rng([seed, 1])
    true_mm = bead_coordinates(rng)
    survey = np.round(true_mm + rng.normal(0, survey_sd_mm, true_mm.shape), 4)
    phantom = Phantom(np.arange(1, BEADS + 1), survey, np.full(BEADS, survey_sd_mm))
    fluoroscopes = []
    for number, name in enumerate(names):
        angle = np.deg2rad(between_deg / 2) * (2 * number - (len(names) - 1))
        angle = angle + rng.uniform(-0.03, 0.03)
        position = 1500 * np.array([np.sin(angle), -np.cos(angle), 0]) + rng.uniform(-30, 30, 3)
        tilt = matrix_from_vector(rng.uniform(-0.01, 0.01, 3))
        interior = np.array([511.5, 511.5, 4000.0]) + rng.uniform([-15, -15, -150], [15, 15, 150])
        fluoroscopes.append(
            VirtualFluoroscope(
                name,
                interior,
                tilt @ looking_at_origin(position),
                position,
                random_field(rng, strength),
            )
        )
    return VirtualRig(tuple(fluoroscopes), true_mm, phantom)


EDGE_PX = 512.0  # half the width of an image; the parts of a field are given by their size there
MAX_ITERATIONS = 100  # of the inversion of a field
TOLERANCE_PX = 1e-11  # rounding
RIPPLES = 14  # parts of a random field


@dataclass(frozen=True)
class DistortionField:
    """Correction field: a function of pixels (n, 2) that returns corrections (n, 2) [px]."""

    centre: NDArray[np.float64]  #: (2,) [px]
    #: size at the edge of the image [px]
    pincushion: float
    s_shape: NDArray[np.float64]  #: (2,) size along u and v at the edge of the image [px]
    spiral: float
    #: (k, 5), Gaussian bumps: centre u, v, width, and height along u and v [px]
    ripples: NDArray[np.float64]

    def __call__(self, uv: ArrayLike) -> np.ndarray:
        """Corrections (n, 2) [px] of observed pixels uv (n, 2)."""
        uv = np.asarray(uv, dtype=float)
        x = (uv - self.centre) / EDGE_PX
        r2 = np.sum(x * x, axis=1, keepdims=True)
        turned = np.stack([-x[:, 1], x[:, 0]], axis=1)
        # The S of each line: a cubic that leaves the centre and the point at two thirds in place.
        s = x[:, ::-1] * (x[:, ::-1] ** 2 - 0.4) / 0.6
        out = r2 * (self.pincushion * x + self.spiral * turned) + self.s_shape * s
        along_u, along_v = np.ascontiguousarray(uv.T)  # sums over an axis of two are slow
        for u, v, width, height_u, height_v in self.ripples:
            bump = np.exp(-((along_u - u) ** 2 + (along_v - v) ** 2) / (2 * width**2))
            out[:, 0] += bump * height_u
            out[:, 1] += bump * height_v
        return out

    def distort(self, uv: ArrayLike) -> np.ndarray:
        """Observed pixels (n, 2) of undistorted ones uv (n, 2), by fixed-point iteration."""
        uv = np.asarray(uv, dtype=float)
        observed = uv + self(uv)
        for _ in range(MAX_ITERATIONS):
            last = observed
            observed = uv + self(observed)
            if np.max(np.abs(observed - last), initial=0.0) < TOLERANCE_PX:
                break
        return observed


def random_field(rng: np.random.Generator, strength: float = 1.0) -> DistortionField:
    """Draw a field at random.

    At strength 1 it is some 15 px along the border of the image and 26 to 35 px in its corners.
    """
    sign = rng.choice([-1.0, 1.0], size=4)
    centre = np.asarray(IMAGE_SIZE) / 2 - 0.5 + rng.uniform(-20, 20, 2)
    ripples = np.column_stack(
        [
            rng.uniform(0, IMAGE_SIZE[0], RIPPLES),
            rng.uniform(0, IMAGE_SIZE[1], RIPPLES),
            rng.uniform(70, 130, RIPPLES),
            rng.uniform(-1.2, 1.2, (RIPPLES, 2)),
        ]
    )
    ripples[:, 3:] *= strength
    pincushion = strength * rng.uniform(9.0, 10.2)
    s_shape = strength * sign[:2] * rng.uniform(1.2, 2.4, 2)
    spiral = strength * sign[2] * rng.uniform(1.2, 2.4)
    return DistortionField(centre, pincushion, s_shape, spiral, ripples)


# Of an observed pixel, as target extraction writes it. It also hides differences between CPUs in
# the last bit.
DECIMALS = 4
START_NS = 1_767_225_600_000_000_000  # stamp of the first frame


@dataclass(frozen=True)
class StreamStart:
    """Stamp [ns] and number of the first frame of a stream."""

    stamp_ns: int = START_NS
    number: int = 1

    def frame(
        self,
        fluoroscope: VirtualFluoroscope,
        index: int,
        time_s: float,
        target_id: np.ndarray,
        observed: np.ndarray,
    ) -> Frame:
        """Frame number `index`, counted from 0, at a time after the first one [s].

        target_id (n,) and observed (n, 2) [px] are its image points.
        """
        return Frame(
            fluoroscope=fluoroscope.name,
            number=self.number + index,
            target_id=target_id,
            uv=observed,
            image_size=fluoroscope.image_size,
            sigma=None,
            stamp_ns=self.stamp_ns + round(time_s * 1e9),
            frame_id=f'{fluoroscope.name}_optical',
        )
