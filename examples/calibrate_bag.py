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

"""Calibrate the recorded rig in bags/, validate the calibration and save it.

python examples/calibrate_bag.py [OUT]
"""

import sys

import fluoro_calib_ros as fc

out = sys.argv[1] if len(sys.argv) > 1 else 'result'

phantom = fc.read_phantom('bags/phantom.csv')
recording = fc.read_source('bags/calibration', collect='auto')
outcome = fc.calibrate(recording.frames, phantom, validated=True)
fc.save_outcome(out, outcome)

for name, calibration in outcome.calibrations.items():
    xp, yp, c = calibration.interior
    rmse = calibration.rmse_after
    print(f'{name}: xp {xp:.2f}, yp {yp:.2f}, c {c:.1f} px; RMSE {rmse[0]:.3f}, {rmse[1]:.3f} px')
if outcome.validation is not None:
    print(f'verdict: {outcome.validation.verdict}')
    for sentence in outcome.validation.findings:
        print(f'  {sentence}')
print(f'saved to {out}')
