# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The drift watch of an oriented rig: convert corrected views into its observations.

It separates the noise of an image point from the error of its correction: noise is independent in
every frame, while the error is constant at a place and does not average out.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from ..bodies.body import Body
from ..findings import Finding, Kind
from ..photogrammetry.noise import CERTAIN
from ..photogrammetry.rig_orientation import RigOrientation
from ..reconstruction.epipolar import UNKNOWN, EpipolarGeometry, missing_rays
from ..reconstruction.intersection import OK as INTERSECTED
from ..reconstruction.intersection import Intersector
from ..reconstruction.reconstruct import IntersectedViews
from ..rows import chosen_rows
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
from .drift_evidence import EPIPOLAR
from .drift_watch import DriftWatch
from .rig_change import Addition, RigChange

# A residual above CERTAIN standard deviations plus this many pixels is a false match. Up to this
# limit it may be due to a drift, even if the intersection rejects it.
FALSE_MATCH_PX = 3.0


class RigDriftWatch:
    """Drift watch of one RigOrientation; a new orientation requires a new watch.

    image_sizes: width and height of the images by fluoroscope [px]. rate_hz: maximum number of
    exposures to examine per second. Raises ValueError as DriftWatch does, and DataError for a rig
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
        # Stamps jitter: a stream at exactly this rate must not lose any exposure.
        self._min_interval_ns = round(0.9e9 / rate_hz)
        self._last_ns: int | None = None
        self._has_bodies = bool(bodies)
        self._orientation = orientation
        self._change = RigChange(orientation, self._pairs)
        self._of_charts = self._watch.state  # state of the last block
        self._state = self._of_charts
        self._addition: Addition | None = None
        self._wide: tuple[Intersector, Intersector] | None = None  # given and widened
        #: addition of an alarm to standard deviations; None without an alarm
        self.widening: Finding | None = None

    @property
    def options(self) -> DriftOptions:
        """Options of the watch."""
        return self._watch.options

    @property
    def state(self) -> DriftState:
        """Present state."""
        return self._state

    @property
    def watched_s(self) -> float:
        """Time after the start in which a drift could have been detected somewhere [s]."""
        return self._watch.watched_s

    def is_due(self, stamp_ns: int) -> bool:
        """Return whether an exposure with this stamp is to be examined."""
        last = self._last_ns
        return last is None or not 0 <= stamp_ns - last < self._min_interval_ns

    def widened(self, intersector: Intersector) -> tuple[Intersector, float]:
        """Return the intersector of the next exposure, and the addition to sigma [px].

        During an alarm, its covariance of the rig includes the change that the alarm shows.
        """
        added = self._addition
        if added is None:
            return intersector, 0.0
        if self._wide is None or self._wide[0] is not intersector:
            covariance = self._orientation.covariance + added.covariance
            orientation = replace(self._orientation, covariance=covariance)
            self._wide = intersector, Intersector(orientation, intersector.reject)
        return self._wide[1], added.image_sd

    def add_exposure(self, stamp_ns: int, exposure: IntersectedViews) -> DriftState:
        """Add an exposure of the fluoroscopes of the orientation, and return the state.

        The exposure must have been intersected with the results of `widened`.
        """
        self._last_ns = stamp_ns
        exposure = self._as_calibrated(exposure)
        target_id = exposure.target_id
        uv, sigma = exposure.views.uv, exposure.views.sigma
        noise2 = np.maximum(sigma * sigma - exposure.views.correction_sd**2, 0)
        for number, (i, j, geometry) in enumerate(self._pairs):
            residuals = geometry.residuals(uv[i], uv[j], sigma[i], sigma[j])
            noise = residuals.factor_a**2 * noise2[i] + residuals.factor_b**2 * noise2[j]
            limit = CERTAIN * residuals.sd_total + FALSE_MATCH_PX
            observations = EpipolarObservations(
                **vars(residuals), target_id=target_id, uv_a=uv[i], uv_b=uv[j], noise=noise
            )
            self._change.add(number, observations)
            accepted = np.abs(residuals.residual) <= limit
            self._watch.add_residuals(stamp_ns, number, chosen_rows(observations, accepted))
        if self._has_bodies:
            self._watch.add_points(stamp_ns, exposure)
        if self._watch.state is not self._of_charts:  # a block has ended
            self._of_charts = self._watch.state
            self._change.close()
            self._state = self._present_state()
            self._widen(exposure)
        return self.state

    def _as_calibrated(self, exposure: IntersectedViews) -> IntersectedViews:
        """Return an exposure without the addition of an alarm to its image points."""
        if self._addition is None or not self._addition.image_sd:
            return exposure
        views = exposure.views
        added = self._addition.image_sd**2
        sigma, correction_sd = (
            np.sqrt(np.maximum(sd * sd - added, 0)) for sd in (views.sigma, views.correction_sd)
        )
        return replace(exposure, views=replace(views, sigma=sigma, correction_sd=correction_sd))

    def _present_state(self) -> DriftState:
        """Return the state of the charts, or of a knock, whose rays are too far apart for them."""
        share = self._change.share_apart
        if not share:
            return self._of_charts
        since_s = self._change.blocks_apart * self.options.block_s
        return replace(
            self._of_charts,
            finding=replace(missing_rays(share, UNKNOWN), severity=ERROR),
            source=EPIPOLAR,
            since_s=since_s,
        )

    def _widen(self, exposure: IntersectedViews) -> None:
        """Compute the addition of an alarm from its newest rays. exposure: the last one."""
        state = self._state
        self._wide = None
        self._addition = self.widening = None
        if state.level == OK or state.finding.kind is Kind.CLUSTER_CHANGE:
            return
        added = self._change.addition(round(state.since_s / self.options.block_s))
        if added is None:
            return
        if state.source != EPIPOLAR and np.isfinite(state.size):
            added = self._with_shift(added, state)
        self._addition = added
        self.widening = self._widening(exposure, added)

    def _with_shift(self, added: Addition, state: DriftState) -> Addition:
        """Add a drift along epipolar lines, shown only by bodies, as a shift of the image."""
        covariance = added.covariance.copy()
        for f, name in enumerate(self._names):
            if name in state.fluoroscopes:
                rows = self._orientation.covariance_rows([f])[6:8]
                covariance[rows, rows] += state.size**2 + state.sd**2
        return replace(added, covariance=covariance)

    def _widening(self, exposure: IntersectedViews, added: Addition) -> Finding | None:
        """Return the increase of the standard deviations of the points of an exposure."""
        views = exposure.views
        as_calibrated = Intersector(self._orientation, None)
        with_change, image_sd = self.widened(as_calibrated)
        self._wide = None
        before, after = (
            intersector.intersect(views.uv, np.hypot(views.sigma, sd))
            for intersector, sd in ((as_calibrated, 0.0), (with_change, image_sd))
        )
        intersected = (before.status == INTERSECTED) & (after.status == INTERSECTED)
        if not intersected.any():
            return None
        sd_before_mm, sd_mm = (
            float(
                np.sqrt(np.median(np.trace(points.covariance[intersected], axis1=1, axis2=2)) / 3)
            )
            for points in (before, after)
        )
        return widened(sd_before_mm, sd_mm, miss_px=added.miss, image_sd_px=added.image_sd)


def widened(sd_before_mm: float, sd_mm: float, miss_px: float, image_sd_px: float) -> Finding:
    """Return the finding that an alarm increases standard deviations."""
    return Finding(
        Kind.WIDENED_BY_ALARM,
        f'rays miss each other by {miss_px:.2f} px (RMS): until the rig is healed, the standard '
        f'deviation of a coordinate is {sd_mm:.3f} mm (median) instead of {sd_before_mm:.3f} mm',
        severity=WARN,
        numbers={
            'sd_before_mm': sd_before_mm,
            'sd_mm': sd_mm,
            'miss_px': miss_px,
            'image_sd_px': image_sd_px,
        },
    )


@dataclass(frozen=True)
class DriftVerdict:
    """Verdict of the drift watch on a recording."""

    finding: Finding  #: result of the watch for the recording
    #: state with the largest evidence, if there was a drift
    state: DriftState | None = None
    #: stamp of the exposure at which the highest level was first reached [ns]
    found_ns: int | None = None
    began_ns: int | None = None  #: start of the drift by the last estimate [ns]
    level_at_end: str | None = None  #: 'ok', 'warn' or 'error'
    watched_s: float = 0.0  #: time in which a drift could have been detected [s]
    widening: Finding | None = None  #: largest addition of an alarm to standard deviations

    @property
    def level(self) -> str:
        """Highest level that was reached: 'ok', 'warn' or 'error'.

        'learning' if the recording is too short, 'unknown' if it does not contain what is needed.
        """
        undecided = {Kind.SHORT_RECORDING: 'learning', Kind.NOT_WATCHED: 'unknown'}
        return undecided.get(self.finding.kind, LEVEL_NAMES[self.finding.severity])

    @property
    def message(self) -> str:
        """Finding as a sentence."""
        return self.finding.sentence

    def beside(self, timing: Finding | None) -> DriftVerdict:
        """Return the verdict beside a fault of the timing, which would look like a drift."""
        if timing is None:
            return self
        cause = 'the fluoroscopes are not synchronous, a drift cannot be detected'
        return DriftVerdict(
            Finding(Kind.NOT_WATCHED, cause, severity=WARN), widening=self.widening
        )


@dataclass(frozen=True, kw_only=True)
class RigEvidence:
    """What the rays of a recording say about its rig.

    Attributes
    ----------
    drift : DriftVerdict or None
        None if the drift watch is switched off.
    disagreement : Finding or None
        Set if frames that were paired by number are far apart in time.
    widening : float
        Factor of the limit of false matches at the end; above 1 if the rays miss each other by
        more than their standard deviations allow.
    noise : Finding or None
        Set if image points have no sigma and their rays show more noise than the calibration.
    timing : Finding or None
        Set if rays miss each other because a fluoroscope is delayed or has lost a frame.
    """

    drift: DriftVerdict | None = None
    disagreement: Finding | None = None
    widening: float = 1.0
    noise: Finding | None = None
    timing: Finding | None = None


class RecordingDriftWatch(RigDriftWatch):
    """RigDriftWatch that stores its alarms, as one in the middle of a recording may end."""

    _first_ns: int | None = None
    _worst: DriftState | None = None
    _worst_ns = 0
    _found_ns = 0
    _widest: Finding | None = None

    def add_exposure(self, stamp_ns: int, exposure: IntersectedViews) -> DriftState:
        """Add an exposure as a RigDriftWatch does, and return the state."""
        state = super().add_exposure(stamp_ns, exposure)
        if self._first_ns is None:
            self._first_ns = stamp_ns
        worst = self._worst = self._worst or state
        is_worse = (state.level, state.evidence) >= (worst.level, worst.evidence)
        if state is not worst and is_worse:
            if state.level > worst.level:
                self._found_ns = stamp_ns
            self._worst = state
            self._worst_ns = stamp_ns
        widest = self._widest
        widening = self.widening
        if widening is not None and (
            widest is None or widening.numbers['sd_mm'] > widest.numbers['sd_mm']
        ):
            self._widest = widening
        return state

    def verdict(self) -> DriftVerdict:
        """Return the verdict on the exposures so far."""
        worst = self._worst or self.state
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
                widening=self._widest,
            )
        min_s = MIN_BLOCKS_TO_ALARM * self.options.block_s
        if watched >= min_s:
            cause = f'no drift detected in {watched:.1f} s'
            finding = Finding(Kind.NO_DRIFT, cause, severity=OK, numbers={'watched_s': watched})
            return DriftVerdict(finding, level_at_end=level_at_end, watched_s=watched)
        learn_s = self.options.learn_s
        length_s = 0.0
        if self._last_ns is not None and self._first_ns is not None:
            length_s = (self._last_ns - self._first_ns) / 1e9
        cause = 'there are too few markers in two views to detect a drift'
        finding = Finding(Kind.NOT_WATCHED, cause, severity=WARN)
        if length_s < learn_s + min_s:
            finding = Finding(
                Kind.SHORT_RECORDING,
                f'the recording is too short to detect a drift: it has {length_s:.1f} s, of '
                f'which the first {learn_s:g} s are the reference',
                severity=WARN,
                numbers={'length_s': length_s, 'learn_s': learn_s},
            )
        return DriftVerdict(finding, watched_s=watched)

    def _drift(self, worst: DriftState) -> Finding:
        """Return the finding on the recording for the drift of the worst state."""
        found_s = (self._found_ns - (self._first_ns or 0)) / 1e9
        ended = '; no longer detected at the end' if self.state.level == OK else ''
        statement = 'no longer holds' if worst.level == ERROR else 'may no longer hold'
        cause = f'{worst.finding.cause}; alarm {found_s:.1f} s after the start{ended}'
        return replace(worst.finding, cause=cause, advice=f'the calibration {statement}')
