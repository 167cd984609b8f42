# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Orientations of the rig that arrive at the reconstruction node, ready for use."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from fluoro_calib_msgs.msg import RigOrientation

from ..checks.rig_watch import RigDriftWatch
from ..errors import DataError
from ..io.calibration import load_orientation, orientation_path
from ..photogrammetry import rig_orientation
from ..photogrammetry.noise import ObservedScatter
from ..reconstruction.intersection import Intersector
from .drift_monitor import DriftMonitor
from .messages.rig_orientation import (
    description_of,
    message_from_orientation,
    orientation_from_message,
)
from .runtime.diagnostics import RefusalLog
from .runtime.logging import Logger
from .runtime.parameters import expand_path

MAX_ORIENTATIONS = 4  # frames of the previous calibrations may still come


class Rig(NamedTuple):
    """An orientation that has arrived, its intersector, scatter, and drift watch if any."""

    orientation_id: str
    orientation: rig_orientation.RigOrientation
    intersector: Intersector
    scatter: ObservedScatter
    watch: RigDriftWatch | None


class RigInput:
    """The last orientations, by the calibrations that they belong to.

    The executor's thread replaces them as a whole, and the thread of the streams reads them.

    Parameters
    ----------
    names : sequence of str
        Fluoroscopes.
    reject : float
        Epipolar distance above which image points do not belong together [standard deviations].
    drift : DriftMonitor
    refusals : RefusalLog
    logger : Logger
    """

    def __init__(
        self,
        names: Sequence[str],
        reject: float,
        drift: DriftMonitor,
        *,
        refusals: RefusalLog,
        logger: Logger,
    ) -> None:
        self._names = names
        self._reject = reject
        self._drift = drift
        self._refusals = refusals
        self._logger = logger
        # By calibration ids, the oldest first; replaced as a whole.
        self._rigs: dict[tuple[str | None, ...], Rig] = {}

    @property
    def newest(self) -> Rig | None:
        """The last one that has arrived."""
        return next(reversed(self._rigs.values()), None)

    def camera_of(self, name: str) -> tuple[str, np.ndarray | None]:
        """Return optical frame and interior orientation (3,) of the newest one, or '' and None."""
        rig = self.newest
        if rig is None:
            return '', None
        index = rig.orientation.fluoroscopes.index(name)
        return rig.orientation.optical_frame_ids[index], rig.orientation.interior[index]

    def rig_of(self, calibration_ids: Mapping[str, str]) -> Rig | None:
        """Return the newest rig with the calibrations of some views, by fluoroscope."""
        rigs = self._rigs
        ids = tuple(calibration_ids.get(name) for name in self._names)
        if len(calibration_ids) == len(ids):
            return rigs.get(ids)
        for known_ids, rig in reversed(rigs.items()):
            if all(own in (None, known) for own, known in zip(ids, known_ids)):
                return rig
        return None

    def add(self, message: RigOrientation) -> bool:
        """Use an orientation from now on; returns whether it is not refused."""
        try:
            orientation = orientation_from_message(message).subset(self._names)
            rig = Rig(
                message.orientation_id,
                orientation,
                Intersector(orientation, self._reject),
                ObservedScatter(),
                self._drift.make_watch(orientation),
            )
        except ValueError as error:  # DataError among them
            self._refusals.last_fault = str(error)
            self._logger.error(f'orientation refused, the current one stays in use: {error}')
            return False
        ids = orientation.calibration_ids
        newest = list(self._rigs.items())[-(MAX_ORIENTATIONS - 1) :]
        self._rigs = {**{i: old for i, old in newest if i != ids}, ids: rig}
        self._logger.info(f'{description_of(message)}, in use')
        return True

    def saved(self, file: str, folder: str) -> RigOrientation | None:
        """Return the orientation of a file, or else of a folder, None where there is none."""
        try:
            path = file
            if not path and folder:
                known = orientation_path(expand_path(folder))
                path = known if Path(known).exists() else ''
            return message_from_orientation(load_orientation(path)) if path else None
        except DataError as error:
            self._logger.error(str(error))
            self._refusals.last_fault = str(error)
            return None

    def use_reject(self, reject: float) -> None:
        """Use another limit from now on."""
        self._reject = reject
        self._rigs = {
            ids: rig._replace(intersector=Intersector(rig.orientation, reject))
            for ids, rig in self._rigs.items()
        }

    def renew_watches(self) -> None:
        """Watch for drift from the beginning."""
        try:
            self._rigs = {
                ids: rig._replace(watch=self._drift.make_watch(rig.orientation))
                for ids, rig in self._rigs.items()
            }
        except ValueError as error:  # DataError among them
            self._refusals.last_fault = f'no drift watch: {error}'
            self._logger.error(self._refusals.last_fault)
