# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Reading of whole files, folders, and names that are safe as file names."""

from __future__ import annotations

import os
import re
import stat

from ..errors import DataError
from ..limits import read_limits

_SAFE_NAME = re.compile('[A-Za-z0-9_-]+')

PathLike = str | os.PathLike[str]


def os_error_reason(error: OSError) -> str:
    """Return the reason of an OSError in a few words, in lower case."""
    return (error.strerror or type(error).__name__).lower()


def check_regular_file(path: PathLike) -> None:
    """Raise DataError for a pipe, device or socket: reading one may never end.

    What does not exist, or cannot be looked at, is left to the reader.
    """
    try:
        mode = os.stat(path).st_mode
    except (OSError, ValueError):
        return
    if not stat.S_ISREG(mode) and not stat.S_ISDIR(mode):
        raise DataError('this is a pipe, device or socket, not a file', at=path)


def read_bytes(path: PathLike) -> bytes:
    """Return the content of a file.

    Raises DataError for a file that does not exist, cannot be read or is empty, and for a folder.
    """
    check_regular_file(path)
    try:
        with open(path, 'rb') as file:
            size = os.fstat(file.fileno()).st_size
            limits = read_limits()
            if size > limits.max_file_bytes:
                raise DataError(
                    f'the file has {size / 1e6:.0f} MB, more than {limits.max_file_mb} MB '
                    'are not read',
                    at=path,
                )
            content = file.read()
    except FileNotFoundError:
        raise DataError('there is no such file', at=path) from None
    except IsADirectoryError:
        raise DataError('this is a folder, not a file', at=path) from None
    except OSError as error:
        raise DataError(f'cannot be read ({os_error_reason(error)})', at=path) from None
    except ValueError as error:  # a NUL byte in the name
        raise DataError(f'cannot be read ({error})', at=path) from None
    if not content:
        raise DataError('the file is empty', at=path)
    return content


def read_text(path: PathLike) -> str:
    """Return the text of a UTF-8 file, without its byte order mark.

    Raises DataError as `read_bytes` does, and for a file that is not UTF-8.
    """
    content = read_bytes(path)
    try:
        return content.decode('utf-8-sig')
    except UnicodeDecodeError as error:
        row = content.count(b'\n', 0, error.start) + 1
        raise DataError(
            f'{path}, row {row}: this is not UTF-8 text (byte 0x{content[error.start]:02x})'
        ) from None


def check_rows(text: str, most: int, where: object) -> None:
    """Raise DataError for a text of more rows than that; where begins its message."""
    rows = text.count('\n')
    if rows > most:
        raise DataError(f'{where}: {rows} rows, more than {most} are not read')


def check_safe_name(name: str, where: object) -> None:
    """Raise DataError unless the name of a fluoroscope can be part of a file name.

    It may contain letters, digits, _ and -; where begins the message.
    """
    longest = read_limits().max_name_length
    if len(str(name)) > longest or not _SAFE_NAME.fullmatch(str(name)):
        raise DataError(
            f'the fluoroscope is called {name!r}, but a name consists of letters, '
            f'digits, _ and -, at most {longest} of them',
            at=where,
        )


def make_folder(path: PathLike) -> None:
    """Create a folder, and those above it, unless it exists. Raises DataError."""
    try:
        os.makedirs(path, exist_ok=True)
    except FileExistsError:
        raise DataError('this is a file, not a folder', at=path) from None
    except OSError as error:
        raise DataError(
            f'the folder cannot be created ({os_error_reason(error)})', at=path
        ) from None
