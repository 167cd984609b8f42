# Copyright 2026 fluoro_calib_ros maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""Write the licence notice at the beginning of every source file that lacks it.

    python tools/add_notices.py

ament_copyright expects it there; tests/test_ament.py tests it without ament. Empty files and
setup.py, which lies beside package.xml, need none.
"""

from __future__ import annotations

import re
import subprocess
import textwrap
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
HOLDER = 'fluoro_calib_ros maintainers'
YEAR = 2026
COMMENTS = {'.py': '#', '.cpp': '//', '.hpp': '//'}
APPENDIX = 'Licensed under the Apache License, Version 2.0 (the "License");'


def notice(comment: str) -> str:
    """Return the notice as lines of comment; its text is that of the appendix of LICENSE."""
    licence = (ROOT / 'LICENSE').read_text()
    text = textwrap.dedent('   ' + licence[licence.rindex(APPENDIX) :]).rstrip()
    lines = [f'Copyright {YEAR} {HOLDER}', '', *text.splitlines()]
    return ''.join(f'{comment} {line}'.rstrip() + '\n' for line in lines)


def sources() -> list[Path]:
    """Return the files of the project that need the notice."""
    patterns = [f'*{suffix}' for suffix in COMMENTS]
    listing = subprocess.run(
        ['git', 'ls-files', '-z', *patterns], cwd=ROOT, capture_output=True, check=True
    )
    paths = [ROOT / name.decode() for name in filter(None, listing.stdout.split(b'\0'))]
    return [path for path in paths if path != ROOT / 'setup.py' and path.read_text()]


def has_notice(path: Path) -> bool:
    """Return whether a file begins with the notice, below a line that names an interpreter."""
    text = re.sub(r'^#!.*\n+', '', path.read_text())
    return text.startswith(notice(COMMENTS[path.suffix]))


def add_notice(path: Path) -> None:
    """Write the notice at the beginning of a file, below a line that names an interpreter."""
    first, rest = '', path.read_text()
    if rest.startswith('#!'):
        first, _, rest = rest.partition('\n')
        first += '\n\n'
    path.write_text(f'{first}{notice(COMMENTS[path.suffix])}\n{rest.lstrip()}')


if __name__ == '__main__':
    for path in sources():
        if not has_notice(path):
            add_notice(path)
            print(path.relative_to(ROOT))
