# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What a person should look at after an adjustment: bad exposures, and ids that may be wrong."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
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
    for point in result.outliers[0]:
        name, exposure, target = point['fluoroscope'], point['exposure'], point['target_id']
        here = (table.fluoroscope == name) & (table.exposure == exposure)
        for row in np.flatnonzero(here & (table.target_id == target)):
            length = float(np.hypot(*table.residual[row]))
            sd = float(np.sqrt(point['value']))
            limit = float(np.sqrt(point['critical']))
            yield Doubtful(
                name,
                exposure,
                exposure,
                target,
                f'residual {length:.2f} px, {sd:.1f} times its standard deviation '
                f'(limit {limit:.1f})',
                others=_may_be(result, table, here, row, length * limit / sd),
                uv=(round(float(table.uv[row, 0]), 4), round(float(table.uv[row, 1]), 4)),
                residual_px=round(length, 3),
            )


def _may_be(
    result: CalibrationResult,
    table: ResidualTable,
    here: NDArray[np.bool_],
    row: np.intp,
    limit_px: float,
) -> tuple[int, ...]:
    """Return other targets in whose place an image point would pass its test, the nearest first.

    here (N,): the image points of its exposure. Those that fit where they are, are none of them.
    limit_px: of its residual; at other targets it has about the same standard deviation.
    """
    name = str(table.fluoroscope[row])
    figures = result.fluoroscopes[name]
    pose = next(e for e in figures.exposures if e.exposure == table.exposure[row])
    outlying = {
        p['target_id']
        for p in result.outliers[0]
        if p['fluoroscope'] == name and p['exposure'] == pose.exposure
    }
    seen = set(table.target_id[here].tolist()) - outlying
    ids = result.targets.target_id
    others = np.array([i not in seen and i != table.target_id[row] for i in ids.tolist()])
    if not others.any():
        return ()
    points = result.targets.xyz_mm[others]
    count = len(points)
    uv: Any = project(
        np.broadcast_to(matrix_from_quaternion(pose.quaternion_wxyz), (count, 3, 3)),
        np.broadcast_to(pose.position_mm, (count, 3)),
        points,
        figures.interior,
    )
    distance = np.linalg.norm(table.uv[row] - table.correction[row] - uv, axis=1)
    order = np.argsort(distance)
    return tuple(int(i) for i in ids[others][order[distance[order] < limit_px]])
