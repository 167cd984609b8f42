# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

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
    for finding in outcome.validation.findings:
        print(f'  {finding}')
print(f'saved to {out}')
