"""What a network cannot determine, in words, and unknowns that can hardly be told apart.

Near-zero eigenvalues of the normal matrix, scaled to a unit diagonal, belong to combinations of
unknowns that the observations leave open; the largest components of their eigenvectors tell which
(Belsley, Kuh and Welsch, "Regression Diagnostics", Wiley 1980, 3.2; for self-calibration Luhmann
et al., "Close-Range Photogrammetry and 3D Imaging", 3rd ed., de Gruyter 2020, 7.3.2).
"""

import numpy as np
from scipy.linalg import eigh

from .noise import Noise
from .normal_equations import normal_equations

HIGH = 0.95  # correlation from which on two unknowns are named
NAMED = 20  # correlations named at most
OPEN = 1e-11  # eigenvalue of the scaled normal matrix below which it is rounding error
# image noise by which a network is judged, so that a bent image does not make it look worse
NOMINAL_PX = 1.0
# standard deviation of the interior orientation, as a part of c, above which it is not determined
WEAK = 0.05
INSEPARABLE = 0.9999  # correlation of c and every distance
SHARE = (
    0.1  # of the square of an eigenvector's largest component, from which on a component is named
)
FLAT = 0.1  # smallest over largest extent of targets that are called nearly flat
INTERIOR = ('xp', 'yp', 'c')
EXTERIOR = ('X', 'Y', 'Z', 'rotation about x', 'rotation about y', 'rotation about z')


def names_of_globals(network, fluoroscopes):
    """Names of the global unknowns: interior orientations, relative orientations, additional
    parameters.
    """
    out = [f'{f}: {part}' for f in fluoroscopes for part in INTERIOR]
    for constraint in network.relative:
        a, b = (fluoroscopes[f] for f in constraint.fluoroscopes)
        out += [f'relative orientation of {a} and {b}: {part}' for part in EXTERIOR]
    for f, additional in enumerate(network.additional):
        if additional is not None:
            out += [
                f'{fluoroscopes[f]}: additional parameter {i + 1}' for i in range(additional.count)
            ]
    return out


def names_of_exposures(network, fluoroscopes, numbers):
    """Names of the exterior orientations: of the source's coordinates in the sensor frame, Z
    towards the phantom.
    """
    return [
        f'exposure {number} of {fluoroscopes[f]}: {part}'
        for number, f in zip(numbers, network.fluoroscope)
        for part in EXTERIOR
    ]


def high_correlations(network, parameters, precise, fluoroscopes, numbers):
    """Correlations above 0.95 of interior and relative orientations with each other, exterior
    orientations and additional parameters: at most 20 of (name, name, value), the largest first.
    numbers (m,): of the exposures.
    """
    names = names_of_globals(network, fluoroscopes)
    first = 3 * network.shape[3] + 6 * len(network.relative)
    sd = np.sqrt(np.maximum(np.diagonal(precise.all_global), 0))
    own = _correlations(precise.all_global[:first], sd[:first], sd)
    own[np.arange(first)[:, None] >= np.arange(len(sd))] = 0
    exterior, mixed = _in_sensor(
        parameters, precise.exterior, precise.exterior_global[:, :, :first]
    )
    other = _correlations(
        mixed.reshape(-1, first).T,
        sd[:first],
        np.sqrt(np.diagonal(exterior, axis1=1, axis2=2)).ravel(),
    )
    everything = np.concatenate([own, other], axis=1)
    names_of_columns = names + names_of_exposures(network, fluoroscopes, numbers)
    row, column = np.nonzero(np.abs(everything) > HIGH)
    order = np.argsort(-np.abs(everything[row, column]), kind='stable')[:NAMED]
    return tuple(
        (names[row[i]], names_of_columns[column[i]], float(everything[row[i], column[i]]))
        for i in order
    )


def _correlations(covariance, sd_rows, sd_columns):
    """Correlations of covariances (r, c); zero for what is held."""
    with np.errstate(divide='ignore', invalid='ignore'):
        out = covariance / np.outer(sd_rows, sd_columns)
    return np.where(np.isfinite(out), out, 0.0)


def _in_sensor(parameters, exterior, mixed):
    """Covariances (m, 6, 6) and (m, 6, G) of exposures, the source's coordinates turned into the
    sensor frame.
    """
    turn = np.tile(np.eye(6), (len(exterior), 1, 1))
    turn[:, :3, :3] = parameters.rotation
    return turn @ exterior @ turn.transpose(0, 2, 1), turn @ mixed


def undetermined(network, parameters, precise, fluoroscopes, scale):
    """A sentence for every fluoroscope whose interior orientation a Precision leaves open, as a
    tuple.

    Judged at an image noise of a pixel at most; scale: that of the noise model of the precision.
    """
    out = []
    correlations = _distance_correlations(network, parameters, precise)
    for f, name in enumerate(fluoroscopes):
        if not network.interior_free[f]:
            continue
        factor = min(NOMINAL_PX / (scale * float(np.median(network.sigma[network.rows(f)]))), 1.0)
        sd = np.sqrt(np.diagonal(precise.interior[f])) * factor
        c = parameters.interior[f, 2]
        if sd[2] > WEAK * c or correlations[f] > INSEPARABLE:
            out.append(
                f'fluoroscope {name}: principal distance and distance to the phantom cannot be separated '
                f'(standard deviation of c {100 * sd[2] / c:.0f} %, correlation {correlations[f]:.5f})'
                f'{_flat(network)}; '
                'add exposures with the phantom tilted towards the source, or hold the interior orientation'
            )
        elif max(sd[:2]) > WEAK * c:
            out.append(
                f'fluoroscope {name}: the principal point cannot be separated from the position of the source '
                f'(standard deviation {max(sd[:2]):.0f} px){_flat(network)}; add exposures with the phantom '
                'turned about the axis of the image and tilted, or hold the interior orientation'
            )
    return tuple(out)


def _distance_correlations(network, parameters, precise):
    """Smallest correlation (F,) of c with the distance of the source along its axis, over the
    exposures.
    """
    exterior, mixed = _in_sensor(parameters, precise.exterior, precise.exterior_global)
    out = np.ones(network.shape[3])
    for f in range(network.shape[3]):
        mine = network.fluoroscope == f
        sd = np.sqrt(exterior[mine, 2, 2] * precise.interior[f, 2, 2])
        with np.errstate(divide='ignore', invalid='ignore'):
            out[f] = np.min(np.abs(mixed[mine, 2, 3 * f + 2]) / sd)
    return np.nan_to_num(out)


def _flat(network):
    """A remark where the targets nearly lie in a plane."""
    extent = np.linalg.svd(network.survey_mm - network.survey_mm.mean(axis=0), compute_uv=False)
    return '; the beads lie nearly in one plane' if extent[2] < FLAT * extent[0] else ''


def reduced_normal_matrix(network, parameters, noise_px=NOMINAL_PX):
    """Normal matrix (6m + G, 6m + G) of exposures, in the sensor frame, and free global unknowns,
    the object points eliminated; all weights are equal.
    """
    noise = Noise('gaussian', noise_px / float(np.median(network.sigma)))
    equations = normal_equations(network, parameters, 0.0, noise)
    _, m, n, _ = network.shape
    free = network.global_free
    br = np.zeros((n, 3, 6 * m + int(free.sum())))
    br[:, :, : 6 * m].reshape(n, 3, m, 6)[network.point, :, network.exposure, :] = equations.pe
    br[:, :, 6 * m :] = equations.pg[:, :, free]
    out = np.zeros((br.shape[2], br.shape[2]))
    rows = np.arange(6 * m).reshape(m, 6)
    out[rows[:, :, None], rows[:, None, :]] = equations.ee
    for (a, b), mixed in zip(*equations.coupled):
        out[np.ix_(rows[a], rows[b])] = mixed
        out[np.ix_(rows[b], rows[a])] = mixed.T
    out[: 6 * m, 6 * m :] = equations.eg.reshape(6 * m, -1)[:, free]
    out[6 * m :, : 6 * m] = out[: 6 * m, 6 * m :].T
    out[6 * m :, 6 * m :] = equations.gg[np.ix_(free, free)]
    inverse = np.linalg.pinv(equations.pp, hermitian=True)
    out -= br.reshape(3 * n, -1).T @ (inverse @ br).reshape(3 * n, -1)
    for r, rotation in zip(rows[:, :3], parameters.rotation):
        out[r] = rotation @ out[r]
        out[:, r] = out[:, r] @ rotation.T
    return out


def open_directions(network, parameters, fluoroscopes, numbers):
    """Names of the unknowns that dominate each combination that the network leaves open: a tuple
    for each.

    Those of the datum of a free network are not among them.
    """
    matrix = reduced_normal_matrix(network, parameters)
    scale = np.sqrt(np.maximum(np.diagonal(matrix), 1e-300))
    names = np.array(
        names_of_exposures(network, fluoroscopes, numbers)
        + [
            n
            for n, free in zip(names_of_globals(network, fluoroscopes), network.global_free)
            if free
        ]
    )
    values, vectors = eigh(matrix / np.outer(scale, scale))
    out = []
    for value, vector in list(zip(values, vectors.T))[7 if network.datum == 'inner' else 0 :]:
        if value > OPEN:
            break
        square = vector**2
        order = np.argsort(-square, kind='stable')
        out.append(tuple(names[order[square[order] > SHARE * square.max()]]))
    return tuple(out)


def sentence_of(directions):
    """One sentence on the combinations of unknowns that are left open."""
    parts = []
    for names in directions[:3]:
        of_exposures = sorted(
            {name.split(':')[0] for name in names if name.startswith('exposure')}
        )
        interior = [name for name in names if name.endswith((': xp', ': yp', ': c'))]
        shown = interior + [n for n in names if n not in interior and not n.startswith('exposure')]
        if shown and of_exposures:
            parts.append(
                f'{", ".join(shown[:4])} cannot be separated from the orientation of {_some(of_exposures)}'
            )
        elif of_exposures:
            parts.append(f'the orientation of {_some(of_exposures)} is left open')
        else:
            parts.append(f'{", ".join(shown[:4])} cannot be separated')
    return '; '.join(dict.fromkeys(parts))


def _some(names):
    return ', '.join(names[:3]) + (f' and {len(names) - 3} more' if len(names) > 3 else '')
