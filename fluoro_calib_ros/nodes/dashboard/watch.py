# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The dashboard as a program: fluoro-calib watch."""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence

from .client import SessionClient, session_client
from .view import Dashboard, session_text

ONCE = '--once'
FIRST_REPORT_S = 5.0  # nodes report once a second, and have to be discovered first


def main(args: Sequence[str] | None = None) -> None:
    """Show the session in the terminal until a key ends it; with --once, print it and end."""
    words = list(sys.argv[1:] if args is None else args)
    once = ONCE in words
    if not once and not (sys.stdin.isatty() and sys.stdout.isatty()):
        sys.exit('fluoro-calib watch: this is no terminal; with --once the state is only printed')
    with session_client([word for word in words if word != ONCE]) as client:
        if once:
            _print(client)
        else:
            Dashboard(client).run()


def _print(client: SessionClient) -> None:
    """Print the state once, after the first reports."""
    from rich.console import Console

    end = time.monotonic() + FIRST_REPORT_S
    while time.monotonic() < end:
        time.sleep(0.1)
    state = client.state()
    Console().print(session_text(state))
    if not state.nodes:
        sys.exit(
            f'fluoro-calib watch: no node has reported in the namespace {state.namespace} within '
            f'{FIRST_REPORT_S:g} s'
        )
