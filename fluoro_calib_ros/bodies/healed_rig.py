# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The rig as it is after a diagnosis, and what of its changes the bodies do not show.

What the data do not identify keeps the covariance that it had, or that of the change.

The size of an unseen change has a half-Cauchy prior: flat where it is small, so that it does not
matter which size is the smallest that is tried, and with a heavy tail (Gelman, "Prior
distributions for variance parameters in hierarchical models", Bayesian Analysis 1, 2006).

How large a drift of the distortion is far from the bodies follows from what they show of it. Three
parts have a size each: polynomials up to degree 1, those beyond, which grow towards the edges, and
the waves. The mean square of a size, given the data, is the prior variance of its part everywhere.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import eigh

from ..correction.series import Functions
from ..photogrammetry.rig_orientation import RigOrientation
from .healing import DRIFT_PX, OF_RIG, SIZES, Cause, Change, Diagnosis, Diagnostician
from .rig_adjustment import Prior, RigAdjustment, RigSolution, drift_errors

KNOCK_SIZES = np.geomspace(2.0**-7, 1.0, 8)  # of a knock that is not seen, relative to a large one
DRIFT_SIZES = np.geomspace(2.0**-7, 8.0, 11)  # of each part of a drift, in units of DRIFT_PX


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
    show all of a drift of the distortion (see `_Drift.unseen`).
    """
    adjustment = diagnostician.adjustment
    changed = np.zeros(adjustment.size)
    largest = np.zeros(adjustment.size)
    changes = [change for change in diagnosis.changes if change.cause in OF_RIG]
    for change in changes or diagnostician.knocks():
        changed = np.hypot(changed, diagnostician.sd_of(change))
        largest = np.hypot(largest, diagnostician.sd_of(replace(change, size=SIZES[0])))
    largest[adjustment.drift] = 0.0
    drifted = [change.fluoroscope for change in changes if change.cause is Cause.DISTORTION]
    prior = _with_sizes_of_drifts(adjustment, diagnosis, drifted).widened(largest)
    solution = adjustment.with_fixed(diagnosis.observed, prior, diagnosis.solution, changed > 0)
    values = solution.values
    covariance = solution.covariance[adjustment.rig, adjustment.rig]
    weakest = _weakest(adjustment, covariance, largest)
    if not changes:
        covariance = _of_unseen_knocks(diagnostician, diagnosis, solution)
        values = np.zeros(adjustment.size)
    views = len(adjustment.functions)
    held = values[adjustment.rig]
    unseen = {
        f: (adjustment.functions[f], _Drift.of(adjustment, diagnosis, f, held).unseen())
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


def _of_unseen_knocks(
    diagnostician: Diagnostician, diagnosis: Diagnosis, start: RigSolution
) -> NDArray[np.float64]:
    """Second moments (9F, 9F) of what a rig has changed by that is taken for unchanged.

    The mean over sizes of a knock, weighted by prior and evidence: the moments of one size alone
    would be those of a rig that has certainly been knocked as hard. Bodies tell of a knock only:
    their shapes were learned with the errors of the calibration, which are added as they were.
    """
    adjustment = diagnostician.adjustment
    knock = np.linalg.norm([diagnostician.sd_of(one) for one in diagnostician.knocks()], axis=0)
    moments = []
    evidence = []
    calibrated = diagnosis.prior.orientation
    exact = replace(diagnosis.prior, orientation=np.zeros_like(calibrated))
    for size in KNOCK_SIZES[::-1]:
        prior = exact.widened(size * knock)
        start = adjustment.with_fixed(diagnosis.observed, prior, start, knock > 0)
        change = start.values[adjustment.rig]
        moments.append(start.covariance[adjustment.rig, adjustment.rig] + np.outer(change, change))
        evidence.append(start.evidence / diagnosis.noise**2)
    share = _shares(np.array(evidence), KNOCK_SIZES[::-1, None])
    return calibrated + np.tensordot(share, np.array(moments), axes=1)


def _shares(evidence: np.ndarray, size: np.ndarray) -> NDArray[np.float64]:
    """Return the probabilities (k,) of sizes (k, p), evenly spaced in their logarithms."""
    log = evidence + np.log(size / (1 + size**2)).sum(axis=1)
    share = np.exp(log - log.max())
    return np.asarray(share / share.sum())


def _coefficients(adjustment: RigAdjustment, fluoroscope: int) -> NDArray[np.int64]:
    """Return the numbers (2n,) of the unknowns that are the drift of a fluoroscope."""
    views = len(adjustment.functions)
    return np.arange(adjustment.size)[adjustment.drift].reshape(views, -1)[fluoroscope]


def _with_sizes_of_drifts(
    adjustment: RigAdjustment, diagnosis: Diagnosis, drifted: Sequence[int]
) -> Prior:
    """Return the prior of a diagnosis, where drifts have the sizes that the data show."""
    sd = diagnosis.prior.sd.copy()
    held = diagnosis.solution.values[adjustment.rig]
    for f in drifted:
        sd[_coefficients(adjustment, f)] = _Drift.of(adjustment, diagnosis, f, held).sd
    return replace(diagnosis.prior, sd=sd)


@dataclass(frozen=True)
class _Drift:
    """What the bodies tell of the drift of an image, with the rig held."""

    functions: Functions
    matrix: np.ndarray  # (2n, 2n) normal equations of the coefficients, without other unknowns
    right: np.ndarray  # (2n,)
    smooth: np.ndarray  # (2n,) standard deviations by the error of the correction
    one_px: np.ndarray  # (2n,) the same by a drift of 1 px
    pixel: np.ndarray  # (m, 2) where the markers were seen

    @classmethod
    def of(
        cls, adjustment: RigAdjustment, diagnosis: Diagnosis, fluoroscope: int, held: np.ndarray
    ) -> _Drift:
        """Eliminate the other unknowns; held (9F,): changes of the rig."""
        observed, solution = diagnosis.observed, diagnosis.solution
        own = _coefficients(adjustment, fluoroscope)
        normal, right = adjustment.normal_at(observed, diagnosis.prior, solution)
        values = solution.values.copy()
        values[adjustment.rig] -= held
        right = right + normal @ values  # for all unknowns at 0, and the rig as it is held
        sd = diagnosis.prior.sd.copy()
        sd[adjustment.rig] = 0.0
        sd[own] = 0.0
        exact = np.zeros_like(diagnosis.prior.orientation)
        root = adjustment.root(replace(diagnosis.prior, orientation=exact, sd=sd))
        whitened = np.eye(root.shape[1]) + root.T @ normal @ root
        both = np.column_stack([normal[:, own], right])
        told = both[own] - normal[own] @ root @ np.linalg.solve(whitened, root.T @ both)
        told /= diagnosis.noise**2
        return cls(
            adjustment.functions[fluoroscope],
            matrix=(told[:, :-1] + told[:, :-1].T) / 2,
            right=told[:, -1],
            smooth=adjustment.healthy_prior(observed, 0.0).sd[own],
            one_px=DRIFT_PX * adjustment.sd_of_drift(fluoroscope),
            pixel=observed.pixel[..., fluoroscope, :][observed.seen[..., fluoroscope]],
        )

    @property
    def _is_affine(self) -> np.ndarray:
        """Which functions (n,) are polynomials up to degree 1."""
        out = np.zeros(len(self.functions), dtype=bool)
        out[: len(self.functions.powers)] = [i + j <= 1 for i, j in self.functions.powers]
        return out

    @cached_property
    def sd(self) -> NDArray[np.float64]:
        """Standard deviations (2n,) of the coefficients, by the sizes that the data show."""
        waves = np.arange(len(self.functions)) >= self.functions.trend
        part = np.tile(np.where(waves, 2, np.where(self._is_affine, 0, 1)), 2)
        size = np.array(list(product(DRIFT_SIZES, repeat=3)))
        root = np.hypot(self.smooth, size[:, part] * self.one_px)
        whitened = np.eye(len(part)) + root[:, :, None] * self.matrix * root[:, None]
        gradient = root * self.right
        solved = np.linalg.solve(whitened, gradient[..., None])[..., 0]
        evidence = 0.5 * (np.sum(gradient * solved, axis=1) - np.linalg.slogdet(whitened)[1])
        mean_square = _shares(evidence, size) @ size**2
        return np.hypot(self.smooth, np.sqrt(mean_square)[part] * self.one_px)

    def unseen(self) -> NDArray[np.float64]:
        """Second moments (2n, 2n) of the drift that is not corrected.

        Without the affine map that is nearest to it where the markers were: orientation and
        interior take that up, and their covariance contains it.
        """
        sd = self.sd
        whitened = np.eye(len(sd)) + sd[:, None] * self.matrix * sd
        covariance = sd[:, None] * np.linalg.solve(whitened, np.diag(sd))
        mean = covariance @ self.right
        values = self.functions(self.pixel)
        affine = np.flatnonzero(self._is_affine)
        rest = np.eye(len(self.functions))
        rest[affine] -= np.linalg.lstsq(values[:, affine], values, rcond=None)[0]
        of_both = np.kron(np.eye(2), rest)
        return np.asarray(of_both @ (covariance + np.outer(mean, mean)) @ of_both.T)


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


def _weakest(adjustment: RigAdjustment, covariance: np.ndarray, sd: np.ndarray) -> float:
    """Return the largest standard deviation of a direction over that before the data.

    covariance (9F, 9F) of the rig; sd (K,) by which the changed unknowns may have changed.
    """
    rows = np.flatnonzero(sd[adjustment.rig])
    if not len(rows):
        return 0.0
    before = adjustment.orientation.covariance + np.diag(sd[adjustment.rig] ** 2)
    of_rows = np.ix_(rows, rows)
    return float(np.sqrt(eigh(covariance[of_rows], before[of_rows], eigvals_only=True)[-1]))
