"""Where the fluoroscopes of a rig stand: from a capture of the phantom, or from the exposures of a
calibration.

Interior orientations and corrections are held at their calibrations, so that rays and corrected
image points belong together; what is uncertain in the interior orientation is carried on, not
estimated again. With N the normal matrix of the adjustment of exteriors e and object points, were
the interiors i free beside them,

    de/di = -N_ee^-1 N_ei (object points eliminated),   C_e = N_ee^-1 + de/di C_i (de/di)^T,   C_ei
    = de/di C_i,

the covariance of an estimate with parameters that are held, but not known (Schmidt's consider
parameters: Bierman, "Factorization Methods for Discrete Sequential Estimation", Academic Press
1977, ch. VIII). An error of the principal distance moves the source, and the points that are
intersected afterwards hardly: that is in C_ei.
"""

from dataclasses import dataclass, replace

import numpy as np
from threadpoolctl import threadpool_limits

from ..errors import DataError
from ..exposures.collector import displacement
from ..exposures.frame import Frame, validate_frame
from ..exposures.phantom import Phantom
from ..photogrammetry.adjustment import Adjustment
from ..photogrammetry.collinearity import to_sensor
from ..photogrammetry.elimination import factorize
from ..photogrammetry.normal_equations import normal_equations
from ..photogrammetry.precision import covariance_blocks
from ..photogrammetry.relative_orientation import (
    RelativeConstraint,
    discrepancies,
    discrepancies_with_jacobian,
    mean_pose,
)
from ..photogrammetry.rig_orientation import ORIENTATION_SIZE, RigOrientation, with_datum_of_points
from .calibrate import SEEN_FOR_NOISE, held_corrections
from .constraints import paired_exposures
from .initial_network import MIN_TARGETS_OF_EXPOSURE, Measured, measured_network
from .robust_adjustment import adjusted_with_precision, start_noise

# exposures that are used: more tell no more, the interior orientations are what is uncertain then
MAX_PAIRS = 30
# Median displacement between two frames of a capture from which the phantom does not stand still:
# further than both, pixels and standard deviations of the noise; and distance from the median of a
# target at which a match is false.
STILL_PX = 1.0
STILL_SD = 4.0
FALSE_SD = 5.0
# Of the interior orientations where they are added as unknowns, so that their normal matrix can be
# inverted also where one pose of the phantom does not determine them; the derivative de/di does
# not depend on it.
ASSUMED_SD_PX = 1.0


@dataclass(frozen=True)
class _Held:
    """An adjustment with calibrations held: exteriors (m, 6, 3F): their derivatives by the
    interiors (de/di); covariance(e, f): (k, 6, 6) of exposures e (k,) with others f (k,), the
    interiors taken as known; interiors (3F, 3F): covariance of these.
    """

    measured: Measured
    after: Adjustment
    by_interior: np.ndarray
    covariance: object
    interiors: np.ndarray


def orientation_of_capture(
    frames, phantom, calibrations, frame_id='rig', loss='student_t', raise_if_cancelled=None
):
    """RigOrientation from a capture of the phantom standing still: the frame of the phantom is
    that of the rig.

    frames {fluoroscope: [Frame, ...]}: one or several of every fluoroscope, they need not be
    paired; phantom: survey of its targets, or a Phantom of the better known object points of a
    calibration; calibrations {fluoroscope: FluoroscopeCalibration}, held; raise_if_cancelled():
    called during the adjustment, may raise to stop it. The object points are estimated along, with
    their survey as weighted observations. Raises DataError for fewer than two fluoroscopes,
    missing calibrations, wrong frames, other image sizes, too few targets, and a phantom that
    moves.
    """
    _check(frames, phantom, calibrations)
    standing = {name: [frame] for name, frame in standing_frames(frames, calibrations).items()}
    for name, (frame,) in standing.items():
        if len(frame.target_id) < MIN_TARGETS_OF_EXPOSURE:
            raise DataError(
                f'fluoroscope {name}: the capture shows {len(frame.target_id)} targets of the phantom, '
                f'{MIN_TARGETS_OF_EXPOSURE} are needed'
            )
    with threadpool_limits(1):
        held = _adjusted(standing, phantom, calibrations, loss, True, raise_if_cancelled)
        count = len(frames)
        one, other = (index.ravel() for index in np.indices((count, count)))
        known = (
            held.covariance(one, other)
            .reshape(count, count, 6, 6)
            .transpose(0, 2, 1, 3)
            .reshape(6 * count, -1)
        )
    parameters = held.after.parameters
    return _orientation(
        held,
        parameters.rotation,
        parameters.position_mm,
        known,
        held.by_interior.reshape(6 * count, -1),
        calibrations,
        frame_id,
        'capture',
        _last_stamp(frames),
        min(len(of_one) for of_one in frames.values()),
    )


def orientation_of_exposures(
    frames, phantom, calibrations, loss='student_t', raise_if_cancelled=None
):
    """RigOrientation in the optical frame of the first fluoroscope, from the exposures that all
    took of the phantom.

    The frame is the sensor's as it was estimated, and its covariance is held to where the phantom
    stood (with_datum_of_points).

    frames {fluoroscope: [Frame, ...]}, those of the same number belong together; calibrations
    {fluoroscope: FluoroscopeCalibration}, held. The relative orientation is the weighted mean of
    those of the exposures; where they scatter by more than their standard deviations, its
    covariance grows accordingly. Raises DataError as orientation_of_capture, and where no
    exposures can be paired.
    """
    _check(frames, phantom, calibrations)
    paired = _paired(frames)
    with threadpool_limits(1):
        held = _adjusted(paired, phantom, calibrations, loss, False, raise_if_cancelled)
        count = len(frames)
        rotation = np.tile(np.eye(3), (count, 1, 1))
        position = np.zeros((count, 3))
        operator = np.zeros((6 * count, 6 * len(held.measured.frames)))
        growth = np.ones(6 * count)
        used = []
        for b in range(1, count):
            pairs = paired_exposures(held.measured, b)
            if not len(pairs):
                raise DataError(_unpaired(held.measured.fluoroscopes, b))
            rows = slice(6 * b, 6 * b + 6)
            pose, operator[rows], growth[rows] = _mean_of_pairs(held, pairs)
            rotation[b] = pose.rotation
            position[b] = pose.translation_mm
            used.append(len(pairs))
        known = growth[:, None] * (operator @ _all_exposures(held) @ operator.T) * growth
    by_interior = operator @ held.by_interior.reshape(operator.shape[1], -1)
    first = held.measured.fluoroscopes[0]
    found = _orientation(
        held,
        rotation,
        position,
        known,
        by_interior,
        calibrations,
        calibrations[first].frame_id or f'{first}_optical',
        'joint calibration',
        _last_stamp(paired),
        min(used),
    )
    return with_datum_of_points(found, _seen_by_first(held))


def _seen_by_first(held):
    """Object points (n, 3) [mm] of all image points of the first fluoroscope, in its sensor frame."""
    network = held.measured.network
    parameters = held.after.parameters
    rows = network.rows(0)
    exposure = network.exposure[rows]
    points = parameters.points_mm[network.point[rows]]
    return to_sensor(parameters.rotation[exposure], parameters.position_mm[exposure], points)


def phantom_of(targets):
    """Phantom of the object points of a calibration (Targets), better known than by their survey.

    The standard deviation of a target is the root mean square of those of its coordinates.
    """
    variance = np.trace(targets.covariance, axis1=1, axis2=2) / 3
    return Phantom(targets.target_id, targets.xyz_mm, np.sqrt(variance))


def _check(frames, phantom, calibrations):
    """Raise DataError for frames and calibrations that do not go together."""
    if len(frames) < 2:
        raise DataError(
            f'a rig has two fluoroscopes or more, there are frames of {", ".join(frames) or "none"} only'
        )
    for name, of_one in frames.items():
        if name not in calibrations:
            raise DataError(
                f'there is no calibration of fluoroscope {name}, only of {", ".join(calibrations)}'
            )
        if not of_one:
            raise DataError(f'fluoroscope {name}: there is no frame of the phantom')
        for frame in of_one:
            validate_frame(frame, phantom, calibrations[name].image_size)


def _last_stamp(frames):
    return max(frame.stamp_ns for of_one in frames.values() for frame in of_one)


def standing_frames(frames, calibrations):
    """{fluoroscope: Frame} of a capture {fluoroscope: [Frame, ...]} in which the phantom stands
    still: weighted means of the image points of every target. Raises DataError where the phantom
    moves.

    An image point that is far from the median of its target is a false match and left out.
    """
    return {
        name: _standing(of_one, calibrations[name].image_sd) for name, of_one in frames.items()
    }


def _standing(frames, image_sd):
    """One Frame of the frames (Frame, ...) of a fluoroscope; image_sd: noise of an image
    coordinate [px].
    """
    if len(frames) == 1:
        return frames[0]
    _refuse_motion(frames, max(STILL_PX, STILL_SD * image_sd))
    ids, row = np.unique(np.concatenate([f.target_id for f in frames]), return_inverse=True)
    uv = np.concatenate([f.uv for f in frames])
    sigma = np.concatenate(
        [np.ones(len(f.target_id)) if f.sigma is None else f.sigma for f in frames]
    )
    order = np.argsort(row, kind='stable')
    ends = np.cumsum(np.bincount(row))[:-1]
    middle = np.array([np.median(uv[part], axis=0) for part in np.split(order, ends)])
    off = uv - middle[row]
    weight = np.where(
        np.linalg.norm(off, axis=1) <= max(STILL_PX, FALSE_SD * image_sd), sigma**-2.0, 0.0
    )
    total = np.bincount(row, weight, len(ids))
    kept = total > 0
    mean = (
        np.column_stack([np.bincount(row, weight * off[:, i], len(ids)) for i in (0, 1)])[kept]
        / total[kept, None]
    )
    last = max(frames, key=lambda f: (f.stamp_ns, f.number))
    return Frame(
        last.fluoroscope,
        last.number,
        ids[kept],
        middle[kept] + mean,
        last.image_size,
        total[kept] ** -0.5,
        last.stamp_ns,
        last.frame_id,
    )


def _refuse_motion(frames, still_px):
    """Raise DataError where a frame shows the phantom displaced from the one before or from the
    first by more than still_px.
    """
    for before, frame in [*zip(frames, frames[1:]), *((frames[0], frame) for frame in frames[2:])]:
        moved = displacement(before, frame)
        if np.isfinite(moved) and moved > still_px:
            raise DataError(
                f'fluoroscope {frame.fluoroscope}: the phantom does not stand still, between frames '
                f'{before.number} and {frame.number} it moves by {moved:.1f} px'
            )


def _paired(frames):
    """The frames of which the first fluoroscope and another have one of the same number, at most
    MAX_PAIRS each.
    """
    first, *others = frames
    numbers = {name: {frame.number for frame in of_one} for name, of_one in frames.items()}
    for b, name in enumerate(others, 1):
        if not numbers[name] & numbers[first]:
            raise DataError(_unpaired(tuple(frames), b))
    # The exposures of which most views are there come first, evenly over their numbers.
    every = sorted(numbers[first] & set.union(*(numbers[name] for name in others)))
    full = [n for n in every if all(n in numbers[name] for name in others)]
    used = full if len(full) >= MAX_PAIRS else every
    used = {used[i] for i in np.unique(np.linspace(0, len(used) - 1, MAX_PAIRS).astype(int))}
    return {
        name: [frame for frame in of_one if frame.number in used]
        for name, of_one in frames.items()
    }


def _unpaired(names, b):
    return (
        f'fluoroscopes {names[0]} and {names[b]}: no exposures have the same number, so that their relative '
        'orientation is not known'
    )


def _adjusted(frames, phantom, calibrations, loss, noise_held, raise_if_cancelled):
    """The _Held adjustment of frames; noise_held: noise is that of the calibrations, else only
    where there are too few exposures to estimate it.
    """
    names = tuple(frames)
    measured = measured_network(
        frames,
        phantom,
        interior={n: calibrations[n].interior for n in names},
        interior_free=False,
        min_exposures=1,
        corrections={n: calibrations[n].model.predict for n in names},
        raise_if_cancelled=raise_if_cancelled,
    )
    correction, network = held_corrections(measured, calibrations)
    noise_held = noise_held or len(network.uv) < SEEN_FOR_NOISE * len(network.survey_mm)
    used = [calibrations[n] for n in names]
    noise = replace(
        start_noise(loss),
        scale=float(np.median([c.sigma0 for c in used])),
        nu=float(np.median([c.nu for c in used])),
    )
    after, _ = adjusted_with_precision(
        network,
        measured.start,
        correction,
        noise,
        raise_if_cancelled=raise_if_cancelled,
        noise_held=noise_held,
    )
    if not np.isfinite(after.parameters.position_mm).all():
        raise DataError('the exposures do not determine the orientation of the fluoroscopes')
    count = 3 * len(names)
    free = replace(
        network,
        interior_free=np.ones(len(names), dtype=bool),
        interior_mean=after.parameters.interior,
        interior_sd=np.full((len(names), 3), ASSUMED_SD_PX),
    )
    blocks = covariance_blocks(
        factorize(
            free,
            normal_equations(
                free,
                after.parameters,
                correction,
                after.noise,
                after.noise.information_factor(after.q),
            ),
        ),
    )
    by_interior = blocks.eg @ np.linalg.inv(blocks.gg)
    interiors = np.zeros((count, count))
    for f, calibration in enumerate(used):
        interiors[3 * f : 3 * f + 3, 3 * f : 3 * f + 3] = calibration.interior_covariance

    def covariance(e, f):
        return blocks.between(e, f) - by_interior[e] @ blocks.gg @ by_interior[f].transpose(
            0, 2, 1
        )

    return _Held(measured, after, by_interior, covariance, interiors)


def _all_exposures(held):
    """Covariance (6m, 6m) of all exposures, the interiors taken as known."""
    count = len(held.measured.frames)
    every = np.arange(count)
    rows = [
        held.covariance(np.full(count, e), every).transpose(1, 0, 2).reshape(6, 6 * count)
        for e in every
    ]
    return np.concatenate(rows)


def _mean_of_pairs(held, pairs):
    """Weighted mean RelativePose of pairs (k, 2) of exposures, its derivatives (6, 6m) by the
    exposures, and the factor by which the pairs scatter more than their standard deviations say,
    at least 1.
    """
    parameters = held.after.parameters
    (a, b) = pairs.T
    constraint = RelativeConstraint((0, 1), pairs, 1.0, 1.0)
    _, d_a, d_b, _ = discrepancies_with_jacobian(
        constraint, mean_pose(parameters, pairs), parameters
    )
    mixed = d_a @ held.covariance(a, b) @ d_b.transpose(0, 2, 1)
    own = (
        d_a @ held.covariance(a, a) @ d_a.transpose(0, 2, 1)
        + d_b @ held.covariance(b, b) @ d_b.transpose(0, 2, 1)
        + mixed
        + mixed.transpose(0, 2, 1)
    )
    weights = np.linalg.inv(own)
    pose = mean_pose(parameters, pairs, weights)
    operator = np.zeros((6, len(held.measured.frames), 6))
    share = np.linalg.solve(
        weights.sum(axis=0), weights.transpose(1, 0, 2).reshape(6, -1)
    ).reshape(6, len(pairs), 6)
    for rows, derivative in ((a, d_a), (b, d_b)):
        operator[:, rows] += np.einsum('ika,kab->ikb', share, derivative)
    off = discrepancies(constraint, pose, parameters)
    square = np.einsum('ki,kij,kj', off, weights, off) / max(6 * (len(pairs) - 1), 1)
    return pose, operator.reshape(6, -1), np.sqrt(max(1.0, square))


def _orientation(
    held,
    rotation,
    position,
    known,
    by_interior,
    calibrations,
    frame_id,
    source,
    stamp_ns,
    exposures,
):
    """RigOrientation of exteriors: known (6F, 6F): their covariance with the interiors known,
    by_interior (6F, 3F).
    """
    names = held.measured.fluoroscopes
    mixed = by_interior @ held.interiors
    every = np.block([[known + mixed @ by_interior.T, mixed], [mixed.T, held.interiors]])
    count = len(names)
    order = np.concatenate(
        [np.r_[6 * f : 6 * f + 6, 6 * count + 3 * f : 6 * count + 3 * f + 3] for f in range(count)]
    )
    covariance = every[np.ix_(order, order)].reshape(ORIENTATION_SIZE * count, -1)
    return RigOrientation(
        names,
        np.array([calibrations[n].interior for n in names]),
        rotation,
        position,
        (covariance + covariance.T) / 2,
        frame_id,
        source,
        tuple(calibrations[n].calibration_id for n in names),
        stamp_ns,
        exposures,
        tuple(calibrations[n].frame_id or f'{n}_optical' for n in names),
    )
