# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Constraints of a self-calibration, and the relative orientations that it estimates.

Constraints are relative orientations of the fluoroscopes, interior orientations known beforehand,
and the datum.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..errors import DataError
from ..exposures.frame import Frame, Frames
from ..findings import Finding, Kind, Place, Severity, first_few
from ..photogrammetry.network import MIN_RAYS
from ..photogrammetry.plane_resection import orients
from ..photogrammetry.precision import covariance_of_exteriors
from ..photogrammetry.unknowns import (
    RIGID_SD_MM,
    RIGID_SD_RAD,
    Parameters,
    RelativeConstraint,
    RelativePose,
    discrepancies,
    discrepancies_with_jacobian,
    mean_pose,
)
from .estimator import GaugeKind
from .initial_network import Measured
from .options import CalibrationOptions
from .rounds import SelfCalibration

MIN_COMMON = 4  # targets that orient an exposure; three do so in several ways
MIN_PAIRS = 2  # pairs of exposures that a constraint of the relative orientation needs


@dataclass(frozen=True)
class RelativeOrientation:
    """Relative orientation of two fluoroscopes."""

    fluoroscopes: tuple[str, str]  #: names of fluoroscopes a and b
    pose: RelativePose  #: Q = R_b R_a^T and t = R_a (T_b - T_a) [mm]
    #: (6, 6) covariance of t [mm], and of Q [rad] about the axes of the sensor of b
    covariance: NDArray[np.float64]
    #: (3,) standard deviations of single exposures about the pose
    scatter_mm: NDArray[np.float64]
    scatter_rad: NDArray[np.float64]
    exposures: int  #: number of pairs of exposures
    constraint: str  #: 'none', 'soft' or 'hard'

    @property
    def sd_mm(self) -> NDArray[np.float64]:
        """Standard deviations (3,) of the translation [mm]."""
        return np.sqrt(np.diagonal(self.covariance)[:3])

    @property
    def sd_rad(self) -> NDArray[np.float64]:
        """Standard deviations (3,) of the rotation [rad]."""
        return np.sqrt(np.diagonal(self.covariance)[3:])


def paired_exposures(measured: Measured, b: int) -> NDArray[np.int64]:
    """Return the rows (k, 2) of exposures of fluoroscopes 0 and b that orient the rig.

    They have the same number and `orients` holds.
    """
    network = measured.network
    row = {
        (int(f), frame.number): j
        for j, (f, frame) in enumerate(zip(network.fluoroscope, measured.frames))
        if orients(network.survey_mm[network.point[network.exposure == j]], network.survey_mm)
    }
    pairs = [
        (row[0, number], j) for (f, number), j in row.items() if f == b and (0, number) in row
    ]
    return np.array(pairs, dtype=int).reshape(-1, 2)


def interiors_to_estimate(measured: Measured, options: CalibrationOptions) -> NDArray[np.bool_]:
    """Return whether (F,) the interior orientation of each fluoroscope is estimated.

    It is fixed where it is known without a standard deviation, and where flat targets parallel to
    the image do not determine it.
    """
    estimated = options.interior == 'estimated'
    out = np.full(len(measured.fluoroscopes), estimated)
    for f, name in enumerate(measured.fluoroscopes):
        if name in measured.known:
            out[f] = measured.known[name].interior_sd is not None
        elif _is_untilted(measured, f):
            out[f] = estimated and options.interior_sd is not None
    return out


def gauges_of(measured: Measured, options: CalibrationOptions) -> tuple[GaugeKind, ...]:
    """Return which changes the orientation of each fluoroscope can absorb.

    With targets parallel to the image, the exterior orientations can absorb any shift and scale,
    even if the interior orientation is fixed.
    """
    fixed = GaugeKind.TURNS if options.interior == 'fixed' else GaugeKind.FULL
    return tuple(
        GaugeKind.NONE
        if name in measured.known
        else GaugeKind.TREND
        if _is_untilted(measured, f)
        else fixed
        for f, name in enumerate(measured.fluoroscopes)
    )


def _is_untilted(measured: Measured, f: int) -> bool:
    return bool(measured.untilted) and measured.untilted[f]


def _interior_sd(measured: Measured, options: CalibrationOptions) -> NDArray[np.float64] | None:
    """Return the standard deviations (F, 3) [px] of the initial interior orientations.

    None if all are unknown.
    """
    sd = np.full((len(measured.fluoroscopes), 3), np.inf)
    if options.interior_sd is not None:
        sd[:] = options.interior_sd
    for f, name in enumerate(measured.fluoroscopes):
        known = measured.known.get(name)
        if known is not None:
            sd[f] = np.inf if known.interior_sd is None else known.interior_sd
    return sd if np.isfinite(sd).any() else None


def with_constraints(measured: Measured, options: CalibrationOptions) -> Measured:
    """Return a network with the constraints and the datum of the options.

    Raises DataError if no exposures can be paired.
    """
    if options.datum == 'inner':
        measured = _without_targets_of_few_rays(measured)
    network = replace(measured.network, datum=options.datum, relative=())
    start = replace(measured.start, relative=())
    sd = _interior_sd(measured, options)
    if sd is not None:
        network = replace(network, interior_mean=start.interior, interior_sd=sd)
    if options.relative_orientation != 'none':
        constraints = _relative_constraints(measured, options)
        start = replace(start, relative=tuple(mean_pose(start, c.pairs) for c in constraints))
        if options.datum == 'inner':
            constraints = tuple(
                replace(c, length_mm=float(np.linalg.norm(pose.translation_mm)))
                for c, pose in zip(constraints, start.relative)
            )
        network = replace(network, relative=constraints)
    return replace(measured, network=network, start=start)


def _relative_constraints(
    measured: Measured, options: CalibrationOptions
) -> tuple[RelativeConstraint, ...]:
    """Return the constraints of every other fluoroscope with the first. Raises DataError."""
    first, *others = measured.fluoroscopes
    if not others:
        raise DataError(
            'a relative orientation needs two fluoroscopes in one adjustment, there is only '
            f'{first}'
        )
    soft = options.relative_orientation == 'soft'
    sd_mm, sd_rad = options.relative_sd if soft else (RIGID_SD_MM, RIGID_SD_RAD)
    out = []
    for b, name in enumerate(others, 1):
        pairs = paired_exposures(measured, b)
        if len(pairs) < MIN_PAIRS:
            raise DataError(
                f'fluoroscopes {first} and {name}: {len(pairs)} exposures have the same number, '
                f'{MIN_PAIRS} are needed for a relative orientation constraint'
            )
        out.append(RelativeConstraint((0, b), pairs, sd_mm, sd_rad))
    return tuple(out)


def connected_frames(frames: Frames) -> tuple[dict[str, list[Frame]], tuple[Finding, ...]]:
    """Return the largest group of frames that common targets connect, and findings on the others.

    A free network has no other relation between exposures. Targets with fewer than MIN_RAYS image
    points connect none.
    """
    entries = [frame for exposures in frames.values() for frame in exposures]
    ids, rays = np.unique(
        np.concatenate([frame.target_id for frame in entries]), return_counts=True
    )
    remaining = [
        (frame, frame.target_id[np.isin(frame.target_id, ids[rays >= MIN_RAYS])])
        for frame in entries
    ]
    largest: list[Frame] = []
    while len(remaining) > len(largest):
        seed = max(remaining, key=lambda entry: len(entry[1]))
        group, seen = [], seed[1]
        while joining := [e for e in remaining if np.isin(e[1], seen).sum() >= MIN_COMMON]:
            group += [frame for frame, _ in joining]
            seen = np.unique(np.concatenate([seen, *(targets for _, targets in joining)]))
            remaining = [entry for entry in remaining if not any(entry is e for e in joining)]
        if not group:
            break
        largest = max(largest, group, key=len)
    if not largest:
        return {name: list(exposures) for name, exposures in frames.items()}, ()
    kept = {id(frame) for frame in largest}
    excluded = [
        Finding(
            Kind.FEW_TARGETS,
            f'fewer than {MIN_COMMON} of its targets are seen in the other exposures, which '
            'without surveyed coordinates does not orient it',
            frame.place,
            severity=Severity.NOTE,
            numbers={'targets': len(frame.target_id), 'needed': MIN_COMMON},
        )
        for frame in entries
        if id(frame) not in kept
    ]
    connected = {
        name: [frame for frame in exposures if id(frame) in kept]
        for name, exposures in frames.items()
    }
    return connected, tuple(excluded)


def _without_targets_of_few_rays(measured: Measured) -> Measured:
    """Return the network without targets that have fewer than MIN_RAYS image points."""
    network = measured.network
    rays = np.bincount(network.point, minlength=network.n_points)
    few = rays < MIN_RAYS
    if not few.any():
        return measured
    selected = ~few[network.point]
    row = np.cumsum(~few) - 1
    if not selected.any():
        raise DataError(
            'no target is seen in three exposures: without surveyed coordinates none is determined'
        )
    network = replace(
        network,
        uv=network.uv[selected],
        sigma=network.sigma[selected],
        exposure=network.exposure[selected],
        point=row[network.point[selected]],
        survey_mm=network.survey_mm[~few],
        survey_sd_mm=network.survey_sd_mm[~few],
    )
    excluded = Finding(
        Kind.FEW_RAYS,
        f'{few.sum()} targets are seen in fewer than {MIN_RAYS} exposures, too few to determine '
        f'them without surveyed coordinates: {first_few(measured.target_id[few])}',
        Place(target_id=tuple(measured.target_id[few].tolist())),
        severity=Severity.NOTE,
    )
    return replace(
        measured,
        network=network,
        target_id=measured.target_id[~few],
        start=replace(measured.start, points_mm=measured.start.points_mm[~few]),
        excluded=(*measured.excluded, excluded),
    )


def relative_orientations(
    run: SelfCalibration, constraint: str
) -> tuple[RelativeOrientation, ...]:
    """Return the relative orientation of every other fluoroscope to the first.

    Without a constraint, fluoroscopes that share no exposures with the first are skipped, and the
    result is the weighted mean of the exposures. constraint: that of the CalibrationOptions.
    """
    measured = run.measured
    parameters = run.after.parameters
    out = []
    for b in range(1, len(measured.fluoroscopes)):
        names = (measured.fluoroscopes[0], measured.fluoroscopes[b])
        if constraint == 'none':
            pairs = paired_exposures(measured, b)
            if not len(pairs):
                continue
            pose, covariance = _mean_of_run(run, pairs)
        else:
            pairs = measured.network.relative[b - 1].pairs
            pose = parameters.relative[b - 1]
            covariance = run.precision.relative[b - 1]
        deviations = discrepancies(RelativeConstraint((0, b), pairs, 1.0, 1.0), pose, parameters)
        scatter = np.sqrt(np.sum(deviations**2, axis=0) / max(len(deviations) - 1, 1))
        out.append(
            RelativeOrientation(
                names,
                pose,
                covariance=covariance,
                scatter_mm=scatter[:3],
                scatter_rad=scatter[3:],
                exposures=len(pairs),
                constraint=constraint,
            )
        )
    return tuple(out)


def _mean_of_run(
    run: SelfCalibration, pairs: NDArray[np.int64]
) -> tuple[RelativePose, NDArray[np.float64]]:
    """Return the weighted mean of relative orientations of pairs (k, 2), and covariance (6, 6).

    The exposures are correlated through interior orientation and object points, so the covariances
    between pairs are included.
    """
    parameters = run.after.parameters
    covariance = covariance_of_exteriors(run.solved.blocks())
    derivatives = derivatives_of_pairs(parameters, pairs)
    weights = np.linalg.inv(derivatives @ covariance @ derivatives.transpose(0, 2, 1))
    pose, operator = mean_of_pairs(parameters, pairs, derivatives, weights)
    return pose, operator @ covariance @ operator.T


def derivatives_of_pairs(parameters: Parameters, pairs: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return derivatives (k, 6, 6m) of relative orientations of pairs (k, 2) by m exposures."""
    constraint = RelativeConstraint((0, 1), pairs, 1.0, 1.0)
    start = mean_pose(parameters, pairs)
    _, d_a, d_b, _ = discrepancies_with_jacobian(constraint, start, parameters)
    count = np.arange(len(pairs))
    out = np.zeros((len(pairs), 6, len(parameters.rotation), 6))
    out[count, :, pairs[:, 0]] = d_a
    out[count, :, pairs[:, 1]] = d_b
    return out.reshape(len(pairs), 6, -1)


def mean_of_pairs(
    parameters: Parameters,
    pairs: NDArray[np.int64],
    derivatives: NDArray[np.float64],
    weights: NDArray[np.float64],
) -> tuple[RelativePose, NDArray[np.float64]]:
    """Return the mean of relative orientations of pairs (k, 2) with weights (k, 6, 6).

    derivatives: see `derivatives_of_pairs`. Also returns those (6, 6m) of the mean.
    """
    operator = np.linalg.solve(weights.sum(axis=0), (weights @ derivatives).sum(axis=0))
    return mean_pose(parameters, pairs, weights), operator
