# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Self-calibrate with a regressor of scikit-learn in place of the models of the package.

    python examples/own_regressor.py [OUT]

The command line does the same: fluoro-calib calibrate bags/calibration --phantom
bags/phantom.csv --out OUT --model sklearn.neighbors:KNeighborsRegressor
"""

import sys

from sklearn.neighbors import KNeighborsRegressor

import fluoro_calib_ros as fc

out = sys.argv[1] if len(sys.argv) > 1 else 'own_result'

phantom = fc.read_phantom('bags/phantom.csv')
frames = fc.read_source('bags/calibration', fluoroscopes=['a'], collect='auto').frames
regressor = KNeighborsRegressor(n_neighbors=20, weights='distance')
options = fc.CalibrationOptions(model=regressor, max_iterations=15)
outcome = fc.calibrate(frames, phantom, options)
fc.save_outcome(out, outcome)

# The calibration is saved as a lookup grid: reading it needs neither the class nor a pickle.
calibration = fc.read_calibrations(out)['a']
rmse = calibration.rmse_after
print(f'{calibration.model.kind}: RMSE {rmse[0]:.3f}, {rmse[1]:.3f} px, saved to {out}')
