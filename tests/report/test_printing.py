# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The report as PDF, printed by a browser found on the path, here replaced by a script."""

import os
import stat

import pytest
from rigs import run

from fluoro_calib_ros.errors import DataError
from fluoro_calib_ros.jobs.report import BROWSERS, find_browser, print_page

PRINTS = """
for word in "$@"; do
    case "$word" in --print-to-pdf=*) echo '%PDF-1.4' > "${word#--print-to-pdf=}";; esac
    last=$word
done
echo "$last" > "$SEEN"
"""


@pytest.fixture
def page(tmp_path, monkeypatch):
    monkeypatch.setenv('PATH', str(tmp_path / 'bin'))
    monkeypatch.setenv('SEEN', str(tmp_path / 'seen'))
    (tmp_path / 'bin').mkdir()
    path = tmp_path / 'a report.html'
    path.write_text('<html></html>')
    return path


def browser(page, text, name=BROWSERS[0]):
    path = page.parent / 'bin' / name
    path.write_text(f'#!/bin/sh\n{text}')
    path.chmod(path.stat().st_mode | stat.S_IXUSR)
    return path


@pytest.mark.parametrize('name', BROWSERS)
def test_a_browser_prints_the_page(page, name):
    assert find_browser() is None
    path = browser(page, PRINTS, name)
    assert find_browser() == str(path)
    out = page.with_suffix('.pdf')
    print_page(page, out)
    assert out.read_bytes().startswith(b'%PDF-1.4')
    assert (page.parent / 'seen').read_text().strip() == page.as_uri()


@pytest.mark.parametrize(
    ('text', 'cause'),
    [
        (
            'echo "cannot open display" >&2; exit 3',
            'does not print the report (cannot open display)',
        ),
        ('exit 3', 'does not print the report (exit status 3)'),
        (PRINTS.replace('PDF', 'TXT'), 'does not print the report (exit status 0)'),
    ],
)
def test_a_browser_that_fails_is_named(page, text, cause):
    path = browser(page, text)
    out = page.with_suffix('.pdf')
    out.write_bytes(b'of yesterday')
    with pytest.raises(DataError) as caught:
        print_page(page, out)
    assert str(caught.value) == f'{out}: {path} {cause}'
    assert out.read_bytes() == b'of yesterday'


def test_without_a_browser_it_says_what_to_do(page):
    with pytest.raises(DataError, match='in any other browser and print it from there'):
        print_page(page, page.with_suffix('.pdf'))


def test_a_folder_that_is_no_result_is_not_printed(tmp_path, capsys):
    assert run('report', tmp_path, '--pdf') == 1
    assert not os.listdir(tmp_path)
