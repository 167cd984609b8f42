#!/usr/bin/env python3

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

"""Resolve requirements.in into requirements.lock for several Pythons.

    tools/lock.py python3.10 python3.11 python3.12 python3.13

Each interpreter resolves in a throw-away venv (nothing is installed); the answers are merged, with
a marker wherever the Pythons differ. Run it with ALL supported Pythons, then `make setup && make
test`.
"""

from __future__ import annotations

import json
import pathlib
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence

ROOT = pathlib.Path(__file__).resolve().parent.parent
HEAD = """\
# Made by tools/lock.py from requirements.in: do not edit. Every package, exactly, for Python \
{pythons}.
"""


def resolve(python: str) -> tuple[str, dict[str, str]]:
    """Return the minor version, and {name: version} as pip of this Python resolves them."""
    with tempfile.TemporaryDirectory() as folder:
        subprocess.run([python, '-m', 'venv', folder], check=True)
        pip = [folder + '/bin/python', '-m', 'pip', 'install', '--quiet', '--quiet']
        subprocess.run(pip + ['--upgrade', 'pip'], check=True)
        report = folder + '/report.json'
        subprocess.run(
            pip
            + [
                '--dry-run',
                '--ignore-installed',
                '--report',
                report,
                '-r',
                str(ROOT / 'requirements.in'),
            ],
            check=True,
        )
        with open(report) as stream:
            data = json.load(stream)
    pins = {
        item['metadata']['name'].lower().replace('_', '-').replace('.', '-'): item['metadata'][
            'version'
        ]
        for item in data['install']
    }
    return data['environment']['python_version'], pins


def marker(pythons: Sequence[str], known: Sequence[str]) -> str:
    """Return the environment marker that picks these Python versions out of the known ones."""
    if pythons == known[-len(pythons) :]:
        return f'python_version >= "{pythons[0]}"'
    if pythons == known[: len(pythons)]:
        return f'python_version <= "{pythons[-1]}"'
    return ' or '.join(f'python_version == "{python}"' for python in pythons)


def merge(answers: Mapping[str, Mapping[str, str]]) -> list[str]:
    """Return the lines of the lock for {python version: {name: version}}."""
    lines = []
    for name in sorted({name for pins in answers.values() for name in pins}):
        by_version: dict[str, list[str]] = {}
        for python, pins in answers.items():
            if name in pins:
                by_version.setdefault(pins[name], []).append(python)
        for version, pythons in sorted(by_version.items()):
            line = f'{name}=={version}'
            if len(pythons) < len(answers):
                line += ' ; ' + marker(pythons, list(answers))
            lines.append(line)
    return lines


def main() -> None:
    """Resolve for the Pythons of the command line and write the lock."""
    if len(sys.argv) < 2:
        sys.exit(__doc__)
    answers = dict(
        sorted(
            (resolve(python) for python in sys.argv[1:]),
            key=lambda item: int(item[0].split('.')[1]),
        )
    )
    text = HEAD.format(pythons=', '.join(answers)) + '\n'.join(merge(answers)) + '\n'
    (ROOT / 'requirements.lock').write_text(text)


if __name__ == '__main__':
    main()
