# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Whether the collected exposures suffice for a calibration, and what the next one should show."""

from __future__ import annotations

from dataclasses import dataclass

from .coverage import Coverage

RECOMMENDED_EXPOSURES = 15  # docs/usage.md; accuracy by number: docs/how_good/accuracy.md
RECOMMENDED_COVERAGE = 0.9
MAX_AREAS = 2  # named at once


@dataclass(frozen=True)
class Readiness:
    """What is still missing before a calibration is worthwhile.

    Attributes
    ----------
    ready : bool
        Whether there are enough exposures and enough of the image is covered.
    advice : str
        What the next pose should show, or that it is time to calibrate.
    """

    ready: bool
    advice: str


def readiness(exposures: int, coverage: Coverage | None) -> Readiness:
    """Return what is missing to a calibration of one fluoroscope.

    exposures: number of collected ones; coverage: None before the first one.
    """
    if coverage is None or not exposures:
        return Readiness(False, 'show the phantom and keep it still')
    missing = coverage.missing_areas[:MAX_AREAS]
    covered = coverage.fraction >= RECOMMENDED_COVERAGE
    if exposures >= RECOMMENDED_EXPOSURES and covered:
        return Readiness(True, 'ready to calibrate')
    further = RECOMMENDED_EXPOSURES - exposures
    count = f'{further} more, ' if further > 0 else ''
    if not missing:
        return Readiness(False, f'{count}with the phantom turned and tilted')
    return Readiness(False, f'{count}with beads {" and ".join(missing)} of the image')
