# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The documentation: links resolve, and generated sections are replaced between their marks."""

import re
from pathlib import Path

import pytest

from tools.sections import with_section, write_section

ROOT = Path(__file__).parents[1]
PAGES = sorted(
    [*(ROOT / 'docs').rglob('*.md'), *ROOT.glob('*.md'), *(ROOT / 'examples').glob('*.md')]
)
SOURCES = [
    path
    for folder in (
        'fluoro_calib_ros',
        'benchmarks',
        'tools',
        'tests',
        'config',
        'examples',
        'fuzz',
    )
    for path in (ROOT / folder).rglob('*')
    if path.suffix in ('.py', '.md', '.xml', '.yaml', '.ipynb')
]


@pytest.mark.parametrize('page', PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_lead_to_files(page):
    links = re.findall(r'\]\(([^)\s]+)\)', page.read_text())
    relative = [link.partition('#')[0] for link in links if '://' not in link]
    assert not [link for link in relative if link and not (page.parent / link).exists()]


def test_pages_that_sources_name_exist():
    named = {
        match
        for path in [*SOURCES, ROOT / 'Makefile']
        for match in re.findall(r'\bdocs/[\w/]+\.(?:md|svg|png)\b', path.read_text())
    }
    assert named and not [name for name in named if not (ROOT / name).exists()]


def test_picture_of_the_rooms_shows_those_that_there_are():
    """The order is that of the import contract, without entry_points, which only names others."""
    layers = re.search(r'^layers = \[(.*?)^\]', (ROOT / 'pyproject.toml').read_text(), re.M | re.S)
    rooms = re.findall(r'\w+', layers[1])
    picture = (ROOT / 'docs/images/architecture.svg').read_text()
    drawn = re.findall(r'font-weight="bold">(\w+)<', picture)
    assert drawn == [room for room in rooms if room != 'entry_points']


def test_section_is_replaced_between_its_marks(tmp_path):
    page = tmp_path / 'page.md'
    page.write_text('# Page\n\n<!-- begin: a -->\n\nold\n\n<!-- end: a -->\n\nrest\n')
    write_section(page, 'a', r'new \1')
    assert page.read_text() == (
        '# Page\n\n<!-- begin: a -->\n\nnew \\1\n\n<!-- end: a -->\n\nrest\n'
    )
    write_section(page, 'a', r'new \1')
    assert page.read_text().count('new') == 1
    with pytest.raises(ValueError, match='section b: 0'):
        with_section(page.read_text(), 'b', '')
    write_section(tmp_path / 'alone.md', 'a', 'text')
    assert (tmp_path / 'alone.md').read_text() == 'text'
