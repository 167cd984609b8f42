# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Distortions: displacements (n, 2) [px] as functions of ideal image points.

A distortion is defined from ideal to observed pixels, the opposite of the package. Coordinates x
are relative to the middle of the image in units of half its side.
"""

from dataclasses import dataclass

import numpy as np

ITERATIONS = 20
STEP_PX = 0.5  # step of the numerical derivatives
TOLERANCE_PX = 1e-9
SIDE = 1024.0  # image side to which sizes declared in pixels refer


@dataclass(frozen=True)
class CurvedScreen:
    """Pincushion (if negative, barrel) of a curved input screen; size at the rim [px]."""

    size: float

    def draw(self, rng):
        """Draw size and centre."""
        return self.size * rng.uniform(0.9, 1.1), rng.uniform(-0.06, 0.06, 2)

    def __call__(self, drawn, x):
        size, centre = drawn
        d = x - centre
        r = np.maximum(np.linalg.norm(d, axis=1, keepdims=True), 1e-12)
        if size < 0:  # a tangent would fold the corners inwards
            return size * d / r * (0.7 * r - np.arctan(0.7 * r)) / 0.0893
        return size * d / r * (np.tan(0.7 * np.minimum(r, 1.9)) - 0.7 * r) / 0.1423


@dataclass(frozen=True)
class Magnetic:
    """S-curve of a magnetic field: a rotation that depends on the radius, and a bent line [px]."""

    size: float

    def draw(self, rng):
        """Draw rotation, its radius, and size and direction of the bend."""
        return rng.normal(0, 1), rng.uniform(0.4, 0.9), rng.normal(0, 1), rng.uniform(0, np.pi)

    def __call__(self, drawn, x):
        turn, radius, bend, direction = drawn
        r2 = np.sum(x * x, axis=1, keepdims=True)
        turned = np.stack([-x[:, 1], x[:, 0]], axis=1) * np.exp(-r2 / (2 * radius**2))
        along = np.array([np.cos(direction), np.sin(direction)])
        s = np.sin(2.2 * (x @ along[::-1]))[:, None] * along
        return self.size * (turn * turned + 0.6 * bend * s)


@dataclass(frozen=True)
class Bumps:
    """Gaussian bumps: count, width [px] and height [px]."""

    count: int
    width: float
    height: float

    def draw(self, rng):
        """Draw positions, widths and heights."""
        return (
            rng.uniform(-1, 1, (self.count, 2)),
            self.width / (SIDE / 2) * rng.uniform(0.7, 1.4, self.count),
            self.height * rng.uniform(-1, 1, (self.count, 2)),
        )

    def __call__(self, drawn, x):
        out = np.zeros_like(x)
        for place, width, height in zip(*drawn):
            square = np.sum((x - place) ** 2, axis=1, keepdims=True)
            out += np.exp(-square / (2 * width**2)) * height
        return out


@dataclass(frozen=True)
class ThinPlate:
    """Thin-plate splines over random knots with a given RMS size [px]."""

    knots: int
    size: float

    def draw(self, rng):
        """Draw knots and weights."""
        return rng.uniform(-1.1, 1.1, (self.knots, 2)), rng.normal(0, 1, (self.knots, 2))

    def __call__(self, drawn, x):
        knots, weights = drawn
        raw = self._raw(knots, weights, x)
        lattice = np.stack(np.meshgrid(*[np.linspace(-1, 1, 15)] * 2), axis=-1).reshape(-1, 2)
        reference = self._raw(knots, weights, lattice)
        plane = np.column_stack([np.ones(len(lattice)), lattice])
        fit = np.linalg.lstsq(plane, reference, rcond=None)[0]
        scale = np.sqrt(np.mean((reference - plane @ fit) ** 2))
        return self.size * (raw - np.column_stack([np.ones(len(x)), x]) @ fit) / scale

    @staticmethod
    def _raw(knots, weights, x):
        square = np.sum((x[:, None] - knots) ** 2, axis=2)
        return (0.5 * square * np.log(square + 1e-12)) @ weights


@dataclass(frozen=True)
class Waves:
    """Plane waves with a given wavelength [px] and amplitude [px]."""

    wavelength: float
    amplitude: float
    count: int = 3

    def draw(self, rng):
        """Draw directions, phases and amplitudes."""
        angle = rng.uniform(0, np.pi, self.count)
        vectors = np.stack([np.cos(angle), np.sin(angle)])
        amplitude = self.amplitude * rng.uniform(-1, 1, (self.count, 2)) / np.sqrt(self.count)
        return vectors, rng.uniform(0, 2 * np.pi, self.count), amplitude

    def __call__(self, drawn, x):
        vectors, phase, amplitude = drawn
        return np.sin(2 * np.pi * (SIDE / 2) / self.wavelength * x @ vectors + phase) @ amplitude


@dataclass(frozen=True)
class Step:
    """A jump [px] across a line, within a width [px], as at the seam of two fibre plates."""

    jump: float
    width: float

    def draw(self, rng):
        """Draw line and direction of the jump."""
        angle = rng.uniform(0, 2 * np.pi, 2)
        return angle[0], rng.uniform(-0.3, 0.3), [np.cos(angle[1]), np.sin(angle[1])]

    def __call__(self, drawn, x):
        angle, offset, direction = drawn
        across = x @ [np.cos(angle), np.sin(angle)] - offset
        side = np.tanh(across * (SIDE / 2) / self.width)
        return 0.5 * self.jump * side[:, None] * np.asarray(direction)


@dataclass(frozen=True)
class Distortion:
    """A sum of parts with drawn parameters, for an image with a given side [px]."""

    parts: tuple
    drawn: tuple
    side: float

    @classmethod
    def of(cls, parts, rng, side):
        """Draw a random distortion."""
        return cls(tuple(parts), tuple(part.draw(rng) for part in parts), float(side))

    def displacement(self, ideal):
        """Return displacements (n, 2) [px] of ideal image points (n, 2)."""
        x = (ideal - (self.side - 1) / 2) / (self.side / 2)
        out = np.zeros_like(ideal)
        for part, drawn in zip(self.parts, self.drawn):
            out += part(drawn, x)
        return out * self.side / SIDE

    def observed(self, ideal):
        """Return observed pixels (n, 2) of ideal ones."""
        return ideal + self.displacement(ideal)

    def correction(self, observed):
        """Return corrections (n, 2) [px] of observed pixels: observed - ideal."""
        ideal = observed - self.displacement(observed)
        for _ in range(ITERATIONS):
            misclosure = observed - self.observed(ideal)
            if np.max(np.abs(misclosure), initial=0.0) < TOLERANCE_PX:
                break
            ideal = ideal + np.linalg.solve(self._slopes(ideal), misclosure[..., None])[..., 0]
        return observed - ideal

    def _slopes(self, ideal):
        """Return derivatives (n, 2, 2) of the observed pixels with respect to the ideal ones."""
        steps = STEP_PX * np.eye(2)
        columns = [self.observed(ideal + step) - self.observed(ideal - step) for step in steps]
        return np.stack(columns, axis=2) / (2 * STEP_PX)


@dataclass(frozen=True)
class Wander:
    """Smooth change of a distortion between exposures, of a given size [px] at the rim."""

    size: float

    def draw(self, rng):
        """Draw rotation with radius, pincushion, bend and shear of one exposure."""
        return rng.normal(0, 1, 6)

    def __call__(self, drawn, x):
        r2 = np.sum(x * x, axis=1, keepdims=True)
        turned = np.stack([-x[:, 1], x[:, 0]], axis=1)
        bend = np.stack([x[:, 1] ** 2, x[:, 0] ** 2], axis=1)
        out = (r2 - 0.5) * (0.5 * drawn[0] * turned + 0.5 * drawn[1] * x)
        out += 0.5 * drawn[2:4] * bend
        out += drawn[4:6] * np.sin(2.2 * x[:, ::-1]) * 0.4
        return self.size / 0.9 * out


@dataclass(frozen=True)
class Turning:
    """Change of a distortion with the angle of a C-arm, with a given size [px] at the rim.

    The field of the earth is fixed in the room, so it rotates in the image frame; the arm adds a
    component at twice the angle.
    """

    size: float
    angle: float  # rad

    def draw(self, rng):
        """Draw patterns along and across the field, and of the arm; see `Wander`."""
        return [Wander(1.0).draw(rng) for _ in range(3)]

    def __call__(self, drawn, x):
        wander = Wander(self.size)
        factors = (np.cos(self.angle), np.sin(self.angle), 0.3 * np.cos(2 * self.angle + 0.7))
        return sum(factor * wander(pattern, x) for factor, pattern in zip(factors, drawn))


BASE = (CurvedScreen(12), Magnetic(3), Bumps(12, 110, 0.9), ThinPlate(9, 0.8))
