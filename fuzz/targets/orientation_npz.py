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

"""The orientation of a rig; the fuzzer sees its arrays without archive and checksums."""

from __future__ import annotations

from fluoro_calib_ros.files.rig_orientation import load_orientation, save_orientation

from ..harness import Target
from ..seeds import archive_of, flattened, in_folder, orientation

TARGET = Target(
    'orientation_npz',
    'rig_orientation.npz',
    load_orientation,
    lambda: [flattened(in_folder(lambda folder: save_orientation(folder, orientation())))],
    archive_of,
)
