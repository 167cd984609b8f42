# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Options of the drift watch."""

from __future__ import annotations

from dataclasses import dataclass

from ..findings import Finding, Severity
from ..options import option, validate_options

# What the drift watch reports: its level and the drift it has found.

# Levels of an alarm; the values are those of the message DriftStatus.
OK = Severity.NOTE
WARN = Severity.WARNING
ERROR = Severity.ERROR
LEVEL_NAMES = {OK: 'ok', WARN: 'warn', ERROR: 'error'}
NAN = float('nan')


@dataclass(frozen=True)
class DriftState:
    """Present state of the drift watch.

    Without a drift, size, sd, since_s, area and direction are NaN.
    """

    finding: Finding  #: what the watch says; its severity is the level
    evidence: float  #: largest log-likelihood ratio of all charts
    #: evidence at which the levels WARN and ERROR begin
    threshold_warn: float
    threshold_error: float
    observations: int  #: residuals and distances since the last reset
    learning: bool  #: whether the reference is still being learned from the start of the stream
    #: name of the fluoroscope whose image has drifted, 'a or b' where the two cannot be
    #: distinguished, '' without a drift
    fluoroscope: str = ''
    #: corners u0, v0, u1, v1 of the area that has drifted [px]
    area: tuple[float, ...] = (NAN,) * 4
    place: str = ''  #: the same area in words
    #: size of the drift along `direction` and its standard deviation [px]; as residuals are
    #: clipped, a size of more than a pixel is a lower bound
    size: float = NAN
    sd: float = NAN
    #: unit vector (2,) in the image: the normal of the epipolar lines, or u or v where the drift
    #: was found by bodies
    direction: tuple[float, ...] = (NAN,) * 2
    against: str = ''  #: reference of the drift: 'calibration' or 'start'
    source: str = ''  #: 'epipolar' or 'cluster NAME'
    since_s: float = NAN  #: estimated time since the drift began [s]

    @property
    def level(self) -> Severity:
        """Level of the alarm."""
        return self.finding.severity

    @property
    def message(self) -> str:
        """The finding in a sentence."""
        return self.finding.sentence


@dataclass(frozen=True)
class DriftOptions:
    """Options of the drift watch.

    The dead band of a chart is the root of the sum of the squares of the tolerance and of
    band_calibration or band_start systematic standard deviations. Raises ValueError for values out
    of their range, and for combinations that make no sense.
    """

    error_interval_h: float = option(
        1000.0,
        'mean time between false alarms of level ERROR',
        minimum=1e-3,
        maximum=1e9,
        unit='h of stream',
    )
    warn_interval_h: float = option(
        10.0,
        'mean time between false alarms of level WARN',
        minimum=1e-3,
        maximum=1e9,
        unit='h of stream',
    )
    learn_s: float = option(
        10.0,
        'length of the start, the reference of all that follows',
        minimum=1.0,
        maximum=3600.0,
        unit='s',
    )
    block_s: float = option(
        0.25,
        'time over which observations are collected before they are tested',
        minimum=0.01,
        maximum=10.0,
        unit='s',
    )
    cells: int = option(4, 'cells across an image, an even number', minimum=2, maximum=16)
    tolerance_px: float = option(
        0.15,
        'drift that does not matter, part of every dead band',
        minimum=0.0,
        maximum=100.0,
        unit='px',
    )
    step_px: float = option(
        0.1,
        'excess over the dead band to which a chart is most sensitive',
        minimum=1e-3,
        maximum=100.0,
        unit='px',
    )
    band_calibration: float = option(
        4.0,
        'dead band against the calibration',
        minimum=1.0,
        maximum=20.0,
        unit='systematic standard deviations',
    )
    band_start: float = option(
        3.0,
        'dead band against the start',
        minimum=1.0,
        maximum=20.0,
        unit='systematic standard deviations',
    )
    clip: float = option(
        3.0,
        'size at which residuals are clipped',
        minimum=1.0,
        maximum=10.0,
        unit='standard deviations of the noise',
    )
    min_markers: int = option(
        3,
        'different markers that an area needs in a block to be tested',
        minimum=1,
        maximum=1000,
    )

    def __post_init__(self) -> None:
        validate_options(self)
        if int(self.cells) != self.cells or self.cells % 2:
            raise ValueError(f'cells must be an even number, not {self.cells}')
        if self.warn_interval_h > self.error_interval_h:
            raise ValueError(
                'warn_interval_h must not exceed error_interval_h, but they are '
                f'{self.warn_interval_h:g} and {self.error_interval_h:g}'
            )
        if self.learn_s < 4 * self.block_s:
            raise ValueError(
                f'learn_s must be at least 4 blocks of {self.block_s:g} s, not {self.learn_s:g} s'
            )
