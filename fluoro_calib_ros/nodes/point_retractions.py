# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Points of earlier exposures whose image points were taken back."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Mapping
from functools import partial

import numpy as np
from fluoro_calib_msgs.msg import Retraction

from .body_retractions import BodyRetractions
from .messages.bodies import BodiesContent
from .messages.observations import nanoseconds_from_stamp, stamp_from_nanoseconds, uint32_field
from .messages.points import PointsContent
from .runtime.diagnostics import RefusalLog
from .runtime.lifecycle import StreamNode, remember
from .runtime.topics import observations_qos

TOPIC = 'retractions'
REMEMBERED = 1000  # views and retractions
MAX_IDS = 10_000  # of a retraction


class PointRetractions:
    """Publishes which points of an exposure are by image points that were taken back."""

    def __init__(self, node: StreamNode) -> None:
        self._node = node
        self._output = node.create_output(
            Retraction, f'reconstruction/{TOPIC}', observations_qos()
        )
        # By fluoroscope and stamp of a view.
        self._exposures: OrderedDict[tuple[str, int], PointsContent] = OrderedDict()
        self._early: OrderedDict[tuple[str, int], Retraction] = OrderedDict()
        self._lock = threading.Lock()  # views and retractions come in two threads
        self.bodies = BodyRetractions(_nowhere)  #: whose poses are by these points
        self._count = 0  # points that were taken back

    def listen(self, name: str, refusals: RefusalLog) -> None:
        """Receive what is taken back of a fluoroscope."""
        on_retraction = partial(self.on_retraction, name)
        topic = f'{name}/{TOPIC}'
        self._node.create_input(Retraction, topic, on_retraction, observations_qos(), refusals)

    def note(self, stamps_ns: Mapping[str, int], content: PointsContent) -> None:
        """Remember an exposure that was reconstructed, by the stamps of its views."""
        with self._lock:
            for key in stamps_ns.items():
                remember(self._exposures, key, content, REMEMBERED)
                if key in self._early:
                    self._publish(content, self._early.pop(key))

    def on_retraction(self, name: str, message: Retraction) -> None:
        """Take back points of an exposure, or of one that is still to come."""
        key = name, nanoseconds_from_stamp(message.header.stamp)
        with self._lock:
            if key in self._exposures:
                self._publish(self._exposures[key], message)
            elif len(message.target_id) <= MAX_IDS:
                remember(self._early, key, message, REMEMBERED)

    def _publish(self, content: PointsContent, message: Retraction) -> None:
        wrong = np.intersect1d(content.target_id, message.target_id)
        if not len(wrong):
            return
        out = Retraction(frame_number=content.frame_number, target_id=uint32_field(wrong))
        out.header.stamp = stamp_from_nanoseconds(content.stamp_ns)
        out.header.frame_id = content.orientation.frame_id
        self._output.publish(out)
        self._count += len(wrong)
        self.bodies.take_back(content.stamp_ns, wrong.tolist())

    def values(self) -> dict[str, int]:
        """Return the counts for the diagnostics."""
        return {'points retracted': self._count, 'poses retracted': self.bodies.count}


def _nowhere(content: BodiesContent) -> None:
    """Publish no bodies."""
