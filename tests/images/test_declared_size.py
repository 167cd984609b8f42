# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The declared size of an image is read without decoding anything."""

import struct
import zlib

import cv2
import numpy as np
import pytest
import tifffile

from fluoro_calib_ros.errors import DataError
from fluoro_calib_ros.images.codec import declared_size, decode
from fluoro_calib_ros.io.image_reading import open_images

SIZE = (37, 23)
IMAGE = np.arange(SIZE[0] * SIZE[1], dtype=np.uint8).reshape(SIZE[::-1])


@pytest.mark.parametrize('suffix', ['.png', '.jpg', '.bmp', '.pgm', '.tif'])
def test_declared_size_is_that_of_the_image(suffix):
    content = cv2.imencode(suffix, IMAGE)[1].tobytes()
    assert declared_size(memoryview(content)) == SIZE
    # Content cut off anywhere raises no error and declares no other size.
    for end in range(len(content)):
        assert declared_size(memoryview(content[:end])) in (SIZE, (SIZE[0], 0), (0, 0))


def test_comments_of_pgm_are_passed_over():
    assert declared_size(memoryview(b'P5\n# by a camera\n37 23\n255\n' + bytes(851))) == SIZE


def test_sizes_beyond_the_limit_are_refused(tmp_path):
    def png(width, height):
        def chunk(kind, data):
            body = kind + data
            return struct.pack('>I', len(data)) + body + struct.pack('>I', zlib.crc32(body))

        header = struct.pack('>IIBBBBB', width, height, 8, 0, 0, 0, 0)
        rows = zlib.compress(bytes(10_000))
        parts = chunk(b'IHDR', header) + chunk(b'IDAT', rows) + chunk(b'IEND', b'')
        return b'\x89PNG\r\n\x1a\n' + parts

    bmp = bytearray(cv2.imencode('.bmp', IMAGE)[1].tobytes())
    bmp[18:26] = struct.pack('<ii', 30_000, -30_000)
    for content in (
        png(32_767, 32_767),
        png(2**31 - 1, 1),
        bytes(bmp),
        b'P5 20000 20000 255\n' + bytes(1000),
    ):
        with pytest.raises(DataError, match='images of more than 64 megapixels are not read'):
            decode(content)
    path = tmp_path / 'giant.tif'
    tifffile.imwrite(path, shape=(20_000, 20_000), dtype=np.uint8)
    with pytest.raises(DataError, match=r'giant\.tif: the image is 20000 x 20000 px'):
        open_images(path)
