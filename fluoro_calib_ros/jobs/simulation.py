# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The simulation job: write a data set of the virtual rig to disk."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..exposures.frame import Frame
from ..exposures.phantom import EXACT_SD_MM, Phantom
from ..images.codec import encode
from ..io.access import PathLike, make_folder, write_bytes, write_text
from ..io.bags.writer import write_bag
from ..io.bodies import COLUMNS as POSE_COLUMNS
from ..io.bodies import JOINT_COLUMNS as JOINT_COLUMNS
from ..io.bodies import joint_definition, write_bodies
from ..io.csv_table import Table
from ..io.documents import write_json
from ..io.folder import FolderKind, replaced_folder
from ..io.observations import COLUMNS as OBSERVATION_COLUMNS
from ..io.observations import write_observations_csv
from ..io.phantom import write_phantom
from ..options import option, validate_options
from ..photogrammetry.rotations import quaternion_from_matrix
from ..processes import OF_STREAM, WorkerProcess
from ..simulation.knee import JOINT as KNEE
from ..simulation.knee import (
    LANDING_HZ,
    LANDING_S,
    MOTIONS,
    SimulatedKnee,
    VirtualKnee,
    simulate_knee,
    virtual_knee,
)
from ..simulation.marker_images import (
    HARD_MARKER_SETTINGS,
    MARKER_SETTINGS,
    MarkerImage,
    MarkerScene,
    MarkerSequence,
    MovingMarkers,
)
from ..simulation.radiographs import CLEAN, HARD, RadiographSettings, Radiography
from ..simulation.rig import (
    BETWEEN_DEG,
    BETWEEN_THREE_DEG,
    START_NS,
    Detection,
    Pose,
    SimulatedExposures,
    SimulatedTracking,
    StreamStart,
    VirtualFluoroscope,
    VirtualRig,
    simulate_exposures,
    simulate_tracking,
    virtual_rig,
)

# Data set of the virtual rig on disk: bags, CSV files, phantom and truth.

IMAGES = 'images'  # folder of radiographs, with one folder per fluoroscope
MARKER_IMAGES = 'marker_images'  # the same for moving markers
FIRST_MARKERS = 'first_markers.csv'  # their positions in the first image, to the nearest pixel
BODIES = 'bodies.csv'
JOINTS = 'joints.toml'
CLUSTERS = 'clusters.txt'  # rigid groups of markers, one line per cluster
TRUTH = 'truth'  # folder of the true values of a data set


def _rows(
    begin: Sequence[object],
    ids: Iterable[object],
    values: Iterable[NDArray[np.float64]],
    digits: int,
) -> Iterator[list[object]]:
    """Yield rows that start with the same values, followed by an id and formatted numbers."""
    for identity, numbers in zip(ids, values):
        yield [*begin, identity, *(f'{x:.{digits}f}' for x in numbers)]


def write_exposures(
    directory: Path, name: str, rig: VirtualRig, simulated: SimulatedExposures
) -> None:
    """Write exposures as NAME (bag) and NAME.csv, with their truth.

    truth/NAME_exposures.csv contains the exterior orientations, truth/NAME_undistorted.csv the
    observed points after a perfect correction. Raises DataError.
    """
    write_bag(directory / name, simulated.frames)
    write_observations_csv(directory / f'{name}.csv', simulated.frames)
    undistorted_frames = {
        fluoroscope: [
            Frame(f.fluoroscope, f.number, f.target_id, np.round(uv, 6), f.image_size)
            for f, uv in zip(frames, simulated.undistorted[fluoroscope])
        ]
        for fluoroscope, frames in simulated.frames.items()
    }
    write_observations_csv(directory / TRUTH / f'{name}_undistorted.csv', undistorted_frames)
    rows: list[list[object]] = []
    for fluoroscope in rig.fluoroscopes:
        numbers = [frame.number for frame in simulated.frames[fluoroscope.name]]
        exterior = [fluoroscope.exterior(pose) for pose in simulated.poses]
        values = [np.append(position, quaternion_from_matrix(turn)) for turn, position in exterior]
        rows += _rows([fluoroscope.name], numbers, values, 9)
    header = ('fluoroscope', 'exposure', 'x_mm', 'y_mm', 'z_mm', 'qw', 'qx', 'qy', 'qz')
    Table(header, rows).write(directory / TRUTH / f'{name}_exposures.csv')


def write_radiographs(
    directory: Path,
    rig: VirtualRig,
    simulated: SimulatedExposures,
    settings: RadiographSettings,
    progress: Callable[[int, int], None] | None = None,
) -> None:
    """Write a radiograph of every exposure as images/FLUOROSCOPE/NUMBER.png, with its truth.

    truth/images.csv contains the centres of all beads in the field of view. progress is called
    after every image with the number of finished images and their total. Raises DataError.
    """
    rows: list[list[object]] = []
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
            prefix = (fluoroscope.name, frame.number)
            rows += _rows(prefix, rig.phantom.target_id[seen], centres[seen], 4)
            done += 1
            if progress is not None:
                progress(done, total)
    Table(OBSERVATION_COLUMNS, rows).write(directory / TRUTH / 'images.csv')


def write_marker_radiographs(
    directory: Path,
    sequence: MarkerSequence,
    progress: Callable[[int, int], None] | None = None,
) -> None:
    """Write radiographs of moving markers as marker_images/FLUOROSCOPE/NUMBER.png.

    first_markers.csv contains the markers in the first images, to the nearest pixel, as a person
    would point at them; clusters.txt the rigid clusters; truth/marker_images.csv the true centres
    of all markers, with 1 for visible ones; truth/marker_images_points.csv their points in space
    [mm]. progress is called as by `write_radiographs`. Raises DataError.
    """
    markers = sequence.markers
    names = [fluoroscope.name for fluoroscope in sequence.rig.fluoroscopes]
    for name in names:
        make_folder(directory / MARKER_IMAGES / name)
    rows: list[list[object]] = []
    points: list[list[object]] = []
    for number, views in enumerate(sequence, 1):
        for name, view in views.items():
            path = directory / MARKER_IMAGES / name / f'{number:04d}.png'
            write_bytes(path, encode(view.image, '.png'))
            view_rows = _rows((name, number), markers.target_id, view.uv, 4)
            rows += ([*row, int(seen)] for row, seen in zip(view_rows, view.seen))
        points += _rows([number], markers.target_id, markers.points_mm(number), 6)
        if number == 1:
            write_observations_csv(directory / FIRST_MARKERS, _first_markers(views, markers))
        if progress is not None:
            progress(number * len(names), sequence.frames * len(names))
    Table((*OBSERVATION_COLUMNS, 'seen'), rows).write(directory / TRUTH / 'marker_images.csv')
    columns = ('exposure', 'target_id', 'x_mm', 'y_mm', 'z_mm')
    Table(columns, points).write(directory / TRUTH / 'marker_images_points.csv')
    clusters = [
        f'cluster_{number + 1}: {" ".join(map(str, markers.target_id[markers.cluster == number]))}'
        for number in range(markers.scene.clusters)
    ]
    write_text(directory / CLUSTERS, '\n'.join(clusters) + '\n')


def _first_markers(
    views: Mapping[str, MarkerImage], markers: MovingMarkers
) -> dict[str, list[Frame]]:
    """Return the markers visible in the images of an exposure, to the nearest pixel."""
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


def write_tracking(directory: Path, tracking: SimulatedTracking) -> None:
    """Write a recording of markers as the bag tracking, and truth/markers.csv."""
    write_bag(directory / 'tracking', tracking.frames)
    numbers = [frame.number for frame in next(iter(tracking.frames.values()))]
    rows = (
        row
        for number, points in zip(numbers, tracking.points_mm)
        for row in _rows([number], tracking.marker_id, points, 6)
    )
    header = ('frame', 'target_id', 'x_mm', 'y_mm', 'z_mm')
    Table(header, rows).write(directory / TRUTH / 'markers.csv')


def write_knee(directory: Path, knee: VirtualKnee) -> None:
    """Write bodies.csv and joints.toml of a knee, and truth/bodies.csv. Raises DataError."""
    write_bodies(directory / BODIES, knee.surveyed)
    write_bodies(directory / TRUTH / BODIES, knee.bodies)
    write_text(directory / JOINTS, joint_definition(knee.joint, knee.landmarks))


def write_knee_recording(directory: Path, name: str, recording: SimulatedKnee) -> None:
    """Write a recording of a knee as the bag NAME, with truth/NAME_poses.csv and NAME_joints.csv.

    Their columns are the first ones of poses.csv and joints.csv. Raises DataError.
    """
    write_bag(directory / name, recording.frames)
    motion = recording.motion
    numbers = [frame.number for frame in next(iter(recording.frames.values()))]
    rows: list[list[object]] = []
    for body, rotation in motion.rotation.items():
        wxyz = quaternion_from_matrix(rotation)
        values = np.column_stack(
            [motion.times_s, motion.position_mm[body], wxyz[:, 1:], wxyz[:, :1]]
        )
        rows += _rows([body], numbers, values, 9)
    Table(POSE_COLUMNS[:10], rows).write(directory / TRUTH / f'{name}_poses.csv')
    values = np.column_stack([motion.times_s, np.rad2deg(motion.angles), motion.translations])
    rows = list(_rows([KNEE], numbers, values, 9))
    Table(JOINT_COLUMNS[:9], rows).write(directory / TRUTH / f'{name}_joints.csv')


def write_rig(directory: Path, rig: VirtualRig, options: Mapping[str, Any]) -> None:
    """Write phantom.csv (the survey), truth/phantom.csv (true coordinates) and truth/rig.json.

    options: those of the simulation. Raises DataError.
    """
    make_folder(directory / TRUTH)
    write_phantom(directory / 'phantom.csv', rig.phantom)
    write_phantom(
        directory / TRUTH / 'phantom.csv',
        Phantom(rig.phantom.target_id, rig.true_mm, np.full(len(rig.true_mm), EXACT_SD_MM)),
    )
    write_json(
        directory / TRUTH / 'rig.json',
        {
            'made_with': dict(options),
            'fluoroscopes': {f.name: _fluoroscope(f) for f in rig.fluoroscopes},
        },
    )


def _fluoroscope(fluoroscope: VirtualFluoroscope) -> dict[str, Any]:
    return {
        'interior': dict(zip(('xp', 'yp', 'c'), fluoroscope.interior)),
        'image_size': list(fluoroscope.image_size),
        'position_mm': fluoroscope.position_mm,
        'quaternion_wxyz': quaternion_from_matrix(fluoroscope.rotation),
        'distortion': vars(fluoroscope.distortion),
    }


# Radiographs of a virtual rig, rendered in separate processes.

SETTINGS = {'clean': CLEAN, 'hard': HARD}
MARKER_MM = 1.0  # diameter of a marker


@dataclass(frozen=True)
class RenderedScene:
    """Scene of which radiographs are rendered."""

    points_mm: NDArray[np.float64]  #: (n, 3), centres of beads or markers
    pose: Pose  #: transforms them into the rig frame
    seed: int = 0  #: seed of noise and clutter
    diameter_mm: NDArray[np.float64] | None = None  #: (n,), None: the usual diameter of beads
    plates: bool = True  #: whether the faces of the phantom are present


class Renderers:
    """Renders radiographs of the fluoroscopes of a virtual rig, each in its own process."""

    def __init__(
        self, fluoroscopes: Sequence[VirtualFluoroscope], settings: RadiographSettings
    ) -> None:
        self._processes = {
            f.name: WorkerProcess(
                partial(_camera, f, settings), 'the process of rendering', OF_STREAM
            )
            for f in fluoroscopes
        }

    def start(self) -> None:
        """Start the processes, so that they are ready for the first scene."""
        for process in self._processes.values():
            process.start()

    def images(self, scene: RenderedScene) -> Mapping[str, np.ndarray]:
        """Return the radiographs (h, w) of a scene. Raises RuntimeError after close()."""
        for process in self._processes.values():
            process.send(scene)
        return {name: process.receive() for name, process in self._processes.items()}

    def close(self) -> None:
        """End the processes, even while they render."""
        for process in self._processes.values():
            process.close()


def _camera(
    fluoroscope: VirtualFluoroscope, settings: RadiographSettings
) -> Callable[[RenderedScene], np.ndarray]:
    radiography = Radiography(fluoroscope, settings)
    return lambda scene: radiography.image(
        scene.points_mm, scene.pose, scene.seed, scene.diameter_mm, scene.plates
    )


HOUR_NS = 3600 * 10**9  # time from one recording to the next
NAMES = 'abcdefgh'  # names of fluoroscopes
DATA_SET = FolderKind(
    'a data set of the virtual rig',
    parts=(
        *('calibration', 'calibration.csv', 'test', 'test.csv', 'tracking', 'phantom.csv'),
        *(IMAGES, MARKER_IMAGES, FIRST_MARKERS, CLUSTERS, *MOTIONS, BODIES, JOINTS, TRUTH),
    ),
    marks=(TRUTH,),
)


@dataclasses.dataclass(frozen=True)
class SimulationOptions:
    """Options of a data set. Raises ValueError for an invalid value."""

    seed: int = option(
        1, 'seed of the random numbers, which determines the rig', minimum=0, maximum=2**31
    )
    exposures: int = option(
        15, 'exposures of the phantom for the calibration', minimum=1, maximum=100000
    )
    test_exposures: int = option(
        0,
        'further exposures, in a separate bag and CSV file',
        minimum=0,
        maximum=100000,
    )
    seconds: float = option(
        3.0, 'duration of the recording of moving markers', minimum=0, maximum=86400, unit='s'
    )
    rate: float = option(
        120.0, 'frame rate of the recording of moving markers', minimum=1, maximum=2000, unit='Hz'
    )
    noise: float = option(0.25, 'image noise', minimum=0, maximum=100, unit='px')
    false_matches: float = option(
        0.01, 'fraction of the targets with a wrong id', minimum=0, maximum=0.5
    )
    strength: float = option(1.0, 'strength of the distortion', minimum=0, maximum=10)
    bodies: bool = option(
        False,
        'recordings of a knee that walks, as long and at the rate of the moving markers, and that '
        'lands, with its bodies and joints',
    )
    images: str = option(
        'none',
        'radiographs of the exposures of the phantom, clean or with clutter and little dose',
        choices=('none', 'clean', 'hard'),
    )
    marker_images: int = option(
        0,
        'radiographs of moving markers with each fluoroscope, in bones and with the clutter of '
        'the images',
        minimum=0,
        maximum=100000,
    )
    fluoroscopes: int = option(2, 'fluoroscopes of the rig', minimum=2, maximum=len(NAMES))

    def __post_init__(self) -> None:
        validate_options(self)


def simulate(
    directory: PathLike,
    options: SimulationOptions | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> None:
    """Write bags, CSV files, phantom and truth of a virtual rig into a folder.

    An earlier data set is replaced as a whole and kept as DIRECTORY.previous. progress is called
    after every radiograph with its number and the total. Raises DataError if the folder cannot be
    written, or is not a data set.
    """
    options = options or SimulationOptions()
    with replaced_folder(directory, DATA_SET) as folder:
        _write(folder, options, progress)


def _write(
    directory: Path,
    options: SimulationOptions,
    progress: Callable[[int, int], None] | None,
) -> None:
    """Write the parts of a data set."""
    names = NAMES[: options.fluoroscopes]
    between_deg = min(BETWEEN_DEG, 2 * BETWEEN_THREE_DEG / (len(names) - 1))
    rig = virtual_rig(options.seed, options.strength, names, between_deg=between_deg)
    write_rig(directory, rig, dataclasses.asdict(options))
    detection = Detection(options.noise, options.false_matches)
    calibration = simulate_exposures(rig, options.exposures, options.seed, detection)
    write_exposures(directory, 'calibration', rig, calibration)
    settings = SETTINGS.get(options.images)
    if settings is not None:
        write_radiographs(directory, rig, calibration, settings, progress)
    if options.marker_images:
        markers = MovingMarkers(MarkerScene(), options.seed)
        image_settings = MARKER_SETTINGS if options.images != 'hard' else HARD_MARKER_SETTINGS
        sequence = MarkerSequence(
            rig, markers, image_settings, options.marker_images, options.seed
        )
        write_marker_radiographs(directory, sequence, progress)
    # Each part has its own seed, so that its size does not affect the others.
    if options.test_exposures:
        test = simulate_exposures(
            rig,
            options.test_exposures,
            options.seed + 1_000_000,
            detection,
            StreamStart(START_NS + HOUR_NS, options.exposures + 1),
        )
        write_exposures(directory, 'test', rig, test)
    if options.seconds:
        tracking = simulate_tracking(
            rig,
            options.seconds,
            rate_hz=options.rate,
            seed=options.seed,
            noise_px=options.noise,
            start=StreamStart(START_NS + 2 * HOUR_NS),
        )
        write_tracking(directory, tracking)
    if options.bodies:
        _write_knee(directory, rig, options)


def _write_knee(directory: Path, rig: VirtualRig, options: SimulationOptions) -> None:
    """Write the knee and its recordings."""
    knee = virtual_knee(options.seed)
    write_knee(directory, knee)
    lengths = {
        'walking': (options.seconds, options.rate),
        'landing': (LANDING_S, LANDING_HZ),
    }
    for number, (name, move) in enumerate(MOTIONS.items()):
        seconds, rate = lengths[name]
        times_s = np.arange(round(seconds * rate)) / rate
        recording = simulate_knee(
            rig,
            knee,
            move(knee, times_s),
            noise_px=options.noise,
            seed=options.seed + number,
            start=StreamStart(START_NS + (3 + number) * HOUR_NS),
        )
        write_knee_recording(directory, name, recording)
