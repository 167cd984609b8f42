# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Registry of the formats: the only place that lists them.

A new format is a `content.Format` and one line here. The command line takes the kinds from this
module, and reads every source through it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

from ...errors import DataError, quoted
from ...exposures.frame import Frame
from ...exposures.names import Names
from ..access import PathLike, encoding_of, kind_not_read, opened
from . import bundle, native, xmalab_project
from .bodies import AUTOSCOPER, OPENSIM, POSES, RIGIDBODY
from .content import PARTS, Content, FileSettings, Format, Sample, Written, has_content
from .image_points import DEEPLABCUT, SLEAP, XMALAB2D
from .opencv_cameras import ANIPOSE, CAMERA_INFO, OPENCV
from .phantoms import COORDINATES, FRAMESPEC
from .points import C3D, TRC, XMALAB3D
from .xmalab_cameras import DLT, LOOKUP, MAYACAM1, MAYACAM2

HEAD = 65536  # first bytes of a file, by which a format is recognised
LINES = 20  # first lines of a file, by which a format is recognised

# Order in which a file is compared with the formats; help texts have the same order.
FORMATS: dict[str, Format] = {
    format_.kind: format_
    for format_ in (
        *native.FORMATS,
        native.KNOWN_ORIENTATION,
        XMALAB2D,
        DEEPLABCUT,
        SLEAP,
        xmalab_project.FORMAT,
        FRAMESPEC,
        RIGIDBODY,
        POSES,
        XMALAB3D,
        MAYACAM2,
        MAYACAM1,
        DLT,
        AUTOSCOPER,
        LOOKUP,
        ANIPOSE,
        OPENCV,
        CAMERA_INFO,
        COORDINATES,
        bundle.FORMAT,
        C3D,
        TRC,
        OPENSIM,
    )
}


def kinds(condition: Callable[[Format], object]) -> tuple[str, ...]:
    """Return the kinds of the formats that meet a condition."""
    return tuple(kind for kind, format_ in FORMATS.items() if condition(format_))


def sample_of(path: PathLike) -> Sample:
    """Return the beginning of a file. Raises DataError for a file that cannot be read."""
    path = Path(path)
    with opened(path) as file:
        head = file.read(HEAD)
    if not head:
        raise DataError(f'{path}: the file is empty')
    encoding = encoding_of(head)
    if b'\0' in head and encoding != 'utf-16':
        return Sample(path, head, [])
    text = head.decode(encoding, 'replace')
    lines = [line.strip() for line in text.splitlines()]
    return Sample(path, head, [line for line in lines if line][:LINES])


def recognised(path: PathLike) -> Format | None:
    """Return the format of a file, None if unknown. Raises DataError for an unreadable file."""
    sample = sample_of(path)
    return next((f for f in FORMATS.values() if f.recognise(sample)), None)


def read(path: PathLike, settings: FileSettings, kind: str | None = None) -> Content:
    """Read a file of any format, or a folder with a file of one format for each camera.

    kind: the format; by default it is recognised. Raises DataError for a file that does not have
    the format; the message names the recognised one.
    """
    path = Path(path)
    if path.is_dir():
        return _read_folder(path, settings, kind)
    recognised_format = recognised(path)
    format_ = recognised_format if kind is None else FORMATS[kind]
    if format_ is None:
        sample = sample_of(path)
        nature = kind_not_read(sample.head) or ('' if sample.lines else 'not text')
        beginning = f'it is {nature}' if nature else f'it begins with {quoted(sample.lines[0])}'
        raise DataError(f'{path}: the format is not known; {beginning}')
    if format_.read is None:
        raise DataError(f'{path}: {format_.title} is only written, not read')
    try:
        return format_.read(path, settings)
    except DataError as error:
        if recognised_format is None or recognised_format is format_:
            raise
        raise DataError(
            f'{error}; the file looks like {recognised_format.title} ({recognised_format.kind})'
        ) from None


def _read_folder(folder: Path, settings: FileSettings, kind: str | None) -> Content:
    """Read a folder with a file for each camera. Raises DataError."""
    contents: dict[Path, tuple[str, Content]] = {}
    for path in sorted(p for p in folder.iterdir() if p.is_file() and p.name[0] != '.'):
        format_ = recognised(path)
        if format_ is None or format_.read is None or (kind and format_.kind != kind):
            continue
        if format_.parts not in (('cameras',), ('lookups',)) and not format_.one_camera:
            continue
        content = format_.read(path, settings)
        # A target must have the same id in all files.
        settings = replace(settings, names=settings.names.merged(content.names))
        contents[path] = (format_.kind, content)
    kinds_found = dict.fromkeys(name for name, _ in contents.values())
    if len(kinds_found) != 1:
        contained = (
            f'files of {" and ".join(kinds_found)}' if kinds_found else 'no file of cameras'
        )
        raise DataError(
            f'{folder}: the folder has {contained}, but should be a result folder or have a file '
            'of one format for each camera'
        )
    cameras = [camera for _, content in contents.values() for camera in content.cameras]
    lookups = {n: maps for _, content in contents.values() for n, maps in content.lookups.items()}
    notes = tuple(dict.fromkeys(n for _, content in contents.values() for n in content.notes))
    for camera in cameras:
        if sum(candidate.name == camera.name for candidate in cameras) > 1:
            raise DataError(f'{folder}: two cameras are called {camera.name!r}')
    observations: dict[str, Sequence[Frame]] = {}
    for path, (_, content) in contents.items():
        for name, frames in (content.observations or {}).items():
            if name in observations:
                raise DataError(f'{path}: another file is also of fluoroscope {name}')
            observations[name] = frames
    return Content(
        observations=observations or None,
        cameras=tuple(cameras),
        lookups=lookups,
        names=Names(settings.names.targets),
        notes=notes,
    )


def write(path: PathLike, kind: str, content: Content, settings: FileSettings) -> Written:
    """Write a Content in a format.

    Raises DataError for a format that is only read, and for a Content without a suitable part.
    """
    format_ = FORMATS[kind]
    if format_.write is None:
        raise DataError(f'{path}: {format_.title} is only read, not written')
    parts = [name for name in format_.parts if has_content(getattr(content, name))]
    if not parts:
        needed = ' or '.join(PARTS[name] for name in format_.parts)
        available = (
            ' and '.join(PARTS[name] for name in content.parts) or 'nothing that can be converted'
        )
        raise DataError(f'{format_.title} needs {needed}, but the source has {available}')
    return format_.write(Path(path), content, settings)
