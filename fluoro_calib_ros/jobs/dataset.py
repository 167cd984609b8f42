# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""A data set of the virtual rig on disk: bags, CSV files, phantom and truth."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..bags.writer import BagWriter
from ..exposures.frame import Frame
from ..exposures.phantom import Phantom
from ..files.access import PathLike, make_folder
from ..files.atomic import write_bytes, write_text
from ..files.json_file import write_json
from ..files.observations import write_observations_csv
from ..files.phantom import write_phantom
from ..images.codec import encode
from ..photogrammetry.rotations import quaternion_from_matrix
from ..simulation.exposures import SimulatedExposures
from ..simulation.marker_images import MarkerImage, MarkerSequence, MovingMarkers
from ..simulation.radiographs import RadiographSettings, Radiography
from ..simulation.rig import VirtualFluoroscope, VirtualRig
from ..simulation.tracking import SimulatedTracking

IMAGES = 'images'  # folder of radiographs, a folder for each fluoroscope
MARKER_IMAGES = 'marker_images'  # the same of moving markers
FIRST_MARKERS = 'first_markers.csv'  # where they are in the first image, to some pixel
CLUSTERS = 'clusters.txt'  # markers that are rigid together, a line for each cluster
TRUTH = 'truth'  # folder of what a data set was made with
TRUE_SD_MM = 1e-6  # the file of the true coordinates has to contain a standard deviation


def write_bag(path: PathLike, frames: Mapping[str, Sequence[Frame]]) -> None:
    """Write frames as a bag folder, in the order of their stamps. Raises DataError."""
    recorded = [frame for of_fluoroscope in frames.values() for frame in of_fluoroscope]
    with BagWriter(path, overwrite=True) as bag:
        for frame in sorted(recorded, key=lambda f: f.stamp_ns):
            bag.write_frame(frame)


def write_exposures(
    directory: PathLike, name: str, rig: VirtualRig, simulated: SimulatedExposures
) -> None:
    """Write exposures as NAME (bag) and NAME.csv, with their truth.

    truth/NAME_exposures.csv contains the exterior orientations, truth/NAME_undistorted.csv the
    observed points after a perfect correction. Raises DataError.
    """
    directory = Path(directory)
    write_bag(directory / name, simulated.frames)
    write_observations_csv(directory / f'{name}.csv', simulated.frames)
    perfect = {
        fluoroscope: [
            Frame(f.fluoroscope, f.number, f.target_id, np.round(uv, 6), f.image_size)
            for f, uv in zip(frames, simulated.undistorted[fluoroscope])
        ]
        for fluoroscope, frames in simulated.frames.items()
    }
    write_observations_csv(directory / TRUTH / f'{name}_undistorted.csv', perfect)
    lines = ['fluoroscope,exposure,x_mm,y_mm,z_mm,qw,qx,qy,qz']
    for fluoroscope in rig.fluoroscopes:
        for frame, pose in zip(simulated.frames[fluoroscope.name], simulated.poses):
            rotation, position = fluoroscope.exterior(pose)
            numbers = [f'{x:.9f}' for x in (*position, *quaternion_from_matrix(rotation))]
            lines.append(','.join([fluoroscope.name, str(frame.number), *numbers]))
    write_text(directory / TRUTH / f'{name}_exposures.csv', '\n'.join(lines) + '\n')


def write_radiographs(
    directory: PathLike,
    rig: VirtualRig,
    simulated: SimulatedExposures,
    settings: RadiographSettings,
    progress: Callable[[int, int], None] | None = None,
) -> None:
    """Write a radiograph of every exposure as images/FLUOROSCOPE/NUMBER.png, with its truth.

    truth/images.csv contains the centres of all beads in the field of view. progress is called
    after every image with the number of images that are done, and their total. Raises DataError.
    """
    directory = Path(directory)
    lines = ['fluoroscope,exposure,target_id,u,v']
    total = len(rig.fluoroscopes) * len(simulated.poses)
    done = 0
    for fluoroscope in rig.fluoroscopes:
        folder = directory / IMAGES / fluoroscope.name
        make_folder(folder)
        radiography = Radiography(fluoroscope, settings)
        for frame, pose in zip(simulated.frames[fluoroscope.name], simulated.poses):
            image = radiography.image(rig.true_mm, pose, frame.number)
            write_bytes(folder / f'{frame.number:04d}.png', encode(image, '.png'))
            centres = radiography.centres(rig.true_mm, pose)
            seen = np.flatnonzero(radiography.in_field(centres))
            lines += [
                f'{fluoroscope.name},{frame.number},{target},{u:.4f},{v:.4f}'
                for target, (u, v) in zip(rig.phantom.target_id[seen], centres[seen])
            ]
            done += 1
            if progress is not None:
                progress(done, total)
    write_text(directory / TRUTH / 'images.csv', '\n'.join(lines) + '\n')


def write_marker_radiographs(
    directory: PathLike,
    sequence: MarkerSequence,
    progress: Callable[[int, int], None] | None = None,
) -> None:
    """Write radiographs of moving markers as marker_images/FLUOROSCOPE/NUMBER.png.

    first_markers.csv contains the markers of the first images, to the nearest pixel, as a person
    would point at them; clusters.txt the rigid clusters, truth/marker_images.csv the true centres
    of all markers with 1 for those that are seen, truth/marker_images_points.csv their points in
    space [mm]. progress is called as by `write_radiographs`. Raises DataError.
    """
    directory = Path(directory)
    markers = sequence.markers
    names = [fluoroscope.name for fluoroscope in sequence.rig.fluoroscopes]
    for name in names:
        make_folder(directory / MARKER_IMAGES / name)
    lines = ['fluoroscope,exposure,target_id,u,v,seen']
    points = ['exposure,target_id,x_mm,y_mm,z_mm']
    for number, views in enumerate(sequence, 1):
        for name, view in views.items():
            path = directory / MARKER_IMAGES / name / f'{number:04d}.png'
            write_bytes(path, encode(view.image, '.png'))
            lines += [
                f'{name},{number},{target},{u:.4f},{v:.4f},{int(seen)}'
                for target, (u, v), seen in zip(markers.target_id, view.uv, view.seen)
            ]
        points += [
            f'{number},{target},{x:.6f},{y:.6f},{z:.6f}'
            for target, (x, y, z) in zip(markers.target_id, markers.points_mm(number))
        ]
        if number == 1:
            write_observations_csv(directory / FIRST_MARKERS, _first_markers(views, markers))
        if progress is not None:
            progress(number * len(names), sequence.frames * len(names))
    write_text(directory / TRUTH / 'marker_images.csv', '\n'.join(lines) + '\n')
    write_text(directory / TRUTH / 'marker_images_points.csv', '\n'.join(points) + '\n')
    clusters = [
        f'cluster_{number + 1}: {" ".join(map(str, markers.target_id[markers.cluster == number]))}'
        for number in range(markers.scene.clusters)
    ]
    write_text(directory / CLUSTERS, '\n'.join(clusters) + '\n')


def _first_markers(
    views: Mapping[str, MarkerImage], markers: MovingMarkers
) -> dict[str, list[Frame]]:
    """Return the markers that are seen in the images of an exposure, to the nearest pixel."""
    return {
        name: [
            Frame(
                name,
                1,
                markers.target_id[view.seen],
                np.rint(view.uv[view.seen]),
                (view.image.shape[1], view.image.shape[0]),
            )
        ]
        for name, view in views.items()
    }


def write_tracking(directory: PathLike, tracking: SimulatedTracking) -> None:
    """Write a recording of markers as the bag tracking, and truth/markers.csv."""
    directory = Path(directory)
    write_bag(directory / 'tracking', tracking.frames)
    numbers = [frame.number for frame in next(iter(tracking.frames.values()))]
    lines = ['frame,target_id,x_mm,y_mm,z_mm']
    for number, points in zip(numbers, tracking.points_mm):
        lines += [
            f'{number},{marker},{x:.6f},{y:.6f},{z:.6f}'
            for marker, (x, y, z) in zip(tracking.marker_id, points)
        ]
    write_text(directory / TRUTH / 'markers.csv', '\n'.join(lines) + '\n')


def write_rig(directory: PathLike, rig: VirtualRig, options: Mapping[str, Any]) -> None:
    """Write phantom.csv (the survey), truth/phantom.csv (true coordinates) and truth/rig.json.

    options are those of the simulation. Raises DataError.
    """
    directory = Path(directory)
    make_folder(directory / TRUTH)
    write_phantom(directory / 'phantom.csv', rig.phantom)
    write_phantom(
        directory / TRUTH / 'phantom.csv',
        Phantom(rig.phantom.target_id, rig.true_mm, np.full(len(rig.true_mm), TRUE_SD_MM)),
    )
    write_json(
        directory / TRUTH / 'rig.json',
        {
            'made_with': dict(options),
            'fluoroscopes': {f.name: _fluoroscope(f) for f in rig.fluoroscopes},
        },
    )


def _fluoroscope(fluoroscope: VirtualFluoroscope) -> dict[str, Any]:
    distortion = fluoroscope.distortion
    return {
        'interior': dict(zip(('xp', 'yp', 'c'), fluoroscope.interior)),
        'image_size': list(fluoroscope.image_size),
        'position_mm': fluoroscope.position_mm,
        'quaternion_wxyz': quaternion_from_matrix(fluoroscope.rotation),
        'distortion': {
            'centre': distortion.centre,
            'pincushion': distortion.pincushion,
            's_shape': distortion.s_shape,
            'spiral': distortion.spiral,
            'ripples': distortion.ripples,
        },
    }
