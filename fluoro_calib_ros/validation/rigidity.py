# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Test whether the exposures of two fluoroscopes agree on how these stand to each other.

Fluoroscopes of a rig do not move against each other while the phantom is moved. Where frames of
different exposures have the same number, the relative orientations of the pairs contradict each
other, however well each fluoroscope is calibrated.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..calibration.calibrate import ExposureResult, FluoroscopeResult
from ..calibration.pair_scatter import MOVED_SHARE, PairScatter, steps_of
from ..photogrammetry.rotations import matrix_from_quaternion, rotation_angle, vector_from_matrix

MIN_PAIRS = 3
# Distance, in radians and relative shift, from which a pair is not one of the rig.
INTERCHANGED = 0.4
# Median deviation of the pairs from their median, far above that of a rig whose mounting gives.
MAX_SHIFT_MM = 10.0
MAX_SHIFT = 0.01  # the same over the distance of the sources; the larger of both holds
MAX_TURN_RAD = np.deg2rad(1.0)
# Scatter of the pairs over their standard deviations above which they are doubtful; of honest rigs
# it is 1.0 to 1.4, and 3 where the model does not follow the distortion at all.
DOUBTFUL_GROWTH = 2.0
MAX_GROWTH = 8.0  # above which there is no orientation, where the displacement is large as well
MIN_DOUBT_PX = 0.3  # less displaces no point by more than its noise does
MAX_OFF = 0.0025  # median displacement of image points over the longer side of the image
MIN_PAIRS_MOVED = 6


def interchanged(names: tuple[str, str], one: FluoroscopeResult, other: FluoroscopeResult) -> str:
    """Return a sentence where frames of two fluoroscopes are interchanged in some exposures.

    The relative orientation of such a pair is far from the others, and its inverse is near them.
    """
    pairs = _pairs(one, other)
    if len(pairs) < MIN_PAIRS:
        return ''
    turn, shift = _relative(pairs)
    numbers = [a.exposure for a, _ in pairs]
    middle = int(np.argmin(np.median(_distances(turn, shift, turn, shift), axis=1)))
    there = turn[middle : middle + 1]
    base = shift[middle : middle + 1]
    far = _distances(turn, shift, there, base)[:, 0] > INTERCHANGED
    inverse_turn = turn.transpose(0, 2, 1)
    inverse_shift = -(turn @ shift[..., None])[..., 0]
    near = _distances(inverse_turn, inverse_shift, there, base)[:, 0] < INTERCHANGED / 2
    wrong = [str(number) for number, is_wrong in zip(numbers, far & near) if is_wrong]
    if not wrong:
        return ''
    a, b = names
    return (
        f'the frames of fluoroscopes {a} and {b} are interchanged in exposure'
        f'{"s" * (len(wrong) > 1)} {", ".join(wrong)}'
    )


def _pairs(
    one: FluoroscopeResult, other: FluoroscopeResult
) -> list[tuple[ExposureResult, ExposureResult]]:
    """Return the exposures of the same number."""
    by_number = {e.exposure: e for e in other.exposures}
    return [(e, by_number[e.exposure]) for e in one.exposures if e.exposure in by_number]


def _relative(
    pairs: Sequence[tuple[ExposureResult, ExposureResult]],
) -> tuple[np.ndarray, np.ndarray]:
    """Return rotations (k, 3, 3) from sensor to sensor, and shifts (k, 3) [mm] in the first."""
    r_a = matrix_from_quaternion([a.quaternion_wxyz for a, _ in pairs])
    r_b = matrix_from_quaternion([b.quaternion_wxyz for _, b in pairs])
    base = np.array([b.position_mm - a.position_mm for a, b in pairs])
    return r_b @ r_a.transpose(0, 2, 1), (r_a @ base[..., None])[..., 0]


def _distances(
    turn: np.ndarray, shift: np.ndarray, other_turn: np.ndarray, other_shift: np.ndarray
) -> np.ndarray:
    """Return how far (k, l) relative orientations are apart: angle [rad] and relative shift."""
    angle = rotation_angle(turn[:, None] @ other_turn[None].transpose(0, 1, 3, 2))
    length = np.linalg.norm(other_shift, axis=-1)[None]
    apart = np.linalg.norm(shift[:, None] - other_shift[None], axis=-1)
    return angle + apart / np.maximum(length, 1e-9)


def contradiction(names: tuple[str, str], one: FluoroscopeResult, other: FluoroscopeResult) -> str:
    """Return a sentence where the exposures of two fluoroscopes contradict each other, else ''.

    Exposures of the same number belong together. Fewer than three pairs cannot contradict.
    """
    pairs = _pairs(one, other)
    if len(pairs) < MIN_PAIRS:
        return ''
    turn, shift = _relative(pairs)
    deviation = np.linalg.norm(shift - np.median(shift, axis=0), axis=1)
    middle = int(np.argmin(deviation))
    off_mm = float(np.median(deviation))
    off_rad = float(np.median(rotation_angle(turn @ turn[middle].T)))
    limit = max(MAX_SHIFT_MM, MAX_SHIFT * float(np.median(np.linalg.norm(shift, axis=1))))
    if off_mm <= limit and off_rad <= MAX_TURN_RAD:
        return ''
    a, b = names
    return (
        f'the exposures of fluoroscopes {a} and {b} contradict each other: their relative '
        f'orientation differs by {off_mm:.0f} mm and {np.rad2deg(off_rad):.1f} degrees between '
        'them; frames with the same number are not of the same exposure, or a fluoroscope was '
        'moved'
    )


def doubtful(scatter: PairScatter, side_px: int) -> tuple[str, str]:
    """Return why exposures give no orientation of a rig, or what is doubtful about the one given.

    side_px is the longer side of the image. At least one of both sentences is ''.
    """
    a, b = scatter.fluoroscopes
    off = float(np.median(scatter.off_px[scatter.used]))
    left_out = ''
    if not scatter.used.all():
        numbers = ', '.join(str(number) for number in scatter.exposures[~scatter.used])
        left_out = (
            f'not from exposure {numbers}, in which fluoroscopes {a} and {b} stand otherwise to '
            f'each other by {_size(scatter.off_px[~scatter.used])}: the frames are not of one '
            'exposure, or the phantom moved between them'
        )
    if scatter.unexplained <= DOUBTFUL_GROWTH or off < MIN_DOUBT_PX:
        bent = '' if scatter.corrected or scatter.angle_px < MIN_DOUBT_PX else _bent(scatter)
        return '', '; '.join(filter(None, (left_out, bent)))
    sentence = (
        f'the exposures contradict each other: the relative orientation of fluoroscopes {a} and '
        f'{b} differs between them by {off:.1f} px, {scatter.unexplained:.0f} times its standard '
        f'deviation; {_cause(scatter)}'
    )
    refused = off > MAX_OFF * side_px and scatter.unexplained > MAX_GROWTH
    return (sentence, '') if refused else ('', sentence)


def _bent(scatter: PairScatter) -> str:
    """Return the sentence on a relative orientation that changes with the angle of a C-arm."""
    a, b = scatter.fluoroscopes
    return (
        f'the relative orientation of fluoroscopes {a} and {b} changes with the angle of the '
        f'C-arm, by {scatter.angle_px:.1f} px: it is that of the mean angle; orient the rig from '
        'a capture at the angle that is used'
    )


def _size(off_px: np.ndarray) -> str:
    """Return the displacements of image points as text."""
    low, high = float(np.min(off_px)), float(np.max(off_px))
    if not np.isfinite(high):
        return f'{low:.1f} px and more' if np.isfinite(low) else 'more than the image shows'
    return f'{low:.1f} px' if high - low < 0.05 else f'{low:.1f} to {high:.1f} px'


def _cause(scatter: PairScatter) -> str:
    """Return why the pairs scatter: one move of the rig, where that explains nearly all."""
    count = len(scatter.exposures)
    order = np.argsort(scatter.exposures)
    turn = scatter.turn[order]
    columns = scatter.columns[order]
    # Rotations about the first pair [rad], and shifts over the distance of the sources.
    base = float(np.median(np.linalg.norm(scatter.shift_mm, axis=1)))
    place = np.hstack(
        [vector_from_matrix(turn @ turn[0].T), scatter.shift_mm[order] / max(base, 1e-9)]
    )
    steps = steps_of(count)
    fits = [_squares(place, np.hstack([columns, step])) for step in steps]
    left = [squares for squares, _ in fits]
    if count < MIN_PAIRS_MOVED or min(left) > MOVED_SHARE * _squares(place, columns)[0]:
        return (
            'frames with the same number are not of the same exposure, the phantom moved between '
            'them, the fluoroscopes or their images do not stand still, or the corrections do not '
            'hold in all of them'
        )
    best = int(np.argmin(left))
    split = 2 + best
    numbers = scatter.exposures[order]
    step = fits[best][1][-1]
    return (
        f'a fluoroscope was moved between exposures {numbers[split - 1]} and {numbers[split]}, by '
        f'about {np.linalg.norm(step[3:]) * base:.1f} mm and '
        f'{np.rad2deg(np.linalg.norm(step[:3])):.2f} degrees: orient the rig from a capture'
    )


def _squares(values: np.ndarray, columns: np.ndarray) -> tuple[float, np.ndarray]:
    """Fit functions (k, p) to values (k, 6); return the squares left, and coefficients (p, 6)."""
    coefficients = np.linalg.lstsq(columns, values, rcond=None)[0]
    return float(np.sum((values - columns @ coefficients) ** 2)), coefficients
