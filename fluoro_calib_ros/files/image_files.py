"""Image files, stacks, folders of images and videos that are corrected and written anew.

Whatever is written appears under its name when it is whole. Images are grey; they keep their 8 or
16 bits, and where the new file cannot hold them, that is said and nothing is written. Videos are
written without loss (FFV1), but for MP4, which players know with lossy codecs only.
"""

import os
import secrets
import shutil
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from ..errors import DataError
from ..images.codec import decode, encode, grey
from .access import make_folder, os_error_reason, read_bytes
from .atomic import atomic_file, sync_folder, write_bytes
from .tiff import TiffWriter, count_pages

STACKS = ('.tif', '.tiff')
IMAGES = ('.png', *STACKS, '.jpg', '.jpeg', '.bmp', '.pgm')
VIDEOS = {'.avi': 'FFV1', '.mkv': 'FFV1', '.mp4': 'mp4v'}  # codec that is written
AT_ONCE = 64_000_000  # bytes of pages that are read at once
# part of the frames a video may have fewer than it says, which for some containers is an estimate
LOST = 0.01
GREY_16 = b'Y1\0\x10'  # OpenCV's name of the pixels of a video with 16 bits

os.environ.setdefault(
    'OPENCV_FFMPEG_LOGLEVEL', '-8'
)  # nothing: what is wrong is said here, in one sentence


@dataclass(frozen=True)
class CorrectedImages:
    """What has been corrected: kind (image, stack, video or folder), number of images, pages or
    frames, and names of the files of a folder that are no images.
    """

    kind: str
    images: int
    passed_over: tuple = ()


def ending_of(path):
    """Ending of a path in lower case, with its dot."""
    return Path(path).suffix.lower()


def is_images(path):
    """Whether path is a folder, or a file whose ending is that of an image or a video."""
    return os.path.isdir(path) or ending_of(path) in (*IMAGES, *VIDEOS)


def correct_images(source, out, corrector, progress=lambda done, total: None):
    """Correct the image file, stack, folder of images or video source with an ImageCorrector, and
    write out.

    progress(done, total) is called after every image. Returns CorrectedImages. Raises DataError,
    and leaves out as it was, where source cannot be read or is damaged, is no grey image of the
    calibration's size, or where out cannot be written or is of a format that cannot hold it.
    """
    source = Path(source)
    out = Path(out)
    if source.exists() and out.exists() and os.path.samefile(source, out):
        raise DataError(f'{out}: this is the source itself, corrected images need another name')
    if not out.absolute().parent.is_dir():
        raise DataError(f'{out}: cannot be written, there is no folder {out.absolute().parent}')
    if source.is_dir():
        return _correct_folder(source, out, corrector, progress)
    if out.is_dir():
        raise DataError(f'{out}: this is a folder, but {source} is a file')
    kind, count, images, rate = _read(source)
    written = _write(out, kind, count, rate, _corrected(images, corrector), progress)
    return CorrectedImages(kind, written)


def _corrected(images, corrector):
    """Corrected images of an iterator of (where, image), in one array that is used again."""
    out = None
    for where, image in images:
        try:
            corrector.check(image)
        except DataError as error:
            raise DataError(f'{where}: {error}') from None
        if out is None or out.dtype != image.dtype:
            out = np.empty(corrector.shape, dtype=image.dtype)
        yield where, corrector.correct(image, out)


def _correct_folder(source, out, corrector, progress):
    """All into a folder beside out, and then into place."""
    files = sorted(path for path in source.iterdir() if path.is_file())
    wanted = [path for path in files if ending_of(path) in IMAGES]
    if not wanted:
        raise DataError(
            f'{source}: there are no images in this folder ({", ".join(e[1:] for e in IMAGES)})'
        )
    if out.exists() and not out.is_dir():
        raise DataError(f'{out}: this is a file, but {source} is a folder')
    with _temporary(out) as temporary:
        make_folder(temporary)
        for number, path in enumerate(wanted):
            kind, count, images, _ = _read(path)
            _write(
                temporary / path.name,
                kind,
                count,
                None,
                _corrected(images, corrector),
                lambda *_: None,
            )
            progress(number + 1, len(wanted))
        make_folder(out)
        for path in wanted:  # before anything is moved: all or nothing
            if (out / path.name).is_dir():
                raise DataError(f'{out / path.name}: cannot be written, this is a folder')
        for path in wanted:
            os.replace(temporary / path.name, out / path.name)
        sync_folder(out)
    return CorrectedImages('folder', len(wanted), tuple(p.name for p in files if p not in wanted))


# ---- reading


def _read(path):
    """Kind, number, iterator of (where, image) and frames a second (or None) of a file with
    images.
    """
    ending = ending_of(path)
    if ending in VIDEOS:
        return _read_video(path)
    if ending not in IMAGES:
        raise DataError(
            f'{path}: the ending {ending or "(none)"} is none of an image ({_listed(IMAGES)}) or a video '
            f'({_listed(VIDEOS)})'
        )
    pages = count_pages(path) if ending in STACKS else 1
    if pages > 1:
        _check_text(path)
        return 'stack', pages, _pages_of(path, pages), None
    return 'image', 1, _image_of(path), None


def _check_text(path):
    """Raise DataError for a name that OpenCV cannot be told: it would end the process."""
    try:
        str(path).encode()
    except UnicodeEncodeError:
        raise DataError(f'{path}: the name is not UTF-8 text, rename it') from None


def _image_of(path):
    content = read_bytes(path)
    try:
        image = decode(content)
    except DataError as error:
        raise DataError(f'{path}: {error}') from None
    yield path, image


def _pages_of(path, pages):
    at = 0
    step = 1
    while at < pages:
        try:
            ok, images = cv2.imreadmulti(
                str(path), at, min(step, pages - at), flags=cv2.IMREAD_UNCHANGED
            )
        except cv2.error:
            ok = False
            images = ()
        if not ok or len(images) != min(step, pages - at):
            raise DataError(
                f'{path}: page {at + len(images) + 1} of {pages} is damaged or cut off'
            )
        for image in images:
            at += 1
            where = f'{path}, page {at}'
            try:
                yield where, grey(image)
            except DataError as error:
                raise DataError(f'{where}: {error}') from None
        step = max(1, AT_ONCE // images[0].nbytes)


def _read_video(path):
    if not os.path.isfile(path):
        read_bytes(path)  # says why
    _check_text(path)
    video = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG)
    if not video.isOpened():
        raise DataError(f'{path}: this is no video that can be read, or it is damaged')
    rate = video.get(cv2.CAP_PROP_FPS)
    count = max(0, round(video.get(cv2.CAP_PROP_FRAME_COUNT)))
    if not 0 < rate < 1e6:
        raise DataError(f'{path}: the video does not tell its frame rate')
    pixels = int(video.get(cv2.CAP_PROP_CODEC_PIXEL_FORMAT)).to_bytes(4, 'little')
    if pixels == GREY_16:
        video.set(cv2.CAP_PROP_CONVERT_RGB, 0)
    elif pixels[:3] == GREY_16[:3]:
        raise DataError(
            f'{path}: the video has grey values of {pixels[3]} bits, only 8 and 16 are read'
        )
    return 'video', count, _frames_of(path, video, count), rate


def _frames_of(path, video, count):
    number = 0
    try:
        while True:
            ok, frame = video.read()
            if not ok:
                break
            number += 1
            # Colours of a grey video are equal but for rounding; others become grey as people see
            # them.
            yield (
                f'{path}, frame {number}',
                frame if frame.ndim == 2 else cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY),
            )
    finally:
        video.release()
    if number < count - 1 - LOST * count or not number:
        raise DataError(
            f'{path}: only {number} of {count} frames can be read, the video is damaged or cut off'
        )


# ---- writing


def _write(out, kind, count, rate, images, progress):
    """Write corrected (where, image) to a file; returns their number."""
    ending = ending_of(out)
    if ending in VIDEOS and kind == 'video':
        return _write_video(out, count, rate, images, progress)
    if ending in STACKS:
        return _write_stack(out, count, images, progress)
    if kind != 'image':
        raise DataError(
            f'{out}: a {kind} cannot be written as {ending or "a file without ending"}, take '
            f'{_listed((*STACKS, *VIDEOS) if kind == "video" else STACKS)}'
        )
    if ending not in IMAGES:
        raise DataError(
            f'{out}: the ending {ending or "(none)"} is none of an image ({_listed(IMAGES)})'
        )
    where, image = next(images)
    try:
        content = encode(image, ending)
    except DataError as error:
        raise DataError(f'{out}: {error}') from None
    write_bytes(out, content)
    progress(1, 1)
    return 1


def _write_stack(out, count, images, progress):
    where, image = next(images)
    with atomic_file(out) as file:
        writer = TiffWriter(file, max(count, 1), image.nbytes)
        number = 0
        while True:
            writer.write(image)
            number += 1
            progress(number, count)
            try:
                where, image = next(images)
            except StopIteration:
                return number


def _write_video(out, count, rate, images, progress):
    where, image = next(images)
    height, width = image.shape
    deep = image.dtype == np.uint16
    if width % 2 or height % 2:
        raise DataError(
            f'{out}: a video cannot have images of {width} x {height} px, both have to be even'
        )
    if deep and VIDEOS[ending_of(out)] != 'FFV1':
        raise DataError(
            f'{out}: grey values of 16 bits cannot be written as {ending_of(out)[1:]}, take avi or mkv'
        )
    _check_text(out.absolute())
    with _temporary(out) as temporary:
        video = cv2.VideoWriter(
            str(temporary),
            cv2.CAP_FFMPEG,
            cv2.VideoWriter_fourcc(*VIDEOS[ending_of(out)]),
            rate,
            (width, height),
            [
                cv2.VIDEOWRITER_PROP_IS_COLOR,
                0,
                cv2.VIDEOWRITER_PROP_DEPTH,
                cv2.CV_16U if deep else cv2.CV_8U,
            ],
        )
        if not video.isOpened():
            raise DataError(f'{out}: cannot be written')
        number = 0
        try:
            while image is not None:
                video.write(image)
                number += 1
                progress(number, count)
                where, image = next(images, (None, None))
        finally:
            video.release()
        _check_written(out, temporary, number)
        os.replace(temporary, out)
        sync_folder(out.absolute().parent)
    return number


def _check_written(out, path, count):
    """Raise DataError unless the video path is whole: OpenCV does not tell when the disk is full."""
    video = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG)
    whole = video.isOpened() and video.get(cv2.CAP_PROP_FRAME_COUNT) >= count - 1
    video.release()
    if not whole:
        raise DataError(f'{out}: cannot be written (is the disk full?)')
    with open(path, 'rb') as file:
        os.fsync(file.fileno())


@contextmanager
def _temporary(out):
    """Path beside out with its ending, for a file or folder; what is left of it goes with the
    block.

    An OSError in the block is said to be of out.
    """
    path = out.absolute().parent / f'.{out.stem[:100]}.{secrets.token_hex(8)}.tmp{out.suffix}'
    try:
        yield path
    except OSError as error:
        raise DataError(f'{out}: cannot be written ({os_error_reason(error)})') from None
    finally:
        if path.is_dir():
            shutil.rmtree(path, ignore_errors=True)
        else:
            with suppress(OSError):
                path.unlink()


def _listed(endings):
    return ', '.join(ending[1:] for ending in endings)


__all__ = ['IMAGES', 'VIDEOS', 'CorrectedImages', 'correct_images', 'ending_of', 'is_images']
