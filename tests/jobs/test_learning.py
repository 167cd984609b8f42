# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Shapes that a healthy rig learns: correct ones, and none where something is wrong."""

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from rigs import kinds, refused, true_calibrations, true_orientation

from fluoro_calib_ros.bodies.body import Body, declared_bodies, fitted_pose
from fluoro_calib_ros.errors import DataError
from fluoro_calib_ros.findings import Kind
from fluoro_calib_ros.io.versions import (
    LEARNED_SHAPES,
    read_learned_shapes,
    write_learned_shapes,
)
from fluoro_calib_ros.jobs.learning import learn_shapes, learned_for
from fluoro_calib_ros.simulation.knee import simulate_knee, virtual_knee, walking
from fluoro_calib_ros.simulation.rig import virtual_rig

RATE_HZ = 30


class Healthy:
    """A knee that walks for 2 s in a rig without distortion."""

    def __init__(self):
        self.rig = virtual_rig(1, strength=0.0)
        fluoroscopes = self.rig.fluoroscopes
        self.knee = virtual_knee(1)
        self.motion = walking(self.knee, np.arange(2 * RATE_HZ) / RATE_HZ)
        self.calibrations = true_calibrations(fluoroscopes)
        self.orientation = true_orientation(fluoroscopes, self.calibrations)
        texts = (f'{body.name}: {" ".join(map(str, body.target_id))}' for body in self.knee.bodies)
        self.bodies = declared_bodies(texts)
        self.frames = self.seen(self.knee)

    def seen(self, knee, seed=0):
        return simulate_knee(self.rig, knee, self.motion, seed=seed).frames

    def learn(self, frames=None, orientation=None):
        orientation = orientation or self.orientation
        return learn_shapes(frames or self.frames, self.calibrations, orientation, self.bodies)


@pytest.fixture(scope='module')
def healthy():
    return Healthy()


@pytest.fixture(scope='module')
def learned(healthy):
    return healthy.learn()


def moving(frames, marker, px=6.0):
    """Return frames in which one marker moves relative to the others, in both views."""
    rng = np.random.default_rng(3)
    shift = rng.normal(0, px, (len(frames['a']), 2))
    return {
        name: [
            replace(f, uv=f.uv + np.where((f.target_id == marker)[:, None], shift[k], 0.0))
            for k, f in enumerate(of_one)
        ]
        for name, of_one in frames.items()
    }


def test_learned_shapes_are_those_of_the_bodies(healthy, learned):
    assert learned.findings == () and learned.exposures == 2 * RATE_HZ
    assert learned.orientation_ids == (healthy.orientation.orientation_id,)
    ids = {name: one.calibration_id for name, one in healthy.calibrations.items()}
    assert dict(learned.calibration_ids) == ids
    for body, true in zip(learned.bodies, healthy.knee.bodies):
        rotation, shift = fitted_pose(body.xyz_mm, true.xyz_mm)
        away = body.xyz_mm @ rotation.T + shift - true.xyz_mm
        assert (body.name, body.target_id.tolist()) == (true.name, true.target_id.tolist())
        assert np.sqrt(np.mean(away**2)) < 2 * np.sqrt(np.mean(body.sd_mm**2)) < 0.1


def test_body_with_a_loose_marker_is_left_out(healthy):
    marker = int(healthy.knee.bodies[0].target_id[1])
    frames = moving(healthy.frames, marker)
    learned = healthy.learn(frames)
    assert [body.name for body in learned.bodies] == [healthy.knee.bodies[1].name]
    assert Kind.MARKER_LOOSE in kinds(learned.findings)
    other = int(healthy.knee.bodies[1].target_id[0])
    with refused(Kind.MARKER_LOOSE):
        healthy.learn(moving(frames, other))


def test_soft_body_is_left_out(healthy):
    """Its markers move by less than ISO 16087 allows, but more than their standard deviations."""
    rng = np.random.default_rng(4)

    def soft(body):
        moving_mm = rng.normal(0, 0.15, (2 * RATE_HZ, *body.xyz_mm.shape))
        return SimpleNamespace(
            name=body.name, target_id=body.target_id, xyz_mm=body.xyz_mm + moving_mm
        )

    first, second = healthy.knee.bodies
    learned = healthy.learn(healthy.seen(SimpleNamespace(bodies=(soft(first), second))))
    assert [body.name for body in learned.bodies] == [second.name]
    found = learned.findings[0]
    assert kinds(learned.findings) == [Kind.BODY_NOT_RIGID]
    assert found.place.name == f'body {first.name}' and found.numbers['ratio'] > 1.5
    assert found.numbers['mean_error_mm'] < 0.35
    with refused(Kind.BODY_NOT_RIGID):
        healthy.learn(healthy.seen(SimpleNamespace(bodies=(soft(first), soft(second)))))


def test_body_that_is_not_seen_is_left_out(healthy):
    keep = healthy.knee.bodies[1].target_id
    frames = {
        name: [
            replace(f, target_id=f.target_id[row], uv=f.uv[row], sigma=None)
            for f in of_one
            for row in [np.isin(f.target_id, keep)]
        ]
        for name, of_one in healthy.frames.items()
    }
    learned = healthy.learn(frames)
    assert len(learned.bodies) == 1 and kinds(learned.findings) == [Kind.BODY_UNSEEN]
    few = {name: of_one[:9] for name, of_one in frames.items()}
    with pytest.raises(DataError, match='no body has a shape from 10 exposures or more'):
        healthy.learn(few)


def test_nothing_is_learned_in_a_drift_or_with_a_healed_rig(healthy):
    shifted = {
        'a': healthy.frames['a'],
        'b': [
            replace(f, uv=f.uv + (20.0 if k >= RATE_HZ else 0.0))
            for k, f in enumerate(healthy.frames['b'])
        ],
    }
    with refused(Kind.RAYS_DO_NOT_MEET):
        healthy.learn(shifted)
    healed = replace(healthy.orientation, source='healing')
    with pytest.raises(DataError, match='is a healed rig, from which no shapes are learned'):
        healthy.learn(orientation=healed)


def test_file_holds_the_same_values(healthy, tmp_path):
    learned = healthy.learn().with_healed('rig-healed')
    write_learned_shapes(tmp_path, learned)
    again = read_learned_shapes(tmp_path)
    for one, other in zip(again.bodies, learned.bodies):
        assert one.name == other.name
        for name in ('target_id', 'xyz_mm', 'sd_mm', 'covariance_mm2'):
            np.testing.assert_array_equal(getattr(one, name), getattr(other, name))
    assert replace(again, bodies=()) == replace(learned, bodies=())
    assert learned_for(tmp_path, healthy.orientation).exposures == learned.exposures
    other = replace(healthy.orientation, exposures=7)
    with pytest.raises(DataError, match=r'learned with .*, not with the orientation'):
        learned_for(tmp_path, other)
    with pytest.raises(DataError, match='no shapes of bodies were learned'):
        learned_for(tmp_path / 'none', healthy.orientation)


@pytest.mark.parametrize(
    'change, message',
    [
        ({'version': 2}, 'version 2 of learned shapes is not known, only 1'),
        ({'exposures': 3}, 'the file was changed after it was written'),
        ({'digest': None, 'bodies': 5}, 'this is not a file of learned shapes'),
        ({'digest': None, 'bodies': [{'body': 'femur'}]}, 'this is not a file of learned shapes'),
        ({'digest': None, 'bodies': []}, 'there are no bodies'),
    ],
)
def test_file_that_is_not_right_is_refused(learned, tmp_path, change, message):
    write_learned_shapes(tmp_path, learned)
    path = tmp_path / LEARNED_SHAPES
    document = {**json.loads(path.read_text()), **change}
    path.write_text(json.dumps({k: v for k, v in document.items() if v is not None}))
    with pytest.raises(DataError, match=message):
        read_learned_shapes(tmp_path)


def test_covariance_of_another_size_is_refused(healthy, tmp_path):
    write_learned_shapes(tmp_path, healthy.learn())
    path = tmp_path / LEARNED_SHAPES
    document = json.loads(path.read_text())
    del document['digest']
    document['bodies'][0]['covariance_mm2'] = [[1.0]]
    path.write_text(json.dumps(document))
    with pytest.raises(DataError, match='the covariance of femur is not 12 x 12 numbers'):
        read_learned_shapes(tmp_path)


def test_covariance_follows_the_markers_of_a_body():
    markers = np.array([7, 5, 6])
    variance = np.repeat([7.0, 5.0, 6.0], 3)
    body = Body('one', markers, np.eye(3), np.ones(3), covariance_mm2=np.diag(variance))
    assert np.diagonal(body.covariance_mm2)[::3].tolist() == [5, 6, 7]
    some = body.rows(np.array([True, False, True]))
    assert np.diagonal(some.covariance_mm2)[::3].tolist() == [5, 7]
