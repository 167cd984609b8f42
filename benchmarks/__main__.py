# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Speed on one thread, compared with COLMAP's bundle adjuster and scikit-learn.

python -m benchmarks                      all tables, written to docs/how_good/speed.md
python -m benchmarks scaling adjustment   these only, printed
"""

from __future__ import annotations

import argparse
import os
import platform
import sys
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path

from threadpoolctl import threadpool_limits

from fluoro_calib_ros.estimation.calibrate import calibrate
from fluoro_calib_ros.estimation.initial_network import measured_network
from fluoro_calib_ros.estimation.options import CalibrationOptions, model_choices
from fluoro_calib_ros.exposures.frame import Frame
from fluoro_calib_ros.simulation.rig import Detection, VirtualRig, simulate_exposures, virtual_rig
from tools.sections import write_section

from . import adjustments, profiling, scaling
from .lookup import lookup_section
from .peers import PeerCalibration, self_calibrate_with_peers
from .timing import section, timed


def exposures() -> tuple[VirtualRig, dict[str, list[Frame]]]:
    """Return a virtual rig and 15 exposures of about 132 targets each by its fluoroscope a."""
    rig = virtual_rig(1)
    return rig, {
        'a': simulate_exposures(rig, 15, 1, detection=Detection(beads=(130, 134))).frames['a']
    }


def models() -> list[CalibrationOptions]:
    """Return CalibrationOptions for each correction model."""
    return [CalibrationOptions(model) for model in model_choices()]


def calibration_section() -> str:
    """Compare the self-calibration of every model with a loop of COLMAP and scikit-learn."""
    rig, frames = exposures()
    ours = []
    for options in models():
        job, seconds = timed(lambda: calibrate(frames, rig.phantom, options), 3)
        ours.append((options.model, job, seconds))

    def with_peers() -> PeerCalibration:
        measured = measured_network(frames, rig.phantom)
        return self_calibrate_with_peers(measured.network, measured.start)

    peer, peer_seconds = timed(with_peers)
    rows = []
    for model, job, seconds in ours:
        f = job.fluoroscopes['a']
        rows.append(
            [
                model,
                f'{seconds:.2f} s',
                str(len(job.history['a'])),
                str(f.k),
                f'{f.interior[2]:.1f}',
                ', '.join(f'{x:.3f}' for x in f.rmse_after),
                f'{peer_seconds / seconds:.0f}',
            ]
        )
    rows.append(
        [
            'COLMAP and GridSearchCV',
            f'{peer_seconds:.2f} s',
            str(peer.rounds),
            str(peer.k),
            f'{peer.interior[2]:.1f}',
            ', '.join(f'{x:.3f}' for x in peer.rmse),
            '1',
        ]
    )
    count = sum(len(frame.target_id) for frame in frames['a'])
    return section(
        f'Self-calibration of {len(frames["a"])} exposures, {count} image points',
        'The times include all steps from the frames on: start values, selection of k in every '
        'round, precision. The '
        "last row is the same alternation built from COLMAP's bundle adjuster (Cauchy loss, "
        'warm-started) and '
        'GridSearchCV of KNeighborsRegressor from scikit-learn (k = 3..49, ten folds of whole '
        f'exposures). It {"converged" if peer.converged else "had not converged"} after '
        f'{peer.rounds} rounds; the grid searches took {peer.search_seconds:.1f} s, everything '
        f'else {peer_seconds - peer.search_seconds:.1f} s.',
        [
            'model',
            'median time',
            'rounds',
            'k',
            'c [px]',
            'RMSE of inliers u, v [px]',
            'speed-up',
        ],
        rows,
    )


def adjustment_section() -> str:
    """Compare an adjustment with one by COLMAP."""
    return section(
        'One adjustment compared with COLMAP',
        'All targets in all exposures, Student-t noise of fixed scale, interior orientation '
        'estimated, the same start values. Every tenth object point is fixed and the others are '
        'free, because COLMAP does not support surveyed coordinates with standard deviations. The '
        'costs are the negative log-likelihoods of the image points.',
        adjustments.HEADER,
        [adjustments.compare_with_colmap(size) for size in adjustments.SIZES],
    )


def scaling_section() -> str:
    """Measure time and memory by the number of exposures."""
    return section(
        'Many exposures',
        'One adjustment with surveyed coordinates and a given noise model. Each size runs in a '
        'new process.',
        scaling.HEADER,
        list(scaling.rows()),
    )


def profile_section() -> str:
    """List the functions in which the self-calibration spends its time."""
    rig, frames = exposures()
    calibrate(frames, rig.phantom)  # untimed: the first call includes one-off work
    rows = list(profiling.rows(lambda: calibrate(frames, rig.phantom)))
    return section(
        'Where the time of a self-calibration goes',
        'cProfile of the self-calibration above with the default model '
        f'({CalibrationOptions().model}): functions of this package with the largest cumulative '
        'times. The profiler itself adds some time.',
        profiling.HEADER,
        rows,
    )


SECTIONS = {
    'calibration': calibration_section,
    'adjustment': adjustment_section,
    'scaling': scaling_section,
    'correction': lookup_section,
    'profile': profile_section,
}


def machine() -> str:
    """Return the machine and the versions of the packages in one sentence."""
    cpu = platform.processor() or platform.machine()
    information = Path('/proc/cpuinfo')
    if information.exists():
        names = [
            line.split(':', 1)[1].strip()
            for line in information.read_text().splitlines()
            if line.startswith('model name')
        ]
        cpu = names[0] if names else cpu
    memory = os.sysconf('SC_PHYS_PAGES') * os.sysconf('SC_PAGE_SIZE') / 2**30
    packages = ', '.join(
        f'{name} {version(name)}' for name in ('numpy', 'scipy', 'scikit-learn', 'pycolmap')
    )
    return (
        f'{cpu} ({platform.machine()}), {os.cpu_count()} cores, {memory:.0f} GiB, '
        f'{platform.system()}; Python {platform.python_version()}, {packages}.'
    )


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the tables; if all are selected, write them to docs/how_good/speed.md."""
    parser = argparse.ArgumentParser(
        prog='python -m benchmarks', description=__doc__.splitlines()[0]
    )
    parser.add_argument('section', nargs='*', help=f'{", ".join(SECTIONS)} (default: all)')
    chosen = parser.parse_args(arguments).section or list(SECTIONS)
    for name in chosen:
        if name not in SECTIONS:
            parser.error(f'{name}: there is no such section; there are {", ".join(SECTIONS)}')
    parts = [
        'Generated by `make bench` (`python -m benchmarks`). All computations '
        'use one thread.\n' + machine()
    ]
    with threadpool_limits(1):
        for name in chosen:
            print(name, file=sys.stderr)
            parts.append(SECTIONS[name]())
    text = '\n\n'.join(parts) + '\n'
    if chosen == list(SECTIONS):
        write_section(Path('docs/how_good/speed.md'), 'computations', text)
    sys.stdout.write(text)


if __name__ == '__main__':
    main()
