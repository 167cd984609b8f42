# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Foreign documents: the worst cases of their size, and structures that grow."""

import resource
import subprocess
import sys
from pathlib import Path

import pytest

from fluoro_calib_ros.errors import DataError
from fluoro_calib_ros.io import documents
from fluoro_calib_ros.io.formats import registry
from fluoro_calib_ros.io.formats.content import FileSettings
from fluoro_calib_ros.io.observations import read_observations_csv
from fluoro_calib_ros.limits import DOCUMENT_BYTES, MAX_DEPTH, MAX_ROWS

ROOT = Path(__file__).parents[2]
PARSE = {
    'TOML': documents.parse_toml,
    'YAML': documents.parse_yaml,
    'JSON': documents.parse_json,
    'XML': documents.parse_xml,
}
# Texts have a quarter of the size limit. If the time grew as the square of the size, the limit
# would take 16 times as long.
PART = 4
CPU_S = 8  # limit of the CPU time [s]; the slowest takes 2.5 s
MEMORY = 5 * 2**27  # address space [bytes]
# Format, and text that is repeated up to a quarter of the size limit of the format.
WORST = {
    'keys of many parts': ('TOML', 'a', '[{}' + '.k' * 90 + ']\n', ''),
    'empty tables': ('TOML', 'a=[', '{{}},', ']'),
    'quotation marks': ('TOML', '', '"""', ''),
    'keys of a flow': ('YAML', '{' * (MAX_DEPTH - 1), 'a,', ''),
    'empty lists of YAML': ('YAML', '[', '[],', ']'),
    'entries': ('YAML', '', '{:x}: \n', ''),
    'empty lists of JSON': ('JSON', '{"a":[', '[],', '0]}'),
    'objects': ('JSON', '{"a":[', '{{"":0}},', '0]}'),
    'attributes': ('XML', '<a>', '<a b=""/>', '</a>'),
    'nested elements': ('XML', '', '<a>', ''),
}
LIMITED = """
import sys
from fluoro_calib_ros.errors import DataError
from fluoro_calib_ros.io import documents
text = sys.stdin.read()
try:
    getattr(documents, f'parse_{sys.argv[1].lower()}')(text, 'document')
except DataError as error:
    print(error)
"""


def limit_process():
    resource.setrlimit(resource.RLIMIT_CPU, (CPU_S, CPU_S))
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))


@pytest.mark.long
@pytest.mark.parametrize('case', WORST)
def test_worst_document_stays_in_its_part_of_the_budget(case):
    kind, begin, unit, end = WORST[case]
    limit = DOCUMENT_BYTES[kind] // PART
    room = limit - len(begin) - len(end)
    count = room // len(unit.format(10**5))
    text = begin + ''.join(unit.format(number) for number in range(count)) + end
    assert 0.7 * limit < len(text) <= limit
    done = subprocess.run(
        [sys.executable, '-c', LIMITED, kind],
        cwd=ROOT,
        input=text,
        capture_output=True,
        text=True,
        preexec_fn=limit_process,
    )
    assert done.returncode == 0 and not done.stderr, done.stderr[-500:]
    assert 'more than' not in done.stdout


@pytest.mark.parametrize('kind', PARSE)
def test_document_beyond_the_limit_is_not_parsed(kind):
    with pytest.raises(DataError, match=f'^f: the {kind} text has .* MB; the limit is .* MB$'):
        PARSE[kind](' ' * (DOCUMENT_BYTES[kind] + 1), 'f')


@pytest.mark.parametrize(
    'kind, text, sentence',
    [
        ('TOML', 'a.' * 1000 + 'a = 1', 'nested too deeply'),
        ('TOML', '"a=#" . ' * 1000 + 'a = 1', 'nested too deeply'),
        ('TOML', '[' + 'a.' * 1000 + 'a]', 'nested too deeply'),
        ('TOML', 'a = ' + '[' * 1000, 'nested too deeply'),
        ('TOML', 'a = 1' + '0' * 400, 'too large'),
        ('YAML', '- ' * 1000, 'nested too deeply'),
        ('YAML', '? ' * 1000, 'nested too deeply'),
        ('YAML', '[' * 1000, 'nested too deeply'),
        ('YAML', '\n'.join(' ' * n + '-' for n in range(1400)), 'nested too deeply'),
        ('YAML', 'a: &a {b: 1}\nc: *a', 'aliases are not allowed'),
        ('YAML', 'a: &a {b: 1}\nc:\n  <<: *a', 'merged keys are not allowed'),
        ('YAML', 'a: ' + '1:' * 1000 + '1', 'numbers of more than 400 characters'),
        ('YAML', 'a: 1' + '0' * 100, 'too large'),
        ('JSON', '{"a": 1' + '0' * 400 + '}', 'too large'),
        ('JSON', '{"a": NaN}', 'NaN is not a number of JSON'),
        ('JSON', '{"a": ' + '[' * 100_000, 'nested too deeply'),
        ('XML', '<!DOCTYPE a [<!ENTITY b "c">]><a>&b;</a>', 'are not read'),
    ],
)
def test_what_grows_or_overflows_is_refused(kind, text, sentence):
    with pytest.raises(DataError, match=f'^f(, |: ).*{sentence}'):
        PARSE[kind](text, 'f')


@pytest.mark.parametrize(
    'kind, text, value',
    [
        ('TOML', 'a.b = ["x.y", 1.5]  # ' + 'c.' * 1000, {'a': {'b': ['x.y', 1.5]}}),
        ('TOML', "a = '" + 'c.' * 1000 + "'", {'a': 'c.' * 1000}),
        ('YAML', 'a: [1, 2.5, x, null]', {'a': [1, 2.5, 'x', None]}),
        ('JSON', '{"a": [9007199254740993, 1e300]}', {'a': [9007199254740993, 1e300]}),
    ],
)
def test_ordinary_documents_are_read(kind, text, value):
    assert PARSE[kind](text, 'f') == value


def test_nested_file_of_opencv_is_refused(tmp_path):
    """OpenCV would end the process."""
    path = tmp_path / 'a_opencv.yaml'
    path.write_text('%YAML:1.0\n---\ncamera_matrix: ' + '[' * 200_000)
    with pytest.raises(DataError, match='nested too deeply'):
        registry.read(path, FileSettings(), 'opencv')


@pytest.mark.parametrize('kind', ['lut', 'xmalab2d'])
def test_table_of_very_many_rows_is_not_read(tmp_path, kind):
    path = tmp_path / 'table.csv'
    path.write_text('1\n' * (MAX_ROWS + 1))
    with pytest.raises(DataError, match=r'rows; the limit is \d+'):
        registry.read(path, FileSettings(image_size=(9, 9)), kind)


@pytest.mark.parametrize('text', ['\t\n', '\x0b\n\t\n'])
def test_lookup_table_of_blanks_is_refused(tmp_path, text):
    path = tmp_path / 'a_LUT.csv'
    path.write_text(text)
    with pytest.raises(DataError, match='no rows'):
        registry.read(path, FileSettings(), 'lut')


def test_table_of_comments_has_no_header(tmp_path):
    path = tmp_path / 'observations.csv'
    path.write_text('#\n' * 100_000)
    with pytest.raises(DataError, match='the file has no header'):
        read_observations_csv(path, (9, 9))
