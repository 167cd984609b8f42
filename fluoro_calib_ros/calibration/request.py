# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What a calibration is made from."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from ..exposures.frame import Frame
from ..exposures.names import Names
from ..exposures.phantom import Phantom
from ..photogrammetry.known_orientation import KnownOrientation
from .options import CalibrationOptions


@dataclass(frozen=True)
class CalibrationRequest:
    """Observations and options of a calibration.

    Attributes
    ----------
    frames : mapping of str to sequence of Frame
        Exposures of the phantom by fluoroscope.
    phantom : Phantom
        Its survey.
    options : CalibrationOptions
    joint : bool
        Whether all fluoroscopes are adjusted together; else one after the other.
    principal_distance : float or None
        Start value, or with interior 'fixed' the held value [px]; None: from the observations.
    names : Names
        Names of targets, exposures and fluoroscopes in the files that they were read from.
    known_orientations : mapping of str to KnownOrientation
        Orientations that are known beforehand, by fluoroscope; the phantom is then surveyed in
        their frame.
    """

    frames: Mapping[str, Sequence[Frame]]
    phantom: Phantom
    options: CalibrationOptions = field(default_factory=CalibrationOptions)
    joint: bool = False
    principal_distance: float | None = None
    names: Names = field(default_factory=Names)
    known_orientations: Mapping[str, KnownOrientation] = field(default_factory=dict)

    @property
    def groups(self) -> list[tuple[str, ...]]:
        """Names of the fluoroscopes that are adjusted together, group by group."""
        return [tuple(self.frames)] if self.joint else [(name,) for name in self.frames]
