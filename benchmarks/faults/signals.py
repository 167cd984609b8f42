# Copyright 2026 fluoro_calib_ros maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""SIGINT and SIGTERM at random moments of every node, during the start, too."""

from __future__ import annotations

import random
import signal
import time
from collections import Counter
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from pathlib import Path

from ..timing import section
from .processes import ROOT, Process, node

SIGNALS = (signal.SIGINT, signal.SIGTERM)
LONGEST_S = 3.0  # after the start of a process; it is ready after a third of it
READY = 'handlers'
PHANTOM = {'phantom': ROOT / 'bags' / 'phantom.csv'}


def nodes_under_test(folder: Path) -> dict[str, Callable[[int], Mapping[str, object]]]:
    """Return the parameters of all nodes; called with the number of the run."""
    calibrated = {'calibration_directory': folder / 'calibrated'}
    return {
        'calibration_node': lambda _: {**PHANTOM, **calibrated},
        'correction_node': lambda _: calibrated,
        'reconstruction_node': lambda _: calibrated,
        'image_node': lambda _: calibrated,
        'extraction_node': lambda _: PHANTOM,
        'player_node': lambda _: {
            'bag': ROOT / 'bags' / 'tracking',
            'loop': 'true',
            'wait_for_readers': 0,
        },
        'recorder_node': lambda number: {'folder': folder / f'bag_{number}'},
        'simulator_node': lambda _: {'scene': 'markers', 'rate': 120.0},
        'bridge_node': lambda _: {'port': 0},
    }


def run(folder: Path, count: int, seed: int) -> str:
    """Interrupt every node `count` times with each signal; returns the section of the report."""
    (folder / 'calibrated').mkdir()
    tests = nodes_under_test(folder)
    rows = []
    with ExitStack() as stack:
        # A stream for the nodes to be in the middle of.
        feed = node('simulator_node', {'scene': 'markers', 'rate': 60.0})
        stack.enter_context(Process(feed, folder / 'feed.log'))
        for name, parameters in tests.items():
            for number in SIGNALS:
                rng = random.Random(f'{seed} {name} {number}')
                rows.append(_row(name, number, parameters, rng, count, folder))
    return section(
        'Interrupts',
        f'Every node was interrupted {count} times with each signal, at moments between 0 and '
        f'{LONGEST_S:g} s after the start of its process, at which it is ready after 1 to 2 s. '
        'Status 0: the node was running; by signal: Python was still importing; with traceback: '
        'Python itself had not yet read the first line of the package. The last column is the '
        'longest time to the end.',
        (
            'node',
            'signal',
            'status 0',
            'by signal',
            'other status',
            'traceback',
            'processes left',
            'end [s]',
        ),
        rows,
    )


def _row(
    name: str,
    number: signal.Signals,
    parameters: Callable[[int], Mapping[str, object]],
    rng: random.Random,
    count: int,
    folder: Path,
) -> list[str]:
    found: Counter[str] = Counter()
    longest = 0.0
    for run_number in range(count):
        label = f'{number.name}_{run_number}'
        moment = rng.uniform(0.0, LONGEST_S)
        status, output, left, seconds = interrupted(
            node(name, parameters(hash_of(name, number, run_number))),
            number,
            moment,
            folder / f'{name}_{label}.log',
        )
        longest = max(longest, seconds)
        kind = {0: 'clean', -number: 'by signal'}.get(status, 'other')
        found[kind] += 1
        found['traceback'] += 'Traceback' in output
        found['left'] += left
        if kind == 'other' or 'Traceback' in output or left:
            print(f'{name} {number.name} after {moment:.3f} s: status {status}, {left} left')
            print('    ' + output[-800:].replace('\n', '\n    '), flush=True)
    return [
        name,
        number.name,
        *(str(found[key]) for key in ('clean', 'by signal', 'other', 'traceback', 'left')),
        f'{longest:.1f}',
    ]


def hash_of(name: str, number: int, run_number: int) -> int:
    """Return a number of its own for every run of a node."""
    return run_number * 100 + number


def interrupted(
    words: list[object], number: int, moment: float, log: Path
) -> tuple[int, str, int, float]:
    """Send a signal to a process some seconds after its start.

    Returns exit status, output, number of processes that are left and the time to the end [s].
    """
    with Process(words, log) as process:
        time.sleep(moment)
        began = time.monotonic()
        process.send(number)
        status = process.wait(60.0)
        seconds = time.monotonic() - began
        return status, process.output, len(process.left()), seconds
