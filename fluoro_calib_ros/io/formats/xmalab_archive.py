# SPDX-FileCopyrightText: 2026 fluoro_calib_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The files of an XMALab project: a ZIP file with project.xml and the tables it names."""

from __future__ import annotations

import posixpath
import sys
import zipfile
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from ...errors import DataError
from ...limits import MAX_MEMBER, read_limits
from ..access import os_error_reason
from ..documents import parse_xml
from .text import Row, table_of

DOCUMENT = 'project.xml'


class ProjectArchive:
    """An open project; a context manager.

    Attributes
    ----------
    path : Path
        For messages.
    root : Element
        Of project.xml.

    Raises
    ------
    DataError
        Where the file is no project; so do the methods, for whatever is missing or damaged.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            self._archive = zipfile.ZipFile(path)
        except OSError as error:
            raise DataError(f'{path}: cannot be read ({os_error_reason(error)})') from None
        except zipfile.BadZipFile:
            raise DataError(
                f'{path}: this is not an XMALab project, which is a ZIP file'
            ) from None
        self._members = {
            posixpath.normpath(info.filename.replace('\\', '/')): info
            for info in self._archive.infolist()
        }
        self.root = self._document()

    def __enter__(self) -> ProjectArchive:
        return self

    def __exit__(self, *_: object) -> None:
        self._archive.close()

    def _document(self) -> ElementTree.Element:
        root = parse_xml(self.member_text(DOCUMENT), f'{self.path}, {DOCUMENT}')
        if root.tag != 'Project':
            raise DataError(f'{self.path}, {DOCUMENT}: this is not a project of XMALab')
        return root

    def member(self, name: str, most: int = sys.maxsize) -> bytes:
        """Return a file of the archive, of at most so many bytes."""
        info = self._members.get(posixpath.normpath(name.replace('\\', '/')))
        if info is None:
            raise DataError(f'{self.path}: the project does not contain {name}')
        if info.file_size > min(most, read_limits().max_file_bytes):
            raise DataError(f'{self.path}: {name} is too large, {info.file_size} bytes')
        try:
            return self._archive.read(info)
        except Exception as error:  # whatever zipfile and its decompressors make of the damage
            raise DataError(f'{self.path}: {name} is damaged ({error})') from None

    def member_text(self, name: str) -> str:
        """Return a file of the archive as text."""
        return self.member(name, MAX_MEMBER).decode('utf-8', 'replace')

    def numbers(self, name: str) -> np.ndarray:
        """Return a table of numbers; an error for rows of different lengths, too."""
        rows: list[Row] = table_of(f'{self.path}, {name}', self.member_text(name))
        values = [row.numbers_or_nan() for row in rows]
        for row, of_row in zip(rows, values):
            if len(of_row) != len(values[0]):
                row.fail(f'{len(of_row)} columns, but the first row has {len(values[0])}')
        return np.array(values)

    def text(self, element: ElementTree.Element, name: str) -> str:
        """Return an attribute."""
        value = element.get(name)
        if value is None:
            raise DataError(f'{self.path}, {DOCUMENT}: a {element.tag} has no attribute {name}')
        return value

    def whole(self, element: ElementTree.Element, name: str) -> int:
        """Return an attribute that is a whole number."""
        text = self.text(element, name)
        if not text.isascii() or not text.isdigit():
            raise DataError(
                f'{self.path}, {DOCUMENT}: {name} of a {element.tag} is {text!r}, not a whole '
                'number'
            )
        return int(text)

    def file_of(self, element: ElementTree.Element, tag: str) -> str:
        """Return the name of the file of a child."""
        child = element.find(tag)
        if child is None:
            raise DataError(f'{self.path}, {DOCUMENT}: a {element.tag} has no {tag}')
        return self.text(child, 'Filename')
