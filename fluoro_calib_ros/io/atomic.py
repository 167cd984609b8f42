# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Writing that leaves either the complete new file or the old one."""

from __future__ import annotations

import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import IO, Any

from ..errors import DataError
from .access import PathLike, os_error_reason


@contextmanager
def atomic_file(path: PathLike, mode: str = 'wb') -> Iterator[IO[Any]]:
    """Open a file for writing that gets its name when the block ends without an error.

    Parameters
    ----------
    path : path-like
    mode : {'wb', 'w'}
        Bytes, or UTF-8 text without conversion of line ends.

    Raises
    ------
    DataError
        Where the file cannot be written. After any exception an earlier file is unchanged.
    """
    target = os.path.realpath(path)  # a symbolic link remains one
    folder, name = os.path.split(target)
    if os.path.lexists(target) and not os.path.isfile(target):
        what = 'a directory' if os.path.isdir(target) else 'a device or pipe'
        raise DataError(f'{path}: cannot be written (this is {what}, not a file)')
    temporary = os.path.join(folder, f'.{name[:100]}.{secrets.token_hex(8)}.tmp')
    text: dict[str, Any] = {} if 'b' in mode else {'encoding': 'utf-8', 'newline': ''}
    try:
        with open(temporary, mode.replace('w', 'x'), **text) as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, target)
        sync_folder(folder)
    except OSError as error:
        _remove(temporary)
        raise DataError(f'{path}: cannot be written ({os_error_reason(error)})') from None
    except BaseException:
        _remove(temporary)
        raise


def write_bytes(path: PathLike, content: bytes) -> None:
    """Write a file of bytes as a whole. Raises DataError where it cannot be written."""
    with atomic_file(path) as file:
        file.write(content)


def write_text(path: PathLike, text: str) -> None:
    """Write a file of UTF-8 text as a whole. Raises DataError where it cannot be written."""
    write_bytes(path, text.encode())


def sync_folder(folder: PathLike) -> None:
    """Make the names in a folder survive a power failure, where the system supports it."""
    with suppress(OSError):
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


def _remove(path: PathLike) -> None:
    with suppress(OSError):
        os.unlink(path)
