# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The image node: images of all kinds are corrected, invalid ones counted; calibrations change."""

from array import array
from dataclasses import replace

import cv2
import numpy as np
import pytest
from fluoro_calib_msgs.msg import FluoroscopeCalibration
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from rclpy.qos import qos_profile_sensor_data
from rclpy.serialization import serialize_message
from sensor_msgs.msg import CameraInfo, CompressedImage, Image

from benchmarks.bead_images import bead_image
from fluoro_calib_ros.correction.registry import no_correction
from fluoro_calib_ros.images.codec import decode, encode
from fluoro_calib_ros.images.corrector import ImageCorrector
from fluoro_calib_ros.io.calibration import load_calibrations
from fluoro_calib_ros.nodes.messages.fluoroscope_calibration import (
    message_from_calibration,
    message_of_corrected_stream,
)
from fluoro_calib_ros.nodes.messages.observations import stamp_from_nanoseconds
from fluoro_calib_ros.nodes.runtime.topics import images_qos, latched_qos

SIZE = (1024, 1024)
DEPTHS = {'mono8': np.uint8, 'mono16': np.uint16}


@pytest.fixture(scope='module')
def pictures(exposures):
    """Images of the phantom in fluoroscope a, by encoding."""
    return {name: bead_image(exposures['a'][0].uv, SIZE, dtype) for name, dtype in DEPTHS.items()}


class Eyes:
    """What a client sends to the image node and receives from it, for fluoroscope a."""

    def __init__(self, graph):
        self.client = graph.client
        self.number = 0
        self.raw = self.client.create_publisher(Image, 'a/image_raw', images_qos())
        self.compressed = self.client.create_publisher(
            CompressedImage, 'a/image_raw/compressed', images_qos()
        )
        self.images = []
        self.infos = []
        self.beside = []  # CameraInfo on the topic where image_transport looks for it
        self.small = []
        self.client.create_subscription(
            Image, 'a/image_corrected', self.images.append, images_qos()
        )
        self.client.create_subscription(
            CameraInfo, 'a/image_corrected/camera_info', self.infos.append, images_qos()
        )
        # With the quality of service that a CameraSubscriber requests.
        self.client.create_subscription(
            CameraInfo, 'a/camera_info', self.beside.append, qos_profile_sensor_data
        )

    def connected(self):
        """Return whether all topics are connected."""
        return (
            self.raw.get_subscription_count()
            and self.compressed.get_subscription_count()
            and self.client.count_publishers('a/image_corrected/camera_info')
            and self.client.count_publishers('a/camera_info')
        )

    def stamped(self, message):
        """Give a message a unique stamp and return the message."""
        self.number += 1
        message.header.stamp = stamp_from_nanoseconds(10**18 + self.number)
        message.header.frame_id = 'a_optical'
        return message

    def message(self, image, encoding='mono8'):
        """Return the Image message of an array."""
        return self.stamped(
            Image(
                height=image.shape[0],
                width=image.shape[1],
                encoding=encoding,
                step=image.shape[1] * image.itemsize,
                data=array('B', image.tobytes()),
            )
        )

    def answer(self, publisher, message):
        """Return the Image and CameraInfo that the node publishes for a message."""
        publisher.publish(message)
        stamp = message.header.stamp
        found = [None, None]

        def both():
            for place, collected in enumerate((self.images, self.infos)):
                found[place] = next((m for m in collected if m.header.stamp == stamp), None)
            return all(found)

        self.client.wait_until(both, what='the corrected image and its CameraInfo')
        self.images.clear()
        self.infos.clear()
        return found

    def diagnostics(self, condition, what='a diagnostic'):
        """Return the values of fluoroscope a once they fulfil condition(values, status)."""

        def values(status):
            return {v.key: v.value for v in status.values}

        return values(
            self.client.wait_for_diagnostics(
                'image_node', lambda s: condition(values(s), s), what=what
            )
        )


def pixels_of(message):
    """Return the array of an Image message."""
    return np.frombuffer(message.data, DEPTHS[message.encoding]).reshape(
        message.height, message.width
    )


@pytest.fixture(scope='module')
def eyes(module_graph, by_command):
    """The image node with a calibration that a calibration node has published."""
    module_graph.fork = False
    module_graph.calibration_node(by_command, wait=False)
    module_graph.client.expect(ChangeState, 'image_node/change_state')
    module_graph.node = module_graph.start('image_node', {'fluoroscopes': '[a]'})
    eyes = Eyes(module_graph)
    eyes.calibration = load_calibrations(by_command)['a']
    eyes.corrector = ImageCorrector(eyes.calibration)
    eyes.node = module_graph.node
    eyes.client.wait_until(eyes.connected, what='the image node')
    eyes.client.wait_until_known_to('image_node')
    eyes.diagnostics(lambda v, _: v['calibration'] == eyes.calibration.calibration_id)
    return eyes


# ---- valid images


@pytest.mark.parametrize('encoding', DEPTHS)
@pytest.mark.parametrize('kind', ['raw', 'padded', 'other end first', 'compressed'])
def test_image_is_corrected_as_by_the_corrector(eyes, pictures, encoding, kind):
    """The pixels are those of ImageCorrector, the header that of the input."""
    image = pictures[encoding]
    message = eyes.message(image, encoding)
    if kind == 'padded':
        step = message.step + 24
        rows = np.full((1024, step), 0xAA, np.uint8)
        rows[:, : message.step] = image.view(np.uint8).reshape(1024, -1)
        message.step = step
        message.data = array('B', rows.tobytes())
    elif kind == 'other end first':
        message.is_bigendian = 1
        message.data = array('B', image.astype(image.dtype.newbyteorder('>')).tobytes())
    elif kind == 'compressed':
        message = eyes.stamped(
            CompressedImage(
                format=f'{encoding}; png compressed {encoding}',
                data=array('B', encode(image, '.png')),
            )
        )
    out, info = eyes.answer(eyes.compressed if kind == 'compressed' else eyes.raw, message)
    assert np.array_equal(pixels_of(out), eyes.corrector.correct(image))
    assert out.encoding == encoding and out.step == 1024 * image.itemsize and not out.is_bigendian
    assert out.header == info.header == message.header
    wanted = message_of_corrected_stream(eyes.calibration, message.header.stamp)
    assert info == wanted and info.k[0] == eyes.calibration.interior[2] and not any(info.d)
    eyes.client.wait_until(lambda: wanted in eyes.beside, what='the CameraInfo beside the image')


def test_images_are_compressed_for_subscribers_only(eyes, pictures):
    """The node compresses only while there are subscribers, by format and depth of the pixels."""
    assert eyes.diagnostics(lambda v, _: True)['images compressed'] == '0'
    small = eyes.small
    eyes.client.create_subscription(
        CompressedImage, 'a/image_corrected/compressed', small.append, images_qos()
    )
    eyes.client.wait_until(lambda: eyes.client.count_publishers('a/image_corrected/compressed'))

    def compressed():
        message = eyes.message(pictures['mono8'])
        eyes.answer(eyes.raw, message)
        return small

    eyes.client.wait_until(
        compressed, what='the first compressed image: the node has found its listener'
    )
    for encoding in DEPTHS:
        small.clear()
        message = eyes.message(pictures[encoding], encoding)
        eyes.answer(eyes.raw, message)
        eyes.client.wait_until(
            lambda: any(m.header == message.header for m in small), what='a compressed image'
        )
        assert small[-1].format == f'{encoding}; png compressed {encoding}'
        assert np.array_equal(decode(small[-1].data), eyes.corrector.correct(pictures[encoding]))


# ---- invalid images


def changed(**fields):
    """Return a function that changes fields of an Image message."""

    def change(message):
        for name, value in fields.items():
            setattr(message, name, value(message) if callable(value) else value)
        return message

    return change


def of_array(image):
    """Return a PNG of an image."""
    return array('B', cv2.imencode('.png', image)[1].tobytes())


BAD = {  # change of the message, kind, what is reported
    'colours': (changed(encoding='rgb8'), 'encoding', "encoding 'rgb8' is not mono8 or mono16"),
    'no encoding': (changed(encoding=''), 'encoding', "encoding '' is not"),
    'another size': (
        changed(width=512, step=512, data=lambda m: m.data[: 512 * 1024]),
        'image size',
        'the image is 512 x 1024 px, but the calibration is for 1024 x 1024 px',
    ),
    'too little data': (
        changed(data=lambda m: m.data[:-1]),
        'image size',
        '1048575 bytes in rows of 1024',
    ),
    'too much data': (
        changed(data=lambda m: m.data + array('B', [0])),
        'image size',
        '1048577 bytes in rows of 1024',
    ),
    'short rows': (changed(step=1000), 'image size', 'in rows of 1000'),
    'no size': (
        changed(width=0, height=0, step=0, data=array('B')),
        'image size',
        '0 bytes in rows of 0',
    ),
    'mono16 in half of its bytes': (
        changed(encoding='mono16'),
        'image size',
        '1024 x 1024 px of mono16',
    ),
    'of another fluoroscope': (
        lambda m: (setattr(m.header, 'frame_id', 'b_optical'), m)[1],
        'frame id',
        'the frame id is b_optical',
    ),
}
GREY = np.arange(1024 * 1024, dtype=np.uint32).reshape(1024, 1024).astype(np.uint8)
BAD_COMPRESSED = {
    'empty': (array('B'), 'damaged', 'it has no data'),
    'no image': (array('B', b'this is no image'), 'damaged', 'not an image that can be decoded'),
    'cut off': (of_array(GREY)[:-100], 'damaged', 'the PNG image is cut off'),
    'cut off jpeg': (array('B', encode(GREY, '.jpg'))[:-100], 'damaged', 'damaged'),
    'in colours': (
        of_array(np.stack([GREY, GREY.T, GREY], axis=-1)),
        'encoding',
        'this is a colour image',
    ),
    'small': (of_array(GREY[:10]), 'image size', 'the image is 1024 x 10 px'),
}


@pytest.fixture(scope='module')
def after_bad_ones(eyes):
    """The eyes after all invalid images, each followed by a valid one."""
    for change, _, _ in BAD.values():
        message = change(eyes.message(GREY))
        eyes.raw.publish(message)
        eyes.answer(eyes.raw, eyes.message(GREY))
    for data, _, _ in BAD_COMPRESSED.values():
        eyes.compressed.publish(eyes.stamped(CompressedImage(format='a format', data=data)))
        eyes.answer(
            eyes.compressed, eyes.stamped(CompressedImage(format='png', data=of_array(GREY)))
        )
    for publisher, message in (
        (eyes.raw, eyes.message(GREY)),
        (eyes.compressed, eyes.stamped(CompressedImage(format='png', data=of_array(GREY)))),
    ):
        publisher.publish(serialize_message(message)[:500])  # truncated: not a valid message
        eyes.answer(publisher, eyes.message(GREY) if publisher is eyes.raw else message)
    return eyes


@pytest.mark.parametrize('fault', [*BAD, *BAD_COMPRESSED])
def test_bad_image_is_reported_in_one_sentence(after_bad_ones, fault):
    _, _, sentence = {**BAD, **BAD_COMPRESSED}[fault]
    lines = [line for line in after_bad_ones.node.log.splitlines() if sentence in line]
    assert lines and all(
        'image refused: fluoroscope a, image of 1000000000.0' in line for line in lines
    )


def test_bad_images_are_counted_by_kind(after_bad_ones):
    kinds = [kind for _, kind, _ in (*BAD.values(), *BAD_COMPRESSED.values())] + [
        'undecodable'
    ] * 2
    # Diagnostics may be published while the last image is being corrected.
    values = after_bad_ones.diagnostics(
        lambda v, s: (
            f'{len(kinds)} images refused' in s.message
            and s.level == b'\1'
            and int(v['images received']) == int(v['images corrected']) + len(kinds)
        ),
        what='diagnostics in which all images are corrected or refused',
    )
    for kind in set(kinds):
        assert values[f'refused: {kind}'] == str(kinds.count(kind))
    assert float(values['latency p50 [ms]']) > 0
    assert after_bad_ones.node.running and 'Traceback' not in after_bad_ones.node.log


def test_lifecycle(after_bad_ones, pictures):
    """An inactive node corrects nothing; reconfigured, it receives the latched calibration."""
    eyes = after_bad_ones
    image = pictures['mono8']

    def change(transition):
        return eyes.client.call(
            ChangeState, 'image_node/change_state', transition=Transition(id=transition)
        ).success

    assert change(Transition.TRANSITION_DEACTIVATE)
    eyes.client.wait_until(lambda: not eyes.raw.get_subscription_count(), what='no subscription')
    eyes.diagnostics(lambda v, s: s.message == 'the node is not active')
    assert change(Transition.TRANSITION_CLEANUP)
    eyes.client.wait_until(
        lambda: not eyes.client.count_publishers('a/image_corrected'), what='no publisher'
    )
    assert change(Transition.TRANSITION_CONFIGURE) and change(Transition.TRANSITION_ACTIVATE)
    eyes.client.wait_until(eyes.connected, what='the image node')
    eyes.client.wait_until_known_to('image_node')
    values = eyes.diagnostics(lambda v, s: v['calibration'] and v['images received'] == '0')
    assert values['images refused'] == '0'
    out, _ = eyes.answer(eyes.raw, eyes.message(image))
    assert np.array_equal(pixels_of(out), eyes.corrector.correct(image))


# ---- calibrations


def test_calibrations_change_between_two_images(graph, by_command, pictures):
    """Each image is corrected with one calibration; an invalid calibration changes nothing."""
    graph.start('image_node', {'fluoroscopes': '[a]'})
    eyes = Eyes(graph)
    image = pictures['mono8']
    latched = eyes.client.create_publisher(FluoroscopeCalibration, 'a/calibration', latched_qos())
    eyes.client.wait_until(
        lambda: eyes.connected() and latched.get_subscription_count(), what='the image node'
    )
    eyes.client.wait_until_known_to('image_node')
    first = load_calibrations(by_command)['a']
    second = replace(first, model=no_correction(), train_exposure=np.zeros(0, dtype=np.int64))
    results = [ImageCorrector(c).correct(image).tobytes() for c in (first, second)]
    stream = eyes.client.create_timer(0.05, lambda: eyes.raw.publish(eyes.message(image)))
    eyes.diagnostics(
        lambda v, s: int(v['images without calibration']) > 0 and 'no calibration yet' in s.message
    )
    assert not eyes.images and not eyes.infos
    for calibration, result in zip((first, second), results):
        latched.publish(message_from_calibration(calibration))
        eyes.client.wait_until(
            lambda: eyes.images and eyes.images[-1].data.tobytes() == result,
            what='the calibration',
        )
    wrong = message_from_calibration(first)
    wrong.xp += 1.0
    latched.publish(wrong)
    values = eyes.diagnostics(lambda v, _: 'does not match its id' in v['last fault'])
    eyes.client.destroy_timer(stream)
    assert values['calibration'] == second.calibration_id
    came = [results.index(message.data.tobytes()) for message in eyes.images]  # raises if no match
    assert came == sorted(came) and set(came) == {0, 1}


def test_invalid_parameters_are_refused(graph):
    """The node does not start and gives the reason."""
    wrong = {
        'interpolation': ('nearest', 'parameter interpolation must be one of linear, cubic'),
        'inputs': ('none', 'parameter inputs must be one of raw, compressed, both'),
        'compressed_format': ('gif', 'parameter compressed_format must be one of png, jpeg'),
        'jpeg_quality': (0, 'parameter jpeg_quality'),
    }
    processes = [
        graph.start('image_node', {name: value}, wait=False) for name, (value, _) in wrong.items()
    ]
    for process, (_, sentence) in zip(processes, wrong.values()):
        assert process.wait() == 1 and sentence in process.log and 'Traceback' not in process.log
