"""The drift watch: tells from ordinary tracked markers that the calibration no longer holds.

A calibration is wrong by something from its first day, and the markers see that everywhere: a test
of 'mean zero' would cry at once. So the mean of the epipolar residuals in an area of an image is
let be while it is within a dead band: what the calibration's own uncertainty allows (against the
calibration), and beside it, narrower, what is left unknown after the first seconds of markers have
shown the calibration's errors (against the start). A marker along an epipolar line shows nothing;
beads whose distances must not change do (see clusters).

The test: in every area and both directions a CUSUM (Page, Biometrika 41, 1954) of the
log-likelihood ratio of a drift beyond the dead band against one at its edge. As the expectation of
every factor of the likelihood ratio is at most 1 for all means within the band, the mean number of
blocks to a false alarm of a chart is at least exp(threshold) (Lorden, Annals of Mathematical
Statistics 42, 1971; for composite hypotheses Shin, Ramdas and Rinaldo, "E-detectors", New England
Journal of Statistics in Data Science 2, 2024), and with M charts at least an M-th of it: the
thresholds follow from the mean time between false alarms that is asked for. The variance comes
from the data, from differences of successive blocks and from the correlation of a marker's noise
in successive frames, and is never taken smaller than predicted. So noise that markers share, noise
larger than expected and noise that is correlated in time (up to 0.9 in frames of 120 Hz, measured)
are in it. Single residuals are clipped (Huber, Annals of Mathematical Statistics 35, 1964), and so
is what a block can add to a chart.

Not seen: a drift that is there from the start and within what the calibration claims; along the
epipolar lines, one without clusters, or one that moves all beads of a cluster alike, as the shift
of a whole image does; and where there are no markers.
"""

from collections import deque
from dataclasses import dataclass, fields
from itertools import combinations

import numpy as np

from .clusters import CHUNK_S, ClusterWatch

OK = 0
WARN = 1
ERROR = 2
LEVEL = ('OK', 'WARN', 'ERROR')  # text of each level
AGAINST = ('calibration', 'start')  # what a chart of epipolar residuals holds them against
NODES = 8  # of the field of the systematic errors, across an image
# correlation lengths of that field over the width of the image: correction, orientation
SHORT = 0.12
LONG = 1.0
NUGGET = (
    0.35  # part of the systematic standard deviation that a field of these nodes does not follow
)
# Part of the systematic standard deviation that distances in an area have in common: a fifth to
# two fifths measured, as what they were at the start is their reference, and beads some
# centimetres apart have errors of their own.
COMMON = 0.5
CLUSTER_STEP = 2.0  # of step_px in the charts of the clusters, which have less information
PRIOR_DIFFERENCES = 20  # pairs of blocks that the variance of all areas counts for in that of one
LAGS = (1, 2, 4)  # frames, over which the noise is compared
MAX_CORRELATION = 0.97  # of the noise of a marker in successive frames
MEMORY = 160  # blocks over which the variance is estimated
WINDOW_S = 30.0  # of the newest blocks, in which place and size of a drift are estimated
MARGIN = 1.25  # on the estimated variance: of 100 differences it has a standard deviation of 15 %
STEPS_TO_ALARM = 4  # blocks that an alarm takes at least
# of the evidence over the threshold of ERROR, so that it falls again when the drift is gone
CAP = 1.5
FALLS_BELOW = 0.5  # of the threshold of WARN, before an alarm ends
SIMILAR = (
    0.8  # log-likelihood of the other image over that of the named one, from which both are named
)
CONFIRMED = 3.0  # standard deviations by which the other clusters tell a drift too
JUMP_BACK_S = 5.0  # a stamp so much before the last one is a new stream, not a late frame


@dataclass(frozen=True)
class DriftOptions:
    """Settings of the drift watch, with their units.

    error_interval_h, warn_interval_h: mean time between false alarms of each level [h of stream];
    learn_s: length of the start, of which everything later is held against [s]; block_s: time over
    which residuals are gathered [s]; cells: areas across an image, an even number; tolerance_px:
    drift that does not matter, a part of every dead band; step_px: excess over the dead band for
    which a chart is most sensitive; band_calibration and band_start: dead band against the
    calibration and against the start in systematic standard deviations, with the tolerance as the
    root of the sum of squares; clip: residuals beyond so many standard deviations of the noise
    count as much as those; fewest_markers: different markers in an area without which a block
    tells nothing of it. Raises ValueError for values out of their range.
    """

    error_interval_h: float = 1000.0
    warn_interval_h: float = 10.0
    learn_s: float = 10.0
    block_s: float = 0.25
    cells: int = 4
    tolerance_px: float = 0.15
    step_px: float = 0.1
    band_calibration: float = 4.0
    band_start: float = 3.0
    clip: float = 3.0
    fewest_markers: int = 3

    def __post_init__(self):
        ranges = {
            'error_interval_h': (1e-3, 1e9),
            'warn_interval_h': (1e-3, 1e9),
            'learn_s': (1.0, 3600.0),
            'block_s': (0.01, 10.0),
            'cells': (2, 16),
            'tolerance_px': (0.0, 100.0),
            'step_px': (1e-3, 100.0),
            'band_calibration': (1.0, 20.0),
            'band_start': (1.0, 20.0),
            'clip': (1.0, 10.0),
            'fewest_markers': (1, 1000),
        }
        for field in fields(self):
            low, high = ranges[field.name]
            value = getattr(self, field.name)
            if not low <= value <= high:
                raise ValueError(f'{field.name} is a number from {low:g} to {high:g}, not {value}')
        if int(self.cells) != self.cells or self.cells % 2:
            raise ValueError(f'cells is an even number, not {self.cells}')
        if self.warn_interval_h > self.error_interval_h:
            raise ValueError(
                f'false WARNs are to be as frequent as false ERRORs or more: warn_interval_h is '
                f'{self.warn_interval_h:g}, error_interval_h {self.error_interval_h:g}'
            )
        if self.learn_s < 4 * self.block_s:
            raise ValueError(
                f'learn_s is 4 blocks of {self.block_s:g} s or more, not {self.learn_s:g} s'
            )


@dataclass(frozen=True)
class DriftState:
    """What the watch says now.

    level: OK, WARN or ERROR; fluoroscope: name of the one that has drifted, 'a or b' where they
    cannot be told apart, '' without a drift; area (u0, v0, u1, v1): its place in the image [px]
    and place, the same in words; size of the drift and its sd [px], its component along direction
    (2,), a unit vector in the image: normal to the epipolar lines, or along u or v from clusters.
    As residuals are clipped, a size of more than a pixel is a lower bound; against: 'calibration'
    or 'start'; source: 'epipolar' or 'cluster NAME'; evidence: the largest log-likelihood ratio of
    all charts, and the thresholds of it for WARN and ERROR; since_s: time since the drift began,
    as estimated [s]; observations: residuals and distances taken in since the last reset;
    learning: the start is still being learned; message: one sentence. Without a drift size, sd,
    since_s, area and direction are NaN.
    """

    level: int
    fluoroscope: str
    area: tuple
    place: str
    size: float
    sd: float
    direction: tuple
    against: str
    source: str
    evidence: float
    threshold_warn: float
    threshold_error: float
    since_s: float
    observations: int
    learning: bool
    message: str


class Areas:
    """Areas of an image: n x n cells, windows of half its size, halves, and the whole.

    member (areas, cells): 1 where a cell belongs to an area; box (areas, 4): u0, v0, u1, v1 as
    parts of the image.
    """

    def __init__(self, n):
        half = n // 2
        step = max(1, n // 4)
        starts = range(0, half + 1, step) if n % 4 == 0 else (0, half)
        boxes = [(i, j, i + 1, j + 1) for j in range(n) for i in range(n)] if n > 2 else []
        boxes += [(i, j, i + half, j + half) for j in starts for i in starts]
        boxes += [(0, 0, half, n), (half, 0, n, n), (0, 0, n, half), (0, half, n, n), (0, 0, n, n)]
        self.n = n
        self.box = np.array(boxes) / n
        row, column = np.divmod(np.arange(n * n), n)
        left, top, right, bottom = np.array(boxes).T[:, :, None]
        self.member = ((column >= left) & (column < right) & (row >= top) & (row < bottom)).astype(
            float
        )

    def cell(self, uv, size):
        """Cells (n,) of pixels uv (n, 2) of an image of size (width, height); pixels beside it go
        to the nearest.
        """
        column = np.clip((uv[:, 0] + 0.5) * (self.n / size[0]), 0, self.n - 1).astype(int)
        return column + self.n * np.clip(
            (uv[:, 1] + 0.5) * (self.n / size[1]), 0, self.n - 1
        ).astype(int)

    def place(self, number, size):
        """Corners (u0, v0, u1, v1) [px] of an area, and its place in words."""
        u0, v0, u1, v1 = self.box[number]
        corners = tuple(float(x) for x in self.box[number] * np.tile(size, 2) - 0.5)
        across = 'left' if u0 + u1 < 1 else 'right' if u0 + u1 > 1 else 'middle'
        down = 'upper' if v0 + v1 < 1 else 'lower' if v0 + v1 > 1 else 'middle'
        wide = u1 - u0
        high = v1 - v0
        if wide == 1 or high == 1:
            return (
                corners,
                'whole image' if wide == high else f'{across if high == 1 else down} half',
            )
        if wide < 0.5:
            middle = self.box[number].reshape(2, 2).mean(axis=0) * size - 0.5
            return corners, f'{down} {across} quarter, about ({middle[0]:.0f}, {middle[1]:.0f}) px'
        if 'middle' in (across, down):
            return corners, 'middle' if across == down else f'{down} {across}'
        return corners, f'{down} {across} quarter'


class Charts:
    """CUSUM charts of K series in A areas and both directions, with the variance that their blocks
    turn out to have.

    step_px: excess over the dead band for which they are most sensitive; cap: largest evidence.
    """

    def __init__(self, series, areas, step_px, cap):
        shape = (series, areas)
        self._step = step_px
        self._cap = cap
        self.evidence = np.zeros((2, *shape))
        self.begin = np.zeros((2, *shape), dtype=np.int64)
        self._run = np.zeros((2, 2, *shape))  # score and information of the runs, by direction
        self._squares = np.zeros(shape)
        self._count = np.zeros(shape)
        self._last = np.full((2, *shape), np.nan)  # mean and variance of the last block
        self._decay = 1 - 1 / MEMORY
        self.stretch = np.ones(
            (series, 1)
        )  # of the variance of a long sum of blocks over that of their differences

    def factor(self):
        """Variance of sums of blocks over the predicted one (K, A): the estimate, not below 1,
        with its margin.
        """
        pooled = (1 + self._squares.sum(axis=1)) / (1 + self._count.sum(axis=1))
        pooled = np.maximum(pooled, 1)[:, None]
        total = (PRIOR_DIFFERENCES * pooled + self._squares) / (PRIOR_DIFFERENCES + self._count)
        return MARGIN * np.maximum(total, 1) * self.stretch

    def update(self, score, information, band, testing, stamp_ns):
        """One block: score and information (K, A) of drifts [1/px, 1/px^2], dead bands (K, A)
        [px], testing (K, A) where it counts; stamp_ns of its begin.
        """
        seen = information > 0
        factor = self._learn(score, information, seen)
        step = self._step
        sign = np.array([1.0, -1.0])[:, None, None]
        with np.errstate(invalid='ignore'):
            gain = step * (sign * score - band * information - step / 2 * information) / factor
        gain = np.where(seen & testing, np.minimum(gain, self._cap / CAP / STEPS_TO_ALARM), 0.0)
        fresh = (self.evidence <= 0) & (gain > 0)
        self.begin[fresh] = stamp_ns
        self._run[:, fresh] = 0
        self._run += np.where(seen & testing, np.stack([score, information]), 0)[:, None]
        self.evidence = np.clip(self.evidence + gain, 0, self._cap)
        return factor

    def _learn(self, score, information, seen):
        """Take the differences of this block and the last in; the factor (K, A) as it was before."""
        factor = self.factor()
        with np.errstate(divide='ignore', invalid='ignore'):
            now = np.stack([score / information, 1 / information])
            square = (now[0] - self._last[0]) ** 2 / (now[1] + self._last[1])
        both = np.isfinite(square)
        decay = np.where(both, self._decay, 1)
        self._squares *= decay
        self._count *= decay
        # A drift that begins is one large difference: it is not to raise the variance that it is
        # tested with.
        self._squares[both] += np.minimum(square, 9 * factor)[both]
        self._count[both] += 1
        self._last = np.where(seen, now, self._last)
        return factor

    def likelihood(self):
        """Log-likelihood (2, K, A) of a drift of any size in the runs of the charts."""
        score, information = self._run
        return score**2 / (2 * np.maximum(information, 1e-300) * self.factor())


class Field:
    """The systematic errors of a pair of fluoroscopes: a value at each node of both images,
    residuals between them.

    Prior: what the calibration tells of itself, with the correlation of a correction and of an
    orientation. It is estimated from the residuals of the start, marker by marker and block by
    block, by least squares (collocation).
    """

    def __init__(self, sizes):
        self._sizes = np.asarray(sizes, dtype=float)
        self._nodes = NODES * NODES
        self._normal, self._right = np.zeros((2 * self._nodes,) * 2), np.zeros(2 * self._nodes)
        self._systematic = 0.0
        self._count = 0
        self.mean = self.covariance = None

    def weights(self, uv, side):
        """Nodes (n, 4) and their weights (n, 4) at pixels uv (n, 2) of image number side,
        bilinear.
        """
        x = np.clip((uv + 0.5) * ((NODES - 1) / self._sizes[side]), 0, NODES - 1)
        low = np.minimum(x.astype(int), NODES - 2)
        (fu, fv) = (x - low).T
        first = low[:, 0] + NODES * low[:, 1] + side * self._nodes
        weights = np.stack([(1 - fu) * (1 - fv), fu * (1 - fv), (1 - fu) * fv, fu * fv], axis=1)
        return first[:, None] + np.array([0, 1, NODES, NODES + 1]), weights

    def take(self, marker, nodes, weights, residual, variance, systematic):
        """Residuals (n,) [px] of markers (n,) numbered from 0, at nodes and weights (n, 8), into
        the estimate.
        """
        count = np.bincount(marker)
        markers = len(count)
        size = 2 * self._nodes
        rows = np.bincount(
            (marker[:, None] * size + nodes).ravel(), weights.ravel(), markers * size
        )
        rows = rows.reshape(markers, size) / count[:, None]
        weight = count**2 / np.bincount(marker, variance)
        self._normal += rows.T @ (rows * weight[:, None])
        self._right += rows.T @ (weight * np.bincount(marker, residual) / count)
        self._systematic += float(systematic @ systematic)
        self._count += len(systematic)

    def estimate(self, factor):
        """Set mean (m,) and covariance (m, m) [px, px^2]; factor: variance of the residuals over
        the predicted one.
        """
        node = np.stack(np.divmod(np.arange(self._nodes), NODES)) / (NODES - 1)
        square = np.sum((node[:, :, None] - node[:, None]) ** 2, axis=0)
        shape = (np.exp(-square / (2 * SHORT**2)) + np.exp(-square / (2 * LONG**2))) / 2
        # Twice the variance that is claimed, the whole for each image: the prior is to hold
        # nothing back.
        variance = max(self._systematic / max(self._count, 1), 1e-4)
        prior = variance * np.kron(np.eye(2), shape + 1e-6 * np.eye(self._nodes))
        gain = np.linalg.solve(np.eye(len(prior)) + prior @ self._normal / factor, prior)
        self.covariance = (gain + gain.T) / 2
        self.mean = self.covariance @ self._right / factor


@dataclass(frozen=True)
class _Block:
    """Scores, information, systematic standard deviations [px] and whether there are markers
    enough (4, A): image a and b against the calibration, then against the start; normals (2, A, 2)
    of the epipolar lines, summed.
    """

    score: np.ndarray
    information: np.ndarray
    systematic: np.ndarray
    enough: np.ndarray
    normals: np.ndarray


class PairWatch:
    """What one pair of fluoroscopes tells of both images, block by block."""

    def __init__(self, sizes, areas, options):
        self._sizes = sizes
        self._areas = areas
        self._options = options
        self.field = Field(sizes)
        self._squares = np.zeros(len(LAGS))
        self._count = 0.0
        self._frames = 0.0

    def stretch(self):
        """Variance of a long sum of blocks over that of the differences of two, for noise as
        correlated as it is here.

        Noise of a marker: a white part w and an autoregression of variance s and correlation r in
        successive frames. Half the mean squares of differences over 1, 2 and 4 frames, in which
        the place of a marker hardly changes, are V1 = w + s (1 - r), V2 = w + s (1 - r^2), V4 = w
        + s (1 - r^4), whence (V4 - V2)/(V2 - V1) = r (1 + r).
        """
        if not self._count:
            return 1.0
        v1, v2, v4 = self._squares / self._count
        if v2 - v1 < 6 * v1 / np.sqrt(
            self._count
        ):  # three standard deviations: no correlation is seen
            return 1.0
        r = (np.sqrt(1 + 4 * max(v4 - v2, 0) / (v2 - v1)) - 1) / 2
        r = float(np.clip(r, 0.05, MAX_CORRELATION))
        s = min((v2 - v1) / (r * (1 - r)), v1 / (1 - r))
        n = max(self._frames / self._count, 1.0)
        long = (1 + r) / (1 - r)
        # Of means of n: variance and covariance of two in succession, times n.
        own = long - 2 * r * (1 - r**n) / (n * (1 - r) ** 2)
        shared = r * (1 - r**n) ** 2 / (n * (1 - r) ** 2)
        white = v1 - s * (1 - r)
        return max(1.0, (white + s * long) / (white + s * (own - shared)))

    def _correlate(self, marker, standardised):
        """Take the differences of standardised residuals (n,) of markers (n,) in the order of
        frames.
        """
        order = np.argsort(marker, kind='stable')
        marker = marker[order]
        z = standardised[order]
        first = np.flatnonzero(marker[LAGS[-1] :] == marker[: -LAGS[-1]])
        if not len(first):
            return
        decay = 1 - 1 / MEMORY
        self._squares = decay * self._squares + [
            np.sum((z[first + lag] - z[first]) ** 2) / 2 for lag in LAGS
        ]
        self._frames = decay * self._frames + len(first) * len(marker) / (marker[-1] + 1)
        self._count = decay * self._count + len(first)

    def block(self, rows):
        """_Block of rows (n, 14): target id, uv_a, uv_b, residual, sd of noise, systematic sd,
        normals, factors.
        """
        options = self._options
        areas = self._areas
        _, marker = np.unique(rows[:, 0], return_inverse=True)
        residual, sd, systematic = rows[:, 5:8].T
        found = [self.field.weights(rows[:, 1 + 2 * f : 3 + 2 * f], f) for f in (0, 1)]
        nodes, weights = (np.concatenate(part, axis=1) for part in zip(*found))
        variance = sd * sd
        limit = (
            options.clip * sd
            + options.band_calibration * systematic
            + options.tolerance_px
            + 2 * options.step_px
        )
        absolute = np.clip(residual, -limit, limit)
        self._correlate(marker, absolute / sd)
        learned = self.field.mean is not None
        if learned:
            reference = np.sum(self.field.mean[nodes] * weights, axis=1)
            relative = np.clip(residual - reference, -limit, limit)
        else:
            self.field.take(marker, nodes, weights, absolute, variance, systematic)
            relative = absolute
        count = len(areas.member)
        out = _Block(
            *np.zeros((3, 4, count)), np.zeros((4, count), dtype=bool), np.zeros((2, count, 2))
        )
        for f in (0, 1):
            cell = areas.cell(rows[:, 1 + 2 * f : 3 + 2 * f], self._sizes[f])
            weight = rows[:, 12 + f] / variance
            columns = np.stack(
                [
                    weight * absolute,
                    weight * relative,
                    weight * rows[:, 12 + f],
                    weight * systematic,
                    rows[:, 8 + 2 * f],
                    rows[:, 9 + 2 * f],
                ]
            )
            sums = self._summed(cell, columns)
            out.score[[f, 2 + f]] = sums[:2]
            out.information[[f, 2 + f]] = sums[2]
            out.normals[f] = sums[4:].T
            present = np.zeros((areas.n**2, marker.max() + 1))
            present[cell, marker] = 1
            out.enough[[f, 2 + f]] = ((areas.member @ present) > 0).sum(
                axis=1
            ) >= options.fewest_markers
            with np.errstate(divide='ignore', invalid='ignore'):
                out.systematic[f] = sums[3] / sums[2]
                if learned:
                    left = self._left(cell, nodes, weights * weight[:, None]) / sums[2] ** 2
                    out.systematic[2 + f] = np.sqrt(left + (NUGGET * out.systematic[f]) ** 2)
        return out

    def _summed(self, cell, columns):
        """Sums (k, A) of columns (k, n) over the areas of cells (n,)."""
        size = self._areas.n**2
        k = len(columns)
        index = cell + size * np.arange(k)[:, None]
        return (
            np.bincount(index.ravel(), columns.ravel(), k * size).reshape(k, size)
            @ self._areas.member.T
        )

    def _left(self, cell, nodes, weights):
        """Variance (A,) of the weighted sums of residuals in the areas, by what the field is not
        known to.
        """
        size = len(self.field.mean)
        sums = np.bincount(
            (cell[:, None] * size + nodes).ravel(), weights.ravel(), self._areas.n**2 * size
        )
        sums = self._areas.member @ sums.reshape(-1, size)
        return np.maximum(np.sum((sums @ self.field.covariance) * sums, axis=1), 0)


class DriftWatch:
    """The drift watch of a rig.

    image_sizes {fluoroscope: (width, height)} [px]; options: DriftOptions; clusters: Cluster, ...
    of beads, which need rig: interior (F, 3), rotation (F, 3, 3), position_mm (F, 3) in the order
    of image_sizes, as in RigOrientation. Raises ValueError for fewer than two fluoroscopes, and
    for clusters without rig.
    """

    def __init__(self, image_sizes, options=DriftOptions(), clusters=(), rig=None):
        if len(image_sizes) < 2:
            raise ValueError(f'a drift watch needs two fluoroscopes, not {len(image_sizes)}')
        if clusters and rig is None:
            raise ValueError('clusters need the orientation of the rig')
        self.options = options
        self._sizes = {name: tuple(size) for name, size in image_sizes.items()}
        self._names = tuple(self._sizes)
        self._areas = Areas(int(options.cells))
        self._pairs = list(combinations(self._names, 2))
        self._cluster_watch = (
            ClusterWatch(clusters, *rig, list(self._sizes.values()), self._areas, options)
            if clusters
            else None
        )
        series = 4 * len(self._pairs) + (2 * len(self._names) if clusters else 0)
        charts = 2 * series * len(self._areas.member)
        self.thresholds = tuple(
            float(np.log(charts * hours * 3600 / options.block_s))
            for hours in (options.warn_interval_h, options.error_interval_h)
        )
        self.reset()

    def reset(self):
        """Forget everything: after a new calibration or orientation."""
        options = self.options
        cap = CAP * self.thresholds[1]
        areas = len(self._areas.member)
        self._watches = [
            PairWatch([self._sizes[name] for name in pair], self._areas, options)
            for pair in self._pairs
        ]
        self._charts = [
            Charts(4 * len(self._pairs), areas, options.step_px, cap),
            Charts(2 * len(self._names), areas, CLUSTER_STEP * options.step_px, cap),
        ]
        window = max(4, round(WINDOW_S / options.block_s))
        self._rings = [deque(maxlen=window), deque(maxlen=window)]
        self._rows = [[] for _ in self._pairs]
        self._blocks = [0] * (len(self._pairs) + 1)
        self._told = 0
        self._start = self._newest = None
        self._offset = 0
        self._observations = 0
        self._level = OK
        if self._cluster_watch:
            self._cluster_watch.clear()
        self.state = self._state()

    @property
    def watched_s(self):
        """Length of the blocks after the start in which a drift could be told somewhere [s]."""
        return self._told * self.options.block_s

    def add(
        self,
        stamp_ns,
        a,
        b,
        target_id,
        uv_a,
        uv_b,
        residual,
        sd_noise,
        sd_systematic,
        normal_a,
        normal_b,
        factor_a,
        factor_b,
    ):
        """Take in the epipolar residuals of a pair of frames; returns the DriftState.

        stamp_ns; names a, b; target_id (n,); uv_a, uv_b (n, 2): where the markers are in the
        images [px]; residual (n,), its sd_noise and sd_systematic (that of correction and
        orientation) (n,) or numbers [px]; normal_a, normal_b (n, 2) and factor_a, factor_b (n,) as
        in EpipolarResiduals. What is not finite is left out. Residuals that are too large for a
        match belong to it too: they are clipped here, and a large drift has no others. Raises
        ValueError for an unknown pair of fluoroscopes, and for arrays that do not belong together.
        """
        number, turned = self._number(a, b)
        self._advance(stamp_ns)
        n = len(target_id)
        rows = np.empty((n, 14))
        order = (
            (uv_b, uv_a, normal_b, normal_a, factor_b, factor_a)
            if turned
            else (uv_a, uv_b, normal_a, normal_b, factor_a, factor_b)
        )
        if n:
            rows[:, 0] = target_id
            rows[:, 1:3], rows[:, 3:5], rows[:, 8:10], rows[:, 10:12], rows[:, 12], rows[:, 13] = (
                order
            )
            rows[:, 5] = residual
            rows[:, 6] = sd_noise
            rows[:, 7] = sd_systematic
            self._rows[number].append(rows)
        return self.state

    def add_points(self, stamp_ns, target_id, xyz_mm, covariance, uv, sd_systematic):
        """Take in intersected points for the clusters; returns the DriftState.

        target_id (n,); xyz_mm (n, 3); covariance (n, 3, 3) of the image noise alone [mm^2]; uv (F,
        n, 2): where the points are in the images; sd_systematic (F, n) or a number: of the
        corrections there [px]. Without clusters nothing happens. Raises ValueError for arrays that
        do not belong together.
        """
        self._advance(stamp_ns)
        if self._cluster_watch:
            target_id, n, f = np.asarray(target_id), len(target_id), len(self._names)
            xyz_mm, covariance, uv = (np.asarray(x, dtype=float) for x in (xyz_mm, covariance, uv))
            if xyz_mm.shape != (n, 3) or covariance.shape != (n, 3, 3) or uv.shape != (f, n, 2):
                raise ValueError(
                    f'xyz_mm is ({n}, 3), covariance ({n}, 3, 3), uv ({f}, {n}, 2), not {xyz_mm.shape}, '
                    f'{covariance.shape}, {uv.shape}'
                )
            self._cluster_watch.add(
                (stamp_ns + self._offset) / 1e9,
                target_id,
                xyz_mm,
                covariance,
                uv,
                np.broadcast_to(sd_systematic, (f, n)),
            )
        return self.state

    def _number(self, a, b):
        """Number of a pair, and whether it is the other way round."""
        for pair, turned in (((a, b), False), ((b, a), True)):
            if pair in self._pairs:
                return self._pairs.index(pair), turned
        raise ValueError(
            f'there is no pair of fluoroscopes {a!r} and {b!r}, only of {", ".join(self._names)}'
        )

    def _advance(self, stamp_ns):
        """Close the block where this stamp is of a later one. A late frame goes into the present
        block.
        """
        now = int(stamp_ns) + self._offset
        length = round(self.options.block_s * 1e9)
        if self._start is None:
            self._start = self._newest = now
        if (
            now < self._newest - JUMP_BACK_S * 1e9
        ):  # a new stream: its time goes on where the last one stopped
            self._offset += self._newest - now
            now = self._newest
        self._newest = max(self._newest, now)
        if now >= self._start + length:
            self._close()
            self._start += (now - self._start) // length * length

    def _close(self):
        """Update the charts with the present block, and the state."""
        options = self.options
        watch = self._cluster_watch
        shape = (4 * len(self._pairs), len(self._areas.member))
        values = np.zeros((3, *shape))
        testing = np.zeros(shape, dtype=bool)
        normals = np.zeros((len(self._pairs), 2, shape[1], 2))
        seen = []
        told = False
        for number in range(len(self._pairs)):
            rows = np.concatenate(self._rows[number]) if self._rows[number] else np.zeros((0, 14))
            self._rows[number] = []
            rows = rows[
                np.isfinite(rows).all(axis=1) & (rows[:, 6] > 0) & (rows[:, 12:].min(axis=1) > 0)
            ]
            if not len(rows):
                continue
            block = self._watches[number].block(rows)
            own = slice(4 * number, 4 * number + 4)
            seen.append(number)
            self._observations += len(rows)
            values[:, own] = block.score, block.information, block.systematic
            testing[own] = block.enough & self._learned(number)
            normals[number] = block.normals
        if seen:
            stretch = np.array([own.stretch() for own in self._watches])
            self._charts[0].stretch[:, 0] = np.repeat(stretch, 4)
            self._charts[1].stretch[:] = stretch.max()
            bands = np.tile(
                np.repeat([options.band_calibration, options.band_start], 2), len(self._pairs)
            )
            self._take(0, values, bands[:, None], testing, normals)
            told = testing.any()
            for number in seen:
                self._learn(number)
        if watch:
            block = watch.block()
            if block is not None:
                self._observations += block.count
                testing = (block.pairs > 2 * options.block_s / CHUNK_S) & self._learned(-1)
                self._take(
                    1,
                    [block.score.sum(axis=0), block.information.sum(axis=0), _common(block)],
                    options.band_start,
                    testing,
                    block,
                )
                told = told or testing.any()
                self._blocks[-1] += 1
                if self._learned(-1):
                    watch.learn()
        self._told += bool(told)
        self.state = self._state()

    def _learned(self, number):
        return self._blocks[number] * self.options.block_s >= self.options.learn_s

    def _learn(self, number):
        """Count a block of the start of a pair; with the last of them, the field of systematic
        errors is estimated.
        """
        if self._learned(number):
            return
        self._blocks[number] += 1
        if self._learned(number):
            factor = self._charts[0].factor()[4 * number : 4 * number + 2]
            self._watches[number].field.estimate(float(np.median(factor)))

    def _take(self, kind, values, bands, testing, more):
        """A block (score, information, systematic sd) into charts number kind and its ring; more:
        normals, or the ClusterBlock.
        """
        score, information, systematic = values
        band = np.hypot(self.options.tolerance_px, bands * np.nan_to_num(systematic))
        self._charts[kind].update(score, information, band, testing, self._start)
        self._rings[kind].append((self._start, score, information, systematic, more))

    def _state(self):
        """The DriftState of the charts as they stand."""
        warn, error = self.thresholds
        peaks = [float(charts.evidence.max()) for charts in self._charts]
        evidence = max(peaks)
        level = ERROR if evidence >= error else WARN if evidence >= warn else OK
        if level < self._level and evidence >= FALLS_BELOW * warn:
            level = self._level
        self._level = level
        learning = not any(self._blocks) or any(
            count and not self._learned(number) for number, count in enumerate(self._blocks)
        )
        nothing = (float('nan'),) * 4
        if level == OK:
            text = (
                'no markers were seen'
                if not self._observations
                else 'the start is being learned'
                if learning
                else 'no drift is seen'
            )
            return DriftState(
                OK,
                '',
                nothing,
                '',
                np.nan,
                np.nan,
                nothing[:2],
                '',
                '',
                evidence,
                warn,
                error,
                np.nan,
                self._observations,
                learning,
                text,
            )
        return self._named(level, int(np.argmax(peaks)), evidence, learning)

    def _named(self, level, kind, evidence, learning):
        """The DriftState of an alarm: where the likelihood of a drift is largest since the run of
        its chart began.
        """
        charts = self._charts[kind]
        likelihood = np.where(
            charts.evidence >= min(evidence, self.thresholds[0]), charts.likelihood(), -1
        )
        start = np.arange(likelihood.shape[1]) % 4 >= 2
        if (
            kind == 0 and likelihood[:, start].max() >= 0
        ):  # it knows the errors of the calibration: it is sharper
            likelihood[:, ~start] = -1
        sign, series, area = np.unravel_index(np.argmax(likelihood), likelihood.shape)
        begin, run = self._run(kind, series, area, charts.begin[sign, series, area])
        score, information = (sum(entry[i] for entry in run) for i in (1, 2))
        factor = float(np.median(charts.factor()[series]))
        with np.errstate(divide='ignore', invalid='ignore'):
            size = score / information
        likelihood = np.nan_to_num(score * size / (2 * factor))
        names, series, area = (self._of_pairs if kind == 0 else self._of_clusters)(
            likelihood, series
        )
        name = names[0]
        systematic = np.nansum([entry[3][series, area] * entry[2][series, area] for entry in run])
        size = float(size[series, area])
        sd = float(
            np.hypot(
                np.sqrt(factor / information[series, area]), systematic / information[series, area]
            )
        )
        direction, source, confirmed = (self._direction if kind == 0 else self._cluster)(
            run, series, area
        )
        against = AGAINST[series % 4 // 2] if kind == 0 else AGAINST[1]
        corners, place = self._areas.place(area, self._sizes[name])
        since = max(self._newest - begin, 0) / 1e9
        direction = tuple(float(x) for x in np.sign(size) * direction)
        which = ' or '.join(names)
        doubt = (
            ''
            if kind == 0 or confirmed
            else ', in which a bead may have moved, for no other cluster tells it'
        )
        text = (
            f'{LEVEL[level]}: the image of fluoroscope {which} has drifted by {abs(size):.2f} px (sd {sd:.2f}) '
            f'towards ({direction[0]:.1f}, {direction[1]:.1f}), {place}, for {since:.1f} s, held against the '
            f'{against}; seen in {"the epipolar residuals" if kind == 0 else source}{doubt}'
        )
        return DriftState(
            level,
            which,
            corners,
            place,
            abs(size),
            sd,
            direction,
            against,
            source,
            evidence,
            *self.thresholds,
            since,
            self._observations,
            learning,
            text,
        )

    def _run(self, kind, series, area, begin):
        """Begin of the drift [ns], and the entries of the ring since: the newest blocks with the
        largest likelihood.

        begin: of the run of the chart; it holds where the drift is older than the ring.
        """
        ring = list(self._rings[kind])
        sums = np.cumsum(
            [[entry[1][series, area], entry[2][series, area]] for entry in reversed(ring)], axis=0
        )
        first = len(ring) - 1 - int(np.argmax(sums[:, 0] ** 2 / np.maximum(sums[:, 1], 1e-300)))
        return (min(begin, ring[0][0]) if first == 0 else ring[first][0]), ring[first:]

    def _of_pairs(self, likelihood, series):
        """Names of the fluoroscopes that have most likely drifted, and series and area of the
        first of them.
        """
        against = series % 4 // 2
        best = {}
        for name in self._names:
            own = [
                4 * n + 2 * against + pair.index(name)
                for n, pair in enumerate(self._pairs)
                if name in pair
            ]
            total = likelihood[own].sum(axis=0)
            area = int(np.argmax(total))
            best[name] = float(total[area]), own[int(np.argmax(likelihood[own, area]))], area
        return self._ranked(best)

    def _of_clusters(self, likelihood, _):
        best = {}
        for f, name in enumerate(self._names):
            k, area = np.unravel_index(
                np.argmax(likelihood[2 * f : 2 * f + 2]), (2, likelihood.shape[1])
            )
            best[name] = float(likelihood[2 * f + k, area]), int(2 * f + k), int(area)
        return self._ranked(best)

    def _ranked(self, best):
        """Names by likelihood, those as likely as the first only; its series and area."""
        order = sorted(best, key=lambda name: -best[name][0])
        top = best[order[0]]
        return [name for name in order if best[name][0] >= SIMILAR * top[0]], top[1], top[2]

    def _direction(self, run, series, area):
        """Normal (2,) of the epipolar lines in an area, the source, True."""
        normal = sum(entry[4][series // 4, series % 2, area] for entry in run)
        return normal / max(np.linalg.norm(normal), 1e-300), 'epipolar', True

    def _cluster(self, run, series, area):
        """Direction (2,) of a series of the clusters, the cluster that tells most, whether the
        others tell it too.
        """
        score, information = (
            sum(getattr(entry[4], name)[:, series, area] for entry in run)
            for name in ('score', 'information')
        )
        told = np.sign(score.sum()) * score / np.sqrt(np.maximum(information, 1e-300))
        most = int(np.argmax(told))
        factor = float(np.median(self._charts[1].factor()[series]))
        others = np.arange(len(told)) != most
        rest = (
            np.sign(score.sum())
            * score[others].sum()
            / np.sqrt(max(information[others].sum() * factor, 1e-300))
        )
        return (
            np.eye(2)[series % 2],
            f'cluster {self._cluster_watch.names[most]}',
            bool(rest > CONFIRMED),
        )


def _common(block):
    """Systematic standard deviations (2F, A) [px] of what all clusters tell together: the weighted
    mean.
    """
    with np.errstate(divide='ignore', invalid='ignore'):
        return (
            COMMON
            * np.nansum(block.systematic * block.information, axis=0)
            / block.information.sum(axis=0)
        )
