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

"""From a radiograph to observations: detect, match, measure all predicted beads, check."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from ..errors import DataError
from .detection import Detections, detect_beads
from .growth import Match, Seen, smoothed
from .matching import PhantomModel, match
from .measurement import Beads, estimate_noise, estimate_profile, measure_beads
from .profile import Profile
from .view import Lens, View, fit_view

MAX_SIGMA_PX = 0.3
MAX_MISFIT = 5.0
DEPTH = (0.55, 1.7)  # of the shadow of a bead, 1 for that of a typical one
RESIDUAL_SIGMAS = 4.5  # from the prediction by neighbours
FIRST_RESIDUAL_PX = 2.5
MIN_ACCEPTED = 0.5  # of the matched beads that are measured well
MIN_SCATTER_PX = 0.05


@dataclass(frozen=True)
class Refusal:
    """A predicted bead without observation: its row, the prediction (2,) [px], and why."""

    bead: int
    uv: np.ndarray
    reason: str


@dataclass(frozen=True)
class Extraction:
    """Observations of one radiograph.

    Attributes
    ----------
    bead : (n,) ndarray of int
        Rows of the phantom.
    uv : (n, 2) ndarray
        Centres [px].
    sigma : (n,) ndarray
        Standard deviation of a coordinate [px].
    overlapped : (n,) ndarray of bool
        The shadow of another bead reaches into that of the bead.
    refused : tuple of Refusal
    view : View
    detections : Detections
    match : Match
    profile : Profile
    """

    bead: np.ndarray
    uv: np.ndarray
    sigma: np.ndarray
    overlapped: np.ndarray
    refused: tuple[Refusal, ...]
    view: View
    detections: Detections
    match: Match
    profile: Profile


def extract_beads(
    image: np.ndarray, model: PhantomModel, lens: Lens, near: View | None = None
) -> Extraction:
    """Extract the beads of a phantom from a radiograph.

    Parameters
    ----------
    image : (h, w) ndarray of uint8 or uint16
    model : PhantomModel
    lens : Lens
    near : View, optional
        A pose nearby, which is tried first.

    Returns
    -------
    Extraction

    Raises
    ------
    DataError
        Where there is no phantom in the image, or its pose is not sure, with the reason.
    """
    detections = detect_beads(image)
    seen = Seen.of(detections.uv, detections.field, detections.radius_px)
    found = match(seen, model, lens, near)
    return _measured(detections, seen, found, model)


def _measured(detections: Detections, seen: Seen, found: Match, model: PhantomModel) -> Extraction:
    """Measure all predicted beads, twice: the second time from a better prediction."""
    view = found.view
    predicted = found.predicted
    bead = found.bead
    uv = seen.uv[found.detection]
    light = detections.light
    noise = estimate_noise(light, detections.field)
    profile: Profile | None = None
    for _ in range(2):
        rows = np.flatnonzero(seen.in_field(predicted))
        start = _starts(predicted, rows, bead, uv, seen)
        radius = _relative_radius(view, model)
        if profile is None:
            known = np.isin(rows, bead)
            profile = estimate_profile(
                light, detections.field, start[known], radius[rows[known]], seen.radius_px
            )
        beads = measure_beads(light, detections.field, start, radius[rows], profile, noise)
        reasons = _reasons(beads, predicted[rows])
        good = np.array([not reason for reason in reasons], dtype=bool)
        if np.count_nonzero(good) < max(4, MIN_ACCEPTED * len(found.bead)):
            raise DataError(
                f'the phantom is found with {len(found.bead)} beads, of which only '
                f'{np.count_nonzero(good)} can be measured'
            )
        bead = rows[good]
        uv = beads.uv[good]
        view, _ = fit_view(view, model.xyz[bead], uv, 3)
        predicted = view.project(model.xyz) + smoothed(view, model.xyz, bead, uv)
    return _checked(detections, found, view, (rows, beads, reasons, predicted), profile)


def _checked(
    detections: Detections,
    found: Match,
    view: View,
    measured: tuple[np.ndarray, Beads, list[str], np.ndarray],
    profile: Profile | None,
) -> Extraction:
    """Leave out beads that are not where their neighbours say."""
    rows, beads, reasons, predicted = measured
    residual = np.linalg.norm(beads.uv - predicted[rows], axis=1)
    good = np.array([not reason for reason in reasons], dtype=bool)
    scatter = max(float(np.median(residual[good])) / np.sqrt(2 * np.log(2)), MIN_SCATTER_PX)
    # The scatter contains what the survey and the smoothing leave open.
    limit = RESIDUAL_SIGMAS * np.hypot(scatter, beads.sigma)
    far = good & ~(residual < limit)
    for number in np.flatnonzero(far):
        reasons[number] = f'{residual[number]:.2f} px from where its neighbours say'
    good &= ~far
    refused = tuple(
        Refusal(int(rows[number]), predicted[rows[number]], reasons[number])
        for number in np.flatnonzero(~good)
    )
    assert profile is not None
    return Extraction(
        rows[good],
        beads.uv[good],
        beads.sigma[good],
        beads.overlapped[good],
        refused,
        view,
        detections,
        found,
        profile,
    )


def _starts(
    predicted: np.ndarray, rows: np.ndarray, bead: np.ndarray, uv: np.ndarray, seen: Seen
) -> np.ndarray:
    """Start values (n, 2) of predicted beads: what was found of one alone, else the prediction."""
    start = predicted.copy()
    if len(rows) > 1:
        distance = cKDTree(predicted[rows]).query(predicted[bead], k=[2])[0][:, 0]
        alone = distance > 2.5 * seen.radius_px
        start[bead[alone]] = uv[alone]
    return start[rows]


def _relative_radius(view: View, model: PhantomModel) -> np.ndarray:
    """Radii (n,) of the shadows of all beads, 1 for a typical one."""
    depth = view.depth(model.xyz)
    radius = np.median(depth) / np.where(depth > 0, depth, np.median(depth))
    if model.diameter_mm is not None:
        radius = radius * model.diameter_mm / np.median(model.diameter_mm)
    return np.clip(radius, 0.2, 5.0)


def _reasons(beads: Beads, predicted: np.ndarray) -> list[str]:
    """Why beads are not observed, '' for those that are."""
    away = np.linalg.norm(beads.uv - predicted, axis=1)
    out = []
    for number in range(len(beads.uv)):
        depth = beads.depth[number]
        if not beads.measured[number]:
            reason = 'cut off, or lost while it was measured'
        elif not DEPTH[0] < depth < DEPTH[1]:
            reason = f'a shadow of {depth:.0%} of that of a bead'
        elif beads.misfit[number] > MAX_MISFIT:
            reason = 'something else is beside it'
        elif beads.sigma[number] > MAX_SIGMA_PX:
            reason = 'hidden by another bead'
        elif away[number] > FIRST_RESIDUAL_PX:
            reason = f'{away[number]:.1f} px from its prediction'
        else:
            reason = ''
        out.append(reason)
    return out
