# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Atomic replacement of folders, and checks that outputs do not destroy anything.

A new folder is written next to the old one, and both are exchanged in one step of the file system.
The old one is kept as NAME.previous. Hidden folders left behind by a killed run are cleaned up by
the next run. They are named .NAME.<random>.tmp while a folder is being written, .NAME.<inode>.swap
when it is complete, and .NAME.<random>.old for a folder on its way to NAME.previous or to
deletion.
"""

from __future__ import annotations

import ctypes
import errno
import os
import secrets
import shutil
import stat
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path

from ..errors import DataError
from .access import (
    PathLike,
    hidden_path,
    make_folder,
    os_errors,
    start_of_hidden,
    sync_folder,
)

try:
    import fcntl
except ImportError:  # Windows, where a folder can be neither opened nor locked
    fcntl = None  # type: ignore[assignment]

PREVIOUS = '.previous'
# Suffixes of the files of a bag or a result folder that are read as inputs.
_INPUT_NAMES = (
    *('.mcap', '.db3', '.zstd', '.npz', '.yaml', '.json'),
    *('observations.csv', 'phantom.csv', 'names.csv'),
)
_AT_FDCWD = -100  # linux/fcntl.h: paths are relative to the working directory
_RENAME_EXCHANGE = 2  # linux/fs.h
# Errors of file systems and old kernels that do not support the exchange.
_NO_EXCHANGE = (errno.ENOSYS, errno.EINVAL, errno.ENOTSUP, errno.EXDEV)


@dataclass(frozen=True)
class FolderKind:
    """Description of a kind of folder."""

    title: str  #: name in messages, such as 'a result folder'
    #: patterns of names of entries that are replaced with the folder; all others belong to the
    #: user and are carried over
    parts: tuple[str, ...]
    marks: tuple[str, ...]  #: patterns of names that identify a folder of this kind

    def owns(self, name: str) -> bool:
        """Return whether an entry belongs to the folder, or was left behind by a killed run."""
        return any(fnmatchcase(name, pattern) for pattern in (*self.parts, '.*.tmp'))

    def is_marked_by(self, name: str) -> bool:
        """Return whether an entry of this name identifies a folder of this kind."""
        return any(fnmatchcase(name, pattern) for pattern in self.marks)


def check_output_folder(path: PathLike, kind: FolderKind, inputs: Iterable[PathLike] = ()) -> None:
    """Raise DataError unless a folder of this kind may be written at a path.

    The path must not exist, or be an empty folder or one of this kind, and must be writable. It
    must neither contain an input, nor be an input or lie in one.
    """
    target = os.path.realpath(path)
    if os.path.lexists(target) and not os.path.isdir(target):
        raise DataError(f'{path}: this is {_what(target)}, not a folder; choose another output')
    for input_path in inputs:
        source = os.path.realpath(input_path)
        if target == source or source.startswith(os.path.join(target, '')):
            raise DataError(
                f'{path}: the input {input_path} would be overwritten, choose another output '
                'folder'
            )
        if target.startswith(os.path.join(source, '')):
            raise DataError(
                f'{path}: the output is inside the input {input_path}, choose another output '
                'folder'
            )
    for folder in (target, target + PREVIOUS):
        _check_kind(folder, kind)
    _check_writable(path, target)


def check_output_file(path: PathLike, inputs: Iterable[PathLike] = ()) -> None:
    """Raise DataError unless a file may be written at a path.

    The path must not exist, or be a regular file that is neither an input nor part of one.
    """
    target = os.path.realpath(path)
    if os.path.lexists(target) and not os.path.isfile(target):
        raise DataError(f'{path}: this is {_what(target)}, not a file; choose another output')
    for input_path in inputs:
        source = os.path.realpath(input_path)
        name = os.path.basename(target)
        is_part = os.path.dirname(target) == source and name.endswith(_INPUT_NAMES)
        if os.path.exists(target) and (is_part or _is_same(target, source)):
            raise DataError(
                f'{path}: the input {input_path} would be overwritten, choose another output file'
            )


@contextmanager
def replaced_folder(path: PathLike, kind: FolderKind) -> Iterator[Path]:
    """Yield a new folder to write to; give it its name if the block ends without an error.

    Entries of an earlier folder that do not belong to this kind are carried over; entries that do
    are lost unless they are written again. Raises DataError if the folder cannot be written. After
    any exception the earlier folder is unchanged.
    """
    check_output_folder(path, kind)
    target = os.path.realpath(path)
    parent = os.path.dirname(target)
    make_folder(parent)
    clean_up(target)
    in_place = _is_fixed(target, kind)
    # Set before the folder is created: a signal may end the program right after that.
    staging = _hidden(
        os.path.join(target, os.path.basename(target)) if in_place else target, 'tmp'
    )
    try:
        with os_errors(path, 'cannot be written'), _locked_folder(staging):
            if not in_place and os.path.isdir(target):
                shutil.copymode(target, staging)
                _carry_over(target, staging, kind)
            yield Path(staging)
            sync_folder(staging)
            if in_place:
                _move_entries(staging, target, kind)
            else:
                put_in_place(staging, target)
    except DataError as error:
        raise DataError(str(error).replace(staging, str(path))) from None


@contextmanager
def temporary_folder(path: PathLike) -> Iterator[Path]:
    """Yield a hidden folder next to a path for files on their way there; delete it at the end.

    Folders left behind by killed runs are deleted, too. Raises DataError that names the path if
    the folder cannot be created, and for an OSError in the block.
    """
    clean_up(path)
    folder = _hidden(os.path.abspath(path), 'tmp')
    with os_errors(path, 'cannot be written'), _locked_folder(folder):
        yield Path(folder)


def clean_up(path: PathLike) -> None:
    """Finish or delete folders that killed runs left behind; skip those of active runs.

    Raises DataError if that fails.
    """
    target = os.path.realpath(path)
    parent = os.path.dirname(target)
    with os_errors(path, 'files left by an earlier run cannot be removed'):
        for folder in (parent, target):
            for leftover in _leftovers(folder, target):
                if not _is_locked(leftover):
                    _settle(leftover, target)


def _settle(leftover: str, target: str) -> None:
    """Keep a leftover if it is an old folder, delete it otherwise."""
    mark, suffix = leftover.rsplit('.', 2)[1:]
    is_old = suffix == 'old' or (suffix == 'swap' and mark != str(os.stat(leftover).st_ino))
    if is_old and not os.path.lexists(target):
        os.rename(leftover, target)
    elif is_old and not os.path.lexists(target + PREVIOUS):
        os.rename(leftover, target + PREVIOUS)
    elif suffix == 'swap' and is_old:
        keep_as_previous(leftover, target)
    else:
        shutil.rmtree(leftover)


def put_in_place(staging: str, target: str) -> None:
    """Rename a complete folder to the target; keep the old one as the previous.

    Raises OSError; the old one is then unchanged.
    """
    parent = os.path.dirname(target)
    complete = hidden_path(target, str(os.stat(staging).st_ino), 'swap')
    os.rename(staging, complete)
    try:
        if not os.path.lexists(target):
            os.rename(complete, target)
            sync_folder(parent)
            return
        try:
            _exchange(complete, target)
        except OSError as error:
            if error.errno not in _NO_EXCHANGE:
                raise
            backup = _hidden(target, 'old')
            os.rename(target, backup)
            os.rename(complete, target)
            complete = backup
    except OSError:
        _delete(complete)
        raise
    sync_folder(parent)
    keep_as_previous(complete, target)
    sync_folder(parent)


def keep_as_previous(folder: str, target: str) -> None:
    """Keep a folder as NAME.previous; delete the one that had this name."""
    previous = target + PREVIOUS
    if os.path.lexists(previous):
        outdated = _hidden(target, 'old')
        os.rename(previous, outdated)
        os.rename(folder, previous)
        shutil.rmtree(outdated, ignore_errors=True)
    else:
        os.rename(folder, previous)


def _exchange(first: str, second: str) -> None:
    """Exchange the names of two folders in one step (renameat2 of Linux). Raises OSError."""
    library = None if fcntl is None else ctypes.CDLL(None, use_errno=True)
    function = getattr(library, 'renameat2', None)
    if function is None:
        raise OSError(errno.ENOSYS, os.strerror(errno.ENOSYS))
    paths = (os.fsencode(first), os.fsencode(second))
    if function(_AT_FDCWD, paths[0], _AT_FDCWD, paths[1], _RENAME_EXCHANGE):
        number = ctypes.get_errno()
        raise OSError(number, os.strerror(number))


def _move_entries(staging: str, target: str, kind: FolderKind) -> None:
    """Move new entries one by one into a folder that must stay in place."""
    new_names = set(os.listdir(staging))
    for name in os.listdir(target):
        path = os.path.join(target, name)
        if path != staging and kind.owns(name) and (name not in new_names or os.path.isdir(path)):
            _delete(path)
    for name in sorted(new_names):
        os.replace(os.path.join(staging, name), os.path.join(target, name))
    os.rmdir(staging)
    sync_folder(target)


def _carry_over(old: str, new: str, kind: FolderKind) -> None:
    """Link, or copy, the user's entries of a folder into the new one."""

    def link(source: str, copy: str) -> None:
        try:
            os.link(source, copy, follow_symlinks=False)
        except (OSError, NotImplementedError):
            shutil.copy2(source, copy, follow_symlinks=False)

    for name in sorted(os.listdir(old)):
        source = os.path.join(old, name)
        if kind.owns(name):
            continue
        if os.path.isdir(source) and not os.path.islink(source):
            shutil.copytree(source, os.path.join(new, name), symlinks=True, copy_function=link)
        else:
            link(source, os.path.join(new, name))


@contextmanager
def _locked_folder(path: str) -> Iterator[None]:
    """Create a folder that is locked until the block ends; then delete it unless it was moved."""
    try:
        lock = _make_locked(path)
        try:
            yield
        finally:
            os.close(lock)
    finally:
        _delete(path)


def _make_locked(path: str) -> int:
    """Create a folder that is locked as long as this process lives; return its lock."""
    while True:
        os.mkdir(path)
        lock = _open_folder(path)
        with suppress(OSError):  # no locks in this file system, or another run cleans up now
            _lock(lock)
        if os.path.isdir(path):
            return lock
        os.close(lock)


def _is_locked(path: str) -> bool:
    """Return whether a run is still writing to a folder."""
    lock = _open_folder(path)
    try:
        _lock(lock)
    except BlockingIOError:
        return True
    finally:
        os.close(lock)
    return False


def _open_folder(path: str) -> int:
    return os.open(path, os.O_RDONLY | os.O_DIRECTORY) if fcntl else os.open(os.devnull, 0)


def _lock(folder: int) -> None:
    if fcntl:
        fcntl.flock(folder, fcntl.LOCK_EX | fcntl.LOCK_NB)


def _leftovers(folder: str, target: str) -> list[str]:
    """Return the paths of hidden folders in a folder that were created to replace the target."""
    if not os.path.isdir(folder):
        return []
    start = start_of_hidden(target)
    leftovers = []
    for entry in sorted(os.listdir(folder)):
        mark, _, suffix = entry.removeprefix(start).partition('.')
        if entry.startswith(start) and mark.isalnum() and suffix in ('tmp', 'swap', 'old'):
            path = os.path.join(folder, entry)
            if os.path.isdir(path) and not os.path.islink(path):
                leftovers.append(path)
    return leftovers


def _hidden(target: str, suffix: str) -> str:
    return hidden_path(target, secrets.token_hex(8), suffix)


def _is_fixed(target: str, kind: FolderKind) -> bool:
    """Return whether a folder must stay in place.

    This applies to a mount point, a folder whose parent is not writable, the working folder (a
    shell in it would stay with the old one), and a folder that contains folders of the same kind,
    to which others may be writing.
    """
    if not os.path.isdir(target):
        return False
    return (
        os.path.ismount(target)
        or not os.access(os.path.dirname(target), os.W_OK | os.X_OK)
        or _is_same(target, os.curdir)
        or any(_is_of_kind(os.path.join(target, name), kind) for name in os.listdir(target))
    )


def _is_of_kind(path: str, kind: FolderKind) -> bool:
    return os.path.isdir(path) and any(kind.is_marked_by(name) for name in os.listdir(path))


def _check_kind(folder: str, kind: FolderKind) -> None:
    """Raise DataError for a folder that is neither empty nor of this kind."""
    if not os.path.lexists(folder):
        return
    with os_errors(folder, 'cannot be read'):
        names = [
            name
            for name in os.listdir(folder)
            if name[0] != '.' and not _is_of_kind(os.path.join(folder, name), kind)
        ]
    if names and not any(kind.is_marked_by(name) for name in names):
        raise DataError(
            f'{folder}: this is not {kind.title}, it holds {min(names)}; it is not overwritten'
        )


def _check_writable(path: PathLike, target: str) -> None:
    """Raise DataError unless files can be created in a folder or its nearest existing parent."""
    folder = target
    while not os.path.lexists(folder):
        folder = os.path.dirname(folder)
    if not os.path.isdir(folder):
        raise DataError(f'{path}: {folder} is {_what(folder)}, not a folder')
    probe = os.path.join(folder, f'.{secrets.token_hex(8)}.tmp')
    try:
        with os_errors(path, 'cannot be written'), open(probe, 'xb') as file:
            file.write(b'0')
    finally:
        with suppress(OSError):
            os.unlink(probe)


def _what(path: str) -> str:
    """Return what a path is, if it is not the expected file or folder."""
    mode = os.stat(path).st_mode if os.path.exists(path) else 0
    for test, name in (
        (stat.S_ISREG, 'a file'),
        (stat.S_ISDIR, 'a folder'),
        (stat.S_ISFIFO, 'a pipe'),
        (stat.S_ISCHR, 'a device'),
        (stat.S_ISBLK, 'a device'),
        (stat.S_ISSOCK, 'a socket'),
    ):
        if test(mode):
            return name
    return 'a broken link'


def _is_same(first: str, second: str) -> bool:
    try:
        return os.path.samefile(first, second)
    except OSError:
        return False


def _delete(path: str) -> None:
    if os.path.isdir(path) and not os.path.islink(path):
        shutil.rmtree(path, ignore_errors=True)
    elif path:
        with suppress(OSError):
            os.unlink(path)
