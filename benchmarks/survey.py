# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Surveys of a phantom from its own exposures: docs/how_good.md has the results.

    python -m benchmarks.survey [--seeds 10] [--write docs/how_good.md]

The phantom in hand is 0.3 % larger than its drawing, and its beads lie 1 mm from it in each
coordinate. Three distances between beads are measured with a standard deviation of 0.02 mm. Then
calibrations with the true coordinates, the surveyed ones and those of the drawing, from other
exposures, reconstruct the beads in exposures that none of them used. Errors of the distances
between beads do not depend on the choice of a frame.
"""

import argparse
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from fluoro_calib_ros.errors import DataError
from fluoro_calib_ros.estimation.options import CalibrationRequest
from fluoro_calib_ros.estimation.survey import MeasuredDistance, SurveyedBeads
from fluoro_calib_ros.exposures.frame import Frame
from fluoro_calib_ros.exposures.phantom import Drawing, Phantom
from fluoro_calib_ros.findings import Kind
from fluoro_calib_ros.jobs.calibration import run_calibration
from fluoro_calib_ros.jobs.reconstruction import ReconstructionOptions, reconstruct
from fluoro_calib_ros.jobs.survey import SurveyOutcome, SurveyRequest, survey
from fluoro_calib_ros.simulation.rig import BEADS as CUBE_BEADS
from fluoro_calib_ros.simulation.rig import Detection, VirtualRig, simulate_exposures, virtual_rig
from tools.sections import show_section

GROWN = 1.003
DRAWING_SD_MM = 1.0
CLAIMED_SD_MM = 0.1  # stated for the drawing if it is taken for a survey
CALIPER_SD_MM = 0.02
DISTANCES = 3
FROM_MM = 150.0  # minimum distance between the beads of a measured distance
EXACT_SD_MM = 1e-3
OTHERS = 500  # offset of the seed of other exposures
TESTED = 900
BLOCK = Drawing(4, 4, 4, pitch_mm=(45.0, 45.0, 45.0))
SMALL_BLOCK = Drawing(3, 3, 2, pitch_mm=(60.0, 60.0, 80.0))
# Drawing of the phantom, exposures, fluoroscopes.
CASES = (
    (None, 15, 2),
    (None, 30, 2),
    (None, 8, 2),
    (None, 6, 2),
    (None, 15, 1),
    (BLOCK, 15, 2),
    (SMALL_BLOCK, 15, 2),
)


@dataclass(frozen=True)
class Case:
    """An actual phantom, its drawing, its exposures and its measured distances."""

    rig: VirtualRig
    drawing: Phantom
    frames: Mapping[str, Sequence[Frame]]
    distances: Sequence[MeasuredDistance]


def case(drawn: Drawing | None, seed: int, exposures: int, fluoroscopes: int) -> Case:
    """Draw a random case; drawn: drawing of the phantom, by default the phantom of the rig."""
    rng = np.random.default_rng([seed, 9])
    rig = virtual_rig(seed, names=('a', 'b')[:fluoroscopes])
    if drawn is not None:
        places = drawn.places_mm - drawn.places_mm.mean(axis=0)
        rig = replace(rig, true_mm=places, phantom=drawn.phantom())
    rig = replace(rig, true_mm=rig.true_mm * GROWN)
    noise = rng.normal(0, DRAWING_SD_MM, rig.true_mm.shape)
    ids = rig.phantom.target_id
    drawing = Phantom(ids, rig.true_mm / GROWN + noise, np.full(len(ids), DRAWING_SD_MM))
    frames = simulate_exposures(rig, exposures, seed).frames
    shown = np.concatenate([f.target_id for each in frames.values() for f in each])
    often = np.flatnonzero(np.bincount(shown, minlength=len(ids) + 1) >= 4)
    distances: list[MeasuredDistance] = []
    while len(distances) < DISTANCES:
        first, second = rng.choice(often, 2, replace=False).tolist()
        length = float(np.linalg.norm(rig.true_mm[first - 1] - rig.true_mm[second - 1]))
        if length > FROM_MM:
            length += rng.normal(0, CALIPER_SD_MM)
            distances.append(MeasuredDistance(first, second, length, CALIPER_SD_MM))
    return Case(rig, drawing, frames, distances)


def errors(beads: SurveyedBeads, rig: VirtualRig) -> tuple[np.ndarray, float]:
    """Return errors (n, 3) [mm] of beads after a rigid motion, and their relative scale error."""
    true = rig.true_mm[rig.phantom.index(beads.target_id)]
    true = true - true.mean(axis=0)
    found = beads.xyz_mm - beads.xyz_mm.mean(axis=0)
    u, _, vt = np.linalg.svd(found.T @ true)
    turn = u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt
    true = true @ turn.T
    return found - true, float(np.sum(found * true) / np.sum(true**2)) - 1


def figures(one: Case, outcome: SurveyOutcome) -> dict[str, float]:
    """Return the figures of a survey."""
    beads = outcome.beads
    off, scale = errors(beads, one.rig)
    square = np.einsum('na,nab,nb->', off, np.linalg.inv(beads.covariance), off)
    checks = {check.kind: check for check in outcome.validation.checks}
    return {
        'beads': len(off),
        'sd': float(np.median(beads.sd_mm)),
        'rmse': float(np.sqrt(np.mean(off**2))),
        'nse': float(square / off.size),
        'scale_sd': beads.scale_sd,
        'scale': scale / beads.scale_sd,
        'halves': checks[Kind.HALVES].value,
        'chi2': checks[Kind.DISTANCES].value,
        'passed': outcome.validation.verdict == 'pass',
    }


def out_of_sample(
    one: Case, phantom: Phantom, frames: Mapping[str, Sequence[Frame]], seed: int
) -> float:
    """Return RMS error [mm] of distances in unused exposures; NaN if calibration is refused."""
    test = simulate_exposures(one.rig, 20, seed + TESTED, Detection(false_matches=0)).frames
    try:
        outcome = run_calibration(CalibrationRequest(frames, phantom, joint=True))
    except DataError:
        return float('nan')
    if outcome.orientation is None:
        return float('nan')
    found = reconstruct(
        test,
        outcome.calibrations,
        outcome.orientation,
        ReconstructionOptions(drift_watch=False),
    )
    off = []
    for frame in found.frames:
        good = frame.points.status == 0
        xyz = frame.points.xyz_mm[good]
        true = one.rig.true_mm[one.rig.phantom.index(frame.target_id[good])]
        i, j = np.triu_indices(len(xyz), 1)
        lengths = [np.linalg.norm(points[i] - points[j], axis=1) for points in (xyz, true)]
        off.append(lengths[0] - lengths[1])
    return float(np.sqrt(np.mean(np.concatenate(off) ** 2)))


def compared(seed: int) -> dict[str, float]:
    """Return out-of-sample errors [mm] by source of the phantom coordinates."""
    one = case(None, seed, 15, 2)
    count = len(one.rig.true_mm)
    request = SurveyRequest(one.frames, one.drawing, one.distances, keep_given=True)
    surveyed = survey(request).phantom
    true = replace(one.drawing, xyz_mm=one.rig.true_mm, sd_mm=np.full(count, EXACT_SD_MM))
    claimed = replace(one.drawing, sd_mm=np.full(count, CLAIMED_SD_MM))
    others = simulate_exposures(one.rig, 15, seed + OTHERS).frames
    return {
        'true coordinates': out_of_sample(one, true, others, seed),
        'surveyed': out_of_sample(one, surveyed, others, seed),
        'surveyed, calibrated from the same exposures': out_of_sample(
            one, surveyed, one.frames, seed
        ),
        'drawing, sd 1 mm': out_of_sample(one, one.drawing, others, seed),
        'drawing, sd 0.1 mm': out_of_sample(one, claimed, others, seed),
    }


def row(seeds: Iterable[int], drawn: Drawing | None, exposures: int, fluoroscopes: int) -> str:
    """Return the table row of a case."""
    found = []
    for seed in seeds:
        one = case(drawn, seed, exposures, fluoroscopes)
        found.append(figures(one, survey(SurveyRequest(one.frames, one.drawing, one.distances))))
    mean = {name: float(np.mean([each[name] for each in found])) for name in found[0]}
    scale = np.mean([each['scale'] ** 2 for each in found])
    nse = [each['nse'] for each in found]
    halves = max(each['halves'] for each in found)
    passed = sum(bool(each['passed']) for each in found)
    size = CUBE_BEADS if drawn is None else len(drawn.places_mm)
    return (
        f'| {size} | {exposures} | {fluoroscopes} | {mean["beads"]:.0f} | {mean["sd"]:.3f} | '
        f'{mean["rmse"]:.3f} | {mean["nse"]:.2f} ({min(nse):.2f} to {max(nse):.2f}) | '
        f'{1e6 * mean["scale_sd"]:.0f} | {scale:.2f} | {mean["chi2"]:.2f} | {halves:.2f} | '
        f'{passed} of {len(found)} |'
    )


def section(seeds: int) -> str:
    """Return the section of docs/how_good.md."""
    lines = [
        '## Survey of a phantom',
        '',
        f'Generated by `python -m benchmarks.survey --seeds {seeds}`: {seeds} virtual rigs each. '
        f'The phantom is 0.3 % larger\nthan its drawing, whose coordinates are off by '
        f'{DRAWING_SD_MM:g} mm; {DISTANCES} distances of more than {FROM_MM:.0f} mm between beads '
        f'are\nmeasured to {CALIPER_SD_MM:g} mm. NSE: mean of (error / stated sd)^2 of the '
        'coordinates with their covariances, after a\nrigid motion, and its range over the rigs; '
        'also of the scale. chi2 of the distances: 2 is expected. Halves: the largest value\nof '
        'the check, whose limit is 1.5 (1.8 for 18 beads).',
        '',
        '| phantom | exposures | fluoroscopes | surveyed | sd [mm] | RMSE [mm] | NSE | '
        'sd of scale [ppm] | NSE of scale | chi2 | halves | pass |',
        '|---:|---:|---:|---:|---:|---:|---|---:|---:|---:|---:|---|',
        *(row(range(seeds), *each) for each in CASES),
        '',
        'Calibrations from 15 other exposures, joint, and the RMS error of distances between the '
        'beads that they reconstruct in 20\nexposures without false matches '
        'that were not used before:',
        '',
        '| coordinates | RMS error of distances [mm] | refused |',
        '|---|---:|---:|',
    ]
    found = [compared(seed) for seed in range(seeds)]
    for name in found[0]:
        values = np.array([each[name] for each in found])
        refused = int(np.isnan(values).sum())
        mean = '-' if refused == len(values) else f'{np.nanmean(values):.3f}'
        lines.append(f'| {name} | {mean} | {refused} of {len(values)} |')
    return '\n'.join(lines)


def main() -> None:
    """Print the section, or write it into the page."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--seeds', type=int, default=10)
    parser.add_argument('--write', type=Path)
    arguments = parser.parse_args()
    show_section(section(arguments.seeds), arguments.write, 'survey')


if __name__ == '__main__':
    main()
