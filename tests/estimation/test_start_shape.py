# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Shapes of phantoms whose coordinates are unknown."""

import functools
from dataclasses import replace

import numpy as np
import pytest
import rigs
from rigs import refused
from scipy.spatial.transform import Rotation

from fluoro_calib_ros.cli import main
from fluoro_calib_ros.estimation.options import CalibrationOptions
from fluoro_calib_ros.estimation.start_shape import start_shape
from fluoro_calib_ros.estimation.survey import MeasuredDistance
from fluoro_calib_ros.exposures.frame import Frame
from fluoro_calib_ros.exposures.phantom import Phantom
from fluoro_calib_ros.findings import Kind
from fluoro_calib_ros.io.observations import write_observations_csv
from fluoro_calib_ros.io.phantom import read_phantom
from fluoro_calib_ros.jobs.survey import SurveyRequest, survey
from fluoro_calib_ros.rows import chosen_rows

BEADS = 40


def exposures(seed=1, count=12, turn_rad=0.6, side_mm=120.0, flat=1.0, seen=0.9, bent=True):
    """Return exposures of beads at random in a box, and their coordinates."""
    rng = np.random.default_rng(seed)
    xyz = rng.uniform(-side_mm / 2, side_mm / 2, (BEADS, 3)) * [1, 1, flat]
    frames = {fluoroscope.name: [] for fluoroscope in rigs.rig().fluoroscopes}
    for number in range(count):
        rotation = Rotation.from_rotvec(rng.uniform(-turn_rad, turn_rad, 3)).as_matrix()
        shift = rng.uniform(-20, 20, 3)
        for fluoroscope in rigs.rig().fluoroscopes:
            uv = fluoroscope.ideal(xyz @ rotation.T + shift)
            uv = fluoroscope.distortion.distort(uv) if bent else uv
            inside = ((uv > 0) & (uv < 1023)).all(axis=1) & (rng.random(BEADS) < seen)
            noise = rng.normal(0, 0.1, (inside.sum(), 2))
            frame = Frame(
                fluoroscope.name, number, np.flatnonzero(inside), uv[inside] + noise, (1024, 1024)
            )
            frames[fluoroscope.name].append(frame)
    return frames, xyz


def error_of(found, true):
    """Return RMS distances after a similarity, over the size; a mirror image differs by much."""
    a, b = found - found.mean(axis=0), true - true.mean(axis=0)
    u, s, v = np.linalg.svd(a.T @ b)
    sign = np.array([1, 1, np.linalg.det(u @ v)])
    moved = (s @ sign) / np.sum(a * a) * a @ (u * sign) @ v
    return np.sqrt(np.mean((moved - b) ** 2) / np.mean(b**2))


@pytest.mark.parametrize('distance', [None, 3200.0, 5500.0])
def test_shape_follows_from_distorted_images(distance):
    """Also with a principal distance that is wrong by 25 %."""
    frames, xyz = exposures()
    shape = start_shape(frames, None if distance is None else dict.fromkeys('ab', distance))
    assert shape.target_id.tolist() == list(range(BEADS))
    assert error_of(shape.xyz, xyz) < 0.005
    # About its centre, along its principal axes; the sd is that of the coordinates.
    np.testing.assert_allclose(shape.xyz.mean(axis=0), 0, atol=1e-9)
    products = shape.xyz.T @ shape.xyz
    np.testing.assert_allclose(
        products - np.diag(np.diag(products)), 0, atol=1e-6 * products[0, 0]
    )
    assert np.all(np.diff(np.diag(products)) < 0)
    actual = error_of(shape.xyz, xyz) * np.sqrt(np.mean(shape.xyz**2))
    assert actual / 3 < shape.sd < 3 * actual


def test_mirrored_images_give_the_mirror_image():
    frames, xyz = exposures()
    mirrored = {
        name: [
            Frame(name, f.number, f.target_id, [1023, 0] + [-1, 1] * f.uv, f.image_size)
            for f in view
        ]
        for name, view in frames.items()
    }
    shape = start_shape(mirrored)
    assert error_of(shape.xyz * [-1, 1, 1], xyz) < 0.005 < 0.3 < error_of(shape.xyz, xyz)


def test_a_third_of_the_targets_in_each_image_is_enough():
    """The images of bags/calibration show 29 % of the beads."""
    shown = rigs.exposures()
    shape = start_shape(shown)
    phantom = rigs.rig().phantom
    assert len(shape.target_id) > 0.99 * len(phantom.target_id)
    assert error_of(shape.xyz, phantom.xyz_mm[phantom.index(shape.target_id)]) < 0.02


def test_an_image_of_few_targets_and_images_without_noise_are_no_exception():
    frames, xyz = exposures()
    few = chosen_rows(frames['a'][0], slice(0, 3))
    shape = start_shape({**frames, 'a': [*frames['a'], replace(few, number=99)]})
    assert error_of(shape.xyz, xyz) < 0.005 and np.isfinite(shape.sd)
    rng = np.random.default_rng(0)
    views = [Rotation.from_rotvec(turn).as_matrix() for turn in rng.uniform(-0.6, 0.6, (6, 3))]
    exact = [
        Frame('a', number, np.arange(BEADS), 4096 * x[:, :2] / x[:, 2:] + 511.5, (1024, 1024))
        for number, x in enumerate(xyz @ view.T + [0, 0, 900] for view in views)
    ]
    assert error_of(start_shape({'a': exact}).xyz, xyz) < 1e-6


def test_a_few_wrong_ids_do_not_change_the_shape():
    frames, xyz = exposures(seen=1.0)
    for frame in (*frames['a'][::4], *frames['b'][1::4]):
        frame.uv[[3, 17]] = frame.uv[[17, 3]]
    shape = start_shape(frames)
    assert error_of(shape.xyz, xyz) < 0.01


def test_ids_that_differ_between_fluoroscopes_are_refused():
    frames, _ = exposures()
    other = np.random.default_rng(0).permutation(BEADS)
    renamed = [replace(frame, target_id=other[frame.target_id]) for frame in frames['b']]
    with refused(Kind.OTHER_PHANTOM):
        start_shape({**frames, 'b': renamed})


def test_what_does_not_determine_a_shape_is_refused():
    frames, _ = exposures()
    two = {name: view[:1] for name, view in frames.items()}
    with refused(Kind.FEW_EXPOSURES):
        start_shape(two)
    rare = {
        name: [
            Frame(name, f.number, f.target_id[i::4], f.uv[i::4], f.image_size)
            for i, f in enumerate(view[:4])
        ]
        for name, view in frames.items()
    }
    with refused(Kind.FEW_TARGETS):
        start_shape(rare)
    with refused(Kind.UNDETERMINED):
        start_shape(exposures(side_mm=10.0)[0])
    with refused(Kind.UNDETERMINED):
        start_shape(exposures(flat=1e-4)[0])


@functools.cache
def surveyed():
    """Return exposures, coordinates, distances, and surveys with and without rough coordinates."""
    frames, xyz = exposures(seed=5, seen=1.0, bent=False)
    ends = [(0, 7), (3, 30), (12, 25)]
    distances = [
        MeasuredDistance(a, b, float(np.linalg.norm(xyz[a] - xyz[b])), 0.02) for a, b in ends
    ]
    rough = xyz + np.random.default_rng(6).normal(0, 2.0, xyz.shape)
    given = Phantom(np.arange(BEADS), rough, np.full(BEADS, 2.0))
    options = CalibrationOptions(model='none')
    outcomes = [
        survey(SurveyRequest(frames, phantom, distances, options)) for phantom in (given, None)
    ]
    return frames, xyz, distances, outcomes


def test_a_survey_without_coordinates_is_that_from_rough_ones():
    _, _, _, (from_rough, outcome) = surveyed()
    np.testing.assert_array_equal(outcome.phantom.target_id, from_rough.phantom.target_id)
    # In another frame: the surveyed shapes and their precisions are the same.
    assert error_of(outcome.phantom.xyz_mm, from_rough.phantom.xyz_mm) < 1e-4
    sizes = [np.linalg.norm(np.std(one.phantom.xyz_mm, axis=0)) for one in (outcome, from_rough)]
    assert sizes[0] == pytest.approx(sizes[1], rel=1e-4)
    np.testing.assert_allclose(outcome.phantom.sd_mm, from_rough.phantom.sd_mm, rtol=0.05)


def test_a_survey_without_coordinates_has_the_checks_that_need_none():
    _, _, _, (_, outcome) = surveyed()
    made = [check.kind for check in outcome.validation.checks]
    assert made == [Kind.WEAK_INTERSECTION, Kind.DISTANCES, Kind.HALVES]
    assert outcome.validation.verdict == 'pass'
    assert [note.kind for note in outcome.validation.notes] == [Kind.TAKEN_ON_TRUST] * 2


def test_a_survey_without_coordinates_needs_distances_between_its_beads():
    frames, _, distances, _ = surveyed()
    with refused(Kind.DISTANCES):
        survey(SurveyRequest(frames, None))
    with refused(Kind.NOT_IN_BOTH):
        survey(SurveyRequest(frames, None, [MeasuredDistance(1, 9999, 5.0, 0.1)]))
    still = {'a': exposures(turn_rad=0.0)[0]['a']}
    with refused(Kind.UNDETERMINED):
        survey(SurveyRequest(still, None, distances))
    spoilt = {**frames, 'a': [replace(frames['a'][0], uv=frames['a'][0].uv * np.nan)]}
    with refused(Kind.DATA):
        survey(SurveyRequest(spoilt, None, distances))


def test_the_command_surveys_without_a_phantom_file(tmp_path, capsys):
    frames, _, distances, (_, outcome) = surveyed()
    write_observations_csv(tmp_path / 'points.csv', frames)
    told = [f'--distance={d.first},{d.second},{d.length_mm},{d.sd_mm}' for d in distances]
    out = tmp_path / 'phantom.csv'
    options = ['--image-size', '1024x1024', '--model', 'none', '--out', str(out)]
    main(['survey', str(tmp_path / 'points.csv'), *told, *options])
    assert 'Verdict: pass' in capsys.readouterr().out
    with pytest.raises(SystemExit):
        main(['survey', str(tmp_path / 'points.csv'), *told, *options, '--keep-given'])
    assert '--keep-given needs' in capsys.readouterr().err
    np.testing.assert_allclose(read_phantom(out).xyz_mm, outcome.phantom.xyz_mm, atol=1e-3)
