# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Check 'shape': the phantom as a whole has the shape stated by its survey.

A phantom that has shrunk along one axis, or is sheared, displaces every bead by less than the
standard deviation of its survey, but all of them together by far more than chance does. The survey
is modelled as S = X + D t + noise with the beads X and five strains t (a common scale has to be
taken on trust, as the images do not show it). The test of t = 0 against this alternative is the
score test (Rao, Proceedings of the Cambridge Philosophical Society 44, 1948): one step from the
adjustment, with exterior orientations, interior orientations and a cubic change of each correction
among the unknowns. The effect of t on the adjusted beads, over their claimed standard deviations,
decides whether it matters. The smallest t that the test would detect decides whether the exposures
can show it (Baarda, "A testing procedure for use in geodetic networks", Netherlands Geodetic
Commission 1968).
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
from .beads import MIN_BEADS, SD_FACTOR
from .calibration_evidence import Evidence, Subject
from .check import Check

STRAINS = 5  # symmetric tensors, without the common scale
# Harmless increase of the NSE of the points by a strain: up to 1.25 it is acceptable.
HARMLESS_NSE = 0.25
# Increase of the NSE by an undetectable strain above which the shape is taken on trust.
TRUSTED_NSE = 1.0
TINY = 1e-12
HIDDEN = ('hidden_x', 'hidden_y', 'hidden_z')  # direction of the undetectable strain
# Minimum square of the displacements by a strain, relative to the largest. Along the normal of a
# flat phantom, strains only rotate or enlarge it, which no image shows.
MIN_DISPLACEMENT = 1e-4


@dataclass(frozen=True)
class Strain:
    """Strain of the survey relative to the images."""

    #: (3, 3) surveyed - true coordinates over the distance from the centre, without common scale
    tensor: NDArray[np.float64]
    rms_mm: float  #: RMS displacement of the beads by the strain [mm]
    #: test statistic, and the value that chance exceeds with probability FALSE_ALARM
    test: float
    critical: float
    nse: float  #: increase of the NSE of the adjusted beads by the strain
    hidden_nse: float  #: largest increase by a strain whose test statistic equals critical
    hidden: NDArray[np.float64]  #: (3, 3) tensor of that strain


def strain_of_survey(evidence: Evidence) -> Strain | None:
    """Return the strain of the survey that the exposures show, or None with too few beads.

    Raises numpy.linalg.LinAlgError if the exposures do not determine the beads.
    """
    (solved,) = evidence.result.solved.values()
    survey = solved.measured.network.survey_mm
    if len(survey) < MIN_BEADS or solved.measured.network.datum != 'survey':
        return None
    tensors, displacement = _strains(survey)
    displacement = _without_similarity(displacement, survey, solved.measured.network.survey_sd_mm)
    score = _score(evidence, solved, displacement)
    visible = _strains_that_show(displacement)
    information = visible.T @ score.information @ visible
    t = np.linalg.solve(information, visible.T @ score.pull)
    critical = SD_FACTOR**2 * _dispersion(evidence) * float(chdtri(len(t), FALSE_ALARM))
    variance = np.diagonal(evidence.result.targets.covariance, axis1=1, axis2=2)
    standardised = (score.followed / np.sqrt(variance)[..., None]).reshape(-1, STRAINS) @ visible
    nse_matrix = standardised.T @ standardised / len(standardised)
    hidden, modes = eigh(critical * nse_matrix, information)
    return Strain(
        np.tensordot(visible @ t, tensors, 1),
        rms_mm=float(np.sqrt(np.mean(np.sum((displacement @ (visible @ t)) ** 2, axis=1)))),
        test=float(t @ information @ t),
        critical=critical,
        nse=float(t @ nse_matrix @ t),
        hidden_nse=float(hidden[-1]),
        hidden=np.tensordot(np.sqrt(critical) * (visible @ modes[:, -1]), tensors, 1),
    )


@dataclass(frozen=True)
class _Score:
    """Normal equations of strains, with all other unknowns eliminated.

    information (5, 5); pull (5,): right-hand side; followed (n, 3, 5): displacements of the
    adjusted beads by unit strains [mm].
    """

    information: NDArray[np.float64]
    pull: NDArray[np.float64]
    followed: NDArray[np.float64]


def _score(evidence: Evidence, solved: SolvedNetwork, displacement: NDArray[np.float64]) -> _Score:
    """Return normal equations of strains with displacements (n, 3, 5), at an adjustment."""
    network = solved.measured.network
    adjustment = solved.adjustment
    names = solved.measured.fluoroscopes
    functions = [_change(evidence, network, f, name) for f, name in enumerate(names)]
    free = [evidence.calibrations[name].interior_estimated for name in names]
    network = replace(network, interior_free=np.array(free), additional=tuple(functions))
    parameters = replace(
        adjustment.parameters, additional=tuple(np.zeros(added.count) for added in functions)
    )
    factor = adjustment.noise.information_factor(adjustment.q)
    equations = normal_equations(network, parameters, solved.correction, adjustment.noise, factor)
    matrix = factorize(network, equations)
    weighted = displacement / network.survey_sd_mm[:, None, None] ** 2
    followed = covariance_times_points(matrix, weighted).points
    step = matrix.solve(equations.right).points
    misclosure = network.survey_mm - parameters.points_mm - step
    return _Score(
        np.einsum('nai,naj->ij', weighted, displacement - followed),
        np.einsum('nai,na->i', weighted, misclosure),
        followed,
    )


def _dispersion(evidence: Evidence) -> float:
    """Return the factor by which low-order terms of the exposures vary more than noise explains.

    A strain shows in such terms, as does a distortion that differs between exposures, which
    inflates the statistic (McCullagh and Nelder, "Generalized Linear Models", 1989, 4.5).
    """
    ratios = [
        variation.chi2_per_dof / VARYING
        for variation in evidence.variations.values()
        if variation is not None
    ]
    return max((1.0, *ratios))


def _change(evidence: Evidence, network: Network, f: int, name: str) -> AdditionalParameters:
    """Return a cubic change of the correction of fluoroscope f, of about its claimed sd."""
    calibration = evidence.calibrations[name]
    rows = network.rows(f)
    functions = exposure_functions(network.uv[rows], calibration.image_size, calibration.interior)
    correction_sd = max(evidence.trends[name].claimed_sd, 1e-3 * calibration.image_sd)
    return AdditionalParameters(functions, np.eye(functions.shape[2]) / correction_sd**2)


def _strains(survey_mm: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return tensors (5, 3, 3) of unit strains, and displacements (n, 3, 5) [mm] of beads."""
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
    """Return displacements (n, 3, 5) without shift, rotation, scale, which the poses absorb."""
    similarity = similarity_directions(survey_mm, survey_mm.mean(axis=0))
    weight = 1 / sd_mm[:, None, None]
    rows = 3 * len(survey_mm)
    weighted = (weight * similarity).reshape(rows, -1)
    right = (weight * displacement).reshape(rows, STRAINS)
    return displacement - similarity @ np.linalg.lstsq(weighted, right, rcond=None)[0]


def _strains_that_show(displacement: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the strains (5, k) that displace beads (n, 3, 5), as columns of unit length."""
    flat = displacement.reshape(-1, STRAINS)
    values, vectors = np.linalg.eigh(flat.T @ flat)
    return vectors[:, values > MIN_DISPLACEMENT * values[-1]]


def check_shape(evidence: Evidence, names: Sequence[str]) -> list[Check]:
    """Test the survey for a strain that all beads have in common."""
    strain = strain_of_survey(evidence)
    if strain is None:
        return []  # reported by check 'beads'
    value = strain.rms_mm
    significant_mm = value * np.sqrt(strain.critical / max(strain.test, TINY))
    harmful_mm = value * np.sqrt(HARMLESS_NSE / max(strain.nse, TINY))
    direction, size = _principal(strain.tensor)
    hidden_direction, hidden_size = _principal(strain.hidden)
    return [
        Check(
            Kind.SHAPE,
            f'the survey of the phantom is strained relative to the images by {1e2 * size:+.3f} '
            f'% along {_text(direction)}, which displaces beads by {value:.3f} mm (RMS)',
            advice='survey the phantom again, or give a larger sd, and calibrate again',
            numbers={
                'strain': size,
                'test': strain.test,
                'critical': strain.critical,
                'nse': strain.nse,
                'hidden_nse': strain.hidden_nse,
                'hidden_strain': hidden_size,
                **dict(zip(HIDDEN, hidden_direction.tolist())),
            },
            value=value,
            limit=max(significant_mm, harmful_mm),
            unit='mm',
        )
    ]


def trusted_shape(checks: Sequence[Check]) -> list[Finding]:
    """Return a finding if the exposures cannot show a strain of the survey that matters."""
    out = []
    for check in checks:
        hidden_nse = check.numbers.get('hidden_nse', 0.0)
        if check.kind is Kind.SHAPE and hidden_nse > TRUSTED_NSE:
            size = abs(check.numbers['hidden_strain'])
            direction = _text(np.array([check.numbers[name] for name in HIDDEN]))
            out.append(
                Finding(
                    Kind.TAKEN_ON_TRUST,
                    'the exposures do not verify the shape of the phantom: a strain of '
                    f'{1e2 * size:.2f} % along {direction} would be undetected, and would make '
                    f'the errors of beads {np.sqrt(1 + hidden_nse):.1f} times their standard '
                    'deviations',
                    Place(name=''),
                    'tilt the phantom about more than one axis',
                    severity=Severity.NOTE,
                    numbers={'strain': size, 'nse': hidden_nse},
                )
            )
    return out


def _principal(tensor: NDArray[np.float64]) -> tuple[NDArray[np.float64], float]:
    """Return direction (3,) of the largest strain, its largest coordinate positive, and size."""
    values, vectors = np.linalg.eigh(tensor)
    largest = int(np.argmax(np.abs(values)))
    direction = vectors[:, largest]
    return direction * np.sign(direction[np.argmax(np.abs(direction))]), float(values[largest])


def _text(direction: NDArray[np.float64]) -> str:
    x, y, z = direction + 0.0
    return f'({x:.2f}, {y:.2f}, {z:.2f})'


SHAPE = Subject(check_shape, of_rig=True)
