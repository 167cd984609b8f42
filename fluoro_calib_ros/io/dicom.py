# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Radiographs and cine loops in DICOM files: grey, uncompressed or with run lengths (RLE).

pydicom (extra dicom) reads and decodes them frame by frame; sizes are checked by the header first.
Grey values rise with brightness: MONOCHROME1, in which they fall, is inverted (PS3.3,
C.7.6.3.1.2). Signed values are shifted to begin at zero.
"""

from __future__ import annotations

import os
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import DataError
from ..images.codec import check_size
from .access import check_regular_file

# Transfer syntaxes (PS3.5, annex A) that are read: implicit and explicit little endian, explicit
# big endian, RLE. A deflated file could be of any size when it is decompressed.
NATIVE = ('1.2.840.10008.1.2', '1.2.840.10008.1.2.1', '1.2.840.10008.1.2.2')
RUN_LENGTHS = '1.2.840.10008.1.2.5'
GREY = ('MONOCHROME1', 'MONOCHROME2')


@dataclass(frozen=True)
class DicomHeader:
    """What the header of a DICOM file says of its images."""

    count: int  #: number of frames
    bits: int  #: used of a pixel
    #: whether grey values can be negative, and whether they fall with brightness
    signed: bool
    inverted: bool
    shape: tuple[int, int]  #: rows and columns
    frame_rate: float | None  #: [Hz]


def read_dicom_header(path: Path) -> DicomHeader:
    """Read the header of a DICOM file.

    Raises DataError for a file that cannot be read, is no DICOM file, is cut off, or holds what is
    no grey image of 8 or 16 bits without compression or with run lengths.
    """
    pydicom = _pydicom()
    check_regular_file(path)
    if not os.path.isfile(path):
        raise DataError('there is no such file', at=path)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter('ignore')
            dataset = pydicom.dcmread(path, stop_before_pixels=True)
            header = _header(dataset, os.path.getsize(path))
    except DataError as error:
        raise error.at(path) from None
    except OSError as error:
        raise DataError(f'cannot be read ({error.strerror or error})', at=path) from None
    except Exception:  # pydicom raises what its parsing stumbles over
        raise DataError('this is no DICOM file, or it is damaged', at=path) from None
    return header


def read_dicom_images(path: Path, header: DicomHeader) -> Iterator[tuple[str, np.ndarray]]:
    """Yield place and image (h, w) of uint8 or uint16, one after the other. Raises DataError."""
    frames = _pydicom().pixels.iter_pixels(path, raw=True)
    for number in range(1, header.count + 1):
        where = f'{path}, frame {number}' if header.count > 1 else str(path)
        try:
            with warnings.catch_warnings():
                warnings.simplefilter('ignore')
                frame = next(frames)
            image = _grey(np.asarray(frame), header)
        except Exception:  # StopIteration, and what the decoders raise
            raise DataError('the frame is damaged or cut off', at=where) from None
        yield where, image


def _pydicom() -> Any:
    """Import pydicom. Raises DataError where it is not installed."""
    try:
        import pydicom
        import pydicom.pixels

        return pydicom
    except ImportError:
        raise DataError(
            'DICOM files need pydicom 3, which is not installed: pip install "pydicom>=3"'
        ) from None


def _header(dataset: Any, file_size: int) -> DicomHeader:
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
    if int(dataset.get('SamplesPerPixel') or 1) != 1 or kind not in GREY:
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
        frame_rate=_frame_rate(dataset),
    )


def _frame_rate(dataset: Any) -> float | None:
    """Return the frame rate [Hz], None where it is not stated."""
    interval_ms = float(dataset.get('FrameTime') or 0)
    rate = 1e3 / interval_ms if interval_ms > 0 else float(dataset.get('CineRate') or 0)
    rate = rate or float(dataset.get('RecommendedDisplayFrameRate') or 0)
    return rate if 0 < rate < 1e6 else None


def _grey(frame: np.ndarray, header: DicomHeader) -> np.ndarray:
    """Return grey values that begin at 0 and rise with brightness."""
    if frame.shape != header.shape:
        raise ValueError
    full = 2**header.bits - 1
    values = frame.astype(np.int32)
    if header.signed:
        values += (full + 1) // 2
    values &= full  # unused bits may hold an overlay
    if header.inverted:
        values = full - values
    return values.astype(np.uint8 if header.bits <= 8 else np.uint16)
