# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Beads exchanged in the survey are found from few image points; exchanged ids are not."""

from dataclasses import replace

import numpy as np
import pytest

from fluoro_calib_ros.checks.bead_intersection import Rays
from fluoro_calib_ros.checks.exchanged_beads import exchanged_beads
from fluoro_calib_ros.estimation.result import Targets
from fluoro_calib_ros.photogrammetry.collinearity import project

BEADS = 200
EXPOSURES = 6
SD = 0.1
INTERIOR = np.array([500.0, 500.0, 4000.0])
SOURCE = np.array([0.0, 0.0, -1000.0])


@pytest.fixture(name='scene')
def scene_fixture():
    """Targets 1 to 200, and rays of six exposures that each show half of them."""
    rng = np.random.default_rng(3)
    xyz = rng.uniform(-100, 100, (BEADS, 3))
    targets = Targets(
        np.arange(1, BEADS + 1), xyz, np.broadcast_to(1e-4 * np.eye(3), (BEADS, 3, 3))
    )
    parts = []
    for exposure in range(EXPOSURES):
        rows = np.sort(rng.permutation(BEADS)[: BEADS // 2])
        count = len(rows)
        rotation = np.broadcast_to(np.eye(3), (count, 3, 3))
        source = np.broadcast_to(SOURCE + rng.normal(0, 40, 3), (count, 3))
        interior = np.broadcast_to(INTERIOR, (count, 3))
        uv = project(rotation, source, xyz[rows], interior) + rng.normal(0, SD, (count, 2))
        variance = np.full(count, SD**2)
        parts.append(
            (rotation, source, interior, uv, variance, rows + 1, np.full(count, exposure))
        )
    return Rays(*(np.concatenate(column) for column in zip(*parts))), targets


def exchanged(rays, first, second, rows=slice(None)):
    """Rays with two target ids exchanged in some rows."""
    ids = rays.target_id[rows]
    new = np.where(ids == first, second, np.where(ids == second, first, ids))
    target_id = rays.target_id.copy()
    target_id[rows] = new
    return replace(rays, target_id=target_id)


def without(rays, drop):
    return Rays(*(getattr(rays, name)[~drop] for name in Rays.__dataclass_fields__))


def nearest_pair(targets):
    distance = np.linalg.norm(targets.xyz_mm[:, None] - targets.xyz_mm, axis=2)
    np.fill_diagonal(distance, np.inf)
    return tuple(np.array(np.unravel_index(distance.argmin(), distance.shape)) + 1)


def test_two_exchanged_beads_are_named(scene):
    rays, targets = scene
    pair = nearest_pair(targets)
    assert exchanged_beads(exchanged(rays, *pair), targets).tolist() == [sorted(pair)]


def test_two_exchanged_beads_of_many_exposures_are_named(scene):
    """Chances are too small to be represented; one image point has no correction."""
    rays, targets = scene
    pair = nearest_pair(targets)
    columns = [getattr(rays, name) for name in Rays.__dataclass_fields__]
    many = Rays(*(np.concatenate([column] * 150) for column in columns))
    many = replace(many, exposure=np.repeat(np.arange(150), len(rays.uv)) + 1000 * many.exposure)
    uv = many.uv.copy()
    uv[3] = np.nan
    found = exchanged_beads(exchanged(replace(many, uv=uv), *pair), targets)
    assert found.tolist() == [sorted(pair)]


def test_beads_that_one_exposure_each_shows_are_named(scene):
    """A false match at one more of their image points does not prevent this."""
    rays, targets = scene
    first, second = nearest_pair(targets)
    of_first, of_second = (rays.target_id == one for one in (first, second))
    kept = {rays.exposure[of_first].min(), rays.exposure[of_first].max()}
    other = min(set(rays.exposure[of_second].tolist()) - {min(kept)})
    drop = (of_first & ~np.isin(rays.exposure, list(kept))) | (
        of_second & (rays.exposure != other)
    )
    few = exchanged(without(rays, drop), first, second)
    uv = few.uv.copy()
    uv[(few.target_id == second) & (few.exposure == max(kept))] += 60
    assert exchanged_beads(replace(few, uv=uv), targets).tolist() == [sorted((first, second))]


def test_ids_exchanged_in_one_exposure_are_no_exchanged_beads(scene):
    rays, targets = scene
    for exposure in range(EXPOSURES):
        rows = rays.exposure == exposure
        ids = rays.target_id[rows]
        confused = exchanged(rays, ids[0], ids[1], rows)
        assert not len(exchanged_beads(confused, targets))


def test_one_bead_at_the_place_of_another_is_not_exchanged_with_it(scene):
    """Each must be at the place of the other."""
    rays, targets = scene
    first, second = nearest_pair(targets)
    target_id = np.where(rays.target_id == first, second, rays.target_id)
    single = without(replace(rays, target_id=target_id), rays.target_id == second)
    assert not len(exchanged_beads(single, targets))


@pytest.mark.parametrize('share', [0.0, 0.02, 0.1, 0.4])
def test_false_matches_exchange_no_beads(scene, share):
    """Matches to a random bead, and to the nearest one."""
    rays, targets = scene
    rng = np.random.default_rng(5)
    distance = np.linalg.norm(targets.xyz_mm[:, None] - targets.xyz_mm, axis=2)
    np.fill_diagonal(distance, np.inf)
    nearest = distance.argmin(axis=1) + 1
    for _ in range(6):
        false = rng.random(len(rays.uv)) < share
        for wrong in (rng.integers(1, BEADS + 1, len(rays.uv)), nearest[rays.target_id - 1]):
            confused = replace(rays, target_id=np.where(false, wrong, rays.target_id))
            assert not len(exchanged_beads(confused, targets))


def test_beads_behind_the_source_are_at_no_place(scene):
    rays, targets = scene
    xyz = targets.xyz_mm.copy()
    hidden = 7
    xyz[hidden - 1] = SOURCE - [0, 0, 500]
    drop = rays.target_id == hidden
    pair = nearest_pair(targets)
    confused = exchanged(without(rays, drop), *pair)
    found = exchanged_beads(confused, replace(targets, xyz_mm=xyz))
    assert found.tolist() == [sorted(pair)]


def test_beads_are_counted_by_exposures(scene):
    """Ids exchanged in the only exposure of both beads are no evidence on the survey."""
    rays, targets = scene
    first, second = nearest_pair(targets)
    both = [
        e
        for e in range(EXPOSURES)
        if {first, second} <= set(rays.target_id[rays.exposure == e].tolist())
    ]
    assert both
    drop = np.isin(rays.target_id, (first, second)) & (rays.exposure != both[0])
    assert not len(exchanged_beads(exchanged(without(rays, drop), first, second), targets))
