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

"""The pose of a phantom from that of an exposure nearby, such as the previous one of a video."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import cv2
import numpy as np
from scipy.spatial import cKDTree

from .growth import Match, Seen, grow, settle
from .matching import MIN_BEADS, PhantomModel, is_sure
from .view import View

REACH = 0.1  # of the image, by which a phantom may move between exposures
SCATTER_FACTOR = 1.5  # on the residuals of the exposure before
SCATTER_PX = 0.1


def follow(seen: Seen, model: PhantomModel, near: View, scale_px: float) -> Match | None:
    """Match what was found in an image from a pose nearby.

    Parameters
    ----------
    seen : Seen
    model : PhantomModel
    near : View
    scale_px : float
        Robust standard deviation of the residuals of the image nearby [px].

    Returns
    -------
    Match or None
        None where the pose is too far, or not sure.
    """
    if len(seen.uv) < MIN_BEADS:
        return None
    limit = SCATTER_FACTOR * scale_px + SCATTER_PX
    for found in _moved(seen, model.xyz, near):
        # Residuals as small as before: a phantom that was turned by nearly a symmetry of its own
        # would have larger ones.
        if found is not None and is_sure(found) and found.scale_px < limit:
            return found if len(found.bead) >= MIN_BEADS else None
    return None


def _moved(seen: Seen, xyz: np.ndarray, near: View) -> Iterator[Match | None]:
    """Yield the matches from a pose nearby: as it is, and shifted over the image."""
    yield settle(near, xyz, seen)
    predicted = near.project(xyz)
    row = np.flatnonzero(seen.in_field(predicted))
    if len(row) < MIN_BEADS:
        return
    shift = _shift(predicted[row], seen)
    if shift is None:
        return
    sensor = np.append(shift, 0) * np.median(near.depth(xyz)) / near.principal_distance_px
    view = replace(near, position=near.position - near.rotation.T @ sensor)
    from_middle = np.linalg.norm(predicted[row] - predicted[row].mean(axis=0), axis=1)
    yield grow(view, int(row[np.argmin(from_middle)]), xyz, seen)


def _shift(predicted: np.ndarray, seen: Seen) -> np.ndarray | None:
    """Shift (2,) [px] that takes most predictions (n, 2) to something that was found."""
    reach = REACH * max(seen.field.shape)
    pairs = cKDTree(predicted).query_ball_tree(seen.tree, reach)
    steps = np.concatenate(
        [seen.uv[near] - at for at, near in zip(predicted, pairs) if near] or [np.zeros((0, 2))]
    )
    if not len(steps):
        return None
    cells = int(np.ceil(reach / seen.tolerance_px))
    cell = np.rint(steps / seen.tolerance_px).astype(int) + cells
    size = 2 * cells + 1
    count = np.bincount(cell[:, 0] * size + cell[:, 1], minlength=size**2).reshape(size, size)
    # A shift near the edge of two cells counts in both.
    smooth = cv2.boxFilter(count.astype(float), -1, (3, 3), normalize=False)
    place = np.unravel_index(np.argmax(smooth), smooth.shape)
    return (np.array(place) - cells) * seen.tolerance_px
