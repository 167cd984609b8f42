# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Configuration of the documentation; `make docs` builds it."""

import sys
from pathlib import Path

DOCS = Path(__file__).resolve().parent
ROOT = DOCS.parent
PACKAGE = ROOT / 'fluoro_calib_ros'
sys.path.insert(0, str(ROOT))

project = 'fluoro_calib_ros'
author = 'fluoro_calib_ros maintainers'
copyright = author  # noqa: A001 Sphinx wants this name
release = '0.1.0'

extensions = ['myst_parser', 'sphinx.ext.autodoc', 'sphinx.ext.napoleon', 'sphinx.ext.viewcode']
source_suffix = {'.md': 'markdown', '.rst': 'restructuredtext'}
exclude_patterns = ['_build']
# A name such as RigOrientation is found in the module that defines it and in api.
suppress_warnings = ['ref.python', 'ref.term', 'ref.ref']
html_theme = 'furo'
html_title = project
myst_heading_anchors = 4

autodoc_member_order = 'bysource'
autodoc_typehints = 'signature'
autodoc_inherit_docstrings = False
napoleon_google_docstring = False
napoleon_use_ivar = True

# Rooms with a page of their own; the nodes are described in nodes.md.
ROOMS = (
    'exposures',
    'photogrammetry',
    'correction',
    'estimation',
    'reconstruction',
    'checks',
    'images',
    'simulation',
    'io',
    'report',
    'jobs',
)


def write_room(room):
    """Write the reference page of a room: a section for each of its modules."""
    lines = [room, '=' * len(room), '', f'.. automodule:: fluoro_calib_ros.{room}', '']
    for module in sorted((PACKAGE / room).rglob('*.py')):
        name = '.'.join(module.relative_to(PACKAGE).with_suffix('').parts)
        if module.stem != '__init__':
            lines += [name, '-' * len(name), '', f'.. automodule:: fluoro_calib_ros.{name}']
            lines += ['   :members:', '']
    text = '\n'.join(lines)
    page = DOCS / 'api' / f'{room}.rst'
    if not page.exists() or page.read_text() != text:
        page.write_text(text)


for _room in ROOMS:
    write_room(_room)
