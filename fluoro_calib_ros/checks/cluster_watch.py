# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What the distances in rigid clusters tell of a drift that epipolar residuals cannot see.

A shift along an epipolar line moves the intersected point in depth, and all rays still meet. If
one of two beads of a rigid cluster is in the area that has drifted and the other is not, their
distance d = norm(P_i - P_j) changes: by e^T dP_i for a shift of bead i and by -e^T dP_j for a
shift of bead j, where e is the direction from j to i and dP the movement of an intersected point
for a pixel in an image. So every distance is a measurement of the drift of an area [px], with a
response, as every epipolar residual is. Where both beads shift alike nothing changes: a drift of
the whole image along the epipolar lines moves and turns a cluster without deforming it.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from ..photogrammetry.collinearity import project_with_jacobian
from ..photogrammetry.rig_orientation import RigOrientation
from .charts import ImageAreas
from .drift_observations import PointObservations
from .drift_options import DriftOptions

# Rigid clusters of beads, whose distances must not change.


@dataclass(frozen=True)
class Cluster:
    """A rigid cluster of beads.

    Attributes
    ----------
    name : str
    target_id : tuple of int
        Beads, two or more, each once.
    distances_mm : ndarray or None
        (n, n), distances between the beads; None: they are learned at the start of a stream.
    sd_mm : float
        Standard deviation of each of these distances.

    Raises
    ------
    ValueError
        For beads or distances that do not make a cluster.
    """

    name: str
    target_id: tuple[int, ...]
    distances_mm: NDArray[np.float64] | None = None
    sd_mm: float = 0.0

    def __post_init__(self) -> None:
        ids = tuple(int(i) for i in self.target_id)
        object.__setattr__(self, 'target_id', ids)
        if len(ids) < 2 or len(set(ids)) < len(ids):
            raise ValueError(
                f'cluster {self.name}: needs two beads or more, each named once, not {ids}'
            )
        if not (np.isfinite(self.sd_mm) and self.sd_mm >= 0):
            raise ValueError(f'cluster {self.name}: sd_mm must be 0 or more, not {self.sd_mm}')
        if self.distances_mm is not None:
            distances = np.array(self.distances_mm, dtype=float)
            self._check_distances(distances)
            distances.setflags(write=False)
            object.__setattr__(self, 'distances_mm', distances)

    def _check_distances(self, distances: np.ndarray) -> None:
        """Raise ValueError unless this is a matrix of distances of the beads."""
        n = len(self.target_id)
        if (
            distances.shape != (n, n)
            or not np.isfinite(distances).all()
            or not np.allclose(distances, distances.T)
        ):
            raise ValueError(
                f'cluster {self.name}: distances_mm must be a symmetric matrix of {n} x {n}'
            )
        if not (distances[np.triu_indices(n, 1)] > 0).all():
            raise ValueError(f'cluster {self.name}: all distances must be above 0 mm')


def parse_clusters(texts: Iterable[str]) -> tuple[Cluster, ...]:
    """Clusters from texts such as 'tibia: 1001 1002 1003'.

    Raises ValueError for a text of another form, for a name that occurs twice and for a target
    in two clusters.
    """
    clusters = tuple(_parse_cluster(text) for text in texts)
    if len({cluster.name for cluster in clusters}) < len(clusters):
        raise ValueError('two clusters have the same name')
    counts = Counter(i for cluster in clusters for i in cluster.target_id)
    repeated = [i for i, count in counts.items() if count > 1]
    if repeated:
        raise ValueError(f'target {repeated[0]} is in two clusters')
    return clusters


def _parse_cluster(text: str) -> Cluster:
    name, colon, ids = text.partition(':')
    try:
        target_id = tuple(int(i) for i in ids.replace(',', ' ').split())
    except ValueError:
        target_id = ()
    if not colon or not name.strip() or not target_id:
        raise ValueError(f"{text!r} does not declare a cluster, as 'tibia: 1001 1002 1003' does")
    return Cluster(name.strip(), target_id)


# A cluster is taken to stand still for this time when its responses are calculated. The distances
# themselves are of every frame.
CHUNK_S = 0.05
COMPONENTS = 2  # of a shift in an image, u and v
# Columns of the values of a bead in a frame: coordinates, covariance, then uv and systematic
# standard deviation of every view.
_XYZ = slice(0, 3)
_COVARIANCE = slice(3, 12)
_UV = 12


@dataclass(frozen=True)
class ClusterBlock:
    """Statistics of the distances of a block.

    The 2F series are the drifts along u and v of the F fluoroscopes.

    Attributes
    ----------
    score, information : ndarray
        (C, 2F, A), of a drift of each area, by cluster [1/px, 1/px^2].
    systematic : ndarray
        (C, 2F, A), systematic standard deviations [px].
    pairs : ndarray
        (2F, A), number of distances between a bead in the area and one outside.
    count : int
        Number of distances.
    """

    score: NDArray[np.float64]
    information: NDArray[np.float64]
    systematic: NDArray[np.float64]
    pairs: NDArray[np.int64]
    count: int


@dataclass(frozen=True)
class _Pairs:
    """Pairs of beads of all clusters: both beads, cluster, declared distance and its sd."""

    first: np.ndarray
    second: np.ndarray
    cluster: np.ndarray
    declared: np.ndarray
    declared_sd: np.ndarray

    @classmethod
    def of(cls, clusters: Sequence[Cluster]) -> _Pairs:
        """Pairs of all clusters; the beads are numbered in their order."""
        columns = []
        start = 0
        for number, cluster in enumerate(clusters):
            beads = len(cluster.target_id)
            i, j = np.triu_indices(beads, 1)
            if cluster.distances_mm is None:
                declared = np.full(len(i), np.nan)
            else:
                declared = cluster.distances_mm[i, j]
            sd = np.full(len(i), cluster.sd_mm)
            columns.append((start + i, start + j, np.full(len(i), number), declared, sd))
            start += beads
        return cls(*map(np.concatenate, zip(*columns)))


@dataclass(frozen=True)
class _Distances:
    """Mean distances of pairs of beads in chunks of a block, a row each.

    pair: number of the pair; residual against its reference, or the distance itself while there is
    none [mm]; variance of a single frame [mm^2]; systematic sd [mm]; frames: number of them;
    response (rows, 2, F, 2) by shifts of both beads along u and v of each view [mm/px]; cell
    (rows, 2, F) of both beads.
    """

    pair: np.ndarray
    residual: np.ndarray
    variance: np.ndarray
    systematic: np.ndarray
    frames: np.ndarray
    response: np.ndarray
    cell: np.ndarray

    def select(self, rows: np.ndarray) -> _Distances:
        return _Distances(*(getattr(self, field.name)[rows] for field in fields(self)))


class ClusterWatch:
    """Turns the distances in rigid clusters into statistics, block by block.

    Parameters
    ----------
    clusters : sequence of Cluster
    orientation : RigOrientation
    sizes : sequence
        (F, 2), width and height of the images [px].
    areas : ImageAreas
    options : DriftOptions

    Raises
    ------
    ValueError
        For a bead in two clusters, and for two clusters of the same name.
    """

    def __init__(
        self,
        clusters: Sequence[Cluster],
        orientation: RigOrientation,
        sizes: Sequence[Sequence[int]],
        areas: ImageAreas,
        options: DriftOptions,
    ) -> None:
        self._orientation = orientation
        self._sizes = np.asarray(sizes, dtype=float)
        self._views = len(self._sizes)
        self._areas = areas
        self._options = options
        self.names = tuple(cluster.name for cluster in clusters)
        self._ids = np.array([i for cluster in clusters for i in cluster.target_id])
        if len(set(self.names)) < len(clusters):
            raise ValueError('two clusters have the same name')
        if len(set(self._ids)) < len(self._ids):
            raise ValueError('a bead is in two clusters')
        self._order = np.argsort(self._ids)
        self._min_chunks = max(4, int(options.learn_s / CHUNK_S / 4))  # to learn a distance
        self._pairs = _Pairs.of(clusters)
        member = areas.member
        # (A, cells * cells), 1 where the first bead is in the area and the second one is not, and
        # the other way round.
        first = member[:, :, None] * (1 - member[:, None, :])
        second = (1 - member[:, :, None]) * member[:, None, :]
        self._separated = first.reshape(len(member), -1), second.reshape(len(member), -1)
        self.clear()

    def clear(self) -> None:
        """Forget the learned distances and all observations."""
        self.distances = self._pairs.declared.copy()
        self._distance_sd = self._pairs.declared_sd.copy()
        self._frames: list[tuple[float, np.ndarray]] = []
        self._learning: list[np.ndarray] = []

    def add(self, stamp_s: float, points: PointObservations) -> None:
        """Add the points of one exposure at stamp_s [s]."""
        n = len(points.target_id)
        if not n:
            return
        row = np.searchsorted(self._ids, points.target_id, sorter=self._order)
        row = self._order[np.minimum(row, len(self._ids) - 1)]
        known = np.flatnonzero(self._ids[row] == points.target_id)
        values = np.concatenate(
            [
                points.xyz_mm,
                points.covariance.reshape(n, 9),
                points.uv.transpose(1, 0, 2).reshape(n, 2 * self._views),
                points.sd_systematic.T,
            ],
            axis=1,
        )[known]
        # A bead with only some of its values would have a wrong mean position.
        complete = np.isfinite(values).all(axis=1)
        frame = np.full((len(self._ids), values.shape[1]), np.nan)
        frame[row[known[complete]]] = values[complete]
        self._frames.append((stamp_s, frame))

    def block(self) -> ClusterBlock | None:
        """Statistics of the frames since the last call, None without any.

        Distances that are still being learned contribute nothing.
        """
        if not self._frames:
            return None
        stamps = np.array([stamp for stamp, _ in self._frames])
        frames = np.stack([frame for _, frame in self._frames])
        self._frames = []
        chunk = ((stamps - stamps.min()) / CHUNK_S).astype(int)
        order = np.argsort(chunk, kind='stable')
        starts = np.flatnonzero(np.diff(chunk[order], prepend=-1))
        return self._statistics(self._mean_distances(frames[order], starts))

    def learn(self) -> None:
        """Set each distance that was not declared to its median, once it has been seen enough.

        To be called after the start of the stream. A cluster that appears later is learned then.
        """
        if not self._learning:
            return
        seen = np.concatenate(self._learning)  # rows of pair, distance, variance, frames
        pair = seen[:, 0].astype(int)
        counts = np.bincount(pair, minlength=len(self.distances))
        for number in np.flatnonzero(counts >= self._min_chunks):
            own = seen[pair == number]
            self.distances[number] = np.median(own[:, 1])
            # The median has pi/2 times the variance of the mean. Chunks may be dependent, so the
            # larger of their predicted and their actual scatter counts.
            scatter = max(np.var(own[:, 1], ddof=1), np.mean(own[:, 2] / own[:, 3]))
            self._distance_sd[number] = np.sqrt(np.pi / 2 * scatter / len(own))
        left = np.isnan(self.distances[pair])
        self._learning = [seen[left]] if left.any() else []

    def _mean_distances(self, frames: np.ndarray, starts: np.ndarray) -> _Distances:
        """Mean distances in the chunks of frames (T, B, columns) that begin at starts (C,)."""
        bead_mean = _chunk_means(frames, starts)
        line = frames[:, self._pairs.first, _XYZ] - frames[:, self._pairs.second, _XYZ]
        length = np.sqrt(np.sum(line * line, axis=2))
        seen = np.isfinite(length)
        count = np.add.reduceat(seen.astype(int), starts, axis=0)
        chunk, pair = np.nonzero(count)
        count = count[chunk, pair]
        with np.errstate(divide='ignore', invalid='ignore'):
            unit = np.where(seen[:, :, None], line / length[:, :, None], 0)
        e = np.add.reduceat(unit, starts, axis=0)[chunk, pair] / count[:, None]
        beads = chunk[:, None], np.stack([self._pairs.first, self._pairs.second], axis=1)[pair]
        ends = bead_mean[beads]  # (rows, 2, columns)
        covariance = (ends[:, 0, _COVARIANCE] + ends[:, 1, _COVARIANCE]).reshape(-1, 3, 3)
        variance = np.sum((e[:, None, :] @ covariance)[:, 0] * e, axis=1)
        response = self._response(bead_mean, beads, e)
        view_sd = ends[:, :, _UV + 2 * self._views :, None]
        systematic = np.sqrt(
            np.sum((response * view_sd) ** 2, axis=(1, 2, 3)) + self._distance_sd[pair] ** 2
        )
        limit = np.zeros((len(starts), len(self._pairs.cluster)))
        limit[chunk, pair] = (
            self._options.clip * np.sqrt(variance)
            + self._options.band_start * systematic
            + self._drift_limit(response)
        )
        limit = np.repeat(limit, np.diff(starts, append=len(frames)), axis=0)
        residual = np.clip(length - self.distances, -limit, limit)
        residual = np.where(np.isnan(self.distances), length, residual)
        residual = np.add.reduceat(np.where(seen, residual, 0), starts, axis=0)[chunk, pair]
        return _Distances(
            pair,
            residual / count,
            variance=variance,
            systematic=systematic,
            frames=count,
            response=response,
            cell=self._cells(ends),
        )

    def _response(
        self, bead_mean: np.ndarray, beads: tuple[np.ndarray, ...], e: np.ndarray
    ) -> np.ndarray:
        """Change (rows, 2, F, 2) of the distances by a shift of either bead [mm/px].

        bead_mean (C, B, columns); beads: its indices (rows, 2); e (rows, 3): unit vectors from the
        second bead to the first.
        """
        chunks, count = bead_mean.shape[:2]
        movement = self._point_movement(bead_mean[:, :, _XYZ].reshape(-1, 3))
        moved = movement.reshape(chunks, count, -1, 3)[beads]
        response = moved.reshape(len(e), 2 * COMPONENTS * self._views, 3) @ e[:, :, None]
        sign = np.array([1.0, -1.0])[:, None, None]
        return response.reshape(-1, 2, self._views, COMPONENTS) * sign

    def _cells(self, ends: np.ndarray) -> np.ndarray:
        """Cells (rows, 2, F) of the beads at both ends (rows, 2, columns) of a distance."""
        cells = []
        for view, size in enumerate(self._sizes):
            uv = ends[:, :, _UV + 2 * view : _UV + 2 * view + 2].reshape(-1, 2)
            cells.append(self._areas.cell(uv, size).reshape(-1, 2))
        return np.stack(cells, axis=2)

    def _drift_limit(self, response: np.ndarray) -> np.ndarray:
        """Change (rows,) [mm] of a distance by the smallest drift to be found, at worst."""
        options = self._options
        strongest = np.max(np.abs(response), axis=(1, 2, 3), initial=0)
        return (options.tolerance_px + 2 * options.step_px) * strongest

    def _point_movement(self, points: np.ndarray) -> np.ndarray:
        """Movement (B, F, 2, 3) of intersected points (B, 3) by shifts along u and v [mm/px]."""
        rig = self._orientation
        count = len(points)
        views = self._views
        a = project_with_jacobian(
            np.tile(rig.rotation, (count, 1, 1)),
            np.tile(rig.position_mm, (count, 1)),
            np.repeat(points, views, axis=0),
            np.tile(rig.interior, (count, 1)),
        )[2].reshape(count, 2 * views, 3)
        good = np.isfinite(a).all(axis=(1, 2))
        out = np.full((count, 2 * views, 3), np.nan)
        out[good] = a[good] @ np.linalg.inv(a[good].transpose(0, 2, 1) @ a[good])
        return out.reshape(count, views, 2, 3)

    def _statistics(self, distances: _Distances) -> ClusterBlock:
        """Statistics of a block; distances without a reference are kept to learn it."""
        learning = np.isnan(self.distances[distances.pair])
        if learning.any():
            d = distances
            columns = np.column_stack([d.pair, d.residual, d.variance, d.frames])
            self._learning.append(columns[learning])
        finite = np.isfinite(distances.response).all(axis=(1, 2, 3))
        used = distances.select(~learning & finite & (distances.variance > 0))
        weight = (used.frames / used.variance)[:, None, None, None] * used.response
        values = np.stack(
            [
                weight * used.residual[:, None, None, None],
                weight * used.response,
                np.abs(weight) * used.systematic[:, None, None, None],
                np.ones_like(weight),
            ]
        )
        sums = self._area_sums(values, used)
        with np.errstate(divide='ignore', invalid='ignore'):
            systematic = sums[2] / sums[1]
        pairs = sums[3].sum(axis=0)
        return ClusterBlock(sums[0], sums[1], systematic, pairs, int(used.frames.sum()))

    def _area_sums(self, values: np.ndarray, distances: _Distances) -> np.ndarray:
        """Sums (k, C, 2F, A) of values (k, rows, 2, F, 2) where one bead alone is in the area."""
        clusters = len(self.names)
        views = self._views
        cells = self._areas.n**2
        view = self._pairs.cluster[distances.pair][:, None] * views + np.arange(views)
        series = view[:, :, None] * COMPONENTS + np.arange(COMPONENTS)
        cell_pair = distances.cell[:, 0] * cells + distances.cell[:, 1]
        index = series * cells * cells + cell_pair[:, :, None]
        size = clusters * views * COMPONENTS * cells * cells
        total = np.zeros(1)
        for bead, separated in enumerate(self._separated):
            sums = np.stack([np.bincount(index.ravel(), v[:, bead].ravel(), size) for v in values])
            sums = sums.reshape(len(values), clusters, COMPONENTS * views, cells * cells)
            total = total + sums @ separated.T
        return total


def _chunk_means(frames: np.ndarray, starts: np.ndarray) -> np.ndarray:
    """Means (C, B, columns) of the beads in chunks of frames (T, B, columns), NaN where unseen."""
    seen = np.isfinite(frames[:, :, :1])
    with np.errstate(divide='ignore', invalid='ignore'):
        return np.add.reduceat(np.where(seen, frames, 0), starts, axis=0) / np.add.reduceat(
            seen, starts, axis=0
        )
