# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Check 'orientation': the exposures of a rig agree on how its fluoroscopes stand to each other.

Points in space depend on the orientation of the rig as much as on the corrections. What two
fluoroscopes see in exposures of one number shows frames of different exposures while the phantom
moves, but not where the motion between them is the same each time, as on a turntable: such a
motion looks like another orientation. Stamps exclude it; without them the verdict takes it on
trust.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np

from ..correction.fluoroscope_calibration import FluoroscopeCalibration
from ..errors import DataError
from ..estimation.options import CalibrationRequest
from ..estimation.pair_scatter import PairScatter
from ..estimation.result import CalibrationResult
from ..estimation.rig_orientation import orientation_and_scatter, orientation_of_known
from ..exposures.frame import Frame
from ..findings import Finding, Kind, Place, Severity
from ..photogrammetry.rig_orientation import RigOrientation
from .check import Check
from .rigidity import DOUBTFUL_GROWTH, NOT_ORIENTED, ORIENTED, contradiction, doubtful

Frames = Mapping[str, Sequence[Frame]]
Calibrations = Mapping[str, FluoroscopeCalibration]

MIN_COMMON = 8  # targets of two frames whose displacement is known
CAPTURE = 'orient the rig from a capture'


@dataclass(frozen=True)
class RigFindings:
    """What the exposures say about the orientation of a rig."""

    fluoroscopes: tuple[str, ...] = ()  #: empty: they are no rig, or the rig is oriented otherwise
    #: None where the exposures give none; the doubts say why
    orientation: RigOrientation | None = None
    doubts: tuple[Finding, ...] = ()
    #: of every fluoroscope but the first; empty where it is not known
    scatter: tuple[PairScatter, ...] = ()
    noise_px: float = 0.0  #: standard deviation of an image coordinate, the largest of all [px]
    trusted: tuple[Finding, ...] = field(default=())  #: what the exposures cannot show

    @property
    def notes(self) -> tuple[Finding, ...]:
        """What a user has to know beside the check."""
        decided = {Kind.PAIRS_CONTRADICT, Kind.RIG_MOVED, Kind.RIG_NOT_ORIENTED}
        return (*(one for one in self.doubts if one.kind not in decided), *self.trusted)


def rig_findings(
    request: CalibrationRequest,
    result: CalibrationResult,
    frames: Frames,
    calibrations: Calibrations,
) -> RigFindings:
    """Determine the orientation of a rig from exposures of the phantom.

    Parameters
    ----------
    request : CalibrationRequest
        With phantom and known orientations.
    result : CalibrationResult
        Adjustment of fluoroscopes of the rig.
    frames, calibrations : mapping
        Of all fluoroscopes of the rig, in their order.
    """
    names = tuple(calibrations)
    if len(names) < 2:
        return RigFindings()
    figures = result.fluoroscopes
    if all(name in request.known_orientations for name in names):
        known = request.known_orientations
        return RigFindings((), orientation_of_known(known, figures, result.calibrations))
    noise = max(calibration.image_sd for calibration in calibrations.values())
    adjusted = [name for name in names if name in figures]
    for name in adjusted[1:]:
        first = adjusted[0]
        found = contradiction((first, name), figures[first], figures[name])
        if found is not None:
            return RigFindings(names, None, (found,), noise_px=noise)
    try:
        orientation, scatter = orientation_and_scatter(
            {name: frames[name] for name in names},
            request.phantom,
            calibrations,
            starts=result.starts,
        )
    except DataError as error:
        why = f'{NOT_ORIENTED}: {error}'
        found = Finding(
            Kind.RIG_NOT_ORIENTED, why, Place(names, name=''), severity=Severity.WARNING
        )
        return RigFindings(names, None, (found,), noise_px=noise)
    side = max(max(calibration.image_size) for calibration in calibrations.values())
    of_pairs = [doubtful(pairs, side, noise) for pairs in scatter]
    refused = tuple(one for usable, doubts in of_pairs for one in doubts if not usable)
    doubts = refused or tuple(one for _, doubts in of_pairs for one in doubts)
    trusted = tuple(_trusted(frames, pairs, noise) for pairs in scatter)
    return RigFindings(
        names,
        None if refused else orientation,
        doubts,
        scatter,
        noise,
        tuple(one for one in trusted if one is not None),
    )


def check_rig(found: RigFindings) -> list[Check]:
    """Return a check for every fluoroscope of a rig but the first."""
    if not found.fluoroscopes:
        return []
    if not found.scatter:
        (doubt,) = found.doubts
        contradicts = doubt.kind is Kind.PAIRS_CONTRADICT
        return [
            Check(
                Kind.ORIENTATION,
                doubt.cause,
                doubt.place,
                doubt.advice or CAPTURE,
                numbers=doubt.numbers,
                value=doubt.numbers['ratio'] if contradicts else np.nan,
                limit=1.0 if contradicts else np.nan,
                unit='largest of a rig' if contradicts else '',
            )
        ]
    return [_check(found, pairs) for pairs in found.scatter]


def _check(found: RigFindings, pairs: PairScatter) -> Check:
    """Check of the scatter of the pairs of two fluoroscopes."""
    a, b = pairs.fluoroscopes
    off = float(np.median(pairs.off_px[pairs.used]))
    predicted = off / max(pairs.unexplained, 1.0)
    wrong = [one for one in found.doubts if one.place.fluoroscopes == (a, b)]
    wrong = [one for one in wrong if one.kind in (Kind.PAIRS_CONTRADICT, Kind.RIG_MOVED)]
    cause = (
        f'the relative orientation of fluoroscopes {a} and {b} differs between the exposures by '
        f'{off:.2f} px, {pairs.unexplained:.1f} times its standard deviation'
    )
    return Check(
        Kind.ORIENTATION,
        wrong[0].cause if wrong else cause,
        wrong[0].place if wrong else Place((a, b), name=ORIENTED),
        '' if wrong and wrong[0].kind is Kind.RIG_MOVED else CAPTURE,  # its cause says so
        numbers={'ratio': float(pairs.unexplained), 'noise_px': found.noise_px},
        value=off,
        limit=max(found.noise_px, DOUBTFUL_GROWTH * predicted),
        unit='px',
    )


def _trusted(frames: Frames, pairs: PairScatter, noise_px: float) -> Finding | None:
    """Return what is taken on trust: that frames of one number are of one exposure.

    None where their stamps say so: the image of the phantom, as fast as from exposure to exposure,
    moves by less than the noise in the time between the frames of a pair.
    """
    a, b = pairs.fluoroscopes
    moved = motion_between_stamps(frames[a], frames[b])
    if moved is not None and moved <= noise_px:
        return None
    why = 'they have no stamps'
    if moved is not None:
        why = f'by their stamps the image moves by {moved:.1f} px between them'
    return Finding(
        Kind.TAKEN_ON_TRUST,
        f'the orientation of fluoroscopes {a} and {b} takes on trust that frames of one number '
        f'are of one exposure, or that the phantom stands still ({why}): a delay that is always '
        'the same looks like another orientation where the phantom turns steadily',
        Place((a, b), name=''),
        severity=Severity.NOTE if moved is None else Severity.WARNING,
        numbers={} if moved is None else {'moved_px': moved},
    )


def motion_between_stamps(one: Sequence[Frame], other: Sequence[Frame]) -> float | None:
    """Return by how much the image moves between frames of one number [px], None: no stamps.

    It is the median over the exposures, at the speed from exposure to exposure.
    """
    there = {frame.number: frame for frame in other if frame.stamp_ns}
    stamped = sorted((f for f in one if f.stamp_ns), key=lambda frame: frame.stamp_ns)
    moved = []
    for before, after in pairwise(stamped):
        partner = there.get(after.number)
        _, i, j = np.intersect1d(before.target_id, after.target_id, return_indices=True)
        interval = after.stamp_ns - before.stamp_ns
        if partner is None or len(i) < MIN_COMMON or not interval:
            continue
        displacement = np.median(np.linalg.norm(after.uv[j] - before.uv[i], axis=1))
        moved.append(displacement * abs(partner.stamp_ns - after.stamp_ns) / interval)
    return float(np.median(moved)) if moved else None
