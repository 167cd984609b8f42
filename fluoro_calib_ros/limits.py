# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Limits of input sizes, in one place.

They lie far above the needs of a laboratory, and bound time and memory if a file or message claims
more. `StreamLimits` and `CollectLimits` are parameters of the nodes. `ReadLimits` hold for
everything that a process reads; they are parameters of the nodes and options of the command line,
which set them once, at the start, and worker processes inherit them.
"""

from __future__ import annotations

from dataclasses import dataclass

from .options import option, validate_options

MEGABYTE = 2**20

# Bags [bytes].
MAX_CHUNK = 512 * MEGABYTE  # of a chunk in a bag, uncompressed
# Of a compressed file of a bag, unpacked over packed; image points have 2, images of a test 20.
MAX_EXPANSION = 100
MAX_OBSERVATIONS = 4 * MEGABYTE  # of a message in a bag: 150,000 image points
MAX_TOPICS = 2000  # of a bag
BYTES_OF_HEAD = 4096  # of a message of image points: header and names
BYTES_OF_POINT = 41  # at most: an id, four numbers and a status, with padding
# Calibrations and orientations of the rig, in files and messages.
MAX_IMAGE_SIDE = 32_000  # px: OpenCV stores whole pixels in 16 bits
MAX_ANGLES = 10_000  # of the exposures of a calibration
MAX_CORNERS = 1000  # of the calibrated area
MAX_NEIGHBOURS = 1000  # of a model read from a file or message
MAX_COINCIDENT = 1000  # training points at the same position
MAX_PX = 1e6  # maximum magnitude of a coordinate or correction
MAX_PRINCIPAL_DISTANCE_PX = 1e9
BYTES_OF_TRAINING_POINT = 36  # in a message: four numbers and an exposure
BYTES_OF_CALIBRATION = 2 * MEGABYTE  # maximum of a message, without training points
BYTES_OF_IMAGE = MEGABYTE  # maximum of a message, without pixels
MAX_JOINTS = 1000  # in a joints.toml
# Texts [characters].
MAX_TEXT = 4096  # of a parameter, or of a text in a request
# Documents of other programs and people: maximum size passed to a parser at once, by format.
DOCUMENT_BYTES = {
    'TOML': MEGABYTE // 4,  # rig.toml, Anipose: some kB
    'YAML': 2 * MEGABYTE,  # metadata.yaml of a bag with hundreds of topics: 0.5 MB
    'JSON': 32 * MEGABYTE,  # result.json with 100,000 targets: 15 MB
    'XML': 8 * MEGABYTE,  # projects of XMALab: below 1 MB
}
MAX_DEPTH = 100  # of nesting in a document
# Text tables: a row takes up to 0.3 kB and 2.5 us, in our own CSV files 0.05 kB and 1 us.
MAX_ROWS = 2_000_000  # of other programs: one row per frame, for two hours at 250 Hz
MAX_ROWS_CSV = 20_000_000  # of our own tables
MAX_FRAMES = 2_000_000  # of a file of image points: 1 kB and 40 us each
MAX_MEMBER = 64 * MEGABYTE  # of a text in an archive, unpacked


@dataclass(frozen=True)
class ReadLimits:
    """Limits for reading files and messages."""

    max_file_mb: int = option(
        268,
        'files that are read as a whole, and unpacked archives; larger ones are refused unread',
        minimum=1,
        maximum=100_000,
        unit='MB',
    )
    max_image_megapixels: int = option(
        64,
        'images, of 2^20 px; larger ones are refused by their header',
        minimum=1,
        maximum=1024,
        unit='megapixels',
    )
    max_training_points: int = option(
        200_000,
        'training points of a calibration; those with more are refused',
        minimum=1,
        maximum=10_000_000,
    )
    max_targets: int = option(
        100_000, 'targets of a phantom; those with more are refused', minimum=1, maximum=10_000_000
    )
    max_fluoroscopes: int = option(
        16,
        'fluoroscopes of a rig orientation; those with more are refused',
        minimum=1,
        maximum=1000,
    )
    max_name_length: int = option(
        100,
        'characters of the name of a fluoroscope in files; longer ones are refused',
        minimum=1,
        maximum=200,
    )

    def __post_init__(self) -> None:
        validate_options(self)

    @property
    def max_file_bytes(self) -> int:
        """Maximum size of a file."""
        return self.max_file_mb * 10**6

    @property
    def max_pixels(self) -> int:
        """Maximum number of pixels of an image."""
        return self.max_image_megapixels * MEGABYTE

    @property
    def max_image_bytes(self) -> int:
        """Maximum size of an image message, with 16 bits per pixel."""
        return 2 * self.max_pixels + BYTES_OF_IMAGE

    @property
    def max_calibration_bytes(self) -> int:
        """Maximum size of a calibration message."""
        return BYTES_OF_CALIBRATION + BYTES_OF_TRAINING_POINT * self.max_training_points


# One set of limits per process: readers are called from everywhere, and the functions above them
# need not pass limits on.
_of_this_process = [ReadLimits()]


def read_limits() -> ReadLimits:
    """Return the limits of this process."""
    return _of_this_process[0]


def use_read_limits(limits: ReadLimits) -> None:
    """Set the limits of this process, at its start."""
    _of_this_process[0] = limits


@dataclass(frozen=True)
class StreamLimits:
    """Limits of a node for a stream of image points."""

    max_points: int = option(
        20_000,
        'image points of a message; larger messages are dropped unread and counted',
        minimum=1,
        maximum=1_000_000,
    )

    @property
    def max_bytes(self) -> int:
        """Maximum size of a message of image points."""
        return BYTES_OF_HEAD + BYTES_OF_POINT * self.max_points


@dataclass(frozen=True)
class CollectLimits(StreamLimits):
    """Limits of what the calibration node collects and keeps for its peers."""

    max_exposures: int = option(
        500,
        'exposures that are collected; more are refused until a reset',
        minimum=1,
        maximum=100_000,
    )
    max_waiting: int = option(
        100,
        'requests that may wait for an exposure at once; more are refused',
        minimum=1,
        maximum=10_000,
    )
    max_folders: int = option(
        100,
        'folders below calibration_directory that save_calibration may make',
        minimum=0,
        maximum=100_000,
    )
