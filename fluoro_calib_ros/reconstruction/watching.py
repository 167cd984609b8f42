"""What the drift watch is given of every exposure: epipolar residuals of all pairs of views, and points in space.

The noise of an image point and the error of its correction are told apart: the one is another in every frame, the
other the same every time at a place, and does not average out.
"""

from collections import Counter
from itertools import combinations

import numpy as np

from .clusters import Cluster
from .drift import DriftOptions, DriftWatch
from .epipolar import EpipolarGeometry
from .intersection import OK


# Beyond both together a residual is one of a false match; up to there it may be that of a drift, rejected or not.
FALSE_SD, FALSE_PX = 4.0, 3.0


class RigWatch:
    """A DriftWatch for a RigOrientation, built anew with every orientation.

    image_sizes {fluoroscope: (width, height)} [px]; options: DriftOptions; clusters: Cluster, ...; rate_hz: most
    exposures a second that are looked at. Raises ValueError as DriftWatch, DataError for a rig of sources in one place.
    """

    def __init__(self, orientation, image_sizes, options=DriftOptions(), clusters=(), rate_hz=120.0):
        names = self._names = orientation.fluoroscopes
        self._pairs = [(i, j, EpipolarGeometry(orientation, names[i], names[j]))
                       for i, j in combinations(range(len(names)), 2)]
        self._watch = DriftWatch({name: image_sizes[name] for name in names}, options, clusters,
                                 (orientation.interior, orientation.rotation, orientation.position_mm))
        # Exposures come with some jitter: at the rate itself none is to be left out.
        self._every_ns, self._last = round(0.9e9 / rate_hz), None
        self.clusters = bool(clusters)

    @property
    def state(self):
        """The DriftState."""
        return self._watch.state

    def wants(self, stamp_ns):
        """Whether an exposure is to be looked at."""
        return self._last is None or not 0 <= stamp_ns - self._last < self._every_ns

    def take(self, stamp_ns, target_id, uv, sigma, correction_sd, points):
        """Take in an exposure; returns the DriftState.

        target_id (n,); uv (F, n, 2), sigma and correction_sd (F, n) [px], NaN where a fluoroscope does not see a
        target; points: the IntersectedPoints of them.
        """
        self._last = stamp_ns
        noise2 = np.maximum(sigma * sigma - correction_sd * correction_sd, 0)
        names = self._names
        for i, j, geometry in self._pairs:
            found = geometry.residuals(uv[i], uv[j], sigma[i], sigma[j])
            noise = found.factor_a ** 2 * noise2[i] + found.factor_b ** 2 * noise2[j]
            good = np.flatnonzero(np.abs(found.residual) <= FALSE_SD * found.sd_total + FALSE_PX)
            self._watch.add(stamp_ns, names[i], names[j], target_id[good], uv[i][good], uv[j][good],
                            found.residual[good], np.sqrt(noise[good]),
                            np.sqrt(np.maximum(found.sd_total ** 2 - noise, 0))[good], found.normal_a[good],
                            found.normal_b[good], found.factor_a[good], found.factor_b[good])
        if self.clusters:
            part = np.nanmean(noise2 / (sigma * sigma), axis=0)   # of the covariance that is noise
            good = np.flatnonzero(points.status == OK)
            self._watch.add_points(stamp_ns, target_id[good], points.xyz_mm[good],
                                   (points.covariance_noise * part[:, None, None])[good], uv[:, good],
                                   correction_sd[:, good])
        return self.state


def clusters_of(texts):
    """Clusters of texts such as 'tibia: 1001 1002 1003'. Raises ValueError for a text that is none."""
    out = []
    for text in texts:
        name, colon, ids = text.partition(':')
        try:
            numbers = tuple(int(i) for i in ids.replace(',', ' ').split())
        except ValueError:
            numbers = ()
        if not colon or not name.strip() or not numbers:
            raise ValueError(f"{text!r} does not declare a cluster, as 'tibia: 1001 1002 1003' does")
        out.append(Cluster(name.strip(), numbers))
    if len({cluster.name for cluster in out}) < len(out):
        raise ValueError('two clusters have the same name')
    targets = Counter(i for cluster in out for i in cluster.target_id)
    twice = [i for i, count in targets.items() if count > 1]
    if twice:
        raise ValueError(f'target {twice[0]} is in two clusters')
    return tuple(out)
