# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Shapes from a recording and CT: scatter as claimed, and findings on a body."""

from dataclasses import replace

import numpy as np
import pytest
from rigs import kinds
from scipy.spatial.transform import Rotation

from fluoro_calib_ros.bodies.body import Body, fitted_pose
from fluoro_calib_ros.bodies.shapes import BodyPlaces, condition_number, estimate_shape
from fluoro_calib_ros.findings import Kind, Severity
from fluoro_calib_ros.photogrammetry.rotations import vector_from_matrix

SD_MM = np.array([0.03, 0.03, 0.06])
CT_SD_MM = 0.1
CORNERS = np.array([[-15.0, -12, -3], [14, -10, 5], [2, 16, -8], [-6, 3, 15], [11, 8, 10]])


def recording(rng, true, exposures=200, fixed_mm=0.0, lost=0.1):
    """Places of the markers (m, 3) of a moving body."""
    count = len(true)
    turn = Rotation.from_rotvec(rng.normal(0, 0.4, (exposures, 3))).as_matrix()
    places = true @ np.swapaxes(turn, 1, 2) + rng.normal(0, 30, (exposures, 1, 3))
    places += rng.normal(0, 1, places.shape) * SD_MM + rng.normal(0, fixed_mm, (count, 3))
    places[rng.random((exposures, count)) < lost] = np.nan
    shape = (exposures, count, 3, 3)
    return BodyPlaces(
        places,
        np.broadcast_to(np.diag(SD_MM**2), shape),
        np.broadcast_to(fixed_mm**2 * np.eye(3), shape),
    )


def by_ct(rng, true, sd=CT_SD_MM):
    given = true + rng.normal(0, sd, true.shape)
    return Body('femur', np.arange(len(true)) + 1, given, np.full(len(true), sd))


def unknown(count=len(CORNERS)):
    return Body('femur', np.arange(count) + 1, np.full((count, 3), np.nan), np.full(count, np.inf))


def relative_errors(shape, true):
    rotation, shift = fitted_pose(shape.body.xyz_mm, true)
    return shape.body.xyz_mm @ rotation.T + shift - true


@pytest.mark.parametrize('fixed_mm', [0.0, 0.04])
def test_coordinates_scatter_as_claimed(fixed_mm):
    rng = np.random.default_rng(1)
    relative = []
    frame = []
    for _ in range(25):
        shape = estimate_shape(by_ct(rng, CORNERS), recording(rng, CORNERS, 60, fixed_mm))
        assert not shape.findings
        relative.append(relative_errors(shape, CORNERS) / shape.body.sd_mm[:, None])
        rotation, shift = fitted_pose(CORNERS, shape.body.xyz_mm)
        moved = (CORNERS @ rotation.T + shift).mean(axis=0) - CORNERS.mean(axis=0)
        away = np.concatenate([moved, vector_from_matrix(rotation)])
        frame.append(away @ np.linalg.solve(shape.body.frame_covariance, away) / 6)
    # One sd stands for three coordinates; in 6 of 15 directions, errors are only rounding.
    assert 0.6 < np.mean(np.square(relative)) < 1.5
    if not fixed_mm:
        assert np.mean(frame) == pytest.approx(1, abs=0.35)


def test_coordinates_of_unknown_sd_define_the_frame():
    """Their sd is that of their fit to the images; the frame scatters as claimed."""
    rng = np.random.default_rng(9)
    squares = []
    for _ in range(40):
        given = by_ct(rng, CORNERS)
        body = replace(given, sd_mm=np.full(len(CORNERS), np.inf))
        shape = estimate_shape(body, recording(rng, CORNERS, 30))
        rotation, shift = fitted_pose(CORNERS, shape.body.xyz_mm)
        moved = (CORNERS @ rotation.T + shift).mean(axis=0) - CORNERS.mean(axis=0)
        away = np.concatenate([moved, vector_from_matrix(rotation)])
        assert np.abs(moved).max() < 5 * CT_SD_MM
        squares.append(away @ np.linalg.solve(shape.body.frame_covariance, away) / 6)
    assert np.mean(squares) == pytest.approx(1, abs=0.35)
    two = replace(body, xyz_mm=np.where(np.arange(5)[:, None] < 2, body.xyz_mm, np.nan))
    free = estimate_shape(two, recording(rng, CORNERS, 30)).body
    assert np.abs(free.xyz_mm.mean(axis=0)).max() < 1  # the frame is that of the markers


def test_errors_of_ct_are_recovered():
    """CT errors of 0.1 mm become 0.02 mm or less after 10 s at 60 Hz."""
    rng = np.random.default_rng(2)
    shape = estimate_shape(by_ct(rng, CORNERS), recording(rng, CORNERS, 600))
    assert np.sqrt(np.mean(relative_errors(shape, CORNERS) ** 2)) < 0.02
    assert (shape.body.sd_mm < 0.02).all()
    assert 0.03 < shape.mean_error_mm < 0.1


def test_covariance_is_that_of_the_errors_in_the_datum_of_the_markers():
    """6 of 12 coordinates are the motion of the body, which has no error."""
    rng = np.random.default_rng(7)
    true = CORNERS[:4]
    squares = []
    for _ in range(40):
        found = estimate_shape(unknown(len(true)), recording(rng, true, 60)).body
        rotation, shift = fitted_pose(true, found.xyz_mm)
        error = (found.xyz_mm - true @ rotation.T - shift).ravel()
        variance, axes = np.linalg.eigh(found.covariance_mm2)
        assert variance[5] < 1e-9 * variance[6]
        squares.append(np.sum((axes[:, 6:].T @ error) ** 2 / variance[6:]) / 6)
    assert np.mean(squares) == pytest.approx(1, abs=4 * np.sqrt(2 / 240))


def test_no_marker_is_accused_where_the_others_are_nearly_on_a_line():
    """Errors of CT may turn these about their line by any angle, which moves the fourth marker."""
    rng = np.random.default_rng(12)
    near_a_line = np.array([[-15.0, -12, -3], [14, -10, 5], [0, -10.7, 1], [-6, 3, 15]])
    assert condition_number(near_a_line) < 120
    for _ in range(40):
        found = estimate_shape(by_ct(rng, near_a_line), recording(rng, near_a_line, 60))
        assert not found.findings


def test_false_places_are_left_out():
    """Three of 1000 are false matches by up to 100 mm; a marker with many of them is loose."""
    rng = np.random.default_rng(8)
    places = recording(rng, CORNERS, 400, lost=0.0)
    clean = estimate_shape(unknown(), places)
    false = rng.random(places.seen.shape) < 0.003
    assert np.count_nonzero(false) > 3
    wrong = places.xyz_mm + np.where(false[..., None], rng.uniform(-100, 100, 3), 0.0)
    found = estimate_shape(unknown(), replace(places, xyz_mm=wrong))
    assert not found.findings
    assert np.abs(relative_errors(found, CORNERS)).max() < 0.01
    np.testing.assert_allclose(found.body.sd_mm, clean.body.sd_mm, rtol=0.05)
    moves = rng.random(400) < 0.2
    jumping = places.xyz_mm.copy()
    jumping[moves, 2] += rng.normal(0, 1.0, (np.count_nonzero(moves), 3))
    found = estimate_shape(unknown(), replace(places, xyz_mm=jumping))
    assert Kind.MARKER_LOOSE in kinds(found.findings)


def test_a_shape_without_ct():
    rng = np.random.default_rng(3)
    shape = estimate_shape(unknown(), recording(rng, CORNERS))
    assert not shape.findings and shape.body.known.all()
    away = relative_errors(shape, CORNERS) / shape.body.sd_mm[:, None]
    assert 0.3 < np.mean(away**2) < 1.6


def test_a_marker_that_ct_does_not_have_gets_its_place():
    rng = np.random.default_rng(4)
    given = by_ct(rng, CORNERS)
    xyz = given.xyz_mm.copy()
    sd = given.sd_mm.copy()
    xyz[4] = np.nan
    sd[4] = np.inf
    shape = estimate_shape(Body('femur', given.target_id, xyz, sd), recording(rng, CORNERS))
    assert np.abs(relative_errors(shape, CORNERS)).max() < 0.03


def migrated(true, given):
    given[1] += [0.8, 0.6, 0.5]


def exchanged(true, given):
    given[[0, 2]] = given[[2, 0]]


def mirrored(true, given):
    given[:, 0] *= -1


def in_cm(true, given):
    given /= 10


def of_other_voxels(true, given):
    given *= 1.03


def of_thicker_slices(true, given):
    given[:, 2] *= 1.3


def of_another_body(true, given):
    given[:] = given[[1, 2, 3, 4, 0]] * [1, -1, -1]


@pytest.mark.parametrize(('error_mm', 'severity'), [(0.5, Severity.WARNING), (9, Severity.ERROR)])
def test_three_markers_that_are_not_those_of_ct_are_named(error_mm, severity):
    """No single one can be told; the frame is as uncertain as they deviate."""
    rng = np.random.default_rng(6)
    given = by_ct(rng, CORNERS[:3], 0.02).xyz_mm + np.outer([0, 0, 1], [0, error_mm, 0])
    body = Body('femur', np.arange(3) + 1, given, np.full(3, 0.02))
    shape = estimate_shape(body, recording(rng, CORNERS[:3]))
    (found,) = shape.findings
    assert (found.kind, found.severity) == (Kind.BODY_DIFFERENT, severity)
    assert np.sqrt(np.diagonal(shape.body.frame_covariance)[:3]).max() > 0.1 * error_mm


@pytest.mark.parametrize(
    ('change', 'kind', 'markers'),
    [
        (migrated, Kind.MARKER_MIGRATED, (2,)),
        (exchanged, Kind.MARKERS_EXCHANGED, (1, 3)),
        (mirrored, Kind.BODY_MIRRORED, ()),
        (in_cm, Kind.WRONG_UNIT, ()),
        (of_other_voxels, Kind.BODY_SCALED, ()),
        (of_thicker_slices, Kind.BODY_SCALED, ()),
        (of_another_body, Kind.BODY_DIFFERENT, ()),
    ],
)
def test_wrong_coordinates_of_ct_are_named(change, kind, markers):
    rng = np.random.default_rng(5)
    given = by_ct(rng, CORNERS).xyz_mm.copy()
    change(CORNERS, given)
    body = Body('femur', np.arange(5) + 1, given, np.full(5, CT_SD_MM))
    shape = estimate_shape(body, recording(rng, CORNERS))
    assert kinds(shape.findings) == [kind]
    assert shape.findings[0].place.target_id == markers
    if change is of_other_voxels:
        assert shape.findings[0].severity == Severity.ERROR
        assert shape.findings[0].numbers['factor'] == pytest.approx(1 / 1.03, abs=0.002)
    if change is of_thicker_slices:
        assert shape.findings[0].numbers['axis'] == 2
        assert shape.findings[0].numbers['factor'] == pytest.approx(1 / 1.3, abs=0.01)
    if change is of_another_body:  # the frame is not known, and says so
        assert shape.findings[0].severity == Severity.ERROR
        assert np.sqrt(np.diagonal(shape.body.frame_covariance)[:3]).min() > 3
    if change in (exchanged, of_other_voxels, of_thicker_slices):  # the frame is that of CT
        assert np.abs(shape.body.xyz_mm - CORNERS).max() < 4 * CT_SD_MM
        assert np.sqrt(np.diagonal(shape.body.frame_covariance)[:3]).max() < CT_SD_MM
    if markers or Kind.BODY_SCALED is kind:  # wrong CT coordinates do not contribute to the shape
        assert np.abs(relative_errors(shape, CORNERS)).max() < 0.03


def test_a_loose_marker_and_a_soft_body_are_named():
    rng = np.random.default_rng(6)
    loose = recording(rng, CORNERS)
    loose.xyz_mm[:, 2] += rng.normal(0, 0.4, (200, 3))
    shape = estimate_shape(by_ct(rng, CORNERS), loose)
    assert kinds(shape.findings) == [Kind.MARKER_LOOSE]
    assert shape.findings[0].place.target_id == (3,)
    soft = recording(rng, CORNERS)
    soft.xyz_mm[:] += rng.normal(0, 0.7, soft.xyz_mm.shape)
    assert Kind.BODY_NOT_RIGID in kinds(estimate_shape(by_ct(rng, CORNERS), soft).findings)


def test_sound_bodies_are_not_accused():
    rng = np.random.default_rng(7)
    for _ in range(30):
        shape = estimate_shape(by_ct(rng, CORNERS), recording(rng, CORNERS, 40, 0.03))
        assert not shape.findings


def test_markers_near_a_line_are_named():
    rng = np.random.default_rng(8)
    line = np.outer(np.linspace(-20, 20, 4), [1.0, 0.2, 0.1]) + rng.normal(0, 1, (4, 3))
    shape = estimate_shape(by_ct(rng, line), recording(rng, line))
    assert kinds(shape.findings) == [Kind.BODY_ON_A_LINE]
    assert shape.condition > 120


def test_condition_number_is_that_of_its_definition():
    # Four corners of a square of 20 mm: each is 10 mm from the best line.
    square = np.array([[0.0, 0, 0], [20, 0, 0], [20, 20, 0], [0, 20, 0]])
    assert condition_number(square) == pytest.approx(1000 / 20)
    assert condition_number(np.outer([1.0, 2, 3], [1, 1, 1])) > 1e10


def test_a_body_that_is_never_seen_stays_as_it_is():
    rng = np.random.default_rng(9)
    given = by_ct(rng, CORNERS)
    nothing = recording(rng, CORNERS, lost=1.0)
    shape = estimate_shape(given, nothing)
    assert kinds(shape.findings) == [Kind.BODY_UNSEEN]
    assert (shape.body.xyz_mm == given.xyz_mm).all()


def test_markers_are_placed_whatever_their_numbers():
    """Some are seen only with markers that are themselves placed by a later exposure."""
    rng = np.random.default_rng(8)
    xyz = rng.uniform(-30, 30, (7, 3))
    shown = [(2, 3, 4, 5, 6)] * 3 + [(0, 1, 2, 3)] * 3 + [(1, 2, 3, 4)] * 3
    for order in (np.arange(7), np.arange(7)[::-1]):
        places = np.full((len(shown), 7, 3), np.nan)
        for row, markers in zip(places, shown):
            turn = Rotation.random(random_state=rng).as_matrix()
            row[order[list(markers)]] = xyz[list(markers)] @ turn.T + rng.normal(0, 0.02, 3)
        covariance = np.broadcast_to(4e-4 * np.eye(3), (*places.shape, 3))
        shape = estimate_shape(unknown(7), BodyPlaces(places, covariance, 0 * covariance))
        assert shape.body.known.all()
        assert np.abs(relative_errors(shape, xyz[np.argsort(order)])).max() < 0.2


def test_marker_is_compared_with_three_others_on_a_line():
    """Also exactly on an axis of CT: the rotation about it is free."""
    rng = np.random.default_rng(9)
    ct = np.array([[0.0, 0, 0], [10, 0, 0], [20, 0, 0], [10, 15, 0]])
    shape = estimate_shape(by_ct(rng, ct, 0.0), recording(rng, ct, 40))
    assert not shape.findings
    assert np.abs(relative_errors(shape, ct)).max() < 0.1
