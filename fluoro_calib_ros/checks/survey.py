# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Checks of a survey of the phantom from its own exposures."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree
from scipy.special import chdtri

from ..estimation.survey import SurveyedBeads
from ..exposures.phantom import SCALE_TOLERANCE, mistaken_unit
from ..findings import Finding, Kind, Place, Severity, first_few
from ..photogrammetry.network import DATUM_DEFECT, MIN_RAYS, similarity_directions
from ..photogrammetry.outliers import CONTRADICTION
from .beads import MIN_BEADS
from .check import Check, not_made

# Errors along two rays are cot(angle / 2) times those across: 6 times at 20 degrees. A single sd
# for all axes would then be wrong by more than half for the worst axis.
MIN_ANGLE_RAD = np.deg2rad(20.0)
# Limit of the mean square of the normalised differences of two halves: docs/how_good.md. It is at
# most 1.41 in simulated surveys with correct sds, and was 1.64 in one with an NSE of 1.6 (8
# exposures, seed 7 of benchmarks.survey).
HALVES_LIMIT = 1.5
OFF_SD = 1.5  # maximum RMS over many beads, in sds of rough coordinates
UNKNOWN = 1e6  # variance of an unknown datum, over that of the beads


def unsurveyed(beads: SurveyedBeads) -> list[Finding]:
    """Return findings for beads with too few rays, and for beads with too acute intersections."""
    has_few_rays = beads.rays < MIN_RAYS
    is_acute = ~has_few_rays & (beads.angle_rad < MIN_ANGLE_RAD)
    angle = f'{np.rad2deg(MIN_ANGLE_RAD):.0f} degrees'
    out = []
    for kind, is_bad, reason in (
        (Kind.FEW_RAYS, has_few_rays, f'fewer than {MIN_RAYS} of their image points agree'),
        (Kind.WEAK_INTERSECTION, is_acute, f'their rays meet at less than {angle}'),
    ):
        if is_bad.any():
            ids = beads.target_id[is_bad]
            out.append(
                Finding(
                    kind,
                    f'{len(ids)} beads are not surveyed, {reason}: {first_few(ids)}',
                    Place(target_id=tuple(ids.tolist()), name=''),
                    severity=Severity.NOTE,
                    numbers={'beads': len(ids)},
                )
            )
    return out


def displaced(beads: SurveyedBeads) -> Finding | None:
    """Return a finding for beads that are not at their given coordinates, in the same unit."""
    if _wrong_unit(beads) is not None:
        return None
    variance = beads.covariance + beads.given_sd_mm[:, None, None] ** 2 * np.eye(3)
    offset = beads.xyz_mm - beads.given_mm
    square = np.einsum('na,nab,nb->n', offset, np.linalg.inv(variance), offset)
    is_wrong = square > chdtri(3, CONTRADICTION / len(offset))
    if not is_wrong.any():
        return None
    order = np.flatnonzero(is_wrong)[np.argsort(-beads.off_mm[is_wrong])]
    ids = beads.target_id[order]
    largest = float(beads.off_mm[order[0]])
    return Finding(
        Kind.BEADS,
        f'{len(ids)} beads lie further from the given coordinates than their sd allows, by up to '
        f'{largest:.2f} mm: {first_few(ids)}',
        Place(target_id=tuple(ids.tolist()), name=''),
        severity=Severity.NOTE,
        numbers={'beads': len(ids), 'largest_mm': largest},
    )


def check_survey(beads: SurveyedBeads, is_given: bool = True) -> list[Check]:
    """Return the checks of the geometry, the scale, the ids and the precision of a survey.

    If the unit of the distances is wrong, nothing else in mm is checked. is_given: whether
    coordinates were given; else there is nothing to compare scale, ids and precision with.
    """
    if not is_given:
        return [_check_intersection(beads), _check_distances(beads, is_given)]
    wrong_unit = _wrong_unit(beads)
    if wrong_unit is not None:
        return [_check_intersection(beads), wrong_unit]
    return [
        _check_intersection(beads),
        _check_distances(beads),
        *([] if beads.scaled is None else [_check_scale(beads)]),
        _check_layout(beads),
        _check_precision(beads),
    ]


def taken_on_trust(beads: SurveyedBeads, is_given: bool = True) -> list[Finding]:
    """Return notes on errors that nothing would show.

    is_given: whether coordinates were given, with a scale.
    """
    unseen = OFF_SD * _given_scale_sd(beads) if is_given else np.inf
    limit = f'if it is below {100 * unseen:.2f} %' if is_given else 'without given coordinates'
    notes = []
    if beads.scaled is not None:
        notes.append(
            'the scale is that of the measured distances: an error that they share, such as that '
            f'of the caliper, is not seen {limit}'
        )
    if not is_given:
        notes.append(
            'images that are mirrored give the mirror image of the phantom: compare the order of '
            'some beads with that on the phantom'
        )
    return [
        Finding(
            Kind.TAKEN_ON_TRUST,
            note,
            Place(name=''),
            severity=Severity.NOTE,
            numbers={'scale': unseen} if is_given else {},
        )
        for note in notes
    ]


def check_survey_halves(one: SurveyedBeads, other: SurveyedBeads) -> Check:
    """Compare surveys from two halves of the exposures, up to shift, rotation and scale.

    Neither has a datum of its own: each is fitted to the given coordinates of its beads.
    """
    common_ids = np.intersect1d(one.target_id, other.target_id)
    if len(common_ids) < MIN_BEADS:
        reason = f'two halves of the exposures have only {len(common_ids)} beads in common'
        return not_made(Kind.HALVES, reason)
    one, other = (
        beads.without(np.setdiff1d(beads.target_id, common_ids)) for beads in (one, other)
    )
    difference = (one.xyz_mm - other.xyz_mm).reshape(-1, 1)
    covariance = one.covariance + other.covariance
    flat = similarity_directions(one.given_mm, one.given_mm.mean(axis=0)).reshape(-1, DATUM_DEFECT)
    flat = flat / np.linalg.norm(flat, axis=0)
    weighted = _weighted_by(one, other, flat)
    remainder = difference - flat @ np.linalg.solve(
        flat.T @ weighted(flat), flat.T @ weighted(difference)
    )
    square = float(np.sum(remainder * weighted(remainder)))
    freedom = 3 * len(common_ids) - DATUM_DEFECT
    rms = float(np.sqrt(np.mean(remainder**2)))
    expected = float(np.sqrt(np.trace(covariance, axis1=1, axis2=2).mean() / 3))
    return Check(
        Kind.HALVES,
        f'two halves of the exposures give coordinates that differ by {rms:.3f} mm, where '
        f'{expected:.3f} mm is predicted',
        advice='keep phantom and fluoroscope still during each exposure, and take more exposures',
        numbers={'difference_mm': rms, 'predicted_mm': expected, 'beads': len(common_ids)},
        value=square / freedom,
        limit=max(HALVES_LIMIT, float(chdtri(freedom, CONTRADICTION)) / freedom),
        unit='predicted variance',
    )


def _weighted_by(
    one: SurveyedBeads, other: SurveyedBeads, datum: NDArray[np.float64]
) -> Callable[[NDArray[np.float64]], NDArray[np.float64]]:
    """Return the product with the information of the difference of two surveys, as a function.

    It multiplies values (3n, k). A few beads share the errors of interior orientation and
    correction; the datum (3n, 7), with unit columns, is not known to either survey.
    """
    if one.joint_covariance is not None and other.joint_covariance is not None:
        total = one.joint_covariance + other.joint_covariance
        information = np.linalg.inv(total + UNKNOWN * np.trace(total) * datum @ datum.T)
        return lambda values: information @ values
    blocks = np.linalg.inv(one.covariance + other.covariance)
    return lambda values: (blocks @ values.reshape(len(blocks), 3, -1)).reshape(values.shape)


def _check_intersection(beads: SurveyedBeads) -> Check:
    angle = float(np.median(beads.angle_rad))
    return Check(
        Kind.WEAK_INTERSECTION,
        f'the rays of a bead meet at up to {np.rad2deg(angle):.0f} degrees (median)',
        advice='turn the phantom between the exposures, by 90 degrees in total',
        numbers={'angle_deg': float(np.rad2deg(angle))},
        value=1 / np.tan(max(angle, 1e-9) / 2),
        limit=1 / np.tan(MIN_ANGLE_RAD / 2),
        unit='error along a ray over that across',
    )


def _wrong_unit(beads: SurveyedBeads) -> Check | None:
    """Return the failed check of distances that are in another unit than the coordinates."""
    for factor, wrong, right in (
        (1 / beads.scale, 'measured distances', 'given coordinates'),
        (beads.scale, 'given coordinates', 'measured distances'),
    ):
        unit = mistaken_unit(factor)
        if beads.scaled is not None and unit:
            return Check(
                Kind.WRONG_UNIT,
                f'the {wrong} are in {unit}, not in mm: by the {right} lengths are '
                f'{factor:.4g} times larger',
                advice=f'give the {wrong} in mm',
                numbers={'factor': factor, 'scale': beads.scale},
                value=factor,
                limit=1 + SCALE_TOLERANCE,
                unit='ratio of lengths',
            )
    return None


def _check_distances(beads: SurveyedBeads, is_given: bool = True) -> Check:
    numbers = {'scale': beads.scale, 'scale_sd': beads.scale_sd, 'distances': 0}
    scale = f'the scale is {beads.scale:.6f} (sd {beads.scale_sd:.6f}) times that of the given '
    scale += 'coordinates'
    if not is_given:
        scale = f'the scale has a standard deviation of {beads.scale_sd:.6f}'
    advice = 'measure two distances or more between beads that are far apart, and give them'
    if beads.scaled is None:
        return Check(
            Kind.DISTANCES,
            'no distance was measured, the scale is that of the given coordinates '
            f'(sd {beads.scale_sd:.6f}, if their errors are independent)',
            advice=advice,
            numbers=numbers,
        )
    numbers['distances'] = len(beads.distances)
    if not beads.scaled.freedom:
        return Check(
            Kind.DISTANCES,
            f'{scale}, from one distance without a check',
            advice=advice,
            numbers=numbers,
        )
    ratio = np.abs(beads.scaled.normalised)
    worst = int(np.argmax(ratio))
    error = float(beads.scaled.error_mm[worst])
    # With two distances, either may be wrong.
    named = beads.distances if len(ratio) == 2 else beads.distances[worst : worst + 1]
    names = ' or '.join(distance.name for distance in named)
    return Check(
        Kind.DISTANCES,
        f'{scale}, from {len(ratio)} distances; the largest error, of {names}, is '
        f'{abs(error):.3f} mm, {ratio[worst]:.1f} times its sd',
        Place(
            target_id=tuple(
                end for distance in named for end in (distance.first, distance.second)
            ),
            name='',
        ),
        'measure again, between the centres of the beads, or give a larger sd',
        numbers={**numbers, 'error_mm': error, 'normalised': float(ratio[worst])},
        value=beads.scaled.chi2,
        limit=float(chdtri(beads.scaled.freedom, CONTRADICTION)),
        unit='chi2',
    )


def _check_scale(beads: SurveyedBeads) -> Check:
    """Compare the scale of the distances with that of the given coordinates."""
    change = beads.scale - 1
    return Check(
        Kind.SCALE,
        f'by the measured distances the beads are {100 * change:+.2f} % further apart than by the '
        'given coordinates',
        advice='check for an error that all distances share, such as that of the caliper; if the '
        'given coordinates have another scale, give them a larger sd',
        numbers={'scale': beads.scale, 'given_scale_sd': _given_scale_sd(beads)},
        value=abs(change),
        limit=OFF_SD * float(np.hypot(_given_scale_sd(beads), beads.scale_sd)),
        unit='relative',
    )


def _given_scale_sd(beads: SurveyedBeads) -> float:
    """Return the change of scale that moves the given coordinates by their sd (RMS)."""
    arm = beads.given_mm - beads.given_mm.mean(axis=0)
    return float(np.sqrt(np.mean(beads.given_sd_mm**2) / np.mean(arm**2)))


def _check_layout(beads: SurveyedBeads) -> Check:
    """Check for beads further off than half a spacing, which may be others unless sds allow it."""
    nearest = float(np.median(KDTree(beads.given_mm).query(beads.given_mm, k=2)[0][:, 1]))
    off_mm = float(np.sqrt(np.mean(beads.off_mm**2)))
    tolerance = OFF_SD * np.sqrt(3) * float(np.sqrt(np.mean(beads.given_sd_mm**2)))
    return Check(
        Kind.OTHER_PHANTOM,
        f'the beads lie {off_mm:.2f} mm from the given coordinates, neighbours are {nearest:.2f} '
        'mm apart',
        advice='check that the ids of the image points are those of the given coordinates, and '
        'that their sd states how rough they are',
        numbers={'off_mm': off_mm, 'spacing_mm': nearest},
        value=off_mm,
        limit=max(nearest / 2, tolerance),
        unit='mm',
    )


def _check_precision(beads: SurveyedBeads) -> Check:
    sd = float(np.median(beads.sd_mm))
    given_sd = float(np.median(beads.given_sd_mm))
    return Check(
        Kind.PRECISION,
        f'the coordinates have a standard deviation of {sd:.3f} mm (median), the given ones '
        f'{given_sd:.3f} mm',
        advice='take more exposures, and measure longer distances, or keep the given coordinates',
        numbers={'sd_mm': sd, 'given_sd_mm': given_sd},
        value=sd,
        limit=given_sd,
        unit='mm',
    )
