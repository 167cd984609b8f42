"""Node that removes the distortion from the images of the fluoroscopes, live.

Images of a fluoroscope are taken and corrected by a thread of its own: what costs time, the remap
and the copies in and out of DDS, is done beside the other fluoroscopes as far as Python's lock
allows.
"""

from builtin_interfaces.msg import Time
from sensor_msgs.msg import CameraInfo, CompressedImage, Image

from ..images.corrector import INTERPOLATIONS, ImageCorrector
from . import support
from .checks import Refused
from .conversion import camera_info
from .correcting import CorrectingNode, Stream
from .pictures import COMPRESSIONS, IMAGE_KINDS, Pictures, compressed, one_thread
from .qos import IMAGES
from .support import StartError, declare

INPUTS = {
    'raw': ((Image, 'image_raw'),),
    'compressed': ((CompressedImage, 'image_raw/compressed'),),
}
INPUTS['both'] = INPUTS['raw'] + INPUTS['compressed']
CORRECTED = 'image_corrected'


class _Calibrated:
    """A calibration, and what is made of it once."""

    def __init__(self, calibration, interpolation):
        calibration.prepare()
        self.calibration = calibration
        self.corrector = ImageCorrector(calibration, interpolation)
        self.info = camera_info(calibration, Time())  # its header is that of each image


class _Stream(Stream):
    """What the node holds of one fluoroscope."""

    def __init__(self, name):
        super().__init__()
        self.pictures = Pictures(name)
        self.compressed = 0


class ImageNode(CorrectingNode):
    """Publishes corrected images and their CameraInfo; nothing before there is a calibration."""

    item = 'image'
    subject = 'images'
    kinds = IMAGE_KINDS
    new_stream = _Stream

    def __init__(self):
        super().__init__('image_node')
        self._interpolation = self._one_of(
            'interpolation',
            'linear',
            INTERPOLATIONS,
            'between the pixels of the '
            'observed image: linear, or cubic, which is sharper and takes longer',
        )
        self._inputs = INPUTS[
            self._one_of(
                'inputs',
                'both',
                INPUTS,
                'what is subscribed to: raw, compressed or both; '
                'a camera that offers both is to be taken in one form',
            )
        ]
        self.topics = tuple(topic for _, topic in self._inputs)
        self._format = self._one_of(
            'compressed_format',
            'png',
            COMPRESSIONS,
            'format of compressed corrected images: '
            'png (without loss) or jpeg; images of 16 bits are png',
        )
        self._quality = declare(self, 'jpeg_quality', 95, 'quality of jpeg', 1, 100)
        one_thread()

    def _one_of(self, name, default, values, description):
        value = declare(self, name, default, description)
        if value not in values:
            raise StartError(f'parameter {name} is one of {", ".join(values)}, not {value!r}')
        return value

    def make(self):
        """Make outputs, and take calibrations."""
        self._images, self._compressed, self._infos = (
            {name: self.publisher(kind, f'{name}/{topic}', IMAGES) for name in self.names}
            for kind, topic in (
                (Image, CORRECTED),
                (CompressedImage, f'{CORRECTED}/compressed'),
                (CameraInfo, f'{CORRECTED}/camera_info'),
            )
        )
        self.take_calibrations()

    def listen(self):
        """Take images, those of each fluoroscope in a thread of its own."""
        for name in self.names:
            reader = self.reader(self.undecodable)
            for kind, topic in self._inputs:
                reader.subscribe(
                    kind,
                    f'{name}/{topic}',
                    lambda message, info, name=name: self._on_image(name, message, info),
                    IMAGES,
                )

    # -- calibrations

    def prepared(self, calibration):
        """The calibration with its map of pixels."""
        return _Calibrated(calibration, self._interpolation)

    def taken(self, name, calibrated):
        """Tell that a calibration is in use."""
        empty = int((~calibrated.corrector.mask).sum())
        self.get_logger().info(
            f'fluoroscope {name}: images corrected with calibration '
            f'{calibrated.calibration.calibration_id} now ({empty} pixels are empty, nothing was '
            'seen there)'
        )

    # -- images

    def _on_image(self, name, message, info):
        """Correct an image and publish it."""
        stream = self.streams[name]
        stream.received += 1
        calibrated = self.calibrations.of(name)
        if calibrated is None:
            stream.waiting += 1
            return
        try:
            image, encoding = stream.pictures.array_of(message, calibrated.calibration)
        except Refused as error:
            self.refuse(stream, error)
            return
        out, pixels = stream.pictures.out(message.header, encoding, image.shape)
        calibrated.corrector.correct(image, pixels)
        self._images[name].publish(out)  # this copies it
        calibrated.info.header = message.header
        self._infos[name].publish(calibrated.info)
        stream.published(info)
        if self._compressed[name].get_subscription_count():
            self._compressed[name].publish(compressed(out, pixels, self._format, self._quality))
            stream.compressed += 1

    # -- diagnostics

    def more(self, name, stream, calibrated):
        """Further values of the diagnostics."""
        return {
            'images compressed': stream.compressed,
            'calibration': calibrated.calibration.calibration_id if calibrated else '',
        }


def main(args=None):
    """Entry point."""
    support.run(ImageNode, args)


if __name__ == '__main__':
    main()
