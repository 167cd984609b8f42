# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Imaging of beads: noise, the shadow of a typical bead, the sizes of all beads.

A phantom without specified sizes may have several. An isolated bead has the size with which its
shadow fits best; if nearly all beads of a sample have the same size, all beads have. Behind two
beads, scattered light is not absorbed twice: shadows that overlap determine its share.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from .detection import LARGER
from .light import MIN_VARIANCE, Light, Noise, vertex
from .measurement import FIRST_STEPS, RADIUS_SD, STEPS, BeadFit, rounded, scatter_equation
from .profile import LIMITS, MASKED, PLAIN, SHAPE, Profile, fit_profile
from .shadow_fit import DISTURBED, ShadowFit, noise_of_windows

PROFILE_STEPS = 3
# The same where pixels are clipped: the light that they hide converges more slowly. With 3, 268 of
# 291 beads were measured in 10 over-exposed renderings with plates, with 4 282, with 5 284.
CLIPPED_STEPS = 4
PROFILE_BEADS = 100  # largest number of beads for the profile
# Rounds without a better fit, after which the best profile is chosen in windows of equal size: a
# hard edge with a wide blur looks like a sphere. If the radius grows by a half, fits get worse
# before they get better.
PATIENCE = 4
PROFILE_ROUNDS = 30  # largest number of rounds; 4 to 10 were needed
MOST = 2.0  # largest factor between the radius of a bead and that of its detection
START_BLUR_PX = 0.9
START_ATTENUATION = 1.5
START_SCATTER = 0.1
START_SHARPENING = 1.0
START_MASK_PX = 3.0
# Common share of the lack of fit from which an unsharp mask is searched for. It was .21 to .43 in
# four images with a mask of factor 1.5 and 3 px, and at most .15 in 41 images without one but in
# one, whose profile was not the best.
COMMON = 0.15
FREE_OF_EDGES = 0.25  # share of windows that are free of edges, at least
MIN_SHARPENING = 0.1  # factor of a mask that hardly changes an image
# Largest lack of fit with a mask over that without one. It was .43 to .88 in seven images with a
# mask whose parameters were found, and .98 in one where they were not.
BETTER = 0.9
SETTLED = 0.1 * RADIUS_SD  # relative change of the radius at which a profile has converged
STEP = 1.25  # ratio of consecutive sizes in the first comparison
SIZES = STEP ** np.arange(-4, 5)
FINER_STEPS = (STEP**0.5, STEP**0.25, STEP**0.125)  # ratios of sizes in the refinements
FEW = 5  # isolated beads below which overlapping beads are used for the profile as well
SAMPLE = 40  # beads that decide whether sizes differ
OTHERS = 0.2  # largest share of beads in the sample with another object next to them
ROUNDS = 2  # the second round uses a profile of beads of one size
# Standard deviation of the share of scattered light from isolated shadows, which hardly separate
# it from attenuation: in renderings with a share of 0.1, it was 0.06 to 0.31.
SCATTER_SD = 0.1
SCATTER_ROUNDS = 3  # windows of overlapping shadows with a large lack of fit are used later
SCATTER_MARGIN = 0.1  # of windows, in which different profiles are compared
SCATTER_STEP = 0.01  # change of the light behind two beads below the noise of a pixel


def estimate_profile(
    light: Light,
    uv: NDArray[np.float64],
    shape: NDArray[np.float64],
    radius_px: float,
    size: NDArray[np.float64] | None = None,
    start: Profile | None = None,
    estimated: Sequence[str] = PLAIN,
) -> Profile:
    """Estimate the shadow of a typical bead from isolated beads.

    radius_px: initial value of its radius. start: initial profile. estimated: parameters that are
    estimated; if the scattered light is not, a start that fits better stays. The other arguments
    are those of `measure_beads`.
    """
    is_known = start is not None and 'scatter' not in estimated
    distance = cKDTree(uv).query(uv, k=[2])[0][:, 0] if len(uv) > 1 else np.full(1, np.inf)
    alone = np.argsort(-distance, kind='stable')[:PROFILE_BEADS]
    place = uv[alone]
    shapes = shape[alone], None if size is None else size[alone]
    start = start or Profile(radius_px * 0.95, START_BLUR_PX, START_ATTENUATION, START_SCATTER)
    # Windows that end with a mask hardly tell its width: the narrower it is taken, the smaller are
    # they, and fits in them are not comparable.
    least_reach_px = start.reach_px if start.sharpening else 0.0
    profiles = [start]
    lacks: list[float] = []
    fit: BeadFit | None = None
    closest: BeadFit | None = None
    while len(lacks) < PROFILE_ROUNDS and len(lacks) - int(np.argmin(lacks or [0])) <= PATIENCE:
        before = profiles[-1]
        fit = _profile_fit(
            light, place, shapes, profile=before, reach_px=least_reach_px, former=fit
        )
        place = fit.uv
        lacks.append(_lack(fit))
        closest = fit if lacks[-1] == min(lacks) else closest
        profile = fit_profile(fit.absorbed(), before, estimated)
        if not radius_px / MOST < profile.radius_px < radius_px * MOST:
            break
        profiles.append(profile)
        if _settled(profile, before, estimated):
            if not is_known:
                return profile
            break
    reach_px = max(profile.reach_px for profile in profiles)
    # Skip the initial guess: it fits shadows as small as their blur about as well.
    estimates = [start, profiles[-1]] if is_known else profiles[1:] or profiles
    fits = [
        _profile_fit(light, uv[alone], shapes, profile=profile, reach_px=reach_px, former=closest)
        for profile in estimates
    ]
    return min(fits, key=ShadowFit.typical).profile


def _settled(profile: Profile, before: Profile, estimated: Sequence[str]) -> bool:
    """Return whether the estimated parameters of a profile changed less than the tolerances.

    Attenuation and scattered light need not settle together: shadows hardly separate them.
    """
    names = SHAPE[:2] if 'scatter' in estimated else estimated
    change = {name: abs(getattr(profile, name) / getattr(before, name) - 1) for name in names}
    return change['radius_px'] < SETTLED and max(change.values()) < RADIUS_SD


def _profile_fit(
    light: Light,
    uv: NDArray[np.float64],
    shapes: tuple[NDArray[np.float64], NDArray[np.float64] | None],
    profile: Profile,
    reach_px: float = 0.0,
    former: BeadFit | None = None,
) -> BeadFit:
    """Fit shadows with a fixed profile, in windows that reach at least as far as reach_px.

    shapes: shapes and sizes of the beads, as in `measure_beads`. former: fit of another profile,
    whose light without beads is the initial one in a clipped image. What clipped pixels tell
    depends on the noise; it follows from the former fit, too.
    """
    gain = 1.0
    former = former if light.clipping else None
    if former:
        gain = max(_lack(former), MIN_VARIANCE / float(np.median(former.background.light)))
    noise = Noise(0.0, gain, np.ones((1, 1)))
    shape, size = shapes
    fit = BeadFit(light, uv, shape, profile=profile, noise=noise, size=size, reach_px=reach_px)
    if former:
        fit.background.start(former.background.light, fit.background.around, profile.scatter)
    fit.background.plane_only = True
    fit.hidden = None
    fit.background.spread[:] = np.inf
    fit.run(CLIPPED_STEPS if light.clipping else PROFILE_STEPS)
    return fit


def _lack(fit: BeadFit) -> float:
    """Return the typical lack of fit with a fixed profile, the noise over the light."""
    return fit.typical() * fit.noise.gain


@dataclass(frozen=True)
class Expected:
    """Expected shadows of beads."""

    row: NDArray[np.int64]  #: (n,), row of the bead in the phantom
    uv: NDArray[np.float64]  #: (n, 2) [px]
    #: (n, 2, 2), matrices from the circle of a typical bead to the borders of shadows of that size
    shape: NDArray[np.float64]
    seen: NDArray[np.bool_]  #: (n,), True if something was detected there
    alone: NDArray[np.bool_]  #: (n,), True if no other shadow is near

    @property
    def radius(self) -> NDArray[np.float64]:
        """Relative radii (n,) that the shadows have if all beads are of typical size."""
        return np.sqrt(np.abs(np.linalg.det(self.shape)))


@dataclass(frozen=True)
class Imaging:
    """Noise and shadows of an image."""

    noise: Noise
    profile: Profile  #: shadow of a typical bead
    #: (n,), relative size of each bead of the phantom; 1 is typical, NaN is unknown
    size: NDArray[np.float64]
    black: float = 0.0  #: grey value of no light; the noise is that of the light above it

    @property
    def sizes_are_alike(self) -> bool:
        """Whether no bead is much larger than a typical one."""
        return bool((self.size < LARGER[0]).all())

    def completed(self, light: Light, shadows: Expected) -> Imaging:
        """Return a copy that adds the unknown sizes of beads that are isolated in this image."""
        unknown = np.flatnonzero(shadows.alone & np.isnan(self.size[shadows.row]))
        if not len(unknown):
            return self
        size = self.size.copy()
        size[shadows.row[unknown]] = _Sizes(light, shadows, self).best(unknown)
        return replace(self, size=size)


def first_imaging(
    light: Light,
    noise: Noise,
    shadows: Expected,
    radius_px: float,
    size: NDArray[np.float64],
    start: Profile | None = None,
) -> Imaging:
    """Estimate the shadows and sizes of beads from an image.

    radius_px: initial value of the radius of a typical bead. size: (n,) relative sizes of all
    beads of the phantom, NaN if unspecified. start: initial profile.
    """
    profile = _typical(light, shadows, size, radius_px, start=start)
    imaging = Imaging(noise, profile, size)
    if not np.isfinite(size).all():
        imaging = _with_sizes(light, shadows, imaging)
    imaging = _with_mask(light, shadows, imaging)
    return _with_scatter(light, shadows, imaging)


def _with_sizes(light: Light, shadows: Expected, imaging: Imaging) -> Imaging:
    """Return a copy with the sizes of isolated beads, or of all beads if they are equal."""
    alone = np.flatnonzero(shadows.seen & shadows.alone)
    sizes = _Sizes(light, shadows, imaging)
    if sizes.are_equal(_sampled(alone, SAMPLE)):
        return replace(imaging, size=np.ones_like(imaging.size))
    for _ in range(ROUNDS):
        sizes = sizes.with_sizes(alone, sizes.best(alone))
    return sizes.imaging


def _with_mask(light: Light, shadows: Expected, imaging: Imaging) -> Imaging:
    """Return a copy with the unsharp mask that the image has.

    It gives shadows bright borders, so that shadows that are close move apart, and without it,
    residuals are no noise. It is only looked for if those of isolated shadows have a part in
    common.
    """
    size = imaging.size[shadows.row]
    start = replace(
        imaging.profile.with_scatter(START_SCATTER),
        sharpening=START_SHARPENING,
        mask_px=START_MASK_PX,
    )
    distance = _distance(shadows)
    alone = shadows.seen & np.isfinite(size) & (distance > 2 * start.reach_px)
    rows = _sampled(np.flatnonzero(alone), SAMPLE)
    if len(rows) < FEW:
        return imaging
    shapes = shadows.shape[rows], size[rows]
    fit = _profile_fit(light, shadows.uv[rows], shapes, imaging.profile)
    if light.clipping:  # the light that clipped pixels hide has not converged
        fit = _profile_fit(light, shadows.uv[rows], shapes, profile=imaging.profile, former=fit)
    if np.median(fit.common_share()) < COMMON:
        return imaging
    masks = [_masked(light, replace(shadows, alone=alone), imaging, start)]
    # Edges of plates spoil the estimate, and comparisons: windows without them decide.
    wide = _profile_fit(light, shadows.uv[rows], shapes, imaging.profile, start.reach_px)
    free = wide.misfit <= DISTURBED * np.quantile(wide.misfit, FREE_OF_EDGES)
    if FEW <= np.count_nonzero(free) < len(rows):
        rows = rows[free]
        shapes = shadows.shape[rows], size[rows]
        fit = _profile_fit(light, shadows.uv[rows], shapes, imaging.profile)
        alone = np.isin(np.arange(len(alone)), rows)
        masks.append(_masked(light, replace(shadows, alone=alone), imaging, start))
    # A mask hardly changes the radius: it was at most 9 % in images with a mask.
    masks = [one for one in masks if 1 / STEP < one.radius_px / start.radius_px < STEP]
    if not masks:
        return imaging
    reach_px = max(profile.reach_px for profile in masks)
    plain, *masked = (
        _lack(
            _profile_fit(
                light, shadows.uv[rows], shapes, profile=one, reach_px=reach_px, former=fit
            )
        )
        for one in (imaging.profile, *masks)
    )
    if min(masked) >= BETTER * plain:
        return imaging
    profile = masks[int(np.argmin(masked))]
    fit = BeadFit(
        light, shadows.uv[rows], shapes[0], profile=profile, noise=imaging.noise, size=shapes[1]
    )
    fit.run(STEPS)
    return replace(imaging, profile=profile, noise=noise_of_windows(fit))


def _masked(light: Light, shadows: Expected, imaging: Imaging, start: Profile) -> Profile:
    """Return the profile of isolated shadows with an unsharp mask, or without if it is weak."""
    profile = start
    # Far from the right mask, a share of scattered light that is estimated with it runs away.
    for estimated in (MASKED, (*MASKED, 'scatter')):
        profile = _typical(
            light, shadows, imaging.size, start.radius_px, start=profile, estimated=estimated
        )
    if profile.sharpening < MIN_SHARPENING:
        return replace(profile, sharpening=0.0, mask_px=0.0)
    return profile


def _with_scatter(light: Light, shadows: Expected, imaging: Imaging) -> Imaging:
    """Return a copy with the share of scattered light from shadows that overlap.

    Without isolated shadows, or if the model does not fit them, the share stays as it is.
    """
    size = imaging.size[shadows.row]
    overlapping = _sampled(_overlapping(shadows, size, imaging.profile.radius_px), PROFILE_BEADS)
    alone = np.flatnonzero(shadows.seen & shadows.alone & np.isfinite(size))
    if not (len(overlapping) and len(alone)):
        return imaging
    rows = np.concatenate([overlapping, _sampled(alone, SAMPLE)])
    reach_px = (1 + SCATTER_MARGIN) * size[rows].max() * imaging.profile.reach_px

    def fitted(imaging: Imaging) -> tuple[BeadFit, NDArray[np.float64]]:
        fit = _Sizes(light, shadows, imaging).fitted(rows, size[rows], STEPS - 1, (reach_px,) * 2)
        return fit, fit.misfit[: len(rows)]

    fit, lack = fitted(imaging)
    if np.median(lack[len(overlapping) :]) > DISTURBED:
        return imaging
    first = imaging.profile.scatter
    weight = SCATTER_SD**-2.0
    for _ in range(SCATTER_ROUNDS):
        right, information = scatter_equation(fit, len(overlapping))
        before = imaging.profile
        step = (right + weight * (first - before.scatter)) / (information + weight)
        scatter = float(np.clip(before.scatter + step, *LIMITS['scatter']))
        known = before.with_scatter(scatter)
        if abs(known.scatter - before.scatter) < SCATTER_STEP:
            break
        profile = _typical(
            light, shadows, imaging.size, before.radius_px, start=known, estimated=SHAPE
        )
        changed = replace(imaging, profile=profile)
        fit, changed_lack = fitted(changed)
        if np.mean(np.log(changed_lack / lack)) > 0:
            break
        imaging, lack = changed, changed_lack
    return imaging


def _overlapping(
    shadows: Expected, size: NDArray[np.float64], radius_px: float
) -> NDArray[np.int64]:
    """Return the expected shadows (m,) that overlap with the nearest one."""
    known = np.flatnonzero(np.isfinite(size))
    if len(known) < 2:
        return known[:0]
    radius = radius_px * shadows.radius[known] * size[known]
    distance, near = cKDTree(shadows.uv[known]).query(shadows.uv[known], k=2)
    nearest = np.where(near[:, 0] == np.arange(len(known)), near[:, 1], near[:, 0])
    return known[distance[:, 1] < radius + radius[nearest]]


def _distance(shadows: Expected) -> NDArray[np.float64]:
    """Return distances (n,) of shadows from the nearest other one [px]."""
    if len(shadows.uv) < 2:
        return np.full(len(shadows.uv), np.inf)
    return np.asarray(cKDTree(shadows.uv).query(shadows.uv, k=[2])[0][:, 0])


def _sampled(rows: NDArray[np.int64], count: int) -> NDArray[np.int64]:
    """Return at most so many of some rows."""
    return rows[:: len(rows) // count + 1]


def _typical(
    light: Light,
    shadows: Expected,
    size: NDArray[np.float64],
    radius_px: float,
    start: Profile | None = None,
    estimated: Sequence[str] = PLAIN,
) -> Profile:
    """Estimate the profile of a bead of size 1 from isolated beads.

    start, estimated: those of `estimate_profile`.
    """
    seen = np.flatnonzero(shadows.seen & shadows.alone)
    if len(seen) < FEW:
        seen = np.flatnonzero(shadows.seen)
    relative = size[shadows.row[seen]]
    known = np.isfinite(relative)
    if known.any():
        seen = seen[known]
    relative = relative[known] if known.any() else np.ones(len(seen))
    alike = rounded(relative, FINER_STEPS[1])
    shape = shadows.shape[seen] * (relative / alike)[:, None, None]
    return estimate_profile(
        light,
        shadows.uv[seen],
        shape,
        radius_px,
        size=alike,
        start=start,
        estimated=estimated,
    )


class _Sizes:
    """Comparison of bead sizes in an image."""

    def __init__(self, light: Light, shadows: Expected, imaging: Imaging) -> None:
        self.light = light
        self.shadows = shadows
        self.imaging = imaging

    def are_equal(self, rows: NDArray[np.int64]) -> bool:
        """Return whether nearly all beads without a disturbance nearby have the same size.

        A bead differs if the common size fits it as badly as if something disturbed it.
        """
        if not len(rows):
            return True
        same = np.ones(len(rows))
        smaller, common, larger = self.lacks(rows, [same / STEP, same, same * STEP])
        if np.mean(common > DISTURBED * np.minimum(smaller, larger)) <= OTHERS:
            return True
        # A mean profile of beads of several sizes fits few of them.
        sized = self.with_sizes(rows, self.best(rows))
        size = sized.imaging.size[self.shadows.row[rows]]
        own, common = sized.lacks(rows, [size, same])
        differs = np.abs(np.log(size)) > 0.5 * np.log(STEP)
        differs &= common > DISTURBED * own
        return bool(np.mean(differs[own < DISTURBED * np.median(own)]) <= OTHERS)

    def with_sizes(self, rows: NDArray[np.int64], sizes: NDArray[np.float64]) -> _Sizes:
        """Return a comparison whose profile is estimated from beads with sizes (m,) found."""
        middle = float(np.median(sizes))
        size = np.full_like(self.imaging.size, np.nan)
        size[self.shadows.row[rows]] = sizes / middle
        radius_px = self.imaging.profile.radius_px * middle
        profile = _typical(self.light, self.shadows, size, radius_px)
        return _Sizes(self.light, self.shadows, Imaging(self.imaging.noise, profile, size))

    def best(self, rows: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return the best-fitting sizes (m,) of beads."""
        same = np.ones(len(rows))
        lack = self.lacks(rows, [one * same for one in SIZES])
        size = SIZES[np.clip(np.argmin(lack, axis=0), 1, len(SIZES) - 2)]
        row = np.arange(len(rows))
        for step in FINER_STEPS:
            tried = np.stack([size / step, size, size * step])
            lack = self.lacks(rows, list(tried))
            least = np.argmin(lack, axis=0)
            size = tried[least, row]
        # A parabola only improves a size if both neighbouring sizes fit worse.
        return np.asarray(size * np.where(least == 1, FINER_STEPS[-1] ** vertex(*-lack), 1.0))

    def lacks(
        self, rows: NDArray[np.int64], sizes: Sequence[NDArray[np.float64]]
    ) -> NDArray[np.float64]:
        """Return the lack of fit (k, m) of beads (m,) for k sets of sizes (m,).

        The shadows around the beads are fitted as well.
        """
        # A small shadow has to explain the window of a typical bead.
        reach_px = self.imaging.profile.reach_px
        largest_px = max(1.0, float(np.max(sizes))) * reach_px
        fits = [self.fitted(rows, size, FIRST_STEPS, (reach_px, largest_px)) for size in sizes]
        return np.stack([fit.misfit[: len(rows)] for fit in fits])

    def fitted(
        self,
        rows: NDArray[np.int64],
        size: NDArray[np.float64],
        steps: int,
        reaches_px: tuple[float, float],
    ) -> BeadFit:
        """Fit beads (m,) of sizes (m,) and, after them, the shadows around.

        reaches_px: smallest reach of the windows, and the largest, up to which shadows are around.
        """
        shadows = self.shadows
        imaging = self.imaging
        # The windows of the beads, and the largest shadow that may reach into them.
        reach = reaches_px[1] + np.nanmax(imaging.size, initial=1.0) * imaging.profile.reach_px
        near = cKDTree(shadows.uv).query_ball_point(shadows.uv[rows], reach)
        around = np.setdiff1d(np.concatenate(near).astype(int), rows)
        every = np.concatenate([rows, around])
        known = np.nan_to_num(imaging.size[shadows.row[around]], nan=1.0)
        fit = BeadFit(
            self.light,
            shadows.uv[every],
            shadows.shape[every],
            profile=imaging.profile,
            noise=imaging.noise,
            size=np.concatenate([size, known]),
            reach_px=reaches_px[0],
        )
        fit.run(steps)
        return fit
