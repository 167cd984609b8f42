# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Find targets of a phantom whose coordinates are in a different unit from the others.

If most targets are right, the wrong ones are those whose image points lie where a direct linear
transformation of the others predicts a multiple of their coordinates. If about half are right,
there is no majority, and the transformation is searched for with both versions of each target.
Among samples of six image points, each matched with the target or with its multiple, the one with
the smallest median residual of the better versions is refined.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ..errors import DataError
from ..estimation.initial_network import MIN_TARGETS_OF_EXPOSURE
from ..exposures.frame import Frame, Frames
from ..exposures.phantom import MISTAKEN_UNITS, Phantom
from ..findings import Finding, Kind, Place, first_few
from ..photogrammetry.resection import (
    SAMPLE_SIZE,
    decompose,
    direct_linear_transformation,
    least_vectors_with_last_one,
    robust_dlt,
    squared_residuals,
)

DISTANCES_MM = (200.0, 10_000.0)  # plausible distances of the source from a phantom in mm
MAX_TESTED = 3  # exposures per fluoroscope, those with the most targets
# Residual over the longer side of the image of a target that is not at its place, and of one that
# is. Also limits of the median for an exposure whose ids are wrong, and right.
OFF = 0.03
AT = 0.01
FIT = 0.004  # median of these residuals if all targets have the right unit
UNCLEAR = 0.6  # share of targets in place below which there may be no majority
MIN_GROUP = 3  # minimum number of targets in either unit
SAMPLES = 1500
STEPS = 10


def mixed_units(frames: Frames, phantom: Phantom, is_suspicious: bool = False) -> Finding | None:
    """Return a finding if a part of the targets is in a different unit from the others.

    frames: exposures by fluoroscope, each of them valid. is_suspicious: whether the exposures do
    not fit the phantom, so that there may be no majority.
    """
    exposures = [
        _on_phantom(frame, phantom)
        for of_fluoroscope in frames.values()
        for frame in of_fluoroscope
    ]
    exposures = [frame for frame in exposures if len(frame.target_id) >= MIN_TARGETS_OF_EXPOSURE]
    tested = [
        frame
        for name in frames
        for frame in sorted(
            (f for f in exposures if f.fluoroscope == name), key=lambda f: -len(f.target_id)
        )[:MAX_TESTED]
    ]
    for frame in tested:
        suspect = _factor_of(frame, phantom, is_suspicious)
        if suspect is None:
            continue
        factor, group = suspect
        scaled, distance = _whole_group(exposures, phantom, factor, group)
        unscaled = _seen(exposures, phantom) & ~scaled
        if min(scaled.sum(), unscaled.sum()) < MIN_GROUP:
            continue
        low, high = DISTANCES_MM
        if not low <= distance <= high and low <= distance / factor <= high:
            scaled, factor = unscaled, 1 / factor  # these are in the wrong unit
        return _finding(phantom.target_id[scaled], factor)
    return None


def _on_phantom(frame: Frame, phantom: Phantom) -> Frame:
    known = phantom.index(frame.target_id) >= 0
    return replace(
        frame,
        target_id=np.asarray(frame.target_id)[known],
        uv=np.asarray(frame.uv, dtype=float)[known],
        sigma=None,
    )


def _seen(frames: Sequence[Frame], phantom: Phantom) -> NDArray[np.bool_]:
    """Return which targets (n,) of a phantom are seen."""
    return np.isin(phantom.target_id, np.concatenate([frame.target_id for frame in frames]))


def _factor_of(
    frame: Frame, phantom: Phantom, is_suspicious: bool
) -> tuple[float, NDArray[np.bool_]] | None:
    """Return the factor by which some targets fit, and which (n,) targets; or None."""
    rows = phantom.index(frame.target_id)
    xyz = phantom.xyz_mm[rows]
    limit = max(frame.image_size)
    try:
        with np.errstate(all='ignore'):
            projection = robust_dlt(xyz, frame.uv)
    except (DataError, np.linalg.LinAlgError):
        return None
    residual = np.sqrt(squared_residuals(projection, xyz, frame.uv))
    is_off = residual > OFF * limit
    for factor in (*MISTAKEN_UNITS, *(1 / factor for factor in MISTAKEN_UNITS)):
        scaled = np.sqrt(squared_residuals(projection, factor * xyz, frame.uv))
        fits_scaled = is_off & (scaled < AT * limit)
        if fits_scaled.sum() >= MIN_GROUP and (residual < AT * limit).sum() > fits_scaled.sum():
            return factor, _chosen(phantom, rows[fits_scaled])
    if not is_suspicious and np.mean(~is_off) > UNCLEAR:
        return None
    return _factor_by_samples(frame, xyz, rows, phantom)


def _factor_by_samples(
    frame: Frame, xyz: NDArray[np.float64], rows: NDArray[np.int64], phantom: Phantom
) -> tuple[float, NDArray[np.bool_]] | None:
    """Do the same as `_factor_of` without a majority of the targets (n, 3)."""
    rng = np.random.default_rng(0)
    limit = max(frame.image_size)
    samples = np.argsort(rng.random((SAMPLES, len(xyz))), axis=1)[:, :SAMPLE_SIZE]
    choice = rng.integers(0, 2, samples.shape)
    for factor in MISTAKEN_UNITS:
        versions = np.stack([xyz, factor * xyz])
        try:
            with np.errstate(all='ignore'):
                candidates = direct_linear_transformation(
                    versions[choice, samples], frame.uv[samples], least_vectors_with_last_one
                )(None)
                squared = [
                    squared_residuals(candidates, version, frame.uv) for version in versions
                ]
                best = candidates[np.argmin(np.median(np.minimum(*squared), axis=1))]
                scaled, median = _refined(best, versions, frame.uv)
        except (DataError, np.linalg.LinAlgError):
            continue
        if median < FIT * limit and MIN_GROUP <= scaled.sum() <= len(xyz) - MIN_GROUP:
            return factor, _chosen(phantom, rows[scaled])
    return None


def _refined(
    projection: NDArray[np.float64], versions: NDArray[np.float64], uv: NDArray[np.float64]
) -> tuple[NDArray[np.bool_], float]:
    """Return which (n,) of versions (2, n, 3) are multiples, and the median residual."""
    points = np.arange(len(uv))
    scaled = np.zeros(len(uv), dtype=int)
    for _ in range(STEPS):
        squared = np.stack([squared_residuals(projection, version, uv) for version in versions])
        before, scaled = scaled, np.argmin(squared, axis=0)
        projection = robust_dlt(versions[scaled, points], uv)
        if np.array_equal(before, scaled):
            break
    squared = squared_residuals(projection, versions[scaled, points], uv)
    return scaled == 1, float(np.sqrt(np.median(squared)))


def _chosen(phantom: Phantom, rows: NDArray[np.int64]) -> NDArray[np.bool_]:
    out = np.zeros(len(phantom.target_id), dtype=bool)
    out[rows] = True
    return out


def _whole_group(
    frames: Sequence[Frame], phantom: Phantom, factor: float, group: NDArray[np.bool_]
) -> tuple[NDArray[np.bool_], float]:
    """Return which (n,) targets fit by the factor in most exposures, and the source's distance.

    group (n,): a part of these targets. The distance [mm] is that with them multiplied.
    """
    votes = np.zeros(len(phantom.target_id))
    distances: list[float] = []
    for _ in range(STEPS):  # each exposure shows only a part of the group
        xyz = np.where(group[:, None], factor * phantom.xyz_mm, phantom.xyz_mm)
        votes[:] = 0
        distances = []
        for frame in frames:
            rows = phantom.index(frame.target_id)
            try:
                with np.errstate(all='ignore'):
                    projection = robust_dlt(xyz[rows], frame.uv)
                    _, _, source = decompose(projection)
            except (DataError, np.linalg.LinAlgError):
                continue
            limit = max(frame.image_size)
            unscaled, scaled = (
                np.sqrt(squared_residuals(projection, f * phantom.xyz_mm[rows], frame.uv))
                for f in (1.0, factor)
            )
            is_multiple = (scaled < AT * limit) & (unscaled > OFF * limit)
            is_own = unscaled < AT * limit
            if is_multiple.any() and is_own.sum() < MIN_GROUP:
                continue  # multiples alone look like a larger phantom, farther away
            votes[rows] += is_multiple
            votes[rows] -= is_own
            distances.append(float(np.linalg.norm(source - xyz[rows].mean(axis=0))))
        before, group = group, votes > 0
        if np.array_equal(before, group):
            break
    return group, float(np.median(distances)) if distances else np.nan


def _finding(ids: NDArray[np.int64], factor: float) -> Finding:
    """Return the finding on targets that fit after multiplication by a factor."""
    unit = MISTAKEN_UNITS.get(factor)
    remark = f' ({unit} instead of mm)' if unit else ''
    return Finding(
        Kind.MIXED_UNITS,
        f'{len(ids)} targets, {first_few(ids)}, are in a different unit from the others',
        Place(target_id=tuple(ids.tolist()), name='phantom'),
        f'they fit when their coordinates are multiplied by {factor:.4g}{remark}',
        numbers={'factor': factor},
    )
