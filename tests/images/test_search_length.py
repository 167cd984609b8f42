# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Length of the search for a pose in an image of another phantom."""

from __future__ import annotations

import numpy as np
import pytest
from rigs import refused
from scipy.spatial.transform import Rotation

from benchmarks.extraction import pose_of, seen_points
from fluoro_calib_ros.findings import Kind
from fluoro_calib_ros.images import matching
from fluoro_calib_ros.images.growth import Seen
from fluoro_calib_ros.images.pose_search import enough_seeds
from fluoro_calib_ros.images.view import Lens
from fluoro_calib_ros.photogrammetry.rotations import matrix_from_vector
from fluoro_calib_ros.simulation.rig import virtual_rig

LENS = Lens((1024, 1024), 4000.0)
NEIGHBOURS = (8, 6)


def beads(seed: int, count: int) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-90, 90, (count, 3))


def seen_of(xyz: np.ndarray) -> Seen:
    uv = xyz @ matrix_from_vector([0.3, -0.5, 0.2]).T
    uv = 4000 * uv[:, :2] / (uv[:, 2:] + 1500) + 511.5
    return Seen.of(uv, np.ones((1024, 1024), bool), 3.0)


def test_more_beads_are_tried_where_more_else_is_seen():
    xyz = beads(1, 80)
    tried = [enough_seeds(xyz, found, 1.0, NEIGHBOURS) for found in (50, 80, 120)]
    assert tried == sorted(tried) and tried[0] < tried[1] < tried[2]


def test_more_beads_are_tried_where_their_shadows_touch():
    xyz = beads(1, 80)
    assert enough_seeds(xyz, 80, 6.0, NEIGHBOURS) > enough_seeds(xyz, 80, 1.0, NEIGHBOURS)


def test_a_phantom_whose_shadows_would_all_be_one_is_not_looked_for():
    sheet = np.array([(x, y, 0.0) for x in range(0, 60, 6) for y in range(0, 60, 6)])
    assert enough_seeds(sheet, 80, 6.5, NEIGHBOURS) == 0


@pytest.mark.long
def test_a_phantom_is_found_where_all_its_faces_are_seen_from_the_edge():
    v, u = np.mgrid[:1024, :1024]
    field = np.hypot(u - 511.5, v - 511.5) < 490
    rig = virtual_rig(3000, 0.9)
    model = matching.PhantomModel.of(rig.phantom.xyz_mm)
    for number, fluoroscope in enumerate(5 * rig.fluoroscopes):
        rng = np.random.default_rng(number)
        rotation, shift = pose_of('tube', rng, fluoroscope)
        true = fluoroscope.ideal(rig.true_mm @ rotation.T + shift)
        uv = seen_points(rng, fluoroscope.distortion.distort(true), field)
        found = matching.match(Seen.of(uv, field, 2.6), model, LENS)
        away = uv[found.detection] - fluoroscope.distortion.distort(true[found.bead])
        assert np.mean(np.linalg.norm(away, axis=1) < 4) > 0.98


def test_few_beads_are_found_though_perspective_moves_the_far_ones():
    for number in range(8):
        rng = np.random.default_rng(number)
        xyz = rng.uniform(-1, 1, (18, 3)) * [60, 60, 35]
        x = xyz @ Rotation.random(random_state=number).as_matrix().T + [0, 0, 600]
        uv = 3300 * x[:, :2] / x[:, 2:] + 511.5
        there = np.flatnonzero(((uv > 0) & (uv < 1023)).all(axis=1))[1:]
        points = np.concatenate([uv[there], rng.uniform(200, 800, (2, 2))])
        seen = Seen.of(points, np.ones((1024, 1024), bool), 8.0)
        found = matching.match(seen, matching.PhantomModel.of(xyz), Lens((1024, 1024), 3300.0))
        own = found.detection < len(there)
        assert len(found.bead) >= len(there) - 1
        np.testing.assert_array_equal(there[found.detection[own]], found.bead[own])


@pytest.mark.long
def test_another_phantom_is_refused_after_as_many_beads_as_would_tell(monkeypatch):
    tried = []

    def counted(seed, *arguments, **named):
        tried.append(seed)
        return search(seed, *arguments, **named)

    search = matching.local_poses
    monkeypatch.setattr(matching, 'local_poses', counted)
    model = matching.PhantomModel.of(beads(1, 170))
    seen = seen_of(beads(2, 170))
    with refused(Kind.NO_POSE):
        matching.match(seen, model, LENS)
    assert len(tried) < 70  # out of 122
    tried.clear()
    found = matching.match(seen_of(model.xyz), model, LENS)
    assert np.array_equal(found.bead, found.detection) and len(tried) <= matching.CENTRAL
