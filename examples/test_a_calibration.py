# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Simulate a rig, calibrate it, and test the calibration on exposures that it has not seen.

python examples/test_a_calibration.py [FOLDER]
"""

import sys
import tempfile
from pathlib import Path

import numpy as np

import fluoro_calib_ros as fc

folder = Path(sys.argv[1] if len(sys.argv) > 1 else tempfile.mkdtemp())
fc.simulate(folder, fc.SimulationOptions(seed=3, test_exposures=20, seconds=0.0))
phantom = fc.read_phantom(folder / 'phantom.csv')
true = fc.read_phantom(folder / 'truth' / 'phantom.csv')

exposures = fc.read_source(folder / 'calibration', collect='all').frames
calibrations = fc.calibrate(exposures, phantom).calibrations
unseen = fc.read_source(folder / 'test').frames
targets = fc.adjust(unseen, phantom, calibrations).targets

rows = true.index(targets.target_id)
error = targets.xyz_mm - true.xyz_mm[rows]
survey = phantom.xyz_mm[rows] - true.xyz_mm[rows]
print(f'beads, RMSE of a coordinate: {np.sqrt(np.mean(error**2)):.3f} mm')
print(f'their survey alone:          {np.sqrt(np.mean(survey**2)):.3f} mm')
