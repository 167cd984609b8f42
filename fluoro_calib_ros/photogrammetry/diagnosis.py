# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Name unknowns that a network cannot determine, and unknowns that can hardly be separated.

Near-zero eigenvalues of the normal matrix, scaled to a unit diagonal, belong to combinations of
unknowns that the observations do not determine. The largest components of their eigenvectors name
them (Belsley, Kuh and Welsch, "Regression Diagnostics", Wiley 1980, 3.2; for self-calibration
Luhmann et al., "Close-Range Photogrammetry and 3D Imaging", 3rd ed., de Gruyter 2020, 7.3.2).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import eigh

from ..findings import Finding, Kind, Place, first_few
from .elimination import Elimination
from .network import Network
from .noise import Noise
from .normal_equations import normal_equations
from .plane_resection import flatness
from .precision import Precision
from .unknowns import POSE_SIZE, SINGULAR, Parameters

# Correlation above which two unknowns are reported.
HIGH_CORRELATION = 0.95
# Largest image noise at which a network is judged, so that distortion does not make it look
# weaker.
NOMINAL_NOISE_PX = 1.0
# Standard deviation of the interior orientation, relative to c, above which it is undetermined.
MAX_RELATIVE_SD = 0.05
# Correlation of c with the distance in every exposure above which they cannot be separated.
MAX_DISTANCE_CORRELATION = 0.9999
# Components of an eigenvector are reported above this part of its largest squared component.
MIN_SHARE = 0.1
INTERIOR = ('xp', 'yp', 'c')
EXTERIOR = ('X', 'Y', 'Z', 'rotation about x', 'rotation about y', 'rotation about z')


def global_names(network: Network, fluoroscopes: Sequence[str]) -> list[str]:
    """Return the names of the global unknowns, in the order of the layout."""
    out = [f'{f}: {part}' for f in fluoroscopes for part in INTERIOR]
    for constraint in network.relative:
        a, b = (fluoroscopes[f] for f in constraint.fluoroscopes)
        out += [f'relative orientation of {a} and {b}: {part}' for part in EXTERIOR]
    for f, additional in enumerate(network.additional):
        count = 0 if additional is None else additional.count
        out += [f'{fluoroscopes[f]}: additional parameter {i + 1}' for i in range(count)]
    return out


def exterior_names(
    network: Network, fluoroscopes: Sequence[str], numbers: Sequence[int]
) -> list[str]:
    """Return the names of the exterior orientations; numbers (m,): of the exposures.

    Coordinates of the source are in the sensor frame, with Z towards the phantom.
    """
    return [
        f'exposure {number} of {fluoroscopes[f]}: {part}'
        for number, f in zip(numbers, network.fluoroscope)
        for part in EXTERIOR
    ]


def high_correlations(
    network: Network,
    parameters: Parameters,
    precision: Precision,
    fluoroscopes: Sequence[str],
    numbers: Sequence[int],
) -> tuple[tuple[str, str, float], ...]:
    """Return high correlations of interior and relative orientations with other unknowns.

    The others are all global unknowns and exterior orientations. fluoroscopes: names. numbers: of
    the exposures. Returns pairs of unknowns with correlations above 0.95, largest first, up to 20.
    """
    orientations = network.layout.all_orientations
    count = orientations.stop
    names = global_names(network, fluoroscopes)
    sd = np.sqrt(np.maximum(np.diagonal(precision.all_global), 0))
    with_globals = _correlations(precision.all_global[orientations], sd[orientations], sd)
    with_globals[np.arange(count)[:, None] >= np.arange(len(sd))] = 0  # each pair once
    exterior, mixed = _turned_to_sensor(
        parameters, precision.exterior, precision.exterior_global[:, :, orientations]
    )
    exterior_sd = np.sqrt(np.diagonal(exterior, axis1=1, axis2=2)).ravel()
    with_exteriors = _correlations(mixed.reshape(-1, count).T, sd[orientations], exterior_sd)
    correlations = np.concatenate([with_globals, with_exteriors], axis=1)
    column_names = names + exterior_names(network, fluoroscopes, numbers)
    row, column = np.nonzero(np.abs(correlations) > HIGH_CORRELATION)
    order = np.argsort(-np.abs(correlations[row, column]), kind='stable')[:20]  # limit of the list
    return tuple(
        (names[row[i]], column_names[column[i]], float(correlations[row[i], column[i]]))
        for i in order
    )


def _correlations(
    covariance: NDArray[np.float64], row_sd: NDArray[np.float64], column_sd: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return correlations of covariances (r, c); zero if an unknown is fixed."""
    with np.errstate(divide='ignore', invalid='ignore'):
        out = covariance / np.outer(row_sd, column_sd)
    return np.where(np.isfinite(out), out, 0.0)


def _turned_to_sensor(
    parameters: Parameters, exterior: NDArray[np.float64], mixed: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Rotate covariances (m, 6, 6) and (m, 6, G) to sources in the sensor frame."""
    turn = np.tile(np.eye(POSE_SIZE), (len(exterior), 1, 1))
    turn[:, :3, :3] = parameters.rotation
    return turn @ exterior @ turn.transpose(0, 2, 1), turn @ mixed


def undetermined_interiors(
    network: Network,
    parameters: Parameters,
    precision: Precision,
    fluoroscopes: Sequence[str],
    scale: float,
) -> tuple[Finding, ...]:
    """Return a finding for every fluoroscope whose interior orientation is not determined.

    precision: judged at an image noise of at most one pixel. fluoroscopes: names of the
    fluoroscopes. scale: scale of the noise model of the precision.
    """
    out = []
    correlations = _distance_correlations(network, parameters, precision)
    for f, name in enumerate(fluoroscopes):
        if not network.interior_free[f]:
            continue
        noise_px = scale * float(np.median(network.sigma[network.rows(f)]))
        factor = min(NOMINAL_NOISE_PX / noise_px, 1.0)
        sd = np.sqrt(np.diagonal(precision.interior[f])) * factor
        c = parameters.interior[f, 2]
        remark = _flatness_remark(network)
        weighted = network.interior_weight[f, 2] > 0
        inseparable = not weighted and correlations[f] > MAX_DISTANCE_CORRELATION
        if sd[2] > MAX_RELATIVE_SD * c or inseparable:
            cause = (
                f'principal distance and distance to the phantom cannot be separated (standard '
                f'deviation of c {100 * sd[2] / c:.0f} %, correlation {correlations[f]:.5f})'
                f'{remark}; add exposures with the phantom tilted towards the source, or use a '
                'fixed interior orientation'
            )
        elif max(sd[:2]) > MAX_RELATIVE_SD * c:
            cause = (
                'the principal point cannot be separated from the position of the source '
                f'(standard deviation {max(sd[:2]):.0f} px){remark}; add exposures with the '
                'phantom turned about the axis of the image and tilted, or use a fixed interior '
                'orientation'
            )
        else:
            continue
        numbers = {'sd_c_px': float(sd[2]), 'correlation': float(correlations[f])}
        numbers['sd_point_px'] = float(max(sd[:2]))
        out.append(Finding(Kind.INTERIOR_UNDETERMINED, cause, Place((name,)), numbers=numbers))
    return tuple(out)


def _distance_correlations(
    network: Network, parameters: Parameters, precision: Precision
) -> NDArray[np.float64]:
    """Return the smallest correlation (F,) of c with the source distance along its axis.

    It is the smallest over the exposures of each fluoroscope.
    """
    exterior, mixed = _turned_to_sensor(parameters, precision.exterior, precision.exterior_global)
    out = np.ones(network.n_fluoroscopes)
    for f, columns in enumerate(network.layout.interiors):
        rows = network.fluoroscope == f
        sd = np.sqrt(exterior[rows, 2, 2] * precision.interior[f, 2, 2])
        covariance = mixed[rows, 2, columns][:, 2]
        with np.errstate(divide='ignore', invalid='ignore'):
            out[f] = np.min(np.abs(covariance) / sd)
    return np.nan_to_num(out)


def _flatness_remark(network: Network) -> str:
    """Return a remark if the targets nearly lie in a plane, else an empty string."""
    flat = flatness(network.survey_mm) < 0.1  # smallest over largest extent
    return '; the beads lie nearly in one plane' if flat else ''


def reduced_normal_matrix(network: Network, parameters: Parameters) -> NDArray[np.float64]:
    """Return the normal matrix of exposures and free global unknowns, object points eliminated.

    Its shape is (6m + G, 6m + G); sources are in the sensor frame, and all weights are equal. It
    may be singular.
    """
    noise = Noise('gaussian', NOMINAL_NOISE_PX / float(np.median(network.sigma)))
    equations = normal_equations(network, parameters, 0.0, noise)
    elimination = Elimination(network, of_exposures=False)
    system = elimination.bordered_system(replace(equations, gauge=None))
    out = system.singular_schur_complement()
    for rows, rotation in zip(elimination.layout.block_rows[:, :3], parameters.rotation):
        out[rows] = rotation @ out[rows]
        out[:, rows] = out[:, rows] @ rotation.T
    return out


def undetermined_directions(
    network: Network,
    parameters: Parameters,
    fluoroscopes: Sequence[str],
    numbers: Sequence[int],
) -> tuple[tuple[str, ...], ...]:
    """Return the unknowns that dominate each combination that the network does not determine.

    numbers (m,): of the exposures. The datum of a free network is not reported.
    """
    matrix = reduced_normal_matrix(network, parameters)
    scale = np.sqrt(np.maximum(np.diagonal(matrix), 1e-300))
    free_names = np.array(global_names(network, fluoroscopes))[network.layout.free]
    names = np.concatenate([exterior_names(network, fluoroscopes, numbers), free_names])
    values, vectors = eigh(matrix / np.outer(scale, scale))
    defect = network.layout.datum_defect
    out = []
    for value, vector in zip(values[defect:], vectors.T[defect:]):
        if value > SINGULAR:
            break
        square = vector**2
        order = np.argsort(-square, kind='stable')
        dominant = order[square[order] > MIN_SHARE * square.max()]
        out.append(tuple(str(name) for name in names[dominant]))
    return tuple(out)


def describe_directions(directions: Sequence[Sequence[str]]) -> str:
    """Describe undetermined combinations of unknowns in one sentence."""
    parts = []
    for names in directions[:3]:
        exposures = sorted({name.split(':')[0] for name in names if name.startswith('exposure')})
        interior = [name for name in names if name.endswith((': xp', ': yp', ': c'))]
        other_names = [n for n in names if n not in interior and not n.startswith('exposure')]
        named = ', '.join((interior + other_names)[:4])
        if named and exposures:
            parts.append(
                f'{named} cannot be separated from the orientation of {first_few(exposures)}'
            )
        elif exposures:
            parts.append(f'the orientation of {first_few(exposures)} is undetermined')
        else:
            parts.append(f'{named} cannot be separated')
    return '; '.join(dict.fromkeys(parts))
