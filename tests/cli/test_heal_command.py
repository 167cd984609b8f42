# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""fluoro-calib heal: a virtual rig is bumped, then recalibrated from a walking knee."""

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
from rigs import run

from fluoro_calib_ros.io.calibration import load_calibrations, load_orientation
from fluoro_calib_ros.io.versions import LEARNED_SHAPES, read_learned_shapes
from fluoro_calib_ros.jobs.simulation import write_knee_recording
from fluoro_calib_ros.photogrammetry.rotations import matrix_from_vector
from fluoro_calib_ros.simulation.knee import simulate_knee, virtual_knee, walking
from fluoro_calib_ros.simulation.rig import virtual_rig

pytestmark = pytest.mark.long

SEED = 1
MOVED_MM = [3.0, -2.0, 3.0]
TURNED_RAD = [0.005, -0.004, 0.003]


@pytest.fixture(scope='module')
def rig(tmp_path_factory):
    """A calibrated rig with learned shapes, and a knee that walks after b was bumped."""
    folder = tmp_path_factory.mktemp('healing') / 'rig'
    simulate = ('simulate', '--out', folder, '--bodies', '--exposures', '8', '--seconds', '1')
    assert run(*simulate, '--seed', SEED) == 0
    calibrate = ('calibrate', folder / 'calibration', '--phantom', folder / 'phantom.csv')
    assert run(*calibrate, '--fast', '--out', folder / 'result') == 0
    bodies = ('bodies', folder / 'walking', '--bodies', folder / 'bodies.csv')
    calibration = ('--calibration', folder / 'result')
    assert run(*bodies, *calibration, '--learn', '--out', folder / 'learned') == 0
    virtual = virtual_rig(SEED)
    a, b = virtual.fluoroscopes
    moved = replace(
        b,
        rotation=matrix_from_vector(TURNED_RAD) @ b.rotation,
        position_mm=b.position_mm + MOVED_MM,
    )
    knee = virtual_knee(SEED)
    motion = walking(knee, np.arange(60) / 60)
    bumped = simulate_knee(replace(virtual, fluoroscopes=(a, moved)), knee, motion)
    write_knee_recording(folder, 'bumped', bumped)
    healthy = simulate_knee(virtual, knee, motion)
    halfway = {
        name: [*frames[:30], *bumped.frames[name][30:]] for name, frames in healthy.frames.items()
    }
    write_knee_recording(folder, 'halfway', replace(healthy, frames=halfway))
    later = simulate_knee(virtual, knee, walking(knee, (np.arange(60) + 0.5) / 60))
    late = {'a': healthy.frames['a'], 'b': later.frames['b']}
    write_knee_recording(folder, 'late', replace(healthy, frames=late))
    return folder


def heal(rig, recording, out, *more):
    return run(
        *('heal', rig / recording, '--calibration', rig / 'result', '--out', out, *more),
    )


def assert_same_but_for_larger_sd(parent, healed):
    """Check that corrections are the same; unseen changes make the later deviations larger."""
    ids = load_orientation(healed / 'rig_orientation.npz').calibration_ids
    before, after = (load_calibrations(folder) for folder in (parent, healed))
    assert ids == tuple(after[name].calibration_id for name in 'ab')
    for name in 'ab':
        old, new = (one[name].to_values() for one in (before, after))
        sd, larger = (values.pop('series_sd') for values in (old, new))
        for values in (old, new):
            del values['calibration_id']
        np.testing.assert_equal(new, old)
        assert (larger >= sd).all()
        assert (larger / sd).max() > 2, 'somewhere no marker has passed'


def test_bumped_rig_is_healed_and_its_points_are_right_again(rig, tmp_path, capsys):
    healed = tmp_path / 'healed'
    assert heal(rig, 'bumped', healed, '--json') == 0
    document = json.loads(capsys.readouterr().out)
    assert document == json.loads((healed / 'healing.json').read_text())
    assert document['verdict'] == 'pass'
    assert [one['kind'] for one in document['findings']] == ['fluoroscope_moved']
    assert set(document['changes']) == {'b'}
    before = load_orientation(rig / 'result' / 'rig_orientation.npz')
    after = load_orientation(healed / 'rig_orientation.npz')
    assert document['parent_orientation_id'] == before.orientation_id
    assert document['orientation_id'] == after.orientation_id and after.source == 'healing'
    # Only the orientation of b has changed: the corrections are the same.
    assert_same_but_for_larger_sd(rig / 'result', healed)
    assert document['common_motion']['numbers']['distance_mm'] > 0.05
    learned = read_learned_shapes(healed)
    assert learned.orientation_ids == (before.orientation_id, after.orientation_id)
    again = ('heal', rig / 'bumped', '--calibration', healed, '--out', tmp_path / 'again')
    assert run(*again) == 0
    assert 'the calibration stays as it was' in capsys.readouterr().out
    change = document['changes']['b']
    np.testing.assert_array_less(
        np.abs(np.radians(change['rotation_deg']) - TURNED_RAD),
        4 * np.radians(change['rotation_sd_deg']),
    )
    bodies = ('bodies', rig / 'bumped', '--bodies', rig / 'learned' / 'shapes.csv', '--json')
    assert run(*bodies, '--keep-shapes', '--calibration', healed, '--out', tmp_path / 'after') == 0
    assert json.loads(capsys.readouterr().out)['bodies']['femur']['poses'] == 60


def test_rig_that_has_not_changed_stays_where_it_was_and_claims_what_is_not_seen(
    rig, tmp_path, capsys
):
    assert heal(rig, 'walking', tmp_path / 'healed', '--json') == 0
    document = json.loads(capsys.readouterr().out)
    assert not document['findings'] and not document['changes']
    before = load_orientation(rig / 'result' / 'rig_orientation.npz')
    after = load_orientation(tmp_path / 'healed' / 'rig_orientation.npz')
    np.testing.assert_array_equal(after.position_mm, before.position_mm)
    np.testing.assert_array_equal(after.rotation, before.rotation)
    assert_same_but_for_larger_sd(rig / 'result', tmp_path / 'healed')
    assert document['orientation_id'] == after.orientation_id != before.orientation_id
    assert document['common_motion']['numbers']['distance_mm'] > 0.05
    of_b = before.covariance_rows([1])[:6]
    claimed, before_claimed = (np.diagonal(one.covariance)[of_b] for one in (after, before))
    assert (claimed > before_claimed).all()


def test_rig_that_is_bumped_during_the_recording_is_told(rig, tmp_path, capsys):
    assert heal(rig, 'halfway', tmp_path / 'healed') == 3
    out = capsys.readouterr().out
    assert 'the rig changed during the recording' in out and 'Verdict: fail' in out
    assert 'no change of the rig is evident' not in out


def test_what_cannot_be_healed_is_refused(rig, tmp_path, capsys):
    shapes = rig / 'learned' / 'shapes.csv'
    unknown = tmp_path / 'unknown.csv'
    lines = shapes.read_text().splitlines()
    unknown.write_text(
        '\n'.join([lines[0], *(f'{",".join(x.split(",")[:2])},,,,' for x in lines[1:])])
    )
    base = ('heal', rig / 'bumped', '--calibration', rig / 'result', '--out', tmp_path / 'out')
    assert run(*base, '--bodies', unknown) == 1
    assert (
        'body femur: the coordinates of only 0 of its 4 markers are known'
        in capsys.readouterr().err
    )
    assert run(*base, '--bodies', shapes, '--orientation', tmp_path / 'none.npz') == 1
    plain = shutil.copytree(rig / 'result', tmp_path / 'plain')
    (plain / LEARNED_SHAPES).unlink()
    capsys.readouterr()
    unlearned = ('heal', rig / 'bumped', '--calibration', plain, '--out', tmp_path / 'out')
    assert run(*unlearned) == 1
    assert 'no shapes of bodies were learned' in capsys.readouterr().err
    inside = ('heal', rig / 'bumped', '--calibration', rig / 'result', '--bodies', shapes)
    assert run(*inside, '--out', rig / 'result') == 1
    assert 'would be overwritten' in capsys.readouterr().err
    assert not (tmp_path / 'out').exists()


def test_fluoroscopes_that_are_not_synchronous_are_not_healed(rig, tmp_path, capsys):
    assert heal(rig, 'late', tmp_path / 'healed') == 1
    err = capsys.readouterr().err
    assert 'fluoroscope b takes its images 0.5' in err and 'after fluoroscope a' in err
    assert not (tmp_path / 'healed').exists()
