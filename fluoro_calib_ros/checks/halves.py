# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Check 'halves': two calibrations, each from every other exposure, predict the same."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..correction.fluoroscope_calibration import FluoroscopeCalibration
from ..errors import DataError
from ..estimation.initial_network import MIN_EXPOSURES
from ..findings import Kind, Place
from .calibration_evidence import Evidence, Subject
from .check import Check, more_exposures, too_little_data
from .comparison import describe_place, difference

LIMIT = 1.9  # from simulated rigs: docs/verdict.md, benchmarks/verdict.py


def check_halves(evidence: Evidence, names: Sequence[str]) -> list[Check]:
    """Compare the calibrations of two halves of the exposures, a check for each fluoroscope."""
    evidence.report_step(f'{"+".join(names)}: two halves')
    fewest = evidence.fewest_exposures(names)
    if fewest < 2 * MIN_EXPOSURES:
        reason = f'{fewest} exposures are too few for two halves of {MIN_EXPOSURES} or more'
        return [too_little_data(Kind.HALVES, name, reason, fewest) for name in names]
    try:
        even = evidence.calibrate(evidence.part(names, lambda i: i % 2 == 0))
        odd = evidence.calibrate(evidence.part(names, lambda i: i % 2 == 1))
    except DataError as error:
        reason = f'half of the exposures cannot be calibrated ({error})'
        return [too_little_data(Kind.HALVES, name, reason, fewest) for name in names]
    return [_check(name, even[name], odd[name], len(evidence.frames[name])) for name in names]


def _check(
    name: str, one: FluoroscopeCalibration, other: FluoroscopeCalibration, count: int
) -> Check:
    found = difference(one, other)
    if found is None:
        reason = 'two halves of the exposures cover too little of the image in common'
        return too_little_data(Kind.HALVES, name, reason, count)
    expected = float(np.sqrt(np.mean(found.sd**2)))
    return Check(
        Kind.HALVES,
        'two halves of the exposures give corrections that differ by '
        f'{found.rms_px:.2f} px, where {expected:.2f} px is predicted, most at '
        f'{describe_place(found.worst, one.image_size)}',
        Place.at(name, found.worst),
        f'{more_exposures(count)} that show beads there, and see that phantom and fluoroscope '
        'stand still in each',
        numbers={'difference_px': found.rms_px, 'predicted_px': expected},
        value=found.normalised,
        limit=LIMIT,
        unit='predicted sd',
    )


HALVES = Subject(check_halves, steps=1)
