# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""From frames to a network: selection of observations, initial values, and exclusions."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import rigs

from fluoro_calib_ros.correction.series import Functions, Series
from fluoro_calib_ros.errors import DataError
from fluoro_calib_ros.estimation import start_orientation
from fluoro_calib_ros.estimation.initial_network import (
    MAX_MISFIT,
    EarlierCalibration,
    KnownSensor,
    StartValues,
    _are_untilted,
    _reject_poor_fits,
    _require_different_poses,
    _Task,
    adjusted_with_precision,
    measured_network,
    nominal_interior,
    undetermined,
)
from fluoro_calib_ros.estimation.self_calibration import _require_inliers
from fluoro_calib_ros.estimation.start_orientation import (
    View,
    _better_pose,
    _preliminary_correction,
    _starts,
    orient_view,
    principal_distance_of_views,
    settle_planes,
    view_of,
)
from fluoro_calib_ros.exposures.frame import Frame
from fluoro_calib_ros.exposures.phantom import Phantom
from fluoro_calib_ros.findings import Finding, Kind
from fluoro_calib_ros.photogrammetry.collinearity import project
from fluoro_calib_ros.photogrammetry.noise import Noise
from fluoro_calib_ros.photogrammetry.plane_resection import mirrored_pose, plane_of
from fluoro_calib_ros.photogrammetry.resection import Resection
from fluoro_calib_ros.photogrammetry.rig_orientation import KnownOrientation
from fluoro_calib_ros.photogrammetry.rotations import matrix_from_vector, rotation_angle
from fluoro_calib_ros.photogrammetry.unknowns import RIGID_SD_MM, RIGID_SD_RAD
from fluoro_calib_ros.simulation.rig import looking_at_origin

SIZE = (1024, 1024)
INTERIOR = np.array([511.5, 511.5, 4000.0])
SOURCE = np.array([0.0, -1500.0, 0.0])


def seen(points, turn=(0.0, 0.0, 0.0), shift=(0.0, 0.0, 0.0), interior=INTERIOR):
    """Image points (n, 2) of targets (n, 3) turned and shifted before a source, and their pose."""
    r = matrix_from_vector(np.array(turn, dtype=float))
    rotation = looking_at_origin(SOURCE) @ r
    position = r.T @ (SOURCE - np.array(shift))
    n = len(points)
    uv = project(
        np.broadcast_to(rotation, (n, 3, 3)), np.broadcast_to(position, (n, 3)), points, interior
    )
    return uv, rotation, position


def phantom_of(points, sd=0.1):
    return Phantom(10 + np.arange(len(points)), points, np.full(len(points), sd))


def cube(count=30, seed=1):
    return np.random.default_rng(seed).uniform(-100, 100, (count, 3))


POSES = [((0, 0, 0), (0, 0, 0)), ((0.3, 0.1, 0), (5, 0, 0)), ((0, 0.4, 0.2), (0, 0, 9))]


def frames_of(points, name='a', poses=POSES, noise=0.0, seed=2, **more):
    """Frames numbered 1, 2, ... with target ids from 10 upwards."""
    rng = np.random.default_rng(seed)
    ids = 10 + np.arange(len(points))
    return [
        Frame(
            name,
            n,
            ids,
            seen(points, *pose)[0] + rng.normal(0, noise, (len(points), 2)),
            SIZE,
            **more,
        )
        for n, pose in enumerate(poses, 1)
    ]


# ---- the network


def test_network_holds_the_image_points_by_exposure_and_target():
    points = cube()
    first = frames_of(points)
    kept = np.arange(30) != 4
    second = [f.rows(kept) for f in frames_of(points, 'b')]
    second = [replace(f, sigma=0.5 + 0.01 * np.arange(29), angle=0.1 * f.number) for f in second]
    # The order of frames and of targets does not matter.
    shuffled = np.random.default_rng(3).permutation(29)
    second[1] = replace(
        second[1],
        target_id=second[1].target_id[shuffled],
        uv=second[1].uv[shuffled],
        sigma=second[1].sigma[shuffled],
    )
    found = measured_network({'a': first, 'b': second[::-1]}, phantom_of(points, 0.2))
    network = found.network
    np.testing.assert_array_equal(network.exposure, np.repeat(np.arange(6), [30] * 3 + [29] * 3))
    np.testing.assert_array_equal(network.fluoroscope, [0, 0, 0, 1, 1, 1])
    assert [(f.fluoroscope, f.number) for f in found.frames] == [
        (name, n) for name in 'ab' for n in (1, 2, 3)
    ]
    np.testing.assert_array_equal(found.target_id, 10 + np.arange(30))
    np.testing.assert_array_equal(network.point[90:119], np.flatnonzero(kept))
    rows = network.exposure == 4
    np.testing.assert_allclose(network.uv[rows], seen(points, *POSES[1])[0][kept])
    np.testing.assert_allclose(network.sigma[rows], 0.5 + 0.01 * np.arange(29))
    assert (network.sigma[:90] == 1).all() and network.interior_free.all()
    np.testing.assert_array_equal(network.survey_sd_mm, 0.2)
    np.testing.assert_array_equal(found.start.points_mm, points)
    assert np.isnan(found.angles[0]).all()
    np.testing.assert_allclose(found.angles[1], [0.1, 0.2, 0.3], atol=1e-7)
    assert found.image_size == (SIZE, SIZE) and found.untilted == (False, False)
    for row, pose in enumerate(POSES * 2):
        _, rotation, position = seen(points, *pose)
        np.testing.assert_allclose(found.start.rotation[row], rotation, atol=1e-3)
        np.testing.assert_allclose(found.start.position_mm[row], position, atol=3.0)


def test_target_that_no_exposure_shows_is_no_object_point():
    points = cube()
    frames = [f.rows(np.arange(30) != 4) for f in frames_of(points)]
    found = measured_network({'a': frames}, phantom_of(points))
    np.testing.assert_array_equal(found.target_id, np.delete(10 + np.arange(30), 4))
    np.testing.assert_array_equal(found.network.survey_mm, np.delete(points, 4, axis=0))


def test_calibrations_that_are_fixed_need_one_exposure():
    """The fixed correction is subtracted from the image points before the resection."""
    points = cube()
    (frame,) = frames_of(points, poses=POSES[1:2])
    shift = np.array([8.0, -5.0])
    sensor = KnownSensor(INTERIOR, lambda frame: np.tile(shift, (len(frame.uv), 1)))
    moved = replace(frame, uv=frame.uv + shift)
    found = measured_network({'a': [moved]}, phantom_of(points), sensors={'a': sensor})
    assert not found.network.interior_free.any()
    _, rotation, position = seen(points, *POSES[1])
    np.testing.assert_allclose(found.start.rotation[0], rotation, atol=1e-6)
    np.testing.assert_allclose(found.start.position_mm[0], position, atol=1e-2)
    np.testing.assert_array_equal(found.start.interior, INTERIOR[None])
    np.testing.assert_array_equal(found.network.uv, moved.uv)
    near = StartValues(
        {'a': INTERIOR + 50.0},
        {('a', 1): (matrix_from_vector([0, 0, 0.01]) @ rotation, position + 2)},
    )
    again = measured_network(
        {'a': [moved]}, phantom_of(points), starts=near, sensors={'a': sensor}
    )
    np.testing.assert_allclose(again.start.position_mm[0], position, atol=1e-2)
    np.testing.assert_array_equal(again.start.interior, INTERIOR[None])


def test_start_values_of_all_exposures_replace_resections():
    points = cube()
    frames = frames_of(points)
    exterior = {('a', n): seen(points, *pose)[1:] for n, pose in enumerate(POSES, 1)}
    interior = INTERIOR + [1.0, 2.0, 3.0]
    earlier = EarlierCalibration(
        {'a': Series(Functions(SIZE, 0), np.array([[2.0], [-1.0]]), np.zeros((33, 33)))},
        frozenset(),
        Noise(),
        10 + np.arange(30),
        points + 0.25,
    )
    starts = StartValues({'a': interior}, exterior)
    found = measured_network({'a': frames}, phantom_of(points), starts=starts)
    np.testing.assert_array_equal(found.start.interior[0], interior)
    np.testing.assert_array_equal(found.start.points_mm, points)
    # With its correction, the orientations equal those of the earlier calibration.
    corrected = [replace(f, uv=f.uv + [2.0, -1.0]) for f in frames]
    found = measured_network(
        {'a': corrected}, phantom_of(points), starts=replace(starts, earlier=earlier)
    )
    for row, (rotation, position) in enumerate(exterior.values()):
        np.testing.assert_array_equal(found.start.rotation[row], rotation)
        np.testing.assert_array_equal(found.start.position_mm[row], position)
    np.testing.assert_array_equal(found.start.points_mm, points + 0.25)
    np.testing.assert_array_equal(earlier.points(np.array([12, 39])), points[[2, 29]] + 0.25)
    task = _Task(phantom_of(points), None, None, {}, starts)
    assert task.has_starts('a', frames)
    assert not task.has_starts('b', frames)
    assert not task.has_starts('a', [*frames, replace(frames[0], number=9)])
    assert not replace(task, starts=None).has_starts('a', frames)


def test_numbers_of_exposures_and_targets_that_are_needed():
    known = {'b': object()}
    task = _Task(None, None, None, known)
    assert [task.min_exposures(name, []) for name in 'ab'] == [3, 1]
    given = replace(task, principal_distance=4000.0)
    assert [given.min_exposures('a', [], untilted) for untilted in (True, False)] == [1, 3]
    assert replace(task, sensors={}).min_exposures('a', []) == 1
    assert [task.min_targets('a'), task.min_targets('b')] == [12, 1]


def test_known_orientations_are_those_of_their_fluoroscope():
    points = cube()
    _, rotation, position = seen(points)
    known = KnownOrientation(INTERIOR, rotation, position, exterior_sd=(2.0, 3e-3))
    still = frames_of(points, 'b', poses=POSES[:1])
    found = measured_network(
        {'a': frames_of(points), 'b': still}, phantom_of(points), known={'b': known}
    )
    prior = found.network.exterior
    np.testing.assert_array_equal(prior.sd[:3], np.inf)
    np.testing.assert_allclose(prior.sd[3], [2.0] * 3 + [3e-3] * 3)
    np.testing.assert_allclose(prior.rotation[3], rotation)
    np.testing.assert_array_equal(prior.position_mm[3], position)
    np.testing.assert_array_equal(found.start.position_mm[3], position)
    assert found.known == {'b': known}
    fixed = replace(known, exterior_sd=None)
    found = measured_network({'b': still}, phantom_of(points), known={'b': fixed})
    np.testing.assert_allclose(
        found.network.exterior.sd[0], [RIGID_SD_MM] * 3 + [RIGID_SD_RAD] * 3
    )


# ---- what is excluded


@pytest.mark.parametrize('factor, poor', [(0.98, False), (1.02, True)])
def test_exposures_whose_residuals_are_many_times_the_median_do_not_fit(factor, poor):
    frames = frames_of(cube(), poses=[((0, 0, 0), (0, 0, 0))] * 5)
    scales = [1.0, 2.0, 2.0, 2.0 * MAX_MISFIT * factor, 5.0]
    found = [SimpleNamespace(scale=s) for s in scales]
    findings = _reject_poor_fits([*frames, frames[0]], [*found, None])
    assert len(findings) == poor
    found.append(None)
    findings = _reject_poor_fits([*frames, frames[0]], found)
    assert [one is None for one in found] == [False] * 3 + [poor, False, True]
    if poor:
        assert findings[0].kind is Kind.POOR_FIT and findings[0].place.exposures == (4,)
        assert findings[0].numbers['residual_px'] == scales[3]
    assert _reject_poor_fits(frames[:1], [None]) == []


@pytest.mark.parametrize(
    'degrees, shift_mm, same',
    [
        (1.9, (0, 0, 0), True),
        (2.1, (0, 0, 0), False),
        (0, (29.0, 0, 0), True),
        (0, (-31.0, 0, 0), False),
        (0, (0, 31.0, 0), False),
        (0, (0, 0, 290.0), True),
        (0, (0, 0, -310.0), False),
    ],
)
@pytest.mark.parametrize('size', [1.0, 0.1])
def test_poses_differ_by_a_turn_or_a_shift(degrees, shift_mm, same, size):
    """A shift along the optical axis counts a tenth; a turn about the phantom is no shift."""
    first = matrix_from_vector(np.array([0.3, -0.2, 0.5]))
    place = size * np.array([10.0, 20.0, 1500.0])
    shift_mm = size * np.array(shift_mm)

    def resection(turn, shift):
        rotation = turn @ first
        return Resection(rotation, -rotation.T @ (place + shift), 1.0, np.ones(1, bool))

    turn = matrix_from_vector(np.deg2rad(degrees) * np.array([0.0, 0.6, 0.8]))
    found = [resection(np.eye(3), 0), None, resection(turn, shift_mm)]
    if same:
        with rigs.refused(Kind.ONE_POSE, exposures=2) as error:
            _require_different_poses('a', found)
        assert error.value.finding.numbers['turn_deg'] == pytest.approx(degrees, abs=1e-5)
        _require_different_poses('a', found[:2])
    else:
        _require_different_poses('a', found)


def flat_grid(side=6, step=40.0):
    axis = step * (np.arange(side) - (side - 1) / 2)
    x, z = np.meshgrid(axis, axis)
    return np.column_stack([x.ravel(), np.zeros(side**2), z.ravel()])


@pytest.mark.parametrize('degrees, untilted', [(4.9, True), (5.1, False)])
def test_flat_targets_are_untilted_below_five_degrees(degrees, untilted):
    points = flat_grid()
    poses = [((0, 0, 0), (0, 0, 0)), ((0, 0, np.deg2rad(degrees)), (0, 0, 0))]
    frames = frames_of(points, poses=poses)
    found = [Resection(*seen(points, *pose)[1:], 1.0, np.ones(36, bool)) for pose in poses]
    task = _Task(phantom_of(points), None, None, {})
    assert _are_untilted(task, frames, found) == untilted
    assert _are_untilted(task, frames, [found[0], None])
    assert not _are_untilted(task, frames, [None, None])
    solid = points + [[0, 1, 0]] * np.arange(36)[:, None]
    assert not _are_untilted(replace(task, phantom=phantom_of(solid)), frames, found)


def test_exposures_that_remain_are_too_few():
    points = cube()
    frames = frames_of(points)
    small = [replace(frames[2].rows(np.arange(30) < 11), number=3)]
    with rigs.refused(Kind.FEW_EXPOSURES, exposures=2, needed=3, few_targets=1):
        measured_network({'a': frames[:2] + small}, phantom_of(points))
    more = [*frames, replace(frames[2].rows(np.arange(30) < 12), number=4)]
    assert len(measured_network({'a': more}, phantom_of(points)).frames) == 4
    rng = np.random.default_rng(5)
    noisy = frames_of(points, noise=0.2)
    wrong = [*noisy[:2], replace(noisy[2], uv=noisy[2].uv + rng.normal(0, 25.0, (30, 2)))]
    with rigs.refused(Kind.POOR_FIT, needed=3, fitting=2) as error:
        measured_network({'a': wrong}, phantom_of(points))
    assert error.value.finding.place.fluoroscopes == ('a',)


@pytest.mark.parametrize(
    ('tilt_deg', 'height', 'is_free', 'kind'),
    [
        (19.0, 0.0, True, Kind.UNTILTED_TARGETS),
        (21.0, 0.0, True, Kind.DATA),
        (19.0, 40.0, True, Kind.DATA),
        (19.0, 0.0, False, Kind.DATA),
    ],
)
def test_flat_targets_that_are_hardly_tilted_are_the_cause_of_few_inliers(
    tilt_deg, height, is_free, kind
):
    survey = np.random.default_rng(1).uniform(-50, 50, (30, 3)) * [1, 1, 0]
    survey[::2, 2] = height
    tilts = [np.deg2rad(tilt_deg) * np.array([np.cos(a), np.sin(a), 0]) for a in range(4)]
    network = SimpleNamespace(
        survey_mm=survey, rows=lambda f: np.arange(120), interior_free=np.array([is_free])
    )
    start = SimpleNamespace(rotation=np.stack([matrix_from_vector(tilt) for tilt in tilts]))
    measured = SimpleNamespace(network=network, start=start, fluoroscopes=('a',))
    few = SimpleNamespace(inliers=np.arange(120) < 20)
    with rigs.refused(kind) as error:
        _require_inliers(measured, few)
    assert kind is Kind.DATA or error.value.finding.place.fluoroscopes == ('a',)


def test_singular_networks_are_refused_with_what_their_targets_are(monkeypatch):
    network, truth = rigs.small_network(exposures=3, targets=20)
    assert undetermined(network).finding.kind is Kind.UNDETERMINED
    flat = replace(network, survey_mm=network.survey_mm * [1, 1, 1e-4])
    assert undetermined(flat).finding.kind is Kind.UNTILTED_TARGETS

    def singular(*arguments):
        raise np.linalg.LinAlgError

    monkeypatch.setattr('fluoro_calib_ros.estimation.initial_network.precision', singular)
    for fixed in (True, False):
        with rigs.refused(Kind.UNDETERMINED):
            adjusted_with_precision(
                network, truth, np.zeros_like(network.uv), Noise(), noise_fixed=fixed
            )


def test_noise_that_is_fixed_is_that_of_the_adjustment():
    network, truth = rigs.small_network(exposures=4, targets=30)
    nothing = np.zeros_like(network.uv)
    noise = Noise('student_t', 0.7, 9.0)
    held, precise = adjusted_with_precision(network, truth, nothing, noise, noise_fixed=True)
    assert held.noise == noise and len(precise.points) == 30
    found, _ = adjusted_with_precision(network, truth, nothing, noise)
    assert found.noise.scale == pytest.approx(0.3, rel=0.2)


def test_principal_point_to_start_with_is_the_centre_of_the_image():
    np.testing.assert_array_equal(nominal_interior((1024, 768), 3000.0), [511.5, 383.5, 3000.0])


# ---- initial orientations


def view(points, uv):
    return view_of(Frame('a', 1, np.arange(len(points)), uv, SIZE), points, uv)


def test_views_are_of_targets_in_space_or_in_a_plane():
    solid, few, flat = cube(25), cube(19), flat_grid()
    nearly = flat + 0.05 * 115.0 * np.random.default_rng(4).uniform(-1, 1, (36, 3)) * [0, 1, 0]
    kinds = {}
    turn = (0.4, 0.1, 0.3)
    for name, points in (('solid', solid), ('few', few), ('flat', flat), ('nearly', nearly)):
        one = view(points, seen(points, turn)[0])
        assert one.error is None
        kinds[name] = (one.projection is None, one.plane is None, one.is_flat, one.needs_samples)
        assert orient_view(one, INTERIOR).scale < 1e-3
        _, rotation, _ = seen(points, turn)
        assert rotation_angle(orient_view(one, INTERIOR).rotation @ rotation.T) < 1e-3
    assert kinds == {
        'solid': (False, True, False, False),
        'few': (False, True, False, True),
        'flat': (True, False, True, True),
        'nearly': (False, False, False, True),
    }
    line = np.outer(np.arange(12.0), [5.0, 3.0, 1.0])
    spoilt = view(line, seen(line)[0])
    assert isinstance(spoilt.error, Finding)
    with pytest.raises(DataError):
        orient_view(spoilt, INTERIOR)


def test_resections_that_compete_depend_on_the_targets():
    flat, few = flat_grid(), cube(19)
    assert len(_starts(view(flat, seen(flat, (0.4, 0.1, 0.3))[0]), INTERIOR)) == 2
    assert len(_starts(view(few, seen(few)[0]), INTERIOR)) == 2


def test_orientation_with_the_smallest_residuals_is_taken(monkeypatch):
    few = cube(19)
    one = view(few, seen(few)[0])

    def starts(*scales):
        def start(scale):
            if scale is None:
                raise DataError('not this one', kind=Kind.NOT_ORIENTED)
            if scale < 0:
                raise np.linalg.LinAlgError('singular')
            return SimpleNamespace(scale=scale)

        monkeypatch.setattr(
            start_orientation,
            '_starts',
            lambda view, interior: [lambda s=s: start(s) for s in scales],
        )
        return orient_view(one, INTERIOR)

    assert starts(3.0, 1.0, None, 2.0, -1).scale == 1.0
    with pytest.raises(DataError, match='not this one'):
        starts(None, -1)
    with pytest.raises(DataError, match='singular'):
        starts(-1, None)


def test_principal_distance_is_the_median_of_views_in_space():
    """Such views precede those with few targets, which precede planes."""
    views = []
    for k, c in enumerate((3000.0, 5000.0, 3900.0)):
        interior = np.array([511.5, 511.5, c])
        views.append(view(cube(25, k), seen(cube(25, k), (0.1 * k, 0, 0), interior=interior)[0]))
    few = view(cube(19), seen(cube(19), interior=np.array([511.5, 511.5, 9000.0]))[0])
    middle = INTERIOR[:2]
    assert principal_distance_of_views([few, *views], middle, SIZE) == pytest.approx(
        3900, rel=1e-3
    )
    assert principal_distance_of_views([few], middle, SIZE) == pytest.approx(9000, rel=1e-3)
    flat = [
        view(flat_grid(), seen(flat_grid(), turn)[0])
        for turn in ((0, 0, 0.5), (0.5, 0, 0), (0.4, 0, 0.4))
    ]
    assert principal_distance_of_views(flat, middle, SIZE) == pytest.approx(4000, rel=1e-3)
    assert principal_distance_of_views([*flat, few], middle, SIZE) == pytest.approx(9000, rel=1e-3)
    # The possible range is half to thirty times the longer side.
    for size, possible in (
        ((7900, 10), True),
        ((8100, 10), False),
        ((10, 134), True),
        ((132, 10), False),
    ):
        if possible:
            assert principal_distance_of_views(flat, middle, size) == pytest.approx(4000, rel=1e-3)
        else:
            with rigs.refused(Kind.UNTILTED_TARGETS):
                principal_distance_of_views(flat, middle, size)
    with rigs.refused(Kind.UNTILTED_TARGETS):
        principal_distance_of_views([], middle, SIZE)


def bend(uv):
    x, y = ((uv - 511.5) / 512).T
    return np.stack([6 * x**3 - 4 * x * y, 5 * y * y * x + 3], axis=1)


def resected(points, pose):
    return Resection(*seen(points, *pose)[1:], 1.0, np.ones(len(points), bool))


def test_preliminary_correction_is_the_cubic_polynomial_of_all_residuals():
    """False matches and views that are not oriented have no influence."""
    flat = flat_grid()
    poses = [((0.3, 0, 0), (0, 0, 0)), ((0, 0, 0.3), (40, 0, 0)), ((0.2, 0, 0.2), (-40, 0, 30))]
    views = []
    for pose in poses:
        ideal = seen(flat, *pose)[0]
        uv = ideal + bend(ideal)
        for _ in range(20):
            uv = ideal + bend(uv)
        uv[::9] += [25.0, -40.0]
        views.append(View(Frame('a', 1, np.arange(36), uv, SIZE), flat, uv))
    found = [resected(flat, pose) for pose in poses]
    wrong = replace(views[0], uv=views[0].uv + 100.0)
    correct = _preliminary_correction([*views, wrong], [*found, None], INTERIOR)
    good = views[1].uv[np.arange(36) % 9 > 0]
    np.testing.assert_allclose(correct(good), bend(good), atol=0.15)


def test_a_plane_gets_the_better_of_its_two_poses():
    flat = flat_grid()
    pose = ((0.3, 0.1, 0.25), (0, 0, 0))
    uv, rotation, position = seen(flat, *pose)
    one = view(flat, uv)
    plane = plane_of(flat)
    mirrored = Resection(*mirrored_pose(rotation, position, plane), 5.0, np.ones(36, bool))
    assert rotation_angle(mirrored.rotation @ rotation.T) > 0.3
    found = _better_pose(one, mirrored, INTERIOR)
    assert rotation_angle(found.rotation @ rotation.T) < 1e-4 and found.scale < 1e-3
    solid = cube(25)
    with_projection = view(solid, seen(solid)[0])
    same = _better_pose(with_projection, resected(solid, POSES[0]), INTERIOR)
    assert same.scale < 1e-3
    # Distortion bends a plane as a tilt does; with more exposures the pose is found.
    poses = [
        ((0.3, 0, 0.0), (0, 0, 0)),
        ((0, 0, 0.35), (40, 0, 0)),
        ((-0.3, 0, 0.2), (-40, 0, 30)),
    ]
    views, start = [], []
    for number, p in enumerate(poses):
        ideal, own, at = seen(flat, *p)
        bent = ideal + bend(ideal) - [0, 3]
        views.append(view(flat, bent))
        there = (own, at) if number else mirrored_pose(own, at, plane)
        start.append(Resection(*there, 1.0, np.ones(36, bool)))
    settled = settle_planes(views, start, INTERIOR)
    for p, one in zip(poses, settled):
        assert rotation_angle(one.rotation @ seen(flat, *p)[1].T) < np.deg2rad(3)
    assert settle_planes(views, [None] * 3, INTERIOR) == [None] * 3
    assert settle_planes([with_projection], [same], INTERIOR)[0] is same


def test_poses_of_planes_are_refined_without_the_preliminary_correction(monkeypatch):
    told = []

    def better(view, present, interior):
        told.append((view.uv, present))
        return present + 1

    monkeypatch.setattr(start_orientation, '_better_pose', better)
    monkeypatch.setattr(
        start_orientation, '_preliminary_correction', lambda *given: lambda uv: 0.1 * uv
    )
    uv = np.arange(8.0).reshape(4, 2)
    views = [View(None, None, uv * factor, plane_image=np.eye(3)) for factor in (1.0, 2.0, 3.0)]
    found = settle_planes(views, [10, None, 20], None)
    rounds = start_orientation.ROUNDS
    assert found == [10 + rounds, None, 20 + rounds]
    assert [present for _, present in told[::2]] == [10 + k for k in range(rounds)]
    for given, _ in told[::2]:
        np.testing.assert_allclose(given, 0.9 * uv)
    bodies = [replace(view, projection=np.eye(3, 4)) for view in views]
    assert settle_planes(bodies, [1, None, 2], None) == [1, None, 2]
