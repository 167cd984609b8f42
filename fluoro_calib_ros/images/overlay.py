# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Pictures of detections in a radiograph that were matched or refused."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ..errors import DataError
from .codec import encode
from .detection import detect_beads
from .extraction import Extraction
from .markers import MarkerFrame

# Colours as blue, green, red.
MATCHED = (80, 220, 60)
OVERLAPPED = (230, 200, 40)
REFUSED = (60, 60, 255)
UNEXPLAINED = (0, 190, 255)
TEXT = (235, 235, 235)
TEXT_HEIGHT = 18  # height of a line of text [px]
FONT = cv2.FONT_HERSHEY_SIMPLEX
QUALITY = 80  # quality of a small JPEG, which is looked at and not measured


def draw_overlay(
    image: np.ndarray, extraction: Extraction | None, reason: str = ''
) -> NDArray[np.uint8]:
    """Draw a picture (h, w, 3) of uint8, blue, green, red, of an image (h, w).

    Green circles are observations, light blue circles overlapped observations, red crosses
    predicted beads without an observation, yellow squares detections that are no bead of the
    phantom. Without an extraction, all detections are yellow, and reason says why it was refused.
    """
    picture, factor = _picture(image)
    if extraction is None:
        try:
            detections = detect_beads(image)
            for uv in detections.uv:
                _square(picture, uv, factor, detections.radius_px)
        except DataError:
            pass  # the label shows the reason
        return _labelled(picture, [(reason or 'refused', REFUSED)])
    radius = extraction.imaging.profile.reach_px
    distance = np.linalg.norm(
        extraction.detections.uv[:, None] - extraction.match.predicted[None], axis=2
    )
    # Predictions of beads behind the source are NaN.
    unexplained = extraction.detections.uv[~(distance < radius).any(axis=1)]
    for uv in unexplained:
        _square(picture, uv, factor, radius)
    for uv, overlapped in zip(extraction.uv, extraction.overlapped):
        colour = OVERLAPPED if overlapped else MATCHED
        cv2.circle(picture, _place(uv, factor), round(factor * radius), colour, 1, cv2.LINE_AA)
    for refusal in extraction.refused:
        place = _place(refusal.uv, factor)
        cv2.drawMarker(picture, place, REFUSED, cv2.MARKER_TILTED_CROSS, round(2 * radius), 1)
    overlapped = int(extraction.overlapped.sum())
    lines = [
        (f'{len(extraction.bead) - overlapped} beads', MATCHED),
        (f'{overlapped} overlapped', OVERLAPPED),
        (f'{len(extraction.refused)} predicted, not measured', REFUSED),
        (f'{len(unexplained)} not of the phantom', UNEXPLAINED),
    ]
    return _labelled(picture, lines)


def full_contrast(image: np.ndarray) -> NDArray[np.uint8]:
    """Return an image (h, w) as uint8 with full contrast."""
    low, high = np.percentile(image[::4, ::4], [0.5, 99.8])
    return np.clip((image - low) * (255 / max(high - low, 1)), 0, 255).astype(np.uint8)


def small_jpeg(image: np.ndarray, largest_px: int) -> bytes:
    """Return an image (h, w) as JPEG with full contrast, a large image reduced to largest_px."""
    factor = largest_px / max(image.shape)
    if factor < 1:
        image = cv2.resize(image, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA)
    return encode(full_contrast(image), '.jpg', QUALITY)


def _picture(image: np.ndarray) -> tuple[NDArray[np.uint8], int]:
    """Return an image as a picture with full contrast, a small image enlarged, and the factor."""
    grey = full_contrast(image)
    factor = 2 if max(image.shape) <= 512 else 1
    grey = cv2.resize(grey, None, fx=factor, fy=factor, interpolation=cv2.INTER_NEAREST)
    return cv2.cvtColor(grey, cv2.COLOR_GRAY2BGR), factor


def _place(uv: np.ndarray, factor: int) -> tuple[int, int]:
    """Return the pixel of the picture for a pixel (2,) of the image."""
    u, v = np.rint((np.asarray(uv) + 0.5) * factor - 0.5).astype(int)
    return int(u), int(v)


def _square(
    picture: NDArray[np.uint8], uv: NDArray[np.float64], factor: int, radius: float
) -> None:
    u, v = _place(uv, factor)
    r = round(factor * radius)
    cv2.rectangle(picture, (u - r, v - r), (u + r, v + r), UNEXPLAINED, 1)


def _labelled(
    picture: NDArray[np.uint8], lines: list[tuple[str, tuple[int, int, int]]]
) -> NDArray[np.uint8]:
    """Return a picture with lines of text below it, which are reduced to its width."""
    width = picture.shape[1]
    band = np.zeros((TEXT_HEIGHT * len(lines) + 8, width, 3), np.uint8)
    for number, (text, colour) in enumerate(lines):
        place = (6, TEXT_HEIGHT * (number + 1) - 2)
        size = cv2.getTextSize(text, FONT, 0.45, 1)[0][0]
        scale = 0.45 * min(1.0, (width - 12) / max(size, 1))
        cv2.putText(band, text, place, FONT, scale, colour, 1, cv2.LINE_AA)
    return np.vstack([picture, band])


# Pictures of tracked markers.

RADIUS_PX = 7


def draw_markers(
    image: np.ndarray, markers: MarkerFrame, target_names: Mapping[int, str] | None = None
) -> NDArray[np.uint8]:
    """Draw a picture (h, w, 3) of uint8, blue, green, red, of an image (h, w).

    Green circles are markers, light blue circles overlapped markers, yellow circles markers with a
    doubtful id; red crosses are predictions of markers that are not seen.
    """
    target_names = target_names or {}
    picture, factor = _picture(image)
    size = cv2.getTextSize('0', FONT, 0.35, 1)[0][1]
    marks = [
        (target, uv, UNEXPLAINED if doubtful else OVERLAPPED if overlapped else MATCHED, True)
        for target, uv, overlapped, doubtful in zip(
            markers.target_id, markers.uv, markers.overlapped, markers.doubtful
        )
    ]
    marks += [
        (target, uv, REFUSED, False) for target, uv in zip(markers.missing, markers.predicted)
    ]
    for target, uv, colour, seen in marks:
        if not np.isfinite(uv).all() or np.abs(uv).max() > 2**14:
            continue
        u, v = _place(uv, factor)
        if seen:
            cv2.circle(picture, (u, v), RADIUS_PX, colour, 1, cv2.LINE_AA)
        else:
            cv2.drawMarker(picture, (u, v), colour, cv2.MARKER_TILTED_CROSS, RADIUS_PX, 1)
        text = target_names.get(int(target), str(int(target)))
        place = (u + RADIUS_PX + 1, v + size // 2)
        cv2.putText(picture, text, place, FONT, 0.35, colour, 1, cv2.LINE_AA)
    lines = [
        (f'{len(markers.target_id)} markers, {int(markers.overlapped.sum())} overlapped', MATCHED),
        (f'{int(markers.doubtful.sum())} with a doubtful id', UNEXPLAINED),
        (f'{len(markers.missing)} not seen', REFUSED),
    ]
    if markers.reason:
        lines.append((markers.reason, REFUSED))
    return _labelled(picture, lines)


# Pictures of bodies.

AXIS_COLOURS = (REFUSED, MATCHED, OVERLAPPED)  # x red, y green, z light blue


@dataclass(frozen=True)
class BodyView:
    """A body in an image: its name and status, markers (n, 2), and centre and ends of axes (4, 2).

    Places are pixels, NaN if the body has no pose.
    """

    name: str
    status: str
    markers: NDArray[np.float64]
    axes: NDArray[np.float64]


def draw_bodies(image: np.ndarray, title: str, bodies: Sequence[BodyView]) -> NDArray[np.uint8]:
    """Draw a picture (h, w, 3) of uint8, blue, green, red, of an image (h, w), of even size.

    Circles are markers at the pose of their body, green where markers were seen; lines are the
    axes of the body, x red, y green, z light blue.
    """
    picture, factor = _picture(image)
    lines = [(title, TEXT)]
    for body in bodies:
        colour = MATCHED if body.status in ('OK', 'WEAK') else UNEXPLAINED
        lines.append((f'{body.name}: {body.status}', colour))
        places = np.vstack([body.markers, body.axes])
        if not np.isfinite(places).all() or np.abs(places).max() > 2**14:
            continue
        for uv in body.markers:
            cv2.circle(picture, _place(uv, factor), RADIUS_PX, colour, 1, cv2.LINE_AA)
        centre, *ends = (_place(uv, factor) for uv in body.axes)
        for end, axis in zip(ends, AXIS_COLOURS):
            cv2.line(picture, centre, end, axis, 2, cv2.LINE_AA)
        place = (centre[0] + RADIUS_PX, centre[1] - RADIUS_PX)
        # Black around the letters: legible on any background.
        cv2.putText(picture, body.name, place, FONT, 0.45, (0,) * 3, 3, cv2.LINE_AA)
        cv2.putText(picture, body.name, place, FONT, 0.45, TEXT, 1, cv2.LINE_AA)
    labelled = _labelled(picture, lines)
    return labelled[: len(labelled) // 2 * 2, : labelled.shape[1] // 2 * 2]


MISSING = (90, 90, 90)
WIDTH = 480  # width of the picture [px]


def coverage_picture(
    covered: NDArray[np.bool_],
    image_size: tuple[int, int],
    lines: tuple[str, ...],
    areas: Sequence[int] = (),
) -> NDArray[np.uint8]:
    """Draw covered cells green and missing cells grey, with lines of text below.

    covered: (rows, columns) of bool; image_size: (width, height) [px] of the image, whose aspect
    ratio the picture has; areas: those that the next pose should show, framed, numbered in rows of
    three from the top left. Returns (h, w, 3) of uint8, blue, green, red.
    """
    width, height = image_size
    rows = max(1, round(WIDTH * height / width))
    colours = np.where(covered[..., None], MATCHED, MISSING).astype(np.uint8)
    picture = cv2.resize(colours, (WIDTH, rows), interpolation=cv2.INTER_NEAREST)
    for i in (1, 2):  # the areas that the advice names
        cv2.line(picture, (WIDTH * i // 3, 0), (WIDTH * i // 3, rows), TEXT, 1)
        cv2.line(picture, (0, rows * i // 3), (WIDTH, rows * i // 3), TEXT, 1)
    for area in areas:
        row, column = divmod(area, 3)
        first = (WIDTH * column // 3 + 3, rows * row // 3 + 3)
        last = (WIDTH * (column + 1) // 3 - 4, rows * (row + 1) // 3 - 4)
        cv2.rectangle(picture, first, last, UNEXPLAINED, 4)
    return _labelled(picture, [(line, TEXT) for line in lines])
