# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Mutation testing: the share of plausible single bugs that the quick tests catch, by room.

In a copy of the repository, a bug is inserted into a random line of a function that quick tests
execute, and the tests that execute the line are run, fastest first. Surviving bugs are printed:
a number or kind that no test asserts, or a change that makes no difference. Operators after
Offutt et al., "An experimental determination of sufficient mutant operators", 1996.
"""

from __future__ import annotations

import argparse
import ast
import copy
import json
import os
import random
import resource
import shutil
import signal
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = 'fluoro_calib_ros'
RECORD = ROOT / '.mutants.json'
OWN_ROOMS = ('io/formats', 'io/bags', 'nodes/runtime', 'nodes/messages')
QUICK = ['-q', '-p', 'no:cacheprovider', '-p', 'no:xdist', '-m', 'not ros and not long']
LEFT_OUT = ('.git', '.venv', '.build', '.*_cache', '.hypothesis', '.mutants.json', '_build')
MAX_TESTS_S = 40.0  # maximum duration of the tests that are run against one bug
OTHER_ROOM = 5.0  # factor on the time of a test of another room, for the order of tests
FIRST = 12  # number of tests that are tried before all of them
RECORD_S = 3600.0
MIN_LIMIT_S = 60.0  # minimum limit of CPU time; a bug that exceeds the limit counts as caught
WAITING = 10.0
NO_TESTS = 5  # exit status of pytest if no tests were collected
THREADS = ('OMP_NUM_THREADS', 'OPENBLAS_NUM_THREADS')
SWAPPED: dict[type, type] = {
    ast.Add: ast.Sub,
    ast.Sub: ast.Add,
    ast.Mult: ast.Div,
    ast.Lt: ast.LtE,
    ast.LtE: ast.Lt,
    ast.Gt: ast.GtE,
    ast.GtE: ast.Gt,
    ast.Eq: ast.NotEq,
    ast.NotEq: ast.Eq,
    ast.And: ast.Or,
    ast.Or: ast.And,
}
NAMES = {'min': 'max', 'max': 'min', 'argmin': 'argmax', 'argmax': 'argmin', 'sin': 'cos'}
COMMUTATIVE = (
    'min',
    'max',
    'minimum',
    'maximum',
    'multiply',
    'np.clip',
    'hypot',
    'allclose',
    'array_equal',
)
LEAVING = (ast.Raise, ast.Return, ast.Continue)


@dataclass(frozen=True)
class Bug:
    """A change of a file (relative to the root) at a line: text that replaces a range."""

    path: str
    line: int
    begin: int
    end: int
    kind: str
    new: str


def bugs_of(node: ast.AST) -> Iterator[tuple[str, ast.AST, ast.AST]]:
    """Yield kind of bug, node to replace and replacement, for one node of a syntax tree."""

    def changed(**fields: Any) -> Any:
        out = copy.copy(node)
        for name, value in fields.items():
            setattr(out, name, value)
        return out

    if isinstance(node, (ast.BinOp, ast.AugAssign)) and type(node.op) in SWAPPED:
        if not _is_text(node):
            yield 'sign', node, changed(op=SWAPPED[type(node.op)]())
    elif isinstance(node, ast.UnaryOp) and isinstance(node.op, (ast.USub, ast.Not)):
        yield 'sign', node, node.operand
    elif isinstance(node, ast.Compare) and type(node.ops[0]) in SWAPPED:
        yield 'bound', node, changed(ops=[SWAPPED[type(node.ops[0])](), *node.ops[1:]])
    elif isinstance(node, ast.BoolOp):
        yield 'logic', node, changed(op=SWAPPED[type(node.op)]())
    elif isinstance(node, ast.Slice) and isinstance(node.lower, ast.Constant):
        yield 'bound', node.lower, ast.Constant(int(str(node.lower.value)) + 1)
    elif isinstance(node, ast.keyword) and node.arg == 'axis':
        axis = ast.unparse(node.value)
        if axis in ('0', '1', '-1', '-2'):
            new = {'0': 1, '1': 0, '-1': -2, '-2': -1}[axis]
            yield 'axis', node.value, ast.Constant(new)
    elif isinstance(node, ast.Attribute):
        if node.attr == 'T' and isinstance(node.ctx, ast.Load):
            yield 'transpose', node, node.value
        elif node.attr in NAMES:
            yield 'function', node, changed(attr=NAMES[node.attr])
    elif isinstance(node, ast.Call) and len(node.args) >= 2:
        name = ast.unparse(node.func)
        is_commutative = not {name, name.split('.')[-1]}.isdisjoint(COMMUTATIVE)
        starred = any(isinstance(a, (ast.Starred, ast.GeneratorExp)) for a in node.args)
        if not is_commutative and not starred:
            first, second, *others = node.args
            if ast.dump(first) != ast.dump(second):
                yield 'arguments', node, changed(args=[second, first, *others])
    elif isinstance(node, ast.If) and not node.orelse and isinstance(node.body[-1], LEAVING):
        yield 'guard', node.test, ast.Constant(False)
    elif isinstance(node, ast.Raise):
        yield 'error', node, ast.Pass()


def _is_text(node: ast.BinOp | ast.AugAssign) -> bool:
    """Return whether strings are joined or formatted: their wording is not tested here."""
    parts = ast.walk(node)
    return any(
        isinstance(p, ast.JoinedStr) or (isinstance(p, ast.Constant) and isinstance(p.value, str))
        for p in parts
    )


def bugs_in(path: Path, executed: set[int]) -> list[Bug]:
    """Return every bug in the executed lines of the functions of a file."""
    text = path.read_text()
    starts = [0]
    for line in text.splitlines(keepends=True):
        starts.append(starts[-1] + len(line.encode()))
    found = {}
    for function in ast.walk(ast.parse(text)):
        if not isinstance(function, (ast.FunctionDef, ast.AsyncFunctionDef)):
            continue
        for node in (n for statement in function.body for n in ast.walk(statement)):
            for kind, old, new in bugs_of(node):
                line, last = old.lineno, old.end_lineno  # type: ignore[attr-defined]
                if line not in executed:
                    continue
                begin = starts[line - 1] + old.col_offset  # type: ignore[attr-defined]
                end = starts[last - 1] + old.end_col_offset  # type: ignore[attr-defined]
                code = ast.unparse(ast.fix_missing_locations(new))
                if isinstance(old, ast.expr):
                    code = f'({code})'
                bug = Bug(str(path.relative_to(ROOT)), line, begin, end, kind, code)
                found[bug.begin, bug.end, bug.kind] = bug
    return list(found.values())


def room_of(path: str) -> str:
    """Return the room of a source or test file, given its path relative to the root."""
    inner = '/'.join(path.split('/')[1:-1])
    return next((room for room in OWN_ROOMS if inner == room), inner.split('/')[0] or 'top')


# ---- runs of tests


class Chosen:
    """Pytest plugin that runs selected tests only, in their order, and records their outcomes."""

    def __init__(self, tests: Sequence[str]) -> None:
        self.rank = {test: rank for rank, test in enumerate(tests)}

    def pytest_collection_modifyitems(self, items: list[Any]) -> None:
        """Deselect all other tests."""
        items[:] = sorted(
            (item for item in items if item.nodeid in self.rank),
            key=lambda item: self.rank[item.nodeid],
        )


class Recorder:
    """Pytest plugin that records the lines that each test executes, and its duration."""

    def __init__(self, coverage: Any) -> None:
        self.coverage = coverage
        self.seconds: dict[str, float] = defaultdict(float)

    def pytest_runtest_logstart(self, nodeid: str) -> None:
        """Notify coverage of the test that begins."""
        self.coverage.switch_context(nodeid)

    def pytest_runtest_logreport(self, report: Any) -> None:
        """Sum the durations of the phases of a test."""
        self.seconds[report.nodeid] += report.duration


def in_child(work: Any, limit_s: float) -> int:
    """Return the exit status of work() in a child process, negative if it took too long.

    The limit is on CPU time, since a busy machine may grant none for a while. A child that waits
    forever uses no CPU time, and is terminated after WAITING times as long in wall time.
    """
    pid = os.fork()
    if pid == 0:
        os.setsid()
        resource.setrlimit(resource.RLIMIT_CPU, (int(limit_s), int(limit_s) + 1))
        with open(os.devnull, 'w') as null:
            os.dup2(null.fileno(), 1)
            os.dup2(null.fileno(), 2)
        os._exit(int(work()))
    end = time.monotonic() + WAITING * limit_s
    while time.monotonic() < end:
        done, status = os.waitpid(pid, os.WNOHANG)
        if done:
            return os.waitstatus_to_exitcode(status)
        time.sleep(0.02)
    os.killpg(pid, signal.SIGKILL)
    os.waitpid(pid, 0)
    return -signal.SIGKILL


def record(folders: Sequence[str]) -> int:
    """Write the durations of quick tests below folders, and which lines each executes."""
    import coverage
    import pytest

    sys.path.insert(0, str(ROOT))
    measured = coverage.Coverage(data_file=None, source=[str(ROOT / PACKAGE)])
    measured.start()
    recorder = Recorder(measured)
    os.chdir(ROOT)
    pytest.main([*QUICK, *folders], plugins=[recorder])
    measured.stop()
    data = measured.get_data()
    tests = list(recorder.seconds)
    number = {test: i for i, test in enumerate(tests)}
    lines = {
        str(Path(file).relative_to(ROOT)): {
            line: [number[test] for test in contexts if test in number]
            for line, contexts in data.contexts_by_lineno(file).items()
        }
        for file in data.measured_files()
    }
    seconds = list(recorder.seconds.values())
    RECORD.write_text(json.dumps({'tests': tests, 'seconds': seconds, 'lines': lines}))
    return 0


def tests_for(bug: Bug, recorded: Mapping[str, Any]) -> list[str]:
    """Return the tests that execute the line of a bug: fast ones of the same room first."""
    tests, seconds = recorded['tests'], recorded['seconds']
    room = room_of(bug.path).split('/')[0]
    there = sorted(
        recorded['lines'][bug.path][str(bug.line)],
        key=lambda i: seconds[i] * (1.0 if room_of(tests[i]) == room else OTHER_ROOM),
    )
    out: list[int] = []
    total = 0.0
    for i in there:
        total += seconds[i]
        if out and total > MAX_TESTS_S:
            break
        out.append(i)
    return [tests[i] for i in out]


def is_caught(bug: Bug, tests: Sequence[str], folder: Path, limit_s: float) -> bool:
    """Return whether any test fails with a bug in a copy of the repository."""
    path = folder / bug.path
    before = path.read_bytes()
    times = path.stat()

    def run() -> int:
        import pytest

        os.chdir(folder)
        sys.path.insert(0, str(folder))
        files = sorted({test.split('::')[0] for test in tests})
        return pytest.main([*QUICK, '-x', *files], plugins=[Chosen(tests)])

    for compiled in path.parent.glob(f'__pycache__/{path.stem}.*'):
        compiled.unlink()
    path.write_bytes(before[: bug.begin] + bug.new.encode() + before[bug.end :])
    try:
        return in_child(run, limit_s) not in (0, NO_TESTS)
    finally:
        path.write_bytes(before)
        os.utime(path, ns=(times.st_atime_ns, times.st_mtime_ns))


def shown(bug: Bug) -> str:
    """Return the description of a bug in one line."""
    source = (ROOT / bug.path).read_bytes()
    old = source[bug.begin : bug.end].decode()
    texts = [' '.join(text.split())[:90] for text in (old, bug.new)]
    return f'{bug.path}:{bug.line}: {bug.kind}: {texts[0]}  ->  {texts[1]}'


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point; the exit status is 0 whichever bugs survive."""
    parser = argparse.ArgumentParser(prog='python -m tools.mutants', description=__doc__)
    parser.add_argument('rooms', nargs='*', help='rooms, for example checks io/formats; all')
    parser.add_argument('--count', type=int, default=10, help='bugs in a room (10)')
    parser.add_argument('--seed', type=int, default=1)
    parser.add_argument(
        '--record',
        nargs='*',
        help=f'run the quick tests of these folders (all: tests) instead of reading {RECORD.name}',
    )
    options = parser.parse_args(arguments)
    for name in THREADS:
        os.environ[name] = '1'
    if options.record or not RECORD.exists():
        folders = options.record or ['tests']
        # Run in a child, since this process must not import the package.
        in_child(lambda: record(folders), RECORD_S)
    recorded = json.loads(RECORD.read_text())
    candidates: dict[str, list[Bug]] = defaultdict(list)
    for file, lines in recorded['lines'].items():
        executed = {int(line) for line, tests in lines.items() if tests}
        if executed and file.endswith('.py') and (ROOT / file).exists():
            candidates[room_of(file)] += bugs_in(ROOT / file, executed)
    os.environ['PYTHONDONTWRITEBYTECODE'] = '1'
    sys.dont_write_bytecode = True
    for name in ('numpy', 'scipy.optimize', 'scipy.spatial', 'cv2', 'sklearn.neighbors', 'pytest'):
        __import__(name)  # import once for all children
    seconds = dict(zip(recorded['tests'], recorded['seconds']))
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place) / ROOT.name
        shutil.copytree(ROOT, folder, symlinks=True, ignore=shutil.ignore_patterns(*LEFT_OUT))
        os.environ['PYTHONPATH'] = str(folder)
        for room in options.rooms or sorted(candidates):
            chosen = _chosen(candidates[room], options.count, f'{options.seed} {room}')
            caught = 0
            for bug in chosen:
                tests = tests_for(bug, recorded)
                limit = MIN_LIMIT_S + 5 * sum(seconds[test] for test in tests)
                # Few tests catch most bugs, and loading all tests takes longer than running them.
                if any(is_caught(bug, tests[:n], folder, limit) for n in (FIRST, None)):
                    caught += 1
                else:
                    print(f'  survives {len(tests)} tests: {shown(bug)}', flush=True)
            print(f'{room}: {caught} of {len(chosen)} caught', flush=True)
    return 0


def _chosen(bugs: Sequence[Bug], count: int, seed: str) -> list[Bug]:
    """Return a random selection of bugs in different lines."""
    rng = random.Random(seed)
    of_line: dict[tuple[str, int], list[Bug]] = defaultdict(list)
    for bug in bugs:
        of_line[bug.path, bug.line].append(bug)
    places = rng.sample(sorted(of_line), min(count, len(of_line)))
    return [rng.choice(of_line[place]) for place in places]


if __name__ == '__main__':
    sys.exit(main())
