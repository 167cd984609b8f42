# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Doubtful image points and what the table suggests: docs/how_good.md has the results.

    python -m benchmarks.decisions [--seeds 10] [--write docs/how_good.md]

Beads of the virtual rig get the ids of other beads nearby. A calibration lists what does not fit;
the suggestion is the first target that a point may be, or to exclude it. Then all suggestions are
followed, and calibrations from the frames before and after reconstruct the beads in exposures
that neither of them used.
"""

import argparse
import sys
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fluoro_calib_ros.checks.residual_tests import doubtful_observations
from fluoro_calib_ros.errors import DataError
from fluoro_calib_ros.estimation.options import CalibrationRequest
from fluoro_calib_ros.exposures.decisions import Doubtful, PointDecision, decided
from fluoro_calib_ros.exposures.frame import Frame
from fluoro_calib_ros.jobs.calibration import run_calibration
from fluoro_calib_ros.simulation.rig import Detection, VirtualRig, simulate_exposures, virtual_rig
from tools.sections import show_section

from .survey import Case, out_of_sample

EXPOSURES = 15
SAME_PX = 5.0  # maximum distance of an image point from its bead, in sd of the noise
CASES = (0.0, 0.01, 0.05, 0.2)  # fractions of the beads that get a wrong id
Frames = Mapping[str, Sequence[Frame]]


def true_ids(
    rig: VirtualRig, frames: Frames, poses: Sequence[Any]
) -> dict[tuple[str, int, int], set[int]]:
    """Return the possible beads of each image point, by fluoroscope, exposure and given id."""
    out: dict[tuple[str, int, int], set[int]] = {}
    noise = Detection().noise_px
    for fluoroscope in rig.fluoroscopes:
        for frame, (rotation, shift) in zip(frames[fluoroscope.name], poses):
            ideal = fluoroscope.ideal(rig.true_mm @ rotation.T + shift)
            places = fluoroscope.distortion.distort(ideal)
            for target, uv in zip(frame.target_id.tolist(), frame.uv):
                near = np.linalg.norm(places - uv, axis=1) < SAME_PX * noise
                ids: NDArray[np.int64] = rig.phantom.target_id[near]
                out[fluoroscope.name, frame.number, target] = set(ids.tolist())
    return out


def suggested(doubtful: Iterable[Doubtful]) -> list[PointDecision]:
    """Return the decisions that follow all suggestions."""
    return [
        PointDecision('', one.fluoroscope, one.first, one.last, one.target_id, new_id)
        for one in doubtful
        for new_id in (one.others[:1] or (None,))
    ]


def measured(part: float, seed: int) -> tuple[Counter[str], float, float]:
    """Return counts of suggestions, and errors [mm] before and after following all of them."""
    rig = virtual_rig(seed)
    simulated = simulate_exposures(rig, EXPOSURES, seed, Detection(false_matches=part))
    truth = true_ids(rig, simulated.frames, simulated.poses)
    outcome = run_calibration(CalibrationRequest(simulated.frames, rig.phantom, joint=True))
    doubtful = doubtful_observations(outcome.result)
    false = {key for key, ids in truth.items() if key[2] not in ids}
    count = Counter(points=len(truth), false=len(false))
    for found in doubtful:
        if found.target_id is None:
            count['exposures'] += 1
            continue
        key = (found.fluoroscope, found.first, found.target_id)
        count['listed'] += key in false
        if found.others:
            count['renamed'] += 1
            count['right'] += found.others[0] in truth[key]
        else:
            count['left out'] += 1
            count['left out, true'] += key not in false
    before, after = errors(Case(rig, rig.phantom, simulated.frames, ()), doubtful, seed)
    return count, before, after


def errors(one: Case, doubtful: Sequence[Doubtful], seed: int) -> tuple[float, float]:
    """Return errors [mm] in unused exposures, with the original frames and after decisions."""
    before = out_of_sample(one, one.rig.phantom, one.frames, seed)
    if not doubtful:
        return before, before
    try:
        repaired, _ = decided(one.frames, suggested(doubtful))
    except DataError as error:  # two points with the same suggestion
        print(f'seed {seed}{error}', file=sys.stderr)
        return before, float('nan')
    return before, out_of_sample(one, one.rig.phantom, repaired, seed)


def row(seeds: Iterable[int], part: float) -> str:
    """Return the table row of a case."""
    count: Counter[str] = Counter()
    both = []
    for seed in seeds:
        found, *of_seed = measured(part, seed)
        count += found
        both.append(of_seed)
    before, after = np.mean(both, axis=0)  # NaN if a table was refused
    refused = int(np.isnan(both).any(axis=1).sum())
    return (
        f'| {100 * part:g} % | {count["false"]} of {count["points"]} | {count["listed"]} | '
        f'{count["right"]} of {count["renamed"]} | '
        f'{count["left out, true"]} of {count["left out"]} | {count["exposures"]} | {refused} | '
        f'{before:.4f} | {after:.4f} |'
    )


def section(seeds: int) -> str:
    """Return the section of docs/how_good.md."""
    lines = [
        '## Doubtful image points',
        '',
        f'Generated by `python -m benchmarks.decisions --seeds {seeds}`: {seeds} virtual rigs '
        f'each, {EXPOSURES} exposures of two fluoroscopes. A\nfraction of the beads has the id of '
        'one of its eight neighbours in the image. `doubtful.csv` suggests the first target of '
        '`may_be`, or\nto leave the point out. The errors are those of distances between beads in '
        'unused exposures, before and after taking all suggestions.',
        '',
        '| wrong ids | points with one | listed | suggested ids that are right | true points that '
        'would be left out | exposures listed | tables refused | error before [mm] | after [mm] |',
        '| --- | --- | --- | --- | --- | --- | --- | --- | --- |',
        *(row(range(seeds), part) for part in CASES),
        '',
    ]
    return '\n'.join(lines)


def main() -> None:
    """Measure, and write the section."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--seeds', type=int, default=10)
    parser.add_argument('--write', type=Path, metavar='PAGE')
    arguments = parser.parse_args()
    show_section(section(arguments.seeds), arguments.write, 'doubtful image points')


if __name__ == '__main__':
    main()
