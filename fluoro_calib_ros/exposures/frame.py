"""Frames of image points and their validation."""

from dataclasses import dataclass, field

import numpy as np

from ..errors import DataError


@dataclass(frozen=True)
class Frame:
    """Image points of identified targets in one exposure of one fluoroscope.

    target_id (n,); uv (n, 2) observed column and row [px]; sigma (n,) standard deviation [px] or
    None; image_size (width, height) [px]; stamp_ns time of the exposure [ns].
    """

    fluoroscope: str
    number: int
    target_id: np.ndarray
    uv: np.ndarray
    image_size: tuple
    sigma: np.ndarray | None = None
    stamp_ns: int = 0
    frame_id: str = field(default='', compare=False)

    def sorted(self):
        """The same frame with its targets in ascending order: results do not depend on the input's
        order.
        """
        order = np.argsort(self.target_id, kind='stable')
        return Frame(
            self.fluoroscope,
            int(self.number),
            np.asarray(self.target_id, dtype=np.int64)[order],
            np.asarray(self.uv, dtype=float)[order],
            tuple(int(s) for s in self.image_size),
            None if self.sigma is None else np.asarray(self.sigma, dtype=float)[order],
            int(self.stamp_ns),
            self.frame_id,
        )


def validate_frame(frame, phantom=None, image_size=None):
    """Check a frame for everything that would spoil a calculation.

    Raises DataError in one sentence: lengths that differ, an empty frame, NaN or infinite numbers,
    a point off the image, a duplicate id, with phantom an id it does not have, with image_size
    another size.
    """
    where = f'fluoroscope {frame.fluoroscope}, frame {frame.number}'
    ids = np.asarray(frame.target_id)
    uv = np.asarray(frame.uv)
    width, height = frame.image_size
    if width <= 0 or height <= 0:
        raise DataError(f'{where}: the image size is {width} x {height} px')
    if image_size is not None and (width, height) != tuple(image_size):
        raise DataError(
            f'{where}: the image is {width} x {height} px, '
            f'but the calibration is for {image_size[0]} x {image_size[1]} px'
        )
    if len(ids) == 0:
        raise DataError(f'{where}: the frame is empty, it has no targets')
    if uv.shape != (len(ids), 2):
        raise DataError(f'{where}: {len(ids)} target ids, but image points of shape {uv.shape}')
    if frame.sigma is not None and len(frame.sigma) != len(ids):
        raise DataError(f'{where}: {len(ids)} target ids, but {len(frame.sigma)} values of sigma')
    bad = ~np.isfinite(uv).all(axis=1)
    if bad.any():
        raise DataError(f'{where}: the image point of target {ids[bad][0]} is not a number')
    if frame.sigma is not None:
        bad = ~(np.isfinite(frame.sigma) & (np.asarray(frame.sigma) > 0))
        if bad.any():
            raise DataError(f'{where}: sigma of target {ids[bad][0]} is not a positive number')
    bad = ~points_on_image(uv, frame.image_size)
    if bad.any():
        raise DataError(f'{where}: target {ids[bad][0]} is off the image of {width} x {height} px')
    values, counts = np.unique(ids, return_counts=True)
    if (counts > 1).any():
        raise DataError(
            f'{where}: target {values[counts > 1][0]} is there {counts[counts > 1][0]} times'
        )
    if phantom is not None:
        unknown = phantom.index(ids) < 0
        if unknown.any():
            raise DataError(f'{where}: target {ids[unknown][0]} is not on the phantom')


def points_on_image(uv, image_size):
    """True (n,) where a pixel (n, 2) is a point of the image; pixel centres are at integers, NaN
    is off.
    """
    uv = np.asarray(uv)
    return ((uv >= -0.5) & (uv <= np.asarray(image_size) - 0.5)).all(axis=1)
