# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Image messages, raw and compressed, as the nodes read them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import CompressedImage, Image

from fluoro_calib_ros.errors import DataError
from fluoro_calib_ros.nodes.messages.image import ImageConverter
from fluoro_calib_ros.nodes.runtime.diagnostics import Refused

from ..harness import Target, both
from ..seeds import encoded_images, images

KINDS = (Image, CompressedImage)


def _read(path: Path) -> None:
    data = path.read_bytes()
    both(*(lambda kind=kind: _decode(kind, data) for kind in KINDS))


def _decode(kind: type, data: bytes) -> None:
    try:
        message = deserialize_message(data, kind)
    except Exception as error:  # raised by rclpy; the stream readers count such messages
        raise DataError(f'undecodable ({type(error).__name__})') from None
    try:
        image, _ = ImageConverter('a').decoded(message)
    except Refused as error:
        raise DataError(str(error)) from None
    np.sum(image)  # checks that every pixel is readable


def _seeds() -> list[bytes]:
    found = []
    for image in images():
        height, width = image.shape
        message = Image(height=height, width=width, step=width * image.itemsize)
        message.encoding = f'mono{8 * image.itemsize}'
        message.data = image.tobytes()
        found.append(bytes(serialize_message(message)))
    for ending in ('.png', '.jpg', '.tif'):
        compressed = CompressedImage(format=ending[1:], data=encoded_images(ending)[0])
        found.append(bytes(serialize_message(compressed)))
    return found


TARGET = Target('image_message', 'message', _read, _seeds)
