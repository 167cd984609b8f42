# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Check 'shape': the phantom as a whole has the shape that its survey says.

A phantom that has shrunk along one axis, or is sheared, displaces every bead by less than the
standard deviation of its survey, and all of them together by far more than chance does. The
survey is taken to be S = X + D t + noise with five strains t besides the beads X (a common scale
has to be taken on trust: the images do not show it). The test of t = 0 against this alternative is
the score test (Rao, Proceedings of the Cambridge Philosophical Society 44, 1948): one step from
the adjustment, with exterior orientations, interior orientations and a cubic change of each
correction among the unknowns. What t does to the adjusted beads, over their claimed standard
deviations, decides whether it matters, and the smallest t that the test would find says whether
the exposures can tell (Baarda, "A testing procedure for use in geodetic networks", Netherlands
Geodetic Commission 1968).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import eigh
from scipy.special import chdtri

from ..estimation.exposure_terms import VARYING, exposure_functions
from ..estimation.fixed_calibration import SolvedNetwork
from ..findings import Finding, Kind, Place, Severity
from ..photogrammetry.collinearity import AdditionalParameters
from ..photogrammetry.elimination import factorize
from ..photogrammetry.network import Network, similarity_directions
from ..photogrammetry.normal_equations import normal_equations
from ..photogrammetry.outliers import FALSE_ALARM
from ..photogrammetry.precision import covariance_times_points
from ..photogrammetry.unknowns import UnknownVector
from .beads import MIN_BEADS, SD_FACTOR
from .calibration_evidence import Evidence, Subject
from .check import Check

STRAINS = 5  # symmetric, without the common scale
# Increase of the NSE of the points by a strain that is no fault: up to 1.25 it is honest.
HARMLESS_NSE = 0.25
# Increase of the NSE by a strain that would not be found from which it is taken on trust.
TRUSTED_NSE = 1.0
TINY = 1e-12
HIDDEN = ('hidden_x', 'hidden_y', 'hidden_z')  # direction of the strain that is hidden
# Square of the displacements by a strain, relative to the largest, from which it is one: those of
# a flat phantom along its normal turn or enlarge it, which no image shows.
MIN_DISPLACEMENT = 1e-4


@dataclass(frozen=True)
class Strain:
    """Strain of the survey against the images."""

    #: (3, 3) surveyed - true coordinates over the distance from the centre, without common scale
    tensor: NDArray[np.float64]
    rms_mm: float  #: RMS displacement of the beads by it [mm]
    #: statistic, and what chance exceeds with FALSE_ALARM
    test: float
    critical: float
    nse: float  #: increase of the NSE of the adjusted beads by it
    hidden_nse: float  #: the largest increase by a strain whose statistic would be critical
    hidden: NDArray[np.float64]  #: (3, 3) the tensor of that strain


def strain_of_survey(evidence: Evidence) -> Strain | None:
    """Return the strain of the survey that the exposures show; None with too few beads.

    Raises numpy.linalg.LinAlgError where the exposures do not determine the beads.
    """
    (solved,) = evidence.result.solved.values()
    survey = solved.measured.network.survey_mm
    if len(survey) < MIN_BEADS or solved.measured.network.datum != 'survey':
        return None
    tensors, displacement = _strains(survey)
    displacement = _without_similarity(displacement, survey, solved.measured.network.survey_sd_mm)
    score = _score(evidence, solved, displacement)
    shown = _strains_that_show(displacement)
    information = shown.T @ score.information @ shown
    t = np.linalg.solve(information, shown.T @ score.pull)
    critical = SD_FACTOR**2 * _dispersion(evidence) * float(chdtri(len(t), FALSE_ALARM))
    variance = np.diagonal(evidence.result.targets.covariance, axis1=1, axis2=2)
    of_points = (score.followed / np.sqrt(variance)[..., None]).reshape(-1, STRAINS) @ shown
    harm = of_points.T @ of_points / len(of_points)
    hidden, modes = eigh(critical * harm, information)
    return Strain(
        np.tensordot(shown @ t, tensors, 1),
        rms_mm=float(np.sqrt(np.mean(np.sum((displacement @ (shown @ t)) ** 2, axis=1)))),
        test=float(t @ information @ t),
        critical=critical,
        nse=float(t @ harm @ t),
        hidden_nse=float(hidden[-1]),
        hidden=np.tensordot(np.sqrt(critical) * (shown @ modes[:, -1]), tensors, 1),
    )


@dataclass(frozen=True)
class _Score:
    """Normal equations of strains, all other unknowns eliminated.

    information (5, 5), pull (5,): their right side; followed (n, 3, 5): displacements of the
    adjusted beads by unit strains [mm].
    """

    information: NDArray[np.float64]
    pull: NDArray[np.float64]
    followed: NDArray[np.float64]


def _score(evidence: Evidence, solved: SolvedNetwork, displacement: NDArray[np.float64]) -> _Score:
    """Normal equations of strains with displacements (n, 3, 5), linearised at an adjustment."""
    network = solved.measured.network
    adjustment = solved.adjustment
    names = solved.measured.fluoroscopes
    functions = [_change(evidence, network, f, name) for f, name in enumerate(names)]
    free = [evidence.calibrations[name].interior_estimated for name in names]
    network = replace(network, interior_free=np.array(free), additional=tuple(functions))
    parameters = replace(
        adjustment.parameters, additional=tuple(np.zeros(one.count) for one in functions)
    )
    factor = adjustment.noise.information_factor(adjustment.q)
    equations = normal_equations(network, parameters, solved.correction, adjustment.noise, factor)
    matrix = factorize(network, equations)
    weighted = displacement / network.survey_sd_mm[:, None, None] ** 2
    followed = covariance_times_points(matrix, weighted).points
    step = matrix.solve(UnknownVector(equations.e, equations.p, equations.g)).points[..., 0]
    left = network.survey_mm - parameters.points_mm - step
    return _Score(
        np.einsum('nai,naj->ij', weighted, displacement - followed),
        np.einsum('nai,na->i', weighted, left),
        followed,
    )


def _dispersion(evidence: Evidence) -> float:
    """Factor by which low-order terms of the exposures vary more than noise makes them.

    A strain shows in such terms, and so does a distortion that differs between exposures, by which
    the statistic grows (McCullagh and Nelder, "Generalized Linear Models", 1989, 4.5).
    """
    found = [one.chi2_per_dof / VARYING for one in evidence.variations.values() if one is not None]
    return max((1.0, *found))


def _change(evidence: Evidence, network: Network, f: int, name: str) -> AdditionalParameters:
    """Cubic change of the correction of fluoroscope f by about what it claims."""
    calibration = evidence.calibrations[name]
    rows = network.rows(f)
    functions = exposure_functions(network.uv[rows], calibration.image_size, calibration.interior)
    claimed = max(evidence.trends[name].claimed_sd, 1e-3 * calibration.image_sd)
    return AdditionalParameters(functions, np.eye(functions.shape[2]) / claimed**2)


def _strains(survey_mm: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Tensors (5, 3, 3) of unit strains, and displacements (n, 3, 5) [mm] of beads by them."""
    tensors = np.zeros((STRAINS, 3, 3))
    tensors[0] = np.diag([1.0, -1.0, 0.0]) / np.sqrt(2)
    tensors[1] = np.diag([1.0, 1.0, -2.0]) / np.sqrt(6)
    for tensor, (i, j) in zip(tensors[2:], ((0, 1), (0, 2), (1, 2))):
        tensor[i, j] = tensor[j, i] = 1 / np.sqrt(2)
    offset = survey_mm - survey_mm.mean(axis=0)
    return tensors, np.einsum('tab,nb->nat', tensors, offset)


def _without_similarity(
    displacement: NDArray[np.float64], survey_mm: NDArray[np.float64], sd_mm: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Displacements (n, 3, 5) less their shift, rotation and scale, which the poses take up."""
    similarity = similarity_directions(survey_mm, survey_mm.mean(axis=0))
    weight = 1 / sd_mm[:, None, None]
    rows = 3 * len(survey_mm)
    left = (weight * similarity).reshape(rows, -1)
    right = (weight * displacement).reshape(rows, STRAINS)
    return displacement - similarity @ np.linalg.lstsq(left, right, rcond=None)[0]


def _strains_that_show(displacement: NDArray[np.float64]) -> NDArray[np.float64]:
    """Strains (5, k) that displace beads (n, 3, 5), as columns of unit length."""
    of_beads = displacement.reshape(-1, STRAINS)
    values, vectors = np.linalg.eigh(of_beads.T @ of_beads)
    return vectors[:, values > MIN_DISPLACEMENT * values[-1]]


def check_shape(evidence: Evidence, names: Sequence[str]) -> list[Check]:
    """Test the survey of all beads for a strain that they have in common."""
    found = strain_of_survey(evidence)
    if found is None:
        return []  # check 'beads' says that there are too few
    value = found.rms_mm
    significant = value * np.sqrt(found.critical / max(found.test, TINY))
    matters = value * np.sqrt(HARMLESS_NSE / max(found.nse, TINY))
    direction, size = _principal(found.tensor)
    hidden_direction, hidden_size = _principal(found.hidden)
    return [
        Check(
            Kind.SHAPE,
            f'the survey of the phantom is strained against the images by {1e2 * size:+.3f} % '
            f'along {_text(direction)}, which displaces beads by {value:.3f} mm (RMS)',
            advice='survey the phantom again, or give a larger sd, and calibrate again',
            numbers={
                'strain': size,
                'test': found.test,
                'critical': found.critical,
                'nse': found.nse,
                'hidden_nse': found.hidden_nse,
                'hidden_strain': hidden_size,
                **dict(zip(HIDDEN, hidden_direction.tolist())),
            },
            value=value,
            limit=max(significant, matters),
            unit='mm',
        )
    ]


def trusted_shape(checks: Sequence[Check]) -> list[Finding]:
    """Return a finding where the exposures cannot tell a strain of the survey that matters."""
    out = []
    for check in checks:
        hidden_nse = check.numbers.get('hidden_nse', 0.0)
        if check.kind is Kind.SHAPE and hidden_nse > TRUSTED_NSE:
            size = abs(check.numbers['hidden_strain'])
            along = _text(np.array([check.numbers[name] for name in HIDDEN]))
            out.append(
                Finding(
                    Kind.TAKEN_ON_TRUST,
                    f'the shape of the phantom is taken on trust: a strain of {1e2 * size:.2f} % '
                    f'along {along} would not be seen in these exposures, and make the errors of '
                    f'beads {np.sqrt(1 + hidden_nse):.1f} times their standard deviations',
                    Place(name=''),
                    'tilt the phantom about more than one axis',
                    severity=Severity.NOTE,
                    numbers={'strain': size, 'nse': hidden_nse},
                )
            )
    return out


def _principal(tensor: NDArray[np.float64]) -> tuple[NDArray[np.float64], float]:
    """Direction (3,) of the largest strain, its largest coordinate positive, and that strain."""
    values, vectors = np.linalg.eigh(tensor)
    largest = int(np.argmax(np.abs(values)))
    direction = vectors[:, largest]
    return direction * np.sign(direction[np.argmax(np.abs(direction))]), float(values[largest])


def _text(direction: NDArray[np.float64]) -> str:
    x, y, z = direction + 0.0
    return f'({x:.2f}, {y:.2f}, {z:.2f})'


SHAPE = Subject(check_shape, of_rig=True)
