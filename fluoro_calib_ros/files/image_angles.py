# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Angles of a C-arm in the images of a stack or video, as CSV: `image,angle_deg`.

The first image has number 1. Rows may have any order; an image without an angle, or without a row,
gets the mean correction.
"""

from __future__ import annotations

import os

import numpy as np

from ..exposures.frame import MAX_ANGLE
from .csv_table import read_blocks

COLUMNS = ('image', 'angle_deg')


def read_image_angles(path: str | os.PathLike[str]) -> dict[int, float]:
    """Return the angle [rad] of each image by its number, the first one being 1.

    Raises DataError for a file that cannot be read, an image that is named twice or has no
    possible number, and a value that is no angle. Images with an empty cell are left out.
    """
    angles: dict[int, float] = {}
    rows: dict[int, int] = {}
    for block in read_blocks(path, COLUMNS):
        numbers = block.ids('image')
        block.require('image', numbers > 0, 'the first image is 1')
        degrees = block.floats_or_nan('angle_deg')
        possible = np.isnan(degrees) | (np.abs(degrees) <= np.degrees(MAX_ANGLE))
        block.require('angle_deg', possible, 'not an angle')
        for index, (number, angle) in enumerate(zip(numbers.tolist(), np.radians(degrees))):
            if number in rows:
                block.fail(index, f'image {number} is in row {rows[number]}, too')
            rows[number] = int(block.lines[index])
            if not np.isnan(angle):
                angles[number] = float(angle)
    return angles
