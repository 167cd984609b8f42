# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Markers in motion are followed through crossings and occlusions; doubtful ids are reported."""

from __future__ import annotations

import csv
import json
from collections.abc import Iterable, Sequence
from dataclasses import replace
from functools import cache
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import pytest
import rigs
from marker_scenes import SCENE, SIZE, covered, small_rig
from rigs import run

from fluoro_calib_ros.bodies.body import Body, declared_bodies
from fluoro_calib_ros.correction.fluoroscope_calibration import FluoroscopeCalibration
from fluoro_calib_ros.correction.registry import no_correction
from fluoro_calib_ros.errors import DataError
from fluoro_calib_ros.exposures.phantom import Phantom
from fluoro_calib_ros.findings import Finding, Kind
from fluoro_calib_ros.images.codec import encode
from fluoro_calib_ros.images.marker_decisions import Decision, revise
from fluoro_calib_ros.images.marker_ids import find_bodies, identify_markers
from fluoro_calib_ros.images.marker_motion import Motion, doubtful_pairs
from fluoro_calib_ros.images.marker_rays import CalibratedRig
from fluoro_calib_ros.images.marker_views import MarkerViews, ViewsFrame
from fluoro_calib_ros.images.markers import FirstMarkers, MarkerFrame, MarkerOptions, MarkerTracker
from fluoro_calib_ros.images.overlay import draw_markers
from fluoro_calib_ros.io.bags.metadata import message_class
from fluoro_calib_ros.io.bags.reader import COMPRESSED_IMAGE, JOINT_STATE
from fluoro_calib_ros.io.bags.writer import BagWriter
from fluoro_calib_ros.io.bodies import write_bodies
from fluoro_calib_ros.io.calibration import save_calibration, save_orientation
from fluoro_calib_ros.io.phantom import write_phantom
from fluoro_calib_ros.jobs.followers import MarkerSettings
from fluoro_calib_ros.photogrammetry.rig_orientation import RigOrientation
from fluoro_calib_ros.photogrammetry.rotations import matrix_from_vector
from fluoro_calib_ros.simulation.marker_images import (
    MARKER_SETTINGS,
    MarkerImage,
    MarkerSequence,
    MovingMarkers,
)
from fluoro_calib_ros.simulation.rig import VirtualRig

FRAMES = 26
SEED = 26  # markers cross in both views, but are apart in the first images
OPTIONS = MarkerOptions(shutter=SCENE.shutter)
FAR_PX = 1.0  # a centre further from the truth is that of another object


@cache
def rig() -> VirtualRig:
    return small_rig()


@cache
def sequence() -> tuple[np.ndarray, tuple[dict[str, MarkerImage], ...]]:
    """Return the ids of the markers, and the images of all exposures by fluoroscope."""
    markers = MovingMarkers(SCENE, SEED)
    settings = replace(MARKER_SETTINGS, round_field=False)
    return markers.target_id, tuple(
        dict(images) for images in MarkerSequence(rig(), markers, settings, FRAMES, SEED)
    )


@cache
def calibration() -> tuple[dict[str, FluoroscopeCalibration], RigOrientation]:
    """Return the true calibration of the rig."""
    calibrations = {
        f.name: FluoroscopeCalibration(
            fluoroscope=f.name,
            image_size=(SIZE, SIZE),
            interior=f.interior,
            interior_covariance=np.eye(3) * 1e-4,
            interior_estimated=True,
            model=no_correction(),
            train_exposure=np.zeros(0, dtype=int),
            image_sd=0.05,
            sigma0=1.0,
            nu=10.0,
            exposures=1,
            observations=1,
            inliers=1,
            rmse_before=np.ones(2),
            rmse_after=np.ones(2),
            cost_adjustment=0.0,
            cost_regression=0.0,
            iterations=1,
            converged=True,
            stamp_ns=0,
            frame_id=f'{f.name}_optical',
            source_digest='00',
            seconds=0.0,
        )
        for f in rig().fluoroscopes
    }
    names = tuple(calibrations)
    orientation = RigOrientation(
        names,
        np.array([f.interior for f in rig().fluoroscopes]),
        np.array([f.rotation for f in rig().fluoroscopes]),
        np.array([f.position_mm for f in rig().fluoroscopes]),
        np.eye(18) * 1e-8,
        'phantom',
        'capture',
        tuple(calibrations[name].calibration_id for name in names),
    )
    return calibrations, orientation


def given(name: str) -> FirstMarkers:
    """Return the markers of the first image, accurate to half a pixel."""
    ids, images = sequence()
    image = images[0][name]
    rng = np.random.default_rng(2)
    uv = image.uv[image.seen] + rng.uniform(-0.5, 0.5, (int(image.seen.sum()), 2))
    return FirstMarkers(ids[image.seen], uv)


@cache
def followed(name: str) -> tuple[MarkerFrame, ...]:
    tracker = MarkerTracker(OPTIONS, first=given(name))
    _, images = sequence()
    return tuple(tracker.update(of[name].image, n) for n, of in enumerate(images, 1))


def followed_bodies() -> tuple[Body, ...]:
    ids, _ = sequence()
    texts = ' '.join(map(str, ids[:4])), ' '.join(map(str, ids[4:]))
    return declared_bodies([f'one: {texts[0]}', f'two: {texts[1]}'])


@cache
def followed_in_both(
    options: MarkerOptions = OPTIONS, jpeg: int | None = None, lag: float = 0.0
) -> tuple[ViewsFrame, ...]:
    """Follow the markers in both views.

    jpeg: quality with which the images were compressed. lag: share of the last result of a filter
    in its next one.
    """
    _, images = sequence()
    shown = [{name: image.image for name, image in of.items()} for of in images]
    for last, of in pairwise(shown):
        for name, image in of.items():
            of[name] = np.rint((1 - lag) * image + lag * last[name]).astype(image.dtype)
    if jpeg is not None:
        shown = [{name: compressed(of[name], jpeg) for name in of} for of in shown]
    calibrations, orientation = calibration()
    bodies = followed_bodies()
    first = {name: given(name) for name in 'ab'}
    views = MarkerViews(calibrations, orientation, options, first=first, bodies=bodies)
    return tuple(views.update(of, number) for number, of in enumerate(shown, 1))


def compressed(image: np.ndarray, quality: int) -> np.ndarray:
    """Return an image of 8 bits after compression."""
    grey = np.rint(image * (255 / (2**MARKER_SETTINGS.bits - 1))).astype(np.uint8)
    encoded = cv2.imencode('.jpg', grey, [cv2.IMWRITE_JPEG_QUALITY, quality])[1]
    return cv2.imdecode(encoded, cv2.IMREAD_GRAYSCALE)


def errors(name: str, frames: tuple[MarkerFrame, ...]) -> tuple[np.ndarray, ...]:
    """Return errors (n, 2) [px], standard deviations and doubts (n,) of all measured markers."""
    ids, images = sequence()
    away = [
        found.uv - of[name].uv[np.searchsorted(ids, found.target_id)]
        for found, of in zip(frames, images[-len(frames) :])
    ]
    return (
        np.concatenate(away),
        np.concatenate([found.sigma for found in frames]),
        np.concatenate([found.doubtful for found in frames]),
    )


@pytest.mark.long
def test_ids_are_right_or_doubtful_through_crossings_and_occlusions():
    ids, images = sequence()
    hidden = {name: sum(int((~of[name].seen).sum()) for of in images) for name in 'ab'}
    overlapped = [int(found.overlapped.sum()) for name in 'ab' for found in followed(name)]
    assert sum(hidden.values()) > 10 and sum(overlapped) > 10
    for name in 'ab':
        away, _, doubtful = errors(name, followed(name))
        wrong = np.linalg.norm(away, axis=1) > FAR_PX
        assert not (wrong & ~doubtful).any()
        assert len(away) > 0.85 * (FRAMES * len(ids) - hidden[name])


@pytest.mark.long
def test_centres_are_as_precise_as_their_sigma_says():
    for name in 'ab':
        away, sigma, _ = errors(name, followed(name))
        good = np.linalg.norm(away, axis=1) < FAR_PX
        normalised = np.abs(away[good]) / sigma[good, None]
        assert 0.75 < np.median(normalised) / 0.6745 < 1.35
        assert np.median(np.abs(away[good])) / 0.6745 < 0.08


def test_two_views_leave_no_wrong_id_and_hardly_a_doubt():
    frames = followed_in_both()
    doubts = []
    for name in 'ab':
        away, _, doubtful = errors(name, tuple(found.views[name] for found in frames))
        assert not (np.linalg.norm(away, axis=1) > FAR_PX)[~doubtful].any()
        doubts.append(doubtful)
    assert np.concatenate(doubts).mean() < 0.05


@pytest.mark.parametrize('processing', [{'jpeg': 9}, {'lag': 0.4}, {}])
def test_centres_are_as_precise_as_their_sigma_says_in_processed_images(processing):
    frames = followed_in_both(**processing)
    normalised = []
    for name in 'ab':
        away, sigma, _ = errors(name, tuple(found.views[name] for found in frames[10:]))
        good = np.linalg.norm(away, axis=1) < FAR_PX
        normalised.append(away[good] / sigma[good, None])
    spread = np.sqrt(np.mean(np.concatenate(normalised) ** 2))
    assert 0.8 < spread < 1.25


def meeting(frame: int, turn: bool) -> tuple[np.ndarray, np.ndarray]:
    """Return an image of two markers that meet and then pass or turn back, and all places."""
    t = frame - 11.0
    along = -abs(t) if turn else t
    first = np.array([64.0 + 2.5 * along, 64.0])
    second = np.array([64.0 - 2.5 * along, 64.0 + 0.3])
    rng = np.random.default_rng(frame)
    still = np.array([[20.0, 20.0], [110.0, 30.0], [30.0, 105.0]])
    x = np.stack(np.meshgrid(np.arange(128), np.arange(128)), axis=-1)
    light = np.full((128, 128), 900.0)
    for centre in (first, second, *still):
        light *= 1 - 0.6 * np.exp(-((x - centre) ** 2).sum(axis=2) / (2 * 1.5**2))
    image = np.clip(20 * rng.poisson(light), 0, 65535).astype(np.uint16)
    return image, np.array([first, second, *still])


def test_markers_that_may_have_been_exchanged_are_doubtful():
    frames = []
    tracker = MarkerTracker(first=FirstMarkers(np.arange(1, 6), meeting(1, True)[1]))
    for number in range(1, 22):
        frames.append(tracker.update(meeting(number, True)[0], number))
    last = frames[-1]
    row = np.isin(last.target_id, (1, 2))
    assert last.doubtful[row].all() and row.any()
    assert not last.doubtful[~row].any()
    said = [doubt for found in frames for doubt in found.doubts]
    assert any(
        doubt.kind is Kind.SHADOWS_MET and set(doubt.place.target_id) == {1, 2} for doubt in said
    )
    assert all(not found.doubtful.any() for found in frames[:6])


def test_markers_that_pass_keep_their_ids():
    tracker = MarkerTracker(first=FirstMarkers(np.arange(1, 6), meeting(1, False)[1]))
    for number in range(1, 22):
        image, true = meeting(number, False)
        last = tracker.update(image, number)
    assert last.target_id.tolist() == [1, 2, 3, 4, 5]
    assert np.abs(last.uv - true).max() < 0.3


def test_markers_that_are_not_seen_are_led_by_those_that_are(monkeypatch):
    """Velocities before and after the image are used; nothing is learned from doubtful markers."""
    told = []

    def lead(motion, seen, before, sure):
        told.append((seen.copy(), motion.velocity - before, sure.copy()))
        return np.zeros(len(seen), dtype=bool)

    monkeypatch.setattr(Motion, 'lead', lead)
    tracker = MarkerTracker(first=FirstMarkers(np.arange(1, 6), meeting(1, False)[1]))
    for number in range(1, 9):
        image, true = meeting(number, False)
        if number == 7:  # cover the last marker
            u, v = true[4].astype(int)
            image[v - 12 : v + 12, u - 12 : u + 12] = image[:10].mean()
        found = tracker.update(image, number)
        seen, change, sure = told[-1]
        assert (np.flatnonzero(seen) + 1).tolist() == found.target_id.tolist()
        assert change[seen].any() == (number > 1) and not change[~seen].any()
        np.testing.assert_array_equal(sure[seen], ~found.doubtful)
        if number == 7:
            assert found.missing.tolist() == [5]
            np.testing.assert_allclose(found.predicted, true[4:], atol=1.0)
    assert told[6][0].tolist() == [True] * 4 + [False]
    late = MarkerTracker(
        first=FirstMarkers(np.arange(1, 5), meeting(1, False)[1][:4]), later=np.array([9])
    )
    found = late.update(meeting(1, False)[0], 1)
    assert found.missing.tolist() == [9] and np.isnan(found.predicted).all()
    assert found.lost.all()


def test_a_marker_enters_where_a_person_sees_it_first():
    ids, images = sequence()
    first = given('a')
    late, at = first.target_id[0], 9
    others = FirstMarkers(first.target_id[1:], first.uv[1:])
    tracker = MarkerTracker(OPTIONS, first=others, later=np.array([late]))
    row = int(np.searchsorted(ids, late))
    there = []
    for number, of in enumerate(images, 1):
        if number == at:
            tracker.place(FirstMarkers([late], of['a'].uv[row : row + 1] + 0.5))
        found = tracker.update(of['a'].image, number)
        if number == at:
            assert not found.doubtful[found.target_id == late].any()
            assert all(late not in doubt.place.target_id for doubt in found.doubts)
        uv = found.uv[(found.target_id == late) & ~found.doubtful]
        there.append(len(uv) > 0)
        assert not len(uv) or np.linalg.norm(uv - of['a'].uv[row]) < FAR_PX
    assert not any(there[: at - 1]) and there[at - 1]
    from_the_first = [late in f.target_id[~f.doubtful] for f in followed('a')[at - 1 :]]
    assert sum(there) >= sum(from_the_first) - 2


def test_a_person_sets_right_what_was_exchanged():
    image, true = meeting(1, True)
    tracker = MarkerTracker(first=FirstMarkers(np.arange(1, 6), true))
    for number in range(1, 22):
        image, true = meeting(number, True)
        last = tracker.update(image, number)
    assert last.doubtful[:2].all()
    for number in range(22, 25):
        image, true = meeting(number, True)
        if number == 22:
            tracker.place(FirstMarkers([1, 2], np.round(true[:2])))
        last = tracker.update(image, number)
        assert last.target_id.tolist() == [1, 2, 3, 4, 5] and not last.doubtful.any()
        assert np.abs(last.uv - true).max() < 0.3
    # A wrong exchange is followed as well: what a person states about two markers counts.
    tracker.place(FirstMarkers([1, 2], np.round(meeting(25, True)[1][[1, 0]])))
    image, true = meeting(25, True)
    last = tracker.update(image, 25)
    assert np.abs(last.uv[:2] - true[[1, 0]]).max() < 0.3


def test_markers_are_found_again_after_images_without_any():
    ids, images = sequence()
    tracker = MarkerTracker(OPTIONS, first=given('a'))
    dark = np.full((SIZE, SIZE), 700, np.uint16)
    for number, of in enumerate(images, 1):
        gone = 8 <= number < 14
        found = tracker.update(dark if gone else of['a'].image, number)
        if gone:
            assert not len(found.target_id) and found.finding.kind is Kind.IMAGE_EMPTY
    row = np.searchsorted(ids, found.target_id)
    away = np.linalg.norm(found.uv - images[-1]['a'].uv[row], axis=1)
    assert np.count_nonzero(away < FAR_PX) >= len(ids) - 3
    assert found.doubtful[away > FAR_PX].all()


def test_two_views_live_are_followed_as_in_a_recording():
    """Following begins with the first exposure that shows both views; one may be missing later."""
    _, images = sequence()
    calibrations, orientation = calibration()
    first = {name: given(name) for name in 'ab'}
    bodies = followed_bodies()
    live = MarkerSettings(first, OPTIONS, calibrations, orientation, bodies)()
    views = MarkerViews(calibrations, orientation, OPTIONS, first=first, bodies=bodies)
    alone = live.extract({'a': images[0]['a'].image}, 1)
    assert alone['a'].reason == 'the view of b is missing'
    empty = {name: np.full((SIZE, SIZE), 20000, np.uint16) for name in 'ab'}
    assert live.extract(empty, 1)['a'].reason  # it waits for the markers
    for number, of in enumerate(images[:4], 2):
        seen = {name: image.image for name, image in of.items()}
        if number == 4:
            del seen['b']
        found = live.extract(seen, number, ['a'])
        expected = views.update(seen, number)
        assert set(found) == set(seen)
        for name, result in found.items():
            assert not result.reason
            assert np.array_equal(result.target_id, expected.views[name].target_id)
            assert np.array_equal(result.uv, expected.views[name].uv)
            assert (result.picture is None) == (name == 'b')
    small = live.extract({name: np.zeros((8, 8), np.uint8) for name in 'ab'}, 9)
    assert 'px' in small['a'].reason and not len(small['a'].target_id)


def test_what_cannot_be_followed_is_said():
    ids, images = sequence()
    image = images[0]['a'].image
    tracker = MarkerTracker(first=given('a'))
    with pytest.raises(DataError, match='there was no image yet'):
        tracker.confirm(int(ids[0]))
    with pytest.raises(DataError, match='is empty'):
        tracker.update(np.zeros_like(image), 1)
    tracker.update(image, 1)
    with pytest.raises(DataError, match='image 1 does not come after image 1'):
        tracker.update(image, 1)
    with pytest.raises(DataError, match='there is no marker 7'):
        tracker.exchange(7, int(ids[0]))
    other = tracker.update(image[:, :-8], 2)
    assert 'but the first one is' in other.reason and len(other.missing) == len(given('a').uv)
    assert 'not of 8 or 16 bits' in tracker.update(image.astype(float), 3).reason
    assert tracker.update(None, 4).reason == 'there is no image'
    assert np.isfinite(other.predicted).all()


@pytest.mark.parametrize(
    ('first', 'reason'),
    [
        (([], np.zeros((0, 2))), 'has no markers'),
        (([1, 1], np.ones((2, 2))), 'marker 1 occurs twice'),
        (
            ([1, 2], np.array([[5, 5], [np.nan, 5]])),
            'marker 2 of the first frame has no image point',
        ),
        (([1], np.ones((2, 2))), 'image points of shape'),
    ],
)
def test_a_wrong_first_frame_is_refused(first, reason):
    with pytest.raises(DataError, match=reason):
        FirstMarkers(np.array(first[0]), first[1])


def test_a_first_image_without_the_markers_is_refused():
    image = sequence()[1][0]['a'].image
    rng = np.random.default_rng(0)
    plain = np.clip(rng.normal(30000, 600, image.shape), 0, 65535).astype(np.uint16)
    with pytest.raises(DataError, match='no round shadow where the markers are expected'):
        MarkerTracker(first=given('a')).update(plain, 1)
    far = FirstMarkers(np.array([1]), np.array([[SIZE + 9.0, 20.0]]))
    with pytest.raises(DataError, match='lies outside of the image'):
        MarkerTracker(first=far).update(image, 1)


def test_decisions_change_earlier_images():
    found = followed('a')[3]
    one, two = map(int, found.target_id[:2])
    uv = {int(i): place for i, place in zip(found.target_id, found.uv)}
    changed = revise(found, Decision('exchanged', 'a', 9, 2, (one, two)))
    assert changed.uv[changed.target_id == one].tolist() == [uv[two].tolist()]
    assert changed.doubtful[np.isin(changed.target_id, (one, two))].all()
    dropped = revise(found, Decision('dropped', 'a', 9, 2, (one,)))
    assert one not in dropped.target_id and one in dropped.missing


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Write ten images of both fluoroscopes, markers of the second, and the calibration."""
    ids, images = sequence()
    for name in 'ab':
        (tmp_path / 'images' / name).mkdir(parents=True)
        for number, of in enumerate(images[:10], 11):
            path = tmp_path / 'images' / name / f'trial_{number:03d}.png'
            cv2.imwrite(str(path), of[name].image)
    with open(tmp_path / 'first.csv', 'w') as file:
        file.write('fluoroscope,exposure,target_id,u,v\n')
        for name in 'ab':
            of = images[1][name]
            for target, (u, v) in zip(ids[of.seen], of.uv[of.seen]):
                file.write(f'{name},12,{target},{u:.1f},{v:.1f}\n')
    calibrations, orientation = calibration()
    (tmp_path / 'result').mkdir()
    for each in calibrations.values():
        save_calibration(tmp_path / 'result', each)
    save_orientation(tmp_path / 'result', orientation)
    return tmp_path


@pytest.mark.parametrize('names', ['a', 'a,b'])
def test_markers_enter_a_recording_where_they_are_given_first(folder, names):
    """They are followed in later exposures and in both views, although no body predicts them."""
    ids, images = sequence()
    late = int(ids[2])
    with open(folder / 'first.csv', newline='') as file:
        rows = [row for row in csv.DictReader(file) if int(row['target_id']) != late]
    for name in 'ab':
        u, v = images[4][name].uv[2]
        row = (name, 15, late, f'{u:.0f}', f'{v:.0f}')
        rows.append(dict(zip(rows[0], row)))
    with open(folder / 'first.csv', 'w', newline='') as file:
        writer = csv.DictWriter(file, rows[0])
        writer.writeheader()
        writer.writerows(rows)
    source = folder / 'images' if ',' in names else folder / 'images' / 'a'
    words = ['extract', source, '--markers', folder / 'first.csv', '--shutter', 0.4]
    words += ['--fluoroscope', names, '--out', folder / 'out.csv']
    assert run(*words, *(('--calibration', folder / 'result') if ',' in names else ())) == 0
    with open(folder / 'out.csv', newline='') as file:
        found = [row for row in csv.DictReader(file) if int(row['target_id']) == late]
    for name in names.split(','):
        of_view = [row for row in found if row['fluoroscope'] == name]
        assert min(int(row['exposure']) for row in of_view) == 15 and len(of_view) >= 4
        for row in of_view:
            true = images[int(row['exposure']) - 11][name].uv[2]
            away = np.hypot(float(row['u']) - true[0], float(row['v']) - true[1])
            assert away < FAR_PX or row['doubtful'] == '1'


@pytest.mark.long
def test_the_command_follows_markers_of_one_and_of_two_fluoroscopes(folder, capsys):
    ids, images = sequence()
    words = ['extract', folder / 'images', '--markers', folder / 'first.csv', '--json']
    words += ['--calibration', folder / 'result', '--fluoroscope', 'a,b', '--shutter', 0.4]
    words += ['--overlay', folder / 'pictures', '--out', folder / 'both.csv']
    words += ['--cluster', 'one: ' + ' '.join(map(str, ids[:4]))]
    assert run(*words) == 0
    document = json.loads(capsys.readouterr().out)
    assert document['fluoroscopes']['b']['images'] == 9
    assert {'doubtful_ids', 'decisions'} <= set(document)
    with open(folder / 'both.csv', newline='') as file:
        rows = list(csv.DictReader(file))
    assert {row['exposure'] for row in rows} == {str(number) for number in range(12, 21)}
    for row in rows:
        true = images[int(row['exposure']) - 11][row['fluoroscope']].uv[
            int(row['target_id']) - ids[0]
        ]
        error = np.hypot(float(row['u']) - true[0], float(row['v']) - true[1])
        assert error < FAR_PX or row['doubtful'] == '1'
    assert len(list((folder / 'pictures').glob('*.png'))) == 18
    write_phantom(
        folder / 'shapes.csv',
        Phantom(ids, MovingMarkers(SCENE, SEED).local_mm, np.full(len(ids), 0.05)),
    )
    words[2:4] = ['--cluster', 'two: ' + ' '.join(map(str, ids[4:]))]
    assert run(*words, '--cluster-shapes', folder / 'shapes.csv') == 0
    document = json.loads(capsys.readouterr().out)
    assert document['fluoroscopes']['b']['images'] >= 6
    with open(folder / 'both.csv', newline='') as file:
        again = {
            (r['fluoroscope'], r['exposure'], r['target_id']): r for r in csv.DictReader(file)
        }
    same = [
        abs(float(row['u']) - float(again[key]['u'])) < FAR_PX
        for row in rows
        if (key := (row['fluoroscope'], row['exposure'], row['target_id'])) in again
    ]
    assert len(same) > 0.5 * len(rows) and all(same)
    write_bodies(folder / 'bodies.csv', known_bodies())
    words = ['extract', folder / 'images', '--bodies', folder / 'bodies.csv', '--json']
    words += ['--calibration', folder / 'result', '--fluoroscope', 'a,b', '--shutter', 0.4]
    assert run(*words, '--out', folder / 'by_shape.csv') == 0
    assert json.loads(capsys.readouterr().out)['fluoroscopes']['b']['images'] == 10
    with open(folder / 'by_shape.csv', newline='') as file:
        rows = list(csv.DictReader(file))
    for row in rows:
        of = images[int(row['exposure']) - 11][row['fluoroscope']]
        true = of.uv[int(row['target_id']) - ids[0]]
        error = np.hypot(float(row['u']) - true[0], float(row['v']) - true[1])
        assert error < FAR_PX or row['doubtful'] == '1'
    assert len(rows) > 0.9 * sum(int(of[n].seen.sum()) for of in images[:10] for n in 'ab')
    alone = ['extract', folder / 'images' / 'a', '--markers', folder / 'first.csv']
    assert run(*alone, '--fluoroscope', 'a', '--out', folder / 'a.csv') == 0
    assert 'fluoroscope a: 9 images' in capsys.readouterr().out


def test_the_command_refuses_what_does_not_fit(folder, capsys):
    def said(*words: object) -> str:
        assert run('extract', folder / 'images', *words, '--out', folder / 'x.csv') in (1, 2)
        return capsys.readouterr().err

    assert 'give --phantom' in said('--fluoroscope', 'a')
    markers = ('--markers', folder / 'first.csv')
    assert 'need their --calibration' in said(*markers, '--fluoroscope', 'a,b')
    bodies = ('--bodies', folder / 'bodies.csv')
    assert 'bodies need two fluoroscopes or more' in said(*markers, *bodies, '--fluoroscope', 'a')
    assert 'as --cluster does' in said(*bodies, '--cluster', 'one: 1 2', '--fluoroscope', 'a,b')
    write_bodies(folder / 'bodies.csv', followed_bodies())
    two = ('--fluoroscope', 'a,b', '--calibration', folder / 'result')
    assert 'no given markers' in said(*bodies, *two)
    (folder / 'first.csv').write_text('fluoroscope,exposure,target_id,u,v\na,99,1,50,50\n')
    one = ('--fluoroscope', 'a')
    assert run('extract', folder / 'images' / 'a', *markers, *one, '--out', folder / 'x.csv') == 1
    assert 'no image of it' in capsys.readouterr().err
    assert not (folder / 'x.csv').exists()


def test_pictures_show_ids_and_doubts():
    found = followed('a')[5]
    image = sequence()[1][5]['a'].image
    picture = draw_markers(
        image,
        replace(found, finding=Finding(Kind.NO_MARKERS, 'why')),
        {int(found.target_id[0]): 'm1'},
    )
    assert picture.shape[1] == 2 * SIZE and picture.dtype == np.uint8


# ---- a correction that depends on the angle of the C-arm

TURNED = 20  # number of exposures
DOUBTING = replace(OPTIONS, margin=200.0)  # so wide that there are doubts to decide
JOINT = {'a': 1.0, 'b': -1.0}  # the arms turn in opposite directions


def angle_at(name: str, number: int) -> float:
    """Return the angle of the C-arm of a fluoroscope in an exposure [rad]."""
    return JOINT[name] * (0.4 + 0.02 * number)


@cache
def turning() -> dict[str, FluoroscopeCalibration]:
    """Return the calibrations, with a correction that changes by some px with the angle."""
    calibrations, _ = calibration()
    return {name: rigs.turning(each, size_px=6.0) for name, each in calibrations.items()}


@cache
def turning_orientation() -> RigOrientation:
    _, orientation = calibration()
    ids = tuple(turning()[name].calibration_id for name in orientation.fluoroscopes)
    return replace(orientation, calibration_ids=ids)


@cache
def turned_images() -> tuple[dict[str, np.ndarray], ...]:
    """Return the images of the first exposures, distorted as at the angles of their C-arms."""
    out = []
    for number, of in enumerate(sequence()[1][:TURNED], 1):
        distorted = {}
        for name, image in of.items():
            v, u = np.indices((SIZE, SIZE)).reshape(2, -1)
            field = turning()[name].angle_field
            change, _ = field.change(np.column_stack([u, v]), angle_at(name, number))
            place = (np.column_stack([u, v]) - change).astype(np.float32).reshape(SIZE, SIZE, 2)
            distorted[name] = cv2.remap(
                image.image, place, None, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE
            )
        out.append(distorted)
    return tuple(out)


def displaced(name: str, number: int, uv: np.ndarray) -> np.ndarray:
    """Return the pixels at which true image points (k, 2) of an exposure appear at its angle."""
    seen = uv
    for _ in range(20):
        seen = uv + turning()[name].angle_field.change(seen, angle_at(name, number))[0]
    return seen


def turned_first() -> dict[str, FirstMarkers]:
    return {
        name: FirstMarkers(given(name).target_id, displaced(name, 1, given(name).uv))
        for name in 'ab'
    }


def angles_of_exposure(number: int) -> dict[str, float | None]:
    return {name: angle_at(name, number) for name in 'ab'}


def followed_while_turning(known: bool) -> list[ViewsFrame]:
    views = MarkerViews(
        turning(),
        turning_orientation(),
        DOUBTING,
        first=turned_first(),
        bodies=followed_bodies(),
    )
    return [
        views.update(dict(images), number, angles_of_exposure(number) if known else None)
        for number, images in enumerate(turned_images(), 1)
    ]


def decided(frames: Iterable[ViewsFrame]) -> list[tuple[str, str, tuple[int, ...]]]:
    return [(d.kind, d.fluoroscope, d.target_id) for of in frames for d in of.decisions]


@pytest.mark.long
def test_doubts_are_decided_at_the_angles_of_the_arms_as_without_distortion():
    """With the mean over the angles, whose deviation is larger, there are no other decisions."""
    assert np.abs(displaced('b', 1, given('b').uv) - given('b').uv).max() > 5
    straight = decided(followed_in_both(DOUBTING)[:TURNED])
    at_angle = decided(followed_while_turning(True))
    assert straight and set(straight) <= set(at_angle)
    assert {kind for kind, *_ in at_angle} == {'confirmed'}
    by_mean = followed_while_turning(False)
    assert set(decided(by_mean)) <= set(at_angle)
    ids, images = sequence()
    for number, (found, of) in enumerate(zip(by_mean, images), 1):
        for name, view in found.views.items():
            true = displaced(name, number, of[name].uv)[np.searchsorted(ids, view.target_id)]
            assert (np.linalg.norm(view.uv - true, axis=1) < FAR_PX)[~view.doubtful].all()


def test_points_are_projected_to_where_they_are_seen_at_an_angle():
    xyz = np.random.default_rng(1).uniform(-10, 10, (20, 3))
    for view, name in enumerate('ab'):
        each = turning()[name]
        ideal = CalibratedRig(turning_orientation(), calibration()[0], {}).project(view, xyz)
        seen = CalibratedRig(turning_orientation(), turning(), {name: 0.7}).project(view, xyz)
        assert np.abs(seen - ideal).max() > 1
        assert np.abs(each.correct(seen, angle=0.7).uv - ideal).max() < 0.01


def known_bodies() -> tuple[Body, ...]:
    ids, _ = sequence()
    local = MovingMarkers(SCENE, SEED).local_mm
    sd = np.full(4, 0.05)
    return Body('one', ids[:4], local[:4], sd), Body('two', ids[4:], local[4:], sd)


def test_markers_are_identified_by_their_shapes_at_the_angles_of_the_arms():
    images = dict(turned_images()[1])
    arguments = (images, turning(), turning_orientation(), known_bodies())
    with pytest.raises(DataError, match='markers fit its shape'):
        identify_markers(*arguments)
    found = identify_markers(*arguments, angles_of_exposure(2))
    ids, true = sequence()
    for name in 'ab':
        rows = np.searchsorted(ids, found[name].target_id)
        away = found[name].uv - displaced(name, 2, true[1][name].uv)[rows]
        assert len(rows) == 8
        assert np.median(np.linalg.norm(away, axis=1)) < 1.0


@pytest.mark.parametrize('seed', range(6))
def test_a_body_is_found_among_other_shadows_in_any_pose_and_not_where_it_is_absent(seed):
    """With shadows of 40 other points in each view, the ids are right or there are none."""
    rng = np.random.default_rng(seed)
    calibrations, orientation = calibration()
    body = Body('bone', np.arange(11, 16), rng.uniform(-9, 9, (5, 3)), np.full(5, 0.03))
    turned = body.xyz_mm @ matrix_from_vector(rng.normal(0, 2, 3)).T + rng.uniform(-5, 5, 3)
    xyz = np.concatenate([turned, rng.uniform(-25, 25, (40, 3))])
    views = [f.ideal(xyz) + rng.normal(0, 0.1, (45, 2)) for f in rig().fluoroscopes]
    seen = CalibratedRig(orientation, calibrations, {})
    found, missing = find_bodies(views, seen, [body])
    assert not missing
    for name, uv in zip('ab', views):
        assert np.abs(found[name].uv - uv[:5]).max() < 1.0
    found, missing = find_bodies([uv[5:] for uv in views], seen, [body])
    assert not found and len(missing) == 1
    found, missing = find_bodies([views[0], views[1][:0]], seen, [body])
    assert not found and len(missing) == 1


def drawn(places: Sequence[tuple[np.ndarray, float]], size: int) -> np.ndarray:
    """Return an image of blurred dark discs of places (k, 2) and a radius [px]."""
    fine = 4
    light = np.full((size * fine, size * fine), 180, np.uint8)
    for uv, radius in places:
        for u, v in (uv + 0.5) * fine - 0.5:
            cv2.circle(light, (round(u), round(v)), round(radius * fine), 80, -1)
    image = cv2.resize(cv2.GaussianBlur(light, (0, 0), 0.8 * fine), (size, size))
    noise = np.random.default_rng(5).normal(0, 1, image.shape)
    return np.clip(np.rint(image + noise), 0, 255).astype(np.uint8)


def test_bodies_with_markers_of_different_sizes_are_found_together():
    """No single size shows all shadows: while a body is missing, other sizes are tried."""
    rng = np.random.default_rng(2477)  # no two markers are within 9 px in a view
    shapes = [rng.uniform(-12, 12, (6, 3)) for _ in range(2)]
    bodies = [
        Body(name, np.arange(first, first + 6), xyz, np.full(6, 0.03))
        for name, first, xyz in zip(('small', 'large'), (11, 21), shapes)
    ]
    calibrations, orientation = calibration()
    places = {f.name: [f.ideal(xyz) for xyz in shapes] for f in rig().fluoroscopes}
    images = {
        name: drawn([(uv[0], 1.2), (uv[1], 3.2)], calibrations[name].image_size[0])
        for name, uv in places.items()
    }
    found = identify_markers(images, calibrations, orientation, bodies)
    for name, uv in places.items():
        assert found[name].target_id.tolist() == [*range(11, 17), *range(21, 27)]
        assert np.abs(found[name].uv - np.concatenate(uv)).max() < 1.0


def test_a_body_is_found_in_images_with_white_labels():
    """Letters look like bright markers, and the gaps between them like dark ones."""
    xyz = np.random.default_rng(2478).uniform(-12, 12, (6, 3))
    body = Body('bone', np.arange(11, 17), xyz, np.full(6, 0.03))
    calibrations, orientation = calibration()
    places = {f.name: f.ideal(xyz) for f in rig().fluoroscopes}
    images = {}
    for name, uv in places.items():
        image = drawn([(uv, 1.2)], SIZE)
        for row, text in ((24, 'PATIENT 4711'), (SIZE - 12, 'L 70 kV 12:30')):
            cv2.putText(image, text, (6, row), cv2.FONT_HERSHEY_SIMPLEX, 0.8, 255, 2, cv2.LINE_AA)
        images[name] = image
    found = identify_markers(images, calibrations, orientation, [body])
    for name, uv in places.items():
        assert found[name].target_id.tolist() == list(range(11, 17))
        assert np.abs(found[name].uv - uv).max() < 1.0


def test_bodies_that_an_impact_moves_are_found_again_and_no_wrong_id_is_left():
    """Both bodies move by 20 px between two images; afterwards a view misses an image."""
    rng = np.random.default_rng(2477)
    shapes = [rng.uniform(-12, 12, (6, 3)) for _ in range(2)]
    bodies = [
        Body(name, np.arange(first, first + 6), xyz, np.full(6, 0.03))
        for name, first, xyz in zip(('one', 'other'), (11, 21), shapes)
    ]
    ids = np.concatenate([body.target_id for body in bodies])
    calibrations, orientation = calibration()
    ways = np.array([[5.0, 3.0, 6.0], [-6.0, 2.0, -5.0]])  # [mm], in the first exposure

    def true(number: int) -> dict[str, np.ndarray]:
        moved = 2 * (1 - 0.5 ** max(number - 4, 0))
        xyz = np.concatenate([shape + moved * way for shape, way in zip(shapes, ways)])
        return {f.name: f.ideal(xyz) for f in rig().fluoroscopes}

    views: MarkerViews | None = None
    found = []
    for number in range(1, 13):
        images = {
            name: drawn([(uv, 1.2)], calibrations[name].image_size[0])
            for name, uv in true(number).items()
        }
        if views is None:
            first = identify_markers(images, calibrations, orientation, bodies)
            views = MarkerViews(calibrations, orientation, OPTIONS, first=first, bodies=bodies)
        found.append(views.update({**images, 'b': None} if number == 7 else images, number))
    for number, exposure in enumerate(found, 1):
        for name, of_view in exposure.views.items():
            uv = true(number)[name][np.searchsorted(ids, of_view.target_id)]
            right = np.linalg.norm(of_view.uv - uv, axis=1) < 1.5
            assert right[~of_view.doubtful].all()
            if number < 5 or number > 7:
                assert np.count_nonzero(right) == 12
                assert np.count_nonzero(of_view.doubtful) < 4


def without_second_body(images: dict[str, MarkerImage]) -> dict[str, np.ndarray]:
    """Return the images of an exposure without the markers of the second body."""
    return {name: covered(of, np.s_[4:]) for name, of in images.items()}


@pytest.mark.parametrize('covered_until', [0, 6])
def test_bodies_are_found_by_their_shapes_and_join_when_they_appear(covered_until):
    """No markers are given; a body that is not in the first exposures is followed later."""
    ids, images = sequence()
    calibrations, orientation = calibration()
    settings = MarkerSettings(
        {}, replace(OPTIONS, search_every=3), calibrations, orientation, known_bodies()
    )
    follower = settings()
    empty = {name: np.full((SIZE, SIZE), 20000, np.uint16) for name in 'ab'}
    assert all(found.reason for found in follower.extract(empty, 1).values())
    right = np.zeros((FRAMES, 2), dtype=int)
    for number, of in enumerate(images, 2):
        hidden = number < 2 + covered_until
        shown = without_second_body(of) if hidden else {n: each.image for n, each in of.items()}
        for name, found in follower.extract(shown, number).items():
            assert not found.reason
            row = np.searchsorted(ids, found.target_id)
            away = np.linalg.norm(found.uv - of[name].uv[row], axis=1)
            right[number - 2] += [np.sum((away < FAR_PX) & part) for part in (row < 4, row >= 4)]
            assert (away > FAR_PX).sum() <= found.doubtful
    assert (right[:covered_until, 1] == 0).all()
    later = covered_until + 5
    seen = sum(int(of[name].seen.sum()) for of in images[later:] for name in 'ab')
    assert right[later:].sum() > 0.9 * seen


def test_a_body_is_found_again_where_it_comes_back():
    """Both views lose it for a third of the recording, during which it moves far."""
    ids, images = sequence()
    calibrations, orientation = calibration()
    first = {name: given(name) for name in 'ab'}
    options = replace(OPTIONS, search_every=3)
    views = MarkerViews(calibrations, orientation, options, first=first, bodies=known_bodies())
    found = 0
    for number, of in enumerate(images, 1):
        hidden = 6 <= number < 14
        shown = without_second_body(of) if hidden else {n: each.image for n, each in of.items()}
        result = views.update(shown, number)
        for name, view in result.views.items():
            row = np.searchsorted(ids, view.target_id)
            away = np.linalg.norm(view.uv - of[name].uv[row], axis=1)
            assert not ((away > FAR_PX) & ~view.doubtful).any()
            if number > 18:
                found += int(((away < FAR_PX) & (row >= 4)).sum())
    seen = sum(int(o.seen[4:].sum()) for of in images[18:] for o in of.values())
    assert found > 0.9 * seen


def test_markers_of_no_body_are_followed():
    ids, images = sequence()
    calibrations, orientation = calibration()
    first = {name: given(name) for name in 'ab'}
    views = MarkerViews(calibrations, orientation, OPTIONS, first=first, bodies=known_bodies()[:1])
    for number, of in enumerate(images, 1):
        result = views.update({n: each.image for n, each in of.items()}, number)
    for name, view in result.views.items():
        away = np.linalg.norm(
            view.uv - images[-1][name].uv[np.searchsorted(ids, view.target_id)], axis=1
        )
        assert not ((away > FAR_PX) & ~view.doubtful).any()
        assert np.isin(ids[4:], view.target_id).sum() >= 3


def save_turning(folder: Path) -> None:
    """Write a result folder of fluoroscopes whose corrections depend on the angle."""
    folder.mkdir()
    for each in turning().values():
        save_calibration(folder, each)
    save_orientation(folder, turning_orientation())


def write_turned_first(path: Path) -> None:
    """Write the markers of the first exposure."""
    with open(path, 'w') as file:
        file.write('fluoroscope,exposure,target_id,u,v\n')
        for name, first in turned_first().items():
            for target, (u, v) in zip(first.target_id, first.uv):
                file.write(f'{name},1,{target},{u:.6f},{v:.6f}\n')


@pytest.mark.long
def test_command_follows_markers_at_the_angles_of_a_bag(tmp_path, capsys, monkeypatch):
    """The table that it writes also has the angles; without them, a note says so."""
    time = message_class('builtin_interfaces/msg/Time')
    header = message_class('std_msgs/msg/Header')
    with BagWriter(tmp_path / 'bag') as bag:
        for number, images in enumerate(turned_images(), 1):
            state = message_class(JOINT_STATE)(
                header(time(number, 0), ''),
                ['frontal', 'lateral'],
                np.array([angle_at(name, number) for name in 'ab']),
                np.zeros(0),
                np.zeros(0),
            )
            bag.write('/joint_states', JOINT_STATE, state, number * 10**9)
            for name, image in images.items():
                message = message_class(COMPRESSED_IMAGE)(
                    header(time(number, 1000), name),
                    'png',
                    np.frombuffer(encode(image, '.png'), np.uint8),
                )
                topic = f'/{name}/image_raw/compressed'
                bag.write(topic, COMPRESSED_IMAGE, message, number * 10**9)
    monkeypatch.setattr(
        'fluoro_calib_ros.images.marker_watch.doubtful_pairs',
        lambda *given: doubtful_pairs(*given[:-1], DOUBTING.margin),
    )
    save_turning(tmp_path / 'result')
    write_turned_first(tmp_path / 'first.csv')
    words = ['extract', tmp_path / 'bag', '--markers', tmp_path / 'first.csv', '--json']
    words += ['--calibration', tmp_path / 'result', '--fluoroscope', 'a,b', '--shutter', 0.4]
    for body in followed_bodies():
        words += ['--cluster', f'{body.name}: ' + ' '.join(map(str, body.target_id))]
    words += ['--out', tmp_path / 'both.csv']
    joints = ['--angle-joint', 'a:frontal,b:lateral']

    def decisions(*more):
        assert run(*words, *more) == 0
        printed = capsys.readouterr()
        found = json.loads(printed.out)['decisions']
        return [(d['kind'], d['fluoroscope'], tuple(d['target_id'])) for d in found], printed.err

    at_angle, said = decisions(*joints)
    assert at_angle and {kind for kind, *_ in at_angle} == {'confirmed'}
    assert 'depends on the angle' not in said
    with open(tmp_path / 'both.csv', newline='') as file:
        for row in csv.DictReader(file):
            angle = angle_at(row['fluoroscope'], int(row['exposure']))
            assert float(row['angle_deg']) == pytest.approx(np.degrees(angle), abs=1e-5)
    by_mean, said = decisions()
    assert set(by_mean) <= set(at_angle)
    assert (
        'the correction of fluoroscope a depends on the angle of the C-arm, which is unknown for '
        '20 of 20 images: markers are predicted by the mean' in said
    )
