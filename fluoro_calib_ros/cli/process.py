# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""fluoro-calib process: calibrate, and process all trials of a study.

Each step is a command of fluoro-calib as it could be typed in the folder of the study. A step is
repeated only if its options, its inputs or the program have changed. Trials run in separate
processes, and a failed trial does not stop the others.
"""

from __future__ import annotations

import argparse
import hashlib
import os
import shlex
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

from ..errors import DataError, shortened
from ..io.rig_file import STUDY
from .arguments import add_shared, input_paths
from .output import NOT_PASSED, print_result, print_status

if TYPE_CHECKING:
    import subprocess

    from ..io.rig_file import Options, StudyFile, Trial
    from ..processes import Programs

NAME = 'process'
HELP = 'Calibrate, and process all trials of a study: one file in, one table out.'
EXAMPLE = 'fluoro-calib process knee_study'
STATE = 'study.json'  # completed steps, with digests of their inputs
TABLE = 'trials.csv'
LOG = 'log.txt'
PROMPT = '$ '  # before a command in the log
POLL_S = 0.05  # interval between polls of the running commands
SOURCE = 'source'
OF_PROCESS = ('out', 'calibration', 'json', 'help', 'help_all', SOURCE)
# Options of trials whose output is one for all of them: each trial would replace that of another.
OF_ONE_TRIAL = ('learn', 'overlay')
WRONG_DRIFT = ('warn', 'error')


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.add_argument(
        'study', type=Path, metavar='STUDY', help=f'folder with a {STUDY}, or the file'
    )
    add_shared(
        parser,
        'workers',
        default=os.cpu_count() or 1,
        help='trials that are processed at a time (default: as many as there are cores)',
    )
    parser.add_argument('--again', action='store_true', help='do all steps again')
    parser.add_argument(
        '--dry-run',
        action='store_true',
        help='print the commands of the study without running them',
    )
    add_shared(parser, 'exit_zero')


@dataclass(frozen=True)
class Step:
    """A command of a study."""

    trial: str  #: name of the trial, '' for the calibration
    words: tuple[str, ...]  #: command line in the folder of the study, without the program
    inputs: tuple[Path, ...]  #: files and folders that it reads
    out: Path

    @property
    def command(self) -> str:
        """Name of the command."""
        return self.words[0]

    @property
    def name(self) -> str:
        """Name of the step in its trial; for conversions with the format."""
        suffix = self.out.suffix if self.command == 'convert' else ''
        return f'{self.command}{suffix.replace(".", " ")}'

    @property
    def key(self) -> str:
        """Name of the step in the study."""
        return f'{self.trial}: {self.name}'.removeprefix(': ')

    @property
    def document(self) -> Path:
        """File for the output of the step with --json."""
        return self.out.parent / f'{self.name.replace(" ", "_")}.json'


@dataclass(frozen=True)
class Done:
    """Result of a step."""

    status: int  #: exit status
    document: Mapping[str, Any]  #: output with --json
    message: str = ''  #: cause of the failure, '' if there is none

    @property
    def ok(self) -> bool:
        """Whether there is a result."""
        return self.status in (0, NOT_PASSED)


Parse = Callable[[Sequence[str], Callable[[str], NoReturn]], argparse.Namespace]


def run(arguments: argparse.Namespace) -> bool:
    """Process a study; return whether all of its verdicts are pass. Raises DataError."""
    from ..io.rig_file import read_study

    study = read_study(arguments.study)
    with working_directory(study.folder):
        calibration, trials = study_steps(study, arguments.parse)
        if arguments.dry_run:
            steps = [*calibration, *(step for steps in trials.values() for step in steps)]
            commands = [shlex.join(('fluoro-calib', *step.words)) for step in steps]
            print_result(arguments, {'commands': commands}, '\n'.join(commands))
            return True
        return _process(arguments, study, calibration, trials)


@contextmanager
def working_directory(folder: Path) -> Iterator[None]:
    """Change the working directory until the block ends."""
    previous_folder = Path.cwd()
    os.chdir(folder)
    try:
        yield
    finally:
        os.chdir(previous_folder)


def _process(
    arguments: argparse.Namespace,
    study: StudyFile,
    calibration: Sequence[Step],
    trials: Mapping[str, Sequence[Step]],
) -> bool:
    """Run all steps in the working directory, write the table and print it. Raises DataError."""
    from ..io.calibration import rig_verdict
    from ..io.csv_table import Table
    from ..processes import Programs

    with Programs() as programs:
        work = _Work(study.out, programs, again=arguments.again)
        work.run([calibration], 1)
        failed = [work.done[step.key] for step in calibration if not work.done[step.key].ok]
        if failed:
            raise DataError(
                f'no calibration: {failed[0].message} ({study.folder / study.out / LOG})'
            )
        verdict = rig_verdict(study.calibration)
        if verdict == 'fail':
            raise DataError(
                'the verdict of the calibration is fail, the trials are not processed: '
                f'fluoro-calib report {study.folder / study.calibration} shows the reasons'
            )
        work.run(trials.values(), arguments.workers)
    rows = [
        trial_row(name, verdict, [(step, work.done.get(step.key)) for step in steps])
        for name, steps in trials.items()
    ]
    columns = tuple(dict.fromkeys(key for row in rows for key in row))
    table = Table(columns, ([row.get(column, '') for column in columns] for row in rows))
    table.write(study.out / TABLE)
    path = study.folder / study.out / TABLE
    verdicts = Counter(row['verdict'] for row in rows)
    counts = ', '.join(f'{count} {name}' for name, count in sorted(verdicts.items()))
    lines = [
        f'{row["trial"]}: {row["verdict"]}' + (f', {row["cause"]}' if row['cause'] else '')
        for row in rows
    ]
    lines.append(f'calibration: {verdict}; {len(rows)} trials: {counts}; table: {path}')
    print_result(
        arguments,
        {'calibration': verdict, 'trials': rows, 'table': str(path)},
        '\n'.join(lines),
    )
    refused = sum(row['verdict'] == 'refused' for row in rows)
    if refused:
        raise DataError(f'{refused} of {len(rows)} trials failed; {path} names the causes')
    return verdict == 'pass' and all(row['verdict'] == 'pass' for row in rows)


def study_steps(study: StudyFile, parse: Parse) -> tuple[list[Step], dict[str, list[Step]]]:
    """Return the steps of the calibration, and those of each trial, with checked options.

    The working directory must be the folder of the study. Raises DataError for an invalid option.
    """
    calibration_steps = []
    if study.calibrate is not None:
        words = ('', str(study.calibrate[SOURCE]), str(study.calibration))
        calibration_steps.append(_step(study, parse, 'calibrate', study.calibrate, words))
    return calibration_steps, {
        trial.name: list(_trial_steps(study, trial, parse)) for trial in study.trials
    }


def _trial_steps(study: StudyFile, trial: Trial, parse: Parse) -> Iterator[Step]:
    """Yield the steps of a trial."""
    folder = study.out / trial.name
    source = str(trial.path)
    for command, name in (
        ('extract', 'observations.csv'),
        ('reconstruct', 'points.csv'),
        ('bodies', 'motion'),
    ):
        if command in study.commands:
            out = str(folder / name)
            words = (trial.name, source, '--calibration', str(study.calibration), out)
            yield _step(study, parse, command, study.commands[command], words)
            source = out if command == 'extract' else source
    for kind, options in study.convert.items():
        out = str(folder / f'points.{kind}')
        words = (trial.name, str(folder / 'points.csv'), '--to', kind, out)
        yield _step(study, parse, 'convert', options, words)


def _step(
    study: StudyFile, parse: Parse, command: str, options: Options, words: Sequence[str]
) -> Step:
    """Return a step that the parser of its command has checked. Raises DataError.

    words: arguments that do not come from the options; the first is the name of the trial, and
    the last the output.
    """
    trial, *given, out = words

    def error(message: str) -> NoReturn:
        raise DataError(f'{study.path}, table {command}: {message}')

    all_words = [command, *given, '--out', out]
    for key, value in options.items():
        name = key.replace('-', '_')
        if name in OF_PROCESS and (command, name) != ('calibrate', SOURCE):
            error(f'the key {key} is set by the study')
        if name in OF_ONE_TRIAL:
            error(f'each trial would replace what {key} writes: give --{key} to a single command')
        if name != SOURCE:
            all_words += _option_words(key, value, error)
    arguments = parse(all_words, error)
    paths = input_paths(arguments)
    paths += [arguments.rig_file.path] if arguments.rig_file is not None else []
    return Step(trial, tuple(all_words), tuple(paths), Path(out))


def _option_words(key: str, value: Any, error: Callable[[str], NoReturn]) -> list[str]:
    """Return an option as words of the command line."""
    word = '--' + key.replace('_', '-')
    if isinstance(value, bool):
        return [word] if value else []
    if isinstance(value, list):
        return [part for item in value for part in _option_words(key, item, error)]
    if not isinstance(value, str | int | float):
        error(f'the key {key} is neither a text nor a number, true, false or a list')
    return [f'{word}={value}']


class _Work:
    """Runs steps as programs, and skips those that were completed earlier."""

    def __init__(self, out: Path, programs: Programs, again: bool) -> None:
        from ..io.access import make_folder
        from ..io.documents import read_json

        self.done: dict[str, Done] = {}
        self._out = out
        self._programs = programs
        make_folder(out)
        path = out / STATE
        self._state: dict[str, Any] = read_json(path) if path.exists() and not again else {}

    def run(self, chains: Iterable[Sequence[Step]], workers: int) -> None:
        """Run chains of steps, at most `workers` at a time; a chain stops at a failed step."""
        chains = list(chains)
        waiting = [self._run(c, f'{n} of {len(chains)}') for n, c in enumerate(chains, 1)]
        running: list[Iterator[None]] = []
        while waiting or running:
            free = workers - len(running)
            running += waiting[:free]
            del waiting[:free]
            running = [chain for chain in running if next(chain, 'ended') != 'ended']
            time.sleep(POLL_S if running else 0)

    def _run(self, chain: Sequence[Step], place: str) -> Iterator[None]:
        """Run the incomplete steps of a chain until one fails; yield while a program runs."""
        for step in chain:
            digest = digest_of(step)
            done = self._kept(step, digest)
            if done is None:
                process = self._started(step, place)
                while process.poll() is None:
                    yield
                done = self._ended(step, digest, int(process.returncode))
            self.done[step.key] = done
            if not done.ok:
                return

    def _started(self, step: Step, place: str) -> subprocess.Popen[Any]:
        """Start the program of a step."""
        from ..io.access import make_folder

        folder = step.out.parent
        make_folder(folder)
        print_status(f'{step.key} ({place})')
        with open(folder / LOG, 'a', encoding='utf-8') as log:
            log.write(f'{PROMPT}{shlex.join(("fluoro-calib", *step.words))}\n')
        command = 'fluoro_calib_ros.cli', *step.words, '--json'
        return self._programs.run(*command, log=folder / LOG, out=step.document)

    def _kept(self, step: Step, digest: str) -> Done | None:
        """Return the earlier result of a step with the same options, inputs and program."""
        from ..io.documents import read_json

        entry = self._state.get(step.key)
        if not isinstance(entry, dict) or entry.get('digest') != digest:
            return None
        if not step.out.exists() or not step.document.exists():
            return None
        return Done(int(entry['status']), read_json(step.document))

    def _ended(self, step: Step, digest: str, status: int) -> Done:
        """Record the end of a step; return its result."""
        from ..io.documents import read_json, write_json

        done = Done(status, {})
        if done.ok:
            done = replace(done, document=read_json(step.document))
            self._state[step.key] = {'digest': digest, 'status': status}
        else:
            done = replace(done, message=_last_line(step.out.parent / LOG))
            self._state.pop(step.key, None)
            print_status(f'{step.key}: {done.message}')
        write_json(self._out / STATE, self._state)
        return done


def _last_line(path: Path) -> str:
    """Return the last line of a log, which is the final message of a command, if it has one."""
    last = path.read_text(errors='replace').strip().splitlines()[-1]
    return 'it ended without a message' if last.startswith(PROMPT) else shortened(last)


def digest_of(step: Step) -> str:
    """Return a digest of a step: version of the program, words, and state of its inputs.

    The state of a file is its size and modification time, as in make.
    """
    try:
        program = version('fluoro_calib_ros')
    except PackageNotFoundError:
        program = 'from source'
    digest = hashlib.sha256('\0'.join((program, *step.words)).encode())
    for path in step.inputs:
        files = sorted(path.rglob('*')) if path.is_dir() else [path]
        for file in files:
            if file.is_file():
                state = file.stat()
                digest.update(f'\0{file}\0{state.st_size}\0{state.st_mtime_ns}'.encode())
    return digest.hexdigest()


def trial_row(
    name: str, calibration: str, steps: Iterable[tuple[Step, Done | None]]
) -> dict[str, Any]:
    """Return the row of a trial in the table; calibration: verdict on the calibration.

    The verdict is 'refused' if a command failed, 'fail' if the trial contradicts its calibration
    or its bodies, and 'cannot tell' instead of pass if targets, bodies or stamps are doubtful;
    otherwise that of the calibration.
    """
    row: dict[str, Any] = {'trial': name, 'verdict': calibration, 'cause': ''}
    for step, done in steps:
        if done is None:  # an earlier step has failed
            continue
        if not done.ok:
            row |= {'verdict': 'refused', 'cause': done.message}
        elif step.command == 'reconstruct':
            row |= _reconstruction_cells(row, done.document)
        elif step.command == 'bodies':
            row |= _bodies_cells(row, done.document)
    return row


def _reconstruction_cells(row: Mapping[str, Any], document: Mapping[str, Any]) -> dict[str, Any]:
    """Return the cells that a reconstruction adds to the row of a trial."""
    cells = {
        'frames': document['frames'],
        'points': document['points'],
        'points_ok': document['status']['OK'],
    }
    cells |= _rig_cells(row, document)
    return cells | _doubts({**row, **cells}, document['lost_targets'])


def _rig_cells(row: Mapping[str, Any], document: Mapping[str, Any]) -> dict[str, Any]:
    """Return the cells on what rays and stamps of a trial say about its rig."""
    drift = document.get('drift') or {}
    widening = document.get('widening', 1.0)
    cells = {'widening': widening, 'drift': drift.get('kind', '')}
    if drift.get('level') in WRONG_DRIFT:
        return cells | {'verdict': 'fail', 'cause': drift['message']}
    timing = document.get('timing')
    if timing is not None or widening > 1:
        cause = 'the rays miss each other by more than their standard deviations allow'
        return cells | {'verdict': 'fail', 'cause': timing['sentence'] if timing else cause}
    disagreement = document.get('disagreement')
    return cells | _doubts(row, [disagreement] if disagreement else [])


def _bodies_cells(row: Mapping[str, Any], document: Mapping[str, Any]) -> dict[str, Any]:
    """Return the cells that poses and joints add to the row of a trial."""
    cells: dict[str, Any] = {}
    for name, body in document['bodies'].items():
        cells |= {f'{name}_{key}': body[key] for key in ('poses', 'sd_mm', 'sd_deg')}
    for joint, angles in document['joints'].items():
        for name, angle in angles.items():
            cells |= {f'{joint}_{name}_{key}': angle[key] for key in ('range_deg', 'sd_deg')}
    cells |= _rig_cells(row, document)
    return cells | _doubts({**row, **cells}, document['findings'])


def _doubts(row: Mapping[str, Any], findings: Iterable[Mapping[str, Any]]) -> dict[str, Any]:
    """Return verdict and cause of a trial that would have a better one without these findings."""
    doubtful = [finding for finding in findings if finding['severity'] != 'note']
    is_wrong = any(finding['severity'] == 'error' for finding in doubtful)
    if not doubtful or row['verdict'] not in ('pass', 'cannot tell' if is_wrong else 'pass'):
        return {}
    return {
        'verdict': 'fail' if is_wrong else 'cannot tell',
        'cause': '; '.join(finding['sentence'] for finding in doubtful),
    }
