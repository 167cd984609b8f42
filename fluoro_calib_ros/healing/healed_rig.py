# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The rig as it is after a diagnosis, and what of its changes the bodies do not show.

What the data do not identify keeps the covariance that it had, or that of the change.

How large a drift of the distortion is far from the bodies follows from what they show of it. Three
parts have a size each (see `sizes`): polynomials up to degree 1, those beyond, which grow towards
the edges, and the waves.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import eigh

from ..correction.series import Functions
from ..photogrammetry.rig_orientation import RigOrientation
from .diagnosis import OF_RIG, Cause, Change, Diagnosis, Diagnostician
from .rig_adjustment import RigAdjustment
from .rig_errors import drift_errors


@dataclass(frozen=True)
class HealedRig:
    """The orientation of a rig as it is now, and the drifts of its images."""

    orientation: RigOrientation  #: with the ids of the calibrations as they were
    #: by fluoroscope; to be added to its correction
    drift: Mapping[int, tuple[Functions, NDArray[np.float64], NDArray[np.float64]]]
    #: by fluoroscope without such a drift: functions, and second moments (2n, 2n) of the
    #: coefficients of the one that it may have had
    unseen: Mapping[int, tuple[Functions, NDArray[np.float64]]]
    changes: NDArray[np.float64]  #: (F, 9) of T [mm], w [rad], xp, yp, c [px]
    sd: NDArray[np.float64]  #: (F, 9) their standard deviations
    #: standard deviation of the direction of the changes that is known worst, over that of a large
    #: change as it may be: 1 where the data tell nothing of it
    weakest: float


def healed_rig(
    diagnostician: Diagnostician, diagnosis: Diagnosis, stamp_ns: int, exposures: int
) -> HealedRig:
    """Estimate what has changed, with the rest of the rig held as it was calibrated.

    A change of orientation or interior may be as large as any. The size with the largest evidence
    is that of the directions that are known well; it would pull the others towards no change.

    Where nothing of the rig has changed, it stays as it was, with the second moments of the knock
    that it may have had (see `_of_unseen_knocks`): bodies do not show all of a knock. Nor do they
    show all of a drift of the distortion (see `_unseen_drift`).
    """
    adjustment = diagnostician.adjustment
    largest = np.zeros(adjustment.size)
    changes = [change for change in diagnosis.changes if change.cause in OF_RIG]
    for change in changes or diagnostician.knocks():
        largest = np.hypot(largest, diagnostician.sd_of(change))
    free = largest > 0
    drifted = [change.fluoroscope for change in changes if change.cause is Cause.DISTORTION]
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
        if f not in drifted
    }
    orientation = replace(
        adjustment.rig_at(values),
        covariance=(covariance + covariance.T) / 2,
        source='healing',
        stamp_ns=stamp_ns,
        exposures=exposures,
    ).rounded()
    drift = {}
    for f in drifted:
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
    """Second moments (9F, 9F) of what a rig has changed by that is taken for unchanged.

    The mean over sizes of a knock, of its shift and turn together: the moments of one size alone
    would be those of a rig that has certainly been knocked as hard. Bodies tell of a knock only:
    their shapes were learned with the errors of the calibration, which are added as they were.
    """
    adjustment = diagnostician.adjustment
    calibrated = diagnosis.prior.orientation
    sd = np.linalg.norm([diagnostician.sd_of(one) for one in diagnostician.knocks()], axis=0)
    rows = np.flatnonzero(sd)
    exact = replace(diagnosis.prior, orientation=np.zeros_like(calibrated))
    told = adjustment.told(diagnosis.observed, exact, diagnosis.solution)
    out = calibrated.copy()
    moments = told.only(rows).with_noise(diagnosis.noise).mean_moments(sd[None, rows])
    out[np.ix_(rows, rows)] += moments
    return out


def _coefficients(adjustment: RigAdjustment, fluoroscope: int) -> NDArray[np.int64]:
    """Return the numbers (2n,) of the unknowns that are the drift of a fluoroscope."""
    views = len(adjustment.functions)
    return np.arange(adjustment.size)[adjustment.drift].reshape(views, -1)[fluoroscope]


def _unseen_drift(
    diagnostician: Diagnostician, diagnosis: Diagnosis, fluoroscope: int, held: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Second moments (2n, 2n) of the drift of an image that is not corrected.

    held (9F,): the changes of the rig, which are certain. Without the affine map that is nearest
    to the drift where the markers were: orientation and interior take that up, and their
    covariance contains it.
    """
    adjustment = diagnostician.adjustment
    observed = diagnosis.observed
    own = _coefficients(adjustment, fluoroscope)
    sd = diagnosis.prior.sd.copy()
    smooth = sd[own]  # by the error of the correction
    sd[adjustment.rig] = 0.0
    sd[own] = 0.0
    certain = np.zeros_like(diagnosis.prior.orientation)
    known = np.zeros(adjustment.size)
    known[adjustment.rig] = held
    exact = replace(diagnosis.prior, orientation=certain, sd=sd)
    told = adjustment.told(observed, exact, diagnosis.solution, known)
    parts = diagnostician.parts_of(Change(Cause.DISTORTION, fluoroscope))[:, own]
    moments = told.only(own).with_noise(diagnosis.noise).mean_moments(parts, smooth)
    functions = adjustment.functions[fluoroscope]
    pixel = observed.pixel[..., fluoroscope, :][observed.seen[..., fluoroscope]]
    of_both = np.kron(np.eye(2), _without_affine(functions, pixel))
    return np.asarray(of_both @ moments @ of_both.T)


def _without_affine(functions: Functions, pixel: NDArray[np.float64]) -> NDArray[np.float64]:
    """Matrix (n, n) that takes the nearest affine map at pixels (m, 2) from coefficients (n,)."""
    values = functions(pixel)
    affine = np.flatnonzero([i + j <= 1 for i, j in functions.powers])
    rest = np.eye(len(functions))
    rest[affine] -= np.linalg.lstsq(values[:, affine], values, rcond=None)[0]
    return rest


def unseen_distortion(diagnostician: Diagnostician, diagnosis: Diagnosis) -> tuple[float, float]:
    """Return how far changes of the distortion may move points that the data do not show [mm].

    RMS distances relative to each other where the markers were: by changes that may be as large as
    any, and by the noise of a single point.
    """
    adjustment = diagnostician.adjustment
    prior = diagnosis.prior
    for f in range(len(adjustment.functions)):
        prior = prior.widened(diagnostician.sd_of(Change(Cause.DISTORTION, f)))
    covariance = adjustment.covariance_at(diagnosis.observed, prior, diagnosis.solution)
    places = adjustment.places_at(diagnosis.solution)
    errors, by_noise = drift_errors(adjustment, covariance, places)
    variance = diagnosis.observed.variance[diagnosis.observed.seen].mean()
    return float(np.sqrt(3) * errors.place_mm), by_noise * float(np.sqrt(variance))


def _weakest(
    adjustment: RigAdjustment, covariance: NDArray[np.float64], sd: NDArray[np.float64]
) -> float:
    """Return the largest standard deviation of a direction over that before the data.

    covariance (9F, 9F) of the rig; sd (K,) by which the changed unknowns may have changed.
    """
    rows = np.flatnonzero(sd[adjustment.rig])
    if not len(rows):
        return 0.0
    before = adjustment.orientation.covariance + np.diag(sd[adjustment.rig] ** 2)
    of_rows = np.ix_(rows, rows)
    return float(np.sqrt(eigh(covariance[of_rows], before[of_rows], eigvals_only=True)[-1]))
