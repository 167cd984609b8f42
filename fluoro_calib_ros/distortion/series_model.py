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

"""Models that are a series alone, estimated as a whole in the adjustment."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from .base import CorrectionModel
from .series import Series


class SeriesModel(CorrectionModel):
    """A series of functions; the training points only bound the calibrated area."""

    has_series = True
    series: Series

    def predict(self, uv: ArrayLike) -> np.ndarray:
        """Corrections (n, 2) [px] at pixels uv (n, 2)."""
        return self.series.predict_in_chunks(np.asarray(uv, dtype=float).reshape(-1, 2))
