# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""fluoro-calib extract: images to observations, from files to a table."""

from __future__ import annotations

import csv
import json
import os
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest

import fluoro_calib_ros as fc
from benchmarks.bead_images import bead_image
from fluoro_calib_ros.cli import main
from fluoro_calib_ros.errors import DataError
from fluoro_calib_ros.exposures.angles import AngleOptions
from fluoro_calib_ros.exposures.phantom import Phantom
from fluoro_calib_ros.images.codec import encode
from fluoro_calib_ros.io.bags.metadata import message_class, to_cdr
from fluoro_calib_ros.io.bags.reader import COMPRESSED_IMAGE, IMAGE, JOINT_STATE
from fluoro_calib_ros.io.bags.writer import BagWriter
from fluoro_calib_ros.io.observations import read_observations_csv
from fluoro_calib_ros.io.phantom import read_phantom, write_phantom
from fluoro_calib_ros.jobs.extraction import recording_of_images
from fluoro_calib_ros.jobs.image_sources import (
    ImageAngles,
    contains_images,
    fluoroscope_folders,
    open_sources,
)
from fluoro_calib_ros.jobs.sources import read_survey
from fluoro_calib_ros.photogrammetry.rotations import matrix_from_vector

pytestmark = pytest.mark.long

SIZE = 400
COUNT = 60


@cache
def beads() -> np.ndarray:
    return np.random.default_rng(5).uniform(-60, 60, (COUNT, 3))


@cache
def picture(number: int, dtype: type = np.uint8) -> tuple[np.ndarray, np.ndarray]:
    """Return an image from a renderer other than that of the benchmark, and the true centres."""
    rotation = matrix_from_vector([0.3 * number, 0.2, -0.1 * number])
    x = beads() @ rotation.T + (0, 0, 900)
    uv = 1600 * x[:, :2] / x[:, 2:] + (SIZE - 1) / 2
    return bead_image(uv, (SIZE, SIZE), dtype, 2.0, 0.6, 0.01, number), uv


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    write_phantom(
        tmp_path / 'phantom.csv', Phantom(np.arange(COUNT) + 1, beads(), np.full(60, 0.1))
    )
    (tmp_path / 'a').mkdir()
    for number in (1, 2, 3):
        cv2.imwrite(str(tmp_path / 'a' / f'image_{number:04d}.png'), picture(number)[0])
    return tmp_path


def extract(folder: Path, source: str, *more: str) -> None:
    main(
        [
            'extract',
            str(folder / source),
            '--phantom',
            str(folder / 'phantom.csv'),
            '--fluoroscopes',
            'a',
            '--out',
            str(folder / 'out.csv'),
            '--workers',
            '1',
            *more,
        ]
    )


FEW = 30  # number of beads; few enough that all poses are searched in a short time


def few_shown() -> np.ndarray:
    """Return an image of a few of the beads."""
    return bead_image(picture(1)[1][:FEW], (SIZE, SIZE), np.uint8, 2.0, 0.6, 0.01, 1)


def few(xyz_mm: np.ndarray) -> Phantom:
    return Phantom(np.arange(FEW) + 1, xyz_mm[:FEW], np.full(FEW, 0.1))


def shown_once(folder: Path, image: np.ndarray) -> None:
    """Write the image as the first one; the other two show no shadows and are refused at once."""
    cv2.imwrite(str(folder / 'a' / 'image_0001.png'), np.ascontiguousarray(image))
    for number in (2, 3):
        cv2.imwrite(str(folder / 'a' / f'image_{number:04d}.png'), np.full_like(image, 200))


@pytest.mark.parametrize('turn', [np.fliplr, np.flipud, np.transpose])
def test_mirrored_images_are_named(folder, turn, capsys):
    write_phantom(folder / 'phantom.csv', few(beads()))
    shown_once(folder, turn(few_shown()))
    with pytest.raises(SystemExit):
        extract(folder, 'a')
    said = capsys.readouterr().err
    assert 'none of 3 images gives observations' in said
    assert 'image_0001.png: the image is mirrored' in said
    assert not (folder / 'out.csv').exists()


def test_images_of_another_phantom_are_not_called_mirrored(folder, capsys):
    other = np.random.default_rng(6).uniform(-60, 60, (COUNT, 3))
    write_phantom(folder / 'phantom.csv', few(other))
    shown_once(folder, few_shown())
    with pytest.raises(SystemExit):
        extract(folder, 'a')
    said = capsys.readouterr().err
    assert 'none of 3 images gives observations' in said and 'mirrored' not in said


def test_a_folder_becomes_a_table_that_calibrate_reads(folder, capsys):
    (folder / 'a' / 'image_0002.png').write_bytes(b'\x89PNG\r\n\x1a\nnothing')
    cv2.imwrite(str(folder / 'a' / 'image_0007.png'), picture(1)[0][:, :300])
    extract(folder, 'a', '--json', '--overlay', str(folder / 'overlay'))
    printed = capsys.readouterr()
    summary = json.loads(printed.out)
    assert [e['exposure'] for e in summary['exposures']] == [1, 2, 3, 7]
    assert [e['observations'] > 40 for e in summary['exposures']] == [True, False, True, False]
    assert 'image_0002.png' in printed.err and 'PNG' in printed.err
    assert '300 x 400 px, but the first one is 400 x 400 px' in printed.err
    with (folder / 'out.csv').open() as file:
        header = next(csv.reader(file))
    assert header == ['fluoroscope', 'exposure', 'target_id', 'u', 'v', 'sigma', 'overlapped']
    frames = read_observations_csv(folder / 'out.csv', (SIZE, SIZE))['a']
    assert [frame.number for frame in frames] == [1, 3]
    for frame in frames:
        error = frame.uv - picture(frame.number)[1][frame.target_id - 1]
        assert np.abs(error).max() < 1.0
        assert np.median(np.abs(error)) < 0.08
        assert frame.sigma is not None and (frame.sigma > 0).all()
    assert sorted(path.name for path in (folder / 'overlay').iterdir())[:2] == [
        'a_0001.png',
        'a_0003.png',
    ]
    # Pictures of results are no radiographs, wherever they are.
    assert list(fluoroscope_folders(folder)) == ['a'] and not contains_images(folder / 'overlay')


def test_a_stack_is_numbered_by_its_order(folder):
    pages = [picture(number, np.uint16)[0] for number in (2, 3)]
    assert cv2.imwritemulti(str(folder / 'stack.tif'), pages)
    extract(folder, 'stack.tif')
    frames = read_observations_csv(folder / 'out.csv', (SIZE, SIZE))['a']
    assert [frame.number for frame in frames] == [1, 2]
    error = frames[0].uv - picture(2)[1][frames[0].target_id - 1]
    assert np.abs(error).max() < 1.0


@pytest.mark.parametrize(
    ('image', 'sentence'),
    [
        (np.zeros((SIZE, SIZE), np.uint8), 'the image is empty'),
        (np.zeros((1, 1), np.uint8), 'only 1 x 1 px'),
        (bead_image([[200, 200]], (SIZE, SIZE), noise=0.01), 'at least 10 are needed'),
    ],
)
def test_images_without_the_phantom_give_one_sentence(folder, capsys, image, sentence):
    cv2.imwrite(str(folder / 'bad.png'), image)
    (folder / 'out.csv').write_text('earlier')
    with pytest.raises(SystemExit) as ended:
        extract(folder, 'bad.png')
    assert ended.value.code == 1
    printed = capsys.readouterr().err
    assert sentence in printed and 'bad.png' in printed and printed.count('\n') == 1
    assert (folder / 'out.csv').read_text() == 'earlier'


def moved(frame: int) -> tuple[np.ndarray, np.ndarray]:
    """Return a frame of a video of a phantom that turns and shifts, and the true centres."""
    rotation = matrix_from_vector([0.3, 0.2 + 0.01 * frame, -0.1])
    x = beads() @ rotation.T + (2.0 * frame - 10, 0, 900)
    uv = 1600 * x[:, :2] / x[:, 2:] + (SIZE - 1) / 2
    return bead_image(uv, (SIZE, SIZE), np.uint8, 2.0, 0.6, 0.01, frame), uv


def test_a_phantom_is_followed_through_a_video(folder, capsys):
    path = folder / 'video.avi'
    codec = cv2.VideoWriter_fourcc(*'FFV1')
    video = cv2.VideoWriter(str(path), codec, 30.0, (SIZE, SIZE), isColor=False)
    for frame in range(13):
        video.write(moved(frame)[0])
    video.release()
    extract(folder, 'video.avi', '--json')
    exposures = json.loads(capsys.readouterr().out)['exposures']
    assert [e['followed'] for e in exposures] == [n not in (0, 12) for n in range(13)]
    frames = read_observations_csv(folder / 'out.csv', (SIZE, SIZE))['a']
    assert [frame.number for frame in frames] == list(range(1, 14))
    for frame in frames:
        error = frame.uv - moved(frame.number - 1)[1][frame.target_id - 1]
        assert np.abs(error).max() < 1.0 and len(error) > 40


@pytest.mark.parametrize('shift_mm', [60.0, 95.0, 130.0])
def test_a_phantom_partly_out_of_view_gives_no_wrong_observation(folder, shift_mm):
    x = beads() @ matrix_from_vector([0.4, -0.3, 0.2]).T + (shift_mm, 30.0, 900)
    uv = 1600 * x[:, :2] / x[:, 2:] + (SIZE - 1) / 2
    cv2.imwrite(str(folder / 'half.png'), bead_image(uv, (SIZE, SIZE), np.uint8, 2.0, 0.6, 0.01))
    inside = ((uv > 8) & (uv < SIZE - 8)).all(axis=1)
    try:
        extract(folder, 'half.png')
    except SystemExit:
        assert inside.sum() < 30
        return
    (frame,) = read_observations_csv(folder / 'out.csv', (SIZE, SIZE))['a']
    assert np.abs(frame.uv - uv[frame.target_id - 1]).max() < 1.0
    assert len(frame.uv) > 0.7 * inside.sum()


def test_a_wrong_principal_distance_gives_no_wrong_observation(folder):
    extract(folder, 'a', '--principal-distance', '1760')
    for frame in read_observations_csv(folder / 'out.csv', (SIZE, SIZE))['a']:
        error = frame.uv - picture(frame.number)[1][frame.target_id - 1]
        assert np.abs(error).max() < 1.0
        assert len(error) > 40


def test_images_of_one_fluoroscope_need_its_name(folder, capsys):
    with pytest.raises(SystemExit):
        main(
            [
                'calibrate',
                str(folder / 'a'),
                '--phantom',
                str(folder / 'phantom.csv'),
                '--out',
                str(folder / 'result'),
            ]
        )
    assert 'name it with --fluoroscopes NAME' in capsys.readouterr().err


def test_python_calibrates_from_images(folder, tmp_path_factory):
    """The source only has one folder for each fluoroscope; progress is reported by image."""
    images = tmp_path_factory.mktemp('images')
    (folder / 'a').rename(images / 'a')
    for number in (4, 5, 6):
        cv2.imwrite(str(images / 'a' / f'image_{number:04d}.png'), picture(number)[0])
    told = []
    outcome = fc.calibrate(
        images,
        folder / 'phantom.csv',
        fc.CalibrationOptions(model='none'),
        progress=lambda *step: told.append(step),
    )
    assert outcome.result.fluoroscopes['a'].observations > 5 * COUNT
    assert told[:6] == [('image', done, 6) for done in range(1, 7)]
    assert told[6][0].startswith('a: round  1')


def test_diameters_of_a_phantom_are_kept(tmp_path):
    phantom = Phantom(np.arange(4), np.eye(4, 3), np.full(4, 0.1), np.array([2.0, 2.0, 2.0, 3.0]))
    write_phantom(tmp_path / 'phantom.csv', phantom)
    assert np.array_equal(read_phantom(tmp_path / 'phantom.csv').diameter_mm, phantom.diameter_mm)


def test_images_of_a_bag_are_read(folder):
    header = message_class('std_msgs/msg/Header')(
        message_class('builtin_interfaces/msg/Time')(1, 0), 'a_optical'
    )
    wide, uv = picture(1, np.uint16)
    rows = wide.astype('>u2').view(np.uint8).reshape(-1)
    raw = message_class(IMAGE)(
        header=header,
        height=SIZE,
        width=SIZE,
        encoding='mono16',
        is_bigendian=1,
        step=2 * SIZE,
        data=rows,
    )
    packed = message_class(COMPRESSED_IMAGE)(
        header=header,
        format='png',
        data=np.frombuffer(encode(picture(2)[0], '.png'), np.uint8),
    )
    with BagWriter(folder / 'bag') as bag:
        bag.write('/rig/a/image_raw', IMAGE, to_cdr(raw, IMAGE), 10**9)
        bag.write(
            '/rig/b/image_raw/compressed',
            COMPRESSED_IMAGE,
            to_cdr(packed, COMPRESSED_IMAGE),
            2 * 10**9,
        )
    assert contains_images(folder / 'bag')
    sources = open_sources([folder / 'bag'], 'a')
    (found,) = sources.images()
    assert np.array_equal(found.image, wide)
    extract(folder, 'bag')
    (frame,) = read_observations_csv(folder / 'out.csv', (SIZE, SIZE))['a']
    assert np.abs(frame.uv - uv[frame.target_id - 1]).max() < 1.0
    with pytest.raises(DataError, match="fluoroscope 'c', only of a, b"):
        open_sources([folder / 'bag'], 'c')


def test_rendered_markers_are_followed(tmp_path, capsys):
    """`simulate --marker-images` writes the images, first places and truth for `extract`."""
    rig = tmp_path / 'rig'
    options = ('--exposures', '1', '--seconds', '0', '--marker-images', '2')
    assert not main(['simulate', '--out', str(rig), *options])
    command = ['extract', str(rig / 'marker_images' / 'a'), '--fluoroscope', 'a']
    files = ['--markers', str(rig / 'first_markers.csv'), '--out', str(tmp_path / 'out.csv')]
    assert not main([*command, *files, '--json'])
    with open(rig / 'truth' / 'marker_images.csv') as file:
        rows = [row for row in csv.DictReader(file) if row['fluoroscope'] == 'a']
    true = {(row['exposure'], row['target_id']): row for row in rows}
    with open(tmp_path / 'out.csv') as file:
        found = list(csv.DictReader(file))
    seen = sum(row['seen'] == '1' for row in rows)
    assert len(found) > 0.9 * seen > 30
    for row in found:
        truth = true[row['exposure'], row['target_id']]
        assert np.hypot(*(float(row[k]) - float(truth[k]) for k in 'uv')) < 1.0
    clusters = (rig / 'clusters.txt').read_text().splitlines()
    assert clusters[0].startswith('cluster_1: 1001 ')


def image_bag(path: Path, numbers: tuple[int, ...] = (1, 2, 3)) -> Path:
    """Write a bag with images of fluoroscope a, and joint states up to the second image."""
    time = message_class('builtin_interfaces/msg/Time')
    header = message_class('std_msgs/msg/Header')
    with BagWriter(path) as bag:
        for number in numbers:
            data = np.frombuffer(encode(picture(number)[0], '.png'), np.uint8)
            image = message_class(COMPRESSED_IMAGE)(header(time(number, 0), 'a'), 'png', data)
            bag.write('/a/image_raw/compressed', COMPRESSED_IMAGE, image, number * 10**9)
            if number <= 2:
                state = message_class(JOINT_STATE)(
                    header(time(number - 1, 900_000_000), ''),
                    ['carm'],
                    np.array([0.1 * number]),
                    np.zeros(0),
                    np.zeros(0),
                )
                bag.write('/joint_states', JOINT_STATE, state, number * 10**9)
    return path


def angles_in_table(folder: Path) -> list[float | None]:
    frames = read_observations_csv(folder / 'out.csv', (SIZE, SIZE))['a']
    return [None if f.angle is None else round(float(np.degrees(f.angle)), 4) for f in frames]


def test_images_of_a_bag_have_the_angle_of_the_joint(folder, capsys):
    image_bag(folder / 'bag')
    extract(folder, 'bag', '--angle-joint', 'carm')
    assert angles_in_table(folder) == [5.7296, 11.4592, None]
    assert '1 of 3 images have no angle, there is no state of joint carm in the 0.5 s' in (
        capsys.readouterr().err
    )
    extract(folder, 'bag', '--angle-joint', 'carm', '--angle-max-age', '2')
    assert angles_in_table(folder) == [5.7296, 11.4592, 11.4592]
    extract(folder, 'bag')
    assert 'angle_deg' not in (folder / 'out.csv').read_text()
    with pytest.raises(SystemExit):
        extract(folder, 'bag', '--angle-joint', 'a:carm,b:other')
    assert "angle_joint: there is no fluoroscope 'b', only a" in capsys.readouterr().err


def test_images_of_files_have_the_angle_that_is_given(folder, capsys):
    extract(folder, 'a', '--angle-deg', '-35')
    assert angles_in_table(folder) == [-35.0, -35.0, -35.0]
    with pytest.raises(SystemExit):
        extract(folder, 'a', '--angle-joint', 'carm')
    assert 'the angle of a joint needs a bag, these images have no times' in (
        capsys.readouterr().err
    )


def test_calibrate_takes_the_angles_of_images_in_a_bag(folder, monkeypatch):
    monkeypatch.setattr(os, 'cpu_count', lambda: 1)  # search the images in this process
    bag = image_bag(folder / 'bag')
    survey = read_survey(folder / 'phantom.csv')
    angles = ImageAngles(AngleOptions('carm', 5.0))
    recording = recording_of_images(bag, survey, angles=angles)
    assert [f.angle for f in recording.frames['a']] == pytest.approx([0.1, 0.2, 0.2], abs=1e-8)
    words = ['calibrate', str(bag), '--phantom', str(folder / 'phantom.csv'), '--model', 'none']
    words += ['--out', str(folder / 'result'), '--fast', '--angle-max-age', '5', '--angle-joint']
    main([*words, 'carm'])
    (folder / 'out.csv').write_bytes((folder / 'result' / 'observations.csv').read_bytes())
    assert angles_in_table(folder) == [5.7296, 11.4592, 11.4592]
    kept = sorted((folder / 'result' / 'radiographs').iterdir())
    assert [path.name for path in kept] == ['a_1.jpg', 'a_2.jpg', 'a_3.jpg']
    shown = cv2.imread(str(kept[0]), cv2.IMREAD_GRAYSCALE)
    assert shown.shape == (SIZE, SIZE) and shown.std() > 10
    with pytest.raises(SystemExit):
        main([*words, 'table'])


def test_files_without_ending_have_the_numbers_of_their_names(folder):
    for number in (1, 2, 3):
        path = folder / 'a' / f'image_{number:04d}.png'
        path.rename(folder / 'a' / f'1.2.840.{10 * number}')
    (folder / 'a' / 'notes').write_text('of the operator')
    extract(folder, 'a')
    frames = read_observations_csv(folder / 'out.csv', (SIZE, SIZE))['a']
    assert [frame.number for frame in frames] == [10, 20, 30]
