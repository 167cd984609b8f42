# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""A rig that changes while it is recorded does not pass, and the command says why."""

from argparse import Namespace
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from fluoro_calib_ros.bodies.body import Body
from fluoro_calib_ros.checks.check import verdict_of
from fluoro_calib_ros.cli.heal import _lines
from fluoro_calib_ros.errors import DataError
from fluoro_calib_ros.healing.diagnosis import Cause, Change
from fluoro_calib_ros.healing.rig_errors import RigErrors
from fluoro_calib_ros.jobs import healing

TARGET_ID = np.array([[0, 1, 2, 3], [10, 11, 12, -1]])
SOFT = [Change(Cause.SOFT, body=row) for row in range(2)]
RIG = SimpleNamespace(orientation=SimpleNamespace(fluoroscopes=('a', 'b')), bodies=())


def outcome(*changes):
    """Return an outcome without a healed rig; the second unused half shows the changes."""
    checks = [
        healing._unused(SimpleNamespace(changes=(), complete=True), 1, RIG),
        healing._unused(SimpleNamespace(changes=changes, complete=True), 2, RIG),
        healing._unseen_distortion(0.02, 0.1),
    ]
    diagnosis = SimpleNamespace(changes=(), probability=())
    errors = RigErrors(1e-4, 0.01, common_mm=0.2)
    return healing.HealingOutcome(
        diagnosis,
        healed=None,
        calibrations={},
        orientation=RIG.orientation,
        before=errors,
        after=errors,
        common_motion=healing.common_motion(0.3),
        verdict=verdict_of(checks),
        checks=tuple(checks),
        findings=(),
        exposures=20,
    )


def test_bodies_that_have_changed_are_left_out_while_another_one_remains():
    np.testing.assert_array_equal(
        healing._left_out(SOFT[:1], TARGET_ID), [[True] * 4, [False] * 4]
    )
    one = Change(Cause.MIGRATED, body=0, markers=(2,))
    assert np.argwhere(healing._left_out([one], TARGET_ID)).tolist() == [[0, 2]]
    of_rig = Change(Cause.ORIENTATION, fluoroscope=1)
    exchanged = Change(Cause.EXCHANGED, body=1, markers=(0, 1))
    assert not healing._left_out([of_rig, exchanged], TARGET_ID).any()


def test_unused_exposures_of_soft_bodies_alone_are_still_diagnosed():
    """Otherwise nothing would be left to show that the rig, not all of the bodies, has changed."""
    assert not healing._left_out(SOFT, TARGET_ID).any()
    loose = Change(Cause.LOOSE, body=1, markers=(0,))  # two of three markers give no pose
    assert not healing._left_out([SOFT[0], loose], TARGET_ID).any()


def test_rig_that_changed_during_the_recording_is_told():
    changed = outcome(Change(Cause.ORIENTATION, fluoroscope=1))
    assert changed.changed_meanwhile and changed.verdict == 'fail'
    lines = _lines(Namespace(out='healed'), changed)
    assert lines[0] == healing.CHANGED_MEANWHILE
    assert not any('no change' in line for line in lines)
    steady = outcome()
    assert not steady.changed_meanwhile and steady.verdict == 'pass'
    lines = _lines(Namespace(out='healed'), steady)
    assert 'no change of the rig is evident' in lines[0]
    assert lines[1] == healing.common_motion(0.3).sentence
    assert lines[2] == steady.unseen_distortion.sentence


def test_bodies_have_a_pose_with_three_markers_whose_ids_begin_at_0():
    ids = np.array([[0, 1, 2, -1], [5, 6, -1, -1], [7, 8, 9, 10]])
    nothing = np.zeros(ids.shape, bool)
    assert healing._solvable(ids, nothing).tolist() == [True, False, True]
    nothing[[0, 2], 0] = True
    assert healing._solvable(ids, nothing).tolist() == [False, False, True]


@pytest.mark.parametrize(
    ('changes', 'complete', 'value', 'passed'),
    [
        ((), True, 0, True),
        ((Change(Cause.LOOSE, body=0),), True, 0, True),
        ((Change(Cause.LOOSE, body=0),), False, 1, False),
        ((Change(Cause.ORIENTATION, fluoroscope=1), Change(Cause.LOOSE, body=0)), True, 1, False),
        ((Change(Cause.ORIENTATION, fluoroscope=1),), False, 2, False),
    ],
)
def test_exposures_that_were_not_used_count_changes_of_the_rig_and_what_is_unexplained(
    changes, complete, value, passed
):
    rest = SimpleNamespace(changes=changes, complete=complete)
    check = healing._unused(rest, 1, RIG)
    assert (check.value, check.passed) == (value, passed)
    unexplained = not complete and value == 1
    assert ('do not explain' in check.cause) is unexplained
    assert ('no further change' in check.cause) is passed
    assert healing._unused(None, 2, RIG).passed is None


def test_distortion_that_a_model_cannot_take_is_diagnosed_and_does_not_pass():
    models = {'a': None, 'b': object()}
    rig = healing._Rig(
        {name: SimpleNamespace(model=SimpleNamespace(series=one)) for name, one in models.items()},
        RIG.orientation,
        (),
    )
    changes = [Change(cause, fluoroscope=f) for cause in (Cause.DISTORTION,) for f in (0, 1)]
    assert rig.with_fixed_correction(changes) == ['a']
    assert not rig.with_fixed_correction([Change(Cause.ORIENTATION, fluoroscope=0)])
    check = healing._correctable(['a'])
    assert check.passed is False and check.place.fluoroscopes == ('a',)
    found = replace(
        outcome(),
        checks=(check, healing._unseen_distortion(0.02, 0.1)),
        diagnosis=SimpleNamespace(changes=changes[:1], probability=(1,)),
    )
    lines = _lines(Namespace(out='out'), found)
    assert lines[0] == 'the calibration stays as it was, nothing is written'


def test_recording_that_three_changes_do_not_explain_does_not_pass():
    """A rig that creeps looks like a distortion together with soft bodies."""
    changes = [Change(Cause.DISTORTION, fluoroscope=0), *SOFT]
    bodies = [Body(name, np.arange(4), np.eye(4, 3), np.ones(4)) for name in ('one', 'other')]
    rig = SimpleNamespace(orientation=RIG.orientation, bodies=bodies)
    found = SimpleNamespace(
        changes=changes, probability=(1.0, 1.0, 1.0), rivals=(None,) * 3, complete=False
    )
    assert healing._sure(found, rig).passed is False
    assert healing._unused(SimpleNamespace(changes=SOFT, complete=False), 1, rig).passed is False
    assert healing._unused(SimpleNamespace(changes=SOFT, complete=True), 1, rig).passed
    found.complete = True
    assert healing._sure(found, rig).passed


def test_exposures_that_suffice_are_counted_over_the_recording():
    exposures = [{'a': n, 'b': n} for n in range(20)]
    used, unused = healing._chosen(exposures)
    assert len(used) == len(unused) == 10
    with pytest.raises(DataError, match='19 exposures have two views, 20 are needed'):
        healing._chosen(exposures[:19])
    few = SimpleNamespace(known=np.arange(10)[:, None] < 9)
    with pytest.raises(DataError, match='9 of 10 exposures, every second block of the recording'):
        healing._check_seen(few)
