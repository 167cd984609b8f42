"""Test whether the exposures of two fluoroscopes agree on how these stand to each other.

Fluoroscopes of a rig do not move against each other while the phantom is moved. Where frames of
different exposures have the same number, the relative orientations of the pairs contradict each
other, however well each fluoroscope is calibrated.
"""

from __future__ import annotations

import numpy as np

from ..calibration.calibrate import FluoroscopeResult
from ..photogrammetry.rotations import matrix_from_quaternion, rotation_angle

MIN_PAIRS = 3
# Median deviation of the pairs from their median, far above that of a rig whose mounting gives.
MAX_SHIFT_MM = 10.0
MAX_SHIFT = 0.01  # the same over the distance of the sources; the larger of both holds
MAX_TURN_RAD = np.deg2rad(1.0)


def contradiction(names: tuple[str, str], one: FluoroscopeResult, other: FluoroscopeResult) -> str:
    """Return a sentence where the exposures of two fluoroscopes contradict each other, else ''.

    Exposures of the same number belong together. Fewer than three pairs cannot contradict.
    """
    by_number = {e.exposure: e for e in other.exposures}
    pairs = [(e, by_number[e.exposure]) for e in one.exposures if e.exposure in by_number]
    if len(pairs) < MIN_PAIRS:
        return ''
    r_a = matrix_from_quaternion([a.quaternion_wxyz for a, _ in pairs])
    r_b = matrix_from_quaternion([b.quaternion_wxyz for _, b in pairs])
    base = np.array([b.position_mm - a.position_mm for a, b in pairs])
    shift = (r_a @ base[..., None])[..., 0]
    turn = r_b @ r_a.transpose(0, 2, 1)
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
