# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What is assumed of a fluoroscope before an image, and from the other images of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from .view import Lens, View

# Without a principal distance: that of image intensifiers and of biplane laboratories, which are
# three to five times as far from the source as they are wide.
USUAL_DISTANCE = 4.0
USUAL_SD = 0.25
GIVEN_SD = 0.08
SHARED_SD = 0.03  # of the principal distance, once other images of the fluoroscope are known
SHARED_CERTAINTY = 0.3
MIN_SHARED = 3  # images whose distortion helps with the others


def assumed_lens(image_size: tuple[int, int], principal_distance_px: float | None) -> Lens:
    """Return what is assumed of a fluoroscope before its first image; None: not known."""
    if principal_distance_px is not None:
        return Lens(image_size, principal_distance_px, GIVEN_SD)
    return Lens(image_size, USUAL_DISTANCE * max(image_size), USUAL_SD)


def shared_lens(lens: Lens, views: Sequence[View]) -> Lens | None:
    """Return the lens with the distortion of the images that were solved, None for too few."""
    if len(views) < MIN_SHARED:
        return None
    return replace(
        lens,
        principal_distance_px=float(np.median([view.principal_distance_px for view in views])),
        principal_distance_sd=SHARED_SD,
        coefficients=np.median([view.coefficients for view in views], axis=0),
        certainty=SHARED_CERTAINTY,
    )


def may_be_found(reason: str) -> bool:
    """Return whether an image is refused because no pose was found for its beads."""
    return 'pose' in reason or 'phantom' in reason
