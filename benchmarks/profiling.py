"""Where the time of a self-calibration goes."""

import cProfile
import pstats
from pathlib import Path

import fluoro_calib_ros

PACKAGE = Path(fluoro_calib_ros.__file__).parent
HEADER = ['function', 'calls', 'cumulative', 'share', 'own']


def rows(function, count=12):
    """Rows of the functions with the largest cumulative times of a call that are the program's."""
    profile = cProfile.Profile()
    profile.runcall(function)
    stats = pstats.Stats(
        profile
    ).stats  # (file, line, name) -> calls, ..., own, cumulative, callers
    total = max(cumulative for _, _, _, cumulative, _ in stats.values())
    ranked = sorted(stats.items(), key=lambda item: -item[1][3])
    named = [(_name(key), *value[1:4]) for key, value in ranked]
    for name, calls, own, cumulative in [row for row in named if row[0]][:count]:
        yield [
            f'`{name}`',
            str(calls),
            f'{cumulative:.3f} s',
            f'{100 * cumulative / total:.0f} %',
            f'{own:.3f} s',
        ]


def _name(key):
    """Module and name of a function of the program without its folders, '' for all others."""
    file, _, name = key
    path = Path(file)
    if PACKAGE not in path.parents or name.startswith('<'):
        return ''
    return '.'.join(path.relative_to(PACKAGE).with_suffix('').parts + (name,))
