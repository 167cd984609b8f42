# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Radiographs of a virtual rig, rendered in processes of their own."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from ..simulation.radiographs import CLEAN, HARD, RadiographSettings, Radiography
from ..simulation.rig import Pose, VirtualFluoroscope
from .service_process import ServiceProcess

SETTINGS = {'clean': CLEAN, 'hard': HARD}
MARKER_MM = 1.0  # diameter of a marker
MARKER_ATTENUATION = 7.0  # of tantalum at 55 keV (NIST XCOM) [1/mm]


@dataclass(frozen=True)
class RenderedScene:
    """What a radiograph is taken of.

    Attributes
    ----------
    points_mm : (n, 3) ndarray
        Centres of beads or markers.
    pose : Pose
        That takes them into the rig frame.
    seed : int
        Of noise and clutter.
    diameter_mm : (n,) ndarray or None
        None: the usual one of beads.
    plates : bool
        Whether there are the faces of the phantom.
    """

    points_mm: np.ndarray
    pose: Pose
    seed: int = 0
    diameter_mm: np.ndarray | None = None
    plates: bool = True


class Renderers:
    """Takes radiographs with the fluoroscopes of a virtual rig, each in a process of its own.

    Parameters
    ----------
    fluoroscopes : sequence of VirtualFluoroscope
    settings : RadiographSettings
    """

    def __init__(
        self, fluoroscopes: Sequence[VirtualFluoroscope], settings: RadiographSettings
    ) -> None:
        self._processes = {
            f.name: ServiceProcess(partial(_camera, f, settings), 'rendering')
            for f in fluoroscopes
        }

    def start(self) -> None:
        """Start the processes, so that they are ready for the first scene."""
        for process in self._processes.values():
            process.start()

    def images(self, scene: RenderedScene) -> Mapping[str, np.ndarray]:
        """Return the radiographs (h, w) of a scene. Raises RuntimeError where it was closed."""
        for process in self._processes.values():
            process.send(scene)
        return {name: process.receive() for name, process in self._processes.items()}

    def close(self) -> None:
        """End the processes, also while they render."""
        for process in self._processes.values():
            process.close()


def _camera(
    fluoroscope: VirtualFluoroscope, settings: RadiographSettings
) -> Callable[[RenderedScene], np.ndarray]:
    radiography = Radiography(fluoroscope, settings)
    return lambda scene: radiography.image(
        scene.points_mm, scene.pose, scene.seed, scene.diameter_mm, scene.plates
    )
