# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The linters of ament if they are installed, and otherwise their rules.

flake8 has the rules of ruff, see tests/test_lint.py; package.xml follows REP 149.
"""

import importlib.util
import re
import shutil
import subprocess
import sys
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = (ROOT, ROOT / 'msg_defs')
# As in pyproject.toml: a summary may take two lines, be a noun, and start in lower case.
PEP257 = ['D101', 'D102', 'D103', 'D105', 'D107', 'D205', 'D400', 'D401', 'D403']
PYTHON = subprocess.run(
    ['git', 'ls-files', '*.py'], cwd=ROOT, capture_output=True, text=True, check=True
).stdout.split()


@pytest.mark.parametrize(
    'linter, arguments',
    [
        ('ament_flake8', ['--config', 'setup.cfg', *PYTHON]),
        ('ament_pep257', ['--convention', 'numpy', '--add-ignore', *PEP257, '--', *PYTHON]),
        ('ament_xmllint', ['package.xml', 'msg_defs/package.xml']),
    ],
    ids=lambda value: value if isinstance(value, str) else '',
)
def test_ament_linter_is_content(linter, arguments):
    """Run each linter in a process of its own: the linters parse sys.argv and keep state."""
    if importlib.util.find_spec(linter) is None:
        pytest.skip(f'{linter} is not installed')
    if linter == 'ament_xmllint' and not shutil.which('xmllint'):
        pytest.skip('xmllint is not installed')
    done = subprocess.run(
        [sys.executable, '-m', f'{linter}.main', *arguments],
        cwd=ROOT,
        capture_output=True,
        text=True,
    )
    assert not done.returncode, (done.stdout + done.stderr)[-3000:]


# ---- the same rules without ament


DEPENDENCIES = (
    'build_depend',
    'build_export_depend',
    'buildtool_depend',
    'buildtool_export_depend',
    'exec_depend',
    'depend',
    'doc_depend',
    'test_depend',
    'conflict',
    'replace',
)
GROUPS = ('group_depend', 'member_of_group')
# Elements of package_format3.xsd with their least and greatest number. Groups come in this
# order; the elements within a group may come in any order.
ELEMENTS = (
    (('name',), 1, 1),
    (('version',), 1, 1),
    (('description',), 1, 1),
    (('maintainer',), 1, None),
    (('license',), 1, None),
    (('url',), 0, None),
    (('author',), 0, None),
    (DEPENDENCIES, 0, None),
    (('group_depend',), 0, None),
    (('member_of_group',), 0, None),
    (('export',), 0, 1),
)
ATTRIBUTES = {
    'maintainer': {'email'},
    'license': {'file'},
    'url': {'type'},
    'author': {'email'},
    **{tag: {'condition'} for tag in (*DEPENDENCIES, *GROUPS)},
}


@pytest.fixture(params=PACKAGES, ids=lambda path: path.name)
def package(request):
    """Return the folder and the root element of a package.xml."""
    return request.param, ElementTree.parse(request.param / 'package.xml').getroot()


def test_package_xml_has_the_elements_of_format_3(package):
    _, root = package
    assert root.tag == 'package' and root.attrib == {'format': '3'}
    places = [next(i for i, (tags, *_) in enumerate(ELEMENTS) if e.tag in tags) for e in root]
    assert places == sorted(places), [element.tag for element in root]
    for place, (tags, least, most) in enumerate(ELEMENTS):
        assert least <= places.count(place) <= (most or len(places)), tags
    for element in root:
        assert set(element.attrib) <= ATTRIBUTES.get(element.tag, set()), element.tag
        assert element.tag == 'export' or (element.text or '').strip() == element.text


def test_package_xml_has_valid_values(package):
    folder, root = package
    assert re.fullmatch(r'[a-z](_?[a-z0-9])*', root.findtext('name'))
    assert re.fullmatch(r'\d+\.\d+\.\d+', root.findtext('version'))
    assert '\n' not in root.findtext('description')
    for person in (*root.findall('maintainer'), *root.findall('author')):
        assert re.fullmatch(r'[^@\s]+@[^@\s]+', person.get('email'))
    for url in root.findall('url'):
        assert url.get('type', 'website') in ('website', 'bugtracker', 'repository')
        assert re.fullmatch(r'https?://\S+', url.text)
    for element in root:
        if element.tag in (*DEPENDENCIES, *GROUPS):
            assert re.fullmatch(r'[A-Za-z][A-Za-z0-9_-]*', element.text), element.text
    named = [(e.tag, e.text) for e in root if e.tag in DEPENDENCIES]
    assert len(named) == len(set(named)), 'no dependency is named twice'
    assert (folder / root.find('license').get('file')).is_file()
    assert root.findtext('export/build_type') in ('ament_python', 'ament_cmake')


def test_author_is_the_one_whom_the_licence_names(package):
    folder, root = package
    assert root.find('url') is not None
    holder = re.search(
        r'^ *Copyright \d{4} (.+)$', (folder / 'LICENSE').read_text(), re.MULTILINE
    ).group(1)
    assert [author.text for author in root.findall('author')] == [holder]
