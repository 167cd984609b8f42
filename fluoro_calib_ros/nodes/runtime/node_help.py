# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What a node prints with --help: its task, how to start it, and its parameters."""

from __future__ import annotations

import shutil
import textwrap
from collections.abc import Sequence
from types import ModuleType

from ...options import Option
from .parameters import parameters_of, settable_parameters

MAX_WIDTH = 100


def asks_for_help(arguments: Sequence[str]) -> bool:
    """Return whether -h or --help is among the arguments in front of those of ROS."""
    words = list(arguments)
    if '--ros-args' in words:
        words = words[: words.index('--ros-args')]
    return any(word in ('-h', '--help') for word in words)


def help_text(module: ModuleType) -> str:
    """Return the help of the node of a module: its docstring, usage and PARAMETERS."""
    name = module.__name__.rpartition('.')[2]
    if name == '__main__' and module.__spec__ is not None:
        name = module.__spec__.name.rpartition('.')[2]
    width = min(MAX_WIDTH, shutil.get_terminal_size().columns)
    task = ' '.join((module.__doc__ or '').strip().partition('\n\n')[0].split())
    settable = settable_parameters(module.PARAMETERS)
    lines = [
        f'usage: {name} [--ros-args -p PARAMETER:=VALUE ... -r __ns:=/NAMESPACE]',
        '',
        *textwrap.wrap(task, width),
        '',
        'parameters (* may change while the node runs):',
    ]
    for parameter, declaration in parameters_of(module.PARAMETERS).items():
        mark = ' *' if parameter in settable else ''
        lines.append(f'  {parameter}{mark}')
        lines += textwrap.wrap(
            _description(declaration), width, initial_indent=' ' * 6, subsequent_indent=' ' * 6
        )
    lines += ['', 'topics, services and the meaning of the diagnostics: docs/nodes.md']
    return '\n'.join(lines)


def _description(declaration: Option) -> str:
    """Return description, values and default of a parameter."""
    default = declaration.default
    text = declaration.help
    if declaration.minimum is not None and declaration.maximum is not None:
        text += f'; {declaration.minimum:g} to {declaration.maximum:g}'
    if isinstance(default, bool):
        shown = str(default).lower()
    elif isinstance(default, tuple):
        shown = f'[{", ".join(map(str, default))}]'
    else:
        shown = str(default) if default != '' else "''"
    return f'{text} (default: {shown})'
