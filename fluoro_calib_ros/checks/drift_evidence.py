# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Evidence of a drift and its location: control charts together with the newest blocks.

Epipolar residuals and rigid bodies have separate charts. Both locate and size a drift in the same
way, and differ in how they attribute it to a fluoroscope.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from ..photogrammetry.noise import SURE
from .body_watch import COMPONENTS, BodyBlock
from .drift_charts import MIN_INFORMATION, Block, CusumCharts
from .pair_watch import PairBlock

WINDOW_S = 30.0  # newest blocks from which place and size of a drift are estimated
# Minimum ratio of the log-likelihoods of another and the likeliest fluoroscope to name both.
SIMILAR = 0.8
REFERENCES = ('calibration', 'start')  # references of the charts of epipolar residuals
EPIPOLAR = 'epipolar'  # source of a drift shown by residuals
SERIES_OF_PAIR = 4  # images a and b against the calibration, then against the start


B = TypeVar('B', bound=Block)


@dataclass(frozen=True)
class DriftEstimate:
    """Drift estimated from the newest blocks."""

    fluoroscopes: tuple[str, ...]  #: likeliest first, then those that are about as likely
    area: int  #: number of the area
    #: signed size along `direction` and its standard deviation [px]
    size: float
    sd: float
    direction: NDArray[np.float64]  #: (2,) unit vector in the image
    against: str  #: element of REFERENCES
    source: str  #: 'epipolar' or 'cluster NAME'
    confirmed: bool  #: False if only a single body shows it, in which a marker may have moved
    begin_ns: int  #: estimated start time


@dataclass(frozen=True)
class _Candidate:
    """Series and area in which a fluoroscope has most likely drifted."""

    likelihood: float
    series: int
    area: int


class Evidence(ABC, Generic[B]):
    """Charts of one kind of observations, and the newest blocks.

    window: number of blocks from which a drift is estimated.
    """

    def __init__(self, charts: CusumCharts, fluoroscopes: Sequence[str], window: int) -> None:
        self.charts = charts
        self._names = tuple(fluoroscopes)
        self._records: deque[tuple[int, B]] = deque(maxlen=window)  # start [ns] and block

    @property
    def peak(self) -> float:
        """Largest evidence of all charts."""
        return float(self.charts.evidence.max())

    def update(self, begin_ns: int, block: B, band: np.ndarray, testing: np.ndarray) -> None:
        """Add a block and its start; band and testing (K, A) are as in CusumCharts.update."""
        self.charts.update(block.score, block.information, band, testing, begin_ns)
        self._records.append((begin_ns, block))

    def estimate(self, min_evidence: float) -> DriftEstimate:
        """Return the most likely drift among the charts with at least this evidence."""
        charts = self.charts
        candidates = charts.evidence >= min_evidence
        likelihood = self._preferred(np.where(candidates, charts.log_likelihood(), -1))
        peak = np.unravel_index(np.argmax(likelihood), likelihood.shape)
        chart = int(peak[1])
        begin, run = self._run(chart, int(peak[2]), int(charts.begin[peak]))
        score = np.sum([block.score for block in run], axis=0)
        information = np.sum([block.information for block in run], axis=0)
        factor = float(np.median(charts.variance_factor()[chart]))
        with np.errstate(divide='ignore', invalid='ignore'):
            size = score / information
        likelihood = np.nan_to_num(score * size / (2 * factor))
        names, series, area = self._likeliest(likelihood, chart)
        systematic = np.nansum(
            [b.systematic[series, area] * b.information[series, area] for b in run]
        )
        total = information[series, area]
        direction, against, source, confirmed = self._described(run, series, area)
        return DriftEstimate(
            names,
            area,
            size=float(size[series, area]),
            sd=float(np.hypot(np.sqrt(factor / total), systematic / total)),
            direction=direction,
            against=against,
            source=source,
            confirmed=confirmed,
            begin_ns=begin,
        )

    def _run(self, series: int, area: int, begin_ns: int) -> tuple[int, list[B]]:
        """Return the start of a drift [ns] and the blocks since then, those of largest likelihood.

        If the drift is older than the window, its start is at most begin_ns, that of the run.
        """
        begins_ns, blocks = zip(*self._records)
        sums = np.cumsum(
            [[b.score[series, area], b.information[series, area]] for b in reversed(blocks)],
            axis=0,
        )
        likelihood = sums[:, 0] ** 2 / np.maximum(sums[:, 1], MIN_INFORMATION)
        first = len(blocks) - 1 - int(np.argmax(likelihood))
        begin = begins_ns[first]
        return (min(begin_ns, begin) if first == 0 else begin), list(blocks[first:])

    def _ranked(self, candidates: dict[str, _Candidate]) -> tuple[tuple[str, ...], int, int]:
        """Return names of the likeliest fluoroscopes, and series and area of the first of them."""
        order = sorted(candidates, key=lambda name: -candidates[name].likelihood)
        best = candidates[order[0]]
        limit = SIMILAR * best.likelihood
        names = tuple(name for name in order if candidates[name].likelihood >= limit)
        return names, best.series, best.area

    def _preferred(self, likelihood: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the likelihood (2, K, A), with -1 for series to which others are preferred."""
        return likelihood

    @abstractmethod
    def _likeliest(
        self, likelihood: NDArray[np.float64], series: int
    ) -> tuple[tuple[str, ...], int, int]:
        """Return names of the likeliest fluoroscopes, and series and area of the first of them.

        likelihood (K, A). series: the one with the largest likelihood.
        """

    @abstractmethod
    def _described(
        self, run: list[B], series: int, area: int
    ) -> tuple[NDArray[np.float64], str, str, bool]:
        """Return direction (2,) of a drift, one of REFERENCES, source, and whether confirmed."""


class EpipolarEvidence(Evidence[PairBlock]):
    """Evidence from epipolar residuals: the rows of the PairBlocks of all pairs of views."""

    def __init__(self, charts: CusumCharts, fluoroscopes: Sequence[str], window: int) -> None:
        super().__init__(charts, fluoroscopes, window)
        self._pairs = list(combinations(self._names, 2))

    def _preferred(self, likelihood: NDArray[np.float64]) -> NDArray[np.float64]:
        # Charts against the start are sharper: the start includes calibration errors.
        start = np.arange(likelihood.shape[1]) % SERIES_OF_PAIR >= 2
        if likelihood[:, start].max() >= 0:
            likelihood[:, ~start] = -1
        return likelihood

    def _likeliest(
        self, likelihood: NDArray[np.float64], series: int
    ) -> tuple[tuple[str, ...], int, int]:
        reference = series % SERIES_OF_PAIR // 2
        candidates = {}
        for name in self._names:
            series_of_name = [
                SERIES_OF_PAIR * number + 2 * reference + pair.index(name)
                for number, pair in enumerate(self._pairs)
                if name in pair
            ]
            total = likelihood[series_of_name].sum(axis=0)
            area = int(np.argmax(total))
            best = series_of_name[int(np.argmax(likelihood[series_of_name, area]))]
            candidates[name] = _Candidate(float(total[area]), best, area)
        return self._ranked(candidates)

    def _described(
        self, run: list[PairBlock], series: int, area: int
    ) -> tuple[NDArray[np.float64], str, str, bool]:
        pair, of_pair = divmod(series, SERIES_OF_PAIR)
        normal = np.sum([block.normals[2 * pair + series % 2, area] for block in run], axis=0)
        direction = normal / max(np.linalg.norm(normal), MIN_INFORMATION)
        return direction, REFERENCES[of_pair // 2], EPIPOLAR, True


class BodyEvidence(Evidence[BodyBlock]):
    """Evidence from rigid bodies: the series are drifts along u and v in each view.

    bodies: names, in the order of the BodyBlocks.
    """

    def __init__(
        self,
        charts: CusumCharts,
        fluoroscopes: Sequence[str],
        window: int,
        bodies: Sequence[str],
    ) -> None:
        super().__init__(charts, fluoroscopes, window)
        self._bodies = tuple(bodies)

    def _likeliest(
        self, likelihood: NDArray[np.float64], series: int
    ) -> tuple[tuple[str, ...], int, int]:
        candidates = {}
        for view, name in enumerate(self._names):
            first = COMPONENTS * view
            block = likelihood[first : first + COMPONENTS]
            component, area = np.unravel_index(np.argmax(block), block.shape)
            value = float(block[component, area])
            candidates[name] = _Candidate(value, int(first + component), int(area))
        return self._ranked(candidates)

    def _described(
        self, run: list[BodyBlock], series: int, area: int
    ) -> tuple[NDArray[np.float64], str, str, bool]:
        score = np.sum([block.score_of_body[:, series, area] for block in run], axis=0)
        information = np.sum([block.information_of_body[:, series, area] for block in run], axis=0)
        sign = np.sign(score.sum())
        significance = sign * score / np.sqrt(np.maximum(information, MIN_INFORMATION))
        strongest = int(np.argmax(significance))
        factor = float(np.median(self.charts.variance_factor()[series]))
        other_bodies = np.arange(len(score)) != strongest
        noise = np.sqrt(max(information[other_bodies].sum() * factor, MIN_INFORMATION))
        confirmed = bool(sign * score[other_bodies].sum() / noise > SURE)
        source = f'cluster {self._bodies[strongest]}'
        return np.eye(COMPONENTS)[series % COMPONENTS], 'start', source, confirmed
