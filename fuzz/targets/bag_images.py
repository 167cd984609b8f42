# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Images in bags, raw and compressed, as the extraction reads them."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np
from mcap.writer import CompressionType, Writer

from fluoro_calib_ros.io.bags.metadata import known_definition, message_class, to_cdr
from fluoro_calib_ros.io.bags.reader import COMPRESSED_IMAGE, IMAGE
from fluoro_calib_ros.jobs.image_sources import open_sources

from ..harness import Target, check_message
from ..seeds import encoded_images, images


def _read(path: Path) -> None:
    refusal = None
    for found in open_sources([path]).images():
        if not isinstance(found.image, np.ndarray):
            check_message(str(found.image))
            refusal = found.image
    if refusal is not None:
        raise refusal


def _header() -> Any:
    time = message_class('builtin_interfaces/msg/Time')(1, 0)
    return message_class('std_msgs/msg/Header')(time, 'a_optical')


def _raw(image: np.ndarray) -> bytes:
    height, width = image.shape
    step = width * image.itemsize
    data = image.view(np.uint8).ravel()
    encoding = f'mono{8 * image.itemsize}'
    message = message_class(IMAGE)(_header(), height, width, encoding, 0, step, data)
    return to_cdr(message, IMAGE)


def _compressed(content: bytes, name: str) -> bytes:
    data = np.frombuffer(content, np.uint8)
    return to_cdr(message_class(COMPRESSED_IMAGE)(_header(), name, data), COMPRESSED_IMAGE)


def _bag(kind: str, topic: str, messages: list[bytes]) -> bytes:
    """Return a bag with one topic, without compression and checksums."""
    buffer = io.BytesIO()
    writer = Writer(
        buffer, compression=CompressionType.NONE, enable_crcs=False, enable_data_crcs=False
    )
    writer.start('ros2', 'fuzz')
    definition = known_definition(kind)
    schema = writer.register_schema(kind, 'ros2msg', definition.text.encode())
    channel = writer.register_channel(topic, 'cdr', schema)
    for number, data in enumerate(messages):
        writer.add_message(channel, number, data, number)
    writer.finish()
    return buffer.getvalue()


def _seeds() -> list[bytes]:
    return [
        _bag(IMAGE, '/a/image', [_raw(image) for image in images()]),
        _bag(
            COMPRESSED_IMAGE,
            '/a/image/compressed',
            [_compressed(encoded_images(ending)[0], ending[1:]) for ending in ('.png', '.jpg')],
        ),
    ]


TARGET = Target('bag_images', 'bag.mcap', _read, _seeds)
