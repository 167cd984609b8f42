# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Stream of the images of a fluoroscope, and its diagnostics in the extraction node."""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np
from sensor_msgs.msg import CompressedImage, Image

from ..jobs.live_extraction import Observations
from .angle_input import AngleInput
from .messages.image import IMAGE_REFUSALS, ImageConverter
from .runtime.conditions import (
    StreamState,
    inactive_node,
    incompatible_publisher,
    lost_messages,
    missing_publisher,
    overrun_input,
    refused_messages,
    stalled_stream,
)
from .runtime.diagnostics import OK, Health, RefusalLog, warning
from .runtime.stream import Stream


class ImageStream(Stream):
    """Stream of images that are extracted."""

    def __init__(self, name: str, refusals: RefusalLog, topic: str) -> None:
        super().__init__(name, refusals)
        self.topic = topic  #: one on which images come, for messages
        #: number of images with observations, of those that the image before gave the start of, of
        #: those without observations, and of those that were never looked at
        self.extracted = 0
        self.followed = 0
        self.without = 0
        self.shed = 0
        self.last: Observations | None = None  #: of the last image
        self.converter = ImageConverter(name)
        self.seconds = 0.0  #: that images took
        #: between the last two calls of measure(), and shed_now: images shed in this time
        self.rate_hz = 0.0
        self.shed_now = 0
        self._first: tuple[tuple[int, int], str] | None = None  # image size and frame id
        # At the last measurement: time, images that were processed, images that were shed.
        self._before = (time.monotonic(), 0, 0)

    def measure(self) -> None:
        """Determine the rate, and what was shed, since the last call."""
        now = time.monotonic()
        then, processed, shed = self._before
        count = self.extracted + self.without
        self.rate_hz = (count - processed) / max(now - then, 1e-3)
        self.shed_now = self.shed - shed
        self._before = (now, count, self.shed)

    def decoded(self, message: Image | CompressedImage) -> np.ndarray:
        """Return the image (h, w) of a message. Raises Refused where the stream has changed."""
        frame_id = message.header.frame_id
        if self._first is not None and frame_id != self._first[1]:
            raise self.converter.refusal(
                'frame id',
                message,
                f'the frame id is {frame_id!r}, but that of the first image is {self._first[1]!r}',
            )
        image, _ = self.converter.decoded(message)
        size = (image.shape[1], image.shape[0])
        if self._first is None:
            self._first = size, frame_id
        elif size != self._first[0]:
            expected = self._first[0]
            raise self.converter.refusal(
                'image size',
                message,
                f'the image is {size[0]} x {size[1]} px, but the first one is '
                f'{expected[0]} x {expected[1]} px',
            )
        return image

    def count(self, message: Image | CompressedImage, found: Observations) -> None:
        """Count an image that was extracted, and log what is wrong with it."""
        if not found.reason:
            self.extracted += 1
            self.followed += found.followed
        else:
            self.without += 1
            self._note(message, f'no observations: {found.reason}')
        if found.note:
            self._note(message, found.note)
        self.last = found
        self.seconds += found.seconds

    def _note(self, message: Image | CompressedImage, text: str) -> None:
        self.refusals.note(str(self.converter.refusal('', message, text)))

    def values(self, waiting: int) -> dict[str, object]:
        """Return the values for the diagnostics; waiting: images that wait."""
        last = self.last or Observations()
        processed = self.extracted + self.without
        return {
            'images received': self.received,
            'images extracted': self.extracted,
            'images followed': self.followed,
            'images without observations': self.without,
            'images waiting': waiting,
            'images shed': self.shed,
            **self.refusals.values(IMAGE_REFUSALS),
            'last fault': self.refusals.last_fault,
            'targets': len(last.target_id),
            'targets expected': last.expected,
            'found [%]': f'{100 * last.found:.1f}',
            'explained [%]': f'{100 * last.explained:.1f}',
            'overlapped': int(last.overlapped.sum()),
            'doubtful': last.doubtful,
            'refusal of the last image': last.reason,
            'rate [Hz]': f'{self.rate_hz:.1f}',
            'time of an image [ms]': f'{1e3 * self.seconds / max(processed, 1):.0f}',
        }


@dataclass(frozen=True)
class ImageState(StreamState):
    """What the diagnostics of a fluoroscope are decided by."""

    stream: ImageStream
    angles: AngleInput


def shed_images(state: ImageState) -> Health | None:
    """Images came faster than they were extracted."""
    shed = f'images come faster than they are extracted: {state.stream.shed} were shed'
    return warning(shed if state.stream.shed_now else '')


def empty_image(state: ImageState) -> Health | None:
    """The last image gave no observations."""
    reason = state.stream.last.reason if state.stream.last is not None else ''
    return warning(reason and f'no observations in the last image: {reason}')


def unknown_angle(state: ImageState) -> Health | None:
    """The angle of the C-arm is unknown, but needed."""
    unknown = state.angles.health(state.stream.name, state.incompatible)
    return unknown and unknown.with_consequence(
        'markers are predicted by the mean correction over all angles'
    )


def extracting(state: ImageState) -> Health:
    """Nothing is wrong."""
    return Health(OK, 'extracting')


CONDITIONS = (
    lost_messages,
    incompatible_publisher,
    inactive_node,
    missing_publisher,
    stalled_stream,
    overrun_input,
    shed_images,
    empty_image,
    unknown_angle,
    refused_messages,
    extracting,
)
