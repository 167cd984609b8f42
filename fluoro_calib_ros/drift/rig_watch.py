"""What the drift watch is given of every exposure: epipolar residuals of all pairs of views, and
points in space.

The noise of an image point and the error of its correction are told apart: the one is another in
every frame, the other the same every time at a place, and does not average out.
"""

from collections import Counter
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from ..reconstruction.epipolar import EpipolarGeometry
from ..reconstruction.intersection import OK as INTERSECTED
from .clusters import Cluster
from .watch import ERROR, LEVEL, OK, STEPS_TO_ALARM, DriftOptions, DriftState, DriftWatch

# Beyond both together a residual is one of a false match; up to there it may be that of a drift,
# rejected or not.
FALSE_SD = 4.0
FALSE_PX = 3.0


class RigWatch:
    """A DriftWatch for a RigOrientation, built anew with every orientation.

    image_sizes {fluoroscope: (width, height)} [px]; options: DriftOptions; clusters: Cluster, ...;
    rate_hz: most exposures a second that are looked at. Raises ValueError as DriftWatch, DataError
    for a rig of sources in one place.
    """

    def __init__(
        self, orientation, image_sizes, options=DriftOptions(), clusters=(), rate_hz=120.0
    ):
        names = self._names = orientation.fluoroscopes
        self._pairs = [
            (i, j, EpipolarGeometry(orientation, names[i], names[j]))
            for i, j in combinations(range(len(names)), 2)
        ]
        self._watch = DriftWatch(
            {name: image_sizes[name] for name in names},
            options,
            clusters,
            (orientation.interior, orientation.rotation, orientation.position_mm),
        )
        # Exposures come with some jitter: at the rate itself none is to be left out.
        self._every_ns = round(0.9e9 / rate_hz)
        self._last = None
        self.clusters = bool(clusters)

    @property
    def state(self):
        """The DriftState."""
        return self._watch.state

    @property
    def watched_s(self):
        """Time after the start in which a drift could be told somewhere [s]."""
        return self._watch.watched_s

    def wants(self, stamp_ns):
        """Whether an exposure is to be looked at."""
        return self._last is None or not 0 <= stamp_ns - self._last < self._every_ns

    def take(self, stamp_ns, target_id, uv, sigma, correction_sd, points):
        """Take in an exposure; returns the DriftState.

        target_id (n,); uv (F, n, 2), sigma and correction_sd (F, n) [px], NaN where a fluoroscope
        does not see a target; points: the IntersectedPoints of them.
        """
        self._last = stamp_ns
        noise2 = np.maximum(sigma * sigma - correction_sd * correction_sd, 0)
        names = self._names
        for i, j, geometry in self._pairs:
            found = geometry.residuals(uv[i], uv[j], sigma[i], sigma[j])
            noise = found.factor_a**2 * noise2[i] + found.factor_b**2 * noise2[j]
            good = np.flatnonzero(np.abs(found.residual) <= FALSE_SD * found.sd_total + FALSE_PX)
            self._watch.add(
                stamp_ns,
                names[i],
                names[j],
                target_id[good],
                uv[i][good],
                uv[j][good],
                found.residual[good],
                np.sqrt(noise[good]),
                np.sqrt(np.maximum(found.sd_total**2 - noise, 0))[good],
                found.normal_a[good],
                found.normal_b[good],
                found.factor_a[good],
                found.factor_b[good],
            )
        if self.clusters:
            part = noise2 / (sigma * sigma)  # of the covariance that is noise
            seen = np.isfinite(part)
            part = np.where(seen, part, 0).sum(axis=0) / np.maximum(seen.sum(axis=0), 1)
            good = np.flatnonzero(points.status == INTERSECTED)
            self._watch.add_points(
                stamp_ns,
                target_id[good],
                points.xyz_mm[good],
                (points.covariance_noise * part[:, None, None])[good],
                uv[:, good],
                correction_sd[:, good],
            )
        return self.state


@dataclass(frozen=True)
class DriftVerdict:
    """What the drift watch says of a whole recording.

    level: 'ok', 'warn' or 'error', the highest that there was; 'learning' where the recording is
    too short to tell; 'unknown' where there is nothing to tell it from. message: one sentence. Of
    a drift, else None: state, the DriftState with the largest evidence; found_ns: stamp of the
    exposure by which its level was found first [ns], began_ns: of the begin of the drift, as
    estimated at last [ns]. level_at_end: 'ok', 'warn' or 'error'; watched_s: time in which a drift
    could be told [s].
    """

    level: str
    message: str
    state: DriftState | None = None
    found_ns: int | None = None
    began_ns: int | None = None
    level_at_end: str | None = None
    watched_s: float = 0.0


class RecordingWatch(RigWatch):
    """A RigWatch that remembers what it has told: an alarm in the middle of a recording may have
    ended with it.
    """

    def __init__(
        self, orientation, image_sizes, options=DriftOptions(), clusters=(), rate_hz=120.0
    ):
        super().__init__(orientation, image_sizes, options, clusters, rate_hz)
        self._options = options
        self._begin_ns = None
        self._worst = self.state
        self._worst_ns = None
        self._found_ns = None

    def take(self, stamp_ns, target_id, uv, sigma, correction_sd, points):
        """Take in an exposure, as a RigWatch does; returns the DriftState."""
        state = super().take(stamp_ns, target_id, uv, sigma, correction_sd, points)
        if self._begin_ns is None:
            self._begin_ns = stamp_ns
        if state is not self._worst and (state.level, state.evidence) >= (
            self._worst.level,
            self._worst.evidence,
        ):
            if state.level > self._worst.level:
                self._found_ns = stamp_ns
            self._worst = state
            self._worst_ns = stamp_ns
        return state

    def verdict(self):
        """The DriftVerdict on what was taken in."""
        worst = self._worst
        watched = self.watched_s
        length = 0.0 if self._last is None else (self._last - self._begin_ns) / 1e9
        at_end = LEVEL[self.state.level].lower()
        if worst.level > OK:
            return DriftVerdict(
                LEVEL[worst.level].lower(),
                self._sentence(worst),
                worst,
                self._found_ns,
                self._worst_ns - round(1e9 * worst.since_s),
                at_end,
                watched,
            )
        least = STEPS_TO_ALARM * self._options.block_s  # an alarm takes so long at least
        if watched >= least:
            return DriftVerdict(
                'ok',
                f'no drift is seen in {watched:.1f} s',
                level_at_end=at_end,
                watched_s=watched,
            )
        learn = self._options.learn_s
        if length < learn + least:
            return DriftVerdict(
                'learning',
                f'the recording is too short to tell a drift: it has {length:.1f} s, of '
                f'which the first {learn:g} s are learned',
                watched_s=watched,
            )
        return DriftVerdict(
            'unknown', 'there are too few markers in two views to tell a drift', watched_s=watched
        )

    def _sentence(self, worst):
        """What to say of a drift."""
        holds = (
            'the calibration no longer holds'
            if worst.level == ERROR
            else 'it may be that the calibration no longer holds'
        )
        ended = '; it was gone at the end' if self.state.level == OK else ''
        return (
            f'{worst.message}; found {(self._found_ns - self._begin_ns) / 1e9:.1f} s after the beginning{ended}: '
            f'{holds}'
        )


def clusters_of(texts):
    """Clusters of texts such as 'tibia: 1001 1002 1003'. Raises ValueError for a text that is
    none.
    """
    out = []
    for text in texts:
        name, colon, ids = text.partition(':')
        try:
            numbers = tuple(int(i) for i in ids.replace(',', ' ').split())
        except ValueError:
            numbers = ()
        if not colon or not name.strip() or not numbers:
            raise ValueError(
                f"{text!r} does not declare a cluster, as 'tibia: 1001 1002 1003' does"
            )
        out.append(Cluster(name.strip(), numbers))
    if len({cluster.name for cluster in out}) < len(out):
        raise ValueError('two clusters have the same name')
    targets = Counter(i for cluster in out for i in cluster.target_id)
    twice = [i for i, count in targets.items() if count > 1]
    if twice:
        raise ValueError(f'target {twice[0]} is in two clusters')
    return tuple(out)
