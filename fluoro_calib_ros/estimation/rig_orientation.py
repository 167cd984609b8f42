# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Orientation of the fluoroscopes of a rig, from a capture of the phantom or from exposures.

Interior orientations and corrections are fixed at their calibrations, so that rays and corrected
image points are consistent. The uncertainty of the interior orientation is propagated; it is not
estimated again. Let N be the normal matrix of the adjustment of exteriors e and object points,
with the interiors i as further unknowns. Then

    de/di = -N_ee^-1 N_ei (object points eliminated),
    C_e = N_ee^-1 + de/di C_i (de/di)^T,   C_ei = de/di C_i,

is the covariance of an estimate with parameters that are fixed, but not known (consider parameters
of Schmidt: Bierman, "Factorization Methods for Discrete Sequential Estimation", Academic Press
1977, ch. VIII). An error of the principal distance moves the source, but hardly the points that
are intersected afterwards; C_ei describes this.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from ..correction.fluoroscope_calibration import Calibrations
from ..errors import DataError
from ..exposures.collector import displacement
from ..exposures.frame import Frame, Frames, angles_of, validate_frame
from ..exposures.phantom import Phantom
from ..photogrammetry.adjustment import Adjustment
from ..photogrammetry.collinearity import to_sensor
from ..photogrammetry.elimination import factorize
from ..photogrammetry.noise import CERTAIN
from ..photogrammetry.plane_resection import orients
from ..photogrammetry.precision import (
    covariance_blocks,
    covariance_of_exteriors,
    equations_with_fixed_interiors,
)
from ..photogrammetry.rig_orientation import ORIENTATION_SIZE, RigOrientation, with_datum_of_points
from ..photogrammetry.rotations import matrix_from_quaternion, nearest_rotation
from ..photogrammetry.threads import one_thread
from ..photogrammetry.unknowns import (
    RIGID_SD_MM,
    RIGID_SD_RAD,
    RelativeConstraint,
    RelativePose,
    relative_poses,
)
from .constraints import derivatives_of_pairs, mean_of_pairs, paired_exposures
from .fixed_calibration import (
    fixed_corrections,
    network_of_calibrations,
    noise_of_calibrations,
    too_few_rays_for_noise,
)
from .initial_network import (
    MIN_TARGETS_OF_EXPOSURE,
    Known,
    Measured,
    StartValues,
    adjusted_with_precision,
)
from .pair_scatter import PairScatter, agreeing, displacements, functions_of_angles
from .result import FluoroscopeResult

# Orientation of a rig whose fluoroscopes were calibrated with known orientations.

FRAME_ID = 'lab'


def orientation_of_known(
    known: Known, figures: Mapping[str, FluoroscopeResult], calibrations: Calibrations
) -> RigOrientation:
    """Return the orientation of the rig in the frame of the known orientations.

    It is the mean of the adjusted orientations of the exposures, which equal the known orientation
    if that is fixed, and else are adjusted with it as a weighted observation. Its standard
    deviations are the given ones: an error of a known orientation is the same in all exposures.
    """
    names = tuple(figures)
    rotations = np.array([_mean_rotation(figures[name]) for name in names])
    positions = np.array(
        [np.mean([e.position_mm for e in figures[name].exposures], axis=0) for name in names]
    )
    blocks = []
    for name in names:
        sd_mm, sd_rad = known[name].exterior_sd or (RIGID_SD_MM, RIGID_SD_RAD)
        blocks.append(np.diag(np.repeat([sd_mm**2, sd_rad**2], 3)))
        blocks.append(calibrations[name].interior_covariance)
    used = {name: calibrations[name] for name in names}
    origin = _Origin(
        FRAME_ID,
        'capture',
        max(calibration.stamp_ns for calibration in used.values()),
        min(calibration.exposures for calibration in used.values()),
    )
    return _with_origin(origin, used, (rotations, positions), block_diag(*blocks))


def _mean_rotation(figures: FluoroscopeResult) -> NDArray[np.float64]:
    """Return the mean rotation (3, 3) of exposures: the nearest to the sum of their matrices."""
    total = matrix_from_quaternion([e.quaternion_wxyz for e in figures.exposures]).sum(axis=0)
    return nearest_rotation(total)


# Most exposures used: with more, the interior orientations dominate the uncertainty.
MAX_PAIRS = 30
# The phantom moves if the median displacement between two frames of a capture exceeds this limit
# [px], and CERTAIN standard deviations of the noise.
MAX_STILL_PX = 1.0
MAX_MATCH_SD = 5.0  # distance from the median of a target above which a match is false


@dataclass(frozen=True)
class _FixedAdjustment:
    """An adjustment of m exposures with the calibrations of F fluoroscopes fixed."""

    measured: Measured
    after: Adjustment
    #: (6m, 3F) derivatives de/di of the exteriors by the interiors
    by_interior: NDArray[np.float64]
    covariance: NDArray[np.float64]  #: (6m, 6m) of the exteriors, for known interiors
    interiors: NDArray[np.float64]  #: (3F, 3F) covariance of the interiors


@dataclass(frozen=True)
class _Exteriors:
    """Exterior orientations of F fluoroscopes in the frame of a rig."""

    rotation: NDArray[np.float64]  #: (F, 3, 3)
    position_mm: NDArray[np.float64]  #: (F, 3)
    covariance: NDArray[np.float64]  #: (6F, 6F), for known interiors
    by_interior: NDArray[np.float64]  #: (6F, 3F) derivatives by the interiors


@dataclass(frozen=True)
class _Origin:
    """Origin of an orientation; see `RigOrientation`."""

    frame_id: str
    source: str
    stamp_ns: int
    exposures: int


def orientation_of_capture(
    frames: Frames,
    phantom: Phantom,
    calibrations: Calibrations,
    frame_id: str = 'rig',
) -> RigOrientation:
    """Estimate the orientation from a capture of the phantom at rest, in the phantom's frame.

    The object points are estimated too, with their survey as weighted observations.

    Parameters
    ----------
    frames : mapping of str to sequence of Frame
        One or more frames of every fluoroscope; they need not be paired.
    phantom : Phantom
        The phantom, with the survey of its targets.
    calibrations : mapping of str to FluoroscopeCalibration
        Fixed calibrations.
    frame_id : str
        Name of the rig frame.

    Raises
    ------
    DataError
        If there are fewer than two fluoroscopes, calibrations are missing, frames are invalid or
        of another image size, there are too few targets, or the phantom moves.
    """
    _validate(frames, phantom, calibrations)
    standing = {name: [frame] for name, frame in standing_frames(frames, calibrations).items()}
    for name, (frame,) in standing.items():
        if len(frame.target_id) < MIN_TARGETS_OF_EXPOSURE:
            raise DataError(
                f'fluoroscope {name}: the capture shows {len(frame.target_id)} targets of the '
                f'phantom, {MIN_TARGETS_OF_EXPOSURE} are needed'
            )
    with one_thread():
        measured = network_of_calibrations(standing, phantom, calibrations)
        fixed = _adjusted(measured, calibrations, True)
    parameters = fixed.after.parameters
    exteriors = _Exteriors(
        parameters.rotation, parameters.position_mm, fixed.covariance, fixed.by_interior
    )
    exposures = min(len(captured) for captured in frames.values())
    origin = _Origin(frame_id, 'capture', _last_stamp(frames), exposures)
    return _orientation(fixed, exteriors, calibrations, origin)


def orientation_and_scatter(
    frames: Frames,
    phantom: Phantom,
    calibrations: Calibrations,
    starts: StartValues | None = None,
) -> tuple[RigOrientation, tuple[PairScatter, ...]]:
    """Estimate the orientation in the optical frame of the first fluoroscope, from exposures.

    The relative orientation is the weighted mean over the exposures; a few exposures that
    contradict the others are excluded. If the exposures scatter more than their standard
    deviations, the covariance is enlarged accordingly. The frame is the estimated frame of the
    sensor; the covariance gets a datum at the place of the phantom (`with_datum_of_points`).

    frames: of the phantom; those with the same number belong together. calibrations: fixed.
    starts: initial values from an earlier adjustment of the frames. Also returns the scatter of
    the exposures about the orientation, a PairScatter for every fluoroscope but the first. Raises
    DataError as `orientation_of_capture`, and if no exposures can be paired.
    """
    _validate(frames, phantom, calibrations)
    paired = _paired(_orienting(frames, phantom))
    with one_thread():
        measured = network_of_calibrations(paired, phantom, calibrations, starts=starts)
        fixed = _adjusted(measured, calibrations, False)
        turning = {
            name
            for name, calibration in calibrations.items()
            if calibration.angle_field is not None
        }
        exteriors, scatter = _relative_to_first(fixed, turning)
    first = fixed.measured.fluoroscopes[0]
    frame_id = calibrations[first].frame_id or f'{first}_optical'
    exposures = min(int(pair.used.sum()) for pair in scatter)
    origin = _Origin(frame_id, 'joint calibration', _last_stamp(paired), exposures)
    orientation = _orientation(fixed, exteriors, calibrations, origin)
    try:
        return with_datum_of_points(orientation, _seen_by_first(fixed)), scatter
    except np.linalg.LinAlgError:
        raise DataError(
            'the sources of the fluoroscopes coincide, so their rays do not intersect'
        ) from None


def _relative_to_first(
    fixed: _FixedAdjustment, turning: Collection[str]
) -> tuple[_Exteriors, tuple[PairScatter, ...]]:
    """Return exteriors relative to the first fluoroscope, and the scatter of paired exposures.

    turning: names of the fluoroscopes whose corrections change with the angle of a C-arm. Raises
    DataError if no exposures can be paired.
    """
    names = fixed.measured.fluoroscopes
    count = len(names)
    rotation = np.tile(np.eye(3), (count, 1, 1))
    position = np.zeros((count, 3))
    operator = np.zeros((6 * count, 6 * len(fixed.measured.frames)))
    growth = np.ones(6 * count)
    scatter = []
    for b in range(1, count):
        pairs = paired_exposures(fixed.measured, b)
        if not len(pairs):
            raise DataError(_unpaired(names, b))
        rows = slice(6 * b, 6 * b + 6)
        corrected = names[0] in turning or names[b] in turning
        pose, operator[rows], pair_scatter = _mean_and_scatter(fixed, pairs, corrected)
        growth[rows] = pair_scatter.growth
        rotation[b] = pose.rotation
        position[b] = pose.translation_mm
        scatter.append(pair_scatter)
    known = growth[:, None] * (operator @ fixed.covariance @ operator.T) * growth
    by_interior = operator @ fixed.by_interior
    return _Exteriors(rotation, position, known, by_interior), tuple(scatter)


def _seen_by_first(fixed: _FixedAdjustment) -> NDArray[np.float64]:
    """Return object points (n, 3) [mm] that the first fluoroscope sees, in its sensor frame."""
    network = fixed.measured.network
    parameters = fixed.after.parameters
    rows = network.rows(0)
    exposure = network.exposure[rows]
    points = parameters.points_mm[network.point[rows]]
    return to_sensor(parameters.rotation[exposure], parameters.position_mm[exposure], points)


def _validate(frames: Frames, phantom: Phantom, calibrations: Calibrations) -> None:
    """Raise DataError if frames and calibrations do not belong together."""
    if len(frames) < 2:
        raise DataError(
            'a rig needs two fluoroscopes or more, there are frames of '
            f'{", ".join(frames) or "none"} only'
        )
    for name, exposures in frames.items():
        if name not in calibrations:
            raise DataError(
                f'there is no calibration of fluoroscope {name}, only of {", ".join(calibrations)}'
            )
        if not exposures:
            raise DataError(f'fluoroscope {name}: there is no frame of the phantom')
        for frame in exposures:
            validate_frame(frame, phantom, calibrations[name].image_size)


def _last_stamp(frames: Frames) -> int:
    return max(frame.stamp_ns for exposures in frames.values() for frame in exposures)


def standing_frames(frames: Frames, calibrations: Calibrations) -> dict[str, Frame]:
    """Return one frame by fluoroscope of a capture of the phantom at rest.

    Its image points are weighted means over the frames, for every target. An image point that is
    far from the median of its target is a false match and excluded. Raises DataError if the
    phantom moves.
    """
    return {
        name: _mean_frame(exposures, calibrations[name].image_sd)
        for name, exposures in frames.items()
    }


def _mean_frame(frames: Sequence[Frame], image_sd: float) -> Frame:
    """Average the frames of a fluoroscope; image_sd: noise of an image coordinate [px]."""
    if len(frames) == 1:
        return frames[0]
    _require_still(frames, max(MAX_STILL_PX, CERTAIN * image_sd))
    ids, row = np.unique(np.concatenate([f.target_id for f in frames]), return_inverse=True)
    uv = np.concatenate([f.uv for f in frames])
    sigma = np.concatenate(
        [np.ones(len(f.target_id)) if f.sigma is None else f.sigma for f in frames]
    )
    order = np.argsort(row, kind='stable')
    ends = np.cumsum(np.bincount(row))[:-1]
    middle = np.array([np.median(uv[part], axis=0) for part in np.split(order, ends)])
    offset = uv - middle[row]
    limit = max(MAX_STILL_PX, MAX_MATCH_SD * image_sd)
    weight = np.where(np.linalg.norm(offset, axis=1) <= limit, sigma**-2.0, 0.0)
    total = np.bincount(row, weight, len(ids))
    matched = total > 0
    sums = np.column_stack([np.bincount(row, weight * offset[:, i], len(ids)) for i in (0, 1)])
    mean = sums[matched] / total[matched, None]
    last = max(frames, key=lambda f: (f.stamp_ns, f.number))
    return Frame(
        fluoroscope=last.fluoroscope,
        number=last.number,
        target_id=ids[matched],
        uv=middle[matched] + mean,
        image_size=last.image_size,
        sigma=np.asarray(total[matched] ** -0.5, dtype=np.float64),
        stamp_ns=last.stamp_ns,
        frame_id=last.frame_id,
        angle=last.angle,
    )


def _require_still(frames: Sequence[Frame], still_px: float) -> None:
    """Raise DataError if the phantom moves by more than still_px between frames.

    Every frame is compared with the previous frame, and with the first.
    """
    to_first = ((frames[0], frame) for frame in frames[2:])
    for before, frame in [*pairwise(frames), *to_first]:
        distance = displacement(before, frame)
        if np.isfinite(distance) and distance > still_px:
            raise DataError(
                f'fluoroscope {frame.fluoroscope}: the phantom does not stand still, between '
                f'frames {before.number} and {frame.number} it moves by {distance:.1f} px'
            )


def _spread(numbers: set[int], count: int) -> set[int]:
    """Return at most `count` of the numbers, evenly spread."""
    ordered = sorted(numbers)
    count = min(count, len(ordered))
    return {ordered[i] for i in np.linspace(0, len(ordered) - 1, count).astype(int)}


def _orienting(frames: Frames, phantom: Phantom) -> dict[str, list[Frame]]:
    """Return the frames that can show the orientation of the rig."""
    xyz = phantom.xyz_mm
    return {
        name: [f for f in exposures if orients(xyz[phantom.index(f.target_id)], xyz)]
        for name, exposures in frames.items()
    }


def _paired(frames: Frames) -> dict[str, list[Frame]]:
    """Return frames that the first fluoroscope shares with another, at most MAX_PAIRS each.

    Raises DataError if a fluoroscope shares no frames with the first.
    """
    first, *others = frames
    numbers = {name: {frame.number for frame in exposures} for name, exposures in frames.items()}
    for b, name in enumerate(others, 1):
        if not numbers[name] & numbers[first]:
            raise DataError(_unpaired(tuple(frames), b))
    # Exposures of all fluoroscopes are preferred; others are spread evenly over each pair.
    shared = {name: numbers[name] & numbers[first] for name in others}
    complete = set.intersection(*shared.values())
    selected = _spread(complete, MAX_PAIRS)
    missing = MAX_PAIRS - len(selected)
    for both in shared.values():
        selected |= _spread(both - complete, missing)
    return {
        name: [frame for frame in exposures if frame.number in selected]
        for name, exposures in frames.items()
    }


def _unpaired(names: Sequence[str], b: int) -> str:
    """Return the message on fluoroscopes without paired exposures."""
    return (
        f'fluoroscopes {names[0]} and {names[b]}: no exposures have the same number, so their '
        'relative orientation is unknown'
    )


def _adjusted(
    measured: Measured, calibrations: Calibrations, noise_fixed: bool
) -> _FixedAdjustment:
    """Adjust a network with the calibrations fixed.

    noise_fixed: use the noise of the calibrations; otherwise it is used only if there are too few
    exposures to estimate it. Raises DataError.
    """
    known = [calibrations[name] for name in measured.fluoroscopes]
    correction, network = fixed_corrections(measured, calibrations)
    after, _ = adjusted_with_precision(
        network,
        measured.start,
        correction,
        noise_of_calibrations('student_t', known),
        noise_fixed=noise_fixed or too_few_rays_for_noise(network),
    )
    if not np.isfinite(after.parameters.position_mm).all():
        raise DataError('the exposures do not determine the orientation of the fluoroscopes')
    # With standard deviations of 1 px, the normal matrix of the interiors can be inverted even if
    # one pose of the phantom does not determine them. The derivative does not depend on them.
    unit = np.tile(np.eye(3), (len(known), 1, 1))
    free, equations = equations_with_fixed_interiors(network, after, correction, unit)
    blocks = covariance_blocks(factorize(free, equations))
    by_interior = blocks.eg.reshape(-1, len(blocks.gg)) @ np.linalg.inv(blocks.gg)
    covariance = covariance_of_exteriors(blocks) - by_interior @ blocks.gg @ by_interior.T
    interior_covariance = block_diag(*(calibration.interior_covariance for calibration in known))
    return _FixedAdjustment(measured, after, by_interior, covariance, interior_covariance)


def _mean_and_scatter(
    fixed: _FixedAdjustment, pairs: NDArray[np.int64], corrected: bool
) -> tuple[RelativePose, NDArray[np.float64], PairScatter]:
    """Return the weighted mean of the relative orientations of pairs (k, 2) of exposures.

    corrected: whether a correction changes with the angle of a C-arm. Returns the mean, its
    derivatives (6, 6m) by the exposures, and the scatter of the pairs about it.
    """
    parameters = fixed.after.parameters
    frames = fixed.measured.frames
    pairs = pairs[np.argsort([frames[row].number for row in pairs[:, 0]], kind='stable')]
    angles = [angles_of(frames[row] for row in rows) for rows in pairs.T]
    constraint = RelativeConstraint((0, 1), pairs, 1.0, 1.0)
    derivatives = derivatives_of_pairs(parameters, pairs)
    weights = np.linalg.inv(derivatives @ fixed.covariance @ derivatives.transpose(0, 2, 1))
    columns = functions_of_angles(angles)
    agreement = agreeing(parameters, constraint, weights, columns)
    used = agreement.used
    pose, operator = mean_of_pairs(parameters, pairs[used], derivatives[used], weights[used])
    poses = [pose.updated(step) for step in agreement.trend]
    network = fixed.measured.network
    by_angle = displacements(network, parameters, pairs, poses, [pose] * len(poses))
    turn, shift = relative_poses(parameters, pairs)
    scatter = PairScatter(
        fluoroscopes=(frames[pairs[0, 0]].fluoroscope, frames[pairs[0, 1]].fluoroscope),
        exposures=np.array([frames[row].number for row in pairs[:, 0]]),
        off_px=displacements(network, parameters, pairs, poses),
        off_sd=agreement.off_sd,
        used=used,
        growth=agreement.growth,
        unexplained=agreement.unexplained,
        angle_px=float(np.sqrt(np.mean(by_angle**2))),
        columns=columns,
        corrected=corrected,
        turn=turn,
        shift_mm=shift,
    )
    return pose, operator, scatter


def _orientation(
    fixed: _FixedAdjustment, exteriors: _Exteriors, calibrations: Calibrations, origin: _Origin
) -> RigOrientation:
    """Return the rig orientation of exteriors, with the uncertainty of the interiors."""
    names = fixed.measured.fluoroscopes
    by_interior = exteriors.by_interior
    mixed = by_interior @ fixed.interiors
    total = exteriors.covariance + mixed @ by_interior.T
    joint = np.block([[total, mixed], [mixed.T, fixed.interiors]])
    count = len(names)
    order = np.concatenate(
        [np.r_[6 * f : 6 * f + 6, 6 * count + 3 * f : 6 * count + 3 * f + 3] for f in range(count)]
    )
    covariance = joint[np.ix_(order, order)].reshape(ORIENTATION_SIZE * count, -1)
    pose = exteriors.rotation, exteriors.position_mm
    used = {name: calibrations[name] for name in names}
    return _with_origin(origin, used, pose, (covariance + covariance.T) / 2)


def _with_origin(
    origin: _Origin,
    calibrations: Calibrations,
    pose: tuple[NDArray[np.float64], NDArray[np.float64]],
    covariance: NDArray[np.float64],
) -> RigOrientation:
    """Return the orientation of calibrated fluoroscopes; pose: rotations, positions [mm]."""
    rotation, position_mm = pose
    known = list(calibrations.values())
    return RigOrientation(
        fluoroscopes=tuple(calibrations),
        interior=np.array([calibration.interior for calibration in known]),
        rotation=rotation,
        position_mm=position_mm,
        covariance=covariance,
        calibration_ids=tuple(calibration.calibration_id for calibration in known),
        optical_frame_ids=tuple(
            c.frame_id or f'{name}_optical' for name, c in calibrations.items()
        ),
        **vars(origin),
    ).rounded()
