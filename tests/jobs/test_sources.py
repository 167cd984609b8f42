# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What a path is, for each job that reads a source: what the job accepts and how it refuses."""

import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from dicom_files import dicom

from fluoro_calib_ros.errors import DataError
from fluoro_calib_ros.images.codec import encode
from fluoro_calib_ros.io.bags.mcap_file import is_bag
from fluoro_calib_ros.io.bags.metadata import TARGET_OBSERVATIONS, message_class, to_cdr
from fluoro_calib_ros.io.bags.reader import COMPRESSED_IMAGE, IMAGE, iterate_messages
from fluoro_calib_ros.io.bags.writer import BagWriter
from fluoro_calib_ros.io.formats.content import FileSettings
from fluoro_calib_ros.jobs.conversion import ConversionRequest, convert, is_result_folder
from fluoro_calib_ros.jobs.image_sources import contains_images, is_image_bag, open_sources
from fluoro_calib_ros.jobs.sources import read_source

BAGS = Path(__file__).resolve().parents[2] / 'bags'
GREY = np.full((40, 60), 90, np.uint8)
READ = ''  # stands for a source that is read
NO_BAG = 'this folder is not a bag'
NO_MISSING_BAG = 'there is no such bag'
NO_CAMERAS = 'the folder has no file of cameras'
NO_IMAGES = 'there are no images in this folder'
NO_ENDING = 'is not that of an image or a video'
UNKNOWN = 'the format is not known'
NO_TOPIC = 'the bag has no topic of type'
CUT = 'the bag is cut off'

# By source: the messages when it is read as image points, converted, and read as images.
SAID = {
    'images': (NO_BAG, NO_CAMERAS, READ),
    'images/1.png': (UNKNOWN, UNKNOWN, READ),
    'rig': (NO_BAG, NO_CAMERAS, NO_IMAGES),
    'dicom': (NO_BAG, NO_CAMERAS, READ),
    'dicom/IM0001': (UNKNOWN, UNKNOWN, READ),
    'bag': (READ, READ, NO_IMAGES),
    'bag/calibration_0.mcap': (READ, READ, NO_ENDING),
    'bag_without_metadata': (READ, READ, NO_IMAGES),
    'bag_without_ending': (READ, READ, NO_ENDING),
    'bag.other': (READ, READ, NO_ENDING),
    'cut.mcap': (CUT, CUT, CUT),
    'radiographs': (NO_TOPIC, NO_TOPIC, READ),
    'radiographs/radiographs_0.mcap': (NO_TOPIC, NO_TOPIC, READ),
    'radiographs_without_metadata': (NO_TOPIC, NO_TOPIC, READ),
    'both': (READ, READ, READ),
    'result': (NO_BAG, READ, NO_IMAGES),  # its conversion is tested in test_conversion.py
    'result/a.calibration.npz': (UNKNOWN, UNKNOWN, NO_ENDING),
    'points.csv': (READ, READ, NO_ENDING),
    'points': (READ, READ, NO_ENDING),
    'foreign.csv': ('which has a phantom, but image points', 'too few', NO_ENDING),
    'notes.txt': (UNKNOWN, UNKNOWN, NO_ENDING),
    'notes': (UNKNOWN, UNKNOWN, NO_ENDING),
    'empty.csv': ('the file is empty', 'the file is empty', NO_ENDING),
    'empty': (NO_BAG, NO_CAMERAS, NO_IMAGES),
    'missing': (NO_MISSING_BAG, NO_MISSING_BAG, NO_MISSING_BAG),
    'missing.mcap': (NO_MISSING_BAG, NO_MISSING_BAG, NO_MISSING_BAG),
    'missing.csv': ('there is no such file', 'there is no such file', NO_ENDING),
}
# Sources from which a calibration extracts beads.
EXTRACTED = (
    *('images', 'images/1.png', 'rig', 'dicom', 'dicom/IM0001', 'radiographs'),
    *('radiographs/radiographs_0.mcap', 'radiographs_without_metadata'),
)
BAG_NAMES = ('bag', 'cut', 'radiographs', 'both', 'missing')


@pytest.fixture(scope='module')
def folder(tmp_path_factory):
    """All of these sources; the result folder has a calibration that cannot be read."""
    out = tmp_path_factory.mktemp('sources')
    for name in ('images', 'rig', 'rig/a', 'dicom', 'result', 'empty'):
        (out / name).mkdir()
    for place in ('images/1.png', 'rig/a/1.png'):
        cv2.imwrite(str(out / place), GREY)
    dicom(out / 'dicom' / 'IM0001', GREY[None])
    _write_bags(out)
    shutil.copy(BAGS / 'calibration.csv', out / 'points.csv')
    shutil.copy(BAGS / 'calibration.csv', out / 'points')
    (out / 'foreign.csv').write_text('x,y,z\n1,2,3\n')
    (out / 'notes.txt').write_text('hello')
    (out / 'notes').write_text('hello')
    (out / 'empty.csv').write_text('')
    np.savez(out / 'result' / 'a.calibration.npz')
    return out


def _write_bags(out):
    """Write bags of observations, of images and of both, intact and damaged."""
    shutil.copytree(BAGS / 'calibration', out / 'bag')
    mcap = out / 'bag' / 'calibration_0.mcap'
    for name in ('bag_without_ending', 'bag.other'):
        shutil.copy(mcap, out / name)
    (out / 'cut.mcap').write_bytes(mcap.read_bytes()[:5000])
    time = message_class('builtin_interfaces/msg/Time')(1, 0)
    image = message_class(COMPRESSED_IMAGE)(
        header=message_class('std_msgs/msg/Header')(time, 'a'),
        format='png',
        data=np.frombuffer(encode(GREY, '.png'), np.uint8),
    )
    for name in ('radiographs', 'both'):
        with BagWriter(out / name) as bag:
            data = to_cdr(image, COMPRESSED_IMAGE)
            bag.write('/a/image_raw/compressed', COMPRESSED_IMAGE, data, 10**9)
            for message in iterate_messages(out / 'bag') if name == 'both' else ():
                bag.write(message.topic, TARGET_OBSERVATIONS, message.data, message.log_time_ns)
    for name in ('bag', 'radiographs'):
        shutil.copytree(out / name, out / f'{name}_without_metadata')
        (out / f'{name}_without_metadata' / 'metadata.yaml').unlink()


def said(job):
    """Return the message with which a job refuses a source, or READ."""
    try:
        job()
    except DataError as error:
        return str(error)
    return READ


def first_image(path):
    """Read the first image of a source."""
    image = next(open_sources([path], 'a').images()).image
    if isinstance(image, DataError):
        raise image


@pytest.mark.parametrize('source', SAID)
def test_every_job_reads_a_source_or_says_why_not(folder, tmp_path, source):
    points, conversion, images = SAID[source]
    path = folder / source
    size = (1024, 1024)
    answers = [
        (points, said(lambda: read_source(path, image_size=size))),
        (images, said(lambda: first_image(path))),
    ]
    if source != 'result':  # its calibration cannot be read
        request = ConversionRequest(
            path, 'observations', tmp_path / 'out.csv', settings=FileSettings(image_size=size)
        )
        answers.append((conversion, said(lambda: convert(request))))
    for expected, answer in answers:
        assert expected in answer and bool(expected) == bool(answer)


@pytest.mark.parametrize('source', SAID)
def test_beads_are_extracted_of_images_that_have_no_observations(folder, source):
    assert contains_images(folder / source) == (source in EXTRACTED)


@pytest.mark.parametrize('source', SAID)
def test_bags_and_result_folders_are_told_by_what_they_hold(folder, source):
    path = folder / source
    bag = source.startswith(BAG_NAMES) and source != 'missing.csv'
    assert is_bag(path) == bag
    assert is_result_folder(path) == (source == 'result')
    if not source.startswith(('missing', 'cut')):
        assert is_image_bag(path) == source.startswith(('radiographs', 'both'))


@pytest.mark.parametrize('late_ns', [0, 300_000_000])
def test_images_of_a_bag_are_numbered_by_stamp(tmp_path, late_ns):
    """A lost image of one fluoroscope shifts no exposure, also in further bags; as live."""
    header = message_class('std_msgs/msg/Header')
    time = message_class('builtin_interfaces/msg/Time')

    def write(bag, name, moment, stamp):
        pixels = np.full(4, moment, np.uint8)
        stamp = time(stamp, late_ns * (name == 'b'))
        image = message_class(IMAGE)(header(stamp, ''), 2, 2, 'mono8', 0, 2, pixels)
        bag.write(f'/{name}/image_raw', IMAGE, image, 10**9 * moment + (name == 'b'))

    for number in (0, 1):
        with BagWriter(tmp_path / f'bag{number}') as bag:
            for moment in range(1, 5):
                for name in 'ab':
                    if (name, moment) not in {('b', 2), ('b', 4)}:
                        write(bag, name, moment + 4 * number, 100 * number + moment)
    bags = [tmp_path / 'bag0', tmp_path / 'bag1']
    for name in 'ab':
        images = list(open_sources(bags, name).images())
        assert [image.exposure for image in images] == [int(image.image[0, 0]) for image in images]
        assert len(images) == (8 if name == 'a' else 4)


def test_images_of_a_bag_without_stamps_are_numbered_by_order(tmp_path):
    header = message_class('std_msgs/msg/Header')
    stamp = message_class('builtin_interfaces/msg/Time')(0, 0)
    image = message_class(IMAGE)(header(stamp, ''), 1, 1, 'mono8', 0, 1, np.zeros(1, np.uint8))
    with BagWriter(tmp_path / 'bag') as bag:
        for moment in range(1, 4):
            bag.write('/a/image_raw', IMAGE, image, moment)
            bag.write('/b/image_raw', IMAGE, image, moment)
    for name in 'ab':
        images = open_sources([tmp_path / 'bag'], name).images()
        assert [image.exposure for image in images] == [1, 2, 3]
