"""Node that removes the distortion from the images of the fluoroscopes, live.

Images of a fluoroscope are taken and corrected by a thread of its own: what costs time, the remap and the copies in and
out of DDS, is done beside the other fluoroscopes as far as Python's lock allows.
"""

import time
from collections import Counter

from builtin_interfaces.msg import Time
from sensor_msgs.msg import CameraInfo, CompressedImage, Image

from ..images.undistortion import INTERPOLATIONS, ImageCorrector
from . import support
from .calibrations import Calibrations
from .checks import Refused
from .conversion import camera_info
from .pictures import COMPRESSIONS, IMAGE_KINDS, Pictures, compressed, one_thread
from .qos import IMAGES, overridable
from .streams import StreamReader
from .support import StartError, declare

INPUTS = {'raw': ((Image, 'image_raw'),), 'compressed': ((CompressedImage, 'image_raw/compressed'),)}
INPUTS['both'] = INPUTS['raw'] + INPUTS['compressed']
CORRECTED = 'image_corrected'


class _Calibrated:
    """A calibration, and what is made of it once."""

    def __init__(self, calibration, interpolation):
        calibration.prepare()
        self.calibration, self.corrector = calibration, ImageCorrector(calibration, interpolation)
        self.info = camera_info(calibration, Time())   # its header is that of each image


class _Stream:
    """What the node holds of one fluoroscope."""

    def __init__(self, name):
        self.pictures, self.reader = Pictures(name), None
        self.received = self.corrected = self.compressed = self.waiting = 0
        self.refused = Counter()   # by kind
        self.last_fault = ''
        self.latencies = support.Latencies()   # from the arrival of an image to its publication


class ImageNode(support.ManagedNode):
    """Publishes corrected images and their CameraInfo; nothing before there is a calibration."""

    def __init__(self):
        super().__init__('image_node')
        self._names = support.fluoroscopes_of(self)
        self._interpolation = self._one_of('interpolation', 'linear', INTERPOLATIONS, 'between the pixels of the '
                                           'observed image: linear, or cubic, which is sharper and takes longer')
        self._inputs = self._one_of('inputs', 'both', INPUTS, 'what is subscribed to: raw, compressed or both; a '
                                    'camera that offers both is to be taken in one form')
        self._format = self._one_of('compressed_format', 'png', COMPRESSIONS, 'format of compressed corrected images: '
                                    'png (without loss) or jpeg; images of 16 bits are png')
        self._quality = declare(self, 'jpeg_quality', 95, 'quality of jpeg', 1, 100)
        self._streams = {name: _Stream(name) for name in self._names}
        self._sentences = support.Sentences(self.get_logger())
        self._images, self._compressed, self._infos = {}, {}, {}
        self._calibrations = self._diagnostics = self._timer = None
        one_thread()

    def _one_of(self, name, default, values, description):
        value = declare(self, name, default, description)
        if value not in values:
            raise StartError(f'parameter {name} is one of {", ".join(values)}, not {value!r}')
        return value

    # -- lifecycle

    def open(self):
        """Make outputs, and take calibrations."""
        for name in self._names:
            for publishers, kind, topic in ((self._images, Image, CORRECTED),
                                            (self._compressed, CompressedImage, f'{CORRECTED}/compressed'),
                                            (self._infos, CameraInfo, f'{CORRECTED}/camera_info')):
                publishers[name] = self.create_lifecycle_publisher(kind, f'{name}/{topic}', IMAGES,
                                                                   qos_overriding_options=overridable())
        self._calibrations = Calibrations(
            self, self._names, lambda calibration: _Calibrated(calibration, self._interpolation), self._on_taken,
            self._on_refused)
        self._diagnostics = support.Diagnostics(self)
        self._timer = self.create_timer(1.0, self._on_timer)

    def begin(self):
        """Take images."""
        for name, stream in self._streams.items():
            stream.reader = StreamReader(self, lambda topic, name=name: self._on_undecodable(name, topic), self.fail)
            for kind, topic in INPUTS[self._inputs]:
                stream.reader.subscribe(kind, f'{name}/{topic}',
                                        lambda message, info, name=name: self._on_image(name, message, info), IMAGES)
            stream.reader.start()

    def end(self):
        """Take no more images."""
        for stream in self._streams.values():
            if stream.reader is not None:
                stream.reader.stop()
                stream.reader = None

    def close(self):
        """Take the outputs back, and forget the calibrations."""
        if self._timer is not None:
            self._calibrations.close()
            self.destroy_timer(self._timer)
            self._diagnostics.close()
        for publishers in (self._images, self._compressed, self._infos):
            for publisher in publishers.values():
                self.destroy_publisher(publisher)
            publishers.clear()
        self._timer = self._calibrations = None
        self._streams = {name: _Stream(name) for name in self._names}

    # -- calibrations

    def _on_refused(self, name, error):
        self._streams[name].last_fault = str(error)

    def _on_taken(self, name, calibrated):
        empty = int((~calibrated.corrector.mask).sum())
        self.get_logger().info(f'fluoroscope {name}: images corrected with calibration '
                               f'{calibrated.calibration.calibration_id} now ({empty} pixels are empty, nothing was '
                               'seen there)')

    # -- images

    def _on_undecodable(self, name, topic):
        self._streams[name].received += 1
        self._refuse(self._streams[name], Refused('undecodable', f'fluoroscope {name}: a message on {topic} cannot be '
                                                  'decoded'))

    def _refuse(self, stream, error):
        stream.refused[error.kind] += 1
        stream.last_fault = str(error)
        self._sentences.warn(f'image refused: {error}')

    def _on_image(self, name, message, info):
        """Correct an image and publish it."""
        stream = self._streams[name]
        stream.received += 1
        calibrated = self._calibrations.of(name)
        if calibrated is None:
            stream.waiting += 1
            return
        try:
            image, encoding = stream.pictures.array_of(message, calibrated.calibration)
        except Refused as error:
            self._refuse(stream, error)
            return
        out, pixels = stream.pictures.out(message.header, encoding, image.shape)
        calibrated.corrector.correct(image, pixels)
        self._images[name].publish(out)   # this copies it
        calibrated.info.header = message.header
        self._infos[name].publish(calibrated.info)
        stream.corrected += 1
        stream.latencies.add(time.time_ns() - info['received_timestamp'])
        if self._compressed[name].get_subscription_count():
            self._compressed[name].publish(compressed(out, pixels, self._format, self._quality))
            stream.compressed += 1

    # -- diagnostics

    def _on_timer(self):
        parts = []
        for name, stream in self._streams.items():
            calibrated = self._calibrations.of(name)
            values = {'images received': stream.received, 'images corrected': stream.corrected,
                      'images compressed': stream.compressed, 'images without calibration': stream.waiting,
                      'images refused': stream.refused.total(),
                      **{f'refused: {kind}': stream.refused[kind] for kind in IMAGE_KINDS},
                      'last fault': stream.last_fault,
                      'calibration': calibrated.calibration.calibration_id if calibrated else '',
                      **stream.latencies.values()}
            parts.append((name, *self._verdict(name, stream), values))
        self._diagnostics.publish(parts)

    def _verdict(self, name, stream):
        """Level and message of the diagnostics of a fluoroscope."""
        topics = [f'{name}/{topic}' for _, topic in INPUTS[self._inputs]]
        deaf = support.deafness(stream.reader, self._sentences)
        if deaf:
            return support.WARN, next(iter(deaf.values()))
        if self._calibrations.of(name) is None:
            return support.WARN, f'no calibration yet: {stream.waiting} images were not corrected'
        if stream.reader is None:
            return support.WARN, 'the node is not active'
        if not any(map(self.count_publishers, topics)):
            return support.WARN, 'nobody publishes images'
        if stream.refused:
            return support.WARN, f'{stream.refused.total()} images refused: {stream.last_fault}'
        return support.OK, 'correcting'


def main(args=None):
    """Entry point."""
    support.run(ImageNode, args)


if __name__ == '__main__':
    main()
