"""Read the frames of a source: a bag, or a CSV file of observations."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from ..bags.reader import read_frames
from ..errors import DataError
from ..exposures.collector import collect_recorded
from ..exposures.frame import Frame
from ..files.observations import read_observations_csv

COLLECT_MODES = ('auto', 'all', 'still')


@dataclass(frozen=True)
class Recording:
    """Frames by fluoroscope, and the numbers of frames without partner that were left out."""

    frames: dict[str, list[Frame]]
    unpaired: Mapping[str, int] = field(default_factory=dict)


def is_csv(path: str | os.PathLike[str]) -> bool:
    """Return whether a source is a CSV file, by its name; else it is a bag."""
    return Path(path).suffix.lower() == '.csv'


def read_source(
    path: str | os.PathLike[str],
    *,
    image_size: tuple[int, int] | None = None,
    fluoroscopes: Sequence[str] | None = None,
    collect: str | None = None,
    validate: bool = True,
) -> Recording:
    """Read the frames of a bag or a CSV file.

    Parameters
    ----------
    path : path-like
        A bag (file or folder) or a CSV file `fluoroscope,exposure,target_id,u,v[,sigma]`.
    image_size : (int, int), optional
        Width and height [px]; needed for a CSV file, which does not hold it.
    fluoroscopes : sequence of str, optional
        Names of those to read, in this order; by default all.
    collect : {'auto', 'all', 'still'}, optional
        How exposures are collected from a bag; by default all frames are returned, unpaired ones
        too. A CSV file holds exposures already.
    validate : bool
        Whether every frame of a bag is validated; else only the lengths of its arrays.

    Returns
    -------
    Recording

    Raises
    ------
    DataError
        For a source that cannot be read, and for a fluoroscope that it does not hold.
    """
    if is_csv(path):
        found = read_observations_csv(path, image_size)
    else:
        found = read_frames(path, validate).frames
    wanted = list(found) if fluoroscopes is None else list(fluoroscopes)
    for name in wanted:
        if name not in found:
            raise DataError(f'{path}: there is no fluoroscope {name!r}, only {", ".join(found)}')
    frames = {name: found[name] for name in wanted}
    if collect is None or is_csv(path):
        return Recording(frames)
    return Recording(*collect_recorded(frames, collect))
