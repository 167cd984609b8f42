# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Folders of images and videos, and new folders like them that appear as a whole."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from ..errors import DataError
from .access import make_folder
from .atomic import sync_folder
from .image_files import check_apart
from .image_formats import (
    CINE_SUFFIXES,
    DICOM_SUFFIXES,
    IMAGE_SUFFIXES,
    READ_SUFFIXES,
    listed,
    suffix_of,
)
from .image_writing import temporary_path

# Suffixes that images get where their own format is read but not written.
_WRITTEN_AS = dict.fromkeys(CINE_SUFFIXES, '.avi') | dict.fromkeys(DICOM_SUFFIXES, '.tif')


@dataclass(frozen=True)
class ImageFolder:
    """Files with images in a folder.

    Attributes
    ----------
    path : Path
    files : tuple of Path
        Images and videos, relative to the folder, in the order of their names.
    passed_over : tuple of str
        Other files.
    recursive : bool
        Whether the folders in the folder belong to it.
    """

    path: Path
    files: tuple[Path, ...]
    passed_over: tuple[str, ...]
    recursive: bool

    @property
    def written(self) -> tuple[Path, ...]:
        """Names of new files for `files`."""
        return tuple(
            path.with_suffix(_WRITTEN_AS.get(suffix_of(path), path.suffix)) for path in self.files
        )


def list_images(folder: Path, recursive: bool = False) -> ImageFolder:
    """Return the files with images in a folder, and in the folders in it if asked for.

    Raises DataError where there are none, or two would be written under one name.
    """
    found = (path for path in folder.rglob('*')) if recursive else folder.iterdir()
    files = sorted(path.relative_to(folder) for path in found if path.is_file())
    images = tuple(path for path in files if suffix_of(path) in READ_SUFFIXES)
    if not images:
        raise DataError(
            f'{folder}: there are no images in this folder ({listed(IMAGE_SUFFIXES)}), and no '
            'videos'
        )
    others = tuple(str(path) for path in files if path not in set(images))
    out = ImageFolder(folder, images, others, recursive)
    by_name: dict[Path, Path] = {}
    for path, name in zip(images, out.written):
        if name in by_name:
            raise DataError(
                f'{folder}: {by_name[name]} and {path} would both be written as {name}, rename one'
            )
        by_name[name] = path
    return out


@contextmanager
def folder_like(out: Path, source: ImageFolder) -> Iterator[Path]:
    """A temporary folder with the folders of another one; at the end its files move to `out`.

    Files of the same names in `out` are replaced, other ones stay. After an error, `out` is as it
    was.

    Raises
    ------
    DataError
        Where `out` is a file, the source itself, or inside of it and would be read as a part of
        it, and where a file would replace a folder.
    """
    check_apart(source.path, out)
    if out.exists() and not out.is_dir():
        raise DataError(f'{out}: this is a file, but {source.path} is a folder')
    if source.path.resolve() in out.resolve().parents and source.recursive:
        raise DataError(f'{out}: this is inside of {source.path}, which is read with its folders')
    with temporary_path(out) as temporary:
        make_folder(temporary)
        folders = sorted({path.parent for path in source.files})
        for folder in folders:
            (temporary / folder).mkdir(parents=True, exist_ok=True)
        yield temporary
        _move(temporary, out, folders, source.written)


def _move(temporary: Path, out: Path, folders: Sequence[Path], names: Sequence[Path]) -> None:
    """Move the files that were written to their place, where all of them can be."""
    names = [name for name in names if (temporary / name).exists()]
    make_folder(out)
    for name in names:  # before any file is moved: all or nothing
        if (out / name).is_dir():
            raise DataError(f'{out / name}: cannot be written, this is a folder')
    for folder in folders:
        (out / folder).mkdir(parents=True, exist_ok=True)
    for name in names:
        os.replace(temporary / name, out / name)
    for folder in folders:
        sync_folder(out / folder)
