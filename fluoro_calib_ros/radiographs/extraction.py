# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""From a radiograph to observations: detect, match, measure all predicted beads, check."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from ..errors import DataError
from .detection import Detections, detect_beads
from .following import Far, follow
from .growth import Match, Seen, smoothed, supported
from .matching import PhantomModel, match
from .measurement import (
    FIRST_STEPS,
    STEPS,
    Beads,
    Noise,
    estimate_noise,
    estimate_profile,
    measure_beads,
)
from .profile import Profile
from .view import Lens, View, fit_view

MAX_SIGMA_PX = 0.3
MAX_SIGMAS = 2.9  # times that of a usual bead of the image: an eighth of its weight
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
    noise : Noise
    followed : bool
        The pose comes from the exposure before, not from a search.
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
    noise: Noise
    followed: bool = False

    @property
    def nearby(self) -> Nearby:
        """What an exposure nearby begins with."""
        found = self.detections
        return Nearby(
            self.view,
            self.match.scale_px,
            self.profile,
            self.noise,
            found.radius_px,
            found.inverted,
        )


@dataclass(frozen=True)
class Nearby:
    """What is taken over from an exposure nearby, such as the previous one of a video.

    Attributes
    ----------
    view : View
    scale_px : float
        Robust standard deviation of its residuals [px].
    profile : Profile
    noise : Noise
    radius_px : float
        Of a bead.
    inverted : bool
        Beads are bright.
    far : Far or None
        For images that were left out since.
    """

    view: View
    scale_px: float
    profile: Profile
    noise: Noise
    radius_px: float
    inverted: bool
    far: Far | None = None


def extract_beads(
    image: np.ndarray, model: PhantomModel, lens: Lens, near: Nearby | None = None
) -> Extraction:
    """Extract the beads of a phantom from a radiograph.

    Parameters
    ----------
    image : (h, w) ndarray of uint8 or uint16
    model : PhantomModel
    lens : Lens
    near : Nearby, optional
        The exposure before. Where the phantom has moved little since then, this is several times
        faster; elsewhere its pose is searched for as without it.

    Returns
    -------
    Extraction

    Raises
    ------
    DataError
        Where there is no phantom in the image, or its pose is not sure, with the reason.
    """
    if near is not None:
        followed = _followed(image, model, near)
        if followed is not None:
            return followed
    detections = detect_beads(image)
    seen = _seen(detections)
    found = match(seen, model, lens)
    noise = estimate_noise(detections.light, detections.field)
    return _measured(detections, seen, found, model, _Imaging(noise))


def _followed(image: np.ndarray, model: PhantomModel, near: Nearby) -> Extraction | None:
    """Return the extraction from an exposure nearby, None where it does not lead to the pose."""
    try:
        detections = detect_beads(image, near.radius_px, near.inverted)
        if image.shape != near.view.lens.image_size[::-1]:
            return None
        seen = _seen(detections)
        found = follow(seen, model, near.view, near.scale_px, near.far)
        if found is None:
            return None
        imaging = _Imaging(near.noise, near.profile)
        followed = _measured(detections, seen, found, model, imaging, (STEPS,))
    except DataError:
        return None
    return replace(followed, followed=True)


def _seen(detections: Detections) -> Seen:
    return Seen.of(detections.uv, detections.field, detections.radius_px, detections.strength)


@dataclass(frozen=True)
class _Imaging:
    """What is known of noise and shadows before beads are measured."""

    noise: Noise
    profile: Profile | None = None


def _measured(
    detections: Detections,
    seen: Seen,
    found: Match,
    model: PhantomModel,
    imaging: _Imaging,
    passes: tuple[int, ...] = (FIRST_STEPS, STEPS),
) -> Extraction:
    """Measure all predicted beads, by default twice: the second time from a better prediction."""
    view = found.view
    predicted = found.predicted
    bead = found.bead
    uv = seen.uv[found.detection]
    light = detections.light
    noise = imaging.noise
    profile = imaging.profile
    for steps in passes:
        rows = np.flatnonzero(seen.in_field(predicted))
        start = _starts(predicted, rows, bead, uv, seen)
        radius = _relative_radius(view, model)
        if profile is None:
            known = np.isin(rows, bead)
            profile = estimate_profile(
                light, detections.field, start[known], radius[rows[known]], seen.radius_px
            )
        beads = measure_beads(light, detections.field, start, radius[rows], profile, noise, steps)
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
    measured = (rows, beads, reasons, predicted)
    extraction = _checked(detections, found, view, measured, _Imaging(noise, profile))
    return _with_support(extraction, model, rows)


def _checked(
    detections: Detections,
    found: Match,
    view: View,
    measured: tuple[np.ndarray, Beads, list[str], np.ndarray],
    imaging: _Imaging,
) -> Extraction:
    """Leave out beads that are not where their neighbours say, or measured badly."""
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
    usual = float(np.median(beads.sigma[good]))
    vague = good & (beads.sigma > MAX_SIGMAS * usual)
    for number in np.flatnonzero(vague):
        reasons[number] = f'sigma {beads.sigma[number]:.2f} px, that of most is {usual:.2f} px'
    good &= ~vague
    refused = tuple(
        Refusal(int(rows[number]), predicted[rows[number]], reasons[number])
        for number in np.flatnonzero(~good)
    )
    assert imaging.profile is not None
    return Extraction(
        rows[good],
        beads.uv[good],
        beads.sigma[good],
        beads.overlapped[good],
        refused,
        view,
        detections,
        found,
        imaging.profile,
        imaging.noise,
    )


def _with_support(extraction: Extraction, model: PhantomModel, rows: np.ndarray) -> Extraction:
    """Leave out beads of which most neighbours among the predicted ones (n,) are refused."""
    good = np.isin(rows, extraction.bead)
    alone = rows[good & ~supported(model.xyz[rows], good)]
    if not len(alone):
        return extraction
    kept = ~np.isin(extraction.bead, alone)
    refused = tuple(
        Refusal(
            int(extraction.bead[number]), extraction.uv[number], 'its neighbours are not found'
        )
        for number in np.flatnonzero(~kept)
    )
    return replace(
        extraction,
        bead=extraction.bead[kept],
        uv=extraction.uv[kept],
        sigma=extraction.sigma[kept],
        overlapped=extraction.overlapped[kept],
        refused=extraction.refused + refused,
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
