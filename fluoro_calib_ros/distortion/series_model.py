# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

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
