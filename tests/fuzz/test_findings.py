# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Inputs that the fuzzer found: each is refused in one sentence."""

import json
import sqlite3
import struct
import zlib

import cv2
import numpy as np
import pytest
import tifffile

from fluoro_calib_ros.errors import DataError
from fluoro_calib_ros.images.codec import decode
from fluoro_calib_ros.io.bags.reader import topics_of
from fluoro_calib_ros.io.calibration import load_orientation
from fluoro_calib_ros.io.image_reading import open_images
from fluoro_calib_ros.photogrammetry.resection import robust_dlt
from fuzz.__main__ import load
from fuzz.harness import Broken, check_message
from fuzz.seeds import SEPARATOR

pytestmark = pytest.mark.filterwarnings('error::RuntimeWarning')


def png_header(width, height):
    """Return the beginning of a PNG that declares a size."""
    chunk = b'IHDR' + struct.pack('>IIBBBBB', width, height, 8, 0, 0, 0, 0)
    return (
        b'\x89PNG\r\n\x1a\n' + struct.pack('>I', 13) + chunk + struct.pack('>I', zlib.crc32(chunk))
    )


def test_topic_of_a_bag_that_is_no_text(tmp_path):
    path = tmp_path / 'bag.db3'
    path.write_bytes(load('bag_sqlite').seeds()[0])
    with sqlite3.connect(path) as database:
        database.execute("UPDATE topics SET name = X'2F61' WHERE id = 1")
    database.close()
    with pytest.raises(DataError, match='the name of a topic is not a text'):
        topics_of(path)


def test_rotation_matrix_of_giant_numbers(tmp_path):
    target = load('orientation_npz')
    content = bytearray(target.seeds()[0])
    at = content.index(b'rotation.npy')
    start = content.index(b'\n', at + len('rotation.npy') + 1) + 1
    content[start : start + 8] = struct.pack('<d', 1e200)
    path = tmp_path / 'rig_orientation.npz'
    path.write_bytes(target.prepare(bytes(content)))
    with pytest.raises(DataError, match=r'rotation'):
        load_orientation(path)


def test_phantom_in_one_place():
    with pytest.raises(DataError, match='all targets coincide'):
        robust_dlt(np.full((20, 3), 5e-324), np.random.default_rng(0).uniform(0, 1000, (20, 2)))


def test_image_of_a_project_that_would_be_giant(tmp_path):
    target = load('xmalab_project')
    members = target.seeds()[0].split(SEPARATOR)
    members = [
        member.partition(b'\n')[0] + b'\n' + png_header(30_000, 30_000)
        if b'.png' in member.partition(b'\n')[0]
        else member
        for member in members
    ]
    (tmp_path / 'project.xma').write_bytes(target.prepare(SEPARATOR.join(members)))
    with pytest.raises(DataError, match='30000 x 30000 px, images of more than 64 megapixels'):
        target.read(tmp_path / 'project.xma')


def test_stack_whose_second_page_is_giant(tmp_path):
    with tifffile.TiffWriter(tmp_path / 'stack.tif') as writer:
        for side in (16, 10_000):
            page = np.zeros((side, side), np.uint8)
            writer.write(page, photometric='minisblack', compression='zlib', metadata=None)
    with pytest.raises(DataError, match='10000 x 10000 px, images of more than 64 megapixels'):
        open_images(tmp_path / 'stack.tif')


def test_format_that_does_not_tell_its_size():
    """WIDTH and HEIGHT of a PAM may be anything, yet OpenCV would decode it."""
    content = b'P7\nWIDTH 30000\nHEIGHT 30000\nDEPTH 1\nMAXVAL 255\nTUPLTYPE GRAYSCALE\nENDHDR\n'
    with pytest.raises(DataError, match='this is not an image that can be decoded'):
        decode(content + bytes(100))


@pytest.mark.parametrize('text', ['two\nlines', 'x' * 2000, '', 'a\x1b[2J'])
def test_property_of_messages_can_fail(text):
    with pytest.raises(Broken):
        check_message(text)


def test_video_without_a_pixel_format(tmp_path):
    """OpenCV returns -1 as the pixel format."""
    path = tmp_path / 'trial.mp4'
    path.write_bytes(load('video').seeds()[1].replace(b'mvhd', b'xvhd'))
    assert cv2.VideoCapture(str(path)).get(cv2.CAP_PROP_CODEC_PIXEL_FORMAT) == -1
    with pytest.raises(DataError, match='0 of 3 frames can be read'):
        list(open_images(path).images)


def test_giant_numbers_in_a_result(tmp_path):
    target = load('result_folder')
    document = json.loads(target.seeds()[0])
    document['targets'][0]['xyz_mm'][0] = 1e300
    path = tmp_path / target.file_name
    path.write_text(json.dumps(document))
    with pytest.raises(DataError, match='this is not the result of a calibration'):
        target.read(path)
