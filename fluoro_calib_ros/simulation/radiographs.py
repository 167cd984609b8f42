# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Radiographs of a virtual fluoroscope: X-rays traced through beads and plates of the phantom.

Every grey value is the mean over rays from several points of the focal spot to several points of
the pixel, each attenuated by its path through the spheres (Beer and Lambert). Rays belong to
observed pixels, so the distortion stretches shadows, too. Blur and glare of the detector, quantum
noise and digitisation follow (Rowlands and Yorkston, "Flat panel detectors for digital
radiography", Handbook of Medical Imaging 1, 2000, section 4.3).
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from .rig import CUBE_MM, Pose, VirtualFluoroscope

OVERSAMPLING = 3  # number of rays across a pixel
FOCAL_POINTS = 7  # number of points of the focal spot: one in the middle, the others on a ring
FIELD_RADIUS = 0.485  # radius of a round field, as a fraction of the smaller side of the image
FIELD_MARGIN = 0.03  # margin of a rectangular field, as a fraction of the image size
FIELD_EDGE_PX = 1.5  # softness of the edge of the field
LEAKAGE = 0.004  # light outside the field, as a fraction of the light inside
GLARE_PX = 60.0  # width of the veiling glare
OPEN_BEAM = 0.85  # grey value of the open beam, as a fraction of the maximum
DARK = 0.02  # grey value without light
MARGIN_PX = 3  # margin around the shadow of a bead


@dataclass(frozen=True)
class RadiographSettings:
    """Settings of radiographs."""

    photons: float = 1500.0  #: photons that a pixel of the open beam counts
    bits: int = 16  #: bits of a grey value, 8 or 16
    bead_mm: float = 2.0  #: diameter of the beads [mm], if the phantom gives none
    #: linear attenuation coefficient of a bead [1/mm]; 1.5 is steel at 50 keV (NIST XCOM)
    bead_attenuation: float = 1.5
    #: thickness of the plates that hold the beads [mm], and their attenuation coefficient [1/mm]
    plate_mm: float = 3.0
    plate_attenuation: float = 0.006
    focal_spot_mm: float = 0.6  #: diameter of the focal spot [mm]; 0 for a point, which is faster
    detector_mm: float = 2000.0  #: distance from the source to the detector [mm]
    blur_px: float = 0.8  #: standard deviation of the detector's blur [px]
    glare: float = 0.08  #: fraction of the light that is scattered over long distances
    round_field: bool = True  #: round field of an image intensifier, otherwise rectangular
    clutter: int = 0  #: number of objects in the image that do not belong to the phantom
    inverted: bool = False  #: whether beads are brighter than their surroundings
    #: standard deviation of the blur of the quantum noise [px], which correlates it
    noise_blur_px: float = 0.0


CLEAN = RadiographSettings()
HARD = RadiographSettings(photons=400.0, bits=8, glare=0.15, blur_px=1.0, clutter=8)


class Radiography:
    """Takes radiographs with a virtual fluoroscope."""

    def __init__(
        self, fluoroscope: VirtualFluoroscope, settings: RadiographSettings | None = None
    ) -> None:
        self.fluoroscope = fluoroscope
        self.settings = settings or CLEAN
        width, height = fluoroscope.image_size
        grid = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1)
        self._rays = self._detector_mm(grid.reshape(-1, 2).astype(float)).reshape(height, width, 3)
        self._open_beam = illumination(grid, (width, height), self.settings)
        rays = self._rays.astype(np.float32)
        self._directions = rays / np.linalg.norm(rays, axis=-1, keepdims=True)

    def centres(self, points_mm: NDArray[np.float64], pose: Pose) -> NDArray[np.float64]:
        """Return observed pixels (n, 2) of points of the phantom (n, 3) [mm]."""
        rotation, shift = pose
        return self.fluoroscope.distortion.distort(
            self.fluoroscope.ideal(points_mm @ rotation.T + shift)
        )

    def in_field(self, uv: NDArray[np.float64], margin_px: float = 0.0) -> NDArray[np.bool_]:
        """Return (n,) whether pixels (n, 2) lie in the field, at least margin_px from its edge."""
        return _depth_in_field(uv, self.fluoroscope.image_size, self.settings) > margin_px

    def image(
        self,
        points_mm: NDArray[np.float64],
        pose: Pose,
        seed: int = 0,
        diameter_mm: NDArray[np.float64] | None = None,
        plates: bool = True,
    ) -> np.ndarray:
        """Take a radiograph.

        Parameters
        ----------
        points_mm : ndarray
            (n, 3), centres of the beads in the frame of the phantom.
        pose : Pose
            Pose of the phantom in the rig frame.
        seed : int
            The same seed gives the same noise and clutter.
        diameter_mm : ndarray, optional
            (n,), diameters of the beads; by default that of the settings.
        plates : bool
            Whether to include the four side faces of the cube.

        Returns
        -------
        ndarray
            (h, w) of uint8 or uint16.
        """
        light = self.light(points_mm, pose, seed, diameter_mm, plates)
        return _digitised(light, self.settings, np.random.default_rng([seed, 12]))

    def light(
        self,
        points_mm: NDArray[np.float64],
        pose: Pose,
        seed: int = 0,
        diameter_mm: NDArray[np.float64] | None = None,
        plates: bool = True,
    ) -> np.ndarray:
        """Return the light (h, w) that reaches the detector, 1 in the open beam, without noise.

        The parameters are those of `image`.
        """
        settings = self.settings
        rng = np.random.default_rng([seed, 11])
        rotation, shift = pose
        to_sensor = self.fluoroscope.rotation @ rotation
        origin = self.fluoroscope.rotation @ (shift - self.fluoroscope.position_mm)
        if diameter_mm is None:
            diameter_mm = np.full(len(points_mm), settings.bead_mm)
        light = self._beads(
            points_mm @ to_sensor.T + origin, self.centres(points_mm, pose), diameter_mm / 2
        )
        if plates:
            light *= self._plates(to_sensor, origin)
        if settings.clutter:
            light *= clutter(rng, light.shape, settings.clutter)
        light *= self._open_beam
        return detected(light, settings)

    def _detector_mm(self, uv: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return detector points (n, 3) in the sensor frame [mm] for observed pixels (n, 2)."""
        xp, yp, c = self.fluoroscope.interior
        ideal = uv - self.fluoroscope.distortion(uv)
        scaled = (ideal - (xp, yp)) * (self.settings.detector_mm / c)
        return np.column_stack([scaled, np.full(len(uv), self.settings.detector_mm)])

    def _beads(
        self,
        sensor_mm: NDArray[np.float64],
        uv: NDArray[np.float64],
        radius_mm: NDArray[np.float64],
    ) -> np.ndarray:
        """Return transmission (h, w) of beads: sensor frame (n, 3) [mm], pixels (n, 2), radii."""
        width, height = self.fluoroscope.image_size
        factor = OVERSAMPLING
        reach = radius_mm * self.fluoroscope.interior[2] / sensor_mm[:, 2] * 1.15 + MARGIN_PX
        low = np.floor(uv - reach[:, None]).astype(int)
        count = 2 * int(np.ceil(reach.max(initial=1.0))) + 2
        # Exclude shadows that do not touch the image; cut the others at its edge.
        seen = np.flatnonzero(((low < (width, height)) & (low + count > 0)).all(axis=1))
        detector = self._patches_mm(low[seen], count)
        total_transmission = np.zeros((height, width), dtype=np.float32)
        spots = focal_spot(self.settings.focal_spot_mm)
        for spot in spots:
            transmission = np.ones(
                ((height + 2 * count) * factor, (width + 2 * count) * factor), dtype=np.float32
            )
            path = chords(sensor_mm[seen, None] - spot, detector - spot, radius_mm[seen, None])
            patches = np.exp(-self.settings.bead_attenuation * path).astype(np.float32)
            patches = patches.reshape(len(seen), count * factor, count * factor)
            for (column, row), patch in zip((low[seen] + count) * factor, patches):
                transmission[row : row + count * factor, column : column + count * factor] *= patch
            inner = transmission[
                count * factor : -count * factor, count * factor : -count * factor
            ]
            total_transmission += cv2.resize(inner, (width, height), interpolation=cv2.INTER_AREA)
        return total_transmission / len(spots)

    def _patches_mm(self, low: NDArray[np.int64], count: int) -> NDArray[np.float64]:
        """Return points (n, k, 3) of the detector [mm] where rays meet patches of `count` pixels.

        low (n, 2) are the first pixels of the patches. The points are interpolated linearly
        between pixels: the distortion bends by less than 1e-4 px from one pixel to the next.
        """
        factor = OVERSAMPLING
        offsets = np.arange(-1, count + 1)
        pixels = low[:, None, None] + np.stack(np.meshgrid(offsets, offsets), axis=-1)
        coarse = self._detector_mm(pixels.reshape(-1, 2).astype(float))
        coarse = coarse.reshape(len(low), count + 2, count + 2, 3)
        positions = (np.arange(count * factor) + 0.5) / factor - 0.5
        weight = np.maximum(1 - np.abs(positions[:, None] - offsets), 0)  # (fine, coarse)
        rows = np.tensordot(weight, coarse, axes=(1, 1))  # (fine, n, coarse, 3)
        detector_points = np.tensordot(weight, rows, axes=(1, 2))  # (fine across, fine down, n, 3)
        return detector_points.transpose(2, 1, 0, 3).reshape(len(low), (count * factor) ** 2, 3)

    def _plates(
        self, rotation: NDArray[np.float64], origin: NDArray[np.float64]
    ) -> NDArray[np.float32]:
        """Return transmission (h, w) of the four plates of the cube.

        rotation (3, 3) and origin (3,) [mm] transform points of the phantom to the sensor frame.
        """
        source = -origin @ rotation
        source = source.astype(np.float32)
        rays = self._directions.reshape(-1, 3) @ rotation.astype(np.float32)
        rays = rays.reshape(self._directions.shape)
        half = CUBE_MM / 2
        thickness = self.settings.plate_mm
        path = np.zeros(rays.shape[:2], dtype=np.float32)
        for axis in (0, 1):
            for side in (-1, 1):
                low = np.full(3, -half, dtype=np.float32)
                high = np.full(3, half, dtype=np.float32)
                low[axis], high[axis] = sorted((side * half, side * (half + thickness)))
                path += _path_in_box(source, rays, low, high)
        return np.exp(-self.settings.plate_attenuation * path).astype(np.float32)


def focal_spot(diameter_mm: float) -> NDArray[np.float64]:
    """Return points (k, 3) of a uniform disc: centre, and a ring that gives its second moment."""
    if not diameter_mm:
        return np.zeros((1, 3))
    angle = np.arange(FOCAL_POINTS - 1) * 2 * np.pi / (FOCAL_POINTS - 1)
    ring = diameter_mm / 4 * np.sqrt(2 * FOCAL_POINTS / (FOCAL_POINTS - 1))
    circle = ring * np.column_stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)])
    return np.concatenate([np.zeros((1, 3)), circle])


def chords(
    centre: NDArray[np.float64], ray: NDArray[np.float64], radius: np.ndarray
) -> NDArray[np.float64]:
    """Return lengths of rays from the origin inside spheres; arguments broadcast, last axis 3."""
    x, y, z = np.moveaxis(ray, -1, 0)
    a, b, c = np.moveaxis(centre, -1, 0)
    projection_squared = (a * x + b * y + c * z) ** 2 / (x * x + y * y + z * z)
    return 2 * np.sqrt(np.maximum(radius**2 - (a * a + b * b + c * c) + projection_squared, 0))


def _path_in_box(
    source: np.ndarray,
    rays: NDArray[np.float32],
    low: NDArray[np.float32],
    high: NDArray[np.float32],
) -> NDArray[np.float32]:
    """Return lengths (h, w) of rays (h, w, 3) of unit length inside a box, by the slab method."""
    direction = np.where(np.abs(rays) < 1e-12, rays.dtype.type(1e-12), rays)
    first = (low - source) / direction
    second = (high - source) / direction
    enter = np.minimum(first, second)
    leave = np.maximum(first, second)
    last_in = np.maximum(np.maximum(enter[..., 0], enter[..., 1]), enter[..., 2])
    first_out = np.minimum(np.minimum(leave[..., 0], leave[..., 1]), leave[..., 2])
    return np.maximum(first_out - last_in, 0)


def _depth_in_field(
    uv: np.ndarray, image_size: tuple[int, int], settings: RadiographSettings
) -> NDArray[np.float64]:
    """Return distances [px] of pixels (..., 2) from the edge of the field, negative outside."""
    size = np.asarray(image_size)
    from_centre = uv - (size - 1) / 2
    if settings.round_field:
        return FIELD_RADIUS * min(image_size) - np.linalg.norm(from_centre, axis=-1)
    return np.min(size * (0.5 - FIELD_MARGIN) - np.abs(from_centre), axis=-1)


def illumination(
    uv: NDArray[np.int64], image_size: tuple[int, int], settings: RadiographSettings
) -> NDArray[np.float32]:
    """Return the open beam (h, w), 0 to 1, at pixels (h, w, 2); darker at the border and anode."""
    x = (uv - (np.asarray(image_size) - 1) / 2) / (max(image_size) / 2)
    light = 1 - 0.16 * np.sum(x * x, axis=-1) + 0.06 * x[..., 0] - 0.05 * x[..., 1] ** 3
    depth = _depth_in_field(uv, image_size, settings)
    field = 1 / (1 + np.exp(-np.clip(depth / FIELD_EDGE_PX, -40, 40)))
    return (light * (LEAKAGE + (1 - LEAKAGE) * field)).astype(np.float32)


def clutter(rng: np.random.Generator, shape: tuple[int, ...], count: int) -> NDArray[np.float32]:
    """Return transmission (h, w) of cables, bone-like shadows, screws and specks."""
    height, width = shape
    size = np.array([width, height])
    transmission = np.ones(shape, dtype=np.float32)
    for number in range(count):
        depth = np.zeros(shape, dtype=np.float32)
        kind = number % 4
        centre = rng.uniform(0.1, 0.9, 2) * size
        if kind == 0:  # a cable
            ends = rng.uniform(0, 1, (4, 2)) * size
            t = np.linspace(0, 1, 60)[:, None]
            curve = (
                (1 - t) ** 3 * ends[0]
                + 3 * t * (1 - t) ** 2 * ends[1]
                + 3 * t**2 * (1 - t) * ends[2]
                + t**3 * ends[3]
            )
            points = np.round(curve * 8).astype(np.int32)
            thickness = int(rng.integers(3, 9))
            cv2.polylines(depth, [points], False, float(rng.uniform(0.2, 0.9)), thickness, 16, 3)
        elif kind == 1:  # a bone
            axes = rng.uniform(0.05, 0.3, 2) * size
            angle_deg = float(rng.uniform(0, 180))
            box = (tuple(map(float, centre)), tuple(map(float, axes)), angle_deg)
            cv2.ellipse(depth, box, float(rng.uniform(0.3, 0.8)), -1, 16)
            depth = cv2.GaussianBlur(depth, (0, 0), float(rng.uniform(1.5, 6)))
        elif kind == 2:  # screws
            for _ in range(3):
                position = np.round((centre + rng.normal(0, 40, 2)) * 8).astype(int)
                radius = round(8 * rng.uniform(4.5, 11))
                cv2.circle(depth, tuple(map(int, position)), radius, 2.5, -1, 16, 3)
        else:  # specks, smaller than a bead
            for _ in range(12):
                position = np.round(rng.uniform(0, 1, 2) * size * 8).astype(int)
                radius = round(8 * rng.uniform(0.4, 1.3))
                cv2.circle(depth, tuple(map(int, position)), radius, 0.8, -1, 16, 3)
        transmission *= np.exp(-depth)
    return transmission


def detected(light: NDArray[np.float32], settings: RadiographSettings) -> NDArray[np.float32]:
    """Return light (h, w) after blur and glare of the detector."""
    sharp = cv2.GaussianBlur(light, (0, 0), settings.blur_px) if settings.blur_px else light
    if not settings.glare:
        return sharp
    reduced = cv2.resize(light, None, fx=0.125, fy=0.125, interpolation=cv2.INTER_AREA)
    glare = cv2.GaussianBlur(reduced, (0, 0), GLARE_PX / 8, borderType=cv2.BORDER_REPLICATE)
    glare = cv2.resize(glare, light.shape[::-1], interpolation=cv2.INTER_CUBIC)
    return (1 - settings.glare) * sharp + settings.glare * glare


def _digitised(
    light: NDArray[np.float32], settings: RadiographSettings, rng: np.random.Generator
) -> np.ndarray:
    """Return grey values (h, w) of light from 0 to 1, with quantum noise."""
    expected = np.maximum(light, 0) * settings.photons
    counts = rng.poisson(expected).astype(np.float32)
    if settings.noise_blur_px:
        noise = cv2.GaussianBlur(
            (counts - expected).astype(np.float32), (0, 0), settings.noise_blur_px
        )
        counts = expected + noise
    return grey_of_counts(counts, settings)


def grey_of_counts(counts: NDArray[np.float32], settings: RadiographSettings) -> np.ndarray:
    """Return grey values (h, w) of numbers of photons (h, w)."""
    largest = 2**settings.bits - 1
    grey = largest * (DARK + (OPEN_BEAM - DARK) * counts / settings.photons)
    if settings.inverted:
        grey = largest - grey
    dtype = np.uint8 if settings.bits == 8 else np.uint16
    return np.clip(np.rint(grey), 0, largest).astype(dtype)
