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

"""Rules for columns of numbers that frames and phantoms share."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray


def is_positive(sigma: ArrayLike) -> NDArray[np.bool_]:
    """Return (n,) whether values are finite and above 0, as a standard deviation must be."""
    sigma = np.asarray(sigma)
    return np.isfinite(sigma) & (sigma > 0)


def first_repeated(target_id: ArrayLike) -> tuple[int, int] | None:
    """Return the first two positions of the smallest id that occurs more than once, else None."""
    ids = np.asarray(target_id)
    order = np.argsort(ids, kind='stable')
    ordered = ids[order]
    repeated = np.flatnonzero(ordered[1:] == ordered[:-1])
    if not len(repeated):
        return None
    return int(order[repeated[0]]), int(order[repeated[0] + 1])
