# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Poses of earlier exposures by markers whose points were taken back."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable, Collection
from dataclasses import dataclass, field, replace

import numpy as np

from ..bodies.body import BodyPoses, PoseStatus
from ..bodies.tracking import unknown_motion
from .messages.bodies import BodiesContent
from .runtime.lifecycle import remember

REMEMBERED = 1000  # exposures, and those that are still to come


@dataclass
class _Published:
    """Bodies of an exposure, and which of them were taken back."""

    content: BodiesContent
    taken: set[str] = field(default_factory=set)


class BodyRetractions:
    """Takes back poses, and the motion of joints between them.

    publish: called with what replaces a part of an exposure: the bodies and joints whose motion is
    not known any more.
    """

    def __init__(self, publish: Callable[[BodiesContent], None]) -> None:
        self._publish = publish
        # By stamp of the exposure [ns].
        self._published: OrderedDict[int, _Published] = OrderedDict()
        self._early: OrderedDict[int, set[int]] = OrderedDict()
        self._lock = threading.Lock()  # exposures and retractions come in two threads
        self.count = 0  #: poses that were taken back

    def note(self, content: BodiesContent) -> None:
        """Remember an exposure that was published."""
        with self._lock:
            remember(self._published, content.stamp_ns, _Published(content), REMEMBERED)
            wrong = self._early.pop(content.stamp_ns, None)
            if wrong:
                self._take_back(self._published[content.stamp_ns], wrong)

    def take_back(self, stamp_ns: int, target_id: Collection[int]) -> None:
        """Take back the poses of an exposure by some markers; it may still be to come."""
        with self._lock:
            published = self._published.get(stamp_ns)
            if published is not None:
                self._take_back(published, target_id)
            else:
                wrong = self._early.get(stamp_ns, set()) | set(target_id)
                remember(self._early, stamp_ns, wrong, REMEMBERED)

    def _take_back(self, published: _Published, target_id: Collection[int]) -> None:
        content = published.content
        wrong = np.array(list(target_id))
        rows = [
            row
            for row, (poses, used) in enumerate(zip(content.poses, content.used))
            if poses.body not in published.taken and np.isin(used, wrong).any()
        ]
        if not rows:
            return
        bodies = {content.poses[row].body for row in rows}
        published.taken |= bodies
        self.count += len(rows)
        self._publish(
            content._replace(
                bodies=[content.bodies[row] for row in rows],
                poses=[_unknown_pose(content.poses[row]) for row in rows],
                used=[content.used[row][:0] for row in rows],
                joints=[
                    unknown_motion(one)
                    for one in content.joints
                    if not bodies.isdisjoint((one.joint.proximal, one.joint.distal))
                ],
            )
        )


def _unknown_pose(poses: BodyPoses) -> BodyPoses:
    """The same exposures without poses."""
    return replace(
        poses,
        rotation=np.full_like(poses.rotation, np.nan),
        position_mm=np.full_like(poses.position_mm, np.nan),
        covariance_noise=np.full_like(poses.covariance_noise, np.nan),
        covariance_fixed=np.full_like(poses.covariance_fixed, np.nan),
        rig_root=np.full_like(poses.rig_root, np.nan),
        markers=np.zeros_like(poses.markers),
        status=np.full_like(poses.status, PoseStatus.FAILED),
    )
