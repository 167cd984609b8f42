# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Output of the commands, and their termination by SIGINT and SIGTERM."""

from __future__ import annotations

import argparse
import contextlib
import os
import shlex
import shutil
import signal
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, TextIO

from ..errors import printable
from ..findings import Finding, Severity, summed_up

if TYPE_CHECKING:
    from pathlib import Path

    from ..checks.rig_watch import RigEvidence
    from ..estimation.rounds import Round

# Escape sequences (ECMA-48, select graphic rendition).
STYLES = {'red': '31;1', 'green': '32;1', 'yellow': '33', 'dim': '2'}
NOT_PASSED = 3  # exit status of a command whose verdict is not pass
VERDICTS = {'pass': 'green', 'fail': 'red', 'cannot tell': 'yellow'}


def styled(text: str, style: str, stream: TextIO) -> str:
    """Return a styled text on a terminal; the plain text elsewhere, and with NO_COLOR.

    https://no-color.org: NO_COLOR applies if it is not empty.
    """
    no_color = os.environ.get('NO_COLOR') or os.environ.get('TERM') == 'dumb'
    if not style or no_color or not stream.isatty():
        return text
    return f'\033[{STYLES[style]}m{text}\033[0m'


def styled_verdict(line: str, verdict: str) -> str:
    """Return the line of a verdict in its colour."""
    return styled(line, VERDICTS.get(verdict, ''), sys.stdout)


def print_result(
    arguments: argparse.Namespace,
    document: Mapping[str, Any],
    text: str,
    next_step: Sequence[object] = (),
) -> None:
    """Print a result: as JSON with --json, otherwise as text, followed by the next command."""
    if arguments.json:
        from ..io.documents import json_text

        is_utf_8 = (sys.stdout.encoding or '').lower().startswith('utf')
        print(json_text(document, ensure_ascii=not is_utf_8).rstrip('\n'))
        return
    print(text.rstrip('\n'))
    if next_step:
        command = ' '.join(shlex.quote(str(word)) for word in ('fluoro-calib', *next_step))
        print(styled(f'Next: {command}', 'dim', sys.stdout))


def print_note(note: object) -> None:
    """Print a text or finding on standard error."""
    print(styled(printable(str(note)), 'yellow', sys.stderr), file=sys.stderr)


def print_status(text: str) -> None:
    """Print the progress of a long command on standard error."""
    print(styled(printable(text), 'dim', sys.stderr), file=sys.stderr)


def print_notes(notes: Iterable[object]) -> None:
    """Print texts and findings on standard error, without repetitions."""
    for text in dict.fromkeys(map(str, notes)):
        print_note(text)


def print_findings(findings: Iterable[Finding], error: str) -> None:
    """Print the findings on a calibration on standard error; error: prefix of errors.

    Findings of one kind on many exposures become one line.
    """
    prefixes = {Severity.NOTE: 'not used: ', Severity.WARNING: '', Severity.ERROR: error}
    given = list(findings)
    for severity in (Severity.WARNING, Severity.NOTE, Severity.ERROR):
        for sentence in summed_up(f for f in given if f.severity is severity):
            print_note(f'{prefixes[severity]}{sentence}')


def print_unpaired(source: Path, unpaired: Mapping[str, int]) -> None:
    """Print the numbers of frames without a partner, if there are any."""
    lost = {name: count for name, count in unpaired.items() if count}
    if lost:
        counts = ', '.join(f'{name} {count}' for name, count in lost.items())
        print_note(
            f'{source}: frames without partner of the other fluoroscopes, not used: {counts}'
        )


def print_rig_evidence(source: Path, evidence: RigEvidence, reject: float) -> None:
    """Print what the rays of a recording say about its rig.

    reject: limit of false matches [standard deviations].
    """
    widening = None if evidence.drift is None else evidence.drift.widening
    for finding in (evidence.disagreement, widening, evidence.noise, evidence.timing):
        if finding is not None:
            print_note(f'{source}: {finding.sentence}')
    if evidence.widening > 1:
        advice = (
            '; check the sigma of the image points, whether they count from 1, how many are '
            'outside the calibrated area, and whether a fluoroscope has moved since its '
            'calibration'
        )
        print_note(
            f'{source}: the rays miss each other by more than their standard deviations allow; '
            f'the limit of false matches was widened {evidence.widening:.1f} times, to '
            f'{reject * evidence.widening:.1f} standard deviations'
            f'{advice if evidence.timing is None else ""}'
        )


def print_round(label: str, current: Round) -> None:
    """Print a round of a self-calibration, on a terminal only."""
    if sys.stderr.isatty():
        print_status(f'{label}: {current}')


def print_step(step: str, done: int, total: int) -> None:
    """Print a step of a validation, on a terminal only."""
    if sys.stderr.isatty():
        print_status(f'{100 * done // total:3d} %  {step}')


class ProgressBar:
    """A progress bar on a terminal, 'name: image 3 of 16'; a context manager.

    It shows nothing elsewhere. unit: name of the counted items.
    """

    def __init__(self, name: str, unit: str = 'image') -> None:
        self._name = name
        self._unit = unit
        self._bar: Any = None

    def __call__(self, done: int, total: int) -> None:
        """Show that `done` of `total` items are done; 0 if the total is unknown."""
        if self._bar is None:
            from tqdm import tqdm

            # tqdm shows nothing on a terminal of unknown width.
            self._bar = tqdm(
                desc=self._name,
                total=total or None,
                unit=self._unit,
                bar_format='{desc}: {unit} {n_fmt} of {total_fmt} {bar} {remaining}',
                disable=None,
                leave=False,
                ncols=shutil.get_terminal_size().columns,
            )
        self._bar.total = total or None
        self._bar.update(done - self._bar.n)

    def __enter__(self) -> ProgressBar:
        return self

    def __exit__(self, *error: object) -> None:
        if self._bar is not None:
            self._bar.close()


AGAIN_S = 1.0  # interval at which an unhandled exception is raised again


@contextlib.contextmanager
def terminated_by_signals() -> Iterator[None]:
    """Raise KeyboardInterrupt at SIGINT, SystemExit at SIGTERM, until the block ends.

    Python drops an exception that a signal handler raises in a destructor or in a callback of the
    garbage collector, and C code may clear it. Therefore it is raised again every second, unless
    it is being handled: cleanup is not interrupted.
    """
    raised: list[BaseException] = []

    def terminate(number: int, _: object) -> None:
        error = KeyboardInterrupt() if number == signal.SIGINT else SystemExit(128 + number)
        raised.append(error)
        _repeat_after(AGAIN_S)
        raise error

    def repeat(_number: int, _frame: object) -> None:
        if not _is_handled(raised):
            raise raised[-1]

    handlers: dict[int, Callable[[int, object], None]] = {
        signal.SIGINT: terminate,
        signal.SIGTERM: terminate,
    }
    if hasattr(signal, 'SIGALRM'):
        handlers[signal.SIGALRM] = repeat
    previous = {number: signal.signal(number, handlers[number]) for number in handlers}
    try:
        yield
    finally:
        _repeat_after(0.0)
        for number, handler in previous.items():
            signal.signal(number, handler)


def _repeat_after(interval_s: float) -> None:
    """Request SIGALRM at an interval, 0: no more; Windows has no such signal."""
    if hasattr(signal, 'setitimer'):
        signal.setitimer(signal.ITIMER_REAL, interval_s, interval_s)


def _is_handled(raised: list[BaseException]) -> bool:
    """Return whether the running code handles one of these exceptions, or one raised meanwhile."""
    error = sys.exc_info()[1]
    while error is not None:
        if error in raised:
            return True
        error = error.__context__
    return False
