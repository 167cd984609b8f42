# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The file names.csv of a result folder."""

import pytest

from fluoro_calib_ros.errors import DataError
from fluoro_calib_ros.exposures.names import MAX_ID, Names, number_names
from fluoro_calib_ros.io import csv_table
from fluoro_calib_ros.io.csv_table import NAMES_FILE, Table, read_names, write_names

NAMES = Names({'tib, lat': 4, 'fem "a"': 2}, {'trial 3.tif': 3}, {'Röntgen 1': 'R_ntgen_1'})


def test_names_return(tmp_path):
    """Names may contain commas and quotes; without names there is no file."""
    write_names(tmp_path, NAMES)
    assert read_names(tmp_path) == NAMES
    without = tmp_path / 'without'
    write_names(without, Names())
    assert not without.exists()
    assert read_names(without) == Names()


@pytest.mark.parametrize(
    ('row', 'sentence'),
    [
        ('bead,1,a', "row 2: kind is 'bead', not target, exposure, fluoroscope"),
        ('target,x,a', "row 2: id is 'x', not an integer"),
        ('target,-1,a', "row 2: id is '-1', not an integer"),
        ('fluoroscope,../a,a', "row 2: the fluoroscope is called '../a'"),
        ('target,1,a\ntarget,1,b', "row 3: the target 'b', id 1, is given twice"),
        ('target,1,a\ntarget,2,a', "row 3: the target 'a', id 2, is given twice"),
    ],
)
def test_wrong_names_name_the_row(tmp_path, row, sentence):
    path = tmp_path / 'names.csv'
    path.write_text(f'kind,id,name\n{row}\n')
    with pytest.raises(DataError) as caught:
        read_names(tmp_path)
    assert str(caught.value).startswith(f'{path}, {sentence}')


def test_name_with_two_ids_is_refused():
    with pytest.raises(DataError, match="target 'a' has the id 1, and the id 2"):
        Names({'a': 1}).merged(Names({'a': 2}))


@pytest.mark.parametrize(
    'name', ['=cmd', '@x', '+1+1', "-in|cmd'!A1", '-0x', "'quoted", "'=quoted", '-1.5a']
)
def test_a_name_that_a_spreadsheet_would_run_is_written_as_text_and_read_again(tmp_path, name):
    write_names(tmp_path, Names(targets={name: 7}))
    text = (tmp_path / NAMES_FILE).read_text()
    assert not any(line.rpartition(',')[2].startswith(tuple('=+-@')) for line in text.split())
    assert read_names(tmp_path).targets == {name: 7}


def test_numbers_are_written_as_they_are(tmp_path):
    path = tmp_path / 'numbers.csv'
    Table(('-1.5', 'name'), [[-1.5, '-1.5', '+2', '-inf', '-1e-05', 'nan', 'name', 3]]).write(path)
    assert path.read_text() == '-1.5,name\n-1.5,-1.5,+2,-inf,-1e-05,nan,name,3\n'


def test_many_names_are_looked_up_not_searched(tmp_path, monkeypatch):
    """Each id is compared once with those before it, whatever their number."""
    names = Names({f'bead {number}': number for number in range(20_000)})
    write_names(tmp_path, names)
    comparisons = 0

    class Counted(int):
        def __eq__(self, other):
            nonlocal comparisons
            comparisons += 1
            return int(self) == other

        __hash__ = int.__hash__

    monkeypatch.setattr(csv_table, 'int', Counted, raising=False)
    assert read_names(tmp_path).targets == names.targets
    assert comparisons < 100_000


@pytest.mark.parametrize(
    ('given', 'known', 'ids'),
    [
        (['top', '1', '2'], {}, {'top': 3, '1': 1, '2': 2}),  # 1 and 2 are ids in other files
        (['top', '1'], {'old': 1}, {'old': 1, 'top': 2, '1': 3}),
        (['top', '007'], {}, {'top': 1, '007': 2}),
    ],
)
def test_names_that_are_ids_keep_them_next_to_other_names(given, known, ids):
    assert number_names(given, known) == ids


def test_names_get_no_id_that_messages_cannot_hold():
    with pytest.raises(DataError, match='no id up to'):
        number_names(['top'], {'last': MAX_ID})
