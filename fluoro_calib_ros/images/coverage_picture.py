# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""A picture of what the collected exposures cover of an image."""

from __future__ import annotations

import cv2
import numpy as np

COVERED = (60, 150, 70)  # RGB
MISSING = (90, 90, 90)
LINES = (235, 235, 235)
TEXT_ROWS = 22  # px a line of text
WIDTH = 480  # px
FONT = cv2.FONT_HERSHEY_SIMPLEX


def coverage_picture(
    covered: np.ndarray, image_size: tuple[int, int], lines: tuple[str, ...]
) -> np.ndarray:
    """Draw covered cells green and missing ones grey, with lines of text below.

    covered: (rows, columns) of bool; image_size: (width, height) [px] of the image, whose shape
    the picture has. Returns (h, w, 3) of uint8, RGB.
    """
    width, height = image_size
    rows = max(1, round(WIDTH * height / width))
    colours = np.where(
        covered[..., None], np.array(COVERED, np.uint8), np.array(MISSING, np.uint8)
    )
    picture = cv2.resize(colours, (WIDTH, rows), interpolation=cv2.INTER_NEAREST)
    for i in (1, 2):  # the areas that the advice names
        cv2.line(picture, (WIDTH * i // 3, 0), (WIDTH * i // 3, rows), LINES, 1)
        cv2.line(picture, (0, rows * i // 3), (WIDTH, rows * i // 3), LINES, 1)
    text = np.zeros((TEXT_ROWS * len(lines) + 8, WIDTH, 3), np.uint8)
    for i, line in enumerate(lines):
        place = (6, TEXT_ROWS * (i + 1) - 6)
        size = cv2.getTextSize(line, FONT, 0.45, 1)[0][0]
        scale = 0.45 * min(1.0, (WIDTH - 12) / max(size, 1))
        cv2.putText(text, line, place, FONT, scale, LINES, 1, cv2.LINE_AA)
    return np.vstack([picture, text])
