# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What a person should look at after an adjustment: bad exposures, and ids that may be wrong."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from itertools import groupby
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..estimation.result import CalibrationResult
from ..estimation.rounds import ResidualTable
from ..exposures.decisions import Doubtful
from ..findings import Finding, Kind, Severity
from ..photogrammetry.collinearity import project
from ..photogrammetry.rotations import matrix_from_quaternion
from .check import Check

# Of what is excluded; a repeated pose is joined, and targets of few rays are no fault of a point.
BAD = {
    Kind.COPIED_EXPOSURE,
    Kind.FALSE_MATCHES,
    Kind.FEW_TARGETS,
    Kind.NOT_ORIENTED,
    Kind.POOR_FIT,
    Kind.SHARED_EXPOSURE,
    Kind.STRAY_POINTS,
}


def doubtful_observations(
    result: CalibrationResult, checks: Iterable[Check] = ()
) -> list[Doubtful]:
    """Return exposures that are excluded or fail their check, and image points that fail theirs.

    checks: of the verdict on the calibration.
    """
    failed = [c for c in checks if c.kind is Kind.EXPOSURES and c.passed is False]
    excluded = [f for f in result.findings if f.severity is Severity.NOTE and f.kind in BAD]
    out = [one for finding in (*failed, *excluded) for one in _of_finding(finding)]
    if result.residuals is not None:
        out += _outlying_points(result, result.residuals)
    return out


def _of_finding(found: Finding) -> Iterator[Doubtful]:
    place = found.place
    for name in place.fluoroscopes:
        for exposure in place.exposures:
            for target in place.target_id or (None,):
                yield Doubtful(name, exposure, exposure, target, found.cause)


def _outlying_points(result: CalibrationResult, table: ResidualTable) -> Iterator[Doubtful]:
    """Yield the image points that fail their test, with the targets that they may be."""

    def of_exposure(point: Mapping[str, Any]) -> tuple[str, int]:
        return point['fluoroscope'], point['exposure']

    for (name, exposure), points in groupby(
        sorted(result.outliers[0], key=of_exposure), of_exposure
    ):
        tests = {point['target_id']: point for point in points}
        here = (table.fluoroscope == name) & (table.exposure == exposure)
        rows = np.flatnonzero(here & np.isin(table.target_id, list(tests)))
        lengths = np.linalg.norm(table.residual[rows], axis=1)
        found = [tests[target] for target in table.target_id[rows].tolist()]
        sd = np.sqrt([point['value'] for point in found])
        limit = np.sqrt([point['critical'] for point in found])
        may_be = _may_be(result, table, here, rows, lengths * limit / sd)
        for k, row in enumerate(rows):
            yield Doubtful(
                name,
                exposure,
                exposure,
                int(table.target_id[row]),
                f'residual {lengths[k]:.2f} px, {sd[k]:.1f} times its standard deviation '
                f'(limit {limit[k]:.1f})',
                others=may_be[k],
                uv=(round(float(table.uv[row, 0]), 4), round(float(table.uv[row, 1]), 4)),
                residual_px=round(float(lengths[k]), 3),
            )


def _may_be(
    result: CalibrationResult,
    table: ResidualTable,
    here: NDArray[np.bool_],
    rows: NDArray[np.intp],
    limit_px: NDArray[np.float64],
) -> list[tuple[int, ...]]:
    """Return other targets in whose place image points would pass their test, the nearest first.

    here (N,): the image points of their exposure; rows (k,): those that fail. A target that fits
    where it is, is none of them, and each is only for the image point that is nearest to it.
    limit_px (k,): of residuals; at other targets they have about the same standard deviation.
    """
    name = str(table.fluoroscope[rows[0]])
    figures = result.fluoroscopes[name]
    pose = next(e for e in figures.exposures if e.exposure == table.exposure[rows[0]])
    ids = result.targets.target_id
    fits = here.copy()
    fits[rows] = False
    others = ~np.isin(ids, table.target_id[fits])
    if not others.any():
        return [()] * len(rows)
    points = result.targets.xyz_mm[others]
    count = len(points)
    uv: Any = project(
        np.broadcast_to(matrix_from_quaternion(pose.quaternion_wxyz), (count, 3, 3)),
        np.broadcast_to(pose.position_mm, (count, 3)),
        points,
        figures.interior,
    )
    seen = table.uv[rows] - table.correction[rows]
    distance = np.linalg.norm(seen[:, None] - uv, axis=2)
    nearest = distance.argmin(axis=0) == np.arange(len(rows))[:, None]
    fitting = nearest & (distance < limit_px[:, None])
    own = table.target_id[rows][:, None] == ids[others]
    return [
        tuple(ids[others][order][good[order]].tolist())
        for order, good in zip(np.argsort(distance, axis=1), fitting & ~own)
    ]
