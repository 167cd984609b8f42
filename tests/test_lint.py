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

"""The linters, the type checker and the import contracts, as tests."""

import ast
import pathlib
import subprocess
import sys

import pytest

ROOT = pathlib.Path(__file__).resolve().parent.parent
SOURCES = sorted((ROOT / 'fluoro_calib_ros').rglob('*.py'))


def run(*command):
    """Run a tool of the environment; returns its exit status and output."""
    done = subprocess.run(
        [sys.executable, '-m', *command], cwd=ROOT, capture_output=True, text=True
    )
    return done.returncode, done.stdout + done.stderr


@pytest.mark.parametrize(
    'command',
    [
        ('ruff', 'check', '.', '--no-cache'),
        ('ruff', 'format', '--check', '.', '--no-cache'),
        pytest.param(('mypy', '--cache-dir', '/dev/null'), marks=pytest.mark.long),
    ],
    ids=['ruff check', 'ruff format', 'mypy'],
)
def test_linter_is_content(command):
    status, output = run(*command)
    assert status == 0, output[-3000:]


def test_imports_keep_their_contracts():
    """No import runs up or in a circle, and only the nodes know ROS; see pyproject.toml."""
    code = (
        'from importlinter.cli import lint_imports; raise SystemExit(lint_imports(no_cache=True))'
    )
    done = subprocess.run([sys.executable, '-c', code], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout[-3000:]


def functions():
    """All functions of the package, with the name of their module."""
    for path in SOURCES:
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef)):
                yield f'{path.relative_to(ROOT)}: {node.name}', node


def test_no_function_has_more_than_seven_parameters():
    too_many = []
    for name, node in functions():
        parameters = [
            a.arg for a in (*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs)
        ]
        if parameters and parameters[0] in ('self', 'cls'):
            parameters = parameters[1:]
        if len(parameters) > 7:
            too_many.append(f'{name} has {len(parameters)}')
    assert not too_many


def test_parallel_assignments_are_rare():
    """One statement a line: `a, b = x, y` is for swaps and for values that belong together."""
    count = 0
    total = 0
    for path in SOURCES:
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Assign):
                total += 1
                count += isinstance(node.targets[0], ast.Tuple) and isinstance(
                    node.value, ast.Tuple
                )
    assert count < 0.01 * total
