# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Reconstructed points, published in all their forms, and counted."""

from __future__ import annotations

import time
from collections import Counter

import numpy as np
from fluoro_calib_msgs.msg import ReconstructedPoints
from sensor_msgs.msg import PointCloud2
from visualization_msgs.msg import MarkerArray

from ..reconstruction.intersection import FAILED, OUTSIDE, REJECTED, SINGLE_VIEW, IntersectedPoints
from .messages.points import (
    MOCAP_MARKERS,
    PointsContent,
    ellipsoid_markers,
    encode_reconstructed_points,
    message_from_points,
    mocap_markers,
    point_cloud,
)
from .runtime.lifecycle import StreamNode
from .runtime.streams import observations_qos

COUNTED_STATUSES = {
    'outside': OUTSIDE,
    'rejected': REJECTED,
    'failed': FAILED,
    'in a single view': SINGLE_VIEW,
}
FORMS = ('points', 'markers', 'mocap_markers')  # beside the points with covariance


class PointsCounter:
    """Counts points by status."""

    def __init__(self) -> None:
        self._counts: Counter[str] = Counter()

    def add(self, points: IntersectedPoints) -> None:
        """Count points."""
        self._counts['points'] += len(points.status)
        if points.status.any():
            for name, status in COUNTED_STATUSES.items():
                self._counts[name] += int(np.count_nonzero(points.status == status))

    def values(self) -> dict[str, object]:
        """Return the counts for the diagnostics."""
        return {
            'points': self._counts['points'],
            **{f'points {name}': self._counts[name] for name in COUNTED_STATUSES},
        }


class PointsOutput:
    """Publishers of reconstructed points."""

    def __init__(self, node: StreamNode) -> None:
        kinds = {
            'points_with_covariance': ReconstructedPoints,
            'points': PointCloud2,
            'markers': MarkerArray,
        }
        if MOCAP_MARKERS is not None:
            kinds['mocap_markers'] = MOCAP_MARKERS
        self._outputs = {
            name: node.create_output(kind, f'reconstruction/{name}', observations_qos())
            for name, kind in kinds.items()
        }
        self._markers_published_ns = 0

    def publish(self, content: PointsContent) -> None:
        """Publish points with their covariance."""
        self._outputs['points_with_covariance'].publish(encode_reconstructed_points(content))

    def publish_forms(self, content: PointsContent, sigmas: float, rate_hz: float) -> None:
        """Publish the other forms that have subscribers: ellipsoids of so many sigmas."""
        wanted = [
            name
            for name in FORMS
            if name in self._outputs and self._outputs[name].get_subscription_count()
        ]
        if not wanted:
            return
        message = message_from_points(content)
        good = np.flatnonzero(content.points.status <= OUTSIDE)
        if 'points' in wanted:
            self._outputs['points'].publish(point_cloud(message, good))
        if 'mocap_markers' in wanted:
            self._outputs['mocap_markers'].publish(mocap_markers(message, good))
        now = time.monotonic_ns()
        if 'markers' in wanted and now - self._markers_published_ns >= round(1e9 / rate_hz):
            self._markers_published_ns = now
            self._outputs['markers'].publish(ellipsoid_markers(message, good, sigmas))
