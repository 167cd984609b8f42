# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Repair by eye: doubtful ids and exposures in a table, and a person's decisions on them."""

import csv
from dataclasses import replace

import numpy as np
import pytest
from rigs import calibrated, exposures, rig, run

from fluoro_calib_ros.checks.check import Check
from fluoro_calib_ros.checks.residual_tests import doubtful_observations
from fluoro_calib_ros.errors import DataError
from fluoro_calib_ros.estimation.calibrate import calibrate
from fluoro_calib_ros.estimation.options import CalibrationOptions
from fluoro_calib_ros.exposures.decisions import PointDecision, decided
from fluoro_calib_ros.exposures.frame import Frame
from fluoro_calib_ros.exposures.names import Names
from fluoro_calib_ros.findings import Finding, Kind, Place, Severity
from fluoro_calib_ros.io.decisions import COLUMNS, doubtful_table, read_decisions
from fluoro_calib_ros.io.formats.content import FileSettings
from fluoro_calib_ros.io.observations import write_observations_csv
from fluoro_calib_ros.io.phantom import write_phantom
from fluoro_calib_ros.jobs.result_folder import save_result
from fluoro_calib_ros.jobs.sources import read_source

OPTIONS = {'max_iterations': 2}


def frame(number, ids, sigma=True):
    uv = np.column_stack([ids, ids]).astype(float)
    return Frame('a', number, np.array(ids), uv, (100, 100), np.ones(len(ids)) if sigma else None)


def decision(exposure, target=None, new_id=None, last=None):
    return PointDecision('d.csv, row 2', 'a', exposure, last or exposure, target, new_id)


def test_points_are_left_out_and_renamed_and_exposures_left_out():
    frames = {'a': [frame(n, [1, 2, 3], sigma=n != 2) for n in (1, 2, 3, 4)]}
    decisions = [
        decision(1, 2),
        decision(2, 1, 3, last=3),
        decision(2, 3, 1, last=3),  # exchanged ids
        decision(4),
    ]
    out, counts = decided(frames, decisions)
    assert counts == (1, 1, 4)
    assert [f.number for f in out['a']] == [1, 2, 3]
    assert out['a'][0].target_id.tolist() == [1, 3]
    assert out['a'][0].uv[:, 0].tolist() == [1.0, 3.0] and len(out['a'][0].sigma) == 2
    assert out['a'][1].target_id.tolist() == [3, 2, 1] and out['a'][1].sigma is None
    assert out['a'][1].uv[:, 0].tolist() == [1.0, 2.0, 3.0], 'the points stay where they are'
    assert frames['a'][1].target_id.tolist() == [1, 2, 3], 'the source is not changed'


@pytest.mark.parametrize(
    ('made', 'cause'),
    [
        ([decision(1, 1, 2)], 'exposure 1 then has target 2 twice'),
        ([decision(7)], 'fluoroscope a has no exposure 7'),
        ([decision(1, 9, last=2)], 'exposure 1 to 2 of fluoroscope a has no target 9'),
        ([replace(decision(1), fluoroscope='c')], "there is no fluoroscope 'c', only a"),
    ],
)
def test_decision_on_what_is_not_there_names_its_row(made, cause):
    with pytest.raises(DataError) as caught:
        decided({'a': [frame(1, [1, 2]), frame(2, [1, 2])]}, made)
    assert str(caught.value).startswith(f'd.csv, row 2: {cause}')


def test_exposure_without_a_point_is_left_out():
    out, counts = decided({'a': [frame(1, [1]), frame(2, [1])]}, [decision(1, 1)])
    assert [f.number for f in out['a']] == [2] and counts == (1, 0, 0)


def write(path, *rows, header='fluoroscope,exposure,last_exposure,target_id,decision'):
    path.write_text('\n'.join([header, *rows]) + '\n')
    return path


def test_numbers_that_a_spreadsheet_wrote_as_floats_are_read(tmp_path):
    path = write(tmp_path / 'd.csv', 'a,2.0,4.0,7.0,8.0')
    (given,) = read_decisions(path, Names())
    assert (given.first, given.last, given.target_id, given.new_id) == (2, 4, 7, 8)


def test_table_is_read_with_names(tmp_path):
    names = Names({'tip': 5, 'base': 6}, {'run 3': 33}, {'cam 1': 'cam_1'})
    path = write(
        tmp_path / 'd.csv',
        'cam 1,run 3,,tip,base',
        'a,1,4,7, Leave_Out ',
        'a,2,,,leave out',
        'b,1,,1,',
    )
    one, two, three = read_decisions(path, names)
    assert (one.fluoroscope, one.first, one.last, one.target_id, one.new_id) == (
        'cam_1',
        33,
        33,
        5,
        6,
    )
    assert (two.first, two.last, two.target_id, two.new_id) == (1, 4, 7, None)
    assert three.target_id is None and three.where == f'{path}, row 4'


@pytest.mark.parametrize(
    ('row', 'cause'),
    [
        ('a,1,,2,maybe', "decision is 'maybe', neither 'leave out' nor a target_id"),
        ('a,1,,,3', "decision is '3', but a whole exposure can only be excluded"),
        ('a,x,,2,3', "exposure is 'x', not an integer"),
        ('a,5,4,2,3', 'last_exposure is 4, before exposure 5'),
        ('a,1,,99999999999,3', 'target_id is'),
    ],
)
def test_a_wrong_row_is_named(tmp_path, row, cause):
    path = write(tmp_path / 'd.csv', 'a,1,,1,', row)
    with pytest.raises(DataError) as caught:
        read_decisions(path, Names())
    assert str(caught.value).startswith(f'{path}, row 3: {cause}')


def with_exchanged(frames, number, one, two):
    """Return the frames with two ids exchanged in one exposure."""
    out = []
    for each in frames:
        ids = each.target_id.copy()
        if each.number == number:
            rows = [np.flatnonzero(ids == i)[0] for i in (one, two)]
            ids[rows] = ids[rows[::-1]]
        out.append(replace(each, target_id=ids))
    return out


def test_exchanged_ids_are_found_with_the_right_ones_and_repaired(tmp_path):
    """The whole procedure: calibrate, write doubtful.csv, decide in it, and calibrate again."""
    true = exposures()['a'][:6]
    ids = true[2].target_id
    far = int(np.argmax(np.linalg.norm(true[2].uv - true[2].uv[0], axis=1)))
    one, two = int(ids[0]), int(ids[far])
    number = true[2].number
    wrong = with_exchanged(true, number, one, two)
    result = calibrate({'a': wrong}, rig().phantom, CalibrationOptions(**OPTIONS))
    found = {(d.first, d.target_id): d for d in doubtful_observations(result)}
    assert found[number, one].others[0] == two and found[number, two].others[0] == one
    assert found[number, one].residual_px > 50

    write_observations_csv(tmp_path / 'wrong.csv', {'a': wrong})
    write_phantom(tmp_path / 'phantom.csv', rig().phantom)
    save_result(tmp_path / 'result', result)
    with (tmp_path / 'result' / 'doubtful.csv').open() as file:
        rows = list(csv.DictReader(file))
    assert tuple(rows[0]) == COLUMNS and not any(row['decision'] for row in rows)
    for row in rows:
        may_be = row['may_be'].split()
        row['decision'] = may_be[0] if may_be else 'leave out'
    with (tmp_path / 'decided.csv').open('w', newline='') as file:
        writer = csv.DictWriter(file, COLUMNS)
        writer.writeheader()
        writer.writerows(rows)
    settings = FileSettings(decisions=tmp_path / 'decided.csv')
    recording = read_source(
        tmp_path / 'wrong.csv', image_size=true[0].image_size, settings=settings
    )
    repaired = next(f for f in recording.frames['a'] if f.number == number)
    place = dict(zip(repaired.target_id.tolist(), repaired.uv.tolist()))
    truth = dict(zip(ids.tolist(), true[2].uv.tolist()))
    assert place[one] == truth[one] and place[two] == truth[two]
    assert 'by decision' in recording.notes[-1]


def test_two_points_at_one_bead_do_not_both_get_its_id():
    """One of them is excluded: an exposure has a target only once."""
    true = exposures()['a'][:6]
    ids = true[2].target_id
    far = np.argsort(-np.linalg.norm(true[2].uv - true[2].uv[0], axis=1))
    first, second = far[:2]
    uv = true[2].uv.copy()
    uv[[first, second]] = true[2].uv[0] + [[0.1, 0], [0, 0.2]]
    wrong = replace(true[2], target_id=ids[1:], uv=uv[1:])
    result = calibrate(
        {'a': [*true[:2], wrong, *true[3:]]}, rig().phantom, CalibrationOptions(**OPTIONS)
    )
    found = [d for d in doubtful_observations(result) if d.first == wrong.number]
    both = [d for d in found if d.target_id in (ids[first], ids[second])]
    assert len(both) == 2
    assert [d.others[:1] for d in both].count((int(ids[0]),)) == 1
    assert sum(int(ids[0]) in d.others for d in found) == 1


def test_commands_read_decisions(tmp_path, capsys):
    write_observations_csv(tmp_path / 'seen.csv', {'a': exposures()['a'][:7]})
    write_phantom(tmp_path / 'phantom.csv', rig().phantom)
    table = write(tmp_path / 'd.csv', f'a,{exposures()["a"][3].number},,,leave out')
    given = ('--phantom', tmp_path / 'phantom.csv', '--image-size', '1024x1024', '--fast')
    given += ('--decisions', table, '--max-iterations', '2')
    assert run('calibrate', tmp_path / 'seen.csv', *given, '--out', tmp_path / 'result') == 0
    assert '1 exposures and 0 further image points are excluded' in capsys.readouterr().err
    with (tmp_path / 'result' / 'exposures.csv').open() as file:
        used = {int(row['exposure']) for row in csv.DictReader(file)}
    assert used == {f.number for f in exposures()['a'][:7]} - {exposures()['a'][3].number}


def test_excluded_and_failing_exposures_are_doubtful():
    result = calibrated('a', 6, **OPTIONS)
    note = Finding(Kind.NOT_ORIENTED, 'no pose', Place(('a',), (9,)), severity=Severity.NOTE)
    joined = replace(note, kind=Kind.REPEATED_POSE)
    place = Place(('a',), (2,))
    checks = [
        Check(Kind.EXPOSURES, 'fits worst', place, 'inspect it', value=2.0, limit=1.0, unit='1'),
        Check(Kind.EXPOSURES, 'fits', place, 'inspect it', value=0.5, limit=1.0, unit='1'),
    ]
    found = doubtful_observations(replace(result, findings=(note, joined)), checks)
    whole = [(d.first, d.target_id, d.reason) for d in found if d.target_id is None]
    assert whole == [(2, None, 'fits worst'), (9, None, 'no pose')]


def test_names_are_written_that_are_read(tmp_path):
    found = doubtful_observations(calibrated('a', 6, **OPTIONS))[:1]
    target = found[0].target_id
    names = Names({f'bead {target}': target}, {'first': found[0].first}, {'cam 1': 'a'})
    doubtful_table(found, names).write(tmp_path / 'd.csv')
    text = (tmp_path / 'd.csv').read_text().replace('"\n', '"\n').rstrip('\n') + 'leave out\n'
    (tmp_path / 'd.csv').write_text(text)
    (one,) = read_decisions(tmp_path / 'd.csv', names)
    assert (one.fluoroscope, one.first, one.target_id) == ('a', found[0].first, target)
