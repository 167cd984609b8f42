# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Results as JSON documents: result.json, validation.json and others."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..checks.check import Check, Validation
from ..checks.rig_watch import DriftVerdict, RigEvidence
from ..correction.calibration_record import Field
from ..correction.fluoroscope_calibration import FluoroscopeCalibration
from ..estimation.constraints import RelativeOrientation
from ..estimation.fixed_calibration import JointPrecision
from ..estimation.result import CalibrationResult, FluoroscopeResult
from ..estimation.rounds import AdjustmentStatistics, ResidualTable, Round
from ..findings import Finding, Severity, sentences
from ..photogrammetry.rig_orientation import RigOrientation
from ..photogrammetry.rotations import quaternion_from_matrix
from .access import PathLike
from .arrays import Layout, read_arrays, to_arrays, write_arrays
from .calibration import VALIDATION_NAME, with_digest, with_digests
from .csv_table import Table
from .documents import write_json

# Version 1 had no version, date, units or adjustments; version 2 no ids, rig note or digest.
FORMAT_VERSION = 3
UNITS = {'lengths': 'mm', 'image': 'px', 'angles': 'rad', 'seconds': 's'}


def result_document(job: CalibrationResult) -> dict[str, Any]:
    """Return a CalibrationResult as the dict of result.json, with its digest.

    Lengths are in mm, image coordinates in px and angles in rad, as the entry `units` states.
    """
    document = {
        'format_version': FORMAT_VERSION,
        'created': job.created,
        'units': UNITS,
        'fluoroscopes': {
            name: {
                'calibration_id': job.calibrations[name].calibration_id,
                **_fluoroscope(figures),
                'noise_px': _noise(job.calibrations[name]),
                **_angle(job.calibrations[name]),
            }
            for name, figures in job.fluoroscopes.items()
        },
        'targets': [
            {'target_id': int(i), 'xyz_mm': xyz, 'sd_mm': sd}
            for i, xyz, sd in zip(
                job.targets.target_id,
                job.targets.xyz_mm,
                np.sqrt(np.diagonal(job.targets.covariance, axis1=1, axis2=2)),
            )
        ],
        'relative_orientation': _relative(job.relative),
        'outliers': {'image_points': list(job.outliers[0]), 'targets': list(job.outliers[1])},
        'adjustments': [_statistics(statistics) for statistics in job.statistics],
        'correlations': [
            {'unknowns': [first, second], 'value': value}
            for first, second, value in job.correlations
        ],
        'history': _history(job.history),
        'converged': job.converged,
        'left_out': sentences(job.findings, Severity.NOTE),
        'seconds': job.seconds,
        'doubts': sentences(job.findings, Severity.ERROR),
        'rig_note': '; '.join(sentences(job.findings, Severity.WARNING)),
        'findings': [finding_document(finding) for finding in job.findings],
    }
    return with_digest(document)


def finding_document(finding: Finding) -> dict[str, Any]:
    """Return a finding as a dict, for programs that act on it."""
    return {
        'kind': finding.kind.value,
        'severity': finding.severity.name.lower(),
        'fluoroscopes': list(finding.place.fluoroscopes),
        'exposures': list(finding.place.exposures),
        'target_id': list(finding.place.target_id),
        'numbers': dict(finding.numbers),
        'sentence': finding.sentence,
    }


def _statistics(statistics: AdjustmentStatistics) -> dict[str, Any]:
    """Return the statistics of an adjustment and of its network."""
    return {
        'fluoroscopes': list(statistics.fluoroscopes),
        'noise': {
            'loss': statistics.loss,
            'sigma0': statistics.sigma0,
            'degrees_of_freedom': statistics.nu,
        },
        'variance_factor': statistics.variance_factor,
        'observations': statistics.observations,
        'unknowns': statistics.unknowns,
        'degrees_of_freedom': statistics.degrees_of_freedom,
        'network': {
            'exposures': statistics.exposures,
            'image_points': statistics.image_points,
            'outliers': statistics.outliers,
            'targets': statistics.targets,
            'image_points_per_target': {
                'least': statistics.least_rays,
                'mean': statistics.mean_rays,
            },
            'redundancy': {
                'least': statistics.least_redundancy,
                'mean': statistics.mean_redundancy,
            },
        },
    }


def _relative(orientations: Sequence[RelativeOrientation]) -> Any:
    """Return the relative orientation of two fluoroscopes, a list for more, None for none."""
    documents = [
        {
            'fluoroscopes': list(o.fluoroscopes),
            'quaternion_wxyz': quaternion_from_matrix(o.pose.rotation),
            'translation_mm': o.pose.translation_mm,
            'sd_mm': o.sd_mm,
            'sd_rad': o.sd_rad,
            'scatter_mm': o.scatter_mm,
            'scatter_rad': o.scatter_rad,
            'exposures': o.exposures,
            'constraint': o.constraint,
        }
        for o in orientations
    ]
    if not documents:
        return None
    return documents[0] if len(documents) == 1 else documents


def _fluoroscope(figures: FluoroscopeResult) -> dict[str, Any]:
    xp, yp, c = figures.interior
    return {
        'interior': {'xp': xp, 'yp': yp, 'c': c, 'sd': figures.interior_sd},
        'image_size': list(figures.image_size),
        'model': {'kind': figures.model_kind, 'k': figures.k},
        'rmse_px': {'before': figures.rmse_before, 'after': figures.rmse_after},
        'inliers': figures.inliers,
        'observations': figures.observations,
        'exposures': [vars(exposure) for exposure in figures.exposures],
    }


def _noise(calibration: FluoroscopeCalibration) -> dict[str, float]:
    """Return the noise of an image coordinate [px], with middle and rim if it depends on place."""
    profile = calibration.noise_profile
    noise = {'sd': calibration.image_sd}
    if profile is not None:
        factors = {'middle': profile.middle, 'rim': profile.rim}
        noise |= {name: calibration.image_sd * factor for name, factor in factors.items()}
    return noise


def _angle(calibration: FluoroscopeCalibration) -> dict[str, Any]:
    """Return the change of a correction with the angle of the C-arm, {} if there is none."""
    field = calibration.angle_field
    if field is None:
        return {}
    return {'angle': {'exposures_rad': field.angles, 'change_rms_px': field.size_px}}


def _history(history: Mapping[str, Sequence[Round]]) -> list[dict[str, Any]]:
    """Return the rounds of all calibrations, one calibration after the other."""
    return [
        {
            'fluoroscopes': label.split('+'),
            'iteration': r.iteration,
            'F': r.F,
            'G': r.G,
            'k': r.k,
            'rmse_px': r.rmse,
            'change_px': r.change,
        }
        for label, rounds in history.items()
        for r in rounds
    ]


def orientation_document(orientation: RigOrientation) -> dict[str, Any]:
    """Return a RigOrientation as a dict: lengths in mm, pixels in px, angles in rad."""
    return {
        'orientation_id': orientation.orientation_id,
        'frame_id': orientation.frame_id,
        'source': orientation.source,
        'exposures': orientation.exposures,
        'fluoroscopes': {
            name: {
                'calibration_id': identity,
                'position_mm': position,
                'quaternion_wxyz': quaternion_from_matrix(rotation),
                'sd_mm': sd_mm,
                'sd_rad': sd_rad,
            }
            for name, identity, position, rotation, sd_mm, sd_rad in zip(
                orientation.fluoroscopes,
                orientation.calibration_ids,
                orientation.position_mm,
                orientation.rotation,
                orientation.sd_mm,
                orientation.sd_rad,
            )
        },
    }


def rig_document(evidence: RigEvidence, begin_ns: int) -> dict[str, Any]:
    """Return what rays say about a rig as a dict; begin_ns: stamp of the first exposure."""
    found = {
        name: None if finding is None else finding_document(finding)
        for name, finding in (
            ('noise', evidence.noise),
            ('disagreement', evidence.disagreement),
            ('timing', evidence.timing),
        )
    }
    return {
        **found,
        'widening': evidence.widening,
        'drift': drift_document(evidence.drift, begin_ns),
    }


def drift_document(verdict: DriftVerdict | None, begin_ns: int) -> dict[str, Any] | None:
    """Return a DriftVerdict as a dict; times [s] are relative to the exposure at begin_ns."""
    if verdict is None:
        return None
    document = {
        'kind': verdict.finding.kind.value,
        'level': verdict.level,
        'message': verdict.message,
        'level_at_end': verdict.level_at_end,
        'watched_s': verdict.watched_s,
    }
    for key in (
        *('fluoroscope', 'place', 'area_px', 'size_px', 'sd_px', 'direction', 'against', 'source'),
        *('evidence', 'threshold_warn', 'threshold_error', 'observations'),
    ):
        document[key] = getattr(verdict.state, key.removesuffix('_px')) if verdict.state else None
    for key, stamp_ns in (('found', verdict.found_ns), ('began', verdict.began_ns)):
        document[f'{key}_stamp_ns'] = stamp_ns
        document[f'{key}_s'] = None if stamp_ns is None else (stamp_ns - begin_ns) / 1e9
    return document


def validation_document(validation: Validation) -> dict[str, Any]:
    """Return a Validation as the dict of validation.json."""
    return {
        'verdict': validation.verdict,
        'findings': sentences(validation.findings),
        'checks': [_check_document(check) for check in validation.checks],
        'calibration_id': dict(validation.calibration_id),
        'achieved_sd_px': dict(validation.achieved_sd_px),
        'notes': sentences(validation.notes),
        'seconds': validation.seconds,
    }


def _check_document(check: Check) -> dict[str, Any]:
    return {
        **finding_document(check),
        'name': check.name,
        'fluoroscope': check.place.fluoroscope,
        'value': check.value,
        'limit': check.limit,
        'unit': check.unit,
        'passed': check.passed,
        'place': check.place.pixel,
        'advice': '' if check.passed else check.advice,
    }


def write_validation(directory: PathLike, validation: Validation) -> dict[str, Any]:
    """Write validation.json as the last file of a folder; return its content. Raises DataError."""
    document = validation_document(validation)
    document = with_digests(directory, document, validation.calibration_id)
    write_json(Path(directory) / VALIDATION_NAME, document)
    return document


# Tables of a result as CSV files, and covariance matrices (docs/files.md).

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


def result_tables(result: CalibrationResult) -> dict[str, Table]:
    """Return the tables of a result by file name."""
    tables = {
        EXPOSURES: (_EXPOSURES_HEADER, _exposures(result)),
        TARGETS: (_TARGETS_HEADER, _targets(result)),
        INTERIOR: (_INTERIOR_HEADER, _interior(result)),
        RESIDUALS: (_RESIDUALS_HEADER, _residuals(result.residuals)),
    }
    return {name: Table(tuple(header.split(',')), rows) for name, (header, rows) in tables.items()}


def _residuals(table: ResidualTable) -> Iterator[Sequence[Any]]:
    figures = np.column_stack(
        [table.uv, table.correction, table.residual, table.redundancy, table.weight]
    )
    for name, exposure, target, row, outlier in zip(
        table.fluoroscope, table.exposure, table.target_id, figures, table.outlier
    ):
        yield [name, int(exposure), int(target), *row.tolist(), int(outlier)]


def _exposures(result: CalibrationResult) -> Iterator[Sequence[Any]]:
    for name, figures in result.fluoroscopes.items():
        for e in figures.exposures:
            orientation = (*e.position_mm, *e.quaternion_wxyz, *e.sd_mm, *e.sd_rad)
            yield [
                name,
                e.exposure,
                *orientation,
                *_fit_of_exposure(result.residuals, name, e.exposure),
            ]


def _fit_of_exposure(table: ResidualTable, name: str, exposure: int) -> list[Any]:
    """Return image points, outliers and RMSE [px] of the inliers."""
    in_exposure = (table.fluoroscope == name) & (table.exposure == exposure)
    is_inlier = in_exposure & ~table.outlier
    rmse = (
        np.sqrt(np.mean(table.residual[is_inlier] ** 2, axis=0))
        if is_inlier.any()
        else [np.nan] * 2
    )
    return [int(in_exposure.sum()), int(in_exposure.sum() - is_inlier.sum()), *rmse]


def _targets(result: CalibrationResult) -> Iterator[Sequence[Any]]:
    targets = result.targets
    sd = np.sqrt(np.diagonal(targets.covariance, axis1=1, axis2=2))
    table = result.residuals
    for target, xyz, target_sd in zip(targets.target_id, targets.xyz_mm, sd):
        of_target = table.target_id == target
        counts = [int(of_target.sum()), int((of_target & table.outlier).sum())]
        yield [int(target), *xyz.tolist(), *target_sd.tolist(), *counts]


def _interior(result: CalibrationResult) -> Iterator[Sequence[Any]]:
    for name, figures in result.fluoroscopes.items():
        yield [
            name,
            *figures.interior,
            *figures.interior_sd,
            *figures.image_size,
            figures.model_kind,
            figures.k,
            figures.observations,
            figures.inliers,
            *figures.rmse_before,
            *figures.rmse_after,
        ]


# Files <adjustment>.covariance.npz: covariance matrix of all unknowns.

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
