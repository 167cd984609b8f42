# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""See the package for usage."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path

from threadpoolctl import threadpool_limits

from .measure import measure
from .page import page
from .sets import READERS
from .sources import download, text_of_sources

DATA = Path('real_data')
PAGE = Path('docs/how_good/real_data.md')


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command."""
    parser = argparse.ArgumentParser(
        prog='python -m benchmarks.real_data',
        description='Calibrate public data of real cameras and test with unseen exposures.',
    )
    parser.add_argument('--list', action='store_true', help='print sources and licences')
    parser.add_argument('--download', action='store_true', help='fetch the data first')
    parser.add_argument('--data', type=Path, default=DATA, help='folder of the data (real_data)')
    parser.add_argument('--set', action='append', choices=list(READERS), help='this set only')
    parser.add_argument('--mrcal', metavar='PYTHON', help='interpreter that can import mrcal')
    parser.add_argument('--no-verdict', action='store_true', help='do not validate')
    parser.add_argument('--seed', type=int, default=1, help='of the random halves (1)')
    parser.add_argument('--note', default='', help='a paragraph for the summary of the page')
    parser.add_argument('--results', type=Path, help='JSON file that keeps the results by set')
    parser.add_argument('--out', type=Path, help=f'the page; default {PAGE} with all sets')
    arguments = parser.parse_args(argv)
    if arguments.list:
        print(text_of_sources())
        return 0
    if arguments.download:
        download(arguments.data)
    kept = arguments.results
    results = json.loads(kept.read_text()) if kept and kept.exists() else {}
    with threadpool_limits(1):
        for name in arguments.set or READERS:
            if name in results and not arguments.set:
                continue
            try:
                data = READERS[name](arguments.data)
            except OSError as error:
                print(f'{error}: use --download, or --data FOLDER', file=sys.stderr)
                return 1
            results[name] = measure(
                data, arguments.mrcal, not arguments.no_verdict, arguments.seed
            )
            print(json.dumps(results[name]), file=sys.stderr)
            if kept:
                kept.write_text(json.dumps(results, indent=1))
    text = page([results[name] for name in READERS if name in results], arguments.note)
    target = arguments.out or (None if arguments.set else PAGE)
    if target is None:
        print(text)
    else:
        target.write_text(text)
    return 0


if __name__ == '__main__':
    sys.exit(main())
