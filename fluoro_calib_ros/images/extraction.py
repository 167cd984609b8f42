# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Extract observations from a radiograph: detect, match, measure all predicted beads, check."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.special import chndtr

from ..errors import DataError
from ..findings import Finding, Kind
from ..photogrammetry.threads import one_thread
from .contrasts import black_level, black_of_holes, usual_depth
from .detection import Detections, Look, detect_beads, likely_detections
from .following import Far, follow
from .growth import SURVEY_SIGMAS, Match, Seen, is_likelier, nearby_residuals, supported
from .imaging import MOST, Expected, Imaging, first_imaging
from .matching import PhantomModel, match
from .measurement import FIRST_STEPS, STEPS, measure_beads
from .profile import Profile
from .shadow_fit import MAX_SIGMA_PX, Beads
from .view import Lens, View, fit_view

# Accepted share of wrong centres among those with the largest standard deviation. A centre is
# wrong if it is off by half a pixel; distances have Rayleigh's distribution.
WRONG_SHARE = 1e-3
WRONG_SIGMAS = np.sqrt(-2 * np.log(WRONG_SHARE))
SURE_SIGMA_PX = 0.5 / WRONG_SIGMAS
MAX_SIGMAS = 2.9  # largest standard deviation over the usual one: an eighth of the weight
MAX_MISFIT = 5.0  # largest lack of fit, relative to that of a typical bead
DEPTH = (0.55, 1.7)  # depth of a shadow relative to the usual depth in such light
RADII = (0.2, 5.0)  # radii of shadows of equal beads, relative to a typical one
BLACK_ROUNDS = 4  # largest number of estimates of the grey value of no light
RESIDUAL_SIGMAS = 4.5  # largest residual from the prediction by neighbours [standard deviations]
FIRST_RESIDUAL_PX = 2.5
# Displacement of the start of a fit from which it may end beside the shadow: fits that started one
# radius off ended 0.2 to 0.4 radii off.
DISPLACED_RADII = 0.5
ALONE_RADII = 2.5  # least distance of an isolated bead from the next shadow [radii]
MIN_ACCEPTED = 0.5  # least share of the matched beads that are measured well
MIN_SCATTER_PX = 0.05
# Share of the shifts of shadows by distortion within them that remains after the correction: 0.46,
# 0.57 and 0.63 with shadows of 17 px (`benchmarks.calibrated_renderings`, large beads).
BENT_LEFT = 0.55
# Reasons why predicted beads are not observed, without a number.
LOST = Finding(Kind.BEAD_LOST, 'cut off, or lost while it was measured')
DISTURBED = Finding(Kind.BEAD_DISTURBED, 'another object is next to it')
HIDDEN = Finding(Kind.BEAD_HIDDEN, 'hidden by another bead')
CONFUSED = Finding(Kind.BEAD_CONFUSED, 'not distinguished from another bead')
VAGUE = (Kind.BEAD_UNSURE, Kind.BEAD_HIDDEN)
ALONE = Finding(Kind.BEAD_ALONE, 'its neighbours were not found')


@dataclass(frozen=True)
class Refusal:
    """Predicted bead without an observation: its row, the prediction (2,) [px], and the reason."""

    bead: int
    uv: NDArray[np.float64]
    finding: Finding


@dataclass(frozen=True)
class Extraction:
    """Observations of one radiograph."""

    bead: NDArray[np.int64]  #: (n,), rows of the phantom
    uv: NDArray[np.float64]  #: (n, 2), centres [px]
    sigma: NDArray[np.float64]  #: (n,), standard deviation of a coordinate [px]
    #: (n,), True if the shadow of another bead reaches into that of the bead
    overlapped: NDArray[np.bool_]
    refused: tuple[Refusal, ...]
    view: View
    detections: Detections
    match: Match
    imaging: Imaging
    followed: bool = False  #: True if the pose was tracked from a nearby exposure
    #: RMS correction of centres for the distortion within their shadows [px]
    bent_px: float = 0.0

    @property
    def nearby(self) -> Nearby:
        """Initial values for a nearby exposure."""
        found = self.detections
        return Nearby(
            self.view,
            self.match.scale_px,
            imaging=self.imaging,
            radius_px=found.radius_px,
            inverted=found.inverted,
        )


@dataclass(frozen=True)
class Nearby:
    """Initial values from a nearby exposure, such as the previous video frame."""

    view: View
    scale_px: float  #: robust standard deviation of the residuals [px]
    imaging: Imaging
    radius_px: float  #: radius of a bead
    inverted: bool  #: True if beads are bright
    far: Far | None = None  #: set if images were skipped since

    @property
    def look(self) -> Look:
        """Expected appearance of beads."""
        # For bright beads the noise was estimated on the inverted image: estimate it again.
        imaging = self.imaging
        noise = None if self.inverted else imaging.noise.above(-imaging.black)
        return Look(self.radius_px, self.inverted, noise, alike=self.imaging.sizes_are_alike)


def extract_beads(
    image: np.ndarray, model: PhantomModel, lens: Lens, near: Nearby | None = None
) -> Extraction:
    """Extract the beads of a phantom from a radiograph.

    image: (h, w). near: the previous exposure. If the phantom has moved little since then, this is
    several times faster; otherwise the pose is searched for as without it. Raises DataError, with
    the reason, if there is no phantom in the image, or its pose is not certain.
    """
    # Small matrices take three times as long on several threads.
    with one_thread():
        followed = None if near is None else _followed(image, model, near)
        return followed or _searched(image, model, lens)


def _searched(image: np.ndarray, model: PhantomModel, lens: Lens) -> Extraction:
    """Extract beads by a search for the pose. Raises DataError."""
    first: DataError | None = None
    for detections in likely_detections(image, len(model.xyz)):
        seen = _seen(detections, model)
        try:
            found = match(seen, model, lens)
            extraction = _measured(detections, seen, found, model)
            return _detected_anew(image, extraction, model) or extraction
        except DataError as error:
            first = first or error
            if error.finding.kind is Kind.POSE_AMBIGUOUS:
                break
    assert first is not None
    raise first


def _detected_anew(
    image: np.ndarray, extraction: Extraction, model: PhantomModel
) -> Extraction | None:
    """Extract beads again, by their size, if that of the detections is the size of other objects.

    Return None if it is that of the beads, or if no pose is found anew.
    """
    found = extraction.detections
    radius_px = extraction.imaging.profile.radius_px
    if found.radius_px / MOST < radius_px < found.radius_px * MOST:
        return None
    look = Look(radius_px, found.inverted)
    return _tracked(image, model, extraction.nearby, look=look, imaging=None)


def _followed(image: np.ndarray, model: PhantomModel, near: Nearby) -> Extraction | None:
    """Extract beads by tracking from a nearby exposure; return None if that finds no pose."""
    tracked = _tracked(image, model, near, look=near.look, imaging=near.imaging)
    return None if tracked is None else replace(tracked, followed=True)


def _tracked(
    image: np.ndarray, model: PhantomModel, near: Nearby, look: Look, imaging: Imaging | None
) -> Extraction | None:
    """Extract beads of some appearance near a pose; return None if that finds no pose."""
    try:
        detections = detect_beads(image, len(model.xyz), look)
        if image.shape != near.view.lens.image_size[::-1]:
            return None
        seen = _seen(detections, model)
        found = follow(seen, model, near.view, near.scale_px, near.far)
        return None if found is None else _measured(detections, seen, found, model, imaging)
    except DataError:
        return None


def _seen(detections: Detections, model: PhantomModel) -> Seen:
    return Seen.of(
        detections.uv,
        detections.light.field,
        detections.radius_px,
        strength=detections.strength if model.sizes_differ else None,
    )


@dataclass(frozen=True)
class _Predicted:
    """Beads that were found, and the prediction of all beads from them."""

    view: View
    bead: NDArray[np.int64]  #: (m,), rows of the beads found
    found: NDArray[np.float64]  #: (m, 2), their centres [px]
    uv: NDArray[np.float64]  #: (n, 2), predicted pixels of all beads of the phantom
    #: (n,), standard deviation of a coordinate from its prediction, including survey errors
    sd_px: NDArray[np.float64]

    @classmethod
    def of(
        cls, view: View, model: PhantomModel, bead: NDArray[np.int64], found: NDArray[np.float64]
    ) -> _Predicted:
        """Return the prediction of a view and of neighbours that were found."""
        nearby = nearby_residuals(view, model.xyz, bead, found)
        return cls(view, bead, found, view.project(model.xyz) + nearby.value, nearby.sd_px)


@dataclass(frozen=True)
class _Measured:
    """Measurements of predicted beads (n,)."""

    rows: NDArray[np.int64]  #: (n,), rows of the phantom
    beads: Beads
    reasons: list[Finding | None]  #: (n,), reasons against an observation, or None
    radius_px: NDArray[np.float64]  #: (n,), radii of the pixels that determine the centres
    imaging: Imaging
    predicted: _Predicted  #: the prediction from these measurements

    @property
    def good(self) -> NDArray[np.bool_]:
        """Whether nothing speaks against an observation (n,)."""
        return np.array([reason is None for reason in self.reasons], dtype=bool)

    @property
    def residual(self) -> NDArray[np.float64]:
        """Distances (n,) from the predictions by neighbours [px]."""
        return np.linalg.norm(self.beads.uv - self.predicted.uv[self.rows], axis=1)


def _measured(
    detections: Detections,
    seen: Seen,
    matched: Match,
    model: PhantomModel,
    imaging: Imaging | None = None,
) -> Extraction:
    """Measure all predicted beads; without a known imaging twice, from a better prediction."""
    sd_px = np.full(len(model.xyz), np.inf)
    found = seen.uv[matched.detection]
    predicted = _Predicted(matched.view, matched.bead, found, matched.predicted, sd_px)
    if imaging is None:
        first = _first_measured(detections, seen, predicted, model)
        predicted, imaging = first.predicted, first.imaging
    measured = _measured_once(
        detections, seen, predicted, model=model, imaging=imaging, least=len(matched.bead)
    )
    measured = _identified(measured, matched.bead)
    away = _away(measured)
    if away.any():
        # Misplaced beads have biased the predictions of their neighbours: predict without them.
        kept = measured.good & ~away
        view = measured.predicted.view
        without = _Predicted.of(view, model, measured.rows[kept], measured.beads.uv[kept])
        measured = replace(measured, predicted=without)
    extraction = _checked(detections, matched, measured)
    return _of_centres(_with_support(extraction, model, measured.rows), measured, model)


def _first_measured(
    detections: Detections, seen: Seen, predicted: _Predicted, model: PhantomModel
) -> _Measured:
    """Measure all predicted beads in light above a grey value that their contrasts determine."""
    is_sheet = detections.inverted and model.grid is not None
    black = black_of_holes(detections.light) if is_sheet else 0.0
    start: Profile | None = None
    for _ in range(BLACK_ROUNDS):
        imaging = _first_imaging(
            detections, seen, predicted, model=model, black=black, start=start
        )
        measured = _measured_once(
            detections,
            seen,
            predicted,
            model=model,
            imaging=imaging,
            least=len(predicted.bead),
            steps=FIRST_STEPS,
        )
        before = black
        if not is_sheet:
            clipping = detections.light.above(black).clipping
            black = black_level(measured.beads, black, clipping)
        if black == before:
            break
        light = float(np.median(measured.beads.light))
        start = imaging.profile.in_light(1 - (black - before) / light)
    return measured


def _first_imaging(
    detections: Detections,
    seen: Seen,
    predicted: _Predicted,
    model: PhantomModel,
    black: float,
    start: Profile | None,
) -> Imaging:
    """Estimate how beads look in the light above a grey value."""
    light = detections.light.above(black)
    noise = detections.noise.above(black)
    shadows = _expected(predicted, seen, model)
    told = _relative_sizes(model)
    imaging = first_imaging(light, noise, shadows, seen.radius_px, size=told, start=start)
    return replace(imaging, black=black)


def _measured_once(
    detections: Detections,
    seen: Seen,
    predicted: _Predicted,
    model: PhantomModel,
    imaging: Imaging,
    least: int,
    steps: int = STEPS,
) -> _Measured:
    """Measure all predicted beads.

    least: number of matched beads, of which MIN_ACCEPTED have to be measured well. Raises
    DataError.
    """
    shadows = _expected(predicted, seen, model)
    light = detections.light.above(imaging.black)
    imaging = imaging.completed(light, shadows)
    sized = np.isfinite(imaging.size[shadows.row])
    size = np.where(sized, imaging.size[shadows.row], 1.0)
    beads = measure_beads(
        light,
        uv=shadows.uv,
        shape=shadows.shape,
        size=size,
        profile=imaging.profile,
        noise=imaging.noise,
        steps=steps,
    )
    reach_px = model.reach_px(predicted.view, FIRST_RESIDUAL_PX)[shadows.row]
    reasons = _reasons(beads, predicted.uv[shadows.row], reach_px)
    reasons = [reason if known else HIDDEN for reason, known in zip(reasons, sized)]
    good = np.array([reason is None for reason in reasons], dtype=bool)
    _check_measured(good, least, MIN_ACCEPTED * least)
    bead = shadows.row[good]
    view, _ = fit_view(predicted.view, model.xyz[bead], beads.uv[good], 3)
    predicted = _Predicted.of(view, model, bead, beads.uv[good])
    radius_px = imaging.profile.border_px * (shadows.radius * size)
    return _Measured(
        shadows.row,
        beads,
        reasons,
        radius_px=radius_px,
        imaging=imaging,
        predicted=predicted,
    )


def _check_measured(good: NDArray[np.bool_], beads: int, least: float) -> None:
    """Raise DataError unless at least four, and so many, of the beads found are measured well."""
    measured_well = int(np.count_nonzero(good))
    if measured_well < max(4, least):
        raise DataError(
            f'the phantom is found with {beads} beads, of which only {measured_well} can be '
            'measured',
            kind=Kind.BEADS_NOT_MEASURED,
            numbers={'beads': beads, 'measured': measured_well},
        )


def _of_centres(extraction: Extraction, measured: _Measured, model: PhantomModel) -> Extraction:
    """Return observations of the projected centres of beads: the fit measures those of shadows."""
    view = measured.predicted.view
    radius_px = measured.radius_px[np.searchsorted(measured.rows, extraction.bead)]
    xyz = model.xyz[extraction.bead]
    shift = view.shadow_shift(xyz, radius_px)
    bent = shift - view.with_degree(1).shadow_shift(xyz, radius_px)
    bent_px = np.sqrt(np.sum(bent**2, axis=1) / 2)
    return replace(
        extraction,
        uv=extraction.uv - shift,
        sigma=np.hypot(extraction.sigma, BENT_LEFT * bent_px),
        bent_px=float(np.sqrt(np.mean(bent_px**2))),
    )


def _identified(measured: _Measured, detected: NDArray[np.int64]) -> _Measured:
    """Exclude beads that are not distinguished from others.

    A bead has to be much likelier at its own prediction than at that of any other. If predictions
    may be off by half a radius, the fit from there may fail: the bead then has to be among those
    detected, and its shadow isolated, from measured beads and from where others may be.
    """
    rows = measured.rows
    if len(rows) < 2:
        return measured
    uv = measured.beads.uv
    place = measured.predicted.uv[rows]
    sd_px = measured.predicted.sd_px[rows]
    radius_px = measured.imaging.profile.radius_px
    good = measured.good
    other = _from_others(uv, place, np.ones(len(rows), dtype=bool))
    is_certain = is_likelier((np.linalg.norm(uv - place, axis=1), other), sd_px)
    reach_px = SURVEY_SIGMAS * sd_px
    alone_px = ALONE_RADII * radius_px
    is_alone = np.isin(rows, detected) & (_from_others(uv, uv, good) > alone_px)
    is_alone &= _from_others(uv, place, ~good) > alone_px + reach_px
    is_certain &= is_alone | (reach_px < DISPLACED_RADII * radius_px)
    reasons = [
        CONFUSED if reason is None and not certain else reason
        for reason, certain in zip(measured.reasons, is_certain)
    ]
    return replace(measured, reasons=reasons)


def _from_others(
    uv: NDArray[np.float64], place: NDArray[np.float64], chosen: NDArray[np.bool_]
) -> NDArray[np.float64]:
    """Return distances (n,) of pixels (n, 2) from the nearest chosen place of another row."""
    number = np.flatnonzero(chosen)
    if not len(number):
        return np.full(len(uv), np.inf)
    distance, index = cKDTree(place[number]).query(uv, k=[1, 2])
    is_own = np.append(number, -1)[index[:, 0]] == np.arange(len(uv))
    return np.asarray(np.where(is_own, distance[:, 1], distance[:, 0]))


def _away(measured: _Measured) -> NDArray[np.bool_]:
    """Return (n,) whether well-measured beads are off the places predicted by their neighbours."""
    good = measured.good
    sigma = measured.beads.sigma[good]
    scatter = np.maximum(measured.predicted.sd_px[measured.rows[good]], MIN_SCATTER_PX)
    residual = measured.residual[good]
    near = residual < RESIDUAL_SIGMAS * np.hypot(scatter, sigma)
    away = np.zeros(len(good), dtype=bool)
    away[good] = ~near | (_chances_of_wrong(residual, sigma, scatter) > WRONG_SHARE)
    return away


def _checked(detections: Detections, matched: Match, measured: _Measured) -> Extraction:
    """Exclude beads that are off the places predicted by their neighbours, or measured badly.

    Raises DataError if no more than three are left.
    """
    beads = measured.beads
    reasons = list(measured.reasons)
    for number in np.flatnonzero(_away(measured)):
        off = float(measured.residual[number])
        cause = f'{off:.2f} px from the prediction of its neighbours'
        reasons[number] = Finding(Kind.BEAD_AWAY, cause, numbers={'off_px': off})
    good = np.array([reason is None for reason in reasons], dtype=bool)
    _check_measured(good, len(matched.bead), 0)
    usual = float(np.median(beads.sigma[good]))
    vague = good & (beads.sigma > max(SURE_SIGMA_PX, MAX_SIGMAS * usual))
    for number in np.flatnonzero(vague):
        cause = f'sigma {beads.sigma[number]:.2f} px, that of most beads is {usual:.2f} px'
        reasons[number] = Finding(
            Kind.BEAD_UNSURE, cause, numbers={'sigma_px': float(beads.sigma[number])}
        )
    good &= ~vague
    refused = tuple(
        Refusal(int(row), uv, reason)
        for row, uv, reason in zip(measured.rows, measured.predicted.uv[measured.rows], reasons)
        if reason is not None
    )
    return Extraction(
        measured.rows[good],
        beads.uv[good],
        sigma=beads.sigma[good],
        overlapped=beads.overlapped[good],
        refused=refused,
        view=measured.predicted.view,
        detections=detections,
        match=matched,
        imaging=measured.imaging,
    )


def _chances_of_wrong(
    residual: NDArray[np.float64], sigma: NDArray[np.float64], scatter: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return probabilities (n,) that centres are wrong, given the predictions of neighbours.

    residual: (n,) distances from the predictions; sigma, scatter: (n,) standard deviations of
    coordinates of centres and of predictions. Given the residual, the error of a centre is normal.
    Its mean is the share of the residual that is not due to the prediction. A centre is wrong if
    it is off by half a pixel, and by more than one in a thousand of the usual centres.
    """
    wrong_px = WRONG_SIGMAS * max(float(np.median(sigma)), SURE_SIGMA_PX)
    total = sigma**2 + scatter**2
    mean = residual * sigma**2 / total
    variance = sigma**2 * scatter**2 / total
    return 1 - chndtr(wrong_px**2 / variance, 2, mean**2 / variance)


def _with_support(
    extraction: Extraction, model: PhantomModel, rows: NDArray[np.int64]
) -> Extraction:
    """Exclude beads of which most neighbours among the predicted ones (n,) are not found.

    A bead that is found, but too uncertain to be observed, also supports its neighbours.
    """
    observed = np.isin(rows, extraction.bead)
    vague = [one.bead for one in extraction.refused if one.finding.kind in VAGUE]
    good = observed | np.isin(rows, vague)
    alone = rows[observed & ~supported(model.xyz[rows], good)]
    if not len(alone):
        return extraction
    kept = ~np.isin(extraction.bead, alone)
    refused = tuple(
        Refusal(int(extraction.bead[number]), extraction.uv[number], ALONE)
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


def _expected(predicted: _Predicted, seen: Seen, model: PhantomModel) -> Expected:
    """Return expected shadows: at the detection of an isolated bead, else at the prediction.

    Beads that may be displaced by more than a radius from their coordinates are expected at their
    detections, too.
    """
    rows = np.flatnonzero(seen.in_field(predicted.uv))
    bead = predicted.bead
    start = predicted.uv.copy()
    displaced = (model.reach_px(predicted.view, 0.0) > seen.radius_px)[bead]
    start[bead[displaced]] = predicted.found[displaced]
    apart = np.full(len(start), np.inf)
    if len(rows) > 1:
        apart[rows] = cKDTree(start[rows]).query(start[rows], k=[2])[0][:, 0]
    alone = apart > ALONE_RADII * seen.radius_px
    start[bead[alone[bead]]] = predicted.found[alone[bead]]
    outlines = predicted.view.outlines(model.xyz)
    size = np.sqrt(np.abs(np.linalg.det(outlines)))
    typical = float(np.median(size))
    usable = (size > RADII[0] * typical) & (size < RADII[1] * typical)
    shape = np.where(usable[:, None, None], outlines / typical, np.eye(2))
    return Expected(rows, start[rows], shape[rows], np.isin(rows, bead), alone[rows])


def _relative_sizes(model: PhantomModel) -> NDArray[np.float64]:
    """Return sizes (n,) of beads of a phantom, 1 for a typical bead, NaN if unspecified."""
    if model.diameter_mm is None:
        return np.full(len(model.xyz), np.nan)
    return np.asarray(model.diameter_mm / np.median(model.diameter_mm))


def _reasons(
    beads: Beads, predicted: NDArray[np.float64], reach_px: NDArray[np.float64]
) -> list[Finding | None]:
    """Return the reasons why beads are not observed, None for observed beads.

    reach_px: (n,) largest distances from the predictions (n, 2).
    """
    away = np.linalg.norm(beads.uv - predicted, axis=1)
    usual = usual_depth(beads)
    out: list[Finding | None] = []
    for number in range(len(beads.uv)):
        depth = float(beads.depth[number] / usual[number])
        off = float(away[number])
        reason: Finding | None = None
        if not beads.measured[number]:
            reason = LOST
        elif not DEPTH[0] < depth < DEPTH[1]:
            cause = f'a contrast of {depth:.0%} of that of a bead'
            reason = Finding(Kind.BEAD_CONTRAST, cause, numbers={'depth': depth})
        elif beads.misfit[number] > MAX_MISFIT:
            reason = DISTURBED
        elif beads.sigma[number] > MAX_SIGMA_PX:
            reason = HIDDEN
        elif off > reach_px[number]:
            cause = f'{off:.1f} px from its prediction'
            reason = Finding(Kind.BEAD_AWAY, cause, numbers={'off_px': off})
        out.append(reason)
    return out
