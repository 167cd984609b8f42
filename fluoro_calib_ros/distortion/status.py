# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Status of a corrected image point."""

from enum import IntEnum


class CorrectionStatus(IntEnum):
    """Status of a corrected image point, as it is sent in messages and written to files."""

    OK = 0
    OUTSIDE = 1  # beyond the calibrated area
    INVALID = 2  # off the image, or not a number
