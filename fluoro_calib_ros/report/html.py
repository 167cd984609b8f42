# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The report of a calibration as one self-contained HTML file."""

from __future__ import annotations

import base64
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from jinja2 import Environment, FileSystemLoader, StrictUndefined
from matplotlib import style
from matplotlib.figure import Figure
from numpy.typing import NDArray

from ..correction.fluoroscope_calibration import Calibrations
from ..exposures.collector import AREAS, coverage_of
from ..exposures.frame import Frames
from ..exposures.names import Names
from ..exposures.phantom import Phantom
from ..findings import Finding, sentences
from ..photogrammetry.rig_orientation import RigOrientation
from ..photogrammetry.rotations import matrix_from_quaternion
from .figures import STYLE, Scale, common_scale, distortion_figure, svg_bytes
from .report_figures import (
    bead_shifts,
    distribution,
    exposure_bars,
    residual_map,
)
from .residuals import Residuals, position_figure, residuals_of
from .rig_geometry import SpaceAccuracy, beams, drawing, phantom_distance, uncalibrated_share
from .tables import model_text
from .versions import versions

TEMPLATES = Path(__file__).parent / 'templates'
VERDICTS = {
    'pass': 'This calibration can be used.',
    'fail': 'Do not use this calibration.',
    'cannot tell': 'The checks cannot decide whether this calibration can be used.',
    None: 'This calibration has not been validated.',
}
MAX_ROWS = 40  # maximum rows in the lists of outliers and correlations
MAX_ARROWS = 30_000  # maximum number of residuals in all exposures; they take a megabyte
MAX_RADIOGRAPHS_BYTES = 3_000_000  # of all exposures together; 4 MB in the report
# The table of the report has the residuals of each fluoroscope's own adjustments.
RESIDUALS = (
    'Residuals by column and row, to the beads as all fluoroscopes together determine them. Those '
    'before the correction are larger than in an adjustment without it, as the orientations are '
    'those of the calibration'
)


@dataclass(frozen=True)
class ReportInput:
    """Content of a result folder."""

    title: str
    result: Mapping[str, Any]  #: content of result.json
    calibrations: Calibrations
    frames: Frames  #: exposures of the calibration
    phantom: Phantom
    settings: Mapping[str, Any]  #: content of options.json
    validation: Mapping[str, Any] | None = None  #: content of validation.json
    orientation: RigOrientation | None = None
    names: Names = field(default_factory=Names)
    written: str = ''  #: date of result.json, as text
    #: why the rig has no orientation, or why it is doubtful
    rig_note: Finding | None = None
    edited: Finding | None = None  #: inconsistency of result.json itself, such as an edit
    #: accuracy of the beads in space, None for a single fluoroscope
    space: SpaceAccuracy | None = None
    #: JPEG by fluoroscope and exposure, if the exposures come from images
    radiographs: Mapping[str, Mapping[int, bytes]] = field(default_factory=dict)


def report_html(report: ReportInput, progress: Callable[[int, int], object] | None = None) -> str:
    """Return the report as HTML with embedded figures and no external references.

    progress is called with the number of figures drawn so far and the total number.
    """
    residuals = {name: _residuals(report, name) for name in report.calibrations}
    with style.context(['default', STYLE]):
        scale = common_scale(
            (c.model, c.image_size) for c in report.calibrations.values() if c.model.kind != 'none'
        )
        pictures: dict[str, list[tuple[str, str]]] = {name: [] for name in residuals}
        drawn = [
            (name, title, figure)
            for name in residuals
            for title, figure in _figures(report, name, residuals[name], scale)
        ]
        for number, (name, title, figure) in enumerate(drawn):
            if progress is not None:
                progress(number, len(drawn))
            pictures[name].append((title, svg_text(figure)))
        beads = _bead_picture(report)
    return page(
        'report.html',
        given=report,
        verdict=_verdict(report),
        fluoroscopes={name: _fluoroscope(report, name, residuals[name]) for name in residuals},
        pictures=pictures,
        beads=beads,
        rig=drawing(report.result, report.calibrations, report.orientation),
        beams=beams(report.orientation) if report.orientation else [],
        outliers=_outliers(report, residuals),
        arrows=_arrows(report, residuals),
        radiographs=_radiographs(report, residuals),
        space=report.space,
        about=report.settings.get('about') or {},
        adjustments=report.result.get('adjustments', []),
        correlations=report.result.get('correlations', [])[:MAX_ROWS],
    )


def page(template: str, **values: Any) -> str:
    """Render a template with values, the formatter of numbers `text`, and `versions`."""
    return _templates().get_template(template).render(**values, versions=versions(), text=_text)


@cache
def _templates() -> Environment:
    """Return the templates, each of which is compiled once in a process."""
    return Environment(
        loader=FileSystemLoader(TEMPLATES),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )


def _verdict(report: ReportInput) -> dict[str, Any]:
    """Return verdict, its sentence, findings with advice, and checks."""
    verdict = None if report.validation is None else report.validation.get('verdict')
    findings = sentences(filter(None, [report.edited]))
    findings += report.validation.get('findings', []) if report.validation else []
    findings += [f'Implausible: {doubt}' for doubt in report.result.get('doubts', [])]
    findings += sentences(filter(None, [report.rig_note]))
    if verdict is None:
        findings.insert(
            0, 'Run fluoro-calib validate on this folder, then write the report again.'
        )
    if verdict == 'pass' and not findings:
        findings.append('Correct and reconstruct with it; keep this report with your data.')
    return {
        'name': verdict or 'not validated',
        'class': (verdict or 'none').replace(' ', '-'),
        'sentence': VERDICTS.get(verdict, VERDICTS['cannot tell']),
        'findings': findings,
        'checks': [
            {'sentence': '', 'advice': '', **check, 'mm': _check_mm(report, check)}
            for check in (report.validation.get('checks', []) if report.validation else [])
        ],
    }


def _check_mm(report: ReportInput, check: Mapping[str, Any]) -> float | None:
    """Return the value of a check in mm at the phantom; None if it is not a length."""
    if check.get('value') is None:
        return None
    if check.get('unit') == 'mm':
        return float(check['value'])
    name = str(check.get('fluoroscope'))
    if check.get('unit') != 'px' or name not in report.calibrations:
        return None
    return float(check['value']) * _mm_per_px(report, name)


def _mm_per_px(report: ReportInput, name: str) -> float:
    """Return the size of a pixel at the median distance of the phantom [mm]."""
    distance = phantom_distance(report.result, name)
    return distance / float(report.calibrations[name].interior[2])


def _residuals(report: ReportInput, name: str) -> Residuals:
    exposures = report.result['fluoroscopes'][name]['exposures']
    poses = {
        int(entry['exposure']): (
            matrix_from_quaternion(np.array(entry['quaternion_wxyz'], dtype=float)),
            np.array(entry['position_mm'], dtype=float),
        )
        for entry in exposures
    }
    points = {int(t['target_id']): np.array(t['xyz_mm'], float) for t in report.result['targets']}
    outliers = {
        (int(o['exposure']), int(o['target_id']))
        for o in _outlying_points(report)
        if o['fluoroscope'] == name
    }
    return residuals_of(report.calibrations[name], report.frames[name], poses, points, outliers)


def _outlying_points(report: ReportInput) -> list[Mapping[str, Any]]:
    return list((report.result.get('outliers') or {}).get('image_points', []))


def _outliers(report: ReportInput, residuals: Mapping[str, Residuals]) -> dict[str, Any]:
    """Return the largest outliers, with names and residuals [px], and their number."""
    length = {
        (name, exposure, target): px
        for name, view_residuals in residuals.items()
        for exposure, target, px in zip(
            view_residuals.exposure.tolist(),
            view_residuals.target_id.tolist(),
            np.hypot(*view_residuals.after.T).tolist(),
        )
    }
    points = sorted(_outlying_points(report), key=lambda o: -float(o['value']))
    targets = report.names.target_names()
    exposures = report.names.exposure_names()
    rows = [
        {
            **o,
            'target': targets.get(int(o['target_id']), o['target_id']),
            'exposure_name': exposures.get(int(o['exposure']), o['exposure']),
            'px': length.get((o['fluoroscope'], int(o['exposure']), int(o['target_id']))),
        }
        for o in points[:MAX_ROWS]
    ]
    return {'count': len(points), 'of': sum(len(r.uv) for r in residuals.values()), 'rows': rows}


def residual_rows(report: ReportInput) -> dict[str, Any]:
    """Return the residuals of every exposure as in the report, see `_arrows`."""
    return _arrows(report, {name: _residuals(report, name) for name in report.calibrations})


def _arrows(report: ReportInput, residuals: Mapping[str, Residuals]) -> dict[str, Any]:
    """Return the residuals of every exposure for interactive display; {} if there are too many.

    The rows u, v, du, dv and inlier flag are grouped by fluoroscope and exposure number.
    """
    if sum(len(r.uv) for r in residuals.values()) > MAX_ARROWS:
        return {}
    arrows: dict[str, Any] = {}
    for name, view_residuals in residuals.items():
        view_rows = np.column_stack(
            [view_residuals.uv.round(1), view_residuals.after.round(2), view_residuals.inlier]
        )
        exposures = {
            int(number): view_rows[view_residuals.exposure == number].tolist()
            for number in np.unique(view_residuals.exposure)
        }
        arrows[name] = {'size': list(report.calibrations[name].image_size), 'exposures': exposures}
    return arrows


def _radiographs(
    report: ReportInput, residuals: Mapping[str, Residuals]
) -> dict[str, dict[int, str]]:
    """Return the radiographs in base64, by fluoroscope and exposure.

    If their total size is limited, those with the largest residuals are included first.
    """
    by_rms = sorted(
        (-np.nan_to_num(after, nan=np.inf), name, number)
        for name, view_residuals in residuals.items()
        for number, _, _, after in view_residuals.of_exposures()
        if number in report.radiographs.get(name, {})
    )
    images: dict[str, dict[int, str]] = {}
    bytes_left = MAX_RADIOGRAPHS_BYTES
    for _, name, number in by_rms:
        content = report.radiographs[name][number]
        if len(content) <= bytes_left:
            bytes_left -= len(content)
            images.setdefault(name, {})[number] = base64.b64encode(content).decode()
    return images


def _fluoroscope(report: ReportInput, name: str, residuals: Residuals) -> dict[str, Any]:
    """Return the numbers of a fluoroscope in the report."""
    calibration = report.calibrations[name]
    coverage = coverage_of(residuals.uv, calibration.image_size)
    exposures = report.names.exposure_names()
    sd = np.array([np.nan])
    if len(residuals.uv):
        sd = calibration.correction(residuals.uv, residuals.angle).sd
    return {
        'label': report.names.fluoroscope_names().get(name, name),
        'entry': report.result['fluoroscopes'][name],
        'calibration': calibration,
        'model': model_text(calibration.model),
        'covered': coverage.fraction,
        'missing': [AREAS[area] for area in coverage.missing_areas],
        'correction_sd': float(np.median(sd)),
        'largest': _largest(residuals),
        'correlation': _correlation(calibration.interior_covariance),
        'exterior': [
            (exposures.get(int(e['exposure']), e['exposure']), e)
            for e in report.result['fluoroscopes'][name]['exposures']
        ],
        'exposures': [
            (number, exposures.get(number, number), *statistics)
            for number, *statistics in residuals.of_exposures()
        ],
        'mm_per_px': _mm_per_px(report, name),
        'distance_mm': phantom_distance(report.result, name),
        'uncalibrated': uncalibrated_share(calibration),
    }


def _largest(residuals: Residuals) -> float:
    """Return the largest correction at an image point [px]."""
    correction = residuals.before - residuals.after
    return float(np.nanmax(np.hypot(*correction.T))) if len(correction) else float('nan')


def _correlation(covariance: NDArray[np.float64]) -> list[list[float]]:
    sd = np.sqrt(np.diag(covariance))
    scale = np.outer(np.where(sd > 0, sd, np.nan), np.where(sd > 0, sd, np.nan))
    return (covariance / scale).tolist()


def _figures(
    report: ReportInput, name: str, residuals: Residuals, scale: Scale
) -> list[tuple[str, Figure]]:
    """Return titles and figures of a fluoroscope."""
    calibration = report.calibrations[name]
    size = calibration.image_size
    figures: list[tuple[str, Figure]] = []
    if calibration.model.kind != 'none':
        field_figure = distortion_figure(
            calibration.model, name, size, calibration.interior_estimated, scale
        )
        figures.append(('Distortion and its standard deviation', field_figure))
    if residuals.inlier.any():
        title = f'{name}: residuals over the image'
        before, after = (residuals.before, residuals.inlier), (residuals.after, residuals.inlier)
        figures += [
            (RESIDUALS, position_figure(title, residuals.uv, before, after, size)),
            ('Residuals and coverage', residual_map(residuals, name, size)),
            ('RMS and number of beads by exposure', exposure_bars(residuals, name)),
            ('Distribution of the residuals', distribution(residuals, name)),
        ]
    return figures


def svg_text(figure: Figure) -> str:
    """Return a figure as SVG in base64."""
    return base64.b64encode(svg_bytes(figure)).decode()


def _bead_picture(report: ReportInput) -> dict[str, Any] | None:
    """Return the shifts of the beads from the survey, None without beads."""
    targets = report.result['targets']
    ids = np.array([t['target_id'] for t in targets], dtype=np.int64)
    row = report.phantom.index(ids) if len(ids) else np.zeros(0, dtype=int)
    on_phantom = row >= 0
    if on_phantom.sum() < 2:
        return None
    xyz = np.array([t['xyz_mm'] for t in targets], dtype=float)[on_phantom]
    shift = xyz - report.phantom.xyz_mm[row[on_phantom]]
    sd = report.phantom.sd_mm[row[on_phantom]]
    order = np.argsort(-np.hypot(np.hypot(*shift.T[:2]), shift.T[2]) / sd)[:10]
    names = report.names.target_names()
    return {
        'svg': svg_text(bead_shifts(shift, sd)),
        'rms': np.sqrt(np.mean(shift**2, axis=0)).tolist(),
        'largest': [
            (names.get(int(i), int(i)), shift[k].tolist(), float(sd[k]))
            for i, k in zip(ids[on_phantom][order], order)
        ],
    }


def _text(value: Any, digits: int = 3) -> str:
    """Format a number for people; a missing one is a dash."""
    if value is None or (isinstance(value, float) and not np.isfinite(value)):
        return '–'
    return f'{float(value):.{digits}f}'
