"""Processes round the image node: a camera, and a node that does nothing but hand images on.

    python -m benchmarks.image_processes camera --ros-args -p rate:=120.0 -p frames:=600
    python -m benchmarks.image_processes relay

The camera publishes bytes that are serialised already, as a driver that does not copy its images
would: what the machine has is left to the node under test.
"""

import struct
import sys
import threading
import time
from array import array

import numpy as np
import rclpy
from rclpy.node import Node
from rclpy.serialization import serialize_message
from sensor_msgs.msg import Image

from fluoro_calib_ros.nodes import support
from fluoro_calib_ros.nodes.qos import IMAGES
from fluoro_calib_ros.nodes.streams import StreamReader
from fluoro_calib_ros.nodes.support import declare
from fluoro_calib_ros.simulation.bead_images import bead_image
from fluoro_calib_ros.simulation.rig import simulate_exposures, virtual_rig

DIFFERENT = 8  # images that come over and over


class Camera(Node):
    """Publishes images of the phantom on a/image_raw at a rate, stamped just before."""

    def __init__(self):
        super().__init__('camera')
        self._rate = declare(self, 'rate', 120.0, 'images a second', 0.1, 2000.0)
        self._frames = declare(
            self, 'frames', 600, 'images after which the process ends', 1, 10**6
        )
        self._wait = declare(self, 'wait_for_readers', 1, 'subscriptions to wait for', 0, 100)
        encoding = declare(self, 'encoding', 'mono8', 'mono8 or mono16')
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
        self._output = self.create_publisher(Image, 'a/image_raw', IMAGES)
        self._ending = threading.Event()
        self._worker = threading.Thread(target=self._run, daemon=True)
        self._worker.start()

    def _run(self):
        support.wait_for_readers(self, [self._output], self._wait, self._ending)
        began = time.monotonic()
        for number in range(self._frames):
            if self._ending.wait(max(0.0, began + number / self._rate - time.monotonic())):
                return
            message = self._messages[number % DIFFERENT]
            struct.pack_into(
                '<iI', message, 4, *divmod(time.time_ns(), 10**9)
            )  # behind the head of CDR
            self._output.publish(bytes(message))
        self.get_logger().info(f'{self._frames} images in {time.monotonic() - began:.2f} s')
        support.wait_until_taken([self._output], self._ending)
        rclpy.try_shutdown()

    def stop(self):
        """End publishing."""
        self._ending.set()
        self._worker.join(2.0)


class Relay(support.ManagedNode):
    """Publishes every image of a/image_raw on a/relayed."""

    def __init__(self):
        super().__init__('relay')
        self._reader = None

    def begin(self):
        """Take and publish."""
        self._reader = StreamReader(self, self.fail, self.fail)
        publisher = self.create_publisher(Image, 'a/relayed', IMAGES)
        self._reader.subscribe(
            Image, 'a/image_raw', lambda message, _: publisher.publish(message), IMAGES
        )
        self._reader.start()

    def end(self):
        """Take no more."""
        self._reader.stop()

    def open(self):
        """Nothing."""

    def close(self):
        """Nothing."""


if __name__ == '__main__':
    support.run({'camera': Camera, 'relay': Relay}[sys.argv[1]], sys.argv[:1] + sys.argv[2:])
