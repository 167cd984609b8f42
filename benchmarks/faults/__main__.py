# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Inject the faults of docs/reliability.md, and print the results as tables.

python -m benchmarks.faults [--only KIND,...] [--count N] [--seed N]
"""

from __future__ import annotations

import argparse
import os
import tempfile
from pathlib import Path

from fluoro_calib_ros.demo.assessment import isolate_ros_graph

from . import damage, hosts, kills, signals

KINDS = {
    'kills': kills.run,
    'damage': damage.run,
    'signals': signals.run,
    'hosts': hosts.run,
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--only', default=','.join(KINDS), help='kinds of faults (default: all)')
    parser.add_argument('--count', type=int, default=50, help='moments of each kind')
    parser.add_argument('--seed', type=int, default=1)
    arguments = parser.parse_args()
    isolate_ros_graph()
    for kind in arguments.only.split(','):
        with tempfile.TemporaryDirectory(prefix=f'faults_{kind}_') as folder:
            os.environ['ROS_LOG_DIR'] = str(Path(folder) / 'ros_log')
            print(KINDS[kind](Path(folder), arguments.count, arguments.seed) + '\n', flush=True)


if __name__ == '__main__':
    main()
