# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Results of a calibration or an adjustment, and combination of their object points."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from ..brief import brief_repr
from ..correction.fluoroscope_calibration import FluoroscopeCalibration
from ..exposures.phantom import Phantom
from ..findings import Finding
from ..photogrammetry.network import similarity_directions
from ..photogrammetry.rig_orientation import ROUNDING
from ..photogrammetry.rotations import matrix_from_quaternion
from .constraints import RelativeOrientation
from .fixed_calibration import SolvedNetwork
from .initial_network import StartValues
from .rounds import AdjustmentStatistics, ResidualTable, Round, SelfCalibration


@dataclass(frozen=True)
class ExposureResult:
    """Exterior orientation of an exposure."""

    exposure: int  #: number of the exposure
    position_mm: NDArray[np.float64]  #: (3,) position of the source
    quaternion_wxyz: NDArray[np.float64]  #: (4,) rotation phantom -> sensor
    #: (3,) standard deviations of the position, and of the rotation about the axes of the sensor
    sd_mm: NDArray[np.float64]
    sd_rad: NDArray[np.float64]


@dataclass(frozen=True)
class FluoroscopeResult:
    """Figures of one fluoroscope."""

    #: (3,) xp, yp, c and their standard deviations [px]
    interior: NDArray[np.float64]
    interior_sd: NDArray[np.float64]
    image_size: tuple[int, int]  #: width and height [px]
    model_kind: str
    k: int  #: number of neighbours of the model
    #: (2,) RMSE of the inlier residuals in u and v [px], without and with the correction
    rmse_before: NDArray[np.float64]
    rmse_after: NDArray[np.float64]
    #: numbers of all image points and of the inliers
    observations: int
    inliers: int
    exposures: tuple[ExposureResult, ...]


@dataclass(frozen=True)
class Targets:
    """Object points."""

    target_id: NDArray[np.int64]  #: (n,)
    xyz_mm: NDArray[np.float64]  #: (n, 3)
    covariance: NDArray[np.float64]  #: (n, 3, 3) [mm^2]
    #: (3n, 3n) covariance of all object points [mm^2]; None if there are too many
    joint_covariance: NDArray[np.float64] | None = None


@dataclass(frozen=True)
class CalibrationResult:
    """Result of a calibration, or of an adjustment with calibrations fixed.

    Attributes
    ----------
    fluoroscopes : dict of str to FluoroscopeResult
    calibrations : dict of str to FluoroscopeCalibration
    targets : Targets
        Object points of all fluoroscopes together.
    history : dict of str to tuple of Round
        By fluoroscope, or by '+'.join(fluoroscopes) if they were adjusted together.
    runs : dict of str to SelfCalibration
        By the same names as the history; for the report.
    findings : tuple of Finding
        NOTE: excluded exposures or image points; WARNING: doubts about the orientation of the rig;
        ERROR: why the calibration cannot be right, although it was forced.
    converged : bool
    seconds : float
    residuals : ResidualTable
        Of all image points.
    relative : tuple of RelativeOrientation
        Of every other fluoroscope to the first, if they were adjusted together.
    outliers : (tuple, tuple)
        Dicts of the image points and of the targets that fail their tests.
    correlations : tuple of (str, str, float)
        Correlations above 0.95 between unknowns.
    statistics : tuple of AdjustmentStatistics
        Of each adjustment.
    created : str
        Date and time of the end (UTC, ISO 8601).
    solved : dict of str to SolvedNetwork
        Input for the covariance matrix of all unknowns, by the names of the history.
    """

    __repr__ = brief_repr

    fluoroscopes: dict[str, FluoroscopeResult]
    calibrations: dict[str, FluoroscopeCalibration]
    targets: Targets
    history: dict[str, tuple[Round, ...]]
    runs: dict[str, SelfCalibration]
    findings: tuple[Finding, ...]
    converged: bool
    seconds: float
    residuals: ResidualTable
    relative: tuple[RelativeOrientation, ...] = ()
    outliers: tuple[tuple[Any, ...], tuple[Any, ...]] = ((), ())
    correlations: tuple[tuple[str, str, float], ...] = ()
    statistics: tuple[AdjustmentStatistics, ...] = ()
    created: str = ''
    solved: dict[str, SolvedNetwork] = field(default_factory=dict)

    @property
    def used_exposures(self) -> dict[str, set[int]]:
        """Numbers of the exposures that were not excluded, by fluoroscope."""
        return {
            name: {e.exposure for e in figures.exposures}
            for name, figures in self.fluoroscopes.items()
        }

    @property
    def starts(self) -> StartValues:
        """Initial values for other adjustments of the same exposures."""
        return StartValues(
            {name: figures.interior for name, figures in self.fluoroscopes.items()},
            {
                (name, e.exposure): (matrix_from_quaternion(e.quaternion_wxyz), e.position_mm)
                for name, figures in self.fluoroscopes.items()
                for e in figures.exposures
            },
        )


def combined_targets(
    parts: Sequence[Targets], phantom: Phantom, weighted: bool = True, open_datum: bool = False
) -> Targets:
    """Return one set of object points from separate adjustments of the same phantom.

    Every adjustment includes the survey. In the sum of their information the survey must count
    once, so its information is subtracted for every further adjustment; with weighted False, no
    adjustment includes the survey. open_datum: in every adjustment, shift, rotation and scale of
    all points follow from the survey alone; their errors are those of the survey and common to all
    points. If the errors of a model make the points of an adjustment worse than the survey, these
    points add nothing to it.
    """
    if len(parts) == 1:
        return parts[0]
    target_id = np.unique(np.concatenate([p.target_id for p in parts]))
    row = phantom.index(target_id)
    survey = np.eye(3) / phantom.sd_mm[row, None, None] ** 2
    seen = np.zeros(len(row))
    for part in parts:
        seen[np.searchsorted(target_id, part.target_id)] += 1
    repeated_survey = ((seen - 1) * weighted)[:, None, None] * survey
    joint = [part.joint_covariance for part in parts if part.joint_covariance is not None]
    if weighted and len(joint) == len(parts):
        combined = _combined_jointly(parts, joint, repeated_survey, phantom)
        if combined is not None:
            return combined
    common = np.zeros_like(survey)
    if weighted and open_datum:
        common = _common_covariance(phantom.xyz_mm[row], phantom.sd_mm[row])
        if not all(_contains(p, common[np.searchsorted(target_id, p.target_id)]) for p in parts):
            common = np.zeros_like(survey)
        survey = np.asarray(np.linalg.inv(np.linalg.inv(survey) - common), dtype=np.float64)
    surveyed = weighted * survey
    information = surveyed.copy()
    right = (surveyed @ phantom.xyz_mm[row, :, None])[..., 0]
    for part in parts:
        rows = np.searchsorted(target_id, part.target_id)
        part_information = np.linalg.inv(part.covariance - common[rows])
        value, vector = np.linalg.eigh(part_information - surveyed[rows])
        is_better = value > 0
        gained = (vector * (value * is_better)[:, None, :]) @ vector.transpose(0, 2, 1)
        information[rows] += gained
        # The point that the adjustment would give without the survey.
        added = (
            part_information @ part.xyz_mm[..., None]
            - (surveyed @ phantom.xyz_mm[row, :, None])[rows]
        )
        inside = (vector * is_better[:, None, :]) @ vector.transpose(0, 2, 1)
        right[rows] += (inside @ added)[..., 0]
    covariance = np.linalg.inv(information)
    return Targets(target_id, (covariance @ right[..., None])[..., 0], covariance + common)


def _common_covariance(
    xyz_mm: NDArray[np.float64], sd_mm: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the covariances (n, 3, 3) [mm^2] of surveyed points (n, 3) due to their datum."""
    directions = similarity_directions(xyz_mm, xyz_mm.mean(axis=0))
    scaled = (directions / sd_mm[:, None, None]).reshape(-1, directions.shape[2])
    datum_covariance = np.linalg.pinv(scaled.T @ scaled, hermitian=True)
    return np.asarray(directions @ datum_covariance @ directions.transpose(0, 2, 1))


def _contains(part: Targets, common: NDArray[np.float64]) -> bool:
    """Whether the covariances of points are larger than the common covariances (n, 3, 3)."""
    return bool((np.linalg.eigvalsh(part.covariance - common) > 0).all())


def _combined_jointly(
    parts: Sequence[Targets],
    joint: Sequence[NDArray[np.float64]],
    further: NDArray[np.float64],
    phantom: Phantom,
) -> Targets | None:
    """Return one set of object points from their joint covariances.

    None if the points of an adjustment are worse than the survey. The errors of a few beads have a
    large common part: the datum, which is the same survey in every adjustment. Adding the
    information of single beads would count it once for each adjustment.

    joint: their joint covariances [mm^2]. further: (n, 3, 3) information of the survey to
    subtract.
    """
    target_id = np.unique(np.concatenate([p.target_id for p in parts]))
    n = len(target_id)
    information = -block_diag(*further)
    right = information @ phantom.xyz_mm[phantom.index(target_id)].ravel()
    for part, covariance in zip(parts, joint):
        coordinates = 3 * np.searchsorted(target_id, part.target_id)[:, None] + np.arange(3)
        part_information = np.linalg.inv(covariance)
        information[np.ix_(coordinates.ravel(), coordinates.ravel())] += part_information
        right[coordinates.ravel()] += part_information @ part.xyz_mm.ravel()
    survey = np.repeat(1 / phantom.sd_mm[phantom.index(target_id)] ** 2, 3)
    relative = information / np.sqrt(np.outer(survey, survey))
    if np.linalg.eigvalsh(relative)[0] < 1 - ROUNDING:
        return None
    joint_covariance = np.linalg.inv(information)
    blocks = joint_covariance.reshape(n, 3, n, 3)[np.arange(n), :, np.arange(n), :]
    return Targets(target_id, (joint_covariance @ right).reshape(n, 3), blocks, joint_covariance)
