# Copyright 2026 fluoro_calib_ros maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""The orientation job: orient the rig from a capture of the phantom."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ..calibration.result import FluoroscopeCalibration
from ..calibration.rig_orientation import orientation_of_capture, standing_frames
from ..exposures.frame import Frame
from ..exposures.phantom import Phantom
from ..photogrammetry.rig_orientation import RigOrientation
from ..reconstruction.intersection import Intersector
from ..reconstruction.reconstruct import reconstruct_exposure


@dataclass(frozen=True)
class OrientationOutcome:
    """Orientation of the rig, and a check of it for people.

    Attributes
    ----------
    orientation : RigOrientation
    targets : int
        Number of targets of the capture that were intersected again.
    rms_mm : float
        Root mean square of their distances from the survey, NaN without targets.
    """

    orientation: RigOrientation
    targets: int
    rms_mm: float


def orient(
    frames: Mapping[str, Sequence[Frame]],
    phantom: Phantom,
    calibrations: Mapping[str, FluoroscopeCalibration],
    frame_id: str = 'rig',
    raise_if_cancelled: Callable[[], None] | None = None,
) -> OrientationOutcome:
    """Orient the rig in the frame of a phantom that stands still.

    Parameters
    ----------
    frames : mapping of str to sequence of Frame
        One or more frames of every fluoroscope.
    phantom : Phantom
    calibrations : mapping of str to FluoroscopeCalibration
    frame_id : str
        Name of the rig frame.
    raise_if_cancelled : callable, optional
        Called during the adjustment; may raise to stop it.

    Returns
    -------
    OrientationOutcome

    Raises
    ------
    DataError
        For fewer than two fluoroscopes, missing calibrations, and frames that do not suffice.
    """
    orientation = orientation_of_capture(
        frames, phantom, calibrations, frame_id, raise_if_cancelled=raise_if_cancelled
    )
    found = reconstruct_exposure(
        standing_frames(frames, calibrations), calibrations, Intersector(orientation)
    )
    offset = found.points.xyz_mm - phantom.xyz_mm[phantom.index(found.target_id)]
    offset = offset[np.isfinite(offset).all(axis=1)]
    rms = float(np.sqrt(np.mean(np.sum(offset**2, axis=1)))) if len(offset) else float('nan')
    return OrientationOutcome(orientation, len(offset), rms)
