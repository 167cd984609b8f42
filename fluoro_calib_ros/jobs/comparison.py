# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The comparison job: what changed between two result folders."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..errors import DataError
from ..files.calibration import load_calibrations
from ..validation.comparison import Comparison, compare_calibrations
from .conversion import stations_of
from .result_folder import RESULT


@dataclass(frozen=True)
class ComparedFolders:
    """Comparisons by fluoroscope, the scale at the phantom, and what could not be compared.

    Attributes
    ----------
    comparisons : dict of str to Comparison
    mm_per_px : dict of str to float
        At the median distance of the phantom; without an entry where result.json is missing.
    notes : tuple of str
    """

    comparisons: dict[str, Comparison]
    mm_per_px: dict[str, float]
    notes: tuple[str, ...]


def compare_folders(
    first: str | os.PathLike[str], second: str | os.PathLike[str]
) -> ComparedFolders:
    """Compare the calibrations of the fluoroscopes that two result folders have in common.

    Raises DataError where there are none, and for calibrations that cannot be compared.
    """
    one = load_calibrations(first)
    other = load_calibrations(second)
    common = [name for name in one if name in other]
    if not common:
        raise DataError(
            f'{second}: there are calibrations of {", ".join(other)}, and in {first} of '
            f'{", ".join(one)}: no fluoroscope is in both'
        )
    notes = [
        f'fluoroscope {name} is in {folder} only'
        for folder, own, foreign in ((first, one, other), (second, other, one))
        for name in own
        if name not in foreign
    ]
    comparisons = {name: compare_calibrations(one[name], other[name]) for name in common}
    distances = _distances(Path(first))
    scales = {n: distances[n] / float(one[n].interior[2]) for n in common if n in distances}
    return ComparedFolders(comparisons, scales, tuple(notes))


def _distances(directory: Path) -> dict[str, float]:
    """Return the median distance of the phantom from the source by fluoroscope [mm]."""
    if not (directory / RESULT).exists():
        return {}
    found: dict[str, list[float]] = {}
    for station in stations_of(directory / RESULT):
        found.setdefault(station.fluoroscope, []).append(
            float(np.linalg.norm(station.position_mm))
        )
    return {name: float(np.median(values)) for name, values in found.items()}
