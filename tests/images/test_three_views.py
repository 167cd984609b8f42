# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Markers in three views: what two views predict for the third."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from marker_scenes import (
    SCENE,
    SIZE,
    THREE,
    bodies,
    calibration,
    covered,
    ids,
    rig,
    save_three,
    sequence,
)
from rigs import run

from fluoro_calib_ros.bodies.body import Body
from fluoro_calib_ros.errors import DataError
from fluoro_calib_ros.findings import Kind
from fluoro_calib_ros.images.codec import encode
from fluoro_calib_ros.images.marker_ids import find_bodies, identify_markers
from fluoro_calib_ros.images.marker_points import shadow_points
from fluoro_calib_ros.images.marker_rays import AGREE, CalibratedRig, RayFit
from fluoro_calib_ros.images.marker_views import MarkerViews
from fluoro_calib_ros.images.markers import FirstMarkers, MarkerFrame, MarkerOptions
from fluoro_calib_ros.io.bodies import write_bodies
from fluoro_calib_ros.io.observations import read_observations_csv
from fluoro_calib_ros.jobs.followers import MarkerSettings
from fluoro_calib_ros.photogrammetry.rotations import matrix_from_vector
from fluoro_calib_ros.simulation.marker_images import (
    MarkerImage,
)

OPTIONS = MarkerOptions(shutter=SCENE.shutter, search_every=3)
FAR_PX = 1.0  # a centre further from the truth is that of another object


def given(name: str) -> FirstMarkers:
    image = sequence()[0][name]
    return FirstMarkers(ids()[image.seen], image.uv[image.seen])


def away(found: MarkerFrame, name: str, number: int) -> np.ndarray:
    """Return distances (n,) [px] of the markers of an exposure from the truth."""
    true = sequence()[number - 1][name].uv[np.searchsorted(ids(), found.target_id)]
    return np.linalg.norm(found.uv - true, axis=1)


def plain(of: dict[str, MarkerImage]) -> dict[str, np.ndarray]:
    return {name: image.image for name, image in of.items()}


# ---- rays


def rays_of(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return image points (3, n, 2) of points (n, 3), and their standard deviations."""
    uv = np.stack([f.ideal(points) for f in rig().fluoroscopes])
    return uv, np.full(uv.shape[:2], 0.1)


def test_the_false_ray_of_three_is_told_by_the_others():
    points = np.random.default_rng(1).uniform(-10, 10, (30, 3))
    uv, sigma = rays_of(points)
    rows = np.arange(30)
    uv[rows % 3, rows] += [3.0, 4.0]
    found, lack = RayFit(calibration()[1]).intersect(uv, sigma)
    assert (found.dropped_view == rows % 3).mean() > 0.9
    told = found.dropped_view >= 0
    is_false = np.arange(3)[:, None] == found.dropped_view
    assert (lack[:, told][is_false[:, told]] > AGREE).all()
    assert (lack[:, told][~is_false[:, told]] < 0.1).all()
    assert np.abs(found.xyz_mm[told] - points[told]).max() < 1e-3
    # If the other rays do not identify the false one, all rays are doubtful.
    assert (lack[:, ~told] > AGREE).all()


def test_two_rays_of_three_views_are_as_those_of_two():
    points = np.random.default_rng(2).uniform(-10, 10, (20, 3))
    uv, sigma = rays_of(points)
    uv += np.random.default_rng(3).normal(0, 0.3, uv.shape)
    orientation = calibration()[1]
    of_two, lack_of_two = RayFit(orientation.subset(['a', 'c'])).intersect(uv[::2], sigma[::2])
    uv[1] = np.nan
    found, lack = RayFit(orientation).intersect(uv, sigma)
    np.testing.assert_allclose(found.xyz_mm, of_two.xyz_mm, atol=1e-9)
    np.testing.assert_allclose(lack[::2], lack_of_two, rtol=1e-6)
    assert np.isnan(lack[1]).all()


def test_agreement_has_the_same_probability_for_two_rays_and_for_three():
    points = np.random.default_rng(4).uniform(-10, 10, (40_000, 3))
    uv, sigma = rays_of(points)
    uv += np.random.default_rng(5).normal(0, 0.1, uv.shape)
    exact = replace(calibration()[1], covariance=np.zeros((27, 27)))
    _, of_three = RayFit(exact).intersect(uv, sigma)
    _, of_two = RayFit(exact.subset(['a', 'b'])).intersect(uv[:2], sigma[:2])
    beyond = [(lack[0] > 2.5 * AGREE / 4).mean() for lack in (of_two, of_three)]
    assert beyond[0] == pytest.approx(0.0124, abs=0.002)  # tail of a normal deviate
    assert (of_three[0] > AGREE).mean() < 4e-4 and (of_two[0] > AGREE).mean() < 4e-4


# ---- bodies by their shapes


def seen_rig() -> CalibratedRig:
    calibrations, orientation = calibration()
    return CalibratedRig(orientation, calibrations, {})


@pytest.mark.parametrize('seed', range(4))
def test_a_body_is_found_by_markers_each_of_which_two_views_see(seed):
    """In any pose, among shadows of 30 other points; no two views have four markers in common."""
    rng = np.random.default_rng(seed)
    body = Body('bone', np.arange(11, 17), rng.uniform(-9, 9, (6, 3)), np.full(6, 0.03))
    turned = body.xyz_mm @ matrix_from_vector(rng.normal(0, 2, 3)).T + rng.uniform(-5, 5, 3)
    xyz = np.concatenate([turned, rng.uniform(-25, 25, (30, 3))])
    views = [f.ideal(xyz) + rng.normal(0, 0.1, (36, 2)) for f in rig().fluoroscopes]
    hidden = [np.delete(uv, [view, view + 3], axis=0) for view, uv in enumerate(views)]
    found, missing = find_bodies(hidden, seen_rig(), [body])
    assert not missing
    for name, uv in zip(THREE, views):
        assert np.abs(found[name].uv - uv[:6]).max() < 1.0
    for one, other in ((0, 1), (0, 2), (1, 2)):
        pair = [uv if view in (one, other) else uv[:0] for view, uv in enumerate(hidden)]
        assert not find_bodies(pair, seen_rig(), [body])[0]
    found, missing = find_bodies([uv[6:] for uv in views], seen_rig(), [body])
    assert not found and len(missing) == 1


def test_points_of_three_rays_leave_few_of_two():
    """Shadows that three views explain are not intersected in pairs as well."""
    xyz = np.random.default_rng(7).uniform(-25, 25, (40, 3))
    views = [f.ideal(xyz) for f in rig().fluoroscopes]
    points = shadow_points(views, seen_rig())
    rows = np.tile(np.arange(40)[:, None], 3)
    found = {tuple(row) for row in points.shadow.tolist()}
    assert {tuple(row) for row in rows.tolist()} <= found and len(found) < 46
    two = shadow_points([views[0], views[1], views[2][:0]], seen_rig())
    assert len(two.xyz) > 60 and (two.shadow[:, 2] == -1).all()


def test_views_without_bodies_are_left_out_and_named_where_two_are_needed():
    images = plain(sequence()[0])
    images['c'] = covered(sequence()[0]['c'], np.s_[:])
    calibrations, orientation = calibration()
    assert set(identify_markers(images, calibrations, orientation, bodies())) == {'a', 'b'}
    images['b'] = covered(sequence()[0]['b'], np.s_[:])
    with pytest.raises(DataError, match=r'markers fit its shape|no markers in the image'):
        identify_markers(images, calibrations, orientation, bodies())


def test_a_view_that_sees_nothing_at_first_does_not_keep_the_others_from_starting():
    """It joins when the markers enter it, starting from the places of their bodies."""
    calibrations, orientation = calibration()
    follower = MarkerSettings({}, OPTIONS, calibrations, orientation, bodies())()
    joined = []
    for number, of in enumerate(sequence(), 1):
        images = plain(of)
        if number <= 8:
            images['c'] = covered(of['c'], np.s_[:])
        found = follower.extract(images, number)
        assert not found['a'].reason and not found['b'].reason
        if number <= 8:
            assert found['c'].finding.kind is Kind.NO_MARKERS and not len(found['c'].target_id)
            continue
        true = of['c'].uv[np.searchsorted(ids(), found['c'].target_id)]
        assert (np.linalg.norm(found['c'].uv - true, axis=1) < FAR_PX).all()
        joined.append(len(true) / of['c'].seen.sum())
    later = joined[OPTIONS.search_every :]
    assert later[0] > 0.8
    assert np.mean(later) > 0.9


def test_bodies_are_found_and_followed_in_three_views():
    """No markers are given; one that c does not see at first is added when it does."""
    calibrations, orientation = calibration()
    follower = MarkerSettings({}, OPTIONS, calibrations, orientation, bodies())()
    seen = right = 0
    joined = []
    for number, of in enumerate(sequence(), 1):
        images = plain(of)
        if number <= 10:
            images['c'] = covered(of['c'], [1])
        for name, found in follower.extract(images, number).items():
            assert not found.reason
            true = of[name].uv[np.searchsorted(ids(), found.target_id)]
            far = np.linalg.norm(found.uv - true, axis=1) > FAR_PX
            assert far.sum() <= found.doubtful
            right += int((~far).sum())
            seen += int(of[name].seen.sum()) - (name == 'c' and number <= 10)
            if name == 'c':
                joined.append(ids()[1] in found.target_id[~far])
            else:  # the other two follow it meanwhile
                assert number > 10 or ids()[1] in found.target_id[~far]
    assert right > 0.95 * seen
    assert not any(joined[:10]) and sum(joined[10:]) > 0.8 * len(joined[10:])


# ---- decisions


def test_ids_that_one_view_exchanged_are_told_by_the_others():
    """Without a body, two views alone could not show which of them is wrong."""
    calibrations, orientation = calibration()
    first = {name: given(name) for name in THREE}
    wrong = first['c'].target_id.copy()
    wrong[[2, 5]] = wrong[[5, 2]]
    first['c'] = FirstMarkers(wrong, first['c'].uv)
    views = MarkerViews(calibrations, orientation, OPTIONS, first=first)
    decisions = []
    for number, of in enumerate(sequence()[:16], 1):
        found = views.update(plain(of), number)
        decisions += found.decisions
        for name, view in found.views.items():
            far = away(view, name, number) > FAR_PX
            # Wrong ids given for the first exposure are noticed in the next one at the latest.
            assert number == 1 or not (far & ~view.doubtful).any()
            assert name == 'c' or not far.any()
    exchanged = [d for d in decisions if d.kind == 'exchanged']
    assert {(d.fluoroscope, frozenset(d.target_id)) for d in exchanged} == {
        ('c', frozenset(wrong[[2, 5]].tolist()))
    }
    assert not (away(found.views['c'], 'c', 16) > FAR_PX).any()


def test_an_exposure_without_one_of_the_views_is_followed_in_the_others():
    calibrations, orientation = calibration()
    first = {name: given(name) for name in THREE}
    views = MarkerViews(calibrations, orientation, OPTIONS, first=first, bodies=bodies())
    for number, of in enumerate(sequence()[:12], 1):
        images = plain(of)
        if 3 < number < 9:
            del images[THREE[number % 3]]
        found = views.update(images, number)
        for name, view in found.views.items():
            assert (view.finding is None) == (name in images)
            assert not ((away(view, name, number) > FAR_PX) & ~view.doubtful).any()
            if name in images:
                assert len(view.target_id) > 0.85 * of[name].seen.sum()


def test_a_marker_of_no_body_is_found_where_two_views_see_it():
    """The third view has lost it for long; two views alone could not determine where it is."""
    calibrations, orientation = calibration()
    first = {name: given(name) for name in THREE}
    views = MarkerViews(calibrations, orientation, OPTIONS, first=first)
    there = []
    for number, of in enumerate(sequence()[:17], 1):
        images = plain(of)
        if 3 < number < 12:
            images['c'] = covered(of['c'], [3])
        found = views.update(images, number)
        view = found.views['c']
        far = away(view, 'c', number) > FAR_PX
        assert not (far & ~view.doubtful).any()
        there.append(ids()[3] in view.target_id[~far & ~view.doubtful])
    assert not any(there[3:11]) and all(there[14:])


def test_what_cannot_be_followed_together_is_said():
    calibrations, orientation = calibration()
    first = {name: given(name) for name in THREE}
    with pytest.raises(DataError, match='only with their calibration'):
        MarkerViews({}, None, OPTIONS, first=first)
    with pytest.raises(DataError, match='fluoroscopes of a, b are followed together'):
        MarkerViews(calibrations, orientation.subset(['a', 'b']), OPTIONS, first=first)
    follower = MarkerSettings(first, OPTIONS, calibrations, orientation)()
    finding = follower.extract({'a': sequence()[0]['a'].image}, 1)['a'].finding
    assert finding.kind is Kind.OTHER_VIEW_MISSING
    assert finding.place.fluoroscopes == ('b', 'c')
    assert str(finding) == 'the views of b, c are missing'


# ---- command


def test_the_command_follows_three_fluoroscopes(tmp_path, capsys):
    """Images come from a folder for each fluoroscope, ids from bodies.csv."""
    save_three(tmp_path / 'result')
    write_bodies(tmp_path / 'bodies.csv', bodies())
    for number, of in enumerate(sequence()[:6], 1):
        for name, image in of.items():
            (tmp_path / 'images' / name).mkdir(parents=True, exist_ok=True)
            path = tmp_path / 'images' / name / f'{number:04d}.png'
            path.write_bytes(encode(image.image, '.png'))
    words = ['--bodies', tmp_path / 'bodies.csv', '--calibration', tmp_path / 'result']
    words += ['--fluoroscope', 'a,b,c', '--out', tmp_path / 'markers.csv', '--shutter', '0.4']
    assert run('extract', tmp_path / 'images', *words, '--json') == 0
    said = json.loads(capsys.readouterr().out)
    assert set(said['fluoroscopes']) == set(THREE)
    frames = read_observations_csv(tmp_path / 'markers.csv', (SIZE, SIZE))
    for name in THREE:
        for frame, of in zip(frames[name], sequence()):
            true = of[name].uv[np.searchsorted(ids(), frame.target_id)]
            assert len(true) >= 6 and np.abs(frame.uv - true).max() < FAR_PX
    two_sources = [tmp_path / 'images' / name for name in 'ab']
    assert run('extract', *two_sources, *words) == 2
    assert 'one SOURCE for each fluoroscope' in capsys.readouterr().err
