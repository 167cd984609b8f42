# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Run fuzz targets: `python -m fuzz TARGET [options of libFuzzer]`, or `all SECONDS`.

`all` runs one target after the other for SECONDS each, and prints the number of inputs of each.
"""

from __future__ import annotations

import importlib
import pkgutil
import re
import subprocess
import sys
from collections.abc import Sequence

from . import targets
from .harness import CORPUS, Target, fuzz

NAMES = tuple(sorted(module.name for module in pkgutil.iter_modules(targets.__path__)))


def load(name: str) -> Target:
    """Import a target."""
    return importlib.import_module(f'{__package__}.targets.{name}').TARGET


def run_all(seconds: float) -> int:
    """Run every target in its own process; return the number of targets with a finding."""
    CORPUS.mkdir(parents=True, exist_ok=True)
    findings = 0
    for name in NAMES:
        log = CORPUS.parent / f'{name}.log'
        command = [sys.executable, '-m', __package__, name, f'-max_total_time={seconds:.0f}']
        with log.open('w') as file:
            status = subprocess.run(
                command, stdout=file, stderr=subprocess.STDOUT, check=False
            ).returncode
        text = log.read_text(errors='replace')
        inputs = re.search(r'number_of_executed_units: *(\d+)', text)
        verdict = 'no finding' if status == 0 else f'FINDING, see {log}'
        print(f'{name:24s} {inputs[1] if inputs else "?":>10s} inputs  {verdict}', flush=True)
        findings += status != 0
    return findings


def main(words: Sequence[str]) -> None:
    """Run the targets that the command line selects."""
    if len(words) == 2 and words[0] == 'all':
        sys.exit(min(run_all(float(words[1])), 1))
    if not words or words[0] not in NAMES:
        sys.exit(f'usage: python -m fuzz TARGET [OPTIONS], or all SECONDS; {", ".join(NAMES)}')
    fuzz(lambda: load(words[0]), words[1:])


if __name__ == '__main__':
    main(sys.argv[1:])
