# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Phantoms: true bead coordinates (n, 3) [mm]."""

import numpy as np


def frame(rng, beads=480, size=250.0):
    """Return beads in staggered rows on four walls of struts and plates."""
    rows = []
    for wall in range(4):
        count = beads // 4
        across = rng.permutation(np.linspace(-0.48, 0.48, count)) * size
        up = np.linspace(-0.48, 0.48, count) * size
        depth = size / 2 + rng.uniform(-2, 2, count)
        angle = wall * np.pi / 2
        rows.append(
            np.column_stack(
                [
                    across * np.cos(angle) - depth * np.sin(angle),
                    across * np.sin(angle) + depth * np.cos(angle),
                    up,
                ]
            )
        )
    return np.concatenate(rows)


def cube(rng, side=4, size=120.0):
    """Return a lattice of side^3 beads, 64 by default."""
    axis = np.linspace(-0.5, 0.5, side) * size
    lattice = np.stack(np.meshgrid(axis, axis, axis), axis=-1).reshape(-1, 3)
    return lattice + rng.normal(0, 0.5, lattice.shape)


def cloud(rng, beads=320, size=150.0):
    """Return beads at random positions in a ball."""
    direction = rng.normal(0, 1, (beads, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    return direction * size * rng.uniform(0.05, 1, (beads, 1)) ** (1 / 3)


def helix(rng, beads=150, size=260.0):
    """Return beads on a helix around a cylinder."""
    turn = np.linspace(0, 9 * np.pi, beads)
    radius = 0.45 * size + rng.uniform(-3, 3, beads)
    up = np.linspace(-0.5, 0.5, beads) * size
    return np.column_stack([radius * np.cos(turn), radius * np.sin(turn), up])


def plates(rng, beads=13, size=240.0):
    """Return two parallel plates with beads^2 beads each."""
    axis = np.linspace(-0.5, 0.5, beads) * size
    lattice = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
    both = [np.column_stack([lattice, np.full(len(lattice), z)]) for z in (-60.0, 60.0)]
    return np.concatenate(both) + rng.normal(0, 0.3, (2 * len(lattice), 3))
