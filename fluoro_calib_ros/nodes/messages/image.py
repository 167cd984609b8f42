# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Conversion of Image and CompressedImage without avoidable copies of the pixels."""

from __future__ import annotations

from array import array
from typing import Any

import cv2
import numpy as np
from sensor_msgs.msg import CompressedImage, Image
from std_msgs.msg import Header

from ...correction.fluoroscope_calibration import FluoroscopeCalibration
from ...errors import DataError
from ...exposures.frame import image_size_error
from ...findings import Kind
from ...images.codec import PIXEL_TYPES, decode, encode, raw_image
from ..runtime.diagnostics import TOO_LARGE, Refused

ENCODINGS = {np.dtype(np.uint8): 'mono8', np.dtype(np.uint16): 'mono16'}
COMPRESSIONS = {'png': '.png', 'jpeg': '.jpg'}
# Kinds of refusals.
IMAGE_REFUSALS = ('undecodable', TOO_LARGE, 'encoding', 'image size', 'frame id', 'damaged')


class ImageConverter:
    """Converts the images of one fluoroscope: messages to arrays, and back into reused memory."""

    def __init__(self, fluoroscope: str) -> None:
        self._fluoroscope = fluoroscope
        # By (encoding, shape), a single entry: message, and its data as an array.
        self._output: dict[tuple[Any, ...], tuple[Image, np.ndarray]] = {}

    def to_array(
        self, message: Image | CompressedImage, calibration: FluoroscopeCalibration
    ) -> tuple[np.ndarray, str]:
        """Return the grey image (h, w) uint8 or uint16, and the encoding for the corrected image.

        The array shares the memory of an Image where byte order and row step allow. Raises Refused
        for an image that does not match the calibration.
        """
        frame_id = message.header.frame_id
        if frame_id != calibration.frame_id and frame_id and calibration.frame_id:
            raise self.refusal(
                'frame id',
                message,
                f'the frame id is {frame_id}, but the calibration is of {calibration.frame_id}',
            )
        image, encoding = self.decoded(message)
        error = image_size_error((image.shape[1], image.shape[0]), calibration.image_size)
        if error:
            raise self.refusal('image size', message, error)
        return image, encoding

    def decoded(self, message: Image | CompressedImage) -> tuple[np.ndarray, str]:
        """Return the grey image (h, w) uint8 or uint16 of a message, and its encoding.

        The array shares the memory of an Image if byte order and row step allow. Raises Refused.
        """
        is_compressed = isinstance(message, CompressedImage)
        try:
            image = decode(message.data) if is_compressed else raw_image(message)
        except DataError as error:
            kind = 'damaged' if is_compressed else 'image size'
            if error.finding.kind is Kind.IMAGE_ENCODING:
                kind = 'encoding'
            prefix = f'{message.format or "no format"}: ' if is_compressed else ''
            raise self.refusal(kind, message, f'{prefix}{error}') from None
        return image, ENCODINGS[image.dtype] if is_compressed else message.encoding

    def prepare_output(
        self, header: Header, encoding: str, shape: tuple[int, ...]
    ) -> tuple[Image, np.ndarray]:
        """Return an Image to be filled, and its pixels (h, w).

        Publish it before the next call, which reuses the memory.
        """
        prepared = self._output.get((encoding, shape))
        if prepared is None:
            dtype = np.dtype(PIXEL_TYPES[encoding])
            message = Image(
                height=shape[0], width=shape[1], encoding=encoding, step=shape[1] * dtype.itemsize
            )
            # The assignment may copy, so view the data that the message owns.
            message.data = array('B', bytes(shape[0] * message.step))
            prepared = message, np.frombuffer(message.data, dtype).reshape(shape)
            self._output = {(encoding, shape): prepared}  # a stream has one encoding
        prepared[0].header = header
        return prepared

    def refusal(self, kind: str, message: Image | CompressedImage, reason: str) -> Refused:
        """Return an error that identifies an image and says why it is refused."""
        stamp = message.header.stamp
        return Refused(
            kind,
            f'fluoroscope {self._fluoroscope}, image of {stamp.sec}.{stamp.nanosec:09d} s: '
            f'{reason}',
        )


def message_from_image(header: Header, image: np.ndarray) -> Image:
    """Return the Image of a grey image (h, w) or a colour picture (h, w, 3) in BGR order."""
    colour = image.ndim == 3
    message = Image(
        header=header,
        height=image.shape[0],
        width=image.shape[1],
        encoding='bgr8' if colour else ENCODINGS[image.dtype],
        step=image.strides[0],
    )
    message.data = array('B', image.tobytes())
    return message


def compressed_message(
    message: Image, image: np.ndarray, kind: str, quality: int
) -> CompressedImage:
    """Return the CompressedImage of an Image.

    Parameters
    ----------
    message : Image
        Source of header and encoding.
    image : np.ndarray
        Pixels (h, w) of the Image.
    kind : {'png', 'jpeg'}
        JPEG has 8 bits, so images of 16 bits always become png.
    quality : int
        JPEG quality, 1 to 100.
    """
    kind = 'png' if image.dtype == np.uint16 else kind
    out = CompressedImage(
        header=message.header, format=f'{message.encoding}; {kind} compressed {message.encoding}'
    )
    out.data = array('B', encode(image, COMPRESSIONS[kind], quality))
    return out


def use_single_thread() -> None:
    """Let OpenCV work in the calling thread: with several streams, more threads are slower."""
    cv2.setNumThreads(1)
