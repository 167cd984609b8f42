"""Image messages to arrays and back, without copies of a megabyte that are not needed."""

from array import array

import cv2
import numpy as np
from sensor_msgs.msg import CompressedImage, Image

from ..errors import DataError
from ..images.codec import decode, encode
from .checks import Refused

# Of an encoding: type of its pixels. 8UC1 and 16UC1 are the same without the word that they are
# grey.
ENCODINGS = {'mono8': np.uint8, '8UC1': np.uint8, 'mono16': np.uint16, '16UC1': np.uint16}
ENCODING_OF = {np.dtype(np.uint8): 'mono8', np.dtype(np.uint16): 'mono16'}
COMPRESSIONS = {'png': '.png', 'jpeg': '.jpg'}
IMAGE_KINDS = ('undecodable', 'encoding', 'image size', 'frame id', 'damaged')  # of refused images


class Pictures:
    """Images of one fluoroscope: arrays of what comes, and messages of what is corrected, in
    memory used again.
    """

    def __init__(self, fluoroscope):
        self._fluoroscope = fluoroscope
        self._out = {}  # (encoding, shape): message, and its data as an array

    def array_of(self, message, calibration):
        """Grey image (h, w) uint8 or uint16 of an Image or a CompressedImage, and the encoding of
        the corrected one.

        That of an Image is its memory where the order of its bytes allows. calibration: the one
        that it is to be of. Raises Refused.
        """
        frame_id = message.header.frame_id
        if frame_id != calibration.frame_id and frame_id and calibration.frame_id:
            raise self._refused(
                'frame id',
                message,
                f'the frame id is {frame_id}, but the calibration is of {calibration.frame_id}',
            )
        if isinstance(message, CompressedImage):
            image = self._decoded(message)
            encoding = ENCODING_OF[image.dtype]
        else:
            image = self._viewed(message)
            encoding = message.encoding
        if image.shape[::-1] != tuple(calibration.image_size):
            raise self._refused(
                'image size',
                message,
                f'the image is {image.shape[1]} x {image.shape[0]} px, but the '
                f'calibration is for {calibration.image_size[0]} x {calibration.image_size[1]} px',
            )
        return image, encoding

    def _viewed(self, message):
        dtype = ENCODINGS.get(message.encoding)
        if dtype is None:
            raise self._refused(
                'encoding', message, f'its encoding {message.encoding!r} is not mono8 or mono16'
            )
        width = message.width
        height = message.height
        step = message.step
        size = len(message.data)
        of_row = width * np.dtype(dtype).itemsize
        if (
            not width
            or not height
            or step < of_row
            or not (height - 1) * step + of_row <= size <= height * step
        ):
            raise self._refused(
                'image size',
                message,
                f'{size} bytes in rows of {step} are not an image of {width} x '
                f'{height} px of {message.encoding}',
            )
        image = np.ndarray(
            (height, width), dtype, message.data, strides=(step, np.dtype(dtype).itemsize)
        )
        if dtype == np.uint16 and message.is_bigendian:
            return image.byteswap()
        return (
            image if step % image.itemsize == 0 else image.copy()
        )  # OpenCV takes no row that begins within a pixel

    def _decoded(self, message):
        try:
            return decode(message.data)
        except DataError as error:
            kind = 'encoding' if 'colour' in str(error) or 'pixels of' in str(error) else 'damaged'
            raise self._refused(
                kind, message, f'{message.format or "no format"}: {error}'
            ) from None

    def _refused(self, kind, message, what):
        stamp = message.header.stamp
        return Refused(
            kind,
            f'fluoroscope {self._fluoroscope}, image of {stamp.sec}.{stamp.nanosec:09d} s: {what}',
        )

    def out(self, header, encoding, shape):
        """An Image message to be filled, with a header, and its pixels (h, w): to be published
        before the next call.
        """
        found = self._out.get((encoding, shape))
        if found is None:
            dtype = np.dtype(ENCODINGS[encoding])
            message = Image(
                height=shape[0], width=shape[1], encoding=encoding, step=shape[1] * dtype.itemsize
            )
            message.data = array(
                'B', bytes(shape[0] * message.step)
            )  # this may copy: the view is of what it has
            # One at a time: a stream has one encoding.
            self._out = {
                (encoding, shape): (message, np.frombuffer(message.data, dtype).reshape(shape))
            }
            found = self._out[encoding, shape]
        found[0].header = header
        return found


def compressed(message, image, kind, quality):
    """CompressedImage of an Image message with pixels image (h, w): kind 'png' or 'jpeg', which
    has 8 bits: deeper images are png all the same. quality of JPEG, 1 to 100.
    """
    kind = 'png' if image.dtype == np.uint16 else kind
    out = CompressedImage(
        header=message.header, format=f'{message.encoding}; {kind} compressed {message.encoding}'
    )
    out.data = array('B', encode(image, COMPRESSIONS[kind], quality))
    return out


def one_thread():
    """Let OpenCV work in the thread that calls it: beside the other streams of a node more would
    be slower.
    """
    cv2.setNumThreads(1)
