# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Noise of image points without sigma, estimated from the rays of a recording.

If image points have no sigma, that of the calibration is used, which applies to beads as they were
measured. Markers measured by another program may scatter several times as much, so that true
points are rejected and standard deviations are too small. Epipolar residuals of one target in
consecutive exposures, between which it hardly moves, share the errors of the rig and of the
correction, and differ by the noise alone (von Neumann, "Distribution of the ratio of the mean
square successive difference to the variance", Annals of Mathematical Statistics 12, 1941). The
estimated noise is used only if it also explains the residuals themselves. Noise below that of the
calibration is not used: tracks may be smoothed, and then share their errors.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import combinations
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..correction.fluoroscope_calibration import FluoroscopeCalibration
from ..exposures.frame import Frame
from ..findings import Finding, Kind, Severity
from ..photogrammetry.noise import (
    CERTAIN,
    MEDIAN_SD,
    NORMAL_MEDIAN,
    SURE,
    WINDOW,
    trimmed_scale,
)
from ..photogrammetry.rig_orientation import RigOrientation
from .epipolar import EpipolarGeometry
from .reconstruct import MatchedViews, RigRecording, match_views

MAX_PAIRS = 200  # pairs of consecutive exposures, evenly spread over a recording
MIN_DIFFERENCES = 30
NEAR = 1 / 32  # distance within which correction errors are equal, over the image width
# Minimum ratio to the noise of the calibration to use the estimate: less does no harm.
MIN_FACTOR = 1.25
# Maximum ratio of residuals to explained ones for which no other error is assumed.
MAX_UNEXPLAINED = 1.5


class _Residuals(NamedTuple):
    """Epipolar residuals of an exposure by pair of views and target."""

    key: NDArray[np.int64]  # (n, 2) pair of views, target id
    place: NDArray[np.float64]  # (n, 4) image points in both views, over the image widths
    value: NDArray[np.float64]  # (n,) [px]
    noise_sd: NDArray[np.float64]  # (n,) due to the noise of the calibration [px]
    other_sd: NDArray[np.float64]  # (n,) due to correction and rig [px]


def with_observed_noise(
    recording: RigRecording, must_explain: bool = True
) -> tuple[RigRecording, Finding | None]:
    """Assign to the image points of a recording the noise that their rays show.

    must_explain: False if rays may also miss each other for another reason, such as a change of
    the rig. Returns the recording with sigma, and a finding on it. Returns the given recording and
    None if any have sigma, if they scatter as the calibration says, or if the noise cannot be
    determined. Raises DataError for frames that cannot be corrected.
    """
    names = recording.fluoroscopes
    given_frames = [frame for name in names for frame in recording.frames.get(name, ())]
    if any(frame.sigma is not None for frame in given_frames):
        return recording, None
    exposures = recording.exposures
    if len(exposures) < 2:
        return recording, None
    count = min(MAX_PAIRS, len(exposures) - 1)
    starts = np.unique(np.linspace(0, len(exposures) - 2, count).astype(int)).tolist()
    rows = {*starts, *(start + 1 for start in starts)}
    geometries = _pairs_of_views(recording.orientation)
    residuals = {row: _residuals(exposures[row], recording, geometries) for row in rows}
    factor = _factor([(residuals[start], residuals[start + 1]) for start in starts])
    if factor < MIN_FACTOR or (must_explain and not _explains(factor, list(residuals.values()))):
        return recording, None
    calibrations = recording.calibrations
    changed = {
        name: [
            replace(frame, sigma=factor * calibrations[name].image_sd_at(frame.uv))
            for frame in view_frames
        ]
        for name, view_frames in recording.frames.items()
        if name in names
    }
    finding = _finding(factor, [calibrations[name] for name in names])
    return recording.with_frames({**recording.frames, **changed}), finding


def _finding(factor: float, calibrations: Sequence[FluoroscopeCalibration]) -> Finding:
    stated = float(np.mean([calibration.image_sd for calibration in calibrations]))
    return Finding(
        Kind.NOISE_OBSERVED,
        f'the image points have no sigma, and their rays show a noise of {factor * stated:.2g} '
        f'px where the calibration has {stated:.2g} px; the noise of the rays is used',
        advice='give their sigma, if it is known',
        severity=Severity.NOTE,
        numbers={'noise_px': factor * stated, 'calibration_px': stated},
    )


def _factor(pairs: Sequence[tuple[_Residuals, _Residuals]]) -> float:
    """Return the noise in consecutive exposures over the calibration's; 1 if unknown."""
    factor, count = _scatter(np.concatenate([_differences(*pair) for pair in pairs]))
    if not count:
        return 1.0
    # Each residual enters two differences.
    chance = 1 + SURE * MEDIAN_SD / np.sqrt(count / 2)
    return factor if factor > chance else 1.0


class NoiseOfRays:
    """Factor by which the rays of a stream of exposures scatter more than their sigma.

    orientation: of the fluoroscopes. widths: of their images [px].
    """

    def __init__(self, orientation: RigOrientation, widths: Sequence[int]) -> None:
        self._geometries = _pairs_of_views(orientation)
        self._widths = widths
        self.factor = 1.0  #: at least 1, for the standard deviations of the next exposure
        self._last: _Residuals | None = None
        self._differences = np.zeros(0)

    def add(self, views: MatchedViews) -> None:
        """Add an exposure whose standard deviations are those with the current factor."""
        residuals = _residuals_of(views, self._geometries, self._widths)
        if not len(residuals.value):
            return
        stated = residuals._replace(noise_sd=residuals.noise_sd / self.factor)
        if self._last is not None:
            new = _differences(self._last, stated)
            self._differences = np.concatenate([self._differences, new])[-WINDOW:]
            self.factor, _ = _scatter(self._differences)
        self._last = stated


def _scatter(differences: NDArray[np.float64]) -> tuple[float, int]:
    """Return the scatter of differences (n,) over the expected one, at least 1, and their number.

    Returns 1 and 0 if there are too few.
    """
    factor, count = trimmed_scale(differences / NORMAL_MEDIAN, CERTAIN / NORMAL_MEDIAN)
    return (factor, count) if count >= MIN_DIFFERENCES else (1.0, 0)


def _explains(factor: float, residuals: Sequence[_Residuals]) -> bool:
    """Return whether residuals agree with noise larger by a factor than the calibration's."""
    size = [
        np.abs(part.value) / np.hypot(factor * part.noise_sd, part.other_sd) for part in residuals
    ]
    return bool(np.median(np.concatenate(size)) <= MAX_UNEXPLAINED * NORMAL_MEDIAN)


def _differences(one: _Residuals, other: _Residuals) -> NDArray[np.float64]:
    """Return differences (m,) of residuals of targets that hardly move, over expected noise."""
    keys = {tuple(key): row for row, key in enumerate(other.key.tolist())}
    rows = [(i, keys[tuple(key)]) for i, key in enumerate(one.key.tolist()) if tuple(key) in keys]
    i, j = np.array(rows, dtype=int).reshape(-1, 2).T
    is_near = (np.abs(one.place[i] - other.place[j]) <= NEAR).all(axis=1)
    i, j = i[is_near], j[is_near]
    sd = np.hypot(one.noise_sd[i], other.noise_sd[j])
    return np.asarray(np.abs(one.value[i] - other.value[j]) / sd)


def _pairs_of_views(orientation: RigOrientation) -> list[EpipolarGeometry]:
    return [
        EpipolarGeometry(orientation, a, b) for a, b in combinations(orientation.fluoroscopes, 2)
    ]


def _residuals(
    exposure: Mapping[str, Frame], recording: RigRecording, geometries: Sequence[EpipolarGeometry]
) -> _Residuals:
    """Return the epipolar residuals of all pairs of views within the calibrated areas."""
    names = recording.fluoroscopes
    views = match_views(
        [recording.corrected(exposure[name]) if name in exposure else None for name in names]
    )
    widths = [recording.calibrations[name].image_size[0] for name in names]
    return _residuals_of(views, geometries, widths)


def _residuals_of(
    views: MatchedViews, geometries: Sequence[EpipolarGeometry], widths: Sequence[int]
) -> _Residuals:
    """Return the epipolar residuals of all pairs of views of an exposure."""
    noise = np.sqrt(np.maximum(views.sigma**2 - views.correction_sd**2, 0.0))
    parts = []
    for number, (a, b) in enumerate(combinations(range(len(widths)), 2)):
        rows = np.flatnonzero(
            np.isfinite(views.uv[[a, b]]).all(axis=(0, 2)) & ~views.outside[[a, b]].any(axis=0)
        )
        uv = views.uv[a, rows], views.uv[b, rows]
        found = geometries[number].residuals(*uv, views.sigma[a, rows], views.sigma[b, rows])
        noise_sd = np.hypot(found.factor_a * noise[a, rows], found.factor_b * noise[b, rows])
        pair = np.full(len(rows), number)
        parts.append(
            _Residuals(
                np.column_stack([pair, views.target_id[rows]]),
                np.column_stack([uv[0] / widths[a], uv[1] / widths[b]]),
                found.residual,
                noise_sd=noise_sd,
                other_sd=np.sqrt(np.maximum(found.sd_total**2 - noise_sd**2, 0.0)),
            )
        )
    return _Residuals(*(np.concatenate(values) for values in zip(*parts)))
