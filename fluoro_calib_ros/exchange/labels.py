# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

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
