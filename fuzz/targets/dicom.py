# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""DICOM files."""

from __future__ import annotations

from pathlib import Path

from fluoro_calib_ros.io.image_reading import open_images

from ..harness import Target
from ..seeds import images, written


def _read(path: Path) -> None:
    for _ in open_images(path).images:
        pass


def _write(path: Path, rle: bool) -> None:
    import pydicom

    image = images()[0]
    meta = pydicom.dataset.FileMetaDataset()
    meta.TransferSyntaxUID = pydicom.uid.ExplicitVRLittleEndian
    meta.MediaStorageSOPClassUID = pydicom.uid.UID('1.2.840.10008.5.1.4.1.1.12.2')
    meta.MediaStorageSOPInstanceUID = pydicom.uid.UID('1.2.3.4')
    dataset = pydicom.dataset.FileDataset(path, {}, file_meta=meta, preamble=bytes(128))
    dataset.SOPClassUID = meta.MediaStorageSOPClassUID
    dataset.SOPInstanceUID = '1.2.3.4'
    dataset.NumberOfFrames = 2
    dataset.Rows, dataset.Columns = image.shape
    dataset.SamplesPerPixel = 1
    dataset.PhotometricInterpretation = 'MONOCHROME2'
    dataset.BitsAllocated = dataset.BitsStored = 8
    dataset.HighBit = 7
    dataset.PixelRepresentation = 0
    dataset.PixelData = 2 * image.tobytes()
    if rle:
        dataset.compress(pydicom.uid.RLELossless)
    dataset.save_as(path, enforce_file_format=True)


TARGET = Target(
    'dicom',
    'trial.dcm',
    _read,
    lambda: written(lambda path: _write(path, False), lambda path: _write(path, True)),
)
