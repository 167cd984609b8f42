# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Rigid clusters of beads, whose distances must not change."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np


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
    distances_mm: np.ndarray | None = None
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
