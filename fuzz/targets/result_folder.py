# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""result.json of a result folder, as `report` and `convert` read it."""

from __future__ import annotations

import functools
import json
import tempfile
from pathlib import Path
from unittest import mock

from fluoro_calib_ros.estimation.options import CalibrationOptions, CalibrationRequest
from fluoro_calib_ros.io.calibration import RESULT_NAME as RESULT
from fluoro_calib_ros.jobs.calibration import run_calibration
from fluoro_calib_ros.jobs.conversion import stations_of
from fluoro_calib_ros.jobs.report import write_report
from fluoro_calib_ros.jobs.result_folder import save_outcome
from fluoro_calib_ros.report import html
from fluoro_calib_ros.simulation.rig import simulate_exposures

from ..harness import Target, both
from ..seeds import rig


@functools.cache
def _folder() -> tempfile.TemporaryDirectory[str]:
    """Return the result folder of a small calibration; it exists until the process ends."""
    temporary = tempfile.TemporaryDirectory()
    frames = {'a': simulate_exposures(rig(), 5, 1).frames['a']}
    options = CalibrationOptions(model='none', max_iterations=2)
    outcome = run_calibration(CalibrationRequest(frames, rig().phantom, options, False))
    save_outcome(Path(temporary.name) / 'result', outcome)
    return temporary


def _read(path: Path) -> None:
    folder = Path(_folder().name) / 'result'
    (folder / RESULT).write_bytes(path.read_bytes())
    with mock.patch.object(html, '_figures', lambda *_: []):  # slow, from other files
        both(lambda: list(stations_of(folder / RESULT)), lambda: write_report(folder))


@functools.cache
def _seed() -> bytes:
    """Return a result with few targets and exposures."""
    document = json.loads((Path(_folder().name) / 'result' / RESULT).read_text())
    document['targets'] = document['targets'][:3]
    document['correlations'] = document.get('correlations', [])[:2]
    for fluoroscope in document['fluoroscopes'].values():
        fluoroscope['exposures'] = fluoroscope['exposures'][:2]
    return json.dumps(document).encode()


TARGET = Target('result_folder', RESULT, _read, lambda: [_seed()])
