# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Gain from joint adjustment and relative orientation constraint: `python -m benchmarks.relative`.

In every exposure, the fluoroscopes of a virtual rig see the phantom in the same pose. Errors refer
to the truth, for other exposures adjusted with fixed calibrations (adjust_with_calibrations).
"""

import argparse
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TextIO

import numpy as np

from fluoro_calib_ros.estimation.calibrate import adjust_with_calibrations, calibrate
from fluoro_calib_ros.estimation.options import CalibrationOptions
from fluoro_calib_ros.photogrammetry.rotations import matrix_from_vector
from fluoro_calib_ros.simulation.rig import (
    SimulatedExposures,
    StreamStart,
    VirtualRig,
    simulate_exposures,
    virtual_rig,
)

METHODS = {
    'separate': (False, 'none'),
    'joint': (True, 'none'),
    'joint, soft': (True, 'soft'),
    'joint, hard': (True, 'hard'),
}
TEST_EXPOSURES = 60


@dataclass(frozen=True)
class Gain:
    """Figures of one calibration.

    Attributes
    ----------
    points_mm, sources_mm : float
        Out-of-sample RMSE of object points and of sources (3-D).
    baseline_mm : float
        Out-of-sample RMSE of the distance between the two sources.
    sd_c : float
        Mean standard deviation of the principal distances [px].
    seconds : float
        Time of the calibration.
    kinds : str
        Kinds of the correction models.
    """

    points_mm: float
    sources_mm: float
    baseline_mm: float
    sd_c: float
    seconds: float
    kinds: str


def measure(
    rig: VirtualRig,
    training: SimulatedExposures,
    test: SimulatedExposures,
    method: str,
    model: str,
) -> Gain:
    """Return the gain of one calibration method from training exposures, on test exposures."""
    joint, relative = METHODS[method]
    began = time.perf_counter()
    job = calibrate(
        training.frames,
        rig.phantom,
        CalibrationOptions(model=model, relative_orientation=relative),
        joint,
    )
    seconds = time.perf_counter() - began
    found = adjust_with_calibrations(test.frames, rig.phantom, job.calibrations)
    points = found.targets.xyz_mm - rig.true_mm[found.targets.target_id - 1]
    first = {name: frames[0].number for name, frames in test.frames.items()}
    sources = []
    positions: dict[int, list[np.ndarray]] = {}
    for fluoroscope in rig.fluoroscopes:
        for exposure in found.fluoroscopes[fluoroscope.name].exposures:
            pose = test.poses[exposure.exposure - first[fluoroscope.name]]
            sources.append(exposure.position_mm - fluoroscope.exterior(pose)[1])
            positions.setdefault(exposure.exposure, []).append(exposure.position_mm)
    length = np.linalg.norm(rig.fluoroscopes[1].position_mm - rig.fluoroscopes[0].position_mm)
    errors = [np.linalg.norm(p[1] - p[0]) - length for p in positions.values() if len(p) == 2]
    return Gain(
        _rms(points),
        _rms(np.array(sources)),
        float(np.sqrt(np.mean(np.square(errors)))),
        float(np.mean([f.interior_sd[2] for f in job.fluoroscopes.values()])),
        seconds,
        '/'.join(f.model_kind for f in job.fluoroscopes.values()),
    )


def _rms(errors: np.ndarray) -> float:
    """Return the root mean square length of errors (n, 3)."""
    return float(np.sqrt(np.mean(np.sum(errors**2, axis=1))))


def simulate_flexible_rig(
    rig: VirtualRig, count: int, seed: int, flex_mm: float = 0.0, flex_rad: float = 0.0
) -> SimulatedExposures:
    """Simulate exposures of a rig whose last fluoroscope moves between exposures.

    flex_mm and flex_rad: standard deviations of its position and attitude.
    """
    if not flex_mm and not flex_rad:
        return simulate_exposures(rig, count, seed)
    rng = np.random.default_rng([seed, 9])
    last = rig.fluoroscopes[-1]
    simulated = []
    for _ in range(count):
        moved = replace(
            last,
            position_mm=last.position_mm + rng.normal(0, flex_mm, 3),
            rotation=matrix_from_vector(rng.normal(0, flex_rad, 3)) @ last.rotation,
        )
        flexed = replace(rig, fluoroscopes=(*rig.fluoroscopes[:-1], moved))
        simulated.append(simulate_exposures(flexed, count, seed))
    out = simulated[0]
    for j, exposures in enumerate(simulated):
        for name, frames in exposures.frames.items():
            out.frames[name][j] = frames[j]
    return out


def compare(
    counts: Sequence[int] = (5, 15),
    seeds: Sequence[int] = (1, 2, 3),
    model: str = 'auto',
    flex: tuple[float, float] = (0.0, 0.0),
    progress: TextIO = sys.stderr,
) -> dict[tuple[int, str], list[Gain]]:
    """Return gains {(count, method): [Gain of every seed]}.

    flex [mm, rad]: standard deviations of the rig motion during calibration.
    """
    out: dict[tuple[int, str], list[Gain]] = {}
    for seed in seeds:
        rig = virtual_rig(seed)
        test = simulate_exposures(
            rig, TEST_EXPOSURES, 10_000 + seed, start=StreamStart(number=1001)
        )
        for count in counts:
            training = simulate_flexible_rig(rig, count, 1000 * seed + count, *flex)
            for method in METHODS:
                gain = measure(rig, training, test, method, model)
                out.setdefault((count, method), []).append(gain)
                print(
                    f'seed {seed}, {count} exposures, {method}: {gain}', file=progress, flush=True
                )
    return out


def table(gains: Mapping[tuple[int, str], Sequence[Gain]]) -> str:
    """Return a Markdown table of the result of compare: root mean squares over the rigs."""
    lines = [
        '| exposures | adjustment | object points, 3-D [mm] | sources, 3-D [mm] | distance of the '
        'sources [mm] | sd of c [px] | time [s] |',
        '| ---: | --- | ---: | ---: | ---: | ---: | ---: |',
    ]
    for (count, method), of_seeds in gains.items():
        points, sources, baseline, sd_c = (
            np.sqrt(np.mean([getattr(g, name) ** 2 for g in of_seeds]))
            for name in ('points_mm', 'sources_mm', 'baseline_mm', 'sd_c')
        )
        seconds = np.mean([g.seconds for g in of_seeds])
        lines.append(
            f'| {count} | {method} | {points:.4f} | {sources:.3f} | {baseline:.3f} | {sd_c:.3f} '
            f'| {seconds:.1f} |'
        )
    return '\n'.join(lines)


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(prog='python -m benchmarks.relative', description=__doc__)
    parser.add_argument(
        '--counts', default='5,15', help='exposures of the calibration (default: 5,15)'
    )
    parser.add_argument('--seeds', default='1,2,3', help='virtual rigs (default: 1,2,3)')
    parser.add_argument('--model', default='auto', help='correction model (default: auto)')
    parser.add_argument(
        '--flex',
        default='0,0',
        help='movement of a fluoroscope between exposures [mm,rad] (default: 0,0, a rigid rig)',
    )
    options = parser.parse_args(arguments)
    counts, seeds = (
        tuple(int(v) for v in text.split(',')) for text in (options.counts, options.seeds)
    )
    flex_mm, flex_rad = (float(v) for v in options.flex.split(','))
    print(table(compare(counts, seeds, options.model, (flex_mm, flex_rad))))


if __name__ == '__main__':
    main()
