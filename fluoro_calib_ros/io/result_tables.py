# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Tables of a result as CSV files, and covariance matrices (docs/files.md)."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..estimation.diagnostics import ResidualTable
from ..estimation.fixed_calibration import JointPrecision
from ..estimation.result import CalibrationResult
from ..records import Field
from .access import PathLike
from .arrays import Layout, read_arrays, to_arrays, write_arrays
from .atomic import atomic_file
from .csv_table import format_float, write_rows

RESIDUALS = 'residuals.csv'
EXPOSURES = 'exposures.csv'
TARGETS = 'targets.csv'
INTERIOR = 'interior.csv'
NAMES = (RESIDUALS, EXPOSURES, TARGETS, INTERIOR)

_RESIDUALS_HEADER = (
    'fluoroscope,exposure,target_id,u_px,v_px,correction_u_px,correction_v_px,residual_u_px,'
    'residual_v_px,redundancy_u,redundancy_v,weight,outlier'
)
_EXPOSURES_HEADER = (
    'fluoroscope,exposure,x_mm,y_mm,z_mm,qw,qx,qy,qz,sd_x_mm,sd_y_mm,sd_z_mm,'
    'sd_turn_x_rad,sd_turn_y_rad,sd_turn_z_rad,image_points,outliers,rmse_u_px,rmse_v_px'
)
_TARGETS_HEADER = 'target_id,x_mm,y_mm,z_mm,sd_x_mm,sd_y_mm,sd_z_mm,image_points,outliers'
_INTERIOR_HEADER = (
    'fluoroscope,xp_px,yp_px,c_px,sd_xp_px,sd_yp_px,sd_c_px,width_px,height_px,model,k,'
    'image_points,inliers,rmse_before_u_px,rmse_before_v_px,rmse_after_u_px,rmse_after_v_px'
)


def write_tables(directory: Path, result: CalibrationResult) -> None:
    """Write the tables of a result into a folder. Raises DataError."""
    tables = {
        EXPOSURES: (_EXPOSURES_HEADER, _exposures(result)),
        TARGETS: (_TARGETS_HEADER, _targets(result)),
        INTERIOR: (_INTERIOR_HEADER, _interior(result)),
    }
    if result.residuals is not None:
        tables[RESIDUALS] = (_RESIDUALS_HEADER, _residuals(result.residuals))
    for name, (header, rows) in tables.items():
        with atomic_file(directory / name, 'w') as file:
            write_rows(file, [header.split(',')])
            write_rows(file, rows)


def _floats(values: Iterable[float]) -> list[str]:
    return [format_float(float(value)) for value in values]


def _residuals(table: ResidualTable) -> Iterator[Sequence[Any]]:
    figures = np.column_stack(
        [table.uv, table.correction, table.residual, table.redundancy, table.weight]
    )
    for name, exposure, target, row, outlier in zip(
        table.fluoroscope, table.exposure, table.target_id, figures, table.outlier
    ):
        yield [name, int(exposure), int(target), *_floats(row), int(outlier)]


def _exposures(result: CalibrationResult) -> Iterator[Sequence[Any]]:
    for name, figures in result.fluoroscopes.items():
        for e in figures.exposures:
            orientation = (*e.position_mm, *e.quaternion_wxyz, *e.sd_mm, *e.sd_rad)
            yield [
                name,
                e.exposure,
                *_floats(orientation),
                *_fit_of_exposure(result.residuals, name, e.exposure),
            ]


def _fit_of_exposure(table: ResidualTable | None, name: str, exposure: int) -> list[Any]:
    """Image points, outliers and RMSE [px] of the inliers of an exposure; blanks without table."""
    if table is None:
        return ['', '', '', '']
    own = (table.fluoroscope == name) & (table.exposure == exposure)
    core = own & ~table.outlier
    rmse = np.sqrt(np.mean(table.residual[core] ** 2, axis=0)) if core.any() else [np.nan] * 2
    return [int(own.sum()), int(own.sum() - core.sum()), *_floats(rmse)]


def _targets(result: CalibrationResult) -> Iterator[Sequence[Any]]:
    targets = result.targets
    sd = np.sqrt(np.diagonal(targets.covariance, axis1=1, axis2=2))
    table = result.residuals
    for target, xyz, own_sd in zip(targets.target_id, targets.xyz_mm, sd):
        counts: list[Any] = ['', '']
        if table is not None:
            own = table.target_id == target
            counts = [int(own.sum()), int((own & table.outlier).sum())]
        yield [int(target), *_floats(xyz), *_floats(own_sd), *counts]


def _interior(result: CalibrationResult) -> Iterator[Sequence[Any]]:
    for name, figures in result.fluoroscopes.items():
        yield [
            name,
            *_floats((*figures.interior, *figures.interior_sd)),
            *figures.image_size,
            figures.model_kind,
            figures.k,
            figures.observations,
            figures.inliers,
            *_floats((*figures.rmse_before, *figures.rmse_after)),
        ]


# Files <adjustment>.covariance.npz: the covariance matrix of all unknowns.

SUFFIX = '.covariance.npz'
_LAYOUT = Layout(
    'a covariance',
    (
        Field('names', 'text', ('u',)),
        Field('values', 'float', ('u',), allowed='nan'),
        Field('covariance', 'float', ('u', 'u')),
    ),
    version=1,
)


def write_covariance(path: PathLike, joint: JointPrecision) -> None:
    """Write the covariance matrix of an adjustment. Raises DataError."""
    values = {
        'names': np.array(joint.names),
        'values': joint.values,
        'covariance': joint.covariance,
    }
    write_arrays(path, _LAYOUT, to_arrays(path, _LAYOUT, values))


def read_covariance(path: PathLike) -> JointPrecision:
    """Read the covariance matrix of an adjustment. Raises DataError."""
    arrays = read_arrays(path, _LAYOUT)
    names = tuple(str(name) for name in arrays['names'])
    return JointPrecision(names, arrays['values'], arrays['covariance'])
