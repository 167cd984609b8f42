# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The simulation job: a data set of the virtual rig on disk."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Callable
from pathlib import Path

from ..files.folder import FolderKind, replaced_folder
from ..options import option, validate_options
from ..simulation.exposures import Detection, simulate_exposures
from ..simulation.marker_images import (
    HARD_MARKER_SETTINGS,
    MARKER_SETTINGS,
    MarkerScene,
    MarkerSequence,
    MovingMarkers,
)
from ..simulation.radiographs import CLEAN, HARD
from ..simulation.rig import virtual_rig
from ..simulation.streams import START_NS, StreamStart
from ..simulation.tracking import simulate_tracking
from .dataset import (
    CLUSTERS,
    FIRST_MARKERS,
    IMAGES,
    MARKER_IMAGES,
    TRUTH,
    write_exposures,
    write_marker_radiographs,
    write_radiographs,
    write_rig,
    write_tracking,
)

HOUR_NS = 3600 * 10**9
_PARTS = (
    'calibration',
    'calibration.csv',
    'test',
    'test.csv',
    'tracking',
    'phantom.csv',
    IMAGES,
    MARKER_IMAGES,
    FIRST_MARKERS,
    CLUSTERS,
    TRUTH,
)


def _is_own(name: str) -> bool:
    """Return whether an entry belongs to a data set, or is what a killed run left of a part."""
    return name in _PARTS or (name.startswith('.') and name.endswith('.tmp'))


DATA_SET = FolderKind('a data set of the virtual rig', _is_own, lambda name: name == TRUTH)


@dataclasses.dataclass(frozen=True)
class SimulationOptions:
    """Options of a data set. Raises ValueError for a value that an option cannot have."""

    seed: int = option(
        1, 'seed of the random numbers, which determines the rig', minimum=0, maximum=2**31
    )
    exposures: int = option(
        15, 'exposures of the phantom for the calibration', minimum=1, maximum=100000
    )
    test_exposures: int = option(
        0,
        'further exposures, in a bag and CSV file of their own',
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

    def __post_init__(self) -> None:
        validate_options(self)


def simulate(
    directory: str | os.PathLike[str],
    options: SimulationOptions | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> None:
    """Write bags, CSV files, phantom and truth of a virtual rig into a folder.

    An earlier data set is replaced as a whole and kept as DIRECTORY.previous. progress is called
    after every radiograph with their number and total. Raises DataError where the folder cannot
    be written, or is no data set.
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
    rig = virtual_rig(options.seed, options.strength)
    write_rig(directory, rig, dataclasses.asdict(options))
    detection = Detection(options.noise, options.false_matches)
    calibration = simulate_exposures(rig, options.exposures, options.seed, detection)
    write_exposures(directory, 'calibration', rig, calibration)
    settings = {'clean': CLEAN, 'hard': HARD}.get(options.images)
    if settings is not None:
        write_radiographs(directory, rig, calibration, settings, progress)
    if options.marker_images:
        moving = MovingMarkers(MarkerScene(), options.seed)
        taken = MARKER_SETTINGS if options.images != 'hard' else HARD_MARKER_SETTINGS
        sequence = MarkerSequence(rig, moving, taken, options.marker_images, options.seed)
        write_marker_radiographs(directory, sequence, progress)
    # Each part has its own seed, so that its size does not change the others.
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
            options.rate,
            options.seed,
            options.noise,
            StreamStart(START_NS + 2 * HOUR_NS),
        )
        write_tracking(directory, tracking)
