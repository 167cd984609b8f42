# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Recordings of Phantom cameras (cine) and DICOM files, written here by other means."""

import struct

import cv2
import numpy as np
import pydicom
import pytest
from dicom_files import dicom

from fluoro_calib_ros.errors import DataError
from fluoro_calib_ros.io.image_reading import image_suffix_of, is_image_source, open_images
from fluoro_calib_ros.io.image_writing import list_images
from fluoro_calib_ros.io.recordings import read_cine_header, read_dicom_header
from fluoro_calib_ros.jobs.image_sources import contains_images, dose_texts, open_sources

JPEG = '1.2.840.10008.1.2.4.50'


def grey(count=3, shape=(6, 8), bits=8, seed=0):
    return np.random.default_rng(seed).integers(0, 2**bits, (count, *shape))


def packed(image):
    """Return pixels of 10 bits without gaps, as one large number per row."""
    rows = []
    for row in image:
        number = 0
        for value in row:
            number = number << 10 | int(value)
        rows.append(number.to_bytes(10 * len(row) // 8, 'big'))
    return b''.join(rows)


def cine(images, bits=8, rate=500, annotation=b'', **changes):
    """Return a cine file; `changes` replace fields of its headers."""
    count, height, width = images.shape
    pixels = [
        packed(i) if bits == 10 else i[::-1].astype('<u2' if bits == 16 else 'u1').tobytes()
        for i in images
    ]
    setup = bytearray(1024)
    setup[0:2] = struct.pack('<H', min(rate, 65535))
    setup[140:144] = b'ST' + struct.pack('<H', len(setup))
    setup[768:772] = struct.pack('<I', rate)
    fields = dict(compression=0, count=count, bit_count=16 if bits > 8 else 8, height=height)
    fields |= dict(width=width, packing=256 if bits == 10 else 0) | changes
    table = 84 + len(setup)
    at = table + 8 * count
    offsets = []
    blocks = []
    for data in pixels:
        block = struct.pack('<I', 8 + len(annotation)) + annotation
        block += struct.pack('<I', len(data)) + data
        offsets.append(at)
        at += len(block)
        blocks.append(block)
    return b''.join(
        [
            b'CI' + struct.pack('<HHHiI', 44, fields['compression'], 1, 0, count),
            struct.pack('<iIIIIQ', 0, fields['count'], 44, 84, table, 0),
            struct.pack('<IiiHH', 40, fields['width'], fields['height'], 1, fields['bit_count']),
            struct.pack('<IIiiII', fields['packing'], 0, 0, 0, 0, 0),
            bytes(setup),
            struct.pack(f'<{count}q', *offsets),
            *blocks,
        ]
    )


def images_of(path):
    source = open_images(path)
    images = [image.copy() for _, image in source.images]
    assert len(images) == source.count
    return np.array(images)


@pytest.fixture
def saved(tmp_path):
    def save(content, name='trial.cine'):
        path = tmp_path / name
        path.write_bytes(content)
        return path

    return save


@pytest.mark.parametrize('bits', [8, 10, 16])
def test_cine_is_read_as_it_was_written(saved, bits):
    images = grey(bits=bits)
    path = saved(cine(images, bits, annotation=b'12345678'))
    np.testing.assert_array_equal(images_of(path), images)
    source = open_images(path)
    assert source.kind == 'video' and source.frame_rate == 500
    assert next(source.images)[1].dtype == (np.uint8 if bits == 8 else np.uint16)


def test_cine_with_a_negative_height_is_stored_from_the_top(saved):
    images = grey()
    found = images_of(saved(cine(images, height=-images.shape[1])))
    np.testing.assert_array_equal(found, images[:, ::-1])


@pytest.mark.parametrize(
    'content, reason',
    [
        (cine(grey())[:-1], 'only 2 of 3 images are in it'),
        (cine(grey())[:60], 'damaged or cut off'),
        (b'RIFF' + cine(grey())[4:], 'it does not begin with CI'),
        (cine(grey(), compression=1), 'JPEG images'),
        (cine(grey(), compression=2), 'the mosaic of a colour sensor'),
        (cine(grey(), bit_count=24), 'colours'),
        (cine(grey(), packing=1024), 'packed pixels of 12 bits'),
        (cine(grey(), count=2**31), 'it claims 2147483648 images'),
        (cine(grey(), width=2**29), '64 megapixels'),
        (cine(grey(), width=3), '48 bytes for 3 x 6 px'),
        (cine(grey(), height=-(2**31)), 'damaged: images of 8 x'),
    ],
)
def test_wrong_cine_is_refused_in_a_sentence(saved, content, reason):
    path = saved(content)
    with pytest.raises(DataError, match=reason) as refusal:
        images_of(path)
    assert str(refusal.value).startswith(str(path))


def test_every_truncated_header_of_a_cine_is_refused(saved):
    whole = cine(grey(1))
    for length in range(1, len(whole) - grey(1).size - 8, 7):
        with pytest.raises(DataError):
            read_cine_header(saved(whole[:length]))


@pytest.mark.parametrize('rle', [False, True])
@pytest.mark.parametrize('bits', [8, 12])
def test_dicom_is_read_as_it_was_written(tmp_path, rle, bits):
    frames = grey(bits=bits)
    found = images_of(dicom(tmp_path / 'loop.dcm', frames, rle))
    np.testing.assert_array_equal(found, frames)
    assert found.dtype == (np.uint8 if bits == 8 else np.uint16)


def test_dicom_monochrome1_is_inverted_and_signed_values_begin_at_zero(tmp_path):
    frames = grey(bits=12)
    path = dicom(tmp_path / 'a.dcm', frames, PhotometricInterpretation='MONOCHROME1')
    np.testing.assert_array_equal(images_of(path), 4095 - frames)
    path = dicom(tmp_path / 'b.dcm', frames - 2048)
    np.testing.assert_array_equal(images_of(path), frames)


def test_dicom_is_a_stack_or_a_video_or_an_image(tmp_path):
    assert open_images(dicom(tmp_path / 'a.dcm', grey())).kind == 'stack'
    video = open_images(dicom(tmp_path / 'b.dcm', grey(), FrameTime='4.0'))
    assert video.kind == 'video' and video.frame_rate == 250
    assert open_images(dicom(tmp_path / 'c.dcm', grey(1))).kind == 'image'


@pytest.mark.parametrize(
    'changes, reason',
    [
        ({'PhotometricInterpretation': 'PALETTE COLOR'}, 'not grey'),
        ({'SamplesPerPixel': 3}, 'not grey'),
        ({'NumberOfFrames': 10**6}, 'it claims 1000000 frames'),
        ({'Rows': 60000, 'Columns': 60000}, '64 megapixels'),
        ({'BitsStored': 7}, 'not read'),
        ({'Rows': 0}, 'no image'),
    ],
)
def test_wrong_dicom_is_refused_in_a_sentence(tmp_path, changes, reason):
    path = dicom(tmp_path / 'loop.dcm', grey(), **changes)
    with pytest.raises(DataError, match=reason) as refusal:
        images_of(path)
    assert str(refusal.value).startswith(str(path))


def test_damaged_and_compressed_dicom_is_refused(tmp_path, saved):
    whole = dicom(tmp_path / 'loop.dcm', grey(), rle=True).read_bytes()
    for content in (whole[:-40], whole[:200], b'no dicom', bytes(400)):
        with pytest.raises(DataError):
            images_of(saved(content, 'cut.dcm'))
    data = pydicom.encaps.encapsulate([bytes(50)] * 3)
    path = dicom(tmp_path / 'jpeg.dcm', grey(), syntax=JPEG, PixelData=data)
    with pytest.raises(DataError, match='compressed \\(JPEG Baseline'):
        images_of(path)


def test_recordings_are_sources_of_exposures(tmp_path, saved):
    path = saved(cine(grey()))
    assert contains_images(path)
    assert [image.exposure for image in open_sources([path]).images()] == [1, 2, 3]
    folder = tmp_path / 'a'
    folder.mkdir()
    for number in (17, 4):
        dicom(folder / f'image_{number}.dcm', grey(1))
    assert [image.exposure for image in open_sources([folder]).images()] == [4, 17]


def test_dose_is_summed_over_dicom_files(tmp_path):
    for name in ('a', 'b'):
        (tmp_path / name).mkdir()
    dicom(tmp_path / 'a' / '1.dcm', grey(1), ExposureInuAs=1500, Exposure=2)  # rounded to mAs
    dicom(tmp_path / 'a' / '2.dcm', grey(1), Exposure=3, ImageAndFluoroscopyAreaDoseProduct=0.25)
    dicom(tmp_path / 'a' / '3.dcm', grey(), XRayTubeCurrent=50, ExposureTime=10)
    dicom(tmp_path / 'b' / '1.dcm', grey(1))
    (tmp_path / 'a' / '4.dcm').write_bytes(bytes(200))
    expected = '4 DICOM files: 5 mAs in 3 of them, 0.25 dGy cm2 in 1 of them'
    assert dose_texts(tmp_path) == {'a': expected}
    assert dose_texts(tmp_path / 'a' / '1.dcm') == {'': '1 DICOM file: 1.5 mAs'}


@pytest.mark.parametrize('value', [0, -1, ''])
def test_a_dose_that_is_no_amount_is_not_told(tmp_path, value):
    path = dicom(tmp_path / '1.dcm', grey(1), ImageAndFluoroscopyAreaDoseProduct=value)
    assert read_dicom_header(path).area_dose is None


def test_missing_pydicom_is_told(tmp_path, monkeypatch):
    path = dicom(tmp_path / 'a.dcm', grey())
    monkeypatch.setitem(__import__('sys').modules, 'pydicom', None)
    with pytest.raises(DataError, match='need pydicom 3, which is not installed: pip install'):
        open_images(path)


@pytest.mark.parametrize('name', ['IM000007', '1.2.840.113619.7', 'loop.IMA'])
def test_dicom_is_recognised_by_its_content(tmp_path, name):
    frames = np.full((1, 40, 60), 7, np.uint8)
    path = dicom(tmp_path / name, frames)
    assert is_image_source(path)
    np.testing.assert_array_equal(images_of(path)[0], frames[0])


@pytest.mark.parametrize('suffix', ['.png', '.tif', '.jpg', '.bmp', '.pgm'])
def test_image_without_ending_is_recognised_by_its_content(tmp_path, suffix):
    image = np.full((40, 60), 90, np.uint8)
    cv2.imwrite(str(tmp_path / f'image{suffix}'), image)
    path = (tmp_path / f'image{suffix}').rename(tmp_path / 'image')
    assert image_suffix_of(path) == suffix
    np.testing.assert_allclose(images_of(path)[0], image, atol=1)  # JPEG is lossy


@pytest.mark.parametrize('name', ['notes', 'notes.txt', 'points.csv', 'DICOMDIR', 'folder'])
def test_other_files_are_no_images(tmp_path, name):
    """Text, the file list of a DICOM medium, and a file whose suffix denies it are no images."""
    (tmp_path / 'folder').mkdir()
    if name != 'folder':
        content = bytes(128) + b'DICM' if name == 'DICOMDIR' else b'P6 is not read'
        (tmp_path / name).write_bytes(content)
    assert image_suffix_of(tmp_path / name) == ''
    assert image_suffix_of(tmp_path / 'missing') == ''


def test_folder_of_a_scanner_is_read_in_the_order_of_its_numbers(tmp_path):
    frames = np.random.default_rng(1).integers(0, 200, (2, 40, 60)).astype(np.uint8)
    for name, frame in zip(('1.3.12.0007', '1.3.12.0012'), frames):
        dicom(tmp_path / name, frame[None])
    (tmp_path / 'notes').write_text('no image')
    (tmp_path / 'DICOMDIR').write_bytes(bytes(128) + b'DICM')
    assert contains_images(tmp_path)
    read = list(open_sources([tmp_path]).images())
    assert [one.exposure for one in read] == [7, 12]
    for one, frame in zip(read, frames):
        np.testing.assert_array_equal(one.image, frame)
    listed = list_images(tmp_path)
    assert [str(path) for path in listed.written] == ['1.3.12.0007.tif', '1.3.12.0012.tif']
    assert listed.passed_over == ('DICOMDIR', 'notes')
    with pytest.raises(DataError, match='not that of an image'):
        open_images(tmp_path / 'DICOMDIR')
