# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Checks 'beads' and 'distances': beads found from the images alone agree with their survey."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri
from scipy.stats import binom

from ..estimation.diagnostics import ResidualTable
from ..findings import Kind, Place, first_few
from .bead_intersection import Beads, distances, intersect, least_chi2_without_a_ray
from .calibration_evidence import Evidence, Subject
from .check import Check
from .faces import displaced_layer

MIN_BEADS = 10  # for distances
FALSE_ALARM = 2e-3  # chance that any bead of a good phantom is reported
# For the part of the errors of orientations and calibration that all beads have in common.
SD_FACTOR = 1.1
# Times the expectation, from simulated rigs with some 500 beads: docs/verdict.md. With few beads
# the limit is that of a FALSE_ALARM.
DISTANCES_LIMIT = 1.12
MOST = 0.5  # part of the image points of a bead that are rejected, above which it is doubted


def check_beads(evidence: Evidence, names: Sequence[str]) -> list[Check]:
    """Compare the beads that all fluoroscopes see with their survey."""
    found = intersect(evidence.result, evidence.frames, evidence.phantom)
    has_trend = any(common.is_significant for common in evidence.trends.values())

    def least_chi2(target_id: np.ndarray) -> np.ndarray:
        return least_chi2_without_a_ray(
            evidence.result, evidence.frames, evidence.phantom, target_id
        )

    checks = compare_with_survey(found, has_trend, least_chi2)
    doubted = rejected_beads(evidence.result.residuals)
    if len(doubted) and not any(check.passed is False for check in checks):
        checks[0] = _rejected(doubted).after_trend(has_trend)
    return checks


def rejected_beads(residuals: ResidualTable | None) -> NDArray[np.int64]:
    """Return the target ids of beads of which most image points are rejected, and not by chance.

    Too few rays of such a bead may agree to intersect it, but false matches are as frequent among
    its image points as among those of the others.
    """
    if residuals is None or not len(residuals.target_id):
        return np.zeros(0, dtype=np.int64)
    target_id, bead = np.unique(residuals.target_id, return_inverse=True)
    seen = np.bincount(bead)
    rejected = np.bincount(bead, residuals.outlier)
    chance = binom.sf(rejected - 1, seen, np.mean(residuals.outlier))
    doubted = (rejected > MOST * seen) & (chance * len(target_id) < FALSE_ALARM)
    return target_id[doubted]


def _rejected(target_id: NDArray[np.int64]) -> Check:
    """Return check 'beads' that fails because the image points of some beads are rejected."""
    return Check(
        Kind.BEADS,
        f'most image points of bead {first_few(target_id)} are rejected, more than false matches '
        'explain: its survey is wrong, or it is exchanged with another',
        Place(target_id=tuple(target_id.tolist())),
        'survey again, and calibrate again',
        numbers={'beads': len(target_id)},
        value=len(target_id),
        limit=0,
        unit='beads',
    )


def compare_with_survey(
    beads: Beads,
    has_trend: bool = False,
    least_chi2: Callable[[np.ndarray], np.ndarray] | None = None,
) -> list[Check]:
    """Return the checks 'beads' and 'distances'.

    has_trend: whether the residuals of a fluoroscope have a trend. least_chi2: called with target
    ids; returns their smallest squared misclosures with any ray excluded; a bead is out of place
    only if it is so by these, too.
    """
    count = len(beads.target_id)
    if count < MIN_BEADS:
        reason = f'only {count} beads are seen often enough to be found from the images alone'
        return [
            Check(
                kind,
                f'check {kind.value} could not be made, {reason}',
                advice='take more exposures',
                numbers={'beads': count},
            )
            for kind in (Kind.BEADS, Kind.DISTANCES)
        ]
    limit = SD_FACTOR**2 * chdtri(3, FALSE_ALARM / count)
    square = beads.chi2
    suspects = np.flatnonzero(square > limit)
    if least_chi2 is not None and len(suspects):
        square[suspects] = np.minimum(square[suspects], least_chi2(beads.target_id[suspects]))
    order = np.argsort(-square)
    wrong = order[square[order] > limit]
    size = np.linalg.norm(beads.misclosure, axis=1)
    worst = order[0]
    named = beads.target_id[[worst]]
    numbers: dict[str, float] = {'beads': count}
    cause = (
        f'bead {beads.target_id[worst]} lies {size[worst]:.2f} mm from its survey, the worst of '
        f'{count}'
    )
    value = size[worst]
    highest = value * np.sqrt(limit / max(square[worst], 1e-9))
    # A face of which no single bead is significant may be so as a whole.
    layer = displaced_layer(beads)
    if layer is not None:
        named = layer.target_id
        cause = layer.cause
        numbers |= layer.numbers
        if not len(wrong):
            value = layer.size_mm
            highest = layer.limit_mm
    elif len(wrong) and not has_trend:
        named = beads.target_id[wrong]
        cause = _wrong_beads(named, size[wrong])
    check = Check(
        Kind.BEADS,
        cause,
        Place(target_id=tuple(named.tolist())),
        'survey again, or give a larger sd, and calibrate again',
        numbers=numbers,
        value=value,
        limit=highest,
        unit='mm',
    )
    return [
        check.after_trend(has_trend),
        # A bead that is in place without one of its rays has a false match and tells nothing.
        _check_distances(beads.without(beads.target_id[suspects]), has_trend),
    ]


def _wrong_beads(target_id: np.ndarray, size: np.ndarray) -> str:
    """Return the names of the beads with a wrong survey, and their errors [mm]."""
    wrong = first_few(f'{target} is wrong by {mm:.1f} mm' for target, mm in zip(target_id, size))
    return f'the survey of bead {wrong}'


def _check_distances(beads: Beads, has_trend: bool) -> Check:
    if len(beads.target_id) < MIN_BEADS:
        return Check(
            Kind.DISTANCES,
            'check distances could not be made, too few beads agree with their survey',
        )
    found = distances(beads)
    by_chance = float(np.sqrt(chdtri(found.freedom, FALSE_ALARM) / found.freedom))
    return Check(
        Kind.DISTANCES,
        f'distances between beads differ from the survey by {found.rmse_mm:.3f} mm, '
        f'{found.expected_mm:.3f} mm are expected (scale {1 + found.scale:.6f}, '
        f'sd {found.scale_sd:.6f})',
        advice='the survey is less precise than its sd says, or the calibration is wrong if other '
        'checks fail too; survey the phantom again, or give a larger sd',
        numbers={'scale': 1 + found.scale, 'scale_sd': found.scale_sd},
        value=found.rmse_mm,
        limit=max(DISTANCES_LIMIT, by_chance) * found.expected_mm,
        unit='mm',
    ).after_trend(has_trend)


BEADS = Subject(check_beads, of_rig=True)
