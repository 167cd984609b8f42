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

"""Status of a corrected image point."""

from enum import IntEnum


class CorrectionStatus(IntEnum):
    """Status of a corrected image point, as it is sent in messages and written to files."""

    OK = 0
    OUTSIDE = 1  # beyond the calibrated area
    INVALID = 2  # off the image, or not a number
