# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The experiment of Chow et al. on the virtual rig, and further comparisons: `make validation`.

Writes docs/how_good/accuracy.md and its pictures; experiment_plan defines the cases,
experiment_text the text.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from .experiment_figures import write_all
from .experiment_plan import Outcomes, Plan, full_plan, quick_plan, run
from .experiment_text import document_text


def make(plan: Plan, document: Path) -> Outcomes:
    """Run a plan, write the document (a Path) and its pictures; return the outcomes by case."""
    began = time.monotonic()
    outcomes = run(plan.cases())
    paths = write_all(plan, outcomes, document.parent / 'images')
    document.write_text(document_text(plan, outcomes, paths, document))
    print(
        f'{document} and {len(paths)} pictures, {time.monotonic() - began:.0f} s', file=sys.stderr
    )
    return outcomes


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point; exit status 1 if a calibration failed."""
    parser = argparse.ArgumentParser(prog='python -m benchmarks.validation', description=__doc__)
    parser.add_argument(
        '--quick', action='store_true', help='all sections, but of a small experiment'
    )
    parser.add_argument(
        '--out',
        type=Path,
        default=Path('docs/how_good/accuracy.md'),
        help='file to write, pictures go into images/ beside it',
    )
    options = parser.parse_args(arguments)
    outcomes = make(quick_plan() if options.quick else full_plan(), options.out)
    return 1 if any(o.failed for o in outcomes.values()) else 0


if __name__ == '__main__':
    sys.exit(main())
