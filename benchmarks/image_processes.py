# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Processes next to the image node: a camera, and a relay that forwards images unchanged.

    python -m benchmarks.image_processes camera --ros-args -p rate:=120.0 -p frames:=600
    python -m benchmarks.image_processes relay

The camera publishes serialised bytes, as a driver that does not copy its images would. This leaves
the CPU to the node under test.
"""

from __future__ import annotations

import struct
import sys
import threading
import time
from array import array
from dataclasses import dataclass

import numpy as np
import rclpy
from rclpy.node import Node
from rclpy.serialization import serialize_message
from sensor_msgs.msg import Image

from benchmarks.bead_images import bead_image
from fluoro_calib_ros.nodes.runtime.lifecycle import StreamNode
from fluoro_calib_ros.nodes.runtime.main import run
from fluoro_calib_ros.nodes.runtime.parameters import ParameterGroup
from fluoro_calib_ros.nodes.runtime.topics import (
    images_qos,
    wait_for_readers,
    wait_until_acknowledged,
)
from fluoro_calib_ros.options import option
from fluoro_calib_ros.simulation.rig import simulate_exposures, virtual_rig

from .relay import RelaySettings, all_fatal

DIFFERENT = 8  # distinct images, published in turn


@dataclass(frozen=True)
class CameraParameters:
    """Parameters of the camera."""

    rate: float = option(120.0, 'frame rate', minimum=0.1, maximum=2000.0, unit='Hz')
    frames: int = option(600, 'images after which the process ends', minimum=1, maximum=10**6)
    wait_for_readers: int = option(1, 'subscriptions to wait for', minimum=0, maximum=100)
    encoding: str = option('mono8', 'encoding', choices=('mono8', 'mono16'))


class Camera(Node):
    """Publishes images of the phantom on a/image_raw at a rate, stamped on publication."""

    def __init__(self) -> None:
        super().__init__('camera')
        self._settings = ParameterGroup(CameraParameters).declare(self)
        encoding = self._settings.encoding
        dtype = np.uint8 if encoding == 'mono8' else np.uint16
        exposures = simulate_exposures(virtual_rig(1), DIFFERENT, 1).frames['a']
        self._messages = []
        for number, frame in enumerate(exposures):
            image = bead_image(frame.uv, frame.image_size, dtype, seed=number)
            message = Image(
                height=image.shape[0],
                width=image.shape[1],
                encoding=encoding,
                step=image.shape[1] * image.itemsize,
                data=array('B', image.tobytes()),
            )
            message.header.frame_id = frame.frame_id
            self._messages.append(bytearray(serialize_message(message)))
        self._output = self.create_publisher(Image, 'a/image_raw', images_qos())
        self._ending = threading.Event()
        self._worker = threading.Thread(target=self._run, daemon=True)
        self._worker.start()

    def _run(self) -> None:
        wait_for_readers(self, [self._output], self._settings.wait_for_readers, self._ending)
        began = time.monotonic()
        for number in range(self._settings.frames):
            if self._ending.wait(
                max(0.0, began + number / self._settings.rate - time.monotonic())
            ):
                return
            message = self._messages[number % DIFFERENT]
            struct.pack_into(
                '<iI', message, 4, *divmod(time.time_ns(), 10**9)
            )  # after the CDR header
            self._output.publish(bytes(message))
        self.get_logger().info(
            f'{self._settings.frames} images in {time.monotonic() - began:.2f} s'
        )
        wait_until_acknowledged([self._output], self._ending)
        rclpy.try_shutdown()

    def stop(self) -> None:
        """Stop publishing."""
        self._ending.set()
        self._worker.join(2.0)


class Relay(StreamNode):
    """Republishes every image of a/image_raw on a/relayed."""

    def __init__(self) -> None:
        super().__init__('relay', RelaySettings)

    def create_readers(self) -> None:
        """Start to relay."""
        reader = self.create_reader(all_fatal(self))
        publisher = self.create_publisher(Image, 'a/relayed', images_qos())
        reader.subscribe(
            Image, 'a/image_raw', lambda message, _: publisher.publish(message), images_qos()
        )


if __name__ == '__main__':
    run({'camera': Camera, 'relay': Relay}[sys.argv[1]], sys.argv[:1] + sys.argv[2:])
