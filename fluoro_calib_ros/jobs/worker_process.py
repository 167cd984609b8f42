# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Run a calibration job in another process, so that it does not delay its caller."""

from __future__ import annotations

from collections.abc import Callable

from ..estimation.options import CalibrationRequest
from ..processes import OF_JOB, WorkerProcess
from .calibration import CalibrationOutcome, Progress, Rig, run_calibration


def run_in_worker_process(
    request: CalibrationRequest,
    *,
    validate: bool = False,
    rig: Rig | None = None,
    progress: Progress | None = None,
    raise_if_cancelled: Callable[[], None] | None = None,
) -> CalibrationOutcome:
    """Run `run_calibration` in another process.

    Parameters and errors are those of `run_calibration`. The outcome has no networks.
    raise_if_cancelled is called repeatedly and may raise to terminate the process. Raises
    RuntimeError for any other failure of the process.
    """
    process = WorkerProcess(_calibration, 'the worker process', OF_JOB)
    try:
        return process(
            request, validate, rig, progress=progress, raise_if_cancelled=raise_if_cancelled
        )
    finally:
        process.close()


def _calibration() -> Callable[..., CalibrationOutcome]:
    return _outcome


def _outcome(
    request: CalibrationRequest,
    validate: bool,
    rig: Rig | None,
    progress: Progress | None = None,
) -> CalibrationOutcome:
    """Run the job in the worker process."""
    outcome = run_calibration(request, validate=validate, rig=rig, progress=progress)
    return outcome.without_runs()
