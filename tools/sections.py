# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Generated sections of the documentation, between the markers `begin: name` and `end: name`."""

from __future__ import annotations

import re
from pathlib import Path


def with_section(page: str, name: str, content: str) -> str:
    """Return the text of a page with the content of a named section replaced.

    Raise ValueError unless the page contains the markers of the section exactly once.
    """
    begin, end = f'<!-- begin: {name} -->\n', f'<!-- end: {name} -->'
    pattern = re.compile(f'{re.escape(begin)}.*?{re.escape(end)}', re.DOTALL)
    text, count = pattern.subn(lambda _: f'{begin}\n{content.strip()}\n\n{end}', page)
    if count != 1:
        raise ValueError(f'section {name}: {count} pairs of marks in the page, not one')
    return text


def write_section(page: Path, name: str, content: str) -> None:
    """Replace a section of a page; a missing page is created with this section only."""
    if page.exists():
        page.write_text(with_section(page.read_text(), name, content))
    else:
        page.write_text(content)


def show_section(content: str, page: Path | None, name: str) -> None:
    """Print a section, and write it into a page if one is given."""
    print(content)
    if page:
        write_section(page, name, content)
