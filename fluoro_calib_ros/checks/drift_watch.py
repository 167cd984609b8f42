# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The drift watch: detect from ordinary tracked markers that the calibration no longer holds.

Every calibration has small errors from the beginning, and the markers show them everywhere: a test
of 'mean zero' would raise an alarm at once. The mean of the epipolar residuals in an area of an
image is therefore accepted while it stays within a dead band. There are two dead bands: the
uncertainty of the calibration (against the calibration), and a narrower one for the uncertainty
that remains after the first seconds of markers have shown the errors of the calibration (against
the start). A drift along an epipolar line does not change the residuals; it changes the shapes of
rigid bodies (see body_watch).

The test is a CUSUM in every area (see drift_charts); its thresholds follow from the requested mean
time between false alarms. The variance is estimated from the data, from differences of successive
blocks and from the correlation of a marker's noise in successive frames, and is never smaller than
predicted. This covers noise that markers share, noise larger than expected and noise that is
correlated in time (measured: up to 0.9 in frames of 120 Hz). Single residuals are clipped (Huber,
Annals of Mathematical Statistics 35, 1964), and so is the contribution of a block to a chart.

Not detected are: a drift that exists from the start and is within the uncertainty of the
calibration; a drift along the epipolar lines without bodies, or one that moves all markers of a
body alike, as the shift of a whole image does; and any drift where there are no markers.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from ..bodies.body import Body
from ..exposures.stamps import Order, StampOrder
from ..findings import Finding, Kind, Place, Severity
from ..photogrammetry.rig_orientation import RigOrientation
from ..reconstruction.reconstruct import IntersectedViews
from ..rows import joined_rows
from .body_watch import COMPONENTS, BodyWatch
from .drift_charts import (
    ERROR,
    EVIDENCE_CAP,
    LEVEL_NAMES,
    OK,
    WARN,
    CusumCharts,
    DriftOptions,
    DriftState,
    EpipolarObservations,
    ImageAreas,
)
from .drift_evidence import (
    EPIPOLAR,
    SERIES_OF_PAIR,
    WINDOW_S,
    BodyEvidence,
    DriftEstimate,
    EpipolarEvidence,
)
from .pair_watch import PairBlock, PairWatch

BODY_STEP = 2.0  # multiple of step_px for the charts of bodies, which have less information
HYSTERESIS = 0.5  # multiple of the threshold of WARN below which an alarm ends


class DriftWatch:
    """Drift watch of a rig.

    image_sizes: width and height of the images by fluoroscope [px], in the order of the
    orientation. bodies: shapes that are not given are learned; bodies require the orientation.
    Raises ValueError for fewer than two fluoroscopes, for bodies without orientation, and as
    BodyWatch.
    """

    def __init__(
        self,
        image_sizes: Mapping[str, tuple[int, int]],
        options: DriftOptions | None = None,
        bodies: Sequence[Body] = (),
        orientation: RigOrientation | None = None,
    ) -> None:
        if len(image_sizes) < 2:
            raise ValueError(f'a drift watch needs two fluoroscopes, not {len(image_sizes)}')
        options = options or DriftOptions()
        self.options = options
        self._sizes = {name: tuple(size) for name, size in image_sizes.items()}
        self._names = tuple(self._sizes)
        self._areas = ImageAreas(int(options.cells))
        self._pairs = list(combinations(self._names, 2))
        self._body_watch = None
        if bodies:
            if orientation is None:
                raise ValueError('bodies need the orientation of the rig')
            sizes = list(self._sizes.values())
            self._body_watch = BodyWatch(bodies, orientation, sizes, self._areas, options)
        series = SERIES_OF_PAIR * len(self._pairs)
        if bodies:
            series += COMPONENTS * len(self._names)
        charts = 2 * series * len(self._areas)
        #: evidence at which the levels WARN and ERROR begin
        self.thresholds = tuple(
            float(np.log(charts * hours * 3600 / options.block_s))
            for hours in (options.warn_interval_h, options.error_interval_h)
        )
        self.reset()

    def reset(self) -> None:
        """Discard all data, for a new calibration or orientation."""
        options = self.options
        cap = EVIDENCE_CAP * self.thresholds[1]
        areas = len(self._areas)
        self._watches = [
            PairWatch([self._sizes[name] for name in pair], self._areas, options)
            for pair in self._pairs
        ]
        window = max(4, round(WINDOW_S / options.block_s))
        self._epipolar = EpipolarEvidence(
            CusumCharts(SERIES_OF_PAIR * len(self._pairs), areas, options.step_px, cap),
            self._names,
            window,
        )
        self._bodies = BodyEvidence(
            CusumCharts(COMPONENTS * len(self._names), areas, BODY_STEP * options.step_px, cap),
            self._names,
            window,
            self._body_watch.names if self._body_watch else (),
        )
        self._collected: list[list[EpipolarObservations]] = [[] for _ in self._pairs]
        self._learned_blocks = [0] * len(self._pairs)
        self._learned_body_blocks = 0
        self._tested_blocks = 0
        self._clock = BlockClock(options.block_s)
        self._observations = 0
        self._level = OK
        if self._body_watch:
            self._body_watch.clear()
        self.state = self._present_state()

    @property
    def watched_s(self) -> float:
        """Time after the start in which a drift could have been detected somewhere [s]."""
        return self._tested_blocks * self.options.block_s

    def add_residuals(
        self, stamp_ns: int, pair: int, observations: EpipolarObservations
    ) -> DriftState:
        """Add the epipolar residuals of one pair of frames, and return the present state.

        pair: number of the pair of fluoroscopes, in the order of their combinations.
        """
        self._advance(stamp_ns)
        if len(observations):
            self._collected[pair].append(observations)
        return self.state

    def add_points(self, stamp_ns: int, exposure: IntersectedViews) -> DriftState:
        """Add intersected views for the bodies; without bodies they are ignored.

        Returns the present state. Raises ValueError for a different number of views.
        """
        views = len(exposure.views.uv)
        if views != len(self._names):
            raise ValueError(
                f'the points must have pixels of {len(self._names)} views, not {views}'
            )
        self._advance(stamp_ns)
        if self._body_watch:
            self._body_watch.add(exposure)
        return self.state

    def _advance(self, stamp_ns: int) -> None:
        """If the stamp is after the present block, update the charts and the state."""
        ended_ns = self._clock.advance(stamp_ns)
        if ended_ns is None:
            return
        is_tested = self._close_residuals(ended_ns)
        is_tested |= self._close_bodies(ended_ns)
        self._tested_blocks += bool(is_tested)
        self.state = self._present_state()

    def _close_residuals(self, begin_ns: int) -> bool:
        """Update the charts of the residuals; return whether a drift could be detected."""
        options = self.options
        blocks = []
        seen = []
        for number, collected in enumerate(self._collected):
            self._collected[number] = []
            observations = joined_rows(collected).usable() if collected else None
            if observations is None or not len(observations):
                blocks.append(PairBlock.empty(len(self._areas)))
                continue
            blocks.append(self._watches[number].block(observations))
            seen.append(number)
            self._observations += len(observations)
        if not seen:
            return False
        block = joined_rows(blocks)
        learned = [self._has_learned(count) for count in self._learned_blocks]
        testing = block.enough & np.repeat(learned, SERIES_OF_PAIR)[:, None]
        stretch = np.array([watch.stretch() for watch in self._watches])
        self._epipolar.charts.stretch[:, 0] = np.repeat(stretch, SERIES_OF_PAIR)
        self._bodies.charts.stretch[:] = stretch.max()
        bands = np.repeat([options.band_calibration, options.band_start], 2)
        bands = np.tile(bands, len(self._pairs))[:, None]
        self._epipolar.update(begin_ns, block, self._dead_band(bands, block.systematic), testing)
        for number in seen:
            self._learn(number)
        return bool(testing.any())

    def _close_bodies(self, begin_ns: int) -> bool:
        """Update the charts of the bodies; return whether a drift could be detected."""
        watch = self._body_watch
        block = watch.block() if watch else None
        if watch is None or block is None:
            return False
        self._observations += block.count
        testing = block.enough & self._has_learned(self._learned_body_blocks)
        band = self._dead_band(self.options.band_start, block.systematic)
        self._bodies.update(begin_ns, block, band, testing)
        self._learned_body_blocks += 1
        if self._has_learned(self._learned_body_blocks):
            watch.learn()
        return bool(testing.any())

    def _dead_band(
        self, factor: float | NDArray[np.float64], systematic: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return dead bands [px] of a number of systematic standard deviations [px]."""
        return np.hypot(self.options.tolerance_px, factor * np.nan_to_num(systematic))

    def _has_learned(self, blocks: int) -> bool:
        """Return whether this number of blocks covers the start."""
        return blocks * self.options.block_s >= self.options.learn_s

    def _learn(self, number: int) -> None:
        """Count a block of the start of a pair; after the last one, estimate its error field."""
        if self._has_learned(self._learned_blocks[number]):
            return
        self._learned_blocks[number] += 1
        if self._has_learned(self._learned_blocks[number]):
            first = SERIES_OF_PAIR * number
            factor = self._epipolar.charts.variance_factor()[first : first + 2]
            self._watches[number].field.estimate(float(np.median(factor)))

    def _is_learning(self) -> bool:
        """Return whether no start has begun yet, or one is still being learned."""
        counts = [*self._learned_blocks, self._learned_body_blocks]
        started = [count for count in counts if count]
        return not started or not all(self._has_learned(count) for count in started)

    def _present_state(self) -> DriftState:
        """Return the state according to the present charts."""
        warn, error = self.thresholds
        is_epipolar = self._epipolar.peak >= self._bodies.peak
        strongest = self._epipolar if is_epipolar else self._bodies
        peak = strongest.peak
        level: Severity = OK
        if peak >= error:
            level = ERROR
        elif peak >= warn:
            level = WARN
        if level < self._level and peak >= HYSTERESIS * warn:
            level = self._level
        self._level = level
        if level != OK:
            estimate = strongest.estimate(min(peak, warn))
            return self._drift_state(level, estimate, peak)
        is_learning = self._is_learning()
        if not self._observations:
            finding = Finding(Kind.NO_MARKERS, 'no markers were seen', severity=OK)
        elif is_learning:
            finding = Finding(Kind.LEARNING, 'the reference is being learned', severity=OK)
        else:
            finding = Finding(Kind.NO_DRIFT, 'no drift detected', severity=OK)
        return DriftState(finding, peak, warn, error, self._observations, learning=is_learning)

    def _drift_state(self, level: Severity, estimate: DriftEstimate, peak: float) -> DriftState:
        """Return the state of an alarm; peak is the largest evidence."""
        corners, place = self._areas.describe(estimate.area, self._sizes[estimate.fluoroscopes[0]])
        since_s = max(self._clock.newest_ns - estimate.begin_ns, 0) / 1e9
        warn, error = self.thresholds
        return DriftState(
            _alarm(level, estimate, place, since_s),
            peak,
            warn,
            error,
            self._observations,
            learning=self._is_learning(),
            fluoroscopes=tuple(estimate.fluoroscopes),
            area=corners,
            place=place,
            size=abs(estimate.size),
            sd=estimate.sd,
            direction=_signed_direction(estimate),
            against=estimate.against,
            source=estimate.source,
            since_s=since_s,
        )


def _signed_direction(estimate: DriftEstimate) -> tuple[float, ...]:
    """Return the direction (2,) in which a drift has positive size."""
    return tuple(float(x) for x in np.sign(estimate.size) * estimate.direction)


def _alarm(level: Severity, estimate: DriftEstimate, place: str, since_s: float) -> Finding:
    """Return the finding of an alarm on a drift."""
    size = abs(estimate.size)
    direction = _signed_direction(estimate)
    seen_in = estimate.source
    if seen_in == EPIPOLAR:
        seen_in = 'the epipolar residuals'
    elif not estimate.confirmed:
        seen_in += ', where a bead may have moved, since no other cluster shows the drift'
    return Finding(
        Kind.IMAGE_DRIFT if estimate.confirmed else Kind.CLUSTER_CHANGE,
        f'{LEVEL_NAMES[level].upper()}: the image of fluoroscope '
        f'{" or ".join(estimate.fluoroscopes)} has drifted by {size:.2f} px (sd '
        f'{estimate.sd:.2f}) towards ({direction[0]:.1f}, {direction[1]:.1f}), {place}, for '
        f'{since_s:.1f} s, relative to the {estimate.against}; detected in {seen_in}',
        Place(estimate.fluoroscopes, name=''),
        severity=level,
        numbers={'size_px': size, 'sd_px': estimate.sd, 'since_s': since_s},
    )


class BlockClock:
    """Clock of a stream.

    block_s: length of a block [s].
    """

    def __init__(self, block_s: float) -> None:
        self.newest_ns = 0  #: newest time [ns]
        self._length_ns = round(block_s * 1e9)
        self._begin_ns: int | None = None  # start of the present block
        self._stamp_ns: int | None = None  # stamp of the last exposure
        self._order = StampOrder()
        self._offset_ns = 0  # added to stamps, so that time continues when a stream restarts

    def advance(self, stamp_ns: int) -> int | None:
        """Return the start of the block that this stamp ends [ns], or None.

        A late exposure belongs to the present block. Calls in a row with the same stamp are those
        of one exposure.
        """
        if stamp_ns == self._stamp_ns:
            return None
        self._stamp_ns = stamp_ns
        order = self._order.add(int(stamp_ns))
        if self._begin_ns is None:
            self._begin_ns = self.newest_ns = int(stamp_ns)
        if order is Order.RESTART:
            self._offset_ns = self.newest_ns - int(stamp_ns)
        time_ns = int(stamp_ns) + self._offset_ns
        self.newest_ns = max(self.newest_ns, time_ns)
        ended = self._begin_ns
        if time_ns < ended + self._length_ns:
            return None
        self._begin_ns += (time_ns - ended) // self._length_ns * self._length_ns
        return ended
