# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Self-calibration of X-ray fluoroscopes and live correction of their image coordinates in ROS 2.

The public interface is that of `fluoro_calib_ros.api`; it needs no ROS:

>>> import fluoro_calib_ros as fc
>>> phantom = fc.read_phantom('bags/phantom.csv')
>>> frames = fc.read_source('bags/calibration', collect='auto').frames
>>> outcome = fc.calibrate(frames, phantom)
>>> fc.save_outcome('result', outcome)
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .api import *  # noqa: F403


def __getattr__(name: str) -> Any:
    """Import the public interface when it is first used, as a node needs only a part of it."""
    if name == '__all__' or not name.startswith('_'):
        api = import_module('.api', __name__)
        if name == '__all__':
            return api.__all__
        if name in api.__all__:
            return getattr(api, name)
    raise AttributeError(f'module {__name__!r} has no attribute {name!r}')


def __dir__() -> list[str]:
    return sorted(__getattr__('__all__'))
