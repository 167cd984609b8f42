"""What is asked of an adjustment beside its observations, and what is told of it.

Relative orientations, known interior orientations and the datum; high correlations and outliers.
"""

from dataclasses import dataclass, replace

import numpy as np

from ..errors import DataError
from ..photogrammetry.diagnosis import (
    describe_directions,
    high_correlations,
    undetermined_directions,
    undetermined_interiors,
)
from ..photogrammetry.elimination import factorize
from ..photogrammetry.normal_equations import normal_equations
from ..photogrammetry.outliers import find_outliers
from ..photogrammetry.precision import covariance_blocks
from ..photogrammetry.relative_orientation import (
    RIGID_SD_MM,
    RIGID_SD_RAD,
    RelativeConstraint,
    RelativePose,
    discrepancies,
    discrepancies_with_jacobian,
    mean_pose,
)

# That determine an object point without its surveyed coordinates: two would do, but a false match
# among them could not be found, and would put the point anywhere.
MIN_RAYS = 3


@dataclass(frozen=True)
class RelativeOrientation:
    """Relative orientation of two fluoroscopes.

    fluoroscopes: their names a and b; pose: Q = R_b R_a^T and t = R_a (T_b - T_a) [mm]; sd_mm and
    sd_rad (3,) of t and of Q about the axes of b's sensor; covariance (6, 6) of both; scatter_mm
    and scatter_rad (3,): standard deviations of the exposures about it; exposures: the number of
    pairs; constraint 'none', 'soft' or 'hard'.
    """

    fluoroscopes: tuple
    pose: RelativePose
    covariance: np.ndarray
    scatter_mm: np.ndarray
    scatter_rad: np.ndarray
    exposures: int
    constraint: str

    @property
    def sd_mm(self):
        """Standard deviations (3,) of the translation [mm]."""
        return np.sqrt(np.diagonal(self.covariance)[:3])

    @property
    def sd_rad(self):
        """Standard deviations (3,) of the rotation [rad]."""
        return np.sqrt(np.diagonal(self.covariance)[3:])


def pairs_of(measured, b, a=0):
    """Rows (k, 2) of the exposures that fluoroscopes number a and b took together: those of the
    same number.
    """
    row = {
        (int(f), frame.number): j
        for j, (f, frame) in enumerate(zip(measured.network.fluoroscope, measured.frames))
    }
    return np.array(
        [(row[a, number], j) for (f, number), j in row.items() if f == b and (a, number) in row],
        dtype=int,
    ).reshape(-1, 2)


def constrained(measured, options):
    """The Measured network with relative orientations, interior weights and datum as the CalibrationOptions
    ask for.

    Raises DataError where no exposures can be paired.
    """
    if options.datum == 'inner':
        measured = _without_few_rays(measured)
    network = replace(measured.network, datum=options.datum, relative=())
    start = replace(measured.start, relative=())
    if options.interior_sd is not None:
        sd = np.tile(options.interior_sd, (len(measured.fluoroscopes), 1))
        network = replace(network, interior_mean=start.interior, interior_sd=sd)
    if options.relative_orientation != 'none':
        constraints = _constraints(measured, options)
        start = replace(start, relative=tuple(mean_pose(start, c.pairs) for c in constraints))
        if options.datum == 'inner':
            constraints = tuple(
                replace(c, length_mm=float(np.linalg.norm(pose.translation_mm)))
                for c, pose in zip(constraints, start.relative)
            )
        network = replace(network, relative=constraints)
    return replace(measured, network=network, start=start)


def _constraints(measured, options):
    """A RelativeConstraint of every further fluoroscope with the first. Raises DataError."""
    if len(measured.fluoroscopes) < 2:
        raise DataError(
            'a relative orientation needs two fluoroscopes in one adjustment, there is only '
            f'{measured.fluoroscopes[0]}'
        )
    sd = (
        options.relative_sd
        if options.relative_orientation == 'soft'
        else (RIGID_SD_MM, RIGID_SD_RAD)
    )
    out = []
    for b in range(1, len(measured.fluoroscopes)):
        pairs = pairs_of(measured, b)
        if len(pairs) < 2:
            raise DataError(
                f'fluoroscopes {measured.fluoroscopes[0]} and {measured.fluoroscopes[b]}: {len(pairs)} '
                'exposures have the same number, 2 are needed for a relative orientation constraint'
            )
        out.append(RelativeConstraint((0, b), pairs, *sd))
    return tuple(out)


def _without_few_rays(measured):
    """The Measured network without targets that fewer than three image points show."""
    network = measured.network
    rays = np.bincount(network.point, minlength=network.n_points)
    few = rays < MIN_RAYS
    if not few.any():
        return measured
    keep = ~few[network.point]
    row = np.cumsum(~few) - 1
    if not keep.any():
        raise DataError(
            'no target is seen in three exposures: without surveyed coordinates none is determined'
        )
    network = replace(
        network,
        uv=network.uv[keep],
        sigma=network.sigma[keep],
        exposure=network.exposure[keep],
        point=row[network.point[keep]],
        survey_mm=network.survey_mm[~few],
        survey_sd_mm=network.survey_sd_mm[~few],
    )
    names = ', '.join(str(i) for i in measured.target_id[few][:10])
    names += ' and more' if few.sum() > 10 else ''
    sentence = (
        f'{few.sum()} targets are seen in fewer than {MIN_RAYS} exposures, which do not determine them '
        'safely without surveyed coordinates: ' + names
    )
    return replace(
        measured,
        network=network,
        target_id=measured.target_id[~few],
        start=replace(measured.start, points_mm=measured.start.points_mm[~few]),
        left_out=measured.left_out + (sentence,),
    )


def relative_orientations(run, constraint):
    """RelativeOrientation of every further fluoroscope of a SelfCalibration with the first, where
    exposures are paired.

    constraint: that of the CalibrationOptions. Without one it is the weighted mean of the exposures.
    """
    measured = run.measured
    parameters = run.after.parameters
    out = []
    for b in range(1, len(measured.fluoroscopes)):
        names = (measured.fluoroscopes[0], measured.fluoroscopes[b])
        if constraint == 'none':
            pairs = pairs_of(measured, b)
            if not len(pairs):
                continue
            pose, covariance = _mean_of_pairs(run, pairs)
        else:
            pairs = measured.network.relative[b - 1].pairs
            pose = parameters.relative[b - 1]
            covariance = run.precision.relative[b - 1]
        off = discrepancies(RelativeConstraint((0, b), pairs, 1.0, 1.0), pose, parameters)
        scatter = np.sqrt(np.sum(off**2, axis=0) / max(len(off) - 1, 1))
        out.append(
            RelativeOrientation(
                names, pose, covariance, scatter[:3], scatter[3:], len(pairs), constraint
            )
        )
    return tuple(out)


def _mean_of_pairs(run, pairs):
    """Weighted mean of the relative orientations of pairs (k, 2) of exposures: RelativePose and
    covariance (6, 6).

    The exposures are correlated, by interior orientation and object points: their mixed
    covariances count.
    """
    network = run.measured.network
    after = run.after
    equations = normal_equations(
        network,
        after.parameters,
        run.correction - network.additional_correction(after.parameters),
        after.noise,
        after.noise.information_factor(after.q),
    )
    blocks = covariance_blocks(factorize(network, equations))
    pose = mean_pose(after.parameters, pairs)
    _, d_a, d_b, _ = discrepancies_with_jacobian(
        RelativeConstraint((0, 1), pairs, 1.0, 1.0), pose, after.parameters
    )
    one, other = (a.ravel() for a in np.indices((len(pairs), len(pairs))))
    mixed = 0
    for p, d_p in zip(pairs.T, (d_a, d_b)):
        for q, d_q in zip(pairs.T, (d_a, d_b)):
            mixed = mixed + d_p[one] @ blocks.between(p[one], q[other]) @ d_q[other].transpose(
                0, 2, 1
            )
    mixed = mixed.reshape(len(pairs), len(pairs), 6, 6)
    weights = np.linalg.inv(mixed[np.arange(len(pairs)), np.arange(len(pairs))])
    inverse = np.linalg.inv(weights.sum(axis=0))
    middle = np.einsum('kab,klbc,lcd->ad', weights, mixed, weights)
    return mean_pose(after.parameters, pairs, weights), inverse @ middle @ inverse


def what_is_open(measured):
    """A sentence on the unknowns that a network leaves open at its start values; empty where there
    are none.
    """
    found = undetermined_directions(
        measured.network, measured.start, measured.fluoroscopes, _numbers(measured)
    )
    if not found:
        return ''
    return (
        f'the exposures do not determine the unknowns: {describe_directions(found)}; '
        'add exposures with the phantom turned and moved, with more targets'
    )


def refuse_undetermined(measured, adjustment, precise):
    """Raise DataError, a sentence for each fluoroscope, where an Adjustment leaves interior
    orientations open.
    """
    scale = adjustment.noise.scale
    found = undetermined_interiors(
        measured.network, adjustment.parameters, precise, measured.fluoroscopes, scale
    )
    if found:
        raise DataError('. '.join(found))


def correlations_of(run):
    """High correlations between unknowns of a SelfCalibration: ((name, name, value), ...)."""
    return high_correlations(
        run.measured.network,
        run.after.parameters,
        run.precision,
        run.measured.fluoroscopes,
        _numbers(run.measured),
    )


def outliers_of(run):
    """Outliers of a SelfCalibration: dicts of image points and of targets with their test
    statistics.
    """
    measured = run.measured
    found = find_outliers(measured.network, run.after, run.precision)
    points = [
        {
            'fluoroscope': measured.frames[j].fluoroscope,
            'exposure': measured.frames[j].number,
            'target_id': int(measured.target_id[measured.network.point[row]]),
            'value': float(value),
            'critical': found.critical_image,
        }
        for row, j, value in zip(
            found.image_point, measured.network.exposure[found.image_point], found.value
        )
    ]
    targets = [
        {
            'target_id': int(measured.target_id[row]),
            'offset_mm': offset,
            'value': float(value),
            'critical': found.critical_target,
        }
        for row, offset, value in zip(found.target, found.offset_mm, found.target_value)
    ]
    return points, targets


def _numbers(measured):
    return [frame.number for frame in measured.frames]


__all__ = [
    'RelativeOrientation',
    'constrained',
    'correlations_of',
    'outliers_of',
    'pairs_of',
    'refuse_undetermined',
    'relative_orientations',
    'what_is_open',
]
