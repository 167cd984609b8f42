# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Retraction of points and poses of earlier exposures whose image points were withdrawn."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
from fluoro_calib_msgs.msg import Retraction

from ..bodies.body import BodyPoses, PoseStatus
from ..bodies.tracking import unknown_motion
from ..exposures.stamps import nanoseconds_from_stamp
from .messages.bodies import BodiesContent
from .messages.observations import stamp_from_nanoseconds, uint32_field
from .messages.points import PointsContent
from .runtime.diagnostics import RefusalLog
from .runtime.lifecycle import StreamNode
from .runtime.streams import remember
from .runtime.topics import observations_qos

TOPIC = 'retractions'
MAX_IDS = 10_000  # maximum number of ids in a retraction that is stored


@dataclass
class _Published:
    """Bodies of an exposure, and the names of those whose poses were retracted."""

    content: BodiesContent
    retracted: set[str] = field(default_factory=set)


class BodyRetractions:
    """Retracts poses of bodies and the motion of the joints between them.

    publish: called with the replacement for a part of an exposure: the bodies and joints whose
    motion is no longer known.
    """

    def __init__(self, publish: Callable[[BodiesContent], None]) -> None:
        self._publish = publish
        # By stamp of the exposure [ns]; _early: marker ids retracted before the exposure is noted.
        self._published: OrderedDict[int, _Published] = OrderedDict()
        self._early: OrderedDict[int, set[int]] = OrderedDict()
        self._lock = threading.Lock()  # exposures and retractions come from different threads
        self.count = 0  #: number of retracted poses

    def note(self, content: BodiesContent) -> None:
        """Store a published exposure."""
        with self._lock:
            remember(self._published, content.stamp_ns, _Published(content))
            retracted_ids = self._early.pop(content.stamp_ns, None)
            if retracted_ids:
                self._take_back(self._published[content.stamp_ns], retracted_ids)

    def take_back(self, stamp_ns: int, target_id: Collection[int]) -> None:
        """Retract the poses of an exposure, possibly a future one, that use some markers."""
        with self._lock:
            published = self._published.get(stamp_ns)
            if published is not None:
                self._take_back(published, target_id)
            else:
                retracted_ids = self._early.get(stamp_ns, set()) | set(target_id)
                remember(self._early, stamp_ns, retracted_ids)

    def _take_back(self, published: _Published, target_id: Collection[int]) -> None:
        content = published.content
        retracted_ids = np.array(list(target_id))
        rows = [
            row
            for row, (poses, used) in enumerate(zip(content.poses, content.used))
            if poses.body not in published.retracted and np.isin(used, retracted_ids).any()
        ]
        if not rows:
            return
        bodies = {content.poses[row].body for row in rows}
        published.retracted |= bodies
        self.count += len(rows)
        self._publish(
            content._replace(
                bodies=[content.bodies[row] for row in rows],
                poses=[_unknown_pose(content.poses[row]) for row in rows],
                used=[content.used[row][:0] for row in rows],
                joints=[
                    unknown_motion(motion)
                    for motion in content.joints
                    if not bodies.isdisjoint((motion.joint.proximal, motion.joint.distal))
                ],
            )
        )


def _unknown_pose(poses: BodyPoses) -> BodyPoses:
    """Return the same exposures with unknown poses."""
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


class PointRetractions:
    """Retracts the points of exposures that rely on withdrawn image points."""

    def __init__(self, node: StreamNode) -> None:
        self._node = node
        self._output = node.create_output(
            Retraction, f'reconstruction/{TOPIC}', observations_qos()
        )
        # By fluoroscope and stamp of a view [ns].
        self._exposures: OrderedDict[tuple[str, int], PointsContent] = OrderedDict()
        self._early: OrderedDict[tuple[str, int], Retraction] = OrderedDict()
        self._lock = threading.Lock()  # views and retractions come from different threads
        self.bodies = BodyRetractions(_nowhere)  #: retracts poses determined from these points
        self._count = 0  # retracted points

    def listen(self, name: str, refusals: RefusalLog) -> None:
        """Subscribe to the retractions of a fluoroscope."""
        on_retraction = partial(self.on_retraction, name)
        topic = f'{name}/{TOPIC}'
        self._node.create_input(Retraction, topic, on_retraction, observations_qos(), refusals)

    def note(self, stamps_ns: Mapping[str, int], content: PointsContent) -> None:
        """Store a reconstructed exposure by the stamps of its views."""
        with self._lock:
            for key in stamps_ns.items():
                remember(self._exposures, key, content)
                if key in self._early:
                    self._publish(content, self._early.pop(key))

    def on_retraction(self, name: str, message: Retraction) -> None:
        """Retract points of an exposure, or store the retraction until the exposure arrives."""
        key = name, nanoseconds_from_stamp(message.header.stamp)
        with self._lock:
            if key in self._exposures:
                self._publish(self._exposures[key], message)
            elif len(message.target_id) <= MAX_IDS:
                remember(self._early, key, message)

    def _publish(self, content: PointsContent, message: Retraction) -> None:
        retracted_ids = np.intersect1d(content.target_id, message.target_id)
        if not len(retracted_ids):
            return
        out = Retraction(frame_number=content.frame_number, target_id=uint32_field(retracted_ids))
        out.header.stamp = stamp_from_nanoseconds(content.stamp_ns)
        out.header.frame_id = content.orientation.frame_id
        self._output.publish(out)
        self._count += len(retracted_ids)
        self.bodies.take_back(content.stamp_ns, retracted_ids.tolist())

    def values(self) -> dict[str, int]:
        """Return the counts for the diagnostics."""
        return {'points retracted': self._count, 'poses retracted': self.bodies.count}


def _nowhere(content: BodiesContent) -> None:
    """Do not publish bodies."""
