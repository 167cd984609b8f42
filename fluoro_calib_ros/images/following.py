# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Track the pose of a phantom from a nearby exposure, such as the previous video frame."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from ..errors import DataError
from ..photogrammetry.rotations import matrix_from_vector, rotation_angle, vector_from_matrix
from .growth import Match, Seen, grow, settle, start_view
from .matching import (
    MIN_BEADS,
    NEIGHBOURS,
    PhantomModel,
    beads_map,
    is_evident,
    seeds_of,
    unambiguous,
)
from .pose_search import LocalPose, local_poses
from .view import View

REACH = 0.1  # maximum motion between exposures, as a fraction of the image size
# Limits of motion between exposures if images in between were skipped.
FAR_REACH = 0.25  # fraction of the image size
FAR_TURN_RAD = np.deg2rad(35)
FAR_SCALES = (0.8, 1.25)  # factors on the scale
FAR_SEEDS = 6  # number of beads of the image from which the pose is searched for
FAR_POSES = 3  # number of poses tried for each of these beads
SCATTER_FACTOR = 1.5  # largest scatter of the residuals over that of the nearby exposure
SCATTER_PX = 0.1  # is added to this limit


@dataclass(frozen=True)
class Far:
    """State of a track after images were skipped since the nearby exposure."""

    ahead: View | None = None  #: extrapolated pose of the phantom


def follow(
    seen: Seen, model: PhantomModel, near: View, scale_px: float, far: Far | None = None
) -> Match | None:
    """Match detections of an image, starting from a nearby pose.

    scale_px: robust standard deviation of the residuals of the nearby image [px]. far: set if
    images in between were skipped; the search then extends farther. Returns None if the pose is
    too far away or not certain.
    """
    if len(seen.uv) < MIN_BEADS:
        return None
    limit = SCATTER_FACTOR * scale_px + SCATTER_PX
    expected = settle(near, model, seen)
    if _fits(expected, limit):
        return expected
    for match in _elsewhere(seen, model, near, far):
        if match is None or not _fits(match, limit):
            continue
        try:
            # A grid may have moved by a step of its pattern.
            match = unambiguous(match, seen, model, FAR_TURN_RAD)
        except DataError:
            return None
        return match if _fits(match, limit) else None
    return None


def _fits(matched: Match | None, limit_px: float) -> bool:
    """Return whether a match is evident, with residuals as small as before.

    If the phantom had turned by nearly one of its symmetries, residuals would be larger.
    """
    return (
        matched is not None
        and is_evident(matched)
        and matched.scale_px < limit_px
        and len(matched.bead) >= MIN_BEADS
    )


def moved_on(
    before: View, last: View, centre_mm: NDArray[np.float64], factor: float
) -> View | None:
    """Extrapolate the motion from one view to the next; return the view after it.

    centre_mm: (3,) of the phantom, which moves on a straight line while it turns about a fixed
    axis. factor: on the motion. Returns None if the turn is not small.
    """
    turn = vector_from_matrix(last.rotation @ before.rotation.T)
    if factor * np.linalg.norm(turn) > FAR_TURN_RAD:
        return None
    rotation = matrix_from_vector(factor * turn) @ last.rotation
    first, second = (view.rotation @ (centre_mm - view.position) for view in (before, last))
    sensor = second + factor * (second - first)
    return replace(last, rotation=rotation, position=centre_mm - rotation.T @ sensor)


def _elsewhere(
    seen: Seen, model: PhantomModel, near: View, far: Far | None
) -> Iterator[Match | None]:
    """Yield matches from a pose that is extrapolated, shifted over the image, or searched for."""
    if far is not None and far.ahead is not None:
        yield settle(far.ahead, model, seen)
    yield _over_the_image(seen, model, near)
    if far is not None:
        yield from _farther(seen, model, near)


def _over_the_image(seen: Seen, model: PhantomModel, near: View) -> Match | None:
    """Return the match of a nearby pose after a shift in the image, None if there is none."""
    predicted = near.project(model.xyz)
    row = np.flatnonzero(seen.in_field(predicted))
    shift = _shift(predicted[row], seen) if len(row) >= MIN_BEADS else None
    if shift is None:
        return None
    view = _shifted(near, shift, float(np.median(near.depth(model.xyz))))
    middle_distance = np.linalg.norm(predicted[row] - predicted[row].mean(axis=0), axis=1)
    return grow(view, int(row[np.argmin(middle_distance)]), model, seen)


def _farther(seen: Seen, model: PhantomModel, near: View) -> Iterator[Match | None]:
    """Yield matches of more distant poses, from triples of beads that are predicted nearby."""
    predicted = near.project(model.xyz)
    with np.errstate(invalid='ignore'):
        size = np.array(seen.field.shape[::-1])
        seen_before = (np.abs(predicted - size / 2) < (0.5 + FAR_REACH) * size).all(axis=1)
    if not seen_before.any():
        return
    scale = near.principal_distance_px / float(np.median(near.depth(model.xyz[seen_before])))
    beads = beads_map(seen, model, scale)
    scales = (FAR_SCALES[0] * scale, FAR_SCALES[1] * scale)
    reach = FAR_REACH * max(seen.field.shape)
    for seed in seeds_of(seen)[:FAR_SEEDS]:
        with np.errstate(invalid='ignore'):
            is_close = np.linalg.norm(predicted - seen.uv[seed], axis=1) < reach
        triples = model.triples.of_beads(is_close)
        poses = local_poses(seed, seen.uv, NEIGHBOURS[1], triples, beads, scales=scales)
        views = [_turned(pose, near, model.xyz) for pose in poses]
        started = [(pose, view) for pose, view in zip(poses, views) if view is not None]
        for pose, view in started[:FAR_POSES]:
            yield grow(view, pose.bead, model, seen)


def _turned(pose: LocalPose, near: View, xyz: NDArray[np.float64]) -> View | None:
    """Return the nearby view with the pose found at a bead, None if it is turned too far."""
    c = near.principal_distance_px
    start = start_view(pose, replace(near.lens, principal_distance_px=c), xyz)
    if rotation_angle(start.rotation @ near.rotation.T) > FAR_TURN_RAD:
        return None
    view = replace(near, rotation=start.rotation, position=start.position)
    bead = xyz[[pose.bead]]
    # The bead is distorted by the fluoroscope, whose distortion is known from the nearby view.
    return _shifted(view, pose.uv - view.project(bead)[0], float(view.depth(bead)[0]))


def _shifted(view: View, shift: NDArray[np.float64], depth_mm: float) -> View:
    """Return a view in which points at a depth are shifted by (2,) [px]."""
    sensor = np.append(shift, 0) * depth_mm / view.principal_distance_px
    return replace(view, position=view.position - view.rotation.T @ sensor)


def _shift(predicted: NDArray[np.float64], seen: Seen) -> NDArray[np.float64] | None:
    """Return the shift (2,) [px] that moves most predictions (n, 2) to a detection."""
    reach = REACH * max(seen.field.shape)
    pairs = cKDTree(predicted).query_ball_tree(seen.tree, reach)
    steps = np.concatenate(
        [
            seen.uv[detections] - prediction
            for prediction, detections in zip(predicted, pairs)
            if detections
        ]
        or [np.zeros((0, 2))]
    )
    if not len(steps):
        return None
    cells = int(np.ceil(reach / seen.tolerance_px))
    cell = np.rint(steps / seen.tolerance_px).astype(int) + cells
    size = 2 * cells + 1
    count = np.bincount(cell[:, 0] * size + cell[:, 1], minlength=size**2).reshape(size, size)
    # A shift near the edge between two cells counts in both.
    smooth = cv2.boxFilter(count.astype(float), -1, (3, 3), normalize=False)
    place = np.unravel_index(np.argmax(smooth), smooth.shape)
    return (np.array(place) - cells) * seen.tolerance_px
