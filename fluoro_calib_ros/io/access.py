# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Read and write whole files and folders; check names that become part of file names."""

from __future__ import annotations

import os
import re
import secrets
import stat
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import IO, Any, BinaryIO

from ..errors import DataError
from ..limits import read_limits

UTF_16 = (b'\xff\xfe', b'\xfe\xff')  # byte order marks
# Beginnings of text files with tables in layouts that are not read.
_QTM = 'a TSV export of Qualisys Track Manager; export the trial as C3D, which is read'
_NEXUS = 'an ASCII export of Vicon Nexus; take the C3D file of the trial, which is read'
# Beginnings of files that are not read, with advice to the user.
_NOT_READ = (
    (b'PK\x03\x04', 'an xlsx spreadsheet or another zip archive; save the table as CSV'),
    (b'\xd0\xcf\x11\xe0', 'an xls spreadsheet; save the table as CSV'),
    (
        b'\x89HDF',
        'an HDF5 file; of these, files of DeepLabCut and analysis files of SLEAP are read, as '
        'image points; save others as CSV',
    ),
    (b'NO_OF_FRAMES\t', _QTM),
    (b'FILE_VERSION\t', _QTM),
    (b'Trajectories', _NEXUS),
    (b'Model Outputs', _NEXUS),
    (b'Sparse format ', 'a sparse file of DLTdv8; save the data in flat format, as CSV'),
)
_SAFE_NAME = re.compile('[A-Za-z0-9_-]+')

PathLike = str | os.PathLike[str]


def os_error_reason(error: OSError) -> str:
    """Return the reason of an OSError in a few words, in lower case."""
    return (error.strerror or type(error).__name__).lower()


@contextmanager
def os_errors(path: object, failure: str) -> Iterator[None]:
    """Turn an OSError into a DataError; failure: the failure, such as 'cannot be read'."""
    try:
        yield
    except OSError as error:
        raise DataError(f'{path}: {failure} ({os_error_reason(error)})') from None


def check_regular_file(path: PathLike) -> None:
    """Raise DataError for a pipe, device or socket: reading one may never end.

    A path that does not exist or cannot be accessed passes: the reader will report it.
    """
    try:
        mode = os.stat(path).st_mode
    except (OSError, ValueError):
        return
    if not stat.S_ISREG(mode) and not stat.S_ISDIR(mode):
        raise DataError('this is a pipe, device or socket, not a file', at=path)


@contextmanager
def opened(path: PathLike) -> Iterator[BinaryIO]:
    """Open a file for reading. Raises DataError for a folder or if the file cannot be read."""
    check_regular_file(path)
    try:
        with open(path, 'rb') as file:
            yield file
    except DataError:
        raise
    except FileNotFoundError:
        raise DataError('there is no such file', at=path) from None
    except IsADirectoryError:
        raise DataError('this is a folder, not a file', at=path) from None
    except (OSError, ValueError) as error:  # ValueError: a NUL byte in the name
        reason = os_error_reason(error) if isinstance(error, OSError) else error
        raise DataError(f'cannot be read ({reason})', at=path) from None


def read_bytes(path: PathLike) -> bytes:
    """Return the content of a file. Raises DataError, also for an empty or too large file."""
    with opened(path) as file:
        size = os.fstat(file.fileno()).st_size
        limits = read_limits()
        if size > limits.max_file_bytes:
            raise DataError(
                f'the file has {size / 1e6:.0f} MB; the limit is {limits.max_file_mb} MB',
                at=path,
            )
        content = file.read()
    if not content:
        raise DataError('the file is empty', at=path)
    return content


def read_text(path: PathLike) -> str:
    """Return the text of a file in UTF-8, or in UTF-16 with a byte order mark, without the mark.

    Raises DataError as `read_bytes`, for a kind that is not read, and for another encoding.
    """
    content = read_bytes(path)
    kind = kind_not_read(content)
    if kind:
        raise DataError(f'this is {kind}', at=path)
    encoding = encoding_of(content)
    try:
        return content.decode(encoding)
    except UnicodeDecodeError as error:
        row = content.count(b'\n', 0, error.start) + 1
        name = encoding.upper().removesuffix('-SIG')
        raise DataError(
            f'{path}, row {row}: this is not {name} text (byte 0x{content[error.start]:02x})'
        ) from None


def encoding_of(content: bytes) -> str:
    """Return the encoding of a text, judged by its first bytes."""
    return 'utf-16' if content.startswith(UTF_16) else 'utf-8-sig'


def kind_not_read(content: bytes) -> str:
    """Return the kind of a file that is not read, with advice to the user; otherwise ''."""
    stripped = content.lstrip()
    return next((kind for start, kind in _NOT_READ if stripped.startswith(start)), '')


def check_rows(text: str, most: int, where: object) -> None:
    """Raise DataError for a text of more than `most` rows; the message begins with where."""
    rows = text.count('\n')
    if rows > most:
        raise DataError(f'{where}: {rows} rows; the limit is {most}')


def check_layout_version(path: object, version: object, last: int) -> None:
    """Raise DataError for a file whose layout has no version from 1 to `last`."""
    if version not in range(1, last + 1):
        known = 'version 1' if last == 1 else f'versions 1 to {last}'
        raise DataError(
            f'{path}: the file has layout version {version}, this program reads {known}'
        )


def check_safe_name(name: str, where: object) -> None:
    """Raise DataError unless the name of a fluoroscope can be part of a file name.

    It may contain letters, digits, _ and -. The message begins with where.
    """
    longest = read_limits().max_name_length
    if len(str(name)) > longest or not _SAFE_NAME.fullmatch(str(name)):
        raise DataError(
            f'the fluoroscope is called {name!r}, but a name consists of letters, '
            f'digits, _ and -, at most {longest} of them',
            at=where,
        )


def make_folder(path: PathLike) -> None:
    """Create a folder and its parents unless it exists. Raises DataError."""
    try:
        os.makedirs(path, exist_ok=True)
    except FileExistsError:
        raise DataError('this is a file, not a folder', at=path) from None
    except OSError as error:
        raise DataError(
            f'the folder cannot be created ({os_error_reason(error)})', at=path
        ) from None


# Atomic writing: afterwards either the complete new file or the old one exists.


def start_of_hidden(target: str) -> str:
    """Return the start of the names of hidden files and folders that are written for a path."""
    name = os.path.basename(target).encode(errors='surrogateescape')
    return f'.{name[:100].decode(errors="ignore")}.'  # file systems limit names to 255 bytes


def hidden_path(target: str, mark: str, suffix: str) -> str:
    """Return the path of a hidden file or folder next to a path; mark: letters and digits."""
    return os.path.join(os.path.dirname(target), f'{start_of_hidden(target)}{mark}.{suffix}')


@contextmanager
def atomic_file(path: PathLike, mode: str = 'wb') -> Iterator[IO[Any]]:
    """Open a temporary file for writing; rename it to path when the block ends without an error.

    mode is 'wb', or 'w' for UTF-8 text without conversion of line ends, in which bytes of a file
    name that are not UTF-8 are escaped, as JSON does. Raises DataError if the file cannot be
    written. After any exception an earlier file is unchanged.
    """
    target = os.path.realpath(path)  # write through a symbolic link, do not replace it
    folder = os.path.dirname(target)
    if os.path.lexists(target) and not os.path.isfile(target):
        kind = 'a directory' if os.path.isdir(target) else 'a device or pipe'
        raise DataError(f'{path}: cannot be written (this is {kind}, not a file)')
    temporary = hidden_path(target, secrets.token_hex(8), 'tmp')
    text_options: dict[str, Any] = {}
    if 'b' not in mode:
        text_options = {'encoding': 'utf-8', 'errors': 'backslashreplace', 'newline': ''}
    try:
        with open(temporary, mode.replace('w', 'x'), **text_options) as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, target)
        sync_folder(folder)
    except OSError as error:
        if isinstance(error, FileNotFoundError) and not os.path.isdir(folder):
            raise DataError(f'{path}: cannot be written, there is no folder {folder}') from None
        raise DataError(f'{path}: cannot be written ({os_error_reason(error)})') from None
    finally:
        with suppress(OSError):  # it has been renamed unless there was an error
            os.unlink(temporary)


def write_bytes(path: PathLike, content: bytes) -> None:
    """Write a binary file atomically. Raises DataError if it cannot be written."""
    with atomic_file(path) as file:
        file.write(content)


def write_text(path: PathLike, text: str) -> None:
    """Write a UTF-8 text file atomically. Raises DataError if it cannot be written."""
    with atomic_file(path, 'w') as file:
        file.write(text)


def sync_folder(folder: PathLike) -> None:
    """Flush a folder to disk, where supported: its names then survive a power failure."""
    with suppress(OSError):
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
