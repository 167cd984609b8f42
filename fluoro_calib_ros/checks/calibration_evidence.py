# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What the checks of a calibration work with."""

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
from ..estimation.lack_of_fit import CELLS
from ..estimation.options import AUTO, CalibrationRequest
from ..estimation.result import CalibrationResult
from ..exposures.frame import Frame, Frames
from ..exposures.phantom import Phantom
from .check import Check
from .residual_tests import (
    RejectedExposure,
    RejectedTrend,
    Residuals,
    ResidualTrend,
    common_trend,
    noise_of,
    rejected_exposure,
    rejected_trend,
    residuals_of,
    unexplained,
)

# The calibration of a part has at most so many rounds: with few exposures it converges slowly, and
# after these rounds without visible change.
MAX_ROUNDS = 25
# Share of the image points of a part that may be rejected beside that of the whole.
MAX_LOST = 0.03
MIN_VARYING_EXPOSURES = 4  # with enough image points, to tell whether the distortion varies


@dataclass(frozen=True)
class CommonTrend:
    """Trend that the residuals of all exposures of a fluoroscope have in common."""

    inliers: Residuals  #: those in the core of the noise
    trend: ResidualTrend
    #: standard deviation that the calibration claims for its correction [px]: an error of this
    #: size is no fault
    claimed_sd: float
    #: what rejected image points have in common; None where they are few everywhere
    rejected: RejectedTrend | None = None
    #: how far those of one exposure agree; None where they are few in all
    of_exposure: RejectedExposure | None = None

    @property
    def limit(self) -> float:
        """Size of a trend [px] that is not significant."""
        return float(np.hypot(self.trend.limit, self.claimed_sd))

    @property
    def is_significant(self) -> bool:
        """Whether the residuals have a trend."""
        return not self.trend.size <= self.limit


@dataclass(frozen=True)
class Evidence:
    """A calibration, the exposures it was made from, and what a check may do with them."""

    #: with the frames that were used only, in the order of their numbers
    request: CalibrationRequest
    calibrations: Calibrations
    result: CalibrationResult  #: adjustment of the frames with the calibrations fixed
    #: to be called with the name of a step before every step of a check
    report_step: Callable[[str], None]

    @property
    def frames(self) -> Frames:
        """Frames by fluoroscope."""
        return self.request.frames

    @property
    def phantom(self) -> Phantom:
        """The survey of the phantom."""
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
        claimed = float(
            np.sqrt(np.mean(calibration.correction(inliers.uv, inliers.angle).sd ** 2))
        )
        size = calibration.image_size
        rejected = residuals.rejected(noise)
        area = rejected_trend(rejected, inliers, size)
        # What the correction does not follow in an area, no exposure is blamed for.
        if area is not None and area.size > area.limit:
            rejected = unexplained(rejected, max(size) / CELLS / 2)
        return CommonTrend(
            inliers,
            common_trend(inliers, size),
            claimed,
            area,
            rejected_exposure(rejected, inliers),
        )

    @cached_property
    def starts(self) -> StartValues:
        """Start values of the adjustments of parts."""
        return self.result.starts

    @cached_property
    def earlier(self) -> EarlierCalibration:
        """What the calibrations of parts take over."""
        varying = (name for name in self.frames if self._is_varying(name))
        targets = self.result.targets
        return EarlierCalibration(
            {
                name: one.model.series
                for name, one in self.calibrations.items()
                if one.model.series
            },
            frozenset(varying),
            noise_of_calibrations(self.request.options.loss, self.calibrations.values()),
            targets.target_id,
            targets.xyz_mm,
        )

    def _is_varying(self, name: str) -> bool:
        if self.calibrations[name].angle_field is not None:
            return True
        found = self.variations[name]
        return found is not None and found.is_varying

    @cached_property
    def variations(self) -> dict[str, Variation | None]:
        """Changes of distortions between exposures; None with too few image points."""
        return {name: self._variation(name) for name in self.frames}

    def _variation(self, name: str) -> Variation | None:
        calibration = self.calibrations[name]
        residuals = self.trends[name].inliers
        if not is_determined(residuals.exposure, MIN_VARYING_EXPOSURES):
            return None
        functions = exposure_functions(residuals.uv, calibration.image_size, calibration.interior)
        return variation(residuals.r, residuals.exposure, functions)

    def fewest_exposures(self, names: Sequence[str]) -> int:
        """Return the number of exposures of the fluoroscope that has the fewest."""
        return min(len(self.frames[name]) for name in names)

    def part(
        self, names: Sequence[str], is_chosen: Callable[[int], bool]
    ) -> dict[str, list[Frame]]:
        """Return the frames of some fluoroscopes whose position in order is chosen."""
        return {
            name: [f for i, f in enumerate(self.frames[name]) if is_chosen(i)] for name in names
        }

    def calibrate(self, frames: Frames) -> Calibrations:
        """Calibrate with a part of the frames. Raises DataError where they do not suffice."""
        options = self.request.options
        distance = self.request.principal_distance
        if options.interior == 'fixed':  # as in the calibration that is validated
            distance = float(np.mean([self.calibrations[name].interior[2] for name in frames]))
        options = replace(options, max_iterations=min(options.max_iterations, MAX_ROUNDS))
        kinds = {self.calibrations[name].model.kind for name in frames}
        if options.model == AUTO and len(kinds) == 1 and kinds <= set(selectable_models()):
            options = replace(options, model=kinds.pop())  # the one that is validated
        part = replace(self.request, frames=frames, options=options, principal_distance=distance)
        if options.model == CollocationModel.kind:
            starts = replace(self.starts, earlier=self.earlier)
            with contextlib.suppress(DataError):
                found = calibrate_part(part, starts, self.calibrations)
                if not self._has_lost_points(found, frames):
                    return found
        # The gauge of the part is another one. Outliers can keep the exposures of a part from it
        # where the distortion is large.
        return calibrate_part(part, self.starts, self.calibrations)

    def calibrate_free(self, names: Sequence[str]) -> Calibrations:
        """Calibrate all frames of some fluoroscopes without a given interior orientation.

        Raises DataError.
        """
        request = replace(self.request, options=replace(self.request.options, interior_sd=None))
        return replace(self, request=request).calibrate(self.part(names, lambda i: True))

    def _has_lost_points(self, found: Calibrations, frames: Frames) -> bool:
        """Whether a part rejects clearly more image points than the whole."""
        for name, calibration in found.items():
            kept = _share_of_inliers(calibration, frames[name])
            of_whole = _share_of_inliers(self.calibrations[name], self.frames[name])
            if kept < of_whole - MAX_LOST:
                return True
        return False

    def adjust(self, frames: Frames, calibrations: Calibrations) -> CalibrationResult:
        """Adjust frames with calibrations fixed. Raises DataError."""
        return adjust_with_calibrations(
            frames,
            self.phantom,
            calibrations=calibrations,
            loss=self.request.options.loss,
            known=self.request.known_orientations,
            starts=self.starts,
        )


def _share_of_inliers(calibration: FluoroscopeCalibration, frames: Sequence[Frame]) -> float:
    return len(calibration.model.train_uv) / sum(len(frame.uv) for frame in frames)


@dataclass(frozen=True)
class Subject:
    """A subject of validation: one or more checks that are made together."""

    #: called with the Evidence and the names of the fluoroscopes that are calibrated together;
    #: returns their checks; with of_rig it is called once, with all fluoroscopes
    run: Callable[[Evidence, Sequence[str]], list[Check]]
    steps: int = 0  #: how often run calls `Evidence.report_step`
    of_rig: bool = False  #: whether the checks are of all fluoroscopes together
