# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Motion of markers in an image: prediction, assignment, and detection of possible exchanges.

Each marker has a Kalman filter of constant velocity whose disturbance is a white acceleration
(Bar-Shalom, Li and Kirubarajan, "Estimation with Applications to Tracking and Navigation", 2001,
6.3.2). Its size is estimated from the innovations. Shadows are assigned to all markers together
(Kuhn and Munkres, by scipy) at the largest likelihood: a squared Mahalanobis distance and the
logarithm of the determinant of its covariance (ibid., 5.4).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment
from scipy.spatial import cKDTree

from .shadow_fit import DEPTH_SD

FIRST_SPEED_PX = 6.0  # standard deviation of the unknown initial velocity [px/frame]
FORGET = 0.9  # weight of the past in a running mean
COMPARED = 5  # images after which it is known how alike two markers move
UNSTEADY_PX = 0.5  # usual change of a velocity in a frame, or difference of two [px/frame]
LEADERS = 4  # number of markers whose motion an unseen marker follows
LED = 0.5  # share of the acceleration that they do not explain
MAX_SD_PX = 60.0  # largest standard deviation of a prediction
MODEL_SD_PX = 0.05  # standard deviation of a place in addition to the noise of the measurement
SHADOW_SD_PX = 0.25  # standard deviation of the place of a shadow before the fit
GIVEN_SD_PX = 1.5  # standard deviation of a place that is given, or predicted from neighbours
FAR = 1e6  # cost of an assignment outside the gate, and place without a measurement
MIN_VOTES = 1.5  # least score of a common shift of markers


@dataclass
class Motion:
    """State of the filters of n markers."""

    uv: NDArray[np.float64]  #: (n, 2), places [px]
    velocity: NDArray[np.float64]  #: (n, 2), velocities [px/frame]
    covariance: NDArray[np.float64]  #: (n, 2, 2), of place and velocity, the same along u and v
    squared: NDArray[np.float64]  #: (n,), running mean of squared accelerations
    unlike: NDArray[np.float64]  #: (n, n), running mean of squared differences of velocities
    together: NDArray[np.int64]  #: (n, n), number of images in which they were compared

    @classmethod
    def start(cls, uv: np.ndarray, sd_px: float) -> Motion:
        """Return filters of markers at uv (n, 2) with unknown velocity."""
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
        """Predict all markers after a number of frames.

        led (n,): True for markers whose velocity follows that of others.
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
        """Return variances (n,) of measured minus predicted coordinates of some markers."""
        return self.variance[rows] + sigma**2 + MODEL_SD_PX**2

    def update(
        self,
        rows: NDArray[np.int64],
        uv: NDArray[np.float64],
        sigma: NDArray[np.float64],
        frames: int,
    ) -> None:
        """Update some markers with measured centres (m, 2)."""
        innovation = uv - self.uv[rows]
        settled = self.settled[rows]
        p = self.covariance[rows]
        gain = p[:, :, 0] / self.innovation_variance(sigma, rows)[:, None]
        self.uv[rows] += gain[:, :1] * innovation
        self.velocity[rows] += gain[:, 1:] * innovation
        self.covariance[rows] = p - gain[:, :, None] * p[:, None, 0, :]
        # Acceleration from the innovation; a first or late innovation has little information.
        observed = 0.5 * (innovation**2).sum(axis=1) / float(frames) ** 4
        observed = np.maximum(observed - sigma**2, 0)
        smoothed = FORGET * self.squared[rows] + (1 - FORGET) * observed
        self.squared[rows] = np.where(settled, smoothed, self.squared[rows])

    def lead(
        self, seen: NDArray[np.bool_], before: NDArray[np.float64], sure: NDArray[np.bool_]
    ) -> NDArray[np.bool_]:
        """Let unseen markers follow markers that move alike; return (n,) which do.

        seen (n,): measured now; before (n, 2): velocities before these measurements. Which markers
        move alike is learned from those with certain ids, sure (n,).
        """
        rows = np.flatnonzero(seen & self.settled)
        led = np.zeros(len(seen), dtype=bool)
        if len(rows) < LEADERS:
            return led
        velocity = self.velocity[rows]
        difference = ((velocity[:, None] - velocity[None]) ** 2).sum(axis=2)
        pairs = np.ix_(rows, rows)
        learned = sure[rows, None] & sure[rows]
        self.together[pairs] += learned
        share = learned * np.maximum(1 / np.maximum(self.together[pairs], 1), 1 - FORGET)
        unlike_before = np.where(learned & (self.together[pairs] == 1), 0.0, self.unlike[pairs])
        np.fill_diagonal(unlike_before, 0.0)
        self.unlike[pairs] = (1 - share) * unlike_before + share * difference
        self.unlike[rows, rows] = np.inf
        for row in np.flatnonzero(~seen & self.settled).tolist():
            company = self.company(row, rows)
            self.velocity[row] += np.median(self.velocity[company] - before[company], axis=0)
            led[row] = True
        return led

    def company(self, row: int, among: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return the LEADERS among some markers that move most like a marker.

        If it is not known which do, return the nearest.
        """
        distance = np.linalg.norm(self.uv[among] - self.uv[row], axis=1)
        return among[np.lexsort((distance, self.unlike[row, among]))[:LEADERS]]

    def strangeness(
        self, seen: NDArray[np.bool_]
    ) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]:
        """Compare velocities with those of the markers that moved alike so far.

        Return, for markers in rows (k,), the ratio (k,) of the squared difference to the usual
        one, and the velocities (k, 2) of the others. seen (n,): True for markers measured now.
        """
        rows = np.flatnonzero(seen & self.settled)
        if len(rows) <= LEADERS:
            return np.zeros(0, dtype=int), np.zeros(0), np.zeros((0, 2))
        pairs = np.ix_(rows, rows)
        unlike = np.where(self.together[pairs] < COMPARED, np.inf, self.unlike[pairs])
        order = np.argsort(unlike, axis=1, kind='stable')[:, :LEADERS]
        usual = np.take_along_axis(unlike, order, axis=1).mean(axis=1)
        company_velocity = np.median(self.velocity[rows][order], axis=1)
        squared = ((self.velocity[rows] - company_velocity) ** 2).sum(axis=1)
        return rows, squared / (usual + UNSTEADY_PX**2), company_velocity

    def place(
        self,
        rows: NDArray[np.int64],
        uv: NDArray[np.float64],
        velocity: NDArray[np.float64],
        sd_px: NDArray[np.float64],
    ) -> None:
        """Move some markers to other predictions if these are more precise."""
        better = sd_px**2 < self.variance[rows]
        self.redirect(rows[better], uv[better], velocity[better], sd_px[better])

    def scatter(self, row: int) -> None:
        """Discard the place of a marker."""
        self.covariance[row] = np.diag([MAX_SD_PX**2, FIRST_SPEED_PX**2])

    @property
    def settled(self) -> NDArray[np.bool_]:
        """Whether (n,) the velocity of a marker is known."""
        return np.asarray(self.covariance[:, 1, 1] < FIRST_SPEED_PX**2 / 4)

    def redirect(
        self,
        rows: NDArray[np.int64] | int,
        uv: NDArray[np.float64],
        velocity: NDArray[np.float64],
        sd_px: NDArray[np.float64] | float,
    ) -> None:
        """Set places (k, 2) and velocities (k, 2) [px/frame] of markers (k,)."""
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
    uv: NDArray[np.float64], variance: NDArray[np.float64], positions: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return costs (n, m), -2 log-likelihood, of places (m, 2) for predictions uv (n, 2)."""
    offset = uv[:, None] - positions[None]
    squared = (offset * offset).sum(axis=2)
    return squared / variance[:, None] + 2 * np.log(variance)[:, None]


def assign(
    uv: NDArray[np.float64],
    variance: NDArray[np.float64],
    positions: NDArray[np.float64],
    gate_sigmas: float,
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Assign places (m, 2) to markers predicted at uv (n, 2); return rows of both.

    As many markers as possible are assigned a place within their gate, at the least sum of costs.
    """
    if not len(uv) or not len(positions):
        return np.zeros(0, dtype=int), np.zeros(0, dtype=int)
    cost = costs(uv, variance, positions)
    offset = uv[:, None] - positions[None]
    inside = (offset * offset).sum(axis=2) < gate_sigmas**2 * variance[:, None]
    row, column = linear_sum_assignment(np.where(inside, cost, FAR))
    accepted = inside[row, column]
    return row[accepted], column[accepted]


def common_shift(
    uv: NDArray[np.float64],
    row: int,
    neighbours: NDArray[np.int64],
    shadow_tree: cKDTree,
    reach_px: float,
) -> NDArray[np.float64] | None:
    """Return the shift (2,) of a marker that moves most of its neighbours to shadows, or None.

    uv (n, 2) are predictions, neighbours (k,) the rows of its neighbours.
    """
    nearby = shadow_tree.query_ball_point(uv[row], reach_px)
    if not nearby:
        return None
    shift = shadow_tree.data[nearby] - uv[row]
    distance = shadow_tree.query((uv[neighbours][None] + shift[:, None]).reshape(-1, 2))[0]
    relative = np.minimum(distance.reshape(len(nearby), -1) / GIVEN_SD_PX, 1.0)
    score = (1 - relative**2).sum(axis=1) - 0.5 * np.linalg.norm(shift, axis=1) / reach_px
    best = int(np.argmax(score))
    if score[best] < MIN_VOTES:
        return None
    return np.asarray(shift[best])


def doubtful_pairs(
    uv: NDArray[np.float64],
    variance: NDArray[np.float64],
    measured: NDArray[np.bool_],
    positions: NDArray[np.float64],
    margin: float,
) -> NDArray[np.int64]:
    """Return pairs (k, 2) of markers whose places could as well be exchanged.

    Parameters
    ----------
    uv : (n, 2) ndarray
        Predictions.
    variance : (n,) ndarray
        Variances of a measured minus a predicted coordinate.
    measured : (n,) ndarray of bool
    positions : (n, 2) ndarray
        Measured centres; any value if there is none.
    margin : float
        Least increase of -2 log-likelihood that excludes an exchange.
    """
    cost = costs(uv, variance, np.where(measured[:, None], positions, FAR))
    own_cost = np.where(measured, np.diagonal(cost), 0.0)
    exchanged_cost = np.where(measured[None], cost, 0.0)
    # Both measured: exchanged. One measured: its place may belong to the other.
    excess = exchanged_cost + exchanged_cost.T - own_cost[:, None] - own_cost[None]
    is_possible = measured[:, None] | measured[None]
    i, j = np.nonzero(np.triu(is_possible & (excess < margin), 1))
    return np.stack([i, j], axis=1)


# States of markers between images: motion, depth of the shadow, number of images unseen.

GIVEN_GATE = 3.0  # largest distance of a marker from a given place [standard deviations]
KNOWN_DEPTH_SD = 0.15  # standard deviation of the depth of a measured marker
RECENT = 4  # images within which two given places determine the velocity


@dataclass(frozen=True)
class MeasuredMarkers:
    """Shadows of n markers in one image, by row."""

    measured: NDArray[np.bool_]  #: (n,); if False, the other values have no meaning
    uv: NDArray[np.float64]  #: (n, 2), centres [px]
    shadow: NDArray[np.float64]  #: (n, 2), places of the shadows before the fit [px]
    sigma: NDArray[np.float64]  #: (n,), standard deviation of a coordinate [px]
    depth: NDArray[np.float64]  #: (n,), depth of the shadow, 1 for that of a typical marker
    #: (n,), True if the shadow of another marker reaches into that of the marker
    overlapped: NDArray[np.bool_]
    free: NDArray[np.float64]  #: (k, 2), shadows that are assigned to no marker [px]

    @classmethod
    def nothing(cls, count: int) -> MeasuredMarkers:
        """Return the result of an image in which none of the markers is seen."""
        unmeasured = np.zeros(count, dtype=bool)
        zero = np.zeros(count)
        uv = np.zeros((count, 2))
        free = np.zeros((0, 2))
        return cls(unmeasured, uv, uv, sigma=zero, depth=zero, overlapped=unmeasured, free=free)


@dataclass
class MarkerStates:
    """States of n markers, by row."""

    motion: Motion
    #: (n,), depth of the shadow, 1 for that of a typical marker
    depth: NDArray[np.float64]
    depth_sd: NDArray[np.float64]
    unseen: NDArray[np.int64]  #: (n,), number of images since a marker was measured
    placed: NDArray[np.int64]  #: (n,), number of images since its place was given

    @classmethod
    def start(cls, motion: Motion, unseen: np.ndarray) -> MarkerStates:
        """Return the states of markers with unknown depth."""
        n = len(unseen)
        long_ago = np.full(n, 2 * RECENT)
        return cls(motion, np.ones(n), np.full(n, DEPTH_SD), unseen=unseen, placed=long_ago)

    @property
    def shadow_variance(self) -> NDArray[np.float64]:
        """Variances (n,) of a coordinate of a shadow minus its prediction [px^2]."""
        return self.motion.variance + SHADOW_SD_PX**2

    def advance(self, frames: int, led: NDArray[np.bool_] | None) -> None:
        """Predict all markers; led (n,) are those whose velocity follows that of others."""
        self.motion.predict(frames, led)
        self.unseen += 1
        self.placed += 1

    def place(self, rows: NDArray[np.int64], uv: NDArray[np.float64], frames: int) -> None:
        """Set markers to given places (k, 2), `frames` after the previous image.

        The second of two such images determines their velocities. Markers that are tracked and
        near the given place anyway keep their state.
        """
        motion = self.motion
        squared = ((uv - motion.uv[rows]) ** 2).sum(axis=1)
        is_expected = squared < GIVEN_GATE**2 * (motion.variance[rows] + GIVEN_SD_PX**2)
        is_moved = ~is_expected | (self.unseen[rows] > 1) | (self.placed[rows] < RECENT)
        rows, uv = rows[is_moved], uv[is_moved]
        is_repeated = is_expected[is_moved] & (self.placed[rows] < RECENT)
        is_repeated &= self.unseen[rows] <= self.placed[rows]
        elapsed = (self.unseen[rows] + frames - 1)[:, None]  # frames since they were measured
        last_uv = motion.uv[rows] - elapsed * motion.velocity[rows]
        velocity = np.where(is_repeated[:, None], (uv - last_uv) / elapsed, 0.0)
        motion.redirect(rows, uv, velocity, GIVEN_SD_PX)
        motion.covariance[rows[~is_repeated], 1, 1] = FIRST_SPEED_PX**2
        self.unseen[rows] = 1
        self.placed[rows] = 0

    def update(self, measured: MeasuredMarkers, frames: int) -> None:
        """Update the measured markers, `frames` after the previous image."""
        rows = np.flatnonzero(measured.measured)
        self.motion.update(rows, measured.uv[rows], measured.sigma[rows], frames)
        self.unseen[rows] = 0
        # The depth of a shadow is only known if no other shadow overlaps.
        separate = rows[~measured.overlapped[rows]]
        first = self.depth_sd[separate] > KNOWN_DEPTH_SD
        memory = np.where(first, 0.0, FORGET)
        self.depth[separate] = (
            memory * self.depth[separate] + (1 - memory) * measured.depth[separate]
        )
        self.depth_sd[separate] = KNOWN_DEPTH_SD

    def exchange(self, one: int, other: int) -> None:
        """Exchange the states of two markers."""
        self.motion.exchange(one, other)
        for values in (self.depth, self.depth_sd, self.unseen, self.placed):
            values[[one, other]] = values[[other, one]]

    def forget(self, row: int, unseen: int) -> None:
        """Discard the place of a marker, as if it had not been measured for a number of images."""
        self.motion.scatter(row)
        self.unseen[row] = unseen
