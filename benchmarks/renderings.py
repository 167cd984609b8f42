# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Extraction from renderings of usual phantoms.

    python -m benchmarks.renderings --images 20                 all rows, printed as a table
    python -m benchmarks.renderings --rows cube-24 --pictures DIR
    python -m benchmarks.renderings --records FILE              what became of each image
    python -m benchmarks.renderings --records FILE --page docs/how_good/real_radiographs.md

The renderer shares no code with the package. A ray from the source to each of 3 x 3 points of a
pixel is attenuated along its chords through spheres and plates (Beer and Lambert). Light is
scattered, blurred by focus and detector, counted
(Poisson) and digitised. Distances of found centres from projected centres count, so the shift of
a shadow against its centre (an ellipse) is part of the error.
"""

from __future__ import annotations

import argparse
import json
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import product
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from fluoro_calib_ros.errors import DataError
from fluoro_calib_ros.images.extraction import Extraction, extract_beads
from fluoro_calib_ros.images.matching import PhantomModel
from fluoro_calib_ros.images.overlay import draw_overlay
from fluoro_calib_ros.images.view import Lens
from tools.sections import show_section

SIZE = 1024  # [px]
PRINCIPAL_PX = 4500.0
DISTANCE_MM = 900.0
STEEL_PER_MM = 0.55  # attenuation at some 70 keV
ACRYLIC_PER_MM = 0.022
BONE_PER_MM = 0.05
SHEET_MM = 1.5
ENLARGED = 1.4  # diameter of an enlarged hole over that of the others
SUB = 3  # points of a pixel in each direction
WRONG_PX = 3.0  # an observation farther from its bead is that of another
FOUND = 0.5  # share of the visible beads from which an image counts as found
IN_TIME_S = 5.0  # CPU time in which an image without the phantom is to be refused
TARGETS = (
    '| target | found | seen | wrong ids | largest error | > 0.5 px | > 5 sd | NSE | s '
    '| slowest | refused |',
    '| --- | --- | --- | --- | --- | --- | --- | --- | --- | --- | --- |',
)
NEGATIVES = (
    '| image | found | s | slowest | within 5 s | refused |',
    '| --- | --- | --- | --- | --- | --- |',
)


@dataclass(frozen=True)
class Target:
    """A phantom: beads (n, 3) [mm] and their diameters (n,) [mm]; empty for no phantom."""

    xyz: NDArray[np.float64]
    diameter: NDArray[np.float64]


@dataclass(frozen=True)
class Row:
    """A row of the table: a phantom by a seed, and what the image suffers.

    Attributes
    ----------
    target : callable
        Takes a random generator, returns a Target.
    photons : float
        A pixel, where nothing absorbs.
    gain : float
        Grey values of the unattenuated light; above 255 the background is clipped.
    plates : int
        Acrylic plates in random places, seen from the edge in some poses.
    faces : float
        Half the distance between the six plates of a box [mm], 0 for none.
    jpeg : int
        Quality, 0 for none.
    unsharp : float
        Strength of an unsharp mask.
    bone : bool
    told : bool
        Diameters are known to the extraction.
    distortion_px : float
    holes : bool
        The places of the target are holes of a plate.
    regular : bool
        Any place on the lattice will do.
    tilt_deg : float
        Largest angle between the axis of the target and that of the fluoroscope; 180: any.
    anatomy : str
        'hand' or 'spine' in the beam.
    wanted : callable, optional
        The phantom that is looked for, where it is another one than the target.
    """

    target: Callable[[np.random.Generator], Target]
    photons: float = 1500.0
    gain: float = 200.0
    plates: int = 0
    faces: float = 0.0
    jpeg: int = 0
    unsharp: float = 0.0
    bone: bool = False
    told: bool = False
    holes: bool = False
    regular: bool = False
    distortion_px: float = 8.0
    tilt_deg: float = 180.0
    anatomy: str = ''
    wanted: Callable[[np.random.Generator], Target] | None = None


def cube(beads: int, side: float = 60.0, diameter: float = 3.0) -> Callable[..., Target]:
    """Beads in four layers of a cube, each in a place of its own."""

    def drawn(rng: np.random.Generator) -> Target:
        layer = np.arange(beads) % 4
        xyz = np.empty((0, 3))
        while len(xyz) < beads:
            place = rng.uniform(-side / 2, side / 2, 2)
            z = (layer[len(xyz)] / 3 - 0.5) * side
            new = np.append(place, z)
            if not len(xyz) or np.linalg.norm(xyz - new, axis=1).min() > 2.5 * diameter:
                xyz = np.vstack([xyz, new])
        return Target(xyz, np.full(beads, diameter))

    return drawn


def lego(beads: int, diameter: float = 3.2) -> Callable[..., Target]:
    """Beads on studs of bricks: 8 mm apart, at heights of 9.6 mm."""

    def drawn(rng: np.random.Generator) -> Target:
        studs = np.array([(x, y, z) for x in range(9) for y in range(9) for z in range(6)])
        chosen = rng.permutation(len(studs))[:beads]
        xyz = (studs[chosen] - (4, 4, 2.5)) * (8.0, 8.0, 9.6)
        return Target(xyz, np.full(beads, diameter))

    return drawn


def three_sizes(beads: int) -> Callable[..., Target]:
    """A cube with beads of 2, 3 and 4 mm."""

    def drawn(rng: np.random.Generator) -> Target:
        one = cube(beads, 80.0, 4.0)(rng)
        return Target(one.xyz, rng.choice([2.0, 3.0, 4.0], beads))

    return drawn


def sheet(
    count: int, pitch: float, hexagonal: bool, marks: int, enlarged: bool = False
) -> Callable[..., Target]:
    """A perforated sheet, some of its holes blocked or larger than the others."""

    def drawn(rng: np.random.Generator) -> Target:
        i, j = np.mgrid[:count, :count].reshape(2, -1) - (count - 1) / 2
        x = pitch * (i + 0.5 * (j % 2)) if hexagonal else pitch * i
        y = pitch * j * (np.sqrt(3) / 2 if hexagonal else 1.0)
        kept = np.ones(count**2, dtype=bool)
        near = np.flatnonzero(np.hypot(x, y) < 0.3 * count * pitch)
        marked = rng.permutation(near)[:marks]
        diameter = np.full(count**2, 0.45 * pitch)
        diameter[marked] *= ENLARGED
        kept[marked] = enlarged
        xyz = np.column_stack([x, y, np.zeros_like(x)])
        return Target(xyz[kept], diameter[kept])

    return drawn


def frame(beads: int, side: float = 140.0, diameter: float = 2.0) -> Callable[..., Target]:
    """Beads on the six faces of a cube."""

    def drawn(rng: np.random.Generator) -> Target:
        xyz = np.empty((0, 3))
        while len(xyz) < beads:
            new = rng.uniform(-side / 2, side / 2, 3)
            new[rng.integers(3)] = rng.choice([-1, 1]) * side / 2
            if not len(xyz) or np.linalg.norm(xyz - new, axis=1).min() > 2.5 * diameter:
                xyz = np.vstack([xyz, new])
        return Target(xyz, np.full(beads, diameter))

    return drawn


def nothing(_: np.random.Generator) -> Target:
    """No phantom."""
    return Target(np.empty((0, 3)), np.empty(0))


ROWS: dict[str, Row] = {
    **{f'cube-{n}': Row(cube(n)) for n in (24, 36, 48, 52, 56, 64)},
    **{f'lego-{n}': Row(lego(n)) for n in (24, 36, 48, 64)},
    'cube-36 small beads': Row(cube(36, diameter=1.5)),
    'cube-48 large beads': Row(cube(48, 90.0, 7.0)),
    'cube-36 clipped': Row(cube(36), gain=420.0),
    'cube-36 3 % dose': Row(cube(36), photons=45.0),
    'cube-36 JPEG 15': Row(cube(36), jpeg=15),
    'cube-36 unsharp': Row(cube(36), unsharp=1.5),
    'cube-36 plates': Row(cube(36), plates=5),
    'frame-503 plates': Row(frame(503), photons=4000.0, faces=70.0, tilt_deg=12.0),
    'cube-36 bone': Row(cube(36), bone=True),
    'cube-48 three sizes': Row(three_sizes(48), told=True),
    'cube-48 three sizes untold': Row(three_sizes(48)),
    'grid of beads': Row(sheet(20, 5.0, False, 2), tilt_deg=15.0),
    **{
        f'{"hexagonal" if hexagonal else "square"} sheet {count} with {marks} marks': Row(
            sheet(count, pitch, hexagonal, marks), holes=True, regular=not marks, tilt_deg=15.0
        )
        for hexagonal in (False, True)
        for count, pitch, marks in (
            (20, 6.0, 1),
            (20, 6.0, 3),
            (30, 6.0, 5),
            (45, 6.0, 0),
            (45, 4.5, 2),
        )
    },
    **{
        f'{"hexagonal" if hexagonal else "square"} sheet 20 with {marks} enlarged holes': Row(
            sheet(20, 6.0, hexagonal, marks, enlarged=True), holes=True, told=True, tilt_deg=15.0
        )
        for hexagonal in (False, True)
        for marks in (1, 3)
    },
    'nothing': Row(nothing, wanted=cube(36)),
    'nothing at 3 % dose': Row(nothing, photons=45.0, wanted=cube(36)),
    'empty and clipped': Row(nothing, gain=420.0, wanted=cube(36)),
    'nothing for frame-503': Row(nothing, wanted=frame(503)),
    'bone without phantom': Row(nothing, bone=True, wanted=cube(36)),
    'hand': Row(nothing, anatomy='hand', wanted=cube(36)),
    'spine': Row(nothing, anatomy='spine', wanted=cube(36)),
    'spine for sheet': Row(nothing, anatomy='spine', wanted=sheet(20, 6.0, False, 1)),
    'cube-48 for cube-36': Row(cube(48), wanted=cube(36)),
    'lego-48 for cube-36': Row(lego(48), wanted=cube(36)),
    'cube-64 for lego-64': Row(cube(64), wanted=lego(64)),
    'cube-64 for frame-503': Row(cube(64), wanted=frame(503)),
    'frame-503 for cube-64': Row(frame(503), wanted=cube(64)),
    'other frame-503': Row(frame(503), wanted=frame(503)),
    'sheet for cube-36': Row(sheet(20, 6.0, False, 1), holes=True, tilt_deg=15.0, wanted=cube(36)),
    'cube-48 for sheet': Row(cube(48), wanted=sheet(20, 6.0, False, 1)),
}


@dataclass(frozen=True)
class Scene:
    """An image with what is true of it: projected centres (n, 2) and what can be seen (n,)."""

    image: NDArray[np.uint8]
    target: Target
    uv: NDArray[np.float64]
    visible: NDArray[np.bool_]


def render(row: Row, rng: np.random.Generator) -> Scene:
    """Render an image of a row."""
    target = row.target(rng)
    rotation, source = _pose(rng, row.tilt_deg)
    bend = _Distortion(rng, row.distortion_px)
    depth = np.zeros((SIZE, SIZE))
    hit = np.zeros((SIZE, SIZE))
    light = np.ones((SIZE, SIZE))
    centres = (target.xyz - source) @ rotation.T
    uv = bend.observed(PRINCIPAL_PX * centres[:, :2] / centres[:, 2:] + (SIZE - 1) / 2)
    if row.holes:
        light *= _perforated(bend, rotation, source, target)
    for centre, place, diameter in zip(centres, uv, target.diameter) if not row.holes else ():
        _add_sphere(light, hit, bend, centre, (place, diameter / 2))
    for middle, half in _plates(row, rng):
        depth += ACRYLIC_PER_MM * _plate(bend, rotation, source, (middle, half))
    if row.bone:
        depth += BONE_PER_MM * _bone(rng)
    if row.anatomy:
        depth += BONE_PER_MM * _skeleton(row.anatomy, rng)
    light = light * np.exp(-depth) * _vignetting(rng)
    grey = _detected(light, row, rng)
    inside = ((uv > 15) & (uv < SIZE - 16)).all(axis=1)
    return Scene(grey, target, uv, inside & (_overlap(uv, target, centres) > 1.0))


def _pose(rng: np.random.Generator, tilt_deg: float) -> tuple[np.ndarray, np.ndarray]:
    """Rotation (3, 3) of the target to the sensor, and the place of the source (3,) [mm]."""
    if tilt_deg >= 180:
        rotation = Rotation.random(random_state=int(rng.integers(2**31))).as_matrix()
    else:
        angle = np.deg2rad(rng.uniform(-tilt_deg, tilt_deg, 2))
        turn = Rotation.from_euler('zxy', [rng.uniform(0, 2 * np.pi), *angle])
        rotation = turn.as_matrix()
    shift = np.array([*rng.uniform(-12, 12, 2), DISTANCE_MM + rng.uniform(-80, 80)])
    return rotation, -rotation.T @ shift


class _Distortion:
    """Pincushion, S shape and a smooth rest; undistorted = observed - duv."""

    def __init__(self, rng: np.random.Generator, size_px: float) -> None:
        self.factor = size_px * rng.uniform(0.5, 1.0, 2) * rng.choice([-1, 1], 2)
        self.wave = rng.normal(0, 0.15 * size_px, (2, 3, 3))

    def undistorted(self, uv: np.ndarray) -> np.ndarray:
        xy = (uv - (SIZE - 1) / 2) / (SIZE / 2)
        r2 = np.sum(xy * xy, axis=-1, keepdims=True)
        duv = self.factor[0] * xy * r2
        duv = duv + self.factor[1] * np.stack([-xy[..., 1], xy[..., 0]], -1) * r2
        for i in range(3):
            for j in range(3):
                wave = np.cos(i * 2.1 * xy[..., 0] + j) * np.cos(j * 2.3 * xy[..., 1] + i)
                duv = duv + wave[..., None] * self.wave[:, i, j]
        return uv - duv

    def observed(self, uv: np.ndarray) -> np.ndarray:
        out = uv.copy()
        for _ in range(30):
            out = out + uv - self.undistorted(out)
        return out


def _rays(bend: _Distortion, left: int, top: int, shape: tuple[int, int]) -> np.ndarray:
    """Unit vectors (h, w, SUB * SUB, 3) of rays through the points of pixels."""
    step = (np.arange(SUB) + 0.5) / SUB - 0.5
    height, width = shape
    v, u, b, a = np.meshgrid(
        top + np.arange(height), left + np.arange(width), step, step, indexing='ij'
    )
    uv = np.stack([u + a, v + b], -1).reshape(height, width, SUB * SUB, 2)
    xy = (bend.undistorted(uv) - (SIZE - 1) / 2) / PRINCIPAL_PX
    ray = np.concatenate([xy, np.ones((*xy.shape[:-1], 1))], -1)
    return ray / np.linalg.norm(ray, axis=-1, keepdims=True)


def _add_sphere(
    light: np.ndarray,
    hit: np.ndarray,
    bend: _Distortion,
    centre: np.ndarray,
    disc: tuple[np.ndarray, float],
) -> None:
    """Attenuate light by a sphere: disc is its place [px] and its radius [mm]."""
    place, radius = disc
    reach = int(np.ceil(PRINCIPAL_PX * radius / centre[2])) + 4
    left, top = (int(x) for x in np.maximum(np.floor(place) - reach, 0))
    right, bottom = (int(x) for x in np.minimum(np.floor(place) + reach + 1, SIZE))
    if right <= left or bottom <= top:
        return
    ray = _rays(bend, left, top, (bottom - top, right - left))
    along = ray @ centre
    chord = 2 * np.sqrt(np.maximum(radius**2 - (centre @ centre - along**2), 0))
    passed = np.exp(-STEEL_PER_MM * chord)
    light[top:bottom, left:right] *= passed.mean(axis=-1)
    hit[top:bottom, left:right] += (chord > 0).any(axis=-1)


def _perforated(
    bend: _Distortion, rotation: np.ndarray, source: np.ndarray, target: Target
) -> np.ndarray:
    """Light (h, w) behind a sheet of steel with holes, the mean over the points of pixels."""
    holes = cKDTree(target.xyz[:, :2])
    step = (np.arange(2) + 0.5) / 2 - 0.5
    light = np.zeros((SIZE, SIZE))
    reach = np.abs(target.xyz[:, :2]).max(axis=0) + target.diameter.min()
    largest = target.diameter.max() / 2
    radius = np.append(target.diameter / 2, 0.0)
    for b, a in product(step, step):
        v, u = np.mgrid[:SIZE, :SIZE]
        xy = (bend.undistorted(np.stack([u + a, v + b], -1)) - (SIZE - 1) / 2) / PRINCIPAL_PX
        ray = np.concatenate([xy, np.ones((SIZE, SIZE, 1))], -1) @ rotation
        metal = np.zeros((SIZE, SIZE))
        for face in (-0.5, 0.5):
            way = (face * SHEET_MM - source[2]) / ray[..., 2]
            place = source[:2] + way[..., None] * ray[..., :2]
            away, nearest = holes.query(place, distance_upper_bound=largest)
            on_sheet = (np.abs(place) < reach).all(axis=-1)
            metal += 0.5 * (on_sheet & (away > radius[nearest]))
        slant = np.linalg.norm(ray, axis=-1) / np.abs(ray[..., 2])
        light += np.exp(-STEEL_PER_MM * SHEET_MM * slant * metal) / 4
    return light


def _plates(row: Row, rng: np.random.Generator) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yield middles and half sizes (3,) of the plates of a row [mm]."""
    for _ in range(row.plates):
        axis = int(rng.integers(3))
        half = np.full(3, 32.0)
        half[axis] = rng.uniform(2, 4)
        middle = np.zeros(3)
        middle[axis] = rng.uniform(-30, 30)
        yield middle, half
    for axis, side in np.ndindex(3, 2) if row.faces else ():
        half = np.full(3, row.faces)
        half[axis] = 3.0
        middle = np.zeros(3)
        middle[axis] = (2 * side - 1) * row.faces
        yield middle, half


def _plate(
    bend: _Distortion,
    rotation: np.ndarray,
    source: np.ndarray,
    plate: tuple[np.ndarray, np.ndarray],
) -> np.ndarray:
    """Lengths (h, w) [mm] of rays in a plate of the phantom."""
    middle, half = plate
    v, u = np.mgrid[:SIZE, :SIZE]
    xy = (bend.undistorted(np.stack([u, v], -1).astype(float)) - (SIZE - 1) / 2) / PRINCIPAL_PX
    ray = np.concatenate([xy, np.ones((SIZE, SIZE, 1))], -1) @ rotation
    ray /= np.linalg.norm(ray, axis=-1, keepdims=True)
    with np.errstate(divide='ignore', invalid='ignore'):
        first = (middle - half - source) / ray
        second = (middle + half - source) / ray
    enter = np.minimum(first, second).max(axis=-1)
    leave = np.maximum(first, second).min(axis=-1)
    return np.maximum(leave - enter, 0)


def _bone(rng: np.random.Generator) -> np.ndarray:
    """Lengths (h, w) [mm] of rays in a shaft of bone with a spongy texture."""
    v, u = np.mgrid[:SIZE, :SIZE]
    angle = rng.uniform(0, np.pi)
    across = (u - SIZE / 2) * np.cos(angle) + (v - SIZE / 2) * np.sin(angle)
    shaft = 2 * np.sqrt(np.maximum(110.0**2 - across**2, 0)) / 15
    hollow = 2 * np.sqrt(np.maximum(70.0**2 - across**2, 0)) / 15
    texture = np.zeros((SIZE, SIZE))
    for blur in (2.5, 6.0, 14.0):
        noise = cv2.GaussianBlur(rng.normal(size=(SIZE, SIZE)), (0, 0), blur)
        texture += noise / noise.std()
    return shaft - 0.7 * hollow + 0.5 * texture * (shaft > 0)


def _skeleton(part: str, rng: np.random.Generator) -> np.ndarray:
    """Lengths (h, w) [mm] of rays in the bones of a hand or a spine.

    Bones are ellipses with a dense border: fingers of four and a wrist of eight, or vertebrae with
    pedicles.
    """
    bones = _hand(rng) if part == 'hand' else _spine(rng)
    turn = rng.uniform(0, 2 * np.pi)
    scale = rng.uniform(0.7, 1.2)
    v, u = np.mgrid[:SIZE, :SIZE] - (SIZE - 1) / 2
    x = (u * np.cos(turn) + v * np.sin(turn)) / scale
    y = (v * np.cos(turn) - u * np.sin(turn)) / scale
    depth = np.zeros((SIZE, SIZE))
    for middle_x, middle_y, half_x, half_y, mm in bones:
        inside = 1 - ((x - middle_x) / half_x) ** 2 - ((y - middle_y) / half_y) ** 2
        marrow = np.maximum(inside - 0.3, 0)
        depth += mm * (np.sqrt(np.maximum(inside, 0)) - 0.7 * np.sqrt(marrow))
    texture = cv2.GaussianBlur(rng.normal(size=(SIZE, SIZE)), (0, 0), 2.5)
    return depth * (1 + 0.15 * texture / texture.std())


def _hand(rng: np.random.Generator) -> Iterator[tuple[float, float, float, float, float]]:
    """Yield the bones of a hand: middle and half axes [px], thickness [mm]."""
    for finger in range(5):
        x = 110.0 * (finger - 2)
        y = 180.0
        for length in (110.0, 75.0, 50.0, 35.0)[: 4 if finger else 3]:
            yield x, y - length, 22.0 + rng.uniform(-4, 4), length, 12.0
            y -= 2 * length + 8
    for row in range(2):
        for place in range(4):
            x = 90.0 * (place - 1.5) + rng.uniform(-8, 8)
            yield x, 235.0 + 85 * row, 40.0, 38.0, 14.0


def _spine(rng: np.random.Generator) -> Iterator[tuple[float, float, float, float, float]]:
    """Yield the bones of a spine: middle and half axes [px], thickness [mm]."""
    for vertebra in range(-4, 5):
        y = 130.0 * vertebra + rng.uniform(-5, 5)
        yield 0.0, y, 105.0, 52.0, 25.0
        yield 0.0, y + 30, 14.0, 40.0, 12.0
        for side in (-1, 1):
            yield side * 62.0, y - 8, 15.0, 20.0, 14.0
            yield side * 150.0, y, 60.0, 14.0, 6.0


def _vignetting(rng: np.random.Generator) -> np.ndarray:
    v, u = np.mgrid[:SIZE, :SIZE] / SIZE - 0.5
    return 1 - rng.uniform(0.1, 0.4) * (u * u + v * v)


def _detected(light: np.ndarray, row: Row, rng: np.random.Generator) -> NDArray[np.uint8]:
    """Grey values of light (h, w): scattered, blurred, counted, amplified, digitised."""
    scattered = 0.9 * light + 0.1 * cv2.GaussianBlur(light, (0, 0), 80)
    blurred = cv2.GaussianBlur(scattered, (0, 0), rng.uniform(0.8, 1.4))
    counted = rng.poisson(row.photons * blurred) / row.photons
    grey = row.gain * cv2.GaussianBlur(counted, (0, 0), 0.5)
    if row.unsharp:
        grey = grey + row.unsharp * (grey - cv2.GaussianBlur(grey, (0, 0), 3))
    image = np.clip(np.rint(grey), 0, 255).astype(np.uint8)
    if row.jpeg:
        _, data = cv2.imencode('.jpg', image, [cv2.IMWRITE_JPEG_QUALITY, row.jpeg])
        image = np.asarray(cv2.imdecode(data, cv2.IMREAD_GRAYSCALE), dtype=np.uint8)
    return image


def _overlap(uv: np.ndarray, target: Target, centres: np.ndarray) -> np.ndarray:
    """Distances (n,) of shadows from the next one, 1 where they touch."""
    if len(uv) < 2:
        return np.full(len(uv), np.inf)
    radius = PRINCIPAL_PX * target.diameter / 2 / centres[:, 2]
    apart = np.linalg.norm(uv[:, None] - uv, axis=2) / (radius[:, None] + radius + 3.0)
    np.fill_diagonal(apart, np.inf)
    return apart.min(axis=1)


@dataclass(frozen=True)
class Outcome:
    """What became of an image.

    wrong, over_half_px and over_5_sd are numbers of observations; normalised is the root mean
    square of errors over their standard deviations.
    """

    row: str
    seed: int
    visible: int
    seen: int = 0
    found: bool = False
    wrong: int = 0
    largest_px: float = 0.0
    over_half_px: int = 0
    over_5_sd: int = 0
    normalised: float = 0.0
    seconds: float = 0.0
    refusal: str = ''


def outcome(name: str, seed: int, scene: Scene, result: Extraction | DataError) -> Outcome:
    """Compare an extraction with the truth."""
    visible = int(scene.visible.sum())
    if isinstance(result, DataError):
        return Outcome(name, seed, visible, refusal=result.finding.kind.value)
    if not len(scene.uv) or ROWS[name].wanted is not None:
        return Outcome(name, seed, visible, found=True, wrong=len(result.bead))
    # Any place of a regular lattice will do: an observation belongs to the nearest target.
    nearest = ROWS[name].regular
    bead = cKDTree(scene.uv).query(result.uv)[1] if nearest else result.bead
    error = result.uv - scene.uv[bead]
    off = np.linalg.norm(error, axis=1)
    right = off < WRONG_PX
    squared = (error[right] / result.sigma[right, None]) ** 2
    return Outcome(
        name,
        seed,
        visible,
        seen=int(np.isin(bead[right], np.flatnonzero(scene.visible)).sum()),
        found=bool(right.sum() >= FOUND * visible),
        wrong=int((~right).sum()),
        largest_px=float(off[right].max(initial=0)),
        over_half_px=int((off[right] > 0.5).sum()),
        over_5_sd=int((off[right] > 5 * result.sigma[right]).sum()),
        normalised=float(np.sqrt(squared.mean())) if len(squared) else 0.0,
    )


def table(outcomes: Sequence[Outcome]) -> str:
    """Return the table of targets and that of images without what is looked for."""
    targets = [*TARGETS]
    negatives = ['', *NEGATIVES]
    for name, row in ROWS.items():
        images = [one for one in outcomes if one.row == name]
        if images and row.wanted is None:
            targets.append(f'| {name} | {_of_targets(images)} |')
        elif images:
            negatives.append(f'| {name} | {_of_negatives(images)} |')
    return '\n'.join(targets + negatives)


def _of_targets(images: list[Outcome]) -> str:
    measured = [one for one in images if not one.refusal]
    normalised = float(np.mean([one.normalised for one in measured])) if measured else np.nan
    cells = (
        f'{sum(one.found for one in images)}/{len(images)}',
        f'{sum(one.seen for one in images)}/{sum(one.visible for one in images)}',
        f'{sum(one.wrong for one in images)}',
        f'{max(one.largest_px for one in images):.2f}',
        f'{sum(one.over_half_px for one in images)}',
        f'{sum(one.over_5_sd for one in images)}',
        f'{normalised:.2f}',
        f'{np.mean([one.seconds for one in images]):.1f}',
        f'{max(one.seconds for one in images):.1f}',
        _causes(images),
    )
    return ' | '.join(cells)


def _of_negatives(images: list[Outcome]) -> str:
    cells = (
        f'{sum(not one.refusal for one in images)}/{len(images)}',
        f'{np.mean([one.seconds for one in images]):.1f}',
        f'{max(one.seconds for one in images):.1f}',
        f'{sum(one.seconds <= IN_TIME_S for one in images)}',
        _causes(images),
    )
    return ' | '.join(cells)


def _causes(images: list[Outcome]) -> str:
    count = Counter(one.refusal for one in images if one.refusal)
    return ', '.join(f'{cause} {count[cause]}' for cause in sorted(count))


def scenes(name: str, images: int, first: int) -> Iterator[Scene]:
    """Yield the scenes of a row, by seeds from the first on."""
    for number in range(first, first + images):
        yield render(ROWS[name], np.random.default_rng([number, *name.encode()]))


def measured(name: str, images: int, first: int, pictures: Path | None) -> Iterator[Outcome]:
    """Yield what becomes of the images of a row; pictures is a folder for overlays."""
    lens = Lens((SIZE, SIZE), PRINCIPAL_PX * 1.05)
    for seed, scene in enumerate(scenes(name, images, first), first):
        other = ROWS[name].wanted
        wanted = scene.target if other is None else other(np.random.default_rng(seed))
        told = wanted.diameter if ROWS[name].told else None
        model = PhantomModel.of(wanted.xyz, told, ROWS[name].regular)
        began = time.process_time()
        try:
            result: Extraction | DataError = extract_beads(scene.image, model, lens)
        except DataError as error:
            result = error
        seconds = time.process_time() - began
        if pictures:
            pictures.mkdir(parents=True, exist_ok=True)
            found = None if isinstance(result, DataError) else result
            picture = draw_overlay(scene.image, found, '' if found else str(result))
            cv2.imwrite(str(pictures / f'{name}-{seed}.png'), picture)
        yield replace(outcome(name, seed, scene, result), seconds=seconds)


def main() -> None:
    """Entry point."""
    parser = argparse.ArgumentParser(prog='python -m benchmarks.renderings')
    parser.add_argument('--images', type=int, default=20, help='of each row')
    parser.add_argument('--first', type=int, default=1, help='first seed')
    parser.add_argument('--rows', default='', help='names, comma separated')
    parser.add_argument('--pictures', type=Path, help='folder for overlays')
    parser.add_argument('--records', type=Path, help='a line of JSON for each image, appended')
    parser.add_argument('--page', type=Path, help='write the table of all records into this page')
    options = parser.parse_args()
    names = [name.strip() for name in options.rows.split(',') if name.strip()] or list(ROWS)
    outcomes: list[Outcome] = []
    for name in () if options.page else names:
        for one in measured(name, options.images, options.first, options.pictures):
            outcomes.append(one)
            if options.records:
                with options.records.open('a') as file:
                    file.write(json.dumps(asdict(one)) + '\n')
        print(table([one for one in outcomes if one.row == name]), flush=True)
    if options.records:
        lines = options.records.read_text().splitlines()
        outcomes = [Outcome(**json.loads(line)) for line in lines]
    show_section(table(outcomes), options.page, 'renderings')


if __name__ == '__main__':
    main()
