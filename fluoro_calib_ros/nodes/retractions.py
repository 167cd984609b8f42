# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Retraction of points and poses of earlier exposures whose image points were withdrawn."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Generic, TypeVar

import numpy as np
from fluoro_calib_msgs.msg import Retraction
from numpy.typing import ArrayLike, NDArray

from ..bodies.body import BodyPoses, PoseStatus
from ..bodies.tracking import unknown_motion
from ..exposures.stamps import nanoseconds_from_stamp
from .messages.bodies import BodiesContent
from .messages.observations import stamp_from_nanoseconds, uint32_field
from .messages.points import PointsContent
from .runtime.diagnostics import RefusalLog
from .runtime.lifecycle import StreamNode
from .runtime.streams import REMEMBERED, remember
from .runtime.topics import observations_qos

TOPIC = 'retractions'
MAX_IDS = 10_000  # maximum number of ids in a retraction that is stored


E = TypeVar('E')
K = TypeVar('K', bound=Hashable)


class PublishedExposures(Generic[K, E]):
    """Keeps published exposures, and ids that were retracted before their exposure came.

    retract: called with an exposure and the ids to retract from it. keys: number of keys of an
    exposure. Calls may come from several threads: views and retractions do.
    """

    def __init__(self, retract: Callable[[E, ArrayLike], None], keys: int = 1) -> None:
        self._retract = retract
        self._most = REMEMBERED * keys
        self._exposures: OrderedDict[K, E] = OrderedDict()
        self._early: OrderedDict[K, NDArray[np.integer]] = OrderedDict()
        self._lock = threading.Lock()

    def note(self, key: K, exposure: E) -> None:
        """Store a published exposure, and retract from it what was retracted before."""
        with self._lock:
            remember(self._exposures, key, exposure, self._most)
            if key in self._early:
                self._retract(exposure, self._early.pop(key))

    def take_back(self, key: K, target_id: ArrayLike) -> None:
        """Retract ids of an exposure, now or when it comes."""
        with self._lock:
            if key in self._exposures:
                self._retract(self._exposures[key], target_id)
                return
            retracted_ids = np.union1d(self._early.get(key, target_id), target_id)
            if len(retracted_ids) <= MAX_IDS:
                remember(self._early, key, retracted_ids, self._most)


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
        # By stamp of the exposure [ns].
        self._published: PublishedExposures[int, _Published] = PublishedExposures(self._retract)
        self.count = 0  #: number of retracted poses

    def note(self, content: BodiesContent) -> None:
        """Store a published exposure."""
        self._published.note(content.stamp_ns, _Published(content))

    def take_back(self, stamp_ns: int, target_id: ArrayLike) -> None:
        """Retract the poses of an exposure, possibly a future one, that use some markers."""
        self._published.take_back(stamp_ns, target_id)

    def _retract(self, published: _Published, target_id: ArrayLike) -> None:
        content = published.content
        rows = [
            row
            for row, (poses, used) in enumerate(zip(content.poses, content.used))
            if poses.body not in published.retracted and np.isin(used, target_id).any()
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
    numbers = ('rotation', 'position_mm', 'covariance_noise', 'covariance_fixed', 'rig_root')
    return replace(
        poses,
        **{name: np.full_like(getattr(poses, name), np.nan) for name in numbers},
        markers=np.zeros_like(poses.markers),
        status=np.full_like(poses.status, PoseStatus.FAILED),
    )


class PointRetractions:
    """Retracts the points of exposures that rely on withdrawn image points of fluoroscopes."""

    def __init__(self, node: StreamNode, names: Sequence[str], refusals: RefusalLog) -> None:
        self._output = node.create_output(
            Retraction, f'reconstruction/{TOPIC}', observations_qos()
        )
        # By fluoroscope and stamp of a view [ns].
        self._published: PublishedExposures[tuple[str, int], PointsContent] = PublishedExposures(
            self._retract, keys=len(names)
        )
        self.bodies: BodyRetractions | None = None  #: of poses determined from these points
        self._count = 0  # retracted points
        for name in names:
            on_retraction = partial(self.on_retraction, name)
            topic = f'{name}/{TOPIC}'
            node.create_input(Retraction, topic, on_retraction, observations_qos(), refusals)

    def note(self, stamps_ns: Mapping[str, int], content: PointsContent) -> None:
        """Store a reconstructed exposure by the stamps of its views."""
        for key in stamps_ns.items():
            self._published.note(key, content)

    def on_retraction(self, name: str, message: Retraction) -> None:
        """Retract points of an exposure, or store the retraction until the exposure arrives."""
        stamp_ns = nanoseconds_from_stamp(message.header.stamp)
        self._published.take_back((name, stamp_ns), message.target_id)

    def _retract(self, content: PointsContent, target_id: ArrayLike) -> None:
        retracted_ids = np.intersect1d(content.target_id, target_id)
        if not len(retracted_ids):
            return
        out = Retraction(frame_number=content.frame_number, target_id=uint32_field(retracted_ids))
        out.header.stamp = stamp_from_nanoseconds(content.stamp_ns)
        out.header.frame_id = content.orientation.frame_id
        self._output.publish(out)
        self._count += len(retracted_ids)
        if self.bodies is not None:
            self.bodies.take_back(content.stamp_ns, retracted_ids)

    def values(self) -> dict[str, int]:
        """Return the counts for the diagnostics."""
        poses = 0 if self.bodies is None else self.bodies.count
        return {'points retracted': self._count, 'poses retracted': poses}
