# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Node that removes the distortion from the images of the fluoroscopes, live.

Each fluoroscope has its own thread, which receives and corrects its images. The slow steps (the
remap and the copies into and out of DDS) run in parallel as far as Python's lock allows. The
thread also receives the joint states that give the angle of the C-arm.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial

from builtin_interfaces.msg import Time
from sensor_msgs.msg import CameraInfo, CompressedImage, Image

from ..correction.fluoroscope_calibration import FluoroscopeCalibration
from ..exposures.angles import AngleOptions
from ..exposures.stamps import nanoseconds_from_stamp
from ..images.angle_maps import AngleMaps
from ..images.corrector import INTERPOLATIONS
from ..options import option
from .angle_input import AngleInput
from .correcting_node import CorrectedStream, CorrectingNode
from .messages.fluoroscope_calibration import message_of_corrected_stream
from .messages.image import (
    COMPRESSIONS,
    IMAGE_REFUSALS,
    ImageConverter,
    compressed_message,
    use_single_thread,
)
from .runtime.diagnostics import Refused
from .runtime.lifecycle import stream_faults
from .runtime.main import run
from .runtime.parameters import CalibratedParameters, group, parameters_of_managed
from .runtime.topics import images_qos, latched_qos

RAW = (Image, 'image_raw')
COMPRESSED = (CompressedImage, 'image_raw/compressed')
INPUTS = {'raw': (RAW,), 'compressed': (COMPRESSED,), 'both': (RAW, COMPRESSED)}
CORRECTED = 'image_corrected'


@dataclass(frozen=True)
class ImageParameters(CalibratedParameters):
    """Parameters of the image node."""

    interpolation: str = option(
        'linear',
        'interpolation between pixels of the observed image; cubic is sharper and slower',
        choices=INTERPOLATIONS,
    )
    inputs: str = option(
        'both',
        'topics to subscribe to; of a camera that offers both, choose one',
        choices=INPUTS,
    )
    compressed_format: str = option(
        'png',
        'format of compressed corrected images; png is lossless, and used for 16 bits always',
        choices=COMPRESSIONS,
    )
    jpeg_quality: int = option(95, 'quality of jpeg images', minimum=1, maximum=100)


@dataclass(frozen=True)
class ImageSettings:
    """Parameter values by group."""

    node: ImageParameters = group(ImageParameters, settable=('compressed_format', 'jpeg_quality'))
    angles: AngleOptions = group(AngleOptions)


PARAMETERS = parameters_of_managed(ImageSettings)


class _PreparedCalibration:
    """Calibration with its pixel maps."""

    def __init__(self, calibration: FluoroscopeCalibration, interpolation: str) -> None:
        calibration.prepare()
        self.calibration = calibration
        self.maps = AngleMaps(calibration, interpolation)
        # The header is replaced by that of each image.
        self.info = message_of_corrected_stream(calibration, Time())


@dataclass
class CorrectedImages(CorrectedStream):
    """Stream of images to correct."""

    compressed: int = 0

    def __post_init__(self) -> None:
        self.converter = ImageConverter(self.name)


class ImageNode(CorrectingNode):
    """Publishes corrected images and their CameraInfo, none before the first calibration."""

    item = 'image'
    subject = 'images'
    refusal_kinds = IMAGE_REFUSALS
    beyond = 'the correction of the images is extrapolated'
    stream_kind = CorrectedImages

    def __init__(self) -> None:
        super().__init__('image_node', ImageSettings)
        self._inputs = INPUTS[self.settings.node.inputs]
        self.topics = tuple(topic for _, topic in self._inputs)
        use_single_thread()

    def make_angles(self) -> dict[str, AngleInput]:
        """Return an AngleInput for each fluoroscope, as each has its own thread."""
        return {
            name: AngleInput(self.settings.angles, self.names, self.limited_logger)
            for name in self.names
        }

    def create_outputs(self) -> None:
        """Create the outputs and subscribe to calibrations."""
        outputs = self.create_outputs_of
        self._images = outputs(Image, CORRECTED, images_qos)
        self._compressed = outputs(CompressedImage, f'{CORRECTED}/compressed', images_qos)
        # image_transport looks for the CameraInfo in the namespace of the image. The correction
        # node publishes there, too, with latched QoS, and subscribers request that.
        sibling_infos = outputs(CameraInfo, 'camera_info', latched_qos)
        nested_infos = outputs(CameraInfo, f'{CORRECTED}/camera_info', images_qos)
        self._infos = {name: (sibling_infos[name], nested_infos[name]) for name in self.names}
        self.subscribe_calibrations()

    def create_readers(self) -> None:
        """Receive the images of each fluoroscope in its own thread."""
        for name, angles in self.angles.items():
            reader = angles.create_reader(self, stream_faults(self.streams, self.fail))
            for kind, topic in self._inputs:
                reader.subscribe(
                    kind,
                    f'{name}/{topic}',
                    partial(self._on_image, name),
                    images_qos(),
                )

    def prepare(self, calibration: FluoroscopeCalibration) -> _PreparedCalibration:
        """Return the calibration with its pixel maps."""
        return _PreparedCalibration(calibration, self.settings.node.interpolation)

    def on_calibration_ready(self, name: str, prepared: _PreparedCalibration) -> None:
        """Log that a calibration is in use."""
        empty_pixels = int((~prepared.maps.mean.mask).sum())
        self.get_logger().info(
            f'fluoroscope {name}: calibration {prepared.calibration.calibration_id} in use '
            f'({empty_pixels} pixels of the corrected image are empty)'
        )

    def extra_values(
        self, stream: CorrectedImages, prepared: _PreparedCalibration | None
    ) -> dict[str, object]:
        """Return further values for the diagnostics of a fluoroscope."""
        return {
            'images compressed': stream.compressed,
            'calibration': prepared.calibration.calibration_id if prepared else '',
            'maps made for angles': prepared.maps.built if prepared else 0,
        }

    def _on_image(
        self, name: str, message: Image | CompressedImage, info: Mapping[str, int]
    ) -> None:
        """Correct an image and publish it."""
        stream = self.streams[name]
        stream.received += 1
        prepared = self.prepared(name)
        if prepared is None:
            stream.waiting += 1
            return
        try:
            image, encoding = stream.converter.to_array(message, prepared.calibration)
        except Refused as error:
            stream.refusals.refuse(error)
            return
        corrected, pixels = stream.converter.prepare_output(message.header, encoding, image.shape)
        stamp_ns = nanoseconds_from_stamp(message.header.stamp)
        angle = self.angle_of(name, stamp_ns, prepared.calibration.angle_field)
        prepared.maps.at(angle).correct(image, pixels)
        self._images[name].publish(corrected)  # copies the image
        prepared.info.header = message.header
        for output in self._infos[name]:
            output.publish(prepared.info)
        stream.count_corrected(info)
        if self._compressed[name].get_subscription_count():
            self._compressed[name].publish(
                compressed_message(
                    corrected,
                    pixels,
                    self.settings.node.compressed_format,
                    self.settings.node.jpeg_quality,
                )
            )
            stream.compressed += 1


main = partial(run, ImageNode)

if __name__ == '__main__':
    main()
