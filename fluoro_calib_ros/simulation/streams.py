# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What all simulated streams of frames have in common."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..exposures.frame import Frame
from .rig import VirtualFluoroscope

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
