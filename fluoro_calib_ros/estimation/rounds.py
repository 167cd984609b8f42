# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The rounds of a self-calibration, and its result."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ..correction.angle_field import AngleField
from ..correction.base import CorrectionModel
from ..photogrammetry.adjustment import Adjustment
from ..photogrammetry.precision import Precision
from .initial_network import Measured

SETTLED_PX = 2e-3  # RMS change of the correction below which a round is the last


@dataclass(frozen=True)
class Round:
    """One round of a self-calibration."""

    iteration: int  #: number of the round, from 1
    F: float  #: negative log-likelihood of the adjustment
    #: weighted square sum of the cross-validation; of the inlier residuals where the model is
    #: estimated in the adjustment
    G: float
    k: Mapping[str, int]  #: number of neighbours by fluoroscope; 0 for a model without
    #: (2,) RMSE of the inlier residuals in u and v [px], by fluoroscope
    rmse: Mapping[str, NDArray[np.float64]]
    quadratic: float  #: robustly weighted square sum of the residuals [px^2]
    change: float  #: RMS change of the correction that the next round would make [px]


@dataclass(frozen=True)
class SelfCalibration:
    """Result of a self-calibration."""

    measured: Measured  #: the network, with the additional parameters of the model
    #: adjustments without correction and with the final one
    before: Adjustment
    after: Adjustment
    precision: Precision  #: of the adjustment after
    #: (N, 2) correction of the image points [px], additional parameters included
    correction: NDArray[np.float64]
    trained: NDArray[np.bool_]  #: (N,) image points to which the models were fitted
    models: Mapping[str, CorrectionModel]  #: by fluoroscope
    history: tuple[Round, ...]
    converged: bool  #: False where the largest number of rounds ended it
    #: with the errors of the models (see `model_errors`); None: these are in the precision
    stated: Precision | None = None
    #: (i,) variances [px^2], at the inliers of a fluoroscope, by which its distortion differs
    #: between exposures, without what orientations absorb
    between_exposures: Mapping[str, NDArray[np.int64]] = field(default_factory=dict)
    #: of the fluoroscopes whose distortion changes with the angle of the C-arm
    angle_fields: Mapping[str, AngleField] = field(default_factory=dict)

    @property
    def claims(self) -> Precision:
        """What the unknowns claim, errors of the models included."""
        return self.stated or self.precision


class History:
    """The rounds of a running self-calibration.

    progress(Round) is called after every round.
    """

    def __init__(self, measured: Measured, progress: Callable[[Round], None] | None) -> None:
        self._measured = measured
        self._progress = progress
        self.rounds: list[Round] = []

    def add(
        self, adjustment: Adjustment, g_cost: float, k: Mapping[str, int], change: float
    ) -> None:
        """Record a round, and report it; see `Round` for the arguments."""
        weighted = adjustment.noise.weight(adjustment.q)[:, None] * adjustment.residuals**2
        rmse = {
            name: rmse_of_inliers(adjustment, self._measured.network.rows(f))
            for f, name in enumerate(self._measured.fluoroscopes)
        }
        self.rounds.append(
            Round(
                len(self.rounds) + 1,
                adjustment.cost,
                G=float(g_cost),
                k=k,
                rmse=rmse,
                quadratic=float(weighted.sum()),
                change=change,
            )
        )
        if self._progress is not None:
            self._progress(self.rounds[-1])

    def has_settled(self, tolerance: float) -> bool:
        """Whether F, G and the correction have stopped changing."""
        return _has_settled(self.rounds, tolerance)


def _has_settled(rounds: Sequence[Round], tolerance: float) -> bool:
    if len(rounds) < 2:
        return False
    last = rounds[-2]
    now = rounds[-1]
    # F is a log-likelihood and may pass zero, so its change is also related to G, which is about
    # the number of image points.
    d_f = abs(now.F - last.F) / max(abs(now.F), now.G)
    d_g = abs(now.G - last.G) / max(now.G, 1e-300)
    return d_f <= tolerance and d_g <= tolerance and now.change <= SETTLED_PX


def rmse_of_inliers(adjustment: Adjustment, rows: np.ndarray) -> np.ndarray:
    """RMSE (2,) [px] in u and v of the raw inlier residuals of the image points rows."""
    r = adjustment.residuals[rows][adjustment.inliers[rows]]
    return np.sqrt(np.mean(r * r, axis=0)) if len(r) else np.full(2, np.nan)
