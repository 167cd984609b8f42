# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""SIGINT and SIGTERM at random moments of every node, including its start-up."""

from __future__ import annotations

import random
import signal
import time
from collections import Counter
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

from ..timing import section
from .processes import ROOT, Process, node

SIGNALS = (signal.SIGINT, signal.SIGTERM)
START_S = 3.0  # time within which a process is interrupted during start-up
RUNNING_S = 2.0  # time within which it is interrupted after start-up
PHASES = ('start', 'running')
PHANTOM = {'phantom': ROOT / 'bags' / 'phantom.csv'}


def nodes_under_test(folder: Path) -> dict[str, Callable[[int], Mapping[str, object]]]:
    """Return functions from the run number to the parameters of a node, for all nodes."""
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
    """Interrupt every node `count` times with each signal; return the section of the report."""
    (folder / 'calibrated').mkdir()
    rows = []
    with ExitStack() as stack:
        # A stream that keeps the nodes busy.
        feed = node('simulator_node', {'scene': 'markers', 'rate': 60.0})
        stack.enter_context(Process(feed, folder / 'feed.log'))
        for name, parameters in nodes_under_test(folder).items():
            for number in SIGNALS:
                for phase in PHASES:
                    test = _Test(folder, name, number, phase)
                    rows.append(test.row(parameters, count, seed))
    return section(
        'Interrupts',
        f'Every node was interrupted {count} times with each signal in each phase. Start: within '
        f'{START_S:g} s after the start of its process. Running: within {RUNNING_S:g} s after it '
        'has begun to handle signals, which is before it joins the graph. By signal: Python was '
        'still importing. With traceback: Python had not yet read a line of the package. The last '
        'column is the longest time to the end.',
        (
            'node',
            'signal',
            'phase',
            'status 0',
            'by signal',
            'other status',
            'traceback',
            'processes left',
            'end [s]',
        ),
        rows,
    )


@dataclass(frozen=True)
class _Test:
    """Interrupts of a node with one signal in one phase."""

    folder: Path
    name: str
    number: signal.Signals
    phase: str

    def row(
        self, parameters: Callable[[int], Mapping[str, object]], count: int, seed: int
    ) -> list[str]:
        """Interrupt the node `count` times; return a row of the report."""
        rng = random.Random(f'{seed} {self.name} {self.number} {self.phase}')
        found: Counter[str] = Counter()
        longest = 0.0
        for run_number in range(count):
            label = f'{self.name}_{self.number.name}_{self.phase}_{run_number}'
            # A unique number of each run, for the folders of the recorder.
            unique = (run_number * 100 + self.number) * 2 + PHASES.index(self.phase)
            words = node(self.name, parameters(unique))
            with Process(words, self.folder / f'{label}.log') as process:
                if self.phase == 'running':
                    while process.running and not catches(process.pid, signal.SIGTERM):
                        time.sleep(0.01)
                time.sleep(rng.uniform(0.0, RUNNING_S if self.phase == 'running' else START_S))
                began = time.monotonic()
                process.send(self.number)
                status = process.wait(60.0)
                longest = max(longest, time.monotonic() - began)
                left = len(process.left())
                output = process.output
            kind = {0: 'clean', -self.number: 'by signal'}.get(status, 'other')
            found[kind] += 1
            found['traceback'] += 'Traceback' in output
            found['left'] += left
            if kind == 'other' or 'Traceback' in output or left:
                print(f'{label}: status {status}, {left} left')
                print('    ' + output[-800:].replace('\n', '\n    '), flush=True)
        numbers = (str(found[k]) for k in ('clean', 'by signal', 'other', 'traceback', 'left'))
        return [self.name, self.number.name, self.phase, *numbers, f'{longest:.1f}']


def catches(pid: int, number: int) -> bool:
    """Return whether a process handles a signal."""
    try:
        lines = Path('/proc', str(pid), 'status').read_text().splitlines()
    except OSError:
        return False
    mask = next(int(line.split()[1], 16) for line in lines if line.startswith('SigCgt'))
    return bool(mask >> (number - 1) & 1)
