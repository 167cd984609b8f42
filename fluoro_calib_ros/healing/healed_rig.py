# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The rig after a diagnosis, including the part of its changes that the bodies do not show.

Directions that the data do not determine keep their prior covariance, or that of the change.

How large a drift of the distortion is far from the bodies is inferred from the part that they
show. Three parts have separate sizes (see `sizes`): polynomials up to degree 1, higher ones, which
increase towards the edges, and the waves.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import eigh

from ..correction.series import Functions
from ..photogrammetry.rig_orientation import RigOrientation
from .diagnosis import FITS, OF_RIG, Cause, Change, Diagnosis, Diagnostician
from .rig_adjustment import RigAdjustment
from .rig_errors import drift_errors


@dataclass(frozen=True)
class HealedRig:
    """Present orientation of a rig, and the drifts of its images."""

    orientation: RigOrientation  #: contains the ids of the previous calibrations
    #: by fluoroscope: drift to be added to its correction
    drift: Mapping[int, tuple[Functions, NDArray[np.float64], NDArray[np.float64]]]
    #: by fluoroscope without such a drift: functions, and second moments (2n, 2n) of the
    #: coefficients of a drift that may have occurred
    unseen: Mapping[int, tuple[Functions, NDArray[np.float64]]]
    changes: NDArray[np.float64]  #: (F, 9) of T [mm], w [rad], xp, yp, c [px]
    sd: NDArray[np.float64]  #: (F, 9) their standard deviations
    #: standard deviation of the least known direction of the changes, over that of a large change:
    #: 1 if the data do not determine it
    weakest: float


def healed_rig(
    diagnostician: Diagnostician, diagnosis: Diagnosis, stamp_ns: int, exposures: int
) -> HealedRig:
    """Estimate what has changed, with the rest of the rig fixed as it was calibrated.

    A change of orientation or interior may have any size. The size with the largest evidence is
    that of the directions that are known well; it would pull the others towards no change.

    If nothing has changed in the rig, its values do not change. Its covariance includes the second
    moments of a knock that may have occurred (see `_of_unseen_knocks`), since bodies do not show
    all of a knock. Nor do they show all of a drift of the distortion (see `_unseen_drift`).
    """
    adjustment = diagnostician.adjustment
    largest = np.zeros(adjustment.size)
    changes = [change for change in diagnosis.changes if change.cause in OF_RIG]
    for change in changes or diagnostician.knocks():
        largest = np.hypot(largest, diagnostician.sd_of(change))
    free = largest > 0
    drifted_views = [change.fluoroscope for change in changes if change.cause is Cause.DISTORTION]
    sd = diagnosis.prior.sd.copy()
    sd[adjustment.rig] = np.maximum(sd, largest)[adjustment.rig]
    prior = replace(diagnosis.prior, sd=sd)
    solution = adjustment.with_fixed(diagnosis.observed, prior, diagnosis.solution, free)
    values = solution.values
    covariance = solution.covariance[adjustment.rig, adjustment.rig]
    weakest = _weakest(adjustment, covariance, largest)
    if not changes:
        covariance = _of_unseen_knocks(diagnostician, diagnosis)
        values = np.zeros(adjustment.size)
    views = len(adjustment.functions)
    held = values[adjustment.rig]
    unseen = {
        f: (adjustment.functions[f], _unseen_drift(diagnostician, diagnosis, f, held))
        for f in range(views)
        if f not in drifted_views
    }
    orientation = replace(
        adjustment.rig_at(values),
        covariance=(covariance + covariance.T) / 2,
        source='healing',
        stamp_ns=stamp_ns,
        exposures=exposures,
    ).rounded()
    drift = {}
    for f in drifted_views:
        number = _coefficients(adjustment, f)
        drift[f] = (
            adjustment.functions[f],
            adjustment.drift_at(values)[f],
            solution.covariance[np.ix_(number, number)],
        )
    return HealedRig(
        orientation,
        drift,
        unseen,
        changes=values[adjustment.rig].reshape(views, -1),
        sd=np.sqrt(np.diagonal(covariance)).reshape(views, -1),
        weakest=weakest,
    )


def _of_unseen_knocks(diagnostician: Diagnostician, diagnosis: Diagnosis) -> NDArray[np.float64]:
    """Return second moments (9F, 9F) of the possible change of a rig considered unchanged.

    They are the mean over sizes of a knock, of its shift and rotation together: the moments of one
    size alone would be those of a rig that has certainly been knocked this hard. Bodies only show
    a knock: their shapes were learned with calibration errors, which are added unchanged.
    """
    adjustment = diagnostician.adjustment
    calibrated = diagnosis.prior.orientation
    sd = np.linalg.norm([diagnostician.sd_of(knock) for knock in diagnostician.knocks()], axis=0)
    rows = np.flatnonzero(sd)
    fixed_prior = replace(diagnosis.prior, orientation=np.zeros_like(calibrated))
    statistics = adjustment.change_statistics(diagnosis.observed, fixed_prior, diagnosis.solution)
    out = calibrated.copy()
    moments = statistics.only(rows).with_noise(diagnosis.noise).mean_moments(sd[None, rows])
    out[np.ix_(rows, rows)] += moments
    return out


def _coefficients(adjustment: RigAdjustment, fluoroscope: int) -> NDArray[np.int64]:
    """Return indices (2n,) of the unknowns that are the drift of a fluoroscope."""
    views = len(adjustment.functions)
    return np.arange(adjustment.size)[adjustment.drift].reshape(views, -1)[fluoroscope]


def _unseen_drift(
    diagnostician: Diagnostician, diagnosis: Diagnosis, fluoroscope: int, held: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return second moments (2n, 2n) of the drift of an image that is not corrected.

    held (9F,): changes of the rig, taken as certain. The affine map nearest to the drift at the
    markers is removed: orientation and interior absorb it, and their covariance includes it.
    """
    adjustment = diagnostician.adjustment
    observed = diagnosis.observed
    columns = _coefficients(adjustment, fluoroscope)
    sd = diagnosis.prior.sd.copy()
    smooth = sd[columns]  # due to the error of the correction
    sd[adjustment.rig] = 0.0
    sd[columns] = 0.0
    no_covariance = np.zeros_like(diagnosis.prior.orientation)
    known = np.zeros(adjustment.size)
    known[adjustment.rig] = held
    fixed_prior = replace(diagnosis.prior, orientation=no_covariance, sd=sd)
    statistics = adjustment.change_statistics(observed, fixed_prior, diagnosis.solution, known)
    parts = diagnostician.parts_of(Change(Cause.DISTORTION, fluoroscope))[:, columns]
    moments = statistics.only(columns).with_noise(diagnosis.noise).mean_moments(parts, smooth)
    functions = adjustment.functions[fluoroscope]
    pixel = observed.pixel[..., fluoroscope, :][observed.seen[..., fluoroscope]]
    projection = np.kron(np.eye(2), _without_affine(functions, pixel))
    return np.asarray(projection @ moments @ projection.T)


def _without_affine(functions: Functions, pixel: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the matrix (n, n) that removes the best affine fit at pixels (m, 2)."""
    values = functions(pixel)
    affine = np.flatnonzero([i + j <= 1 for i, j in functions.powers])
    projection = np.eye(len(functions))
    projection[affine] -= np.linalg.lstsq(values[:, affine], values, rcond=None)[0]
    return projection


def unseen_distortion(diagnostician: Diagnostician, diagnosis: Diagnosis) -> tuple[float, float]:
    """Return how far unobserved changes of the distortion may move points [mm].

    The values are RMS distances relative to each other at the markers: due to changes of any size,
    and due to the noise of a single point.
    """
    adjustment = diagnostician.adjustment
    prior = diagnosis.prior
    for f in range(len(adjustment.functions)):
        prior = prior.widened(diagnostician.sd_of(Change(Cause.DISTORTION, f)))
    covariance = adjustment.covariance_at(diagnosis.observed, prior, diagnosis.solution)
    solution = diagnosis.solution
    fits = solution.poses.known & ~(solution.inliers_of_pose < FITS)
    places = adjustment.places_at(replace(solution, poses=replace(solution.poses, known=fits)))
    errors, by_noise = drift_errors(adjustment, covariance, places)
    variance = diagnosis.observed.variance[diagnosis.observed.seen].mean()
    return float(np.sqrt(3) * errors.place_mm), by_noise * float(np.sqrt(variance))


def _weakest(
    adjustment: RigAdjustment, covariance: NDArray[np.float64], sd: NDArray[np.float64]
) -> float:
    """Return the largest ratio of posterior to prior standard deviation of a direction.

    covariance (9F, 9F): of the rig. sd (K,): prior standard deviations of the changed unknowns.
    """
    rows = np.flatnonzero(sd[adjustment.rig])
    if not len(rows):
        return 0.0
    before = adjustment.orientation.covariance + np.diag(sd[adjustment.rig] ** 2)
    block = np.ix_(rows, rows)
    return float(np.sqrt(eigh(covariance[block], before[block], eigvals_only=True)[-1]))
