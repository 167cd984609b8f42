# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The command fluoro-calib, one module for each subcommand; ROS is not needed."""

from __future__ import annotations

import argparse
import contextlib
import difflib
import sys
from collections.abc import Callable, Iterator, Sequence
from io import TextIOWrapper
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

from ..errors import DataError, printable, shortened
from ..limits import ReadLimits, use_read_limits
from ..report.versions import versions
from . import (
    adjust,
    bag,
    bodies,
    bridge,
    calibrate,
    compare,
    convert,
    correct,
    extract,
    heal,
    orient,
    phantom,
    process,
    reconstruct,
    report,
    simulate,
    survey,
    validate,
    watch,
)
from .arguments import add_read_limits, options_of
from .output import NOT_PASSED, print_status, styled, terminated_by_signals
from .rig import add_rig, find_rig

if TYPE_CHECKING:
    from ..io.rig_file import RigFile

# A command is a module with NAME, HELP, EXAMPLE, add_arguments(parser), run(arguments) and, if its
# arguments depend on each other, check(arguments, error). A command that gives a verdict has
# --exit-zero, and its run returns whether the verdict is pass.
COMMANDS = (
    simulate,
    phantom,
    extract,
    calibrate,
    adjust,
    correct,
    validate,
    report,
    compare,
    survey,
    orient,
    reconstruct,
    bodies,
    heal,
    convert,
    process,
    bag,
    watch,
    bridge,
)

READ_NOTHING = (simulate, phantom, process, watch, bridge)


# Groups of rarely used options: --help names them, --help-all shows them.
RARE = (
    'bags',
    'files of other programs',
    'limits of what is read',
    'adjustment',
    'images on a cluster',
)


class _Parser(argparse.ArgumentParser):
    """A parser of a command, with a short help, and a suggestion for a misspelt choice."""

    def format_usage(self) -> str:
        """Return the usage without the groups of RARE."""
        with self._short():
            return super().format_usage()

    def format_help(self) -> str:
        """Return the help without the groups of RARE."""
        with self._short() as hidden:
            text = super().format_help()
        end = self._get_formatter()
        if hidden:
            count = sum(len(group._group_actions) for group in hidden)
            titles = ', '.join(str(group.title) for group in hidden)
            end.add_text(f'--help-all shows {count} more options: {titles}')
        end.add_text(self.epilog)
        return '\n'.join(filter(None, [text, end.format_help()]))

    @contextlib.contextmanager
    def _short(self) -> Iterator[list[argparse._ArgumentGroup]]:
        """Leave out the groups of RARE, which are yielded, and the epilog."""
        whole = vars(self).copy()
        hidden = [group for group in self._action_groups if group.title in RARE]
        rare = [action for group in hidden for action in group._group_actions]
        self._action_groups = [group for group in self._action_groups if group not in hidden]
        self._actions = [action for action in self._actions if action not in rare]
        self._mutually_exclusive_groups = [
            group
            for group in self._mutually_exclusive_groups
            if not any(action in rare for action in group._group_actions)
        ]
        self.epilog = None
        try:
            yield hidden
        finally:
            vars(self).update(whole)

    def _check_value(self, action: argparse.Action, value: Any) -> None:
        try:
            super()._check_value(action, value)
        except argparse.ArgumentError as error:
            names = [str(choice) for choice in action.choices or ()]
            matches = difflib.get_close_matches(str(value), names, 1)
            if not matches:
                raise
            raise argparse.ArgumentError(
                action, f'{error.message}; did you mean {matches[0]!r}?'
            ) from None


class _Print(argparse.Action):
    """Prints the text that const returns for the parser and the value, and exits."""

    def __call__(self, parser: argparse.ArgumentParser, _: Any, value: Any, *__: Any) -> None:
        print(self.const(parser, value).rstrip('\n'))
        parser.exit()


def _versions(*_: object) -> str:
    """Return the versions, which are looked up only on demand."""
    package_versions = versions()
    program_version = package_versions.pop('fluoro_calib_ros')
    dependencies = ', '.join(f'{name} {version}' for name, version in package_versions.items())
    return f'fluoro_calib_ros {program_version} ({dependencies})'


def make_parser(
    command: str | None = None, rig: RigFile | None = None, kind: type[_Parser] = _Parser
) -> argparse.ArgumentParser:
    """Return the parser of the command line.

    Only the arguments of `command` are added, by default those of all commands: each command
    imports the modules that declare its options. rig: provides defaults of arguments. kind: class
    of the parser.
    """
    parser = kind(prog='fluoro-calib', description='Self-calibration of X-ray fluoroscopes.')
    parser.add_argument(
        '--version', action=_Print, nargs=0, const=_versions, help='print versions and exit'
    )
    parser.add_argument(
        '--print-completion',
        action=_Print,
        const=lambda _, shell: completion_script(make_parser(), shell),
        choices=SHELLS,
        help='print a script that completes the command line in a shell, and exit',
    )
    commands = parser.add_subparsers(dest='command', required=True, metavar='COMMAND')
    for module in COMMANDS:
        sub = commands.add_parser(
            module.NAME,
            help=module.HELP,
            description=module.HELP,
            epilog=f'example: {module.EXAMPLE}',
        )
        sub.set_defaults(module=module, parse=parse_words, rig_file=rig)
        if command in (None, module.NAME):
            sub.add_argument(
                '--help-all',
                action=_Print,
                nargs=0,
                const=lambda whole, _: argparse.ArgumentParser.format_help(whole),
                help='show all options and exit',
            )
            sub.add_argument(
                '--json', action='store_true', help='print the result as JSON on standard output'
            )
            module.add_arguments(sub)
            if module not in READ_NOTHING:
                add_read_limits(sub)
            add_rig(sub, module.NAME, rig)
    return parser


def parse_words(
    words: Sequence[str], error: Callable[[str], NoReturn] | None = None
) -> argparse.Namespace:
    """Parse and check the arguments of a command line.

    error is called with a sentence for an invalid argument; by default it is printed, and the
    process exits with 2. Raises DataError for an invalid rig.toml.
    """

    class Parser(_Parser):
        def error(self, message: str) -> NoReturn:
            if error is not None:
                error(message)
            super().error(message)

    command = _command_of(words)
    rig = find_rig(words, command)
    parser = make_parser(command, rig, Parser)
    options = parser.parse_args(words)
    if hasattr(options.module, 'check'):
        options.module.check(options, parser.error)
    return options


def _command_of(words: Sequence[str]) -> str:
    return next((word for word in words if not word.startswith('-')), '')


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line.

    Exit status 0: success, 1: failure caused by the data, 2: wrong usage, 3: success, but the
    verdict is not pass; 130 and 143 after SIGINT and SIGTERM, which leave neither unfinished
    output nor processes behind.
    """
    words = list(sys.argv[1:] if arguments is None else arguments)
    # Without arguments, this process is the command itself.
    with terminated_by_signals() if arguments is None else contextlib.nullcontext():
        _run(words)


def _run(words: list[str]) -> None:
    """Run the command given by words; exit with its status if that is not 0."""
    command = _command_of(words)
    if isinstance(sys.stdout, TextIOWrapper):  # like standard error: any name can be printed
        sys.stdout.reconfigure(errors='backslashreplace')
    try:
        options = parse_words(words)
        use_read_limits(options_of(ReadLimits, options))
        if options.rig_file is not None:
            print_status(f'defaults of {options.rig_file.path}')
        passed = options.module.run(options)
    except (DataError, OSError) as error:
        known_command = command if command in [module.NAME for module in COMMANDS] else ''
        program = styled(f'fluoro-calib {known_command}'.rstrip() + ':', 'red', sys.stderr)
        print(f'{program} {printable(shortened(str(error)))}', file=sys.stderr)
        sys.exit(1)
    except KeyboardInterrupt:
        sys.exit(130)
    if passed is False and not options.exit_zero:
        sys.exit(NOT_PASSED)


# Shell completion of the command line, by shtab.

SHELLS = ('bash', 'zsh', 'tcsh')


def completion_script(parser: argparse.ArgumentParser, shell: str) -> str:
    """Return the completion script of a command line. Raises DataError without shtab."""
    try:
        import shtab
    except ImportError:
        raise DataError(
            'shell completion needs shtab, which is not installed: pip install shtab'
        ) from None
    _complete_paths(parser, shtab.FILE)
    script: str = shtab.complete(parser, shell)
    return script


def _complete_paths(parser: argparse.ArgumentParser, complete: object) -> None:
    """Enable path completion for every argument that is a path, in all subcommands."""
    for action in parser._actions:
        if action.type is Path:
            action.complete = complete  # type: ignore[attr-defined]
        if isinstance(action, argparse._SubParsersAction):
            for sub in action.choices.values():
                _complete_paths(sub, complete)
