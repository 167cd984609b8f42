# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Symmetries of phantoms against drawings of which they are known."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from fluoro_calib_ros.images.matching import PhantomModel
from fluoro_calib_ros.images.symmetries import MIN_SHARE, Symmetry
from fluoro_calib_ros.images.view import Lens, View, exponents

TURN = Rotation.from_rotvec([0.2, 0.5, -0.1])


def lattice(x, y, z, step=10.0):
    """Return beads of a box, turned and shifted."""
    places = np.stack(np.meshgrid(*map(np.arange, (x, y, z)), indexing='ij'), axis=-1)
    return TURN.apply(step * places.reshape(-1, 3)) + [100.0, -50.0, 20.0]


def ring(count, z=0.0):
    angle = 2 * np.pi * np.arange(count) / count
    return np.column_stack([40 * np.cos(angle), 40 * np.sin(angle), np.full(count, z)])


def helix(count, turns):
    share = np.linspace(0, 1, count)
    angle = 2 * np.pi * turns * share
    return np.column_stack([40 * np.cos(angle), 40 * np.sin(angle), 100 * share])


def found_in(xyz):
    return PhantomModel.of(xyz).symmetries


def is_among(found, rotation, shift):
    """Return whether a motion is one of the symmetries, with a tolerance of 0.5 mm."""
    return any(
        np.allclose(one.rotation, rotation, atol=0.01) and np.allclose(one.shift, shift, atol=0.5)
        for one in found
    )


def test_symmetries_move_beads_to_beads():
    """A box of beads is symmetric about all its axes and by its steps."""
    xyz = lattice(4, 3, 3)
    found = found_in(xyz)
    complete = [one for one in found if one.share == 1]
    # All rotations of a square prism but the identity.
    assert len(complete) == 7
    assert {round(np.rad2deg(one.turn_rad)) for one in complete} == {90, 180}
    reach = 0.3 * np.median(cKDTree(xyz).query(xyz, k=2)[0][:, 1])
    for one in found:
        known = one.row >= 0
        assert one.share == known.mean() >= MIN_SHARE
        moved = xyz @ one.rotation.T + one.shift
        assert np.linalg.norm(moved[known] - xyz[one.row[known]], axis=1).max() < reach
        assert not np.array_equal(one.row, np.arange(len(xyz)))
    steps = [one.shift for one in found if one.turn_rad < 1e-6]
    along = {tuple(np.rint(TURN.inv().apply(step)).astype(int)) for step in steps}
    assert along >= {(10, 0, 0), (-10, 0, 0), (0, 10, 0), (0, 0, -10)}


@pytest.mark.parametrize('count', [7, 9, 12])
def test_a_ring_is_turned_by_each_of_its_steps(count):
    found = found_in(np.concatenate([ring(count, -30), ring(count, 30)]))
    for number in range(1, count):
        turn = Rotation.from_euler('z', 360 / count * number, degrees=True).as_matrix()
        assert is_among(found, turn, np.zeros(3))


def test_a_helix_is_screwed_by_its_steps_also_where_beads_are_missing():
    xyz = helix(60, 3.3)[np.sort(np.random.default_rng(1).permutation(60)[10:])]
    found = found_in(xyz)
    for number in (-3, -2, -1, 1, 2, 3):
        turn = Rotation.from_euler('z', 360 * 3.3 / 59 * number, degrees=True).as_matrix()
        assert is_among(found, turn, [0, 0, 100 / 59 * number])


def test_beads_that_are_made_by_hand_are_nearly_symmetric():
    xyz = lattice(4, 4, 4, 16.0)
    found = found_in(xyz + np.random.default_rng(2).normal(0, 0.8, xyz.shape))
    assert sum(one.share > 0.9 for one in found) >= 23
    assert found_in(np.random.default_rng(3).uniform(-50, 50, (36, 3))) == ()


def test_a_turned_view_sees_the_moved_phantom_as_the_first_one_sees_the_phantom():
    rng = np.random.default_rng(4)
    view = View(
        Lens((1024, 1024), 3000.0),
        Rotation.from_rotvec([0.3, -0.2, 0.4]).as_matrix(),
        position=Rotation.from_rotvec([-0.3, 0.2, -0.4]).apply([5.0, -3.0, -900.0]),
        principal_distance_px=2900.0,
        coefficients=rng.normal(0, 6.0, (2, len(exponents(3)))),
        degree=3,
    )
    xyz = rng.uniform(-90, 90, (60, 3))
    turn = Rotation.from_rotvec([0.1, 1.2, -0.4])
    move = Symmetry(turn.as_matrix(), np.array([3.0, 9, -4]), np.arange(60))
    moved = xyz @ move.rotation.T + move.shift
    np.testing.assert_allclose(move.turned(view).project(moved), view.project(xyz))
    assert move.turn_rad == pytest.approx(turn.magnitude())
    assert replace(move, row=np.where(np.arange(60) < 15, 0, -1)).share == 0.25
