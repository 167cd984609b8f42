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
    """Import the public interface when it is first used: a node needs only a part of it."""
    if name == '__all__' or not name.startswith('_'):
        api = import_module('.api', __name__)
        if name == '__all__':
            return api.__all__
        if name in api.__all__:
            return getattr(api, name)
    raise AttributeError(f'module {__name__!r} has no attribute {name!r}')


def __dir__() -> list[str]:
    return sorted({*globals(), *__getattr__('__all__')})
