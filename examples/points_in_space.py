# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Correct image points and reconstruct points in space with a saved calibration.

    python examples/points_in_space.py [RESULT]

RESULT is the folder that calibrate_bag.py, or `fluoro-calib calibrate`, wrote.
"""

import sys
from pathlib import Path

import numpy as np

import fluoro_calib_ros as fc

folder = Path(sys.argv[1] if len(sys.argv) > 1 else 'result')
calibrations = fc.read_calibrations(folder)
orientation = fc.load_orientation(folder / 'rig_orientation.npz')
frames = fc.read_source('bags/tracking', validate=False).frames

first = frames['a'][0]
corrected = fc.correct(calibrations['a'], first.uv)
moved = np.linalg.norm(corrected.uv - first.uv, axis=1)
print(f'frame {first.number}: {len(moved)} points corrected by up to {moved.max():.2f} px')

outcome = fc.reconstruct(frames, calibrations, orientation)
points = outcome.frames[0].points
print(f'{len(outcome.frames)} exposures: {outcome.status_counts}')
for target, xyz, sd in zip(outcome.frames[0].target_id[:5], points.xyz_mm, points.sd_mm):
    x, y, z = xyz
    print(f'target {target}: {x:.3f} {y:.3f} {z:.3f} mm (sd {sd.max():.3f} mm)')
if outcome.drift is not None:
    print(f'drift watch: {outcome.drift.message}')
