# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Films of radiographs with the markers and axes of bodies where their poses put them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..bodies.body import STATUS_NAMES, Body, BodyPoses
from ..correction.fluoroscope_calibration import FluoroscopeCalibration
from ..errors import DataError
from ..images.corrector import iterated
from ..images.overlay import BodyView, draw_bodies
from ..io.image_reading import ImageSource
from ..io.image_writing import write_video
from ..photogrammetry.collinearity import project
from ..photogrammetry.rig_orientation import RigOrientation
from .image_sources import fluoroscope_folders, is_image_bag, open_sources

FILM_HZ = 25.0  # slow motion: players show no 250 images a second
AXIS_MM = 20.0  # length of an axis, about the size of a cluster of markers in a bone


@dataclass(frozen=True)
class Film:
    """What films are made of."""

    source: Path  #: bag of images, or folder with a folder for each fluoroscope
    calibrations: Mapping[str, FluoroscopeCalibration]
    orientation: RigOrientation  #: of the fluoroscopes of the recording


def write_films(
    folder: Path, film: Film, bodies: Sequence[Body], poses: Sequence[BodyPoses]
) -> None:
    """Write folder/film_<fluoroscope>.mp4 of the exposures that have an image.

    Raises DataError for images that cannot be read, or are of other exposures.
    """
    folders = fluoroscope_folders(film.source)
    if not folders and not is_image_bag(film.source):
        raise DataError(
            f'{film.source}: this is neither a bag with images nor a folder with a folder of '
            'images for each fluoroscope'
        )
    for name in film.orientation.fluoroscopes:
        if folders and name not in folders:
            raise DataError(f'{film.source}: there is no folder {name} with images')
        source = folders.get(name, film.source)
        frames = _frames(source, film, name, bodies=bodies, poses=poses)
        first = next(frames, None)
        if first is None:
            raise DataError(f'{source}: there is no image of an exposure with poses')
        images = ImageSource('video', 0, _chained(first, frames), FILM_HZ)
        write_video(folder / f'film_{name}.mp4', images, lambda done, total: None)


def _chained(
    first: tuple[str, np.ndarray], rest: Iterator[tuple[str, np.ndarray]]
) -> Iterator[tuple[str, np.ndarray]]:
    yield first
    yield from rest


def _frames(
    source: Path, film: Film, name: str, bodies: Sequence[Body], poses: Sequence[BodyPoses]
) -> Iterator[tuple[str, np.ndarray]]:
    """Yield the pictures of a fluoroscope. Raises DataError for an image that cannot be read."""
    rows = {number: row for row, number in enumerate(poses[0].number.tolist())}
    for image in open_sources([source], name).images():
        if isinstance(image.image, DataError):
            raise image.image.at(image.place)
        row = rows.get(image.exposure)
        if row is not None:
            calibration = film.calibrations[name].at_angle(image.angle)
            views = [
                _view(body, one.rows(one.number == image.exposure), film.orientation, calibration)
                for body, one in zip(bodies, poses)
            ]
            yield image.place, draw_bodies(image.image, f'exposure {image.exposure}', views)


def _view(
    body: Body, pose: BodyPoses, orientation: RigOrientation, calibration: FluoroscopeCalibration
) -> BodyView:
    """Return a body where it is in the observed image of a fluoroscope."""
    row = orientation.fluoroscopes.index(calibration.fluoroscope)
    ends = body.centre + np.vstack([np.zeros(3), AXIS_MM * np.eye(3)])
    points = np.vstack([body.xyz_mm, ends]) @ pose.rotation[0].T + pose.position_mm[0]
    count = len(points)
    uv = project(
        np.broadcast_to(orientation.rotation[row], (count, 3, 3)),
        np.broadcast_to(orientation.position_mm[row], (count, 3)),
        points,
        orientation.interior[row],
    )
    if np.isfinite(uv).all():
        uv = iterated(calibration.grid, uv.T.copy()).T
    return BodyView(body.name, STATUS_NAMES[pose.status[0]], uv[:-4], uv[-4:])
