# Copyright 2026 fluoro_calib_ros maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""Limits of what is read, in one place.

They lie far above what a lab has, and bound time and memory where a file or message claims more.
`StreamLimits` and `CollectLimits` are parameters of the nodes; the others hold for files and
messages, whoever reads them.
"""

from __future__ import annotations

from dataclasses import dataclass

from .options import option

MEGABYTE = 2**20

# Files and bags [bytes].
MAX_FILE = 256 * MEGABYTE  # that is read as a whole: some five million image points
MAX_CHUNK = 512 * MEGABYTE  # of a bag, without compression
MAX_OBSERVATIONS = 4 * MEGABYTE  # of a message in a bag: 150,000 image points
MAX_TOPICS = 2000  # of a bag
# Messages that a node takes [bytes]: an image of MAX_PIXELS with 16 bits, and its header.
MAX_MESSAGE = 130 * MEGABYTE
BYTES_OF_HEAD = 4096  # of a message of image points: header and names
BYTES_OF_POINT = 41  # at most: an id, four numbers and a status, and their padding
# Images.
MAX_PIXELS = 64 * MEGABYTE  # 8192 x 8192
# Calibrations and orientations of the rig, in files and messages.
MAX_IMAGE_SIDE = 32_000  # px: OpenCV holds whole pixels in 16 bits
MAX_TRAINING_POINTS = 200_000
MAX_CORNERS = 1000  # of the calibrated area
MAX_NEIGHBOURS = 1000
MAX_COINCIDENT = 1000  # training points on one place
MAX_FLUOROSCOPES = 16
MAX_PX = 1e6  # of a coordinate or correction
MAX_PRINCIPAL_DISTANCE_PX = 1e9
# Names [characters].
MAX_NAME = 100  # of a fluoroscope
MAX_TEXT = 4096  # of a parameter


@dataclass(frozen=True)
class StreamLimits:
    """What a node takes from a stream of image points."""

    max_points: int = option(
        20_000,
        'image points of a message; larger messages are dropped unread and counted',
        minimum=1,
        maximum=1_000_000,
    )

    @property
    def max_bytes(self) -> int:
        """Size of the largest message of image points."""
        return BYTES_OF_HEAD + BYTES_OF_POINT * self.max_points


@dataclass(frozen=True)
class CollectLimits(StreamLimits):
    """What the calibration node collects and keeps for its peers."""

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
