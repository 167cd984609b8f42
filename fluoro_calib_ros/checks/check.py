# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Checks of a calibration, and the resulting verdict."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ..brief import brief_repr
from ..exposures.collector import RECOMMENDED_EXPOSURES
from ..findings import Finding, Kind, Place, Severity, sentence_of

MIN_MORE_EXPOSURES = 5  # minimum number worth recording
WITHOUT_TREND = 'check this again when the residuals no longer have a trend'


@dataclass(frozen=True)
class Check(Finding):
    """Finding that decides on a calibration: a value with a limit.

    Attributes
    ----------
    value, limit : float
        In `unit`. Without a limit (NaN) the check could not be made; the cause says why.
    unit : str
    severity : Severity
        NOTE for a check that passes, ERROR for one that fails.
    """

    value: float = math.nan
    limit: float = math.nan
    unit: str = ''

    def __post_init__(self) -> None:
        for name in ('value', 'limit'):
            object.__setattr__(self, name, float(getattr(self, name)))
        severity = {True: Severity.NOTE, None: Severity.WARNING, False: Severity.ERROR}
        object.__setattr__(self, 'severity', severity[self.passed])

    @property
    def name(self) -> str:
        """Kind of the check as text."""
        return self.kind.value

    @property
    def passed(self) -> bool | None:
        """Whether the value is within the limit; None if the check could not be made."""
        return None if math.isnan(self.limit) else self.value <= self.limit

    @property
    def sentence(self) -> str:
        """Place and cause, with the advice unless the check passed."""
        return sentence_of(self.place, self.cause, '' if self.passed else self.advice)

    def after_trend(self, has_trend: bool) -> Check:
        """Return the check with the advice to repair a trend first, if the residuals have one.

        The trend may have caused the failure.
        """
        return replace(self, advice=WITHOUT_TREND) if has_trend else self


@dataclass(frozen=True)
class Validation:
    """Verdict on the calibrations of a job.

    Attributes
    ----------
    verdict : {'pass', 'fail', 'cannot tell'}
    checks : tuple of Check
    calibration_id : mapping of str to str
        Ids of the calibrations by fluoroscope.
    seconds : float
        Duration of the validation [s].
    achieved_sd_px : mapping of str to float
        Standard deviation of a coordinate of the correction that the checks confirm [px], by
        fluoroscope; whatever the verdict, it states the usable accuracy of the calibration.
    notes : tuple of Finding
        Further information for the user, such as assumptions that were not verified.
    """

    __repr__ = brief_repr

    verdict: str
    checks: tuple[Check, ...]
    calibration_id: Mapping[str, str]
    seconds: float
    achieved_sd_px: Mapping[str, float] = field(default_factory=dict)
    notes: tuple[Finding, ...] = ()

    @property
    def findings(self) -> tuple[Check, ...]:
        """Checks that failed, then those that could not be made."""
        return tuple(
            check for passed in (False, None) for check in self.checks if check.passed is passed
        )


def rms(values: ArrayLike) -> float:
    """Return the root mean square of values."""
    return float(np.sqrt(np.mean(np.square(values))))


def verdict_of(checks: Iterable[Check]) -> str:
    """Return 'fail' if a check failed, else 'cannot tell' if one could not be made, else 'pass'.

    Without any check the verdict is 'cannot tell'.
    """
    passed = [check.passed for check in checks]
    if False in passed:
        return 'fail'
    return 'cannot tell' if None in passed or not passed else 'pass'


def not_made(kind: Kind, reason: str, advice: str = 'take more exposures', **more: Any) -> Check:
    """Return a check that could not be made, with a reason; more: further fields of a finding."""
    return Check(
        kind, f'check {kind.value} could not be performed, {reason}', advice=advice, **more
    )


def too_little_data(kind: Kind, fluoroscope: str, reason: str, count: int) -> Check:
    """Return a check that could not be made, for a reason in `count` exposures."""
    place = Place((fluoroscope,))
    numbers = {'exposures': count}
    return not_made(kind, reason, more_exposures(count), place=place, numbers=numbers)


def more_exposures(count: int) -> str:
    """Return the advice on how many exposures to record in addition to `count`."""
    number = max(RECOMMENDED_EXPOSURES - count, MIN_MORE_EXPOSURES)
    return f'take {number} more exposures (there are {count})'
