# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Time and memory of an adjustment by number of exposures, with one process per size.

python -m benchmarks.scaling 300      one size; prints one line of JSON
"""

import json
import subprocess
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from threadpoolctl import threadpool_limits

from fluoro_calib_ros.photogrammetry.adjustment import adjust

from .adjustments import NOISE, large_network
from .timing import timed

SIZES = (30, 100, 300, 1000, 3000)  # exposures
HEADER = [
    'exposures x targets',
    'image points',
    'unknowns',
    'steps',
    'adjustment',
    'per step',
    'per step and image point',
    'peak memory',
    'memory before the adjustment',
]


def peak_gib() -> float:
    """Return the peak resident memory of this process so far [GiB]."""
    # The ru_maxrss of getrusage starts at the value of the parent process, which exceeds the
    # memory of the small sizes here.
    status = dict(
        line.split(':', 1) for line in Path('/proc/self/status').read_text().splitlines()
    )
    return int(status['VmHWM'].split()[0]) / 2**20


def measure(exposures: int) -> dict[str, Any]:
    """Measure an adjustment from disturbed initial values in this process."""
    network, start = large_network(exposures)
    before = peak_gib()
    with threadpool_limits(1):
        result, seconds = timed(lambda: adjust(network, start, 0.0, NOISE))
    return {
        'exposures': exposures,
        'targets': len(network.survey_mm),
        'image_points': len(network.uv),
        'unknowns': network.n_unknowns,
        'steps': result.steps,
        'converged': bool(result.converged),
        'seconds': seconds,
        'before_gib': before,
        'peak_gib': peak_gib(),
    }


def measure_in_new_process(exposures: int) -> dict[str, Any]:
    """Measure in a new process, so that its memory is that of this adjustment."""
    done = subprocess.run(
        [sys.executable, '-m', 'benchmarks.scaling', str(exposures)],
        stdout=subprocess.PIPE,
        text=True,
        check=True,
    )
    return json.loads(done.stdout)


def rows(sizes: Sequence[int] = SIZES) -> Iterator[list[str]]:
    """Yield the table rows of all sizes."""
    for size in sizes:
        f = measure_in_new_process(size)
        step = f['seconds'] / f['steps']
        yield [
            f'{size} x {f["targets"]}',
            f'{f["image_points"]:,}',
            f'{f["unknowns"]:,}',
            f'{f["steps"]}{"" if f["converged"] else " (not converged)"}',
            f'{f["seconds"]:.2f} s',
            f'{step:.3f} s',
            f'{step / f["image_points"] * 1e6:.2f} us',
            f'{f["peak_gib"]:.2f} GiB',
            f'{f["before_gib"]:.2f} GiB',
        ]


if __name__ == '__main__':
    print(json.dumps(measure(int(sys.argv[1]))))
