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

"""Names of targets in formats that need one."""

from __future__ import annotations

from collections.abc import Mapping

from ..exposures.names import without_trivial


def default_name(target_id: int) -> str:
    """Return the name of a target without one, as XMALab calls its markers: marker001."""
    return f'marker{target_id:03d}'


def named_targets(ids: Mapping[str, int]) -> dict[str, int]:
    """Return the ids of the names that a person has given."""
    return {name: i for name, i in without_trivial(ids).items() if name != default_name(i)}
