# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Profile of a self-calibration."""

import cProfile
import pstats
from collections.abc import Callable, Iterator
from pathlib import Path

import fluoro_calib_ros

PACKAGE = Path(fluoro_calib_ros.__file__).parent
HEADER = ['function', 'calls', 'cumulative', 'share', 'own']


def rows(function: Callable[[], object], count: int = 12) -> Iterator[list[str]]:
    """Yield table rows of the package functions with the largest cumulative times in a call."""
    profile = cProfile.Profile()
    profile.runcall(function)
    # (file, line, name) -> (primitive calls, calls, own time, cumulative time, callers)
    stats = pstats.Stats(profile).stats  # type: ignore[attr-defined]
    total = max(cumulative for _, _, _, cumulative, _ in stats.values())
    ranked = sorted(stats.items(), key=lambda item: -item[1][3])
    named = [(_qualified_name(key), *value[1:4]) for key, value in ranked]
    for name, calls, own, cumulative in [row for row in named if row[0]][:count]:
        yield [
            f'`{name}`',
            str(calls),
            f'{cumulative:.3f} s',
            f'{100 * cumulative / total:.0f} %',
            f'{own:.3f} s',
        ]


def _qualified_name(key: tuple[str, int, str]) -> str:
    """Return module and name of a function of the package, '' for all other functions."""
    file, _, name = key
    path = Path(file)
    if PACKAGE not in path.parents or name.startswith('<'):
        return ''
    return '.'.join((*path.relative_to(PACKAGE).with_suffix('').parts, name))
