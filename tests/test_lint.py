# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The linters, the type checker and the import contracts, as tests."""

import ast
import functools
import gc
import pathlib
import subprocess
import sys

import pytest

ROOT = pathlib.Path(__file__).resolve().parent.parent
SOURCES = sorted((ROOT / 'fluoro_calib_ros').rglob('*.py'))


def run(*command):
    """Run Python with the given arguments and return its exit status and output."""
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
@pytest.mark.timeout(900)
def test_types_are_right():
    """Run mypy without garbage collection, which takes a sixth of its time and finds little.

    mypy's cache is used, so that only the first run after a change of all files takes a minute; on
    a machine that other programs use as well, it takes several.
    """
    code = (
        'import gc; gc.disable(); gc.enable = gc.disable; '
        'from mypy.main import main; main(args=[], clean_exit=True)'
    )
    status, output = run('-c', code)
    assert status == 0 and 'Success' in output, output[-3000:]


def test_imports_keep_their_contracts():
    """No import runs upwards or in a circle, and only the nodes use ROS; see pyproject.toml."""
    code = (
        'from importlinter.cli import lint_imports; raise SystemExit(lint_imports(no_cache=True))'
    )
    status, output = run('-c', code)
    assert status == 0, output[-3000:]


@pytest.mark.long
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


@functools.cache
def nodes():
    """Return pairs of a path and a syntax node: functions, classes, assignments and calls."""
    kinds = (ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef, ast.Assign, ast.Call)
    gc.disable()  # it would traverse all syntax trees again and again without finding anything
    try:
        return [
            (name, node)
            for name, path in ((path.relative_to(ROOT), path) for path in SOURCES)
            for node in ast.walk(ast.parse(path.read_text()))
            if isinstance(node, kinds)
        ]
    finally:
        gc.enable()


def test_no_function_has_more_than_seven_parameters():
    too_many = []
    for path, node in nodes():
        if not isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef)):
            continue
        parameters = [
            a.arg for a in (*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs)
        ]
        if parameters and parameters[0] in ('self', 'cls'):
            parameters = parameters[1:]
        if len(parameters) > 7:
            too_many.append(f'{path}: {node.name} has {len(parameters)}')
    assert not too_many


def test_parallel_assignments_are_rare():
    """One statement a line: `a, b = x, y` is for swaps and for values that belong together."""
    assigned = [node for _, node in nodes() if isinstance(node, ast.Assign)]
    parallel = [
        node
        for node in assigned
        if isinstance(node.targets[0], ast.Tuple) and isinstance(node.value, ast.Tuple)
    ]
    assert len(parallel) < 0.01 * len(assigned)


def is_of_library(call):
    """Return whether a call belongs to a library that takes positional arguments only."""
    target = call.func
    while isinstance(target, ast.Attribute):
        target = target.value
    return isinstance(target, ast.Name) and target.id in ('cv2', 'rclpy_implementation', 'zip')


def test_sources_keep_their_sizes():
    """At most 400 lines a node, 300 a class, 75 a function; five positional arguments a call."""
    too_large = []
    for path in SOURCES:
        lines = path.read_text().count('\n')
        if path.parent.name in ('nodes', 'runtime') and lines > 400:
            too_large.append(f'{path.name}: {lines} lines')
    limits = {ast.ClassDef: 300, ast.FunctionDef: 75, ast.AsyncFunctionDef: 75}
    for path, node in nodes():
        limit = limits.get(type(node))
        if limit and node.end_lineno - node.lineno + 1 > limit:
            too_large.append(f'{path}: {node.name}')
        if not isinstance(node, ast.Call) or is_of_library(node):
            continue
        if len(node.args) > 5 and not any(isinstance(a, ast.Starred) for a in node.args):
            too_large.append(f'{path}:{node.lineno}: {len(node.args)} positional arguments')
    assert not too_large
