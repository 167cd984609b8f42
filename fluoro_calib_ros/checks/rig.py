# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Check 'orientation': the exposures of a rig agree on its relative orientations.

Fluoroscopes of a rig do not move relative to each other while the phantom is moved. If frames of
different exposures have the same number, the relative orientations of the pairs contradict each
other, however well each fluoroscope is calibrated.

Points in space depend on the orientation of the rig as much as on the corrections. Comparing two
fluoroscopes in exposures of the same number reveals frames of different exposures while the
phantom moves. It does not if the motion between the frames is the same each time, as on a
turntable: such a motion looks like a different orientation. Stamps exclude this; without them the
verdict takes it on trust.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from ..correction.fluoroscope_calibration import Calibrations, FluoroscopeCalibration
from ..errors import DataError
from ..estimation.options import CalibrationRequest
from ..estimation.pair_scatter import MOVED_SHARE, PairScatter, steps_of
from ..estimation.result import CalibrationResult, FluoroscopeResult
from ..estimation.rig_orientation import orientation_and_scatter, orientation_of_known
from ..exposures.collector import MIN_EXPOSURES, displacement
from ..exposures.frame import Frame, Frames
from ..findings import Finding, Kind, Place, Severity
from ..photogrammetry.rig_orientation import RigOrientation
from ..photogrammetry.rotations import matrix_from_quaternion, rotation_angle, vector_from_matrix
from .check import Check, not_made
from .inputs import MAX_MISFIT

# Distance, angle [rad] plus relative shift, above which a pair does not belong to the rig.
INTERCHANGED = 0.4
# Scatter of the pairs over their standard deviations above which they are doubtful; in correct
# rigs it is 1.0 to 1.4, and 3 if the model does not follow the distortion at all.
DOUBTFUL_GROWTH = 2.0
MAX_GROWTH = 8.0  # above it, and with a large displacement, there is no orientation
MIN_PAIRS_MOVED = 6
# Subjects of findings on the orientation of a rig.
ORIENTED = 'orientation of the rig'
NOT_ORIENTED = 'no orientation of the rig'


def interchanged(
    names: tuple[str, str], one: FluoroscopeResult, other: FluoroscopeResult
) -> Finding | None:
    """Return a finding if frames of two fluoroscopes are interchanged in some exposures.

    The relative orientation of such a pair is far from the others, while its inverse is near them.
    """
    by_number = {e.exposure: e for e in other.exposures}
    pairs = [(e, by_number[e.exposure]) for e in one.exposures if e.exposure in by_number]
    if len(pairs) < MIN_EXPOSURES:
        return None
    numbers = [e.exposure for e, _ in pairs]
    r_a, r_b = (matrix_from_quaternion([e.quaternion_wxyz for e in side]) for side in zip(*pairs))
    between = np.array([b.position_mm - a.position_mm for a, b in pairs])
    turn = r_b @ r_a.transpose(0, 2, 1)
    shift = (r_a @ between[..., None])[..., 0]
    middle = int(np.argmin(np.median(_distances(turn, shift, turn, shift), axis=1)))
    mean_turn = turn[middle : middle + 1]
    base = shift[middle : middle + 1]
    is_far = _distances(turn, shift, mean_turn, base)[:, 0] > INTERCHANGED
    inverse_turn = turn.transpose(0, 2, 1)
    inverse_shift = -(turn @ shift[..., None])[..., 0]
    is_inverse = _distances(inverse_turn, inverse_shift, mean_turn, base)[:, 0] < INTERCHANGED / 2
    swapped = tuple(
        int(number) for number, is_wrong in zip(numbers, is_far & is_inverse) if is_wrong
    )
    if not swapped:
        return None
    a, b = names
    cause = (
        f'the frames of fluoroscopes {a} and {b} are interchanged in exposure'
        f'{"s" * (len(swapped) > 1)} {", ".join(map(str, swapped))}'
    )
    return Finding(Kind.FLUOROSCOPES_INTERCHANGED, cause, Place(names, swapped, name=''))


def _distances(
    turn: NDArray[np.float64],
    shift: NDArray[np.float64],
    other_turn: NDArray[np.float64],
    other_shift: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Return distances (k, l) of relative orientations: angle [rad] plus relative shift."""
    angle = rotation_angle(turn[:, None] @ other_turn[None].transpose(0, 1, 3, 2))
    length = np.linalg.norm(other_shift, axis=-1)[None]
    distance = np.linalg.norm(shift[:, None] - other_shift[None], axis=-1)
    return angle + distance / np.maximum(length, 1e-9)


def doubtful(
    scatter: PairScatter, side_px: int, noise_px: float, correction_px: float = 0.0
) -> tuple[bool, list[Finding]]:
    """Return whether exposures determine an orientation of a rig, and doubts about it.

    side_px: longer side of the image. noise_px: a displacement below it is within the noise of
    points. correction_px: standard deviation of the corrections of both fluoroscopes. Without an
    orientation the finding contains the reason.
    """
    a, b = scatter.fluoroscopes
    off_px = float(np.median(scatter.off_px[scatter.used]))
    place = Place((a, b), name=ORIENTED)
    limit_px = _limit_px(scatter, noise_px, correction_px)
    if scatter.unexplained > DOUBTFUL_GROWTH and off_px >= limit_px:
        usable = off_px <= MAX_MISFIT * side_px or scatter.unexplained <= MAX_GROWTH
        kind, exposures, reason = _cause(scatter)
        finding = Finding(
            kind,
            'the exposures contradict each other: the relative orientation of fluoroscopes '
            f'{a} and {b} differs between them by {_px(off_px)}, {scatter.unexplained:.1f} '
            f'times its standard deviation; {reason}',
            Place((a, b), exposures, name=ORIENTED if usable else NOT_ORIENTED),
            severity=Severity.WARNING,
            numbers={'off_px': off_px, 'ratio': float(scatter.unexplained)},
        )
        return usable, [finding]
    out = []
    if not scatter.used.all():
        excluded = tuple(scatter.exposures[~scatter.used].tolist())
        finding = Finding(
            Kind.PAIRS_EXCLUDED,
            f'without exposure {", ".join(map(str, excluded))}, where the relative orientation '
            f'of fluoroscopes {a} and {b} differs by {_size(scatter.off_px[~scatter.used])}',
            place=replace(place, exposures=excluded),
            advice='the frames are from different exposures, or the phantom moved between them',
            severity=Severity.WARNING,
            numbers={'off_px': float(np.max(scatter.off_px[~scatter.used]))},
        )
        out.append(finding)
    if not scatter.corrected and scatter.angle_px >= noise_px:
        finding = Finding(
            Kind.RIG_DEPENDS_ON_ANGLE,
            f'the relative orientation of fluoroscopes {a} and {b} changes with the angle of the '
            f'C-arm, by {_px(scatter.angle_px)}',
            place=place,
            advice='it holds for the mean angle; orient the rig from a capture at the angle in '
            'use',
            severity=Severity.WARNING,
            numbers={'angle_px': float(scatter.angle_px)},
        )
        out.append(finding)
    return True, out


def _limit_px(scatter: PairScatter, noise_px: float, correction_px: float) -> float:
    """Return the displacement [px] from which the scatter of pairs is doubtful.

    The standard deviations of the pairs take the errors of corrections for independent noise of
    the image points, of which the mean over an exposure is left. They are smooth: at worst an
    orientation takes over all of them, with the standard deviation correction_px.
    """
    off_px = float(np.median(scatter.off_px[scatter.used]))
    # Where targets come to lie behind the source, the displacement is infinite.
    predicted = off_px / max(scatter.unexplained, 1.0) if np.isfinite(off_px) else 0.0
    return max(noise_px, DOUBTFUL_GROWTH * float(np.hypot(predicted, correction_px)))


def _px(displacement: float) -> str:
    """Return a displacement as text, with two digits where it is small."""
    if not np.isfinite(displacement):
        return 'more than the image shows'
    return f'{displacement:.2g} px' if displacement < 1 else f'{displacement:.1f} px'


def _size(off_px: NDArray[np.float64]) -> str:
    """Return displacements of image points as text."""
    low, high = float(np.min(off_px)), float(np.max(off_px))
    if not np.isfinite(high):
        return f'{_px(low)} and more' if np.isfinite(low) else _px(low)
    from_low = _px(low).removesuffix(' px')
    return _px(low) if high - low < 0.05 else f'{from_low} to {_px(high)}'


def _cause(scatter: PairScatter) -> tuple[Kind, tuple[int, ...], str]:
    """Return why the pairs scatter: a single move of the rig, if it explains nearly all scatter.

    Returns the kind of finding, the exposures between which the rig was moved, and the cause.
    """
    count = len(scatter.exposures)
    order = np.argsort(scatter.exposures)
    turn = scatter.turn[order]
    columns = scatter.columns[order]
    # Rotations relative to the first pair [rad], and shifts over the distance of the sources.
    base = float(np.median(np.linalg.norm(scatter.shift_mm, axis=1)))
    place = np.hstack(
        [vector_from_matrix(turn @ turn[0].T), scatter.shift_mm[order] / max(base, 1e-9)]
    )
    steps = steps_of(count)
    fits = [_squares(place, np.hstack([columns, step])) for step in steps]
    remaining = [squares for squares, _ in fits]
    if count < MIN_PAIRS_MOVED or min(remaining) > MOVED_SHARE * _squares(place, columns)[0]:
        cause = (
            'frames with the same number are from different exposures, the phantom moved between '
            'them, a fluoroscope or its image is unstable, or the corrections do not hold in all '
            'of them'
        )
        return Kind.PAIRS_CONTRADICT, (), cause
    best = int(np.argmin(remaining))
    split = 2 + best
    numbers = scatter.exposures[order]
    step = fits[best][1][-1]
    before, after = numbers[split - 1 : split + 1].tolist()
    cause = (
        f'a fluoroscope was moved between exposures {before} and {after}, by '
        f'about {np.linalg.norm(step[3:]) * base:.1f} mm and '
        f'{np.rad2deg(np.linalg.norm(step[:3])):.2f} degrees: orient the rig from a capture'
    )
    return Kind.RIG_MOVED, (before, after), cause


def _squares(
    values: NDArray[np.float64], columns: NDArray[np.float64]
) -> tuple[float, np.ndarray]:
    """Fit functions (k, p) to values (k, 6); return residual square sum, coefficients (p, 6)."""
    coefficients = np.linalg.lstsq(columns, values, rcond=None)[0]
    return float(np.sum((values - columns @ coefficients) ** 2)), coefficients


CAPTURE = 'orient the rig from a capture'


@dataclass(frozen=True)
class RigFindings:
    """Results of the exposures on the orientation of a rig."""

    fluoroscopes: tuple[str, ...] = ()  #: empty: no rig, or its orientation is known
    #: None if the exposures do not determine it; the doubts contain the reason
    orientation: RigOrientation | None = None
    doubts: tuple[Finding, ...] = ()
    #: for every fluoroscope except the first; empty if unknown
    scatter: tuple[PairScatter, ...] = ()
    noise_px: float = 0.0  #: largest standard deviation of an image coordinate [px]
    #: for every entry of scatter, standard deviation of the corrections of both fluoroscopes [px]
    correction_px: tuple[float, ...] = ()
    trusted: tuple[Finding, ...] = field(default=())  #: unverified assumptions

    @property
    def notes(self) -> tuple[Finding, ...]:
        """Findings that a user has to know in addition to the check."""
        decided = {Kind.PAIRS_CONTRADICT, Kind.RIG_MOVED, Kind.RIG_NOT_ORIENTED}
        return (
            *(finding for finding in self.doubts if finding.kind not in decided),
            *self.trusted,
        )


def rig_findings(
    request: CalibrationRequest,
    result: CalibrationResult,
    frames: Frames,
    calibrations: Calibrations,
) -> RigFindings:
    """Determine the orientation of a rig from exposures of the phantom.

    request: contains phantom and known orientations. result: adjustment of fluoroscopes of the
    rig. frames, calibrations: of all fluoroscopes of the rig, in their order.
    """
    names = tuple(calibrations)
    if len(names) < 2:
        return RigFindings()
    figures = result.fluoroscopes
    if all(name in request.known_orientations for name in names):
        known = request.known_orientations
        return RigFindings((), orientation_of_known(known, figures, result.calibrations))
    noise = max(calibration.image_sd for calibration in calibrations.values())
    try:
        orientation, scatter = orientation_and_scatter(
            {name: frames[name] for name in names},
            request.phantom,
            calibrations,
            starts=result.starts,
        )
    except DataError as error:
        cause = f'{NOT_ORIENTED}: {error}'
        finding = Finding(
            Kind.RIG_NOT_ORIENTED, cause, Place(names, name=''), severity=Severity.WARNING
        )
        return RigFindings(names, None, (finding,), noise_px=noise)
    side = max(max(calibration.image_size) for calibration in calibrations.values())
    corrections = {name: _correction_sd(frames[name], calibrations[name]) for name in names}
    correction_px = tuple(
        float(np.linalg.norm([corrections[name] for name in pairs.fluoroscopes]))
        for pairs in scatter
    )
    tested = [doubtful(pairs, side, noise, sd) for pairs, sd in zip(scatter, correction_px)]
    refused = tuple(doubt for usable, doubts in tested for doubt in doubts if not usable)
    doubts = refused or tuple(doubt for _, doubts in tested for doubt in doubts)
    assumptions = tuple(_trusted(frames, pairs, noise) for pairs in scatter)
    return RigFindings(
        names,
        None if refused else orientation,
        doubts,
        scatter,
        noise_px=noise,
        correction_px=correction_px,
        trusted=tuple(assumption for assumption in assumptions if assumption is not None),
    )


def _correction_sd(frames: Sequence[Frame], calibration: FluoroscopeCalibration) -> float:
    """Return the median standard deviation of the correction of the image points [px]."""
    return float(
        np.median(
            np.concatenate([calibration.correction(frame.uv, frame.angle).sd for frame in frames])
        )
    )


def check_rig(findings: RigFindings) -> list[Check]:
    """Return a check for every fluoroscope of a rig except the first."""
    if not findings.fluoroscopes:
        return []
    if not findings.scatter:
        (doubt,) = findings.doubts
        return [Check(Kind.ORIENTATION, doubt.cause, doubt.place, doubt.advice or CAPTURE)]
    corrections = findings.correction_px or (0.0,) * len(findings.scatter)
    return [_check(findings, pairs, sd) for pairs, sd in zip(findings.scatter, corrections)]


def _check(findings: RigFindings, pairs: PairScatter, correction_px: float) -> Check:
    """Return the check of the scatter of the pairs of two fluoroscopes."""
    a, b = pairs.fluoroscopes
    if len(pairs.off_px) < 2:
        reason = f'fluoroscopes {a} and {b} have one exposure in common, which contradicts none'
        return not_made(Kind.ORIENTATION, reason, place=Place((a, b), name=ORIENTED))
    off_px = float(np.median(pairs.off_px[pairs.used]))
    doubts = [doubt for doubt in findings.doubts if doubt.place.fluoroscopes == (a, b)]
    doubts = [doubt for doubt in doubts if doubt.kind in (Kind.PAIRS_CONTRADICT, Kind.RIG_MOVED)]
    cause = (
        f'the relative orientation of fluoroscopes {a} and {b} differs between the exposures by '
        f'{off_px:.3f} px, {pairs.unexplained:.1f} times its standard deviation'
    )
    return Check(
        Kind.ORIENTATION,
        doubts[0].cause if doubts else cause,
        doubts[0].place if doubts else Place((a, b), name=ORIENTED),
        '' if doubts and doubts[0].kind is Kind.RIG_MOVED else CAPTURE,  # its cause contains it
        numbers={'ratio': float(pairs.unexplained), 'noise_px': findings.noise_px},
        value=off_px,
        limit=_limit_px(pairs, findings.noise_px, correction_px),
        unit='px',
    )


def _trusted(frames: Frames, pairs: PairScatter, noise_px: float) -> Finding | None:
    """Return the assumption that frames of one number are of one exposure, as a finding.

    Returns None if their stamps verify it: the image of the phantom, at its speed between
    exposures, moves by less than the noise in the time between the frames of a pair.
    """
    a, b = pairs.fluoroscopes
    moved_px = motion_between_stamps(frames[a], frames[b])
    if moved_px is not None and moved_px <= noise_px:
        return None
    reason = 'they have no stamps'
    if moved_px is not None:
        reason = f'by their stamps the image moves by {_px(moved_px)} between them'
    return Finding(
        Kind.TAKEN_ON_TRUST,
        f'the orientation of fluoroscopes {a} and {b} assumes that frames with the same number '
        f'are simultaneous, or that the phantom stands still ({reason}): if the phantom turns '
        'steadily, a constant delay looks like another orientation',
        Place((a, b), name=''),
        severity=Severity.NOTE if moved_px is None else Severity.WARNING,
        numbers={} if moved_px is None else {'moved_px': moved_px},
    )


def motion_between_stamps(one: Sequence[Frame], other: Sequence[Frame]) -> float | None:
    """Return the motion of the image between frames of one number [px]; None without stamps.

    It is the median over the exposures, at the speed of the image between exposures.
    """
    by_number = {frame.number: frame for frame in other if frame.stamp_ns}
    stamped = sorted((f for f in one if f.stamp_ns), key=lambda frame: frame.stamp_ns)
    motions = []
    for before, after in pairwise(stamped):
        partner = by_number.get(after.number)
        shift = displacement(before, after)
        interval = after.stamp_ns - before.stamp_ns
        if partner is None or not np.isfinite(shift) or not interval:
            continue
        motions.append(shift * abs(partner.stamp_ns - after.stamp_ns) / interval)
    return float(np.median(motions)) if motions else None
