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
