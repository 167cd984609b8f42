# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Completion of the command line in shells, by shtab."""

from __future__ import annotations

import argparse
from pathlib import Path

from ..errors import DataError

SHELLS = ('bash', 'zsh', 'tcsh')


def completion_script(parser: argparse.ArgumentParser, shell: str) -> str:
    """Return the script that completes a command line. Raises DataError without shtab."""
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
    """Let every argument that is a path be completed as one, in all subcommands."""
    for action in parser._actions:
        if action.type is Path:
            action.complete = complete  # type: ignore[attr-defined]
        if isinstance(action, argparse._SubParsersAction):
            for sub in action.choices.values():
                _complete_paths(sub, complete)
