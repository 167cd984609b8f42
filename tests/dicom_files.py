# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""DICOM files as X-ray machines write them."""

import pydicom

LITTLE = '1.2.840.10008.1.2.1'


def dicom(path, frames, rle=False, **changes):
    """Return a DICOM file written by pydicom; `changes` replace elements."""
    bits = 8 if frames.max() < 256 else 12
    meta = pydicom.dataset.FileMetaDataset()
    meta.TransferSyntaxUID = changes.pop('syntax', LITTLE)
    meta.MediaStorageSOPClassUID = '1.2.840.10008.5.1.4.1.1.12.2'
    meta.MediaStorageSOPInstanceUID = '1.2.3.4'
    dataset = pydicom.dataset.FileDataset(path, {}, file_meta=meta, preamble=bytes(128))
    dataset.SOPClassUID = meta.MediaStorageSOPClassUID
    dataset.SOPInstanceUID = '1.2.3.4'
    dataset.NumberOfFrames, dataset.Rows, dataset.Columns = frames.shape
    dataset.SamplesPerPixel = 1
    dataset.PhotometricInterpretation = 'MONOCHROME2'
    dataset.BitsAllocated = 8 if bits == 8 else 16
    dataset.BitsStored = bits
    dataset.HighBit = bits - 1
    dataset.PixelRepresentation = int(frames.min() < 0)
    dataset.PixelData = frames.astype('u1' if bits == 8 else '<i2').tobytes()
    if rle:
        dataset.compress(pydicom.uid.RLELossless)
    for name, value in changes.items():
        setattr(dataset, name, value)
    dataset.save_as(path, enforce_file_format=True)
    return path
