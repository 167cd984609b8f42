# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The drift watch of an oriented rig: turns corrected views into its observations.

It separates the noise of an image point from the error of its correction: the one is new in every
frame, the other stays the same at a place and does not average out.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from ..bodies.body import Body
from ..findings import Finding, Kind
from ..photogrammetry.rig_orientation import RigOrientation
from ..reconstruction.epipolar import EpipolarGeometry
from ..reconstruction.reconstruct import IntersectedViews
from .drift_charts import (
    ERROR,
    LEVEL_NAMES,
    MIN_BLOCKS_TO_ALARM,
    OK,
    WARN,
    DriftOptions,
    DriftState,
    EpipolarObservations,
)
from .drift_watch import DriftWatch

# A residual above FALSE_MATCH_SD standard deviations and FALSE_MATCH_PX more is that of a false
# match. Up to there it may be that of a drift, even if the intersection rejects it.
FALSE_MATCH_SD = 4.0
FALSE_MATCH_PX = 3.0


class RigDriftWatch:
    """Drift watch of one RigOrientation; a new orientation needs a new one.

    image_sizes: width and height of the images by fluoroscope [px]. rate_hz: largest number of
    exposures to examine per second. Raises ValueError as DriftWatch. Raises DataError for a rig
    with two sources in one place.
    """

    def __init__(
        self,
        orientation: RigOrientation,
        image_sizes: Mapping[str, tuple[int, int]],
        options: DriftOptions | None = None,
        bodies: Sequence[Body] = (),
        rate_hz: float = 120.0,
    ) -> None:
        names = orientation.fluoroscopes
        self._names = names
        self._pairs = [
            (i, j, EpipolarGeometry(orientation, names[i], names[j]))
            for i, j in combinations(range(len(names)), 2)
        ]
        sizes = {name: image_sizes[name] for name in names}
        self._watch = DriftWatch(sizes, options, bodies, orientation)
        # Stamps jitter: a stream at this very rate must not lose any exposure.
        self._min_interval_ns = round(0.9e9 / rate_hz)
        self._last_ns: int | None = None
        self._has_bodies = bool(bodies)

    @property
    def options(self) -> DriftOptions:
        """Options of the watch."""
        return self._watch.options

    @property
    def state(self) -> DriftState:
        """Present state."""
        return self._watch.state

    @property
    def watched_s(self) -> float:
        """Time after the start in which a drift could have been detected somewhere [s]."""
        return self._watch.watched_s

    def is_due(self, stamp_ns: int) -> bool:
        """Whether an exposure with this stamp is to be examined."""
        last = self._last_ns
        return last is None or not 0 <= stamp_ns - last < self._min_interval_ns

    def add_exposure(self, stamp_ns: int, exposure: IntersectedViews) -> DriftState:
        """Add an exposure of the fluoroscopes of the orientation, and return the state."""
        self._last_ns = stamp_ns
        target_id = exposure.target_id
        uv, sigma = exposure.views.uv, exposure.views.sigma
        noise2 = np.maximum(sigma * sigma - exposure.views.correction_sd**2, 0)
        for i, j, geometry in self._pairs:
            found = geometry.residuals(uv[i], uv[j], sigma[i], sigma[j])
            noise = found.factor_a**2 * noise2[i] + found.factor_b**2 * noise2[j]
            limit = FALSE_MATCH_SD * found.sd_total + FALSE_MATCH_PX
            good = np.flatnonzero(np.abs(found.residual) <= limit)
            observations = EpipolarObservations(
                target_id[good],
                uv[i][good],
                uv_b=uv[j][good],
                residual=found.residual[good],
                sd_noise=np.sqrt(noise[good]),
                sd_systematic=np.sqrt(np.maximum(found.sd_total**2 - noise, 0))[good],
                normal_a=found.normal_a[good],
                normal_b=found.normal_b[good],
                factor_a=found.factor_a[good],
                factor_b=found.factor_b[good],
            )
            self._watch.add_residuals(stamp_ns, self._names[i], self._names[j], observations)
        if self._has_bodies:
            self._watch.add_points(stamp_ns, exposure)
        return self.state


@dataclass(frozen=True)
class DriftVerdict:
    """Verdict of the drift watch on a recording."""

    finding: Finding  #: what the watch says of the recording
    #: where there was a drift: the state with the largest evidence
    state: DriftState | None = None
    #: stamp of the exposure at which the highest level was first reached [ns]
    found_ns: int | None = None
    began_ns: int | None = None  #: begin of the drift by the last estimate [ns]
    level_at_end: str | None = None  #: 'ok', 'warn' or 'error'
    watched_s: float = 0.0  #: time in which a drift could have been detected [s]

    @property
    def level(self) -> str:
        """The highest level that was reached: 'ok', 'warn' or 'error'.

        'learning' where the recording is too short, 'unknown' where it lacks what is needed.
        """
        undecided = {Kind.SHORT_RECORDING: 'learning', Kind.NOT_WATCHED: 'unknown'}
        return undecided.get(self.finding.kind, LEVEL_NAMES[self.finding.severity])

    @property
    def message(self) -> str:
        """The finding in a sentence."""
        return self.finding.sentence


class RecordingDriftWatch(RigDriftWatch):
    """A RigDriftWatch that remembers its alarms, as one in the middle of a recording may end.

    The parameters are those of a RigDriftWatch.
    """

    def __init__(
        self,
        orientation: RigOrientation,
        image_sizes: Mapping[str, tuple[int, int]],
        options: DriftOptions | None = None,
        bodies: Sequence[Body] = (),
    ) -> None:
        super().__init__(orientation, image_sizes, options, bodies)
        self._first_ns: int | None = None
        self._worst = self.state
        self._worst_ns = 0
        self._found_ns = 0

    def add_exposure(self, stamp_ns: int, exposure: IntersectedViews) -> DriftState:
        """Add an exposure as a RigDriftWatch does, and return the state."""
        state = super().add_exposure(stamp_ns, exposure)
        if self._first_ns is None:
            self._first_ns = stamp_ns
        worst = self._worst
        is_worse = (state.level, state.evidence) >= (worst.level, worst.evidence)
        if state is not worst and is_worse:
            if state.level > worst.level:
                self._found_ns = stamp_ns
            self._worst = state
            self._worst_ns = stamp_ns
        return state

    def verdict(self) -> DriftVerdict:
        """Verdict on the exposures so far."""
        worst = self._worst
        watched = self.watched_s
        level_at_end = LEVEL_NAMES[self.state.level]
        if worst.level > OK:
            return DriftVerdict(
                self._drift(worst),
                worst,
                found_ns=self._found_ns,
                began_ns=self._worst_ns - round(1e9 * worst.since_s),
                level_at_end=level_at_end,
                watched_s=watched,
            )
        min_s = MIN_BLOCKS_TO_ALARM * self.options.block_s
        if watched >= min_s:
            cause = f'no drift is seen in {watched:.1f} s'
            found = Finding(Kind.NO_DRIFT, cause, severity=OK, numbers={'watched_s': watched})
            return DriftVerdict(found, level_at_end=level_at_end, watched_s=watched)
        learn_s = self.options.learn_s
        length_s = 0.0
        if self._last_ns is not None and self._first_ns is not None:
            length_s = (self._last_ns - self._first_ns) / 1e9
        cause = 'there are too few markers in two views to detect a drift'
        found = Finding(Kind.NOT_WATCHED, cause, severity=WARN)
        if length_s < learn_s + min_s:
            found = Finding(
                Kind.SHORT_RECORDING,
                f'the recording is too short to detect a drift: it has {length_s:.1f} s, of '
                f'which the first {learn_s:g} s are learned',
                severity=WARN,
                numbers={'length_s': length_s, 'learn_s': learn_s},
            )
        return DriftVerdict(found, watched_s=watched)

    def _drift(self, worst: DriftState) -> Finding:
        """Return the drift of the worst state as a finding on the recording."""
        found_s = (self._found_ns - (self._first_ns or 0)) / 1e9
        ended = '; it was gone at the end' if self.state.level == OK else ''
        verb = 'no longer holds' if worst.level == ERROR else 'may no longer hold'
        cause = f'{worst.finding.cause}; found {found_s:.1f} s after the beginning{ended}'
        return replace(worst.finding, cause=cause, advice=f'the calibration {verb}')
