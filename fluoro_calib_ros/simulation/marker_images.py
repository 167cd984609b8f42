# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Radiographs of moving markers: beads in bones that move during the exposure.

Rays from several points of the focal spot, at several moments of the exposure, are traced through
the beads, as in `radiographs`. Bones are hollow ellipsoids that move with their cluster of beads.
Metal discs hide beads for a while; cables, screws and specks are optional. Only the surroundings
of the beads are traced at full resolution.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray

from ..photogrammetry.rotations import matrix_from_vector
from .radiographs import (
    MARGIN_PX,
    RadiographSettings,
    Radiography,
    chords,
    clutter,
    detected,
    focal_spot,
    grey_of_counts,
)
from .rig import VirtualFluoroscope, VirtualRig

FINE = 4  # number of rays across a pixel
MOMENTS = 5  # number of moments of an exposure
SPOT_POINTS = 3  # number of focal spot points at each moment; they alternate between moments
BONE_STEP = 2  # pixels between rays through bones
BONE_ATTENUATION = 0.028  # attenuation of compact bone minus that of soft tissue [1/mm]
HIDING = 0.02  # fraction of light that passes a metal disc
HIDING_PX = (7.0, 11.0)  # range of the radius of such a disc
HIDDEN_FRAMES = (3, 25)  # range of the number of images in which a bead is hidden
FIRST_ID = 1001  # first marker id


@dataclass(frozen=True)
class MarkerScene:
    """Content of a scene in front of the fluoroscopes."""

    #: number of rigid clusters, and number of markers in each
    clusters: int = 5
    markers: int = 6
    diameters_mm: tuple[float, ...] = (0.8, 1.0)  #: diameters of markers, drawn at random
    #: linear attenuation coefficient of a marker [1/mm]; 7 is tantalum at 55 keV (NIST XCOM)
    attenuation: float = 7.0
    spread_mm: float = 20.0  #: half the size of a cluster
    #: half the size of the volume in which the centres of the clusters move
    apart_mm: float = 110.0
    speed_mm: float = 0.6  #: typical motion of a cluster between successive images
    hidden: float = 0.05  #: share of images in which a marker is hidden
    bones: bool = True  #: whether each cluster is inside a bone
    shutter: float = 0.4  #: exposure time, as a fraction of the time between two images


MARKER_SETTINGS = RadiographSettings(photons=1500.0, bits=16, glare=0.08)
HARD_MARKER_SETTINGS = RadiographSettings(
    photons=500.0, bits=8, glare=0.15, blur_px=1.0, clutter=8, noise_blur_px=0.5
)


@dataclass(frozen=True)
class MarkerImage:
    """A radiograph of moving markers, with ground truth."""

    image: np.ndarray  #: (h, w)
    uv: NDArray[np.float64]  #: (n, 2) true centres in the middle of the exposure [px]
    seen: NDArray[np.bool_]  #: (n,) False for markers that are hidden or outside the field
    mean_uv: NDArray[np.float64]  #: (n, 2) mean of the true centres over the exposure [px]


@dataclass(frozen=True)
class _Disc:
    """A metal disc that hides a marker from a fluoroscope in some images."""

    marker: int
    first: float
    last: float
    radius_px: float
    drift: NDArray[np.float64]  # motion from its middle to its end [px]


class MovingMarkers:
    """Rigid clusters of markers in motion.

    seed: the same seed gives the same motion.
    """

    def __init__(self, scene: MarkerScene, seed: int = 0) -> None:
        self.scene = scene
        rng = np.random.default_rng([seed, 21])
        n = scene.clusters * scene.markers
        self.target_id = np.arange(FIRST_ID, FIRST_ID + n)  #: (n,)
        #: (n,) cluster number of each marker
        self.cluster = np.repeat(np.arange(scene.clusters), scene.markers)
        self.local_mm = _spread(rng, scene)  #: (n, 3) markers in the frame of their cluster
        self.diameter_mm = rng.choice(scene.diameters_mm, n)
        # Sum of three sinusoids for each coordinate and angle: (cluster, 6, 3).
        shape = (scene.clusters, 6, 3)
        self._amplitude = rng.uniform(0.3, 1.0, shape)
        self._amplitude[:, :3] *= scene.apart_mm / 1.8
        self._amplitude[:, 3:] *= 0.35
        frequency = rng.uniform(0.5, 1.5, shape)
        self._phase = rng.uniform(0, 2 * np.pi, shape)
        # Scaled such that the clusters have the given speed.
        speed = np.sqrt(0.5 * ((self._amplitude * frequency)[:, :3] ** 2).sum(axis=(1, 2)))
        self._frequency = frequency * scene.speed_mm / np.median(speed)
        angle = rng.uniform(-1.0, 1.0, (scene.clusters, 3))
        self._turn = np.array([matrix_from_vector(vector) for vector in angle])

    def poses(self, frame: float) -> list[tuple[NDArray[np.float64], NDArray[np.float64]]]:
        """Return rotations (3, 3) and shifts (3,) [mm] of all clusters at an image number."""
        angle = 2 * self._frequency * frame / 2 + self._phase
        values = (self._amplitude * np.sin(angle)).sum(axis=2)
        return [
            (matrix_from_vector(value[3:]) @ turn, value[:3])
            for value, turn in zip(values, self._turn)
        ]

    def points_mm(self, frame: float) -> NDArray[np.float64]:
        """Return markers (n, 3) in the rig frame at an image number."""
        points = np.empty_like(self.local_mm)
        for number, (rotation, shift) in enumerate(self.poses(frame)):
            rows = self.cluster == number
            points[rows] = self.local_mm[rows] @ rotation.T + shift
        return points


def _spread(rng: np.random.Generator, scene: MarkerScene) -> NDArray[np.float64]:
    """Return markers (n, 3) of all clusters [mm], none of them close to another of its cluster."""
    positions = []
    for _ in range(scene.clusters):
        cluster: list[NDArray[np.float64]] = []
        while len(cluster) < scene.markers:
            point = rng.uniform(-1, 1, 3) * scene.spread_mm * np.array([0.5, 0.5, 1.0])
            if all(np.linalg.norm(point - other) > 0.25 * scene.spread_mm for other in cluster):
                cluster.append(point)
        positions += cluster
    return np.array(positions)


class MarkerRadiography(Radiography):
    """Takes radiographs of moving markers with one fluoroscope.

    frames: length of the sequence over which markers are hidden.
    """

    def __init__(
        self,
        fluoroscope: VirtualFluoroscope,
        markers: MovingMarkers,
        settings: RadiographSettings | None = None,
        frames: int = 100,
        seed: int = 0,
    ) -> None:
        super().__init__(fluoroscope, settings or MARKER_SETTINGS)
        self.markers = markers
        self.seed = seed
        name = sum(fluoroscope.name.encode())
        rng = np.random.default_rng([seed, 22, name])
        self._discs = _discs(rng, markers, frames)
        if self.settings.clutter:
            self._open_beam *= clutter(rng, self._open_beam.shape, self.settings.clutter)
        self._plane = self._rays[..., :2].astype(np.float32)
        coarse = self._rays[::BONE_STEP, ::BONE_STEP].reshape(-1, 3)
        coarse = coarse / np.linalg.norm(coarse, axis=1, keepdims=True)
        self._coarse = np.ascontiguousarray(coarse.T, dtype=np.float32)

    def take(self, frame: int) -> MarkerImage:
        """Take the radiograph with an image number; the same number gives the same image."""
        rng = np.random.default_rng([self.seed, 23, frame])
        light, uv, hidden = self._light(frame, np.arange(len(self.markers.target_id)))
        image = self._grey(detected(light, self.settings), rng)
        true_uv = self._true(frame)
        return MarkerImage(image, true_uv, self.in_field(true_uv, 6.0) & ~hidden, uv.mean(axis=0))

    def _light(
        self,
        frame: int,
        rows: NDArray[np.int64],
        shift_mm: tuple[float, float, float] = (0.0, 0.0, 0.0),
    ) -> tuple[NDArray[np.float32], NDArray[np.float64], NDArray[np.bool_]]:
        """Return light (h, w) before the detector, centres (moments, n, 2), hidden mask (n,).

        Only markers in rows (k,) are traced; all are shifted by shift_mm in the rig frame.
        """
        scene = self.markers.scene
        moments = frame + scene.shutter * ((np.arange(MOMENTS) + 0.5) / MOMENTS - 0.5)
        points = np.array([self.markers.points_mm(moment) for moment in moments])
        points += np.asarray(shift_mm)
        unit_pose = (np.eye(3), np.zeros(3))
        uv = np.array([self.centres(moment_points, unit_pose) for moment_points in points])
        light = self._open_beam.copy()
        if scene.bones:
            light *= self._bones(self.markers.poses(frame))
        self._trace(light, points[:, rows], uv[:, rows], self.markers.diameter_mm[rows] / 2)
        return light, uv, self._hide(light, frame, self._true(frame, shift_mm))

    def _true(
        self, frame: int, shift_mm: tuple[float, float, float] = (0.0, 0.0, 0.0)
    ) -> NDArray[np.float64]:
        """Return true centres (n, 2) in the middle of an exposure, for shifted markers."""
        points = self.markers.points_mm(frame) + np.asarray(shift_mm)
        return self.centres(points, (np.eye(3), np.zeros(3)))

    def _trace(
        self,
        light: NDArray[np.float32],
        points: NDArray[np.float64],
        uv: NDArray[np.float64],
        radius: NDArray[np.float64],
    ) -> None:
        """Multiply the light (h, w) by the transmission of markers (moments, k, 3) at uv."""
        fluoroscope = self.fluoroscope
        sensor = (points - fluoroscope.position_mm) @ fluoroscope.rotation.T
        reach = radius * fluoroscope.interior[2] / sensor[0, :, 2] * 1.15 + MARGIN_PX
        low = np.floor(uv.min(axis=0) - reach[:, None]).astype(int)
        high = np.ceil(uv.max(axis=0) + reach[:, None]).astype(int) + 1
        low = np.maximum(low, 0)
        high = np.minimum(high, fluoroscope.image_size)
        spots = focal_spot(self.settings.focal_spot_mm)
        is_point = len(spots) == 1
        for rows, (u0, v0), (u1, v1) in _regions(low, high):
            column = (np.arange((u1 - u0) * FINE) + 0.5) / FINE - 0.5 + u0
            row = (np.arange((v1 - v0) * FINE) + 0.5) / FINE - 0.5 + v0
            grid = np.meshgrid(column.astype(np.float32), row.astype(np.float32))
            plane = cv2.remap(self._plane, *grid, cv2.INTER_LINEAR, None, cv2.BORDER_REPLICATE)
            # Squares of metres minus squares of millimetres: single precision is not enough.
            detector = np.dstack([plane, np.full(grid[0].shape, self.settings.detector_mm)])
            total_transmission = np.zeros_like(grid[0])
            for number, centres in enumerate(sensor):
                for spot in spots if is_point else spots[1 + number % 2 :: 2][:SPOT_POINTS]:
                    transmission = np.ones_like(total_transmission)
                    for bead in rows:
                        # Only around the bead: regions of several beads are large.
                        window = tuple(
                            slice((a - b) * FINE, (c - b) * FINE)
                            for a, b, c in zip(low[bead][::-1], (v0, u0), high[bead][::-1])
                        )
                        path = chords(centres[bead] - spot, detector[window] - spot, radius[bead])
                        transmission[window] *= np.exp(-self.markers.scene.attenuation * path)
                    total_transmission += transmission
            coarse = cv2.resize(
                total_transmission, (u1 - u0, v1 - v0), interpolation=cv2.INTER_AREA
            )
            light[v0:v1, u0:u1] *= coarse / (MOMENTS * (1 if is_point else SPOT_POINTS))

    def _bones(
        self, poses: list[tuple[NDArray[np.float64], NDArray[np.float64]]]
    ) -> NDArray[np.float32]:
        """Return transmission (h, w) of the bones around the clusters."""
        fluoroscope = self.fluoroscope
        size = self.markers.scene.spread_mm
        path = np.zeros(self._coarse.shape[1], dtype=np.float32)
        for rotation, shift in poses:
            to_bone = (fluoroscope.rotation @ rotation).T
            source = rotation.T @ (fluoroscope.position_mm - shift)
            for factor, sign in ((1.0, 1.0), (0.78, -1.0)):
                axes = factor * size * np.array([0.75, 0.75, 2.2])
                direction = (to_bone / axes[:, None]).astype(np.float32) @ self._coarse
                path += np.float32(sign) * _ellipsoid_path(source / axes, direction)
        shape = self._plane[::BONE_STEP, ::BONE_STEP].shape[:2]
        transmission = np.exp(-BONE_ATTENUATION * path).astype(np.float32).reshape(shape)
        height, width = self._plane.shape[:2]
        # The coarse pixels are samples at multiples of the step, not area means.
        coordinates = np.meshgrid(
            np.arange(width, dtype=np.float32) / BONE_STEP,
            np.arange(height, dtype=np.float32) / BONE_STEP,
        )
        return cv2.remap(transmission, *coordinates, cv2.INTER_LINEAR, None, cv2.BORDER_REPLICATE)

    def _hide(
        self, light: NDArray[np.float32], frame: int, true: NDArray[np.float64]
    ) -> NDArray[np.bool_]:
        """Draw the metal discs of an image; return a mask (n,) of the markers that they hide."""
        hidden = np.zeros(len(true), dtype=bool)
        for disc in self._discs:
            if not disc.first <= frame <= disc.last:
                continue
            middle = 0.5 * (disc.first + disc.last)
            fraction = (frame - middle) / max(disc.last - middle, 1.0)
            centre = true[disc.marker] + fraction * disc.drift
            mask = np.zeros(light.shape, dtype=np.uint8)
            pixel = np.round(centre * 8).astype(int)
            cv2.circle(mask, tuple(map(int, pixel)), round(disc.radius_px * 8), 255, -1, 16, 3)
            light *= 1 - (1 - HIDING) * (mask / np.float32(255))
            hidden |= np.linalg.norm(true - centre, axis=1) < disc.radius_px + 2.5
        return hidden

    def _grey(self, light: NDArray[np.float32], rng: np.random.Generator) -> np.ndarray:
        """Return grey values (h, w) of light from 0 to 1; many photons have Gaussian noise."""
        settings = self.settings
        expected = np.maximum(light, 0).astype(np.float32) * np.float32(settings.photons)
        noise = rng.standard_normal(expected.shape, dtype=np.float32) * np.sqrt(expected)
        if settings.noise_blur_px:
            noise = cv2.GaussianBlur(noise, (0, 0), settings.noise_blur_px)
        return grey_of_counts(expected + noise, settings)


def _regions(
    low: NDArray[np.int64], high: NDArray[np.int64]
) -> Iterator[tuple[list[int], tuple[int, int], tuple[int, int]]]:
    """Yield rows and corners of boxes low (n, 2) to high (n, 2); touching boxes are merged."""
    boxes = [
        ([number], a.copy(), b.copy())
        for number, (a, b) in enumerate(zip(low, high))
        if (b > a).all()
    ]
    merged = True
    while merged:
        merged = False
        for first in range(len(boxes)):
            for second in range(first + 1, len(boxes)):
                _, a0, a1 = boxes[first]
                rows, b0, b1 = boxes[second]
                if (a0 < b1).all() and (b0 < a1).all():
                    merged_rows = boxes[first][0] + rows
                    boxes[first] = (merged_rows, np.minimum(a0, b0), np.maximum(a1, b1))
                    del boxes[second]
                    merged = True
                    break
            if merged:
                break
    for rows, a, b in boxes:
        yield rows, (int(a[0]), int(a[1])), (int(b[0]), int(b[1]))


def _ellipsoid_path(
    source: NDArray[np.float64], direction: NDArray[np.float32]
) -> NDArray[np.float32]:
    """Return lengths (n,) of rays in an ellipsoid scaled to the unit sphere; directions (3, n)."""
    x, y, z = direction
    a = x * x + y * y + z * z
    b = source.astype(np.float32) @ direction
    c = np.float32(source @ source - 1)
    return 2 * np.sqrt(np.maximum(b * b - a * c, 0)) / a


def _discs(rng: np.random.Generator, markers: MovingMarkers, frames: int) -> list[_Disc]:
    """Draw when markers are hidden, excluding the first images."""
    discs = []
    mean = 0.5 * sum(HIDDEN_FRAMES)
    count = rng.poisson(markers.scene.hidden * frames * len(markers.target_id) / mean)
    for _ in range(count):
        length = rng.integers(*HIDDEN_FRAMES)
        first = rng.uniform(3, max(frames, 4))
        angle = rng.uniform(0, 2 * np.pi)
        radius = rng.uniform(*HIDING_PX)
        drift = radius * np.array([np.cos(angle), np.sin(angle)])
        marker = int(rng.integers(len(markers.target_id)))
        discs.append(
            _Disc(
                marker,
                first=first,
                last=first + length,
                radius_px=radius,
                drift=drift,
            )
        )
    return discs


@dataclass(frozen=True)
class MarkerSequence:
    """Radiographs of moving markers with all fluoroscopes of a rig, taken one after the other."""

    rig: VirtualRig
    markers: MovingMarkers
    settings: RadiographSettings = field(default_factory=lambda: MARKER_SETTINGS)
    frames: int = 100
    seed: int = 0

    def __iter__(self) -> Iterator[Mapping[str, MarkerImage]]:
        """Yield the images of each moment, by fluoroscope."""
        radiographies = {
            fluoroscope.name: MarkerRadiography(
                fluoroscope, self.markers, self.settings, self.frames, self.seed
            )
            for fluoroscope in self.rig.fluoroscopes
        }
        for frame in range(1, self.frames + 1):
            yield {name: radiography.take(frame) for name, radiography in radiographies.items()}
