# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Node that finds the beads of the phantom, or markers, in the images of the fluoroscopes, live.

One thread receives the images and numbers them; each fluoroscope has a thread and a process of its
own that extracts. Where images come faster than they are extracted, whole exposures are shed.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial

import numpy as np
from fluoro_calib_msgs.msg import TargetObservations
from rclpy.publisher import Publisher
from sensor_msgs.msg import CompressedImage, Image

from ..exposures.angles import AngleOptions
from ..exposures.frame import Frame
from ..exposures.stamps import ExposureNumbers
from ..jobs.live_extraction import Observations
from ..jobs.live_markers import MarkerSettings
from .angle_input import AngleInput
from .extraction_settings import PARAMETERS, declare_settings, read_followers
from .image_node import INPUTS
from .image_stream import CONDITIONS, ExtractionWorkers, ImageState, ImageStream, Task
from .messages.image import message_from_image, use_single_thread
from .messages.observations import NS_PER_S, message_from_frame
from .runtime.diagnostics import RefusalLog, Status, health_of
from .runtime.lifecycle import StreamNode
from .runtime.main import run
from .runtime.parameters import declare_read_limits
from .runtime.stream import stream_faults
from .runtime.streams import images_qos, observations_qos

__all__ = ['PARAMETERS', 'ExtractionNode', 'main']

OVERLAY = 'image_overlay'


class ExtractionNode(StreamNode):
    """Publishes the targets that it finds in images."""

    def __init__(self) -> None:
        super().__init__('extraction_node')
        declare_read_limits(self)
        self._settings = settings = declare_settings(self)
        self.autostart = settings.node.autostart
        self.names = settings.node.fluoroscopes
        self._inputs = INPUTS[settings.node.inputs]
        AngleInput(settings.angles, self.names, self.limited_logger)  # refuses unknown joints
        self._followers = read_followers(settings, self.get_logger())
        # By which the images of two views are predicted: only for them, angles are needed.
        self._calibrations = {
            name: calibration
            for follower in self._followers
            if isinstance(follower, MarkerSettings)
            for name, calibration in follower.calibrations.items()
        }
        self._angle_options = settings.angles if self._calibrations else AngleOptions()
        use_single_thread()
        self.reset()

    def reset(self) -> None:
        """Start counting from zero."""
        self.streams = {
            name: ImageStream(
                name,
                RefusalLog('image', self.limited_logger),
                topic=f'{name}/{self._inputs[0][1]}',
            )
            for name in self.names
        }
        self._numbers = ExposureNumbers(self.names, self._settings.pairing.tolerance_ns)
        self._angles = AngleInput(self._angle_options, self.names, self.limited_logger)
        self._workers = self._make_workers()

    def _make_workers(self) -> ExtractionWorkers:
        size = self._settings.node.queue_size
        # One view of a pair waits for the other until the next exposure comes.
        size = max(size, 2) if self._calibrations else size
        return ExtractionWorkers(self.streams, size, self._is_overlay_wanted, self._finish)

    # -- lifecycle

    def create_outputs(self) -> None:
        """Make the outputs."""
        self._observations: dict[str, Publisher] = {}
        self._overlays: dict[str, Publisher] = {}
        for name in self.names:
            self._observations[name] = self.create_output(
                TargetObservations, f'{name}/target_observations', observations_qos()
            )
            self._overlays[name] = self.create_output(Image, f'{name}/{OVERLAY}', images_qos())

    def create_readers(self) -> None:
        """Receive the images of all fluoroscopes in one thread, and number them."""
        reader = self._angles.create_reader(self, stream_faults(self.streams, self.fail))
        for name in self.names:
            for kind, topic in self._inputs:
                reader.subscribe(
                    kind, f'{name}/{topic}', partial(self._on_image, name), images_qos()
                )

    def activate(self) -> None:
        """Start the processes that extract, then the stream reader."""
        self._workers = self._make_workers()
        self._workers.start(self._followers)
        super().activate()

    def deactivate(self) -> None:
        """Stop receiving and extracting; what is waiting is lost."""
        super().deactivate()
        self._workers.close()

    # -- the thread of the stream reader

    def _on_image(
        self, name: str, message: Image | CompressedImage, info: Mapping[str, int]
    ) -> None:
        """Number an image and let it wait for the thread of its fluoroscope."""
        self.streams[name].received += 1
        stamp = message.header.stamp
        stamp_ns = NS_PER_S * stamp.sec + stamp.nanosec
        number = self._numbers.number(name, stamp_ns)
        angle = self._angles.of_frame(name, stamp_ns, needed=self._needs_angle(name))
        self._workers.put(name, Task(number, message, info['received_timestamp'], angle))

    def _needs_angle(self, name: str) -> bool:
        """Return whether predictions in the images of a fluoroscope depend on its angle."""
        calibration = self._calibrations.get(name)
        return calibration is not None and calibration.angle_field is not None

    # -- the threads that extract

    def _is_overlay_wanted(self, name: str) -> bool:
        return bool(self._overlays[name].get_subscription_count())

    def _finish(
        self, stream: ImageStream, task: Task, image: np.ndarray, found: Observations
    ) -> None:
        """Publish what was found in an image, and count it."""
        header = task.message.header
        if not found.reason:
            frame = Frame(
                stream.name,
                task.number,
                found.target_id,
                found.uv,
                (image.shape[1], image.shape[0]),
                sigma=found.sigma,
                stamp_ns=NS_PER_S * header.stamp.sec + header.stamp.nanosec,
                frame_id=header.frame_id,
            )
            self._observations[stream.name].publish(message_from_frame(frame))
            stream.add_latency(task.received_ns)
        stream.count(task.message, found)
        if found.picture is not None:
            self._overlays[stream.name].publish(
                message_from_image(header, np.ascontiguousarray(found.picture))
            )

    # -- diagnostics

    def diagnose(self) -> list[Status]:
        """Return the status of every fluoroscope."""
        incompatible = self.incompatible_publishers()
        return [self._diagnose(stream, incompatible) for stream in self.streams.values()]

    def _diagnose(self, stream: ImageStream, incompatible: Mapping[str, str]) -> Status:
        name = stream.name
        stream.measure()
        state = ImageState(
            node=self,
            topics=tuple(f'{name}/{topic}' for _, topic in self._inputs),
            refusals=stream.refusals,
            incompatible=incompatible,
            recent=self.recent.growth(name, refused=stream.refusals.total, overrun=stream.overrun),
            stream=stream,
            subject='images',
            angles=self._angles,
        )
        health = health_of(state, CONDITIONS)
        values = {
            **stream.values(self._workers.waiting(name)),
            'lost at the input': stream.overrun,
            **self._angles.values(name),
            **stream.latencies.values(),
        }
        return Status(name, *health, values)


def main(args: Sequence[str] | None = None) -> None:
    """Run the node."""
    run(ExtractionNode, args)


if __name__ == '__main__':
    main()
