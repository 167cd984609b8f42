"""Rigid clusters of beads: what their distances tell of a drift that epipolar residuals cannot
see.

A shift along an epipolar line moves the intersected point in depth, and all rays still meet. Two
beads of a rigid cluster of which one is in the area that has drifted and the other is not then
come nearer or go apart: a distance d = |P_i - P_j| changes by e^T dP_i for a shift of bead i and
by -e^T dP_j for one of bead j, e the direction between them and dP the movement of an intersected
point for a pixel in an image. So every distance is a measurement of the drift of an area [px],
with a response, as every epipolar residual is. Where both beads shift by the same nothing is to be
seen: a drift of the whole image along the epipolar lines moves and turns a cluster as it is.
"""

from dataclasses import dataclass

import numpy as np

from ..photogrammetry.collinearity import project_with_jacobian

# a cluster is taken to stand still for so long; the distances themselves are of every frame
CHUNK_S = 0.05
BETWEEN = 2  # components of a shift in an image, u and v


@dataclass(frozen=True)
class Cluster:
    """A rigid cluster: name, target_id (n,) of its beads and, if known, their distances_mm (n, n)
    with sd_mm of each.

    Without distances these are learned during the start. Raises ValueError for fewer than two
    beads, one bead twice, or distances that are none.
    """

    name: str
    target_id: tuple
    distances_mm: np.ndarray | None = None
    sd_mm: float = 0.0

    def __post_init__(self):
        ids = tuple(int(i) for i in self.target_id)
        object.__setattr__(self, 'target_id', ids)
        if len(ids) < 2 or len(set(ids)) < len(ids):
            raise ValueError(
                f'cluster {self.name}: it is two beads or more, each named once, not {ids}'
            )
        if not (np.isfinite(self.sd_mm) and self.sd_mm >= 0):
            raise ValueError(f'cluster {self.name}: sd_mm is a number from 0 on, not {self.sd_mm}')
        if self.distances_mm is not None:
            d = np.array(self.distances_mm, dtype=float)
            if d.shape != (len(ids),) * 2 or not np.isfinite(d).all() or not np.allclose(d, d.T):
                raise ValueError(
                    f'cluster {self.name}: distances_mm is a symmetric matrix of {len(ids)} x {len(ids)}'
                )
            if not (d[np.triu_indices(len(ids), 1)] > 0).all():
                raise ValueError(
                    f'cluster {self.name}: the distance between two beads is above 0 mm'
                )
            d.setflags(write=False)
            object.__setattr__(self, 'distances_mm', d)


@dataclass(frozen=True)
class ClusterBlock:
    """Scores, information and systematic standard deviations [px] (C, 2F, A) of drifts of area A
    along u and v of the fluoroscopes, by cluster; pairs (2F, A): distances between a bead in the
    area and one outside; count: distances.
    """

    score: np.ndarray
    information: np.ndarray
    systematic: np.ndarray
    pairs: np.ndarray
    count: int


class ClusterWatch:
    """The distances in Clusters, gathered and told block by block.

    interior (F, 3), rotation (F, 3, 3) and position_mm (F, 3) as in RigOrientation; sizes (F, 2)
    of the images [px]; areas: Areas. Raises ValueError for a bead in two clusters or a cluster
    named twice.
    """

    def __init__(self, clusters, interior, rotation, position_mm, sizes, areas, options):
        self._rig = tuple(np.asarray(x, dtype=float) for x in (interior, rotation, position_mm))
        self._sizes = np.asarray(sizes, dtype=float)
        self._areas = areas
        self._options = options
        self.names = tuple(cluster.name for cluster in clusters)
        self.ids = np.array([i for cluster in clusters for i in cluster.target_id])
        if len(set(self.names)) < len(clusters) or len(set(self.ids)) < len(self.ids):
            raise ValueError('every cluster has a name of its own, and a bead is in one cluster')
        self._order = np.argsort(self.ids)
        self._fewest = max(
            4, int(options.learn_s / CHUNK_S / 4)
        )  # chunks of which a distance is learned
        one = []
        other = []
        of = []
        known = []
        sd = []
        first = 0
        for number, cluster in enumerate(clusters):
            i, j = np.triu_indices(len(cluster.target_id), 1)
            one = one + [first + i]
            other = other + [first + j]
            of = of + [np.full(len(i), number)]
            given = cluster.distances_mm is not None
            known.append(cluster.distances_mm[i, j] if given else np.full(len(i), np.nan))
            sd.append(np.full(len(i), cluster.sd_mm))
            first += len(cluster.target_id)
        self._one, self._other, self._of, self._declared, self._declared_sd = map(
            np.concatenate, (one, other, of, known, sd)
        )
        member = areas.member
        self._inside = (member[:, :, None] * (1 - member[:, None, :])).reshape(len(member), -1)
        self._outside = ((1 - member[:, :, None]) * member[:, None, :]).reshape(len(member), -1)
        self.clear()

    def clear(self):
        """Forget the distances that were learned, and what is gathered."""
        self.distances, self._distance_sd = self._declared.copy(), self._declared_sd.copy()
        self._frames = []
        self._learning = []

    def add(self, stamp, target_id, xyz_mm, covariance, uv, systematic):
        """Gather a frame: stamp [s], target_id (n,), xyz_mm (n, 3), covariance (n, 3, 3) of its
        noise [mm^2], uv (F, n, 2) [px], systematic (F, n): systematic standard deviation of an
        image point [px].
        """
        if not len(target_id):
            return
        row = self._order[
            np.minimum(np.searchsorted(self.ids, target_id, sorter=self._order), len(self.ids) - 1)
        ]
        at = np.flatnonzero(self.ids[row] == target_id)
        values = np.concatenate(
            [
                xyz_mm[at],
                covariance[at].reshape(len(at), 9),
                uv[:, at].transpose(1, 0, 2).reshape(len(at), 2 * len(uv)),
                systematic[:, at].T,
            ],
            axis=1,
        )
        whole = np.isfinite(values).all(
            axis=1
        )  # a bead with a part of it only would have a wrong mean place
        frame = np.full((len(self.ids), values.shape[1]), np.nan)
        frame[row[at[whole]]] = values[whole]
        self._frames.append((stamp, frame))

    def block(self):
        """ClusterBlock of the frames since the last one, None without any; distances that are
        learned give nothing.
        """
        if not self._frames:
            return None
        stamps = np.array([stamp for stamp, _ in self._frames])
        frames = np.stack([frame for _, frame in self._frames])
        self._frames = []
        chunk = ((stamps - stamps.min()) / CHUNK_S).astype(int)
        order = np.argsort(chunk, kind='stable')
        return self._told(
            *self._rows(frames[order], np.flatnonzero(np.diff(chunk[order], prepend=-1)))
        )

    def learn(self):
        """Distances that were not declared are set to the medians of those seen, once each has
        been seen for a while.

        After the start; a cluster that comes later has a start of its own.
        """
        if not self._learning:
            return
        seen = np.concatenate(self._learning)  # rows of pair, distance, variance, frames
        pair = seen[:, 0].astype(int)
        for number in np.flatnonzero(
            np.bincount(pair, minlength=len(self.distances)) >= self._fewest
        ):
            own = seen[pair == number]
            self.distances[number] = np.median(own[:, 1])
            # The median has pi/2 the variance of the mean; chunks may be dependent, so their own
            # scatter counts.
            scatter = max(np.var(own[:, 1], ddof=1), np.mean(own[:, 2] / own[:, 3]))
            self._distance_sd[number] = np.sqrt(np.pi / 2 * scatter / len(own))
        left = np.isnan(self.distances[pair])
        self._learning = [seen[left]] if left.any() else []

    def _rows(self, frames, starts):
        """Rows of the pairs seen in the chunks of frames (T, B, k) that begin at starts (C,).

        Pair, residual of the mean distance, its variance, systematic sd, frames, responses (rows,
        2, F, 2) of both beads [mm/px], cells (rows, 2, F) of both.
        """

        def total(values):
            return np.add.reduceat(values, starts, axis=0)

        with np.errstate(divide='ignore', invalid='ignore'):
            seen = np.isfinite(frames[:, :, :1])
            mean = total(np.where(seen, frames, 0)) / total(
                seen
            )  # (C, B, k), NaN where a bead is not seen
            line = frames[:, self._one, :3] - frames[:, self._other, :3]
            length = np.sqrt(np.sum(line * line, axis=2))
            seen = np.isfinite(length)
            number = total(seen.astype(int))
            chunk, pair = np.nonzero(number)
            number = number[chunk, pair]
            e = (
                total(np.where(seen[:, :, None], line / length[:, :, None], 0))[chunk, pair]
                / number[:, None]
            )
        beads = chunk[:, None], np.stack([self._one, self._other], axis=1)[pair]
        ends = mean[beads]  # (rows, 2, k)
        spread = (ends[:, 0, 3:12] + ends[:, 1, 3:12]).reshape(-1, 3, 3)
        variance = np.sum((e[:, None, :] @ spread)[:, 0] * e, axis=1)
        f = len(self._sizes)
        moved = self._movement(mean[:, :, :3].reshape(-1, 3)).reshape(*mean.shape[:2], -1, 3)[
            beads
        ]
        response = moved.reshape(len(pair), 4 * f, 3) @ e[:, :, None]
        response = response.reshape(-1, 2, f, BETWEEN) * np.array([1.0, -1.0])[:, None, None]
        own = np.sqrt(
            np.sum((response * ends[:, :, 12 + 2 * f :, None]) ** 2, axis=(1, 2, 3))
            + self._distance_sd[pair] ** 2
        )
        limit = np.zeros((len(starts), len(self._of)))
        limit[chunk, pair] = (
            self._options.clip * np.sqrt(variance)
            + self._options.band_start * own
            + self._most(response)
        )
        limit = np.repeat(limit, np.diff(starts, append=len(frames)), axis=0)
        off = length - self.distances
        off = np.where(np.isnan(self.distances), length, np.clip(off, -limit, limit))
        residual = total(np.where(seen, off, 0))[chunk, pair] / number
        cells = np.stack(
            [
                self._areas.cell(ends[:, :, 12 + 2 * i : 14 + 2 * i].reshape(-1, 2), size).reshape(
                    -1, 2
                )
                for i, size in enumerate(self._sizes)
            ],
            axis=2,
        )
        return pair, residual, variance, own, number, response, cells

    def _most(self, response):
        """Change (rows,) [mm] of a distance for the smallest drift that is to be found, in the
        worst direction.
        """
        options = self._options
        return (options.tolerance_px + 2 * options.step_px) * np.max(
            np.abs(response), axis=(1, 2, 3), initial=0
        )

    def _movement(self, points):
        """Movement (B, F, 2, 3) [mm/px] of intersected points (B, 3) for shifts of their image
        points along u and v.
        """
        interior, rotation, position = self._rig
        b = len(points)
        f = len(interior)
        a = project_with_jacobian(
            np.tile(rotation, (b, 1, 1)),
            np.tile(position, (b, 1)),
            np.repeat(points, f, axis=0),
            np.tile(interior, (b, 1)),
        )[2].reshape(b, 2 * f, 3)
        good = np.isfinite(a).all(axis=(1, 2))
        out = np.full((b, 2 * f, 3), np.nan)
        out[good] = a[good] @ np.linalg.inv(a[good].transpose(0, 2, 1) @ a[good])
        return out.reshape(b, f, 2, 3)

    def _told(self, pair, residual, variance, systematic, number, response, cells):
        """ClusterBlock of rows of _rows; what has no reference yet is kept to learn it."""
        free = np.isnan(self.distances[pair])
        if free.any():
            self._learning.append(np.column_stack([pair, residual, variance, number])[free])
        use = ~free & np.isfinite(response).all(axis=(1, 2, 3)) & (variance > 0)
        pair, residual, variance, systematic, number, response, cells = (
            x[use] for x in (pair, residual, variance, systematic, number, response, cells)
        )
        weight = (number / variance)[:, None, None, None] * response
        values = np.stack(
            [
                weight * residual[:, None, None, None],
                weight * response,
                np.abs(weight) * systematic[:, None, None, None],
                np.ones_like(weight),
            ]
        )
        c = len(self.names)
        (_, f) = self._sizes.T.shape
        n2 = self._areas.n**2
        series = (self._of[pair][:, None] * f + np.arange(f))[:, :, None] * BETWEEN + np.arange(
            BETWEEN
        )
        index = series * n2 * n2 + (cells[:, 0] * n2 + cells[:, 1])[:, :, None]
        total = c * f * BETWEEN * n2 * n2
        told = 0
        for bead, mask in ((0, self._inside), (1, self._outside)):
            sums = np.stack(
                [np.bincount(index.ravel(), v[:, bead].ravel(), total) for v in values]
            )
            told = told + sums.reshape(4, c, BETWEEN * f, n2 * n2) @ mask.T
        with np.errstate(divide='ignore', invalid='ignore'):
            return ClusterBlock(
                told[0], told[1], told[2] / told[1], told[3].sum(axis=0), int(number.sum())
            )
