"""Reading a whole file, and names that are safe as file names."""

import os
import re

from ..errors import DataError

_SAFE_NAME = re.compile(r'[A-Za-z0-9_-]{1,100}')


def os_error_reason(error):
    """The cause of an OSError, in a few words."""
    return (error.strerror or type(error).__name__).lower()


def read_bytes(path):
    """Content of the file path.

    Raises DataError where there is no such file, where it is a folder, where it cannot be read or
    is empty.
    """
    try:
        with open(path, 'rb') as file:
            content = file.read()
    except FileNotFoundError:
        raise DataError(f'{path}: there is no such file') from None
    except IsADirectoryError:
        raise DataError(f'{path}: this is a folder, not a file') from None
    except (OSError, ValueError) as error:  # ValueError: a NUL byte in the name
        cause = os_error_reason(error) if isinstance(error, OSError) else error
        raise DataError(f'{path}: cannot be read ({cause})') from None
    if not content:
        raise DataError(f'{path}: the file is empty')
    return content


def read_text(path):
    """Text of the file path, UTF-8 with or without a byte order mark. Raises DataError, see
    read_bytes.
    """
    content = read_bytes(path)
    try:
        return content.decode('utf-8-sig')
    except UnicodeDecodeError as error:
        row = content.count(b'\n', 0, error.start) + 1
        raise DataError(
            f'{path}, row {row}: this is not UTF-8 text (byte 0x{content[error.start]:02x})'
        ) from None


def check_safe_name(name, where):
    """Check that the name of a fluoroscope can be a file name: letters, digits, _ and -. Raises
    DataError.
    """
    if not _SAFE_NAME.fullmatch(str(name)):
        raise DataError(
            f'{where}: the fluoroscope is called {name!r}, but a name consists of letters, digits, '
            f'_ and -, at most 100 of them'
        )


def make_folder(path):
    """Make the folder path, and those above it, unless it is there. Raises DataError."""
    try:
        os.makedirs(path, exist_ok=True)
    except FileExistsError:
        raise DataError(f'{path}: this is a file, not a folder') from None
    except OSError as error:
        raise DataError(f'{path}: the folder cannot be made ({os_error_reason(error)})') from None
