# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Recordings of other devices: radiographs in DICOM files, cine files of Phantom cameras.

DICOM files contain radiographs or cine loops: grey, uncompressed or run-length encoded (RLE).
pydicom (extra dicom) reads and decodes them frame by frame; sizes in the header are checked first.
Grey values increase with brightness: MONOCHROME1, in which they decrease, is inverted (PS3.3,
C.7.6.3.1.2). Signed values are shifted to start at zero.

Cine files are recordings of Phantom high-speed cameras, uncompressed and grey. The layout is that
of the manufacturer's description "Cine file format" (Vision Research), little endian throughout: a
file header (44 bytes), a BITMAPINFOHEADER (40 bytes), a SETUP with the frame rate, and a table of
64-bit offsets, one an image. The pixels of an image are preceded by an annotation, whose size
includes its own eight bytes, and by the size of the pixels. Rows of 8 and 16 bits are stored from
the bottom, as in a BMP file, unless the height is negative; packed rows of 10 bits from the top.
Grey values are returned as stored: packed ones follow the camera's curve and are not linear.
"""

from __future__ import annotations

import math
import os
import struct
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from ..errors import DataError, ErrorsAt
from ..images.codec import check_size
from ..limits import MAX_FRAMES
from .access import opened, os_errors

# Supported transfer syntaxes (PS3.5, annex A): implicit and explicit little endian, explicit big
# endian, RLE. Deflated files are refused, as their decompressed size is unbounded.
NATIVE = ('1.2.840.10008.1.2', '1.2.840.10008.1.2.1', '1.2.840.10008.1.2.2')
RUN_LENGTHS = '1.2.840.10008.1.2.5'
DICOM_GREY = ('MONOCHROME1', 'MONOCHROME2')


@dataclass(frozen=True)
class DicomHeader:
    """Content of the header of a DICOM file."""

    count: int  #: number of frames
    bits: int  #: bits used of a pixel
    #: whether grey values can be negative, and whether they decrease with brightness
    signed: bool
    inverted: bool
    shape: tuple[int, int]  #: rows and columns
    frame_rate: float | None  #: [Hz]
    #: tube load [mAs] and dose area product [dGy cm^2] of the file; None if not stated
    tube_load: float | None = None
    area_dose: float | None = None


def read_dicom_header(path: Path) -> DicomHeader:
    """Read the header of a DICOM file.

    Raises DataError for a file that cannot be read, is not DICOM, is cut off, or contains anything
    but grey images of 8 or 16 bits, uncompressed or run-length encoded.
    """
    pydicom = _pydicom()
    with ErrorsAt(path), opened(path) as file, warnings.catch_warnings():
        warnings.simplefilter('ignore')
        try:
            dataset = pydicom.dcmread(file, stop_before_pixels=True)
            return _dicom_header(dataset, os.fstat(file.fileno()).st_size)
        except (DataError, OSError):
            raise
        except Exception:  # pydicom raises various exceptions for damaged files
            raise DataError('this is not a DICOM file, or it is damaged') from None


# Tags of the tube load with their units in mAs, finest first (PS3.3, X-Ray Acquisition).
_TUBE_LOADS = (('ExposureInmAs', 1.0), ('ExposureInuAs', 1e-3), ('Exposure', 1.0))


def _tube_load(dataset: Any) -> float | None:
    """Return the tube load [mAs] of a data set, None if not stated."""
    for tag, unit in _TUBE_LOADS:
        value = _amount(dataset, tag)
        if value is not None:
            return unit * value
    current, time_ms = _amount(dataset, 'XRayTubeCurrent'), _amount(dataset, 'ExposureTime')
    return None if current is None or time_ms is None else current * time_ms / 1000


def _amount(dataset: Any, tag: str) -> float | None:
    """Return a positive number of a data set, None for anything else."""
    try:
        value = float(dataset.get(tag))
    except (TypeError, ValueError):
        return None
    return value if 0 < value < math.inf else None


def read_dicom_images(path: Path, header: DicomHeader) -> Iterator[tuple[str, np.ndarray]]:
    """Yield place and image (h, w) of uint8 or uint16 of each frame. Raises DataError."""
    frames = _pydicom().pixels.iter_pixels(path, raw=True)
    for number in range(1, header.count + 1):
        where = f'{path}, frame {number}' if header.count > 1 else str(path)
        try:
            with warnings.catch_warnings():
                warnings.simplefilter('ignore')
                frame = next(frames)
            image = _grey(np.asarray(frame), header)
        except Exception:  # StopIteration, and exceptions of the decoders
            raise DataError('the frame is damaged or cut off', at=where) from None
        yield where, image


def _pydicom() -> Any:
    """Import pydicom. Raises DataError if it is not installed."""
    try:
        import pydicom
        import pydicom.pixels

        return pydicom
    except ImportError:
        raise DataError(
            'DICOM files need pydicom 3, which is not installed: pip install "pydicom>=3"'
        ) from None


def _dicom_header(dataset: Any, file_size: int) -> DicomHeader:
    """Return the header of a data set. Raises DataError."""
    syntax = dataset.file_meta.TransferSyntaxUID
    if syntax not in (*NATIVE, RUN_LENGTHS):
        raise DataError(
            f'the images are compressed ({syntax.name}); save them uncompressed or with run '
            'lengths (RLE)'
        )
    rows, columns = int(dataset.get('Rows') or 0), int(dataset.get('Columns') or 0)
    count = int(dataset.get('NumberOfFrames') or 1)
    if not rows or not columns or count < 1:
        raise DataError('the DICOM file contains no image')
    check_size(columns, rows)
    allocated, stored = int(dataset.BitsAllocated), int(dataset.BitsStored)
    kind = str(dataset.PhotometricInterpretation)
    if int(dataset.get('SamplesPerPixel') or 1) != 1 or kind not in DICOM_GREY:
        raise DataError(f'the images are not grey ({kind})')
    if allocated not in (8, 16) or not 1 <= stored <= allocated or dataset.HighBit != stored - 1:
        raise DataError(
            f'pixels of {stored} bits in {allocated}, up to bit {dataset.HighBit}, are not read, '
            'only 8 and 16 bits with the lowest ones used'
        )
    if syntax in NATIVE and rows * columns * count * allocated // 8 > file_size:
        raise DataError(f'the file is cut off: it claims {count} frames of {columns} x {rows} px')
    return DicomHeader(
        count,
        stored,
        signed=bool(dataset.PixelRepresentation),
        inverted=kind == 'MONOCHROME1',
        shape=(rows, columns),
        frame_rate=_dicom_rate(dataset),
        tube_load=_tube_load(dataset),
        area_dose=_amount(dataset, 'ImageAndFluoroscopyAreaDoseProduct'),
    )


def _dicom_rate(dataset: Any) -> float | None:
    """Return the frame rate [Hz], None if not stated."""
    interval_ms = float(dataset.get('FrameTime') or 0)
    rate = 1e3 / interval_ms if interval_ms > 0 else float(dataset.get('CineRate') or 0)
    rate = rate or float(dataset.get('RecommendedDisplayFrameRate') or 0)
    return rate if 0 < rate < 1e6 else None


def _grey(frame: np.ndarray, header: DicomHeader) -> np.ndarray:
    """Convert to grey values that start at 0 and increase with brightness."""
    if frame.shape != header.shape:
        raise ValueError
    max_value = 2**header.bits - 1
    values = frame.astype(np.int32)
    if header.signed:
        values += (max_value + 1) // 2
    values &= max_value  # unused bits may contain an overlay
    if header.inverted:
        values = max_value - values
    return values.astype(np.uint8 if header.bits <= 8 else np.uint16)


SIGNATURE = b'CI'
FILE_HEADER = struct.Struct('<2sHHHiIiIIIIQ')
BITMAP_HEADER = struct.Struct('<IiiHHIIiiII')
SETUP_MARK = 140  # offset in SETUP of the mark ST, present in newer files, and of its length
FRAME_RATE = 768  # offset in SETUP of the 32-bit rate; SETUP begins with a 16-bit rate
ANNOTATION = 8  # minimum size [bytes]


@dataclass(frozen=True)
class CineHeader:
    """Content of the headers of a cine file."""

    width: int  #: width of the images [px]
    height: int  #: height of the images [px]
    bits: int  #: bits of a stored pixel: 8, 10 (packed) or 16
    from_bottom: bool  #: whether the last row is stored first
    offsets: NDArray[np.int64]  #: (n,), positions of the images in the file
    frame_rate: float  #: [Hz]

    @property
    def image_bytes(self) -> int:
        """Size of the pixels of an image without padding [bytes]."""
        return self.height * ((self.width * self.bits + 7) // 8)


def read_cine_header(path: Path) -> CineHeader:
    """Read the headers of a cine file.

    Raises DataError for a file that cannot be read, is not a cine file, is cut off, is damaged, or
    contains colours or compressed images.
    """
    with opened(path) as file, ErrorsAt(path):
        return _cine_header(file, os.fstat(file.fileno()).st_size)


def read_cine_images(path: Path, header: CineHeader) -> Iterator[tuple[str, np.ndarray]]:
    """Yield place and image (h, w) of uint8 or uint16 of each frame. Raises DataError."""
    with os_errors(path, 'cannot be read'), open(path, 'rb') as file:
        for number, offset in enumerate(header.offsets.tolist(), 1):
            where = f'{path}, frame {number}'
            with ErrorsAt(where):
                image = _image(file, offset, header)
            yield where, image


def _cine_header(file: BinaryIO, size: int) -> CineHeader:
    """Return the header of a file of this size [bytes]. Raises DataError."""
    fields = _unpack(file, 0, FILE_HEADER)
    signature, _, compression, _, _, _, _, count, at_bitmap, at_setup, at_offsets, _ = fields
    if signature != SIGNATURE:
        raise DataError('this is not a cine file: it does not begin with CI')
    if compression:
        kind = {1: 'JPEG images', 2: 'the mosaic of a colour sensor'}.get(
            compression, 'an unknown kind of images'
        )
        raise DataError(f'the cine file holds {kind}; only uncompressed grey images are read')
    bitmap = _unpack(file, at_bitmap, BITMAP_HEADER)
    width, height = bitmap[1], bitmap[2]
    bits = _bits(bitmap[4], bitmap[5])
    if width <= 0 or abs(height) in (0, 2**31):
        raise DataError(f'the cine file is damaged: images of {width} x {height} px')
    check_size(width, abs(height))
    if not 0 < count <= MAX_FRAMES or at_offsets + 8 * count > size:
        raise DataError(f'the cine file is damaged or cut off: it claims {count} images')
    file.seek(at_offsets)
    offsets = np.frombuffer(file.read(8 * count), '<i8')
    rate = _cine_rate(file, at_setup)
    header = CineHeader(
        width,
        abs(height),
        bits=bits,
        from_bottom=bits != 10 and height > 0,
        offsets=offsets,
        frame_rate=rate,
    )
    bytes_needed = ANNOTATION + header.image_bytes
    valid = (offsets >= FILE_HEADER.size) & (offsets <= size - bytes_needed)
    if not valid.all():
        raise DataError(
            f'the cine file is damaged or cut off: only {int(valid.sum())} of {count} images are '
            'in it'
        )
    return header


def _bits(bit_count: int, compression: int) -> int:
    """Return the bits of a stored pixel, from biBitCount and biCompression. Raises DataError."""
    if compression == 0x100:
        return 10
    if not compression and bit_count in (8, 16):
        return bit_count
    if compression == 0x400:
        kind = 'packed pixels of 12 bits'
    elif not compression and bit_count in (24, 48):
        kind = 'colours'
    else:
        kind = f'pixels of {bit_count} bits with compression {compression}'
    raise DataError(
        f'the cine file holds {kind}; only grey images of 8 and 16 bits, and packed ones of 10 '
        'bits, are read'
    )


def _cine_rate(file: BinaryIO, at_setup: int) -> float:
    """Return the frame rate [Hz]. Raises DataError."""
    rate = _unpack(file, at_setup, struct.Struct('<H'))[0]
    mark, length = _unpack(file, at_setup + SETUP_MARK, struct.Struct('<2sH'))
    if mark == b'ST' and length >= FRAME_RATE + 4:
        rate = _unpack(file, at_setup + FRAME_RATE, struct.Struct('<I'))[0] or rate
    if not rate:
        raise DataError('the cine file does not state its frame rate')
    return float(rate)


def _image(file: BinaryIO, offset: int, header: CineHeader) -> np.ndarray:
    """Return the image at an offset. Raises DataError."""
    annotation = _unpack(file, offset, struct.Struct('<I'))[0]
    if not ANNOTATION <= annotation < 2**31:
        raise DataError(f'the frame is damaged: an annotation of {annotation} bytes')
    size = _unpack(file, offset + annotation - 4, struct.Struct('<I'))[0]
    stride = size // header.height
    row = header.image_bytes // header.height
    if size % header.height or stride not in (row, -(-row // 4) * 4):  # padded to 4 bytes
        raise DataError(
            f'the frame is damaged: {size} bytes for {header.width} x {header.height} px of '
            f'{header.bits} bits'
        )
    data = file.read(size)
    if len(data) < size:
        raise DataError('the frame is cut off')
    rows = np.frombuffer(data, np.uint8).reshape(header.height, stride)
    if header.bits == 10:
        return _unpacked_10(rows, header.width)
    row_bytes = header.width * header.bits // 8
    image = rows[:, :row_bytes].copy().view('<u2' if header.bits == 16 else np.uint8)
    image = image[::-1] if header.from_bottom else image
    return np.ascontiguousarray(image, np.uint16 if header.bits == 16 else np.uint8)


def _unpacked_10(rows: NDArray[np.uint8], width: int) -> np.ndarray:
    """Unpack rows with four pixels in five bytes, highest bits first, to pixels (h, w)."""
    bits = np.unpackbits(rows, axis=1)[:, : 10 * width].reshape(len(rows), width, 10)
    padded = np.zeros((len(rows), width, 16), np.uint8)
    padded[..., 6:] = bits
    high_low = np.packbits(padded, axis=2).astype(np.uint16)
    return (high_low[..., 0] << 8) | high_low[..., 1]


def _unpack(file: BinaryIO, offset: int, layout: struct.Struct) -> tuple[Any, ...]:
    """Return the fields at an offset. Raises DataError at the end of the file."""
    file.seek(offset)
    data = file.read(layout.size)
    if len(data) < layout.size:
        raise DataError('the cine file is damaged or cut off')
    return layout.unpack(data)
