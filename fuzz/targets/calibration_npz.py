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

"""The calibration file; the fuzzer sees its arrays without archive and checksums."""

from __future__ import annotations

from functools import partial

from fluoro_calib_ros.files.calibration import load_calibration, save_calibration

from ..harness import Target
from ..seeds import archive_of, calibration, flattened, in_folder


def _seeds() -> list[bytes]:
    found = []
    for model in ('none', 'knn', 'parametric'):
        found.append(
            flattened(in_folder(partial(save_calibration, calibration=calibration(model))))
        )
    return found


TARGET = Target('calibration_npz', 'a.calibration.npz', load_calibration, _seeds, archive_of)
