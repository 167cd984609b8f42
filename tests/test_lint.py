# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The linters, the type checker and the import contracts, as tests."""

import ast
import pathlib
import subprocess
import sys

import pytest

ROOT = pathlib.Path(__file__).resolve().parent.parent
SOURCES = sorted((ROOT / 'fluoro_calib_ros').rglob('*.py'))


def run(*command):
    """Run Python with the arguments of a command; returns its exit status and output."""
    done = subprocess.run([sys.executable, *command], cwd=ROOT, capture_output=True, text=True)
    return done.returncode, done.stdout + done.stderr


@pytest.mark.parametrize(
    'command',
    [
        ('ruff', 'check', '.', '--no-cache'),
        ('ruff', 'format', '--check', '.', '--no-cache'),
    ],
    ids=['ruff check', 'ruff format'],
)
def test_linter_is_content(command):
    status, output = run('-m', *command)
    assert status == 0, output[-3000:]


@pytest.mark.long
def test_types_are_right():
    """Without the garbage collector, which takes a sixth of mypy's time and finds little.

    With mypy's cache, so that only the first run after a change of all files takes a minute.
    """
    code = (
        'import gc; gc.disable(); gc.enable = gc.disable; '
        'from mypy.main import main; main(args=[], clean_exit=True)'
    )
    status, output = run('-c', code)
    assert status == 0 and 'Success' in output, output[-3000:]


def test_imports_keep_their_contracts():
    """No import runs up or in a circle, and only the nodes know ROS; see pyproject.toml."""
    code = (
        'from importlinter.cli import lint_imports; raise SystemExit(lint_imports(no_cache=True))'
    )
    status, output = run('-c', code)
    assert status == 0, output[-3000:]


def test_every_file_names_its_licence():
    status, output = run('-m', 'reuse', 'lint')
    assert status == 0, output[-3000:]


def test_every_source_names_its_licence_itself():
    without = [
        str(path.relative_to(ROOT))
        for path in SOURCES
        if 'SPDX-License-Identifier' not in path.read_text()[:200]
    ]
    assert not without


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
