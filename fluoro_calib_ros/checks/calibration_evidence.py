# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Data and operations that the checks of a calibration use."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from ..correction.fluoroscope_calibration import Calibrations, FluoroscopeCalibration
from ..correction.registry import CollocationModel, selectable_models
from ..errors import DataError
from ..estimation.calibrate import adjust_with_calibrations, calibrate_part
from ..estimation.exposure_terms import Variation, exposure_functions, is_determined, variation
from ..estimation.fixed_calibration import noise_of_calibrations
from ..estimation.initial_network import EarlierCalibration, StartValues
from ..estimation.lack_of_fit import CELLS, RejectedArea
from ..estimation.options import AUTO, CalibrationRequest
from ..estimation.result import CalibrationResult
from ..exposures.frame import Frame, Frames
from ..exposures.phantom import Phantom
from .check import Check
from .residual_tests import (
    RejectedExposure,
    Residuals,
    ResidualTrend,
    common_trend,
    noise_of,
    rejected_exposure,
    rejected_trend,
    residuals_of,
    unexplained,
)

# Maximum number of rounds when calibrating a part of the exposures. With few exposures convergence
# is slow, and changes after this number of rounds are not visible.
MAX_ROUNDS = 25
# Maximum excess of the share of rejected image points in a part over the share in the whole.
MAX_LOST = 0.03
MIN_VARYING_EXPOSURES = 4  # exposures with enough points to detect a varying distortion


@dataclass(frozen=True)
class CommonTrend:
    """Trend that the residuals of all exposures of a fluoroscope have in common."""

    inliers: Residuals  #: residuals in the core of the noise
    trend: ResidualTrend
    #: standard deviation that the calibration claims for its correction [px]; an error of this
    #: size is no fault
    claimed_sd: float
    #: trend of rejected image points; None if there are few everywhere
    rejected: RejectedArea | None = None
    #: agreement of the rejected image points of one exposure; None if all exposures have few
    of_exposure: RejectedExposure | None = None

    @property
    def limit(self) -> float:
        """Largest size of a trend [px] that is not significant."""
        return float(np.hypot(self.trend.limit, self.claimed_sd))

    @property
    def is_significant(self) -> bool:
        """Whether the residuals have a significant trend."""
        return not self.trend.size <= self.limit


@dataclass(frozen=True)
class Evidence:
    """Calibration, the exposures it was made from, and the operations of the checks."""

    #: contains only the frames that were used, in the order of their numbers
    request: CalibrationRequest
    calibrations: Calibrations
    result: CalibrationResult  #: adjustment of the frames with the calibrations fixed
    #: to be called with the name of a step before each step of a check
    report_step: Callable[[str], None]

    @property
    def frames(self) -> Frames:
        """Frames by fluoroscope."""
        return self.request.frames

    @property
    def phantom(self) -> Phantom:
        """Survey of the phantom."""
        return self.request.phantom

    @cached_property
    def trends(self) -> dict[str, CommonTrend]:
        """Trends of the residuals by fluoroscope."""
        return {name: self._common_trend(name) for name in self.frames}

    def _common_trend(self, name: str) -> CommonTrend:
        calibration = self.calibrations[name]
        residuals = residuals_of(self.result, name, self.frames[name])
        noise = noise_of(residuals, calibration, self.frames[name])
        inliers = residuals.inliers(noise)
        correction_sd = float(
            np.sqrt(np.mean(calibration.correction(inliers.uv, inliers.angle).sd ** 2))
        )
        size = calibration.image_size
        rejected = residuals.rejected(noise)
        area = rejected_trend(rejected, inliers, size)
        # Do not blame an exposure for distortion that the correction does not follow in an area.
        if area is not None and area.size_px > area.limit_px:
            rejected = unexplained(rejected, max(size) / CELLS / 2)
        return CommonTrend(
            inliers,
            common_trend(inliers, size),
            correction_sd,
            area,
            rejected_exposure(rejected, inliers),
        )

    @cached_property
    def starts(self) -> StartValues:
        """Initial values for the adjustments of parts."""
        return self.result.starts

    @cached_property
    def earlier(self) -> EarlierCalibration:
        """Results that the calibrations of parts take over."""
        varying = (name for name in self.frames if self._is_varying(name))
        targets = self.result.targets
        return EarlierCalibration(
            {
                name: calibration.model.series
                for name, calibration in self.calibrations.items()
                if calibration.model.series
            },
            frozenset(varying),
            noise_of_calibrations(self.request.options.loss, self.calibrations.values()),
            targets.target_id,
            targets.xyz_mm,
        )

    def _is_varying(self, name: str) -> bool:
        if self.calibrations[name].angle_field is not None:
            return True
        estimate = self.variations[name]
        return estimate is not None and estimate.is_varying

    @cached_property
    def variations(self) -> dict[str, Variation | None]:
        """Variation of the distortion between exposures; None with too few image points."""
        return {name: self._variation(name) for name in self.frames}

    def _variation(self, name: str) -> Variation | None:
        calibration = self.calibrations[name]
        residuals = self.trends[name].inliers
        if not is_determined(residuals.exposure, MIN_VARYING_EXPOSURES):
            return None
        functions = exposure_functions(residuals.uv, calibration.image_size, calibration.interior)
        return variation(residuals.r, residuals.exposure, functions)

    def fewest_exposures(self, names: Sequence[str]) -> int:
        """Return the smallest number of exposures of any of the fluoroscopes."""
        return min(len(self.frames[name]) for name in names)

    def part(
        self, names: Sequence[str], is_chosen: Callable[[int], bool]
    ) -> dict[str, list[Frame]]:
        """Return the frames of some fluoroscopes whose index is chosen."""
        return {
            name: [f for i, f in enumerate(self.frames[name]) if is_chosen(i)] for name in names
        }

    def calibrate(self, frames: Frames) -> Calibrations:
        """Calibrate with a part of the frames. Raises DataError if they do not suffice."""
        options = self.request.options
        distance = self.request.principal_distance
        if options.interior == 'fixed':  # as in the calibration under validation
            distance = float(np.mean([self.calibrations[name].interior[2] for name in frames]))
        options = replace(options, max_iterations=min(options.max_iterations, MAX_ROUNDS))
        kinds = {self.calibrations[name].model.kind for name in frames}
        if options.model == AUTO and len(kinds) == 1 and kinds <= set(selectable_models()):
            options = replace(options, model=kinds.pop())  # the model under validation
        part = replace(self.request, frames=frames, options=options, principal_distance=distance)
        if options.model == CollocationModel.kind:
            starts = replace(self.starts, earlier=self.earlier)
            with contextlib.suppress(DataError):
                calibrations = calibrate_part(part, starts, self.calibrations)
                if not self._has_lost_points(calibrations, frames):
                    return calibrations
        # The part has a different gauge. With a large distortion, outliers can prevent the
        # exposures of a part from reaching it.
        return calibrate_part(part, self.starts, self.calibrations)

    def calibrate_free(self, names: Sequence[str]) -> Calibrations:
        """Calibrate all frames of some fluoroscopes without a given interior orientation.

        Raises DataError.
        """
        request = replace(self.request, options=replace(self.request.options, interior_sd=None))
        return replace(self, request=request).calibrate(self.part(names, lambda i: True))

    def _has_lost_points(self, calibrations: Calibrations, frames: Frames) -> bool:
        """Return whether a part rejects clearly more image points than the whole."""
        for name, calibration in calibrations.items():
            share = _share_of_inliers(calibration, frames[name])
            share_of_whole = _share_of_inliers(self.calibrations[name], self.frames[name])
            if share < share_of_whole - MAX_LOST:
                return True
        return False

    def adjust(self, frames: Frames, calibrations: Calibrations) -> CalibrationResult:
        """Adjust frames with the calibrations fixed. Raises DataError."""
        return adjust_with_calibrations(
            frames,
            self.phantom,
            calibrations=calibrations,
            loss=self.request.options.loss,
            known=self.request.known_orientations,
            starts=self.starts,
        )


def for_each(
    check: Callable[[Evidence, str], Check],
) -> Callable[[Evidence, Sequence[str]], list[Check]]:
    """Return a function that makes a check of one fluoroscope for each of several."""
    return lambda evidence, names: [check(evidence, name) for name in names]


def _share_of_inliers(calibration: FluoroscopeCalibration, frames: Sequence[Frame]) -> float:
    return len(calibration.model.train_uv) / sum(len(frame.uv) for frame in frames)


@dataclass(frozen=True)
class Subject:
    """Subject of validation: one or more checks that are made together."""

    #: called with the Evidence and the names of the fluoroscopes that are calibrated together;
    #: returns their checks; if of_rig is set, it is called once, with all fluoroscopes
    run: Callable[[Evidence, Sequence[str]], list[Check]]
    steps: int = 0  #: number of calls of `Evidence.report_step` by run
    of_rig: bool = False  #: whether the checks concern all fluoroscopes together
