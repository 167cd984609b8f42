# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Current view of a rig: radiographs with image points, coverage, and points in space."""

from __future__ import annotations

import base64
import math
import time
from collections import OrderedDict
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from fluoro_calib_msgs.msg import ReconstructedPoints, RigOrientation, TargetObservations
from rclpy.context import Context
from rclpy.node import Node
from rclpy.subscription import Subscription
from sensor_msgs.msg import CompressedImage, Image

from ...exposures.stamps import nanoseconds_from_stamp
from ...images.codec import encode
from ...images.overlay import small_jpeg
from ...photogrammetry import rig_orientation
from ..messages.image import ImageConverter
from ..messages.rig_orientation import orientation_from_message
from ..runtime.diagnostics import Refused
from ..runtime.streams import remember
from ..runtime.topics import OBSERVATION_DEPTH, adapted_qos, is_outdated

IDLE_S = 10.0  # idle time after which a topic is unsubscribed
LARGEST_PX = 768  # maximum size of a displayed radiograph
KEPT = 16  # radiographs kept until their image points arrive


@dataclass
class _Film:
    """Last radiographs and image points of a fluoroscope, by stamp [ns]."""

    converter: ImageConverter
    #: JPEG data, and width and height of the original image [px]
    images: OrderedDict[int, tuple[bytes, int, int]] = field(default_factory=OrderedDict)
    points: OrderedDict[int, TargetObservations] = field(default_factory=OrderedDict)
    found_at: float = -math.inf  #: time at which the last image points were taken [s]


@dataclass
class _Reader:
    subscription: Subscription
    kind: type
    depth: int
    used_at: float


class Scene:
    """Takes the newest messages of a rig on request; to be used from one thread.

    Its node is not spun: DDS keeps the last messages of a topic, and the others cost Python no
    time. Topics that have not been requested for IDLE_S are unsubscribed.
    """

    def __init__(self, namespace: str, context: Context | None = None) -> None:
        self._node = Node(
            'watch_scene',
            namespace=namespace,
            context=context,
            enable_rosout=False,
            start_parameter_services=False,
        )
        self._readers: dict[str, _Reader] = {}
        self._films: dict[str, _Film] = {}
        self._latched: dict[str, Any] = {}

    def close(self) -> None:
        """Destroy the node."""
        self._node.destroy_node()

    def radiograph(self, name: str) -> dict[str, Any]:
        """Return the newest analysed image, and the image points of the same exposure.

        Keys: stamp [ns]; age [s], how much older it is than the newest image; width, height [px]
        of the image; jpeg, the image as a data URL, '' for a stream without images; points, rows
        (id, u, v) [px]. Empty before any data has arrived.
        """
        film = self._films.setdefault(name, _Film(ImageConverter(name)))
        has_images = self._take_image(name, film)
        depth = OBSERVATION_DEPTH if has_images else 1  # 3 s at 30 Hz
        for message in self._taken(f'{name}/target_observations', TargetObservations, depth):
            if not _has_rows(message, ('target_id', 'u', 'v')):  # the nodes report it
                continue
            stamp_ns = nanoseconds_from_stamp(message.header.stamp)
            remember(film.points, stamp_ns, message, OBSERVATION_DEPTH)
            film.found_at = time.monotonic()
        if has_images and film.images:
            stamp = _shown(film)
            jpeg, width, height = film.images[stamp]
        elif film.points:
            stamp = next(reversed(film.points))
            jpeg = b''
            width = film.points[stamp].image_width
            height = film.points[stamp].image_height
        else:
            return {}
        return {
            'stamp': str(stamp),  # numbers of JavaScript have 53 bits
            'age': max(0, next(reversed(film.images), stamp) - stamp) * 1e-9,
            'width': width,
            'height': height,
            'jpeg': f'data:image/jpeg;base64,{base64.b64encode(jpeg).decode()}' if jpeg else '',
            'points': _rows(film.points.get(stamp)),
        }

    def _take_image(self, name: str, film: _Film) -> bool:
        """Take the newest image of a fluoroscope; return whether images are published."""
        for topic, kind in (('image_raw', Image), ('image_raw/compressed', CompressedImage)):
            if not self._node.count_publishers(f'{name}/{topic}'):
                continue
            for message in self._taken(f'{name}/{topic}', kind):
                try:
                    image, _ = film.converter.decoded(message)
                except Refused:  # the extraction node reports the reason
                    continue
                height, width = image.shape
                remember(
                    film.images,
                    nanoseconds_from_stamp(message.header.stamp),
                    (small_jpeg(image, LARGEST_PX), width, height),
                    KEPT,
                )
            return True
        return False

    def coverage(self, name: str) -> bytes:
        """Return the coverage picture of a fluoroscope as PNG, or b'' if there is none."""
        message = self._last(f'{name}/coverage', Image)
        if message is None or message.encoding != 'bgr8':
            return b''
        shape = message.height, message.width, 3
        picture = np.frombuffer(message.data, np.uint8)
        if picture.size != math.prod(shape):
            return b''
        return encode(picture.reshape(shape), '.png', 0)

    def space(self) -> dict[str, Any]:
        """Return the newest points in space and the sources of the fluoroscopes [mm].

        Keys: frame; points, rows (id, x, y, z, status); sources, each with name, position and
        axis, the direction of its beam.
        """
        out: dict[str, Any] = {'points': [], 'sources': []}
        orientation = self._last('rig_orientation', RigOrientation)
        if orientation is not None:
            with suppress(ValueError):  # the reconstruction node reports the reason
                out['sources'] = _sources(orientation_from_message(orientation))
        points = self._last('reconstruction/points_with_covariance', ReconstructedPoints)
        if points is not None and _has_rows(points, ('target_id', 'x', 'y', 'z', 'status')):
            xyz = 1000 * np.column_stack([points.x, points.y, points.z])
            seen = np.atleast_1d(np.isfinite(xyz).all(axis=1))
            rows = zip(points.target_id, xyz.round(3).tolist(), points.status, seen.tolist())
            out['frame'] = points.frame_number
            out['points'] = [[int(i), *x, int(status)] for i, x, status, good in rows if good]
        return out

    def _last(self, topic: str, kind: type) -> Any:
        """Return the newest message of a topic, possibly taken earlier; None if there is none."""
        for message in self._taken(topic, kind):
            self._latched[topic] = message
        if not self._node.count_publishers(topic):
            self._latched.pop(topic, None)
        return self._latched.get(topic)

    def _taken(self, topic: str, kind: type, depth: int = 1) -> list[Any]:
        """Return the new messages of a topic, at most the last `depth`."""
        now = time.monotonic()
        for name, open_reader in list(self._readers.items()):
            if now - open_reader.used_at > IDLE_S or (
                name == topic
                and (
                    open_reader.depth != depth or is_outdated(self._node, open_reader.subscription)
                )
            ):
                self._node.destroy_subscription(self._readers.pop(name).subscription)
        reader = self._readers.get(topic) or self._open(topic, kind, depth)
        if reader is None:
            return []
        reader.used_at = now
        out: list[Any] = []
        handle = reader.subscription.handle
        with handle:
            while len(out) < depth:
                received = handle.take_message(kind, False)
                if received is None:
                    break
                out.append(received[0])
        return out

    def _open(self, topic: str, kind: type, depth: int) -> _Reader | None:
        """Subscribe to a topic; return None if nobody publishes it."""
        publishers = self._node.get_publishers_info_by_topic(self._node.resolve_topic_name(topic))
        if not publishers:
            return None
        qos = adapted_qos(publishers, depth)
        subscription = self._node.create_subscription(kind, topic, lambda _: None, qos)
        self._readers[topic] = _Reader(subscription, kind, depth, time.monotonic())
        return self._readers[topic]


def _sources(rig: rig_orientation.RigOrientation) -> list[dict[str, Any]]:
    rows = zip(rig.fluoroscopes, rig.position_mm.tolist(), rig.rotation.tolist())
    return [{'name': name, 'position': x, 'axis': rotation[2]} for name, x, rotation in rows]


def _shown(film: _Film) -> int:
    """Return the stamp of the image to show: the newest that was analysed.

    If no image points have arrived for IDLE_S, it is the newest image of all.
    """
    newest = next(reversed(film.images))
    if time.monotonic() - film.found_at > IDLE_S:
        return newest
    last = next(reversed(film.points))
    return max((stamp for stamp in film.images if stamp <= last), default=newest)


def _has_rows(message: Any, columns: Iterable[str]) -> bool:
    """Return whether the arrays of a message have the same length."""
    return len({len(getattr(message, column)) for column in columns}) == 1


def _rows(message: TargetObservations | None) -> list[list[float]]:
    """Return id, u and v of the image points with finite coordinates."""
    if message is None:
        return []
    rows = np.column_stack([message.target_id, message.u, message.v])
    return rows[np.isfinite(rows).all(axis=1)].round(1).tolist()
