"""Speed, side by side in one run: the self-calibration, and the correction of frames against scikit-learn."""

import sys
import time
from pathlib import Path

import numpy as np
from sklearn.neighbors import KNeighborsRegressor
from threadpoolctl import threadpool_limits

from fluoro_calib_ros.calibration.job import calibrate
from fluoro_calib_ros.calibration.self_calibration import Options
from fluoro_calib_ros.simulation.rig import simulate_exposures, virtual_rig

REPEATS = 5


def median_seconds(function, repeats=REPEATS):
    """Median of the wall times of repeated calls [s]."""
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        function()
        times.append(time.perf_counter() - start)
    return float(np.median(times))


def self_calibrations(rig, frames):
    """Rows: seconds of a self-calibration of one fluoroscope, choice of k included."""
    for model in ('local_linear', 'knn', 'none'):
        job = []
        seconds = median_seconds(lambda: job.append(calibrate({'a': frames}, rig.phantom, Options(model))), 3)
        figures, rounds = job[0].fluoroscopes['a'], len(job[0].history['a'])
        yield [f'self-calibration, {model}', f'{len(frames)} exposures, {figures.observations} image points',
               f'{seconds:.2f} s', f'{rounds} rounds, k = {figures.k}']


def corrections(calibration, knn):
    """Rows: time of a correction of one frame, prepared and not, beside scikit-learn's k nearest neighbours."""
    rng = np.random.default_rng(0)
    for targets in (30, 503, 2028):
        uv = rng.uniform(80, 940, (targets, 2))
        for label, one in (('local_linear', calibration), ('knn', knn)):
            one.prepare()
            peer = KNeighborsRegressor(one.model.k).fit(one.model.train_uv, one.model.train_duv)
            repeats = 200
            ours = median_seconds(lambda: one.correct(uv), repeats)
            direct = median_seconds(lambda: one.model.evaluate(uv), repeats // 4)
            theirs = median_seconds(lambda: peer.predict(uv), repeats // 4)
            yield [f'correction, {label}, k = {one.model.k}', f'frame of {targets} targets', f'{ours * 1e3:.3f} ms',
                   f'{direct / ours:.1f} times as fast as a search of all training points, {theirs / ours:.1f} times '
                   'as KNeighborsRegressor.predict']


def main():
    """Print the table, and write it to docs/performance.md."""
    rig = virtual_rig(1)
    frames = simulate_exposures(rig, 15, 1, matched=(130, 134)).frames['a']
    with threadpool_limits(1):
        rows = list(self_calibrations(rig, frames))
        fitted = {model: calibrate({'a': frames}, rig.phantom, Options(model)).calibrations['a']
                  for model in ('local_linear', 'knn')}
        rows += corrections(fitted['local_linear'], fitted['knn'])
    header = ['what', 'size', 'median time', 'beside it']
    lines = ['| ' + ' | '.join(row) + ' |' for row in [header, ['---'] * 4, *rows]]
    text = ('# Performance\n\nWritten by `make bench` (`python -m benchmarks`), one thread of the machine it ran on. A '
            'correction is\nexact: the sum over the nearest training points, with standard deviation and status.\n\n'
            + '\n'.join(lines) + '\n')
    Path('docs/performance.md').write_text(text)
    sys.stdout.write(text)


if __name__ == '__main__':
    main()
