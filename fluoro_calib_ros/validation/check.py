# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Checks of a calibration, and the verdict that follows from them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike

GOOD_EXPOSURES = 15  # with fewer, more exposures are the first advice
MIN_MORE_EXPOSURES = 5  # that are worth recording


@dataclass(frozen=True)
class Check:
    """One check of a calibration.

    Attributes
    ----------
    name : str
    fluoroscope : str
        '' for a check of all fluoroscopes together.
    value, limit : float
        In `unit`; NaN where the check could not be made.
    unit : str
    passed : bool or None
        None where the check could not be made.
    sentence : str
        What was found and, unless the check passed, what to do.
    place : (float, float) or None
        Pixel (u, v) that the finding is about.
    advice : str
        The end of the sentence that says what to do; '' where there is none.
    """

    name: str
    fluoroscope: str
    value: float
    limit: float
    unit: str
    passed: bool | None
    sentence: str
    place: tuple[float, float] | None = None
    advice: str = ''

    def advised(self, advice: str) -> Check:
        """Return the check with another advice, if it has any."""
        if not self.advice:
            return self
        found = self.sentence.removesuffix(self.advice)
        return replace(self, sentence=f'{found}{advice}', advice=advice)


@dataclass(frozen=True)
class Validation:
    """The verdict on the calibrations of a job.

    Attributes
    ----------
    verdict : {'pass', 'fail', 'cannot tell'}
    checks : tuple of Check
    calibration_id : mapping of str to str
        Id of the calibration by fluoroscope.
    seconds : float
        Duration of the validation [s].
    achieved_sd_px : mapping of str to float
        Standard deviation of a coordinate of the correction that the checks confirm [px], by
        fluoroscope; whatever the verdict is, it says what the calibration is good for.
    notes : tuple of str
        What a user has to know beside the verdict, such as what is doubtful about the orientation
        of the rig, on which the verdict does not depend.
    """

    verdict: str
    checks: tuple[Check, ...]
    calibration_id: Mapping[str, str]
    seconds: float
    achieved_sd_px: Mapping[str, float] = field(default_factory=dict)
    notes: tuple[str, ...] = ()

    @property
    def findings(self) -> tuple[str, ...]:
        """Sentences of the checks that failed, then of those that could not be made."""
        return tuple(
            check.sentence
            for passed in (False, None)
            for check in self.checks
            if check.passed is passed
        )


@dataclass(frozen=True)
class Finding:
    """What a check measured.

    Attributes
    ----------
    value, limit : float
        The check passes if value <= limit.
    unit : str
    sentence : str
        What was found.
    advice : str
        What to do if the check fails.
    place : (2,) array_like or None
        Pixel that the finding is about.
    """

    value: float
    limit: float
    unit: str
    sentence: str
    advice: str
    place: ArrayLike | None = None


def verdict_of(checks: Iterable[Check]) -> str:
    """Return 'fail' if a check failed, else 'cannot tell' if one could not be made, else 'pass'.

    Without any check the verdict is 'cannot tell'.
    """
    passed = [check.passed for check in checks]
    if False in passed:
        return 'fail'
    return 'cannot tell' if None in passed or not passed else 'pass'


def judge(name: str, fluoroscope: str, finding: Finding, has_trend: bool = False) -> Check:
    """Return the check of a finding.

    has_trend says that the residuals have a trend: it may be the cause of a failure, and has to be
    removed first.
    """
    passed = bool(finding.value <= finding.limit)
    advice = finding.advice
    if has_trend:
        advice = 'check this again when the residuals no longer have a trend'
    place = None
    if finding.place is not None:
        u, v = np.asarray(finding.place, dtype=float).tolist()
        place = (u, v)
    return Check(
        name,
        fluoroscope,
        float(finding.value),
        float(finding.limit),
        finding.unit,
        passed,
        finding.sentence if passed else f'{finding.sentence}: {advice}',
        place,
        '' if passed else advice,
    )


def not_made(name: str, fluoroscope: str, sentence: str) -> Check:
    """Return a check that could not be made, with the sentence that says why."""
    return Check(name, fluoroscope, np.nan, np.nan, '', None, sentence)


def too_little_data(name: str, fluoroscope: str, reason: str, count: int) -> Check:
    """Return a check that could not be made for a reason in `count` exposures of a fluoroscope."""
    return not_made(
        name,
        fluoroscope,
        f'fluoroscope {fluoroscope}: check {name} could not be made, {reason}; '
        f'{more_exposures(count)}',
    )


def more_exposures(count: int) -> str:
    """Return the advice how many exposures to record in addition to `count`."""
    more = max(GOOD_EXPOSURES - count, MIN_MORE_EXPOSURES)
    return f'take {more} more exposures (there are {count})'
