# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Motion of markers in an image: prediction, assignment, and which ids may have been exchanged.

Each marker has a Kalman filter of constant velocity whose disturbance is a white acceleration
(Bar-Shalom, Li and Kirubarajan, "Estimation with Applications to Tracking and Navigation", 2001,
6.3.2), of a size that is learned from the innovations. Shadows are assigned to all markers
together (Kuhn and Munkres, by scipy), at the largest likelihood: a squared Mahalanobis distance
and the logarithm of the determinant of its covariance (ibid., 5.4).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment
from scipy.spatial import cKDTree

from .shadow_fit import DEPTH_SD

FIRST_SPEED_PX = 6.0  # standard deviation of the unknown first velocity [px a frame]
FORGET = 0.9  # share that a running mean keeps of what was before
COMPARED = 5  # images before the motion of two markers is known to be alike
UNSTEADY_PX = 0.5  # by which velocities usually change in a frame, and differ [px a frame]
LEADERS = 4  # markers whose motion another one follows
LED = 0.5  # share of the acceleration that they do not explain
MAX_SD_PX = 60.0  # of a prediction
MODEL_SD_PX = 0.05  # of a place, beyond the noise of the measurement
SHADOW_SD_PX = 0.25  # of the place of a shadow before it is measured
GIVEN_SD_PX = 1.5  # of a place that is given, or told by markers beside
FAR = 1e6
MIN_VOTES = 1.5  # for a shift of markers together


@dataclass
class Motion:
    """State of the filters of n markers."""

    uv: NDArray[np.float64]  #: (n, 2) [px], [px a frame]
    velocity: NDArray[np.float64]  #: (n, 2) [px], [px a frame]
    covariance: NDArray[np.float64]  #: (n, 2, 2), of place and velocity, the same along u and v
    squared: NDArray[np.float64]  #: (n,), running mean of squared accelerations
    unlike: NDArray[np.float64]  #: (n, n), running mean of squared differences of velocities
    together: NDArray[np.int64]  #: (n, n), images in which they were compared

    @classmethod
    def start(cls, uv: np.ndarray, sd_px: float) -> Motion:
        """Return filters of markers at uv (n, 2), whose velocity is not known."""
        n = len(uv)
        covariance = np.zeros((n, 2, 2))
        covariance[:, 0, 0] = sd_px**2
        covariance[:, 1, 1] = FIRST_SPEED_PX**2
        squared = np.full(n, UNSTEADY_PX**2)
        unlike = np.full((n, n), FIRST_SPEED_PX**2)
        np.fill_diagonal(unlike, np.inf)
        together = np.zeros((n, n), dtype=int)
        return cls(
            np.array(uv, dtype=float),
            np.zeros((n, 2)),
            covariance=covariance,
            squared=squared,
            unlike=unlike,
            together=together,
        )

    @property
    def variance(self) -> NDArray[np.float64]:
        """Variances (n,) of a coordinate [px^2]."""
        return self.covariance[:, 0, 0]

    def predict(self, frames: int, led: NDArray[np.bool_] | None = None) -> None:
        """Move all markers on by a number of frames.

        led (n,) are those whose velocity follows that of others.
        """
        t = float(frames)
        self.uv += t * self.velocity
        pooled = float(np.median(self.squared)) if len(self.squared) else 0.0
        q = np.maximum(self.squared, pooled)
        if led is not None:
            q = np.where(led, LED**2 * pooled, q)
        p = self.covariance
        cross = p[:, 0, 1] + t * p[:, 1, 1]
        p[:, 0, 0] += t * (p[:, 0, 1] + cross) + q * t**4 / 4
        p[:, 0, 1] = p[:, 1, 0] = cross + q * t**3 / 2
        p[:, 1, 1] += q * t**2
        too_wide = p[:, 0, 0] > MAX_SD_PX**2
        if too_wide.any():
            factor = np.where(too_wide, MAX_SD_PX**2 / p[:, 0, 0], 1.0)
            p *= factor[:, None, None]

    def innovation_variance(
        self, sigma: NDArray[np.float64], rows: NDArray[np.int64] | slice = np.s_[:]
    ) -> NDArray[np.float64]:
        """Variances (n,) of a measured less a predicted coordinate, of some markers."""
        return self.variance[rows] + sigma**2 + MODEL_SD_PX**2

    def update(
        self,
        rows: NDArray[np.int64],
        uv: NDArray[np.float64],
        sigma: NDArray[np.float64],
        frames: int,
    ) -> None:
        """Take in measured centres (m, 2) of some markers."""
        innovation = uv - self.uv[rows]
        settled = self.settled[rows]
        p = self.covariance[rows]
        gain = p[:, :, 0] / self.innovation_variance(sigma, rows)[:, None]
        self.uv[rows] += gain[:, :1] * innovation
        self.velocity[rows] += gain[:, 1:] * innovation
        self.covariance[rows] = p - gain[:, :, None] * p[:, None, 0, :]
        # What the innovation says of the acceleration; a first or late one says little.
        seen = 0.5 * (innovation**2).sum(axis=1) / float(frames) ** 4
        seen = np.maximum(seen - sigma**2, 0)
        update = FORGET * self.squared[rows] + (1 - FORGET) * seen
        self.squared[rows] = np.where(settled, update, self.squared[rows])

    def lead(
        self, seen: NDArray[np.bool_], before: NDArray[np.float64], sure: NDArray[np.bool_]
    ) -> NDArray[np.bool_]:
        """Let unseen markers follow those that move alike; returns (n,) which do.

        seen (n,) were measured now, and had velocities before (n, 2). Which markers move alike is
        learned from those that are sure (n,).
        """
        rows = np.flatnonzero(seen & self.settled)
        led = np.zeros(len(seen), dtype=bool)
        if len(rows) < LEADERS:
            return led
        velocity = self.velocity[rows]
        difference = ((velocity[:, None] - velocity[None]) ** 2).sum(axis=2)
        both = np.ix_(rows, rows)
        learned = sure[rows, None] & sure[rows]
        self.together[both] += learned
        share = learned * np.maximum(1 / np.maximum(self.together[both], 1), 1 - FORGET)
        before_unlike = np.where(learned & (self.together[both] == 1), 0.0, self.unlike[both])
        np.fill_diagonal(before_unlike, 0.0)
        self.unlike[both] = (1 - share) * before_unlike + share * difference
        self.unlike[rows, rows] = np.inf
        for row in np.flatnonzero(~seen & self.settled).tolist():
            alike = self.company(row, rows)
            self.velocity[row] += np.median(self.velocity[alike] - before[alike], axis=0)
            led[row] = True
        return led

    def company(self, row: int, among: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return the LEADERS of some markers that move with one.

        They are those that moved most alike, and the nearest where that is not known.
        """
        away = np.linalg.norm(self.uv[among] - self.uv[row], axis=1)
        return among[np.lexsort((away, self.unlike[row, among]))[:LEADERS]]

    def strangeness(
        self, seen: NDArray[np.bool_]
    ) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]:
        """Compare velocities with those of the markers that moved alike so far.

        Returns, for markers in rows (k,), the ratio (k,) of the squared difference to what it used
        to be, and the velocities (k, 2) of the others. seen (n,) were measured now.
        """
        rows = np.flatnonzero(seen & self.settled)
        if len(rows) <= LEADERS:
            return np.zeros(0, dtype=int), np.zeros(0), np.zeros((0, 2))
        both = np.ix_(rows, rows)
        unlike = np.where(self.together[both] < COMPARED, np.inf, self.unlike[both])
        order = np.argsort(unlike, axis=1, kind='stable')[:, :LEADERS]
        usual = np.take_along_axis(unlike, order, axis=1).mean(axis=1)
        others = np.median(self.velocity[rows][order], axis=1)
        squared = ((self.velocity[rows] - others) ** 2).sum(axis=1)
        return rows, squared / (usual + UNSTEADY_PX**2), others

    def place(
        self,
        rows: NDArray[np.int64],
        uv: NDArray[np.float64],
        velocity: NDArray[np.float64],
        sd_px: NDArray[np.float64],
    ) -> None:
        """Put some markers where a better prediction says, if it is better."""
        better = sd_px**2 < self.variance[rows]
        self.redirect(rows[better], uv[better], velocity[better], sd_px[better])

    def scatter(self, row: int) -> None:
        """Forget where a marker is."""
        self.covariance[row] = np.diag([MAX_SD_PX**2, FIRST_SPEED_PX**2])

    @property
    def settled(self) -> NDArray[np.bool_]:
        """Return (n,) whether the velocity of a marker is known."""
        return np.asarray(self.covariance[:, 1, 1] < FIRST_SPEED_PX**2 / 4)

    def redirect(
        self,
        rows: NDArray[np.int64] | int,
        uv: NDArray[np.float64],
        velocity: NDArray[np.float64],
        sd_px: NDArray[np.float64] | float,
    ) -> None:
        """Put markers (k,) at places (k, 2), with velocities (k, 2) [px a frame]."""
        self.uv[rows] = uv
        self.velocity[rows] = velocity
        self.covariance[rows] = np.eye(2) * np.square(sd_px)[..., None, None]

    def exchange(self, one: int, other: int) -> None:
        """Exchange the states of two markers."""
        for values in (self.uv, self.velocity, self.covariance, self.squared):
            values[[one, other]] = values[[other, one]]
        self.unlike[[one, other]] = self.unlike[[other, one]]
        self.unlike[:, [one, other]] = self.unlike[:, [other, one]]
        self.together[[one, other]] = self.together[[other, one]]
        self.together[:, [one, other]] = self.together[:, [other, one]]


def costs(
    uv: NDArray[np.float64], variance: NDArray[np.float64], found: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Costs (n, m), -2 log likelihood, of places (m, 2) for markers predicted at uv (n, 2)."""
    away = uv[:, None] - found[None]
    squared = (away * away).sum(axis=2)
    return squared / variance[:, None] + 2 * np.log(variance)[:, None]


def assign(
    uv: NDArray[np.float64],
    variance: NDArray[np.float64],
    found: NDArray[np.float64],
    gate_sigmas: float,
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Assign places (m, 2) to markers predicted at uv (n, 2); rows of both.

    As many markers as possible get a place within their gate, at the smallest sum of costs.
    """
    if not len(uv) or not len(found):
        return np.zeros(0, dtype=int), np.zeros(0, dtype=int)
    cost = costs(uv, variance, found)
    away = uv[:, None] - found[None]
    inside = (away * away).sum(axis=2) < gate_sigmas**2 * variance[:, None]
    row, column = linear_sum_assignment(np.where(inside, cost, FAR))
    good = inside[row, column]
    return row[good], column[good]


def common_shift(
    uv: NDArray[np.float64], row: int, beside: NDArray[np.int64], found: cKDTree, reach_px: float
) -> NDArray[np.float64] | None:
    """Shift (2,) of a marker that takes most of the markers beside it to shadows, or None.

    uv (n, 2) are predictions, beside (k,) rows of markers that move with it.
    """
    near = found.query_ball_point(uv[row], reach_px)
    if not near:
        return None
    shift = found.data[near] - uv[row]
    there = found.query((uv[beside][None] + shift[:, None]).reshape(-1, 2))[0]
    close = np.minimum(there.reshape(len(near), -1) / GIVEN_SD_PX, 1.0)
    score = (1 - close**2).sum(axis=1) - 0.5 * np.linalg.norm(shift, axis=1) / reach_px
    best = int(np.argmax(score))
    if score[best] < MIN_VOTES:
        return None
    return np.asarray(shift[best])


def doubtful_pairs(
    uv: NDArray[np.float64],
    variance: NDArray[np.float64],
    measured: NDArray[np.bool_],
    found: NDArray[np.float64],
    margin: float,
) -> NDArray[np.int64]:
    """Pairs (k, 2) of markers whose places could as well be exchanged.

    Parameters
    ----------
    uv : (n, 2) ndarray
        Predictions.
    variance : (n,) ndarray
        Of a measured less a predicted coordinate.
    measured : (n,) ndarray of bool
    found : (n, 2) ndarray
        Measured centres; anything where there is none.
    margin : float
        Of -2 log likelihood, below which the other way round is not excluded.
    """
    cost = costs(uv, variance, np.where(measured[:, None], found, FAR))
    own = np.where(measured, np.diagonal(cost), 0.0)
    other = np.where(measured[None], cost, 0.0)
    # Both measured: exchanged. One measured: its place may be that of the other.
    excess = other + other.T - own[:, None] - own[None]
    there = measured[:, None] | measured[None]
    one, two = np.nonzero(np.triu(there & (excess < margin), 1))
    return np.stack([one, two], axis=1)


# What is known of markers from image to image: motion, depth of the shadow, images unseen.

GIVEN_GATE = 3.0  # standard deviations from a given place, within which its marker is
KNOWN_DEPTH_SD = 0.15
RECENT = 4  # images in which a place tells the velocity


@dataclass(frozen=True)
class MeasuredMarkers:
    """Shadows of n markers in one image, by row."""

    measured: NDArray[np.bool_]  #: (n,), the other values say nothing where it is False
    uv: NDArray[np.float64]  #: (n, 2), centres [px]
    shadow: NDArray[np.float64]  #: (n, 2), where their shadows were found, before the fit [px]
    sigma: NDArray[np.float64]  #: (n,), standard deviation of a coordinate [px]
    depth: NDArray[np.float64]  #: (n,)
    #: (n,), the shadow of another marker reaches into that of the marker
    overlapped: NDArray[np.bool_]
    free: NDArray[np.float64]  #: (k, 2), shadows that no marker has [px]

    @classmethod
    def nothing(cls, count: int) -> MeasuredMarkers:
        """Return the result of an image in which none of the markers is seen."""
        nowhere = np.zeros(count, dtype=bool)
        none = np.zeros(count)
        uv = np.zeros((count, 2))
        free = np.zeros((0, 2))
        return cls(nowhere, uv, uv, sigma=none, depth=none, overlapped=nowhere, free=free)


@dataclass
class MarkerStates:
    """What is known of n markers, by row."""

    motion: Motion
    #: (n,), of the shadow, 1 for that of a typical marker
    depth: NDArray[np.float64]
    depth_sd: NDArray[np.float64]
    unseen: NDArray[np.int64]  #: (n,), images since a marker was measured
    placed: NDArray[np.int64]  #: (n,), images since its place was given

    @classmethod
    def start(cls, motion: Motion, unseen: np.ndarray) -> MarkerStates:
        """Return the states of markers whose depth is not known."""
        n = len(unseen)
        long_ago = np.full(n, 2 * RECENT)
        return cls(motion, np.ones(n), np.full(n, DEPTH_SD), unseen=unseen, placed=long_ago)

    @property
    def shadow_variance(self) -> NDArray[np.float64]:
        """Variances (n,) of a coordinate of a shadow less that of the prediction [px^2]."""
        return self.motion.variance + SHADOW_SD_PX**2

    def advance(self, frames: int, led: NDArray[np.bool_] | None) -> None:
        """Predict all markers; led (n,) are those whose velocity follows that of others."""
        self.motion.predict(frames, led)
        self.unseen += 1
        self.placed += 1

    def place(self, rows: NDArray[np.int64], uv: NDArray[np.float64], frames: int) -> None:
        """Put markers at given places (k, 2), frames after the image before.

        The second of two such images tells their velocities. Markers that are followed and there
        anyway go on as they are.
        """
        motion = self.motion
        away = ((uv - motion.uv[rows]) ** 2).sum(axis=1)
        there = away < GIVEN_GATE**2 * (motion.variance[rows] + GIVEN_SD_PX**2)
        elsewhere = ~there | (self.unseen[rows] > 1) | (self.placed[rows] < RECENT)
        rows, uv = rows[elsewhere], uv[elsewhere]
        again = there[elsewhere] & (self.placed[rows] < RECENT)
        again &= self.unseen[rows] <= self.placed[rows]
        since = (self.unseen[rows] + frames - 1)[:, None]  # that they were measured
        before = motion.uv[rows] - since * motion.velocity[rows]
        velocity = np.where(again[:, None], (uv - before) / since, 0.0)
        motion.redirect(rows, uv, velocity, GIVEN_SD_PX)
        motion.covariance[rows[~again], 1, 1] = FIRST_SPEED_PX**2
        self.unseen[rows] = 1
        self.placed[rows] = 0

    def update(self, found: MeasuredMarkers, frames: int) -> None:
        """Take in the markers that were measured, frames after the image before."""
        rows = np.flatnonzero(found.measured)
        self.motion.update(rows, found.uv[rows], found.sigma[rows], frames)
        self.unseen[rows] = 0
        # The depth of a shadow is that of its marker alone.
        free = rows[~found.overlapped[rows]]
        first = self.depth_sd[free] > KNOWN_DEPTH_SD
        memory = np.where(first, 0.0, FORGET)
        self.depth[free] = memory * self.depth[free] + (1 - memory) * found.depth[free]
        self.depth_sd[free] = KNOWN_DEPTH_SD

    def exchange(self, one: int, other: int) -> None:
        """Exchange the states of two markers."""
        self.motion.exchange(one, other)
        for values in (self.depth, self.depth_sd, self.unseen, self.placed):
            values[[one, other]] = values[[other, one]]

    def forget(self, row: int, unseen: int) -> None:
        """Forget where a marker is, as if it had not been measured for a number of images."""
        self.motion.scatter(row)
        self.unseen[row] = unseen
