"""Read the input of jobs: the frames of a bag or a CSV file, and calibrations."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from ..bags.reader import read_frames
from ..calibration.result import FluoroscopeCalibration
from ..errors import DataError
from ..exposures.collector import collect_recorded
from ..exposures.frame import Frame
from ..files.calibration import load_calibrations
from ..files.observations import read_observations_csv


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
        Width and height [px]; needed for a CSV file, which does not contain it.
    fluoroscopes : sequence of str, optional
        Names of those to read, in this order; by default all.
    collect : {'auto', 'all', 'still'}, optional
        How exposures are collected from a bag; by default all frames are returned, unpaired ones
        too. A CSV file already consists of exposures.
    validate : bool
        Whether every frame of a bag is validated; else only the lengths of its arrays.

    Returns
    -------
    Recording

    Raises
    ------
    DataError
        For a source that cannot be read, and for a fluoroscope that it does not contain.
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


def select_calibrations(
    calibrations: Mapping[str, FluoroscopeCalibration],
    fluoroscopes: Iterable[str],
    where: str | os.PathLike[str] = '',
) -> dict[str, FluoroscopeCalibration]:
    """Return the calibrations of some fluoroscopes.

    where begins the message of the DataError that is raised for a missing calibration.
    """
    place = f'{where}: ' if where else ''
    if not calibrations:
        raise DataError(f'{place}there is no calibration')
    for name in fluoroscopes:
        if name not in calibrations:
            raise DataError(
                f'{place}there is no calibration of fluoroscope {name!r}, '
                f'only of {", ".join(calibrations)}'
            )
    return {name: calibrations[name] for name in fluoroscopes}


def read_calibrations(
    directory: str | os.PathLike[str], fluoroscopes: Sequence[str] | None = None
) -> dict[str, FluoroscopeCalibration]:
    """Read the calibrations in a result folder, by default all.

    Raises DataError for a folder without calibrations, a missing one, and a damaged file.
    """
    found = load_calibrations(directory)
    if not found:
        raise DataError(f'{directory}: there is no calibration in this folder')
    return select_calibrations(found, found if fluoroscopes is None else fluoroscopes, directory)


def read_calibrated_source(
    path: str | os.PathLike[str],
    directory: str | os.PathLike[str],
    *,
    image_size: tuple[int, int] | None = None,
    fluoroscopes: Sequence[str] | None = None,
    validate: bool = True,
) -> tuple[dict[str, list[Frame]], dict[str, FluoroscopeCalibration]]:
    """Read all frames of a source whose fluoroscopes are calibrated, and all calibrations.

    Parameters
    ----------
    path : path-like
        A bag or a CSV file.
    directory : path-like
        The result folder with the calibrations.
    image_size : (int, int), optional
        Of a CSV file; by default that of the calibration.
    fluoroscopes, validate
        As in `read_source`.

    Returns
    -------
    frames : dict of str to list of Frame
    calibrations : dict of str to FluoroscopeCalibration

    Raises
    ------
    DataError
        Also for a fluoroscope of the source without calibration.
    """
    calibrations = read_calibrations(directory)
    if image_size is None:
        image_size = next(iter(calibrations.values())).image_size
    frames = read_source(
        path, image_size=image_size, fluoroscopes=fluoroscopes, validate=validate
    ).frames
    select_calibrations(calibrations, frames, directory)
    return frames, calibrations
