"""Write the licence notice at the beginning of every source file that lacks it.

    python tools/add_notices.py

ament_copyright expects it there; tests/test_ament.py tests it without ament. Empty files and
setup.py, which lies beside package.xml, need none.
"""

from __future__ import annotations

import subprocess
import textwrap
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
HOLDER = 'fluoro_calib_ros maintainers'
YEAR = 2026
APPENDIX = 'Licensed under the Apache License, Version 2.0 (the "License");'


def notice() -> str:
    """Return the notice as comment lines; its text is that of the appendix of LICENSE."""
    licence = (ROOT / 'LICENSE').read_text()
    text = textwrap.dedent('   ' + licence[licence.rindex(APPENDIX) :]).rstrip()
    lines = [f'Copyright {YEAR} {HOLDER}', '', *text.splitlines()]
    return ''.join(f'# {line}'.rstrip() + '\n' for line in lines)


def sources() -> list[Path]:
    """Return the Python files of the project that need the notice."""
    listing = subprocess.run(
        ['git', 'ls-files', '-z', '*.py'], cwd=ROOT, capture_output=True, check=True
    )
    paths = [ROOT / name.decode() for name in filter(None, listing.stdout.split(b'\0'))]
    return [path for path in paths if path != ROOT / 'setup.py' and path.read_text()]


def add_notice(text: str) -> str:
    """Return a source with the notice, below a first line that names an interpreter."""
    first, rest = '', text
    if text.startswith('#!'):
        first, _, rest = text.partition('\n')
        first += '\n\n'
    return f'{first}{notice()}\n{rest.lstrip()}'


if __name__ == '__main__':
    for path in sources():
        text = path.read_text()
        if notice() not in text:
            path.write_text(add_notice(text))
            print(path.relative_to(ROOT))
