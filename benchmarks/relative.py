"""What the joint adjustment and the relative orientation constraint gain: `python -m
benchmarks.relative`.

Virtual rigs whose fluoroscopes see the phantom in the same pose in every exposure. Errors are
those of other exposures, adjusted with the calibration held fixed (adjust_with_calibrations),
against the truth of the rig.
"""

import argparse
import sys
import time
from dataclasses import dataclass, replace

import numpy as np

from fluoro_calib_ros.calibration.calibrate import adjust_with_calibrations, calibrate
from fluoro_calib_ros.calibration.options import CalibrationOptions
from fluoro_calib_ros.photogrammetry.rotations import matrix_from_vector
from fluoro_calib_ros.simulation.rig import simulate_exposures, virtual_rig

WAYS = {
    'separate': (False, 'none'),
    'joint': (True, 'none'),
    'joint, soft': (True, 'soft'),
    'joint, hard': (True, 'hard'),
}
TEST_EXPOSURES = 60


@dataclass(frozen=True)
class Gain:
    """Figures of one calibration: RMSE of object points (3-D), of sources (3-D) and of the
    distance between the two sources [mm], out of sample; sd_c: mean standard deviation of the
    principal distances [px]; seconds; kinds of model.
    """

    points_mm: float
    sources_mm: float
    baseline_mm: float
    sd_c: float
    seconds: float
    kinds: str


def measure(rig, training, test, way, model):
    """Gain of one way to calibrate the frames training, on the SimulatedExposures test."""
    joint, relative = WAYS[way]
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
    placed = {}
    for fluoroscope in rig.fluoroscopes:
        for exposure in found.fluoroscopes[fluoroscope.name].exposures:
            pose = test.poses[exposure.exposure - first[fluoroscope.name]]
            sources.append(exposure.position_mm - fluoroscope.exterior(pose)[1])
            placed.setdefault(exposure.exposure, []).append(exposure.position_mm)
    length = np.linalg.norm(rig.fluoroscopes[1].position_mm - rig.fluoroscopes[0].position_mm)
    off = [np.linalg.norm(p[1] - p[0]) - length for p in placed.values() if len(p) == 2]
    return Gain(
        _rms(points),
        _rms(np.array(sources)),
        float(np.sqrt(np.mean(np.square(off)))),
        float(np.mean([f.interior_sd[2] for f in job.fluoroscopes.values()])),
        seconds,
        '/'.join(f.model_kind for f in job.fluoroscopes.values()),
    )


def _rms(errors):
    """Root mean square length of errors (n, 3)."""
    return float(np.sqrt(np.mean(np.sum(errors**2, axis=1))))


def exposures_of(rig, count, seed, flex_mm=0.0, flex_rad=0.0):
    """SimulatedExposures of a rig whose last fluoroscope moves between the exposures, by these
    standard deviations.
    """
    if not flex_mm and not flex_rad:
        return simulate_exposures(rig, count, seed)
    rng = np.random.default_rng([seed, 9])
    out = None
    for j in range(count):
        last = rig.fluoroscopes[-1]
        moved = replace(
            last,
            position_mm=last.position_mm + rng.normal(0, flex_mm, 3),
            rotation=matrix_from_vector(rng.normal(0, flex_rad, 3)) @ last.rotation,
        )
        this = simulate_exposures(
            replace(rig, fluoroscopes=(*rig.fluoroscopes[:-1], moved)), count, seed
        )
        out = this if out is None else out
        for name, frames in this.frames.items():
            out.frames[name][j] = frames[j]
    return out


def compare(counts=(5, 15), seeds=(1, 2, 3), model='auto', flex=(0.0, 0.0), told=sys.stderr):
    """{(count, way): [Gain of every seed]}; flex: of the rig while it is calibrated [mm, rad]."""
    out = {}
    for seed in seeds:
        rig = virtual_rig(seed)
        test = simulate_exposures(rig, TEST_EXPOSURES, 10_000 + seed, first_number=1001)
        for count in counts:
            training = exposures_of(rig, count, 1000 * seed + count, *flex)
            for way in WAYS:
                gain = measure(rig, training, test, way, model)
                out.setdefault((count, way), []).append(gain)
                print(f'seed {seed}, {count} exposures, {way}: {gain}', file=told, flush=True)
    return out


def table(gains):
    """Markdown table of the outcome of compare: means over the rigs, squares averaged."""
    lines = [
        '| exposures | adjustment | object points, 3-D [mm] | sources, 3-D [mm] | distance of the '
        'sources [mm] | sd of c [px] | time [s] |',
        '| ---: | --- | ---: | ---: | ---: | ---: | ---: |',
    ]
    for (count, way), of_seeds in gains.items():
        points, sources, baseline, sd_c = (
            np.sqrt(np.mean([getattr(g, name) ** 2 for g in of_seeds]))
            for name in ('points_mm', 'sources_mm', 'baseline_mm', 'sd_c')
        )
        seconds = np.mean([g.seconds for g in of_seeds])
        lines.append(
            f'| {count} | {way} | {points:.4f} | {sources:.3f} | {baseline:.3f} | {sd_c:.3f} '
            f'| {seconds:.1f} |'
        )
    return '\n'.join(lines)


def main(arguments=None):
    """Entry point: the table on standard output."""
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
    flex = tuple(float(v) for v in options.flex.split(','))
    print(table(compare(counts, seeds, options.model, flex)))


if __name__ == '__main__':
    main()
