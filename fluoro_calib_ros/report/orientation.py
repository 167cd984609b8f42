# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The orientation of a rig as text for a terminal."""

from __future__ import annotations

import numpy as np

from ..photogrammetry.rig_orientation import RigOrientation


def orientation_text(orientation: RigOrientation) -> str:
    """Return a RigOrientation as text: a line, then a line a fluoroscope."""
    lines = [
        f'orientation of the rig {orientation.orientation_id} in frame {orientation.frame_id}, '
        f'from a {orientation.source} (exposures: {orientation.exposures})'
    ]
    for name, position, sd, sd_rad in zip(
        orientation.fluoroscopes, orientation.position_mm, orientation.sd_mm, orientation.sd_rad
    ):
        rotation_sd = np.rad2deg(np.sqrt(np.mean(sd_rad**2)))
        lines.append(
            f'{name}: source at {_numbers(position)} mm (sd {_numbers(sd)}), '
            f'rotation sd {rotation_sd:.4f} degrees'
        )
    return '\n'.join(lines)


def _numbers(values: np.ndarray) -> str:
    return ', '.join(f'{value:.2f}' for value in values)
