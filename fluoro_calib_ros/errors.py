# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The exception for faults in the data, and safe display of text from files and messages."""

from __future__ import annotations

from typing import Any

from .findings import Finding, Kind, sentences

MAX_MESSAGE = 800  # maximum length in characters
_ELLIPSIS = ' ... '
_KEPT_END = 250  # characters kept at the end, where the cause is


def printable(text: str) -> str:
    """Return a text as one line, with control characters shown as escapes.

    Names in files and messages may contain line ends, or sequences that a terminal interprets;
    printed unchanged, they could pretend to be lines of a log.
    """
    if text.isprintable():
        return text
    return ''.join(
        c if c.isprintable() else c.encode('unicode_escape').decode('ascii') for c in text
    )


def shortened(text: str, limit: int = MAX_MESSAGE) -> str:
    """Return a text without its middle if it is longer than the limit in characters."""
    if len(text) <= limit:
        return text
    end = min(_KEPT_END, limit // 3)
    return text[: limit - end - len(_ELLIPSIS)] + _ELLIPSIS + text[-end:]


def quoted(text: str) -> str:
    """Return text from a file in quotation marks, shortened, for use in a message."""
    return repr(shortened(text, 100))


class DataError(ValueError):
    """A fault in the data, as findings; the message is their sentences.

    Parameters
    ----------
    *found : Finding or object
        Anything but a Finding is the text of one: a sentence that names place and cause.
    at : object, optional
        Where it was found, such as a path; put in front of the places.
    kind : Kind
        Kind of the Finding for a text.
    **more
        Further fields of the Finding for a text.

    Attributes
    ----------
    findings : tuple of Finding
        At least one.

    Notes
    -----
    A text may quote the data: control characters are escaped, and a long message is shortened.
    """

    def __init__(
        self, *found: object, at: object = '', kind: Kind = Kind.DATA, **more: Any
    ) -> None:
        findings = (
            item if isinstance(item, Finding) else Finding(kind, _shown(str(item)), **more)
            for item in found or ('',)
        )
        self.findings = tuple(finding.at(at) for finding in findings)
        super().__init__(_shown('. '.join(sentences(self.findings))))

    @property
    def finding(self) -> Finding:
        """The first finding."""
        return self.findings[0]

    def at(self, where: object) -> DataError:
        """Return the error with a place, such as a path, in front of those of its findings."""
        return DataError(*self.findings, at=where)


class ErrorsAt:
    """Context manager that adds a place, such as a path, to a DataError."""

    def __init__(self, where: object) -> None:
        self._where = where

    def __enter__(self) -> None:
        return None

    def __exit__(self, kind: object, error: BaseException | None, traceback: object) -> None:
        if isinstance(error, DataError):
            raise error.at(self._where) from None


def _shown(text: str) -> str:
    if len(text) > MAX_MESSAGE:  # avoid examining megabytes
        text = shortened(text)
    return shortened(printable(text))
