# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Images of a bag: sensor_msgs/Image and CompressedImage, without ROS."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

from ..errors import DataError
from ..images.codec import decode
from .definitions import from_cdr
from .frames import fluoroscope_of_topic
from .reader import iterate_messages, topics_of
from .storage import PathLike

IMAGE = 'sensor_msgs/msg/Image'
COMPRESSED_IMAGE = 'sensor_msgs/msg/CompressedImage'
PIXEL_TYPES = {'mono8': 'u1', '8UC1': 'u1', 'mono16': 'u2', '16UC1': 'u2'}


class BagImage(NamedTuple):
    """An image (h, w) of a bag, its place in words, and its stamp [ns], None where it is damaged.

    In place of an image that cannot be read there is the DataError that says why.
    """

    place: str
    image: np.ndarray | DataError
    stamp_ns: int | None


def image_topics(source: PathLike) -> dict[str, str]:
    """Return the topics of a bag with images by fluoroscope, the part of the name before the last.

    The suffix /compressed of image_transport does not count. Where a fluoroscope has both, the
    images that are not compressed are taken. Raises DataError.
    """
    out: dict[str, str] = {}
    for kind in (COMPRESSED_IMAGE, IMAGE):
        for topic, info in topics_of(source).items():
            if info.type == kind and info.count:
                base = topic.removesuffix('/compressed')
                parts = [part for part in base.split('/') if part]
                out[parts[0] if len(parts) == 1 else fluoroscope_of_topic(base)] = topic
    return out


def images_of_topic(source: PathLike, topic: str) -> Iterator[BagImage]:
    """Yield the images of a topic. Raises DataError for a damaged bag."""
    kind = topics_of(source)[topic].type
    for number, message in enumerate(iterate_messages(source, [topic]), 1):
        stamp_ns = None
        try:
            content = from_cdr(message.data, kind)
            stamp = content.header.stamp
            stamp_ns = stamp.sec * 10**9 + stamp.nanosec
            image = decode(content.data) if kind == COMPRESSED_IMAGE else _pixels(content)
        except DataError as error:
            yield BagImage(f'{source}, topic {topic}, message {number}', error, stamp_ns)
        else:
            yield BagImage(f'{source}, topic {topic}, message {number}', image, stamp_ns)


def _pixels(message: Any) -> np.ndarray:
    """Grey values (h, w) of an Image. Raises DataError."""
    if message.encoding not in PIXEL_TYPES:
        raise DataError(f'the encoding {message.encoding} is none of {", ".join(PIXEL_TYPES)}')
    order = '>' if message.is_bigendian else '<'
    dtype = np.dtype(order + PIXEL_TYPES[message.encoding])
    if message.step < message.width * dtype.itemsize:
        raise DataError(f'a row has {message.step} bytes, too few for {message.width} px')
    data = np.asarray(message.data, dtype=np.uint8)
    if len(data) < message.step * message.height:
        raise DataError('the image has fewer pixels than it says')
    rows = data[: message.step * message.height].reshape(message.height, message.step)
    grey = np.ascontiguousarray(rows[:, : message.width * dtype.itemsize]).view(dtype)
    return grey.astype(dtype.newbyteorder('='), copy=False)
