"""Writing that leaves either the whole new file or the old one, never half of one."""

import os
import secrets
from contextlib import contextmanager, suppress

from ..errors import DataError
from .access import os_error_reason


@contextmanager
def atomic_file(path, mode='wb'):
    """Open path for writing; the content appears under that name only when the block has ended
    well.

    mode 'wb' for bytes or 'w' for UTF-8 text (line ends as written). An exception in the block
    leaves what was there before. Raises DataError where the file cannot be written.
    """
    target = os.path.realpath(path)  # a link stays a link
    folder, name = os.path.split(target)
    temporary = os.path.join(folder, f'.{name[:100]}.{secrets.token_hex(8)}.tmp')
    text = {} if 'b' in mode else {'encoding': 'utf-8', 'newline': ''}
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


def write_bytes(path, content):
    """Write the bytes content to path as a whole. Raises DataError where it cannot be written."""
    with atomic_file(path) as file:
        file.write(content)


def write_text(path, text):
    """Write text to path, UTF-8, as a whole. Raises DataError where it cannot be written."""
    write_bytes(path, text.encode())


def sync_folder(folder):
    """Make the names in a folder survive a power failure, where the system can."""
    with suppress(OSError):
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


def _remove(path):
    with suppress(OSError):
        os.unlink(path)
