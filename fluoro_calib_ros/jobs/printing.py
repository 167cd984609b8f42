# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Print a report as PDF, by a browser of this machine.

The report draws rig, radiographs and residuals by script, which only a browser runs.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import tempfile
from pathlib import Path

from ..errors import DataError
from ..io.access import PathLike, write_bytes

BROWSERS = (
    *('chromium', 'chromium-browser', 'google-chrome', 'google-chrome-stable', 'chrome'),
    *('microsoft-edge', 'microsoft-edge-stable', 'msedge'),
)
# Where Windows and macOS have them, which is on no path.
PLACES = (
    r'%ProgramFiles(x86)%\Microsoft\Edge\Application\msedge.exe',
    r'%ProgramFiles%\Google\Chrome\Application\chrome.exe',
    '/Applications/Google Chrome.app/Contents/MacOS/Google Chrome',
    '/Applications/Microsoft Edge.app/Contents/MacOS/Microsoft Edge',
)
TIMEOUT_S = 300.0  # a report takes some seconds
PDF_START = b'%PDF-'


def find_browser() -> str | None:
    """Return a browser that prints without a window, None where there is none."""
    known = (os.path.expandvars(place) for place in PLACES)
    return next(filter(None, map(shutil.which, (*BROWSERS, *known))), None)


def print_page(page: PathLike, out: PathLike) -> None:
    """Write a page of this machine as PDF. Raises DataError without a browser."""
    browser = find_browser()
    if browser is None:
        raise DataError(
            f'{out}: neither Chromium, Chrome nor Edge is installed, which print the report; open '
            f'{page} in any other browser and print it from there'
        )
    with tempfile.TemporaryDirectory() as folder:
        printed = Path(folder) / 'page.pdf'
        words = [
            *(browser, '--headless', '--disable-gpu', '--no-first-run', '--no-pdf-header-footer'),
            *(f'--user-data-dir={folder}/profile', f'--print-to-pdf={printed}'),
            Path(page).resolve().as_uri(),
        ]
        if hasattr(os, 'geteuid') and os.geteuid() == 0:
            words.insert(
                1, '--no-sandbox'
            )  # with which it refuses to run as root, as in containers
        try:
            done = subprocess.run(words, capture_output=True, timeout=TIMEOUT_S, check=False)
            content = printed.read_bytes() if printed.exists() else b''
        except (OSError, subprocess.TimeoutExpired) as error:
            raise DataError(f'{out}: {browser} does not print the report ({error})') from None
    if not content.startswith(PDF_START):
        said = done.stderr.decode(errors='replace').strip().splitlines()
        cause = said[-1] if said else f'exit status {done.returncode}'
        raise DataError(f'{out}: {browser} does not print the report ({cause})')
    write_bytes(out, content)
