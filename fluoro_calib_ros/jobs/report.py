# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The report job: read a result folder and write DIR/report.html."""

from __future__ import annotations

import os
import shutil
import subprocess
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

import numpy as np
from jinja2 import UndefinedError

from ..checks.comparison import Comparison, compare_calibrations
from ..correction.fluoroscope_calibration import Calibrations, ids_of
from ..errors import DataError
from ..estimation.options import CalibrationRequest
from ..findings import Finding, Kind, Place, Severity
from ..io.access import PathLike, write_bytes, write_text
from ..io.calibration import (
    OPTIONS,
    VALIDATION_NAME,
    changed_since_verdict,
    edited,
    exchanged,
    load_calibrations,
    read_result,
)
from ..io.calibration import RESULT_NAME as RESULT
from ..io.calibration_request import read_radiographs, read_request
from ..io.csv_table import read_names
from ..io.documents import read_json
from ..photogrammetry.rig_orientation import RigOrientation
from ..report.html import ReportInput, report_html, residual_rows
from ..report.rig_geometry import SpaceAccuracy, accuracy_in_space, phantom_distance
from .reconstruction import ReconstructionOptions, reconstruct
from .result_folder import REPORT, belongs_to, saved_orientation, saved_rig_note

# The comparison job: what changed between two result folders.


@dataclass(frozen=True)
class ComparedFolders:
    """Comparisons by fluoroscope, image scales at the phantom, and findings on missing ones."""

    comparisons: dict[str, Comparison]
    #: at the median distance of the phantom; no entry if result.json is missing
    mm_per_px: dict[str, float]
    findings: tuple[Finding, ...]


def compare_folders(first: PathLike, second: PathLike) -> ComparedFolders:
    """Compare the calibrations of the fluoroscopes that two result folders have in common.

    Raises DataError if there are none, and for calibrations that cannot be compared.
    """
    first_calibrations = load_calibrations(first)
    second_calibrations = load_calibrations(second)
    common = [name for name in first_calibrations if name in second_calibrations]
    if not common:
        raise DataError(
            f'{second}: there are calibrations of {", ".join(second_calibrations)}, and in '
            f'{first} of {", ".join(first_calibrations)}: no fluoroscope is in both'
        )
    findings = [
        Finding(
            Kind.NOT_IN_BOTH,
            f'fluoroscope {name} is in {folder} only',
            Place((name,), name=''),
            severity=Severity.NOTE,
        )
        for folder, names, other_names in (
            (first, first_calibrations, second_calibrations),
            (second, second_calibrations, first_calibrations),
        )
        for name in names
        if name not in other_names
    ]
    comparisons = {
        name: compare_calibrations(first_calibrations[name], second_calibrations[name])
        for name in common
    }
    scales = _scales(Path(first), {name: first_calibrations[name] for name in common})
    return ComparedFolders(comparisons, scales, tuple(findings))


def _scales(directory: Path, calibrations: Calibrations) -> dict[str, float]:
    """Return the size of a pixel at the phantom [mm], by fluoroscope of a result folder.

    Raises DataError for a damaged result.json.
    """
    result = read_result(directory, RESULT)
    try:
        return {
            name: phantom_distance(result, name) / float(calibration.interior[2])
            for name, calibration in calibrations.items()
            if name in result.get('fluoroscopes', ())
        }
    except NOT_A_RESULT as error:
        raise _not_a_result(directory, error) from None


# Exceptions raised by reading a damaged result.
NOT_A_RESULT = (
    ArithmeticError,
    AttributeError,
    IndexError,
    KeyError,
    TypeError,
    UndefinedError,
    ValueError,
)


def _not_a_result(directory: PathLike, error: Exception) -> DataError:
    if isinstance(error, DataError):
        return error
    return DataError(
        f'{Path(directory) / RESULT}: this is not the result of a calibration ({error})'
    )


def write_report(directory: PathLike, progress: Callable[[int, int], object] | None = None) -> str:
    """Write DIR/report.html from the result folder of a calibration, and return its path.

    progress is called with the number of finished pictures and their total. Raises DataError for a
    folder that is not the result of a calibration, and if the file cannot be written.
    """
    path = Path(directory) / REPORT
    report_input = read_report_input(directory)
    try:
        with np.errstate(all='ignore'):  # a damaged result may contain huge numbers
            text = report_html(report_input, progress)
    except NOT_A_RESULT as error:
        raise _not_a_result(directory, error) from None
    write_text(path, text)
    return str(path)


def residual_vectors(directory: PathLike) -> dict[str, Any]:
    """Return the residuals of a result folder, by fluoroscope and exposure number.

    For each fluoroscope: size, width and height [px], and exposures, with rows u, v, du, dv [px]
    and whether the point was used. Empty if there are too many. Raises DataError.
    """
    try:
        return residual_rows(read_report_input(directory))
    except NOT_A_RESULT as error:
        raise _not_a_result(directory, error) from None


def read_report_input(directory: PathLike) -> ReportInput:
    """Read the input of the report of a result folder. Raises DataError."""
    directory = Path(directory)
    calibrations = load_calibrations(directory)
    result = read_json(directory / RESULT)
    if not isinstance(result.get('fluoroscopes'), Mapping) or 'targets' not in result:
        raise DataError(f'{directory / RESULT}: this is not the result of a calibration')
    reported = {name: c for name, c in calibrations.items() if name in result['fluoroscopes']}
    if not reported:
        raise DataError(f'{directory / RESULT}: there are no figures of {", ".join(calibrations)}')
    mixed = exchanged(directory, result, reported)
    if mixed is not None:
        raise DataError(mixed)
    request = read_request(directory, reported)
    orientation = saved_orientation(directory)
    if orientation is not None and not belongs_to(orientation, calibrations):
        orientation = None
    verdict = read_result(directory, VALIDATION_NAME)
    if verdict.get('calibration_id') != ids_of(reported):
        verdict = {}
    changed = changed_since_verdict(directory, verdict)
    written_at = datetime.fromtimestamp((directory / RESULT).stat().st_mtime, timezone.utc)
    return ReportInput(
        directory.resolve().name,
        result,
        calibrations=reported,
        frames=request.frames,
        phantom=request.phantom,
        settings=read_json(directory / OPTIONS),
        validation=verdict if verdict and not changed else None,
        orientation=orientation,
        names=read_names(directory),
        written=written_at.strftime('%Y-%m-%d %H:%M UTC'),
        rig_note=saved_rig_note(directory),
        edited=edited(directory, result) or changed,
        space=_accuracy_in_space(request, reported, orientation),
        radiographs=read_radiographs(
            directory,
            ((name, f.number) for name, frames in request.frames.items() for f in frames),
        ),
    )


def _accuracy_in_space(
    request: CalibrationRequest, calibrations: Calibrations, orientation: RigOrientation | None
) -> SpaceAccuracy | None:
    """Return the accuracy of the beads in space, or None if it cannot be determined."""
    if orientation is None or not set(orientation.fluoroscopes) <= set(calibrations):
        return None
    options = ReconstructionOptions(drift_watch=False)
    try:
        outcome = reconstruct(request.frames, calibrations, orientation, options)
    except DataError:  # such as exposures without partner: the verdict reports the reason
        return None
    return accuracy_in_space(outcome.frames, request.phantom)


# Printing a report as PDF with a browser of this machine.
#
# Scripts in the report draw rig, radiographs and residuals, and only a browser runs these.

BROWSERS = (
    *('chromium', 'chromium-browser', 'google-chrome', 'google-chrome-stable', 'chrome'),
    *('microsoft-edge', 'microsoft-edge-stable', 'msedge'),
)
# Locations on Windows and macOS that are not on the search path.
PLACES = (
    r'%ProgramFiles(x86)%\Microsoft\Edge\Application\msedge.exe',
    r'%ProgramFiles%\Google\Chrome\Application\chrome.exe',
    '/Applications/Google Chrome.app/Contents/MacOS/Google Chrome',
    '/Applications/Microsoft Edge.app/Contents/MacOS/Microsoft Edge',
)
PDF_START = b'%PDF-'


def find_browser() -> str | None:
    """Return a browser that can print without a window, or None."""
    paths = (os.path.expandvars(place) for place in PLACES)
    return next(filter(None, map(shutil.which, (*BROWSERS, *paths))), None)


def print_page(page: PathLike, out: PathLike) -> None:
    """Print a local page to PDF. Raises DataError if there is no browser or it fails."""
    browser = find_browser()
    if browser is None:
        raise DataError(
            f'{out}: printing the report needs Chromium, Chrome or Edge, but none is installed; '
            f'open {page} in any other browser and print it from there'
        )
    with tempfile.TemporaryDirectory() as folder:
        printed = Path(folder) / 'page.pdf'
        command = [
            *(browser, '--headless', '--disable-gpu', '--no-first-run', '--no-pdf-header-footer'),
            *(f'--user-data-dir={folder}/profile', f'--print-to-pdf={printed}'),
            Path(page).resolve().as_uri(),
        ]
        if hasattr(os, 'geteuid') and os.geteuid() == 0:
            command.insert(
                1, '--no-sandbox'
            )  # browsers refuse to run sandboxed as root, as in containers
        try:
            process = subprocess.run(command, capture_output=True, timeout=300, check=False)
            content = printed.read_bytes() if printed.exists() else b''
        except (OSError, subprocess.TimeoutExpired) as error:
            raise DataError(f'{out}: {browser} does not print the report ({error})') from None
    if not content.startswith(PDF_START):
        error_lines = process.stderr.decode(errors='replace').strip().splitlines()
        cause = error_lines[-1] if error_lines else f'exit status {process.returncode}'
        raise DataError(f'{out}: {browser} does not print the report ({cause})')
    write_bytes(out, content)
