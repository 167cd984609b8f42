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

"""Doubts whether exposures fit calibrations that are held.

A held calibration leaves the noise that it was determined with. Where exposures leave much more,
it is not theirs: the image has changed, the fluoroscopes are interchanged, or the image points are
corrected already.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from ..calibration.calibrate import CalibrationResult
from ..calibration.result import FluoroscopeCalibration

MAX_NOISE = 2.0  # RMSE over the noise of an image coordinate of the calibration
CORRECTED = 0.6  # RMSE without the correction over that with it, of points that are corrected


def held_doubts(
    result: CalibrationResult, calibrations: Mapping[str, FluoroscopeCalibration]
) -> list[str]:
    """Return a sentence for every fluoroscope whose exposures its calibration does not fit."""
    out = []
    for name, figures in result.fluoroscopes.items():
        after = float(np.sqrt(np.mean(np.square(figures.rmse_after))))
        noise = calibrations[name].image_sd
        if after <= MAX_NOISE * noise:
            continue
        before = float(np.sqrt(np.mean(np.square(figures.rmse_before))))
        cause = 'the image has changed, or the calibration is that of another fluoroscope'
        if before < CORRECTED * after:
            cause = 'the image points seem to be corrected already'
        out.append(
            f'fluoroscope {name}: RMSE {after:.2f} px with the calibration held, '
            f'{after / noise:.1f} times the noise with which it was determined: {cause}'
        )
    return out
