# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""fluoro-calib correct for images: files, stacks, folders and videos, and invalid input."""

import io
import json
import os
import struct
import sys
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import numpy as np
import pytest
import rigs
from dicom_files import dicom

from benchmarks.bead_images import bead_image
from fluoro_calib_ros.errors import DataError
from fluoro_calib_ros.images.angle_maps import AngleMaps
from fluoro_calib_ros.images.codec import decode, encode
from fluoro_calib_ros.images.corrector import ImageCorrector
from fluoro_calib_ros.io import image_reading as tiff
from fluoro_calib_ros.io.calibration import save_calibration
from fluoro_calib_ros.io.image_reading import IMAGE_SUFFIXES, SUPPORTS_16_BIT_VIDEOS, ImageSource
from fluoro_calib_ros.io.image_writing import (
    correct_images,
    folder_like,
    list_images,
    write_images,
    write_video,
)

SIZE = (128, 96)
BEADS = [[30.2, 20.9], [60.5, 50.1], [100.0, 80.4], [20.3, 75.7]]
LOSSLESS = [e for e in IMAGE_SUFFIXES if e not in ('.jpg', '.jpeg')]


def image_of(number=0, dtype=np.uint8):
    """Return an image of beads that move from frame to frame."""
    return bead_image(np.add(BEADS, number), SIZE, dtype, seed=number)


def stack_of(count, dtype=np.uint8):
    return [image_of(n, dtype) for n in range(count)]


def a_calibration(name):
    """Return a calibration for small images."""
    return rigs.smooth_pincushion(name, SIZE)


@pytest.fixture(scope='module')
def corrector():
    return ImageCorrector(a_calibration('a'))


@pytest.fixture(scope='module')
def one(tmp_path_factory):
    """Folder with the calibration of one fluoroscope."""
    folder = tmp_path_factory.mktemp('one')
    save_calibration(folder, a_calibration('a'))
    return folder


@pytest.fixture(scope='module')
def both(tmp_path_factory):
    """Folder with the calibrations of two fluoroscopes."""
    folder = tmp_path_factory.mktemp('both')
    for name in 'ab':
        save_calibration(folder, a_calibration(name))
    return folder


OLD_OPENCV = not SUPPORTS_16_BIT_VIDEOS  # OpenCV before 4.7


def correct(source, calibration, out, *more):
    return rigs.run('correct', source, '--calibration', calibration, '--out', out, *more)


def video_of(path, images, rate=29.97, codec='FFV1', colour=False):
    """Write a video."""
    depth = [] if images[0].dtype == np.uint8 else [cv2.VIDEOWRITER_PROP_DEPTH, cv2.CV_16U]
    if depth and OLD_OPENCV:
        pytest.skip('this version of OpenCV writes no videos of 16 bits')
    video = cv2.VideoWriter(
        str(path),
        cv2.CAP_FFMPEG,
        cv2.VideoWriter_fourcc(*codec),
        rate,
        images[0].shape[1::-1],
        [cv2.VIDEOWRITER_PROP_IS_COLOR, int(colour), *depth],
    )
    for image in images:
        video.write(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR) if colour else image)
    video.release()


def frames_of(path, deep=False):
    """Return the frames (n, h, w) and the rate of a video."""
    video = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG)
    video.set(cv2.CAP_PROP_CONVERT_RGB, int(not deep))
    frames = []
    while True:
        ok, frame = video.read()
        if not ok:
            return np.array(frames), video.get(cv2.CAP_PROP_FPS)
        frames.append(frame if deep else frame[:, :, 0])


# ---- valid input


@pytest.mark.parametrize('dtype', [np.uint8, np.uint16])
@pytest.mark.parametrize('ending', [e for e in LOSSLESS if e != '.bmp'] + ['.PNG'])
def test_image_file(one, corrector, tmp_path, capfd, ending, dtype):
    """All pixels agree, in 8 and 16 bits."""
    image = image_of(0, dtype)
    out = tmp_path / f'out{ending}'
    (tmp_path / f'in{ending}').write_bytes(encode(image, ending.lower()))
    assert correct(tmp_path / f'in{ending}', one, out, '--json') == 0
    said = capfd.readouterr()
    assert said.err == '' and np.array_equal(
        cv2.imread(str(out), cv2.IMREAD_UNCHANGED), corrector.correct(image)
    )
    got = json.loads(said.out)
    assert (got['kind'], got['images'], got['fluoroscope'], got['image_size']) == (
        'image',
        1,
        'a',
        list(SIZE),
    )
    assert got['out'] == str(out) and got['empty_pixels'] == int((~corrector.mask).sum()) > 0
    assert sorted(os.listdir(tmp_path)) == sorted([f'in{ending}', f'out{ending}'])


def test_the_suffix_decides_the_format(one, corrector, tmp_path):
    """A bmp image is written in every format; jpg has a small loss."""
    (tmp_path / 'in.bmp').write_bytes(encode(image_of(), '.bmp'))
    for ending in IMAGE_SUFFIXES:
        out = tmp_path / f'out{ending}'
        assert correct(tmp_path / 'in.bmp', one, out) == 0
        got = decode(out.read_bytes()).astype(float)
        assert np.abs(got - corrector.correct(image_of())).max() <= (
            12 if ending.startswith('.j') else 0
        )
    assert (tmp_path / 'out.png').read_bytes().startswith(b'\x89PNG')
    assert (tmp_path / 'out.jpg').read_bytes().startswith(b'\xff\xd8')


def test_cubic_is_another_image(one, corrector, tmp_path):
    (tmp_path / 'in.png').write_bytes(encode(image_of(), '.png'))
    assert correct(tmp_path / 'in.png', one, tmp_path / 'out.png', '--interpolation', 'cubic') == 0
    cubic = ImageCorrector(a_calibration('a'), 'cubic').correct(image_of())
    assert np.array_equal(decode((tmp_path / 'out.png').read_bytes()), cubic)
    assert not np.array_equal(cubic, corrector.correct(image_of()))


@pytest.mark.parametrize('dtype', [np.uint8, np.uint16])
def test_stack(one, corrector, tmp_path, monkeypatch, dtype):
    """Pages are corrected one by one, in batches of any size."""
    monkeypatch.setattr('fluoro_calib_ros.io.image_reading.MAX_BATCH_BYTES', 3 * 128 * 96)
    pages = stack_of(8, dtype)
    assert cv2.imwritemulti(str(tmp_path / 'in.tif'), pages)
    assert correct(tmp_path / 'in.tif', one, tmp_path / 'out.tiff') == 0
    ok, got = cv2.imreadmulti(str(tmp_path / 'out.tiff'), flags=cv2.IMREAD_UNCHANGED)
    assert ok and len(got) == 8
    for page, image in zip(got, pages):
        assert page.dtype == dtype and np.array_equal(page, corrector.correct(image))


@pytest.mark.parametrize('order', ['little', 'big'])
@pytest.mark.parametrize('large', [False, True])
def test_tiff_with_large_offsets(tmp_path, monkeypatch, large, order):
    """Files beyond 4 GB and of both byte orders are read by OpenCV and their pages counted."""
    if large:
        monkeypatch.setattr('fluoro_calib_ros.io.image_writing.CLASSIC_BYTES', 0)
    pages = stack_of(3, np.uint16)
    content = tiff_of(pages)
    (tmp_path / 'x.tif').write_bytes(content)
    assert struct.unpack('<H', content[2:4])[0] == (43 if large else 42)
    assert tiff.count_pages(tmp_path / 'x.tif') == 3
    ok, got = cv2.imreadmulti(str(tmp_path / 'x.tif'), flags=cv2.IMREAD_UNCHANGED)
    assert ok and np.array_equal(got, pages)
    if order == 'big' and not large:
        head = b'MM' + struct.pack('>HIH', 42, 8, 0) + struct.pack('>I', 0)
        (tmp_path / 'm.tif').write_bytes(head)
        assert tiff.count_pages(tmp_path / 'm.tif') == 1


def test_folder(one, corrector, tmp_path, capfd):
    """All of its images are corrected under their names; other files are skipped, and existing
    files stay.
    """
    source = tmp_path / 'in'
    out = tmp_path / 'out'
    source.mkdir()
    out.mkdir()
    (out / 'note.txt').write_text('mine')
    for n in range(3):
        (source / f'{n}.png').write_bytes(encode(image_of(n), '.png'))
    cv2.imwritemulti(str(source / 'stack.tif'), stack_of(2, np.uint16))
    (source / 'readme.txt').write_text('x')
    (source / 'more').mkdir()
    assert correct(source, one, out, '--json') == 0
    said = capfd.readouterr()
    got = json.loads(said.out)
    assert (got['kind'], got['files'], got['images']) == ('folder', 4, 5)
    assert got['passed_over'] == ['readme.txt']
    assert 'skipped: readme.txt' in said.err
    assert sorted(os.listdir(out)) == ['0.png', '1.png', '2.png', 'note.txt', 'stack.tif']
    for n in range(3):
        assert np.array_equal(
            decode((out / f'{n}.png').read_bytes()), corrector.correct(image_of(n))
        )
    assert tiff.count_pages(out / 'stack.tif') == 2
    assert sorted(os.listdir(tmp_path)) == ['in', 'out']


def archive_of(folder):
    """Write an archive of two trials: images, a stack and a video in folders of their own."""
    for trial in ('trial_1', 'trial_2/raw'):
        (folder / trial).mkdir(parents=True)
        for n in range(2):
            (folder / trial / f'{n}.png').write_bytes(encode(image_of(n), '.png'))
        video_of(folder / trial / 'run.avi', stack_of(3))
    (folder / 'trial_1' / 'notes.txt').write_text('x')
    return folder


def content_of(folder):
    """Return the bytes of all files of a tree by name."""
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in sorted(folder.rglob('*'))
        if path.is_file()
    }


@pytest.mark.long
def test_archive_with_folders_on_two_processes(one, tmp_path, capfd):
    """Nested folders are included; one process and two write the same bytes."""
    source = archive_of(tmp_path / 'in')
    assert 'no images in this folder' in said(capfd, source, one, tmp_path / 'flat')
    for workers in ('1', '2'):
        out = tmp_path / f'out{workers}'
        more = ('--recursive', '--workers', workers, '--json')
        assert correct(source, one, out, *more) == 0
        got = json.loads(capfd.readouterr().out)
        assert (got['files'], got['images']) == (6, 10)
        assert got['passed_over'] == [os.path.join('trial_1', 'notes.txt')]
    first = content_of(tmp_path / 'out1')
    assert first == content_of(tmp_path / 'out2')
    assert set(first) == {name for name in content_of(source) if name.endswith(('png', 'avi'))}
    assert 'this is inside of' in said(capfd, source, one, source / 'out', '--recursive')


def test_what_is_read_but_not_written_has_another_name_in_a_new_folder(one, corrector, tmp_path):
    (tmp_path / 'in').mkdir()
    dicom(tmp_path / 'in' / 'IM1.dcm', image_of()[None])
    assert correct(tmp_path / 'in', one, tmp_path / 'out') == 0
    (new,) = content_of(tmp_path / 'out').items()
    assert new[0] == 'IM1.tif'
    assert np.array_equal(decode(new[1]), corrector.correct(image_of()))


def test_folder_with_a_damaged_file_keeps_going_if_asked_to(one, tmp_path, capfd):
    source = archive_of(tmp_path / 'in')
    bad = source / 'trial_1' / '0.png'
    bad.write_bytes(bad.read_bytes()[:100])
    out = tmp_path / 'out'
    one_process = ('--recursive', '--workers', '1')
    assert str(bad) in said(capfd, source, one, out, *one_process)
    assert not out.exists()
    assert correct(source, one, out, *one_process, '--keep-going', '--json') == 0
    told = capfd.readouterr()
    got = json.loads(told.out)
    assert got['files'] == 5 and len(got['failed']) == 1 and str(bad) in got['failed'][0]
    assert f'not corrected: {bad}' in told.err
    assert not (out / 'trial_1' / '0.png').exists() and (out / 'trial_1' / '1.png').exists()


def test_folder_names_its_output_in_messages(one, tmp_path, capfd):
    """The temporary folder is not named."""
    (tmp_path / 'in').mkdir()
    for name in ('x.avi', 'x.AVI.png'):
        (tmp_path / 'in' / name).write_bytes(encode(image_of(0, np.uint16), '.png'))
    deep = tmp_path / 'in' / 'y.jpg'
    deep.write_bytes(encode(image_of(0, np.uint16), '.png'))
    (tmp_path / 'in' / 'x.avi').unlink()
    text = said(capfd, tmp_path / 'in', one, tmp_path / 'out')
    assert f'{tmp_path / "out" / "y.jpg"}: an image of 16 bits cannot be written' in text


def test_recordings_of_a_folder_get_a_format_that_is_written(tmp_path):
    """Cine files become videos and DICOM files stacks; clashing output names are refused."""
    for name in ('a.cine', 'b.dcm', 'c.mkv'):
        (tmp_path / name).write_bytes(b'x')
    assert [str(path) for path in list_images(tmp_path).written] == ['a.avi', 'b.tif', 'c.mkv']
    (tmp_path / 'a.avi').write_bytes(b'x')
    with pytest.raises(DataError, match=r'a\.avi and a\.cine would both be written as a\.avi'):
        list_images(tmp_path)


@pytest.mark.parametrize(
    'ending, dtype, colour',
    [
        ('.avi', np.uint8, False),
        ('.mkv', np.uint8, True),
        ('.mkv', np.uint16, False),
        ('.avi', np.uint16, False),
    ],
)
def test_video(one, corrector, tmp_path, ending, dtype, colour):
    """Nothing is lost in 8 and 16 bits, and the frame rate is kept. A video in colours that are
    all grey is read as grey.
    """
    images = stack_of(7, dtype)
    out = tmp_path / f'out{ending}'
    video_of(tmp_path / 'in.avi', images, colour=colour)
    assert correct(tmp_path / 'in.avi', one, out) == 0
    got, rate = frames_of(out, dtype == np.uint16)
    assert rate == pytest.approx(29.97, abs=0.01) and got.dtype == dtype
    assert np.array_equal(got, [corrector.correct(image) for image in images])
    assert sorted(os.listdir(tmp_path)) == ['in.avi', f'out{ending}']


def test_video_as_mp4_and_as_a_stack(one, corrector, tmp_path):
    """MP4 is lossy; a stack is not."""
    images = stack_of(7)
    video_of(tmp_path / 'in.avi', images, rate=120)
    wanted = np.array([corrector.correct(image) for image in images])
    assert correct(tmp_path / 'in.avi', one, tmp_path / 'out.mp4') == 0
    got, rate = frames_of(tmp_path / 'out.mp4')
    assert (
        rate == pytest.approx(120)
        and got.shape == wanted.shape
        and np.abs(got - wanted.astype(float)).mean() < 6
    )
    assert correct(tmp_path / 'out.mp4', one, tmp_path / 'again.mp4') == 0
    assert correct(tmp_path / 'in.avi', one, tmp_path / 'out.tif') == 0
    assert np.array_equal(
        cv2.imreadmulti(str(tmp_path / 'out.tif'), flags=cv2.IMREAD_UNCHANGED)[1], wanted
    )


def test_fluoroscope_is_chosen(both, tmp_path):
    (tmp_path / 'in.png').write_bytes(encode(image_of(), '.png'))
    assert correct(tmp_path / 'in.png', both, tmp_path / 'out.png', '--fluoroscope', 'b') == 0
    (tmp_path / 'p.csv').write_text('u,v\n50,50\n')
    assert correct(tmp_path / 'p.csv', both, tmp_path / 'q.csv', '--fluoroscope', 'b') == 0


def test_progress_is_reported(one, corrector, tmp_path):
    video_of(tmp_path / 'in.avi', stack_of(5))
    calls = []
    done = correct_images(
        tmp_path / 'in.avi',
        tmp_path / 'out.avi',
        corrector,
        lambda *numbers: calls.append(numbers),
    )
    assert calls == [(n + 1, 5) for n in range(5)] and (done.kind, done.images) == ('video', 5)


def test_progress_bar_only_on_a_terminal(one, tmp_path, capfd, monkeypatch):
    """It is on standard error, and gone at the end."""
    video_of(tmp_path / 'in.avi', stack_of(5))

    class Terminal(io.StringIO):
        def isatty(self):
            return True

    monkeypatch.setattr('sys.stderr', Terminal())
    assert correct(tmp_path / 'in.avi', one, tmp_path / 'out.avi', '--json') == 0
    shown = sys.stderr.getvalue()
    assert 'in.avi: image 0 of 5' in shown and 'image' not in shown.rpartition('\r')[2]
    json.loads(capfd.readouterr().out)


# ---- invalid input


def said(capfd, *arguments):
    """Return the one sentence with which the command fails."""
    assert correct(*arguments) == 1
    out, err = capfd.readouterr()
    if OLD_OPENCV:  # this version prints errors of its own
        err = err.splitlines(keepends=True)[-1]
    assert out == '' and err.startswith('fluoro-calib correct: ') and err.count('\n') == 1
    return err


def tiff_of(pages):
    """Return the bytes of a stack as this package writes it."""
    with TemporaryDirectory() as folder:
        path = Path(folder) / 'stack.tif'
        source = ImageSource('stack', len(pages), iter([('', page) for page in pages]))
        write_images(path, source, lambda done, total: None)
        return path.read_bytes()


def in_a_circle(content):
    """Return a TIFF file whose last page links to its first."""
    content = bytearray(content)
    first = position = struct.unpack_from('<I', content, 4)[0]
    while position:
        link = position + 2 + 12 * struct.unpack_from('<H', content, position)[0]
        position = struct.unpack_from('<I', content, link)[0]
    content[link : link + 4] = struct.pack('<I', first)
    return bytes(content)


def flipped(content):
    content = bytearray(content)
    content[len(content) // 2] ^= 0x55
    return bytes(content)


PNG = encode(image_of(), '.png')
PLAIN_TIF = tiff_of(stack_of(4, np.uint16))
TIF = PLAIN_TIF  # compressed, as OpenCV writes stacks from 4.7 on
if hasattr(cv2, 'imencodemulti'):
    TIF = cv2.imencodemulti('.tif', stack_of(4, np.uint16))[1].tobytes()
COLOUR = cv2.imencode('.png', np.stack([image_of(), image_of(1), image_of(2)], axis=-1))[
    1
].tobytes()
BAD = {  # file: content, message
    'no.xyz': (b'x', 'files with the suffix .xyz cannot be read'),
    'text.png': (b'this is text', 'not an image that can be decoded, or it is damaged'),
    'empty.png': (b'', 'the file is empty'),
    'cut.png': (PNG[:-30], 'the PNG image is cut off'),
    'damaged.png': (flipped(PNG), 'the PNG image is damaged'),
    'cut.jpg': (encode(image_of(), '.jpg')[:-200], 'the image is cut off'),
    'cut.bmp': (encode(image_of(), '.bmp')[:-200], 'damaged'),
    'cut.pgm': (encode(image_of(), '.pgm')[:-200], 'damaged'),
    'cut.tif': (TIF[: len(TIF) * 2 // 3], 'it is cut off or damaged'),
    'cut_little.tif': (TIF[:-5], 'page 4 of 4 is damaged or cut off'),
    'cut_plain.tif': (PLAIN_TIF[: len(PLAIN_TIF) * 2 // 3], 'it is cut off or damaged'),
    'cut_plain_little.tif': (PLAIN_TIF[:-5], 'page 4 of 4 is damaged or cut off'),
    'circle.tif': (in_a_circle(PLAIN_TIF), 'it is cut off or damaged'),
    'head.tif': (TIF[:3], 'this is not a TIFF file'),
    'text.tif': (b'this is text', 'this is not a TIFF file'),
    'text.avi': (b'this is text', 'not a video that can be read'),
    'empty.mp4': (b'', 'not a video that can be read'),
    'colour.png': (COLOUR, 'this is a colour image'),
    'float.tif': (
        cv2.imencode('.tif', image_of().astype(np.float32))[1].tobytes(),
        'pixels of float32',
    ),
    'small.png': (
        encode(image_of()[:50], '.png'),
        'the image is 128 x 50 px, but the calibration is for 128 x 96 px',
    ),
}


@pytest.mark.parametrize('name', BAD)
def test_bad_source(one, tmp_path, capfd, name):
    """One sentence has its name; an earlier file stays, and nothing else is left."""
    content, sentence = BAD[name]
    source = tmp_path / name
    out = tmp_path / f'out.{name.rpartition(".")[2]}'
    source.write_bytes(content)
    out.write_text('earlier')
    text = said(capfd, source, one, out)
    assert sentence in text and str(source) in text
    assert out.read_text() == 'earlier' and len(os.listdir(tmp_path)) == 2


@pytest.mark.parametrize('suffix', ['png', 'tif', 'avi', 'dcm'])
def test_pipe_is_not_read(one, tmp_path, capfd, suffix):
    source = tmp_path / f'in.{suffix}'
    os.mkfifo(source)
    assert 'this is a pipe' in said(capfd, source, one, tmp_path / 'out.png')


@pytest.mark.parametrize('ending, codec', [('.avi', 'FFV1'), ('.mkv', 'FFV1'), ('.mp4', 'mp4v')])
def test_cut_video(one, tmp_path, capfd, ending, codec):
    source = tmp_path / f'in{ending}'
    out = tmp_path / 'out.avi'
    video_of(source, stack_of(12), codec=codec)
    source.write_bytes(source.read_bytes()[: -source.stat().st_size // 3])
    text = said(capfd, source, one, out)
    assert str(source) in text and 'damaged' in text and os.listdir(tmp_path) == [source.name]


def test_bad_image_among_good_ones(one, tmp_path, capfd):
    """In a folder, stack or video, the error names the place of the image; nothing is written."""
    source = tmp_path / 'in'
    out = tmp_path / 'out'
    source.mkdir()
    for n in range(3):
        (source / f'{n}.png').write_bytes(encode(image_of(n)[: 96 - 2 * (n == 1)], '.png'))
    assert f'{source / "1.png"}: the image is 128 x 94 px' in said(capfd, source, one, out)
    assert os.listdir(tmp_path) == ['in']
    cv2.imwritemulti(str(tmp_path / 'in.tif'), [image_of(), image_of(), image_of()[:50]])
    assert 'in.tif, page 3: the image is 128 x 50 px' in said(
        capfd, tmp_path / 'in.tif', one, tmp_path / 'out.tif'
    )
    assert sorted(os.listdir(tmp_path)) == ['in', 'in.tif']


def test_impossible_outputs_are_refused(one, both, tmp_path, capfd):
    """Such outputs cannot hold the images or would overwrite the source."""
    eight, deep, stack, video = (tmp_path / n for n in ('8.png', '16.png', 's.tif', 'v.avi'))
    eight.write_bytes(encode(image_of(), '.png'))
    deep.write_bytes(encode(image_of(0, np.uint16), '.png'))
    cv2.imwritemulti(str(stack), stack_of(3))
    video_of(video, stack_of(3, np.uint16))
    (tmp_path / 'folder').mkdir()
    (tmp_path / 'empty').mkdir()
    for source, out, sentence in (
        (eight, 'nowhere/x.png', 'there is no folder'),
        (eight, 'x.xyz', 'the suffix .xyz is not that of an image'),
        (eight, 'x', 'the suffix (none) is not'),
        (eight, 'x.avi', 'the suffix .avi is not that of an image'),
        (eight, '8.png', '8.png would be overwritten, choose another output file'),
        (eight, 'folder', 'this is a folder'),
        (deep, 'x.jpg', '16 bits cannot be written as jpg'),
        (deep, 'x.bmp', '16 bits cannot be written as bmp'),
        (stack, 'x.png', 'a stack cannot be written as .png, use tif, tiff'),
        (stack, 'x.avi', 'a stack cannot be written as .avi'),
        (video, 'x.mp4', '16 bits cannot be written as mp4, use avi or mkv'),
        (video, 'x.png', 'a video cannot be written as .png, use tif, tiff, avi, mkv, mp4'),
        (tmp_path / 'empty', 'x', 'there are no images in this folder'),
        (tmp_path / 'nothing.png', 'x.png', 'there is no such file'),
        (tmp_path / 'nothing.avi', 'x.avi', 'there is no such file'),
    ):
        assert sentence in said(capfd, source, one, tmp_path / out)
    assert 'calibrations of a, b: choose one with --fluoroscope' in said(
        capfd, eight, both, tmp_path / 'x.png'
    )
    assert "there is no calibration of fluoroscope 'c', only of a, b" in said(
        capfd, eight, both, tmp_path / 'x.png', '--fluoroscope', 'c'
    )
    assert len(os.listdir(tmp_path)) == 6


def test_file_names_that_are_not_utf8(one, tmp_path, capfd):
    """They are accepted for images, but not for files that OpenCV reads or writes by name, which
    would end the process.
    """
    odd = [tmp_path / os.fsdecode(b'\xff' + ending) for ending in (b'.png', b'.tif', b'.avi')]
    odd[0].write_bytes(encode(image_of(), '.png'))
    cv2.imwritemulti(str(tmp_path / 's.tif'), stack_of(3))
    video_of(tmp_path / 'v.avi', stack_of(3))
    assert (
        correct(odd[0], one, tmp_path / 'out.png') == 0
        and correct(tmp_path / 's.tif', one, odd[1]) == 0
    )
    capfd.readouterr()
    os.replace(tmp_path / 's.tif', odd[1])
    assert 'the name is not UTF-8 text, rename it' in said(capfd, odd[1], one, tmp_path / 'x.tif')
    assert 'the name is not UTF-8 text, rename it' in said(capfd, tmp_path / 'v.avi', one, odd[2])
    os.replace(tmp_path / 'v.avi', odd[2])
    assert 'the name is not UTF-8 text, rename it' in said(capfd, odd[2], one, tmp_path / 'x.avi')
    assert sorted(os.listdir(tmp_path)) == sorted(['out.png', *(p.name for p in odd)])


def test_folder_in_place_of_an_image(one, tmp_path, capfd):
    """All or nothing: no image is replaced if one of them cannot be."""
    (tmp_path / 'in').mkdir()
    (tmp_path / 'out' / 'b.png').mkdir(parents=True)
    for name in ('a.png', 'b.png'):
        (tmp_path / 'in' / name).write_bytes(encode(image_of(), '.png'))
    assert f'{tmp_path / "out" / "b.png"}: cannot be written, this is a folder' in said(
        capfd, tmp_path / 'in', one, tmp_path / 'out'
    )
    assert os.listdir(tmp_path / 'out') == ['b.png'] and sorted(os.listdir(tmp_path)) == [
        'in',
        'out',
    ]


def test_odd_sizes_of_videos(tmp_path):
    """OpenCV would cut off the last row."""
    calibration = replace(a_calibration('a'), image_size=(128, 95))
    cv2.imwritemulti(str(tmp_path / 'x.tif'), [image_of()[:95]] * 2)
    with pytest.raises(DataError, match='a stack cannot be'):
        correct_images(tmp_path / 'x.tif', tmp_path / 'x.avi', ImageCorrector(calibration))
    with pytest.raises(DataError, match='128 x 95 px, both must be even'):
        odd = ImageSource('video', 1, iter([('x', image_of()[:95])]), 25.0)
        write_video(tmp_path / 'x.avi', odd, lambda *_: None)


@pytest.fixture(scope='module')
def turning(tmp_path_factory):
    """Folder with a calibration of a C-arm that turns."""
    folder = tmp_path_factory.mktemp('turning')
    save_calibration(folder, rigs.turning(a_calibration('a')))
    return folder


def test_images_of_a_video_are_corrected_each_at_its_angle(turning, tmp_path, capsys):
    images = stack_of(4)
    cv2.imwritemulti(str(tmp_path / 'trial.tif'), images)
    angles = tmp_path / 'angles.csv'
    angles.write_text('image,angle_deg\n2,-30\n1,40\n4,\n')  # there is no row for image 3
    out = tmp_path / 'out.tif'
    assert correct(tmp_path / 'trial.tif', turning, out, '--angles', angles) == 0
    assert '2 of 4 images have no angle in' in capsys.readouterr().err
    calibration = rigs.turning(a_calibration('a'))
    maps = AngleMaps(calibration)
    wanted = [maps.at(a).correct(i) for a, i in zip(np.radians([40, -30]), images)]
    mean = ImageCorrector(calibration)
    wanted += [mean.correct(image) for image in images[2:]]
    _, found = cv2.imreadmulti(str(out), flags=cv2.IMREAD_UNCHANGED)
    assert np.array_equal(found, wanted)
    assert not np.array_equal(wanted[0], mean.correct(images[0]))


@pytest.mark.parametrize(
    'text, cause',
    [
        ('image,angle_deg\n0,3\n', "row 2: image is '0', the first image is 1"),
        ('image,angle_deg\n1,3\n1,4\n', 'row 3: image 1 is already given in row 2'),
        ('image,angle_deg\n1,9999\n', "row 2: angle_deg is '9999', not an angle"),
        ('image,angle_deg\n1,x\n', "row 2: angle_deg is 'x', not a number"),
        ('image\n1\n', 'angle_deg'),
    ],
)
def test_wrong_angles_of_images_are_named_with_file_and_row(
    turning, tmp_path, capsys, text, cause
):
    cv2.imwrite(str(tmp_path / 'one.png'), image_of())
    (tmp_path / 'angles.csv').write_text(text)
    out = tmp_path / 'out.png'
    assert correct(tmp_path / 'one.png', turning, out, '--angles', tmp_path / 'angles.csv') == 1
    error = capsys.readouterr().err
    assert 'angles.csv' in error and cause in error
    assert not out.exists()


def test_angles_of_images_need_one_file_and_a_calibration_that_depends_on_them(
    turning, one, tmp_path, capsys
):
    folder = tmp_path / 'folder'
    folder.mkdir()
    cv2.imwrite(str(folder / 'one.png'), image_of())
    angles = tmp_path / 'angles.csv'
    angles.write_text('image,angle_deg\n1,30\n')
    assert correct(folder, turning, tmp_path / 'out', '--angles', angles) == 1
    assert 'angles are those of the images of one file' in capsys.readouterr().err
    assert correct(folder / 'one.png', one, tmp_path / 'out.png', '--angles', angles) == 0
    assert 'does not depend on an angle' in capsys.readouterr().err


def test_folder_of_images_does_not_replace_a_file(tmp_path):
    source = tmp_path / 'images'
    source.mkdir()
    (source / 'one.png').write_bytes(encode(np.full((4, 6), 9, np.uint8), '.png'))
    out = tmp_path / 'out'
    out.write_text('mine')
    with pytest.raises(DataError, match='this is a file'), folder_like(out, list_images(source)):
        raise AssertionError
    assert out.read_text() == 'mine' and sorted(tmp_path.iterdir()) == [source, out]
    out.unlink()
    with folder_like(out, list_images(source)) as folder:
        (folder / 'one.png').write_bytes(b'new')
    assert (out / 'one.png').read_bytes() == b'new'
