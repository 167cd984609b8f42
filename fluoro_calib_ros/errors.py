# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The exception for faults in the data, and how text of others is shown."""

from __future__ import annotations

MAX_MESSAGE = 800  # characters
_ELLIPSIS = ' ... '
_KEPT_END = 250  # characters; the cause is at the end


def printable(text: str) -> str:
    """Return a text as one line without control characters, which are shown as escapes.

    Names in files and messages may hold line ends, or sequences that a terminal obeys: printed as
    they are, they could pretend to be lines of a log.
    """
    if text.isprintable():
        return text
    return ''.join(
        c if c.isprintable() else c.encode('unicode_escape').decode('ascii') for c in text
    )


def shortened(text: str, limit: int = MAX_MESSAGE) -> str:
    """Return a text without its middle where it has more characters than the limit."""
    if len(text) <= limit:
        return text
    end = min(_KEPT_END, limit // 3)
    return text[: limit - end - len(_ELLIPSIS)] + _ELLIPSIS + text[-end:]


class DataError(ValueError):
    """A fault in the data; the message is one sentence that names place and cause.

    It may quote the data: control characters are escaped, and a long message is cut.
    """

    def __init__(self, message: object = '') -> None:
        text = str(message)
        if len(text) > MAX_MESSAGE:  # before megabytes are examined
            text = shortened(text)
        super().__init__(shortened(printable(text)))
