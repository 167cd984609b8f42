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

"""Processes that end with the one that has started them."""

from __future__ import annotations

import os
import time

PARENT_POLL_S = 0.5  # interval at which a worker looks whether its caller is alive [s]


def end_with_parent(parent: int) -> None:
    """End this process once its parent has died, which cannot terminate it any more."""
    while os.getppid() == parent:
        time.sleep(PARENT_POLL_S)
    os._exit(1)
