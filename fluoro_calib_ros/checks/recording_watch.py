# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The drift watch of a whole recording, and its verdict."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..findings import Finding, Kind
from ..photogrammetry.rig_orientation import RigOrientation
from ..reconstruction.intersection import IntersectedPoints
from .charts import MIN_BLOCKS_TO_ALARM
from .cluster_watch import Cluster
from .drift_options import ERROR, LEVEL_NAMES, OK, WARN, DriftOptions, DriftState
from .rig_watch import RigDriftWatch


@dataclass(frozen=True)
class DriftVerdict:
    """Verdict of the drift watch on a recording.

    Attributes
    ----------
    finding : Finding
        What the watch says of the recording.
    state : DriftState or None
        Where there was a drift: the state with the largest evidence.
    found_ns : int or None
        Stamp of the exposure at which the highest level was first reached [ns].
    began_ns : int or None
        Begin of the drift by the last estimate [ns].
    level_at_end : str or None
        'ok', 'warn' or 'error'.
    watched_s : float
        Time in which a drift could have been detected [s].
    """

    finding: Finding
    state: DriftState | None = None
    found_ns: int | None = None
    began_ns: int | None = None
    level_at_end: str | None = None
    watched_s: float = 0.0

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
        clusters: Sequence[Cluster] = (),
        rate_hz: float = 120.0,
    ) -> None:
        super().__init__(orientation, image_sizes, options, clusters, rate_hz)
        self._first_ns: int | None = None
        self._worst = self.state
        self._worst_ns = 0
        self._found_ns = 0

    def add_exposure(
        self,
        stamp_ns: int,
        target_id: np.ndarray,
        uv: np.ndarray,
        sigma: np.ndarray,
        correction_sd: np.ndarray,
        points: IntersectedPoints,
    ) -> DriftState:
        """Add an exposure as a RigDriftWatch does, and return the state."""
        state = super().add_exposure(
            stamp_ns, target_id, uv=uv, sigma=sigma, correction_sd=correction_sd, points=points
        )
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
